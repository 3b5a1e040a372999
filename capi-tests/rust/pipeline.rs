//! The whole pipeline against the path tracer and against physics, and what it promises about
//! threads, cancelling and shards. Each test prints its figures (`--nocapture` shows them).

use bakelite::bvh::BuildOptions;
use bakelite::lightmap::plan::left_out;
use bakelite::lightmap::{BakeParams, Layer, LayerData, Lightmap, LightmapDesc};
use bakelite::photon::{PhotonMap, PhotonParams};
use bakelite::reference::{Irradiance, PathTracer, Random, SurfacePoint};
use bakelite::scene::shapes::MeshBuilder;
use bakelite::scene::{Environment, Instance, builtin};
use bakelite::trace::Ray;
use bakelite::{Device, DeviceOptions, Error, Isa, Light, Material, Progress, Scene, SceneData};
use glam::{Affine3A, Quat, Vec3};
use std::f64::consts::PI;
use std::sync::{Arc, OnceLock};
use std::time::Instant;

fn device(num_threads: usize, isa: Option<Isa>) -> Arc<Device> {
    Device::new(DeviceOptions { num_threads, isa, ..Default::default() }).unwrap()
}

fn commit(name: &str, device: &Arc<Device>) -> Arc<Scene> {
    let data = builtin(name).unwrap();
    Scene::commit(device, data, &BuildOptions::default(), &Progress::none()).map_err(|(_, e)| e).unwrap()
}

/// A light map of a built-in scene with default settings, baked.
fn baked(name: &str) -> Lightmap {
    let scene = commit(name, &device(0, None));
    let mut map = Lightmap::create(&scene, &LightmapDesc::default(), &Progress::none()).unwrap();
    map.bake(&BakeParams::default(), &Progress::none()).unwrap();
    map
}

/// A place on a surface: global triangle and weights of corners 1 and 2.
#[derive(Clone, Copy)]
struct Place {
    triangle: u32,
    u: f32,
    v: f32,
}

impl Place {
    /// Uniform over the area of `scene`.
    fn random(scene: &Scene, random: &mut Random) -> Self {
        let areas: Vec<f64> = (0..scene.triangle_count()).map(|t| area(scene, t)).collect();
        let mut pick = random.uniform() * areas.iter().sum::<f64>();
        let triangle = areas.iter().position(|a| {
            pick -= a;
            pick < 0.0
        });
        Self::random_on(triangle.unwrap_or(areas.len() - 1) as u32, random)
    }

    fn random_on(triangle: u32, random: &mut Random) -> Self {
        let [a, b] = random.square();
        let (u, v) = if a + b > 1.0 { (1.0 - a, 1.0 - b) } else { (a, b) };
        Place { triangle, u: u as f32, v: v as f32 }
    }

    fn point(&self, scene: &Scene) -> SurfacePoint {
        SurfacePoint::on_triangle(scene, self.triangle, self.u as f64, self.v as f64)
    }

    fn sample(&self, map: &Lightmap, layer: Layer) -> [f64; 3] {
        map.sample(layer, self.triangle, true, self.u, self.v).map(f64::from)
    }
}

fn area(scene: &Scene, triangle: u32) -> f64 {
    let [a, b, c] = scene.corners(triangle).map(|c| c.as_dvec3());
    0.5 * (b - a).cross(c - a).length()
}

/// Points of the Cornell box that the tests look at.
const CORNELL_POINTS: usize = 200;
const CORNELL_SAMPLES: u32 = 16 * 32 * 32;

/// Places in the Cornell box that light reaches, with their irradiance. (Below the blocks nothing
/// is seen, and light maps repeat there what is around.)
fn cornell_reference() -> &'static [(Place, Irradiance)] {
    static REFERENCE: OnceLock<Vec<(Place, Irradiance)>> = OnceLock::new();
    REFERENCE.get_or_init(|| {
        let start = Instant::now();
        let scene = commit("cornell", &device(0, None));
        let tracer = PathTracer::new(&scene);
        let mut random = Random::new(2024, 0);
        let mut places = Vec::new();
        while places.len() < CORNELL_POINTS {
            let place = Place::random(&scene, &mut random);
            if tracer.irradiance(&place.point(&scene), 256, 0, 0).total()[0] > 0.0 {
                places.push(place);
            }
        }
        let points: Vec<SurfacePoint> = places.iter().map(|p| p.point(&scene)).collect();
        let values = tracer.irradiance_many(scene.device(), &points, CORNELL_SAMPLES, 1, &Progress::none()).unwrap();
        println!("reference: {CORNELL_POINTS} points in {:.2} s", start.elapsed().as_secs_f64());
        places.into_iter().zip(values).collect()
    })
}

/// The mean over values and channels.
fn mean<'a>(values: impl IntoIterator<Item = &'a [f64; 3]>) -> f64 {
    let (sum, count) = values.into_iter().fold((0.0, 0), |(s, n), v| (s + v.iter().sum::<f64>(), n + 3));
    sum / count as f64
}

#[test]
fn the_reference_of_the_cornell_box_is_known_to_half_a_percent() {
    let reference = cornell_reference();
    let totals: Vec<[f64; 3]> = reference.iter().map(|(_, e)| e.total()).collect();
    let variances: Vec<[f64; 3]> = reference.iter().map(|(_, e)| e.standard_error.map(|s| s * s)).collect();
    let error = mean(&variances).sqrt() / mean(&totals);
    println!("relative standard error {error:.5}");
    assert!(error < 0.005, "{error}");
}

