//! Nodes of the [light tree](super::light_tree): up to eight children each, and their importance for a receiver, all at
//! a time (Conty Estevez and Kulla 2018, section 4.3).
//!
//! No product and sum are fused, so that the importance has the same bits on every instruction set.

use crate::simd::{Lanes, Mask, Simd, prefetch};
use glam::Vec3;
use std::f32::consts::PI;

/// Bounds of one light, or of several.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Bounds {
    pub lower: Vec3,
    pub upper: Vec3,
    /// Directions of the lights' axes: a cone of half-angle `spread` around this unit vector.
    pub axis: Vec3,
    pub spread: f32,
    /// Maximum angle from their axes at which the lights shine, at most π/2. (An area light: π/2, with the cosine. A
    /// spot has all of its cone as `spread`, and 0.)
    pub reach: f32,
    /// Sum over the channels of radiant intensity, in the direction where it is largest.
    pub power: f32,
}

impl Bounds {
    pub(super) fn union(&self, o: &Bounds) -> Bounds {
        let (axis, spread) = cone_union((self.axis, self.spread), (o.axis, o.spread));
        Bounds {
            lower: self.lower.min(o.lower),
            upper: self.upper.max(o.upper),
            axis,
            spread,
            reach: self.reach.max(o.reach),
            power: self.power + o.power,
        }
    }

    /// Surface area orientation heuristic, section 4.4 of the paper, with the square of the diagonal for the surface
    /// area, which a row or a ceiling of lamps lacks.
    pub(super) fn cost(&self) -> f32 {
        let (o, w) = (self.spread, (self.spread + self.reach).min(PI));
        let directions = 2.0 * PI * (1.0 - o.cos())
            + PI / 2.0 * (2.0 * w * o.sin() - (o - 2.0 * w).cos() - 2.0 * o * o.sin() + o.cos());
        self.power * directions * (self.upper - self.lower).length_squared()
    }
}

/// The smallest cone, as axis and half-angle, that contains two.
fn cone_union(a: (Vec3, f32), b: (Vec3, f32)) -> (Vec3, f32) {
    let (a, b) = if a.1 >= b.1 { (a, b) } else { (b, a) };
    let between = a.0.angle_between(b.0);
    if a.1 >= PI || (between + b.1).min(PI) <= a.1 {
        return a;
    }
    let spread = 0.5 * (a.1 + between + b.1);
    let around = a.0.cross(b.0).normalize_or_zero();
    if spread >= PI || around == Vec3::ZERO {
        return (a.0, PI);
    }
    let turn = spread - a.1;
    // Slightly enlarged to cover rounding.
    ((a.0 * turn.cos() + around.cross(a.0) * turn.sin()).normalize(), (spread + 1e-5).min(PI))
}

/// What the importance of a child depends on.
#[derive(Clone, Copy, Debug)]
struct Child {
    centre: Vec3,
    /// Radius of the bounding sphere.
    radius: f32,
    axis: Vec3,
    power: f32,
    cos_spread: f32,
    sin_spread: f32,
    cos_reach: f32,
}

impl Child {
    fn new(b: &Bounds) -> Child {
        Child {
            centre: 0.5 * (b.lower + b.upper),
            radius: 0.5 * (b.upper - b.lower).length() * (1.0 + 1e-5),
            axis: b.axis,
            power: b.power,
            cos_spread: if b.spread >= PI { -1.0 } else { b.spread.cos() },
            sin_spread: if b.spread >= PI { 0.0 } else { b.spread.sin() },
            // Slightly enlarged to cover rounding.
            cos_reach: (b.reach + 1e-4).cos(),
        }
    }

    fn columns(&self) -> [f32; COLUMNS] {
        let Child { centre: c, axis: a, .. } = *self;
        [c.x, c.y, c.z, self.radius, a.x, a.y, a.z, self.power, self.cos_spread, self.sin_spread, self.cos_reach]
    }
}

