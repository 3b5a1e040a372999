//! Acceleration structures: a binary tree built by binned SAH, with spatial splits if asked, collapsed to
//! the 8-wide MBVH that the kernels traverse, or to the compact one.

mod binary;
mod binned;
mod bins;
mod check;
mod collapse;
mod collapse_in_files;
pub(crate) mod compact;
mod compact_refit;
mod cut;
pub(crate) mod instances;
pub(crate) mod layout;
mod partings;
pub(crate) mod parts;
mod references;
mod refit;
mod slabs;
mod spatial;

pub use binary::{BinaryBvh, BinaryNode};
pub(crate) use collapse::outwards;
pub(crate) use compact::Compact;
pub use layout::{ChildRef, Mbvh, Node};
pub(crate) use references::References;
pub(crate) use refit::refit as refit_whole;

use crate::base::array::Array;
use crate::base::error::{Result, invalid_argument};
use crate::base::progress::Progress;
use crate::base::scratch_files::Storage;
use glam::Vec3;

/// Quality of the build, against its time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(u32)]
pub enum BuildQuality {
    /// Binned SAH (Wald 2007).
    #[default]
    Default = 0,
    /// Binned SAH with spatial splits (Stich, Friedrich and Dietrich 2009).
    High = 1,
}

/// Parameters of the builder.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BuildOptions {
    /// Bins per axis of the surface area heuristic, 2 to 256. Thesis: 64.
    pub bins: u32,
    /// Maximum number of triangles per leaf, 1 to 8. Thesis: 3 or 4; four are tested at a time. Default: 4.
    pub max_leaf: u32,
    /// Whether triangles may be cut by spatial splits.
    pub quality: BuildQuality,
    /// With [`BuildQuality::High`]: maximum number of references that cuts may add, as a fraction of the number of
    /// triangles, 0 to 4. Leaves grow by at most as much. Default: 0.25.
    pub split_budget: f32,
    /// Whether to build the compact tree, which takes a fifth of the memory; rays take longer. Hits are the same, bit
    /// for bit, except that after spatial splits a ray that grazes an edge within rounding may hit the triangle in one
    /// tree and miss it in the other. Default: false.
    pub compact: bool,
}

impl BuildQuality {
    /// Both qualities, by rising effort.
    pub const ALL: [BuildQuality; 2] = [BuildQuality::Default, BuildQuality::High];

    /// Name on the command line and in reports: "default" or "high".
    pub fn name(self) -> &'static str {
        match self {
            BuildQuality::Default => "default",
            BuildQuality::High => "high",
        }
    }
}

impl Default for BuildOptions {
    fn default() -> Self {
        BuildOptions { bins: 64, max_leaf: 4, quality: BuildQuality::Default, split_budget: 0.25, compact: false }
    }
}

impl BuildOptions {
    /// Checks the ranges documented on the fields.
    pub fn validate(&self) -> Result<()> {
        if !(2..=256).contains(&self.bins) {
            return invalid_argument!("bins is {}, outside 2 to 256", self.bins);
        }
        if !(1..=layout::MAX_LEAF as u32).contains(&self.max_leaf) {
            return invalid_argument!("max_leaf is {}, outside 1 to {}", self.max_leaf, layout::MAX_LEAF);
        }
        if !(0.0..=4.0).contains(&self.split_budget) {
            return invalid_argument!("split_budget is {}, outside 0 to 4", self.split_budget);
        }
        Ok(())
    }
}

/// Upper bound of an [`Mbvh`]'s size together with the builder's working memory, for the memory monitor.
pub fn estimated_bytes(triangles: usize, options: &BuildOptions) -> usize {
    // Bytes per triangle: 40 in leaves and up to 256/7 of nodes, or 4 and up to 80/7; with 40/7 of their plan.
    let tree = if options.compact { 22 } else { 84 };
    match options.quality {
        // Bytes during the build: 4 of numbers and up to 64 of binary nodes, to which 32 of references are added before
        // there is a tree. (Most leaves hold several triangles: real scenes take 60 % of this.)
        BuildQuality::Default => triangles * (68 + tree.max(32)),
        // Per reference twice the binary nodes and numbers, because subtrees are joined at the end.
        BuildQuality::High => {
            let references = triangles as f64 * (1.0 + f64::from(options.split_budget));
            (references * (tree as f64 + 200.0)) as usize
        }
    }
}

/// Working memory of a refit: see [`Tree::room_to_refit`].
pub(crate) type RefitRoom = Option<compact_refit::Room>;

/// A scene's acceleration structure.
pub(crate) enum Tree {
    Whole(Mbvh),
    Compact(Compact),
}

impl Tree {
    /// A tree of nothing.
    pub(crate) fn nothing() -> Self {
        Tree::Whole(Mbvh::nothing())
    }

    /// Whether this is [`Self::nothing`].
    #[inline]
    pub(crate) fn is_nothing(&self) -> bool {
        matches!(self, Tree::Whole(tree) if tree.has_no_leaves())
    }

