//! Packs of rays of [beams](super::beams), and the shafts around them (Haines and Wallace, *Shaft Culling for Efficient
//! Ray-Cast Radiosity*, 1991).
//!
//! A shaft encloses the ways of a pack's rays, from origins to ends. All go the same way along each axis. So what
//! bounds them, at a fraction of the way, are straight lines from the outermost origin to the outermost end, and they
//! are in a box from where the leading line enters it to where the trailing one leaves it: the test of a ray, whose
//! slopes are others for near planes and for far ones. A pack costs at a node what a ray costs in a list.

use super::groups::ChildBoxes;
use super::tree::{BEYOND, EPSILON, FARTHEST_ORIGIN, OFFSET_ERROR};
use super::triangle::{GRAZING, Projected, Shear, V3, accurate_distance};
use crate::bvh::Mbvh;
use crate::simd::{Eight, Lanes, Mask, Simd};
use bytemuck::Zeroable;
use std::array::from_fn;

/// Number of rays of a pack.
pub(super) const SIZE: usize = 16;

/// By how much a shaft is wider than its rays, as a part of the largest coordinate: more than the errors of a ray's
/// test of a plane ([`OFFSET_ERROR`], and the rounding of its fused sum) and of a shaft's test.
const MARGIN: f32 = 32.0 * EPSILON;

/// Greatest extent of a pack's origins and ends, as a fraction of its length, at which it is worth a shaft.
const WIDEST: f32 = 1.0;

/// A value per ray.
type Column = [f32; SIZE];

/// The rays of a pack.
#[derive(Clone, Copy, Zeroable)]
#[repr(C, align(64))]
pub(super) struct Pack {
    /// Origin, tmin, direction and tmax, as in [`Ray`](super::Ray).
    ray: [Column; 8],
    /// As in [`RaySetup`](super::tree::RaySetup).
    reciprocal: [Column; 3],
    near_offset: [Column; 3],
    far_offset: [Column; 3],
    /// Conservative tmax.
    limit: Column,
    /// As in [`Shear`].
    shear: [Column; 2],
    pub axes: [u32; 3],
    /// Rays that have no hit yet.
    pub left: u32,
    /// Their numbers in the stream.
    pub numbers: [u16; SIZE],
    pub count: u32,
    /// Number of tests against leaves, and of rays that hit their boxes.
    pub tests: u32,
    pub met: u32,
}

/// What encloses the rays of a pack: the fraction of the way at which a line is in a plane is reciprocal · plane +
/// offset.
#[derive(Clone, Copy, Zeroable)]
#[repr(C, align(64))]
pub(super) struct Shaft {
    near_reciprocal: [f32; 3],
    near_offset: [f32; 3],
    far_reciprocal: [f32; 3],
    far_offset: [f32; 3],
}

/// Eight rays: origin, tmin, direction and tmax.
pub(super) type Eights<L> = [L; 8];

