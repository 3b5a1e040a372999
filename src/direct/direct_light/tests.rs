//! Tests of direct light against analysis.

use super::*;
use crate::base::sampling::{cosine_hemisphere, uniform, uniform_sphere};
use crate::direct::guide::{BINS, Guide, frame};
use crate::direct::point_light::point_light;
use crate::direct::polygon;
use crate::scene::demo::shapes::MeshBuilder;
use crate::scene::{Material, SceneData, builtin};
use crate::trace::Ray;
use crate::trace::offset::offset_ray_origin;
use glam::DVec3;
use std::f32::consts::PI;

fn receiver(scene: &Scene, position: Vec3, normal: Vec3) -> Receiver {
    let origin = offset_ray_origin(position, normal, scene);
    Receiver { origin, normal, geometric: normal, position, shadow_origin: origin, raised: false }
}

/// A floor at z = 0, and what `add` builds.
fn floor(add: impl FnOnce(&mut SceneData, &mut MeshBuilder)) -> Arc<Scene> {
    let mut data = SceneData::new();
    data.add_material(Material { albedo: [0.5; 3], two_sided: true, ..Default::default() }).unwrap();
    let mut builder = MeshBuilder::new();
    let p = |x: f32, y: f32| Vec3::new(x, y, 0.0);
    builder.quad(p(-20.0, -20.0), p(20.0, -20.0), p(20.0, 20.0), p(-20.0, 20.0), 0);
    add(&mut data, &mut builder);
    data.add_mesh(builder.finish()).unwrap();
    data.committed()
}

fn lambert(origin: Vec3, quad: [Vec3; 4]) -> f64 {
    polygon::irradiance(&quad.map(|p| (p - origin).as_dvec3()), DVec3::Z)
}

fn wall(x: f32, half: f32, height: f32) -> [Vec3; 4] {
    [(-half, 0.0), (half, 0.0), (half, height), (-half, height)].map(|(y, z)| Vec3::new(x, y, z))
}

#[test]
fn a_light_that_stands_on_the_floor_behind_a_board_has_small_errors_up_to_its_foot() {
    for emissive in [false, true] {
        let [a, b, c, d] = wall(0.0, 1.0, 1.0);
        let board = wall(0.004, 0.1, 0.1);
        let scene = floor(|data, builder| {
            if emissive {
                let m = data.add_material(Material { emission: [1.0; 3], ..Default::default() }).unwrap();
                builder.quad(a, b, c, d, m);
            } else {
                let (edge_u, edge_v) = (b - a, d - a);
                data.add_light(Light::Rect { position: a, edge_u, edge_v, radiance: [1.0; 3] }).unwrap();
            }
            builder.quad(board[0], board[1], board[2], board[3], 0);
        });
        let direct = DirectLight::new(&scene);
        let (points, seeds) = (100, 8);
        let (mut mse, mut bias) = (0.0, 0.0);
        for i in 0..points {
            let x = 0.01 * (50f32).powf((i as f32 + 0.5) / points as f32);
            let r = receiver(&scene, Vec3::new(x, 0.0, 0.0), Vec3::Z);
            // The board, as seen from here, covers a part of the light and nothing else.
            let all = lambert(r.origin, [a, b, c, d]);
            let expected = all - lambert(r.origin, board);
            for seed in 0..seeds {
                let e = direct.irradiance(&r, 16, combine(i, seed), &mut 0).x as f64;
                let off = (e - expected) / all;
                mse += off * off / (points * seeds) as f64;
                bias += off / (points * seeds) as f64;
            }
        }
        assert!(mse < 4e-3 && bias.abs() < 4e-3, "emissive {emissive}: MSE {mse}, bias {bias}");
    }
}