#[test]
fn the_cornell_box_agrees_with_the_path_tracer_to_three_percent_without_bias() {
    let map = baked("cornell");
    let reference = cornell_reference();
    let totals: Vec<[f64; 3]> = reference.iter().map(|(_, e)| e.total()).collect();
    let errors_of = |layer, expected: fn(&Irradiance) -> [f64; 3]| -> Vec<[f64; 3]> {
        let error = |(place, e): &(Place, Irradiance)| {
            let (baked, expected) = (place.sample(&map, layer), expected(e));
            std::array::from_fn(|c| baked[c] - expected[c])
        };
        reference.iter().map(error).collect()
    };
    let errors = errors_of(Layer::Combined, Irradiance::total);
    let direct = errors_of(Layer::Direct, |e| e.direct);
    let indirect = errors_of(Layer::Indirect, |e| e.indirect);

    // Triangles in the order of `cornell`: five quads of the room, then the blocks.
    let class = |p: &Place| match p.triangle {
        t @ 0..10 => ["floor", "ceiling", "back wall", "green wall", "red wall"][t as usize / 2],
        10..22 => "short block",
        _ => "tall block",
    };
    println!("Errors relative to the mean irradiance of the surface:");
    println!("{:12} {:>6} {:>8} {:>8} {:>8} {:>8} {:>8}", "", "points", "mean E", "bias", "direct", "indirect", "RMSE");
    let row = |name: &str, belongs: &dyn Fn(&Place) -> bool| -> (f64, f64) {
        let select = |values: &[[f64; 3]]| -> Vec<[f64; 3]> {
            values.iter().zip(reference).filter(|(_, (p, _))| belongs(p)).map(|(v, _)| *v).collect()
        };
        let (e, level) = (select(&errors), mean(&select(&totals)));
        let bias = |values: &[[f64; 3]]| mean(&select(values)) / level;
        let rmse = mean(&squares(&e)).sqrt() / level;
        let percent = [bias(&errors), bias(&direct), bias(&indirect), rmse].map(|x| format!("{:7.2}%", 100.0 * x));
        println!("{name:12} {:6} {level:8.3} {}", e.len(), percent.join(" "));
        (bias(&errors), rmse)
    };
    for name in ["floor", "ceiling", "back wall", "green wall", "red wall", "short block", "tall block"] {
        row(name, &|p| class(p) == name);
    }
    let (bias, rmse) = row("all", &|_| true);
    assert!(rmse <= 0.03, "the relative RMSE is {rmse}");
    // Three times what 200 points of 3 % error would scatter.
    assert!(bias.abs() <= 0.0065, "the bias is {bias}");
}

/// Without photons the radiance map lacks all light that is reflected more than once.
#[test]
fn paths_from_all_hits_have_no_bias_though_the_radiance_map_lacks_light() {
    let scene = commit("cornell", &device(0, None));
    let desc = LightmapDesc { page_size: 256, gather_divisor: 2, ..Default::default() };
    let mut map = Lightmap::create(&scene, &desc, &Progress::none()).unwrap();
    let reference = cornell_reference();
    let expected: Vec<[f64; 3]> = reference.iter().map(|(_, e)| e.indirect).collect();
    let mut bias = |near_hits: f32| {
        let params = BakeParams { near_hits, photon_count: 0, ..Default::default() };
        map.bake(&params, &Progress::none()).unwrap();
        let baked: Vec<[f64; 3]> = reference.iter().map(|(place, _)| place.sample(&map, Layer::Indirect)).collect();
        mean(&baked) / mean(&expected) - 1.0
    };
    let (all, near, none) = (bias(f32::INFINITY), bias(2.0), bias(0.0));
    println!("bias with paths from all hits {all:.4}, near ones {near:.4}, none {none:.4}");
    assert!(all.abs() < 0.01, "{all}");
    // Paths bring back what is missing where they go.
    assert!(none < -0.3 && near > none + 0.01, "{near} {none}");
}

/// Modelled rooms often have their fronts outside, and two-sided materials so that nobody minds.
#[test]
fn a_two_sided_room_turned_inside_out_has_the_same_light() {
    let cornell = builtin("cornell").unwrap();
    let mut data = SceneData::new();
    for material in cornell.materials() {
        data.add_material(Material { two_sided: true, ..*material }).unwrap();
    }
    for mesh in cornell.meshes() {
        let mut mesh = mesh.clone();
        mesh.indices.iter_mut().for_each(|t| t.swap(1, 2));
        mesh.normals.iter_mut().for_each(|n| *n = -*n);
        data.add_mesh(mesh).unwrap();
    }
    for light in cornell.lights() {
        data.add_light(*light).unwrap();
    }
    let device = device(0, None);
    let scene = Scene::commit(&device, data, &BuildOptions::default(), &Progress::none()).map_err(|e| e.1).unwrap();
    let desc = LightmapDesc { both_sides: false, ..Default::default() };
    let mut map = Lightmap::create(&scene, &desc, &Progress::none()).unwrap();
    let stats = map.bake(&BakeParams::default(), &Progress::none()).unwrap();
    // The undersides of the two blocks are dark on both sides.
    assert_eq!(stats.back_charts, map.info().charts as u64 - 2);
    assert!(map.plan_text().contains("backs instead of fronts for"));
    let reference = cornell_reference();
    let turned = |p: &Place| Place { u: p.v, v: p.u, ..*p };
    let error = |(place, e): &(Place, Irradiance)| {
        let baked = turned(place).sample(&map, Layer::Combined);
        std::array::from_fn(|c| baked[c] - e.total()[c])
    };
    let errors: Vec<[f64; 3]> = reference.iter().map(error).collect();
    let totals: Vec<[f64; 3]> = reference.iter().map(|(_, e)| e.total()).collect();
    let (bias, rmse) = (mean(&errors) / mean(&totals), mean(&squares(&errors)).sqrt() / mean(&totals));
    println!("bias {:.2} %, RMSE {:.2} %", 100.0 * bias, 100.0 * rmse);
    assert!(rmse <= 0.03, "the relative RMSE is {rmse}");
    assert!(bias.abs() <= 0.0065, "the bias is {bias}");
}

