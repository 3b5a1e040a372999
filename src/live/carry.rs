//! Makes live light of a scene that was described anew, and keeps what live light of the scene before has gathered: after
//! meshes were added, removed or edited.
//!
//! A block keeps its rays if all of its texels show the [same points](Correspondence) as those of a former block, and its
//! direct light if nothing that changed lies between it and a light. Where light may differ, near what changed and, with all
//! photons, where probes find it as in a bake of changes, old light fades out while new rays come in, as after a
//! [move](super::follow).

use super::Live;
use super::blocks::{Block, BlockMap, BlockStatus, BlockWork, DirectTile, Tile};
use super::follow::{Base, Following};
use super::illumination::Illumination;
use super::save::Saved;
use super::shown_layer::Shown;
use super::work_on_direct::owns;
use crate::base::error::{Result, invalid_argument};
use crate::base::memory::{try_collect, try_par_collect_ok, try_to_vec};
use crate::base::progress::Progress;
use crate::lightmap::Lightmap;
use crate::lightmap::changed::comparison::Cell;
use crate::lightmap::changed::correspondence::Correspondence;
use crate::lightmap::moved::Moved;
use crate::scene::NONE;
use rayon::prelude::*;
use std::sync::Arc;

const KEPT: &str = "live light of before a change";

impl Live {
    /// Makes live light of a scene that was described anew, with the parameters of an `earlier` object, of the scene before.
    /// What that has gathered is kept where the scenes are alike, unless light has changed by more than `keep_error` (finite,
    /// ≥ 0; relative to the light or, if that is more, to a tenth of the mean), as far as probes tell. `lightmap` is best made by
    /// [`Lightmap::create_from`], and need not be baked.
    ///
    /// With [`quick_start`](super::LiveParams::quick_start) all that can be kept is shown at once, and new photons are traced beside
    /// the updates; else they are traced now. The earlier object is not changed, and may be dropped.
    pub fn create_from(lightmap: &Lightmap, earlier: &mut Live, keep_error: f32, progress: &Progress) -> Result<Live> {
        earlier.collect_now()?;
        Live::create_from_idle(lightmap, earlier, keep_error, progress)
    }

    /// Does the work of [`create_from`](Self::create_from). What the earlier object's background work has at the time is not kept.
    pub(crate) fn create_from_idle(
        lightmap: &Lightmap,
        earlier: &Live,
        keep_error: f32,
        progress: &Progress,
    ) -> Result<Live> {
        if !(keep_error >= 0.0 && keep_error.is_finite()) {
            return invalid_argument!("keep_error is {keep_error}, not a finite number ≥ 0");
        }
        let scene = &lightmap.atlas().scene;
        let carry = || scene.device().run(progress, || Live::carry_from(lightmap, earlier, keep_error, progress));
        scene.while_unchanged(|| earlier.scene().while_unchanged(carry))
    }

    fn carry_from(lightmap: &Lightmap, earlier: &Live, keep_error: f32, progress: &Progress) -> Result<Live> {
        let (atlas, old, before) = (lightmap.atlas(), &earlier.context.map.atlas, &earlier.context.light);
        let params = &earlier.params;
        let (former, moved) = Correspondence::between(old, atlas, progress)?;
        let light = |bake: &_| match params.quick_start {
            true => Illumination::carried(atlas, bake, before, (old, &former), progress),
            false => Illumination::new(atlas, bake, false, progress),
        };
        let mut live = Live::idle(lightmap, params, light, progress)?;
        live.start(progress)?;
        let new = live.context.light.clone();
        if !new.has_indirect {
            return Ok(live);
        }
        let has_same_lights =
            live.lights == earlier.lights && atlas.scene.environments() == old.scene.environments() && !moved.emits;
        let blocks = live.former_blocks(earlier, &former, progress)?;
        let base = Arc::new(live.base_of(earlier, &blocks, (former, moved))?);
        let following = Following { base, keep_error };
        // Blocks that all have the light of one radiance map can be compared.
        let is_settled = !earlier.relight.is_pending() && before.has_indirect && !before.radiance.values.is_empty();
        let with_all_photons = (is_settled && !params.quick_start).then_some((&*new.radiance, &live.bake));
        let cells = following.cells(atlas, &new.sides.backs, with_all_photons, progress)?;
        live.take_blocks(earlier, &blocks, (&cells, &following), (is_settled, has_same_lights), progress)?;
        if params.quick_start {
            live.make_room_for_epochs()?;
            live.make_room_for_stale()?;
            live.is_stale.iter_mut().zip(&cells).for_each(|(is_stale, cell)| *is_stale = cell.is_new);
            live.relight.following = is_settled.then_some(following);
            live.relight.follow_first_impression(&live.context.map, &live.bake)?;
        }
        Ok(live)
    }

