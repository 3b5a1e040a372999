//! Texels of the light map whose shown light has changed since an application last fetched them, and what of them
//! it is given next.
//!
//! Pages are divided into squares of 4 × 4 texels. A change makes squares *pending*; giving out turns pending squares
//! into few rectangles. When the texels given out are limited, those of the blocks that are seen come first, in the order
//! of visibility times change, and a part of the limit goes round all pages, so that nothing waits for ever. What is not
//! given out stays pending. Invariant: a texel that differs from the application's copy is pending or in a rectangle.

use super::blocks::Rect;
use super::display::Changed;
use crate::base::error::Result;
use crate::base::memory::{try_vec, try_with_capacity};
use crate::base::sort::greatest_first;

/// Side of a square in texels.
const SQUARE: i32 = 4;

/// Squares per row of a tile, one bit each, and rows of a tile.
const COLUMNS: i32 = u64::BITS as i32;
const ROWS: i32 = 16;

/// Size of a tile in texels.
const TILE_WIDTH: i32 = SQUARE * COLUMNS;
const TILE_HEIGHT: i32 = SQUARE * ROWS;

/// Bytes of a texel, by which the limit is reckoned: four half floats.
pub(super) const TEXEL_BYTES: u64 = 8;

/// The smallest limit in bytes: less than this leaves no room for the parts below.
pub(super) const LEAST_BYTES: u64 = 1024;

/// Two rectangles are merged if the result has at most this many times the area of both.
const SLACK: f64 = 1.3;

/// Maximum number of rectangles given out at a time.
const MAX_RECTS: usize = 256;

/// Parts of the limit: what is seen is chosen until it takes three quarters and merged until it takes seven eighths; then
/// come the other texels.
const SEEN: Parts = Parts { chosen: 0.75, merged: 0.875 };
const ALL: Parts = Parts { chosen: 0.9375, merged: 1.0 };

/// Number of blocks that are sorted by urgency at a time.
const SORTED: usize = 64;

/// A block's change counts as this much at least: its texels have been computed anew.
const LEAST_CHANGE: f32 = 0.05;

#[derive(Clone, Copy)]
struct Parts {
    chosen: f64,
    merged: f64,
}

/// Squares of a tile, one word per row.
type Squares = [u64; ROWS as usize];

/// Changed texels.
pub(super) struct Dirty {
    page: Rect,
    /// Number of tiles along a side of a page, in both directions.
    columns: i32,
    rows: i32,
    /// Pending squares and their number, by tile: pages one after the other, row by row.
    tiles: Vec<Squares>,
    counts: Vec<u16>,
    /// Number of pending squares.
    pending: usize,
    /// The tile from which texels that are not seen are given out next.
    next: usize,
    /// How much the light of each block has changed since it was last given out.
    changes: Vec<f32>,
    /// Buffer for sorting; has capacity for all blocks.
    urgent: Vec<(f32, u32)>,
    /// Rectangles given out and not fetched yet, and the sum of their areas.
    rects: Vec<(u32, Rect)>,
    area: usize,
    /// Whether more is given out by updates only.
    is_limited: bool,
}

impl Dirty {
    /// Creates the list with all pages marked as changed.
    pub fn all(pages: u32, size: u32, blocks: usize) -> Result<Dirty> {
        let what = "the list of changes";
        let size = size as i32;
        let (columns, rows) = ((size + TILE_WIDTH - 1) / TILE_WIDTH, (size + TILE_HEIGHT - 1) / TILE_HEIGHT);
        let tiles = pages as usize * columns as usize * rows as usize;
        let mut dirty = Dirty {
            page: Rect { x0: 0, y0: 0, x1: size, y1: size },
            columns,
            rows,
            tiles: try_vec(tiles, what)?,
            counts: try_vec(tiles, what)?,
            pending: 0,
            next: 0,
            changes: try_vec(blocks, what)?,
            urgent: try_with_capacity(blocks, what)?,
            rects: try_with_capacity(MAX_RECTS, what)?,
            area: 0,
            is_limited: false,
        };
        dirty.mark_all();
        Ok(dirty)
    }

