//! Texels that nobody can see: inside solids, below objects that stand on their surface, behind mouldings, in hollow
//! walls.
//!
//! Their light differs from that of the visible surface beside them, and bilinear filtering and interpolation would
//! spread it there, as dark rims where walls meet or light that leaks below walls. Therefore the sample of each is
//! moved to that of the nearest texel of its chart that can be seen, in the light map, the gather map and the radiance
//! map alike, unless another point of the texel itself can be seen, in whatever triangle of the chart. Bakes and live
//! updates use the moved samples without further distinction.
//!
//! A texel is buried if, on the side that it shows, almost all rays end within about a texel, on backs of one-sided
//! surfaces, or on sides that cannot be seen from any [open place](super::seen), or if most of them end on such backs, or,
//! where no sun or sky shines, if all of them end on backs, some of them near, or leave the scene, and no lamp can be seen,
//! as below the floor of a room of sheets. (A floor below a grate, or beside the back of a wall in the open, sees nothing
//! else either, but from farther away or in the light of a lamp.)
//!
//! Texels of [ledges] behind walls count as buried, too.

use super::chart_index::ChartIndex;
use super::chart_map::{ChartMap, receiver_of};
use super::charts::Charts;
use super::fill::{Hole, around};
use super::ids::{GatherMap, LightMap, Map, PlacementId, RadianceMap, TexelId, TexelRange};
use super::seen::{self, Seen};
use super::texels::TexelSample;
use crate::base::bounds::Bounds;
use crate::base::error::Result;
use crate::base::memory::{try_append, try_collect, try_filled, try_par_collect, try_push, try_vec, try_with_capacity};
use crate::base::parallel::one_by_one;
use crate::base::progress::Stage;
use crate::base::sampling::{cosine_around, sobol_2d};
use crate::base::scratch::Scratch;
use crate::scene::Scene;
use crate::trace::{RawHit, Ray};
use glam::Vec3;
use rayon::prelude::*;

/// Maximum number of rays that test a point.
const RAYS: u32 = 16;

/// Minimum number of rays that end in the open for a texel to be visible, unless more than half of all rays end on
/// backs.
const OPEN: u32 = 3;

/// A texel that no lamp shines on and whose rays all leave an indoor scene or end on backs is buried if one in this many
/// ends on a back that is [near](NEARBY): outside of a corner a quarter end on backs.
const FEW_BACKS: u32 = 8;

/// Backs up to this many times `near` away tell that a texel which sees nothing else lies below or behind a surface.
const NEARBY: f32 = 4.0;

/// What lies within this many times the distance at which surfaces cover texels may cover some.
const REACH: f32 = 4.0;

/// Maximum number of lamps that are looked for.
const LAMPS: usize = 64;

/// A texel is visible at once if its first ray ends in the open, farther away than this many times `near`: most texels
/// need only one ray.
const AT_ONCE: f32 = 4.0;

/// Number of rays after which a texel's sample counts as buried if none of them has ended in the open. (Two fifths fewer rays
/// than without this and [`GIVE_UP_OTHERS`]; in Sponza two in a thousand visible samples are lost, those that see least:
/// docs/experiments.md#sides-and-buried-texels.)
const GIVE_UP: u32 = 8;

/// The same of another point of a texel. (One in five of the visible ones is lost.)
const GIVE_UP_OTHERS: u32 = 4;

/// Number of other points of a texel, in the triangle of its sample and in other triangles, that are tested if its sample is
/// buried, and number of candidates for them, which may miss its chart.
const POINTS: usize = 4;
const POINT_TRIES: u32 = 32;

/// Number of points that are tested together.
const BLOCK: usize = 256;

pub(super) const BURIED: &str = "which texels are buried";

/// A map whose buried texels are looked for.
pub(in crate::lightmap) trait Searched: Map {
    /// Whether texels with another point that can be seen show that point. (It is a strip along the surface that covers the
    /// texel, often darker than its surroundings; the gather map would spread that darkness as a rim.)
    const BY_PARTS: bool;
    /// Whether texels on [ledges] take the light of those in the room.
    const LEDGES: bool;
}

impl Searched for LightMap {
    const BY_PARTS: bool = true;
    const LEDGES: bool = true;
}

impl Searched for GatherMap {
    const BY_PARTS: bool = false;
    // Light map texels use those gather texels that they see.
    const LEDGES: bool = false;
}

