//! Nodes of the [light tree](super::light_tree), and their importance for a receiver, eight nodes at a time (Conty
//! Estevez and Kulla 2018, section 4.3).
//!
//! No product and sum are fused, so that the importance has the same bits on every instruction set.

use crate::simd::{self, Eight, Lanes, Mask, Simd};
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

/// A node of 48 bytes; the left child of an inner node follows it.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub(super) struct Node {
    centre: Vec3,
    /// Square of the radius of the bounding sphere.
    radius2: f32,
    axis: Vec3,
    power: f32,
    cos_spread: f32,
    sin_spread: f32,
    cos_reach: f32,
    /// Right child; for a leaf, the complement of its light's number.
    pub right: u32,
}

impl Node {
    pub fn new(b: &Bounds, right: u32) -> Node {
        Node {
            centre: 0.5 * (b.lower + b.upper),
            radius2: 0.25 * (b.upper - b.lower).length_squared() * (1.0 + 1e-5),
            axis: b.axis,
            power: b.power,
            cos_spread: if b.spread >= PI { -1.0 } else { b.spread.cos() },
            sin_spread: if b.spread >= PI { 0.0 } else { b.spread.sin() },
            // Slightly enlarged to cover rounding.
            cos_reach: (b.reach + 1e-4).cos(),
            right,
        }
    }

    /// The importance as [`importances`] computes it, for one node.
    #[cfg(test)]
    pub fn importance(&self, position: Vec3, normal: Vec3) -> f32 {
        let way = self.centre - position;
        let d2 = way.length_squared();
        if d2 <= self.radius2 {
            return self.power / self.radius2.max(f32::MIN_POSITIVE);
        }
        let inverse = 1.0 / d2.sqrt();
        let sin2 = self.radius2 / d2;
        let (sin_size, cos_size) = (sin2.sqrt(), (1.0 - sin2).sqrt());
        let here = less(way.dot(normal) * inverse, cos_size, sin_size);
        if here <= 0.0 {
            return 0.0;
        }
        let there = less(-way.dot(self.axis) * inverse, self.cos_spread, self.sin_spread);
        let there = less(there, cos_size, sin_size);
        if there < self.cos_reach {
            return 0.0;
        }
        self.power * here * there.max(1e-3) / d2
    }
}

/// Cosine of the angle with cosine `cosine`, reduced by another angle, but not below 0.
#[cfg(test)]
fn less(cosine: f32, by_cos: f32, by_sin: f32) -> f32 {
    if cosine >= by_cos {
        return 1.0;
    }
    cosine * by_cos + (1.0 - cosine * cosine).max(0.0).sqrt() * by_sin
}

/// Kernel that computes the importance of the nodes `names` of a tree for a receiver, given its position and normal.
pub(super) type ImportanceFn = fn(&[Node], &[u32], [Vec3; 2], &mut [f32]);

simd::kernel! {
    /// Returns the kernel of an ISA; the portable one if the machine cannot run `isa`.
    pub(super) fn kernel -> ImportanceFn;

    fn all<S>(nodes: &[Node], names: &[u32], receiver: [Vec3; 2], out: &mut [f32]) {
        for (names, out) in names.chunks(8).zip(out.chunks_mut(8)) {
            let mut eight = [&nodes[names[0] as usize]; 8];
            for (node, &name) in eight.iter_mut().zip(names) {
                *node = &nodes[name as usize];
            }
            let values = importances::<S>(&eight, receiver).to_array();
            out.copy_from_slice(&values[..out.len()]);
        }
    }
}

/// Eight floats of each of eight nodes, from the float `first` on, which is at most 4: component by component.
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
unsafe fn components<S: Simd>(n: &[&Node; 8], first: usize) -> [S::F8; 8] {
    let p = |i: usize| std::ptr::from_ref(n[i]).cast::<f32>().wrapping_add(first);
    // SAFETY: the caller vouches for the ISA. A node is twelve floats.
    unsafe {
        S::F8::transpose([
            S::F8::load(p(0)),
            S::F8::load(p(1)),
            S::F8::load(p(2)),
            S::F8::load(p(3)),
            S::F8::load(p(4)),
            S::F8::load(p(5)),
            S::F8::load(p(6)),
            S::F8::load(p(7)),
        ])
    }
}

