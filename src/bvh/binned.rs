//! Binary BVH by binned surface area heuristic (thesis 3.1.1; Wald, *On fast Construction of
//! SAH-based Bounding Volume Hierarchies*, 2007), parallel and deterministic.
//!
//! A subtree over n triangles owns a fixed range of 2n − 1 node slots and of n triangle slots, so threads never share
//! any of them; what one thread builds lies at the beginning of its range, so that slots that are not needed take no
//! memory. References move in place, so that scratch files can take the place of memory: ranges of references are read and
//! written from one end to the other, and below some splits a range fits into memory. Their order depends on how ranges are cut into blocks; but bins, boxes and
//! partings are the same in any order, and leaves are sorted, so the tree depends on the triangles alone.

use super::BuildOptions;
use super::binary::{BinaryBvh, BinaryNode};
use super::bins::{BinMap, Bins, Side, Split, bin_count, in_parallel, on_heap};
use super::layout::SAH_DEPTH;
use super::partings::{best_parting, halve, leaf_cost, part_few};
use super::references::{Box4, Extent, Range4, Reference, References, area_scale};
use crate::base::error::Result;
use crate::base::memory::{try_collect, try_filled, try_push, try_zeroed, try_zeroed_as_needed};
use crate::base::parallel::ParallelLoop;
use crate::base::progress::Progress;
use crate::base::scratch_files::Storage;
#[cfg(target_arch = "x86_64")]
use crate::simd::Isa;
use glam::{Vec3, Vec4};
use rayon::prelude::*;

/// Subtrees of more triangles than this are built as separate tasks.
pub(super) const PARALLEL_SUBTREE: usize = 4096;

/// Name of these buffers in error messages.
const TREE: &str = "the binary tree";

/// Number of references that are partitioned at a time, so that those in between stay in the cache.
const BLOCK: usize = 1 << 10;

/// Room for those references of a block that belong to the right.
struct Scratch {
    refs: Box<[Reference; BLOCK]>,
    /// Whether the CPU has AVX2, by which parting has the same result.
    #[cfg(target_arch = "x86_64")]
    has_avx2: bool,
}

impl Scratch {
    fn new() -> Scratch {
        Scratch {
            refs: on_heap(Reference::default()),
            #[cfg(target_arch = "x86_64")]
            has_avx2: Isa::Avx2.is_available(),
        }
    }
}

/// Moves the references left of a split, `middle` in number, before the others. Returns the bounds of the centres of
/// both sides.
fn partition(
    refs: &mut [Reference],
    middle: usize,
    map: &BinMap,
    split: &Split,
    scratch: &mut Scratch,
) -> Result<[Range4; 2]> {
    if refs.len() <= BLOCK {
        return Ok(partition_block(refs, map, split, scratch).1);
    }
    // First within blocks, then between them.
    let parted = if in_parallel(refs.len()) {
        let mut parted = try_filled(refs.len().div_ceil(BLOCK), (0, [Range4::EMPTY; 2]), TREE)?;
        let blocks = refs.par_chunks_mut(BLOCK).zip(&mut parted).with_min_len(BLOCKS_PER_THREAD);
        blocks.try_each_with(Scratch::new, |scratch, (block, of_block)| {
            *of_block = partition_block(block, map, split, scratch);
            Ok(())
        })?;
        parted
    } else {
        try_collect(refs.chunks_mut(BLOCK).map(|block| partition_block(block, map, split, scratch)), TREE)?
    };
    swap_misplaced(refs, middle, &parted)?;
    Ok(parted.iter().fold([Range4::EMPTY; 2], |[a, b], &(_, [c, d])| [a.join(c), b.join(d)]))
}

/// Number of blocks that a thread takes at a time.
const BLOCKS_PER_THREAD: usize = 8;

