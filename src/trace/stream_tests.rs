//! Streams against single rays, bit by bit: on every ISA, in whole and compact trees.

use super::four_wide::FourWide;
use super::{Hit, RawHit, Ray};
use crate::base::progress::Progress;
use crate::base::sampling::{uniform, uniform_sphere};
use crate::bvh::BuildOptions;
use crate::device::{Device, DeviceOptions};
use crate::scene::{Material, Mesh, Scene, SceneData};
use crate::simd::Isa;
use glam::Vec3;
use std::sync::Arc;

fn point(i: u32, dimension: u32, seed: u32) -> Vec3 {
    Vec3::from_array([0, 1, 2].map(|a| uniform(i, dimension + a, seed))) * 2.0 - 1.0
}

/// Triangles of a size, from −1 to 1; every eighth is there twice.
fn soup(n: u32, size: f32, seed: u32) -> Vec<[Vec3; 3]> {
    let corner = |i: u32, k: u32| point(i - u32::from(i % 8 == 7), k, seed);
    (0..n).map(|i| [corner(i, 0), corner(i, 0) + size * corner(i, 3), corner(i, 0) + size * corner(i, 6)]).collect()
}

/// The scene of these triangles on every ISA, whole and compact.
fn scenes(triangles: &[[Vec3; 3]], max_leaf: u32) -> Vec<Arc<Scene>> {
    let mut all = Vec::new();
    for isa in Isa::available() {
        let device = Device::new(DeviceOptions { isa: Some(isa), num_threads: 1, ..Default::default() }).unwrap();
        for compact in [false, true] {
            let mut data = SceneData::new();
            data.add_material(Material::default()).unwrap();
            let indices = (0..triangles.len() as u32).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
            data.add_mesh(Mesh { positions: triangles.concat().into(), indices, ..Default::default() }).unwrap();
            let options = BuildOptions { max_leaf, compact, ..Default::default() };
            all.push(Scene::commit(&device, data, &options, &Progress::none()).map_err(|e| e.1).unwrap());
        }
    }
    all
}

/// Rays from within `extent` of a place, in all directions.
fn rays(n: u32, extent: f32, seed: u32) -> Vec<Ray> {
    let ray = |i: u32| {
        let direction = uniform_sphere([uniform(i, 3, seed), uniform(i, 4, seed)]);
        Ray::new(0.3 * point(0, 20, seed) + extent * point(i, 0, seed), direction)
    };
    (0..n).map(ray).collect()
}

/// Returns how many rays hit something.
fn assert_same(scene: &Scene, rays: &[Ray], what: &str) -> usize {
    let bits = |h: &RawHit| (h.t.to_bits(), h.u.to_bits(), h.v.to_bits(), h.triangle, h.front);
    let what = format!("{what} {:?}, {} rays", scene.device().isa(), rays.len());
    let mut hits = vec![RawHit { t: f32::NAN, ..RawHit::MISS }; rays.len()];
    let mut occluded = vec![2; rays.len()];
    scene.intersect_stream(rays, &mut hits);
    scene.occluded_stream(rays, &mut occluded);
    let mut count = 0;
    for (i, ray) in rays.iter().enumerate() {
        let alone = scene.intersect_raw(ray);
        assert_eq!(bits(&hits[i]), bits(&alone), "{what}: {i} {ray:?}");
        assert_eq!(occluded[i], u8::from(scene.occluded(ray)), "{what}: {i} {ray:?}");
        count += usize::from(!alone.is_miss());
    }
    count
}

#[test]
fn streams_of_any_length_have_the_hits_of_single_rays() {
    for (n, size, max_leaf) in [(1, 1.0, 4), (60, 0.7, 8), (500, 0.2, 1), (3000, 0.1, 3), (3000, 0.1, 4)] {
        for scene in scenes(&soup(n, size, n), max_leaf) {
            for (count, extent) in [(0, 0.0), (1, 0.0), (23, 0.1), (200, 0.0), (1500, 0.05), (5000, 1.5)] {
                let hit = assert_same(&scene, &rays(count, extent, count), &format!("{n} triangles"));
                assert!(n < 60 || count < 200 || hit as u32 > count / 8, "{hit} of {count} hit");
            }
        }
    }
}

#[test]
fn long_streams_have_the_hits_of_single_rays() {
    for scene in scenes(&soup(2000, 0.1, 8), 4) {
        assert!(assert_same(&scene, &rays(16_384, 0.02, 1), "long") > 1000);
    }
}

