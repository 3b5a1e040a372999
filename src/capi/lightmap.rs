//! Light maps
//!
//! A light map lays the surfaces of a committed scene out on square pages and, once baked, holds
//! irradiance E (W/m2) per texel: a shader shows albedo / pi * E. Texel (0, 0) is at uv (0, 0);
//! rows follow v.
//!
//! One thread at a time may bake a light map; reads are safe from any threads. A read during a bake,
//! or a second bake, fails with BK_ERROR_INVALID_STATE.

use super::args::{OutStruct, SizedStruct, init, read_bool, read_struct, sized_struct, slice_mut, write};
use super::device::{bk_progress_fn, progress, refuse_in_callback};
use super::error::{bk_result, call, call_or};
use super::handles::{create, hold, object, release, retain};
use super::scene::bk_scene;
use crate::error::{Error, Result};
use crate::lightmap::{Lightmap, LightmapDesc, LightmapInfo, MeshUvs};
use std::ffi::c_void;
use std::sync::{Arc, RwLock, TryLockError};

/// A light map: a layout and, once baked, light.
pub struct bk_lightmap {
    /// Only ever tried, never waited for.
    lightmap: RwLock<Lightmap>,
}

impl bk_lightmap {
    pub(super) fn read<R>(&self, f: impl FnOnce(&Lightmap) -> Result<R>) -> Result<R> {
        match self.lightmap.try_read() {
            Ok(lightmap) => f(&lightmap),
            Err(TryLockError::WouldBlock) => Err(Error::InvalidState("the light map is being baked".into())),
            Err(TryLockError::Poisoned(_)) => Err(unusable()),
        }
    }

    pub(super) fn change<R>(&self, f: impl FnOnce(&mut Lightmap) -> Result<R>) -> Result<R> {
        match self.lightmap.try_write() {
            Ok(mut lightmap) => {
                lightmap.scene().device().check_process()?;
                f(&mut lightmap)
            }
            Err(TryLockError::WouldBlock) => {
                Err(Error::InvalidState("another call is using the light map at the same time".into()))
            }
            Err(TryLockError::Poisoned(_)) => Err(unusable()),
        }
    }
}

fn unusable() -> Error {
    Error::InvalidState("an internal error has left the light map unusable".into())
}

/// How to lay out a light map.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_lightmap_desc {
    /// Size of this structure in bytes, set by bk_lightmap_desc_init.
    pub struct_size: u32,
    /// Texels per scene unit of what is unwrapped, finite and >= 0; 0, the default: so that the scene
    /// fills about one page. All pages of a map together hold at most 2^29 texels.
    pub texels_per_unit: f32,
    /// Width and height of a page in texels, 16 to 16384. Default: 1024.
    pub page_size: u32,
    /// Texels around each chart that filtering may read, 1 to 64, at most a quarter of page_size.
    /// Default: 2.
    pub padding: u32,
    /// Light map texels per texel of the gather map (indirect light), along each axis, 1 to 64.
    /// Default: 4.
    pub gather_divisor: u32,
    /// Light map texels per texel of the radiance map (what gather rays see), along each axis, 1 to 64.
    /// Default: 4.
    pub radiance_divisor: u32,
    /// Whether two-sided charts of which both sides are seen from open places get a second place for their
    /// backs, which bk_lightmap_mesh_back_uvs tells of. Open places have free space around them; those
    /// outside of buildings count where a sun or a sky shines as the light map is created. Without a second
    /// place, a chart shows the side that is seen, or the one that the bake chooses. 0: no, any other value:
    /// yes. Default: 1.
    pub both_sides: u32,
}

sized_struct!(bk_lightmap_desc, defaults: {
    let d = LightmapDesc::default();
    bk_lightmap_desc {
        struct_size: size_of::<bk_lightmap_desc>() as u32,
        texels_per_unit: d.texels_per_unit,
        page_size: d.page_size,
        padding: d.padding,
        gather_divisor: d.gather_divisor,
        radiance_divisor: d.radiance_divisor,
        both_sides: d.both_sides as u32,
    }
});

/// Fills in the defaults.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_lightmap_desc_init(desc: *mut bk_lightmap_desc) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(desc) }
}

