//! Binary BVH by binned surface area heuristic (thesis 3.1.1; Wald, *On fast Construction of
//! SAH-based Bounding Volume Hierarchies*, 2007), parallel and deterministic.
//!
//! A subtree over n triangles owns a fixed range of 2n − 1 node slots and of n triangle slots, so
//! threads never share anything. References move between two buffers by a stable partition, which
//! several threads can share; so the tree does not depend on their number.

use super::BuildOptions;
use super::layout::SAH_DEPTH;
use crate::base::geometry::half_area;
use crate::error::Result;
use crate::memory::try_vec;
use crate::progress::Progress;
#[cfg(target_arch = "x86_64")]
use crate::simd::Isa;
use glam::{Mat4, Vec3, Vec4, Vec4Swizzles};
use rayon::prelude::*;

/// Subtrees of more triangles than this are built as separate tasks.
pub(super) const PARALLEL_SUBTREE: usize = 4096;

/// Ranges of more triangles than this are binned and partitioned by several threads.
const PARALLEL_RANGE: usize = 1 << 15;

/// What one thread takes of such a range at a time.
const CHUNK: usize = 1 << 12;

const MAX_BINS: usize = 256;

/// A node of the binary tree, 32 bytes. The left child of an inner node follows it.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C)]
pub struct BinaryNode {
    /// Lower corner of the node's box.
    pub lower: Vec3,
    /// Inner: number of the right child. Leaf: first triangle slot.
    pub index: u32,
    /// Upper corner of the node's box.
    pub upper: Vec3,
    /// Triangles of a leaf; 0 in an inner node.
    pub count: u32,
}

/// The binary tree, before collapse.
pub struct BinaryBvh {
    /// Node 0 is the root. Slots of subtrees that ended early are unused.
    pub nodes: Vec<BinaryNode>,
    /// Global triangle numbers, leaf by leaf.
    pub triangles: Vec<u32>,
}

/// A box as its negated lower and its upper corner, so that one maximum of eight lanes joins two.
#[derive(Clone, Copy)]
#[repr(C, align(32))]
pub(super) struct Box4 {
    neg_lower: Vec4,
    upper: Vec4,
}

impl Box4 {
    pub(super) const EMPTY: Box4 = Box4 { neg_lower: Vec4::NEG_INFINITY, upper: Vec4::NEG_INFINITY };

    pub(super) fn new(lower: Vec3, upper: Vec3) -> Box4 {
        // −0 + 0 = +0: of two zeros, min and max return one by its place, not by its sign.
        Box4 { neg_lower: (-(lower + Vec3::ZERO)).extend(0.0), upper: (upper + Vec3::ZERO).extend(0.0) }
    }

    pub(super) fn corners(&self) -> (Vec3, Vec3) {
        (-self.neg_lower.truncate(), self.upper.truncate())
    }

    #[inline(always)]
    pub(super) fn join(self, o: Box4) -> Box4 {
        Box4 { neg_lower: self.neg_lower.max(o.neg_lower), upper: self.upper.max(o.upper) }
    }

    #[inline(always)]
    pub(super) fn add(&mut self, p: Vec4) {
        *self = self.join(Box4 { neg_lower: -p, upper: p });
    }

    /// The part that both cover, which may be empty.
    pub(super) fn meet(self, o: Box4) -> Box4 {
        Box4 { neg_lower: self.neg_lower.min(o.neg_lower), upper: self.upper.min(o.upper) }
    }

    pub(super) fn is_empty(&self) -> bool {
        (self.upper + self.neg_lower).truncate().min_element() < 0.0
    }

    /// Half the surface area, 0 if empty.
    pub(super) fn half_area(&self) -> f64 {
        let (lower, upper) = self.corners();
        if self.is_empty() { 0.0 } else { half_area(lower, upper) }
    }

    /// Extent, 0 on axes where there is nothing.
    #[inline(always)]
    pub(super) fn extent(&self) -> Vec4 {
        (self.upper + self.neg_lower).max(Vec4::ZERO)
    }
}

/// The box of a triangle.
#[inline(always)]
pub(super) fn triangle_box([a, b, c]: [Vec3; 3]) -> Box4 {
    Box4::new(a.min(b).min(c), a.max(b).max(c))
}

