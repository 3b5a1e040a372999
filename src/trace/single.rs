//! Single rays through the 4-wide tree: ordered closest hit and any hit (thesis 3.1.2; Wald,
//! Benthin and Boulos, *Getting Rid of Packets*, 2008; Dammertz et al. 2008).
//!
//! The box test is conservative (Ize, *Robust BVH Ray Traversal*, 2013): far distances are scaled
//! up by more than the rounding of three operations.

use super::triangle::{OriginTriangle, V3};
use super::{RawHit, Ray};
use crate::bvh::layout::{ChildRef, Mbvh, Node, STACK_SIZE};
use crate::scene::NONE;
use crate::simd::{Halves, Lanes, Mask, Simd};
use std::mem::MaybeUninit;

/// Ize's 1 + 2γ₃ for the box test, rounded up.
pub(super) const FAR_SCALE: f32 = 1.0 + 4e-7;

/// A box is entered up to this factor beyond the closest hit so far: a triangle's t has a larger
/// rounding error than its box's, and of triangles at equal t all must be seen.
pub(super) const T_SCALE: f32 = 1.0 + 4e-6;

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

/// Powers of two that bring any direction's largest component into a range where the reciprocals
/// and products of the tests neither overflow nor vanish: (scale, largest component), or `None` for
/// a ray that can hit nothing.
#[inline(always)]
pub(super) fn direction_scale(ray: &Ray) -> Option<f32> {
    let [x, y, z] = ray.direction.map(f32::abs);
    let largest = x.max(y).max(z);
    let sum = x + y + z + ray.origin[0].abs() + ray.origin[1].abs() + ray.origin[2].abs();
    // One comparison finds NaN and infinities; `max` alone would lose a NaN.
    if !(sum < f32::INFINITY) || largest == 0.0 {
        return None;
    }
    if (1e-6..=1e6).contains(&largest) {
        return Some(1.0);
    }
    // The power of two is exact: scaling the direction changes no bit of the geometry.
    let exponent = (largest.log2().floor() as i32).clamp(-126, 126);
    Some(2f32.powi(-exponent))
}

/// What a ray is for the tests.
pub(super) struct RaySetup<S: Simd> {
    origin4: V3<S::F4>,
    direction4: V3<S::F4>,
    origin8: V3<S::F8>,
    /// Low half: reciprocals. High half: negated and scaled by [`FAR_SCALE`].
    reciprocal8: V3<S::F8>,
    /// Floats from a node's row to the near planes, per axis: 0 or 4.
    near: [usize; 3],
    tmin: f32,
}

impl<S: Simd> RaySetup<S> {
    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    pub(super) unsafe fn new(origin: [f32; 3], direction: [f32; 3], tmin: f32) -> Self {
        let [x, y, z] = direction.map(f32::abs);
        let parallel = PARALLEL * x.max(y).max(z);
        let mut near = [0; 3];
        let axis = |a: usize, near: &mut usize| {
            let (o, d) = (origin[a], direction[a]);
            let (r, n) = if d.abs() <= parallel { (PARALLEL_RECIPROCAL, nudge(o)) } else { (1.0 / d, 0.0) };
            *near = if r < 0.0 { 4 } else { 0 };
            let (low, high) = ([o + n; 4], [o - n; 4]);
            let (rl, rh) = ([r; 4], [-r * FAR_SCALE; 4]);
            // SAFETY: arrays of four floats; the caller vouches for the ISA.
            unsafe { (S::F8::load_halves(low.as_ptr(), high.as_ptr()), S::F8::load_halves(rl.as_ptr(), rh.as_ptr())) }
        };
        let (ox, rx) = axis(0, &mut near[0]);
        let (oy, ry) = axis(1, &mut near[1]);
        let (oz, rz) = axis(2, &mut near[2]);
        RaySetup {
            // SAFETY: the caller vouches for the ISA.
            origin4: unsafe { V3::splat(origin) },
            // SAFETY: likewise.
            direction4: unsafe { V3::splat(direction) },
            origin8: V3 { x: ox, y: oy, z: oz },
            reciprocal8: V3 { x: rx, y: ry, z: rz },
            near,
            tmin,
        }
    }

    /// (tmin ×4, −tmax ×4) for [`Self::node`].
    ///
    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    unsafe fn limits(&self, tmax: f32) -> S::F8 {
        let (low, high) = ([self.tmin; 4], [-tmax * T_SCALE; 4]);
        // SAFETY: arrays of four floats; the caller vouches for the ISA.
        unsafe { S::F8::load_halves(low.as_ptr(), high.as_ptr()) }
    }

