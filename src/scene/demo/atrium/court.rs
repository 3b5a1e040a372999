//! What stands in the court: a fountain and planters.

use super::measures::Palette;
use super::part::{Part, Shading};
use glam::Vec2;
use std::f32::consts::PI;

/// A fountain with a sphere in the middle of the court.
pub(super) fn fountain(part: &mut Part, p: &Palette) {
    let axis = Vec2::ZERO;
    let n = 56;
    // Two steps, basin, rim, inside of the basin down to the water.
    let steps = [[1.75, 0.0], [1.75, 0.14], [1.5, 0.14], [1.5, 0.28]];
    part.lathe(axis, &steps, n, p.stone, Shading::Faceted);
    let basin = [[1.5, 0.28], [1.2, 0.28], [1.2, 0.68], [1.26, 0.7], [1.26, 0.78], [1.08, 0.78], [1.08, 0.62]];
    part.lathe(axis, &basin, n, p.column, Shading::Faceted);
    part.lathe(axis, &[[1.08, 0.62], [0.26, 0.62]], n, p.water, Shading::Faceted);
    // Pedestal.
    let foot = [[0.26, 0.62], [0.26, 0.72], [0.2, 0.76]];
    part.lathe(axis, &foot, n, p.stone, Shading::Faceted);
    let vase: Vec<[f32; 2]> = (0..=14)
        .map(|i| {
            let t = i as f32 / 14.0;
            [0.2 - 0.09 * (PI * t).sin() + 0.06 * t * t, 0.76 + 0.7 * t]
        })
        .collect();
    part.lathe(axis, &vase, n, p.column, Shading::Smooth);
    let top = 1.46;
    part.lathe(
        axis,
        &[[0.26, top], [0.3, top + 0.03], [0.3, top + 0.08], [0.14, top + 0.08]],
        n,
        p.stone,
        Shading::Faceted,
    );
    // The sphere rests in the ring where its radius is 0.14.
    let r: f32 = 0.42;
    let centre = top + 0.08 + (r * r - 0.14 * 0.14).sqrt();
    part.lathe(axis, &sphere(r, centre, -(centre - top - 0.08), 28), n, p.bronze, Shading::Smooth);
}

/// Profile of a sphere from the height `from` (relative to its centre) up to the pole.
pub(super) fn sphere(r: f32, centre: f32, from: f32, steps: usize) -> Vec<[f32; 2]> {
    let start = (from / r).clamp(-1.0, 1.0).asin();
    (0..=steps)
        .map(|i| {
            if i == steps {
                return [0.0, centre + r];
            }
            let a = start + (0.5 * PI - start) * i as f32 / steps as f32;
            [r * a.cos(), centre + r * a.sin()]
        })
        .collect()
}

/// Four clay pots with round shrubs in the corners of the court.
pub(super) fn planters(part: &mut Part, p: &Palette) {
    for x in [-1.0, 1.0] {
        for z in [-1.0, 1.0] {
            let axis = Vec2::new(5.6 * x, 1.75 * z);
            let pot = [[0.22, 0.0], [0.24, 0.06], [0.34, 0.5]];
            part.lathe(axis, &pot, 30, p.clay, Shading::Smooth);
            let rim = [[0.34, 0.5], [0.38, 0.5], [0.38, 0.58], [0.32, 0.58], [0.32, 0.53]];
            part.lathe(axis, &rim, 30, p.clay, Shading::Faceted);
            part.lathe(axis, &[[0.32, 0.53], [0.1, 0.53]], 30, p.band, Shading::Faceted);
            let (r, foot): (f32, f32) = (0.46, 0.1);
            let down = (r * r - foot * foot).sqrt();
            part.lathe(axis, &sphere(r, 0.53 + down, -down, 18), 30, p.leaf, Shading::Smooth);
        }
    }
}
