//! The shown light: indirect light of every gather texel, from its own rays or interpolated from those of a lower LOD,
//! filled where the texel cannot be seen, blurred; and its composition with direct light when a page is read. The sums
//! of the texels are not changed.
//!
//! The file is long because the shown light has one owner: indirect light, fades and direct light are written here alone.

use super::blocks::{BLOCK_TEXELS, BlockMap, Blocks, DirectTile, Rect, TILE};
use super::relight::{Illumination, Sides};
use super::{SHOWN_AT_ONCE, in_parts};
use crate::base::error::{Error, Result};
use crate::base::memory::{try_filled, try_to_vec, try_vec, try_with_capacity};
use crate::lightmap::atlas::fill::mean_around;
use crate::lightmap::atlas::ids::{GatherTexel, LightTexel, PerTexel, PlacementId};
use crate::lightmap::indirect::blur::{Texels, Window};
use glam::Vec3;
use rayon::prelude::*;
use std::sync::Arc;

/// Distance in gather texels within which texels that cannot be seen are filled from those that can.
const FILLED: i32 = TILE;

/// Number of updates in which a block whose cell was promoted fades from its shown to its newest light: cells are
/// large, and sudden changes would be visible.
const FADE: u8 = 6;

/// The shown light.
pub(super) struct Display {
    /// Indirect irradiance per gather texel, not blurred.
    plain: Vec<Vec3>,
    /// Indirect irradiance as shown: blurred, and fading.
    shown: Vec<Vec3>,
    /// Direct irradiance of the lowest LOD per gather texel, interpolated: shown until a block has direct light at full
    /// resolution.
    coarse: Vec<Vec3>,
    /// Value of `coarse` when a block's direct tile was made. The difference corrects tiles that were made under other
    /// lights, which keeps the shadows of the lights that did not change. Empty until a light changes.
    coarse_of_tile: Vec<Vec3>,
    normals: Vec<Vec3>,
    /// Variances of `plain`; infinite where it is interpolated.
    variances: Vec<f32>,
    /// Whether a gather texel can be seen, as far as is known so far.
    visible: Vec<bool>,
    /// Number of gather texels that cannot be seen, by block, and the number of blocks with such texels.
    unseen: Vec<u8>,
    blocks_with_unseen: u32,
    /// The LOD in use, by block: that of its work, or a lower one until the block's cell is promoted.
    pub lods: Vec<u8>,
    /// The LOD whose texels have current light, by block, at most that in use.
    fresh: Vec<u8>,
    /// Indirect irradiance before the last change of light. The change at fresh texels is interpolated and added to it,
    /// which keeps its detail. Empty until light changes.
    old: Vec<Vec3>,
    /// Direct light at full resolution, by block.
    tiles: Vec<Option<Arc<DirectTile>>>,
    /// Epoch of the lights, counted in changes, when the tile was made, and now.
    tile_epochs: Vec<u32>,
    epoch: u32,
    /// Number of updates left of the fade, by block.
    fades: Vec<u8>,
    blur: i32,
    scratch: Scratch,
}

/// A new value of a texel of the display.
type NewValue = (GatherTexel, Vec3);

/// Number of blocks whose texels get new values at a time.
const BLOCKS_AT_ONCE: usize = 256;

/// Buffers for the values that change at a time, allocated once, so that no update fails for lack of them.
#[derive(Default)]
struct Scratch {
    /// Blocks that interpolate, and blocks that are filled.
    all: Vec<u32>,
    to_fill: Vec<u32>,
    /// New values by block, in slots of equal size. A slot that is not full ends with the texel [`NONE`](GatherTexel::NONE).
    values: Vec<NewValue>,
}

impl Scratch {
    fn new(blocks: usize, blur: i32) -> Result<Scratch> {
        let what = "changes of the shown light";
        // Blocks and their neighbours; those that interpolate and those that are filled come together.
        let most = 2 * 9 * SHOWN_AT_ONCE;
        Ok(Scratch {
            all: try_with_capacity(most, what)?,
            to_fill: try_with_capacity(most, what)?,
            values: try_vec(blocks.min(BLOCKS_AT_ONCE) * slot(blur), what)?,
        })
    }

