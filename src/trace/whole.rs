//! Rays through the full tree, [`Mbvh`].

use super::tree::{Leaf, LeafRows, RaySetup, Tree};
use super::triangle::{Projected, Shear, accurate_distance};
use crate::bvh::layout::{ChildRef, Mbvh, Node, WIDTH};
use crate::simd::{Four, Lanes, Simd};
use std::mem::MaybeUninit;

macro_rules! tree {
    ($width:literal, $lanes:ident, $whole:expr) => {
        impl Tree for Mbvh<$width> {
            type Node = Node<$width>;
            type Leaf<'a> = Rows;

            const WIDTH: usize = $width;
            type Lanes<S: Simd> = S::$lanes;
            const ROW: u32 = 4 * $width;
            const IS_BY_WORTH: bool = true;

            #[inline(always)]
            fn prefetch(&self, child: ChildRef) {
                self.prefetch(child);
            }

            #[inline(always)]
            fn prefetch_whole(&self, child: ChildRef) {
                self.prefetch_whole(child);
            }

            #[inline(always)]
            unsafe fn node(&self, node: ChildRef) -> &Node<$width> {
                debug_assert!(node.node_index() < self.nodes.len());
                // SAFETY: inner references of the tree are in range.
                unsafe { self.nodes.get_unchecked(node.node_index()) }
            }

            #[inline(always)]
            unsafe fn planes<S: Simd>(node: &Node<$width>, _: usize, row: u32) -> S::$lanes {
                let bytes = std::ptr::from_ref(node).cast::<u8>();
                // SAFETY: planes come first in a node, in rows of `$width`; the caller vouches for the ISA.
                unsafe { S::$lanes::load(bytes.add(row as usize).cast()) }
            }

            #[inline(always)]
            fn names(node: &Node<$width>, _: &mut MaybeUninit<[u32; WIDTH]>) -> *const u32 {
                node.children.as_ptr().cast()
            }

            #[inline(always)]
            fn order(node: &Node<$width>) -> *const u32 {
                node.order.as_ptr()
            }

            #[inline(always)]
            fn whole(&self) -> Option<&Mbvh> {
                $whole(self)
            }

            #[inline(always)]
            unsafe fn leaf<S: Simd>(&self, leaf: ChildRef) -> Rows {
                // SAFETY: forwarded.
                Rows { rows: unsafe { self.leaf(leaf) }, count: leaf.leaf_count() }
            }
        }
    };
}

tree!(8, F8, Some);
#[cfg(any(test, feature = "reference"))]
tree!(4, F4, |_| None);

/// A leaf of an [`Mbvh`].
pub(super) struct Rows {
    rows: *const f32,
    count: usize,
}

impl Leaf for Rows {
    const ALWAYS_COUNTS: bool = true;

    #[inline(always)]
    fn rows(&self, _: &mut MaybeUninit<LeafRows>) -> *const f32 {
        self.rows
    }

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

    /// Always true: the leaf's box has been tested.
    #[inline(always)]
    unsafe fn counts<S: Simd>(&self, _: usize, _: &RaySetup, _: f32) -> bool {
        true
    }
}
