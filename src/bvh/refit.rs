//! Refit: puts new corners into an existing tree. Leaf rows are rewritten, boxes and orders of children computed anew
//! from the leaves up; the assignment of triangles to leaves and of leaves to nodes stays. (Compact trees:
//! `compact_refit`.)
//!
//! The tree is processed in memory order (see [`Part`]): threads share neither nodes nor rows, those of each are
//! contiguous, and the result does not depend on their number.

use super::collapse::set_box;
use super::layout::{ChildRef, LEAF_PAD, LEAF_STRIDE, Mbvh, Node, WIDTH};
use super::references::{Box4, triangle_box};
use crate::base::geometry::is_valid_triangle;
use crate::base::parallel::ParallelLoop;
use glam::Vec3;
use rayon::prelude::*;

/// Subtrees of more nodes than this are shared among threads.
const PARALLEL_SUBTREE: usize = 256;

/// The part of the tree below a node, which is contiguous in memory because the collapse works depth-first: the node's
/// inner children, one after the other, then all nodes below the first of them, below the second, and so on; and the
/// rows of the node's leaves, then of those below the first inner child, and so on.
#[derive(Default)]
struct Part<'a> {
    nodes: &'a mut [Node],
    /// Index of `nodes[0]`.
    first_node: usize,
    rows: &'a mut [f32],
    /// Triangle slot at which `rows` begins.
    first_slot: usize,
}

/// Moves the triangles of `tree` to the corners given by `corners` (by global number). Triangles that become degenerate
/// or not finite, so that no ray can hit them, stay in the tree and can come back with the next refit; they widen no
/// box. If no triangle is left, boxes are empty, the bounds too. Takes no memory.
///
/// Leaf boxes become those of whole triangles: where spatial splits had cut triangles, they are larger
/// than the builder's even if nothing moved.
pub(crate) fn refit(tree: &mut Mbvh, corners: &(impl Fn(u32) -> [Vec3; 3] + Sync)) {
    let (root, nodes) = tree.nodes.split_first_mut().expect("there is a root");
    let end = tree.leaves.len() - LEAF_PAD;
    let part = Part { nodes, first_node: 1, rows: &mut tree.leaves[..end], first_slot: 0 };
    tree.bounds = refit_node(root, part, corners).corners();
}

/// Refits a node with all nodes below it; returns the box around them.
fn refit_node(node: &mut Node, part: Part, corners: &(impl Fn(u32) -> [Vec3; 3] + Sync)) -> Box4 {
    let parallel = part.nodes.len() > PARALLEL_SUBTREE;
    let Part { nodes, first_node, rows, first_slot } = part;
    let mut boxes = [Box4::EMPTY; WIDTH];

    let mut used = 0;
    for (i, leaf) in leaves(node) {
        let count = leaf.leaf_count();
        debug_assert!(leaf.leaf_slot() == first_slot + used / LEAF_STRIDE);
        boxes[i] = refit_leaf(&mut rows[used..][..LEAF_STRIDE * count], corners);
        used += LEAF_STRIDE * count;
    }

    // The parts of the inner children, split off from the back: the start of a child's nodes and rows is known from
    // itself, their end from the next child.
    let inner = inner(node).count();
    let (block, mut nodes) = nodes.split_at_mut(inner);
    let (mut rows, first_node) = (&mut rows[used..], first_node + inner);
    let first_slot = first_slot + used / LEAF_STRIDE;
    let mut shares: [Option<(&mut Node, Part, Box4)>; WIDTH] = Default::default();
    for (share, child) in shares[..inner].iter_mut().zip(block).rev() {
        let node = self::inner(child).next().map_or(first_node + nodes.len(), |(_, c)| c.node_index());
        let (before, own_nodes) = nodes.split_at_mut(node - first_node);
        let slot = first_slot_below(child, own_nodes, node);
        let (rows_before, own_rows) = rows.split_at_mut((slot - first_slot) * LEAF_STRIDE);
        let part = Part { nodes: own_nodes, first_node: node, rows: own_rows, first_slot: slot };
        *share = Some((child, part, Box4::EMPTY));
        (nodes, rows) = (before, rows_before);
    }
    let run = |share: &mut Option<(&mut Node, Part, Box4)>| {
        let (child, part, below) = share.as_mut().expect("as many as there are inner children");
        *below = refit_node(child, std::mem::take(part), corners);
    };
    if parallel {
        shares[..inner].par_iter_mut().with_max_len(1).each(run);
    } else {
        shares[..inner].iter_mut().for_each(run);
    }
    for ((i, _), share) in self::inner(node).zip(shares) {
        let (_, _, below) = share.expect("as many as there are inner children");
        boxes[i] = below;
    }

    for (i, b) in boxes.iter().enumerate() {
        set_box(node, i, b);
    }
    node.sort_children();
    boxes.into_iter().fold(Box4::EMPTY, Box4::join)
}

