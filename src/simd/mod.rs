//! Lanes: f32 vectors of a few widths over several instruction sets, and the choice between them at
//! run time. Nothing in here knows about rays.
//!
//! A kernel is written once, `#[inline(always)] unsafe fn kernel<S: Simd>(…)`, over the vectors of
//! [`Simd`]. Per ISA there is one entry point with `#[target_feature]` into which everything
//! inlines, and a table of function pointers binds them when the device is created (the design of
//! memchr's `arch` tree).
//!
//! # Safety
//!
//! The only ways to make a vector are [`Lanes::splat`] and the loads, which are unsafe: the caller
//! promises that the CPU has the ISA. A value of the type is therefore proof that the ISA is there,
//! and all arithmetic on it is safe. Entry points, which [`entry_point`] makes, are unsafe for the same
//! reason and are reached only through tables chosen by [`Isa::is_available`]. Both take the ISA's CPU
//! features from [`isa_features`], so that no entry point can use a feature which the check leaves out.

use std::ops::{Add, Mul, Sub};
use std::sync::OnceLock;

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod kernel;
mod portable;

#[cfg(target_arch = "x86_64")]
pub(crate) use avx2::Avx2;
#[cfg(target_arch = "x86_64")]
pub(crate) use avx512::{Avx512, Avx512Vbmi2};
pub(crate) use kernel::kernel;
pub(crate) use portable::Portable;

/// Calls the macro `$then` with the CPU features of an ISA in brackets, followed by `$args`.
macro_rules! isa_features {
    (Portable => $then:ident! { $($args:tt)* }) => { $then! { [] $($args)* } };
    // Bit counts came to every CPU no later than AVX2.
    (Avx2 => $then:ident! { $($args:tt)* }) => {
        $then! { ["avx2" "fma" "popcnt" "lzcnt" "bmi1" "bmi2"] $($args)* }
    };
    (Avx512 => $then:ident! { $($args:tt)* }) => {
        $then! {
            ["avx2" "fma" "popcnt" "lzcnt" "bmi1" "bmi2" "avx512f" "avx512vl" "avx512dq" "avx512bw"] $($args)*
        }
    };
    (Avx512Vbmi2 => $then:ident! { $($args:tt)* }) => {
        $then! {
            ["avx2" "fma" "popcnt" "lzcnt" "bmi1" "bmi2" "avx512f" "avx512vl" "avx512dq" "avx512bw" "avx512vbmi2"]
            $($args)*
        }
    };
}
pub(crate) use isa_features;

/// Defines the entry point of a kernel, compiled for the features of an ISA:
/// `isa_features! { Avx2 => entry_point! { fn name(arguments) -> result { body } } }`.
///
/// The body may call whatever needs nothing but the ISA. The function is unsafe: its caller promises that
/// the CPU has the ISA.
macro_rules! entry_point {
    ([$($feature:literal)*] fn $name:ident $([const $flag:ident: bool])? ($($arg:ident: $type:ty),*) $(-> $result:ty)?
        $body:block
    ) => {
        $(#[target_feature(enable = $feature)])*
        unsafe fn $name $(<const $flag: bool>)? ($($arg: $type),*) $(-> $result)? {
            // SAFETY: the body needs the ISA alone, for which the caller of an entry point vouches.
            unsafe { $body }
        }
    };
}
pub(crate) use entry_point;

/// Whether the CPU has all of the features.
#[cfg(all(target_arch = "x86_64", not(miri)))]
macro_rules! cpu_has {
    ([$($feature:tt)*]) => { true $(&& std::arch::is_x86_feature_detected!($feature))* };
}

/// Environment variable with the name of the best ISA to use, whatever the machine has. Any other word than a name
/// allows none, so that a misspelt one is not taken for a test of what it meant.
pub(crate) const LIMIT_VARIABLE: &str = "BAKELITE_ISA";

/// What the environment allows; read once, so that it is the same for a whole process.
fn limit() -> Option<Isa> {
    static LIMIT: OnceLock<Option<Isa>> = OnceLock::new();
    *LIMIT.get_or_init(|| match std::env::var_os(LIMIT_VARIABLE) {
        Some(name) => Isa::ALL.into_iter().find(|isa| name == isa.name()),
        None => Some(Isa::Avx512),
    })
}

/// An instruction set that kernels are compiled for; the greater, the better.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Hash)]
#[repr(u32)]
pub enum Isa {
    /// The `wide` crate's vectors at the target's baseline: SSE2, NEON, simd128 or scalar.
    Portable = 1,
    /// AVX2 with FMA.
    Avx2 = 2,
    /// AVX-512 F, VL, DQ and BW, with AVX2 and FMA.
    Avx512 = 3,
}

impl Isa {
    /// All of them, best last.
    pub const ALL: [Isa; 3] = [Isa::Portable, Isa::Avx2, Isa::Avx512];

    /// Whether this machine can run it, and the environment variable `BAKELITE_ISA` allows it.
    pub fn is_available(self) -> bool {
        let is_allowed = limit().is_some_and(|best| self <= best);
        // Miri interprets no intrinsics of wide vectors.
        #[cfg(all(target_arch = "x86_64", not(miri)))]
        let is_there = match self {
            Isa::Portable => true,
            Isa::Avx2 => isa_features! { Avx2 => cpu_has! {} },
            Isa::Avx512 => isa_features! { Avx512 => cpu_has! {} },
        };
        #[cfg(any(not(target_arch = "x86_64"), miri))]
        let is_there = self == Isa::Portable;
        is_allowed && is_there
    }

    /// Whether this machine has VBMI2 beside AVX-512.
    pub(crate) fn has_vbmi2() -> bool {
        #[cfg(all(target_arch = "x86_64", not(miri)))]
        {
            isa_features! { Avx512Vbmi2 => cpu_has! {} }
        }
        #[cfg(any(not(target_arch = "x86_64"), miri))]
        {
            false
        }
    }

    /// Those that this machine can run, best last.
    pub fn available() -> impl Iterator<Item = Isa> {
        Self::ALL.into_iter().filter(|i| i.is_available())
    }

    /// The best that this machine can run.
    pub fn best() -> Isa {
        Self::available().last().unwrap_or(Isa::Portable)
    }

    /// Whether kernels round a product and a sum once (FMA) instead of twice. Bakes on ISAs that agree in this have
    /// the same bits.
    pub fn is_fused(self) -> bool {
        self != Isa::Portable
    }

    /// Lower-case name, as the command line takes it.
    pub fn name(self) -> &'static str {
        match self {
            Isa::Portable => "portable",
            Isa::Avx2 => "avx2",
            Isa::Avx512 => "avx512",
        }
    }
}

