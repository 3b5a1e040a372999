//! The photon map as physics, and its manners.

use super::*;
use crate::base::error::Error;
use crate::base::sampling::sobol_2d;
use crate::bvh::BuildOptions;
use crate::device::{Device, DeviceOptions};
use crate::scene::{Light, Material, Mesh, MeshMaterials, SceneData, builtin};
use crate::simd::Isa;
use std::f64::consts::PI;

fn device(num_threads: usize) -> Arc<Device> {
    Device::new(DeviceOptions { num_threads, ..Default::default() }).unwrap()
}

fn commit_on(device: &Arc<Device>, data: SceneData) -> Arc<Scene> {
    Scene::commit(device, data, &BuildOptions::default(), &Progress::none()).map_err(|e| e.1).unwrap()
}

fn trace(scene: &Arc<Scene>, params: PhotonParams) -> PhotonMap {
    PhotonMap::trace(scene, &params, &Progress::none()).unwrap()
}

/// Adds the box between two corners; its front faces look outwards, or inwards.
pub(super) fn add_box(data: &mut SceneData, material: u32, lower: Vec3, upper: Vec3, inwards: bool) {
    let corner = |i: usize| Vec3::from_array([0, 1, 2].map(|a| if i >> a & 1 == 1 { upper[a] } else { lower[a] }));
    let mut indices = Vec::new();
    for [a, b, c, d] in [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]] {
        indices.extend([[a, b, c], [a, c, d]]);
    }
    if inwards {
        indices.iter_mut().for_each(|t| t.swap(1, 2));
    }
    let positions = (0..8).map(corner).collect();
    let mesh =
        Mesh { positions, indices: indices.into(), materials: MeshMaterials::One(material), ..Default::default() };
    data.add_mesh(mesh).unwrap();
}

fn grey(albedo: f32) -> Material {
    Material { albedo: [albedo; 3], ..Default::default() }
}

/// A closed room seen from inside, `size` along each axis, with a point light inside.
fn room(albedo: f32, size: Vec3, light: Vec3) -> SceneData {
    let mut data = SceneData::new();
    data.add_material(grey(albedo)).unwrap();
    add_box(&mut data, 0, Vec3::ZERO, size, true);
    data.add_light(Light::Point { position: light, intensity: [1.0, 2.0, 3.0] }).unwrap();
    data
}

/// The Cornell box's plan: a room with an open front, a block in it, a light below the ceiling.
fn cornell_like() -> SceneData {
    let mut data = SceneData::new();
    let white = data.add_material(grey(0.7)).unwrap();
    let red = data.add_material(Material { albedo: [0.6, 0.1, 0.1], ..Default::default() }).unwrap();
    add_box(&mut data, white, Vec3::ZERO, Vec3::splat(5.5), true);
    add_box(&mut data, red, Vec3::new(1.0, 0.0, 1.0), Vec3::new(2.5, 1.6, 2.5), false);
    add_box(&mut data, white, Vec3::new(3.0, 0.0, 3.0), Vec3::new(4.5, 3.3, 4.4), false);
    let (edge_u, edge_v) = (Vec3::X * 1.3, Vec3::Z * 1.05);
    let position = Vec3::new(2.1, 5.45, 2.2);
    data.add_light(Light::Rect { position, edge_u, edge_v, radiance: [17.0, 12.0, 4.0] }).unwrap();
    data
}

/// Points in the middle of the face of the unit square spanned by `u` and `v` at `corner`.
fn points_on(corner: Vec3, u: Vec3, v: Vec3, margin: f32, count: u32) -> Vec<Vec3> {
    let inner = |x: f32| margin + x * (1.0 - 2.0 * margin);
    (0..count).map(|i| sobol_2d(i, 11)).map(|[a, b]| corner + u * inner(a) + v * inner(b)).collect()
}

fn mean_estimate(map: &PhotonMap, points: &[Vec3], normal: Vec3) -> [f64; 3] {
    let mut sum = [0.0; 3];
    for &p in points {
        let e = map.estimate(p, normal);
        (0..3).for_each(|c| sum[c] += e[c] as f64 / points.len() as f64);
    }
    sum
}

#[track_caller]
fn assert_close(found: f64, expected: f64, tolerance: f64) {
    assert!((found / expected - 1.0).abs() <= tolerance, "{found} is not within {tolerance} of {expected}");
}

fn stored_power(map: &PhotonMap) -> [f64; 3] {
    map.columns().power.map(|c| c.iter().map(|&x| x as f64).sum())
}