    /// Lower and upper corner of the box around all triangles.
    pub(crate) fn bounds(&self) -> (Vec3, Vec3) {
        match self {
            Tree::Whole(t) => t.bounds(),
            Tree::Compact(t) => t.bounds(),
        }
    }

    pub(crate) fn node_count(&self) -> usize {
        match self {
            Tree::Whole(t) => t.node_count(),
            Tree::Compact(t) => t.node_count(),
        }
    }

    pub(crate) fn node_bytes(&self) -> usize {
        match self {
            Tree::Whole(t) => size_of_val(&t.nodes[..]),
            Tree::Compact(t) => t.node_bytes(),
        }
    }

    pub(crate) fn bytes(&self) -> usize {
        match self {
            Tree::Whole(t) => t.bytes(),
            Tree::Compact(t) => t.bytes(),
        }
    }

    /// Size in bytes of what lies in files.
    pub(crate) fn mapped_bytes(&self) -> usize {
        fn size<T>(array: &Array<T>) -> usize {
            if array.is_mapped() { size_of_val(&array[..]) } else { 0 }
        }
        match self {
            Tree::Whole(t) => size(&t.nodes) + size(&t.leaves),
            Tree::Compact(t) => size(&t.nodes) + size(&t.triangles),
        }
    }

    /// Cost as [`Mbvh::sah_cost`].
    pub(crate) fn sah_cost(&self) -> f32 {
        match self {
            Tree::Whole(t) => t.sah_cost(),
            Tree::Compact(t) => t.sah_cost(),
        }
    }

    /// Allocates the working memory of [`refit`](Self::refit).
    pub(crate) fn room_to_refit(&self) -> Result<RefitRoom> {
        Ok(match self {
            Tree::Whole(_) => None,
            Tree::Compact(t) => Some(compact_refit::Room::new(t)?),
        })
    }

    /// Refits the tree as [`refit::refit`] does. `room` must have been made for this tree.
    pub(crate) fn refit(&mut self, corners: &(impl Fn(u32) -> [Vec3; 3] + Sync), room: RefitRoom) {
        match (self, room) {
            (Tree::Compact(t), Some(room)) => compact_refit::refit(t, corners, room),
            (Tree::Whole(t), _) => refit::refit(t, corners),
            (Tree::Compact(_), None) => unreachable!("the room is this tree's"),
        }
    }

    /// Copies the tree; fails if there is not enough memory.
    pub(crate) fn copy(&self, storage: Storage, progress: &Progress) -> Result<Tree> {
        Ok(match self {
            Tree::Whole(t) => Tree::Whole(t.copy(storage, progress)?),
            Tree::Compact(t) => Tree::Compact(t.copy(storage, progress)?),
        })
    }
}

/// Where a tree lies, and what is needed to build it: references and the binary tree.
#[derive(Clone, Copy)]
pub(crate) struct BuildStorage<'a> {
    pub tree: Storage<'a>,
    pub work: Storage<'a>,
}

impl<'a> BuildStorage<'a> {
    /// In memory.
    #[cfg(test)]
    pub const MEMORY: BuildStorage<'static> = BuildStorage { tree: Storage::MEMORY, work: Storage::MEMORY };

    /// In `tree` and `work`, but for spatial splits, which need memory to be tried.
    pub fn new(tree: Storage<'a>, work: Storage<'a>, options: &BuildOptions) -> Self {
        match options.quality {
            BuildQuality::Default => BuildStorage { tree, work },
            BuildQuality::High => BuildStorage { tree, work: Storage::MEMORY },
        }
    }
}

/// Builds the tree over the triangles of at least one reference, with the `corners`. Returns it with its SAH cost: that
/// of the binary tree with traversal and intersection costing 1 each.
///
/// `meshes`: the first triangle of each mesh, and the number of all triangles at the end. The bits are the same in any storage.
pub(crate) fn build(
    corners: &(impl Fn(u32) -> [Vec3; 3] + Sync),
    references: References,
    meshes: &[u32],
    options: &BuildOptions,
    BuildStorage { tree: storage, work }: BuildStorage,
    progress: &Progress,
) -> Result<(Tree, f32)> {
    let binary = build_binary(corners, references, options, work, progress)?;
    let cost = binary.sah_cost();
    let tree = match (options.compact, storage.is_files()) {
        (true, false) => Tree::Compact(collapse::collapse_compact(&binary, meshes, progress)?),
        (false, false) => Tree::Whole(collapse::collapse(&binary, corners, progress)?),
        (true, true) => Tree::Compact(collapse_in_files::collapse_compact(&binary, meshes, storage, progress)?),
        (false, true) => Tree::Whole(collapse_in_files::collapse(&binary, corners, storage, progress)?),
    };
    Ok((tree, cost))
}

/// Builds the 4-wide tree over the triangles of at least one reference, as [`build`] does.
#[cfg(any(test, feature = "reference"))]
pub(crate) fn build_four_wide(
    corners: &(impl Fn(u32) -> [Vec3; 3] + Sync),
    references: References,
    options: &BuildOptions,
    progress: &Progress,
) -> Result<Mbvh<4>> {
    let binary = build_binary(corners, references, options, Storage::MEMORY, progress)?;
    collapse::collapse(&binary, corners, progress)
}

