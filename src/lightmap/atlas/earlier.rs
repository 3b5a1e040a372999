//! What the atlas of a scene that is described anew takes over from that of the earlier scene: charts, of which only those of
//! new surfaces are unwrapped, and which texels are buried, which is searched only near what has changed.
//!
//! Sides are counted anew: that takes little time, and new things may hide or show any of them.

use super::Atlas;
use super::buried::{BURIED, Only, Part, reach};
use super::chart_map::ChartMap;
use super::charts::Charts;
use super::ids::{ChartId, GatherMap, LightMap, Map, PlacementId, RadianceMap};
use super::pieces::{CHARTS, ITEMS_PER_CHECK, Piece, triangle_area};
use super::seen::{self, Seen};
use super::texels::TexelSample;
use crate::base::bounds::Bounds;
use crate::base::error::Result;
use crate::base::memory::{try_collect, try_par_collect, try_push, try_vec, try_with_capacity};
use crate::base::parallel::{ParallelLoop, one_by_one};
use crate::base::progress::{Progress, Stage};
use crate::base::sort::sort;
use crate::lightmap::moved::{MOST_BOXES, merged};
use crate::lightmap::surfaces::{Rest, Surfaces};
use crate::scene::Scene;
use glam::Vec2;
use rayon::prelude::*;

/// Distance, in texels, up to which points of charts are the same.
const SAME: f32 = 0.01;

/// Greatest relative difference of the area of a chart's triangles from that when it was made.
const SAME_AREA: f64 = 0.01;

/// Maximum number of boxes around charts with a side that is hidden and was not, or the other way round.
const MOST_TURNED: usize = 256;

/// A side that was hidden is seen now, or the other way round, if its rays from open places have doubled or halved, by more than
/// this number: else chance has decided, and nothing around it can have changed.
const CLEARLY: u32 = 8;

/// The atlas of an earlier scene, and what it has in common with the new one.
pub(in crate::lightmap) struct Earlier<'a> {
    atlas: &'a Atlas,
    surfaces: Surfaces,
    /// Boxes around what only one of the scenes has.
    boxes: Vec<Bounds>,
    /// Whether lamps stand where they stood, and a sun or a sky shines if one shone.
    has_same_lamps: bool,
}

