//! Collapse of the binary tree to wide nodes (Dammertz, Hanika and Keller, *Shallow Bounding
//! Volume Hierarchies for Fast SIMD Ray Tracing of Incoherent Rays*, 2008): the child of largest
//! area is opened first. (The best choice, by dynamic programming as in Ylitie, Karras and Laine 2017, makes
//! rays visit 1 to 3 % fewer nodes and takes a sixth of the whole build's time.)
//!
//! Children come in the order in which rays to any hit should visit them, from last to first: the one with the largest
//! area for its triangles is visited first, since it ends most rays for its cost. (Embree sorts by numbers of
//! primitives. Visited by distance, as for closest hits, occlusion took 1.3 to 2 times as long:
//! docs/experiments.md#order-of-children.)

use super::binary::{BinaryBvh, BinaryNode};
use super::compact::{self, Compact, CompactNode};
use super::layout::{ChildRef, LEAF_PAD, LEAF_STRIDE, Mbvh, Node, WIDTH};
use super::references::Box4;
use crate::base::error::Result;
use crate::base::memory::{try_append, try_par_collect, try_push, try_with_capacity, try_zeroed};
use crate::base::parallel::ParallelLoop;
use crate::base::progress::Progress;
use glam::Vec3;
use rayon::prelude::*;

/// Fraction of their coordinates by which boxes grow, to cover the rounding of planes in the box test of the kernels.
const OUTWARDS: f32 = 2.0 * f32::EPSILON;

/// Box of a child: the box around its triangles, moved outwards.
#[inline(always)]
pub(crate) fn outwards(lower: Vec3, upper: Vec3) -> (Vec3, Vec3) {
    (lower - OUTWARDS * lower.abs(), upper + OUTWARDS * upper.abs())
}

/// Sets the box of child `i`, moved outwards; an empty one is hit by no ray.
pub(super) fn set_box<const W: usize>(node: &mut Node<W>, i: usize, b: &Box4) {
    // Infinities would give NaN.
    if b.is_empty() {
        for axis in 0..3 {
            (node.lower[axis][i], node.upper[axis][i]) = (f32::INFINITY, f32::NEG_INFINITY);
        }
        return;
    }
    let (lower, upper) = b.corners();
    let (lower, upper) = outwards(lower, upper);
    for axis in 0..3 {
        (node.lower[axis][i], node.upper[axis][i]) = (lower[axis], upper[axis]);
    }
}

/// The binary nodes that become the children of a wide node.
#[derive(Clone, Copy)]
struct Plan<const W: usize> {
    children: [u32; W],
    count: u32,
    /// Index of the node of the first inner child, and slot of the first triangle of the first leaf; those of the
    /// others follow.
    first_node: u32,
    first_slot: u32,
}

/// Computes the plans of all nodes, and the indices of these plans in the order of their leaves.
///
/// Nodes are in depth-first order: the inner children of a node follow each other, then come the nodes below the first
/// of them, those below the second, and so on; leaves likewise (`refit` relies on it).
fn plans<const W: usize>(binary: &BinaryBvh, progress: &Progress) -> Result<(Vec<Plan<W>>, Vec<u32>)> {
    let n = binary.triangles.len();
    let idle = Plan { children: [0; W], count: 0, first_node: 0, first_slot: 0 };
    let mut plans = try_with_capacity(n / 6 + 1, PLANS)?;
    plans.push(idle);
    let mut order = try_with_capacity(n / 6 + 1, PLANS)?;
    let mut slot = 0;
    let mut work = vec![(0usize, Subtree::new(binary, 0, 0, n as u32))];
    while let Some((target, source)) = work.pop() {
        let (subtrees, count) = open::<W>(binary, source);
        let children = subtrees.map(|s| s.node);
        let first = plans.len();
        plans[target] = Plan { children, count: count as u32, first_node: first as u32, first_slot: slot };
        try_push(&mut order, target as u32, PLANS)?;
        if order.len() % NODES_PER_JOB == 0 {
            progress.check()?;
        }
        for &child in &subtrees[..count] {
            match binary.nodes[child.node as usize].count {
                0 => {
                    work.push((plans.len(), child));
                    try_push(&mut plans, idle, PLANS)?;
                }
                triangles => slot += triangles,
            }
        }
        // The first child's subtree is next.
        let end = work.len();
        work[end - (plans.len() - first)..].reverse();
    }
    Ok((plans, order))
}

