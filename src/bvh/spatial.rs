//! Binary BVH with spatial splits: M. Stich, H. Friedrich and A. Dietrich, *Spatial Splits in
//! Bounding Volume Hierarchies*, 2009.
//!
//! A node is split between triangles, as in [`binned`](super::binned), or by a plane that cuts
//! triangles: both sides then refer to a cut triangle, each with the box of its part. That pays
//! where large triangles overlap small ones. Subtrees are built in parallel; each has its own share
//! of the references that may be added, so that the tree does not depend on the number of threads.
//!
//! Planes are searched for in [`slabs`](super::slabs); [`cut`](super::cut) cuts triangles.

use super::BuildOptions;
use super::binary::{BinaryBvh, BinaryNode};
use super::binned::PARALLEL_SUBTREE;
use super::bins::{BinMap, Bins, Side, bin_count};
use super::cut::cut;
use super::layout::SAH_DEPTH;
use super::partings::{best_parting, halve, leaf_cost, part_few};
use super::references::{Box4, Extent, Reference, References, area_scale, half_areas};
use super::slabs::{Grid, Plane, Slabs};
use crate::base::error::{Error, Result};
use crate::base::memory::try_zeroed;
use crate::base::progress::Progress;
use glam::Vec3;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

/// Planes are tried only where the halves of the best split between triangles overlap by more than
/// this part of the root's area (the paper's α, there 1e-5; this takes a tenth longer, but a ground
/// plane that makes the root huge does not at once forbid all cuts).
const ALPHA: f32 = 1e-6;

/// Planes are tried only where the halves also overlap by more than this fraction of the node's own area. Without that
/// (the paper has only α) the build takes twice as long, for trees of 1 % less cost.
const OVERLAP: f64 = 0.2;

/// Levels on which the surface area decides. One less than elsewhere, because cut triangles can
/// double the references that are halved below it.
const FREE_DEPTH: usize = SAH_DEPTH - 1;

/// Maximum number of slots that leaf references can address.
const MAX_SLOTS: usize = (1 << 28) - 2;

/// Buffers of a task.
struct Work {
    bins: Bins,
    slabs: Slabs,
    left: Vec<Reference>,
    right: Vec<Reference>,
}

impl Work {
    fn new() -> Work {
        Work { bins: Bins::new(), slabs: Slabs::new(), left: Vec::new(), right: Vec::new() }
    }

    /// Makes room for the sides of a split of `n` references: neither gets more. `None`: there is not enough memory.
    fn make_room(&mut self, n: usize) -> Option<()> {
        for side in [&mut self.left, &mut self.right] {
            side.clear();
            side.try_reserve(n).ok()?;
        }
        Some(())
    }

    /// Adds each reference to its side of a split between triangles; both sides have room for all of them.
    fn divide(&mut self, refs: &[Reference], side: &Side) {
        let [left, right] = [&mut self.left, &mut self.right].map(|s| &mut s.spare_capacity_mut()[..refs.len()]);
        // Without branches on the side: every reference is written to both, and the wrong copy is overwritten by the next.
        // (With what slabs do by batches: 4 to 6 % of the build.)
        let (mut l, mut r) = (0, 0);
        for reference in refs {
            left[l].write(*reference);
            right[r].write(*reference);
            let is_left = side.is_left(reference);
            l += usize::from(is_left);
            r += usize::from(!is_left);
        }
        // SAFETY: so many have been written beyond the lengths, within the capacities.
        unsafe {
            self.left.set_len(self.left.len() + l);
            self.right.set_len(self.right.len() + r);
        }
    }
}

/// A subtree: indices in it count from its own first node and triangle.
#[derive(Default)]
struct Flat {
    nodes: Vec<BinaryNode>,
    triangles: Vec<u32>,
}

impl Flat {
    /// Adds a leaf. `None`: there is not enough memory.
    fn leaf(&mut self, refs: &[Reference], bounds: &Box4) -> Option<()> {
        self.triangles.try_reserve(refs.len()).ok()?;
        self.node(bounds, self.triangles.len(), refs.len())?;
        self.triangles.extend(refs.iter().map(Reference::id));
        Some(())
    }

    /// Adds a node. `None`: there is not enough memory.
    fn node(&mut self, bounds: &Box4, index: usize, count: usize) -> Option<()> {
        let (lower, upper) = bounds.corners();
        self.nodes.try_reserve(1).ok()?;
        self.nodes.push(BinaryNode { lower, upper, index: index as u32, count: count as u32 });
        Some(())
    }
}

