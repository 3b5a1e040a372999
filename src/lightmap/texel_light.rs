//! Direct light of a texel: an average over the part of the chart that the texel covers. This file has the points of
//! texels and their light; [`averages`] what texels of the light map make of it, and [`looks`] those of the radiance
//! map.
//!
//! A point sample at the texel's centre turns every shadow edge into stairs, and misses or exaggerates light that falls
//! on less than a texel. Averages are taken where they matter:
//!
//! - Lights with penumbrae are sampled from four stratified points instead of one, with as many rays in all.
//! - Lights without penumbrae get one ray from the texel's sample. If that light differs from a neighbouring texel's,
//!   or at the border of a chart, 4 or 16 points spread over the texel are lit instead.
//! - Texels in the penumbra of a disc, which is narrow, get 16 points too.
//!
//! Points lie on the chart: each on whichever triangle of the chart covers it, with that triangle's normals. Points
//! inside solids, in cut-outs, or behind a wall that stands on the texel do not count: the light of the other room
//! would leak in. A point lies inside a solid if the way along the surface from there to the texel's sample, which can be
//! seen, or the ways straight up and to four sides end at the solid's surface from inside. If all points do, as in a
//! texel of which a strip looks out from under a block, the texel's sample alone is lit.
//!
//! Light of point and spot lights closer to a texel than it is wide is sampled [apart](near).
//!
//! The data used of neighbours is a function of their numbers alone, so that shards of a bake and tiles of live
//! updates, which recompute it, have the same bits. The shadow rays of a [tile](super::tiles) are traced together,
//! which changes no bit.

pub(crate) mod averages;
pub(crate) mod looks;
mod near;
mod sky_seen;

use super::atlas::Atlas;
use super::atlas::chart_index::ChartIndex;
use super::atlas::chart_map::{ChartMap, Receivers};
use super::atlas::charts::Charts;
use super::atlas::ids::{Map, TexelId};
use super::atlas::layout::Placement;
use super::atlas::seen::Seen;
use super::atlas::texels::TexelSample;
use crate::base::directional::Directional;
use crate::base::error::Result;
use crate::base::memory::{try_filled, try_with_capacity};
use crate::base::sampling::{combine, orthonormal_basis, sobol_2d};
use crate::direct::Receiver;
use crate::direct::direct_light::{DirectLight, Lights, PointLight};
use crate::direct::shadow_rays::{KINDS, TileRoom};
use crate::scene::Scene;
use crate::trace::{RawHit, Ray};
use glam::{Vec2, Vec3};
use sky_seen::Guides;
use std::ops::Range;

/// Maximum number of points of a texel that are lit together.
const MAX_POINTS: usize = 16;

/// Number of rays that tell whether a point lies inside a solid: straight up and to four sides. (The ray straight up alone
/// may hit the back of a single sheet, such as a table top, below which there is light.)
const PROBES: usize = 5;

/// Number of lines of sight, or of such rays, that are worth a stream.
const LEAST_STREAM: usize = 32;

/// Number of points in a texel in which light is not known to vary.
const FEW: u32 = 4;

/// Data from which the surface under a texel is found.
#[derive(Clone, Copy)]
pub(crate) struct TexelAreas<'a, M: Map> {
    pub scene: &'a Scene,
    pub charts: &'a Charts,
    pub index: &'a ChartIndex,
    pub seen: &'a Seen,
    pub map: &'a ChartMap<M>,
}

impl Atlas {
    /// Returns the texels of one of the maps as areas.
    pub(crate) fn areas<'a, M: Map>(&'a self, map: &'a ChartMap<M>) -> TexelAreas<'a, M> {
        TexelAreas { scene: &self.scene, charts: &self.charts, index: &self.index, seen: &self.seen, map }
    }
}

