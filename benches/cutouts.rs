//! What holes cut out by alpha cost rays: layers of leaves of which the image leaves about half, against the
//! same triangles without holes, and against rays that meet no leaf's hole.
//!
//! Measured with AVX2 on one thread of a shared machine, against the same rays without holes: where the first
//! leaf of half of the rays is met in a hole, closest hits take 3.2 times as long and occlusion 4.4 times, for
//! rays there go on through the leaves behind; where no ray's first leaf is, closest hits take 1.2 times as
//! long (the look-ups) and occlusion 3 times: what occludes a ray is not known, so each is searched again.

use bakelite::bvh::BuildOptions;
use bakelite::sampling::{sobol_2d, uniform, uniform_sphere};
use bakelite::scene::{Material, Mesh, MeshMaterials, NONE, Texture};
use bakelite::trace::{Hit, Ray};
use bakelite::{Device, DeviceOptions, Progress, Scene, SceneData};
use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use glam::{Vec2, Vec3};
use std::sync::Arc;

const RAYS: u32 = 1 << 14;

/// Leaves in the unit cube, and the length of their sides.
const LEAVES: u32 = 10_000;
const SIDE: f32 = 0.04;

/// Texels along each axis of the leaves' image.
const TEXELS: u32 = 32;

/// A disc that covers half of the image.
fn leaf() -> Texture {
    let is_leaf = |i: u32| {
        let place = Vec2::new((i % TEXELS) as f32, (i / TEXELS) as f32) + 0.5 - 0.5 * TEXELS as f32;
        place.length() < 0.4 * TEXELS as f32
    };
    let alpha = |i| if is_leaf(i) { 255 } else { 0 };
    Texture { width: TEXELS, height: TEXELS, rgba8: (0..TEXELS * TEXELS).map(|i| [99, 150, 50, alpha(i)]).collect() }
}

/// Squares in all directions.
fn leaves(material: u32) -> Mesh {
    let mut mesh = Mesh { materials: MeshMaterials::One(material), ..Default::default() };
    for i in 0..LEAVES {
        let place = Vec3::from([0, 1, 2].map(|d| uniform(i, d, 1)));
        let (x, y) = uniform_sphere([uniform(i, 3, 1), uniform(i, 4, 1)]).any_orthonormal_pair();
        let first = mesh.positions.len() as u32;
        for [u, v] in [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]] {
            mesh.positions.as_vec().push(place + SIDE * ((u - 0.5) * x + (v - 0.5) * y));
            mesh.uvs.as_vec().push(Vec2::new(u, v));
        }
        mesh.indices.as_vec().extend([[first, first + 1, first + 2], [first, first + 2, first + 3]]);
    }
    mesh
}

/// The leaves; `holes`: cut out by the image or not.
fn scene(holes: bool) -> Arc<Scene> {
    let device = Device::new(DeviceOptions { num_threads: 1, ..Default::default() }).expect("device");
    let mut data = SceneData::new();
    let albedo_texture = if holes { data.add_texture(leaf()).expect("texture") } else { NONE };
    let alpha_cutoff = if holes { 0.5 } else { 0.0 };
    let material = Material { two_sided: true, albedo_texture, alpha_cutoff, ..Default::default() };
    let material = data.add_material(material).expect("material");
    data.add_mesh(leaves(material)).expect("mesh");
    Scene::commit(&device, data, &BuildOptions::default(), &Progress::none()).map_err(|e| e.1).expect("commit")
}

/// From around the cube through it, far enough to leave it again.
fn through() -> Vec<Ray> {
    let ray = |i: u32| {
        let from = 1.8 * uniform_sphere(sobol_2d(i, 2));
        let to = Vec3::from([0, 1, 2].map(|d| uniform(i, d, 3))) - 0.5;
        Ray::new(from + 0.5, to - from).within(0.0, 2.0)
    };
    (0..RAYS).map(ray).collect()
}

fn cutouts(c: &mut Criterion) {
    let (opaque, cut) = (scene(false), scene(true));
    let all = through();
    // Those whose first leaf is the same with holes and without.
    let solid: Vec<Ray> = all.iter().copied().filter(|r| opaque.intersect(r) == cut.intersect(r)).collect();
    println!("{} of {RAYS} rays meet no hole first", solid.len());
    let mut group = c.benchmark_group("cutouts");
    for (name, scene, rays) in [
        ("all rays, no holes", &opaque, &all),
        ("all rays, holes", &cut, &all),
        ("rays that meet no hole, no holes", &opaque, &solid),
        ("rays that meet no hole, holes", &cut, &solid),
    ] {
        let (mut hits, mut occluded) = (vec![Hit::MISS; rays.len()], vec![0; rays.len()]);
        group.throughput(Throughput::Elements(rays.len() as u64));
        group.bench_function(BenchmarkId::new("closest", name), |b| {
            b.iter(|| scene.intersect_many(rays, false, &mut hits).expect("rays"));
        });
        group.bench_function(BenchmarkId::new("occluded", name), |b| {
            b.iter(|| scene.occluded_many(rays, false, &mut occluded).expect("rays"));
        });
    }
    group.finish();
}

criterion_group!(benches, cutouts);
criterion_main!(benches);