#[test]
fn one_sample_has_no_bias_if_asked_so() {
    let mut worst = 0f32;
    // A half plane hides a part of a lamp and of a disc, that which brings more or that which brings less.
    for (side, radius) in [(-1.0, 0.0), (1.0, 0.0), (-1.0, 0.5), (1.0, 0.5)] {
        let scene = floor(|data, builder| {
            // Through the middle of the disc.
            let edge = if radius > 0.0 { 0.25 * side } else { 0.1 };
            let p = |x: f32, y: f32| Vec3::new(x * side, y, 0.5);
            builder.quad(p(edge, -15.0), p(15.0, -15.0), p(15.0, 15.0), p(edge, 15.0), 0);
            if radius > 0.0 {
                data.add_light(sun(Vec3::new(-0.5, 0.0, -1.0), radius)).unwrap();
            } else {
                let (position, edge_u, edge_v) = (Vec3::new(-1.0, -0.5, 1.0), Vec3::Y, Vec3::X * 6.0);
                data.add_light(Light::Rect { position, edge_u, edge_v, radiance: [10.0; 3] }).unwrap();
            }
        });
        let direct = DirectLight::new(&scene);
        let r = receiver(&scene, Vec3::ZERO, Vec3::Z);
        let exact = direct.irradiance(&r, 4096, 1, &mut 0).x;
        let seeds = 1 << 17;
        let mean_of = |one: &dyn Fn(u32) -> Vec3| {
            (0..seeds).map(|s| one(combine(s, 5)).x as f64).sum::<f64>() as f32 / seeds as f32 / exact - 1.0
        };
        let (unbiased, by_ratio) = (
            mean_of(&|seed| direct.unbiased(&r, 1, seed, &mut 0)),
            mean_of(&|seed| direct.irradiance(&r, 1, seed, &mut 0)),
        );
        assert!(unbiased.abs() < 0.005, "{side} {radius}: {unbiased}");
        worst = by_ratio.abs().max(worst);
    }
    assert!(worst > 0.01, "{worst}: these cases tell nothing");
}

#[test]
fn a_light_just_above_the_surface_and_one_that_lies_on_it() {
    for (height, expected) in [(1e-3, PI), (1e-2, PI), (0.0, 0.0)] {
        let p = Vec3::new(-5.0, -5.0, height);
        let scene = floor(|data, _| {
            // Its u × v points down.
            let (edge_u, edge_v) = (Vec3::Y * 10.0, Vec3::X * 10.0);
            data.add_light(Light::Rect { position: p, edge_u, edge_v, radiance: [1.0; 3] }).unwrap();
        });
        let direct = DirectLight::new(&scene);
        for i in 0..50 {
            let place = Vec3::new(uniform(i, 0, 1) - 0.5, uniform(i, 1, 1) - 0.5, 0.0) * 9.8;
            let e = direct.irradiance(&receiver(&scene, place, Vec3::Z), 4, i, &mut 0).x;
            assert!((e - expected).abs() < 5e-4 * PI, "{e} instead of {expected}, {height} above");
        }
    }
}

/// The atrium with 300 lights, half points and spots, half triangles, in place of its own.
fn many() -> Arc<Scene> {
    let mut data = builtin("atrium").unwrap();
    for i in 0..data.lights().len() as u32 {
        data.set_light(i, Light::Point { position: Vec3::ZERO, intensity: [0.0; 3] }).unwrap();
    }
    let positions: Vec<Vec3> = data.meshes().iter().flat_map(|m| m.positions.iter().copied()).collect();
    let lower = positions.iter().fold(Vec3::INFINITY, |a, &b| a.min(b));
    let upper = positions.iter().fold(Vec3::NEG_INFINITY, |a, &b| a.max(b));
    for i in 0..300 {
        let r = |d| uniform(i, d, 5);
        let position = lower + (upper - lower) * Vec3::new(r(0), r(1), r(2));
        let intensity = [0.1 + 10.0 * r(3), 5.0 * r(4), 1.0];
        match i % 4 {
            0 => data.add_light(Light::Point { position, intensity }),
            1 => {
                let direction = uniform_sphere([r(5), r(6)]);
                data.add_light(Light::Spot { position, direction, inner: 0.3, outer: 0.3 + r(7), intensity })
            }
            _ => {
                let (edge_u, edge_v) = (uniform_sphere([r(5), r(6)]) * 0.5, uniform_sphere([r(7), r(8)]) * 0.5);
                data.add_light(Light::Rect { position, edge_u, edge_v, radiance: intensity })
            }
        }
        .unwrap();
    }
    data.committed()
}

