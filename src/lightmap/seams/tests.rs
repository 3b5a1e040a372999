use super::solver::STIFFNESS;
use super::*;
use crate::device::{Device, DeviceOptions};
use crate::lightmap::{Layer, LightmapDesc};
use crate::scene::demo::shapes::MeshBuilder;
use crate::scene::{Instance, LightmapUvs, Material, Mesh, MeshMaterials, Scene, SceneData};
use glam::{Affine3A, DVec3, Quat};
use std::f32::consts::FRAC_PI_6;
use std::sync::Arc;

const LAMP: crate::scene::Light =
    crate::scene::Light::Point { position: Vec3::new(0.9, 0.4, 0.45), intensity: [4.0, 2.0, 1.0] };

fn scene(threads: usize, meshes: Vec<Mesh>, light: crate::scene::Light) -> Arc<Scene> {
    let device = Device::new(DeviceOptions { num_threads: threads, ..Default::default() }).unwrap();
    let mut data = SceneData::new();
    data.add_material(Material { albedo: [0.7; 3], ..Default::default() }).unwrap();
    data.add_material(Material { albedo: [0.7; 3], two_sided: true, ..Default::default() }).unwrap();
    for mesh in meshes {
        data.add_mesh(mesh).unwrap();
    }
    data.add_light(light).unwrap();
    Scene::commit(&device, data, &Default::default(), &Progress::none()).map_err(|e| e.1).unwrap()
}

/// A quad with given light map UVs: a square of half a page's width around `centre`, turned by `angle`.
fn quad(corners: [Vec3; 4], centre: Vec2, angle: f32) -> Mesh {
    let uvs = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]
        .map(|c| centre + Vec2::from_angle(angle).rotate(0.15 * Vec2::from_array(c)));
    Mesh {
        positions: corners.to_vec().into(),
        indices: vec![[0, 1, 2], [0, 2, 3]].into(),
        lightmap: Some(LightmapUvs { uvs: uvs.to_vec().into(), pages: Vec::new().into() }),
        ..Default::default()
    }
}

/// Two squares of floor, side by side at x = 1, in charts whose texels do not meet, and a ceiling
/// that reflects light on them.
fn floor() -> Vec<Mesh> {
    let square = |x: f32| {
        let p = |dx: f32, z: f32| Vec3::new(x + dx, 0.0, z);
        [p(0.0, 0.0), p(0.0, 1.0), p(1.0, 1.0), p(1.0, 0.0)]
    };
    let ceiling = [[-1.0, -1.0], [3.0, -1.0], [3.0, 2.0], [-1.0, 2.0]].map(|[x, z]| Vec3::new(x, 1.5, z));
    vec![
        quad(square(0.0), Vec2::new(0.25, 0.25), 0.0),
        quad(square(1.0), Vec2::new(0.73, 0.26), FRAC_PI_6),
        quad(ceiling, Vec2::new(0.25, 0.75), 0.0),
    ]
}

fn lightmap(scene: &Arc<Scene>) -> Lightmap {
    let desc = LightmapDesc { texels_per_unit: 40.0, page_size: 128, gather_divisor: 2, ..Default::default() };
    Lightmap::create(scene, &desc, &Progress::none()).unwrap()
}

fn params(stitch: bool) -> BakeParams {
    BakeParams { photon_count: 20_000, gather_rays: 64, stitch, ..Default::default() }
}

fn bake(map: &mut Lightmap, params: &BakeParams) -> BakeStats {
    map.bake(params, &Progress::none()).unwrap()
}

fn bits(map: &Lightmap) -> Vec<[u32; 3]> {
    let light = map.light.as_ref().unwrap();
    light.direct.iter().chain(&light.indirect).map(|v| v.to_array().map(f32::to_bits)).collect()
}

/// What the two squares of floor show differently where they meet, as a shader would, relative to
/// what they show: root mean square over places that have nothing to do with the points.
fn rms_at_the_seam(map: &Lightmap, layer: Layer, front: bool) -> f64 {
    let (mut squares, mut sum, n) = (0.0, 0.0, 1009);
    for i in 0..n {
        let z = (i as f32 + 0.5) / n as f32;
        // Triangle 1 has corners 0, 2, 3 of its square: x = 1 from its corner 1 to 2. Triangle 2 has
        // corners 0, 1, 2 of the other: from its corner 0 to 1.
        let a = Vec3::from(map.sample(layer, 1, front, z, 1.0 - z));
        let b = Vec3::from(map.sample(layer, 2, front, z, 0.0));
        squares += (a - b).length_squared() as f64;
        sum += (a + b).element_sum() as f64 / 2.0;
    }
    (squares / (3 * n) as f64).sqrt() / (sum / (3 * n) as f64)
}

