//! Memory layout of the 8-wide tree, and of trees of other widths.

use crate::base::array::Array;
use crate::base::error::Result;
use crate::base::geometry::half_area;
use crate::base::parallel::ParallelLoop;
use crate::base::progress::Progress;
use crate::base::scratch_files::Storage;
use crate::simd::prefetch;
use bytemuck::{Pod, Zeroable};
use glam::Vec3;
use rayon::prelude::*;
use std::hint::select_unpredictable;

/// Maximum number of triangles of a leaf reference.
pub(crate) const MAX_LEAF: usize = 8;

/// Maximum number of binary levels from the root to a leaf: the builder falls back to halving below [`SAH_DEPTH`], and
/// 2^28 triangles are halved 28 times.
pub(crate) const MAX_DEPTH: usize = SAH_DEPTH + 28;

/// Number of levels on which the builder may follow the SAH freely.
pub(crate) const SAH_DEPTH: usize = 48;

/// Greatest number of children of a node, and that of the tree that scenes have.
pub(crate) const WIDTH: usize = 8;

/// Number of entries that a traversal stack can need: each level of the 8-wide tree leaves at most seven siblings
/// behind, and an 8-wide level is at least one binary level. Children are pushed eight at a time, whatever their
/// number.
pub(crate) const STACK_SIZE: usize = (WIDTH - 1) * MAX_DEPTH + 1 + WIDTH;

/// A reference to a child: another node, a leaf, or nothing.
///
/// ```text
/// bit 31      30..28           27..0
///     0       node number (31 bits)
///     1       triangles − 1    first triangle slot
///     all ones: no child
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, Pod, Zeroable)]
#[repr(transparent)]
pub struct ChildRef(u32);

impl ChildRef {
    /// No child.
    pub const EMPTY: ChildRef = ChildRef(u32::MAX);

    /// The root of a tree.
    pub(crate) const ROOT: ChildRef = ChildRef(0);

    pub(crate) fn node(index: usize) -> Self {
        debug_assert!(index < 1 << 31);
        ChildRef(index as u32)
    }

    pub(crate) fn leaf(first_slot: usize, count: usize) -> Self {
        debug_assert!((1..=MAX_LEAF).contains(&count) && first_slot < (1 << 28) - 1);
        ChildRef(1 << 31 | (count as u32 - 1) << 28 | first_slot as u32)
    }

    pub(crate) fn bits(self) -> u32 {
        self.0
    }

    pub(crate) fn from_bits(bits: u32) -> Self {
        ChildRef(bits)
    }

    /// Whether the reference is to a leaf (or empty).
    #[inline(always)]
    pub(crate) fn is_leaf(self) -> bool {
        (self.0 as i32) < 0
    }

    #[inline(always)]
    pub(crate) fn node_index(self) -> usize {
        self.0 as usize
    }

    /// Number of triangles of a leaf.
    #[inline(always)]
    pub(crate) fn leaf_count(self) -> usize {
        (self.0 >> 28 & 7) as usize + 1
    }

    /// First triangle slot of a leaf.
    #[inline(always)]
    pub(crate) fn leaf_slot(self) -> usize {
        (self.0 & 0x0fff_ffff) as usize
    }
}

/// An 8-wide node, 256 bytes, four cache lines. (A 4-wide one has four values wherever this has eight, and 128 bytes.)
///
/// ```text
/// byte   0  minima of x (eight f32), of y, of z
///       96  maxima of x, of y, of z
///      192  eight child references (u32)
///      224  eight u32: bits 3·o to 3·o + 2 of the i-th name the child that comes i-th, from far to
///           near, for directions of octant o (bit a of o: component a is negative)
/// ```
///
/// Missing children have minima +inf, maxima −inf: no ray hits them.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
pub struct Node<const W: usize = WIDTH> {
    /// Minima of the children's boxes, by axis.
    pub lower: [[f32; W]; 3],
    /// Maxima of the children's boxes, by axis.
    pub upper: [[f32; W]; 3],
    /// The children.
    pub children: [ChildRef; W],
    /// Order of the children by octant, three bits each, as drawn above.
    pub order: [u32; W],
}

