//! Live updates against bakes: whatever the order of the updates, the light that they end with has
//! the bits of a bake with as many rays; and what an application may rely on in between.

use bakelite::bvh::BuildOptions;
use bakelite::lightmap::{Layer, LayerData, Lightmap, LightmapDesc};
use bakelite::live::{Budget, Live, LiveCamera, LiveParams, LiveStats, Mode, PageRect};
use bakelite::scene::{Light, LightmapUvs, MeshMaterials, builtin};
use bakelite::{Device, DeviceOptions, Error, Material, Mesh, Progress, Scene, SceneData};
use glam::{Vec2, Vec3};
use std::f32::consts::PI;

const RAYS: Budget = Budget { milliseconds: 0.0, rays: 200_000, max_dirty_bytes: 0 };

/// A light map of a built-in scene, not baked.
fn unbaked(name: &str, threads: usize, texels_per_unit: f32) -> Lightmap {
    unbaked_of(builtin(name).unwrap(), threads, texels_per_unit)
}

fn unbaked_of(data: SceneData, threads: usize, texels_per_unit: f32) -> Lightmap {
    let device = Device::new(DeviceOptions { num_threads: threads, ..Default::default() }).unwrap();
    let scene = Scene::commit(&device, data, &BuildOptions::default(), &Progress::none()).map_err(|e| e.1).unwrap();
    let desc = LightmapDesc { texels_per_unit, page_size: 256, ..Default::default() };
    Lightmap::create(&scene, &desc, &Progress::none()).unwrap()
}

fn params(mode: Mode) -> LiveParams {
    LiveParams { mode, max_rounds: 3, photon_count: 20_000, direct_samples: 4, seed: 5, ..Default::default() }
}

/// Looks around the Cornell box, and at its outside too.
fn camera(i: u32) -> LiveCamera {
    let angle = i as f32 * 0.7;
    LiveCamera {
        position: Vec3::new(0.278, 0.35, 0.28),
        forward: Vec3::new(angle.cos(), 0.9 * (0.37 * angle).sin(), angle.sin()),
        up: Vec3::Y,
        fov_y: 1.5,
        width: 320,
        height: 200,
    }
}

/// Layers of light by direction.
const BY_DIRECTION: [Layer; 5] = [Layer::L0, Layer::L1X, Layer::L1Y, Layer::L1Z, Layer::Direction];

fn pages(live: &Live, lightmap: &Lightmap) -> Vec<[f32; 3]> {
    pages_of(live, lightmap, Layer::Combined)
}

fn pages_of(live: &Live, lightmap: &Lightmap, layer: Layer) -> Vec<[f32; 3]> {
    let info = lightmap.info();
    let lod = live.params().lod_count - 1;
    let rect = |page| PageRect { page, x: 0, y: 0, width: info.width, height: info.height };
    (0..info.page_count).flat_map(|page| live.read(&rect(page), lod, layer).unwrap()).collect()
}

/// Updates until nothing is left to do. The camera sees all that can be seen sooner or later; for
/// what it never does, position-based updates see to the rest.
fn finish(live: &mut Live) -> LiveStats {
    let mut stats = LiveStats::default();
    for i in 0..20_000 {
        stats = live.update(&camera(i), &RAYS).unwrap();
        if stats.finished == 1.0 {
            break;
        }
    }
    // What was promoted last is still fading in.
    while live.update(&camera(0), &Budget { milliseconds: 1000.0, rays: 0, max_dirty_bytes: 0 }).unwrap().blocks_changed
        > 0
    {}
    stats
}

/// Compares the texels that can be seen; others are filled from what is around them.
fn assert_same_as_bake(live: &Live, lightmap: &mut Lightmap, what: &str) {
    lightmap.bake(&live.params().bake(), &Progress::none()).unwrap();
    let by_direction = if live.params().directional == 0 { &[][..] } else { &BY_DIRECTION };
    for &layer in [Layer::Combined, Layer::Indirect, Layer::Direct].iter().chain(by_direction) {
        assert_same_layer(live, lightmap, layer, &format!("{what}, {layer:?}"));
    }
}

fn assert_same_layer(live: &Live, lightmap: &Lightmap, layer: Layer, what: &str) {
    let (shown, baked) = (pages_of(live, lightmap, layer), rgb(lightmap, layer));
    let page = |page| match lightmap.read(page, Layer::Validity).unwrap() {
        LayerData::Scalar(v) => v,
        _ => unreachable!(),
    };
    let valid: Vec<f32> = (0..lightmap.info().page_count).flat_map(page).collect();
    let compared = (0..baked.len()).filter(|&i| valid[i] == 1.0).count();
    let different: Vec<usize> = (0..baked.len())
        .filter(|&i| valid[i] == 1.0 && shown[i].map(f32::to_bits) != baked[i].map(f32::to_bits))
        .collect();
    assert!(compared > 1000, "{what}: only {compared} texels to compare");
    if let Some(&i) = different.first() {
        panic!(
            "{what}: {} of {compared} texels differ, first {i}: {:?} is not {:?}",
            different.len(),
            shown[i],
            baked[i]
        );
    }
}

/// A room of 4 × 3 × 5 whose six faces have light map UVs of their own, in two rows of three cells with gaps of `gap`
/// around each.
fn room_with_uvs(gap: f32) -> SceneData {
    let corner = |i: usize| Vec3::new((i & 1) as f32 * 4.0, (i >> 1 & 1) as f32 * 3.0, (i >> 2) as f32 * 5.0);
    let faces = [[0, 4, 5, 1], [2, 3, 7, 6], [0, 1, 3, 2], [4, 6, 7, 5], [0, 2, 6, 4], [1, 5, 7, 3]];
    let mut mesh = Mesh::default();
    let mut uvs = Vec::new();
    for (cell, face) in faces.into_iter().enumerate() {
        let first = mesh.positions.len() as u32;
        mesh.positions.as_vec().extend(face.map(corner));
        mesh.indices.as_vec().extend([[first, first + 1, first + 2], [first, first + 2, first + 3]]);
        let (u, v) = ((cell % 3) as f32 / 3.0, (cell / 3) as f32 / 2.0);
        let (u0, u1, v0, v1) = (u + gap, u + 1.0 / 3.0 - gap, v + gap, v + 0.5 - gap);
        uvs.extend([[u0, v0], [u1, v0], [u1, v1], [u0, v1]].map(Vec2::from));
    }
    mesh.lightmap = Some(LightmapUvs { uvs: uvs.into(), pages: Vec::new().into() });
    let position = Vec3::new(1.5, 2.99, 2.0);
    let light = Light::Rect { position, edge_u: Vec3::X, edge_v: Vec3::Z, radiance: [10.0; 3] };
    let mut data = SceneData::new();
    data.add_material(Material { albedo: [0.75; 3], ..Default::default() }).unwrap();
    data.add_mesh(mesh).unwrap();
    data.add_light(light).unwrap();
    data
}

