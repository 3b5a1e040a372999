//! Tests of shares: whatever their number, light has the bits of one bake; what is damaged, foreign or missing is refused
//! and changes nothing.

use super::*;
use crate::base::progress::Progress;
use crate::lightmap::saved::tests::{assert_same, bits, lamp, lightmap_with, with_records};
use crate::lightmap::{CheckpointParams, LightmapDesc};
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

/// A folder of its own, removed in the end.
struct Folder(PathBuf);

impl Folder {
    fn new() -> Folder {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let name = format!("bakelite-shares-{}-{}", std::process::id(), COUNT.fetch_add(1, Relaxed));
        let folder = std::env::temp_dir().join(name);
        std::fs::create_dir(&folder).unwrap();
        Folder(folder)
    }

    fn shares(&self, count: u32) -> ShareParams {
        ShareParams { prefix: self.0.join("a-"), count }
    }

    fn names(&self) -> Vec<String> {
        let name = |e: std::io::Result<std::fs::DirEntry>| e.unwrap().file_name().into_string().unwrap();
        let mut names: Vec<_> = std::fs::read_dir(&self.0).unwrap().map(name).collect();
        names.sort();
        names
    }

    fn file(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// A light map whose radiance map has several blocks of texels.
fn lightmap(threads: usize) -> Lightmap {
    let coarse = lightmap_with(threads, 20.0);
    let desc = LightmapDesc { texels_per_unit: 28.0, page_size: 256, radiance_divisor: 1, ..Default::default() };
    let map = Lightmap::create(coarse.scene(), &desc, &Progress::none()).unwrap();
    assert!(map.atlas.radiance.len() > 3 * 1024, "{}", map.atlas.radiance.len());
    map
}

fn params() -> BakeParams {
    BakeParams { photon_count: 10_000, gather_rays: 16, direct_samples: 2, seed: 3, ..Default::default() }
}

fn compute(
    map: &Lightmap,
    params: &BakeParams,
    shares: &ShareParams,
    stage: ShareStage,
    share: u32,
) -> Result<BakeStats> {
    map.bake_share(params, shares, stage, share, &Progress::none())
}

/// Computes all shares, the last ones first.
fn compute_all(map: &Lightmap, params: &BakeParams, shares: &ShareParams) {
    for stage in [ShareStage::Photons, ShareStage::Radiance] {
        for share in (0..shares.count).rev() {
            compute(map, params, shares, stage, share).unwrap();
        }
    }
}

fn bake(map: &mut Lightmap, params: &BakeParams, shares: Option<&ShareParams>) -> Result<BakeStats> {
    map.bake_with_shares(params, shares, None, &Progress::none())
}

#[test]
fn light_of_shares_has_the_bits_of_one_bake() {
    let (mut whole, mut map) = (lightmap(2), lightmap(1));
    let expected = bake(&mut whole, &params(), None).unwrap();
    let light = whole.light.as_ref().unwrap();
    assert!(!light.radiance.split.is_empty(), "no texel lies on both sides of a wall");
    for count in [1, 2, 3, 5, 40] {
        let folder = Folder::new();
        let shares = folder.shares(count);
        compute_all(if count % 2 == 0 { &whole } else { &map }, &params(), &shares);
        assert_eq!(folder.names().len() as u32, 2 * count);
        let stats = bake(&mut map, &params(), Some(&shares)).unwrap();
        assert_same(&map, &whole, &format!("{count} shares"));
        let photons = |s: &BakeStats| (s.photons_emitted, s.photons_stored);
        assert_eq!(photons(&stats), photons(&expected));
        assert_eq!(stats.photons.rays, 0);
    }
}

#[test]
fn each_pass_has_shares_of_its_own_and_a_checkpoint_keeps_what_was_read() {
    let params = BakeParams { passes: 2, ..params() };
    let (mut whole, mut map, folder) = (lightmap(2), lightmap(2), Folder::new());
    bake(&mut whole, &params, None).unwrap();
    let shares = folder.shares(2);
    compute_all(&map, &params, &shares);
    let photons = ["a-photons-0-of-2-pass-2.bkshare", "a-photons-0-of-2.bkshare"];
    assert_eq!((folder.names().len(), &folder.names()[..2]), (8, &photons.map(String::from)[..]));
    let checkpoint = CheckpointParams { path: folder.file("checkpoint"), seconds: 0.0 };
    map.bake_with_shares(&params, Some(&shares), Some(&checkpoint), &Progress::none()).unwrap();
    assert_same(&map, &whole, "two passes");
    // The shares are needed no more.
    folder
        .names()
        .iter()
        .filter(|n| n.ends_with("bkshare"))
        .for_each(|n| std::fs::remove_file(folder.file(n)).unwrap());
    map.bake_with_shares(&params, Some(&shares), Some(&checkpoint), &Progress::none()).unwrap();
    assert_same(&map, &whole, "from the checkpoint");
}

#[test]
fn what_the_plan_leaves_out_has_no_files() {
    let (mut map, mut whole) = (lightmap(2), lightmap(2));
    for (params, files) in [
        (BakeParams { gather_rays: 0, ..params() }, 0),
        (BakeParams { max_bounces: 1, ..params() }, 2),
        (BakeParams { photon_count: 0, ..params() }, 2),
    ] {
        let folder = Folder::new();
        compute_all(&map, &params, &folder.shares(2));
        assert_eq!(folder.names().len(), files, "{params:?}");
        bake(&mut map, &params, Some(&folder.shares(2))).unwrap();
        bake(&mut whole, &params, None).unwrap();
        assert_same(&map, &whole, "less work");
    }
}

#[test]
fn a_whole_file_is_kept_and_a_damaged_one_is_made_again() {
    let (map, folder) = (lightmap(2), Folder::new());
    let shares = folder.shares(2);
    let file = folder.file("a-photons-1-of-2.bkshare");
    let rays = || compute(&map, &params(), &shares, ShareStage::Photons, 1).unwrap().photons.rays;
    assert!(rays() > 0);
    let bytes = std::fs::read(&file).unwrap();
    assert_eq!(rays(), 0);
    for damage in [&bytes[..bytes.len() - 1], b"", b"something else", &[&bytes[..], b"!"].concat()] {
        std::fs::write(&file, damage).unwrap();
        assert!(rays() > 0);
        assert!(std::fs::read(&file).unwrap() == bytes);
    }
}

/// Fails with an error of one of these kinds that says so, and leaves the light that was there.
#[track_caller]
fn assert_refused(map: &mut Lightmap, params: &BakeParams, shares: &ShareParams, what: &str) {
    let before = bits(map);
    match bake(map, params, Some(shares)) {
        Err(Error::Io(s) | Error::InvalidArgument(s)) => assert!(s.contains(what), "{s}, not {what}"),
        other => panic!("{other:?}"),
    }
    assert!(bits(map) == before, "{what}: light has changed");
}

#[test]
fn damaged_shares_are_refused_and_change_nothing() {
    let (mut map, folder) = (lightmap(2), Folder::new());
    bake(&mut map, &BakeParams { seed: 8, ..params() }, None).unwrap();
    let shares = folder.shares(2);
    compute_all(&map, &params(), &shares);
    let file = folder.file("a-radiance-1-of-2.bkshare");
    let bytes = std::fs::read(&file).unwrap();
    for i in 0..24 {
        let mut flipped = bytes.clone();
        let at = (i * bytes.len() + bytes.len() / 2) / 24;
        flipped[at] ^= 1 << (i % 8);
        std::fs::write(&file, &flipped).unwrap();
        assert_refused(&mut map, &params(), &shares, "a-radiance-1-of-2");
        std::fs::write(&file, &bytes[..i * bytes.len() / 24]).unwrap();
        assert_refused(&mut map, &params(), &shares, "a-radiance-1-of-2");
    }
    std::fs::remove_file(&file).unwrap();
    assert_refused(&mut map, &params(), &shares, "cannot read");

    // Photons are read for the radiance map.
    let file = folder.file("a-photons-0-of-2.bkshare");
    let bytes = std::fs::read(&file).unwrap();
    for i in 0..40 {
        let mut damaged = bytes.clone();
        damaged[(i * bytes.len() + bytes.len() / 2) / 40] ^= 1 << (i % 8);
        damaged.truncate(if i % 2 == 0 { bytes.len() } else { i * bytes.len() / 40 });
        std::fs::write(&file, &damaged).unwrap();
        let refused = compute(&map, &params(), &shares, ShareStage::Radiance, 1);
        assert!(matches!(refused, Err(Error::Io(_) | Error::InvalidArgument(_))), "{refused:?}");
    }
    assert!(!folder.file("a-radiance-1-of-2.bkshare").exists());
    std::fs::write(&file, bytes).unwrap();
    compute(&map, &params(), &shares, ShareStage::Radiance, 1).unwrap();
    bake(&mut map, &params(), Some(&shares)).unwrap();
}

#[test]
fn numbers_that_no_share_has_are_refused_under_right_checksums() {
    let (mut map, folder) = (lightmap(2), Folder::new());
    bake(&mut map, &params(), None).unwrap();
    let shares = folder.shares(2);
    compute_all(&map, &params(), &shares);
    let put = |name: &str, tag: &[u8; 4], at: usize, value: f32| {
        let file = folder.file(name);
        let bytes = std::fs::read(&file).unwrap();
        let change = |t: &[u8; 4], content: &mut [u8]| {
            if t == tag {
                content[at..at + 4].copy_from_slice(&value.to_ne_bytes());
            }
        };
        std::fs::copy(with_records(&bytes, change).path(), &file).unwrap();
        (file, bytes)
    };
    for value in [-1.0, f32::NAN, f32::INFINITY, 3e38] {
        let (file, bytes) = put("a-radiance-0-of-2.bkshare", b"RADI", 12, value);
        assert_refused(&mut map, &params(), &shares, "is damaged");
        std::fs::write(file, bytes).unwrap();
    }
    std::fs::remove_file(folder.file("a-radiance-0-of-2.bkshare")).unwrap();
    // Positions, directions, power and normal of the second photon; numbers of photons in the head.
    for (tag, at, value) in [
        (b"PHOT", 48, f32::NAN),
        (b"PHOT", 60, f32::INFINITY),
        (b"PHOT", 72, -1.0),
        (b"PHOT", 76, f32::NAN),
        (b"PHOT", 92, f32::NAN),
        (b"SHAR", size_of::<Head>() - 8, 1.0),
        (b"SHAR", size_of::<Head>() - 20, 1.0),
    ] {
        let (file, bytes) = put("a-photons-1-of-2.bkshare", tag, at, value);
        let refused = compute(&map, &params(), &shares, ShareStage::Radiance, 0);
        assert!(matches!(refused, Err(Error::Io(_))), "{tag:?} {at}: {refused:?}");
        std::fs::write(file, bytes).unwrap();
    }
    compute(&map, &params(), &shares, ShareStage::Radiance, 0).unwrap();
}

#[test]
fn foreign_shares_are_refused_by_name() {
    let (mut map, folder) = (lightmap(2), Folder::new());
    bake(&mut map, &params(), None).unwrap();
    let shares = folder.shares(2);
    compute_all(&map, &params(), &shares);
    assert_refused(&mut map, &BakeParams { seed: 9, ..params() }, &shares, "seed (3, here 9)");
    assert_refused(&mut map, &BakeParams { photon_count: 9, ..params() }, &shares, "photon_count (10000, here 9)");
    let copy = |from: &str, to: &str| std::fs::copy(folder.file(from), folder.file(to)).unwrap();
    copy("a-radiance-0-of-2.bkshare", "a-radiance-0-of-3.bkshare");
    assert_refused(&mut map, &params(), &folder.shares(3), "the number of shares (2, here 3)");
    copy("a-radiance-0-of-2.bkshare", "a-radiance-1-of-2.bkshare");
    assert_refused(&mut map, &params(), &shares, "the share (0, here 1)");
    copy("a-photons-1-of-2.bkshare", "a-radiance-1-of-2.bkshare");
    assert_refused(&mut map, &params(), &shares, "the stage (0, here 1)");
    map.scene().set_light(1, lamp(0.6)).unwrap();
    assert_refused(&mut map, &params(), &shares, "the lights");
    // Other texels and another budget are the same bake.
    map.scene().set_light(1, lamp(0.5)).unwrap();
    compute(&map, &params(), &shares, ShareStage::Radiance, 1).unwrap();
    let some = BakeParams { texel_begin: 5, texel_end: 50, memory_budget: 1 << 40, ..params() };
    bake(&mut map, &some, Some(&shares)).unwrap();
}

#[test]
fn wrong_arguments_small_budgets_and_cancels_leave_no_file() {
    let (map, folder) = (lightmap(2), Folder::new());
    let refused = |params: &BakeParams, count: u32, share: u32, what: &str| match compute(
        &map,
        params,
        &folder.shares(count),
        ShareStage::Photons,
        share,
    ) {
        Err(Error::InvalidArgument(s) | Error::OutOfMemory(s)) => assert!(s.contains(what), "{s}"),
        other => panic!("{other:?}"),
    };
    refused(&params(), 0, 0, "share_count is 0");
    refused(&params(), MAX_SHARES + 1, 0, "share_count is 65537");
    refused(&params(), 2, 2, "share is 2, and there are 2");
    refused(&BakeParams { target_error: 0.1, ..params() }, 2, 0, "target_error");
    refused(&BakeParams { memory_budget: 100_000, ..params() }, 2, 0, "memory_budget");
    let nowhere = ShareParams { prefix: folder.file("none/"), count: 1 };
    assert!(matches!(compute(&map, &params(), &nowhere, ShareStage::Photons, 0), Err(Error::Io(_))));
    let missing = compute(&map, &params(), &folder.shares(2), ShareStage::Radiance, 0);
    assert!(matches!(missing, Err(Error::Io(_))), "{missing:?}");
    assert!(folder.names().is_empty(), "{:?}", folder.names());

    let shares = folder.shares(1);
    for stage in [ShareStage::Photons, ShareStage::Radiance] {
        for left in [0, 1, 2, 3] {
            let reports = AtomicU32::new(left);
            let progress = Progress::new(|_, _| reports.fetch_update(Relaxed, Relaxed, |n| n.checked_sub(1)).is_ok());
            let before = folder.names();
            let cancelled = map.bake_share(&params(), &shares, stage, 0, &progress);
            // Small as it is, it may have been done before there were so many reports.
            match cancelled {
                Err(Error::Cancelled) if reports.load(Relaxed) == 0 => {
                    assert!(folder.names().len() <= before.len() + 1)
                }
                Ok(_) => break,
                other => panic!("{other:?}"),
            }
            folder.names().iter().for_each(|n| assert!(n.ends_with("bkshare"), "{n}"));
        }
        compute(&map, &params(), &shares, stage, 0).unwrap();
    }
}
