//! Scene files
//!
//! Scenes come from files of other programs (OBJ, PLY, glTF), which are added to a description, and
//! from files that bk_scene_save has written: those hold a committed scene with its acceleration
//! structure, and are opened instead of described and committed.
//!
//! Thread safety: as for scenes.
//!
//! Cost: functions that are not described otherwise take less than a microsecond.

use super::args::{OutStruct, SizedStruct, check_flags, init, read_bool, read_struct, sized_struct, text};
use super::device::{bk_progress_fn, progress, refuse_in_callback};
use super::error::{bk_result, call};
use super::handles::hold;
use super::scene::bk_scene;
#[cfg(not(feature = "io"))]
use crate::base::error::Error;
use crate::base::error::Result;
use crate::base::progress::Progress;
use crate::device::Device;
use crate::scene::{OpenOptions, Scene, SceneData, builtin};
use std::ffi::{c_char, c_void};

/// Numbers about a file that was loaded.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_load_info {
    /// Size of this structure in bytes, set by bk_load_info_init.
    pub struct_size: u32,
    /// Number of meshes added.
    pub meshes: u32,
    /// Number of the first mesh added; the others follow it.
    pub first_mesh: u32,
    /// Number of materials added.
    pub materials: u32,
    /// Number of the first material added; the others follow it.
    pub first_material: u32,
    /// Number of lights added, emissive materials not counted.
    pub lights: u32,
    /// Number of the first light added; the others follow it.
    pub first_light: u32,
    /// Number of materials with a reflectance outside [0, 0.98], which was clamped to that range.
    pub clamped_albedos: u32,
    /// Number of triangles added, those of every instance counted and degenerate ones included.
    pub triangles: u64,
    /// Duration of the call in seconds.
    pub seconds: f64,
    /// Number of textures added. An image that cannot be read is left out, with a warning in the
    /// log.
    pub textures: u32,
    /// Number of the first texture added; the others follow it.
    pub first_texture: u32,
    /// Number of instances added, of meshes of at least 1,000 triangles that stand in several
    /// places.
    pub instances: u32,
    /// Number of the first instance added; the others follow it.
    pub first_instance: u32,
}

sized_struct!(bk_load_info, defaults: bk_load_info {
    struct_size: size_of::<bk_load_info>() as u32,
    meshes: 0,
    first_mesh: 0,
    materials: 0,
    first_material: 0,
    lights: 0,
    first_light: 0,
    clamped_albedos: 0,
    triangles: 0,
    seconds: 0.0,
    textures: 0,
    first_texture: 0,
    instances: 0,
    first_instance: 0,
});

/// Sets `struct_size` and clears the other fields.
///
/// @param info  structure to fill in; NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_load_info_init(info: *mut bk_load_info) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(info) }
}

/// Flag of bk_load_params: files that the scene file names may lie in any folder. Use it for scenes
/// of trusted authors only: such a scene can find out which files exist, and can show their texels
/// in its light.
pub const BK_LOAD_ANY_FOLDER: u32 = 1;

/// Limits of bk_scene_load_file: which files it may read, and how much of them.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_load_params {
    /// Size of this structure in bytes, set by bk_load_params_init.
    pub struct_size: u32,
    /// BK_LOAD_ANY_FOLDER or 0. Default: 0.
    pub flags: u32,
    /// Folder in or below which all files must lie that the scene file names (material libraries,
    /// images, buffers), symbolic links resolved. UTF-8; NULL: the folder of the scene file.
    /// Default: NULL.
    pub base_folder: *const c_char,
    /// Limit in bytes for all decoded images together, 4 per texel, checked before an image is
    /// decoded. (Decoding takes up to 8 more bytes per texel of the image.) Default: 2 GiB.
    pub max_texture_bytes: u64,
    /// Limit in bytes for all files together, the scene file included. Default: 16 GiB.
    pub max_file_bytes: u64,
}

