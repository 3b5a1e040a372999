//! Finds texels in gaps narrower than a gather texel.
//!
//! The light behind a picture frame, below a skirting board or between a carpet and the floor is not that of the wall
//! and the floor beside it, and a gather texel there may be as wide as the gap is deep. Plain interpolation makes dark
//! rims around objects that stand on a surface or hang before it, and makes gaps too bright.
//! [Upsampling](super::upsample) keeps texels inside and outside of narrow gaps apart.
//!
//! Measured, with alternatives that were tried: docs/experiments.md#narrow-gaps.

use crate::base::sampling::{cosine_around, sobol_2d};
use crate::direct::Receiver;
use crate::scene::Scene;
use crate::trace::Ray;

/// Maximum number of rays that test whether a texel is in a gap.
pub(super) const PROBES: u32 = 16;

/// Minimum number of these rays that get further than a gather texel outside of gaps.
pub(super) const AWAY: u32 = 2;

/// Whether all but at most one of the rays from a texel hit a surface within `distance`, the width of a gather texel.
/// Adds the rays traced to `rays`.
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
