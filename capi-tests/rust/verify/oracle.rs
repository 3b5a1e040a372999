//! Scalar f64 answers to rays by brute force over all triangles, and the judgement of f32 answers.
//! Shares no code with the kernels.
//!
//! Corners and directions are f32, so f64 sees the exact scene. What an f32 kernel may get wrong is
//! bounded by counting its roundings (u = ε/2, per operation, relative):
//!
//! - **Edge functions.** With corners a, b relative to the origin, e = b − a and s = b + a, the
//!   kernels form d · (e × s) = 2 d · (e × a). The sum and the difference are rounded once each, the
//!   cross product twice, the dot product three times: 7u |d|·(|e| ⊗ |s|), where the cross product of
//!   absolute values is at most 2/√3 · |e||s|. The subtraction of the origin moves corners by u|v|,
//!   which near the edge counts for 2u |d||e||v|. With |s| ≤ |a| + |b|: less than 5.1 ε |d||e|(|a| + |b|),
//!   or [`EDGE_ULPS`] = 3 for half of it. A ray for which an edge function is smaller *grazes* the edge.
//! - **t.** The same count for n · v / n · d on a triangle with no angle near 0 or 180° gives
//!   [`PLANE_ULPS`] = 9 ε |v| of displacement of the plane, hence 9 ε |v| / cos θ along the ray.
//!   Triangles of any shape are held to this or to 1e-5 of t, whichever is more.

use bakelite::scene::{MAX_COORDINATE, NONE};
use bakelite::trace::{Hit, Ray};
use glam::{DVec3, Vec3};

pub type Triangle = [Vec3; 3];

const EPSILON: f64 = f32::EPSILON as f64;
const EDGE_ULPS: f64 = 3.0;
const PLANE_ULPS: f64 = 9.0;
const RELATIVE_T: f64 = 1e-5;

/// What can be wrong with an answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Fault {
    /// Another triangle or a miss, other barycentrics, an end of the interval passed over.
    Wrong,
    /// The right triangle at a t that is not accurate.
    InaccurateT,
    /// A hit of a triangle in whose plane the ray lies, at a point off the triangle.
    OffTriangle,
    /// Not the lowest number among exact copies of a triangle.
    NotLowest,
}

/// A triangle that the ray hits or may be held to hit.
#[derive(Clone, Copy, Debug)]
struct Candidate {
    triangle: usize,
    t: f64,
    t_error: f64,
    /// Weights of corners 1 and 2, with their error.
    uv: [f64; 2],
    uv_error: [f64; 2],
    /// Which of the edges opposite corners 0, 1, 2 the ray grazes.
    grazed: [bool; 3],
    /// The ray lies in the triangle's plane as far as f32 can tell.
    edge_on: bool,
    /// In the ray's interval up to the error of t.
    within: bool,
    /// Not near an end of it.
    well_within: bool,
}

impl Candidate {
    fn is_certain(&self) -> bool {
        self.grazed == [false; 3] && !self.edge_on && self.well_within
    }
}

fn finite(v: [f32; 3]) -> bool {
    v.iter().all(|x| x.is_finite())
}

/// Whether a ray can hit anything at all, by the documentation of [`Ray`].
fn is_usable(ray: &Ray) -> bool {
    let numbers = !ray.tmin.is_nan() && !ray.tmax.is_nan();
    numbers && finite(ray.origin) && finite(ray.direction) && ray.direction != [0.0; 3]
}

pub fn is_in_range(triangle: &Triangle) -> bool {
    triangle.iter().all(|v| v.abs().max_element() <= MAX_COORDINATE && v.is_finite())
}