impl Shaft {
    /// The shaft around rays of an octant; `None` if there cannot be one, or if it is wide.
    ///
    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    pub(super) unsafe fn new<S: Simd>(halves: &[Eights<S::F8>; 2], octant: usize, tree: &Mbvh) -> Option<Shaft> {
        // SAFETY: the caller vouches for the ISA; arrays have as many floats as are read.
        unsafe {
            let ([a, b], [c, d]) = (halves, [ends(&halves[0], octant, tree), ends(&halves[1], octant, tree)]);
            let [i, j, k, l, m, n, o, p] = S::F8::transpose([
                a[0].min(b[0]),
                a[1].min(b[1]),
                a[2].min(b[2]),
                a[3].min(b[3]),
                c[0].min(d[0]),
                c[1].min(d[1]),
                c[2].min(d[2]),
                a[3],
            ]);
            let low = i.min(j).min(k.min(l)).min(m.min(n).min(o.min(p))).to_array();
            let [i, j, k, l, m, n, o, p] = S::F8::transpose([
                a[0].max(b[0]),
                a[1].max(b[1]),
                a[2].max(b[2]),
                a[3],
                c[0].max(d[0]),
                c[1].max(d[1]),
                c[2].max(d[2]),
                a[3],
            ]);
            let high = i.max(j).max(k.max(l)).max(m.max(n).max(o.max(p))).to_array();
            let [first_low, last_low] = [S::F4::load(low.as_ptr()), S::F4::load(low.as_ptr().add(4))];
            let [first_high, last_high] = [S::F4::load(high.as_ptr()), S::F4::load(high.as_ptr().add(4))];
            let splat = |x: f32| S::F4::splat(x);
            let (zero, one) = (splat(0.0), splat(1.0));
            let most = first_high.max(zero - first_low).max(last_high.max(zero - last_low));
            // The fourth of the lanes is tmin.
            if most.le(splat(FARTHEST_ORIGIN)).bits() & 7 != 7 || low[3] < 0.0 {
                return None;
            }
            let sum = |v: S::F4| {
                let [x, y, z, ..] = v.to_array();
                x + y + z
            };
            let way = last_low + last_high - first_low - first_high;
            let length = 0.5 * sum(way.max(zero - way));
            let extent = sum((first_high - first_low) + (last_high - last_low));
            if !(extent <= WIDEST * length) {
                return None;
            }
            // (Not less than any number: rays close to 0 that go along the other axes.)
            let margin = (splat(MARGIN) * most).max(splat(1e-30));
            let twice = margin + margin;
            let sign: [f32; 4] = from_fn(|a| if octant >> a & 1 != 0 { -1.0 } else { 1.0 });
            let descends = S::F4::load(sign.as_ptr()).lt(zero);
            let either = |down: S::F4, up: S::F4| S::F4::select(descends, down, up);
            // Lines ascend or descend as the rays do, whatever rounding does: by a margin at least.
            let near = either(first_low - margin, first_high + margin);
            let near_end = either(last_low - twice, last_high + twice);
            let far = either(first_high + twice, first_low - twice);
            let far_end = either(last_high + margin, last_low - margin);
            let (near_reciprocal, far_reciprocal) = (one.div(near_end - near), one.div(far_end - far));
            let row = |v: S::F4| {
                let [x, y, z, ..] = v.to_array();
                [x, y, z]
            };
            Some(Shaft {
                near_reciprocal: row(near_reciprocal),
                near_offset: row(zero - near * near_reciprocal),
                far_reciprocal: row(far_reciprocal),
                far_offset: row(zero - far * far_reciprocal),
            })
        }
    }

    /// Mask of the boxes that the shaft meets.
    ///
    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    pub(super) unsafe fn meets<L: Lanes>(&self, boxes: &ChildBoxes<L>) -> L::Mask {
        // SAFETY: the caller vouches for the ISA.
        let splat = |x: f32| unsafe { L::splat(x) };
        let near = |a: usize| boxes.near[a].mul_add(splat(self.near_reciprocal[a]), splat(self.near_offset[a]));
        let far = |a: usize| boxes.far[a].mul_add(splat(self.far_reciprocal[a]), splat(self.far_offset[a]));
        let first = near(0).max(near(1)).max(near(2).max(splat(0.0)));
        let last = far(0).min(far(1)).min(far(2).min(splat(1.0)));
        first.le(last)
    }
}

/// Where eight rays of an octant end, or have left the scene by more than rounding.
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
unsafe fn ends<L: Eight>(rays: &Eights<L>, octant: usize, tree: &Mbvh) -> [L; 3] {
    // SAFETY: the caller vouches for the ISA.
    let splat = |x: f32| unsafe { L::splat(x) };
    let tmax = rays[7];
    let mut t = tmax + splat(BEYOND) * tmax;
    let is_infinite = splat(f32::INFINITY).le(tmax);
    if is_infinite.any() {
        let (lower, upper) = tree.bounds();
        let margin = MARGIN * lower.abs().max(upper.abs()).max_element();
        let planes = [0, 1, 2].map(|a| if octant >> a & 1 != 0 { (lower[a], -1.0) } else { (upper[a], 1.0) });
        // SAFETY: the caller vouches for the ISA.
        let [x, y, z] = unsafe {
            [
                exit(rays[0], rays[4], planes[0], margin),
                exit(rays[1], rays[5], planes[1], margin),
                exit(rays[2], rays[6], planes[2], margin),
            ]
        };
        t = L::select(is_infinite, x.min(y).min(z), t);
    }
    [rays[4].mul_add(t, rays[0]), rays[5].mul_add(t, rays[1]), rays[6].mul_add(t, rays[2])]
}

