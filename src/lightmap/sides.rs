//! Which side of two-sided charts the light map shows.
//!
//! A texel holds the light of one side. In modelled scenes many two-sided surfaces have their fronts
//! where nobody looks and no light arrives: ceilings that face the roof, sofas turned inside out. So
//! the light of the whole chart on both its sides decides.

use super::charts::Charts;
use super::map::ChartMap;

/// The back is shown if it gets more than this many times the light of the front. Between sides that
/// are both lit the front is preferred: it is what users expect, and it does not change when a light
/// moves a little.
const DARK_FRONT: f64 = 10.0;

/// Per chart, whether its back is baked; empty if no chart has a back. `light` tells how much light a
/// sample of the radiance map gets (any unit).
pub(crate) fn backs(charts: &Charts, radiance: &ChartMap, mut light: impl FnMut(usize) -> f32) -> Vec<bool> {
    if radiance.layout.back_of.is_empty() {
        return Vec::new();
    }
    let mut mean = |placement: u32| {
        let samples = radiance.samples_of(placement);
        let n = samples.len().max(1) as f64;
        samples.map(|s| light(s) as f64).sum::<f64>() / n
    };
    (0..charts.charts.len() as u32)
        .map(|chart| radiance.layout.back(chart).is_some_and(|back| mean(back) > DARK_FRONT * mean(chart)))
        .collect()
}
