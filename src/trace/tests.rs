//! Every query on every ISA against an f64 brute-force oracle.

use super::*;
use crate::base::progress::Progress;
use crate::base::sampling::{orthonormal_basis, sobol_2d, uniform, uniform_sphere};
use crate::device::{Device, DeviceOptions};
use crate::scene::{Material, Mesh, Scene, SceneData};
use crate::simd::Isa;
use glam::DVec3;
use glam::Vec3;
use proptest::prelude::*;
use std::sync::Arc;

fn scene(isa: Isa, triangles: &[[Vec3; 3]], max_leaf: u32) -> Arc<Scene> {
    let device = Device::new(DeviceOptions { isa: Some(isa), num_threads: 1, ..Default::default() }).unwrap();
    let mut data = SceneData::new();
    data.add_material(Material::default()).unwrap();
    let positions: Vec<Vec3> = triangles.iter().flatten().copied().collect();
    let indices = (0..triangles.len() as u32).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
    data.add_mesh(Mesh { positions: positions.into(), indices, ..Default::default() }).unwrap();
    let options = crate::bvh::BuildOptions { max_leaf, ..Default::default() };
    Scene::commit(&device, data, &options, &Progress::none()).map_err(|e| e.1).unwrap()
}

/// t of the ray with a triangle's plane, and the least barycentric weight there.
fn oracle(ray: &Ray, triangle: &[Vec3; 3]) -> Option<(f64, f64)> {
    let [a, b, c] = triangle.map(|v| v.as_dvec3());
    let (o, d) = (DVec3::from(ray.origin.map(f64::from)), DVec3::from(ray.direction.map(f64::from)));
    let n = (b - a).cross(c - a);
    let den = n.dot(d);
    if den.abs() <= 1e-9 * n.length() * d.length() {
        return None;
    }
    let t = n.dot(a - o) / den;
    let p = o + t * d;
    let weight = |v: DVec3, w: DVec3| (w - v).cross(p - v).dot(n) / n.length_squared();
    Some((t, weight(b, c).min(weight(c, a)).min(weight(a, b))))
}

/// By how much rounding may falsify a ray's barycentric weights on a triangle, to first order: much where the triangle
/// is small or narrow as the ray sees it. Infinite where it may be seen from either side.
///
/// The kernels take weights as ratios of areas across the ray, whose corners are relative to its origin and sheared
/// along it (see [`triangle`]).
fn weight_error(ray: &Ray, triangle: &[Vec3; 3]) -> f64 {
    /// Half a unit in the last place of 1.
    const HALF: f64 = f32::EPSILON as f64 / 2.0;
    let (o, d) = (DVec3::from(ray.origin.map(f64::from)), DVec3::from(ray.direction.map(f64::from)));
    let z = (0..3).max_by(|&a, &b| d[a].abs().total_cmp(&d[b].abs())).unwrap();
    let (x, y) = ((z + 1) % 3, (z + 2) % 3);
    let corners = triangle.map(|v| v.as_dvec3() - o);
    let across = corners.map(|c| [c[x] - c[z] * (d[x] / d[z]), c[y] - c[z] * (d[y] / d[z])]);
    let far = corners.iter().map(|c| c.abs().max_element()).fold(0.0, f64::max);
    let wide = across.iter().flatten().map(|c| c.abs()).fold(0.0, f64::max);
    // Two differences, the slope (a reciprocal and a product) and its product, the sum.
    let coordinate = HALF * (5.0 * far + wide);
    // Products of two coordinates, and their difference.
    let area = 4.0 * wide * coordinate + HALF * 4.0 * wide * wide;
    let area_of = |i: usize, j: usize| across[i][0] * across[j][1] - across[i][1] * across[j][0];
    let sum = (area_of(0, 1) + area_of(1, 2) + area_of(2, 0)).abs();
    // Of a quotient of one area by the sum of three.
    if sum > 4.0 * area { 4.0 * area / (sum - 4.0 * area) + 4.0 * HALF } else { f64::INFINITY }
}

