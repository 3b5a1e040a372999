//! Photons in a uniform grid (thesis 3.2.2).
//!
//! Cells are cubes with a fixed fraction of the search radius as their size. Photons lie sorted by
//! cell, cells by z, then y, then x: the photons that a query wants from one row of cells along x
//! are one run of memory, ready for wide loads. A cell costs four bytes, full or empty, and there
//! are at most [`CELLS_PER_PHOTON`] per photon: where a radius is tiny for the size of the scene,
//! cells grow, and queries look at more photons instead.
//!
//! The sort is a stable counting sort in two parallel steps, so its result is a function of the
//! photons' order alone: first each block of photons is sorted by ranges of cells; then each range
//! collects its photons from all blocks, in their order, and sorts them by cell into its own part
//! of the arrays.

use super::PhotonView;
use super::cylinder::Cylinder;
use super::trace::{StoredPhoton, Traced};
use crate::base::error::{Error, Result};
use crate::base::memory::{Reservation, try_par_collect_ok, try_to_vec, try_vec, try_with_capacity};
use crate::base::parallel::ParallelLoop;
use crate::base::progress::{Progress, Stage};
use glam::{DVec3, Vec3};
use rayon::prelude::*;

/// Cell size as a fraction of the search radius.
const CELL_SIZE: f64 = 0.5;
/// Maximum number of cells per photon, so that the grid's memory stays below that of the photons.
const CELLS_PER_PHOTON: usize = 4;
/// Maximum number of ranges of cells that are sorted in parallel.
const RANGES: usize = 256;
/// Number of entries behind the last photon, so that vectors may be loaded from its index.
const PADDING: usize = 16;
/// Number of components of a photon.
const COLUMNS: usize = 12;

/// Photon components, each in an array of its own.
pub(super) struct Photons {
    /// Position, direction, power and normal, three arrays each, of `len` + [`PADDING`] entries.
    columns: [Vec<f32>; COLUMNS],
    len: usize,
}

impl Photons {
    /// The columns as in [`PhotonView`], and 16 readable floats from each index below the length.
    pub(super) fn view(&self) -> PhotonView<'_> {
        let three = |first: usize| std::array::from_fn(|i| &self.columns[first + i][..self.len]);
        PhotonView { position: three(0), direction: three(3), power: three(6), normal: three(9) }
    }

    /// Start of each column. From every index below [`len`](Self::len), 16 floats can be read.
    #[inline(always)]
    pub(super) fn pointers(&self) -> [*const f32; COLUMNS] {
        std::array::from_fn(|i| self.columns[i].as_ptr())
    }
}

/// The grid with its photons.
pub(super) struct Grid {
    pub(super) photons: Photons,
    frame: Frame,
    /// First photon of each cell, and the number of photons.
    starts: Vec<u32>,
}

/// Position and size of the cells.
#[derive(Clone, Copy, Debug)]
struct Frame {
    lower: DVec3,
    /// Number of cells per scene unit.
    inverse_size: f64,
    dims: [usize; 3],
}

impl Frame {
    /// Lays cells of about `size` over a box, but at most `most` of them.
    fn new(lower: Vec3, upper: Vec3, size: f64, most: usize) -> Frame {
        let extent = (upper.as_dvec3() - lower.as_dvec3()).max(DVec3::ZERO);
        let cells = |size: f64| (extent / size).floor() + DVec3::ONE;
        let count = |size: f64| cells(size).element_product();
        let mut size = size;
        if count(size) > most as f64 {
            let (mut low, mut high) = (size, extent.max_element());
            for _ in 0..64 {
                // Bisects by ratio: the sizes may be many orders of magnitude apart.
                let middle = low.sqrt() * high.sqrt();
                if count(middle) > most as f64 { low = middle } else { high = middle }
            }
            size = high;
        }
        Frame { lower: lower.as_dvec3(), inverse_size: 1.0 / size, dims: cells(size).to_array().map(|n| n as usize) }
    }

    fn cells(&self) -> usize {
        self.dims.iter().product()
    }

    /// Position in units of cells.
    #[inline(always)]
    fn place(&self, p: Vec3) -> DVec3 {
        (p.as_dvec3() - self.lower) * self.inverse_size
    }

    #[inline]
    fn cell(&self, p: Vec3) -> usize {
        // Monotone in each coordinate, like the ranges of queries, so rounding loses no photon.
        let c = self.place(p).to_array();
        let [x, y, z] = [0, 1, 2].map(|i| (c[i] as usize).min(self.dims[i] - 1));
        (z * self.dims[1] + y) * self.dims[0] + x
    }
}

