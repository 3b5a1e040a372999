//! Damaged files of every kind that is read: a short run of what `fuzz/` does for hours, the same each time.
//!
//!     BAKELITE_DAMAGED_FILES=checkpoint,600,7 cargo test --release --all-features --test damaged_files -- --nocapture
//!
//! tries other inputs instead, of one kind, for so many seconds, from a seed of one's own, and counts them: without the
//! nightly toolchain that `fuzz/` needs.

#[path = "../../fuzz/src/damaged_files.rs"]
mod damaged_files;
#[path = "../../fuzz/src/live_state.rs"]
mod live_state;
#[path = "../../fuzz/src/records.rs"]
mod records;
#[path = "../../fuzz/src/room.rs"]
mod room;
#[path = "../../fuzz/src/saved.rs"]
mod saved;
#[path = "../../fuzz/src/scene_file.rs"]
mod scene_file;
#[path = "../../fuzz/src/seeds.rs"]
mod seeds;
#[path = "../../fuzz/src/shares.rs"]
mod shares;

use seeds::{TARGETS, seeds};
use std::time::{Duration, Instant};

/// Inputs per kind of file.
const INPUTS: usize = 500;

/// A small generator of random numbers (xorshift64*).
struct Random(u64);

impl Random {
    fn below(&mut self, n: usize) -> usize {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 33) as usize % n.max(1)
    }
}

/// Numbers that tend to be too much, too little or odd.
const NUMBERS: [&str; 10] =
    ["-1", "0", "1e9", "4294967295", "18446744073709551615", "1e39", "nan", "-0.5", "../a", "/dev/zero"];

/// One change: a byte, a bit, a number in text or binary, a piece cut out, doubled, or taken from another file.
fn damage(bytes: &mut Vec<u8>, other: &[u8], random: &mut Random) {
    let at = random.below(bytes.len());
    let piece = |random: &mut Random, length: usize| {
        let start = random.below(length);
        start..(start + 1 + random.below(16)).min(length)
    };
    match random.below(8) {
        0 if !bytes.is_empty() => bytes[at] = random.below(256) as u8,
        1 if !bytes.is_empty() => bytes[at] ^= 1 << random.below(8),
        2 => {
            let digits = |b: &[u8]| b.iter().take_while(|c| c.is_ascii_digit()).count();
            let end = at + digits(&bytes[at.min(bytes.len())..]);
            bytes.splice(at.min(bytes.len())..end.min(bytes.len()), NUMBERS[random.below(10)].bytes());
        }
        3 if bytes.len() >= 4 => {
            let at = random.below(bytes.len() - 3);
            let value = [0, 1, 0x7fff_ffff, 0x8000_0000, 0xffff_ffff, 0x00ff_ffff][random.below(6)];
            bytes[at..at + 4].copy_from_slice(&u32::to_le_bytes(value));
        }
        4 => {
            let cut = piece(random, bytes.len());
            bytes.drain(cut.start..cut.end.max(cut.start));
        }
        5 => bytes.truncate(at),
        6 if !other.is_empty() => {
            let part = piece(random, other.len());
            bytes.splice(at..at, other[part].iter().copied());
        }
        _ => {
            let part = bytes[piece(random, bytes.len())].to_vec();
            bytes.splice(at..at, part.repeat(1 + random.below(20)));
        }
    }
}

/// Reads damaged files of one kind while `more` says so of their number, which it returns.
fn read_damaged(target: &str, random: &mut Random, more: impl Fn(usize) -> bool) -> usize {
    let seeds = seeds();
    let own: Vec<&[u8]> = seeds.iter().filter(|(t, _)| *t == target).map(|(_, bytes)| &bytes[..]).collect();
    assert!(!own.is_empty(), "{target} has no seed");
    own.iter().for_each(|bytes| damaged_files::read(target, bytes));
    let mut inputs = 0;
    while more(inputs) {
        let mut bytes = own[random.below(own.len())].to_vec();
        let other = own[random.below(own.len())];
        for _ in 0..1 + random.below(5) {
            damage(&mut bytes, other, random);
        }
        damaged_files::read(target, &bytes);
        inputs += 1;
    }
    inputs
}

/// Files that hold light. They have a test of their own, so that two threads have work.
const OF_LIGHT: [&str; 4] = ["saved_result", "checkpoint", "live_restore", "share"];

#[test]
fn damaged_files_are_read_or_refused_and_nothing_else() {
    if let Ok(run) = std::env::var("BAKELITE_DAMAGED_FILES") {
        let [target, seconds, seed] = run.split(',').collect::<Vec<_>>().try_into().expect("KIND,SECONDS,SEED");
        let (start, time) = (Instant::now(), Duration::from_secs(seconds.parse().expect("seconds")));
        let mut random = Random(1 + seed.parse::<u64>().expect("a seed"));
        let inputs = read_damaged(target, &mut random, |_| start.elapsed() < time);
        println!("{target}: {inputs} files in {seconds} s, none of which broke anything");
        return;
    }
    assert!(OF_LIGHT.iter().all(|target| TARGETS.contains(target)));
    let mut random = Random(0x9e37_79b9_7f4a_7c15);
    for target in TARGETS.iter().filter(|target| !OF_LIGHT.contains(target)) {
        read_damaged(target, &mut random, |inputs| inputs < INPUTS);
    }
}

#[test]
fn damaged_light_is_read_or_refused_and_nothing_else() {
    if std::env::var("BAKELITE_DAMAGED_FILES").is_ok() {
        return;
    }
    let mut random = Random(0x2545_f491_4f6c_dd1d);
    for target in OF_LIGHT {
        read_damaged(target, &mut random, |inputs| inputs < INPUTS);
    }
}
