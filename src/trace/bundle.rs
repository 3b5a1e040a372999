//! Which consecutive rays make a bundle, to be traced [together](super::packet).

use super::Ray;
use super::tree::{FARTHEST_ORIGIN, STEEP};
use crate::simd::{self, Eight, Lanes, Mask, Simd};
use std::array::from_fn;

/// Maximum number of rays in a bundle. (In tiles of 4 × 4 pixels, 128 were no faster.)
pub(super) const SIZE: usize = 64;

/// Minimum number of rays in a bundle; fewer are traced one by one.
pub(super) const LEAST: usize = 12;

/// Maximum difference of slopes against the longest axis in a bundle.
const SPREAD: f32 = 0.4;

/// Range of the largest component of a direction.
const LARGEST: std::ops::RangeInclusive<f32> = 1e-6..=1e6;

/// Range of the slopes of rays against their longest axis.
#[derive(Clone, Copy)]
struct Slopes {
    least: [f32; 2],
    most: [f32; 2],
}

impl Slopes {
    const NONE: Slopes = Slopes { least: [f32::INFINITY; 2], most: [0.0; 2] };

    fn are_narrow(&self) -> bool {
        (self.most[0] - self.least[0] <= SPREAD) & (self.most[1] - self.least[1] <= SPREAD)
    }
}

/// The longest axis of a bundle's rays, behind the other two, and the signs of their directions.
struct Way {
    axes: [usize; 3],
    sign: [f32; 3],
}

/// Number of rays before the next bundles, and of those in bundles that follow one another from there on.
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
pub(super) unsafe fn next<S: Simd>(rays: &[Ray]) -> (usize, usize) {
    let (mut before, mut end) = (0, 0);
    while end < rays.len() {
        // SAFETY: forwarded.
        let length = unsafe { bundle::<S>(&rays[end..]) };
        if length >= LEAST {
            end += length;
        } else if before < end {
            break;
        } else {
            before += length.max(1);
            end = before;
        }
    }
    (before, end - before)
}

/// Number of rays, from the first, that make a bundle: they share their origin and tmin, octant and longest axis of their
/// directions, and nearly their slopes. It is less than [`LEAST`] if there is no bundle.
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
pub(super) unsafe fn bundle<S: Simd>(rays: &[Ray]) -> usize {
    // Rejects most rays that are in no bundle at once.
    if rays.len() < LEAST || !starts_as(&rays[1], &rays[0]) || !starts_as(&rays[0], &rays[0]) {
        return 0;
    }
    let rays = &rays[..rays.len().min(SIZE)];
    let first = &rays[0];
    let (Some(k), true) = (longest_axis(first.direction), first.origin.iter().all(|o| o.abs() <= FARTHEST_ORIGIN))
    else {
        return 0;
    };
    let way = Way { axes: [(k + 1) % 3, (k + 2) % 3, k], sign: first.direction.map(|d| 1f32.copysign(d)) };
    // SAFETY: forwarded.
    let (mut n, mut slopes) = unsafe { eights::<S>(rays, &way) };
    if !slopes.are_narrow() {
        (n, slopes) = (0, Slopes::NONE);
    }
    for ray in &rays[n..] {
        if !(starts_as(ray, first) && goes_alike(ray, &way, &mut slopes)) {
            return n;
        }
        n += 1;
    }
    n
}

/// The axis of the largest component of a direction; `None` if there are several such axes or the direction needs
/// special treatment in a test.
#[inline(always)]
fn longest_axis(d: [f32; 3]) -> Option<usize> {
    let [x, y, z] = d.map(f32::abs);
    let (k, least) = if x > y && x > z {
        (0, y.min(z))
    } else if y > z && y > x {
        (1, x.min(z))
    } else if z > x && z > y {
        (2, x.min(y))
    } else {
        return None;
    };
    let largest = d[k].abs();
    (LARGEST.contains(&largest) && least > STEEP * largest).then_some(k)
}

