//! Which blocks are worked on next.

use super::blocks::{BlockMap, BlockStatus};
use super::cells::Grid;
use super::visibility::Visibility;
use super::work::{Context, Step};
use super::{LiveCamera, Mode};
use crate::base::memory::{try_filled, try_vec, try_with_capacity};
use crate::base::sampling::{combine, mix};
use crate::base::sort::greatest_first;
use std::cmp::Ordering;

/// State that choosing keeps from update to update.
pub(super) struct Chooser {
    /// Per block, whether work is left to do.
    open: Vec<bool>,
    open_count: usize,
    /// Per cell, the least progress of its open blocks; `None`: all are finished.
    least: Vec<Option<u32>>,
    /// Cells whose `least` must be recomputed.
    stale: Vec<bool>,
    /// Cells with marked blocks, in the update under way.
    visible: Vec<u32>,
    is_visible: Vec<bool>,
    /// Number of choices so far.
    turn: u32,
    scratch: Scratch,
}

/// Sort key of a cell: hidden cells last, then by distance.
type KeyedCell = (bool, f32, u32);

/// Buffers for sorting, allocated once, so that no update fails for lack of them.
#[derive(Default)]
struct Scratch {
    /// Blocks with their gain.
    blocks: Vec<(f32, u32)>,
    cells: Vec<KeyedCell>,
    of_cell: Vec<u32>,
}

/// Input of a choice.
pub(super) struct Choice<'a> {
    pub context: &'a Context,
    pub blocks: &'a [BlockStatus],
    pub grid: &'a Grid,
    pub visibility: &'a Visibility,
}

impl Chooser {
    pub fn new(map: &BlockMap, grid: &Grid) -> crate::base::error::Result<Chooser> {
        let cells = grid.info.cells();
        let mut open = try_vec(map.tiles.len(), "the blocks that are open")?;
        open.iter_mut().zip(&map.tiles).for_each(|(open, tile)| *open = !tile.texels.is_empty());
        let what = "the choice of blocks";
        Ok(Chooser {
            scratch: Scratch {
                blocks: try_with_capacity(map.tiles.len(), what)?,
                cells: try_with_capacity(grid.occupied.len(), what)?,
                of_cell: try_with_capacity(grid.most_blocks(), what)?,
            },
            open_count: open.iter().filter(|&&o| o).count(),
            open,
            least: try_vec(cells, "the progress of cells")?,
            stale: try_filled(cells, true, "the cells that are stale")?,
            visible: try_with_capacity(grid.occupied.len(), "the cells that are visible")?,
            is_visible: try_vec(cells, "the cells that are visible")?,
            turn: 0,
        })
    }

    pub fn bytes(&self) -> usize {
        let Scratch { blocks, cells, of_cell } = &self.scratch;
        let scratch = blocks.capacity() * size_of::<(f32, u32)>() + cells.capacity() * size_of::<KeyedCell>();
        let listed = (self.visible.capacity() + of_cell.capacity()) * size_of::<u32>();
        self.open.len() + self.least.len() * (size_of::<Option<u32>>() + 2) + scratch + listed
    }

    /// Fraction of blocks that are finished.
    pub fn finished(&self) -> f32 {
        1.0 - self.open_count as f32 / self.open.len().max(1) as f32
    }

    pub fn is_open(&self, b: u32) -> bool {
        self.open[b as usize]
    }

    /// Records that a block was worked on.
    pub fn note(&mut self, context: &Context, b: u32, block: &BlockStatus) {
        let tile = &context.map.tiles[b as usize];
        let open = !tile.texels.is_empty() && !block.is_finished(context);
        if self.open[b as usize] != open {
            self.open[b as usize] = open;
            self.open_count = if open { self.open_count + 1 } else { self.open_count - 1 };
        }
        if !tile.texels.is_empty() {
            self.stale[tile.cell as usize] = true;
        }
    }

    /// Records that the light has changed.
    pub fn note_all(&mut self, context: &Context, blocks: &[BlockStatus]) {
        (0..).zip(blocks).for_each(|(b, block)| self.note(context, b, block));
    }

    /// Records which blocks are visible in this update.
    pub fn look(&mut self, map: &BlockMap, visibility: &Visibility) {
        self.visible.drain(..).for_each(|cell| self.is_visible[cell as usize] = false);
        for &b in &visibility.seen {
            let cell = map.tiles[b as usize].cell;
            if !std::mem::replace(&mut self.is_visible[cell as usize], true) {
                self.visible.push(cell);
            }
        }
    }

    /// Visible blocks whose coarse direct light was computed under other lights than the current ones: the most visible
    /// first, and first of all those that have waited for long.
    pub fn wrong(&mut self, from: &Choice, count: usize) -> Vec<u32> {
        let wrong = |&b: &u32| {
            let behind = from.blocks[b as usize].changes_behind(from.context);
            (behind > 0).then(|| (from.visibility.mark(b) * behind as f32, b))
        };
        greatest(&mut self.scratch.blocks, from.visibility.seen.iter().filter_map(wrong), count)
    }

