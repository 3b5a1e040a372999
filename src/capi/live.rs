//! Live updates
//!
//! A live object lights a scene at once, coarsely, and refines the light while a camera moves
//! through it: call bk_live_update once per frame with the camera and a time budget, fetch the
//! rectangles of texels that changed, and read and upload them. All levels of detail (LODs) are
//! shown in pages of the light map's size and layout; lower LODs are interpolated. Source: Schouls
//! 2017, section 3.3.
//!
//! Thread safety: any thread, one call at a time per live object: a second call that comes while
//! the first runs fails with BK_ERROR_INVALID_STATE and changes nothing. bk_live_read,
//! bk_live_cell_lods and bk_live_lod_at exclude other calls but not each other.
//!
//! Cost: see each function; those without a remark take microseconds.

// The file is long because a section of the header is one file, and a third of it the text for the C reader.

use super::args::{OutStruct, SizedStruct, init, read_bool, read_struct, read_vec3, sized_struct, slice_mut, write};
use super::bake::read_directional;
use super::device::{bk_progress_fn, call_with_file, progress as report_to, refuse_in_callback};
use super::error::{BK_NONE, bk_result, call, call_or};
use super::handles::{create, hold, is_null, object, release, retain};
use super::lightmap::bk_lightmap;
use super::read::{copy_rgb, core_layer, texel_bytes};
use crate::base::error::{Error, Result, invalid_argument};
use crate::lightmap::directional;
use crate::live::{Budget, CellInfo, Live, LiveCamera, LiveParams, LiveStats, Mode, PageRect};
use glam::Vec3;
use std::ffi::{c_char, c_void};
use std::sync::{RwLock, TryLockError};

/// Mode: refine the surfaces in view, first where estimated error times visibility is largest.
pub const BK_LIVE_VIEW: u32 = 0;
/// Mode: refine the grid cells near the camera, visible ones first. A cell shows its next LOD when
/// all its texels have it.
pub const BK_LIVE_POSITION: u32 = 1;
/// Mode: refine anywhere, at random, for comparison.
pub const BK_LIVE_UNIFORM: u32 = 2;

/// Handle of a live object.
pub struct bk_live {
    /// Only ever tried, never waited for.
    live: RwLock<Live>,
}

impl bk_live {
    fn read<R>(&self, f: impl FnOnce(&Live) -> Result<R>) -> Result<R> {
        match self.live.try_read() {
            Ok(live) => f(&live),
            Err(TryLockError::WouldBlock) => Err(busy()),
            Err(TryLockError::Poisoned(_)) => Err(unusable()),
        }
    }

    fn change<R>(&self, f: impl FnOnce(&mut Live) -> Result<R>) -> Result<R> {
        match self.live.try_write() {
            Ok(mut live) => {
                live.device().check_process()?;
                f(&mut live)
            }
            Err(TryLockError::WouldBlock) => Err(busy()),
            Err(TryLockError::Poisoned(_)) => Err(unusable()),
        }
    }
}

fn busy() -> Error {
    Error::InvalidState("another call is using the live object at the same time".into())
}

fn unusable() -> Error {
    Error::InvalidState("an internal error has left the live object unusable".into())
}

