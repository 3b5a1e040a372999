//! Reading rectangles of the shown light: which placements of charts lie in a rectangle, and their composition with
//! the padding around them.

use super::blocks::{BlockMap, Rect};
use super::display::Display;
use super::{Live, PageRect};
use crate::error::{Result, invalid_argument};
use crate::scene::NONE;
use rayon::prelude::*;

/// Side of a bin in texels. (16 is no faster: time goes to the search of the nearest texel in the padding.)
const BIN: i32 = 64;

/// Rows that a thread composes at a time.
const ROWS: usize = 16;

/// Rectangles of fewer texels are composed by the calling thread: waking others takes longer.
const SMALL: usize = 4096;

/// Placements by where they lie: bins of 64 × 64 texels of the pages.
pub(super) struct ChartBins {
    /// Bins along a side of a page.
    side: i32,
    bins: Vec<Vec<u32>>,
}

impl ChartBins {
    pub fn new(map: &BlockMap) -> ChartBins {
        let layout = &map.atlas.map.layout;
        let side = (layout.page_size as i32 + BIN - 1) / BIN;
        let pages = map.atlas.info.page_count as i32;
        let mut bins = ChartBins { side, bins: vec![Vec::new(); (side * side * pages) as usize] };
        for placement in 0..layout.placements.len() as u32 {
            let (page, rect) = padded(map, placement);
            for i in bins.overlapping(page, &rect) {
                bins.bins[i].push(placement);
            }
        }
        bins
    }

    fn overlapping(&self, page: u32, rect: &Rect) -> impl Iterator<Item = usize> + use<> {
        let side = self.side;
        let clamp = |v: i32| v.clamp(0, side - 1);
        let columns = clamp(rect.x0 / BIN)..clamp((rect.x1 - 1) / BIN) + 1;
        let rows = clamp(rect.y0 / BIN)..clamp((rect.y1 - 1) / BIN) + 1;
        rows.flat_map(move |j| columns.clone().map(move |i| (i, j)))
            .map(move |(i, j)| ((page as i32 * side + j) * side + i) as usize)
    }

    /// Placements that a rectangle of a page may show, with their padding, in order.
    fn placements(&self, page: u32, rect: &Rect) -> Vec<u32> {
        let mut all: Vec<u32> = self.overlapping(page, rect).flat_map(|i| self.bins[i].iter().copied()).collect();
        all.sort_unstable();
        all.dedup();
        all
    }

    pub fn bytes(&self) -> usize {
        self.bins.iter().map(|b| size_of::<Vec<u32>>() + b.capacity() * 4).sum()
    }
}

/// A placement's page and rectangle.
fn placed(map: &BlockMap, placement: u32) -> (u32, Rect) {
    let p = &map.atlas.map.layout.placements[placement as usize];
    (p.page, Rect::of(p))
}

/// A placement's page and rectangle, with padding. (That of given charts lies outside their own.)
fn padded(map: &BlockMap, placement: u32) -> (u32, Rect) {
    let (page, rect) = placed(map, placement);
    (page, if placement < map.atlas.map.layout.given { rect.grown(map.atlas.padding as i32) } else { rect })
}

impl Live {
    /// Irradiance shown in a rectangle of a page, row by row; `with_direct` false: indirect light
    /// alone. Texels around charts repeat the nearest of the chart, up to the padding. `lod` below the
    /// highest: what would be shown if no block were above it (slow).
    pub fn read(&self, rect: &PageRect, lod: u32, with_direct: bool) -> Result<Vec<[f32; 3]>> {
        let atlas = &self.context.map.atlas;
        let size = self.page_size();
        let (right, bottom) = (rect.x as u64 + rect.width as u64, rect.y as u64 + rect.height as u64);
        if rect.page >= atlas.info.page_count || right > size as u64 || bottom > size as u64 {
            let pages = atlas.info.page_count;
            return invalid_argument!("{rect:?} is not within the {pages} pages of {size} × {size} texels");
        }
        if lod >= self.params.lod_count {
            return invalid_argument!("lod is {lod}, the live object has {}", self.params.lod_count);
        }
        let mut out = crate::memory::try_vec::<[f32; 3]>(rect.width as usize * rect.height as usize, "a page")?;
        let r = Rect { x0: rect.x as i32, y0: rect.y as i32, x1: right as i32, y1: bottom as i32 };
        if r.area() == 0 {
            return Ok(out);
        }
        let lower = (lod + 1 < self.params.lod_count).then(|| self.display.lowered(&self.context.map, lod as u8));
        let display = lower.as_ref().unwrap_or(&self.display);
        let compose = |(i, out): (usize, &mut [[f32; 3]])| {
            let y0 = r.y0 + (i * ROWS) as i32;
            let rows = Rect { y0, y1: (y0 + ROWS as i32).min(r.y1), ..r };
            self.compose(display, rect.page, &rows, with_direct, out);
        };
        if r.area() < SMALL {
            out.chunks_mut(r.width() * ROWS).enumerate().for_each(compose);
        } else {
            let device = atlas.scene.device();
            device.install(|| out.par_chunks_mut(r.width() * ROWS).enumerate().for_each(compose));
        }
        Ok(out)
    }

    fn compose(&self, display: &Display, page: u32, rows: &Rect, with_direct: bool, out: &mut [[f32; 3]]) {
        let (map, light) = (&self.context.map, &*self.context.light);
        let atlas = &map.atlas;
        let padding = atlas.padding as i32;
        let mut is_own = vec![false; out.len()];
        // Each sample is looked up and its light put together once, though up to a dozen texels of the
        // padding repeat it.
        let (mut samples, mut values) = (Vec::new(), Vec::new());
        for placement in self.bins.placements(page, rows) {
            let shown = padded(map, placement).1.clipped(rows);
            let from = placed(map, placement).1.clipped(&shown.grown(padding));
            samples.clear();
            samples.extend(from.texels().map(|(x, y)| {
                let s = atlas.map.at(placement, x, y);
                let is_own = s != NONE && atlas.map.placement_of(&atlas.charts, s as usize) == placement;
                if is_own { s } else { NONE }
            }));
            values.clear();
            values.resize(samples.len(), None);
            let index = |x: i32, y: i32| (y - from.y0) as usize * from.width() + (x - from.x0) as usize;
            for (x, y) in shown.texels() {
                let at = (y - rows.y0) as usize * rows.width() + (x - rows.x0) as usize;
                if is_own[at] {
                    continue;
                }
                // Around the chart: the nearest texel within the padding.
                let here = Rect { x0: x, y0: y, x1: x + 1, y1: y + 1 };
                let own = here.clipped(&from).texels().map(|(i, j)| index(i, j)).find(|&i| samples[i] != NONE);
                is_own[at] = own.is_some();
                let nearest = own.or_else(|| {
                    let around = here.grown(padding).clipped(&from);
                    let distance = |(i, j): (i32, i32)| ((i - x).pow(2) + (j - y).pow(2), samples[index(i, j)]);
                    let near =
                        around.texels().filter(|&(i, j)| samples[index(i, j)] != NONE).min_by_key(|&t| distance(t));
                    near.map(|(i, j)| index(i, j))
                });
                if let Some(i) = nearest {
                    let value =
                        values[i].get_or_insert_with(|| display.irradiance(map, light, samples[i], with_direct));
                    out[at] = value.to_array();
                }
            }
        }
    }
}
