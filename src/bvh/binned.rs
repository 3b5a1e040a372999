//! Binary BVH by binned surface area heuristic (thesis 3.1.1; Wald, *On fast Construction of
//! SAH-based Bounding Volume Hierarchies*, 2007), parallel and deterministic.
//!
//! A subtree over n triangles owns a fixed range of 2n − 1 node slots and of n triangle slots, so threads never share
//! any of them. References move between two buffers by a stable partition, which several threads can carry out
//! together; so the tree does not depend on their number.

use super::BuildOptions;
use super::binary::{BinaryBvh, BinaryNode};
use super::bins::{BinMap, Bins, Split, bin_count, in_parallel};
use super::layout::SAH_DEPTH;
use super::partings::{best_parting, halve, leaf_cost, part_few};
use super::references::{Box4, CHUNK, Extent, Range4, Reference, area_scale, references};
use crate::error::Result;
use crate::memory::try_vec;
use crate::progress::Progress;
use glam::{Vec3, Vec4};
use rayon::prelude::*;

/// Subtrees of more triangles than this are built as separate tasks.
pub(super) const PARALLEL_SUBTREE: usize = 4096;

/// Copies `from` to `to`: first the references left of a split, `middle` in number, then the others, both in their old
/// order. Returns the bounds of the centres of both sides.
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
    // Without branches on the side: every reference is written to both sides, and the wrong copy is overwritten by the
    // next.
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
    /// 2n − 1 nodes, the first of which has index `base`.
    nodes: &'a mut [BinaryNode],
    base: u32,
    /// n triangles, the first of which has index `first`.
    triangles: &'a mut [u32],
    first: u32,
}

impl<'a> Slots<'a> {
    /// Divides the slots among a node and its children, the left one over `n` triangles.
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
    /// Builds the subtree over `refs`; `other` is a buffer of the same length.
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
        // All centres are equal, or the node is too deep.
        let middle = halve(refs, &extent);
        let extents = [Extent::of(&refs[..middle]), Extent::of(&refs[middle..])];
        self.children(refs, other, slots, extent, extents, middle, depth, bins);
    }

    /// Builds the subtree over two to four triangles by trying every partition.
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
        // The centres of so few are not needed, unless the node is too deep.
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