    fn bytes(&self) -> usize {
        (self.all.capacity() + self.to_fill.capacity()) * size_of::<u32>() + size_of_val(&self.values[..])
    }
}

/// Texels of a block and those within the blur's radius of it.
fn slot(blur: i32) -> usize {
    (TILE + 2 * blur).pow(2) as usize
}

/// Calls `compute` in parallel to put new values of texels of each block into its slot.
fn compute_values<B: Copy + Sync>(
    values: &mut [NewValue],
    slot: usize,
    blocks: &[B],
    compute: impl Fn(B, &mut Slot) + Sync,
) {
    values.par_chunks_mut(slot).zip(blocks).for_each(|(room, &b)| {
        let mut slot = Slot { room, used: 0 };
        compute(b, &mut slot);
        if let Some(end) = slot.room.get_mut(slot.used) {
            end.0 = GatherTexel::NONE;
        }
    });
}

/// The values that [`compute_values`] has computed, by block.
fn computed<'a>(
    values: &'a [NewValue],
    slot: usize,
    blocks: &'a [u32],
) -> impl Iterator<Item = (u32, impl Iterator<Item = NewValue> + 'a)> {
    let of_block =
        values.chunks(slot).map(|of_block| of_block.iter().copied().take_while(|v| v.0 != GatherTexel::NONE));
    blocks.iter().copied().zip(of_block)
}

/// Replaces values; returns by how much the new ones differ, relative to the sum of both: 0 to 1.
fn replace(of: &mut [Vec3], values: impl Iterator<Item = NewValue>) -> f32 {
    let (mut change, mut sum) = (0.0, 0.0);
    for (texel, value) in values {
        let old = std::mem::replace(&mut of[texel.index()], value);
        change += (value - old).abs().element_sum();
        sum += (value + old).element_sum();
    }
    // Sums that overflow make 1 of it.
    if sum > 0.0 { (change / sum).min(1.0) } else { 0.0 }
}

/// Buffer for the new values of one block.
struct Slot<'a> {
    room: &'a mut [NewValue],
    used: usize,
}

impl Slot<'_> {
    fn put(&mut self, texel: GatherTexel, value: Vec3) {
        self.room[self.used] = (texel, value);
        self.used += 1;
    }
}

/// A change of the shown light of a block: a rectangle of a page of the light map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Changed {
    pub page: u32,
    pub rect: Rect,
    pub block: u32,
    /// How much it has changed, 0 to 1.
    pub amount: f32,
}

impl Display {
    pub fn new(map: &BlockMap, blur: u32) -> Result<Display> {
        let atlas = &map.atlas;
        let n = atlas.gather.len();
        let mut normals = try_vec(n, "the gather map's normals")?;
        atlas.scene.device().install(|| {
            normals.par_iter_mut().enumerate().for_each(|(i, normal): (usize, &mut Vec3)| {
                *normal = atlas.receiver(&atlas.gather, &[], GatherTexel::new(i)).normal;
            });
        });
        let blur = blur as i32;
        Ok(Display {
            plain: try_vec(n, "live indirect light")?,
            shown: try_vec(n, "shown indirect light")?,
            coarse: try_vec(n, "live direct light")?,
            coarse_of_tile: Vec::new(),
            normals,
            variances: try_filled(n, f32::INFINITY, "the gather map's variance")?,
            visible: try_filled(n, true, "the gather map's validity")?,
            unseen: try_vec(map.tiles.len(), "hidden texels of blocks")?,
            blocks_with_unseen: 0,
            lods: try_vec(map.tiles.len(), "the LODs of blocks")?,
            fresh: try_vec(map.tiles.len(), "the LODs of blocks")?,
            old: Vec::new(),
            tiles: try_vec(map.tiles.len(), "the direct light of blocks")?,
            tile_epochs: try_vec(map.tiles.len(), "the epochs of blocks")?,
            epoch: 0,
            fades: try_vec(map.tiles.len(), "the fades of blocks")?,
            blur,
            scratch: Scratch::new(map.tiles.len(), blur)?,
        })
    }