/// A tree of subtrees, as built by the tasks.
enum Piece {
    Flat(Flat),
    Inner(Box4, Box<[Piece; 2]>),
}

impl Piece {
    fn size(&self) -> (usize, usize) {
        match self {
            Piece::Flat(f) => (f.nodes.len(), f.triangles.len()),
            Piece::Inner(_, children) => {
                let [a, b] = [children[0].size(), children[1].size()];
                (a.0 + b.0 + 1, a.1 + b.1)
            }
        }
    }

    /// Writes the subtree to slots of its own, which are in number as many as its [`size`](Self::size) says and the
    /// first of which have these numbers.
    fn write(self, nodes: &mut [BinaryNode], triangles: &mut [u32], first_node: u32, first_triangle: u32) {
        match self {
            Piece::Flat(f) => {
                for (to, n) in nodes.iter_mut().zip(&f.nodes) {
                    *to = BinaryNode { index: n.index + if n.count > 0 { first_triangle } else { first_node }, ..*n };
                }
                triangles.copy_from_slice(&f.triangles);
            }
            Piece::Inner(bounds, children) => {
                let [left, right] = *children;
                let (n, t) = left.size();
                let (lower, upper) = bounds.corners();
                let right_node = first_node + 1 + n as u32;
                let (node, below) = nodes.split_first_mut().expect("a subtree has a node");
                *node = BinaryNode { lower, upper, index: right_node, count: 0 };
                let ((nodes, right_nodes), (triangles, right_triangles)) =
                    (below.split_at_mut(n), triangles.split_at_mut(t));
                rayon::join(
                    || left.write(nodes, triangles, first_node + 1, first_triangle),
                    || right.write(right_nodes, right_triangles, right_node, first_triangle + t as u32),
                );
            }
        }
    }
}

/// The corners of each triangle.
type Corners<'a> = dyn Fn(u32) -> [Vec3; 3] + Sync + 'a;

struct Builder<'a, 'p> {
    /// (Not generic: with that the library had 90 kB more code.)
    corners: &'a Corners<'a>,
    options: &'a BuildOptions,
    progress: &'a Progress<'p>,
    /// Half the root's area in f64, times α.
    least_overlap: f64,
    /// Set when an allocation has failed: the result is then discarded.
    out_of_memory: AtomicBool,
}

/// The two sides of a split, whose references are in [`Work`].
struct Sides {
    extents: [Extent; 2],
    /// Number of references that may be added in each side.
    extra: [usize; 2],
}

impl Builder<'_, '_> {
    /// Builds over `refs`, adding at most `extra` to them.
    fn build(&self, refs: Vec<Reference>, extent: Extent, extra: usize, depth: usize) -> Piece {
        if self.progress.is_cancelled() {
            return Piece::Flat(Flat::default());
        }
        if refs.len() <= PARALLEL_SUBTREE {
            return Piece::Flat(self.build_small(refs, extent, extra, depth));
        }
        let Some((sides, left, right)) = self.part(refs, &extent, extra, depth) else {
            self.out_of_memory.store(true, Relaxed);
            return Piece::Flat(Flat::default());
        };
        let (a, b) = rayon::join(
            || self.build(left, sides.extents[0], sides.extra[0], depth + 1),
            || self.build(right, sides.extents[1], sides.extra[1], depth + 1),
        );
        Piece::Inner(extent.boxes, Box::new([a, b]))
    }

    /// Splits more references than a leaf can hold; `None` if there is not enough memory for both sides. The working
    /// buffers are freed before the sides are built, so that no level of the recursion holds them.
    #[inline(never)]
    fn part(
        &self,
        mut refs: Vec<Reference>,
        extent: &Extent,
        extra: usize,
        depth: usize,
    ) -> Option<(Sides, Vec<Reference>, Vec<Reference>)> {
        let mut work = Work::new();
        work.make_room(refs.len())?;
        let sides = self.split(&mut refs, extent, extra, depth, &mut work).expect("too many for a leaf");
        // Unused capacity is freed.
        work.left.shrink_to_fit();
        work.right.shrink_to_fit();
        Some((sides, work.left, work.right))
    }