const PLANS: &str = "the plan of the tree";

/// Collapses a binary tree to one of compact nodes and leaves; `meshes` as in [`Compact::new`].
pub(super) fn collapse_compact(binary: &BinaryBvh, meshes: &[u32], progress: &Progress) -> Result<Compact> {
    let root = &binary.nodes[0];
    let (plans, order) = plans::<WIDTH>(binary, progress)?;
    let compact = |plan: &Plan<WIDTH>| CompactNode::new(&node(binary, plan), plan.first_node, plan.first_slot);
    let nodes = try_par_collect(plans.par_iter().with_min_len(1024).map(compact), "the tree")?;
    let mut triangles = try_with_capacity(binary.triangles.len() + compact::PAD, "the tree")?;
    for &i in &order {
        for b in plans[i as usize].leaves(binary) {
            try_append(&mut triangles, &binary.triangles[b.index as usize..][..b.count as usize], "the tree")?;
            *triangles.last_mut().expect("a leaf has triangles") |= compact::LAST;
        }
    }
    try_append(&mut triangles, &[compact::LAST | compact::GONE; compact::PAD], "the tree")?;
    Compact::new(nodes.into(), triangles.into(), (root.lower, root.upper), meshes)
}

/// Collapses a binary tree to one of `W` children per node.
pub(super) fn collapse<const W: usize>(
    binary: &BinaryBvh,
    corners: &(impl Fn(u32) -> [Vec3; 3] + Sync),
    progress: &Progress,
) -> Result<Mbvh<W>> {
    let n = binary.triangles.len();
    let root = &binary.nodes[0];
    // Choosing the binary nodes that become children is quick; filling in nodes and leaves takes the time.
    let (plans, order) = plans(binary, progress)?;
    let nodes = try_par_collect(plans.par_iter().with_min_len(1024).map(|plan| node(binary, plan)), "the tree")?;
    progress.check()?;
    let mut leaves = try_zeroed(n * LEAF_STRIDE + LEAF_PAD, "the leaves of the tree")?;
    let mut rest = &mut leaves[..n * LEAF_STRIDE];
    let mut jobs = Vec::with_capacity(order.len() / NODES_PER_JOB + 1);
    for (i, part) in order.chunks(NODES_PER_JOB).enumerate() {
        let end = order.get((i + 1) * NODES_PER_JOB).map_or(n, |&next| plans[next as usize].first_slot as usize);
        let triangles = end - plans[part[0] as usize].first_slot as usize;
        let (rows, others) = std::mem::take(&mut rest).split_at_mut(triangles * LEAF_STRIDE);
        jobs.push((part, rows));
        rest = others;
    }
    jobs.into_par_iter().try_each(|(part, mut rows): (&[u32], &mut [f32])| {
        progress.check()?;
        for &i in part {
            for b in plans[i as usize].leaves(binary) {
                let (leaf, others) = rows.split_at_mut(b.count as usize * LEAF_STRIDE);
                fill_leaf(leaf, &binary.triangles[b.index as usize..][..b.count as usize], corners);
                rows = others;
            }
        }
        Ok(())
    })?;
    Ok(Mbvh { nodes: nodes.into(), leaves: leaves.into(), bounds: (root.lower, root.upper) })
}

/// Number of nodes whose leaves a thread fills at a time.
const NODES_PER_JOB: usize = 1024;

impl<const W: usize> Plan<W> {
    fn leaves<'a>(&'a self, binary: &'a BinaryBvh) -> impl Iterator<Item = &'a BinaryNode> {
        self.children[..self.count as usize].iter().map(|&c| &binary.nodes[c as usize]).filter(|b| b.count > 0)
    }
}

fn node<const W: usize>(binary: &BinaryBvh, plan: &Plan<W>) -> Node<W> {
    let mut node = Node::EMPTY;
    let (mut next_node, mut next_slot) = (plan.first_node as usize, plan.first_slot as usize);
    for (i, &child) in plan.children[..plan.count as usize].iter().enumerate() {
        let b = &binary.nodes[child as usize];
        set_box(&mut node, i, &Box4::new(b.lower, b.upper));
        if b.count > 0 {
            node.children[i] = ChildRef::leaf(next_slot, b.count as usize);
            next_slot += b.count as usize;
        } else {
            node.children[i] = ChildRef::node(next_node);
            next_node += 1;
        }
    }
    node.sort_children();
    node
}

