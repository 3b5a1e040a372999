//! Live updates
//!
//! A live object lights a scene at once, coarsely, and refines it while somebody walks through: call
//! bk_live_update once per frame with the camera and a time budget, fetch the rectangles of texels
//! that changed, and read and upload those. All levels of detail (LODs) are shown in pages of the
//! light map's size and layout; a lower LOD is interpolated.
//!
//! One call at a time may use a live object, from any thread: a second one that comes while it runs
//! fails with BK_ERROR_INVALID_STATE and changes nothing. Reads (bk_live_read, bk_live_cell_lods,
//! bk_live_lod_at) exclude updates only, not each other. Source: Schouls 2017, section 3.3.

use super::args::{OutStruct, SizedStruct, init, read_bool, read_struct, read_vec3, sized_struct, slice_mut, write};
use super::device::{bk_progress_fn, call_with_file, progress as report_to, refuse_in_callback};
use super::error::{BK_NONE, bk_result, call, call_or};
use super::handles::{create, hold, is_null, object, release, retain};
use super::lightmap::bk_lightmap;
use super::read::{copy_rgb, texel_bytes};
use crate::error::{Error, Result, invalid_argument};
use crate::live::{Budget, CellInfo, Live, LiveCamera, LiveParams, LiveStats, Mode, PageRect};
use glam::Vec3;
use std::ffi::{c_char, c_void};
use std::sync::{RwLock, TryLockError};

/// Work on what the camera sees, most where estimated error times visibility is largest.
pub const BK_LIVE_VIEW: u32 = 0;
/// Work on the grid cells near the camera, visible ones first. A cell shows its next LOD when all its
/// texels have it.
pub const BK_LIVE_POSITION: u32 = 1;
/// Work anywhere, at random: to compare with.
pub const BK_LIVE_UNIFORM: u32 = 2;

/// Added to the format of bk_live_read: leave direct light out, for applications that shade it
/// themselves.
pub const BK_FORMAT_INDIRECT_ONLY: u32 = 0x100;

/// A scene's light under refinement.
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

/// How to update.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_live_params {
    /// Size of this structure in bytes, set by bk_live_params_init.
    pub struct_size: u32,
    /// One of the BK_LIVE modes. Default: BK_LIVE_VIEW.
    pub mode: u32,
    /// Levels of detail, 1 to 4: the lowest computes every 2^(lod_count - 1)-th texel of the gather map
    /// along each axis, the highest all. Default: 3.
    pub lod_count: u32,
    /// Rounds of 64 rays that each texel of a cell needs before the cell shows its next LOD, 1 to
    /// max_rounds. Default: 1.
    pub promote_threshold: u32,
    /// Rounds of 64 rays after which a texel is finished, 1 to 1024. Default: 16.
    pub max_rounds: u32,
    /// The most rays that an update traces, whatever its budget; 0, the default: no such limit.
    pub rays_per_update: u32,
    /// Radius in texels of the gather map of a blur for display, 0 to 16; what is accumulated is not
    /// blurred. Default: 2.
    pub blur: u32,
    /// Edge of a grid cell in scene units, finite and >= 0; 0, the default: a sixteenth of the scene's
    /// longest side. A grid of more than 2^24 cells is refused.
    pub cell_size: f32,
    /// Seed of all random numbers, as in bk_bake_params. Default: 0.
    pub seed: u64,
    /// Photons to emit, as in bk_bake_params. Default: 1,000,000.
    pub photon_count: u64,
    /// Most reflections, as in bk_bake_params. Default: 0.
    pub max_bounces: u32,
    /// Shadow rays per light map texel and area light, as in bk_bake_params. Default: 16.
    pub direct_samples: u32,
    /// Photon search radius, as in bk_bake_params. Default: 0.
    pub radius: f32,
    /// 1: the device's threads go on working between updates, on what the last one saw. Default: 0.
    pub background: u32,
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
        seed: p.seed,
        photon_count: p.photon_count,
        max_bounces: p.max_bounces,
        direct_samples: p.direct_samples,
        radius: p.radius,
        background: p.background as u32,
    }
});

/// Fills in the defaults.
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
        background: read_bool(p.background, "background")?,
    })
}

/// Where somebody looks from.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_camera {
    /// Size of this structure in bytes, set by bk_camera_init.
    pub struct_size: u32,
    /// Width of the picture in pixels, >= 1: only the aspect matters. Default: 1920.
    pub width: u32,
    /// Height of the picture in pixels, >= 1. Default: 1080.
    pub height: u32,
    /// Position in the scene. Default: the origin.
    pub position: [f32; 3],
    /// Direction of view, of any length > 0. Default: -z.
    pub forward: [f32; 3],
    /// Upwards, of any length > 0, not parallel to forward. Default: +y.
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

