//! Direct light at points of surfaces, by shadow rays (thesis 3.2.6).
//!
//! Point, spot and directional lights take one ray. For area lights (rect lights and emissive
//! triangles) the unoccluded irradiance is computed exactly and multiplied by the fraction of it
//! that rays find visible (the ratio estimator of Heitz, Hill and McGuire, *Combining Analytic
//! Direct Illumination and Stochastic Shadows*, 2018): without occluders there is no noise. Of very
//! many area lights each ray picks one at random, and the estimate is the plain unbiased one.

use super::{polygon, terminator};
use crate::sampling::{combine, sobol_2d, uniform_triangle};
use crate::scene::{BRIGHTEST, Light, Scene};
use crate::trace::Ray;
use crate::trace::offset::{SurfacePoint, offset_ray_origin, ray_epsilon};
use glam::Vec3;
use std::sync::Arc;

/// Up to this many area lights are evaluated exactly at every point.
const MAX_ANALYTIC: usize = 64;

/// Rays to area lights from one point, at most: this many times those for one light.
const MAX_LIGHTS_SAMPLED: usize = 4;

/// Shadow rays end this far before a light, as a fraction of the way; before a point at most.
const LIGHT_MARGIN: f32 = 1e-4;

/// A point that receives light.
#[derive(Clone, Copy, Debug)]
pub struct Receiver {
    /// Where its rays start.
    pub origin: Vec3,
    /// Unit normal of the irradiance.
    pub normal: Vec3,
    /// Unit geometric normal on the same side.
    pub geometric: Vec3,
    /// The point whose light is wanted: on the surface, or raised from it.
    pub position: Vec3,
    /// Where its shadow rays start.
    pub shadow_origin: Vec3,
    /// Raised to the smooth surface that its normals stand on: the flat one shades nothing there.
    pub raised: bool,
}

impl Receiver {
    /// The front (or back) of a point of a triangle. `shading` is the interpolated normal, if the
    /// mesh has any; it is turned to the side.
    pub fn new(scene: &Scene, point: &SurfacePoint, shading: Option<Vec3>, back: bool) -> Receiver {
        let geometric = if back { -point.normal } else { point.normal };
        let normal = match shading {
            Some(n) if n.dot(geometric) < 0.0 => -n,
            Some(n) => n,
            None => geometric,
        };
        let origin = offset_ray_origin(point.interior, geometric, scene);
        Receiver { origin, normal, geometric, position: point.position, shadow_origin: origin, raised: false }
    }

    /// The same on a mesh with normals: those of the corners of the point's triangle.
    pub(super) fn smooth(self, scene: &Scene, corners: [Vec3; 3], normals: [Vec3; 3], uv: [f32; 2]) -> Receiver {
        let normals = normals.map(|n| if n.dot(self.geometric) < 0.0 { -n } else { n });
        match terminator::raised(scene, corners, normals, uv, self.geometric, self.origin) {
            Some(p) => Receiver { position: p, shadow_origin: p, raised: true, ..self },
            None => self,
        }
    }

    /// Whether the flat surface faces what lies in a direction, as far as that matters.
    fn faces(&self, direction: Vec3) -> bool {
        self.raised || direction.dot(self.geometric) > 0.0
    }
}

/// A parallelogram or a triangle that emits.
#[derive(Clone, Copy, Debug)]
struct AreaLight {
    corner: Vec3,
    edge_u: Vec3,
    edge_v: Vec3,
    /// Unit normal of the emitting side.
    normal: Vec3,
    area: f32,
    triangle: bool,
    two_sided: bool,
    radiance: Vec3,
}

impl AreaLight {
    /// Unoccluded irradiance for radiance 1.
    fn irradiance(&self, receiver: &Receiver) -> f64 {
        let o = receiver.origin.as_dvec3();
        let c = self.corner.as_dvec3() - o;
        let (u, v) = (self.edge_u.as_dvec3(), self.edge_v.as_dvec3());
        if !self.two_sided && c.dot(self.normal.as_dvec3()) >= 0.0 {
            return 0.0;
        }
        let normal = receiver.normal.as_dvec3();
        if self.triangle {
            polygon::irradiance(&[c, c + u, c + v], normal)
        } else {
            polygon::irradiance(&[c, c + u, c + u + v, c + v], normal)
        }
    }

