//! Lanes over AVX2 and FMA: 128-bit vectors of four, 256-bit vectors of eight.

use super::{Compress, Eight, Four, Lanes, Mask, Simd};
use std::arch::x86_64::*;
use std::ops::{Add, Mul, Sub};

/// AVX2 with FMA.
#[derive(Clone, Copy)]
pub(crate) struct Avx2;

impl Simd for Avx2 {
    type F4 = A4;
    type F8 = A8;
    type Packet = A8;

    #[inline(always)]
    unsafe fn pick(masks: *const u8, numbers: *const u16, count: usize, bit: u32, out: *mut u16) -> usize {
        // SAFETY: forwarded.
        unsafe { pick(masks, numbers, count, bit, out) }
    }

    #[inline(always)]
    unsafe fn column(masks: &[u8; 32], bit: u32) -> u32 {
        // SAFETY: the caller vouches for the ISA.
        unsafe {
            let shift = _mm_cvtsi32_si128(7 - bit as i32);
            _mm256_movemask_epi8(_mm256_sll_epi16(_mm256_loadu_si256(masks.as_ptr().cast()), shift)) as u32
        }
    }
}

/// [`Simd::pick`]: the bits of 32 masks by `vpmovmskb`, then eight numbers at a time by a table of shuffles.
///
/// # Safety
/// As there.
#[inline(always)]
pub(super) unsafe fn pick(masks: *const u8, numbers: *const u16, count: usize, bit: u32, out: *mut u16) -> usize {
    let mut n = 0;
    // SAFETY: the caller vouches for masks and numbers up to the next multiples of 32 and 8, and for `out`, of which
    // no more than `count` numbers have been taken when eight more are written.
    unsafe {
        let shift = _mm_cvtsi32_si128(7 - bit as i32);
        for first in (0..count).step_by(32) {
            let masks = _mm256_loadu_si256(masks.add(first).cast());
            // The bit is the highest of its byte; what comes from the byte below lies lower.
            let mut sets = _mm256_movemask_epi8(_mm256_sll_epi16(masks, shift)) as u32;
            for i in (first..count.min(first + 32)).step_by(8) {
                let set = sets as usize & 0xff;
                let kept = _mm_loadu_si128(NUMBERS_OF[set].as_ptr().cast());
                let picked = _mm_shuffle_epi8(_mm_loadu_si128(numbers.add(i).cast()), kept);
                _mm_storeu_si128(out.add(n).cast(), picked);
                n += set.count_ones() as usize;
                sets >>= 8;
            }
        }
    }
    n
}

/// For each set of eight 16-bit numbers, the bytes of the set's numbers in ascending order.
static NUMBERS_OF: [[u8; 16]; 256] = {
    let mut table = [[0; 16]; 256];
    let mut set = 0;
    while set < 256 {
        let mut i = 0;
        while i < 8 {
            table[set][2 * i] = 2 * LANES_OF[set][i];
            table[set][2 * i + 1] = 2 * LANES_OF[set][i] + 1;
            i += 1;
        }
        set += 1;
    }
    table
};

#[derive(Clone, Copy)]
pub(crate) struct A4(pub(super) __m128);

#[derive(Clone, Copy)]
pub(crate) struct A8(pub(super) __m256);

/// Applies an intrinsic of AVX2 or FMA to values.
macro_rules! on_values {
    ($intrinsic:expr, $($value:expr),*) => {
        // SAFETY: the intrinsic touches no memory, and a vector among the values exists only where the CPU
        // has the ISA (see the module docs of `simd`).
        unsafe { $intrinsic($($value),*) }
    };
}