#[cfg(feature = "io")]
fn default_limits() -> [u64; 2] {
    let options = crate::io::LoadOptions::default();
    [options.max_texture_bytes, options.max_file_bytes]
}

#[cfg(not(feature = "io"))]
fn default_limits() -> [u64; 2] {
    [0; 2]
}

sized_struct!(bk_load_params, defaults: {
    let [max_texture_bytes, max_file_bytes] = default_limits();
    bk_load_params {
        struct_size: size_of::<bk_load_params>() as u32,
        flags: 0,
        base_folder: std::ptr::null(),
        max_texture_bytes,
        max_file_bytes,
    }
});

/// Sets `struct_size` and fills in the defaults.
///
/// @param params  structure to fill in; NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_load_params_init(params: *mut bk_load_params) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(params) }
}

/// Loads a scene file and adds its meshes, materials with their textures (PNG and JPEG), and
/// lights.
///
/// Only regular files are read, never devices, FIFOs or sockets. A material library or an image
/// that cannot be read, or that lies where `params` allows none, is left out with a warning in the
/// log; a buffer of a glTF file that cannot be read is an error. bk_scene_get_mesh,
/// bk_scene_get_material, bk_scene_get_texture and bk_scene_get_light read the loaded objects back.
///
/// Files from untrusted sources are safe to load, within the limits of `params`: malformed content
/// gives an error, or is left out with a warning.
///
/// Cost: 0.2 (PLY) to 2 s (OBJ) per million triangles, on one thread, and the decoding of images.
///
/// @param scene  scene that is not committed
/// @param path  name of a file that ends in .obj (with its .mtl), .ply, .gltf or .glb; UTF-8
/// @param params  limits; NULL for the defaults
/// @param progress,user  progress callback and its pointer; may be NULL
/// @param out  receives the numbers of the objects added; may be NULL
/// @retval BK_ERROR_IO  a file cannot be read or is malformed, and bk_last_error names it; or there
///   is no room in bk_device_desc.scratch_folder
/// @retval BK_ERROR_UNSUPPORTED  the kind of file is unknown, the file requires an extension of
///   glTF that is not supported, or the library was built without files
/// @retval BK_ERROR_OUT_OF_MEMORY  a limit of `params` is exceeded, the memory callback refuses, or
///   memory runs out
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
/// @retval BK_ERROR_INVALID_STATE  the scene is committed or another thread is changing it
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_load_file(
    scene: *mut bk_scene,
    path: *const c_char,
    params: *const bk_load_params,
    progress: bk_progress_fn,
    user: *mut c_void,
    out: *mut bk_load_info,
) -> bk_result {
    // SAFETY: path, params and out are the caller's, or NULL.
    call(|| unsafe {
        refuse_in_callback()?;
        let scene = hold(scene, "scene")?;
        let path = text(path, "path")?;
        let params = if params.is_null() { bk_load_params::defaults() } else { read_struct(params, "params")? };
        check_flags(params.flags, BK_LOAD_ANY_FOLDER, "flags")?;
        scene.device.check_process()?;
        let base = if params.base_folder.is_null() { None } else { Some(text(params.base_folder, "base_folder")?) };
        let out = OutStruct::optional(out, "out")?;
        let progress = self::progress(progress, user);
        let info = scene.describe("files can be loaded", |d| {
            let mut loaded = SceneData::new();
            let info = load_file(&scene.device, &mut loaded, path, &params, base, &progress)?;
            let first = [
                d.data.meshes().len(),
                d.data.materials().len(),
                d.data.lights().len(),
                d.data.textures().len(),
                d.data.instances().len(),
            ];
            d.append(loaded, &scene.device)?;
            let [first_mesh, first_material, first_light, first_texture, first_instance] = first.map(|n| n as u32);
            Ok(bk_load_info { first_mesh, first_material, first_light, first_texture, first_instance, ..info })
        })?;
        if let Some(out) = out {
            out.write(info);
        }
        Ok(())
    })
}