/// Bounds of centres.
#[derive(Clone, Copy)]
pub(super) struct Range4 {
    lower: Vec4,
    upper: Vec4,
}

impl Range4 {
    const EMPTY: Range4 = Range4 { lower: Vec4::INFINITY, upper: Vec4::NEG_INFINITY };

    #[inline(always)]
    fn grow(&mut self, c: Vec4) {
        self.lower = self.lower.min(c);
        self.upper = self.upper.max(c);
    }

    fn join(self, o: Range4) -> Range4 {
        Range4 { lower: self.lower.min(o.lower), upper: self.upper.max(o.upper) }
    }
}

/// A triangle's box; its number rides in `neg_lower.w` as the low bits of a normal float (arithmetic
/// on denormals would be slow), which no result depends on.
#[derive(Clone, Copy)]
#[repr(transparent)]
pub(super) struct Reference(Box4);

impl Default for Reference {
    fn default() -> Self {
        Reference(Box4 { neg_lower: Vec4::ZERO, upper: Vec4::ZERO })
    }
}

impl Reference {
    const NORMAL: u32 = 0x4000_0000;

    fn new(id: u32, corners: [Vec3; 3]) -> Self {
        Reference::of_box(id, triangle_box(corners))
    }

    pub(super) fn of_box(id: u32, mut b: Box4) -> Self {
        debug_assert!(id < Self::NORMAL);
        b.neg_lower.w = f32::from_bits(id | Self::NORMAL);
        Reference(b)
    }

    pub(super) fn bounds(&self) -> Box4 {
        self.0
    }

    pub(super) fn id(&self) -> u32 {
        self.0.neg_lower.w.to_bits() & (Self::NORMAL - 1)
    }

    /// Twice the box's centre: no rounding for the division, and all comparisons are the same.
    #[inline(always)]
    pub(super) fn centre(&self) -> Vec4 {
        self.0.upper - self.0.neg_lower
    }
}

/// Half the surface areas of boxes of extents `d`, in lanes.
#[inline(always)]
pub(super) fn half_areas(d: [Vec4; 4]) -> Vec4 {
    let [a, b, c, d] = d.map(|d| d * d.yzxw());
    let sums = Mat4::from_cols(a, b, c, d).transpose();
    sums.x_axis + sums.y_axis + sums.z_axis
}

/// A power of two near 1 / greatest extent, so that f32 areas of boxes inside neither over- nor
/// underflow, and scaling is exact.
#[inline(always)]
pub(super) fn area_scale(b: &Box4) -> f32 {
    let exponent = b.extent().truncate().max_element().to_bits() & 0x7f80_0000;
    f32::from_bits((0x7f00_0000 - exponent.min(0x7e80_0000)).max(1 << 23))
}

/// Bounds of the boxes and of their centres.
#[derive(Clone, Copy)]
pub(super) struct Extent {
    pub(super) boxes: Box4,
    pub(super) centres: Range4,
}

impl Extent {
    pub(super) const EMPTY: Extent = Extent { boxes: Box4::EMPTY, centres: Range4::EMPTY };

    pub(super) fn of(refs: &[Reference]) -> Extent {
        let mut e = Extent::EMPTY;
        for r in refs {
            e.boxes = e.boxes.join(r.0);
            e.centres.grow(r.centre());
        }
        e
    }

    pub(super) fn join(self, o: Extent) -> Extent {
        Extent { boxes: self.boxes.join(o.boxes), centres: self.centres.join(o.centres) }
    }
}

/// Whether to share the work on a range among threads. The results are the same.
pub(super) fn in_parallel(n: usize) -> bool {
    n > PARALLEL_RANGE && rayon::current_num_threads() > 1
}

/// Maps centres to bins on all three axes.
#[derive(Clone, Copy)]
pub(super) struct BinMap {
    origin: Vec4,
    scale: Vec4,
    last: Vec4,
    pub(super) bins: usize,
}

impl BinMap {
    pub(super) fn new(centres: &Range4, bins: usize) -> Self {
        let extent = centres.upper - centres.lower;
        let scale = Vec4::splat(bins as f32) / extent;
        let ok = extent.cmpgt(Vec4::ZERO) & scale.cmplt(Vec4::INFINITY);
        let scale = Vec4::select(ok, scale, Vec4::ZERO);
        BinMap { origin: centres.lower, scale, last: Vec4::splat(bins as f32 - 1.0), bins }
    }

