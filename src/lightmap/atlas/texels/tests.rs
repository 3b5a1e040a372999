//! Tests of the inverse mapping.

use super::super::flat_triangle::Flat;
use super::inverse_mapping::cover_centres;
use super::*;
use crate::base::error::Error;
use crate::base::progress::Progress;
use crate::lightmap::atlas::charts::Chart;
use crate::lightmap::atlas::charts::tests::{grid, map_of, quad, scene_of, scene_on};
use crate::lightmap::atlas::ids::ChartId;
use crate::lightmap::atlas::pieces::Given;
use crate::lightmap::atlas::sheets::Sheet;
use crate::scene::Mesh;
use glam::DVec2;
use proptest::prelude::*;

const SIZE: [i64; 2] = [16, 12];

fn flat(points: [(f64, f64); 3]) -> Flat {
    Flat(points.map(|(x, y)| DVec2::new(x, y)))
}

/// Triangles in the window [0, 16]×[0, 12]: anything, slivers, and corners on texel borders.
fn triangles() -> impl Strategy<Value = Flat> {
    let point = || (0.0..16.0, 0.0..12.0);
    let any = [point(), point(), point()].prop_map(flat);
    let sliver =
        (point(), point(), 0.0..1.0, -14.0..-4.0).prop_map(|(a, b, t, d): ((f64, f64), (f64, f64), f64, f64)| {
            let c = (a.0 + t * (b.0 - a.0), (a.1 + t * (b.1 - a.1) + 10f64.powf(d)).clamp(0.0, 12.0));
            flat([a, b, c])
        });
    let small = (0.0..15.0, 0.0..11.0, [(0.0..1.0, 0.0..1.0), (0.0..1.0, 0.0..1.0), (0.0..1.0, 0.0..1.0)])
        .prop_map(|(x, y, p)| flat(p.map(|(px, py)| (x + px, y + py))));
    let integer = || (0..17, 0..13).prop_map(|(x, y)| (x as f64, y as f64));
    let on_borders = [integer(), integer(), integer()].prop_map(flat);
    prop_oneof![any, sliver, small, on_borders]
}

/// By how much a triangle and a texel's square overlap along the axis that separates them best
/// (negative: they are apart). Separating axes: nothing in common with the clipping under test.
fn overlap(t: &Flat, x: i64, y: i64) -> f64 {
    let square = [(0, 0), (1, 0), (1, 1), (0, 1)].map(|(i, j)| DVec2::new((x + i) as f64, (y + j) as f64));
    let edges = [0, 1, 2].map(|k| (t.0[(k + 1) % 3] - t.0[k]).perp().normalize_or_zero());
    let mut least = f64::INFINITY;
    for axis in edges.into_iter().chain([DVec2::X, DVec2::Y]).filter(|a| *a != DVec2::ZERO) {
        let range = |points: &[DVec2]| {
            points.iter().map(|p| p.dot(axis)).fold((f64::MAX, f64::MIN), |m, d| (m.0.min(d), m.1.max(d)))
        };
        let ((a0, a1), (b0, b1)) = (range(&t.0), range(&square));
        least = least.min(a1.min(b1) - a0.max(b0));
    }
    least
}

fn area(t: &Flat) -> f64 {
    let [a, b, c] = t.0;
    0.5 * (b - a).perp_dot(c - a).abs()
}

