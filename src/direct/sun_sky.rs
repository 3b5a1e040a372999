//! Direct light of discs and skies infinitely far away.
//!
//! A disc (the sun) is a ratio estimate as area lights are: its unoccluded irradiance, exact even where the horizon
//! cuts it (the form factor of a sphere as seen from its tangent cone; Howell, *A Catalog of Radiation Heat Transfer
//! Configuration Factors*, B-42), times the visible fraction of directions uniform in it. A constant sky is sampled by
//! cosine, so without occluders it has no noise. A sky with an image is sampled half by importance, half by cosine, and
//! both halves are weighted by the density of the mixture (Veach 1997, section 9.2.2). Where a [guide](super::guide) says
//! from which directions sky comes, what is sampled by cosine follows it. Gather rays that leave the scene
//! contribute nothing: skies are direct light, and would count twice.

use super::guide::{frame, square_of};
use super::receiver::Receiver;
use super::shadow_rays::ShadowRays;
use crate::base::sampling::{combine, cosine_hemisphere, orthonormal_basis, sobol_2d};
use crate::scene::Sky;
use crate::trace::Ray;
use glam::Vec3;
use std::f32::consts::PI;
use std::f64::consts;

/// A light of uniform radiance around a direction.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Disc {
    /// Unit vector to its middle.
    pub to_light: Vec3,
    /// Irradiance on a plane that faces the disc.
    pub irradiance: Vec3,
    /// Angular radius in radians, greater than 0, at most π/2.
    pub angular_radius: f32,
}

impl Disc {
    /// Irradiance at a receiver from the unoccluded part of the disc above its horizon, as a fraction of `irradiance`;
    /// `cosine`: that of the angle between the disc's centre and the normal.
    fn unoccluded(&self, cosine: f64) -> f64 {
        let sine = (self.angular_radius as f64).sin();
        if cosine >= sine {
            return cosine;
        }
        if cosine <= -sine {
            return 0.0;
        }
        // h is the distance of a unit sphere of the disc's apparent size.
        let h2 = 1.0 / (sine * sine);
        let beyond = (h2 - 1.0).max(0.0);
        let k = (1.0 - h2 * cosine * cosine).max(0.0).sqrt();
        let inside = -cosine * (beyond / (1.0 - cosine * cosine)).sqrt();
        let part = cosine * inside.clamp(-1.0, 1.0).acos() - k * beyond.sqrt() + h2 * k.atan2(beyond.sqrt());
        (part / consts::PI).max(0.0)
    }

    /// Pushes the shadow rays of samples `first` to `first + samples` of the sequence that `seed` chooses. Returns the
    /// unoccluded irradiance, and the unoccluded sum of all samples.
    pub(crate) fn push(
        &self,
        receiver: &Receiver,
        first: u32,
        samples: u32,
        seed: u32,
        shadow: &mut ShadowRays,
    ) -> (Vec3, Vec3) {
        let cosine = self.to_light.as_dvec3().dot(receiver.normal.as_dvec3());
        let total = self.unoccluded(cosine) as f32;
        if total <= 0.0 {
            return (Vec3::ZERO, Vec3::ZERO);
        }
        let (t, b) = orthonormal_basis(self.to_light);
        // 1 − cos of the angular radius, without cancellation.
        let height = 2.0 * (0.5 * self.angular_radius).sin().powi(2);
        // Radiance times solid angle: irradiance / (π sin²) · 2π (1 − cos).
        let sine = self.angular_radius.sin();
        let of_one = self.irradiance * (2.0 * height / (sine * sine) / samples as f32);
        let mut brought = Vec3::ZERO;
        for k in first..first + samples {
            let [u, v] = sobol_2d(k, combine(seed, 4));
            let (sin, cos) = (2.0 * PI * v).sin_cos();
            let h = u * height;
            let direction = (t * cos + b * sin) * (h * (2.0 - h)).sqrt() + self.to_light * (1.0 - h);
            let weight = direction.dot(receiver.normal);
            if weight > 0.0 {
                brought += of_one * weight;
                if receiver.faces(direction) {
                    shadow.push(Ray::new(receiver.shadow_origin, direction), of_one * weight);
                }
            }
        }
        (self.irradiance * total, brought)
    }
}

