//! Indirect light: the radiance map, the gather map, and its upsampling to the light map's texels.

pub mod blur;
pub(crate) mod bright_patches;
pub(crate) mod fallback_gather;
pub(crate) mod find_bright_patches;
pub(crate) mod gather;
pub(in crate::lightmap) mod interpolation_contrast;
mod interpolation_error;
mod narrow_gaps;
pub(crate) mod near_hits;
pub(in crate::lightmap) mod probes;
pub(crate) mod radiance_map;
pub(crate) mod sample_set;
mod sights;
pub(crate) mod split_texels;
pub(crate) mod texel_albedo;
mod texel_set;
pub(crate) mod upsample;
mod upsample_visibility;
