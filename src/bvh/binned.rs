//! Binary BVH by binned surface area heuristic (thesis 3.1.1; Wald, *On fast Construction of
//! SAH-based Bounding Volume Hierarchies*, 2007), parallel and deterministic.
//!
//! A subtree over n triangles owns a fixed range of 2n − 1 node slots and of n triangle slots, so
//! threads never share anything and the tree does not depend on their number.

use super::BuildOptions;
use super::layout::SAH_DEPTH;
use crate::error::Result;
use crate::memory::try_vec;
use crate::progress::Progress;
use glam::{Vec3, Vec4};
use rayon::prelude::*;

/// Subtrees of more triangles than this are built as separate tasks.
const PARALLEL_SUBTREE: usize = 4096;

/// Ranges of more triangles than this are bounded and binned by several threads.
const PARALLEL_BINNING: usize = 1 << 16;

const MAX_BINS: usize = 256;

/// A node of the binary tree, 32 bytes. The left child of an inner node follows it.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C)]
pub struct BinaryNode {
    pub lower: Vec3,
    /// Inner: number of the right child. Leaf: first triangle slot.
    pub index: u32,
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

/// A triangle's box; its number rides in `lower.w` as bits, which min and max never look at.
#[derive(Clone, Copy)]
struct Reference {
    lower: Vec4,
    upper: Vec4,
}

impl Reference {
    fn new(id: u32, [a, b, c]: [Vec3; 3]) -> Self {
        let (lower, upper) = (a.min(b).min(c), a.max(b).max(c));
        Reference { lower: lower.extend(f32::from_bits(id)), upper: upper.extend(0.0) }
    }

    fn id(&self) -> u32 {
        self.lower.w.to_bits()
    }

    /// Twice the box's centre: no rounding for the division, and all comparisons are the same.
    #[inline]
    fn centre(&self) -> Vec4 {
        self.lower + self.upper
    }
}

#[derive(Clone, Copy)]
struct Box4 {
    lower: Vec4,
    upper: Vec4,
}

impl Box4 {
    const EMPTY: Box4 = Box4 { lower: Vec4::INFINITY, upper: Vec4::NEG_INFINITY };

    #[inline]
    fn grow(&mut self, lower: Vec4, upper: Vec4) {
        self.lower = self.lower.min(lower);
        self.upper = self.upper.max(upper);
    }

    fn join(mut self, o: Box4) -> Box4 {
        self.grow(o.lower, o.upper);
        self
    }

    /// Half the surface area, in f64: sums over huge scenes neither overflow nor cancel.
    #[inline]
    fn half_area(&self) -> f64 {
        half_area(self.lower.truncate(), self.upper.truncate())
    }
}

fn half_area(lower: Vec3, upper: Vec3) -> f64 {
    let d = (upper - lower).max(Vec3::ZERO).as_dvec3();
    d.x * d.y + d.y * d.z + d.z * d.x
}

/// Bounds of the boxes and of their centres.
#[derive(Clone, Copy)]
struct Extent {
    boxes: Box4,
    centres: Box4,
}

impl Extent {
    const EMPTY: Extent = Extent { boxes: Box4::EMPTY, centres: Box4::EMPTY };

    fn of(refs: &[Reference]) -> Extent {
        let sequential = |refs: &[Reference]| {
            let mut e = Extent::EMPTY;
            for r in refs {
                e.boxes.grow(r.lower, r.upper);
                e.centres.grow(r.centre(), r.centre());
            }
            e
        };
        if refs.len() > PARALLEL_BINNING {
            refs.par_chunks(PARALLEL_BINNING / 4).map(sequential).reduce(|| Extent::EMPTY, Extent::join)
        } else {
            sequential(refs)
        }
    }

    fn join(self, o: Extent) -> Extent {
        Extent { boxes: self.boxes.join(o.boxes), centres: self.centres.join(o.centres) }
    }
}

/// Maps centres to bins on all three axes.
#[derive(Clone, Copy)]
struct BinMap {
    origin: Vec4,
    scale: Vec4,
    bins: usize,
}

impl BinMap {
    fn new(centres: &Box4, bins: usize) -> Self {
        let extent = centres.upper - centres.lower;
        // The factor below 1 keeps the greatest centre in the last bin.
        let scale = Vec4::splat(bins as f32 * 0.999_999) / extent;
        let ok = extent.cmpgt(Vec4::ZERO) & scale.cmplt(Vec4::INFINITY);
        BinMap { origin: centres.lower, scale: Vec4::select(ok, scale, Vec4::ZERO), bins }
    }