fn leaves(node: &Node) -> impl Iterator<Item = (usize, ChildRef)> + use<> {
    node.children.into_iter().enumerate().filter(|(_, c)| c.is_leaf() && *c != ChildRef::EMPTY)
}

fn inner(node: &Node) -> impl Iterator<Item = (usize, ChildRef)> + use<> {
    node.children.into_iter().enumerate().filter(|(_, c)| !c.is_leaf())
}

/// The first triangle slot below `node`; `below` are the nodes below it, from index `first` on.
fn first_slot_below<'a>(mut node: &'a Node, below: &'a [Node], first: usize) -> usize {
    loop {
        if let Some((_, leaf)) = leaves(node).next() {
            return leaf.leaf_slot();
        }
        let (_, child) = inner(node).next().expect("a node has children");
        node = &below[child.node_index() - first];
    }
}

/// Rewrites the rows of a leaf and returns its box.
fn refit_leaf(rows: &mut [f32], corners: &impl Fn(u32) -> [Vec3; 3]) -> Box4 {
    let count = rows.len() / LEAF_STRIDE;
    let mut bounds = Box4::EMPTY;
    for k in 0..count {
        let triangle = rows[9 * count + k].to_bits();
        let mut c = corners(triangle);
        if is_valid_triangle(c) {
            bounds = bounds.join(triangle_box(c));
        } else {
            // Its edge functions are NaN: no ray is inside.
            c = [Vec3::NAN; 3];
        }
        for row in 0..9 {
            rows[row * count + k] = c[row / 3][row % 3];
        }
    }
    bounds
}

#[cfg(test)]
mod tests {
    use super::super::collapse::collapse;
    use super::super::{BuildOptions, BuildQuality, References, build_binary};
    use super::*;
    use crate::base::progress::Progress;
    use crate::base::sampling::{uniform, uniform_sphere};
    use crate::base::scratch_files::Storage;
    use crate::simd::Isa;

    use crate::trace::{Kernels, RawHit, Ray};
    use bytemuck::bytes_of;
    use glam::Quat;
    use proptest::prelude::*;

    type Triangles = Vec<[Vec3; 3]>;

    fn point(i: u32, dimension: u32, seed: u32) -> Vec3 {
        Vec3::from_array([0, 1, 2].map(|a| uniform(i, dimension + a, seed)))
    }

    /// Small triangles and long needles in the unit cube.
    fn soup(n: usize, seed: u32) -> Triangles {
        (0..n as u32)
            .map(|i| {
                let (a, b) = (point(i, 0, seed), point(i, 3, seed));
                let size = if i % 5 == 0 { 1.0 } else { 0.05 };
                [a, a + size * (b - a), a + 0.05 * point(i, 6, seed)]
            })
            .collect()
    }

    fn tree(corners: &Triangles, options: &BuildOptions) -> Mbvh {
        let valid: Vec<u32> = (0..corners.len() as u32).filter(|&t| is_valid_triangle(corners[t as usize])).collect();
        let (none, of) = (Progress::none(), |t: u32| corners[t as usize]);
        let references = References::of(&valid, &of).unwrap();
        collapse(&build_binary(&of, references, options, Storage::MEMORY, &none).unwrap(), &of, &none).unwrap()
    }

