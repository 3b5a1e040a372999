//! What single rays need of a tree: the whole one of [`Mbvh`], or the [compact](super::compact) one. Kernels
//! are compiled for each; which of them runs is chosen once per call.
//!
//! The box test is conservative (Ize, *Robust BVH Ray Traversal*, 2013): the builder moves planes, and
//! a ray its origin, by more than rounding can.

use super::Ray;
use super::triangle::{Projected, Shear};
use crate::bvh::layout::{ChildRef, WIDTH};
use crate::simd::{Four, Lanes, Mask, Simd};
use glam::Vec3;
use std::hint::select_unpredictable;
use std::marker::PhantomData;
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

/// Ize's 1 + 2γ₃ for box tests that subtract the origin from planes, rounded up.
pub(super) const FAR_SCALE: f32 = 1.0 + 4e-7;

/// A box is entered up to this distance: a triangle's t has a larger rounding error than its box's, and
/// of triangles at equal t all must be seen.
#[inline(always)]
pub(super) fn beyond(t: f32) -> f32 {
    t + BEYOND * t.abs()
}

/// See [`beyond`].
pub(super) const BEYOND: f32 = 4e-6;

/// A direction component below this fraction of the largest counts as zero in box tests.
pub(super) const PARALLEL: f32 = 1e-18;

/// Reciprocal of a zero component: with [`nudge`] its product is beyond any t, but never NaN.
pub(super) const PARALLEL_RECIPROCAL: f32 = 1e38;

/// How far box planes are moved outwards for rays along them, so that an origin on a plane counts
/// as inside on both sides: over an ulp, and over what `PARALLEL_RECIPROCAL` needs to reach 1e18.
#[inline(always)]
pub(super) fn nudge(origin: f32) -> f32 {
    (origin.abs() * 2.4e-7).max(1e-20)
}