    #[inline]
    fn bin(&self, r: &Reference) -> [usize; 3] {
        let b = (r.centre() - self.origin) * self.scale;
        [b.x, b.y, b.z].map(|x| (x as usize).min(self.bins - 1))
    }
}

struct Bins {
    boxes: Vec<[Box4; 3]>,
    counts: Vec<[u32; 3]>,
}

impl Bins {
    fn fill(refs: &[Reference], map: &BinMap) -> Bins {
        let sequential = |refs: &[Reference]| {
            let mut bins = Bins { boxes: vec![[Box4::EMPTY; 3]; map.bins], counts: vec![[0; 3]; map.bins] };
            for r in refs {
                for (axis, b) in map.bin(r).into_iter().enumerate() {
                    bins.boxes[b][axis].grow(r.lower, r.upper);
                    bins.counts[b][axis] += 1;
                }
            }
            bins
        };
        if refs.len() > PARALLEL_BINNING {
            refs.par_chunks(PARALLEL_BINNING / 4)
                .map(sequential)
                .reduce_with(Bins::join)
                .expect("a parallel range is not empty")
        } else {
            sequential(refs)
        }
    }

    fn join(mut self, o: Bins) -> Bins {
        for b in 0..self.boxes.len() {
            for axis in 0..3 {
                self.boxes[b][axis] = self.boxes[b][axis].join(o.boxes[b][axis]);
                self.counts[b][axis] += o.counts[b][axis];
            }
        }
        self
    }

    /// The best (cost, axis, first bin on the right); cost is Σ half area · triangles.
    fn best_split(&self, map: &BinMap) -> Option<(f64, usize, usize)> {
        let mut best: Option<(f64, usize, usize)> = None;
        let mut right = [0.0f64; MAX_BINS];
        for axis in 0..3 {
            if map.scale[axis] == 0.0 {
                continue;
            }
            let (mut b, mut n) = (Box4::EMPTY, 0);
            for i in (1..map.bins).rev() {
                b = b.join(self.boxes[i][axis]);
                n += self.counts[i][axis];
                right[i] = if n > 0 { b.half_area() * n as f64 } else { f64::INFINITY };
            }
            let (mut b, mut n) = (Box4::EMPTY, 0);
            for i in 1..map.bins {
                b = b.join(self.boxes[i - 1][axis]);
                n += self.counts[i - 1][axis];
                if n == 0 {
                    continue;
                }
                let cost = b.half_area() * n as f64 + right[i];
                if cost < best.map_or(f64::INFINITY, |x| x.0) {
                    best = Some((cost, axis, i));
                }
            }
        }
        best
    }
}

struct Builder<'a, 'p> {
    options: &'a BuildOptions,
    progress: &'a Progress<'p>,
}

impl Builder<'_, '_> {
    /// Builds the subtree over `refs` into `nodes` (2n − 1 slots, the first is number `base`).
    fn build(
        &self,
        refs: &mut [Reference],
        nodes: &mut [BinaryNode],
        base: u32,
        slot: u32,
        extent: Extent,
        depth: usize,
    ) {
        let (lower, upper) = (extent.boxes.lower.truncate(), extent.boxes.upper.truncate());
        let leaf = BinaryNode { lower, upper, index: slot, count: refs.len() as u32 };
        if refs.len() == 1 {
            nodes[0] = leaf;
            return;
        }
        let Some(middle) = self.split(refs, &extent, depth) else {
            nodes[0] = leaf;
            return;
        };
        nodes[0] = BinaryNode { lower, upper, index: base + 2 * middle as u32, count: 0 };
        let parallel = refs.len() > PARALLEL_SUBTREE;
        let (left_refs, right_refs) = refs.split_at_mut(middle);
        let (left_nodes, right_nodes) = nodes[1..].split_at_mut(2 * middle - 1);
        let mut left = || {
            let e = Extent::of(left_refs);
            self.build(left_refs, left_nodes, base + 1, slot, e, depth + 1);
        };
        let mut right = || {
            let e = Extent::of(right_refs);
            self.build(right_refs, right_nodes, base + 2 * middle as u32, slot + middle as u32, e, depth + 1);
        };
        if !parallel {
            left();
            right();
        } else if !self.progress.is_cancelled() {
            rayon::join(left, right);
        }
    }

