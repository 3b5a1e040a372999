//! Skies: light from infinitely far away, equal in all directions or given by an image, and the choice of directions by
//! importance (Pharr, Jakob and Humphreys, *Physically Based Rendering*, section 12.5, with the exact solid angle of
//! each pixel instead of its sine).

use super::check_energy;
use crate::base::error::{Result, invalid_argument};
use glam::{DVec3, Vec3};
use std::f32::consts::{FRAC_PI_4, PI, TAU};
use std::f64;
use std::sync::Arc;

/// Maximum number of pixels of an environment along each axis.
pub const MAX_ENVIRONMENT_SIZE: u32 = 1 << 14;

/// An image of the whole sphere of directions by longitude and latitude, in linear RGB.
///
/// Row 0 is at the zenith, the last row at the nadir. The middle of the image is the sky's front, and
/// columns follow one another to the right as seen from inside; the left and right border are behind.
/// Radiance is that of the pixel, without interpolation: sampling follows it exactly.
#[derive(Clone, Debug, PartialEq)]
pub struct Environment {
    width: u32,
    height: u32,
    rgb: Vec<[f32; 3]>,
    /// Cumulative part of the image's light, up to and including each row.
    rows: Vec<f64>,
    /// Cumulative part of a row's light, up to and including each pixel.
    pixels: Vec<f32>,
    /// Integral of radiance over the sphere.
    integral: DVec3,
}

impl Environment {
    /// Makes an environment from `width` × `height` radiances or factors, row by row. Both sizes must be in 1 to
    /// [`MAX_ENVIRONMENT_SIZE`], values finite and at least 0.
    pub fn new(width: u32, height: u32, rgb: Vec<[f32; 3]>) -> Result<Environment> {
        for (name, size) in [("width", width), ("height", height)] {
            if !(1..=MAX_ENVIRONMENT_SIZE).contains(&size) {
                return invalid_argument!("the environment's {name} is {size}, outside 1 to {MAX_ENVIRONMENT_SIZE}");
            }
        }
        if rgb.len() != width as usize * height as usize {
            return invalid_argument!("an environment of {width} × {height} pixels is given by {} values", rgb.len());
        }
        if let Some(i) = rgb.iter().position(|p| check_energy("", p).is_err()) {
            check_energy(&format!("pixel ({}, {})", i as u32 % width, i as u32 / width), &rgb[i])?;
        }
        let mut e = Environment { width, height, rgb, rows: Vec::new(), pixels: Vec::new(), integral: DVec3::ZERO };
        e.prepare()?;
        Ok(e)
    }

    fn prepare(&mut self) -> Result<()> {
        self.pixels = crate::base::memory::try_vec(self.rgb.len(), "an environment")?;
        let mut below = 0.0;
        for y in 0..self.height {
            let row = y as usize * self.width as usize..(y + 1) as usize * self.width as usize;
            let (top, bottom) = self.heights(y);
            let solid_angle = (top - bottom) * f64::consts::TAU / self.width as f64;
            let sum: f64 = self.rgb[row.clone()].iter().map(brightness).sum();
            let mut left = 0.0;
            for i in row {
                left += brightness(&self.rgb[i]);
                self.pixels[i] = if sum > 0.0 { (left / sum) as f32 } else { 0.0 };
                self.integral += DVec3::from_array(self.rgb[i].map(f64::from)) * solid_angle;
            }
            below += sum * solid_angle;
            self.rows.push(below);
        }
        if below > 0.0 {
            self.rows.iter_mut().for_each(|r| *r /= below);
        }
        Ok(())
    }

    /// Cosines of the angle to the zenith at the borders of a row.
    fn heights(&self, y: u32) -> (f64, f64) {
        let cosine = |y: u32| (f64::consts::PI * y as f64 / self.height as f64).cos();
        (cosine(y), cosine(y + 1))
    }

    /// Number of pixels along longitude and latitude.
    pub fn size(&self) -> (u32, u32) {
        (self.width, self.height)
    }

    /// The pixels, row by row.
    pub fn rgb(&self) -> &[[f32; 3]] {
        &self.rgb
    }

    /// Size of pixels and tables in bytes.
    pub fn bytes(&self) -> usize {
        size_of_val(&self.rgb[..]) + size_of_val(&self.rows[..]) + size_of_val(&self.pixels[..])
    }

    /// The pixel at the angle `right` to the right of the front and at `height`, the cosine of the angle to the zenith.
    fn pixel(&self, right: f32, height: f32) -> usize {
        let x = ((right / TAU + 0.5) * self.width as f32) as u32;
        let y = (height.clamp(-1.0, 1.0).acos() / PI * self.height as f32) as u32;
        y.min(self.height - 1) as usize * self.width as usize + x.min(self.width - 1) as usize
    }

