//! Photon maps
//!
//! A photon map is light frozen on surfaces: photons emitted by the lights in proportion to their
//! power, traced with Russian roulette, and kept where they meet diffuse surfaces. It gives the
//! irradiance at any point. It is complete when created and never changes; all functions on it are
//! safe from any threads.

use super::args::{OutStruct, SizedStruct, check_flags, init, read_struct, sized_struct, slice, slice_mut, write};
use super::device::{bk_progress_fn, progress, refuse_in_callback};
use super::error::{bk_result, call, call_or};
use super::handles::{borrowed, create, hold, object, release, retain};
use super::scene::bk_scene;
use crate::photon::{PhotonMap, PhotonParams};
use bytemuck::cast_slice;
use std::ffi::c_void;
use std::sync::Arc;

/// Flag: leave out photons that come straight from a light; the map then holds indirect light only.
pub const BK_PHOTONS_INDIRECT_ONLY: u32 = 1;

/// A photon map.
pub struct bk_photon_map {
    map: PhotonMap,
}

/// How to trace photons.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_photon_params {
    /// Size of this structure in bytes, set by bk_photon_params_init.
    pub struct_size: u32,
    /// BK_PHOTONS flags. Default: 0.
    pub flags: u32,
    /// Photons to emit, 1 to 2^32. They meet 1 / (1 - albedo) surfaces each, and take 96 bytes for each
    /// while the map is made, half of them later. Default: 1,000,000.
    pub photon_count: u64,
    /// Most surfaces that a photon meets; 0, the default: Russian roulette alone ends its path. At most
    /// 10,000 in any case.
    pub max_bounces: u32,
    /// Search radius of the estimate in scene units, finite and at least 1.2e-38; 0, the default: from
    /// the density of photons.
    pub radius: f32,
    /// Half the height of the search cylinder, as a fraction of the radius, finite and > 0.
    /// Default: 0.25.
    pub half_height: f32,
    /// Constant of Jensen's cone filter, >= 1; +infinity: no filter. Default: 1.1.
    pub cone_k: f32,
    /// Seed of all random numbers. The same seed gives the same bits on any number of threads.
    /// Default: 0.
    pub seed: u64,
    /// Bytes that the map may take while it is made; 0, the default: no limit.
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

/// Fills in the defaults.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_photon_params_init(params: *mut bk_photon_params) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(params) }
}

/// Traces photons through a committed scene, on the device's threads.
///
/// params: NULL for the defaults. progress, user: told how far it is; NULL if not wanted. out:
/// receives the map, NULL on failure.
///
/// Fails with BK_ERROR_INVALID_ARGUMENT if a field of params is out of its range,
/// BK_ERROR_INVALID_STATE if the scene is not committed or has no lights, BK_ERROR_OUT_OF_MEMORY if
/// the map would not fit into memory_budget or the memory callback refuses, BK_ERROR_CANCELLED if
/// progress says so. Lights without power make an empty map.
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

/// Counts one more reference. NULL is ignored.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_photon_map_retain(map: *mut bk_photon_map) {
    // SAFETY: a handle or NULL.
    unsafe { retain(map) }
}

/// Gives one reference back. NULL is ignored.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_photon_map_release(map: *mut bk_photon_map) {
    // SAFETY: a handle whose reference the caller gives up, or NULL.
    call_or((), || unsafe {
        release(map);
        Ok(())
    })
}

/// Irradiance (W/m2) at points of surfaces, on the side that the normal points to; the calling
/// thread does the work.
///
/// positions, normals: count times three floats, packed, aligned to 4 bytes; normals of length 1.
/// out_irradiance_rgb: receives count times three floats, packed, finite and >= 0, at most 1e30; must
/// not overlap the inputs.
///
/// The estimate takes the search disc to lie wholly on the surface: less than a radius from an edge it
/// falls, to half at the edge, and photons behind a wall that crosses the disc count. Positions and
/// normals that are not finite give 0.
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

/// The stored photons, array by array.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_photon_view {
    /// Size of this structure in bytes, set by bk_photon_view_init.
    pub struct_size: u32,
    /// Search radius in use, in scene units.
    pub radius: f32,
    /// Number of stored photons.
    pub count: usize,
    /// count times three floats, packed: where it lies.
    pub position: *const f32,
    /// count times three floats, packed: unit direction of travel.
    pub direction: *const f32,
    /// count times three floats, packed: power in W.
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

/// Sets struct_size and clears the rest.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_photon_view_init(view: *mut bk_photon_view) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(view) }
}

/// Shows the stored photons. The first call packs them, 36 bytes each, for as long as the map lives.
///
/// out: receives pointers that are valid while the map lives. If no photon was stored, count is 0
/// and the pointers must not be read.
///
/// Fails with BK_ERROR_OUT_OF_MEMORY if the memory callback refuses the packed copy that the first
/// call makes.
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

fn core_params(p: &bk_photon_params) -> crate::Result<PhotonParams> {
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
