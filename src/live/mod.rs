//! Live updates (thesis 3.3): coarse light at once, refined while a camera moves through the scene,
//! within a time budget per frame, and relit when lights change.
//!
//! Creating a [`Live`] object computes photons and radiance map as a bake does, and the texels of the
//! lowest LOD. Each update then works on `blocks` of texels: in view-based mode (3.3.1) on those
//! that the camera sees, where estimated error times visibility is largest; in position-based mode
//! (3.3.2) on the cells of the light map grid that are near, visible ones first. The thesis picks
//! texels at random and lets neighbouring cells of different LOD show their border; here the texels
//! of an LOD are among those of the next, and the texels between them are interpolated across cells.
//!
//! A texel's sums depend on its number of rounds alone. When all texels have k rounds they have the
//! bits of a bake with 64 · k gather rays and without stitching, whatever the order of the updates.

mod batch;
mod blocks;
mod cells;
mod choose;
mod dirty;
mod display;
mod lists;
mod read;
mod relight;
mod save;
mod visibility;
mod work;

pub use blocks::MAX_LODS;
pub use cells::{CellInfo, NO_LOD};

use crate::device::Device;
use crate::direct::DirectLight;
use crate::error::{Error, Result, invalid_argument};
use crate::lightmap::bake::purpose;
use crate::lightmap::indirect::blur::MAX_BLUR_RADIUS;
use crate::lightmap::indirect::gather::Gathered;
use crate::lightmap::indirect::sample_set::{ROUND, SampleSet};
use crate::lightmap::{BakeParams, Lightmap};
use crate::memory::{Reservation, try_vec, try_with_capacity};
use crate::progress::Progress;
use crate::sampling::purpose_seed;
use crate::scene::{Light, Scene};
use batch::{Background, Batch, Item};
use blocks::{Block, BlockMap, BlockStatus, Blocks, Rect, Tile};
use cells::{Grid, Promotion};
use choose::{Choice, Chooser};
use dirty::Dirty;
use display::Display;
use glam::Vec3;
use rayon::prelude::*;
use read::ChartBins;
use relight::{Illumination, Relight};
use std::collections::VecDeque;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use visibility::Visibility;
use work::{Context, Limit, Step};

/// Which blocks updates work on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// Refine the surfaces in view.
    View,
    /// Refine the cells near the camera, visible or not.
    Position,
    /// Refine anywhere, at random, for comparison.
    Uniform,
}

/// Parameters of live updates.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LiveParams {
    /// Where updates work.
    pub mode: Mode,
    /// Number of levels of detail, 1 to [`MAX_LODS`]. The lowest computes every 2^(lod_count − 1)-th gather texel per
    /// axis.
    pub lod_count: u32,
    /// Rounds of 64 rays that each texel of a cell needs before the cell shows its next LOD, ≥ 1.
    pub promote_threshold: u32,
    /// Rounds of 64 rays after which a texel is finished, at least `promote_threshold`, at most 1024.
    pub max_rounds: u32,
    /// Maximum number of rays per update, whatever its budget; 0: no limit.
    pub rays_per_update: u32,
    /// Radius of a blur for display, in gather texels; accumulated light is not blurred.
    pub blur: u32,
    /// Edge of a grid cell in scene units; 0: a sixteenth of the scene's longest side.
    pub cell_size: f32,
    /// Seed of all random numbers, as in a bake.
    pub seed: u64,
    /// Number of photons to emit, as in a bake.
    pub photon_count: u64,
    /// Maximum number of reflections, as in a bake.
    pub max_bounces: u32,
    /// Shadow rays per light map texel and area light, as in a bake.
    pub direct_samples: u32,
    /// Search radius of photons in scene units, as in a bake.
    pub radius: f32,
    /// Whether the device's threads go on working between updates.
    pub background: bool,
}

impl Default for LiveParams {
    fn default() -> Self {
        let bake = BakeParams::default();
        LiveParams {
            mode: Mode::View,
            lod_count: 3,
            promote_threshold: 1,
            max_rounds: 16,
            rays_per_update: 0,
            blur: bake.blur_radius,
            cell_size: 0.0,
            seed: bake.seed,
            photon_count: bake.photon_count,
            max_bounces: bake.max_bounces,
            direct_samples: bake.direct_samples,
            radius: bake.radius,
            background: false,
        }
    }
}

