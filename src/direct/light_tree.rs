//! Importance of many lights: a light tree after Conty Estevez and Kulla, *Importance Sampling of
//! Many Lights with Adaptive Tree Splitting*, 2018.
//!
//! Each node bounds the positions, directions and power of its lights, and thereby their contribution to a receiver; if
//! there can be none (all behind the horizon, all facing away, outside all cones) the importance is exactly 0. Instead
//! of one descent per sample with splitting, all samples descend together: they are spaced systematically, (k +
//! offset)/n, on the unit interval, each node divides its part of the interval among its children by importance, and
//! children that no sample falls on are skipped. This spreads the samples evenly over the tree, and its upper nodes are
//! visited once for all of them.
//!
//! A binary tree is collapsed to nodes of eight children, which are weighed at a time: fewer levels, each of which
//! divides by what it knows better. (46,000 bright patches of Sponza: 0.44 of the time that a binary tree took, whose
//! nodes were weighed eight at a time too, and no more noise: docs/experiments.md#many-lights.)

use super::light_node::{Bounds, Node, WIDTH};
use crate::base::error::Result;
use crate::base::memory::{try_collect, try_filled, try_push, try_to_vec};
use crate::simd::{self, Isa};
use glam::Vec3;

/// Name of these buffers in error messages.
pub(crate) const LIGHT_TREE: &str = "the tree of the lights";

/// Number of split candidates per axis.
const BINS: usize = 12;

/// From this depth on nodes are halved, so that the tree is never deeper than some 70 nodes.
const HALVE_FROM: u32 = 40;

/// Number of lights from which the two parts of a node are built in parallel.
const IN_PARALLEL: usize = 1024;

/// Light tree over some of the lights of a scene, ready to be sampled.
pub(crate) struct LightTree {
    nodes: Vec<Node>,
    descend: DescendFn,
}

/// A node of the binary tree; the left child of an inner node follows it.
#[derive(Clone, Copy)]
struct Binary {
    bounds: Bounds,
    /// Right child; for a leaf, the complement of its light's number.
    right: u32,
}

/// Whether a child is the complement of a light's number.
#[inline]
fn is_light(child: u32) -> bool {
    child > i32::MAX as u32
}

/// Part of the interval from -`offset` to the number of samples less `offset` that falls on a node. Samples lie at
/// integers: the first in the part, and the end of those in it.
#[derive(Clone, Copy)]
struct Part {
    node: u32,
    from: f64,
    to: f64,
    first: i32,
    end: i32,
}

/// A light that samples fall on.
#[derive(Clone, Copy)]
struct Sampled {
    light: u32,
    /// Number of samples, and the number that is expected.
    count: u32,
    due: f32,
}

/// Lists of a descent, which keep their room for the next one.
#[derive(Default)]
pub(crate) struct Descent {
    level: Vec<Part>,
    next: Vec<Part>,
    importances: Vec<[f32; WIDTH]>,
    lights: Vec<Sampled>,
}

impl LightTree {
    /// Builds the tree over the lights whose power is greater than 0, to be sampled by the kernels of an ISA.
    pub(crate) fn new(isa: Isa, lights: &[Bounds]) -> Result<LightTree> {
        // Powers are taken as parts of the whole: those of large scenes would overflow when multiplied by squared
        // lengths.
        let whole = lights.iter().map(|l| f64::from(l.power)).sum::<f64>();
        let part = |l: &Bounds| Bounds { power: (f64::from(l.power) / whole) as f32, ..*l };
        let mut numbered = try_collect((0u32..).zip(lights.iter().map(part)), LIGHT_TREE)?;
        let mut nodes = Vec::new();
        if !lights.is_empty() {
            let mut later = try_to_vec(&numbered, LIGHT_TREE)?;
            let leaf = Binary { bounds: numbered[0].1, right: 0 };
            let mut binary = try_filled(2 * lights.len() - 1, leaf, LIGHT_TREE)?;
            build(&mut binary, 0, &mut numbered, 0, &mut later);
            collapse(&binary, 0, &mut nodes)?;
        }
        Ok(LightTree { nodes, descend: kernel(isa) })
    }