// SAFETY: numbers without gaps between them, whatever their width; all bits are possible. (The alignment is not more than
// the size of 8 children, of which files have nodes.)
unsafe impl Zeroable for Node<WIDTH> {}
// SAFETY: as above.
unsafe impl Pod for Node<WIDTH> {}

impl<const W: usize> Node<W> {
    pub(crate) const EMPTY: Self = Node {
        lower: [[f32::INFINITY; W]; 3],
        upper: [[f32::NEG_INFINITY; W]; 3],
        children: [ChildRef::EMPTY; W],
        order: [0; W],
    };

    /// Sum of the children's contributions to the tree's cost, times half the area of its bounds.
    fn sah_cost(&self) -> f64 {
        let child = |i: usize| {
            let c = self.children[i];
            // An empty child, or a leaf whose triangles cannot be hit.
            if self.lower[0][i] > self.upper[0][i] {
                return 0.0;
            }
            let [lower, upper] = [&self.lower, &self.upper].map(|b| Vec3::new(b[0][i], b[1][i], b[2][i]));
            half_area(lower, upper) * if c.is_leaf() { c.leaf_count() as f64 } else { 1.0 }
        };
        (0..W).map(child).sum()
    }

    /// Fills in `order` from the boxes, by their centres along the octant's diagonal. (Ordering by where boxes begin
    /// costs random rays 3 % more instructions.)
    pub(crate) fn sort_children(&mut self) {
        self.order = [0; W];
        let centre: [[f32; W]; 3] =
            std::array::from_fn(|a| std::array::from_fn(|i| self.lower[a][i] + self.upper[a][i]));
        for octant in 0..4u32 {
            let sign = |a: u32| if octant >> a & 1 == 1 { -1.0 } else { 1.0 };
            let key: [f32; W] = std::array::from_fn(|i| {
                let along = sign(0) * centre[0][i] + sign(1) * centre[1][i] + centre[2][i];
                // The position of a missing child, or of one that no ray hits, is never used.
                if along.is_nan() { f32::INFINITY } else { along }
            });
            // The number of children that come before each: those farther away, and of equal ones the first.
            let mut place = [0u32; W];
            for (j, &other) in key.iter().enumerate() {
                for (i, place) in place.iter_mut().enumerate() {
                    *place += u32::from(if j < i { other >= key[i] } else { other > key[i] });
                }
            }
            for (child, place) in place.into_iter().enumerate() {
                self.order[place as usize] |= (child as u32) << (3 * octant);
                // The opposite octant.
                self.order[W - 1 - place as usize] |= (child as u32) << (3 * (7 - octant));
            }
        }
    }
}

/// Number of floats that leaf loads may read beyond a leaf's end.
pub(crate) const LEAF_PAD: usize = 16;

/// Number of floats per triangle in a leaf: nine coordinates and the number.
pub(crate) const LEAF_STRIDE: usize = 10;

/// The tree that the kernels traverse; that of a scene is 8-wide. Node 0 is the root.
///
/// Triangles lie leaf by leaf. A leaf of c triangles that starts at slot s occupies floats 10·s to
/// 10·(s + c): ten rows of c values each:
///
/// ```text
/// x of corner 0 (c floats), y of corner 0, z of corner 0, x of corner 1, … z of corner 2,
/// global triangle numbers (c u32, as bits)
/// ```
///
/// Rows are loaded four at a time whatever c is; lanes beyond c hold the next row's values and are
/// masked. That keeps leaves at 40 bytes per triangle with no transposition (padding every leaf to
/// four triangles would take about twice that).
pub struct Mbvh<const W: usize = WIDTH> {
    pub(crate) nodes: Array<Node<W>>,
    pub(crate) leaves: Array<f32>,
    pub(crate) bounds: (Vec3, Vec3),
}

impl Mbvh {
    /// Copies the tree; fails if there is not enough memory.
    pub(super) fn copy(&self, storage: Storage, progress: &Progress) -> Result<Self> {
        let what = "a copy of the tree";
        let (nodes, leaves) = (storage.copy(&self.nodes, what, progress)?, storage.copy(&self.leaves, what, progress)?);
        nodes.at_random();
        leaves.at_random();
        Ok(Mbvh { nodes, leaves, bounds: self.bounds })
    }
}