macro_rules! lanes {
    ($v:ident, $raw:ty, $width:expr, $splat:ident, $load:ident, $store:ident, $add:ident, $sub:ident, $mul:ident,
     $div:ident, $sqrt:ident, $min:ident, $max:ident, $fmadd:ident, $cmp:ident, $blend:ident, $movemask:ident, $and:ident, $or:ident) => {
        impl Mask for $v {
            #[inline(always)]
            fn bits(self) -> u32 {
                on_values!($movemask, self.0) as u32
            }
            #[inline(always)]
            fn and(self, o: Self) -> Self {
                $v(on_values!($and, self.0, o.0))
            }
            #[inline(always)]
            fn or(self, o: Self) -> Self {
                $v(on_values!($or, self.0, o.0))
            }
        }
        impl Add for $v {
            type Output = $v;
            #[inline(always)]
            fn add(self, o: $v) -> $v {
                $v(on_values!($add, self.0, o.0))
            }
        }
        impl Sub for $v {
            type Output = $v;
            #[inline(always)]
            fn sub(self, o: $v) -> $v {
                $v(on_values!($sub, self.0, o.0))
            }
        }
        impl Mul for $v {
            type Output = $v;
            #[inline(always)]
            fn mul(self, o: $v) -> $v {
                $v(on_values!($mul, self.0, o.0))
            }
        }
        impl Lanes for $v {
            const WIDTH: usize = $width;
            // A comparison gives all-ones or all-zeros lanes of the same vector type.
            type Mask = $v;
            #[inline(always)]
            unsafe fn splat(x: f32) -> Self {
                // SAFETY: the caller vouches for the ISA.
                $v(unsafe { $splat(x) })
            }
            #[inline(always)]
            unsafe fn load(p: *const f32) -> Self {
                // SAFETY: the caller vouches for the ISA and the floats; an unaligned load.
                $v(unsafe { $load(p) })
            }
            #[inline(always)]
            unsafe fn store(self, p: *mut f32) {
                // SAFETY: the caller vouches for the floats; an unaligned store.
                unsafe { $store(p, self.0) }
            }
            #[inline(always)]
            fn div(self, d: Self) -> Self {
                $v(on_values!($div, self.0, d.0))
            }
            #[inline(always)]
            fn sqrt(self) -> Self {
                $v(on_values!($sqrt, self.0))
            }
            #[inline(always)]
            fn min(self, o: Self) -> Self {
                $v(on_values!($min, self.0, o.0))
            }
            #[inline(always)]
            fn max(self, o: Self) -> Self {
                $v(on_values!($max, self.0, o.0))
            }
            #[inline(always)]
            fn mul_add(self, b: Self, c: Self) -> Self {
                $v(on_values!($fmadd, self.0, b.0, c.0))
            }
            #[inline(always)]
            fn lt(self, o: Self) -> $v {
                $v(on_values!($cmp::<_CMP_LT_OQ>, self.0, o.0))
            }
            #[inline(always)]
            fn le(self, o: Self) -> $v {
                $v(on_values!($cmp::<_CMP_LE_OQ>, self.0, o.0))
            }
            #[inline(always)]
            fn select(m: $v, t: Self, f: Self) -> Self {
                $v(on_values!($blend, f.0, t.0, m.0))
            }
        }
    };
}

lanes!(
    A4,
    __m128,
    4,
    _mm_set1_ps,
    _mm_loadu_ps,
    _mm_storeu_ps,
    _mm_add_ps,
    _mm_sub_ps,
    _mm_mul_ps,
    _mm_div_ps,
    _mm_sqrt_ps,
    _mm_min_ps,
    _mm_max_ps,
    _mm_fmadd_ps,
    _mm_cmp_ps,
    _mm_blendv_ps,
    _mm_movemask_ps,
    _mm_and_ps,
    _mm_or_ps
);
lanes!(
    A8,
    __m256,
    8,
    _mm256_set1_ps,
    _mm256_loadu_ps,
    _mm256_storeu_ps,
    _mm256_add_ps,
    _mm256_sub_ps,
    _mm256_mul_ps,
    _mm256_div_ps,
    _mm256_sqrt_ps,
    _mm256_min_ps,
    _mm256_max_ps,
    _mm256_fmadd_ps,
    _mm256_cmp_ps,
    _mm256_blendv_ps,
    _mm256_movemask_ps,
    _mm256_and_ps,
    _mm256_or_ps
);

/// For each set of lanes, the lanes of the set in ascending order.
static LANES_OF: [[u8; 8]; 256] = {
    let mut table = [[0; 8]; 256];
    let mut set = 0;
    while set < 256 {
        let (mut lane, mut n) = (0, 0);
        while lane < 8 {
            if set >> lane & 1 == 1 {
                table[set][n] = lane as u8;
                n += 1;
            }
            lane += 1;
        }
        set += 1;
    }
    table
};

impl Four for A4 {
    #[inline(always)]
    unsafe fn gather([a, b, c, d]: [*const f32; 4]) -> Self {
        // SAFETY: the caller vouches for the pointers. (One load and three inserts; the gather instruction is
        // slower.)
        A4(unsafe { _mm_setr_ps(a.read(), b.read(), c.read(), d.read()) })
    }
}

impl Compress for A4 {
    #[inline(always)]
    unsafe fn compress(
        self,
        names: *const u32,
        order: *const u32,
        shift: u32,
        mask: A4,
        values: *mut f32,
        out_names: *mut u32,
    ) -> u32 {
        // SAFETY: the caller vouches for four values at each pointer. Permutations use the lowest
        // two bits of each index alone.
        unsafe {
            let order = _mm_srlv_epi32(_mm_loadu_si128(order.cast()), _mm_set1_epi32(shift as i32));
            let set = _mm_movemask_ps(_mm_permutevar_ps(mask.0, order)) as usize;
            // A set of four lanes is one of eight without the others.
            let kept = _mm_cvtepu8_epi32(_mm_loadu_si32(LANES_OF[set].as_ptr().cast()));
            let from = _mm_castps_si128(_mm_permutevar_ps(_mm_castsi128_ps(order), kept));
            _mm_storeu_ps(values, _mm_permutevar_ps(self.0, from));
            let names = _mm_permutevar_ps(_mm_loadu_ps(names.cast()), from);
            _mm_storeu_ps(out_names.cast(), names);
            set as u32
        }
    }
}