impl<'a> Earlier<'a> {
    /// Matches the surfaces of a new scene. To be called on the device's threads.
    pub fn new(atlas: &'a Atlas, scene: &Scene, progress: &Progress) -> Result<Earlier<'a>> {
        let (surfaces, Rest { boxes, .. }) = Surfaces::between([&atlas.scene, scene], progress)?;
        let has_same_lamps = atlas.is_outdoors == seen::is_outdoors(scene) && atlas.lamps == seen::lamps(scene)?;
        Ok(Earlier { atlas, surfaces, boxes: merged(boxes, MOST_BOXES), has_same_lamps })
    }

    /// Makes pieces of those of the given triangles (ascending) whose charts have no others, and have had none.
    pub fn pieces(&self, scene: &Scene, triangles: &[u32], stage: &Stage) -> Result<Vec<Piece>> {
        let charts = &self.atlas.charts;
        let _memory = scene.device().memory().reserve(size_of::<(ChartId, u32, u32)>() * triangles.len(), CHARTS)?;
        // Chart, triangle, and its former number.
        let mut known: Vec<(ChartId, u32, u32)> = try_with_capacity(triangles.len(), CHARTS)?;
        for (i, &triangle) in triangles.iter().enumerate() {
            if i % ITEMS_PER_CHECK == 0 {
                stage.check()?;
            }
            // An instance that showed another one's light had charts as large as that one's.
            let former = self.surfaces.triangle(scene, triangle).filter(|&former| charts.is_own(former));
            if let Some((former, chart)) = former.and_then(|former| Some((former, charts.find(former)?)))
                && charts[chart].given.is_none()
            {
                known.push((chart, triangle, former));
            }
        }
        sort(&mut known, &|| stage.check())?;
        let mut pieces = Vec::new();
        for of_chart in known.chunk_by(|a, b| a.0 == b.0) {
            stage.check()?;
            let chart = of_chart[0].0;
            let area = || of_chart.iter().map(|&(_, triangle, _)| triangle_area(scene, triangle)).sum::<f64>();
            // The earlier scene may have been refitted since its charts were made.
            let has_its_size = || (area() / f64::from(charts[chart].area) - 1.0).abs() < SAME_AREA;
            if of_chart.len() == charts.triangles_of(chart).len() && has_its_size() {
                let numbers = try_collect(of_chart.iter().map(|&(_, triangle, _)| triangle), CHARTS)?;
                let corners = try_collect(of_chart.iter().map(|&(_, _, former)| charts.corners(former)), CHARTS)?;
                let piece = Piece { triangles: numbers.into(), corners: corners.into(), given: None };
                try_push(&mut pieces, piece, CHARTS)?;
            }
        }
        Ok(pieces)
    }

    /// Finds out which texels are taken over. `near` is the distance at which surfaces cover texels.
    pub fn texels(
        &self,
        scene: &Scene,
        charts: &Charts,
        (map, gather, radiance): (&ChartMap<LightMap>, &ChartMap<GatherMap>, &ChartMap<RadianceMap>),
        seen: &Seen,
        near: f32,
        stage: &Stage,
    ) -> Result<TakenOver> {
        let atlas = self.atlas;
        let reach = reach(near, 1.0 / map.layout.density);
        let mut boxes: Vec<Bounds> = self.boxes.iter().map(|bounds| bounds.grown(reach)).collect();
        let most = SAME / map.layout.density;
        let of_chart = |number: usize| {
            let chart = ChartId::new(number);
            stage.check()?;
            let Some(former) = self.has_same_lamps.then(|| self.former_chart(scene, charts, chart, most)).flatten()
            else {
                return Ok((ChartId::NONE, Bounds::EMPTY, false));
            };
            let before = &atlas.seen;
            let has_same_sides = [true, false].map(|front| seen.is_hidden(chart, front))
                == [true, false].map(|front| before.is_hidden(former, front))
                && seen.shows_back(chart) == before.shows_back(former);
            let counts = [(seen, chart), (before, former)].map(|(seen, chart)| seen.counts.get(chart.index()));
            let differ = |a: u32, b: u32| a.abs_diff(b) > a.min(b).max(CLEARLY);
            let has_turned =
                !has_same_sides && matches!(counts, [Some(&[a, b]), Some(&[c, d])] if differ(a, c) || differ(b, d));
            let size = charts[chart].size;
            let is_alike = are_alike((&atlas.map, former), (map, chart), size)
                && are_alike((&atlas.gather, former), (gather, chart), size)
                && are_alike((&atlas.radiance, former), (radiance, chart), size);
            let former = if has_same_sides && is_alike { former } else { ChartId::NONE };
            Ok((former, charts.bounds(scene, chart), has_turned))
        };
        let numbers = 0..charts.charts.len();
        let found = try_par_collect(one_by_one(numbers.into_par_iter().map(of_chart)), CHARTS)?;
        let (mut formers, mut bounds, mut turned) =
            (try_with_capacity(found.len(), CHARTS)?, try_with_capacity(found.len(), CHARTS)?, Vec::new());
        for of_chart in found {
            let (former, around, has_turned): (ChartId, Bounds, bool) = of_chart?;
            formers.push(former);
            bounds.push(around);
            // What sees little else than this chart is no farther away than it is wide.
            if has_turned {
                try_push(&mut turned, around.grown(around.width().max(reach)), CHARTS)?;
            }
        }
        boxes.append(&mut merged(turned, MOST_TURNED));
        let part = |(former, around): (&ChartId, &Bounds)| match former {
            &ChartId::NONE => Part::All,
            _ if boxes.iter().any(|bounds| bounds.overlaps(around)) => Part::Near,
            _ => Part::None,
        };
        let searched = try_collect(formers.iter().zip(&bounds).map(part), CHARTS)?;
        Ok(TakenOver { formers, searched, boxes })
    }

    /// Returns the former chart of the same triangles in the same places, up to a distance, that was theirs alone.
    fn former_chart(&self, scene: &Scene, charts: &Charts, chart: ChartId, most: f32) -> Option<ChartId> {
        let before = &*self.atlas.charts;
        let found = self.surfaces.chart(scene, [before, charts], chart, most)?;
        let had_own = |triangle| self.surfaces.triangle(scene, triangle).is_some_and(|former| before.is_own(former));
        charts.triangles_of(chart).all(had_own).then_some(found)
    }

    /// Copies samples that are taken over. Returns which texels of the light map are buried among them; empty: none.
    pub fn copy(
        &self,
        scene: &Scene,
        charts: &Charts,
        taken: &TakenOver,
        (map, gather, radiance): (&mut ChartMap<LightMap>, &mut ChartMap<GatherMap>, &mut ChartMap<RadianceMap>),
        stage: &Stage,
    ) -> Result<Vec<bool>> {
        let atlas = self.atlas;
        let mut buried = try_vec(if atlas.buried.is_empty() { 0 } else { map.len() }, BURIED)?;
        if !buried.is_empty() {
            for placement in (0..map.layout.placements.len()).map(PlacementId::new) {
                if let Some(former) = taken.former_place(&atlas.map, map, placement) {
                    let were = &atlas.buried[atlas.map.texels_of(former).indices()];
                    let all = taken.searched[map.layout.chart_of(placement).index()] == Part::None;
                    for (texel, &was) in map.texels_of(placement).zip(were).filter(|(_, was)| **was) {
                        buried[texel.index()] = was && (all || !taken.only().is_near(scene, &map[texel]));
                    }
                }
            }
        }
        self.copy_samples(scene, charts, taken, &atlas.map, map, stage)?;
        self.copy_samples(scene, charts, taken, &atlas.gather, gather, stage)?;
        self.copy_samples(scene, charts, taken, &atlas.radiance, radiance, stage)?;
        Ok(buried)
    }

    fn copy_samples<M: Map>(
        &self,
        scene: &Scene,
        charts: &Charts,
        taken: &TakenOver,
        old: &ChartMap<M>,
        map: &mut ChartMap<M>,
        stage: &Stage,
    ) -> Result<()> {
        // Former places with the samples that they give theirs to.
        let mut places = Vec::new();
        for placement in (0..map.layout.placements.len()).map(PlacementId::new) {
            if let Some(former) = taken.former_place(old, map, placement) {
                let range = map.texels_of(placement).indices();
                try_push(&mut places, (map.layout.chart_of(placement), former, range), BURIED)?;
            }
        }
        let (mut rest, mut before) = (&mut map.texels.samples[..], 0);
        let mut parts = try_with_capacity(places.len(), BURIED)?;
        for (chart, former, range) in places {
            let (samples, others) = std::mem::take(&mut rest)[range.start - before..].split_at_mut(range.len());
            (rest, before) = (others, range.end);
            parts.push((chart, former, samples));
        }
        // Most samples are where they were made, but for rounding.
        let most = SAME / map.layout.density;
        let is_near = |a: &TexelSample, b: &TexelSample| {
            let [a, b] = [a, b].map(|t| Vec2::from(charts.local(t.triangle, t.u, t.v)));
            a.distance_squared(b) <= most * most
        };
        one_by_one(parts.into_par_iter()).try_each(|(chart, former, samples)| {
            stage.check()?;
            let number = |triangle| Some((self.surfaces.triangle(scene, triangle)?, triangle));
            let mut numbers = try_collect(charts.triangles_of(chart).map_while(number), BURIED)?;
            numbers.sort_unstable();
            let only = Some(taken.only()).filter(|only| only.charts[chart.index()] == Part::Near);
            let former = &old.texels.samples[old.texels_of(former).indices()];
            for (i, (sample, was)) in samples.iter_mut().zip(former).enumerate() {
                if i % ITEMS_PER_CHECK == 0 {
                    stage.check()?;
                }
                if only.is_some_and(|only| only.is_near(scene, sample)) {
                    continue;
                }
                let at = numbers.partition_point(|&(former, _)| former < was.triangle);
                let former = TexelSample { triangle: numbers[at].1, u: was.u, v: was.v, ..*sample };
                if !is_near(sample, &former) {
                    *sample = former;
                }
            }
            Ok(())
        })
    }
}

/// Which texels are taken over from an earlier atlas.
pub(in crate::lightmap) struct TakenOver {
    /// By chart, the former number of one whose texels show what they did, on the same sides; [`ChartId::NONE`]: there was none.
    formers: Vec<ChartId>,
    /// Part of each chart that is searched for buried texels. The rest is taken over.
    searched: Vec<Part>,
    /// Boxes around what has changed, so large that nothing in the changes covers texels outside of them.
    boxes: Vec<Bounds>,
}

impl TakenOver {
    /// Returns the texels that are still to be searched.
    pub fn only(&self) -> Only<'_> {
        Only { charts: &self.searched, boxes: &self.boxes }
    }

