//! Groups of rays of a [stream](super::stream) whose directions lie in one octant, and the boxes of a node's children as
//! such rays meet them: what lists and [beams](super::beams) share.

use super::tree::Tree;
use super::triangle::AXES;
use crate::simd::{Lanes, Simd};

/// The rays of one octant.
pub(super) struct Group {
    /// Bit a: component a of the directions is negative.
    pub octant: usize,
    /// Place of the first ray in the stream's order.
    pub begin: usize,
    /// Where rays with the longest axis x, y and z begin in the group, and where they end.
    pub runs: [usize; 4],
}

impl Group {
    /// `starts`: where the rays of each octant and axis begin in the stream's order, and where all end.
    pub(super) fn new(octant: usize, starts: &[usize]) -> Group {
        let begin = starts[3 * octant];
        Group { octant, begin, runs: std::array::from_fn(|axis| starts[3 * octant + axis] - begin) }
    }

    pub(super) fn end(&self) -> usize {
        self.begin + self.len()
    }

    pub(super) fn len(&self) -> usize {
        self.runs[3]
    }

    /// [`Shear::axes`] of rays whose longest axis is `axis`.
    pub(super) fn axes(&self, axis: usize) -> &'static [u32; 3] {
        axes_of(self.octant, axis)
    }
}

/// [`Shear::axes`] of rays of an octant whose longest axis is `axis`.
pub(super) fn axes_of(octant: usize, axis: usize) -> &'static [u32; 3] {
    &AXES[if octant >> axis & 1 != 0 { axis + 3 } else { axis }]
}

/// The planes of a node's children that rays of an octant reach first and last, by axis.
pub(super) struct ChildBoxes<L> {
    pub near: [L; 3],
    pub far: [L; 3],
}

impl<L: Lanes> ChildBoxes<L> {
    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    pub(super) unsafe fn new<S: Simd, T: Tree<Lanes<S> = L>>(node: &T::Node, octant: usize) -> Self {
        let row = |a: usize, far: bool| T::ROW * (a as u32 + if (octant >> a & 1 != 0) != far { 3 } else { 0 });
        // SAFETY: forwarded; rows are those of the axes.
        unsafe {
            ChildBoxes {
                near: [
                    T::planes::<S>(node, 0, row(0, false)),
                    T::planes::<S>(node, 1, row(1, false)),
                    T::planes::<S>(node, 2, row(2, false)),
                ],
                far: [
                    T::planes::<S>(node, 0, row(0, true)),
                    T::planes::<S>(node, 1, row(1, true)),
                    T::planes::<S>(node, 2, row(2, true)),
                ],
            }
        }
    }
}
