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

use super::chart_index::ChartIndex;
use super::chart_map::{ChartMap, receiver_of};
use super::charts::Charts;
use super::fill::{Hole, around};
use super::ids::{Map, PlacementId, TexelId, TexelRange};
use super::seen::{self, Seen};
use super::texels::TexelSample;
use crate::base::error::Result;
use crate::base::memory::{try_collect, try_filled, try_par_collect, try_push, try_vec, try_with_capacity};
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

/// Maximum number of lamps that are looked for.
const LAMPS: usize = 64;

/// A texel is visible at once if its first ray ends in the open, farther away than this many times `near`: most texels
/// need only one ray.
const AT_ONCE: f32 = 4.0;

/// Number of other points of a texel, in the triangle of its sample and in other triangles, that are tested if its sample is
/// buried, and number of candidates for them, which may miss its chart.
const POINTS: usize = 4;
const POINT_TRIES: u32 = 32;

/// Number of points that are tested together.
const BLOCK: usize = 256;

const BURIED: &str = "which texels are buried";

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
    /// Whether each chart is searched; `None`: all are.
    pub only: Option<&'a [bool]>,
}

impl Search<'_> {
    /// Moves the samples of a map's buried texels to the nearest visible ones, and returns which texels were moved
    /// (empty: none) and the number of rays. If `by_parts`, samples of texels with another point that can be seen are
    /// moved to that point instead; in placements without any visible sample this is done in any case. Advances `stage`
    /// by one per placement. To be called on the device's threads.
    pub fn move_buried<M: Map>(
        &self,
        map: &mut ChartMap<M>,
        by_parts: bool,
        stage: &Stage,
    ) -> Result<(Vec<bool>, u64)> {
        let scratch = Scratch::new();
        let of_placement = |placement: usize| {
            let mut tests = scratch.take(PointTests::new)?;
            let found = self.in_placement(map, PlacementId::new(placement), by_parts, &mut tests, stage)?;
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

    fn in_placement<M: Map>(
        &self,
        map: &ChartMap<M>,
        placement: PlacementId,
        by_parts: bool,
        tests: &mut PointTests,
        stage: &Stage,
    ) -> Result<Found<M>> {
        let mut found = Found::default();
        let chart = map.layout.chart_of(placement);
        if self.only.is_some_and(|only| !only[chart.index()]) {
            return Ok(found);
        }
        let is_back = match map.layout.is_back(placement) {
            true => true,
            false if !self.charts[chart].two_sided || map.layout.back(chart).is_some() => false,
            // The bake chooses the side if open places do not decide it.
            false => match self.seen.shows_back(chart) {
                Some(back) => back,
                None => return Ok(found),
            },
        };
        // Nobody sees a hidden side, and all of its texels would be tested by all rays.
        if self.seen.is_hidden(chart, !is_back) {
            return Ok(found);
        }
        let texels = map.texels_of(placement);
        let indices = texels.indices();
        let mut buried = Vec::new();
        for first in indices.clone().step_by(BLOCK) {
            stage.advance(0)?;
            let block = TexelId::range(first..indices.end.min(first + BLOCK));
            let points = block.map(|texel| (map[texel], map.seed_in(placement, texel)));
            for &number in self.find_buried(tests, points, is_back, &mut found.rays) {
                try_push(&mut buried, TexelId::new(first + number as usize), BURIED)?;
            }
        }
        if by_parts || buried.len() == texels.len() {
            self.find_seen_parts(map, placement, is_back, &texels, &mut buried, tests, &mut found, stage)?;
        }
        if !buried.is_empty() && buried.len() < texels.len() {
            found.moved = nearest_seen(map, placement, texels, buried, stage)?;
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
        texels: &TexelRange<M>,
        buried: &mut Vec<TexelId<M>>,
        tests: &mut PointTests,
        found: &mut Found<M>,
        stage: &Stage,
    ) -> Result<()> {
        if buried.is_empty() {
            return Ok(());
        }
        let mut is_buried = try_vec(texels.len(), BURIED)?;
        buried.iter().for_each(|&s| is_buried[texels.place(s)] = true);
        // A texel surrounded by buried ones is taken to have no visible point.
        let is_at_border = |s: TexelId<M>| {
            around(map.position(s)).any(|(x, y)| {
                let neighbour = map.at(placement, x, y);
                neighbour.is_none_or(|n| !texels.contains(n) || !is_buried[texels.place(n)])
            })
        };
        let mut candidates: Vec<Candidates<M>> = try_with_capacity(BLOCK.min(buried.len()), BURIED)?;
        let mut others = buried.iter();
        // The points of a texel are tested one by one until one of them can be seen, those of many texels side by side: alone,
        // each would take a stream of one ray per round.
        loop {
            candidates.retain(|c| c.next < c.points.len());
            while candidates.len() < BLOCK {
                stage.check()?;
                let Some(&texel) = others.next() else { break };
                if !is_at_border(texel) {
                    continue;
                }
                let seed = map.seed_in(placement, texel);
                let points = self.points_of_texel(map, placement, texel, seed);
                if !points.is_empty() {
                    candidates.push(Candidates { texel, seed, points, next: 0 });
                }
            }
            if candidates.is_empty() {
                break;
            }
            let points = candidates.iter().map(|c| (c.points[c.next], c.seed));
            let mut numbers = self.find_buried(tests, points, back, &mut found.rays).iter().peekable();
            for (number, c) in (0..).zip(&mut candidates) {
                if numbers.next_if_eq(&&number).is_some() {
                    c.next += 1;
                } else {
                    try_push(&mut found.seen_parts, (c.texel, c.points[c.next]), BURIED)?;
                    c.next = c.points.len();
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

    /// Returns the numbers of the points that are buried, in order; there are at most [`BLOCK`] points, each with a seed. In
    /// each round every undecided point traces a ray, all of them as a stream.
    fn find_buried<'t>(
        &self,
        tests: &'t mut PointTests,
        points: impl Iterator<Item = (TexelSample, u32)>,
        back: bool,
        rays: &mut u64,
    ) -> &'t [u32] {
        let PointTests { undecided, probes, hits, numbers } = tests;
        undecided.clear();
        undecided.extend((0..).zip(points).map(|(number, (point, seed))| {
            let (_, receiver) = receiver_of(self.scene, &point, back);
            Undecided { number, seed, origin: receiver.origin, normal: receiver.geometric, ..Default::default() }
        }));
        assert!(undecided.len() <= hits.len());
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
                point.open < OPEN || point.backs > 0 || point.open == point.nothing
            });
        }
        numbers.clear();
        numbers.extend(undecided.iter().filter_map(|point| {
            let mut sees_nothing = || {
                let is_behind = point.open == point.nothing && FEW_BACKS * point.near_backs >= RAYS;
                is_behind && !self.sees_lamp(point.origin, point.normal, rays)
            };
            (point.open < OPEN || 2 * point.backs > RAYS || sees_nothing()).then_some(point.number)
        }));
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

/// Points of a texel whose sample is buried, one of which may be visible.
struct Candidates<M: Map> {
    texel: TexelId<M>,
    seed: u32,
    points: Vec<TexelSample>,
    /// The one to be tested next; none is left once one can be seen.
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

/// Finds the nearest visible texels to those `buried`, ring by ring.
fn nearest_seen<M: Map>(
    map: &ChartMap<M>,
    placement: PlacementId,
    texels: TexelRange<M>,
    buried: Vec<TexelId<M>>,
    stage: &Stage,
) -> Result<Vec<(TexelId<M>, TexelId<M>)>> {
    let mut to: Vec<Option<TexelId<M>>> = try_collect(texels.clone().map(Some), BURIED)?;
    buried.iter().for_each(|&s| to[texels.place(s)] = None);
    let mut moved = try_with_capacity(buried.len(), BURIED)?;
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
            moved.push((texel, known));
        },
    )?;
    Ok(moved)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::progress::Progress;
    use crate::lightmap::atlas::Atlas;
    use crate::lightmap::atlas::ids::LightTexel;
    use crate::lightmap::{Lightmap, LightmapDesc};
    use crate::scene::demo::shapes::MeshBuilder;
    use crate::scene::{Light, LightmapUvs, Material, SceneData};
    use glam::{Mat2, Vec2, Vec3};

    /// The light map of a room of 4 × 3 × 4 m, of sheets or of a solid's inside, with a closed box in it and
    /// a second lamp, which is off.
    fn room(two_sided: bool, [lower, upper]: [Vec3; 2], unlit: Vec3) -> Lightmap {
        let mut data = SceneData::new();
        let m = data.add_material(Material { two_sided, ..Default::default() }).unwrap();
        for (lower, upper, inward) in [(Vec3::ZERO, Vec3::new(4.0, 3.0, 4.0), true), (lower, upper, false)] {
            let mut builder = MeshBuilder::new();
            builder.box_(lower, upper, inward, m);
            data.add_mesh(builder.finish()).unwrap();
        }
        data.add_light(Light::Point { position: Vec3::new(2.0, 2.5, 3.5), intensity: [9.0; 3] }).unwrap();
        data.add_light(Light::Point { position: unlit, intensity: [0.0; 3] }).unwrap();
        let desc = LightmapDesc { texels_per_unit: 20.0, ..Default::default() };
        Lightmap::create(&data.committed(), &desc, &Progress::none()).unwrap()
    }

    /// Texels of the room's floor and walls whose centres `is_covered` by the box and that are, or are not, buried.
    fn counted(lightmap: &Lightmap, is_covered: impl Fn(Vec3) -> bool) -> [usize; 2] {
        let atlas = lightmap.atlas();
        let mut n = [0; 2];
        for placement in (0..atlas.map.layout.placements.len()).map(PlacementId::new) {
            for s in atlas.map.texels_of(placement) {
                if atlas.map.is_back(s) {
                    continue;
                }
                // The centre, wherever the texel's light is from.
                let local = Vec2::from(atlas.texel_local(placement, s));
                let chart = atlas.map.layout.chart_of(placement);
                let place = atlas.charts.triangles_of(chart).filter(|&t| t < 12).find_map(|t| {
                    let [a, b, c] = atlas.charts.corners(t).map(Vec2::from);
                    let w = Mat2::from_cols(b - a, c - a).inverse() * (local - a);
                    let [p, q, r] = atlas.scene.corners(t);
                    let is_in = w.min_element() > -1e-3 && w.x + w.y < 1.001;
                    is_in.then(|| p + (q - p) * w.x + (r - p) * w.y)
                });
                if place.is_some_and(&is_covered) {
                    n[usize::from(atlas.buried.get(s.index()) == Some(&true))] += 1;
                }
            }
        }
        n
    }

    #[test]
    fn the_floor_below_a_box_is_buried_and_takes_its_light_from_beside_it() {
        let (lower, upper) = (Vec3::new(1.0, -0.1, 1.0), Vec3::new(1.6, 1.0, 1.6));
        for two_sided in [false, true] {
            let lightmap = room(two_sided, [lower, upper], 0.5 * (lower + upper));
            let below = |margin: f32| {
                move |p: Vec3| {
                    p.y < 0.01
                        && p.x > lower.x + margin
                        && p.x < upper.x - margin
                        && p.z > lower.z + margin
                        && p.z < upper.z - margin
                }
            };
            let [seen, buried] = counted(&lightmap, below(0.05));
            // A box that one fits into, of sheets, has a floor that could be seen.
            if two_sided {
                assert!(seen > 80, "{seen} {buried}");
                continue;
            }
            assert!(buried > 80 && seen == 0, "{seen} {buried}");
            let [_, elsewhere] = counted(&lightmap, |p| !below(-0.05)(p));
            assert_eq!(elsewhere, 0);
            let atlas = lightmap.atlas();
            for s in atlas.map.all().filter(|s| atlas.buried[s.index()]) {
                let p = atlas.map.surface(&atlas.scene, s).0;
                // Texels of the box's sides below the floor take the light of those above it.
                let is_above_floor = p.y > 0.0 && p.y < 0.051;
                assert!(!below(0.0)(p) && below(-0.11)(p) || is_above_floor || p.y < 0.0, "{p}");
            }
        }
    }

    #[test]
    fn a_strip_of_floor_in_a_hollow_wall_of_sheets_is_buried() {
        let (lower, upper) = (Vec3::new(1.0, -0.01, -0.01), Vec3::new(1.08, 3.01, 4.01));
        // The part of the room behind the wall has a lamp, too.
        let lightmap = room(true, [lower, upper], Vec3::new(0.5, 2.0, 2.0));
        let [seen, buried] = counted(&lightmap, |p| p.y < 0.01 && p.x > 1.02 && p.x < 1.06);
        // Some see the wall's ends.
        assert!(buried > 8 * seen && buried > 60, "{seen} {buried}");
        let [_, elsewhere] = counted(&lightmap, |p| p.x < 0.97 || p.x > 1.11);
        assert_eq!(elsewhere, 0);
    }

    #[test]
    fn what_a_wardrobe_5_mm_off_the_wall_covers_is_buried_and_what_one_a_hand_off_covers_is_not() {
        for (gap, expected) in [(0.005, true), (0.15, false)] {
            let lightmap = room(false, [Vec3::new(gap, 0.0, 1.0), Vec3::new(0.6, 2.0, 2.0)], Vec3::ONE);
            let [seen, buried] =
                counted(&lightmap, |p| p.x < 0.001 && p.y > 0.1 && p.y < 1.9 && p.z > 1.1 && p.z < 1.9);
            assert!(if expected { buried > 9 * seen } else { buried * 50 < seen }, "{gap}: {seen} {buried}");
        }
    }

    /// Unit squares of one-sided surface, each by a corner and two edges, below a lamp in the open.
    fn squares(squares: &[[Vec3; 3]], texels_per_unit: f32) -> Lightmap {
        let mut data = SceneData::new();
        let m = data.add_material(Material::default()).unwrap();
        for &[at, u, v] in squares {
            let mut builder = MeshBuilder::new();
            builder.quad(at, at + u, at + u + v, at + v, m);
            data.add_mesh(builder.finish()).unwrap();
        }
        data.add_light(Light::Point { position: Vec3::new(0.5, 0.9, 0.5), intensity: [1.0; 3] }).unwrap();
        let desc = LightmapDesc { texels_per_unit, ..Default::default() };
        Lightmap::create(&data.committed(), &desc, &Progress::none()).unwrap()
    }

    /// It sees nothing but the sheet's back and the void.
    #[test]
    fn a_floor_in_the_open_below_the_back_of_a_sheet_is_not_buried() {
        let floor = [Vec3::ZERO, Vec3::Z, Vec3::X];
        let sheet = [0.5 * Vec3::Y, Vec3::Z, 0.5 * Vec3::X];
        assert_eq!(squares(&[floor, sheet], 32.0).info().buried_texels, 0);
    }

    /// It sees nothing but the wall's back, nearby, and the void, but the lamp shines on it.
    #[test]
    fn a_lit_floor_in_the_open_beside_the_back_of_a_wall_is_not_buried() {
        let floor = [Vec3::ZERO, Vec3::Z, Vec3::X];
        let wall = [Vec3::ZERO, Vec3::Z, Vec3::Y];
        assert_eq!(squares(&[floor, wall], 40.0).info().buried_texels, 0);
    }

    /// The rim of a board, a tenth of a texel wide, unfolded with the side of the board, which stands 1 mm before a block.
    #[test]
    fn a_texel_shows_the_narrow_part_of_it_that_can_be_seen() {
        let mut data = SceneData::new();
        let m = data.add_material(Material::default()).unwrap();
        let (rim, density, page) = (0.005, 20.0, 1024);
        let mut board = MeshBuilder::new();
        board.sheet(2, 1, m, |u, v| {
            let y = if u > 0.75 { 0.7 } else { 1.0 };
            Vec3::new(if u > 0.25 { 2.0 + rim } else { 2.0 }, y, 3.0 - 2.0 * v)
        });
        let mut board = board.finish();
        let uv = |p: &Vec3| Vec2::new((p.x - 2.0) + (1.0 - p.y), p.z) * density / page as f32;
        board.lightmap = Some(LightmapUvs { uvs: board.positions.iter().map(uv).collect(), pages: Vec::new().into() });
        data.add_mesh(board).unwrap();
        let block = [Vec3::new(2.006, 0.5, 0.9), Vec3::new(2.3, 1.0, 3.1)];
        for ([lower, upper], inward) in [(block, false), ([Vec3::ZERO, Vec3::new(4.0, 3.0, 4.0)], true)] {
            let mut builder = MeshBuilder::new();
            builder.box_(lower, upper, inward, m);
            data.add_mesh(builder.finish()).unwrap();
        }
        data.add_light(Light::Point { position: Vec3::new(2.0, 2.5, 3.5), intensity: [9.0; 3] }).unwrap();
        let desc = LightmapDesc { texels_per_unit: density, page_size: page, ..Default::default() };
        let lightmap = Lightmap::create(&data.committed(), &desc, &Progress::none()).unwrap();
        let atlas = lightmap.atlas();
        let texels = atlas.map.texels_of(PlacementId::front_of(atlas.charts.chart_of(0)));
        let shows_rim = |&s: &LightTexel| atlas.map.surface(&atlas.scene, s).0.y == 1.0;
        let of_rim = texels.clone().filter(|&s| atlas.map.position(s).0 == 0 && !atlas.buried[s.index()]);
        let (shown, all) = (of_rim.clone().filter(shows_rim).count(), of_rim.count());
        // A texel on the side counts as open if its first ray leaves the gap, which one in ten does.
        assert!(all >= 40 && shown >= 30, "{shown} of {all}");
        // The others are buried and take the light of the nearest: of the rim, or of one that counts as open, once in ten rows.
        let (shown, all) = (texels.clone().filter(shows_rim).count(), texels.len());
        assert!(all >= 240 && shown > 8 * all / 10, "{shown} of {all}");
    }

    #[test]
    fn points_that_are_tested_together_are_buried_if_they_are_alone() {
        // It ends within texels.
        let (lower, upper) = (Vec3::new(1.0, -0.1, 1.0), Vec3::new(1.62, 1.0, 1.62));
        let lightmap = room(false, [lower, upper], Vec3::ONE);
        let atlas = lightmap.atlas();
        let Atlas { scene, charts, index, seen, .. } = &**atlas;
        let search = Search { scene, charts, index, seen, near: 0.05, outdoors: false, only: None };
        let (mut together, mut alone) = (PointTests::new().unwrap(), PointTests::new().unwrap());
        let (mut buried, mut rays, mut rays_alone) = (0, 0, 0);
        // The floor's texels, at their own places: samples of buried ones lie elsewhere.
        let count = |p: &PlacementId| atlas.map.texels_of(*p).filter(|s| atlas.buried[s.index()]).count();
        let floor = (0..atlas.map.layout.placements.len()).map(PlacementId::new).max_by_key(count).unwrap();
        let texels: Vec<LightTexel> = atlas.map.texels_of(floor).collect();
        for block in texels.chunks(BLOCK) {
            let point = |&s: &LightTexel| {
                let placement = &atlas.map.layout[floor];
                atlas.index.in_texel(&atlas.charts, placement, &atlas.map[s], [0.5; 2]).map(|p| (p, s.index() as u32))
            };
            let points: Vec<(TexelSample, u32)> = block.iter().filter_map(point).collect();
            let found = search.find_buried(&mut together, points.iter().copied(), false, &mut rays);
            let is_alone = |(_, point): &(u32, &(TexelSample, u32))| {
                !search.find_buried(&mut alone, std::iter::once(**point), false, &mut rays_alone).is_empty()
            };
            let expected: Vec<u32> = (0..).zip(&points).filter(is_alone).map(|(number, _)| number).collect();
            assert_eq!(found, expected);
            buried += found.len();
        }
        assert!(buried > 80 && texels.len() > buried + BLOCK && rays == rays_alone, "{buried} of {}", texels.len());

        // Other points of more texels than are tested together: of every second column, as if their samples were buried.
        let (all, mut found, progress) = (atlas.map.texels_of(floor), Found::default(), Progress::none());
        let given: Vec<LightTexel> = texels.iter().copied().step_by(2).collect();
        let (mut left, stage) = (given.clone(), progress.stage("buried texels", 0.0, 1.0, 1));
        search.find_seen_parts(&atlas.map, floor, false, &all, &mut left, &mut together, &mut found, &stage).unwrap();
        found.seen_parts.sort_unstable_by_key(|part| part.0);
        let place = |(s, p): (LightTexel, TexelSample)| (s, p.triangle, p.u, p.v);
        let seen_part = |&s: &LightTexel| {
            let seed = atlas.map.seed_in(floor, s);
            let mut points = search.points_of_texel(&atlas.map, floor, s, seed).into_iter();
            points
                .find(|&p| search.find_buried(&mut alone, std::iter::once((p, seed)), false, &mut 0).is_empty())
                .map(|point| place((s, point)))
        };
        let expected: Vec<_> = given.iter().filter_map(seen_part).collect();
        assert_eq!(found.seen_parts.into_iter().map(place).collect::<Vec<_>>(), expected);
        assert!(expected.len() > BLOCK && left.len() > 20 && left.len() + expected.len() == given.len());
    }

    /// A wall between two rooms, and a poster 5 mm behind a part of it.
    #[test]
    fn a_back_with_a_place_of_its_own_has_buried_texels_of_its_own() {
        let mut data = SceneData::new();
        let m = data.add_material(Material { two_sided: true, ..Default::default() }).unwrap();
        let quad = |size: f32, z: f32| {
            let p = |x: f32, y: f32| Vec3::new(x, y, z);
            let mut builder = MeshBuilder::new();
            builder.quad(p(-size, -size), p(size, -size), p(size, size), p(-size, size), m);
            builder.finish()
        };
        data.add_mesh(quad(2.0, 0.0)).unwrap();
        data.add_mesh(quad(0.8, -0.005)).unwrap();
        let mut room = MeshBuilder::new();
        room.box_(Vec3::splat(-2.0), Vec3::splat(2.0), true, m);
        data.add_mesh(room.finish()).unwrap();
        let desc = LightmapDesc { texels_per_unit: 20.0, ..Default::default() };
        let lightmap = Lightmap::create(&data.committed(), &desc, &Progress::none()).unwrap();
        let atlas = lightmap.atlas();
        let wall = atlas.charts.chart_of(0);
        let back = atlas.map.layout.back(wall).unwrap();
        let poster = PlacementId::front_of(atlas.charts.chart_of(2));
        let buried = |placement| atlas.map.texels_of(placement).filter(|s| atlas.buried[s.index()]).count();
        assert_eq!(buried(PlacementId::front_of(wall)), 0);
        // 32 × 32 texels lie behind it.
        assert!((900..1100).contains(&buried(back)), "{}", buried(back));
        assert_eq!(lightmap.info().buried_texels, (buried(back) + buried(poster)) as u64);
    }
}