    /// Copies the display; direct light at full resolution is shared.
    pub fn try_clone(&self) -> Result<Display> {
        Ok(Display {
            plain: copy_of(&self.plain)?,
            shown: copy_of(&self.shown)?,
            coarse: copy_of(&self.coarse)?,
            coarse_of_tile: copy_of(&self.coarse_of_tile)?,
            normals: copy_of(&self.normals)?,
            variances: copy_of(&self.variances)?,
            visible: copy_of(&self.visible)?,
            unseen: copy_of(&self.unseen)?,
            blocks_with_unseen: self.blocks_with_unseen,
            lods: copy_of(&self.lods)?,
            fresh: copy_of(&self.fresh)?,
            old: copy_of(&self.old)?,
            tiles: copy_of(&self.tiles)?,
            tile_epochs: copy_of(&self.tile_epochs)?,
            epoch: self.epoch,
            fades: copy_of(&self.fades)?,
            blur: self.blur,
            scratch: Scratch::new(self.lods.len(), self.blur)?,
        })
    }

    /// Bytes held by direct light at full resolution.
    pub fn tile_bytes(&self) -> usize {
        self.tiles.iter().flatten().map(|t| t.bytes()).sum()
    }

    /// Bytes that [`make_room_for_epochs`](Self::make_room_for_epochs) will allocate.
    pub fn room_missing_for_epochs(&self) -> usize {
        let missing = |v: &Vec<Vec3>| self.plain.len().saturating_sub(v.capacity()) * size_of::<Vec3>();
        missing(&self.old) + missing(&self.coarse_of_tile)
    }

    /// Allocates the buffers of the next epochs of light, so that their beginning cannot fail.
    pub fn make_room_for_epochs(&mut self) -> Result<()> {
        for copy in [&mut self.old, &mut self.coarse_of_tile] {
            copy.try_reserve_exact(self.plain.len() - copy.len())
                .map_err(|_| Error::OutOfMemory("light of before a change".into()))?;
        }
        Ok(())
    }

    /// Bytes held, without those of the tiles.
    pub fn bytes(&self) -> usize {
        let per_texel = 4 * size_of::<Vec3>() + size_of::<f32>() + 1;
        let per_block = size_of::<Option<Arc<DirectTile>>>() + size_of::<DirectTile>() + size_of::<u32>() + 4;
        self.plain.len() * per_texel
            + (self.coarse_of_tile.capacity() + self.old.capacity()) * size_of::<Vec3>()
            + self.lods.len() * per_block
            + self.scratch.bytes()
    }

    /// Shows the newest light of the `changed` blocks, at most [`SHOWN_AT_ONCE`]; reports to `note` where that changes
    /// the light map. A block that is away keeps its shown light until it is back.
    pub fn refresh(&mut self, map: &BlockMap, blocks: &Blocks, changed: &[u32], note: impl FnMut(Changed)) {
        for &b in changed {
            let Some(block) = blocks.work(b) else { continue };
            let tile = &map.tiles[b as usize];
            let fresh = blocks.status()[b as usize].fresh_lod.min(self.lods[b as usize]);
            self.fresh[b as usize] = fresh;
            for i in 0..tile.lod_end[fresh as usize] as usize {
                if let Some(value) = block.estimate(i) {
                    self.plain[tile.texels[i].index()] = value;
                    self.variances[tile.texels[i].index()] = block.variance(i);
                }
                self.note_visible(b, tile.texels[i], block.is_visible(i));
            }
        }
        self.spread(map, changed, note);
    }

