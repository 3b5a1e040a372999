//! Nodes of few triangles: the cost of a leaf, and the best partition of two to four references.

use super::references::{Box4, Extent, Reference, half_areas};

/// Cost of testing n triangles, of which four are tested at a time, in traversal steps. (With n alone, random rays take
/// 3 to 4 % more instructions; with 3 + n / 2 as many.)
pub(super) fn leaf_weight(n: usize) -> f32 {
    if n <= 4 { 1.0 + 0.5 * n as f32 } else { n as f32 }
}

/// Cost of a leaf minus that of a traversal step, in the units of [`Bins::best_split`].
pub(super) fn leaf_cost(bounds: &Box4, scale: f32, n: usize) -> f32 {
    half_areas([bounds.extent() * scale; 4]).x * (leaf_weight(n) - 1.0)
}

/// A partition of two to four references: 0 to 3: that one from the others; 4 to 6: the first and one more from the
/// other two.
#[derive(Clone, Copy)]
pub(super) struct Parting(usize);

/// The best partition of two to four references, with its cost.
pub(super) fn best_parting(refs: &[Reference], scale: f32) -> (f32, Parting) {
    let n = refs.len();
    let boxes: [Box4; 4] = std::array::from_fn(|i| if i < n { refs[i].0 } else { Box4::EMPTY });
    let pair = |i: usize, j: usize| boxes[i].join(boxes[j]);
    let (p01, p23) = (pair(0, 1), pair(2, 3));
    let areas = |b: [Box4; 4]| half_areas(b.map(|b| b.extent() * scale));
    let others = [p23.join(boxes[1]), p23.join(boxes[0]), p01.join(boxes[3]), p01.join(boxes[2])];
    let ones = (areas(boxes) * leaf_weight(1) + areas(others) * leaf_weight(n - 1)).to_array();
    let mut best = (f32::INFINITY, 0);
    for i in 0..n {
        if ones[i] < best.0 {
            best = (ones[i], i);
        }
    }
    if n == 4 {
        let left = areas([p01, pair(0, 2), pair(0, 3), p01]);
        let right = areas([p23, pair(1, 3), pair(1, 2), p23]);
        let pairs = (leaf_weight(2) * (left + right)).to_array();
        for i in 0..3 {
            if pairs[i] < best.0 {
                best = (pairs[i], 4 + i);
            }
        }
    }
    (best.0, Parting(best.1))
}

/// Reorders references for a partition and returns the number on the left.
pub(super) fn part_few(refs: &mut [Reference], Parting(i): Parting) -> usize {
    if i < 4 {
        refs.swap(0, i);
        1
    } else {
        refs.swap(1, i - 3);
        2
    }
}

/// Halves references along the widest axis of their centres; ties are broken by number.
pub(super) fn halve(refs: &mut [Reference], extent: &Extent) -> usize {
    let d = extent.centres.upper - extent.centres.lower;
    let axis = if d.x >= d.y && d.x >= d.z { 0 } else { 1 + usize::from(d.z > d.y) };
    let middle = refs.len() / 2;
    refs.select_nth_unstable_by(middle, |a, b| a.centre()[axis].total_cmp(&b.centre()[axis]).then(a.id().cmp(&b.id())));
    middle
}