/// Distances at which rays have left the scene along an axis, whose last plane they reach in the direction of `sign`.
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
unsafe fn exit<L: Lanes>(origin: L, direction: L, (plane, sign): (f32, f32), margin: f32) -> L {
    // SAFETY: the caller vouches for the ISA.
    let [zero, plane, sign, margin, part] =
        unsafe { [L::splat(0.0), L::splat(plane), L::splat(sign), L::splat(margin), L::splat(MARGIN)] };
    let way = ((plane - origin) * sign).max(zero);
    (way + margin + part * origin.max(zero - origin)).div(direction * sign)
}

impl Pack {
    /// Sets up the rays with the arithmetic of [`RaySetup::new`](super::tree::RaySetup::new) and [`Shear::new`].
    ///
    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    pub(super) unsafe fn set_up<S: Simd>(&mut self, halves: &[Eights<S::F8>; 2]) {
        self.left = (1 << self.count) - 1;
        (self.tests, self.met) = (0, 0);
        let [i, j, k] = self.axes.map(|a| 4 + a as usize);
        for (half, rays) in halves.iter().enumerate() {
            // SAFETY: columns have twice eight lanes. The caller vouches for the ISA.
            unsafe {
                let first = 8 * half;
                let splat = |x: f32| S::F8::splat(x);
                let abs = |x: S::F8| x.max(splat(0.0) - x);
                for (column, &lanes) in self.ray.iter_mut().zip(rays) {
                    put(column, first, lanes);
                }
                for a in 0..3 {
                    let reciprocal = splat(1.0).div(rays[4 + a]);
                    let offset = splat(-1.0) * rays[a] * reciprocal;
                    let error = splat(OFFSET_ERROR) * abs(offset);
                    put(&mut self.reciprocal[a], first, reciprocal);
                    put(&mut self.near_offset[a], first, offset - error);
                    put(&mut self.far_offset[a], first, offset + error);
                }
                let tmax = rays[7];
                put(&mut self.limit, first, tmax + splat(BEYOND) * abs(tmax));
                let inverse = splat(-1.0).div(rays[k]);
                put(&mut self.shear[0], first, rays[i] * inverse);
                put(&mut self.shear[1], first, rays[j] * inverse);
            }
        }
    }

    /// Tests as many rays as there are lanes, from `first` on, against the box of a leaf, given by its near and far
    /// planes, and against its triangles. Returns how many of those that have no hit yet hit the box.
    ///
    /// # Safety
    /// The CPU must have the ISA; `rows` must be those of a leaf of `count` triangles.
    #[inline(always)]
    pub(super) unsafe fn test<S: Simd>(
        &mut self,
        first: usize,
        planes: &[[f32; 2]; 3],
        rows: *const f32,
        count: usize,
    ) -> u32 {
        // SAFETY: the caller vouches for the ISA and the leaf; rows are `count` apart.
        unsafe {
            let splat = |x: f32| S::Packet::splat(x);
            let axis = |a: usize| {
                let reciprocal = at(&self.reciprocal[a], first);
                (
                    splat(planes[a][0]).mul_add(reciprocal, at(&self.near_offset[a], first)),
                    splat(planes[a][1]).mul_add(reciprocal, at(&self.far_offset[a], first)),
                )
            };
            let ((nx, fx), (ny, fy), (nz, fz)) = (axis(0), axis(1), axis(2));
            let near = nx.max(ny).max(nz.max(at(&self.ray[3], first)));
            let far = fx.min(fy).min(fz.min(at(&self.limit, first)));
            let mut open = near.le(far).bits() & self.left >> first;
            if open == 0 {
                return 0;
            }
            let met = open.count_ones();
            let [i, j, k] = self.axes.map(|a| a as usize);
            let (x, y, z): (S::Packet, S::Packet, S::Packet) =
                (at(&self.ray[i], first), at(&self.ray[j], first), at(&self.ray[k], first));
            let shear = [at(&self.shear[0], first), at(&self.shear[1], first)];
            for triangle in 0..count {
                let corner = |c: usize| {
                    let row = |a: usize| splat(rows.add(triangle + (3 * c + a) * count).read());
                    V3 { x: x - row(i), y: y - row(j), z: z - row(k) }
                };
                let seen = Projected::new([corner(0), corner(1), corner(2)], shear);
                let candidates = seen.inside().bits() & open;
                if candidates == 0 {
                    continue;
                }
                let hits = self.hits::<S>(first, rows, count, triangle, &seen, candidates);
                self.left &= !(hits << first);
                open &= !hits;
                if open == 0 {
                    break;
                }
            }
            met
        }
    }

