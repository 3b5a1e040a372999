//! Direct light at points of surfaces, by shadow rays (thesis 3.2.6).
//!
//! Point, spot and parallel lights take one ray. For area lights (rectangular lights and emissive triangles) the
//! unoccluded irradiance is computed exactly and multiplied by the fraction of it that rays find visible (the ratio
//! estimator of Heitz, Hill and McGuire, *Combining Analytic Direct Illumination and Stochastic Shadows*, 2018):
//! without occluders there is no noise. If there are very many lights, candidates are chosen by a
//! [tree](super::light_tree), and the estimate is the plain unbiased one. Discs and skies have [a file of their
//! own](super::sun_sky).
//!
//! In scenes with transmissive surfaces, the light along a ray is multiplied by their transmittance.

use super::area_light::AreaLight;
use super::light_tree::LIGHT_TREE;
use super::many_lights::ManyLights;
use super::near_lights::NearLights;
use super::point_light::push_one;
use super::receiver::Receiver;
use super::shadow_rays::{KINDS, PointRoom, ShadowRays, shadow_ray};
use super::sun_sky::{Disc, push_sky};
use crate::base::directional::Directional;
use crate::base::error::Result;
use crate::base::memory::try_collect;
use crate::base::sampling::{combine, sobol_2d};
use crate::scene::{Light, Scene, Sky};
use glam::Vec3;
use std::sync::Arc;

/// Up to this many area lights are evaluated exactly at every point, and up to this many point and
/// spot lights get a ray each: no noise, and no more rays than sampling takes.
const MAX_EXACT: usize = 64;

/// Maximum number of area lights that get rays from one point, in multiples of the rays for one light; also the number
/// of rays to all of many lights.
const MAX_LIGHTS_SAMPLED: usize = 4;

/// Subset of the lights.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Lights {
    All,
    /// Lights whose shadows have no penumbrae: parallel lights, and point and spot lights unless they are many.
    Sharp,
    /// All other lights.
    Soft,
}

/// A ratio estimate: the exact unoccluded light, and the sums of samples of it with and without occlusion.
#[derive(Clone, Copy, Debug, Default)]
struct Ratio {
    total: Vec3,
    visible: Vec3,
    samples: Vec3,
    /// Number of rays.
    rays: u32,
}

/// Direct light at a point, or a weighted sum over points.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct PointLight {
    /// Irradiance of the lights of [`Lights::Sharp`].
    pub sharp: Vec3,
    /// Irradiance of skies and of many lights.
    sampled: Vec3,
    discs: Ratio,
    areas: Ratio,
}

impl Ratio {
    fn add(&mut self, other: &Ratio, weight: Vec3) {
        self.total += weight * other.total;
        self.visible += weight * other.visible;
        self.samples += weight * other.samples;
        self.rays += other.rays;
    }

    fn value(&self) -> Vec3 {
        let fraction = |v: f32, w: f32| if w > 0.0 { v / w } else { 0.0 };
        let (v, w) = (self.visible, self.samples);
        self.total * Vec3::new(fraction(v.x, w.x), fraction(v.y, w.y), fraction(v.z, w.z))
    }
}

impl PointLight {
    /// Takes over the light that has arrived in a point's slots.
    pub(crate) fn take(&mut self, sums: &[Vec3]) {
        (self.sharp, self.sampled, self.discs.visible, self.areas.visible) = (sums[0], sums[1], sums[2], sums[3]);
    }

    /// Adds `weight` times the light of another point.
    pub(crate) fn add(&mut self, other: &PointLight, weight: Vec3) {
        self.sharp += weight * other.sharp;
        self.sampled += weight * other.sampled;
        self.discs.add(&other.discs, weight);
        self.areas.add(&other.areas, weight);
    }

    /// The irradiance, or the sum of irradiances.
    pub(crate) fn value(&self) -> Vec3 {
        self.sharp + self.sampled + self.discs.value() + self.areas.value()
    }

    /// Light by direction, from what has arrived in the slots: weighted as the irradiance is, if that is a sum.
    pub(crate) fn by_direction(&self, [sharp, sampled, discs, areas]: &[Directional; KINDS]) -> Directional {
        let scale = |ratio: &Ratio| {
            let (value, visible) = (ratio.value(), ratio.visible);
            Vec3::select(visible.cmpgt(Vec3::ZERO), value / visible, Vec3::ZERO)
        };
        *sharp + *sampled + discs.scaled(scale(&self.discs)) + areas.scaled(scale(&self.areas))
    }

    /// Irradiance from lights whose shadows have narrow penumbrae or none.
    pub(crate) fn narrow(&self) -> Vec3 {
        self.sharp + self.discs.visible
    }

