//! Reads rectangles of the shown light: finds the groups of charts that lie in a rectangle, and composes them.

use super::blocks::{BlockMap, Rect};
use super::display::Display;
use super::lists::Lists;
use super::{CellInfo, Live, NO_LOD, PageRect};
use crate::base::error::{Error, Result, invalid_argument};
use crate::base::memory::{try_append, try_vec};
use crate::base::parallel::ParallelLoop;
use crate::lightmap::atlas::ids::LightTexel;
use crate::lightmap::atlas::texels::PageArea;
use crate::lightmap::{Layer, directional};
use glam::Vec3;
use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::{Duration, Instant};

/// Side of a bin in texels. (16 is no faster: the time goes into the search for the nearest texel in the padding.)
const BIN: i32 = 64;

/// Number of rows that a thread composes at a time.
const ROWS: usize = 16;

/// Rectangles of fewer texels are composed by the calling thread: waking others would take longer.
const SMALL: usize = 4096;

/// Groups of charts (see [`TexelMap::group_count`](crate::lightmap::atlas::texels::TexelMap)) by position, in bins of
/// 64 × 64 texels of the pages.
pub(super) struct ChartBins {
    /// Number of bins along a side of a page.
    side: i32,
    bins: Lists,
}

impl ChartBins {
    pub fn new(map: &BlockMap) -> Result<ChartBins> {
        let atlas = &map.atlas;
        let side = (atlas.map.layout.page_size as i32 + BIN - 1) / BIN;
        let count = (side * side) as usize * atlas.info.page_count as usize;
        let bins = Lists::new(count, "where charts lie", |add| {
            for group in 0..atlas.map.texels.group_count() {
                let (page, area) = atlas.map.texels.group_area(group, atlas.padding);
                overlapping(side, page, &area).for_each(|bin| add(bin, group as u32));
            }
        })?;
        Ok(ChartBins { side, bins })
    }

    /// Groups that a rectangle of a page may show, with their padding, in order.
    fn groups(&self, page: u32, area: &PageArea) -> Result<Vec<u32>> {
        let mut all = Vec::new();
        for bin in overlapping(self.side, page, area) {
            try_append(&mut all, self.bins.get(bin), "the charts of a page")?;
        }
        all.sort_unstable();
        all.dedup();
        Ok(all)
    }

    pub fn bytes(&self) -> usize {
        self.bins.bytes()
    }
}

/// Indices of the bins that a rectangle of a page overlaps; pages have `side` bins along each side.
fn overlapping(side: i32, page: u32, area: &PageArea) -> impl Iterator<Item = usize> + use<> {
    let clamp = |v: i32| v.clamp(0, side - 1);
    let columns = clamp(area.columns.start / BIN)..clamp((area.columns.end - 1) / BIN) + 1;
    let rows = clamp(area.rows.start / BIN)..clamp((area.rows.end - 1) / BIN) + 1;
    rows.flat_map(move |j| columns.clone().map(move |i| (i, j)))
        .map(move |(i, j)| (page as usize * side as usize + j as usize) * side as usize + i as usize)
}

/// What is read of the shown light: parts of the irradiance, by bits of [`directional`], or a layer of light by
/// direction.
#[derive(Clone, Copy)]
enum Shown {
    Irradiance(u32),
    ByDirection(Layer),
}

/// Recent time of reading a texel of the shown light.
#[derive(Default)]
pub(super) struct ReadingTime {
    /// Nanoseconds and texels of the reads since the last update. Reads may run side by side.
    nanoseconds: AtomicU64,
    texels: AtomicU64,
    per_texel: f64,
}

impl ReadingTime {
    /// Time in seconds of a texel, small rectangles included.
    pub fn per_texel(&self) -> f64 {
        if self.per_texel > 0.0 { self.per_texel } else { 2e-7 }
    }

    /// Takes the reads since the last update into account. Slow ones count at once, fast ones by and by: time that is
    /// kept free in vain is less harm than a frame that is late.
    pub fn settle(&mut self) {
        let (nanoseconds, texels) = (std::mem::take(self.nanoseconds.get_mut()), std::mem::take(self.texels.get_mut()));
        // Of few texels the call takes longer than the texels.
        if texels >= 1024 {
            let (old, new) = (self.per_texel(), 1e-9 * nanoseconds as f64 / texels as f64);
            // One read that had to wait for something says nothing about the next.
            let new = new.min(4.0 * old);
            self.per_texel = old + if new > old { 0.5 } else { 0.02 } * (new - old);
        }
    }

    fn note(&self, texels: usize, time: Duration) {
        self.nanoseconds.fetch_add(time.as_nanos() as u64, Relaxed);
        self.texels.fetch_add(texels as u64, Relaxed);
    }
}

