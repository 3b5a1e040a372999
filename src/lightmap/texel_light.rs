//! Direct light of a texel: an average over the part of the chart that the texel covers.
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
//! would leak in.
//!
//! The data used of neighbours is a function of their numbers alone, so that shards of a bake and tiles of live
//! updates, which recompute it, have the same bits. The shadow rays of a [tile](super::tiles) are traced together, which
//! changes no bit.

use super::atlas::Atlas;
use super::atlas::chart_index::ChartIndex;
use super::atlas::chart_map::{ChartMap, receiver_of};
use super::atlas::charts::Charts;
use super::atlas::ids::{LightMap, LightTexel, Map, PerTexel, RadianceMap, RadianceTexel, TexelId};
use super::atlas::texels::TexelSample;
use super::tiles::TILE;
use crate::base::error::Result;
use crate::base::memory::{try_filled, try_with_capacity};
use crate::base::sampling::{combine, orthonormal_basis, sobol_2d};
use crate::direct::Receiver;
use crate::direct::direct_light::{DirectLight, Lights, PointLight};
use crate::direct::shadow_rays::{KINDS, TileRoom};
use crate::scene::Scene;
use crate::trace::Ray;
use glam::{Vec2, Vec3};
use std::ops::Range;

/// Maximum number of points of a texel that are lit together.
const MAX_POINTS: usize = 16;

/// Number of points in a texel in which light is not known to vary.
const FEW: u32 = 4;

/// Two values of light differ if their difference is more than this fraction of the greater: the first between
/// neighbouring texels of the light map, the second between neighbours or within a texel of the radiance map, whose
/// texels are larger and seen by gather rays only.
const DIFFERENCE: f32 = 0.15;
const RADIANCE_DIFFERENCE: f32 = 0.25;

/// Number of points in a texel of the radiance map if one of the first [`MAX_POINTS`] gets more than `SPIKE` times the
/// mean, since the lit area then covers little of the texel.
const MANY: u32 = 64;
const SPIKE: f32 = 3.0;

/// Height of lines of sight above the surface they run along, as a fraction of their length: it clears curved surfaces.
const RAISED: f32 = 0.25;

/// Data from which the surface under a texel is found.
#[derive(Clone, Copy)]
pub(crate) struct TexelAreas<'a, M: Map> {
    pub scene: &'a Scene,
    pub charts: &'a Charts,
    pub index: &'a ChartIndex,
    pub map: &'a ChartMap<M>,
}

impl Atlas {
    /// Returns the texels of one of the maps as areas.
    pub(crate) fn areas<'a, M: Map>(&'a self, map: &'a ChartMap<M>) -> TexelAreas<'a, M> {
        TexelAreas { scene: &self.scene, charts: &self.charts, index: &self.index, map }
    }
}

impl<M: Map> TexelAreas<'_, M> {
    /// Returns point `number` of a sequence that is stratified over a texel; `None` if it misses the chart or lies in a
    /// cut-out.
    pub(crate) fn point(&self, texel: TexelId<M>, number: u32, seed: u32) -> Option<TexelSample> {
        let own = &self.map[texel];
        let placement = &self.map.layout[self.map.placement_of(self.charts, texel)];
        // The sample of a buried texel lies in another texel; no other points are used.
        let at = Vec2::from(placement.texel_coord(self.charts.local(own.triangle, own.u, own.v)));
        let within = at - Vec2::new(own.x as f32, own.y as f32);
        if within.min_element() < -0.01 || within.max_element() > 1.01 {
            return None;
        }
        let [x, y] = sobol_2d(number, combine(seed, 32));
        let local = placement.local([own.x as f32 + x, own.y as f32 + y]);
        let chart = self.charts.chart_of(own.triangle);
        let point = self.index.locate(self.charts, chart, local.into(), own.triangle)?;
        (!self.scene.is_hole(point.triangle, point.u, point.v)).then_some(point)
    }

    /// Returns the texel at an offset of columns and rows in the same placement, if there is one.
    fn neighbour(&self, texel: TexelId<M>, dx: i32, dy: i32) -> Option<TexelId<M>> {
        let placement = self.map.placement_of(self.charts, texel);
        let (x, y) = self.map.position(texel);
        let near = self.map.at(placement, x + dx, y + dy)?;
        (self.map.placement_of(self.charts, near) == placement).then_some(near)
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
}

