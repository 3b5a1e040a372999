//! The least squares problem of the seams and its solution by conjugate gradients (Hestenes and Stiefel 1952).

use crate::base::error::Result;
use crate::base::memory::{try_filled, try_par_collect, try_to_vec, try_vec};
use crate::base::parallel::ParallelLoop;
use crate::base::progress::Stage;
use glam::{DVec3, Vec3A};
use rayon::prelude::*;
use std::ops::Range;

/// Penalty λ for changing a texel. Much less than the weight of a texel in the points around it (about 1/2), so that
/// both sides agree, and large enough to keep texels that have hardly any weight.
pub(super) const STIFFNESS: f32 = 0.01;

/// Relative length of the gradient, compared with the start, at which the iteration ends.
const TOLERANCE: f64 = 1e-4;

/// Maximum number of iterations, far more than are needed.
const MAX_ITERATIONS: usize = 200;

/// Number of elements that a thread processes at a time.
pub(super) const CHUNK: usize = 1 << 12;

/// Name of the buffers in error messages.
pub(super) const POINTS: &str = "the seams' points";

/// A point of an edge, with the texels that each side interpolates there.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Point {
    /// Texels of the one side, then of the other.
    pub(super) texels: [u32; 8],
    /// Interpolation weights, which sum to 1 on the one side and to −1 on the other.
    pub(super) weights: [f32; 8],
    /// Length of the part of the edge around the point, in texels.
    pub(super) length: f32,
}

impl Point {
    /// Makes one of this point and another one between the same texels.
    pub(super) fn join(&mut self, other: &Point) {
        let length = self.length + other.length;
        if length > 0.0 {
            let part = other.length / length;
            self.weights = std::array::from_fn(|k| self.weights[k] + part * (other.weights[k] - self.weights[k]));
        }
        self.length = length;
    }
}

/// The least squares problem: row i of J has the weights of texels at point i, times the square root of the point's
/// length.
pub(super) struct System {
    pub(super) points: Vec<Point>,
    /// Index of the first use of each texel; the last element is the number of uses.
    first_use: Vec<usize>,
    /// Points that use a texel, each with the texel's weight there times the point's length.
    uses: Vec<(u32, f32)>,
}

impl System {
    pub(super) fn new(points: Vec<Point>, texels: usize, stage: &Stage) -> Result<System> {
        let used = |part: usize| {
            let of_part = (part * CHUNK..points.len().min((part + 1) * CHUNK)).map(|i| (i, &points[i]));
            let all = of_part.flat_map(|(i, p)| (0..8).map(move |k| (i as u32, p.texels[k], p.weights[k] * p.length)));
            all.filter(|u| u.2 != 0.0)
        };
        let parts = 0..points.len().div_ceil(CHUNK);
        let mut first_use: Vec<usize> = try_vec(texels + 1, POINTS)?;
        for part in parts.clone() {
            stage.check()?;
            used(part).for_each(|(_, t, _)| first_use[t as usize + 1] += 1);
        }
        (0..texels).for_each(|t| first_use[t + 1] += first_use[t]);
        let mut uses: Vec<(u32, f32)> = try_vec(first_use[texels], POINTS)?;
        let mut next = try_to_vec(&first_use, POINTS)?;
        for part in parts {
            stage.check()?;
            for (i, t, w) in used(part) {
                uses[next[t as usize]] = (i, w);
                next[t as usize] += 1;
            }
        }
        Ok(System { points, first_use, uses })
    }

    /// Computes A − B at every point.
    pub(super) fn differences(&self, x: &[Vec3A], out: &mut [Vec3A]) {
        let show = |p: &Point| (0..8).fold(Vec3A::ZERO, |sum, k| sum + p.weights[k] * x[p.texels[k] as usize]);
        out.par_iter_mut().zip(&self.points).with_min_len(CHUNK).each(|(d, p)| *d = show(p));
    }