    pub(crate) fn bytes(&self) -> usize {
        size_of_val(&self.nodes[..])
    }

    /// Calls `visit` with each light that gets any of `n` systematic samples, and before that `prefetch` with all of their
    /// numbers. `visit` gets a light's number, its expected number of
    /// samples (n times its probability) and its actual number, which is the former rounded down or up. `offset` is in
    /// [0, 1). Lights that can contribute have a probability greater than 0.
    pub(crate) fn sample(
        &self,
        (position, normal): (Vec3, Vec3),
        n: u32,
        offset: f32,
        descent: &mut Descent,
        prefetch: impl Fn(usize),
        mut visit: impl FnMut(usize, f32, u32),
    ) {
        (self.descend)(&self.nodes, [position, normal], (n, offset), descent);
        descent.lights.iter().for_each(|sampled| prefetch(sampled.light as usize));
        for sampled in &descent.lights {
            visit(sampled.light as usize, sampled.due, sampled.count);
        }
    }
}

/// Kernel that lists the lights that samples fall on, given the position and the normal of a receiver, the number of
/// samples and their offset.
type DescendFn = fn(&[Node], [Vec3; 2], (u32, f32), &mut Descent);

simd::kernel! {
    /// Returns the kernel of an ISA; the portable one if the machine cannot run `isa`.
    fn kernel -> DescendFn;

    fn descend<S>(nodes: &[Node], receiver: [Vec3; 2], samples: (u32, f32), descent: &mut Descent) {
        let (n, offset) = samples;
        let Descent { level, next, importances, lights } = descent;
        level.clear();
        lights.clear();
        let (from, to) = (-f64::from(offset), f64::from(n) - f64::from(offset));
        if !nodes.is_empty() {
            level.push(Part { node: 0, from, to, first: ceil(from), end: ceil(to) });
        }
        while !level.is_empty() {
            // In a loop of its own, so that what waits for roots and for memory overlaps.
            importances.resize(level.len(), [0.0; WIDTH]);
            for (part, out) in level.iter().zip(importances.iter_mut()) {
                *out = nodes[part.node as usize].importances::<S>(receiver);
            }
            next.clear();
            for (part, importances) in level.iter().zip(importances.iter()) {
                divide(&nodes[part.node as usize], importances, part, next, lights);
            }
            for part in &*next {
                nodes[part.node as usize].prefetch();
            }
            std::mem::swap(level, next);
        }
    }
}

/// Divides a part of the interval among the children of its node by their importances.
#[inline(always)]
fn divide(node: &Node, importances: &[f32; WIDTH], part: &Part, next: &mut Vec<Part>, lights: &mut Vec<Sampled>) {
    let mut ends = [0.0; WIDTH];
    let mut sum = 0.0;
    for (end, importance) in ends.iter_mut().zip(importances) {
        sum += f64::from(*importance);
        *end = sum;
    }
    if !(sum > 0.0 && sum < f64::INFINITY) {
        return;
    }
    let scale = (part.to - part.from) / sum;
    for end in &mut ends {
        *end = part.from + *end * scale;
    }
    // The first sample after each child. (All at once, in lanes: descents take 0.93 of the time.)
    let after = ends.map(|end| ceil(end).min(part.end).max(part.first));
    let before: [i32; WIDTH] = std::array::from_fn(|child| if child == 0 { part.first } else { after[child - 1] });
    // Children that samples fall on. (To look for the child of each sample takes longer.)
    let mut filled = 0u32;
    for child in 0..WIDTH {
        filled |= u32::from(before[child] < after[child]) << child;
    }
    let mut add = |child: usize, first: i32, end: i32| {
        let (from, to) = (if child == 0 { part.from } else { ends[child - 1] }, ends[child]);
        match node.children[child] {
            light if is_light(light) => {
                lights.push(Sampled { light: !light, count: (end - first) as u32, due: (to - from) as f32 });
            }
            node => next.push(Part { node, from, to, first, end }),
        }
    };
    while filled != 0 {
        let child = filled.trailing_zeros() as usize;
        filled &= filled - 1;
        add(child, before[child], after[child]);
    }
    if after[WIDTH - 1] < part.end {
        // The last sample, and rounding.
        add(importances.iter().rposition(|&i| i > 0.0).unwrap_or(0), after[WIDTH - 1], part.end);
    }
}