impl<M: Map> TexelAreas<'_, M> {
    /// Returns point `number` of a sequence that is stratified over a texel; `None` if it misses the chart or lies in a
    /// cut-out.
    pub(crate) fn point(&self, texel: TexelId<M>, number: u32, seed: u32) -> Option<TexelSample> {
        self.point_at(texel, sobol_2d(number, combine(seed, 32)))
    }

    /// Returns the point of the chart at a place in a texel, (0, 0) to (1, 1); `None` if it misses the chart or lies in a
    /// cut-out.
    fn point_at(&self, texel: TexelId<M>, place: [f32; 2]) -> Option<TexelSample> {
        let (own, placement) = (&self.map[texel], self.placement(texel));
        // The sample of a buried texel lies in another texel; no other points are used.
        let at = Vec2::from(placement.texel_coord(self.charts.local(own.triangle, own.u, own.v)));
        let within = at - Vec2::new(own.x as f32, own.y as f32);
        if within.min_element() < -0.01 || within.max_element() > 1.01 {
            return None;
        }
        let point = self.index.in_texel(self.charts, placement, own, place)?;
        (!self.scene.is_hole(point.triangle, point.u, point.v)).then_some(point)
    }

    fn placement(&self, texel: TexelId<M>) -> &Placement {
        &self.map.layout[self.map.placement_of(self.charts, texel)]
    }

    /// Whether a hit is on a surface from inside a solid: on the back of a one-sided surface, or on a side that is seen
    /// from no open place.
    fn is_inner(&self, hit: &RawHit) -> bool {
        !hit.is_miss()
            && (self.seen.is_hidden(self.charts.chart_of(hit.triangle), hit.front)
                || !hit.front && {
                    let material = self.scene.material(hit.triangle);
                    !material.two_sided && !material.transmits()
                })
    }

    /// Returns the texels [around](AROUND) a texel in the same placement, where there are any.
    #[inline]
    pub(crate) fn neighbours(&self, texel: TexelId<M>) -> [Option<TexelId<M>>; AROUND.len()] {
        self.map.around(self.map.placement_of(self.charts, texel), texel, AROUND)
    }
}

/// Direct light of texels of map `M`.
#[derive(Clone, Copy)]
pub(crate) struct TexelLight<'a, M: Map> {
    pub areas: TexelAreas<'a, M>,
    pub direct: &'a DirectLight,
    /// Number of samples per texel, as in [`DirectLight::irradiance`].
    pub samples: u32,
    /// Seed of the stage.
    pub seed: u32,
    /// From where [the sky is seen](sky_seen), which guides shadow rays to it; `None`: they go anywhere.
    pub sky_from: Option<&'a Atlas>,
}

/// A point of a texel and its light.
#[derive(Clone, Copy)]
struct Point {
    on: TexelSample,
    receiver: Receiver,
    light: PointLight,
    /// Number of the point in its tile.
    place: u32,
    /// Whether it is known to lie inside a solid.
    is_buried: bool,
    /// Whether light of lamps close to its texel is sampled [apart](near), so that it may be lit although its light is dark.
    is_near_lamps: bool,
}

impl Point {
    fn may_be_lit(&self) -> bool {
        self.is_near_lamps || !self.light.is_dark()
    }
}

/// Adds the light of the points that are not inside solids, by their weights; returns the sum of the weights. Only unlit
/// points have been tested; if all are unlit, the first one tells it for all.
fn add_points(points: &[Point], sum: &mut PointLight, weight: impl Fn(&TexelSample) -> Vec3) -> Vec3 {
    let is_lit = points.iter().any(Point::may_be_lit);
    if !is_lit && points.first().is_some_and(|p| p.is_buried) {
        return Vec3::ZERO;
    }
    let mut n = Vec3::ZERO;
    for Point { on, light, .. } in points.iter().filter(|p| !p.is_buried) {
        let weight = weight(on);
        sum.add(light, weight);
        n += weight;
    }
    n
}

/// Height of lines of sight above the surface they run along, as a fraction of their length: it clears curved surfaces.
const RAISED: f32 = 0.25;

/// Returns the ray along a surface from one of its points to another, which ends at a distance of 1.
fn line_of_sight(a: &Receiver, b: &Receiver) -> Ray {
    let raise = RAISED * a.origin.distance(b.origin);
    let (from, to) = (a.origin + raise * a.geometric, b.origin + raise * b.geometric);
    Ray::new(from, to - from).within(0.0, 1.0)
}

/// Whether another surface stands between two points of a surface.
fn is_hidden(scene: &Scene, a: &Receiver, b: &Receiver, rays: &mut u64) -> bool {
    *rays += 1;
    scene.occluded(&line_of_sight(a, b))
}

/// Returns one of the rays that tell whether a point lies inside a solid.
fn probe(receiver: &Receiver, number: usize) -> Ray {
    let Receiver { origin, geometric, .. } = *receiver;
    let (x, y) = orthonormal_basis(geometric);
    Ray::new(origin, geometric + [Vec3::ZERO, x, -x, y, -y][number])
}

