//! Bakes of textured surfaces, grates and stained glass against the f64 path tracer, which looks textures up
//! by itself, and against closed forms.

use bakelite::bvh::BuildOptions;
use bakelite::lightmap::plan::left_out;
use bakelite::lightmap::{BakeParams, BakeStats, Layer, Lightmap, LightmapDesc};
use bakelite::photon::{PhotonMap, PhotonParams};
use bakelite::reference::{Irradiance, PathTracer, Random, SurfacePoint};
use bakelite::scene::{MeshMaterials, NONE, Texture};
use bakelite::{Device, DeviceOptions, Light, Material, Mesh, Progress, Scene, SceneData};
use glam::{Vec2, Vec3};
use std::sync::Arc;

/// At which light is compared.
const PLACES: u32 = 60;

/// Paths per place and half of the truth.
const SAMPLES: u32 = 16 * 12 * 12;

fn commit(data: SceneData, compact: bool) -> Arc<Scene> {
    let device = Device::new(DeviceOptions::default()).unwrap();
    let build = BuildOptions { compact, ..Default::default() };
    Scene::commit(&device, data, &build, &Progress::none()).map_err(|(_, e)| e).unwrap()
}

/// `density`: texels per unit, and gather texels, of which the former are a multiple.
fn bake(scene: &Arc<Scene>, density: [u32; 2], params: &BakeParams) -> (Lightmap, BakeStats) {
    let [texels, gather] = density;
    let (texels_per_unit, gather_divisor) = (texels as f32, texels / gather);
    let desc = LightmapDesc { texels_per_unit, gather_divisor, radiance_divisor: 2, ..Default::default() };
    let mut map = Lightmap::create(scene, &desc, &Progress::none()).unwrap();
    let stats = map.bake(params, &Progress::none()).unwrap();
    (map, stats)
}

/// A parallelogram that faces edge_u × edge_v; texture coordinates from 0 to `repeats`.
fn sheet(corner: Vec3, edge_u: Vec3, edge_v: Vec3, repeats: f32, material: u32) -> Mesh {
    let places = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]].map(Vec2::from);
    Mesh {
        positions: places.iter().map(|p| corner + edge_u * p.x + edge_v * p.y).collect(),
        uvs: places.iter().map(|p| *p * repeats).collect(),
        indices: vec![[0, 1, 2], [0, 2, 3]].into(),
        materials: MeshMaterials::One(material),
        ..Default::default()
    }
}

/// The inside of a box: floor, ceiling, and the walls at x = 0, x = size, y = 0 and y = size, as meshes 0 to 5.
fn room(data: &mut SceneData, size: Vec3, floor: u32, walls: u32) {
    let (x, y, z) = (Vec3::X * size.x, Vec3::Y * size.y, Vec3::Z * size.z);
    for (corner, u, v, material) in [
        (Vec3::ZERO, x, y, floor),
        (z, y, x, walls),
        (Vec3::ZERO, y, z, walls),
        (x, z, y, walls),
        (Vec3::ZERO, z, x, walls),
        (y, x, z, walls),
    ] {
        data.add_mesh(sheet(corner, u, v, 4.0, material)).unwrap();
    }
}

/// Red and pale green squares of 4 × 4 texels.
fn chequer() -> Texture {
    let (red, green) = ([230, 20, 20, 255], [150, 250, 150, 255]);
    let color = |(x, y): (u32, u32)| if (x / 4 + y / 4) % 2 == 0 { red } else { green };
    Texture { width: 8, height: 8, rgba8: (0..64).map(|i| color((i % 8, i / 8))).collect() }
}

/// Bars along v: half of the surface.
fn bars() -> Texture {
    Texture { width: 2, height: 1, rgba8: vec![[255, 255, 255, 0], [255; 4]] }
}

/// True light at random places of a mesh: two independent halves, which tell its noise.
struct Truth {
    places: Vec<(u32, f64, f64)>,
    halves: [Vec<Irradiance>; 2],
}

impl Truth {
    fn new(scene: &Arc<Scene>, mesh: u32) -> Truth {
        let tracer = PathTracer::new(scene);
        let mut random = Random::new(11, mesh as u64);
        let first = scene.first_triangle(mesh);
        let places: Vec<(u32, f64, f64)> = (0..PLACES)
            .map(|i| {
                let [a, b] = random.square();
                let (u, v) = if a + b > 1.0 { (1.0 - a, 1.0 - b) } else { (a, b) };
                (first + i % 2, u, v)
            })
            .collect();
        let points: Vec<_> = places.iter().map(|&(t, u, v)| SurfacePoint::on_triangle(scene, t, u, v)).collect();
        let half = |seed| tracer.irradiance_many(scene.device(), &points, SAMPLES, seed, &Progress::none()).unwrap();
        Truth { places, halves: [half(5), half(6)] }
    }