#[cfg(feature = "io")]
fn load_file(
    device: &Device,
    data: &mut SceneData,
    path: &str,
    params: &bk_load_params,
    base_folder: Option<&str>,
    progress: &Progress,
) -> Result<bk_load_info> {
    let options = crate::io::LoadOptions {
        base_folder: base_folder.map(Into::into),
        any_folder: params.flags & BK_LOAD_ANY_FOLDER != 0,
        max_file_bytes: params.max_file_bytes,
        max_texture_bytes: params.max_texture_bytes,
        memory: device.memory().clone(),
    };
    let (first_mesh, first_material) = (data.meshes().len() as u32, data.materials().len() as u32);
    let (first_light, first_texture) = (data.lights().len() as u32, data.textures().len() as u32);
    // The thread that called makes the reports meanwhile.
    let i = device.run(progress, || crate::io::load_with(path.as_ref(), &options, progress, data))?;
    for warning in &i.warnings {
        device.log(crate::device::LogLevel::Warning, warning);
    }
    Ok(bk_load_info {
        meshes: i.meshes,
        first_mesh,
        materials: i.materials,
        first_material,
        lights: i.lights,
        first_light,
        clamped_albedos: i.albedos_clamped,
        triangles: i.triangles,
        seconds: i.seconds,
        textures: i.textures,
        first_texture,
        instances: i.instances,
        first_instance: 0,
        struct_size: 0,
    })
}

#[cfg(not(feature = "io"))]
fn load_file(
    _: &Device,
    _: &mut SceneData,
    path: &str,
    _: &bk_load_params,
    _: Option<&str>,
    _: &Progress,
) -> Result<bk_load_info> {
    Err(Error::Unsupported(format!("the library was built without files and cannot read {path}")))
}

/// Adds a built-in scene with its lights.
///
/// Cost: less than 0.1 s.
///
/// @param scene  scene that is not committed
/// @param name  "cornell" (the Cornell box), "furnace" (a closed, glowing cube) or "atrium" (a
///   two-floor court in the sun)
/// @retval BK_ERROR_INVALID_ARGUMENT  there is no such scene
/// @retval BK_ERROR_INVALID_STATE  the scene is committed or another thread is changing it
/// @retval BK_ERROR_OUT_OF_MEMORY  the memory callback refuses
/// @retval BK_ERROR_IO  there is no room in bk_device_desc.scratch_folder
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_load_builtin(scene: *mut bk_scene, name: *const c_char) -> bk_result {
    call(|| {
        // SAFETY: a handle or NULL. The memory callback may release it.
        let scene = unsafe { hold(scene, "scene") }?;
        // SAFETY: name is the caller's, or NULL.
        let name = unsafe { text(name, "name") }?;
        scene.describe("scenes can be loaded", |d| d.append(builtin(name)?, &scene.device))
    })
}

/// Writes a committed scene to a file, which is replaced as a whole, for bk_scene_open: meshes,
/// instances, materials, textures, environments, lights as they are now, and the acceleration
/// structure with the refits that were made. If the call fails, the old file is as it was.
///
/// The format is described in the manual (docs/scene_file.md). Files are for machines of the same
/// order of bytes, and for this version of the format.
///
/// Cost: 60 to 110 bytes per triangle to write, half of that for a compact structure, with textures.
///
/// @param scene  committed scene
/// @param path  name of the file; UTF-8
/// @param progress,user  progress callback and its pointer; may be NULL
/// @retval BK_ERROR_IO  the file cannot be written
/// @retval BK_ERROR_INVALID_STATE  the scene is not committed or is being refitted
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_save(
    scene: *mut bk_scene,
    path: *const c_char,
    progress: bk_progress_fn,
    user: *mut c_void,
) -> bk_result {
    // SAFETY: path is the caller's, or NULL.
    call(|| unsafe {
        refuse_in_callback()?;
        let scene = hold(scene, "scene")?;
        let path = text(path, "path")?;
        scene.device.check_process()?;
        scene.committed()?.save(path.as_ref(), &self::progress(progress, user))
    })
}