    /// Returns the former block of each block, [`NONE`] where there was none.
    fn former_blocks(&self, earlier: &Live, former: &Correspondence, progress: &Progress) -> Result<Vec<u32>> {
        let maps = (&*earlier.context.map, &*self.context.map);
        let former_block = |block| {
            progress.check()?;
            Ok(former_block(maps, former, block).unwrap_or(NONE))
        };
        try_par_collect_ok((0..self.blocks.len()).into_par_iter().map(former_block), KEPT)
    }

    /// Returns the light of an earlier object, with which that of this one is compared.
    fn base_of(&self, earlier: &Live, blocks: &[u32], former: (Correspondence, Moved)) -> Result<Base> {
        let (map, before) = (self.context.map.clone(), &earlier.context.light);
        let statuses = earlier.blocks.status();
        let light = |&b: &u32| statuses.get(b as usize).map_or(0.0, |b| b.mean + b.direct_mean);
        let light = try_collect(blocks.iter().map(light), KEPT)?;
        let bytes = size_of_val(&before.radiance.values[..]) + size_of_val(&light[..]) + former.0.bytes();
        Ok(Base {
            atlas: earlier.context.map.atlas.clone(),
            radiance: before.radiance.clone(),
            backs: former.0.backs(&before.sides.backs)?,
            former: Some(former),
            mean: Base::mean(&light, &map.tiles),
            light,
            _memory: map.atlas.scene.device().memory().reserve(bytes, KEPT)?,
            map,
        })
    }

    /// Takes over what former blocks have. With a quick start light that may be another now counts as the present one until
    /// all photons have come.
    fn take_blocks(
        &mut self,
        earlier: &Live,
        blocks: &[u32],
        (cells, following): (&[Cell], &Following),
        (is_settled, has_same_lights): (bool, bool),
        progress: &Progress,
    ) -> Result<()> {
        let bytes = |&block: &u32| {
            let work = earlier.blocks.work(block).map_or(0, BlockWork::bytes);
            work + earlier.display.direct_tile(block).map_or(0, |(tile, _)| tile.bytes())
        };
        let known: usize = blocks.iter().filter(|&&block| block != NONE).map(bytes).sum();
        // The list of blocks is collected twice, with errors and without.
        self.reserve(known + 2 * blocks.len() * size_of::<Saved>())?;
        let carry = Carry { earlier, live: self, following, has_same_lights };
        let carry = |(b, (&former, cell)): (usize, (&u32, &Cell))| {
            let is_old = !is_settled || cell.is_new && !earlier.params.quick_start;
            carry.block(b as u32, former, cell, is_old, progress)
        };
        let kept = try_par_collect_ok(blocks.par_iter().zip(cells).enumerate().map(carry), KEPT)?;
        let is_any_old = kept.iter().any(|saved| saved.is_old);
        let (display, blocks) = self.restored(kept, progress)?;
        self.go_on_from(display, blocks);
        self.settle();
        self.show_cells();
        if is_any_old {
            // Its detail stays while the first new rays come in.
            self.make_room_for_epochs()?;
            self.display.begin_indirect_epoch();
        }
        Ok(())
    }
}

