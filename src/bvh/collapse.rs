//! Collapse of the binary tree to eight-wide nodes (Dammertz, Hanika and Keller, *Shallow Bounding
//! Volume Hierarchies for Fast SIMD Ray Tracing of Incoherent Rays*, 2008): the child of largest
//! area is opened first.

use super::binned::{BinaryBvh, Box4};
use super::layout::{ChildRef, LEAF_PAD, LEAF_STRIDE, Mbvh, Node, WIDTH};
use glam::Vec3;

/// Boxes grow by this part of their coordinates, which pays for the rounding of planes in the box test of
/// the kernels.
const OUTWARDS: f32 = 2.0 * f32::EPSILON;

/// Sets the box of child `i`, moved outwards; an empty one is hit by no ray.
pub(super) fn set_box(node: &mut Node, i: usize, b: &Box4) {
    // From infinities it would make NaN.
    if b.is_empty() {
        for axis in 0..3 {
            (node.lower[axis][i], node.upper[axis][i]) = (f32::INFINITY, f32::NEG_INFINITY);
        }
        return;
    }
    let (lower, upper) = b.corners();
    for axis in 0..3 {
        node.lower[axis][i] = lower[axis] - OUTWARDS * lower[axis].abs();
        node.upper[axis][i] = upper[axis] + OUTWARDS * upper[axis].abs();
    }
}

/// The 8-wide tree of a binary one, nodes in depth-first order: the inner children of a node follow each
/// other, then comes what lies below the first, below the second, and so on; leaves likewise (`refit`
/// relies on it).
pub(super) fn collapse(binary: &BinaryBvh, corners: &[[Vec3; 3]]) -> Mbvh {
    let n = binary.triangles.len();
    let root = &binary.nodes[0];
    let mut tree = Mbvh {
        nodes: Vec::with_capacity(n / 8 + 1),
        leaves: Vec::with_capacity(n * LEAF_STRIDE + LEAF_PAD),
        bounds: (root.lower, root.upper),
    };
    tree.nodes.push(Node::EMPTY);
    // (node to fill, its binary root); depth-first, first child next.
    let mut work = vec![(0usize, 0u32)];
    while let Some((target, source)) = work.pop() {
        let mut children = [0u32; WIDTH];
        let count = open(binary, source, &mut children);
        let mut node = Node::EMPTY;
        for (i, &child) in children[..count].iter().enumerate() {
            let b = &binary.nodes[child as usize];
            set_box(&mut node, i, &Box4::new(b.lower, b.upper));
            node.children[i] = if b.count > 0 {
                let triangles = &binary.triangles[b.index as usize..][..b.count as usize];
                push_leaf(&mut tree.leaves, triangles, corners)
            } else {
                tree.nodes.push(Node::EMPTY);
                ChildRef::node(tree.nodes.len() - 1)
            };
        }
        node.sort_children();
        tree.nodes[target] = node;
        for (i, &child) in children[..count].iter().enumerate().rev() {
            if !node.children[i].is_leaf() {
                work.push((node.children[i].node_index(), child));
            }
        }
    }
    tree.leaves.extend([0.0; LEAF_PAD]);
    tree.nodes.shrink_to_fit();
    tree
}

/// Fills in up to eight descendants of `source` that cover it, and says how many.
fn open(binary: &BinaryBvh, source: u32, children: &mut [u32; WIDTH]) -> usize {
    children[0] = source;
    let mut count = 1;
    while count < WIDTH {
        let inner = (0..count).filter(|&i| binary.nodes[children[i] as usize].count == 0);
        let largest =
            inner.reduce(|a, b| if binary.half_area(children[b]) > binary.half_area(children[a]) { b } else { a });
        let Some(i) = largest else { break };
        let parent = children[i];
        children[i] = parent + 1;
        children[count] = binary.nodes[parent as usize].index;
        count += 1;
    }
    count
}

fn push_leaf(leaves: &mut Vec<f32>, triangles: &[u32], corners: &[[Vec3; 3]]) -> ChildRef {
    let slot = leaves.len() / LEAF_STRIDE;
    for corner in 0..3 {
        for axis in 0..3 {
            leaves.extend(triangles.iter().map(|&t| corners[t as usize][corner][axis]));
        }
    }
    leaves.extend(triangles.iter().map(|&t| f32::from_bits(t)));
    ChildRef::leaf(slot, triangles.len())
}

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
            let binary = BinaryBvh::build(&corners, &ids, &options, &Progress::none()).unwrap();
            let tree = collapse(&binary, &corners);
            let mut seen = vec![false; n];
            for node in &tree.nodes {
                for (i, child) in node.children.iter().enumerate() {
                    if *child == ChildRef::EMPTY || !child.is_leaf() {
                        continue;
                    }
                    let c = child.leaf_count();
                    let rows = &tree.leaves[child.leaf_slot() * LEAF_STRIDE..][..LEAF_STRIDE * c];
                    for k in 0..c {
                        let id = rows[9 * c + k].to_bits() as usize;
                        assert!(!std::mem::replace(&mut seen[id], true));
                        for row in 0..9 {
                            let x = rows[row * c + k];
                            assert_eq!(x, corners[id][row / 3][row % 3]);
                            assert!(node.lower[row % 3][i] <= x && x <= node.upper[row % 3][i]);
                        }
                    }
                }
            }
            assert!(seen.iter().all(|&s| s));
        }
    }
}