#[test]
fn rays_that_streams_leave_alone_have_their_hits() {
    for scene in scenes(&soup(2000, 0.2, 9), 4) {
        let mut rays = rays(3000, 0.05, 2);
        for (i, ray) in rays.iter_mut().enumerate() {
            let [x, y, z] = ray.direction;
            match i % 16 {
                0 => ray.direction = [x, 0.0, z],
                1 => ray.direction = [0.0, -0.0, z],
                2 => ray.direction = [x, f32::NAN, z],
                3 => ray.direction = [f32::INFINITY, y, z],
                4 => ray.direction = [0.0; 3],
                5 => ray.direction = [1e-30 * x, 1e-30 * y, 1e-30 * z],
                6 => ray.direction = [1e30 * x, 1e30 * y, 1e30 * z],
                7 => ray.direction = [x, 1e-12 * y, z],
                8 => ray.origin[i / 16 % 3] = f32::NAN,
                9 => ray.origin[i / 16 % 3] = 2e18,
                10 => (ray.tmin, ray.tmax) = (f32::NAN, 1.0),
                11 => (ray.tmin, ray.tmax) = (0.5, 0.5),
                12 => (ray.tmin, ray.tmax) = (-2.0, 0.3),
                13 => ray.tmax = 0.4,
                14 => ray.direction = [x, x, -x],
                _ => {}
            }
        }
        assert!(assert_same(&scene, &rays, "special") > 1000);
    }
}

/// Shadow rays from texels around a place to lamps: straight above it, so that several octants and axes meet in a tile,
/// at an angle, near it and far off, with other ends; to lights of a size; and all of that far from the coordinates'
/// origin.
#[test]
fn shadow_rays_of_tiles_have_the_hits_of_single_rays() {
    for shift in [Vec3::ZERO, Vec3::new(1000.0, -300.0, 7e4)] {
        let triangles: Vec<_> = soup(3000, 0.1, 21).into_iter().map(|t| t.map(|v| v + shift)).collect();
        for scene in scenes(&triangles, 4) {
            let (mut hit, mut count) = (0, 0);
            for seed in 0..24u32 {
                let place = 0.8 * point(seed, 0, 31);
                let n = [17, 256, 700, 1500][seed as usize % 4];
                let extent = [0.02, 0.1, 0.3][seed as usize / 4 % 3];
                let size = [0.0, 0.0, 0.05, 0.5][seed as usize / 3 % 4];
                let lamp = match seed % 3 {
                    0 => place + 0.6 * Vec3::Y,
                    1 => 2.0 * point(seed, 3, 31),
                    _ => place + 40.0 * point(seed, 3, 31),
                };
                let ray = |i: u32| {
                    let flat = Vec3::new(1.0, 0.0, 1.0);
                    let origin = place + extent * flat * point(i, 0, seed) + shift;
                    let end = lamp + size * point(i, 3, seed) + shift;
                    let (tmin, tmax) = [(0.0, 1.0), (0.0, 0.999), (0.1, 0.6), (-0.5, 1.0)][seed as usize / 6];
                    Ray::new(origin, end - origin).within(tmin, tmax)
                };
                let rays: Vec<Ray> = (0..n).map(ray).collect();
                hit += assert_same(&scene, &rays, &format!("lamp {seed}"));
                count += rays.len();
            }
            assert!(hit > count / 10 && hit < count - count / 10, "{hit} of {count}");
        }
    }
}

/// Shadow rays of tiles to a sun, from within the scene and from outside of it; in some tiles some of them end.
#[test]
fn parallel_rays_to_infinity_have_the_hits_of_single_rays() {
    for shift in [Vec3::ZERO, Vec3::new(1000.0, -300.0, 7e4)] {
        let triangles: Vec<_> = soup(3000, 0.1, 21).into_iter().map(|t| t.map(|v| v + shift)).collect();
        for scene in scenes(&triangles, 4) {
            let (mut hit, mut count) = (0, 0);
            for seed in 0..24u32 {
                let place = [0.8, 2.0][seed as usize % 2] * point(seed, 0, 31) + shift;
                let to_sun = point(seed, 3, 31) * [1.0, 1e-3, 1e4][seed as usize / 2 % 3];
                let ray = |i: u32| {
                    let flat = Vec3::new(1.0, 0.0, 1.0);
                    let ray = Ray::new(place + [0.05, 0.4][seed as usize / 6 % 2] * flat * point(i, 0, seed), to_sun);
                    let ends = seed % 4 == 3 && i.is_multiple_of(3);
                    if ends { ray.within(0.0, 0.3 / to_sun.length()) } else { ray }
                };
                let rays: Vec<Ray> = (0..[100, 1000][seed as usize / 12]).map(ray).collect();
                hit += assert_same(&scene, &rays, &format!("sun {seed}"));
                count += rays.len();
            }
            assert!(hit > count / 10 && hit < count - count / 10, "{hit} of {count}");
        }
    }
}