#[test]
fn many_lights_are_sampled_without_bias() {
    let scene = many();
    let direct = DirectLight::new(&scene);
    assert_eq!((direct.many_light_count(), direct.area_light_count()), (300, 150));
    let lights = scene.lights();
    let mut checked = 0;
    for i in 0..60 {
        let triangle = (uniform(i, 0, 9) * scene.triangle_count() as f32) as u32;
        if !scene.is_valid(triangle) {
            continue;
        }
        let [a, b, c] = scene.corners(triangle);
        let r = receiver(&scene, (a + b + c) / 3.0, scene.normal(triangle));
        // The sum over all lights, one at a time.
        let mut expected = Vec3::ZERO;
        for light in lights.iter() {
            if let Some(area) = AreaLight::rect(light) {
                let (n, Some(sampler)) = (256, area.sampler(&r)) else { continue };
                for k in 0..n {
                    let (point, weight) = area.sample(&sampler, &r, sobol_2d(k, combine(i, 77)));
                    if weight > 0.0 && !scene.occluded(&shadow_ray(&r, point)) {
                        expected += area.radiance * (weight / n as f32);
                    }
                }
            } else if let Some((target, light)) = point_light(light, &r)
                && !scene.occluded(&shadow_ray(&r, target))
            {
                expected += light;
            }
        }
        let (mut mean, mut square, seeds) = (Vec3::ZERO, Vec3::ZERO, 400);
        for seed in 0..seeds {
            let e = direct.irradiance(&r, 2, combine(seed, 1000 + i), &mut 0);
            mean += e / seeds as f32;
            square += e * e / seeds as f32;
        }
        let error = ((square - mean * mean).max(Vec3::ZERO) / seeds as f32).sqrt();
        let off = (mean - expected).abs();
        assert!(off.cmple(5.0 * error + 0.01 * expected + 1e-5).all(), "{mean} ± {error} is not {expected}");
        checked += (expected.max_element() > 0.0) as u32;
    }
    assert!(checked > 20, "{checked} of the points were lit");
}

#[test]
fn a_thousand_rays_are_not_needed_for_a_thousand_lights() {
    let scene = many();
    let direct = DirectLight::new(&scene);
    let r = receiver(&scene, scene.corners(0)[0], scene.normal(0));
    let mut rays = 0;
    direct.irradiance(&r, 8, 1, &mut rays);
    assert!(rays <= 33, "{rays} rays, not 4 · 8 or one more");
    assert_eq!(direct.rays_per_point(8), 32.0);
}

fn sun(direction: Vec3, angular_radius: f32) -> Light {
    Light::Directional { direction, irradiance: [10.0; 3], angular_radius }
}

fn sky(radiance: f32) -> Light {
    Light::Sky { radiance: [radiance; 3], environment: crate::scene::NONE, up: Vec3::Z, rotation: 0.0 }
}

/// Mean over seeds at a point of the floor.
fn mean(direct: &DirectLight, position: Vec3, samples: u32, seeds: u32) -> f32 {
    let r = receiver(&direct.scene, position, Vec3::Z);
    (0..seeds).map(|s| direct.irradiance(&r, samples, combine(s, 3), &mut 0).x).sum::<f32>() / seeds as f32
}

