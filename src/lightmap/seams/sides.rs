//! The edges that two triangles share, found by the positions of their ends.
//!
//! Sides of triangles are put into the cells of a grid by the middles of their edges, counted first, and cells that
//! follow one another along a space-filling curve (Morton 1966) are sorted together: in linear time, in parallel, in 4
//! bytes per side, and with neighbours in memory close together.
//!
//! Instances that are unwrapped alike have the same edges inside, which are found once. Only the sides that one triangle of
//! an instance has alone are compared with those of other objects.

use crate::base::error::Result;
use crate::base::memory::{try_collect, try_par_collect, try_par_gather, try_push};
use crate::base::parallel::ParallelLoop;
use crate::base::progress::Stage;
use crate::base::sort::sort;
use crate::lightmap::atlas::pieces::float_key;
use crate::scene::Scene;
use glam::Vec3;
use rayon::prelude::*;
use std::sync::atomic::AtomicU32;
use std::sync::atomic::Ordering::Relaxed;

/// An edge of a triangle in one of its placements: three times the triangle's global number, plus the number of the
/// corner that the edge starts at, plus [`SECOND`] in the placement of a back.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Side(u64);

const SECOND: u64 = 1 << 63;

impl Side {
    fn new(triangle: u32, corner: u32) -> Side {
        Side(3 * u64::from(triangle) + u64::from(corner))
    }

    /// Returns the same side of the triangle whose number is greater by `shift` (modulo 2^32).
    pub(super) fn shifted(self, shift: u32) -> Side {
        Side::new(self.triangle().wrapping_add(shift), self.corner() as u32)
    }

    /// Returns the same side in the placement of the back.
    pub(super) fn second(self) -> Side {
        Side(self.0 | SECOND)
    }

    pub(super) fn triangle(self) -> u32 {
        ((self.0 & !SECOND) / 3) as u32
    }

    /// Returns the number of the triangle's corner that the edge starts at.
    pub(super) fn corner(self) -> usize {
        ((self.0 & !SECOND) % 3) as usize
    }

    pub(super) fn is_second(self) -> bool {
        self.0 & SECOND != 0
    }

    /// Returns the edge's start and end among values of the triangle's corners.
    pub(super) fn ends<T: Copy>(self, corners: [T; 3]) -> [T; 2] {
        let k = self.corner();
        [corners[k], corners[(k + 1) % 3]]
    }
}

/// Number of sides that are sorted together, if no cell has more: as many as are sorted without a look for a cancel.
const BUCKET: usize = 1 << 16;

/// Number of triangles that a thread puts into cells at a time.
const PART: usize = 1 << 14;

/// Maximum number of times that the grid is halved along each axis: 16 million cells.
const MAX_LEVEL: u32 = 8;

/// Name of the buffers in error messages.
const EDGES: &str = "the edges of the charts";

/// Estimates the bytes that [`for_each_edge`] takes for a number of sides, without what it returns.
pub(super) fn bytes(sides: usize, threads: usize) -> usize {
    let cells = size_of::<u32>() << (3 * Cells::level(sides));
    sides * size_of::<u32>() + cells + threads * 2 * BUCKET * size_of::<(u64, Side)>()
}

/// The cells of a cubic grid, numbered along a space-filling curve.
struct Cells {
    lower: Vec3,
    /// Cells per unit of length.
    scale: f32,
    level: u32,
}

impl Cells {
    /// Returns how often the grid is halved along each axis. A surface meets some 4^level of the 8^level cells: about
    /// four for each bucket.
    fn level(sides: usize) -> u32 {
        let buckets = sides.div_ceil(BUCKET).max(1);
        (1 + buckets.ilog2().div_ceil(2)).min(MAX_LEVEL)
    }

    fn new(scene: &Scene, sides: usize) -> Cells {
        let ((lower, upper), level) = (scene.bounds(), Self::level(sides));
        Cells { lower, scale: (1 << level) as f32 / (upper - lower).max_element(), level }
    }

    fn count(&self) -> usize {
        1 << (3 * self.level)
    }

    /// Returns the cell of an edge, the same for both directions.
    fn of(&self, [a, b]: [Vec3; 2]) -> usize {
        // The result is in range even if rounding, or an overflow of a huge scene, brings the middle out of it.
        let cell = ((0.5 * a + 0.5 * b) - self.lower) * self.scale;
        let [x, y, z] = cell.to_array().map(|c| (c.max(0.0) as u32).min((1 << self.level) - 1));
        let bits = (0..self.level).map(|i| ((x >> i & 1) | (y >> i & 1) << 1 | (z >> i & 1) << 2) << (3 * i));
        bits.fold(0, |cell, bit| cell | bit as usize)
    }
}

/// Sides that are compared.
pub(super) struct Sides<'a> {
    /// Triangles, by their numbers less the first one's, of which all three sides are.
    pub triangles: &'a [u32],
    pub first_triangle: u32,
    pub others: &'a [Side],
}

