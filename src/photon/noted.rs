//! Photons that count in an estimate, noted while it is computed, so that some of them can be looked at.

/// Maximum number of photons that are noted.
const MOST: usize = 1024;

/// Numbers of photons at regular intervals among those that count: all of them if there is room, else every second one,
/// or every fourth …
pub(super) struct Noted {
    photons: [u32; MOST],
    len: usize,
    /// The photons that count so far, and the interval less 1, whose bits are all ones.
    count: usize,
    skip: usize,
}

impl Noted {
    pub(super) fn new() -> Noted {
        Noted { photons: [0; MOST], len: 0, count: 0, skip: 0 }
    }

    pub(super) fn clear(&mut self) {
        (self.len, self.count, self.skip) = (0, 0, 0);
    }

    /// Notes the photons of a vector that count: bit i is that of photon `first` + i.
    #[inline(always)]
    pub(super) fn note(&mut self, first: usize, mut bits: u32) {
        while bits != 0 {
            if self.count & self.skip == 0 {
                if self.len == MOST {
                    (0..MOST / 2).for_each(|i| self.photons[i] = self.photons[2 * i]);
                    (self.len, self.skip) = (MOST / 2, 2 * self.skip + 1);
                }
                self.photons[self.len] = first as u32 + bits.trailing_zeros();
                self.len += 1;
            }
            self.count += 1;
            bits &= bits - 1;
        }
    }

    /// Fills `out` with photons, each far from those before, and returns how many they are: all that were noted if there
    /// is room.
    pub(super) fn spread(&self, seed: u32, out: &mut [u32]) -> usize {
        let n = self.len.min(out.len());
        let stride = spreading_stride(self.len);
        for (k, out) in out[..n].iter_mut().enumerate() {
            *out = self.photons[(seed as usize + k * stride) % self.len];
        }
        n
    }
}

/// A stride that visits all `total` indices, wherever it starts, each far from the ones before: near the golden
/// section.
fn spreading_stride(total: usize) -> usize {
    let gcd = |mut a: usize, mut b: usize| {
        while b > 0 {
            (a, b) = (b, a % b);
        }
        a
    };
    let golden = (0.618_034 * total as f64) as usize;
    (golden.max(1)..).find(|&s| gcd(s, total) == 1).unwrap_or(1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn photons_at_regular_intervals_are_noted_and_spread() {
        let mut noted = Noted::new();
        for total in [0, 1, 5, 40, 1000, 1024, 1025, 5000] {
            noted.clear();
            // Every third photon counts.
            for first in (0..3 * total).step_by(8) {
                noted.note(
                    first,
                    (0..8).filter(|i| (first + i) % 3 == 0 && first + i < 3 * total).map(|i| 1 << i).sum(),
                );
            }
            let step = 3 * total.div_ceil(MOST).next_power_of_two();
            let expected: Vec<u32> = (0..3 * total as u32).step_by(step.max(1)).collect();
            assert_eq!(noted.photons[..noted.len], expected[..]);
            let mut spread = [0; 32];
            let n = noted.spread(7, &mut spread);
            assert_eq!(n, noted.len.min(32));
            let mut found = spread[..n].to_vec();
            found.sort_unstable();
            found.dedup();
            assert!(found.len() == n && found.iter().all(|p| expected.contains(p)));
            // Both halves of the photons are among few.
            let first_half = spread[..n].iter().filter(|&&p| (p as usize) < 3 * total / 2).count();
            assert!(n < 8 || first_half.abs_diff(n / 2) <= n / 8, "{first_half} of {n}");
        }
    }
}