    /// A point on the light, uniform in area.
    fn sample(&self, u: [f32; 2]) -> Vec3 {
        let [u, v] = if self.triangle { uniform_triangle(u) } else { u };
        self.corner + u * self.edge_u + v * self.edge_v
    }

    /// cos cos'/d² between a point of the light and a receiver: irradiance per area for radiance 1.
    fn geometry_term(&self, receiver: &Receiver, point: Vec3) -> f32 {
        let way = point - receiver.origin;
        let d2 = way.length_squared();
        if d2 == 0.0 {
            return 0.0;
        }
        let there = -way.dot(self.normal);
        let there = if self.two_sided { there.abs() } else { there.max(0.0) };
        // Divided one by one: the fourth power of a distance of 10⁹ overflows.
        way.dot(receiver.normal).max(0.0) / d2 * (there / d2)
    }
}

fn shadow_ray(receiver: &Receiver, target: Vec3) -> Ray {
    Ray::new(receiver.shadow_origin, target - receiver.shadow_origin).within(0.0, 1.0 - LIGHT_MARGIN)
}

/// Shadow rays that are traced together. (Direct light of the living room, 20 texels/m: 1.4 s; one by one 2.15 s.)
const TOGETHER: usize = 32;

/// Shadow rays and the light that comes along them if nothing is in the way.
struct ShadowRays<'a> {
    scene: &'a Scene,
    rays: [Ray; TOGETHER],
    light: [Vec3; TOGETHER],
    count: usize,
    traced: u64,
    visible: Vec3,
}

impl<'a> ShadowRays<'a> {
    fn new(scene: &'a Scene) -> Self {
        let rays = [Ray::new(Vec3::ZERO, Vec3::ZERO); TOGETHER];
        ShadowRays { scene, rays, light: [Vec3::ZERO; TOGETHER], count: 0, traced: 0, visible: Vec3::ZERO }
    }

    fn push(&mut self, ray: Ray, light: Vec3) {
        if self.count == TOGETHER {
            self.trace();
        }
        (self.rays[self.count], self.light[self.count]) = (ray, light);
        self.count += 1;
    }

    fn trace(&mut self) {
        let mut occluded = [0; TOGETHER];
        let scene = self.scene;
        scene.occluded_block(&self.rays[..self.count], &mut occluded);
        for (light, _) in self.light[..self.count].iter().zip(occluded).filter(|(_, occluded)| *occluded == 0) {
            self.visible += *light;
        }
        self.traced += self.count as u64;
        self.count = 0;
    }

    /// The light that arrives; adds the rays traced to `rays`.
    fn finish(mut self, rays: &mut u64) -> Vec3 {
        self.trace();
        *rays += self.traced;
        self.visible
    }
}

/// The lights of a scene, ready to be sampled.
pub struct DirectLight {
    scene: Arc<Scene>,
    lights: Arc<Vec<Light>>,
    areas: Vec<AreaLight>,
    /// Cumulative power of `areas`, normalised, for the many-light case.
    power_cdf: Vec<f32>,
}

impl DirectLight {
    /// A snapshot of a scene's lights.
    pub fn new(scene: &Arc<Scene>) -> DirectLight {
        let lights = scene.lights();
        let mut areas = Vec::new();
        for light in lights.iter() {
            if let Light::Rect { position, edge_u, edge_v, radiance } = *light {
                let cross = edge_u.as_dvec3().cross(edge_v.as_dvec3());
                areas.push(AreaLight {
                    corner: position,
                    edge_u,
                    edge_v,
                    normal: cross.normalize().as_vec3(),
                    area: cross.length() as f32,
                    triangle: false,
                    two_sided: false,
                    radiance: Vec3::from(radiance),
                });
            }
        }
        areas.extend(scene.emitters().iter().map(|e| AreaLight {
            corner: e.corner,
            edge_u: e.edge_u,
            edge_v: e.edge_v,
            normal: e.normal,
            area: e.area,
            triangle: true,
            two_sided: e.two_sided,
            radiance: Vec3::from(e.radiance),
        }));
        areas.retain(|a| a.radiance.max_element() > 0.0 && a.area > 0.0);
        let total: f64 = areas.iter().map(|a| (a.radiance.element_sum() * a.area) as f64).sum();
        let mut below = 0.0;
        let power_cdf = areas
            .iter()
            .map(|a| {
                below += (a.radiance.element_sum() * a.area) as f64 / total;
                below as f32
            })
            .collect();
        DirectLight { scene: scene.clone(), lights, areas, power_cdf }
    }