/// An ISA's vectors: four lanes for the triangles of a leaf, eight for the children of a node, and the
/// width that suits packets of rays and photons.
pub(crate) trait Simd: Copy {
    type F4: Four;
    type F8: Eight;
    type Packet: Lanes;

    /// Writes those of `count` numbers whose mask byte has the bit `bit`, in their order, to `out`; returns how many.
    ///
    /// # Safety
    /// The CPU must have the ISA. `masks` must be valid for reading `count` bytes, rounded up to a multiple of 32, of
    /// which those from `count` on are 0; `numbers` for reading, and `out` for writing, `count` numbers rounded up
    /// likewise. `out` may overlap what lies behind the `count` numbers.
    unsafe fn pick(masks: *const u8, numbers: *const u16, count: usize, bit: u32, out: *mut u16) -> usize;

    /// Which of 32 mask bytes have the bit `bit`: bit i for the i-th.
    ///
    /// # Safety
    /// The CPU must have the ISA.
    unsafe fn column(masks: &[u8; 32], bit: u32) -> u32;
}

/// Asks for the cache line at `p`, which need not be valid.
#[inline(always)]
pub(crate) fn prefetch<T>(p: *const T) {
    #[cfg(all(target_arch = "x86_64", not(miri)))]
    // SAFETY: a prefetch is a hint; it reads nothing and never faults. SSE is part of x86-64.
    unsafe {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        _mm_prefetch::<_MM_HINT_T0>(p.cast());
    }
    #[cfg(any(not(target_arch = "x86_64"), miri))]
    let _ = p;
}

/// Result of a comparison, one bit of truth per lane.
pub(crate) trait Mask: Copy {
    /// Bit i is lane i.
    fn bits(self) -> u32;
    fn and(self, other: Self) -> Self;
    fn or(self, other: Self) -> Self;
    #[inline(always)]
    fn any(self) -> bool {
        self.bits() != 0
    }
}

/// A vector of f32. Arithmetic rounds like scalar f32; only [`mul_add`](Lanes::mul_add) depends on
/// the ISA (fused where there is FMA).
pub(crate) trait Lanes: Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> {
    /// Number of lanes.
    const WIDTH: usize;
    type Mask: Mask;

    /// All lanes `x`.
    ///
    /// # Safety
    /// The CPU must have the ISA.
    unsafe fn splat(x: f32) -> Self;
    /// `WIDTH` floats from `p`, which need not be aligned.
    ///
    /// # Safety
    /// The CPU must have the ISA, and `p` must be valid for reading `WIDTH` floats.
    unsafe fn load(p: *const f32) -> Self;
    /// `WIDTH` floats to `p`, which need not be aligned.
    ///
    /// # Safety
    /// `p` must be valid for writing `WIDTH` floats.
    unsafe fn store(self, p: *mut f32);

