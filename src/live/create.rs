//! Creates live objects: photons and radiance map, and the texels of the lowest LOD.

use super::blocks::{Block, BlockMap, Blocks, Rect, Tile};
use super::cells::{Grid, Promotion};
use super::choose::Chooser;
use super::dirty::Dirty;
use super::display::Display;
use super::illumination::Illumination;
use super::limit::Limit;
use super::readback::{ChartBins, ReadingTime};
use super::relight::Relight;
use super::room::{Room, Rooms};
use super::visibility::Visibility;
use super::work::Context;
use super::{Live, LiveParams, in_parts};
use crate::base::error::{Error, Result};
use crate::base::memory::{try_vec, try_with_capacity};
use crate::base::parallel::{ParallelLoop, one_by_one};
use crate::base::progress::Progress;
use crate::base::sampling::purpose_seed;
use crate::lightmap::indirect::sample_set::SampleSet;
use crate::lightmap::stages::purpose;
use crate::lightmap::{BakeParams, Lightmap};
use glam::Vec3;
use rayon::prelude::*;
use std::collections::VecDeque;
use std::sync::Arc;

/// Light below this part of the scene's mean counts as dark.
const DIM: f32 = 0.02;

/// Number of blocks whose lowest LOD is computed together.
const TOGETHER: usize = 16;

impl Live {
    /// Computes the lowest LOD of all texels, under the scene's current lights. `lightmap` need not be baked and is not
    /// changed.
    pub fn new(lightmap: &Lightmap, params: &LiveParams, progress: &Progress) -> Result<Live> {
        params.validate()?;
        let device = lightmap.atlas().scene.device();
        device.run(progress, || {
            let light = |bake: &_| Illumination::new(lightmap.atlas(), bake, params.quick_start, progress);
            let mut live = Live::idle(lightmap, params, light, progress)?;
            live.start(progress)?;
            if params.quick_start && live.context.light.has_indirect {
                live.make_room_for_epochs()?;
                live.relight.follow_first_impression(&live.context.map, &live.bake)?;
            }
            Ok(live)
        })
    }

    /// Creates the object with all buffers; only photons and radiance are computed, by `light`.
    pub(super) fn idle(
        lightmap: &Lightmap,
        params: &LiveParams,
        light: impl FnOnce(&BakeParams) -> Result<Illumination>,
        progress: &Progress,
    ) -> Result<Live> {
        let atlas = lightmap.atlas();
        let bake = params.bake();
        let mut map = BlockMap::new(atlas, params.lod_count, 0.02, progress)?;
        let (lower, upper) = atlas.scene.bounds();
        let grid = Grid::new(lower, upper, params.cell_size, &mut map.tiles)?;
        let lights = atlas.scene.lights();
        let light = light(&bake)?;
        progress.check()?;
        let display = Display::new(&map, params.blur, params.directional != 0)?;
        progress.check()?;
        let bins = ChartBins::new(&map)?;
        let chooser = Chooser::new(&map, &grid)?;
        let promotion = Promotion::new(&map.tiles, &grid)?;
        let dirty = Dirty::all(atlas.info.page_count, atlas.map.layout.page_size, map.tiles.len())?;
        let fixed = map.bytes()
            + display.bytes()
            + grid.bytes()
            + promotion.bytes()
            + bins.bytes()
            + chooser.bytes()
            + dirty.bytes()
            + light.radiance.values.len() * size_of::<Vec3>()
            // Marks, visible blocks, the queues of blocks that wait to be shown or fade, and rectangles.
            + map.tiles.len() * (21 + size_of::<Rect>());
        let memory = atlas.scene.device().memory().reserve(fixed, "the live state")?;
        let all_of =
            |t: &Tile| t.texels.len() * params.gathered_bytes() + t.map_texels as usize * params.direct_bytes();
        let full: usize = map.tiles.iter().map(all_of).sum();
        let blocks = Blocks::new(map.tiles.len())?;
        let mut alone = try_vec(blocks.len(), "texels on their own")?;
        Display::find_alone(&map, &light.sides, &mut alone);
        let mut waiting = VecDeque::new();
        waiting.try_reserve_exact(blocks.len()).map_err(|_| Error::OutOfMemory("the queue of blocks".into()))?;
        Ok(Live {
            visibility: Visibility::new(blocks.len())?,
            dirty,
            reading: ReadingTime::default(),
            choosing_seconds: 0.0,
            last_dirty_bytes: 0,
            alone,
            marking: None,
            is_stale: Vec::new(),
            is_waiting: try_vec(blocks.len(), "the queue of blocks")?,
            waiting,
            fading: try_with_capacity(blocks.len(), "the queue of blocks")?,
            still_fading: try_with_capacity(blocks.len(), "the queue of blocks")?,
            bytes_full: (fixed + full) as u64,
            params: *params,
            relight: Relight::beside(atlas.scene.device().num_threads()),
            background: None,
            paused: false,
            refresh_seconds: 1e-4,
            coarse_seconds: 1e-4,
            total_rays: 0,
            fixed,
            held: 0,
            memory,
            context: Context {
                map: Arc::new(map),
                samples: Arc::new(SampleSet::new(bake.gather_rays, purpose_seed(params.seed, purpose::GATHER_SET))?),
                gather_seed: purpose_seed(params.seed, purpose::GATHER),
                near_hits: params.near_hits,
                direct_seed: purpose_seed(params.seed, purpose::DIRECT),
                direct_samples: params.direct_samples,
                blurs: params.blur > 0,
                directional: params.directional,
                direct_rays: light.direct.rays_per_point(params.direct_samples),
                dim: 0.0,
                promote_threshold: params.promote_threshold,
                max_rounds: params.max_rounds,
                rooms: Arc::new(Rooms::new()),
                light: Arc::new(light),
            },
            lights,
            bake,
            blocks,
            grid,
            promotion,
            display,
            bins,
            chooser,
        })
    }