/// Number of floats of a [`Child`].
const COLUMNS: usize = 11;

/// Maximum number of children of a node.
pub(super) const WIDTH: usize = 8;

/// A node of six cache lines.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
pub(super) struct Node {
    /// The floats of each child, column by column. Where there is no child they are the first child's, but no power.
    columns: [[f32; WIDTH]; COLUMNS],
    /// The node of each child; for a single light, the complement of its number.
    pub children: [u32; WIDTH],
}

impl Node {
    /// Makes a node of one to [`WIDTH`] children; which nodes these are is filled in later.
    pub fn new<'a>(children: impl Iterator<Item = &'a Bounds>) -> Node {
        let mut node = Node { columns: [[0.0; WIDTH]; COLUMNS], children: [0; WIDTH] };
        for (i, bounds) in children.take(WIDTH).enumerate() {
            let child = Child::new(bounds);
            if i == 0 {
                node.columns = Child { power: 0.0, ..child }.columns().map(|x| [x; WIDTH]);
            }
            node.columns.iter_mut().zip(child.columns()).for_each(|(column, x)| column[i] = x);
        }
        node
    }

    /// Asks for the node's cache lines.
    #[inline(always)]
    pub fn prefetch(&self) {
        self.columns.iter().step_by(2).for_each(|line| prefetch(line));
    }

    /// Importance of the children's lights for a receiver, given its position and normal; 0 where there is no child.
    /// (With the distance to the nearest point instead of the centre of a node: 1.3 to 2 times the error.)
    ///
    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    pub unsafe fn importances<S: Simd>(&self, [position, normal]: [Vec3; 2]) -> [f32; WIDTH] {
        let column = |i: usize| self.columns[i].as_ptr();
        let mut out = [0.0; WIDTH];
        // SAFETY: the caller vouches for the ISA. A column has eight floats, and so has `out`.
        unsafe {
            let (zero, one) = (S::F8::splat(0.0), S::F8::splat(1.0));
            let x = S::F8::load(column(0)) - S::F8::splat(position.x);
            let y = S::F8::load(column(1)) - S::F8::splat(position.y);
            let z = S::F8::load(column(2)) - S::F8::splat(position.z);
            let (radius, power) = (S::F8::load(column(3)), S::F8::load(column(7)));
            let d2 = x * x + y * y + z * z;
            let radius2 = radius * radius;
            // One division and four roots: they take as long as the rest.
            let inverse2 = one.div(d2.max(radius2).max(S::F8::splat(f32::MIN_POSITIVE)));
            let inverse = inverse2.sqrt();
            let sin_size = radius * inverse;
            let cos_size = (one - sin_size * sin_size).max(zero).sqrt();
            let along_normal = x * S::F8::splat(normal.x) + y * S::F8::splat(normal.y) + z * S::F8::splat(normal.z);
            let here = reduced(along_normal * inverse, cos_size, sin_size, [zero, one]);
            let along_axis = x * S::F8::load(column(4)) + y * S::F8::load(column(5)) + z * S::F8::load(column(6));
            let (cos_spread, sin_spread) = (S::F8::load(column(8)), S::F8::load(column(9)));
            let (cos, sin) =
                (cos_spread * cos_size - sin_spread * sin_size, sin_spread * cos_size + cos_spread * sin_size);
            let there = reduced((zero - along_axis) * inverse, cos, sin, [zero, one]);
            // Beyond π together.
            let there = S::F8::select(sin.lt(zero), one, there);
            let none = here.le(zero).or(there.lt(S::F8::load(column(10))));
            let outside = S::F8::select(none, zero, here * there.max(S::F8::splat(1e-3)));
            let share = S::F8::select(d2.le(radius2), one, outside);
            (power * inverse2 * share).store(out.as_mut_ptr());
        }
        out
    }
}