    /// Near distances of a node's boxes, and which of them the ray meets. One 256-bit operation
    /// serves near and far planes: the upper half holds negated far distances, so that the maximum
    /// over the axes is right for both.
    ///
    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    unsafe fn node(&self, node: &Node, limits: S::F8, zero: S::F4) -> (S::F4, u32) {
        let plane = |a: usize| {
            let row = node.bounds[a].as_ptr();
            // SAFETY: `near` is 0 or 4, so both loads stay in the row of eight.
            unsafe { S::F8::load_halves(row.add(self.near[a]), row.add(4 - self.near[a])) }
        };
        let tx = (plane(0) - self.origin8.x) * self.reciprocal8.x;
        let ty = (plane(1) - self.origin8.y) * self.reciprocal8.y;
        let tz = (plane(2) - self.origin8.z) * self.reciprocal8.z;
        let t = tx.max(ty).max(tz.max(limits));
        let near = t.low();
        (near, near.le(zero - t.high()).bits())
    }
}

/// The best hit of a ray so far, with edge functions in place of barycentrics.
#[derive(Clone, Copy)]
pub(super) struct Best {
    pub t: f32,
    pub triangle: u32,
    pub u: f32,
    pub v: f32,
    /// u + v + w: twice normal · direction, so negative on the front.
    pub sum: f32,
}

impl Best {
    #[inline(always)]
    pub(super) fn none(tmax: f32) -> Self {
        Best { t: tmax, triangle: NONE, u: 0.0, v: 0.0, sum: 1.0 }
    }

    #[inline(always)]
    pub(super) fn hit(&self) -> RawHit {
        if self.triangle == NONE {
            return RawHit::MISS;
        }
        let (u, v) = barycentrics(self.u, self.v, self.sum);
        RawHit { t: self.t, u, v, triangle: self.triangle, front: self.sum < 0.0 }
    }
}

/// Weights of corners 1 and 2 from the edge functions. The sum vanishes only where all three do.
#[inline(always)]
pub(super) fn barycentrics(u: f32, v: f32, sum: f32) -> (f32, f32) {
    if sum == 0.0 { (0.0, 0.0) } else { ((u / sum).min(1.0), (v / sum).min(1.0)) }
}

/// Improves `best` by the triangles of a leaf; `any`: stops at the first. Says whether it did.
///
/// # Safety
/// The CPU must have the ISA; `leaf` must be a leaf of `bvh`.
#[inline(always)]
unsafe fn leaf<S: Simd, const ANY: bool>(
    bvh: &Mbvh,
    leaf: ChildRef,
    ray: &RaySetup<S>,
    zero: S::F4,
    best: &mut Best,
) -> bool {
    let (rows, count) = (bvh.leaf(leaf), leaf.leaf_count());
    let mut improved = false;
    let mut first = 0;
    while first < count {
        // SAFETY: `rows` is a leaf of `count`, and `first < count`.
        let triangle = unsafe { OriginTriangle::<S::F4>::load(rows, count, first, ray.origin4) };
        let (u, v, w, inside) = triangle.edges(ray.direction4, zero);
        let lanes = if count - first >= 4 { 0xf } else { (1u32 << (count - first)) - 1 };
        let mut candidates = inside.bits() & lanes;
        if candidates != 0 {
            let den = triangle.normal.dot(ray.direction4);
            let t = triangle.distance.div(den);
            // SAFETY: the caller vouches for the ISA.
            let (tmin, tmax) = unsafe { (S::F4::splat(ray.tmin), S::F4::splat(best.t)) };
            candidates &= tmin.lt(t).and(t.le(tmax)).bits() & !den.eq(zero).bits();
            if ANY && candidates != 0 {
                return true;
            }
            while candidates != 0 {
                let i = candidates.trailing_zeros() as usize;
                candidates &= candidates - 1;
                // SAFETY: row 9 of the leaf holds `count` numbers, and first + i < count.
                let id = unsafe { rows.add(9 * count + first + i).read().to_bits() };
                let ti = t.to_array()[i];
                if ti < best.t || (ti == best.t && id < best.triangle) {
                    let (u, v, w) = (u.to_array()[i], v.to_array()[i], w.to_array()[i]);
                    *best = Best { t: ti, triangle: id, u, v, sum: u + v + w };
                    improved = true;
                }
            }
        }
        first += 4;
    }
    improved
}

