//! What is shown: indirect light of every gather texel, from its own rays or interpolated from those
//! of a lower LOD, filled where it cannot be seen, blurred; and its composition with direct light
//! when a page is read. The sums of the texels are left alone.

use super::blocks::{BlockMap, Blocks, DirectTile, Rect, TILE};
use super::in_parts;
use super::relight::Illumination;
use crate::error::{Error, Result};
use crate::lightmap::indirect::blur::{Texels, Window};
use crate::memory::try_vec;
use crate::scene::NONE;
use glam::Vec3;
use rayon::prelude::*;
use std::collections::HashMap;
use std::sync::Arc;

/// Unseen texels are filled from those that are seen within this distance.
const FILLED: i32 = TILE;

/// Updates over which a block whose cell was promoted goes from what was shown to what is known: cells
/// are large, and would be seen to jump.
const FADE: u8 = 6;

/// What is shown.
pub(super) struct Display {
    /// Indirect irradiance per gather texel, not blurred.
    plain: Vec<Vec3>,
    /// What is shown of it.
    shown: Vec<Vec3>,
    /// Direct irradiance of the lowest LOD per gather texel, interpolated: shown until a block has
    /// more.
    coarse: Vec<Vec3>,
    /// What `coarse` was when a block's direct tile was made. The difference corrects tiles that were
    /// made under other lights, which keeps the shadows of the lights that did not change. Empty
    /// until a light changes.
    coarse_of_tile: Vec<Vec3>,
    normals: Vec<Vec3>,
    /// Of `plain`; infinite where it is interpolated.
    variances: Vec<f32>,
    /// Whether a gather texel can be seen, as far as is known.
    visible: Vec<bool>,
    /// Gather texels that cannot, by block.
    unseen: HashMap<u32, Vec<u32>>,
    /// The LOD in use, by block: that of the work, or less until the block's cell is promoted.
    pub lods: Vec<u8>,
    /// The LOD whose texels have light of now, by block, at most that in use.
    fresh: Vec<u8>,
    /// Indirect irradiance before the last change of light. What the fresh texels differ from it by is
    /// interpolated and added to it, which keeps its detail. Empty until light changes.
    old: Vec<Vec3>,
    /// Direct light at full resolution, by block.
    tiles: Vec<Option<Arc<DirectTile>>>,
    /// Changes of the lights before the tile was made, and so far.
    tile_epochs: Vec<u32>,
    epoch: u32,
    /// Updates left of the fade, by block.
    fades: Vec<u8>,
    blur: i32,
}

/// Where changes of the shown light lie in the light map: a rectangle of a page.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Changed {
    pub page: u32,
    pub rect: Rect,
}

impl Display {
    pub fn new(map: &BlockMap, blur: u32) -> Result<Display> {
        let atlas = &map.atlas;
        let n = atlas.gather.len();
        let mut normals = try_vec(n, "the gather map's normals")?;
        atlas.scene.device().install(|| {
            normals.par_iter_mut().enumerate().for_each(|(i, normal): (usize, &mut Vec3)| {
                *normal = atlas.receiver(&atlas.gather, &[], i).normal;
            });
        });
        let mut variances = try_vec(n, "the gather map's variance")?;
        variances.fill(f32::INFINITY);
        let mut visible = try_vec(n, "the gather map's validity")?;
        visible.fill(true);
        Ok(Display {
            plain: try_vec(n, "live indirect light")?,
            shown: try_vec(n, "shown indirect light")?,
            coarse: try_vec(n, "live direct light")?,
            coarse_of_tile: Vec::new(),
            normals,
            variances,
            visible,
            unseen: HashMap::new(),
            lods: try_vec(map.tiles.len(), "the LODs of blocks")?,
            fresh: try_vec(map.tiles.len(), "the LODs of blocks")?,
            old: Vec::new(),
            tiles: try_vec(map.tiles.len(), "the direct light of blocks")?,
            tile_epochs: try_vec(map.tiles.len(), "the epochs of blocks")?,
            epoch: 0,
            fades: try_vec(map.tiles.len(), "the fades of blocks")?,
            blur: blur as i32,
        })
    }