/// Whether a ray is not empty and has the same origin and tmin as another, bit for bit.
#[inline(always)]
fn starts_as(a: &Ray, b: &Ray) -> bool {
    // All at once, without branches.
    let differ = |a: f32, b: f32| a.to_bits() ^ b.to_bits();
    let origin = (0..3).fold(0, |sum, i| sum | differ(a.origin[i], b.origin[i]));
    (origin | differ(a.tmin, b.tmin) == 0) & (a.tmax > a.tmin)
}

/// Whether a ray goes the way of others whose slopes are given, to which its own are added.
#[inline(always)]
fn goes_alike(ray: &Ray, &Way { axes: [i, j, k], sign }: &Way, slopes: &mut Slopes) -> bool {
    let [x, y, z] = [ray.direction[i] * sign[i], ray.direction[j] * sign[j], ray.direction[k] * sign[k]];
    // The conditions of `longest_axis`, and the octant.
    let is_alike = (x < z) & (y < z) & (x > STEEP * z) & (y > STEEP * z) & LARGEST.contains(&z);
    let inverse = 1.0 / z;
    for (a, s) in [x * inverse, y * inverse].into_iter().enumerate() {
        slopes.least[a] = if s < slopes.least[a] { s } else { slopes.least[a] };
        slopes.most[a] = if s > slopes.most[a] { s } else { slopes.most[a] };
    }
    is_alike & slopes.are_narrow()
}

/// Number of rays, in whole eights from the first on, that start as the first and go its way, and their slopes, however
/// much these differ. (In lanes, since ray by ray this was a fifth of the time of primary rays in Sponza.)
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
unsafe fn eights<S: Simd>(rays: &[Ray], &Way { axes: [i, j, k], sign }: &Way) -> (usize, Slopes) {
    let first: [u32; 8] = bytemuck::cast(rays[0]);
    let mut n = 0;
    // SAFETY: the caller vouches for the ISA.
    unsafe {
        let splat = |x: f32| S::F8::splat(x);
        let [si, sj, sk] = [splat(sign[i]), splat(sign[j]), splat(sign[k])];
        let (steep, one, tmin) = (splat(STEEP), splat(1.0), splat(rays[0].tmin));
        let (mut least, mut most) = ([splat(f32::INFINITY); 2], [splat(0.0); 2]);
        for eight in rays.chunks_exact(8) {
            let mut differ = [0; 8];
            for ray in eight {
                let bits: [u32; 8] = bytemuck::cast(*ray);
                differ = from_fn(|a| differ[a] | bits[a] ^ first[a]);
            }
            let (d, tmax) = directions_and_ends::<S>(eight);
            let (x, y, z) = (d[i] * si, d[j] * sj, d[k] * sk);
            let limit = steep * z;
            let is_alike = x.lt(z).and(y.lt(z)).and(limit.lt(x)).and(limit.lt(y));
            let is_alike = is_alike.and(splat(*LARGEST.start()).le(z)).and(z.le(splat(*LARGEST.end())));
            let is_alike = is_alike.and(tmin.lt(tmax));
            let [ox, oy, oz, begin, ..] = differ;
            if ox | oy | oz | begin != 0 || is_alike.bits() & 0xff != 0xff {
                break;
            }
            let inverse = one.div(z);
            for (a, s) in [x * inverse, y * inverse].into_iter().enumerate() {
                (least[a], most[a]) = (least[a].min(s), most[a].max(s));
            }
            n += 8;
        }
        (n, Slopes { least: least.map(simd::least), most: most.map(simd::greatest) })
    }
}

/// The directions of eight rays, by component, and their tmax.
///
/// # Safety
/// The CPU must have the ISA, and there must be eight rays.
#[inline(always)]
pub(super) unsafe fn directions_and_ends<S: Simd>(rays: &[Ray]) -> ([S::F8; 3], S::F8) {
    debug_assert_eq!(rays.len(), 8);
    // SAFETY: forwarded; a ray is eight floats.
    let rows = from_fn(|r| unsafe { S::F8::load(rays.as_ptr().add(r).cast()) });
    let [_, _, _, _, x, y, z, tmax] = S::F8::transpose(rows);
    ([x, y, z], tmax)
}
