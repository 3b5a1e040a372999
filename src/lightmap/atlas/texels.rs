//! Texels: inverse mapping from texels to points on triangles (thesis 3.2.3).
//!
//! Every texel that a chart touches gets one sample: the texel's centre if it lies in the chart, else the centroid of
//! the part in the texel of the chart's triangle that is nearest to the centre. Borders are covered conservatively: any
//! point of a chart lies in a texel that has a sample of this chart. (If the nearest point itself is taken, samples lie
//! exactly on the charts' edges, where walls meet: in a furnished room at 10 texels per metre the mean squared error of
//! light was a tenth more.)

mod inverse_mapping;
mod padding;

use super::charts::Charts;
use super::ids::PlacementId;
use super::layout::Layout;
use crate::base::error::Result;
use crate::base::geometry::unit_normal;
use crate::base::memory::{Reservation, try_collect, try_push, try_to_vec, try_vec, try_with_capacity};
use crate::base::parallel::{ParallelLoop, one_by_one};
use crate::base::progress::Stage;
use crate::scene::{NONE, Object, Scene};
use crate::simd::prefetch;
use glam::Vec3;
use inverse_mapping::{Job, cover_group, sample_group};
pub(crate) use padding::PageArea;
use rayon::prelude::*;
use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// The point on a triangle that a texel shows, in 16 bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub struct TexelSample {
    /// Column of the texel in its page, which is that of the sample's placement.
    pub x: u16,
    /// Row of the texel.
    pub y: u16,
    /// Global triangle number.
    pub triangle: u32,
    /// Weight of the triangle's corner 1; u, v ≥ 0, u + v ≤ 1 up to rounding.
    pub u: f32,
    /// Weight of the triangle's corner 2.
    pub v: f32,
}

impl TexelSample {
    /// Returns the position in the scene.
    #[inline]
    pub fn position(&self, scene: &Scene) -> Vec3 {
        let [a, b, c] = scene.corners(self.triangle).map(|c| c.as_dvec3());
        (a + (b - a) * self.u as f64 + (c - a) * self.v as f64).as_vec3()
    }

    /// Returns the unit geometric normal of the front side.
    #[inline]
    pub fn geometric_normal(&self, scene: &Scene) -> Vec3 {
        scene.normal(self.triangle)
    }

    /// Returns the unit shading normal of the front side: interpolated if the mesh has normals and the result points to
    /// the front, else the geometric normal.
    pub fn shading_normal(&self, scene: &Scene) -> Vec3 {
        let (object, triangle) = scene.locate(self.triangle);
        let object = scene.object(object);
        self.normal_in(object, triangle, object.corners(triangle))
    }

    /// Does the work of [`shading_normal`](Self::shading_normal), given the triangle and its corners.
    #[inline]
    pub(super) fn normal_in(&self, object: Object, triangle: u32, corners: [Vec3; 3]) -> Vec3 {
        let geometric = unit_normal(corners);
        let mesh = object.mesh();
        if mesh.normals.is_empty() {
            return geometric;
        }
        let [a, b, c] = mesh.indices[triangle as usize].map(|i| object.normal(i).as_dvec3());
        let (u, v) = (self.u as f64, self.v as f64);
        let normal = (a * (1.0 - u - v) + b * u + c * v).normalize_or_zero().as_vec3();
        if normal.dot(geometric) > 0.0 { normal } else { geometric }
    }
}

/// Samples to interpolate between, with weights that sum to 1. Unused entries have weight 0 and
/// repeat a used sample.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bilinear {
    /// Numbers of the four samples.
    pub samples: [u32; 4],
    /// Weight of each.
    pub weights: [f32; 4],
}

/// The texels of all charts of a layout.
pub struct TexelMap {
    /// Samples, ordered by placement, row, column.
    pub samples: Vec<TexelSample>,
    /// First sample of each placement, and the number of samples at the end.
    pub chart_start: Vec<u32>,
    /// Texels whose centre is covered by several triangles.
    pub overlapping_texels: u64,
    /// Window of each placement in the index.
    windows: Vec<Window>,
    /// Sample of each texel of each window, row-major, [`NONE`] where there is none.
    index: Vec<u32>,
    groups: Vec<Group>,
    _memory: Vec<Reservation>,
}

/// A rectangle of texels, and the start of its entries in the index.
#[derive(Clone, Copy, Debug)]
struct Window {
    x: u16,
    y: u16,
    w: u16,
    h: u16,
    start: u32,
}

/// Placements that are mapped together: a packed chart alone, or all given charts of a page, since
/// their rectangles may overlap.
#[derive(Clone, Debug)]
struct Group {
    page: u32,
    /// Whether the placements are the caller's, whose rectangles have no padding inside.
    given: bool,
    placements: Range<u32>,
    window: Window,
}