/// Parameters of bk_live_create.
///
/// Measured curves of these fields: docs/performance.md, "Live updates".
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_live_params {
    /// Size of this structure in bytes, set by bk_live_params_init.
    pub struct_size: u32,
    /// One of the BK_LIVE modes. In Sponza an error of 1 % took BK_LIVE_VIEW 2.3 s and
    /// BK_LIVE_POSITION 4.0 s; the latter changes the LOD of whole cells at a time, which
    /// bk_live_cell_lods reports. Default: BK_LIVE_VIEW.
    pub mode: u32,
    /// Number of levels of detail, 1 to 4: the lowest computes every 2^(lod_count - 1)-th texel of
    /// the gather map along each axis, the highest all. Raise it for a sooner and coarser first
    /// picture; lower it where coarse light must not be seen. Default: 3.
    pub lod_count: u32,
    /// Number of rounds of 64 rays that each texel of a cell needs before the cell shows its next
    /// LOD, 1 to `max_rounds`. Raise it so that cells change their LOD with less noise and later.
    /// Default: 1.
    pub promote_threshold: u32,
    /// Number of rounds of 64 rays after which a texel is finished, 1 to 1024. Raise it for less
    /// final noise, lower it to be finished sooner: 1 round has the rays of a default bake, 4 those
    /// of final light, and the time until all is finished grows in proportion. Default: 16.
    pub max_rounds: u32,
    /// Maximum number of rays that an update traces, whatever its budget; 0: no limit. Set it where
    /// the work per frame must not depend on the speed of the machine, as in tests. Default: 0.
    pub rays_per_update: u32,
    /// Radius of a blur for display, in texels of the gather map, 0 to 16; accumulated indirect light
    /// is not blurred. With 0 noisy direct light is not blurred either, as in a bake. Lower it to 1
    /// or 0 where contact shadows matter and noise at the beginning does not; it costs time when
    /// texels are shown. Default: 2.
    pub blur: u32,
    /// Distance, in texels of the radiance map, up to which light is computed where gather rays hit,
    /// see bk_bake_params. Default: 0.
    pub near_hits: f32,
    /// Edge of a grid cell in scene units, finite and >= 0; 0: a sixteenth of the scene's longest
    /// side. A grid of more than 2^24 cells is refused. Lower it for finer decisions in
    /// BK_LIVE_POSITION; more cells take more time per update to sort. Default: 0.
    pub cell_size: f32,
    /// 1: begin with a first impression of the light that was reflected by other surfaces: a quarter of
    /// the photons, few points per texel of the radiance map, and light that may cross walls by a texel of
    /// the gather map. All that a bake computes then follows on a thread of its own beside the updates,
    /// while bk_live_stats.light_pending is 1, and replaces it: finished light is the same. Set it to 1
    /// where the first picture must come soon on a machine of few cores (Sponza: 1.5 instead of 3.2 s
    /// from nothing); the update that replaces it may take longer than its budget (34 ms there, once).
    /// States are saved and restored when nothing is pending. Default: 0.
    pub quick_start: u32,
    /// Seed of all random numbers, see bk_bake_params. Default: 0.
    pub seed: u64,
    /// Number of photons to emit, see bk_bake_params. Lower it where bk_live_create and changes of
    /// light must be quick: both trace all photons. Default: 1,000,000.
    pub photon_count: u64,
    /// Maximum number of reflections, see bk_bake_params. Leave it at 0. Default: 0.
    pub max_bounces: u32,
    /// Number of shadow rays per light map texel and area light, see bk_bake_params. Lower it where
    /// lights change often: direct light is computed anew each time. Default: 16.
    pub direct_samples: u32,
    /// Search radius of photons in scene units, see bk_bake_params. Default: 0.
    pub radius: f32,
    /// 1: the device's threads go on working between updates, on the surfaces that the last one
    /// saw. 0: they rest. Set it to 1 where the application leaves cores idle between updates:
    /// light converges sooner, and the cores are busy all the time. Default: 0.
    pub background: u32,
    /// Estimated error of interpolation above which texels trace rays themselves, see
    /// bk_bake_params. These rays come before the first light and before that of new lights. Set it
    /// to 1.5 for those of a default bake. There is no interpolation_contrast here, as the gather map
    /// of live updates comes after that choice: they end with the light of a bake whose
    /// interpolation_contrast is INFINITY. Default: INFINITY.
    pub interpolation_error: f32,
    /// Number of rays of texels of the light map that trace rays themselves, see bk_bake_params; 0:
    /// 64, as in a default bake. They come before the first light. Default: 16.
    pub own_rays: u32,
    /// 1: compute light that was reflected by other surfaces by direction too, as
    /// bk_bake_params.directional_indirect does. It takes 240 bytes more per texel of the gather map, half
    /// as much again once a light has changed, and a fifth more time until light is finished.
    /// Default: 0.
    pub directional_indirect: u32,
    /// 1: the same for light that comes straight from lights, for about 120 bytes more per texel of the
    /// light map (48 per texel of tiles, which overlap). With both, the layers hold the sum.
    /// Default: 0.
    pub directional_direct: u32,
}

sized_struct!(bk_live_params, defaults: {
    let p = LiveParams::default();
    bk_live_params {
        struct_size: size_of::<bk_live_params>() as u32,
        mode: BK_LIVE_VIEW,
        lod_count: p.lod_count,
        promote_threshold: p.promote_threshold,
        max_rounds: p.max_rounds,
        rays_per_update: p.rays_per_update,
        blur: p.blur,
        cell_size: p.cell_size,
        quick_start: p.quick_start as u32,
        seed: p.seed,
        photon_count: p.photon_count,
        max_bounces: p.max_bounces,
        direct_samples: p.direct_samples,
        radius: p.radius,
        near_hits: p.near_hits,
        interpolation_error: p.interpolation_error,
        own_rays: p.own_rays,
        background: p.background as u32,
        directional_indirect: u32::from(p.directional & directional::INDIRECT != 0),
        directional_direct: u32::from(p.directional & directional::DIRECT != 0),
    }
});

