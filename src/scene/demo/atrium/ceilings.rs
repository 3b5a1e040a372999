//! The ceilings of the galleries: groin vaults on the ground floor, coffers above.

use super::measures::{ARCADE, BAY, CEILING, COURT, HALL, Palette, SIDES, SPRING, Side, VAULT_RISE, half_circle};
use super::part::Part;
use glam::{Vec2, Vec3};

/// Groin vaults over the ground floor gallery: two crossing barrels per bay. Their webs are pieces
/// of cylinders; on the outer walls they end in lunettes.
pub(super) fn vaults(part: &mut Part, p: &Palette) {
    let gallery = |side: &Side| {
        // From the arcade to the wall.
        let (near, far) = (side.axis() + ARCADE, side.halves(HALL).0);
        (0.5 * (near + far), 0.5 * (far - near))
    };
    for side in SIDES {
        let (depth_middle, depth_half) = gallery(&side);
        for middle in side.bays() {
            let bay = VaultBay { side, middle, half: BAY / 2.0, depth_middle, depth_half };
            bay.webs(part, p.vault);
            bay.lunette(part, p.plaster);
        }
        // The corner bay at the side's end: square, with lunettes on this wall and the next.
        let (half_length, hall_length) = (side.halves(COURT).1 + ARCADE, side.halves(HALL).1);
        let (middle, half) = (0.5 * (half_length + hall_length), 0.5 * (hall_length - half_length));
        let corner = VaultBay { side, middle, half, depth_middle, depth_half };
        corner.webs(part, p.vault);
        corner.lunette(part, p.plaster);
        VaultBay { middle: -middle, ..corner }.lunette(part, p.plaster);
        // Bands of barrel between the straight bays and the corners.
        for end in [-1.0, 1.0] {
            let profile = |a: f32| -> Vec<Vec3> {
                let at = |[c, s]: [f32; 2]| side.at(a, depth_middle + depth_half * c, SPRING + VAULT_RISE * s);
                half_circle().into_iter().map(at).collect()
            };
            let normals: Vec<Vec3> = half_circle()
                .into_iter()
                .map(|[c, s]| -(side.out * c / depth_half + Vec3::Y * s / VAULT_RISE).normalize())
                .collect();
            let axis = side.halves(COURT).1;
            part.strip(&profile(end * axis), &profile(end * (axis + ARCADE)), &normals, p.vault);
        }
    }
}

/// One bay of a groin vault.
pub(super) struct VaultBay {
    side: Side,
    /// Middle along the side.
    middle: f32,
    half: f32,
    /// Middle across the side.
    depth_middle: f32,
    depth_half: f32,
}

impl VaultBay {
    /// A point of the bay at u, v in [−1, 1] along and across, at relative height h.
    fn at(&self, u: f32, v: f32, h: f32) -> Vec3 {
        self.side.at(self.middle + self.half * u, self.depth_middle + self.depth_half * v, SPRING + VAULT_RISE * h)
    }

    /// The four webs. The web towards v = ±1 is part of the barrel that runs across: its height
    /// depends on u alone and it reaches from the groin |v| = |u| to the edge.
    fn webs(&self, part: &mut Part, material: u32) {
        let arc = half_circle();
        for sign in [-1.0, 1.0] {
            let groin: Vec<Vec3> = arc.iter().map(|&[c, s]| self.at(c, sign * c.abs(), s)).collect();
            let edge: Vec<Vec3> = arc.iter().map(|&[c, s]| self.at(c, sign, s)).collect();
            let normal = |[c, s]: [f32; 2]| -(self.side.along * c / self.half + Vec3::Y * s / VAULT_RISE).normalize();
            part.strip(&groin, &edge, &arc.iter().map(|&cs| normal(cs)).collect::<Vec<_>>(), material);

            let groin: Vec<Vec3> = arc.iter().map(|&[c, s]| self.at(sign * c.abs(), c, s)).collect();
            let edge: Vec<Vec3> = arc.iter().map(|&[c, s]| self.at(sign, c, s)).collect();
            let normal =
                |[c, s]: [f32; 2]| -(self.side.out * c / self.depth_half + Vec3::Y * s / VAULT_RISE).normalize();
            part.strip(&groin, &edge, &arc.iter().map(|&cs| normal(cs)).collect::<Vec<_>>(), material);
        }
    }

    /// The piece of outer wall under the vault.
    fn lunette(&self, part: &mut Part, material: u32) {
        let arc = half_circle();
        let above: Vec<Vec3> = arc.iter().map(|&[c, s]| self.at(c, 1.0, s)).collect();
        let below: Vec<Vec3> = arc.iter().map(|&[c, _]| self.at(c, 1.0, 0.0)).collect();
        part.strip(&below, &above, &vec![-self.side.out; arc.len()], material);
    }
}

/// The ceiling of the upper gallery: a grid of ribs with sunk panels.
pub(super) fn coffers(part: &mut Part, p: &Palette) {
    const RIB: f32 = 0.25;
    const DEPTH: f32 = 0.2;
    // Lines of ribs and coffers by turns: rib, coffer, …, rib over the gallery's width; between the
    // corners coffer, rib, …, coffer. Odd intervals are coffers.
    let lines = |hall: f32, axis: f32, n: usize| -> Vec<f32> {
        let outer = axis + ARCADE;
        let coffer = (hall - outer - 3.0 * RIB) / 2.0;
        let mut half = vec![outer, outer + RIB, outer + RIB + coffer, hall - RIB - coffer, hall - RIB, hall];
        let mut lines: Vec<f32> = half.iter().rev().map(|l| -l).collect();
        let width = (2.0 * outer - (n - 1) as f32 * RIB) / n as f32;
        for i in 1..n {
            let start = -outer + i as f32 * (width + RIB);
            lines.extend([start - RIB, start]);
        }
        lines.append(&mut half);
        lines
    };
    let xs = lines(HALL.x, COURT.x, 12);
    let zs = lines(HALL.y, COURT.y, 5);
    let over_court = |i: usize, j: usize| {
        let middle = Vec2::new(xs[i] + xs[i + 1], zs[j] + zs[j + 1]).abs() * 0.5;
        middle.x < COURT.x + ARCADE && middle.y < COURT.y + ARCADE
    };
    for i in 0..xs.len() - 1 {
        for j in 0..zs.len() - 1 {
            if over_court(i, j) {
                continue;
            }
            let at = |i: usize, j: usize, y: f32| Vec3::new(xs[i], y, zs[j]);
            let corners = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)];
            if i % 2 == 0 || j % 2 == 0 {
                part.quad(corners.map(|(i, j)| at(i, j, CEILING)), Vec3::NEG_Y, p.rib);
                continue;
            }
            part.quad(corners.map(|(i, j)| at(i, j, CEILING + DEPTH)), Vec3::NEG_Y, p.panel);
            let middle = 0.5 * (at(i, j, CEILING) + at(i + 1, j + 1, CEILING));
            let upper = |i, j| at(i, j, CEILING + DEPTH);
            for k in 0..4 {
                let ((i0, j0), (i1, j1)) = (corners[k], corners[(k + 1) % 4]);
                let (a, b) = (at(i0, j0, CEILING), at(i1, j1, CEILING));
                part.quad([a, b, upper(i1, j1), upper(i0, j0)], middle - 0.5 * (a + b), p.rib);
            }
        }
    }
}