/// Returns the former block of a block, if all of their texels show the same points.
fn former_block((old, new): (&BlockMap, &BlockMap), former: &Correspondence, block: usize) -> Option<u32> {
    let tile = &new.tiles[block];
    let placement = former.gather_placement(tile.placement)?;
    let size = |map: &BlockMap, placement| (map.own_rect(placement).width(), map.own_rect(placement).height());
    if size(old, placement) != size(new, tile.placement) {
        return None;
    }
    let found = old.of_placement(placement).start + block as u32 - new.of_placement(tile.placement).start;
    let there = &old.tiles[found as usize];
    let is_same = |(&texel, &there)| former.gather_texel(&old.atlas, &new.atlas, tile.placement, texel) == Some(there);
    let is_alike = tile.lod_end == there.lod_end && tile.texels.iter().zip(&there.texels).all(is_same);
    is_alike.then_some(found)
}

/// Copies blocks of an earlier object.
struct Carry<'a> {
    earlier: &'a Live,
    live: &'a Live,
    following: &'a Following,
    has_same_lights: bool,
}

impl Carry<'_> {
    /// Returns what a block keeps of a former one ([`NONE`]: nothing), whose indirect light may be old.
    fn block(&self, b: u32, former: u32, cell: &Cell, is_old: bool, progress: &Progress) -> Result<Saved> {
        progress.check()?;
        let Carry { earlier, live, .. } = *self;
        let Some(status) = earlier.blocks.status().get(former as usize) else { return Ok(Saved::default()) };
        let Some(work) = earlier.blocks.work(former) else { return Ok(Saved::default()) };
        let (lod, rounds) = (status.fresh_lod, status.rounds);
        let keeps_direct = self.has_same_lights && !cell.is_new && !cell.is_shadowed;
        let direct = earlier.display.direct_tile(former).filter(|&(_, is_current)| is_current && keeps_direct);
        Ok(Saved {
            block: Block {
                status: BlockStatus { lod, fresh_lod: lod, rounds, ..Default::default() },
                work: BlockWork {
                    gathered: try_to_vec(&work.gathered, KEPT)?,
                    directional: try_to_vec(&work.directional, KEPT)?,
                    prior: try_to_vec(&work.prior, KEPT)?.into_boxed_slice(),
                    prior_directional: try_to_vec(&work.prior_directional, KEPT)?.into_boxed_slice(),
                    deviations: work.deviations,
                    deviation_count: work.deviation_count,
                    ..Default::default()
                },
            },
            shown: earlier.display.lods[former as usize].min(lod),
            direct: match direct {
                Some((direct, _)) => self.direct(&live.context.map.tiles[b as usize], direct)?,
                None => None,
            },
            is_old: is_old || status.has_old_light(&earlier.context),
        })
    }

    /// Copies direct light to the place of the same texels; `None` if not all show the same points.
    fn direct(&self, tile: &Tile, from: &DirectTile) -> Result<Option<DirectTile>> {
        let (context, old) = (&self.live.context, &self.following.base.atlas);
        let Some((former, _)) = &self.following.base.former else { return Ok(None) };
        let rect = context.map.rect_in_light_map(tile.placement, &tile.rect);
        if (rect.width(), rect.height()) != (from.rect.width(), from.rect.height()) {
            return Ok(None);
        }
        let mut tile_of = DirectTile {
            rect,
            values: try_to_vec(&from.values, KEPT)?.into_boxed_slice(),
            directional: try_to_vec(&from.directional, KEPT)?.into_boxed_slice(),
        };
        for (i, (x, y)) in rect.texels().enumerate() {
            let Some(texel) = owns(context, tile, x, y) else {
                // Rounding may have it that the block owned the texel where it was before.
                tile_of.values[i] = Shown::UNKNOWN;
                if let Some(by_direction) = tile_of.directional.get_mut(i) {
                    *by_direction = Shown::UNKNOWN;
                }
                continue;
            };
            let place = (x - rect.x0 + from.rect.x0, y - rect.y0 + from.rect.y0);
            let former = former.texel(old, &context.map.atlas, tile.placement, texel);
            let is_same = former.is_some_and(|former| old.map.position(former) == place);
            if !is_same || !tile_of.values[i].is_known() {
                return Ok(None);
            }
        }
        Ok(Some(tile_of))
    }
}
