//! Live updates (thesis 3.3): coarse light at once, refined while somebody walks through the scene,
//! within a time budget per frame, and relit when lights change.
//!
//! Creating a [`Live`] object computes photons and radiance map as a bake does, and the texels of the
//! lowest LOD. Each update then works on [`blocks`] of texels: in view-based mode (3.3.1) on those
//! that the camera sees, where estimated error times visibility is largest; in position-based mode
//! (3.3.2) on the cells of the light map grid that are near, visible ones first. The thesis picks
//! texels at random and lets neighbouring cells of different LOD show their border; here the texels
//! of a LOD are among those of the next and what lies between is interpolated across cells.
//!
//! A texel's sums depend on its number of rounds alone. When all texels have k rounds they have the
//! bits of a bake with 64 · k gather rays, whatever the order of the updates.

mod blocks;
mod cells;
mod dirty;
mod display;
mod relight;
mod visibility;
mod work;

pub use blocks::MAX_LODS;
pub use cells::{CellInfo, NO_LOD};

use crate::error::{Result, invalid_argument};
use crate::lightmap::bake::purpose;
use crate::lightmap::gather::{ROUND, SampleSet};
use crate::lightmap::{Atlas, BakeParams, Lightmap, blur::MAX_BLUR_RADIUS};
use crate::memory::Reservation;
use crate::progress::Progress;
use crate::sampling::{combine, mix, purpose_seed};
use crate::scene::{NONE, Scene};
use blocks::{Block, BlockIndex, Rect};
use cells::Grid;
use dirty::Dirty;
use display::Display;
use glam::Vec3;
use rayon::prelude::*;
use relight::{Illumination, Relight};
use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering::Relaxed};
use std::time::{Duration, Instant};
use visibility::Visibility;
use work::{Context, Done, Limit};

/// Which blocks updates work on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// What the camera sees.
    View,
    /// What is near the camera, visible or not, cell by cell.
    Position,
    /// Anywhere, at random: for comparison.
    Uniform,
}

/// How to update.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LiveParams {
    pub mode: Mode,
    /// 1 to [`MAX_LODS`]. The lowest LOD computes every 2^(lod_count − 1)-th gather texel per axis.
    pub lod_count: u32,
    /// Rounds of 64 rays that a texel needs before its cell shows the next LOD, ≥ 1.
    pub promote_threshold: u32,
    /// Rounds per texel after which it is finished, at least `promote_threshold`, at most 1024.
    pub max_rounds: u32,
    /// Rays per update at most, whatever the budget; 0: no limit.
    pub rays_per_update: u32,
    /// Blur radius in gather texels, for display alone.
    pub blur: u32,
    /// Edge of a grid cell in scene units; 0: a sixteenth of the scene's longest side.
    pub cell_size: f32,
    pub seed: u64,
    /// As in a bake.
    pub photon_count: u64,
    pub max_bounces: u32,
    pub direct_samples: u32,
    pub radius: f32,
    /// The device's threads go on working between updates.
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

/// Where somebody looks from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LiveCamera {
    pub position: Vec3,
    /// Any length.
    pub forward: Vec3,
    /// Any length, not parallel to `forward`.
    pub up: Vec3,
    /// Vertical field of view in radians, in (0, π).
    pub fov_y: f32,
    pub width: u32,
    pub height: u32,
}

/// What an update may take. Both 0: nothing is traced.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Budget {
    /// 0: no limit by time.
    pub milliseconds: f32,
    /// 0: no limit by rays.
    pub rays: u64,
}

/// What an update did, and how things stand.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LiveStats {
    /// Indirect light is being recomputed because a light has changed.
    pub light_pending: bool,
    /// That the update took.
    pub milliseconds: f32,
    /// Estimated relative error of indirect light where the camera looks.
    pub visible_error: f32,
    /// Part of the blocks that are finished, of all and of those that the camera sees.
    pub finished: f32,
    pub visible_finished: f32,
    /// Traced by the update, and since the beginning.
    pub rays: u64,
    pub total_rays: u64,
    pub cells_promoted: u32,
    /// Blocks whose shown light changed.
    pub blocks_changed: u32,
    /// Held now, and with all LODs allocated everywhere.
    pub bytes: u64,
    pub bytes_full: u64,
}