    /// Interpolates, fills and blurs the texels that depend on those of the `changed` blocks; reports to `note` where
    /// that changes the light map.
    fn spread(&mut self, map: &BlockMap, changed: &[u32], mut note: impl FnMut(Changed)) {
        let mut scratch = std::mem::take(&mut self.scratch);
        let Scratch { all, to_fill, values } = &mut scratch;
        let top = map.top();
        // Neighbouring blocks that interpolate use texels of these blocks too.
        all.clear();
        all.extend_from_slice(changed);
        for &b in changed {
            all.extend(map.neighbours(b).filter(|&n| self.fresh[n as usize] < top));
        }
        all.sort_unstable();
        all.dedup();
        // No texel is both interpolated and a source of interpolation, so parts of all blocks may be processed one
        // after the other.
        for some in all.chunks(BLOCKS_AT_ONCE) {
            compute_values(values, BLOCK_TEXELS, some, |b, slot| self.interpolate_block(map, b, slot));
            for (texel, value) in computed(values, BLOCK_TEXELS, some).flat_map(|of_block| of_block.1) {
                self.plain[texel.index()] = value;
                self.variances[texel.index()] = f32::INFINITY;
            }
        }

        to_fill.clear();
        if self.blocks_with_unseen > 0 {
            to_fill.extend(changed.iter().flat_map(|&b| map.neighbours(b).chain([b])));
            to_fill.retain(|&b| self.unseen[b as usize] > 0);
            to_fill.sort_unstable();
            to_fill.dedup();
        }
        // Only texels that can be seen are read, and these are not filled.
        for some in to_fill.chunks(BLOCKS_AT_ONCE) {
            compute_values(values, BLOCK_TEXELS, some, |b, slot| self.fill(map, b, slot));
            for (texel, value) in computed(values, BLOCK_TEXELS, some).flat_map(|of_block| of_block.1) {
                self.plain[texel.index()] = value;
            }
        }

        all.extend_from_slice(to_fill);
        all.sort_unstable();
        all.dedup();
        let grown = |b: u32| {
            let tile = &map.tiles[b as usize];
            (tile.placement, tile.rect.grown(self.blur).clipped(&own_rect(map, tile.placement)))
        };
        let slot_size = slot(self.blur);
        for some in all.chunks(BLOCKS_AT_ONCE) {
            compute_values(values, slot_size, some, |b, slot| {
                let (placement, rect) = grown(b);
                let mut window = Window::new(self.blur);
                // Blocks that fade reach their values by fading.
                let is_still = |&(x, y): &(i32, i32)| self.fades[map.block_at(placement, x, y) as usize] == 0;
                let at = |(x, y)| map.atlas.gather.at(placement, x, y);
                let texels = rect.texels().filter(is_still).filter_map(at);
                texels.for_each(|s| slot.put(s, self.blurred(map, &mut window, s)));
            });
            for (block, values) in computed(values, slot_size, some) {
                let amount = replace(&mut self.shown, values);
                let (page, rect) = self.widest_rect(map, block);
                note(Changed { page, rect, block, amount });
            }
        }
        self.scratch = scratch;
    }

    /// Interpolates the indirect light of a block's texels above the LOD that has current light.
    fn interpolate_block(&self, map: &BlockMap, b: u32, slot: &mut Slot) {
        let (tile, lod) = (&map.tiles[b as usize], self.fresh[b as usize]);
        let known =
            |s: GatherTexel, x, y| map.lod_of[s.index()] <= self.fresh[map.block_at(tile.placement, x, y) as usize];
        let value = |s: GatherTexel| {
            if self.old.is_empty() {
                return self.interpolate(map, b, lod, s, known, |s| self.plain[s.index()]);
            }
            // Adds the change of the surroundings; where the sum would be negative, scales by their relative change
            // instead: nothing goes black because its surroundings lost more light than it had.
            let around = |of: &[Vec3]| self.interpolate(map, b, lod, s, known, |s| of[s.index()]);
            let (old, before, now) = (self.old[s.index()], around(&self.old), around(&self.plain));
            let sum = old + (now - before);
            Vec3::select(sum.cmpge(Vec3::ZERO), sum, old * now / before.max(Vec3::splat(f32::MIN_POSITIVE)))
        };
        tile.texels[tile.lod_end[lod as usize] as usize..].iter().for_each(|&s| slot.put(s, value(s)));
    }

    /// The display as it would be if no block were above a LOD.
    pub fn lowered(&self, map: &BlockMap, lod: u8) -> Result<Display> {
        let mut lower = self.try_clone()?;
        lower.lods.iter_mut().for_each(|l| *l = lod.min(*l));
        lower.fresh.iter_mut().for_each(|l| *l = lod.min(*l));
        lower.old = Vec::new();
        lower.fades.fill(0);
        let device = map.atlas.scene.device();
        device.install(|| in_parts(map.tiles.len()).for_each(|some| lower.spread(map, &some, |_| ())));
        Ok(lower)
    }