#[test]
fn a_sun_with_a_disc_has_the_irradiance_of_a_point_and_a_penumbra_as_wide_as_it_looks() {
    // A half plane at height 1 over x > 0 (as far as it matters), under a disc at the zenith.
    let radius = 0.1f32;
    let scene = floor(|data, builder| {
        let p = |x: f32, y: f32| Vec3::new(x, y, 1.0);
        builder.quad(p(0.0, -15.0), p(15.0, -15.0), p(15.0, 15.0), p(0.0, 15.0), 0);
        data.add_light(sun(Vec3::NEG_Z, radius)).unwrap();
    });
    let direct = DirectLight::new(&scene);
    assert_eq!((direct.disc_count(), direct.rays_per_point(16)), (1, 16.0));
    let e = direct.irradiance(&receiver(&scene, Vec3::new(-3.0, 0.0, 0.0), Vec3::Z), 4, 1, &mut 0);
    assert!((e - 10.0).abs().max_element() < 1e-5, "no noise in the open: {e}");
    let reach = radius.tan();
    assert_eq!(mean(&direct, Vec3::X * (1.01 * reach), 64, 16), 0.0);
    assert!((mean(&direct, Vec3::X * (-1.01 * reach), 64, 1) - 10.0).abs() < 1e-5);
    for part in [-0.8f32, -0.5, 0.0, 0.5, 0.8] {
        // Projected on the floor, the disc is a disc in which every area counts the same; the edge
        // cuts it along a great circle, an ellipse's axis wide x/√(1 + x²) from its middle.
        let x = part * reach;
        let cut = (x / (1.0 + x * x).sqrt() / radius.sin()) as f64;
        let segment = (cut.acos() - cut * (1.0 - cut * cut).sqrt()) / std::f64::consts::PI;
        let e = mean(&direct, Vec3::X * x, 256, 64) as f64 / 10.0;
        assert!((e - segment).abs() < 4e-3, "{part}: {e}, not {segment}");
    }
}

#[test]
fn the_horizon_cuts_a_disc_without_noise_and_parallel_light_is_its_limit() {
    let light = |elevation: f32, radius: f32| {
        let direction = -Vec3::new(elevation.cos(), 0.0, elevation.sin());
        let scene = floor(|data, _| assert!(data.add_light(sun(direction, radius)).is_ok()));
        mean(&DirectLight::new(&scene), Vec3::ZERO, 16, 4)
    };
    assert!((light(0.5, 1e-3) / light(0.5, 0.0) - 1.0).abs() < 1e-5);
    assert_eq!(light(0.5, 1e-6), light(0.5, 0.0));
    // The middle on the horizon: half a disc; what cosines sum to in the small limit is 2/(3π) · radius.
    let (e, limit) = (light(1e-7, 0.01), 10.0 * 2.0 / (3.0 * PI) * 0.01);
    assert!((e / limit - 1.0).abs() < 1e-4, "{e} {limit}");
    // A disc of half the sphere at the zenith is a sky.
    assert!((light(PI / 2.0, PI / 2.0) - 10.0).abs() < 1e-4);
}

#[test]
fn an_open_floor_under_a_constant_sky_gets_pi_times_its_radiance_without_noise() {
    let scene = floor(|data, _| assert!(data.add_light(sky(2.0)).is_ok()));
    let direct = DirectLight::new(&scene);
    for seed in 0..20 {
        let e = direct.irradiance(&receiver(&scene, Vec3::ZERO, Vec3::Z), 4, seed, &mut 0);
        assert!((e / (2.0 * PI) - 1.0).abs().max_element() < 1e-6, "{e}");
    }
}

#[test]
fn a_valley_under_the_sky_gets_what_its_walls_leave() {
    // On the middle line of a trench with walls that lean outwards (half-width 1, up to height h),
    // the sky is seen between two great circles: E = π L · cos of the angle from the zenith.
    let (width, height) = (1.0f32, 0.75f32);
    let scene = floor(|data, builder| {
        for x in [-width, width] {
            let p = |y: f32, z: f32| Vec3::new(x, y, z);
            builder.quad(p(-200.0, 0.0), p(200.0, 0.0), p(200.0, height), p(-200.0, height), 0);
        }
        data.add_light(sky(1.0)).unwrap();
    });
    let expected = PI * (width / (width * width + height * height).sqrt());
    let e = mean(&DirectLight::new(&scene), Vec3::ZERO, 64, 1024);
    assert!((e / expected - 1.0).abs() < 1.5e-3, "{e}, not {expected}");
}

