//! Light of lamps (point and spot lights) that are closer to a texel than it is wide, such as just below a ceiling.
//!
//! A lamp 5 mm from a surface sends half of its light to a spot of a few centimetres. A few points spread over a texel miss
//! that spot or exaggerate it, and with it what the spot reflects to all the room. So a texel's area is split in two for
//! each lamp: what is farther from it than [`NEAR`] times the texel's width gets its light at the texel's usual points
//! ([`Near`]), and the rest is sampled here, by points that lie as densely as the light would fall on a plane, mixed with points
//! spread evenly, which find what is not in that plane (both weighted by the balance heuristic of Veach and Guibas, *Optimally
//! Combining Sampling Techniques for Monte Carlo Rendering*, 1995). On a plane without occluders there is hardly any noise. Points
//! that the texel's sample does not see, inside solids or behind a wall that stands on the texel, do not count.
//!
//! Measured: docs/accuracy.md#lamps-close-to-surfaces.

use super::{TexelAreas, TexelLight, is_hidden};
use crate::base::directional::Directional;
use crate::base::sampling::{combine, sobol_2d};
use crate::direct::Receiver;
use crate::direct::point_light::point_light;
use crate::direct::shadow_rays::{Near, PointRoom};
use crate::lightmap::atlas::chart_map::Receivers;
use crate::lightmap::atlas::ids::{Map, TexelId};
use crate::lightmap::atlas::texels::TexelSample;
use glam::{DVec2, DVec3, Vec3};
use std::f64::consts::TAU;

/// Distance up to which a lamp's light is sampled here, in widths of a texel.
const NEAR: f32 = 1.0;

/// Greatest distance of such a lamp from the texel's sample, in widths of the texel: of others the usual points find the
/// light, as of a lamp a width away from the corner of a square texel with its sample in the middle.
const REACH: f32 = 1.75;

/// Number of points spread evenly over a texel, of those that lie where the light of one lamp falls, and of the latter for
/// all lamps together. Where more lamps than [`MOST`] are close to a texel, none is sampled here, which would take long.
const EVEN: u32 = 32;
const PEAKED: u32 = 96;
const PEAKED_OF_ALL: u32 = 768;
const MOST: usize = 64;

/// Least height of a lamp above a texel's plane by which points are placed, in widths of the texel.
const LEAST_HEIGHT: f64 = 1e-6;

/// Distance in texels by which a point may miss the place that was asked for.
const ROUNDING: f64 = 1e-3;