impl Eight for A8 {
    #[inline(always)]
    unsafe fn pair(low: *const f32, high: *const f32) -> Self {
        // SAFETY: the caller vouches for four floats at each pointer.
        A8(unsafe { _mm256_insertf128_ps::<1>(_mm256_castps128_ps256(_mm_loadu_ps(low)), _mm_loadu_ps(high)) })
    }

    #[inline(always)]
    fn spread<const I: i32>(self) -> Self {
        match I {
            0 => A8(on_values!(_mm256_permute_ps::<0x00>, self.0)),
            1 => A8(on_values!(_mm256_permute_ps::<0x55>, self.0)),
            2 => A8(on_values!(_mm256_permute_ps::<0xaa>, self.0)),
            _ => A8(on_values!(_mm256_permute_ps::<0xff>, self.0)),
        }
    }

    #[inline(always)]
    fn transpose(r: [A8; 8]) -> [A8; 8] {
        // Pairs, then fours of each half, then halves.
        let low = |a: A8, b: A8| A8(on_values!(_mm256_unpacklo_ps, a.0, b.0));
        let high = |a: A8, b: A8| A8(on_values!(_mm256_unpackhi_ps, a.0, b.0));
        let (a0, a1, a2, a3) = (low(r[0], r[1]), high(r[0], r[1]), low(r[2], r[3]), high(r[2], r[3]));
        let (a4, a5, a6, a7) = (low(r[4], r[5]), high(r[4], r[5]), low(r[6], r[7]), high(r[6], r[7]));
        let low = |a: A8, b: A8| A8(on_values!(_mm256_shuffle_ps::<0x44>, a.0, b.0));
        let high = |a: A8, b: A8| A8(on_values!(_mm256_shuffle_ps::<0xee>, a.0, b.0));
        let (b0, b1, b2, b3) = (low(a0, a2), high(a0, a2), low(a1, a3), high(a1, a3));
        let (b4, b5, b6, b7) = (low(a4, a6), high(a4, a6), low(a5, a7), high(a5, a7));
        let low = |a: A8, b: A8| A8(on_values!(_mm256_permute2f128_ps::<0x20>, a.0, b.0));
        let high = |a: A8, b: A8| A8(on_values!(_mm256_permute2f128_ps::<0x31>, a.0, b.0));
        [low(b0, b4), low(b1, b5), low(b2, b6), low(b3, b7), high(b0, b4), high(b1, b5), high(b2, b6), high(b3, b7)]
    }

    #[inline(always)]
    unsafe fn from_bytes(p: *const u8) -> Self {
        // SAFETY: the caller vouches for eight bytes.
        A8(unsafe { _mm256_cvtepi32_ps(_mm256_cvtepu8_epi32(_mm_loadl_epi64(p.cast()))) })
    }

    #[inline(always)]
    unsafe fn highest_bits(p: *const u32) -> u32 {
        // SAFETY: the caller vouches for eight numbers.
        unsafe { _mm256_movemask_ps(_mm256_loadu_ps(p.cast())) as u32 }
    }
}

impl Compress for A8 {
    #[inline(always)]
    unsafe fn compress(
        self,
        names: *const u32,
        order: *const u32,
        shift: u32,
        mask: A8,
        values: *mut f32,
        out_names: *mut u32,
    ) -> u32 {
        // SAFETY: the caller vouches for eight values at each pointer. Permutations use the lowest
        // three bits of each index alone.
        unsafe {
            // (A shift by one count in a vector register made the compiler get the count from a load of its neighbours,
            // by an instruction that waited for the boxes: single rays took up to 4 % longer on AVX-512.)
            let order = _mm256_srlv_epi32(_mm256_loadu_si256(order.cast()), _mm256_set1_epi32(shift as i32));
            let set = _mm256_movemask_ps(_mm256_permutevar8x32_ps(mask.0, order)) as usize;
            let kept = _mm256_cvtepu8_epi32(_mm_loadl_epi64(LANES_OF[set].as_ptr().cast()));
            let from = _mm256_permutevar8x32_epi32(order, kept);
            _mm256_storeu_ps(values, _mm256_permutevar8x32_ps(self.0, from));
            let names = _mm256_permutevar8x32_epi32(_mm256_loadu_si256(names.cast()), from);
            _mm256_storeu_si256(out_names.cast(), names);
            set as u32
        }
    }
}
