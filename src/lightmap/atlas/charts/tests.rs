//! Tests of charts, with what the tests of layouts and texels share.

use super::*;
use crate::device::{Device, DeviceOptions};
use crate::lightmap::atlas::layout::Layout;
use crate::lightmap::atlas::pieces::connected_by_vertices;
use crate::lightmap::atlas::texels::TexelMap;
use crate::scene::Material;
use crate::scene::{MeshMaterials, SceneData};
use glam::Vec3;
use proptest::prelude::*;
use std::sync::Arc;

/// A committed scene of one mesh on a device of `threads`. Materials: 0 one-sided, 1 two-sided.
pub(in crate::lightmap) fn scene_on(threads: usize, mesh: Mesh) -> Arc<Scene> {
    let device = Device::new(DeviceOptions { num_threads: threads, ..Default::default() }).unwrap();
    let mut data = SceneData::new();
    data.add_material(Material::default()).unwrap();
    data.add_material(Material { two_sided: true, ..Default::default() }).unwrap();
    data.add_mesh(mesh).unwrap();
    Scene::commit(&device, data, &Default::default(), &Progress::none()).map_err(|e| e.1).unwrap()
}

pub(in crate::lightmap) fn scene_of(mesh: Mesh) -> Arc<Scene> {
    scene_on(2, mesh)
}

pub(in crate::lightmap) fn map_of(scene: &Scene, charts: &Charts, layout: &Layout) -> TexelMap {
    let progress = Progress::none();
    let stage = progress.stage("texels", 0.0, 1.0, TexelMap::work(layout));
    TexelMap::build(scene, charts, layout, &stage).unwrap()
}

/// The unit square in two triangles.
pub(in crate::lightmap) fn quad() -> Mesh {
    let corner = |x, y| Vec3::new(x, y, 0.0);
    Mesh {
        positions: vec![corner(0.0, 0.0), corner(1.0, 0.0), corner(1.0, 1.0), corner(0.0, 1.0)].into(),
        indices: vec![[0, 1, 2], [0, 2, 3]].into(),
        ..Default::default()
    }
}

/// A height field of w × h unit squares, two triangles each.
pub(in crate::lightmap) fn grid(w: usize, h: usize, height: impl Fn(usize, usize) -> f32) -> Mesh {
    let mut mesh = Mesh::default();
    for y in 0..=h {
        for x in 0..=w {
            mesh.positions.as_vec().push(Vec3::new(x as f32, y as f32, height(x, y)));
        }
    }
    for y in 0..h {
        for x in 0..w {
            let i = (y * (w + 1) + x) as u32;
            let above = i + w as u32 + 1;
            mesh.indices.as_vec().extend([[i, i + 1, above + 1], [i, above + 1, above]]);
        }
    }
    mesh
}

fn with_uvs(mesh: Mesh, uvs: Vec<Vec2>, pages: Vec<u32>) -> Mesh {
    Mesh { lightmap: Some(LightmapUvs { uvs: uvs.into(), pages: pages.into() }), ..mesh }
}

fn charts_of(scene: &Scene, density: f32) -> (Charts, UvReport) {
    Charts::of_scene(scene, density, 256, 2, &Progress::none()).unwrap()
}

/// Every valid triangle is in one chart, coordinates lie in the chart's extent, charts keep their
/// area, and packed texels have one owner.
pub(in crate::lightmap) fn check(scene: &Scene, charts: &Charts) {
    let mut seen = vec![false; scene.triangle_count() as usize];
    for (id, chart) in charts.ids().zip(&charts.charts) {
        let triangles = charts.triangles_of(id);
        assert!(triangles.len() > 0 && triangles.clone().is_sorted());
        let mut area = 0.0;
        for t in triangles {
            assert!(!std::mem::replace(&mut seen[t as usize], true));
            assert_eq!(charts.chart_of(t), id);
            assert_eq!(scene.material(t).two_sided, chart.two_sided);
            for c in charts.corners(t) {
                assert!((0..2).all(|k| c[k] >= 0.0 && c[k] <= chart.size[k]), "{c:?} in a chart of {:?}", chart.size);
            }
            area += triangle_area(scene, t);
        }
        assert!((chart.area as f64 / area - 1.0).abs() < 1e-5);
    }
    for t in 0..scene.triangle_count() {
        assert_eq!(seen[t as usize], scene.is_valid(t), "triangle {t}");
        assert_eq!(charts.chart_of(t) == ChartId::NONE, !scene.is_valid(t));
    }
    let density = automatic_density(scene, 256, 1.0).unwrap();
    let layout = Layout::pack(charts, density, 256, 1, false, &[], &[], &Progress::none()).unwrap();
    assert_eq!(map_of(scene, charts, &layout).overlapping_texels, 0);
}

