//! What single rays need of a tree: the whole one of [`Mbvh`], or the [compact](super::compact) one. Kernels
//! are compiled for each; which of them runs is chosen once per call.

use super::single::RaySetup;
use super::triangle::{Projected, Shear, accurate_distance};
use crate::bvh::layout::{ChildRef, Mbvh, Node, WIDTH};
use crate::simd::{Four, Lanes, Simd};
use std::mem::MaybeUninit;

/// A tree that rays can walk through.
pub(super) trait Tree {
    type Node;
    type Leaf<'a>: Leaf
    where
        Self: 'a;

    /// Bytes between a node's rows of planes: minima of x, y, z, maxima of x, y, z.
    const ROW: u32;

    /// Asks for the memory of a child that will be visited soon.
    fn prefetch(&self, child: ChildRef);

    /// # Safety
    /// `node` must be an inner reference of this tree.
    unsafe fn node(&self, node: ChildRef) -> &Self::Node;

    /// Planes of all children across `axis`, those of the row that begins at `row`.
    ///
    /// # Safety
    /// The CPU must have the ISA, and `row` must be a multiple of [`Self::ROW`] for one of that axis.
    unsafe fn planes<S: Simd>(node: &Self::Node, axis: usize, row: u32) -> S::F8;

    /// References to the children, which may be put into `room`.
    fn names(node: &Self::Node, room: &mut MaybeUninit<[u32; WIDTH]>) -> *const u32;

    /// As [`Node::order`].
    fn order(node: &Self::Node) -> *const u32;

    /// # Safety
    /// The CPU must have the ISA, and `leaf` must be a leaf of this tree.
    unsafe fn leaf<S: Simd>(&self, leaf: ChildRef) -> Self::Leaf<'_>;
}

/// A leaf of a tree.
pub(super) trait Leaf {
    /// Number of triangles.
    fn count(&self) -> usize;

    /// Triangles `first .. first + 4` as a ray sees them. Lanes beyond the count are garbage.
    ///
    /// # Safety
    /// The CPU must have the ISA, and `first` must be below the count.
    unsafe fn project<L: Four>(&self, first: usize, ray: &Shear) -> Projected<L>;

    /// See [`accurate_distance`].
    ///
    /// # Safety
    /// `i` must be below the count.
    unsafe fn accurate_distance(&self, i: usize, ray: &Shear) -> f32;

    /// The number of triangle `i`.
    ///
    /// # Safety
    /// `i` must be below the count.
    unsafe fn number(&self, i: usize) -> u32;

    /// Whether hits of triangle `i` by a ray that walks up to `limit` count. To be asked before a hit is taken:
    /// it may take a while.
    ///
    /// # Safety
    /// The CPU must have the ISA, and `i` must be below the count.
    unsafe fn counts<S: Simd>(&self, i: usize, ray: &RaySetup, limit: f32) -> bool;
}

impl Tree for Mbvh {
    type Node = Node;
    type Leaf<'a> = Rows;

    const ROW: u32 = 4 * WIDTH as u32;

    #[inline(always)]
    fn prefetch(&self, child: ChildRef) {
        self.prefetch(child);
    }

    #[inline(always)]
    unsafe fn node(&self, node: ChildRef) -> &Node {
        debug_assert!(node.node_index() < self.nodes.len());
        // SAFETY: inner references of the tree are in range.
        unsafe { self.nodes.get_unchecked(node.node_index()) }
    }

    #[inline(always)]
    unsafe fn planes<S: Simd>(node: &Node, _: usize, row: u32) -> S::F8 {
        let bytes = std::ptr::from_ref(node).cast::<u8>();
        // SAFETY: planes come first in a node, in rows of eight; the caller vouches for the ISA.
        unsafe { S::F8::load(bytes.add(row as usize).cast()) }
    }

    #[inline(always)]
    fn names(node: &Node, _: &mut MaybeUninit<[u32; WIDTH]>) -> *const u32 {
        node.children.as_ptr().cast()
    }

    #[inline(always)]
    fn order(node: &Node) -> *const u32 {
        node.order.as_ptr()
    }

    #[inline(always)]
    unsafe fn leaf<S: Simd>(&self, leaf: ChildRef) -> Rows {
        // SAFETY: forwarded.
        Rows { rows: unsafe { self.leaf(leaf) }, count: leaf.leaf_count() }
    }
}

/// A leaf of an [`Mbvh`].
pub(super) struct Rows {
    rows: *const f32,
    count: usize,
}

impl Leaf for Rows {
    #[inline(always)]
    fn count(&self) -> usize {
        self.count
    }

    #[inline(always)]
    unsafe fn project<L: Four>(&self, first: usize, ray: &Shear) -> Projected<L> {
        // SAFETY: `rows` is a leaf of `count`; the caller vouches for the rest.
        unsafe { Projected::load(self.rows, self.count, first, ray) }
    }

    #[inline(always)]
    unsafe fn accurate_distance(&self, i: usize, ray: &Shear) -> f32 {
        // SAFETY: as above.
        unsafe { accurate_distance(self.rows, self.count, i, ray) }
    }

    #[inline(always)]
    unsafe fn number(&self, i: usize) -> u32 {
        // SAFETY: row 9 of the leaf holds `count` numbers.
        unsafe { self.rows.add(9 * self.count + i).read().to_bits() }
    }

    /// Always: the leaf's box has been met.
    #[inline(always)]
    unsafe fn counts<S: Simd>(&self, _: usize, _: &RaySetup, _: f32) -> bool {
        true
    }
}
