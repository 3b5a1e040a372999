//! Memory that runs out: each large allocation of each long call fails once, and so does each request to the memory
//! monitor. The call then ends with an error and nothing is lost: made again, it gives the bits that it would have
//! given at first.
//!
//! A failed allocation aborts the process unless it was asked for with `try_reserve` or the like. So one that was
//! overlooked ends this test with "memory allocation of … bytes failed", after the line that says which one it was.
//!
//! One test, because the allocator is that of the whole process.

use bakelite::bvh::{BuildOptions, BuildQuality};
use bakelite::io::{LoadOptions, load_with};
use bakelite::lightmap::{BakeParams, Layer, LayerData, Lightmap, LightmapDesc};
use bakelite::live::{Live, LiveParams, PageRect};
use bakelite::photon::{PhotonMap, PhotonParams};
use bakelite::scene::{LightmapUvs, MeshMaterials};
use bakelite::{Device, DeviceOptions, Error, Light, Material, Mesh, Progress, Result, Scene, SceneData};
use glam::{Vec2, Vec3};
use std::alloc::{GlobalAlloc, Layout, System};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, AtomicUsize, Ordering::SeqCst};

/// Allocations of fewer bytes never fail. In the scene below, what grows with the number of triangles or texels takes
/// more.
static LARGE: AtomicUsize = AtomicUsize::new(128 << 10);

/// For readers of files, which take their input in pieces of fixed size that are smaller.
const LARGER_THAN_PIECES: usize = 512 << 10;

/// Large allocations until one fails; negative: none will.
static ALLOCATIONS_LEFT: AtomicI64 = AtomicI64::new(-1);

/// Requests to the memory monitor until one is refused; negative: none will be.
static REQUESTS_LEFT: AtomicI64 = AtomicI64::new(-1);

/// Bytes announced to the memory monitor and not yet given back.
static ANNOUNCED: AtomicI64 = AtomicI64::new(0);

/// Counts down; whether this one is to fail.
fn is_due(left: &AtomicI64) -> bool {
    left.load(SeqCst) >= 0 && left.fetch_sub(1, SeqCst) == 0
}

struct FailingAllocator;