/// Points of the texels of a tile, up to [`MAX_POINTS`] of each at a time.
pub(crate) struct TilePoints {
    points: Vec<Point>,
    /// Number of points of each texel.
    counts: Vec<usize>,
    /// Points whose light has not arrived yet, or whose lines of sight have not been traced.
    pending: Vec<u32>,
    lines: Vec<Ray>,
    line_hits: Vec<RawHit>,
    room: TileRoom,
    /// Light by direction that has arrived at each point, by kind; empty if nobody asks for it.
    directional: Vec<[Directional; KINDS]>,
}

/// Points of a texel that are to be lit.
struct Wanted<M: Map> {
    /// Place of the texel in its tile.
    place: usize,
    texel: TexelId<M>,
    back: bool,
    numbers: Range<u32>,
    lights: Lights,
}

impl TilePoints {
    /// Allocates room for the points of a tile of at most `texels`, which are at most [`TILE`](super::tiles::TILE).
    pub(crate) fn new(texels: usize) -> Result<TilePoints> {
        let what = "the points of a tile";
        let receiver = Receiver {
            origin: Vec3::ZERO,
            normal: Vec3::ZERO,
            geometric: Vec3::ZERO,
            position: Vec3::ZERO,
            shadow_origin: Vec3::ZERO,
            raised: false,
        };
        let point = Point {
            on: TexelSample::default(),
            receiver,
            light: PointLight::default(),
            place: 0,
            is_buried: false,
            is_near_lamps: false,
        };
        let points = texels * MAX_POINTS;
        Ok(TilePoints {
            points: try_filled(points, point, what)?,
            counts: try_filled(texels, 0, what)?,
            pending: try_with_capacity(points, what)?,
            lines: try_with_capacity(points, what)?,
            line_hits: try_filled(points, RawHit::MISS, what)?,
            room: TileRoom::new(KINDS * points, points)?,
            directional: Vec::new(),
        })
    }

    /// Allocates room for the points of a tile and their light by direction.
    pub(crate) fn by_direction(texels: usize) -> Result<TilePoints> {
        let tile = TilePoints::new(texels)?;
        let directional = try_filled(tile.points.len(), [Directional::default(); KINDS], "the points of a tile")?;
        Ok(TilePoints { room: tile.room.by_direction()?, directional, ..tile })
    }

    fn clear(&mut self) {
        self.counts.fill(0);
    }

    fn of(&self, place: usize) -> &[Point] {
        &self.points[place * MAX_POINTS..][..self.counts[place]]
    }

    /// Returns the points of a texel, and the light by direction of all points of the tile.
    fn of_mut(&mut self, place: usize) -> (&mut [Point], &[[Directional; KINDS]]) {
        (&mut self.points[place * MAX_POINTS..][..self.counts[place]], &self.directional)
    }

    /// Traces the lines of sight from unlit points beside lit ones to the samples of their texels, for the first `texels` of
    /// the tile, and [rays](probe) from those that are left, which tell which of them [lie inside
    /// solids](Point::is_buried). Of texels without any lit point the first point tells it for all.
    fn find_buried<M: Map>(
        &mut self,
        texels: usize,
        areas: &TexelAreas<M>,
        sample: impl Fn(usize) -> Receiver,
        rays: &mut u64,
    ) {
        self.pending.clear();
        self.lines.clear();
        for (i, &count) in self.counts[..texels].iter().enumerate() {
            let points = i * MAX_POINTS..i * MAX_POINTS + count;
            let dark = |&place: &usize| self.points[place].light.is_dark();
            let few = if points.clone().any(|place| self.points[place].may_be_lit()) { count } else { 1 };
            let mut to = None;
            for place in points.filter(dark).take(few) {
                let to = to.get_or_insert_with(|| sample(i));
                self.lines.push(line_of_sight(&self.points[place].receiver, to));
                self.pending.push(place as u32);
            }
        }
        self.trace_lines(areas, rays);
        for (&place, hit) in self.pending.iter().zip(&self.line_hits) {
            self.points[place as usize].is_buried = areas.is_inner(hit);
        }
        // A solid that something else covers on the way to the sample is found by what is around the point.
        self.pending.retain(|&place| !self.points[place as usize].is_buried);
        // The first ray decides for nearly all of them.
        for number in 0..PROBES {
            self.lines.clear();
            self.lines.extend(self.pending.iter().map(|&place| probe(&self.points[place as usize].receiver, number)));
            self.trace_lines(areas, rays);
            let mut hits = self.line_hits.iter();
            self.pending.retain(|_| hits.next().is_some_and(|hit| areas.is_inner(hit)));
        }
        for &place in &self.pending {
            self.points[place as usize].is_buried = true;
        }
    }

