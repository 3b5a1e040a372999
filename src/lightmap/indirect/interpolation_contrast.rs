//! Finds where interpolation between gather texels is wrong by their light: where it differs by more than its noise can
//! explain, as beside a sunlit leaf, there is an edge or a gradient that the gather map is too coarse for.
//!
//! The [geometric estimate](super::interpolation_error) knows how fast light may change, this one how fast it does. It
//! needs the gather map, which live updates do not have before they choose texels.

use crate::lightmap::atlas::ids::{GatherMap, GatherTexel, PerTexel};
use glam::Vec3;

/// Light of the gather map.
pub(crate) struct GatherLight<'a> {
    pub irradiance: PerTexel<'a, GatherMap, Vec3>,
    /// Variances of the irradiance's sums over the channels; infinite if unknown.
    pub variances: PerTexel<'a, GatherMap, f32>,
}

impl GatherLight<'_> {
    /// Whether the RMS contrast of gather texels with weights, their standard deviation divided by their mean (Peli,
    /// *Contrast in complex images*, 1990), is more than `most` without the part that is noise.
    pub(super) fn contrast_exceeds(&self, most: f32, texels: impl Iterator<Item = (GatherTexel, f32)> + Clone) -> bool {
        // With 64 bits no square overflows or vanishes.
        let mean_of = |value: &dyn Fn(GatherTexel) -> f64| {
            let (sum, total) = texels.clone().fold((0.0, 0.0), |(sum, total), (texel, weight)| {
                (sum + f64::from(weight) * value(texel), total + f64::from(weight))
            });
            sum / total
        };
        let light = |texel| f64::from(self.irradiance[texel].element_sum());
        let mean = mean_of(&light);
        let spread = mean_of(&|texel| (light(texel) - mean).powi(2) - f64::from(self.variances[texel]));
        spread > (f64::from(most) * mean).powi(2)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn contrast_counts_what_is_more_than_noise_at_any_scale() {
        for scale in [1e-12f32, 1.0, 1e12] {
            let exceeds = |light: [f32; 4], noise: f32, weights: [f32; 4]| {
                let irradiance = light.map(|l| Vec3::new(l, 0.0, 0.0) * scale);
                let variances = [noise * scale * scale; 4];
                let light =
                    GatherLight { irradiance: PerTexel::new(&irradiance), variances: PerTexel::new(&variances) };
                let texels = (0..4).map(|i| (GatherTexel::new(i), weights[i]));
                light.contrast_exceeds(0.3, texels)
            };
            let same = [0.25; 4];
            // Contrasts of 0.29 and 0.31 about a mean of 1.
            assert!(!exceeds([0.71, 1.29, 0.71, 1.29], 0.0, same));
            assert!(exceeds([0.69, 1.31, 0.69, 1.31], 0.0, same));
            assert!(!exceeds([0.69, 1.31, 0.69, 1.31], 0.01, same));
            assert!(!exceeds([0.69, 1.31, 0.69, 1.31], f32::INFINITY, same));
            // One that hardly counts.
            assert!(!exceeds([1.0, 1.0, 1.0, 3.0], 0.0, [0.33, 0.33, 0.33, 0.01]));
            assert!(exceeds([1.0, 1.0, 1.0, 3.0], 0.0, [0.3, 0.3, 0.3, 0.1]));
            // Nothing, or only one.
            assert!(!exceeds([0.0; 4], 0.0, same) && !exceeds([1.0, 0.0, 0.0, 0.0], 0.0, [1.0, 0.0, 0.0, 0.0]));
        }
    }
}