impl Group {
    fn texels(&self) -> usize {
        self.window.w as usize * self.window.h as usize
    }
}

impl TexelMap {
    /// Maps the texels of `layout`, which must be of `charts`, which must be of `scene`. Runs on the
    /// device's threads and advances `stage` by [`work`](Self::work) in all.
    ///
    /// If given charts overlap, a texel belongs to the first triangle that covers its centre, else to the one nearest
    /// to it.
    pub fn build(scene: &Scene, charts: &Charts, layout: &Layout, stage: &Stage) -> Result<TexelMap> {
        let (groups, windows, entries) = groups(layout)?;
        let memory = scene.device().memory();
        let mut map = TexelMap {
            samples: Vec::new(),
            chart_start: try_with_capacity(layout.placements.len() + 1, INDEX)?,
            overlapping_texels: 0,
            _memory: vec![memory.reserve(entries * 4 + windows.len() * 16, INDEX)?],
            windows,
            index: try_vec(entries, INDEX)?,
            groups,
        };
        scene.device().install(|| {
            let job = Job { charts, layout, stage };
            map.cover(&job)?;
            let bytes = map.sample_count() * size_of::<TexelSample>();
            map._memory.push(memory.reserve(bytes, "the texel samples")?);
            map.sample(&job)
        })?;
        Ok(map)
    }

    /// Copies the map, but makes the samples of placements that are `anew` as [`build`](Self::build) does, whatever has
    /// become of them since, and perhaps of others on the same page. Advances `stage` by one per placement.
    pub(in crate::lightmap) fn copied(
        &self,
        scene: &Scene,
        charts: &Charts,
        layout: &Layout,
        anew: &(dyn Fn(PlacementId) -> bool + Sync),
        stage: &Stage,
    ) -> Result<TexelMap> {
        let mut map = TexelMap {
            _memory: vec![scene.device().memory().reserve(self.bytes(), "the texel samples")?],
            samples: try_to_vec(&self.samples, "the texel samples")?,
            chart_start: try_to_vec(&self.chart_start, INDEX)?,
            overlapping_texels: self.overlapping_texels,
            windows: try_to_vec(&self.windows, INDEX)?,
            index: try_to_vec(&self.index, INDEX)?,
            groups: try_to_vec(&self.groups, INDEX)?,
        };
        let job = Job { charts, layout, stage };
        let sizes = group_sizes(&map.groups, &map.chart_start);
        let owners = split(&mut map.index, map.groups.iter().map(Group::texels))?;
        let samples = split(&mut map.samples, sizes)?;
        let (groups, chart_start) = (&map.groups, &map.chart_start);
        scene.device().install(|| {
            let groups = groups.par_iter().zip(owners).zip(samples);
            groups.try_each_with(Vec::new, |scratch, ((group, owners), samples)| {
                let mut placements = group.placements.clone().map(|p| PlacementId::new(p as usize));
                if placements.any(anew) {
                    let mut counts = try_vec(group.placements.len(), INDEX)?;
                    cover_group(&job, group, owners, scratch, &mut counts)?;
                    sample_group(&job, group, chart_start, owners, samples)?;
                }
                stage.advance(group.placements.len() as u64)
            })
        })?;
        Ok(map)
    }

    /// Returns the number of steps by which building a map of `layout` advances its stage.
    pub fn work(layout: &Layout) -> u64 {
        2 * layout.placements.len() as u64
    }

    /// Returns the placement of a sample: the chart's number, or the placement of its back.
    pub fn placement_of(&self, sample: u32) -> PlacementId {
        PlacementId::new(self.chart_start.partition_point(|&first| first <= sample) - 1)
    }

    /// Returns the samples of a placement.
    #[inline]
    pub fn samples_of(&self, placement: PlacementId) -> Range<u32> {
        self.chart_start[placement.index()]..self.chart_start[placement.index() + 1]
    }

    /// Returns the sample of a texel (x, y) of the page, [`NONE`] if it lies outside the placement's rectangle or is
    /// not covered. Among given charts it may be the sample of another chart.
    #[inline]
    pub fn texel_index(&self, placement: PlacementId, x: u32, y: u32) -> u32 {
        let w = &self.windows[placement.index()];
        let (x, y) = (x.wrapping_sub(w.x as u32), y.wrapping_sub(w.y as u32));
        if x < w.w as u32 && y < w.h as u32 { self.index[w.at(x, y)] } else { NONE }
    }

