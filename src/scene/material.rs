//! Materials: diffuse reflectance, emission, cut-outs and transmission.

use super::{NONE, check_energy};
use crate::base::error::{Result, invalid_argument};

/// Maximum reflectance that file loaders and look-ups of textures return; the API refuses 1 and above.
pub const MAX_ALBEDO: f32 = 0.98;

/// A diffuse material.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Material {
    /// Diffuse reflectance per channel, in [0, 1). With a texture: the factor of the texture, in [0, 1].
    pub albedo: [f32; 3],
    /// Emitted radiance per channel in W/(m²·sr), from the front side, and from the back too if the
    /// material is two-sided.
    pub emission: [f32; 3],
    /// Whether the back side reflects and emits like the front. The back of a one-sided material absorbs all light that
    /// hits it and is not transmitted.
    pub two_sided: bool,
    /// Number of the [texture](super::Texture) that is multiplied with `albedo`, the product limited to
    /// [`MAX_ALBEDO`]; [`NONE`]: none. Where a mesh has no texture coordinates, `albedo` alone counts.
    pub albedo_texture: u32,
    /// Points of the surface where the texture's alpha is less than this are cut out: rays and photons pass through
    /// them from either side. In [0, 1]; 0: no cut-outs.
    pub alpha_cutoff: f32,
    /// Fraction of light, per channel, that passes straight through, from either side, as through stained glass; with
    /// `albedo` at most 1. Geometric ray queries hit the surface all the same.
    pub transmission: [f32; 3],
}

impl Default for Material {
    fn default() -> Self {
        Material {
            albedo: [0.5; 3],
            emission: [0.0; 3],
            two_sided: false,
            albedo_texture: NONE,
            alpha_cutoff: 0.0,
            transmission: [0.0; 3],
        }
    }
}

/// Tolerance for the rounding of two fractions that sum to 1.
const SUM_SLACK: f32 = 1e-6;

impl Material {
    /// Whether the material emits light.
    pub fn is_emissive(&self) -> bool {
        self.emission.iter().any(|&e| e > 0.0)
    }

    /// Whether light passes through the material.
    #[inline]
    pub fn transmits(&self) -> bool {
        self.transmission.iter().any(|&t| t > 0.0)
    }

    /// Checks the ranges documented on the fields; `textures`: number of textures of the scene.
    pub fn validate(&self, textures: usize) -> Result<()> {
        let textured = self.albedo_texture != NONE;
        for (c, &a) in self.albedo.iter().enumerate() {
            if textured && !(0.0..=1.0).contains(&a) {
                return invalid_argument!("albedo[{c}] is {a}, outside [0, 1]");
            }
            if !textured && !(0.0..1.0).contains(&a) {
                return invalid_argument!("albedo[{c}] is {a}, outside [0, 1)");
            }
        }
        check_energy("emission", &self.emission)?;
        if textured && self.albedo_texture as usize >= textures {
            return invalid_argument!(
                "albedo_texture {} does not exist, the scene has {textures} textures",
                self.albedo_texture
            );
        }
        if !(0.0..=1.0).contains(&self.alpha_cutoff) {
            return invalid_argument!("alpha_cutoff is {}, outside [0, 1]", self.alpha_cutoff);
        }
        if self.alpha_cutoff > 0.0 && !textured {
            return invalid_argument!("alpha_cutoff is {}, but there is no albedo_texture", self.alpha_cutoff);
        }
        if self.alpha_cutoff > 0.0 && self.is_emissive() {
            return invalid_argument!(
                "a material that emits cannot have cut-outs (alpha_cutoff {})",
                self.alpha_cutoff
            );
        }
        for (c, (&t, &a)) in self.transmission.iter().zip(&self.albedo).enumerate() {
            if !(0.0..=1.0).contains(&t) {
                return invalid_argument!("transmission[{c}] is {t}, outside [0, 1]");
            }
            if t > 0.0 && !(t + a <= 1.0 + SUM_SLACK) {
                return invalid_argument!("albedo[{c}] {a} and transmission[{c}] {t} are more than 1 together");
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_out_of_range_is_named() {
        let m = Material::default();
        let textured = Material { albedo: [1.0; 3], albedo_texture: 1, ..m };
        assert!(textured.validate(2).is_ok());
        assert!(Material { transmission: [0.5, 0.0, 0.4], ..m }.validate(0).is_ok());
        assert!(Material { albedo: [0.7; 3], transmission: [0.3; 3], ..m }.validate(0).is_ok());
        for (material, culprit) in [
            (Material { albedo: [0.0, 1.0, 0.0], ..m }, "albedo[1] is 1, outside [0, 1)"),
            (Material { albedo: [0.0, 0.0, 1.1], ..textured }, "albedo[2] is 1.1, outside [0, 1]"),
            (Material { albedo_texture: 2, ..textured }, "albedo_texture 2 does not exist, the scene has 2"),
            (Material { alpha_cutoff: 0.5, ..m }, "there is no albedo_texture"),
            (Material { alpha_cutoff: f32::NAN, ..textured }, "alpha_cutoff is NaN"),
            (Material { alpha_cutoff: 1.5, ..textured }, "alpha_cutoff is 1.5"),
            (Material { alpha_cutoff: 0.5, emission: [1.0; 3], ..textured }, "cannot have cut-outs"),
            (Material { transmission: [0.0, -0.1, 0.0], ..m }, "transmission[1] is -0.1"),
            (Material { transmission: [0.0, 0.0, 0.6], ..m }, "transmission[2] 0.6 are more than 1"),
            (Material { transmission: [f32::NAN; 3], ..m }, "transmission[0] is NaN"),
        ] {
            let e = material.validate(2).unwrap_err().to_string();
            assert!(e.contains(culprit), "{e}");
        }
    }
}