#[test]
fn a_closed_glowing_box_has_the_irradiance_of_a_furnace() {
    let scene = builtin("furnace").unwrap().committed();
    let map = trace(&scene, PhotonParams { photon_count: 300_000, radius: 0.05, ..Default::default() });
    let faces = [
        (Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z),
        (Vec3::Z, Vec3::X, Vec3::Y, -Vec3::Z),
        (Vec3::ZERO, Vec3::Y, Vec3::Z, Vec3::X),
        (Vec3::ONE, -Vec3::Y, -Vec3::Z, -Vec3::X),
    ];
    for (corner, u, v, normal) in faces {
        let mean = mean_estimate(&map, &points_on(corner, u, v, 0.06, 400), normal);
        // Some 100,000 photons lie on a face: 0.3 %, and the points' own sampling.
        mean.iter().for_each(|&e| assert_close(e, PI / (1.0 - 0.5), 0.01));
    }
    let stats = map.stats();
    assert_eq!(stats.escaped_power, [0.0; 3], "light leaves a closed box");
    for c in 0..3 {
        assert_close(stats.emitted_power[c], 6.0 * PI, 1e-6);
        assert_close(stored_power(&map)[c], 6.0 * PI / 0.5, 0.005);
    }
}

#[test]
fn a_point_light_in_a_room_gives_intensity_times_cosine_over_squared_distance() {
    let light = Vec3::new(0.5, 0.4, 0.45);
    let scene = room(0.6, Vec3::ONE, light).committed();
    let params = PhotonParams { photon_count: 1_000_000, max_bounces: 1, radius: 0.03, ..Default::default() };
    let map = trace(&scene, params);
    for point in [Vec3::new(0.5, 0.5, 0.0), Vec3::new(0.3, 0.0, 0.6), Vec3::new(1.0, 0.7, 0.3)] {
        let normal = (Vec3::splat(0.5) - point).to_array().map(|x| if x.abs() == 0.5 { x * 2.0 } else { 0.0 });
        let normal = Vec3::from_array(normal);
        let to_light = light - point;
        let expected = to_light.dot(normal) as f64 / (to_light.length() as f64).powi(3);
        let found = map.estimate(point, normal);
        // Photons in the disc, and the noise of as many independent ones under the cone filter.
        let count = 1e6 / (4.0 * PI) * expected * PI * 0.03f64.powi(2);
        for (channel, &e) in found.iter().enumerate() {
            assert_close(e as f64, (channel + 1) as f64 * expected, 3.0 / count.sqrt());
        }
    }
}

#[test]
fn the_sun_gives_a_plane_its_irradiance() {
    let mut data = SceneData::new();
    data.add_material(grey(0.3)).unwrap();
    let positions = vec![Vec3::ZERO, Vec3::X, Vec3::X + Vec3::Y, Vec3::Y];
    data.add_mesh(Mesh {
        positions: positions.into(),
        indices: vec![[0, 1, 2], [0, 2, 3]].into(),
        ..Default::default()
    })
    .unwrap();
    let direction = Vec3::new(0.3, 0.5, -0.8);
    data.add_light(Light::Directional { direction, irradiance: [1.0, 5.0, 0.0], angular_radius: 0.0 }).unwrap();
    let map = trace(&data.committed(), PhotonParams { photon_count: 200_000, radius: 0.04, ..Default::default() });
    let cosine = 0.8 / direction.length() as f64;
    let mean = mean_estimate(&map, &points_on(Vec3::ZERO, Vec3::X, Vec3::Y, 0.05, 400), Vec3::Z);
    assert_close(mean[0], cosine, 0.005);
    assert_close(mean[1], 5.0 * cosine, 0.005);
    assert_eq!(mean[2], 0.0);
    assert_eq!(map.estimate(Vec3::new(0.5, 0.5, 0.0), -Vec3::Z), [0.0; 3], "the back is dark");
    // The box's faces lie edge to edge as seen by the sun: nothing is wasted but at the very rim.
    assert!(map.stats().stored as f64 > 0.999 * 200_000.0, "{}", map.stats().stored);
}

fn white_sky(radiance: f32) -> Light {
    Light::Sky { radiance: [radiance; 3], environment: crate::scene::NONE, up: Vec3::Y, rotation: 0.0 }
}

/// A unit square at z = 0 that looks up, of reflectance 0.3.
fn square_under(add: impl FnOnce(&mut SceneData) -> Light) -> Arc<Scene> {
    let mut data = SceneData::new();
    data.add_material(grey(0.3)).unwrap();
    let positions = vec![Vec3::ZERO, Vec3::X, Vec3::X + Vec3::Y, Vec3::Y];
    data.add_mesh(Mesh {
        positions: positions.into(),
        indices: vec![[0, 1, 2], [0, 2, 3]].into(),
        ..Default::default()
    })
    .unwrap();
    let light = add(&mut data);
    data.add_light(light).unwrap();
    data.committed()
}

