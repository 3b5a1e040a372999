//! Tests of the search for buried texels.

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
        let [seen, buried] = counted(&lightmap, |p| p.x < 0.001 && p.y > 0.1 && p.y < 1.9 && p.z > 1.1 && p.z < 1.9);
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
    let (mut buried, mut rays, mut rays_alone, mut given_up) = (0, 0, 0, 0);
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
        let found = search.find_buried(&mut together, points.iter().copied(), false, GIVE_UP, &mut rays);
        let is_alone = |(_, point): &(u32, &(TexelSample, u32))| {
            let (before, point) = (rays_alone, std::iter::once(**point));
            let is_buried = !search.find_buried(&mut alone, point, false, GIVE_UP, &mut rays_alone).is_empty();
            given_up += u32::from(is_buried && rays_alone - before == u64::from(GIVE_UP));
            is_buried
        };
        let expected: Vec<u32> = (0..).zip(&points).filter(is_alone).map(|(number, _)| number).collect();
        assert_eq!(found, expected);
        buried += found.len();
    }
    assert!(buried > 80 && texels.len() > buried + BLOCK && rays == rays_alone, "{buried} of {}", texels.len());
    // Within the box all rays end on backs.
    assert!(given_up > 80, "{given_up} of {buried}");

    // Other points of more texels than are tested together: of every second column, as if their samples were buried.
    let (mut found, progress) = (Found::default(), Progress::none());
    let given: Vec<LightTexel> = texels.iter().copied().step_by(2).collect();
    let (mut left, stage) = (given.clone(), progress.stage("buried texels", 0.0, 1.0, 1));
    search.find_seen_parts(&atlas.map, floor, false, &mut left, &mut together, &mut found, &stage).unwrap();
    found.seen_parts.sort_unstable_by_key(|part| part.0);
    let place = |(s, p): (LightTexel, TexelSample)| (s, p.triangle, p.u, p.v);
    let seen_part = |&s: &LightTexel| {
        let seed = atlas.map.seed_in(floor, s);
        let mut points = search.points_of_texel(&atlas.map, floor, s, seed).into_iter();
        points
            .find(|&p| {
                search.find_buried(&mut alone, std::iter::once((p, seed)), false, GIVE_UP_OTHERS, &mut 0).is_empty()
            })
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