    /// Relative difference of a bake's mean, which must be less than `bias`, and the root of the mean square
    /// of the differences by the mean, less than `rms`. The noise of the truth is not part of the latter.
    #[track_caller]
    fn assert_close(&self, what: &str, map: &Lightmap, layer: Layer, bias: f64, rms: f64) {
        let (mut baked, mut truth, mut squares, mut noise) = (0.0, 0.0, 0.0, 0.0);
        for (i, &(t, u, v)) in self.places.iter().enumerate() {
            let x = map.sample(layer, t, true, u as f32, v as f32);
            let [a, b] = [0, 1].map(|half| match layer {
                Layer::Indirect => self.halves[half][i].indirect,
                Layer::Direct => self.halves[half][i].direct,
                _ => self.halves[half][i].total(),
            });
            for c in 0..3 {
                let x = x[c] as f64;
                baked += x;
                truth += 0.5 * (a[c] + b[c]);
                squares += (x - a[c]) * (x - b[c]);
                noise += 0.25 * (a[c] - b[c]).powi(2);
            }
        }
        let n = 3.0 * self.places.len() as f64;
        let (got, noise) = (baked / truth - 1.0, noise.sqrt() / truth);
        let got_rms = (squares / n).max(0.0).sqrt() / (truth / n);
        println!("{what}: bias {got:.4} ± {noise:.4}, RMS {got_rms:.4}");
        assert!(noise < 0.2 * bias && got.abs() < bias, "{what}: bias {got} ± {noise}");
        assert!(got_rms < rms, "{what}: RMS {got_rms}");
    }
}

fn production() -> BakeParams {
    BakeParams { photon_count: 400_000, gather_rays: 256, ..Default::default() }
}

fn lamp(data: &mut SceneData, position: Vec3) {
    data.add_light(Light::Point { position, intensity: [10.0; 3] }).unwrap();
}

#[test]
fn a_chequered_floor_colors_the_walls_as_in_the_path_tracer() {
    for textured in [true, false] {
        let mut data = SceneData::new();
        let albedo_texture = data.add_texture(chequer()).unwrap();
        let tiles = Material { albedo: [0.9; 3], albedo_texture, ..Default::default() };
        let floor = data.add_material(tiles).unwrap();
        // Without texture coordinates the factor counts alone: the same floor, but white.
        let walls = data.add_material(Material { albedo: [0.6; 3], ..Default::default() }).unwrap();
        room(&mut data, Vec3::new(2.0, 2.0, 1.5), floor, walls);
        lamp(&mut data, Vec3::new(0.8, 1.1, 1.1));
        if !textured {
            let mut other = SceneData::new();
            other.add_texture(chequer()).unwrap();
            for m in data.materials() {
                other.add_material(*m).unwrap();
            }
            for mesh in data.meshes() {
                other.add_mesh(Mesh { uvs: Vec::new().into(), ..mesh.clone() }).unwrap();
            }
            lamp(&mut other, Vec3::new(0.8, 1.1, 1.1));
            data = other;
        }
        let scene = commit(data, false);
        let (map, stats) = bake(&scene, [24, 24], &production());
        assert_eq!(stats.left_out & left_out::TEXTURES == 0, textured);
        for mesh in [2, 5] {
            let what = format!("wall {mesh}, textured {textured}");
            Truth::new(&scene, mesh).assert_close(&what, &map, Layer::Indirect, 0.004, 0.02);
        }
        // Red light: the floor's mean albedo is (0.53, 0.43, 0.15) with the texture.
        let wall = map.sample(Layer::Indirect, scene.first_triangle(2), true, 0.3, 0.3);
        assert_eq!(wall[0] > 1.3 * wall[2], textured, "{wall:?}");
        // Outgoing radiance shows the tiles.
        let texel = |u: f32, v: f32| map.sample(Layer::Radiance, scene.first_triangle(0), true, u, v);
        let tile = texel(0.5 + 1.0 / 32.0, 1.0 / 32.0);
        assert_eq!(tile[0] > 3.0 * tile[1], textured, "{tile:?}");
    }
}

