//! Two-level trees: each mesh with instances has a tree of its own, in its coordinates, and the boxes of all instances
//! are the leaves of another (Wald, Benthin and Slusallek, *Distributed Interactive Ray Tracing of Dynamic Scenes*,
//! 2003). A ray that meets the box of an instance goes through the tree of its mesh, in that one's coordinates.

use super::layout::{ChildRef, Mbvh};
use super::{BuildOptions, BuildQuality, Tree, build_few};
use crate::base::error::Result;
use crate::base::geometry::{MAX_COORDINATE, is_valid_triangle};
use crate::base::memory::{try_collect, try_push, try_to_vec};
use crate::base::progress::Progress;
use crate::base::scratch_files::Storage;
use glam::{Mat3A, Vec3, Vec3A};

/// The trees of a scene's instances.
pub(crate) struct Instances {
    /// Tree over the boxes of instances, with the [margin](Margin) of rays around them; its leaves hold their numbers, one
    /// each.
    pub top: Mbvh,
    /// The meshes that have instances.
    pub trees: Vec<MeshTree>,
    /// The instances, by number.
    pub placed: Vec<PlacedTree>,
    pub margin: Margin,
}

/// By how much rays that are tested against boxes of instances may lie beside where they are, since what is hit in an
/// instance is found by transformed rays.
#[derive(Clone, Copy)]
pub(crate) struct Margin {
    /// The greatest [margin](crate::scene::Instance::margin) of all instances, a fraction of the coordinates of a ray's
    /// origin.
    pub part: f32,
    /// The boxes in the tree are larger by the margin of rays whose origins have coordinates up to this. Those of rays
    /// from farther away are added where these are set up.
    pub reach: f32,
}

impl Margin {
    /// That of boxes whose triangles are hit by rays as they are.
    pub(crate) const NONE: Margin = Margin { part: 0.0, reach: f32::INFINITY };

    /// By how much a ray from `origin` may lie beside where it is, if the boxes are not large enough for that.
    pub(crate) fn beside(self, origin: [f32; 3]) -> f32 {
        let far = origin.map(f32::abs).into_iter().fold(0.0, f32::max);
        if far > self.reach { self.part * far } else { 0.0 }
    }

    /// Returns a box as it is in the tree.
    pub(crate) fn around(self, (lower, upper): (Vec3, Vec3)) -> (Vec3, Vec3) {
        let beside = self.part * self.reach;
        // A box that is valid stays so.
        let low = (lower - beside).max(Vec3::splat(-MAX_COORDINATE)).min(lower);
        (low, (upper + beside).min(Vec3::splat(MAX_COORDINATE)).max(upper))
    }
}

/// The tree of a mesh that has instances, with triangles by their number in the mesh.
pub(crate) struct MeshTree {
    /// Number of the mesh.
    pub mesh: u32,
    /// 0 and the number of triangles.
    pub range: [u32; 2],
    pub tree: Tree,
    /// Triangles that are not in the tree, ascending.
    pub skipped: Vec<u32>,
    /// Number of the others that cannot be hit since a refit.
    pub gone: usize,
    /// Whether a refit has moved its mesh: a tree built anew may be better, and have triangles that were none.
    pub is_refitted: bool,
}

/// An instance as rays meet it.
#[derive(Clone, Copy)]
pub(crate) struct PlacedTree {
    /// Map of vectors to the mesh's coordinates.
    pub to_mesh: Mat3A,
    /// Where the mesh's origin lies.
    pub origin: Vec3A,
    /// Index of the tree.
    pub tree: u32,
    /// Global number of the first triangle.
    pub first_triangle: u32,
}

/// Returns the box around the image of another, moved outwards by `margin`, a fraction of its coordinates and extents, for
/// what transforming a ray moves it by; `reach`: the largest coordinate that placing a corner goes through. A box that is not finite, of a mesh that cannot be hit, gives one that no ray meets.
pub(crate) fn placed_box(
    (lower, upper): (Vec3, Vec3),
    reach: f32,
    margin: f32,
    place: impl Fn(Vec3) -> Vec3,
) -> (Vec3, Vec3) {
    let corner = |i: usize| place(Vec3::from_array([0, 1, 2].map(|a| [lower, upper][i >> a & 1][a])));
    let (mut low, mut high) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
    for c in (0..8).map(corner) {
        (low, high) = (low.min(c), high.max(c));
    }
    let margin = margin * ((high - low).max_element() + low.abs().max(high.abs()).max_element().max(reach));
    (low - margin, high + margin)
}

impl Instances {
    /// Returns a triangle with this box.
    pub(crate) fn corners_of_box((lower, upper): (Vec3, Vec3)) -> [Vec3; 3] {
        [lower, Vec3::new(upper.x, upper.y, lower.z), Vec3::new(lower.x, upper.y, upper.z)]
    }

    /// Builds the tree over the boxes of instances.
    pub(crate) fn top_of(boxes: &[(Vec3, Vec3)], progress: &Progress) -> Result<Mbvh> {
        let corners = |i: u32| Self::corners_of_box(boxes[i as usize]);
        let options = BuildOptions { max_leaf: 1, quality: BuildQuality::Default, ..Default::default() };
        // Boxes beyond the greatest coordinate are not met, as triangles there are not.
        let met = |(i, _): (u32, &(Vec3, Vec3))| is_valid_triangle(corners(i)).then_some(i);
        let ids = try_collect((0..).zip(boxes).filter_map(met), "the tree of instances")?;
        build_few(&corners, &ids, &options, progress)
    }

    /// Whether any ray can hit any instance.
    pub(crate) fn are_hit(&self) -> bool {
        let (lower, upper) = self.top.bounds();
        lower.cmple(upper).all()
    }

    /// Returns the numbers of the instances in the tree over their boxes. Others are never met, wherever they move.
    pub(crate) fn in_top(&self) -> impl Iterator<Item = u32> {
        let leaves = self.top.nodes.iter().flat_map(|node| node.children);
        let leaves = leaves.filter(|child| child.is_leaf() && *child != ChildRef::EMPTY);
        leaves.flat_map(|leaf| self.top.leaf_triangles(leaf))
    }

    /// Returns the number of triangles that are in no tree, those of each mesh once.
    pub(crate) fn skipped(&self) -> usize {
        self.trees.iter().map(|t| t.skipped.len()).sum()
    }

    /// Returns the size in bytes.
    pub(crate) fn bytes(&self) -> usize {
        let trees: usize = self.trees.iter().map(|t| t.tree.bytes() + size_of_val(&t.skipped[..])).sum();
        trees + self.top.bytes() + size_of_val(&self.placed[..])
    }

    /// Copies the trees, those of meshes to `storage`; fails if there is not enough memory.
    pub(crate) fn copy(&self, storage: Storage) -> Result<Instances> {
        let none = Progress::none();
        let what = "a copy of the trees of instances";
        let mut trees = Vec::new();
        for t in &self.trees {
            let copy = MeshTree {
                mesh: t.mesh,
                range: t.range,
                tree: t.tree.copy(storage, &none)?,
                skipped: try_to_vec(&t.skipped, what)?,
                gone: t.gone,
                is_refitted: t.is_refitted,
            };
            try_push(&mut trees, copy, what)?;
        }
        Ok(Instances {
            top: self.top.copy(Storage::MEMORY, &none)?,
            trees,
            placed: try_to_vec(&self.placed, what)?,
            margin: self.margin,
        })
    }
}

impl MeshTree {
    /// Whether any ray can hit the mesh.
    pub(crate) fn is_hit(&self) -> bool {
        self.range[1] as usize > self.skipped.len()
    }
}