    /// Returns the number of charts that are taken over, at least in part.
    pub fn charts(&self) -> u32 {
        self.formers.iter().filter(|&&former| former != ChartId::NONE).count() as u32
    }

    /// Adds the texels of the light map that [were](Earlier::copy) buried to those that the search has found (empty: none).
    pub fn add_buried(
        &self,
        were: &[bool],
        charts: &Charts,
        map: &ChartMap<LightMap>,
        buried: &mut Vec<bool>,
    ) -> Result<()> {
        if buried.is_empty() {
            *buried = try_vec(were.len(), BURIED)?;
        }
        // One whose sample was another texel's may have been searched, and may have a point of its own now.
        let is_searched = |texel| self.searched[charts.chart_of(map[texel].triangle).index()] != Part::None;
        let has_own = |texel| is_searched(texel) && map.is_of_own(charts, texel);
        for ((is, _), texel) in buried.iter_mut().zip(were).zip(map.all()).filter(|((_, was), _)| **was) {
            *is |= !has_own(texel);
        }
        Ok(())
    }

    /// Returns the former place of a placement whose chart has a former one.
    fn former_place<M: Map>(
        &self,
        old: &ChartMap<M>,
        map: &ChartMap<M>,
        placement: PlacementId,
    ) -> Option<PlacementId> {
        match self.formers[map.layout.chart_of(placement).index()] {
            ChartId::NONE => None,
            former => old.layout.side(former, !map.layout.is_back(placement)),
        }
    }
}