/// Swaps the right references below `middle` with the left ones above, given what [`partition_block`] returned for each
/// block. There are equally many.
fn swap_misplaced(refs: &mut [Reference], middle: usize, parted: &[(usize, [Range4; 2])]) -> Result<()> {
    let parallel = in_parallel(refs.len());
    let (low, high) = refs.split_at_mut(middle);
    let (mut low, mut high) = (Runs::new(low, 0), Runs::new(high, middle));
    let mut pairs = Vec::new();
    let (mut rights, mut lefts) = (Default::default(), Default::default());
    let mut from_low = parted.iter().enumerate().map(|(i, &(n, _))| i * BLOCK + n..(i + 1) * BLOCK);
    let mut from_high = parted.iter().enumerate().map(|(i, &(n, _))| i * BLOCK..i * BLOCK + n);
    while let (Some(a), Some(b)) = (low.next(&mut rights, &mut from_low), high.next(&mut lefts, &mut from_high)) {
        let n = a.len().min(b.len());
        let ((a, rest_a), (b, rest_b)) = (a.split_at_mut(n), b.split_at_mut(n));
        (rights, lefts) = (rest_a, rest_b);
        if parallel {
            try_push(&mut pairs, (a, b), TREE)?;
        } else {
            a.swap_with_slice(b);
        }
    }
    pairs.into_par_iter().with_min_len(BLOCKS_PER_THREAD).each(|(a, b)| a.swap_with_slice(b));
    Ok(())
}

/// What is left of one side of a range, whose misplaced runs are taken off in order.
struct Runs<'a> {
    rest: &'a mut [Reference],
    /// Place of the first of `rest` in the range.
    start: usize,
}

impl<'a> Runs<'a> {
    fn new(rest: &'a mut [Reference], start: usize) -> Self {
        Runs { rest, start }
    }

    /// Returns `current`, or the next run of `places` that lies on this side if there is nothing left of it.
    fn next(
        &mut self,
        current: &mut &'a mut [Reference],
        places: &mut impl Iterator<Item = std::ops::Range<usize>>,
    ) -> Option<&'a mut [Reference]> {
        while current.is_empty() {
            let end = self.start + self.rest.len();
            let place = places.next()?;
            let place = place.start.clamp(self.start, end)..place.end.clamp(self.start, end);
            let (run, rest) = std::mem::take(&mut self.rest)[place.start - self.start..].split_at_mut(place.len());
            (*current, self.rest, self.start) = (run, rest, place.end);
        }
        Some(std::mem::take(current))
    }
}

/// Moves the left references of a block before the others, both in their old order. Returns their number, and the
/// bounds of the centres of both sides.
fn partition_block(refs: &mut [Reference], map: &BinMap, split: &Split, scratch: &mut Scratch) -> (usize, [Range4; 2]) {
    let side = map.side(split);
    #[cfg(target_arch = "x86_64")]
    if scratch.has_avx2 {
        // SAFETY: the CPU has AVX2.
        return unsafe { partition_block_avx2(refs, &side, &mut scratch.refs) };
    }
    let [mut low, mut high] = [Range4::EMPTY; 2];
    let (mut l, mut r) = (0, 0);
    // Without branches on the side: every reference is written to both sides, and the wrong copy is overwritten by the
    // next.
    for i in 0..refs.len().min(BLOCK) {
        let reference = refs[i];
        let is_left = side.is_left(&reference);
        refs[l] = reference;
        scratch.refs[r] = reference;
        l += usize::from(is_left);
        r += usize::from(!is_left);
        if is_left { low.grow(reference.centre()) } else { high.grow(reference.centre()) }
    }
    refs[l..].copy_from_slice(&scratch.refs[..r]);
    (l, [low, high])
}

/// The same with each reference in one register.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn partition_block_avx2(refs: &mut [Reference], side: &Side, scratch: &mut [Reference; BLOCK]) -> (usize, [Range4; 2]) {
    use std::arch::x86_64::*;
    let n = refs.len().min(BLOCK);
    let (from, to) = (refs.as_mut_ptr().cast::<f32>(), scratch.as_mut_ptr().cast::<f32>());
    let axis = _mm256_set1_epi32(side.axis as i32);
    let [origin, scale, first_right] = [side.origin, side.scale, side.first_right].map(|x| _mm256_set1_ps(x));
    let nothing = _mm256_set1_ps(f32::NEG_INFINITY);
    // Greatest centre and greatest negated centre of either side.
    let [mut low, mut high] = [nothing; 2];
    let mut l = 0;
    for i in 0..n {
        // SAFETY: i < n. References are eight floats, aligned for this.
        let r = unsafe { _mm256_load_ps(from.add(8 * i)) };
        // The centre, then the same negated.
        let c = _mm256_sub_ps(_mm256_permute2f128_ps::<1>(r, r), r);
        let on_axis = _mm256_permutevar8x32_ps(c, axis);
        let bin = _mm256_mul_ps(_mm256_sub_ps(on_axis, origin), scale);
        let left = _mm256_cmp_ps::<_CMP_LT_OQ>(bin, first_right);
        // SAFETY: l ≤ i and i − l ≤ i. Nothing is overwritten before it is read.
        unsafe {
            _mm256_store_ps(from.add(8 * l), r);
            _mm256_store_ps(to.add(8 * (i - l)), r);
        }
        l += (_mm256_movemask_ps(left) & 1) as usize;
        low = _mm256_max_ps(low, _mm256_blendv_ps(nothing, c, left));
        high = _mm256_max_ps(high, _mm256_blendv_ps(c, nothing, left));
    }
    refs[l..n].copy_from_slice(&scratch[..n - l]);
    let range = |m: __m256| {
        let [upper, neg_lower] = [_mm256_castps256_ps128(m), _mm256_extractf128_ps::<1>(m)].map(Vec4::from);
        Range4 { lower: -neg_lower, upper }
    };
    (l, [range(low), range(high)])
}