    /// Starts fading a block to its newest light in steps of [`fade`](Self::fade). Returns whether it was not fading
    /// already.
    pub fn begin_fade(&mut self, b: u32) -> bool {
        std::mem::replace(&mut self.fades[b as usize], FADE) == 0
    }

    /// Ends all fades: with the next refresh blocks show their newest light.
    pub fn end_fades(&mut self) {
        self.fades.fill(0);
    }

    /// Whether a block is still fading.
    pub fn is_fading(&self, b: u32) -> bool {
        self.fades[b as usize] > 0
    }

    /// Does one step of fading `blocks`; reports to `note` where that changes the light map.
    pub fn fade(&mut self, map: &BlockMap, blocks: &[u32], mut note: impl FnMut(Changed)) {
        let mut scratch = std::mem::take(&mut self.scratch);
        for some in blocks.chunks(BLOCKS_AT_ONCE) {
            compute_values(&mut scratch.values, BLOCK_TEXELS, some, |b, slot| self.fade_block(map, b, slot));
            for (b, values) in computed(&scratch.values, BLOCK_TEXELS, some) {
                let amount = replace(&mut self.shown, values);
                note(self.changed(map, b, amount));
            }
        }
        self.scratch = scratch;
        blocks.iter().for_each(|&b| self.fades[b as usize] -= 1);
    }

    fn fade_block(&self, map: &BlockMap, b: u32, slot: &mut Slot) {
        let mut window = Window::new(self.blur);
        let part = 1.0 / self.fades[b as usize] as f32;
        for &s in &map.tiles[b as usize].texels {
            let (shown, goal) = (self.shown[s.index()], self.blurred(map, &mut window, s));
            // The last step must leave no rounding error.
            slot.put(s, if part == 1.0 { goal } else { shown + (goal - shown) * part });
        }
    }

    fn blurred(&self, map: &BlockMap, window: &mut Window, texel: GatherTexel) -> Vec3 {
        if self.blur == 0 || !self.visible[texel.index()] {
            return self.plain[texel.index()];
        }
        let atlas = &map.atlas;
        let texels =
            Texels { values: &self.plain, variances: &self.variances, valid: &self.visible, normals: &self.normals };
        window.blur(&atlas.charts, &atlas.gather, texel, texels)
    }

    fn note_visible(&mut self, b: u32, texel: GatherTexel, visible: bool) {
        if self.visible[texel.index()] == visible {
            return;
        }
        self.visible[texel.index()] = visible;
        let unseen = &mut self.unseen[b as usize];
        if visible {
            *unseen -= 1;
            self.blocks_with_unseen -= u32::from(*unseen == 0);
        } else {
            self.blocks_with_unseen += u32::from(*unseen == 0);
            *unseen += 1;
        }
    }

    /// The texels of a block that cannot be seen.
    fn unseen_of<'a>(&'a self, map: &'a BlockMap, b: u32) -> impl Iterator<Item = GatherTexel> + 'a {
        let texels = if self.unseen[b as usize] > 0 { &map.tiles[b as usize].texels[..] } else { &[] };
        texels.iter().copied().filter(|&s| !self.visible[s.index()])
    }