fn candidate(ray: &Ray, number: usize, corners: &Triangle) -> Option<Candidate> {
    let d = Vec3::from(ray.direction).as_dvec3();
    let origin = Vec3::from(ray.origin).as_dvec3();
    let corner = corners.map(|c| c.as_dvec3());
    let relative = corner.map(|c| c - origin);
    // Edge k is opposite corner k; differences of f32 values are exact unless exponents differ much.
    let edge = |k: usize| (corner[(k + 1) % 3], corner[(k + 2) % 3]);
    let function = |k: usize| d.dot((edge(k).1 - edge(k).0).cross(relative[(k + 1) % 3]));
    let tolerance = |k: usize| {
        let ends = relative[(k + 1) % 3].length() + relative[(k + 2) % 3].length();
        EDGE_ULPS * EPSILON * d.length() * (edge(k).1 - edge(k).0).length() * ends
    };
    let w = [function(0), function(1), function(2)];
    let (least, most) = (w[0].min(w[1]).min(w[2]), w[0].max(w[1]).max(w[2]));
    // The cheap way out for nearly all triangles.
    if least < 0.0 && most > 0.0 {
        let outside = |sign: f64| (0..3).any(|k| w[k] * sign < -tolerance(k));
        if outside(1.0) && outside(-1.0) {
            return None;
        }
    }
    if !is_in_range(corners) {
        return None;
    }
    let normal = (corner[1] - corner[0]).cross(corner[2] - corner[0]);
    let slope = normal.dot(d);
    if normal.length_squared() == 0.0 {
        return None;
    }
    let tolerances = [tolerance(0), tolerance(1), tolerance(2)];
    let sum = w[0] + w[1] + w[2];
    let farthest = relative.iter().fold(0.0, |m: f64, v| m.max(v.length()));
    let longest = (0..3).fold(0.0, |m: f64, k| m.max((edge(k).1 - edge(k).0).length()));
    let t = normal.dot(relative[0]) / slope;
    let t_error = (PLANE_ULPS * EPSILON * farthest * normal.length() / slope.abs() + EPSILON * t.abs())
        .max(RELATIVE_T * t.abs())
        // Denormal results are rounded in absolute terms.
        .max(f32::from_bits(1) as f64);
    let edge_on = !(slope != 0.0 && t_error * d.length() < longest.max(2.0 * RELATIVE_T * farthest));
    let (tmin, tmax) = (ray.tmin as f64, ray.tmax as f64);
    // Where the sum is lost in the errors of its terms, so are the weights.
    let total: f64 = tolerances.iter().sum();
    let certain_sum = (sum.abs() - total).max(0.0);
    let error = |k: usize| (tolerances[k] + total * (w[k] / sum).abs()) / certain_sum + 2.0 * EPSILON;
    Some(Candidate {
        triangle: number,
        t,
        t_error,
        uv: [w[1] / sum, w[2] / sum],
        uv_error: [error(1), error(2)],
        grazed: std::array::from_fn(|k| w[k].abs() <= tolerances[k]),
        edge_on,
        within: edge_on || (t + t_error > tmin && t - t_error <= tmax),
        well_within: t - t_error > tmin && t + t_error < tmax,
    })
}

/// What f64 knows about one ray.
pub struct Truth<'a> {
    ray: Ray,
    triangles: &'a [Triangle],
    candidates: Vec<Candidate>,
    /// Something is surely hit no farther than this: t, its error included, and the triangle.
    limit: Option<(f64, usize)>,
}

impl<'a> Truth<'a> {
    pub fn new(ray: &Ray, triangles: &'a [Triangle]) -> Self {
        let mut candidates = Vec::new();
        if is_usable(ray) && ray.tmin < ray.tmax {
            candidates.extend(triangles.iter().enumerate().filter_map(|(i, c)| candidate(ray, i, c)));
        }
        let mut limit: Option<(f64, usize)> = None;
        let mut sure = |t: f64, triangle: usize| {
            if limit.is_none_or(|(nearest, _)| t < nearest) {
                limit = Some((t, triangle));
            }
        };
        for (i, a) in candidates.iter().enumerate() {
            if a.is_certain() {
                sure(a.t + a.t_error, a.triangle);
            }
            for b in &candidates[..i] {
                if is_blocked_by_both(ray, triangles, a, b) {
                    sure((a.t + a.t_error).max(b.t + b.t_error), a.triangle);
                }
            }
        }
        Truth { ray: *ray, triangles, candidates, limit }
    }

    /// Whether something is hit for certain.
    pub fn surely_hits(&self) -> bool {
        self.limit.is_some()
    }