// SAFETY: all is passed on to the system's allocator, or refused with NULL, which is allowed.
unsafe impl GlobalAlloc for FailingAllocator {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        if layout.size() >= LARGE.load(SeqCst) && is_due(&ALLOCATIONS_LEFT) {
            return std::ptr::null_mut();
        }
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        if layout.size() >= LARGE.load(SeqCst) && is_due(&ALLOCATIONS_LEFT) {
            return std::ptr::null_mut();
        }
        // SAFETY: as above.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, p: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        if size > layout.size() && size >= LARGE.load(SeqCst) && is_due(&ALLOCATIONS_LEFT) {
            return std::ptr::null_mut();
        }
        // SAFETY: as above.
        unsafe { System.realloc(p, layout, size) }
    }

    unsafe fn dealloc(&self, p: *mut u8, layout: Layout) {
        // SAFETY: as above.
        unsafe { System.dealloc(p, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: FailingAllocator = FailingAllocator;

/// Calls again and again: the first time the first allocation or request that `left` counts fails, then the second,
/// and so on until none does. Returns what the last call, which had all, brought.
fn fail_each<T>(what: &str, left: &AtomicI64, mut call: impl FnMut() -> Result<T>) -> T {
    for n in 0.. {
        // Seen if the process is aborted.
        eprintln!("{what}: without number {n}");
        left.store(n, SeqCst);
        let result = call();
        let failed = left.swap(-1, SeqCst) < 0;
        match result {
            Ok(value) if !failed => {
                assert!(n > 0, "{what} takes no memory that could fail");
                return value;
            }
            Err(Error::OutOfMemory(_)) if failed => {}
            Ok(_) => panic!("{what}: number {n} failed, but the call did not"),
            Err(e) => panic!("{what}: without number {n}: {e}"),
        }
    }
    unreachable!("there are fewer allocations")
}

/// Both kinds of failures, and the value of the last call.
fn fail_all<T>(what: &str, mut call: impl FnMut() -> Result<T>) -> T {
    fail_each(&format!("{what}, malloc"), &ALLOCATIONS_LEFT, &mut call);
    fail_each(&format!("{what}, monitor"), &REQUESTS_LEFT, call)
}

/// Squares along each side of the ground.
const SIDE: usize = 180;

/// A hilly ground of many triangles, of which some are degenerate and some shine, with light map UVs, below a roof.
fn description() -> Result<SceneData> {
    let mut data = SceneData::new();
    let white = data.add_material(Material { albedo: [0.8; 3], two_sided: true, ..Default::default() })?;
    let lamp = data.add_material(Material { emission: [5.0; 3], ..Default::default() })?;
    let place = |i: usize| [i % (SIDE + 1), i / (SIDE + 1)].map(|c| c as f32 / SIDE as f32);
    let vertices = (SIDE + 1) * (SIDE + 1);
    let height = |x: f32, y: f32| 0.05 * (9.0 * x).sin() * (7.0 * y).cos();
    let mut mesh = Mesh {
        positions: (0..vertices).map(place).map(|[x, y]| Vec3::new(x, y, height(x, y))).collect(),
        normals: vec![Vec3::Z; vertices],
        uvs: vec![Vec2::ZERO; vertices],
        lightmap: Some(LightmapUvs {
            uvs: (0..vertices).map(|i| Vec2::from(place(i)) * 0.98 + 0.01).collect(),
            pages: vec![0; 2 * SIDE * SIDE],
        }),
        ..Default::default()
    };
    for i in (0..SIDE * SIDE).map(|i| (i / SIDE * (SIDE + 1) + i % SIDE) as u32) {
        let up = SIDE as u32 + 1;
        mesh.indices.extend([[i, i + 1, i + up + 1], [i, i + up + 1, i + up]]);
    }
    let triangles = mesh.indices.len();
    mesh.materials =
        MeshMaterials::PerTriangle((0..triangles).map(|t| if t % 16 == 5 { lamp } else { white }).collect());
    data.add_mesh(mesh)?;
    let corner = |x: f32, y: f32| Vec3::new(x, y, 0.6);
    data.add_mesh(Mesh {
        positions: vec![corner(0.1, 0.1), corner(0.1, 0.9), corner(0.9, 0.9), corner(0.9, 0.1)],
        indices: vec![[0, 1, 2], [0, 2, 3]],
        lightmap: Some(LightmapUvs {
            uvs: [[0.1, 0.1], [0.1, 0.9], [0.9, 0.9], [0.9, 0.1]].map(Vec2::from).to_vec(),
            pages: vec![1; 2],
        }),
        materials: MeshMaterials::One(white),
        ..Default::default()
    })?;
    data.add_light(Light::Point { position: Vec3::new(0.5, 0.5, 0.4), intensity: [1.0; 3] })?;
    Ok(data)
}

/// A number that stands for all bits of a light map's light.
fn bits(lightmap: &Lightmap) -> u64 {
    let mut hash = DefaultHasher::new();
    for page in 0..lightmap.info().page_count {
        for layer in [Layer::Direct, Layer::Indirect, Layer::Radiance] {
            let LayerData::Rgb(pixels) = lightmap.read(page, layer).unwrap() else { panic!("not RGB") };
            pixels.iter().flatten().for_each(|c| c.to_bits().hash(&mut hash));
        }
    }
    hash.finish()
}

#[test]
fn every_large_allocation_and_every_request_may_fail_and_nothing_is_lost() {
    let memory = |bytes: i64| {
        let granted = bytes < 0 || !is_due(&REQUESTS_LEFT);
        if granted {
            ANNOUNCED.fetch_add(bytes, SeqCst);
        }
        granted
    };
    let options = DeviceOptions { num_threads: 2, memory: Some(Box::new(memory)), ..Default::default() };
    let device = Device::new(options).unwrap();
    let none = Progress::none();

    let mut scene = None;
    for compact in [false, true] {
        for quality in BuildQuality::ALL {
            let build = BuildOptions { compact, quality, ..Default::default() };
            let original = description().unwrap();
            let mut data = None;
            let committed = fail_all(&format!("commit, {quality:?}, compact: {compact}"), || {
                // What a commit that failed gave back is committed next.
                let description = data.take().map_or_else(|| original.try_clone(), Ok)?;
                Scene::commit(&device, description, &build, &none).map_err(|(back, e)| {
                    data = Some(back);
                    e
                })
            });
            assert_eq!(committed.stats().triangles, 2 * (SIDE * SIDE) as u64 + 2);
            refit(committed.clone(), &format!("refit, {quality:?}, compact: {compact}"));
            scene.get_or_insert(committed);
        }
    }
    let scene = scene.unwrap();

    let params = PhotonParams { photon_count: 100_000, ..Default::default() };
    let photons = fail_all("photon map", || PhotonMap::trace(&scene, &params, &none));
    fail_all("packed photons", || {
        let photons = PhotonMap::trace(&scene, &PhotonParams { photon_count: 20_000, ..params }, &none)?;
        photons.photons().map(|p| p.position.len())
    });
    drop(photons);

    let desc = LightmapDesc { texels_per_unit: 200.0, page_size: 512, ..Default::default() };
    let mut lightmap = fail_all("light map", || Lightmap::create(&scene, &desc, &none));
    let params = BakeParams { photon_count: 100_000, gather_rays: 4, direct_samples: 1, ..Default::default() };
    lightmap.bake(&params, &none).unwrap();
    let (expected, whole) = (bits(&lightmap), params);
    lightmap.bake(&BakeParams { seed: 1, ..whole }, &none).unwrap();
    let before = bits(&lightmap);
    assert_ne!(before, expected);
    let mut failures = 0;
    fail_all("bake", || {
        let result = lightmap.bake(&whole, &none);
        failures += u32::from(result.is_err());
        // Now and then: it takes as long as a bake.
        if result.is_err() && failures % 16 == 1 {
            let left = [&ALLOCATIONS_LEFT, &REQUESTS_LEFT].map(|left| left.swap(-1, SeqCst));
            assert!([before, expected].contains(&bits(&lightmap)), "after failure {failures}");
            ALLOCATIONS_LEFT.store(left[0], SeqCst);
            REQUESTS_LEFT.store(left[1], SeqCst);
        }
        result
    });
    assert_eq!(bits(&lightmap), expected);

    fail_each("reading UVs", &ALLOCATIONS_LEFT, || lightmap.mesh_uvs(0));

    let folder = std::env::temp_dir().join(format!("bakelite-out-of-memory-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    live(&lightmap);
    LARGE.store(LARGER_THAN_PIECES, SeqCst);
    results(&mut lightmap, &folder.join("light.result"), expected);
    load(&device, &folder.join("ground.obj"));
    std::fs::remove_dir_all(&folder).unwrap();

    drop((lightmap, scene));
    assert_eq!(ANNOUNCED.load(SeqCst), 0, "bytes announced, but not given back");
}

/// Loads the light map's result, which is saved before.
fn results(lightmap: &mut Lightmap, path: &Path, expected: u64) {
    let none = Progress::none();
    lightmap.save_result(path, &none).unwrap();
    fail_all("loading a result", || lightmap.load_result(path, &none));
    assert_eq!(bits(lightmap), expected);
}

/// Live objects, whose own allocations may not fail: refused by the monitor, and read.
fn live(lightmap: &Lightmap) {
    let none = Progress::none();
    let params = LiveParams { photon_count: 100_000, direct_samples: 1, max_rounds: 1, ..Default::default() };
    let live = fail_each("live, monitor", &REQUESTS_LEFT, || Live::new(lightmap, &params, &none));
    let page = PageRect { page: 0, x: 0, y: 0, width: lightmap.info().width, height: lightmap.info().height };
    let lod = params.lod_count - 1;
    let expected = live.read(&page, lod, true).unwrap();
    assert!(fail_each("reading live light", &ALLOCATIONS_LEFT, || live.read(&page, lod, true)) == expected);
}

/// Loads a file of the same ground.
fn load(device: &Device, path: &Path) {
    let ground = description().unwrap();
    let mesh = &ground.meshes()[0];
    let vertices = mesh.positions.iter().map(|p| format!("v {} {} {}\n", p.x, p.y, p.z));
    let corners = |t: &[u32; 3]| format!("f {} {} {}\n", t[0] + 1, t[1] + 1, t[2] + 1);
    let text: String = vertices.chain(mesh.indices.iter().map(corners)).collect();
    std::fs::write(path, text).unwrap();
    let options = LoadOptions { memory: device.memory().clone(), ..Default::default() };
    let mut data = SceneData::new();
    fail_all("load", || {
        assert!(data.meshes().is_empty(), "a load that failed left something");
        load_with(path, &options, &Progress::none(), &mut data)?;
        let read = std::mem::take(&mut data);
        assert_eq!(read.meshes().iter().map(|m| m.indices.len()).sum::<usize>(), mesh.indices.len());
        Ok(())
    });
}

/// Refits of a scene and of a copy of it, which others hold.
fn refit(scene: Arc<Scene>, what: &str) {
    let moved: Vec<Vec3> = scene.meshes()[0].positions.iter().map(|&p| 1.01 * p).collect();
    let old = scene.meshes()[0].positions.clone();
    let mut copy = scene.clone();
    fail_all(what, || {
        // As a copy again.
        copy = scene.clone();
        let result = Scene::refit(&mut copy, &[(0, &moved)]);
        let kept = if result.is_ok() { &moved } else { &old };
        assert!(copy.meshes()[0].positions == *kept && scene.meshes()[0].positions == old);
        result
    });
}