/// The slots of a subtree over n triangles, or of some that one thread builds one after the other.
struct Slots<'a> {
    /// 2n − 1 nodes, the first of which has index `base`, and the number of those in use.
    nodes: &'a mut [BinaryNode],
    base: u32,
    used: usize,
    /// n triangles, the first of which has index `first`, and the number of those in leaves.
    triangles: &'a mut [u32],
    first: u32,
    filled: usize,
}

impl<'a> Slots<'a> {
    /// Divides slots of which only the first node is in use among its children, the left one over `n` triangles.
    fn split(&mut self, n: usize) -> [Slots<'_>; 2] {
        let (left, right) = self.nodes[1..].split_at_mut(2 * n - 1);
        let (left_triangles, right_triangles) = self.triangles.split_at_mut(n);
        let slots = |nodes, base, triangles, first| Slots { nodes, base, used: 0, triangles, first, filled: 0 };
        [
            slots(left, self.base + 1, left_triangles, self.first),
            slots(right, self.base + 2 * n as u32, right_triangles, self.first + n as u32),
        ]
    }

    /// Adds a node and returns its place.
    fn node(&mut self, bounds: &Box4, index: u32, count: u32) -> usize {
        let (lower, upper) = bounds.corners();
        self.nodes[self.used] = BinaryNode { lower, upper, index, count };
        self.used += 1;
        self.used - 1
    }

    fn leaf(&mut self, refs: &mut [Reference], bounds: &Box4) {
        sort_few(refs);
        self.node(bounds, self.first + self.filled as u32, refs.len() as u32);
        for (t, r) in self.triangles[self.filled..].iter_mut().zip(refs.iter()) {
            *t = r.id();
        }
        self.filled += refs.len();
    }
}

/// Buffers of a task.
struct Work {
    bins: Bins,
    scratch: Scratch,
}

impl Work {
    fn new() -> Work {
        Work { bins: Bins::new(), scratch: Scratch::new() }
    }
}

struct Builder<'a, 'p> {
    options: &'a BuildOptions,
    progress: &'a Progress<'p>,
}

impl Builder<'_, '_> {
    /// Builds the subtree over `refs`.
    fn build(
        &self,
        refs: &mut [Reference],
        slots: &mut Slots,
        extent: Extent,
        depth: usize,
        work: &mut Work,
    ) -> Result<()> {
        let n = refs.len();
        if n == 1 {
            slots.leaf(refs, &extent.boxes);
            return Ok(());
        }
        let may_be_leaf = n <= self.options.max_leaf as usize;
        if n <= 4 && depth < SAH_DEPTH {
            return self.few(refs, slots, extent, depth, work);
        }
        if depth < SAH_DEPTH {
            let scale = area_scale(&extent.boxes);
            let map = BinMap::new(&extent.centres, bin_count(self.options.bins as usize, n));
            work.bins.fill(refs, &map);
            if let Some(split) = work.bins.best_split(&map, scale) {
                if may_be_leaf && leaf_cost(&extent.boxes, scale, n) <= split.cost {
                    slots.leaf(refs, &extent.boxes);
                    return Ok(());
                }
                let (middle, boxes) = work.bins.sides(&map, &split);
                let centres = partition(refs, middle, &map, &split, &mut work.scratch)?;
                let extents = [0, 1].map(|i| Extent { boxes: boxes[i], centres: centres[i] });
                return self.children(refs, slots, extent, extents, middle, depth, work);
            }
        }
        if may_be_leaf {
            slots.leaf(refs, &extent.boxes);
            return Ok(());
        }
        // All centres are equal, or the node is too deep.
        let middle = halve(refs, &extent);
        let extents = [Extent::of(&refs[..middle]), Extent::of(&refs[middle..])];
        self.children(refs, slots, extent, extents, middle, depth, work)
    }

