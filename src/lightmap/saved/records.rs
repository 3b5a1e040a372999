//! The container of results and checkpoints: a magic number, then records.
//!
//! ```text
//! bytes   record, little-endian
//! 0..4    tag
//! 4..12   length of the content
//! 12..16  CRC-32 of the content
//! 16..20  CRC-32 of bytes 0..16
//! 20..    content
//! ```
//!
//! A process that is killed while it appends leaves a file that ends within a record: a torn end. After a power
//! failure, a file system may have kept the new length of the file but not the last blocks of its content, which then
//! read as zeros: a torn end, too ([`ends_in_zeros`]). Any other change of a file is found by a checksum; changes of a
//! length are found by that of the header.

use super::{another_kind, damaged, unreadable};
use crate::base::error::{Error, Result};
use std::io::{self, ErrorKind, Read, Seek, SeekFrom};
use std::path::Path;

/// Maximum number of items, such as texels, that files keep in a record.
pub(super) const RUN: usize = 1 << 14;

/// Magic number at the start of every file; its last byte is the version of the format. Numbers are stored in the
/// machine's byte order, so files of machines with the other byte order have another magic number.
pub(super) const MAGIC: [u8; 8] = if cfg!(target_endian = "little") { *b"BKLIGHT1" } else { *b"1THGILKB" };

/// Number of bytes before the content of a record.
const HEADER: usize = 20;

/// Minimum size in bytes of the blocks in which file systems lose content.
const LEAST_BLOCK: u64 = 512;

pub(super) type Tag = [u8; 4];

/// Appends a record whose content is `parts`, one after the other. An error appends nothing.
pub(super) fn append(out: &mut Vec<u8>, tag: Tag, parts: &[&[u8]]) -> Result<()> {
    let mut sum = crc32fast::Hasher::new();
    parts.iter().for_each(|p| sum.update(p));
    let length: usize = parts.iter().map(|p| p.len()).sum();
    let start = out.len();
    let no_room = |_| Error::OutOfMemory(format!("a record needs {length} bytes"));
    out.try_reserve(HEADER + length).map_err(no_room)?;
    out.extend(tag);
    out.extend((length as u64).to_ne_bytes());
    out.extend(sum.finalize().to_ne_bytes());
    let header_sum = crc32fast::hash(&out[start..]);
    out.extend(header_sum.to_ne_bytes());
    parts.iter().for_each(|p| out.extend_from_slice(p));
    Ok(())
}

/// Result of reading the next record of a file.
#[derive(Debug, PartialEq)]
pub(super) enum Next {
    Record(Tag, Vec<u8>),
    /// The file ends after a record.
    End,
    /// The file ends within a record.
    Torn,
    /// The checksum of the header or of the content does not fit. The header or the content ends at this position.
    Damaged(u64),
}

/// Reads records one by one.
pub(super) struct Records<R> {
    from: R,
    /// Number of bytes of the file that are not read yet.
    left: u64,
    /// Number of bytes up to the end of the last whole record.
    pub whole: u64,
}

impl<R: Read> Records<R> {
    /// Makes a reader of a file of `size` bytes whose magic number has been read.
    pub fn new(from: R, size: u64) -> Records<R> {
        let whole = MAGIC.len() as u64;
        Records { from, left: size.saturating_sub(whole), whole }
    }

    pub fn next(&mut self) -> io::Result<Next> {
        if self.left == 0 {
            return Ok(Next::End);
        }
        if self.left < HEADER as u64 {
            return Ok(Next::Torn);
        }
        let mut header = [0; HEADER];
        self.from.read_exact(&mut header)?;
        self.left -= HEADER as u64;
        let number = |at: usize| u32::from_ne_bytes(std::array::from_fn(|i| header[at + i]));
        if crc32fast::hash(&header[..16]) != number(16) {
            return Ok(Next::Damaged(self.whole + HEADER as u64));
        }
        let length = u64::from_ne_bytes(std::array::from_fn(|i| header[4 + i]));
        if length > self.left {
            return Ok(Next::Torn);
        }
        let mut content = Vec::new();
        content.try_reserve_exact(length as usize).map_err(|_| io::Error::from(ErrorKind::OutOfMemory))?;
        self.from.by_ref().take(length).read_to_end(&mut content)?;
        self.left -= length;
        let end = self.whole + HEADER as u64 + length;
        if content.len() as u64 != length || crc32fast::hash(&content) != number(12) {
            return Ok(Next::Damaged(end));
        }
        self.whole = end;
        Ok(Next::Record(std::array::from_fn(|i| header[i]), content))
    }
}

