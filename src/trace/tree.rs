//! The interface through which single rays traverse a tree: the full one, [`Mbvh`], or the [compact](super::compact)
//! one. Kernels are compiled for each; which of them runs is chosen once per call.
//!
//! The box test is conservative (Ize, *Robust BVH Ray Traversal*, 2013): the builder moves planes, and
//! a ray its origin, by more than rounding can.

use super::Ray;
use super::triangle::{Projected, Shear};
use crate::bvh::Mbvh;
use crate::bvh::instances::Margin;
use crate::bvh::layout::{ChildRef, LEAF_PAD, LEAF_STRIDE, MAX_LEAF, WIDTH};
use crate::simd::{Compress, Four, Lanes, Mask, Simd};
use glam::Vec3;
use std::hint::select_unpredictable;
use std::marker::PhantomData;
use std::mem::MaybeUninit;

/// A tree that rays can traverse.
pub(super) trait Tree {
    type Node;
    type Leaf<'a>: Leaf
    where
        Self: 'a;

    /// Number of children of a node, up to [`WIDTH`].
    const WIDTH: usize;

    /// Lanes, one per child.
    type Lanes<S: Simd>: Compress;

    /// Distance in bytes between a node's rows of planes: minima of x, y, z, maxima of x, y, z.
    const ROW: u32;

    /// Whether the children of a node come in the order in which rays to any hit should visit them, from last to first.
    const IS_BY_WORTH: bool;

    /// Prefetches a child that will be visited soon.
    fn prefetch(&self, child: ChildRef);

    /// Prefetches what is read of a child as soon as it is visited, as far as that is worth it.
    fn prefetch_whole(&self, child: ChildRef);

    /// # Safety
    /// `node` must be an inner reference of this tree.
    unsafe fn node(&self, node: ChildRef) -> &Self::Node;

    /// Returns the planes of all children across `axis`, from the row that begins at `row`.
    ///
    /// # Safety
    /// The CPU must have the ISA, and `row` must be a multiple of [`Self::ROW`] for one of that axis.
    unsafe fn planes<S: Simd>(node: &Self::Node, axis: usize, row: u32) -> Self::Lanes<S>;

    /// Returns the references to the children, for which `room` may serve as a buffer.
    fn names(node: &Self::Node, room: &mut MaybeUninit<[u32; WIDTH]>) -> *const u32;

    /// Order of the children by octant, as [`Node::order`].
    fn order(node: &Self::Node) -> *const u32;

    /// The tree itself if it is the full one of scenes.
    fn whole(&self) -> Option<&Mbvh> {
        None
    }

    /// # Safety
    /// The CPU must have the ISA, and `leaf` must be a leaf of this tree.
    unsafe fn leaf<S: Simd>(&self, leaf: ChildRef) -> Self::Leaf<'_>;
}

/// Rows of a leaf, as in [`Mbvh`](crate::bvh::Mbvh), and what loads may read behind them.
pub(super) type LeafRows = [f32; LEAF_STRIDE * MAX_LEAF + LEAF_PAD];

/// A leaf of a tree.
pub(super) trait Leaf {
    /// Whether [`counts`](Self::counts) is always true.
    const ALWAYS_COUNTS: bool;

    /// Rows of the corners as in [`Mbvh`](crate::bvh::Mbvh), for which `room` may serve as a buffer; they can be read
    /// as long as the leaf and `room` live.
    fn rows(&self, room: &mut MaybeUninit<LeafRows>) -> *const f32;

    /// Number of triangles.
    fn count(&self) -> usize;

    /// Projects triangles `first .. first + 4` along a ray. Lanes beyond the count are garbage.
    ///
    /// # Safety
    /// The CPU must have the ISA, and `first` must be below the count.
    unsafe fn project<L: Four>(&self, first: usize, ray: &Shear) -> Projected<L>;

    /// Distance to triangle `i` in f64: see [`accurate_distance`].
    ///
    /// # Safety
    /// `i` must be below the count.
    unsafe fn accurate_distance(&self, i: usize, ray: &Shear) -> f32;

    /// Global number of triangle `i`.
    ///
    /// # Safety
    /// `i` must be below the count.
    unsafe fn number(&self, i: usize) -> u32;

