//! Scene files in, images and scenes out (feature `io`).
//!
//! | file | what it does |
//! |---|---|
//! | [`load`] | chooses a reader by the file name's extension |
//! | `obj`, `mtl` | Wavefront OBJ with material libraries |
//! | `ply` | PLY, ASCII and binary |
//! | `gltf` | glTF 2.0 and GLB: geometry, materials, punctual lights |
//! | `texture` | PNG and JPEG images of materials |
//! | [`image`] | EXR and PNG files, tone mapping |
//! | [`lightmaps`] | baked light maps: pages as EXR and PNG, the lit scene as GLB |
//! | [`glb`] | a scene with its light maps as GLB, for any viewer |
//!
//! All surfaces become diffuse [`Material`]s with their colour textures, holes and transmission. Images that
//! cannot be read are warnings.
//! Malformed files are refused with an [`Error::Io`] that names the file and the place; degenerate
//! triangles are kept (commit skips and counts them); vertices that are not finite are malformed.

pub mod glb;
mod gltf;
pub mod image;
pub mod lightmaps;
mod mtl;
mod obj;
mod ply;
#[cfg(test)]
mod tests;
mod texture;

use crate::error::{Error, Result};
use crate::scene::{MAX_ALBEDO, MAX_COORDINATE, MAX_TRIANGLES, Material, Mesh, NONE, SceneData, Texture};
use glam::Vec3;
use std::fmt::Display;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Sidedness of materials from files that say nothing about it (OBJ, PLY). Such files are often
/// modelled without care for winding, so like other renderers we let both sides reflect. Emissive
/// surfaces then emit from both sides too.
pub const TWO_SIDED_UNLESS_SAID: bool = true;

/// Reflectance where a file names a material without describing it, or none at all.
pub const DEFAULT_ALBEDO: f32 = 0.5;

/// What [`load`] found.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LoadInfo {
    pub meshes: u32,
    pub triangles: u64,
    pub vertices: u64,
    pub materials: u32,
    pub textures: u32,
    pub lights: u32,
    /// Materials of which a reflectance was outside [0, [`MAX_ALBEDO`]] and was clamped.
    pub albedos_clamped: u32,
    /// Faces of more than three corners, split into fans of triangles.
    pub faces_triangulated: u64,
    /// Whether any mesh brings light map coordinates.
    pub has_lightmap_uvs: bool,
    /// What was ignored or replaced, a sentence each.
    pub warnings: Vec<String>,
    /// Wall time.
    pub seconds: f64,
}

/// Reads the scene file `path` and appends what is in it to `data`. The extension decides, in any
/// case: `.obj`, `.ply`, `.gltf`, `.glb`.
///
/// Fails with [`Error::Unsupported`] for other extensions and for files that need what is not
/// supported, and with [`Error::Io`] for files that cannot be read or are malformed; `data` is
/// unchanged then.
pub fn load(path: &Path, data: &mut SceneData) -> Result<LoadInfo> {
    let start = Instant::now();
    let extension = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
    let mut import = Import::new(path);
    match extension.as_str() {
        "obj" => obj::load(&mut import)?,
        "ply" => ply::load(&mut import)?,
        "gltf" | "glb" => gltf::load(&mut import)?,
        _ => {
            return Err(Error::Unsupported(format!(
                "{} has the extension {extension:?}, not obj, ply, gltf or glb",
                path.display()
            )));
        }
    }
    let mut info = import.finish(data)?;
    info.seconds = start.elapsed().as_secs_f64();
    Ok(info)
}

/// A scene file being read: what was found so far, apart from the caller's scene.
struct Import {
    path: PathBuf,
    scene: SceneData,
    info: LoadInfo,
}

impl Import {
    fn new(path: &Path) -> Self {
        Import { path: path.to_owned(), scene: SceneData::new(), info: LoadInfo::default() }
    }

    /// "This file is malformed": the error that names it.
    fn error(&self, what: impl std::fmt::Display) -> Error {
        Error::Io(format!("{}: {what}", self.path.display()))
    }

    fn warn(&mut self, what: impl Into<String>) {
        self.info.warnings.push(what.into());
    }

    /// Adds a material, its reflectance clamped and counted, and limited to what does not pass through.
    fn add_material(&mut self, mut material: Material) -> Result<u32> {
        let limit = if material.albedo_texture == NONE { MAX_ALBEDO } else { 1.0 };
        let clamped = material.albedo.map(|a| a.clamp(0.0, limit));
        self.info.albedos_clamped += (clamped != material.albedo) as u32;
        material.transmission = material.transmission.map(|t| t.clamp(0.0, 1.0));
        material.albedo = std::array::from_fn(|c| clamped[c].min(1.0 - material.transmission[c]));
        self.scene.add_material(material).map_err(|e| self.rename(e))
    }

    /// The image of some materials, or a warning that it cannot be read; `name`: the image's.
    fn image(&mut self, name: impl Display, image: std::result::Result<Texture, String>) -> Option<Texture> {
        if let Err(what) = &image {
            self.warn(format!("the image {name} cannot be read ({what}); its materials do without"));
        }
        image.ok()
    }

    fn add_texture(&mut self, texture: Texture) -> Result<u32> {
        self.scene.add_texture(texture).map_err(|e| self.rename(e))
    }

    fn add_mesh(&mut self, mesh: Mesh) -> Result<()> {
        self.scene.add_mesh(mesh).map(|_| ()).map_err(|e| self.rename(e))
    }

    /// What the scene refuses is the file's fault.
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

    /// Hands all that was read to the caller's scene.
    fn finish(self, data: &mut SceneData) -> Result<LoadInfo> {
        let Import { mut info, scene, .. } = self;
        info.meshes = scene.meshes().len() as u32;
        info.triangles = scene.triangle_count() as u64;
        info.vertices = scene.meshes().iter().map(|m| m.positions.len() as u64).sum();
        info.materials = scene.materials().len() as u32;
        info.textures = scene.textures().len() as u32;
        info.lights = scene.lights().len() as u32;
        info.has_lightmap_uvs = scene.meshes().iter().any(|m| m.lightmap.is_some());
        data.append(scene)?;
        Ok(info)
    }
}

/// Whether a vertex is finite and in the valid range.
fn is_valid_position(p: Vec3) -> bool {
    p.abs().max_element() <= MAX_COORDINATE && !p.is_nan()
}
