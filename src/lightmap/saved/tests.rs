//! Tests of results and checkpoints: what comes back has the bits of one bake, whatever was cut off, put together or
//! killed in between; what is damaged or foreign is refused and changes nothing.

use super::records::{self, Next, Records};
use crate::base::error::{Error, Result};
use crate::base::progress::Progress;
use crate::bvh::BuildOptions;
use crate::device::{Device, DeviceOptions};
use crate::lightmap::atlas::chart_map::ChartMap;
use crate::lightmap::atlas::ids::Map;
use crate::lightmap::{BakeParams, CheckpointParams, Layer, LayerData, Lightmap, LightmapDesc, Region};
use crate::scene::{Light, Scene, builtin};
use crate::simd::Isa;
use glam::Vec3;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

/// A file of its own, deleted in the end.
pub(super) struct Place(PathBuf);

impl Place {
    fn new() -> Place {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let name = format!("bakelite-saved-{}-{}", std::process::id(), COUNT.fetch_add(1, Relaxed));
        Place(std::env::temp_dir().join(name))
    }

    fn bytes(&self) -> Vec<u8> {
        std::fs::read(&self.0).unwrap()
    }

    pub(super) fn path(&self) -> &Path {
        &self.0
    }

    fn of(bytes: &[u8]) -> Place {
        let place = Place::new();
        std::fs::write(&place.0, bytes).unwrap();
        place
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.0);
    }
}

pub(super) fn lightmap_with(threads: usize, texels_per_unit: f32) -> Lightmap {
    lightmap_on(DeviceOptions { num_threads: threads, ..Default::default() }, texels_per_unit)
}

fn lightmap_on(device: DeviceOptions, texels_per_unit: f32) -> Lightmap {
    let device = Device::new(device).unwrap();
    let mut data = builtin("cornell").unwrap();
    data.add_light(lamp(0.5)).unwrap();
    let scene = Scene::commit(&device, data, &BuildOptions::default(), &Progress::none()).map_err(|e| e.1).unwrap();
    let desc = LightmapDesc { texels_per_unit, page_size: 128, ..Default::default() };
    Lightmap::create(&scene, &desc, &Progress::none()).unwrap()
}

pub(super) fn lamp(intensity: f32) -> Light {
    Light::Point { position: glam::Vec3::new(0.3, 0.3, 0.3), intensity: [intensity; 3] }
}

fn lightmap(threads: usize) -> Lightmap {
    lightmap_with(threads, 20.0)
}

/// Bakes in a moment and runs every stage.
fn params() -> BakeParams {
    let (photon_count, interpolation_contrast) = (10_000, 0.15);
    BakeParams {
        photon_count,
        interpolation_contrast,
        gather_rays: 16,
        direct_samples: 2,
        seed: 3,
        ..Default::default()
    }
}

fn bake(threads: usize, params: &BakeParams) -> Lightmap {
    let mut map = lightmap(threads);
    map.bake(params, &Progress::none()).unwrap();
    let light = map.light.as_ref().unwrap();
    assert!(!light.radiance.split.is_empty(), "no texel lies on both sides of a wall");
    map
}

/// All that a light map shows.
pub(super) fn bits(map: &Lightmap) -> Vec<u32> {
    let mut all = Vec::new();
    for page in 0..map.info().page_count {
        for layer in [Layer::Combined, Layer::Indirect, Layer::Direct, Layer::Radiance, Layer::Validity, Layer::Normal]
        {
            match map.read(page, layer).unwrap() {
                LayerData::Rgb(v) => all.extend(v.iter().flatten().map(|x| x.to_bits())),
                LayerData::Scalar(v) => all.extend(v.iter().map(|x| x.to_bits())),
                LayerData::Integer(v) => all.extend(v),
            }
        }
    }
    all
}

/// Says how many numbers differ, not which.
#[track_caller]
pub(super) fn assert_same(a: &Lightmap, b: &Lightmap, what: &str) {
    let (a, b) = (bits(a), bits(b));
    let different: Vec<usize> = (0..a.len().max(b.len())).filter(|&i| a.get(i) != b.get(i)).collect();
    assert!(different.is_empty(), "{what}: {} of {} differ, first {}", different.len(), b.len(), different[0]);
}

fn save(map: &Lightmap) -> Place {
    let place = Place::new();
    map.save_result(&place.0, &Progress::none()).unwrap();
    place
}

fn load(map: &mut Lightmap, path: &Path) -> Result<()> {
    map.load_result(path, &Progress::none())
}

