//! Rays
//!
//! All functions take a committed scene. A closest hit is the one with the least t in tmin < t <=
//! tmax; among hits of equal t the triangle that was added first, whichever function is called.
//! Both sides of a triangle are hit. A ray with a NaN, an origin beyond a magnitude of 1e18 or a
//! zero direction hits nothing.
//!
//! Units: origins are in scene units. Directions need not have length 1; t, tmin and tmax are in
//! multiples of the direction's length.
//!
//! Thread safety: any thread, all functions at the same time; during bk_scene_refit they fail with
//! BK_ERROR_INVALID_STATE.
//!
//! Cost: grows with the logarithm of the number of triangles; the calling thread does the work
//! unless BK_RAYS_PARALLEL is set. Nothing is allocated.

use super::args::{check_flags, read_vec3, slice, slice_mut};
use super::device::refuse_in_callback;
use super::error::{BK_NONE, bk_result, call, call_or};
use super::handles::{borrowed, is_null};
use super::scene::bk_scene;
use crate::base::error::Result;
use crate::scene::Scene;
use crate::trace::{Hit, Ray};
use bytemuck::{Pod, Zeroable, cast_slice, cast_slice_mut};

/// Flag: spread the rays over the device's threads. Without it the calling thread does the work.
pub const BK_RAYS_PARALLEL: u32 = 1;

/// A ray: the points origin + t direction with tmin < t <= tmax.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct bk_ray {
    /// Origin, in scene units.
    pub origin: [f32; 3],
    /// Lower limit of t, exclusive, in multiples of the direction's length.
    pub tmin: f32,
    /// Direction, a vector of any length but 0, in scene units.
    pub direction: [f32; 3],
    /// Upper limit of t, inclusive, in multiples of the direction's length; may be infinite.
    pub tmax: f32,
}

/// A hit. A miss has t = +infinity, u = v = 0, and BK_NONE in the other fields.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct bk_hit {
    /// Distance in multiples of the direction's length.
    pub t: f32,
    /// Barycentric weight of the triangle's vertex 1, a fraction in [0, 1].
    pub u: f32,
    /// Barycentric weight of the triangle's vertex 2, a fraction in [0, 1].
    pub v: f32,
    /// Number of the triangle in its mesh.
    pub triangle: u32,
    /// Number of the mesh.
    pub mesh: u32,
    /// Number of the instance; BK_NONE if the mesh has none.
    pub instance: u32,
}

const _: () = assert!(size_of::<bk_ray>() == 32 && size_of::<bk_ray>() == size_of::<Ray>());
const _: () = assert!(size_of::<bk_hit>() == 24 && size_of::<bk_hit>() == size_of::<Hit>());

const MISS: bk_hit = bk_hit { t: f32::INFINITY, u: 0.0, v: 0.0, triangle: BK_NONE, mesh: BK_NONE, instance: BK_NONE };

/// Finds the closest hit of one ray.
///
/// @param scene  committed scene
/// @param ray  the ray
/// @param out  receives the hit; on failure (a scene that is not committed, a NULL pointer) a miss,
///   and bk_last_error has the reason
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_intersect(scene: *const bk_scene, ray: *const bk_ray, out: *mut bk_hit) {
    // SAFETY: ray and out are the caller's, or NULL.
    let hit = call_or(MISS, || unsafe {
        if out.is_null() {
            return Err(is_null("out"));
        }
        let scene = borrowed!(scene).committed()?;
        let ray = &slice(ray, 1, "ray")?[0];
        Ok(bytemuck::cast(scene.intersect(bytemuck::cast_ref(ray))))
    });
    if !out.is_null() {
        // SAFETY: as above.
        unsafe { out.write_unaligned(hit) };
    }
}

/// Returns whether anything lies on a ray.
///
/// @param scene  committed scene
/// @param ray  the ray
/// @return  1 or 0; 0 on failure, and bk_last_error has the reason
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_occluded(scene: *const bk_scene, ray: *const bk_ray) -> i32 {
    // SAFETY: ray is the caller's, or NULL.
    call_or(0, || unsafe {
        let scene = borrowed!(scene).committed()?;
        let ray = &slice(ray, 1, "ray")?[0];
        Ok(scene.occluded(bytemuck::cast_ref(ray)) as i32)
    })
}

