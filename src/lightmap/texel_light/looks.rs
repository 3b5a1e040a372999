//! Direct light of texels of the radiance map: a first look by a few points, and a closer one where it varies.

use super::{FEW, MAX_POINTS, Point, TexelLight, TilePoints, Wanted, add_points, differ, vary};
use crate::base::sampling::combine;
use crate::direct::Receiver;
use crate::direct::direct_light::{Lights, PointLight};
use crate::lightmap::atlas::ids::{PerTexel, RadianceMap, RadianceTexel};
use crate::lightmap::atlas::texels::TexelSample;
use crate::lightmap::tiles::TILE;
use bytemuck::Zeroable;
use glam::Vec3;
use std::ops::Range;

/// Light of two texels or points differs if the difference is more than this fraction of the greater. (More than in the
/// light map: texels are larger, and seen by gather rays only.)
const DIFFERENCE: f32 = 0.25;

/// Number of points in a texel of the radiance map if one of the first [`MAX_POINTS`] gets more than `SPIKE` times the
/// mean, since the lit area then covers little of the texel.
const MANY: u32 = 64;
const SPIKE: f32 = 3.0;

/// Result of the first look at a texel of the radiance map.
#[derive(Clone, Copy, Debug, Default, Zeroable)]
pub(crate) struct Look {
    pub irradiance: Vec3,
    /// Light of sources with narrow penumbrae or none.
    narrow: Vec3,
    varies: bool,
}

impl TexelLight<'_, RadianceMap> {
    /// Computes direct light of a tile of the radiance map by few points, and the values that decide on a [closer
    /// look](Self::closer_look).
    pub(crate) fn first_look(
        &self,
        texels: &[RadianceTexel],
        tile: &mut TilePoints,
        rays: &mut u64,
        mut out: impl FnMut(usize, Look),
    ) {
        let sample = |i: usize| self.sample(texels[i]);
        tile.clear();
        tile.light(self, texels.iter().enumerate().map(|(i, &texel)| self.all_of(i, texel, 0..FEW)), rays);
        tile.find_buried(texels.len(), &self.areas, sample, rays);
        for (i, &texel) in texels.iter().enumerate() {
            let (mut sum, points) = (PointLight::default(), tile.of(i));
            let mut n = add_points(points, &mut sum, |_| Vec3::ONE);
            let missing = (points.len() as f32 - n.x).max(if n == Vec3::ZERO { 1.0 } else { 0.0 });
            if missing > 0.0 {
                // Few rays are left: those of the points inside solids go from the sample.
                let seed = combine(self.seed, self.areas.map.seed(texel));
                let light = self.direct.at_point(&sample(i), Lights::All, self.samples, seed, rays);
                sum.add(&light, Vec3::splat(missing));
                n += missing;
            }
            // Lamps close to the texel are left to the closer look.
            let varies = points.iter().any(|p| p.is_near_lamps)
                || vary(points, PointLight::narrow, DIFFERENCE)
                || vary(points, PointLight::unoccluded_areas, DIFFERENCE);
            out(i, Look { irradiance: sum.value() / n, narrow: sum.narrow() / n, varies });
        }
    }

    /// Computes direct light of a tile of the radiance map by few points, without tests of which lie inside solids and
    /// without a closer look.
    pub(crate) fn quick_look(
        &self,
        texels: &[RadianceTexel],
        tile: &mut TilePoints,
        rays: &mut u64,
        mut out: impl FnMut(usize, Vec3),
    ) {
        tile.clear();
        tile.light(self, texels.iter().enumerate().map(|(i, &texel)| self.all_of(i, texel, 0..FEW)), rays);
        for (i, &texel) in texels.iter().enumerate() {
            let (mut sum, points) = (PointLight::default(), tile.of(i));
            points.iter().for_each(|p| sum.add(&p.light, Vec3::ONE));
            let near = self.near_light(texel, |_| Vec3::ONE, rays);
            out(i, sum.value() / points.len().max(1) as f32 + near);
        }
    }

    /// Returns what [lamps close to a texel](super::near) bring to it.
    fn near_light(&self, texel: RadianceTexel, weight: impl Fn(&TexelSample) -> Vec3, rays: &mut u64) -> Vec3 {
        let near = self.near(texel);
        match near.distance2 > 0.0 {
            true => {
                self.sample_near((texel, self.areas.map.is_back(texel)), &near, &self.sample(texel), weight, None, rays)
            }
            false => Vec3::ZERO,
        }
    }

    /// Returns the sample of a texel of the radiance map as a receiver.
    fn sample(&self, texel: RadianceTexel) -> Receiver {
        let map = self.areas.map;
        map.receiver(self.areas.scene, texel, map.is_back(texel)).1
    }

    /// Points of a texel of the radiance map, to be lit by all lights.
    fn all_of(&self, place: usize, texel: RadianceTexel, numbers: Range<u32>) -> Wanted<RadianceMap> {
        Wanted { place, texel, back: self.areas.map.is_back(texel), numbers, lights: Lights::All }
    }

    /// Whether a texel of the radiance map needs more points: its first few differ, or its neighbours' light does.
    pub(crate) fn needs_closer_look(&self, texel: RadianceTexel, looks: PerTexel<RadianceMap, Look>) -> bool {
        let look = &looks[texel];
        look.varies
            || self
                .areas
                .neighbours(texel)
                .into_iter()
                .flatten()
                .any(|near| differ(look.narrow, looks[near].narrow, DIFFERENCE))
    }

    /// Computes direct light of texels of the radiance map by 16 or 64 points, weighted by their albedos; `None` if
    /// none of them lies on the chart.
    pub(crate) fn closer_look(
        &self,
        texels: &[RadianceTexel],
        tile: &mut TilePoints,
        albedo: impl Fn(&TexelSample) -> Vec3,
        rays: &mut u64,
        mut out: impl FnMut(usize, Option<Vec3>),
    ) {
        let sample = |i: usize| self.sample(texels[i]);
        let weight = |t: &TexelSample| albedo(t).max(Vec3::splat(f32::MIN_POSITIVE));
        let (mut sums, mut weights) = ([PointLight::default(); TILE], [Vec3::ZERO; TILE]);
        // Texels that go on after the first round of points.
        let mut has_spikes = [true; TILE];
        for begin in (0..MANY).step_by(MAX_POINTS) {
            let numbers = begin..begin + MAX_POINTS as u32;
            let wanted = texels.iter().enumerate().filter(|(i, _)| has_spikes[*i]);
            tile.clear();
            tile.light(self, wanted.map(|(i, &texel)| self.all_of(i, texel, numbers.clone())), rays);
            tile.find_buried(texels.len(), &self.areas, sample, rays);
            for i in (0..texels.len()).filter(|&i| has_spikes[i]) {
                weights[i] += add_points(tile.of(i), &mut sums[i], weight);
            }
            if begin == 0 {
                for (i, has_spikes) in has_spikes.iter_mut().enumerate() {
                    *has_spikes = i < texels.len() && spikes(tile.of(i));
                }
            }
        }
        for (i, (sum, n)) in sums.iter().zip(weights).take(texels.len()).enumerate() {
            out(i, (n != Vec3::ZERO).then(|| sum.value() / n + self.near_light(texels[i], weight, rays)));
        }
    }
}

/// Whether one point has far more light than the mean.
fn spikes(points: &[Point]) -> bool {
    let all = |p: &Point| (p.light.narrow() + p.light.unoccluded_areas()).element_sum();
    let (sum, most) = points.iter().map(all).fold((0.0, 0f32), |(sum, most), l| (sum + l, most.max(l)));
    most * points.len() as f32 > SPIKE * sum
}