fn under_image(image: crate::scene::Environment, up: Vec3, rotation: f32) -> DirectLight {
    let scene = floor(|data, _| {
        let environment = data.add_environment(image);
        data.add_light(Light::Sky { radiance: [3.0; 3], environment, up, rotation }).unwrap();
    });
    DirectLight::new(&scene)
}

#[test]
fn half_an_image_that_is_bright_gives_half_the_light() {
    use crate::scene::Environment;
    let half = Environment::new(8, 1, [[[1.0; 3]; 4], [[0.0; 3]; 4]].concat()).unwrap();
    let e = mean(&under_image(half, Vec3::Z, 0.7), Vec3::ZERO, 64, 32);
    assert!((e / (1.5 * PI) - 1.0).abs() < 1e-3, "{e}");
    // Bright above the horizon only, upside down: nothing.
    let above = Environment::new(1, 2, vec![[1.0; 3], [0.0; 3]]).unwrap();
    let e = mean(&under_image(above.clone(), Vec3::Z, 0.0), Vec3::ZERO, 64, 8);
    assert!((e / (3.0 * PI) - 1.0).abs() < 2e-4, "{e}");
    assert_eq!(mean(&under_image(above, Vec3::NEG_Z, 0.0), Vec3::ZERO, 64, 8), 0.0);
}

#[test]
fn an_image_with_one_bright_pixel_is_a_sun() {
    use crate::scene::Environment;
    let (width, height) = (512usize, 256usize);
    let (x, y) = (300usize, 60usize);
    let mut rgb = vec![[0.0; 3]; width * height];
    rgb[y * width + x] = [1e4; 3];
    let direct = under_image(Environment::new(width as u32, height as u32, rgb).unwrap(), Vec3::Z, 0.0);
    let theta = |y: f32| PI * y / height as f32;
    let y = y as f32;
    let solid_angle = 2.0 * PI / width as f32 * (theta(y).cos() - theta(y + 1.0).cos());
    let expected = 3.0 * 1e4 * solid_angle * theta(y + 0.5).cos();
    let e = mean(&direct, Vec3::ZERO, 16, 16);
    assert!((e / expected - 1.0).abs() < 1e-4, "{e}, not {expected}");
}

/// A roof at z = 1 with a square hole.
fn roof(builder: &mut MeshBuilder) -> [Vec3; 4] {
    let p = |x: f32, y: f32| Vec3::new(x, y, 1.0);
    let (x0, x1, y0, y1, far) = (0.6, 0.8, -0.1, 0.1, 1e4);
    builder.quad(p(-far, -far), p(x0, -far), p(x0, far), p(-far, far), 0);
    builder.quad(p(x1, -far), p(far, -far), p(far, far), p(x1, far), 0);
    builder.quad(p(x0, -far), p(x1, -far), p(x1, y0), p(x0, y0), 0);
    builder.quad(p(x0, y1), p(x1, y1), p(x1, far), p(x0, far), 0);
    [p(x0, y0), p(x1, y0), p(x1, y1), p(x0, y1)]
}

/// Mean light at the origin of the floor and variance of single estimates, guided by what is `seen` of the sky from there.
fn guided(direct: &DirectLight, seen: Option<u64>, seeds: u32) -> [f64; 2] {
    let r = receiver(&direct.scene, Vec3::ZERO, Vec3::Z);
    let (mut sum, mut squares) = (0.0, 0.0);
    for seed in 0..seeds {
        let mut room = PointRoom::new();
        let mut shadow = room.begin(&direct.scene);
        shadow.guide = seen.and_then(|seen| Guide::new(std::iter::repeat_n((seen, false), 81)));
        assert_eq!(shadow.guide.is_some(), seen.is_some());
        let mut light = direct.push(&r, 0, Lights::All, 4, combine(seed, 9), &mut shadow);
        light.take(shadow.finish(&mut 0));
        let e = f64::from(light.value().x);
        (sum, squares) = (sum + e, squares + e * e);
    }
    let mean = sum / f64::from(seeds);
    [mean, squares / f64::from(seeds) - mean * mean]
}

