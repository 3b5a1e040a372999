//! Keys of rays: by the octant and the longest axis of their directions, as streams sort them.

use super::tree::{FARTHEST_ORIGIN, STEEP};
use crate::simd::{Eight, Mask};

/// Key of rays that need special treatment in a test; the other keys are 3 · octant + axis.
pub(super) const SPECIAL: usize = 24;

/// Whether eight keys are the same, as they are of most rays that go to a lamp.
pub(super) fn is_uniform(keys: [u8; 8]) -> bool {
    u64::from_ne_bytes(keys) == u64::from_ne_bytes([keys[0]; 8])
}

/// Keys of eight rays, by components. Special are rays that cannot hit anything, those whose direction has to be scaled,
/// and those that take the slower box test.
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
pub(super) unsafe fn keys_of<L: Eight>(rays: [L; 8]) -> [u8; 8] {
    let [ox, oy, oz, tmin, dx, dy, dz, tmax] = rays;
    // SAFETY: the caller vouches for the ISA.
    let splat = |x: f32| unsafe { L::splat(x) };
    let zero = splat(0.0);
    let abs = |x: L| x.max(zero - x);
    let (x, y, z) = (abs(dx), abs(dy), abs(dz));
    let largest = x.max(y).max(z);
    let least = x.min(y).min(z);
    // NaN is in none of these ranges: it is the greater and the lesser of itself and another only in one order.
    let is_number = |v: L| v.le(v);
    let near = |o: L| abs(o).le(splat(FARTHEST_ORIGIN)).and(is_number(o));
    let is_ordinary = splat(1e-6)
        .le(largest)
        .and(largest.le(splat(1e6)))
        .and((splat(STEEP) * largest).lt(least))
        .and(is_number(x).and(is_number(y)).and(is_number(z)))
        .and(near(ox).and(near(oy)).and(near(oz)))
        .and(tmin.lt(tmax));
    let is_x = y.lt(x).and(z.lt(x));
    let bits = [dx.lt(zero), dy.lt(zero), dz.lt(zero), is_x, z.lt(y), is_ordinary].map(|mask| mask.bits());
    if bits.iter().all(|&bits| bits == 0 || bits == 0xff) {
        return [key_of(bits, 0); 8];
    }
    std::array::from_fn(|i| key_of(bits, i))
}

/// Key of ray i (from masks, which was measured together with packs given up one by one:
/// docs/experiments.md#streams), of which bits i tell whether its direction is negative along x, y and z, whether x is its longest axis,
/// whether it is longer along y than along z, and whether it is not special.
#[inline(always)]
fn key_of(bits: [u32; 6], i: usize) -> u8 {
    let [x, y, z, is_x, is_y, is_ordinary] = bits.map(|bits| (bits >> i) as u8 & 1);
    match is_ordinary {
        0 => SPECIAL as u8,
        _ => 3 * (x + 2 * y + 4 * z) + (1 - is_x) * (2 - is_y),
    }
}