    /// The bins as floats: any monotonic rounding will do, so the nearest is taken, which is one
    /// addition.
    #[inline(always)]
    fn bin(&self, r: &Reference) -> Vec4 {
        let b = (r.centre() - self.origin) * self.scale - Vec4::splat(0.5);
        b.max(Vec4::ZERO).min(self.last) + Vec4::splat(8_388_608.0)
    }

    pub(super) fn side(&self, split: &Split) -> Side {
        let axis = split.axis;
        let first_right = split.bin as f32 + 8_388_608.0;
        Side { axis, origin: self.origin[axis], scale: self.scale[axis], first_right }
    }

    /// The bins as numbers.
    #[inline(always)]
    fn indices(&self, r: &Reference) -> [usize; 3] {
        let b = self.bin(r);
        [b.x, b.y, b.z].map(|b| (b.to_bits() & 0xff) as usize)
    }
}

/// Tells the sides of a split by the same arithmetic as [`BinMap::bin`].
pub(super) struct Side {
    axis: usize,
    origin: f32,
    scale: f32,
    first_right: f32,
}

impl Side {
    #[inline(always)]
    fn bin(&self, r: &Reference) -> f32 {
        let c = r.0.upper[self.axis] - r.0.neg_lower[self.axis];
        (c - self.origin) * self.scale - 0.5 + 8_388_608.0
    }

    #[inline(always)]
    pub(super) fn is_left(&self, r: &Reference) -> bool {
        self.bin(r) < self.first_right
    }
}

/// One bin on each axis.
#[derive(Clone, Copy)]
struct Bin {
    boxes: [Box4; 3],
    /// Signed, because that converts to floats in one instruction; the last is unused.
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

    /// Areas times counts per axis, with extents scaled; infinite where there is nothing. (Counted in
    /// fours, as they are tested, random rays are no faster.)
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
    axis: usize,
    /// First bin on the right.
    bin: usize,
}

/// An array of copies of `value`, which is never on the stack.
pub(super) fn on_heap<T: Copy, const N: usize>(value: T) -> Box<[T; N]> {
    vec![value; N].try_into().unwrap_or_else(|_| unreachable!("the vector has N elements"))
}

/// The bins of a node, and scratch space for the costs of what lies right of each.
///
/// Both are on the heap from the start: builds recurse, and a frame that holds them even for a moment holds
/// them on every level.
pub(super) struct Bins {
    bins: Box<[Bin; MAX_BINS]>,
    right: Box<[Vec4; MAX_BINS]>,
    /// Only minima and maxima depend on it, which are the same bits either way.
    #[cfg(target_arch = "x86_64")]
    has_avx: bool,
}