/// Finds the closest hits of many rays.
///
/// The call is fastest where consecutive rays share `origin`, `tmin` and `tmax` and have nearly the
/// same direction, like those of a pinhole camera in small square tiles of pixels; and where some
/// hundreds or thousands of consecutive rays start near one another, in any directions, like those of
/// neighbouring texels, which are traced together as a stream. The hits are the same, bit for bit, in
/// any order of rays.
///
/// @param scene  committed scene
/// @param rays  `count` rays, aligned to 4 bytes; may be NULL if `count` is 0
/// @param count  number of rays
/// @param flags  0 or BK_RAYS_PARALLEL
/// @param out  receives `count` hits in the order of the rays; must not overlap `rays`
/// @retval BK_ERROR_INVALID_STATE  the scene is not committed or is being refitted
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_intersect_many(
    scene: *const bk_scene,
    rays: *const bk_ray,
    count: usize,
    flags: u32,
    out: *mut bk_hit,
) -> bk_result {
    // SAFETY: rays and out are the caller's, or NULL.
    call(|| unsafe {
        let scene = borrowed!(scene).committed()?;
        let parallel = parallel(&scene, flags)?;
        let rays = slice(rays, count, "rays")?;
        let out = slice_mut(out, count, "out", &[(cast_slice(rays), "rays")])?;
        scene.intersect_many(cast_slice(rays), parallel, cast_slice_mut(out))
    })
}

/// Finds out for many rays whether anything lies on them.
///
/// The call is fastest where some hundreds or thousands of consecutive rays start near one another.
///
/// @param scene  committed scene
/// @param rays  `count` rays, aligned to 4 bytes; may be NULL if `count` is 0
/// @param count  number of rays
/// @param flags  0 or BK_RAYS_PARALLEL
/// @param out  receives `count` bytes, 1 or 0, in the order of the rays; must not overlap `rays`
/// @retval BK_ERROR_INVALID_STATE  the scene is not committed or is being refitted
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_occluded_many(
    scene: *const bk_scene,
    rays: *const bk_ray,
    count: usize,
    flags: u32,
    out: *mut u8,
) -> bk_result {
    // SAFETY: rays and out are the caller's, or NULL.
    call(|| unsafe {
        let scene = borrowed!(scene).committed()?;
        let parallel = parallel(&scene, flags)?;
        let rays = slice(rays, count, "rays")?;
        let out = slice_mut(out, count, "out", &[(cast_slice(rays), "rays")])?;
        scene.occluded_many(cast_slice(rays), parallel, out)
    })
}

/// cbindgen:ptrs-as-arrays=[[origin; 3]]
/// Finds the closest hits, with 0 < t <= tmax, of rays that share an origin.
///
/// The hits are those of bk_intersect_many. The call is faster than as many single rays from 32
/// directions on, and the faster the more there are.
///
/// @param scene  committed scene
/// @param origin  origin of all rays, in scene units
/// @param directions  `count` vectors of any length, of three floats, packed, aligned to 4 bytes;
///   may be NULL if `count` is 0
/// @param count  number of directions
/// @param tmax  upper limit of t, inclusive, in multiples of a direction's length
/// @param flags  0 or BK_RAYS_PARALLEL
/// @param out  receives `count` hits in the order of the directions; must not overlap `directions`
/// @retval BK_ERROR_INVALID_STATE  the scene is not committed or is being refitted
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_gather(
    scene: *const bk_scene,
    origin: *const f32,
    directions: *const f32,
    count: usize,
    tmax: f32,
    flags: u32,
    out: *mut bk_hit,
) -> bk_result {
    // SAFETY: origin, directions and out are the caller's, or NULL.
    call(|| unsafe {
        let scene = borrowed!(scene).committed()?;
        let parallel = parallel(&scene, flags)?;
        let origin = read_vec3(origin, "origin")?;
        let directions = slice(directions.cast::<[f32; 3]>(), count, "directions")?;
        let out = slice_mut(out, count, "out", &[(cast_slice(directions), "directions")])?;
        scene.gather(origin, directions, tmax, parallel, cast_slice_mut(out))
    })
}

/// Checks the flags; whether they ask for the device's threads.
fn parallel(scene: &Scene, flags: u32) -> Result<bool> {
    check_flags(flags, BK_RAYS_PARALLEL, "flags")?;
    let parallel = flags & BK_RAYS_PARALLEL != 0;
    if parallel {
        refuse_in_callback()?;
        scene.device().check_process()?;
    }
    Ok(parallel)
}