/// Sets `struct_size` and fills in the defaults.
///
/// @param params  structure to fill in; NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_live_params_init(params: *mut bk_live_params) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(params) }
}

fn core_params(p: &bk_live_params) -> Result<LiveParams> {
    let mode = match p.mode {
        BK_LIVE_VIEW => Mode::View,
        BK_LIVE_POSITION => Mode::Position,
        BK_LIVE_UNIFORM => Mode::Uniform,
        other => return invalid_argument!("mode is {other}, not one of the BK_LIVE values"),
    };
    Ok(LiveParams {
        mode,
        lod_count: p.lod_count,
        promote_threshold: p.promote_threshold,
        max_rounds: p.max_rounds,
        rays_per_update: p.rays_per_update,
        blur: p.blur,
        cell_size: p.cell_size,
        seed: p.seed,
        photon_count: p.photon_count,
        max_bounces: p.max_bounces,
        direct_samples: p.direct_samples,
        radius: p.radius,
        near_hits: p.near_hits,
        interpolation_error: p.interpolation_error,
        own_rays: p.own_rays,
        quick_start: read_bool(p.quick_start, "quick_start")?,
        background: read_bool(p.background, "background")?,
        directional: read_directional(p.directional_indirect, p.directional_direct)?,
    })
}

/// A perspective camera.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_camera {
    /// Size of this structure in bytes, set by bk_camera_init.
    pub struct_size: u32,
    /// Width of the picture in pixels, >= 1; only the ratio to `height` matters. Default: 1920.
    pub width: u32,
    /// Height of the picture in pixels, >= 1. Default: 1080.
    pub height: u32,
    /// Position in scene units. Default: the origin.
    pub position: [f32; 3],
    /// Direction of view, a vector of any length > 0. Default: -z.
    pub forward: [f32; 3],
    /// Upward direction, a vector of any length > 0, not parallel to `forward`. Default: +y.
    pub up: [f32; 3],
    /// Vertical field of view in radians, in (0, pi). Default: 1.
    pub fov_y: f32,
}

sized_struct!(bk_camera, defaults: bk_camera {
    struct_size: size_of::<bk_camera>() as u32,
    width: 1920,
    height: 1080,
    position: [0.0; 3],
    forward: [0.0, 0.0, -1.0],
    up: [0.0, 1.0, 0.0],
    fov_y: 1.0,
});

/// Sets `struct_size` and fills in the defaults.
///
/// @param camera  structure to fill in; NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_camera_init(camera: *mut bk_camera) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(camera) }
}

/// Limits of an update. With time and rays 0 nothing is traced.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_budget {
    /// Size of this structure in bytes, set by bk_budget_init.
    pub struct_size: u32,
    /// Time limit in milliseconds, finite and >= 0; 0: none. Default: 4.
    pub milliseconds: f32,
    /// Limit of the number of rays; 0: none. A round of 64 rays that has begun is finished.
    /// Default: 0.
    pub rays: u64,
    /// Maximum size in bytes of the texels in the rectangles that bk_live_dirty_rects fetches until
    /// the next update, 8 bytes per texel (BK_FORMAT_RGBA16F), at least 1024; 0: no limit. Set it so
    /// that no frame reads and uploads more than it has time for, also after the start and after a
    /// change of light: surfaces in view whose light has changed most come first, the others in later
    /// updates. The time that bk_live_read takes for that many texels is then kept free within
    /// `milliseconds`, up to half of it; if reading takes longer, fewer bytes come. Default: 0.
    pub max_dirty_bytes: u64,
}

sized_struct!(bk_budget, defaults: bk_budget {
    struct_size: size_of::<bk_budget>() as u32,
    milliseconds: 4.0,
    rays: 0,
    max_dirty_bytes: 0,
});

/// Sets `struct_size` and fills in the defaults.
///
/// @param budget  structure to fill in; NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_budget_init(budget: *mut bk_budget) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(budget) }
}

