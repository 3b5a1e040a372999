//! Lanes over the `wide` crate: SSE2, NEON, simd128 or plain scalars, whatever the target's baseline
//! has.

use super::{Compress, Eight, Four, Lanes, Mask, Simd};
use std::ops::{Add, Mul, Sub};
use wide::f32x4;

/// The target's baseline.
#[derive(Clone, Copy)]
pub(crate) struct Portable;

impl Simd for Portable {
    type F4 = P4;
    type F8 = P8;
    // Four lanes, not eight: with 16 SSE2 registers a pair of them per value spills.
    type Packet = P4;

    #[inline(always)]
    unsafe fn pick(masks: *const u8, numbers: *const u16, count: usize, bit: u32, out: *mut u16) -> usize {
        let mut n = 0;
        for i in 0..count {
            // SAFETY: the caller vouches for `count` masks, numbers, and places; n ≤ i.
            unsafe {
                out.add(n).write(numbers.add(i).read());
                n += (masks.add(i).read() >> bit & 1) as usize;
            }
        }
        n
    }

    #[inline(always)]
    unsafe fn column(masks: &[u8; 32], bit: u32) -> u32 {
        masks.iter().enumerate().fold(0, |set, (i, mask)| set | u32::from(mask >> bit & 1) << i)
    }
}

#[derive(Clone, Copy)]
pub(crate) struct P4(f32x4);

/// Two `f32x4`: the baseline has no wider register.
#[derive(Clone, Copy)]
pub(crate) struct P8(P4, P4);

#[derive(Clone, Copy)]
pub(crate) struct M4(f32x4);

#[derive(Clone, Copy)]
pub(crate) struct M8(M4, M4);

impl Mask for M4 {
    #[inline(always)]
    fn bits(self) -> u32 {
        self.0.to_bitmask()
    }
    #[inline(always)]
    fn and(self, o: Self) -> Self {
        M4(self.0 & o.0)
    }
    #[inline(always)]
    fn or(self, o: Self) -> Self {
        M4(self.0 | o.0)
    }
}

impl Mask for M8 {
    #[inline(always)]
    fn bits(self) -> u32 {
        self.0.bits() | self.1.bits() << 4
    }
    #[inline(always)]
    fn and(self, o: Self) -> Self {
        M8(self.0.and(o.0), self.1.and(o.1))
    }
    #[inline(always)]
    fn or(self, o: Self) -> Self {
        M8(self.0.or(o.0), self.1.or(o.1))
    }
}

macro_rules! op4 {
    ($trait:ident, $f:ident) => {
        impl $trait for P4 {
            type Output = P4;
            #[inline(always)]
            fn $f(self, o: P4) -> P4 {
                P4(self.0.$f(o.0))
            }
        }
        impl $trait for P8 {
            type Output = P8;
            #[inline(always)]
            fn $f(self, o: P8) -> P8 {
                P8(self.0.$f(o.0), self.1.$f(o.1))
            }
        }
    };
}
op4!(Add, add);
op4!(Sub, sub);
op4!(Mul, mul);

impl Lanes for P4 {
    const WIDTH: usize = 4;
    type Mask = M4;
    #[inline(always)]
    unsafe fn splat(x: f32) -> Self {
        P4(f32x4::splat(x))
    }
    #[inline(always)]
    unsafe fn load(p: *const f32) -> Self {
        // SAFETY: the caller vouches for four readable floats; [f32; 4] has f32's alignment.
        P4(f32x4::new(unsafe { p.cast::<[f32; 4]>().read() }))
    }
    #[inline(always)]
    unsafe fn store(self, p: *mut f32) {
        // SAFETY: the caller vouches for four writable floats.
        unsafe { p.cast::<[f32; 4]>().write(self.0.to_array()) }
    }
    #[inline(always)]
    fn div(self, d: Self) -> Self {
        P4(self.0 / d.0)
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        P4(self.0.sqrt())
    }
    #[inline(always)]
    fn min(self, o: Self) -> Self {
        // By comparison, not `fast_min`, whose answer for NaN and ±0 differs between targets.
        // On x86 it compiles to the same minps.
        Self::select(self.lt(o), self, o)
    }
    #[inline(always)]
    fn max(self, o: Self) -> Self {
        Self::select(o.lt(self), self, o)
    }
    #[inline(always)]
    fn mul_add(self, b: Self, c: Self) -> Self {
        // Not wide's mul_add: that fuses on targets whose baseline has FMA, and the result should
        // be the same on every target.
        P4(self.0 * b.0 + c.0)
    }
    #[inline(always)]
    fn lt(self, o: Self) -> M4 {
        M4(self.0.simd_lt(o.0))
    }
    #[inline(always)]
    fn le(self, o: Self) -> M4 {
        M4(self.0.simd_le(o.0))
    }
    #[inline(always)]
    fn select(m: M4, t: Self, f: Self) -> Self {
        P4(m.0.bitselect(t.0, f.0))
    }
}

