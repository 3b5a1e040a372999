//! Light sampling of the path tracer.
//!
//! Every light proposes one sample; one of the proposals is taken with a probability in proportion
//! to what it would contribute unoccluded, and a single shadow ray decides. (The expectation is the
//! sum of all lights whatever the proposals were, so this adds no bias.) Lights with an area are
//! weighted against directions sampled by cosine with the balance heuristic (Veach 1997, section
//! 9.2.2), which keeps surfaces close to them free of fireflies.

use super::proposal::{Proposal, balance, brightness, rgb};
use super::random::{Random, triangle_point};
use super::sky::Sky;
use crate::scene::{Environment, Light, Material, Mesh};
use glam::{DVec3, Vec3};
use std::f64::consts::{PI, TAU};
use std::sync::Arc;

/// A flat piece of surface that radiates.
#[derive(Clone, Copy, Debug)]
struct Area {
    corner: DVec3,
    edge_u: DVec3,
    edge_v: DVec3,
    /// Unit normal on the radiating side.
    normal: DVec3,
    radiance: DVec3,
    two_sided: bool,
    /// Density of samples per area.
    density: f64,
}

/// All lights of a scene.
pub struct Lights {
    /// Point, spot and directional lights.
    simple: Vec<Light>,
    skies: Vec<Sky>,
    rects: Vec<Area>,
    emitters: Vec<Area>,
    /// Running sums of the emitters' power (in luminance-like units), the total last.
    power: Vec<f64>,
}

impl Area {
    fn new(corner: DVec3, edge_u: DVec3, edge_v: DVec3, radiance: [f32; 3], two_sided: bool) -> Self {
        let normal = edge_u.cross(edge_v).normalize_or_zero();
        Area { corner, edge_u, edge_v, normal, radiance: rgb(radiance), two_sided, density: 0.0 }
    }

    /// Density per solid angle of an area sample seen under `cosine` (on the light) at `distance`;
    /// `None` on the side that does not radiate.
    fn solid_angle_density(&self, cosine: f64, distance: f64) -> Option<f64> {
        let cosine = if self.two_sided { cosine.abs() } else { cosine };
        (cosine > 0.0).then(|| self.density * distance * distance / cosine)
    }

    /// The sample at `corner + u · edge_u + v · edge_v`.
    fn propose(&self, point: DVec3, normal: DVec3, [u, v]: [f64; 2]) -> Option<Proposal> {
        let to_light = self.corner + self.edge_u * u + self.edge_v * v - point;
        let distance = to_light.length();
        let direction = to_light / distance;
        let cosine = normal.dot(direction);
        if cosine.is_nan() || cosine <= 0.0 {
            return None;
        }
        let density = self.solid_angle_density(-self.normal.dot(direction), distance)?;
        // Radiance · cosine / density, times density / (density + density by cosine).
        Some(Proposal { irradiance: self.radiance * (cosine / (density + cosine / PI)), direction, distance })
    }
}

impl Lights {
    /// The lights of a scene, emissive triangles included.
    pub fn new(meshes: &[Mesh], materials: &[Material], environments: &[Arc<Environment>], lights: &[Light]) -> Self {
        let mut simple = Vec::new();
        let mut skies = Vec::new();
        let mut rects = Vec::new();
        for light in lights {
            match *light {
                Light::Rect { position, edge_u, edge_v, radiance } => {
                    let [corner, u, v] = [position, edge_u, edge_v].map(Vec3::as_dvec3);
                    let density = 1.0 / u.cross(v).length();
                    rects.push(Area { density, ..Area::new(corner, u, v, radiance, false) });
                }
                Light::Sky { .. } => skies.extend(Sky::new(light, environments)),
                other => simple.push(other),
            }
        }
        let mut emitters = Vec::new();
        let mut power = Vec::new();
        let mut total = 0.0;
        for mesh in meshes {
            for t in 0..mesh.indices.len() {
                let material = &materials[mesh.material(t) as usize];
                let [a, b, c] = mesh.corners(t).map(Vec3::as_dvec3);
                let area = 0.5 * (b - a).cross(c - a).length();
                if material.is_emissive() && area > 0.0 && area.is_finite() {
                    total += area * brightness_of(material);
                    power.push(total);
                    emitters.push(Area::new(a, b - a, c - a, material.emission, material.two_sided));
                }
            }
        }
        for e in &mut emitters {
            e.density = brightness(e.radiance) * if e.two_sided { 2.0 } else { 1.0 } / total;
        }
        Lights { simple, skies, rects, emitters, power }
    }