/// Lays out a light map of a committed scene: meshes with light map coordinates keep them, the
/// others are unwrapped, texels are mapped to triangles. Runs on the device's threads.
///
/// scene: kept alive by the light map. desc: NULL for the defaults. progress, user: told how far it
/// is; NULL if not wanted. out: receives the light map, NULL on failure.
///
/// Logs a warning if the scene lies so far from the origin that rays start more than a quarter of a
/// texel above surfaces: 32 rounding steps of its coordinates.
///
/// Fails with BK_ERROR_INVALID_ARGUMENT if a field of desc is out of its range or a mesh names a page
/// beyond 2^29 texels, BK_ERROR_INVALID_STATE if the scene is not committed, BK_ERROR_OUT_OF_MEMORY
/// if there would be more than 2^29 texels, they do not fit, or the memory callback refuses,
/// BK_ERROR_CANCELLED if progress says so.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_lightmap_create(
    scene: *const bk_scene,
    desc: *const bk_lightmap_desc,
    progress: bk_progress_fn,
    user: *mut c_void,
    out: *mut *mut bk_lightmap,
) -> bk_result {
    // SAFETY: desc and out are the caller's, or NULL.
    call(|| unsafe {
        write(out, std::ptr::null_mut(), "out")?;
        refuse_in_callback()?;
        // Its geometry as of now: it may be refitted meanwhile.
        let scene = Arc::clone(&*hold(scene, "scene")?.committed()?);
        scene.device().check_process()?;
        let d: bk_lightmap_desc = if desc.is_null() { SizedStruct::defaults() } else { read_struct(desc, "desc")? };
        let desc = LightmapDesc {
            texels_per_unit: d.texels_per_unit,
            page_size: d.page_size,
            padding: d.padding,
            gather_divisor: d.gather_divisor,
            radiance_divisor: d.radiance_divisor,
            both_sides: read_bool(d.both_sides, "both_sides")?,
        };
        let lightmap = Lightmap::create(&scene, &desc, &self::progress(progress, user))?;
        write(out, create(bk_lightmap { lightmap: RwLock::new(lightmap) }), "out")
    })
}

/// Counts one more reference. NULL is ignored.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_lightmap_retain(lightmap: *mut bk_lightmap) {
    // SAFETY: a handle or NULL.
    unsafe { retain(lightmap) }
}

/// Gives one reference back. NULL is ignored.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_lightmap_release(lightmap: *mut bk_lightmap) {
    // SAFETY: a handle whose reference the caller gives up, or NULL.
    call_or((), || unsafe {
        release(lightmap);
        Ok(())
    })
}

/// Numbers about a light map's layout.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_lightmap_info {
    /// Size of this structure in bytes, set by bk_lightmap_info_init.
    pub struct_size: u32,
    /// Number of pages.
    pub page_count: u32,
    /// Width of each page in texels.
    pub width: u32,
    /// Height of each page in texels.
    pub height: u32,
    /// Charts: pieces of surface that are flat in the light map.
    pub charts: u32,
    /// Of those, taken from the caller's coordinates.
    pub given_charts: u32,
    /// Of those, made by unwrapping.
    pub unwrapped_charts: u32,
    /// Of those, reduced in density to fit a page.
    pub reduced_charts: u32,
    /// Of charts, those with a second place for their backs; see both_sides of bk_lightmap_desc.
    pub both_sided_charts: u32,
    /// Texels per scene unit in use.
    pub texels_per_unit: f32,
    /// Texels that a triangle covers: the range of texel_begin and texel_end of a bake.
    pub texels: u64,
    /// Texels of the gather map.
    pub gather_texels: u64,
    /// Texels of the radiance map.
    pub radiance_texels: u64,
    /// Bytes held.
    pub bytes: u64,
    /// Triangles whose given coordinates lie outside [0, 1]; they were unwrapped.
    pub uv_out_of_range: u64,
    /// Triangles with an area in space whose given coordinates have none; they were unwrapped.
    pub uv_degenerate: u64,
    /// Texels whose centre is covered by several triangles of given coordinates.
    pub uv_overlapping_texels: u64,
    /// Time of unwrapping, in seconds.
    pub unwrap_seconds: f64,
    /// Of texels, those of the second places: the last so many.
    pub back_texels: u64,
}

sized_struct!(bk_lightmap_info, defaults: info(&Default::default()));

