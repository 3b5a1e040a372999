//! Light of point and spot lights that are much nearer to a texel than it is wide, such as lamps just below a ceiling.
//!
//! A lamp 5 mm from a surface sends half of its light to a spot of a few centimetres. A few points spread over a texel miss
//! that spot or exaggerate it, and with it what the spot reflects to all the room. So a texel's area is split in two for
//! each light: what is farther from it than [`NEAR`] times the texel's width gets its light at the texel's usual points, and the
//! rest is sampled here, by points that lie as densely as the light would fall on a plane, mixed with points spread evenly, which
//! find what is not in that plane (both weighted by the balance heuristic of Veach and Guibas, *Optimally Combining Sampling
//! Techniques for Monte Carlo Rendering*, 1995). The result has no bias; on a plane without occluders it has hardly any noise.
//!
//! Measured: docs/accuracy.md#lamps-close-to-surfaces.

use super::{TexelAreas, TexelLight, is_hidden};
use crate::base::directional::Directional;
use crate::base::sampling::{combine, sobol_2d};
use crate::direct::Receiver;
use crate::direct::point_light::point_light;
use crate::direct::shadow_rays::PointRoom;
use crate::lightmap::atlas::chart_map::Receivers;
use crate::lightmap::atlas::ids::{Map, TexelId};
use crate::lightmap::atlas::texels::TexelSample;
use crate::scene::Scene;
use glam::{DVec2, DVec3, Vec3};
use std::f64::consts::TAU;

/// Distance up to which a light's irradiance is sampled here, in widths of a texel.
const NEAR: f32 = 1.0;

/// Distance of a light from a texel's sample, in widths of the texel, from which no point of the texel is [`NEAR`] it: half of the
/// diagonal of a texel that is stretched to twice its width, and a sample in a corner, included.
const FAR: f32 = 2.0;

/// Number of points spread evenly over a texel, and of those that lie where a light falls.
const EVEN: u32 = 32;
const PEAKED: u32 = 96;

/// Least height of a light above a texel's plane by which points are placed, in widths of the texel.
const LEAST_HEIGHT: f64 = 1e-6;

/// What lights nearby bring to a texel.
#[derive(Default)]
pub(super) struct Near {
    /// Mean over the texel's square, outside of its chart 0.
    pub light: Vec3,
    /// That light by direction; `None`: nobody asks for it.
    pub directional: Option<Directional>,
}

impl<M: Map> TexelLight<'_, M> {
    /// Returns the square of the distance within which point and spot lights are sampled [here](self); 0 if none is so near to
    /// a texel.
    pub(super) fn near2(&self, texel: TexelId<M>) -> f32 {
        if self.direct.near.is_empty() {
            return 0.0;
        }
        let width = self.areas.width(texel);
        let at = self.areas.map[texel].position(self.areas.scene);
        let is_near = self.direct.near.within((NEAR + FAR) * width, at).next().is_some();
        if is_near && width.is_finite() { (NEAR * width).powi(2) } else { 0.0 }
    }

    /// Adds the light of lights nearby to a texel, on its back if `back`; returns whether there are any. Light at a point counts
    /// by its `weight`, and only where the point can be seen from `own`, if it is given.
    pub(super) fn sample_near(
        &self,
        (texel, back): (TexelId<M>, bool),
        weight: impl Fn(&TexelSample) -> Vec3,
        own: Option<&Receiver>,
        out: &mut Near,
        rays: &mut u64,
    ) -> bool {
        let near2 = self.near2(texel);
        if near2 == 0.0 {
            return false;
        }
        let TexelAreas { scene, map, .. } = self.areas;
        let at = map[texel].position(scene);
        let seed = combine(combine(self.seed, map.seed(texel)), 33);
        let mut room = if out.directional.is_some() { PointRoom::by_direction() } else { PointRoom::new() };
        let (mut shadow, mut receivers) = (room.begin(scene), Receivers::new(scene));
        for (light, position) in self.direct.near.within((NEAR + FAR) * self.areas.width(texel), at) {
            let peak = self.areas.peak(texel, position);
            for i in 0..EVEN + PEAKED {
                let place = match &peak {
                    Some(peak) if i >= EVEN => peak.place(sobol_2d(i - EVEN, combine(seed, 1))),
                    _ => sobol_2d(i, seed),
                };
                if !place.iter().all(|x| (0.0..1.0).contains(x)) {
                    continue;
                }
                let Some(on) = self.areas.point_at(texel, place) else { continue };
                let receiver = receivers.of(&on, back);
                if receiver.position.distance_squared(position) >= near2 {
                    continue;
                }
                let Some((target, irradiance)) = point_light(light, &receiver, 0.0) else { continue };
                if own.is_some_and(|own| is_hidden(scene, own, &receiver, rays)) {
                    continue;
                }
                let density = peak.as_ref().map_or(1.0, |peak| {
                    (f64::from(EVEN) + f64::from(PEAKED) * peak.density(place)) / f64::from(EVEN + PEAKED)
                });
                let scale = (1.0 / (density * f64::from(EVEN + PEAKED))) as f32;
                shadow.normal = receiver.normal;
                shadow.push_point(&receiver, target, irradiance * scale * weight(&on));
            }
        }
        let (arrived, directed) = shadow.finish_by_direction(rays);
        out.light += arrived[0];
        if let (Some(out), Some(&directed)) = (&mut out.directional, directed.first()) {
            *out += directed;
        }
        true
    }
}

