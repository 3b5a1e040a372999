//! Saving and restoring of accumulated light: rays per texel, and direct light.
//!
//! A file holds, in little-endian order: magic, fingerprint of everything that the state depends on, number of blocks,
//! the blocks, and a checksum. Light of earlier epochs is not saved. The checksum detects accidental damage; in
//! addition every number is checked to be one that live updates could have reached.

use super::blocks::{Block, BlockStatus, BlockWork, Blocks, DirectTile, Tile};
use super::display::Display;
use super::work_on_direct::owns;
use super::{Live, in_parts};
use crate::base::directional::Directional;
use crate::base::error::{Error, Result, invalid_argument};
use crate::base::files;
use crate::base::memory::{try_vec, try_with_capacity};
use crate::base::progress::Progress;
use crate::lightmap::directional;
use crate::lightmap::indirect::gather::Gathered;
use crate::lightmap::indirect::sample_set::ROUND;
use crate::lightmap::saved::fingerprint::geometry;
use crate::scene::MOST_LIGHT;
use glam::Vec3;
use std::fmt::Write;
use std::io::Read;
use std::path::Path;

const MAGIC: [u8; 8] = *b"BKLIVE5\0";

/// Size in bytes of magic, fingerprint and number of blocks.
const HEAD: usize = 24;

/// Size in bytes of a block without its texels, of a gathered texel, and of light by direction.
const BLOCK_BYTES: usize = 18;
const TEXEL_BYTES: usize = 24;
const DIRECTIONAL_BYTES: usize = size_of::<Directional>();

/// Number of bytes that are read, hashed or written between two progress reports.
const PIECE: usize = 1 << 18;

/// FNV-1a hash of 64 bits.
struct Hash(u64);

impl Hash {
    fn new() -> Hash {
        Hash(0xcbf2_9ce4_8422_2325)
    }

    fn word(&mut self, word: u64) {
        self.0 = (self.0 ^ word).wrapping_mul(0x0000_0100_0000_01b3);
    }

    fn bytes(&mut self, bytes: &[u8]) {
        bytes.iter().for_each(|&b| self.word(b as u64));
    }
}

/// Hashes text as its bytes.
impl std::fmt::Write for Hash {
    fn write_str(&mut self, text: &str) -> std::fmt::Result {
        self.bytes(text.as_bytes());
        Ok(())
    }
}

/// A block as read from a file, or as another object has it.
#[derive(Default)]
pub(super) struct Saved {
    pub block: Block,
    pub shown: u8,
    pub direct: Option<DirectTile>,
    /// Whether its indirect light is that of before a change.
    pub is_old: bool,
}

/// Reason for which a part of a file is rejected.
enum Refusal {
    /// A number is not one that updates could have reached, or the file ends too early.
    Impossible(&'static str),
    Failed(Error),
}

impl From<Error> for Refusal {
    fn from(e: Error) -> Self {
        Refusal::Failed(e)
    }
}

type Field<T> = std::result::Result<T, Refusal>;

impl Live {
    /// Writes the accumulated state to a file, which is replaced as a whole. If that fails or is cancelled, an old file
    /// of that name is unchanged.
    pub fn save(&mut self, path: &Path, progress: &Progress) -> Result<()> {
        self.collect_now()?;
        let live = &*self;
        live.device().run(progress, || live.write(path, progress))?.finish()
    }

    fn write(&self, path: &Path, progress: &Progress) -> Result<files::Replacement> {
        let fingerprint = self.fingerprint(progress)?;
        let stage = progress.stage("save", 0.1, 1.0, self.blocks.len() as u64);
        files::prepare(path, |file| {
            let (mut sum, mut out) = (Hash::new(), try_with_capacity(2 * PIECE, SAVED)?);
            out.extend(MAGIC);
            out.extend(fingerprint.to_le_bytes());
            out.extend((self.blocks.len() as u64).to_le_bytes());
            for b in 0..self.blocks.len() as u32 {
                self.write_block(b, &mut out)?;
                if out.len() >= PIECE {
                    sum.bytes(&out);
                    file.append(&out, |_| progress.check())?;
                    out.clear();
                }
                stage.advance(1)?;
            }
            sum.bytes(&out);
            out.extend(sum.0.to_le_bytes());
            file.append(&out, |_| progress.check())
        })
    }

