//! Scenes and rays that several benches share.
//!
//! The scene is the built-in atrium, or the file that `BAKELITE_BENCH_SCENE` names.

use bakelite::bvh::{BuildOptions, BuildQuality};
use bakelite::sampling::{concentric_disc, cosine_around, orthonormal_basis, sobol_2d, uniform, uniform_triangle};
use bakelite::scene::builtin;
use bakelite::trace::{Hit, Ray};
use bakelite::{Device, DeviceOptions, Isa, Light, Progress, Scene, SceneData};
use glam::Vec3;
use std::env;
use std::f32::consts::TAU;
use std::path::Path;
use std::sync::Arc;

pub fn data() -> SceneData {
    let Ok(path) = env::var("BAKELITE_BENCH_SCENE") else { return builtin("atrium").expect("scene") };
    load(&path)
}

/// Reads a scene file. Relative paths start at the folder of the library: cargo runs benches in their own.
pub fn load(path: &str) -> SceneData {
    let mut data = SceneData::new();
    let path = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/..")).join(path);
    bakelite::io::load(&path, &mut data).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    assert!(data.triangle_count() > 0, "{} has no triangles", path.display());
    data
}

/// Committed on one thread.
pub fn commit(isa: Isa, quality: BuildQuality) -> Arc<Scene> {
    commit_data(data(), isa, quality)
}

/// The same with a point light in the middle if it has no light.
pub fn commit_lit(isa: Isa, quality: BuildQuality) -> Arc<Scene> {
    let mut data = data();
    if data.lights().is_empty() {
        let positions = || data.meshes().iter().flat_map(|m| &m.positions);
        let lower = positions().fold(Vec3::INFINITY, |a, &b| a.min(b));
        let upper = positions().fold(Vec3::NEG_INFINITY, |a, &b| a.max(b));
        let light = Light::Point { position: (lower + upper) * 0.5, intensity: [1.0; 3] };
        data.add_light(light).expect("light");
    }
    commit_data(data, isa, quality)
}

fn commit_data(data: SceneData, isa: Isa, quality: BuildQuality) -> Arc<Scene> {
    let device = Device::new(DeviceOptions { isa: Some(isa), num_threads: 1, ..Default::default() }).expect("device");
    let options = BuildOptions { quality, ..Default::default() };
    Scene::commit(&device, data, &options, &Progress::none()).map_err(|e| e.1).expect("commit")
}

/// Points a little above random triangles, with unit normals. (Of triangles with an area: thesis 4.1.2.)
pub fn origins(scene: &Scene, count: u32) -> Vec<(Vec3, Vec3)> {
    let valid: Vec<u32> = (0..scene.triangle_count()).filter(|&t| scene.is_valid(t)).collect();
    (0..count)
        .map(|i| {
            let triangle = valid[(uniform(i, 0, 1) * valid.len() as f32) as usize];
            let [a, b, c] = scene.corners(triangle);
            let [u, v] = uniform_triangle(sobol_2d(i, 2));
            let n = scene.normal(triangle);
            (a + u * (b - a) + v * (c - a) + 1e-4 * scene.diagonal() * n, n)
        })
        .collect()
}

/// Cosine-distributed, as a gather's.
pub fn directions(normal: Vec3, seed: u32, count: u32) -> impl Iterator<Item = [f32; 3]> {
    (0..count).map(move |i| cosine_around(normal, sobol_2d(i, seed)).to_array())
}

/// From random points into the hemisphere, uniformly: thesis 4.1.2.
pub fn incoherent(scene: &Scene, count: u32) -> Vec<Ray> {
    let into_hemisphere = |(i, (origin, n)): (usize, (Vec3, Vec3))| {
        let [z, turn] = sobol_2d(i as u32, 3);
        let (t, b) = orthonormal_basis(n);
        let (sin, cos) = (TAU * turn).sin_cos();
        Ray::new(origin, (1.0 - z * z).sqrt() * (cos * t + sin * b) + z * n)
    };
    origins(scene, count).into_iter().enumerate().map(into_hemisphere).collect()
}

