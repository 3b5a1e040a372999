//! Many single rays through both levels of the trees of [`instances`](super::instances): each goes from box to box,
//! nearest first, and at each through the tree of the instance's mesh, up to its best hit so far. While one ray waits for
//! the memory of a mesh's tree, others go on, whichever mesh they are in (Wald, Benthin and Slusallek, *Distributed Interactive Ray Tracing of
//! Dynamic Scenes*, 2003, with the flights of [`single`]).

use super::Ray;
use super::compact::View;
use super::filter::All;
use super::instances::{Answer, to_mesh};
use super::queries::TreeView;
use super::single::{self, FLIGHT, Walk, Work};
use super::tree::{Leaf, Tree};
use crate::bvh::instances::{Instances, MeshTree};
use crate::bvh::{self, ChildRef, Mbvh};
use crate::scene::Scene;
use crate::simd::{Lanes, Simd};
use std::borrow::Borrow;
use std::mem::MaybeUninit;

/// Rays that are under way.
struct Placed<'a, A, H, F> {
    scene: &'a Scene,
    instances: &'a Instances,
    tree_of: F,
    rays: &'a [Ray],
    answers: &'a mut [A],
    /// The next ray.
    next: usize,
    /// What each ray goes through, by place, once one has begun there.
    at: [MaybeUninit<At<H>>; FLIGHT],
}

#[derive(Clone, Copy)]
struct At<H> {
    ray: usize,
    tree: H,
    first_triangle: u32,
}

/// Adds what rays find in instances to their answers; as many as both slices have.
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
pub(super) unsafe fn trace<S: Simd, A: Answer, const ANY: bool>(
    scene: &Scene,
    instances: &Instances,
    rays: &[Ray],
    answers: &mut [A],
) {
    let whole = |tree| match scene.tree_of(instances, tree) {
        TreeView::Whole(tree) => Some(tree),
        TreeView::Compact(_) => None,
    };
    let compact = |tree| match scene.tree_of(instances, tree) {
        TreeView::Whole(_) => None,
        TreeView::Compact(view) => Some(view),
    };
    // All trees are of one kind, but for those without triangles, which no ray meets.
    let is_compact =
        matches!(instances.trees.iter().find(|t| t.is_hit()), Some(MeshTree { tree: bvh::Tree::Compact(_), .. }));
    // SAFETY: forwarded.
    unsafe {
        match is_compact {
            true => trace_in::<S, View, _, A, ANY>(scene, instances, compact, rays, answers),
            false => trace_in::<S, Mbvh, _, A, ANY>(scene, instances, whole, rays, answers),
        }
    }
}

/// As [`trace`]; `tree_of` gives the trees of meshes.
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
unsafe fn trace_in<S: Simd, T: Tree, H: Borrow<T> + Copy, A: Answer, const ANY: bool>(
    scene: &Scene,
    instances: &Instances,
    tree_of: impl Fn(u32) -> Option<H>,
    rays: &[Ray],
    answers: &mut [A],
) {
    // (Compact trees on the portable lanes do without: it took some 25 kB of the library there.)
    let is_whole = T::IS_BY_WORTH;
    if let ([ray], [answer], true) = (rays, &mut *answers, is_whole || <S::Packet as Lanes>::WIDTH > 4) {
        // SAFETY: forwarded.
        return unsafe { trace_one::<S, T, H, A, ANY>(scene, instances, tree_of, ray, answer) };
    }
    let at = [const { MaybeUninit::uninit() }; FLIGHT];
    let rays = &rays[..rays.len().min(answers.len())];
    let mut work = Placed { scene, instances, tree_of, rays, answers, next: 0, at };
    // SAFETY: forwarded.
    unsafe { single::fly::<S, T, ANY>(&mut work) }
}