#[test]
fn a_result_comes_back_with_every_bit_and_its_plan() {
    let baked = bake(2, &params());
    let file = save(&baked);
    let mut map = lightmap(1);
    load(&mut map, &file.0).unwrap();
    assert!(bits(&map) == bits(&baked));
    assert_eq!(map.plan_text(), baked.plan_text());
    // And goes out again as it came.
    assert!(save(&map).bytes() == file.bytes());
}

#[test]
fn shards_put_together_in_any_order_are_one_bake() {
    let whole = bake(2, &params());
    let n = whole.info().texels;
    let cuts = [0, n / 5, n / 2, n];
    let shards: Vec<Place> = cuts
        .windows(2)
        .map(|w| save(&bake(1, &BakeParams { texel_begin: w[0], texel_end: w[1], ..params() })))
        .collect();
    for order in [[0, 1, 2], [2, 0, 1], [1, 2, 0]] {
        let mut map = lightmap(2);
        for i in order {
            assert!(bits(&map_or_dark(&map)) != bits(&whole));
            load(&mut map, &shards[i].0).unwrap();
        }
        assert_same(&map, &whole, &format!("{order:?}"));
    }
    // Two in one file, the third baked here.
    let mut map = lightmap(2);
    load(&mut map, &shards[2].0).unwrap();
    load(&mut map, &shards[0].0).unwrap();
    let two = save(&map);
    let mut map = lightmap(2);
    map.bake(&BakeParams { texel_begin: cuts[1], texel_end: cuts[2], ..params() }, &Progress::none()).unwrap();
    load(&mut map, &two.0).unwrap();
    assert_same(&map, &whole, "two in one file");
}

/// A light map with whatever light there is; [`bits`] needs some.
fn map_or_dark(map: &Lightmap) -> Lightmap {
    if map.read(0, Layer::Combined).is_ok() {
        let file = save(map);
        let mut copy = lightmap(1);
        load(&mut copy, &file.0).unwrap();
        return copy;
    }
    let mut dark = lightmap(1);
    dark.bake(&BakeParams { gather_rays: 0, direct_samples: 1, seed: 99, ..params() }, &Progress::none()).unwrap();
    dark
}

#[test]
fn a_foreign_result_is_refused_by_name_and_changes_nothing() {
    let n = lightmap(1).info().texels;
    let shard = |p: BakeParams| save(&bake(1, &BakeParams { texel_end: n / 2, ..p }));
    let file = shard(params());
    let mut other_lights = lightmap(1);
    other_lights.scene().set_light(0, lamp(0.6)).unwrap();
    let e = load(&mut other_lights, &file.0).unwrap_err();
    assert!(matches!(&e, Error::InvalidArgument(s) if s.contains("the lights") && !s.contains("geometry")), "{e}");
    assert!(other_lights.read(0, Layer::Combined).is_err());
    let e = load(&mut lightmap_with(1, 19.0), &file.0).unwrap_err();
    assert!(e.to_string().contains("the light map's layout") && !e.to_string().contains("materials"), "{e}");
    // Shards of two bakes do not mix.
    let mut map = lightmap(1);
    load(&mut map, &shard(BakeParams { seed: 4, ..params() }).0).unwrap();
    let before = bits(&map);
    assert!(matches!(load(&mut map, &file.0), Err(Error::InvalidState(_))));
    assert!(bits(&map) == before);
    // Nor can their mixture be saved.
    map.bake(&BakeParams { texel_begin: n / 2, ..params() }, &Progress::none()).unwrap();
    let place = Place::new();
    assert!(matches!(map.save_result(&place.0, &Progress::none()), Err(Error::InvalidState(_))));
    assert!(!place.0.exists());
}

#[test]
fn isas_that_fuse_give_the_same_bits_and_share_results_and_others_are_refused() {
    let of = |isa| lightmap_on(DeviceOptions { num_threads: 2, isa: Some(isa), ..Default::default() }, 20.0);
    let mut baked: Vec<(Isa, Lightmap, Place)> = Vec::new();
    for isa in Isa::available() {
        let mut map = of(isa);
        map.bake(&params(), &Progress::none()).unwrap();
        let file = save(&map);
        for (other, other_map, other_file) in &baked {
            let loaded = load(&mut of(isa), &other_file.0);
            if other.is_fused() == isa.is_fused() {
                assert!(bits(&map) == bits(other_map), "{} and {} differ", isa.name(), other.name());
                loaded.unwrap();
            } else {
                let e = loaded.unwrap_err();
                assert!(e.to_string().contains("the instruction set (portable, here AVX2 or AVX-512)"), "{e}");
            }
        }
        baked.push((isa, map, file));
    }
}

