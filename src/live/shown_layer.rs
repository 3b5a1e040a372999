//! A layer of the shown light: irradiance, or light by direction. Here is all that is done with values of gather texels
//! whatever they are: interpolated from those of a lower LOD, filled where a texel cannot be seen, blurred, and faded.

use super::blocks::{BLOCK_TEXELS, BlockMap, TILE};
use crate::base::directional::{Directional, Linear};
use crate::base::error::{Error, Result};
use crate::base::memory::{try_filled, try_to_vec, try_vec};
use crate::base::parallel::ParallelLoop;
use crate::lightmap::atlas::fill::mean_around;
use crate::lightmap::atlas::ids::{GatherTexel, PlacementId};
use crate::lightmap::indirect::blur::{Texels, Window};
use glam::Vec3;
use rayon::prelude::*;
use std::ops::{Add, Sub};

/// Distance in gather texels within which texels that cannot be seen are filled from those that can.
const FILLED: i32 = TILE;

/// Number of blocks whose texels get new values at a time.
const BLOCKS_AT_ONCE: usize = 256;

/// Light of a texel that can be shown.
pub(super) trait Shown: Linear + Add<Output = Self> + Sub<Output = Self> {
    /// Stands for a value that is not known.
    const UNKNOWN: Self;

    fn is_known(&self) -> bool;

    /// Returns the possible light nearest to a sum with differences of light.
    fn valid(self) -> Self;

    /// Returns what `old` light is after a change of its surroundings from `before` to `now`.
    fn follow(old: Self, before: Self, now: Self) -> Self;

    /// Returns the sum of the channels' magnitudes.
    fn size(&self) -> f32;
}

impl Shown for Vec3 {
    const UNKNOWN: Vec3 = Vec3::NAN;

    fn is_known(&self) -> bool {
        self.is_finite()
    }

    fn valid(self) -> Vec3 {
        self.max(Vec3::ZERO)
    }

    /// Adds the change of the surroundings; where the sum would be negative, scales by their relative change instead:
    /// nothing goes black because its surroundings lost more light than it had.
    fn follow(old: Vec3, before: Vec3, now: Vec3) -> Vec3 {
        let sum = old + (now - before);
        Vec3::select(sum.cmpge(Vec3::ZERO), sum, old * now / before.max(Vec3::splat(f32::MIN_POSITIVE)))
    }

    fn size(&self) -> f32 {
        self.abs().element_sum()
    }
}

impl Shown for Directional {
    const UNKNOWN: Directional = Directional { l0: Vec3::NAN, l1: [Vec3::NAN; 3] };

    fn is_known(&self) -> bool {
        self.l0.is_finite()
    }

    fn valid(self) -> Directional {
        self.valid()
    }

    fn follow(old: Directional, before: Directional, now: Directional) -> Directional {
        let l1 = (old + (now - before)).l1;
        Directional { l0: Vec3::follow(old.l0, before.l0, now.l0), l1 }.valid()
    }

    fn size(&self) -> f32 {
        self.l0.size()
    }
}

/// What is known of gather texels and blocks, whichever layers are shown of them.
pub(super) struct Surface {
    pub normals: Vec<Vec3>,
    /// Variances of the irradiance; infinite where it is interpolated.
    pub variances: Vec<f32>,
    /// Whether a gather texel can be seen, as far as is known so far.
    pub visible: Vec<bool>,
    /// Number of gather texels that cannot be seen, by block, and the number of blocks with such texels.
    unseen: Vec<u8>,
    blocks_with_unseen: u32,
    /// The LOD whose texels have current light, by block, at most that in use.
    pub fresh: Vec<u8>,
    /// Number of updates left of the fade, by block.
    pub fades: Vec<u8>,
    pub blur: i32,
}

impl Surface {
    pub fn new(normals: Vec<Vec3>, blocks: usize, blur: u32) -> Result<Surface> {
        let n = normals.len();
        Ok(Surface {
            normals,
            variances: try_filled(n, f32::INFINITY, "the gather map's variance")?,
            visible: try_filled(n, true, "the gather map's validity")?,
            unseen: try_vec(blocks, "hidden texels of blocks")?,
            blocks_with_unseen: 0,
            fresh: try_vec(blocks, "the LODs of blocks")?,
            fades: try_vec(blocks, "the fades of blocks")?,
            blur: blur as i32,
        })
    }

    pub fn try_clone(&self) -> Result<Surface> {
        Ok(Surface {
            normals: copy_of(&self.normals)?,
            variances: copy_of(&self.variances)?,
            visible: copy_of(&self.visible)?,
            unseen: copy_of(&self.unseen)?,
            fresh: copy_of(&self.fresh)?,
            fades: copy_of(&self.fades)?,
            ..*self
        })
    }

