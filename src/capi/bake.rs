//! Baking
//!
//! A bake computes the light of a light map in stages: photons, radiance map, gather map (indirect
//! light), direct light, composition, stitching of seams. Stages that the scene does not need are
//! left out.
//!
//! Thread safety: one thread at a time may bake a light map; a second one fails with
//! BK_ERROR_INVALID_STATE.
//!
//! Cost: see bk_bake; the other functions take microseconds at most.

use super::args::{OutStruct, SizedStruct, init, read_bool, read_struct, sized_struct, slice_mut, text};
use super::device::{bk_progress_fn, progress, refuse_in_callback};
use super::error::{bk_result, call, call_or};
use super::handles::{hold, object};
use super::lightmap::{bk_lightmap, bk_lightmap_desc};
use crate::base::error::{Result, invalid_argument};
use crate::lightmap::plan::left_out;
use crate::lightmap::quality::Quality;
use crate::lightmap::{
    BakeParams, BakeStats, CheckpointParams, Lightmap, LightmapDesc, ShareParams, ShareStage, StageStats, directional,
};
use std::ffi::{c_char, c_void};
use std::sync::Arc;

/// Bit of left_out: indirect light with photons, radiance map and gather map.
pub const BK_LEFT_OUT_INDIRECT: u32 = 1;
/// Bit of left_out: photons and their estimate, so that no light is reflected more than once.
pub const BK_LEFT_OUT_PHOTONS: u32 = 2;
/// Bit of left_out: direct light, as the scene has no lights.
pub const BK_LEFT_OUT_DIRECT: u32 = 4;
/// Bit of left_out: sampling of area lights.
pub const BK_LEFT_OUT_AREA_LIGHTS: u32 = 8;
/// Bit of left_out: radiance of back sides.
pub const BK_LEFT_OUT_BACK_SIDES: u32 = 16;
/// Bit of left_out: blur of the gather map.
pub const BK_LEFT_OUT_BLUR: u32 = 32;
/// Bit of left_out: unwrapping, as all meshes have usable light map coordinates.
pub const BK_LEFT_OUT_UNWRAP: u32 = 64;
/// Bit of left_out: interpolation of shading normals.
pub const BK_LEFT_OUT_SHADING_NORMALS: u32 = 128;
/// Bit of left_out: look-ups of albedo textures.
pub const BK_LEFT_OUT_TEXTURES: u32 = 256;
/// Bit of left_out: alpha tests.
pub const BK_LEFT_OUT_CUTOUTS: u32 = 512;
/// Bit of left_out: light that passes through surfaces.
pub const BK_LEFT_OUT_TRANSMISSION: u32 = 1024;
/// Bit of left_out: light of skies.
pub const BK_LEFT_OUT_SKY: u32 = 2048;
/// Bit of left_out: discs of directional lights.
pub const BK_LEFT_OUT_SUN_DISC: u32 = 4096;
/// Bit of left_out: sampling of many lights, as there are at most 64 point and spot lights, each of
/// which gets a shadow ray, and at most 64 rect lights and emissive triangles. More of either kind
/// are sampled with up to 4 times bk_bake_params.direct_samples shadow rays for all of them.
pub const BK_LEFT_OUT_MANY_LIGHTS: u32 = 8192;
/// Bit of left_out: stitching of seams.
pub const BK_LEFT_OUT_SEAMS: u32 = 16384;
/// Bit of left_out: sampling of bright patches of surfaces as lights, as gather rays find most of
/// them.
pub const BK_LEFT_OUT_BRIGHT_PATCHES: u32 = 32768;
/// Bit of left_out: light by direction, as bk_bake_params.directional_indirect and directional_direct
/// are 0.
pub const BK_LEFT_OUT_DIRECTIONAL: u32 = 65536;

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
        && BK_LEFT_OUT_DIRECTIONAL == left_out::DIRECTIONAL
);

