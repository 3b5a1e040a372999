//! Ledges: narrow strips of a surface that goes on behind an outer wall, as the floor of a model whose walls are sheets ends a
//! few centimetres outside of them.
//!
//! The texel at the foot of such a wall is filtered into the room even if its centre lies behind the wall, and the sun
//! that shines on the ledge would be a bright line along the wall. Hardly anybody looks at a ledge, so its texel beside the
//! wall takes the light of the nearest one in the room, as buried texels do.
//!
//! A ledge ends: what ends at another wall is a gap, and what is as wide as a terrace is looked at. Both sides of the wall are
//! seen: behind one whose other side nobody sees it is dark, and what little is seen of the strip shows that. Of two walls, one
//! behind the other, the outer one is found.
//!
//! Measured: docs/experiments.md#ledges-behind-walls.

use super::{BLOCK, BURIED, Only, PointTests, Search};
use crate::base::error::Result;
use crate::base::memory::try_push;
use crate::base::progress::Stage;
use crate::direct::Receiver;
use crate::lightmap::atlas::chart_map::ChartMap;
use crate::lightmap::atlas::ids::{Map, PlacementId, TexelId};
use crate::trace::{RawHit, Ray};
use glam::Vec3;

/// Maximum width of a ledge in texels.
const WIDTH: i32 = 3;

/// Minimum width of the surface on the other side of the wall, in texels.
const ROOM: i32 = 6;

/// Maximum thickness of the wall, in texels below it.
const WALL: i32 = 3;

/// Height of lines of sight above the surface, in widths of a texel.
const ABOVE: f32 = 0.25;

/// Distance from the centre of the last texel, in widths of a texel, at which the surface has ended.
const BEYOND: f32 = 1.25;

/// A wall is at least so long that the ledge behind it has this many other texels up to [`ASIDE`] away. (A post beside the edge
/// of a balcony is none.)
const OTHERS: usize = 2;
const ASIDE: i32 = 2;

/// Texels farther away than this do not tell whether a texel lies on a ledge, in widths of a texel.
pub(super) const REACH: f32 = (WIDTH + WALL + 1) as f32;

/// Directions in a map.
const DIRECTIONS: [(i32, i32); 4] = [(1, 0), (-1, 0), (0, 1), (0, -1)];

/// A texel of a ledge beside a wall.
#[derive(Clone, Copy)]
struct Ledge<M: Map> {
    texel: TexelId<M>,
    /// The nearest texel on the other side of the wall.
    inner: TexelId<M>,
    /// Direction from there to the ledge.
    outwards: (i32, i32),
}

/// The last texel of a placement in some direction.
struct End<M: Map> {
    texel: TexelId<M>,
    outwards: (i32, i32),
    /// Its receiver, and that of the texel [`WIDTH`] before it.
    receivers: [Receiver; 2],
}

/// The strips at the ends of a placement.
struct Strips<'a, M: Map> {
    search: &'a Search<'a>,
    map: &'a ChartMap<M>,
    placement: PlacementId,
    back: bool,
    /// Of those that are searched, ascending.
    buried: &'a [TexelId<M>],
    /// Whether the others have the samples that they are to have.
    is_in_part: bool,
    /// Of lines of sight.
    height: f32,
}