    pub fn bytes(&self) -> usize {
        self.normals.len() * (size_of::<Vec3>() + size_of::<f32>() + 1) + 3 * self.unseen.len()
    }

    pub fn note_visible(&mut self, b: u32, texel: GatherTexel, visible: bool) {
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

    /// Whether all texels can be seen.
    pub fn is_all_seen(&self) -> bool {
        self.blocks_with_unseen == 0
    }

    /// Whether some texel of a block cannot be seen.
    pub fn has_unseen(&self, b: u32) -> bool {
        self.unseen[b as usize] > 0
    }

    /// The texels of a block that cannot be seen.
    fn unseen_of<'a>(&'a self, map: &'a BlockMap, b: u32) -> impl Iterator<Item = GatherTexel> + 'a {
        let texels = if self.has_unseen(b) { &map.tiles[b as usize].texels[..] } else { &[] };
        texels.iter().copied().filter(|&s| !self.visible[s.index()])
    }

    /// Value of a texel that has no value of its own at LOD `lod`: bilinear between the corners of that LOD's grid that
    /// are `known`; else the mean of the block's own values by inverse square distance.
    fn interpolate<T: Shown>(
        &self,
        map: &BlockMap,
        b: u32,
        lod: u8,
        texel: GatherTexel,
        known: impl Fn(GatherTexel, i32, i32) -> bool,
        values: &[T],
    ) -> T {
        let (tile, gather) = (&map.tiles[b as usize], &map.atlas.gather);
        let (x, y) = gather.position(texel);
        let (ox, oy) = map.origin(tile.placement);
        let step = 1 << (map.top() - lod);
        let (x0, y0) = (x - (x - ox) % step, y - (y - oy) % step);
        let (fx, fy) = ((x - x0) as f32 / step as f32, (y - y0) as f32 / step as f32);
        let (mut sum, mut total) = (T::default(), 0.0);
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
                sum += values[s.index()] * w;
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
            sum += values[s.index()] * w;
            total += w;
        }
        if total > 0.0 { sum / total } else { T::default() }
    }
}

/// A new value of a texel.
type NewValue<T> = (GatherTexel, T);

/// Buffer for the new values of one block.
pub(super) struct Slot<'a, T> {
    room: &'a mut [NewValue<T>],
    used: usize,
}

impl<T> Slot<'_, T> {
    pub fn put(&mut self, texel: GatherTexel, value: T) {
        self.room[self.used] = (texel, value);
        self.used += 1;
    }
}

/// Number of texels of a block and those within the blur's radius of it.
pub(super) fn slot_size(blur: i32) -> usize {
    (TILE + 2 * blur).pow(2) as usize
}

/// Values of a layer, by gather texel; all empty if the layer is not asked for.
pub(super) struct ShownLayer<T> {
    /// Indirect light, not blurred.
    pub plain: Vec<T>,
    /// Indirect light as shown: blurred, and fading.
    pub shown: Vec<T>,
    /// Indirect light before the last change of light. The change at fresh texels is interpolated and added to it, which
    /// keeps its detail. Empty until light changes.
    pub old: Vec<T>,
    /// Direct light of the lowest LOD, interpolated: shown until a block has direct light at full resolution.
    pub coarse: Vec<T>,
    /// Value of `coarse` when a block's direct tile was made. The difference corrects tiles that were made under other
    /// lights, which keeps the shadows of the lights that did not change. Empty until a light changes.
    pub coarse_of_tile: Vec<T>,
    /// New values by block, in slots of equal size, allocated once, so that no update fails for lack of them. A slot that
    /// is not full ends with the texel [`NONE`](GatherTexel::NONE).
    values: Vec<NewValue<T>>,
}

impl<T: Shown> ShownLayer<T> {
    /// Creates a layer of `texels` in a number of blocks; of 0 if nobody asks for it.
    pub fn new(texels: usize, blocks: usize, blur: i32) -> Result<Self> {
        let room = if texels > 0 { blocks.min(BLOCKS_AT_ONCE) * slot_size(blur) } else { 0 };
        Ok(ShownLayer {
            plain: try_vec(texels, "live indirect light")?,
            shown: try_vec(texels, "shown indirect light")?,
            old: Vec::new(),
            coarse: try_vec(texels, "live direct light")?,
            coarse_of_tile: Vec::new(),
            values: try_vec(room, "changes of the shown light")?,
        })
    }

    pub fn try_clone(&self) -> Result<Self> {
        Ok(ShownLayer {
            plain: copy_of(&self.plain)?,
            shown: copy_of(&self.shown)?,
            old: copy_of(&self.old)?,
            coarse: copy_of(&self.coarse)?,
            coarse_of_tile: copy_of(&self.coarse_of_tile)?,
            values: try_vec(self.values.len(), "changes of the shown light")?,
        })
    }

