//! The bake: stages in order, each with its share of progress, time and memory.

use super::blur::Filling;
use super::bright::Bright;
use super::buried::Search;
use super::chart_index::ChartIndex;
use super::charts::{Charts, automatic_density};
use super::direct::DirectLight;
use super::gather::{Gathered, SampleSet};
use super::layout::Layout;
use super::map::ChartMap;
use super::plan::{Plan, left_out};
use super::radiance::{self, Radiance, RadianceInput, RadianceMap};
use super::saved::checkpoint::Checkpoint;
use super::seams::Stitch;
use super::seen::{self, Seen};
use super::sides;
use super::texel_light::{TexelLight, Variation};
use super::texels::TexelMap;
use super::upsample::{OWN_RAYS, OwnLight, OwnRays, Upsampling};
use super::{
    Atlas, BakeParams, BakeStats, CheckpointParams, Light, Lightmap, LightmapDesc, LightmapInfo, Origin, StageStats,
    TexelState, blur,
};
use crate::device::LogLevel;
use crate::error::{Error, Result, invalid_argument};
use crate::memory::{try_collect, try_vec};
use crate::photon::{PhotonMap, PhotonParams};
use crate::progress::{Progress, Stage};
use crate::sampling::{combine, purpose_seed};
use crate::scene::Scene;
use crate::scene::precision::too_few_digits;
use glam::Vec3;
use rayon::prelude::*;
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::Instant;

/// Texels handed to a thread at a time.
const BLOCK: usize = 256;

/// Pages that a scene about fills if the caller leaves the density open.
const AUTOMATIC_PAGES: f64 = 1.0;

/// Bytes per gather texel while a bake runs: light, blurred light, normal, variance, whether it is valid.
const GATHER_BYTES: usize = 3 * size_of::<Vec3>() + size_of::<f32>() + size_of::<bool>();

/// Bytes per light map texel while a bake runs: direct and indirect light, what is known of it, whether direct light varies.
const TEXEL_BYTES: usize = 2 * size_of::<Vec3>() + size_of::<TexelState>() + size_of::<Variation>();

/// The offset of rays from surfaces from which on a warning is due, as a part of a texel.
const OFFSET_PART: f32 = 0.25;

/// Coarse maps of small light maps have pages of this size at least.
const MIN_PAGE_SIZE: u32 = 64;

/// What the random numbers of a bake are for.
pub(crate) mod purpose {
    pub const RADIANCE: u32 = 1;
    pub const GATHER_SET: u32 = 2;
    pub const GATHER: u32 = 3;
    pub const DIRECT: u32 = 4;
    pub const OWN: u32 = 5;
}

/// The automatic search radius of photons is at least so many texels of the radiance map, so that the discs around its
/// samples leave no photon out.
const RADIUS_TEXELS: f32 = 0.75;

/// Photons that are kept, at most, and per texel of the radiance map if that is more; of more, some stand for the others.
const MOST_STORED: u64 = 1 << 24;
const STORED_PER_TEXEL: u64 = 256;

/// The radiance map, coarser than the light map, takes this part of the direct samples.
const RADIANCE_SAMPLE_DIVISOR: u32 = 4;

impl Lightmap {
    /// Unwraps what brings no usable UVs, lays out the pages and maps texels to triangles.
    pub fn create(scene: &Arc<Scene>, desc: &LightmapDesc, progress: &Progress) -> Result<Lightmap> {
        desc.validate()?;
        scene.device().run(progress, || Self::lay_out(scene, desc, progress))
    }