impl<M: Map> Strips<'_, M> {
    /// Returns the texel some steps away, if the placement has one there.
    fn beside(&self, texel: TexelId<M>, (dx, dy): (i32, i32), steps: i32) -> Option<TexelId<M>> {
        let [found] = self.map.around(self.placement, texel, [(steps * dx, steps * dy)]);
        found
    }

    fn is_buried(&self, texel: TexelId<M>) -> bool {
        self.buried.binary_search(&texel).is_ok() || self.is_known(texel)
    }

    /// Whether a texel was buried or on a ledge before the change, and is not near it.
    fn is_known(&self, texel: TexelId<M>) -> bool {
        self.is_in_part && !self.map.is_of_own(self.search.charts, texel)
    }

    fn receiver(&self, texel: TexelId<M>) -> Receiver {
        self.map.receiver(self.search.scene, texel, self.back).1
    }

    fn raised(&self, receiver: &Receiver) -> Vec3 {
        receiver.origin + self.height * receiver.geometric
    }

    /// Returns the line of sight from one point of the surface to another, which ends at a distance of 1.
    fn sight(&self, from: &Receiver, to: &Receiver) -> Ray {
        let [from, to] = [from, to].map(|receiver| self.raised(receiver));
        Ray::new(from, to - from).within(0.0, 1.0)
    }

    fn is_blocked(&self, ray: &Ray, rays: &mut u64) -> bool {
        *rays += 1;
        self.search.scene.occluded(ray)
    }

    /// Whether a surface is no pane, and both of its sides are seen from open places, about as often: it parts a room from what is
    /// outside, or from another room, and not from the inside of a chest or of a hollow wall.
    fn is_between_rooms(&self, hit: &RawHit) -> bool {
        let Search { charts, seen, .. } = self.search;
        let chart = charts.chart_of(hit.triangle);
        let is_seen = |counts: &[u32; 2]| counts.iter().all(|&n| n > 0) && seen.shows_back(chart).is_none();
        seen.counts.get(chart.index()).is_none_or(is_seen) && !self.search.scene.material(hit.triangle).transmits()
    }

    /// Returns the texel some steps inwards from the end of a strip and the nearest one that is not buried behind it, if there is
    /// a wall between them.
    fn beside_wall(&self, end: &End<M>, steps: i32, rays: &mut u64) -> Option<(TexelId<M>, TexelId<M>)> {
        let texel = self.beside(end.texel, end.outwards, -steps).filter(|&texel| !self.is_buried(texel))?;
        let mut inwards = (1..=1 + WALL).filter_map(|i| self.beside(texel, end.outwards, -i));
        let inner = inwards.find(|&found| !self.is_buried(found))?;
        self.beside(inner, end.outwards, -ROOM)?;
        let [outside, inside] = [texel, inner].map(|texel| self.receiver(texel));
        let wall = self.search.scene.intersect_raw(&self.sight(&outside, &inside));
        *rays += 1;
        (!wall.is_miss() && self.is_between_rooms(&wall)).then_some((texel, inner))
    }

    /// Returns the ledge that ends at a texel, given after which part of the way inwards something blocks the sight.
    fn ledge(&self, end: &End<M>, part: f32, rays: &mut u64) -> Option<Ledge<M>> {
        // Samples of texels that the end of the chart cuts are not in their middle, so that it may be a step more.
        let steps = (part * WIDTH as f32) as i32;
        let (texel, inner) = (steps..WIDTH.min(steps + 2)).find_map(|steps| self.beside_wall(end, steps, rays))?;
        let [last, before] = end.receivers.each_ref().map(|receiver| self.raised(receiver));
        let beyond = BEYOND / WIDTH as f32 * (last - before);
        let is_gap = self.is_blocked(&Ray::new(last, beyond).within(0.0, 1.0), rays);
        let down = -2.0 * self.height * end.receivers[0].geometric;
        let goes_on = is_gap || self.is_blocked(&Ray::new(last + beyond, down).within(0.0, 1.0), rays);
        (!goes_on).then_some(Ledge { texel, inner, outwards: end.outwards })
    }
}

