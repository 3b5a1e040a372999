//! Chooses the side of two-sided charts that the light map shows.
//!
//! A texel holds the light of one side. In modelled scenes, many two-sided surfaces have fronts that nobody can see:
//! ceilings that face the roof, sofas turned inside out. Charts whose sides can both be seen from [open
//! places](super::seen) have separate texels for each. The others show the side that can be seen. If that is not known,
//! or if both sides can be seen and share texels, the choice is the side with the longer view, as from inside a room
//! rather than from inside its furniture or from the void around, and with more light.
//!
//! Measured, with this rule and with others: docs/experiments.md#which-side-is-shown.
//!
//! A side that can be seen loses if it is in full darkness and the other one, which may be seen too, is lit: the inside
//! of a sofa, seen from within, would show as black strips at its seams. (Living room: 15 charts that few rays see from
//! outside, and the ring of a teapot's lid, too small to have been seen.)
//!
//! Before views are compared, a side that other surfaces cover loses to one that is not covered, however bright it is,
//! since light leaks between layers of cloth.
//!
//! The front of a surface in the open is kept if it is clearly brighter than the back: some light gets into a hollow
//! body through its openings. Where a sun or a sky shines, this holds unless one side is clearly seen more: the sun on the
//! upper side of a ceiling is no reason to show that.

use super::Atlas;
use super::chart_map::ChartMap;
use super::ids::{ChartId, PlacementId, RadianceMap, RadianceTexel};
use super::seen::Seen;
use crate::base::error::Result;
use crate::base::memory::{try_collect, try_par_collect};
use crate::base::parallel::one_by_one;
use crate::base::progress::Progress;
use crate::base::sampling::{cosine_around, sobol_2d};
use crate::scene::Scene;
use crate::trace::{RawHit, Ray};
use glam::Vec3;
use rayon::prelude::*;

/// Factor by which the back must be better than the front to be shown, if both sides are covered or neither is. The
/// measure is the length of the view times the cube root of the light: the factor is reached by a view twice as long,
/// or by light eight times as bright. The front is preferred between similar sides: users expect it, and it does not
/// change when a light moves a little.
const BETTER: f64 = 2.0;

/// A front in the open that gets more than this many times the light of its back is shown, however long the view from
/// the back is.
const BRIGHTER: f64 = 4.0;

/// A side is in the open if at least this fraction of its rays hit nothing.
const OPEN: f64 = 0.5;

/// Maximum length of a view, as a fraction of the scene's diagonal; longer ones count as this long.
const FAR: f32 = 0.3;

/// Length of a view in which a ray hits nothing, as a fraction of [`FAR`].
const VOID: f32 = 0.05;

/// Fraction of the rays from open places that may end on sides that are not shown, to save texels.
const MISSING: f64 = 0.003;

/// A side is covered by other surfaces if the mean length of its views is less than this fraction of [`FAR`].
const SOMETHING: f32 = 0.1;

/// Maximum number of points per side of a chart from which rays start, and number of rays from each.
const PLACES: usize = 64;
const RAYS: usize = 4;