/// Checks a hit against all triangles; near edges either answer is right.
fn check(ray: &Ray, triangles: &[[Vec3; 3]], hit: RawHit, what: &str) {
    let (tmin, tmax) = (ray.tmin as f64, ray.tmax as f64);
    let near = |t: f64, e: f64| (t - e).abs() <= 2e-5 * e.abs().max(1.0);
    for (i, triangle) in triangles.iter().enumerate() {
        let Some((t, weight)) = oracle(ray, triangle) else { continue };
        let is_in_range = t > tmin && t < tmax && !near(t, tmin) && !near(t, tmax);
        let certain = is_in_range && weight > 0.0 && weight > weight_error(ray, triangle);
        assert!(
            !certain || hit.t as f64 <= t || near(hit.t as f64, t),
            "{what}: {ray:?} misses {i} at {t}, has {hit:?}"
        );
    }
    if !hit.is_miss() {
        let triangle = &triangles[hit.triangle as usize];
        let (t, weight) = oracle(ray, triangle).expect("a ray in a plane has no hit");
        let [a, b, c] = triangle.map(|v| v.as_dvec3());
        let direction = DVec3::from(ray.direction.map(f64::from));
        // How far from the ray's place in the plane the hit may be, which lies between the triangle's edges.
        let error = weight_error(ray, triangle);
        let bound = error * ((b - a).length() + (c - a).length());
        let is_at_t = near(hit.t as f64, t) || (hit.t as f64 - t).abs() * direction.length() <= bound;
        assert!(weight >= -error && is_at_t, "{what}: {ray:?} {hit:?}, oracle t {t} weight {weight} error {error}");
        assert!(hit.t > ray.tmin && hit.t <= ray.tmax);
        let facing = (b - a).cross(c - a).dot(direction);
        assert!(error.is_infinite() || hit.front == (facing < 0.0), "{what}: {hit:?} {facing}");
        let p = a + f64::from(hit.u) * (b - a) + f64::from(hit.v) * (c - a);
        let q = DVec3::from(ray.origin.map(f64::from)) + t * direction;
        assert!((p - q).length() <= bound, "{what}: {ray:?} {hit:?} barycentrics say {p}, t says {q}, {bound} at most");
    }
}
#[test]
fn hits_on_triangles_seen_edge_on_are_as_accurate_as_their_areas_allow() {
    for thin in [1.0, 0.03, 1e-3] {
        let triangles: Vec<_> = soup(60, 1.0, 31).into_iter().map(|[a, b, c]| [a, b, b + thin * (c - b)]).collect();
        for isa in Isa::available() {
            let scene = scene(isa, &triangles, 1);
            for (i, &[a, b, c]) in (0..).zip(&triangles) {
                let normal = crate::scene::unit_normal([a, b, c]);
                let (x, y) = orthonormal_basis(normal);
                for j in 0..100 {
                    let random = |d| uniform(100 * i + j, d, 3);
                    let [u, v] = crate::base::sampling::uniform_triangle([random(0), random(1)]);
                    let (sin, cos) = (std::f32::consts::TAU * random(2)).sin_cos();
                    let slope = 10f32.powf(-5.0 * random(3));
                    let away = 3.0 * random(4) * (cos * x + sin * y + slope * normal);
                    let ray = Ray::new(a + u * (b - a) + v * (c - a) + away, -away);
                    check(&ray, &triangles, scene.intersect_raw(&ray), &format!("{isa:?} {thin} {slope}"));
                }
            }
        }
    }
}

/// All queries of all ISAs on rays from one origin, against the oracle and each other.
fn check_all(triangles: &[[Vec3; 3]], origin: Vec3, directions: &[[f32; 3]], tmax: f32) {
    for isa in Isa::available() {
        for max_leaf in [1, 3, 8] {
            let scene = scene(isa, triangles, max_leaf);
            let mut gathered = vec![Hit::MISS; directions.len()];
            scene.gather(origin, directions, tmax, false, &mut gathered).unwrap();
            let rays: Vec<Ray> = directions.iter().map(|&d| Ray::new(origin, d.into()).within(0.0, tmax)).collect();
            let mut many = vec![Hit::MISS; rays.len()];
            scene.intersect_many(&rays, false, &mut many).unwrap();
            let mut occluded = vec![2; rays.len()];
            scene.occluded_many(&rays, false, &mut occluded).unwrap();
            for (i, ray) in rays.iter().enumerate() {
                let hit = scene.intersect_raw(ray);
                check(ray, triangles, hit, &format!("{isa:?} leaf {max_leaf} single"));
                assert_eq!(scene.to_hit(hit), many[i]);
                assert_eq!(scene.to_hit(hit), gathered[i], "{isa:?} leaf {max_leaf} gather {ray:?}");
                assert_eq!(occluded[i] == 1, !hit.is_miss());
                assert_eq!(scene.occluded(ray), !hit.is_miss());
            }
        }
    }
}