    /// The next blocks to work on, the most urgent first, and the step to be done on them.
    pub fn next(&mut self, from: &Choice, mode: Mode, camera: &LiveCamera, count: usize) -> (Step, Vec<u32>) {
        self.turn = self.turn.wrapping_add(1);
        if mode == Mode::Position && self.turn.is_multiple_of(2) {
            // Alternates cells with direct light of visible blocks: shadows that end at the border of a cell are the
            // most visible of all defects.
            let open = &self.open;
            let missing = |&b: &u32| {
                let is_missing = open[b as usize] && !from.blocks[b as usize].has_direct(from.context);
                is_missing.then(|| (from.visibility.mark(b), b))
            };
            let missing = from.visibility.seen.iter().filter_map(missing);
            let missing = greatest(&mut self.scratch.blocks, missing, count);
            if !missing.is_empty() {
                return (Step::Direct, missing);
            }
        }
        (Step::Next, self.next_by_mode(from, mode, camera, count))
    }

    fn next_by_mode(&mut self, from: &Choice, mode: Mode, camera: &LiveCamera, count: usize) -> Vec<u32> {
        match mode {
            Mode::View => {
                let urgency = |b: u32| {
                    let gain = from.blocks[b as usize].next(from.context, &from.context.map.tiles[b as usize]);
                    from.visibility.mark(b) * gain.map_or(0.0, |g| g.1)
                };
                let open = from.visibility.seen.iter().filter(|&&b| self.open[b as usize]);
                greatest(&mut self.scratch.blocks, open.map(|&b| (urgency(b), b)), count)
            }
            Mode::Uniform => {
                let n = self.open.len() as u32;
                let random = |i: u32| mix(combine(self.turn, i)) % n.max(1);
                if self.open_count < self.open.len() / 16 {
                    // Few blocks are left: takes the next ones from a random position on.
                    let from = random(0);
                    let around = (from..n).chain(0..from);
                    return around.filter(|&b| self.is_open(b)).take(count).collect();
                }
                let mut chosen: Vec<u32> =
                    (0..16 * count as u32).map(random).filter(|&b| self.is_open(b)).take(count).collect();
                chosen.sort_unstable();
                chosen.dedup();
                chosen
            }
            Mode::Position => self.next_of_cells(from, camera, count),
        }
    }

    /// Blocks of the next cells: visible cells before hidden ones, near before far, where each LOD that a cell has
    /// doubles its distance.
    fn next_of_cells(&mut self, from: &Choice, camera: &LiveCamera, count: usize) -> Vec<u32> {
        let top = from.context.map.top() as u32;
        let progress = |b: u32| {
            let block = &from.blocks[b as usize];
            let is_new = !block.has_old_light(from.context) as u32;
            let rounds = if block.fresh_lod as u32 == top { block.rounds as u32 } else { 0 };
            is_new * (1 + block.fresh_lod as u32 + rounds)
        };
        let info = &from.grid.info;
        let mut scratch = std::mem::take(&mut self.scratch);
        let Scratch { cells, of_cell, .. } = &mut scratch;
        cells.clear();
        for &cell in &from.grid.occupied {
            let c = cell as usize;
            if std::mem::replace(&mut self.stale[c], false) {
                let open = from.grid.blocks_of(cell).iter().filter(|&&b| self.is_open(b));
                self.least[c] = open.map(|&b| progress(b)).min();
            }
            if let Some(least) = self.least[c] {
                let away = info.distance(cell, camera.position) + info.cell_size;
                cells.push((!self.is_visible[c], away * (1u64 << least.min(40)) as f32, cell));
            }
        }
        let order =
            |a: &KeyedCell, b: &KeyedCell| -> Ordering { a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)).then(a.2.cmp(&b.2)) };
        // Each of these has at least one open block.
        if cells.len() > count {
            cells.select_nth_unstable_by(count, order);
            cells.truncate(count);
        }
        cells.sort_unstable_by(order);
        let mut chosen = Vec::with_capacity(count);
        for &(_, _, cell) in &*cells {
            // The least advanced blocks of the cell come first: a cell is promoted as a whole.
            of_cell.clear();
            of_cell.extend(from.grid.blocks_of(cell).iter().filter(|&&b| self.is_open(b)));
            of_cell.sort_unstable_by_key(|&b| (progress(b), from.visibility.mark(b) == 0.0, b));
            chosen.extend(of_cell.iter().take(count - chosen.len()));
            if chosen.len() >= count {
                break;
            }
        }
        self.scratch = scratch;
        chosen
    }
}

/// Returns the `count` greatest, in descending order. `keyed` is scratch space with capacity for all.
fn greatest(keyed: &mut Vec<(f32, u32)>, all: impl Iterator<Item = (f32, u32)>, count: usize) -> Vec<u32> {
    keyed.clear();
    keyed.extend(all);
    greatest_first(keyed, count).0.iter().map(|k| k.1).collect()
}