#[test]
fn discs_and_skies_send_photons_of_their_irradiance() {
    let direction = Vec3::new(0.3, 0.5, -0.8);
    let disc = Light::Directional { direction, irradiance: [1.0, 5.0, 0.0], angular_radius: 0.3 };
    let cosine = 0.8 / direction.length() as f64;
    let image = |data: &mut SceneData| {
        // Red from above x > 0, blue from x < 0: a front that looks along +y, right of it is +x.
        let rgb = vec![[0.0, 0.0, 2.0], [1.0, 0.0, 0.0]];
        let environment = data.add_environment(crate::scene::Environment::new(2, 1, rgb).unwrap());
        Light::Sky { radiance: [3.0; 3], environment, up: Vec3::Z, rotation: 0.0 }
    };
    let cases: [(Arc<Scene>, [f64; 3]); 3] = [
        (square_under(|_| disc), [cosine, 5.0 * cosine, 0.0]),
        (square_under(|_| white_sky(2.0)), [2.0 * PI; 3]),
        (square_under(image), [1.5 * PI, 0.0, 3.0 * PI]),
    ];
    for (scene, expected) in cases {
        let map = trace(&scene, PhotonParams { photon_count: 1_000_000, radius: 0.05, ..Default::default() });
        let mean = mean_estimate(&map, &points_on(Vec3::ZERO, Vec3::X, Vec3::Y, 0.06, 400), Vec3::Z);
        for c in 0..3 {
            assert!((mean[c] - expected[c]).abs() <= 0.004 * expected[c], "{mean:?}, not {expected:?}");
        }
        let s = map.stats();
        for c in 0..3 {
            let sum = s.absorbed_power[c] + s.escaped_power[c] + s.truncated_power[c];
            assert!((sum - s.emitted_power[c]).abs() <= 7e-4 * s.emitted_power[c], "{s:?}");
        }
    }
}

#[test]
fn a_ball_under_a_white_sky_absorbs_what_its_surface_gets() {
    // It is convex: nothing is reflected onto it, and every point gets π times the radiance.
    let mut data = SceneData::new();
    data.add_material(grey(0.6)).unwrap();
    let mut builder = crate::scene::demo::shapes::MeshBuilder::new();
    builder.sphere(Vec3::splat(3.0), 1.0, 4, 0);
    let mesh = builder.finish();
    let area: f64 = (0..mesh.indices.len())
        .map(|t| {
            let [a, b, c] = mesh.corners(t).map(|c| c.as_dvec3());
            0.5 * (b - a).cross(c - a).length()
        })
        .sum();
    data.add_mesh(mesh).unwrap();
    data.add_light(white_sky(2.0)).unwrap();
    let map = trace(&data.committed(), PhotonParams { photon_count: 300_000, ..Default::default() });
    assert_close(map.stats().absorbed_power[0], 0.4 * 2.0 * PI * area, 0.001);
}

#[test]
fn a_far_point_light_is_aimed_at_the_scene_and_keeps_its_irradiance() {
    let mut data = SceneData::new();
    data.add_material(grey(0.0)).unwrap();
    add_box(&mut data, 0, Vec3::ZERO, Vec3::ONE, false);
    data.add_light(Light::Point { position: Vec3::new(0.5, 0.5, 41.0), intensity: [1600.0; 3] }).unwrap();
    let map = trace(&data.committed(), PhotonParams { photon_count: 100_000, radius: 0.06, ..Default::default() });
    let stats = map.stats();
    assert!(stats.stored > 35_000, "only {} photons of 100,000 reach the box", stats.stored);
    assert_close(stats.emitted_power[0], 4.0 * PI * 1600.0, 1e-9);
    assert_close(stats.absorbed_power[0] + stats.escaped_power[0], stats.emitted_power[0], 1e-9);
    let mean = mean_estimate(&map, &points_on(Vec3::Z, Vec3::X, Vec3::Y, 0.07, 200), Vec3::Z);
    assert_close(mean[0], 1.0, 0.01);
}

