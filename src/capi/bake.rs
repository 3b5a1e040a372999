//! Baking
//!
//! A bake fills a light map with light: photons, radiance map, gather map (indirect light), direct
//! light, composition, stitching of seams. What the scene does not need is not run.

use super::args::{OutStruct, SizedStruct, init, read_bool, read_struct, sized_struct, slice_mut, text};
use super::device::{bk_progress_fn, progress, refuse_in_callback};
use super::error::{bk_result, call, call_or};
use super::handles::{hold, object};
use super::lightmap::bk_lightmap;
use crate::lightmap::plan::left_out;
use crate::lightmap::{BakeParams, BakeStats, CheckpointParams, StageStats};
use std::ffi::{c_char, c_void};

/// Bit of left_out. No indirect light: no photons, radiance map and gather map.
pub const BK_LEFT_OUT_INDIRECT: u32 = 1;
/// Bit of left_out. No photons and no estimate: no light is reflected more than once.
pub const BK_LEFT_OUT_PHOTONS: u32 = 2;
/// Bit of left_out. No direct light: nothing shines.
pub const BK_LEFT_OUT_DIRECT: u32 = 4;
/// Bit of left_out. No sampling of area lights.
pub const BK_LEFT_OUT_AREA_LIGHTS: u32 = 8;
/// Bit of left_out. No radiance of back sides.
pub const BK_LEFT_OUT_BACK_SIDES: u32 = 16;
/// Bit of left_out. No blur of the gather map.
pub const BK_LEFT_OUT_BLUR: u32 = 32;
/// Bit of left_out. No unwrapping: all meshes bring usable coordinates.
pub const BK_LEFT_OUT_UNWRAP: u32 = 64;
/// Bit of left_out. No interpolation of shading normals.
pub const BK_LEFT_OUT_SHADING_NORMALS: u32 = 128;
/// Bit of left_out. No look-ups of albedo textures.
pub const BK_LEFT_OUT_TEXTURES: u32 = 256;
/// Bit of left_out. No tests for holes that textures cut out.
pub const BK_LEFT_OUT_CUTOUTS: u32 = 512;
/// Bit of left_out. No light through surfaces.
pub const BK_LEFT_OUT_TRANSMISSION: u32 = 1024;
/// Bit of left_out. No light from a sky.
pub const BK_LEFT_OUT_SKY: u32 = 2048;
/// Bit of left_out. No directional light with an angular_radius.
pub const BK_LEFT_OUT_SUN_DISC: u32 = 4096;
/// Bit of left_out. No choice among many lights: at most 64 point and spot lights, each of which gets a
/// shadow ray, and at most 64 rect lights and emissive triangles. More of either are sampled, with up to 4
/// direct_samples shadow rays for all.
pub const BK_LEFT_OUT_MANY_LIGHTS: u32 = 8192;
/// Bit of left_out. No stitching of seams.
pub const BK_LEFT_OUT_SEAMS: u32 = 16384;
/// Bit of left_out. No bright patches of surfaces as lights: gather rays find most of what is bright.
pub const BK_LEFT_OUT_BRIGHT_PATCHES: u32 = 32768;

// The numbers are literal for the header's sake.
const _: () = assert!(
    BK_LEFT_OUT_INDIRECT == left_out::INDIRECT
        && BK_LEFT_OUT_PHOTONS == left_out::PHOTONS
        && BK_LEFT_OUT_DIRECT == left_out::DIRECT
        && BK_LEFT_OUT_AREA_LIGHTS == left_out::AREA_LIGHTS
        && BK_LEFT_OUT_BACK_SIDES == left_out::BACK_SIDES
        && BK_LEFT_OUT_BLUR == left_out::BLUR
        && BK_LEFT_OUT_UNWRAP == left_out::UNWRAP
        && BK_LEFT_OUT_SHADING_NORMALS == left_out::SHADING_NORMALS
        && BK_LEFT_OUT_TEXTURES == left_out::TEXTURES
        && BK_LEFT_OUT_CUTOUTS == left_out::CUTOUTS
        && BK_LEFT_OUT_TRANSMISSION == left_out::TRANSMISSION
        && BK_LEFT_OUT_SKY == left_out::SKY
        && BK_LEFT_OUT_SUN_DISC == left_out::SUN_DISC
        && BK_LEFT_OUT_MANY_LIGHTS == left_out::MANY_LIGHTS
        && BK_LEFT_OUT_SEAMS == left_out::SEAMS
        && BK_LEFT_OUT_BRIGHT_PATCHES == left_out::BRIGHT_PATCHES
);