/// Parameters of bk_bake.
///
/// Measured curves of these fields: docs/accuracy.md, "Which knobs have a curve".
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_bake_params {
    /// Size of this structure in bytes, set by bk_bake_params_init.
    pub struct_size: u32,
    /// Maximum number of reflections of light before it reaches a texel; 0: Russian roulette alone
    /// decides. Leave it at 0: a limit saves little time and darkens closed bright rooms (with 4,
    /// the indirect light of the Cornell box is 9 % too low). Default: 0.
    pub max_bounces: u32,
    /// Number of photons to emit, at most 2^32; 0: no light that is reflected more than once. A
    /// pilot of up to 3/16 as many, at most 196,608, finds out beforehand where to send them. Raise
    /// it against blotches that are the same with every number of gather rays; time and memory of
    /// the photons grow in proportion, and beyond 1,000,000 the error fell by a tenth in the
    /// Cornell box. Default: 1,000,000.
    pub photon_count: u64,
    /// Number of rays per texel of the gather map, at most 65536; 0: no indirect light. Each 64
    /// rays are accompanied by up to 32 shadow rays to bright patches of surfaces, where there are
    /// any (BK_LEFT_OUT_BRIGHT_PATCHES). Light map texels for which none of the gather texels
    /// around is a valid source of interpolation (1 to 3 %), and those beyond
    /// `interpolation_error` or `interpolation_contrast`, trace `own_rays` themselves.
    /// Raise it to 256 for final light: noise falls with its root, the time of the gather map grows
    /// in proportion; 32 suffice for a preview. Default: 128.
    pub gather_rays: u32,
    /// Search radius of photons in scene units, finite and at least 1.2e-38; 0: from the number of
    /// photons that reach surfaces and the lit area, and at least three quarters of a texel of the
    /// radiance map, so that no photon lies between the discs of the estimates. Photons (and area
    /// of the disc) that are occluded from the centre of the disc, for example behind a wall, are
    /// excluded from the estimate. Leave it at 0; a larger radius has less noise, takes more time
    /// per estimate, and blurs the light behind furniture; half of the automatic one has 1.5 times
    /// the error in the Cornell box. Default: 0.
    pub radius: f32,
    /// Distance, in texels of the radiance map, up to which the light reflected where a gather ray
    /// hits is computed by a short path instead of looked up, 0 to infinity; 0: never. Set it to 1 for
    /// final light, where corners, gaps behind furniture and contacts matter: a fifth to a half more
    /// time. INFINITY traces paths from every hit, where `photon_count` may be 0: nothing but surfaces
    /// behind sheets that transmit is looked up in the radiance map, and the error falls as long as
    /// `gather_rays` are raised, from several times the noise. Default: 0.
    pub near_hits: f32,
    /// Radius of the gather map's blur in texels of the gather map, at most 16; 0: no blur. Lower
    /// it to 1 or 0, with more gather rays, where contact shadows matter; it costs little time. 4
    /// blurs more than it smooths. With 0 the noise of direct light from skies, area lights and many
    /// lights stays, too, which is averaged over up to 9 × 9 texels of the light map otherwise, as
    /// far as they differ by no more than noise. Default: 2.
    pub blur_radius: u32,
    /// Number of shadow rays per light map texel and area light or disc of a directional light, 1
    /// to 4096. More than four area lights share four times as many rays; a sky takes four times as
    /// many, and many lights together do (BK_LEFT_OUT_MANY_LIGHTS). The rays start from 4 points of
    /// the texel, or from 16 in the penumbra of a disc. Point, spot and parallel lights take one
    /// ray each, and 4 to 16 more, spread over the texel, where shadow edges cross it. Raise it to
    /// 64 where soft shadows are grainy; the time of direct light of area lights, discs and skies
    /// grows in proportion. Default: 16.
    pub direct_samples: u32,
    /// Seed of all random numbers. The same seed gives the same bits on any number of threads.
    /// Change it to see which part of an error is noise; it costs nothing. Default: 0.
    pub seed: u64,
    /// Limit in bytes of the memory that the bake takes in addition to scene and light map; 0: no
    /// limit. Set it where a failed call is better than a full machine; coarser maps and fewer
    /// photons take less. Default: 0.
    pub memory_budget: u64,
    /// Number of the first covered texel to bake, to spread a bake over several runs; at most
    /// bk_lightmap_info.texels. Ranges share out the gather map and direct light only: each run
    /// traces all photons and fills the whole radiance map. Default: 0.
    pub texel_begin: u64,
    /// Number of the covered texel behind the last one to bake, above `texel_begin` and at most
    /// bk_lightmap_info.texels; 0: all. See `texel_begin`. Default: 0.
    pub texel_end: u64,
    /// 1: stitch seams. Where a smooth surface is cut in the light map, the texels along the edge
    /// are changed so that both sides look the same under bilinear filtering, but for points where
    /// the texels of both sides face more than 30 degrees apart or have light that differs by more
    /// than a factor of 4. Seams are stitched when all texels are baked. Live updates do not
    /// stitch: their finished texels have the bits of a bake with 0. 0: leave seams as they are.
    /// Set it to 0 where results are compared with live updates or seams do not matter; it takes
    /// bk_bake_stats.seam_seconds. Default: 1.
    pub stitch: u32,
    /// Experimental: interval in seconds between two writes of the checkpoint, 0 to 1e9. A process
    /// that is killed loses at most the work of this interval; with 0, that of the blocks of texels
    /// under way. Lower it where machines are taken away without notice; flushes to disk never take
    /// more than a hundredth of the time. Default: 10.
    pub checkpoint_seconds: f32,
    /// Experimental: name of the checkpoint, a file in which the bake keeps finished work; UTF-8.
    /// May be NULL: no checkpoint. Default: NULL.
    ///
    /// A bake with the same scene, lights, light map and parameters that finds the file continues
    /// from it, whether the bake before was cancelled, failed or was killed, and gives the bits of
    /// an uninterrupted bake, on any number of threads. The file is created if it does not exist
    /// and stays when the bake is complete: delete it when the light has been saved. If the file
    /// cannot be written later, for example because the disk is full, the bake continues and logs a
    /// warning, and the file stays readable. See bk_bake for errors, which leave the file as it is.
    pub checkpoint: *const c_char,
    /// 1: compute light that was reflected by other surfaces by direction too (SH L1), for surfaces
    /// with normal maps. Reading starts at BK_LAYER_L0. It comes from the same rays; in memory it
    /// takes 48 bytes per texel of the light map, and during the bake 96 per texel of the gather
    /// map. bk_live_params has the same fields. Default: 0.
    pub directional_indirect: u32,
    /// 1: the same for light that comes straight from lights, for 48 bytes more per texel of the light
    /// map during the bake. With both, the layers hold the sum.
    /// Set only `directional_indirect` where the application draws the lights itself. Default: 0.
    pub directional_direct: u32,
    /// Number of passes, 1 to 4096: whole bakes with different random numbers, whose mean is the
    /// light. n of them take n times as long and have 1/n of the noise's variance, that of photons
    /// included. From two on, BK_LAYER_ERROR and bk_bake_stats.error estimate the noise that is
    /// left, and light can be read from two halves of the passes, for denoisers
    /// (BK_LAYER_FIRST_HALF). The bake takes 61 bytes more per texel of the light map, 36 of which
    /// stay. A checkpoint grows with each pass. Default: 1.
    pub passes: u32,
    /// If > 0, there are as many passes as it takes, at least 4 and `passes` and at most 4096, until
    /// bk_bake_stats.error is no larger; for bakes of all texels only. 0.05 is a good preview, 0.01
    /// is hard to see. Errors by blur and coarse maps are not noise and stay: see near_hits,
    /// blur_radius and bk_lightmap_desc.gather_divisor, or bk_quality_set. Default: 0.
    pub target_error: f32,
    /// Estimated error of interpolation between texels of the gather map above which texels of the
    /// light map trace rays themselves, as in corners, behind furniture and under arches; > 0,
    /// INFINITY: only where there is nothing to interpolate. It is the width of a gather texel by
    /// the harmonic mean distance of the surfaces that it sees, plus 4 times the root of 1 − cos of
    /// the angle between normals (after Ward, Rubinstein and Clear 1988), plus, outside of gaps
    /// narrower than a gather texel, 3 times the distance, in widths of a gather texel, between the
    /// texel and the mean position of the gather texels that nothing hides from it. Light that is
    /// gathered because of this distance alone counts only as far as it differs from the interpolated one
    /// by more than noise, unless interpolation_contrast is INFINITY. 0.5 for final light;
    /// INFINITY for a preview, or where a scene is open and flat. 1 halves the error of a furnished
    /// room for a tenth more time, and takes up to a quarter more elsewhere: docs/accuracy.md,
    /// "Interpolation error". Default: 1.5.
    pub interpolation_error: f32,
    /// Contrast of the light of the texels of the gather map between which a texel of the light map
    /// interpolates, above which it traces rays itself, as at the edges of sunlit spots and of
    /// shadows of indirect light; > 0, INFINITY: never, as for a preview. It is the standard deviation
    /// of their light divided by their mean, without the part that their noise explains. The light that
    /// such a texel gathers counts as far as it differs from the interpolated one by more than noise:
    /// docs/accuracy.md, "Interpolation contrast". Default: 0.15.
    pub interpolation_contrast: f32,
    /// Number of rays of texels of the light map that trace rays themselves, at most 64, and no more
    /// than `gather_rays`; 0: as many as `gather_rays`, at most 64. Those with few others beside them
    /// have twice as many, within the same limits. With 16 a bake takes 2 to 10 % less time, for up to
    /// 29 % more error: docs/accuracy.md, "Rays of texels that gather for themselves". Default: 0.
    pub own_rays: u32,
    /// Number of shares of bk_bake_share, 1 to 65,536; not read if `shares` is NULL. Default: 0.
    pub share_count: u32,
    /// Experimental: beginning of the names of the files that bk_bake_share writes, for example "out/"
    /// for files in the folder out, which must exist; UTF-8. bk_bake then neither traces photons nor
    /// fills the radiance map, but reads the radiance map of all shares from their files, and
    /// photons and the radiance map of bk_bake_stats are without rays of the shares. May be NULL:
    /// there are no shares. Default: NULL.
    pub shares: *const c_char,
}

