//! Measures and materials of the atrium, and the sides of its court.

use crate::base::error::Result;
use crate::scene::SceneData;
use crate::scene::material::Material;
use glam::{Vec2, Vec3};
use std::f32::consts::PI;
/// Half the inner length and width of the building: inner faces of its outer walls.
pub(super) const HALL: Vec2 = Vec2::new(10.0, 5.8);
/// Half the length and width between the column axes round the court.
pub(super) const COURT: Vec2 = Vec2::new(7.0, 2.8);
/// Thickness of the outer walls.
pub(super) const WALL_THICKNESS: f32 = 0.3;
/// Half the thickness of the arcade walls, which stand on the column axes.
pub(super) const ARCADE: f32 = 0.25;
/// Distance between column axes.
pub(super) const BAY: f32 = 2.8;
/// Inner radius of the arches.
pub(super) const ARCH_RADIUS: f32 = 1.08;
/// Height at which arches and vaults of the ground floor spring.
pub(super) const SPRING: f32 = 2.9;
/// Height of the vaults above their springing: half a bay, so that they are round along the arcade.
pub(super) const VAULT_RISE: f32 = BAY / 2.0;
/// Top of the upper floor.
pub(super) const FLOOR: f32 = 4.8;
/// Top of the balustrade.
pub(super) const RAIL: f32 = 5.75;
/// Height at which the arches of the upper floor spring.
pub(super) const UPPER_SPRING: f32 = 7.6;
/// Height of the upper gallery's ceiling.
pub(super) const CEILING: f32 = 9.0;
/// Top of the roof.
pub(super) const ROOF: f32 = 9.4;
/// Top of the parapet round the opening.
pub(super) const PARAPET: f32 = 9.8;
/// Number of steps of a half circle in arches and vaults. Even, so that the crown is a vertex.
pub(super) const ARC_STEPS: usize = 28;

/// Material numbers.
pub(super) struct Palette {
    pub(super) plaster: u32,
    pub(super) ochre: u32,
    pub(super) dado: u32,
    pub(super) stone: u32,
    pub(super) column: u32,
    pub(super) vault: u32,
    pub(super) tile_light: u32,
    pub(super) tile_dark: u32,
    pub(super) band: u32,
    pub(super) rib: u32,
    pub(super) panel: u32,
    pub(super) roof: u32,
    pub(super) red: u32,
    pub(super) blue: u32,
    pub(super) green: u32,
    pub(super) bronze: u32,
    pub(super) water: u32,
    pub(super) clay: u32,
    pub(super) leaf: u32,
}

impl Palette {
    pub(super) fn new(scene: &mut SceneData) -> Result<Palette> {
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
pub(super) struct Side {
    /// Horizontal direction from the court to the gallery.
    pub(super) out: Vec3,
    /// Direction along the side.
    pub(super) along: Vec3,
    /// Whether it is one of the two long sides.
    pub(super) long: bool,
}

pub(super) const SIDES: [Side; 4] = [
    Side { out: Vec3::Z, along: Vec3::X, long: true },
    Side { out: Vec3::X, along: Vec3::NEG_Z, long: false },
    Side { out: Vec3::NEG_Z, along: Vec3::NEG_X, long: true },
    Side { out: Vec3::NEG_X, along: Vec3::Z, long: false },
];

impl Side {
    /// Half lengths of a rectangle: (this side's distance from the middle, half this side's length).
    pub(super) fn halves(&self, rectangle: Vec2) -> (f32, f32) {
        if self.long { (rectangle.y, rectangle.x) } else { (rectangle.x, rectangle.y) }
    }

    /// A point `a` along the side, `d` outwards from the middle of the court.
    pub(super) fn at(&self, a: f32, d: f32, y: f32) -> Vec3 {
        self.along * a + self.out * d + Vec3::Y * y
    }

    /// Distance of the column axes from the middle.
    pub(super) fn axis(&self) -> f32 {
        self.halves(COURT).0
    }

    /// Middles of the bays along the side.
    pub(super) fn bays(&self) -> impl Iterator<Item = f32> {
        let n = if self.long { 5 } else { 2 };
        (0..n).map(move |i| BAY * (i as f32 - 0.5 * (n - 1) as f32))
    }
}

/// A rectangle shrunk by `inset` on all sides.
pub(super) fn inset(rectangle: Vec2, inset: f32) -> Vec2 {
    rectangle - Vec2::splat(inset)
}

/// cos and sin over a half circle from π to 0, exactly symmetric so that neighbours meet exactly.
pub(super) fn half_circle() -> Vec<[f32; 2]> {
    let half = ARC_STEPS / 2;
    let quarter = |i: usize| {
        let angle = 0.5 * PI * i as f32 / half as f32;
        if i == half { [0.0, 1.0] } else { [angle.cos(), angle.sin()] }
    };
    let left = (0..half).map(quarter).map(|[c, s]| [-c, s]);
    left.chain((0..=half).rev().map(quarter)).collect()
}

/// Column axes: (x, z).
pub(super) fn column_axes() -> Vec<Vec2> {
    let mut axes = Vec::new();
    for i in 0..6 {
        let x = BAY * (i as f32 - 2.5);
        axes.extend([Vec2::new(x, COURT.y), Vec2::new(x, -COURT.y)]);
    }
    axes.extend([Vec2::new(COURT.x, 0.0), Vec2::new(-COURT.x, 0.0)]);
    axes
}
