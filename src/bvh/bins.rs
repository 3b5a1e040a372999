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

/// Number of references whose bins are found before they are added. (8: slower, 16 and 64: the same.)
const BATCH: usize = 32;

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

/// The bins of a node, and scratch space for the costs of the parts to the left and to the right of splits.
///
/// All are on the heap from the start: builds recurse, and a frame that holds them even for a moment holds
/// them on every level.
pub(super) struct Bins {
    bins: Box<[Bin; MAX_BINS]>,
    left: Box<[Vec4; MAX_BINS]>,
    right: Box<[Vec4; MAX_BINS]>,
    /// Affects only how minima and maxima are computed, which have the same bits either way.
    #[cfg(target_arch = "x86_64")]
    has_avx2: bool,
}

impl Bins {
    pub(super) fn new() -> Bins {
        Bins {
            bins: on_heap(Bin::EMPTY),
            left: on_heap(Vec4::ZERO),
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

    /// Adds references with boxes in one register each, and bins as offsets in bytes, which are found for some references
    /// before the first of these is added: 4 to 5 instead of 6 to 9 ns per reference of nodes of 32 and more (Zen 4). Found
    /// just before they are needed, addresses were not known in time to tell whether loads had to wait for stores to the
    /// same bin. (Even and odd references into two sets of bins: no faster.)
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn add_avx2(&mut self, refs: &[Reference], map: &BinMap) {
        use std::arch::x86_64::*;
        const SHIFT: i32 = size_of::<Bin>().trailing_zeros() as i32;
        const { assert!(size_of::<Bin>() == 1 << SHIFT) };
        let [origin, scale, last] = [map.origin, map.scale, map.last].map(__m128::from);
        // SAFETY: a box is eight floats, aligned for this.
        let load = |r: &Reference| unsafe { _mm256_load_ps((&raw const r.0).cast()) };
        let bins = self.bins.as_mut_ptr();
        let mut offsets = [[0u32; 4]; BATCH];
        for refs in refs.chunks(BATCH) {
            for (r, offsets) in refs.iter().zip(&mut offsets) {
                let new = load(r);
                let centre = _mm_sub_ps(_mm256_extractf128_ps::<1>(new), _mm256_castps256_ps128(new));
                let b = _mm_mul_ps(_mm_sub_ps(centre, origin), scale);
                let b = _mm_min_ps(_mm_max_ps(b, _mm_setzero_ps()), last);
                let b = _mm_slli_epi32::<SHIFT>(_mm_cvttps_epi32(b));
                // SAFETY: four integers.
                unsafe { _mm_storeu_si128(offsets.as_mut_ptr().cast(), b) };
            }
            for (r, offsets) in refs.iter().zip(&offsets) {
                let new = load(r);
                for axis in 0..3 {
                    // SAFETY: 0 ≤ bin ≤ `last`, whatever the reference; a map has at most as many bins as there are here.
                    // Boxes are aligned as above.
                    unsafe {
                        let bin = bins.byte_add(offsets[axis] as usize);
                        let p = (&raw mut (*bin).boxes[axis]).cast();
                        _mm256_store_ps(p, _mm256_max_ps(_mm256_load_ps(p), new));
                        (*bin).counts[axis] += 1;
                    }
                }
            }
        }
    }

    /// The best split with triangles on both sides. `scale` keeps f32 areas from over- and
    /// underflow.
    pub(super) fn best_split(&mut self, map: &BinMap, scale: f32) -> Option<Split> {
        self.find_costs(map, scale);
        let (mut best, mut best_bin) = (Vec4::INFINITY, Vec4::ZERO);
        for i in 1..map.bins {
            let cost = self.left[i] + self.right[i];
            let better = cost.cmplt(best);
            best = Vec4::select(better, cost, best);
            best_bin = Vec4::select(better, Vec4::splat(i as f32), best_bin);
        }
        let axis = if best.x <= best.y && best.x <= best.z { 0 } else { 1 + usize::from(best.z < best.y) };
        (best[axis] < f32::INFINITY).then(|| Split { cost: best[axis], axis, bin: best_bin[axis] as usize })
    }

    /// Finds the costs of both sides of the splits before each bin but the first.
    fn find_costs(&mut self, map: &BinMap, scale: f32) {
        #[cfg(target_arch = "x86_64")]
        if self.has_avx2 {
            // SAFETY: the CPU has AVX2.
            return unsafe { self.find_costs_avx2(map, scale) };
        }
        let (n, scale) = (map.bins, Vec4::splat(scale));
        let (mut low, mut high) = (Bin::EMPTY, Bin::EMPTY);
        for i in 1..n {
            low.add(&self.bins[i - 1]);
            self.left[i] = low.cost(scale);
            high.add(&self.bins[n - i]);
            self.right[n - i] = high.cost(scale);
        }
    }

    /// The same, with bit for bit the same costs, and the areas of both sides in the halves of registers: with the loop above
    /// compiled for AVX2, finding splits took 1.4 to 1.7 times as long.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn find_costs_avx2(&mut self, map: &BinMap, scale: f32) {
        use std::arch::x86_64::*;
        let load = |bin: &Bin, axis: usize| {
            // SAFETY: a box is eight floats, aligned for this.
            unsafe { _mm256_load_ps((&raw const bin.boxes[axis]).cast()) }
        };
        // SAFETY: four integers.
        let counts = |bin: &Bin| unsafe { _mm_loadu_si128(bin.counts.as_ptr().cast()) };
        let (scale, zero, infinite) = (_mm256_set1_ps(scale), _mm256_setzero_ps(), _mm256_set1_ps(f32::INFINITY));
        let [mut low, mut high] = [[_mm256_set1_ps(f32::NEG_INFINITY); 3]; 2];
        let [mut low_counts, mut high_counts] = [_mm_setzero_si128(); 2];
        let n = map.bins;
        let (bins, left, right) = (&self.bins[..n], &mut self.left[..n], &mut self.right[..n]);
        for i in 1..n {
            let (low_bin, high_bin) = (&bins[i - 1], &bins[n - i]);
            low_counts = _mm_add_epi32(low_counts, counts(low_bin));
            high_counts = _mm_add_epi32(high_counts, counts(high_bin));
            let mut extents = [zero; 3];
            for axis in 0..3 {
                low[axis] = _mm256_max_ps(low[axis], load(low_bin, axis));
                high[axis] = _mm256_max_ps(high[axis], load(high_bin, axis));
                let neg_lower = _mm256_permute2f128_ps::<0x20>(low[axis], high[axis]);
                let upper = _mm256_permute2f128_ps::<0x31>(low[axis], high[axis]);
                extents[axis] = _mm256_mul_ps(_mm256_max_ps(_mm256_add_ps(upper, neg_lower), zero), scale);
            }
            // The x, y and z of the extents of the three axes.
            let [a, b, c] = extents;
            let (ab, ab_z) = (_mm256_unpacklo_ps(a, b), _mm256_unpackhi_ps(a, b));
            let x = _mm256_shuffle_ps::<0b00_00_01_00>(ab, c);
            let y = _mm256_shuffle_ps::<0b01_01_11_10>(ab, c);
            let z = _mm256_shuffle_ps::<0b10_10_01_00>(ab_z, c);
            let area = _mm256_add_ps(_mm256_add_ps(_mm256_mul_ps(x, y), _mm256_mul_ps(y, z)), _mm256_mul_ps(z, x));
            let count = _mm256_cvtepi32_ps(_mm256_set_m128i(high_counts, low_counts));
            let is_empty = _mm256_cmp_ps::<_CMP_EQ_OQ>(count, zero);
            let cost = _mm256_blendv_ps(_mm256_mul_ps(area, count), infinite, is_empty);
            left[i] = _mm256_castps256_ps128(cost).into();
            right[n - i] = _mm256_extractf128_ps::<1>(cost).into();
        }
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

#[cfg(test)]
mod tests {
    use super::super::references::Extent;
    use super::*;
    use crate::base::sampling::uniform;
    use glam::Vec3;

    #[test]
    fn splits_have_the_same_bits_with_and_without_avx2() {
        for n in [2u32, 5, 31, 32, 33, 1000] {
            for (bins, flat) in [(2, 1.0), (7, 0.0), (64, 1.0), (256, 0.0)] {
                let at =
                    |i: u32, k: u32| Vec3::new(uniform(i, k, n), uniform(i, k + 1, n), flat * uniform(i, k + 2, n));
                let refs: Vec<Reference> =
                    (0..n).map(|i| Reference::new(i, [0, 3, 6].map(|k| at(i / 2, 0) + 0.1 * at(i, k)))).collect();
                let extent = Extent::of(&refs);
                let map = BinMap::new(&extent.centres, bins);
                let found = [false, true].map(|_has_avx2| {
                    let mut work = Bins::new();
                    #[cfg(target_arch = "x86_64")]
                    {
                        work.has_avx2 &= _has_avx2;
                    }
                    work.fill(&refs, &map);
                    let split = work.best_split(&map, 1.0).expect("centres differ");
                    let costs: Vec<_> =
                        (1..bins).map(|i| [work.left[i], work.right[i]].map(|c| c.to_array())).collect();
                    let (left, boxes) = work.sides(&map, &split);
                    let corners = boxes.map(|b| b.corners());
                    (split.cost.to_bits(), split.axis, split.bin, format!("{costs:?}"), left, corners)
                });
                assert_eq!(found[0], found[1]);
                assert!(found[0].4 > 0 && found[0].4 < n as usize);
            }
        }
    }
}