sized_struct!(bk_bake_params, defaults: {
    let p = BakeParams::default();
    bk_bake_params {
        struct_size: size_of::<bk_bake_params>() as u32,
        max_bounces: p.max_bounces,
        photon_count: p.photon_count,
        gather_rays: p.gather_rays,
        radius: p.radius,
        near_hits: p.near_hits,
        interpolation_error: p.interpolation_error,
        interpolation_contrast: p.interpolation_contrast,
        own_rays: p.own_rays,
        blur_radius: p.blur_radius,
        direct_samples: p.direct_samples,
        seed: p.seed,
        memory_budget: p.memory_budget,
        texel_begin: p.texel_begin,
        texel_end: p.texel_end,
        stitch: p.stitch as u32,
        checkpoint_seconds: CheckpointParams::new("").seconds as f32,
        checkpoint: std::ptr::null(),
        directional_indirect: p.directional & directional::INDIRECT,
        directional_direct: (p.directional & directional::DIRECT != 0) as u32,
        passes: p.passes,
        target_error: p.target_error,
        share_count: 0,
        shares: std::ptr::null(),
    }
});

/// Sets `struct_size` and fills in the defaults.
///
/// @param params  structure to fill in; NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_bake_params_init(params: *mut bk_bake_params) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(params) }
}