    /// Value of a texel that has no value of its own at LOD `lod`: bilinear between the corners of that LOD's grid that
    /// are `known`; else the mean of the block's own values by inverse square distance.
    fn interpolate(
        &self,
        map: &BlockMap,
        b: u32,
        lod: u8,
        texel: GatherTexel,
        known: impl Fn(GatherTexel, i32, i32) -> bool,
        values: impl Fn(GatherTexel) -> Vec3,
    ) -> Vec3 {
        let (tile, gather) = (&map.tiles[b as usize], &map.atlas.gather);
        let (x, y) = gather.position(texel);
        let (ox, oy) = map.origin(tile.placement);
        let step = 1 << (map.top() - lod);
        let (x0, y0) = (x - (x - ox) % step, y - (y - oy) % step);
        let (fx, fy) = ((x - x0) as f32 / step as f32, (y - y0) as f32 / step as f32);
        let (mut sum, mut total) = (Vec3::ZERO, 0.0);
        for (cx, cy, w) in [
            (x0, y0, (1.0 - fx) * (1.0 - fy)),
            (x0 + step, y0, fx * (1.0 - fy)),
            (x0, y0 + step, (1.0 - fx) * fy),
            (x0 + step, y0 + step, fx * fy),
        ] {
            if w > 0.0
                && let Some(s) = gather.at(tile.placement, cx, cy)
                && self.visible[s.index()]
                && known(s, cx, cy)
            {
                sum += w * values(s);
                total += w;
            }
        }
        if total > 0.2 {
            return sum / total;
        }
        for &s in &tile.texels[..tile.lod_end[lod as usize] as usize] {
            let (sx, sy) = gather.position(s);
            let weight = if self.visible[s.index()] { 1.0 } else { 1e-3 };
            let w = weight / ((sx - x).pow(2) + (sy - y).pow(2)).max(1) as f32;
            sum += w * values(s);
            total += w;
        }
        if total > 0.0 { sum / total } else { Vec3::ZERO }
    }

    /// Keeps the indirect light as that before a change.
    pub fn begin_indirect_epoch(&mut self) {
        self.old.clear();
        self.old.extend_from_slice(&self.plain);
    }

    /// Begins an epoch in which tiles that were made under older lights are corrected by coarse light.
    pub fn begin_direct_epoch(&mut self) {
        if self.coarse_of_tile.is_empty() {
            self.coarse_of_tile.extend_from_slice(&self.coarse);
        }
        self.epoch += 1;
    }

    /// Marks a tile that was current before the last change as still current.
    pub fn keep_tile(&mut self, b: u32) {
        if self.tile_epochs[b as usize] + 1 == self.epoch {
            self.tile_epochs[b as usize] = self.epoch;
        }
    }

    /// Takes over the direct light of the lowest LOD's texels of `changed` blocks, at most [`SHOWN_AT_ONCE`], and
    /// interpolates it to the other texels; reports to `note` where that changes the light map.
    pub fn take_coarse(&mut self, map: &BlockMap, blocks: &mut Blocks, changed: &[u32], mut note: impl FnMut(Changed)) {
        let mut scratch = std::mem::take(&mut self.scratch);
        let Scratch { all, values, .. } = &mut scratch;
        for &b in changed {
            let values = blocks.work_mut(b).map(|w| std::mem::take(&mut w.new_coarse)).unwrap_or_default();
            for (&texel, value) in map.tiles[b as usize].texels.iter().zip(values) {
                self.coarse[texel.index()] = value;
            }
        }
        all.clear();
        all.extend(changed.iter().flat_map(|&b| map.neighbours(b).chain([b])));
        all.sort_unstable();
        all.dedup();
        for some in all.chunks(BLOCKS_AT_ONCE) {
            compute_values(values, BLOCK_TEXELS, some, |b, slot| self.interpolate_coarse(map, b, slot));
            for (b, values) in computed(values, BLOCK_TEXELS, some) {
                let amount = replace(&mut self.coarse, values);
                note(self.changed(map, b, amount));
                self.keep_correction(map, b);
            }
        }
        self.scratch = scratch;
    }

    /// A tile that is current is not corrected, nor when the next epoch begins: what has changed around it since is no
    /// change of light.
    fn keep_correction(&mut self, map: &BlockMap, b: u32) {
        let is_current = self.direct_tile(b).is_some_and(|(_, is_current)| is_current);
        if is_current && !self.coarse_of_tile.is_empty() {
            for &s in &map.tiles[b as usize].texels {
                self.coarse_of_tile[s.index()] = self.coarse[s.index()];
            }
        }
    }