/// A room with a sheet half-way up, above a black floor or not, and a lamp above the sheet.
fn divided_room(sheet_material: impl FnOnce(&mut SceneData) -> Material, faces_up: bool) -> SceneData {
    let mut data = SceneData::new();
    let grey = data.add_material(Material { albedo: [0.7, 0.6, 0.5], ..Default::default() }).unwrap();
    let material = sheet_material(&mut data);
    let divider = data.add_material(material).unwrap();
    room(&mut data, Vec3::new(2.0, 2.0, 2.0), grey, grey);
    let (u, v) = if faces_up { (Vec3::X, Vec3::Y) } else { (Vec3::Y, Vec3::X) };
    data.add_mesh(sheet(Vec3::new(0.0, 0.0, 1.0), 2.0 * u, 2.0 * v, 4.0, divider)).unwrap();
    lamp(&mut data, Vec3::new(1.1, 0.9, 1.7));
    data
}

fn grate(data: &mut SceneData) -> Material {
    let albedo_texture = data.add_texture(bars()).unwrap();
    Material { albedo: [0.8; 3], albedo_texture, alpha_cutoff: 0.5, ..Default::default() }
}

#[test]
fn a_grate_casts_its_shadow_and_lets_photons_through() {
    // Two-sided; one-sided facing the lamp; one-sided facing away: from below it is lit or black.
    for (two_sided, faces_up) in [(true, true), (false, true), (false, false)] {
        let data = divided_room(|d| Material { two_sided, ..grate(d) }, faces_up);
        let scene = commit(data, !two_sided);
        let (map, stats) = bake(&scene, [48, 24], &production());
        assert_eq!(stats.left_out & left_out::CUTOUTS, 0);
        // The shadow: straight lines from the lamp to the floor, holes where the fraction of u, twice the
        // distance along the sheet's first edge, is less than 1/2.
        let lamp = Vec3::new(1.1, 0.9, 1.7);
        let (mut lit, mut dark) = (0, 0);
        let mut random = Random::new(3, 0);
        while lit < 100 || dark < 100 {
            let [a, b] = random.square().map(|x| x as f32);
            let (u, v) = if a + b > 1.0 { (1.0 - a, 1.0 - b) } else { (a, b) };
            let point = SurfacePoint::on_triangle(&scene, 0, u as f64, v as f64).position.as_vec3();
            let at = lamp + (point - lamp) * (0.7 / 1.7);
            let along = if faces_up { at.x } else { at.y } * 2.0;
            if (2.0 * along - (2.0 * along).round()).abs() < 0.12 {
                continue;
            }
            let way = lamp - point;
            let expected = 10.0 * way.z / way.length().powi(3);
            let e = map.sample(Layer::Direct, 0, true, u, v)[1];
            if along - along.floor() < 0.5 {
                assert!((e - expected).abs() < 0.02 * expected, "{point}: {e} is not {expected}");
                lit += 1;
            } else {
                assert_eq!(e, 0.0, "{point}");
                dark += 1;
            }
        }
        let what = format!("two-sided {two_sided}, up {faces_up}");
        for (name, mesh) in [("floor", 0), ("ceiling", 1)] {
            let truth = Truth::new(&scene, mesh);
            truth.assert_close(&format!("{name}, {what}"), &map, Layer::Indirect, 0.01, 0.04);
        }
        assert_energy(&scene);
    }
}

/// Power absorbed, escaped and cut off is the power emitted.
fn assert_energy(scene: &Arc<Scene>) {
    let params = PhotonParams { photon_count: 200_000, ..Default::default() };
    let map = PhotonMap::trace(scene, &params, &Progress::none()).unwrap();
    let s = map.stats();
    for c in 0..3 {
        let out = s.absorbed_power[c] + s.escaped_power[c] + s.truncated_power[c];
        assert!((out / s.emitted_power[c] - 1.0).abs() < 0.01, "{out} W of {} W", s.emitted_power[c]);
    }
}

const GLASS: [f32; 3] = [0.8, 0.1, 0.1];

