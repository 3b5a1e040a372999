//! The bake: stages in order, each with its share of progress, time and memory. Those that live updates have, too, are
//! in [`stages`].
//!
//! The file is long because it has every stage once, in order: this order is what a reader looks for here.

mod direct;

use super::atlas::Atlas;
use super::atlas::fill::Filling;
use super::atlas::ids::{GatherTexel, LightTexel, PerTexel};
use super::changed::{Before, Keep, Redo};
use super::direct_blur;
use super::indirect::blur;
use super::indirect::gather::{Gathered, Tile, TileTexel};
use super::indirect::interpolation_contrast::GatherLight;
use super::indirect::radiance_map::Radiance;
use super::indirect::sample_set::SampleSet;
use super::indirect::split_texels;
use super::indirect::upsample::Upsampling;
use super::passes::{self, Passes};
use super::plan::{Plan, left_out};
use super::saved::checkpoint::Checkpoint;
use super::saved::share::Shares;
use super::seams::Stitch;
use super::stages::{self, Inputs, Own, purpose};
use super::texel_light::TilePoints;
use super::texel_light::averages::Variation;
use super::tiles::{TILE, in_order};
use super::{
    BakeParams, BakeStats, CheckpointParams, Light, Lightmap, Origin, ShareParams, StageStats, TexelState, directional,
};
use crate::base::directional::Directional;
use crate::base::error::{Error, Result, invalid_argument};
use crate::base::memory::{try_collect, try_filled, try_parts, try_to_vec, try_vec, try_zeroed};
use crate::base::parallel::{ParallelLoop, one_by_one};
use crate::base::progress::Progress;
use crate::base::sampling::{combine, purpose_seed};
use crate::base::scratch::Scratch;
use crate::direct::DirectLight;
use crate::scene::Scene;
use glam::Vec3;
use rayon::prelude::*;
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::Instant;

/// Texels handed to a thread at a time.
const BLOCK: usize = 1024;

/// Bytes per gather texel while a bake runs: light, blurred light, normal, variance, validity.
const GATHER_BYTES: usize = 3 * size_of::<Vec3>() + size_of::<f32>() + size_of::<bool>();

/// Bytes more if the blurred light is compared: its variance.
const COMPARED_BYTES: usize = size_of::<f32>();

/// Bytes per light map texel while a bake runs: direct and indirect light, state, variation of direct light.
const TEXEL_BYTES: usize = 2 * size_of::<Vec3>() + size_of::<TexelState>() + size_of::<Variation>();

/// Bytes of light by direction per gather texel, if it is asked for: plain and blurred.
const DIRECTIONAL_BYTES: usize = 2 * size_of::<Directional>();

impl Lightmap {
    /// Runs the pipeline. After an error or a cancel, the light of earlier bakes is unchanged.
    pub fn bake(&mut self, params: &BakeParams, progress: &Progress) -> Result<BakeStats> {
        self.bake_with(params, None, progress)
    }

    /// Runs the pipeline and keeps finished work in a file. A later call with the same scene, lights, layout and
    /// parameters continues from it, whatever ended this one; the light has the bits of an uninterrupted bake. The
    /// statistics cover the work of this call only.
    ///
    /// The file is created if it is not there (or empty), and stays when the bake is complete: the caller deletes it
    /// when the light has been saved. `InvalidArgument` if it is of another bake, `Io` if it is damaged or cannot be
    /// read or created, `InvalidState` if another bake is using it. If it cannot be written later, as on a full disk,
    /// the bake goes on, a warning is logged, and the content already in the file stays valid.
    pub fn bake_with(
        &mut self,
        params: &BakeParams,
        checkpoint: Option<&CheckpointParams>,
        progress: &Progress,
    ) -> Result<BakeStats> {
        self.bake_with_shares(params, None, checkpoint, progress)
    }

    /// Runs the pipeline without photons and the radiance map, which [`bake_share`](Self::bake_share) has computed with
    /// the same parameters and lights: reads them from the files of all shares. `Io` if one is missing or damaged,
    /// `InvalidArgument` if one is of another bake.
    pub fn bake_with_shares(
        &mut self,
        params: &BakeParams,
        shares: Option<&ShareParams>,
        checkpoint: Option<&CheckpointParams>,
        progress: &Progress,
    ) -> Result<BakeStats> {
        params.validate()?;
        shares.map_or(Ok(()), |shares| shares.validate(params))?;
        checkpoint.map_or(Ok(()), CheckpointParams::validate)?;
        self.bake_all(params, shares, checkpoint, None, progress)
    }

