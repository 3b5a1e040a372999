//! Texels in gaps narrower than themselves.
//!
//! The light behind a picture frame, below a skirting board or between a carpet and the floor is not that of the
//! wall and the floor beside it, and a gather texel there may be as wide as the gap is deep. Interpolated as they
//! come, dark rims lie around what stands on or hangs before a surface, and gaps shine.
//! [Upsampling](super::upsample) keeps what lies in gaps apart from what does not.
//!
//! Measured, with what was tried instead: docs/experiments.md#narrow-gaps.

use crate::direct::Receiver;
use crate::sampling::{cosine_around, sobol_2d};
use crate::scene::Scene;
use crate::trace::Ray;

/// Rays that tell whether a texel is in a gap, at most.
const PROBES: u32 = 16;

/// Outside of gaps at least so many of them get further than a texel.
const AWAY: u32 = 2;

/// Whether all but a few rays from a texel meet something within `distance`, the width of a gather texel. Adds the rays
/// traced to `rays`.
pub(in crate::lightmap) fn is_in_gap(
    scene: &Scene,
    receiver: &Receiver,
    distance: f32,
    seed: u32,
    rays: &mut u64,
) -> bool {
    let mut away = 0;
    for i in 0..PROBES {
        let d = cosine_around(receiver.normal, sobol_2d(i, seed));
        *rays += 1;
        away += u32::from(!scene.occluded(&Ray::new(receiver.origin, d).within(0.0, distance)));
        if away == AWAY {
            return false;
        }
    }
    true
}