fn soup(n: u32, size: f32, seed: u32) -> Vec<[Vec3; 3]> {
    let p = |i, k| Vec3::new(uniform(i, k, seed), uniform(i, k + 1, seed), uniform(i, k + 2, seed)) * 2.0 - 1.0;
    (0..n).map(|i| [p(i, 0), p(i, 0) + size * p(i, 3), p(i, 0) + size * p(i, 6)]).collect()
}

fn sphere_directions(n: u32, seed: u32) -> Vec<[f32; 3]> {
    (0..n).map(|i| uniform_sphere(sobol_2d(i, seed)).to_array()).collect()
}

#[test]
fn every_query_finds_the_closest_triangle_of_a_soup() {
    for (n, size, seed) in [(1, 1.0, 1), (4, 1.0, 2), (50, 0.7, 3), (400, 0.2, 4), (3000, 0.05, 5)] {
        let triangles = soup(n, size, seed);
        for (k, origin) in [Vec3::ZERO, Vec3::new(0.3, -0.2, 0.5), Vec3::new(3.0, 0.1, 0.2)].into_iter().enumerate() {
            check_all(&triangles, origin, &sphere_directions(100, k as u32), f32::INFINITY);
            check_all(&triangles, origin, &sphere_directions(33, 7), 0.5);
        }
    }
}

#[test]
fn the_baseline_finds_the_same_triangles() {
    let triangles = soup(2000, 0.1, 4);
    let ids: Vec<u32> = (0..2000).collect();
    let binary =
        crate::bvh::BinaryBvh::build(&|t| triangles[t as usize], &ids, &Default::default(), &Progress::none()).unwrap();
    for d in sphere_directions(2000, 3) {
        let ray = Ray::new(Vec3::new(0.1, 0.2, 0.3), d.into());
        check(&ray, &triangles, baseline::closest(&binary, &triangles, &ray), "baseline");
    }
}

/// Unit squares of an integer grid: the planes x, y, z = 0..n, two triangles each.
fn grid(n: i32) -> Vec<[Vec3; 3]> {
    let mut out = Vec::new();
    for axis in 0..3 {
        for k in [0, n] {
            for i in 0..n {
                for j in 0..n {
                    let p = |i: i32, j: i32| {
                        let mut v = [0.0; 3];
                        (v[axis], v[(axis + 1) % 3], v[(axis + 2) % 3]) = (k as f32, i as f32, j as f32);
                        Vec3::from(v)
                    };
                    out.push([p(i, j), p(i + 1, j), p(i + 1, j + 1)]);
                    out.push([p(i, j), p(i + 1, j + 1), p(i, j + 1)]);
                }
            }
        }
    }
    out
}

#[test]
fn axis_parallel_rays_through_grid_corners_and_edges_hit_the_wall() {
    // Rays along edges and through corners of a closed box of unit squares, with zeros of both signs.
    let triangles = grid(4);
    for isa in Isa::available() {
        let scene = scene(isa, &triangles, 3);
        for axis in 0..3 {
            for sign in [1.0f32, -1.0] {
                for zero in [0.0f32, -0.0] {
                    for i in 1..=7 {
                        for j in 1..=7 {
                            let (mut o, mut d) = ([2.0f32; 3], [zero; 3]);
                            d[axis] = sign;
                            (o[(axis + 1) % 3], o[(axis + 2) % 3]) = (i as f32 / 2.0, j as f32 / 2.0);
                            let ray = Ray { origin: o, tmin: 0.0, direction: d, tmax: f32::INFINITY };
                            let hit = scene.intersect_raw(&ray);
                            assert_eq!(hit.t, 2.0, "{isa:?} {ray:?} {hit:?}");
                            assert!(scene.occluded(&ray));
                            let mut out = [Hit::MISS; 9];
                            scene.gather(o.into(), &[d; 9], f32::INFINITY, false, &mut out).unwrap();
                            assert!(out.iter().all(|&h| h == scene.to_hit(hit)));
                        }
                    }
                }
            }
        }
    }
}