#[test]
fn both_sides_of_a_seam_agree_and_nothing_else_changes() {
    let mut map = lightmap(&scene(2, floor(), LAMP));
    let off = bake(&mut map, &params(false));
    assert!(off.left_out & left_out::SEAMS != 0 && off.seam_points == 0);
    let before = [Layer::Direct, Layer::Indirect].map(|l| rms_at_the_seam(&map, l, true));
    let plain = bits(&map);
    let stats = bake(&mut map, &params(true));
    let after = [Layer::Direct, Layer::Indirect].map(|l| rms_at_the_seam(&map, l, true));
    println!("{before:?} {after:?} {} {}", stats.seam_rms_before, stats.seam_rms_after);
    assert!(map.plan_text().contains("stitching of seams at 1 edges"), "{}", map.plan_text());
    for (before, after) in before.into_iter().zip(after) {
        assert!(before > 0.002 && after < before / 5.0, "{before} {after}");
    }
    assert!(stats.seam_rms_after < stats.seam_rms_before / 5.0);
    let stitched = bits(&map);
    let n = map.atlas.map.len();
    let mut moved = 0;
    for i in 0..2 * n {
        let p = map.atlas.map.texels.samples[i % n].position(&map.atlas.scene);
        // Texels are 1/38 wide.
        let near = p.y < 0.1 && (p.x - 1.0).abs() < 2.0 / 38.0;
        assert!(near || stitched[i] == plain[i], "texel {i} at {p}");
        moved += (stitched[i] != plain[i]) as u32;
    }
    assert!(moved > 100, "{moved}");
    assert_eq!(map.light.as_ref().unwrap().stitch.as_ref().unwrap().texels.len() * 2, moved as usize);
    bake(&mut map, &params(false));
    assert!(bits(&map) == plain);
}

#[test]
fn edges_rounded_within_a_texel_are_not_stitched() {
    // A floor and its side, which a lamp lights nearly as much. Between them the edge is rounded by four strips, of a
    // millimetre together, that are as smooth as the side of a column of sixteen faces.
    let square = |corners: [[f32; 2]; 2], uv| {
        let [a, b] = corners.map(|[x, y]| [0.0, 1.0].map(|z| Vec3::new(x, y, z)));
        quad([a[0], a[1], b[1], b[0]], uv, 0.0)
    };
    let radius = 1e-3;
    let on_arc = |i: usize| {
        let (sin, cos) = (i as f32 * std::f32::consts::FRAC_PI_8).sin_cos();
        [1.0 + radius * sin, radius * (cos - 1.0)]
    };
    let arc = (0..5).map(on_arc);
    let positions: Vec<Vec3> = arc.flat_map(|[x, y]| [0.0, 1.0].map(|z| Vec3::new(x, y, z))).collect();
    // All in one column of texels, whose samples lie in the middle of the bend.
    let uvs: Vec<Vec2> =
        (0..5).flat_map(|i| [0.1, 0.4].map(|v| Vec2::new(70.5 / 128.0 + 1e-4 * (i as f32 - 2.0), v))).collect();
    let strips = Mesh {
        positions: positions.into(),
        indices: (0..4).flat_map(|i| [[0, 1, 3], [0, 3, 2]].map(|t| t.map(|k| 2 * i + k))).collect::<Vec<_>>().into(),
        lightmap: Some(LightmapUvs { uvs: uvs.into(), pages: Vec::new().into() }),
        ..Default::default()
    };
    let ceiling = floor().remove(2);
    let meshes = vec![
        square([[0.0, 0.0], on_arc(0)], Vec2::new(0.25, 0.25)),
        strips,
        square([on_arc(4), [1.0 + radius, -1.0]], Vec2::new(0.75, 0.25)),
        ceiling,
    ];
    let lamp = crate::scene::Light::Point { position: Vec3::new(2.0, 0.5, 0.5), intensity: [4.0; 3] };
    let mut map = lightmap(&scene(2, meshes, lamp));
    bake(&mut map, &params(false));
    let (plain, n) = (bits(&map), map.atlas.map.len());
    let stats = bake(&mut map, &params(true));
    let stitched = bits(&map);
    let changed = (0..2 * n).filter(|&i| stitched[i] != plain[i]).map(|i| map.atlas.map.texels.samples[i % n]);
    // Triangles of the floor and of its side come first and last before the ceiling.
    let changed = changed.filter(|sample| !(2..10).contains(&sample.triangle)).count();
    assert_eq!((changed, stats.seam_points), (0, 0), "{}", map.plan_text());
}

