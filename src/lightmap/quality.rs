//! Qualities: one choice that sets the knobs of light map and bake which trade error for time.
//!
//! Error and time of each on several scenes: docs/accuracy.md#qualities.

use super::{BakeParams, LightmapDesc};

/// A quality, from the fastest to the most accurate.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Quality {
    /// A look within a fraction of the default's time: coarse indirect light, noisy penumbrae.
    Preview,
    /// The defaults.
    #[default]
    Medium,
    /// Final light: finer maps, and corners, gaps and contacts computed instead of looked up.
    High,
    /// Path tracing of every texel without blur: nothing that stays if one pays for more
    /// [passes](BakeParams::passes) or sets a [target](BakeParams::target_error). For comparison.
    Reference,
}

impl Quality {
    /// All qualities and their names, from the fastest.
    pub const ALL: [(Quality, &str); 4] = [
        (Quality::Preview, "preview"),
        (Quality::Medium, "medium"),
        (Quality::High, "high"),
        (Quality::Reference, "reference"),
    ];

    /// Sets the divisors of a light map. All else stays.
    pub fn set_desc(self, desc: &mut LightmapDesc) {
        let default = LightmapDesc::default();
        let (gather, radiance) = match self {
            Quality::Preview => (8, 8),
            Quality::Medium => (default.gather_divisor, default.radiance_divisor),
            Quality::High => (2, 2),
            Quality::Reference => (1, 4),
        };
        (desc.gather_divisor, desc.radiance_divisor) = (gather, radiance);
    }

    /// Sets photons, rays, blur and passes of a bake. All else stays.
    pub fn set_params(self, params: &mut BakeParams) {
        let d = BakeParams::default();
        const NEVER: f32 = f32::INFINITY;
        let (photons, gather, near_hits, (error, contrast), blur, direct, passes) = match self {
            Quality::Preview => (200_000, 32, 0.0, (NEVER, NEVER), 2, 4, 1),
            Quality::Medium => {
                let most = (d.interpolation_error, d.interpolation_contrast);
                (d.photon_count, d.gather_rays, d.near_hits, most, d.blur_radius, d.direct_samples, d.passes)
            }
            Quality::High => (4_000_000, 256, 1.0, (0.5, d.interpolation_contrast), 1, 32, 1),
            Quality::Reference => (0, 256, f32::INFINITY, (NEVER, NEVER), 0, 64, 4),
        };
        params.photon_count = photons;
        params.gather_rays = gather;
        params.near_hits = near_hits;
        params.interpolation_error = error;
        params.interpolation_contrast = contrast;
        params.blur_radius = blur;
        params.direct_samples = direct;
        params.passes = passes;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn qualities_are_valid_and_the_medium_one_is_the_default() {
        for (quality, name) in Quality::ALL {
            let (mut desc, mut params) = (LightmapDesc::default(), BakeParams { seed: 7, ..Default::default() });
            quality.set_desc(&mut desc);
            quality.set_params(&mut params);
            desc.validate().and(params.validate()).unwrap_or_else(|e| panic!("{name}: {e}"));
            assert_eq!(params.seed, 7);
            let is_default = desc == LightmapDesc::default() && BakeParams { seed: 0, ..params } == Default::default();
            assert_eq!(is_default, quality == Quality::default(), "{name}");
        }
    }
}
