//! Photon maps
//!
//! A photon map stores light on surfaces: photons are emitted by the lights in proportion to their
//! power, traced with Russian roulette, and stored where they hit diffuse surfaces. The irradiance
//! at any point is estimated from them. A photon map is complete when it has been created, and
//! never changes.
//!
//! Thread safety: any thread, all functions at the same time.
//!
//! Cost: see bk_photon_map_create and bk_photon_map_estimate; the other functions take nanoseconds.

use super::args::{OutStruct, SizedStruct, check_flags, init, read_struct, sized_struct, slice, slice_mut, write};
use super::device::{bk_progress_fn, progress, refuse_in_callback};
use super::error::{bk_result, call, call_or};
use super::handles::{borrowed, create, hold, object, release, retain};
use super::scene::bk_scene;
use crate::photon::{PhotonMap, PhotonParams};
use bytemuck::cast_slice;
use std::ffi::c_void;
use std::sync::Arc;

/// Flag of bk_photon_params: do not store photons that come straight from a light, so that the map
/// holds indirect light only.
pub const BK_PHOTONS_INDIRECT_ONLY: u32 = 1;

/// Handle of a photon map.
pub struct bk_photon_map {
    map: PhotonMap,
}

/// Parameters of bk_photon_map_create.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_photon_params {
    /// Size of this structure in bytes, set by bk_photon_params_init.
    pub struct_size: u32,
    /// BK_PHOTONS flags. Default: 0.
    pub flags: u32,
    /// Number of photons to emit, 1 to 2^32. Each is stored on 1 / (1 - albedo) surfaces on
    /// average; a stored photon takes 96 bytes while the map is made and 48 later. Default:
    /// 1,000,000.
    pub photon_count: u64,
    /// Maximum number of surfaces that a photon hits; 0: Russian roulette alone ends its path. A
    /// path ends after 10,000 surfaces in any case. Default: 0.
    pub max_bounces: u32,
    /// Search radius of the estimate in scene units, finite and at least 1.2e-38; 0: from the
    /// density of photons. Default: 0.
    pub radius: f32,
    /// Half the height of the search cylinder, as a fraction of the radius, finite and > 0.
    /// Default: 0.25.
    pub half_height: f32,
    /// Constant of Jensen's cone filter, a ratio >= 1; +infinity: no filter. Default: 1.1.
    pub cone_k: f32,
    /// Seed of all random numbers. The same seed gives the same bits on any number of threads.
    /// Default: 0.
    pub seed: u64,
    /// Limit in bytes of the memory that the map takes while it is made; 0: no limit. Default: 0.
    pub memory_budget: u64,
}

sized_struct!(bk_photon_params, defaults: {
    let p = PhotonParams::default();
    bk_photon_params {
        struct_size: size_of::<bk_photon_params>() as u32,
        flags: if p.store_direct { 0 } else { BK_PHOTONS_INDIRECT_ONLY },
        photon_count: p.photon_count,
        max_bounces: p.max_bounces,
        radius: p.radius,
        half_height: p.half_height,
        cone_k: p.cone_k,
        seed: p.seed,
        memory_budget: p.memory_budget,
    }
});

/// Sets `struct_size` and fills in the defaults.
///
/// @param params  structure to fill in; NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_photon_params_init(params: *mut bk_photon_params) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(params) }
}

/// Creates a photon map: traces photons through a committed scene, on the device's threads.
///
/// The map keeps the parts of the scene alive that it needs. Lights without power make an empty
/// map.
///
/// Cost: 3 to 7 million rays per second on two threads; a photon takes 1 / (1 - albedo) rays on
/// average.
///
/// @param scene  committed scene
/// @param params  parameters; NULL for the defaults
/// @param progress,user  progress callback and its pointer; may be NULL
/// @param out  receives the photon map, which the caller releases with bk_photon_map_release; NULL
///   on failure
/// @retval BK_ERROR_INVALID_ARGUMENT  a field of `params` is out of its range
/// @retval BK_ERROR_INVALID_STATE  the scene is not committed, is being refitted, or has no lights
/// @retval BK_ERROR_OUT_OF_MEMORY  the map does not fit into `memory_budget` or the memory callback
///   refuses
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_photon_map_create(
    scene: *const bk_scene,
    params: *const bk_photon_params,
    progress: bk_progress_fn,
    user: *mut c_void,
    out: *mut *mut bk_photon_map,
) -> bk_result {
    // SAFETY: params and out are the caller's, or NULL.
    call(|| unsafe {
        write(out, std::ptr::null_mut(), "out")?;
        refuse_in_callback()?;
        // Its geometry as of now: it may be refitted meanwhile.
        let scene = Arc::clone(&*hold(scene, "scene")?.committed()?);
        scene.device().check_process()?;
        let params = if params.is_null() { SizedStruct::defaults() } else { read_struct(params, "params")? };
        let params = core_params(&params)?;
        let map = PhotonMap::trace(&scene, &params, &self::progress(progress, user))?;
        write(out, create(bk_photon_map { map }), "out")
    })
}