    /// Builds the subtree over two to four triangles by trying every partition.
    fn few(
        &self,
        refs: &mut [Reference],
        slots: &mut Slots,
        extent: Extent,
        depth: usize,
        work: &mut Work,
    ) -> Result<()> {
        sort_few(refs);
        let scale = area_scale(&extent.boxes);
        let (cost, parting) = best_parting(refs, scale);
        if refs.len() <= self.options.max_leaf as usize && leaf_cost(&extent.boxes, scale, refs.len()) <= cost {
            slots.leaf(refs, &extent.boxes);
            return Ok(());
        }
        let middle = part_few(refs, parting);
        // The centres of so few are not needed, unless the node is too deep.
        let extents = [&refs[..middle], &refs[middle..]].map(|refs| {
            let boxes = refs.iter().fold(Box4::EMPTY, |b, r| b.join(r.0));
            Extent { boxes, centres: extent.centres }
        });
        self.children(refs, slots, extent, extents, middle, depth, work)
    }

    /// Builds an inner node and its children, over the first `middle` of `refs` and the others.
    fn children(
        &self,
        refs: &mut [Reference],
        slots: &mut Slots,
        extent: Extent,
        [left_extent, right_extent]: [Extent; 2],
        middle: usize,
        depth: usize,
        work: &mut Work,
    ) -> Result<()> {
        let parallel = refs.len() > PARALLEL_SUBTREE;
        let (left_refs, right_refs) = refs.split_at_mut(middle);
        let node = slots.node(&extent.boxes, 0, 0);
        if !parallel {
            self.build(left_refs, slots, left_extent, depth + 1, work)?;
            slots.nodes[node].index = slots.base + slots.used as u32;
            return self.build(right_refs, slots, right_extent, depth + 1, work);
        }
        if !self.progress.is_cancelled() {
            slots.nodes[node].index = slots.base + 2 * middle as u32;
            let [mut left, mut right] = slots.split(middle);
            let (left, right) = rayon::join(
                || self.build(left_refs, &mut left, left_extent, depth + 1, work),
                || self.build(right_refs, &mut right, right_extent, depth + 1, &mut Work::new()),
            );
            left.and(right)?;
        }
        Ok(())
    }
}

/// Sorts the references of a leaf, or so few, by number: no result depends on the order in which they come.
fn sort_few(refs: &mut [Reference]) {
    for end in 1..refs.len() {
        let mut i = end;
        while i > 0 && refs[i - 1].id() > refs[i].id() {
            refs.swap(i - 1, i);
            i -= 1;
        }
    }
}

impl BinaryBvh {
    /// Builds the tree over the triangles `valid` with the `corners`, on the current rayon pool.
    pub fn build(
        corners: &(impl Fn(u32) -> [Vec3; 3] + Sync),
        valid: &[u32],
        options: &BuildOptions,
        progress: &Progress,
    ) -> Result<BinaryBvh> {
        BinaryBvh::of(References::of(valid, corners)?, options, Storage::MEMORY, progress)
    }

