//! Describing and moving scenes of many meshes: the time per mesh must not grow with their number.
//!
//!     cargo bench -p bakelite-benches --bench describe

use bakelite::bvh::BuildOptions;
use bakelite::{Array, Device, DeviceOptions, Light, Material, Mesh, Progress, Scene, SceneData};
use criterion::{BatchSize, BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use glam::Vec3;
use std::sync::Arc;

const COUNTS: [u32; 3] = [5_000, 20_000, 80_000];

/// A mesh of one triangle at a place of its own.
fn mesh(i: u32) -> Mesh {
    let corner = Vec3::new((i % 300) as f32, (i / 300) as f32, 0.0);
    Mesh {
        positions: vec![corner, corner + Vec3::X, corner + Vec3::Y].into(),
        indices: vec![[0, 1, 2]].into(),
        ..Default::default()
    }
}

fn described(count: u32) -> SceneData {
    let mut data = SceneData::new();
    data.add_material(Material::default()).unwrap();
    for i in 0..count {
        data.add_mesh(mesh(i)).unwrap();
    }
    data
}

fn light(i: u32) -> Light {
    Light::Point { position: Vec3::splat(i as f32), intensity: [1.0; 3] }
}

fn committed(mut data: SceneData, device: &Arc<Device>, lights: u32) -> Arc<Scene> {
    for i in 0..lights {
        data.add_light(light(i)).unwrap();
    }
    Scene::commit(device, data, &BuildOptions::default(), &Progress::none()).map_err(|e| e.1).unwrap()
}

fn describe(c: &mut Criterion) {
    let device = Device::new(DeviceOptions::default()).unwrap();
    let mut group = c.benchmark_group("describe");
    group.sample_size(10);
    for count in COUNTS {
        group.throughput(Throughput::Elements(count.into()));
        group.bench_function(BenchmarkId::new("add_mesh", count), |b| b.iter(|| described(count)));
        group.bench_function(BenchmarkId::new("set_light", count), |b| {
            let setup = || committed(described(1), &device, count);
            let change = |scene: Arc<Scene>| (0..count).for_each(|i| scene.set_light(i, light(i + 1)).unwrap());
            b.iter_batched(setup, change, BatchSize::LargeInput);
        });
        group.bench_function(BenchmarkId::new("refit", count), |b| {
            let mut scene = committed(described(count), &device, 0);
            let positions: Vec<Array<Vec3>> = (0..count).map(|i| mesh(i).positions).collect();
            let moved: Vec<(u32, &[Vec3])> = (0..count).zip(positions.iter().map(|p| &p[..])).collect();
            b.iter(|| Scene::refit(&mut scene, &moved).unwrap());
        });
    }
    group.finish();
}

criterion_group!(benches, describe);
criterion_main!(benches);