impl Grid {
    /// Sorts photons for queries with `radius`.
    pub(super) fn build(
        traced: Traced,
        radius: f32,
        progress: &Progress,
        (from, to): (f32, f32),
    ) -> Result<(Grid, Reservation)> {
        let Traced { mut blocks, memory: account, .. } = traced;
        let len: usize = blocks.iter().map(Vec::len).sum();
        if len >= u32::MAX as usize {
            return Err(Error::OutOfMemory(format!("{len} photons were stored, more than {}", u32::MAX - 1)));
        }
        let (lower, upper) = bounds(&blocks);
        let most = (len * CELLS_PER_PHOTON).clamp(1, i32::MAX as usize);
        let frame = Frame::new(lower, upper, radius as f64 * CELL_SIZE, most);
        let cells = frame.cells();
        let bytes = COLUMNS * 4 * (len + PADDING) + 4 * (cells + 1);
        let memory = account.reserve(bytes, "the photon map")?;

        let stage = progress.stage("photon grid", from, to, 2 * blocks.len() as u64);
        let ranges = Ranges::new(cells);
        let sorted = blocks.par_iter_mut().map(|block| {
            stage.advance(1)?;
            sort_block(block, &frame, &ranges)
        });
        let offsets: Vec<Vec<u32>> = try_par_collect_ok(sorted, "the photons being sorted")?;
        let mut columns: [Vec<f32>; COLUMNS] = Default::default();
        for column in &mut columns {
            *column = try_vec(len + PADDING, "the photon map")?;
        }
        let mut starts: Vec<u32> = try_vec(cells + 1, "the photon grid")?;
        starts[cells] = len as u32;
        fill_ranges(&blocks, &offsets, &frame, &ranges, &mut starts[..cells], &mut columns, &stage)?;
        Ok((Grid { photons: Photons { columns, len }, frame, starts }, memory))
    }

    /// Bytes held.
    pub(super) fn bytes(&self) -> usize {
        self.photons.columns.iter().map(|c| c.len() * 4).sum::<usize>() + self.starts.len() * 4
    }

    /// The rows of cells that a cylinder around `normal` at `position` may overlap.
    #[inline(always)]
    pub(super) fn search(&self, position: Vec3, normal: Vec3, cylinder: &Cylinder) -> Search {
        let size = self.frame.inverse_size;
        let centre = self.frame.place(position);
        // The margin exceeds all rounding, here and in the test of single photons.
        let grow = |length: f64| length * size * 1.0001 + 1e-6;
        let radius = cylinder.radius as f64;
        let half_height = grow(radius * cylinder.half_height as f64);
        let n = normal.as_dvec3();
        let reach = (DVec3::ONE - n * n).max(DVec3::ZERO).map(f64::sqrt) * grow(radius) + n.abs() * half_height;
        let range = |axis: usize| {
            let last = self.frame.dims[axis] as f64 - 1.0;
            let (low, high) = ((centre[axis] - reach[axis]).floor(), (centre[axis] + reach[axis]).floor());
            // The range is empty if the cylinder lies outside, or if anything is NaN.
            if high >= 0.0 && low <= last { (low.max(0.0) as usize, high.min(last) as usize + 1) } else { (0, 0) }
        };
        let ball2 = grow(radius).powi(2) + half_height.powi(2);
        Search { centre, normal: n, ball2, half_height, y: range(1), z: range(2) }
    }

    /// The run of photons in the part of row (`y`, `z`) that the cylinder may overlap.
    #[inline(always)]
    pub(super) fn row(&self, s: &Search, y: usize, z: usize) -> (usize, usize) {
        // Nearest and farthest offsets of the row from the cylinder's centre.
        let (dy, dz) = (y as f64 + 0.5 - s.centre.y, z as f64 + 0.5 - s.centre.z);
        let (near_y, near_z) = ((dy.abs() - 0.5).max(0.0), (dz.abs() - 0.5).max(0.0));
        // The cylinder lies in a ball …
        let left = s.ball2 - near_y * near_y - near_z * near_z;
        if left < 0.0 {
            return (0, 0);
        }
        let mut high = left.sqrt();
        let mut low = -high;
        // … and in a slab: |n·d| ≤ half height.
        let middle = s.normal.y * dy + s.normal.z * dz;
        let slack = 0.5 * (s.normal.y.abs() + s.normal.z.abs()) + s.half_height;
        let nx = s.normal.x;
        if nx.abs() > 1e-3 {
            let inverse = 1.0 / nx;
            let (a, b) = ((-middle - slack) * inverse, (-middle + slack) * inverse);
            low = low.max(a.min(b));
            high = high.min(a.max(b));
        } else if middle.abs() > slack + nx.abs() * high {
            return (0, 0);
        }
        let last = self.frame.dims[0] as f64 - 1.0;
        let (low, high) = ((s.centre.x + low).floor(), (s.centre.x + high).floor());
        if !(low <= high && high >= 0.0 && low <= last) {
            return (0, 0);
        }
        let row = (z * self.frame.dims[1] + y) * self.frame.dims[0];
        let (first, end) = (low.max(0.0) as usize, high.min(last) as usize + 1);
        (self.starts[row + first] as usize, self.starts[row + end] as usize)
    }
}