    /// Computes the lowest LOD everywhere. It must be called in the pool.
    pub(super) fn start(&mut self, progress: &Progress) -> Result<()> {
        let stage = progress.stage("lowest LOD", 0.5, 0.9, self.blocks.len() as u64);
        let (limit, top) = (Limit::new(None, u64::MAX, Room::TEXELS), self.context.map.top());
        let context = self.context.clone();
        let blocks = self.blocks.par_chunks_mut(TOGETHER).zip(context.map.tiles.par_chunks(TOGETHER));
        one_by_one(blocks).try_each(|((status, homes), tiles)| {
            let mut room = context.room()?;
            let mut blocks = try_with_capacity(tiles.len(), "blocks to be worked on")?;
            for ((status, home), tile) in status.iter().zip(&mut *homes).zip(tiles) {
                if !tile.texels.is_empty()
                    && let Some(work) = home.take()
                {
                    blocks.push((Block { status: *status, work }, tile));
                }
            }
            Block::coarse_of_all(&context, &mut blocks, &mut room, &limit);
            Block::first_indirect(&context, &mut blocks, &mut room, &limit);
            for (block, tile) in &mut blocks {
                // One or two texels that lie hidden inside something, or against it, are no evidence about the others.
                while block.status.lod < top
                    && tile.lod_end[block.status.lod as usize] <= 2
                    && !block.work.sees_light()
                    && block.work_on_indirect(&context, tile, &mut room, &limit)
                {}
            }
            let mut blocks = blocks.into_iter();
            for ((status, home), tile) in status.iter_mut().zip(homes).zip(tiles) {
                if !tile.texels.is_empty()
                    && let Some((block, _)) = blocks.next()
                {
                    (*status, *home) = (block.status, Some(block.work));
                }
            }
            limit.check_memory()?;
            stage.advance(tiles.len() as u64)
        })?;
        self.total_rays += limit.traced();
        let sum: f64 = self.blocks.status().iter().map(|b| (b.mean + b.direct_mean) as f64).sum();
        self.context.dim = DIM * (sum / self.blocks.len() as f64) as f32;
        self.held = self.blocks.bytes() as isize;
        let stage = progress.stage("show", 0.9, 1.0, 2 * self.blocks.len() as u64);
        for some in in_parts(self.blocks.len()) {
            self.display.take_coarse(&context.map, &mut self.blocks, &some, &mut |_| ());
            stage.advance(some.len() as u64)?;
        }
        for (lod, status) in self.display.lods.iter_mut().zip(self.blocks.status()) {
            *lod = status.lod;
        }
        self.reserve(0)?;
        for some in in_parts(self.blocks.len()) {
            self.display.refresh(&context.map, &self.blocks, &some, &mut |_| ());
            stage.advance(some.len() as u64)?;
        }
        self.note_all_shown();
        Ok(())
    }
}