/// Quality: a look within a fraction of the default's time. Indirect light is coarse, penumbrae are
/// noisy.
pub const BK_QUALITY_PREVIEW: u32 = 0;
/// Quality: the defaults.
pub const BK_QUALITY_MEDIUM: u32 = 1;
/// Quality: final light. Finer maps; corners, gaps and contacts are computed instead of looked up.
pub const BK_QUALITY_HIGH: u32 = 2;
/// Quality: paths from every texel, without blur, in 4 passes, to compare others with. No error of
/// it stays if `passes` is raised or `target_error` set.
pub const BK_QUALITY_REFERENCE: u32 = 3;

/// Sets the fields that trade error for time to those of a quality, and leaves all others: density,
/// seed, budget and so on. Measured error and time: docs/accuracy.md, "Qualities".
///
/// bk_lightmap_desc: `gather_divisor`, `radiance_divisor`. bk_bake_params: `photon_count`,
/// `gather_rays`, `near_hits`, `interpolation_error`, `interpolation_contrast`, `blur_radius`,
/// `direct_samples`, `passes`.
///
/// @param quality  one of the BK_QUALITY values
/// @param desc  structure that bk_lightmap_desc_init has filled in; may be NULL
/// @param params  structure that bk_bake_params_init has filled in; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  there is no such quality, or a `struct_size` is wrong; nothing
///   is set
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_quality_set(
    quality: u32,
    desc: *mut bk_lightmap_desc,
    params: *mut bk_bake_params,
) -> bk_result {
    // SAFETY: the structures are the caller's, or NULL.
    call(|| unsafe {
        let Some(&(quality, _)) = Quality::ALL.get(quality as usize) else {
            return invalid_argument!("quality is {quality}, not one of the BK_QUALITY values");
        };
        let (desc_out, params_out) = (OutStruct::optional(desc, "desc")?, OutStruct::optional(params, "params")?);
        if let Some(out) = desc_out {
            let (mut d, mut new) = (read_struct(desc, "desc")?, LightmapDesc::default());
            quality.set_desc(&mut new);
            (d.gather_divisor, d.radiance_divisor) = (new.gather_divisor, new.radiance_divisor);
            out.write(d);
        }
        if let Some(out) = params_out {
            let (mut p, mut new) = (read_struct(params, "params")?, BakeParams::default());
            quality.set_params(&mut new);
            p.photon_count = new.photon_count;
            p.gather_rays = new.gather_rays;
            p.near_hits = new.near_hits;
            p.interpolation_error = new.interpolation_error;
            p.interpolation_contrast = new.interpolation_contrast;
            p.blur_radius = new.blur_radius;
            p.direct_samples = new.direct_samples;
            p.passes = new.passes;
            out.write(p);
        }
        Ok(())
    })
}