    /// A copy, which shares direct light at full resolution.
    pub fn try_clone(&self) -> Result<Display> {
        Ok(Display {
            plain: copy_of(&self.plain)?,
            shown: copy_of(&self.shown)?,
            coarse: copy_of(&self.coarse)?,
            coarse_of_tile: copy_of(&self.coarse_of_tile)?,
            normals: copy_of(&self.normals)?,
            variances: copy_of(&self.variances)?,
            visible: copy_of(&self.visible)?,
            unseen: self.unseen.clone(),
            lods: copy_of(&self.lods)?,
            fresh: copy_of(&self.fresh)?,
            old: copy_of(&self.old)?,
            tiles: copy_of(&self.tiles)?,
            tile_epochs: copy_of(&self.tile_epochs)?,
            epoch: self.epoch,
            fades: copy_of(&self.fades)?,
            blur: self.blur,
        })
    }

    /// Bytes of direct light at full resolution.
    pub fn tile_bytes(&self) -> usize {
        self.tiles.iter().flatten().map(|t| t.bytes()).sum()
    }

    /// Bytes that [`make_room_for_epochs`](Self::make_room_for_epochs) will allocate.
    pub fn room_missing_for_epochs(&self) -> usize {
        let missing = |v: &Vec<Vec3>| self.plain.len().saturating_sub(v.capacity()) * size_of::<Vec3>();
        missing(&self.old) + missing(&self.coarse_of_tile)
    }

    /// Makes room for what the next epochs of light keep, so that their beginning cannot fail.
    pub fn make_room_for_epochs(&mut self) -> Result<()> {
        for copy in [&mut self.old, &mut self.coarse_of_tile] {
            copy.try_reserve_exact(self.plain.len() - copy.len())
                .map_err(|_| Error::OutOfMemory("light of before a change".into()))?;
        }
        Ok(())
    }

    /// Bytes held, without the tiles.
    pub fn bytes(&self) -> usize {
        let per_texel = 4 * size_of::<Vec3>() + size_of::<f32>() + 1;
        let per_block = size_of::<Option<Arc<DirectTile>>>() + size_of::<DirectTile>() + size_of::<u32>() + 3;
        self.plain.len() * per_texel
            + (self.coarse_of_tile.capacity() + self.old.capacity()) * size_of::<Vec3>()
            + self.lods.len() * per_block
    }

    /// Shows what `changed` blocks know now; returns where that changes the light map. A block that is away keeps
    /// what it shows until it is back.
    pub fn refresh(&mut self, map: &BlockMap, blocks: &Blocks, changed: &[u32]) -> Vec<Changed> {
        for &b in changed {
            let Some(block) = blocks.work(b) else { continue };
            let tile = &map.tiles[b as usize];
            let fresh = blocks.status()[b as usize].fresh_lod.min(self.lods[b as usize]);
            self.fresh[b as usize] = fresh;
            for i in 0..tile.lod_end[fresh as usize] as usize {
                if let Some(value) = block.estimate(i) {
                    self.plain[tile.texels[i] as usize] = value;
                    self.variances[tile.texels[i] as usize] = block.variance(i);
                }
                self.note_visible(b, tile.texels[i], block.is_visible(i));
            }
        }
        self.spread(map, changed)
    }