    /// Whether a hit on triangle `i` counts for a ray with the conservative tmax `limit`. This may be slow, so it is
    /// asked only before a hit is accepted.
    ///
    /// # Safety
    /// The CPU must have the ISA, and `i` must be below the count.
    unsafe fn counts<S: Simd>(&self, i: usize, ray: &RaySetup, limit: f32) -> bool;
}

/// Ize's 1 + 2γ₃ for box tests that subtract the origin from planes, rounded up.
pub(super) const FAR_SCALE: f32 = 1.0 + 4e-7;

/// Conservative tmax of the slab test for a hit at `t`: a triangle's t has a larger rounding error than its box's, and
/// of triangles at equal t all must be tested.
#[inline(always)]
pub(super) fn beyond(t: f32) -> f32 {
    t + BEYOND * t.abs()
}

/// Relative margin of [`beyond`].
pub(super) const BEYOND: f32 = 4e-6;

/// A direction component below this fraction of the largest counts as zero in box tests.
pub(super) const PARALLEL: f32 = 1e-18;

/// Reciprocal of a zero component: its product with [`nudge`] is beyond any t, but never NaN.
pub(super) const PARALLEL_RECIPROCAL: f32 = 1e38;

/// Distance by which box planes are moved outwards for rays along them, so that an origin on a plane counts as inside
/// on both sides: over an ulp, and over the distance that `PARALLEL_RECIPROCAL` needs to reach 1e18.
#[inline(always)]
pub(super) fn nudge(origin: f32) -> f32 {
    (origin.abs() * 2.4e-7).max(1e-20)
}

