//! Collapse of the binary tree to eight-wide nodes (Dammertz, Hanika and Keller, *Shallow Bounding
//! Volume Hierarchies for Fast SIMD Ray Tracing of Incoherent Rays*, 2008): the child of largest
//! area is opened first.

use super::binned::BinaryBvh;
use super::layout::{ChildRef, LEAF_PAD, LEAF_STRIDE, Mbvh, Node, WIDTH};
use glam::Vec3;
use rayon::prelude::*;

/// Boxes grow by this part of their coordinates, which pays for the rounding of planes in the box test of
/// the kernels.
const OUTWARDS: f32 = 2.0 * f32::EPSILON;

/// The binary nodes that an 8-wide node has as children.
#[derive(Clone, Copy)]
struct Plan {
    children: [u32; WIDTH],
    count: u32,
    /// Number of the node of the first inner child; those of the others follow.
    first: u32,
}

/// The 8-wide tree of a binary one; nodes follow their parents.
pub(super) fn collapse(binary: &BinaryBvh, corners: &[[Vec3; 3]]) -> Mbvh {
    let n = binary.triangles.len();
    let root = &binary.nodes[0];
    // Which binary nodes become children is quickly told; to fill in nodes and leaves takes the time.
    let mut plans = Vec::with_capacity(n / 6 + 1);
    plans.push(Plan { children: [0; WIDTH], count: 0, first: 0 });
    let mut work = vec![(0usize, 0u32)];
    while let Some((target, source)) = work.pop() {
        let (children, count) = open(binary, source);
        let first = plans.len();
        plans[target] = Plan { children, count: count as u32, first: first as u32 };
        for &child in &children[..count] {
            if binary.nodes[child as usize].count == 0 {
                work.push((plans.len(), child));
                plans.push(Plan { children: [0; WIDTH], count: 0, first: 0 });
            }
        }
        // The first child's subtree comes next.
        let inner = plans.len() - first;
        let end = work.len();
        work[end - inner..].reverse();
    }
    let nodes = plans.par_iter().with_min_len(1024).map(|plan| node(binary, plan)).collect();
    let mut leaves = vec![0.0; n * LEAF_STRIDE + LEAF_PAD];
    fill_leaves(&mut leaves[..n * LEAF_STRIDE], binary, corners);
    Mbvh { nodes, leaves, bounds: (root.lower, root.upper) }
}

fn node(binary: &BinaryBvh, plan: &Plan) -> Node {
    let mut node = Node::EMPTY;
    let mut next = plan.first as usize;
    for (i, &child) in plan.children[..plan.count as usize].iter().enumerate() {
        let b = &binary.nodes[child as usize];
        for axis in 0..3 {
            node.lower[axis][i] = b.lower[axis] - OUTWARDS * b.lower[axis].abs();
            node.upper[axis][i] = b.upper[axis] + OUTWARDS * b.upper[axis].abs();
        }
        node.children[i] = if b.count > 0 {
            ChildRef::leaf(b.index as usize, b.count as usize)
        } else {
            next += 1;
            ChildRef::node(next - 1)
        };
    }
    node.sort_children();
    node
}

/// Descendants of `source` that cover it, up to eight, and how many.
fn open(binary: &BinaryBvh, source: u32) -> ([u32; WIDTH], usize) {
    // A leaf is never opened. Its area counts as negative.
    let area = |node: u32| if binary.nodes[node as usize].count == 0 { binary.half_area(node) } else { -1.0 };
    let mut children = [source; WIDTH];
    let mut areas = [area(source); WIDTH];
    let mut count = 1;
    while count < WIDTH {
        let largest = (1..count).fold(0, |a, b| if areas[b] > areas[a] { b } else { a });
        if areas[largest] < 0.0 {
            break;
        }
        let parent = children[largest];
        for (place, child) in [(largest, parent + 1), (count, binary.nodes[parent as usize].index)] {
            (children[place], areas[place]) = (child, area(child));
        }
        count += 1;
    }
    (children, count)
}

/// Rows of all leaves, each where its triangles are in the binary tree's order.
fn fill_leaves(leaves: &mut [f32], binary: &BinaryBvh, corners: &[[Vec3; 3]]) {
    // In the order of the nodes, leaves follow each other in `triangles` too.
    let counts: Vec<u32> = binary.nodes.iter().map(|b| b.count).filter(|&c| c > 0).collect();
    debug_assert!(binary.nodes.iter().filter(|b| b.count > 0).is_sorted_by_key(|b| b.index));
    let mut rest = leaves;
    let mut first = 0;
    let mut jobs = Vec::with_capacity(counts.len() / LEAVES_PER_JOB + 1);
    for counts in counts.chunks(LEAVES_PER_JOB) {
        let triangles = counts.iter().sum::<u32>() as usize;
        let (rows, others) = rest.split_at_mut(triangles * LEAF_STRIDE);
        jobs.push((rows, counts, &binary.triangles[first..first + triangles]));
        (rest, first) = (others, first + triangles);
    }
    jobs.into_par_iter().for_each(|(mut rows, counts, mut triangles)| {
        for &count in counts {
            let count = count as usize;
            let (leaf, others) = std::mem::take(&mut rows).split_at_mut(count * LEAF_STRIDE);
            let (own, next) = triangles.split_at(count);
            for (i, &t) in own.iter().enumerate() {
                for (corner, v) in corners[t as usize].iter().enumerate() {
                    for axis in 0..3 {
                        leaf[(3 * corner + axis) * count + i] = v[axis];
                    }
                }
                leaf[9 * count + i] = f32::from_bits(t);
            }
            (rows, triangles) = (others, next);
        }
    });
}

/// Leaves that a thread fills at a time.
const LEAVES_PER_JOB: usize = 1024;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bvh::BuildOptions;
    use crate::progress::Progress;
    use crate::sampling::uniform;

    #[test]
    fn every_triangle_is_in_one_leaf_with_its_corners_and_number() {
        for (n, max_leaf) in [(1usize, 3), (2, 1), (5, 8), (3000, 3)] {
            let corners: Vec<[Vec3; 3]> = (0..n as u32)
                .map(|i| [0, 3, 6].map(|k| Vec3::new(uniform(i, k, 1), uniform(i, k + 1, 1), uniform(i, k + 2, 1))))
                .collect();
            let ids: Vec<u32> = (0..n as u32).collect();
            let options = BuildOptions { max_leaf, ..Default::default() };
            for binary in [
                BinaryBvh::build(&corners, &ids, &options, &Progress::none()).unwrap(),
                BinaryBvh::build_spatial(&corners, &ids, &options, &Progress::none()).unwrap(),
            ] {
                let tree = collapse(&binary, &corners);
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