/// A layer of light of all pages.
fn rgb(lightmap: &Lightmap, layer: Layer) -> Vec<[f32; 3]> {
    let page = |page| match lightmap.read(page, layer).unwrap() {
        LayerData::Rgb(v) => v,
        _ => unreachable!(),
    };
    (0..lightmap.info().page_count).flat_map(page).collect()
}

#[test]
fn around_given_charts_bakes_and_live_light_are_padded_alike() {
    let mut lightmap = unbaked_of(room_with_uvs(0.02), 2, 20.0);
    let mut live = Live::new(&lightmap, &params(Mode::Uniform), &Progress::none()).unwrap();
    finish(&mut live);
    lightmap.bake(&live.params().bake(), &Progress::none()).unwrap();
    let (width, padding) = (lightmap.info().width as usize, 2);
    let shown = pages(&live, &lightmap);
    let layers = [Layer::Combined, Layer::Direct, Layer::Indirect, Layer::Radiance].map(|l| rgb(&lightmap, l));
    assert!(shown == layers[0], "a bake and live light differ in the padding");
    let LayerData::Scalar(validity) = lightmap.read(0, Layer::Validity).unwrap() else { unreachable!() };
    let mut filled = 0;
    for (i, v) in validity.iter().enumerate() {
        let (x, y) = (i % width, i / width);
        let near = |reach: usize, value: f32| {
            let range = |c: usize| c.saturating_sub(reach)..(c + reach + 1).min(width);
            range(y).any(|y| range(x).any(|x| validity[y * width + x] == value))
        };
        let expected = if *v == 1.0 { 1.0 } else { 0.5 * f32::from(near(padding, 1.0)) };
        assert_eq!(*v, expected, "validity at ({x}, {y})");
        filled += usize::from(*v == 0.5);
        // The ceiling gets no direct light.
        let lit = [0, 2, 3].iter().all(|&l: &usize| layers[l][i][0] > 0.0);
        assert_eq!(lit, *v > 0.0, "({x}, {y}) has validity {v}");
    }
    assert!(filled > 6 * 4 * 60, "{filled} texels of padding");
}

#[test]
fn around_given_charts_whatever_changes_is_dirty() {
    let lightmap = unbaked_of(room_with_uvs(0.04), 2, 20.0);
    let mut live = Live::new(&lightmap, &params(Mode::Uniform), &Progress::none()).unwrap();
    live.take_dirty(usize::MAX).unwrap();
    let mut before = pages(&live, &lightmap);
    let width = lightmap.info().width;
    for i in 0..6 {
        live.update(&camera(i), &RAYS).unwrap();
        let mut uploaded = before.clone();
        let after = pages(&live, &lightmap);
        for r in live.take_dirty(usize::MAX).unwrap() {
            for (y, x) in (r.y..r.y + r.height).flat_map(|y| (r.x..r.x + r.width).map(move |x| (y, x))) {
                uploaded[(y * width + x) as usize] = after[(y * width + x) as usize];
            }
        }
        assert!(uploaded == after, "update {i} changed texels outside of the dirty rectangles");
        before = after;
    }
}

#[test]
fn position_based_and_uniform_updates_end_with_the_bits_of_a_bake() {
    for (mode, threads) in [(Mode::Position, 1), (Mode::Position, 2), (Mode::Uniform, 2)] {
        let mut lightmap = unbaked("cornell", threads, 24.0);
        let mut live = Live::new(&lightmap, &params(mode), &Progress::none()).unwrap();
        let stats = finish(&mut live);
        assert_eq!(stats.finished, 1.0, "{mode:?}");
        assert!(live.sums().unwrap().iter().all(|s| s.1 == 3 * 64));
        assert_same_as_bake(&live, &mut lightmap, &format!("{mode:?}, {threads} threads"));
    }
}

/// Interpolation keeps the gap apart from what lies beside the carpet.
#[test]
fn a_carpet_in_the_cornell_box_ends_with_the_bits_of_a_bake() {
    let mut data = builtin("cornell").unwrap();
    let material = data.add_material(Material { two_sided: true, ..Default::default() }).unwrap();
    let corners = [[0.1, 0.1], [0.1, 0.3], [0.4, 0.3], [0.4, 0.1]].map(|[x, z]| Vec3::new(x, 0.004, z));
    let (indices, materials) = (vec![[0, 1, 2], [0, 2, 3]], MeshMaterials::One(material));
    data.add_mesh(Mesh { positions: corners.into(), indices: indices.into(), materials, ..Default::default() })
        .unwrap();
    let mut lightmap = unbaked_of(data, 2, 60.0);
    let mut live = Live::new(&lightmap, &params(Mode::Uniform), &Progress::none()).unwrap();
    assert_eq!(finish(&mut live).finished, 1.0);
    assert_same_as_bake(&live, &mut lightmap, "carpet");
}