/// Cosine of the angle with cosine `cosine`, reduced by another angle, but not below 0.
#[inline(always)]
fn reduced<L: Lanes>(cosine: L, by_cos: L, by_sin: L, [zero, one]: [L; 2]) -> L {
    let between = cosine * by_cos + (one - cosine * cosine).max(zero).sqrt() * by_sin;
    L::select(by_cos.le(cosine), one, between)
}

/// The importance of one light or several as [`Node::importances`] computes it, one after the other.
#[cfg(test)]
pub(super) fn importance(b: &Bounds, position: Vec3, normal: Vec3) -> f32 {
    let c = Child::new(b);
    let less = |cosine: f32, by_cos: f32, by_sin: f32| match cosine >= by_cos {
        true => 1.0,
        false => cosine * by_cos + (1.0 - cosine * cosine).max(0.0).sqrt() * by_sin,
    };
    let way = c.centre - position;
    let d2 = way.length_squared();
    let inverse2 = 1.0 / d2.max(c.radius * c.radius).max(f32::MIN_POSITIVE);
    if d2 <= c.radius * c.radius {
        return c.power * inverse2;
    }
    let inverse = inverse2.sqrt();
    let sin_size = c.radius * inverse;
    let cos_size = (1.0 - sin_size * sin_size).max(0.0).sqrt();
    let here = less(way.dot(normal) * inverse, cos_size, sin_size);
    let cos = c.cos_spread * cos_size - c.sin_spread * sin_size;
    let sin = c.sin_spread * cos_size + c.cos_spread * sin_size;
    let there = if sin < 0.0 { 1.0 } else { less(-way.dot(c.axis) * inverse, cos, sin) };
    if here <= 0.0 || there < c.cos_reach {
        return 0.0;
    }
    c.power * inverse2 * (here * there.max(1e-3))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::sampling::{uniform, uniform_sphere};
    use crate::simd::{self, Isa};

    simd::kernel! {
        fn kernel -> fn(&Node, [Vec3; 2], &mut [f32; WIDTH]);

        fn all<S>(node: &Node, receiver: [Vec3; 2], out: &mut [f32; WIDTH]) {
            *out = node.importances::<S>(receiver);
        }
    }

    #[test]
    fn importance_has_the_same_bits_on_every_instruction_set_and_one_by_one() {
        let bounds = |i: u32| {
            let r = |d| uniform(i, d, 9);
            let lower = Vec3::new(r(0), r(1), r(2)) * 10.0;
            Bounds {
                lower,
                upper: lower + Vec3::splat(if r(3) < 0.3 { 0.0 } else { 4.0 * r(4) }),
                axis: uniform_sphere([r(5), r(6)]),
                spread: if r(7) < 0.5 { 0.0 } else { PI * r(8) },
                reach: if r(9) < 0.3 { 0.0 } else { PI / 2.0 },
                power: r(10),
            }
        };
        let all: Vec<Bounds> = (0..203).map(bounds).collect();
        let mut shining = 0;
        for i in 0..50 {
            let r = |d| uniform(i, d, 10);
            // Some receivers lie in the middle of a child.
            let middle = 0.5 * (all[i as usize].lower + all[i as usize].upper);
            let position = if i % 5 == 0 { middle } else { 10.0 * Vec3::new(r(0), r(1), r(2)) };
            let normal = uniform_sphere([r(3), r(4)]);
            // Of 203 the last node has three.
            for children in all.chunks(WIDTH) {
                let mut expected = [0.0; WIDTH];
                expected.iter_mut().zip(children).for_each(|(e, b)| *e = importance(b, position, normal));
                shining += expected.iter().filter(|&&v| v > 0.0).count();
                for isa in Isa::available() {
                    let mut out = [0.0; WIDTH];
                    kernel(isa)(&Node::new(children.iter()), [position, normal], &mut out);
                    assert_eq!(out.map(f32::to_bits), expected.map(f32::to_bits), "{}", isa.name());
                }
            }
        }
        assert!(shining > 1000 && shining < 9000, "{shining}");
        assert_eq!(size_of::<Node>(), 6 * 64);
    }
}