#[test]
fn a_damaged_or_cut_result_is_refused_and_changes_nothing() {
    let baked = bake(2, &params());
    let bytes = save(&baked).bytes();
    let mut map = lightmap(2);
    map.bake(&BakeParams { seed: 8, ..params() }, &Progress::none()).unwrap();
    let before = bits(&map);
    for i in 0..200 {
        let at = i * 7919 * bytes.len() / (200 * 7919);
        let mut flipped = bytes.clone();
        flipped[at] ^= 1 << (i % 8);
        for damaged in [&flipped[..], &bytes[..at]] {
            let e = load(&mut map, &Place::of(damaged).0).expect_err("damage is not seen");
            assert!(matches!(e, Error::Io(_) | Error::InvalidArgument(_)), "{e}");
        }
    }
    assert!(bits(&map) == before);
    assert!(matches!(load(&mut map, Path::new("no-such-file")), Err(Error::Io(_))));
}

#[test]
fn loading_can_be_cancelled_and_saving_leaves_no_half_of_a_file() {
    let baked = bake(2, &params());
    let file = save(&baked);
    // At the start of the first stage, which is reported whatever the speed.
    let cancelling = || Progress::new(|_, _| false);
    let mut map = lightmap(2);
    assert_eq!(map.load_result(&file.0, &cancelling()), Err(Error::Cancelled));
    assert!(map.read(0, Layer::Combined).is_err());
    let other = Place::of(b"old");
    assert_eq!(baked.save_result(&other.0, &cancelling()), Err(Error::Cancelled));
    assert_eq!(other.bytes(), b"old");
}

fn at(place: &Place) -> CheckpointParams {
    CheckpointParams { path: place.0.clone(), seconds: 0.0 }
}

/// Bakes with a checkpoint that is written at once, and cancels at the given part of the way.
fn bake_until(threads: usize, place: &Place, part: f32) -> Result<Lightmap> {
    let mut map = lightmap(threads);
    let progress = Progress::new(|f, _| f < part);
    map.bake_with(&params(), Some(&at(place)), &progress).map(|_| map)
}

#[test]
fn a_bake_that_ended_anywhere_goes_on_and_gives_the_same_bits() {
    let whole = bits(&bake(2, &params()));
    for (i, part) in [0.05, 0.25, 0.31, 0.4, 0.5, 0.61, 0.7, 0.9, 0.99].into_iter().enumerate() {
        let place = Place::new();
        assert_eq!(bake_until(1 + i % 2, &place, part).err(), Some(Error::Cancelled), "{part}");
        let begun = std::fs::metadata(&place.0).unwrap().len();
        let map = bake_until(2 - i % 2, &place, 2.0).unwrap();
        assert!(bits(&map) == whole, "cancelled at {part}");
        let complete = std::fs::metadata(&place.0).unwrap().len();
        // Small as it is, the bake may have been complete before the cancel was heard.
        assert!(begun <= complete);
        // Of a complete bake nothing is computed or written again.
        let mut map = lightmap(2);
        let stats = map.bake_with(&params(), Some(&at(&place)), &Progress::none()).unwrap();
        assert!(bits(&map) == whole);
        assert_eq!((stats.photons.rays, stats.radiance.rays, stats.direct.rays), (0, 0, 0));
        assert_eq!(std::fs::metadata(&place.0).unwrap().len(), complete);
    }
}

#[test]
fn a_checkpoint_cut_at_any_byte_goes_on_and_a_flipped_bit_is_refused() {
    let whole = bits(&bake(2, &params()));
    let place = Place::new();
    bake_until(2, &place, 2.0).unwrap();
    let bytes = place.bytes();
    for i in 0..24 {
        let cut = Place::of(&bytes[..bytes.len() * i / 24]);
        assert!(bits(&bake_until(2, &cut, 2.0).unwrap()) == whole, "cut to {i}/24");
    }
    for i in 0..200 {
        let mut flipped = bytes.clone();
        let at = (i * bytes.len() + bytes.len() / 2) / 200;
        flipped[at] ^= 1 << (i % 8);
        let damaged = Place::of(&flipped);
        assert!(matches!(bake_until(2, &damaged, 2.0), Err(Error::Io(_) | Error::InvalidArgument(_))), "byte {at}");
        assert!(damaged.bytes() == flipped, "a file that is refused is changed");
    }
}