/// A point of a texel and its light.
#[derive(Clone, Copy)]
struct Point {
    on: TexelSample,
    receiver: Receiver,
    light: PointLight,
}

/// Points of the texels of a tile, up to [`MAX_POINTS`] of each at a time.
pub(crate) struct TilePoints {
    points: Vec<Point>,
    /// Number of points of each texel.
    counts: Vec<usize>,
    /// Points whose light has not arrived yet.
    pending: Vec<u32>,
    room: TileRoom,
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

/// A texel whose direct light is to be averaged.
#[derive(Clone, Copy)]
pub(crate) struct Averaged {
    pub texel: LightTexel,
    pub back: bool,
    /// The texel's sample.
    pub receiver: Receiver,
    /// The light of its sample without penumbrae.
    pub sharp: Vec3,
    pub variation: Variation,
}

impl TexelLight<'_, LightMap> {
    /// Computes light without penumbrae at the sample itself.
    pub(crate) fn sharp(&self, receiver: &Receiver, rays: &mut u64) -> Vec3 {
        if !self.direct.has_sharp() {
            return Vec3::ZERO;
        }
        self.direct.at_point(receiver, Lights::Sharp, 0, 0, rays).sharp
    }

    /// Computes light without penumbrae at samples: at most [`MAX_POINTS`] times as many as `tile` has room for texels.
    pub(crate) fn sharp_of_tile(
        &self,
        receivers: impl Iterator<Item = Receiver>,
        tile: &mut TilePoints,
        rays: &mut u64,
        mut out: impl FnMut(usize, Vec3),
    ) {
        let mut shadow = tile.room.begin(self.areas.scene);
        let mut count = 0;
        for receiver in receivers {
            shadow.slot = KINDS * count;
            self.direct.push(&receiver, 0, Lights::Sharp, 0, 0, &mut shadow);
            count += 1;
        }
        let mut light = PointLight::default();
        for (i, sums) in shadow.finish(rays).chunks_exact(KINDS).take(count).enumerate() {
            light.take(sums);
            out(i, light.sharp);
        }
    }

    /// Whether light without penumbrae varies in a texel, judged by its neighbours: `sharp` is the texel's own light,
    /// and `of` returns a neighbour's.
    pub(crate) fn varies(&self, texel: LightTexel, sharp: Vec3, mut of: impl FnMut(LightTexel) -> Vec3) -> Variation {
        if !self.direct.has_sharp() {
            return Variation::None;
        }
        let mut variation = Variation::None;
        for (dx, dy) in AROUND {
            match self.areas.neighbour(texel, dx, dy) {
                Some(s) if differ(sharp, of(s), DIFFERENCE) => return Variation::Some,
                // Diagonal neighbours are missed at every second edge.
                None if dx == 0 || dy == 0 => variation = Variation::Unknown,
                _ => {}
            }
        }
        variation
    }

    /// Computes the direct light of the texels of a tile.
    pub(crate) fn irradiance(
        &self,
        texels: &[Averaged],
        tile: &mut TilePoints,
        rays: &mut u64,
        mut out: impl FnMut(usize, Vec3),
    ) {
        let soft = self.direct.has_soft();
        let lights_of = |variation| match (variation, soft) {
            (Variation::None, false) => None,
            (Variation::None, true) => Some(Lights::Soft),
            (_, false) => Some(Lights::Sharp),
            (_, true) => Some(Lights::All),
        };
        let few = |variation| if variation == Variation::Some { MAX_POINTS as u32 } else { FEW };
        let wanted = |place: usize, t: &Averaged, numbers| {
            let lights = lights_of(t.variation)?;
            Some(Wanted { place, texel: t.texel, back: t.back, numbers, lights })
        };
        let first = texels.iter().enumerate().filter_map(|(i, t)| wanted(i, t, 0..few(t.variation)));
        tile.clear();
        tile.light(self, first, rays);
        let mut goes_on = [false; TILE];
        for (i, (t, goes_on)) in texels.iter().zip(&mut goes_on).enumerate() {
            let points = tile.of(i);
            *goes_on = few(t.variation) == FEW
                && (has_penumbra(points)
                    || (t.variation == Variation::Unknown && vary(points, PointLight::narrow, DIFFERENCE)));
        }
        let more = texels.iter().enumerate().filter(|(i, _)| goes_on[*i]);
        tile.light(self, more.filter_map(|(i, t)| wanted(i, t, FEW..MAX_POINTS as u32)), rays);
        for (i, t) in texels.iter().enumerate() {
            let e = match lights_of(t.variation) {
                Some(_) => self.average(t, tile.of_mut(i), goes_on[i], rays),
                None => t.sharp,
            };
            out(i, e);
        }
    }