    /// What is wrong with a closest hit, if anything.
    pub fn judge(&self, hit: &Hit) -> Result<(), (Fault, String)> {
        let wrong = |what: String| Err((Fault::Wrong, what));
        if hit.triangle == NONE {
            return match self.limit {
                _ if *hit != Hit::MISS => wrong(format!("a miss that is not Hit::MISS: {hit:?}")),
                Some((t, triangle)) => wrong(format!("misses {} with t ≤ {t:e}", self.describe(triangle))),
                None => Ok(()),
            };
        }
        let number = hit.triangle as usize;
        let Some(c) = self.candidates.iter().find(|c| c.triangle == number) else {
            return wrong(format!("{hit:?}, but the ray does not meet {}", self.describe(number)));
        };
        if !(hit.t > self.ray.tmin && hit.t <= self.ray.tmax) || (hit.mesh, hit.instance) != (0, NONE) {
            return wrong(format!("{hit:?} outside the interval or of no mesh"));
        }
        let weights = [hit.u, hit.v, 1.0 - hit.u - hit.v];
        if !weights.iter().all(|&w| (-2.0 * f32::EPSILON..=1.0).contains(&w)) {
            return wrong(format!("{hit:?}: barycentrics outside the triangle"));
        }
        if !c.within {
            let what = format!("{hit:?}, but t is {:e} ± {:e}: outside the interval", c.t, c.t_error);
            return Err((if (hit.t as f64 - c.t).abs() > c.t_error { Fault::InaccurateT } else { Fault::Wrong }, what));
        }
        let t = if c.edge_on { hit.t as f64 } else { c.t };
        if let Some((limit, nearer)) = self.limit
            && t - RELATIVE_T * t.abs() > limit
        {
            return wrong(format!("{hit:?} lies behind {} with t ≤ {limit:e}", self.describe(nearer)));
        }
        if c.edge_on {
            return self.judge_edge_on(hit);
        }
        for (got, k) in [(hit.u, 0), (hit.v, 1)] {
            if (got as f64 - c.uv[k]).abs() > c.uv_error[k] {
                let (uv, error) = (c.uv, c.uv_error);
                return wrong(format!("{hit:?}, but u, v are {uv:?} ± {error:?} on {}", self.describe(number)));
            }
        }
        // The second: where f32 overflows.
        if (hit.t as f64 - c.t).abs() <= c.t_error || hit.t == c.t as f32 {
            Ok(())
        } else {
            let what = format!("{hit:?}, but t is {:e} ± {:e} on {}", c.t, c.t_error, self.describe(number));
            Err((Fault::InaccurateT, what))
        }
    }

    /// A hit of a ray in the triangle's plane: its t is poorly determined, but the point must lie in
    /// the triangle's box up to the displacement that is allowed.
    fn judge_edge_on(&self, hit: &Hit) -> Result<(), (Fault, String)> {
        let corners = self.triangles[hit.triangle as usize].map(|c| c.as_dvec3());
        let origin = Vec3::from(self.ray.origin).as_dvec3();
        let point = origin + hit.t as f64 * Vec3::from(self.ray.direction).as_dvec3();
        let farthest = corners.iter().fold(0.0, |m: f64, c| m.max((*c - origin).length()));
        let slack = DVec3::splat(RELATIVE_T * farthest);
        let (lower, upper) = (corners[0].min(corners[1]).min(corners[2]), corners[0].max(corners[1]).max(corners[2]));
        if point.cmpge(lower - slack).all() && point.cmple(upper + slack).all() {
            Ok(())
        } else {
            let triangle = self.describe(hit.triangle as usize);
            Err((Fault::OffTriangle, format!("{hit:?}: {point} is not on {triangle}")))
        }
    }

    fn describe(&self, triangle: usize) -> String {
        format!("triangle {triangle} {:?}", self.triangles[triangle].map(|v| v.to_array()))
    }
}

/// Whether two triangles that share the one edge that the ray grazes cover it from both sides: one
/// of them must be hit, whichever.
fn is_blocked_by_both(ray: &Ray, triangles: &[Triangle], a: &Candidate, b: &Candidate) -> bool {
    let one_edge = |c: &Candidate| {
        let plain = !c.edge_on && c.well_within && c.grazed.iter().filter(|&&g| g).count() == 1;
        plain.then(|| c.grazed.iter().position(|&g| g)).flatten()
    };
    let (Some(i), Some(j)) = (one_edge(a), one_edge(b)) else { return false };
    let (p, q) = (triangles[a.triangle], triangles[b.triangle]);
    let ends = |t: &Triangle, k: usize| [t[(k + 1) % 3], t[(k + 2) % 3]];
    let ([p0, p1], [q0, q1]) = (ends(&p, i), ends(&q, j));
    if !((p0 == q0 && p1 == q1) || (p0 == q1 && p1 == q0)) {
        return false;
    }
    let side = |third: Vec3| {
        let (edge, to) = ((p1 - p0).as_dvec3(), (third - p0).as_dvec3());
        Vec3::from(ray.direction).as_dvec3().dot(edge.cross(to))
    };
    side(p[i]) * side(q[j]) < 0.0
}