    /// Returns the samples of the texels at some offsets from (x, y), as [`texel_index`](Self::texel_index) does.
    #[inline(always)] // The window stays in registers, and the offsets are constants.
    pub fn around<const N: usize>(&self, placement: PlacementId, x: i32, y: i32, offsets: [(i32, i32); N]) -> [u32; N] {
        let w = &self.windows[placement.index()];
        let (x, y) = (x - i32::from(w.x), y - i32::from(w.y));
        offsets.map(|(dx, dy)| {
            let (x, y) = ((x + dx) as u32, (y + dy) as u32);
            if x < u32::from(w.w) && y < u32::from(w.h) { self.index[w.at(x, y)] } else { NONE }
        })
    }

    /// Returns the sample nearest to a texel coordinate of the placement's page.
    #[inline]
    pub fn nearest(&self, placement: PlacementId, coord: [f32; 2]) -> u32 {
        self.nearest_of(placement, self.entry(placement, coord))
    }

    /// Returns the entry in the index that [`nearest_of`](Self::nearest_of) reads for a texel coordinate.
    #[inline]
    pub fn entry(&self, placement: PlacementId, coord: [f32; 2]) -> usize {
        let w = &self.windows[placement.index()];
        w.at(w.column(coord[0]), w.row(coord[1]))
    }

    /// Asks for an entry of the index.
    #[inline]
    pub fn prefetch(&self, entry: usize) {
        if let Some(entry) = self.index.get(entry) {
            prefetch(entry);
        }
    }

    /// Returns the sample nearest to an [`entry`](Self::entry) of a placement.
    #[inline]
    pub fn nearest_of(&self, placement: PlacementId, entry: usize) -> u32 {
        let sample = self.index[entry];
        if sample != NONE {
            return sample;
        }
        let w = &self.windows[placement.index()];
        let place = (entry - w.start as usize) as u32;
        self.search(w, place % u32::from(w.w), place / u32::from(w.w))
    }

    /// Returns up to four samples around a texel coordinate of the placement's page. The weight of texels without a
    /// sample, and of those outside the placement's rectangle, is shared by the others.
    #[inline]
    pub fn bilinear(&self, placement: PlacementId, coord: [f32; 2]) -> Bilinear {
        let w = &self.windows[placement.index()];
        let (cx, cy) = (coord[0] - 0.5, coord[1] - 0.5);
        let (x0, y0) = (floor(cx), floor(cy));
        let (fx, fy) = (cx - x0, cy - y0);
        let (xs, ys) = ([w.column(x0), w.column(x0 + 1.0)], [w.row(y0), w.row(y0 + 1.0)]);
        let at = |i: usize| self.index[w.at(xs[i & 1], ys[i >> 1])];
        let mut samples = [at(0), at(1), at(2), at(3)];
        let mut weights = [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy];
        let mut sum = 0.0;
        for i in 0..4 {
            if samples[i] == NONE {
                weights[i] = 0.0;
            }
            sum += weights[i];
        }
        // The texel of a coordinate in the chart is covered and has a weight of at least 1/4. A coordinate that
        // rounding moved out of the chart gets the nearest sample.
        if !(sum > 0.01) {
            return Bilinear { samples: [self.nearest(placement, coord); 4], weights: [1.0, 0.0, 0.0, 0.0] };
        }
        let used = (0..4).find(|&i| weights[i] > 0.0).map_or(samples[0], |i| samples[i]);
        for i in 0..4 {
            samples[i] = if samples[i] == NONE { used } else { samples[i] };
            weights[i] /= sum;
        }
        Bilinear { samples, weights }
    }

    /// Returns the size in bytes.
    pub fn bytes(&self) -> usize {
        size_of_val(&self.samples[..])
            + (self.index.len() + self.chart_start.len()) * 4
            + size_of_val(&self.windows[..])
    }

    fn sample_count(&self) -> usize {
        *self.chart_start.last().unwrap_or(&0) as usize
    }

    fn entries(&self, group: &Group) -> &[u32] {
        &self.index[group.window.start as usize..][..group.texels()]
    }

    #[cold]
    fn search(&self, w: &Window, x: u32, y: u32) -> u32 {
        let mut best = (u64::MAX, NONE);
        for row in 0..w.h as u32 {
            let dy = row.abs_diff(y) as u64;
            if dy * dy >= best.0 {
                continue;
            }
            for column in 0..w.w as u32 {
                let dx = column.abs_diff(x) as u64;
                let sample = self.index[w.at(column, row)];
                if sample != NONE {
                    best = best.min((dx * dx + dy * dy, sample));
                }
            }
        }
        best.1
    }

