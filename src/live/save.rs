//! Saving and restoring what has been accumulated: rays per texel, and direct light.
//!
//! A file holds, in little-endian order: magic, fingerprint of what the state depends on, number of
//! blocks, the blocks, and a checksum. Light of earlier epochs is not saved.

use super::Live;
use super::blocks::{Block, BlockStatus, BlockWork, DirectTile};
use crate::error::{Error, Result, invalid_argument};
use crate::files;
use crate::lightmap::gather::{Gathered, ROUND};
use glam::Vec3;
use std::path::Path;

const MAGIC: [u8; 8] = *b"BKLIVE2\0";

/// FNV-1a, 64 bits.
struct Hash(u64);

impl Hash {
    fn new() -> Hash {
        Hash(0xcbf2_9ce4_8422_2325)
    }

    fn bytes(&mut self, bytes: &[u8]) {
        for &b in bytes {
            self.0 = (self.0 ^ b as u64).wrapping_mul(0x0000_0100_0000_01b3);
        }
    }
}

/// A block as saved.
struct Saved {
    block: Block,
    shown: u8,
    direct: Option<Box<[Vec3]>>,
}

impl Live {
    /// Writes the accumulated state to a file, which is replaced as a whole.
    pub fn save(&mut self, path: &Path) -> Result<()> {
        self.collect_now()?;
        let mut out = MAGIC.to_vec();
        out.extend(self.fingerprint().to_le_bytes());
        out.extend((self.blocks.len() as u64).to_le_bytes());
        for b in 0..self.blocks.len() as u32 {
            self.write_block(b, &mut out);
        }
        let mut sum = Hash::new();
        sum.bytes(&out);
        out.extend(sum.0.to_le_bytes());
        files::replace_with(path, &out)
    }

    /// Goes on from a state that was saved of the same scene, light map, lights and parameters. A file
    /// that is refused changes nothing.
    pub fn restore(&mut self, path: &Path) -> Result<()> {
        let bytes = files::read(path, u64::MAX - 1)?;
        let saved = self.parse(&bytes, path)?;
        self.collect_now()?;
        let direct = |s: &Saved| s.direct.as_ref().map_or(0, |d| size_of_val(&d[..]));
        self.reserve(saved.iter().map(|s| s.block.work.bytes() + direct(s)).sum())?;
        for (b, saved) in (0u32..).zip(saved) {
            if saved.block.work.gathered.is_empty() {
                // Nothing was known; what this object began with is more.
                continue;
            }
            let Some(old) = self.blocks.take(b) else { continue };
            let mut block = saved.block;
            block.status.coarse_epoch = old.status.coarse_epoch;
            block.status.direct_mean = old.status.direct_mean;
            block.status.indirect_epoch = self.context.light.indirect_epoch;
            self.held += block.work.bytes() as isize - old.work.bytes() as isize;
            if let Some(values) = saved.direct
                && block.status.changes_behind(&self.context) == 0
            {
                block.status.direct_epoch = self.context.light.direct_epoch;
                let tile = &self.context.map.tiles[b as usize];
                let rect = self.context.map.rect_in_light_map(tile.placement, &tile.rect);
                self.held += self.display.take_direct(&self.context.map, b, DirectTile { rect, values }).1;
            }
            block.note_error(self.context.map.top());
            self.display.lods[b as usize] = saved.shown;
            self.blocks.put(b, block);
        }
        self.show_all();
        Ok(())
    }

    /// Of all that the accumulated light depends on.
    fn fingerprint(&self) -> u64 {
        let mut h = Hash::new();
        let atlas = &self.context.map.atlas;
        let p = &self.params;
        for n in [
            atlas.map.len() as u64,
            atlas.gather.len() as u64,
            self.blocks.len() as u64,
            p.lod_count as u64,
            p.max_rounds as u64,
            p.seed,
            p.direct_samples as u64,
        ] {
            h.bytes(&n.to_le_bytes());
        }
        h.bytes(format!("{:?}", self.lights).as_bytes());
        for v in self.context.light.radiance.values.iter() {
            v.to_array().iter().for_each(|c| h.bytes(&c.to_bits().to_le_bytes()));
        }
        for tile in &self.context.map.tiles {
            tile.texels.iter().for_each(|t| h.bytes(&t.to_le_bytes()));
        }
        h.0
    }

