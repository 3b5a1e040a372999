//! Work on one block, in steps: coarse direct light; a few rays of indirect light if that is of an earlier epoch; then
//! whichever reduces more error per ray: direct light at full resolution, the texels of the next LOD, or another round
//! of 64 rays for all. Rays of texels that follow one another are traced together, a few texels or many by the time that
//! is left, and work can stop after any of them and continue later; the sums of a texel depend on its number of rounds
//! alone, so they have the bits of a bake with as many rays.

use super::blocks::{Block, BlockMap, BlockStatus, BlockWork, Tile};
use super::illumination::Illumination;
use super::limit::Limit;
use super::room::{Room, Rooms};
use super::shown_layer::Shown;
use crate::base::directional::Directional;
use crate::base::error::Result;
use crate::base::memory::try_collect;
use crate::base::sampling::combine;
use crate::base::scratch::Taken;
use crate::lightmap::directional;
use crate::lightmap::indirect::gather::{Gathered, TileTexel};
use crate::lightmap::indirect::near_hits::{HitRadiance, NearHits};
use crate::lightmap::indirect::radiance_map::RadianceLookup;
use crate::lightmap::indirect::sample_set::{ROUND, SampleSet};
use glam::Vec3;
use std::ops::Range;
use std::sync::Arc;
use std::time::Instant;

/// Gain of rays under new light.
const OLD_LIGHT: f32 = 1e30;

/// Relative error assumed of coarse direct light: shadows are missing or blurred over whole blocks, which is the most
/// visible error.
const DIRECT_ERROR: f32 = 2.0;

/// Weight of old light relative to the first round of rays under new light. More would hide the noise of that round,
/// but old light is mostly further from the truth.
const PRIOR_WEIGHT: f32 = 0.25;

/// Shared input of all work on blocks.
#[derive(Clone)]
pub(super) struct Context {
    pub map: Arc<BlockMap>,
    pub light: Arc<Illumination>,
    pub samples: Arc<SampleSet>,
    pub gather_seed: u32,
    /// Distance up to which hits of gather rays are near: [`NearHits::texels`].
    pub near_hits: f32,
    pub direct_seed: u32,
    pub direct_samples: u32,
    /// Whether noise of direct light is blurred.
    pub blurs: bool,
    /// Bits of [`directional`]: the light that is computed by direction too.
    pub directional: u32,
    /// Approximate number of rays that direct light at a point takes.
    pub direct_rays: f32,
    /// Light below which a texel counts as dark: a small part of the scene's mean.
    pub dim: f32,
    pub promote_threshold: u32,
    pub max_rounds: u32,
    /// Working memory of the threads.
    pub rooms: Arc<Rooms>,
}

impl Context {
    /// Whether some light is asked for by direction, given by a bit of [`directional`].
    pub fn asks(&self, bit: u32) -> bool {
        self.directional & bit != 0
    }

    /// Working memory for one thread.
    pub fn room(&self) -> Result<Taken<'_, Room>> {
        self.rooms.take(|| Room::new([directional::INDIRECT, directional::DIRECT].map(|bit| self.asks(bit))))
    }

    /// What gather rays see where they hit.
    fn lookup(&self) -> HitRadiance<'_> {
        let (atlas, light) = (&self.map.atlas, &self.light);
        let map = RadianceLookup::new(&atlas.charts, &atlas.radiance, &light.radiance);
        HitRadiance::new(map, NearHits { direct: &light.direct, texels: self.near_hits })
    }
}

/// Kind of work that a block can do next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    Direct,
    Indirect,
}

/// Amount of work to be done on a block.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Step {
    /// Coarse direct light, if it was computed under other lights than the current ones. The other steps begin with
    /// this too.
    Coarse,
    /// Direct light at full resolution.
    Direct,
    /// Whichever of direct and indirect light gains more.
    Next,
}

/// Results of work on a block.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Done {
    /// Coarse direct light is new.
    pub coarse: bool,
    /// Direct light at full resolution is new.
    pub direct: bool,
    /// A step of indirect light was completed.
    pub indirect: bool,
}

impl Done {
    /// Whether there is anything to show.
    pub fn any(&self) -> bool {
        self.coarse || self.direct || self.indirect
    }
}

impl BlockStatus {
    /// LOD and number of rounds that the next step works towards; `None` if nothing is left to do.
    fn target(&self, c: &Context) -> Option<(u8, u32)> {
        let top = c.map.top();
        if !c.light.has_indirect {
            None
        } else if self.indirect_epoch != c.light.indirect_epoch || self.rounds == 0 {
            // New light: begins with a little of it everywhere.
            Some((0, c.promote_threshold))
        } else if self.fresh_lod < top {
            Some((self.fresh_lod + 1, c.promote_threshold))
        } else if (self.rounds as u32) < c.max_rounds {
            Some((top, self.rounds as u32 + 1))
        } else {
            None
        }
    }