    /// Plans a bake.
    pub(super) fn planned(&self, direct: &DirectLight, params: &BakeParams) -> Plan {
        let two_sided = !self.atlas.radiance.layout.back_of.is_empty();
        let mut plan =
            Plan::new(&self.atlas.scene, direct, params, two_sided, self.atlas.info.uvs.unwrapped_charts > 0);
        plan.note_sides(&self.atlas.info);
        plan
    }

    /// Bakes with checked parameters, anew or, given what may be kept, what has changed.
    pub(super) fn bake_all(
        &mut self,
        params: &BakeParams,
        shares: Option<&ShareParams>,
        checkpoint: Option<&CheckpointParams>,
        keep: Option<Keep>,
        progress: &Progress,
    ) -> Result<BakeStats> {
        let total = self.atlas.map.len() as u64;
        if params.texel_begin > total || params.texel_end > total {
            return invalid_argument!(
                "texel_begin {} or texel_end {} lies beyond the light map's {total} texels",
                params.texel_begin,
                params.texel_end
            );
        }
        let end = if params.texel_end == 0 { total } else { params.texel_end };
        if params.target_error > 0.0 && end - params.texel_begin < total {
            return invalid_argument!(
                "target_error asks for all texels, and these are {} to {end}",
                params.texel_begin
            );
        }
        let origin = Origin::new(params, &self.atlas.scene.lights());
        let direct = self.atlas.scene.device().install(|| DirectLight::try_new(&self.atlas.scene))?;
        let mut plan = self.planned(&direct, params);
        let device = self.atlas.scene.device().clone();
        device.memory().reset_peak();
        let range = params.texel_begin as usize..end as usize;
        let count = range.len();
        let work = || {
            let (atlas, direct, range) = (&self.atlas, &direct, range.clone());
            let checkpoint = match checkpoint {
                Some(c) => Some(Checkpoint::open(c, atlas, &origin, [range.start as u64, range.end as u64])?),
                None => None,
            };
            let shares = shares.map(|shares| Shares::new(shares, atlas, &origin));
            let before = match keep {
                Some(keep) => self.before(params, &plan, direct, &origin, keep, progress)?,
                None => None,
            };
            let from = From { shares: shares.as_ref(), checkpoint: checkpoint.as_ref(), before: before.as_ref() };
            let passes = || self.passes(params, &plan, direct, &range, from, progress);
            let (mut light, mut stats) = atlas.scene.install(passes)?;
            stats.back_charts = light.backs.iter().filter(|&&b| b).count() as u64;
            plan.note_back_charts(stats.back_charts);
            plan.note_bright(&light.radiance.bright);
            if let Some((before, redo)) = before.as_ref().and_then(|b| Some((b, b.redo.get()?))) {
                stats.kept_texels = redo.kept();
                plan.note_kept(stats.kept_texels, range.len() as u64, before.keep_error);
                if let Some(&kept) = before.kept_radiance.get() {
                    plan.note_kept_radiance(kept, atlas.radiance.len() as u64);
                }
            }
            light.plan = plan.clone();
            light.origin = Some(origin);
            let stitch = self.stitch(&light, &range, params, &mut plan, &mut stats, progress)?;
            Ok((light, stats, stitch))
        };
        let scene = &self.atlas.scene;
        let (light, mut stats, stitch) = scene.while_unchanged(|| device.run(progress, work))?;
        stats.left_out = plan.left_out;
        stats.peak_bytes = device.memory().peak() as u64;
        self.plan = plan;
        let start = Instant::now();
        device.install(|| self.store(light, range, stitch));
        stats.compose.seconds = start.elapsed().as_secs_f64();
        stats.seconds += stats.compose.seconds;
        device.log_info(|| {
            let s = &stats;
            let stages = [("photons", &s.photons), ("radiance map", &s.radiance), ("gather map", &s.gather)];
            let stages = stages.map(|(name, s)| format!("{name} {:.3} s", s.seconds)).join(", ");
            format!(
                "baked {count} texels in {:.3} s ({stages}, direct light {:.3} s), at most {} bytes\n{}",
                s.seconds,
                s.direct.seconds,
                s.peak_bytes,
                self.plan.text().trim_end()
            )
        });
        Ok(stats)
    }

