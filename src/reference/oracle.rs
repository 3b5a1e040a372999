//! Judges f32 answers to a ray: is a disagreement a mistake, or are both answers defensible?
//!
//! A kernel in f32 works on positions relative to the ray's origin, which it knows to a few units
//! in the last place of their length. This error is the tolerance: an edge that the ray passes within it
//! may count as hit or missed, and two hits nearer to each other than their errors along the ray
//! may come in either order.

use super::geometry::{Edges, Geometry, Ray64, Triangle};
use crate::scene::NONE;
use crate::trace::{RawHit, Ray};
use glam::DVec3;
use std::f64::consts::TAU;

/// Position error that an f32 answer may have, relative to the distance of the triangle's farthest
/// corner from the ray's origin: 8 units in the last place (a subtraction, a cross and a dot product).
const POSITION_ERROR: f64 = 8.0 * f32::EPSILON as f64;

/// Displaced rays that are tried before an answer is called wrong.
const RING: u32 = 16;

/// A triangle that the ray hits or nearly hits.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Candidate {
    /// Distance at which the ray crosses the triangle's plane.
    pub t: f64,
    /// Weight of corner 1; outside [0, 1] where the ray passes beside the triangle.
    pub u: f64,
    /// Weight of corner 2.
    pub v: f64,
    /// Global triangle number.
    pub triangle: u32,
    /// Distance of the ray from the nearest edge (line to line), negative outside the triangle.
    pub clearance: f64,
    /// Position error allowed to an f32 answer, to compare `clearance` with.
    pub tolerance: f64,
    /// The same along the ray, in units of t: larger, the more the ray grazes the triangle.
    pub t_error: f64,
}

/// Verdict on one answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// The closest hit, or rightly a miss.
    Right,
    /// Coincident or grazing: as good as the f64 answer within f32's accuracy.
    Defensible,
    /// The ray went through a triangle, or the triangle is one that it does not hit, or t is wrong.
    Wrong,
}

/// Result of comparing two answers to one ray.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Agreement {
    /// Both miss, or both hit the same triangle at the same t up to f32's accuracy.
    Same,
    /// They differ, and both are defensible.
    CoincidentOrGrazing,
    /// They differ, and at least one is wrong.
    Real,
}

impl Geometry {
    /// All triangles that the ray hits, or passes within f32's accuracy of, by t.
    pub fn candidates(&self, ray: &Ray64) -> Vec<Candidate> {
        let (lower, upper) = self.bounds();
        let reach = (lower - ray.origin).abs().max((upper - ray.origin).abs()).length();
        let open = Ray64 { tmin: f64::NEG_INFINITY, tmax: f64::INFINITY, ..*ray };
        let mut found = Vec::new();
        self.traverse(&open, POSITION_ERROR * reach, |triangle, limit| {
            found.extend(candidate(triangle, ray));
            limit
        });
        found.sort_by(|a, b| a.t.total_cmp(&b.t).then(a.triangle.cmp(&b.triangle)));
        found
    }

    /// Judges an f32 answer to a ray.
    pub fn judge(&self, ray: &Ray, answer: &RawHit) -> Verdict {
        let ray = Ray64::from(ray);
        let exact = self.closest(&ray).map_or(NONE, |h| h.triangle);
        let candidates = self.candidates(&ray);
        let mine = candidates.iter().find(|c| c.triangle == answer.triangle);
        let reached = match mine {
            Some(c) if (answer.t as f64 - c.t).abs() <= c.t_error => c.t - c.t_error,
            None if answer.is_miss() => f64::INFINITY,
            _ => return Verdict::Wrong,
        };
        if exact == answer.triangle {
            Verdict::Right
        } else if self.is_blocked(&ray, &candidates, reached) {
            Verdict::Wrong
        } else {
            Verdict::Defensible
        }
    }