/// Numbers about an update, and the state after it.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_live_stats {
    /// Size of this structure in bytes, set by bk_live_stats_init.
    pub struct_size: u32,
    /// 1 while indirect light is being recomputed because a light has changed, or after a quick start;
    /// else 0.
    pub light_pending: u32,
    /// Duration of the update in milliseconds.
    pub milliseconds: f32,
    /// Estimated relative error of the indirect light that the camera sees.
    pub visible_error: f32,
    /// Fraction of the light map that is finished, 0 to 1.
    pub finished: f32,
    /// Fraction of the surfaces in view that is finished, 0 to 1.
    pub visible_finished: f32,
    /// Number of rays traced by the update, and in the background since the update before.
    pub rays: u64,
    /// Number of rays traced since the live object was created.
    pub total_rays: u64,
    /// Number of cells that went to a higher LOD (BK_LIVE_POSITION).
    pub cells_promoted: u32,
    /// Number of blocks of 8 x 8 texels of the gather map whose shown light changed.
    pub blocks_changed: u32,
    /// Size of the live object in bytes.
    pub bytes: u64,
    /// Size in bytes that the live object would have with all LODs in use everywhere.
    pub bytes_full: u64,
    /// Size in bytes of the texels in the rectangles that bk_live_dirty_rects fetches now, 8 bytes
    /// per texel.
    pub dirty_bytes: u64,
    /// Size in bytes of the changed texels that bk_budget.max_dirty_bytes leaves to later updates.
    pub dirty_bytes_left: u64,
}

sized_struct!(bk_live_stats, defaults: stats(&Default::default()));

fn stats(s: &LiveStats) -> bk_live_stats {
    bk_live_stats {
        struct_size: size_of::<bk_live_stats>() as u32,
        light_pending: s.light_pending as u32,
        milliseconds: s.milliseconds,
        visible_error: s.visible_error,
        finished: s.finished,
        visible_finished: s.visible_finished,
        rays: s.rays,
        total_rays: s.total_rays,
        cells_promoted: s.cells_promoted,
        blocks_changed: s.blocks_changed,
        bytes: s.bytes,
        bytes_full: s.bytes_full,
        dirty_bytes: s.dirty_bytes,
        dirty_bytes_left: s.dirty_bytes_left,
    }
}

/// Sets `struct_size` and clears the other fields.
///
/// @param stats  structure to fill in; NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_live_stats_init(stats: *mut bk_live_stats) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(stats) }
}

/// A rectangle of texels of a page.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_rect {
    /// Number of the page.
    pub page: u32,
    /// LOD to read; in dirty rectangles always the highest, lod_count - 1.
    pub lod: u32,
    /// First column, in texels.
    pub x: u32,
    /// First row, in texels.
    pub y: u32,
    /// Number of columns, in texels.
    pub width: u32,
    /// Number of rows, in texels.
    pub height: u32,
}

// SAFETY: repr(C), six u32 without padding, of which every value is valid.
unsafe impl bytemuck::Zeroable for bk_rect {}
// SAFETY: as above.
unsafe impl bytemuck::Pod for bk_rect {}

/// Geometry of the light map grid.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_cell_info {
    /// Size of this structure in bytes, set by bk_cell_info_init.
    pub struct_size: u32,
    /// Number of cells along x, y and z.
    pub dimensions: [u32; 3],
    /// Lower corner of the first cell, in scene units.
    pub origin: [f32; 3],
    /// Edge of a cell in scene units.
    pub cell_size: f32,
}

sized_struct!(bk_cell_info, defaults: cell_info(&CellInfo::default()));

fn cell_info(i: &CellInfo) -> bk_cell_info {
    bk_cell_info {
        struct_size: size_of::<bk_cell_info>() as u32,
        dimensions: i.dimensions,
        origin: i.origin.to_array(),
        cell_size: i.cell_size,
    }
}

/// Sets `struct_size` and clears the other fields.
///
/// @param info  structure to fill in; NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_cell_info_init(info: *mut bk_cell_info) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(info) }
}

/// Creates a live object: computes photons and the lowest LOD under the present lights, on the
/// device's threads. All pages are dirty afterwards.
///
/// Cost: a second or two for a large scene.
///
/// @param lightmap  light map whose layout is used; need not be baked, is not changed, and may be
///   released
/// @param params  parameters; NULL for the defaults
/// @param progress,user  progress callback and its pointer; may be NULL
/// @param out  receives the live object, which the caller releases with bk_live_release; NULL on
///   failure
/// @retval BK_ERROR_INVALID_ARGUMENT  a field of `params` is out of its range
/// @retval BK_ERROR_INVALID_STATE  the light map is being baked
/// @retval BK_ERROR_OUT_OF_MEMORY  the live object does not fit or the memory callback refuses
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_live_create(
    lightmap: *mut bk_lightmap,
    params: *const bk_live_params,
    progress: bk_progress_fn,
    user: *mut c_void,
    out: *mut *mut bk_live,
) -> bk_result {
    // SAFETY: params and out are the caller's, or NULL.
    call(|| unsafe {
        write(out, std::ptr::null_mut(), "out")?;
        refuse_in_callback()?;
        let lightmap = hold(lightmap, "lightmap")?;
        let p: bk_live_params = if params.is_null() { SizedStruct::defaults() } else { read_struct(params, "params")? };
        let params = core_params(&p)?;
        let live = lightmap.read(|l| Live::new(l, &params, &report_to(progress, user)))?;
        write(out, create(bk_live { live: RwLock::new(live) }), "out")
    })
}