/// Whether a chart of a size has texels on the same sides, in the same places of it, as a former one in an earlier map.
fn are_alike<M: Map>(
    (old, former): (&ChartMap<M>, ChartId),
    (map, chart): (&ChartMap<M>, ChartId),
    size: [f32; 2],
) -> bool {
    [true, false].into_iter().all(|front| match (old.layout.side(former, front), map.layout.side(chart, front)) {
        (None, None) => true,
        (Some(was), Some(is)) => {
            let [there, here] = [&old.layout[was], &map.layout[is]];
            // Of the lower and the upper corner, in texels from the rectangle's.
            let is_placed_alike = [[0.0; 2], size].into_iter().all(|local| {
                let [x, y] = old.layout.texel_coord(was, local);
                let [u, v] = map.layout.texel_coord(is, local);
                let before = Vec2::new(x - f32::from(there.x), y - f32::from(there.y));
                before.distance(Vec2::new(u - f32::from(here.x), v - f32::from(here.y))) <= SAME
            });
            let [before, after] =
                [(old, was), (map, is)].map(|(map, at)| &map.texels.samples[map.texels_of(at).indices()]);
            let is_same =
                |(a, b): (&TexelSample, &TexelSample)| (a.x - there.x, a.y - there.y) == (b.x - here.x, b.y - here.y);
            is_placed_alike && before.len() == after.len() && before.iter().zip(after).all(is_same)
        }
        _ => false,
    })
}

#[cfg(test)]
mod tests {
    use crate::base::progress::Progress;
    use crate::lightmap::atlas::Atlas;
    use crate::lightmap::atlas::charts::tests::grid;
    use crate::lightmap::atlas::ids::{LightTexel, PlacementId};
    use crate::lightmap::{Lightmap, LightmapDesc};
    use crate::scene::demo::shapes::MeshBuilder;
    use crate::scene::{Instance, Light, Material, Mesh, Scene, SceneData};
    use glam::{Affine3A, Quat, Vec3};

    /// A curved ground somewhere in the room.
    fn ground(at: Vec3) -> Mesh {
        let mut mesh = grid(24, 20, |x, y| ((x * 7 + y * 5) % 9) as f32 * 0.1);
        mesh.positions.iter_mut().for_each(|p| *p = 0.04 * *p + at);
        mesh
    }

    /// A room of sheets with a wardrobe that stands on its floor, and curved grounds.
    fn room(grounds: &[Mesh], lamp: Vec3) -> SceneData {
        let mut data = SceneData::new();
        let m = data.add_material(Material { two_sided: true, ..Default::default() }).unwrap();
        let p = Vec3::new;
        for [lower, upper] in [[Vec3::ZERO, p(6.0, 6.0, 3.0)], [p(4.5, 4.5, 0.0), p(5.5, 5.5, 2.0)]] {
            let mut b = MeshBuilder::new();
            b.box_(lower, upper, false, m);
            data.add_mesh(b.finish()).unwrap();
        }
        for mesh in grounds {
            data.add_mesh(mesh.clone()).unwrap();
        }
        data.add_light(Light::Point { position: lamp, intensity: [5.0; 3] }).unwrap();
        data
    }