    fn lay_out(scene: &Arc<Scene>, desc: &LightmapDesc, progress: &Progress) -> Result<Lightmap> {
        let start = Instant::now();
        let density = match desc.texels_per_unit {
            0.0 => automatic_density(scene, desc.page_size, AUTOMATIC_PAGES),
            d => d,
        };
        let (charts, mut uvs) = Charts::of_scene(scene, density, desc.page_size, desc.padding, progress)?;
        let unwrap_seconds = start.elapsed().as_secs_f64();
        let two_sided = (0..).zip(&charts.charts).filter(|(_, c)| c.two_sided).map(|(c, _)| c);
        let two_sided: Vec<u32> = try_collect(two_sided, "the two-sided charts")?;
        let pack = |divisor: u32, padding: u32, given: bool, with_backs: &[u32]| {
            let page_size = if divisor == 1 { desc.page_size } else { (desc.page_size / divisor).max(MIN_PAGE_SIZE) };
            Layout::pack(&charts, density / divisor as f32, page_size, padding, given, with_backs, progress)
        };
        let radiance = pack(desc.radiance_divisor, 0, false, &two_sided)?;
        let stage = progress.stage("texels", 0.5, 0.6, TexelMap::work(&radiance));
        let mut radiance = ChartMap::new(scene, &charts, radiance, &stage)?;
        let texel = 1.0 / density;
        let stage = progress.stage("sides", 0.6, 0.65, Seen::work(&radiance));
        let seen = scene.device().install(|| Seen::count(scene, &charts, &radiance, texel, &stage))?;
        let with_backs =
            if desc.both_sides { sides::seen_from_both(&seen, &radiance, &two_sided)? } else { Vec::new() };
        let map = pack(1, desc.padding, true, &with_backs)?;
        let gather = pack(desc.gather_divisor, 0, false, &with_backs)?;
        let stage = progress.stage("texels", 0.65, 0.8, TexelMap::work(&map) + TexelMap::work(&gather));
        let mut map = ChartMap::new(scene, &charts, map, &stage)?;
        let mut gather = ChartMap::new(scene, &charts, gather, &stage)?;
        let placements = [&map, &gather, &radiance].map(|map| map.layout.placements.len() as u64);
        let stage = progress.stage("buried texels", 0.8, 1.0, placements.iter().sum());
        let near = texel.min(seen::ROOM * scene.diagonal());
        let search = Search { scene, charts: &charts, seen: &seen, near };
        let mut sight_rays = seen.rays;
        let mut move_buried = |map: &mut ChartMap, by_parts: bool| -> Result<Vec<bool>> {
            let (buried, rays) = scene.device().install(|| search.move_buried(map, by_parts, &stage))?;
            sight_rays += rays;
            Ok(buried)
        };
        move_buried(&mut radiance, true)?;
        // The rest of a texel that is buried for the most part is a strip along what covers it, often darker than all
        // around: gather texels are larger, and would spread that dark as a rim.
        move_buried(&mut gather, false)?;
        let buried = move_buried(&mut map, true)?;
        uvs.overlapping_texels = map.texels.overlapping_texels;
        uvs.reduced_charts = map.layout.reduced;
        let index = ChartIndex::new(scene.device(), &charts)?;
        let own_bytes = charts.bytes() + seen.bytes() + buried.len();
        let bytes = own_bytes + index.bytes() + map.bytes() + gather.bytes() + radiance.bytes();
        let info = LightmapInfo {
            page_count: map.layout.page_count,
            width: map.layout.page_size,
            height: map.layout.page_size,
            charts: charts.charts.len() as u32,
            texels: map.len() as u64,
            gather_texels: gather.len() as u64,
            radiance_texels: radiance.len() as u64,
            bytes: bytes as u64,
            unwrap_seconds,
            texels_per_unit: density,
            uvs,
            both_sided_charts: with_backs.len() as u32,
            back_texels: (map.len() - map.back_start) as u64,
            buried_texels: buried.iter().filter(|&&b| b).count() as u64,
            open_places: seen.places,
            sight_rays,
        };
        let memory = scene.device().memory().reserve(own_bytes, "the charts")?;
        if let Some(message) = too_few_digits(scene, "texels", 1.0 / density, OFFSET_PART) {
            scene.device().log(LogLevel::Warning, &message);
        }
        let direct = DirectLight::try_new(scene)?;
        let mut plan =
            Plan::new(scene, &direct, &BakeParams::default(), !two_sided.is_empty(), uvs.unwrapped_charts > 0);
        plan.note_sides(&info);
        let scene = scene.clone();
        let padding = desc.padding;
        let atlas = Atlas { scene, charts, index, map, gather, radiance, padding, info, seen, buried, _memory: memory };
        Ok(Lightmap { atlas: Arc::new(atlas), plan, light: None })
    }

    /// Runs the pipeline. On an error or a cancel what an earlier bake left stays as it was.
    pub fn bake(&mut self, params: &BakeParams, progress: &Progress) -> Result<BakeStats> {
        self.bake_with(params, None, progress)
    }