    /// Which of the candidates, counted from `first` on, hit a triangle within their range.
    ///
    /// # Safety
    /// As for `test`; `triangle` must be below the count.
    #[inline(always)]
    unsafe fn hits<S: Simd>(
        &self,
        first: usize,
        rows: *const f32,
        count: usize,
        triangle: usize,
        seen: &Projected<S::Packet>,
        candidates: u32,
    ) -> u32 {
        // SAFETY: the caller vouches for the ISA and the triangle.
        unsafe {
            let zero = S::Packet::splat(0.0);
            let abs = |x: S::Packet| x.max(zero - x);
            let direction: [S::Packet; 3] = from_fn(|a| at(&self.ray[4 + a], first));
            let back = |a: usize| zero - direction[self.axes[a] as usize];
            let back = V3 { x: back(0), y: back(1), z: back(2) };
            let [x, y, z] = direction.map(abs);
            let (t, is_accurate) = seen.distances_along(back, S::Packet::splat(GRAZING) * (x + y + z));
            let [tmin, tmax]: [S::Packet; 2] = [at(&self.ray[3], first), at(&self.ray[7], first)];
            let accurate = is_accurate.bits();
            let hits = candidates & accurate & tmin.lt(t).and(t.le(tmax)).bits();
            let inaccurate = candidates & !accurate;
            if inaccurate == 0 {
                return hits;
            }
            // If all weights vanish, the ray lies in the plane.
            let inaccurate = inaccurate & zero.lt(abs(seen.u + seen.v + seen.w)).bits();
            // Distances in f64 are slow, and mostly the corners tell enough.
            let (within, outside) = seen.depths(back.z, tmin, tmax);
            let mut hits = hits | inaccurate & within.bits();
            let mut unknown = inaccurate & !within.bits() & !outside.bits();
            while unknown != 0 {
                let lane = unknown.trailing_zeros() as usize;
                unknown &= unknown - 1;
                let ray = |c: usize| self.ray[c][first + lane];
                let shear = Shear::new([ray(0), ray(1), ray(2)], [ray(4), ray(5), ray(6)]);
                let t = accurate_distance(rows, count, triangle, &shear);
                hits |= u32::from(ray(3) < t && t <= ray(7)) << lane;
            }
            hits
        }
    }
}

/// Lanes of a column, from `first` on.
///
/// # Safety
/// The CPU must have the ISA, and the column as many values from there.
#[inline(always)]
unsafe fn at<L: Lanes>(column: &Column, first: usize) -> L {
    // SAFETY: forwarded.
    unsafe { L::load(column.as_ptr().add(first)) }
}

/// Writes lanes to a column, from `first` on.
///
/// # Safety
/// The column must have as many values from there.
#[inline(always)]
unsafe fn put<L: Lanes>(column: &mut Column, first: usize, lanes: L) {
    // SAFETY: forwarded.
    unsafe { lanes.store(column.as_mut_ptr().add(first)) }
}
