//! The shown light: indirect light of every gather texel, from its own rays or interpolated from those of a lower LOD,
//! filled where the texel cannot be seen, blurred; and its composition with direct light when a page is read. The sums
//! of the texels are not changed. Irradiance and, if it is asked for, light by direction go through the same steps, with
//! the same weights ([`shown_layer`](super::shown_layer)).

use super::blocks::{BLOCK_TEXELS, BlockMap, Blocks, DirectTile, Rect};
use super::illumination::{Illumination, Sides};
use super::shown_layer::{Shown, ShownLayer, Surface, copy_of, slot_size};
use super::{SHOWN_AT_ONCE, in_parts};
use crate::base::directional::Directional;
use crate::base::error::Result;
use crate::base::memory::{try_vec, try_with_capacity};
use crate::base::parallel::ParallelLoop;
use crate::lightmap::atlas::ids::{GatherTexel, LightTexel, PerTexel, PlacementId};
use crate::lightmap::directional;
use glam::Vec3;
use rayon::prelude::*;
use std::sync::Arc;

/// Number of updates in which a block whose cell was promoted fades from its shown to its newest light: cells are
/// large, and sudden changes would be visible.
const FADE: u8 = 6;

/// The shown light.
pub(super) struct Display {
    irradiance: ShownLayer<Vec3>,
    /// Empty if nobody asks for light by direction.
    directional: ShownLayer<Directional>,
    on: Surface,
    /// The LOD in use, by block: that of its work, or a lower one until the block's cell is promoted.
    pub lods: Vec<u8>,
    /// Direct light at full resolution, by block.
    tiles: Vec<Option<Arc<DirectTile>>>,
    /// Epoch of the lights, counted in changes, when the tile was made, and now.
    tile_epochs: Vec<u32>,
    epoch: u32,
    scratch: Scratch,
}

/// Lists of blocks, allocated once, so that no update fails for lack of them.
#[derive(Default)]
struct Scratch {
    /// Blocks that interpolate, and blocks that are filled.
    all: Vec<u32>,
    to_fill: Vec<u32>,
}

impl Scratch {
    fn new() -> Result<Scratch> {
        let what = "changes of the shown light";
        // Blocks and their neighbours; those that interpolate and those that are filled come together.
        let most = 2 * 9 * SHOWN_AT_ONCE;
        Ok(Scratch { all: try_with_capacity(most, what)?, to_fill: try_with_capacity(most, what)? })
    }