    /// Chooses a light and a point on it for the surface element at `point`. `square` places the
    /// point on area lights.
    pub fn propose(&self, point: DVec3, normal: DVec3, square: [f64; 2], random: &mut Random) -> Option<Proposal> {
        let mut chosen: Option<Proposal> = None;
        let mut total = 0.0;
        let mut offer = |proposal: Option<Proposal>, random: &mut Random| {
            let Some(proposal) = proposal else { return };
            let weight = brightness(proposal.irradiance);
            total += weight;
            if weight > 0.0 && random.uniform() * total < weight {
                chosen = Some(proposal);
            }
        };
        for light in &self.simple {
            offer(propose_simple(light, point, normal, square), random);
        }
        for sky in &self.skies {
            offer(sky.propose(normal, random), random);
        }
        for rect in &self.rects {
            offer(rect.propose(point, normal, square), random);
        }
        if let Some(&all) = self.power.last() {
            let pick = random.uniform() * all;
            let i = self.power.partition_point(|&p| p <= pick).min(self.emitters.len() - 1);
            offer(self.emitters[i].propose(point, normal, triangle_point(square)), random);
        }
        chosen.map(|p| Proposal { irradiance: p.irradiance * (total / brightness(p.irradiance)), ..p })
    }

    /// Radiance of the rect lights that a ray sampled by cosine crosses between two distances, weighted against
    /// area sampling. (Rect lights stop no rays, so there may be several.)
    pub fn rects_along(&self, origin: DVec3, direction: DVec3, range: [f64; 2], by_direction: f64) -> DVec3 {
        self.rects.iter().fold(DVec3::ZERO, |sum, rect| sum + rect_along(rect, origin, direction, range, by_direction))
    }

    /// Radiance of the skies along a ray that hits nothing, weighted against their own sampling if its
    /// direction was sampled by cosine.
    pub fn skies_along(&self, direction: DVec3, by_direction: Option<f64>) -> DVec3 {
        self.skies.iter().map(|s| s.along(direction, by_direction)).sum()
    }

    /// Weight of a triangle's emission that a ray sampled by cosine has found at `distance`, under
    /// |`cosine`| on the triangle.
    pub fn emission_weight(&self, material: &Material, cosine: f64, distance: f64, by_direction: f64) -> f64 {
        let Some(total) = self.power.last() else { return 1.0 };
        let by_area = brightness_of(material) / total * distance * distance / cosine.abs();
        balance(by_direction, by_area)
    }
}

/// Radiant exitance of a material, in units of [`brightness`].
fn brightness_of(material: &Material) -> f64 {
    brightness(rgb(material.emission)) * if material.two_sided { 2.0 } else { 1.0 }
}

fn rect_along(rect: &Area, origin: DVec3, direction: DVec3, [from, to]: [f64; 2], by_direction: f64) -> DVec3 {
    let cosine = -rect.normal.dot(direction);
    let distance = -rect.normal.dot(rect.corner - origin) / cosine;
    if !(cosine > 0.0 && distance > from && distance < to) {
        return DVec3::ZERO;
    }
    let p = origin + direction * distance - rect.corner;
    let doubled = rect.edge_u.cross(rect.edge_v);
    let area = doubled.length_squared();
    let u = p.cross(rect.edge_v).dot(doubled) / area;
    let v = rect.edge_u.cross(p).dot(doubled) / area;
    if !(0.0..=1.0).contains(&u) || !(0.0..=1.0).contains(&v) {
        return DVec3::ZERO;
    }
    let by_area = rect.density * distance * distance / cosine;
    rect.radiance * balance(by_direction, by_area)
}

/// Point, spot and directional lights; `square` places the sample on a disc.
fn propose_simple(light: &Light, point: DVec3, normal: DVec3, square: [f64; 2]) -> Option<Proposal> {
    let towards = |position: Vec3| {
        let to_light = position.as_dvec3() - point;
        let distance = to_light.length();
        (distance > 0.0).then(|| (to_light / distance, distance))
    };
    let (direction, distance, irradiance) = match *light {
        Light::Point { position, intensity } => {
            let (direction, distance) = towards(position)?;
            (direction, distance, rgb(intensity) / (distance * distance))
        }
        Light::Spot { position, direction: axis, inner, outer, intensity } => {
            let (direction, distance) = towards(position)?;
            let cosine = -direction.dot(axis.as_dvec3().normalize());
            let falloff = Light::spot_falloff(cosine as f32, inner, outer) as f64;
            (direction, distance, rgb(intensity) * (falloff / (distance * distance)))
        }
        Light::Directional { direction, irradiance, angular_radius } => {
            let axis = -direction.as_dvec3().normalize();
            let (x, y) = axis.any_orthonormal_pair();
            // A disc in the plane across the axis projects to the cap: radiance L, density cos/(π sin² α),
            // so the weight of a sample is L π sin² α / cos = irradiance / cos.
            let sine = (angular_radius as f64).sin() * square[0].sqrt();
            let cosine = (1.0 - sine * sine).sqrt();
            let (sin, cos) = (TAU * square[1]).sin_cos();
            (axis * cosine + (x * cos + y * sin) * sine, f64::INFINITY, rgb(irradiance) / cosine.max(1e-9))
        }
        Light::Rect { .. } | Light::Sky { .. } => return None,
    };
    let cosine = normal.dot(direction);
    (cosine > 0.0).then(|| Proposal { irradiance: irradiance * cosine, direction, distance })
}