/// As a file system leaves a file whose last blocks were not on disk when power failed.
#[test]
fn a_checkpoint_whose_end_is_zeros_goes_on() {
    let whole = bits(&bake(2, &params()));
    let place = Place::new();
    bake_until(2, &place, 2.0).unwrap();
    let bytes = place.bytes();
    for (i, lost) in [1, 30, 512, 5_000, bytes.len() / 2].into_iter().enumerate() {
        for behind in [0, 7, 4096] {
            let mut zeroed = bytes.clone();
            let start = (bytes.len() + behind - lost) / 512 * 512;
            zeroed.resize(bytes.len() + behind, 0);
            zeroed[start..].fill(0);
            let file = Place::of(&zeroed);
            let mut map = lightmap(1 + i % 2);
            map.bake_with(&params(), Some(&at(&file)), &Progress::none()).unwrap();
            assert!(bits(&map) == whole, "{lost} bytes and {behind} more");
            // It has become a checkpoint without zeros.
            assert!(file.bytes().len() == bytes.len());
        }
    }
    // Zeros in the middle are damage, and so is a flipped bit before zeros.
    let mut damaged = bytes.clone();
    // The middle may be zeros already: states of texels, in the order in which threads finish blocks.
    let start = (bytes.len() / 2..).find(|&i| bytes[i] != 0).unwrap();
    damaged[start..][..600].fill(0);
    let mut flipped = bytes.clone();
    // Of the bits of the last byte one that does not leave zeros.
    *flipped.last_mut().unwrap() ^= if bytes.ends_with(&[1 << 7]) { 1 } else { 1 << 7 };
    flipped.resize(bytes.len() + 4096, 0);
    for damaged in [damaged, flipped] {
        let file = Place::of(&damaged);
        assert!(matches!(bake_until(2, &file, 2.0), Err(Error::Io(_))));
        assert!(file.bytes() == damaged);
    }
}

#[test]
fn a_foreign_or_used_checkpoint_is_refused_and_kept() {
    let place = Place::new();
    let _ = bake_until(2, &place, 0.5);
    let bytes = place.bytes();
    let mut map = lightmap(2);
    let mut refused = |params: BakeParams, what: &str| {
        let e = map.bake_with(&params, Some(&at(&place)), &Progress::none()).unwrap_err();
        assert!(matches!(&e, Error::InvalidArgument(s) if s.contains(what)), "{e}");
        assert!(place.bytes() == bytes);
    };
    refused(BakeParams { seed: 9, ..params() }, "seed (3, here 9)");
    refused(BakeParams { texel_end: 10, ..params() }, "texel_end");
    refused(BakeParams { radius: 0.25, ..params() }, "radius (0.0, here 0.25)");
    // A result is no checkpoint, nor is anything else.
    for other in [save(&bake(1, &params())).bytes(), b"some text".to_vec(), vec![0; 4096]] {
        let other = Place::of(&other);
        let before = other.bytes();
        assert!(matches!(bake_until(1, &other, 2.0), Err(Error::Io(_))));
        assert!(other.bytes() == before);
    }
    // While one bake uses it another one cannot.
    let mut seconds = Vec::new();
    // At the end seams are stitched, and the file is free again.
    let progress = Progress::new(|f, _| {
        if f < 0.3 {
            seconds.push(bake_until(1, &place, 2.0).err());
        }
        true
    });
    lightmap(2).bake_with(&params(), Some(&at(&place)), &progress).unwrap();
    drop(progress);
    assert!(!seconds.is_empty() && seconds.iter().all(|e| matches!(e, Some(Error::InvalidState(_)))), "{seconds:?}");
    let bad = CheckpointParams { seconds: f64::NAN, ..at(&place) };
    assert!(matches!(map.bake_with(&params(), Some(&bad), &Progress::none()), Err(Error::InvalidArgument(_))));
}

/// A file with changed content and right checksums.
pub(super) fn with_records(bytes: &[u8], mut change: impl FnMut(&[u8; 4], &mut [u8])) -> Place {
    let mut file = records::MAGIC.to_vec();
    let mut from = Records::new(&bytes[file.len()..], bytes.len() as u64);
    while let Next::Record(tag, mut content) = from.next().unwrap() {
        change(&tag, &mut content);
        records::append(&mut file, tag, &[&content]).unwrap();
    }
    Place::of(&file)
}

