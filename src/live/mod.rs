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
//! bits of a bake with 64 · k gather rays, without stitching and with an `interpolation_contrast` of infinity, whatever the
//! order of the updates.

mod background;
mod batch;
mod blocks;
mod carry;
mod cells;
mod choose;
mod create;
mod dirty;
mod display;
mod follow;
mod illumination;
mod limit;
mod lists;
mod params;
mod readback;
mod relight;
mod room;
mod save;
mod show;
mod shown_layer;
mod visibility;
mod work;
mod work_on_direct;

pub use blocks::MAX_LODS;
pub use cells::{CellInfo, NO_LOD};
pub use params::{Budget, LiveCamera, LiveParams, LiveStats, Mode, PageRect};

use crate::base::error::Result;
use crate::base::memory::Reservation;
use crate::device::Device;
use crate::lightmap::BakeParams;
use crate::scene::{Light, Scene};
use batch::{Background, Batch, Item};
use blocks::{BlockStatus, Blocks, Rect};
use cells::{Grid, Promotion};
use choose::{Choice, Chooser};
use dirty::Dirty;
use display::Display;
use limit::Limit;
use readback::{ChartBins, ReadingTime};
use relight::Relight;
use room::Room;
use show::{MARKED_AT_ONCE, Marking};
use std::collections::VecDeque;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use visibility::Visibility;
use work::{Context, Step};

/// Number of blocks that one pass of an update works on. With more, their light would be shown later; with fewer,
/// threads would be without work at the end of a pass.
const PASS: usize = 32;

/// Fraction of the time budget that is reserved for showing results and for returning.
const SPARE: f64 = 0.15;

/// Number of blocks that are shown at a time when all are: their texels take less than a MB.
const SHOWN_AT_ONCE: usize = 512;

/// Memory is announced to the monitor in steps of this many bytes.
const MEMORY_STEP: usize = 1 << 20;

/// Live light of a scene, refined by updates.
pub struct Live {
    params: LiveParams,
    bake: BakeParams,
    /// Blocks with their light, as needed by work on them.
    context: Context,
    /// The lights under which direct light is computed.
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
    reading: ReadingTime,
    /// Recent duration in seconds of choosing the rectangles that are given out.
    choosing_seconds: f64,
    /// Bytes that the last update gave out.
    last_dirty_bytes: u64,
    /// Rectangle of each block's texels that gather for themselves, in the light map.
    alone: Vec<Rect>,
    /// What new indirect light changes and is not marked yet.
    marking: Option<Marking>,
    /// Queue of blocks whose shown light must be refreshed.
    waiting: VecDeque<u32>,
    is_waiting: Vec<bool>,
    /// By block, whether a change of the scene has changed its light, until indirect light with all photons has followed;
    /// empty before the first change.
    is_stale: Vec<bool>,
    /// Blocks that are fading, and a buffer for those that go on fading. Each has capacity for all blocks.
    fading: Vec<u32>,
    still_fading: Vec<u32>,
    /// Work that goes on between updates, on blocks that are then away from `blocks`.
    background: Option<Background>,
    paused: bool,
    /// Recent duration in seconds of showing a block: its indirect light; coarse direct light.
    refresh_seconds: f64,
    coarse_seconds: f64,
    total_rays: u64,
    /// Bytes held by buffers that never grow, and those allocated since by blocks and display.
    fixed: usize,
    held: isize,
    bytes_full: u64,
    memory: Reservation,
}

impl Live {
    fn status(&self, b: u32) -> &BlockStatus {
        &self.blocks.status()[b as usize]
    }

    pub(crate) fn device(&self) -> Arc<Device> {
        self.context.map.atlas.scene.device().clone()
    }

    /// The scene whose light this is.
    pub fn scene(&self) -> &Arc<Scene> {
        &self.context.map.atlas.scene
    }

    /// The parameters it was created with.
    pub fn params(&self) -> &LiveParams {
        &self.params
    }

    /// Refines for as long as the budget allows. Bad input is refused before anything changes.
    pub fn update(&mut self, camera: &LiveCamera, budget: &Budget) -> Result<LiveStats> {
        let start = Instant::now();
        camera.validate()?;
        budget.validate()?;
        let mut stats = LiveStats::default();
        let _way = self.relight.make_way();
        self.reading.settle();
        let device = self.device();
        let seconds = budget.milliseconds as f64 * 1e-3;
        let end = (seconds > 0.0).then(|| start + Duration::from_secs_f64(seconds));
        let mut kept = 0.0;
        let result = self.collect(&mut stats).and_then(|()| {
            self.take_new_light()?;
            self.mark_new_light(MARKED_AT_ONCE);
            if !budget.is_nothing() {
                kept = self.reading_seconds(budget);
                let spare = Duration::from_secs_f64(self.choosing_seconds + kept);
                let end = end.map(|e| e.checked_sub(spare).unwrap_or(start));
                // Enters the pool once per update: each entry takes as long as a hundred rays.
                device.install(|| self.spend(end, camera, budget, &mut stats))?;
            }
            Ok(())
        });
        self.give_out(budget, end, kept);
        let result = result.and_then(|()| self.start_background(camera));
        self.total_rays += stats.rays;
        result?;
        self.describe(&mut stats);
        stats.milliseconds = start.elapsed().as_secs_f32() * 1e3;
        Ok(stats)
    }

