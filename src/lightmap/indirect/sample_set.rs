//! Points of the square from which gather rays get their directions, in rounds.

use crate::base::error::Result;
use crate::base::memory::try_collect;
use crate::base::sampling::sobol_2d_bits;

/// Number of rays of a round.
pub(crate) const ROUND: usize = 64;

/// Points of the unit square, in fixed point, to which every texel applies its own shift.
pub(crate) struct SampleSet {
    points: Vec<[u32; 2]>,
}

impl SampleSet {
    pub(crate) fn new(count: u32, seed: u32) -> Result<SampleSet> {
        let mut points = try_collect((0..count).map(|i| sobol_2d_bits(i, seed)), "the points of gather rays")?;
        for round in points.chunks_mut(ROUND) {
            let (mut order, mut sorted) = ([(0, 0); ROUND], [[0; 2]; ROUND]);
            let order = &mut order[..round.len()];
            for ((key, &[x, y]), i) in order.iter_mut().zip(&*round).zip(0u32..) {
                *key = (morton(x >> 16, y >> 16), i);
            }
            order.sort_unstable();
            sorted.iter_mut().zip(&*order).for_each(|(point, &(_, i))| *point = round[i as usize]);
            round.copy_from_slice(&sorted[..round.len()]);
        }
        Ok(SampleSet { points })
    }

    /// Returns all points, round by round.
    pub(crate) fn points(&self) -> &[[u32; 2]] {
        &self.points
    }

    /// Returns the number of rounds, the last of which may be shorter.
    pub(crate) fn rounds(&self) -> usize {
        self.points.len().div_ceil(ROUND)
    }
}

/// Interleaves the bits of two 16-bit numbers.
fn morton(x: u32, y: u32) -> u32 {
    let spread = |mut v: u32| {
        v = (v | v << 8) & 0x00ff_00ff;
        v = (v | v << 4) & 0x0f0f_0f0f;
        v = (v | v << 2) & 0x3333_3333;
        (v | v << 1) & 0x5555_5555
    };
    spread(x) | spread(y) << 1
}