    /// Continues from a state that was saved of the same scene, light map, lights and parameters. A file that is
    /// rejected, and a call that fails or is cancelled, change nothing.
    pub fn restore(&mut self, path: &Path, progress: &Progress) -> Result<()> {
        let device = self.device();
        let bytes = device.run(progress, || self.read_file(path, progress))?;
        self.restore_bytes(&bytes, &path.display().to_string(), progress)
    }

    /// Restores as [`restore`](Self::restore) does, from the bytes of a file; errors call it `name`.
    pub fn restore_bytes(&mut self, bytes: &[u8], name: &str, progress: &Progress) -> Result<()> {
        self.collect_now()?;
        let device = self.device();
        let restored = device.run(progress, || {
            let saved = self.parse(bytes, name, progress)?;
            self.restored(saved, progress)
        });
        let result = restored.map(|(display, blocks)| self.go_on_from(display, blocks));
        self.settle();
        result
    }

    /// Makes display and blocks from the saved ones: the part of restoring that can fail.
    pub(super) fn restored(&mut self, saved: Vec<Saved>, progress: &Progress) -> Result<(Display, Blocks)> {
        let direct = |s: &Saved| s.direct.as_ref().map_or(0, DirectTile::bytes);
        let held: usize = saved.iter().map(|s| s.block.work.bytes() + direct(s)).sum();
        // Old and new state are held at the same time.
        self.reserve(held + self.display.bytes())?;
        let context = &self.context;
        let mut display = self.display.try_clone()?;
        if self.display.room_missing_for_epochs() == 0 {
            // New indirect light may be on its way.
            display.make_room_for_epochs()?;
        }
        display.end_fades();
        let mut blocks = Blocks::away(self.blocks.status())?;
        for (b, saved) in (0u32..).zip(saved) {
            if saved.block.work.gathered.is_empty() {
                // The file has no light of this block; the light that this object began with is more.
                continue;
            }
            let (old, mut block) = (self.blocks.status()[b as usize], saved.block);
            block.status.coarse_epoch = old.coarse_epoch;
            block.status.direct_mean = old.direct_mean;
            block.status.direct_epoch = old.direct_epoch;
            block.status.indirect_epoch = context.light.indirect_epoch - u32::from(saved.is_old);
            if let Some(tile) = saved.direct
                && block.status.changes_behind(context) == 0
            {
                block.status.direct_epoch = context.light.direct_epoch;
                display.take_direct(&context.map, b, tile);
            }
            block.note_error(context.map.top());
            display.lods[b as usize] = saved.shown;
            blocks.put(b, block);
        }
        let stage = progress.stage("show", 0.6, 1.0, blocks.len() as u64);
        for some in in_parts(blocks.len()) {
            display.refresh(&context.map, &blocks, &some, &mut |_| ());
            stage.advance(some.len() as u64)?;
        }
        Ok((display, blocks))
    }

    pub(super) fn go_on_from(&mut self, display: Display, blocks: Blocks) {
        self.display = display;
        self.blocks.replace_by(blocks);
        self.held = self.blocks.bytes() as isize + self.display.tile_bytes() as isize;
        // Blocks of which nothing was saved end their fades.
        while let Some(b) = self.fading.pop() {
            self.wait(b);
        }
        self.note_all_shown();
    }

    /// Fingerprint of everything that the accumulated light depends on.
    fn fingerprint(&self, progress: &Progress) -> Result<u64> {
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
            p.directional as u64,
            p.near_hits.to_bits().into(),
        ] {
            h.word(n);
        }
        h.word(u64::from(geometry(&atlas.scene)));
        write!(h, "{:?}", self.lights).map_err(|_| Error::Internal("lights have no text".into()))?;
        for values in self.context.light.radiance.values.chunks(PIECE) {
            values.iter().flat_map(|v| v.to_array()).for_each(|c| h.word(c.to_bits() as u64));
            progress.check()?;
        }
        for tiles in self.context.map.tiles.chunks(PIECE / 64) {
            tiles.iter().flat_map(|t| t.texels.iter()).for_each(|&t| h.word(t.index() as u64));
            progress.check()?;
        }
        Ok(h.0)
    }

