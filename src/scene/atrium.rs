//! The built-in atrium: a daylit court between two floors of galleries, made by code.
//!
//! All lengths are metres, y is up. The court lies along x, open to the sky. Round it run arcades of
//! columns and round arches; behind them a ground floor gallery under groin vaults and an upper
//! gallery under a coffered ceiling, with a balustrade and drapes between the columns. A large blue
//! rect light above the opening stands for the sky, a directional light for the sun.
//!
//! What the light map asks of it: flat faces are few and big, curved ones are smooth strips without
//! stretch (vault webs and arch soffits are developable); edges where parts meet hide under
//! mouldings; walls are 0.3 m thick or more, so that no light gets round the back of a face; every
//! one-sided face is seen from its front alone. Faces on which something stands (floors under
//! columns) run on below it: those texels are dark and hidden.

use super::{Camera, Light, Material, Mesh, MeshMaterials, SceneData};
use crate::error::Result;
use glam::{Vec2, Vec3};
use std::collections::HashMap;
use std::f32::consts::{PI, TAU};

/// Half the inner length and width of the building: inner faces of its outer walls.
const HALL: Vec2 = Vec2::new(10.0, 5.8);
/// Half the length and width between the column axes round the court.
const COURT: Vec2 = Vec2::new(7.0, 2.8);
/// Outer walls.
const WALL_THICKNESS: f32 = 0.3;
/// Half the thickness of the arcade walls, which stand on the column axes.
const ARCADE: f32 = 0.25;
/// Distance between column axes.
const BAY: f32 = 2.8;
/// Inner radius of the arches.
const ARCH_RADIUS: f32 = 1.08;
/// Where arches and vaults of the ground floor spring.
const SPRING: f32 = 2.9;
/// Height of the vaults above their springing: half a bay, so that they are round along the arcade.
const VAULT_RISE: f32 = BAY / 2.0;
/// Top of the upper floor.
const FLOOR: f32 = 4.8;
/// Top of the balustrade.
const RAIL: f32 = 5.75;
/// Where the arches of the upper floor spring.
const UPPER_SPRING: f32 = 7.6;
/// The upper gallery's ceiling.
const CEILING: f32 = 9.0;
/// Top of the roof.
const ROOF: f32 = 9.4;
/// Top of the parapet round the opening.
const PARAPET: f32 = 9.8;
/// Steps of a half circle in arches and vaults. Even, so that the crown is a vertex.
const ARC_STEPS: usize = 28;

/// The atrium with its two lights: about 98,000 triangles.
pub fn atrium() -> Result<SceneData> {
    let mut scene = SceneData::new();
    let p = Palette::new(&mut scene)?;
    for build in [shell, floors, arcades, vaults, coffers, columns, balustrade, drapes, fountain, planters] {
        let mut part = Part::default();
        build(&mut part, &p);
        scene.add_mesh(part.into_mesh())?;
    }
    // The sky: a little larger than the opening and well above it, so that no wall comes close.
    let (x, z) = (COURT.x + ARCADE, COURT.y + ARCADE);
    scene.add_light(Light::Rect {
        position: Vec3::new(-x, PARAPET + 0.7, -z),
        edge_u: Vec3::new(2.0 * x, 0.0, 0.0),
        edge_v: Vec3::new(0.0, 0.0, 2.0 * z),
        radiance: [3.2, 4.0, 5.2],
    })?;
    scene.add_light(Light::Directional { direction: SUN, irradiance: [44.0, 37.5, 28.0], angular_radius: 0.0 })?;
    Ok(scene)
}

/// The way that sunlight travels.
const SUN: Vec3 = Vec3::new(0.45, -1.0, 0.36);

/// A view from the upper floor at one end, along the court and down into it.
pub fn atrium_camera() -> Camera {
    Camera {
        position: Vec3::new(-6.45, 6.0, -1.4),
        target: Vec3::new(1.5, 3.7, 0.8),
        up: Vec3::Y,
        fov_y: 62f32.to_radians(),
    }
}

/// Material numbers.
struct Palette {
    plaster: u32,
    ochre: u32,
    dado: u32,
    stone: u32,
    column: u32,
    vault: u32,
    tile_light: u32,
    tile_dark: u32,
    band: u32,
    rib: u32,
    panel: u32,
    roof: u32,
    red: u32,
    blue: u32,
    green: u32,
    bronze: u32,
    water: u32,
    clay: u32,
    leaf: u32,
}