    /// First pass: finds the triangle that each texel belongs to, and counts the texels of each placement.
    fn cover(&mut self, job: &Job) -> Result<()> {
        let slices = split(&mut self.index, self.groups.iter().map(Group::texels))?;
        let placements = self.groups.last().map_or(0, |g| g.placements.end as usize);
        let mut counts: Vec<u32> = try_vec(placements, INDEX)?;
        let of_groups = split(&mut counts, self.groups.iter().map(|g| g.placements.len()))?;
        let overlapping = AtomicU64::new(0);
        self.groups.par_iter().zip(slices).zip(of_groups).try_each_with(
            Vec::new,
            |scratch, ((group, owners), counts)| {
                overlapping.fetch_add(cover_group(job, group, owners, scratch, counts)?, Relaxed);
                job.stage.advance(group.placements.len() as u64)
            },
        )?;
        self.overlapping_texels = overlapping.into_inner();
        let mut first = 0;
        for count in counts {
            self.chart_start.push(first);
            first += count;
        }
        self.chart_start.push(first);
        Ok(())
    }

    /// Second pass: makes the samples, and writes their numbers to the index.
    fn sample(&mut self, job: &Job) -> Result<()> {
        self.samples = try_vec(self.sample_count(), "the texel samples")?;
        let sizes = group_sizes(&self.groups, &self.chart_start);
        let owners = split(&mut self.index, self.groups.iter().map(Group::texels))?;
        let samples = split(&mut self.samples, sizes)?;
        one_by_one(self.groups.par_iter().zip(owners).zip(samples)).try_each(|((group, owners), samples)| {
            sample_group(job, group, &self.chart_start, owners, samples)?;
            job.stage.advance(group.placements.len() as u64)
        })
    }
}

impl Window {
    #[inline]
    fn at(&self, x: u32, y: u32) -> usize {
        self.start as usize + y as usize * self.w as usize + x as usize
    }

    /// Returns the column of the window that a coordinate of the page lies in, clamped to the window. (NaN gives 0.)
    #[inline]
    fn column(&self, x: f32) -> u32 {
        (x - self.x as f32).max(0.0).min(self.w as f32 - 1.0) as u32
    }

    #[inline]
    fn row(&self, y: f32) -> u32 {
        (y - self.y as f32).max(0.0).min(self.h as f32 - 1.0) as u32
    }
}

/// Rounds a coordinate down. (`f32::floor` is a call into the C library, since SSE4.1 is not required: reading live
/// light takes 80 ns per texel, with that call 92.)
#[inline]
fn floor(x: f32) -> f32 {
    let towards_zero = x as i32 as f32;
    if towards_zero > x { towards_zero - 1.0 } else { towards_zero }
}

fn groups(layout: &Layout) -> Result<(Vec<Group>, Vec<Window>, usize)> {
    let mut groups: Vec<Group> = Vec::new();
    let mut start = 0;
    let placements = &layout.placements[..];
    let (given, packed) = placements.split_at(layout.given as usize);
    let runs = given.chunk_by(|a, b| a.page == b.page).chain(packed.chunks(1));
    for run in runs {
        let first = groups.last().map_or(0, |g: &Group| g.placements.end);
        let x = run.iter().map(|p| p.x).min().unwrap_or(0);
        let y = run.iter().map(|p| p.y).min().unwrap_or(0);
        let w = run.iter().map(|p| p.x + p.w).max().unwrap_or(0) - x;
        let h = run.iter().map(|p| p.y + p.h).max().unwrap_or(0) - y;
        let window = Window { x, y, w, h, start: start as u32 };
        let (page, is_given) = (run[0].page, first < layout.given);
        let placements = first..first + run.len() as u32;
        try_push(&mut groups, Group { page, given: is_given, placements, window }, INDEX)?;
        start += w as usize * h as usize;
    }
    let windows = try_collect(groups.iter().flat_map(|g| g.placements.clone().map(|_| g.window)), INDEX)?;
    Ok((groups, windows, start))
}

fn group_sizes<'a>(groups: &'a [Group], chart_start: &'a [u32]) -> impl Iterator<Item = usize> + 'a {
    let start = |placement: u32| chart_start[placement as usize] as usize;
    groups.iter().map(move |g| start(g.placements.end) - start(g.placements.start))
}

/// Splits `all` into consecutive pieces.
fn split<T>(mut all: &mut [T], sizes: impl Iterator<Item = usize>) -> Result<Vec<&mut [T]>> {
    let mut pieces = Vec::new();
    for size in sizes {
        let (piece, rest) = all.split_at_mut(size);
        try_push(&mut pieces, piece, INDEX)?;
        all = rest;
    }
    Ok(pieces)
}

/// Name of the buffers in error messages.
const INDEX: &str = "the index of texels";

#[cfg(test)]
mod tests;