impl Live {
    /// Light shown in a rectangle of a page, row by row: combined, indirect or direct irradiance, or a layer of light by
    /// direction, if that was asked for. Texels around charts repeat the chart's nearest texel, up to the padding. `lod`
    /// below the highest: reads the light as it would be shown if no block were above it (slow).
    pub fn read(&self, rect: &PageRect, lod: u32, layer: Layer) -> Result<Vec<[f32; 3]>> {
        let layer = self.shown(layer)?;
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
        let mut out = try_vec::<[f32; 3]>(rect.width as usize * rect.height as usize, "a page")?;
        let r = Rect { x0: rect.x as i32, y0: rect.y as i32, x1: right as i32, y1: bottom as i32 };
        if r.area() == 0 {
            return Ok(out);
        }
        let start = Instant::now();
        let is_lower = lod + 1 < self.params.lod_count;
        let lower = is_lower.then(|| self.display.lowered(&self.context.map, lod as u8)).transpose()?;
        let display = lower.as_ref().unwrap_or(&self.display);
        let compose = |(i, out): (usize, &mut [[f32; 3]])| {
            let y0 = r.y0 + (i * ROWS) as i32;
            let rows = Rect { y0, y1: (y0 + ROWS as i32).min(r.y1), ..r };
            self.compose(display, rect.page, &rows, layer, out)
        };
        if r.area() < SMALL {
            out.chunks_mut(r.width() * ROWS).enumerate().try_for_each(compose)?;
        } else {
            let device = atlas.scene.device();
            device.install(|| out.par_chunks_mut(r.width() * ROWS).enumerate().try_each(compose))?;
        }
        if !is_lower {
            self.reading.note(r.area(), start.elapsed());
        }
        Ok(out)
    }

    /// Whether a layer is shown, and how.
    fn shown(&self, layer: Layer) -> Result<Shown> {
        match layer {
            Layer::Combined => Ok(Shown::Irradiance(directional::INDIRECT | directional::DIRECT)),
            Layer::Indirect => Ok(Shown::Irradiance(directional::INDIRECT)),
            Layer::Direct => Ok(Shown::Irradiance(directional::DIRECT)),
            _ if !layer.is_directional() => invalid_argument!("layer is {layer:?}, which live updates do not show"),
            _ if !self.display.has_directional() => {
                Err(Error::InvalidState("the live object was created without light by direction".into()))
            }
            _ => Ok(Shown::ByDirection(layer)),
        }
    }

    fn compose(&self, display: &Display, page: u32, rows: &Rect, layer: Shown, out: &mut [[f32; 3]]) -> Result<()> {
        let (map, light) = (&self.context.map, &*self.context.light);
        let atlas = &map.atlas;
        let area = PageArea { columns: rows.x0..rows.x1, rows: rows.y0..rows.y1 };
        let groups = self.bins.groups(page, &area)?.into_iter().map(|g| g as usize);
        let texels = &atlas.map.texels;
        let texel = |i: u32| LightTexel::new(i as usize);
        match layer {
            Shown::Irradiance(parts) => {
                let value = |i| display.irradiance(map, light, texel(i), parts).to_array();
                texels.compose(groups, &area, atlas.padding, out, value, |v| v)
            }
            Shown::ByDirection(layer) => {
                let parts = self.params.directional;
                let value = |i| layer.of_directional(&display.directional(map, light, texel(i), parts)).to_array();
                texels.compose(groups, &area, atlas.padding, out, value, |v| v)
            }
        }
    }
}

impl Live {
    /// Removes and returns up to `capacity` rectangles whose shown light has changed since they were last taken. At
    /// first these are all pages.
    pub fn take_dirty(&mut self, capacity: usize) -> Result<Vec<PageRect>> {
        let mut all = Vec::new();
        while all.len() < capacity {
            // Makes room before it takes a rectangle, so that none is lost.
            if all.len() == all.capacity() && all.try_reserve(1).is_err() {
                if all.is_empty() {
                    return Err(Error::OutOfMemory("the list of changes".into()));
                }
                break;
            }
            let count = all.len();
            self.take_each_dirty(1, |rect| all.push(rect));
            if all.len() == count {
                break;
            }
        }
        Ok(all)
    }

    /// Does the work of [`take_dirty`](Self::take_dirty), but passes the rectangles to `put` one by one.
    pub fn take_each_dirty(&mut self, capacity: usize, mut put: impl FnMut(PageRect)) {
        self.dirty.take(capacity, |page, r| {
            let (width, height) = (r.width() as u32, r.height() as u32);
            put(PageRect { page, x: r.x0 as u32, y: r.y0 as u32, width, height });
        });
    }

    /// Width and height of the pages: the same as those of the light map.
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
    /// Sums and numbers of rays of every gather texel, by sample: the part of the state that bakes share. For tests.
    pub fn sums(&mut self) -> Result<Vec<([f32; 3], u32)>> {
        self.collect_now()?;
        let mut sums = try_vec(self.context.map.atlas.gather.len(), "the sums of texels")?;
        for (b, tile) in (0..).zip(&self.context.map.tiles) {
            let gathered = self.blocks.work(b).map_or(&[][..], |w| &w.gathered);
            for (&s, g) in tile.texels.iter().zip(gathered) {
                sums[s.index()] = (g.sum.to_array(), g.rays);
            }
        }
        Ok(sums)
    }
}
