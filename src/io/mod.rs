//! Scene files in, images and scenes out (feature `io`).
//!
//! | file | what it does |
//! |---|---|
//! | [`load`] | chooses a reader by the file name's extension |
//! | `source`, `account` | which files a scene may name, limits, progress, cancelling, memory |
//! | `obj` | Wavefront OBJ with material libraries |
//! | `ply` | PLY, ASCII and binary |
//! | `gltf` | glTF 2.0 and GLB: geometry, materials, punctual lights |
//! | `texture` | PNG and JPEG images of materials |
//! | [`image`] | EXR and PNG files, tone mapping |
//! | [`lightmaps`] | baked light maps: pages as EXR and PNG, the lit scene as GLB |
//! | [`glb`] | a scene with its light maps as GLB, for any viewer |
//!
//! All surfaces become diffuse [`Material`]s with their colour textures, holes and transmission. Images that
//! cannot be read, or lie where the scene must not look, are warnings.
//! Malformed files are refused with an [`Error::Io`] that names the file and the place; degenerate
//! triangles are kept (commit skips and counts them); vertices that are not finite are malformed.

mod account;
pub mod glb;
mod gltf;
pub mod image;
pub mod lightmaps;
mod obj;
mod ply;
mod source;
#[cfg(test)]
mod tests;
mod texture;

use crate::base::error::{Error, Result};
use crate::base::memory::MemoryMonitor;
use crate::base::progress::Progress;
use crate::scene::{Instance, MAX_ALBEDO, MAX_COORDINATE, MAX_TRIANGLES, Material, Mesh, NONE, SceneData, Texture};
use account::Account;
use glam::Vec3;
use source::{Advance, Attempt, Files, Opened, Source, read_error};
use std::fmt::Display;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

/// Sidedness of materials from files that say nothing about it (OBJ, PLY). Such files are often
/// modelled without care for winding, so like other renderers we let both sides reflect. Emissive
/// surfaces then emit from both sides too.
pub const TWO_SIDED_UNLESS_SAID: bool = true;

/// Reflectance of surfaces whose file names no material, or names one without describing it.
pub const DEFAULT_ALBEDO: f32 = 0.5;

/// Numbers about a file that was loaded.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LoadInfo {
    /// Number of meshes added.
    pub meshes: u32,
    /// Number of instances added.
    pub instances: u32,
    /// Number of triangles added, those of every instance counted and degenerate ones included.
    pub triangles: u64,
    /// Number of vertices added.
    pub vertices: u64,
    /// Number of materials added, emissive ones included.
    pub materials: u32,
    /// Number of textures added.
    pub textures: u32,
    /// Number of lights added, emissive materials not counted.
    pub lights: u32,
    /// Materials of which a reflectance was outside [0, [`MAX_ALBEDO`]] and was clamped.
    pub albedos_clamped: u32,
    /// Faces of more than three corners, split into fans of triangles.
    pub faces_triangulated: u64,
    /// Whether any mesh brings light map coordinates.
    pub has_lightmap_uvs: bool,
    /// Things of the file that were ignored or replaced, a sentence each.
    pub warnings: Vec<String>,
    /// Wall time.
    pub seconds: f64,
}

/// Which files a scene may consist of, and how much of them.
#[derive(Clone)]
pub struct LoadOptions {
    /// Files that the scene names must lie in this folder or below; `None`: in the scene file's own or below.
    pub base_folder: Option<PathBuf>,
    /// Whether files that the scene names may lie anywhere: for scenes that are trusted.
    pub any_folder: bool,
    /// Most bytes of all files together.
    pub max_file_bytes: u64,
    /// Most bytes of all decoded images together, 4 per texel. Looked at before an image is decoded.
    pub max_texture_bytes: u64,
    /// The accounts that are asked before memory is taken: those of the device.
    pub memory: Arc<MemoryMonitor>,
}

impl Default for LoadOptions {
    fn default() -> Self {
        LoadOptions {
            base_folder: None,
            any_folder: false,
            max_file_bytes: 16 << 30,
            max_texture_bytes: 2 << 30,
            memory: Arc::default(),
        }
    }
}

/// Same as [`load_with`], with the default options and without reports of progress.
pub fn load(path: &Path, data: &mut SceneData) -> Result<LoadInfo> {
    load_with(path, &LoadOptions::default(), &Progress::none(), data)
}

/// Reads the scene file `path` and appends what is in it to `data`. The extension decides, in any
/// case: `.obj`, `.ply`, `.gltf`, `.glb`.
///
/// Fails with [`Error::Unsupported`] for other extensions and for files that need what is not supported, with
/// [`Error::Io`] for files that cannot be read or are malformed, with [`Error::OutOfMemory`] beyond the limits of
/// `options` or where there is no memory, with [`Error::Cancelled`]; `data` is unchanged then.
pub fn load_with(path: &Path, options: &LoadOptions, progress: &Progress, data: &mut SceneData) -> Result<LoadInfo> {
    let start = Instant::now();
    let extension = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
    let read = match extension.as_str() {
        "obj" => obj::load,
        "ply" => ply::load,
        "gltf" | "glb" => gltf::load,
        _ => {
            return Err(Error::Unsupported(format!(
                "{} has the extension {extension:?}, not obj, ply, gltf or glb",
                path.display()
            )));
        }
    };
    let mut files = Files::new(path, options)?;
    let opened = files.open_scene(path)?;
    // Twice the file: nobody knows yet what its images add.
    let stage = progress.stage("scene file", 0.0, 0.99, opened.size.saturating_mul(2));
    let advance = |bytes| stage.advance(bytes);
    let mut import = Import::new(path, options, files, &advance)?;
    // Decoders know no cancel: they take it for a file that cannot be read.
    let read = read(&mut import, opened).map_err(|e| if progress.is_cancelled() { Error::Cancelled } else { e });
    read?;
    // The last report comes before `data` changes.
    progress.stage("scene file", 1.0, 1.0, 1);
    progress.check()?;
    let mut info = import.finish(data)?;
    info.seconds = start.elapsed().as_secs_f64();
    Ok(info)
}