#[test]
fn a_spot_gives_the_irradiance_of_its_falloff() {
    let mut data = SceneData::new();
    data.add_material(grey(0.0)).unwrap();
    add_box(&mut data, 0, Vec3::new(-5.0, -5.0, 0.0), Vec3::new(5.0, 5.0, 10.0), true);
    let (inner, outer) = (0.3, 0.7);
    let (position, direction) = (Vec3::Z * 4.0, -Vec3::Z);
    data.add_light(Light::Spot { position, direction, inner, outer, intensity: [1.0; 3] }).unwrap();
    let map = trace(&data.committed(), PhotonParams { photon_count: 1_000_000, radius: 0.1, ..Default::default() });
    for x in [0.0f32, 1.0, 1.9, 2.4] {
        let cosine = 4.0 / x.hypot(4.0);
        let expected = (Light::spot_falloff(cosine, inner, outer) * cosine.powi(3) / 16.0) as f64;
        let density = 1e6 / map.stats().emitted_power[0];
        let count = expected * density * PI * 0.1f64.powi(2);
        // Averaged around the axis.
        let points: Vec<Vec3> = (0..64).map(|i| Vec3::new(x, 0.0, 0.0).rotate_z(i as f32 * 0.1)).collect();
        assert_close(mean_estimate(&map, &points, Vec3::Z)[0], expected, 0.01 + 1.0 / count.sqrt());
    }
    assert_eq!(map.estimate(Vec3::new(3.6, 0.0, 0.0), Vec3::Z), [0.0; 3], "outside the cone");
}

#[test]
fn two_sided_emitters_light_both_sides_with_double_power() {
    let mut data = SceneData::new();
    data.add_material(grey(0.0)).unwrap();
    let lamp = Material { albedo: [0.0; 3], emission: [2.0; 3], two_sided: true, ..Default::default() };
    let lamp = data.add_material(lamp).unwrap();
    add_box(&mut data, 0, Vec3::ZERO, Vec3::ONE, true);
    let positions = [(0.4, 0.4), (0.6, 0.4), (0.4, 0.6)].map(|(x, y)| Vec3::new(x, y, 0.5)).to_vec();
    let materials = MeshMaterials::One(lamp);
    data.add_mesh(Mesh {
        positions: positions.into(),
        indices: vec![[0, 1, 2]].into(),
        materials,
        ..Default::default()
    })
    .unwrap();
    let map = trace(&data.committed(), PhotonParams { photon_count: 100_000, radius: 0.1, ..Default::default() });
    assert_close(map.stats().emitted_power[0], 2.0 * PI * 2.0 * 0.02, 1e-5);
    let photons = map.columns();
    let above = photons.position[2].iter().filter(|&&z| z > 0.5).count() as f64;
    assert_close(above, 0.5 * photons.len() as f64, 0.001);
}

#[test]
fn all_power_emitted_is_absorbed_or_escapes_or_is_cut_off() {
    let mut data = cornell_like();
    // An opening, and a second light of another colour and kind.
    data.add_light(Light::Point { position: Vec3::new(2.0, 3.0, 9.0), intensity: [0.1, 9.0, 2.0] }).unwrap();
    let scene = data.committed();
    for max_bounces in [0, 1, 3] {
        let params = PhotonParams { photon_count: 200_000, max_bounces, ..Default::default() };
        let s = trace(&scene, params).stats();
        for c in 0..3 {
            assert_close(s.absorbed_power[c] + s.escaped_power[c] + s.truncated_power[c], s.emitted_power[c], 0.004);
        }
        assert_eq!(max_bounces == 0, s.truncated_power == [0.0; 3]);
    }
}

/// Lengths of paths are stratified over the photons: with independent numbers for every bounce, the standard
/// deviation of 1,000 photons at albedo 0.999 would be 3 %.
#[test]
fn few_photons_of_long_paths_lose_no_power() {
    for albedo in [0.5, 0.9, 0.999] {
        let scene = room(albedo, Vec3::ONE, Vec3::new(0.4, 0.5, 0.6)).committed();
        let s = trace(&scene, PhotonParams { photon_count: 1_000, ..Default::default() }).stats();
        for c in 0..3 {
            let sum = s.absorbed_power[c] + s.escaped_power[c] + s.truncated_power[c];
            assert_close(sum, s.emitted_power[c], 0.0025);
        }
    }
}