impl Search<'_> {
    /// Returns the texels of a placement that lie on ledges beside walls, each with the texel whose light it takes, of all or of
    /// those `near` what has changed. `buried`: those that nobody can see, ascending. Adds the number of rays to `rays`.
    pub(super) fn find_ledges<M: Map>(
        &self,
        map: &ChartMap<M>,
        placement: PlacementId,
        back: bool,
        near: Option<Only>,
        buried: &[TexelId<M>],
        tests: &mut PointTests,
        rays: &mut u64,
        stage: &Stage,
    ) -> Result<Vec<(TexelId<M>, TexelId<M>)>> {
        let [x, y] = map.layout[placement].scale;
        let is_in_part = near.is_some();
        let strips = Strips { search: self, map, placement, back, buried, is_in_part, height: ABOVE / x.min(y) };
        let mut found: Vec<Ledge<M>> = Vec::new();
        let mut ends: Vec<End<M>> = Vec::new();
        let texels = map.texels_of(placement);
        let mut all = texels.flat_map(|texel| DIRECTIONS.map(|outwards| (texel, outwards)));
        loop {
            stage.check()?;
            ends.clear();
            for (texel, outwards) in all.by_ref() {
                if strips.beside(texel, outwards, 1).is_some() {
                    continue;
                }
                let Some(before) = strips.beside(texel, outwards, -WIDTH) else { continue };
                if strips.is_known(texel) || strips.is_known(before) {
                    continue;
                }
                let receivers = [texel, before].map(|texel| strips.receiver(texel));
                try_push(&mut ends, End { texel, outwards, receivers }, BURIED)?;
                if ends.len() == BLOCK {
                    break;
                }
            }
            if ends.is_empty() {
                break;
            }
            tests.probes.clear();
            tests.probes.extend(ends.iter().map(|end| strips.sight(&end.receivers[0], &end.receivers[1])));
            self.scene.intersect_stream(&tests.probes, &mut tests.hits);
            *rays += ends.len() as u64;
            for (end, hit) in ends.iter().zip(&tests.hits).filter(|(_, hit)| !hit.is_miss()) {
                if let Some(ledge) = strips.ledge(end, hit.t, rays) {
                    try_push(&mut found, ledge, BURIED)?;
                }
            }
        }
        found.sort_unstable_by_key(|ledge| (ledge.texel, ledge.inner, ledge.outwards));
        found.dedup_by_key(|ledge| ledge.texel);
        let find = |texel: TexelId<M>| Some(&found[found.binary_search_by_key(&texel, |ledge| ledge.texel).ok()?]);
        let mut moved = Vec::new();
        for ledge in &found {
            let window = (-ASIDE..=ASIDE).flat_map(|dy| (-ASIDE..=ASIDE).map(move |dx| (dx, dy)));
            let around = window.filter_map(|offset| strips.beside(ledge.texel, offset, 1));
            if around.filter(|&texel| find(texel).is_some() || strips.is_known(texel)).count() <= OTHERS {
                continue;
            }
            // Behind two walls that cross, the nearest texel on the other side of one is on a ledge behind the other.
            let inner = find(ledge.inner).map_or(ledge.inner, |next| next.inner);
            if find(inner).is_some() {
                continue;
            }
            try_push(&mut moved, (ledge.texel, inner), BURIED)?;
            // Where two ledges meet, the corner is behind both walls.
            let (dx, dy) = ledge.outwards;
            for aside in [(dy, dx), (-dy, -dx)] {
                let Some(corner) = strips.beside(ledge.texel, aside, 1) else { continue };
                let other = strips.beside(corner, ledge.outwards, -1).and_then(find).map(|other| other.outwards);
                if other == Some(aside) && find(corner).is_none() && !strips.is_buried(corner) {
                    try_push(&mut moved, (corner, inner), BURIED)?;
                }
            }
        }
        moved.retain(|(texel, _)| near.is_none_or(|only| only.is_near(self.scene, &map[*texel])));
        moved.sort_unstable();
        moved.dedup_by_key(|(texel, _)| *texel);
        Ok(moved)
    }
}

#[cfg(test)]
mod tests {
    use crate::base::progress::Progress;
    use crate::lightmap::atlas::ids::PlacementId;
    use crate::lightmap::{BakeParams, Layer, Lightmap, LightmapDesc};
    use crate::scene::demo::shapes::MeshBuilder;
    use crate::scene::{Light, Material, Scene, SceneData};
    use glam::{Mat2, Vec2, Vec3};

    /// The inside of a house.
    const SIZE: Vec3 = Vec3::new(2.0, 1.0, 1.5);