/// Below a table top of one side one sees its back, but that is no solid: its shadow stays.
#[test]
fn below_a_one_sided_sheet_updates_end_with_the_bits_of_a_bake() {
    let mut data = builtin("cornell").unwrap();
    let material = data.add_material(Material::default()).unwrap();
    // Its front faces up.
    let positions = [[0.1, 0.1], [0.1, 0.25], [0.4, 0.25], [0.4, 0.1]].map(|[x, z]| Vec3::new(x, 0.4, z));
    let (indices, materials) = (vec![[0, 1, 2], [0, 2, 3]], MeshMaterials::One(material));
    data.add_mesh(Mesh { positions: positions.into(), indices: indices.into(), materials, ..Default::default() })
        .unwrap();
    let mut lightmap = unbaked_of(data, 2, 60.0);
    let mut live = Live::new(&lightmap, &params(Mode::Position), &Progress::none()).unwrap();
    assert_eq!(finish(&mut live).finished, 1.0);
    assert_same_as_bake(&live, &mut lightmap, "one-sided sheet");
}

/// The Cornell box with a two-sided shelf below its lamp, its back above, and a mat 4 mm over that.
fn with_shelf(threads: usize, both_sides: bool) -> Lightmap {
    let mut data = builtin("cornell").unwrap();
    let material = data.add_material(Material { two_sided: true, ..Default::default() }).unwrap();
    for (right, y) in [(3.6, 3.6), (2.0, 3.604)] {
        let corners = [[0.8, 0.8], [right, 0.8], [right, 3.2], [0.8, 3.2]].map(|[x, z]| Vec3::new(x, y, z));
        let (indices, materials) = (vec![[0, 1, 2], [0, 2, 3]], MeshMaterials::One(material));
        data.add_mesh(Mesh { positions: corners.into(), indices: indices.into(), materials, ..Default::default() })
            .unwrap();
    }
    let device = Device::new(DeviceOptions { num_threads: threads, ..Default::default() }).unwrap();
    let scene = Scene::commit(&device, data, &BuildOptions::default(), &Progress::none()).map_err(|e| e.1).unwrap();
    let desc = LightmapDesc { texels_per_unit: 60.0, page_size: 256, both_sides, ..Default::default() };
    Lightmap::create(&scene, &desc, &Progress::none()).unwrap()
}

#[test]
fn with_both_sides_updates_end_with_the_bits_of_a_bake_before_and_after_a_change_of_light() {
    let mut lightmap = with_shelf(2, true);
    assert!(lightmap.info().both_sided_charts == 1 && lightmap.info().back_texels > 300);
    // Light by direction goes the same way.
    let params = |mode| LiveParams { directional: 3, ..params(mode) };
    let mut live = Live::new(&lightmap, &params(Mode::Position), &Progress::none()).unwrap();
    for i in 0..10 {
        live.update(&camera(i), &RAYS).unwrap();
    }
    let path = std::env::temp_dir().join(format!("bakelite-both-sides-{}", std::process::id()));
    live.save(&path, &Progress::none()).unwrap();
    let mut other = Live::new(&lightmap, &params(Mode::Position), &Progress::none()).unwrap();
    other.restore(&path, &Progress::none()).unwrap();
    assert_eq!(other.sums().unwrap(), live.sums().unwrap());
    let mut one_sided = Live::new(&with_shelf(2, false), &params(Mode::Position), &Progress::none()).unwrap();
    assert!(matches!(one_sided.restore(&path, &Progress::none()), Err(Error::InvalidArgument(_))));
    std::fs::remove_file(&path).unwrap();
    assert_eq!(finish(&mut other).finished, 1.0);
    assert_same_as_bake(&other, &mut lightmap, "both sides");
    let Light::Rect { position, edge_u, edge_v, radiance } = lightmap.scene().lights()[0] else { panic!() };
    let radiance = [radiance[2], 0.1 * radiance[1], radiance[0]];
    lightmap.scene().set_light(0, Light::Rect { position, edge_u, edge_v, radiance }).unwrap();
    other.light_changed(0).unwrap();
    other.finish_relighting().unwrap();
    assert_eq!(finish(&mut other).finished, 1.0);
    assert_same_as_bake(&other, &mut lightmap, "both sides under another light");
}

#[test]
fn texels_on_their_own_end_with_the_light_by_direction_of_a_bake() {
    let mut lightmap = unbaked("atrium", 2, 6.0);
    for directional in [1, 2] {
        let params = LiveParams { directional, max_rounds: 1, interpolation_error: 1.0, ..params(Mode::Uniform) };
        let mut live = Live::new(&lightmap, &params, &Progress::none()).unwrap();
        assert_eq!(finish(&mut live).finished, 1.0);
        assert_same_as_bake(&live, &mut lightmap, &format!("directional {directional}"));
    }
    let live = Live::new(&lightmap, &params(Mode::Uniform), &Progress::none()).unwrap();
    let rect = PageRect { page: 0, x: 0, y: 0, width: 4, height: 4 };
    assert!(matches!(live.read(&rect, 2, Layer::L0), Err(Error::InvalidState(_))));
    assert!(matches!(live.read(&rect, 2, Layer::Normal), Err(Error::InvalidArgument(_))));
}

#[test]
fn view_based_updates_finish_what_the_camera_sees() {
    let lightmap = unbaked("cornell", 2, 24.0);
    let mut live = Live::new(&lightmap, &params(Mode::View), &Progress::none()).unwrap();
    let mut stats = LiveStats::default();
    for _ in 0..3000 {
        stats = live.update(&camera(0), &RAYS).unwrap();
    }
    assert_eq!(stats.visible_finished, 1.0);
    assert!(stats.finished < 1.0, "what is behind the camera has no turn");
    assert!(stats.visible_error < 0.2, "{stats:?}");
    // A texel's sums depend on its rounds alone.
    let mut other = Live::new(&lightmap, &params(Mode::Position), &Progress::none()).unwrap();
    finish(&mut other);
    let (some, all) = (live.sums().unwrap(), other.sums().unwrap());
    let same = some.iter().zip(&all).filter(|(a, _)| a.1 == 3 * 64).map(|(a, b)| assert_eq!(a, b)).count();
    assert!(same > some.len() / 20, "{same}");
}

