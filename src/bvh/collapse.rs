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
use crate::base::error::{Error, Result};
use crate::base::memory::{try_append, try_par_collect, try_par_collect_ok, try_push, try_with_capacity, try_zeroed};
use crate::base::parallel::ParallelLoop;
use crate::base::progress::Progress;
use crate::simd::prefetch;
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
pub(super) struct Plan<const W: usize> {
    children: [u32; W],
    count: u32,
    /// Index of the node of the first inner child, and slot of the first triangle of the first leaf; those of the
    /// others follow.
    pub(super) first_node: u32,
    pub(super) first_slot: u32,
}

/// The plans of the nodes of a subtree, its root's first, and the indices of these plans in the order of their leaves.
///
/// Nodes are in depth-first order: the inner children of a node follow each other, then come the nodes below the first
/// of them, those below the second, and so on; leaves likewise (`refit` relies on it).
struct Plans<const W: usize> {
    plans: Vec<Plan<W>>,
    order: Vec<u32>,
}

/// Subtrees of more triangles than this are planned by several threads.
const PARALLEL_PLANS: usize = 1 << 15;

/// Computes the plans of a subtree, of large ones in parallel: one after the other they were a tenth of the time that two
/// threads take to build Sponza's tree.
fn plans<const W: usize>(binary: &BinaryBvh, source: Subtree, progress: &Progress) -> Result<Plans<W>> {
    if source.triangles() <= PARALLEL_PLANS || rayon::current_num_threads() == 1 {
        return plans_in_sequence(binary, source, progress);
    }
    let (subtrees, count) = open::<W>(binary, source);
    let is_leaf = |s: &Subtree| binary.nodes[s.node as usize].count > 0;
    let inner: Vec<Subtree> = subtrees[..count].iter().filter(|s| !is_leaf(s)).copied().collect();
    let below = inner.par_iter().map(|&s| plans::<W>(binary, s, progress));
    let below: Vec<Plans<W>> = try_par_collect_ok(below, PLANS)?;
    // The slots of its own leaves come first.
    let own: usize = subtrees[..count].iter().filter(|s| is_leaf(s)).map(Subtree::triangles).sum();
    let (mut node, mut slot) = (1 + inner.len() as u32, own as u32);
    let places: Vec<(u32, u32)> = inner
        .iter()
        .zip(&below)
        .map(|(subtree, plans)| {
            let place = (node, slot);
            node += plans.plans.len() as u32 - 1;
            slot += subtree.triangles() as u32;
            place
        })
        .collect();
    let moved = |plan: &Plan<W>, (node, slot): (u32, u32)| Plan {
        first_node: plan.first_node + node - 1,
        first_slot: plan.first_slot + slot,
        ..*plan
    };
    let mut all =
        Plans { plans: try_with_capacity(node as usize, PLANS)?, order: try_with_capacity(node as usize, PLANS)? };
    all.plans.push(Plan { children: subtrees.map(|s| s.node), count: count as u32, first_node: 1, first_slot: 0 });
    all.plans.extend(below.iter().zip(&places).map(|(plans, &place)| moved(&plans.plans[0], place)));
    all.order.push(0);
    for (root, (plans, &place)) in (1..).zip(below.iter().zip(&places)) {
        all.plans.extend(plans.plans[1..].iter().map(|plan| moved(plan, place)));
        all.order.extend(plans.order.iter().map(|&i| if i == 0 { root } else { place.0 + i - 1 }));
    }
    Ok(all)
}

/// Computes the plans of a subtree one after the other.
fn plans_in_sequence<const W: usize>(binary: &BinaryBvh, source: Subtree, progress: &Progress) -> Result<Plans<W>> {
    let n = source.triangles();
    let idle = Plan { children: [0; W], count: 0, first_node: 0, first_slot: 0 };
    let mut plans = try_with_capacity(n / 6 + 1, PLANS)?;
    let mut order = try_with_capacity(n / 6 + 1, PLANS)?;
    for_each_plan(binary, source, progress, |target, plan, count| {
        while plans.len() < count {
            try_push(&mut plans, idle, PLANS)?;
        }
        plans[target] = plan;
        try_push(&mut order, target as u32, PLANS)
    })?;
    Ok(Plans { plans, order })
}