impl Palette {
    fn new(scene: &mut SceneData) -> Result<Palette> {
        let mut add =
            |r, g, b, two_sided| scene.add_material(Material { albedo: [r, g, b], two_sided, ..Default::default() });
        Ok(Palette {
            plaster: add(0.74, 0.66, 0.53, false)?,
            ochre: add(0.70, 0.52, 0.34, false)?,
            dado: add(0.44, 0.25, 0.17, false)?,
            stone: add(0.68, 0.60, 0.48, false)?,
            column: add(0.72, 0.66, 0.56, false)?,
            vault: add(0.76, 0.71, 0.62, false)?,
            tile_light: add(0.66, 0.58, 0.47, false)?,
            tile_dark: add(0.36, 0.23, 0.17, false)?,
            band: add(0.24, 0.18, 0.15, false)?,
            rib: add(0.46, 0.30, 0.18, false)?,
            panel: add(0.24, 0.33, 0.48, false)?,
            roof: add(0.45, 0.42, 0.40, false)?,
            red: add(0.58, 0.06, 0.05, true)?,
            blue: add(0.06, 0.13, 0.48, true)?,
            green: add(0.07, 0.34, 0.12, true)?,
            bronze: add(0.62, 0.42, 0.16, false)?,
            water: add(0.14, 0.30, 0.34, false)?,
            clay: add(0.58, 0.28, 0.16, false)?,
            leaf: add(0.10, 0.24, 0.06, false)?,
        })
    }
}

/// One side of a rectangle round the court.
#[derive(Clone, Copy)]
struct Side {
    /// From the court to the gallery, horizontally.
    out: Vec3,
    /// Along the side.
    along: Vec3,
    /// Whether it is one of the two long sides.
    long: bool,
}

const SIDES: [Side; 4] = [
    Side { out: Vec3::Z, along: Vec3::X, long: true },
    Side { out: Vec3::X, along: Vec3::NEG_Z, long: false },
    Side { out: Vec3::NEG_Z, along: Vec3::NEG_X, long: true },
    Side { out: Vec3::NEG_X, along: Vec3::Z, long: false },
];

impl Side {
    /// Half lengths of a rectangle: (this side's distance from the middle, half this side's length).
    fn halves(&self, rectangle: Vec2) -> (f32, f32) {
        if self.long { (rectangle.y, rectangle.x) } else { (rectangle.x, rectangle.y) }
    }

    /// A point `a` along the side, `d` outwards from the middle of the court.
    fn at(&self, a: f32, d: f32, y: f32) -> Vec3 {
        self.along * a + self.out * d + Vec3::Y * y
    }

    /// Distance of the column axes from the middle.
    fn axis(&self) -> f32 {
        self.halves(COURT).0
    }

    /// Middles of the bays along the side.
    fn bays(&self) -> impl Iterator<Item = f32> {
        let n = if self.long { 5 } else { 2 };
        (0..n).map(move |i| BAY * (i as f32 - 0.5 * (n - 1) as f32))
    }
}

/// A rectangle shrunk by `inset` on all sides.
fn inset(rectangle: Vec2, inset: f32) -> Vec2 {
    rectangle - Vec2::splat(inset)
}

/// cos and sin over a half circle from π to 0, exactly symmetric so that neighbours meet exactly.
fn half_circle() -> Vec<[f32; 2]> {
    let half = ARC_STEPS / 2;
    let quarter = |i: usize| {
        let angle = 0.5 * PI * i as f32 / half as f32;
        if i == half { [0.0, 1.0] } else { [angle.cos(), angle.sin()] }
    };
    let left = (0..half).map(quarter).map(|[c, s]| [-c, s]);
    left.chain((0..=half).rev().map(quarter)).collect()
}