    /// Builds a subtree on the calling thread alone.
    #[inline(never)]
    fn build_small(&self, mut refs: Vec<Reference>, extent: Extent, extra: usize, depth: usize) -> Flat {
        let (mut work, mut flat) = (Work::new(), Flat::default());
        let n = refs.len();
        if self.build_flat(&mut refs, n, extent, extra, depth, &mut work, &mut flat).is_none() {
            self.out_of_memory.store(true, Relaxed);
        }
        flat
    }

    /// Builds over the last `n` references of `stack` and removes them. `None`: there is not enough memory.
    fn build_flat(
        &self,
        stack: &mut Vec<Reference>,
        n: usize,
        extent: Extent,
        extra: usize,
        depth: usize,
        work: &mut Work,
        out: &mut Flat,
    ) -> Option<()> {
        let start = stack.len() - n;
        work.make_room(n)?;
        let Some(sides) = self.split(&mut stack[start..], &extent, extra, depth, work) else {
            out.leaf(&stack[start..], &extent.boxes)?;
            stack.truncate(start);
            return Some(());
        };
        stack.truncate(start);
        stack.try_reserve(work.left.len() + work.right.len()).ok()?;
        // The left side goes on top, because it is built first.
        stack.extend_from_slice(&work.right);
        stack.extend_from_slice(&work.left);
        let (nl, nr) = (work.left.len(), work.right.len());
        let i = out.nodes.len();
        out.node(&extent.boxes, 0, 0)?;
        self.build_flat(stack, nl, sides.extents[0], sides.extra[0], depth + 1, work, out)?;
        out.nodes[i].index = out.nodes.len() as u32;
        self.build_flat(stack, nr, sides.extents[1], sides.extra[1], depth + 1, work, out)
    }

    /// Writes the two sides of the best split to `work`, which [has room](Work::make_room) for them; `None`: the node
    /// must become a leaf.
    fn split(
        &self,
        refs: &mut [Reference],
        extent: &Extent,
        extra: usize,
        depth: usize,
        work: &mut Work,
    ) -> Option<Sides> {
        let n = refs.len();
        if n == 1 {
            return None;
        }
        let may_be_leaf = n <= self.options.max_leaf as usize;
        work.left.clear();
        work.right.clear();
        if depth >= FREE_DEPTH {
            return (!may_be_leaf).then(|| self.halve(refs, extent, extra, work));
        }
        let scale = area_scale(&extent.boxes);
        // Splits between triangles.
        let few = (n <= 4).then(|| {
            let (cost, parting) = best_parting(refs, scale);
            (cost, part_few(refs, parting))
        });
        let map = BinMap::new(&extent.centres, bin_count(self.options.bins as usize, n));
        let object = if few.is_some() {
            None
        } else {
            work.bins.fill(refs, &map);
            work.bins.best_split(&map, scale).map(|split| (work.bins.sides(&map, &split), split))
        };
        let (mut cost, overlap) = match (&few, &object) {
            (Some((cost, middle)), _) => {
                let [a, b] = [&refs[..*middle], &refs[*middle..]]
                    .map(|refs| refs.iter().fold(Box4::EMPTY, |b, r| b.join(r.bounds())));
                (*cost, a.meet(b).half_area())
            }
            (_, Some(((_, [a, b]), split))) => (split.cost, a.meet(*b).half_area()),
            _ => (f32::INFINITY, f64::INFINITY),
        };
        // Splits by a plane.
        let mut plane = None;
        if extra > 0 && overlap > self.least_overlap.max(OVERLAP * extent.boxes.half_area()) {
            let grid = Grid::new(&extent.boxes, n);
            work.slabs.fill(refs, &self.corners, &grid);
            plane = work.slabs.best_plane(&grid, scale, n, extra).filter(|p| p.cost < cost);
            cost = plane.as_ref().map_or(cost, |p| p.cost);
        }
        if may_be_leaf && leaf_cost(&extent.boxes, scale, n) <= cost {
            return None;
        }
        if let Some(plane) = plane
            && self.cut_all(refs, &plane, scale, extra, work)
        {
            return Some(self.sides(n, extra, work));
        }
        if let Some((_, middle)) = few {
            let (left, right) = refs.split_at(middle);
            work.left.extend_from_slice(left);
            work.right.extend_from_slice(right);
            return Some(self.sides(n, extra, work));
        }
        match object {
            Some((_, split)) => {
                work.divide(refs, &map.side(&split));
                Some(self.sides(n, extra, work))
            }
            None => (!may_be_leaf).then(|| self.halve(refs, extent, extra, work)),
        }
    }