    fn write_block(&self, b: u32, out: &mut Vec<u8>) -> Result<()> {
        let fresh = BlockWork::default();
        let Some(mut block) = self.blocks.work(b) else {
            return Err(Error::Internal(format!("block {b} is being worked on while it is saved")));
        };
        let mut status = self.blocks.status()[b as usize];
        // Light that was gathered in an earlier epoch is left out.
        if status.has_old_light(&self.context) {
            (status, block) = (BlockStatus::default(), &fresh);
        }
        let tile = self.display.direct_tile(b).filter(|t| t.1).map(|t| t.0);
        let texels = block.gathered.len() * TEXEL_BYTES + block.directional.len() * DIRECTIONAL_BYTES;
        let bytes = BLOCK_BYTES + texels + tile.map_or(0, |t| t.bytes());
        out.try_reserve(bytes).map_err(|_| Error::OutOfMemory(format!("{SAVED} needs {bytes} bytes for a block")))?;
        out.extend([status.fresh_lod, self.display.lods[b as usize].min(status.fresh_lod)]);
        for n in [status.rounds, block.gathered.len() as u16] {
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
        write_directional(&block.directional, out);
        out.extend(tile.map_or(0, |t| t.values.len() as u32).to_le_bytes());
        for v in tile.iter().flat_map(|t| t.values.iter()) {
            v.to_array().iter().for_each(|c| out.extend(c.to_le_bytes()));
        }
        write_directional(tile.map_or(&[], |t| &t.directional), out);
        Ok(())
    }

    /// Reads a file that, as far as its head shows, is a saved state of this object.
    fn read_file(&self, path: &Path, progress: &Progress) -> Result<Vec<u8>> {
        let name = path.display();
        let failed = |e: std::io::Error| Error::Io(format!("cannot read {name}: {e}"));
        let mut file = files::open(path).map_err(failed)?;
        let size = file.metadata().map_err(failed)?.len();
        let mut head = [0; HEAD];
        if size < HEAD as u64 {
            return Err(not_saved(&name.to_string()));
        }
        file.read_exact(&mut head).map_err(failed)?;
        self.check_head(&head, &name.to_string(), progress)?;
        let most = self.most_bytes();
        if size > most {
            return Err(Error::Io(format!("{name} is damaged: it has {size} bytes, {most} is the most")));
        }
        let mut bytes = try_vec::<u8>(size as usize, SAVED)?;
        bytes[..HEAD].copy_from_slice(&head);
        let stage = progress.stage("read", 0.1, 0.2, size);
        for piece in bytes[HEAD..].chunks_mut(PIECE) {
            file.read_exact(piece).map_err(failed)?;
            stage.advance(piece.len() as u64)?;
        }
        Ok(bytes)
    }

    /// Maximum size in bytes of a saved state of this object.
    fn most_bytes(&self) -> u64 {
        let map = &self.context.map;
        let direct = |t: &Tile| map.rect_in_light_map(t.placement, &t.rect).area() * self.params.direct_bytes();
        let texel = TEXEL_BYTES + if self.context.asks(directional::INDIRECT) { DIRECTIONAL_BYTES } else { 0 };
        let block = |t: &Tile| (BLOCK_BYTES + t.texels.len() * texel + direct(t)) as u64;
        (HEAD + size_of::<u64>()) as u64 + map.tiles.iter().map(block).sum::<u64>()
    }

    /// Whether magic, fingerprint and number of blocks are those of a state of this object.
    fn check_head(&self, head: &[u8; HEAD], name: &str, progress: &Progress) -> Result<()> {
        let mut from = Reader { bytes: head };
        let fields = (from.take::<8>(), from.u64(), from.u64());
        let (Ok(MAGIC), Ok(fingerprint), Ok(count)) = fields else { return Err(not_saved(name)) };
        if fingerprint != self.fingerprint(progress)? {
            return invalid_argument!(
                "{name} was saved of another scene or light map, under other lights or with other parameters"
            );
        }
        if count != self.blocks.len() as u64 {
            let blocks = self.blocks.len();
            return Err(Error::Io(format!("{name} is damaged: it has {count} blocks of texels, not {blocks}")));
        }
        Ok(())
    }

    fn parse(&self, bytes: &[u8], name: &str, progress: &Progress) -> Result<Vec<Saved>> {
        let Some((content, sum)) = bytes.split_last_chunk::<8>() else { return Err(not_saved(name)) };
        let Some((head, mut rest)) = content.split_first_chunk::<HEAD>() else { return Err(not_saved(name)) };
        self.check_head(head, name, progress)?;
        let stage = progress.stage("check", 0.2, 0.3, bytes.len() as u64);
        let mut h = Hash::new();
        for piece in content.chunks(PIECE) {
            h.bytes(piece);
            stage.advance(piece.len() as u64)?;
        }
        if h.0.to_le_bytes() != *sum {
            return Err(Error::Io(format!("{name} is damaged: its checksum does not fit")));
        }
        let stage = progress.stage("parse", 0.3, 0.6, self.blocks.len() as u64);
        let mut saved = try_with_capacity(self.blocks.len(), SAVED)?;
        let mut from = Reader { bytes: rest };
        for b in 0..self.blocks.len() as u32 {
            saved.push(self.read_block(b, &mut from).map_err(|e| match e {
                Refusal::Impossible(what) => Error::Io(format!("{name} is damaged: block {b} has {what}")),
                Refusal::Failed(e) => e,
            })?);
            stage.advance(1)?;
        }
        rest = from.bytes;
        if !rest.is_empty() {
            return Err(Error::Io(format!("{name} is damaged: {} bytes follow its last block", rest.len())));
        }
        Ok(saved)
    }

    fn read_block(&self, b: u32, from: &mut Reader) -> Field<Saved> {
        let tile = &self.context.map.tiles[b as usize];
        let [lod, shown] = from.take()?;
        let (rounds, count) = (from.u16()?, from.u16()? as usize);
        let (deviations, deviation_count) = (from.f32()?, from.u32()?);
        let most_rounds = self.params.max_rounds;
        check(lod <= self.context.map.top() && shown <= lod, "an impossible LOD")?;
        check(rounds as u32 <= most_rounds && (rounds > 0 || lod == 0), "an impossible number of rounds")?;
        check(count <= tile.texels.len(), "more texels than there are")?;
        // A LOD is complete, or no texel has been gathered yet.
        let complete = if rounds > 0 { tile.lod_end[lod as usize] as usize } else { 0 };
        check(count >= complete, "fewer texels than its LOD")?;
        check(deviations >= 0.0, "a deviation that is none")?;
        check(deviation_count <= count as u32 * most_rounds, "more deviations than rounds")?;
        let least = |i: usize| if i < complete { rounds as u32 * ROUND as u32 } else { 0 };
        let mut gathered = try_with_capacity(count, SAVED)?;
        for i in 0..count {
            gathered.push(from.gathered(least(i)..=most_rounds * ROUND as u32)?);
        }
        let count = if self.context.asks(directional::INDIRECT) { count } else { 0 };
        let mut by_direction = try_with_capacity(count, SAVED)?;
        for _ in 0..count {
            // A sum need not be possible light: what near hits subtract may be more than what others bring.
            let sum = from.directional()?;
            check(is_bounded(&sum), NO_LIGHT)?;
            by_direction.push(sum);
        }
        let direct = self.read_direct(tile, from)?;
        // The step under way begins again; texels that already have its rays are skipped.
        Ok(Saved {
            block: Block {
                status: BlockStatus { lod, fresh_lod: lod, rounds, ..Default::default() },
                work: BlockWork {
                    gathered,
                    directional: by_direction,
                    deviations,
                    deviation_count,
                    ..Default::default()
                },
            },
            shown,
            direct,
            is_old: false,
        })
    }

    /// Reads direct light at full resolution: light where the block has texels, NaN elsewhere.
    fn read_direct(&self, tile: &Tile, from: &mut Reader) -> Field<Option<DirectTile>> {
        let rect = self.context.map.rect_in_light_map(tile.placement, &tile.rect);
        let count = from.u32()? as usize;
        if count == 0 {
            return Ok(None);
        }
        check(count == rect.area(), "direct light of another size")?;
        let mut values = try_with_capacity(count, SAVED)?;
        for (x, y) in rect.texels() {
            let value = from.vec3()?;
            if owns(&self.context, tile, x, y).is_none() {
                check(value.is_nan_mask().all(), "direct light where it has no texel")?;
                values.push(Vec3::NAN);
                continue;
            }
            check(is_light(value), NO_LIGHT)?;
            values.push(value);
        }
        let count = if self.context.asks(directional::DIRECT) { count } else { 0 };
        let mut by_direction = try_with_capacity(count, SAVED)?;
        for value in &values[..count] {
            let light = from.directional()?;
            let is_light = is_bounded(&light) && light.l0.cmpge(Vec3::ZERO).all();
            let is_right = if value.is_nan() { !light.l0.is_finite() } else { is_light };
            check(is_right, NO_LIGHT)?;
            by_direction.push(light);
        }
        let (values, directional) = (values.into_boxed_slice(), by_direction.into_boxed_slice());
        Ok(Some(DirectTile { rect, values, directional }))
    }
}

/// Name of these buffers in error messages.
const SAVED: &str = "the saved state";

const NO_LIGHT: &str = "light that is negative, infinite or no number";

fn not_saved(name: &str) -> Error {
    Error::Io(format!("{name} is not a saved live state"))
}

fn is_light(v: Vec3) -> bool {
    v.cmpge(Vec3::ZERO).all() && v.cmple(Vec3::splat(MOST_LIGHT)).all()
}

fn is_bounded(light: &Directional) -> bool {
    let bounded = |v: &Vec3| v.abs().cmple(Vec3::splat(MOST_LIGHT)).all();
    bounded(&light.l0) && light.l1.iter().all(bounded)
}

fn write_directional(light: &[Directional], out: &mut Vec<u8>) {
    let vectors = light.iter().flat_map(|d| [d.l0, d.l1[0], d.l1[1], d.l1[2]]);
    vectors.flat_map(|v| v.to_array()).for_each(|c| out.extend(c.to_le_bytes()));
}

fn check(is_possible: bool, what: &'static str) -> Field<()> {
    if is_possible { Ok(()) } else { Err(Refusal::Impossible(what)) }
}

/// Reads numbers from bytes.
struct Reader<'a> {
    bytes: &'a [u8],
}

