//! Ray kernels on the built-in scenes, per ISA, against the binary baseline. Rays as in thesis
//! 4.1.2: from random points of random triangles into the hemisphere; gather packets from such
//! points with cosine-distributed directions.

use bakelite::bvh::{BinaryBvh, BuildOptions};
use bakelite::sampling::{cosine_hemisphere, orthonormal_basis, sobol_2d, uniform, uniform_triangle};
use bakelite::scene::builtin;
use bakelite::trace::{Hit, Ray, baseline};
use bakelite::{Device, DeviceOptions, Isa, Progress, Scene};
use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use glam::Vec3;
use std::sync::Arc;

const ORIGINS: u32 = 1024;

fn scene(isa: Isa) -> Arc<Scene> {
    let device = Device::new(DeviceOptions { isa: Some(isa), num_threads: 1, ..Default::default() }).expect("device");
    let data = builtin("atrium").expect("scene");
    Scene::commit(&device, data, &BuildOptions::default(), &Progress::none()).map_err(|e| e.1).expect("commit")
}

/// Points a little above random triangles, with unit normals.
fn origins(scene: &Scene) -> Vec<(Vec3, Vec3)> {
    (0..ORIGINS)
        .map(|i| {
            let triangle = (uniform(i, 0, 1) * scene.triangle_count() as f32) as u32;
            let [a, b, c] = scene.corners(triangle);
            let [u, v] = uniform_triangle(sobol_2d(i, 2));
            let n = scene.normal(triangle);
            (a + u * (b - a) + v * (c - a) + 1e-4 * n, n)
        })
        .collect()
}

fn directions(normal: Vec3, seed: u32, count: u32) -> impl Iterator<Item = [f32; 3]> {
    let (t, b) = orthonormal_basis(normal);
    (0..count).map(move |i| {
        let d = cosine_hemisphere(sobol_2d(i, seed));
        (d.x * t + d.y * b + d.z * normal).to_array()
    })
}

fn rays(c: &mut Criterion) {
    let mut group = c.benchmark_group("rays");
    group.throughput(Throughput::Elements(ORIGINS as u64 * 32));
    for isa in Isa::available() {
        let scene = scene(isa);
        let origins = origins(&scene);
        let packets: Vec<Vec<[f32; 3]>> =
            origins.iter().enumerate().map(|(i, &(_, n))| directions(n, i as u32, 32).collect()).collect();
        let single: Vec<Ray> = origins
            .iter()
            .zip(&packets)
            .flat_map(|(&(o, _), p)| p.iter().map(move |&d| Ray::new(o, d.into())))
            .collect();
        let mut hits = vec![Hit::MISS; single.len()];
        group.bench_function(BenchmarkId::new("closest", isa.name()), |b| {
            b.iter(|| scene.intersect_many(&single, false, &mut hits).expect("rays"));
        });
        let mut occluded = vec![0; single.len()];
        group.bench_function(BenchmarkId::new("occluded", isa.name()), |b| {
            b.iter(|| scene.occluded_many(&single, false, &mut occluded).expect("rays"));
        });
        let mut packet_hits = [Hit::MISS; 32];
        group.bench_function(BenchmarkId::new("gather32", isa.name()), |b| {
            b.iter(|| {
                for (&(o, _), p) in origins.iter().zip(&packets) {
                    scene.gather(o, p, f32::INFINITY, false, &mut packet_hits).expect("packet");
                }
            });
        });
        if isa == Isa::Portable {
            let corners: Vec<[Vec3; 3]> = (0..scene.triangle_count()).map(|t| scene.corners(t)).collect();
            let ids: Vec<u32> = (0..scene.triangle_count()).collect();
            let tree = BinaryBvh::build(&corners, &ids, &BuildOptions::default(), &Progress::none()).expect("tree");
            group.bench_function(BenchmarkId::new("closest", "binary baseline"), |b| {
                b.iter(|| single.iter().filter(|r| !baseline::closest(&tree, &corners, r).is_miss()).count());
            });
        }
    }
    group.finish();
}

criterion_group!(benches, rays);
criterion_main!(benches);