impl Searched for RadianceMap {
    const BY_PARTS: bool = true;
    // Its texels have a value for each side of a wall.
    const LEDGES: bool = false;
}

/// Inputs of the search for buried texels.
#[derive(Clone, Copy)]
pub(in crate::lightmap) struct Search<'a> {
    pub scene: &'a Scene,
    pub charts: &'a Charts,
    pub index: &'a ChartIndex,
    pub seen: &'a Seen,
    /// Distance up to which surfaces cover a texel, at most the width of a texel of the light map.
    pub near: f32,
    /// Whether a sun or a sky shines, so that people may stand where rays leave the scene.
    pub outdoors: bool,
    /// Which texels are searched; `None`: all are.
    pub only: Option<Only<'a>>,
}

/// Which texels are searched.
#[derive(Clone, Copy)]
pub(in crate::lightmap) struct Only<'a> {
    /// By chart.
    pub charts: &'a [Part],
    /// Where those of [`Part::Near`] are.
    pub boxes: &'a [Bounds],
}

/// Part of a chart that is searched.
#[derive(Clone, Copy, PartialEq)]
pub(in crate::lightmap) enum Part {
    None,
    /// Texels whose samples lie in the boxes. All others have the samples that they are to have.
    Near,
    All,
}

/// Returns the distance from what has changed within which texels are searched again, given that at which surfaces cover texels and
/// the width of a texel of the light map.
pub(in crate::lightmap) fn reach(near: f32, texel: f32) -> f32 {
    (REACH * near).max(ledges::REACH * texel)
}

impl Only<'_> {
    /// Whether a texel is searched whose chart is searched in part.
    pub fn is_near(&self, scene: &Scene, texel: &TexelSample) -> bool {
        let at = texel.position(scene);
        self.boxes.iter().any(|bounds| bounds.contains(at))
    }
}