    /// Density per steradian with which [`sample`](Self::sample) chooses a direction in a pixel.
    fn density(&self, pixel: usize) -> f32 {
        (brightness(&self.rgb[pixel]) / self.integral.element_sum()) as f32
    }

    /// Chooses a pixel in proportion to its light, and a direction uniform in it: angle to the right and cosine to the
    /// zenith.
    fn sample(&self, u: [f32; 2]) -> (usize, f32, f32) {
        let v = u[1] as f64;
        let y = self.rows.partition_point(|&r| r <= v).min(self.height as usize - 1);
        let (top, bottom) = self.heights(y as u32);
        let first = if y == 0 { 0.0 } else { self.rows[y - 1] };
        let within = ((v - first) / (self.rows[y] - first)).clamp(0.0, 1.0);
        let row = &self.pixels[y * self.width as usize..(y + 1) * self.width as usize];
        let x = row.partition_point(|&p| p <= u[0]).min(row.len() - 1);
        let left = if x == 0 { 0.0 } else { row[x - 1] };
        let across = ((u[0] - left) / (row[x] - left)).clamp(0.0, 1.0);
        let right = ((x as f32 + across) / self.width as f32 - 0.5) * TAU;
        (y * self.width as usize + x, right, (top + (bottom - top) * within) as f32)
    }
}

fn brightness(rgb: &[f32; 3]) -> f64 {
    rgb.iter().map(|&c| c as f64).sum()
}

/// A sky prepared for sampling: its environment, if it has one, turned as the light specifies.
#[derive(Clone, Debug, PartialEq)]
pub struct Sky {
    radiance: Vec3,
    image: Option<Arc<Environment>>,
    front: Vec3,
    right: Vec3,
    up: Vec3,
}

impl Sky {
    /// Makes a sky from the fields of [`Light::Sky`](super::Light::Sky); `up` is a unit vector.
    pub(crate) fn new(
        radiance: [f32; 3],
        environment: u32,
        up: Vec3,
        rotation: f32,
        environments: &[Arc<Environment>],
    ) -> Sky {
        // (No image has the number NONE.)
        let image = environments.get(environment as usize).cloned();
        // Direction of the front before the sky is turned.
        let ahead = if up.z.abs() > FRAC_PI_4.cos() { Vec3::Y } else { Vec3::NEG_Z };
        let ahead = ahead.reject_from_normalized(up).normalize_or(up.any_orthonormal_vector());
        let side = ahead.cross(up);
        // A counter-clockwise turn takes the front to the left.
        let (sin, cos) = rotation.sin_cos();
        Sky {
            radiance: Vec3::from(radiance),
            image,
            front: ahead * cos - side * sin,
            right: side * cos + ahead * sin,
            up,
        }
    }

    /// Whether the sky does not shine at all.
    pub fn is_dark(&self) -> bool {
        let image = self.image.as_ref().map_or(DVec3::ONE, |i| i.integral);
        (self.radiance.as_dvec3() * image).max_element() <= 0.0
    }

    /// Whether the sky's radiance is the same in all directions.
    pub fn is_constant(&self) -> bool {
        self.image.is_none()
    }

    /// Integral of radiance over the sphere.
    pub(crate) fn integral(&self) -> DVec3 {
        self.radiance.as_dvec3() * self.image.as_ref().map_or(DVec3::splat(4.0 * f64::consts::PI), |i| i.integral)
    }

    /// Radiance from a direction, and the density per steradian with which [`sample`](Self::sample)
    /// chooses it.
    pub fn at(&self, direction: Vec3) -> (Vec3, f32) {
        let Some(image) = &self.image else { return (self.radiance, 0.25 / PI) };
        let right = direction.dot(self.right).atan2(direction.dot(self.front));
        let pixel = image.pixel(right, direction.dot(self.up));
        (self.radiance * Vec3::from(image.rgb[pixel]), image.density(pixel))
    }