proptest! {
    #[test]
    fn the_texels_touched_are_those_whose_square_the_triangle_overlaps(t in triangles()) {
        let mut touched = vec![false; (SIZE[0] * SIZE[1]) as usize];
        t.for_each_touched(SIZE, |x, y| touched[(y * SIZE[0] + x) as usize] = true);
        for y in 0..SIZE[1] {
            for x in 0..SIZE[0] {
                let by = overlap(&t, x, y);
                let is = touched[(y * SIZE[0] + x) as usize];
                prop_assert!(is || by < 1e-9, "({x}, {y}) is overlapped by {by} and not touched by {t:?}");
                prop_assert!(!is || by > -1e-9, "({x}, {y}) is {by} away and touched by {t:?}");
            }
        }
        prop_assert!(touched.contains(&true));
    }

    #[test]
    fn areas_of_a_triangle_in_texels_add_up_to_its_area(t in triangles()) {
        let mut sum = 0.0;
        t.for_each_touched(SIZE, |x, y| {
            let area = t.clip(x, y).area_and_centroid().0;
            assert!((0.0..=1.0 + 1e-12).contains(&area));
            sum += area;
        });
        prop_assert!((sum - area(&t)).abs() < 1e-10, "{sum} is not {}", area(&t));
    }

    #[test]
    fn the_nearest_point_lies_in_the_texel_on_the_triangle_and_none_is_nearer(t in triangles(), s in 0.0..1.0, r in 0.0..1.0) {
        let (s, r): (f64, f64) = if s + r > 1.0 { (1.0 - s, 1.0 - r) } else { (s, r) };
        let [a, b, c] = t.0;
        let other = a + (b - a) * s + (c - a) * r;
        t.for_each_touched(SIZE, |x, y| {
            let corner = DVec2::new(x as f64, y as f64);
            let (p, distance) = t.nearest_in_texel(x, y);
            assert!(p.cmpge(corner).all() && p.cmple(corner + 1.0).all());
            let [u, v] = t.weights(p);
            assert!(u >= 0.0 && v >= 0.0 && u + v <= 1.0 + 1e-12);
            // The centre counts as inside elsewhere; here the border's nearest point is meant.
            let inside_texel = other.cmpge(corner).all() && other.cmple(corner + 1.0).all();
            let centre_inside = t.slab(corner.y + 0.5, corner.y + 0.5);
            if inside_texel && !(centre_inside.0..=centre_inside.1).contains(&(corner.x + 0.5)) {
                assert!(other.distance_squared(corner + 0.5) >= distance - 1e-9);
                let back = a + (b - a) * u + (c - a) * v;
                assert!(back.distance(p) < 1e-6, "{p} came back as {back}");
            }
        });
    }

    #[test]
    fn samples_lie_in_their_texel_and_on_their_chart(seed in any::<u64>(), density in 0.3f32..6.0, padding in 0u32..3) {
        let (scene, charts) = crumpled(seed);
        let layout = Layout::pack(&charts, density, 64, padding, false, &[], &[], &Progress::none()).unwrap();
        let map = map_of(&scene, &charts, &layout);
        for p in (0..layout.placements.len()).map(PlacementId::new) {
            let mut last = None;
            for s in map.samples_of(p) {
                let t = map.samples[s as usize];
                prop_assert!(last < Some((t.y, t.x)), "samples are ordered by row and column");
                last = Some((t.y, t.x));
                prop_assert_eq!(PlacementId::front_of(charts.chart_of(t.triangle)), p);
                prop_assert_eq!(map.texel_index(p, t.x as u32, t.y as u32), s);
                prop_assert_eq!(map.placement_of(s), p);
                let offsets = [(0, 0), (-1, 0), (1, 1), (0, -2)];
                let (x, y) = (i32::from(t.x), i32::from(t.y));
                let one_by_one = offsets.map(|(dx, dy)| map.texel_index(p, (x + dx) as u32, (y + dy) as u32));
                prop_assert_eq!(map.around(p, x, y, offsets), one_by_one);
                prop_assert!(t.u >= 0.0 && t.v >= 0.0 && t.u + t.v <= 1.0 + 1e-6);
                let [x, y] = layout.texel_coord(p, charts.local(t.triangle, t.u, t.v));
                prop_assert!((x - t.x as f32 - 0.5).abs() < 0.5001 && (y - t.y as f32 - 0.5).abs() < 0.5001);
            }
        }
    }

    #[test]
    fn lookups_find_samples_of_the_chart_around_the_point(
        seed in any::<u64>(), density in 0.1f32..6.0, triangle in 0u32..72, u in 0.0f32..1.0, v in 0.0f32..1.0
    ) {
        let (scene, charts) = crumpled(seed);
        let layout = Layout::pack(&charts, density, 64, 0, false, &[], &[], &Progress::none()).unwrap();
        let map = map_of(&scene, &charts, &layout);
        let (u, v) = if u + v > 1.0 { (1.0 - u, 1.0 - v) } else { (u, v) };
        let chart = charts.chart_of(triangle);
        prop_assume!(chart != ChartId::NONE);
        let p = PlacementId::front_of(chart);
        let coord = layout.texel_coord(p, charts.local(triangle, u, v));
        let nearest = map.samples[map.nearest(p, coord) as usize];
        prop_assert!((nearest.x as f32 + 0.5 - coord[0]).abs() < 0.501 && (nearest.y as f32 + 0.5 - coord[1]).abs() < 0.501);
        let b = map.bilinear(p, coord);
        prop_assert!((b.weights.iter().sum::<f32>() - 1.0).abs() < 1e-5);
        for (s, w) in b.samples.into_iter().zip(b.weights) {
            prop_assert!(map.samples_of(p).contains(&s) && (0.0..=1.0).contains(&w));
            let t = map.samples[s as usize];
            let distance = (t.x as f32 + 0.5 - coord[0]).abs().max((t.y as f32 + 0.5 - coord[1]).abs());
            prop_assert!(w == 0.0 || distance <= 1.0001, "sample {distance} texels away");
        }
    }

    #[test]
    fn the_padding_shows_the_nearest_covered_texel(
        seed in any::<u64>(), padding in 1u32..5, x0 in 0i32..64, y0 in 0i32..64, w in 1i32..64, h in 1i32..64
    ) {
        let (scene, charts) = crumpled(seed);
        let layout = Layout::pack(&charts, 2.0, 64, 4, false, &[], &[], &Progress::none()).unwrap();
        let map = map_of(&scene, &charts, &layout);
        let area = PageArea { columns: x0..(x0 + w).min(64), rows: y0..(y0 + h).min(64) };
        for page in 0..layout.page_count {
            prop_assert_eq!(shown(&map, page, &area, padding), expected(&map, &layout, page, &area, padding));
        }
    }

    #[test]
    fn the_padding_of_given_charts_reaches_beyond_their_rectangles(
        corner in prop::array::uniform2(0.0f32..0.8), size in prop::array::uniform2(0.02f32..0.5), padding in 1u32..5,
        x0 in 0i32..32, y0 in 0i32..32, w in 1i32..32, h in 1i32..32
    ) {
        let (scene, mut charts) = unit_quad();
        // Two charts, apart or one over the other.
        charts.charts = vec![
            Chart { triangles: 0..1, given: given(corner, size), ..charts.charts[0].clone() },
            Chart { triangles: 1..2, given: given([0.4, 0.3], [0.3, 0.5]), ..charts.charts[0].clone() },
        ];
        charts.own.of_triangles = [0, 1].map(ChartId::new).into();
        let layout = Layout::pack(&charts, 1.0, 32, 2, true, &[], &[], &Progress::none()).unwrap();
        let map = map_of(&scene, &charts, &layout);
        let area = PageArea { columns: x0..(x0 + w).min(32), rows: y0..(y0 + h).min(32) };
        let found = shown(&map, 0, &area, padding);
        prop_assert_eq!(&found, &expected(&map, &layout, 0, &area, padding));
        let all = shown(&map, 0, &PageArea::page(32), padding);
        prop_assert!(all.iter().any(|&s| s != NONE));
    }
}