    /// Averages the light of a texel's points; `goes_on`: more than the first few have been lit.
    fn average(&self, t: &Averaged, points: &mut [Point], goes_on: bool, rays: &mut u64) -> Vec3 {
        let (scene, sharp) = (self.areas.scene, t.sharp);
        let points = match t.variation {
            Variation::None => points,
            _ => without_other_rooms(points, scene, &t.receiver, sharp, rays),
        };
        let mut sum = PointLight::default();
        let n = add_to(points, scene, &mut sum, |_| Vec3::ONE, rays);
        if n == Vec3::ZERO {
            // All points miss a small part of a chart: its sample alone is lit.
            let seed = combine(self.seed, t.texel.seed());
            return sharp + self.direct.at_point(&t.receiver, Lights::Soft, self.samples, seed, rays).value();
        }
        let is_even = t.variation == Variation::Unknown
            && !goes_on
            && !points.iter().any(|p| differ(p.light.sharp, sharp, DIFFERENCE));
        if is_even {
            // The sample lies in the middle of the chart's part in the texel, whereas the few points lie anywhere in
            // it.
            sum.sharp = sharp * n;
        }
        let e = sum.value() / n;
        if t.variation == Variation::None { sharp + e } else { e }
    }
}

impl TexelLight<'_, RadianceMap> {
    /// Computes direct light of a tile of the radiance map by few points, and the values that decide on a [closer
    /// look](Self::closer_look).
    pub(crate) fn first_look(
        &self,
        texels: &[RadianceTexel],
        tile: &mut TilePoints,
        rays: &mut u64,
        mut out: impl FnMut(usize, Look),
    ) {
        let (scene, map) = (self.areas.scene, self.areas.map);
        tile.clear();
        tile.light(self, texels.iter().enumerate().map(|(i, &texel)| self.all_of(i, texel, 0..FEW)), rays);
        for (i, &texel) in texels.iter().enumerate() {
            let (mut sum, points) = (PointLight::default(), tile.of(i));
            let mut n = add_to(points, scene, &mut sum, |_| Vec3::ONE, rays);
            if points.is_empty() {
                let seed = combine(self.seed, texel.seed());
                let (on, receiver) = (map[texel], map.receiver(scene, texel, map.is_back(texel)).1);
                let light = self.direct.at_point(&receiver, Lights::All, self.samples, seed, rays);
                n = add_to(&[Point { on, receiver, light }], scene, &mut sum, |_| Vec3::ONE, rays);
            }
            let varies = vary(points, PointLight::narrow, RADIANCE_DIFFERENCE)
                || vary(points, PointLight::unoccluded_areas, RADIANCE_DIFFERENCE);
            out(i, Look { irradiance: sum.value() / n, narrow: sum.narrow() / n, varies });
        }
    }

    /// Points of a texel of the radiance map, to be lit by all lights.
    fn all_of(&self, place: usize, texel: RadianceTexel, numbers: Range<u32>) -> Wanted<RadianceMap> {
        Wanted { place, texel, back: self.areas.map.is_back(texel), numbers, lights: Lights::All }
    }

    /// Whether a texel of the radiance map needs more points: its first few differ, or its neighbours' light does.
    pub(crate) fn needs_closer_look(&self, texel: RadianceTexel, looks: PerTexel<RadianceMap, Look>) -> bool {
        let look = &looks[texel];
        look.varies
            || AROUND.into_iter().any(|(dx, dy)| {
                let near = self.areas.neighbour(texel, dx, dy);
                near.is_some_and(|near| differ(look.narrow, looks[near].narrow, RADIANCE_DIFFERENCE))
            })
    }

    /// Computes direct light of texels of the radiance map by 16 or 64 points, weighted by their albedos; `None` if none of
    /// them lies on the chart.
    pub(crate) fn closer_look(
        &self,
        texels: &[RadianceTexel],
        tile: &mut TilePoints,
        albedo: impl Fn(&TexelSample) -> Vec3,
        rays: &mut u64,
        mut out: impl FnMut(usize, Option<Vec3>),
    ) {
        let scene = self.areas.scene;
        let weight = |t: &TexelSample| albedo(t).max(Vec3::splat(f32::MIN_POSITIVE));
        let (mut sums, mut weights) = ([PointLight::default(); TILE], [Vec3::ZERO; TILE]);
        // Texels that go on after the first round of points.
        let mut has_spikes = [true; TILE];
        for begin in (0..MANY).step_by(MAX_POINTS) {
            let numbers = begin..begin + MAX_POINTS as u32;
            let wanted = texels.iter().enumerate().filter(|(i, _)| has_spikes[*i]);
            tile.clear();
            tile.light(self, wanted.map(|(i, &texel)| self.all_of(i, texel, numbers.clone())), rays);
            for i in (0..texels.len()).filter(|&i| has_spikes[i]) {
                weights[i] += add_to(tile.of(i), scene, &mut sums[i], weight, rays);
            }
            if begin == 0 {
                for (i, has_spikes) in has_spikes.iter_mut().enumerate() {
                    *has_spikes = i < texels.len() && spikes(tile.of(i));
                }
            }
        }
        for (i, (sum, n)) in sums.iter().zip(weights).take(texels.len()).enumerate() {
            out(i, (n != Vec3::ZERO).then(|| sum.value() / n));
        }
    }
}

