//! Collapse of a binary tree that lies in scratch files to one that does, too: one thread goes through the nodes in the order
//! of their leaves, counts them, and writes them the second time, so that what is read and written at a time lies together
//! and nothing else is kept. The trees are those of `collapse`, bit for bit, which fills them in by several threads, by
//! plans that take memory.

use super::binary::{BinaryBvh, BinaryNode};
use super::collapse::{LEAVES, LeafBlock, NODES_PER_BLOCK, Plan, Subtree, for_each_plan, node};
use super::compact::{self, Compact, CompactNode};
use super::layout::{LEAF_PAD, LEAF_STRIDE, Mbvh, Node, WIDTH};
use crate::base::array::Array;
use crate::base::error::Result;
use crate::base::memory::try_zeroed;
use crate::base::progress::Progress;
use crate::base::scratch_files::Storage;
use bytemuck::Pod;
use glam::Vec3;

/// Collapses a binary tree to one of full nodes and leaves.
pub(super) fn collapse(
    binary: &BinaryBvh,
    corners: &impl Fn(u32) -> [Vec3; 3],
    storage: Storage,
    progress: &Progress,
) -> Result<Mbvh> {
    let n = binary.triangles.len();
    let mut leaves = storage.zeroed(n * LEAF_STRIDE + LEAF_PAD, try_zeroed, LEAVES)?;
    let mut rest = &mut leaves[..n * LEAF_STRIDE];
    let mut block = LeafBlock::default();
    let mut fill = |block: &mut LeafBlock| {
        let (rows, others) = std::mem::take(&mut rest).split_at_mut(block.triangles.len() * LEAF_STRIDE);
        rest = others;
        block.fill(rows, corners)?;
        block.clear();
        Ok(())
    };
    let add = |leaf: &BinaryNode| {
        block.add(leaf, binary)?;
        if block.triangles.len() >= FEW { fill(&mut block) } else { Ok(()) }
    };
    let nodes = nodes(binary, storage, progress, |_, node| node, add)?;
    fill(&mut block)?;
    leaves.at_random();
    let root = &binary.nodes[0];
    Ok(Mbvh { nodes, leaves, bounds: (root.lower, root.upper) })
}

/// Number of triangles that are written at a time, about as many as in the blocks of `collapse`.
const FEW: usize = 6 * NODES_PER_BLOCK;

/// Collapses a binary tree to one of compact nodes and leaves; `meshes` as in [`Compact::new`].
pub(super) fn collapse_compact(
    binary: &BinaryBvh,
    meshes: &[u32],
    storage: Storage,
    progress: &Progress,
) -> Result<Compact> {
    let n = binary.triangles.len();
    let mut triangles = storage.zeroed(n + compact::PAD, try_zeroed, LEAVES)?;
    let mut done = 0;
    let make = |plan: &Plan<WIDTH>, node: Node| CompactNode::new(&node, plan.first_node, plan.first_slot);
    let nodes = nodes(binary, storage, progress, make, |leaf| {
        let of_leaf = &binary.triangles[leaf.index as usize..][..leaf.count as usize];
        triangles[done..][..of_leaf.len()].copy_from_slice(of_leaf);
        done += of_leaf.len();
        triangles[done - 1] |= compact::LAST;
        Ok(())
    })?;
    triangles[n..].fill(compact::LAST | compact::GONE);
    triangles.at_random();
    let root = &binary.nodes[0];
    Compact::new(nodes, triangles, (root.lower, root.upper), meshes)
}

