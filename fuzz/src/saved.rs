//! Results and checkpoints of a small room, damaged record by record, with all checksums put right: whatever is
//! accepted shows light that is finite and not negative, and can be saved again.

use crate::room;
use bakelite::lightmap::{BakeParams, CheckpointParams, Layer, LayerData, Lightmap};
use bakelite::{Error, Progress};
use std::path::{Path, PathBuf};

/// Bytes before the first record, and before the content of each.
const MAGIC: usize = 8;
const HEADER: usize = 20;

const TAGS: [[u8; 4]; 9] = [*b"RSLT", *b"CKPT", *b"RADI", *b"RDNE", *b"BACK", *b"GATH", *b"DRCT", *b"TEXL", *b"DONE"];

/// Tag and content.
type Record = ([u8; 4], Vec<u8>);

/// A light map, and a true file of it.
pub struct Saved {
    lightmap: Lightmap,
    magic: [u8; MAGIC],
    records: Vec<Record>,
    /// Where the true file is.
    truth: PathBuf,
    /// Where damaged ones are put.
    input: PathBuf,
}

/// The files of one process, in memory where that can be.
fn place(name: &str) -> PathBuf {
    let shared_memory = Path::new("/dev/shm");
    let parent = if shared_memory.is_dir() { shared_memory.to_owned() } else { std::env::temp_dir() };
    parent.join(format!("bakelite-saved-{}-{name}", std::process::id()))
}

fn params() -> BakeParams {
    BakeParams { photon_count: 500, gather_rays: 4, direct_samples: 1, ..Default::default() }
}

fn checkpoint(path: &Path) -> CheckpointParams {
    CheckpointParams { path: path.to_owned(), seconds: 0.0 }
}

impl Saved {
    /// The result of a bake.
    pub fn result() -> Saved {
        let (mut lightmap, truth) = (room::lightmap(), place("result"));
        lightmap.bake(&params(), &Progress::none()).expect("a bake");
        lightmap.save_result(&truth, &Progress::none()).expect("a result");
        Saved::new(lightmap, truth, place("result-input"))
    }

    /// The checkpoint of a complete bake.
    pub fn checkpoint() -> Saved {
        let (mut lightmap, truth) = (room::lightmap(), place("checkpoint"));
        lightmap.bake_with(&params(), Some(&checkpoint(&truth)), &Progress::none()).expect("a bake");
        Saved::new(lightmap, truth, place("checkpoint-input"))
    }

    fn new(lightmap: Lightmap, truth: PathBuf, input: PathBuf) -> Saved {
        let file = std::fs::read(&truth).expect("a file");
        let (magic, mut rest) = file.split_first_chunk().expect("a magic number");
        let mut records = Vec::new();
        while let Some((header, behind)) = rest.split_first_chunk::<HEADER>() {
            let length = u64::from_ne_bytes(std::array::from_fn(|i| header[4 + i])) as usize;
            let (content, behind) = behind.split_at(length);
            records.push((std::array::from_fn(|i| header[i]), content.to_vec()));
            rest = behind;
        }
        Saved { lightmap, magic: *magic, records, truth, input }
    }

    /// Writes the true file with changes: of four bytes each (which record, what is done, where) and the bytes that
    /// this takes.
    fn write(&self, changes: &[u8]) {
        let mut records = self.records.clone();
        let mut rest = changes;
        while let Some(([which, what, low, high], more)) = rest.split_first_chunk() {
            rest = more;
            let (which, at) = (*which as usize % records.len(), u16::from_le_bytes([*low, *high]) as usize);
            let count = records.len();
            match what % 8 {
                0 if count > 1 => drop(records.remove(which)),
                1 if count < 100 => records.insert(at % count, records[which].clone()),
                _ => rest = change(&mut records[which], *what, at, rest),
            }
        }
        let mut file = self.magic.to_vec();
        for (tag, content) in records {
            let start = file.len();
            file.extend(tag);
            file.extend((content.len() as u64).to_ne_bytes());
            file.extend(crc32fast::hash(&content).to_ne_bytes());
            file.extend(crc32fast::hash(&file[start..]).to_ne_bytes());
            file.extend(content);
        }
        std::fs::write(&self.input, file).expect("a file");
    }

    /// Loads the damaged result over the true one.
    pub fn load(&mut self, changes: &[u8]) {
        self.write(changes);
        match self.lightmap.load_result(&self.input, &Progress::none()) {
            Ok(()) => {
                let light = check_light(&self.lightmap);
                self.lightmap.save_result(&self.input, &Progress::none()).expect("what was loaded can be saved");
                self.lightmap.load_result(&self.input, &Progress::none()).expect("what was saved can be loaded");
                assert!(check_light(&self.lightmap) == light, "what was saved comes back");
                self.lightmap.load_result(&self.truth, &Progress::none()).expect("the true result");
            }
            Err(e) => check_error(&e),
        }
    }

    /// Goes on from the damaged checkpoint.
    pub fn resume(&mut self, changes: &[u8]) {
        self.write(changes);
        match self.lightmap.bake_with(&params(), Some(&checkpoint(&self.input)), &Progress::none()) {
            Ok(_) => drop(check_light(&self.lightmap)),
            Err(e) => check_error(&e),
        }
    }
}

/// Changes one record; returns what is left of the `bytes` that this takes.
fn change<'a>((tag, content): &mut Record, what: u8, at: usize, bytes: &'a [u8]) -> &'a [u8] {
    match what % 8 {
        2 => content.truncate(at % (content.len() + 1)),
        3 => *tag = TAGS[at % TAGS.len()],
        4 => content.extend(std::iter::repeat_n(what, at % 100)),
        _ if !content.is_empty() => {
            let (new, rest) = bytes.split_at(bytes.len().min(what as usize / 8));
            let at = at % content.len();
            let end = content.len().min(at + new.len());
            content[at..end].copy_from_slice(&new[..end - at]);
            return rest;
        }
        _ => {}
    }
    bytes
}

impl Drop for Saved {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.truth);
        let _ = std::fs::remove_file(&self.input);
    }
}

/// The bits of all layers.
fn check_light(lightmap: &Lightmap) -> Vec<u32> {
    let mut bits = Vec::new();
    for layer in [Layer::Combined, Layer::Indirect, Layer::Direct, Layer::Radiance, Layer::Validity] {
        let values = match lightmap.read(0, layer).expect("a layer") {
            LayerData::Rgb(v) => v.into_flattened(),
            LayerData::Scalar(v) => v,
            LayerData::Integer(_) => Vec::new(),
        };
        assert!(values.iter().all(|c| c.is_finite() && *c >= 0.0), "{layer:?}");
        bits.extend(values.iter().map(|c| c.to_bits()));
    }
    bits
}

fn check_error(e: &Error) {
    use Error::*;
    assert!(matches!(e, Io(_) | InvalidArgument(_) | InvalidState(_) | OutOfMemory(_)), "{e}");
}