    /// Runs the pipeline and keeps what is done in a file, from which a later call with the same scene, lights, layout
    /// and parameters goes on, whatever ended this one; the light has the bits of a bake without a break. The
    /// statistics tell of what this call did.
    ///
    /// The file is created if it is not there (or empty), and stays when the bake is complete: the caller deletes it when
    /// the light has been saved. `InvalidArgument` if it is of another bake, `Io` if it is damaged or cannot be read or
    /// created, `InvalidState` if another bake is using it. If it cannot be written later, as on a full disk, the bake
    /// goes on, a warning is logged, and what the file holds stays whole.
    pub fn bake_with(
        &mut self,
        params: &BakeParams,
        checkpoint: Option<&CheckpointParams>,
        progress: &Progress,
    ) -> Result<BakeStats> {
        params.validate()?;
        checkpoint.map_or(Ok(()), CheckpointParams::validate)?;
        let total = self.atlas.map.len() as u64;
        if params.texel_begin > total || params.texel_end > total {
            return invalid_argument!(
                "texel_begin {} or texel_end {} lies beyond the light map's {total} texels",
                params.texel_begin,
                params.texel_end
            );
        }
        let end = if params.texel_end == 0 { total } else { params.texel_end };
        let origin = Origin::new(params, &self.atlas.scene.lights());
        let direct = self.atlas.scene.device().install(|| DirectLight::try_new(&self.atlas.scene))?;
        let two_sided = !self.atlas.radiance.layout.back_of.is_empty();
        let mut plan =
            Plan::new(&self.atlas.scene, &direct, params, two_sided, self.atlas.info.uvs.unwrapped_charts > 0);
        plan.note_sides(&self.atlas.info);
        let device = self.atlas.scene.device().clone();
        device.memory().reset_peak();
        let range = params.texel_begin as usize..end as usize;
        let (light, mut stats, stitch) = device.run(progress, || {
            let (atlas, direct, range) = (&self.atlas, &direct, range.clone());
            let checkpoint = match checkpoint {
                Some(c) => Some(Checkpoint::open(c, atlas, &origin, [range.start as u64, range.end as u64])?),
                None => None,
            };
            let checkpoint = checkpoint.as_ref();
            let (mut light, mut stats) =
                Bake { atlas, params, plan: &plan, direct, range: range.clone(), progress, checkpoint }.run()?;
            stats.back_charts = light.backs.iter().filter(|&&b| b).count() as u64;
            plan.note_back_charts(stats.back_charts);
            plan.note_bright(&light.radiance.bright);
            light.plan = plan.clone();
            light.origin = Some(origin);
            let stitch = self.stitch(&light, &range, params, &mut plan, &mut stats, progress)?;
            Ok((light, stats, stitch))
        })?;
        stats.left_out = plan.left_out;
        stats.peak_bytes = device.memory().peak() as u64;
        self.plan = plan;
        let start = Instant::now();
        device.install(|| self.store(light, range, stitch));
        stats.compose.seconds = start.elapsed().as_secs_f64();
        stats.seconds += stats.compose.seconds;
        Ok(stats)
    }

    /// Takes the light of a range of samples over. Seams are stitched anew: whatever the shards, the last one leaves
    /// the bits of a whole bake.
    pub(super) fn store(&mut self, new: Light, range: Range<usize>, stitch: Option<Stitch>) {
        match &mut self.light {
            Some(old) if range.len() < self.atlas.map.len() => {
                if let Some(mut before) = old.stitch.take() {
                    before.swap(old);
                }
                old.direct[range.clone()].copy_from_slice(&new.direct[range.clone()]);
                old.indirect[range.clone()].copy_from_slice(&new.indirect[range.clone()]);
                old.state[range.clone()].copy_from_slice(&new.state[range]);
                old.radiance = new.radiance;
                old.backs = new.backs;
                old.plan = new.plan;
                old.origin = old.origin.filter(|&origin| Some(origin) == new.origin);
            }
            light => *light = Some(new),
        }
        let Some(light) = &mut self.light else { return };
        if let Some(mut stitch) = stitch {
            stitch.swap(light);
            light.stitch = Some(stitch);
        }
    }
}

/// One bake under way.
pub(crate) struct Bake<'a, 'p> {
    pub atlas: &'a Atlas,
    pub params: &'a BakeParams,
    pub plan: &'a Plan,
    pub direct: &'a DirectLight,
    /// Samples of the light map to bake.
    pub range: Range<usize>,
    pub progress: &'a Progress<'p>,
    pub checkpoint: Option<&'a Checkpoint<'a>>,
}