    fn trace_lines<M: Map>(&mut self, areas: &TexelAreas<M>, rays: &mut u64) {
        match self.lines.len() < LEAST_STREAM {
            true => areas.scene.intersect_block(&self.lines, &mut self.line_hits),
            false => areas.scene.intersect_stream(&self.lines, &mut self.line_hits),
        }
        *rays += self.lines.len() as u64;
    }

    /// Computes direct light at receivers with seeds of their own, at most [`MAX_POINTS`] times as many as there is room
    /// for texels. `out` gets the light of each, and that by direction as far as there is room for it.
    pub(crate) fn light_at(
        &mut self,
        direct: &DirectLight,
        scene: &Scene,
        samples: u32,
        receivers: impl Iterator<Item = (Receiver, u32)>,
        rays: &mut u64,
        mut out: impl FnMut(&PointLight, Option<&[Directional; KINDS]>),
    ) {
        let mut shadow = self.room.begin(scene);
        let mut count = 0;
        for (receiver, seed) in receivers {
            shadow.slot = KINDS * count;
            self.points[count].light = direct.push(&receiver, 0, Lights::All, samples, seed, &mut shadow);
            count += 1;
        }
        let (arrived, directed) = shadow.finish_by_direction(rays);
        let mut directed = directed.as_chunks().0.iter();
        for (point, sums) in self.points[..count].iter_mut().zip(arrived.chunks_exact(KINDS)) {
            point.light.take(sums);
            out(&point.light, directed.next());
        }
    }

    /// Lights the wanted points that lie on their charts, and adds them to those of their texels.
    fn light<M: Map>(&mut self, by: &TexelLight<M>, wanted: impl Iterator<Item = Wanted<M>>, rays: &mut u64) {
        let scene = by.areas.scene;
        let (mut shadow, mut receivers) = (self.room.begin(scene), Receivers::new(scene));
        let mut guides = Guides::default();
        self.pending.clear();
        for Wanted { place, texel, back, numbers, lights } in wanted {
            let samples = by.samples.div_ceil(numbers.len() as u32);
            let (seed, first) = (combine(by.seed, by.areas.map.seed(texel)), self.counts[place]);
            let of_round = combine(seed, numbers.start);
            shadow.near = by.near(texel);
            shadow.guide = guides.of(by, (texel, back), rays);
            let is_near_lamps = shadow.near.distance2 > 0.0;
            for number in numbers {
                let Some(on) = by.areas.point(texel, number, seed) else { continue };
                let receiver = receivers.of(&on, back);
                let (count, at) = (self.counts[place], place * MAX_POINTS + self.counts[place]);
                shadow.slot = KINDS * at;
                let light = by.direct.push(&receiver, (count - first) as u32, lights, samples, of_round, &mut shadow);
                self.points[at] = Point { on, receiver, light, place: at as u32, is_buried: false, is_near_lamps };
                self.pending.push(at as u32);
                self.counts[place] += 1;
            }
        }
        let (arrived, directed) = shadow.finish_by_direction(rays);
        for &place in &self.pending {
            let place = place as usize;
            self.points[place].light.take(&arrived[KINDS * place..][..KINDS]);
            if let Some(of_point) = self.directional.get_mut(place) {
                of_point.copy_from_slice(&directed[KINDS * place..][..KINDS]);
            }
        }
    }
}

/// Offsets of the neighbours of a texel.
const AROUND: [(i32, i32); 8] = [(-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (1, -1), (-1, 1), (1, 1)];

fn differ(a: Vec3, b: Vec3, part: f32) -> bool {
    (a - b).abs().max_element() > part * a.max_element().max(b.max_element())
}

/// Whether a part of the light of points differs between them.
fn vary(points: &[Point], what: impl Fn(&PointLight) -> Vec3, part: f32) -> bool {
    points.iter().any(|p| differ(what(&p.light), what(&points[0].light), part))
}

#[cfg(test)]
mod tests;
