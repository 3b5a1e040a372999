//! Bright patches as lights.
//!
//! Surfaces close to a lamp or in the sun reflect far more light than others, and few gather rays find them: where they
//! make much of the light, they make most of its noise. So of texels of the radiance map that are brighter than a limit,
//! gather rays see the limit alone; what these reflect beyond it is sampled as that of many lights is. A gather ray that
//! meets such a texel from nearby, where it is large, sees all of it, and the texel is no light there. (That indirect
//! light is the sum of a bounded part and of light from points on surfaces, and where each is good, is from Kollig and
//! Keller, *Illumination in the Presence of Weak Singularities*, 2006.)
//!
//! Relative MSE of indirect light and its noise at 300 points, and seconds of a bake, without -> with: Sponza by two lamps
//! 4.2e-2 -> 1.2e-2, 3.5e-2 -> 2.6e-3, 5.9 -> 6.4; in the sun 0.21 -> 0.12, 4.3e-2 -> 1.3e-2, 7.7 -> 11; living room
//! 0.142 -> 0.141, 1.2e-3 -> 1.1e-3, 2.9 -> 3.3; Cornell box 4.2e-4 -> 3.8e-4, 2.5e-4 -> 2.0e-4, 0.60 -> 0.61. With half
//! and twice the shadow rays, noise in the sun 4.4e-2 and 0.9e-2 for 11 and 16 s; by lamps no difference. With a limit of
//! twice or eight times what is seen on average instead of four, 1.2 and 1.3 times the noise (lamps).
//!
//! It brings little where much is in the sun, which stratified rays find well: in the built-in atrium with its 35,000
//! patches 9.6e-3 -> 7.5e-3 takes 9.8 -> 11.3 s. So rounds of gather rays from some places are traced with and without
//! them. The variance of rounds with them is 0.3 (Sponza by lamps), 0.5 (in the sun), 0.6 (Cornell box), 0.7 (atrium) and
//! 0.9 (living room) of that without, and its product with the time of rounds 0.2, 1.1, 0.7, 1.9 and 1.1. Half or a quarter
//! of the candidates per shadow ray or a sixteenth of the patches did not make the product smaller by more than a fifth in
//! any of them.

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
