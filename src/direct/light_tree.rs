//! Importance of many lights: a light tree after Conty Estevez and Kulla, *Importance Sampling of
//! Many Lights with Adaptive Tree Splitting*, 2018.
//!
//! Each node bounds the positions, directions and power of its lights, and thereby their contribution to a receiver; if
//! there can be none (all behind the horizon, all facing away, outside all cones) the importance is exactly 0. Instead
//! of one descent per sample with splitting, all samples descend together: they are spaced systematically, (k +
//! offset)/n, on the unit interval, each node divides its part of the interval among its children by importance, and
//! children that no sample falls on are skipped. This spreads the samples evenly over the tree, and its upper nodes are
//! visited once for all of them.

use crate::error::Result;
use crate::memory::{try_collect, try_with_capacity};
use glam::Vec3;
use std::f32::consts::PI;

/// Name of these buffers in error messages.
pub(crate) const LIGHT_TREE: &str = "the tree of the lights";

/// Number of split candidates per axis.
const BINS: usize = 12;

/// From this depth on nodes are halved, so that the tree is never deeper than some 70 nodes.
const HALVE_FROM: u32 = 40;

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
    fn union(&self, o: &Bounds) -> Bounds {
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
    fn cost(&self) -> f32 {
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
struct Node {
    centre: Vec3,
    /// Square of the radius of the bounding sphere.
    radius2: f32,
    axis: Vec3,
    power: f32,
    cos_spread: f32,
    sin_spread: f32,
    cos_reach: f32,
    /// Right child; for a leaf, the complement of its light's number.
    right: u32,
}

impl Node {
    fn new(b: &Bounds, right: u32) -> Node {
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

    /// Importance of the node's lights for a receiver, section 4.3 of the paper. (With the distance to the nearest
    /// point instead of the centre of a node: 1.3 to 2 times the error.)
    #[inline]
    fn importance(&self, position: Vec3, normal: Vec3) -> f32 {
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
#[inline]
fn less(cosine: f32, by_cos: f32, by_sin: f32) -> f32 {
    if cosine >= by_cos {
        return 1.0;
    }
    cosine * by_cos + (1.0 - cosine * cosine).max(0.0).sqrt() * by_sin
}

/// Light tree over some of the lights of a scene, ready to be sampled.
pub(crate) struct LightTree {
    nodes: Vec<Node>,
}

impl LightTree {
    /// Builds the tree over the lights whose power is greater than 0.
    pub(crate) fn new(lights: &[Bounds]) -> Result<LightTree> {
        let mut tree = LightTree { nodes: try_with_capacity((2 * lights.len()).saturating_sub(1), LIGHT_TREE)? };
        // Powers are taken as parts of the whole: those of large scenes would overflow when multiplied by squared
        // lengths.
        let whole = lights.iter().map(|l| f64::from(l.power)).sum::<f64>();
        let part = |l: &Bounds| Bounds { power: (f64::from(l.power) / whole) as f32, ..*l };
        let mut numbered = try_collect((0u32..).zip(lights.iter().map(part)), LIGHT_TREE)?;
        if !lights.is_empty() {
            let mut later = try_with_capacity(lights.len(), LIGHT_TREE)?;
            tree.build(&mut numbered, 0, &mut later);
        }
        Ok(tree)
    }

    pub(crate) fn bytes(&self) -> usize {
        size_of_val(&self.nodes[..])
    }

    /// Builds the subtree over `lights`. `later` has capacity for all lights.
    fn build(&mut self, lights: &mut [(u32, Bounds)], depth: u32, later: &mut Vec<(u32, Bounds)>) -> Bounds {
        if let [(light, bounds)] = lights {
            self.nodes.push(Node::new(bounds, !*light));
            return *bounds;
        }
        let middle = split(lights, depth, later);
        let (left, right) = lights.split_at_mut(middle);
        let place = self.nodes.len();
        self.nodes.push(Node::new(&left[0].1, 0));
        let left = self.build(left, depth + 1, later);
        let second = self.nodes.len() as u32;
        let both = left.union(&self.build(right, depth + 1, later));
        self.nodes[place] = Node::new(&both, second);
        both
    }

    /// Calls `visit` with each light that gets any of `n` systematic samples: its number, its expected number of
    /// samples (n times its probability) and its actual number, which is the former rounded down or up. `offset` is in
    /// [0, 1). Lights that can contribute have a probability greater than 0.
    pub(crate) fn sample(
        &self,
        (position, normal): (Vec3, Vec3),
        n: u32,
        offset: f32,
        visit: &mut impl FnMut(usize, f32, u32),
    ) {
        if !self.nodes.is_empty() {
            self.descend(0, position, normal, (0.0, n as f64), offset as f64, visit);
        }
    }

    fn descend(
        &self,
        node: u32,
        position: Vec3,
        normal: Vec3,
        (from, to): (f64, f64),
        offset: f64,
        visit: &mut impl FnMut(usize, f32, u32),
    ) {
        let samples = |from: f64, to: f64| ceil(to - offset) - ceil(from - offset);
        let right = self.nodes[node as usize].right;
        if right > i32::MAX as u32 {
            return visit(!right as usize, (to - from) as f32, samples(from, to) as u32);
        }
        let left = node + 1;
        let [l, r] = [left, right].map(|n| self.nodes[n as usize].importance(position, normal) as f64);
        if !(l + r > 0.0) {
            return;
        }
        let middle = if r == 0.0 { to } else { from + (to - from) * (l / (l + r)) };
        if samples(from, middle) > 0.0 {
            self.descend(left, position, normal, (from, middle), offset, visit);
        }
        if samples(middle, to) > 0.0 {
            self.descend(right, position, normal, (middle, to), offset, visit);
        }
    }
}

/// Reorders at least two lights and returns the index at which to split them.
fn split(lights: &mut [(u32, Bounds)], depth: u32, later: &mut Vec<(u32, Bounds)>) -> usize {
    let half = lights.len() / 2;
    let centre = |b: &Bounds| 0.5 * (b.lower + b.upper);
    let (mut lower, mut upper) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
    for (_, b) in lights.iter() {
        (lower, upper) = (lower.min(centre(b)), upper.max(centre(b)));
    }
    let size = upper - lower;
    let bin = |b: &Bounds, axis: usize| {
        let x = (centre(b)[axis] - lower[axis]) / size[axis];
        ((x * BINS as f32) as usize).min(BINS - 1)
    };
    if depth >= HALVE_FROM || !(size.max_element() > 0.0) {
        let axis = size.max_position();
        // Sorts in place, unlike a stable sort, which may fail to get memory.
        lights.sort_unstable_by(|(i, a), (j, b)| centre(a)[axis].total_cmp(&centre(b)[axis]).then(i.cmp(j)));
        return half;
    }
    let mut best = (f32::INFINITY, 0, 0);
    for axis in (0..3).filter(|&a| size[a] > 0.0) {
        let mut bins = [None::<Bounds>; BINS];
        for (_, b) in lights.iter() {
            let slot = &mut bins[bin(b, axis)];
            *slot = Some(slot.map_or(*b, |s| s.union(b)));
        }
        let merge = |a: Option<Bounds>, b: &Option<Bounds>| match (a, b) {
            (Some(a), Some(b)) => Some(a.union(b)),
            (a, b) => a.or(*b),
        };
        let mut right = [None; BINS];
        for i in (1..BINS).rev() {
            right[i - 1] = merge(right[i], &bins[i]);
        }
        let mut left = None;
        for i in 0..BINS - 1 {
            left = merge(left, &bins[i]);
            let (Some(l), Some(r)) = (&left, &right[i]) else { continue };
            // Thin nodes are not cut along their short sides.
            let cost = (l.cost() + r.cost()) * (size.max_element() / size[axis]);
            if cost < best.0 {
                best = (cost, axis, i);
            }
        }
    }
    let (_, axis, last) = best;
    let middle = partition(lights, |(_, b)| bin(b, axis) <= last, later);
    if middle == 0 || middle == lights.len() { half } else { middle }
}

/// Moves the values that `is_first` accepts to the front, and returns their number; the order within both groups is
/// kept. `later` has capacity for the others.
fn partition<T: Copy>(values: &mut [T], is_first: impl Fn(&T) -> bool, later: &mut Vec<T>) -> usize {
    later.clear();
    let mut first = 0;
    for i in 0..values.len() {
        let value = values[i];
        if is_first(&value) {
            values[first] = value;
            first += 1;
        } else {
            later.push(value);
        }
    }
    values[first..].copy_from_slice(later);
    first
}

/// Rounds up. (`f64::ceil` is a call into the C library, as SSE4.1 is not assumed: gathering in Sponza with 45,000
/// bright patches takes 4 % longer with it.)
#[inline]
fn ceil(x: f64) -> f64 {
    let towards_zero = x as i64 as f64;
    if towards_zero < x { towards_zero + 1.0 } else { towards_zero }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sampling::{uniform, uniform_sphere};

    fn random_lights(count: u32, seed: u32) -> Vec<Bounds> {
        (0..count)
            .map(|i| {
                let r = |d| uniform(i, d, seed);
                let lower = Vec3::new(r(0), r(1), r(2)) * 10.0;
                Bounds {
                    lower,
                    upper: lower + Vec3::splat(0.3 * r(3)),
                    axis: uniform_sphere([r(4), r(5)]),
                    spread: if r(6) < 0.5 { 0.0 } else { PI * r(6) },
                    reach: if r(7) < 0.3 { 0.0 } else { PI / 2.0 },
                    power: r(8) + 0.01,
                }
            })
            .collect()
    }

    #[test]
    fn every_light_that_can_shine_on_a_receiver_is_sampled_as_often_as_due() {
        let lights = random_lights(300, 1);
        let tree = LightTree::new(&lights).unwrap();
        for i in 0..40 {
            let r = |d| uniform(i, d, 2);
            let position = Vec3::new(r(0), r(1), r(2)) * 14.0 - 2.0;
            let normal = uniform_sphere([r(3), r(4)]);
            let mut due = vec![0.0; lights.len()];
            let (rounds, n) = (2000, 16);
            let mut sampled = vec![0.0; lights.len()];
            for round in 0..rounds {
                tree.sample((position, normal), n, (round as f32 + 0.5) / rounds as f32, &mut |light, d, count| {
                    due[light] = d;
                    sampled[light] += count as f32 / rounds as f32;
                    assert!(count as f32 >= d.floor() && count as f32 <= d.ceil());
                });
            }
            let total: f32 = due.iter().sum();
            assert!(total < n as f32 * 1.0001);
            for (light, b) in lights.iter().enumerate() {
                assert!((sampled[light] - due[light]).abs() < 1e-3, "{} {}", sampled[light], due[light]);
                // (What is due less often than once in all rounds may not be seen.)
                if Node::new(b, 0).importance(position, normal) > 3e-4 * b.power {
                    assert!(due[light] > 0.0, "light {light} at {i}");
                }
            }
        }
    }

    #[test]
    fn what_cannot_contribute_has_no_importance() {
        let b =
            Bounds { lower: Vec3::ZERO, upper: Vec3::ZERO, axis: Vec3::Z, spread: 0.0, reach: PI / 2.0, power: 1.0 };
        let node = Node::new(&b, 0);
        assert_eq!(node.importance(Vec3::new(0.5, 0.0, -1.0), Vec3::Z), 0.0, "behind an area light");
        assert_eq!(node.importance(Vec3::new(0.5, 0.0, 1.0), Vec3::Z), 0.0, "below the horizon");
        assert!((node.importance(Vec3::Z * 2.0, -Vec3::Z) - 0.25).abs() < 1e-6);
        let spot = Node::new(&Bounds { spread: 0.3, reach: 0.0, ..b }, 0);
        assert_eq!(spot.importance(Vec3::new(0.32, 0.0, 1.0), -Vec3::Z), 0.0, "outside a cone");
        assert!(spot.importance(Vec3::new(0.28, 0.0, 1.0), -Vec3::Z) > 0.85);
    }

    #[test]
    fn partitions_are_stable_sorts() {
        let values: Vec<(u32, u32)> = (0..1000).map(|i| (crate::sampling::mix(i) % 7, i)).collect();
        for from in 0..=7 {
            let (mut sorted, mut parted, mut later) =
                (values.clone(), values.clone(), Vec::with_capacity(values.len()));
            sorted.sort_by_key(|v| v.0 >= from);
            let first = partition(&mut parted, |v| v.0 < from, &mut later);
            assert_eq!((parted, first), (sorted, values.iter().filter(|v| v.0 < from).count()));
        }
    }

    #[test]
    fn lights_in_one_place_and_no_lights_make_trees() {
        let b = random_lights(1, 3)[0];
        let mut seen = 0;
        LightTree::new(&[b; 100])
            .unwrap()
            .sample((b.lower - b.axis, Vec3::X), 50, 0.5, &mut |_, _, count| seen += count);
        assert!(seen == 50 || seen == 0);
        LightTree::new(&[]).unwrap().sample((Vec3::ZERO, Vec3::X), 50, 0.5, &mut |_, _, _| panic!());
        assert_eq!(size_of::<Node>(), 48);
    }
}