/// Fills in the defaults.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_camera_init(camera: *mut bk_camera) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(camera) }
}

/// What an update may take. Both limits 0: nothing is traced.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_budget {
    /// Size of this structure in bytes, set by bk_budget_init.
    pub struct_size: u32,
    /// Time in milliseconds, finite and >= 0; 0: no limit by time. Default: 4.
    pub milliseconds: f32,
    /// Rays; 0, the default: no limit by rays. A round of 64 that was begun is finished.
    pub rays: u64,
}

sized_struct!(bk_budget, defaults: bk_budget {
    struct_size: size_of::<bk_budget>() as u32,
    milliseconds: 4.0,
    rays: 0,
});

/// Fills in the defaults.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_budget_init(budget: *mut bk_budget) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(budget) }
}

/// What an update did, and how things stand.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_live_stats {
    /// Size of this structure in bytes, set by bk_live_stats_init.
    pub struct_size: u32,
    /// 1 while indirect light is being recomputed because a light has changed, else 0.
    pub light_pending: u32,
    /// Time that the update took.
    pub milliseconds: f32,
    /// Estimated relative error of indirect light where the camera looks.
    pub visible_error: f32,
    /// Part of the light map that is finished, 0 to 1.
    pub finished: f32,
    /// Part of what the camera sees that is finished, 0 to 1.
    pub visible_finished: f32,
    /// Rays traced by the update, and in the background since the one before.
    pub rays: u64,
    /// Rays traced since the beginning.
    pub total_rays: u64,
    /// Cells that went to a higher LOD (BK_LIVE_POSITION).
    pub cells_promoted: u32,
    /// Blocks of 8 x 8 texels of the gather map whose shown light changed.
    pub blocks_changed: u32,
    /// Bytes that the live object holds.
    pub bytes: u64,
    /// Bytes that it would hold with all LODs worked on everywhere.
    pub bytes_full: u64,
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
    }
}

/// Sets struct_size and clears the rest.
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
    /// LOD of what is to be read; of dirty rectangles always the highest: lod_count - 1.
    pub lod: u32,
    /// First column.
    pub x: u32,
    /// First row.
    pub y: u32,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

// SAFETY: repr(C), six u32 without padding, of which every value is valid.
unsafe impl bytemuck::Zeroable for bk_rect {}
// SAFETY: as above.
unsafe impl bytemuck::Pod for bk_rect {}

/// Where the cells of the light map grid lie.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_cell_info {
    /// Size of this structure in bytes, set by bk_cell_info_init.
    pub struct_size: u32,
    /// Cells along x, y and z.
    pub dimensions: [u32; 3],
    /// Lower corner of the first cell, in the scene.
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

/// Sets struct_size and clears the rest.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_cell_info_init(info: *mut bk_cell_info) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(info) }
}

/// Computes photons and the lowest LOD under the lights of now, on the device's threads: a second or
/// two for a large scene. All pages are dirty afterwards.
///
/// lightmap: its layout is used; it need not be baked, is not changed, and may be released. params:
/// NULL for the defaults. progress, user: told how far it is; NULL if not wanted. out: receives the live object,
/// NULL on failure.
///
/// Fails with BK_ERROR_OUT_OF_MEMORY if memory is not to be had or the memory callback refuses, and with
/// BK_ERROR_CANCELLED if progress says so; nothing is left behind then.
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

/// Counts one more reference. NULL is ignored.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_live_retain(live: *mut bk_live) {
    // SAFETY: a handle or NULL.
    unsafe { retain(live) }
}

/// Gives one reference back. NULL is ignored.
///
/// The last release stops work between updates and the recomputation of indirect light, and waits until both have
/// ended: no callback comes from them afterwards. It may be made in a callback, on any thread; only when it is made
/// in a memory callback that the recomputation of indirect light calls, that work ends just after the callback has
/// returned, and may call the memory callback once more for what it gives back. A thread that makes the last
/// release must not hold a lock that a callback takes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_live_release(live: *mut bk_live) {
    // SAFETY: a handle whose reference the caller gives up, or NULL.
    call_or((), || unsafe {
        release(live);
        Ok(())
    })
}

/// Refines the light for as long as the budget allows, on the device's threads.
///
/// camera: where somebody looks from; it may be inside walls or outside the scene. budget: NULL for
/// 4 ms. out: what was done; NULL if not wanted.
///
/// A camera with coordinates that are not finite, with no extent or field of view, or whose forward
/// and up are parallel, and a budget that is negative or not finite are refused
/// (BK_ERROR_INVALID_ARGUMENT). BK_ERROR_OUT_OF_MEMORY if memory is not to be had or the memory callback
/// refuses it, for a higher LOD or for indirect light that is being recomputed; what has been computed stays, and the
/// next update tries again.
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
        let budget = Budget { milliseconds: b.milliseconds, rays: b.rays };
        let done = live.change(|l| l.update(&camera, &budget))?;
        if let Some(out) = out {
            out.write(stats(&done));
        }
        Ok(())
    })
}