/// Outer walls with pilasters, mouldings, cornices, roof and parapet.
fn shell(part: &mut Part, p: &Palette) {
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
fn pilaster_walls(part: &mut Part, depth: f32, bands: &[(f32, u32)]) {
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

/// Both floors, as checkers of flush quads that share their vertices.
fn floors(part: &mut Part, p: &Palette) {
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

/// The walls over the columns, with their arches.
fn arcades(part: &mut Part, p: &Palette) {
    for side in SIDES {
        let (axis, half) = side.halves(COURT);
        for middle in side.bays() {
            for (spring, top, upper) in [(SPRING, FLOOR - 0.34, false), (UPPER_SPRING, CEILING, true)] {
                let arch = Arch { side, middle, spring };
                // Half a bay to each side; at the ends only as far as the wall round the corner.
                let limits = |end: f32| {
                    let clip = |a: f32| if a.abs() > half - 0.01 { end.copysign(a) } else { a };
                    [clip(middle - BAY / 2.0), clip(middle + BAY / 2.0)]
                };
                arch.spandrel(part, axis - ARCADE, -side.out, limits(half - ARCADE), top, p.plaster);
                if upper {
                    arch.spandrel(part, axis + ARCADE, side.out, limits(half + ARCADE), top, p.plaster);
                } else {
                    arch.ring(part, axis + ARCADE, side.out, BAY / 2.0, p.plaster);
                }
                arch.soffit(part, axis - ARCADE, axis + ARCADE, p.stone);
            }
        }
    }
}

/// A round arch of [`ARCH_RADIUS`] in the arcade of a side.
struct Arch {
    side: Side,
    middle: f32,
    spring: f32,
}

impl Arch {
    /// A point on the arch scaled to `radius`, `d` from the middle of the court.
    fn at(&self, [c, s]: [f32; 2], radius: f32, d: f32) -> Vec3 {
        self.side.at(self.middle + radius * c, d, self.spring + radius * s)
    }

    /// The face at distance `d` from the arch up to `top`, between `limits` along the side.
    fn spandrel(&self, part: &mut Part, d: f32, normal: Vec3, limits: [f32; 2], top: f32, material: u32) {
        let mut below: Vec<Vec3> = half_circle().into_iter().map(|cs| self.at(cs, ARCH_RADIUS, d)).collect();
        below.insert(0, self.side.at(limits[0], d, self.spring));
        below.push(self.side.at(limits[1], d, self.spring));
        let above = below.iter().map(|b| Vec3::new(b.x, top, b.z)).collect::<Vec<_>>();
        part.strip(&below, &above, &vec![normal; below.len()], material);
    }

    /// The face at distance `d` between the arch and a concentric one of `radius`.
    fn ring(&self, part: &mut Part, d: f32, normal: Vec3, radius: f32, material: u32) {
        let inner: Vec<Vec3> = half_circle().into_iter().map(|cs| self.at(cs, ARCH_RADIUS, d)).collect();
        let outer: Vec<Vec3> = half_circle().into_iter().map(|cs| self.at(cs, radius, d)).collect();
        part.strip(&inner, &outer, &vec![normal; inner.len()], material);
    }

    /// The underside of the arch.
    fn soffit(&self, part: &mut Part, from: f32, to: f32, material: u32) {
        let near: Vec<Vec3> = half_circle().into_iter().map(|cs| self.at(cs, ARCH_RADIUS, from)).collect();
        let far: Vec<Vec3> = half_circle().into_iter().map(|cs| self.at(cs, ARCH_RADIUS, to)).collect();
        let normals: Vec<Vec3> = half_circle().into_iter().map(|[c, s]| -(self.side.along * c + Vec3::Y * s)).collect();
        part.strip(&near, &far, &normals, material);
    }
}

/// Groin vaults over the ground floor gallery: two crossing barrels per bay. Their webs are pieces
/// of cylinders; on the outer walls they end in lunettes.
fn vaults(part: &mut Part, p: &Palette) {
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
struct VaultBay {
    side: Side,
    /// Along the side.
    middle: f32,
    half: f32,
    /// Across it.
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
fn coffers(part: &mut Part, p: &Palette) {
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

/// Column axes: (x, z).
fn column_axes() -> Vec<Vec2> {
    let mut axes = Vec::new();
    for i in 0..6 {
        let x = BAY * (i as f32 - 2.5);
        axes.extend([Vec2::new(x, COURT.y), Vec2::new(x, -COURT.y)]);
    }
    axes.extend([Vec2::new(COURT.x, 0.0), Vec2::new(-COURT.x, 0.0)]);
    axes
}

/// Columns of both floors; the upper ones stand on the balustrade's pedestals.
fn columns(part: &mut Part, p: &Palette) {
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
fn column_shaft(part: &mut Part, axis: Vec2, bottom: f32, top: f32, radius: f32, material: u32) {
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
fn balustrade(part: &mut Part, p: &Palette) {
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

fn baluster(part: &mut Part, axis: Vec2, bottom: f32, top: f32, material: u32) {
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

/// How a drape hangs.
#[derive(Clone, Copy)]
enum Hang {
    /// Across the bay.
    Full,
    /// In two halves, tied back to the columns.
    Tied,
}

/// Cloth between the upper columns, on rods.
fn drapes(part: &mut Part, p: &Palette) {
    let colours = [p.red, p.blue, p.green];
    for (s, side) in SIDES.into_iter().enumerate() {
        for (b, middle) in side.bays().enumerate() {
            let hang = match (side.long, b) {
                (true, 0 | 4) => Hang::Tied,
                (true, 2) => Hang::Full,
                (false, _) => Hang::Tied,
                _ if s == 0 => Hang::Full,
                _ => continue,
            };
            let colour = colours[(b + s) % 3];
            let d = side.axis() + 0.25;
            rod(
                part,
                side,
                [middle - BAY / 2.0 + 0.335, middle + BAY / 2.0 - 0.335],
                d,
                UPPER_SPRING - 0.055,
                p.bronze,
            );
            match hang {
                Hang::Full => Drape { side, d, from: middle - 0.98, to: middle + 0.98, tie: None }.build(part, colour),
                Hang::Tied => {
                    for sign in [-1.0, 1.0] {
                        let (from, to) = (middle + sign * 1.02, middle + sign * 0.06);
                        Drape { side, d, from, to, tie: Some(0.34) }.build(part, colour);
                    }
                }
            }
        }
    }
}

/// A horizontal rod between two abaci.
fn rod(part: &mut Part, side: Side, [from, to]: [f32; 2], d: f32, y: f32, material: u32) {
    const SEGMENTS: usize = 10;
    let ring: Vec<Vec3> = (0..=SEGMENTS)
        .map(|i| {
            let (sin, cos) = (TAU * (i % SEGMENTS) as f32 / SEGMENTS as f32).sin_cos();
            side.out * cos + Vec3::Y * sin
        })
        .collect();
    let circle = |a: f32| -> Vec<Vec3> { ring.iter().map(|r| side.at(a, d, y) + 0.018 * r).collect() };
    part.strip(&circle(from), &circle(to), &ring, material);
}

/// A sheet with vertical folds.
struct Drape {
    side: Side,
    /// Distance from the middle of the court.
    d: f32,
    /// Along the side, at the rod: the fixed edge and the free one.
    from: f32,
    to: f32,
    /// Width at the tie, as a fraction; `None`: it hangs free.
    tie: Option<f32>,
}

impl Drape {
    /// A point of the sheet: s in [0, 1] from the fixed edge, t in [0, 1] downwards.
    fn at(&self, s: f32, t: f32) -> Vec3 {
        let (top, bottom) = (UPPER_SPRING - 0.08, FLOOR + 0.06);
        let smooth = |x: f32| x.clamp(0.0, 1.0).powi(2) * (3.0 - 2.0 * x.clamp(0.0, 1.0));
        let width = match self.tie {
            None => 1.0,
            // Tied at 55 % of its height, half free again below.
            Some(w) if t < 0.55 => 1.0 + (w - 1.0) * smooth(t / 0.55),
            Some(w) => w + 0.16 * smooth((t - 0.55) / 0.3),
        };
        let folds = ((self.to - self.from).abs() * 3.2).round();
        let phase = TAU * folds * s + 0.7 * (3.0 * t + 5.0 * s).sin();
        // Gathered at the rod, deeper folds below; where the cloth is drawn together there are more
        // of them to the metre, so they are shallower.
        let depth = (0.03 + 0.03 * smooth(t / 0.4)) * (0.1 + 0.9 * width);
        let hem = if self.tie.is_some() { 0.0 } else { 0.02 * phase.cos() * t };
        let along = self.from + (self.to - self.from) * width * s;
        self.side.at(along, self.d + depth * phase.sin(), top + (bottom - top) * t + hem)
    }

    /// Unit normal of the front, which looks into the court.
    fn normal(&self, s: f32, t: f32) -> Vec3 {
        const STEP: f32 = 1e-3;
        let n = (self.at(s + STEP, t) - self.at(s - STEP, t)).cross(self.at(s, t + STEP) - self.at(s, t - STEP));
        (n * -n.dot(self.side.out).signum()).normalize()
    }

    fn build(&self, part: &mut Part, material: u32) {
        let (columns, rows) = (((self.to - self.from).abs() * 34.0).round() as usize, 14);
        let row = |j: usize| -> (Vec<Vec3>, Vec<Vec3>) {
            let t = j as f32 / rows as f32;
            (0..=columns).map(|i| i as f32 / columns as f32).map(|s| (self.at(s, t), self.normal(s, t))).unzip()
        };
        for j in 0..rows {
            let ((a, na), (b, nb)) = (row(j), row(j + 1));
            part.curved_strip(&a, &b, &na, &nb, material);
        }
    }
}

/// A fountain with a sphere in the middle of the court.
fn fountain(part: &mut Part, p: &Palette) {
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
fn sphere(r: f32, centre: f32, from: f32, steps: usize) -> Vec<[f32; 2]> {
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
fn planters(part: &mut Part, p: &Palette) {
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

/// Which faces a block has.
#[derive(Clone, Copy, PartialEq)]
enum Faces {
    All,
    NoBottom,
    Sides,
}

/// Normals of a lathed surface.
#[derive(Clone, Copy, PartialEq)]
enum Shading {
    /// Smooth round the axis and along the profile.
    Smooth,
    /// Smooth round the axis, hard edges between the profile's pieces.
    Faceted,
}

/// A mesh being built. Every face is given with the direction that it looks in, and is wound to
/// match.
#[derive(Default)]
struct Part {
    positions: Vec<Vec3>,
    normals: Vec<Vec3>,
    indices: Vec<[u32; 3]>,
    materials: Vec<u32>,
    /// Vertices by the bits of position and normal: faces that meet share them.
    known: HashMap<[u32; 6], u32>,
}

impl Part {
    fn vertex(&mut self, position: Vec3, normal: Vec3) -> u32 {
        // Adding zero makes -0 and 0 the same.
        let (p, n) = (position + Vec3::ZERO, normal + Vec3::ZERO);
        let key = [p.x, p.y, p.z, n.x, n.y, n.z].map(f32::to_bits);
        *self.known.entry(key).or_insert_with(|| {
            self.positions.push(p);
            self.normals.push(n);
            self.positions.len() as u32 - 1
        })
    }

    /// A triangle, wound so that it looks the way its vertices' normals do. One without area is left out.
    fn triangle(&mut self, corners: [(Vec3, Vec3); 3], material: u32) {
        let [(a, na), (b, nb), (c, nc)] = corners;
        let cross = (b - a).as_dvec3().cross((c - a).as_dvec3());
        // Smaller than a hundredth of a square millimetre: the tip of a strip.
        if cross.length() < 1e-8 {
            return;
        }
        let flip = cross.dot((na + nb + nc).as_dvec3()) < 0.0;
        let [i, j, k] = corners.map(|(p, n)| self.vertex(p, n));
        self.indices.push(if flip { [i, k, j] } else { [i, j, k] });
        self.materials.push(material);
    }

    /// A flat quadrilateral, corners in either order round it, that looks towards `normal`.
    fn quad(&mut self, corners: [Vec3; 4], normal: Vec3, material: u32) {
        let normal = normal.normalize();
        let [a, b, c, d] = corners.map(|p| (p, normal));
        self.triangle([a, b, c], material);
        self.triangle([a, c, d], material);
    }

    /// The band between two polylines of equal length, with a normal per step.
    fn strip(&mut self, a: &[Vec3], b: &[Vec3], normals: &[Vec3], material: u32) {
        self.curved_strip(a, b, normals, normals, material);
    }

    /// The band between two polylines of equal length, with a normal per point.
    fn curved_strip(&mut self, a: &[Vec3], b: &[Vec3], na: &[Vec3], nb: &[Vec3], material: u32) {
        for i in 0..a.len() - 1 {
            let j = i + 1;
            self.triangle([(a[i], na[i]), (b[i], nb[i]), (b[j], nb[j])], material);
            self.triangle([(a[i], na[i]), (b[j], nb[j]), (a[j], na[j])], material);
        }
    }

    /// A profile of (inset, height) carried round a rectangle with mitred corners. It looks to the
    /// left of the profile's way when inwards is to the left of upwards: upwards along a wall, it
    /// looks inwards.
    fn sweep(&mut self, rectangle: Vec2, profile: &[(f32, f32)], material: u32) {
        for side in SIDES {
            for ends in profile.windows(2) {
                let [(d0, y0), (d1, y1)] = [ends[0], ends[1]];
                let at = |end: f32, d: f32, y: f32| {
                    let (distance, half) = side.halves(inset(rectangle, d));
                    side.at(end * half, distance, y)
                };
                let normal = -side.out * (y1 - y0) + Vec3::Y * (d0 - d1);
                self.quad([at(-1.0, d0, y0), at(1.0, d0, y0), at(1.0, d1, y1), at(-1.0, d1, y1)], normal, material);
            }
        }
    }

    /// A flat ring between two rectangles that looks up.
    fn ring(&mut self, y: f32, inner: Vec2, outer: Vec2, material: u32) {
        for side in SIDES {
            let at = |end: f32, rectangle: Vec2| {
                let (distance, half) = side.halves(rectangle);
                side.at(end * half, distance, y)
            };
            self.quad([at(-1.0, inner), at(1.0, inner), at(1.0, outer), at(-1.0, outer)], Vec3::Y, material);
        }
    }

    /// An upright box around an axis.
    fn block(&mut self, axis: Vec2, half: Vec2, y0: f32, y1: f32, faces: Faces, material: u32) {
        let at = |x: f32, z: f32, y: f32| Vec3::new(axis.x + half.x * x, y, axis.y + half.y * z);
        for (x, z) in [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)] {
            let normal = Vec3::new(x, 0.0, z);
            let [(x0, z0), (x1, z1)] = [(x - z, z - x), (x + z, z + x)];
            self.quad([at(x0, z0, y0), at(x1, z1, y0), at(x1, z1, y1), at(x0, z0, y1)], normal, material);
        }
        let square = |y: f32| [at(-1.0, -1.0, y), at(1.0, -1.0, y), at(1.0, 1.0, y), at(-1.0, 1.0, y)];
        if faces != Faces::Sides {
            self.quad(square(y1), Vec3::Y, material);
        }
        if faces == Faces::All {
            self.quad(square(y0), Vec3::NEG_Y, material);
        }
    }

    /// A profile of (radius, height) turned round a vertical axis. It looks outwards where the
    /// profile runs upwards, and up where it runs inwards.
    fn lathe(&mut self, axis: Vec2, profile: &[[f32; 2]], segments: usize, material: u32, shading: Shading) {
        let along = |a: [f32; 2], b: [f32; 2]| Vec2::new(b[1] - a[1], a[0] - b[0]).normalize();
        let last = profile.len() - 1;
        // Normals (outward, up) at both ends of each piece of the profile.
        let normals = |i: usize| {
            let flat = along(profile[i], profile[i + 1]);
            if shading == Shading::Faceted {
                return [flat, flat];
            }
            let at = |k: usize| {
                let before = if k > 0 { along(profile[k - 1], profile[k]) } else { flat };
                let after = if k < last { along(profile[k], profile[k + 1]) } else { flat };
                (before + after).normalize()
            };
            [at(i), at(i + 1)]
        };
        let directions: Vec<Vec2> = (0..=segments)
            .map(|s| {
                let (sin, cos) = (TAU * (s % segments) as f32 / segments as f32).sin_cos();
                Vec2::new(cos, sin)
            })
            .collect();
        for i in 0..last {
            let [n0, n1] = normals(i);
            let row = |[r, y]: [f32; 2], n: Vec2| -> (Vec<Vec3>, Vec<Vec3>) {
                let turn =
                    |d: &Vec2| (Vec3::new(axis.x + r * d.x, y, axis.y + r * d.y), Vec3::new(n.x * d.x, n.y, n.x * d.y));
                directions.iter().map(turn).unzip()
            };
            let ((a, na), (b, nb)) = (row(profile[i], n0), row(profile[i + 1], n1));
            self.curved_strip(&a, &b, &na, &nb, material);
        }
    }

    fn into_mesh(self) -> Mesh {
        Mesh {
            positions: self.positions,
            normals: self.normals,
            indices: self.indices,
            materials: MeshMaterials::PerTriangle(self.materials),
            strict: true,
            ..Default::default()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bvh::BuildOptions;
    use crate::device::Device;
    use crate::progress::Progress;
    use crate::sampling::{cosine_around, sobol_2d};
    use crate::scene::Scene;
    use crate::scene::is_valid_triangle;
    use crate::trace::Ray;
    use std::sync::Arc;

    fn corners(data: &SceneData) -> impl Iterator<Item = [Vec3; 3]> + '_ {
        data.meshes().iter().flat_map(|m| (0..m.indices.len()).map(|t| m.corners(t)))
    }

    fn committed() -> Arc<Scene> {
        let device = Device::new(Default::default()).unwrap();
        Scene::commit(&device, atrium().unwrap(), &BuildOptions::default(), &Progress::none()).map_err(|e| e.1).unwrap()
    }

    #[test]
    fn it_is_as_large_as_documented_and_has_no_degenerate_triangles() {
        let data = atrium().unwrap();
        let n = data.triangle_count();
        assert!((60_000..=100_000).contains(&n), "{n} triangles");
        assert_eq!(corners(&data).filter(|&c| !is_valid_triangle(c)).count(), 0);
        let least = corners(&data).map(|[a, b, c]| 0.5 * (b - a).cross(c - a).length()).fold(f32::INFINITY, f32::min);
        assert!(least > 1e-7, "a triangle of {least} m²");
        let (lo, hi) = corners(&data).flatten().fold((Vec3::MAX, Vec3::MIN), |(lo, hi), p| (lo.min(p), hi.max(p)));
        let size = Vec3::new(2.0 * 10.3, PARAPET, 2.0 * 6.1);
        assert!((hi - lo - size).length() < 1e-5 && lo.y == 0.0, "{lo} to {hi}");
    }

    #[test]
    fn shading_normals_are_unit_and_near_the_geometric_ones() {
        for mesh in atrium().unwrap().meshes() {
            for (t, tri) in mesh.indices.iter().enumerate() {
                let [a, b, c] = mesh.corners(t);
                let geometric = (b - a).cross(c - a).normalize();
                for &i in tri {
                    let n = mesh.normals[i as usize];
                    assert!((n.length() - 1.0).abs() < 1e-5 && n.dot(geometric) > 0.6, "{geometric} {n} at {a}");
                }
            }
        }
    }

    /// Light walks from the camera over diffuse bounces wherever it can get to.
    #[test]
    fn no_light_that_starts_inside_ever_meets_a_back_or_leaves_but_through_the_opening() {
        let scene = committed();
        let start = atrium_camera().position;
        let (mut position, mut normal) = (start, Vec3::Y);
        let (mut hits, mut escapes) = (0, 0);
        for i in 0..200_000u32 {
            let direction = cosine_around(normal, sobol_2d(i, 5));
            let (origin, ray) = (position, Ray::new(position, direction));
            let hit = scene.intersect_raw(&ray);
            if hit.is_miss() {
                escapes += 1;
                let out = origin + direction * ((PARAPET - origin.y) / direction.y);
                assert!(
                    direction.y > 0.0 && out.x.abs() < COURT.x - ARCADE + 1e-3 && out.z.abs() < COURT.y - ARCADE + 1e-3,
                    "a ray from {origin} along {direction} escapes at {out}"
                );
                (position, normal) = (start, if escapes % 2 == 0 { Vec3::Y } else { Vec3::NEG_Y });
                continue;
            }
            hits += 1;
            // Stepping back on the way stays in the air, even in the wedge between two faces.
            position = origin + direction * (hit.t - 1e-3f32.min(0.5 * hit.t));
            let facing = scene.normal(hit.triangle);
            let back = facing.dot(direction) > 0.0;
            assert!(
                !back || scene.material(hit.triangle).two_sided,
                "a ray from {origin} meets the back of {:?}",
                scene.corners(hit.triangle)
            );
            normal = if back { -facing } else { facing };
        }
        assert!(hits > 100_000 && escapes > 1_000, "{hits} hits, {escapes} escapes");
    }

    #[test]
    fn the_sun_reaches_the_floor_and_a_wall() {
        let scene = committed();
        let sunlit = |p: Vec3| !scene.occluded(&Ray::new(p, -SUN));
        let on_floor = (0..400)
            .filter(|i| sunlit(Vec3::new((i % 20) as f32 * 0.6 - 6.0, 0.001, (i / 20) as f32 * 0.25 - 2.5)))
            .count();
        assert!((60..300).contains(&on_floor), "{on_floor} of 400 points on the court's floor are in the sun");
        // The piers between the arches, below the cornice's shadow.
        let z = COURT.y - ARCADE - 0.001;
        let pier = |i: u32| Vec3::new(BAY * ((i % 4) as f32 - 1.5), 3.0 + 0.04 * (i / 4) as f32, z);
        let on_wall = (0..80).filter(|&i| sunlit(pier(i))).count();
        assert!(on_wall > 20, "{on_wall} of 80 points on the court's wall are in the sun");
    }
}