    /// Computes JᵀJ x from the differences of x. (Sums are in the order of points, on any number of threads.)
    pub(super) fn pull(&self, differences: &[Vec3A], out: &mut [Vec3A]) {
        out.par_iter_mut().enumerate().with_min_len(CHUNK).each(|(t, out)| {
            let uses = &self.uses[self.first_use[t]..self.first_use[t + 1]];
            *out = uses.iter().fold(Vec3A::ZERO, |sum, &(p, w)| sum + w * differences[p as usize]);
        });
    }

    /// Solves by conjugate gradients, starting at `before`, for each channel separately. Values are at `least` what is
    /// given.
    pub(super) fn solve(&self, before: &[Vec3A], x: &mut [Vec3A], least: f32, stage: &Stage) -> Result<()> {
        let mut differences = try_filled(self.points.len(), Vec3A::ZERO, POINTS)?;
        let mut q = try_filled(before.len(), Vec3A::ZERO, POINTS)?;
        self.differences(before, &mut differences);
        self.pull(&differences, &mut q);
        let mut r = try_par_collect(q.par_iter().map(|&v| -v), POINTS)?;
        let mut p = try_to_vec(&r, POINTS)?;
        x.copy_from_slice(before);
        let mut rr = dot(&r, &r);
        let enough = rr * TOLERANCE * TOLERANCE;
        for _ in 0..MAX_ITERATIONS {
            stage.advance(0)?;
            if rr.cmple(enough).all() {
                break;
            }
            self.differences(&p, &mut differences);
            self.pull(&differences, &mut q);
            q.par_iter_mut().zip(&p).with_min_len(CHUNK).each(|(q, &p)| *q += STIFFNESS * p);
            let step = ratio(rr, dot(&p, &q));
            x.par_iter_mut().zip(&p).with_min_len(CHUNK).each(|(x, &p)| *x += step * p);
            r.par_iter_mut().zip(&q).with_min_len(CHUNK).each(|(r, &q)| *r -= step * q);
            let next = dot(&r, &r);
            let keep = ratio(next, rr);
            p.par_iter_mut().zip(&r).with_min_len(CHUNK).each(|(p, &r)| *p = r + keep * *p);
            rr = next;
        }
        for (x, &before) in x.iter_mut().zip(before) {
            *x = if x.is_finite() { x.max(Vec3A::splat(least)) } else { before };
        }
        Ok(())
    }

    /// Returns the root mean square of A − B over lengths and channels, relative to the mean light; 0 if there is no
    /// light.
    pub(super) fn relative_rms(&self, x: &[Vec3A]) -> f64 {
        let (mut squares, mut sum, mut total) = (DVec3::ZERO, DVec3::ZERO, 0.0);
        for p in &self.points {
            let length = p.length as f64;
            let [a, b] = [0..4, 4..8].map(|side: Range<usize>| {
                side.fold(DVec3::ZERO, |s, k| s + (p.weights[k].abs() * x[p.texels[k] as usize]).as_dvec3())
            });
            squares += length * (a - b) * (a - b);
            sum += length * 0.5 * (a + b);
            total += length;
        }
        let mean = sum.element_sum() / 3.0 / total;
        if mean > 0.0 { (squares.element_sum() / 3.0 / total).sqrt() / mean } else { 0.0 }
    }
}

/// Dot product per channel, in f64 and in a fixed order.
fn dot(a: &[Vec3A], b: &[Vec3A]) -> DVec3 {
    let part = |(a, b): (&[Vec3A], &[Vec3A])| {
        a.iter().zip(b).fold(DVec3::ZERO, |sum, (a, b)| sum + a.as_dvec3() * b.as_dvec3())
    };
    let parts: Vec<DVec3> = a.par_chunks(CHUNK).zip(b.par_chunks(CHUNK)).map(part).collected();
    parts.into_iter().sum()
}

/// Quotient per channel; 0 for a channel that has converged.
fn ratio(a: DVec3, b: DVec3) -> Vec3A {
    let q = a / b;
    DVec3::select(b.cmpgt(DVec3::ZERO), q, DVec3::ZERO).as_vec3a()
}