    /// Works until the budget is used up. It must be called in the pool.
    fn spend(
        &mut self,
        end: Option<Instant>,
        camera: &LiveCamera,
        budget: &Budget,
        stats: &mut LiveStats,
    ) -> Result<()> {
        let seconds = budget.milliseconds as f64 * 1e-3;
        let most_rays = [budget.rays, self.params.rays_per_update as u64].into_iter().filter(|&r| r > 0).min();
        let most_rays = most_rays.unwrap_or(u64::MAX);
        stats.rays += self.visibility.look(&self.context.map, camera);
        self.chooser.look(&self.context.map, &self.visibility);
        self.show_fading(end, stats);
        let mut traced = 0;
        let over = |traced: u64| traced >= most_rays || end.is_some_and(|e| Instant::now() >= e);
        while !over(traced) {
            // Blocks that wait to be shown come first, then wrong direct light, then the next blocks.
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
            traced += self.work_on(&chosen, step, Limit::new(deadline, most_rays - traced, Room::TEXELS), stats)?;
        }
        self.show_waiting(end, stats);
        Ok(())
    }

    /// Works on blocks in order, each on one thread, and takes over their results; returns the number of rays traced.
    fn work_on(&mut self, chosen: &[u32], step: Step, limit: Limit, stats: &mut LiveStats) -> Result<u64> {
        self.reserve_for(chosen)?;
        let start = Instant::now();
        // Showing completed blocks takes time too.
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

    /// Puts blocks back and shows their results or queues them to be shown. It must be called in the pool.
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

    /// Announces the memory that work on blocks may allocate.
    fn reserve_for(&mut self, chosen: &[u32]) -> Result<()> {
        let growth = |&b: &u32| {
            let tile = &self.context.map.tiles[b as usize];
            // Direct light under way is held beside the shown one.
            tile.texels.len() * (self.params.gathered_bytes() + self.params.shown_bytes())
                + 2 * tile.map_texels as usize * self.params.direct_bytes()
        };
        self.reserve(chosen.iter().map(growth).sum())
    }

    /// Announces more bytes than are held, in steps, so that the monitor is called rarely.
    fn reserve(&mut self, more: usize) -> Result<()> {
        let needed = self.fixed + self.held.max(0) as usize + more;
        if needed > self.memory.bytes() {
            self.memory.grow(needed.next_multiple_of(MEMORY_STEP), "live light")?;
        }
        Ok(())
    }

    /// Returns the announced bytes that are not held.
    fn settle(&mut self) {
        let held = self.fixed + self.held.max(0) as usize;
        self.memory.shrink(held.next_multiple_of(MEMORY_STEP));
    }

    /// Allocates the buffers in which the display keeps the light from before a change, so that taking over new light
    /// cannot fail.
    fn make_room_for_epochs(&mut self) -> Result<()> {
        self.reserve(self.display.room_missing_for_epochs())?;
        let before = self.display.bytes();
        let result = self.display.make_room_for_epochs();
        let grown = self.display.bytes() - before;
        self.fixed += grown;
        self.bytes_full += grown as u64;
        result
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
        stats.light_pending = self.is_light_pending();
        if marks > 0.0 {
            stats.visible_error = if light > 0.0 { (error / light).sqrt() as f32 } else { 0.0 };
            stats.visible_finished = done / marks;
        }
        stats.finished = self.chooser.finished();
        stats.total_rays = self.total_rays;
        stats.dirty_bytes = self.dirty.bytes_out();
        stats.dirty_bytes_left = self.dirty.bytes_left();
        stats.bytes = (self.fixed as isize + self.held).max(0) as u64;
        stats.bytes_full = self.bytes_full;
    }
}

/// The content of a mutex on which nobody else has a lock.
fn inside<T>(of: &mut Mutex<T>) -> &mut T {
    of.get_mut().unwrap_or_else(|e| e.into_inner())
}

/// The numbers of all blocks, in parts that are shown at a time.
fn in_parts(blocks: usize) -> impl Iterator<Item = Vec<u32>> {
    let end = blocks as u32;
    (0..end).step_by(SHOWN_AT_ONCE).map(move |first| (first..end).take(SHOWN_AT_ONCE).collect())
}