/// Builds the tree over the triangles `numbers`, which are few beside those of a scene. (Compiled once.)
fn build_few(
    corners: &(dyn Fn(u32) -> [Vec3; 3] + Sync),
    numbers: &[u32],
    options: &BuildOptions,
    progress: &Progress,
) -> Result<Mbvh> {
    if numbers.is_empty() {
        return Ok(Mbvh::nothing());
    }
    let binary = build_binary(&corners, References::of(numbers, &corners)?, options, Storage::MEMORY, progress)?;
    collapse::collapse(&binary, &corners, progress)
}

fn build_binary(
    corners: &(impl Fn(u32) -> [Vec3; 3] + Sync),
    references: References,
    options: &BuildOptions,
    storage: Storage,
    progress: &Progress,
) -> Result<BinaryBvh> {
    options.validate()?;
    let binary = match options.quality {
        BuildQuality::Default => BinaryBvh::of(references, options, storage, progress)?,
        BuildQuality::High => {
            BinaryBvh::spatial_of(references, corners as &(dyn Fn(u32) -> [Vec3; 3] + Sync), options, progress)?
        }
    };
    progress.check()?;
    Ok(binary)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::sampling::uniform;

    /// Triangles around the origin, of sizes from 10^-30 to 10^12: each split takes off the few largest.
    fn nested(n: u32) -> Vec<[Vec3; 3]> {
        let corner = |i, k: u32| Vec3::from_array([0, 1, 2].map(|a| uniform(i, k + a, 1) - 0.5));
        let size = |i: u32| 10f64.powf(-30.0 + 42.0 * f64::from(i) / f64::from(n)) as f32;
        (0..n).map(|i| [0, 3, 6].map(|k| size(i) * corner(i, k))).collect()
    }

    /// Levels of inner nodes, and of those the ones of subtrees that tasks of their own may build.
    fn depths(binary: &BinaryBvh) -> (usize, usize) {
        fn triangles(binary: &BinaryBvh, node: u32) -> usize {
            let mut stack = vec![node];
            let mut sum = 0;
            while let Some(i) = stack.pop() {
                let node = binary.nodes[i as usize];
                sum += node.count as usize;
                stack.extend(if node.count == 0 { vec![i + 1, node.index] } else { vec![] });
            }
            sum
        }
        let (mut stack, mut deepest, mut large) = (vec![(0, 0)], 0, 0);
        while let Some((i, depth)) = stack.pop() {
            let node = binary.nodes[i as usize];
            deepest = deepest.max(depth);
            if node.count == 0 {
                large = if depth > large && triangles(binary, i) > binned::PARALLEL_SUBTREE { depth } else { large };
                stack.extend([(i + 1, depth + 1), (node.index, depth + 1)]);
            }
        }
        (deepest, large)
    }

    #[test]
    fn deep_trees_are_built_and_refitted_on_small_stacks() {
        let corners = nested(20_000);
        let of = |t: u32| corners[t as usize];
        let valid: Vec<u32> = (0..corners.len() as u32).collect();
        // A sixteenth of what the threads of a device have.
        let pool = rayon::ThreadPoolBuilder::new().num_threads(2).stack_size(256 << 10).build().unwrap();
        for quality in BuildQuality::ALL {
            let options = BuildOptions { bins: 2, quality, ..Default::default() };
            pool.install(|| {
                let (deepest, large) = depths(
                    &build_binary(
                        &of,
                        References::of(&valid, &of).unwrap(),
                        &options,
                        Storage::MEMORY,
                        &Progress::none(),
                    )
                    .unwrap(),
                );
                assert!(
                    deepest > layout::SAH_DEPTH && large > 20,
                    "{quality:?}: {deepest} levels, {large} of them large"
                );
                for compact in [false, true] {
                    let options = BuildOptions { compact, ..options };
                    let meshes = [0, corners.len() as u32];
                    let (mut tree, _) = build(
                        &of,
                        References::of(&valid, &of).unwrap(),
                        &meshes,
                        &options,
                        BuildStorage::MEMORY,
                        &Progress::none(),
                    )
                    .unwrap();
                    let room = tree.room_to_refit().unwrap();
                    tree.refit(&|t| corners[t as usize], room);
                }
            });
        }
    }

    #[test]
    fn options_out_of_range_are_refused_by_name() {
        let ok = BuildOptions { quality: BuildQuality::High, ..Default::default() };
        assert_eq!(ok.validate(), Ok(()));
        for (options, name) in [
            (BuildOptions { bins: 257, ..ok }, "bins is 257"),
            (BuildOptions { max_leaf: 0, ..ok }, "max_leaf is 0"),
            (BuildOptions { split_budget: -0.1, ..ok }, "split_budget is -0.1"),
            (BuildOptions { split_budget: f32::NAN, ..ok }, "split_budget is NaN"),
        ] {
            assert!(options.validate().unwrap_err().to_string().contains(name));
        }
    }
}