impl Bins {
    pub(super) fn new() -> Bins {
        Bins {
            bins: on_heap(Bin::EMPTY),
            right: on_heap(Vec4::ZERO),
            #[cfg(target_arch = "x86_64")]
            has_avx: Isa::Avx2.is_available(),
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
            .collect();
        for part in &parts {
            for b in 0..map.bins {
                self.bins[b].add(&part.bins[b]);
            }
        }
    }

    fn add(&mut self, refs: &[Reference], map: &BinMap) {
        #[cfg(target_arch = "x86_64")]
        if self.has_avx {
            // SAFETY: the CPU has AVX2, and with it AVX.
            return unsafe { self.add_avx(refs, map) };
        }
        for r in refs {
            for (axis, b) in map.indices(r).into_iter().enumerate() {
                let bin = &mut self.bins[b];
                bin.boxes[axis] = bin.boxes[axis].join(r.0);
                bin.counts[axis] += 1;
            }
        }
    }

    /// The same with boxes in one register each. (Even and odd references into two sets of bins, so
    /// that they do not wait for each other's stores: 0 to 3 %, not kept.)
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx")]
    fn add_avx(&mut self, refs: &[Reference], map: &BinMap) {
        use std::arch::x86_64::{_mm256_load_ps, _mm256_max_ps, _mm256_store_ps};
        for r in refs {
            // SAFETY: a box is eight floats, aligned for this.
            let new = unsafe { _mm256_load_ps((&raw const r.0).cast()) };
            for (axis, b) in map.indices(r).into_iter().enumerate() {
                let bin = &mut self.bins[b];
                let p = (&raw mut bin.boxes[axis]).cast();
                // SAFETY: as above.
                unsafe { _mm256_store_ps(p, _mm256_max_ps(_mm256_load_ps(p), new)) };
                bin.counts[axis] += 1;
            }
        }
    }

    /// The best split with triangles on both sides. `scale` keeps f32 areas from over- and
    /// underflow.
    pub(super) fn best_split(&mut self, map: &BinMap, scale: f32) -> Option<Split> {
        let scale = Vec4::splat(scale);
        let mut sum = Bin::EMPTY;
        for i in (1..map.bins).rev() {
            sum.add(&self.bins[i]);
            self.right[i] = sum.cost(scale);
        }
        let mut sum = Bin::EMPTY;
        let (mut best, mut best_bin) = (Vec4::INFINITY, Vec4::ZERO);
        for i in 1..map.bins {
            sum.add(&self.bins[i - 1]);
            let cost = sum.cost(scale) + self.right[i];
            let better = cost.cmplt(best);
            best = Vec4::select(better, cost, best);
            best_bin = Vec4::select(better, Vec4::splat(i as f32), best_bin);
        }
        let axis = if best.x <= best.y && best.x <= best.z { 0 } else { 1 + usize::from(best.z < best.y) };
        (best[axis] < f32::INFINITY).then(|| Split { cost: best[axis], axis, bin: best_bin[axis] as usize })
    }

    /// Triangles left of a split, and the boxes of both sides.
    pub(super) fn sides(&self, map: &BinMap, split: &Split) -> (usize, [Box4; 2]) {
        let join = |bins: &[Bin]| bins.iter().fold(Box4::EMPTY, |b, bin| b.join(bin.boxes[split.axis]));
        let (left, right) = self.bins[..map.bins].split_at(split.bin);
        let n: i32 = left.iter().map(|b| b.counts[split.axis]).sum();
        (n as usize, [join(left), join(right)])
    }
}

/// Copies `from` to `to`: first those left of a split, `middle` in number, then the others, both in
/// their old order. Gives the bounds of the centres of both sides.
fn partition(from: &[Reference], to: &mut [Reference], middle: usize, map: &BinMap, split: &Split) -> [Range4; 2] {
    let (left, right) = to.split_at_mut(middle);
    if !in_parallel(from.len()) {
        return partition_chunk(from, left, right, map, split);
    }
    let side = map.side(split);
    let counts: Vec<usize> =
        from.par_chunks(CHUNK).map(|chunk| chunk.iter().filter(|r| side.is_left(r)).count()).collect();
    let (mut left, mut right) = (left, right);
    let mut parts = Vec::with_capacity(counts.len());
    for (chunk, &n) in from.chunks(CHUNK).zip(&counts) {
        let (l, rest) = std::mem::take(&mut left).split_at_mut(n);
        left = rest;
        let (r, rest) = std::mem::take(&mut right).split_at_mut(chunk.len() - n);
        right = rest;
        parts.push((chunk, l, r));
    }
    parts
        .into_par_iter()
        .map(|(chunk, l, r)| partition_chunk(chunk, l, r, map, split))
        .reduce(|| [Range4::EMPTY; 2], |[a, b], [c, d]| [a.join(c), b.join(d)])
}

fn partition_chunk(
    from: &[Reference],
    left: &mut [Reference],
    right: &mut [Reference],
    map: &BinMap,
    split: &Split,
) -> [Range4; 2] {
    let side = map.side(split);
    let [mut low, mut high] = [Range4::EMPTY; 2];
    let (mut l, mut r, mut i) = (0, 0, 0);
    // Without branches on the side: every reference is written to both, and the wrong copy is
    // overwritten by the next.
    while l < left.len() && r < right.len() {
        let reference = &from[i];
        let mask = Vec4::splat(side.bin(reference)).cmplt(Vec4::splat(side.first_right));
        let is_left = (mask.bitmask() & 1) as usize;
        left[l] = *reference;
        right[r] = *reference;
        l += is_left;
        r += 1 - is_left;
        i += 1;
        let c = reference.centre();
        low.lower = low.lower.min(Vec4::select(mask, c, Vec4::INFINITY));
        low.upper = low.upper.max(Vec4::select(mask, c, Vec4::NEG_INFINITY));
        high.lower = high.lower.min(Vec4::select(mask, Vec4::INFINITY, c));
        high.upper = high.upper.max(Vec4::select(mask, Vec4::NEG_INFINITY, c));
    }
    let rest = &from[i..];
    let (to, range) = if l < left.len() { (&mut left[l..], &mut low) } else { (&mut right[r..], &mut high) };
    to.copy_from_slice(rest);
    rest.iter().for_each(|r| range.grow(r.centre()));
    [low, high]
}

/// The slots of a subtree.
struct Slots<'a> {
    /// 2n − 1 nodes, the first is number `base`.
    nodes: &'a mut [BinaryNode],
    base: u32,
    /// n triangles, the first is number `first`.
    triangles: &'a mut [u32],
    first: u32,
}