/// How to bake.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_bake_params {
    /// Size of this structure in bytes, set by bk_bake_params_init.
    pub struct_size: u32,
    /// Most reflections of light before it reaches a texel; 0, the default: Russian roulette alone
    /// decides.
    pub max_bounces: u32,
    /// Photons to emit, at most 2^32; 0: no light that is reflected more than once. A sixteenth as many, at
    /// most 65,536, are traced before to find out where to send them. Default: 1,000,000.
    pub photon_count: u64,
    /// Rays per texel of the gather map, at most 65536; 0: no indirect light. With every 64 go up to 16
    /// shadow rays to bright patches of surfaces, where there are any (BK_LEFT_OUT_BRIGHT_PATCHES).
    /// Texels of the light map that no texel of the gather map around stands for (some 1 to 3 %) trace up to 16
    /// rays of their own. Default: 64.
    pub gather_rays: u32,
    /// Photon search radius in scene units, finite and at least 1.2e-38; 0, the default: from the number of photons that
    /// reach surfaces and the lit area, and at least three quarters of a texel of the radiance map, so that no photon
    /// lies between the places where light is estimated. Photons that are not seen from the middle of their disc, as
    /// those behind a wall, do not count, and neither does the surface there.
    pub radius: f32,
    /// Radius of the gather map's blur in its texels, at most 16; 0: none. Default: 2.
    pub blur_radius: u32,
    /// Shadow rays per light map texel and area light or disc of a directional light, 1 to 4096 (of
    /// more than four area lights, four times as many rays are shared out); four times as many per sky,
    /// and for all of many lights (BK_LEFT_OUT_MANY_LIGHTS). They start from 4 points spread over the
    /// texel, or from 16 in the penumbra of a disc. Point, spot and parallel lights take one ray each, and
    /// 4 to 16 more, spread over the texel, where shadow edges cross it. Default: 16.
    pub direct_samples: u32,
    /// Seed of all random numbers. The same seed gives the same bits on any number of threads.
    /// Default: 0.
    pub seed: u64,
    /// Bytes that the bake may take in addition to scene and light map; 0, the default: no limit.
    pub memory_budget: u64,
    /// First covered texel to bake, for spreading a bake over several runs, at most the number of
    /// texels that bk_lightmap_info tells. Default: 0.
    pub texel_begin: u64,
    /// One behind the last covered texel to bake, above texel_begin and at most the number of texels;
    /// 0, the default: all.
    pub texel_end: u64,
    /// Whether seams are stitched: where a smooth surface is cut open in the light map, both sides of
    /// the edge are made to show the same under bilinear filtering, by moving the texels that the edge
    /// shows and no others. Done when all texels are baked. 0: no, any other value: yes. Live updates
    /// do not stitch: their finished texels have the bits of a bake with 0. Default: 1.
    pub stitch: u32,
    /// Seconds between two writes of the checkpoint, 0 to 1e9. A process that is killed loses at most the
    /// work of so long; 0: of the blocks of texels under way. Default: 10.
    pub checkpoint_seconds: f32,
    /// Name of a file, UTF-8, in which the bake keeps what it has done; NULL, the default: none. A bake with the
    /// same scene, lights, light map and parameters that finds the file goes on from it, whatever ended
    /// the one before (a cancel, an error, a kill), and gives the bits of a bake without a break, on any
    /// number of threads. The file is created if it is not there. It stays when the bake is complete:
    /// delete it when the light has been saved. bk_bake fails with BK_ERROR_INVALID_ARGUMENT if the file is of
    /// another bake (bk_last_error says in what it differs), with BK_ERROR_IO if it is damaged, is not a checkpoint or
    /// cannot be read or created, with BK_ERROR_INVALID_STATE if another bake is using it, and leaves it as it is. If it
    /// cannot be written later, as on a full disk, the bake goes on, logs a warning, and what the file
    /// holds stays whole.
    pub checkpoint: *const c_char,
}

