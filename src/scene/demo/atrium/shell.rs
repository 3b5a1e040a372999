//! The outer walls of the atrium with roof and parapet, and its floors.

use super::measures::{
    ARCADE, BAY, CEILING, COURT, FLOOR, HALL, PARAPET, Palette, ROOF, SIDES, SPRING, WALL_THICKNESS, inset,
};
use super::part::Part;
use glam::{Vec2, Vec3};

/// Outer walls with pilasters, mouldings, cornices, roof and parapet.
pub(super) fn shell(part: &mut Part, p: &Palette) {
    const PILASTER: f32 = 0.07;
    // Ground floor: dado, wall, moulding at the springing of the vaults.
    pilaster_walls(part, PILASTER, &[(0.0, p.dado), (1.1, p.ochre), (SPRING - 0.14, p.ochre)]);
    part.sweep(HALL, &[(0.0, SPRING - 0.14), (0.09, SPRING - 0.14), (0.11, SPRING)], p.stone);
    part.sweep(HALL, &[(0.11, SPRING), (0.0, SPRING)], p.stone);
    // Upper floor: dado, wall, cornice below the coffers.
    pilaster_walls(part, PILASTER, &[(FLOOR, p.dado), (FLOOR + 0.95, p.plaster), (CEILING - 0.3, p.plaster)]);
    part.sweep(HALL, &[(0.0, CEILING - 0.3), (0.1, CEILING - 0.3), (0.18, CEILING)], p.stone);

    // Court side: the cornice in front of the upper floor, the one below the parapet, the parapet.
    let court = inset(COURT, ARCADE);
    let cornice = [(0.0, FLOOR - 0.34), (0.04, FLOOR - 0.32), (0.06, FLOOR - 0.2), (0.13, FLOOR - 0.14), (0.15, FLOOR)];
    part.sweep(court, &cornice, p.stone);
    part.sweep(court, &[(0.15, FLOOR), (0.0, FLOOR)], p.stone);
    part.sweep(court, &[(0.0, CEILING), (0.05, CEILING + 0.02), (0.12, CEILING + 0.2), (0.14, CEILING + 0.3)], p.stone);
    part.sweep(court, &[(0.14, CEILING + 0.3), (0.0, CEILING + 0.3)], p.stone);
    part.sweep(court, &[(0.0, CEILING + 0.3), (0.0, PARAPET)], p.plaster);
    part.sweep(court, &[(0.0, PARAPET), (-2.0 * ARCADE, PARAPET)], p.stone);
    part.sweep(court, &[(-2.0 * ARCADE, PARAPET), (-2.0 * ARCADE, ROOF)], p.plaster);
    // Roof and outside.
    let outside = inset(HALL, -WALL_THICKNESS);
    part.ring(ROOF, inset(COURT, -ARCADE), outside, p.roof);
    part.sweep(outside, &[(0.0, ROOF), (0.0, 0.0)], p.plaster);
}

/// The outer walls of one floor from inside, in bands of (lower edge, material); the last entry
/// gives the upper edge. At each column axis a pilaster of the given depth.
pub(super) fn pilaster_walls(part: &mut Part, depth: f32, bands: &[(f32, u32)]) {
    for side in SIDES {
        let (distance, half) = side.halves(HALL);
        // (along, inset, direction that the face towards the next point looks at)
        let mut plan = vec![(-half, 0.0, -side.out)];
        let axes = if side.long { 6 } else { 3 };
        for i in 0..axes {
            let a = BAY * (i as f32 - 0.5 * (axes - 1) as f32);
            let (left, right) = (a - 0.26, a + 0.26);
            plan.extend([
                (left, 0.0, -side.along),
                (left, depth, -side.out),
                (right, depth, side.along),
                (right, 0.0, -side.out),
            ]);
        }
        plan.push((half, 0.0, Vec3::ZERO));
        for ends in plan.windows(2) {
            let [(a0, d0, normal), (a1, d1, _)] = [ends[0], ends[1]];
            for band in bands.windows(2) {
                let [(y0, material), (y1, _)] = [band[0], band[1]];
                let at = |a, d, y| side.at(a, distance - d, y);
                part.quad([at(a0, d0, y0), at(a1, d1, y0), at(a1, d1, y1), at(a0, d0, y1)], normal, material);
            }
        }
    }
}

/// Builds both floors, as checkers of flush quads that share their vertices.
pub(super) fn floors(part: &mut Part, p: &Palette) {
    let steps = |from: f32, to: f32, n: usize| (0..n).map(move |i| from + (to - from) * i as f32 / n as f32);
    // Grid lines: tiles in the gallery, a band under the arcade, tiles in the court, and back.
    let lines = |hall: f32, axis: f32, court_tiles: usize| -> Vec<f32> {
        let (inner, outer) = (axis - ARCADE, axis + ARCADE);
        steps(-hall, -outer, 4)
            .chain([-outer])
            .chain(steps(-inner, inner, court_tiles))
            .chain([inner])
            .chain(steps(outer, hall, 4))
            .chain([hall])
            .collect()
    };
    let xs = lines(HALL.x, COURT.x, 18);
    let zs = lines(HALL.y, COURT.y, 7);
    for (y, upper) in [(0.0, false), (FLOOR, true)] {
        let material = |i: usize, j: usize| {
            let middle = Vec2::new(xs[i] + xs[i + 1], zs[j] + zs[j + 1]).abs() * 0.5;
            let (inner, outer) = (inset(COURT, ARCADE), inset(COURT, -ARCADE));
            if middle.x < inner.x && middle.y < inner.y {
                return if upper { None } else { Some([p.tile_light, p.tile_dark][(i + j) % 2]) };
            }
            let gallery = middle.x > outer.x || middle.y > outer.y;
            let straight = middle.x < inner.x || middle.y < inner.y || middle.x > outer.x && middle.y > outer.y;
            Some(match (gallery, straight) {
                (false, _) => p.band,
                (true, true) => [p.tile_light, p.tile_dark][(i + j) % 2],
                (true, false) => p.stone,
            })
        };
        for i in 0..xs.len() - 1 {
            for j in 0..zs.len() - 1 {
                if let Some(m) = material(i, j) {
                    let at = |i: usize, j: usize| Vec3::new(xs[i], y, zs[j]);
                    part.quad([at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)], Vec3::Y, m);
                }
            }
        }
    }
}