/// The gather map after blur and filling.
struct Indirect {
    irradiance: Vec<Vec3>,
    upsampling: Upsampling,
    own: OwnLight,
}

impl Bake<'_, '_> {
    fn run(&self) -> Result<(Light, BakeStats)> {
        let start = Instant::now();
        let mut stats = BakeStats::default();
        let memory = self.reserve()?;
        let scene = &self.atlas.scene;
        let mut indirect = None;
        let radiance = self.illuminate(&mut stats)?;
        let backs = self.backs(&radiance.values)?;
        if self.plan.runs(left_out::INDIRECT) {
            indirect = Some(self.gather(&radiance, &backs, &mut stats)?);
        }
        let n = self.atlas.map.len();
        let mut light = Light {
            direct: try_vec(n, "direct light")?,
            indirect: try_vec(n, "indirect light")?,
            state: try_vec(n, "validity")?,
            radiance,
            backs,
            stitch: None,
            origin: None,
            plan: Plan::default(),
            _memory: memory,
        };
        self.compose(scene, indirect.as_ref(), &mut light, &mut stats)?;
        stats.seconds = start.elapsed().as_secs_f64();
        Ok((light, stats))
    }

    /// The radiance map; empty if the plan leaves indirect light out.
    pub(crate) fn illuminate(&self, stats: &mut BakeStats) -> Result<Radiance> {
        if !self.plan.runs(left_out::INDIRECT) {
            return Ok(Radiance::default());
        }
        if let Some(c) = self.checkpoint
            && let Some(radiance) = self.atlas.scene.device().install(|| c.radiance(self.atlas))?
        {
            return Ok(radiance);
        }
        let photons = if self.plan.runs(left_out::PHOTONS) { Some(self.photons(stats)?) } else { None };
        let radiance = self.radiance(photons.as_ref(), stats)?;
        if let Some(c) = self.checkpoint {
            c.keep_radiance(&radiance);
        }
        Ok(radiance)
    }

    /// Announces the buffers of all stages but the photon map, which announces its own.
    fn reserve(&self) -> Result<crate::memory::Reservation> {
        let l = self.atlas;
        let mut bytes = l.map.len() * TEXEL_BYTES;
        if self.plan.runs(left_out::INDIRECT) {
            bytes += l.radiance.len() * 12 + l.gather.len() * GATHER_BYTES;
        }
        if self.params.memory_budget != 0 && bytes as u64 > self.params.memory_budget {
            return Err(Error::OutOfMemory(format!(
                "the bake's buffers take {bytes} bytes, more than memory_budget {}",
                self.params.memory_budget
            )));
        }
        l.scene.device().memory().reserve(bytes, "the bake's buffers")
    }

    fn photons(&self, stats: &mut BakeStats) -> Result<PhotonMap> {
        let start = Instant::now();
        let params = PhotonParams {
            photon_count: self.params.photon_count,
            max_bounces: self.params.max_bounces,
            radius: self.params.radius,
            seed: self.params.seed,
            memory_budget: self.params.memory_budget,
            store_direct: false,
            // Of a density that is nearly 0 the quotient is infinite.
            least_radius: (RADIUS_TEXELS / self.atlas.radiance.layout.density).min(f32::MAX),
            most_stored: MOST_STORED.max(STORED_PER_TEXEL * self.atlas.radiance.len() as u64),
            ..Default::default()
        };
        let map = PhotonMap::trace_within(&self.atlas.scene, &params, self.progress, 0.0, 0.2)?;
        let s = map.stats();
        stats.photons = StageStats { seconds: start.elapsed().as_secs_f64(), rays: s.rays, bytes: map.bytes() as u64 };
        (stats.photons_emitted, stats.photons_stored) = (s.emitted, s.stored);
        Ok(map)
    }

