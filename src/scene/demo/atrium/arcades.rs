//! The walls between the columns of the atrium, with their arches.

use super::measures::{
    ARCADE, ARCH_RADIUS, BAY, CEILING, COURT, FLOOR, Palette, SIDES, SPRING, Side, UPPER_SPRING, half_circle,
};
use super::part::Part;
use glam::Vec3;

/// The walls over the columns, with their arches.
pub(super) fn arcades(part: &mut Part, p: &Palette) {
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
pub(super) struct Arch {
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