impl Lanes for P8 {
    const WIDTH: usize = 8;
    type Mask = M8;
    #[inline(always)]
    unsafe fn splat(x: f32) -> Self {
        // SAFETY: forwarded.
        unsafe { P8(P4::splat(x), P4::splat(x)) }
    }
    #[inline(always)]
    unsafe fn load(p: *const f32) -> Self {
        // SAFETY: the caller vouches for eight readable floats.
        unsafe { P8(P4::load(p), P4::load(p.add(4))) }
    }
    #[inline(always)]
    unsafe fn store(self, p: *mut f32) {
        // SAFETY: the caller vouches for eight writable floats.
        unsafe {
            self.0.store(p);
            self.1.store(p.add(4));
        }
    }
    #[inline(always)]
    fn div(self, d: Self) -> Self {
        P8(self.0.div(d.0), self.1.div(d.1))
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        P8(self.0.sqrt(), self.1.sqrt())
    }
    #[inline(always)]
    fn min(self, o: Self) -> Self {
        P8(self.0.min(o.0), self.1.min(o.1))
    }
    #[inline(always)]
    fn max(self, o: Self) -> Self {
        P8(self.0.max(o.0), self.1.max(o.1))
    }
    #[inline(always)]
    fn mul_add(self, b: Self, c: Self) -> Self {
        P8(self.0.mul_add(b.0, c.0), self.1.mul_add(b.1, c.1))
    }
    #[inline(always)]
    fn lt(self, o: Self) -> M8 {
        M8(self.0.lt(o.0), self.1.lt(o.1))
    }
    #[inline(always)]
    fn le(self, o: Self) -> M8 {
        M8(self.0.le(o.0), self.1.le(o.1))
    }
    #[inline(always)]
    fn select(m: M8, t: Self, f: Self) -> Self {
        P8(P4::select(m.0, t.0, f.0), P4::select(m.1, t.1, f.1))
    }
}

impl Four for P4 {
    #[inline(always)]
    unsafe fn gather(from: [*const f32; 4]) -> Self {
        // SAFETY: the caller vouches for the pointers.
        P4(f32x4::new(from.map(|p| unsafe { p.read() })))
    }
}

impl Eight for P8 {
    #[inline(always)]
    unsafe fn pair(low: *const f32, high: *const f32) -> Self {
        // SAFETY: the caller vouches for four floats at each pointer.
        unsafe { P8(P4::load(low), P4::load(high)) }
    }

    #[inline(always)]
    fn spread<const I: i32>(self) -> Self {
        let of = |v: P4| P4(f32x4::splat(v.0.to_array()[I as usize & 3]));
        P8(of(self.0), of(self.1))
    }

    #[inline(always)]
    fn transpose(rows: [P8; 8]) -> [P8; 8] {
        let rows = rows.map(|r| r.to_array());
        let four = |j: usize, i: usize| P4(f32x4::new([0, 1, 2, 3].map(|k| rows[i + k][j])));
        std::array::from_fn(|j| P8(four(j, 0), four(j, 4)))
    }

    #[inline(always)]
    unsafe fn from_bytes(p: *const u8) -> Self {
        // SAFETY: the caller vouches for eight bytes.
        let four = |i: usize| P4(f32x4::new([0, 1, 2, 3].map(|k| unsafe { p.add(i + k).read() } as f32)));
        P8(four(0), four(4))
    }

    #[inline(always)]
    unsafe fn highest_bits(p: *const u32) -> u32 {
        // SAFETY: the caller vouches for eight numbers.
        (0..8).fold(0, |bits, i| bits | unsafe { p.add(i).read_unaligned() } >> 31 << i)
    }
}

macro_rules! compress {
    ($v:ident, $width:literal) => {
        impl Compress for $v {
            #[inline(always)]
            unsafe fn compress(
                self,
                names: *const u32,
                order: *const u32,
                shift: u32,
                mask: Self::Mask,
                values: *mut f32,
                out_names: *mut u32,
            ) -> u32 {
                let (own, mask) = (self.to_array(), mask.bits());
                let (mut n, mut set) = (0, 0);
                for i in 0..$width {
                    // SAFETY: the caller vouches for `$width` values at each pointer; n ≤ i and `lane` are below it.
                    unsafe {
                        let lane = (order.add(i).read() >> shift & 7) as usize;
                        values.add(n).write(own[lane]);
                        out_names.add(n).write(names.add(lane).read());
                        n += (mask >> lane & 1) as usize;
                        set |= (mask >> lane & 1) << i;
                    }
                }
                set
            }
        }
    };
}

compress!(P4, 4);
compress!(P8, 8);
