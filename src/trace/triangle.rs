//! Ray-triangle test by edge functions (Plücker coordinates) relative to the ray's origin (Kensler
//! and Shirley 2006; Davidovič et al., *3D Rasterization*, 2012).
//!
//! With corners v relative to the origin, the edge function of the edge a→b is
//! ((b − a) × (b + a)) · d. Swapping a and b negates it exactly: the difference is negated, the sum
//! is not changed, and the cross product, formed without contraction, is antisymmetric in rounding;
//! the fused dot product rounds symmetrically. So the two triangles of an edge see exactly opposite
//! values, both accept 0, and no ray passes between them. Forming it from (b − a) and (b + a), not
//! from b × a, keeps the error proportional to edge · distance, not distance².
//!
//! Everything but the dot products with d depends on the origin alone: the shared-origin gather
//! computes it once per packet.

use crate::simd::{Lanes, Mask};

/// Three f32 vectors.
#[derive(Clone, Copy)]
pub(super) struct V3<L> {
    pub x: L,
    pub y: L,
    pub z: L,
}

impl<L: Lanes> V3<L> {
    #[inline(always)]
    fn sub(self, o: Self) -> Self {
        V3 { x: self.x - o.x, y: self.y - o.y, z: self.z - o.z }
    }

    #[inline(always)]
    fn add(self, o: Self) -> Self {
        V3 { x: self.x + o.x, y: self.y + o.y, z: self.z + o.z }
    }

    /// Without contraction: antisymmetric in rounding.
    #[inline(always)]
    fn cross(self, o: Self) -> Self {
        V3 { x: self.y * o.z - self.z * o.y, y: self.z * o.x - self.x * o.z, z: self.x * o.y - self.y * o.x }
    }

    /// Always in this order, so that every kernel of an ISA gets the same bits.
    #[inline(always)]
    pub(super) fn dot(self, o: Self) -> L {
        self.x.mul_add(o.x, self.y.mul_add(o.y, self.z * o.z))
    }

    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    pub(super) unsafe fn splat(v: [f32; 3]) -> Self {
        // SAFETY: forwarded.
        unsafe { V3 { x: L::splat(v[0]), y: L::splat(v[1]), z: L::splat(v[2]) } }
    }

    /// # Safety
    /// The CPU must have the ISA, and `WIDTH` floats must be readable at each of the three rows.
    #[inline(always)]
    unsafe fn load_rows(p: *const f32, stride: usize) -> Self {
        // SAFETY: forwarded.
        unsafe { V3 { x: L::load(p), y: L::load(p.add(stride)), z: L::load(p.add(2 * stride)) } }
    }
}

/// What a triangle (or a vector of them) is for all rays from one origin.
#[derive(Clone, Copy)]
pub(super) struct OriginTriangle<L> {
    /// Edge functions as vectors: dot with the direction.
    pub u: V3<L>,
    pub v: V3<L>,
    pub w: V3<L>,
    /// Geometric normal (not normalised), twice: on the scale of the edge functions' sum.
    pub normal: V3<L>,
    /// Normal · corner: t is this over normal · direction.
    pub distance: L,
}

impl<L: Lanes> OriginTriangle<L> {
    /// Triangles `first .. first + WIDTH` of a leaf of `count` (lanes beyond `count` are garbage).
    ///
    /// # Safety
    /// The CPU must have the ISA; `leaf` must point to a leaf of `count` triangles in an
    /// [`crate::bvh::Mbvh`], and `first < count`.
    #[inline(always)]
    pub(super) unsafe fn load(leaf: *const f32, count: usize, first: usize, origin: V3<L>) -> Self {
        // SAFETY: rows are `count` apart; the pad behind the last leaf covers reads beyond it.
        let corner = |k: usize| unsafe { V3::<L>::load_rows(leaf.add(first + 3 * k * count), count).sub(origin) };
        Self::new([corner(0), corner(1), corner(2)])
    }

    /// From corners relative to the origin.
    #[inline(always)]
    pub(super) fn new([v0, v1, v2]: [V3<L>; 3]) -> Self {
        let (e0, e1, e2) = (v2.sub(v0), v0.sub(v1), v1.sub(v2));
        let normal = e0.cross(e1);
        OriginTriangle {
            u: e0.cross(v2.add(v0)),
            v: e1.cross(v0.add(v1)),
            w: e2.cross(v1.add(v2)),
            normal,
            distance: normal.dot(v0),
        }
    }

    /// Edge functions for a direction, and whether it passes inside (edges and corners included).
    #[inline(always)]
    pub(super) fn edges(&self, d: V3<L>, zero: L) -> (L, L, L, L::Mask) {
        let (u, v, w) = (self.u.dot(d), self.v.dot(d), self.w.dot(d));
        let inside = zero.le(u.min(v).min(w)).or(u.max(v).max(w).le(zero));
        (u, v, w, inside)
    }
}