/// As [`trace_in`] for one ray.
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
unsafe fn trace_one<S: Simd, T: Tree, H: Borrow<T>, A: Answer, const ANY: bool>(
    scene: &Scene,
    instances: &Instances,
    tree_of: impl Fn(u32) -> Option<H>,
    ray: &Ray,
    answer: &mut A,
) {
    let mut place = MaybeUninit::uninit();
    if answer.tmax(ray).is_none() || !Walk::begin_in_boxes(&mut place, ray, 0, instances.margin) {
        return;
    }
    // SAFETY: it has begun. The leaves of the tree over boxes hold the instances' numbers, one each. The caller vouches for
    // the ISA.
    unsafe {
        let walk = place.assume_init_mut();
        while let Some(tmax) = answer.tmax(ray) {
            let leaf = walk.next_leaf::<S, Mbvh>(&instances.top, tmax);
            if leaf == ChildRef::EMPTY {
                return;
            }
            let at = &instances.placed[Tree::leaf::<S>(&instances.top, leaf).number(0) as usize];
            let Some(tree) = tree_of(at.tree) else { continue };
            if !walk.enter::<T>(&to_mesh(at, ray, tmax)) {
                return scene.meet_one_by_one(instances, ray, answer);
            }
            let hit = walk.run::<S, T, All, ANY>(tree.borrow(), &mut All);
            answer.add(A::of(hit), at.first_triangle);
            if !walk.leave(ray, instances.margin) {
                return;
            }
        }
    }
}

impl<A: Answer, H: Copy, F: Fn(u32) -> Option<H>> Placed<'_, A, H, F> {
    /// Sends a ray into the next box. Returns false after its last one.
    ///
    /// # Safety
    /// The CPU must have the ISA; the walk must be that ray's, and in the tree over boxes.
    #[inline(always)]
    unsafe fn go_on<S: Simd, T: Tree>(&mut self, walk: &mut Walk, ray: usize) -> bool
    where
        H: Borrow<T>,
    {
        // SAFETY: forwarded; the leaves of the tree over boxes hold the instances' numbers, one each.
        unsafe {
            while let Some(tmax) = self.answers[ray].tmax(&self.rays[ray]) {
                let leaf = walk.next_leaf::<S, Mbvh>(&self.instances.top, tmax);
                if leaf == ChildRef::EMPTY {
                    return false;
                }
                let at = &self.instances.placed[Tree::leaf::<S>(&self.instances.top, leaf).number(0) as usize];
                let Some(tree) = (self.tree_of)(at.tree) else { continue };
                if !walk.enter::<T>(&to_mesh(at, &self.rays[ray], tmax)) {
                    self.scene.meet_one_by_one(self.instances, &self.rays[ray], &mut self.answers[ray]);
                    return false;
                }
                self.at[walk.number].write(At { ray, tree, first_triangle: at.first_triangle });
                return true;
            }
        }
        false
    }
}

// SAFETY: walks enter the tree that is noted in their place, at its root.
unsafe impl<T: Tree, A: Answer, H: Borrow<T> + Copy, F: Fn(u32) -> Option<H>> Work<T> for Placed<'_, A, H, F> {
    #[inline(always)]
    unsafe fn begin<S: Simd>(&mut self, place: &mut MaybeUninit<Walk>, number: usize) -> bool {
        while self.next < self.rays.len() {
            let ray = self.next;
            self.next += 1;
            let goes_on = self.answers[ray].tmax(&self.rays[ray]).is_some();
            if goes_on && Walk::begin_in_boxes(place, &self.rays[ray], number, self.instances.margin) {
                // SAFETY: it has begun. The caller vouches for the ISA.
                if unsafe { self.go_on::<S, T>(place.assume_init_mut(), ray) } {
                    return true;
                }
            }
        }
        false
    }

    #[inline(always)]
    unsafe fn end<S: Simd>(&mut self, walk: &mut Walk) -> bool {
        // SAFETY: a ray is in its place. The caller vouches for the ISA.
        unsafe {
            let At { ray, first_triangle, .. } = self.at[walk.number].assume_init();
            self.answers[ray].add(A::of(walk.hit()), first_triangle);
            walk.leave(&self.rays[ray], self.instances.margin) && self.go_on::<S, T>(walk, ray)
        }
    }

    #[inline(always)]
    unsafe fn tree(&self, walk: &Walk) -> &T {
        // SAFETY: a ray is in its place.
        unsafe { self.at[walk.number].assume_init_ref() }.tree.borrow()
    }
}