/// Numbers about one stage of a bake.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_stage_stats {
    /// Duration in seconds.
    pub seconds: f64,
    /// Number of rays traced.
    pub rays: u64,
    /// Size of the stage's buffers in bytes.
    pub bytes: u64,
}

/// Numbers about a bake.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_bake_stats {
    /// Size of this structure in bytes, set by bk_bake_stats_init.
    pub struct_size: u32,
    /// BK_LEFT_OUT bits: work that the scene does not need.
    pub left_out: u32,
    /// Duration of the whole bake in seconds.
    pub seconds: f64,
    /// Maximum of the memory that the device's objects held at once, in bytes, scene and light map
    /// included.
    pub peak_bytes: u64,
    /// Number of photons emitted.
    pub photons_emitted: u64,
    /// Number of photons stored on surfaces.
    pub photons_stored: u64,
    /// Tracing and sorting of photons.
    pub photons: bk_stage_stats,
    /// Radiance map: outgoing radiance from photons and direct light.
    pub radiance: bk_stage_stats,
    /// Gather map: indirect light.
    pub gather: bk_stage_stats,
    /// Direct light with shadow rays.
    pub direct: bk_stage_stats,
    /// Filtering and composition.
    pub compose: bk_stage_stats,
    /// Number of two-sided charts whose texels show the back, because the distance that is seen
    /// from it times the cube root of its light is more than twice that of the front.
    pub back_charts: u64,
    /// Number of points along stitched edges, at most half a texel apart.
    pub seam_points: u64,
    /// Difference of light between the two sides of stitched edges under bilinear filtering, before
    /// the stitching: root mean square over the length of the edges, relative to the mean
    /// irradiance there. 0 without seams.
    pub seam_rms_before: f64,
    /// The same relative difference after the stitching.
    pub seam_rms_after: f64,
    /// Duration of finding and stitching seams, in seconds.
    pub seam_seconds: f64,
    /// Estimated relative error of the irradiance, as far as it is noise: the root of the mean over
    /// texels and channels of its variance by its square; texels darker than a tenth of the mean
    /// count as if they were so bright. 0 after a single pass, which gives no estimate.
    pub error: f64,
    /// Number of passes. Seconds, rays and photons above are sums over them.
    pub passes: u64,
    /// Number of texels that kept all of their light; 0 unless bk_bake_changed or
    /// bk_bake_changed_from baked.
    pub kept_texels: u64,
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
        error: s.error,
        passes: s.passes.into(),
        kept_texels: s.kept_texels,
    }
}

/// Sets `struct_size` and clears the other fields.
///
/// @param stats  structure to fill in; NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_bake_stats_init(stats: *mut bk_bake_stats) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(stats) }
}

/// Returns the bits of [`directional`] that two fields ask for.
pub(super) fn read_directional(indirect: u32, direct: u32) -> Result<u32> {
    let bit = |asks: bool, bit| if asks { bit } else { 0 };
    Ok(bit(read_bool(indirect, "directional_indirect")?, directional::INDIRECT)
        | bit(read_bool(direct, "directional_direct")?, directional::DIRECT))
}

/// Bakes a light map: computes the light of all texels, or of a range, on the device's threads.
///
/// Can be called again, with other lights or parameters. The same scene, lights, light map,
/// parameters and seed give the same bits on any number of threads, in one bake or in several of
/// some texels each, and on AVX2 and AVX-512; the portable kernels, which round products and sums
/// separately, give others. All light is finite and >= 0: the irradiance of each light is clamped
/// to 1e30 W/m2. A bake that fails or is cancelled keeps the light of earlier bakes, and can be
/// repeated.
///
/// Cost: seconds to hours, in proportion to the number of texels, `gather_rays` and
/// `direct_samples`.
///
/// @param lightmap  any light map
/// @param params  parameters; NULL for the defaults
/// @param progress,user  progress callback and its pointer; may be NULL
/// @param out  receives numbers about the bake; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  a field of `params` is out of its range, or the checkpoint or a
///   share is of another bake; bk_last_error says in which respect
/// @retval BK_ERROR_INVALID_STATE  another call is using the light map, or another bake the
///   checkpoint
/// @retval BK_ERROR_OUT_OF_MEMORY  `memory_budget` is exceeded or the memory callback refuses
/// @retval BK_ERROR_IO  the checkpoint or a share is damaged, is another kind of file, or cannot be
///   read, or the checkpoint cannot be created
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
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
        let (params, checkpoint, shares) = core_params(params)?;
        let out = OutStruct::optional(out, "out")?;
        let progress = self::progress(progress, user);
        let bake = |l: &mut Lightmap| l.bake_with_shares(&params, shares.as_ref(), checkpoint.as_ref(), &progress);
        let done = lightmap.change(bake)?;
        if let Some(out) = out {
            out.write(stats(&done));
        }
        Ok(())
    })
}