    /// Irradiance from discs, as estimated by their samples.
    pub(crate) fn of_discs(&self) -> Vec3 {
        self.discs.visible
    }

    /// Irradiance of skies and of many lights, summed over the channels.
    pub(crate) fn sampled(&self) -> f32 {
        self.sampled.element_sum()
    }

    /// Returns the number of rays to area lights, and the variance of their irradiance, summed over the channels, if each
    /// ray brought the same or nothing, at random.
    pub(crate) fn variance_of_areas(&self) -> (u32, f32) {
        let Ratio { total, visible, samples, rays } = self.areas;
        let (total, visible, samples) = (total.element_sum(), visible.element_sum(), samples.element_sum());
        let part = if samples > 0.0 { (visible / samples).min(1.0) } else { 0.0 };
        (rays, total * total * part * (1.0 - part) / rays.saturating_sub(1).max(1) as f32)
    }

    /// Unoccluded irradiance from area lights.
    pub(crate) fn unoccluded_areas(&self) -> Vec3 {
        self.areas.total
    }

    /// Whether some samples of discs are occluded and others are not.
    pub(crate) fn is_in_a_penumbra_of_discs(&self) -> bool {
        let (visible, samples) = (self.discs.visible.element_sum(), self.discs.samples.element_sum());
        visible > 0.0 && visible < samples * (1.0 - 1e-5)
    }

    /// Whether no sample found any light.
    pub(crate) fn is_dark(&self) -> bool {
        self.sharp + self.sampled + self.discs.visible + self.areas.visible == Vec3::ZERO
    }
}

/// The lights of a scene, ready to be sampled.
pub struct DirectLight {
    scene: Arc<Scene>,
    /// Lights that each get a ray from every point: parallel ones, and point and spot lights if these are few.
    each: Vec<Light>,
    /// Area lights, if they are few.
    areas: Vec<AreaLight>,
    area_count: usize,
    discs: Vec<Disc>,
    skies: Vec<Sky>,
    /// Point and spot lights if these are many, and area lights if these are many.
    many: Option<ManyLights>,
    /// Point and spot lights, few or many, by place.
    pub(crate) near: NearLights,
}

impl DirectLight {
    /// Takes a snapshot of a scene's lights. Panics if there is not enough memory.
    pub fn new(scene: &Arc<Scene>) -> DirectLight {
        DirectLight::try_new(scene).expect("memory for the lights")
    }

    /// Takes a snapshot of a scene's lights. Fails if there is not enough memory.
    pub fn try_new(scene: &Arc<Scene>) -> Result<DirectLight> {
        let lights = scene.lights();
        let all = lights.iter().filter_map(AreaLight::rect).chain(scene.emitters().iter().map(AreaLight::emitter));
        let mut areas = try_collect(all, LIGHT_TREE)?;
        areas.retain(|a| a.radiance.max_element() > 0.0 && a.area > 0.0);
        let shines = |l: &&Light| l.color().iter().any(|&c| c > 0.0);
        let is_point = |l: &&Light| matches!(l, Light::Point { .. } | Light::Spot { .. });
        let is_parallel = |l: &&Light| matches!(l, Light::Directional { angular_radius: 0.0, .. });
        let shining = || lights.iter().filter(shines);
        let points = try_collect(shining().filter(is_point).copied(), LIGHT_TREE)?;
        let mut each = try_collect(shining().filter(is_parallel).copied(), LIGHT_TREE)?;
        let discs = shining().filter_map(|l| match *l {
            Light::Directional { direction, irradiance, angular_radius } if angular_radius > 0.0 => {
                Some(Disc { to_light: -direction, irradiance: Vec3::from(irradiance), angular_radius })
            }
            _ => None,
        });
        let skies = lights.iter().filter_map(|l| scene.sky(l)).filter(|s| !s.is_dark());
        let area_count = areas.len();
        let few_points = points.len() <= MAX_EXACT;
        let few_areas = area_count <= MAX_EXACT;
        let many = ManyLights::new(
            scene.device().isa(),
            if few_points { &[] } else { &points },
            if few_areas { &[] } else { &areas },
        )?;
        if few_points {
            each.extend_from_slice(&points);
        }
        if !few_areas {
            areas = Vec::new();
        }
        Ok(DirectLight {
            scene: scene.clone(),
            each,
            areas,
            area_count,
            discs: try_collect(discs, LIGHT_TREE)?,
            skies: try_collect(skies, LIGHT_TREE)?,
            many: (many.len() > 0).then_some(many),
            near: NearLights::new(points),
        })
    }

    /// Number of rectangular lights and emissive triangles.
    pub fn area_light_count(&self) -> usize {
        self.area_count
    }