#[test]
fn groups_of_rays_from_scattered_places_have_the_hits_of_single_rays() {
    for scene in scenes(&soup(3000, 0.1, 6), 4) {
        let rays: Vec<Ray> = (0..40).flat_map(|place| rays(128, 0.0, place)).collect();
        let mut hits = vec![Hit::MISS; rays.len()];
        let mut occluded = vec![2; rays.len()];
        scene.intersect_many(&rays, false, &mut hits).unwrap();
        scene.occluded_many(&rays, false, &mut occluded).unwrap();
        for (i, ray) in rays.iter().enumerate() {
            assert_eq!(hits[i], scene.intersect(ray), "{:?}: {i} {ray:?}", scene.device().isa());
            assert_eq!(occluded[i], u8::from(scene.occluded(ray)), "{:?}: {i} {ray:?}", scene.device().isa());
        }
        assert!(hits.iter().filter(|h| h.t.is_finite()).count() > 1000);
    }
}

#[test]
fn four_wide_trees_have_the_hits_of_scenes() {
    let bits = |h: &RawHit| (h.t.to_bits(), h.u.to_bits(), h.v.to_bits(), h.triangle, h.front);
    for (n, size, max_leaf) in [(1, 1.0, 4), (60, 0.7, 8), (3000, 0.1, 3)] {
        for scene in scenes(&soup(n, size, n), max_leaf) {
            let four = FourWide::new(&scene, &BuildOptions { max_leaf, ..Default::default() }).unwrap();
            let mut rays = rays(3000, 0.3, n);
            // Parallel to two axes: the slower test of boxes.
            rays.iter_mut().step_by(50).for_each(|r| r.direction = [0.0, -1.0, 0.0]);
            let mut hits = [vec![RawHit::MISS; rays.len()], vec![RawHit::MISS; rays.len()]];
            four.intersect_many(&rays, &mut hits[0]);
            four.stream(&rays, &mut hits[1]);
            for (i, ray) in rays.iter().enumerate() {
                let (isa, expected) = (scene.device().isa(), scene.intersect_raw(ray));
                for hit in [hits[0][i], hits[1][i], four.intersect(ray)] {
                    assert_eq!(bits(&hit), bits(&expected), "{isa:?}, {n} triangles: {i} {ray:?}");
                }
                assert_eq!(four.occluded(ray), scene.occluded(ray), "{isa:?}, {n} triangles: {i} {ray:?}");
            }
            assert!(n < 60 || hits[0].iter().filter(|h| !h.is_miss()).count() > 300);
        }
    }
}

/// All rays hit all boxes: 4,096 rays, of one octant, are in eight lists on each level, for which there is no room.
#[test]
fn streams_whose_lists_find_no_room_have_the_hits_of_single_rays() {
    let triangles: Vec<[Vec3; 3]> = soup(400, 0.01, 3).into_iter().map(|t| t.map(|v| v * 1e-3)).collect();
    let large =
        |[a, b, c]: [Vec3; 3]| [a + Vec3::new(-9.0, 0.0, -9.0), b + Vec3::new(9.0, 0.0, -9.0), c + 9.0 * Vec3::Z];
    let triangles: Vec<[Vec3; 3]> = triangles.into_iter().map(large).collect();
    for scene in scenes(&triangles, 4) {
        let rays: Vec<Ray> = (0..4096)
            .map(|i| {
                let to = Vec3::new(0.2 + uniform(i, 0, 5), 3.0, 0.2 + uniform(i, 1, 5));
                Ray::new(Vec3::new(0.0, -1.0, -1.0), to)
            })
            .collect();
        assert_eq!(assert_same(&scene, &rays, "no room"), rays.len());
    }
}
