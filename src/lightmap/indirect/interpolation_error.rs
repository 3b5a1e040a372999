//! Estimates the error of interpolation between gather texels from what surrounds them, before any light is known: light
//! varies the more, the nearer other surfaces are and the more the surface itself bends (the split-sphere model of Ward,
//! Rubinstein and Clear, *A Ray Tracing Solution for Diffuse Interreflection*, 1988, where the sum of both decides how
//! far apart irradiance is computed). To that comes how far the place whose light is interpolated is
//! from the texel, as gather texels may all be on one side of it.
//!
//! Measured: docs/accuracy.md#interpolation-error.

use super::narrow_gaps::{AWAY, PROBES};
use crate::base::error::Result;
use crate::base::memory::{try_filled, try_with_capacity};
use crate::base::progress::Stage;
use crate::base::sampling::{cosine_around, sobol_2d};
use crate::lightmap::atlas::Atlas;
use crate::lightmap::atlas::ids::PlacementId;
use crate::lightmap::tiles::{TILE, in_order};
use crate::trace::{RawHit, Ray};
use glam::Vec3;

/// Error where normals are at a right angle. (Of Sponza in the sun at 10 texels per metre, a fifth of whose texels gather
/// for themselves then, MSE 0.27 → 0.14; without this part no gain: most of the error is under arches.)
const BEND: f32 = 4.0;

/// Maximum contribution of a ray: one that touches the surface says little about the others.
const MOST: f32 = 4.0;

/// Error where interpolated light is that of a point one gather texel away. (How near the surfaces around that point are
/// tells little about the texel, which may be beneath a cupboard: taking it into account, too, brings no gain. What this
/// part is worth: docs/accuracy.md#interpolation-error.)
const OFFSET: f32 = 3.0;

/// Length of the probes in widths of a gather texel. What is further away would add at most this part of the error at
/// which texels gather for themselves. (Sponza at 31.5 texels/m: 0.87 of the time of upsampling, and 0.8 % fewer such
/// texels, than with rays of any length.)
const FAR: f32 = 16.0;

const WHAT: &str = "what surrounds gather texels";

/// Number of texels whose probes are traced together.
const TEXELS: usize = 4 * TILE;

/// What surrounds a gather texel.
#[derive(Clone, Copy)]
pub(super) struct Surroundings {
    /// Whether it lies in a [narrow gap](super::narrow_gaps).
    pub is_gap: bool,
    /// Width of a gather texel divided by the harmonic mean distance of what the texel sees.
    nearness: f32,
    normal: Vec3,
    position: Vec3,
}

impl Surroundings {
    /// Returns those of a texel in a narrow gap or outside, of which nothing else is known.
    pub(super) fn unknown(is_gap: bool) -> Surroundings {
        Surroundings { is_gap, nearness: 0.0, normal: Vec3::ZERO, position: Vec3::ZERO }
    }

    /// Returns the estimated error of this texel's light at a texel nearby with a shading normal.
    pub(super) fn error_at(&self, normal: Vec3) -> f32 {
        self.nearness + BEND * (1.0 - self.normal.dot(normal)).max(0.0).sqrt()
    }
}

/// Mean position of the gather texels between which a texel interpolates.
///
/// Bilinear weights of gather texels all around a texel have their mean at the texel. Where some are behind a wall or,
/// because they are buried, have their samples elsewhere, it is beside the texel, and interpolated light is that of
/// another place: an error of first order in the distance, where that of interpolation is of second order. (It does not
/// count in [narrow gaps](super::narrow_gaps), most of which nobody sees: what a texel below a carpet gathers would
/// be taken by the buried ones around it.)
#[derive(Default)]
pub(super) struct MeanPosition {
    sum: Vec3,
    weight: f32,
}

impl MeanPosition {
    /// Adds a gather texel with a weight.
    pub(super) fn add(&mut self, around: &Surroundings, weight: f32) {
        self.sum += around.position * weight;
        self.weight += weight;
    }

    /// Returns the estimated error of the light of this place at a texel's position; `width` is that of a gather texel.
    pub(super) fn error_at(&self, position: Vec3, width: f32) -> f32 {
        if self.weight > 0.0 { OFFSET * (self.sum / self.weight).distance(position) / width } else { 0.0 }
    }
}

/// Finds what surrounds the gather texels of a placement, of a given `width`, by [`PROBES`] rays from each. Adds the rays
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
    let count = TEXELS.min(of_placement.len()) * PROBES as usize;
    let mut probes: Vec<Ray> = try_with_capacity(count, WHAT)?;
    let mut hits = try_filled(count, RawHit::MISS, WHAT)?;
    let mut receiver = atlas.receivers(&atlas.gather, backs);
    for texels in in_order(&atlas.gather, of_placement.indices())?.chunks(TEXELS) {
        stage.check()?;
        probes.clear();
        for &texel in texels {
            let receiver = receiver(texel);
            let seed = atlas.gather.seed_in(placement, texel);
            let along = |i| cosine_around(receiver.normal, sobol_2d(i, seed));
            let ray = |i| Ray::new(receiver.origin, along(i)).within(0.0, FAR * width);
            probes.extend((0..PROBES).map(ray));
        }
        atlas.scene.intersect_stream(&probes, &mut hits);
        *rays += probes.len() as u64;
        for (&texel, hits) in texels.iter().zip(hits.chunks(PROBES as usize)) {
            let distances = hits.iter().map(|hit| if hit.is_miss() { f32::INFINITY } else { hit.t });
            let away = distances.clone().filter(|&t| t > width).count();
            let nearness = distances.map(|t| (width / t).min(MOST)).sum::<f32>() / PROBES as f32;
            let (position, normal) = atlas.gather.surface(&atlas.scene, texel);
            found[of_placement.place(texel)] =
                Surroundings { is_gap: away < AWAY as usize, nearness, normal, position };
        }
    }
    Ok(found)
}
