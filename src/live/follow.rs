//! Lets live light follow its scene when vertices or instances have moved.
//!
//! Direct light is computed anew at once where what moved lies, or lay, between a block and a light. Indirect light needs
//! new photons: they are traced beside the updates ([`relight`](super::relight)), first a sixteenth of them, whose light
//! is gathered near what moved only, then all. With these, probes compare the light of every block with that from before
//! the move, as a bake of changes does, and blocks that see no other light keep what they have gathered.

use super::Live;
use super::Mode;
use super::blocks::{BlockMap, Rect, Tile};
use super::cells::{Grid, Promotion};
use super::choose::Chooser;
use super::display::{Changed, Display};
use super::illumination::{Illumination, Indirect, Part};
use crate::base::error::{Result, invalid_argument};
use crate::base::memory::{Reservation, try_collect, try_filled, try_to_vec};
use crate::base::progress::Progress;
use crate::direct::DirectLight;
use crate::lightmap::atlas::Atlas;
use crate::lightmap::changed::comparison::{Cell, Comparison, SceneState};
use crate::lightmap::changed::correspondence::Correspondence;
use crate::lightmap::indirect::radiance_map::Radiance;
use crate::lightmap::moved::Moved;
use crate::lightmap::{BakeParams, Lightmap};
use glam::Vec3;
use std::sync::Arc;

const MOVED: &str = "blocks whose light a move has changed";

/// The light from before a change, with which that after it is compared.
pub(super) struct Base {
    pub atlas: Arc<Atlas>,
    pub radiance: Arc<Radiance>,
    /// Which charts show their backs, by their numbers after the change (empty: none).
    pub backs: Vec<bool>,
    /// How surfaces were numbered, and what changed, if the scene was described anew.
    pub former: Option<(Correspondence, Moved)>,
    /// Blocks as they are numbered after the change, the light of each from before it, by the sum of its channels, and its
    /// mean over the light map.
    pub map: Arc<BlockMap>,
    pub light: Vec<f32>,
    pub mean: f32,
    pub _memory: Reservation,
}

/// What a renewal of indirect light is compared with.
#[derive(Clone)]
pub(super) struct Following {
    pub base: Arc<Base>,
    /// Relative difference of light that is let stand.
    pub keep_error: f32,
}

impl Following {
    /// Finds the blocks whose indirect light stays as it was, under new light with all photons; none if it is dark.
    pub fn kept(&self, atlas: &Atlas, new: &Indirect, params: &BakeParams, progress: &Progress) -> Result<Vec<bool>> {
        if !new.has_indirect {
            return Ok(Vec::new());
        }
        let cells = self.cells(atlas, &new.sides.backs, Some((&new.radiance, params)), progress)?;
        try_collect(cells.iter().map(|cell| !cell.is_new), MOVED)
    }

    /// Compares all blocks with what they were: by what lies near them, and by probes under new light with all photons, if
    /// that is given.
    pub fn cells(
        &self,
        atlas: &Atlas,
        backs: &[bool],
        light: Option<(&Radiance, &BakeParams)>,
        progress: &Progress,
    ) -> Result<Vec<Cell>> {
        let base = &*self.base;
        let old = &*base.atlas;
        let between;
        let (former, moved) = match &base.former {
            Some((former, moved)) => (Some(former), moved),
            None => {
                between = Moved::between(&old.scene, &atlas.scene, &atlas.charts)?;
                (None, &between)
            }
        };
        let old = SceneState { atlas: old, backs: &base.backs, former };
        let states = [old, SceneState { atlas, backs, former: None }];
        let comparison = Comparison::new(states, moved, self.keep_error, progress)?;
        let mut cells = comparison.cells()?;
        if let Some((radiance, params)) = light {
            let light = |texel| base.light[base.map.block_of(texel) as usize];
            comparison.probe(&mut cells, [&base.radiance, radiance], params, light, base.mean)?;
        }
        Ok(cells)
    }
}

impl Base {
    /// Returns the mean of the light of blocks.
    pub fn mean(light: &[f32], tiles: &[Tile]) -> f32 {
        let (mut sum, mut texels) = (0.0, 0.0);
        for (light, tile) in light.iter().zip(tiles) {
            let n = f64::from(tile.map_texels);
            (sum, texels) = (sum + f64::from(*light) * n, texels + n);
        }
        (sum / f64::max(texels, 1.0)) as f32
    }
}