#[test]
fn the_photons_of_all_lights_carry_exactly_their_power() {
    let mut data = cornell_like();
    let intensity = [3.0, 0.0, 1.0];
    let position = Vec3::ONE;
    let direction = Vec3::new(0.1, -1.0, 0.2);
    data.add_light(Light::Point { position, intensity }).unwrap();
    data.add_light(Light::Spot { position, direction, inner: 0.2, outer: 0.4, intensity: [100.0; 3] }).unwrap();
    data.add_light(Light::Directional { direction, irradiance: [2.0, 1.0, 0.5], angular_radius: 0.0 }).unwrap();
    data.add_light(Light::Directional { direction, irradiance: [9.0, 1.0, 0.5], angular_radius: 0.2 }).unwrap();
    data.add_light(white_sky(0.3)).unwrap();
    let scene = data.committed();
    for count in [1_000, 9_999] {
        let emission = emission::Emission::new(&scene, &scene.lights(), count, 0.37).unwrap();
        let sum: glam::DVec3 = (0..count).map(|i| emission.emit(i, [0.5; 2], [0.5; 2]).power.as_dvec3()).sum();
        for c in 0..3 {
            assert_close(sum[c], emission.power[c], 1e-5);
        }
    }
}

#[test]
fn a_light_too_faint_for_a_photon_keeps_its_power_in_expectation() {
    let mut data = cornell_like();
    let (position, intensity) = (Vec3::ONE, [0.0, 0.0, 3.0]);
    data.add_light(Light::Point { position, intensity }).unwrap();
    let scene = data.committed();
    let offsets = 1000;
    let mut blue = 0.0;
    for i in 0..offsets {
        let emission = emission::Emission::new(&scene, &scene.lights(), 4, (i as f32 + 0.5) / offsets as f32).unwrap();
        let only = |p: &emission::Emitted| p.power.x == 0.0;
        let photons = (0..4).map(|i| emission.emit(i, [0.5; 2], [0.5; 2]));
        blue += photons.filter(only).map(|p| p.power.z as f64).sum::<f64>() / offsets as f64;
    }
    assert_close(blue, 4.0 * PI * 3.0, 0.01);
}

#[test]
fn the_same_seed_gives_the_same_bits_for_any_number_of_threads() {
    let results: Vec<_> = [1, 2, 7]
        .map(|threads| {
            let scene = commit_on(&device(threads), cornell_like());
            let map = trace(&scene, PhotonParams { photon_count: 20_000, seed: 5, ..Default::default() });
            let v = map.columns();
            let columns = [v.position, v.direction, v.power, v.normal].map(|g| g.map(|c| c.to_vec()));
            let points: Vec<[f32; 3]> =
                (0..2000).map(|i| [v.position[0][i], v.position[1][i], v.position[2][i]]).collect();
            let normals: Vec<[f32; 3]> = (0..2000).map(|i| [v.normal[0][i], v.normal[1][i], v.normal[2][i]]).collect();
            let mut out = vec![[0.0; 3]; 2000];
            map.estimate_many(&points, &normals, &mut out, &Progress::none()).unwrap();
            let timeless = PhotonStats { trace_seconds: 0.0, grid_seconds: 0.0, ..map.stats() };
            (columns, out, timeless, map.radius())
        })
        .into();
    assert!(results[0].0[0][0].len() > 20_000);
    assert!(results[0] == results[1] && results[0] == results[2]);
}

#[test]
fn packed_photons_are_the_columns_row_by_row() {
    let map = trace(&cornell_like().committed(), PhotonParams { photon_count: 100, ..Default::default() });
    let (packed, columns) = (map.photons().unwrap(), map.columns());
    assert_eq!(packed.position.len(), columns.len());
    for i in 0..columns.len() {
        assert_eq!(packed.position[i], columns.position.map(|c| c[i]));
        assert_eq!(packed.direction[i], columns.direction.map(|c| c[i]));
        assert_eq!(packed.power[i], columns.power.map(|c| c[i]));
    }
    assert!(std::ptr::eq(packed, map.photons().unwrap()), "copied once");
}

#[test]
fn another_seed_gives_other_photons_and_the_same_light() {
    let scene = cornell_like().committed();
    let maps = [1, 2].map(|seed| trace(&scene, PhotonParams { photon_count: 100_000, seed, ..Default::default() }));
    assert_ne!(maps[0].columns().position[0][..100], maps[1].columns().position[0][..100]);
    for c in 0..3 {
        assert_close(stored_power(&maps[0])[c], stored_power(&maps[1])[c], 0.01);
    }
}