sized_struct!(bk_bake_params, defaults: {
    let p = BakeParams::default();
    bk_bake_params {
        struct_size: size_of::<bk_bake_params>() as u32,
        max_bounces: p.max_bounces,
        photon_count: p.photon_count,
        gather_rays: p.gather_rays,
        radius: p.radius,
        blur_radius: p.blur_radius,
        direct_samples: p.direct_samples,
        seed: p.seed,
        memory_budget: p.memory_budget,
        texel_begin: p.texel_begin,
        texel_end: p.texel_end,
        stitch: p.stitch as u32,
        checkpoint_seconds: CheckpointParams::new("").seconds as f32,
        checkpoint: std::ptr::null(),
    }
});

/// Fills in the defaults.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_bake_params_init(params: *mut bk_bake_params) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(params) }
}

/// What one stage of a bake took.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_stage_stats {
    /// Time, in seconds.
    pub seconds: f64,
    /// Rays traced.
    pub rays: u64,
    /// Bytes of its buffers.
    pub bytes: u64,
}

/// What a bake did.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_bake_stats {
    /// Size of this structure in bytes, set by bk_bake_stats_init.
    pub struct_size: u32,
    /// BK_LEFT_OUT bits: what the plan found unnecessary.
    pub left_out: u32,
    /// Time of the whole bake, in seconds.
    pub seconds: f64,
    /// The most bytes held at once on the device, scene and light map included.
    pub peak_bytes: u64,
    /// Photons emitted.
    pub photons_emitted: u64,
    /// Photons stored on surfaces.
    pub photons_stored: u64,
    /// Tracing and sorting photons.
    pub photons: bk_stage_stats,
    /// The radiance map: outgoing radiance from the photons.
    pub radiance: bk_stage_stats,
    /// The gather map: indirect light.
    pub gather: bk_stage_stats,
    /// Direct light with shadow rays.
    pub direct: bk_stage_stats,
    /// Filtering and composition.
    pub compose: bk_stage_stats,
    /// Two-sided charts whose light map shows the back, because the distance that one sees from it
    /// times the cube root of its light is more than twice that of the front.
    pub back_charts: u64,
    /// Points, half a texel apart at most, along the edges that were stitched.
    pub seam_points: u64,
    /// How much the two sides of these edges showed different light under bilinear filtering: root mean
    /// square over the edges' lengths, relative to the mean irradiance there. 0 without seams.
    pub seam_rms_before: f64,
    /// The same after the stitching.
    pub seam_rms_after: f64,
    /// Finding and stitching seams, in seconds.
    pub seam_seconds: f64,
}

sized_struct!(bk_bake_stats, defaults: stats(&Default::default()));

fn stats(s: &BakeStats) -> bk_bake_stats {
    let stage = |s: &StageStats| bk_stage_stats { seconds: s.seconds, rays: s.rays, bytes: s.bytes };
    bk_bake_stats {
        struct_size: size_of::<bk_bake_stats>() as u32,
        left_out: s.left_out,
        seconds: s.seconds,
        peak_bytes: s.peak_bytes,
        photons_emitted: s.photons_emitted,
        photons_stored: s.photons_stored,
        photons: stage(&s.photons),
        radiance: stage(&s.radiance),
        gather: stage(&s.gather),
        direct: stage(&s.direct),
        compose: stage(&s.compose),
        back_charts: s.back_charts,
        seam_points: s.seam_points,
        seam_rms_before: s.seam_rms_before,
        seam_rms_after: s.seam_rms_after,
        seam_seconds: s.seam_seconds,
    }
}

