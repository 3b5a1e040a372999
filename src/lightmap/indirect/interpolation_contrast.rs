//! Finds where interpolation between gather texels is wrong by their light: where it differs by more than its noise can
//! explain, as beside a sunlit leaf, there is an edge or a gradient that the gather map is too coarse for. What texels there
//! gather with their few rays is averaged over those nearby that differ alike from what they interpolate. The mean replaces
//! the interpolated light only as far as the two differ by more than noise.
//!
//! The [geometric estimate](super::interpolation_error) knows how fast light may change, this one how fast it does. It
//! needs the gather map, which live updates do not have before they choose texels.

use crate::base::directional::Directional;
use crate::lightmap::atlas::ids::{GatherMap, GatherTexel, PerTexel};
use glam::Vec3;

/// Factor on the noise that is subtracted from the contrast, and on that of the difference between what texels gather
/// and what they interpolate: where few rays meet what is bright, their spread tells too little. (With 1, and with what
/// texels gather alone, groups of a few of them stood out on smooth walls: docs/accuracy.md#interpolation-contrast.)
const SURE: f64 = 3.0;

/// Light of the gather map.
pub(crate) struct GatherLight<'a> {
    pub irradiance: PerTexel<'a, GatherMap, Vec3>,
    /// Variances of the irradiance's sums over the channels; infinite if unknown.
    pub variances: PerTexel<'a, GatherMap, f32>,
    /// The same before the blur.
    pub unblurred: PerTexel<'a, GatherMap, f32>,
    /// Number of gather rays of a texel.
    pub rays: u32,
    /// Light by direction; empty if nobody asks for it.
    pub directional: &'a [Directional],
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
        let spread = mean_of(&|texel| (light(texel) - mean).powi(2) - SURE * f64::from(self.variances[texel]));
        spread > (f64::from(most) * mean).powi(2)
    }
}

/// Returns the weight of what a texel has gathered in a mean with what it interpolates. The former has noise, of a given
/// variance of its sum over the channels, and the latter an unknown error, which the square of their difference less the
/// noise tells (the positive part of the estimate of James and Stein, *Estimation with quadratic loss*, 1961).
pub(super) fn weight_of_own(own: Vec3, interpolated: Vec3, variance: f32) -> f32 {
    let difference = f64::from(own.element_sum()) - f64::from(interpolated.element_sum());
    let (square, noise) = (difference * difference, SURE * f64::from(variance));
    if square > noise { (1.0 - noise / square) as f32 } else { 0.0 }
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
                let variances = PerTexel::new(&variances);
                let light = GatherLight {
                    irradiance: PerTexel::new(&irradiance),
                    variances,
                    unblurred: variances,
                    rays: 64,
                    directional: &[],
                };
                let texels = (0..4).map(|i| (GatherTexel::new(i), weights[i]));
                light.contrast_exceeds(0.3, texels)
            };
            let same = [0.25; 4];
            // Contrasts of 0.29 and 0.31 about a mean of 1.
            assert!(!exceeds([0.71, 1.29, 0.71, 1.29], 0.0, same));
            assert!(exceeds([0.69, 1.31, 0.69, 1.31], 0.0, same));
            assert!(exceeds([0.69, 1.31, 0.69, 1.31], 0.001, same) && !exceeds([0.69, 1.31, 0.69, 1.31], 0.003, same));
            assert!(!exceeds([0.69, 1.31, 0.69, 1.31], f32::INFINITY, same));
            // One that hardly counts.
            assert!(!exceeds([1.0, 1.0, 1.0, 3.0], 0.0, [0.33, 0.33, 0.33, 0.01]));
            assert!(exceeds([1.0, 1.0, 1.0, 3.0], 0.0, [0.3, 0.3, 0.3, 0.1]));
            // Nothing, or only one.
            assert!(!exceeds([0.0; 4], 0.0, same) && !exceeds([1.0, 0.0, 0.0, 0.0], 0.0, [1.0, 0.0, 0.0, 0.0]));
        }
    }

    #[test]
    fn what_differs_by_no_more_than_noise_counts_for_nothing() {
        for scale in [1e-12f32, 1.0, 1e12] {
            let weight = |own: f32, variance: f32| {
                weight_of_own(Vec3::X * own * scale, Vec3::Y * scale, variance * scale * scale)
            };
            assert_eq!((weight(1.0, 0.0), weight(2.0, 0.5), weight(1.5, f32::INFINITY)), (0.0, 0.0, 0.0));
            assert_eq!(weight(0.0, 0.0), 1.0);
            for (own, variance, expected) in [(3.0, 1.0, 0.25), (0.0, 0.125, 0.625), (11.0, 0.5, 0.985)] {
                assert!((weight(own, variance) - expected).abs() < 1e-6);
            }
        }
        assert_eq!(weight_of_own(Vec3::MAX, Vec3::ZERO, f32::NAN), 0.0);
    }
}