    /// Whether all rays have been traced under the current light.
    pub fn is_finished(&self, c: &Context) -> bool {
        self.has_direct(c) && self.target(c).is_none()
    }

    /// Whether direct light has been computed at full resolution under the current light.
    pub fn has_direct(&self, c: &Context) -> bool {
        self.direct_epoch == c.light.direct_epoch
    }

    /// Whether all of the block's indirect light is of an earlier epoch.
    pub fn has_old_light(&self, c: &Context) -> bool {
        c.light.has_indirect && self.indirect_epoch != c.light.indirect_epoch
    }

    /// Number of changes of the lights since the coarse direct light was computed.
    pub fn changes_behind(&self, c: &Context) -> u32 {
        c.light.direct_epoch - self.coarse_epoch
    }

    /// The kind of work that gains most next, and its gain: reduction of error per ray.
    pub fn next(&self, c: &Context, tile: &Tile) -> Option<(Kind, f32)> {
        if self.has_old_light(c) {
            // Few rays make a great difference here, so they come before all else.
            return Some((Kind::Indirect, OLD_LIGHT));
        }
        // Errors in dark places are more visible than their absolute size suggests, and less than their relative size
        // does.
        let scale = 1.0 / (self.mean + self.direct_mean + c.dim).max(f32::MIN_POSITIVE).sqrt();
        let direct = (!self.has_direct(c)).then(|| {
            let rays = tile.map_texels as f32 * c.direct_rays;
            (Kind::Direct, scale * DIRECT_ERROR * (self.direct_mean + 0.1 * self.mean + c.dim) / rays.max(1.0))
        });
        let indirect = self.target(c).map(|(lod, rounds)| {
            let known = if lod > 0 && rounds == c.promote_threshold { tile.lod_end[lod as usize - 1] } else { 0 };
            let rays = (tile.lod_end[lod as usize] - known) as f32 * ROUND as f32;
            // Even a block with an error of 0 gets its turn.
            (Kind::Indirect, scale * self.error.max(1e-4) * (self.mean + c.dim) / rays.max(1.0))
        });
        match (direct, indirect) {
            (Some(d), Some(i)) => Some(if i.1 > d.1 { i } else { d }),
            (one, other) => one.or(other),
        }
    }
}

impl Block {
    /// Works until a step is completed or the limit is reached.
    pub fn work(&mut self, c: &Context, tile: &Tile, step: Step, room: &mut Room, limit: &Limit) -> Done {
        let mut done = Done::default();
        if tile.texels.is_empty() {
            return done;
        }
        if self.status.changes_behind(c) > 0 {
            done.coarse = self.work_on_coarse(c, tile, room, limit);
            if !done.coarse {
                return done;
            }
        }
        let kind = match step {
            Step::Coarse => None,
            Step::Direct => (!self.status.has_direct(c)).then_some(Kind::Direct),
            Step::Next => self.status.next(c, tile).map(|n| n.0),
        };
        match kind {
            Some(Kind::Direct) => done.direct = self.work_on_direct(c, tile, room, limit),
            Some(Kind::Indirect) => done.indirect = self.work_on_indirect(c, tile, room, limit),
            None => {}
        }
        done
    }

    /// Does one step of indirect light; returns whether it was completed.
    pub fn work_on_indirect(&mut self, c: &Context, tile: &Tile, room: &mut Room, limit: &Limit) -> bool {
        let Some((lod, rounds)) = self.begin_step(c, tile, limit) else { return false };
        let (end, rays) = (tile.lod_end[lod as usize] as usize, rounds * ROUND as u32);
        let lookup = c.lookup();
        while (self.work.cursor as usize) < end {
            let first = self.work.cursor as usize;
            let known = self.work.rays(first);
            if known >= rays {
                // It is of a lower LOD, or its rays were traced before the work was saved.
                self.work.cursor += 1;
                continue;
            }
            if limit.reached() {
                return false;
            }
            let most = room.gather_pace.texels(limit, ROUND as u64);
            let count = (first..end).take(most).take_while(|&i| self.work.rays(i) == known).count();
            let begun = Instant::now();
            room.texels.clear();
            self.work.take_texels(c, tile, first..first + count, &mut room.texels);
            let round = known as usize / ROUND;
            let traced = room.gather.add_round(&c.map.atlas.scene, &lookup, &mut room.texels, &c.samples, round);
            self.work.put_texels(first, &room.texels);
            room.gather_pace.note(begun, count);
            limit.add(traced);
        }
        self.end_step(c, lod, rounds);
        true
    }

