//! Textures
//!
//! Images that a scene uses. Added before its commit, and before what names them.
//!
//! Textures colour surfaces and cut holes into them. They are addressed by the first texture coordinates of
//! meshes (bk_mesh_desc.uvs), repeat beyond [0, 1], and are interpolated between the centres of texels.
//!
//! Environments are the images of skies: the whole sphere of directions by longitude and latitude. Row 0 is at
//! the zenith, the last row at the nadir; the middle of a row is the sky's front, and texels follow one another
//! to the right as seen from inside. Each texel is an area of uniform radiance, without interpolation.
//!
//! A scene without images spends neither memory nor time on them.

use super::args::{OutStruct, SizedStruct, init, read_struct, sized_struct, write_optional};
use super::error::{bk_result, call, call_or};
use super::handles::{hold, is_null, object};
use super::scene::bk_scene;
use crate::error::{Result, invalid_argument};
use crate::scene::{Environment, MAX_ENVIRONMENT_SIZE, MAX_TEXTURE_SIZE, SceneData, Texture};
use bytemuck::Pod;
use std::ffi::c_void;
use std::sync::Arc;

/// Format: four bytes per texel, sRGB red, green and blue and linear alpha (255: opaque).
pub const BK_TEXTURE_RGBA8_SRGB: u32 = 0;
/// Format: three floats per texel, linear red, green and blue, finite and >= 0.
pub const BK_TEXTURE_RGB32F: u32 = 1;

/// An image. The texels are copied.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_texture_desc {
    /// Size of this structure in bytes, set by bk_texture_desc_init.
    pub struct_size: u32,
    /// One of BK_TEXTURE. Default: BK_TEXTURE_RGBA8_SRGB.
    pub format: u32,
    /// Texels along u, 1 to 16384.
    pub width: u32,
    /// Texels along v, 1 to 16384.
    pub height: u32,
    /// height rows of width texels. Row 0 lies at v = 0 and the first texel of a row at u = 0, as in glTF.
    pub data: *const c_void,
    /// Bytes from one row to the next, at least those of a row; 0: packed.
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

/// Fills in the defaults.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_texture_desc_init(desc: *mut bk_texture_desc) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(desc) }
}

/// Adds a texture.
///
/// out_id: receives its number, for materials; NULL if not wanted. Numbers count up from 0 in the order of
/// addition.
///
/// Fails with BK_ERROR_INVALID_ARGUMENT if a size or the stride is out of range, the format is unknown or data
/// is NULL, with BK_ERROR_OUT_OF_MEMORY if there is no memory for a copy.
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
        let read = || read_texture(&desc);
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

/// Adds an environment, for lights of type BK_LIGHT_SKY. Its format must be BK_TEXTURE_RGB32F. It takes 16
/// bytes per texel.
///
/// out_id: receives its number; NULL if not wanted. Numbers count up from 0 in the order of addition, apart
/// from those of other images.
///
/// Fails with BK_ERROR_INVALID_ARGUMENT if a size or the stride is out of range, the format is another, data
/// is NULL or a texel is not finite or less than 0; with BK_ERROR_OUT_OF_MEMORY if there is no memory for a
/// copy; with BK_ERROR_INVALID_STATE after the commit.
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
            || read_environment(&desc),
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

/// The number of textures, committed or not; 0 on failure.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_texture_count(scene: *const bk_scene) -> u32 {
    call_or(0, || object!(scene).count(|d| d.textures().len(), |s| s.textures().len()))
}

/// Shows a texture, without a copy.
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

/// The number of environments, committed or not; 0 on failure.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_scene_environment_count(scene: *const bk_scene) -> u32 {
    call_or(0, || object!(scene).count(|d| d.environments().len(), |s| s.environments().len()))
}

/// Shows an environment, without a copy.
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

/// What a copy of an image takes.
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
    let mut out = crate::memory::try_vec::<T>(width * height, what)?;
    for (y, texels) in out.chunks_exact_mut(width).enumerate() {
        // SAFETY: by contract the row is there; as bytes it needs no alignment.
        unsafe {
            std::ptr::copy_nonoverlapping(d.data.cast::<u8>().add(y * stride), texels.as_mut_ptr().cast::<u8>(), row);
        }
    }
    Ok(out)
}
