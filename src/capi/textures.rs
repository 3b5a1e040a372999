//! Textures
//!
//! Textures colour surfaces and cut parts of them out by alpha. Meshes place them by
//! bk_mesh_desc.uvs; they repeat beyond [0, 1] and are interpolated between the centres of texels.
//!
//! Environments are images of the sky: all directions by longitude and latitude. Row 0 is at the
//! zenith, the last row at the nadir; the middle of a row is the sky's front, and texels follow one
//! another to the right as seen from inside. Each texel is an area of uniform radiance, without
//! interpolation.
//!
//! Textures and environments are added to a scene before its commit, and before the materials and
//! lights that name them. A scene without images spends neither memory nor time on them.
//!
//! Thread safety: as for scenes; the functions that read are safe from any thread, but before the
//! commit fail with BK_ERROR_INVALID_STATE while another thread is changing the scene.
//!
//! Cost: adding copies the texels; reading copies nothing and takes less than a microsecond.

use super::args::{OutStruct, SizedStruct, init, read_struct, sized_struct, write_optional};
use super::error::{bk_result, call, call_or};
use super::handles::{hold, is_null, object};
use super::scene::bk_scene;
use crate::base::error::{Result, invalid_argument};
use crate::scene::{Environment, MAX_ENVIRONMENT_SIZE, MAX_TEXTURE_SIZE, SceneData, Texture};
use bytemuck::Pod;
use std::ffi::c_void;
use std::sync::Arc;

/// Format of textures: four bytes per texel, sRGB red, green and blue and linear alpha (255:
/// opaque).
pub const BK_TEXTURE_RGBA8_SRGB: u32 = 0;
/// Format of environments: three floats per texel, linear red, green and blue, finite and >= 0.
pub const BK_TEXTURE_RGB32F: u32 = 1;

/// An image.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_texture_desc {
    /// Size of this structure in bytes, set by bk_texture_desc_init.
    pub struct_size: u32,
    /// One of the BK_TEXTURE values. Default: BK_TEXTURE_RGBA8_SRGB.
    pub format: u32,
    /// Number of texels along u, 1 to 16384. Default: 0, to be set.
    pub width: u32,
    /// Number of texels along v, 1 to 16384. Default: 0, to be set.
    pub height: u32,
    /// `height` rows of `width` texels, without alignment. Row 0 lies at v = 0 and the first texel
    /// of a row at u = 0, as in glTF. Default: NULL, to be set.
    pub data: *const c_void,
    /// Distance between rows in bytes, at least the bytes of a row; 0: packed. Default: 0.
    pub row_stride: usize,
}

sized_struct!(bk_texture_desc, defaults: bk_texture_desc {
    struct_size: size_of::<bk_texture_desc>() as u32,
    format: BK_TEXTURE_RGBA8_SRGB,
    width: 0,
    height: 0,
    data: std::ptr::null(),
    row_stride: 0,
});

/// Sets `struct_size` and fills in the defaults.
///
/// @param desc  structure to fill in; NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_texture_desc_init(desc: *mut bk_texture_desc) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(desc) }
}

/// Adds a texture.
///
/// @param scene  scene that is not committed
/// @param desc  image of format BK_TEXTURE_RGBA8_SRGB; the texels are copied
/// @param out_id  receives the number of the texture, for materials; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  a size or the stride is out of range, the format is another,
///   or `data` is NULL
/// @retval BK_ERROR_INVALID_STATE  the scene is committed or another thread is changing it
/// @retval BK_ERROR_OUT_OF_MEMORY  the copy does not fit or the memory callback refuses
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_add_texture(
    scene: *mut bk_scene,
    desc: *const bk_texture_desc,
    out_id: *mut u32,
) -> bk_result {
    // SAFETY: desc, the texels and out_id are the caller's, or NULL.
    call(|| unsafe {
        // The memory callback may release it.
        let scene = hold(scene, "scene")?;
        let desc = read_struct(desc, "desc")?;
        let read = |_: &mut _| read_texture(&desc);
        let id = scene.describe_large("textures can be added", bytes(&desc, 4), read, SceneData::add_texture)?;
        write_optional(out_id, id)
    })
}

/// # Safety
/// `data` holds what the description says.
unsafe fn read_texture(d: &bk_texture_desc) -> Result<Texture> {
    if d.format != BK_TEXTURE_RGBA8_SRGB {
        return invalid_argument!("format is {}, not one of BK_TEXTURE_*", d.format);
    }
    // SAFETY: forwarded.
    let rgba8 = unsafe { texels(d, MAX_TEXTURE_SIZE, "the texture")? };
    Ok(Texture { width: d.width, height: d.height, rgba8 })
}

/// Adds an environment, for lights of type BK_LIGHT_SKY.
///
/// Cost: 16 bytes of memory per texel, and time in proportion.
///
/// @param scene  scene that is not committed
/// @param desc  image of format BK_TEXTURE_RGB32F; the texels are copied
/// @param out_id  receives the number of the environment, for lights; may be NULL. Environments are
///   numbered apart from textures
/// @retval BK_ERROR_INVALID_ARGUMENT  a size or the stride is out of range, the format is another,
///   `data` is NULL, or a texel is not finite or negative
/// @retval BK_ERROR_INVALID_STATE  the scene is committed or another thread is changing it
/// @retval BK_ERROR_OUT_OF_MEMORY  the copy does not fit or the memory callback refuses
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_add_environment(
    scene: *mut bk_scene,
    desc: *const bk_texture_desc,
    out_id: *mut u32,
) -> bk_result {
    // SAFETY: desc, the texels and out_id are the caller's, or NULL.
    call(|| unsafe {
        // The memory callback may release it.
        let scene = hold(scene, "scene")?;
        let desc = read_struct(desc, "desc")?;
        let id = scene.describe_large(
            "environments can be added",
            bytes(&desc, 16),
            |_| read_environment(&desc),
            |data, environment| Ok(data.add_environment(environment)),
        )?;
        write_optional(out_id, id)
    })
}