impl<M: Map> TexelAreas<'_, M> {
    /// Returns the greater side of a texel in the scene.
    fn width(&self, texel: TexelId<M>) -> f32 {
        let [x, y] = self.map.layout[self.map.placement_of(self.charts, texel)].scale;
        1.0 / x.min(y)
    }

    /// Returns where on a texel the light of a point light falls; `None` if its triangle is too narrow to tell, or if it is far away.
    fn peak(&self, texel: TexelId<M>, light: Vec3) -> Option<Peak> {
        let own = &self.map[texel];
        let placement = &self.map.layout[self.map.placement_of(self.charts, texel)];
        let [a, b, c] = corners(self.scene, own.triangle);
        let in_texel = |u: f32, v: f32| {
            let at = placement.texel_coord(self.charts.local(own.triangle, u, v));
            DVec2::new(f64::from(at[0]) - f64::from(own.x), f64::from(at[1]) - f64::from(own.y))
        };
        let (origin, along_u, along_v) = (in_texel(0.0, 0.0), in_texel(1.0, 0.0), in_texel(0.0, 1.0));
        let (along_u, along_v) = (along_u - origin, along_v - origin);
        let (edge_u, edge_v, to) = (b - a, c - a, light.as_dvec3() - a);
        let normal = edge_u.cross(edge_v);
        // Barycentric weights of the foot of the perpendicular from the light.
        let twice_area2 = normal.length_squared();
        let u = to.cross(edge_v).dot(normal) / twice_area2;
        let v = edge_u.cross(to).dot(normal) / twice_area2;
        let texels2 = along_u.perp_dot(along_v).abs() / twice_area2.sqrt();
        let height = (to.dot(normal).abs() / twice_area2.sqrt() * texels2.sqrt()).max(LEAST_HEIGHT);
        let foot = origin + u * along_u + v * along_v;
        // Chart maps may be stretched.
        let [x, y] = placement.scale;
        let radius = 2.0 * f64::from(NEAR * x.max(y) / x.min(y));
        (foot.is_finite() && height.is_finite()).then(|| Peak::new(foot, height, radius)).flatten()
    }
}

fn corners(scene: &Scene, triangle: u32) -> [DVec3; 3] {
    let (object, triangle) = scene.locate(triangle);
    scene.object(object).corners(triangle).map(|corner| corner.as_dvec3())
}

/// Density of points in the part of a texel that lies within a square around the foot of the perpendicular from a light to its plane,
/// in proportion to its irradiance there: uniform in the solid angle of a rectangle (Ureña, Fajardo and King, *An
/// Area-Preserving Parametrization for Spherical Rectangles*, 2013). Lengths are in texels.
struct Peak {
    foot: DVec2,
    height: f64,
    /// Corners of the rectangle, seen from the foot.
    lower: DVec2,
    upper: DVec2,
    solid_angle: f64,
    /// Sum of the angles at the rectangle's corners at its greater x, from which angles of parts of it are counted.
    rest: f64,
    /// Components along the light's height of the normals of the planes through the light and the sides along x.
    normals: [f64; 2],
}