    /// Interpolates, fills and blurs what depends on texels of the `changed` blocks; returns where that
    /// changes the light map.
    fn spread(&mut self, map: &BlockMap, changed: &[u32]) -> Vec<Changed> {
        let top = map.top();
        // Neighbours that interpolate do so between texels of these blocks too.
        let mut all = changed.to_vec();
        for &b in changed {
            all.extend(map.neighbours(b).filter(|&n| self.fresh[n as usize] < top));
        }
        all.sort_unstable();
        all.dedup();
        let interpolate = |&b: &u32| -> Vec<(u32, Vec3)> {
            let (tile, lod) = (&map.tiles[b as usize], self.fresh[b as usize]);
            let known =
                |s: u32, x, y| map.lod_of[s as usize] <= self.fresh[map.block_at(tile.placement, x, y) as usize];
            let value = |s: u32| {
                if self.old.is_empty() {
                    return self.interpolate(map, b, lod, s, known, |s| self.plain[s]);
                }
                // What is around has changed by so much; but where that is more than there was here, by such a
                // part: nothing goes black because its surroundings lost more than it had.
                let around = |of: &[Vec3]| self.interpolate(map, b, lod, s, known, |s| of[s]);
                let (old, before, now) = (self.old[s as usize], around(&self.old), around(&self.plain));
                let sum = old + (now - before);
                Vec3::select(sum.cmpge(Vec3::ZERO), sum, old * now / before.max(Vec3::splat(f32::MIN_POSITIVE)))
            };
            tile.texels[tile.lod_end[lod as usize] as usize..].iter().map(|&s| (s, value(s))).collect()
        };
        let interpolated: Vec<(u32, Vec3)> = all.par_iter().flat_map_iter(interpolate).collect();
        for (sample, value) in interpolated {
            self.plain[sample as usize] = value;
            self.variances[sample as usize] = f32::INFINITY;
        }

        let mut to_fill = Vec::new();
        if !self.unseen.is_empty() {
            to_fill.extend(changed.iter().flat_map(|&b| map.neighbours(b).chain([b])));
            to_fill.retain(|b| self.unseen.contains_key(b));
            to_fill.sort_unstable();
            to_fill.dedup();
        }
        let filled: Vec<(u32, Vec3)> = to_fill.par_iter().flat_map_iter(|&b| self.fill(map, b)).collect();
        for (sample, value) in filled {
            self.plain[sample as usize] = value;
        }

        let grown = |b: u32| {
            let tile = &map.tiles[b as usize];
            (tile.placement, tile.rect.grown(self.blur).clipped(&own_rect(map, tile.placement)))
        };
        all.extend(to_fill);
        all.sort_unstable();
        all.dedup();
        let touched: Vec<(u32, Rect)> = all.into_iter().map(grown).collect();
        let shown: Vec<(u32, Vec3)> = touched
            .par_iter()
            .flat_map_iter(|&(placement, rect)| {
                let mut window = Window::new(self.blur);
                // Blocks that fade get there by themselves.
                let is_still = |&(x, y): &(i32, i32)| self.fades[map.block_at(placement, x, y) as usize] == 0;
                let at = |(x, y)| map.atlas.gather.at(placement, x, y);
                let samples = rect.texels().filter(is_still).map(at).filter(|&s| s != NONE);
                samples.map(|s| (s, self.blurred(map, &mut window, s as usize))).collect::<Vec<_>>()
            })
            .collect();
        for (sample, value) in shown {
            self.shown[sample as usize] = value;
        }
        // A texel of the light map interpolates between four of the gather map.
        touched.iter().map(|(placement, rect)| in_light_map(map, *placement, &rect.grown(1))).collect()
    }

    /// What would be shown if no block were above a LOD.
    pub fn lowered(&self, map: &BlockMap, lod: u8) -> Result<Display> {
        let mut lower = self.try_clone()?;
        lower.lods.iter_mut().for_each(|l| *l = lod.min(*l));
        lower.fresh.iter_mut().for_each(|l| *l = lod.min(*l));
        lower.old = Vec::new();
        lower.fades.fill(0);
        map.atlas.scene.device().install(|| in_parts(map.tiles.len()).for_each(|some| drop(lower.spread(map, &some))));
        Ok(lower)
    }

    /// Has a block reach what is known in steps of [`fade`](Self::fade). Tells whether it did not already.
    pub fn begin_fade(&mut self, b: u32) -> bool {
        std::mem::replace(&mut self.fades[b as usize], FADE) == 0
    }

