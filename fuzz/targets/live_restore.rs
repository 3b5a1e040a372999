//! Saved live states of a small room, damaged behind their head, with the checksum put right: whatever is accepted
//! shows light that is finite and not negative, and can be refined.
#![no_main]

use bakelite::Progress;
use bakelite::live::{Budget, Live, LiveCamera, LiveParams, PageRect};
use bakelite_fuzz::room::{self, PAGE};
use std::sync::{LazyLock, Mutex};

const HEAD: usize = 24;

/// A live object, and a state of it.
static ROOM: LazyLock<Mutex<(Live, Vec<u8>)>> = LazyLock::new(|| Mutex::new(room()));

fn room() -> (Live, Vec<u8>) {
    let lightmap = room::lightmap();
    let params = LiveParams { photon_count: 2000, max_rounds: 3, ..Default::default() };
    let mut live = Live::new(&lightmap, &params, &Progress::none()).unwrap();
    live.update(&camera(), &Budget { milliseconds: 0.0, rays: 20_000 }).unwrap();
    let path = std::env::temp_dir().join(format!("bakelite-fuzz-live-{}", std::process::id()));
    live.save(&path, &Progress::none()).unwrap();
    let state = std::fs::read(&path).unwrap();
    std::fs::remove_file(&path).unwrap();
    (live, state)
}

fn camera() -> LiveCamera {
    LiveCamera {
        position: [0.0, 0.0, 0.5].into(),
        forward: [0.0, 0.1, -1.0].into(),
        up: [0.0, 1.0, 0.0].into(),
        fov_y: 1.5,
        width: 32,
        height: 32,
    }
}

/// FNV-1a over all but the last eight bytes.
fn checksum(content: &[u8]) -> [u8; 8] {
    let hash = |h: u64, &b: &u8| (h ^ b as u64).wrapping_mul(0x0000_0100_0000_01b3);
    content.iter().fold(0xcbf2_9ce4_8422_2325, hash).to_le_bytes()
}

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let mut room = ROOM.lock().unwrap();
    let (live, state) = &mut *room;
    // The input lies over the true state: position, length, bytes, again and again.
    let mut content = state[..state.len() - 8].to_vec();
    let mut rest = bytes;
    while let Some(([low, high, length], more)) = rest.split_first_chunk() {
        let (new, more) = more.split_at(more.len().min(*length as usize % 32));
        let at = HEAD + u16::from_le_bytes([*low, *high]) as usize % (content.len() - HEAD);
        let end = content.len().min(at + new.len());
        content[at..end].copy_from_slice(&new[..end - at]);
        rest = more;
    }
    if bytes.len() % 7 == 6 {
        content.truncate(HEAD + bytes.len() % (content.len() - HEAD));
    }
    let sum = checksum(&content);
    content.extend(sum);
    if live.restore_bytes(&content, "input", &Progress::none()).is_ok() {
        let page = PageRect { page: 0, x: 0, y: 0, width: PAGE, height: PAGE };
        for lod in 0..live.params().lod_count {
            let light = live.read(&page, lod, true).unwrap();
            assert!(light.iter().flatten().all(|c| c.is_finite() && *c >= 0.0));
        }
        live.update(&camera(), &Budget { milliseconds: 0.0, rays: 500 }).unwrap();
        live.restore_bytes(state, "state", &Progress::none()).unwrap();
    }
});