    /// Number of lights that are sampled because they are many.
    pub fn many_light_count(&self) -> usize {
        self.many.as_ref().map_or(0, ManyLights::len)
    }

    /// Number of directional lights with a disc.
    pub fn disc_count(&self) -> usize {
        self.discs.len()
    }

    /// Number of skies that shine.
    pub fn sky_count(&self) -> usize {
        self.skies.len()
    }

    /// Number of rays that [`irradiance`](Self::irradiance) traces at a point where all lights shine.
    pub fn rays_per_point(&self, samples: u32) -> f32 {
        let four = self.skies.len() + self.many.is_some() as usize;
        let sampled = self.areas.len().min(MAX_LIGHTS_SAMPLED) + self.discs.len() + four * MAX_LIGHTS_SAMPLED;
        (self.each.len() + samples as usize * sampled) as f32
    }

    /// Whether no light shines.
    pub fn is_dark(&self) -> bool {
        self.area_count == 0
            && self.each.is_empty()
            && self.many.is_none()
            && self.discs.is_empty()
            && self.skies.is_empty()
    }

    /// Irradiance in W/m² at a receiver. `samples`: rays per area light or disc, and a quarter of the rays per sky and
    /// for all of many lights. `seed`: seed of this point. Adds the rays traced to `rays`.
    pub fn irradiance(&self, receiver: &Receiver, samples: u32, seed: u32, rays: &mut u64) -> Vec3 {
        self.estimate(receiver, samples, seed, rays, true)
    }

    /// Irradiance by Monte Carlo alone: with noise even without occluders, but without bias, however few the samples.
    /// (The visible fraction of a single sample does not weigh it by its contribution: with the ratio, path tracing the
    /// Cornell box with one shadow ray per vertex is 1 % too dark.)
    pub fn unbiased(&self, receiver: &Receiver, samples: u32, seed: u32, rays: &mut u64) -> Vec3 {
        self.estimate(receiver, samples, seed, rays, false)
    }

    /// Irradiance by samples; `by_ratio`: that of area lights and discs as their exact irradiance times the visible
    /// fraction.
    fn estimate(&self, receiver: &Receiver, samples: u32, seed: u32, rays: &mut u64, by_ratio: bool) -> Vec3 {
        let l = self.at_point(receiver, Lights::All, samples, seed, rays);
        if by_ratio { l.value() } else { l.sharp + l.sampled + l.discs.visible + l.areas.visible }
    }

    /// Whether there are lights of [`Lights::Sharp`].
    pub(crate) fn has_sharp(&self) -> bool {
        !self.each.is_empty()
    }

    /// Whether there are lights of [`Lights::Soft`].
    pub(crate) fn has_soft(&self) -> bool {
        !self.areas.is_empty() || self.many.is_some() || !self.discs.is_empty() || !self.skies.is_empty()
    }

    /// Whether there are lights with wide penumbrae, which are sampled.
    pub(crate) fn has_wide(&self) -> bool {
        !self.areas.is_empty() || self.many.is_some() || !self.skies.is_empty()
    }

    /// Direct light at one point. `samples`: as in [`irradiance`](Self::irradiance).
    pub(crate) fn at_point(
        &self,
        receiver: &Receiver,
        lights: Lights,
        samples: u32,
        seed: u32,
        rays: &mut u64,
    ) -> PointLight {
        let mut room = PointRoom::new();
        let mut shadow = room.begin(&self.scene);
        let mut light = self.push(receiver, 0, lights, samples, seed, &mut shadow);
        light.take(shadow.finish(rays));
        light
    }

    /// Does the work of [`at_point`](Self::at_point), and returns the light by direction too.
    pub(crate) fn at_point_by_direction(
        &self,
        receiver: &Receiver,
        lights: Lights,
        samples: u32,
        seed: u32,
        rays: &mut u64,
    ) -> (PointLight, Directional) {
        let mut room = PointRoom::by_direction();
        let mut shadow = room.begin(&self.scene);
        let mut light = self.push(receiver, 0, lights, samples, seed, &mut shadow);
        let (sums, directed) = shadow.finish_by_direction(rays);
        light.take(sums);
        let kinds = std::array::from_fn(|kind| directed[kind]);
        (light, light.by_direction(&kinds))
    }