/// A cylinder in units of cells, slightly enlarged, and the rows that it may overlap.
pub(super) struct Search {
    centre: DVec3,
    normal: DVec3,
    /// Square of the radius of a ball around the cylinder.
    ball2: f64,
    half_height: f64,
    /// First row and the one after the last, along y and z.
    pub(super) y: (usize, usize),
    pub(super) z: (usize, usize),
}

fn bounds(blocks: &[Vec<StoredPhoton>]) -> (Vec3, Vec3) {
    let none = (Vec3::INFINITY, Vec3::NEG_INFINITY);
    let both = |a: (Vec3, Vec3), b: (Vec3, Vec3)| (a.0.min(b.0), a.1.max(b.1));
    let of_block = |b: &Vec<StoredPhoton>| b.iter().fold(none, |a, p| both(a, (p.position, p.position)));
    let (lower, upper) = blocks.par_iter().map(of_block).reduce(|| none, both);
    if lower.x <= upper.x { (lower, upper) } else { (Vec3::ZERO, Vec3::ZERO) }
}

/// Ranges of consecutive cells.
struct Ranges {
    cells: usize,
    per_range: usize,
}

impl Ranges {
    fn new(cells: usize) -> Self {
        Ranges { cells, per_range: cells.div_ceil(RANGES).max(1) }
    }

    fn count(&self) -> usize {
        self.cells.div_ceil(self.per_range)
    }
}

/// Sorts a block by range of cells, stably. Returns the start of each range, and the block's length.
fn sort_block(block: &mut Vec<StoredPhoton>, frame: &Frame, ranges: &Ranges) -> Result<Vec<u32>> {
    let range_of = |p: &StoredPhoton| frame.cell(p.position) / ranges.per_range;
    let mut offsets: Vec<u32> = try_vec(ranges.count() + 1, "the photons being sorted")?;
    for p in block.iter() {
        offsets[range_of(p) + 1] += 1;
    }
    for i in 1..offsets.len() {
        offsets[i] += offsets[i - 1];
    }
    let mut next = try_to_vec(&offsets, "the photons being sorted")?;
    let mut sorted: Vec<StoredPhoton> = try_vec(block.len(), "the photons being sorted")?;
    for p in block.iter() {
        let place = &mut next[range_of(p)];
        sorted[*place as usize] = *p;
        *place += 1;
    }
    *block = sorted;
    Ok(offsets)
}

/// A range's own part of the arrays.
struct Part<'a> {
    range: usize,
    /// Index of the part's first photon in the whole.
    first: u32,
    starts: &'a mut [u32],
    columns: [&'a mut [f32]; COLUMNS],
}

fn fill_ranges(
    blocks: &[Vec<StoredPhoton>],
    offsets: &[Vec<u32>],
    frame: &Frame,
    ranges: &Ranges,
    mut starts: &mut [u32],
    columns: &mut [Vec<f32>; COLUMNS],
    stage: &Stage,
) -> Result<()> {
    let mut parts = try_with_capacity(ranges.count(), "the photons being sorted")?;
    let mut columns = columns.each_mut().map(|c| c.as_mut_slice());
    let mut first = 0;
    for range in 0..ranges.count() {
        let len: u32 = offsets.iter().map(|o| o[range + 1] - o[range]).sum();
        let cells = ranges.per_range.min(starts.len());
        parts.push(Part {
            range,
            first,
            starts: starts.split_off_mut(..cells).expect("cells of all ranges add up"),
            columns: columns.each_mut().map(|c| c.split_off_mut(..len as usize).expect("photons of all ranges add up")),
        });
        first += len;
    }
    let per_part = (blocks.len() as u64).div_ceil(parts.len().max(1) as u64);
    parts.into_par_iter().try_each(|part| {
        stage.advance(per_part)?;
        fill_range(part, blocks, offsets, frame, ranges)
    })
}

/// Counting sort of one range.
fn fill_range(
    part: Part,
    blocks: &[Vec<StoredPhoton>],
    offsets: &[Vec<u32>],
    frame: &Frame,
    ranges: &Ranges,
) -> Result<()> {
    let first_cell = part.range * ranges.per_range;
    let run = |offsets: &[u32]| offsets[part.range] as usize..offsets[part.range + 1] as usize;
    let photons = || blocks.iter().zip(offsets).flat_map(|(block, offsets)| &block[run(offsets)]);
    for p in photons() {
        part.starts[frame.cell(p.position) - first_cell] += 1;
    }
    let mut next = part.first;
    for start in part.starts.iter_mut() {
        next += std::mem::replace(start, next);
    }
    let mut next: Vec<u32> = try_vec(part.starts.len(), "the photons being sorted")?;
    next.copy_from_slice(part.starts);
    for p in photons() {
        let place = &mut next[frame.cell(p.position) - first_cell];
        let i = (*place - part.first) as usize;
        *place += 1;
        for (v, value) in [p.position, p.direction, p.power, p.normal].iter().enumerate() {
            for c in 0..3 {
                part.columns[3 * v + c][i] = value[c];
            }
        }
    }
    Ok(())
}
