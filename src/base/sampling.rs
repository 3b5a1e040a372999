//! Counter-based sampling.
//!
//! Every random number is a function of a seed, an index and a dimension, so results do not depend
//! on threads or sharding, and a longer run starts with the samples of a shorter one.
//!
//! The sequences are Owen-scrambled Sobol points (Burley, *Practical Hash-based Owen Scrambling*,
//! JCGT 2020, with the Laine-Karras permutation). Pairs of dimensions are (0,2)-sequences; further
//! pairs are padded with their own shuffle of the index (Burley, section 5).

use super::functions::sin_cos;
use glam::Vec3;
use std::f32::consts::{PI, TAU};

/// Mixes 32 bits (the finaliser of MurmurHash3): every input bit affects every output bit.
#[inline]
pub fn mix(mut x: u32) -> u32 {
    x ^= x >> 16;
    x = x.wrapping_mul(0x85eb_ca6b);
    x ^= x >> 13;
    x = x.wrapping_mul(0xc2b2_ae35);
    x ^ (x >> 16)
}

/// Makes a seed from a seed and another number.
#[inline]
pub fn combine(seed: u32, value: u32) -> u32 {
    mix(seed ^ mix(value.wrapping_add(0x9e37_79b9)))
}

/// Makes a 32-bit seed for one purpose (a stage of the pipeline) from the caller's 64-bit seed.
#[inline]
pub fn purpose_seed(seed: u64, purpose: u32) -> u32 {
    combine(combine(mix(seed as u32), (seed >> 32) as u32), purpose)
}

/// Laine and Karras' hash: permutes so that each bit depends only on those below it.
#[inline]
fn laine_karras(mut x: u32, seed: u32) -> u32 {
    x = x.wrapping_add(seed);
    x ^= x.wrapping_mul(0x6c50_b47c);
    x ^= x.wrapping_mul(0xb82f_1e52);
    x ^= x.wrapping_mul(0xc7af_e638);
    x ^ x.wrapping_mul(0x8d22_f6e6)
}

/// Owen's nested uniform scramble, base 2.
#[inline]
fn owen_scramble(x: u32, seed: u32) -> u32 {
    laine_karras(x.reverse_bits(), seed).reverse_bits()
}

/// The second Sobol dimension: the Pascal matrix applied to the bits of the index, computed by
/// folding (each step doubles the block on which the matrix is right).
#[inline]
fn sobol_second(index: u32) -> u32 {
    let mut x = index;
    x ^= (x & 0xaaaa_aaaa) >> 1;
    x ^= (x & 0xcccc_cccc) >> 2;
    x ^= (x & 0xf0f0_f0f0) >> 4;
    x ^= (x & 0xff00_ff00) >> 8;
    x ^= (x & 0xffff_0000) >> 16;
    x.reverse_bits()
}

/// Maps 32 bits to [0, 1): 24 bits, so that the result is never rounded up to 1.
#[inline]
pub fn unit_float(x: u32) -> f32 {
    (x >> 8) as f32 * (1.0 / (1 << 24) as f32)
}

/// Point `index` of an Owen-scrambled Sobol (0,2)-sequence chosen by `seed`.
#[inline]
pub fn sobol_2d(index: u32, seed: u32) -> [f32; 2] {
    sobol_2d_bits(index, seed).map(unit_float)
}

/// Point `index` of the sequence of `sobol_2d` in fixed point: 32 binary digits behind the point. XOR with a constant
/// per coordinate (a digital shift) gives another (0,2)-sequence with the same points in each elementary interval.
#[inline]
pub fn sobol_2d_bits(index: u32, seed: u32) -> [u32; 2] {
    let shuffled = owen_scramble(index, combine(seed, 0));
    [owen_scramble(shuffled.reverse_bits(), combine(seed, 1)), owen_scramble(sobol_second(shuffled), combine(seed, 2))]
}

/// A uniform pseudo-random number in [0, 1), independent in all arguments.
#[inline]
pub fn uniform(index: u32, dimension: u32, seed: u32) -> f32 {
    unit_float(combine(combine(seed, dimension), index))
}

/// Maps the unit square to the hemisphere around +z with density cos θ / π (Malley's method with Shirley and Chiu's
/// concentric map).
#[inline]
pub fn cosine_hemisphere(u: [f32; 2]) -> Vec3 {
    let [x, y] = concentric_disc(u);
    Vec3::new(x, y, (1.0 - x * x - y * y).max(0.0).sqrt())
}

