//! Samples of light and how those of two strategies are weighed (multiple importance sampling: Veach and Guibas 1995).

use glam::{DVec3, Vec3};

/// A light sample: its effect on a surface element if nothing lies between.
#[derive(Clone, Copy, Debug)]
pub struct Proposal {
    /// Irradiance, weighted by the balance heuristic and divided by the density of the sample.
    pub irradiance: DVec3,
    /// Unit vector towards the light.
    pub direction: DVec3,
    /// Distance of the light; infinite for directional lights.
    pub distance: f64,
}

/// Share of a sample that was found by following a direction of density `by_direction`, when area
/// sampling would have found it with density `by_area`.
pub fn balance(by_direction: f64, by_area: f64) -> f64 {
    by_direction / (by_direction + by_area)
}

/// Sum of the channels, by which random choices are weighted.
pub fn brightness(color: DVec3) -> f64 {
    color.element_sum()
}

pub fn rgb(color: [f32; 3]) -> DVec3 {
    Vec3::from_array(color).as_dvec3()
}