/// Calls `visit` with each node of a subtree, in the order of their leaves: its index, its plan, and the number of nodes
/// whose index is known, its children's too. Returns the number of all.
pub(super) fn for_each_plan<const W: usize>(
    binary: &BinaryBvh,
    source: Subtree,
    progress: &Progress,
    mut visit: impl FnMut(usize, Plan<W>, usize) -> Result<()>,
) -> Result<usize> {
    let (mut nodes, mut slot, mut visited) = (1, 0, 0);
    let mut work = vec![(0usize, source)];
    while let Some((target, source)) = work.pop() {
        let (subtrees, count) = open::<W>(binary, source);
        let children = subtrees.map(|s| s.node);
        let first = nodes;
        let plan = Plan { children, count: count as u32, first_node: first as u32, first_slot: slot };
        visited += 1;
        if visited % NODES_PER_JOB == 0 {
            progress.check()?;
        }
        for &child in &subtrees[..count] {
            let node = &binary.nodes[child.node as usize];
            match node.count {
                0 => {
                    prefetch(&raw const binary.nodes[node.index as usize]);
                    work.push((nodes, child));
                    nodes += 1;
                }
                triangles => slot += triangles,
            }
        }
        // The first child's subtree is next.
        let end = work.len();
        work[end - (nodes - first)..].reverse();
        visit(target, plan, nodes)?;
    }
    Ok(nodes)
}

const PLANS: &str = "the plan of the tree";
pub(super) const LEAVES: &str = "the leaves of the tree";

/// Collapses a binary tree to one of compact nodes and leaves; `meshes` as in [`Compact::new`].
pub(super) fn collapse_compact(binary: &BinaryBvh, meshes: &[u32], progress: &Progress) -> Result<Compact> {
    let root = &binary.nodes[0];
    let Plans { plans, order } = plans::<WIDTH>(binary, Subtree::root(binary), progress)?;
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
    let Plans { plans, order } = plans(binary, Subtree::root(binary), progress)?;
    let plan_of = |i: usize| {
        plans.get(i + AHEAD).inspect(|plan| plan.prefetch(binary));
        node(binary, &plans[i])
    };
    let nodes = try_par_collect((0..plans.len()).into_par_iter().with_min_len(1024).map(plan_of), "the tree")?;
    progress.check()?;
    let mut leaves = try_zeroed(n * LEAF_STRIDE + LEAF_PAD, LEAVES)?;
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
        let mut block = LeafBlock::default();
        for (i, nodes) in part.chunks(NODES_PER_BLOCK).enumerate() {
            block.clear();
            for (k, &plan) in nodes.iter().enumerate() {
                let next = part.get(i * NODES_PER_BLOCK + k + AHEAD);
                next.inspect(|&&next| plans[next as usize].prefetch(binary));
                plans[plan as usize].leaves(binary).try_for_each(|leaf| block.add(leaf, binary))?;
            }
            let (of_block, others) = rows.split_at_mut(block.triangles.len() * LEAF_STRIDE);
            block.fill(of_block, corners)?;
            rows = others;
        }
        Ok(())
    })?;
    Ok(Mbvh { nodes: nodes.into(), leaves: leaves.into(), bounds: (root.lower, root.upper) })
}

/// Number of nodes whose leaves a thread fills at a time.
const NODES_PER_JOB: usize = 1024;

/// Number of nodes whose leaves are filled together: some 200 triangles.
pub(super) const NODES_PER_BLOCK: usize = 32;

/// Number of plans ahead of which binary nodes are asked for.
const AHEAD: usize = 4;

/// Leaves that are filled together. What is read for a triangle, its leaf, its number, its vertices' numbers and its
/// vertices, lies anywhere in memory, and each read needs the one before: with a loop for each kind the processor has
/// reads of many triangles under way. (With nodes asked for ahead: Sponza's whole build 2.5 → 3.3 million triangles per
/// second, San Miguel's alike.)
#[derive(Default)]
pub(super) struct LeafBlock {
    /// Number of triangles of each leaf.
    counts: Vec<u32>,
    pub(super) triangles: Vec<u32>,
    corners: Vec<[Vec3; 3]>,
}

impl LeafBlock {
    pub(super) fn clear(&mut self) {
        self.counts.clear();
        self.triangles.clear();
        self.corners.clear();
    }