#[test]
fn light_is_not_stitched_to_shade() {
    // A curtain hangs down to half of the seam and shades the second square, which sees nearly all of the ceiling.
    let mut meshes = floor();
    let curtain = [[0.3, 0.0], [0.3, 0.5], [1e-4, 0.5], [1e-4, 0.0]].map(|[y, z]| Vec3::new(1.000_01, y, z));
    meshes.push(quad(curtain, Vec2::new(0.75, 0.75), 0.0));
    let mut map = lightmap(&scene(2, meshes, LAMP));
    bake(&mut map, &params(false));
    let plain = bits(&map);
    bake(&mut map, &params(true));
    let stitched = bits(&map);
    let n = map.atlas.map.len();
    let (mut open, mut shaded) = (0, 0);
    for i in (0..n).filter(|&i| stitched[i] != plain[i]) {
        let z = map.atlas.map.texels.samples[i].position(&map.atlas.scene).z;
        (open, shaded) = (open + (z > 0.55) as u32, shaded + (z < 0.45) as u32);
    }
    assert!(open > 50 && shaded == 0, "{open} {shaded}");
}

#[test]
fn what_lies_in_a_gap_is_not_stitched_to_what_does_not() {
    // Half of the second square is covered, and a curtain hangs down from the cover where the squares meet.
    let mut meshes = floor();
    let cover = [[1.000_01, 0.0], [2.0, 0.0], [2.0, 0.5], [1.000_01, 0.5]].map(|[x, z]| Vec3::new(x, 0.02, z));
    let curtain = [[0.02, 0.0], [0.02, 0.5], [1e-4, 0.5], [1e-4, 0.0]].map(|[y, z]| Vec3::new(1.000_01, y, z));
    meshes.push(quad(cover, Vec2::new(0.75, 0.75), 0.0));
    meshes.push(quad(curtain, Vec2::new(0.75, 0.75), 0.0));
    let mut map = lightmap(&scene(2, meshes, LAMP));
    bake(&mut map, &params(false));
    let plain = bits(&map);
    bake(&mut map, &params(true));
    let text = map.plan_text();
    let stitched = bits(&map);
    let n = map.atlas.map.len();
    let (mut open, mut covered) = (0, 0);
    for i in (0..2 * n).filter(|&i| stitched[i] != plain[i]) {
        let z = map.atlas.map.texels.samples[i % n].position(&map.atlas.scene).z;
        (open, covered) = (open + (z > 0.5) as u32, covered + (z < 0.45) as u32);
    }
    // But for some texels (34 of 138) whose samples lie before the curtain.
    assert!(open > 50 && 3 * covered < open, "{open} {covered}");
    assert!(text.contains("smooth surfaces, except "), "{text}");
}