    /// Does the first step of indirect light of blocks that have none, together.
    pub fn first_indirect(c: &Context, blocks: &mut [(Block, &Tile)], room: &mut Room, limit: &Limit) {
        let lookup = c.lookup();
        let mut step = None;
        for (block, tile) in &mut *blocks {
            step = block.begin_step(c, tile, limit);
            if step.is_none() {
                return;
            }
        }
        let Some((lod, rounds)) = step else { return };
        for round in 0..rounds as usize {
            let mut from = 0;
            while from < blocks.len() {
                // As many blocks as have room in a tile.
                room.texels.clear();
                let mut to = from;
                while let Some((block, tile)) = blocks.get(to) {
                    let count = tile.lod_end[lod as usize] as usize;
                    if to > from && room.texels.len() + count > Room::TEXELS {
                        break;
                    }
                    block.work.take_texels(c, tile, 0..count, &mut room.texels);
                    to += 1;
                }
                limit.add(room.gather.add_round(&c.map.atlas.scene, &lookup, &mut room.texels, &c.samples, round));
                let mut texels = &room.texels[..];
                for (block, tile) in &mut blocks[from..to] {
                    let (own, others) = texels.split_at(tile.lod_end[lod as usize] as usize);
                    block.work.put_texels(0, own);
                    texels = others;
                }
                from = to;
            }
        }
        blocks.iter_mut().for_each(|(block, _)| block.end_step(c, lod, rounds));
    }

    /// Begins a step of indirect light, or goes on with one. Returns the LOD and the number of rounds that it works
    /// towards; `None` if nothing is left to do, or if there is no memory for it.
    fn begin_step(&mut self, c: &Context, tile: &Tile, limit: &Limit) -> Option<(u8, u32)> {
        let (lod, rounds) = self.status.target(c)?;
        if self.status.indirect_epoch != c.light.indirect_epoch {
            limit.granted(self.begin_epoch(tile, c.light.indirect_epoch))?;
        }
        let work = &mut self.work;
        let missing = (tile.lod_end[lod as usize] as usize).saturating_sub(work.gathered.len());
        let by_direction = if c.asks(directional::INDIRECT) { missing } else { 0 };
        if work.gathered.try_reserve_exact(missing).is_err()
            || work.directional.try_reserve_exact(by_direction).is_err()
        {
            limit.note_out_of_memory();
            return None;
        }
        Some((lod, rounds))
    }

    /// Records that all texels of a step have its rays.
    fn end_step(&mut self, c: &Context, lod: u8, rounds: u32) {
        self.work.cursor = 0;
        self.status.fresh_lod = lod;
        self.status.lod = self.status.lod.max(lod);
        self.status.rounds = rounds as u16;
        if self.status.target(c).is_none() {
            // A single round would leave the prior some weight for ever.
            self.work.drop_prior();
        }
        self.note_error(c.map.top());
    }

    /// Keeps the current light as a prior and starts over. An error changes nothing.
    fn begin_epoch(&mut self, tile: &Tile, epoch: u32) -> Result<()> {
        let work = &mut self.work;
        if !work.gathered.is_empty() {
            let (what, all) = ("light of before a change", 0..tile.texels.len());
            let known = all.clone().map(|i| work.estimate(i).unwrap_or(Shown::UNKNOWN));
            let prior = try_collect(known, what)?.into_boxed_slice();
            let all = if work.directional.is_empty() { 0..0 } else { all };
            let by_direction = all.map(|i| work.directional(i).unwrap_or(Shown::UNKNOWN));
            work.prior_directional = try_collect(by_direction, what)?.into_boxed_slice();
            work.prior = prior;
        }
        work.gathered.clear();
        work.directional.clear();
        work.cursor = 0;
        (work.deviations, work.deviation_count) = (0.0, 0);
        let status = &mut self.status;
        (status.indirect_epoch, status.fresh_lod, status.rounds) = (epoch, 0, 0);
        Ok(())
    }

    /// Estimates mean and relative error of the block's indirect light: the spread of its rounds, if there is more than
    /// one, and, if texels are interpolated, half the spread of those that are not.
    pub fn note_error(&mut self, top: u8) {
        let values = || self.work.gathered.iter().filter(|g| g.rays > 0).map(|g| g.irradiance().element_sum());
        let n = values().count().max(1) as f32;
        let mean = values().sum::<f32>() / n;
        self.status.mean = mean;
        let error = if mean > 0.0 {
            let spread = (values().map(|v| (v - mean).powi(2)).sum::<f32>() / n).sqrt() / mean;
            let noise = if self.work.deviation_count > 0 {
                (self.work.deviations / self.work.deviation_count as f32 / self.status.rounds.max(1) as f32).sqrt()
                    / mean
            } else {
                // A single round gives no estimate of its noise; it makes neighbours differ at least that much. Few
                // texels do not even give this estimate.
                spread.max(1.0 / n).min(1.0) / (self.status.rounds.max(1) as f32).sqrt()
            };
            if self.status.fresh_lod < top { noise + 0.5 * spread.min(1.0) + 0.02 } else { noise }
        } else {
            // The block is dark, or the texels so far lie hidden inside something and those of the next LOD do not.
            (self.status.fresh_lod < top) as u8 as f32
        };
        // The square of light beyond 1e19 overflows a float.
        self.status.error = if error.is_finite() { error } else { 1.0 };
    }
}