/// Builds the binary tree over `lights` into `nodes`, which has as many places as it takes; `place` is the number of the
/// first. `later` is scratch memory for as many lights.
fn build(
    nodes: &mut [Binary],
    place: u32,
    lights: &mut [(u32, Bounds)],
    depth: u32,
    later: &mut [(u32, Bounds)],
) -> Bounds {
    if let [(light, bounds)] = lights {
        nodes[0] = Binary { bounds: *bounds, right: !*light };
        return *bounds;
    }
    let middle = split(lights, depth, later);
    let (left, right) = lights.split_at_mut(middle);
    let (later_left, later_right) = later.split_at_mut(middle);
    // A tree over n lights has 2 n - 1 nodes.
    let (node, below) = nodes.split_at_mut(1);
    let (left_nodes, right_nodes) = below.split_at_mut(2 * middle - 1);
    let (second, is_large) = (place + 2 * middle as u32, left.len() + right.len() >= IN_PARALLEL);
    let mut left = || build(left_nodes, place + 1, left, depth + 1, later_left);
    let mut right = || build(right_nodes, second, right, depth + 1, later_right);
    // Outside of a pool, rayon would make one of its own.
    let (left, right) = match is_large && rayon::current_thread_index().is_some() {
        true => rayon::join(left, right),
        false => (left(), right()),
    };
    let both = left.union(&right);
    node[0] = Binary { bounds: both, right: second };
    both
}

/// Makes a node of what lies below a node of the binary tree, and the nodes below it. Returns its number. Those children
/// are opened whose lights are spread most.
fn collapse(binary: &[Binary], root: u32, nodes: &mut Vec<Node>) -> Result<u32> {
    let (mut children, mut count) = ([root; WIDTH], 1);
    let of = |child: u32| &binary[child as usize];
    while count < WIDTH {
        let inner = (0..count).filter(|&i| !is_light(of(children[i]).right));
        let widest = inner.max_by(|&a, &b| of(children[a]).bounds.cost().total_cmp(&of(children[b]).bounds.cost()));
        let Some(i) = widest else { break };
        children.copy_within(i..count, i + 1);
        children[i + 1] = of(children[i]).right;
        children[i] += 1;
        count += 1;
    }
    let place = nodes.len();
    try_push(nodes, Node::new(children[..count].iter().map(|&c| &of(c).bounds)), LIGHT_TREE)?;
    for (i, &child) in children[..count].iter().enumerate() {
        let right = of(child).right;
        nodes[place].children[i] = if is_light(right) { right } else { collapse(binary, child, nodes)? };
    }
    Ok(place as u32)
}