    fn desc() -> LightmapDesc {
        LightmapDesc { texels_per_unit: 16.0, page_size: 512, ..Default::default() }
    }

    /// Points of the texels of a triangle's chart, and whether they are buried.
    fn shown(atlas: &Atlas, triangle: u32) -> Vec<(Vec3, bool)> {
        let placement = PlacementId::front_of(atlas.charts.chart_of(triangle));
        let texel = |t: LightTexel| (atlas.map[t].position(&atlas.scene), atlas.buried.get(t.index()) == Some(&true));
        atlas.map.texels_of(placement).map(texel).collect()
    }

    #[test]
    fn the_same_scene_has_the_same_atlas_without_search() {
        let grounds = [ground(Vec3::new(1.0, 1.0, 0.5)), ground(Vec3::new(2.5, 3.0, 1.0))];
        let lamp = Vec3::new(3.0, 3.0, 2.5);
        let none = Progress::none();
        let first = Lightmap::create(&room(&grounds, lamp).committed(), &desc(), &none).unwrap();
        let scene = room(&grounds, lamp).committed();
        let again = Lightmap::create_from(&scene, &desc(), &first, &none).unwrap();
        let (a, b) = (&first.atlas, &again.atlas);
        assert!(a.info.buried_texels > 0 && a.buried == b.buried);
        for triangle in 0..scene.triangle_count() {
            assert_eq!(a.charts.corners(triangle), b.charts.corners(triangle));
            assert!(shown(a, triangle) == shown(b, triangle), "{triangle}");
        }
        assert_eq!((b.info.kept_charts, b.info.sight_rays), (b.info.charts, a.seen.rays));
        assert_eq!(a.info.kept_charts, 0);
    }

    #[test]
    fn what_changed_is_made_anew_and_the_rest_is_kept() {
        let [one, two, three] =
            [Vec3::new(1.0, 1.0, 0.0), Vec3::new(2.5, 3.0, 0.5), Vec3::new(4.0, 1.0, 0.01)].map(ground);
        // A third of the triangles is gone.
        let mut less = two.clone();
        less.indices = less.indices[..2 * less.indices.len() / 3].to_vec().into();
        let lamp = Vec3::new(3.0, 3.0, 2.5);
        let none = Progress::none();
        let before = Lightmap::create(&room(&[one.clone(), two], lamp).committed(), &desc(), &none).unwrap();
        let scene = room(&[one, less, three], lamp).committed();
        let whole = Lightmap::create(&scene, &desc(), &none).unwrap();
        let kept = Lightmap::create_from(&scene, &desc(), &before, &none).unwrap();
        let (a, b) = (&whole.atlas, &kept.atlas);
        let is_kept = b.info.kept_charts > 0 && b.info.kept_charts < b.info.charts;
        assert!(is_kept && b.info.sight_rays < a.info.sight_rays, "{:?} {:?}", a.info, b.info);
        // All triangles have charts, and those of what has not changed their former ones.
        let first = scene.first_triangle(2);
        let of_one = scene.first_triangle(3) - first;
        for triangle in 0..scene.triangle_count() {
            let chart = b.charts.find(triangle).expect("a chart");
            assert!(b.charts.triangles_of(chart).any(|t| t == triangle));
            if triangle < first + of_one {
                assert_eq!(b.charts.corners(triangle), before.atlas.charts.corners(triangle));
            }
            if (first..first + of_one).contains(&triangle) {
                // Where charts lie on their pages differs, and so does rounding.
                let [was, is] = [a, b].map(|atlas| shown(atlas, triangle));
                let is_same = |((p, b), (q, c)): (&(Vec3, bool), &(Vec3, bool))| p.distance(*q) < 1e-4 && b == c;
                assert!(was.len() == is.len() && was.iter().zip(&is).all(is_same), "{triangle}");
            }
        }
        // The third ground covers a part of the floor, whose chart is searched there alone.
        let floor = (0..12).find(|&t| scene.corners(t).iter().all(|corner| corner.z == 0.0)).unwrap();
        let buried = |atlas: &Atlas| shown(atlas, floor).iter().filter(|(_, is_buried)| *is_buried).count();
        let [of_before, of_whole, of_kept] = [&before.atlas, a, b].map(|atlas| buried(atlas));
        assert!(of_whole > of_before + 20 && of_kept == of_whole, "{of_before} {of_whole} {of_kept}");
        let searched = [a, b].map(|atlas| atlas.info.sight_rays - atlas.seen.rays);
        assert!(searched[1] < searched[0] / 2, "{searched:?}");
    }