impl<'a> Slots<'a> {
    /// The slots of the children, the left one over `n` triangles.
    fn split(self, n: usize) -> (&'a mut BinaryNode, Slots<'a>, Slots<'a>) {
        let (node, rest) = self.nodes.split_first_mut().expect("a subtree has a node");
        let (left, right) = rest.split_at_mut(2 * n - 1);
        let (left_triangles, right_triangles) = self.triangles.split_at_mut(n);
        (
            node,
            Slots { nodes: left, base: self.base + 1, triangles: left_triangles, first: self.first },
            Slots {
                nodes: right,
                base: self.base + 2 * n as u32,
                triangles: right_triangles,
                first: self.first + n as u32,
            },
        )
    }

    fn leaf(self, refs: &[Reference], bounds: &Box4) {
        let (lower, upper) = bounds.corners();
        self.nodes[0] = BinaryNode { lower, upper, index: self.first, count: refs.len() as u32 };
        for (t, r) in self.triangles.iter_mut().zip(refs) {
            *t = r.id();
        }
    }
}

struct Builder<'a, 'p> {
    options: &'a BuildOptions,
    progress: &'a Progress<'p>,
}

impl Builder<'_, '_> {
    /// Builds the subtree over `refs`; `other` is as long and holds nothing.
    fn build(
        &self,
        refs: &mut [Reference],
        other: &mut [Reference],
        slots: Slots,
        extent: Extent,
        depth: usize,
        bins: &mut Bins,
    ) {
        let n = refs.len();
        if n == 1 {
            return slots.leaf(refs, &extent.boxes);
        }
        let may_be_leaf = n <= self.options.max_leaf as usize;
        if n <= 4 && depth < SAH_DEPTH {
            return self.few(refs, other, slots, extent, depth, bins);
        }
        if depth < SAH_DEPTH {
            let scale = area_scale(&extent.boxes);
            let map = BinMap::new(&extent.centres, bin_count(self.options.bins as usize, n));
            bins.fill(refs, &map);
            if let Some(split) = bins.best_split(&map, scale) {
                if may_be_leaf && leaf_cost(&extent.boxes, scale, n) <= split.cost {
                    return slots.leaf(refs, &extent.boxes);
                }
                let (middle, boxes) = bins.sides(&map, &split);
                let centres = partition(refs, other, middle, &map, &split);
                let [left, right] = [0, 1].map(|i| Extent { boxes: boxes[i], centres: centres[i] });
                return self.children(other, refs, slots, extent, [left, right], middle, depth, bins);
            }
        }
        if may_be_leaf {
            return slots.leaf(refs, &extent.boxes);
        }
        // All centres equal, or too deep.
        let middle = halve(refs, &extent);
        let extents = [Extent::of(&refs[..middle]), Extent::of(&refs[middle..])];
        self.children(refs, other, slots, extent, extents, middle, depth, bins);
    }

