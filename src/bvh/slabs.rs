//! Slabs of equal width in a node's box, and the plane between two of them at which a [spatial split](super::spatial)
//! costs least. What a triangle has in each slab is estimated in f32: planes are chosen by it, and boxes of references
//! come from [`cut`](super::cut).

use super::binned::PARALLEL_SUBTREE;
use super::bins::{in_parallel, on_heap};
use super::partings::leaf_weight;
use super::references::{Box4, Reference, half_areas};
use crate::base::parallel::ParallelLoop;
use glam::{Vec3, Vec4};
use rayon::prelude::*;

/// Maximum number of slabs per axis at whose borders planes are tried. (16: up to a fifth faster; cost within 1 % on
/// four scenes, but on San Miguel 4 % higher, and rays visit 13 % more nodes.)
const SLABS: usize = 32;

/// Number of references whose slabs are found before they are added.
const BATCH: usize = 32;

/// One slab on each axis.
#[derive(Clone, Copy)]
struct Slab {
    boxes: [Box4; 3],
    /// Number of references whose first and last slab it is. The fourth is unused.
    first: [i32; 4],
    last: [i32; 4],
}

impl Slab {
    const EMPTY: Slab = Slab { boxes: [Box4::EMPTY; 3], first: [0; 4], last: [0; 4] };

    fn add(&mut self, o: &Slab) {
        for axis in 0..3 {
            self.boxes[axis] = self.boxes[axis].join(o.boxes[axis]);
        }
        for axis in 0..4 {
            self.first[axis] += o.first[axis];
            self.last[axis] += o.last[axis];
        }
    }
}

/// Slabs of equal width in a box.
pub(super) struct Grid {
    slabs: usize,
    lower: Vec3,
    width: Vec3,
    scale: Vec3,
}

impl Grid {
    pub(super) fn new(bounds: &Box4, n: usize) -> Grid {
        let slabs = slab_count(n);
        let (lower, upper) = bounds.corners();
        let width = (upper - lower) / slabs as f32;
        let scale = Vec3::select(width.cmpgt(Vec3::splat(f32::MIN_POSITIVE)), width.recip(), Vec3::ZERO);
        Grid { slabs, lower, width, scale }
    }

    /// First and last slab of a box on each axis.
    #[inline(always)]
    fn slabs_of(&self, b: &Box4) -> [[u32; 3]; 2] {
        let [lower, scale] = [self.lower, self.scale].map(|v| v.extend(0.0));
        let last = Vec4::splat(self.slabs as f32 - 1.0);
        [-b.neg_lower, b.upper].map(|corner| {
            let slab = ((corner - lower) * scale).max(Vec4::ZERO).min(last);
            // SAFETY: 0 ≤ slab < SLABS. No lane is NaN: corners are finite, as those of valid triangles are, and so is
            // the scale.
            [slab.x, slab.y, slab.z].map(|x| unsafe { x.to_int_unchecked() })
        })
    }

    /// The border below slab `i`.
    fn plane(&self, axis: usize, i: usize) -> f32 {
        self.lower[axis] + i as f32 * self.width[axis]
    }
}

/// A plane, and the references it would leave on either side.
pub(super) struct Plane {
    pub(super) cost: f32,
    pub(super) axis: usize,
    pub(super) position: f32,
    pub(super) boxes: [Box4; 2],
    pub(super) counts: [i32; 2],
}

/// An edge of a triangle that runs up an axis.
struct Edge {
    from: Vec4,
    along: Vec4,
    inverse: f32,
}

impl Edge {
    #[inline(always)]
    fn new<const AXIS: usize>(from: Vec4, to: Vec4) -> Edge {
        let along = to - from;
        Edge { from, along, inverse: 1.0 / along[AXIS] }
    }

    /// The point nearest to a plane.
    #[inline(always)]
    fn at<const AXIS: usize>(&self, plane: f32) -> Vec4 {
        let t = (plane - self.from[AXIS]) * self.inverse;
        // Of an edge along the plane, whose `t` may not be a number, any point will do.
        let t = if t > 0.0 { t } else { 0.0 };
        self.from + self.along * if t < 1.0 { t } else { 1.0 }
    }
}

/// Calls `add` with the slabs `first` to `last` of an axis and the boxes of a triangle's parts in them. Only an
/// estimate, in f32.
#[inline(always)]
fn chop<const AXIS: usize>(corners: &[Vec4; 3], [first, last]: [u32; 2], grid: &Grid, mut add: impl FnMut(u32, Box4)) {
    let sort = |a: Vec4, b: Vec4| {
        let up = Vec4::splat(a[AXIS]).cmple(Vec4::splat(b[AXIS]));
        (Vec4::select(up, a, b), Vec4::select(up, b, a))
    };
    let (a, b) = sort(corners[0], corners[1]);
    let (b, c) = sort(b, corners[2]);
    let (a, b) = sort(a, b);
    let (whole, lower, upper) = (Edge::new::<AXIS>(a, c), Edge::new::<AXIS>(a, b), Edge::new::<AXIS>(b, c));
    let [low, middle, high] = [a, b, c].map(|p| (p[AXIS] - grid.lower[AXIS]) * grid.scale[AXIS]);
    // Where a plane cuts the triangle.
    let section = |i: u32| {
        let plane = grid.plane(AXIS, i as usize);
        let short = if plane < b[AXIS] { &lower } else { &upper };
        let mut section = Box4::EMPTY;
        section.add(whole.at::<AXIS>(plane));
        section.add(short.at::<AXIS>(plane));
        section
    };
    let point = |p: Vec4| Box4 { neg_lower: -p, upper: p };
    let mut below = if low < first as f32 { section(first) } else { point(a) };
    for i in first..=last {
        let above = if i == last && high < (last + 1) as f32 { point(c) } else { section(i + 1) };
        let mut part = below.join(above);
        if i as f32 <= middle && middle < (i + 1) as f32 {
            part.add(b);
        }
        add(i, part);
        below = above;
    }
}