    pub fn bytes(&self) -> usize {
        size_of_val(&self.tiles[..])
            + size_of_val(&self.counts[..])
            + size_of_val(&self.changes[..])
            + self.urgent.capacity() * size_of::<(f32, u32)>()
            + self.rects.capacity() * size_of::<(u32, Rect)>()
    }

    /// Marks all of all pages as changed.
    pub fn mark_all(&mut self) {
        let whole = self.page;
        (0..self.page_count()).for_each(|page| self.mark(page, &whole));
        self.changes.fill(1.0);
    }

    pub fn add(&mut self, changed: Changed) {
        self.changes[changed.block as usize] += changed.amount + LEAST_CHANGE;
        self.mark(changed.page, &changed.rect);
    }

    /// Bytes of the rectangles given out and not fetched yet.
    pub fn bytes_out(&self) -> u64 {
        self.area as u64 * TEXEL_BYTES
    }

    /// Bytes of the texels that are kept for later. (Squares on the upper borders of pages may count too much.)
    pub fn bytes_left(&self) -> u64 {
        self.pending as u64 * (SQUARE * SQUARE) as u64 * TEXEL_BYTES
    }

    /// Removes up to `capacity` rectangles and passes them with their pages to `put`.
    pub fn take(&mut self, capacity: usize, mut put: impl FnMut(u32, Rect)) {
        for _ in 0..capacity {
            if self.rects.is_empty() && !self.is_limited {
                self.give_all(ALL, usize::MAX);
            }
            if self.rects.is_empty() {
                return;
            }
            // The most urgent come first.
            let (page, rect) = self.rects.remove(0);
            self.area -= rect.area();
            put(page, rect);
        }
    }

    /// Gives out rectangles with at most `limit` bytes in all; `None`: without limit. What was given out before and not
    /// fetched is chosen anew. `seen` yields blocks with their visibility, `place` tells where a block is shown.
    pub fn give_out(
        &mut self,
        limit: Option<u64>,
        seen: impl Iterator<Item = (f32, u32)>,
        place: impl Fn(u32) -> (u32, Rect),
    ) {
        while let Some((page, rect)) = self.rects.pop() {
            self.mark(page, &rect);
        }
        self.area = 0;
        self.is_limited = limit.is_some();
        match limit {
            None => self.give_all(ALL, usize::MAX),
            Some(bytes) => {
                let limit = (bytes / TEXEL_BYTES) as usize;
                self.give_seen(limit, seen, place);
                self.give_all(ALL, limit);
            }
        }
    }

    /// Gives out the most urgent of the blocks that are seen.
    fn give_seen(&mut self, limit: usize, seen: impl Iterator<Item = (f32, u32)>, place: impl Fn(u32) -> (u32, Rect)) {
        let mut urgent = std::mem::take(&mut self.urgent);
        urgent.clear();
        urgent.extend(seen.map(|(mark, b)| (mark * self.changes[b as usize], b)).filter(|u| u.0 > 0.0));
        let mut rest = &mut urgent[..];
        while !rest.is_empty() && self.has_room(SEEN, limit) {
            let (some, others) = greatest_first(rest, SORTED);
            for &(_, b) in &*some {
                let (page, rect) = place(b);
                let is_whole = self.give(page, &rect, SEEN, limit);
                if !is_whole {
                    break;
                }
                self.changes[b as usize] = 0.0;
            }
            rest = others;
        }
        self.urgent = urgent;
    }

    /// Gives out whatever is pending, going on where this ended the last time.
    fn give_all(&mut self, parts: Parts, limit: usize) {
        self.give_round(parts, limit);
        // What lies between merged rectangles has been given out with them.
        for i in 0..self.rects.len() {
            let (page, rect) = self.rects[i];
            self.for_each_tile(page, &rect, |dirty, tile, squares| dirty.clear(tile, squares));
        }
    }

    fn give_round(&mut self, parts: Parts, limit: usize) {
        let per_page = (self.columns * self.rows) as usize;
        for _ in 0..self.tiles.len() {
            if self.pending == 0 {
                return;
            }
            let tile = self.next;
            if self.counts[tile] > 0 {
                let (page, at) = (tile / per_page, (tile % per_page) as i32);
                let (x0, y0) = (at % self.columns * TILE_WIDTH, at / self.columns * TILE_HEIGHT);
                let rect = Rect { x0, y0, x1: x0 + TILE_WIDTH, y1: y0 + TILE_HEIGHT };
                if !self.give(page as u32, &rect, parts, limit) {
                    return;
                }
            }
            self.next = (tile + 1) % self.tiles.len();
        }
    }