/// Reads the magic number and the first record, which must be a `T` under `tag`: the beginning of a file of `size`
/// bytes. `kind` names such a file in messages.
pub(super) fn begin<T: bytemuck::Pod, R: Read>(
    mut from: R,
    size: u64,
    tag: Tag,
    path: &Path,
    kind: &str,
) -> Result<(Records<R>, T)> {
    let mut magic = [0; MAGIC.len()];
    if from.read_exact(&mut magic).is_err() || magic != MAGIC {
        return Err(another_kind(path, kind));
    }
    let mut records = Records::new(from, size);
    match records.next().map_err(|e| unreadable(path, e))? {
        Next::Record(found, content) if found == tag && content.len() == size_of::<T>() => {
            Ok((records, bytemuck::pod_read_unaligned(&content)))
        }
        Next::Record(..) => Err(another_kind(path, kind)),
        Next::End | Next::Torn | Next::Damaged(_) => Err(damaged(path)),
    }
}

/// Whether the damaged record from `start` to `end` may be the one whose own end was lost when power failed: its last
/// byte is zero, as is all that follows in the file of `size` bytes, at least a block.
pub(super) fn ends_in_zeros(file: &mut (impl Read + Seek), start: u64, end: u64, size: u64) -> io::Result<bool> {
    let last_block = size.saturating_sub(1) / LEAST_BLOCK * LEAST_BLOCK;
    file.seek(SeekFrom::Start(last_block.clamp(start, end - 1)))?;
    let mut piece = vec![0; 1 << 16];
    loop {
        match file.read(&mut piece)? {
            0 => return Ok(true),
            n if piece[..n].iter().any(|&b| b != 0) => return Ok(false),
            _ => {}
        }
    }
}

/// Takes numbers from the front of a record's content; `None` if there are fewer.
pub(super) fn take<T: bytemuck::Pod>(content: &mut &[u8], into: &mut [T]) -> Option<()> {
    let (first, rest) = content.split_at_checked(size_of_val(into))?;
    *content = rest;
    bytemuck::cast_slice_mut(into).copy_from_slice(first);
    Some(())
}

/// Takes one number.
pub(super) fn take_one<T: bytemuck::Pod>(content: &mut &[u8]) -> Option<T> {
    let mut one = [T::zeroed()];
    take(content, &mut one).map(|()| one[0])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn all(bytes: &[u8]) -> (Vec<Next>, u64) {
        let mut records = Records::new(bytes, (bytes.len() + MAGIC.len()) as u64);
        let mut found = Vec::new();
        loop {
            found.push(records.next().unwrap());
            if !matches!(found[found.len() - 1], Next::Record(..)) {
                return (found, records.whole - MAGIC.len() as u64);
            }
        }
    }

    fn two() -> (Vec<u8>, usize) {
        let mut out = Vec::new();
        append(&mut out, *b"ONE ", &[b"content", b" in parts"]).unwrap();
        let first = out.len();
        append(&mut out, *b"TWO ", &[]).unwrap();
        (out, first)
    }

    #[test]
    fn records_come_back() {
        let found = all(&two().0).0;
        let one = Next::Record(*b"ONE ", b"content in parts".to_vec());
        assert_eq!(found, [one, Next::Record(*b"TWO ", Vec::new()), Next::End]);
    }

    #[test]
    fn every_flipped_bit_is_damage_and_every_shorter_file_is_torn_or_whole() {
        let (bytes, first) = two();
        for bit in 0..bytes.len() * 8 {
            let mut flipped = bytes.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            assert!(matches!(all(&flipped).0.last().unwrap(), Next::Damaged(_)), "bit {bit}");
        }
        for length in 0..bytes.len() {
            let (found, whole) = all(&bytes[..length]);
            let end = if length == 0 || length == first { Next::End } else { Next::Torn };
            assert_eq!(*found.last().unwrap(), end, "{length} bytes");
            assert_eq!(whole as usize, if length >= first { first } else { 0 });
        }
    }
}