impl Search<'_> {
    /// Moves the samples of a map's buried texels, and of those on [ledges], to the nearest visible ones, and returns which
    /// texels were moved (empty: none) and the number of rays. If [by parts](Searched::BY_PARTS), samples of texels with
    /// another point that can be seen are moved to that point instead; in placements without any visible sample this is done
    /// in any case. Advances `stage` by one per placement. To be called on the device's threads.
    pub fn move_buried<M: Searched>(&self, map: &mut ChartMap<M>, stage: &Stage) -> Result<(Vec<bool>, u64)> {
        let scratch = Scratch::new();
        let of_placement = |placement: usize| {
            let mut tests = scratch.take(PointTests::new)?;
            let found = self.in_placement(map, PlacementId::new(placement), &mut tests, stage)?;
            stage.advance(1)?;
            Ok(found)
        };
        let placements = 0..map.layout.placements.len();
        let mut found = try_par_collect(one_by_one(placements.into_par_iter().map(of_placement)), BURIED)?;
        if let Some(failed) = found.iter_mut().find(|f| f.is_err()) {
            return Err(std::mem::replace(failed, Ok(Found::default())).err().expect("it failed"));
        }
        let found = || found.iter().flatten();
        let rays = found().map(|f| f.rays).sum();
        for &(texel, point) in found().flat_map(|f| &f.seen_parts) {
            map.texels.samples[texel.index()] = point;
        }
        if found().all(|f| f.moved.is_empty()) {
            return Ok((Vec::new(), rays));
        }
        let mut is_moved = try_vec(map.len(), BURIED)?;
        for &(texel, to) in found().flat_map(|f| &f.moved) {
            let to = map[to];
            let sample = &mut map.texels.samples[texel.index()];
            (sample.triangle, sample.u, sample.v) = (to.triangle, to.u, to.v);
            is_moved[texel.index()] = true;
        }
        Ok((is_moved, rays))
    }

    fn in_placement<M: Searched>(
        &self,
        map: &ChartMap<M>,
        placement: PlacementId,
        tests: &mut PointTests,
        stage: &Stage,
    ) -> Result<Found<M>> {
        let mut found = Found::default();
        let chart = map.layout.chart_of(placement);
        let near = match self.only.map(|only| (only, only.charts[chart.index()])) {
            Some((_, Part::None)) => return Ok(found),
            Some((only, Part::Near)) => Some(only),
            None | Some((_, Part::All)) => None,
        };
        let shows_back = match map.layout.is_back(placement) {
            true => Some(true),
            false if !self.charts[chart].two_sided || map.layout.back(chart).is_some() => Some(false),
            // The bake chooses the side if open places do not decide it: buried texels are not searched then, and ledges of the
            // front, which it prefers.
            false => self.seen.shows_back(chart),
        };
        let is_back = shows_back.unwrap_or(false);
        // Nobody sees a hidden side, and all of its texels would be tested by all rays.
        if self.seen.is_hidden(chart, !is_back) {
            return Ok(found);
        }
        let texels = map.texels_of(placement);
        let mut buried = Vec::new();
        let indices = texels.indices();
        let mut block = [TexelId::new(0); BLOCK];
        let searched = if shows_back.is_some() { indices.clone() } else { 0..0 };
        for first in searched.step_by(BLOCK) {
            stage.advance(0)?;
            let all = TexelId::range(first..indices.end.min(first + BLOCK));
            let wanted = all.filter(|&texel| near.is_none_or(|only| only.is_near(self.scene, &map[texel])));
            let count = block.iter_mut().zip(wanted).map(|(place, texel)| *place = texel).count();
            let points = block[..count].iter().map(|&texel| (map[texel], map.seed_in(placement, texel)));
            for &number in self.find_buried(tests, points, is_back, GIVE_UP, &mut found.rays) {
                try_push(&mut buried, block[number as usize], BURIED)?;
            }
        }
        if M::BY_PARTS || buried.len() == texels.len() {
            self.find_seen_parts(map, placement, is_back, &mut buried, tests, &mut found, stage)?;
        }
        if M::LEDGES {
            found.moved = self.find_ledges(map, placement, is_back, near, &buried, tests, &mut found.rays, stage)?;
        }
        if !buried.is_empty() && buried.len() < texels.len() {
            nearest_seen(map, placement, texels, buried, &mut found.moved, stage)?;
        }
        Ok(found)
    }

    /// Removes the texels from `buried` that have another point that can be seen, and adds them to `found` with this
    /// point.
    fn find_seen_parts<M: Map>(
        &self,
        map: &ChartMap<M>,
        placement: PlacementId,
        back: bool,
        buried: &mut Vec<TexelId<M>>,
        tests: &mut PointTests,
        found: &mut Found<M>,
        stage: &Stage,
    ) -> Result<()> {
        if buried.is_empty() {
            return Ok(());
        }
        let texels = map.texels_of(placement);
        let mut is_buried = try_vec(texels.len(), BURIED)?;
        buried.iter().for_each(|&s| is_buried[texels.place(s)] = true);
        // A texel surrounded by buried ones is taken to have no visible point.
        let is_at_border = |s: TexelId<M>| {
            around(map.position(s)).any(|(x, y)| {
                let neighbour = map.at(placement, x, y);
                neighbour.is_none_or(|n| !texels.contains(n) || !is_buried[texels.place(n)])
            })
        };
        let mut others: Vec<OtherPoints<M>> = try_with_capacity(BLOCK.min(buried.len()), BURIED)?;
        let mut rest = buried.iter();
        // The points of a texel are tested one by one until one of them can be seen, those of many texels side by side: alone,
        // each would take a stream of one ray per round.
        loop {
            others.retain(|o| o.next < o.points.len());
            while others.len() < BLOCK {
                stage.check()?;
                let Some(&texel) = rest.next() else { break };
                if !is_at_border(texel) {
                    continue;
                }
                let seed = map.seed_in(placement, texel);
                let points = self.points_of_texel(map, placement, texel, seed);
                if !points.is_empty() {
                    others.push(OtherPoints { texel, seed, points, next: 0 });
                }
            }
            if others.is_empty() {
                break;
            }
            let points = others.iter().map(|o| (o.points[o.next], o.seed));
            let numbers = self.find_buried(tests, points, back, GIVE_UP_OTHERS, &mut found.rays);
            let mut numbers = numbers.iter().peekable();
            for (number, other) in (0..).zip(&mut others) {
                if numbers.next_if_eq(&&number).is_some() {
                    other.next += 1;
                } else {
                    try_push(&mut found.seen_parts, (other.texel, other.points[other.next]), BURIED)?;
                    other.next = other.points.len();
                }
            }
        }
        for &(texel, _) in &found.seen_parts {
            is_buried[texels.place(texel)] = false;
        }
        buried.retain(|&s| is_buried[texels.place(s)]);
        Ok(())
    }

    /// Returns some points of the chart in a texel, as many in other triangles as in that of its sample: where a chart folds,
    /// one that is narrower than the texel may be all that can be seen of it.
    fn points_of_texel<M: Map>(
        &self,
        map: &ChartMap<M>,
        placement: PlacementId,
        texel: TexelId<M>,
        seed: u32,
    ) -> Vec<TexelSample> {
        let (placement, sample) = (&map.layout[placement], &map[texel]);
        let mut counts = [0; 2];
        let mut is_wanted = |point: &TexelSample| {
            let count = &mut counts[usize::from(point.triangle != sample.triangle)];
            *count += 1;
            *count <= POINTS
        };
        let points =
            (0..POINT_TRIES).filter_map(|i| self.index.in_texel(self.charts, placement, sample, sobol_2d(i, seed)));
        points.filter(|point| is_wanted(point)).collect()
    }

    /// Returns the numbers of those points that are buried, in order. There are at most [`BLOCK`] points, each with the seed of
    /// its rays, on backs if `back`; one is buried if none of its first `give_up` rays ends in the open. Rays are traced as streams
    /// of one per undecided point, since most points need one and nearly all others need many. Adds the number of rays to `rays`.
    fn find_buried<'t>(
        &self,
        tests: &'t mut PointTests,
        points: impl Iterator<Item = (TexelSample, u32)>,
        back: bool,
        give_up: u32,
        rays: &mut u64,
    ) -> &'t [u32] {
        let PointTests { undecided, probes, hits, numbers } = tests;
        undecided.clear();
        undecided.extend((0..).zip(points).map(|(number, (point, seed))| {
            let (_, receiver) = receiver_of(self.scene, &point, back);
            Undecided { number, seed, origin: receiver.origin, normal: receiver.geometric, ..Default::default() }
        }));
        assert!(undecided.len() <= hits.len());
        numbers.clear();
        for i in 0..RAYS {
            if undecided.is_empty() {
                break;
            }
            probes.clear();
            probes.extend(undecided.iter().map(|p| Ray::new(p.origin, cosine_around(p.normal, sobol_2d(i, p.seed)))));
            self.scene.intersect_stream(probes, hits);
            *rays += probes.len() as u64;
            let mut hits = hits.iter();
            undecided.retain_mut(|point| {
                let hit = hits.next().expect("there is one for each ray");
                match self.seen_by(hit) {
                    Sight::Open if i == 0 && hit.t > AT_ONCE * self.near => return false,
                    Sight::Open => point.open += 1,
                    Sight::Nothing => (point.open, point.nothing) = (point.open + 1, point.nothing + 1),
                    Sight::Back => {
                        point.backs += 1;
                        point.near_backs += u32::from(hit.t <= NEARBY * self.near);
                    }
                    Sight::Covered => {}
                }
                if i + 1 == give_up && point.open == 0 {
                    numbers.push(point.number);
                    return false;
                }
                point.open < OPEN || point.backs > 0 || point.open == point.nothing
            });
        }
        numbers.extend(undecided.iter().filter_map(|point| {
            let mut sees_nothing = || {
                let is_behind = point.open == point.nothing && FEW_BACKS * point.near_backs >= RAYS;
                is_behind && !self.sees_lamp(point.origin, point.normal, rays)
            };
            (point.open < OPEN || 2 * point.backs > RAYS || sees_nothing()).then_some(point.number)
        }));
        numbers.sort_unstable();
        numbers
    }

    /// Whether a lamp, which may be switched off, can be seen from a point. (Like the [open places](super::seen) this holds for
    /// the lamps of when the light map was created; it is not looked for again when they move.)
    fn sees_lamp(&self, origin: Vec3, normal: Vec3, rays: &mut u64) -> bool {
        let lights = self.scene.lights();
        let few = lights.iter().step_by(lights.len().div_ceil(LAMPS).max(1));
        few.filter_map(seen::middle_of).any(|lamp| {
            let to = lamp - origin;
            *rays += u64::from(to.dot(normal) > 0.0);
            to.dot(normal) > 0.0 && !self.scene.occluded(&Ray::new(origin, to).within(0.0, seen::NEARLY))
        })
    }

    fn seen_by(&self, hit: &RawHit) -> Sight {
        if hit.is_miss() {
            return if self.outdoors { Sight::Open } else { Sight::Nothing };
        }
        let material = self.scene.material(hit.triangle);
        if !hit.front && !material.two_sided && !material.transmits() {
            return Sight::Back;
        }
        let chart = self.charts.chart_of(hit.triangle);
        if hit.t <= self.near || self.seen.is_hidden(chart, hit.front) { Sight::Covered } else { Sight::Open }
    }
}