/// Creates a live object of a scene that was described anew, after meshes were added, removed or
/// edited, with the parameters of the live object of the scene before, which is not changed.
///
/// Blocks of texels that show the same surfaces keep their rays, and their direct light where nothing
/// that changed lies between them and a light. When all photons of the new scene have been traced, rays
/// of a few texels of each block find out whether its indirect light differs by more than `keep_error`; if
/// it does, it is gathered again, while the old light fades out. With bk_live_params.quick_start all that
/// can be kept is shown at once, and photons are traced beside the updates, while
/// bk_live_stats.light_pending is 1; else they are traced in this call. If light was pending in the earlier
/// object, its light is shown until new rays replace it. All pages are dirty afterwards. Until the photons
/// have come, the live object keeps the scene before in memory, with its device.
///
/// Cost: up to half as much again as bk_live_create, with quick_start two to three times as much: in
/// Sponza 1.8 instead of 0.9 seconds on two threads; see docs/performance.md, "Edits".
///
/// @param lightmap  light map of the new scene, best made by bk_lightmap_create_from; need not be baked,
///   is not changed, and may be released
/// @param earlier  live object of the scene before; it may be released afterwards
/// @param keep_error  change of light below which blocks keep it, as a fraction of their light or, if
///   that is more, of a tenth of the mean light; finite, >= 0. 0.03 is hard to see
/// @param progress,user  progress callback and its pointer; may be NULL
/// @param out  receives the live object, which the caller releases with bk_live_release; NULL on
///   failure
/// @retval BK_ERROR_INVALID_ARGUMENT  `keep_error` is out of its range, or the earlier object's cell_size
///   is too small for the new scene
/// @retval BK_ERROR_INVALID_STATE  the light map is being baked, or another call is using the earlier
///   object
/// @retval BK_ERROR_OUT_OF_MEMORY  both live objects do not fit or the memory callback refuses
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_live_create_from(
    lightmap: *mut bk_lightmap,
    earlier: *mut bk_live,
    keep_error: f32,
    progress: bk_progress_fn,
    user: *mut c_void,
    out: *mut *mut bk_live,
) -> bk_result {
    // SAFETY: handles, and out is the caller's, or NULL.
    call(|| unsafe {
        write(out, std::ptr::null_mut(), "out")?;
        refuse_in_callback()?;
        let (lightmap, earlier) = (hold(lightmap, "lightmap")?, hold(earlier, "earlier")?);
        let report = report_to(progress, user);
        earlier.change(Live::collect_now)?;
        // Read from here on: an error in the new object is none in the earlier one.
        let live =
            earlier.read(|earlier| lightmap.read(|l| Live::create_from_idle(l, earlier, keep_error, &report)))?;
        write(out, create(bk_live { live: RwLock::new(live) }), "out")
    })
}

/// Adds one reference.
///
/// @param live  NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_live_retain(live: *mut bk_live) {
    // SAFETY: a handle or NULL.
    unsafe { retain(live) }
}

/// Releases one reference.
///
/// The last release stops work between updates and the recomputation of indirect light, and waits
/// until both have ended; no callback comes from them afterwards. It may be made in a callback, on
/// any thread. Only if it is made in a memory callback that the recomputation of indirect light
/// calls, that work ends just after the callback has returned, and may call the memory callback
/// once more for the memory that it frees. A thread that makes the last release must not hold a
/// lock that a callback takes.
///
/// @param live  NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_live_release(live: *mut bk_live) {
    // SAFETY: a handle whose reference the caller gives up, or NULL.
    call_or((), || unsafe {
        release(live);
        Ok(())
    })
}

