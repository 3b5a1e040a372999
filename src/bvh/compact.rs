//! The compact tree (Ylitie, Karras and Laine, *Efficient Incoherent Ray Traversal on GPUs Through Compressed Wide
//! BVHs*, 2017): boxes of children are quantised to bytes on a grid over the node's own box, their order follows from
//! their slot in the node, and leaves hold triangle numbers, whose corners are read from the meshes.
//!
//! Unlike in the paper, grids start at a float and boxes are decoded to floats, and these boxes contain those of
//! [`Node`]: so the box test is that of full nodes and as conservative.

use super::layout::{ChildRef, Node, WIDTH};
use crate::base::array::Array;
use crate::base::error::Result;
use crate::base::geometry::half_area;
use crate::base::memory::{try_collect, try_to_vec};
use crate::base::parallel::ParallelLoop;
use crate::base::progress::Progress;
use crate::base::scratch_files::Storage;
use bytemuck::{Pod, Zeroable};
use glam::Vec3;
use rayon::prelude::*;
use std::hint::select_unpredictable;

/// An 8-wide node in 80 bytes.
///
/// ```text
/// byte   0  lower corner of the grid (three f32)
///       12  cell size per axis: exponents of powers of two, biased as those of f32
///       15  bit i: there is a child i
///       16  number of the first inner child (u32); the others follow it
///       20  first triangle slot of the leaves (bits 0 to 27; bit 31 is set); those of the others follow
///       24  eight children: bit 7: is a leaf; bits 0 to 5: nodes or triangle slots after the first
///       32  minima of x in cells (eight u8), of y, of z
///       56  maxima of x, of y, of z
/// ```
///
/// Child i lies towards the corner of the node that bits 0 to 2 of i name (bit a: the greater end of axis
/// a). Rays of octant o visit children in the order of i xor o.
///
/// Missing children have minima 255, maxima 0. A ray from very far may take that for a box, so they refer to a leaf of
/// the node, which can be visited twice: only nodes that have no inner child lack any.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C, align(16))]
pub(crate) struct CompactNode {
    pub(crate) origin: [f32; 3],
    exponents: [u8; 3],
    present: u8,
    first_node: u32,
    first_leaf: u32,
    children: [u8; WIDTH],
    pub(crate) lower: [[u8; WIDTH]; 3],
    upper: [[u8; WIDTH]; 3],
}

const LEAF: u8 = 1 << 7;

/// The [`Node::order`] of all compact nodes.
pub(crate) static ORDER: [u32; WIDTH] = {
    let mut order = [0; WIDTH];
    let mut place = 0;
    while place < WIDTH {
        let mut octant = 0;
        while octant < 8 {
            order[place] |= ((WIDTH - 1 - place) as u32 ^ octant) << (3 * octant);
            octant += 1;
        }
        place += 1;
    }
    order
};

/// Mask of the triangle number in an entry of [`Compact::triangles`].
pub(crate) const NUMBER: u32 = (1 << 28) - 1;

/// Flag: the triangle is the last of its leaf.
pub(crate) const LAST: u32 = 1 << 31;

/// Flag: the triangle is degenerate or not finite since a refit and cannot be hit.
pub(crate) const GONE: u32 = 1 << 30;

impl CompactNode {
    /// Makes a node from a full one, with the first node and the first slot below it.
    pub(super) fn new(node: &Node, first_node: u32, first_slot: u32) -> CompactNode {
        let mut compact = CompactNode::zeroed();
        (compact.first_node, compact.first_leaf) = (first_node, ChildRef::leaf(first_slot as usize, 1).bits());
        let places = places(node);
        // Children are moved to their slots.
        let mut placed = Node::EMPTY;
        for (child, &place) in places.iter().enumerate() {
            let reference = node.children[child];
            if reference == ChildRef::EMPTY {
                continue;
            }
            compact.present |= 1 << place;
            compact.children[place] = if reference.is_leaf() {
                LEAF | (reference.leaf_slot() - first_slot as usize) as u8
            } else {
                (reference.node_index() - first_node as usize) as u8
            };
            for axis in 0..3 {
                placed.lower[axis][place] = node.lower[axis][child];
                placed.upper[axis][place] = node.upper[axis][child];
            }
        }
        if compact.present != u8::MAX {
            let missing = (0..WIDTH).filter(|i| compact.present >> i & 1 == 0);
            debug_assert!(compact.inner().next().is_none());
            missing.for_each(|i| compact.children[i] = LEAF);
        }
        compact.set_boxes(&placed);
        compact
    }