#[test]
fn after_a_light_has_changed_the_updates_end_with_the_bits_of_a_bake_under_it() {
    let mut lightmap = unbaked("cornell", 2, 24.0);
    // Near hits see direct light, which changes before indirect light does.
    let params = LiveParams { near_hits: 1.0, directional: 3, ..params(Mode::Position) };
    let mut live = Live::new(&lightmap, &params, &Progress::none()).unwrap();
    finish(&mut live);
    let before = pages(&live, &lightmap);
    let scene = lightmap.scene().clone();
    let changed = match scene.lights()[0] {
        Light::Rect { position, edge_u, edge_v, radiance } => {
            Light::Rect { position, edge_u, edge_v, radiance: [radiance[2], radiance[1] * 0.1, radiance[0]] }
        }
        other => panic!("{other:?}"),
    };
    scene.set_light(0, changed).unwrap();
    live.light_changed(0).unwrap();
    // While light is recomputed nothing is black that was not, nor anything wilder than before or after.
    let brightest = before.iter().flatten().fold(0.0, |a: f32, &b| a.max(b));
    for i in 0..50 {
        live.update(&camera(i), &RAYS).unwrap();
        for (now, before) in pages(&live, &lightmap).iter().zip(&before) {
            assert!(now.iter().all(|c| c.is_finite() && *c >= 0.0 && *c < 6.0 * brightest), "{now:?}");
            assert!(before[1] == 0.0 || now[1] > 0.0, "{before:?} turned {now:?}");
        }
        let [l0, x, y, z] = [Layer::L0, Layer::L1X, Layer::L1Y, Layer::L1Z].map(|l| pages_of(&live, &lightmap, l));
        for (k, l0) in l0.iter().flatten().enumerate() {
            let length = [&x, &y, &z].map(|l| l[k / 3][k % 3].powi(2)).iter().sum::<f32>().sqrt();
            assert!(*l0 >= 0.0 && length <= 1.001 * l0, "{length} for {l0}");
        }
    }
    live.finish_relighting().unwrap();
    assert_eq!(finish(&mut live).finished, 1.0);
    assert_same_as_bake(&live, &mut lightmap, "new light");
    let e = live.light_changed(7).unwrap_err().to_string();
    assert!(e.ends_with("light 7 does not exist, the scene has 1"), "{e}");
}

/// A quick start shows light at once that is about that of a bake, and all is as without it once nothing is pending.
#[test]
fn after_a_quick_start_the_updates_end_with_the_bits_of_a_bake() {
    // With 2 texels per unit in the atrium, whose photon discs are wider than its columns then, the first light is 0.78 of the
    // last: plain estimates know nothing of what lies beside a surface.
    for (name, directional) in [("cornell", 3), ("atrium", 0)] {
        let mut lightmap = unbaked(name, 2, if name == "cornell" { 24.0 } else { 4.0 });
        let params = LiveParams { quick_start: true, directional, ..params(Mode::Position) };
        let mut live = Live::new(&lightmap, &params, &Progress::none()).unwrap();
        let first = pages(&live, &lightmap);
        let mean = |pages: &[[f32; 3]]| pages.iter().flatten().map(|&c| f64::from(c)).sum::<f64>();
        assert!(live.update(&camera(0), &RAYS).unwrap().light_pending, "{name}");
        live.finish_relighting().unwrap();
        let stats = finish(&mut live);
        assert_eq!((stats.finished, stats.light_pending), (1.0, false), "{name}");
        assert_same_as_bake(&live, &mut lightmap, name);
        let ratio = mean(&first) / mean(&pages(&live, &lightmap));
        assert!((0.8..1.25).contains(&ratio), "{name}: the first light is {ratio} of the last");
    }
}

#[test]
fn a_light_that_changes_during_a_quick_start_ends_with_the_bits_of_a_bake_under_it() {
    let mut lightmap = unbaked("cornell", 2, 24.0);
    let params = LiveParams { quick_start: true, ..params(Mode::Position) };
    let mut live = Live::new(&lightmap, &params, &Progress::none()).unwrap();
    let scene = lightmap.scene().clone();
    let Light::Rect { position, edge_u, edge_v, radiance } = scene.lights()[0] else { panic!("another light") };
    let radiance = [radiance[2], radiance[1] * 0.1, radiance[0]];
    scene.set_light(0, Light::Rect { position, edge_u, edge_v, radiance }).unwrap();
    assert!(live.update(&camera(0), &RAYS).unwrap().light_pending);
    live.light_changed(0).unwrap();
    live.finish_relighting().unwrap();
    let stats = finish(&mut live);
    assert_eq!((stats.finished, stats.light_pending), (1.0, false));
    assert_same_as_bake(&live, &mut lightmap, "new light");
}

#[test]
fn what_changes_is_covered_by_dirty_rectangles_and_is_never_negative() {
    for mode in [Mode::View, Mode::Position, Mode::Uniform] {
        let lightmap = unbaked("cornell", 2, 24.0);
        let mut live = Live::new(&lightmap, &params(mode), &Progress::none()).unwrap();
        let size = lightmap.info().width;
        let whole = PageRect { page: 0, x: 0, y: 0, width: size, height: size };
        assert_eq!(live.take_dirty(1).unwrap(), [whole]);
        let mut copy = pages(&live, &lightmap);
        live.take_dirty(usize::MAX).unwrap();
        for i in 0..40 {
            live.update(&camera(i), &Budget { milliseconds: 0.0, rays: 30_000, max_dirty_bytes: 0 }).unwrap();
            while let Some(r) = live.take_dirty(1).unwrap().pop() {
                let values = live.read(&r, live.params().lod_count - 1, Layer::Combined).unwrap();
                for (k, v) in values.into_iter().enumerate() {
                    let (x, y) = (r.x + k as u32 % r.width, r.y + k as u32 / r.width);
                    copy[(r.page * size * size + y * size + x) as usize] = v;
                }
            }
            let now = pages(&live, &lightmap);
            assert!(now.iter().flatten().all(|c| c.is_finite() && *c >= 0.0));
            let stale = (0..now.len()).filter(|&i| now[i] != copy[i]).count();
            assert_eq!(stale, 0, "{mode:?}: texels that changed outside of all rectangles");
        }
    }
}