/// Between random points.
pub fn segments(scene: &Scene, count: u32) -> Vec<Ray> {
    let points = origins(scene, 2 * count);
    points.chunks_exact(2).map(|p| Ray::new(p[0].0, p[1].0 - p[0].0).within(0.0, 1.0 - 1e-4)).collect()
}

/// A pinhole camera's, 90 degrees, in tiles of 4 x 4 pixels; from the one of some points that sees the most, toward the
/// middle. side: pixels, a multiple of 4.
pub fn camera(scene: &Scene, side: u32) -> Vec<Ray> {
    let (lower, upper) = scene.bounds();
    let from = |eye: Vec3, side: u32| {
        let z = ((lower + upper) * 0.5 - eye).normalize();
        let (x, y) = orthonormal_basis(z);
        let tile_side = side / 4;
        (0..side * side).map(move |i| {
            let (tile, p) = (i / 16, i % 16);
            let pixel = |tile: u32, p: u32| 2.0 * ((4 * tile + p) as f32 + 0.5) / side as f32 - 1.0;
            Ray::new(eye, z + pixel(tile % tile_side, p % 4) * x + pixel(tile / tile_side, p / 4) * y)
        })
    };
    let seen = |eye: Vec3| {
        let rays: Vec<Ray> = from(eye, 16).collect();
        let mut hits = vec![Hit::MISS; rays.len()];
        scene.intersect_many(&rays, false, &mut hits).expect("rays");
        hits.iter().filter(|h| h.t.is_finite()).map(|h| (h.t / (0.1 * scene.diagonal())).min(1.0)).sum::<f32>()
    };
    let eyes = origins(scene, 64).into_iter().map(|(p, n)| p + 0.02 * scene.diagonal() * n);
    let eye = eyes.max_by(|&a, &b| seen(a).total_cmp(&seen(b))).expect("a point");
    from(eye, side).collect()
}

pub fn median(mut v: Vec<f64>) -> f64 {
    v.sort_by(f64::total_cmp);
    v[v.len() / 2]
}

/// Sums of the areas of the triangles up to each.
pub fn areas(scene: &Scene) -> Vec<f32> {
    let area = |t: u32| {
        let [a, b, c] = scene.corners(t).map(|v| v.as_dvec3());
        0.5 * (b - a).cross(c - a).length()
    };
    let sums = (0..scene.triangle_count()).scan(0.0, |sum, t| {
        *sum += area(t);
        Some(*sum as f32)
    });
    sums.collect()
}

/// Rays of a tile of `side`² texels, `rays` each, at a place that is uniform over the surface.
pub fn tile(scene: &Scene, areas: &[f32], number: u32, side: u32, rays: u32, spacing: f32) -> Vec<Ray> {
    let at = uniform(number, 0, 7) * areas[areas.len() - 1];
    let t = areas.partition_point(|&sum| sum <= at).min(areas.len() - 1);
    let [a, b, c] = scene.corners(t as u32);
    let normal = (b - a).cross(c - a).normalize();
    let normal = if uniform(number, 3, 7) < 0.5 { normal } else { -normal };
    let (u, v) = (uniform(number, 1, 7), uniform(number, 2, 7));
    let (u, v) = if u + v > 1.0 { (1.0 - u, 1.0 - v) } else { (u, v) };
    let centre = a + u * (b - a) + v * (c - a) + 1e-3 * normal;
    let (tangent, bitangent) = orthonormal_basis(normal);
    let mut out = Vec::new();
    for y in 0..side {
        for x in 0..side {
            let origin = centre + spacing * (x as f32 * tangent + y as f32 * bitangent);
            for i in 0..rays {
                let seed = number * 1000 + y * side + x;
                let [p, q] = concentric_disc([uniform(i, 4, seed), uniform(i, 5, seed)]);
                let z = (1.0 - p * p - q * q).max(0.0).sqrt();
                out.push(Ray::new(origin, p * tangent + q * bitangent + z * normal));
            }
        }
    }
    out
}