#[derive(Clone, Copy)]
struct Entry {
    child: ChildRef,
    near: f32,
}

/// Improves `best` by everything under `root`, nearest boxes first; `ANY`: says whether there is
/// anything, in no order.
///
/// # Safety
/// The CPU must have the ISA; `root` must be a child reference of `bvh`.
#[inline(always)]
pub(super) unsafe fn traverse<S: Simd, const ANY: bool>(
    bvh: &Mbvh,
    root: ChildRef,
    ray: &RaySetup<S>,
    best: &mut Best,
) -> bool {
    let mut stack = [const { MaybeUninit::<Entry>::uninit() }; STACK_SIZE];
    let mut top = 0;
    // SAFETY: the caller vouches for the ISA.
    let zero = unsafe { S::F4::splat(0.0) };
    // SAFETY: likewise.
    let mut limits = unsafe { ray.limits(best.t) };
    let mut current = root;
    loop {
        if current.is_leaf() {
            // SAFETY: `current` comes from the tree.
            if unsafe { leaf::<S, ANY>(bvh, current, ray, zero, best) } {
                if ANY {
                    return true;
                }
                // SAFETY: the caller vouches for the ISA.
                limits = unsafe { ray.limits(best.t) };
            }
        } else {
            debug_assert!(current.node_index() < bvh.nodes.len());
            // SAFETY: inner references of the tree are in range.
            let node = unsafe { bvh.nodes.get_unchecked(current.node_index()) };
            // SAFETY: the caller vouches for the ISA.
            let (near, mut mask) = unsafe { ray.node(node, limits, zero) };
            if mask != 0 {
                let near = near.to_array();
                let first = mask.trailing_zeros() as usize;
                mask &= mask - 1;
                if mask == 0 {
                    current = node.children[first];
                    continue;
                }
                bvh.prefetch(node.children[first]);
                // Insertion into the stack in order of falling distance: the nearest ends on top.
                let base = top;
                stack[top].write(Entry { child: node.children[first], near: near[first] });
                top += 1;
                while mask != 0 {
                    let i = mask.trailing_zeros() as usize;
                    mask &= mask - 1;
                    let e = Entry { child: node.children[i], near: near[i] };
                    bvh.prefetch(e.child);
                    let mut j = top;
                    if !ANY {
                        while j > base {
                            // SAFETY: entries base .. top have been written.
                            let below = unsafe { stack[j - 1].assume_init() };
                            if below.near >= e.near {
                                break;
                            }
                            stack[j].write(below);
                            j -= 1;
                        }
                    }
                    stack[j].write(e);
                    top += 1;
                }
            }
        }
        loop {
            if top == 0 {
                return false;
            }
            top -= 1;
            // SAFETY: entries below `top` have been written; the builder bounds the tree's depth so
            // that the stack suffices (see `STACK_SIZE`).
            let e = unsafe { stack[top].assume_init() };
            if ANY || e.near <= best.t * T_SCALE {
                current = e.child;
                break;
            }
        }
    }
}

/// Closest hit.
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
pub(super) unsafe fn closest<S: Simd>(bvh: &Mbvh, ray: &Ray) -> RawHit {
    let Some(scale) = direction_scale(ray) else { return RawHit::MISS };
    let (d, inverse) = (ray.direction.map(|d| d * scale), 1.0 / scale);
    // SAFETY: the caller vouches for the ISA.
    let setup = unsafe { RaySetup::<S>::new(ray.origin, d, ray.tmin * inverse) };
    let mut best = Best::none(ray.tmax * inverse);
    if !(best.t > setup.tmin) {
        return RawHit::MISS;
    }
    // SAFETY: node 0 is the root.
    unsafe { traverse::<S, false>(bvh, ChildRef::node(0), &setup, &mut best) };
    best.t *= scale;
    best.hit()
}

/// Whether there is any hit.
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
pub(super) unsafe fn any<S: Simd>(bvh: &Mbvh, ray: &Ray) -> bool {
    let Some(scale) = direction_scale(ray) else { return false };
    let (d, inverse) = (ray.direction.map(|d| d * scale), 1.0 / scale);
    // SAFETY: the caller vouches for the ISA.
    let setup = unsafe { RaySetup::<S>::new(ray.origin, d, ray.tmin * inverse) };
    let mut best = Best::none(ray.tmax * inverse);
    if !(best.t > setup.tmin) {
        return false;
    }
    // SAFETY: node 0 is the root.
    unsafe { traverse::<S, true>(bvh, ChildRef::node(0), &setup, &mut best) }
}