/// Updates the light for as long as the budget allows, on the device's threads.
///
/// Cost: the budget, which is exceeded by 0.04 ms in the median.
///
/// @param live  live object
/// @param camera  camera with finite coordinates; may be inside walls or outside the scene
/// @param budget  limits; NULL for 4 milliseconds
/// @param out  receives numbers about the update; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  a field of `camera` or `budget` is out of its range or not
///   finite
/// @retval BK_ERROR_INVALID_STATE  another call is using the live object
/// @retval BK_ERROR_OUT_OF_MEMORY  a higher LOD or recomputed indirect light does not fit, or the
///   memory callback refuses; finished work stays, and the next update tries again
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_live_update(
    live: *mut bk_live,
    camera: *const bk_camera,
    budget: *const bk_budget,
    out: *mut bk_live_stats,
) -> bk_result {
    // SAFETY: camera, budget and out are the caller's, or NULL.
    call(|| unsafe {
        refuse_in_callback()?;
        let live = hold(live, "live")?;
        let c: bk_camera = read_struct(camera, "camera")?;
        let b: bk_budget = if budget.is_null() { SizedStruct::defaults() } else { read_struct(budget, "budget")? };
        let out = OutStruct::optional(out, "out")?;
        let camera = LiveCamera {
            position: Vec3::from(c.position),
            forward: Vec3::from(c.forward),
            up: Vec3::from(c.up),
            fov_y: c.fov_y,
            width: c.width,
            height: c.height,
        };
        let budget = Budget { milliseconds: b.milliseconds, rays: b.rays, max_dirty_bytes: b.max_dirty_bytes };
        let done = live.change(|l| l.update(&camera, &budget))?;
        if let Some(out) = out {
            out.write(stats(&done));
        }
        Ok(())
    })
}

/// Fetches rectangles of texels whose shown light has changed since they were last fetched, padding
/// around charts included. Rectangles are merged where that adds few texels, and are at most as many
/// as the last update's bk_budget.max_dirty_bytes allows.
///
/// @param live  live object
/// @param out  receives at most `capacity` rectangles, aligned to 4 bytes; may be NULL if
///   `capacity` is 0
/// @param capacity  number of rectangles that `out` holds
/// @param count  receives the number of rectangles fetched; the others are kept for the next call,
///   so fetch until `count` is less than `capacity`
/// @retval BK_ERROR_INVALID_STATE  another call is using the live object
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_live_dirty_rects(
    live: *mut bk_live,
    out: *mut bk_rect,
    capacity: usize,
    count: *mut usize,
) -> bk_result {
    // SAFETY: out and count are the caller's, or NULL.
    call(|| unsafe {
        write(count, 0, "count")?;
        let live = object!(live);
        let out = slice_mut(out, capacity, "out", &[])?;
        let taken = live.change(|l| {
            let lod = l.params().lod_count - 1;
            let rect = |r: PageRect| bk_rect { page: r.page, lod, x: r.x, y: r.y, width: r.width, height: r.height };
            let mut taken = 0;
            l.take_each_dirty(capacity, |r| {
                out[taken] = rect(r);
                taken += 1;
            });
            Ok(taken)
        })?;
        write(count, taken, "count")
    })
}

/// Copies the shown light of a rectangle of a page.
///
/// Cost: about 0.2 microseconds per texel; more for layers of light by direction and for an LOD below
/// the highest.
///
/// @param live  live object
/// @param page  number of the page
/// @param lod  lod_count - 1 for the light as shown; less for the light as it would be shown if no
///   texel were above that LOD
/// @param layer  BK_LAYER_COMBINED, INDIRECT or DIRECT; or one from BK_LAYER_L0 to DIRECTION, of a live
///   object that was created with `directional_indirect` or `directional_direct`
/// @param format  BK_FORMAT_RGB32F or BK_FORMAT_RGBA16F; for ratios and DIRECTION also BK_FORMAT_RGBA8
/// @param rect  `x`, `y`, `width` and `height` of the rectangle; its `page` and `lod` are ignored.
///   NULL: the whole page
/// @param dst  receives the rectangle's rows; needs no alignment
/// @param row_stride  distance between rows in bytes, at least the bytes of a row; 0: packed
/// @retval BK_ERROR_INVALID_ARGUMENT  page, LOD, layer or format does not exist, the layer is another
///   one, the format does not suit it, the rectangle is not within the page, or `row_stride` is too
///   small
/// @retval BK_ERROR_INVALID_STATE  another call is changing the live object, or it was created without
///   light by direction
/// @retval BK_ERROR_OUT_OF_MEMORY  the rectangle does not fit
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_live_read(
    live: *const bk_live,
    page: u32,
    lod: u32,
    layer: u32,
    format: u32,
    rect: *const bk_rect,
    dst: *mut c_void,
    row_stride: usize,
) -> bk_result {
    call(|| {
        let live = object!(live);
        if dst.is_null() {
            return Err(is_null("dst"));
        }
        let layer = core_layer(layer)?;
        let texel = texel_bytes(format)?;
        // SAFETY: the caller's rectangle, or NULL.
        let rect = unsafe { rect.as_ref() };
        live.read(|l| {
            let size = l.page_size();
            let rect = rect.map_or(PageRect { page, x: 0, y: 0, width: size, height: size }, |r| PageRect {
                page,
                x: r.x,
                y: r.y,
                width: r.width,
                height: r.height,
            });
            let packed = rect.width as usize * texel;
            let stride = if row_stride == 0 { packed } else { row_stride };
            if stride < packed {
                return invalid_argument!("row_stride is {row_stride}, less than the {packed} bytes of a row");
            }
            let texels = l.read(&rect, lod, layer)?;
            // SAFETY: the caller has room for the rectangle's rows, `stride` bytes apart.
            unsafe { copy_rgb(texels, layer, format, rect.width as usize, dst, stride) }
        })
    })
}