    /// Whatever fades is there with the next refresh.
    pub fn end_fades(&mut self) {
        self.fades.fill(0);
    }

    /// Whether a block is still to fade.
    pub fn is_fading(&self, b: u32) -> bool {
        self.fades[b as usize] > 0
    }

    /// One step of blocks that fade; returns where that changes the light map.
    pub fn fade(&mut self, map: &BlockMap, blocks: &[u32]) -> Vec<Changed> {
        let step = |&b: &u32| -> Vec<(u32, Vec3)> {
            let mut window = Window::new(self.blur);
            let part = 1.0 / self.fades[b as usize] as f32;
            let mut value = |s: u32| {
                let (shown, goal) = (self.shown[s as usize], self.blurred(map, &mut window, s as usize));
                // The last step must leave no rounding error.
                if part == 1.0 { goal } else { shown + (goal - shown) * part }
            };
            map.tiles[b as usize].texels.iter().map(|&s| (s, value(s))).collect()
        };
        let values: Vec<(u32, Vec3)> = blocks.par_iter().flat_map_iter(step).collect();
        for (sample, value) in values {
            self.shown[sample as usize] = value;
        }
        blocks.iter().for_each(|&b| self.fades[b as usize] -= 1);
        blocks.iter().map(|&b| self.block_rect(map, b)).collect()
    }

    fn blurred(&self, map: &BlockMap, window: &mut Window, sample: usize) -> Vec3 {
        if self.blur == 0 || !self.visible[sample] {
            return self.plain[sample];
        }
        let atlas = &map.atlas;
        let texels =
            Texels { values: &self.plain, variances: &self.variances, valid: &self.visible, normals: &self.normals };
        window.blur(&atlas.charts, &atlas.gather, sample, texels)
    }

    fn note_visible(&mut self, b: u32, sample: u32, visible: bool) {
        if self.visible[sample as usize] == visible {
            return;
        }
        self.visible[sample as usize] = visible;
        let list = self.unseen.entry(b).or_default();
        if visible {
            list.retain(|&s| s != sample);
            if list.is_empty() {
                self.unseen.remove(&b);
            }
        } else {
            list.push(sample);
        }
    }