    /// Partitions `refs` and says where the right part starts; `None`: make a leaf.
    fn split(&self, refs: &mut [Reference], extent: &Extent, depth: usize) -> Option<usize> {
        let n = refs.len();
        let may_be_leaf = n <= self.options.max_leaf as usize;
        if depth < SAH_DEPTH {
            // Few triangles do not fill many bins; fewer bins find the same splits sooner.
            let bins = (self.options.bins as usize).min(n.max(4) * 2);
            let map = BinMap::new(&extent.centres, bins);
            if let Some((cost, axis, first_right)) = Bins::fill(refs, &map).best_split(&map) {
                if may_be_leaf && extent.boxes.half_area() * (n as f64 - 1.0) <= cost {
                    return None;
                }
                return Some(partition(refs, |r| map.bin(r)[axis] < first_right));
            }
        }
        if may_be_leaf {
            return None;
        }
        // All centres equal, or too deep: halve along the widest axis.
        let d = extent.centres.upper - extent.centres.lower;
        let axis = if d.x >= d.y && d.x >= d.z { 0 } else { 1 + usize::from(d.z > d.y) };
        refs.select_nth_unstable_by(n / 2, |a, b| {
            a.centre()[axis].total_cmp(&b.centre()[axis]).then(a.id().cmp(&b.id()))
        });
        Some(n / 2)
    }
}

/// Moves those for which `left` holds to the front and says how many they are.
fn partition(refs: &mut [Reference], left: impl Fn(&Reference) -> bool) -> usize {
    let (mut i, mut j) = (0, refs.len());
    loop {
        while i < j && left(&refs[i]) {
            i += 1;
        }
        while i < j && !left(&refs[j - 1]) {
            j -= 1;
        }
        if i == j {
            return i;
        }
        refs.swap(i, j - 1);
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
        let mut refs: Vec<Reference> =
            valid.par_iter().with_min_len(4096).map(|&t| Reference::new(t, corners[t as usize])).collect();
        let mut nodes = try_vec::<BinaryNode>(2 * n - 1, "the binary tree")?;
        let extent = Extent::of(&refs);
        Builder { options, progress }.build(&mut refs, &mut nodes, 0, 0, extent, 0);
        progress.check()?;
        Ok(BinaryBvh { nodes, triangles: refs.iter().map(Reference::id).collect() })
    }

    /// Surface area heuristic: expected cost of a random ray through the root's box, traversal
    /// step and intersection costing 1 each.
    pub fn sah_cost(&self) -> f32 {
        let root = &self.nodes[0];
        let root_area = half_area(root.lower, root.upper);
        if root_area == 0.0 {
            return self.triangles.len() as f32;
        }
        let mut sum = 0.0;
        let mut stack = vec![0u32];
        while let Some(i) = stack.pop() {
            let node = &self.nodes[i as usize];
            let weight = if node.count > 0 { node.count as f64 } else { 1.0 };
            sum += weight * half_area(node.lower, node.upper);
            if node.count == 0 {
                stack.extend([i + 1, node.index]);
            }
        }
        (sum / root_area) as f32
    }

    /// Half the surface area of a node's box.
    pub(super) fn half_area(&self, node: u32) -> f64 {
        let n = &self.nodes[node as usize];
        half_area(n.lower, n.upper)
    }
}

#[cfg(test)]
mod tests {
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
                check(&build(&corners, BuildOptions { bins, max_leaf }), &corners, max_leaf);
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
            let depth = check(&build(&corners, BuildOptions { bins: 2, max_leaf: 1 }), &corners, 1);
            assert!(depth <= crate::bvh::layout::MAX_DEPTH, "{depth}");
        }
    }

    #[test]
    fn the_tree_does_not_depend_on_the_number_of_threads() {
        let corners = soup(100_000, 9, 0.01);
        let trees: Vec<_> = [1, 2, 7]
            .into_iter()
            .map(|n| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
                let b = pool.install(|| build(&corners, BuildOptions::default()));
                (b.triangles.clone(), b.sah_cost().to_bits())
            })
            .collect();
        assert!(trees.iter().all(|t| *t == trees[0]));
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
