//! Rectangles of pages that have changed since they were last fetched: merged where that adds little
//! area, so that an application uploads few and tight ones.

use super::blocks::Rect;
use super::display::Changed;

/// Two rectangles become one if that has at most this many times the area of both.
const SLACK: f64 = 1.3;

/// More rectangles than this on one page become one.
const MAX_RECTS: usize = 1024;

/// Changed rectangles, by page.
pub(super) struct Dirty {
    pages: Vec<Vec<Rect>>,
}

impl Dirty {
    /// All of all pages.
    pub fn all(pages: u32, size: u32) -> Dirty {
        let page = Rect { x0: 0, y0: 0, x1: size as i32, y1: size as i32 };
        Dirty { pages: vec![vec![page]; pages as usize] }
    }

    pub fn add(&mut self, changed: Changed) {
        if changed.rect.area() == 0 {
            return;
        }
        let rects = &mut self.pages[changed.page as usize];
        let mut new = changed.rect;
        // A grown rectangle may swallow others in turn.
        while let Some(i) = rects.iter().position(|r| merges(r, &new)) {
            new = new.union(&rects.swap_remove(i));
        }
        rects.push(new);
        if rects.len() > MAX_RECTS {
            let all = rects.iter().fold(new, |a, r| a.union(r));
            *rects = vec![all];
        }
    }

    /// Removes and returns up to `capacity` rectangles with their pages.
    pub fn take(&mut self, capacity: usize) -> Vec<(u32, Rect)> {
        let mut out = Vec::new();
        for (page, rects) in self.pages.iter_mut().enumerate() {
            while out.len() < capacity
                && let Some(rect) = rects.pop()
            {
                out.push((page as u32, rect));
            }
        }
        out
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
        dirty.take(usize::MAX).into_iter().map(|(page, r)| (assert_eq!(page, 1), r).1).collect()
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
        let mut dirty = Dirty::all(3, 16);
        assert_eq!(dirty.take(2).len(), 2);
        assert_eq!(dirty.take(0).len(), 0);
        assert_eq!(dirty.take(8).len(), 1);
        assert_eq!(dirty.take(8).len(), 0);
    }
}