impl TilePoints {
    /// Allocates room for the points of a tile of at most `texels`, which are at most [`TILE`].
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
        let point = Point { on: TexelSample::default(), receiver, light: PointLight::default() };
        let points = texels * MAX_POINTS;
        Ok(TilePoints {
            points: try_filled(points, point, what)?,
            counts: try_filled(texels, 0, what)?,
            pending: try_with_capacity(points, what)?,
            room: TileRoom::new(KINDS * points, points)?,
        })
    }

    fn clear(&mut self) {
        self.counts.fill(0);
    }

    fn of(&self, place: usize) -> &[Point] {
        &self.points[place * MAX_POINTS..][..self.counts[place]]
    }

    fn of_mut(&mut self, place: usize) -> &mut [Point] {
        &mut self.points[place * MAX_POINTS..][..self.counts[place]]
    }

    /// Lights the wanted points that lie on their charts, and adds them to those of their texels.
    fn light<M: Map>(&mut self, by: &TexelLight<M>, wanted: impl Iterator<Item = Wanted<M>>, rays: &mut u64) {
        let scene = by.areas.scene;
        let mut shadow = self.room.begin(scene);
        self.pending.clear();
        for Wanted { place, texel, back, numbers, lights } in wanted {
            let samples = by.samples.div_ceil(numbers.len() as u32);
            let (seed, first) = (combine(by.seed, texel.seed()), self.counts[place]);
            let of_round = combine(seed, numbers.start);
            for number in numbers {
                let Some(on) = by.areas.point(texel, number, seed) else { continue };
                let receiver = receiver_of(scene, &on, back).1;
                let (count, at) = (self.counts[place], place * MAX_POINTS + self.counts[place]);
                shadow.slot = KINDS * at;
                let light = by.direct.push(&receiver, (count - first) as u32, lights, samples, of_round, &mut shadow);
                self.points[at] = Point { on, receiver, light };
                self.pending.push(at as u32);
                self.counts[place] += 1;
            }
        }
        let arrived = shadow.finish(rays);
        for &place in &self.pending {
            let place = place as usize;
            self.points[place].light.take(&arrived[KINDS * place..][..KINDS]);
        }
    }
}

/// Result of the first look at a texel of the radiance map.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Look {
    pub irradiance: Vec3,
    /// Light of sources with narrow penumbrae or none.
    narrow: Vec3,
    varies: bool,
}

/// Whether light without penumbrae varies in a texel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum Variation {
    #[default]
    None,
    /// Not known: the texel is at the border of its chart.
    Unknown,
    Some,
}