/// A room with a lamp in either half and a two-sided sheet between them: mesh 0, which does not reach the ceiling.
fn divided_room(threads: usize) -> Arc<Scene> {
    let mut data = SceneData::new();
    let cloth = Material { albedo: [0.7, 0.5, 0.3], two_sided: true, ..Default::default() };
    let cloth = data.add_material(cloth).unwrap();
    let walls = data.add_material(Material { albedo: [0.6; 3], ..Default::default() }).unwrap();
    let p = |x: f32, y: f32| Vec3::new(x, y, 0.0);
    let mut sheet = MeshBuilder::new();
    sheet.quad(p(-1.0, -1.0), p(1.0, -1.0), p(1.0, 0.5), p(-1.0, 0.5), cloth);
    data.add_mesh(sheet.finish()).unwrap();
    let mut room = MeshBuilder::new();
    room.box_(Vec3::new(-1.0, -1.0, -1.5), Vec3::new(1.0, 1.0, 1.5), true, walls);
    data.add_mesh(room.finish()).unwrap();
    for (position, intensity) in [([0.0, 0.2, 1.0], [3.0, 2.0, 1.0]), ([0.3, -0.2, -0.8], [0.2, 0.4, 0.6])] {
        data.add_light(Light::Point { position: position.into(), intensity }).unwrap();
    }
    let device = device(threads, None);
    Scene::commit(&device, data, &BuildOptions::default(), &Progress::none()).map_err(|e| e.1).unwrap()
}

fn divided(threads: usize, both_sides: bool) -> Lightmap {
    let desc = LightmapDesc { texels_per_unit: 16.0, page_size: 256, gather_divisor: 2, ..Default::default() };
    let desc = LightmapDesc { radiance_divisor: 2, both_sides, ..desc };
    Lightmap::create(&divided_room(threads), &desc, &Progress::none()).unwrap()
}

#[test]
fn both_sides_of_a_sheet_have_their_own_light() {
    let mut map = divided(0, true);
    map.bake(&BakeParams::default(), &Progress::none()).unwrap();
    let info = map.info();
    assert_eq!(info.both_sided_charts, 1);
    let line = format!("separate texels for the backs of 1 two-sided charts: {} of", info.back_texels);
    assert!(map.plan_text().contains(&line), "{}", map.plan_text());
    let scene = map.scene().clone();
    let tracer = PathTracer::new(&scene);
    let mut random = Random::new(7, 0);
    let places: Vec<Place> = (0..100).map(|i| Place::random_on(i % 2, &mut random)).collect();
    for (front, most_rmse, most_bias) in [(true, 0.03, 0.007), (false, 0.04, 0.02)] {
        let side = |p: &Place| {
            let point = p.point(&scene);
            SurfacePoint { normal: if front { point.normal } else { -point.normal }, ..point }
        };
        let points: Vec<SurfacePoint> = places.iter().map(side).collect();
        let reference = tracer.irradiance_many(scene.device(), &points, 16 * 16 * 16, 1, &Progress::none()).unwrap();
        let totals: Vec<[f64; 3]> = reference.iter().map(|e| e.total()).collect();
        let error = |(p, e): (&Place, &[f64; 3])| -> [f64; 3] {
            let x = map.sample(Layer::Combined, p.triangle, front, p.u, p.v).map(f64::from);
            std::array::from_fn(|c| x[c] - e[c])
        };
        let errors: Vec<[f64; 3]> = places.iter().zip(&totals).map(error).collect();
        let level = mean(&totals);
        let (bias, rmse) = (mean(&errors) / level, mean(&squares(&errors)).sqrt() / level);
        println!("front {front}: mean {level:.3}, bias {:.2} %, RMSE {:.2} %", 100.0 * bias, 100.0 * rmse);
        // Reflected is albedo/π of it, in texels of another size.
        let sum = |layer, c: usize| {
            places.iter().map(|p| map.sample(layer, p.triangle, front, p.u, p.v)[c] as f64).sum::<f64>()
        };
        let reflected = [0, 1, 2].map(|c| PI * sum(Layer::Radiance, c) / sum(Layer::Combined, c));
        println!("reflected {reflected:.3?}");
        let off = (0..3).map(|c| (reflected[c] / [0.7, 0.5, 0.3][c] - 1.0).abs()).fold(0.0, f64::max);
        assert!(off <= 0.08, "front {front}: {reflected:?} of the light is reflected");
        assert!(rmse <= most_rmse && bias.abs() <= most_bias, "front {front}: RMSE {rmse}, bias {bias}");
    }
}