impl<const W: usize> Mbvh<W> {
    /// Returns a tree of nothing, which no ray hits.
    pub(crate) fn nothing() -> Self {
        let bounds = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        Mbvh { nodes: vec![Node::EMPTY].into(), leaves: vec![0.0; LEAF_PAD].into(), bounds }
    }

    #[inline]
    pub(crate) fn has_no_leaves(&self) -> bool {
        self.leaves.len() <= LEAF_PAD
    }

    /// Lower and upper corner of the box around all triangles.
    pub fn bounds(&self) -> (Vec3, Vec3) {
        self.bounds
    }

    /// Number of nodes.
    pub fn node_count(&self) -> usize {
        self.nodes.len()
    }

    /// Whether a child is a node of this tree.
    #[inline]
    pub(crate) fn has_node(&self, node: ChildRef) -> bool {
        node.node_index() < self.nodes.len()
    }

    /// Returns the numbers of the triangles of a leaf.
    pub(crate) fn leaf_triangles(&self, leaf: ChildRef) -> impl Iterator<Item = u32> + '_ {
        let (count, first) = (leaf.leaf_count(), LEAF_STRIDE * leaf.leaf_slot());
        self.leaves[first + 9 * count..][..count].iter().map(|number| number.to_bits())
    }

    /// Size in bytes of nodes and leaves.
    pub fn bytes(&self) -> usize {
        self.nodes.len() * size_of::<Node<W>>() + self.leaves.len() * size_of::<f32>()
    }

    /// Surface area heuristic cost: expected number of nodes plus triangles that a ray through the bounds is tested
    /// against. It is computed from the current boxes, so a refit changes it.
    pub fn sah_cost(&self) -> f32 {
        if !self.bounds.0.cmple(self.bounds.1).all() {
            return 0.0;
        }
        let root_area = half_area(self.bounds.0, self.bounds.1);
        // Sums are taken by chunks, so that they do not depend on the number of threads.
        let chunks: Vec<f64> =
            self.nodes.par_chunks(1 << 10).map(|nodes| nodes.iter().map(Node::<W>::sah_cost).sum()).collected();
        (1.0 + chunks.iter().sum::<f64>() / root_area) as f32
    }

    /// Prefetches a child that will be visited soon.
    #[inline(always)]
    pub(crate) fn prefetch(&self, child: ChildRef) {
        // One cache line: the hardware prefetches the others. (Two and four lines are no faster.)
        prefetch(self.address(child));
    }

    /// Prefetches all of a child: the cache lines of a node, or those of a leaf.
    #[inline(always)]
    pub(crate) fn prefetch_whole(&self, child: ChildRef) {
        let p = self.address(child);
        let bytes = if child.is_leaf() { 4 * LEAF_STRIDE * child.leaf_count() } else { size_of::<Node<W>>() };
        for line in (0..bytes).step_by(64) {
            prefetch(p.wrapping_add(line));
        }
    }

    /// Where a child begins in memory.
    #[inline(always)]
    fn address(&self, child: ChildRef) -> *const u8 {
        let leaf = self.leaves.as_ptr().wrapping_add(LEAF_STRIDE * child.leaf_slot()).cast();
        let node = self.nodes.as_ptr().wrapping_add(child.node_index()).cast();
        // (Where rays are in different trees, it had become a branch, which was often mispredicted.)
        select_unpredictable(child.is_leaf(), leaf, node)
    }

    /// Pointer to the first row of a leaf; [`LEAF_PAD`] floats behind the last leaf are readable.
    ///
    /// # Safety
    /// `leaf` must be a leaf of this tree.
    #[inline(always)]
    pub(crate) unsafe fn leaf(&self, leaf: ChildRef) -> *const f32 {
        debug_assert!(LEAF_STRIDE * (leaf.leaf_slot() + leaf.leaf_count()) + LEAF_PAD <= self.leaves.len());
        // SAFETY: the caller vouches for the reference; the builder made the rows that it names.
        unsafe { self.leaves.as_ptr().add(LEAF_STRIDE * leaf.leaf_slot()) }
    }
}