/// Makes the nodes, and calls `leaf` with each leaf in order.
fn nodes<N: Pod>(
    binary: &BinaryBvh,
    storage: Storage,
    progress: &Progress,
    make: impl Fn(&Plan<WIDTH>, Node) -> N,
    mut leaf: impl FnMut(&BinaryNode) -> Result<()>,
) -> Result<Array<N>> {
    let root = Subtree::root(binary);
    let count = for_each_plan::<WIDTH>(binary, root, progress, |_, _, _| Ok(()))?;
    let mut nodes = storage.zeroed::<N>(count, try_zeroed, "the tree")?;
    for_each_plan(binary, root, progress, |target, plan, _| {
        nodes[target] = make(&plan, node(binary, &plan));
        plan.leaves(binary).try_for_each(&mut leaf)
    })?;
    nodes.at_random();
    Ok(nodes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::sampling::uniform;
    use crate::base::scratch_files::ScratchFiles;
    use crate::bvh::{BuildOptions, BuildQuality, BuildStorage, References, Tree, build};

    fn bytes<T: Pod>(array: &Array<T>) -> &[u8] {
        bytemuck::cast_slice(array)
    }

    #[test]
    fn trees_in_files_have_the_bits_of_those_in_memory() {
        let folder = std::env::temp_dir().join(format!("bakelite-trees-in-files-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let files = ScratchFiles::new(folder.clone());
        for (n, max_leaf) in [(1, 4), (2, 1), (7, 8), (1_000, 4), (70_000, 4), (70_000, 1)] {
            // Every hundredth is large, so that leaves lie high up in the tree.
            let of = |i: u32| {
                let size = if i.is_multiple_of(100) { 1.0 } else { 0.01 };
                let point = |k| Vec3::new(uniform(i, k, 1), uniform(i, k + 1, 1), uniform(i, k + 2, 1));
                [point(0), point(0) + size * point(3), point(0) + size * point(6)]
            };
            let is_valid = |c: [Vec3; 3]| n < 100 || c[0].x < 0.9;
            for (quality, compact) in BuildQuality::ALL.into_iter().flat_map(|q| [(q, false), (q, true)]) {
                let options = BuildOptions { max_leaf, quality, compact, ..Default::default() };
                let tree = |storage| {
                    let (storage, none) = (BuildStorage::new(storage, storage, &options), Progress::none());
                    let references = References::of_valid(n, &of, is_valid, storage.work, &none).unwrap();
                    build(&of, references, &[0, n as u32], &options, storage, &none).unwrap()
                };
                match (tree(Storage::MEMORY), tree(Storage::new(Some(&files)))) {
                    ((Tree::Whole(a), cost), (Tree::Whole(b), other_cost)) => {
                        assert_eq!((cost, a.bounds, bytes(&a.leaves)), (other_cost, b.bounds, bytes(&b.leaves)));
                        assert_eq!(bytes(&a.nodes), bytes(&b.nodes));
                        assert!(n < 70_000 || b.nodes.is_mapped() && b.leaves.is_mapped() && !a.nodes.is_mapped());
                    }
                    ((Tree::Compact(a), cost), (Tree::Compact(b), other_cost)) => {
                        assert_eq!((cost, a.bounds(), bytes(&a.nodes)), (other_cost, b.bounds(), bytes(&b.nodes)));
                        assert_eq!(bytes(&a.triangles), bytes(&b.triangles));
                        assert!(n < 70_000 || b.nodes.is_mapped() && b.triangles.is_mapped());
                    }
                    _ => panic!("trees of two kinds"),
                }
            }
        }
        std::fs::remove_dir(&folder).expect("files have no names");
    }

    #[test]
    fn a_folder_that_is_not_there_is_an_error_and_a_cancel_ends_it() {
        let of = |i: u32| [0, 3, 6].map(|k| Vec3::new(uniform(i, k, 1), uniform(i, k + 1, 1), uniform(i, k + 2, 1)));
        let files = ScratchFiles::new("/nowhere/at/all".into());
        let references =
            References::of_valid(1_000, &of, |_| true, Storage::new(Some(&files)), &Progress::none()).err().unwrap();
        assert!(references.to_string().contains("scratch file"), "{references}");
        let files = ScratchFiles::new(std::env::temp_dir());
        let storage = Storage::new(Some(&files));
        let references = References::of_valid(50_000, &of, |_| true, storage, &Progress::none()).unwrap();
        let binary = BinaryBvh::of(references, &BuildOptions::default(), storage, &Progress::none()).unwrap();
        let cancelled = collapse(&binary, &of, storage, &Progress::new(|_, _| false));
        assert!(matches!(cancelled, Err(crate::base::error::Error::Cancelled)));
    }
}