    /// Rect lights and emissive triangles.
    pub fn area_light_count(&self) -> usize {
        self.areas.len()
    }

    /// Rays that [`irradiance`](Self::irradiance) traces where all lights shine.
    pub fn rays_per_point(&self, samples: u32) -> f32 {
        let others = self.lights.iter().filter(|l| !matches!(l, Light::Rect { .. })).count();
        (others + samples as usize * self.areas.len().min(MAX_LIGHTS_SAMPLED)) as f32
    }

    /// Whether any light shines.
    pub fn is_dark(&self) -> bool {
        self.areas.is_empty() && self.lights.iter().all(|l| l.color().iter().all(|&c| c == 0.0))
    }

    /// Irradiance in W/m² at a receiver. `samples`: rays per area light. `seed`: of this point.
    /// Adds the rays traced to `rays`.
    pub fn irradiance(&self, receiver: &Receiver, samples: u32, seed: u32, rays: &mut u64) -> Vec3 {
        let mut sum = Vec3::ZERO;
        for light in self.lights.iter() {
            sum += self.one_light(light, receiver, rays);
        }
        if self.areas.is_empty() || samples == 0 {
            sum
        } else if self.areas.len() <= MAX_ANALYTIC {
            sum + self.few_area_lights(receiver, samples, seed, rays)
        } else {
            sum + self.many_area_lights(receiver, samples, seed, rays)
        }
    }

    /// Whether a point light is seen. Its ray ends as far before it as rays start from surfaces: a light
    /// may lie on a wall, but also close inside of a housing that must hold its light back.
    fn visible(&self, receiver: &Receiver, light: Vec3, rays: &mut u64) -> bool {
        *rays += 1;
        let way = light - receiver.shadow_origin;
        let margin = (ray_epsilon(light, &self.scene) / way.length()).min(LIGHT_MARGIN);
        !self.scene.occluded(&Ray::new(receiver.shadow_origin, way).within(0.0, 1.0 - margin))
    }

    fn one_light(&self, light: &Light, receiver: &Receiver, rays: &mut u64) -> Vec3 {
        match *light {
            Light::Point { position, intensity } => self.point_light(position, Vec3::from(intensity), receiver, rays),
            Light::Spot { position, direction, inner, outer, intensity } => {
                let way = (receiver.position - position).normalize_or_zero();
                let falloff = Light::spot_falloff(way.dot(direction), inner, outer);
                self.point_light(position, Vec3::from(intensity) * falloff, receiver, rays)
            }
            Light::Directional { direction, irradiance } => {
                let cosine = -direction.dot(receiver.normal);
                let irradiance = Vec3::from(irradiance) * cosine;
                if cosine <= 0.0 || !receiver.faces(-direction) || irradiance.max_element() <= 0.0 {
                    return Vec3::ZERO;
                }
                *rays += 1;
                if self.scene.occluded(&Ray::new(receiver.shadow_origin, -direction)) { Vec3::ZERO } else { irradiance }
            }
            Light::Rect { .. } => Vec3::ZERO,
        }
    }