/// Sets struct_size and clears the rest.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_bake_stats_init(stats: *mut bk_bake_stats) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(stats) }
}

/// Computes the light of all texels, or of the given range, on the device's threads. May be called
/// again, with other lights or parameters.
///
/// params: NULL for the defaults. progress, user: told how far it is; NULL if not wanted. out: what
/// was done; NULL if not wanted.
///
/// The same scene, lights, light map, parameters and seed give the same bits on any number of threads, in one
/// bake or in several of some texels each, and on AVX2 as on AVX-512; portable kernels, which round products and sums
/// apart, give others.
///
/// All light is finite and >= 0: irradiance is cut off at 1e30 W/m2 per light.
///
/// Fails with BK_ERROR_INVALID_ARGUMENT if a field of params is out of its range,
/// BK_ERROR_INVALID_STATE if another call is using the light map, BK_ERROR_OUT_OF_MEMORY if
/// memory_budget is exceeded or the memory callback refuses, BK_ERROR_CANCELLED if progress says so. A
/// bake that fails or is cancelled keeps what was baked before, and can be repeated.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_bake(
    lightmap: *mut bk_lightmap,
    params: *const bk_bake_params,
    progress: bk_progress_fn,
    user: *mut c_void,
    out: *mut bk_bake_stats,
) -> bk_result {
    // SAFETY: params and out are the caller's, or NULL.
    call(|| unsafe {
        refuse_in_callback()?;
        let lightmap = hold(lightmap, "lightmap")?;
        let p: bk_bake_params = if params.is_null() { SizedStruct::defaults() } else { read_struct(params, "params")? };
        let out = OutStruct::optional(out, "out")?;
        let params = BakeParams {
            photon_count: p.photon_count,
            max_bounces: p.max_bounces,
            gather_rays: p.gather_rays,
            radius: p.radius,
            blur_radius: p.blur_radius,
            direct_samples: p.direct_samples,
            seed: p.seed,
            memory_budget: p.memory_budget,
            texel_begin: p.texel_begin,
            texel_end: p.texel_end,
            stitch: read_bool(p.stitch, "stitch")?,
        };
        let checkpoint = match p.checkpoint.is_null() {
            true => None,
            false => Some(CheckpointParams {
                path: text(p.checkpoint, "checkpoint")?.into(),
                seconds: p.checkpoint_seconds.into(),
            }),
        };
        let progress = self::progress(progress, user);
        let done = lightmap.change(|l| l.bake_with(&params, checkpoint.as_ref(), &progress))?;
        if let Some(out) = out {
            out.write(stats(&done));
        }
        Ok(())
    })
}

/// Describes in words what the last bake ran (before the first: what a bake with default parameters
/// would run), and what it left out and why, one line each.
///
/// dst: receives as much of the text (UTF-8) as fits, with a NUL; may be NULL if capacity is 0.
/// capacity: bytes that dst has room for.
///
/// Returns the length of the whole text without its NUL, whatever the capacity; 0 on failure.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_plan_describe(lightmap: *const bk_lightmap, dst: *mut c_char, capacity: usize) -> usize {
    // SAFETY: dst is the caller's, or NULL.
    call_or(0, || unsafe {
        let plan = object!(lightmap).read(|l| Ok(l.plan_text()))?;
        let dst = slice_mut(dst.cast::<u8>(), capacity, "dst", &[])?;
        if let Some(room) = capacity.checked_sub(1) {
            let fits = (0..=room.min(plan.len())).rev().find(|&i| plan.is_char_boundary(i)).unwrap_or(0);
            dst[..fits].copy_from_slice(&plan.as_bytes()[..fits]);
            dst[fits] = 0;
        }
        Ok(plan.len())
    })
}
