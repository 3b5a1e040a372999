//! Bright patches as lights.
//!
//! Surfaces close to a lamp or in the sun reflect far more light than others, and few gather rays find them: if they
//! contribute much of the light, they cause most of its noise. Therefore gather rays see texels of the radiance map
//! with at most a limit of radiance, and the radiance beyond the limit is sampled as many lights are. A gather ray that
//! hits such a texel from nearby, where it is large, sees all of its radiance, and the texel is not sampled as a light
//! from there. (The split of indirect light into a bounded part and light from points on surfaces, and where each works
//! well, is from Kollig and Keller, *Illumination in the Presence of Weak Singularities*, 2006.)
//!
//! Bright patches help little if much of the scene is in the sun, which stratified rays find well. A trial therefore
//! traces rounds of gather rays from some texels with and without them first. Measured:
//! docs/experiments.md#bright-patches-as-lights.

use super::sample_set::ROUND;
use crate::base::memory::Reservation;
use crate::direct::Receiver;
use crate::direct::many_lights::{ManyLights, Unoccluded};
use crate::direct::shadow_rays::ShadowRays;
use crate::lightmap::atlas::chart_map::ChartMap;
use crate::lightmap::atlas::ids::{PlacementId, RadianceMap};
use glam::Vec3;

/// Gather rays see the full radiance of a texel if they are shorter than the square root of this many times its area.
/// (A quarter and four times as many make no difference.)
const NEAR: f32 = 16.0;

/// Bright texels of a radiance map as lights. There are none by default.
#[derive(Default)]
pub(crate) struct Bright {
    /// Maximum radiance that gather rays see, summed over the channels.
    pub(in crate::lightmap) limit: f32,
    pub(in crate::lightmap) patches: Option<ManyLights>,
    pub(in crate::lightmap) shadow_rays: u32,
    pub(in crate::lightmap) _memory: Option<Reservation>,
}

impl Bright {
    /// Returns the values from which [`again`](super::find_bright_patches::again) makes the same patches: the limit (0:
    /// there are none) and the number of shadow rays.
    pub(crate) fn parts(&self) -> (f32, u32) {
        (self.limit, self.shadow_rays)
    }

    /// Returns the number of lights.
    pub(crate) fn len(&self) -> usize {
        self.patches.as_ref().map_or(0, ManyLights::len)
    }

    /// Returns the number of shadow rays per round of gather rays.
    pub(crate) fn shadow_rays(&self) -> u32 {
        self.shadow_rays
    }

    /// Returns the part of the `radiance` of a texel of the radiance map that a gather ray sees from a `distance`.
    #[inline]
    pub(crate) fn seen(
        &self,
        radiance: Vec3,
        map: &ChartMap<RadianceMap>,
        placement: PlacementId,
        distance: f32,
    ) -> Vec3 {
        let sum = radiance.element_sum();
        if self.patches.is_none() || sum <= self.limit || distance * distance <= near2(map, placement) {
            return radiance;
        }
        radiance * (self.limit / sum)
    }

    /// Pushes the shadow rays of a round of `gather_rays`, whose sum is the irradiance by the radiance beyond the
    /// limit.
    pub(crate) fn push(
        &self,
        receiver: &Receiver,
        gather_rays: usize,
        seed: u32,
        shadow: &mut ShadowRays,
    ) -> Unoccluded {
        let Some(patches) = &self.patches else { return Unoccluded::default() };
        // Shadow rays start where gather rays do.
        let receiver = Receiver { shadow_origin: receiver.origin, raised: false, ..*receiver };
        let rays = (self.shadow_rays * gather_rays as u32).div_ceil(ROUND as u32);
        patches.push(&receiver, rays, seed, shadow)
    }
}

/// Returns the square of the distance up to which gather rays see the full radiance of a placement's texels.
#[inline]
pub(in crate::lightmap) fn near2(map: &ChartMap<RadianceMap>, placement: PlacementId) -> f32 {
    let [x, y] = map.layout[placement].scale;
    NEAR / (x * y)
}
