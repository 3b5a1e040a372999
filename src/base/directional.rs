//! Light by direction: the first two bands of spherical harmonics (SH L1) of the radiance above a surface.
//!
//! Irradiance says how much light a surface gets whose normal is the one it was computed for. For other normals, as of
//! normal maps, one needs to know where light comes from: the mean radiance L0 and the mean of radiance times direction,
//! L1, which are the coefficients of the bands 0 and 1 but for constant factors (Ramamoorthi and Hanrahan, *An Efficient
//! Representation for Irradiance Environment Maps*, 2001). Their estimates weigh radiance by 1 / cos θ, which has no
//! bound at the horizon; below [`HORIZON`] the weight is that of the horizon.
//!
//! Each sample adds to L1 at most what it adds to L0, and stages after that take sums with weights ≥ 0, so |L1| ≤ L0 in
//! each channel. Stitching of seams, which subtracts, [clamps](Directional::valid).

use bytemuck::{Pod, Zeroable};
use glam::Vec3;
use std::f32::consts::PI;
use std::ops::{Add, AddAssign, Div, Mul, Sub};

/// Cosine of the angle from the normal beyond which directions count as at that angle.
const HORIZON: f32 = 0.1;

/// Light by direction, per channel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct Directional {
    /// Mean radiance over the sphere, of which the half below the surface is dark: 1 / 4π · ∫ L dω, W/(m²·sr).
    pub l0: Vec3,
    /// The same mean of radiance times each coordinate of its direction: 1 / 4π · ∫ L ω dω.
    pub l1: [Vec3; 3],
}

impl Directional {
    /// Makes the light of an `irradiance` from one unit direction. `cosine`: that of the angle to the normal.
    pub(crate) fn of(irradiance: Vec3, direction: Vec3, cosine: f32) -> Directional {
        let l0 = irradiance * (1.0 / (4.0 * PI * cosine.max(HORIZON)));
        Directional { l0, l1: direction.to_array().map(|x| x * l0) }
    }

    /// Scales each channel.
    pub(crate) fn scaled(self, by: Vec3) -> Directional {
        Directional { l0: self.l0 * by, l1: self.l1.map(|x| x * by) }
    }

    /// Returns this light with L0 ≥ 0 and, in each channel, |L1| ≤ L0.
    pub(crate) fn valid(self) -> Directional {
        let l0 = self.l0.max(Vec3::ZERO);
        let length = self.l1.iter().map(|&x| x * x).sum::<Vec3>().map(f32::sqrt);
        let scale = Vec3::select(length.cmpgt(l0), l0 / length, Vec3::ONE);
        Directional { l0, l1: self.l1.map(|x| x * scale) }
    }

    /// Whether the values are possible: finite, L0 ≥ 0, and |L1| ≤ L0 but for rounding.
    pub(crate) fn is_possible(&self) -> bool {
        let squares = self.l1.iter().map(|&x| x * x).sum::<Vec3>();
        let limit = self.l0 * self.l0 * 1.001 + 1e-30;
        limit.is_finite() && squares.cmple(limit).all() && self.l0.cmpge(Vec3::ZERO).all()
    }
}

/// Values that stages of a bake take weighted sums of.
pub(crate) trait Linear:
    Copy + Default + Send + Sync + AddAssign + Mul<f32, Output = Self> + Div<f32, Output = Self>
{
}

impl Linear for f32 {}
impl Linear for Vec3 {}
impl Linear for Directional {}

impl Add for Directional {
    type Output = Directional;

    fn add(self, other: Directional) -> Directional {
        let [x, y, z] = self.l1;
        let [a, b, c] = other.l1;
        Directional { l0: self.l0 + other.l0, l1: [x + a, y + b, z + c] }
    }
}

impl Sub for Directional {
    type Output = Directional;

    fn sub(self, other: Directional) -> Directional {
        self + other * -1.0
    }
}

impl AddAssign for Directional {
    fn add_assign(&mut self, other: Directional) {
        *self = *self + other;
    }
}

impl Mul<f32> for Directional {
    type Output = Directional;

    fn mul(self, by: f32) -> Directional {
        self.scaled(Vec3::splat(by))
    }
}

impl Div<f32> for Directional {
    type Output = Directional;

    fn div(self, by: f32) -> Directional {
        Directional { l0: self.l0 / by, l1: self.l1.map(|x| x / by) }
    }
}
