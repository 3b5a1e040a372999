//! Rectangles of pages that have changed since they were last fetched: merged where that adds little
//! area, so that an application uploads few and tight ones.

use super::blocks::Rect;
use super::display::Changed;
use crate::base::error::Result;
use crate::base::memory::{try_collect_ok, try_with_capacity};

/// Two rectangles are merged if the result has at most this many times the area of both.
const SLACK: f64 = 1.3;

/// Maximum number of rectangles on a page; more are merged into one.
const MAX_RECTS: usize = 1024;

/// Changed rectangles, by page.
pub(super) struct Dirty {
    pages: Vec<Vec<Rect>>,
}

impl Dirty {
    /// Creates the list with all pages marked as changed.
    pub fn all(pages: u32, size: u32) -> Result<Dirty> {
        let what = "the list of changes";
        // Capacity for one rectangle, into which all others can be merged.
        let lists = (0..pages).map(|_| try_with_capacity(1, what));
        let mut dirty = Dirty { pages: try_collect_ok(lists, what)? };
        dirty.mark_all(size);
        Ok(dirty)
    }

    /// Marks all of all pages as changed.
    pub fn mark_all(&mut self, size: u32) {
        for rects in &mut self.pages {
            rects.clear();
            rects.push(Rect { x0: 0, y0: 0, x1: size as i32, y1: size as i32 });
        }
    }

    pub fn add(&mut self, changed: Changed) {
        if changed.rect.area() == 0 {
            return;
        }
        let rects = &mut self.pages[changed.page as usize];
        let mut new = changed.rect;
        // A grown rectangle may contain others in turn.
        while let Some(i) = rects.iter().position(|r| merges(r, &new)) {
            new = new.union(&rects.swap_remove(i));
        }
        // If there is no memory for more, all are merged into one: light that has changed must not be forgotten.
        if rects.len() >= MAX_RECTS || rects.try_reserve(1).is_err() {
            new = rects.iter().fold(new, |a, r| a.union(r));
            rects.clear();
        }
        rects.push(new);
    }

    /// The number of rectangles.
    pub fn len(&self) -> usize {
        self.pages.iter().map(Vec::len).sum()
    }

    /// Removes up to `capacity` rectangles and passes them with their pages to `put`.
    pub fn take(&mut self, capacity: usize, mut put: impl FnMut(u32, Rect)) {
        let mut left = capacity;
        for (page, rects) in (0..).zip(&mut self.pages) {
            while left > 0
                && let Some(rect) = rects.pop()
            {
                put(page, rect);
                left -= 1;
            }
        }
    }
}

fn merges(a: &Rect, b: &Rect) -> bool {
    let both = a.area() + b.area() - a.clipped(b).area();
    a.union(b).area() as f64 <= SLACK * both as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rect(x0: i32, y0: i32, x1: i32, y1: i32) -> Rect {
        Rect { x0, y0, x1, y1 }
    }

    fn added(rects: &[Rect]) -> Vec<Rect> {
        let mut dirty = Dirty { pages: vec![Vec::new(); 2] };
        rects.iter().for_each(|&rect| dirty.add(Changed { page: 1, rect }));
        let mut all = Vec::new();
        dirty.take(usize::MAX, |page, r| {
            assert_eq!(page, 1);
            all.push(r);
        });
        all
    }

    #[test]
    fn neighbours_merge_and_distant_rectangles_do_not() {
        assert_eq!(added(&[rect(0, 0, 32, 32), rect(32, 0, 64, 32)]), [rect(0, 0, 64, 32)]);
        assert_eq!(added(&[rect(0, 0, 8, 8), rect(100, 100, 108, 108)]).len(), 2);
        assert_eq!(added(&[rect(0, 0, 8, 8), rect(2, 2, 6, 6)]), [rect(0, 0, 8, 8)]);
        assert!(added(&[rect(0, 0, 0, 8)]).is_empty());
    }

    #[test]
    fn a_merge_swallows_what_it_has_grown_to() {
        let rects = added(&[rect(0, 0, 10, 10), rect(20, 0, 30, 10), rect(10, 0, 20, 10)]);
        assert_eq!(rects, [rect(0, 0, 30, 10)]);
    }

    #[test]
    fn what_does_not_fit_is_kept() {
        let mut dirty = Dirty::all(3, 16).unwrap();
        let counts = [2, 0, 8, 8].map(|capacity| {
            let mut count = 0;
            dirty.take(capacity, |_, _| count += 1);
            count
        });
        assert_eq!((counts, dirty.len()), ([2, 0, 1, 0], 0));
    }

    #[test]
    fn very_many_rectangles_become_one() {
        let apart = |i: i32| rect(8 * i, 0, 8 * i + 1, 1);
        let many: Vec<Rect> = (0..MAX_RECTS as i32).map(apart).collect();
        assert_eq!(added(&many).len(), MAX_RECTS);
        let more: Vec<Rect> = (0..=MAX_RECTS as i32).map(apart).collect();
        assert_eq!(added(&more), [rect(0, 0, 8 * MAX_RECTS as i32 + 1, 1)]);
    }
}
