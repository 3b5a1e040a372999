//! Lanes over AVX-512: 512-bit vectors with mask registers for packets. Nodes and leaves keep the
//! 128- and 256-bit vectors of AVX2, whose shape they have: four triangles, eight children.

use super::avx2::{A4, A8, pick};
use super::{Lanes, Mask, Simd};
use std::arch::x86_64::*;
use std::ops::{Add, Mul, Sub};

/// AVX-512 F, VL, DQ and BW.
#[derive(Clone, Copy)]
pub(crate) struct Avx512;

impl Simd for Avx512 {
    type F4 = A4;
    type F8 = A8;
    type Packet = A16;

    #[inline(always)]
    unsafe fn pick(masks: *const u8, numbers: *const u16, count: usize, bit: u32, out: *mut u16) -> usize {
        // SAFETY: forwarded.
        unsafe { pick(masks, numbers, count, bit, out) }
    }

    #[inline(always)]
    unsafe fn column(masks: &[u8; 32], bit: u32) -> u32 {
        // SAFETY: the caller vouches for the ISA.
        unsafe { _mm256_test_epi8_mask(_mm256_loadu_si256(masks.as_ptr().cast()), _mm256_set1_epi8(1 << bit)) }
    }
}

/// [`Avx512`] with VBMI2, by which streams make their lists.
#[derive(Clone, Copy)]
pub(crate) struct Avx512Vbmi2;

impl Simd for Avx512Vbmi2 {
    type F4 = A4;
    type F8 = A8;
    type Packet = A16;

    /// 32 numbers at a time. (To a register and from there to memory: compressing to memory is slow on Zen 4.)
    #[inline(always)]
    unsafe fn pick(masks: *const u8, numbers: *const u16, count: usize, bit: u32, out: *mut u16) -> usize {
        let mut n = 0;
        // SAFETY: the caller vouches for masks and numbers up to the next multiple of 32, and for `out`, of which no
        // more than `count` numbers have been taken when 32 more are written.
        unsafe {
            let bit = _mm256_set1_epi8(1 << bit);
            for first in (0..count).step_by(32) {
                let set = _mm256_test_epi8_mask(_mm256_loadu_si256(masks.add(first).cast()), bit);
                let picked = _mm512_maskz_compress_epi16(set, _mm512_loadu_si512(numbers.add(first).cast()));
                _mm512_storeu_si512(out.add(n).cast(), picked);
                n += set.count_ones() as usize;
            }
        }
        n
    }

    #[inline(always)]
    unsafe fn column(masks: &[u8; 32], bit: u32) -> u32 {
        // SAFETY: the caller vouches for the ISA.
        unsafe { _mm256_test_epi8_mask(_mm256_loadu_si256(masks.as_ptr().cast()), _mm256_set1_epi8(1 << bit)) }
    }
}

#[derive(Clone, Copy)]
pub(crate) struct A16(__m512);

#[derive(Clone, Copy)]
pub(crate) struct M16(__mmask16);

impl Mask for M16 {
    #[inline(always)]
    fn bits(self) -> u32 {
        self.0 as u32
    }
    #[inline(always)]
    fn and(self, o: Self) -> Self {
        M16(self.0 & o.0)
    }
    #[inline(always)]
    fn or(self, o: Self) -> Self {
        M16(self.0 | o.0)
    }
}

/// Applies an intrinsic of AVX-512 F to values.
macro_rules! on_values {
    ($intrinsic:expr, $($value:expr),*) => {
        // SAFETY: the intrinsic touches no memory, and an `A16` among the values exists only where the CPU
        // has the ISA (see the module docs of `simd`).
        unsafe { $intrinsic($($value),*) }
    };
}

impl Add for A16 {
    type Output = A16;
    #[inline(always)]
    fn add(self, o: A16) -> A16 {
        A16(on_values!(_mm512_add_ps, self.0, o.0))
    }
}
impl Sub for A16 {
    type Output = A16;
    #[inline(always)]
    fn sub(self, o: A16) -> A16 {
        A16(on_values!(_mm512_sub_ps, self.0, o.0))
    }
}
impl Mul for A16 {
    type Output = A16;
    #[inline(always)]
    fn mul(self, o: A16) -> A16 {
        A16(on_values!(_mm512_mul_ps, self.0, o.0))
    }
}

impl Lanes for A16 {
    const WIDTH: usize = 16;
    type Mask = M16;
    #[inline(always)]
    unsafe fn splat(x: f32) -> Self {
        // SAFETY: the caller vouches for the ISA.
        A16(unsafe { _mm512_set1_ps(x) })
    }
    #[inline(always)]
    unsafe fn load(p: *const f32) -> Self {
        // SAFETY: the caller vouches for the ISA and the floats; an unaligned load.
        A16(unsafe { _mm512_loadu_ps(p) })
    }
    #[inline(always)]
    unsafe fn store(self, p: *mut f32) {
        // SAFETY: the caller vouches for the floats; an unaligned store.
        unsafe { _mm512_storeu_ps(p, self.0) }
    }
    #[inline(always)]
    fn div(self, d: Self) -> Self {
        A16(on_values!(_mm512_div_ps, self.0, d.0))
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        A16(on_values!(_mm512_sqrt_ps, self.0))
    }
    #[inline(always)]
    fn min(self, o: Self) -> Self {
        A16(on_values!(_mm512_min_ps, self.0, o.0))
    }
    #[inline(always)]
    fn max(self, o: Self) -> Self {
        A16(on_values!(_mm512_max_ps, self.0, o.0))
    }
    #[inline(always)]
    fn mul_add(self, b: Self, c: Self) -> Self {
        A16(on_values!(_mm512_fmadd_ps, self.0, b.0, c.0))
    }
    #[inline(always)]
    fn lt(self, o: Self) -> M16 {
        M16(on_values!(_mm512_cmp_ps_mask::<_CMP_LT_OQ>, self.0, o.0))
    }
    #[inline(always)]
    fn le(self, o: Self) -> M16 {
        M16(on_values!(_mm512_cmp_ps_mask::<_CMP_LE_OQ>, self.0, o.0))
    }
    #[inline(always)]
    fn select(m: M16, t: Self, f: Self) -> Self {
        A16(on_values!(_mm512_mask_blend_ps, m.0, f.0, t.0))
    }
}
