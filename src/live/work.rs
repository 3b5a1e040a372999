//! Work on one block, in steps: coarse direct light; a few rays of indirect light if that is of an earlier epoch; then
//! whichever reduces more error per ray: direct light at full resolution, the texels of the next LOD, or another round
//! of 64 rays for all. Work can stop after any texel and continue later; the sums of a texel depend on its number of
//! rounds alone, so they have the bits of a bake with as many rays.

use super::blocks::{Block, BlockMap, BlockStatus, BlockWork, DirectTile, DirectWork, Tile};
use super::relight::Illumination;
use super::shown_layer::Shown;
use crate::base::directional::Directional;
use crate::base::error::{Error, Result};
use crate::base::memory::{try_collect, try_filled, try_with_capacity};
use crate::base::sampling::combine;
use crate::direct::direct_light::Lights;
use crate::lightmap::atlas::ids::{GatherTexel, LightTexel};
use crate::lightmap::directional;
use crate::lightmap::indirect::gather::Gathered;
use crate::lightmap::indirect::near_hits::{HitRadiance, NearHits};
use crate::lightmap::indirect::radiance_map::RadianceLookup;
use crate::lightmap::indirect::sample_set::{ROUND, SampleSet};
use crate::lightmap::texel_light::averages::Averaged;
use crate::lightmap::texel_light::{TexelLight, TilePoints};
use glam::Vec3;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::time::Instant;

/// Maximum number of shadow rays per area light for coarse direct light.
const COARSE_SAMPLES: u32 = 4;

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
    /// Bits of [`directional`]: the light that is computed by direction too.
    pub directional: u32,
    /// Approximate number of rays that direct light at a point takes.
    pub direct_rays: f32,
    /// Light below which a texel counts as dark: a small part of the scene's mean.
    pub dim: f32,
    pub promote_threshold: u32,
    pub max_rounds: u32,
}

impl Context {
    /// Whether some light is asked for by direction, given by a bit of [`directional`].
    pub fn asks(&self, bit: u32) -> bool {
        self.directional & bit != 0
    }
}

/// Kind of work that a block can do next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    Direct,
    Indirect,
}

/// Conditions that end the work of an update.
pub(super) struct Limit {
    pub deadline: Option<Instant>,
    /// Number of rays that may be traced; `u64::MAX`: any number.
    pub rays: u64,
    pub traced: AtomicU64,
    /// Set to get the work back.
    pub stopped: AtomicBool,
    /// Set when memory for the work could not be allocated.
    pub out_of_memory: AtomicBool,
}

impl Limit {
    pub fn new(deadline: Option<Instant>, rays: u64) -> Limit {
        Limit {
            deadline,
            rays,
            traced: AtomicU64::new(0),
            stopped: AtomicBool::new(false),
            out_of_memory: AtomicBool::new(false),
        }
    }

    /// Returns an error if memory for the work could not be allocated.
    pub fn check_memory(&self) -> Result<()> {
        if self.out_of_memory.load(Relaxed) {
            return Err(Error::OutOfMemory("the light of a block of texels".into()));
        }
        Ok(())
    }

    /// Unwraps the result of an allocation; records a failure.
    fn granted<T>(&self, result: Result<T>) -> Option<T> {
        result.inspect_err(|_| self.out_of_memory.store(true, Relaxed)).ok()
    }

    /// Whether the limit has been reached; asked before every texel.
    pub fn reached(&self) -> bool {
        self.stopped.load(Relaxed)
            || self.traced.load(Relaxed) >= self.rays
            || self.deadline.is_some_and(|d| Instant::now() >= d)
    }
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
    pub fn work(&mut self, c: &Context, tile: &Tile, step: Step, limit: &Limit) -> Done {
        let mut done = Done::default();
        if tile.texels.is_empty() {
            return done;
        }
        if self.status.changes_behind(c) > 0 {
            done.coarse = self.work_on_coarse(c, tile, limit);
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
            Some(Kind::Direct) => done.direct = self.work_on_direct(c, tile, limit),
            Some(Kind::Indirect) => done.indirect = self.work_on_indirect(c, tile, limit),
            None => {}
        }
        done
    }

