//! The trees of a scene's instances: built at the commit, and after refits.

use super::kept_trees::EarlierTrees;
use super::{Instance, SceneData, is_valid_triangle};
use crate::base::error::Result;
use crate::base::geometry::MAX_COORDINATE;
use crate::base::memory::{try_collect, try_par_collect, try_par_gather};
use crate::base::progress::Progress;
use crate::bvh::instances::{Instances, Margin, MeshTree, PlacedTree, placed_box};
use crate::bvh::{self, BuildOptions, BuildStorage, References, RefitRoom, Tree};
use glam::Vec3;
use rayon::prelude::*;

/// Name of this memory in error messages.
const TREES: &str = "the trees of instances";

/// The numbers of meshes that have instances.
pub(super) fn instanced(data: &SceneData) -> impl Iterator<Item = u32> {
    (0..data.meshes.len() as u32).filter(|&m| data.is_instanced(m))
}

/// Upper bound of the size of the trees of meshes with as many triangles as `counts` says, and of what there is of each
/// instance, together with the builder's working memory.
pub(super) fn estimated_bytes(data: &SceneData, options: &BuildOptions, counts: impl Fn(usize) -> bool) -> usize {
    let triangles: usize = instanced(data).map(|m| data.meshes[m as usize].indices.len()).filter(|&n| counts(n)).sum();
    bvh::estimated_bytes(triangles, options) + estimated_bytes_of_places(data.instances.len(), options)
}

/// Upper bound of the size of what there is of each instance, together with the builder's working memory.
pub(super) fn estimated_bytes_of_places(instances: usize, options: &BuildOptions) -> usize {
    let top = BuildOptions { compact: false, ..*options };
    let per_instance = size_of::<PlacedTree>() + 24;
    bvh::estimated_bytes(instances, &top) + instances * per_instance
}

/// Builds the trees, or takes over those that `earlier` has; `None` if the scene has no instances.
pub(super) fn build(
    data: &SceneData,
    first_triangle: &[u32],
    options: &BuildOptions,
    storage: BuildStorage,
    earlier: Option<&EarlierTrees>,
    progress: &Progress,
) -> Result<Option<Instances>> {
    if data.instances.is_empty() {
        return Ok(None);
    }
    let meshes = try_collect(instanced(data), TREES)?;
    let trees = try_par_gather(meshes.len(), TREES, |i, out: &mut Vec<MeshTree>| {
        let kept = earlier.map(|e| e.of_mesh(&data.meshes[meshes[i] as usize], meshes[i])).transpose()?.flatten();
        out.push(match kept {
            Some(tree) => tree,
            None => tree_of(data, meshes[i], options, storage, progress)?,
        });
        Ok(())
    })?;
    place(data, first_triangle, trees, progress).map(Some)
}

/// Builds the tree over the boxes of instances; `trees`: those of all meshes that have some, by number.
pub(super) fn place(
    data: &SceneData,
    first_triangle: &[u32],
    trees: Vec<MeshTree>,
    progress: &Progress,
) -> Result<Instances> {
    let tree_of = |mesh: u32| trees.binary_search_by_key(&mesh, |t| t.mesh).expect("a mesh with instances has a tree");
    let first = &first_triangle[data.meshes.len()..];
    let place = |(instance, &first_triangle): (&Instance, &u32)| PlacedTree {
        to_mesh: instance.to_mesh(),
        origin: instance.transform.translation,
        tree: tree_of(instance.mesh) as u32,
        first_triangle,
    };
    let placed = try_collect(data.instances.iter().zip(first).map(place), TREES)?;
    let margin = margin_of(data, &trees, &placed);
    let of_instance = |i: usize| box_of(&data.instances[i], trees[placed[i].tree as usize].tree.bounds());
    let boxes = (0..placed.len()).into_par_iter().map(|i| margin.around(of_instance(i)));
    let top = Instances::top_of(&try_par_collect(boxes, TREES)?, progress)?;
    Ok(Instances { top, trees, placed, margin })
}