#[test]
fn seams_of_instances_are_those_of_copies_inside_and_between_them() {
    let mut tile = MeshBuilder::new();
    let corner = |x: f32, z: f32| Vec3::new(x, 0.0, z);
    tile.grid_quad(corner(0.0, 0.0), corner(0.0, 1.0), corner(1.0, 1.0), corner(1.0, 0.0), 2, 2, 0);
    let mut ball = MeshBuilder::new();
    ball.sphere(Vec3::Y, 0.4, 3, 0);
    // Three tiles in a row. Copies of balls may be unwrapped with other rounding; balls do not touch, since it is by chance which
    // texels are hidden there.
    for (mesh, difference) in [(tile.finish(), 0.0), (ball.finish(), 0.02)] {
        let mut data = SceneData::new();
        data.add_material(Material { albedo: [0.7; 3], ..Default::default() }).unwrap();
        let mesh = data.add_mesh(mesh).unwrap();
        for (x, scale) in [(0.0, 1.0), (1.0, 1.0), (2.0, 1.0), (7.0, 2.0)] {
            let transform = Affine3A::from_scale_rotation_translation(Vec3::splat(scale), Quat::IDENTITY, x * Vec3::X);
            data.add_instance(Instance::new(mesh, transform)).unwrap();
        }
        data.add_light(LAMP).unwrap();
        let mut copies = SceneData::new();
        copies.add_material(Material { albedo: [0.7; 3], ..Default::default() }).unwrap();
        data.flattened().iter().for_each(|mesh| _ = copies.add_mesh(mesh.clone()).unwrap());
        copies.add_light(LAMP).unwrap();
        let [instances, copies] = [data, copies].map(|data| {
            let mut map = lightmap(&data.committed());
            let stats = bake(&mut map, &params(true));
            assert!(stats.seam_rms_after < 0.2 * stats.seam_rms_before, "{stats:?}");
            let text = map.plan_text();
            let edges = text.split("seams at ").nth(1).and_then(|rest| rest.split(' ').next()).unwrap();
            // Noise decides which points are left out for unlike light.
            let unlike = text.split("except ").nth(1).and_then(|rest| rest.split(' ').next()).unwrap_or("0");
            [edges.parse().unwrap(), stats.seam_points as f64 + unlike.parse::<f64>().unwrap()]
        });
        for (a, b) in instances.into_iter().zip(copies) {
            assert!((a - b).abs() <= difference * b, "{instances:?} {copies:?}");
        }
    }
}

#[test]
fn shards_and_threads_leave_the_bits_of_a_whole_bake() {
    let mut whole = lightmap(&scene(1, floor(), LAMP));
    bake(&mut whole, &params(true));
    let mut parts = lightmap(&scene(2, floor(), LAMP));
    let n = parts.info().texels;
    let shard = |parts: &mut Lightmap, range: [u64; 2], stitch| {
        let stats = bake(parts, &BakeParams { texel_begin: range[0], texel_end: range[1], ..params(stitch) });
        stats.left_out & left_out::SEAMS == 0
    };
    assert!(!shard(&mut parts, [n / 2, n], true), "stitched too soon");
    // But for one texel, which no seam shows.
    assert!(!shard(&mut parts, [1, n / 2], true), "stitched too soon");
    assert!(shard(&mut parts, [0, 1], true));
    assert!(bits(&whole) == bits(&parts));
    // A part again: what was stitched is stitched anew, not twice.
    assert!(shard(&mut parts, [n / 5, n / 4], true));
    assert!(bits(&whole) == bits(&parts));
    assert!(!shard(&mut parts, [n / 5, n / 4], false));
    bake(&mut whole, &params(false));
    assert!(bits(&whole) == bits(&parts));
}

#[test]
fn a_cancel_leaves_what_was_there() {
    let mut map = lightmap(&scene(2, floor(), LAMP));
    bake(&mut map, &params(false));
    let before = bits(&map);
    let cancel = Progress::new(|_, stage| stage != "seams");
    assert_eq!(map.bake(&params(true), &cancel).err(), Some(Error::Cancelled));
    assert!(bits(&map) == before);
}

#[test]
fn the_edges_of_a_cube_stay_and_a_smooth_cylinder_is_closed() {
    let mut cube = MeshBuilder::new();
    cube.box_(Vec3::ZERO, Vec3::splat(0.5), false, 0);
    let mut map = lightmap(&scene(2, vec![cube.finish()], LAMP));
    let stats = bake(&mut map, &params(true));
    assert!(stats.left_out & left_out::SEAMS != 0 && stats.seam_points == 0);
    assert!(map.plan_text().contains("left out: stitching of seams (no edge of a smooth"), "{}", map.plan_text());

    let tube = |segments: u32, smooth: bool| {
        let mut tube = MeshBuilder::new();
        tube.revolve(Vec3::ZERO, Vec3::Y, &[(0.0, 0.3), (0.5, 0.3)], segments, 0);
        let mut tube = tube.finish();
        if smooth {
            tube.normals = tube.positions.iter().map(|p| Vec3::new(p.x, 0.0, p.z).normalize()).collect();
        }
        tube
    };
    // Eight sides meet at 45 degrees, with normals of their own or smoothed.
    let mut map = lightmap(&scene(2, vec![tube(8, false)], LAMP));
    assert!(bake(&mut map, &params(true)).left_out & left_out::SEAMS != 0);
    let mut map = lightmap(&scene(2, vec![tube(8, true)], LAMP));
    let stats = bake(&mut map, &params(true));
    println!("{} {} {}", stats.seam_points, stats.seam_rms_before, stats.seam_rms_after);
    assert!(stats.left_out & left_out::SEAMS == 0 && stats.seam_points > 10);
    assert!(stats.seam_rms_after < stats.seam_rms_before / 5.0);
}