    pub(super) fn add(&mut self, leaf: &BinaryNode, binary: &BinaryBvh) -> Result<()> {
        try_push(&mut self.counts, leaf.count, LEAVES)?;
        try_append(&mut self.triangles, &binary.triangles[leaf.index as usize..][..leaf.count as usize], LEAVES)
    }

    /// Fills in the leaves, which follow each other.
    pub(super) fn fill(&mut self, mut rows: &mut [f32], corners: &impl Fn(u32) -> [Vec3; 3]) -> Result<()> {
        let no_room = |e| Error::OutOfMemory(format!("{LEAVES}: {e}"));
        self.corners.try_reserve(self.triangles.len()).map_err(no_room)?;
        self.corners.extend(self.triangles.iter().map(|&t| corners(t)));
        let (mut triangles, mut corners) = (&self.triangles[..], &self.corners[..]);
        for count in self.counts.iter().map(|&n| n as usize) {
            let (leaf, others) = rows.split_at_mut(count * LEAF_STRIDE);
            fill_leaf(leaf, &triangles[..count], &corners[..count]);
            (rows, triangles, corners) = (others, &triangles[count..], &corners[count..]);
        }
        Ok(())
    }
}

impl<const W: usize> Plan<W> {
    fn prefetch(&self, binary: &BinaryBvh) {
        self.children[..self.count as usize].iter().for_each(|&c| prefetch(&raw const binary.nodes[c as usize]));
    }

    pub(super) fn leaves<'a>(&'a self, binary: &'a BinaryBvh) -> impl Iterator<Item = &'a BinaryNode> {
        self.children[..self.count as usize].iter().map(|&c| &binary.nodes[c as usize]).filter(|b| b.count > 0)
    }
}

pub(super) fn node<const W: usize>(binary: &BinaryBvh, plan: &Plan<W>) -> Node<W> {
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
pub(super) struct Subtree {
    node: u32,
    /// Range of its triangles, which follow one another as its leaves do.
    first: u32,
    end: u32,
    /// Half its surface area.
    area: f64,
}

impl Subtree {
    pub(super) fn root(binary: &BinaryBvh) -> Subtree {
        Subtree::new(binary, 0, 0, binary.triangles.len() as u32)
    }

    fn new(binary: &BinaryBvh, node: u32, first: u32, end: u32) -> Subtree {
        Subtree { node, first, end, area: binary.half_area(node) }
    }

    fn triangles(&self) -> usize {
        (self.end - self.first) as usize
    }

    /// Probability of a hit for the cost of finding it.
    fn worth(&self) -> f64 {
        self.area / self.triangles() as f64
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

fn fill_leaf(leaf: &mut [f32], triangles: &[u32], corners: &[[Vec3; 3]]) {
    let count = triangles.len();
    for (i, (&t, corners)) in triangles.iter().zip(corners).enumerate() {
        for (corner, v) in corners.iter().enumerate() {
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
    fn plans_are_the_same_on_any_number_of_threads() {
        let n = 3 * PARALLEL_PLANS as u32;
        // Half of them in a row of ever larger ones, so that leaves lie beside large subtrees.
        let size = |i: u32| if i.is_multiple_of(2) { 1.0 } else { 1.0 + i as f32 * i as f32 };
        let of = |i: u32| {
            [0, 3, 6].map(|k| size(i) * Vec3::new(uniform(i, k, 1), uniform(i, k + 1, 1), uniform(i, k + 2, 1)))
        };
        let ids: Vec<u32> = (0..n).collect();
        let binary = BinaryBvh::build(&of, &ids, &BuildOptions::default(), &Progress::none()).unwrap();
        let made = [1, 2, 7].map(|threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let Plans { plans, order } =
                pool.install(|| plans::<WIDTH>(&binary, Subtree::root(&binary), &Progress::none())).unwrap();
            let of_plan = |p: &Plan<WIDTH>| (p.children[..p.count as usize].to_vec(), p.first_node, p.first_slot);
            (plans.iter().map(of_plan).collect::<Vec<_>>(), order)
        });
        assert!(made[0].0.len() > 5_000);
        assert!(made[0] == made[1] && made[0] == made[2]);
    }

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