/// The greater value in one instruction; `f32::max` takes four to treat NaN.
#[inline(always)]
fn greater(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

/// The lesser value in one instruction, as `greater`.
#[inline(always)]
fn lesser(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

/// Rays whose origin is beyond this hit nothing: products of two distances to them would overflow.
pub(super) const FARTHEST_ORIGIN: f32 = 1e18;

/// The power of two that scales a direction's largest component into a range where the reciprocals and products of the
/// tests neither overflow nor vanish; `None` for a ray that can hit nothing.
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

/// Relative rounding error of one operation.
pub(super) const EPSILON: f32 = f32::EPSILON / 2.0;

/// Relative bound of the error of a slab test's offset, as a part of the product of origin and reciprocal: the rounding
/// of the product, of the reciprocal, of the box test's fused sum and of the sum with this bound, and some to spare.
/// (The builder has moved planes outwards by their own share.)
pub(super) const OFFSET_ERROR: f32 = 6.0 * EPSILON;

/// A ray prepared for box and triangle tests.
#[derive(Clone, Copy)]
pub(super) struct RaySetup {
    /// The t of a plane is `reciprocal` · plane + `near_offset` or `far_offset`. An offset is the negative product of
    /// origin and reciprocal, lowered or raised by its greatest rounding error. In the slower test, offsets are
    /// origins.
    reciprocal: [f32; 3],
    near_offset: [f32; 3],
    far_offset: [f32; 3],
    /// Offset in bytes from the first row of a node's planes to the near and far ones, per axis.
    near: [u32; 3],
    far: [u32; 3],
    /// Shift that selects the direction's octant in [`Tree::order`].
    pub(super) shift: u32,
    is_slow: bool,
    pub(super) tmin: f32,
    pub(super) shear: Shear,
}

impl RaySetup {
    /// Sets up a ray for the fast box test. If [`must_be_slow`](Self::must_be_slow) says so,
    /// [`make_slow`](Self::make_slow) must follow. (All axes in one vector by hand take no fewer instructions.)
    #[inline(always)]
    pub(super) fn new<T: Tree>(origin: [f32; 3], direction: [f32; 3], tmin: f32) -> Self {
        Self::with::<T>(origin, direction, tmin, Shear::new(origin, direction))
    }

    #[inline(always)]
    fn with<T: Tree>(origin: [f32; 3], direction: [f32; 3], tmin: f32, shear: Shear) -> Self {
        let is_negative = direction.map(|d| d < 0.0);
        let reciprocal = direction.map(|d| 1.0 / d);
        let offset: [f32; 3] = std::array::from_fn(|a| -origin[a] * reciprocal[a]);
        let error = offset.map(|o| OFFSET_ERROR * o.abs());
        // (Half of the branches that the compiler made of this were mispredicted.)
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

    /// Writes the setup of a ray to `place`, by the box test that it needs. (In place: a call that may change a ray keeps
    /// the compiler from building it at its destination, and the ray was then copied through memory twice, which stalls
    /// where wide loads follow narrow stores.)
    ///
    /// # Safety
    /// `place` must be valid for writing.
    #[inline(always)]
    pub(super) unsafe fn write<T: Tree>(place: *mut RaySetup, origin: [f32; 3], direction: [f32; 3], tmin: f32) {
        // SAFETY: forwarded.
        unsafe {
            place.write(RaySetup::new::<T>(origin, direction, tmin));
            if RaySetup::must_be_slow(direction) {
                (*place).make_slow::<T>(origin, direction, 0.0);
            }
        }
    }

    /// As [`write`](Self::write), for a ray that is tested against the boxes of instances alone, with their `margin`.
    /// (Without what triangle tests need, rays through instances take 1 to 3 % less time.)
    ///
    /// # Safety
    /// `place` must be valid for writing.
    #[inline(always)]
    pub(super) unsafe fn write_for_boxes<T: Tree>(
        place: *mut RaySetup,
        origin: [f32; 3],
        direction: [f32; 3],
        tmin: f32,
        margin: Margin,
    ) {
        let [x, y, z] = origin.map(f32::abs);
        // SAFETY: forwarded.
        unsafe {
            place.write(RaySetup::with::<T>(origin, direction, tmin, Shear::NONE));
            if greater(greater(x, y), z) > margin.reach || RaySetup::must_be_slow(direction) {
                (*place).change_for_boxes::<T>(origin, direction, margin);
            }
        }
    }

    /// Changes the setup of a ray from far away, or for the slower box test.
    #[cold]
    #[inline(never)]
    fn change_for_boxes<T: Tree>(&mut self, origin: [f32; 3], direction: [f32; 3], margin: Margin) {
        let beside = margin.beside(origin);
        for a in 0..3 {
            self.near_offset[a] -= beside * self.reciprocal[a].abs();
            self.far_offset[a] += beside * self.reciprocal[a].abs();
        }
        if RaySetup::must_be_slow(direction) {
            self.make_slow::<T>(origin, direction, beside);
        }
    }

    #[inline(always)]
    fn must_be_slow(direction: [f32; 3]) -> bool {
        let [x, y, z] = direction.map(f32::abs);
        lesser(lesser(x, y), z) <= STEEP * greater(greater(x, y), z)
    }

    /// Changes the setup to the slower box test, for directions of which a reciprocal is infinite or too large for the
    /// fast one. `beside`: by how much the ray may lie beside where it is.
    #[cold]
    fn make_slow<T: Tree>(&mut self, origin: [f32; 3], direction: [f32; 3], beside: f32) {
        let [x, y, z] = direction.map(f32::abs);
        let parallel = PARALLEL * x.max(y).max(z);
        self.is_slow = true;
        for a in 0..3 {
            let wider = beside.copysign(direction[a]);
            (self.near_offset[a], self.far_offset[a]) = (origin[a] + wider, origin[a] - wider);
            if direction[a].abs() <= parallel {
                self.reciprocal[a] = PARALLEL_RECIPROCAL;
                self.near_offset[a] = origin[a] + nudge(origin[a]) + beside;
                self.far_offset[a] = origin[a] - nudge(origin[a]) - beside;
                // The sign of a component that counts as zero must not matter.
                self.near[a] = T::ROW * a as u32;
                self.far[a] = T::ROW * (a as u32 + 3);
            }
        }
    }

    /// Distances at which the ray enters boxes, and a mask of those that it intersects up to `tmax`.
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

    /// Distances of near and far planes across an axis, by the slower test.
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
            // Rounds the far distance away from the near planes, on either side of the origin.
            (near, (far * L::splat(FAR_SCALE)).max(far * L::splat(2.0 - FAR_SCALE)))
        }
    }

    /// Whether the ray, set up for `T`, intersects a box up to `tmax`, with the arithmetic of the test of nodes.
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
    /// Planes across `axis`, from the row that begins at `row`, as in [`Tree::planes`].
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

impl<S: Simd, T: Tree> Boxes<T::Lanes<S>> for Children<'_, S, T> {
    #[inline(always)]
    unsafe fn planes(&self, axis: usize, row: u32) -> T::Lanes<S> {
        // SAFETY: forwarded.
        unsafe { T::planes::<S>(self.node, axis, row) }
    }
}

/// A single box, repeated in all lanes.
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