    /// Sets the boxes of the children, in the order of this node, so that they contain those of `node`.
    pub(super) fn set_boxes(&mut self, node: &Node) {
        for axis in 0..3 {
            let (lower, upper) = (&node.lower[axis], &node.upper[axis]);
            let least = lower.iter().copied().fold(f32::INFINITY, f32::min);
            let most = upper.iter().copied().fold(f32::NEG_INFINITY, f32::max);
            (self.lower[axis], self.upper[axis]) = ([u8::MAX; WIDTH], [0; WIDTH]);
            if least > most {
                (self.origin[axis], self.exponents[axis]) = (0.0, 1);
                continue;
            }
            self.origin[axis] = least;
            // The least power of two that is a 255th of the extent, or a normal number.
            let cell = (f64::from(most) - f64::from(least)) / 255.0;
            self.exponents[axis] = (cell.log2().ceil().clamp(-126.0, 127.0) as i32 + 127) as u8;
            let decode = |this: &Self, cells: u8| this.origin[axis] + cells as f32 * this.cell(axis);
            while decode(self, u8::MAX) < most {
                self.exponents[axis] += 1;
            }
            for i in (0..WIDTH).filter(|&i| lower[i] <= upper[i]) {
                let cells = |x: f32| (f64::from(x) - f64::from(least)) / f64::from(self.cell(axis));
                // Decoding rounds, possibly inwards. 0 is `least` itself, and 255 is `most` or more.
                let mut below = cells(lower[i]) as u8;
                while decode(self, below) > lower[i] {
                    below -= 1;
                }
                let mut above = cells(upper[i]).ceil() as u8;
                while decode(self, above) < upper[i] {
                    above += 1;
                }
                (self.lower[axis][i], self.upper[axis][i]) = (below, above);
            }
        }
    }

    /// Edge length of a cell of the grid.
    #[inline(always)]
    pub(crate) fn cell(&self, axis: usize) -> f32 {
        f32::from_bits((self.exponents[axis] as u32) << 23)
    }

    /// References to the children; every leaf's reference says that it holds one triangle.
    #[inline(always)]
    pub(crate) fn names(&self) -> [u32; WIDTH] {
        let mut names = [0; WIDTH];
        // (A loop: `map` was not vectorised.)
        for i in 0..WIDTH {
            let child = self.children[i] as u32;
            let first = if child & LEAF as u32 != 0 { self.first_leaf } else { self.first_node };
            names[i] = first.wrapping_add(child & !(LEAF as u32));
        }
        names
    }

    fn children(&self) -> impl Iterator<Item = (usize, ChildRef)> + use<> {
        let (present, names) = (self.present, self.names());
        (0..WIDTH).filter(move |i| present >> i & 1 == 1).map(move |i| (i, ChildRef::from_bits(names[i])))
    }

    /// The leaves, with their slots in the node.
    pub(super) fn leaves(&self) -> impl Iterator<Item = (usize, ChildRef)> + use<> {
        self.children().filter(|(_, c)| c.is_leaf())
    }

    /// The inner children, with their slots in the node.
    pub(super) fn inner(&self) -> impl Iterator<Item = (usize, ChildRef)> + use<> {
        self.children().filter(|(_, c)| !c.is_leaf())
    }

