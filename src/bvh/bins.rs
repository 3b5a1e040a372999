//! Bins of references, and the best split between them by the surface area heuristic.

use super::references::{Box4, Range4, Reference, half_areas};
#[cfg(target_arch = "x86_64")]
use crate::base::parallel::ParallelLoop;
use crate::simd::Isa;
use glam::Vec4;
use rayon::prelude::*;

/// Ranges of more triangles than this are binned and partitioned by several threads.
const PARALLEL_RANGE: usize = 1 << 15;

const MAX_BINS: usize = 256;

/// Whether the work on a range is shared among threads. The results are the same.
pub(super) fn in_parallel(n: usize) -> bool {
    n > PARALLEL_RANGE && rayon::current_num_threads() > 1
}

/// Maps centres to bins on all three axes.
#[derive(Clone, Copy)]
pub(super) struct BinMap {
    pub(super) origin: Vec4,
    pub(super) scale: Vec4,
    pub(super) last: Vec4,
    pub(super) bins: usize,
}

impl BinMap {
    /// `centres` must hold the centres of all references.
    pub(super) fn new(centres: &Range4, bins: usize) -> Self {
        assert!((1..=MAX_BINS).contains(&bins));
        let extent = centres.upper - centres.lower;
        let scale = Vec4::splat(bins as f32) / extent;
        let ok = extent.cmpgt(Vec4::ZERO) & scale.cmplt(Vec4::INFINITY);
        let scale = Vec4::select(ok, scale, Vec4::ZERO);
        BinMap { origin: centres.lower, scale, last: Vec4::splat(bins as f32 - 1.0), bins }
    }

    pub(super) fn side(&self, split: &Split) -> Side {
        let axis = split.axis;
        Side { axis, origin: self.origin[axis], scale: self.scale[axis], first_right: split.bin as f32 }
    }

    /// Bins of a reference. No centre is NaN: valid triangles have finite corners. On an axis on which the centres are
    /// equal, or so close that the quotient would overflow, the scale is 0, and all are in the first bin.
    #[inline(always)]
    pub(super) fn indices(&self, r: &Reference) -> [usize; 3] {
        let b = ((r.centre() - self.origin) * self.scale).min(self.last);
        [b.x, b.y, b.z].map(|b| b as usize)
    }
}

/// Determines the sides of a split by the same arithmetic as [`BinMap::indices`]: what is less than a whole number is
/// so rounded down, too, and the last bin is never on the left.
pub(super) struct Side {
    pub(super) axis: usize,
    pub(super) origin: f32,
    pub(super) scale: f32,
    pub(super) first_right: f32,
}

impl Side {
    #[inline(always)]
    pub(super) fn is_left(&self, r: &Reference) -> bool {
        let c = r.0.upper[self.axis] - r.0.neg_lower[self.axis];
        (c - self.origin) * self.scale < self.first_right
    }
}

/// One bin on each axis.
#[derive(Clone, Copy)]
struct Bin {
    boxes: [Box4; 3],
    /// Signed, because these convert to floats in one instruction; the last is unused.
    counts: [i32; 4],
}

impl Bin {
    const EMPTY: Bin = Bin { boxes: [Box4::EMPTY; 3], counts: [0; 4] };

    #[inline(always)]
    fn add(&mut self, o: &Bin) {
        for axis in 0..3 {
            self.boxes[axis] = self.boxes[axis].join(o.boxes[axis]);
        }
        for axis in 0..4 {
            self.counts[axis] += o.counts[axis];
        }
    }

    /// Areas times counts per axis, with extents scaled; infinite for empty bins. (Counted in fours, as they are
    /// tested, random rays are no faster.)
    #[inline(always)]
    fn cost(&self, scale: Vec4) -> Vec4 {
        let n = Vec4::from_array(self.counts.map(|n| n as f32));
        let cost =
            half_areas([self.boxes[0], self.boxes[1], self.boxes[2], Box4::EMPTY].map(|b| b.extent() * scale)) * n;
        Vec4::select(n.cmpeq(Vec4::ZERO), Vec4::INFINITY, cost)
    }
}