    /// Whether another square may be chosen.
    fn has_room(&self, parts: Parts, limit: usize) -> bool {
        self.room(parts, limit) > 0
    }

    /// Number of squares that may still be chosen.
    fn room(&self, parts: Parts, limit: usize) -> usize {
        if self.rects.len() >= MAX_RECTS {
            return 0;
        }
        (part_of(limit, parts.chosen).saturating_sub(self.area)) / (SQUARE * SQUARE) as usize
    }

    /// Gives out the pending squares of a rectangle; returns whether there was room for all of them.
    fn give(&mut self, page: u32, rect: &Rect, parts: Parts, limit: usize) -> bool {
        let mut is_whole = true;
        self.for_each_tile(page, rect, |dirty, tile, squares| {
            let pending = dirty.tiles[tile];
            let mut chosen: Squares = std::array::from_fn(|r| squares[r] & pending[r]);
            let mut room = dirty.room(parts, limit);
            for row in &mut chosen {
                while row.count_ones() as usize > room {
                    // Drops the last square of the row.
                    *row &= !(1 << (u64::BITS - 1 - row.leading_zeros()));
                    is_whole = false;
                }
                room -= row.count_ones() as usize;
            }
            dirty.clear(tile, &chosen);
            is_whole &= dirty.put_squares(tile, chosen, part_of(limit, parts.merged));
        });
        is_whole
    }

    /// Adds rectangles that cover the squares of a tile; returns whether there was room for all of them. What has none
    /// becomes pending again.
    fn put_squares(&mut self, tile: usize, mut squares: Squares, most: usize) -> bool {
        let per_page = (self.columns * self.rows) as usize;
        let (page, at) = ((tile / per_page) as u32, (tile % per_page) as i32);
        let (left, top) = (at % self.columns * COLUMNS, at / self.columns * ROWS);
        let mut is_whole = true;
        // All of them count before the first is merged: what merging wastes must leave room for the others.
        self.area += squares.iter().map(|row| row.count_ones() as usize * (SQUARE * SQUARE) as usize).sum::<usize>();
        for first in 0..squares.len() {
            while squares[first] != 0 {
                let x = squares[first].trailing_zeros();
                let width = (squares[first] >> x).trailing_ones();
                let run = ones(width) << x;
                let height = squares[first..].iter().take_while(|&&row| row & run == run).count();
                squares[first..first + height].iter_mut().for_each(|row| *row &= !run);
                let (x, y) = (left + x as i32, top + first as i32);
                let rect = Rect { x0: x, y0: y, x1: x + width as i32, y1: y + height as i32 };
                let (whole, rect) = (rect.times(SQUARE).area(), rect.times(SQUARE).clipped(&self.page));
                self.area -= whole - rect.area();
                is_whole &= self.put(page, rect, most);
            }
        }
        is_whole
    }

    /// Adds a rectangle, whose area is counted already, and merges it with others, where that does not make the area
    /// greater than `most`.
    fn put(&mut self, page: u32, mut rect: Rect, most: usize) -> bool {
        let merges = |area: usize, (p, r): &(u32, Rect), new: &Rect| {
            let (both, union) = (r.area() + new.area(), r.union(new).area());
            let overlap = r.clipped(new).area();
            *p == page && area + union <= most + both && union as f64 <= SLACK * (both - overlap) as f64
        };
        let mut place = self.rects.len();
        // A grown rectangle may contain others in turn.
        while let Some(i) = self.rects.iter().position(|r| merges(self.area, r, &rect)) {
            let (_, other) = self.rects.remove(i);
            place = place.min(i);
            let union = rect.union(&other);
            self.area = self.area + union.area() - rect.area() - other.area();
            rect = union;
        }
        if self.rects.len() < MAX_RECTS {
            self.rects.insert(place.min(self.rects.len()), (page, rect));
            return true;
        }
        self.area -= rect.area();
        self.mark(page, &rect);
        false
    }