/// Area in the chart over area in space, of a triangle.
fn stretch(scene: &Scene, charts: &Charts, triangle: u32) -> f64 {
    let [a, b, c] = charts.corners(triangle).map(|p| Vec2::from_array(p).as_dvec2());
    0.5 * (b - a).perp_dot(c - a) / triangle_area(scene, triangle)
}

#[test]
fn a_cube_has_a_chart_per_side_in_true_size() {
    let mut mesh = Mesh::default();
    mesh.positions
        .as_vec()
        .extend((0..8).map(|i| Vec3::new((i & 1) as f32, (i >> 1 & 1) as f32, (i >> 2) as f32) * 3.0));
    for [a, b, c, d] in [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]] {
        mesh.indices.as_vec().extend([[a, b, c], [a, c, d]]);
    }
    let scene = scene_of(mesh);
    let (charts, report) = charts_of(&scene, 10.0);
    assert_eq!((charts.charts.len(), report.unwrapped_charts), (6, 6));
    check(&scene, &charts);
    for chart in &charts.charts {
        assert!(chart.size.iter().all(|s| (s - 3.0).abs() < 1e-4), "{:?}", chart.size);
    }
}

#[test]
fn a_flat_region_is_one_chart_even_where_parts_are_cut() {
    // More triangles than a part may have, all flat but for a ridge.
    let scene = scene_of(grid(150, 120, |x, _| if x == 75 { 40.0 } else { 0.0 }));
    let (charts, _) = charts_of(&scene, 0.5);
    check(&scene, &charts);
    #[cfg(feature = "unwrap")]
    assert!(charts.charts.len() <= 4, "{} charts", charts.charts.len());
}

#[test]
fn tiny_and_huge_and_distant_meshes_keep_their_proportions() {
    for (scale, offset) in [(1e-6, 0.0), (1e6, 0.0), (1.0, 1e4)] {
        let mut mesh = grid(8, 8, |x, y| (x * y % 3) as f32 * 0.5);
        mesh.positions.iter_mut().for_each(|p| *p = *p * scale + Vec3::splat(offset));
        let scene = scene_of(mesh);
        let (charts, _) = charts_of(&scene, 10.0 / scale);
        check(&scene, &charts);
        for t in 0..scene.triangle_count() {
            let stretch = stretch(&scene, &charts, t);
            assert!((0.45..2.2).contains(&stretch), "triangle {t} at scale {scale} is stretched by {stretch}");
        }
    }
}

#[test]
fn sides_lit_and_unlit_do_not_share_a_chart() {
    let materials = (0..32).map(|t| (t / 2 + t / 8) % 2).collect();
    let scene = scene_of(Mesh { materials: MeshMaterials::PerTriangle(materials), ..grid(4, 4, |_, _| 0.0) });
    let (charts, _) = charts_of(&scene, 4.0);
    assert!(charts.charts.len() >= 2);
    check(&scene, &charts);
}

#[test]
fn charts_longer_than_a_page_are_cut_where_triangles_allow_it() {
    let scene = scene_of(grid(200, 1, |_, _| 0.0));
    let (charts, _) = Charts::of_scene(&scene, 10.0, 256, 2, &Progress::none()).unwrap();
    assert!((8..=16).contains(&charts.charts.len()), "{} charts", charts.charts.len());
    assert!(charts.charts.iter().all(|c| c.size[0].max(c.size[1]) * 10.0 <= 252.0));
    check(&scene, &charts);
    let whole = scene_of(quad());
    assert_eq!(Charts::of_scene(&whole, 1000.0, 256, 2, &Progress::none()).unwrap().0.charts.len(), 1);
}

#[test]
fn given_uvs_come_back() {
    let mesh = grid(4, 4, |x, _| x as f32);
    let uvs: Vec<Vec2> = mesh.positions.iter().map(|p| Vec2::new(0.1 + p.x * 0.2, 0.3 + p.y * 0.05)).collect();
    let scene = scene_of(with_uvs(mesh, uvs.clone(), vec![3; 32]));
    let (charts, report) = charts_of(&scene, 4.0);
    assert_eq!((report.given_charts, report.unwrapped_charts), (1, 0));
    check(&scene, &charts);
    let layout = Layout::pack(&charts, 4.0, 256, 2, true, &[], &[], &Progress::none()).unwrap();
    assert_eq!((layout.page_count, layout.placements[0].page), (4, 3));
    for (t, i) in scene.meshes()[0].indices.iter().enumerate() {
        for k in 0..3 {
            let coord = Vec2::from_array(layout.placements[0].texel_coord(charts.own.corners[t][k]));
            assert!((coord / 256.0).distance(uvs[i[k] as usize]) < 1e-6);
        }
    }
}