#[test]
fn direct_light_is_multiplied_with_what_each_pane_transmits() {
    // Lights of all kinds that have no noise, above panes that all their rays pass.
    let scene = |panes: &[f32]| {
        let mut data = SceneData::new();
        let grey = data.add_material(Material::default()).unwrap();
        let glass = Material { albedo: [0.1; 3], transmission: GLASS, two_sided: true, ..Default::default() };
        let glass = data.add_material(glass).unwrap();
        data.add_mesh(sheet(Vec3::ZERO, Vec3::X, Vec3::Y, 1.0, grey)).unwrap();
        // Far from all light, so that all scenes are of one size and rays start as far from the floor.
        for corner in [Vec3::splat(-40.0), Vec3::splat(40.0)] {
            data.add_mesh(sheet(corner, Vec3::X, Vec3::Y, 1.0, grey)).unwrap();
        }
        for &z in panes {
            data.add_mesh(sheet(Vec3::new(-1.0, -1.0, z), 3.0 * Vec3::X, 3.0 * Vec3::Y, 1.0, glass)).unwrap();
        }
        let position = Vec3::new(0.3, 0.4, 4.0);
        let direction = Vec3::new(0.2, 0.1, -1.0);
        lamp(&mut data, position);
        data.add_light(Light::Directional { direction, irradiance: [1.0, 2.0, 3.0], angular_radius: 0.0 }).unwrap();
        data.add_light(Light::Spot { position, direction, inner: 0.3, outer: 1.0, intensity: [5.0; 3] }).unwrap();
        let (edge_u, edge_v) = (Vec3::Y, Vec3::X);
        data.add_light(Light::Rect { position, edge_u, edge_v, radiance: [3.0; 3] }).unwrap();
        commit(data, false)
    };
    let params = BakeParams { gather_rays: 0, ..Default::default() };
    let bare = scene(&[]);
    let (bare_map, stats) = bake(&bare, [32, 32], &params);
    assert_ne!(stats.left_out & left_out::TRANSMISSION, 0);
    // The last two at one place.
    for panes in [&[1.0][..], &[1.0, 2.0], &[1.5, 1.5]] {
        let (map, stats) = bake(&scene(panes), [32, 32], &params);
        assert_eq!(stats.left_out & left_out::TRANSMISSION, 0);
        for i in 0..200 {
            let (u, v) = (i as f32 / 400.0, (i * 37 % 200) as f32 / 400.0);
            let (e, full) =
                (map.sample(Layer::Direct, i % 2, true, u, v), bare_map.sample(Layer::Direct, i % 2, true, u, v));
            for c in 0..3 {
                let expected = full[c] * GLASS[c].powi(panes.len() as i32);
                assert!((e[c] - expected).abs() <= 2e-6 * expected, "{panes:?} {c}: {} is not {expected}", e[c]);
            }
        }
    }
}

#[test]
fn light_below_stained_glass_is_that_of_the_path_tracer() {
    for (two_sided, faces_up) in [(true, true), (false, true), (false, false)] {
        let glass = |_: &mut SceneData| Material {
            albedo: [0.15, 0.6, 0.3],
            transmission: GLASS.map(|t| t / 2.0),
            two_sided,
            ..Default::default()
        };
        let scene = commit(divided_room(glass, faces_up), two_sided);
        let (map, _) = bake(&scene, [16, 16], &production());
        let what = format!("two-sided {two_sided}, up {faces_up}");
        for (name, mesh) in [("floor", 0), ("ceiling", 1)] {
            let truth = Truth::new(&scene, mesh);
            truth.assert_close(&format!("{name}, {what}"), &map, Layer::Combined, 0.02, 0.04);
            truth.assert_close(&format!("{name}, indirect, {what}"), &map, Layer::Indirect, 0.02, 0.04);
        }
        assert_energy(&scene);
    }
}

#[test]
fn a_lamp_behind_glass_is_direct_light_whether_it_is_met_or_sampled() {
    // The reference finds the emissive lamp both by shadow rays and by chance; the bake by shadow rays alone.
    let mut data = divided_room(
        |_| Material { albedo: [0.1; 3], transmission: [0.7, 0.5, 0.3], two_sided: true, ..Default::default() },
        true,
    );
    let glow = data.add_material(Material { albedo: [0.0; 3], emission: [5.0; 3], ..Default::default() }).unwrap();
    data.add_mesh(sheet(Vec3::new(0.6, 0.6, 1.6), 0.8 * Vec3::Y, 0.8 * Vec3::X, 1.0, glow)).unwrap();
    let scene = commit(data, false);
    let (map, _) = bake(&scene, [16, 16], &BakeParams { direct_samples: 64, ..production() });
    let truth = Truth::new(&scene, 0);
    truth.assert_close("direct", &map, Layer::Direct, 0.01, 0.02);
    truth.assert_close("combined", &map, Layer::Combined, 0.01, 0.02);
}

