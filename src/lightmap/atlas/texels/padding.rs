//! The padding of pages: finds the sample that each texel shows. A covered texel shows its own sample; an uncovered one
//! near a chart repeats the nearest, so that bilinear filtering at a chart's border reads no empty texel. Bakes and
//! live updates both compose their pages here, and so agree on every texel.
//!
//! The search is exact: first the nearest covered texel in each column is found, then the best of the columns around.

use super::{Group, NONE, TexelMap};
use crate::base::error::{Error, Result};
use crate::base::memory::try_push;
use std::collections::HashMap;
use std::ops::Range;

/// A rectangle of a page: columns and rows. The rectangle around a chart may reach beyond the page.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct PageArea {
    pub columns: Range<i32>,
    pub rows: Range<i32>,
}

impl PageArea {
    /// Returns the rectangle of a whole square page.
    pub fn page(size: u32) -> PageArea {
        PageArea { columns: 0..size as i32, rows: 0..size as i32 }
    }

    fn clipped(&self, to: &PageArea) -> PageArea {
        let clip = |a: &Range<i32>, b: &Range<i32>| a.start.max(b.start)..a.end.min(b.end);
        PageArea { columns: clip(&self.columns, &to.columns), rows: clip(&self.rows, &to.rows) }
    }

    fn grown(&self, by: i32) -> PageArea {
        let grow = |a: &Range<i32>| a.start - by..a.end + by;
        PageArea { columns: grow(&self.columns), rows: grow(&self.rows) }
    }

    /// Returns the index of a texel in a row-major array of the rectangle.
    fn index(&self, x: i32, y: i32) -> Option<usize> {
        let inside = self.columns.contains(&x) && self.rows.contains(&y);
        inside.then(|| (y - self.rows.start) as usize * self.columns.len() + (x - self.columns.start) as usize)
    }
}

impl TexelMap {
    /// Returns the number of groups: all given charts of a page are one group, and every other placement is a group by
    /// itself.
    pub(crate) fn group_count(&self) -> usize {
        self.groups.len()
    }

    /// Returns the page of a group and the rectangle of texels that it shows with `padding` texels around its charts.
    /// The rectangles of packed charts have their padding inside; around given charts it may reach beyond the page.
    pub(crate) fn group_area(&self, group: usize, padding: u32) -> (u32, PageArea) {
        let g = &self.groups[group];
        (g.page, g.area().grown(if g.given { padding as i32 } else { 0 }))
    }

    /// Returns the groups of a page.
    pub(crate) fn groups_of_page(&self, page: u32) -> impl Iterator<Item = usize> {
        (0..self.groups.len()).filter(move |&g| self.groups[g].page == page)
    }

    /// Composes a rectangle of a page from `groups`, which must include all groups that overlap it, each once. `out` is
    /// row-major and unchanged at texels that show no sample. `value` returns the value of a sample; a texel of the
    /// padding gets `fill` of the value of the nearest sample within `padding` rows and columns (the first of equally
    /// near ones).
    pub(crate) fn compose<T: Copy>(
        &self,
        groups: impl Iterator<Item = usize>,
        area: &PageArea,
        padding: u32,
        out: &mut [T],
        mut value: impl FnMut(u32) -> T,
        fill: impl Fn(T) -> T,
    ) -> Result<()> {
        let (mut filled, mut outside) = (Vec::new(), HashMap::new());
        for group in groups {
            filled.clear();
            self.shown(group, area, padding, &mut |x, y, sample, is_covered| {
                let Some(i) = area.index(x, y) else { return Ok(()) };
                if is_covered {
                    out[i] = value(sample);
                    return Ok(());
                }
                try_push(&mut filled, (i, sample), "the padding of a page")
            })?;
            // Up to a dozen texels of the padding repeat a sample: its value is not computed again.
            for &(i, sample) in &filled {
                let t = &self.samples[sample as usize];
                out[i] = fill(match area.index(t.x as i32, t.y as i32) {
                    Some(own) => out[own],
                    None => {
                        let no_room = |_| Error::OutOfMemory("the padding of a page".into());
                        outside.try_reserve(1).map_err(no_room)?;
                        *outside.entry(sample).or_insert_with(|| value(sample))
                    }
                });
            }
        }
        Ok(())
    }

    /// Calls `visit` with column, row, sample and whether the texel is covered for every texel of `area` that a
    /// group shows, row by row, up to its first error.
    pub(super) fn shown(
        &self,
        group: usize,
        area: &PageArea,
        padding: u32,
        visit: &mut dyn FnMut(i32, i32, u32, bool) -> Result<()>,
    ) -> Result<()> {
        let window = self.groups[group].area();
        let reach = padding as i32;
        let shown = self.group_area(group, padding).1.clipped(area);
        if shown.columns.is_empty() || shown.rows.is_empty() {
            return Ok(());
        }
        let around = shown.grown(reach).clipped(&window);
        let width = window.columns.len();
        let entries = self.entries(&self.groups[group]);
        let entry =
            |x: i32, y: i32| entries[(y - window.rows.start) as usize * width + (x - window.columns.start) as usize];
        // Rows of the nearest covered texels of each column: at or above the present row, and at or below it.
        let mut above = vec![i32::MIN; around.columns.len()];
        let mut below = vec![i32::MIN; around.columns.len()];
        for y in shown.rows.clone() {
            for (i, x) in around.columns.clone().enumerate() {
                if y == shown.rows.start {
                    let rows = around.rows.start..around.rows.end.min(y + 1);
                    above[i] = rows.rev().find(|&row| entry(x, row) != NONE).unwrap_or(i32::MIN);
                } else if around.rows.contains(&y) && entry(x, y) != NONE {
                    above[i] = y;
                }
                if below[i] < y {
                    let rows = y.max(around.rows.start)..around.rows.end.min(y + reach + 1);
                    below[i] = rows.into_iter().find(|&row| entry(x, row) != NONE).unwrap_or(i32::MIN);
                }
            }
            let is_near = |row: i32| row != i32::MIN && row.abs_diff(y) <= padding;
            for x in shown.columns.clone() {
                if window.index(x, y).is_some() && entry(x, y) != NONE {
                    visit(x, y, entry(x, y), true)?;
                    continue;
                }
                let columns = around.columns.start.max(x - reach)..around.columns.end.min(x + reach + 1);
                let nearest = columns
                    .flat_map(|column| {
                        let i = (column - around.columns.start) as usize;
                        [above[i], below[i]].map(|row| (column, row))
                    })
                    .filter(|&(_, row)| is_near(row))
                    .map(|(column, row)| ((column - x).pow(2) + (row - y).pow(2), entry(column, row)))
                    .min();
                if let Some((_, sample)) = nearest {
                    visit(x, y, sample, false)?;
                }
            }
        }
        Ok(())
    }
}

impl Group {
    /// Returns the rectangle of the group's window.
    fn area(&self) -> PageArea {
        let (x, y) = (self.window.x as i32, self.window.y as i32);
        PageArea { columns: x..x + self.window.w as i32, rows: y..y + self.window.h as i32 }
    }
}