    /// Halves references along the widest axis of the centres.
    fn halve(&self, refs: &mut [Reference], extent: &Extent, extra: usize, work: &mut Work) -> Sides {
        let n = refs.len();
        let middle = halve(refs, extent);
        let (left, right) = refs.split_at(middle);
        work.left.extend_from_slice(left);
        work.right.extend_from_slice(right);
        self.sides(n, extra, work)
    }

    /// Cuts the references that a plane crosses, unless one is better left whole on one side (the paper's reference
    /// unsplitting, with the sizes that were estimated for the sides, so that the order of references does not matter).
    /// Returns whether both sides have references.
    fn cut_all(&self, refs: &[Reference], plane: &Plane, scale: f32, extra: usize, work: &mut Work) -> bool {
        let area = |b: Box4| half_areas([b.extent() * scale; 4]).x;
        let [left, right] = plane.boxes;
        let [nl, nr] = plane.counts.map(|n| n as f32);
        let (al, ar) = (area(left), area(right));
        let mut added = 0;
        for r in refs {
            let (lower, upper) = r.bounds().corners();
            if upper[plane.axis] <= plane.position {
                work.left.push(*r);
                continue;
            }
            if lower[plane.axis] >= plane.position {
                work.right.push(*r);
                continue;
            }
            let [below, above] = cut(&(self.corners)(r.id()), r.bounds(), plane.axis, plane.position);
            match (below.is_empty(), above.is_empty()) {
                (false, true) => work.left.push(Reference::of_box(r.id(), below)),
                (true, false) => work.right.push(Reference::of_box(r.id(), above)),
                (empty, _) => {
                    let both = al * nl + ar * nr;
                    let whole_left = area(left.join(r.bounds())) * nl + ar * (nr - 1.0);
                    let whole_right = al * (nl - 1.0) + area(right.join(r.bounds())) * nr;
                    if !empty && added < extra && both <= whole_left.min(whole_right) {
                        added += 1;
                        work.left.push(Reference::of_box(r.id(), below));
                        work.right.push(Reference::of_box(r.id(), above));
                    } else if whole_left <= whole_right {
                        work.left.push(*r);
                    } else {
                        work.right.push(*r);
                    }
                }
            }
        }
        let ok = !work.left.is_empty() && !work.right.is_empty();
        if !ok {
            work.left.clear();
            work.right.clear();
        }
        ok
    }

    /// The extents of both sides, and their shares of the references that may still be added: by their areas times
    /// references, which is where more cuts can save most.
    fn sides(&self, n: usize, extra: usize, work: &Work) -> Sides {
        let extents = [Extent::of(&work.left), Extent::of(&work.right)];
        let remaining = extra - (work.left.len() + work.right.len() - n);
        let [a, b] = [(&work.left, &extents[0]), (&work.right, &extents[1])]
            .map(|(refs, e)| share_weight(refs.len(), e.boxes.half_area()));
        let share = if a + b > 0.0 { ((a / (a + b) * remaining as f64) as usize).min(remaining) } else { 0 };
        Sides { extents, extra: [share, remaining - share] }
    }
}

fn share_weight(n: usize, area: f64) -> f64 {
    n as f64 * area
}

impl BinaryBvh {
    /// Builds the tree over the triangles `valid` with the `corners` and with spatial splits, which add at most
    /// `options.split_budget` times as many references. Runs on the current rayon pool.
    pub fn build_spatial(
        corners: &(impl Fn(u32) -> [Vec3; 3] + Sync),
        valid: &[u32],
        options: &BuildOptions,
        progress: &Progress,
    ) -> Result<BinaryBvh> {
        BinaryBvh::spatial_of(References::of(valid, corners)?, corners, options, progress)
    }

