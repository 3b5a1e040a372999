//! Memory layout of the 4-wide tree.

use crate::simd::prefetch;
use bytemuck::{Pod, Zeroable};
use glam::Vec3;

/// Most triangles that a leaf reference can name.
pub(crate) const MAX_LEAF: usize = 8;

/// Most binary levels from the root to a leaf: the builder falls back to halving below
/// [`SAH_DEPTH`], and 2^28 triangles are halved 28 times.
pub(crate) const MAX_DEPTH: usize = SAH_DEPTH + 28;

/// Levels on which the builder may follow the SAH freely.
pub(crate) const SAH_DEPTH: usize = 48;

/// Entries that a traversal stack can need: each level of the 4-wide tree leaves at most three
/// siblings behind, and a 4-wide level is at least one binary level.
pub(crate) const STACK_SIZE: usize = 3 * MAX_DEPTH + 1;

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

    pub(crate) fn node(index: usize) -> Self {
        debug_assert!(index < 1 << 31);
        ChildRef(index as u32)
    }

    pub(crate) fn leaf(first_slot: usize, count: usize) -> Self {
        debug_assert!((1..=MAX_LEAF).contains(&count) && first_slot < (1 << 28) - 1);
        ChildRef(1 << 31 | (count as u32 - 1) << 28 | first_slot as u32)
    }

    /// Whether it names a leaf (or nothing).
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

/// A 4-wide node, 128 bytes, two cache lines.
///
/// ```text
/// byte   0  x: four minima (f32), four maxima
///       32  y: four minima, four maxima
///       64  z: four minima, four maxima
///       96  four child references (u32)
///      112  unused
/// ```
///
/// The minima and maxima of an axis lie side by side, so that one 256-bit operation tests the near
/// and far planes of four boxes. Missing children have minima +inf, maxima −inf: no ray hits them.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C, align(64))]
pub struct Node {
    pub bounds: [[f32; 8]; 3],
    pub children: [ChildRef; 4],
    pub unused: [u32; 4],
}

impl Node {
    pub(crate) const EMPTY: Node = Node {
        bounds: [[
            f32::INFINITY,
            f32::INFINITY,
            f32::INFINITY,
            f32::INFINITY,
            f32::NEG_INFINITY,
            f32::NEG_INFINITY,
            f32::NEG_INFINITY,
            f32::NEG_INFINITY,
        ]; 3],
        children: [ChildRef::EMPTY; 4],
        unused: [0; 4],
    };
}

/// Floats that leaf loads may read beyond a leaf's end.
pub(crate) const LEAF_PAD: usize = 16;

/// Floats per triangle in a leaf: nine coordinates and the number.
pub(crate) const LEAF_STRIDE: usize = 10;

/// The 4-wide tree that the kernels traverse. Node 0 is the root.
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
pub struct Mbvh {
    pub(crate) nodes: Vec<Node>,
    pub(crate) leaves: Vec<f32>,
    pub(crate) bounds: (Vec3, Vec3),
}

impl Mbvh {
    /// Lower and upper corner of the box around all triangles.
    pub fn bounds(&self) -> (Vec3, Vec3) {
        self.bounds
    }

    /// Number of 4-wide nodes.
    pub fn node_count(&self) -> usize {
        self.nodes.len()
    }

    /// Bytes of nodes and leaves.
    pub fn bytes(&self) -> usize {
        self.nodes.len() * size_of::<Node>() + self.leaves.len() * size_of::<f32>()
    }

    /// Asks for the memory of a child that will be visited soon.
    #[inline(always)]
    pub(crate) fn prefetch(&self, child: ChildRef) {
        let p = if child.is_leaf() {
            self.leaves.as_ptr().wrapping_add(LEAF_STRIDE * child.leaf_slot()).cast::<u8>()
        } else {
            self.nodes.as_ptr().wrapping_add(child.node_index()).cast::<u8>()
        };
        prefetch(p);
        prefetch(p.wrapping_add(64));
    }

    /// Pointer to the first row of a leaf; [`LEAF_PAD`] floats behind the last leaf are readable.
    #[inline(always)]
    pub(crate) fn leaf(&self, leaf: ChildRef) -> *const f32 {
        debug_assert!(LEAF_STRIDE * (leaf.leaf_slot() + leaf.leaf_count()) + LEAF_PAD <= self.leaves.len());
        // SAFETY: leaf references come from the builder, which made the rows they name.
        unsafe { self.leaves.as_ptr().add(LEAF_STRIDE * leaf.leaf_slot()) }
    }
}