/// Cosine of the angle with cosine `cosine`, reduced by another angle, but not below 0.
#[inline(always)]
fn reduced<L: Lanes>(cosine: L, by_cos: L, by_sin: L, [zero, one]: [L; 2]) -> L {
    let between = cosine * by_cos + (one - cosine * cosine).max(zero).sqrt() * by_sin;
    L::select(by_cos.le(cosine), one, between)
}

/// Importance of eight nodes' lights for a receiver. (With the distance to the nearest point instead of the centre of a
/// node: 1.3 to 2 times the error.)
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
unsafe fn importances<S: Simd>(n: &[&Node; 8], [position, normal]: [Vec3; 2]) -> S::F8 {
    // SAFETY: the caller vouches for the ISA.
    unsafe {
        let [cx, cy, cz, radius2, ax, ay, az, power] = components::<S>(n, 0);
        let [_, _, _, _, cos_spread, sin_spread, cos_reach, _] = components::<S>(n, 4);
        let (zero, one) = (S::F8::splat(0.0), S::F8::splat(1.0));
        let (x, y, z) = (cx - S::F8::splat(position.x), cy - S::F8::splat(position.y), cz - S::F8::splat(position.z));
        let d2 = x * x + y * y + z * z;
        let around = power.div(radius2.max(S::F8::splat(f32::MIN_POSITIVE)));
        let inverse = one.div(d2.sqrt());
        let sin2 = radius2.div(d2);
        let (sin_size, cos_size) = (sin2.sqrt(), (one - sin2).sqrt());
        let along_normal = x * S::F8::splat(normal.x) + y * S::F8::splat(normal.y) + z * S::F8::splat(normal.z);
        let here = reduced(along_normal * inverse, cos_size, sin_size, [zero, one]);
        let along_axis = x * ax + y * ay + z * az;
        let there = reduced((zero - along_axis) * inverse, cos_spread, sin_spread, [zero, one]);
        let there = reduced(there, cos_size, sin_size, [zero, one]);
        let outside = (power * here * there.max(S::F8::splat(1e-3))).div(d2);
        let none = here.le(zero).or(there.lt(cos_reach));
        S::F8::select(d2.le(radius2), around, S::F8::select(none, zero, outside))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::sampling::{uniform, uniform_sphere};
    use crate::simd::Isa;

    #[test]
    fn importance_has_the_same_bits_on_every_instruction_set_and_one_by_one() {
        let node = |i: u32| {
            let r = |d| uniform(i, d, 9);
            let lower = Vec3::new(r(0), r(1), r(2)) * 10.0;
            Node::new(
                &Bounds {
                    lower,
                    upper: lower + Vec3::splat(if r(3) < 0.3 { 0.0 } else { 4.0 * r(4) }),
                    axis: uniform_sphere([r(5), r(6)]),
                    spread: if r(7) < 0.5 { 0.0 } else { PI * r(8) },
                    reach: if r(9) < 0.3 { 0.0 } else { PI / 2.0 },
                    power: r(10),
                },
                0,
            )
        };
        let nodes: Vec<Node> = (0..203).map(node).collect();
        let names: Vec<u32> = (0..203).rev().collect();
        let mut shining = 0;
        for i in 0..50 {
            let r = |d| uniform(i, d, 10);
            // Some receivers lie in the middle of a node.
            let position = if i % 5 == 0 { nodes[i as usize].centre } else { 10.0 * Vec3::new(r(0), r(1), r(2)) };
            let normal = uniform_sphere([r(3), r(4)]);
            let expected: Vec<f32> = names.iter().map(|&n| nodes[n as usize].importance(position, normal)).collect();
            shining += expected.iter().filter(|&&v| v > 0.0).count();
            for isa in Isa::available() {
                let mut out = vec![0.0; names.len()];
                kernel(isa)(&nodes, &names, [position, normal], &mut out);
                assert!(out.iter().zip(&expected).all(|(a, b)| a.to_bits() == b.to_bits()), "{}", isa.name());
            }
        }
        assert!(shining > 1000 && shining < 9000, "{shining}");
    }
}