fn given(offset: [f32; 2], scale: [f32; 2]) -> Option<Given> {
    Some(Given { page: 0, offset, scale })
}

/// The sample that each texel of a rectangle shows, as composed.
fn shown(map: &TexelMap, page: u32, area: &PageArea, padding: u32) -> Vec<u32> {
    let mut out = vec![NONE; area.columns.len() * area.rows.len()];
    map.compose(map.groups_of_page(page), area, padding, &mut out, |s| s, |s| s).unwrap();
    out
}

/// The same by comparing all samples of the page.
fn expected(map: &TexelMap, layout: &Layout, page: u32, area: &PageArea, padding: u32) -> Vec<u32> {
    let mut out = Vec::new();
    for (y, x) in area.rows.clone().flat_map(|y| area.columns.clone().map(move |x| (y, x))) {
        let offset = |s: u32| {
            let t = map.samples[s as usize];
            (x.abs_diff(t.x as i32), y.abs_diff(t.y as i32))
        };
        let owns = |n: usize| {
            let p = &layout.placements[n];
            let inside = (p.x as i32..(p.x + p.w) as i32).contains(&x) && (p.y as i32..(p.y + p.h) as i32).contains(&y);
            p.page == page && (inside || n < layout.given as usize)
        };
        let samples =
            (0..layout.placements.len()).filter(|&n| owns(n)).flat_map(|n| map.samples_of(PlacementId::new(n)));
        let near = samples.filter(|&s| offset(s).0.max(offset(s).1) <= padding);
        let best = near.min_by_key(|&s| (offset(s).0.pow(2) + offset(s).1.pow(2), s));
        out.push(best.unwrap_or(NONE));
    }
    out
}