/// Offsets of the neighbours of a texel.
const AROUND: [(i32, i32); 8] = [(-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (1, -1), (-1, 1), (1, 1)];

fn differ(a: Vec3, b: Vec3, part: f32) -> bool {
    (a - b).abs().max_element() > part * a.max_element().max(b.max_element())
}

/// Whether a point lies inside a solid: the rays straight up and to four sides all hit backs of one-sided surfaces.
/// (The ray straight up alone may hit the back of a single sheet, such as a table top, below which there is light.)
fn is_buried(scene: &Scene, origin: Vec3, normal: Vec3, rays: &mut u64) -> bool {
    let (x, y) = orthonormal_basis(normal);
    [Vec3::ZERO, x, -x, y, -y].into_iter().all(|aside| {
        *rays += 1;
        let hit = scene.intersect_raw(&Ray::new(origin, normal + aside));
        !hit.is_miss() && !hit.front && {
            let material = scene.material(hit.triangle);
            !material.two_sided && !material.transmits()
        }
    })
}

/// Whether another surface stands between two points of a surface.
fn is_hidden(scene: &Scene, a: &Receiver, b: &Receiver, rays: &mut u64) -> bool {
    let raise = RAISED * a.origin.distance(b.origin);
    let (from, to) = (a.origin + raise * a.geometric, b.origin + raise * b.geometric);
    *rays += 1;
    scene.occluded(&Ray::new(from, to - from).within(0.0, 1.0))
}

/// Whether some point lies in the penumbra of a disc.
fn has_penumbra(points: &[Point]) -> bool {
    points.iter().any(|p| p.light.is_in_a_penumbra_of_discs()) || vary(points, PointLight::of_discs, DIFFERENCE)
}

/// Whether a part of the light of points differs between them.
fn vary(points: &[Point], what: impl Fn(&PointLight) -> Vec3, part: f32) -> bool {
    points.iter().any(|p| differ(what(&p.light), what(&points[0].light), part))
}

/// Whether one point has far more light than the mean.
fn spikes(points: &[Point]) -> bool {
    let all = |p: &Point| (p.light.narrow() + p.light.unoccluded_areas()).element_sum();
    let (sum, most) = points.iter().map(all).fold((0.0, 0f32), |(sum, most), l| (sum + l, most.max(l)));
    most * points.len() as f32 > SPIKE * sum
}

/// Returns the points that are seen from the texel's sample, `own`, whose light without penumbrae is `sharp`. Points with
/// the same light are kept without a test.
fn without_other_rooms<'p>(
    points: &'p mut [Point],
    scene: &Scene,
    own: &Receiver,
    sharp: Vec3,
    rays: &mut u64,
) -> &'p mut [Point] {
    let mut kept = 0;
    for i in 0..points.len() {
        let point = points[i];
        if differ(point.light.sharp, sharp, DIFFERENCE) && is_hidden(scene, own, &point.receiver, rays) {
            continue;
        }
        points[kept] = point;
        kept += 1;
    }
    &mut points[..kept]
}

/// Adds the light of the points that are not inside of solids, by their weights; returns the sum of the weights. Only
/// unlit points beside lit ones are tested, since others make no difference.
fn add_to(
    points: &[Point],
    scene: &Scene,
    sum: &mut PointLight,
    weight: impl Fn(&TexelSample) -> Vec3,
    rays: &mut u64,
) -> Vec3 {
    let is_lit = points.iter().any(|p| !p.light.is_dark());
    let mut n = Vec3::ZERO;
    for Point { on, receiver, light } in points {
        if is_lit && light.is_dark() && is_buried(scene, receiver.origin, receiver.geometric, rays) {
            continue;
        }
        let weight = weight(on);
        sum.add(light, weight);
        n += weight;
    }
    n
}

#[cfg(test)]
mod tests {
    use super::super::{BakeParams, Lightmap, LightmapDesc};
    use super::*;
    use crate::base::progress::Progress;
    use crate::scene::demo::shapes::MeshBuilder;
    use crate::scene::{Light, Material, SceneData, builtin};
    use std::sync::Arc;

    fn created(scene: &Arc<Scene>, texels_per_unit: f32) -> Lightmap {
        let desc = LightmapDesc { texels_per_unit, page_size: 512, both_sides: false, ..Default::default() };
        Lightmap::create(scene, &desc, &Progress::none()).unwrap()
    }