/// Bakes a light map again where its light has changed, after lights were set (bk_scene_set_light)
/// or the scene has moved (bk_lightmap_follow).
///
/// Photons are traced again; texels of the radiance map that they and lamps reach as before keep
/// their radiance. Indirect light is computed again around moved
/// surfaces, and where probes find it changed: rays from one or two texels of every 8 x 8 texels of
/// the gather map, traced in the scene before and after. Direct light is computed again where a
/// moved surface lies, or lay, in the way to a light, and everywhere if a light was set or an
/// emissive surface moved. These texels get the light that bk_bake gives them, and its bits if
/// `keep_error` is 0; the others keep their light. If there is no light yet, or the last bake had
/// other parameters, everything is baked. bk_bake_stats.kept_texels and bk_plan_describe report how
/// much was kept.
///
/// Each call may leave an error of `keep_error`, and these errors add up: use bk_bake for final
/// light. With several passes, `keep_error` below the noise of one pass's photons keeps little, and
/// the radiance map is made anew.
///
/// Cost: photons and seams as in a bake; of the other stages the part that changed.
/// Measured: docs/performance.md, "Edits".
///
/// @param lightmap  any light map
/// @param params  parameters of the last bake, without a range of texels, checkpoint, shares and
///   target_error; NULL for the defaults
/// @param keep_error  change of light below which texels keep it, as a fraction of their irradiance
///   or, if that is more, of a tenth of the mean irradiance; finite, >= 0. 0.03 is hard to see.
///   Texels of the radiance map keep their radiance by the same measure, unless it is 0
/// @param progress,user  progress callback and its pointer; may be NULL
/// @param out  receives numbers about the bake; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  `keep_error` or a field of `params` is out of its range
/// @retval BK_ERROR_INVALID_STATE  another call is using the light map
/// @retval BK_ERROR_OUT_OF_MEMORY  `memory_budget` is exceeded or the memory callback refuses
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_bake_changed(
    lightmap: *mut bk_lightmap,
    params: *const bk_bake_params,
    keep_error: f32,
    progress: bk_progress_fn,
    user: *mut c_void,
    out: *mut bk_bake_stats,
) -> bk_result {
    // SAFETY: params and out are the caller's, or NULL.
    call(|| unsafe {
        refuse_in_callback()?;
        let lightmap = hold(lightmap, "lightmap")?;
        let params = params_of_changes(params, "bk_bake_changed")?;
        let out = OutStruct::optional(out, "out")?;
        let progress = self::progress(progress, user);
        let done = lightmap.change(|l| l.bake_changed(&params, keep_error, &progress))?;
        if let Some(out) = out {
            out.write(stats(&done));
        }
        Ok(())
    })
}

/// Reads the parameters of a bake of changes by a `function` of that name, which has neither a checkpoint nor shares.
///
/// # Safety
/// As for [`core_params`].
unsafe fn params_of_changes(params: *const bk_bake_params, function: &str) -> Result<BakeParams> {
    // SAFETY: forwarded.
    let (params, checkpoint, shares) = unsafe { core_params(params)? };
    if checkpoint.is_some() || shares.is_some() {
        return invalid_argument!("checkpoint or shares is not NULL: {function} has none");
    }
    Ok(params)
}