/// A split between two bins.
pub(super) struct Split {
    /// Σ scaled half area · triangles.
    pub(super) cost: f32,
    pub(super) axis: usize,
    /// First bin on the right.
    pub(super) bin: usize,
}

/// Allocates an array of copies of `value` without putting it on the stack.
pub(super) fn on_heap<T: Copy, const N: usize>(value: T) -> Box<[T; N]> {
    vec![value; N].try_into().unwrap_or_else(|_| unreachable!("the vector has N elements"))
}

/// The bins of a node, and scratch space for the costs of the parts to the right of each.
///
/// Both are on the heap from the start: builds recurse, and a frame that holds them even for a moment holds
/// them on every level.
pub(super) struct Bins {
    bins: Box<[Bin; MAX_BINS]>,
    right: Box<[Vec4; MAX_BINS]>,
    /// Affects only how minima and maxima are computed, which have the same bits either way.
    #[cfg(target_arch = "x86_64")]
    has_avx2: bool,
}

impl Bins {
    pub(super) fn new() -> Bins {
        Bins {
            bins: on_heap(Bin::EMPTY),
            right: on_heap(Vec4::ZERO),
            #[cfg(target_arch = "x86_64")]
            has_avx2: Isa::Avx2.is_available(),
        }
    }

    pub(super) fn fill(&mut self, refs: &[Reference], map: &BinMap) {
        self.bins[..map.bins].fill(Bin::EMPTY);
        if !in_parallel(refs.len()) {
            return self.add(refs, map);
        }
        let parts = rayon::current_num_threads() * 2;
        let parts: Vec<Bins> = refs
            .par_chunks(refs.len().div_ceil(parts))
            .map(|refs| {
                let mut bins = Bins::new();
                bins.add(refs, map);
                bins
            })
            .collected();
        for part in &parts {
            for b in 0..map.bins {
                self.bins[b].add(&part.bins[b]);
            }
        }
    }

    fn add(&mut self, refs: &[Reference], map: &BinMap) {
        #[cfg(target_arch = "x86_64")]
        if self.has_avx2 {
            // SAFETY: the CPU has AVX2.
            return unsafe { self.add_avx2(refs, map) };
        }
        for r in refs {
            for (axis, b) in map.indices(r).into_iter().enumerate() {
                let bin = &mut self.bins[b];
                bin.boxes[axis] = bin.boxes[axis].join(r.0);
                bin.counts[axis] += 1;
            }
        }
    }

    /// Adds references with boxes in one register each, and bins as offsets in bytes. (Even and odd references into two
    /// sets of bins, so that they do not wait for each other's stores: 0 to 3 %, not kept.)
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn add_avx2(&mut self, refs: &[Reference], map: &BinMap) {
        use std::arch::x86_64::*;
        const SHIFT: i32 = size_of::<Bin>().trailing_zeros() as i32;
        const { assert!(size_of::<Bin>() == 1 << SHIFT) };
        let [origin, scale, last] = [map.origin, map.scale, map.last].map(__m128::from);
        let bins = self.bins.as_mut_ptr();
        for r in refs {
            // SAFETY: a box is eight floats, aligned for this.
            let new = unsafe { _mm256_load_ps((&raw const r.0).cast()) };
            let centre = _mm_sub_ps(_mm256_extractf128_ps::<1>(new), _mm256_castps256_ps128(new));
            let b = _mm_mul_ps(_mm_sub_ps(centre, origin), scale);
            let b = _mm_min_ps(_mm_max_ps(b, _mm_setzero_ps()), last);
            let b = _mm_slli_epi32::<SHIFT>(_mm_cvttps_epi32(b));
            let offsets = [_mm_extract_epi32::<0>(b), _mm_extract_epi32::<1>(b), _mm_extract_epi32::<2>(b)];
            for (axis, offset) in offsets.into_iter().enumerate() {
                // SAFETY: 0 ≤ bin ≤ `last`, whatever the reference; a map has at most as many bins as there are here.
                // Boxes are aligned as above.
                unsafe {
                    let bin = bins.byte_add(offset as u32 as usize);
                    let p = (&raw mut (*bin).boxes[axis]).cast();
                    _mm256_store_ps(p, _mm256_max_ps(_mm256_load_ps(p), new));
                    (*bin).counts[axis] += 1;
                }
            }
        }
    }