    /// Builds the tree over at least one reference. It lies in `storage`.
    pub(super) fn of(
        references: References,
        options: &BuildOptions,
        storage: Storage,
        progress: &Progress,
    ) -> Result<BinaryBvh> {
        let References { mut refs, extent, .. } = references;
        let n = refs.len();
        let mut nodes = storage.zeroed::<BinaryNode>(2 * n - 1, try_zeroed_as_needed, TREE)?;
        let mut triangles = storage.zeroed::<u32>(n, try_zeroed, TREE)?;
        let mut slots = Slots { nodes: &mut nodes, base: 0, used: 0, triangles: &mut triangles, first: 0, filled: 0 };
        Builder { options, progress }.build(&mut refs, &mut slots, extent, 0, &mut Work::new())?;
        progress.check()?;
        Ok(BinaryBvh { nodes, triangles })
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::base::sampling::uniform;

    fn soup(n: usize, seed: u32, size: f32) -> Vec<[Vec3; 3]> {
        let p = |i: usize, k: u32| {
            Vec3::new(uniform(i as u32, k, seed), uniform(i as u32, k + 1, seed), uniform(i as u32, k + 2, seed))
        };
        (0..n).map(|i| [p(i, 0), p(i, 0) + size * p(i, 3), p(i, 0) + size * p(i, 6)]).collect()
    }

    fn build(corners: &[[Vec3; 3]], options: BuildOptions) -> BinaryBvh {
        let ids: Vec<u32> = (0..corners.len() as u32).collect();
        BinaryBvh::build(&|t| corners[t as usize], &ids, &options, &Progress::none()).unwrap()
    }

    /// Every triangle once, in a leaf of allowed size, inside all boxes above it; returns the depth.
    fn check(bvh: &BinaryBvh, corners: &[[Vec3; 3]], max_leaf: u32) -> usize {
        let mut seen = vec![false; corners.len()];
        let mut deepest = 0;
        let mut stack = vec![(0u32, 0usize, Vec3::NEG_INFINITY, Vec3::INFINITY)];
        while let Some((i, depth, lo, hi)) = stack.pop() {
            let node = bvh.nodes[i as usize];
            deepest = deepest.max(depth);
            assert!(node.lower.cmpge(lo).all() && node.upper.cmple(hi).all());
            if node.count == 0 {
                stack.push((i + 1, depth + 1, node.lower, node.upper));
                stack.push((node.index, depth + 1, node.lower, node.upper));
                continue;
            }
            assert!(node.count <= max_leaf);
            for &t in &bvh.triangles[node.index as usize..][..node.count as usize] {
                assert!(!std::mem::replace(&mut seen[t as usize], true));
                for c in corners[t as usize] {
                    assert!(c.cmpge(node.lower).all() && c.cmple(node.upper).all());
                }
            }
        }
        assert!(seen.iter().all(|&s| s));
        deepest
    }

    #[test]
    fn every_triangle_lies_in_one_leaf_and_in_all_boxes_above() {
        for (bins, max_leaf) in [(2, 1), (16, 3), (64, 3), (256, 8)] {
            for n in [1, 2, 3, 9, 1000, 70_000] {
                let corners = soup(n, 5, 0.1);
                check(&build(&corners, BuildOptions { bins, max_leaf, ..Default::default() }), &corners, max_leaf);
            }
        }
    }

    #[test]
    fn equal_centroids_and_geometric_chains_stay_shallow() {
        let equal: Vec<_> = (1..5000)
            .map(|i| {
                let s = i as f32;
                [Vec3::new(-s, -s, 0.0), Vec3::new(s, -s, 0.0), Vec3::new(0.0, s, 0.0)]
            })
            .collect();
        let chain: Vec<_> = (0..120)
            .map(|i| {
                let s = 2f32.powi(i - 90);
                [Vec3::new(s, 0.0, 0.0), Vec3::new(s, s, 0.0), Vec3::new(s, 0.0, s)]
            })
            .collect();
        for corners in [equal, chain] {
            let depth =
                check(&build(&corners, BuildOptions { bins: 2, max_leaf: 1, ..Default::default() }), &corners, 1);
            assert!(depth <= crate::bvh::layout::MAX_DEPTH, "{depth}");
        }
    }

    /// Builds with 1, 2 and 7 threads, which must give the same bits.
    pub(in crate::bvh) fn assert_no_matter_how_many_threads(build: impl Fn() -> BinaryBvh + Sync) {
        let trees: Vec<_> = [1, 2, 7]
            .into_iter()
            .map(|n| {
                let b = rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap().install(&build);
                let bits = |v: Vec3| v.to_array().map(f32::to_bits);
                let nodes: Vec<_> = b.nodes.iter().map(|n| (bits(n.lower), bits(n.upper), n.index, n.count)).collect();
                (b.triangles, nodes)
            })
            .collect();
        assert!(trees.iter().all(|t| *t == trees[0]));
    }

    #[test]
    fn the_tree_does_not_depend_on_the_number_of_threads() {
        let corners = soup(100_000, 9, 0.01);
        assert_no_matter_how_many_threads(|| build(&corners, BuildOptions::default()));
    }

    #[test]
    fn a_split_pays_by_its_surface_area() {
        // Two far clusters: the root must separate them.
        let mut corners = soup(100, 1, 0.1);
        corners.extend(soup(100, 2, 0.1).into_iter().map(|t| t.map(|c| c + Vec3::X * 100.0)));
        let bvh = build(&corners, BuildOptions::default());
        assert!(bvh.nodes[1].upper.x < 2.0);
        assert!(bvh.nodes[bvh.nodes[0].index as usize].lower.x > 99.0);
    }
}
