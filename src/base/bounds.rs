//! Boxes with sides along the axes.

use glam::Vec3;

/// A box with sides along the axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Bounds {
    pub lower: Vec3,
    pub upper: Vec3,
}

impl Bounds {
    pub const EMPTY: Bounds = Bounds { lower: Vec3::splat(f32::INFINITY), upper: Vec3::splat(f32::NEG_INFINITY) };

    pub fn is_empty(&self) -> bool {
        !self.lower.cmple(self.upper).all()
    }

    pub fn add(&mut self, point: Vec3) {
        (self.lower, self.upper) = (self.lower.min(point), self.upper.max(point));
    }

    pub fn with(&self, other: &Bounds) -> Bounds {
        Bounds { lower: self.lower.min(other.lower), upper: self.upper.max(other.upper) }
    }

    /// Returns the box with every side moved outwards.
    pub fn grown(&self, by: f32) -> Bounds {
        Bounds { lower: self.lower - by, upper: self.upper + by }
    }

    pub fn contains(&self, point: Vec3) -> bool {
        self.lower.cmple(point).all() && point.cmple(self.upper).all()
    }

    pub fn overlaps(&self, other: &Bounds) -> bool {
        self.lower.cmple(other.upper).all() && other.lower.cmple(self.upper).all()
    }

    /// Returns the area of the six sides.
    pub fn area(&self) -> f32 {
        let d = (self.upper - self.lower).max(Vec3::ZERO);
        2.0 * (d.x * d.y + d.y * d.z + d.z * d.x)
    }

    /// Returns the length of the diagonal.
    pub fn diagonal(&self) -> f32 {
        (self.upper - self.lower).length()
    }

    /// Returns the length of the sides that are neither the longest nor the shortest.
    pub fn width(&self) -> f32 {
        let d = self.upper - self.lower;
        d.element_sum() - d.min_element() - d.max_element()
    }

    /// Returns the distance to another box, 0 if they overlap.
    pub fn distance(&self, other: &Bounds) -> f32 {
        (other.lower - self.upper).max(self.lower - other.upper).max(Vec3::ZERO).length()
    }

    /// Whether another box is met on the way from this one, while its sides move by `lower` and `upper` times the way,
    /// from 0 to `end`. With the sides of a second box at 1, that is the convex hull of both: it consists of the boxes
    /// between them.
    pub fn sweeps(&self, lower: Vec3, upper: Vec3, end: f32, other: &Bounds) -> bool {
        let (mut near, mut far) = (0.0f32, end);
        // Where value + slope · t ≤ limit.
        let mut bound = |value: f32, slope: f32, limit: f32| {
            if slope > 0.0 {
                far = far.min((limit - value) / slope);
            } else if slope < 0.0 {
                near = near.max((limit - value) / slope);
            } else if value > limit {
                far = -1.0;
            }
        };
        for axis in 0..3 {
            bound(self.lower[axis], lower[axis], other.upper[axis]);
            bound(-self.upper[axis], -upper[axis], -other.lower[axis]);
        }
        near <= far
    }

    /// Whether the part of a ray up to `end` times its direction meets the box (slab test).
    pub fn is_hit(&self, origin: Vec3, direction: Vec3, end: f32) -> bool {
        let (mut near, mut far) = (0.0f32, end);
        for axis in 0..3 {
            let (o, d, low, high) = (origin[axis], direction[axis], self.lower[axis], self.upper[axis]);
            if d == 0.0 {
                if o < low || o > high {
                    return false;
                }
                continue;
            }
            let (a, b) = ((low - o) / d, (high - o) / d);
            (near, far) = (near.max(a.min(b)), far.min(a.max(b)));
        }
        near <= far
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::sampling::uniform;

    fn unit_box(at: Vec3) -> Bounds {
        Bounds { lower: at, upper: at + 1.0 }
    }

    #[test]
    fn a_box_is_hit_by_what_passes_through_it_alone() {
        let bounds = unit_box(Vec3::ONE);
        let to = |target: Vec3, end| bounds.is_hit(Vec3::ZERO, target, end);
        assert!(to(Vec3::splat(3.0), 1.0) && !to(Vec3::splat(0.9), 1.0) && !to(-Vec3::splat(3.0), 1.0));
        assert!(!to(Vec3::new(3.0, 0.5, 3.0), 1.0) && to(Vec3::ONE, f32::INFINITY));
        // Along an axis, beside the box and through it.
        assert!(!bounds.is_hit(Vec3::new(0.0, 0.5, 1.5), Vec3::X, f32::INFINITY));
        assert!(bounds.is_hit(Vec3::new(0.0, 1.5, 1.5), Vec3::X, f32::INFINITY));
        assert!(bounds.is_hit(bounds.lower + 0.5, Vec3::X, 0.0));
    }

    #[test]
    fn a_sweep_meets_what_lies_in_the_hull_of_two_boxes() {
        let (from, to) = (unit_box(Vec3::ZERO), Bounds { lower: Vec3::splat(8.0), upper: Vec3::new(12.0, 10.0, 9.0) });
        let meets = |other: &Bounds| from.sweeps(to.lower - from.lower, to.upper - from.upper, 1.0, other);
        // Points of the hull, and points far from it by its definition: the nearest of many in it.
        for i in 0..2000u32 {
            let random = |k| uniform(i, k, 7);
            let at = Vec3::new(14.0 * random(0), 14.0 * random(1), 14.0 * random(2)) - 1.0;
            let other = Bounds { lower: at, upper: at + 0.5 * random(3) };
            let is_met = (0..=400).any(|t| {
                let t = t as f32 / 400.0;
                let between = Bounds { lower: from.lower.lerp(to.lower, t), upper: from.upper.lerp(to.upper, t) };
                between.grown(0.02).overlaps(&other)
            });
            let is_met_surely = (0..=400).any(|t| {
                let t = t as f32 / 400.0;
                let between = Bounds { lower: from.lower.lerp(to.lower, t), upper: from.upper.lerp(to.upper, t) };
                between.overlaps(&other)
            });
            assert!(meets(&other) <= is_met && meets(&other) >= is_met_surely, "{other:?}");
        }
        // Towards infinity, within a spread.
        let sun =
            |other: Bounds| from.sweeps(Vec3::new(-0.1, -0.1, 1.0), Vec3::new(0.1, 0.1, 1.0), f32::INFINITY, &other);
        assert!(sun(unit_box(Vec3::new(5.0, 0.0, 100.0))) && !sun(unit_box(Vec3::new(12.0, 0.0, 100.0))));
        assert!(!sun(unit_box(Vec3::new(0.0, 0.0, -3.0))));
    }
}