    /// Builds the subtree over two to four triangles by trying every way to part them.
    fn few(
        &self,
        refs: &mut [Reference],
        other: &mut [Reference],
        slots: Slots,
        extent: Extent,
        depth: usize,
        bins: &mut Bins,
    ) {
        let scale = area_scale(&extent.boxes);
        let (cost, parting) = best_parting(refs, scale);
        if refs.len() <= self.options.max_leaf as usize && leaf_cost(&extent.boxes, scale, refs.len()) <= cost {
            return slots.leaf(refs, &extent.boxes);
        }
        let middle = part_few(refs, parting);
        // Nothing looks at the centres of so few, unless too deep.
        let extents = [&refs[..middle], &refs[middle..]].map(|refs| {
            let boxes = refs.iter().fold(Box4::EMPTY, |b, r| b.join(r.0));
            Extent { boxes, centres: extent.centres }
        });
        self.children(refs, other, slots, extent, extents, middle, depth, bins);
    }

    /// Builds an inner node and its children, over the first `middle` of `refs` and the others.
    fn children(
        &self,
        refs: &mut [Reference],
        other: &mut [Reference],
        slots: Slots,
        extent: Extent,
        [left_extent, right_extent]: [Extent; 2],
        middle: usize,
        depth: usize,
        bins: &mut Bins,
    ) {
        let parallel = refs.len() > PARALLEL_SUBTREE;
        let (left_refs, right_refs) = refs.split_at_mut(middle);
        let (left_other, right_other) = other.split_at_mut(middle);
        let (node, left, right) = slots.split(middle);
        let (lower, upper) = extent.boxes.corners();
        *node = BinaryNode { lower, upper, index: right.base, count: 0 };
        if !parallel {
            self.build(left_refs, left_other, left, left_extent, depth + 1, bins);
            self.build(right_refs, right_other, right, right_extent, depth + 1, bins);
        } else if !self.progress.is_cancelled() {
            rayon::join(
                || self.build(left_refs, left_other, left, left_extent, depth + 1, bins),
                || self.build(right_refs, right_other, right, right_extent, depth + 1, &mut Bins::new()),
            );
        }
    }
}

/// Cost of testing n triangles, of which four are tested at a time, in traversal steps. (With n alone,
/// random rays take 3 to 4 % more instructions; with 3 + n / 2 as many.)
pub(super) fn leaf_weight(n: usize) -> f32 {
    if n <= 4 { 1.0 + 0.5 * n as f32 } else { n as f32 }
}

/// Cost of a leaf less that of a traversal step, in the units of [`Bins::best_split`].
pub(super) fn leaf_cost(bounds: &Box4, scale: f32, n: usize) -> f32 {
    half_areas([bounds.extent() * scale; 4]).x * (leaf_weight(n) - 1.0)
}

/// A way to part two to four references: 0 to 3: that one from the others; 4 to 6: the first and one
/// more from the other two.
#[derive(Clone, Copy)]
pub(super) struct Parting(usize);

/// The best way to part two to four references, with its cost.
pub(super) fn best_parting(refs: &[Reference], scale: f32) -> (f32, Parting) {
    let n = refs.len();
    let boxes: [Box4; 4] = std::array::from_fn(|i| if i < n { refs[i].0 } else { Box4::EMPTY });
    let pair = |i: usize, j: usize| boxes[i].join(boxes[j]);
    let (p01, p23) = (pair(0, 1), pair(2, 3));
    let areas = |b: [Box4; 4]| half_areas(b.map(|b| b.extent() * scale));
    let others = [p23.join(boxes[1]), p23.join(boxes[0]), p01.join(boxes[3]), p01.join(boxes[2])];
    let ones = (areas(boxes) * leaf_weight(1) + areas(others) * leaf_weight(n - 1)).to_array();
    let mut best = (f32::INFINITY, 0);
    for i in 0..n {
        if ones[i] < best.0 {
            best = (ones[i], i);
        }
    }
    if n == 4 {
        let left = areas([p01, pair(0, 2), pair(0, 3), p01]);
        let right = areas([p23, pair(1, 3), pair(1, 2), p23]);
        let pairs = (leaf_weight(2) * (left + right)).to_array();
        for i in 0..3 {
            if pairs[i] < best.0 {
                best = (pairs[i], 4 + i);
            }
        }
    }
    (best.0, Parting(best.1))
}

/// Brings references into the order of a parting and says how many are on the left.
pub(super) fn part_few(refs: &mut [Reference], Parting(i): Parting) -> usize {
    if i < 4 {
        refs.swap(0, i);
        1
    } else {
        refs.swap(1, i - 3);
        2
    }
}