/// Pushes up to `n` shadow rays, whose sum is the irradiance of the sky.
pub(crate) fn push_sky(sky: &Sky, receiver: &Receiver, n: u32, seed: u32, shadow: &mut ShadowRays) {
    let guide = shadow.guide;
    let (t, b) = if guide.is_some() { frame(receiver.normal) } else { orthonormal_basis(receiver.normal) };
    // A direction, and its density as a multiple of that by cosine.
    let by_cosine = |u| {
        let (u, density) = guide.as_ref().map_or((u, 1.0), |guide| guide.warp(u));
        let d = cosine_hemisphere(u);
        (t * d.x + b * d.y + receiver.normal * d.z, density)
    };
    let mut push = |direction: Vec3, light: Vec3| {
        if receiver.faces(direction) && light.max_element() > 0.0 {
            shadow.push(Ray::new(receiver.shadow_origin, direction), light);
        }
    };
    if sky.is_constant() {
        let light = sky.at(receiver.normal).0 * (PI / n as f32);
        for k in 0..n {
            let (direction, density) = by_cosine(sobol_2d(k, combine(seed, 5)));
            push(direction, light / density);
        }
        return;
    }
    // All samples of one kind together have the density n/2 · p; both kinds together, the sum of their densities.
    let half = n.div_ceil(2);
    let weighted = |direction: Vec3, radiance: Vec3, by_image: f32, guided: f32| {
        let cosine = direction.dot(receiver.normal).max(0.0);
        radiance * (cosine / (half as f32 * (by_image + guided * cosine / PI)))
    };
    for k in 0..half {
        let (direction, radiance, density) = sky.sample(sobol_2d(k, combine(seed, 6)));
        let guided = guide.as_ref().map_or(1.0, |g| g.density(square_of(direction.dot(t), direction.dot(b))));
        push(direction, weighted(direction, radiance, density, guided));
        let (direction, guided) = by_cosine(sobol_2d(k, combine(seed, 5)));
        let (radiance, density) = sky.at(direction);
        push(direction, weighted(direction, radiance, density, guided));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_disc_cut_by_the_horizon_gives_what_is_above_it() {
        for radius in [1e-4, 0.00465, 0.3, 1.2, consts::FRAC_PI_2 as f32] {
            let disc = Disc { to_light: Vec3::Z, irradiance: Vec3::ONE, angular_radius: radius };
            let (a, sine) = (radius as f64, (radius as f64).sin());
            for i in -12..=12 {
                // Angle of the middle to the normal.
                let theta = consts::FRAC_PI_2 - a * i as f64 / 10.0;
                if !(0.0..=consts::PI).contains(&theta) {
                    continue;
                }
                // Radiance over the disc, in rings: the mean over azimuth of max(0, cosine) in closed form.
                let (n, mut sum) = (4000, 0.0);
                for k in 0..n {
                    let r = a * (k as f64 + 0.5) / n as f64;
                    let (p, q) = (r.cos() * theta.cos(), r.sin() * theta.sin());
                    let ring = if p >= q.abs() {
                        2.0 * consts::PI * p
                    } else if p <= -q.abs() {
                        0.0
                    } else {
                        let edge = (-p / q).acos();
                        2.0 * (p * edge + q * edge.sin())
                    };
                    sum += ring * r.sin() * a / n as f64;
                }
                let expected = sum / (consts::PI * sine * sine);
                let got = disc.unoccluded(theta.cos());
                assert!((got - expected).abs() < 2e-7 * sine.max(expected) + 1e-10, "{radius} {i}: {got}, {expected}");
            }
        }
    }
}
