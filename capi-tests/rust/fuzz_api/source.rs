//! Random choices of one thread, and the numbers that are hard on a library.

/// A stream of choices (SplitMix64: Steele, Lea and Flood 2014). The same seed makes the same choices.
pub struct Source(u64);

const FLOATS: [f32; 24] = [
    0.0,
    -0.0,
    1.0,
    -1.0,
    0.5,
    f32::EPSILON,
    f32::MIN_POSITIVE,
    1e-45,
    -1e-40,
    1e-30,
    1e-12,
    1e12,
    -1e12,
    1.1e12,
    1e18,
    1e30,
    -1e38,
    f32::MAX,
    f32::MIN,
    f32::INFINITY,
    f32::NEG_INFINITY,
    f32::NAN,
    -f32::NAN,
    16_777_216.0,
];

const INTEGERS: [u32; 26] = [
    0,
    1,
    2,
    3,
    4,
    5,
    8,
    15,
    16,
    17,
    63,
    64,
    65,
    255,
    256,
    257,
    1024,
    4096,
    65_535,
    65_536,
    1 << 24,
    1 << 28,
    (1 << 31) - 1,
    1 << 31,
    u32::MAX - 1,
    u32::MAX,
];

impl Source {
    pub fn new(seed: u64) -> Source {
        Source(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ 0x5851_f42d_4c95_7f2d)
    }

    pub fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// 0 to `n` − 1.
    pub fn below(&mut self, n: usize) -> usize {
        (self.next() >> 16) as usize % n.max(1)
    }

    /// True once in `n` times.
    pub fn one_in(&mut self, n: usize) -> bool {
        self.below(n) == 0
    }

    /// In [0, 1).
    pub fn unit(&mut self) -> f32 {
        (self.next() >> 40) as f32 / (1u64 << 24) as f32
    }

    /// One of the least pleasant floats, or any bits, or any magnitude.
    pub fn float(&mut self) -> f32 {
        match self.below(8) {
            0 => f32::from_bits(self.next() as u32),
            1 => (self.unit() * 200.0 - 100.0).exp2() * if self.one_in(2) { -1.0 } else { 1.0 },
            _ => FLOATS[self.below(FLOATS.len())],
        }
    }

    /// A coordinate: most of a small scene's, some hostile.
    pub fn coordinate(&mut self) -> f32 {
        if self.one_in(40) { self.float() } else { self.unit() * 4.0 - 2.0 }
    }

    pub fn point(&mut self) -> [f32; 3] {
        std::array::from_fn(|_| self.coordinate())
    }

    /// One of the least pleasant integers, or any.
    pub fn integer(&mut self) -> u32 {
        if self.one_in(6) { self.next() as u32 } else { INTEGERS[self.below(INTEGERS.len())] }
    }

    /// An index: mostly a small one, which may exist.
    pub fn index(&mut self) -> u32 {
        if self.one_in(8) { self.integer() } else { self.below(3) as u32 }
    }

    /// Replaces a few of the 4-byte words of a structure without pointers; its size among them now and then.
    pub fn mutate<T: Copy>(&mut self, value: &mut T) {
        let words = size_of::<T>() / 4;
        if !self.one_in(3) {
            return;
        }
        for _ in 0..1 + self.below(3) {
            let word = self.below(words);
            if word == 0 && !self.one_in(4) {
                continue;
            }
            let bits = if self.one_in(2) { self.integer() } else { self.float().to_bits() };
            // SAFETY: the word lies in the structure, which is of integers and floats alone: of these every
            // bit pattern is valid.
            unsafe { std::ptr::from_mut(value).cast::<u32>().add(word).write_unaligned(bits) };
        }
    }
}