    /// A light map of a floor in the sun that has a margin around the place of a house, of boxes on it, each by two corners, and of
    /// rectangles, each by a corner and two edges.
    fn floor(margin: f32, boxes: &[[Vec3; 2]], rectangles: &[[Vec3; 3]], texels_per_unit: f32) -> Lightmap {
        let mut data = SceneData::new();
        let m = data.add_material(Material { albedo: [0.7; 3], two_sided: true, ..Default::default() }).unwrap();
        let size = SIZE + 2.0 * Vec3::splat(margin);
        let floor = [[Vec3::new(-margin, 0.0, -margin), size.z * Vec3::Z, size.x * Vec3::X]];
        for &[at, u, v] in floor.iter().chain(rectangles) {
            let mut builder = MeshBuilder::new();
            builder.quad(at, at + u, at + u + v, at + v, m);
            data.add_mesh(builder.finish()).unwrap();
        }
        for &[lower, upper] in boxes {
            let mut builder = MeshBuilder::new();
            builder.box_(lower, upper, true, m);
            data.add_mesh(builder.finish()).unwrap();
        }
        let direction = Vec3::new(0.3, -1.0, 0.2).normalize();
        data.add_light(Light::Directional { direction, irradiance: [10.0; 3], angular_radius: 0.0 }).unwrap();
        // Or the house would not be open.
        data.add_light(Light::Point { position: 0.5 * SIZE, intensity: [1e-6; 3] }).unwrap();
        let desc = LightmapDesc { texels_per_unit, ..Default::default() };
        Lightmap::create(&data.committed(), &desc, &Progress::none()).unwrap()
    }

    /// A house of sheets, slightly off the grid of texels, on a floor that goes on behind its walls.
    fn house(ledge: f32, rectangles: &[[Vec3; 3]], texels_per_unit: f32) -> Lightmap {
        floor(
            ledge,
            &[[Vec3::new(0.003, -0.01, 0.004), SIZE - Vec3::new(0.004, 0.0, 0.003)]],
            rectangles,
            texels_per_unit,
        )
    }

    /// Returns the direct light that is shown on the floor along two walls, `inside` of them.
    fn along_walls(lightmap: &Lightmap, inside: f32) -> Vec<f32> {
        let scene = &lightmap.atlas().scene;
        let light = |at: Vec2| {
            let on_triangle = (0..2).find_map(|t| {
                let [a, b, c] = scene.corners(t).map(|p| Vec2::new(p.x, p.z));
                let w = Mat2::from_cols(b - a, c - a).inverse() * (at - a);
                (w.min_element() > -1e-3 && w.x + w.y < 1.001).then_some((t, w))
            });
            let (triangle, w) = on_triangle.unwrap();
            lightmap.sample(Layer::Direct, triangle, true, w.x, w.y)[0]
        };
        let steps = || (0..50).map(|i| 0.02 * i as f32 + 0.01);
        let along_x = steps().map(|s| Vec2::new(s * SIZE.x, 0.004 + inside));
        along_x.chain(steps().map(|s| Vec2::new(SIZE.x - 0.004 - inside, s * SIZE.z))).map(light).collect()
    }

    #[test]
    fn the_sun_on_a_ledge_is_not_filtered_into_the_room() {
        for (ledge, texels_per_unit) in [(0.03, 20.0), (0.07, 20.0), (0.12, 20.0), (0.07, 10.0), (0.07, 33.0)] {
            let mut lightmap = house(ledge, &[], texels_per_unit);
            lightmap.bake(&BakeParams { gather_rays: 0, ..Default::default() }, &Progress::none()).unwrap();
            for inside in [0.005, 0.02, 0.04] {
                let brightest = along_walls(&lightmap, inside).into_iter().fold(0.0, f32::max);
                // The sun has 9.4 on the floor.
                assert!(brightest < 1e-3, "{brightest} {inside} {ledge} {texels_per_unit}");
            }
            // What is two texels away from the wall shows its own light.
            if ledge > 2.5 / texels_per_unit {
                let outside = along_walls(&lightmap, -0.95 * ledge);
                assert!(outside.iter().filter(|&&light| light > 5.0).count() > outside.len() / 2, "{outside:?}");
            }
        }
    }