#[test]
fn a_sealed_box_in_a_lit_room_is_exactly_dark_inside() {
    let mut data = room(0.9, Vec3::splat(3.0), Vec3::new(1.5, 2.7, 1.4));
    let both = data.add_material(Material { two_sided: true, ..grey(0.9) }).unwrap();
    let (lower, upper) = (Vec3::new(1.1, 1.2, 0.9), Vec3::new(1.9, 1.7, 1.8));
    add_box(&mut data, both, lower, upper, false);
    let map = trace(&data.committed(), PhotonParams { photon_count: 300_000, radius: 0.1, ..Default::default() });
    assert_eq!(map.stats().escaped_power, [0.0; 3]);
    let v = map.columns();
    let (mut outside, centre) = (0, (lower + upper) * 0.5);
    for i in 0..v.len() {
        let at = |v: [&[f32]; 3]| Vec3::new(v[0][i], v[1][i], v[2][i]);
        let p = at(v.position);
        if p.cmpge(lower - 1e-4).all() && p.cmple(upper + 1e-4).all() {
            assert!(at(v.normal).dot(p - centre) > 0.0, "a photon is inside, at {p}");
            outside += 1;
        }
    }
    assert!(outside > 100_000, "{outside}");
    let floor = Vec3::new(1.5, lower.y, 1.4);
    assert_eq!(map.estimate(floor, Vec3::Y), [0.0; 3]);
    assert!(map.estimate(floor, -Vec3::Y)[0] > 0.0);
}

#[test]
fn no_light_leaves_a_closed_room_with_sharp_corners() {
    // A flat tetrahedron: dihedral angles down to 20 degrees, all paths long.
    let mut data = SceneData::new();
    data.add_material(Material { two_sided: true, ..grey(0.95) }).unwrap();
    let positions = vec![Vec3::ZERO, Vec3::new(3.0, 0.1, 0.2), Vec3::new(1.0, 2.7, 0.0), Vec3::new(1.3, 1.0, 0.35)];
    let indices = vec![[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]];
    let inside = positions.iter().sum::<Vec3>() / 4.0;
    data.add_mesh(Mesh { positions: positions.into(), indices: indices.into(), ..Default::default() }).unwrap();
    data.add_light(Light::Point { position: inside, intensity: [1.0; 3] }).unwrap();
    let stats = trace(&data.committed(), PhotonParams { photon_count: 100_000, ..Default::default() }).stats();
    assert!(stats.rays > 1_500_000);
    assert_eq!(stats.escaped_power, [0.0; 3]);
}

#[test]
fn backs_of_one_sided_surfaces_swallow_photons() {
    let mut data = SceneData::new();
    data.add_material(grey(0.5)).unwrap();
    // Front faces look outwards, the light is inside.
    add_box(&mut data, 0, Vec3::ZERO, Vec3::ONE, false);
    data.add_light(Light::Point { position: Vec3::splat(0.5), intensity: [1.0; 3] }).unwrap();
    let stats = trace(&data.committed(), PhotonParams { photon_count: 1000, ..Default::default() }).stats();
    assert_eq!((stats.stored, stats.rays), (0, 1000));
    assert_close(stats.absorbed_power[0], 4.0 * PI, 1e-6);
}

#[test]
fn direct_and_indirect_photons_add_up_to_all() {
    let scene = cornell_like().committed();
    let params = PhotonParams { photon_count: 20_000, ..Default::default() };
    let all = trace(&scene, params);
    let direct = trace(&scene, PhotonParams { max_bounces: 1, ..params });
    let indirect = trace(&scene, PhotonParams { store_direct: false, ..params });
    let none = trace(&scene, PhotonParams { max_bounces: 1, store_direct: false, ..params });
    assert_eq!(direct.stats().rays, 20_000);
    assert_eq!(direct.stats().stored, 20_000, "the room is closed");
    assert_eq!(direct.stats().stored + indirect.stats().stored, all.stats().stored);
    for c in 0..3 {
        assert_close(stored_power(&direct)[c] + stored_power(&indirect)[c], stored_power(&all)[c], 1e-9);
        assert_close(stored_power(&direct)[c], direct.stats().emitted_power[c], 1e-5);
    }
    assert_eq!(none.stats().stored, 0);
    assert!(none.radius() > 0.0);
    assert_eq!(none.estimate(Vec3::ONE, Vec3::Y), [0.0; 3]);
}

#[test]
fn the_automatic_radius_finds_the_documented_number_of_photons() {
    for photon_count in [3_000, 200_000] {
        let map = trace(&cornell_like().committed(), PhotonParams { photon_count, ..Default::default() });
        let (v, r) = (map.columns(), map.radius());
        // Where a random point of the floor, a wall or the block lies.
        let mut found = 0;
        let faces = [
            (Vec3::ZERO, Vec3::X * 5.5, Vec3::Z * 5.5, Vec3::Y),
            (Vec3::ZERO, Vec3::Y * 5.5, Vec3::Z * 5.5, Vec3::X),
            (Vec3::Z * 5.5, Vec3::X * 5.5, Vec3::Y * 5.5, -Vec3::Z),
            (Vec3::Y * 5.5, Vec3::X * 5.5, Vec3::Z * 5.5, -Vec3::Y),
        ];
        let per_face = 50;
        for (corner, a, b, normal) in faces {
            for p in points_on(corner, a, b, 0.0, per_face) {
                let near = |i: usize| {
                    let d = Vec3::new(v.position[0][i], v.position[1][i], v.position[2][i]) - p;
                    d.dot(normal).abs() < 0.01 && d.length() < r
                };
                found += (0..v.len()).filter(|&i| near(i)).count();
            }
        }
        let mean = found as f64 / (faces.len() as u32 * per_face) as f64;
        assert!((0.5..2.0).contains(&(mean / PHOTONS_PER_DISC)), "{mean} photons at radius {r}");
    }
}