    /// The tree after a refit, and the triangles that no ray can hit.
    fn moved(mut tree: Mbvh, corners: &Triangles) -> (Mbvh, Vec<u32>) {
        refit(&mut tree, &|t| corners[t as usize]);
        let mut out = Vec::new();
        for (_, leaf) in tree.nodes.iter().flat_map(leaves) {
            let (slot, count) = (leaf.leaf_slot() * LEAF_STRIDE, leaf.leaf_count());
            let rows = &tree.leaves[slot..][..LEAF_STRIDE * count];
            out.extend((0..count).filter(|&k| rows[k].is_nan()).map(|k| rows[9 * count + k].to_bits()));
        }
        // Several times if cut.
        out.sort_unstable();
        out.dedup();
        (tree, out)
    }

    /// All of a tree, bit by bit.
    fn bits(tree: &Mbvh) -> (Vec<u8>, Vec<u32>, [u32; 6]) {
        let node =
            |n: &Node| [bytes_of(&n.lower), bytes_of(&n.upper), bytes_of(&n.children), bytes_of(&n.order)].concat();
        let (l, u) = tree.bounds;
        let bounds = [l.x, l.y, l.z, u.x, u.y, u.z].map(f32::to_bits);
        (
            tree.nodes.iter().flat_map(node).collect(),
            tree.leaves[..tree.leaves.len() - LEAF_PAD].iter().map(|x| x.to_bits()).collect(),
            bounds,
        )
    }

    fn rays(n: u32, centre: Vec3, radius: f32) -> Vec<Ray> {
        (0..n)
            .map(|i| {
                let from = centre + radius * uniform_sphere([uniform(i, 0, 9), uniform(i, 1, 9)]);
                let to = centre + 0.7 * radius * (2.0 * point(i, 2, 9) - 1.0);
                let direction = (to - from).to_array();
                Ray { origin: from.to_array(), tmin: 0.0, direction, tmax: f32::INFINITY }
            })
            .collect()
    }

    fn hits(tree: &Mbvh, rays: &[Ray]) -> Vec<RawHit> {
        let kernels = Isa::ALL.into_iter().filter(|isa| isa.is_available()).map(Kernels::for_isa);
        let mut all = Vec::new();
        for k in kernels {
            for r in rays {
                let hit = k.intersect(tree, r);
                assert_eq!(k.occluded(tree, r), !hit.is_miss());
                all.push(hit);
            }
        }
        all
    }

    /// Checks that hits have the same t and, if they are on the same triangle, the same u and v; other triangles may
    /// tie.
    fn assert_same_hits(a: &Mbvh, b: &Mbvh, rays: &[Ray]) -> usize {
        let (a, b) = (hits(a, rays), hits(b, rays));
        for (i, (a, b)) in a.iter().zip(&b).enumerate() {
            assert_eq!(a.t.to_bits(), b.t.to_bits(), "ray {i}: {a:?}, {b:?}");
            if a.triangle == b.triangle {
                assert_eq!((a.u.to_bits(), a.v.to_bits()), (b.u.to_bits(), b.v.to_bits()), "ray {i}");
            }
        }
        a.iter().filter(|h| !h.is_miss()).count()
    }

    fn high() -> BuildOptions {
        BuildOptions { quality: BuildQuality::High, split_budget: 0.5, ..Default::default() }
    }

    #[test]
    fn a_refit_of_what_did_not_move_changes_no_bit() {
        for (n, max_leaf) in [(1usize, 3), (2, 1), (5, 8), (9, 1), (300, 2), (20_000, 3)] {
            let options = BuildOptions { max_leaf, ..Default::default() };
            for scale in [1.0, -1.0, 1e-18, 1e11] {
                let corners: Triangles = soup(n, 1).into_iter().map(|t| t.map(|c| c * scale)).collect();
                let before = tree(&corners, &options);
                let expected = bits(&before);
                let (after, out) = moved(before, &corners);
                assert!(bits(&after) == expected && out.is_empty(), "{n} triangles, scale {scale}");
            }
        }
    }