/// Copies the light map grid and the LOD that each of its cells shows, for example into a 3D
/// texture.
///
/// @param live  live object
/// @param info  receives the geometry of the grid
/// @param out  receives one LOD per cell, x fastest, 255 for cells without surfaces; may be NULL if
///   `capacity` is 0
/// @param capacity  size of `out` in bytes, at least the number of cells; 0 to get `info` only
/// @retval BK_ERROR_INVALID_ARGUMENT  `capacity` is too small
/// @retval BK_ERROR_INVALID_STATE  another call is changing the live object
/// @retval BK_ERROR_OUT_OF_MEMORY  a copy does not fit
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_live_cell_lods(
    live: *const bk_live,
    info: *mut bk_cell_info,
    out: *mut u8,
    capacity: usize,
) -> bk_result {
    // SAFETY: info and out are the caller's, or NULL.
    call(|| unsafe {
        let live = object!(live);
        let info = OutStruct::new(info, "info")?;
        let (cells, lods) = live.read(Live::cell_lods)?;
        if capacity > 0 {
            if capacity < lods.len() {
                return invalid_argument!("capacity is {capacity}, the grid has {} cells", lods.len());
            }
            slice_mut(out, lods.len(), "out", &[])?.copy_from_slice(&lods);
        }
        info.write(cell_info(&cells));
        Ok(())
    })
}

/// Returns the LOD that is shown at a position.
///
/// @param live  live object
/// @param position  three floats, in scene units
/// @return  the LOD; BK_NONE outside the grid, in cells without surfaces, and on failure
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_live_lod_at(live: *const bk_live, position: *const f32) -> u32 {
    call_or(BK_NONE, || {
        let live = object!(live);
        // SAFETY: the caller's position, or NULL.
        let position = unsafe { read_vec3(position, "position") }?;
        live.read(|l| Ok(l.lod_at(position).map_or(BK_NONE, u32::from)))
    })
}

/// Announces that bk_scene_set_light has changed lights.
///
/// Direct light follows in the next updates, first where the camera looks. Photons are traced again
/// on a thread of their own; indirect light follows as they arrive, while the old light fades out.
/// One call can follow several changes.
///
/// @param live  live object
/// @param light  number of one of the lights that changed
/// @retval BK_ERROR_INVALID_ARGUMENT  there is no such light
/// @retval BK_ERROR_INVALID_STATE  another call is using the live object
/// @retval BK_ERROR_OUT_OF_MEMORY  the recomputation of indirect light does not fit or the memory
///   callback refuses
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_live_light_changed(live: *mut bk_live, light: u32) -> bk_result {
    // SAFETY: a handle, or NULL.
    call(|| unsafe { hold(live, "live") }?.change(|l| l.light_changed(light)))
}