/// The parts of a live object that depend on where things are, in another state of the scene.
struct Place {
    map: Arc<BlockMap>,
    normals: Vec<Vec3>,
    grid: Grid,
    promotion: Promotion,
    chooser: Chooser,
    direct: DirectLight,
    /// By block, whether indirect light and direct light are computed anew whatever probes find.
    differs: Vec<[bool; 2]>,
    /// Whether an emissive triangle moved.
    emits: bool,
    /// Memory of both states.
    _memory: Reservation,
}

impl Live {
    /// Takes over another state of the scene, to which the light map that this object was made of has been updated
    /// ([`Lightmap::follow`]). Blocks whose light differs by less than `keep_error` (finite, ≥ 0; relative to their light
    /// or, if that is more, to a tenth of the mean), as far as probes tell, keep it. If lights were set since
    /// they were last taken over, all light is computed anew.
    ///
    /// A call that fails or is cancelled changes nothing.
    pub fn follow(&mut self, lightmap: &Lightmap, keep_error: f32, progress: &Progress) -> Result<()> {
        if !(keep_error >= 0.0 && keep_error.is_finite()) {
            return invalid_argument!("keep_error is {keep_error}, not a finite number ≥ 0");
        }
        let (atlas, old) = (lightmap.atlas(), self.context.map.clone());
        if Arc::ptr_eq(atlas, &old.atlas) {
            return Ok(());
        }
        if !Arc::ptr_eq(&atlas.charts, &old.atlas.charts) {
            return invalid_argument!("the live object is of another light map");
        }
        self.collect_now()?;
        let place = self.device().run(progress, || self.place_in(atlas, keep_error, progress))?;
        let lights = atlas.scene.lights();
        let has_other_lights = lights != self.lights;
        let following = match has_other_lights {
            true => None,
            false => self.following(keep_error)?,
        };
        self.make_room_for_epochs()?;
        let former = std::mem::replace(&mut self.relight.following, following);
        if let Err(e) = self.relight.start(&place.map, &self.bake, &self.context.light.sides) {
            self.relight.following = former;
            return Err(e);
        }
        // Nothing can fail from here on.
        self.move_to(place, has_other_lights);
        self.lights = lights;
        Ok(())
    }

    /// Computes what depends on where things are. To be called on the device's threads.
    fn place_in(&mut self, atlas: &Arc<Atlas>, keep_error: f32, progress: &Progress) -> Result<Place> {
        let old = &self.context.map;
        let texels = old.atlas.gather.len() * size_of::<Vec3>();
        let memory = old.atlas.scene.device().memory().reserve(old.bytes() + texels, MOVED)?;
        let moved = Moved::between(&old.atlas.scene, &atlas.scene, &atlas.charts)?;
        let mut map = BlockMap::new(atlas, self.params.lod_count, 0.5, progress)?;
        let backs = &self.context.light.sides.backs;
        let states = [&*old.atlas, &**atlas].map(|atlas| SceneState { atlas, backs, former: None });
        let cells = Comparison::new(states, &moved, keep_error, progress)?.cells()?;
        let grid = Grid::with(self.grid.info, &mut map.tiles)?;
        let direct = DirectLight::try_new(&atlas.scene)?;
        atlas.make_room_for_sky_seen(&direct)?;
        let place = Place {
            direct,
            normals: Display::normals(&map)?,
            promotion: Promotion::new(&map.tiles, &grid)?,
            chooser: Chooser::new(&map, &grid)?,
            differs: try_collect(cells.iter().map(|cell| [cell.is_new, cell.is_new || cell.is_shadowed]), MOVED)?,
            emits: moved.emits,
            _memory: memory,
            map: Arc::new(map),
            grid,
        };
        self.make_room_for_stale()?;
        Ok(place)
    }

    /// Makes the marks of blocks whose light a change has made stale, if there are none.
    pub(super) fn make_room_for_stale(&mut self) -> Result<()> {
        if self.is_stale.is_empty() {
            let count = self.blocks.len();
            self.reserve(count)?;
            self.is_stale = try_filled(count, false, MOVED)?;
            self.fixed += count;
            self.bytes_full += count as u64;
        }
        Ok(())
    }