/// Bakes a light map and keeps light of an earlier one, of a scene of which this one's is a
/// revision: after meshes were added, removed, edited, or given other materials.
///
/// The new scene is described and committed like any other, and its light map made with the
/// `texels_per_unit` (not 0), divisors and other fields of the earlier one, so that surfaces which
/// both scenes have are given the same texels. Surfaces are matched by content and place: whole
/// objects first, then single triangles of the others; where a mesh stands in the description does
/// not matter. Light is compared and
/// baked as bk_bake_changed does it; surfaces that only one of the scenes has count as moved. Light
/// that the light map already has is replaced. If the earlier light map has no light, was baked with
/// other parameters or has no surface in common with this one, everything is baked.
///
/// Errors add up as in bk_bake_changed. bk_lightmap_create_from makes the light map without
/// unwrapping common surfaces; a cache folder (bk_device_desc.cache_folder) saves unwraps, too.
///
/// Cost: as bk_bake_changed, and up to some 100 bytes and a microsecond per triangle of objects that
/// changed, less of those that did not; the earlier light is held a second time while it is baked.
/// Measured: docs/performance.md, "Edits".
///
/// Thread-safety: the earlier light map is read for the whole call; other calls may read it
/// meanwhile.
///
/// @param lightmap  any light map
/// @param earlier  another light map, of another scene or the same one, on any device
/// @param params  parameters of the last bake of `earlier`, without a range of texels, checkpoint,
///   shares and target_error; NULL for the defaults
/// @param keep_error  change of light below which texels keep it, as a fraction, as in
///   bk_bake_changed; finite, >= 0
/// @param progress,user  progress callback and its pointer; may be NULL
/// @param out  receives numbers about the bake; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  `earlier` is `lightmap`, or `keep_error` or a field of
///   `params` is out of its range
/// @retval BK_ERROR_INVALID_STATE  another call is using the light map, or changing the earlier one
/// @retval BK_ERROR_OUT_OF_MEMORY  `memory_budget` is exceeded or the memory callback refuses
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_bake_changed_from(
    lightmap: *mut bk_lightmap,
    earlier: *const bk_lightmap,
    params: *const bk_bake_params,
    keep_error: f32,
    progress: bk_progress_fn,
    user: *mut c_void,
    out: *mut bk_bake_stats,
) -> bk_result {
    // SAFETY: params and out are the caller's, or NULL.
    call(|| unsafe {
        refuse_in_callback()?;
        let lightmap = hold(lightmap, "lightmap")?;
        let earlier = hold(earlier, "earlier")?;
        if Arc::ptr_eq(&lightmap, &earlier) {
            return invalid_argument!("earlier is the light map itself: bk_bake_changed keeps its light");
        }
        let params = params_of_changes(params, "bk_bake_changed_from")?;
        let out = OutStruct::optional(out, "out")?;
        let progress = self::progress(progress, user);
        let done = earlier
            .read(|earlier| lightmap.change(|l| l.bake_changed_from(earlier, &params, keep_error, &progress)))?;
        if let Some(out) = out {
            out.write(stats(&done));
        }
        Ok(())
    })
}

/// Stage of bk_bake_share: tracing of photons.
pub const BK_SHARE_PHOTONS: u32 = 0;
/// Stage of bk_bake_share: the radiance map, which needs the photons of all shares.
pub const BK_SHARE_RADIANCE: u32 = 1;