#[test]
fn unusable_uvs_are_counted_and_unwrapped() {
    let mesh = grid(4, 1, |_, _| 0.0);
    let mut uvs: Vec<Vec2> = mesh.positions.iter().map(|p| Vec2::new(p.x * 0.25, p.y)).collect();
    uvs[0].x = f32::NAN;
    uvs[9].y = 1.1;
    uvs[2] = uvs[3];
    // The last vertex is within half a texel of the page.
    uvs[4].x = 1.0 + 1.0 / 1024.0;
    let scene = scene_of(with_uvs(mesh, uvs, vec![]));
    let (charts, report) = charts_of(&scene, 16.0);
    // Vertex 0 is in two triangles and vertex 9 in two; of the squares beside the edge (2, 3) one
    // triangle is collapsed.
    assert_eq!((report.out_of_range, report.degenerate), (4, 1));
    assert!(report.given_charts >= 1 && report.unwrapped_charts >= 1);
    check(&scene, &charts);
}

#[test]
fn uvs_that_cannot_be_unique_are_unwrapped() {
    let mesh = grid(3, 1, |_, _| 0.0);
    // Every square on the whole page, as with texture coordinates of a repeating pattern.
    let positions: Vec<Vec3> = mesh.indices.iter().flatten().map(|&i| mesh.positions[i as usize]).collect();
    let indices = (0..6).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
    let uvs = [[0, 0], [1, 0], [1, 1], [0, 0], [1, 1], [0, 1]].map(|c| Vec2::new(c[0] as f32, c[1] as f32)).repeat(3);
    let scene = scene_of(with_uvs(Mesh { positions: positions.into(), indices, ..Default::default() }, uvs, vec![]));
    let (charts, report) = charts_of(&scene, 4.0);
    assert_eq!((report.overlapping, report.given_charts), (6, 0));
    check(&scene, &charts);
}

#[test]
fn absurd_densities_and_pages_are_refused_by_name() {
    let scene = scene_of(quad());
    let error = |density, page_size| {
        Charts::of_scene(&scene, density, page_size, 2, &Progress::none()).err().unwrap().to_string()
    };
    assert!(error(1e9, 256).contains("texels_per_unit 1000000000 on a surface of 1.000"));
    assert!(error(f32::NAN, 256).contains("texels_per_unit is NaN"));
    assert!(error(-1.0, 256).contains("texels_per_unit is -1"));
    assert!(error(1.0, 1 << 20).contains("page_size is 1048576"));
    assert!(error(1.0, 4).contains("padding 2"));
    let scene = scene_of(with_uvs(quad(), vec![Vec2::ZERO, Vec2::X, Vec2::ONE, Vec2::Y], vec![0, 4_000_000_000]));
    let e = Charts::of_scene(&scene, 4.0, 256, 2, &Progress::none()).err().unwrap().to_string();
    assert!(e.contains("lightmap_page of triangle 1 of mesh 0 is 4000000000"), "{e}");
}

#[test]
fn a_single_triangle_is_a_chart() {
    let scene = scene_of(Mesh { indices: vec![[0, 1, 2]].into(), ..quad() });
    let (charts, _) = charts_of(&scene, 4.0);
    assert_eq!(charts.charts.len(), 1);
    check(&scene, &charts);
}

#[test]
fn the_number_of_threads_does_not_change_the_charts() {
    let charts = [1, 2, 7].map(|threads| {
        let scene = scene_on(threads, grid(150, 120, |x, y| ((x / 9 * y / 7) % 5) as f32));
        charts_of(&scene, 1.0).0
    });
    assert!(charts[0] == charts[1] && charts[0] == charts[2]);
}

#[test]
fn a_cancel_stops_the_unwrapping() {
    // So large that there are many reports, of which there are no more than a hundred per second.
    let scene = scene_of(grid(250, 250, |x, y| (x * y % 5) as f32));
    let mut reports = 0;
    let progress = Progress::new(|_, _| {
        reports += 1;
        reports < 3
    });
    assert_eq!(Charts::of_scene(&scene, 4.0, 256, 2, &progress).err(), Some(Error::Cancelled));
}