/// Fetches rectangles of texels whose shown light has changed since they were last fetched, merged
/// where that adds little. Texels around charts (padding) are included.
///
/// out: receives at most capacity rectangles; NULL if capacity is 0. count: receives how many. What
/// does not fit is kept for the next call: fetch until count < capacity.
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
            Ok(l.take_dirty(capacity).into_iter().map(rect).collect::<Vec<_>>())
        })?;
        out[..taken.len()].copy_from_slice(&taken);
        write(count, taken.len(), "count")
    })
}

/// Copies irradiance as shown, in W/m2, for a rectangle of a page.
///
/// lod: lod_count - 1 for what is shown; less: what would be shown if no texel were above that LOD
/// (slow: for comparison). format: BK_FORMAT_RGB32F or BK_FORMAT_RGBA16F, with BK_FORMAT_INDIRECT_ONLY
/// added or not. rect: x, y, width and height count, page and lod do not; NULL: the whole page. dst:
/// receives the rectangle's rows, row_stride bytes apart; needs no alignment. row_stride: at least
/// the bytes of a row; 0: just that many.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_live_read(
    live: *const bk_live,
    page: u32,
    lod: u32,
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
        let with_direct = format & BK_FORMAT_INDIRECT_ONLY == 0;
        let format = format & !BK_FORMAT_INDIRECT_ONLY;
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
            let texels = l.read(&rect, lod, with_direct)?;
            // SAFETY: the caller has room for the rectangle's rows, `stride` bytes apart.
            unsafe { copy_rgb(texels, format, rect.width as usize, dst, stride) }
        })
    })
}

/// The light map grid and the LOD that each of its cells shows, to be put into a 3D texture.
///
/// info: receives where the cells lie. out: receives one LOD per cell, x fastest, 255 in cells without
/// surfaces; NULL if capacity is 0 and only info is wanted. capacity: bytes that out has room for, at
/// least the number of cells unless 0.
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

/// The LOD that is shown at a position: three floats. BK_NONE outside the grid, in cells without
/// surfaces, and on failure.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_live_lod_at(live: *const bk_live, position: *const f32) -> u32 {
    call_or(BK_NONE, || {
        let live = object!(live);
        // SAFETY: the caller's position, or NULL.
        let position = unsafe { read_vec3(position, "position") }?;
        live.read(|l| Ok(l.lod_at(position).map_or(BK_NONE, u32::from)))
    })
}

/// To be called after bk_scene_set_light: direct light follows in the next
/// updates, first where the camera looks; photons are traced again on a thread of their own, and
/// indirect light follows as they come, the old fading out. Several changes may be followed by one
/// call.
///
/// light: number of a light that changed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_live_light_changed(live: *mut bk_live, light: u32) -> bk_result {
    // SAFETY: a handle, or NULL.
    call(|| unsafe { hold(live, "live") }?.change(|l| l.light_changed(light)))
}

/// Stops work between updates (background), and the recomputation of indirect light, or lets both go
/// on with the next update. Updates still do what their budget allows.
///
/// paused: 1 or 0.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_live_pause(live: *mut bk_live, paused: u32) -> bk_result {
    call(|| {
        // SAFETY: a handle, or NULL.
        let live = unsafe { hold(live, "live") }?;
        let paused = read_bool(paused, "paused")?;
        live.change(|l| l.pause(paused))
    })
}

/// Writes what has been accumulated to a file, to go on from another time; an existing file is
/// replaced once the new one is whole. Light that is older than the last change of a light is left
/// out.
///
/// path: UTF-8. progress, user: told how far it is; NULL if not wanted.
///
/// Fails with BK_ERROR_IO if the file cannot be written, and with BK_ERROR_CANCELLED if progress says so; an
/// existing file is as it was then, and the live object too.
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

/// Goes on from a file that was saved of the same scene, light map, lights and parameters (mode, cell
/// size, promotion, blur and limits may differ). All pages are dirty afterwards.
///
/// Every number of the file is checked to be one that updates could have arrived at: light is finite and >= 0, counts
/// fit the light map. For a moment the call needs memory for the light that is shown twice.
///
/// path: UTF-8. progress, user: told how far it is; NULL if not wanted.
///
/// Fails with BK_ERROR_IO if the file cannot be read or is damaged, with BK_ERROR_INVALID_ARGUMENT if it is of
/// something else, with BK_ERROR_OUT_OF_MEMORY if memory is not to be had or the memory callback refuses, and with
/// BK_ERROR_CANCELLED if progress says so; nothing is changed then.
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