    fn bytes(&self) -> usize {
        (self.all.capacity() + self.to_fill.capacity()) * size_of::<u32>()
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
    /// Creates the display. `by_direction`: whether light by direction is asked for.
    pub fn new(map: &BlockMap, blur: u32, by_direction: bool) -> Result<Display> {
        let atlas = &map.atlas;
        let (n, blocks) = (atlas.gather.len(), map.tiles.len());
        let normals = Display::normals(map)?;
        Ok(Display {
            irradiance: ShownLayer::new(n, blocks, blur as i32)?,
            directional: ShownLayer::new(if by_direction { n } else { 0 }, blocks, blur as i32)?,
            on: Surface::new(normals, blocks, blur)?,
            lods: try_vec(blocks, "the LODs of blocks")?,
            tiles: try_vec(blocks, "the direct light of blocks")?,
            tile_epochs: try_vec(blocks, "the epochs of blocks")?,
            epoch: 0,
            scratch: Scratch::new()?,
        })
    }

    /// The normals of the gather map's texels.
    pub fn normals(map: &BlockMap) -> Result<Vec<Vec3>> {
        let atlas = &map.atlas;
        let mut normals = try_vec(atlas.gather.len(), "the gather map's normals")?;
        atlas.scene.device().install(|| {
            normals.par_iter_mut().enumerate().each(|(i, normal): (usize, &mut Vec3)| {
                *normal = atlas.receiver(&atlas.gather, &[], GatherTexel::new(i)).normal;
            });
        });
        Ok(normals)
    }

    /// Takes over the normals of a scene that has moved, with which light is blurred from now on.
    pub fn set_normals(&mut self, normals: Vec<Vec3>) {
        self.on.normals = normals;
    }

    /// Copies the display; direct light at full resolution is shared.
    pub fn try_clone(&self) -> Result<Display> {
        Ok(Display {
            irradiance: self.irradiance.try_clone()?,
            directional: self.directional.try_clone()?,
            on: self.on.try_clone()?,
            lods: copy_of(&self.lods)?,
            tiles: copy_of(&self.tiles)?,
            tile_epochs: copy_of(&self.tile_epochs)?,
            epoch: self.epoch,
            scratch: Scratch::new()?,
        })
    }

    /// Whether light by direction is asked for.
    pub fn has_directional(&self) -> bool {
        !self.directional.is_empty()
    }

    /// Bytes held by direct light at full resolution.
    pub fn tile_bytes(&self) -> usize {
        self.tiles.iter().flatten().map(|t| t.bytes()).sum()
    }

    /// Bytes that [`make_room_for_epochs`](Self::make_room_for_epochs) will allocate.
    pub fn room_missing_for_epochs(&self) -> usize {
        self.irradiance.room_missing_for_epochs() + self.directional.room_missing_for_epochs()
    }

    /// Allocates the buffers of the next epochs of light, so that their beginning cannot fail.
    pub fn make_room_for_epochs(&mut self) -> Result<()> {
        self.irradiance.make_room_for_epochs()?;
        self.directional.make_room_for_epochs()
    }

    /// Bytes held, without those of the tiles.
    pub fn bytes(&self) -> usize {
        let per_block = size_of::<Option<Arc<DirectTile>>>() + size_of::<DirectTile>() + size_of::<u32>() + 1;
        self.irradiance.bytes()
            + self.directional.bytes()
            + self.on.bytes()
            + self.lods.len() * per_block
            + self.scratch.bytes()
    }

    /// Shows the newest light of the `changed` blocks, at most [`SHOWN_AT_ONCE`]; reports to `note` where that changes
    /// the light map. A block that is away keeps its shown light until it is back.
    pub fn refresh(&mut self, map: &BlockMap, blocks: &Blocks, changed: &[u32], note: &mut dyn FnMut(Changed)) {
        for &b in changed {
            let Some(block) = blocks.work(b) else { continue };
            let tile = &map.tiles[b as usize];
            let fresh = blocks.status()[b as usize].fresh_lod.min(self.lods[b as usize]);
            self.on.fresh[b as usize] = fresh;
            for i in 0..tile.lod_end[fresh as usize] as usize {
                let texel = tile.texels[i];
                if let Some(value) = block.estimate(i) {
                    self.irradiance.plain[texel.index()] = value;
                    self.on.variances[texel.index()] = block.variance(i);
                }
                if let Some((shown, value)) = self.directional.plain.get_mut(texel.index()).zip(block.directional(i)) {
                    *shown = value;
                }
                self.on.note_visible(b, texel, block.is_visible(i));
            }
        }
        self.spread(map, changed, note);
    }

    /// Interpolates, fills and blurs the texels that depend on those of the `changed` blocks; reports to `note` where
    /// that changes the light map.
    fn spread(&mut self, map: &BlockMap, changed: &[u32], note: &mut dyn FnMut(Changed)) {
        let Display { irradiance, directional, on, scratch: Scratch { all, to_fill }, .. } = self;
        let top = map.top();
        // Neighbouring blocks that interpolate use texels of these blocks too.
        all.clear();
        all.extend_from_slice(changed);
        for &b in changed {
            all.extend(map.neighbours(b).filter(|&n| on.fresh[n as usize] < top));
        }
        all.sort_unstable();
        all.dedup();
        // No texel is both interpolated and a source of interpolation, so parts of all blocks may be processed one
        // after the other.
        for &b in &*all {
            let (tile, fresh) = (&map.tiles[b as usize], on.fresh[b as usize]);
            let interpolated = &tile.texels[tile.lod_end[fresh as usize] as usize..];
            interpolated.iter().for_each(|s| on.variances[s.index()] = f32::INFINITY);
        }
        let on = &*on;
        let size = BLOCK_TEXELS;
        irradiance.renew(all, size, |l| &mut l.plain, |l, b, slot| l.interpolate_block(on, map, b, slot), |_, _| ());
        directional.renew(all, size, |l| &mut l.plain, |l, b, slot| l.interpolate_block(on, map, b, slot), |_, _| ());

        to_fill.clear();
        if !on.is_all_seen() {
            to_fill.extend(changed.iter().flat_map(|&b| map.neighbours(b).chain([b])));
            to_fill.retain(|&b| on.has_unseen(b));
            to_fill.sort_unstable();
            to_fill.dedup();
        }
        // Only texels that can be seen are read, and these are not filled.
        irradiance.renew(to_fill, size, |l| &mut l.plain, |l, b, slot| l.fill_block(on, map, b, slot), |_, _| ());
        directional.renew(to_fill, size, |l| &mut l.plain, |l, b, slot| l.fill_block(on, map, b, slot), |_, _| ());

        all.extend_from_slice(to_fill);
        all.sort_unstable();
        all.dedup();
        let size = slot_size(on.blur);
        let note = |block, amount| {
            let (page, rect) = widest_rect(map, block, on.blur);
            note(Changed { page, rect, block, amount });
        };
        irradiance.renew(all, size, |l| &mut l.shown, |l, b, slot| l.blur_block(on, map, b, slot, &l.plain), note);
        let by = &irradiance.plain;
        directional.renew(all, size, |l| &mut l.shown, |l, b, slot| l.blur_block(on, map, b, slot, by), |_, _| ());
    }

    /// The display as it would be if no block were above a LOD.
    pub fn lowered(&self, map: &BlockMap, lod: u8) -> Result<Display> {
        let mut lower = self.try_clone()?;
        lower.lods.iter_mut().for_each(|l| *l = lod.min(*l));
        lower.on.fresh.iter_mut().for_each(|l| *l = lod.min(*l));
        (lower.irradiance.old, lower.directional.old) = (Vec::new(), Vec::new());
        lower.on.fades.fill(0);
        let device = map.atlas.scene.device();
        device.install(|| in_parts(map.tiles.len()).for_each(|some| lower.spread(map, &some, &mut |_| ())));
        Ok(lower)
    }

    /// Starts fading a block to its newest light in steps of [`fade`](Self::fade). Returns whether it was not fading
    /// already.
    pub fn begin_fade(&mut self, b: u32) -> bool {
        std::mem::replace(&mut self.on.fades[b as usize], FADE) == 0
    }

    /// Ends all fades: with the next refresh blocks show their newest light.
    pub fn end_fades(&mut self) {
        self.on.fades.fill(0);
    }

    /// Whether a block is still fading.
    pub fn is_fading(&self, b: u32) -> bool {
        self.on.fades[b as usize] > 0
    }

    /// Does one step of fading `blocks`; reports to `note` where that changes the light map.
    pub fn fade(&mut self, map: &BlockMap, blocks: &[u32], mut note: impl FnMut(Changed)) {
        let Display { irradiance, directional, on, .. } = self;
        let (on, size) = (&*on, BLOCK_TEXELS);
        let note = |b, amount| note(changed(map, b, amount));
        irradiance.renew(blocks, size, |l| &mut l.shown, |l, b, slot| l.fade_block(on, map, b, slot, &l.plain), note);
        let by = &irradiance.plain;
        directional.renew(blocks, size, |l| &mut l.shown, |l, b, slot| l.fade_block(on, map, b, slot, by), |_, _| ());
        blocks.iter().for_each(|&b| self.on.fades[b as usize] -= 1);
    }

    /// Keeps the indirect light as that before a change.
    pub fn begin_indirect_epoch(&mut self) {
        self.irradiance.begin_indirect_epoch();
        self.directional.begin_indirect_epoch();
    }

    /// Begins an epoch in which tiles that were made under older lights are corrected by coarse light.
    pub fn begin_direct_epoch(&mut self) {
        self.irradiance.begin_direct_epoch();
        self.directional.begin_direct_epoch();
        self.epoch += 1;
    }

    /// Marks a tile that was current before the last change as still current.
    pub fn keep_tile(&mut self, b: u32) {
        if self.tile_epochs[b as usize] + 1 == self.epoch {
            self.tile_epochs[b as usize] = self.epoch;
        }
    }

    /// Takes over the direct light of the lowest LOD's texels of `blocks` that have changed, at most [`SHOWN_AT_ONCE`],
    /// and interpolates it to the other texels; reports to `note` where that changes the light map.
    pub fn take_coarse(&mut self, map: &BlockMap, blocks: &mut Blocks, of: &[u32], mut note: impl FnMut(Changed)) {
        let Display { irradiance, directional, on, scratch: Scratch { all, .. }, .. } = self;
        for &b in of {
            let Some(work) = blocks.work_mut(b) else { continue };
            let texels = &map.tiles[b as usize].texels;
            let (values, by_direction) =
                (std::mem::take(&mut work.new_coarse), std::mem::take(&mut work.new_coarse_directional));
            texels.iter().zip(values).for_each(|(s, value)| irradiance.coarse[s.index()] = value);
            texels.iter().zip(by_direction).for_each(|(s, value)| directional.coarse[s.index()] = value);
        }
        all.clear();
        all.extend(of.iter().flat_map(|&b| map.neighbours(b).chain([b])));
        all.sort_unstable();
        all.dedup();
        let (on, size) = (&*on, BLOCK_TEXELS);
        let note = |b, amount| note(changed(map, b, amount));
        irradiance.renew(all, size, |l| &mut l.coarse, |l, b, slot| l.interpolate_coarse(on, map, b, slot), note);
        let nothing = |_, _| ();
        directional.renew(all, size, |l| &mut l.coarse, |l, b, slot| l.interpolate_coarse(on, map, b, slot), nothing);
        for i in 0..self.scratch.all.len() {
            self.keep_correction(map, self.scratch.all[i]);
        }
    }

    /// A tile that is current is not corrected, nor when the next epoch begins: what has changed around it since is no
    /// change of light.
    fn keep_correction(&mut self, map: &BlockMap, b: u32) {
        if self.direct_tile(b).is_some_and(|(_, is_current)| is_current) {
            self.irradiance.keep_coarse(map, b);
            self.directional.keep_coarse(map, b);
        }
    }

    /// Takes over the direct light of a block at full resolution; returns the rectangle that changes, and by how many
    /// bytes the display has grown.
    pub fn take_direct(&mut self, map: &BlockMap, b: u32, tile: DirectTile) -> (Changed, isize) {
        self.tile_epochs[b as usize] = self.epoch;
        let grown = tile.bytes() as isize;
        let old = self.tiles[b as usize].replace(Arc::new(tile));
        self.keep_correction(map, b);
        // Shadows are the most visible of all changes.
        (changed(map, b, 1.0), grown - old.map_or(0, |t| t.bytes() as isize))
    }

    /// Direct light of a block at full resolution, and whether it was computed under the current lights.
    pub fn direct_tile(&self, b: u32) -> Option<(&DirectTile, bool)> {
        self.tiles[b as usize].as_deref().map(|t| (t, self.tile_epochs[b as usize] == self.epoch))
    }

    /// Puts the rectangle of a block's texels that gather for themselves, in the light map, into its place in `rects`: it
    /// is empty where there are none. These texels change at once when indirect light does.
    pub fn find_alone(map: &BlockMap, sides: &Sides, rects: &mut [Rect]) {
        rects.fill(Rect::default());
        let atlas = &map.atlas;
        for &texel in sides.upsampling.alone() {
            let rect = &mut rects[map.block_of(texel) as usize];
            let (x, y) = atlas.map.position(texel);
            let own = Rect { x0: x, y0: y, x1: x + 1, y1: y + 1 };
            *rect = if rect.area() == 0 { own } else { rect.union(&own) };
        }
    }

    /// The page and the part of it that a change of a block's light may change: within the blur's radius, and one texel
    /// more, as a texel of the light map interpolates between four texels of the gather map.
    pub fn widest_rect(&self, map: &BlockMap, block: u32) -> (u32, Rect) {
        widest_rect(map, block, self.on.blur)
    }

    /// Irradiance shown at a texel of the light map, of the parts given by bits of [`directional`].
    pub fn irradiance(&self, map: &BlockMap, light: &Illumination, texel: LightTexel, parts: u32) -> Vec3 {
        self.light(map, light, texel, parts, (&self.irradiance, &light.own), |tile| &tile.values)
    }

    /// Light by direction shown at a texel of the light map, of the parts given by bits of [`directional`], which must
    /// be among those asked for.
    pub fn directional(&self, map: &BlockMap, light: &Illumination, texel: LightTexel, parts: u32) -> Directional {
        self.light(map, light, texel, parts, (&self.directional, &light.own_directional), |tile| &tile.directional)
    }

    fn light<T: Shown>(
        &self,
        map: &BlockMap,
        light: &Illumination,
        texel: LightTexel,
        parts: u32,
        (layer, own): (&ShownLayer<T>, &[Option<T>]),
        of_tile: fn(&DirectTile) -> &[T],
    ) -> T {
        let atlas = &map.atlas;
        let mut indirect = T::default();
        if parts & directional::INDIRECT != 0 {
            indirect = light.sides.upsampling.at(atlas, PerTexel::new(&layer.shown), own, texel);
        }
        if parts & directional::DIRECT == 0 {
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
            let value = || of_tile(tile)[(y - r.y0) as usize * r.width() + (x - r.x0) as usize];
            inside.then(value).filter(T::is_known)
        });
        indirect
            + match fine {
                Some(fine) if self.tile_epochs[b] == self.epoch => fine,
                Some(old) => {
                    // Neighbours whose tiles were made in other epochs do not contribute.
                    let counts = |of: usize| {
                        of == b || (self.tiles[of].is_some() && self.tile_epochs[of] == self.tile_epochs[b])
                    };
                    (old + layer.change_of_direct(map, placement, local, counts)).valid()
                }
                None => {
                    let mut coarse = T::default();
                    atlas.gather.bilinear(placement, local, |s, w| coarse += layer.coarse[s.index()] * w);
                    coarse
                }
            }
    }
}

/// A change of the part of the light map that shows a block.
fn changed(map: &BlockMap, block: u32, amount: f32) -> Changed {
    let tile = &map.tiles[block as usize];
    let (page, rect) = in_light_map(map, tile.placement, &tile.rect.grown(1));
    Changed { page, rect, block, amount }
}

fn widest_rect(map: &BlockMap, block: u32, blur: i32) -> (u32, Rect) {
    let tile = &map.tiles[block as usize];
    let rect = tile.rect.grown(blur).clipped(&map.own_rect(tile.placement));
    in_light_map(map, tile.placement, &rect.grown(1))
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