/// An application's copy of the pages, refreshed by what it is given after each update.
struct Copied {
    pages: Vec<[f32; 3]>,
    size: u32,
}

impl Copied {
    /// Reads the rectangles that are given out, and returns their bytes and their number.
    fn refresh(&mut self, live: &mut Live) -> (u64, usize) {
        let (lod, mut bytes) = (live.params().lod_count - 1, 0);
        let rects = live.take_dirty(usize::MAX).unwrap();
        for r in &rects {
            bytes += 8 * r.width as u64 * r.height as u64;
            for (k, v) in (0..).zip(live.read(r, lod, Layer::Combined).unwrap()) {
                let (x, y) = (r.x + k % r.width, r.y + k / r.width);
                self.pages[(r.page * self.size * self.size + y * self.size + x) as usize] = v;
            }
        }
        assert!(live.take_dirty(1).unwrap().is_empty(), "more came than was announced");
        (bytes, rects.len())
    }
}

/// New indirect light changes at once what texels gather for themselves, and the sides of charts.
#[test]
fn what_a_change_of_light_changes_is_dirty() {
    for (what, lightmap) in [("atrium", unbaked("atrium", 2, 3.0)), ("shelf", with_shelf(2, false))] {
        let mut live = Live::new(&lightmap, &params(Mode::Position), &Progress::none()).unwrap();
        let mut copied = Copied { pages: pages(&live, &lightmap), size: lightmap.info().width };
        live.take_dirty(usize::MAX).unwrap();
        let mut check = |live: &mut Live, when: &str| {
            copied.refresh(live);
            let now = pages(live, &lightmap);
            let stale = (0..now.len()).filter(|&i| now[i] != copied.pages[i]).count();
            assert_eq!(stale, 0, "{what}, {when}: texels that changed outside of all rectangles");
        };
        for i in 0..3 {
            live.update(&camera(i), &RAYS).unwrap();
            check(&mut live, "before");
        }
        for power in [0.3, 2.0] {
            let light = match lightmap.scene().lights()[0] {
                Light::Point { position, intensity } => {
                    Light::Point { position, intensity: intensity.map(|i| power * i) }
                }
                Light::Rect { position, edge_u, edge_v, radiance } => {
                    // Above the shelf first, then below it.
                    let position = Vec3 { y: if power < 1.0 { 5.0 } else { 3.0 }, ..position };
                    Light::Rect { position, edge_u, edge_v, radiance }
                }
                other => panic!("{other:?}"),
            };
            lightmap.scene().set_light(0, light).unwrap();
            live.light_changed(0).unwrap();
            check(&mut live, "when the light changes");
            live.update(&camera(0), &RAYS).unwrap();
            check(&mut live, "before there is new indirect light");
            live.finish_relighting().unwrap();
            check(&mut live, "when there is new indirect light");
            for i in 0..3 {
                live.update(&camera(i), &RAYS).unwrap();
                check(&mut live, "after");
            }
        }
    }
}

/// With a limit of bytes an application has what it has without one, a little later, and never more at a time: with and
/// without work between updates, after a change of light and after a restored state.
#[test]
fn no_update_gives_out_more_bytes_than_its_limit_and_all_comes_in_the_end() {
    for (mode, background, limit) in
        [(Mode::View, false, 20_000), (Mode::Position, true, 50_000), (Mode::Uniform, false, 1024)]
    {
        let lightmap = unbaked("cornell", 2, 40.0);
        let (scene, info) = (lightmap.scene().clone(), lightmap.info());
        let (original, size) = (scene.lights()[0], info.width);
        let params = LiveParams { background, max_rounds: 1, ..params(mode) };
        let mut live = Live::new(&lightmap, &params, &Progress::none()).unwrap();
        // A copy of which no texel is right.
        let unread = vec![[-1.0; 3]; (info.page_count * size * size) as usize];
        let mut copy = Copied { pages: unread, size };
        let path = std::env::temp_dir().join(format!("bakelite-limit-{}-{limit}", std::process::id()));
        let (mut updates, mut rects, mut left) = (0, 0, u64::MAX);
        let mut step = |live: &mut Live, copy: &mut Copied, rays: u64| {
            let budget = Budget { milliseconds: 0.0, rays, max_dirty_bytes: limit };
            let stats = live.update(&camera(updates), &budget).unwrap();
            assert!(stats.dirty_bytes <= limit, "{mode:?}: {}", stats.dirty_bytes);
            assert!(stats.dirty_bytes > 0 || stats.dirty_bytes_left == 0, "{mode:?}: nothing comes");
            let (bytes, count) = copy.refresh(live);
            assert_eq!(bytes, stats.dirty_bytes, "{mode:?}");
            (updates, rects, left) = (updates + 1, rects.max(count), stats.dirty_bytes_left);
            left
        };
        for i in 0..60 {
            match i {
                20 => {
                    live.save(&path, &Progress::none()).unwrap();
                    let Light::Rect { position, edge_u, edge_v, radiance } = original else { panic!() };
                    let radiance = radiance.map(|r| 0.5 * r);
                    scene.set_light(0, Light::Rect { position, edge_u, edge_v, radiance }).unwrap();
                    live.light_changed(0).unwrap();
                }
                40 => {
                    scene.set_light(0, original).unwrap();
                    live.light_changed(0).unwrap();
                    live.finish_relighting().unwrap();
                    live.restore(&path, &Progress::none()).unwrap();
                }
                _ => {}
            }
            step(&mut live, &mut copy, 30_000);
        }
        finish(&mut live);
        live.pause(true).unwrap();
        // Nothing is traced any more: what is left comes, bit for bit.
        while step(&mut live, &mut copy, 0) > 0 {}
        let now = pages(&live, &lightmap);
        let stale = (0..now.len()).filter(|&i| now[i] != copy.pages[i]).count();
        assert_eq!(stale, 0, "{mode:?}: texels that never came");
        assert!(rects <= 256, "{mode:?}: {rects} rectangles at once");
        scene.set_light(0, original).unwrap();
        std::fs::remove_file(&path).unwrap();
    }
}