    /// Pushes the shadow rays of a point, for the [`KINDS`](super::shadow_rays::KINDS) slots from the current one on.
    /// It is point `number` of those that share `seed`: their samples of a light are stratified together. Returns the
    /// point's light, which is to [take](PointLight::take) what arrives in these slots. `samples`: per point, as in
    /// [`irradiance`](Self::irradiance).
    pub(crate) fn push(
        &self,
        receiver: &Receiver,
        number: u32,
        lights: Lights,
        samples: u32,
        seed: u32,
        shadow: &mut ShadowRays,
    ) -> PointLight {
        let mut out = PointLight::default();
        shadow.normal = receiver.normal;
        if lights != Lights::Soft {
            for (i, light) in self.each.iter().enumerate() {
                shadow.light = 1 + i;
                push_one(light, receiver, shadow);
            }
        }
        if lights != Lights::Sharp && samples > 0 {
            self.push_soft(receiver, number, samples, seed, shadow, &mut out);
        }
        out
    }

    /// Pushes the shadow rays of [`Lights::Soft`] from point `number` of those that share `seed`.
    fn push_soft(
        &self,
        receiver: &Receiver,
        number: u32,
        samples: u32,
        seed: u32,
        shadow: &mut ShadowRays,
        out: &mut PointLight,
    ) {
        // The sequences of skies and many lights begin anew at every point.
        let own = if number == 0 { seed } else { combine(seed, 64 + number) };
        shadow.slot += 1;
        shadow.light = 0;
        if let Some(many) = &self.many {
            many.push(receiver, samples * MAX_LIGHTS_SAMPLED as u32, own, shadow);
        }
        // Sequences of skies and discs differ by their number.
        for (i, sky) in (0..).zip(&self.skies) {
            push_sky(sky, receiver, samples * MAX_LIGHTS_SAMPLED as u32, combine(own, 16 + i), shadow);
        }
        shadow.slot += 1;
        for (i, disc) in (0..).zip(&self.discs) {
            shadow.light = 1 + self.each.len() + i as usize;
            let (total, light) = disc.push(receiver, number * samples, samples, combine(seed, 16 + i), shadow);
            out.discs.total += total;
            out.discs.samples += light;
        }
        shadow.slot += 1;
        shadow.light = 0;
        if !self.areas.is_empty() {
            (out.areas.total, out.areas.samples, out.areas.rays) =
                self.push_areas(receiver, number, samples, seed, shadow);
        }
    }

    /// Pushes the shadow rays to few area lights. Returns their exact unoccluded irradiance, and the unoccluded sum of
    /// all samples, and the number of rays.
    fn push_areas(
        &self,
        receiver: &Receiver,
        number: u32,
        samples: u32,
        seed: u32,
        shadow: &mut ShadowRays,
    ) -> (Vec3, Vec3, u32) {
        let mut unoccluded = [0.0f32; MAX_EXACT];
        let (mut total, mut importance, mut shining) = (Vec3::ZERO, 0.0f32, 0);
        for (e, area) in unoccluded.iter_mut().zip(&self.areas) {
            *e = area.irradiance(receiver) as f32;
            total += *e * area.radiance;
            importance += *e * area.radiance.element_sum();
            shining += (*e > 0.0) as usize;
        }
        if !(importance > 0.0) {
            return (Vec3::ZERO, Vec3::ZERO, 0);
        }
        let n = samples as usize * shining.min(MAX_LIGHTS_SAMPLED);
        let mut brought = Vec3::ZERO;
        let offset = sobol_2d(number, combine(seed, 1))[0];
        let (mut light, mut below) = (0, 0.0f32);
        let mut prepared = None;
        for k in 0..n {
            // Systematic sampling: the k-th ray goes to the light that the k-th stratum of the sum falls on.
            let target = (k as f32 + offset) / n as f32 * importance;
            let share = |i: usize| unoccluded[i] * self.areas[i].radiance.element_sum();
            while light + 1 < self.areas.len() && below + share(light) <= target {
                below += share(light);
                light += 1;
                prepared = None;
            }
            let area = &self.areas[light];
            let Some(sampler) = prepared.get_or_insert_with(|| area.sampler(receiver)) else { continue };
            let at = sobol_2d(number * n as u32 + k as u32, combine(seed, 2));
            let (point, weight) = area.sample(sampler, receiver, at);
            let weight = weight / share(light).max(f32::MIN_POSITIVE);
            if !(weight > 0.0 && weight.is_finite()) {
                continue;
            }
            let weight = weight * (importance / n as f32);
            brought += weight * area.radiance;
            shadow.push(shadow_ray(receiver, point), weight * area.radiance);
        }
        (total, brought, n as u32)
    }

    /// Emitted radiance of a front (or back) of a triangle.
    pub fn emitted(scene: &Scene, triangle: u32, back: bool) -> Vec3 {
        let material = scene.material(triangle);
        if back && !material.two_sided { Vec3::ZERO } else { Vec3::from(material.emission) }
    }
}

#[cfg(test)]
mod tests;
