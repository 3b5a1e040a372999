//! Acceleration structures: a binary tree built by binned SAH, collapsed to the 4-wide MBVH that the
//! kernels traverse.

mod binned;
mod collapse;
pub(crate) mod layout;

pub use binned::{BinaryBvh, BinaryNode};
pub use layout::{ChildRef, Mbvh, Node};

use crate::error::{Result, invalid_argument};
use crate::progress::Progress;
use glam::Vec3;

/// Parameters of the builder.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BuildOptions {
    /// Bins per axis of the surface area heuristic, 2 to 256. Thesis: 64.
    pub bins: u32,
    /// Most triangles per leaf, 1 to 8. Thesis: 3.
    pub max_leaf: u32,
}

impl Default for BuildOptions {
    fn default() -> Self {
        BuildOptions { bins: 64, max_leaf: 3 }
    }
}

impl BuildOptions {
    /// Checks the ranges documented on the fields.
    pub fn validate(&self) -> Result<()> {
        if !(2..=256).contains(&self.bins) {
            return invalid_argument!("bins is {}, outside 2 to 256", self.bins);
        }
        if !(1..=layout::MAX_LEAF as u32).contains(&self.max_leaf) {
            return invalid_argument!("max_leaf is {}, outside 1 to {}", self.max_leaf, layout::MAX_LEAF);
        }
        Ok(())
    }
}

/// Upper bound of an [`Mbvh`]'s size with the builder's working memory, for the memory monitor.
pub fn estimated_bytes(triangles: usize) -> usize {
    // Per triangle: 40 in leaves, up to 128/3 of nodes, and while building 32 of references, 64 of
    // binary nodes and 36 of corners.
    triangles * 216
}

/// Builds the MBVH over the triangles `valid` (global numbers, ascending) and gives its SAH cost:
/// that of the binary tree with traversal and intersection costing 1 each.
pub fn build(corners: &[[Vec3; 3]], valid: &[u32], options: &BuildOptions, progress: &Progress) -> Result<(Mbvh, f32)> {
    options.validate()?;
    let binary = BinaryBvh::build(corners, valid, options, progress)?;
    progress.check()?;
    let cost = binary.sah_cost();
    Ok((collapse::collapse(&binary, corners), cost))
}