    fn point_light(&self, position: Vec3, intensity: Vec3, receiver: &Receiver, rays: &mut u64) -> Vec3 {
        // From the surface itself, not from where rays start: a light may be nearer to it than that.
        let way = position.as_dvec3() - receiver.position.as_dvec3();
        let d2 = way.length_squared();
        let cosine = way.dot(receiver.normal.as_dvec3());
        if cosine <= 0.0 || !receiver.faces(way.as_vec3()) || intensity.max_element() <= 0.0 {
            return Vec3::ZERO;
        }
        let factor = (cosine / (d2 * d2.sqrt())).min(BRIGHTEST as f64) as f32;
        let light = (intensity * factor).min(Vec3::splat(BRIGHTEST));
        if self.visible(receiver, position, rays) { light } else { Vec3::ZERO }
    }

    /// Exact unoccluded irradiance times the visible fraction of it.
    fn few_area_lights(&self, receiver: &Receiver, samples: u32, seed: u32, rays: &mut u64) -> Vec3 {
        let mut unoccluded = [0.0f32; MAX_ANALYTIC];
        let (mut total, mut importance, mut shining) = (Vec3::ZERO, 0.0f32, 0);
        for (e, area) in unoccluded.iter_mut().zip(&self.areas) {
            *e = area.irradiance(receiver) as f32;
            total += *e * area.radiance;
            importance += *e * area.radiance.element_sum();
            shining += (*e > 0.0) as usize;
        }
        if !(importance > 0.0) {
            return Vec3::ZERO;
        }
        let n = samples as usize * shining.min(MAX_LIGHTS_SAMPLED);
        let (mut weights, mut shadow) = (Vec3::ZERO, ShadowRays::new(&self.scene));
        let offset = sobol_2d(0, combine(seed, 1))[0];
        let (mut light, mut below) = (0, 0.0f32);
        for k in 0..n {
            // Systematic: the k-th ray goes to the light that the k-th stratum of the sum falls on.
            let target = (k as f32 + offset) / n as f32 * importance;
            let share = |i: usize| unoccluded[i] * self.areas[i].radiance.element_sum();
            while light + 1 < self.areas.len() && below + share(light) <= target {
                below += share(light);
                light += 1;
            }
            let area = &self.areas[light];
            let point = area.sample(sobol_2d(k as u32, combine(seed, 2)));
            let weight = area.geometry_term(receiver, point) * area.area / share(light).max(f32::MIN_POSITIVE);
            if !(weight > 0.0 && weight.is_finite()) {
                continue;
            }
            weights += weight * area.radiance;
            shadow.push(shadow_ray(receiver, point), weight * area.radiance);
        }
        let visible = shadow.finish(rays);
        let fraction = |v: f32, w: f32| if w > 0.0 { v / w } else { 0.0 };
        total
            * Vec3::new(fraction(visible.x, weights.x), fraction(visible.y, weights.y), fraction(visible.z, weights.z))
    }

    /// Unbiased: lights picked by power.
    fn many_area_lights(&self, receiver: &Receiver, samples: u32, seed: u32, rays: &mut u64) -> Vec3 {
        let n = samples as usize * MAX_LIGHTS_SAMPLED;
        let offset = sobol_2d(0, combine(seed, 1))[0];
        let mut shadow = ShadowRays::new(&self.scene);
        for k in 0..n {
            let target = (k as f32 + offset) / n as f32;
            let light = self.power_cdf.partition_point(|&c| c <= target).min(self.areas.len() - 1);
            let area = &self.areas[light];
            let below = if light == 0 { 0.0 } else { self.power_cdf[light - 1] };
            let probability = self.power_cdf[light] - below;
            let point = area.sample(sobol_2d(k as u32, combine(seed, 2)));
            let weight = area.geometry_term(receiver, point) * area.area / (probability * n as f32);
            if weight > 0.0 && weight.is_finite() {
                shadow.push(shadow_ray(receiver, point), weight * area.radiance);
            }
        }
        shadow.finish(rays)
    }

    /// Emitted radiance of a front (or back) of a triangle.
    pub fn emitted(scene: &Scene, triangle: u32, back: bool) -> Vec3 {
        let material = scene.material(triangle);
        if back && !material.two_sided { Vec3::ZERO } else { Vec3::from(material.emission) }
    }
}
