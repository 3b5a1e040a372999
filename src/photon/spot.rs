//! Spot lights: their power, and directions in proportion to their falloff.
//!
//! [`Light::spot_falloff`](crate::scene::Light::spot_falloff) is 1 inside the inner cone and the
//! smoothstep x²(3 − 2x) of the cosine between the cones. Solid angle is uniform in the cosine, so
//! both the integral and the cumulative distribution are polynomials: ∫₀ˣ = x³ − x⁴/2.

use std::f64::consts::TAU;

/// The falloff as a distribution over 1 − cos θ.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct SpotProfile {
    /// 1 − cos of the inner half-angle.
    inner: f64,
    /// cos(inner) − cos(outer).
    penumbra: f64,
}

impl SpotProfile {
    /// Makes the profile from the half-angles in radians, 0 ≤ `inner` ≤ `outer` ≤ π.
    pub(super) fn new(inner: f32, outer: f32) -> Self {
        // 1 − cos a = 2 sin²(a/2), without cancellation for narrow cones.
        let height = |a: f32| 2.0 * (0.5 * a as f64).sin().powi(2);
        SpotProfile { inner: height(inner), penumbra: height(outer) - height(inner) }
    }

    /// Integral of the falloff over the sphere: power per radiant intensity on the axis.
    pub(super) fn solid_angle(&self) -> f64 {
        TAU * (self.inner + 0.5 * self.penumbra)
    }

    /// The value of 1 − cos θ below which the fraction `u` of the light is emitted.
    pub(super) fn height(&self, u: f64) -> f64 {
        let a = u * (self.inner + 0.5 * self.penumbra);
        if a <= self.inner {
            return a;
        }
        // x falls from 1 at the inner cone to 0 at the outer; x³ − x⁴/2 of the light lies beyond.
        let beyond = 0.5 - (a - self.inner) / self.penumbra;
        let (mut low, mut high) = (0.0, 1.0);
        for _ in 0..30 {
            let x: f64 = 0.5 * (low + high);
            if x * x * x * (1.0 - 0.5 * x) < beyond { low = x } else { high = x }
        }
        self.inner + (1.0 - 0.5 * (low + high)) * self.penumbra
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Light;

    const CONES: [(f32, f32); 6] = [(0.0, 0.3), (0.2, 0.5), (0.5, 0.5), (0.4, 2.0), (0.0, 3.1415925), (1.5, 3.0)];

    /// Integral of the falloff from the axis to 1 − cos θ = `height`, by the midpoint rule.
    fn integral(inner: f32, outer: f32, height: f64) -> f64 {
        let n = 200_000;
        let falloff = |i: i32| Light::spot_falloff((1.0 - (i as f64 + 0.5) / n as f64 * height) as f32, inner, outer);
        (0..n).map(|i| falloff(i) as f64).sum::<f64>() * TAU * height / n as f64
    }

    #[test]
    fn the_power_is_the_integral_of_the_falloff() {
        for (inner, outer) in CONES {
            let (exact, numeric) = (SpotProfile::new(inner, outer).solid_angle(), integral(inner, outer, 2.0));
            assert!((exact / numeric - 1.0).abs() < 1e-4, "{inner} {outer}: {exact} {numeric}");
        }
    }

    #[test]
    fn heights_are_quantiles_of_the_falloff() {
        for (inner, outer) in CONES {
            let profile = SpotProfile::new(inner, outer);
            for u in [0.01, 0.3, 0.5, 0.7, 0.9, 0.999] {
                let fraction = integral(inner, outer, profile.height(u)) / profile.solid_angle();
                assert!((fraction - u).abs() < 1e-4, "{inner} {outer}: {fraction} for {u}");
            }
        }
    }
}