/// A rectangle of texels of a page.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PageRect {
    pub page: u32,
    pub x: u32,
    pub y: u32,
    pub width: u32,
    pub height: u32,
}

/// Blocks that one pass of an update works on. More would let their light wait; fewer would leave
/// threads without work at the end of a pass.
const PASS: usize = 32;

/// Part of the time budget that is left to showing what was computed and to leaving.
const SPARE: f64 = 0.15;

/// A scene's light under refinement.
pub struct Live {
    atlas: Arc<Atlas>,
    params: LiveParams,
    bake: BakeParams,
    light: Illumination,
    relight: Relight,
    samples: SampleSet,
    index: BlockIndex,
    blocks: Vec<Block>,
    grid: Grid,
    display: Display,
    visibility: Visibility,
    dirty: Dirty,
    /// Blocks to show anew.
    waiting: VecDeque<u32>,
    is_waiting: Vec<bool>,
    /// Seconds that showing a block took lately.
    refresh_seconds: f64,
    updates: u32,
    total_rays: u64,
    bytes_full: u64,
    _memory: Reservation,
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
            ..Default::default()
        }
    }
}

impl Budget {
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
        let atlas = lightmap.atlas().clone();
        let bake = params.bake();
        let (index, mut blocks) = BlockIndex::new(&atlas, params.lod_count);
        let (lower, upper) = atlas.scene.bounds();
        let grid = Grid::new(lower, upper, params.cell_size, &mut blocks)?;
        let light = Illumination::new(&atlas, &bake, progress)?;
        let display = Display::new(&atlas, params.blur)?;
        let seed = purpose_seed(params.seed, purpose::GATHER_SET);
        let block_bytes: usize = blocks.iter().map(Block::bytes).sum();
        let fixed = display.bytes() + index.bytes() + grid.bytes() + block_bytes + blocks.len() * size_of::<Block>();
        let memory = atlas.scene.device().memory().reserve(fixed, "the live state")?;
        let full = atlas.gather.len() * size_of::<crate::lightmap::gather::Gathered>() + atlas.map.len() * 12;
        let mut live = Live {
            visibility: Visibility::new(blocks.len()),
            dirty: Dirty::all(atlas.info.page_count, atlas.map.layout.page_size),
            is_waiting: vec![false; blocks.len()],
            waiting: VecDeque::new(),
            samples: SampleSet::new(bake.gather_rays, seed),
            bytes_full: (fixed + full) as u64,
            params: *params,
            relight: Relight::default(),
            refresh_seconds: 1e-4,
            updates: 0,
            total_rays: 0,
            _memory: memory,
            atlas,
            bake,
            light,
            index,
            blocks,
            grid,
            display,
        };
        live.start(progress)?;
        Ok(live)
    }

    /// The lowest LOD everywhere.
    fn start(&mut self, progress: &Progress) -> Result<()> {
        self.light_coarsely();
        let stage = progress.stage("lowest LOD", 0.5, 1.0, self.blocks.len() as u64);
        let limit = Limit { deadline: None, rays: u64::MAX, traced: AtomicU64::new(0) };
        let mut blocks = std::mem::take(&mut self.blocks);
        let context = self.context();
        let result = self.atlas.scene.device().install(|| {
            blocks.par_iter_mut().try_for_each(|block| {
                block.work_on_indirect(&context, &limit);
                stage.advance(1)
            })
        });
        self.blocks = blocks;
        result?;
        self.total_rays += limit.traced.into_inner();
        let all: Vec<u32> = (0..self.blocks.len() as u32).collect();
        let device = self.atlas.scene.device();
        self.display.refresh(device, &self.atlas, &self.index, &self.blocks, &all);
        Ok(())
    }

    /// Direct light of the lowest LOD's texels, for all blocks that have no better.
    fn light_coarsely(&mut self) {
        let context = self.context();
        let samples = self.params.direct_samples.min(4);
        let texel = |&s: &u32| {
            let receiver = self.atlas.receiver(&self.atlas.gather, &self.light.backs, s as usize);
            (s, self.light.direct.irradiance(&receiver, samples, combine(context.direct_seed, s), &mut 0))
        };
        let of_block = |b: &Block| b.texels[..b.lod_end[0] as usize].iter().map(texel).collect::<Vec<_>>();
        let device = self.atlas.scene.device();
        let known: Vec<(u32, Vec3)> = device.install(|| self.blocks.par_iter().flat_map_iter(of_block).collect());
        self.display.spread_direct(device, &self.atlas, &self.index, &self.blocks, &known);
    }

    fn context(&self) -> Context<'_> {
        Context {
            atlas: &self.atlas,
            light: &self.light,
            samples: &self.samples,
            gather_seed: purpose_seed(self.params.seed, purpose::GATHER),
            direct_seed: purpose_seed(self.params.seed, purpose::DIRECT),
            direct_samples: self.params.direct_samples,
            top: self.index.top(),
            promote_threshold: self.params.promote_threshold,
            max_rounds: self.params.max_rounds,
        }
    }

    /// The scene that is lit.
    pub fn scene(&self) -> &Arc<Scene> {
        &self.atlas.scene
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
        if let Some(new) = self.relight.poll(&self.atlas, &self.bake)? {
            self.light.renew(new);
        }
        let rays = match (budget.rays, self.params.rays_per_update as u64) {
            (0, 0) if budget.milliseconds > 0.0 => u64::MAX,
            (0, 0) => 0,
            (0, r) | (r, 0) => r,
            (a, b) => a.min(b),
        };
        let idle = budget.milliseconds == 0.0 && budget.rays == 0;
        let end =
            (budget.milliseconds > 0.0).then(|| start + Duration::from_secs_f64(budget.milliseconds as f64 * 1e-3));
        let mut stats = LiveStats::default();
        let mut limit = Limit { deadline: end, rays: if idle { 0 } else { rays }, traced: AtomicU64::new(0) };
        if !idle {
            let looked = self.visibility.look(&self.atlas, &self.index, camera);
            *limit.traced.get_mut() += looked;
        }
        while !idle && !limit.reached() {
            // What is waiting to be shown comes first, then the next blocks.
            self.show_waiting(end, &mut stats);
            let chosen = self.choose(camera);
            if chosen.is_empty() || limit.reached() {
                break;
            }
            let spare = Duration::from_secs_f64(budget.milliseconds as f64 * 1e-3 * SPARE);
            limit.deadline = end.map(|e| e.checked_sub(spare).unwrap_or(e));
            self.work_on(&chosen, &limit, &mut stats);
            limit.deadline = end;
        }
        self.show_waiting(end, &mut stats);
        self.updates = self.updates.wrapping_add(1);
        stats.rays = limit.traced.into_inner();
        self.total_rays += stats.rays;
        self.describe(&mut stats);
        stats.milliseconds = start.elapsed().as_secs_f32() * 1e3;
        Ok(stats)
    }

    /// The next blocks to work on, the most urgent first.
    fn choose(&self, camera: &LiveCamera) -> Vec<u32> {
        let context = self.context();
        let open =
            |b: &u32| !self.blocks[*b as usize].texels.is_empty() && !self.blocks[*b as usize].is_finished(&context);
        let urgency = |b: u32| {
            let block = &self.blocks[b as usize];
            // Wrong direct light is what is seen first, then missing detail.
            let error = if block.has_direct(&context) { block.error.max(1e-4) } else { 100.0 };
            self.visibility.mark(b) * error
        };
        let mut keyed: Vec<(f32, u32)> = match self.params.mode {
            Mode::View => self.visibility.seen.iter().copied().filter(open).map(|b| (urgency(b), b)).collect(),
            Mode::Uniform => {
                let n = self.blocks.len() as u32;
                let random = |i: u32| mix(combine(self.updates, i)) % n.max(1);
                (0..PASS as u32).map(random).filter(open).map(|b| (1.0, b)).collect()
            }
            Mode::Position => return self.choose_by_cell(camera, &open),
        };
        if keyed.len() > PASS {
            keyed.select_nth_unstable_by(PASS, |a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
            keyed.truncate(PASS);
        }
        keyed.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        keyed.dedup_by_key(|k| k.1);
        keyed.into_iter().map(|k| k.1).collect()
    }

    /// Blocks of the cell that is next: visible cells before hidden ones, near before far, where each
    /// LOD that a cell has makes it twice as far.
    fn choose_by_cell(&self, camera: &LiveCamera, open: &impl Fn(&u32) -> bool) -> Vec<u32> {
        let mut seen = vec![false; self.blocks.len()];
        let mut visible = std::collections::HashSet::new();
        for &b in &self.visibility.seen {
            seen[b as usize] = true;
            visible.insert(self.blocks[b as usize].cell);
        }
        let top = self.index.top() as u32;
        let progress = |b: &u32| {
            let block = &self.blocks[*b as usize];
            block.lod as u32 + if block.lod as u32 == top { block.rounds as u32 } else { 0 }
        };
        let mut cells: Vec<(bool, f32, u32)> = self
            .grid
            .occupied
            .iter()
            .filter_map(|&cell| {
                let least = self.grid.blocks_of(cell).iter().filter(|b| open(b)).map(progress).min()?;
                let away = self.grid.info.distance(cell, camera.position) + self.grid.info.cell_size;
                Some((!visible.contains(&cell), away * (1u64 << least.min(40)) as f32, cell))
            })
            .collect();
        cells.sort_unstable_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)).then(a.2.cmp(&b.2)));
        let mut chosen = Vec::new();
        for &(_, _, cell) in &cells {
            // The least advanced of the cell first: it is promoted as a whole.
            let mut of_cell: Vec<u32> = self.grid.blocks_of(cell).iter().copied().filter(open).collect();
            of_cell.sort_by_key(|b| (progress(b), !seen[*b as usize]));
            chosen.extend(of_cell);
            if chosen.len() >= PASS {
                break;
            }
        }
        chosen.truncate(PASS);
        chosen
    }

    /// Works on blocks in order, each on one thread.
    fn work_on(&mut self, chosen: &[u32], limit: &Limit, stats: &mut LiveStats) {
        let items: Vec<Mutex<(Block, Done)>> = chosen
            .iter()
            .map(|&b| Mutex::new((std::mem::take(&mut self.blocks[b as usize]), Done::default())))
            .collect();
        let next = AtomicUsize::new(0);
        let context = self.context();
        // Showing what is completed takes time too, which is kept free.
        let completed = AtomicUsize::new(0);
        let reserve = self.refresh_seconds;
        self.atlas.scene.device().install(|| {
            rayon::broadcast(|_| {
                while let Some(item) = items.get(next.fetch_add(1, Relaxed)) {
                    let soon = Duration::from_secs_f64(reserve * completed.load(Relaxed) as f64);
                    if limit.reached() || limit.deadline.is_some_and(|d| Instant::now() + soon >= d) {
                        break;
                    }
                    let mut item = item.lock().unwrap_or_else(|e| e.into_inner());
                    let done = item.0.work(&context, limit);
                    item.1 = done;
                    completed.fetch_add((done.direct || done.indirect) as usize, Relaxed);
                }
            })
        });
        for (&b, item) in chosen.iter().zip(items) {
            let (block, done) = item.into_inner().unwrap_or_else(|e| e.into_inner());
            self.blocks[b as usize] = block;
            if done.direct {
                self.dirty.add(Display::direct_rect(&self.atlas, &self.blocks[b as usize]));
                stats.blocks_changed += 1;
            }
            if done.indirect {
                self.promote(b, stats);
            }
        }
    }

    /// Has a block that completed a step shown: at once, or, in position-based mode, with its cell.
    fn promote(&mut self, b: u32, stats: &mut LiveStats) {
        let (cell, lod) = (self.blocks[b as usize].cell, self.blocks[b as usize].lod);
        if self.params.mode != Mode::Position || lod == self.blocks[b as usize].shown_lod {
            self.blocks[b as usize].shown_lod = lod;
            self.wait(b);
            return;
        }
        let of_cell = self.grid.blocks_of(cell).to_vec();
        let common = of_cell.iter().map(|&b| self.blocks[b as usize].lod).min().unwrap_or(0);
        if of_cell.iter().any(|&b| self.blocks[b as usize].shown_lod < common) {
            stats.cells_promoted += 1;
            for b in of_cell {
                self.blocks[b as usize].shown_lod = common;
                self.wait(b);
            }
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
                return;
            }
            let batch: Vec<u32> = self.waiting.drain(..fit.min(PASS).min(self.waiting.len())).collect();
            let device = self.atlas.scene.device();
            let changed = self.display.refresh(device, &self.atlas, &self.index, &self.blocks, &batch);
            changed.into_iter().for_each(|c| self.dirty.add(c));
            for &b in &batch {
                self.is_waiting[b as usize] = false;
                self.blocks[b as usize].drop_faded_prior();
            }
            stats.blocks_changed += batch.len() as u32;
            let seconds = start.elapsed().as_secs_f64() / batch.len() as f64;
            self.refresh_seconds += 0.2 * (seconds - self.refresh_seconds);
        }
    }

    fn describe(&self, stats: &mut LiveStats) {
        let context = self.context();
        let finished = |b: &Block| (b.texels.is_empty() || b.is_finished(&context)) as u32 as f32;
        let (mut error, mut marks, mut done) = (0.0, 0.0, 0.0);
        for &b in &self.visibility.seen {
            let (mark, block) = (self.visibility.mark(b), &self.blocks[b as usize]);
            error += mark * block.error.powi(2);
            done += mark * finished(block);
            marks += mark;
        }
        stats.light_pending = self.relight.is_pending();
        if marks > 0.0 {
            stats.visible_error = (error / marks).sqrt();
            stats.visible_finished = done / marks;
        }
        stats.finished = self.blocks.iter().map(finished).sum::<f32>() / self.blocks.len().max(1) as f32;
        stats.total_rays = self.total_rays;
        let blocks: usize = self.blocks.iter().map(Block::bytes).sum();
        let structures = self.blocks.len() * size_of::<Block>() + self.visibility.bytes();
        let fixed = self.display.bytes() + self.index.bytes() + self.grid.bytes();
        stats.bytes = (blocks + structures + fixed) as u64;
        stats.bytes_full = self.bytes_full;
    }

    /// Takes a change of light `id` of the scene into account: direct light in the next updates,
    /// indirect light as it is recomputed in the background.
    pub fn light_changed(&mut self, id: u32) -> Result<()> {
        let count = self.atlas.scene.lights().len();
        if id as usize >= count {
            return invalid_argument!("light {id} does not exist, the scene has {count}");
        }
        self.relight.start(&self.atlas, &self.bake)?;
        self.light.direct = crate::lightmap::direct::DirectLight::new(&self.atlas.scene);
        self.light.direct_epoch += 1;
        Ok(())
    }

    /// Removes and returns up to `capacity` rectangles whose shown light has changed since they were
    /// last taken. At first all pages are.
    pub fn take_dirty(&mut self, capacity: usize) -> Vec<PageRect> {
        let size = self.atlas.map.layout.page_size as i32;
        let page = Rect { x0: 0, y0: 0, x1: size, y1: size };
        let padding = self.atlas.padding as i32;
        let rect = |(number, rect): (u32, Rect)| {
            let r = rect.grown(padding).clipped(&page);
            let (width, height) = (r.width() as u32, r.height() as u32);
            PageRect { page: number, x: r.x0 as u32, y: r.y0 as u32, width, height }
        };
        self.dirty.take(capacity).into_iter().map(rect).collect()
    }

    /// Irradiance shown in a rectangle of a page, row by row; `with_direct` false: indirect light
    /// alone. Texels around charts repeat the nearest of the chart, up to the padding.
    pub fn read(&self, rect: &PageRect, with_direct: bool) -> Result<Vec<[f32; 3]>> {
        let size = self.atlas.map.layout.page_size;
        let (right, bottom) = (rect.x as u64 + rect.width as u64, rect.y as u64 + rect.height as u64);
        if rect.page >= self.atlas.info.page_count || right > size as u64 || bottom > size as u64 {
            let pages = self.atlas.info.page_count;
            return invalid_argument!("{rect:?} is not within the {pages} pages of {size} × {size} texels");
        }
        let mut out = crate::memory::try_vec::<[f32; 3]>(rect.width as usize * rect.height as usize, "a page")?;
        let r = Rect { x0: rect.x as i32, y0: rect.y as i32, x1: right as i32, y1: bottom as i32 };
        let padding = self.atlas.padding as i32;
        let shown: Vec<(u32, Rect)> = (0..self.atlas.charts.charts.len() as u32)
            .filter_map(|chart| {
                let p = &self.atlas.map.layout.placements[chart as usize];
                let (x0, y0) = (p.x as i32, p.y as i32);
                let own = Rect { x0, y0, x1: x0 + p.w as i32, y1: y0 + p.h as i32 }.grown(padding).clipped(&r);
                (p.page == rect.page && own.width() * own.height() > 0).then_some((chart, own))
            })
            .collect();
        let (atlas, index, blocks, display) = (&self.atlas, &self.index, &self.blocks, &self.display);
        let value = |chart: u32, x: i32, y: i32| -> Option<(u32, bool)> {
            let own = |x: i32, y: i32| {
                let s = atlas.map.at(chart, x, y);
                let is_own =
                    |s: u32| atlas.charts.chart_of[atlas.map.texels.samples[s as usize].triangle as usize] == chart;
                (s != NONE && is_own(s)).then_some(s)
            };
            if let Some(s) = own(x, y) {
                return Some((s, true));
            }
            // Around the chart: the nearest texel within the padding.
            let around = Rect { x0: x, y0: y, x1: x + 1, y1: y + 1 }.grown(padding);
            let near = around.texels().filter_map(|(i, j)| own(i, j).map(|s| ((i - x).pow(2) + (j - y).pow(2), s)));
            near.min().map(|(_, s)| (s, false))
        };
        let lit: Vec<Vec<(usize, Vec3, bool)>> = atlas.scene.device().install(|| {
            shown
                .par_iter()
                .map(|&(chart, own)| {
                    let texel = |(x, y): (i32, i32)| {
                        let (s, is_own) = value(chart, x, y)?;
                        let at = (y - r.y0) as usize * r.width() + (x - r.x0) as usize;
                        Some((at, display.irradiance(atlas, index, blocks, s, with_direct), is_own))
                    };
                    own.texels().filter_map(texel).collect()
                })
                .collect()
        });
        let mut is_set = vec![false; out.len()];
        for (at, value, is_own) in lit.into_iter().flatten() {
            if is_own || !is_set[at] {
                out[at] = value.to_array();
                is_set[at] |= is_own;
            }
        }
        Ok(out)
    }

    /// Width and height of the pages, as those of the light map.
    pub fn page_size(&self) -> u32 {
        self.atlas.map.layout.page_size
    }

    /// The light map grid, and the LOD that each of its cells shows ([`NO_LOD`]: no surfaces), x
    /// fastest.
    pub fn cell_lods(&self) -> (CellInfo, Vec<u8>) {
        let cells = self.grid.info.dimensions.iter().product::<u32>();
        (self.grid.info, (0..cells).map(|c| self.grid.lod(c, &self.blocks)).collect())
    }

    /// The LOD shown at a position; `None` outside the grid and in cells without surfaces.
    pub fn lod_at(&self, position: Vec3) -> Option<u8> {
        let lod = self.grid.info.contains(position).then(|| self.grid.lod(self.grid.info.cell(position), &self.blocks));
        lod.filter(|&l| l != NO_LOD)
    }

    /// Sums and rays of every gather texel, by sample: the part of the state that bakes share. For
    /// tests.
    pub fn sums(&self) -> Vec<([f32; 3], u32)> {
        let mut sums = vec![([0.0; 3], 0); self.atlas.gather.len()];
        for block in &self.blocks {
            for (&s, g) in block.texels.iter().zip(&block.gathered) {
                sums[s as usize] = (g.sum.to_array(), g.rays);
            }
        }
        sums
    }

    /// Waits for indirect light that is being recomputed and takes it over.
    pub fn finish_relighting(&mut self) -> Result<()> {
        while self.relight.is_pending() {
            if let Some(new) = self.relight.poll(&self.atlas, &self.bake)? {
                self.light.renew(new);
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        Ok(())
    }
}