#[test]
fn cells_are_promoted_near_the_camera_first() {
    let lightmap = unbaked("cornell", 2, 24.0);
    let mut live = Live::new(&lightmap, &params(Mode::Position), &Progress::none()).unwrap();
    let (info, lods) = live.cell_lods().unwrap();
    assert_eq!(info.dimensions.iter().product::<u32>() as usize, lods.len());
    // Cells whose texels all lie hidden, as below the boxes, are worked on until one does not.
    let occupied = lods.iter().filter(|&&l| l != bakelite::live::NO_LOD).count();
    let lowest = lods.iter().filter(|&&l| l == 0).count();
    assert!(lowest * 10 > occupied * 9, "{lowest} of {occupied}");
    let (mut promoted, mut last) = (0, lods);
    while promoted < 20 {
        promoted += live
            .update(&camera(0), &Budget { milliseconds: 0.0, rays: 20_000, max_dirty_bytes: 0 })
            .unwrap()
            .cells_promoted;
        let (_, lods) = live.cell_lods().unwrap();
        assert!(lods.iter().zip(&last).all(|(now, before)| now >= before), "no cell falls back");
        last = lods;
    }
    assert!(last.contains(&0), "and not all at once");
    assert_eq!(live.lod_at(Vec3::splat(1e6)), None);
    assert_eq!(live.lod_at(Vec3::NAN), None);
}

#[test]
fn work_between_updates_ends_with_the_bits_of_a_bake_and_can_be_paused() {
    let mut lightmap = unbaked("cornell", 2, 24.0);
    let params = LiveParams { background: true, near_hits: 1.0, ..params(Mode::Position) };
    let mut live = Live::new(&lightmap, &params, &Progress::none()).unwrap();
    let little = Budget { milliseconds: 0.0, rays: 64, max_dirty_bytes: 0 };
    let mut behind_the_back = 0;
    for i in 0..100_000 {
        let stats = live.update(&camera(i), &little).unwrap();
        behind_the_back += stats.rays.saturating_sub(2048);
        if i == 10 {
            live.pause(true).unwrap();
            let before = live.sums().unwrap();
            std::thread::sleep(std::time::Duration::from_millis(20));
            assert_eq!(live.sums().unwrap(), before);
            live.pause(false).unwrap();
        }
        if stats.finished == 1.0 {
            break;
        }
        std::thread::sleep(std::time::Duration::from_micros(500));
    }
    assert!(behind_the_back > 100_000, "{behind_the_back}");
    while live.update(&camera(0), &Budget { milliseconds: 1000.0, rays: 0, max_dirty_bytes: 0 }).unwrap().blocks_changed
        > 0
    {}
    assert_same_as_bake(&live, &mut lightmap, "in the background");
}

/// With one thread, updates limited by rays do the same work every time.
#[test]
fn errors_of_blocks_that_are_worked_on_between_updates_count() {
    let lightmap = unbaked("cornell", 1, 24.0);
    let create = |background| {
        let params = LiveParams { background, max_rounds: 64, ..params(Mode::View) };
        Live::new(&lightmap, &params, &Progress::none()).unwrap()
    };
    let (mut alone, mut live) = (create(false), create(true));
    let little = Budget { milliseconds: 0.0, rays: 64, max_dirty_bytes: 0 };
    let nothing = Budget { milliseconds: 0.0, rays: 0, max_dirty_bytes: 0 };
    // The first update leaves all blocks alike; the pool then takes the most urgent ones away.
    let (at_home, away) = (alone.update(&camera(0), &little).unwrap(), live.update(&camera(0), &little).unwrap());
    assert!(at_home.visible_error > 0.2, "{at_home:?}");
    assert_eq!(away.visible_error, at_home.visible_error);
    assert_eq!((away.finished, away.visible_finished), (at_home.finished, at_home.visible_finished));
    for _ in 0..20 {
        let before = live.update(&camera(0), &little).unwrap().visible_error;
        live.pause(true).unwrap();
        let after = live.update(&camera(0), &nothing).unwrap().visible_error;
        live.pause(false).unwrap();
        // Work in the background lowers the error, or finds that it was more than one round could tell.
        assert!(before > 0.7 * after, "{before} while blocks are away, {after} when they are back");
    }
}

#[test]
fn a_saved_state_goes_on_where_it_was() {
    let mut lightmap = unbaked("cornell", 2, 24.0);
    let mut live = Live::new(&lightmap, &params(Mode::Position), &Progress::none()).unwrap();
    for i in 0..15 {
        live.update(&camera(i), &RAYS).unwrap();
    }
    let path = std::env::temp_dir().join(format!("bakelite-live-{}", std::process::id()));
    live.save(&path, &Progress::none()).unwrap();
    let mut other = Live::new(&lightmap, &params(Mode::Position), &Progress::none()).unwrap();
    other.restore(&path, &Progress::none()).unwrap();
    assert_eq!(other.sums().unwrap(), live.sums().unwrap());
    assert_eq!(other.cell_lods().unwrap(), live.cell_lods().unwrap());

    // What is damaged, cut off, of something else or missing is refused and changes nothing.
    let whole = std::fs::read(&path).unwrap();
    let mut refuse = |bytes: &[u8], part: &str| {
        std::fs::write(&path, bytes).unwrap();
        let e = other.restore(&path, &Progress::none()).unwrap_err().to_string();
        assert!(e.contains(part) || e.contains("was saved of another"), "{e}");
        assert_eq!(other.sums().unwrap(), live.sums().unwrap());
    };
    refuse(&whole[..whole.len() / 2], "checksum");
    refuse(&[], "is not a saved");
    for at in (0..whole.len()).step_by(whole.len() / 50) {
        let mut damaged = whole.clone();
        damaged[at] ^= 0x40;
        refuse(&damaged, "is");
    }
    std::fs::write(&path, &whole).unwrap();
    let different = LiveParams { seed: 6, ..params(Mode::Position) };
    let mut different = Live::new(&lightmap, &different, &Progress::none()).unwrap();
    assert!(matches!(different.restore(&path, &Progress::none()), Err(Error::InvalidArgument(_))));
    std::fs::remove_file(&path).unwrap();
    assert!(matches!(other.restore(&path, &Progress::none()), Err(Error::Io(_))));

    assert_eq!(finish(&mut other).finished, 1.0);
    assert_same_as_bake(&other, &mut lightmap, "restored");
}