    /// Returns where the samples of the floor's texels are, and which texels are buried. (Other charts may be laid out otherwise.)
    fn of_floor(lightmap: &Lightmap) -> Vec<(u32, [f32; 2], bool)> {
        let atlas = lightmap.atlas();
        let floor = PlacementId::front_of(atlas.charts.chart_of(0));
        let of_texel = |s| (atlas.map[s].triangle, [atlas.map[s].u, atlas.map[s].v], atlas.buried[s.index()]);
        atlas.map.texels_of(floor).map(of_texel).collect()
    }

    /// Returns the number of texels of the floor on ledges.
    fn counted(lightmap: &Lightmap) -> usize {
        let atlas = lightmap.atlas();
        let is_floor = |s| atlas.map[s].triangle < 2 && !atlas.map.is_back(s);
        atlas.map.all().filter(|&s| is_floor(s) && atlas.buried.get(s.index()) == Some(&true)).count()
    }

    #[test]
    fn terraces_gaps_and_floors_that_go_on_are_no_ledges() {
        let all = counted(&house(0.07, &[], 20.0));
        // 7 m of walls.
        assert!((130..=160).contains(&all), "{all}");
        assert_eq!(counted(&house(0.5, &[], 20.0)), 0);
        let (long, along_x) = (1.0, SIZE.x + 0.14);
        let corner = Vec3::new(-0.07, 0.0, -0.07);
        let wall = [corner, along_x * Vec3::X, long * Vec3::Y];
        let more_floor = [corner - long * Vec3::Z, along_x * Vec3::X, long * Vec3::Z];
        for one_side in [wall, more_floor] {
            // One of the long sides has 40 texels.
            let rest = counted(&house(0.07, &[one_side], 20.0));
            assert!((90..=115).contains(&rest), "{rest} of {all}");
        }
    }

    /// Sheets, whose both sides are seen.
    #[test]
    fn posts_make_no_ledges() {
        let sheet = |x: f32, width: f32| [Vec3::new(x, 0.0, -0.03), width * Vec3::X, 0.9 * Vec3::Y];
        let posts: [[Vec3; 3]; 5] = std::array::from_fn(|i| sheet(0.2 + 0.3 * i as f32, 0.04));
        let on_ledges = |sheets: &[[Vec3; 3]]| counted(&floor(0.1, &[], sheets, 20.0));
        assert_eq!(on_ledges(&posts), 0);
        // A wall does.
        let behind_wall = on_ledges(&[sheet(0.2, 1.3)]);
        assert!((20..30).contains(&behind_wall), "{behind_wall}");
    }

    #[test]
    fn ledges_are_found_again_where_something_has_moved() {
        let none = Progress::none();
        let chest = [Vec3::new(1.5, 0.2, 0.05), 0.3 * Vec3::X, 0.3 * Vec3::Y];
        let mut lightmap = house(0.07, &[chest], 20.0);
        let mut scene = lightmap.atlas().scene.clone();
        for by in [Vec3::new(-0.9, 0.1, 0.6), Vec3::new(0.8, -0.2, -0.65)] {
            let moved: Vec<Vec3> = scene.meshes()[1].positions.iter().map(|&p| p + by).collect();
            Scene::refit(&mut scene, &[(1, &moved)]).unwrap();
            lightmap.follow(&scene, &none).unwrap();
            let fresh = Lightmap::create(&scene, &lightmap.atlas().desc.clone(), &none).unwrap();
            assert!(of_floor(&fresh) == of_floor(&lightmap));
            // As if all was described anew.
            let taken_over = Lightmap::create_from(&scene, &lightmap.atlas().desc.clone(), &lightmap, &none).unwrap();
            assert!(of_floor(&fresh) == of_floor(&taken_over));
        }
    }
}