fn info(i: &LightmapInfo) -> bk_lightmap_info {
    bk_lightmap_info {
        struct_size: size_of::<bk_lightmap_info>() as u32,
        page_count: i.page_count,
        width: i.width,
        height: i.height,
        charts: i.charts,
        given_charts: i.uvs.given_charts,
        unwrapped_charts: i.uvs.unwrapped_charts,
        reduced_charts: i.uvs.reduced_charts,
        both_sided_charts: i.both_sided_charts,
        texels_per_unit: i.texels_per_unit,
        texels: i.texels,
        gather_texels: i.gather_texels,
        radiance_texels: i.radiance_texels,
        bytes: i.bytes,
        uv_out_of_range: i.uvs.out_of_range,
        uv_degenerate: i.uvs.degenerate,
        uv_overlapping_texels: i.uvs.overlapping_texels,
        unwrap_seconds: i.unwrap_seconds,
        back_texels: i.back_texels,
    }
}

/// Sets struct_size and clears the rest.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_lightmap_info_init(info: *mut bk_lightmap_info) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(info) }
}

/// Numbers about the layout.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_lightmap_get_info(lightmap: *const bk_lightmap, out: *mut bk_lightmap_info) -> bk_result {
    call(|| {
        let lightmap = object!(lightmap);
        // SAFETY: out is the caller's, or NULL.
        let out = unsafe { OutStruct::new(out, "out") }?;
        out.write(info(&lightmap.read(|l| Ok(l.info()))?));
        Ok(())
    })
}

/// Where the triangles of a mesh lie in the light map.
///
/// out_corner_uvs: receives u and v in [0, 1] of each corner, 3 * triangles * 2 floats, aligned to 4
/// bytes; NULL if not wanted. out_page_per_triangle: receives triangles page numbers, BK_NONE for
/// triangles without texels; NULL if not wanted.
///
/// Fails with BK_ERROR_INVALID_ARGUMENT if there is no such mesh, with BK_ERROR_INVALID_STATE while
/// the light map is being baked.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_lightmap_mesh_uvs(
    lightmap: *const bk_lightmap,
    mesh: u32,
    out_corner_uvs: *mut f32,
    out_page_per_triangle: *mut u32,
) -> bk_result {
    // SAFETY: the arrays are the caller's, or NULL.
    call(|| unsafe {
        let uvs = object!(lightmap).read(|l| l.mesh_uvs(mesh))?;
        copy_uvs(&uvs, out_corner_uvs, out_page_per_triangle)
    })
}

/// Where the backs of the triangles of a mesh lie in the light map. A shader that reads
/// gl_FrontFacing ? uv : back_uv, and the page accordingly, shows the right light on both sides.
///
/// out_corner_uvs, out_page_per_triangle: as of bk_lightmap_mesh_uvs; of triangles whose back has no
/// place of its own, the same as there. out_own_place_per_triangle: receives triangles bytes, 1 where
/// the back has a place of its own (see both_sides of bk_lightmap_desc), else 0; NULL if not wanted.
///
/// Fails as bk_lightmap_mesh_uvs does.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_lightmap_mesh_back_uvs(
    lightmap: *const bk_lightmap,
    mesh: u32,
    out_corner_uvs: *mut f32,
    out_page_per_triangle: *mut u32,
    out_own_place_per_triangle: *mut u8,
) -> bk_result {
    // SAFETY: the arrays are the caller's, or NULL.
    call(|| unsafe {
        let (uvs, own) = object!(lightmap).read(|l| l.mesh_back_uvs(mesh))?;
        copy_uvs(&uvs, out_corner_uvs, out_page_per_triangle)?;
        if !out_own_place_per_triangle.is_null() {
            let out = slice_mut(out_own_place_per_triangle, own.len(), "out_own_place_per_triangle", &[])?;
            out.iter_mut().zip(own).for_each(|(out, own)| *out = own.into());
        }
        Ok(())
    })
}

/// Copies corner UVs and pages where they are wanted.
///
/// # Safety
/// Each array is NULL or valid for writing as many elements.
unsafe fn copy_uvs((uvs, pages): &MeshUvs, out_corner_uvs: *mut f32, out_pages: *mut u32) -> Result<()> {
    // SAFETY: by contract.
    unsafe {
        if !out_corner_uvs.is_null() {
            slice_mut(out_corner_uvs.cast(), uvs.len(), "out_corner_uvs", &[])?.copy_from_slice(uvs);
        }
        if !out_pages.is_null() {
            slice_mut(out_pages, pages.len(), "out_page_per_triangle", &[])?.copy_from_slice(pages);
        }
    }
    Ok(())
}