    /// The children, with lower and upper corner of their boxes as rays test them.
    pub(super) fn boxes(&self) -> impl Iterator<Item = (ChildRef, (Vec3, Vec3))> + '_ {
        self.children().map(|(i, child)| (child, self.decoded(i).into()))
    }

    /// What takes the places of missing children.
    pub(super) fn missing(&self) -> impl Iterator<Item = ChildRef> + use<> {
        let (present, names) = (self.present, self.names());
        (0..WIDTH).filter(move |i| present >> i & 1 == 0).map(move |i| ChildRef::from_bits(names[i]))
    }

    /// Lower and upper corner of the box of child `i` as rays test it.
    fn decoded(&self, i: usize) -> [Vec3; 2] {
        [&self.lower, &self.upper].map(|rows| {
            Vec3::from_array([0, 1, 2].map(|axis| self.origin[axis] + rows[axis][i] as f32 * self.cell(axis)))
        })
    }
}

/// Slot of each child of a node: the one towards whose corner its centre lies farthest; the clearest cases are assigned
/// first.
fn places(node: &Node) -> [usize; WIDTH] {
    let is_there = |i: usize| node.lower[0][i] <= node.upper[0][i];
    let centre = |i: usize| Vec3::from_array([0, 1, 2].map(|a| 0.5 * node.lower[a][i] + 0.5 * node.upper[a][i]));
    let there = (0..WIDTH).filter(|&i| is_there(i));
    let (lower, upper) = there.fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(l, u), i| {
        let corner = |b: &[[f32; WIDTH]; 3]| Vec3::new(b[0][i], b[1][i], b[2][i]);
        (l.min(corner(&node.lower)), u.max(corner(&node.upper)))
    });
    let middle = 0.5 * lower + 0.5 * upper;
    let gains: [[f32; WIDTH]; WIDTH] = std::array::from_fn(|child| {
        if !is_there(child) {
            return [0.0; WIDTH];
        }
        let c = centre(child) - middle;
        std::array::from_fn(|place| (0..3).map(|axis| if place >> axis & 1 == 1 { c[axis] } else { -c[axis] }).sum())
    });
    let mut places = [WIDTH; WIDTH];
    let mut is_taken = [false; WIDTH];
    // Existing children come first, so that missing ones get the remaining slots.
    for wanted in [true, false] {
        for _ in (0..WIDTH).filter(|&i| is_there(i) == wanted) {
            let mut best = (f32::NEG_INFINITY, 0, 0);
            for child in (0..WIDTH).filter(|&i| places[i] == WIDTH && is_there(i) == wanted) {
                for place in (0..WIDTH).filter(|&p| !is_taken[p]) {
                    if gains[child][place] > best.0 {
                        best = (gains[child][place], child, place);
                    }
                }
            }
            (places[best.1], is_taken[best.2]) = (best.2, true);
        }
    }
    places
}

/// Number of entries that may be read behind the last leaf.
pub(super) const PAD: usize = WIDTH - 1;

/// Number of triangles whose mesh is looked up together: see [`Compact::mesh_range`].
const BLOCK: u32 = 1 << 8;

/// The tree of [`CompactNode`]s. Node 0 is the root.
pub(crate) struct Compact {
    pub(crate) nodes: Array<CompactNode>,
    /// Global triangle numbers, leaf by leaf, with the flags [`LAST`] and [`GONE`]; [`PAD`] more entries follow the
    /// last leaf.
    pub(crate) triangles: Array<u32>,
    pub(super) bounds: (Vec3, Vec3),
    /// The mesh of every 256th triangle.
    blocks: Vec<u32>,
}

impl Compact {
    /// Copies the tree; fails if there is not enough memory.
    pub(super) fn copy(&self, storage: Storage, progress: &Progress) -> Result<Compact> {
        let what = "a copy of the tree";
        let (nodes, triangles) =
            (storage.copy(&self.nodes, what, progress)?, storage.copy(&self.triangles, what, progress)?);
        nodes.at_random();
        triangles.at_random();
        Ok(Compact { nodes, triangles, bounds: self.bounds, blocks: try_to_vec(&self.blocks, what)? })
    }