    fn page_count(&self) -> u32 {
        (self.tiles.len() / (self.columns * self.rows).max(1) as usize) as u32
    }

    /// Makes the squares of a rectangle pending.
    fn mark(&mut self, page: u32, rect: &Rect) {
        self.for_each_tile(page, rect, |dirty, tile, squares| {
            let rows = &mut dirty.tiles[tile];
            let mut new = 0;
            for (row, more) in rows.iter_mut().zip(squares) {
                new += (more & !*row).count_ones();
                *row |= more;
            }
            dirty.counts[tile] += new as u16;
            dirty.pending += new as usize;
        });
    }

    fn clear(&mut self, tile: usize, squares: &Squares) {
        let mut old = 0;
        for (row, less) in self.tiles[tile].iter_mut().zip(squares) {
            old += (less & *row).count_ones();
            *row &= !less;
        }
        self.counts[tile] -= old as u16;
        self.pending -= old as usize;
    }

    /// Calls `visit` with the tiles that a rectangle of a page overlaps, and its squares in them.
    fn for_each_tile(&mut self, page: u32, rect: &Rect, mut visit: impl FnMut(&mut Dirty, usize, &Squares)) {
        let rect = rect.clipped(&self.page);
        if rect.area() == 0 {
            return;
        }
        let (x0, x1) = (rect.x0 / SQUARE, (rect.x1 + SQUARE - 1) / SQUARE);
        let (y0, y1) = (rect.y0 / SQUARE, (rect.y1 + SQUARE - 1) / SQUARE);
        for j in y0 / ROWS..(y1 + ROWS - 1) / ROWS {
            for i in x0 / COLUMNS..(x1 + COLUMNS - 1) / COLUMNS {
                let inside = |v: i32, first: i32, count: i32| (v - first).clamp(0, count);
                let [left, right] = [x0, x1].map(|x| inside(x, i * COLUMNS, COLUMNS) as u32);
                let [top, bottom] = [y0, y1].map(|y| inside(y, j * ROWS, ROWS) as usize);
                let mut squares = Squares::default();
                squares[top..bottom].fill(ones(right - left) << left);
                visit(self, ((page as i32 * self.rows + j) * self.columns + i) as usize, &squares);
            }
        }
    }
}

/// A word whose lowest `count` bits, 1 to 64, are set.
fn ones(count: u32) -> u64 {
    u64::MAX >> (u64::BITS - count)
}

