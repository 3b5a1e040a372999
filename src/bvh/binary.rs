//! The binary tree, before it is collapsed to wide nodes.

use crate::base::array::Array;
use crate::base::geometry::half_area;
use crate::base::parallel::ParallelLoop;
use bytemuck::{Pod, Zeroable};
use glam::Vec3;
use rayon::prelude::*;

/// A node of the binary tree, 32 bytes. The left child of an inner node follows it.
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[repr(C)]
pub struct BinaryNode {
    /// Lower corner of the node's box.
    pub lower: Vec3,
    /// Index of the right child of an inner node; first triangle slot of a leaf.
    pub index: u32,
    /// Upper corner of the node's box.
    pub upper: Vec3,
    /// Number of triangles of a leaf; 0 in an inner node.
    pub count: u32,
}

/// The binary tree, before collapse.
pub struct BinaryBvh {
    /// Node 0 is the root. Slots of subtrees that ended early are unused and zero.
    pub nodes: Array<BinaryNode>,
    /// Global triangle numbers, leaf by leaf.
    pub triangles: Array<u32>,
}

impl BinaryBvh {
    /// Surface area heuristic: expected cost of a random ray through the root's box; a traversal step and an
    /// intersection cost 1 each.
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
            .collected();
        (chunks.iter().sum::<f64>() / root_area) as f32
    }

    /// Half the surface area of a node's box.
    pub(super) fn half_area(&self, node: u32) -> f64 {
        let n = &self.nodes[node as usize];
        half_area(n.lower, n.upper)
    }
}