    /// Does one step of indirect light; returns whether it was completed.
    pub fn work_on_indirect(&mut self, c: &Context, tile: &Tile, limit: &Limit) -> bool {
        let Some((lod, rounds)) = self.status.target(c) else { return false };
        if self.status.indirect_epoch != c.light.indirect_epoch
            && limit.granted(self.begin_epoch(tile, c.light.indirect_epoch)).is_none()
        {
            return false;
        }
        let atlas = &c.map.atlas;
        let near = NearHits { direct: &c.light.direct, texels: c.near_hits };
        let map = RadianceLookup::new(&atlas.charts, &atlas.radiance, &c.light.radiance);
        let lookup = HitRadiance::new(map, near);
        let end = tile.lod_end[lod as usize];
        let work = &mut self.work;
        let missing = (end as usize).saturating_sub(work.gathered.len());
        let by_direction = if c.asks(directional::INDIRECT) { missing } else { 0 };
        if work.gathered.try_reserve_exact(missing).is_err()
            || work.directional.try_reserve_exact(by_direction).is_err()
        {
            limit.out_of_memory.store(true, Relaxed);
            return false;
        }
        while work.cursor < end {
            let i = work.cursor as usize;
            let texel = tile.texels[i];
            if work.gathered.len() <= i {
                work.gathered.push(Gathered::default());
                if c.asks(directional::INDIRECT) {
                    work.directional.push(Directional::default());
                }
            }
            let receiver = atlas.receiver(&atlas.gather, &c.light.sides.backs, texel);
            while work.gathered[i].rays < rounds * ROUND as u32 {
                if limit.reached() {
                    return false;
                }
                let before = work.gathered[i];
                let round = (before.rays as usize) / ROUND;
                let seed = combine(c.gather_seed, texel.seed());
                let (gathered, sum) = (&mut work.gathered[i], work.directional.get_mut(i));
                let rays =
                    gathered.add_round_by_direction(&atlas.scene, &lookup, &receiver, &c.samples, round, seed, sum);
                work.note_deviation(&before, i);
                limit.traced.fetch_add(rays, Relaxed);
            }
            work.cursor += 1;
        }
        work.cursor = 0;
        self.status.fresh_lod = lod;
        self.status.lod = self.status.lod.max(lod);
        self.status.rounds = rounds as u16;
        if self.status.target(c).is_none() {
            // A single round would leave the prior some weight for ever.
            self.work.drop_prior();
        }
        self.note_error(c.map.top());
        true
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

    /// Computes direct light of the lowest LOD's texels; returns whether there was memory for it.
    pub fn work_on_coarse(&mut self, c: &Context, tile: &Tile, limit: &Limit) -> bool {
        let (atlas, mut rays) = (&c.map.atlas, 0);
        let samples = c.direct_samples.min(COARSE_SAMPLES);
        let (texels, what) = (&tile.texels[..tile.lod_end[0] as usize], "coarse direct light");
        let count = if c.asks(directional::DIRECT) { texels.len() } else { 0 };
        let Some(mut by_direction) = limit.granted(try_with_capacity(count, what)) else { return false };
        let value = |&texel: &GatherTexel| {
            let receiver = atlas.receiver(&atlas.gather, &c.light.sides.backs, texel);
            let (direct, seed) = (&c.light.direct, combine(c.direct_seed, texel.seed()));
            if count == 0 {
                return direct.irradiance(&receiver, samples, seed, &mut rays);
            }
            let light = direct.at_point_by_direction(&receiver, Lights::All, samples, seed, &mut rays);
            by_direction.push(light.1);
            light.0.value()
        };
        let values = try_collect(texels.iter().map(value), what);
        let Some(values) = limit.granted(values) else { return false };
        self.work.new_coarse_directional = by_direction.into_boxed_slice();
        let sum: f32 = values.iter().map(|v| v.element_sum()).sum();
        self.status.direct_mean = sum / values.len().max(1) as f32;
        self.status.coarse_epoch = c.light.direct_epoch;
        self.work.new_coarse = values.into_boxed_slice();
        limit.traced.fetch_add(rays, Relaxed);
        true
    }

    /// Computes direct light of the block's light map texels; returns whether it was completed.
    fn work_on_direct(&mut self, c: &Context, of: &Tile, limit: &Limit) -> bool {
        let under_way = self.work.direct.take().filter(|w| w.epoch == c.light.direct_epoch);
        let begin = || {
            let rect = c.map.rect_in_light_map(of.placement, &of.rect);
            // Vertices far away can make a block as large as a page.
            let (area, around) = (rect.area(), rect.grown(1).area());
            let asked = usize::from(c.asks(directional::DIRECT));
            let tile = DirectTile { rect, values: unknown(area, limit)?, directional: unknown(asked * area, limit)? };
            let (sharp, sharp_directional) = (unknown(around, limit)?, unknown(asked * around, limit)?);
            Some(DirectWork { tile, next: 0, epoch: c.light.direct_epoch, sharp, sharp_directional })
        };
        let Some(mut direct) = under_way.or_else(begin) else { return false };
        let points = if c.asks(directional::DIRECT) { TilePoints::by_direction(1) } else { TilePoints::new(1) };
        let Some(mut points) = limit.granted(points) else {
            self.work.direct = Some(direct);
            return false;
        };
        let (width, corner) = (direct.tile.rect.width().max(1), (direct.tile.rect.x0, direct.tile.rect.y0));
        while (direct.next as usize) < direct.tile.values.len() {
            if limit.reached() {
                self.work.direct = Some(direct);
                return false;
            }
            let at = direct.next as usize;
            let (x, y) = (corner.0 + (at % width) as i32, corner.1 + (at / width) as i32);
            let mut rays = 0;
            if let Some((value, by_direction)) = direct_texel(c, of, x, y, &mut direct, &mut points, &mut rays) {
                direct.tile.values[at] = value;
                if let Some(here) = direct.tile.directional.get_mut(at) {
                    *here = by_direction;
                }
            }
            limit.traced.fetch_add(rays, Relaxed);
            direct.next += 1;
        }
        self.status.direct_epoch = direct.epoch;
        self.work.new_direct = Some(direct.tile);
        true
    }
}

impl BlockWork {
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

/// The texel of the light map at a column and row of a block's page; `None` if it is not the block's.
pub(super) fn owns(c: &Context, tile: &Tile, x: i32, y: i32) -> Option<LightTexel> {
    let a = &c.map.atlas;
    let at = a.map.at(tile.placement, x, y);
    let texel = at.filter(|&texel| a.map.placement_of(&a.charts, texel) == tile.placement)?;
    let at = a.gather.layout.texel_coord(tile.placement, a.texel_local(tile.placement, texel));
    // Includes one texel around the block's own, so that rounding leaves no gaps between blocks.
    let own = tile.rect.grown(1);
    let (gx, gy) = (at[0].floor() as i32, at[1].floor() as i32);
    (gx >= own.x0 && gx < own.x1 && gy >= own.y0 && gy < own.y1).then_some(texel)
}

/// Makes room for direct light of texels, of which nothing is known yet.
fn unknown<T: Shown>(texels: usize, limit: &Limit) -> Option<Box<[T]>> {
    limit.granted(try_filled(texels, T::UNKNOWN, "direct light")).map(Vec::into_boxed_slice)
}

/// Direct light of a texel of the light map, and that light by direction if it is asked for; `None` if the texel is not
/// the block's; infinite if it is inside a solid.
fn direct_texel(
    c: &Context,
    tile: &Tile,
    x: i32,
    y: i32,
    work: &mut DirectWork,
    points: &mut TilePoints,
    rays: &mut u64,
) -> Option<(Vec3, Directional)> {
    let (a, texel) = (&c.map.atlas, owns(c, tile, x, y)?);
    let backs = &c.light.sides.backs;
    let receiver = a.receiver(&a.map, backs, texel);
    let texels =
        TexelLight { areas: a.areas(&a.map), direct: &c.light.direct, samples: c.direct_samples, seed: c.direct_seed };
    // Light without penumbrae of texels that are needed as neighbours too is computed once per tile.
    let known = work.tile.rect.grown(1);
    let mut sharp_at = |s: LightTexel| {
        let (x, y) = a.map.position(s);
        let i = (y - known.y0) as usize * known.width() + (x - known.x0) as usize;
        let sharp = &mut work.sharp[i];
        let directional = work.sharp_directional.get_mut(i);
        if sharp.x.is_nan() {
            let receiver = a.receiver(&a.map, backs, s);
            match directional {
                Some(directional) => (*sharp, *directional) = texels.sharp_by_direction(&receiver, rays),
                None => *sharp = texels.sharp(&receiver, rays),
            }
        }
        (*sharp, work.sharp_directional.get(i).copied().unwrap_or_default())
    };
    let (sharp, sharp_directional) = sharp_at(texel);
    let variation = texels.varies(texel, sharp, |s| sharp_at(s).0);
    let back = a.is_back(&a.map, backs, texel);
    let mut light = (Vec3::ZERO, Directional::default());
    let averaged = Averaged { texel, back, receiver, sharp, sharp_directional, variation };
    texels.irradiance(&[averaged], points, rays, |_, e, by_direction| light = (e, *by_direction));
    Some(light)
}
