//! Shows computed light: blocks that wait for the display, and blocks that fade from one LOD to the next.

use super::dirty::{LEAST_BYTES, TEXEL_BYTES};
use super::display::Changed;
use super::illumination::Sides;
use super::{Budget, Live, LiveStats, Mode, PASS};
use std::sync::Arc;
use std::time::Instant;

/// Part of the time budget that is kept free at most for reading what an update gives out.
const MOST_READING: f64 = 0.5;

/// Number of blocks that an update marks after new indirect light: less than a millisecond. (All of Sponza's 62,636 took
/// up to 2 ms, and more where other programs run.)
pub(super) const MARKED_AT_ONCE: usize = 16_384;

/// What is left to be marked as changed by new indirect light.
pub(super) struct Marking {
    /// The next block.
    next: u32,
    /// The sides that were shown before.
    before: Arc<Sides>,
    has_moved: bool,
}

impl Marking {
    pub fn of(before: Arc<Sides>, has_moved: bool) -> Marking {
        Marking { next: 0, before, has_moved }
    }
}

impl Live {
    /// Records the progress of all blocks, and that all pages have changed.
    pub(super) fn note_all_shown(&mut self) {
        self.dirty.mark_all();
        self.promotion.count(&self.context.map.tiles, self.blocks.status());
        self.chooser.note_all(&self.context, self.blocks.status());
    }

    /// Goes on marking what new indirect light changes at once: what texels gather for themselves, and all of charts that
    /// show their other side; all, after a first impression; and, if the scene has moved, blocks whose light that changes.
    pub(super) fn mark_new_light(&mut self, most: usize) {
        let Some(marking) = &mut self.marking else { return };
        let (map, light) = (self.context.map.clone(), self.context.light.clone());
        let first = marking.next as usize;
        let end = map.tiles.len().min(first.saturating_add(most));
        marking.next = end as u32;
        let (before, has_moved) = (marking.before.clone(), marking.has_moved);
        let was_first_impression = before.is_first_impression && !light.sides.is_first_impression;
        for (b, tile) in (first as u32..).zip(&map.tiles[first..end]) {
            let chart = map.atlas.gather.layout.chart_of(tile.placement).index();
            let alone = self.alone[b as usize];
            let amount = if before.backs.get(chart) != light.sides.backs.get(chart) {
                1.0
            } else if was_first_impression || has_moved && self.status(b).has_old_light(&self.context) {
                // Other walls and gaps separate texels from now on.
                0.25
            } else if alone.area() > 0 {
                let (page, rect) = (map.atlas.map.layout[tile.placement].page, alone.grown(map.atlas.padding as i32));
                self.dirty.add(Changed { page, rect, block: b, amount: 0.5 });
                continue;
            } else {
                continue;
            };
            let (page, rect) = self.display.widest_rect(&map, b);
            self.dirty.add(Changed { page, rect, block: b, amount });
        }
        if end == map.tiles.len() {
            self.marking = None;
        }
    }

    /// Shows a block that completed a step: at once, or, in position-based mode, together with its cell.
    pub(super) fn promote(&mut self, b: u32, stats: &mut LiveStats) {
        let cell = self.context.map.tiles[b as usize].cell;
        let lod = self.status(b).lod;
        let common = self.promotion.note(b, cell, lod);
        if self.params.mode != Mode::Position {
            self.display.lods[b as usize] = lod;
            self.wait(b);
        } else if let Some(common) = common {
            stats.cells_promoted += 1;
            self.show_cell(cell, common);
            self.wait(b);
        } else if self.status(b).fresh_lod <= self.display.lods[b as usize] {
            self.wait(b);
        }
    }

    /// Lets all blocks of a cell that show less fade to a LOD that they all have.
    pub(super) fn show_cell(&mut self, cell: u32, lod: u8) {
        for i in 0..self.grid.blocks_of(cell).len() {
            let b = self.grid.blocks_of(cell)[i];
            if self.display.lods[b as usize] >= lod {
                continue;
            }
            self.display.lods[b as usize] = lod;
            if self.display.begin_fade(b) {
                self.fading.push(b);
            }
            self.wait(b);
        }
    }

    pub(super) fn wait(&mut self, b: u32) {
        if !std::mem::replace(&mut self.is_waiting[b as usize], true) {
            self.waiting.push_back(b);
        }
    }

    /// Shows waiting blocks while there is time.
    pub(super) fn show_waiting(&mut self, end: Option<Instant>, stats: &mut LiveStats) {
        while !self.waiting.is_empty() {
            let start = Instant::now();
            let left = end.map_or(f64::INFINITY, |e| e.saturating_duration_since(start).as_secs_f64());
            let fit = (left / self.refresh_seconds) as usize;
            if fit == 0 {
                // One slow measurement must not keep light from being shown for ever.
                self.refresh_seconds *= 0.9;
                return;
            }
            let batch: Vec<u32> = self.waiting.drain(..fit.min(PASS).min(self.waiting.len())).collect();
            let dirty = &mut self.dirty;
            self.display.refresh(&self.context.map, &self.blocks, &batch, &mut |c| dirty.add(c));
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

    /// Advances the fades by one step, as far as there is time; the remaining blocks come first next time.
    pub(super) fn show_fading(&mut self, end: Option<Instant>, stats: &mut LiveStats) {
        let rest = &mut self.still_fading;
        // The display has not yet received the values of waiting blocks.
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
            // Fades must not take all the time of an update.
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

    /// Time to be kept free for reading what an update gives out, in seconds: of as much as it may give out, if there is
    /// a limit, and at most half of the budget.
    pub(super) fn reading_seconds(&self, budget: &Budget) -> f64 {
        let expected = (self.dirty.bytes_left() + self.last_dirty_bytes).min(budget.max_dirty_bytes);
        let seconds = (expected / TEXEL_BYTES) as f64 * self.reading.per_texel();
        seconds.min(MOST_READING * budget.milliseconds as f64 * 1e-3)
    }

    /// Gives out rectangles of changed texels, at most as many bytes as the budget allows and, if there is a limit, as
    /// can be read until `end`, or in the time in seconds that was `kept` free for that. (What changed while nothing was
    /// expected to comes with the next update: read with what changed, it overran 4 ms by 1.0 ms at p99 in Sponza.)
    pub(super) fn give_out(&mut self, budget: &Budget, end: Option<Instant>, kept: f64) {
        let start = Instant::now();
        let most = budget.max_dirty_bytes;
        let limit = (most > 0).then(|| {
            let Some(end) = end else { return most };
            let left = end.saturating_duration_since(start).as_secs_f64().max(kept);
            let readable = (left / self.reading.per_texel()) as u64 * TEXEL_BYTES;
            readable.clamp(LEAST_BYTES, most)
        });
        let (visibility, display, map) = (&self.visibility, &self.display, &self.context.map);
        let seen = visibility.seen.iter().map(|&b| (visibility.mark(b), b));
        self.dirty.give_out(limit, seen, |b| display.widest_rect(map, b));
        self.last_dirty_bytes = self.dirty.bytes_out();
        self.choosing_seconds += 0.2 * (start.elapsed().as_secs_f64() - self.choosing_seconds);
    }
}