#[test]
fn parameters_out_of_range_are_refused_by_name() {
    let scene = cornell_like().committed();
    let good = PhotonParams::default();
    for (params, name) in [
        (PhotonParams { photon_count: 0, ..good }, "photon_count is 0"),
        (PhotonParams { photon_count: MAX_PHOTONS + 1, ..good }, "photon_count is 4294967297"),
        (PhotonParams { radius: -1.0, ..good }, "radius is -1"),
        (PhotonParams { radius: f32::NAN, ..good }, "radius is NaN"),
        (PhotonParams { radius: f32::INFINITY, ..good }, "radius is inf"),
        (PhotonParams { radius: 1e-40, ..good }, "radius is 1e-40"),
        (PhotonParams { half_height: 0.0, ..good }, "half_height is 0"),
        (PhotonParams { half_height: f32::NAN, ..good }, "half_height is NaN"),
        (PhotonParams { cone_k: 0.9, ..good }, "cone_k is 0.9"),
        (PhotonParams { cone_k: f32::NAN, ..good }, "cone_k is NaN"),
    ] {
        match PhotonMap::trace(&scene, &params, &Progress::none()) {
            Err(Error::InvalidArgument(sentence)) => assert!(sentence.contains(name), "{sentence}"),
            other => panic!("{name}: {:?}", other.map(|m| m.stats())),
        }
    }
}

#[test]
fn a_scene_without_lights_is_an_error_and_dark_lights_make_an_empty_map() {
    let mut data = SceneData::new();
    data.add_material(grey(0.5)).unwrap();
    add_box(&mut data, 0, Vec3::ZERO, Vec3::ONE, true);
    let params = PhotonParams::default();
    let error = PhotonMap::trace(&data.clone().committed(), &params, &Progress::none()).err().unwrap();
    assert!(matches!(&error, Error::InvalidState(s) if s.contains("the scene has no lights")), "{error}");
    data.add_light(Light::Point { position: Vec3::ONE, intensity: [0.0; 3] }).unwrap();
    let map = trace(&data.committed(), params);
    assert_eq!((map.stats().emitted, map.stats().stored), (0, 0));
    assert!(map.columns().is_empty());
    assert_eq!(map.estimate(Vec3::ZERO, Vec3::Z), [0.0; 3]);
}

#[test]
fn the_memory_budget_is_kept_and_named() {
    let scene = cornell_like().committed();
    let map = trace(&scene, PhotonParams { photon_count: 5_000, ..Default::default() });
    let tight = PhotonParams { photon_count: 5_000, memory_budget: map.bytes() as u64, ..Default::default() };
    let error = PhotonMap::trace(&scene, &tight, &Progress::none()).err().unwrap();
    let name = format!("memory_budget, {}", map.bytes());
    assert!(matches!(&error, Error::OutOfMemory(s) if s.contains(&name)), "{error}");
    // While it is made, the map needs its photons twice.
    let enough = PhotonParams { memory_budget: 2 * map.bytes() as u64, ..tight };
    assert!(PhotonMap::trace(&scene, &enough, &Progress::none()).is_ok());
}

/// Not only between them: one block of photons between white walls stores hundreds of megabytes.
#[test]
fn the_memory_budget_is_kept_within_a_block() {
    let scene = room(1.0 - f32::EPSILON, Vec3::ONE, Vec3::splat(0.5)).committed();
    let params = PhotonParams { photon_count: 1_000, memory_budget: 4 << 20, ..Default::default() };
    let refused = PhotonMap::trace(&scene, &params, &Progress::none()).err();
    assert!(matches!(refused, Some(Error::OutOfMemory(_))), "{refused:?}");
    let seen = Arc::new(std::sync::atomic::AtomicI64::new(0));
    let memory = {
        let seen = seen.clone();
        move |bytes: i64| seen.fetch_add(bytes, std::sync::atomic::Ordering::SeqCst) + bytes < 64 << 20
    };
    let device =
        Device::new(DeviceOptions { num_threads: 1, memory: Some(Box::new(memory)), ..Default::default() }).unwrap();
    let scene = commit_on(&device, room(1.0 - f32::EPSILON, Vec3::ONE, Vec3::splat(0.5)));
    let params = PhotonParams { photon_count: 1_000, ..Default::default() };
    let refused = PhotonMap::trace(&scene, &params, &Progress::none()).err();
    assert!(matches!(refused, Some(Error::OutOfMemory(_))), "{refused:?}");
}