    /// Whether nobody asks for the layer.
    pub fn is_empty(&self) -> bool {
        self.plain.is_empty()
    }

    pub fn bytes(&self) -> usize {
        let epochs = self.old.capacity() + self.coarse_of_tile.capacity();
        (3 * self.plain.len() + epochs) * size_of::<T>() + size_of_val(&self.values[..])
    }

    /// Bytes that [`make_room_for_epochs`](Self::make_room_for_epochs) will allocate.
    pub fn room_missing_for_epochs(&self) -> usize {
        let missing = |v: &Vec<T>| self.plain.len().saturating_sub(v.capacity()) * size_of::<T>();
        missing(&self.old) + missing(&self.coarse_of_tile)
    }

    /// Allocates the buffers of the next epochs of light, so that their beginning cannot fail, and touches their pages,
    /// so that it does not take an update long.
    pub fn make_room_for_epochs(&mut self) -> Result<()> {
        let texels = self.plain.len();
        for copy in [&mut self.old, &mut self.coarse_of_tile].into_iter().filter(|copy| copy.capacity() < texels) {
            let length = copy.len();
            copy.try_reserve_exact(texels - length)
                .map_err(|_| Error::OutOfMemory("light of before a change".into()))?;
            copy.resize(texels, T::default());
            copy.truncate(length);
        }
        Ok(())
    }

    /// Keeps the indirect light as that before a change.
    pub fn begin_indirect_epoch(&mut self) {
        self.old.clear();
        self.old.extend_from_slice(&self.plain);
    }

    /// Keeps the coarse direct light, unless it has been kept already, as that of the tiles that are now out of date.
    pub fn begin_direct_epoch(&mut self) {
        if self.coarse_of_tile.is_empty() {
            self.coarse_of_tile.extend_from_slice(&self.coarse);
        }
    }

    /// Calls `compute` in parallel to get new values of texels of each block, at most `slot` of them, and puts them
    /// into the values that `into` names. Reports to `note` by how much those of a block differ from the ones before,
    /// relative to the sum of both: 0 to 1. The next blocks are computed when the first 256 have their values, so these
    /// must not be what `compute` reads.
    pub fn renew(
        &mut self,
        blocks: &[u32],
        slot: usize,
        into: fn(&mut Self) -> &mut [T],
        compute: impl Fn(&Self, u32, &mut Slot<T>) + Sync,
        mut note: impl FnMut(u32, f32),
    ) {
        if self.is_empty() {
            return;
        }
        let mut values = std::mem::take(&mut self.values);
        for some in blocks.chunks(BLOCKS_AT_ONCE) {
            let layer = &*self;
            values.par_chunks_mut(slot).zip(some).each(|(room, &b)| {
                let mut slot = Slot { room, used: 0 };
                compute(layer, b, &mut slot);
                if let Some(end) = slot.room.get_mut(slot.used) {
                    end.0 = GatherTexel::NONE;
                }
            });
            let of = into(self);
            for (&b, room) in some.iter().zip(values.chunks(slot)) {
                let (mut change, mut sum) = (0.0, 0.0);
                for &(texel, value) in room.iter().take_while(|v| v.0 != GatherTexel::NONE) {
                    let old = std::mem::replace(&mut of[texel.index()], value);
                    change += (value - old).size();
                    sum += (value + old).size();
                }
                // Sums that overflow make 1 of it.
                note(b, if sum > 0.0 { (change / sum).min(1.0) } else { 0.0 });
            }
        }
        self.values = values;
    }

    /// Interpolates the indirect light of a block's texels above the LOD that has current light.
    pub fn interpolate_block(&self, on: &Surface, map: &BlockMap, b: u32, slot: &mut Slot<T>) {
        let (tile, lod) = (&map.tiles[b as usize], on.fresh[b as usize]);
        let known =
            |s: GatherTexel, x, y| map.lod_of[s.index()] <= on.fresh[map.block_at(tile.placement, x, y) as usize];
        let value = |s: GatherTexel| {
            let around = |of: &[T]| on.interpolate(map, b, lod, s, known, of);
            if self.old.is_empty() {
                return around(&self.plain);
            }
            T::follow(self.old[s.index()], around(&self.old), around(&self.plain))
        };
        tile.texels[tile.lod_end[lod as usize] as usize..].iter().for_each(|&s| slot.put(s, value(s)));
    }