/// The UVs of fronts and backs lead to texels of the same places that look the other way.
#[test]
fn backs_have_uvs_positions_and_normals_of_their_own() {
    let map = divided(2, true);
    let size = map.info().width as usize;
    let ((fronts, pages), (backs, back_pages)) = (map.mesh_uvs(0).unwrap(), map.mesh_back_uvs(0).unwrap().0);
    for t in 0..2 {
        let texel = |corners: [[f32; 2]; 3], page: u32| -> [[f32; 3]; 2] {
            let [x, y] = [0, 1].map(|k| (corners.iter().map(|c| c[k]).sum::<f32>() / 3.0 * size as f32) as usize);
            [Layer::Position, Layer::Normal].map(|layer| match map.read(page, layer).unwrap() {
                LayerData::Rgb(v) => v[y * size + x],
                _ => unreachable!(),
            })
        };
        let [front, back] = [texel(fronts[t], pages[t]), texel(backs[t], back_pages[t])];
        assert!((Vec3::from(front[0]) - Vec3::from(back[0])).length() < 1.5 / 16.0, "{front:?} {back:?}");
        assert_eq!((front[1][2], back[1][2]), (1.0, -1.0));
        assert!(map.shows(t as u32, true) && map.shows(t as u32, false));
    }
    assert_eq!(map.mesh_back_uvs(0).unwrap().1, [true; 2]);
    // The walls are one-sided, and without the option so is the place of the sheet.
    assert_eq!(map.mesh_back_uvs(1).unwrap(), (map.mesh_uvs(1).unwrap(), vec![false; 12]));
    assert!(map.shows(2, true) && !map.shows(2, false));
    let mut one = divided(2, false);
    assert_eq!(one.mesh_back_uvs(0).unwrap(), (one.mesh_uvs(0).unwrap(), vec![false; 2]));
    one.bake(&small().1, &Progress::none()).unwrap();
    assert_ne!(one.shows(0, true), one.shows(0, false));
    assert_eq!(one.sample(Layer::Combined, 0, true, 0.3, 0.3), one.sample(Layer::Combined, 0, false, 0.3, 0.3));
    assert_eq!(one.info().texels + map.info().back_texels, map.info().texels);
}

/// A closed white room with a lamp, and balls in it that are instances of one mesh, or copies of it.
fn room_of_balls(threads: usize, copies: bool) -> Arc<Scene> {
    let (device, data) = (device(threads, None), described_balls(copies));
    Scene::commit(&device, data, &BuildOptions::default(), &Progress::none()).map_err(|e| e.1).unwrap()
}

fn described_balls(copies: bool) -> SceneData {
    let mut data = SceneData::new();
    let white = data.add_material(Material { albedo: [0.7; 3], ..Default::default() }).unwrap();
    let red = data.add_material(Material { albedo: [0.6, 0.1, 0.1], ..Default::default() }).unwrap();
    let mut room = MeshBuilder::new();
    room.box_(Vec3::ZERO, Vec3::new(4.0, 3.0, 4.0), true, white);
    data.add_mesh(room.finish()).unwrap();
    let mut ball = MeshBuilder::new();
    ball.sphere(Vec3::ZERO, 0.5, 3, red);
    let mesh = data.add_mesh(ball.finish()).unwrap();
    for i in 0..5 {
        let place = Vec3::new(0.8 + 0.6 * i as f32, 0.5 + 0.4 * (i % 3) as f32, 0.9 + 1.1 * (i % 2) as f32);
        let scale = if i == 4 { Vec3::new(1.2, 0.6, 1.0) } else { Vec3::splat(0.5 + 0.2 * i as f32) };
        let turn = Quat::from_rotation_z(0.7 * i as f32);
        let transform = Affine3A::from_scale_rotation_translation(scale, turn, place);
        data.add_instance(Instance::new(mesh, transform)).unwrap();
    }
    let lamp = Light::Point { position: Vec3::new(2.0, 2.7, 2.0), intensity: [3.0; 3] };
    if copies {
        let mut flat = SceneData::new();
        data.materials().iter().for_each(|m| _ = flat.add_material(*m).unwrap());
        data.flattened().iter().for_each(|m| _ = flat.add_mesh(m.clone()).unwrap());
        data = flat;
    }
    data.add_light(lamp).unwrap();
    data
}

#[test]
fn instances_have_the_light_of_copies_each_its_own() {
    let desc = LightmapDesc { texels_per_unit: 16.0, ..Default::default() };
    let bake = |threads, copies| {
        let mut map = Lightmap::create(&room_of_balls(threads, copies), &desc, &Progress::none()).unwrap();
        map.bake(&BakeParams::default(), &Progress::none()).unwrap();
        map
    };
    let (instances, copies) = (bake(2, false), bake(2, true));
    assert_same_bits(&bits(&instances), &bits(&bake(1, false)), "one thread");
    let scene = instances.scene();
    assert_eq!((scene.instances().len(), copies.scene().instances().len()), (5, 0));
    let (mut random, mut squares, mut sum) = (Random::new(4, 0), 0.0, 0.0);
    let mut on_balls = 0;
    for _ in 0..2000 {
        let place = Place::random(scene, &mut random);
        let [a, b] = [&instances, &copies].map(|map| place.sample(map, Layer::Combined));
        squares += (a[0] - b[0]).powi(2);
        sum += b[0];
        on_balls += u32::from(scene.locate(place.triangle).0 > 1);
    }
    let error = (squares / 2000.0).sqrt() / (sum / 2000.0);
    println!("instances against copies: {:.2} % RMS, {on_balls} of 2000 points on balls", 100.0 * error);
    // Their charts differ, and so do noise and blur: as much as two seeds of one scene do (2 %).
    assert!(error < 0.04 && on_balls > 200, "{error}");
    let tracer = PathTracer::new(scene);
    let (mut light, mut truth) = (0.0, 0.0);
    for _ in 0..100 {
        let place = Place::random_on(scene.first_triangle(2) + (900.0 * random.uniform()) as u32, &mut random);
        light += place.sample(&instances, Layer::Combined)[0];
        truth += tracer.irradiance(&place.point(scene), 512, 0, 5).total()[0];
    }
    println!("light of the first ball: {light:.2}, by paths {truth:.2}");
    assert!((light / truth - 1.0).abs() < 0.04, "{light} {truth}");
}