/// Sheets that lie on each other, or turn their backs on each other, do not go on in each other.
#[test]
fn three_sheets_at_an_edge_and_sheets_that_face_away_stay() {
    let edges = |meshes: Vec<Mesh>| {
        let map = lightmap(&scene(2, meshes, LAMP));
        let progress = Progress::none();
        let stage = progress.stage("seams", 0.0, 1.0, 1);
        let job = Job { atlas: &map.atlas, backs: &[], budget: 0, stage: &stage };
        job.edges().unwrap().len()
    };
    assert_eq!(edges(floor()), 1);
    let mut turned = floor();
    turned[1].indices.iter_mut().for_each(|t| t.swap(1, 2));
    assert_eq!(edges(turned), 0);
    let mut folded = floor();
    folded[1] = quad([1.0, 1.0, 0.0, 0.0].map(|x| Vec3::new(x, 0.0, 0.0)), Vec2::new(0.73, 0.26), 0.3);
    for (i, z) in [0.0, 1.0, 1.0, 0.0].into_iter().enumerate() {
        folded[1].positions[i].z = z;
    }
    assert_eq!(edges(folded), 0);
    let mut stacked = floor();
    stacked[1].positions = stacked[0].positions.clone();
    assert_eq!(edges(stacked), 0);
    let wall = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]].map(|[z, y]| Vec3::new(1.0, y, z));
    let mut walled = floor();
    walled.push(quad(wall, Vec2::new(0.75, 0.75), 0.0));
    assert_eq!(edges(walled), 0);
}

/// The floor with both its sides over a cellar.
#[test]
fn backs_are_stitched_to_the_sides_that_go_on_in_them() {
    let house = |sides: [u32; 2], turned: bool| {
        let mut meshes = floor();
        let cellar = [[-1.0, -1.0], [-1.0, 2.0], [3.0, 2.0], [3.0, -1.0]].map(|[x, z]| Vec3::new(x, -1.5, z));
        meshes.push(quad(cellar, Vec2::new(0.75, 0.75), 0.0));
        for (mesh, material) in meshes.iter_mut().zip(sides) {
            mesh.materials = MeshMaterials::One(material);
        }
        if turned {
            meshes[1].indices.iter_mut().for_each(|t| t.swap(1, 2));
        }
        let light = crate::scene::Light::Point { position: Vec3::new(0.9, -0.4, 0.45), intensity: [4.0, 2.0, 1.0] };
        let scene = scene(2, meshes, light);
        let desc = LightmapDesc { texels_per_unit: 40.0, page_size: 128, gather_divisor: 2, ..Default::default() };
        Lightmap::create(&scene, &LightmapDesc { both_sides: true, ..desc }, &Progress::none()).unwrap()
    };
    // Pairs of sides by material and winding; backs are true.
    let pairs = |map: &Lightmap| -> Vec<[bool; 2]> {
        let progress = Progress::none();
        let stage = progress.stage("seams", 0.0, 1.0, 1);
        let job = Job { atlas: &map.atlas, backs: &[], budget: 0, stage: &stage };
        job.edges().unwrap().iter().map(|e| e.map(|side| job.is_back(side))).collect()
    };
    assert_eq!(pairs(&house([1, 1], false)), [[false, false], [true, true]]);
    assert_eq!(pairs(&house([1, 1], true)), [[false, true], [true, false]]);
    assert_eq!(pairs(&house([1, 0], false)), [[false, false]]);
    assert_eq!(pairs(&house([1, 0], true)), [[true, false]]);

    let mut map = house([1, 1], false);
    bake(&mut map, &params(false));
    let before = [Layer::Direct, Layer::Indirect].map(|l| rms_at_the_seam(&map, l, false));
    bake(&mut map, &params(true));
    let after = [Layer::Direct, Layer::Indirect].map(|l| rms_at_the_seam(&map, l, false));
    println!("{before:?} {after:?}");
    for (before, after) in before.into_iter().zip(after) {
        assert!(before > 0.002 && after < before / 5.0, "{before} {after}");
    }
}