/// Refits the trees after vertices of meshes and instances have moved; `rooms` are those of the meshes' trees. Returns
/// how many triangles can no longer be hit.
pub(super) fn refit(
    data: &SceneData,
    instances: &mut Instances,
    rooms: Vec<RefitRoom>,
    has_moved: impl Fn(u32) -> bool + Sync,
) -> usize {
    let of_tree = |(t, room): (&mut MeshTree, RefitRoom)| {
        t.is_refitted |= has_moved(t.mesh);
        if !t.is_hit() || !has_moved(t.mesh) {
            return t.gone;
        }
        let mesh = &data.meshes[t.mesh as usize];
        let corners = |i: u32| mesh.corners(i as usize);
        t.tree.refit(&corners, room);
        let is_gone = |&i: &u32| !is_valid_triangle(corners(i)) && t.skipped.binary_search(&i).is_err();
        t.gone = (0..t.range[1]).into_par_iter().filter(is_gone).count();
        t.gone
    };
    let gone = instances.trees.par_iter_mut().zip(rooms).map(of_tree).sum();
    for (at, instance) in instances.placed.iter_mut().zip(&data.instances) {
        (at.to_mesh, at.origin) = (instance.to_mesh(), instance.transform.translation);
    }
    instances.margin = margin_of(data, &instances.trees, &instances.placed);
    let Instances { top, trees, placed, margin } = instances;
    let corners = |i: u32| {
        let bounds = trees[placed[i as usize].tree as usize].tree.bounds();
        Instances::corners_of_box(margin.around(box_of(&data.instances[i as usize], bounds)))
    };
    bvh::refit_whole(top, &corners);
    gone
}

/// The margin of the instances' boxes: of rays from within twice the greatest coordinate of the instances, unless the
/// boxes would grow by more than a tenth of the instances' (geometric) mean size, as with a single one far away.
fn margin_of(data: &SceneData, trees: &[MeshTree], placed: &[PlacedTree]) -> Margin {
    let (mut part, mut farthest, mut size, mut count) = (0f32, 0f32, 0.0, 0);
    for (instance, at) in data.instances.iter().zip(placed) {
        let bounds = trees[at.tree as usize].tree.bounds();
        let (reach, extent) = (instance.reach(bounds), instance.extent(bounds));
        part = part.max(instance.margin());
        if reach <= MAX_COORDINATE && extent > 0.0 {
            farthest = farthest.max(reach);
            size += extent.log2() as f64;
            count += 1;
        }
    }
    let mean = (size / f64::from(count.max(1))).exp2() as f32;
    Margin { part, reach: (2.0 * farthest).min(0.1 * mean / part.max(f32::MIN_POSITIVE)) }
}

/// The box in the scene of an instance of a mesh with given bounds.
pub(super) fn box_of(instance: &Instance, bounds: (Vec3, Vec3)) -> (Vec3, Vec3) {
    placed_box(bounds, instance.reach(bounds), instance.margin(), |p| super::instance::placed(&instance.transform, p))
}

/// Returns the box around a scene whose meshes without instances have the tree `own`, and its
/// `extent`.
pub(super) fn bounds_and_extent(data: &SceneData, own: &Tree, instances: Option<&Instances>) -> ((Vec3, Vec3), f32) {
    let (mut lower, mut upper) = own.bounds();
    let mut reach = 0.0;
    if let Some(instances) = instances {
        for i in instances.in_top() {
            let bounds = instances.trees[instances.placed[i as usize].tree as usize].tree.bounds();
            let (low, high) = box_of(&data.instances[i as usize], bounds);
            if is_valid_triangle(Instances::corners_of_box((low, high))) {
                (lower, upper) = (lower.min(low), upper.max(high));
            }
        }
        let of_instance = |(i, at): (&Instance, &PlacedTree)| i.reach(instances.trees[at.tree as usize].tree.bounds());
        let all = data.instances.iter().zip(&instances.placed).map(of_instance);
        reach = all.filter(|r| r.is_finite()).fold(0.0, f32::max);
    }
    ((lower, upper), (upper - lower).length().max(reach))
}

fn tree_of(
    data: &SceneData,
    number: u32,
    options: &BuildOptions,
    storage: BuildStorage,
    progress: &Progress,
) -> Result<MeshTree> {
    let mesh = &data.meshes[number as usize];
    let total = mesh.indices.len();
    let corners = |t: u32| mesh.corners(t as usize);
    let mut references = References::of_valid(total, &corners, is_valid_triangle, storage.work, progress)?;
    progress.check()?;
    let skipped = std::mem::take(&mut references.skipped);
    let range = [0, total as u32];
    let tree = match references.len() {
        0 => Tree::nothing(),
        _ => bvh::build(&corners, references, &range, options, storage, progress)?.0,
    };
    Ok(MeshTree { mesh: number, range, tree, skipped, gone: 0, is_refitted: false })
}

/// Whether a triangle of an object is in no tree: `own` are the skipped triangles of meshes without instances, by their
/// global number.
pub(super) fn is_skipped(
    data: &SceneData,
    own: &[u32],
    instances: Option<&Instances>,
    object: u32,
    triangle: u32,
    first: u32,
) -> bool {
    match (object as usize).checked_sub(data.meshes.len()) {
        None => own.binary_search(&(first + triangle)).is_ok(),
        Some(instance) => instances.is_some_and(|i| {
            let tree = &i.trees[i.placed[instance].tree as usize];
            tree.skipped.binary_search(&triangle).is_ok()
        }),
    }
}