/// Decides for each chart without separate texels for its back whether the back is baked; empty if no chart has a back.
/// `light` returns how much light a texel of the radiance map gets (any unit). To be called on the device's threads.
/// Its time is part of the whole bake's; its rays are not counted in any stage.
pub(crate) fn backs(
    atlas: &Atlas,
    light: impl Fn(RadianceTexel) -> f32 + Sync,
    progress: &Progress,
) -> Result<Vec<bool>> {
    let (scene, radiance) = (&atlas.scene, &atlas.radiance);
    if radiance.layout.back_of.is_empty() {
        return Ok(Vec::new());
    }
    let lit = |placement: PlacementId| {
        let texels = radiance.texels_of(placement);
        let n = texels.len().max(1) as f64;
        texels.map(|s| light(s) as f64).sum::<f64>() / n
    };
    let is_back = |chart: ChartId| {
        // The result is discarded after a cancel.
        if progress.is_cancelled() {
            return false;
        }
        let Some(back) = radiance.layout.back(chart).filter(|_| atlas.map.layout.back(chart).is_none()) else {
            return false;
        };
        let front = PlacementId::front_of(chart);
        let [of_front, of_back] = [front, back].map(|placement| view(scene, radiance, placement));
        // Rays that were counted start in the open only if a sun or a sky shines.
        if !(atlas.is_outdoors && atlas.seen.shows_back(chart).is_some()) {
            if of_front.is_in_the_open() && lit(front) > BRIGHTER * lit(back) {
                return false;
            }
            if of_back.is_in_the_open() && lit(back) > BRIGHTER * BETTER * lit(front) {
                return true;
            }
        }
        if let Some(is_back) = atlas.seen.shows_back(chart) {
            let [shown, other] = if is_back { [back, front] } else { [front, back] };
            let may_be_seen =
                atlas.seen.counts[chart.index()].iter().all(|&n| n > 0) || !atlas.seen.is_hidden(chart, is_back);
            let is_dark = may_be_seen && lit(shown) == 0.0 && lit(other) > 0.0;
            return is_back != is_dark;
        }
        if of_front.is_covered(scene) != of_back.is_covered(scene) {
            return of_front.is_covered(scene);
        }
        of_back.distance * lit(back).cbrt() > BETTER * of_front.distance * lit(front).cbrt()
    };
    let charts = (0..atlas.charts.charts.len()).into_par_iter();
    let backs = try_par_collect(one_by_one(charts.map(|chart| is_back(ChartId::new(chart)))), "the sides of charts")?;
    progress.check()?;
    Ok(backs)
}

/// Returns those of the given two-sided charts whose sides can both be seen, ascending. Of charts of which one side is seen
/// [clearly](Seen::shows_back) more, those that gain least per texel are left out as long as at most [`MISSING`] of all rays from
/// open places end on sides that are not shown. (Around a house on a wide ground most rays end on the ground, and the ceilings of
/// its rooms get less than that: docs/experiments.md#which-side-is-shown.)
pub(crate) fn seen_from_both(
    seen: &Seen,
    radiance: &ChartMap<RadianceMap>,
    charts: &[ChartId],
) -> Result<Vec<ChartId>> {
    let missing = |chart: ChartId| seen.counts[chart.index()].into_iter().min().unwrap_or(0);
    let mut both = try_collect(charts.iter().copied().filter(|&chart| missing(chart) > 0), BOTH)?;
    let texels = |chart| radiance.texels_of(PlacementId::front_of(chart)).len().max(1);
    let per_texel = |chart: ChartId| f64::from(missing(chart)) / texels(chart) as f64;
    both.sort_unstable_by(|&a, &b| per_texel(a).total_cmp(&per_texel(b)).then(a.cmp(&b)));
    let all: u64 = seen.counts.iter().flatten().map(|&n| u64::from(n)).sum();
    // `None`: the rays are used up, and all other charts keep both sides.
    let mut left = Some((MISSING * all as f64) as u64);
    both.retain(|&chart| {
        if seen.shows_back(chart).is_none() {
            return true;
        }
        left = left.and_then(|rays| rays.checked_sub(missing(chart).into()));
        left.is_none()
    });
    both.sort_unstable();
    Ok(both)
}

const BOTH: &str = "the charts of which both sides are seen";

/// Returns the mean length of views below which a side is covered.
fn something(scene: &Scene) -> f64 {
    f64::from(SOMETHING * FAR * scene.diagonal())
}

/// The view from a side.
struct View {
    /// Mean length in scene units; [`VOID`] of the maximum for rays that hit nothing.
    distance: f64,
    /// Fraction of the rays that hit nothing.
    void: f64,
}