/// Reorders at least two lights and returns the index at which to split them.
fn split(lights: &mut [(u32, Bounds)], depth: u32, later: &mut [(u32, Bounds)]) -> usize {
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
/// kept. `later` is scratch memory for as many.
fn partition<T: Copy>(values: &mut [T], is_first: impl Fn(&T) -> bool, later: &mut [T]) -> usize {
    let mut first = 0;
    for i in 0..values.len() {
        let value = values[i];
        if is_first(&value) {
            values[first] = value;
            first += 1;
        } else {
            later[i - first] = value;
        }
    }
    let rest = &mut values[first..];
    rest.copy_from_slice(&later[..rest.len()]);
    first
}

/// Rounds up; for numbers of samples. (`f64::ceil` is a call into the C library, as SSE4.1 is not assumed: gathering in
/// Sponza with 45,000 bright patches takes 4 % longer with it.)
#[inline(always)]
fn ceil(x: f64) -> i32 {
    // 1.5 · 2^52: in a sum with it, the lowest bits are an integer.
    const TO_INTEGER: f64 = 6_755_399_441_055_744.0;
    let sum = x + TO_INTEGER;
    sum.to_bits() as i32 + i32::from(sum - TO_INTEGER < x)
}

#[cfg(test)]
mod tests {
    use super::super::light_node::importance;
    use super::*;
    use crate::base::sampling::{uniform, uniform_sphere};
    use std::f32::consts::PI;

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
        let tree = LightTree::new(Isa::best(), &lights).unwrap();
        let mut descent = Descent::default();
        for i in 0..40 {
            let r = |d| uniform(i, d, 2);
            let position = Vec3::new(r(0), r(1), r(2)) * 14.0 - 2.0;
            let normal = uniform_sphere([r(3), r(4)]);
            let mut due = vec![0.0; lights.len()];
            let (rounds, n) = (2000, 16);
            let mut sampled = vec![0.0; lights.len()];
            for round in 0..rounds {
                tree.sample(
                    (position, normal),
                    n,
                    (round as f32 + 0.5) / rounds as f32,
                    &mut descent,
                    |_| (),
                    |light, d, count| {
                        due[light] = d;
                        sampled[light] += count as f32 / rounds as f32;
                        assert!(count as f32 >= d.floor() && count as f32 <= d.ceil());
                    },
                );
            }
            let total: f32 = due.iter().sum();
            assert!(total < n as f32 * 1.0001);
            for (light, b) in lights.iter().enumerate() {
                assert!((sampled[light] - due[light]).abs() < 1e-3, "{} {}", sampled[light], due[light]);
                // (What is due less often than once in all rounds may not be seen.)
                if importance(b, position, normal) > 3e-4 * b.power {
                    assert!(due[light] > 0.0, "light {light} at {i}");
                }
            }
        }
    }

    #[test]
    fn what_cannot_contribute_has_no_importance() {
        let b =
            Bounds { lower: Vec3::ZERO, upper: Vec3::ZERO, axis: Vec3::Z, spread: 0.0, reach: PI / 2.0, power: 1.0 };
        assert_eq!(importance(&b, Vec3::new(0.5, 0.0, -1.0), Vec3::Z), 0.0, "behind an area light");
        assert_eq!(importance(&b, Vec3::new(0.5, 0.0, 1.0), Vec3::Z), 0.0, "below the horizon");
        assert!((importance(&b, Vec3::Z * 2.0, -Vec3::Z) - 0.25).abs() < 1e-6);
        let spot = Bounds { spread: 0.3, reach: 0.0, ..b };
        assert_eq!(importance(&spot, Vec3::new(0.32, 0.0, 1.0), -Vec3::Z), 0.0, "outside a cone");
        assert!(importance(&spot, Vec3::new(0.28, 0.0, 1.0), -Vec3::Z) > 0.85);
    }

    #[test]
    fn partitions_are_stable_sorts() {
        let values: Vec<(u32, u32)> = (0..1000).map(|i| (crate::base::sampling::mix(i) % 7, i)).collect();
        for from in 0..=7 {
            let (mut sorted, mut parted, mut later) = (values.clone(), values.clone(), values.clone());
            sorted.sort_by_key(|v| v.0 >= from);
            let first = partition(&mut parted, |v| v.0 < from, &mut later);
            assert_eq!((parted, first), (sorted, values.iter().filter(|v| v.0 < from).count()));
        }
    }

    #[test]
    fn lights_in_one_place_and_no_lights_make_trees() {
        let b = random_lights(1, 3)[0];
        let (mut seen, mut descent) = (0, Descent::default());
        LightTree::new(Isa::best(), &[b; 100]).unwrap().sample(
            (b.lower - b.axis, Vec3::X),
            50,
            0.5,
            &mut descent,
            |_| (),
            |_, _, count| seen += count,
        );
        assert!(seen == 50 || seen == 0);
        LightTree::new(Isa::best(), &[]).unwrap().sample(
            (Vec3::ZERO, Vec3::X),
            50,
            0.5,
            &mut descent,
            |_| (),
            |_, _, _| panic!(),
        );
    }
}