#[test]
fn a_checkpoint_with_numbers_of_shadow_rays_that_no_bake_has_is_not_believed() {
    let whole = bits(&bake(2, &params()));
    let place = Place::new();
    bake_until(2, &place, 2.0).unwrap();
    for shadow_rays in [0, 33u32] {
        let file = with_records(&place.bytes(), |tag, content| match tag {
            b"RDNE" => {
                content[8..12].copy_from_slice(&1e-3f32.to_ne_bytes());
                content[12..16].copy_from_slice(&shadow_rays.to_ne_bytes());
            }
            // To be computed again, from the radiance map.
            _ if tag != b"CKPT" && tag != b"RADI" => content[..8].fill(0xff),
            _ => {}
        });
        assert!(bits(&bake_until(2, &file, 2.0).unwrap()) == whole, "{shadow_rays}");
    }
}

#[test]
fn a_result_with_more_light_than_can_be_is_refused() {
    let baked = bake(2, &params());
    let bytes = save(&baked).bytes();
    for (tag, first) in [(b"RADI", 0), (b"TEXL", 16)] {
        let file = with_records(&bytes, |t, content| {
            if t == tag {
                content[first..first + 4].copy_from_slice(&3e38f32.to_ne_bytes());
            }
        });
        assert!(matches!(load(&mut lightmap(1), &file.0), Err(Error::Io(_))), "{tag:?}");
    }
}

fn scene_of(name: &str, isa: Option<Isa>) -> std::sync::Arc<Scene> {
    let device = Device::new(DeviceOptions { num_threads: 2, isa, ..Default::default() }).unwrap();
    let mut data = builtin(name).unwrap();
    data.add_light(lamp(0.5)).unwrap();
    Scene::commit(&device, data, &BuildOptions::default(), &Progress::none()).map_err(|e| e.1).unwrap()
}

fn coarse() -> LightmapDesc {
    LightmapDesc { texels_per_unit: 4.0, page_size: 128, ..Default::default() }
}

#[test]
fn a_layout_comes_back_with_all_its_bits() {
    let above = Region { lower: Vec3::new(0.4, 0.9, 0.4), upper: Vec3::new(0.6, 0.95, 0.6) };
    for (name, texels_per_unit, seen_from) in [
        ("cornell", 40.0, vec![]),
        ("atrium", 4.0, vec![]),
        ("cornell", 40.0, vec![above]),
        ("colonnade:100000", 2.0, vec![]),
    ] {
        let scene = scene_of(name, None);
        let desc = LightmapDesc { texels_per_unit, seen_from, ..coarse() };
        let made = Lightmap::create(&scene, &desc, &Progress::none()).unwrap();
        let place = Place::new();
        made.save_layout(&place.0, &Progress::none()).unwrap();
        let loaded = Lightmap::load_layout(&scene, &desc, &place.0, &Progress::none()).unwrap();
        let (a, b) = (made.atlas(), loaded.atlas());
        assert_eq!(a.charts, b.charts, "{name}");
        fn assert_same<M: Map>(a: &ChartMap<M>, b: &ChartMap<M>, name: &str) {
            assert_eq!(a.layout, b.layout, "{name}");
            assert!(a.texels.samples == b.texels.samples && a.texels.chart_start == b.texels.chart_start, "{name}");
        }
        assert_same(&a.map, &b.map, name);
        assert_same(&a.gather, &b.gather, name);
        assert_same(&a.radiance, &b.radiance, name);
        assert!(a.seen.unseen == b.seen.unseen && a.seen.unseen.contains(&true) != desc.seen_from.is_empty(), "{name}");
        assert!(a.buried == b.buried && a.seen.counts == b.seen.counts && a.seen.hidden == b.seen.hidden, "{name}");
        assert!(a.buried.iter().any(|&b| b), "{name} has no buried texels to test");
        let numbers = |l: &Lightmap| {
            let mut info = l.info();
            (info.unwrap_seconds, info.uvs.seconds) = (0.0, 0.0);
            format!("{info:?}")
        };
        assert_eq!(numbers(&made), numbers(&loaded), "{name}");
        let again = Place::new();
        loaded.save_layout(&again.0, &Progress::none()).unwrap();
        assert!(place.bytes() == again.bytes(), "{name}");
    }
}

