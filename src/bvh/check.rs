//! Checks of trees that come from files: a tree that passes can be traversed, refitted and saved like one that was
//! built, whatever else the file holds. Boxes may be wrong; then rays miss what they should hit, and no more.
//!
//! The order that the [builder](super::collapse) gives nodes and leaves says where each must lie, so that a walk finds
//! each once: there are no circles, and no node or leaf is left out or in two places.

use super::Compact;
use super::Mbvh;
use super::compact::{GONE, LAST, NUMBER, PAD};
use super::layout::{ChildRef, LEAF_PAD, LEAF_STRIDE, MAX_DEPTH, MAX_LEAF, WIDTH};

/// A walk over the nodes of a tree in their order.
struct Walk {
    /// Nodes that are still to be visited, with the number of levels above them.
    waiting: Vec<(u32, usize)>,
    next_node: usize,
}

impl Walk {
    fn new() -> Walk {
        Walk { waiting: vec![(0, 0)], next_node: 1 }
    }

    fn next(&mut self) -> Option<(usize, usize)> {
        self.waiting.pop().map(|(node, level)| (node as usize, level))
    }

    /// Notes the next `count` nodes as the inner children of a node of `level`; `None` if the tree has not so many, or
    /// is too deep.
    fn descend(&mut self, count: usize, level: usize, nodes: usize) -> Option<()> {
        let first = self.next_node;
        self.next_node += count;
        // The first is visited next.
        self.waiting.extend((first..self.next_node).rev().map(|node| (node as u32, level + 1)));
        (self.next_node <= nodes && level + usize::from(count > 0) < MAX_DEPTH).then_some(())
    }
}

impl Mbvh {
    /// Returns whether this is a tree of triangles whose numbers are below `triangles`.
    pub(crate) fn is_sound(&self, triangles: usize) -> bool {
        self.check(triangles).is_some()
    }

    fn check(&self, triangles: usize) -> Option<()> {
        let slots = (self.leaves.len().checked_sub(LEAF_PAD)?) / LEAF_STRIDE;
        let (mut walk, mut next_slot) = (Walk::new(), 0);
        while let Some((node, level)) = walk.next() {
            let node = self.nodes.get(node)?;
            let mut inner = 0;
            for (i, &child) in node.children.iter().enumerate() {
                if child == ChildRef::EMPTY {
                    // Its box is what keeps rays from it.
                    let is_empty =
                        (0..3).all(|a| node.lower[a][i] == f32::INFINITY && node.upper[a][i] == f32::NEG_INFINITY);
                    is_empty.then_some(())?;
                } else if child.is_leaf() {
                    let count = child.leaf_count();
                    let end = next_slot + count;
                    (child.leaf_slot() == next_slot && end <= slots).then_some(())?;
                    let numbers = &self.leaves[LEAF_STRIDE * next_slot + 9 * count..LEAF_STRIDE * end];
                    numbers.iter().all(|n| (n.to_bits() as usize) < triangles).then_some(())?;
                    next_slot = end;
                } else {
                    (child.node_index() == walk.next_node + inner).then_some(())?;
                    inner += 1;
                }
            }
            walk.descend(inner, level, self.nodes.len())?;
        }
        let is_whole = walk.next_node == self.nodes.len() && next_slot * LEAF_STRIDE + LEAF_PAD == self.leaves.len();
        is_whole.then_some(())
    }
}

impl Compact {
    /// Returns whether this is a tree of triangles whose numbers are below `triangles`.
    pub(crate) fn is_sound(&self, triangles: usize) -> bool {
        self.check(triangles).is_some()
    }

    fn check(&self, triangles: usize) -> Option<()> {
        let slots = self.triangles.len().checked_sub(PAD)?;
        let (leaves, pad) = self.triangles.split_at(slots);
        pad.iter().all(|&t| t == LAST | GONE).then_some(())?;
        leaves.iter().all(|t| ((t & NUMBER) as usize) < triangles).then_some(())?;
        let (mut walk, mut next_slot) = (Walk::new(), 0);
        while let Some((node, level)) = walk.next() {
            let node = self.nodes.get(node)?;
            // Which inner children and which leaves there are, by their numbers after the first.
            let (mut inner, mut starts) = (0u64, 0u64);
            for (_, child) in node.inner() {
                let after = child.node_index().checked_sub(walk.next_node).filter(|&n| n < WIDTH)?;
                (inner >> after & 1 == 0).then_some(())?;
                inner |= 1 << after;
            }
            for (_, child) in node.leaves() {
                let after = child.leaf_slot().checked_sub(next_slot).filter(|&n| n < WIDTH * MAX_LEAF)?;
                (starts >> after & 1 == 0).then_some(())?;
                starts |= 1 << after;
            }
            let count = inner.count_ones();
            (inner == (1 << count) - 1).then_some(())?;
            // A missing child is a leaf of the node to rays from very far.
            let missing_are_leaves = node.missing().all(|child| child.is_leaf() && child.leaf_slot() == next_slot);
            (missing_are_leaves && (starts != 0 || node.missing().next().is_none())).then_some(())?;
            let first = next_slot;
            while next_slot < slots && starts >> (next_slot - first) & 1 == 1 {
                starts ^= 1 << (next_slot - first);
                let rest = &leaves[next_slot..slots.min(next_slot + MAX_LEAF)];
                next_slot += rest.iter().position(|t| t & LAST != 0)? + 1;
                if starts == 0 {
                    break;
                }
                (next_slot - first < WIDTH * MAX_LEAF).then_some(())?;
            }
            (starts == 0).then_some(())?;
            walk.descend(count as usize, level, self.nodes.len())?;
        }
        (walk.next_node == self.nodes.len() && next_slot == slots).then_some(())
    }
}
