//! Refit of the compact tree, as [`refit`](super::refit) does it for full nodes. Numbers of triangles that no ray can
//! hit are marked, and boxes computed anew from the leaves up, level by level; children keep their slots in their
//! nodes.
//!
//! Threads share a level; the result does not depend on their number.

use super::collapse::set_box;
use super::compact::{Compact, CompactNode, GONE, NUMBER, PAD};
use super::layout::{ChildRef, Node};
use super::references::{Box4, triangle_box};
use crate::base::error::Result;
use crate::base::geometry::is_valid_triangle;
use crate::base::memory::{try_filled, try_with_capacity};
use crate::base::parallel::ParallelLoop;
use glam::Vec3;
use rayon::prelude::*;

/// Number of nodes or triangles that a thread takes at a time.
const CHUNK: usize = 256;

/// Working memory of a refit.
pub(crate) struct Room {
    /// The box of each node.
    boxes: Vec<Box4>,
    /// The nodes in order of their distance from the root, and the start of each distance, with the number of nodes at
    /// the end.
    order: Vec<u32>,
    levels: Vec<usize>,
    /// Buffer as large as the largest level.
    done: Vec<(CompactNode, Box4)>,
}

impl Room {
    pub(super) fn new(tree: &Compact) -> Result<Room> {
        let nodes = &tree.nodes;
        let what = "working memory of the refit";
        let mut order = try_with_capacity(nodes.len(), what)?;
        order.push(ChildRef::node(0).bits());
        let mut levels = vec![0];
        let mut largest = 1;
        while let Some(&begin) = levels.last().filter(|&&begin| begin < order.len()) {
            let end = order.len();
            for i in begin..end {
                order.extend(nodes[order[i] as usize].inner().map(|(_, c)| c.bits()));
            }
            largest = largest.max(end - begin);
            levels.push(end);
        }
        let boxes = try_filled(nodes.len(), Box4::EMPTY, what)?;
        Ok(Room { boxes, order, levels, done: try_with_capacity(largest, what)? })
    }
}

/// Refits the tree as [`super::refit::refit`] does.
pub(super) fn refit(tree: &mut Compact, corners: &(impl Fn(u32) -> [Vec3; 3] + Sync), room: Room) {
    let end = tree.triangles.len() - PAD;
    tree.triangles[..end].par_iter_mut().with_min_len(CHUNK).each(|t| {
        *t = if is_valid_triangle(corners(*t & NUMBER)) { *t & !GONE } else { *t | GONE };
    });
    let Room { mut boxes, order, levels, mut done } = room;
    for level in levels.windows(2).rev().map(|w| &order[w[0]..w[1]]) {
        let work = level.par_iter().with_min_len(CHUNK);
        done.clear();
        work.map(|&i| refit_node(tree, i as usize, &boxes, corners)).collect_into_capacity(&mut done);
        for (&i, (node, bounds)) in level.iter().zip(&done) {
            (tree.nodes[i as usize], boxes[i as usize]) = (*node, *bounds);
        }
    }
    tree.bounds = boxes[0].corners();
}

/// Computes a node with new boxes, and the box around them; `boxes` are those of the nodes below.
fn refit_node(
    tree: &Compact,
    number: usize,
    boxes: &[Box4],
    corners: &impl Fn(u32) -> [Vec3; 3],
) -> (CompactNode, Box4) {
    let mut node = tree.nodes[number];
    let (mut whole, mut bounds) = (Node::EMPTY, Box4::EMPTY);
    let leaf_box = |leaf| {
        let there = tree.leaf_triangles(leaf).iter().filter(|&t| t & GONE == 0);
        there.fold(Box4::EMPTY, |b, t| b.join(triangle_box(corners(t & NUMBER))))
    };
    let leaves = node.leaves().map(|(i, leaf)| (i, leaf_box(leaf)));
    for (i, b) in leaves.chain(node.inner().map(|(i, c)| (i, boxes[c.node_index()]))) {
        set_box(&mut whole, i, &b);
        bounds = bounds.join(b);
    }
    node.set_boxes(&whole);
    (node, bounds)
}

#[cfg(test)]
mod tests {
    use super::super::BinaryBvh;
    use super::super::collapse::collapse_compact;
    use super::*;
    use crate::base::progress::Progress;
    use crate::base::sampling::uniform;

    fn soup(n: u32, seed: u32) -> Vec<[Vec3; 3]> {
        let point = |i, k: u32| Vec3::from_array([0, 1, 2].map(|a| uniform(i, k + a, seed)));
        (0..n).map(|i| [3, 6, 9].map(|k| point(i, 0) + 0.05 * point(i, k))).collect()
    }

    fn tree(corners: &[[Vec3; 3]]) -> Compact {
        let n = corners.len() as u32;
        let ids: Vec<u32> = (0..n).collect();
        let binary = BinaryBvh::build(&|t| corners[t as usize], &ids, &Default::default(), &Progress::none()).unwrap();
        collapse_compact(&binary, &[0, n], &Progress::none()).unwrap()
    }

    /// A refit; the triangles that no ray can hit afterwards.
    fn refit_here(tree: &mut Compact, corners: &(impl Fn(u32) -> [Vec3; 3] + Sync)) -> Vec<u32> {
        let room = Room::new(tree).unwrap();
        refit(tree, corners, room);
        let gone = tree.triangles[..tree.triangles.len() - PAD].iter().filter(|&t| t & GONE != 0);
        let mut out: Vec<u32> = gone.map(|t| t & NUMBER).collect();
        out.sort_unstable();
        out
    }

    fn bits(tree: &Compact) -> (Vec<u8>, Vec<u32>, (Vec3, Vec3)) {
        (bytemuck::cast_slice(&tree.nodes).to_vec(), tree.triangles.to_vec(), tree.bounds)
    }

    #[test]
    fn a_refit_of_what_did_not_move_changes_no_bit() {
        for n in [1, 2, 5, 9, 300, 20_000] {
            let corners = soup(n, 1);
            let mut tree = tree(&corners);
            let before = bits(&tree);
            assert!(refit_here(&mut tree, &|t| corners[t as usize]).is_empty());
            assert!(bits(&tree) == before, "{n} triangles");
        }
    }

    #[test]
    fn the_result_does_not_depend_on_the_number_of_threads() {
        let (from, mut to) = (soup(30_000, 1), soup(30_000, 2));
        for i in (0..to.len()).step_by(77) {
            to[i][1] = Vec3::NAN;
        }
        let results = [1, 2, 7].map(|n| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
            let mut tree = tree(&from);
            let out = pool.install(|| refit_here(&mut tree, &|t| to[t as usize]));
            (bits(&tree), out)
        });
        assert_eq!(results[0].1, (0..30_000).step_by(77).collect::<Vec<u32>>());
        assert!(results.iter().all(|r| *r == results[0]));
    }
}