impl BlockWork {
    /// Number of gather rays of texel `i`.
    fn rays(&self, i: usize) -> u32 {
        self.gathered.get(i).map_or(0, |g| g.rays)
    }

    /// Appends texels with what they have gathered so far.
    fn take_texels(&self, c: &Context, tile: &Tile, texels: Range<usize>, out: &mut Vec<TileTexel>) {
        let (atlas, asks) = (&c.map.atlas, c.asks(directional::INDIRECT));
        out.extend(texels.map(|i| TileTexel {
            receiver: atlas.receiver(&atlas.gather, &c.light.sides.backs, tile.texels[i]),
            seed: combine(c.gather_seed, atlas.gather.seed(tile.texels[i])),
            gathered: self.gathered.get(i).copied().unwrap_or_default(),
            directional: asks.then(|| self.directional.get(i).copied().unwrap_or_default()),
        }));
    }

    /// Takes over what the texels from the `first` on have gathered.
    fn put_texels(&mut self, first: usize, texels: &[TileTexel]) {
        for (i, texel) in (first..).zip(texels) {
            if self.gathered.len() <= i {
                self.gathered.push(Gathered::default());
                self.directional.extend(texel.directional.map(|_| Directional::default()));
            }
            let before = std::mem::replace(&mut self.gathered[i], texel.gathered);
            if let (Some(sum), Some(new)) = (self.directional.get_mut(i), texel.directional) {
                *sum = new;
            }
            self.note_deviation(&before, i);
        }
    }

    /// Estimate of the light of texel `i`: from its own rays, with the prior's light fading while these are few.
    pub fn estimate(&self, i: usize) -> Option<Vec3> {
        self.with_prior(i, &self.prior, |g| g.irradiance())
    }

    /// Estimate of the light of texel `i` by direction; `None` also if nobody asks for it.
    pub fn directional(&self, i: usize) -> Option<Directional> {
        let own = |g: &Gathered| g.directional(self.directional.get(i).copied().unwrap_or_default());
        let asked = !self.directional.is_empty() || !self.prior_directional.is_empty();
        asked.then(|| self.with_prior(i, &self.prior_directional, own)).flatten()
    }

    fn with_prior<T: Shown>(&self, i: usize, prior: &[T], own: impl Fn(&Gathered) -> T) -> Option<T> {
        let prior = prior.get(i).copied().filter(T::is_known);
        let Some(g) = self.gathered.get(i).filter(|g| g.rays > 0) else { return prior };
        let Some(prior) = prior else { return Some(own(g)) };
        // The prior loses its weight within two rounds.
        let n = g.rays as f32 / ROUND as f32;
        let weight = PRIOR_WEIGHT * (2.0 - n).max(0.0);
        Some((prior * weight + own(g) * n) / (weight + n))
    }

    /// Variance of the light that texel `i` has gathered, infinite before it has gathered any.
    pub fn variance(&self, i: usize) -> f32 {
        self.gathered.get(i).filter(|g| g.rays > 0).map_or(f32::INFINITY, |g| g.variance())
    }

    /// Whether texel `i` can be seen, as far as is known so far.
    pub fn is_visible(&self, i: usize) -> bool {
        self.gathered.get(i).is_none_or(|g| g.is_visible())
    }

    /// Whether any texel gathered so far can be seen and sees light.
    pub fn sees_light(&self) -> bool {
        self.gathered.iter().any(|g| g.is_visible() && g.sum != Vec3::ZERO)
    }

    /// Drops the prior when it has no weight left: when a step of the second round has been completed.
    pub fn drop_faded_prior(&mut self, status: &BlockStatus) {
        if status.rounds >= 2 && self.cursor == 0 {
            self.drop_prior();
        }
    }

    fn drop_prior(&mut self) {
        (self.prior, self.prior_directional) = (Box::default(), Box::default());
    }

    /// Records how far a round lies from the mean of the rounds before it (Welford 1962).
    fn note_deviation(&mut self, before: &Gathered, i: usize) {
        let (n, after) = (before.rays as f32 / ROUND as f32, &self.gathered[i]);
        if n > 0.0 {
            let mean = before.irradiance().element_sum();
            let round = after.irradiance().element_sum() * (n + 1.0) - mean * n;
            self.deviations += (round - mean).powi(2) * n / (n + 1.0);
            self.deviation_count += 1;
        }
    }
}