impl Peak {
    /// Makes the density in a texel, up to a `radius` from the foot; `None` if the texel lies beyond it.
    fn new(foot: DVec2, height: f64, radius: f64) -> Option<Peak> {
        let lower = (-foot).max(DVec2::splat(-radius));
        let upper = (DVec2::ONE - foot).min(DVec2::splat(radius));
        let corners = [(lower.x, lower.y), (upper.x, lower.y), (upper.x, upper.y), (lower.x, upper.y)];
        let corners = corners.map(|(x, y)| DVec3::new(x, y, -height));
        let normal = |k: usize| corners[k].cross(corners[(k + 1) % 4]).normalize_or_zero();
        let normals = [normal(0), normal(1), normal(2), normal(3)];
        let angle = |k: usize| (-normals[k].dot(normals[(k + 1) % 4])).clamp(-1.0, 1.0).acos();
        let rest = TAU - angle(2) - angle(3);
        let solid_angle = angle(0) + angle(1) - rest;
        let normals = [normals[0].z, normals[2].z];
        let is_seen = lower.cmplt(upper).all() && solid_angle > 0.0;
        is_seen.then_some(Peak { foot, height, lower, upper, solid_angle, rest, normals })
    }

    /// Returns a place of this density for a point of the unit square.
    fn place(&self, [s, t]: [f32; 2]) -> [f32; 2] {
        let Peak { foot, height, lower, upper, .. } = *self;
        let (sin, cos) = (f64::from(s) * self.solid_angle + self.rest).sin_cos();
        let along = (cos * self.normals[0] - self.normals[1]) / sin;
        let c = (1.0 / (along * along + self.normals[0] * self.normals[0]).sqrt()).min(1.0).copysign(along);
        let x = (c * height / (1.0 - c * c).sqrt()).clamp(lower.x, upper.x);
        let d2 = x * x + height * height;
        let [h0, h1] = [lower.y, upper.y].map(|y| y / (d2 + y * y).sqrt());
        let h = h0 + f64::from(t) * (h1 - h0);
        let y = (h * (d2 / (1.0 - h * h)).sqrt()).clamp(lower.y, upper.y);
        [(foot.x + x) as f32, (foot.y + y) as f32]
    }

    /// Returns the density at a place, per area of a texel.
    fn density(&self, [x, y]: [f32; 2]) -> f64 {
        let at = DVec2::new(f64::from(x), f64::from(y)) - self.foot;
        let d2 = self.height * self.height + at.length_squared();
        let is_within = at.cmpge(self.lower).all() && at.cmple(self.upper).all();
        if is_within { self.height / (d2 * d2.sqrt() * self.solid_angle) } else { 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_have_the_density_that_is_told() {
        for (foot, height) in [([0.4, 0.6], 0.3), ([0.5, 0.03], 0.01), ([1.2, -0.3], 0.05), ([0.2, 1.7], 0.5)] {
            let peak = Peak::new(DVec2::from(foot), height, 2.0).unwrap();
            // The texel in cells: the density's integral, and the part of the places in each.
            const CELLS: usize = 4;
            let (mut found, mut expected) = ([0.0; CELLS * CELLS], [0.0; CELLS * CELLS]);
            let n = 1 << 14;
            for i in 0..n {
                let [x, y] = peak.place(sobol_2d(i, 7));
                assert!((-1e-6..=1.0 + 1e-6).contains(&x) && (-1e-6..=1.0 + 1e-6).contains(&y), "{x}, {y}");
                let cell = |x: f32| ((x * CELLS as f32) as usize).min(CELLS - 1);
                found[cell(y) * CELLS + cell(x)] += 1.0 / f64::from(n);
            }
            for (cell, expected) in expected.iter_mut().enumerate() {
                const FINE: usize = 400;
                let width = 1.0 / (CELLS * FINE) as f64;
                for i in 0..FINE * FINE {
                    let at = |cell: usize, i: usize| (((cell * FINE + i) as f64 + 0.5) * width) as f32;
                    *expected += peak.density([at(cell % CELLS, i % FINE), at(cell / CELLS, i / FINE)]) * width * width;
                }
            }
            let total: f64 = expected.iter().sum();
            assert!((total - 1.0).abs() < 0.01, "{total} at {foot:?}");
            for (f, e) in found.iter().zip(expected) {
                assert!((f - e).abs() < 0.005, "{f} instead of {e} at {foot:?}");
            }
        }
    }
}
