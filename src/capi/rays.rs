//! Rays
//!
//! All functions take a committed scene and are safe from any threads. A closest hit is the one with
//! the least t in tmin < t <= tmax; among equal t the triangle that was added first, whichever
//! function is asked. Directions need not be normalised; t is in units of the direction's length.
//! Both sides of a triangle are hit. A ray with a NaN, an origin beyond 1e18 or a zero direction hits
//! nothing.

use super::args::{check_flags, read_vec3, slice, slice_mut};
use super::device::refuse_in_callback;
use super::error::{BK_NONE, bk_result, call, call_or};
use super::handles::{borrowed, is_null};
use super::scene::bk_scene;
use crate::error::Result;
use crate::scene::Scene;
use crate::trace::{Hit, Ray};
use bytemuck::{Pod, Zeroable, cast_slice, cast_slice_mut};

/// Flag: spread the rays over the device's threads. Without it the calling thread does the work.
pub const BK_RAYS_PARALLEL: u32 = 1;

/// The points origin + t direction with tmin < t <= tmax.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct bk_ray {
    pub origin: [f32; 3],
    pub tmin: f32,
    pub direction: [f32; 3],
    pub tmax: f32,
}

/// What a ray hits. A miss has t = +infinity, u = v = 0, and BK_NONE in the rest.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct bk_hit {
    /// Distance in units of the direction's length.
    pub t: f32,
    /// Barycentric weight of the triangle's vertex 1.
    pub u: f32,
    /// Barycentric weight of the triangle's vertex 2.
    pub v: f32,
    /// Number of the triangle in its mesh.
    pub triangle: u32,
    /// Number of the mesh.
    pub mesh: u32,
    /// Not used yet: BK_NONE.
    pub instance: u32,
}

const _: () = assert!(size_of::<bk_ray>() == 32 && size_of::<bk_ray>() == size_of::<Ray>());
const _: () = assert!(size_of::<bk_hit>() == 24 && size_of::<bk_hit>() == size_of::<Hit>());

const MISS: bk_hit = bk_hit { t: f32::INFINITY, u: 0.0, v: 0.0, triangle: BK_NONE, mesh: BK_NONE, instance: BK_NONE };

/// The closest hit of one ray. On failure (a scene that is NULL or not committed, a NULL ray) out
/// receives a miss, and bk_last_error the reason.
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

/// Whether anything lies on the ray: 1 or 0. On failure 0, and bk_last_error has the reason.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_occluded(scene: *const bk_scene, ray: *const bk_ray) -> i32 {
    // SAFETY: ray is the caller's, or NULL.
    call_or(0, || unsafe {
        let scene = borrowed!(scene).committed()?;
        let ray = &slice(ray, 1, "ray")?[0];
        Ok(scene.occluded(bytemuck::cast_ref(ray)) as i32)
    })
}

/// The closest hits of many rays. Fastest where consecutive rays share origin, tmin and tmax and go
/// nearly the same way, as those of a pinhole camera do in small square tiles of pixels; the hits are
/// the same, bit for bit, in any order of rays.
///
/// rays: count rays, aligned to 4 bytes. flags: 0 or BK_RAYS_PARALLEL. out: receives
/// count hits in the order of the rays; must not overlap them.
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

/// Whether anything lies on each of many rays.
///
/// rays: count rays, aligned to 4 bytes. flags: 0 or BK_RAYS_PARALLEL. out: receives
/// count bytes, 1 or 0, in the order of the rays; must not overlap them.
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
/// The closest hits of rays that share an origin, with 0 < t <= tmax: those of bk_intersect_many.
/// Faster than as many single rays; use 32 directions and more.
///
/// directions: count directions of three floats, packed, aligned to 4 bytes. flags:
/// BK_RAYS_PARALLEL. out: receives count hits in the order of the directions; must not overlap them.
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