    /// Chooses a direction by importance; returns it with its radiance and density.
    pub fn sample(&self, u: [f32; 2]) -> (Vec3, Vec3, f32) {
        let Some(image) = &self.image else {
            return (crate::base::sampling::uniform_sphere(u), self.radiance, 0.25 / PI);
        };
        let (pixel, right, height) = image.sample(u);
        let flat = (1.0 - height * height).max(0.0).sqrt();
        let (sin, cos) = right.sin_cos();
        let direction = self.up * height + (self.front * cos + self.right * sin) * flat;
        (direction.normalize(), self.radiance * Vec3::from(image.rgb[pixel]), image.density(pixel))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::sampling::{sobol_2d, uniform, uniform_sphere};

    fn random_image(width: u32, height: u32) -> Environment {
        let rgb = (0..width * height).map(|i| [0, 1, 2].map(|d| uniform(i, d, 4).powi(4))).collect();
        Environment::new(width, height, rgb).unwrap()
    }

    fn sky(image: Environment, up: Vec3, rotation: f32) -> Sky {
        Sky::new([1.0, 2.0, 0.5], 0, up.normalize(), rotation, &[Arc::new(image)])
    }

    #[test]
    fn samples_are_what_is_seen_in_their_direction_and_their_mean_is_the_integral() {
        for (width, height) in [(1, 1), (16, 8), (7, 33)] {
            let sky = sky(random_image(width, height), Vec3::new(0.3, 1.0, -0.4), 1.1);
            let (n, mut mean, mut uniform_mean, mut off) = (1 << 14, DVec3::ZERO, DVec3::ZERO, 0);
            for i in 0..n {
                let (direction, radiance, density) = sky.sample(sobol_2d(i, 1));
                assert!((direction.length() - 1.0).abs() < 1e-5);
                // But for rounding at the borders of pixels.
                off += (sky.at(direction) != (radiance, density)) as u32;
                mean += (radiance / density).as_dvec3() / n as f64;
                let d = uniform_sphere(sobol_2d(i, 2));
                uniform_mean += sky.at(d).0.as_dvec3() * (4.0 * f64::consts::PI) / n as f64;
            }
            assert!(off < n / 5000, "{off} of {n}");
            let exact = sky.integral();
            assert!((mean / exact - 1.0).abs().max_element() < 3e-3, "{mean} {exact}");
            assert!((uniform_mean / exact - 1.0).abs().max_element() < 0.01, "{uniform_mean} {exact}");
        }
    }

    #[test]
    fn the_image_is_the_right_way_up_and_round() {
        // Zenith red, nadir green, and the horizon from left to right blue 1 to 4.
        let row = |c: [f32; 3]| vec![c; 4];
        let mut rgb = row([1.0, 0.0, 0.0]);
        rgb.extend((1..=4).map(|b| [0.0, 0.0, b as f32]));
        rgb.extend(row([0.0, 1.0, 0.0]));
        let image = Arc::new(Environment::new(4, 3, rgb).unwrap());
        let look = |up: Vec3, rotation: f32, d: Vec3| {
            (Sky::new([1.0; 3], 0, up, rotation, std::slice::from_ref(&image)).at(d.normalize()).0).to_array()
        };
        assert_eq!(look(Vec3::Y, 0.0, Vec3::Y), [1.0, 0.0, 0.0]);
        assert_eq!(look(Vec3::Y, 0.0, Vec3::NEG_Y), [0.0, 1.0, 0.0]);
        assert_eq!(look(Vec3::Z, 0.0, Vec3::Z), [1.0, 0.0, 0.0]);
        // Up y: the middle looks along -z, right is +x.
        let (right, left) = (Vec3::new(0.1, 0.0, -1.0), Vec3::new(-0.1, 0.0, -1.0));
        assert_eq!((look(Vec3::Y, 0.0, right)[2], look(Vec3::Y, 0.0, left)[2]), (3.0, 2.0));
        assert_eq!(look(Vec3::Y, 0.0, Vec3::new(0.1, 0.0, 1.0))[2], 4.0);
        // Up z: the middle looks along +y, right is +x.
        assert_eq!(look(Vec3::Z, 0.0, Vec3::new(0.1, 1.0, 0.0))[2], 3.0);
        // A quarter turn counter-clockwise about y takes what was at -z to -x.
        assert_eq!(look(Vec3::Y, PI / 2.0, Vec3::new(-1.0, 0.0, -0.1))[2], 3.0);
        assert_eq!(look(Vec3::Y, PI / 2.0, Vec3::new(-1.0, 0.0, 0.1))[2], 2.0);
    }

    #[test]
    fn what_is_no_image_is_refused() {
        for (width, height, count) in [(0, 1, 0), (2, 2, 3), (1 << 15, 1, 1 << 15)] {
            assert!(Environment::new(width, height, vec![[1.0; 3]; count]).is_err());
        }
        for bad in [f32::NAN, f32::INFINITY, -1.0] {
            let message = Environment::new(2, 1, vec![[1.0; 3], [1.0, bad, 1.0]]).unwrap_err().to_string();
            assert!(message.contains("pixel (1, 0)"), "{message}");
        }
        let black = sky(Environment::new(2, 2, vec![[0.0; 3]; 4]).unwrap(), Vec3::Y, 0.0);
        assert!(black.is_dark() && !sky(random_image(2, 2), Vec3::Y, 0.0).is_dark());
    }
}