/// Triangles that share corners of a small lattice: duplicates, edges with many triangles,
/// contradictory winding, needles and degenerate ones; a few corners are just off the lattice.
fn garbage() -> impl Strategy<Value = Mesh> {
    let corner = (0..3u8, 0..3u8, 0..3u8, 0..8u8);
    let triangle = [corner.clone(), corner.clone(), corner];
    prop::collection::vec(triangle, 1..40).prop_map(|triangles| {
        let mut mesh = Mesh { materials: MeshMaterials::PerTriangle(Vec::new().into()), ..Default::default() };
        for (t, triangle) in triangles.into_iter().enumerate() {
            let first = mesh.positions.len() as u32;
            mesh.indices.as_vec().push([first, first + 1, first + 2]);
            for (x, y, z, off) in triangle {
                let off = if off == 0 { 1e-6 } else { 0.0 };
                mesh.positions.as_vec().push(Vec3::new(x as f32 + off, y as f32, z as f32 - off));
            }
            let MeshMaterials::PerTriangle(materials) = &mut mesh.materials else { unreachable!() };
            materials.as_vec().push(u32::from(t % 5 == 0));
        }
        // A scene needs one valid triangle.
        mesh.indices.as_vec().push([0, 1, 2].map(|i| mesh.positions.len() as u32 + i));
        mesh.positions.as_vec().extend([Vec3::ZERO, Vec3::X, Vec3::Y]);
        let MeshMaterials::PerTriangle(materials) = &mut mesh.materials else { unreachable!() };
        materials.as_vec().push(0);
        mesh
    })
}

proptest! {
    #[test]
    fn garbage_gets_valid_charts(mesh in garbage()) {
        let scene = scene_on(1, mesh);
        check(&scene, &charts_of(&scene, 8.0).0);
    }

    #[test]
    fn items_that_share_vertices_are_connected_as_by_keys(
        items in prop::collection::vec([0u32..30, 0u32..30, 0u32..30], 1..40),
    ) {
        let progress = Progress::none();
        let stage = progress.stage("unwrap", 0.0, 1.0, 1);
        let keys = items.iter().zip(0..).flat_map(|(corners, i)| corners.map(|v| (v, i))).collect();
        let expected = connected(items.len(), keys, &stage).unwrap();
        prop_assert_eq!(connected_by_vertices(items.into_iter(), 30, &stage).unwrap(), expected);
    }

    #[test]
    fn connected_items_share_the_lowest_of_them(pairs in prop::collection::vec((0u32..30, 0u32..30), 0..40)) {
        let keys = pairs.iter().enumerate().flat_map(|(k, &(a, b))| [(k, a), (k, b)]).collect();
        let progress = Progress::none();
        let stage = progress.stage("unwrap", 0.0, 1.0, 1);
        let roots = connected(30, keys, &stage).unwrap();
        let mut expected: Vec<u32> = (0..30).collect();
        for _ in 0..30 {
            for &(a, b) in &pairs {
                let low = expected[a as usize].min(expected[b as usize]);
                (expected[a as usize], expected[b as usize]) = (low, low);
            }
        }
        prop_assert_eq!(&roots, &expected);
        let groups = Groups::new(&roots, &stage).unwrap();
        let groups: Vec<&[u32]> = groups.iter().collect();
        prop_assert_eq!(groups.iter().map(|g| g.len()).sum::<usize>(), 30);
        prop_assert!(groups.iter().all(|g| g.is_sorted() && g.iter().all(|&i| roots[i as usize] == g[0])));
    }
}

#[test]
#[cfg(feature = "io")]
fn a_real_level_keeps_its_own_pages() {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/scenes/q3_oa_dm5.obj");
    if !path.exists() {
        eprintln!("skipped: needs the shared scenes");
        return;
    }
    let device = Device::new(DeviceOptions::default()).unwrap();
    let mut data = SceneData::new();
    crate::io::load(&path, &mut data).unwrap();
    let scene = Scene::commit(&device, data, &Default::default(), &Progress::none()).map_err(|e| e.1).unwrap();
    let (charts, report) = Charts::of_scene(&scene, 0.5, 1024, 2, &Progress::none()).unwrap();
    assert!(report.given_charts > 1000, "{report:?}");
    assert_eq!((report.out_of_range, report.overlapping), (0, 0));
    let layout = Layout::pack(&charts, 0.5, 1024, 2, true, &[], &[], &Progress::none()).unwrap();
    let pages = layout.placements[..layout.given as usize].iter().map(|p| p.page).max();
    assert_eq!(pages, Some(5));
    let map = map_of(&scene, &charts, &layout);
    assert!((0..charts.charts.len() as u32).all(|c| c >= layout.given || layout.placements[c as usize].page <= 5));
    assert!(map.samples.len() > 1_000_000);
}