    /// The value of a texel that has none of its own at LOD `lod`: bilinear between the corners of that
    /// LOD's grid that are `known`; else the mean of the block's own by inverse square distance.
    fn interpolate(
        &self,
        map: &BlockMap,
        b: u32,
        lod: u8,
        sample: u32,
        known: impl Fn(u32, i32, i32) -> bool,
        values: impl Fn(usize) -> Vec3,
    ) -> Vec3 {
        let (tile, gather) = (&map.tiles[b as usize], &map.atlas.gather);
        let (x, y) = gather.position(sample as usize);
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
            let s = gather.at(tile.placement, cx, cy);
            if w > 0.0 && s != NONE && self.visible[s as usize] && known(s, cx, cy) {
                sum += w * values(s as usize);
                total += w;
            }
        }
        if total > 0.2 {
            return sum / total;
        }
        for &s in &tile.texels[..tile.lod_end[lod as usize] as usize] {
            let (sx, sy) = gather.position(s as usize);
            let weight = if self.visible[s as usize] { 1.0 } else { 1e-3 };
            let w = weight / ((sx - x).pow(2) + (sy - y).pow(2)).max(1) as f32;
            sum += w * values(s as usize);
            total += w;
        }
        if total > 0.0 { sum / total } else { Vec3::ZERO }
    }

    /// Keeps what is shown as the light of before a change.
    pub fn begin_indirect_epoch(&mut self) {
        self.old.clear();
        self.old.extend_from_slice(&self.plain);
    }

    /// Has tiles that were made under other lights than those of now corrected by coarse light.
    pub fn begin_direct_epoch(&mut self) {
        if self.coarse_of_tile.is_empty() {
            self.coarse_of_tile.extend_from_slice(&self.coarse);
        }
        self.epoch += 1;
    }

    /// A tile that was current before the last change is so still.
    pub fn keep_tile(&mut self, b: u32) {
        if self.tile_epochs[b as usize] + 1 == self.epoch {
            self.tile_epochs[b as usize] = self.epoch;
        }
    }

    /// Takes over the direct light of the lowest LOD's texels of `changed` blocks, and interpolates it
    /// to the others; returns where that changes the light map.
    pub fn take_coarse(&mut self, map: &BlockMap, blocks: &mut Blocks, changed: &[u32]) -> Vec<Changed> {
        for &b in changed {
            let values = blocks.work_mut(b).map(|w| std::mem::take(&mut w.new_coarse)).unwrap_or_default();
            for (&sample, value) in map.tiles[b as usize].texels.iter().zip(values) {
                self.coarse[sample as usize] = value;
            }
        }
        let mut all: Vec<u32> = changed.iter().flat_map(|&b| map.neighbours(b).chain([b])).collect();
        all.sort_unstable();
        all.dedup();
        let others = |&b: &u32| -> Vec<(u32, Vec3)> {
            let tile = &map.tiles[b as usize];
            let lowest = |s: u32, _, _| map.lod_of[s as usize] == 0;
            let value = |s: u32| self.interpolate(map, b, 0, s, lowest, |s| self.coarse[s]);
            tile.texels[tile.lod_end[0] as usize..].iter().map(|&s| (s, value(s))).collect()
        };
        let others: Vec<(u32, Vec3)> = all.par_iter().flat_map_iter(others).collect();
        for (sample, value) in others {
            self.coarse[sample as usize] = value;
        }
        all.iter().map(|&b| self.block_rect(map, b)).collect()
    }

    /// Takes over the direct light of a block at full resolution; returns where that changes the light
    /// map, and by how many bytes the display has grown.
    pub fn take_direct(&mut self, map: &BlockMap, b: u32, tile: DirectTile) -> (Changed, isize) {
        if !self.coarse_of_tile.is_empty() {
            for &s in &map.tiles[b as usize].texels {
                self.coarse_of_tile[s as usize] = self.coarse[s as usize];
            }
        }
        self.tile_epochs[b as usize] = self.epoch;
        let grown = tile.bytes() as isize;
        let old = self.tiles[b as usize].replace(Arc::new(tile));
        (self.block_rect(map, b), grown - old.map_or(0, |t| t.bytes() as isize))
    }

    /// Direct light of a block at full resolution, and whether it is that of the lights of now.
    pub fn direct_tile(&self, b: u32) -> Option<(&DirectTile, bool)> {
        self.tiles[b as usize].as_deref().map(|t| (t, self.tile_epochs[b as usize] == self.epoch))
    }

    /// The part of the light map that shows a block.
    fn block_rect(&self, map: &BlockMap, b: u32) -> Changed {
        let tile = &map.tiles[b as usize];
        in_light_map(map, tile.placement, &tile.rect.grown(1))
    }

    /// The unseen texels of a block with the mean of their neighbours, ring by ring from those that are
    /// seen. (A bake fills across whole charts: here work on a block must stay short.)
    fn fill(&self, map: &BlockMap, b: u32) -> Vec<(u32, Vec3)> {
        let tile = &map.tiles[b as usize];
        let around = |b: u32| self.unseen.get(&b).into_iter().flatten().copied();
        let mut missing: Vec<u32> = map.neighbours(b).chain([b]).flat_map(around).collect();
        missing.sort_unstable();
        let mut filled: HashMap<u32, Vec3> = HashMap::new();
        for _ in 0..FILLED {
            let ring: Vec<(u32, Vec3)> = missing
                .iter()
                .filter_map(|&s| {
                    let (x, y) = map.atlas.gather.position(s as usize);
                    let (mut sum, mut n) = (Vec3::ZERO, 0.0);
                    for (nx, ny) in (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (x + dx, y + dy))) {
                        let t = map.atlas.gather.at(tile.placement, nx, ny);
                        if t == NONE {
                            continue;
                        }
                        let value = if self.visible[t as usize] {
                            Some(self.plain[t as usize])
                        } else {
                            filled.get(&t).copied()
                        };
                        if let Some(value) = value {
                            sum += value;
                            n += 1.0;
                        }
                    }
                    (n > 0.0).then(|| (s, sum / n))
                })
                .collect();
            if ring.is_empty() {
                break;
            }
            filled.extend(ring);
            missing.retain(|s| !filled.contains_key(s));
        }
        let own = self.unseen.get(&b).into_iter().flatten();
        own.filter_map(|s| filled.get(s).map(|&value| (*s, value))).collect()
    }

    /// Irradiance shown at a sample of the light map; `with_direct` false: indirect light alone.
    pub fn irradiance(&self, map: &BlockMap, light: &Illumination, sample: u32, with_direct: bool) -> Vec3 {
        let atlas = &map.atlas;
        let indirect = light.sides.upsampling.at(atlas, &self.shown, &light.own, sample as usize);
        if !with_direct {
            return indirect;
        }
        let placement = atlas.map.placement_of(&atlas.charts, sample as usize);
        let local = atlas.texel_local(placement, sample as usize);
        // Coordinates are not negative, so that truncation rounds down.
        let at = atlas.gather.layout.texel_coord(placement, local);
        let b = map.block_at(placement, at[0] as i32, at[1] as i32) as usize;
        let fine = self.tiles[b].as_ref().and_then(|tile| {
            let (x, y) = atlas.map.position(sample as usize);
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
                    atlas.gather.bilinear(placement, local, |s, w| coarse += w * self.coarse[s]);
                    coarse
                }
            }
    }

    /// What the coarse direct light around a point has changed by since the tile of its block was made.
    /// Neighbours whose tiles are of other times say nothing of that.
    fn change_of_direct(&self, map: &BlockMap, placement: u32, local: [f32; 2], b: usize) -> Vec3 {
        let gather = &map.atlas.gather;
        let (mut sum, mut total) = (Vec3::ZERO, 0.0);
        gather.bilinear(placement, local, |s, w| {
            let (x, y) = gather.position(s);
            let of = map.block_at(placement, x, y) as usize;
            if of == b || (self.tiles[of].is_some() && self.tile_epochs[of] == self.tile_epochs[b]) {
                sum += w * (self.coarse[s] - self.coarse_of_tile[s]);
                total += w;
            }
        });
        if total > 0.0 { sum / total } else { Vec3::ZERO }
    }
}

fn copy_of<T: Clone>(of: &[T]) -> Result<Vec<T>> {
    let mut copy = Vec::new();
    copy.try_reserve_exact(of.len())
        .map_err(|_| Error::OutOfMemory(format!("a copy of shown light needs {} bytes", size_of_val(of))))?;
    copy.extend_from_slice(of);
    Ok(copy)
}

fn own_rect(map: &BlockMap, placement: u32) -> Rect {
    Rect::of(&map.atlas.gather.layout.placements[placement as usize])
}

/// Where the light map shows a rectangle of a placement's gather texels, the padding that repeats it included.
fn in_light_map(map: &BlockMap, placement: u32, rect: &Rect) -> Changed {
    let layout = &map.atlas.map.layout;
    let padding = map.atlas.padding as i32;
    let place = &layout.placements[placement as usize];
    // The padding of packed charts lies in their rectangles, that of given charts around them.
    let shown = if placement < layout.given { Rect::of(place).grown(padding) } else { Rect::of(place) };
    let size = layout.page_size as i32;
    let page = Rect { x0: 0, y0: 0, x1: size, y1: size };
    let rect = map.shown_in_light_map(placement, rect).grown(padding).clipped(&shown).clipped(&page);
    Changed { page: place.page, rect }
}
