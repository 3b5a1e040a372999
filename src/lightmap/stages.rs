//! Stages that a bake and live updates share, as functions of their [`Inputs`]: photons and radiance map, the sides
//! that are shown, how texels interpolate, and fallback gathers.

use super::atlas::Atlas;
use super::atlas::ids::{RadianceMap, RadianceTexel};
use super::atlas::two_sided;
use super::indirect::fallback_gather::{OwnDirectional, OwnLight, OwnRays};
use super::indirect::interpolation_contrast::GatherLight;
use super::indirect::near_hits::{HitRadiance, NearHits};
use super::indirect::radiance_map::{self, Anew, Radiance, RadianceInput, RadianceLookup};
use super::indirect::sample_set::{ROUND, SampleSet};
use super::indirect::upsample::{Asked, Upsampling};
use super::indirect::{find_bright_patches, split_texels};
use super::plan::{Plan, left_out};
use super::texel_light::TexelLight;
use super::{BakeParams, BakeStats, StageStats};
use crate::base::error::Result;
use crate::base::memory::try_vec;
use crate::base::progress::Progress;
use crate::base::sampling::{combine, purpose_seed};
use crate::base::share::Share;
use crate::direct::DirectLight;
use crate::photon::trace::Traced;
use crate::photon::{Change, Difference, Guidance, PhotonMap, PhotonParams, PhotonStats};
use glam::Vec3;
use std::ops::Range;
use std::sync::Arc;
use std::time::Instant;

/// Purposes of the random numbers of a bake.
pub(crate) mod purpose {
    pub const RADIANCE: u32 = 1;
    pub const GATHER_SET: u32 = 2;
    pub const GATHER: u32 = 3;
    pub const DIRECT: u32 = 4;
    pub const OWN: u32 = 5;
    pub const PROBE: u32 = 6;
}

/// Lower bound of the automatic search radius of photons in texels of the radiance map: the discs around its samples
/// then leave no photon out.
const RADIUS_TEXELS: f32 = 0.75;

/// Maximum number of photons kept: the larger of a fixed number and a number per texel of the radiance map. Of more,
/// every n-th is kept, with n times the power.
const MOST_STORED: u64 = 1 << 24;
const STORED_PER_TEXEL: u64 = 256;

/// Divisor of the photon count in a first impression. (With a sixteenth the sides of sheets in Sponza are told wrongly.)
const FIRST_IMPRESSION_PART: u64 = 4;

/// Divisor of `direct_samples` in the radiance map, which is coarser than the light map.
const RADIANCE_SAMPLE_DIVISOR: u32 = 4;

/// Inputs of all stages.
#[derive(Clone, Copy)]
pub(crate) struct Inputs<'a, 'p> {
    pub atlas: &'a Atlas,
    pub direct: &'a DirectLight,
    pub params: &'a BakeParams,
    pub progress: &'a Progress<'p>,
}

impl<'a> Inputs<'a, '_> {
    /// What gather rays see where they hit.
    pub(crate) fn lookup(&self, radiance: &'a Radiance) -> HitRadiance<'a> {
        let near = NearHits { direct: self.direct, texels: self.params.near_hits };
        HitRadiance::new(RadianceLookup::new(&self.atlas.charts, &self.atlas.radiance, radiance), near)
    }
}

/// Computes the radiance map; empty if the plan leaves indirect light out.
pub(crate) fn illuminate(inputs: &Inputs, plan: &Plan, stats: &mut BakeStats) -> Result<Radiance> {
    if !plan.runs(left_out::INDIRECT) {
        return Ok(Radiance::default());
    }
    let photons = if plan.runs(left_out::PHOTONS) { Some(photons(inputs, stats)?) } else { None };
    radiance(inputs, photons.as_ref(), false, stats)
}