    /// Makes a tree of its arrays; `meshes`: the first triangle of each mesh, and the number of all triangles at the end.
    pub(crate) fn new(
        nodes: Array<CompactNode>,
        triangles: Array<u32>,
        bounds: (Vec3, Vec3),
        meshes: &[u32],
    ) -> Result<Compact> {
        let total = *meshes.last().expect("never empty");
        let mesh = |t: u32| meshes.partition_point(|&first| first <= t) as u32 - 1;
        // One more, for the end of the last block.
        let blocks = (0..=total.div_ceil(BLOCK)).map(|b| mesh((b * BLOCK).min(total - 1)));
        Ok(Compact { nodes, triangles, bounds, blocks: try_collect(blocks, "the tree")? })
    }

    pub(crate) fn bounds(&self) -> (Vec3, Vec3) {
        self.bounds
    }

    pub(crate) fn node_count(&self) -> usize {
        self.nodes.len()
    }

    pub(crate) fn node_bytes(&self) -> usize {
        size_of_val(&self.nodes[..])
    }

    pub(crate) fn bytes(&self) -> usize {
        self.node_bytes() + size_of_val(&self.triangles[..]) + size_of_val(&self.blocks[..])
    }

    /// First and last mesh that may contain a triangle.
    ///
    /// # Safety
    /// The triangle must be one of the scene.
    #[inline(always)]
    pub(crate) unsafe fn mesh_range(&self, triangle: u32) -> (u32, u32) {
        let block = (triangle / BLOCK) as usize;
        debug_assert!(block + 1 < self.blocks.len());
        // SAFETY: there is an entry for the block of every triangle and one more; the caller vouches for the
        // triangle.
        unsafe { (*self.blocks.get_unchecked(block), *self.blocks.get_unchecked(block + 1)) }
    }

    /// A node, without a check.
    ///
    /// # Safety
    /// `node` must come from a node of this tree, or be the root.
    #[inline(always)]
    pub(crate) unsafe fn node(&self, node: ChildRef) -> &CompactNode {
        debug_assert!(node.node_index() < self.nodes.len());
        // SAFETY: inner references of the tree are in range.
        unsafe { self.nodes.get_unchecked(node.node_index()) }
    }

    /// Pointer to the numbers of a leaf; [`MAX_LEAF`](super::layout::MAX_LEAF) of them are readable.
    ///
    /// # Safety
    /// `leaf` must be a leaf of this tree.
    #[inline(always)]
    pub(crate) unsafe fn leaf(&self, leaf: ChildRef) -> *const u32 {
        debug_assert!(leaf.leaf_slot() < self.triangles.len());
        // SAFETY: the caller vouches for the reference; the builder made the numbers that it names.
        unsafe { self.triangles.as_ptr().add(leaf.leaf_slot()) }
    }

    /// Address of the node or leaf of a reference.
    #[inline(always)]
    pub(crate) fn address(&self, child: ChildRef) -> *const u8 {
        let leaf = self.triangles.as_ptr().wrapping_add(child.leaf_slot()).cast();
        let node = self.nodes.as_ptr().wrapping_add(child.node_index()).cast();
        select_unpredictable(child.is_leaf(), leaf, node)
    }

    /// The triangle numbers of a leaf.
    pub(super) fn leaf_triangles(&self, leaf: ChildRef) -> &[u32] {
        let all = &self.triangles[leaf.leaf_slot()..];
        let last = all.iter().position(|t| t & LAST != 0).expect("every leaf ends");
        &all[..=last]
    }