    fn radiance(&self, photons: Option<&PhotonMap>, stats: &mut BakeStats) -> Result<Radiance> {
        let start = Instant::now();
        let l = self.atlas;
        let stage = self.progress.stage("radiance", 0.2, 0.3, 2 * l.radiance.len() as u64);
        let mut values = try_vec(l.radiance.len(), "the radiance map")?;
        let light = TexelLight {
            areas: l.areas(&l.radiance),
            direct: self.direct,
            samples: self.params.direct_samples.div_ceil(RADIANCE_SAMPLE_DIVISOR),
            seed: purpose_seed(self.params.seed, purpose::RADIANCE),
        };
        let input = RadianceInput { light, photons };
        let mut rays = radiance::bake(l.scene.device(), &input, &mut values, &stage)?;
        let mut radiance = Radiance { values, bright: Bright::default() };
        l.scene.device().install(|| Bright::find(l, &mut radiance, &mut rays, self.progress))?;
        let bytes = (radiance.values.len() * size_of::<Vec3>() + l.radiance.bytes()) as u64;
        stats.radiance = StageStats { seconds: start.elapsed().as_secs_f64(), rays, bytes };
        Ok(radiance)
    }

    /// Per chart with one place, whether its back is baked. With [`illuminate`](Self::illuminate)'s map all that
    /// texels need to be lit.
    pub(crate) fn backs(&self, radiance: &[Vec3]) -> Result<Vec<bool>> {
        let l = self.atlas;
        if let Some(backs) = self.checkpoint.and_then(|c| c.backs(l.charts.charts.len())) {
            return Ok(backs);
        }
        // Without indirect light there is no radiance map: direct light decides.
        let light = |s: usize| match radiance.get(s) {
            Some(radiance) => radiance.element_sum(),
            None => {
                let (_, receiver) = l.radiance.receiver(&l.scene, s, l.radiance.is_back(s));
                self.direct.irradiance(&receiver, 1, combine(self.params.seed as u32, s as u32), &mut 0).element_sum()
            }
        };
        let backs = l.scene.device().install(|| sides::backs(l, light, self.progress))?;
        if let Some(c) = self.checkpoint {
            c.keep_backs(&backs);
        }
        Ok(backs)
    }

    /// Gathers, blurs and fills. Only placements that the range touches are gathered.
    fn gather(&self, radiance: &Radiance, backs: &[bool], stats: &mut BakeStats) -> Result<Indirect> {
        let start = Instant::now();
        let l = self.atlas;
        let device = l.scene.device();
        let placements = l.map.texels.placement_of(self.range.start as u32)
            ..l.map.texels.placement_of(self.range.end as u32 - 1) + 1;
        let needed = l.gather.texels.chart_start[placements.start as usize] as usize
            ..l.gather.texels.chart_start[placements.end as usize] as usize;
        let upsampling = self.upsampling(backs, placements)?;
        let (own, own_rays) = self.own_light(radiance, backs, &upsampling)?;
        let lookup = RadianceMap::new(&l.charts, &l.radiance, radiance);
        let samples = SampleSet::new(self.params.gather_rays, purpose_seed(self.params.seed, purpose::GATHER_SET));
        let seed = purpose_seed(self.params.seed, purpose::GATHER);
        let stage = self.progress.stage("gather", 0.32, 0.6, needed.len() as u64);
        let n = l.gather.len();
        let mut irradiance: Vec<Vec3> = try_vec(n, "the gather map")?;
        let mut normals: Vec<Vec3> = try_vec(n, "the gather map's normals")?;
        let mut variances: Vec<f32> = try_vec(n, "the gather map's variance")?;
        let mut valid: Vec<bool> = try_vec(n, "the gather map's validity")?;
        let rays = AtomicU64::new(upsampling.rays + own_rays);
        device.install(|| {
            let values = irradiance[needed.clone()].par_chunks_mut(BLOCK);
            let normals = normals[needed.clone()].par_chunks_mut(BLOCK);
            let variances = variances[needed.clone()].par_chunks_mut(BLOCK);
            let valid = valid[needed.clone()].par_chunks_mut(BLOCK);
            let blocks = values.zip(normals).zip(variances).zip(valid).enumerate();
            blocks.try_for_each(|(block, (((values, normals), variances), valid))| {
                if self.checkpoint.is_some_and(|c| c.gathered(block, values, variances, valid)) {
                    for (i, normal) in normals.iter_mut().enumerate() {
                        *normal = l.receiver(&l.gather, backs, needed.start + block * BLOCK + i).normal;
                    }
                    return stage.advance(values.len() as u64);
                }
                let mut traced = 0;
                for i in 0..values.len() {
                    self.progress.check()?;
                    let sample = needed.start + block * BLOCK + i;
                    let receiver = l.receiver(&l.gather, backs, sample);
                    let mut gathered = Gathered::default();
                    for round in 0..samples.rounds() {
                        let seed = combine(seed, sample as u32);
                        traced += gathered.add_round(&l.scene, &lookup, &receiver, &samples, round, seed);
                    }
                    (values[i], normals[i]) = (gathered.irradiance(), receiver.normal);
                    (variances[i], valid[i]) = (gathered.variance(), gathered.is_visible());
                }
                if let Some(c) = self.checkpoint {
                    c.keep_gathered(block, values, variances, valid);
                }
                rays.fetch_add(traced, Relaxed);
                stage.advance(values.len() as u64)
            })
        })?;
        let is_hidden = |i: usize| needed.contains(&i) && !valid[i];
        Filling::new(n, |i| valid[i], is_hidden)?.fill(&l.charts, &l.gather, &mut irradiance, self.progress)?;
        if self.plan.runs(left_out::BLUR) {
            let stage = self.progress.stage("blur", 0.6, 0.65, n as u64);
            let mut blurred = try_vec(n, "the blurred gather map")?;
            let radius = self.params.blur_radius;
            let texels = blur::Texels { values: &irradiance, variances: &variances, valid: &valid, normals: &normals };
            blur::blur(device, &l.charts, &l.gather, texels, radius, &mut blurred, &stage)?;
            irradiance = blurred;
        }
        let bytes = (n * GATHER_BYTES + l.gather.bytes()) as u64;
        stats.gather = StageStats { seconds: start.elapsed().as_secs_f64(), rays: rays.into_inner(), bytes };
        Ok(Indirect { irradiance, upsampling, own })
    }