/// Traces a share of the photons.
pub(crate) fn share_of_photons(inputs: &Inputs, share: Share, stats: &mut BakeStats) -> Result<Traced> {
    let Inputs { atlas, progress, .. } = *inputs;
    let traced = Traced::trace(&atlas.scene, &photon_params(inputs), share, progress, (0.0, 0.8))?;
    let PhotonStats { emitted, stored, rays, trace_seconds, .. } = traced.stats;
    let bytes = traced.runs().map(<[u8]>::len).sum::<usize>() as u64;
    stats.photons = StageStats { seconds: trace_seconds, rays, bytes };
    (stats.photons_emitted, stats.photons_stored) = (emitted, stored);
    Ok(traced)
}

/// Computes a share of the radiance map from the photons of all shares, or without any if the plan leaves them out.
pub(crate) fn share_of_radiance(
    inputs: &Inputs,
    photons: Option<Traced>,
    share: Share,
    stats: &mut BakeStats,
) -> Result<Vec<Vec3>> {
    let Inputs { atlas, progress, .. } = *inputs;
    let sorted = |photons| PhotonMap::of(&atlas.scene, &photon_params(inputs), photons, progress, 0.2, 0.25);
    let photons = photons.map(sorted).transpose()?;
    if let Some(photons) = &photons {
        let s = photons.stats();
        stats.photons = StageStats { seconds: s.grid_seconds, rays: 0, bytes: photons.bytes() as u64 };
        (stats.photons_emitted, stats.photons_stored) = (s.emitted, s.stored);
    }
    let (start, range) = (Instant::now(), radiance_map::share(&atlas.radiance, share));
    let (values, rays) = radiance_values(inputs, photons.as_ref(), range, false, (0.25, 0.95))?;
    let bytes = size_of_val(&values[..]) as u64;
    stats.radiance = StageStats { seconds: start.elapsed().as_secs_f64(), rays, bytes };
    Ok(values)
}

/// Computes a first impression of the radiance map, by a part of the photons, in a fraction of the time that
/// [`illuminate`] takes; empty if the plan leaves indirect light out.
pub(crate) fn illuminate_quickly(inputs: &Inputs, plan: &Plan) -> Result<Radiance> {
    if !plan.runs(left_out::INDIRECT) {
        return Ok(Radiance::default());
    }
    let stats = &mut BakeStats::default();
    let few = BakeParams { photon_count: inputs.params.photon_count.div_ceil(FIRST_IMPRESSION_PART), ..*inputs.params };
    let few = Inputs { params: &few, ..*inputs };
    let photons = if plan.runs(left_out::PHOTONS) { Some(photons(&few, stats)?) } else { None };
    radiance(inputs, photons.as_ref(), true, stats)
}

/// Parameters of the photons of a bake.
pub(crate) fn photon_params(inputs: &Inputs) -> PhotonParams {
    let Inputs { atlas, params, .. } = *inputs;
    PhotonParams {
        photon_count: params.photon_count,
        max_bounces: params.max_bounces,
        radius: params.radius,
        seed: params.seed,
        memory_budget: params.memory_budget,
        store_direct: false,
        // The quotient is infinite if the density is nearly 0.
        least_radius: (RADIUS_TEXELS / atlas.radiance.layout.density).min(f32::MAX),
        most_stored: MOST_STORED.max(STORED_PER_TEXEL * atlas.radiance.len() as u64),
        ..Default::default()
    }
}

fn photons(inputs: &Inputs, stats: &mut BakeStats) -> Result<PhotonMap> {
    let start = Instant::now();
    let map = PhotonMap::trace_within(&inputs.atlas.scene, &photon_params(inputs), inputs.progress, 0.0, 0.2)?;
    note_photons(&map, start, stats);
    Ok(map)
}

/// Traces the photons of a scene after a change, and tells which came and went; `None` if all may have changed.
pub(crate) fn photons_again(
    inputs: &Inputs,
    change: &Change,
    stats: &mut BakeStats,
) -> Result<Option<(PhotonMap, Difference)>> {
    let (start, scene) = (Instant::now(), &inputs.atlas.scene);
    let trace = || PhotonMap::trace_again(scene, &photon_params(inputs), change, inputs.progress, (0.0, 0.2));
    let found = scene.device().install(trace)?;
    if let Some((map, _)) = &found {
        note_photons(map, start, stats);
    }
    Ok(found)
}