impl Sides<'_> {
    pub(super) fn len(&self) -> usize {
        3 * self.triangles.len() + self.others.len()
    }

    fn get(&self, index: usize) -> Side {
        match self.triangles.get(index / 3) {
            Some(&t) => Side::new(self.first_triangle + t, index as u32 % 3),
            None => self.others[index - 3 * self.triangles.len()],
        }
    }
}

/// What is done with the sides of an edge: may add to a list.
pub(super) type Visit<'a, T> = dyn Fn(&[(u64, Side)], &mut Vec<T>) -> Result<()> + Sync + 'a;

/// Calls `visit` with the sides of each edge, of which only the ends count, and collects what it adds. (The rare edges
/// that share a hash are taken for one.)
pub(super) fn for_each_edge<T: Send>(
    scene: &Scene,
    sides: &Sides,
    stage: &Stage,
    visit: &Visit<'_, T>,
) -> Result<Vec<T>> {
    let cells = Cells::new(scene, sides.len());
    let each = |visit: &(dyn Fn(usize, usize) + Sync)| {
        (0..sides.len().div_ceil(PART)).into_par_iter().try_each(|part| {
            for index in part * PART..sides.len().min((part + 1) * PART) {
                let side = sides.get(index);
                visit(index, cells.of(side.ends(scene.corners(side.triangle()))));
            }
            stage.check()
        })
    };
    let zeros = |len: usize| try_par_collect((0..len).into_par_iter().map(|_| AtomicU32::new(0)), EDGES);
    let mut starts = zeros(cells.count())?;
    each(&|_, cell| _ = starts[cell].fetch_add(1, Relaxed))?;
    let mut sum = 0;
    for start in &mut starts {
        sum += *start.get_mut();
        *start.get_mut() = sum;
    }
    // Cells are filled from behind. The order in a cell depends on the threads, but not when it is sorted.
    let indices = zeros(sides.len())?;
    each(&|index, cell| indices[starts[cell].fetch_sub(1, Relaxed) as usize - 1].store(index as u32, Relaxed))?;
    stage.check()?;

    let mut buckets: Vec<usize> = Vec::new();
    for start in starts.iter().map(|start| start.load(Relaxed) as usize) {
        if buckets.last().is_none_or(|&last| start >= last + BUCKET) {
            try_push(&mut buckets, start, EDGES)?;
        }
    }
    drop(starts);
    try_par_gather(buckets.len(), EDGES, |bucket, out| {
        stage.check()?;
        let range = buckets[bucket]..buckets.get(bucket + 1).copied().unwrap_or(indices.len());
        let hashed = indices[range].iter().map(|index| {
            let side = sides.get(index.load(Relaxed) as usize);
            (hash(side.ends(scene.corners(side.triangle()))), side)
        });
        let mut hashed = try_collect(hashed, EDGES)?;
        sort(&mut hashed, &|| stage.check())?;
        for same in hashed.chunk_by(|a, b| a.0 == b.0) {
            visit(same, out)?;
        }
        Ok(())
    })
}

/// Hashes an edge, with the same result for both directions.
fn hash(ends: [Vec3; 2]) -> u64 {
    let [a, b] = ends.map(|p| p.to_array().map(float_key));
    let (low, high) = if a < b { (a, b) } else { (b, a) };
    low.into_iter().chain(high).fold(0, |h: u64, x| {
        let h = (h ^ x as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        h ^ h >> 29
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::progress::Progress;
    use crate::scene::builtin;
    use std::collections::BTreeMap;

    #[test]
    fn the_edges_that_two_triangles_share_are_found_in_any_number_of_cells() {
        for name in ["cornell", "atrium", "hall:60000"] {
            let scene = builtin(name).unwrap().committed();
            let triangles: Vec<u32> = (0..scene.triangle_count()).filter(|&t| scene.is_valid(t)).collect();
            let mut sides = BTreeMap::<_, Vec<Side>>::new();
            for side in triangles.iter().flat_map(|&t| [0, 1, 2].map(|k| Side::new(t, k))) {
                let mut ends = side.ends(scene.corners(side.triangle())).map(|p| p.to_array().map(float_key));
                ends.sort_unstable();
                sides.entry(ends).or_default().push(side);
            }
            let mut expected: Vec<[Side; 2]> = sides.into_values().filter_map(|s| s.try_into().ok()).collect();
            let progress = Progress::none();
            let stage = progress.stage("seams", 0.0, 1.0, 1);
            // Half as triangles, half as sides.
            let (some, rest) = triangles.split_at(triangles.len() / 2);
            let others: Vec<Side> = rest.iter().flat_map(|&t| [0, 1, 2].map(|k| Side::new(t, k))).collect();
            let sides = Sides { triangles: some, first_triangle: 0, others: &others };
            let mut found = for_each_edge(&scene, &sides, &stage, &|same, out| match *same {
                [(_, a), (_, b)] => try_push(out, [a, b], "edges"),
                _ => Ok(()),
            })
            .unwrap();
            expected.sort_unstable();
            found.sort_unstable();
            assert_eq!(found, expected, "{name}");
            assert!(found.len() > triangles.len());
        }
    }
}
