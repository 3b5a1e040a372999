//! Estimates the error of interpolation between gather texels from what surrounds them, before any light is known: light
//! varies the more, the nearer other surfaces are and the more the surface itself bends (the split-sphere model of Ward,
//! Rubinstein and Clear, *A Ray Tracing Solution for Diffuse Interreflection*, 1988, where the sum of both decides how
//! far apart irradiance is computed).
//!
//! Measured: docs/accuracy.md#interpolation-error.

use super::narrow_gaps::{AWAY, PROBES};
use crate::base::error::Result;
use crate::base::memory::{try_filled, try_with_capacity};
use crate::base::progress::Stage;
use crate::base::sampling::{cosine_around, sobol_2d};
use crate::direct::Receiver;
use crate::lightmap::atlas::Atlas;
use crate::lightmap::atlas::ids::{GatherTexel, PlacementId};
use crate::lightmap::tiles::{TILE, in_order};
use crate::trace::{RawHit, Ray};
use glam::Vec3;

/// Error per width of a gather texel by harmonic mean distance. (With 1 instead, and weights that do not depend on
/// normals, as many texels of Sponza gather for themselves, and interpolation is wrong by twice as much.)
const NEARNESS: f32 = 1.6;

/// Error where normals are at a right angle. (Of Sponza in the sun at 10 texels per metre, a fifth of whose texels gather
/// for themselves then, MSE 0.27 → 0.14; without this part no gain: most of the error is under arches.)
const BEND: f32 = 3.2;

/// Power of the cosine between the normals of two texels by which one counts less for the other: on folded surface light
/// changes at the folds. (Sponza: with 32 the same error.)
const POWER: i32 = 16;

/// Maximum contribution of a ray: one that touches the surface says little about the others.
const MOST: f32 = 4.0;

/// Length of the probes in widths of a gather texel. What is further away would add at most this part of the error at
/// which texels gather for themselves. (Sponza at 31.5 texels/m: 0.87 of the time of upsampling, and 0.8 % fewer such
/// texels, than with rays of any length.)
const FAR: f32 = 16.0;

const WHAT: &str = "what surrounds gather texels";

/// Number of first probes, and the nearness that they find below which a texel gets no others: most lie on open walls.
const FIRST: u32 = 8;
const OPEN: f32 = 0.2;

/// Number of texels whose probes are traced together.
const TEXELS: usize = 4 * TILE;

/// What surrounds a gather texel.
#[derive(Clone, Copy)]
pub(super) struct Surroundings {
    /// Whether it lies in a [narrow gap](super::narrow_gaps).
    pub is_gap: bool,
    /// Width of a gather texel divided by the harmonic mean distance of what the texel sees.
    nearness: f32,
    /// Shading normal.
    pub normal: Vec3,
}

impl Surroundings {
    /// Returns those of a texel in a narrow gap or outside, of which nothing else is known.
    pub(super) fn unknown(is_gap: bool) -> Surroundings {
        Surroundings { is_gap, nearness: 0.0, normal: Vec3::ZERO }
    }

    /// Returns the estimated error of this texel's light at a texel nearby with a shading normal.
    pub(super) fn error_at(&self, normal: Vec3) -> f32 {
        NEARNESS * self.nearness + BEND * (1.0 - self.normal.dot(normal)).max(0.0).sqrt()
    }
}

/// Returns the factor on the weight with which texels with these shading normals are interpolated.
#[inline]
pub(super) fn likeness(a: Vec3, b: Vec3) -> f32 {
    a.dot(b).max(0.0).powi(POWER)
}

/// A texel and what its probes have found so far.
struct Probed {
    texel: GatherTexel,
    receiver: Receiver,
    /// Sum over the probes.
    nearness: f32,
    /// Number of probes that got further than a gather texel.
    away: u32,
}

/// Finds what surrounds the gather texels of a placement, of a given `width`, by up to [`PROBES`] rays from each. Adds the rays
/// to `rays`; `stage` may cancel.
pub(super) fn surroundings(
    atlas: &Atlas,
    placement: PlacementId,
    backs: &[bool],
    width: f32,
    stage: &Stage,
    rays: &mut u64,
) -> Result<Vec<Surroundings>> {
    let of_placement = atlas.gather.texels_of(placement);
    let mut found = try_filled(of_placement.len(), Surroundings::unknown(false), WHAT)?;
    let most = TEXELS.min(of_placement.len());
    let mut probes: Vec<Ray> = try_with_capacity(most * FIRST as usize, WHAT)?;
    let mut hits = try_filled(most * FIRST as usize, RawHit::MISS, WHAT)?;
    let mut undecided: Vec<Probed> = try_with_capacity(most, WHAT)?;
    let mut receiver = atlas.receivers(&atlas.gather, backs);
    for texels in in_order(&atlas.gather, of_placement.indices())?.chunks(TEXELS) {
        undecided.clear();
        undecided.extend(texels.iter().map(|&texel| Probed {
            texel,
            receiver: receiver(texel),
            nearness: 0.0,
            away: 0,
        }));
        for round in [0..FIRST, FIRST..PROBES] {
            stage.check()?;
            probes.clear();
            for Probed { texel, receiver, .. } in &undecided {
                let along = |i| cosine_around(receiver.normal, sobol_2d(i, texel.seed()));
                probes.extend(round.clone().map(|i| Ray::new(receiver.origin, along(i)).within(0.0, FAR * width)));
            }
            atlas.scene.intersect_stream(&probes, &mut hits);
            *rays += probes.len() as u64;
            for (probed, hits) in undecided.iter_mut().zip(hits.chunks(round.len())) {
                let distances = hits.iter().map(|hit| if hit.is_miss() { f32::INFINITY } else { hit.t });
                probed.away += distances.clone().filter(|&t| t > width).count() as u32;
                probed.nearness += distances.map(|t| (width / t).min(MOST)).sum::<f32>();
                let normal = atlas.gather.surface(&atlas.scene, probed.texel).1;
                let nearness = probed.nearness / round.end as f32;
                found[of_placement.place(probed.texel)] = Surroundings { is_gap: probed.away < AWAY, nearness, normal };
            }
            undecided.retain(|probed| probed.away < AWAY || probed.nearness >= OPEN * FIRST as f32);
        }
    }
    Ok(found)
}