fn note_photons(map: &PhotonMap, start: Instant, stats: &mut BakeStats) {
    let s = map.stats();
    stats.photons = StageStats { seconds: start.elapsed().as_secs_f64(), rays: s.rays, bytes: map.bytes() as u64 };
    (stats.photons_emitted, stats.photons_stored) = (s.emitted, s.stored);
}

fn radiance(inputs: &Inputs, photons: Option<&PhotonMap>, quick: bool, stats: &mut BakeStats) -> Result<Radiance> {
    let start = Instant::now();
    let (values, mut rays) = radiance_values(inputs, photons, 0..inputs.atlas.radiance.len(), quick, (0.2, 0.3))?;
    let mut radiance = Radiance { values, ..Default::default() };
    if !quick {
        complete(inputs, &mut radiance, &mut rays)?;
        radiance.guidance = photons.map(PhotonMap::guidance).transpose()?.flatten().map(Arc::new);
    }
    stats.radiance = radiance_stats(inputs, start, rays);
    Ok(radiance)
}

/// Computes the radiance of the texels of `values` that are to be `anew`, given what photons after later changes have in common
/// with these.
pub(crate) fn radiance_again(
    inputs: &Inputs,
    photons: &PhotonMap,
    guidance: Arc<Guidance>,
    (mut values, anew): (Vec<Vec3>, &[bool]),
    stats: &mut BakeStats,
) -> Result<Radiance> {
    let (start, atlas) = (Instant::now(), inputs.atlas);
    let anew = Anew::new(&atlas.areas(&atlas.radiance), anew)?;
    let range = 0..values.len();
    let stage = inputs.progress.stage("radiance", 0.2, 0.3, radiance_map::work(&atlas.radiance, &range));
    let input = RadianceInput {
        light: radiance_light(inputs, false)?,
        photons: Some(photons),
        quick: false,
        anew: Some(&anew),
    };
    let mut rays = radiance_map::bake(atlas.scene.device(), &input, range, &mut values, &stage)?;
    let mut radiance = Radiance { values, guidance: Some(guidance), ..Default::default() };
    complete(inputs, &mut radiance, &mut rays)?;
    stats.radiance = radiance_stats(inputs, start, rays);
    Ok(radiance)
}

fn radiance_stats(inputs: &Inputs, start: Instant, rays: u64) -> StageStats {
    let map = &inputs.atlas.radiance;
    StageStats {
        seconds: start.elapsed().as_secs_f64(),
        rays,
        bytes: (map.len() * size_of::<Vec3>() + map.bytes()) as u64,
    }
}

/// Finds what look-ups need to know of a complete radiance map: its texels on both sides of a wall, and its bright patches.
/// Adds the rays traced to `rays`.
pub(crate) fn complete(inputs: &Inputs, radiance: &mut Radiance, rays: &mut u64) -> Result<()> {
    let Inputs { atlas, params, progress, .. } = *inputs;
    atlas.scene.device().install(|| {
        radiance.split = split_texels::find(atlas, &radiance.values, rays, progress)?;
        // Paths from all hits look nothing up, and so find bright patches by their own shadow rays.
        match params.near_hits < f32::INFINITY {
            true => find_bright_patches::find(atlas, radiance, rays, progress),
            false => Ok(()),
        }
    })
}

/// Computes a range of the radiance map; returns the number of rays, too.
fn radiance_values(
    inputs: &Inputs,
    photons: Option<&PhotonMap>,
    range: Range<usize>,
    quick: bool,
    (from, to): (f32, f32),
) -> Result<(Vec<Vec3>, u64)> {
    let Inputs { atlas, progress, .. } = *inputs;
    let stage = progress.stage("radiance", from, to, radiance_map::work(&atlas.radiance, &range));
    let mut values = try_vec(range.len(), "the radiance map")?;
    let input = RadianceInput { light: radiance_light(inputs, quick)?, photons, quick, anew: None };
    let rays = radiance_map::bake(atlas.scene.device(), &input, range, &mut values, &stage)?;
    Ok((values, rays))
}

