//! Ray-triangle test in the plane across the ray (Woop, Benthin and Wald, *Watertight Ray/Triangle
//! Intersection*, 2013).
//!
//! Corners relative to the origin are sheared so that the ray becomes the axis of its largest
//! component; edge functions are then those of 2D. A corner becomes the same 2D point in every
//! triangle that has it. A product rounds monotonically, so the difference of two has the sign of the
//! exact difference or is 0; both triangles of an edge, and all of a corner, accept 0: no ray passes
//! between them. (Formed without contraction: fused, the sign would depend on the order of corners.)
//!
//! The distance comes from the plane, which is accurate for large triangles along the axes, and is
//! kept within the corners' range, which nothing guarantees where the ray grazes the plane.

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
    fn cross(self, o: Self) -> Self {
        V3 { x: self.y * o.z - self.z * o.y, y: self.z * o.x - self.x * o.z, z: self.x * o.y - self.y * o.x }
    }

    #[inline(always)]
    fn dot(self, o: Self) -> L {
        self.x.mul_add(o.x, self.y.mul_add(o.y, self.z * o.z))
    }

    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    pub(super) unsafe fn splat(v: [f32; 3]) -> Self {
        // SAFETY: forwarded.
        unsafe { V3 { x: L::splat(v[0]), y: L::splat(v[1]), z: L::splat(v[2]) } }
    }
}

/// A ray in its own frame: z along the axis of the direction's largest component.
#[derive(Clone, Copy)]
pub(super) struct Shear {
    /// Of the scene's axes, which are x, y, and z of the frame. Right-handed if the direction's z is
    /// positive in it, left-handed if not: the winding of corners stays what it is seen from the origin.
    axes: [u32; 3],
    /// In the frame's order.
    origin: [f32; 3],
    /// Where the ray comes from: the direction negated, in the frame's order.
    back: [f32; 3],
    /// −x/z, −y/z and −1/z of the direction.
    shear: [f32; 3],
}

impl Shear {
    #[inline(always)]
    pub(super) fn new(origin: [f32; 3], d: [f32; 3]) -> Shear {
        let [x, y, z] = d.map(f32::abs);
        let k = if x > y && x > z { 0 } else { 2 - usize::from(y > z) };
        let (next, last) = ([1, 2, 0][k], [2, 0, 1][k]);
        let (i, j) = if d[k] < 0.0 { (last, next) } else { (next, last) };
        let inverse = -1.0 / d[k];
        Shear {
            axes: [i as u32, j as u32, k as u32],
            origin: [origin[i], origin[j], origin[k]],
            back: [-d[i], -d[j], -d[k]],
            shear: [d[i] * inverse, d[j] * inverse, inverse],
        }
    }
}

/// Triangles of a leaf as a ray sees them.
#[derive(Clone, Copy)]
pub(super) struct Projected<L> {
    /// From the corners to the origin, in the ray's frame, not sheared.
    corners: [V3<L>; 3],
    /// Edge functions opposite of corners 1, 2 and 0: weights of these corners, up to a factor.
    pub u: L,
    pub v: L,
    pub w: L,
}

impl<L: Lanes> Projected<L> {
    /// Triangles `first .. first + WIDTH` of a leaf of `count` (lanes beyond `count` are garbage).
    ///
    /// # Safety
    /// The CPU must have the ISA; `leaf` must point to a leaf of `count` triangles in an
    /// [`crate::bvh::Mbvh`], and `first < count`.
    #[inline(always)]
    pub(super) unsafe fn load(leaf: *const f32, count: usize, first: usize, ray: &Shear) -> Self {
        // SAFETY (all): rows are `count` apart; the pad behind the last leaf covers reads beyond it. The
        // caller vouches for the ISA.
        let axis = |a: usize| unsafe {
            let (row, origin) = (leaf.add(first + ray.axes[a] as usize * count), L::splat(ray.origin[a]));
            [0, 3 * count, 6 * count].map(|corner| origin - L::load(row.add(corner)))
        };
        let ([ax, bx, cx], [ay, by, cy], [az, bz, cz]) = (axis(0), axis(1), axis(2));
        let corners = [V3 { x: ax, y: ay, z: az }, V3 { x: bx, y: by, z: bz }, V3 { x: cx, y: cy, z: cz }];
        let (sx, sy) = unsafe { (L::splat(ray.shear[0]), L::splat(ray.shear[1])) };
        let [(ax, ay), (bx, by), (cx, cy)] = corners.map(|c| (sx.mul_add(c.z, c.x), sy.mul_add(c.z, c.y)));
        Projected { corners, u: ax * cy - ay * cx, v: bx * ay - by * ax, w: cx * by - cy * bx }
    }

    /// Where the ray passes inside, edges and corners included.
    ///
    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    pub(super) unsafe fn inside(&self) -> L::Mask {
        // SAFETY: the caller vouches for the ISA.
        let zero = unsafe { L::splat(0.0) };
        let (u, v, w) = (self.u, self.v, self.w);
        zero.le(u.min(v).min(w)).or(u.max(v).max(w).le(zero))
    }

    /// Distances, and where they lie in `tmin < t ≤ tmax` and exist at all.
    ///
    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    pub(super) unsafe fn distances(&self, ray: &Shear, tmin: f32, tmax: f32) -> (L, L::Mask) {
        let [a, b, c] = self.corners;
        let normal = c.sub(a).cross(b.sub(a));
        // SAFETY (all): the caller vouches for the ISA.
        let (back, inverse, zero) = unsafe { (V3::splat(ray.back), L::splat(ray.shear[2]), L::splat(0.0)) };
        let t = normal.dot(a).div(normal.dot(back));
        let (ta, tb, tc) = (a.z * inverse, b.z * inverse, c.z * inverse);
        let t = t.max(ta.min(tb).min(tc)).min(ta.max(tb).max(tc));
        let (tmin, tmax) = unsafe { (L::splat(tmin), L::splat(tmax)) };
        // In the plane of a triangle all three vanish.
        let sum = self.u + self.v + self.w;
        let exists = sum.lt(zero).or(zero.lt(sum));
        (t, tmin.lt(t).and(t.le(tmax)).and(exists))
    }
}