    fn div(self, d: Self) -> Self;
    /// Square root, correctly rounded; NaN where negative.
    fn sqrt(self) -> Self;
    /// The lesser; `other` where either is NaN.
    fn min(self, other: Self) -> Self;
    /// The greater; `other` where either is NaN.
    fn max(self, other: Self) -> Self;
    /// `self * b + c`, in one rounding where the ISA has FMA, else in two.
    fn mul_add(self, b: Self, c: Self) -> Self;
    /// Ordered `<`: false where either is NaN.
    fn lt(self, other: Self) -> Self::Mask;
    /// Ordered `≤`.
    fn le(self, other: Self) -> Self::Mask;
    /// Lane by lane `if_true` or `if_false`.
    fn select(mask: Self::Mask, if_true: Self, if_false: Self) -> Self;

    /// The lanes as an array's first `WIDTH` entries (at most 16), for tests and cold paths.
    #[inline(always)]
    fn to_array(self) -> [f32; 16] {
        let mut a = [0.0; 16];
        const { assert!(Self::WIDTH <= 16) };
        // SAFETY: the array has room for 16 ≥ WIDTH floats.
        unsafe { self.store(a.as_mut_ptr()) };
        a
    }
}

/// Least of all lanes, none of which may be NaN.
#[inline(always)]
pub(crate) fn least<L: Lanes>(x: L) -> f32 {
    reduce(x, |a, b| if a < b { a } else { b })
}

/// Greatest of all lanes, none of which may be NaN.
#[inline(always)]
pub(crate) fn greatest<L: Lanes>(x: L) -> f32 {
    reduce(x, |a, b| if a > b { a } else { b })
}

/// In halves, which compile to vectors; `f32::min` and a fold, to three instructions per lane, one after the other.
#[inline(always)]
fn reduce<L: Lanes>(x: L, of: impl Fn(f32, f32) -> f32) -> f32 {
    let (mut a, mut width) = (x.to_array(), L::WIDTH);
    while width > 1 {
        width /= 2;
        for i in 0..width {
            a[i] = of(a[i], a[i + width]);
        }
    }
    a[0]
}

/// Four lanes: one per triangle of a leaf, or per child of a 4-wide node.
pub(crate) trait Four: Compress {
    /// Lane i from where `from[i]` points.
    ///
    /// # Safety
    /// The CPU must have the ISA, and all pointers must be valid for reading.
    unsafe fn gather(from: [*const f32; 4]) -> Self;
}

/// Eight lanes: one per child of an 8-wide node, or four triangles for each of two rays.
pub(crate) trait Eight: Compress {
    /// Four floats from `low` in the lower half, four from `high` in the upper.
    ///
    /// # Safety
    /// The CPU must have the ISA, and both pointers must be valid for reading four floats.
    unsafe fn pair(low: *const f32, high: *const f32) -> Self;

    /// Lane `I` of each half in all lanes of that half. `I` must be below 4.
    fn spread<const I: i32>(self) -> Self;

    /// Lane j of row i becomes lane i of row j.
    fn transpose(rows: [Self; 8]) -> [Self; 8];

    /// Eight bytes as numbers 0 to 255.
    ///
    /// # Safety
    /// The CPU must have the ISA, and `p` must be valid for reading eight bytes.
    unsafe fn from_bytes(p: *const u8) -> Self;

    /// The highest bits of eight numbers: bit i is that of the i-th.
    ///
    /// # Safety
    /// The CPU must have the ISA, and `p` must be valid for reading eight numbers, which need not be aligned.
    unsafe fn highest_bits(p: *const u32) -> u32;
}

/// Lanes of which each is for a child of a node.
pub(crate) trait Compress: Lanes {
    /// Writes the lanes of `mask` to `values`, and the same lanes of `names` to `out_names`, in the
    /// order that bits `shift` to `shift + 2` of each of `order` tell; returns, as bits, which places in that
    /// order were taken. As many entries behind both outputs as there are lanes may be overwritten.
    ///
    /// # Safety
    /// The CPU must have the ISA, and all pointers must be valid for as many values as there are lanes. `out_names` may overlap `names` if `order` tells the
    /// lanes' own and it does not lie behind.
    unsafe fn compress(
        self,
        names: *const u32,
        order: *const u32,
        shift: u32,
        mask: Self::Mask,
        values: *mut f32,
        out_names: *mut u32,
    ) -> u32;
}

#[cfg(test)]
mod tests;