    /// Interpolates the coarse direct light of a block's texels above the lowest LOD.
    fn interpolate_coarse(&self, map: &BlockMap, b: u32, slot: &mut Slot) {
        let tile = &map.tiles[b as usize];
        let lowest = |s: GatherTexel, _, _| map.lod_of[s.index()] == 0;
        let value = |s: GatherTexel| self.interpolate(map, b, 0, s, lowest, |s| self.coarse[s.index()]);
        tile.texels[tile.lod_end[0] as usize..].iter().for_each(|&s| slot.put(s, value(s)));
    }

    /// Takes over the direct light of a block at full resolution; returns the rectangle that changes, and by how many
    /// bytes the display has grown.
    pub fn take_direct(&mut self, map: &BlockMap, b: u32, tile: DirectTile) -> (Changed, isize) {
        self.tile_epochs[b as usize] = self.epoch;
        let grown = tile.bytes() as isize;
        let old = self.tiles[b as usize].replace(Arc::new(tile));
        self.keep_correction(map, b);
        // Shadows are the most visible of all changes.
        (self.changed(map, b, 1.0), grown - old.map_or(0, |t| t.bytes() as isize))
    }

    /// Direct light of a block at full resolution, and whether it was computed under the current lights.
    pub fn direct_tile(&self, b: u32) -> Option<(&DirectTile, bool)> {
        self.tiles[b as usize].as_deref().map(|t| (t, self.tile_epochs[b as usize] == self.epoch))
    }

    /// A change of the part of the light map that shows a block.
    fn changed(&self, map: &BlockMap, block: u32, amount: f32) -> Changed {
        let tile = &map.tiles[block as usize];
        let (page, rect) = in_light_map(map, tile.placement, &tile.rect.grown(1));
        Changed { page, rect, block, amount }
    }

    /// Puts the rectangle of a block's texels that gather for themselves, in the light map, into its place in `rects`: it
    /// is empty where there are none. These texels change at once when indirect light does.
    pub fn find_alone(map: &BlockMap, sides: &Sides, rects: &mut [Rect]) {
        rects.fill(Rect::default());
        let atlas = &map.atlas;
        for &texel in sides.upsampling.alone() {
            let placement = atlas.map.placement_of(&atlas.charts, texel);
            let at = atlas.gather.layout.texel_coord(placement, atlas.texel_local(placement, texel));
            let rect = &mut rects[map.block_at(placement, at[0] as i32, at[1] as i32) as usize];
            let (x, y) = atlas.map.position(texel);
            let own = Rect { x0: x, y0: y, x1: x + 1, y1: y + 1 };
            *rect = if rect.area() == 0 { own } else { rect.union(&own) };
        }
    }

    /// The page and the part of it that a change of a block's light may change: within the blur's radius, and one texel
    /// more, as a texel of the light map interpolates between four texels of the gather map.
    pub fn widest_rect(&self, map: &BlockMap, block: u32) -> (u32, Rect) {
        let tile = &map.tiles[block as usize];
        let rect = tile.rect.grown(self.blur).clipped(&own_rect(map, tile.placement));
        in_light_map(map, tile.placement, &rect.grown(1))
    }

    /// Fills a block's texels that cannot be seen with the mean of their neighbours, ring by ring from those that can.
    /// (A bake fills across whole charts: here work on a block must stay short.)
    fn fill(&self, map: &BlockMap, b: u32, slot: &mut Slot) {
        let tile = &map.tiles[b as usize];
        // Texels in ascending order, with the ring that filled them; 0: not filled yet.
        let mut room = [(GatherTexel::NONE, 0, Vec3::ZERO); 9 * BLOCK_TEXELS];
        let mut count = 0;
        for s in map.neighbours(b).chain([b]).flat_map(|b| self.unseen_of(map, b)) {
            room[count].0 = s;
            count += 1;
        }
        let missing = &mut room[..count];
        missing.sort_unstable_by_key(|m| m.0);
        for ring in 1..=FILLED {
            let mut is_empty = true;
            for i in 0..missing.len() {
                let (s, filled_by, _) = missing[i];
                if filled_by > 0 {
                    continue;
                }
                let value = |t: GatherTexel| {
                    if self.visible[t.index()] {
                        return Some(self.plain[t.index()]);
                    }
                    let known = missing.binary_search_by_key(&t, |m| m.0).ok().map(|i| missing[i]);
                    known.filter(|m| (1..ring).contains(&m.1)).map(|m| m.2)
                };
                if let Some(mean) = mean_around(&map.atlas.gather, tile.placement, s, value) {
                    missing[i] = (s, ring, mean);
                    is_empty = false;
                }
            }
            if is_empty {
                break;
            }
        }
        for s in self.unseen_of(map, b) {
            let filled = missing.binary_search_by_key(&s, |m| m.0).ok().map(|i| missing[i]);
            if let Some((_, 1.., value)) = filled {
                slot.put(s, value);
            }
        }
    }

