//! Plain pseudo-random numbers, and maps from the square to what is sampled.

use glam::DVec3;
use std::f64::consts::TAU;

/// SplitMix64 (Steele, Lea and Flood, *Fast splittable pseudorandom number generators*, 2014).
#[derive(Clone, Debug)]
pub struct Random {
    state: u64,
}

impl Random {
    /// The stream with number `stream` of a seed.
    pub fn new(seed: u64, stream: u64) -> Self {
        // Two rounds of the mix put the states of neighbouring streams far apart.
        let mut start = Random { state: seed };
        start.state = start.next_u64() ^ stream.wrapping_mul(0xd6e8_feb8_6659_fd93);
        Random { state: start.next_u64() }
    }

    /// 64 random bits.
    pub fn next_u64(&mut self) -> u64 {
        self.state = self.state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.state;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// Uniform in [0, 1).
    pub fn uniform(&mut self) -> f64 {
        (self.next_u64() >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
    }

    /// Uniform in the unit square.
    pub fn square(&mut self) -> [f64; 2] {
        [self.uniform(), self.uniform()]
    }

    /// Uniform in cell (`x`, `y`) of the unit square's `n` × `n` grid.
    pub fn cell(&mut self, x: u32, y: u32, n: u32) -> [f64; 2] {
        [(x as f64 + self.uniform()) / n as f64, (y as f64 + self.uniform()) / n as f64]
    }

    /// A direction, uniform on the unit sphere.
    pub fn direction(&mut self) -> DVec3 {
        let [a, b] = self.square();
        let z = 1.0 - 2.0 * a;
        let (sin, cos) = (TAU * b).sin_cos();
        let r = (1.0 - z * z).max(0.0).sqrt();
        DVec3::new(r * cos, r * sin, z)
    }
}

/// A unit direction around `normal` with density cos θ / π, and cos θ.
pub fn cosine_direction(normal: DVec3, square: [f64; 2]) -> (DVec3, f64) {
    let (x, y) = normal.any_orthonormal_pair();
    let (sin, cos) = (TAU * square[1]).sin_cos();
    let r = square[0].sqrt();
    let z = (1.0 - square[0]).sqrt();
    (x * (r * cos) + y * (r * sin) + normal * z, z)
}

/// Weights of corners 1 and 2 of a point uniform on a triangle.
pub fn triangle_point(square: [f64; 2]) -> [f64; 2] {
    let root = square[0].sqrt();
    [root * (1.0 - square[1]), root * square[1]]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_and_streams_are_uniform_and_uncorrelated() {
        let n = 100_000;
        let (mut mean, mut square, mut cross) = (0.0, 0.0, 0.0);
        for i in 0..n {
            let (a, b) = (Random::new(1, i).uniform(), Random::new(1, i + 1).uniform());
            mean += a / n as f64;
            square += a * a / n as f64;
            cross += a * b / n as f64;
        }
        // Four standard errors of each mean.
        let tolerance = 4.0 * 0.3 / (n as f64).sqrt();
        assert!((mean - 0.5).abs() < tolerance, "{mean}");
        assert!((square - 1.0 / 3.0).abs() < tolerance, "{square}");
        assert!((cross - 0.25).abs() < tolerance, "{cross}");
    }

    #[test]
    fn cosine_directions_have_the_moments_of_their_density() {
        let normal = DVec3::new(1.0, -2.0, 0.5).normalize();
        let mut random = Random::new(2, 0);
        let (mut first, mut second) = (DVec3::ZERO, 0.0);
        let n = 100_000;
        for _ in 0..n {
            let (d, cosine) = cosine_direction(normal, random.square());
            assert!((d.length() - 1.0).abs() < 1e-12 && (d.dot(normal) - cosine).abs() < 1e-12);
            first += d / n as f64;
            second += cosine * cosine / n as f64;
        }
        assert!((first - normal * (2.0 / 3.0)).length() < 5e-3);
        assert!((second - 0.5).abs() < 5e-3);
    }
}