    /// Whether not even a ray displaced by f32's accuracy gets as far as `reached`. (Looking at one
    /// triangle at a time would excuse a ray that slips through the edge between two.)
    fn is_blocked(&self, ray: &Ray64, candidates: &[Candidate], reached: f64) -> bool {
        let tolerance = candidates.iter().map(|c| c.tolerance).fold(0.0, f64::max);
        let (x, y) = ray.direction.normalize().any_orthonormal_pair();
        let blocks = |ray: &Ray64, c: &Candidate| {
            let within = c.t - c.t_error > ray.tmin && c.t + c.t_error < ray.tmax.min(reached);
            c.clearance >= 0.0 && within
        };
        (0..RING).all(|i| {
            let (sin, cos) = (TAU * i as f64 / RING as f64).sin_cos();
            let displaced = Ray64 { origin: ray.origin + (x * cos + y * sin) * tolerance, ..*ray };
            self.candidates(&displaced).iter().any(|c| blocks(&displaced, c))
        })
    }

    /// Compares two f32 answers to a ray.
    pub fn compare(&self, ray: &Ray, a: &RawHit, b: &RawHit) -> Agreement {
        let same_t = || {
            let candidates = self.candidates(&Ray64::from(ray));
            let error = candidates.iter().find(|c| c.triangle == a.triangle).map_or(0.0, |c| c.t_error);
            (a.t as f64 - b.t as f64).abs() <= 2.0 * error
        };
        if a.triangle == b.triangle && (a.is_miss() || same_t()) {
            Agreement::Same
        } else if [a, b].iter().all(|h| self.judge(ray, h) != Verdict::Wrong) {
            Agreement::CoincidentOrGrazing
        } else {
            Agreement::Real
        }
    }
}

/// A triangle with what a verdict needs, if the ray hits it or nearly does. The ends of the ray are
/// not looked at, except that a triangle well beyond them is none.
fn candidate(triangle: &Triangle, ray: &Ray64) -> Option<Candidate> {
    let Edges { corners, weights } = triangle.edges(ray);
    let [a, b, c] = corners;
    let normal = (b - a).cross(c - a);
    let slope = normal.dot(ray.direction);
    let sum: f64 = weights.iter().sum();
    let tolerance = POSITION_ERROR * corners.iter().fold(0.0, |m: f64, c| m.max(c.length()));
    // Edge-on: whatever is hit there is another triangle's business.
    if slope == 0.0 || sum == 0.0 {
        return None;
    }
    let clearance = (0..3)
        .map(|i| line_distance(weights[i] * sum.signum(), ray.direction, corners[(i + 2) % 3] - corners[(i + 1) % 3]))
        .fold(f64::INFINITY, f64::min);
    let t = normal.dot(a) / slope;
    let t_error = tolerance * normal.length() / slope.abs() + 4.0 * f32::EPSILON as f64 * t.abs();
    let near_ray = t + t_error > ray.tmin && t - t_error <= ray.tmax;
    (clearance >= -tolerance && near_ray).then_some(Candidate {
        t,
        u: weights[1] / sum,
        v: weights[2] / sum,
        triangle: triangle.number,
        clearance,
        tolerance,
        t_error,
    })
}