    /// A curved ground and two instances of it, the second twice as large; it shows the light of the first if `shares`.
    fn instances(shares: bool) -> SceneData {
        let mut data = room(&[], Vec3::splat(2.5));
        let mesh = data.add_mesh(ground(Vec3::ZERO)).unwrap();
        for (scale, x) in [(1.0, 1.0), (2.0, 3.0)] {
            let transform =
                Affine3A::from_scale_rotation_translation(Vec3::splat(scale), Quat::IDENTITY, Vec3::new(x, 2.0, 0.3));
            data.add_instance(Instance::new(mesh, transform)).unwrap();
        }
        if shares {
            data.share_light(1, 0).unwrap();
        }
        data
    }

    #[test]
    fn what_showed_the_light_of_another_gets_charts_of_its_own_size() {
        let none = Progress::none();
        let before = Lightmap::create(&instances(true).committed(), &desc(), &none).unwrap();
        let scene = instances(false).committed();
        let whole = Lightmap::create(&scene, &desc(), &none).unwrap();
        let kept = Lightmap::create_from(&scene, &desc(), &before, &none).unwrap();
        let (a, b) = (&whole.atlas, &kept.atlas);
        assert!(b.info.kept_charts > 0 && b.info.kept_charts < b.info.charts);
        for triangle in 0..scene.triangle_count() {
            assert_eq!(a.charts.corners(triangle), b.charts.corners(triangle));
            let [was, is] = [a, b].map(|atlas| shown(atlas, triangle));
            let is_same = |((p, b), (q, c)): (&(Vec3, bool), &(Vec3, bool))| p.distance(*q) < 1e-3 && b == c;
            assert!(was.len() == is.len() && was.iter().zip(&is).all(is_same), "{triangle}");
        }
    }

    #[test]
    fn charts_of_what_grew_since_are_made_anew() {
        let none = Progress::none();
        let mut scene = room(&[ground(Vec3::new(1.0, 1.0, 0.3))], Vec3::splat(2.5)).committed();
        let mut before = Lightmap::create(&scene, &desc(), &none).unwrap();
        let larger: Vec<Vec3> = scene.meshes()[2].positions.iter().map(|&p| 2.0 * p).collect();
        Scene::refit(&mut scene, &[(2, &larger)]).unwrap();
        before.follow(&scene, &none).unwrap();
        let mut mesh = ground(Vec3::new(1.0, 1.0, 0.3));
        mesh.positions.iter_mut().for_each(|p| *p *= 2.0);
        let scene = room(&[mesh], Vec3::splat(2.5)).committed();
        let whole = Lightmap::create(&scene, &desc(), &none).unwrap();
        let kept = Lightmap::create_from(&scene, &desc(), &before, &none).unwrap();
        let (a, b) = (&whole.atlas.charts, &kept.atlas.charts);
        assert!((0..scene.triangle_count()).all(|t| a.corners(t) == b.corners(t)));
    }

    #[test]
    fn under_other_lamps_or_densities_texels_are_searched() {
        let grounds = [ground(Vec3::new(1.0, 1.0, 0.5))];
        let none = Progress::none();
        let first = Lightmap::create(&room(&grounds, Vec3::splat(2.5)).committed(), &desc(), &none).unwrap();
        let finer = LightmapDesc { texels_per_unit: 20.0, ..desc() };
        for (lamp, desc) in [(Vec3::new(1.0, 5.0, 2.0), desc()), (Vec3::splat(2.5), finer)] {
            let scene = room(&grounds, lamp).committed();
            let whole = Lightmap::create(&scene, &desc, &none).unwrap();
            let kept = Lightmap::create_from(&scene, &desc, &first, &none).unwrap();
            let (a, b) = (&whole.atlas, &kept.atlas);
            assert_eq!((b.info.kept_charts, b.info.sight_rays), (0, a.info.sight_rays));
            for triangle in 0..scene.triangle_count() {
                assert!(shown(a, triangle) == shown(b, triangle), "{triangle}");
            }
        }
    }
}
