//! Memory that runs out: each large allocation of each long call fails once, and so does each request to the memory
//! monitor. The call then ends with an error and nothing is lost: made again, it gives the bits that it would have
//! given at first.
//!
//! A failed allocation aborts the process unless it was asked for with `try_reserve` or the like. So one that was
//! overlooked ends this test with "memory allocation of … bytes failed", after the line that says which one it was.
//!
//! One test, because the allocator is that of the whole process.

use bakelite::bvh::{BuildOptions, BuildQuality};
use bakelite::io::lightmaps::{write_png_pages, write_scene};
use bakelite::io::{LoadOptions, load_with};
use bakelite::lightmap::{
    BakeParams, CheckpointParams, Layer, LayerData, Lightmap, LightmapDesc, ShareParams, ShareStage,
};
use bakelite::live::{Budget, Live, LiveCamera, LiveParams, Mode, PageRect};
use bakelite::photon::{PhotonMap, PhotonParams};
use bakelite::scene::{LightmapUvs, MeshMaterials, OpenOptions};
use bakelite::trace::Ray;
use bakelite::{Device, DeviceOptions, Error, Light, Material, Mesh, Progress, Result, Scene, SceneData};
use glam::{Vec2, Vec3};
use std::alloc::{GlobalAlloc, Layout, System};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::ops::Range;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, AtomicUsize, Ordering::SeqCst};

/// Allocations of fewer bytes never fail. In the scene below, what grows with the number of triangles or texels takes
/// more.
static LARGE: AtomicUsize = AtomicUsize::new(128 << 10);

/// For bakes, live objects, saved results and shares: what grows with the number of blocks or texels takes more, although
/// there are few.
const LARGE_OF_LIGHT: usize = 16 << 10;

/// For their updates: the sums of one block's texels. (Queues of rayon, which cannot fail, take 1,520 bytes.)
const LARGE_OF_UPDATES: usize = 1536;

/// For loads of results, which read 64 kB at a time.
const LARGE_OF_RECORDS: usize = 128 << 10;

/// For readers of scene files and encoders of images, which take their input in pieces of fixed size that are smaller.
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

/// The same where light is baked, which takes longer than trees.
const SIDE_OF_BAKES: usize = 90;