/// Bakes one share of the photons or of the radiance map, on which all texels depend, and writes it
/// to a file: machines that bake some texels each (texel_begin and texel_end of bk_bake_params) need
/// not each trace all photons and fill the whole map.
///
/// First all shares of photons are computed, on any machines and in any order; when they are there,
/// all shares of the radiance map, each of which reads the photons of all; then all texels, with the
/// same `shares` and `share_count`. All other fields of `params` but `memory_budget`, the range of
/// texels and the checkpoint must be the same in all these calls, and so must scene, lights and
/// layout. The light has the bits of a bake without shares, whatever `share_count` is.
///
/// The file of share K of N is `shares` followed by photons-K-of-N.bkshare or
/// radiance-K-of-N.bkshare (and by -pass-P before .bkshare, from the second pass on). It is replaced
/// as a whole or not at all. A whole file of the same share that is there already is kept, and the
/// call then only reads it: after an interruption or the loss of a machine, the same calls complete
/// the work. Files may be copied between machines and renamed with another prefix. A
/// photon takes 48 bytes in its file, a texel of the radiance map 12. Stages that the scene does not
/// need write no file. Files from untrusted sources are safe to read: every number is checked, and
/// light is finite and >= 0.
///
/// Any number of threads may compute shares of one light map at the same time, but not during a
/// bake.
///
/// Cost: of photons and the radiance map in a bake the N-th part; beside it, a pilot of photons for
/// each share of photons (see bk_bake_params.photon_count), and reading and sorting of all photons
/// for each share of the radiance map. Measured: docs/performance.md, "Many machines".
///
/// Experimental: another version of the library may refuse the file.
///
/// @param lightmap  any light map
/// @param params  parameters of the bake; not NULL, with `shares` and `share_count`
/// @param stage  one of the BK_SHARE values
/// @param share  number of the share, less than `share_count`
/// @param progress,user  progress callback and its pointer; may be NULL
/// @param out  receives numbers about photons and the radiance map, without rays where a file was
///   read; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  a field of `params` is out of its range, `shares` is NULL,
///   `target_error` is not 0, there is no such stage or share, or the photons of a share are of
///   another bake; bk_last_error says in which respect
/// @retval BK_ERROR_INVALID_STATE  the light map is being baked
/// @retval BK_ERROR_OUT_OF_MEMORY  `memory_budget` is exceeded or the memory callback refuses
/// @retval BK_ERROR_IO  the photons of a share are missing, damaged or cannot be read, or the file
///   cannot be written
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_bake_share(
    lightmap: *const bk_lightmap,
    params: *const bk_bake_params,
    stage: u32,
    share: u32,
    progress: bk_progress_fn,
    user: *mut c_void,
    out: *mut bk_bake_stats,
) -> bk_result {
    // SAFETY: params and out are the caller's, or NULL.
    call(|| unsafe {
        refuse_in_callback()?;
        let lightmap = hold(lightmap, "lightmap")?;
        let (params, _, shares) = core_params(params)?;
        let Some(shares) = shares else { return invalid_argument!("shares is NULL") };
        let stage = match stage {
            BK_SHARE_PHOTONS => ShareStage::Photons,
            BK_SHARE_RADIANCE => ShareStage::Radiance,
            other => return invalid_argument!("stage is {other}, not one of the BK_SHARE values"),
        };
        let out = OutStruct::optional(out, "out")?;
        let progress = self::progress(progress, user);
        let done = lightmap.read(|l| {
            l.scene().device().check_process()?;
            l.bake_share(&params, &shares, stage, share, &progress)
        })?;
        if let Some(out) = out {
            out.write(stats(&done));
        }
        Ok(())
    })
}

/// What a caller's parameters say.
type Params = (BakeParams, Option<CheckpointParams>, Option<ShareParams>);

/// # Safety
/// `params` is NULL or the caller's structure, whose checkpoint and shares are NULL or texts.
unsafe fn core_params(params: *const bk_bake_params) -> Result<Params> {
    // SAFETY: by contract.
    let read = || unsafe { read_struct(params, "params") };
    let p: bk_bake_params = if params.is_null() { SizedStruct::defaults() } else { read()? };
    let directional = read_directional(p.directional_indirect, p.directional_direct)?;
    let params = BakeParams {
        photon_count: p.photon_count,
        max_bounces: p.max_bounces,
        gather_rays: p.gather_rays,
        radius: p.radius,
        near_hits: p.near_hits,
        interpolation_error: p.interpolation_error,
        interpolation_contrast: p.interpolation_contrast,
        own_rays: p.own_rays,
        blur_radius: p.blur_radius,
        direct_samples: p.direct_samples,
        seed: p.seed,
        memory_budget: p.memory_budget,
        texel_begin: p.texel_begin,
        texel_end: p.texel_end,
        stitch: read_bool(p.stitch, "stitch")?,
        directional,
        passes: p.passes,
        target_error: p.target_error,
    };
    let checkpoint = match p.checkpoint.is_null() {
        true => None,
        false => {
            // SAFETY: by contract a text.
            let path = unsafe { text(p.checkpoint, "checkpoint") }?.into();
            Some(CheckpointParams { path, seconds: p.checkpoint_seconds.into() })
        }
    };
    let shares = match p.shares.is_null() {
        true => None,
        false => {
            // SAFETY: by contract a text.
            let prefix = unsafe { text(p.shares, "shares") }?.into();
            Some(ShareParams { prefix, count: p.share_count })
        }
    };
    Ok((params, checkpoint, shares))
}

/// Writes a text about the last bake, one line per stage: whether it ran or was left out, and why.
/// Before the first bake the text is about a bake with default parameters.
///
/// @param lightmap  any light map
/// @param dst  receives as much of the text as fits, UTF-8 with a NUL; may be NULL if `capacity` is
///   0
/// @param capacity  size of `dst` in bytes
/// @return  length of the whole text in bytes without its NUL, whatever the capacity; 0 on failure,
///   for example during a bake
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