impl Reader<'_> {
    fn take<const N: usize>(&mut self) -> Field<[u8; N]> {
        let (first, rest) = self.bytes.split_first_chunk().ok_or(Refusal::Impossible("no end"))?;
        self.bytes = rest;
        Ok(*first)
    }

    fn u16(&mut self) -> Field<u16> {
        self.take().map(u16::from_le_bytes)
    }

    fn u32(&mut self) -> Field<u32> {
        self.take().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Field<u64> {
        self.take().map(u64::from_le_bytes)
    }

    fn f32(&mut self) -> Field<f32> {
        self.take().map(f32::from_le_bytes)
    }

    fn vec3(&mut self) -> Field<Vec3> {
        Ok(Vec3::new(self.f32()?, self.f32()?, self.f32()?))
    }

    fn directional(&mut self) -> Field<Directional> {
        Ok(Directional { l0: self.vec3()?, l1: [self.vec3()?, self.vec3()?, self.vec3()?] })
    }

    /// Reads the sums of a texel, whose number of rays must be in `rays`.
    fn gathered(&mut self, rays: std::ops::RangeInclusive<u32>) -> Field<Gathered> {
        let g = Gathered { sum: self.vec3()?, rays: self.u32()?, backs: self.u32()?, squares: self.f32()? };
        check(rays.contains(&g.rays) && g.rays.is_multiple_of(ROUND as u32), "an impossible number of rays")?;
        check(g.backs <= g.rays, "more rays at backs than rays")?;
        check(is_light(g.sum) && g.squares >= 0.0, NO_LIGHT)?;
        check(g.rays > 0 || (g.sum == Vec3::ZERO && g.squares == 0.0), "light without rays")?;
        Ok(g)
    }
}