    /// How the light map shows some placements of the gather map.
    pub(crate) fn upsampling(&self, backs: &[bool], placements: Range<u32>) -> Result<Upsampling> {
        let stage = self.progress.stage("upsampling", 0.3, 0.315, placements.len() as u64);
        Upsampling::find(self.atlas, placements, backs, &stage)
    }

    /// Light of the texels that no gather texel stands for, and the rays that it takes.
    pub(crate) fn own_light(
        &self,
        radiance: &Radiance,
        backs: &[bool],
        upsampling: &Upsampling,
    ) -> Result<(OwnLight, u64)> {
        let l = self.atlas;
        let texels = upsampling.own_work() as usize / 2;
        if let Some(own) = self.checkpoint.and_then(|c| c.own_light(texels)) {
            return Ok((own, 0));
        }
        let count = self.params.gather_rays.min(OWN_RAYS);
        let rays = OwnRays {
            radiance: RadianceMap::new(&l.charts, &l.radiance, radiance),
            samples: &SampleSet::new(count, purpose_seed(self.params.seed, purpose::GATHER_SET)),
            seed: purpose_seed(self.params.seed, purpose::OWN),
        };
        let stage = self.progress.stage("own light", 0.315, 0.32, upsampling.own_work());
        let own = upsampling.own_light(l, backs, &rays, &stage)?;
        if let Some(c) = self.checkpoint {
            c.keep_own_light(&own.0);
        }
        Ok(own)
    }