/// The bins of a guide in which the sky is seen from the origin of the floor.
fn seen(direct: &DirectLight) -> u64 {
    let r = receiver(&direct.scene, Vec3::ZERO, Vec3::Z);
    let (t, b) = frame(Vec3::Z);
    (0..BINS as u32 * 16).fold(0, |bits, i| {
        let (bin, within) = (i / 16, i % 16);
        let place = |k: u32| ((bin >> (3 * k) & 7) as f32 + ((within >> (2 * k) & 3) as f32 + 0.5) / 4.0) / 8.0;
        let d = cosine_hemisphere([place(0), place(1)]);
        let ray = Ray::new(r.shadow_origin, t * d.x + b * d.y + Vec3::Z * d.z);
        bits | u64::from(!direct.scene.occluded(&ray)) << bin
    })
}

#[test]
fn guided_rays_to_a_sky_bring_the_same_light_with_less_noise() {
    let mut hole = [Vec3::ZERO; 4];
    let scene = floor(|data, builder| {
        hole = roof(builder);
        data.add_light(sky(2.0)).unwrap();
    });
    let direct = DirectLight::new(&scene);
    let r = receiver(&scene, Vec3::ZERO, Vec3::Z);
    let expected = 2.0 * lambert(r.origin, hole);
    assert!(expected < 0.02 * 2.0 * f64::from(PI), "a small window: {expected}");
    let seen = seen(&direct);
    assert!((1..=8).contains(&seen.count_ones()), "{seen:b}");
    let [[plain, noise], [mean, less]] = [None, Some(seen)].map(|seen| guided(&direct, seen, 20_000));
    // (Standard errors, by the rays that pass the hole: 2.3 %, less than 0.8 % and, at last, 3.3 %.)
    assert!((plain / expected - 1.0).abs() < 0.06, "{plain}, not {expected}");
    assert!((mean / expected - 1.0).abs() < 0.01, "{mean}, not {expected}");
    // (The hole is in 1 to 8 of 64 bins, and many samples go to the bins beside them.)
    assert!(less < 0.2 * noise, "variance {noise}, guided {less}");
    // A guide that knows nothing of the window misses none of its light.
    let [mean, _] = guided(&direct, Some(1 << 63 | 1 << 7), 40_000);
    assert!((mean / expected - 1.0).abs() < 0.06, "{mean}, not {expected}");
}

#[test]
fn guided_rays_to_an_image_bring_the_same_light_with_less_noise() {
    use crate::scene::Environment;
    let rgb = (0..64).map(|i| [0.2 + uniform(i, 0, 7); 3]).collect();
    let image = Environment::new(16, 4, rgb).unwrap();
    let scene = floor(|data, builder| {
        roof(builder);
        let environment = data.add_environment(image);
        data.add_light(Light::Sky { radiance: [3.0; 3], environment, up: Vec3::Z, rotation: 0.4 }).unwrap();
    });
    let direct = DirectLight::new(&scene);
    let seen = seen(&direct);
    let [[plain, noise], [mean, less]] = [None, Some(seen)].map(|seen| guided(&direct, seen, 40_000));
    assert!((mean / plain - 1.0).abs() < 0.05, "{mean}, not {plain}");
    // (Half of the rays go to what is bright in the image, without a guide.)
    assert!(less < 0.25 * noise, "variance {noise}, guided {less}");
    let [other, _] = guided(&direct, Some(1 << 63 | 1 << 7), 40_000);
    assert!((other / plain - 1.0).abs() < 0.08, "{other}, not {plain}");
}