fn part_of(limit: usize, part: f64) -> usize {
    if limit == usize::MAX { limit / 2 } else { (limit as f64 * part) as usize }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rect(x0: i32, y0: i32, x1: i32, y1: i32) -> Rect {
        Rect { x0, y0, x1, y1 }
    }

    fn changed(block: u32, rect: Rect) -> Changed {
        Changed { page: 1, rect, block, amount: 1.0 }
    }

    /// Two pages of which nothing is changed, with blocks of 32 × 32 texels on the second.
    fn clean(size: u32) -> Dirty {
        let mut dirty = Dirty::all(2, size, 64).unwrap();
        dirty.take(usize::MAX, |_, _| ());
        dirty.changes.fill(0.0);
        assert_eq!((dirty.bytes_out(), dirty.bytes_left()), (0, 0));
        dirty
    }

    fn place(b: u32) -> (u32, Rect) {
        let (x, y) = (b as i32 % 8 * 32, b as i32 / 8 * 32);
        (1, rect(x, y, x + 32, y + 32))
    }

    fn taken(dirty: &mut Dirty) -> Vec<(u32, Rect)> {
        let mut all = Vec::new();
        dirty.take(usize::MAX, |page, r| all.push((page, r)));
        all
    }

    fn added(rects: &[Rect]) -> Vec<Rect> {
        let mut dirty = clean(4096);
        rects.iter().for_each(|&rect| dirty.add(changed(0, rect)));
        let mut all = taken(&mut dirty);
        assert!(all.iter().all(|r| r.0 == 1));
        all.sort_by_key(|r| r.1.x0);
        all.into_iter().map(|r| r.1).collect()
    }

    #[test]
    fn neighbours_merge_and_distant_rectangles_do_not() {
        assert_eq!(added(&[rect(0, 0, 32, 32), rect(32, 0, 64, 32)]), [rect(0, 0, 64, 32)]);
        assert_eq!(added(&[rect(0, 0, 8, 8), rect(100, 100, 108, 108)]).len(), 2);
        assert_eq!(added(&[rect(0, 0, 8, 8), rect(2, 2, 6, 6)]), [rect(0, 0, 8, 8)]);
        assert_eq!(added(&[rect(1, 2, 3, 5)]), [rect(0, 0, 4, 8)]);
        assert!(added(&[rect(0, 0, 0, 8)]).is_empty());
        // Across the borders of tiles.
        assert_eq!(added(&[rect(200, 40, 600, 200)]), [rect(200, 40, 600, 200)]);
        assert_eq!(added(&[rect(0, 0, 12, 8), rect(20, 0, 32, 8), rect(12, 0, 20, 8)]), [rect(0, 0, 32, 8)]);
    }

    #[test]
    fn all_pages_are_given_out_whole_and_one_by_one() {
        for size in [16, 100, 1024, 4096] {
            let mut dirty = Dirty::all(3, size, 0).unwrap();
            let mut pages = Vec::new();
            for capacity in [2, 0, 1, 8] {
                dirty.take(capacity, |page, r| {
                    assert_eq!(r, rect(0, 0, size as i32, size as i32));
                    pages.push(page);
                });
            }
            pages.sort_unstable();
            assert_eq!((pages, dirty.bytes_left()), (vec![0, 1, 2], 0));
        }
    }

    #[test]
    fn very_many_rectangles_all_come() {
        let apart: Vec<Rect> =
            (0..1000).map(|i| rect(16 * (i % 100), 16 * (i / 100), 16 * (i % 100) + 1, 16 * (i / 100) + 1)).collect();
        let got = added(&apart);
        assert!(got.iter().map(|r| r.area()).sum::<usize>() < 1000 * 16 * 14 / 10);
        assert!(apart.iter().all(|a| got.iter().any(|g| g.union(a) == *g)));
    }

    #[test]
    fn what_is_seen_and_has_changed_most_comes_first() {
        let mut dirty = clean(256);
        (0..64).for_each(|b| dirty.add(changed(b, place(b).1)));
        dirty.add(changed(21, place(21).1));
        // Room for one block among those that are seen.
        dirty.give_out(Some(1100 * TEXEL_BYTES * 4 / 3), [(1.0, 20), (1.0, 21), (0.5, 22)].into_iter(), place);
        let all = taken(&mut dirty);
        let [x, y] = [21 % 8 * 32, 21 / 8 * 32];
        assert!(all.iter().any(|(_, r)| r.union(&rect(x, y, x + 32, y + 32)) == *r), "{all:?}");
        // No more comes until the next update, which gives out what was not fetched, and more.
        assert!(taken(&mut dirty).is_empty());
    }

    #[test]
    fn a_limit_is_kept_and_everything_comes_in_the_end() {
        for (size, limit) in [(256u32, 1024u64), (256, 5000), (100, 20_000), (1000, 65_536)] {
            let mut dirty = Dirty::all(2, size, 64).unwrap();
            let mut missing = vec![true; 2 * (size * size) as usize];
            let mut updates = 0;
            while missing.iter().any(|&m| m) {
                // Later on nothing changes any more.
                if updates % 3 == 0 && updates < 300 {
                    let b = updates % 64;
                    let (page, r) = place(b);
                    dirty.add(changed(b, r));
                    for (x, y) in r.clipped(&dirty.page).texels() {
                        missing[((page * size + y as u32) * size + x as u32) as usize] = true;
                    }
                }
                dirty.give_out(Some(limit), (0..64).map(|b| (1.0 + b as f32, b)), place);
                assert!(dirty.bytes_out() <= limit && dirty.bytes_out() > 0);
                let mut bytes = 0;
                dirty.take(usize::MAX, |page, r| {
                    bytes += r.area() as u64 * TEXEL_BYTES;
                    for (x, y) in r.texels() {
                        missing[((page * size + y as u32) * size + x as u32) as usize] = false;
                    }
                });
                assert!(bytes <= limit);
                updates += 1;
                assert!(updates < 20_000);
            }
            assert_eq!(dirty.bytes_left(), 0);
        }
    }
}