#[test]
fn a_layout_of_something_else_is_refused_by_name() {
    let (scene, place) = (scene_of("cornell", None), Place::new());
    let desc = LightmapDesc { texels_per_unit: 20.0, ..coarse() };
    Lightmap::create(&scene, &desc, &Progress::none()).unwrap().save_layout(&place.0, &Progress::none()).unwrap();
    let refused = |scene: &std::sync::Arc<Scene>, desc: &LightmapDesc, differences: &str| match Lightmap::load_layout(
        scene,
        desc,
        &place.0,
        &Progress::none(),
    ) {
        Err(Error::InvalidArgument(text)) => assert!(text.ends_with(differences), "{text}"),
        Err(e) => panic!("{e}"),
        Ok(_) => panic!("{differences}: not refused"),
    };
    let seen_from = vec![Region { lower: Vec3::ZERO, upper: Vec3::ONE }];
    refused(&scene, &LightmapDesc { seen_from, ..desc.clone() }, "differs in from where it is seen");
    refused(&scene, &LightmapDesc { padding: 3, ..desc.clone() }, "differs in padding (2, here 3)");
    refused(&scene_of("atrium", None), &desc, "the scene's geometry, the light map UVs, the scene's materials");
    let sun = Light::Directional { direction: glam::Vec3::NEG_Y, irradiance: [1.0; 3], angular_radius: 0.0 };
    scene.set_light(1, sun).unwrap();
    refused(&scene, &desc, "differs in whether a sun or a sky shines");
    scene.set_light(1, lamp(0.1)).unwrap();
    Lightmap::load_layout(&scene, &desc, &place.0, &Progress::none()).unwrap();
    let result = Lightmap::load_layout(&scene, &desc, &place.0, &Progress::new(|_, _| false));
    assert!(matches!(result, Err(Error::Cancelled)));
    let other = lightmap(1);
    std::fs::write(&place.0, b"BKLIGHT0").unwrap();
    assert!(matches!(
        Lightmap::load_layout(other.scene(), &desc, &place.0, &Progress::none()),
        Err(Error::Io(text)) if text.contains("is no layout of a light map")
    ));
}

/// With right checksums, too, no number leads out of a buffer: each file is refused, or a light map that can be read.
#[test]
fn damaged_layouts_are_refused_or_harmless() {
    damage("cornell", 20.0, 1000);
    damage("colonnade:100000", 0.5, 60);
}

fn damage(name: &str, texels_per_unit: f32, changes: u32) {
    let (scene, place) = (scene_of(name, None), Place::new());
    let desc = LightmapDesc { texels_per_unit, ..coarse() };
    Lightmap::create(&scene, &desc, &Progress::none()).unwrap().save_layout(&place.0, &Progress::none()).unwrap();
    let bytes = place.bytes();
    let load = |bytes: &[u8]| Lightmap::load_layout(&scene, &desc, &Place::of(bytes).0, &Progress::none());
    let places = changes as usize / 5;
    for i in 0..places {
        let mut flipped = bytes.clone();
        flipped[i * bytes.len() / places] ^= 1 << (i % 8);
        assert!(matches!(load(&flipped), Err(Error::Io(_))), "{i}");
        assert!(load(&bytes[..i * bytes.len() / places]).is_err());
    }
    let mut records = Records::new(&bytes[records::MAGIC.len()..], bytes.len() as u64);
    let mut all = Vec::new();
    while let Next::Record(tag, content) = records.next().unwrap() {
        all.push((tag, content));
    }
    let mut refusals = 0;
    for i in 0..changes {
        let random = |n: u32, below: usize| (crate::base::sampling::mix(4 * i + n) as usize) % below;
        let mut changed = all.clone();
        let (_, content) = &mut changed[random(0, all.len() - 1)];
        let at = random(1, content.len() / 4) * 4;
        let extremes = [0, 1, u32::MAX, f32::NAN.to_bits(), f32::MAX.to_bits(), 1 << random(3, 32)];
        content[at..at + 4].copy_from_slice(&extremes[random(2, extremes.len())].to_ne_bytes());
        let mut file = records::MAGIC.to_vec();
        changed.iter().for_each(|(tag, content)| records::append(&mut file, *tag, &[content]).unwrap());
        match load(&file) {
            Err(e) => {
                refusals += usize::from(matches!(e, Error::Io(_) | Error::InvalidArgument(_) | Error::OutOfMemory(_)))
            }
            Ok(lightmap) => (0..lightmap.info().page_count).for_each(|p| drop(lightmap.read(p, Layer::Position))),
        }
    }
    assert!(refusals > changes as usize / 2, "{refusals}");
}