/// A hilly ground of `side` × `side` squares, of which some are degenerate and some shine, with light map UVs, below a
/// roof.
fn description(side: usize) -> Result<SceneData> {
    let mut data = SceneData::new();
    let white = data.add_material(Material { albedo: [0.8; 3], two_sided: true, ..Default::default() })?;
    let lamp = data.add_material(Material { emission: [5.0; 3], ..Default::default() })?;
    let place = |i: usize| [i % (side + 1), i / (side + 1)].map(|c| c as f32 / side as f32);
    let vertices = (side + 1) * (side + 1);
    let height = |x: f32, y: f32| 0.05 * (9.0 * x).sin() * (7.0 * y).cos();
    let mut mesh = Mesh {
        positions: (0..vertices).map(place).map(|[x, y]| Vec3::new(x, y, height(x, y))).collect(),
        normals: vec![Vec3::Z; vertices].into(),
        uvs: vec![Vec2::ZERO; vertices].into(),
        lightmap: Some(LightmapUvs {
            uvs: (0..vertices).map(|i| Vec2::from(place(i)) * 0.98 + 0.01).collect(),
            pages: vec![0; 2 * side * side].into(),
        }),
        ..Default::default()
    };
    for i in (0..side * side).map(|i| (i / side * (side + 1) + i % side) as u32) {
        let up = side as u32 + 1;
        mesh.indices.as_vec().extend([[i, i + 1, i + up + 1], [i, i + up + 1, i + up]]);
    }
    let triangles = mesh.indices.len();
    mesh.materials =
        MeshMaterials::PerTriangle((0..triangles).map(|t| if t % 16 == 5 { lamp } else { white }).collect());
    data.add_mesh(mesh)?;
    let corner = |x: f32, y: f32| Vec3::new(x, y, 0.6);
    data.add_mesh(Mesh {
        positions: vec![corner(0.1, 0.1), corner(0.1, 0.9), corner(0.9, 0.9), corner(0.9, 0.1)].into(),
        indices: vec![[0, 1, 2], [0, 2, 3]].into(),
        lightmap: Some(LightmapUvs {
            uvs: [[0.1, 0.1], [0.1, 0.9], [0.9, 0.9], [0.9, 0.1]].map(Vec2::from).to_vec().into(),
            pages: vec![1; 2].into(),
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

    let folder = std::env::temp_dir().join(format!("bakelite-out-of-memory-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let large = LARGE.swap(LARGE_OF_LIGHT, SeqCst);
    let mut small = small_lightmap(&device);
    trace_streams(small.scene());
    live(&small, &folder.join("light.live"));
    let expected = checkpoints(&mut small, &folder.join("light.checkpoint"));
    results(&mut small, &folder, expected);
    LARGE.store(LARGE_OF_LIGHT, SeqCst);
    shares(&mut small, &folder, expected);
    LARGE.store(large, SeqCst);
    drop(small);

    for compact in [false, true] {
        for quality in BuildQuality::ALL {
            let build = BuildOptions { compact, quality, ..Default::default() };
            let original = description(SIDE).unwrap();
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
            scene_file(&committed, &folder.join("ground.bkscene"));
        }
    }

    LARGE.store(LARGE_OF_LIGHT, SeqCst);
    let ground = description(SIDE_OF_BAKES).unwrap();
    let scene = Scene::commit(&device, ground, &BuildOptions::default(), &none).map_err(|(_, e)| e).unwrap();
    let params = PhotonParams { photon_count: 25_000, ..Default::default() };
    let photons = fail_all("photon map", || PhotonMap::trace(&scene, &params, &none));
    fail_all("packed photons", || {
        let photons = PhotonMap::trace(&scene, &PhotonParams { photon_count: 5_000, ..params }, &none)?;
        photons.photons().map(|p| p.position.len())
    });
    drop(photons);

    let desc = LightmapDesc { texels_per_unit: 60.0, page_size: 128, ..Default::default() };
    let mut lightmap = fail_all("light map", || Lightmap::create(&scene, &desc, &none));
    let (gather_rays, interpolation_contrast) = (4, 0.15);
    let params = BakeParams {
        photon_count: 25_000,
        gather_rays,
        interpolation_contrast,
        direct_samples: 1,
        ..Default::default()
    };
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

    LARGE.store(LARGER_THAN_PIECES, SeqCst);
    load(&device, &folder.join("ground.obj"));
    std::fs::remove_dir_all(&folder).unwrap();

    LARGE.store(LARGE_OF_LIGHT, SeqCst);
    edits(&scene, &mut lightmap, &desc, &whole);
    drop((lightmap, scene));
    assert_eq!(ANNOUNCED.load(SeqCst), 0, "bytes announced, but not given back");
}

/// A vertex moves, and the light map and live light follow.
fn edits(scene: &Arc<Scene>, lightmap: &mut Lightmap, desc: &LightmapDesc, params: &BakeParams) {
    let none = Progress::none();
    let mut moved = scene.meshes()[0].positions.to_vec();
    let live_params = LiveParams { lod_count: 2, max_rounds: 1, photon_count: 10_000, ..Default::default() };
    let mut live = Live::new(lightmap, &live_params, &none).unwrap();
    // What is computed beside the calls waits.
    live.pause(true).unwrap();
    for left in [&ALLOCATIONS_LEFT, &REQUESTS_LEFT] {
        let mut state = scene.clone();
        moved[1].z += 0.01;
        Scene::refit(&mut state, &[(0, &moved)]).unwrap();
        let (texels, light) = (lightmap.info().texels, bits(lightmap));
        fail_each("following a scene", left, || lightmap.follow(&state, &none));
        assert_eq!((lightmap.info().texels, bits(lightmap)), (texels, light));
        fail_each("live light that follows", left, || live.follow(lightmap, 0.03, &none));
        assert!(Arc::ptr_eq(live.scene(), &state));
    }
    drop(live);
    // After the first that succeeds there is nothing left to bake, but all is looked at.
    let stats = fail_all("bake of changes", || lightmap.bake_changed(params, 0.03, &none));
    assert!(stats.kept_texels > 0);
    // A light map of a scene with one mesh more keeps light, too.
    let mut revision = SceneData::new();
    let scene = lightmap.scene();
    for texture in scene.textures() {
        revision.add_texture(texture.as_ref().clone()).unwrap();
    }
    for &material in scene.materials() {
        revision.add_material(material).unwrap();
    }
    for &light in scene.lights().iter() {
        revision.add_light(light).unwrap();
    }
    for mesh in scene.meshes() {
        revision.add_mesh(mesh.clone()).unwrap();
    }
    let mut added = scene.meshes()[1].clone();
    added.positions = added.positions.iter().map(|p| 0.05 * *p + Vec3::Z * 0.06).collect();
    if let Some(lightmap) = &mut added.lightmap {
        lightmap.pages = vec![2; 2].into();
    }
    revision.add_mesh(added).unwrap();
    let device = scene.device();
    let revision = Scene::commit(device, revision, &BuildOptions::default(), &none).map_err(|e| e.1).unwrap();
    let mut revised =
        fail_all("a light map from another one", || Lightmap::create_from(&revision, desc, lightmap, &none));
    let stats = fail_all("light of another light map", || revised.bake_changed_from(lightmap, params, 0.03, &none));
    assert!(stats.kept_texels > 0);
    let live_params = LiveParams { lod_count: 2, max_rounds: 1, photon_count: 10_000, ..Default::default() };
    let mut live = Live::new(lightmap, &live_params, &none).unwrap();
    let camera = LiveCamera { position: Vec3::ZERO, forward: Vec3::X, up: Vec3::Z, fov_y: 1.0, width: 64, height: 64 };
    live.update(&camera, &Budget { milliseconds: 0.0, rays: 500_000, max_dirty_bytes: 0 }).unwrap();
    let before = live.sums().unwrap();
    let mut carried = fail_all("live light from before", || Live::create_from(&revised, &mut live, 0.03, &none));
    assert!(live.sums().unwrap() == before, "live light of before has changed");
    assert!(carried.sums().unwrap().iter().any(|sum| before.contains(sum) && sum.1 > 0));
}

/// Saves and loads the light map's result, and saves its pages. (EXR files are left out: the
/// crate that encodes them ends the process where there is no memory.)
fn results(lightmap: &mut Lightmap, folder: &Path, expected: u64) {
    let none = Progress::none();
    let path = &folder.join("light.result");
    LARGE.store(LARGE_OF_LIGHT, SeqCst);
    fail_each("saving a result", &ALLOCATIONS_LEFT, || lightmap.save_result(path, &none));
    LARGE.store(LARGE_OF_RECORDS, SeqCst);
    fail_all("loading a result", || lightmap.load_result(path, &none));
    assert_eq!(bits(lightmap), expected);
    LARGE.store(LARGER_THAN_PIECES, SeqCst);
    let prefix = folder.join("pages-").display().to_string();
    fail_all("PNG pages", || write_png_pages(lightmap, &prefix, None, &none));
    fail_all("GLB", || write_scene(lightmap, &folder.join("light.glb"), None, &none));
}

/// Bakes with a checkpoint. What cannot be kept for want of memory is left out and computed again; what is there cannot
/// be read without memory. Returns what stands for the bits of the bake.
fn checkpoints(lightmap: &mut Lightmap, path: &Path) -> u64 {
    let none = Progress::none();
    let params = &BakeParams { photon_count: 20_000, gather_rays: 4, direct_samples: 1, ..Default::default() };
    lightmap.bake(params, &none).unwrap();
    let expected = bits(lightmap);
    // All of it is written at the end: much is kept in memory.
    let checkpoint = CheckpointParams { seconds: 1e6, ..CheckpointParams::new(path) };
    let (mut failures, mut completed) = (0, 0);
    for n in 0.. {
        eprintln!("bake with checkpoint: without number {n}");
        let _ = std::fs::remove_file(path);
        ALLOCATIONS_LEFT.store(n, SeqCst);
        let result = lightmap.bake_with(params, Some(&checkpoint), &none);
        let failed = ALLOCATIONS_LEFT.swap(-1, SeqCst) < 0;
        match result {
            Ok(_) => {
                assert_eq!(bits(lightmap), expected);
                completed += 1;
            }
            Err(Error::OutOfMemory(_)) if failed => failures += 1,
            Err(e) => panic!("{e}"),
        }
        if !failed {
            break;
        }
    }
    assert!(failures > 0 && completed > 0, "{failures} failed, {completed} did not");
    let large = LARGE.swap(LARGE_OF_RECORDS, SeqCst);
    fail_each("bake that goes on", &ALLOCATIONS_LEFT, || lightmap.bake_with(params, Some(&checkpoint), &none));
    LARGE.store(large, SeqCst);
    assert_eq!(bits(lightmap), expected);
    expected
}

/// Computes shares of photons and of the radiance map, and bakes from them.
fn shares(lightmap: &mut Lightmap, folder: &Path, expected: u64) {
    let none = Progress::none();
    let params = &BakeParams { photon_count: 20_000, gather_rays: 4, direct_samples: 1, ..Default::default() };
    let shares = &ShareParams { prefix: folder.join("share-"), count: 2 };
    for (stage, name) in [(ShareStage::Photons, "photons"), (ShareStage::Radiance, "radiance")] {
        for share in 0..2 {
            // A file that is there would be kept.
            let _ = std::fs::remove_file(folder.join(format!("share-{name}-{share}-of-2.bkshare")));
            fail_each(&format!("a share of {name}"), &ALLOCATIONS_LEFT, || {
                lightmap.bake_share(params, shares, stage, share, &none)
            });
        }
    }
    LARGE.store(LARGE_OF_RECORDS, SeqCst);
    fail_each("a bake from shares", &ALLOCATIONS_LEFT, || lightmap.bake_with_shares(params, Some(shares), None, &none));
    assert_eq!(bits(lightmap), expected);
}

/// A light map of a smaller ground without emissive triangles, of which there are so many in the other one that light
/// takes long.
fn small_lightmap(device: &Arc<Device>) -> Lightmap {
    let none = Progress::none();
    let ground = description(60).unwrap();
    let mut data = SceneData::new();
    data.add_material(Material { albedo: [0.8; 3], two_sided: true, ..Default::default() }).unwrap();
    for mesh in ground.meshes() {
        data.add_mesh(Mesh { materials: MeshMaterials::One(0), ..mesh.clone() }).unwrap();
    }
    data.add_light(Light::Point { position: Vec3::new(0.5, 0.5, 0.4), intensity: [1.0; 3] }).unwrap();
    let scene = Scene::commit(device, data, &BuildOptions::default(), &none).map_err(|(_, e)| e).unwrap();
    let desc = LightmapDesc { texels_per_unit: 100.0, page_size: 256, ..Default::default() };
    Lightmap::create(&scene, &desc, &none).unwrap()
}

/// Traces streams on all threads. Each keeps the memory that it takes for them; without, rays are traced one by one, so
/// that no call fails for it.
fn trace_streams(scene: &Scene) {
    let up = |i: usize| Ray::new(Vec3::splat(0.1), Vec3::new((i % 7) as f32 - 3.0, (i % 5) as f32 - 2.5, 1.0));
    let rays: Vec<Ray> = (0..1 << 18).map(up).collect();
    let mut occluded = vec![0; rays.len()];
    scene.occluded_many(&rays, true, &mut occluded).unwrap();
}

/// Live objects: made, refined, relit, read, saved and restored.
fn live(lightmap: &Lightmap, path: &Path) {
    let none = Progress::none();
    // At random, so that what no camera sees is worked on too.
    let mode = Mode::Uniform;
    let params = LiveParams { mode, photon_count: 4_000, direct_samples: 1, max_rounds: 2, ..Default::default() };
    let mut live = fail_all("live", || Live::new(lightmap, &params, &none));
    let page = PageRect { page: 0, x: 0, y: 0, width: lightmap.info().width, height: lightmap.info().height };
    let top = params.lod_count - 1;
    let read = |live: &Live, lod| live.read(&page, lod, Layer::Combined).unwrap();
    for lod in [top, 0] {
        let expected = read(&live, lod);
        assert!(
            fail_each("reading live light", &ALLOCATIONS_LEFT, || live.read(&page, lod, Layer::Combined)) == expected
        );
    }

    let mut expected = Live::new(lightmap, &params, &none).unwrap();
    refine(&mut expected, 0..0, u32::MAX);
    let begun = read(&live, top);
    let all = expected.sums().unwrap();
    for (mode, background) in [(Mode::View, false), (Mode::Position, false), (Mode::Uniform, true)] {
        let what = format!("{mode:?}, background: {background}");
        let mut other = Live::new(lightmap, &LiveParams { mode, background, ..params }, &none).unwrap();
        // Some blocks are never seen.
        let turns = if mode == Mode::View { 100 } else { u32::MAX };
        let failures = refine(&mut other, 0..1000, turns);
        eprintln!("updates, {what}: {failures} failed");
        assert!(failures >= 5, "{what}");
        if turns == u32::MAX {
            assert!(other.sums().unwrap() == all, "{what}: light was lost");
            assert!(read(&other, top) == read(&expected, top), "{what}: other light is shown");
        } else {
            // What a texel has gathered depends on the number of its rays alone.
            let sums = other.sums().unwrap();
            let complete: Vec<_> = sums.iter().zip(&all).filter(|(a, b)| a.1 == b.1).collect();
            assert!(complete.len() > 500 && complete.iter().all(|(a, b)| a == b), "{what}: {}", complete.len());
        }
    }

    // On hold nothing is computed beside the calls.
    let before = lightmap.scene().lights()[0];
    let dimmer = Light::Point { position: Vec3::new(0.5, 0.5, 0.4), intensity: [0.5; 3] };
    live.pause(true).unwrap();
    // In this scene it takes no memory that could fail.
    lightmap.scene().set_light(0, dimmer).unwrap();
    live.light_changed(0).unwrap();
    live.pause(false).unwrap();
    relight(&mut live);
    let mut again = Live::new(lightmap, &params, &none).unwrap();
    refine(&mut live, 0..20, u32::MAX);
    refine(&mut again, 0..0, u32::MAX);
    assert!(live.sums().unwrap() == again.sums().unwrap(), "light of after a change was lost");

    let whole = live.sums().unwrap();
    fail_each("saving live light", &ALLOCATIONS_LEFT, || live.save(path, &none));
    let mut restored = Live::new(lightmap, &params, &none).unwrap();
    let begun_again = read(&restored, top);
    assert!(begun_again != begun && begun_again != read(&live, top));
    let mut failures = 0;
    fail_all("restoring live light", || {
        let result = restored.restore(path, &none);
        failures += 1;
        if result.is_err() && failures % 8 == 1 {
            let left = [&ALLOCATIONS_LEFT, &REQUESTS_LEFT].map(|left| left.swap(-1, SeqCst));
            assert!([&begun_again, &read(&live, top)].contains(&&read(&restored, top)), "failure {failures}");
            ALLOCATIONS_LEFT.store(left[0], SeqCst);
            REQUESTS_LEFT.store(left[1], SeqCst);
        }
        result
    });
    assert!(restored.sums().unwrap() == whole);
    drop((live, restored, again, expected));
    lightmap.scene().set_light(0, before).unwrap();
}

/// Changes of light whose renewals lack memory. Unlike in other calls an allocation may fail without an error: that of
/// a renewal that another one has taken the place of, and that ends by and by.
fn relight(live: &mut Live) {
    let mut failures = 0;
    for n in 0.. {
        eprintln!("relighting: without number {n}");
        ALLOCATIONS_LEFT.store(n, SeqCst);
        let result = live.light_changed(0).and_then(|()| live.finish_relighting());
        let failed = ALLOCATIONS_LEFT.swap(-1, SeqCst) < 0;
        match result {
            Ok(()) if !failed => break,
            Ok(()) => {}
            Err(Error::OutOfMemory(_)) if failed => failures += 1,
            Err(e) => panic!("relighting: without number {n}: {e}"),
        }
    }
    assert!(failures > 5, "{failures}");
    live.finish_relighting().unwrap();
}

/// Updates an object until nothing is left to do, or `turns` times; in each update, and in what follows it in the
/// background, an allocation fails, another one each time, as long as its number is among `numbers`. Returns how many
/// failed.
fn refine(live: &mut Live, numbers: Range<i64>, turns: u32) -> u32 {
    let camera = LiveCamera {
        position: Vec3::new(0.5, 0.5, 0.5),
        forward: Vec3::new(0.1, 0.2, -1.0),
        up: Vec3::Y,
        fov_y: 2.0,
        width: 64,
        height: 64,
    };
    let large = LARGE.swap(LARGE_OF_UPDATES, SeqCst);
    let (mut number, mut failures) = (numbers.start, 0);
    let (mut finished, mut turns_when_finished) = (0.0, 0);
    for turn in 0..turns {
        assert!(turn < 20_000, "{finished} of all blocks are finished");
        if numbers.contains(&number) {
            ALLOCATIONS_LEFT.store(number, SeqCst);
        }
        // What nobody sees is finished too, in time: the camera turns.
        let angle = turn as f32;
        let camera = LiveCamera { forward: Vec3::new(angle.cos(), angle.sin(), -0.5), ..camera };
        let updated = live.update(&camera, &Budget { milliseconds: 0.0, rays: 40_000, max_dirty_bytes: 0 });
        let paused = live.pause(true).and(live.pause(false));
        let failed = numbers.contains(&number) && ALLOCATIONS_LEFT.swap(-1, SeqCst) < 0;
        let result = updated.and_then(|stats| paused.map(|()| stats));
        number = if failed { number + 1 } else { numbers.start };
        match result {
            Err(Error::OutOfMemory(_)) if failed => failures += 1,
            Err(e) => panic!("update {turn}: {e}"),
            Ok(_) if failed => panic!("update {turn}: memory was missing, but the update did not fail"),
            Ok(stats) => finished = stats.finished,
        }
        // What was promoted last fades in for some updates more.
        turns_when_finished += u32::from(finished == 1.0);
        if turns_when_finished > 16 {
            break;
        }
    }
    LARGE.store(large, SeqCst);
    failures
}

/// Loads a file of the same ground.
fn load(device: &Device, path: &Path) {
    let ground = description(SIDE).unwrap();
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

/// Saves the scene, which takes no memory to speak of, and opens it, mapped and read, which is announced and takes none from
/// `malloc`.
fn scene_file(scene: &Scene, path: &Path) {
    scene.save(path, &Progress::none()).unwrap();
    for map in [true, false] {
        let open = || Scene::open(scene.device(), path, &OpenOptions { map, ..Default::default() }, &Progress::none());
        let opened = fail_each("open a scene, monitor", &REQUESTS_LEFT, open);
        assert_eq!(opened.stats().triangles, scene.stats().triangles);
    }
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
        let kept = if result.is_ok() { &moved[..] } else { &old[..] };
        assert!(copy.meshes()[0].positions == *kept && scene.meshes()[0].positions == old);
        result
    });
}
