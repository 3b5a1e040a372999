//! Finds which charts can be seen from the places from which somebody looks at the scene.
//!
//! Rays in all directions from random places of the given regions count how often the sides of charts are seen. Charts
//! that none of them hit are looked at from the other end, by rays from points of theirs to places of the regions: a chart
//! counts as unseen only if these are all occluded, too. Unseen charts get the fewest texels possible in the light map and
//! the gather map; in the radiance map they keep theirs, since light that they reflect is seen.

use super::chart_map::ChartMap;
use super::charts::Charts;
use super::ids::{ChartId, PlacementId, RadianceMap};
use super::seen::{BACKS, COUNTS, Seen};
use crate::base::error::Result;
use crate::base::memory::try_collect;
use crate::base::parallel::{ParallelLoop, one_by_one};
use crate::base::progress::Stage;
use crate::base::sampling::{combine, uniform, uniform_sphere};
use crate::lightmap::Region;
use crate::scene::Scene;
use crate::trace::{RawHit, Ray};
use glam::Vec3;
use rayon::prelude::*;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering::Relaxed};

/// Number of places from which rays start, in turn in each region, and rays of each.
const PLACES: u32 = 1 << 12;
const RAYS: u32 = 512;

/// Rays that are traced together.
const TOGETHER: usize = 128;

/// Maximum number of points of a side of a chart that look back, and places that each looks at.
const POINTS: usize = 16;
const LOOKS: u32 = 16;

/// Part of the way to a surface on which rays that look at it end before it.
const SHORT: f32 = 1e-3;

/// Purpose of the random numbers.
const PURPOSE: u32 = 0x5ee0;

/// Replaces the counts of `seen` by those from the `regions`, and finds the unseen charts. Advances `stage` by
/// [`work`]. To be called on the device's threads.
pub(crate) fn look(
    scene: &Scene,
    charts: &Charts,
    radiance: &ChartMap<RadianceMap>,
    regions: &[Region],
    stage: &Stage,
    seen: &mut Seen,
) -> Result<()> {
    let eye = Eye { scene, charts, radiance, regions };
    let counters: Vec<[AtomicU32; 2]> = try_collect(charts.charts.iter().map(|_| Default::default()), COUNTS)?;
    let rays = AtomicU64::new(0);
    one_by_one((0..PLACES).into_par_iter()).try_each(|number| {
        eye.look_around(number, &counters);
        rays.fetch_add(u64::from(RAYS), Relaxed);
        stage.advance(1)
    })?;
    one_by_one((0..charts.charts.len()).into_par_iter().map(ChartId::new)).try_each(|chart| {
        let counts = &counters[chart.index()];
        for side in [0, 1] {
            if counts[side].load(Relaxed) == 0 && eye.is_seen(chart, side == 0, &rays) {
                counts[side].store(1, Relaxed);
            }
        }
        stage.advance(1)
    })?;
    seen.counts = try_collect(counters.into_iter().map(|of_chart| of_chart.map(AtomicU32::into_inner)), COUNTS)?;
    if seen.hidden.is_empty() {
        seen.hidden = try_collect(seen.counts.iter().map(|_| [false; 2]), COUNTS)?;
    }
    seen.unseen = try_collect(seen.counts.iter().map(|counts| *counts == [0; 2]), COUNTS)?;
    seen.rays += rays.into_inner();
    Ok(())
}

/// Returns the number of steps by which [`look`] advances its stage.
pub(crate) fn work(charts: &Charts, regions: &[Region]) -> u64 {
    if regions.is_empty() { 0 } else { u64::from(PLACES) + charts.charts.len() as u64 }
}

struct Eye<'a> {
    scene: &'a Scene,
    charts: &'a Charts,
    radiance: &'a ChartMap<RadianceMap>,
    regions: &'a [Region],
}