/// A perspective camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LiveCamera {
    /// Position in scene units.
    pub position: Vec3,
    /// Direction of view, of any length.
    pub forward: Vec3,
    /// Upward direction, of any length, not parallel to `forward`.
    pub up: Vec3,
    /// Vertical field of view in radians, in (0, π).
    pub fov_y: f32,
    /// Width of the picture in pixels; only the ratio to `height` matters.
    pub width: u32,
    /// Height of the picture in pixels.
    pub height: u32,
}

/// Limits of an update. With both 0 nothing is traced.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Budget {
    /// Time limit in milliseconds; 0: none.
    pub milliseconds: f32,
    /// Limit of the number of rays; 0: none.
    pub rays: u64,
}

/// Numbers about an update, and the state after it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LiveStats {
    /// Whether indirect light is being recomputed because a light has changed.
    pub light_pending: bool,
    /// Duration of the update in milliseconds.
    pub milliseconds: f32,
    /// Estimated relative error (RMS) of the indirect light that the camera sees.
    pub visible_error: f32,
    /// Fraction of all blocks that is finished.
    pub finished: f32,
    /// Fraction of the blocks in view that is finished.
    pub visible_finished: f32,
    /// Number of rays traced by the update, and in the background since the update before.
    pub rays: u64,
    /// Number of rays traced since the beginning.
    pub total_rays: u64,
    /// Number of cells that went to a higher LOD.
    pub cells_promoted: u32,
    /// Number of blocks whose shown light changed.
    pub blocks_changed: u32,
    /// Size of the live object in bytes.
    pub bytes: u64,
    /// Size in bytes with all LODs in use everywhere.
    pub bytes_full: u64,
}

/// A rectangle of texels of a page.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PageRect {
    /// Number of the page.
    pub page: u32,
    /// First column.
    pub x: u32,
    /// First row.
    pub y: u32,
    /// Number of columns.
    pub width: u32,
    /// Number of rows.
    pub height: u32,
}

/// Blocks that one pass of an update works on. More would let their light wait; fewer would leave
/// threads without work at the end of a pass.
const PASS: usize = 32;

/// Blocks that are worked on between two updates, at most.
const BACKGROUND_BLOCKS: usize = 256;

/// Part of the time budget that is left to showing what was computed and to leaving.
const SPARE: f64 = 0.15;

/// Light below this part of the scene's mean counts as dark.
const DIM: f32 = 0.02;

/// Blocks that are shown at once where all are: fewer than have a MB of texels.
const SHOWN_AT_ONCE: usize = 512;

/// Memory is announced to the monitor in steps of so many bytes.
const MEMORY_STEP: usize = 1 << 20;

/// A scene's light under refinement.
pub struct Live {
    params: LiveParams,
    bake: BakeParams,
    /// Blocks with their lights, as work on them sees them.
    context: Context,
    /// The lights that direct light is of.
    lights: Arc<Vec<Light>>,
    relight: Relight,
    blocks: Blocks,
    grid: Grid,
    promotion: Promotion,
    display: Display,
    bins: ChartBins,
    visibility: Visibility,
    chooser: Chooser,
    dirty: Dirty,
    /// Blocks to show anew.
    waiting: VecDeque<u32>,
    is_waiting: Vec<bool>,
    /// Blocks that fade to what is known, and room for those that go on fading. All blocks fit into each.
    fading: Vec<u32>,
    still_fading: Vec<u32>,
    /// Work that goes on between updates, on blocks that are then away from `blocks`.
    background: Option<Background>,
    paused: bool,
    /// Seconds that showing a block took lately: its indirect light; coarse direct light.
    refresh_seconds: f64,
    coarse_seconds: f64,
    total_rays: u64,
    /// Bytes of what never grows, and of what blocks and display have allocated since.
    fixed: usize,
    held: isize,
    bytes_full: u64,
    memory: Reservation,
}

impl LiveParams {
    /// Checks the ranges documented on the fields.
    pub fn validate(&self) -> Result<()> {
        if !(1..=MAX_LODS as u32).contains(&self.lod_count) {
            return invalid_argument!("lod_count is {}, outside 1 to {MAX_LODS}", self.lod_count);
        }
        if !(1..=1024).contains(&self.max_rounds) {
            return invalid_argument!("max_rounds is {}, outside 1 to 1024", self.max_rounds);
        }
        if !(1..=self.max_rounds).contains(&self.promote_threshold) {
            let (t, m) = (self.promote_threshold, self.max_rounds);
            return invalid_argument!("promote_threshold is {t}, outside 1 to max_rounds ({m})");
        }
        if self.blur > MAX_BLUR_RADIUS {
            return invalid_argument!("blur is {}, more than {MAX_BLUR_RADIUS}", self.blur);
        }
        self.bake().validate()
    }