impl<M: Map> TexelLight<'_, M> {
    /// Returns the lamps of which light is sampled [here](self), if there are any so close to a texel.
    pub(super) fn near(&self, texel: TexelId<M>) -> Near {
        if self.direct.near.is_empty() {
            return Near::default();
        }
        let width = self.areas.width(texel);
        let (of, reach2) = (self.areas.map[texel].position(self.areas.scene), (REACH * width).powi(2));
        let count = self.direct.near.within(reach2, of).take(MOST + 1).count();
        let is_near = (1..=MOST).contains(&count) && reach2.is_finite();
        Near { distance2: if is_near { (NEAR * width).powi(2) } else { 0.0 }, of, reach2 }
    }

    /// Returns the mean light of lamps `near` a texel, on its back if `back`. Light at a point counts by its `weight`, and points
    /// by whether they are seen from the texel's sample, `own`. If light by direction is asked for, it is added to `directional`.
    pub(super) fn sample_near(
        &self,
        (texel, back): (TexelId<M>, bool),
        near: &Near,
        own: &Receiver,
        weight: impl Fn(&TexelSample) -> Vec3,
        directional: Option<&mut Directional>,
        rays: &mut u64,
    ) -> Vec3 {
        let TexelAreas { scene, map, .. } = self.areas;
        let seed = combine(combine(self.seed, map.seed(texel)), 33);
        let mut receivers = Receivers::new(scene);
        let mut counting = |place, rays: &mut u64| {
            let on = self.areas.point_at(texel, place)?;
            let receiver = receivers.of(&on, back);
            (!is_hidden(scene, own, &receiver, rays)).then_some((on, receiver))
        };
        let even: [_; EVEN as usize] = std::array::from_fn(|i| counting(sobol_2d(i as u32, seed), rays));
        let sum: Vec3 = even.iter().flatten().map(|(on, _)| weight(on)).sum();
        if sum == Vec3::ZERO {
            return Vec3::ZERO;
        }
        let mut room = if directional.is_some() { PointRoom::by_direction() } else { PointRoom::new() };
        let mut shadow = room.begin(scene);
        let lamps = || self.direct.near.within(near.reach2, near.of);
        let of_one = (PEAKED_OF_ALL / lamps().count().max(1) as u32).min(PEAKED);
        for (light, position) in lamps() {
            let mut push = |on: &TexelSample, receiver: &Receiver, scale: f64| {
                if let Some((target, light)) = point_light(light, receiver).filter(|&(at, _)| near.has(at, receiver)) {
                    shadow.normal = receiver.normal;
                    shadow.push_point(receiver, target, light * weight(on) * scale as f32);
                }
            };
            let peak = self.areas.peak(texel, position);
            // Of points of both kinds, by the sum of their densities.
            let scale = |on: &TexelSample| match &peak {
                Some(peak) => {
                    1.0 / (f64::from(EVEN) + f64::from(of_one) * peak.density(self.areas.place(texel, peak, on)))
                }
                None => 1.0 / f64::from(EVEN),
            };
            even.iter().flatten().for_each(|(on, receiver)| push(on, receiver, scale(on)));
            for place in peak.iter().flat_map(|peak| (0..of_one).map(|i| peak.place(sobol_2d(i, combine(seed, 1))))) {
                if let Some((on, receiver)) = counting(place, rays) {
                    push(&on, &receiver, scale(&on));
                }
            }
        }
        let (arrived, directed) = shadow.finish_by_direction(rays);
        // What has arrived is the mean over the texel's square, of which a part counts. (Albedos of 0 weigh next to nothing, and a
        // part of that may be nothing.)
        if let (Some(out), Some(&directed)) = (directional, directed.first()) {
            *out += directed * EVEN as f32 / sum.x;
        }
        arrived[0] * EVEN as f32 / sum
    }
}

impl<M: Map> TexelAreas<'_, M> {
    /// Returns the greater side of a texel in the scene.
    fn width(&self, texel: TexelId<M>) -> f32 {
        let [x, y] = self.placement(texel).scale;
        1.0 / x.min(y)
    }

    /// Returns the place of a triangle's point in a texel.
    fn in_texel(&self, texel: TexelId<M>, triangle: u32, u: f32, v: f32) -> DVec2 {
        let own = &self.map[texel];
        let [x, y] = self.placement(texel).texel_coord(self.charts.local(triangle, u, v));
        DVec2::new(f64::from(x) - f64::from(own.x), f64::from(y) - f64::from(own.y))
    }

    /// Returns where on a texel the light of a lamp falls; `None` if its triangle is too narrow to tell, or if it is far away.
    fn peak(&self, texel: TexelId<M>, lamp: Vec3) -> Option<Peak> {
        let own = &self.map[texel];
        let (object, triangle) = self.scene.locate(own.triangle);
        let [a, b, c] = self.scene.object(object).corners(triangle).map(|corner| corner.as_dvec3());
        let at = |u, v| self.in_texel(texel, own.triangle, u, v);
        let origin = at(0.0, 0.0);
        let axes = [at(1.0, 0.0) - origin, at(0.0, 1.0) - origin];
        let (edge_u, edge_v, to) = (b - a, c - a, lamp.as_dvec3() - a);
        let normal = edge_u.cross(edge_v);
        // Barycentric weights of the foot of the perpendicular from the lamp.
        let twice_area2 = normal.length_squared();
        let u = to.cross(edge_v).dot(normal) / twice_area2;
        let v = edge_u.cross(to).dot(normal) / twice_area2;
        let texels2 = axes[0].perp_dot(axes[1]).abs() / twice_area2.sqrt();
        let height = (to.dot(normal).abs() / twice_area2.sqrt() * texels2.sqrt()).max(LEAST_HEIGHT);
        let foot = origin + u * axes[0] + v * axes[1];
        // Chart maps may be stretched.
        let [x, y] = self.placement(texel).scale;
        let radius = 2.0 * f64::from(NEAR * x.max(y) / x.min(y));
        let is_known = foot.is_finite() && height.is_finite();
        is_known.then(|| Peak::new((own.triangle, origin, axes), foot, height, radius)).flatten()
    }

    /// Returns the place of a point in its texel: in the triangle by which the peak was found without the rounding of texel
    /// coordinates, which in wide pages may be more than a lamp's height.
    fn place(&self, texel: TexelId<M>, peak: &Peak, on: &TexelSample) -> DVec2 {
        let &(triangle, origin, [along_u, along_v]) = &peak.plane;
        match on.triangle == triangle {
            true => origin + f64::from(on.u) * along_u + f64::from(on.v) * along_v,
            false => self.in_texel(texel, on.triangle, on.u, on.v),
        }
    }
}