/// The checksum of a saved state, put right after a change.
fn with_checksum(mut bytes: Vec<u8>) -> Vec<u8> {
    let end = bytes.len() - 8;
    let sum = bytes[..end]
        .iter()
        .fold(0xcbf2_9ce4_8422_2325, |h: u64, &b| (h ^ b as u64).wrapping_mul(0x0000_0100_0000_01b3));
    bytes[end..].copy_from_slice(&sum.to_le_bytes());
    bytes
}

/// Whoever can write a file can write its checksum too.
#[test]
fn no_file_with_a_right_checksum_brings_light_that_cannot_be() {
    mutate_state(0, 600);
    mutate_state(3, 160);
}

/// Restores a state, with a number of changes one after the other.
fn mutate_state(directional: u32, turns: u32) {
    let lightmap = unbaked("cornell", 2, 8.0);
    let params = |mode| LiveParams { directional, ..params(mode) };
    let mut live = Live::new(&lightmap, &params(Mode::Position), &Progress::none()).unwrap();
    for i in 0..8 {
        live.update(&camera(i), &Budget { milliseconds: 0.0, rays: 20_000, max_dirty_bytes: 0 }).unwrap();
    }
    let path = std::env::temp_dir().join(format!("bakelite-mutated-{directional}-{}", std::process::id()));
    live.save(&path, &Progress::none()).unwrap();
    let whole = std::fs::read(&path).unwrap();
    std::fs::remove_file(&path).unwrap();
    assert_eq!(with_checksum(whole.clone()), whole);
    let mut other = Live::new(&lightmap, &params(Mode::Position), &Progress::none()).unwrap();
    other.restore_bytes(&whole, "whole", &Progress::none()).unwrap();
    let sums = other.sums().unwrap();
    assert_eq!(sums, live.sums().unwrap());
    let hostile = [-1.0, -1e-30, f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX, 1e38].map(f32::to_bits);
    let hostile: Vec<u32> = hostile.into_iter().chain([0, 1, 63, 65, 0xff, 0xffff, 0x7fff_ffff, u32::MAX]).collect();
    let (mut refused, mut taken, mut random) = (0, 0, 12345u32);
    for turn in 0..turns {
        random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        // Behind the head; blocks are of odd sizes, so that all fields have their turn.
        let at = 24 + (random >> 4) as usize % (whole.len() - 36);
        let mut bytes = whole.clone();
        match turn % 8 {
            0 => bytes.truncate(at.max(32)),
            1 => drop(bytes.splice(at..at, [0; 24])),
            2 => bytes[at] ^= 1 << (random & 7),
            _ => bytes[at..at + 4].copy_from_slice(&hostile[random as usize % hostile.len()].to_le_bytes()),
        }
        match other.restore_bytes(&with_checksum(bytes), "mutated", &Progress::none()) {
            Err(e) => {
                assert!(matches!(&e, Error::Io(m) if m.starts_with("mutated is ")), "{e}");
                assert_eq!(other.sums().unwrap(), sums, "{e}");
                refused += 1;
            }
            Ok(()) => {
                for lod in 0..3 {
                    let info = lightmap.info();
                    for page in 0..info.page_count {
                        let rect = PageRect { page, x: 0, y: 0, width: info.width, height: info.height };
                        let light = other.read(&rect, lod, Layer::Combined).unwrap();
                        assert!(light.iter().flatten().all(|c| c.is_finite() && *c >= 0.0), "turn {turn}, byte {at}");
                        let l0 = if directional == 0 { Vec::new() } else { other.read(&rect, lod, Layer::L0).unwrap() };
                        assert!(l0.iter().flatten().all(|c| c.is_finite() && *c >= 0.0), "turn {turn}, byte {at}");
                    }
                }
                if taken % 16 == 0 {
                    other.update(&camera(turn), &Budget { milliseconds: 0.0, rays: 1000, max_dirty_bytes: 0 }).unwrap();
                }
                other.restore_bytes(&whole, "whole", &Progress::none()).unwrap();
                taken += 1;
            }
        }
    }
    println!("{refused} refused, {taken} taken");
    assert!(refused > turns / 5 && taken > turns / 12, "{refused} refused, {taken} taken");
    assert_eq!(finish(&mut other).finished, 1.0);
}

/// A callback that cancels at its `n`-th call, and how often it was called.
fn cancels_at(n: u32, calls: &std::sync::atomic::AtomicU32) -> Progress<'_> {
    Progress::new(move |_, _| calls.fetch_add(1, std::sync::atomic::Ordering::SeqCst) + 1 < n)
}