/// Kind of end of a ray.
enum Sight {
    Open,
    /// Outside of a scene that has no outside.
    Nothing,
    /// On the back of a one-sided surface.
    Back,
    /// Within a texel, or on a side that cannot be seen from any open place.
    Covered,
}

/// A point of which rays have not told yet whether it is buried.
#[derive(Default)]
struct Undecided {
    /// Its number among the points.
    number: u32,
    /// Seed of its rays.
    seed: u32,
    origin: Vec3,
    normal: Vec3,
    /// Rays that ended in the open, and those of them that left an indoor scene.
    open: u32,
    nothing: u32,
    /// Rays that ended on backs, and those of them that ended nearby.
    backs: u32,
    near_backs: u32,
}

/// Working memory to test up to [`BLOCK`] points.
struct PointTests {
    undecided: Vec<Undecided>,
    probes: Vec<Ray>,
    hits: Vec<RawHit>,
    /// Numbers of the points that are buried.
    numbers: Vec<u32>,
}

impl PointTests {
    fn new() -> Result<PointTests> {
        Ok(PointTests {
            undecided: try_with_capacity(BLOCK, BURIED)?,
            probes: try_with_capacity(BLOCK, BURIED)?,
            hits: try_filled(BLOCK, RawHit::MISS, BURIED)?,
            numbers: try_with_capacity(BLOCK, BURIED)?,
        })
    }
}