    /// Cost as [`super::Mbvh::sah_cost`]; here of the decoded boxes, which are larger.
    pub(crate) fn sah_cost(&self) -> f32 {
        let cost = |node: &CompactNode| -> f64 {
            let child = |(i, c): (usize, ChildRef)| {
                let [lower, upper] = node.decoded(i);
                let n = if c.is_leaf() { self.leaf_triangles(c).len() as f64 } else { 1.0 };
                if lower.x > upper.x { 0.0 } else { half_area(lower, upper) * n }
            };
            node.children().map(child).sum()
        };
        let chunks: Vec<f64> = self.nodes.par_chunks(1 << 10).map(|nodes| nodes.iter().map(cost).sum()).collected();
        (1.0 + chunks.iter().sum::<f64>() / half_area(self.bounds.0, self.bounds.1)) as f32
    }
}

#[cfg(test)]
mod tests {
    use super::super::BinaryBvh;
    use super::super::collapse::{collapse, collapse_compact};
    use super::super::layout::LEAF_STRIDE;
    use super::super::{BuildOptions, Mbvh};
    use super::*;
    use crate::base::progress::Progress;
    use crate::base::sampling::uniform;
    use proptest::prelude::*;

    fn soup(n: u32, seed: u32, scale: f32) -> Vec<[Vec3; 3]> {
        let point = |i, k: u32| Vec3::from_array([0, 1, 2].map(|a| uniform(i, k + a, seed))) * 2.0 - 1.0;
        (0..n).map(|i| [3, 6, 9].map(|k| (point(i, 0) + 0.1 * point(i, k)) * scale)).collect()
    }

    fn trees(corners: &[[Vec3; 3]], max_leaf: u32, split: bool) -> (Mbvh, Compact) {
        let n = corners.len() as u32;
        let (ids, options) = ((0..n).collect::<Vec<u32>>(), BuildOptions { max_leaf, ..Default::default() });
        let (none, of) = (Progress::none(), |t: u32| corners[t as usize]);
        let build = if split { BinaryBvh::build_spatial } else { BinaryBvh::build };
        let binary = build(&of, &ids, &options, &none).unwrap();
        (collapse(&binary, &of, &none).unwrap(), collapse_compact(&binary, &[0, n], &none).unwrap())
    }

    #[test]
    fn a_node_has_the_bytes_that_are_drawn() {
        assert_eq!(size_of::<CompactNode>(), 80);
        assert_eq!(std::mem::offset_of!(CompactNode, present), 15);
        assert_eq!(std::mem::offset_of!(CompactNode, first_leaf), 20);
        assert_eq!(std::mem::offset_of!(CompactNode, children), 24);
        assert_eq!(std::mem::offset_of!(CompactNode, lower), 32);
        assert_eq!(std::mem::offset_of!(CompactNode, upper), 56);
    }

    #[test]
    fn rays_of_an_octant_come_to_the_corner_that_they_come_from_first() {
        for octant in 0..8u32 {
            let far_to_near = ORDER.map(|o| (o >> (3 * octant) & 7) as usize);
            let mut sorted = far_to_near;
            sorted.sort_unstable();
            assert_eq!(sorted, [0, 1, 2, 3, 4, 5, 6, 7]);
            // The nearest place is on the lesser side where the ray goes up, on the greater where it goes down.
            assert_eq!((far_to_near[7], far_to_near[0]), (octant as usize, 7 - octant as usize));
        }
    }