    fn write_block(&self, b: u32, out: &mut Vec<u8>) {
        let fresh = BlockWork::default();
        let (mut status, mut block) = (*self.status(b), self.blocks.work(b).unwrap_or(&fresh));
        // What was gathered under an earlier light is left out.
        if status.has_old_light(&self.context) {
            (status, block) = (BlockStatus::default(), &fresh);
        }
        out.extend([status.fresh_lod, self.display.lods[b as usize].min(status.fresh_lod)]);
        for n in [status.rounds, block.cursor, block.gathered.len() as u16] {
            out.extend(n.to_le_bytes());
        }
        out.extend(block.deviations.to_le_bytes());
        out.extend(block.deviation_count.to_le_bytes());
        for g in &block.gathered {
            g.sum.to_array().iter().for_each(|c| out.extend(c.to_le_bytes()));
            out.extend(g.rays.to_le_bytes());
            out.extend(g.backs.to_le_bytes());
            out.extend(g.squares.to_le_bytes());
        }
        let tile = self.display.direct_tile(b).filter(|t| t.1).map(|t| t.0);
        out.extend(tile.map_or(0, |t| t.values.len() as u32).to_le_bytes());
        for v in tile.iter().flat_map(|t| t.values.iter()) {
            v.to_array().iter().for_each(|c| out.extend(c.to_le_bytes()));
        }
    }

    fn parse(&self, bytes: &[u8], path: &Path) -> Result<Vec<Saved>> {
        let bad = |what: &str| Error::Io(format!("{} {what}", path.display()));
        let Some((content, sum)) = bytes.split_last_chunk::<8>().filter(|(c, _)| c.starts_with(&MAGIC)) else {
            return Err(bad("is not a saved live state"));
        };
        let mut h = Hash::new();
        h.bytes(content);
        if h.0.to_le_bytes() != *sum {
            return Err(bad("is damaged: its checksum does not fit"));
        }
        let mut from = Reader { bytes: &content[MAGIC.len()..] };
        let damaged = || bad("is damaged");
        if from.u64().ok_or_else(damaged)? != self.fingerprint() {
            return invalid_argument!(
                "{} was saved of another scene or light map, under other lights or with other parameters",
                path.display()
            );
        }
        let count = from.u64().ok_or_else(damaged)?;
        if count != self.blocks.len() as u64 {
            return Err(damaged());
        }
        (0..count as u32).map(|b| self.read_block(b, &mut from).ok_or_else(damaged)).collect()
    }

    /// `None` if numbers are out of range.
    fn read_block(&self, b: u32, from: &mut Reader) -> Option<Saved> {
        let tile = &self.context.map.tiles[b as usize];
        let [lod, shown] = from.take()?;
        let (rounds, cursor, count) = (from.u16()?, from.u16()?, from.u16()? as usize);
        let (deviations, deviation_count) = (from.f32()?, from.u32()?);
        let top = self.context.map.top();
        if lod > top || shown > lod || rounds as u32 > self.params.max_rounds || count > tile.texels.len() {
            return None;
        }
        if cursor as usize > count || !(deviations >= 0.0) {
            return None;
        }
        let most = self.params.max_rounds * ROUND as u32;
        let gathered = |from: &mut Reader| {
            let g = Gathered { sum: from.vec3()?, rays: from.u32()?, backs: from.u32()?, squares: from.f32()? };
            (g.sum.is_finite()
                && g.squares >= 0.0
                && g.rays <= most
                && g.rays.is_multiple_of(ROUND as u32)
                && g.backs <= g.rays)
                .then_some(g)
        };
        let gathered = (0..count).map(|_| gathered(from)).collect::<Option<Vec<_>>>()?;
        let values = from.u32()? as usize;
        let rect = self.context.map.rect_in_light_map(tile.placement, &tile.rect);
        if values != 0 && values != rect.area() {
            return None;
        }
        let direct = (0..values).map(|_| from.vec3()).collect::<Option<Box<[Vec3]>>>()?;
        Some(Saved {
            block: Block {
                status: BlockStatus { lod, fresh_lod: lod, rounds, ..Default::default() },
                work: Box::new(BlockWork { cursor, gathered, deviations, deviation_count, ..Default::default() }),
            },
            shown,
            direct: (values > 0).then_some(direct),
        })
    }
}

/// Numbers from bytes; `None` at their end.
struct Reader<'a> {
    bytes: &'a [u8],
}

impl Reader<'_> {
    fn take<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (first, rest) = self.bytes.split_first_chunk()?;
        self.bytes = rest;
        Some(*first)
    }

    fn u16(&mut self) -> Option<u16> {
        self.take().map(u16::from_le_bytes)
    }

    fn u32(&mut self) -> Option<u32> {
        self.take().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Option<u64> {
        self.take().map(u64::from_le_bytes)
    }

    fn f32(&mut self) -> Option<f32> {
        self.take().map(f32::from_le_bytes)
    }

    fn vec3(&mut self) -> Option<Vec3> {
        Some(Vec3::new(self.f32()?, self.f32()?, self.f32()?))
    }
}