impl Eye<'_> {
    /// Returns a random place in one of the regions.
    fn place(&self, number: u32, seed: u32) -> Vec3 {
        let region = &self.regions[number as usize % self.regions.len()];
        let at = Vec3::from_array(std::array::from_fn(|d| uniform(number, d as u32, combine(PURPOSE, seed))));
        region.lower + (region.upper - region.lower) * at
    }

    /// Counts the sides that rays from a place see, unless it lies inside a solid.
    fn look_around(&self, number: u32, counters: &[[AtomicU32; 2]]) {
        let position = self.place(number, 0);
        let mut rays = [Ray::new(position, Vec3::Z); TOGETHER];
        let mut hits = [RawHit::MISS; TOGETHER];
        for begin in (0..RAYS).step_by(TOGETHER) {
            for (i, ray) in (begin..).zip(&mut rays) {
                let direction = uniform_sphere([0, 1].map(|d| uniform(i, d, combine(number, PURPOSE))));
                *ray = Ray::new(position, direction);
            }
            self.scene.intersect_stream(&rays, &mut hits);
            let is_met = |hit: &&RawHit| !hit.is_miss();
            let backs = hits.iter().filter(is_met).filter(|hit| !self.shows(hit)).count();
            if backs as f32 > BACKS * hits.iter().filter(is_met).count() as f32 {
                return;
            }
            let mut crossings = Vec::new();
            for (ray, hit) in rays.iter().zip(&hits).filter(|(_, hit)| !hit.is_miss()) {
                self.count(hit, counters);
                if self.scene.material(hit.triangle).transmits() {
                    let behind = self.scene.intersect_through(ray, &mut crossings);
                    crossings.iter().for_each(|c| self.count(&c.hit, counters));
                    self.count(&behind, counters);
                }
            }
        }
    }

    /// Whether a hit lies on a side that is drawn: not on the back of a one-sided surface.
    fn shows(&self, hit: &RawHit) -> bool {
        hit.front || self.scene.material(hit.triangle).two_sided
    }

    fn count(&self, hit: &RawHit, counters: &[[AtomicU32; 2]]) {
        if hit.is_miss() || !self.shows(hit) {
            return;
        }
        let chart = self.charts.chart_of(hit.triangle);
        if chart != ChartId::NONE {
            counters[chart.index()][usize::from(!hit.front)].fetch_add(1, Relaxed);
        }
    }

    /// Whether some point of a side of a chart can be seen from some place of the regions.
    fn is_seen(&self, chart: ChartId, front: bool, traced: &AtomicU64) -> bool {
        if !front && !self.charts[chart].two_sided {
            return false;
        }
        if self.charts.times_shown(chart) > 1 {
            // Texels tell of one of the places where it stands.
            return true;
        }
        let placement = PlacementId::front_of(chart);
        let texels = self.radiance.texels_of(placement);
        let step = texels.len().div_ceil(POINTS).max(1);
        let mut crossings = Vec::new();
        texels.step_by(step).any(|texel| {
            let (_, receiver) = self.radiance.receiver(self.scene, texel, !front);
            let seed = self.radiance.seed_in(placement, texel);
            (0..LOOKS).any(|look| {
                let place = self.place(look, seed);
                let away = receiver.origin - place;
                if away.dot(receiver.geometric) >= 0.0 {
                    return false;
                }
                traced.fetch_add(1, Relaxed);
                let ray = Ray::new(place, away).within(0.0, 1.0 - SHORT);
                match self.scene.uses().transmission {
                    true => self.scene.intersect_through(&ray, &mut crossings).is_miss(),
                    false => !self.scene.occluded(&ray),
                }
            })
        })
    }
}

#[cfg(test)]
mod tests {
    use crate::base::progress::Progress;
    use crate::lightmap::atlas::ids::ChartId;
    use crate::lightmap::{BakeParams, Lightmap, LightmapDesc, Region};
    use crate::scene::demo::shapes::MeshBuilder;
    use crate::scene::{Light, Material, SceneData};
    use glam::Vec3;

    /// Two rooms without a door between them, side by side, with a table in each.
    fn rooms(seen_from: Vec<Region>, two_sided: bool) -> Lightmap {
        let mut data = SceneData::new();
        let m = data.add_material(Material { two_sided, ..Default::default() }).unwrap();
        let p = Vec3::new;
        for x in [0.0, 5.0] {
            let mut b = MeshBuilder::new();
            b.box_(p(x, 0.0, 0.0), p(x + 4.0, 3.0, 4.0), true, m);
            data.add_mesh(b.finish()).unwrap();
            let mut b = MeshBuilder::new();
            b.box_(p(x + 1.0, 0.7, 1.0), p(x + 2.0, 0.8, 2.0), false, m);
            data.add_mesh(b.finish()).unwrap();
        }
        for x in [2.0, 7.0] {
            data.add_light(Light::Point { position: Vec3::new(x, 2.0, 3.0), intensity: [30.0; 3] }).unwrap();
        }
        let desc = LightmapDesc { texels_per_unit: 20.0, seen_from, ..Default::default() };
        Lightmap::create(&data.committed(), &desc, &Progress::none()).unwrap()
    }