    /// The bake that the updates converge to.
    pub fn bake(&self) -> BakeParams {
        BakeParams {
            photon_count: self.photon_count,
            max_bounces: self.max_bounces,
            gather_rays: self.max_rounds * ROUND as u32,
            radius: self.radius,
            blur_radius: self.blur,
            direct_samples: self.direct_samples,
            seed: self.seed,
            // What is shown changes block by block, and each block is shown as it is.
            stitch: false,
            ..Default::default()
        }
    }
}

impl Budget {
    fn is_nothing(&self) -> bool {
        self.milliseconds == 0.0 && self.rays == 0
    }

    fn validate(&self) -> Result<()> {
        if !(self.milliseconds >= 0.0 && self.milliseconds.is_finite()) {
            return invalid_argument!("the budget is {} milliseconds, not a finite number ≥ 0", self.milliseconds);
        }
        Ok(())
    }
}

impl Live {
    /// Computes the lowest LOD of everything, under the scene's lights of now. `lightmap` need not be
    /// baked and is not changed.
    pub fn new(lightmap: &Lightmap, params: &LiveParams, progress: &Progress) -> Result<Live> {
        params.validate()?;
        let device = lightmap.atlas().scene.device();
        device.run(progress, || {
            let mut live = Live::idle(lightmap, params, progress)?;
            live.start(progress)?;
            Ok(live)
        })
    }