    #[test]
    fn moved_triangles_are_hit_as_in_a_new_tree() {
        for options in [BuildOptions::default(), BuildOptions { max_leaf: 8, ..Default::default() }, high()] {
            let from = soup(5000, 1);
            for to in [soup(5000, 2), from.iter().map(|t| t.map(|c| 3.0 * c + Vec3::splat(2.0))).collect()] {
                let (refitted, out) = moved(tree(&from, &options), &to);
                let fresh = tree(&to, &options);
                assert!(out.is_empty());
                assert_eq!(refitted.bounds, fresh.bounds);
                let (l, u) = fresh.bounds;
                let n = assert_same_hits(&refitted, &fresh, &rays(2000, 0.5 * (l + u), (u - l).length()));
                assert!(n > 500, "{n} hits only");
            }
        }
    }

    #[test]
    fn there_and_back_again_is_the_first_tree() {
        let (from, to) = (soup(4000, 1), soup(4000, 2));
        let before = tree(&from, &BuildOptions::default());
        let expected = bits(&before);
        let back = moved(moved(before, &to).0, &from).0;
        assert!(bits(&back) == expected);
    }

    #[test]
    fn cut_triangles_get_whole_boxes_and_the_cost_says_so() {
        let corners = soup(5000, 1);
        let before = tree(&corners, &high());
        let (cost, rays) = (before.sah_cost(), rays(2000, Vec3::splat(0.5), 2.0));
        let expected = hits(&before, &rays);
        let after = moved(before, &corners).0;
        assert!(after.sah_cost() > 1.05 * cost, "{} after {cost}", after.sah_cost());
        assert!(hits(&after, &rays).iter().zip(&expected).all(|(a, b)| a.t.to_bits() == b.t.to_bits()));
        covers(&after, &corners);
    }

    #[test]
    fn the_cost_stays_under_rigid_moves_and_grows_when_neighbours_part() {
        let corners = soup(5000, 1);
        let before = tree(&corners, &BuildOptions::default());
        let cost = before.sah_cost();
        let turn = Quat::from_rotation_z(std::f32::consts::FRAC_PI_2);
        let turned: Triangles = corners.iter().map(|t| t.map(|c| turn * c + Vec3::new(5.0, 0.0, -7.0))).collect();
        let (rigid, _) = moved(before, &turned);
        assert!((rigid.sah_cost() / cost - 1.0).abs() < 1e-3, "{} after {cost}", rigid.sah_cost());
        covers(&rigid, &turned);
        let scattered = moved(rigid, &soup(5000, 2)).0;
        assert!(scattered.sah_cost() > 3.0 * cost);
    }

    #[test]
    fn the_result_does_not_depend_on_the_number_of_threads() {
        let (from, mut to) = (soup(60_000, 1), soup(60_000, 2));
        for i in (0..to.len()).step_by(77) {
            to[i][1] = Vec3::NAN;
        }
        for options in [BuildOptions::default(), high()] {
            let results: Vec<_> = [1, 2, 7]
                .into_iter()
                .map(|n| {
                    let pool = rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
                    let (tree, out) = pool.install(|| moved(tree(&from, &options), &to));
                    (bits(&tree), tree.sah_cost().to_bits(), out)
                })
                .collect();
            assert!(results.iter().all(|r| *r == results[0]));
        }
    }

    #[test]
    fn what_becomes_no_triangle_is_not_hit_until_it_is_one_again() {
        let from = soup(3000, 1);
        let rays = rays(2000, Vec3::splat(0.5), 2.0);
        for options in [BuildOptions::default(), high()] {
            let mut to = from.clone();
            let bad = [Vec3::NAN, Vec3::INFINITY, Vec3::splat(2e12), Vec3::new(0.5, f32::NEG_INFINITY, 0.5)];
            let mut gone: Vec<u32> = Vec::new();
            for t in (0..to.len()).filter(|t| t % 3 != 0) {
                gone.push(t as u32);
                match t % 8 {
                    k @ 0..4 => to[t][k % 3] = bad[k],
                    4..6 => to[t] = [to[t][0]; 3],
                    _ => to[t][2] = to[t][0],
                }
            }
            let (refitted, out) = moved(tree(&from, &options), &to);
            assert_eq!(out, gone);
            let fresh = tree(&to, &options);
            assert_eq!(refitted.bounds, fresh.bounds);
            assert!(assert_same_hits(&refitted, &fresh, &rays) > 200);
            assert!(refitted.sah_cost().is_finite());
            covers(&refitted, &to);
            let (back, out) = moved(refitted, &from);
            assert!(out.is_empty());
            assert_same_hits(&back, &tree(&from, &options), &rays);
        }
    }