    /// Bakes in as many passes as the parameters ask for.
    fn passes(
        &self,
        params: &BakeParams,
        plan: &Plan,
        direct: &DirectLight,
        range: &Range<usize>,
        from: From,
        progress: &Progress,
    ) -> Result<(Light, BakeStats)> {
        let From { checkpoint, before, .. } = from;
        let run = |pass: u32, all: Option<&Passes>| {
            let params = &passes::params_of(params, pass);
            if let Some(c) = checkpoint {
                c.begin_pass(pass);
            }
            let (atlas, range) = (&self.atlas, range.clone());
            let (known_backs, held) = (all.map(|all| &all.light.backs[..]), all.map_or(0, Passes::bytes));
            Bake { atlas, params, plan, direct, range, progress, pass, from, known_backs, held }.run()
        };
        if params.passes == 1 && params.target_error == 0.0 {
            let (light, stats) = run(0, None)?;
            return Ok((light, BakeStats { passes: 1, ..stats }));
        }
        let device = self.atlas.scene.device();
        let mut needed = params.passes.max(2);
        progress.set_part(0.0, 1.0 / needed as f32);
        let (light, stats) = run(0, None)?;
        let mut all = Passes::begin(light, stats, range)?;
        loop {
            needed = device.install(|| all.needed(params, range));
            if all.count >= needed {
                progress.set_part(0.0, 1.0);
                let (mut light, stats) = device.install(|| all.finish(range));
                // Those of the first pass lie between other values.
                let find = || split_texels::find(&self.atlas, &light.radiance.values, &mut 0, progress);
                light.radiance.split = device.install(find)?;
                if let Some(before) = before {
                    before.keep_spread(&mut light);
                }
                return Ok((light, stats));
            }
            progress.set_part(all.count as f32 / needed as f32, (all.count + 1) as f32 / needed as f32);
            // All passes show the same sides.
            let (light, stats) = run(all.count, Some(&all))?;
            device.install(|| all.add(&light, &stats, range));
        }
    }

    /// Stores the new light of a range of samples. Seams are stitched anew: whatever the shards, the last one leaves
    /// the bits of a whole bake.
    pub(super) fn store(&mut self, new: Light, range: Range<usize>, stitch: Option<Stitch>) {
        let is_current = self.before.is_none();
        match &mut self.light {
            Some(old) if range.len() < self.atlas.map.len() && is_current => {
                if let Some(mut before) = old.stitch.take() {
                    before.swap(old);
                }
                old.direct[range.clone()].copy_from_slice(&new.direct[range.clone()]);
                old.indirect[range.clone()].copy_from_slice(&new.indirect[range.clone()]);
                if old.directional.len() == new.directional.len() {
                    let of_range = range.start.min(new.directional.len())..range.end.min(new.directional.len());
                    old.directional[of_range.clone()].copy_from_slice(&new.directional[of_range]);
                } else {
                    // Bakes that differ in what they were asked for: the light by direction of the last one stays.
                    (old.directional, old._memory) = (new.directional, new._memory);
                }
                if old.spread.len() == new.spread.len() {
                    let of_range = range.start.min(new.spread.len())..range.end.min(new.spread.len());
                    old.spread[of_range.clone()].copy_from_slice(&new.spread[of_range]);
                } else {
                    old.spread = new.spread;
                }
                old.state[range.clone()].copy_from_slice(&new.state[range]);
                old.radiance = new.radiance;
                old.backs = new.backs;
                old.plan = new.plan;
                old.origin = old.origin.filter(|&origin| Some(origin) == new.origin);
            }
            light => *light = Some(new),
        }
        self.before = None;
        let Some(light) = &mut self.light else { return };
        if let Some(mut stitch) = stitch {
            stitch.swap(light);
            light.stitch = Some(stitch);
        }
    }
}

/// Where light comes from that need not be computed.
#[derive(Clone, Copy)]
struct From<'a> {
    /// Photons and radiance map.
    shares: Option<&'a Shares<'a>>,
    checkpoint: Option<&'a Checkpoint<'a>>,
    /// Light from before a change, of which some is kept.
    before: Option<&'a Before<'a>>,
}