impl View {
    fn is_in_the_open(&self) -> bool {
        self.void >= OPEN
    }

    /// Whether other surfaces are close on all sides.
    fn is_covered(&self, scene: &Scene) -> bool {
        self.distance + self.void * f64::from((1.0 - VOID) * FAR * scene.diagonal()) < something(scene)
    }
}

fn view(scene: &Scene, radiance: &ChartMap<RadianceMap>, placement: PlacementId) -> View {
    let far = FAR * scene.diagonal();
    let texels = radiance.texels_of(placement);
    let step = texels.len().div_ceil(PLACES).max(1);
    let places = texels.step_by(step);
    let mut rays = [Ray::new(Vec3::ZERO, Vec3::ZERO); PLACES * RAYS];
    let mut hits = [RawHit::MISS; PLACES * RAYS];
    let rays = &mut rays[..places.len() * RAYS];
    for (texel, rays) in places.zip(rays.chunks_mut(RAYS)) {
        let (_, receiver) = radiance.receiver(scene, texel, radiance.is_back(texel));
        let seed = radiance.seed_in(placement, texel);
        for (i, ray) in (0..).zip(rays) {
            *ray = Ray::new(receiver.origin, cosine_around(receiver.geometric, sobol_2d(i, seed)));
        }
    }
    scene.intersect_stream(rays, &mut hits);
    let count = rays.len().max(RAYS) as f64;
    let mut view = View { distance: 0.0, void: 0.0 };
    for hit in &hits[..rays.len()] {
        view.distance += f64::from(if hit.is_miss() { VOID * far } else { hit.t.min(far) }) / count;
        view.void += f64::from(u8::from(hit.is_miss())) / count;
    }
    view
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lightmap::{Lightmap, LightmapDesc};
    use crate::scene::demo::shapes::MeshBuilder;
    use crate::scene::{Light, Material, NONE, SceneData};
    use glam::Vec3;
    use std::sync::Arc;

    /// A scene to be, and its two-sided material.
    fn two_sided() -> (SceneData, u32) {
        let mut data = SceneData::new();
        let m = data.add_material(Material { two_sided: true, ..Default::default() }).unwrap();
        (data, m)
    }

    fn lightmap(data: SceneData, both_sides: bool) -> Lightmap {
        let desc = LightmapDesc { texels_per_unit: 8.0, both_sides, ..Default::default() };
        Lightmap::create(&data.committed(), &desc, &Progress::none()).unwrap()
    }

    /// Sides of a room that faces inwards or outwards and of a box in it that faces outwards or inwards, each a mesh.
    /// `lights` is said to fall on outer and inner sides.
    fn backs_of(room_inward: bool, box_inward: bool, lights: [f32; 2]) -> Vec<bool> {
        let (mut data, m) = two_sided();
        for (size, inward) in [(2.0, room_inward), (0.4, box_inward)] {
            let mut builder = MeshBuilder::new();
            builder.box_(Vec3::splat(-size), Vec3::splat(size), inward, m);
            data.add_mesh(builder.finish()).unwrap();
        }
        data.add_light(Light::Point { position: Vec3::splat(1.0), intensity: [1.0; 3] }).unwrap();
        let lightmap = lightmap(data, false);
        let atlas = lightmap.atlas();
        let light = |s: RadianceTexel| {
            let (point, receiver) = atlas.radiance.receiver(&atlas.scene, s, atlas.radiance.is_back(s));
            let inwards = receiver.geometric.dot(point.position) < 0.0;
            lights[usize::from(inwards)]
        };
        let of_chart = backs(atlas, light, &Progress::none()).unwrap();
        // The first triangles of the room and of the box.
        [0, 12].map(|t| of_chart[atlas.charts.chart_of(t).index()]).to_vec()
    }

    #[test]
    fn rooms_show_their_inside_and_boxes_their_outside() {
        for lights in [[1.0, 1.0], [1.0, 0.5], [0.5, 1.0]] {
            assert_eq!(backs_of(true, false, lights), [false, false], "{lights:?}");
            assert_eq!(backs_of(false, false, lights), [true, false], "{lights:?}");
            assert_eq!(backs_of(true, true, lights), [false, true], "{lights:?}");
        }
    }

    /// Whether a wall between two rooms shows its back, which may be covered by another `layer`, if so much light falls
    /// on its front and its back.
    fn wall_shows_back(layer: bool, front: f32, back: f32) -> bool {
        let (mut data, m) = two_sided();
        let p = |x: f32, y: f32| Vec3::new(x, y, 0.0);
        let mut builder = MeshBuilder::new();
        // The wall between them, whose front faces +z.
        builder.quad(p(-1.0, -1.0), p(1.0, -1.0), p(1.0, 1.0), p(-1.0, 1.0), m);
        builder.box_(Vec3::new(-1.0, -1.0, -2.0), Vec3::new(1.0, 1.0, 2.0), true, m);
        if layer {
            let p = |x: f32, y: f32| Vec3::new(x, y, -0.02);
            builder.quad(p(-1.0, -1.0), p(1.0, -1.0), p(1.0, 1.0), p(-1.0, 1.0), m);
        }
        data.add_mesh(builder.finish()).unwrap();
        for position in [Vec3::Z, Vec3::NEG_Z] {
            data.add_light(Light::Point { position, intensity: [1.0; 3] }).unwrap();
        }
        let lightmap = lightmap(data, false);
        let atlas = lightmap.atlas();
        let light = |s: RadianceTexel| if atlas.radiance.is_back(s) { back } else { front };
        backs(atlas, light, &Progress::none()).unwrap()[atlas.charts.chart_of(0).index()]
    }

    /// Whether charts of hollow things in the open, with fronts outside or inside, show their backs.
    fn hollow_thing_shows_back(inward: bool, lights: [f32; 2]) -> bool {
        let (mut data, m) = two_sided();
        let mut builder = MeshBuilder::new();
        builder.box_(Vec3::splat(-1.0), Vec3::splat(1.0), inward, m);
        data.add_mesh(builder.finish()).unwrap();
        let lightmap = lightmap(data, false);
        let atlas = lightmap.atlas();
        let is_outer = |s: RadianceTexel| atlas.radiance.is_back(s) == inward;
        backs(atlas, |s| lights[usize::from(!is_outer(s))], &Progress::none()).unwrap()[0]
    }

    #[test]
    fn hollow_things_in_the_open_show_their_lit_outside_and_rooms_in_it_their_lit_inside() {
        // Light outside, light inside; whether the outside is the front, and whether the back is to be seen.
        let cases = [
            ([1.0, 0.0], false, false),
            ([1.0, 0.2], false, false),
            ([1.0, 0.3], false, true),
            ([1.0, 1.0], false, true),
            ([0.0, 1.0], false, true),
            ([1.0, 0.0], true, true),
            ([1.0, 0.2], true, false),
            ([1.0, 1.0], true, false),
        ];
        for (lights, inward, expected) in cases {
            assert_eq!(hollow_thing_shows_back(inward, lights), expected, "{lights:?}, fronts inwards: {inward}");
        }
    }

    #[test]
    fn of_two_like_rooms_the_one_that_is_lit_is_shown() {
        let shown = [0.0, 1.0, 7.0, 9.0].map(|back| wall_shows_back(false, 1.0, back));
        assert_eq!(shown, [false, false, false, true]);
    }

    /// A box in a room whose inside is seen far more often than its outside, or alone.
    #[test]
    fn a_dark_side_loses_to_a_lit_one_unless_that_is_hidden() {
        let (mut data, m) = two_sided();
        for size in [2.0, 0.4] {
            let mut builder = MeshBuilder::new();
            builder.box_(Vec3::splat(-size), Vec3::splat(size), false, m);
            data.add_mesh(builder.finish()).unwrap();
        }
        data.add_light(Light::Point { position: Vec3::splat(1.0), intensity: [1.0; 3] }).unwrap();
        let mut lightmap = lightmap(data, false);
        let chart = lightmap.atlas().charts.chart_of(12);
        let mut shown = |counts: [u32; 2], hidden: [bool; 2], lights: [f32; 2]| {
            let atlas = Arc::get_mut(&mut lightmap.atlas).unwrap();
            let seen = Arc::get_mut(&mut atlas.seen).unwrap();
            (seen.counts[chart.index()], seen.hidden[chart.index()]) = (counts, hidden);
            let light = |s| lights[usize::from(lightmap.atlas.radiance.is_back(s))];
            backs(&lightmap.atlas, light, &Progress::none()).unwrap()[chart.index()]
        };
        let (seen, front_hidden) = ([false; 2], [true, false]);
        assert!(shown([3, 200], seen, [1.0, 0.01]) && shown([0, 200], front_hidden, [1.0, 0.0]));
        assert!(!shown([3, 200], front_hidden, [1.0, 0.0]) && !shown([0, 200], seen, [1.0, 0.0]));
        assert!(shown([200, 3], seen, [0.0, 1.0]) && !shown([200, 3], seen, [0.0, 0.0]));
    }

    /// The ceiling of a house without a roof, seen far more often from inside.
    #[test]
    fn the_sun_does_not_turn_a_ceiling_over_unless_it_is_seen_from_above() {
        let (mut data, m) = two_sided();
        let mut builder = MeshBuilder::new();
        builder.box_(Vec3::splat(-1.0), Vec3::splat(1.0), true, m);
        data.add_mesh(builder.finish()).unwrap();
        data.add_light(Light::Directional { direction: Vec3::NEG_Y, irradiance: [1.0; 3], angular_radius: 0.0 })
            .unwrap();
        let mut lightmap = lightmap(data, false);
        let mut shows_back = |counts: [u32; 2]| {
            let atlas = Arc::get_mut(&mut lightmap.atlas).unwrap();
            let seen = Arc::get_mut(&mut atlas.seen).unwrap();
            seen.counts.iter_mut().for_each(|of_chart| *of_chart = counts);
            let light = |s| if lightmap.atlas.radiance.is_back(s) { 9.0 } else { 1.0 };
            let backs = backs(&lightmap.atlas, light, &Progress::none()).unwrap();
            assert!(backs.iter().all(|&back| back == backs[0]));
            backs[0]
        };
        assert_eq!([[200, 3], [200, 30], [3, 200]].map(&mut shows_back), [false, true, true]);
    }

    #[test]
    fn a_side_that_is_covered_loses_however_bright_it_is() {
        assert!(!wall_shows_back(true, 1.0, 1e6));
    }

    /// The charts with two places of a box in the open, with `light`, in which a lamp is switched off; it stands on a square ground
    /// of that width (0: none).
    fn both_sided_of_a_house(light: Light, ground: f32) -> u32 {
        let (mut data, m) = two_sided();
        let mut builder = MeshBuilder::new();
        builder.box_(Vec3::splat(-1.0), Vec3::splat(1.0), false, m);
        if ground > 0.0 {
            let p = |x: f32, z: f32| Vec3::new(0.5 * ground * x, -1.2, 0.5 * ground * z);
            let ground = data.add_material(Material::default()).unwrap();
            builder.quad(p(-1.0, -1.0), p(-1.0, 1.0), p(1.0, 1.0), p(1.0, -1.0), ground);
        }
        data.add_mesh(builder.finish()).unwrap();
        data.add_light(light).unwrap();
        data.add_light(Light::Point { position: Vec3::ZERO, intensity: [0.0; 3] }).unwrap();
        lightmap(data, true).info().both_sided_charts
    }

    #[test]
    fn the_outside_of_rooms_is_seen_where_the_sun_or_the_sky_shines() {
        let sun = |e: f32| Light::Directional { direction: Vec3::NEG_Y, irradiance: [e; 3], angular_radius: 0.0 };
        let sky = Light::Sky { radiance: [1.0; 3], environment: NONE, up: Vec3::Y, rotation: 0.0 };
        let charts = [sun(1.0), sky].map(|light| both_sided_of_a_house(light, 0.0));
        assert!(charts[0] > 0 && charts[0] == charts[1], "{charts:?}");
        assert_eq!(both_sided_of_a_house(sun(0.0), 0.0), 0);
        assert_eq!(both_sided_of_a_house(Light::Point { position: Vec3::ZERO, intensity: [1.0; 3] }, 0.0), 0);
    }

    /// Nearly all rays end on the ground.
    #[test]
    fn the_inside_of_a_house_on_a_wide_ground_is_seen() {
        let sun = Light::Directional { direction: Vec3::NEG_Y, irradiance: [1.0; 3], angular_radius: 0.0 };
        let [alone, on_ground] = [0.0, 60.0].map(|ground| both_sided_of_a_house(sun, ground));
        // The house's floor is not seen from below.
        assert_eq!([alone, on_ground], [6, 5]);
    }

    /// Two rooms, a wall between them, and in them two small boxes and a one-sided screen.
    #[test]
    fn what_one_sees_something_from_both_sides_of_gets_two_places() {
        let (mut data, m) = two_sided();
        let one_sided = data.add_material(Material::default()).unwrap();
        let p = |x: f32, y: f32, z: f32| Vec3::new(x, y, z);
        let mut builder = MeshBuilder::new();
        builder.quad(p(-1.0, -1.0, 0.0), p(1.0, -1.0, 0.0), p(1.0, 1.0, 0.0), p(-1.0, 1.0, 0.0), m);
        builder.box_(Vec3::new(-1.0, -1.0, -2.0), Vec3::new(1.0, 1.0, 2.0), true, m);
        // Their fronts outside, and inside.
        builder.box_(Vec3::splat(0.05), Vec3::splat(0.15), false, m);
        builder.box_(Vec3::splat(0.45), Vec3::splat(0.55), true, m);
        let screen = [p(-0.5, -0.5, -1.0), p(0.5, -0.5, -1.0), p(0.5, 0.5, -1.0), p(-0.5, 0.5, -1.0)];
        builder.quad(screen[0], screen[1], screen[2], screen[3], one_sided);
        data.add_mesh(builder.finish()).unwrap();
        let lightmap = lightmap(data, true);
        let atlas = lightmap.atlas();
        let wall = atlas.charts.chart_of(0);
        for layout in [&atlas.map.layout, &atlas.gather.layout] {
            assert_eq!(layout.back_of, [wall], "the insides of the boxes and the outside of the room see nothing");
        }
        let back = atlas.map.layout.back(wall).unwrap();
        assert_eq!(atlas.map.texels_of(back).indices(), atlas.map.back_start.index()..atlas.map.len());
        let info = lightmap.info();
        assert_eq!(
            (info.both_sided_charts, info.back_texels),
            (1, atlas.map.texels_of(PlacementId::front_of(wall)).len() as u64)
        );
        // A chart with two places never turns over.
        let light = |s| if atlas.radiance.is_back(s) { 1e6 } else { 1.0 };
        assert!(!backs(atlas, light, &Progress::none()).unwrap()[wall.index()]);
        for both_sides in [false, true] {
            let cancel = Progress::new(|_, stage| stage != "sides");
            let desc = LightmapDesc { texels_per_unit: 8.0, both_sides, ..Default::default() };
            let result = Lightmap::create(&atlas.scene, &desc, &cancel);
            assert!(result.is_err(), "{both_sides}");
        }
    }
}