/// How bk_scene_open opens a file.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_open_params {
    /// Size of this structure in bytes, set by bk_open_params_init.
    pub struct_size: u32,
    /// 1: the file is mapped and takes the place of memory. Parts are read when they are needed, and
    /// the system drops them when it needs the memory, so that a scene may be larger than it. Pages
    /// that a refit changes stay in memory. While the scene lives, the file must not be changed in
    /// place or cut short: that would be as if somebody wrote to the process's memory. (bk_scene_save
    /// under its name is fine: it makes a new file.) Bakes, light maps, photon maps, saves and refits
    /// notice it and fail with BK_ERROR_IO, and checkpoints hold nothing that was computed since; but
    /// reading a part that was cut off ends the process (SIGBUS). 0: the file is read to memory; rays are
    /// somewhat faster, because memory can have large pages. Default: 1.
    pub map: u32,
    /// 1: rays wait at parts of the tree until enough of them do, for scenes that are larger than
    /// memory: a part is then read for many rays at once. The scene has threads of its own for that,
    /// 128 per thread of the device but no more than 512 that bring rays, and no more than 64 that
    /// trace them. Hits and light stay the same, bit for bit. Scenes that fit into memory take longer
    /// so, and a cancel is noticed when the rays that wait have been traced. A refit brings all of the
    /// scene to memory, and ends it. Default: 0.
    pub ray_queues: u32,
}

sized_struct!(bk_open_params, defaults: bk_open_params {
    struct_size: size_of::<bk_open_params>() as u32,
    map: OpenOptions::default().map.into(),
    ray_queues: OpenOptions::default().ray_queues.into(),
});

/// Sets `struct_size` and fills in the defaults.
///
/// @param params  structure to fill in; NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_open_params_init(params: *mut bk_open_params) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(params) }
}

/// Loads a scene that bk_scene_save has written. It is committed then, with the hits and the light,
/// bit for bit, of the scene that was saved; numbers of meshes, materials and so on are the same.
/// Nothing is built.
///
/// Files from untrusted sources are safe to open as long as nobody changes them meanwhile: a file
/// that is damaged, or of another version, gives an error.
///
/// Cost: all of the file is read once, to check it: some 0.03 s per million triangles if the
/// system has it in its cache, and 0.2 s to read it to memory. A mapped scene takes no memory but for textures, skies, emissive triangles
/// and instances.
///
/// @param scene  scene to which nothing has been added
/// @param path  name of the file; UTF-8
/// @param params  NULL for the defaults
/// @param progress,user  progress callback and its pointer; may be NULL
/// @retval BK_ERROR_IO  the file cannot be read, is damaged, or is no scene file of this version
/// @retval BK_ERROR_INVALID_STATE  the scene is committed, something has been added to it, or
///   another thread is changing it
/// @retval BK_ERROR_OUT_OF_MEMORY  the memory callback refuses, or memory runs out
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_open(
    scene: *mut bk_scene,
    path: *const c_char,
    params: *const bk_open_params,
    progress: bk_progress_fn,
    user: *mut c_void,
) -> bk_result {
    // SAFETY: path and params are the caller's, or NULL.
    call(|| unsafe {
        refuse_in_callback()?;
        let scene = hold(scene, "scene")?;
        let path = text(path, "path")?;
        let params = if params.is_null() { bk_open_params::defaults() } else { read_struct(params, "params")? };
        let options =
            OpenOptions { map: read_bool(params.map, "map")?, ray_queues: read_bool(params.ray_queues, "ray_queues")? };
        scene.device.check_process()?;
        scene.open(|device| Scene::open(device, path.as_ref(), &options, &self::progress(progress, user)))
    })
}