    /// Direct light and the interpolated indirect light of every texel of the range.
    fn compose(
        &self,
        scene: &Arc<Scene>,
        indirect: Option<&Indirect>,
        light: &mut Light,
        stats: &mut BakeStats,
    ) -> Result<()> {
        let start = Instant::now();
        let l = self.atlas;
        let stage = self.progress.stage("direct", 0.65, 1.0, 2 * self.range.len() as u64);
        let rays = AtomicU64::new(0);
        let range = self.range.clone();
        let backs = &light.backs[..];
        let texels = self.texel_light();
        // Blocks whose light a checkpoint has.
        let mut known = vec![false; range.len().div_ceil(BLOCK)];
        scene.device().install(|| {
            let direct = light.direct[range.clone()].par_chunks_mut(BLOCK).zip(&mut known);
            let indirect_out = light.indirect[range.clone()].par_chunks_mut(BLOCK);
            let state = light.state[range.clone()].par_chunks_mut(BLOCK);
            direct.zip(indirect_out).zip(state).enumerate().try_for_each(|(block, (((direct, known), ind), state))| {
                let mut traced = 0;
                let first = range.start + block * BLOCK;
                if let Some(indirect) = indirect {
                    for (i, ind) in ind.iter_mut().enumerate() {
                        *ind = indirect.upsampling.at(l, &indirect.irradiance, &indirect.own, first + i);
                    }
                }
                *known = self.checkpoint.is_some_and(|c| c.lit(block, direct, state));
                if *known {
                    return stage.advance(direct.len() as u64);
                }
                for i in 0..direct.len() {
                    self.progress.check()?;
                    let sample = first + i;
                    let receiver = l.receiver(&l.map, backs, sample);
                    state[i] = match l.buried.get(sample) {
                        Some(true) => TexelState::Hidden,
                        _ => TexelState::Visible,
                    };
                    if self.plan.runs(left_out::DIRECT) {
                        direct[i] = texels.sharp(&receiver, &mut traced);
                    }
                }
                if let Some(c) = self.checkpoint.filter(|_| !self.plan.runs(left_out::DIRECT)) {
                    c.keep_lit(block, direct, state);
                }
                rays.fetch_add(traced, Relaxed);
                stage.advance(direct.len() as u64)
            })
        })?;
        if self.plan.runs(left_out::DIRECT) {
            let traced = self.average_direct(&texels, backs, &known, &mut light.direct, &light.state, &stage)?;
            rays.fetch_add(traced, Relaxed);
        }
        stats.direct = StageStats {
            seconds: start.elapsed().as_secs_f64(),
            rays: rays.into_inner(),
            bytes: (l.map.len() * TEXEL_BYTES + l.map.bytes()) as u64,
        };
        Ok(())
    }

    /// Direct light of the light map's texels.
    fn texel_light(&self) -> TexelLight<'_> {
        TexelLight {
            areas: self.atlas.areas(&self.atlas.map),
            direct: self.direct,
            samples: self.params.direct_samples,
            seed: purpose_seed(self.params.seed, purpose::DIRECT),
        }
    }

    /// Turns light without penumbrae at the samples of the range into all direct light, averaged over texels; returns the
    /// rays traced.
    fn average_direct(
        &self,
        texels: &TexelLight,
        backs: &[bool],
        known: &[bool],
        direct: &mut [Vec3],
        state: &[TexelState],
        stage: &Stage,
    ) -> Result<u64> {
        let (l, range) = (self.atlas, self.range.clone());
        let rays = AtomicU64::new(0);
        let mut variations: Vec<Variation> = try_vec(range.len(), "where direct light varies")?;
        l.scene.device().install(|| {
            let sharp = &direct[..];
            variations.par_chunks_mut(BLOCK).enumerate().for_each(|(block, out)| {
                let mut traced = 0;
                for (i, variation) in out.iter_mut().enumerate().filter(|_| !known[block]) {
                    let sample = range.start + block * BLOCK + i;
                    // What is baked by another shard, or was before, is computed here too.
                    let is_here = |s: usize| range.contains(&s) && !known[(s - range.start) / BLOCK];
                    *variation = texels.varies(sample, sharp[sample], |s| match is_here(s) {
                        true => sharp[s],
                        false => texels.sharp(&l.receiver(&l.map, backs, s), &mut traced),
                    });
                }
                rays.fetch_add(traced, Relaxed);
            });
            let blocks = direct[range.clone()].par_chunks_mut(BLOCK).zip(state[range.clone()].par_chunks(BLOCK));
            let blocks = blocks.zip(variations.par_chunks(BLOCK)).enumerate();
            blocks.try_for_each(|(block, ((direct, state), variations))| {
                if known[block] {
                    return stage.advance(direct.len() as u64);
                }
                let mut traced = 0;
                for (i, (direct, &variation)) in direct.iter_mut().zip(variations).enumerate() {
                    self.progress.check()?;
                    let sample = range.start + block * BLOCK + i;
                    let (back, receiver) = (l.is_back(&l.map, backs, sample), l.receiver(&l.map, backs, sample));
                    *direct = texels.irradiance(sample, back, &receiver, *direct, variation, &mut traced);
                }
                if let Some(c) = self.checkpoint {
                    c.keep_lit(block, direct, state);
                }
                rays.fetch_add(traced, Relaxed);
                stage.advance(direct.len() as u64)
            })
        })?;
        Ok(rays.into_inner())
    }
}