fn solve(points: Vec<Point>, texels: usize, before: &[Vec3A], x: &mut [Vec3A]) {
    let progress = Progress::none();
    let stage = progress.stage("seams", 0.0, 1.0, 1);
    System::new(points, texels, &stage).unwrap().solve(before, x, 0.0, &stage).unwrap();
}

/// On the edge of a spotlight's cone, where least squares alone would go below zero.
#[test]
fn light_stays_at_least_zero() {
    // One side shows texels 0 and 1 in equal parts, the other texel 2: alone, texel 0 would become
    // −1/2 · 1/2 / (3/2 + λ).
    let point =
        Point { texels: [0, 1, 0, 0, 2, 2, 2, 2], weights: [0.5, 0.5, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0], length: 1.0 };
    let before = [Vec3A::ZERO, Vec3A::ONE, Vec3A::ZERO];
    let mut x = before;
    solve(vec![point], 3, &before, &mut x);
    let step = 0.5 / (1.5 + STIFFNESS);
    for (x, expected) in x.iter().zip([0.0, 1.0 - 0.5 * step, step]) {
        assert!((*x - Vec3A::splat(expected)).abs().max_element() < 1e-5, "{x} {expected}");
    }

    let spot = crate::scene::Light::Spot {
        position: Vec3::new(0.985, 1.0, 0.3),
        direction: -Vec3::Y,
        inner: 0.28,
        outer: 0.29,
        intensity: [1.0, 0.5, 2.0],
    };
    let mut map = lightmap(&scene(2, floor(), spot));
    let stats = bake(&mut map, &params(true));
    assert!(stats.seam_points > 0 && stats.seam_rms_after < stats.seam_rms_before, "{stats:?}");
    let light = map.light.as_ref().unwrap();
    assert!(light.direct.iter().chain(&light.indirect).all(|v| v.min_element() >= 0.0 && v.is_finite()));
}

/// Against the normal equations, written out and solved by elimination in f64.
#[test]
fn the_light_found_is_the_least_squares_solution() {
    let n = 12;
    let random = |i: u32| crate::base::sampling::uniform(i, 0, 7);
    let points: Vec<Point> = (0..20)
        .map(|i| {
            let mut p = Point { length: 0.1 + random(i), ..Default::default() };
            for side in 0..2 {
                let [fx, fy] = [random(100 + 4 * i + side), random(300 + 4 * i + side)];
                let w = [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy];
                for k in 0..4 {
                    let at = (4 * side) as usize + k;
                    p.texels[at] = (random(500 + 8 * i + at as u32) * n as f32) as u32;
                    p.weights[at] = if side == 0 { w[k] } else { -w[k] };
                }
            }
            p
        })
        .collect();
    // Around 10: nothing is clamped.
    let before: Vec<Vec3A> =
        (0..n).map(|i| Vec3A::new(10.0 + random(900 + i), 10.0 + 3.0 * random(950 + i), 10.0)).collect();
    let mut matrix = vec![vec![0.0f64; n as usize]; n as usize];
    for p in &points {
        for (j, k) in (0..8).flat_map(|j| (0..8).map(move |k| (j, k))) {
            let w = p.weights[j] as f64 * p.weights[k] as f64 * p.length as f64;
            matrix[p.texels[j] as usize][p.texels[k] as usize] += w;
        }
    }
    let mut rows: Vec<(Vec<f64>, DVec3)> =
        matrix.into_iter().zip(&before).map(|(row, b)| (row, STIFFNESS as f64 * b.as_dvec3())).collect();
    (0..n as usize).for_each(|i| rows[i].0[i] += STIFFNESS as f64);
    // The matrix is positive definite: no pivoting.
    for i in 0..n as usize {
        for j in (0..n as usize).filter(|&j| j != i) {
            let f = rows[j].0[i] / rows[i].0[i];
            for k in 0..n as usize {
                rows[j].0[k] -= f * rows[i].0[k];
            }
            rows[j].1 = rows[j].1 - f * rows[i].1;
        }
    }
    let mut x = before.clone();
    solve(points, n as usize, &before, &mut x);
    for i in 0..n as usize {
        let expected = rows[i].1 / rows[i].0[i];
        let moved = (before[i].as_dvec3() - expected).abs().max_element();
        assert!((x[i].as_dvec3() - expected).abs().max_element() < 2e-5, "{i}: {} {expected}, moved by {moved}", x[i]);
    }
    assert!(x.iter().zip(&before).any(|(x, b)| (*x - *b).length() > 0.1));
}