    /// Builds the tree over at least one reference.
    pub(super) fn spatial_of(
        references: References,
        corners: &Corners,
        options: &BuildOptions,
        progress: &Progress,
    ) -> Result<BinaryBvh> {
        let References { refs, extent, .. } = references;
        let n = refs.len();
        let extra = ((n as f64 * f64::from(options.split_budget)) as usize).min(MAX_SLOTS - n.min(MAX_SLOTS));
        let least_overlap = extent.boxes.half_area() * f64::from(ALPHA);
        let builder = Builder { corners, options, progress, least_overlap, out_of_memory: AtomicBool::new(false) };
        let piece = builder.build(refs.into(), extent, extra, 0);
        progress.check()?;
        if builder.out_of_memory.into_inner() {
            return Err(Error::OutOfMemory(format!("the tree over {n} triangles with spatial splits")));
        }
        let (node_count, triangle_count) = piece.size();
        let mut nodes = try_zeroed::<BinaryNode>(node_count, "the binary tree")?;
        let mut triangles = try_zeroed::<u32>(triangle_count, "the binary tree")?;
        piece.write(&mut nodes, &mut triangles, 0, 0);
        Ok(BinaryBvh { nodes: nodes.into(), triangles: triangles.into() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::sampling::uniform;
    use crate::bvh::BuildQuality;
    use crate::bvh::binned::tests::assert_no_matter_how_many_threads;
    use crate::bvh::layout::MAX_DEPTH;
    use glam::DVec3;

    type Triangles = Vec<[Vec3; 3]>;

    fn point(i: usize, k: u32, seed: u32) -> Vec3 {
        Vec3::new(uniform(i as u32, k, seed), uniform(i as u32, k + 1, seed), uniform(i as u32, k + 2, seed))
    }

    /// Long thin triangles in all directions among small ones: what spatial splits are for.
    fn needles(n: usize) -> Triangles {
        (0..n)
            .map(|i| {
                let (a, b) = (point(i, 0, 3), point(i, 3, 3));
                let size = if i % 3 == 0 { 1.0 } else { 0.02 };
                [a, a + size * (b - a), a + size * (b - a) + 0.01 * point(i, 6, 3)]
            })
            .collect()
    }

    fn options(split_budget: f32) -> BuildOptions {
        BuildOptions { quality: BuildQuality::High, split_budget, ..Default::default() }
    }

    fn build(corners: &Triangles, options: &BuildOptions) -> BinaryBvh {
        let ids: Vec<u32> = (0..corners.len() as u32).collect();
        BinaryBvh::build_spatial(&|t| corners[t as usize], &ids, options, &Progress::none()).unwrap()
    }

    /// Checks nesting, leaf sizes, and slots that are used once; gives the boxes of the leaves that
    /// name each triangle, and the depth.
    fn leaves(bvh: &BinaryBvh, triangles: usize, max_leaf: u32) -> (Vec<Vec<(Vec3, Vec3)>>, usize) {
        let mut boxes = vec![Vec::new(); triangles];
        let (mut slots, mut nodes, mut deepest) = (0, 0, 0);
        let mut stack = vec![(0u32, 0usize, Vec3::NEG_INFINITY, Vec3::INFINITY)];
        while let Some((i, depth, lo, hi)) = stack.pop() {
            let node = bvh.nodes[i as usize];
            nodes += 1;
            deepest = deepest.max(depth);
            assert!(node.lower.cmpge(lo).all() && node.upper.cmple(hi).all());
            if node.count == 0 {
                stack.push((i + 1, depth + 1, node.lower, node.upper));
                stack.push((node.index, depth + 1, node.lower, node.upper));
                continue;
            }
            assert!(node.count <= max_leaf);
            let named = &bvh.triangles[node.index as usize..][..node.count as usize];
            slots += named.len();
            for (k, &t) in named.iter().enumerate() {
                assert!(!named[..k].contains(&t), "twice in a leaf");
                boxes[t as usize].push((node.lower, node.upper));
            }
        }
        assert_eq!((slots, nodes), (bvh.triangles.len(), bvh.nodes.len()));
        (boxes, deepest)
    }

    /// Points of each triangle, moved by as much as rounding can move its corners, lie in leaves.
    fn covers(bvh: &BinaryBvh, corners: &Triangles, max_leaf: u32) {
        let (boxes, depth) = leaves(bvh, corners.len(), max_leaf);
        assert!(depth <= MAX_DEPTH);
        for (t, (tri, boxes)) in corners.iter().zip(&boxes).enumerate() {
            let v = tri.map(|c| c.as_dvec3());
            let (lower, upper) = (v[0].min(v[1]).min(v[2]), v[0].max(v[1]).max(v[2]));
            let rounding = (upper - lower).max_element() / (1 << 24) as f64;
            let inside =
                |p: DVec3| boxes.iter().any(|b| p.cmpge(b.0.as_dvec3()).all() && p.cmple(b.1.as_dvec3()).all());
            for s in 0..64u32 {
                let [a, b] = [0, 1].map(|k| f64::from(uniform(s, k, t as u32)));
                // On edges and at corners too.
                let (a, b) = match s % 8 {
                    0 => (a, 0.0),
                    1 => (0.0, b),
                    2 => (a, 1.0 - a),
                    3 => ([0.0, 1.0, 0.0][s as usize % 3], [0.0, 0.0, 1.0][s as usize % 3]),
                    _ if a + b > 1.0 => (1.0 - a, 1.0 - b),
                    _ => (a, b),
                };
                let p = v[0] + a * (v[1] - v[0]) + b * (v[2] - v[0]);
                for axis in 0..3 {
                    for sign in [-1.0, 0.0, 1.0] {
                        let moved = p + sign * rounding * DVec3::AXES[axis];
                        assert!(inside(moved.clamp(lower, upper)), "triangle {t}, sample {s}: {moved}");
                    }
                }
            }
        }
    }

    #[test]
    fn every_point_of_a_triangle_lies_in_a_leaf_that_names_it() {
        for (scale, offset) in [
            (1.0, Vec3::ZERO),
            (1e-18, Vec3::ZERO),
            (1e12, Vec3::ZERO),
            (1.0, Vec3::new(148376.0, 1234.0, -223423.0)),
            (1e3, Vec3::new(1e9, 1e9, -1e9)),
        ] {
            let corners: Triangles = needles(1500).into_iter().map(|t| t.map(|c| (c - 0.5) * scale + offset)).collect();
            let bvh = build(&corners, &options(1.0));
            assert!(offset.x > 1e6 || bvh.triangles.len() > corners.len() + 200, "no splits at {scale}, {offset}");
            covers(&bvh, &corners, BuildOptions::default().max_leaf);
        }
    }

    #[test]
    fn hard_triangles_are_covered_too() {
        // Axis-parallel grids, a fan of slivers, one huge triangle over all, two scales far apart.
        let mut corners = Triangles::new();
        for i in 0..20 {
            for j in 0..20 {
                let p = Vec3::new(i as f32, j as f32, (i * j % 3) as f32);
                corners.push([p, p + Vec3::X, p + Vec3::Y]);
                corners.push([p, p + 7.0 * Vec3::Z, p + 9.0 * Vec3::Y]);
            }
        }
        corners.push([Vec3::new(-300.0, -300.0, 0.5), Vec3::new(300.0, -300.0, 0.7), Vec3::new(0.0, 400.0, 0.9)]);
        for i in 0..200 {
            let a = i as f32 * 0.01;
            let p = |a: f32| Vec3::new(30.0 * a.cos(), 30.0 * a.sin(), a);
            corners.push([Vec3::ZERO, p(a), p(a + 1e-5)]);
            corners.push([1e-6 * p(a), 1e-6 * p(a + 0.01), 1e-6 * p(a + 2.0)]);
        }
        for max_leaf in [1, 8] {
            let o = BuildOptions { max_leaf, ..options(2.0) };
            let bvh = build(&corners, &o);
            assert!(bvh.triangles.len() > corners.len());
            covers(&bvh, &corners, max_leaf);
        }
    }

    #[test]
    fn the_budget_holds_and_the_cost_falls() {
        let corners = needles(20_000);
        let costs: Vec<f32> = [0.0, 0.1, 0.5, 2.0]
            .into_iter()
            .map(|budget| {
                let bvh = build(&corners, &options(budget));
                assert!(bvh.triangles.len() as f32 <= corners.len() as f32 * (1.0 + budget));
                bvh.sah_cost()
            })
            .collect();
        assert!(costs.windows(2).all(|c| c[1] < c[0]), "{costs:?}");
        assert!(costs[2] < 0.9 * costs[0], "{costs:?}");
    }

    #[test]
    fn the_tree_does_not_depend_on_the_number_of_threads() {
        let corners = needles(60_000);
        assert_no_matter_how_many_threads(|| build(&corners, &options(0.5)));
    }

    #[test]
    fn equal_triangles_and_chains_stay_shallow() {
        let equal: Triangles = vec![[Vec3::ZERO, Vec3::X, Vec3::Y]; 3000];
        let chain: Triangles = (0..120)
            .map(|i| {
                let s = 2f32.powi(i - 90);
                [Vec3::new(s, 0.0, 0.0), Vec3::new(s, s, 0.0), Vec3::new(s, 0.0, s)]
            })
            .collect();
        for corners in [equal, chain] {
            let o = BuildOptions { bins: 2, max_leaf: 1, ..options(1.0) };
            covers(&build(&corners, &o), &corners, 1);
        }
    }
}