/// One instruction, where `f32::max` takes four to treat NaN.
#[inline(always)]
fn greater(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

/// Likewise.
#[inline(always)]
fn lesser(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

/// Rays from beyond this hit nothing: products of two distances to them would overflow.
pub(super) const FARTHEST_ORIGIN: f32 = 1e18;

/// The power of two that brings a direction's largest component into a range where the reciprocals and
/// products of the tests neither overflow nor vanish; `None` for a ray that can hit nothing.
#[inline(always)]
pub(super) fn direction_scale(ray: &Ray) -> Option<f32> {
    let ([x, y, z], [ox, oy, oz]) = (ray.direction, ray.origin);
    let largest = greater(greater(x.abs(), y.abs()), z.abs());
    // Any NaN or infinity makes this NaN; a maximum alone would lose a NaN. Origins become infinite from
    // `FARTHEST_ORIGIN` on.
    const FAR: f32 = f32::MAX / FARTHEST_ORIGIN;
    let zero = (0.0 * x + 0.0 * y + 0.0 * z) + (0.0 * (ox * FAR) + 0.0 * (oy * FAR) + 0.0 * (oz * FAR));
    if zero != 0.0 || largest == 0.0 {
        return None;
    }
    if (1e-6..=1e6).contains(&largest) {
        return Some(1.0);
    }
    // The power of two is exact: scaling the direction changes no bit of the geometry.
    let exponent = (largest.log2().floor() as i32).clamp(-126, 126);
    Some(2f32.powi(-exponent))
}

/// A ray whose direction has a component below this fraction of the largest takes the slower box test.
pub(super) const STEEP: f32 = 1e-10;

/// Rounding of one operation.
pub(super) const EPSILON: f32 = f32::EPSILON / 2.0;

/// Bound, as a part of the product of origin and reciprocal, of its rounding, of the reciprocal's, of the
/// box test's fused sum and of the sum with this, and some to spare. (The builder has moved planes outwards
/// by their own share.)
pub(super) const OFFSET_ERROR: f32 = 6.0 * EPSILON;

/// What a ray is for the tests.
#[derive(Clone, Copy)]
pub(super) struct RaySetup {
    /// t of a plane is `reciprocal` · plane + `near_offset` or `far_offset`: minus the origin's, less or
    /// more what rounding that may have cost. In the slower test, offsets are origins.
    reciprocal: [f32; 3],
    near_offset: [f32; 3],
    far_offset: [f32; 3],
    /// Bytes from the first row of a node's planes to the near and far ones, per axis.
    near: [u32; 3],
    far: [u32; 3],
    /// Of the direction's octant in [`Tree::order`].
    pub(super) shift: u32,
    is_slow: bool,
    pub(super) tmin: f32,
    pub(super) shear: Shear,
}

impl RaySetup {
    /// If [`must_be_slow`](Self::must_be_slow), then [`make_slow`](Self::make_slow). (All axes in one vector by
    /// hand take no fewer instructions.)
    #[inline(always)]
    pub(super) fn new<T: Tree>(origin: [f32; 3], direction: [f32; 3], tmin: f32) -> Self {
        let shear = Shear::new(origin, direction);
        let is_negative = direction.map(|d| d < 0.0);
        let reciprocal = direction.map(|d| 1.0 / d);
        let offset: [f32; 3] = std::array::from_fn(|a| -origin[a] * reciprocal[a]);
        let error: [f32; 3] = std::array::from_fn(|a| OFFSET_ERROR * offset[a].abs());
        // (Half of the branches that this became were mispredicted.)
        let near =
            std::array::from_fn(|a| select_unpredictable(is_negative[a], T::ROW * (a as u32 + 3), T::ROW * a as u32));
        RaySetup {
            reciprocal,
            near_offset: std::array::from_fn(|a| offset[a] - error[a]),
            far_offset: std::array::from_fn(|a| offset[a] + error[a]),
            near,
            far: std::array::from_fn(|a| T::ROW * (2 * a as u32 + 3) - near[a]),
            shift: 3 * (is_negative[0] as u32 | (is_negative[1] as u32) << 1 | (is_negative[2] as u32) << 2),
            is_slow: false,
            tmin,
            shear,
        }
    }

    #[inline(always)]
    pub(super) fn must_be_slow(direction: [f32; 3]) -> bool {
        let [x, y, z] = direction.map(f32::abs);
        lesser(lesser(x, y), z) <= STEEP * greater(greater(x, y), z)
    }

    /// Where a reciprocal is infinite or too large for [`Self::node`].
    #[cold]
    pub(super) fn make_slow<T: Tree>(&mut self, origin: [f32; 3], direction: [f32; 3]) {
        let [x, y, z] = direction.map(f32::abs);
        let parallel = PARALLEL * x.max(y).max(z);
        self.is_slow = true;
        (self.near_offset, self.far_offset) = (origin, origin);
        for a in 0..3 {
            if direction[a].abs() <= parallel {
                self.reciprocal[a] = PARALLEL_RECIPROCAL;
                self.near_offset[a] += nudge(origin[a]);
                self.far_offset[a] -= nudge(origin[a]);
                // The sign of a direction that is not quite 0 must not matter.
                self.near[a] = T::ROW * a as u32;
                self.far[a] = T::ROW * (a as u32 + 3);
            }
        }
    }

    /// Near distances of boxes, and which of them the ray meets up to `tmax`.
    ///
    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    pub(super) unsafe fn boxes<L: Lanes>(&self, boxes: &impl Boxes<L>, tmax: f32) -> (L, L::Mask) {
        // SAFETY: the caller vouches for the ISA; 0, 1 and 2 are axes.
        let ((nx, fx), (ny, fy), (nz, fz)) = unsafe {
            if self.is_slow {
                (self.slow_axis(boxes, 0), self.slow_axis(boxes, 1), self.slow_axis(boxes, 2))
            } else {
                (self.axis(boxes, 0), self.axis(boxes, 1), self.axis(boxes, 2))
            }
        };
        // SAFETY: the caller vouches for the ISA.
        let (tmin, tmax) = unsafe { (L::splat(self.tmin), L::splat(tmax)) };
        let near = nx.max(ny).max(nz.max(tmin));
        let far = fx.min(fy).min(fz.min(tmax));
        (near, near.le(far))
    }

    /// Distances of near and far planes across an axis. (A function: as a closure it was not inlined.)
    ///
    /// # Safety
    /// The CPU must have the ISA; the axis must be 0 to 2.
    #[inline(always)]
    unsafe fn axis<L: Lanes>(&self, boxes: &impl Boxes<L>, a: usize) -> (L, L) {
        // SAFETY: forwarded; rows are those of the axis.
        unsafe {
            let r = L::splat(self.reciprocal[a]);
            let near = boxes.planes(a, self.near[a]).mul_add(r, L::splat(self.near_offset[a]));
            let far = boxes.planes(a, self.far[a]).mul_add(r, L::splat(self.far_offset[a]));
            (near, far)
        }
    }

    /// The same of rays that are slow.
    ///
    /// # Safety
    /// As for [`Self::axis`].
    #[inline(always)]
    unsafe fn slow_axis<L: Lanes>(&self, boxes: &impl Boxes<L>, a: usize) -> (L, L) {
        // SAFETY: forwarded; rows are those of the axis.
        unsafe {
            let r = L::splat(self.reciprocal[a]);
            let near = (boxes.planes(a, self.near[a]) - L::splat(self.near_offset[a])) * r;
            let far = (boxes.planes(a, self.far[a]) - L::splat(self.far_offset[a])) * r;
            // Away from the near planes, on either side of the origin.
            (near, (far * L::splat(FAR_SCALE)).max(far * L::splat(2.0 - FAR_SCALE)))
        }
    }

    /// Whether the ray, set up for `T`, meets a box up to `tmax`, by the arithmetic that nodes meet.
    ///
    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    pub(super) unsafe fn meets<S: Simd, T: Tree>(&self, lower: Vec3, upper: Vec3, tmax: f32) -> bool {
        let one = OneBox::<T> { planes: [lower, upper], tree: PhantomData };
        // SAFETY: forwarded.
        unsafe { self.boxes::<S::F4>(&one, tmax) }.1.any()
    }
}

/// Boxes that rays are tested against.
pub(super) trait Boxes<L> {
    /// Planes across `axis`, of the row that begins at `row` as in [`Tree::planes`].
    ///
    /// # Safety
    /// As for [`Tree::planes`].
    unsafe fn planes(&self, axis: usize, row: u32) -> L;
}

/// The children of a node.
pub(super) struct Children<'a, S, T: Tree> {
    pub(super) node: &'a T::Node,
    pub(super) isa: PhantomData<S>,
}

impl<S: Simd, T: Tree> Boxes<S::F8> for Children<'_, S, T> {
    #[inline(always)]
    unsafe fn planes(&self, axis: usize, row: u32) -> S::F8 {
        // SAFETY: forwarded.
        unsafe { T::planes::<S>(self.node, axis, row) }
    }
}

/// One box, in all lanes.
struct OneBox<T> {
    planes: [Vec3; 2],
    tree: PhantomData<T>,
}

impl<L: Lanes, T: Tree> Boxes<L> for OneBox<T> {
    #[inline(always)]
    unsafe fn planes(&self, axis: usize, row: u32) -> L {
        // SAFETY: forwarded.
        unsafe { L::splat(self.planes[(row >= 3 * T::ROW) as usize][axis]) }
    }
}