#[test]
fn all_memory_is_accounted_for_and_given_back() {
    let limit = 4 << 20;
    let memory: Box<crate::base::memory::MemoryFn> = Box::new(move |bytes| bytes < 64 << 20);
    let device = Device::new(DeviceOptions { memory: Some(memory), ..Default::default() }).unwrap();
    let scene = commit_on(&device, cornell_like());
    let before = device.memory().current();
    let map = trace(&scene, PhotonParams { photon_count: 50_000, ..Default::default() });
    assert_eq!(device.memory().current() - before, map.bytes() as i64);
    assert!(map.bytes() > limit);
    assert_eq!(map.photons().unwrap().power.len(), map.columns().len());
    drop(map);
    let refused = PhotonParams { photon_count: 1_000_000, max_bounces: 4, ..Default::default() };
    let error = PhotonMap::trace(&scene, &refused, &Progress::none()).err().unwrap();
    assert!(matches!(&error, Error::OutOfMemory(s) if s.contains("the memory monitor refused")), "{error}");
    assert_eq!(device.memory().current(), before);
}

#[test]
fn cancelling_stops_every_stage_and_gives_all_memory_back() {
    let scene = cornell_like().committed();
    let before = scene.device().memory().current();
    let params = PhotonParams { photon_count: 20_000, ..Default::default() };
    for stage in ["photons", "photon grid"] {
        let progress = Progress::new(|_, s| s != stage);
        assert_eq!(PhotonMap::trace(&scene, &params, &progress).err(), Some(Error::Cancelled));
        assert_eq!(scene.device().memory().current(), before);
    }
    let map = trace(&scene, params);
    let progress = Progress::new(|_, s| s != "photon estimates");
    let (points, mut out) = ([[1.0; 3]; 500], [[0.0; 3]; 500]);
    assert_eq!(map.estimate_many(&points, &points, &mut out, &progress), Err(Error::Cancelled));
}

#[test]
fn every_isa_finds_the_same_photons() {
    let maps: Vec<PhotonMap> = Isa::available()
        .map(|isa| {
            let device = Device::new(DeviceOptions { isa: Some(isa), ..Default::default() }).unwrap();
            trace(&commit_on(&device, cornell_like()), PhotonParams { photon_count: 20_000, ..Default::default() })
        })
        .collect();
    for map in &maps[1..] {
        // Hits differ in their last bits; a few paths are split by them.
        assert_close(map.stats().stored as f64, maps[0].stats().stored as f64, 0.002);
        let (p, n) = (Vec3::new(2.0, 0.0, 4.0), Vec3::Y);
        assert_close(map.estimate(p, n)[0] as f64, maps[0].estimate(p, n)[0] as f64, 0.05);
    }
}

#[test]
fn photons_that_would_be_too_many_are_thinned_out_without_losing_power() {
    let scene = room(0.95, Vec3::splat(3.0), Vec3::splat(1.3)).committed();
    let params = PhotonParams { photon_count: 200_000, ..Default::default() };
    let (all, some) = (trace(&scene, params), trace(&scene, PhotonParams { most_stored: 300_000, ..params }));
    assert!(all.stats().stored > 3_000_000, "{}", all.stats().stored);
    let stored = some.stats().stored as f64;
    assert!((0.9..1.1).contains(&(stored / 300_000.0)), "{stored}");
    for (found, expected) in stored_power(&some).into_iter().zip(stored_power(&all)) {
        assert_close(found, expected, 0.002);
    }
}

#[test]
fn the_automatic_radius_is_never_less_than_the_least() {
    let scene = room(0.9, Vec3::splat(3.0), Vec3::splat(1.3)).committed();
    let params = PhotonParams { photon_count: 100_000, ..Default::default() };
    let automatic = trace(&scene, params).radius();
    assert!(automatic < 0.2);
    assert_eq!(trace(&scene, PhotonParams { least_radius: 0.2, ..params }).radius(), 0.2);
    assert_eq!(trace(&scene, PhotonParams { least_radius: 1e-3, ..params }).radius(), automatic);
}