    #[test]
    fn points_of_a_texel_lie_in_it_and_on_its_chart() {
        let scene = builtin("atrium").unwrap().committed();
        let map = created(&scene, 5.0);
        let atlas = map.atlas();
        let areas = atlas.areas(&atlas.radiance);
        let (mut found, mut other_triangles) = (0, 0);
        for sample in atlas.radiance.all().step_by(11) {
            let own = atlas.radiance[sample];
            let placement = atlas.radiance.placement_of(&atlas.charts, sample);
            for number in 0..16 {
                let Some(p) = areas.point(sample, number, 3) else { continue };
                assert_eq!(atlas.charts.chart_of(p.triangle), atlas.charts.chart_of(own.triangle));
                let at = atlas.radiance.layout.texel_coord(placement, atlas.charts.local(p.triangle, p.u, p.v));
                let within = Vec2::from(at) - Vec2::new(own.x as f32, own.y as f32);
                assert!(within.min_element() > -0.01 && within.max_element() < 1.01, "{within}");
                found += 1;
                other_triangles += (p.triangle != own.triangle) as u32;
            }
        }
        assert!(found > 1000 && other_triangles > 100, "{found} points, {other_triangles} on other triangles");
    }

    /// A floor below a roof that ends at x = `edge`, or has a slit there, `slit` wide, under the sun at the zenith.
    fn under_a_roof(edge: f32, slit: f32, angular_radius: f32) -> Arc<Scene> {
        let mut data = SceneData::new();
        let m = data.add_material(Material { albedo: [0.5; 3], two_sided: true, ..Default::default() }).unwrap();
        let mut builder = MeshBuilder::new();
        let p = |x: f32, y: f32, z: f32| Vec3::new(x, y, z);
        builder.quad(p(0.0, 0.0, 0.0), p(4.0, 0.0, 0.0), p(4.0, 4.0, 0.0), p(0.0, 4.0, 0.0), m);
        let mut roof = |x0: f32, x1: f32| {
            builder.quad(p(x0, -1.0, 1.0), p(x1, -1.0, 1.0), p(x1, 5.0, 1.0), p(x0, 5.0, 1.0), m);
        };
        roof(edge, 5.0);
        if slit > 0.0 {
            roof(-1.0, edge - slit);
        }
        data.add_mesh(builder.finish()).unwrap();
        let direction = -Vec3::Z;
        data.add_light(Light::Directional { direction, irradiance: [2.0; 3], angular_radius }).unwrap();
        data.committed()
    }

    #[test]
    fn a_texel_that_a_shadow_edge_crosses_has_the_part_of_the_light_that_falls_on_it() {
        for angular_radius in [0.0, 0.004] {
            for edge in [1.93, 2.0, 2.07] {
                let scene = under_a_roof(edge, 0.0, angular_radius);
                let mut map = created(&scene, 4.0);
                let params = BakeParams { gather_rays: 0, ..Default::default() };
                map.bake(&params, &Progress::none()).unwrap();
                let (atlas, light) = (map.atlas(), map.light.as_ref().unwrap());
                let (mut crossed, mut sum, mut expected) = (0, 0.0, 0.0);
                for (sample, direct) in light.direct.iter().enumerate() {
                    let t = &atlas.map.texels.samples[sample];
                    let x = t.position(&scene);
                    if x.z > 0.5 {
                        continue;
                    }
                    let part = ((edge - x.x) * 4.0 + 0.5).clamp(0.0, 1.0);
                    assert!((direct.x / 2.0 - part).abs() < 0.1, "edge {edge}: {} at {x}, not {part}", direct.x / 2.0);
                    crossed += (part > 0.0 && part < 1.0) as u32;
                    sum += direct.x / 2.0;
                    expected += part;
                }
                assert!(crossed > 10 || edge == 2.0, "{crossed} texels are crossed by the edge at {edge}");
                assert!((sum / expected - 1.0).abs() < 2e-3, "{sum} instead of {expected}");
            }
        }
    }