/// A scene file being read: what was found so far, apart from the caller's scene.
struct Import<'s> {
    path: PathBuf,
    scene: SceneData,
    info: LoadInfo,
    account: Account,
    files: Files,
    texture_bytes_left: u64,
    advance: Advance<'s>,
}

impl<'s> Import<'s> {
    fn new(path: &Path, options: &LoadOptions, files: Files, advance: Advance<'s>) -> Result<Self> {
        Ok(Import {
            path: path.to_owned(),
            scene: SceneData::new(),
            info: LoadInfo::default(),
            account: Account::new(&options.memory)?,
            files,
            texture_bytes_left: options.max_texture_bytes,
            advance,
        })
    }

    /// The error that the file is malformed, which names it.
    fn error(&self, what: impl std::fmt::Display) -> Error {
        Error::Io(format!("{}: {what}", self.path.display()))
    }

    /// `Err(Cancelled)` once the caller has asked to stop. Makes reports that are due.
    fn check(&self) -> Result<()> {
        (self.advance)(0)
    }

    fn warn(&mut self, what: impl Into<String>) {
        self.info.warnings.push(what.into());
    }

    /// Adds a material. Clamps its reflectance, counts that, and limits it to the light that does not pass through.
    fn add_material(&mut self, mut material: Material) -> Result<u32> {
        let limit = if material.albedo_texture == NONE { MAX_ALBEDO } else { 1.0 };
        let clamped = material.albedo.map(|a| a.clamp(0.0, limit));
        self.info.albedos_clamped += (clamped != material.albedo) as u32;
        material.transmission = material.transmission.map(|t| t.clamp(0.0, 1.0));
        material.albedo = std::array::from_fn(|c| clamped[c].min(1.0 - material.transmission[c]));
        self.scene.add_material(material).map_err(|e| self.rename(e))
    }

    /// Adds the image of some materials, which is called `name`, or a warning that it cannot be read.
    fn image(&mut self, name: impl Display, image: Attempt<Texture>) -> Result<Option<Texture>> {
        let image = image?;
        if let Err(what) = &image {
            self.warn(format!("the image {name} cannot be read ({what}); its materials do without"));
        }
        Ok(image.ok())
    }

    /// All bytes of a file that one in `folder` names. They are counted in the account.
    fn read_named(&mut self, folder: &Path, name: &str) -> Attempt<Vec<u8>> {
        match self.files.open(folder, name)? {
            Ok(opened) => self.read_opened(opened).map(Ok),
            Err(what) => Ok(Err(what)),
        }
    }

    fn read_opened(&mut self, opened: Opened) -> Result<Vec<u8>> {
        let path = opened.path.clone();
        let size = usize::try_from(opened.size).map_err(|_| self.error("it does not fit into memory"))?;
        let mut bytes = self.account.list(size, "a file")?;
        let mut source = Source::new(opened, self.advance);
        // (There is room for all of it: the list does not grow.)
        source.read_to_end(&mut bytes).map_err(|e| read_error(e, path.display()))?;
        Ok(bytes)
    }

    fn add_texture(&mut self, texture: Texture) -> Result<u32> {
        self.scene.add_texture(texture).map_err(|e| self.rename(e))
    }

    fn add_mesh(&mut self, mesh: Mesh) -> Result<()> {
        self.scene.add_mesh(mesh).map(|_| ()).map_err(|e| self.rename(e))
    }

    fn add_instance(&mut self, instance: Instance) -> Result<()> {
        self.scene.add_instance(instance).map(|_| ()).map_err(|e| self.rename(e))
    }

    /// Turns a refusal of the scene into an error that names the file.
    fn rename(&self, e: Error) -> Error {
        match e {
            Error::InvalidArgument(what) => self.error(what),
            e => e,
        }
    }

    /// Refuses a file before its triangles fill the memory.
    fn check_triangle_count(&self, count: usize) -> Result<()> {
        if count > MAX_TRIANGLES {
            return Err(self.error(format_args!("it has more than {MAX_TRIANGLES} triangles")));
        }
        Ok(())
    }

    /// Moves everything that was read to the caller's scene.
    fn finish(self, data: &mut SceneData) -> Result<LoadInfo> {
        let Import { mut info, scene, account, .. } = self;
        info.meshes = scene.meshes().len() as u32;
        info.instances = scene.instances().len() as u32;
        info.triangles = scene.triangle_count() as u64;
        info.vertices = scene.meshes().iter().map(|m| m.positions.len() as u64).sum();
        info.materials = scene.materials().len() as u32;
        info.textures = scene.textures().len() as u32;
        info.lights = scene.lights().len() as u32;
        info.has_lightmap_uvs = scene.meshes().iter().any(|m| m.lightmap.is_some());
        // From here on the memory is the scene's.
        drop(account);
        data.append(scene)?;
        Ok(info)
    }
}

/// Whether a vertex is finite and in the valid range.
fn is_valid_position(p: Vec3) -> bool {
    p.abs().max_element() <= MAX_COORDINATE && !p.is_nan()
}