/// Other points of a texel whose sample is buried, one of which may be visible.
struct OtherPoints<M: Map> {
    texel: TexelId<M>,
    /// Seed of the rays of each point.
    seed: u32,
    points: Vec<TexelSample>,
    /// Index of the point to be tested next; past the end once one can be seen.
    next: usize,
}

#[derive(Default)]
struct Found<M: Map> {
    /// Buried texels, each with the visible one whose sample it takes.
    moved: Vec<(TexelId<M>, TexelId<M>)>,
    /// Texels that can be seen at another point than their sample, with that point.
    seen_parts: Vec<(TexelId<M>, TexelSample)>,
    rays: u64,
}

/// Finds the nearest visible texels to those `buried`, ring by ring, and adds them to `moved`, which has texels on ledges.
fn nearest_seen<M: Map>(
    map: &ChartMap<M>,
    placement: PlacementId,
    texels: TexelRange<M>,
    buried: Vec<TexelId<M>>,
    moved: &mut Vec<(TexelId<M>, TexelId<M>)>,
    stage: &Stage,
) -> Result<()> {
    let mut to: Vec<Option<TexelId<M>>> = try_collect(texels.clone().map(Some), BURIED)?;
    buried.iter().for_each(|&s| to[texels.place(s)] = None);
    moved.iter().for_each(|&(texel, inner)| to[texels.place(texel)] = Some(inner));
    let mut filled = try_with_capacity(buried.len(), BURIED)?;
    let nearest = |to: &Vec<Option<TexelId<M>>>, texel: TexelId<M>| {
        let (ox, oy) = map.position(texel);
        let known = around((ox, oy)).filter_map(|(x, y)| {
            // The window of given charts may contain another chart.
            let neighbour = map.at(placement, x, y).filter(|&n| texels.contains(n))?;
            let known = to[texels.place(neighbour)]?;
            let (kx, ky) = map.position(known);
            Some(((kx - ox).pow(2) + (ky - oy).pow(2), known))
        });
        known.min().map(|(_, known)| known)
    };
    Hole::new(buried)?.fill(
        &mut to,
        || stage.check(),
        nearest,
        |to, texel, known| {
            to[texels.place(texel)] = Some(known);
            filled.push((texel, known));
        },
    )?;
    try_append(moved, &filled, BURIED)
}

mod ledges;
#[cfg(test)]
mod tests;
