//! Every kernel on every ISA: rays of all kinds, of closest hits also against the binary baseline, and what
//! makes the tree. The scene and its rays: common/mod.rs.

use bakelite::bvh::{BinaryBvh, BuildOptions, BuildQuality};
use bakelite::trace::{Hit, baseline};
use bakelite::{Isa, Progress, Scene};
use common::{camera, commit, data, directions, incoherent, origins, segments};
use criterion::{BatchSize, BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use glam::Vec3;

/// 32768 rays of every kind.
const RAYS: u32 = 1 << 15;
const SIDE: u32 = 180;

fn rays(c: &mut Criterion) {
    let mut group = c.benchmark_group("rays");
    for isa in Isa::available() {
        let scene = commit(isa, BuildQuality::Default);
        let mut hits = vec![Hit::MISS; RAYS as usize];
        let random = incoherent(&scene, RAYS);
        group.throughput(Throughput::Elements(RAYS as u64));
        group.bench_function(BenchmarkId::new("closest", isa.name()), |b| {
            b.iter(|| scene.intersect_many(&random, false, &mut hits).expect("rays"));
        });
        group.bench_function(BenchmarkId::new("closest, one by one", isa.name()), |b| {
            b.iter(|| random.iter().filter(|r| scene.intersect(r).t.is_finite()).count());
        });
        let between = segments(&scene, RAYS);
        let mut occluded = vec![0; between.len()];
        group.bench_function(BenchmarkId::new("occluded", isa.name()), |b| {
            b.iter(|| scene.occluded_many(&between, false, &mut occluded).expect("rays"));
        });
        for size in [32, 256] {
            let packets: Vec<(Vec3, Vec<[f32; 3]>)> = (origins(&scene, RAYS / size).iter().enumerate())
                .map(|(i, &(o, n))| (o, directions(n, i as u32, size).collect()))
                .collect();
            group.bench_function(BenchmarkId::new(format!("gather{size}"), isa.name()), |b| {
                b.iter(|| {
                    for ((o, p), h) in packets.iter().zip(hits.chunks_mut(size as usize)) {
                        scene.gather(*o, p, f32::INFINITY, false, h).expect("packet");
                    }
                });
            });
        }
        if isa == Isa::Portable {
            let corners: Vec<[Vec3; 3]> = (0..scene.triangle_count()).map(|t| scene.corners(t)).collect();
            let ids: Vec<u32> = (0..scene.triangle_count()).filter(|&t| scene.is_valid(t)).collect();
            let tree = BinaryBvh::build(&|t| corners[t as usize], &ids, &BuildOptions::default(), &Progress::none())
                .expect("tree");
            group.bench_function(BenchmarkId::new("closest", "binary baseline"), |b| {
                b.iter(|| random.iter().filter(|r| !baseline::closest(&tree, &corners, r).is_miss()).count());
            });
        }
        let primary = camera(&scene, SIDE);
        let mut hits = vec![Hit::MISS; primary.len()];
        group.throughput(Throughput::Elements(primary.len() as u64));
        group.bench_function(BenchmarkId::new("primary", isa.name()), |b| {
            b.iter(|| scene.intersect_many(&primary, false, &mut hits).expect("rays"));
        });
    }
    group.finish();
}

/// Commits of both qualities and a refit that moves everything, on one thread.
fn trees(c: &mut Criterion) {
    let mut group = c.benchmark_group("trees");
    group.sample_size(10);
    for isa in Isa::available() {
        let mut scene = commit(isa, BuildQuality::Default);
        group.throughput(Throughput::Elements(scene.triangle_count() as u64));
        let device = scene.device().clone();
        for quality in BuildQuality::ALL {
            let options = BuildOptions { quality, ..Default::default() };
            group.bench_function(BenchmarkId::new(format!("commit, {}", quality.name()), isa.name()), |b| {
                b.iter_batched(
                    data,
                    |data| Scene::commit(&device, data, &options, &Progress::none()).map_err(|e| e.1).expect("commit"),
                    BatchSize::PerIteration,
                );
            });
        }
        let positions: Vec<Vec<Vec3>> = scene.meshes().iter().map(|m| m.positions.to_vec()).collect();
        let moved: Vec<(u32, &[Vec3])> = positions.iter().enumerate().map(|(m, p)| (m as u32, &p[..])).collect();
        group.bench_function(BenchmarkId::new("refit", isa.name()), |b| {
            b.iter(|| Scene::refit(&mut scene, &moved).expect("refit"));
        });
    }
    group.finish();
}

criterion_group!(benches, rays, trees);
criterion_main!(benches);