/// A node of the binary tree with all below it.
#[derive(Clone, Copy)]
struct Subtree {
    node: u32,
    /// Range of its triangles, which follow one another as its leaves do.
    first: u32,
    end: u32,
    /// Half its surface area.
    area: f64,
}

impl Subtree {
    fn new(binary: &BinaryBvh, node: u32, first: u32, end: u32) -> Subtree {
        Subtree { node, first, end, area: binary.half_area(node) }
    }

    /// Probability of a hit for the cost of finding it.
    fn worth(&self) -> f64 {
        self.area / f64::from(self.end - self.first)
    }
}

/// Finds up to `W` descendants of `source` that cover it; returns them, in the order of a node's children, and their
/// number.
fn open<const W: usize>(binary: &BinaryBvh, source: Subtree) -> ([Subtree; W], usize) {
    let mut children = [source; W];
    let mut count = 1;
    while count < W {
        // A leaf is never opened.
        let is_inner = |&i: &usize| binary.nodes[children[i].node as usize].count == 0;
        let by_area = |&a: &usize, &b: &usize| children[a].area.total_cmp(&children[b].area);
        let Some(largest) = (0..count).rev().filter(is_inner).max_by(by_area) else { break };
        let Subtree { node, first, end, .. } = children[largest];
        let right = binary.nodes[node as usize].index;
        // The first leaf below the right child.
        let leaf = binary.nodes[right as usize..].iter().find(|b| b.count > 0);
        let middle = leaf.map_or(end, |b| b.index);
        children[largest] = Subtree::new(binary, node + 1, first, middle);
        children[count] = Subtree::new(binary, right, middle, end);
        count += 1;
    }
    children[..count].sort_by(|a, b| a.worth().total_cmp(&b.worth()));
    (children, count)
}

fn fill_leaf(leaf: &mut [f32], triangles: &[u32], corners: &impl Fn(u32) -> [Vec3; 3]) {
    let count = triangles.len();
    for (i, &t) in triangles.iter().enumerate() {
        for (corner, v) in corners(t).iter().enumerate() {
            for axis in 0..3 {
                leaf[(3 * corner + axis) * count + i] = v[axis];
            }
        }
        leaf[9 * count + i] = f32::from_bits(t);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::progress::Progress;
    use crate::base::sampling::uniform;
    use crate::bvh::BuildOptions;

    #[test]
    fn every_triangle_is_in_one_leaf_with_its_corners_and_number() {
        for (n, max_leaf) in [(1usize, 3), (2, 1), (5, 8), (3000, 3)] {
            let corners: Vec<[Vec3; 3]> = (0..n as u32)
                .map(|i| [0, 3, 6].map(|k| Vec3::new(uniform(i, k, 1), uniform(i, k + 1, 1), uniform(i, k + 2, 1))))
                .collect();
            let ids: Vec<u32> = (0..n as u32).collect();
            let options = BuildOptions { max_leaf, ..Default::default() };
            let of = |t: u32| corners[t as usize];
            for binary in [
                BinaryBvh::build(&of, &ids, &options, &Progress::none()).unwrap(),
                BinaryBvh::build_spatial(&of, &ids, &options, &Progress::none()).unwrap(),
            ] {
                let tree: Mbvh = collapse(&binary, &of, &Progress::none()).unwrap();
                let mut seen = vec![0; n];
                for node in &tree.nodes {
                    for (i, child) in node.children.iter().enumerate() {
                        if *child == ChildRef::EMPTY || !child.is_leaf() {
                            continue;
                        }
                        let c = child.leaf_count();
                        let rows = &tree.leaves[child.leaf_slot() * LEAF_STRIDE..][..LEAF_STRIDE * c];
                        for k in 0..c {
                            let id = rows[9 * c + k].to_bits() as usize;
                            seen[id] += 1;
                            for row in 0..9 {
                                let x = rows[row * c + k];
                                assert_eq!(x, corners[id][row / 3][row % 3]);
                                // A cut triangle is larger than its box.
                                assert!(
                                    binary.triangles.len() > n
                                        || node.lower[row % 3][i] <= x && x <= node.upper[row % 3][i]
                                );
                            }
                        }
                    }
                }
                assert!(seen.iter().all(|&s| s > 0) && seen.iter().sum::<usize>() == binary.triangles.len());
            }
        }
    }
}