    #[test]
    fn compact_trees_have_the_leaves_of_whole_ones_in_boxes_around_theirs() {
        for (n, scale) in [(1, 1.0), (2, 1e-18), (7, 1e11), (3000, 1.0), (3000, -1e-18), (3000, 1e11)] {
            for (max_leaf, split) in [(1, false), (4, true), (8, false)] {
                let (whole, compact) = trees(&soup(n, 1, scale), max_leaf, split);
                assert_eq!((whole.nodes.len(), whole.bounds), (compact.nodes.len(), compact.bounds));
                for (a, b) in whole.nodes.iter().zip(&compact.nodes) {
                    let there = a.children.iter().filter(|c| **c != ChildRef::EMPTY).count();
                    assert_eq!(b.children().count(), there);
                    for (i, c) in b.children() {
                        let is_same = |&k: &usize| match a.children[k] {
                            ChildRef::EMPTY => false,
                            r if r.is_leaf() => c.is_leaf() && r.leaf_slot() == c.leaf_slot(),
                            r => r == c,
                        };
                        let k = (0..WIDTH).find(is_same).expect("the child is there");
                        let [lower, upper] = b.decoded(i);
                        for axis in 0..3 {
                            assert!(lower[axis] <= a.lower[axis][k] && a.upper[axis][k] <= upper[axis]);
                            let slack = b.cell(axis) * 4.0
                                + 4.0 * f32::EPSILON * a.upper[axis][k].abs().max(a.lower[axis][k].abs());
                            assert!(upper[axis] - lower[axis] <= a.upper[axis][k] - a.lower[axis][k] + slack);
                        }
                        if c.is_leaf() {
                            let (slot, count) = (c.leaf_slot(), a.children[k].leaf_count());
                            let rows = &whole.leaves[slot * LEAF_STRIDE + 9 * count..][..count];
                            let numbers = compact.leaf_triangles(c).iter().map(|t| t & NUMBER);
                            assert!(numbers.eq(rows.iter().map(|x| x.to_bits())));
                        }
                    }
                }
                let cost = compact.sah_cost() / whole.sah_cost();
                assert!((0.999..1.2).contains(&cost), "{n} {scale} {max_leaf}: {cost}");
            }
        }
    }

    #[test]
    fn a_compact_tree_takes_80_bytes_per_node_and_4_per_triangle() {
        let (whole, compact) = trees(&soup(20_000, 1, 1.0), 4, false);
        // And one number for every 256 triangles.
        assert_eq!(compact.bytes(), 80 * whole.nodes.len() + 4 * (20_000 + PAD) + 4 * (79 + 1));
    }

    #[test]
    fn the_mesh_of_a_triangle_is_in_its_range() {
        // Meshes of 0, 1, 300, 3, 0, 2000 and 1 triangles.
        let firsts = [0, 0, 1, 301, 304, 304, 2304, 2305];
        let tree = Compact::new(Vec::new().into(), Vec::new().into(), (Vec3::ZERO, Vec3::ZERO), &firsts).unwrap();
        for t in 0..2305 {
            let mesh = firsts.partition_point(|&first| first <= t) as u32 - 1;
            // SAFETY: a triangle of the meshes that the tree was built of.
            let (first, last) = unsafe { tree.mesh_range(t) };
            assert!((first..=last).contains(&mesh), "{t}: {mesh}, {first} to {last}");
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 2000, failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn boxes_of_any_size_anywhere_are_contained(
            origin in prop::array::uniform3(prop_oneof![Just(0.0f32), -1e12f32..1e12, -1f32..1.0, -1e-18f32..1e-18]),
            extents in prop::collection::vec(prop::array::uniform6(0f32..1.0), 1..=8),
            exponents in prop::array::uniform3(-70i32..40),
        ) {
            let mut node = Node::EMPTY;
            for (i, e) in extents.iter().enumerate() {
                node.children[i] = ChildRef::leaf(i, 1);
                for axis in 0..3 {
                    let scale = 2f32.powi(exponents[axis]);
                    node.lower[axis][i] = origin[axis] + e[axis] * scale;
                    node.upper[axis][i] = node.lower[axis][i] + e[axis + 3] * scale;
                }
            }
            let compact = CompactNode::new(&node, 0, 0);
            for (i, c) in compact.children() {
                let [lower, upper] = compact.decoded(i);
                for axis in 0..3 {
                    let k = c.leaf_slot();
                    prop_assert!(lower[axis] <= node.lower[axis][k] && node.upper[axis][k] <= upper[axis]);
                }
            }
            prop_assert_eq!(compact.children().count(), extents.len());
        }
    }
}