/// Adds one reference.
///
/// @param map  NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_photon_map_retain(map: *mut bk_photon_map) {
    // SAFETY: a handle or NULL.
    unsafe { retain(map) }
}

/// Releases one reference.
///
/// @param map  NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_photon_map_release(map: *mut bk_photon_map) {
    // SAFETY: a handle whose reference the caller gives up, or NULL.
    call_or((), || unsafe {
        release(map);
        Ok(())
    })
}

/// Estimates the irradiance at points of surfaces, on the side that the normal points to.
///
/// The estimate assumes that the search disc lies wholly on the surface: nearer than a radius to an
/// edge it falls, to half at the edge, and photons behind a wall that crosses the disc count.
/// Positions and normals that are not finite give 0.
///
/// Cost: in proportion to the number of photons within the search radius, on the calling thread.
///
/// @param map  photon map
/// @param positions  `count` positions of three floats in scene units, packed, aligned to 4 bytes
/// @param normals  `count` unit vectors of three floats, packed, aligned to 4 bytes
/// @param count  number of points; if 0, the arrays may be NULL
/// @param out_irradiance_rgb  receives `count` times three floats in W/m2, packed, finite, 0 to
///   1e30; must not overlap the inputs
/// @retval BK_ERROR_INVALID_ARGUMENT  an array is NULL, not aligned, or overlaps the output
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_photon_map_estimate(
    map: *const bk_photon_map,
    positions: *const f32,
    normals: *const f32,
    count: usize,
    out_irradiance_rgb: *mut f32,
) -> bk_result {
    // SAFETY: the arrays are the caller's, or NULL.
    call(|| unsafe {
        let map = borrowed!(map);
        let positions: &[[f32; 3]] = slice(positions.cast(), count, "positions")?;
        let normals: &[[f32; 3]] = slice(normals.cast(), count, "normals")?;
        let inputs = [(cast_slice(positions), "positions"), (cast_slice(normals), "normals")];
        let out = slice_mut(out_irradiance_rgb.cast(), count, "out_irradiance_rgb", &inputs)?;
        map.map.estimate_block(positions, normals, out);
        Ok(())
    })
}

/// Pointers to the stored photons, array by array.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_photon_view {
    /// Size of this structure in bytes, set by bk_photon_view_init.
    pub struct_size: u32,
    /// Search radius in use, in scene units.
    pub radius: f32,
    /// Number of stored photons.
    pub count: usize,
    /// `count` positions of three floats, packed, in scene units.
    pub position: *const f32,
    /// `count` directions of travel of three floats, packed, unit vectors.
    pub direction: *const f32,
    /// `count` powers of three floats (RGB), packed, in W.
    pub power: *const f32,
}

sized_struct!(bk_photon_view, defaults: bk_photon_view {
    struct_size: size_of::<bk_photon_view>() as u32,
    radius: 0.0,
    count: 0,
    position: std::ptr::null(),
    direction: std::ptr::null(),
    power: std::ptr::null(),
});

/// Sets `struct_size` and clears the other fields.
///
/// @param view  structure to fill in; NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_photon_view_init(view: *mut bk_photon_view) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(view) }
}

/// Gets pointers to the stored photons.
///
/// Cost: the first call packs them into 36 bytes of memory each, which stay while the map lives.
///
/// @param map  photon map
/// @param out  receives pointers that are valid while the map lives; if `count` is 0, they must not
///   be read
/// @retval BK_ERROR_OUT_OF_MEMORY  the memory callback refuses the packed copy
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_photon_map_get_photons(map: *const bk_photon_map, out: *mut bk_photon_view) -> bk_result {
    call(|| {
        let map = object!(map);
        let map = &map.map;
        let photons = map.photons()?;
        // SAFETY: out is the caller's, or NULL.
        unsafe { OutStruct::new(out, "out") }?.write(bk_photon_view {
            struct_size: 0,
            radius: map.radius(),
            count: photons.position.len(),
            position: photons.position.as_ptr().cast(),
            direction: photons.direction.as_ptr().cast(),
            power: photons.power.as_ptr().cast(),
        });
        Ok(())
    })
}

fn core_params(p: &bk_photon_params) -> crate::base::error::Result<PhotonParams> {
    check_flags(p.flags, BK_PHOTONS_INDIRECT_ONLY, "flags")?;
    Ok(PhotonParams {
        photon_count: p.photon_count,
        max_bounces: p.max_bounces,
        radius: p.radius,
        half_height: p.half_height,
        cone_k: p.cone_k,
        seed: p.seed,
        memory_budget: p.memory_budget,
        store_direct: p.flags & BK_PHOTONS_INDIRECT_ONLY == 0,
        ..PhotonParams::default()
    })
}