#[test]
fn a_cancelled_create_save_or_restore_changes_nothing() {
    let mut lightmap = unbaked("cornell", 2, 40.0);
    let device = lightmap.scene().device().clone();
    let before = device.memory().current();
    for n in 1..30 {
        let calls = Default::default();
        let result = Live::new(&lightmap, &params(Mode::Position), &cancels_at(n, &calls));
        assert_eq!(result.err(), (calls.into_inner() >= n).then_some(Error::Cancelled));
        assert_eq!(device.memory().current(), before);
    }
    let mut live = Live::new(&lightmap, &params(Mode::Position), &Progress::none()).unwrap();
    let path = std::env::temp_dir().join(format!("bakelite-cancelled-{}", std::process::id()));
    live.save(&path, &Progress::none()).unwrap();
    let first = std::fs::read(&path).unwrap();
    for i in 0..10 {
        live.update(&camera(i), &RAYS).unwrap();
    }
    let (sums, light) = (live.sums().unwrap(), pages(&live, &lightmap));
    // The first report comes before anything is written or read.
    let mut cancelled = [0, 0];
    for n in 1..8 {
        let calls = Default::default();
        if live.save(&path, &cancels_at(n, &calls)) == Err(Error::Cancelled) {
            cancelled[0] += 1;
            assert_eq!(std::fs::read(&path).unwrap(), first);
        } else {
            std::fs::write(&path, &first).unwrap();
        }
        let calls = Default::default();
        if live.restore(&path, &cancels_at(n, &calls)) == Err(Error::Cancelled) {
            cancelled[1] += 1;
            assert_eq!((live.sums().unwrap(), pages(&live, &lightmap)), (sums.clone(), light.clone()));
        } else {
            break;
        }
    }
    assert!(cancelled[0] > 0 && cancelled[1] > 0, "{cancelled:?}");
    let mut beside = path.clone().into_os_string();
    beside.push(".part");
    assert!(!std::path::Path::new(&beside).exists());
    std::fs::remove_file(&path).unwrap();
    assert_eq!(finish(&mut live).finished, 1.0);
    assert_same_as_bake(&live, &mut lightmap, "after cancelled calls");
}

#[test]
fn a_lower_lod_can_be_read_beside_what_is_shown() {
    let lightmap = unbaked("cornell", 2, 24.0);
    let mut live = Live::new(&lightmap, &params(Mode::Position), &Progress::none()).unwrap();
    let size = lightmap.info().width;
    let whole = PageRect { page: 0, x: 0, y: 0, width: size, height: size };
    let first = live.read(&whole, 2, Layer::Indirect).unwrap();
    finish(&mut live);
    let error = |lod| {
        let (now, top) =
            (live.read(&whole, lod, Layer::Indirect).unwrap(), live.read(&whole, 2, Layer::Indirect).unwrap());
        now.iter().zip(&top).map(|(a, b)| (Vec3::from(*a) - Vec3::from(*b)).length_squared()).sum::<f32>()
    };
    assert!(error(0) > error(1) && error(1) > 0.0, "{} {}", error(0), error(1));
    assert_ne!(first, live.read(&whole, 0, Layer::Indirect).unwrap(), "more rays came in");
    assert!(live.read(&whole, 3, Layer::Combined).unwrap_err().to_string().contains("lod is 3"));
}

#[test]
fn a_monitor_that_refuses_growth_stops_the_work_and_nothing_else() {
    let limit = std::sync::Arc::new(std::sync::atomic::AtomicI64::new(i64::MAX));
    let ask = limit.clone();
    let device = Device::new(DeviceOptions {
        num_threads: 2,
        memory: Some(Box::new(move |bytes| bytes <= ask.load(std::sync::atomic::Ordering::SeqCst))),
        ..Default::default()
    })
    .unwrap();
    let data = builtin("cornell").unwrap();
    let scene = Scene::commit(&device, data, &BuildOptions::default(), &Progress::none()).map_err(|e| e.1).unwrap();
    let desc = LightmapDesc { texels_per_unit: 120.0, page_size: 256, ..Default::default() };
    let mut lightmap = Lightmap::create(&scene, &desc, &Progress::none()).unwrap();
    let mut live = Live::new(&lightmap, &params(Mode::Position), &Progress::none()).unwrap();
    limit.store(0, std::sync::atomic::Ordering::SeqCst);
    let refused = (0..200).find_map(|i| live.update(&camera(i), &RAYS).err()).unwrap();
    assert!(matches!(&refused, Error::OutOfMemory(m) if m.contains("live light")), "{refused}");
    limit.store(i64::MAX, std::sync::atomic::Ordering::SeqCst);
    assert_eq!(finish(&mut live).finished, 1.0);
    assert_same_as_bake(&live, &mut lightmap, "after a refusal");
    drop((live, lightmap, scene));
    assert_eq!(device.memory().current(), 0);
}

#[test]
fn bad_cameras_and_budgets_are_refused_and_change_nothing() {
    let lightmap = unbaked("cornell", 1, 24.0);
    let mut live = Live::new(&lightmap, &params(Mode::View), &Progress::none()).unwrap();
    live.take_dirty(usize::MAX).unwrap();
    let before = (live.sums().unwrap(), pages(&live, &lightmap));
    let good = camera(0);
    let bad = [
        LiveCamera { position: Vec3::new(0.0, f32::NAN, 0.0), ..good },
        LiveCamera { forward: Vec3::ZERO, ..good },
        LiveCamera { up: good.forward * 2.0, ..good },
        LiveCamera { fov_y: 0.0, ..good },
        LiveCamera { fov_y: PI, ..good },
        LiveCamera { width: 0, ..good },
    ];
    for camera in bad {
        let e = live.update(&camera, &RAYS).unwrap_err();
        assert!(matches!(&e, Error::InvalidArgument(m) if m.contains("camera")), "{e}");
    }
    for milliseconds in [-1.0, f32::NAN, f32::INFINITY] {
        let e = live.update(&good, &Budget { milliseconds, rays: 0, max_dirty_bytes: 0 }).unwrap_err();
        assert!(e.to_string().contains("milliseconds"), "{e}");
    }
    let stats = live.update(&good, &Budget { milliseconds: 0.0, rays: 0, max_dirty_bytes: 0 }).unwrap();
    assert_eq!((stats.rays, stats.blocks_changed), (0, 0));
    assert_eq!((live.sums().unwrap(), pages(&live, &lightmap)), before);
    assert!(live.take_dirty(8).unwrap().is_empty());
    // From inside a wall, outside the scene and very far away: nothing to see, and no harm.
    for position in [Vec3::new(0.0, -0.001, 0.0), Vec3::splat(100.0), Vec3::splat(1e18)] {
        live.update(&LiveCamera { position, ..good }, &RAYS).unwrap();
    }
    for wrong in [LiveParams { lod_count: 0, ..params(Mode::View) }, LiveParams { max_rounds: 0, ..params(Mode::View) }]
    {
        assert!(Live::new(&lightmap, &wrong, &Progress::none()).is_err());
    }
}