#[test]
fn instances_that_share_light_show_that_of_one() {
    let desc = LightmapDesc { texels_per_unit: 16.0, ..Default::default() };
    let shared = |shared: &[(u32, u32)], threads| {
        let mut data = described_balls(false);
        shared.iter().for_each(|&(instance, of)| data.share_light(instance, of).unwrap());
        let scene = Scene::commit(&device(threads, None), data, &BuildOptions::default(), &Progress::none());
        let mut map = Lightmap::create(&scene.map_err(|e| e.1).unwrap(), &desc, &Progress::none()).unwrap();
        map.bake(&BakeParams::default(), &Progress::none()).unwrap();
        map
    };
    // Two balls beside one another; and the flattened one, whose charts are of another shape.
    let (some, alone) = (shared(&[(2, 1), (4, 0)], 2), shared(&[], 2));
    assert_same_bits(&bits(&some), &bits(&shared(&[(2, 1), (4, 0)], 1)), "one thread");
    assert!(some.plan_text().contains("left out: texels of 2 instances"));
    assert!(some.info().texels < alone.info().texels);
    let scene = some.scene();
    let (mut random, mut squares, mut sum) = (Random::new(4, 0), 0.0, 0.0);
    for (instance, of) in [(2, 1), (4, 0)] {
        let [first, shown] = [instance, of].map(|i| scene.first_triangle(2 + i));
        assert_eq!(some.instance_uvs(instance).unwrap(), some.instance_uvs(of).unwrap());
        for t in (0..scene.triangles_of(2).len() as u32).step_by(5) {
            let [a, b] = [first, shown].map(|f| some.sample(Layer::Combined, f + t, true, 0.3, 0.3));
            assert!(a == b && a[0] > 0.0, "{t}: {a:?} {b:?}");
        }
    }
    // The room has the light that it has with texels for each ball, but for what two of them reflect in places of much the
    // same light.
    for _ in 0..2000 {
        let place = Place::random(scene, &mut random);
        if scene.locate(place.triangle).0 == 0 {
            let [a, b] = [&some, &alone].map(|map| place.sample(map, Layer::Combined));
            squares += (a[0] - b[0]).powi(2);
            sum += b[0];
        }
    }
    let error = (squares / 2000.0).sqrt() / (sum / 2000.0);
    println!("shared light against each its own, on the walls: {:.2} % RMS", 100.0 * error);
    assert!(error < 0.03, "{error}");
    // A layout and a scene file say who shows whose light.
    let folder = std::env::temp_dir().join(format!("bakelite-shared-light-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let [layout, file] = ["layout", "scene"].map(|name| folder.join(name));
    some.save_layout(&layout, &Progress::none()).unwrap();
    scene.save(&file, &Progress::none()).unwrap();
    let opened = Scene::open(&device(2, None), &file, &Default::default(), &Progress::none()).unwrap();
    assert_eq!((0..5).map(|i| opened.light_of_instance(i)).collect::<Vec<_>>(), [0, 1, 1, 3, 0]);
    let loaded = Lightmap::load_layout(&opened, &desc, &layout, &Progress::none()).unwrap();
    assert_eq!(loaded.instance_uvs(2).unwrap(), some.instance_uvs(1).unwrap());
    assert!(Lightmap::load_layout(alone.scene(), &desc, &layout, &Progress::none()).is_err());
    std::fs::remove_dir_all(&folder).unwrap();
}

/// The Cornell box, whose front is open, in the light of a sky with an image and of a low sun with a disc.
fn cornell_in_the_open() -> Arc<Scene> {
    let mut data = builtin("cornell").unwrap();
    for i in 0..data.lights().len() as u32 {
        data.set_light(i, Light::Point { position: Vec3::ZERO, intensity: [0.0; 3] }).unwrap();
    }
    let rgb = (0..16 * 8).map(|i| [0.2, 1.0 + (i % 5) as f32, if i == 70 { 300.0 } else { 0.5 }]).collect();
    let environment = data.add_environment(Environment::new(16, 8, rgb).unwrap());
    data.add_light(Light::Sky { radiance: [1.0, 0.5, 0.7], environment, up: Vec3::Y, rotation: 0.4 }).unwrap();
    let (lower, upper) = data
        .meshes()
        .iter()
        .flat_map(|m| &m.positions)
        .fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(l, u), &p| (l.min(p), u.max(p)));
    // Into the box from wherever it is open.
    let scene = Scene::commit(&device(0, None), data.clone(), &BuildOptions::default(), &Progress::none());
    let scene = scene.map_err(|e| e.1).unwrap();
    let middle = 0.5 * (lower + upper);
    let is_open = |d: &Vec3| !scene.occluded(&Ray::new(middle, -*d));
    let into = [Vec3::X, Vec3::NEG_X, Vec3::Y, Vec3::Z, Vec3::NEG_Z].into_iter().find(is_open).unwrap();
    let direction = into + Vec3::new(0.2, -0.3, 0.15);
    data.add_light(Light::Directional { direction, irradiance: [6.0, 5.0, 4.0], angular_radius: 0.08 }).unwrap();
    Scene::commit(&device(0, None), data, &BuildOptions::default(), &Progress::none()).map_err(|e| e.1).unwrap()
}

#[test]
fn a_room_with_an_open_front_under_sky_and_sun_agrees_with_the_path_tracer() {
    let scene = cornell_in_the_open();
    let mut map = Lightmap::create(&scene, &LightmapDesc::default(), &Progress::none()).unwrap();
    let params = BakeParams { direct_samples: 64, ..Default::default() };
    let stats = map.bake(&params, &Progress::none()).unwrap();
    assert_eq!(stats.left_out & (left_out::SKY | left_out::SUN_DISC), 0);
    assert_ne!(stats.left_out & left_out::MANY_LIGHTS, 0);
    let tracer = PathTracer::new(&scene);
    let mut random = Random::new(77, 0);
    let mut places = Vec::new();
    while places.len() < 150 {
        let place = Place::random(&scene, &mut random);
        if tracer.irradiance(&place.point(&scene), 256, 0, 0).total()[0] > 0.0 {
            places.push(place);
        }
    }
    let points: Vec<SurfacePoint> = places.iter().map(|p| p.point(&scene)).collect();
    // Its noise is far below what is allowed.
    let reference = tracer.irradiance_many(scene.device(), &points, CORNELL_SAMPLES / 4, 1, &Progress::none()).unwrap();
    for (layer, expected) in [
        (Layer::Direct, (|e: &Irradiance| e.direct) as fn(&Irradiance) -> [f64; 3]),
        (Layer::Indirect, |e| e.indirect),
        (Layer::Combined, |e| e.total()),
    ] {
        let error = |(place, e): (&Place, &Irradiance)| {
            let (baked, expected) = (place.sample(&map, layer), expected(e));
            std::array::from_fn(|c| baked[c] - expected[c])
        };
        let errors: Vec<[f64; 3]> = places.iter().zip(&reference).map(error).collect();
        let values: Vec<[f64; 3]> = reference.iter().map(expected).collect();
        let (bias, rmse) = (mean(&errors) / mean(&values), mean(&squares(&errors)).sqrt() / mean(&values));
        println!("{layer:?}: bias {:.2} %, RMSE {:.2} %", 100.0 * bias, 100.0 * rmse);
        // What is left is the edge of the patch of sun, within a texel.
        assert!(bias.abs() < 0.015 && rmse < 0.08, "{layer:?}: bias {bias}, RMSE {rmse}");
    }
}

fn squares(values: &[[f64; 3]]) -> Vec<[f64; 3]> {
    values.iter().map(|v| v.map(|x| x * x)).collect()
}

#[test]
fn a_furnace_glows_at_its_emission_over_one_minus_its_reflectance() {
    let map = baked("furnace");
    let scene = map.scene();
    let expected = PI / (1.0 - 0.5);
    let mut random = Random::new(3, 0);
    let errors: Vec<[f64; 3]> = (0..scene.triangle_count())
        .flat_map(|t| (0..50).map(move |_| t))
        .map(|t| Place::random_on(t, &mut random).sample(&map, Layer::Combined).map(|e| e / expected - 1.0))
        .collect();
    let worst = errors.iter().flatten().fold(0.0, |w: f64, e| w.max(e.abs()));
    let (bias, rmse) = (mean(&errors), mean(&squares(&errors)).sqrt());
    println!("bias {:.2} %, RMSE {:.2} %, worst {:.2} %", 100.0 * bias, 100.0 * rmse, 100.0 * worst);
    assert!(rmse <= 0.02, "the relative RMSE is {rmse}");
    assert!(bias.abs() <= 0.01, "the bias is {bias}");
}

/// The mean over the surface of a furnace of some albedo by E/(1 − albedo), less 1, with photons thrown by some seed.
fn furnace_error(albedo: f32, photon_count: u64, seed: u64, page_size: u32) -> f64 {
    let mut data = SceneData::new();
    let walls = Material { albedo: [albedo; 3], emission: [1.0; 3], ..Default::default() };
    let walls = data.add_material(walls).unwrap();
    let mut cube = MeshBuilder::new();
    cube.box_(Vec3::ZERO, Vec3::ONE, true, walls);
    data.add_mesh(cube.finish()).unwrap();
    let scene = Scene::commit(&device(0, None), data, &BuildOptions::default(), &Progress::none());
    let scene = scene.map_err(|(_, e)| e).unwrap();
    let desc = LightmapDesc { page_size, ..Default::default() };
    let mut map = Lightmap::create(&scene, &desc, &Progress::none()).unwrap();
    map.bake(&BakeParams { photon_count, seed, ..Default::default() }, &Progress::none()).unwrap();
    let mut random = Random::new(3, 0);
    let values: Vec<[f64; 3]> = (0..scene.triangle_count())
        .flat_map(|t| (0..500).map(move |_| t))
        .map(|t| Place::random_on(t, &mut random).sample(&map, Layer::Combined))
        .collect();
    mean(&values) * (1.0 - albedo as f64) / PI - 1.0
}

#[test]
fn more_photons_are_never_worse_in_a_furnace() {
    for (albedo, photons) in [(0.5, 10_000), (0.9, 400_000), (0.98, 10_000), (0.98, 100_000)] {
        for seed in 0..2 {
            let error = furnace_error(albedo, photons, seed, 128);
            println!("albedo {albedo}, {photons} photons, seed {seed}: {:.3} %", 100.0 * error);
            assert!(error.abs() <= 0.005, "albedo {albedo}, {photons} photons, seed {seed}: {error}");
        }
    }
}

/// The table of docs/accuracy.md; `BAKELITE_FURNACE_PHOTONS` (10^6) are the most and `BAKELITE_FURNACE_LEAST` (10^4) the
/// fewest, `BAKELITE_FURNACE_ALBEDO` (all) is the only albedo.
#[test]
#[ignore = "takes minutes, and says more than pass or fail"]
fn furnaces_of_all_albedos_with_all_numbers_of_photons() {
    let number = |name, default| std::env::var(name).map_or(default, |n| n.parse().unwrap());
    let photons = number("BAKELITE_FURNACE_LEAST", 10_000)..=number("BAKELITE_FURNACE_PHOTONS", 1_000_000);
    let only: Option<f32> = std::env::var("BAKELITE_FURNACE_ALBEDO").ok().map(|a| a.parse().unwrap());
    println!("| albedo | photons | mean error of 6 seeds, % | greatest, % | seconds |\n|---|---|---|---|---|");
    let mut worst = 0.0f64;
    for albedo in [0.5, 0.8, 0.9, 0.95, 0.98].into_iter().filter(|&a| only.is_none_or(|only| a == only)) {
        for photons in [10_000, 100_000, 1_000_000, 10_000_000].into_iter().filter(|n| photons.contains(n)) {
            let start = Instant::now();
            let error = |seed| {
                let error = furnace_error(albedo, photons, seed, 128);
                eprintln!("albedo {albedo}, {photons} photons, seed {seed}: {:.3} %", 100.0 * error);
                error
            };
            let errors: Vec<f64> = (0..6).map(error).collect();
            let greatest = errors.iter().fold(0.0f64, |m, e| m.max(e.abs()));
            let seconds = start.elapsed().as_secs_f64() / 6.0;
            let mean = errors.iter().sum::<f64>() / 6.0;
            println!("| {albedo} | {photons} | {:.3} | {:.3} | {seconds:.1} |", 100.0 * mean, 100.0 * greatest);
            worst = worst.max(greatest);
        }
    }
    assert!(worst <= 0.005, "{worst}");
}

#[test]
fn no_light_enters_a_sealed_box() {
    let map = baked("sealed");
    let scene = map.scene();
    let inside = scene.first_triangle(1)..scene.first_triangle(2);
    let mut lit = 0;
    for page in 0..map.info().page_count {
        let LayerData::Rgb(light) = map.read(page, Layer::Combined).unwrap() else { panic!("light is RGB") };
        let LayerData::Integer(triangles) = map.read(page, Layer::Triangle).unwrap() else { panic!("numbers") };
        for (light, triangle) in light.iter().zip(&triangles) {
            if inside.contains(triangle) {
                assert_eq!(*light, [0.0; 3], "on triangle {triangle}");
            } else if light[0] > 0.0 {
                lit += 1;
            }
        }
    }
    assert!(lit > 1000, "the room is lit, but only {lit} texels are");
    let mut random = Random::new(4, 0);
    for triangle in inside {
        for _ in 0..100 {
            assert_eq!(Place::random_on(triangle, &mut random).sample(&map, Layer::Combined), [0.0; 3]);
        }
    }
}

/// Settings that bake in a moment and still run every stage.
fn small() -> (LightmapDesc, BakeParams) {
    let desc = LightmapDesc { texels_per_unit: 8.0, page_size: 256, ..Default::default() };
    (desc, BakeParams { photon_count: 20_000, gather_rays: 32, direct_samples: 4, ..Default::default() })
}

fn small_cornell(threads: usize, isa: Option<Isa>) -> Lightmap {
    let scene = commit("cornell", &device(threads, isa));
    Lightmap::create(&scene, &small().0, &Progress::none()).unwrap()
}

/// The bits of every layer of light on every page.
fn bits(map: &Lightmap) -> Vec<u32> {
    let layers = [Layer::Combined, Layer::Indirect, Layer::Direct, Layer::Radiance, Layer::Validity];
    let mut all = Vec::new();
    for page in 0..map.info().page_count {
        for layer in layers {
            match map.read(page, layer).unwrap() {
                LayerData::Rgb(v) => all.extend(v.iter().flatten().map(|x| x.to_bits())),
                LayerData::Scalar(v) => all.extend(v.iter().map(|x| x.to_bits())),
                LayerData::Integer(v) => all.extend(v),
            }
        }
    }
    assert!(all.iter().any(|&b| b != 0), "all layers are empty");
    all
}

/// Compares bits; says how many differ, not which million numbers they are.
#[track_caller]
fn assert_same_bits(a: &[u32], b: &[u32], what: &str) {
    assert_eq!(a.len(), b.len(), "{what}");
    let different = a.iter().zip(b).filter(|(a, b)| a != b).count();
    assert!(different == 0, "{what}: {different} of {} numbers differ", a.len());
}

#[test]
fn the_number_of_threads_changes_no_bit_on_any_isa() {
    for isa in Isa::available() {
        let bake = |threads| {
            let mut map = small_cornell(threads, Some(isa));
            map.bake(&small().1, &Progress::none()).unwrap();
            bits(&map)
        };
        let one = bake(1);
        for threads in [2, 7] {
            assert_same_bits(&one, &bake(threads), &format!("{} with {threads} threads", isa.name()));
        }
    }
}

#[test]
fn a_bake_cancelled_anywhere_can_be_repeated_and_gives_the_same_bits() {
    let params = small().1;
    let mut map = small_cornell(2, None);
    let mut stages: Vec<String> = Vec::new();
    let watch = Progress::new(|_, stage| {
        if stages.last().is_none_or(|last| last != stage) {
            stages.push(stage.to_string());
        }
        true
    });
    map.bake(&params, &watch).unwrap();
    drop(watch);
    let undisturbed = bits(&map);
    println!("stages: {}", stages.join(", "));
    assert!(stages.len() >= 4, "photons, radiance, gather and direct light at least: {stages:?}");

    for name in &stages {
        let mut map = small_cornell(2, None);
        let cancel = Progress::new(|_, stage| stage != name);
        assert_eq!(map.bake(&params, &cancel).err(), Some(Error::Cancelled), "in {name}");
        map.bake(&params, &Progress::none()).unwrap();
        assert_same_bits(&undisturbed, &bits(&map), &format!("after a cancel in {name}"));
    }
    // In the midst of stages, and on a light map whose earlier bake must survive.
    for percent in (5..100).step_by(10) {
        let cancel = Progress::new(|fraction, _| fraction * 100.0 < percent as f32);
        assert_eq!(map.bake(&params, &cancel).err(), Some(Error::Cancelled), "at {percent} %");
        assert_same_bits(&undisturbed, &bits(&map), &format!("kept after a cancel at {percent} %"));
    }
    map.bake(&params, &Progress::none()).unwrap();
    assert_same_bits(&undisturbed, &bits(&map), "after all these cancels");
}

#[test]
fn creating_a_light_map_can_be_cancelled() {
    let scene = commit("cornell", &device(2, None));
    let cancel = Progress::new(|_, _| false);
    assert_eq!(Lightmap::create(&scene, &small().0, &cancel).err(), Some(Error::Cancelled));
}

/// Cancels a call at its first report, then at its second, and so on until it makes no more, and at the start of each
/// of `stages`.
///
/// The second cannot be left to the first: how often a stage is reported, so which report is the first of the next one,
/// depends on the time that a call takes.
fn cancel_everywhere(stages: &[&str], mut call: impl FnMut(&Progress) -> Result<(), Error>) {
    for last in 0.. {
        let mut reports = 0;
        let result = call(&Progress::new(|_, name| {
            // It comes only if the threads are slow to begin the first stage, so that it would be counted in some
            // calls.
            if name == "start" {
                return true;
            }
            reports += 1;
            reports <= last
        }));
        match result {
            Err(Error::Cancelled) => assert_eq!(reports, last + 1, "no report follows a refusal"),
            Ok(()) if reports <= last => break,
            other => panic!("{other:?} when the report {last} of {reports} refused"),
        }
    }
    for stage in stages {
        let cancelled = call(&Progress::new(|_, name| name != *stage)).err();
        assert_eq!(cancelled, Some(Error::Cancelled), "in the stage {stage}");
    }
}

#[test]
fn every_call_can_be_cancelled_at_every_report() {
    let device = device(2, None);
    let mut data = Some(builtin("cornell").unwrap());
    cancel_everywhere(&["bvh"], |progress| {
        let data = data.take().map_or_else(|| builtin("cornell"), Ok)?;
        Scene::commit(&device, data, &BuildOptions::default(), progress).map(drop).map_err(|e| e.1)
    });
    let scene = commit("cornell", &device);
    let photons = PhotonParams { photon_count: 50_000, ..Default::default() };
    cancel_everywhere(&["photons", "photon grid"], |progress| PhotonMap::trace(&scene, &photons, progress).map(drop));
    let map = PhotonMap::trace(&scene, &photons, &Progress::none()).unwrap();
    let (points, normals) = (vec![[0.5; 3]; 1000], vec![[0.0, 1.0, 0.0]; 1000]);
    let mut out = vec![[0.0; 3]; 1000];
    cancel_everywhere(&["photon estimates"], |progress| map.estimate_many(&points, &normals, &mut out, progress));
    cancel_everywhere(&["unwrap", "texels"], |progress| Lightmap::create(&scene, &small().0, progress).map(drop));
    let mut map = small_cornell(2, None);
    let stages = ["photons", "photon grid", "radiance", "upsampling", "gather", "blur", "direct", "seams"];
    cancel_everywhere(&stages, |progress| map.bake(&small().1, progress).map(drop));
}

#[test]
fn reports_are_made_on_the_calling_thread_alone() {
    let this = std::thread::current().id();
    let same_thread = |_: f32, _: &str| std::thread::current().id() == this;
    let device = device(2, None);
    let data = builtin("cornell").unwrap();
    let scene = Scene::commit(&device, data, &BuildOptions::default(), &Progress::new(same_thread)).map_err(|e| e.1);
    let scene = scene.unwrap();
    let mut map = Lightmap::create(&scene, &small().0, &Progress::new(same_thread)).unwrap();
    map.bake(&small().1, &Progress::new(same_thread)).unwrap();
    PhotonMap::trace(&scene, &PhotonParams::default(), &Progress::new(same_thread)).unwrap();
}

#[test]
fn a_callback_may_wait_for_the_threads_of_the_call_that_it_is_in() {
    let scene = commit("cornell", &device(1, None));
    let mut map = Lightmap::create(&scene, &small().0, &Progress::none()).unwrap();
    let device = scene.device().clone();
    let mut waited = 0;
    map.bake(
        &small().1,
        &Progress::new(|_, _| {
            device.install(|| {
                waited += 1;
                true
            })
        }),
    )
    .unwrap();
    assert!(waited > 4);
}

#[test]
fn shards_of_texels_combine_to_the_same_bits() {
    let params = small().1;
    let mut whole = small_cornell(2, None);
    whole.bake(&params, &Progress::none()).unwrap();
    let texels = whole.info().texels;
    // Cuts that fall into the midst of charts; the last shard first.
    let cuts = [0, texels / 7, texels / 2 + 3, texels];
    let mut parts = small_cornell(2, None);
    for range in cuts.windows(2).rev() {
        let shard = BakeParams { texel_begin: range[0], texel_end: range[1], ..params };
        parts.bake(&shard, &Progress::none()).unwrap();
    }
    assert_same_bits(&bits(&whole), &bits(&parts), "three shards");
}

#[test]
fn with_both_sides_neither_threads_nor_shards_change_a_bit() {
    let params = small().1;
    let bake = |threads| {
        let mut map = divided(threads, true);
        map.bake(&params, &Progress::none()).unwrap();
        bits(&map)
    };
    let one = bake(1);
    assert_same_bits(&one, &bake(7), "7 threads");
    let mut parts = divided(2, true);
    let (texels, backs) = (parts.info().texels, parts.info().back_texels);
    // One shard has backs alone.
    let cuts = [0, texels / 3, texels - backs - 5, texels - backs / 2, texels];
    for range in cuts.windows(2).rev() {
        let shard = BakeParams { texel_begin: range[0], texel_end: range[1], ..params };
        parts.bake(&shard, &Progress::none()).unwrap();
    }
    assert_same_bits(&one, &bits(&parts), "four shards");
}