    /// Interpolates the coarse direct light of a block's texels above the lowest LOD.
    pub fn interpolate_coarse(&self, on: &Surface, map: &BlockMap, b: u32, slot: &mut Slot<T>) {
        let tile = &map.tiles[b as usize];
        let lowest = |s: GatherTexel, _, _| map.lod_of[s.index()] == 0;
        let value = |s: GatherTexel| on.interpolate(map, b, 0, s, lowest, &self.coarse);
        tile.texels[tile.lod_end[0] as usize..].iter().for_each(|&s| slot.put(s, value(s)));
    }

    /// Blurred indirect light of a texel. `irradiance`: the plain irradiance, by which weights are chosen.
    pub fn blurred(
        &self,
        on: &Surface,
        map: &BlockMap,
        window: &mut Window,
        texel: GatherTexel,
        irradiance: &[Vec3],
    ) -> T {
        if on.blur == 0 || !on.visible[texel.index()] {
            return self.plain[texel.index()];
        }
        let texels = Texels { values: irradiance, variances: &on.variances, valid: &on.visible, normals: &on.normals };
        window.blur(&map.atlas.charts, &map.atlas.gather, texel, texels, &self.plain)
    }

    /// Blurs the texels of a block and of those around it that the blur reaches; blocks that fade reach their values by
    /// fading.
    pub fn blur_block(&self, on: &Surface, map: &BlockMap, b: u32, slot: &mut Slot<T>, irradiance: &[Vec3]) {
        let tile = &map.tiles[b as usize];
        let rect = tile.rect.grown(on.blur).clipped(&map.own_rect(tile.placement));
        let mut window = Window::new(on.blur);
        let is_still = |&(x, y): &(i32, i32)| on.fades[map.block_at(tile.placement, x, y) as usize] == 0;
        let texels = rect.texels().filter(is_still).filter_map(|(x, y)| map.atlas.gather.at(tile.placement, x, y));
        texels.for_each(|s| slot.put(s, self.blurred(on, map, &mut window, s, irradiance)));
    }

    /// Goes a step from what a block shows to its newest light.
    pub fn fade_block(&self, on: &Surface, map: &BlockMap, b: u32, slot: &mut Slot<T>, irradiance: &[Vec3]) {
        let mut window = Window::new(on.blur);
        let part = 1.0 / on.fades[b as usize] as f32;
        for &s in &map.tiles[b as usize].texels {
            let (shown, goal) = (self.shown[s.index()], self.blurred(on, map, &mut window, s, irradiance));
            // The last step must leave no rounding error.
            slot.put(s, if part == 1.0 { goal } else { shown + (goal - shown) * part });
        }
    }

    /// Fills a block's texels that cannot be seen with the mean of their neighbours, ring by ring from those that can.
    /// (A bake fills across whole charts: here work on a block must stay short.)
    pub fn fill_block(&self, on: &Surface, map: &BlockMap, b: u32, slot: &mut Slot<T>) {
        let tile = &map.tiles[b as usize];
        // Texels in ascending order, with the ring that filled them; 0: not filled yet.
        let mut room = [(GatherTexel::NONE, 0, T::default()); 9 * BLOCK_TEXELS];
        let mut count = 0;
        for s in map.neighbours(b).chain([b]).flat_map(|b| on.unseen_of(map, b)) {
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
                    if on.visible[t.index()] {
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
        for s in on.unseen_of(map, b) {
            let filled = missing.binary_search_by_key(&s, |m| m.0).ok().map(|i| missing[i]);
            if let Some((_, 1.., value)) = filled {
                slot.put(s, value);
            }
        }
    }

    /// Keeps the coarse direct light of a block as that of its tile.
    pub fn keep_coarse(&mut self, map: &BlockMap, b: u32) {
        if !self.coarse_of_tile.is_empty() {
            for &s in &map.tiles[b as usize].texels {
                self.coarse_of_tile[s.index()] = self.coarse[s.index()];
            }
        }
    }

    /// Change of the coarse direct light around a point since a tile was made. Texels of blocks that do not `count` do
    /// not contribute.
    pub fn change_of_direct(
        &self,
        map: &BlockMap,
        placement: PlacementId,
        local: [f32; 2],
        counts: impl Fn(usize) -> bool,
    ) -> T {
        let gather = &map.atlas.gather;
        let (mut sum, mut total) = (T::default(), 0.0);
        gather.bilinear(placement, local, |s, w| {
            let (x, y) = gather.position(s);
            if counts(map.block_at(placement, x, y) as usize) {
                sum += (self.coarse[s.index()] - self.coarse_of_tile[s.index()]) * w;
                total += w;
            }
        });
        if total > 0.0 { sum / total } else { T::default() }
    }
}

pub(super) fn copy_of<V: Clone>(of: &[V]) -> Result<Vec<V>> {
    try_to_vec(of, "a copy of shown light")
}