/// Direct light of the radiance map's texels; `quick`: without a look at where the sky is seen.
fn radiance_light<'a>(inputs: &Inputs<'a, '_>, quick: bool) -> Result<TexelLight<'a, RadianceMap>> {
    let Inputs { atlas, direct, params, .. } = *inputs;
    if !quick {
        atlas.make_room_for_sky_seen(direct)?;
    }
    Ok(TexelLight {
        areas: atlas.areas(&atlas.radiance),
        direct,
        samples: params.direct_samples.div_ceil(RADIANCE_SAMPLE_DIVISOR),
        seed: purpose_seed(params.seed, purpose::RADIANCE),
        sky_from: (!quick).then_some(atlas),
    })
}

/// Decides for each two-sided chart without separate texels for its back whether the back is baked. With the radiance
/// map of [`illuminate`], this is all that lighting texels needs.
pub(crate) fn backs(inputs: &Inputs, radiance: &[Vec3]) -> Result<Vec<bool>> {
    let Inputs { atlas, direct, params, progress } = *inputs;
    let map = &atlas.radiance;
    // Without indirect light there is no radiance map: direct light decides.
    let light = |texel: RadianceTexel| match radiance.get(texel.index()) {
        Some(radiance) => radiance.element_sum(),
        None => {
            let (_, receiver) = map.receiver(&atlas.scene, texel, map.is_back(texel));
            let seed = combine(params.seed as u32, map.seed(texel));
            direct.irradiance(&receiver, 1, seed, &mut 0).element_sum()
        }
    };
    atlas.scene.device().install(|| two_sided::backs(atlas, light, progress))
}

/// Finds how texels of the light map interpolate between gather texels, for a range of placements and those that are
/// `asked` for (`None`: all).
pub(crate) fn upsampling(
    inputs: &Inputs,
    backs: &[bool],
    placements: Range<usize>,
    asked: Option<Asked>,
) -> Result<Upsampling> {
    let stage = inputs.progress.stage("upsampling", 0.3, 0.315, placements.len() as u64);
    Upsampling::find(inputs.atlas, placements, backs, inputs.params.interpolation_error, asked, &stage)
}

/// Light of fallback gathers, and the number of their rays.
#[derive(Default)]
pub(crate) struct Own {
    pub light: OwnLight,
    pub directional: OwnDirectional,
    pub rays: u64,
}

/// Traces the fallback gathers of an interpolation. `gathered`: the gather map, if what some of them gather is weighed against it;
/// `directional`: whether light by direction is asked for; `from`, `to`: the progress of the bake.
pub(crate) fn own_light(
    inputs: &Inputs,
    radiance: &Radiance,
    backs: &[bool],
    upsampling: &Upsampling,
    gathered: Option<&GatherLight>,
    directional: bool,
    (from, to): (f32, f32),
) -> Result<Own> {
    let Inputs { atlas, params, progress, .. } = *inputs;
    let count = if params.own_rays == 0 { ROUND as u32 } else { params.own_rays }.min(params.gather_rays);
    let set = |count| SampleSet::new(count, purpose_seed(params.seed, purpose::GATHER_SET));
    let rays = OwnRays {
        radiance: inputs.lookup(radiance),
        samples: [&set(count)?, &set((2 * count).min(params.gather_rays).min(ROUND as u32))?],
        seed: purpose_seed(params.seed, purpose::OWN),
        directional,
        gathered,
    };
    let stage = progress.stage("own light", from, to, upsampling.own_work());
    let (light, directional, rays) = upsampling.own_light(atlas, backs, &rays, &stage)?;
    Ok(Own { light, directional, rays })
}
