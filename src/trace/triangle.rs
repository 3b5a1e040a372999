//! Ray-triangle test in the plane across the ray (Woop, Benthin and Wald, *Watertight Ray/Triangle
//! Intersection*, 2013).
//!
//! Corners relative to the origin are sheared so that the ray becomes the axis of its largest
//! component; edge functions are then those of 2D. A corner becomes the same 2D point in every
//! triangle that has it. A product rounds monotonically, so the difference of two has the sign of the
//! exact difference or is 0; both triangles of an edge, and all of a corner, accept 0: no ray passes
//! between them. (Formed without contraction: fused, the sign would depend on the order of corners.)
//!
//! The distance is that of the plane, which is accurate for large triangles along the axes. If f32 is not precise
//! enough for it, it is computed in f64 and clamped to the range between the edges that the ray crosses: no hit lies
//! off its triangle.

use crate::simd::{Lanes, Mask};
use glam::DVec3;
use std::hint::select_unpredictable;

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
    fn map(self, f: impl Fn(L) -> L) -> Self {
        V3 { x: f(self.x), y: f(self.y), z: f(self.z) }
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

/// [`Shear::axes`] by the axis of the largest component, three for positive and three for negative ones.
pub(super) static AXES: [[u32; 3]; 6] = [[1, 2, 0], [2, 0, 1], [0, 1, 2], [2, 1, 0], [0, 2, 1], [1, 0, 2]];

/// A ray in its own frame: z along the axis of the direction's largest component.
#[derive(Clone, Copy)]
pub(super) struct Shear {
    /// The scene's axes that are x, y and z of the frame. The frame is right-handed if the direction's z is positive in
    /// it, left-handed if not: the winding of corners stays as it is seen from the origin.
    pub axes: [u32; 3],
    /// Origin, in the frame's order.
    pub origin: [f32; 3],
    /// Direction negated, in the frame's order: it points to where the ray comes from.
    pub back: [f32; 3],
    /// −x/z and −y/z of the direction.
    pub shear: [f32; 2],
    /// Lower bound of [`GRAZING`] times the direction's length.
    pub grazing: f32,
}

impl Shear {
    /// That of rays that meet no triangles.
    pub(super) const NONE: Shear =
        Shear { axes: [0, 1, 2], origin: [0.0; 3], back: [0.0; 3], shear: [0.0; 2], grazing: 0.0 };

    #[inline(always)]
    pub(super) fn new(origin: [f32; 3], d: [f32; 3]) -> Shear {
        let [x, y, z] = d.map(f32::abs);
        let k = if x > y && x > z { 0 } else { 2 - usize::from(y > z) };
        // (Half of the branches that the compiler made of this were mispredicted.)
        let axes = &AXES[select_unpredictable(d[k] < 0.0, k + 3, k)];
        // (Four elements each, so that no index is checked.)
        let [d4, origin4] = [d, origin].map(|v| [v[0], v[1], v[2], 0.0]);
        let of = |v: &[f32; 4], a: usize| v[axes[a] as usize & 3];
        let inverse = -1.0 / of(&d4, 2);
        Shear {
            axes: *axes,
            origin: [of(&origin4, 0), of(&origin4, 1), of(&origin4, 2)],
            back: [-of(&d4, 0), -of(&d4, 1), -of(&d4, 2)],
            shear: [of(&d4, 0) * inverse, of(&d4, 1) * inverse],
            grazing: GRAZING * (x + y + z),
        }
    }
}

/// Triangles of a leaf, projected along a ray.
#[derive(Clone, Copy)]
pub(super) struct Projected<L> {
    /// Vectors from the corners to the origin, in the ray's frame, not sheared.
    corners: [V3<L>; 3],
    /// Edge functions opposite of corners 1, 2 and 0: weights of these corners, up to a factor.
    pub u: L,
    pub v: L,
    pub w: L,
}

impl<L: Lanes> Projected<L> {
    /// Loads and projects triangles `first .. first + WIDTH` of a leaf of `count` (lanes beyond `count` are garbage).
    ///
    /// # Safety
    /// The CPU must have the ISA; `leaf` must point to a leaf of `count` triangles in an
    /// [`crate::bvh::Mbvh`], and `first < count`.
    #[inline(always)]
    pub(super) unsafe fn load(leaf: *const f32, count: usize, first: usize, ray: &Shear) -> Self {
        // SAFETY: rows are `count` apart; the pad behind the last leaf covers reads beyond it. The caller
        // vouches for the ISA.
        let axis = |a: usize| unsafe {
            let (row, origin) = (leaf.add(first + ray.axes[a] as usize * count), L::splat(ray.origin[a]));
            [0, 3 * count, 6 * count].map(|corner| origin - L::load(row.add(corner)))
        };
        let ([ax, bx, cx], [ay, by, cy], [az, bz, cz]) = (axis(0), axis(1), axis(2));
        let corners = [V3 { x: ax, y: ay, z: az }, V3 { x: bx, y: by, z: bz }, V3 { x: cx, y: cy, z: cz }];
        // SAFETY: the caller vouches for the ISA.
        Self::new(corners, unsafe { [L::splat(ray.shear[0]), L::splat(ray.shear[1])] })
    }

    /// Projects triangles given by the vectors from `corners` to the origin, in the ray's frame. Lanes are triangles of
    /// one ray, or rays of one triangle.
    #[inline(always)]
    pub(super) fn new(corners: [V3<L>; 3], [sx, sy]: [L; 2]) -> Self {
        // (`map` was not inlined everywhere.)
        let [a, b, c] = corners;
        let (ax, ay) = (sx.mul_add(a.z, a.x), sy.mul_add(a.z, a.y));
        let (bx, by) = (sx.mul_add(b.z, b.x), sy.mul_add(b.z, b.y));
        let (cx, cy) = (sx.mul_add(c.z, c.x), sy.mul_add(c.z, c.y));
        Projected { corners, u: ax * cy - ay * cx, v: bx * ay - by * ax, w: cx * by - cy * bx }
    }

    /// Mask of the lanes in which the ray passes through the triangle, edges and corners included.
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

    /// Masks of the lanes in which the [`accurate_distance`] is sure to be between `tmin` and `tmax`, which are not
    /// negative, and of those in which it is sure not to be: where all corners are by more than rounding, along the
    /// ray's longest axis, of which `back` is the component of [`Shear::back`]. That distance is clamped to between
    /// theirs.
    ///
    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    pub(super) unsafe fn depths(&self, back: L, tmin: L, tmax: L) -> (L::Mask, L::Mask) {
        // SAFETY: the caller vouches for the ISA.
        let splat = |x: f32| unsafe { L::splat(x) };
        let reciprocal = splat(1.0).div(back);
        let [a, b, c] = self.corners.map(|corner| corner.z * reciprocal);
        let (least, most) = (a.min(b).min(c), a.max(b).max(c));
        // (Of negative ones the margins go the wrong way, but these are beyond tmin anyway.)
        let (low, high) = (splat(1.0 - 1e-6), splat(1.0 + 1e-6));
        let within = tmin.lt(low * least).and((high * most).lt(tmax));
        (within, (high * most).lt(tmin).or(tmax.lt(low * least)))
    }

    /// Distances to the planes, and a mask of the lanes where these are accurate. They are not on thin triangles, whose
    /// normal is rounded, where the ray grazes the plane, and where areas are too small for f32: see
    /// [`accurate_distance`].
    ///
    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    pub(super) unsafe fn distances(&self, ray: &Shear) -> (L, L::Mask) {
        // SAFETY: forwarded.
        unsafe { self.distances_along(V3::splat(ray.back), L::splat(ray.grazing)) }
    }

    /// Distances as of `distances`, of rays given by [`Shear::back`] and [`Shear::grazing`].
    ///
    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    pub(super) unsafe fn distances_along(&self, back: V3<L>, grazing: L) -> (L, L::Mask) {
        let [a, b, c] = self.corners;
        let (e0, e1) = (c.sub(a), b.sub(a));
        let normal = e0.cross(e1);
        // SAFETY: the caller vouches for the ISA.
        let splat = |x: f32| unsafe { L::splat(x) };
        let zero = splat(0.0);
        let slope = normal.dot(back);
        // Divides before the product with a corner, which may be too small for f32.
        let reciprocal = splat(1.0).div(slope);
        let t = normal.map(|n| n * reciprocal).dot(a);
        let abs = |x: L| x.max(zero - x);
        let area = abs(normal.x).max(abs(normal.y)).max(abs(normal.z));
        let is_fat = (splat(THIN) * e0.dot(e0).max(e1.dot(e1))).lt(area);
        let is_steep = (grazing * area).lt(abs(slope));
        (t, is_fat.and(is_steep))
    }
}

/// Twice a triangle's area over its longest edge's square, below which it is thin. Below, t would lose more than some
/// 1e-6.
const THIN: f32 = 0.05;

/// Sine of the angle between ray and plane below which the ray grazes it. Below, t would lose as much.
pub(super) const GRAZING: f32 = 0.03;

/// Distance to a triangle's plane in f64 from the corners themselves, clamped to the range between the edges that the
/// ray crosses, which is the only other information about where the hit lies in the plane.
///
/// # Safety
/// As for [`Projected::load`]; `i` must be below `count`.
#[cold]
pub(super) unsafe fn accurate_distance(leaf: *const f32, count: usize, i: usize, ray: &Shear) -> f32 {
    // SAFETY: rows are `count` apart.
    let at = |corner: usize, a: usize| unsafe {
        leaf.add(i + (3 * corner + ray.axes[a] as usize) * count).read() as f64 - ray.origin[a] as f64
    };
    let corners = [0, 1, 2].map(|k| DVec3::new(at(k, 0), at(k, 1), at(k, 2)));
    let [a, b, c] = corners;
    let d = -DVec3::from(ray.back.map(f64::from));
    let normal = (b - a).cross(c - a);
    let slope = normal.dot(d);
    let t = normal.dot(a) / slope;
    // Coordinates of the corners across the ray.
    let (sx, sy) = (d.x / d.z, d.y / d.z);
    let (x, y) = (corners.map(|v| v.x - v.z * sx), corners.map(|v| v.y - v.z * sy));
    // If the ray passes the plane well within all edges, and not along it, that distance lies between the edges.
    // (Most do; without the range it takes a third of the time.)
    let edge = |i: usize, j: usize| x[i] * y[j] - y[i] * x[j];
    let (u, v, w) = (edge(0, 2), edge(1, 0), edge(2, 1));
    let size = |v: DVec3| v.abs().max_element();
    let extent = size(a).max(size(b)).max(size(c));
    let margin = MARGIN * extent * extent;
    let longest = (b - a).length_squared().max((c - a).length_squared());
    let is_within = u.min(v).min(w) > margin || u.max(v).max(w) < -margin;
    if is_within && slope.abs() > STEEP * longest * d.z.abs() {
        return t as f32;
    }
    // The axis along which the corners lie farther apart.
    let spread = |s: [f64; 3]| s[0].max(s[1]).max(s[2]) - s[0].min(s[1]).min(s[2]);
    clamped(t, &corners.map(|v| v.z), d.z, &if spread(x) > spread(y) { x } else { y })
}

/// Part of the square of the corners' distance from the origin from which an edge function's sign in f64 is certain,
/// with much to spare.
const MARGIN: f64 = 1e-13;

/// The sine of the angle between ray and plane, times the triangle's area by the square of its longest edge, from which
/// the distance to the plane in f64 is more accurate than f32.
const STEEP: f64 = 1e-5;

/// Clamps a distance to the range between the edges that a ray crosses, given the corners' coordinates along the ray's
/// axis, that component of its direction, and coordinates across it.
#[cold]
fn clamped(t: f64, z: &[f64; 3], dz: f64, s: &[f64; 3]) -> f32 {
    let crossing = |i: usize, j: usize| {
        let part = (-s[i] / (s[j] - s[i])).clamp(0.0, 1.0);
        (s[i] * s[j] <= 0.0 && !part.is_nan()).then(|| (z[i] + part * (z[j] - z[i])) / dz)
    };
    let crossings = [crossing(0, 1), crossing(1, 2), crossing(2, 0)].into_iter().flatten();
    let range =
        crossings.fold(None, |r: Option<[f64; 2]>, t| r.map_or(Some([t; 2]), |[a, b]| Some([a.min(t), b.max(t)])));
    // The ray passes beside the triangle by less than f32 resolves: takes the corner nearest to the ray.
    let nearest = || {
        let k = (0..3).min_by(|&i, &j| s[i].abs().total_cmp(&s[j].abs())).unwrap_or(0);
        [z[k] / dz; 2]
    };
    let [least, most] = range.unwrap_or_else(nearest);
    t.max(least).min(most) as f32
}

/// Barycentric weights of corners 1 and 2 from the edge functions. The sum vanishes only if all three do.
#[inline(always)]
pub(super) fn barycentrics(u: f32, v: f32, sum: f32) -> (f32, f32) {
    if sum == 0.0 { (0.0, 0.0) } else { ((u / sum).min(1.0), (v / sum).min(1.0)) }
}