    #[test]
    fn a_floor_that_goes_on_below_a_block_has_no_dark_rim_around_it() {
        let mut data = SceneData::new();
        let m = data.add_material(Material { albedo: [0.5; 3], ..Default::default() }).unwrap();
        let mut builder = MeshBuilder::new();
        let p = |x: f32, y: f32| Vec3::new(x, y, 0.0);
        builder.quad(p(0.0, 0.0), p(4.0, 0.0), p(4.0, 4.0), p(0.0, 4.0), m);
        builder.box_(Vec3::new(1.0, 1.0, -1.0), Vec3::new(2.1, 2.1, 1.0), false, m);
        data.add_mesh(builder.finish()).unwrap();
        let (direction, irradiance) = (-Vec3::Z, [2.0; 3]);
        data.add_light(Light::Directional { direction, irradiance, angular_radius: 0.0 }).unwrap();
        let scene = data.committed();
        let mut map = created(&scene, 4.0);
        map.bake(&BakeParams { gather_rays: 0, ..Default::default() }, &Progress::none()).unwrap();
        let (atlas, light) = (map.atlas(), map.light.as_ref().unwrap());
        let floor = |s: &usize| {
            let t = &atlas.map.texels.samples[*s];
            t.geometric_normal(&scene).z > 0.9 && t.position(&scene).z.abs() < 1e-3
        };
        let lit: Vec<f32> = (0..light.direct.len()).filter(floor).map(|s| light.direct[s].x).collect();
        assert!(lit.len() > 200 && lit.iter().all(|e| (e - 2.0).abs() < 1e-4), "{lit:?}");
    }

    #[test]
    fn the_sun_does_not_leak_below_a_wall_into_the_texels_of_a_dark_room() {
        for wall in [2.03, 2.2] {
            let mut data = SceneData::new();
            let m = data.add_material(Material { albedo: [0.5; 3], two_sided: true, ..Default::default() }).unwrap();
            let mut builder = MeshBuilder::new();
            let p = Vec3::new;
            builder.quad(p(0.0, 0.0, 0.0), p(4.0, 0.0, 0.0), p(4.0, 4.0, 0.0), p(0.0, 4.0, 0.0), m);
            builder.quad(p(wall, -9.0, 0.0), p(wall, 9.0, 0.0), p(wall, 9.0, 9.0), p(wall, -9.0, 9.0), m);
            data.add_mesh(builder.finish()).unwrap();
            let (direction, irradiance) = (p(-1.0, 0.0, -1.0).normalize(), [2.0; 3]);
            data.add_light(Light::Directional { direction, irradiance, angular_radius: 0.0 }).unwrap();
            let scene = data.committed();
            let mut map = created(&scene, 4.0);
            map.bake(&BakeParams { gather_rays: 0, ..Default::default() }, &Progress::none()).unwrap();
            let (atlas, light) = (map.atlas(), map.light.as_ref().unwrap());
            let mut lit = 0;
            for (t, e) in atlas.map.texels.samples.iter().zip(&light.direct) {
                let at = t.position(&scene);
                if scene.normal(t.triangle).z > 0.9 {
                    let expected = if at.x > wall { std::f32::consts::SQRT_2 } else { 0.0 };
                    assert!((e.x - expected).abs() < 1e-4, "{} at {at}, wall at {wall}", e.x);
                    lit += (expected > 0.0) as u32;
                }
            }
            assert!(lit > 100);
        }
    }

    #[test]
    fn the_radiance_map_has_the_energy_of_a_patch_of_sun_smaller_than_its_texels() {
        for (edge, angular_radius) in [(1.63, 0.0), (2.11, 0.0), (2.38, 0.0), (2.11, 0.004)] {
            let scene = under_a_roof(edge, 0.1, angular_radius);
            let map = created(&scene, 10.0);
            let atlas = map.atlas();
            let direct = DirectLight::new(&scene);
            let light = TexelLight { areas: atlas.areas(&atlas.radiance), direct: &direct, samples: 4, seed: 5 };
            let input = crate::lightmap::indirect::radiance_map::RadianceInput { light, photons: None };
            let mut values = vec![Vec3::ZERO; atlas.radiance.len()];
            let progress = Progress::none();
            let stage = progress.stage("radiance", 0.0, 1.0, 1);
            crate::lightmap::indirect::radiance_map::bake(scene.device(), &input, &mut values, &stage).unwrap();
            // Texels are 0.4 wide, and 10 of them have the floor's width. Per metre of the slit:
            let on_floor = |s: &usize| atlas.radiance.texels.samples[*s].position(&scene).z.abs() < 0.5;
            let sum: f32 = (0..values.len()).filter(on_floor).map(|s| values[s].x * 0.16).sum();
            let energy = sum * std::f32::consts::PI / 0.5 / 4.0;
            assert!((energy / (2.0 * 0.1) - 1.0).abs() < 0.03, "{energy} instead of 0.2, edge {edge}");
        }
    }
}