/// Maps the unit square to the unit disc, uniformly (Shirley and Chiu 1997).
#[inline]
pub fn concentric_disc(u: [f32; 2]) -> [f32; 2] {
    let (a, b) = (2.0 * u[0] - 1.0, 2.0 * u[1] - 1.0);
    if a == 0.0 && b == 0.0 {
        return [0.0, 0.0];
    }
    let is_wide = a.abs() > b.abs();
    let (r, other) = if is_wide { (a, b) } else { (b, a) };
    let (sin, cos) = sin_cos(PI / 4.0 * (other / r));
    if is_wide { [r * cos, r * sin] } else { [r * sin, r * cos] }
}

/// Maps the unit square to the unit sphere, uniformly.
#[inline]
pub fn uniform_sphere(u: [f32; 2]) -> Vec3 {
    uniform_cone(u, -1.0)
}

/// Maps the unit square to the cone around +z of half-angle acos(`cos_max`), uniformly in solid angle.
#[inline]
pub fn uniform_cone(u: [f32; 2], cos_max: f32) -> Vec3 {
    let z = 1.0 - u[0] * (1.0 - cos_max);
    let r = (1.0 - z * z).max(0.0).sqrt();
    let (sin, cos) = (TAU * u[1]).sin_cos();
    Vec3::new(r * cos, r * sin, z)
}

/// Maps the unit square to barycentrics (weights of vertices 1 and 2), uniformly in area.
#[inline]
pub fn uniform_triangle(u: [f32; 2]) -> [f32; 2] {
    let s = u[0].sqrt();
    [s * (1.0 - u[1]), s * u[1]]
}

/// Two unit vectors that make a right-handed basis with the unit vector `n` (Duff et al., *Building
/// an Orthonormal Basis, Revisited*, JCGT 2017).
#[inline]
pub fn orthonormal_basis(n: Vec3) -> (Vec3, Vec3) {
    let sign = 1.0_f32.copysign(n.z);
    let a = -1.0 / (sign + n.z);
    let b = n.x * n.y * a;
    (Vec3::new(1.0 + sign * n.x * n.x * a, sign * b, -sign * n.x), Vec3::new(b, sign + n.y * n.y * a, -n.y))
}

/// A direction around the unit vector `normal` with density cos θ / π.
#[inline]
pub fn cosine_around(normal: Vec3, u: [f32; 2]) -> Vec3 {
    let local = cosine_hemisphere(u);
    let (t, b) = orthonormal_basis(normal);
    (t * local.x + b * local.y + normal * local.z).normalize()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sobol_pairs_are_stratified_in_every_elementary_interval() {
        // A (0,m,2)-net in base 2 has one point in each 2^-a × 2^-b box, a + b = m.
        for seed in 0..8 {
            for m in [4, 8] {
                let n = 1u32 << m;
                for start in [0, n, 5 * n] {
                    for a in 0..=m {
                        let (na, nb) = (1usize << a, 1usize << (m - a));
                        let mut seen = vec![false; na * nb];
                        for i in start..start + n {
                            let [x, y] = sobol_2d(i, seed);
                            let cell = (x * na as f32) as usize * nb + (y * nb as f32) as usize;
                            assert!(!std::mem::replace(&mut seen[cell], true), "seed {seed} m {m} a {a}");
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn directions_are_unit_and_have_the_right_mean() {
        let n = 1 << 12;
        let (mut cosine, mut sphere, mut cone) = (Vec3::ZERO, Vec3::ZERO, 0.0f32);
        for i in 0..n {
            let u = sobol_2d(i, 7);
            let c = cosine_hemisphere(u);
            assert!((c.length() - 1.0).abs() < 1e-5);
            cosine += c / n as f32;
            sphere += uniform_sphere(u) / n as f32;
            cone += uniform_cone(u, 0.5).z / n as f32;
        }
        assert!((cosine - Vec3::new(0.0, 0.0, 2.0 / 3.0)).length() < 2e-3, "{cosine}");
        assert!(sphere.length() < 2e-3, "{sphere}");
        assert!((cone - 0.75).abs() < 1e-3, "{cone}");
    }

    #[test]
    fn bases_are_orthonormal_and_right_handed() {
        for i in 0..1000 {
            let n = uniform_sphere(sobol_2d(i, 3)).normalize();
            let (t, b) = orthonormal_basis(n);
            assert!(t.dot(b).abs() < 1e-6 && t.dot(n).abs() < 1e-6);
            assert!((t.cross(b) - n).length() < 1e-5);
        }
    }
}