    #[test]
    fn what_is_seen_has_the_light_that_it_has_otherwise() {
        let region = Region { lower: Vec3::new(0.2, 0.9, 0.2), upper: Vec3::new(3.8, 2.9, 3.8) };
        let light = |seen_from: Vec<Region>| {
            let mut map = rooms(seen_from, false);
            let params = BakeParams { photon_count: 100_000, ..Default::default() };
            map.bake(&params, &Progress::none()).unwrap();
            map
        };
        let (all, some) = (light(Vec::new()), light(vec![region]));
        let mean = |map: &Lightmap, t: u32| {
            let atlas = map.atlas();
            let texels = atlas.map.texels_of(atlas.map.layout.place_of(atlas.charts.chart_of(t), true));
            let (n, of) = (texels.len(), map.light().unwrap());
            (texels.map(|s| (of.direct[s.index()] + of.indirect[s.index()]).x).sum::<f32>() / n as f32, n)
        };
        let unseen = &some.atlas().seen.unseen;
        for t in (0..24).filter(|&t| !unseen[some.atlas().charts.chart_of(t).index()]) {
            let ((a, n), (b, _)) = (mean(&all, t), mean(&some, t));
            // Edges of the table have a handful of gather texels, and their noise.
            let tolerance = if n >= 100 { 0.01 } else { 0.05 };
            assert!((a - b).abs() < tolerance * a, "triangle {t}, {n} texels: {b} for {a}");
        }
        // Even the few texels of the other room have its light, roughly.
        for t in 24..36 {
            let (a, b) = (mean(&all, t).0, mean(&some, t).0);
            assert!((a - b).abs() < a, "triangle {t}: {b} for {a}");
        }
    }

    #[test]
    fn charts_that_cannot_be_seen_get_the_fewest_texels() {
        let point = |p: Vec3| Region { lower: p, upper: p };
        for two_sided in [false, true] {
            let all = rooms(Vec::new(), two_sided);
            let regions = vec![Region { lower: Vec3::new(0.2, 0.1, 0.2), upper: Vec3::new(3.8, 2.9, 3.8) }];
            let some = rooms(regions, two_sided);
            let (atlas, info) = (some.atlas(), some.info());
            let unseen = |triangle: u32| atlas.seen.unseen[atlas.charts.chart_of(triangle).index()];
            assert!((0..24).all(|t| !unseen(t)) && (24..48).all(unseen), "two-sided: {two_sided}");
            assert_eq!(info.unseen_charts, 12);
            let before = all.info();
            assert!(info.texels < before.texels * 6 / 10, "{} of {}", info.texels, before.texels);
            let spared = before.texels as f64 - info.texels as f64;
            // Backs that unseen charts would have had are not counted.
            let least = if two_sided { 0.7 } else { 0.9 };
            assert!((least..1.1).contains(&(info.spared_texels as f64 / spared)), "{info:?} for {spared}");
            assert_eq!(info.radiance_texels, before.radiance_texels);
            // What is seen has the texels that it has otherwise.
            let texels = |map: &Lightmap, t: u32| {
                let chart: ChartId = map.atlas().charts.chart_of(t);
                let place = map.atlas().map.layout.place_of(chart, true);
                map.atlas().map.texels_of(place).len()
            };
            assert!((0..24).all(|t| texels(&all, t) == texels(&some, t)));
        }
        // From below the table, its top is unseen, and from above its underside.
        for (y, seen) in [(0.3, [false, true]), (1.5, [true, false])] {
            let map = rooms(vec![point(Vec3::new(1.5, y, 1.5))], false);
            let atlas = map.atlas();
            let of = |up: f32| (12..24).find(|&t| atlas.scene.normal(t).y * up > 0.9).map(|t| atlas.charts.chart_of(t));
            let is_seen = [of(1.0), of(-1.0)].map(|chart| !atlas.seen.unseen[chart.unwrap().index()]);
            assert_eq!(is_seen, seen, "from {y}");
        }
    }
}