/// A small crumpled sheet, whose triangles the unwrapper spreads over several charts.
fn crumpled(seed: u64) -> (std::sync::Arc<Scene>, Charts) {
    let height = |x: usize, y: usize| {
        let bits = (seed ^ (x * 7 + y) as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        (bits >> 40) as f32 / (1u64 << 24) as f32 * 2.0
    };
    let scene = scene_of(grid(6, 6, height));
    let charts = Charts::of_scene(&scene, 4.0, 64, 2, &Progress::none()).unwrap().0;
    (scene, charts)
}

/// One chart made by hand, of a quad of 1×1 unit in two triangles.
fn unit_quad() -> (std::sync::Arc<Scene>, Charts) {
    let scene = scene_of(quad());
    let charts = Charts {
        charts: vec![Chart { triangles: 0..2, size: [1.0; 2], area: 1.0, two_sided: false, given: None }],
        own: Sheet {
            triangles: vec![0, 1].into(),
            of_triangles: vec![ChartId::new(0); 2].into(),
            corners: vec![[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]], [[0.0, 0.0], [1.0, 1.0], [0.0, 1.0]]].into(),
            ..Sheet::default()
        },
        ..Charts::default()
    };
    (scene, charts)
}

#[test]
fn centres_on_a_shared_edge_go_to_the_lower_triangle_and_none_is_lost() {
    let (scene, charts) = unit_quad();
    let mut layout = Layout::pack(&charts, 8.0, 16, 0, false, &[], &[], &Progress::none()).unwrap();
    // Exactly on texels, so that the diagonal passes through centres.
    (layout.placements[0].offset, layout.placements[0].scale) = ([0.0; 2], [8.0; 2]);
    let map = map_of(&scene, &charts, &layout);
    assert_eq!(map.samples.len(), 64);
    assert_eq!(map.overlapping_texels, 0);
    for s in &map.samples {
        assert_eq!(s.triangle, if s.y > s.x { 1 } else { 0 });
        let [x, y] = charts.local(s.triangle, s.u, s.v).map(|c| c * 8.0);
        assert!((x - s.x as f32 - 0.5).abs() < 1e-5 && (y - s.y as f32 - 0.5).abs() < 1e-5, "not the centre");
    }
}

#[test]
fn a_chart_smaller_than_a_texel_has_one() {
    let (scene, charts) = unit_quad();
    for density in [1e-6, 0.01, 0.9] {
        let layout = Layout::pack(&charts, density, 16, 0, false, &[], &[], &Progress::none()).unwrap();
        let map = map_of(&scene, &charts, &layout);
        assert_eq!(map.samples.len(), 1);
        assert_eq!(map.bilinear(PlacementId::new(0), [-1e30, f32::NAN]).samples, [0; 4]);
    }
}

#[test]
fn a_texel_wide_strip_of_huge_length_and_a_sliver_are_mapped_whole() {
    let huge = flat([(0.5, 0.5), (4000.25, 0.5), (0.5, 3999.75)]);
    let size = [4096, 4096];
    let mut owners = vec![NONE; 4096 * 4096];
    assert_eq!(cover_centres(&huge, 7, size, &mut owners), 0);
    let covered = owners.iter().filter(|&&o| o == 7).count() as f64;
    assert!((covered - area(&huge)).abs() < 8000.0, "{covered} texels for an area of {}", area(&huge));
    let sliver = flat([(0.5, 10.25), (4000.0, 10.25), (2000.0, 10.25 + 1e-6)]);
    let mut touched = 0;
    sliver.for_each_touched(size, |x, y| {
        touched += 1;
        let p = sliver.nearest_in_texel(x, y).0;
        assert!((p.y - 10.25).abs() < 1.1e-6 && p.x >= x as f64 && p.x <= x as f64 + 1.0);
    });
    assert_eq!(touched, 4000);
}

