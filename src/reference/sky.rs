//! Skies of the path tracer: written from their description alone, in f64, so that a mistake in the
//! library's own is not shared.

use super::proposal::{Proposal, balance, rgb};
use super::random::Random;
use crate::scene::{Environment, Light, NONE};
use glam::{DVec2, DVec3};
use std::f64::consts::{PI, TAU};
use std::sync::Arc;

/// An infinitely distant sphere of light.
pub struct Sky {
    radiance: DVec3,
    image: Option<Arc<Environment>>,
    /// Running sums of brightness times solid angle, over all pixels.
    sums: Vec<f64>,
    up: DVec3,
    /// Direction of the middle of the image.
    front: DVec3,
}

impl Sky {
    pub fn new(light: &Light, environments: &[Arc<Environment>]) -> Option<Sky> {
        let Light::Sky { radiance, environment, up, rotation } = *light else { return None };
        let image = (environment != NONE).then(|| environments[environment as usize].clone());
        let up = up.as_dvec3().normalize();
        let ahead = if up.z.abs() > 0.5f64.sqrt() { DVec3::Y } else { -DVec3::Z };
        let ahead = (ahead - up * up.dot(ahead)).normalize();
        let front = glam::DQuat::from_axis_angle(up, rotation as f64) * ahead;
        let mut sky = Sky { radiance: rgb(radiance), image, sums: Vec::new(), up, front };
        if let Some(image) = &sky.image {
            let mut sum = 0.0;
            for (i, &pixel) in image.rgb().iter().enumerate() {
                sum += rgb(pixel).element_sum() * solid_angle(image, i);
                sky.sums.push(sum);
            }
            if sum == 0.0 {
                return None;
            }
        }
        Some(sky)
    }

    /// Radiance from a direction, and the density of [`propose`](Self::propose) there.
    fn look(&self, direction: DVec3) -> (DVec3, f64) {
        let Some(image) = &self.image else { return (self.radiance, 0.0) };
        let (width, height) = image.size();
        let right = self.front.cross(self.up);
        let flat = DVec2::new(self.front.dot(direction), right.dot(direction));
        let turn = flat.to_angle() / TAU + 0.5;
        let polar = self.up.dot(direction).clamp(-1.0, 1.0).acos() / PI;
        let cell = |x: f64, n: u32| ((x * n as f64) as u32).min(n - 1) as usize;
        let pixel = rgb(image.rgb()[cell(polar, height) * width as usize + cell(turn, width)]);
        (self.radiance * pixel, pixel.element_sum() / self.sums[self.sums.len() - 1])
    }

    /// A direction in proportion to the image's light; none of a constant sky, which cosines sample best.
    pub fn propose(&self, normal: DVec3, random: &mut Random) -> Option<Proposal> {
        let (image, &total) = (self.image.as_ref()?, self.sums.last()?);
        let pick = random.uniform() * total;
        let i = self.sums.partition_point(|&s| s <= pick).min(self.sums.len() - 1);
        let (width, height) = image.size();
        let (x, y) = (i % width as usize, i / width as usize);
        let turn = TAU * ((x as f64 + random.uniform()) / width as f64 - 0.5);
        let rim = |y: usize| (PI * y as f64 / height as f64).cos();
        let z = rim(y) + (rim(y + 1) - rim(y)) * random.uniform();
        let right = self.front.cross(self.up);
        let flat = (1.0 - z * z).max(0.0).sqrt();
        let direction = self.up * z + (self.front * turn.cos() + right * turn.sin()) * flat;
        let cosine = normal.dot(direction);
        let pixel = rgb(image.rgb()[i]);
        let density = pixel.element_sum() / total;
        // Radiance · cosine / density, times density / (density + density by cosine).
        let irradiance = self.radiance * pixel * (cosine / (density + cosine / PI));
        (cosine > 0.0).then_some(Proposal { irradiance, direction, distance: f64::INFINITY })
    }

    /// Radiance along a ray that hits nothing.
    pub fn along(&self, direction: DVec3, by_cosine: Option<f64>) -> DVec3 {
        let (radiance, density) = self.look(direction);
        by_cosine.map_or(radiance, |d| radiance * balance(d, density))
    }
}

fn solid_angle(image: &Environment, pixel: usize) -> f64 {
    let (width, height) = image.size();
    let row = pixel / width as usize;
    let rim = |y: usize| (PI * y as f64 / height as f64).cos();
    (rim(row) - rim(row + 1)) * TAU / width as f64
}