/// The slabs of a node, and scratch space for the parts to the right of each. On the heap as [`Bins`] are.
pub(super) struct Slabs {
    slabs: Box<[Slab; SLABS]>,
    right: Box<[Slab; SLABS]>,
}

impl Slabs {
    pub(super) fn new() -> Slabs {
        Slabs { slabs: on_heap(Slab::EMPTY), right: on_heap(Slab::EMPTY) }
    }

    pub(super) fn fill(&mut self, refs: &[Reference], corners: &(impl Fn(u32) -> [Vec3; 3] + Sync), grid: &Grid) {
        self.slabs[..grid.slabs].fill(Slab::EMPTY);
        if !in_parallel(refs.len()) {
            return self.add(refs, corners, grid);
        }
        let parts: Vec<Slabs> = refs
            .par_chunks(1 << 13)
            .map(|refs| {
                let mut slabs = Slabs::new();
                slabs.add(refs, corners, grid);
                slabs
            })
            .collected();
        for part in &parts {
            self.slabs.iter_mut().zip(part.slabs.iter()).for_each(|(s, p)| s.add(p));
        }
    }

    /// Adds references, as [`Bins`](super::bins::Bins) does: slabs, and corners where they are needed, are found for some
    /// before the first is added (with sides divided without branches: 4 to 6 % of the build).
    fn add(&mut self, refs: &[Reference], corners: &impl Fn(u32) -> [Vec3; 3], grid: &Grid) {
        let mut ranges = [[[0; 3]; 2]; BATCH];
        let mut corners_of = [[Vec4::ZERO; 3]; BATCH];
        for refs in refs.chunks(BATCH) {
            for (r, range) in refs.iter().zip(&mut ranges) {
                *range = grid.slabs_of(&r.bounds());
            }
            for ((r, [first, last]), corners_of) in refs.iter().zip(&ranges).zip(&mut corners_of) {
                // Only these need the corners, which are far away in memory.
                if first != last {
                    *corners_of = corners(r.id()).map(|c| c.extend(0.0));
                }
            }
            for ((r, [first, last]), corners) in refs.iter().zip(&ranges).zip(&corners_of) {
                for axis in 0..3 {
                    self.slabs[first[axis] as usize].first[axis] += 1;
                    self.slabs[last[axis] as usize].last[axis] += 1;
                    if first[axis] == last[axis] {
                        let b = &mut self.slabs[first[axis] as usize].boxes[axis];
                        *b = b.join(r.bounds());
                    }
                }
                if first != last {
                    self.add_parts::<0>(r, corners, [first[0], last[0]], grid);
                    self.add_parts::<1>(r, corners, [first[1], last[1]], grid);
                    self.add_parts::<2>(r, corners, [first[2], last[2]], grid);
                }
            }
        }
    }

    /// Adds the parts of a reference that lies in several slabs of an axis.
    #[inline(always)]
    fn add_parts<const AXIS: usize>(&mut self, r: &Reference, corners: &[Vec4; 3], range: [u32; 2], grid: &Grid) {
        if range[0] == range[1] {
            return;
        }
        chop::<AXIS>(corners, range, grid, |slab, part| {
            let part = part.meet(r.bounds());
            if !part.is_empty() {
                let b = &mut self.slabs[slab as usize].boxes[AXIS];
                *b = b.join(part);
            }
        });
    }

    /// The best plane that adds at most `extra` references.
    pub(super) fn best_plane(&mut self, grid: &Grid, scale: f32, n: usize, extra: usize) -> Option<Plane> {
        let cost = |s: &Slab, counts: &[i32; 4]| {
            let areas = half_areas([s.boxes[0], s.boxes[1], s.boxes[2], Box4::EMPTY].map(|b| b.extent() * scale));
            areas
                * Vec4::from_array(counts.map(|count| if n <= 4 { leaf_weight(count as usize) } else { count as f32 }))
        };
        let mut sum = Slab::EMPTY;
        for i in (1..grid.slabs).rev() {
            sum.add(&self.slabs[i]);
            self.right[i] = sum;
        }
        let mut left = Slab::EMPTY;
        let mut best: Option<Plane> = None;
        for i in 1..grid.slabs {
            left.add(&self.slabs[i - 1]);
            let right = &self.right[i];
            let costs = cost(&left, &left.first) + cost(right, &right.last);
            for axis in 0..3 {
                let counts = [left.first[axis], right.last[axis]];
                let allowed = counts[0] > 0 && counts[1] > 0 && (counts[0] + counts[1]) as usize <= n + extra;
                if allowed && grid.scale[axis] > 0.0 && costs[axis] < best.as_ref().map_or(f32::INFINITY, |b| b.cost) {
                    let boxes = [left.boxes[axis], right.boxes[axis]];
                    best = Some(Plane { cost: costs[axis], axis, position: grid.plane(axis, i), boxes, counts });
                }
            }
        }
        best
    }
}

/// Number of slabs. The first cuts, between parts of a building, must lie well; those among few triangles need not. (Up
/// to all of them everywhere: 6 to 8 % longer; rays visit as many nodes within 0.5 %.)
fn slab_count(n: usize) -> usize {
    if n > PARALLEL_SUBTREE { SLABS } else { (n / 16 + 4).min(16) }
}