/// Density of points in the part of a texel that lies within a square around the foot of the perpendicular from a lamp to its plane,
/// in proportion to its irradiance there: uniform in the solid angle of a rectangle (Ureña, Fajardo and King, *An
/// Area-Preserving Parametrization for Spherical Rectangles*, 2013). Lengths are in texels.
struct Peak {
    /// Triangle in whose plane it lies, place of its corner 0, and its edges.
    plane: (u32, DVec2, [DVec2; 2]),
    foot: DVec2,
    height: f64,
    /// Corners of the rectangle, seen from the foot.
    lower: DVec2,
    upper: DVec2,
    solid_angle: f64,
    /// Sum of the angles at the rectangle's corners at its greater x, from which angles of parts of it are counted.
    rest: f64,
    /// Components along the lamp's height of the normals of the planes through the lamp and the sides along x.
    normals: [f64; 2],
}

impl Peak {
    /// Makes the density in a texel, up to a `radius` from the foot; `None` if the texel lies beyond it.
    fn new(plane: (u32, DVec2, [DVec2; 2]), foot: DVec2, height: f64, radius: f64) -> Option<Peak> {
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
        is_seen.then_some(Peak { plane, foot, height, lower, upper, solid_angle, rest, normals })
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
        // Rounded up to 1 it would be another texel's.
        [foot.x + x, foot.y + y].map(|at| (at as f32).clamp(0.0, 1.0 - f32::EPSILON))
    }

    /// Returns the density at a place, per area of a texel.
    fn density(&self, place: DVec2) -> f64 {
        let at = place - self.foot;
        let d2 = self.height * self.height + at.length_squared();
        let is_within = at.cmpge(self.lower - ROUNDING).all() && at.cmple(self.upper + ROUNDING).all();
        if is_within { self.height / (d2 * d2.sqrt() * self.solid_angle) } else { 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_have_the_density_that_is_told() {
        for (foot, height) in [([0.4, 0.6], 0.3), ([0.5, 0.03], 0.01), ([1.2, -0.3], 0.05), ([0.2, 1.7], 0.5)] {
            let peak = Peak::new((0, DVec2::ZERO, [DVec2::X, DVec2::Y]), DVec2::from(foot), height, 2.0).unwrap();
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
                    let at = |cell: usize, i: usize| ((cell * FINE + i) as f64 + 0.5) * width;
                    *expected += peak.density(DVec2::new(at(cell % CELLS, i % FINE), at(cell / CELLS, i / FINE)))
                        * width
                        * width;
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
