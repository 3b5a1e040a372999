//! The records of a saved file, changed one by one, with all checksums put right.

use std::path::{Path, PathBuf};

/// Bytes before the first record, and before the content of each.
const MAGIC: usize = 8;
const HEADER: usize = 20;

const TAGS: [[u8; 4]; 11] =
    [*b"RSLT", *b"CKPT", *b"RADI", *b"RDNE", *b"BACK", *b"GATH", *b"DRCT", *b"TEXL", *b"DONE", *b"SHAR", *b"PHOT"];

/// Tag and content.
type Record = ([u8; 4], Vec<u8>);

/// A true file.
pub struct Records {
    magic: [u8; MAGIC],
    records: Vec<Record>,
}

impl Records {
    /// Splits a true file into its records.
    pub fn read(path: &Path) -> Records {
        let file = std::fs::read(path).expect("a file");
        let (magic, mut rest) = file.split_first_chunk().expect("a magic number");
        let mut records = Vec::new();
        while let Some((header, behind)) = rest.split_first_chunk::<HEADER>() {
            let length = u64::from_ne_bytes(std::array::from_fn(|i| header[4 + i])) as usize;
            let (content, behind) = behind.split_at(length);
            records.push((std::array::from_fn(|i| header[i]), content.to_vec()));
            rest = behind;
        }
        Records { magic: *magic, records }
    }

    /// Writes the file with changes: of four bytes each (which record, what is done, where) and the bytes that this takes.
    pub fn write_changed(&self, changes: &[u8], path: &Path) {
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
        std::fs::write(path, file).expect("a file");
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

/// Returns where this process has a file, in memory where that can be.
pub fn place(name: &str) -> PathBuf {
    let shared_memory = Path::new("/dev/shm");
    let parent = if shared_memory.is_dir() { shared_memory.to_owned() } else { std::env::temp_dir() };
    parent.join(format!("bakelite-saved-{}-{name}", std::process::id()))
}