/// # Safety
/// `data` holds what the description says.
unsafe fn read_environment(d: &bk_texture_desc) -> Result<Environment> {
    if d.format != BK_TEXTURE_RGB32F {
        return invalid_argument!("format is {}, not BK_TEXTURE_RGB32F, as environments need", d.format);
    }
    // SAFETY: forwarded.
    Environment::new(d.width, d.height, unsafe { texels(d, MAX_ENVIRONMENT_SIZE, "the environment")? })
}

/// Returns the number of textures of a scene, committed or not.
///
/// @param scene  any scene
/// @return  number of textures; 0 on failure
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_texture_count(scene: *const bk_scene) -> u32 {
    call_or(0, || object!(scene).count(|d| d.textures().len(), |s| s.textures().len()))
}

/// Gets a texture of a scene, committed or not, without a copy.
///
/// @param scene  any scene
/// @param id  number of the texture
/// @param out  receives size, format and a pointer to packed texels, which stays valid while the
///   scene lives
/// @retval BK_ERROR_INVALID_ARGUMENT  there is no such texture
/// @retval BK_ERROR_INVALID_STATE  another thread is changing the scene
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_get_texture(scene: *const bk_scene, id: u32, out: *mut bk_texture_desc) -> bk_result {
    call(|| {
        let scene = object!(scene);
        // SAFETY: out is the caller's, or NULL.
        let out = unsafe { OutStruct::new(out, "out") }?;
        let find = |textures: &[Arc<Texture>]| find(textures, id, "texture");
        // The scene keeps its textures in either state, and they never move.
        let texture = scene.either(|d| find(d.textures()), |s| find(s.textures()))?;
        out.write(bk_texture_desc {
            format: BK_TEXTURE_RGBA8_SRGB,
            width: texture.width,
            height: texture.height,
            data: texture.rgba8.as_ptr().cast(),
            ..SizedStruct::defaults()
        });
        Ok(())
    })
}

/// Returns the number of environments of a scene, committed or not.
///
/// @param scene  any scene
/// @return  number of environments; 0 on failure
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_environment_count(scene: *const bk_scene) -> u32 {
    call_or(0, || object!(scene).count(|d| d.environments().len(), |s| s.environments().len()))
}

/// Gets an environment of a scene, committed or not, without a copy.
///
/// @param scene  any scene
/// @param id  number of the environment
/// @param out  receives size, format and a pointer to packed texels, which stays valid while the
///   scene lives
/// @retval BK_ERROR_INVALID_ARGUMENT  there is no such environment
/// @retval BK_ERROR_INVALID_STATE  another thread is changing the scene
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_get_environment(
    scene: *const bk_scene,
    id: u32,
    out: *mut bk_texture_desc,
) -> bk_result {
    call(|| {
        let scene = object!(scene);
        // SAFETY: out is the caller's, or NULL.
        let out = unsafe { OutStruct::new(out, "out") }?;
        let find = |environments: &[Arc<Environment>]| find(environments, id, "environment");
        // As textures, they never move.
        let environment = scene.either(|d| find(d.environments()), |s| find(s.environments()))?;
        let (width, height) = environment.size();
        let data = environment.rgb().as_ptr().cast();
        out.write(bk_texture_desc { format: BK_TEXTURE_RGB32F, width, height, data, ..SizedStruct::defaults() });
        Ok(())
    })
}

fn find<T>(images: &[Arc<T>], id: u32, what: &str) -> Result<Arc<T>> {
    match images.get(id as usize) {
        Some(image) => Ok(image.clone()),
        None => invalid_argument!("{what} {id} does not exist, the scene has {}", images.len()),
    }
}

/// Size of a copy of an image in bytes.
fn bytes(d: &bk_texture_desc, per_texel: usize) -> usize {
    // At most 2^30 texels are taken; more are refused by name where they are read.
    let texels = d.width as usize * d.height as usize;
    if texels > 1 << 30 { 0 } else { texels * per_texel }
}

/// A copy of an image's texels.
///
/// # Safety
/// `data` holds what the description says, in texels of type `T`.
unsafe fn texels<T: Pod + Default>(d: &bk_texture_desc, most: u32, what: &str) -> Result<Vec<T>> {
    // Sizes before the texels: wrong ones must not be read by.
    for (name, size) in [("width", d.width), ("height", d.height)] {
        if !(1..=most).contains(&size) {
            return invalid_argument!("{name} is {size}, outside 1 to {most}");
        }
    }
    let (width, height) = (d.width as usize, d.height as usize);
    let row = size_of::<T>() * width;
    let stride = if d.row_stride == 0 { row } else { d.row_stride };
    if stride < row || stride.checked_mul(height).is_none_or(|bytes| bytes > isize::MAX as usize) {
        return invalid_argument!("row_stride is {stride}, less than the {row} bytes of a row or too large");
    }
    if d.data.is_null() {
        return Err(is_null("data"));
    }
    let mut out = crate::base::memory::try_vec::<T>(width * height, what)?;
    for (y, texels) in out.chunks_exact_mut(width).enumerate() {
        // SAFETY: by contract the row is there; as bytes it needs no alignment.
        unsafe {
            std::ptr::copy_nonoverlapping(d.data.cast::<u8>().add(y * stride), texels.as_mut_ptr().cast::<u8>(), row);
        }
    }
    Ok(out)
}
