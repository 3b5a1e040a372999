//! Bright patches as lights.
//!
//! Surfaces close to a lamp or in the sun reflect far more light than others, and few gather rays find them: where they
//! make much of the light, they make most of its noise. So of texels of the radiance map that are brighter than a limit,
//! gather rays see the limit alone; what these reflect beyond it is sampled as that of many lights is. A gather ray that
//! meets such a texel from nearby, where it is large, sees all of it, and the texel is no light there. (That indirect
//! light is the sum of a bounded part and of light from points on surfaces, and where each is good, is from Kollig and
//! Keller, *Illumination in the Presence of Weak Singularities*, 2006.)
//!
//! They bring little where much is in the sun, which stratified rays find well. So rounds of gather rays from some texels are
//! traced with and without them first. Measured: docs/experiments.md#bright-patches-as-lights.

use super::sample_set::ROUND;
use crate::direct::Receiver;
use crate::direct::many_lights::ManyLights;
use crate::direct::shadow_rays::ShadowRays;
use crate::lightmap::atlas::chart_map::ChartMap;
use crate::memory::Reservation;
use crate::scene::Scene;
use glam::Vec3;

/// Texels are seen in full from closer than the square root of this many times their area. (A quarter and four times
/// as many make no difference.)
const NEAR: f32 = 16.0;

/// Bright texels of a radiance map as lights. None, by default.
#[derive(Default)]
pub(crate) struct Bright {
    /// Sum over the channels of the radiance that gather rays see at most.
    pub(in crate::lightmap) limit: f32,
    pub(in crate::lightmap) patches: Option<ManyLights>,
    pub(in crate::lightmap) shadow_rays: u32,
    pub(in crate::lightmap) _memory: Option<Reservation>,
}

impl Bright {
    /// What [`again`](super::find_bright_patches::again) makes the same patches of: the limit (0: there are none) and the shadow rays.
    pub(crate) fn parts(&self) -> (f32, u32) {
        (self.limit, self.shadow_rays)
    }

    /// Number of lights.
    pub(crate) fn len(&self) -> usize {
        self.patches.as_ref().map_or(0, ManyLights::len)
    }

    /// Shadow rays per round of gather rays.
    pub(crate) fn shadow_rays(&self) -> u32 {
        self.shadow_rays
    }

    /// The part of the `radiance` of a texel of the radiance map that a gather ray sees from a `distance`.
    #[inline]
    pub(crate) fn seen(&self, radiance: Vec3, map: &ChartMap, placement: u32, distance: f32) -> Vec3 {
        let sum = radiance.element_sum();
        if self.patches.is_none() || sum <= self.limit || distance * distance <= near2(map, placement) {
            return radiance;
        }
        radiance * (self.limit / sum)
    }

    /// Irradiance by what a round of `gather_rays` does not see, and the variance of its sum over the channels. Adds the
    /// rays traced to `rays`.
    pub(crate) fn irradiance(
        &self,
        scene: &Scene,
        receiver: &Receiver,
        gather_rays: usize,
        seed: u32,
        rays: &mut u64,
    ) -> (Vec3, f32) {
        let Some(patches) = &self.patches else { return (Vec3::ZERO, 0.0) };
        // As gather rays start.
        let receiver = Receiver { shadow_origin: receiver.origin, raised: false, ..*receiver };
        let mut shadow = ShadowRays::new(scene);
        let shadow_rays = (self.shadow_rays * gather_rays as u32).div_ceil(ROUND as u32);
        let unoccluded = patches.push(&receiver, shadow_rays, seed, &mut shadow);
        let e = shadow.finish(rays);
        // Each ray brings about as much, or nothing.
        let sum = e.element_sum();
        (e, sum * (unoccluded - sum).max(0.0) / shadow_rays as f32)
    }
}

/// Square of the distance up to which texels of a placement are seen in full.
#[inline]
pub(in crate::lightmap) fn near2(map: &ChartMap, placement: u32) -> f32 {
    let [x, y] = map.layout.placements[placement as usize].scale;
    NEAR / (x * y)
}