/// Inputs of one bake in progress.
struct Bake<'a, 'p> {
    atlas: &'a Atlas,
    params: &'a BakeParams,
    plan: &'a Plan,
    direct: &'a DirectLight,
    /// Texels of the light map to bake.
    range: Range<usize>,
    progress: &'a Progress<'p>,
    pass: u32,
    from: From<'a>,
    /// The charts that show their backs, if an earlier pass has decided it.
    known_backs: Option<&'a [bool]>,
    /// Bytes that earlier passes hold.
    held: usize,
}

/// The gather map after blur and filling.
struct Indirect {
    irradiance: Vec<Vec3>,
    /// Light by direction; empty if nobody asks for it.
    directional: Vec<Directional>,
    upsampling: Upsampling,
    own: Own,
}

impl<'p> Bake<'_, 'p> {
    fn run(&self) -> Result<(Light, BakeStats)> {
        let start = Instant::now();
        let mut stats = BakeStats::default();
        let memory = self.reserve()?;
        let scene = &self.atlas.scene;
        let mut indirect = None;
        let radiance = self.illuminate(&mut stats)?;
        let backs = self.backs(&radiance.values)?;
        let redo = match self.from.before {
            Some(before) => Some(self.redo(before, &radiance, &backs)?),
            None => None,
        };
        if self.plan.runs(left_out::INDIRECT) {
            indirect = Some(self.gather(&radiance, &backs, redo, &mut stats)?);
        }
        let n = self.atlas.map.len();
        let mut light = Light {
            direct: try_zeroed(n, "direct light")?,
            indirect: try_zeroed(n, "indirect light")?,
            directional: try_vec(if self.params.directional == 0 { 0 } else { n }, "light by direction")?,
            spread: Vec::new(),
            state: try_vec(n, "validity")?,
            radiance,
            backs,
            stitch: None,
            origin: None,
            plan: Plan::default(),
            _memory: memory,
        };
        if let Some((before, redo)) = self.from.before.zip(redo) {
            before.keep(redo, &mut light);
        }
        self.compose(scene, indirect.as_ref(), redo, &mut light, &mut stats)?;
        drop(indirect);
        let bytes = light.bytes();
        light._memory.shrink(bytes);
        stats.seconds = start.elapsed().as_secs_f64();
        Ok((light, stats))
    }

    /// Returns the inputs of the stages that live updates have, too.
    fn inputs(&self) -> Inputs<'_, 'p> {
        Inputs { atlas: self.atlas, direct: self.direct, params: self.params, progress: self.progress }
    }

    /// Returns what is computed anew, which the first pass decides.
    fn redo<'b>(&self, before: &'b Before, radiance: &Radiance, backs: &[bool]) -> Result<&'b Redo> {
        if let Some(redo) = before.redo.get() {
            return Ok(redo);
        }
        let (atlas, params, plan) = (self.atlas, self.params, self.plan);
        let find = || Redo::find(before, atlas, params, plan, (radiance, backs), self.progress);
        let redo = atlas.scene.device().install(find)?;
        Ok(before.redo.get_or_init(|| redo))
    }

    /// Computes the radiance map, or what has changed of it, or reads it from the checkpoint or from the files of shares; empty if the plan leaves
    /// indirect light out.
    fn illuminate(&self, stats: &mut BakeStats) -> Result<Radiance> {
        if !self.plan.runs(left_out::INDIRECT) {
            return Ok(Radiance::default());
        }
        if let Some(c) = self.from.checkpoint
            && let Some(radiance) = self.atlas.scene.device().install(|| c.radiance(self.atlas, self.progress))?
        {
            return Ok(radiance);
        }
        if let Some(before) = self.from.before
            && let Some(radiance) = before.illuminate(&self.inputs(), self.plan, stats)?
        {
            return Ok(radiance);
        }
        let radiance = match self.from.shares {
            Some(shares) => shares.radiance(&self.inputs(), self.pass, stats)?,
            None => stages::illuminate(&self.inputs(), self.plan, stats)?,
        };
        if let Some(c) = self.from.checkpoint {
            c.keep_radiance(&radiance);
        }
        Ok(radiance)
    }

    /// Decides which charts show their backs, or reads it from the checkpoint.
    fn backs(&self, radiance: &[Vec3]) -> Result<Vec<bool>> {
        let charts = self.atlas.charts.charts.len();
        if let Some(backs) = self.known_backs {
            return try_to_vec(backs, "the sides of charts");
        }
        if let Some(backs) = self.from.checkpoint.map(|c| c.backs(charts)).transpose()?.flatten() {
            return Ok(backs);
        }
        let backs = stages::backs(&self.inputs(), radiance)?;
        if let Some(c) = self.from.checkpoint {
            c.keep_backs(&backs);
        }
        Ok(backs)
    }

    /// Traces the fallback gathers, or reads their light from the checkpoint.
    fn own_light(
        &self,
        radiance: &Radiance,
        backs: &[bool],
        upsampling: &Upsampling,
        gathered: Option<&GatherLight>,
    ) -> Result<Own> {
        let texels = upsampling.own_work() as usize / 2;
        let asks = self.asks(directional::INDIRECT);
        if let Some(c) = self.from.checkpoint
            && let Some(light) = c.own_light(texels)?
            && let Some(directional) = if asks { c.own_directional(&light)? } else { Some(Vec::new()) }
        {
            return Ok(Own { light, directional, rays: 0 });
        }
        let own = stages::own_light(&self.inputs(), radiance, backs, upsampling, gathered, asks, (0.56, 0.65))?;
        if let Some(c) = self.from.checkpoint {
            if asks {
                c.keep_own_directional(&own.directional);
            }
            c.keep_own_light(&own.light);
        }
        Ok(own)
    }

    /// Announces the buffers of all stages but the photon map, which announces its own.
    fn reserve(&self) -> Result<crate::base::memory::Reservation> {
        let l = self.atlas;
        let mut bytes = l.map.len() * TEXEL_BYTES;
        if self.params.directional != 0 {
            // The sum of both kinds of light, and direct light before it is added.
            let arrays = 1 + usize::from(self.asks(directional::DIRECT));
            bytes += l.map.len() * arrays * size_of::<Directional>();
        }
        if self.blurs_direct() {
            bytes += l.map.len() * direct_blur::TEXEL_BYTES;
        }
        if self.asks(directional::INDIRECT) {
            bytes += l.gather.len() * DIRECTIONAL_BYTES;
        }
        if self.plan.runs(left_out::INDIRECT) {
            bytes += l.radiance.len() * 12 + l.gather.len() * self.gather_bytes();
        }
        let all = bytes + self.held;
        if self.params.memory_budget != 0 && all as u64 > self.params.memory_budget {
            return Err(Error::OutOfMemory(format!(
                "the bake's buffers take {all} bytes, more than memory_budget {}",
                self.params.memory_budget
            )));
        }
        l.scene.device().memory().reserve(bytes, "the bake's buffers")
    }

    /// Returns the bytes per gather texel while this bake runs, without light by direction.
    fn gather_bytes(&self) -> usize {
        GATHER_BYTES + if self.compares() && self.plan.runs(left_out::BLUR) { COMPARED_BYTES } else { 0 }
    }

    /// Whether the light of gather texels tells which texels of the light map gather for themselves.
    fn compares(&self) -> bool {
        self.params.interpolation_contrast < f32::INFINITY
    }

    /// Whether some light is computed and asked for by direction, given by a bit of [`directional`].
    fn asks(&self, bit: u32) -> bool {
        let stage = if bit == directional::INDIRECT { left_out::INDIRECT } else { left_out::DIRECT };
        self.params.directional & bit != 0 && self.plan.runs(stage)
    }

    /// Gathers indirect light, fills and blurs it. Only placements that the range touches are gathered.
    fn gather(
        &self,
        radiance: &Radiance,
        backs: &[bool],
        redo: Option<&Redo>,
        stats: &mut BakeStats,
    ) -> Result<Indirect> {
        let start = Instant::now();
        let l = self.atlas;
        let device = l.scene.device();
        let placement_of = |i: usize| l.map.texels.placement_of(i as u32).index();
        let placements = placement_of(self.range.start)..placement_of(self.range.end - 1) + 1;
        let starts = &l.gather.texels.chart_start;
        let needed = starts[placements.start] as usize..starts[placements.end] as usize;
        let asked = redo.map(Redo::asked);
        let is_needed = |texel: usize| redo.is_none_or(|redo| redo.gather[texel]);
        let mut upsampling = stages::upsampling(&self.inputs(), backs, placements.clone(), asked)?;
        let lookup = self.inputs().lookup(radiance);
        let samples = SampleSet::new(self.params.gather_rays, purpose_seed(self.params.seed, purpose::GATHER_SET))?;
        let seed = purpose_seed(self.params.seed, purpose::GATHER);
        let stage = self.progress.stage("gather", 0.315, 0.53, needed.len() as u64);
        let n = l.gather.len();
        let mut irradiance: Vec<Vec3> = try_zeroed(n, "the gather map")?;
        let mut normals: Vec<Vec3> = try_zeroed(n, "the gather map's normals")?;
        let mut variances: Vec<f32> = try_zeroed(n, "the gather map's variance")?;
        let mut valid: Vec<bool> = try_vec(n, "the gather map's validity")?;
        let asks = self.asks(directional::INDIRECT);
        let mut directional: Vec<Directional> = try_vec(if asks { n } else { 0 }, "the gather map by direction")?;
        let (new_tile, nothing) = (if asks { Tile::by_direction } else { Tile::new }, asks.then(Directional::default));
        let rays = AtomicU64::new(upsampling.rays + redo.map_or(0, |redo| redo.rays));
        let tiles = Scratch::new();
        device.install(|| {
            let values = irradiance[needed.clone()].par_chunks_mut(BLOCK);
            let normals = normals[needed.clone()].par_chunks_mut(BLOCK);
            let variances = variances[needed.clone()].par_chunks_mut(BLOCK);
            let valid = valid[needed.clone()].par_chunks_mut(BLOCK);
            let directional = directional.get_mut(needed.clone()).unwrap_or_default();
            let directional = try_parts(directional, BLOCK, needed.len())?;
            let blocks = values.zip(normals).zip(variances).zip(valid).zip(directional).enumerate();
            one_by_one(blocks).try_each(|(block, ((((values, normals), variances), valid), directional))| {
                if self.from.checkpoint.is_some_and(|c| c.gathered(block, values, variances, valid, directional)) {
                    for (i, normal) in normals.iter_mut().enumerate() {
                        let texel = GatherTexel::new(needed.start + block * BLOCK + i);
                        *normal = l.receiver(&l.gather, backs, texel).normal;
                    }
                    return stage.advance(values.len() as u64);
                }
                let (mut traced, mut tile) = (0, tiles.take(new_tile)?);
                let first = needed.start + block * BLOCK;
                let mut order = in_order(&l.gather, first..first + values.len())?;
                order.retain(|texel| is_needed(texel.index()));
                let mut receiver = l.receivers(&l.gather, backs);
                for texels_of_tile in order.chunks(Tile::texels(&samples)) {
                    let texel = |&texel: &GatherTexel| TileTexel {
                        receiver: receiver(texel),
                        seed: combine(seed, l.gather.seed(texel)),
                        gathered: Gathered::default(),
                        directional: nothing,
                    };
                    let mut texels = try_collect(texels_of_tile.iter().map(texel), "the texels of a tile")?;
                    for round in 0..samples.rounds() {
                        // A tile may have 4 million rays.
                        self.progress.check()?;
                        traced += tile.add_round(&l.scene, &lookup, &mut texels, &samples, round);
                    }
                    for (texel, of_texel) in texels_of_tile.iter().zip(&texels) {
                        let (i, TileTexel { receiver, gathered, .. }) = (texel.index() - first, of_texel);
                        (values[i], normals[i]) = (gathered.irradiance(), receiver.normal);
                        (variances[i], valid[i]) = (gathered.variance(), gathered.is_visible());
                        if let Some(directional) = directional.get_mut(i) {
                            *directional = of_texel.directional();
                        }
                    }
                }
                if let Some(c) = self.from.checkpoint {
                    c.keep_gathered(block, values, variances, valid, directional);
                }
                rays.fetch_add(traced, Relaxed);
                stage.advance(values.len() as u64)
            })
        })?;
        let is_hidden = |i: usize| needed.contains(&i) && is_needed(i) && !valid[i];
        Filling::new(n, |i| valid[i], is_hidden)?.fill(&l.charts, &l.gather, &mut irradiance, self.progress)?;
        if asks {
            let filling = Filling::new(n, |i| valid[i], is_hidden)?;
            filling.fill(&l.charts, &l.gather, &mut directional, self.progress)?;
        }
        let mut blurred_variances = Vec::new();
        if self.plan.runs(left_out::BLUR) {
            let stage = self.progress.stage("blur", 0.53, 0.55, if asks { 2 * n as u64 } else { n as u64 });
            let mut blurred = try_vec(n, "the blurred gather map")?;
            let mut noises = try_vec(if self.compares() { n } else { 0 }, "the blurred gather map's variance")?;
            let radius = self.params.blur_radius;
            let texels = blur::Texels { values: &irradiance, variances: &variances, valid: &valid, normals: &normals };
            let out = (&mut blurred[..], &mut noises[..]);
            blur::blur(device, &l.charts, &l.gather, (texels, &irradiance), radius, out, &stage)?;
            if asks {
                let mut out = try_vec(n, "the blurred gather map by direction")?;
                blur::blur(device, &l.charts, &l.gather, (texels, &directional), radius, (&mut out, &mut []), &stage)?;
                directional = out;
            }
            irradiance = blurred;
            blurred_variances = noises;
        }
        drop((normals, valid));
        let unblurred = PerTexel::new(&variances);
        let light = GatherLight {
            irradiance: PerTexel::new(&irradiance),
            variances: if blurred_variances.is_empty() { unblurred } else { PerTexel::new(&blurred_variances) },
            unblurred,
            rays: self.params.gather_rays,
            directional: &directional,
        };
        if self.compares() {
            let stage = self.progress.stage("contrast of the gather map", 0.55, 0.56, placements.len() as u64);
            let most = self.params.interpolation_contrast;
            upsampling.add_where_light_differs(l, placements, backs, &light, most, asked, &stage)?;
        }
        let own = self.own_light(radiance, backs, &upsampling, self.compares().then_some(&light))?;
        let bytes = (n * self.gather_bytes() + directional.len() * DIRECTIONAL_BYTES + l.gather.bytes()) as u64;
        let rays = rays.into_inner() + own.rays;
        stats.gather = StageStats { seconds: start.elapsed().as_secs_f64(), rays, bytes };
        Ok(Indirect { irradiance, directional, upsampling, own })
    }

    /// Computes direct light and interpolates indirect light for every texel of the range.
    fn compose(
        &self,
        scene: &Arc<Scene>,
        indirect: Option<&Indirect>,
        redo: Option<&Redo>,
        light: &mut Light,
        stats: &mut BakeStats,
    ) -> Result<()> {
        let start = Instant::now();
        let l = self.atlas;
        // Whose direct light is needed.
        let range = if self.blurs_direct() { direct_blur::needed(l, &self.range) } else { self.range.clone() };
        let blurred = if self.blurs_direct() { self.range.len() } else { 0 };
        let stage = self.progress.stage("direct", 0.65, 1.0, (2 * range.len() + blurred) as u64);
        let rays = AtomicU64::new(0);
        let backs = &light.backs[..];
        l.make_room_for_sky_seen(self.direct)?;
        let texels = self.texel_light();
        // Blocks whose light is in the checkpoint.
        let mut known = try_filled(range.len().div_ceil(BLOCK), false, "blocks of texels")?;
        let tiles = Scratch::new();
        let has_new_indirect = |texel: usize| redo.is_none_or(|redo| redo.indirect[texel]);
        let has_new_direct = |texel: usize| redo.is_none_or(|redo| redo.lit[texel]);
        let lit_only = self.lit_only(redo, &light.direct)?;
        lit_only.iter().for_each(|&(texel, _)| light.direct[texel as usize] = Vec3::ZERO);
        let asks = self.asks(directional::DIRECT);
        let new_tile = if asks { TilePoints::by_direction } else { TilePoints::new };
        // Direct light by direction, which is averaged before it is added to the rest.
        let mut directed: Vec<Directional> = try_vec(if asks { range.len() } else { 0 }, "direct light by direction")?;
        let noises = if self.blurs_direct() { range.len() } else { 0 };
        let mut variances: Vec<f32> = try_vec(noises, "the variance of direct light")?;
        scene.device().install(|| {
            let direct = light.direct[range.clone()].par_chunks_mut(BLOCK).zip(&mut known);
            let indirect_out = light.indirect[range.clone()].par_chunks_mut(BLOCK);
            let state = light.state[range.clone()].par_chunks_mut(BLOCK);
            let directional = light.directional.get_mut(range.clone()).unwrap_or_default();
            let directional = try_parts(directional, BLOCK, range.len())?;
            let directional = directional.into_par_iter().zip(try_parts(&mut directed, BLOCK, range.len())?);
            let noises = try_parts(&mut variances, BLOCK, range.len())?;
            let blocks = direct.zip(indirect_out).zip(state).zip(directional.zip(noises)).enumerate();
            one_by_one(blocks).try_each(|(block, ((((direct, known), ind), state), rest))| {
                let ((directional, directed), variances) = rest;
                let mut traced = 0;
                let first = range.start + block * BLOCK;
                if let Some(indirect) = indirect {
                    let irradiance = PerTexel::new(&indirect.irradiance);
                    let end = first + ind.len();
                    let texels = || LightTexel::range(first..end);
                    for (texel, ind) in texels().zip(&mut *ind).filter(|(texel, _)| has_new_indirect(texel.index())) {
                        *ind = indirect.upsampling.at(l, irradiance, &indirect.own.light, texel);
                    }
                    if !indirect.directional.is_empty() {
                        let from = PerTexel::new(&indirect.directional);
                        let of_texels = texels().zip(directional);
                        for (texel, out) in of_texels.filter(|(texel, _)| has_new_indirect(texel.index())) {
                            *out = indirect.upsampling.at(l, from, &indirect.own.directional, texel);
                        }
                    }
                }
                *known = self.from.checkpoint.is_some_and(|c| c.lit(block, direct, variances, state, directed));
                if *known {
                    return stage.advance(direct.len() as u64);
                }
                for (i, state) in state.iter_mut().enumerate() {
                    *state = match l.buried.get(first + i) {
                        Some(true) => TexelState::Hidden,
                        _ => TexelState::Visible,
                    };
                }
                if self.plan.runs(left_out::DIRECT) && self.direct.has_sharp() {
                    let mut tile = tiles.take(|| new_tile(TILE))?;
                    let mut order = in_order(&l.map, first..first + direct.len())?;
                    order.retain(|texel| has_new_direct(texel.index()));
                    let mut receiver = l.receivers(&l.map, backs);
                    for of_tile in order.chunks(4 * TILE) {
                        self.progress.check()?;
                        let receivers = of_tile.iter().map(|&texel| receiver(texel));
                        let place = |i: usize| of_tile[i].index() - first;
                        texels.sharp_of_tile(receivers, &mut tile, &mut traced, |i, sharp, by_direction| {
                            direct[place(i)] = sharp;
                            if let Some((directed, by_direction)) = directed.get_mut(place(i)).zip(by_direction) {
                                *directed = *by_direction;
                            }
                        });
                    }
                }
                if let Some(c) = self.from.checkpoint.filter(|_| !self.plan.runs(left_out::DIRECT)) {
                    c.keep_lit(block, direct, variances, state, directed);
                }
                rays.fetch_add(traced, Relaxed);
                stage.advance(direct.len() as u64)
            })
        })?;
        if self.plan.runs(left_out::DIRECT) {
            let direct = (&mut light.direct[..], &mut directed[..], &mut variances[..]);
            let traced = self.average_direct(&texels, backs, (&known, redo), &range, direct, &light.state, &stage)?;
            rays.fetch_add(traced, Relaxed);
            if self.blurs_direct() {
                let is_new = |texel: usize| redo.is_none_or(|redo| redo.direct[texel]);
                let light = (&variances[..], &mut light.direct[..], &mut directed[..]);
                direct_blur::blur(l, &range, &self.range, is_new, light, &stage)?;
            }
            for &(texel, before) in &lit_only {
                light.direct[texel as usize] = before;
                // Nothing is added to the sum that they keep.
                if let Some(directed) = directed.get_mut(texel as usize - range.start) {
                    *directed = Directional::default();
                }
            }
            let sums = light.directional.get_mut(range.clone()).unwrap_or_default();
            sums.iter_mut().zip(&directed).for_each(|(sum, &directed)| *sum += directed);
        }
        // Beside the range only what the blur needs was computed.
        for i in range.filter(|i| !self.range.contains(i)) {
            (light.direct[i], light.indirect[i], light.state[i]) = (Vec3::ZERO, Vec3::ZERO, TexelState::default());
            if let Some(directional) = light.directional.get_mut(i) {
                *directional = Directional::default();
            }
        }
        stats.direct = StageStats {
            seconds: start.elapsed().as_secs_f64(),
            rays: rays.into_inner(),
            bytes: (l.map.len() * TEXEL_BYTES + l.map.bytes()) as u64,
        };
        Ok(())
    }
}
