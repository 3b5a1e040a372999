//! Parts of a tree that may be larger than memory: subtrees of some megabytes, each of which lies together in the file that
//! the tree is mapped from. Rays wait at them (`crate::scene::waiting`).
//!
//! What is above them, and so is met by most rays, is in memory: the boxes of the parts, with a tree over them, and the
//! triangles of leaves near the root, with another.

use super::instances::Instances;
use super::layout::{ChildRef, LEAF_PAD, LEAF_STRIDE, Mbvh, Node, WIDTH};
use super::{BuildOptions, Compact, Tree, build_few, compact};
use crate::base::error::Result;
use crate::base::memory::{try_collect, try_push};
use crate::base::progress::Progress;
use glam::Vec3;
use std::ops::Range;

/// A subtree.
pub(crate) struct Part {
    pub root: ChildRef,
    /// Lower and upper corner of its box.
    pub bounds: (Vec3, Vec3),
    /// The nodes below the root, and the slots of their triangles: each lie together.
    nodes: Range<usize>,
    slots: Range<usize>,
}

/// A tree in parts.
pub(crate) struct Parts {
    /// The parts, by number: those that lie next to each other in the file follow each other.
    pub parts: Vec<Part>,
    /// Tree over the boxes of parts; its leaves hold their numbers, one each.
    pub top: Mbvh,
    /// The triangles that are in no part.
    pub near_root: Mbvh,
}

/// Name of this memory in error messages.
const PARTS: &str = "the parts of a tree";

impl Parts {
    /// Cuts a tree into parts of at most `bytes` bytes, but for nodes that have no smaller ones below them.
    pub fn of(tree: &Tree, corners: &(dyn Fn(u32) -> [Vec3; 3] + Sync), bytes: usize) -> Result<Parts> {
        let (mut parts, mut near_root) = (Vec::new(), Vec::new());
        let whole =
            Part { root: ChildRef::ROOT, bounds: tree.bounds(), nodes: 1..tree.node_count(), slots: tree.slots() };
        let mut stack = vec![whole];
        while let Some(part) = stack.pop() {
            let children = tree.children(part.root);
            if tree.bytes_of(&part) <= bytes || !children.iter().any(|c| !c.0.is_leaf()) {
                try_push(&mut parts, part, PARTS)?;
                continue;
            }
            for (leaf, _) in children.iter().filter(|c| c.0.is_leaf()) {
                tree.triangles(*leaf, &mut near_root);
            }
            // The subtrees of the children follow each other; the end of one is where the next begins.
            let (mut end, mut last_slot) = (part.nodes.end, part.slots.end);
            let inner = || children.iter().filter(|c| !c.0.is_leaf());
            let first = inner().map(|c| c.0.node_index()).min().unwrap_or_default();
            for number in (first..first + inner().count()).rev() {
                let Some(&(root, bounds)) = inner().find(|c| c.0.node_index() == number) else { continue };
                let first = tree.children(root).iter().filter(|c| !c.0.is_leaf()).map(|c| c.0.node_index()).min();
                let (nodes, slots) = (first.unwrap_or(end)..end, tree.first_slot(root)..last_slot);
                (end, last_slot) = (nodes.start, slots.start);
                stack.push(Part { root, bounds, nodes, slots });
            }
        }
        let boxes = try_collect(parts.iter().map(|p| p.bounds), PARTS)?;
        let top = Instances::top_of(&boxes, &Progress::none())?;
        // Spatial splits put a triangle into several leaves.
        near_root.sort_unstable();
        near_root.dedup();
        let near_root = build_few(corners, &near_root, &BuildOptions::default(), &Progress::none())?;
        Ok(Parts { parts, top, near_root })
    }

    /// Returns the size in bytes.
    pub fn bytes(&self) -> usize {
        size_of_val(&self.parts[..]) + self.top.bytes() + self.near_root.bytes()
    }
}

impl Tree {
    /// The slots of all triangles.
    fn slots(&self) -> Range<usize> {
        0..match self {
            Tree::Whole(t) => (t.leaves.len() - LEAF_PAD) / LEAF_STRIDE,
            Tree::Compact(t) => t.triangles.len() - compact::PAD,
        }
    }

    /// Size in bytes of a part, but for vertices.
    fn bytes_of(&self, part: &Part) -> usize {
        let (nodes, slots) = (part.nodes.len(), part.slots.len());
        match self {
            Tree::Whole(_) => nodes * size_of::<Node>() + slots * LEAF_STRIDE * size_of::<f32>(),
            Tree::Compact(_) => nodes * size_of::<compact::CompactNode>() + slots * size_of::<u32>(),
        }
    }

    /// The children of a node, with their boxes.
    fn children(&self, node: ChildRef) -> Vec<(ChildRef, (Vec3, Vec3))> {
        match self {
            Tree::Whole(t) => {
                let node = &t.nodes[node.node_index()];
                let corner = |rows: &[[f32; WIDTH]; 3], i: usize| Vec3::from_array([0, 1, 2].map(|a| rows[a][i]));
                let child = |i: usize| (node.children[i], (corner(&node.lower, i), corner(&node.upper, i)));
                (0..WIDTH).map(child).filter(|c| c.0 != ChildRef::EMPTY).collect()
            }
            Tree::Compact(t) => t.nodes[node.node_index()].boxes().collect(),
        }
    }

    /// Appends the triangles of a leaf.
    fn triangles(&self, leaf: ChildRef, out: &mut Vec<u32>) {
        match self {
            Tree::Whole(t) => out.extend(t.leaf_triangles(leaf)),
            Tree::Compact(t) => out.extend(t.triangles_of(leaf)),
        }
    }

    /// The first slot of the triangles below a node.
    fn first_slot(&self, mut node: ChildRef) -> usize {
        loop {
            let children = self.children(node);
            let (leaves, inner): (Vec<_>, Vec<_>) = children.iter().map(|c| c.0).partition(|c| c.is_leaf());
            if let Some(slot) = leaves.iter().map(|c| c.leaf_slot()).min() {
                return slot;
            }
            node = inner.into_iter().min_by_key(|c| c.node_index()).expect("a node has children");
        }
    }

    /// Asks the system to read a part now, if it lies in a mapped file.
    pub(crate) fn will_need(&self, part: &Part) {
        match self {
            Tree::Whole(t) => {
                t.nodes.will_need(part.nodes.clone());
                t.leaves.will_need(LEAF_STRIDE * part.slots.start..LEAF_STRIDE * part.slots.end);
            }
            Tree::Compact(t) => {
                t.nodes.will_need(part.nodes.clone());
                t.triangles.will_need(part.slots.clone());
            }
        }
    }
}

impl Compact {
    fn triangles_of(&self, leaf: ChildRef) -> impl Iterator<Item = u32> + '_ {
        let entries = &self.triangles[leaf.leaf_slot()..];
        let count = entries.iter().position(|t| t & compact::LAST != 0).map_or(0, |last| last + 1);
        entries[..count].iter().filter(|&t| t & compact::GONE == 0).map(|t| t & compact::NUMBER)
    }
}