    /// Returns what the light after a move is to be compared with: that from before the first move since all blocks had
    /// the same; `None` if they have not.
    fn following(&self, keep_error: f32) -> Result<Option<Following>> {
        if let Some(following) = &self.relight.following {
            if following.base.former.is_some() {
                // What it knows to have changed is what the new description changed, without this move.
                return Ok(None);
            }
            let keep_error = keep_error.min(following.keep_error);
            return Ok(Some(Following { keep_error, ..following.clone() }));
        }
        let light = &self.context.light;
        if self.relight.is_pending() || !light.has_indirect || light.radiance.values.is_empty() {
            return Ok(None);
        }
        let map = &self.context.map;
        let of_blocks = try_collect(self.blocks.status().iter().map(|b| b.mean + b.direct_mean), MOVED)?;
        let mean = Base::mean(&of_blocks, &map.tiles);
        let radiance = light.radiance.clone();
        let backs = try_to_vec(&light.sides.backs, MOVED)?;
        let bytes = map.bytes() + size_of_val(&radiance.values[..]) + size_of_val(&of_blocks[..]);
        let memory = map.atlas.scene.device().memory().reserve(bytes, MOVED)?;
        let (atlas, map) = (map.atlas.clone(), map.clone());
        let base = Base { atlas, radiance, backs, former: None, map, light: of_blocks, mean, _memory: memory };
        Ok(Some(Following { base: Arc::new(base), keep_error }))
    }

    fn move_to(&mut self, place: Place, has_other_lights: bool) {
        let Place { map, normals, grid, promotion, chooser, direct, differs, emits, _memory } = place;
        let old = std::mem::replace(&mut self.context.map, map.clone());
        debug_assert_eq!((old.tiles.len(), differs.len()), (map.tiles.len(), map.tiles.len()));
        (self.grid, self.promotion, self.chooser) = (grid, promotion, chooser);
        self.display.set_normals(normals);
        self.display.begin_direct_epoch();
        let before = self.context.light.clone();
        self.context.light = Arc::new(Illumination {
            direct: Arc::new(direct),
            direct_epoch: before.direct_epoch + 1,
            ..(*before).clone()
        });
        if !has_other_lights && !emits {
            self.keep_direct(before.direct_epoch, |b, _| !differs[b as usize][1]);
        }
        for (is_stale, [differs, _]) in self.is_stale.iter_mut().zip(&differs) {
            *is_stale |= differs;
        }
        self.mark_moved_texels(&old);
        self.promotion.count(&map.tiles, self.blocks.status());
        self.show_cells();
        self.chooser.note_all(&self.context, self.blocks.status());
    }

    /// Marks the texels of the light map whose samples have moved to another place in their charts: their light is that of
    /// other texels.
    fn mark_moved_texels(&mut self, old: &BlockMap) {
        let map = self.context.map.clone();
        let (new, old) = (&*map.atlas, &*old.atlas);
        let size = new.map.layout.page_size as i32;
        let whole = Rect { x0: 0, y0: 0, x1: size, y1: size };
        let is_buried = |atlas: &Atlas, i: usize| atlas.buried.get(i).is_some_and(|&b| b);
        for texel in new.map.all() {
            let i = texel.index();
            if new.map[texel] != old.map[texel] || is_buried(new, i) != is_buried(old, i) {
                let (x, y) = new.map.position(texel);
                let page = new.map.layout[new.map.placement_of(&new.charts, texel)].page;
                let rect = Rect { x0: x, y0: y, x1: x + 1, y1: y + 1 }.grown(new.padding as i32).clipped(&whole);
                self.dirty.add(Changed { page, rect, block: map.block_of(texel), amount: 0.5 });
            }
        }
    }

    /// Shows the LOD that all blocks of a cell have, after blocks came to other cells.
    pub(super) fn show_cells(&mut self) {
        if self.params.mode != Mode::Position {
            return;
        }
        for i in 0..self.grid.occupied.len() {
            let cell = self.grid.occupied[i];
            self.show_cell(cell, self.promotion.common(cell));
        }
    }

    /// Lets blocks whose light a move does not change keep what they have gathered under the light of an epoch, although
    /// there is new light: of few photons all but those near what moved, of all photons those that probes have `kept`.
    pub(super) fn keep_indirect(&mut self, before_epoch: u32, part: Part, kept: &[bool]) {
        let epoch = self.context.light.indirect_epoch;
        if self.relight.following.is_some() {
            for (b, status) in self.blocks.status_mut().iter_mut().enumerate() {
                let is_kept = part == Part::Quick || kept.get(b).is_some_and(|&kept| kept);
                if is_kept && !self.is_stale[b] && status.indirect_epoch == before_epoch {
                    status.indirect_epoch = epoch;
                }
            }
        }
        if part == Part::Whole {
            self.relight.following = None;
            self.is_stale.fill(false);
        }
    }
}