    /// The best split with triangles on both sides. `scale` keeps f32 areas from over- and
    /// underflow.
    pub(super) fn best_split(&mut self, map: &BinMap, scale: f32) -> Option<Split> {
        #[cfg(target_arch = "x86_64")]
        if self.has_avx2 {
            // SAFETY: the CPU has AVX2.
            return unsafe { self.best_split_avx2(map, scale) };
        }
        self.sweep(map, scale, Bin::add)
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn best_split_avx2(&mut self, map: &BinMap, scale: f32) -> Option<Split> {
        use std::arch::x86_64::{_mm256_load_ps, _mm256_max_ps, _mm256_store_ps};
        self.sweep(map, scale, |sum, bin| {
            for axis in 0..3 {
                let (p, q) = ((&raw mut sum.boxes[axis]).cast(), (&raw const bin.boxes[axis]).cast());
                // SAFETY: a box is eight floats, aligned for this.
                unsafe { _mm256_store_ps(p, _mm256_max_ps(_mm256_load_ps(p), _mm256_load_ps(q))) };
            }
            for axis in 0..4 {
                sum.counts[axis] += bin.counts[axis];
            }
        })
    }

    /// The best split, given how a bin is added to a sum.
    #[inline(always)]
    fn sweep(&mut self, map: &BinMap, scale: f32, add: impl Fn(&mut Bin, &Bin)) -> Option<Split> {
        let scale = Vec4::splat(scale);
        let mut sum = Bin::EMPTY;
        for i in (1..map.bins).rev() {
            add(&mut sum, &self.bins[i]);
            self.right[i] = sum.cost(scale);
        }
        let mut sum = Bin::EMPTY;
        let (mut best, mut best_bin) = (Vec4::INFINITY, Vec4::ZERO);
        for i in 1..map.bins {
            add(&mut sum, &self.bins[i - 1]);
            let cost = sum.cost(scale) + self.right[i];
            let better = cost.cmplt(best);
            best = Vec4::select(better, cost, best);
            best_bin = Vec4::select(better, Vec4::splat(i as f32), best_bin);
        }
        let axis = if best.x <= best.y && best.x <= best.z { 0 } else { 1 + usize::from(best.z < best.y) };
        (best[axis] < f32::INFINITY).then(|| Split { cost: best[axis], axis, bin: best_bin[axis] as usize })
    }

    /// Number of triangles left of a split, and the boxes of both sides.
    pub(super) fn sides(&self, map: &BinMap, split: &Split) -> (usize, [Box4; 2]) {
        let join = |bins: &[Bin]| bins.iter().fold(Box4::EMPTY, |b, bin| b.join(bin.boxes[split.axis]));
        let (left, right) = self.bins[..map.bins].split_at(split.bin);
        let n: i32 = left.iter().map(|b| b.counts[split.axis]).sum();
        (n as usize, [join(left), join(right)])
    }
}

/// Number of bins for a node of `n` triangles. Few triangles do not fill many bins; fewer bins find the same splits
/// sooner. (2n bins: longer for the same cost; n / 20 + 4: a tenth faster, cost up to 0.6 % higher. How many bins there
/// are at most hardly matters then: 16 to 64 take the same time within 5 %.)
pub(super) fn bin_count(most: usize, n: usize) -> usize {
    most.min(n / 4 + 6)
}