#[test]
fn rays_in_the_plane_of_a_box_face_still_enter_the_box() {
    // A wall across x with its border at y = 0, and rays that run exactly along y = 0.
    let wall = [Vec3::new(5.0, 0.0, -1.0), Vec3::new(5.0, 0.0, 1.0), Vec3::new(5.0, 1.0, 0.0)];
    for isa in Isa::available() {
        for mirror in [1.0, -1.0] {
            let scene = scene(isa, &[wall.map(|v| v * Vec3::new(1.0, mirror, 1.0))], 3);
            for zero in [0.0f32, -0.0] {
                for (ox, oz) in [(0.0, 0.25), (-1000.0, 0.0), (4.0, -0.75)] {
                    let ray =
                        Ray { origin: [ox, 0.0, oz], tmin: 0.0, direction: [1.0, zero, zero], tmax: f32::INFINITY };
                    assert!(!scene.intersect_raw(&ray).is_miss(), "{isa:?} {ray:?}");
                }
            }
        }
    }
}

#[test]
fn coincident_triangles_give_the_lowest_number_on_every_path() {
    let triangles = [soup(40, 0.8, 8), soup(40, 0.8, 8), soup(40, 0.8, 8)].concat();
    for isa in Isa::available() {
        let scene = scene(isa, &triangles, 3);
        for d in sphere_directions(500, 2) {
            let hit = scene.intersect_raw(&Ray::new(Vec3::ZERO, d.into()));
            assert!(hit.is_miss() || hit.triangle < 40, "{isa:?} {hit:?}");
        }
    }
}

#[test]
fn unusable_rays_hit_nothing_and_extreme_lengths_do_not_matter() {
    let triangles = grid(4);
    let good = Ray::new(Vec3::splat(1.3), Vec3::new(0.3, -0.9, 0.2));
    for isa in Isa::available() {
        let scene = scene(isa, &triangles, 3);
        let reference = scene.intersect_raw(&good);
        // Products of distances to the origins at 3e38 would overflow, and made hits with weights 1 and 1.
        for (bad, far) in [(f32::NAN, 1.1e18), (f32::INFINITY, f32::MAX), (f32::NEG_INFINITY, f32::MIN)] {
            for k in 0..3 {
                let mut from_afar = good;
                from_afar.origin[k] = far;
                assert!(scene.intersect_raw(&from_afar).is_miss() && !scene.occluded(&from_afar));
                let mut bundle = [Hit::MISS; 32];
                scene.intersect_many(&[from_afar; 32], false, &mut bundle).unwrap();
                assert_eq!(bundle, [Hit::MISS; 32]);
                let (mut o, mut d) = (good, good);
                o.origin[k] = bad;
                d.direction[k] = bad;
                assert!(scene.intersect_raw(&o).is_miss() && !scene.occluded(&o));
                assert!(scene.intersect_raw(&d).is_miss() && !scene.occluded(&d));
            }
        }
        let zero = Ray { direction: [0.0; 3], ..good };
        assert!(scene.intersect_raw(&zero).is_miss() && !scene.occluded(&zero));
        for (tmin, tmax) in [(1.0, 0.5), (f32::NAN, 1.0), (0.0, f32::NAN), (0.0, -1.0), (f32::INFINITY, f32::INFINITY)]
        {
            assert!(scene.intersect_raw(&good.within(tmin, tmax)).is_miss(), "{tmin} {tmax}");
        }
        for exponent in [-100, -40, -20, -3, 3, 20, 40, 100] {
            let s = 2f32.powi(exponent);
            let ray = Ray { direction: good.direction.map(|d| d * s), ..good };
            let hit = scene.intersect_raw(&ray);
            assert_eq!((hit.triangle, hit.u, hit.v), (reference.triangle, reference.u, reference.v));
            assert_eq!(hit.t, reference.t / s);
            let mut out = [Hit::MISS; 2];
            scene.gather(good.origin.into(), &[ray.direction, good.direction], f32::INFINITY, false, &mut out).unwrap();
            assert_eq!(out, [scene.to_hit(hit), scene.to_hit(reference)]);
        }
        let limit = good.within(0.0, reference.t);
        assert_eq!(scene.intersect_raw(&limit), reference, "tmax is inclusive");
        assert_ne!(scene.intersect_raw(&good.within(reference.t, f32::INFINITY)), reference, "tmin is exclusive");
    }
}