#[test]
fn of_overlapping_given_triangles_the_first_one_wins_and_texels_are_counted() {
    let (scene, mut charts) = unit_quad();
    let given = Some(Given { page: 0, offset: [0.0; 2], scale: [1.0; 2] });
    let chart = |t: u32| Chart { triangles: t..t + 1, given, ..charts.charts[0].clone() };
    charts.charts = vec![chart(0), chart(1)];
    charts.own.of_triangles = [0, 1].map(ChartId::new).into();
    // The second lies on the first, and on a part of the page that is its own.
    charts.own.corners[1] = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]];
    let layout = Layout::pack(&charts, 1.0, 8, 2, true, &[], &[], &Progress::none()).unwrap();
    let map = map_of(&scene, &charts, &layout);
    // The right triangle x ≥ y has 36 centres; x + y ≤ 8 has 36 too; both have 20, of which those
    // strictly inside both are counted.
    let [first, second] = [0, 1].map(PlacementId::new);
    assert_eq!(map.samples_of(first).len(), 36);
    assert!((6..=20).contains(&map.overlapping_texels), "{}", map.overlapping_texels);
    assert_eq!(map.samples[map.texel_index(second, 3, 0) as usize].triangle, 0);
    assert_eq!(map.samples[map.texel_index(second, 0, 3) as usize].triangle, 1);
    let mut texels: Vec<_> = map.samples.iter().map(|s| (s.x, s.y)).collect();
    texels.sort_unstable();
    texels.dedup();
    assert_eq!(texels.len(), map.samples.len(), "a texel has two samples");
}

#[test]
fn back_sides_have_the_same_texels_elsewhere() {
    let (scene, charts) = unit_quad();
    let chart = ChartId::new(0);
    let layout = Layout::pack(&charts, 4.0, 16, 0, false, &[chart], &[], &Progress::none()).unwrap();
    let map = map_of(&scene, &charts, &layout);
    let (front, back) = (PlacementId::front_of(chart), layout.back(chart).unwrap());
    assert_eq!(map.samples_of(front).len(), map.samples_of(back).len());
    for (f, b) in map.samples_of(front).zip(map.samples_of(back)) {
        let (f, b) = (map.samples[f as usize], map.samples[b as usize]);
        assert_eq!((f.triangle, f.u, f.v), (b.triangle, b.u, b.v));
    }
}

#[test]
fn a_map_without_charts_is_empty() {
    let (scene, _) = unit_quad();
    let layout = Layout::pack(&Charts::default(), 1.0, 16, 2, true, &[], &[], &Progress::none()).unwrap();
    let map = map_of(&scene, &Charts::default(), &layout);
    assert_eq!((map.samples.len(), layout.page_count), (0, 0));
    assert_eq!(map.group_count(), 0);
}

#[test]
fn the_number_of_threads_does_not_change_the_texels() {
    let maps = [1, 2, 7].map(|threads| {
        let scene = scene_on(threads, grid(40, 40, |x, y| ((x * y) % 7) as f32 * 0.3));
        let charts = Charts::of_scene(&scene, 3.0, 64, 2, &Progress::none()).unwrap().0;
        let layout = Layout::pack(&charts, 3.0, 64, 2, false, &[], &[], &Progress::none()).unwrap();
        let map = map_of(&scene, &charts, &layout);
        (charts, layout, map.samples, map.chart_start, map.index)
    });
    assert!(maps[0] == maps[1] && maps[0] == maps[2]);
}

#[test]
fn normals_come_from_the_mesh_unless_they_face_away() {
    let up = Vec3::new(0.6, 0.0, 0.8);
    let scene = scene_of(Mesh { normals: vec![up, up, up, -up].into(), ..quad() });
    let front = TexelSample { triangle: 0, u: 0.25, v: 0.25, ..Default::default() };
    assert!(front.shading_normal(&scene).distance(up) < 1e-6);
    assert!(front.position(&scene).distance(Vec3::new(0.5, 0.25, 0.0)) < 1e-6);
    let away = TexelSample { triangle: 1, u: 0.0, v: 1.0, ..Default::default() };
    assert_eq!(away.shading_normal(&scene), Vec3::Z);
}

#[test]
fn a_cancel_stops_the_mapping() {
    let (scene, charts) = unit_quad();
    let layout = Layout::pack(&charts, 8.0, 16, 0, false, &[], &[], &Progress::none()).unwrap();
    let progress = Progress::new(|_, _| false);
    let stage = progress.stage("texels", 0.0, 1.0, TexelMap::work(&layout));
    assert_eq!(TexelMap::build(&scene, &charts, &layout, &stage).err(), Some(Error::Cancelled));
}