    /// Irradiance shown at a texel of the light map; `with_direct` false: indirect light alone.
    pub fn irradiance(&self, map: &BlockMap, light: &Illumination, texel: LightTexel, with_direct: bool) -> Vec3 {
        let atlas = &map.atlas;
        let indirect = light.sides.upsampling.at(atlas, PerTexel::new(&self.shown), &light.own, texel);
        if !with_direct {
            return indirect;
        }
        let placement = atlas.map.placement_of(&atlas.charts, texel);
        let local = atlas.texel_local(placement, texel);
        // Coordinates are not negative, so truncation rounds down.
        let at = atlas.gather.layout.texel_coord(placement, local);
        let b = map.block_at(placement, at[0] as i32, at[1] as i32) as usize;
        let fine = self.tiles[b].as_ref().and_then(|tile| {
            let (x, y) = atlas.map.position(texel);
            let r = &tile.rect;
            let inside = x >= r.x0 && x < r.x1 && y >= r.y0 && y < r.y1;
            inside.then(|| tile.values[(y - r.y0) as usize * r.width() + (x - r.x0) as usize]).filter(|v| v.is_finite())
        });
        indirect
            + match fine {
                Some(fine) if self.tile_epochs[b] == self.epoch => fine,
                Some(old) => (old + self.change_of_direct(map, placement, local, b)).max(Vec3::ZERO),
                None => {
                    let mut coarse = Vec3::ZERO;
                    atlas.gather.bilinear(placement, local, |s, w| coarse += w * self.coarse[s.index()]);
                    coarse
                }
            }
    }

    /// Change of the coarse direct light around a point since the tile of its block was made. Neighbours whose tiles
    /// were made in other epochs do not contribute.
    fn change_of_direct(&self, map: &BlockMap, placement: PlacementId, local: [f32; 2], b: usize) -> Vec3 {
        let gather = &map.atlas.gather;
        let (mut sum, mut total) = (Vec3::ZERO, 0.0);
        gather.bilinear(placement, local, |s, w| {
            let (x, y) = gather.position(s);
            let of = map.block_at(placement, x, y) as usize;
            if of == b || (self.tiles[of].is_some() && self.tile_epochs[of] == self.tile_epochs[b]) {
                sum += w * (self.coarse[s.index()] - self.coarse_of_tile[s.index()]);
                total += w;
            }
        });
        if total > 0.0 { sum / total } else { Vec3::ZERO }
    }
}

fn copy_of<T: Clone>(of: &[T]) -> Result<Vec<T>> {
    try_to_vec(of, "a copy of shown light")
}

fn own_rect(map: &BlockMap, placement: PlacementId) -> Rect {
    Rect::of(&map.atlas.gather.layout[placement])
}

/// The rectangle of the light map that shows a rectangle of a placement's gather texels, the padding around it
/// included.
fn in_light_map(map: &BlockMap, placement: PlacementId, rect: &Rect) -> (u32, Rect) {
    let layout = &map.atlas.map.layout;
    let padding = map.atlas.padding as i32;
    let place = &layout[placement];
    // The padding of packed charts lies in their rectangles, that of given charts around them.
    let shown =
        if placement.index() < layout.given as usize { Rect::of(place).grown(padding) } else { Rect::of(place) };
    let size = layout.page_size as i32;
    let page = Rect { x0: 0, y0: 0, x1: size, y1: size };
    let rect = map.shown_in_light_map(placement, rect).grown(padding).clipped(&shown).clipped(&page);
    (place.page, rect)
}
