//! Finds texels in gaps narrower than a gather texel.
//!
//! The light behind a picture frame, below a skirting board or between a carpet and the floor is not that of the wall
//! and the floor beside it, and a gather texel there may be as wide as the gap is deep. Plain interpolation makes dark
//! rims around objects that stand on a surface or hang before it, and makes gaps too bright.
//! [Upsampling](super::upsample) keeps texels inside and outside of narrow gaps apart.
//!
//! Measured, with alternatives that were tried: docs/experiments.md#narrow-gaps.

use super::sights::Sights;
use crate::base::error::Result;
use crate::base::memory::{try_filled, try_with_capacity};
use crate::base::progress::Stage;
use crate::base::sampling::{cosine_around, sobol_2d};
use crate::direct::Receiver;
use crate::lightmap::atlas::Atlas;
use crate::lightmap::atlas::chart_map::ChartMap;
use crate::lightmap::atlas::ids::{ShownMap, TexelId};
use crate::lightmap::tiles::{TILE, places_in_order};
use crate::trace::Ray;
use std::ops::Range;

/// Maximum number of rays that test whether a texel is in a gap.
pub(super) const PROBES: u32 = 16;

/// Minimum number of these rays that get further than a gather texel outside of gaps.
pub(super) const AWAY: u32 = 2;

/// Rays that are traced together; texels of which enough have got away by then get no more. Most need two.
const ROUNDS: [Range<u32>; 4] = [0..2, 2..4, 4..8, 8..PROBES];

/// Number of texels whose rays are traced together.
const TEXELS: usize = 4 * TILE;

/// Name of the buffers in error messages.
const GAPS: &str = "texels in narrow gaps";

/// Says of each of some texels whether all but at most one of its rays hit a surface within `distance`, the width of a
/// gather texel. Adds the rays traced to `rays`; `stage` may cancel.
pub(super) fn are_in_gaps<M: ShownMap>(
    atlas: &Atlas,
    map: &ChartMap<M>,
    backs: &[bool],
    texels: &[TexelId<M>],
    distance: f32,
    stage: &Stage,
    rays: &mut u64,
) -> Result<Vec<bool>> {
    let mut are = try_filled(texels.len(), false, GAPS)?;
    let most = TEXELS.min(texels.len());
    let mut receivers: Vec<Receiver> = try_with_capacity(most, GAPS)?;
    let mut away = try_filled(most, 0, GAPS)?;
    let mut sights = Sights::default();
    for places in places_in_order(map, texels)?.chunks(TEXELS) {
        let texel = |i: usize| texels[places[i] as usize];
        receivers.clear();
        receivers.extend((0..places.len()).map(|i| atlas.receiver(map, backs, texel(i))));
        away.fill(0);
        for round in ROUNDS {
            stage.check()?;
            for i in (0..places.len()).filter(|&i| away[i] < AWAY) {
                let seed = map.seed(texel(i));
                for k in round.clone() {
                    let direction = cosine_around(receivers[i].normal, sobol_2d(k, seed));
                    sights.push(Ray::new(receivers[i].origin, direction).within(0.0, distance), i as u32)?;
                }
            }
            sights.trace(&atlas.scene, rays, |i, is_occluded| away[i as usize] += u32::from(!is_occluded))?;
        }
        places.iter().zip(&away).for_each(|(&place, &away)| are[place as usize] = away < AWAY);
    }
    Ok(are)
}