#[test]
fn a_scene_that_uses_none_of_it_keeps_and_runs_none_of_it() {
    let plain = |extra: bool| {
        let mut data = SceneData::new();
        let texture = if extra { data.add_texture(bars()).unwrap() } else { NONE };
        // Opaque all over: no holes.
        let white = data.add_texture(Texture { width: 1, height: 1, rgba8: vec![[255; 4]] }).unwrap();
        let grey = data.add_material(Material::default()).unwrap();
        // Materials that no surface has, and a cutoff that nothing reaches.
        let unused = Material { albedo_texture: texture, transmission: [0.5; 3], ..Default::default() };
        data.add_material(unused).unwrap();
        let opaque = Material { albedo_texture: white, alpha_cutoff: 0.5, ..Default::default() };
        let opaque = data.add_material(opaque).unwrap();
        room(&mut data, Vec3::ONE, if extra { opaque } else { grey }, grey);
        lamp(&mut data, Vec3::splat(0.5));
        commit(data, false)
    };
    let bits = left_out::TEXTURES | left_out::CUTOUTS | left_out::TRANSMISSION;
    let params = BakeParams { photon_count: 1000, gather_rays: 16, ..Default::default() };
    let (map, stats) = bake(&plain(false), [8, 8], &params);
    assert_eq!(stats.left_out & bits, bits);
    assert!(map.plan_text().contains("left out: alpha cut-outs (no surface has any)"), "{}", map.plan_text());
    let (map, stats) = bake(&plain(true), [8, 8], &params);
    assert_eq!(stats.left_out & bits, left_out::CUTOUTS | left_out::TRANSMISSION);
    assert!(map.plan_text().contains("runs: albedo textures"), "{}", map.plan_text());
}

/// Nobody can see the floor 1 cm below a carpet: it takes its light from beside the carpet, and gather texels four
/// times as wide as the light map's darken neither. The first texel beside the carpet, whose middle is 5 mm away, is
/// darker, in both maps.
#[test]
fn a_carpet_has_no_dark_rim_and_what_it_covers_shows_the_light_beside_it() {
    let mut data = SceneData::new();
    let grey = data.add_material(Material { albedo: [0.5; 3], two_sided: true, ..Default::default() }).unwrap();
    room(&mut data, Vec3::new(4.0, 4.0, 3.0), grey, grey);
    data.add_mesh(sheet(Vec3::Z * 0.01, Vec3::X * 1.97, Vec3::Y * 4.0, 1.0, grey)).unwrap();
    data.add_light(Light::Point { position: Vec3::new(2.0, 2.0, 2.5), intensity: [10.0; 3] }).unwrap();
    let scene = commit(data, false);
    let params = BakeParams { gather_rays: 256, photon_count: 200_000, stitch: false, ..Default::default() };
    let (fine, coarse) = (bake(&scene, [20, 20], &params).0, bake(&scene, [20, 5], &params).0);
    // The mean along the carpet, of the floor at some distance from the wall at x = 0.
    let mean = |map: &Lightmap, x: f32| {
        let light = |y: f32| {
            let (triangle, u, v) = if y <= x { (0, (x - y) / 4.0, y / 4.0) } else { (1, x / 4.0, (y - x) / 4.0) };
            map.sample(Layer::Indirect, triangle, true, u, v)[0]
        };
        (0..30).map(|j| light(0.5 + 0.1 * j as f32)).sum::<f32>() / 30.0
    };
    let first = mean(&coarse, 1.975) / mean(&fine, 1.975);
    assert!((first - 1.0).abs() < 0.02 && mean(&fine, 1.975) < 0.9 * mean(&fine, 2.1), "{first} in the first texel");
    // The floor's own light changes by less than 0.6 % in 10 cm; so far from the carpet the fine map has no rim either.
    for x in (0..20).map(|i| 0.02 * i as f32) {
        let (beside, below) = (mean(&coarse, 2.025 + x) / mean(&fine, 2.1 + x), mean(&coarse, 1.84 - x));
        assert!((beside - 1.0).abs() < 0.01, "{x} beside the carpet: {beside}");
        // The light of the first texel or, where one below counts as open by chance, of those around it.
        let is_from_beside = below > 0.98 * mean(&fine, 1.975) && below < 1.02 * mean(&fine, 2.1);
        assert!(is_from_beside, "{x} below the carpet: {below}");
    }
}
