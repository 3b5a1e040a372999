//! Materials: diffuse reflectance and emission.

use super::check_energy;
use crate::error::{Result, invalid_argument};

/// File loaders clamp reflectances to this; the API refuses 1 and above.
pub const MAX_ALBEDO: f32 = 0.98;

/// A diffuse material.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Material {
    /// Diffuse reflectance per channel, in [0, 1).
    pub albedo: [f32; 3],
    /// Emitted radiance per channel in W/(m²·sr), from the front side, and from the back too if the
    /// material is two-sided.
    pub emission: [f32; 3],
    /// Whether the back side reflects and emits like the front. The back of a one-sided material
    /// absorbs what meets it.
    pub two_sided: bool,
}

impl Default for Material {
    fn default() -> Self {
        Material { albedo: [0.5; 3], emission: [0.0; 3], two_sided: false }
    }
}

impl Material {
    /// Whether it emits light.
    pub fn is_emissive(&self) -> bool {
        self.emission.iter().any(|&e| e > 0.0)
    }

    /// Checks the ranges documented on the fields.
    pub fn validate(&self) -> Result<()> {
        for (c, &a) in self.albedo.iter().enumerate() {
            if !(0.0..1.0).contains(&a) {
                return invalid_argument!("albedo[{c}] is {a}, outside [0, 1)");
            }
        }
        check_energy("emission", &self.emission)
    }
}