/// Updates live light to the geometry of its light map after bk_lightmap_follow. Pages, UVs and the
/// grid stay, and so does the light of blocks that the move does not change.
///
/// Direct light follows in the next updates where moved surfaces lie, or lay, between a block and a
/// light. Photons are traced again on a thread of its own: first a sixteenth of them, whose light is
/// gathered near moved surfaces only, then all. With these, rays of a few texels of each block find
/// out whether its light has changed. A move on the way to another one needs no waiting. If
/// bk_scene_set_light has changed lights too, this call announces them, and all light is computed
/// anew. Until the photons have come, the live object keeps the scene in both states in memory.
///
/// Cost: 0.1 to 0.3 seconds per million texels and thread. Does nothing if the live object has the
/// state of the light map already.
///
/// @param live  live object
/// @param lightmap  the light map from which it was created, after bk_lightmap_follow
/// @param keep_error  change of light below which blocks keep it, as a fraction of their light or, if
///   that is more, of a tenth of the mean light; finite, >= 0. 0.03 is hard to see
/// @param progress,user  progress callback and its pointer; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  the live object was created from another light map, or
///   `keep_error` is out of its range
/// @retval BK_ERROR_INVALID_STATE  another call is using the live object or changing the light map
/// @retval BK_ERROR_OUT_OF_MEMORY  blocks or the recomputation of indirect light do not fit or the
///   memory callback refuses; the live object keeps the old geometry
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0; the live object keeps the old
///   geometry
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_live_follow(
    live: *mut bk_live,
    lightmap: *const bk_lightmap,
    keep_error: f32,
    progress: bk_progress_fn,
    user: *mut c_void,
) -> bk_result {
    // SAFETY: handles, or NULL.
    call(|| unsafe {
        refuse_in_callback()?;
        let (live, lightmap) = (hold(live, "live")?, hold(lightmap, "lightmap")?);
        live.change(|live| lightmap.read(|map| live.follow(map, keep_error, &report_to(progress, user))))
    })
}

/// Pauses or resumes work between updates (bk_live_params.background) and the recomputation of
/// indirect light. They resume with the next update; updates themselves go on.
///
/// Cost: pausing waits for the work under way.
///
/// @param live  live object
/// @param paused  1 to pause, 0 to resume
/// @retval BK_ERROR_INVALID_STATE  another call is using the live object
/// @retval BK_ERROR_OUT_OF_MEMORY  the recomputation of indirect light does not fit or the memory
///   callback refuses
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_live_pause(live: *mut bk_live, paused: u32) -> bk_result {
    call(|| {
        // SAFETY: a handle, or NULL.
        let live = unsafe { hold(live, "live") }?;
        let paused = read_bool(paused, "paused")?;
        live.change(|l| l.pause(paused))
    })
}

/// Saves accumulated light to a file, from which bk_live_restore continues. Light that is older
/// than the last change of a light is left out.
///
/// Experimental: another version of the library may refuse the file.
///
/// Cost: the time of writing the file.
///
/// @param live  live object
/// @param path  name of the file, which is replaced as a whole or not at all; UTF-8
/// @param progress,user  progress callback and its pointer; may be NULL
/// @retval BK_ERROR_INVALID_STATE  another call is using the live object
/// @retval BK_ERROR_IO  the file cannot be written; bk_last_error names it
/// @retval BK_ERROR_OUT_OF_MEMORY  a buffer does not fit
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_live_save(
    live: *mut bk_live,
    path: *const c_char,
    progress: bk_progress_fn,
    user: *mut c_void,
) -> bk_result {
    // SAFETY: a handle or NULL; path is the caller's, or NULL.
    unsafe {
        call_with_file((live.cast_const(), "live"), (path, "path"), |live, path| {
            live.change(|l| l.save(path.as_ref(), &report_to(progress, user)))
        })
    }
}

/// Restores light that bk_live_save wrote for the same scene, light map, lights and parameters
/// (mode, cell size, promotion, blur and limits may differ). All pages are dirty afterwards. A call
/// that fails changes nothing.
///
/// Files from untrusted sources are safe to restore: every number is checked, light must be finite
/// and >= 0, and counts must fit the light map. It may be any such light, though.
///
/// Experimental: another version of the library may refuse the file.
///
/// Cost: the time of reading the file; for a moment, twice the memory of the shown light.
///
/// @param live  live object
/// @param path  name of the file; UTF-8
/// @param progress,user  progress callback and its pointer; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  the file is of another scene, light map, lights or parameters
/// @retval BK_ERROR_INVALID_STATE  another call is using the live object
/// @retval BK_ERROR_IO  the file cannot be read, is damaged, or is another kind of file;
///   bk_last_error names it
/// @retval BK_ERROR_OUT_OF_MEMORY  the light does not fit or the memory callback refuses
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_live_restore(
    live: *mut bk_live,
    path: *const c_char,
    progress: bk_progress_fn,
    user: *mut c_void,
) -> bk_result {
    // SAFETY: a handle or NULL; path is the caller's, or NULL.
    unsafe {
        call_with_file((live.cast_const(), "live"), (path, "path"), |live, path| {
            live.change(|l| l.restore(path.as_ref(), &report_to(progress, user)))
        })
    }
}