    #[test]
    fn nothing_is_left_of_a_tree_of_points() {
        let from = soup(500, 1);
        let to: Triangles = vec![[Vec3::ONE; 3]; from.len()];
        let (empty, out) = moved(tree(&from, &BuildOptions::default()), &to);
        assert_eq!(out.len(), from.len());
        assert!(hits(&empty, &rays(300, Vec3::ONE, 1.0)).iter().all(|h| h.is_miss()));
        assert!(empty.nodes.iter().all(|n| n.lower[0] == [f32::INFINITY; WIDTH]));
    }

    /// Every triangle that can be hit lies in the boxes of all nodes above it; no box holds a NaN.
    fn covers(tree: &Mbvh, corners: &Triangles) {
        fn below(tree: &Mbvh, child: ChildRef, corners: &Triangles) -> Vec<Vec3> {
            if child.is_leaf() {
                let (slot, n) = (child.leaf_slot() * LEAF_STRIDE, child.leaf_count());
                let ids = tree.leaves[slot + 9 * n..][..n].iter().map(|x| x.to_bits() as usize);
                return ids.map(|t| corners[t]).filter(|c| is_valid_triangle(*c)).flatten().collect();
            }
            let node = &tree.nodes[child.node_index()];
            let mut all = Vec::new();
            for (i, c) in node.children.iter().enumerate().filter(|(_, c)| **c != ChildRef::EMPTY) {
                let [lower, upper] = [node.lower, node.upper].map(|b| Vec3::new(b[0][i], b[1][i], b[2][i]));
                assert!(!lower.is_nan() && !upper.is_nan());
                let points = below(tree, *c, corners);
                assert!(points.iter().all(|p| p.cmpge(lower).all() && p.cmple(upper).all()));
                all.extend(points);
            }
            all
        }
        below(tree, ChildRef::node(0), corners);
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 48, failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn any_moves_give_the_hits_of_a_new_tree(
            n in 1usize..400,
            seed in any::<u32>(),
            max_leaf in 1u32..=8,
            cuts in any::<bool>(),
            moves in prop::collection::vec((any::<prop::sample::Index>(), -2.0f32..3.0, 0u32..6), 0..60),
            grid in any::<bool>(),
        ) {
            let quality = if cuts { BuildQuality::High } else { BuildQuality::Default };
            let options = BuildOptions { max_leaf, quality, split_budget: 1.0, ..Default::default() };
            let snap = |c: Vec3| if grid { (c * 4.0).round() } else { c };
            let mut from: Triangles = soup(n, seed);
            from[0] = [Vec3::ZERO, Vec3::X, Vec3::Y];
            // What is degenerate at the build is not in the tree, even if it moves.
            let mut to: Triangles = from.iter().map(|t| t.map(snap)).collect();
            for (which, by, kind) in &moves {
                let t = which.index(n);
                match kind {
                    0 => to[t] = to[t].map(|c| c + by * Vec3::new(1.0, 0.5, -0.25)),
                    1 => to[t][t % 3] *= *by,
                    2 => to[t][2] = to[t][1],
                    3 => to[t][0].y = f32::NAN,
                    4 => to[t] = to[t].map(|c| c * 1e6 * by),
                    _ => to[t].swap(0, 1),
                }
            }
            to[0] = from[0];
            let (refitted, _) = moved(tree(&from, &options), &to);
            covers(&refitted, &to);
            let fresh = tree(&to, &options);
            prop_assert_eq!(refitted.bounds, fresh.bounds);
            assert_same_hits(&refitted, &fresh, &rays(200, Vec3::splat(0.5), if grid { 8.0 } else { 2.0 }));
        }
    }
}