    /// All that is needed, nothing computed but photons and radiance.
    fn idle(lightmap: &Lightmap, params: &LiveParams, progress: &Progress) -> Result<Live> {
        let atlas = lightmap.atlas();
        let bake = params.bake();
        let mut map = BlockMap::new(atlas, params.lod_count, progress)?;
        let (lower, upper) = atlas.scene.bounds();
        let grid = Grid::new(lower, upper, params.cell_size, &mut map.tiles)?;
        let lights = atlas.scene.lights();
        let light = Illumination::new(atlas, &bake, progress)?;
        progress.check()?;
        let display = Display::new(&map, params.blur)?;
        progress.check()?;
        let bins = ChartBins::new(&map)?;
        let chooser = Chooser::new(&map, &grid)?;
        let promotion = Promotion::new(&map.tiles, &grid)?;
        let fixed = map.bytes()
            + display.bytes()
            + grid.bytes()
            + promotion.bytes()
            + bins.bytes()
            + chooser.bytes()
            + light.radiance.values.len() * size_of::<Vec3>()
            // Marks, what is seen, and the queues of what is to be shown and fades.
            + map.tiles.len() * 21;
        let memory = atlas.scene.device().memory().reserve(fixed, "the live state")?;
        let all_of = |t: &Tile| t.texels.len() * size_of::<Gathered>() + t.map_texels as usize * size_of::<Vec3>();
        let full: usize = map.tiles.iter().map(all_of).sum();
        let blocks = Blocks::new(map.tiles.len())?;
        let mut waiting = VecDeque::new();
        waiting.try_reserve_exact(blocks.len()).map_err(|_| Error::OutOfMemory("the queue of blocks".into()))?;
        Ok(Live {
            visibility: Visibility::new(blocks.len())?,
            dirty: Dirty::all(atlas.info.page_count, atlas.map.layout.page_size)?,
            is_waiting: try_vec(blocks.len(), "the queue of blocks")?,
            waiting,
            fading: try_with_capacity(blocks.len(), "the queue of blocks")?,
            still_fading: try_with_capacity(blocks.len(), "the queue of blocks")?,
            bytes_full: (fixed + full) as u64,
            params: *params,
            relight: Relight::default(),
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
                samples: Arc::new(SampleSet::new(bake.gather_rays, purpose_seed(params.seed, purpose::GATHER_SET))),
                gather_seed: purpose_seed(params.seed, purpose::GATHER),
                direct_seed: purpose_seed(params.seed, purpose::DIRECT),
                direct_samples: params.direct_samples,
                direct_rays: light.direct.rays_per_point(params.direct_samples),
                dim: 0.0,
                promote_threshold: params.promote_threshold,
                max_rounds: params.max_rounds,
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

    /// The lowest LOD everywhere. To be called in the pool.
    fn start(&mut self, progress: &Progress) -> Result<()> {
        let stage = progress.stage("lowest LOD", 0.5, 0.9, self.blocks.len() as u64);
        let limit = Limit::new(None, u64::MAX);
        let context = self.context.clone();
        let top = context.map.top();
        self.blocks.par_iter_mut().zip(&context.map.tiles).try_for_each(|((status, home), tile)| {
            if !tile.texels.is_empty()
                && let Some(work) = home.take()
            {
                let mut block = Block { status: *status, work };
                block.work_on_coarse(&context, tile, &limit);
                block.work_on_indirect(&context, tile, &limit);
                // One or two texels that lie hidden inside something, or against it, tell nothing of
                // the others.
                while block.status.lod < top
                    && tile.lod_end[block.status.lod as usize] <= 2
                    && !block.work.sees_light()
                    && block.work_on_indirect(&context, tile, &limit)
                {}
                (*status, *home) = (block.status, Some(block.work));
            }
            limit.check_memory()?;
            stage.advance(1)
        })?;
        self.total_rays += limit.traced.into_inner();
        let sum: f64 = self.blocks.status().iter().map(|b| (b.mean + b.direct_mean) as f64).sum();
        self.context.dim = DIM * (sum / self.blocks.len() as f64) as f32;
        self.held = self.blocks.bytes() as isize;
        let stage = progress.stage("show", 0.9, 1.0, 2 * self.blocks.len() as u64);
        for some in in_parts(self.blocks.len()) {
            self.display.take_coarse(&context.map, &mut self.blocks, &some, |_| ());
            stage.advance(some.len() as u64)?;
        }
        for (lod, status) in self.display.lods.iter_mut().zip(self.blocks.status()) {
            *lod = status.lod;
        }
        self.reserve(0)?;
        for some in in_parts(self.blocks.len()) {
            self.display.refresh(&context.map, &self.blocks, &some, |_| ());
            stage.advance(some.len() as u64)?;
        }
        self.note_all_shown();
        Ok(())
    }

    /// Takes note of how far all blocks are, and that all pages show something else.
    fn note_all_shown(&mut self) {
        self.dirty.mark_all(self.page_size());
        self.promotion.count(&self.context.map.tiles, self.blocks.status());
        self.chooser.note_all(&self.context, self.blocks.status());
    }

    fn status(&self, b: u32) -> &BlockStatus {
        &self.blocks.status()[b as usize]
    }

    pub(crate) fn device(&self) -> Arc<Device> {
        self.context.map.atlas.scene.device().clone()
    }

    /// The scene that is lit.
    pub fn scene(&self) -> &Arc<Scene> {
        &self.context.map.atlas.scene
    }

    /// How it was made.
    pub fn params(&self) -> &LiveParams {
        &self.params
    }

    /// Refines for as long as the budget allows. Bad input is refused before anything changes.
    pub fn update(&mut self, camera: &LiveCamera, budget: &Budget) -> Result<LiveStats> {
        let start = Instant::now();
        camera.validate()?;
        budget.validate()?;
        let mut stats = LiveStats::default();
        let device = self.device();
        let result = self.collect(&mut stats).and_then(|()| {
            self.take_new_light()?;
            if !budget.is_nothing() {
                // On the pool as a whole: going there and back takes as long as a hundred rays.
                device.install(|| self.spend(start, camera, budget, &mut stats))?;
            }
            self.start_background(camera)
        });
        self.total_rays += stats.rays;
        result?;
        self.describe(&mut stats);
        stats.milliseconds = start.elapsed().as_secs_f32() * 1e3;
        Ok(stats)
    }

    /// Works until the budget is used up. To be called in the pool.
    fn spend(&mut self, start: Instant, camera: &LiveCamera, budget: &Budget, stats: &mut LiveStats) -> Result<()> {
        let seconds = budget.milliseconds as f64 * 1e-3;
        let end = (seconds > 0.0).then(|| start + Duration::from_secs_f64(seconds));
        let most_rays = [budget.rays, self.params.rays_per_update as u64].into_iter().filter(|&r| r > 0).min();
        let most_rays = most_rays.unwrap_or(u64::MAX);
        stats.rays += self.visibility.look(&self.context.map, camera);
        self.chooser.look(&self.context.map, &self.visibility);
        self.show_fading(end, stats);
        let mut traced = 0;
        let over = |traced: u64| traced >= most_rays || end.is_some_and(|e| Instant::now() >= e);
        while !over(traced) {
            // What is waiting to be shown comes first, then wrong light, then the next blocks.
            self.show_waiting(end, stats);
            let left = end.map_or(f64::INFINITY, |e| e.saturating_duration_since(Instant::now()).as_secs_f64());
            let mut step = Step::Coarse;
            let from = Choice {
                context: &self.context,
                blocks: self.blocks.status(),
                grid: &self.grid,
                visibility: &self.visibility,
            };
            let mut chosen = self.chooser.wrong(&from, ((left / self.coarse_seconds) as usize).clamp(1, PASS));
            if chosen.is_empty() {
                (step, chosen) = self.chooser.next(&from, self.params.mode, camera, PASS);
            }
            if chosen.is_empty() || over(traced) {
                break;
            }
            let spare = Duration::from_secs_f64(seconds * SPARE);
            let deadline = end.map(|e| e.checked_sub(spare).unwrap_or(e));
            traced += self.work_on(&chosen, step, Limit::new(deadline, most_rays - traced), stats)?;
        }
        self.show_waiting(end, stats);
        Ok(())
    }

    /// Works on blocks in order, each on one thread, and takes over what became of them; returns the
    /// rays traced.
    fn work_on(&mut self, chosen: &[u32], step: Step, limit: Limit, stats: &mut LiveStats) -> Result<u64> {
        self.reserve_for(chosen)?;
        let start = Instant::now();
        // Showing what is completed takes time too.
        let seconds = if step == Step::Coarse { self.coarse_seconds } else { self.refresh_seconds };
        let showing = Duration::from_secs_f64(seconds);
        let batch = Batch::new(self.context.clone(), &mut self.blocks, chosen, step, limit, showing)?;
        let (items, traced, result) = batch.run();
        self.take_over(items, stats);
        if step == Step::Coarse {
            let seconds = start.elapsed().as_secs_f64() / chosen.len() as f64;
            self.coarse_seconds += 0.2 * (seconds - self.coarse_seconds);
        }
        stats.rays += traced;
        result.map(|()| traced)
    }

    /// Puts blocks back and shows, or has shown, what became of them. To be called in the pool.
    fn take_over(&mut self, mut items: Vec<Mutex<Item>>, stats: &mut LiveStats) {
        let map = self.context.map.clone();
        let mut coarse = Vec::new();
        for item in &mut items {
            let item = inside(item);
            self.held += item.block.work.bytes() as isize - item.bytes as isize;
            self.blocks.put(item.number, std::mem::take(&mut item.block));
            if item.done.coarse {
                coarse.push(item.number);
            }
        }
        if !coarse.is_empty() {
            let dirty = &mut self.dirty;
            self.display.take_coarse(&map, &mut self.blocks, &coarse, |c| dirty.add(c));
            stats.blocks_changed += coarse.len() as u32;
        }
        for item in &mut items {
            let &mut Item { number: b, done, .. } = inside(item);
            if let Some(tile) = self.blocks.work_mut(b).and_then(|w| w.new_direct.take()) {
                let (changed, grown) = self.display.take_direct(&map, b, tile);
                self.dirty.add(changed);
                self.held += grown;
                stats.blocks_changed += 1;
            }
            if done.indirect {
                self.promote(b, stats);
            }
            self.chooser.note(&self.context, b, &self.blocks.status()[b as usize]);
        }
    }

    /// Has a block that completed a step shown: at once, or, in position-based mode, with its cell.
    fn promote(&mut self, b: u32, stats: &mut LiveStats) {
        let cell = self.context.map.tiles[b as usize].cell;
        let lod = self.status(b).lod;
        let common = self.promotion.note(b, cell, lod);
        if self.params.mode != Mode::Position {
            self.display.lods[b as usize] = lod;
            self.wait(b);
        } else if let Some(common) = common {
            stats.cells_promoted += 1;
            for i in 0..self.grid.blocks_of(cell).len() {
                let b = self.grid.blocks_of(cell)[i];
                self.display.lods[b as usize] = common;
                if self.display.begin_fade(b) {
                    self.fading.push(b);
                }
                self.wait(b);
            }
        } else if self.status(b).fresh_lod <= self.display.lods[b as usize] {
            self.wait(b);
        }
    }

    fn wait(&mut self, b: u32) {
        if !std::mem::replace(&mut self.is_waiting[b as usize], true) {
            self.waiting.push_back(b);
        }
    }

    /// Shows waiting blocks as long as there is time.
    fn show_waiting(&mut self, end: Option<Instant>, stats: &mut LiveStats) {
        while !self.waiting.is_empty() {
            let start = Instant::now();
            let left = end.map_or(f64::INFINITY, |e| e.saturating_duration_since(start).as_secs_f64());
            let fit = (left / self.refresh_seconds) as usize;
            if fit == 0 {
                // One slow moment must not keep light from being shown for ever.
                self.refresh_seconds *= 0.9;
                return;
            }
            let batch: Vec<u32> = self.waiting.drain(..fit.min(PASS).min(self.waiting.len())).collect();
            let dirty = &mut self.dirty;
            self.display.refresh(&self.context.map, &self.blocks, &batch, |c| dirty.add(c));
            for &b in &batch {
                self.is_waiting[b as usize] = false;
                let status = *self.status(b);
                let Some(block) = self.blocks.work_mut(b) else { continue };
                self.held -= block.bytes() as isize;
                block.drop_faded_prior(&status);
                self.held += block.bytes() as isize;
            }
            stats.blocks_changed += batch.len() as u32;
            let seconds = start.elapsed().as_secs_f64() / batch.len() as f64;
            self.refresh_seconds += 0.2 * (seconds - self.refresh_seconds);
        }
    }

    /// One step of the blocks that fade, as far as there is time; those left come first next time.
    fn show_fading(&mut self, end: Option<Instant>, stats: &mut LiveStats) {
        let rest = &mut self.still_fading;
        // What waits is not known to the display yet.
        self.fading.retain(|&b| {
            let waits = self.is_waiting[b as usize];
            if waits {
                rest.push(b);
            }
            !waits
        });
        let mut shown = 0;
        while shown < self.fading.len() {
            let left = end.map_or(f64::INFINITY, |e| e.saturating_duration_since(Instant::now()).as_secs_f64());
            // A fade must not take the time of all work.
            let fit = (0.5 * left / self.refresh_seconds) as usize;
            if fit == 0 {
                break;
            }
            let batch = &self.fading[shown..self.fading.len().min(shown + fit.min(PASS))];
            let dirty = &mut self.dirty;
            self.display.fade(&self.context.map, batch, |c| dirty.add(c));
            stats.blocks_changed += batch.len() as u32;
            rest.extend(batch.iter().filter(|&&b| self.display.is_fading(b)));
            shown += batch.len();
        }
        self.fading.drain(..shown);
        self.fading.append(rest);
    }

    /// Announces what work on blocks may allocate.
    fn reserve_for(&mut self, chosen: &[u32]) -> Result<()> {
        let growth = |&b: &u32| {
            let tile = &self.context.map.tiles[b as usize];
            // Direct light under way is held beside that which is shown.
            tile.texels.len() * (size_of::<Gathered>() + size_of::<Vec3>())
                + 2 * tile.map_texels as usize * size_of::<Vec3>()
        };
        self.reserve(chosen.iter().map(growth).sum())
    }

    /// Announces more bytes than are held, in steps, so that the monitor is rarely asked.
    fn reserve(&mut self, more: usize) -> Result<()> {
        let needed = self.fixed + self.held.max(0) as usize + more;
        if needed > self.memory.bytes() {
            self.memory.grow(needed.next_multiple_of(MEMORY_STEP), "live light")?;
        }
        Ok(())
    }

    /// Gives back what was announced beyond what is held.
    fn settle(&mut self) {
        let held = self.fixed + self.held.max(0) as usize;
        self.memory.shrink(held.next_multiple_of(MEMORY_STEP));
    }

    /// Has room for what the display keeps of the light of before a change, so that nothing fails when new light is
    /// there.
    fn make_room_for_epochs(&mut self) -> Result<()> {
        self.reserve(self.display.room_missing_for_epochs())?;
        let before = self.display.bytes();
        let result = self.display.make_room_for_epochs();
        let grown = self.display.bytes() - before;
        self.fixed += grown;
        self.bytes_full += grown as u64;
        result
    }

    /// Takes new indirect light over, if there is any.
    fn take_new_light(&mut self) -> Result<()> {
        if self.paused {
            return Ok(());
        }
        let Some(new) = self.relight.poll(&self.context.map.atlas, &self.bake, &self.context.light.sides)? else {
            return Ok(());
        };
        let before = self.context.light.clone();
        let renewed = before.renewed(new).inspect_err(|_| self.relight.redo())?;
        self.context.light = Arc::new(renewed);
        self.display.begin_indirect_epoch();
        if self.context.light.direct_epoch != before.direct_epoch {
            self.display.begin_direct_epoch();
            self.keep_direct_of_same_sides(&before);
        }
        self.chooser.note_all(&self.context, self.blocks.status());
        Ok(())
    }

    /// New indirect light may turn charts over; the direct light of all others stays good.
    fn keep_direct_of_same_sides(&mut self, before: &Illumination) {
        let light = self.context.light.clone();
        for (b, tile) in (0u32..).zip(&self.context.map.tiles) {
            let chart = self.context.map.atlas.gather.layout.chart_of(tile.placement) as usize;
            if before.sides.backs.get(chart) != light.sides.backs.get(chart) {
                continue;
            }
            let renew = |epoch: &mut u32| {
                let is_good = *epoch == before.direct_epoch;
                *epoch = if is_good { light.direct_epoch } else { *epoch };
                is_good
            };
            let status = &mut self.blocks.status_mut()[b as usize];
            if renew(&mut status.coarse_epoch) {
                if renew(&mut status.direct_epoch) {
                    self.display.keep_tile(b);
                }
                if let Some(work) = self.blocks.work_mut(b).and_then(|w| w.direct.as_mut()) {
                    renew(&mut work.epoch);
                }
            }
        }
    }

    /// Has the pool go on with what was seen last.
    fn start_background(&mut self, camera: &LiveCamera) -> Result<()> {
        if !self.params.background || self.paused {
            return Ok(());
        }
        let from = Choice {
            context: &self.context,
            blocks: self.blocks.status(),
            grid: &self.grid,
            visibility: &self.visibility,
        };
        let (step, mut chosen) = self.chooser.next(&from, self.params.mode, camera, BACKGROUND_BLOCKS);
        // What waits to be shown must be there for it.
        chosen.retain(|&b| !self.is_waiting[b as usize]);
        if chosen.is_empty() {
            return Ok(());
        }
        self.reserve_for(&chosen)?;
        let most_rays = Some(self.params.rays_per_update as u64).filter(|&r| r > 0).unwrap_or(u64::MAX);
        let limit = Limit::new(None, most_rays);
        let batch = Batch::new(self.context.clone(), &mut self.blocks, &chosen, step, limit, Duration::ZERO)?;
        self.background = Some(Background::start(batch, &self.device()));
        Ok(())
    }

    /// Ends work in the background and takes it over, whatever became of it.
    fn collect(&mut self, stats: &mut LiveStats) -> Result<()> {
        let Some(background) = self.background.take() else { return Ok(()) };
        let (items, traced, result) = background.finish();
        stats.rays += traced;
        let device = self.device();
        device.install(|| self.take_over(items, stats));
        result
    }

    /// [`collect`](Self::collect) outside of updates.
    fn collect_now(&mut self) -> Result<()> {
        let mut stats = LiveStats::default();
        let result = self.collect(&mut stats);
        self.total_rays += stats.rays;
        result
    }

    /// Stops work in the background, or lets it go on with the next update: refinement between
    /// updates, and the recomputation of indirect light.
    pub fn pause(&mut self, paused: bool) -> Result<()> {
        self.paused = paused;
        self.relight.hold(paused, &self.context.map.atlas, &self.bake, &self.context.light.sides)?;
        self.collect_now()
    }

    fn describe(&self, stats: &mut LiveStats) {
        let (mut error, mut light, mut marks, mut done) = (0f64, 0f64, 0.0, 0.0);
        for &b in &self.visibility.seen {
            let mark = self.visibility.mark(b);
            let block = self.status(b);
            let (part, mean) = (mark as f64, block.mean as f64);
            error += part * (block.error as f64 * mean).powi(2);
            light += part * mean * mean;
            done += if self.chooser.is_open(b) { 0.0 } else { mark };
            marks += mark;
        }
        stats.light_pending = self.relight.is_pending();
        if marks > 0.0 {
            stats.visible_error = if light > 0.0 { (error / light).sqrt() as f32 } else { 0.0 };
            stats.visible_finished = done / marks;
        }
        stats.finished = self.chooser.finished();
        stats.total_rays = self.total_rays;
        stats.bytes = (self.fixed as isize + self.held).max(0) as u64;
        stats.bytes_full = self.bytes_full;
    }

    /// Takes a change of light `id` of the scene into account: direct light in the next updates,
    /// indirect light as it is recomputed in the background.
    pub fn light_changed(&mut self, id: u32) -> Result<()> {
        let lights = self.scene().lights();
        let count = lights.len();
        if id as usize >= count {
            return invalid_argument!("light {id} does not exist, the scene has {count}");
        }
        let direct = Arc::new(DirectLight::try_new(self.scene())?);
        self.collect_now()?;
        self.make_room_for_epochs()?;
        self.relight.start(&self.context.map.atlas, &self.bake, &self.context.light.sides)?;
        // Nothing fails from here on.
        self.display.begin_direct_epoch();
        self.lights = lights;
        self.context.light = Arc::new(Illumination {
            direct,
            direct_epoch: self.context.light.direct_epoch + 1,
            ..(*self.context.light).clone()
        });
        self.chooser.note_all(&self.context, self.blocks.status());
        Ok(())
    }

    /// Removes and returns up to `capacity` rectangles whose shown light has changed since they were
    /// last taken. At first all pages are.
    pub fn take_dirty(&mut self, capacity: usize) -> Result<Vec<PageRect>> {
        let mut all = try_with_capacity(capacity.min(self.dirty.len()), "the list of changes")?;
        self.take_each_dirty(capacity, |rect| all.push(rect));
        Ok(all)
    }

    /// [`take_dirty`](Self::take_dirty), handed out one by one.
    pub fn take_each_dirty(&mut self, capacity: usize, mut put: impl FnMut(PageRect)) {
        let size = self.page_size() as i32;
        let page = Rect { x0: 0, y0: 0, x1: size, y1: size };
        let padding = self.context.map.atlas.padding as i32;
        self.dirty.take(capacity, |number, rect| {
            let r = rect.grown(padding).clipped(&page);
            let (width, height) = (r.width() as u32, r.height() as u32);
            put(PageRect { page: number, x: r.x0 as u32, y: r.y0 as u32, width, height });
        });
    }

    /// Width and height of the pages, as those of the light map.
    pub fn page_size(&self) -> u32 {
        self.context.map.atlas.map.layout.page_size
    }

    /// The light map grid, and the LOD that each of its cells shows ([`NO_LOD`]: no surfaces), x
    /// fastest.
    pub fn cell_lods(&self) -> Result<(CellInfo, Vec<u8>)> {
        let mut lods = try_vec(self.grid.info.cells(), "the LODs of cells")?;
        (0..).zip(&mut lods).for_each(|(c, lod)| *lod = self.grid.lod(c, &self.display.lods));
        Ok((self.grid.info, lods))
    }

    /// The LOD shown at a position; `None` outside the grid and in cells without surfaces.
    pub fn lod_at(&self, position: Vec3) -> Option<u8> {
        let info = &self.grid.info;
        let lod = info.contains(position).then(|| self.grid.lod(info.cell(position), &self.display.lods));
        lod.filter(|&l| l != NO_LOD)
    }

    #[doc(hidden)]
    /// Sums and rays of every gather texel, by sample: the part of the state that bakes share. For
    /// tests.
    pub fn sums(&mut self) -> Result<Vec<([f32; 3], u32)>> {
        self.collect_now()?;
        let mut sums = try_vec(self.context.map.atlas.gather.len(), "the sums of texels")?;
        for (b, tile) in (0..).zip(&self.context.map.tiles) {
            let gathered = self.blocks.work(b).map_or(&[][..], |w| &w.gathered);
            for (&s, g) in tile.texels.iter().zip(gathered) {
                sums[s as usize] = (g.sum.to_array(), g.rays);
            }
        }
        Ok(sums)
    }

    /// Waits for indirect light that is being recomputed and takes it over.
    pub fn finish_relighting(&mut self) -> Result<()> {
        self.collect_now()?;
        while self.relight.is_pending() && !self.paused {
            self.take_new_light()?;
            std::thread::sleep(Duration::from_millis(1));
        }
        Ok(())
    }
}

/// What nobody else has a lock on.
fn inside<T>(of: &mut Mutex<T>) -> &mut T {
    of.get_mut().unwrap_or_else(|e| e.into_inner())
}

/// The numbers of all blocks, in parts that are shown at once.
fn in_parts(blocks: usize) -> impl Iterator<Item = Vec<u32>> {
    let end = blocks as u32;
    (0..end).step_by(SHOWN_AT_ONCE).map(move |first| (first..end).take(SHOWN_AT_ONCE).collect())
}

impl Drop for Live {
    fn drop(&mut self) {
        if let Some(background) = self.background.take() {
            if self.device().check_process().is_err() {
                // The threads that it waits for are in another process.
                std::mem::forget(background);
            } else {
                // Nothing is lost if this is the end of it.
                let _ = background.finish();
            }
        }
        // Before the scene is let go: its last reference then ends here, not on the thread that relights.
        drop(std::mem::take(&mut self.relight));
    }
}
