//! Photon tracing against its bare rays, and irradiance estimates per ISA.
//!
//! On the Cornell box, or on the scene file that `BAKELITE_BENCH_SCENE` names, lit by a point light
//! at `BAKELITE_BENCH_LIGHT` ("x,y,z") or in the middle of the scene.

use bakelite::bvh::BuildOptions;
use bakelite::photon::{PhotonMap, PhotonParams, photon_rays};
use bakelite::scene::builtin;
use bakelite::trace::Hit;
use bakelite::{Device, DeviceOptions, Isa, Light, Progress, Scene, SceneData};
use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use glam::Vec3;
use std::env;
use std::sync::Arc;

const PHOTONS: u64 = 200_000;
const ESTIMATES: usize = 20_000;

fn data() -> SceneData {
    let Ok(path) = env::var("BAKELITE_BENCH_SCENE") else { return builtin("cornell").expect("scene") };
    let mut data = common::load(&path);
    let position = match env::var("BAKELITE_BENCH_LIGHT") {
        Ok(text) => {
            let xyz: Vec<f32> = text.split(',').map(|x| x.parse().expect("a number")).collect();
            Vec3::from_slice(&xyz)
        }
        Err(_) => {
            let positions = || data.meshes().iter().flat_map(|m| &m.positions);
            let lower = positions().fold(Vec3::INFINITY, |a, &b| a.min(b));
            let upper = positions().fold(Vec3::NEG_INFINITY, |a, &b| a.max(b));
            (lower + upper) * 0.5
        }
    };
    data.add_light(Light::Point { position, intensity: [1.0; 3] }).expect("light");
    data
}

fn commit(isa: Isa) -> Arc<Scene> {
    let device = Device::new(DeviceOptions { isa: Some(isa), ..Default::default() }).expect("device");
    Scene::commit(&device, data(), &BuildOptions::default(), &Progress::none()).map_err(|e| e.1).expect("commit")
}

/// Rays per second with emission, shading, storing and sorting, and without.
fn tracing(c: &mut Criterion) {
    let scene = commit(Isa::best());
    let params = PhotonParams { photon_count: PHOTONS, ..Default::default() };
    let rays = photon_rays(&scene, &params).expect("rays");
    let mut hits = vec![Hit::MISS; rays.len()];
    let mut group = c.benchmark_group("photon rays");
    group.sample_size(20).throughput(Throughput::Elements(rays.len() as u64));
    group.bench_function("bare", |b| b.iter(|| scene.intersect_many(&rays, true, &mut hits).expect("rays")));
    group.bench_function("traced", |b| {
        b.iter(|| PhotonMap::trace(&scene, &params, &Progress::none()).expect("map"));
    });
    group.finish();
    let map = PhotonMap::trace(&scene, &params, &Progress::none()).expect("map");
    println!("{:?}, radius {}, {} bytes", map.stats(), map.radius(), map.bytes());
}

/// Estimates at photons spread over the map, with the automatic radius.
fn estimates(c: &mut Criterion) {
    let mut group = c.benchmark_group("estimates");
    group.throughput(Throughput::Elements(ESTIMATES as u64));
    for isa in Isa::available() {
        let scene = commit(isa);
        let params = PhotonParams { photon_count: 1_000_000, ..Default::default() };
        let map = PhotonMap::trace(&scene, &params, &Progress::none()).expect("map");
        let view = map.columns();
        let step = view.len() / ESTIMATES;
        let pick = |c: [&[f32]; 3]| (0..ESTIMATES).map(|i| c.map(|c| c[i * step])).collect::<Vec<_>>();
        let (positions, normals) = (pick(view.position), pick(view.normal));
        let mut out = vec![[0.0; 3]; ESTIMATES];
        group.bench_function(BenchmarkId::new("one thread", isa.name()), |b| {
            b.iter(|| map.estimate_block(&positions, &normals, &mut out));
        });
    }
    group.finish();
}

criterion_group!(benches, tracing, estimates);
criterion_main!(benches);