/// A sphere of 2 · rings · segments triangles, watertight by construction.
fn sphere(centre: Vec3, segments: u32, rings: u32) -> Vec<[Vec3; 3]> {
    let p = |i: u32, j: u32| {
        let (theta, phi) = (
            std::f64::consts::PI * j as f64 / rings as f64,
            std::f64::consts::TAU * (i % segments) as f64 / segments as f64,
        );
        let r = if j == 0 || j == rings { 0.0 } else { theta.sin() };
        centre + DVec3::new(r * phi.cos(), r * phi.sin(), theta.cos()).as_vec3()
    };
    let mut out = Vec::new();
    for j in 0..rings {
        for i in 0..segments {
            out.push([p(i, j), p(i, j + 1), p(i + 1, j + 1)]);
            out.push([p(i, j), p(i + 1, j + 1), p(i + 1, j)]);
        }
    }
    out.retain(|t| crate::scene::is_valid_triangle(*t));
    out
}

#[test]
fn no_ray_leaks_between_the_triangles_of_an_edge_of_a_closed_sphere() {
    let triangles = sphere(Vec3::ZERO, 40, 20);
    for isa in Isa::available() {
        let scene = scene(isa, &triangles, 3);
        let mut leaks = 0;
        for (i, t) in triangles.iter().enumerate() {
            for k in 0..3 {
                for s in 0..8 {
                    let x = uniform(i as u32, 8 * k + s, 3);
                    let target = t[k as usize].lerp(t[(k as usize + 1) % 3], x);
                    let o = uniform_sphere(sobol_2d(i as u32, 11 + k)) * 0.5;
                    leaks += scene.intersect_raw(&Ray::new(o, target - o)).is_miss() as u32;
                }
            }
        }
        assert_eq!(leaks, 0, "{isa:?}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn queries_agree_on_random_scenes(n in 1u32..200, size in 0.01f32..2.0, seed: u32, ox in -1.5f32..1.5, oy in -1.5f32..1.5, count in 1usize..70) {
        check_all(&soup(n, size, seed), Vec3::new(ox, oy, 0.1), &sphere_directions(count as u32, seed ^ 5), f32::INFINITY);
    }

    #[test]
    fn narrow_packets_agree_with_single_rays(n in 50u32..500, seed: u32, width in 0.0f32..0.3) {
        let axis = uniform_sphere(sobol_2d(seed, 1));
        let (t, b) = orthonormal_basis(axis);
        let directions: Vec<_> = (0..32)
            .map(|i| { let [x, y] = sobol_2d(i, seed); (axis + width * (x - 0.5) * t + width * (y - 0.5) * b).to_array() })
            .collect();
        check_all(&soup(n, 0.3, seed), Vec3::ZERO, &directions, f32::INFINITY);
    }
}

/// Rays of a pinhole camera with a square picture, in tiles of 4 x 4 pixels.
fn camera(eye: Vec3, toward: Vec3, width: f32, side: usize) -> Vec<Ray> {
    let z = toward.normalize();
    let (x, y) = orthonormal_basis(z);
    let pixel = |i: usize| {
        let (tile, p) = (i / 16, i % 16);
        let (px, py) = (tile % (side / 4) * 4 + p % 4, tile / (side / 4) * 4 + p / 4);
        let at = |p: usize| width * (2.0 * (p as f32 + 0.5) / side as f32 - 1.0);
        Ray::new(eye, z + at(px) * x + at(py) * y)
    };
    (0..side * side).map(pixel).collect()
}

/// Checks that rays together hit what each hits alone, bit for bit.
fn check_together(triangles: &[[Vec3; 3]], rays: &[Ray], what: &str) {
    for isa in Isa::available() {
        for max_leaf in [1, 8] {
            let scene = scene(isa, triangles, max_leaf);
            let mut many = vec![Hit::MISS; rays.len()];
            scene.intersect_many(rays, false, &mut many).unwrap();
            for (i, ray) in rays.iter().enumerate() {
                let alone = scene.to_hit(scene.intersect_raw(ray));
                let bits = |h: Hit| bytemuck::cast::<Hit, [u32; 6]>(h);
                assert_eq!(bits(alone), bits(many[i]), "{what} {isa:?} {ray:?} {alone:?} {:?}", many[i]);
            }
        }
    }
}

#[test]
fn a_camera_sees_what_its_rays_hit_alone() {
    let grid: Vec<[Vec3; 3]> = grid(4).iter().map(|t| t.map(|v| v * 0.5 - 1.0)).collect();
    let twice: Vec<[Vec3; 3]> = soup(300, 0.3, 9).into_iter().flat_map(|t| [t, t]).collect();
    let slivers: Vec<[Vec3; 3]> = soup(500, 0.8, 3).into_iter().map(|[a, b, c]| [a, b, b + 1e-3 * (c - b)]).collect();
    let scenes = [
        ("soup", soup(3000, 0.1, 2)),
        ("large", soup(60, 1.0, 5)),
        ("grid", grid),
        ("twice", twice),
        ("thin", slivers),
    ];
    for (name, triangles) in scenes {
        for octant in 0..8 {
            let sign = |a: usize| if octant >> a & 1 == 1 { -1.0 } else { 1.0 };
            let toward = Vec3::new(sign(0) * 0.9, sign(1) * 0.55, sign(2) * 0.3);
            for toward in [toward, Vec3::new(toward.z, toward.x, toward.y), Vec3::new(toward.y, toward.z, toward.x)] {
                check_together(&triangles, &camera(-1.5 * toward, toward, 0.2, 16), name);
                check_together(&triangles, &camera(Vec3::new(0.1, -0.2, 0.05), toward, 0.1, 16), name);
            }
        }
        // Straddling axes and diagonals; from the planes of triangles.
        for toward in [Vec3::X, Vec3::NEG_Y, Vec3::Z, Vec3::ONE, Vec3::new(1.0, -1.0, 0.0)] {
            check_together(&triangles, &camera(-2.0 * toward, toward, 1.0, 48), name);
            check_together(&triangles, &camera(Vec3::ZERO, toward, 0.3, 32), name);
        }
    }
}

#[test]
fn a_camera_before_triangles_finer_than_pixels_sees_what_its_rays_hit_alone() {
    let triangles = sphere(Vec3::ZERO, 200, 160);
    for side in [12, 40, 70] {
        check_together(&triangles, &camera(Vec3::new(1.0, 2.0, 3.0), Vec3::new(-1.0, -2.0, -3.0), 0.3, side), "fine");
    }
}

#[test]
fn bundles_of_any_length_and_range_hit_what_rays_hit_alone() {
    let triangles = soup(2000, 0.1, 8);
    let rays = camera(Vec3::new(-2.0, -1.0, -0.7), Vec3::new(2.0, 1.0, 0.7), 0.25, 16);
    for n in (1..=80).chain([127, 128, 129, 255]) {
        check_together(&triangles, &rays[..n], "tail");
    }
    for (tmin, tmax) in [(0.5, 1.0), (-1.0, 0.7), (0.0, 1e-3), (1.0, 0.5), (f32::NAN, 1.0), (0.8, f32::INFINITY)] {
        let some: Vec<Ray> = rays.iter().map(|r| r.within(tmin, tmax)).collect();
        check_together(&triangles, &some, "range");
    }
    // Among others; with directions that can hit nothing, and of any length.
    let mut mixed = rays.clone();
    for (i, r) in mixed.iter_mut().enumerate() {
        match i % 97 {
            90 => r.direction[i % 3] = f32::NAN,
            91 => r.direction = [0.0; 3],
            92 => r.origin[i % 3] = f32::INFINITY,
            93 => r.direction[i % 3] = -0.0,
            94 => r.direction = r.direction.map(|d| d * 1e20),
            95 => r.origin[0] += 0.1,
            _ => r.direction = r.direction.map(|d| d * (1.0 + i as f32)),
        }
    }
    check_together(&triangles, &mixed, "mixed");
}
