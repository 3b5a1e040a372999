//! Columns, and the balustrade between the upper ones.

use super::measures::{BAY, FLOOR, Palette, RAIL, SIDES, SPRING, UPPER_SPRING, column_axes};
use super::part::{Faces, Part, Shading};
use glam::{Vec2, Vec3};
use std::f32::consts::PI;

/// Columns of both floors; the upper ones stand on the balustrade's pedestals.
pub(super) fn columns(part: &mut Part, p: &Palette) {
    for axis in column_axes() {
        // Plinth, shaft between base and capital, abacus.
        part.block(axis, Vec2::splat(0.34), 0.0, 0.13, Faces::NoBottom, p.stone);
        column_shaft(part, axis, 0.13, SPRING - 0.13, 0.25, p.column);
        part.block(axis, Vec2::splat(0.34), SPRING - 0.13, SPRING, Faces::All, p.stone);

        part.block(axis, Vec2::splat(0.26), FLOOR, RAIL - 0.1, Faces::Sides, p.stone);
        part.block(axis, Vec2::splat(0.30), RAIL - 0.1, RAIL, Faces::All, p.stone);
        column_shaft(part, axis, RAIL, UPPER_SPRING - 0.11, 0.185, p.column);
        part.block(axis, Vec2::splat(0.335), UPPER_SPRING - 0.11, UPPER_SPRING, Faces::All, p.stone);
    }
}

/// Base, shaft and capital of a column whose shaft has the given radius at the bottom.
pub(super) fn column_shaft(part: &mut Part, axis: Vec2, bottom: f32, top: f32, radius: f32, material: u32) {
    const SEGMENTS: usize = 24;
    let r = radius;
    let torus = |y: f32, inner: f32, bulge: f32| -> Vec<[f32; 2]> {
        (0..=4)
            .map(|i| {
                let a = PI * (i as f32 / 4.0 - 0.5);
                [inner + bulge * a.cos(), y + bulge * (1.0 + a.sin())]
            })
            .collect()
    };
    // Attic base: torus, fillet, torus.
    let mut profile = torus(bottom, 1.06 * r, 0.22 * r);
    let mut y = bottom + 0.44 * r;
    profile.extend([[1.02 * r, y + 0.02 * r], [1.02 * r, y + 0.12 * r]]);
    y += 0.14 * r;
    profile.extend(torus(y, 1.02 * r, 0.13 * r));
    part.lathe(axis, &profile, SEGMENTS, material, Shading::Faceted);
    y += 0.26 * r;
    // The shaft, with entasis.
    let capital = top - 1.5 * r;
    let shaft: Vec<[f32; 2]> = (0..=3)
        .map(|i| {
            let t = i as f32 / 3.0;
            [r * (1.0 - 0.16 * t * t), y + (capital - y) * t]
        })
        .collect();
    part.lathe(axis, &[[1.02 * r, y], shaft[0]], SEGMENTS, material, Shading::Smooth);
    part.lathe(axis, &shaft, SEGMENTS, material, Shading::Smooth);
    // Ring and bell.
    let neck = 0.84 * r;
    part.lathe(axis, &torus(capital, neck, 0.09 * r), SEGMENTS, material, Shading::Smooth);
    let y = capital + 0.18 * r;
    let bell: Vec<[f32; 2]> = (0..=4)
        .map(|i| {
            let t = i as f32 / 4.0;
            [neck + 0.42 * r * t * t, y + (top - y) * t]
        })
        .collect();
    part.lathe(axis, &bell, SEGMENTS, material, Shading::Smooth);
}

/// Rails and balusters between the pedestals of the upper floor.
pub(super) fn balustrade(part: &mut Part, p: &Palette) {
    const COUNT: usize = 9;
    for side in SIDES {
        for middle in side.bays() {
            // From pedestal to pedestal.
            let half = BAY / 2.0 - 0.26;
            let bar = |part: &mut Part, half_width: f32, y0: f32, y1: f32, bottom: bool, half: f32| {
                let at = |a: f32, d: f32, y: f32| side.at(middle + half * a, side.axis() + half_width * d, y);
                let mut face = |corners: [[f32; 3]; 4], normal| {
                    part.quad(corners.map(|[a, d, y]| at(a, d, y)), normal, p.stone);
                };
                for d in [-1.0, 1.0] {
                    face([[-1.0, d, y0], [1.0, d, y0], [1.0, d, y1], [-1.0, d, y1]], side.out * d);
                }
                face([[-1.0, -1.0, y1], [1.0, -1.0, y1], [1.0, 1.0, y1], [-1.0, 1.0, y1]], Vec3::Y);
                if bottom {
                    face([[-1.0, -1.0, y0], [1.0, -1.0, y0], [1.0, 1.0, y0], [-1.0, 1.0, y0]], Vec3::NEG_Y);
                }
            };
            bar(part, 0.14, FLOOR, FLOOR + 0.12, false, half);
            bar(part, 0.15, RAIL - 0.1, RAIL, true, BAY / 2.0 - 0.30);
            for i in 0..COUNT {
                let a = middle + half * (2.0 * (i as f32 + 0.5) / COUNT as f32 - 1.0);
                let foot = side.at(a, side.axis(), 0.0);
                baluster(part, Vec2::new(foot.x, foot.z), FLOOR + 0.12, RAIL - 0.1, p.column);
            }
        }
    }
}

pub(super) fn baluster(part: &mut Part, axis: Vec2, bottom: f32, top: f32, material: u32) {
    // Vase and neck: (radius, height as a fraction).
    let profile = [
        (0.075, 0.0),
        (0.06, 0.07),
        (0.045, 0.12),
        (0.078, 0.3),
        (0.07, 0.42),
        (0.042, 0.7),
        (0.04, 0.85),
        (0.07, 1.0),
    ];
    let profile = profile.map(|(r, t)| [r, bottom + (top - bottom) * t]);
    part.lathe(axis, &profile, 10, material, Shading::Smooth);
}
