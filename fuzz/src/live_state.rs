//! Saved live states of a small room, damaged behind their head, with the checksum put right: whatever is accepted
//! shows light that is finite and not negative, and can be refined.

use crate::room::{self, PAGE};
use bakelite::Progress;
use bakelite::lightmap::Layer;
use bakelite::live::{Budget, Live, LiveCamera, LiveParams, PageRect};

/// Bytes that stay as they are: what kind of file it is, and of which scene.
const HEAD: usize = 24;

/// A live object, and a true state of it.
pub struct LiveState {
    live: Live,
    state: Vec<u8>,
}

impl LiveState {
    pub fn of_room() -> LiveState {
        let params = LiveParams { photon_count: 2000, max_rounds: 3, ..Default::default() };
        let mut live = Live::new(&room::lightmap(), &params, &Progress::none()).expect("a live object");
        live.update(&camera(), &Budget { milliseconds: 0.0, rays: 20_000, max_dirty_bytes: 0 }).expect("an update");
        let path = std::env::temp_dir().join(format!("bakelite-live-state-{}", std::process::id()));
        live.save(&path, &Progress::none()).expect("a state");
        let state = std::fs::read(&path).expect("a file");
        let _ = std::fs::remove_file(&path);
        LiveState { live, state }
    }

    /// Restores the true state with changes: of three bytes each (where, how many bytes) and the bytes that are put
    /// there. One of seven numbers of bytes of changes cuts the file off, too.
    pub fn restore(&mut self, changes: &[u8]) {
        let LiveState { live, state } = self;
        let mut content = state[..state.len() - 8].to_vec();
        let mut rest = changes;
        while let Some(([low, high, length], more)) = rest.split_first_chunk() {
            let (new, more) = more.split_at(more.len().min(*length as usize % 32));
            let at = HEAD + u16::from_le_bytes([*low, *high]) as usize % (content.len() - HEAD);
            let end = content.len().min(at + new.len());
            content[at..end].copy_from_slice(&new[..end - at]);
            rest = more;
        }
        if changes.len() % 7 == 6 {
            content.truncate(HEAD + changes.len() % (content.len() - HEAD));
        }
        let sum = checksum(&content);
        content.extend(sum);
        if live.restore_bytes(&content, "input", &Progress::none()).is_ok() {
            let page = PageRect { page: 0, x: 0, y: 0, width: PAGE, height: PAGE };
            for lod in 0..live.params().lod_count {
                let light = live.read(&page, lod, Layer::Combined).expect("light");
                assert!(light.iter().flatten().all(|c| c.is_finite() && *c >= 0.0));
            }
            live.update(&camera(), &Budget { milliseconds: 0.0, rays: 500, max_dirty_bytes: 0 }).expect("an update");
            live.restore_bytes(state, "state", &Progress::none()).expect("the true state");
        }
    }
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