/// Halves references along the widest axis of their centres; ties are broken by number.
pub(super) fn halve(refs: &mut [Reference], extent: &Extent) -> usize {
    let d = extent.centres.upper - extent.centres.lower;
    let axis = if d.x >= d.y && d.x >= d.z { 0 } else { 1 + usize::from(d.z > d.y) };
    let middle = refs.len() / 2;
    refs.select_nth_unstable_by(middle, |a, b| a.centre()[axis].total_cmp(&b.centre()[axis]).then(a.id().cmp(&b.id())));
    middle
}

/// Few triangles do not fill many bins; fewer bins find the same splits sooner. (2n bins: longer for
/// the same cost; n / 20 + 4: a tenth faster, cost up to 0.6 % higher. How many bins there are at
/// most hardly matters then: 16 to 64 take the same time within 5 %.)
pub(super) fn bin_count(most: usize, n: usize) -> usize {
    most.min(n / 4 + 6)
}

/// References to the triangles `valid` of `corners`, and their extent.
pub(super) fn references(corners: &[[Vec3; 3]], valid: &[u32]) -> Result<(Vec<Reference>, Extent)> {
    let mut refs = try_vec::<Reference>(valid.len(), "references to triangles")?;
    let extent = refs
        .par_chunks_mut(CHUNK)
        .zip(valid.par_chunks(CHUNK))
        .map(|(refs, valid)| {
            for (r, &t) in refs.iter_mut().zip(valid) {
                *r = Reference::new(t, corners[t as usize]);
            }
            Extent::of(refs)
        })
        .reduce(|| Extent::EMPTY, Extent::join);
    Ok((refs, extent))
}

impl BinaryBvh {
    /// Builds the tree over the triangles `valid` of `corners`, on the current rayon pool.
    pub fn build(
        corners: &[[Vec3; 3]],
        valid: &[u32],
        options: &BuildOptions,
        progress: &Progress,
    ) -> Result<BinaryBvh> {
        let n = valid.len();
        let (mut refs, extent) = references(corners, valid)?;
        let mut other = try_vec::<Reference>(n, "references to triangles")?;
        let mut nodes = try_vec::<BinaryNode>(2 * n - 1, "the binary tree")?;
        let mut triangles = try_vec::<u32>(n, "the binary tree")?;
        let slots = Slots { nodes: &mut nodes, base: 0, triangles: &mut triangles, first: 0 };
        Builder { options, progress }.build(&mut refs, &mut other, slots, extent, 0, &mut Bins::new());
        progress.check()?;
        Ok(BinaryBvh { nodes, triangles })
    }

    /// Surface area heuristic: expected cost of a random ray through the root's box, traversal
    /// step and intersection costing 1 each.
    pub fn sah_cost(&self) -> f32 {
        let root = &self.nodes[0];
        let root_area = half_area(root.lower, root.upper);
        if root_area == 0.0 {
            return self.triangles.len() as f32;
        }
        // Unused slots have no area.
        let chunks: Vec<f64> = self
            .nodes
            .par_chunks(1 << 14)
            .map(|nodes| nodes.iter().map(|n| f64::from(n.count.max(1)) * half_area(n.lower, n.upper)).sum())
            .collect();
        (chunks.iter().sum::<f64>() / root_area) as f32
    }

    /// Half the surface area of a node's box.
    pub(super) fn half_area(&self, node: u32) -> f64 {
        let n = &self.nodes[node as usize];
        half_area(n.lower, n.upper)
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::sampling::uniform;

    fn soup(n: usize, seed: u32, size: f32) -> Vec<[Vec3; 3]> {
        let p = |i: usize, k: u32| {
            Vec3::new(uniform(i as u32, k, seed), uniform(i as u32, k + 1, seed), uniform(i as u32, k + 2, seed))
        };
        (0..n).map(|i| [p(i, 0), p(i, 0) + size * p(i, 3), p(i, 0) + size * p(i, 6)]).collect()
    }

    fn build(corners: &[[Vec3; 3]], options: BuildOptions) -> BinaryBvh {
        let ids: Vec<u32> = (0..corners.len() as u32).collect();
        BinaryBvh::build(corners, &ids, &options, &Progress::none()).unwrap()
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