/// Distance of the ray's line from an edge's line, given the edge function d · (p × q): 0 if they
/// are parallel and f64 cannot tell.
fn line_distance(edge_function: f64, direction: DVec3, edge: DVec3) -> f64 {
    let common = direction.cross(edge).length();
    if common > 0.0 { edge_function / common } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::super::Random;
    use super::*;
    use crate::scene::demo::shapes::MeshBuilder;
    use glam::Vec3;

    /// Two stacked squares at z = 0 (triangles 0 and 1) and z = 1 (2 and 3), seen from above.
    fn stacked(z: f32) -> Geometry {
        let mut builder = MeshBuilder::new();
        for z in [0.0, z] {
            let p = |x, y| Vec3::new(x, y, z);
            builder.quad(p(0.0, 0.0), p(1.0, 0.0), p(1.0, 1.0), p(0.0, 1.0), 0);
        }
        Geometry::new(&[builder.finish()])
    }

    fn down(x: f32, y: f32) -> Ray {
        Ray::new(Vec3::new(x, y, 5.0), Vec3::NEG_Z)
    }

    fn answer(t: f32, triangle: u32) -> RawHit {
        RawHit { t, triangle, ..RawHit::MISS }
    }

    #[test]
    fn the_closest_hit_is_right_and_what_lies_behind_it_is_wrong() {
        let g = stacked(1.0);
        let ray = down(0.7, 0.2);
        assert_eq!(g.judge(&ray, &answer(4.0, 2)), Verdict::Right);
        assert_eq!(g.judge(&ray, &answer(5.0, 0)), Verdict::Wrong);
        assert_eq!(g.judge(&ray, &answer(4.01, 2)), Verdict::Wrong);
        assert_eq!(g.judge(&ray, &answer(4.0, 3)), Verdict::Wrong);
        assert_eq!(g.judge(&ray, &RawHit::MISS), Verdict::Wrong);
        assert_eq!(g.compare(&ray, &answer(4.0, 2), &answer(5.0, 0)), Agreement::Real);
        assert_eq!(g.compare(&ray, &answer(4.0, 2), &answer(4.0000005, 2)), Agreement::Same);
        assert_eq!(g.compare(&ray, &answer(4.0, 2), &answer(4.001, 2)), Agreement::Real);
    }

    #[test]
    fn either_triangle_of_an_edge_will_do_but_nothing_behind_them() {
        let g = stacked(1.0);
        let ray = down(0.5, 0.5);
        assert_eq!(g.compare(&ray, &answer(4.0, 2), &answer(4.0, 3)), Agreement::CoincidentOrGrazing);
        assert_eq!(g.judge(&ray, &answer(5.0, 0)), Verdict::Wrong, "slipped through the edge");
        assert_eq!(g.judge(&ray, &RawHit::MISS), Verdict::Wrong);
        assert_eq!(g.candidates(&Ray64::from(&ray)).len(), 4);
    }

    #[test]
    fn either_of_two_coincident_surfaces_will_do() {
        let g = stacked(0.0);
        let ray = down(0.7, 0.2);
        assert_eq!(g.judge(&ray, &answer(5.0, 0)), Verdict::Right);
        assert_eq!(g.judge(&ray, &answer(5.0, 2)), Verdict::Defensible);
        assert_eq!(g.compare(&ray, &answer(5.0, 0), &answer(5.0, 2)), Agreement::CoincidentOrGrazing);
    }

    #[test]
    fn a_ray_along_the_border_may_hit_or_miss_and_one_beside_it_must_miss() {
        let g = stacked(1.0);
        let (border, beside) = (down(1.0, 0.3), down(1.00001, 0.3));
        assert_eq!(g.compare(&border, &answer(4.0, 2), &RawHit::MISS), Agreement::CoincidentOrGrazing);
        assert_eq!(g.compare(&beside, &answer(4.0, 2), &RawHit::MISS), Agreement::Real);
        assert_eq!(g.judge(&beside, &RawHit::MISS), Verdict::Right);
        assert_eq!(RawHit::MISS.triangle, NONE);
    }

    #[test]
    fn the_ends_of_a_ray_are_judged_too() {
        let g = stacked(1.0);
        let short = down(0.7, 0.2).within(0.0, 3.9);
        assert_eq!(g.judge(&short, &RawHit::MISS), Verdict::Right);
        assert_eq!(g.judge(&short, &answer(4.0, 2)), Verdict::Wrong);
        let late = down(0.7, 0.2).within(4.5, f32::INFINITY);
        assert_eq!(g.judge(&late, &answer(5.0, 0)), Verdict::Right);
        assert_eq!(g.judge(&late, &answer(4.0, 2)), Verdict::Wrong);
    }

    #[test]
    fn rounding_the_exact_answer_to_f32_is_always_right() {
        let mut builder = MeshBuilder::new();
        builder.sphere(Vec3::new(50.0, -20.0, 3.0), 1.0, 3, 0);
        let g = Geometry::new(&[builder.finish()]);
        let mut random = Random::new(8, 0);
        for _ in 0..2000 {
            let origin = (DVec3::new(50.0, -20.0, 3.0) + random.direction() * 3.0).as_vec3();
            let ray = Ray::new(origin, random.direction().as_vec3());
            let rounded = g.closest(&Ray64::from(&ray)).map_or(RawHit::MISS, |h| answer(h.t as f32, h.triangle));
            assert_eq!(g.judge(&ray, &rounded), Verdict::Right);
        }
    }
}
