//! Rays through instances (the two levels of [`crate::bvh::instances`]): each ray goes from box to box through the tree
//! over instances, nearest first, and at each box through the tree of the instance's mesh, up to its best hit so far.
//!
//! Many rays do so by turns: all go on to their next box, then those that wait at one instance go through its mesh
//! together, as a stream where they are many. (The queues of Pharr et al., *Rendering Complex Scenes with
//! Memory-Coherent Ray Tracing*, 1997.) Transformed rays keep the length of their direction, so that distances are those
//! in the scene, and the arithmetic of a transformed ray does not depend on the rays beside it: hits are the same, bit
//! for bit, for one ray and for many.

use super::filter::Filter;
use super::queries::TreeView;
use super::single::Walk;
use super::{RawHit, Ray};
use crate::base::geometry::NONE;
use crate::bvh::instances::{Instances, PlacedTree};
use crate::bvh::{ChildRef, Mbvh};
use crate::scene::Scene;
use glam::Vec3A;
use std::cell::Cell;
use std::mem::MaybeUninit;

/// Maximum number of rays that go by turns.
const BATCH: usize = 1024;

/// Least number of rays at one instance that are traced as a stream.
const LEAST_STREAM: usize = 16;

/// What is known of a ray so far.
pub(super) trait Answer: Copy {
    const MISS: Self;

    /// The buffer of answers in a room.
    fn buffer(room: &mut Buffers) -> &mut Vec<Self>;

    /// How far the ray goes on; `None` if its answer cannot change.
    fn tmax(&self, ray: &Ray) -> Option<f32>;

    /// Traces rays through what is below a node of a tree; `alike`: as a stream if there are enough.
    fn trace(scene: &Scene, tree: TreeView, root: ChildRef, rays: &[Ray], alike: bool, out: &mut [Self]);

    /// Adds what a ray has found in an instance.
    fn add(&mut self, found: Self, first_triangle: u32);
}

impl Answer for RawHit {
    const MISS: RawHit = RawHit::MISS;

    fn buffer(room: &mut Buffers) -> &mut Vec<RawHit> {
        &mut room.hits
    }

    #[inline]
    fn tmax(&self, ray: &Ray) -> Option<f32> {
        Some(if self.is_miss() { ray.tmax } else { self.t })
    }

    fn trace(scene: &Scene, tree: TreeView, root: ChildRef, rays: &[Ray], alike: bool, out: &mut [RawHit]) {
        let (kernels, as_stream) = (scene.kernels(), alike && rays.len() >= LEAST_STREAM);
        match (tree, rays) {
            (TreeView::Whole(tree), [ray]) if root == ChildRef::ROOT => out[0] = kernels.intersect(tree, ray),
            (TreeView::Whole(tree), _) if !as_stream => kernels.intersect_block(tree, root, rays, out),
            (TreeView::Whole(tree), _) => kernels.stream(tree, root, rays, out),
            (TreeView::Compact(tree), _) if !as_stream => kernels.compact_intersect(&tree, root, rays, out),
            (TreeView::Compact(tree), _) => kernels.compact_stream(&tree, root, rays, out),
        }
    }

    #[inline]
    fn add(&mut self, mut found: RawHit, first_triangle: u32) {
        if found.is_miss() {
            return;
        }
        found.triangle += first_triangle;
        if self.is_miss() || found.t < self.t || (found.t == self.t && found.triangle < self.triangle) {
            *self = found;
        }
    }
}

/// Whether anything lies on a ray: 1 or 0.
impl Answer for u8 {
    const MISS: u8 = 0;

    fn buffer(room: &mut Buffers) -> &mut Vec<u8> {
        &mut room.occluded
    }

    #[inline]
    fn tmax(&self, ray: &Ray) -> Option<f32> {
        (*self == 0).then_some(ray.tmax)
    }

    fn trace(scene: &Scene, tree: TreeView, root: ChildRef, rays: &[Ray], alike: bool, out: &mut [u8]) {
        let (kernels, as_stream) = (scene.kernels(), alike && rays.len() >= LEAST_STREAM);
        match (tree, rays) {
            (TreeView::Whole(tree), [ray]) if root == ChildRef::ROOT => out[0] = kernels.occluded(tree, ray) as u8,
            (TreeView::Whole(tree), _) if !as_stream => kernels.occluded_block(tree, root, rays, out),
            (TreeView::Whole(tree), _) => kernels.stream_occluded(tree, root, rays, out),
            (TreeView::Compact(tree), _) if !as_stream => kernels.compact_occluded(&tree, root, rays, out),
            (TreeView::Compact(tree), _) => kernels.compact_stream_occluded(&tree, root, rays, out),
        }
    }

    #[inline]
    fn add(&mut self, found: u8, _: u32) {
        *self |= found;
    }
}

/// The ray in the coordinates of an instance's mesh.
#[inline]
fn to_mesh(at: &PlacedTree, ray: &Ray, tmax: f32) -> Ray {
    let origin = at.to_mesh * (Vec3A::from(ray.origin) - at.origin);
    let direction = at.to_mesh * Vec3A::from(ray.direction);
    Ray { origin: origin.into(), tmin: ray.tmin, direction: direction.into(), tmax }
}

/// Working memory of a thread for rays that go by turns, kept for the next ones: 4.7 MB, of which little is touched.
#[derive(Default)]
struct Room {
    walks: Vec<Walk>,
    /// The instance that a ray waits at, above the number of the ray.
    visits: Vec<u64>,
    rays: Vec<Ray>,
    found: Buffers,
}

/// Answers of the rays at one instance.
#[derive(Default)]
pub(super) struct Buffers {
    hits: Vec<RawHit>,
    occluded: Vec<u8>,
}

thread_local! {
    static ROOM: Cell<Room> = const {
        let found = Buffers { hits: Vec::new(), occluded: Vec::new() };
        Cell::new(Room { walks: Vec::new(), visits: Vec::new(), rays: Vec::new(), found })
    };
}

impl Scene {
    /// Adds what rays find in instances, if there are any, to `answers`, which hold what they find elsewhere: as many as
    /// both slices have. `alike`: whether the rays are those of a stream.
    #[inline]
    pub(super) fn meet_instances<A: Answer>(&self, rays: &[Ray], alike: bool, answers: &mut [A]) {
        if let Some(instances) = self.instance_trees() {
            let n = rays.len().min(answers.len());
            self.meet_all(instances, &rays[..n], alike, &mut answers[..n]);
        }
    }

    fn meet_all<A: Answer>(&self, instances: &Instances, rays: &[Ray], alike: bool, answers: &mut [A]) {
        if let ([ray], [answer]) = (rays, &mut *answers) {
            return self.meet_one_by_one(instances, ray, answer);
        }
        let mut room = ROOM.try_with(Cell::take).unwrap_or_default();
        let size = rays.len().min(BATCH);
        room.walks.clear();
        room.visits.clear();
        room.rays.clear();
        let has_room = room.walks.try_reserve_exact(size).is_ok()
            && room.visits.try_reserve(size).is_ok()
            && room.rays.try_reserve(size).is_ok()
            && A::buffer(&mut room.found).try_reserve(size).is_ok();
        if has_room {
            for (rays, answers) in rays.chunks(BATCH).zip(answers.chunks_mut(BATCH)) {
                self.meet_by_turns(instances, rays, alike, answers, &mut room);
            }
        } else {
            rays.iter().zip(answers).for_each(|(ray, answer)| self.meet_one_by_one(instances, ray, answer));
        }
        let _ = ROOM.try_with(|kept| kept.set(room));
    }

    fn meet_one_by_one<A: Answer>(&self, instances: &Instances, ray: &Ray, answer: &mut A) {
        let kernels = self.kernels();
        let mut place = MaybeUninit::uninit();
        if answer.tmax(ray).is_none() || !Walk::begin::<Mbvh>(&mut place, ChildRef::ROOT, ray, 0) {
            return;
        }
        // SAFETY: it has begun.
        let walk = unsafe { place.assume_init_mut() };
        while let Some(tmax) = answer.tmax(ray) {
            let instance = kernels.next_box(&instances.top, walk, tmax);
            if instance == NONE {
                return;
            }
            let at = &instances.placed[instance as usize];
            let mut found = [A::MISS];
            A::trace(
                self,
                self.tree_of(instances, at.tree),
                ChildRef::ROOT,
                &[to_mesh(at, ray, tmax)],
                false,
                &mut found,
            );
            answer.add(found[0], at.first_triangle);
        }
    }

    /// `room` has capacity for as many rays.
    fn meet_by_turns<A: Answer>(
        &self,
        instances: &Instances,
        rays: &[Ray],
        alike: bool,
        answers: &mut [A],
        room: &mut Room,
    ) {
        let kernels = self.kernels();
        let Room { walks, visits, rays: turned, found } = room;
        let found = A::buffer(found);
        let walks = &mut walks.spare_capacity_mut()[..rays.len()];
        visits.clear();
        for (r, ((ray, answer), place)) in rays.iter().zip(&*answers).zip(&mut *walks).enumerate() {
            if answer.tmax(ray).is_some() && Walk::begin::<Mbvh>(place, ChildRef::ROOT, ray, r) {
                visits.push(r as u64);
            }
        }
        loop {
            visits.retain_mut(|visit| {
                let r = *visit as u32 as usize;
                let Some(tmax) = answers[r].tmax(&rays[r]) else { return false };
                // SAFETY: the walks of rays among the visits have begun.
                let walk = unsafe { walks[r].assume_init_mut() };
                let instance = kernels.next_box(&instances.top, walk, tmax);
                *visit = u64::from(instance) << 32 | r as u64;
                instance != NONE
            });
            if visits.is_empty() {
                return;
            }
            visits.sort_unstable();
            for at_one in visits.chunk_by(|a, b| a >> 32 == b >> 32) {
                let at = &instances.placed[(at_one[0] >> 32) as usize];
                let ray = |&visit: &u64| {
                    let r = visit as u32 as usize;
                    to_mesh(at, &rays[r], answers[r].tmax(&rays[r]).unwrap_or(0.0))
                };
                turned.clear();
                turned.extend(at_one.iter().map(ray));
                found.clear();
                found.resize(turned.len(), A::MISS);
                A::trace(self, self.tree_of(instances, at.tree), ChildRef::ROOT, turned, alike, found);
                for (&visit, &found) in at_one.iter().zip(&*found) {
                    answers[visit as u32 as usize].add(found, at.first_triangle);
                }
            }
        }
    }

    /// Traces a ray through instances, by the kernels with a filter: the closest hit (`ANY`: any hit) that counts and is
    /// nearer than `best`.
    pub(super) fn meet_filtered<const ANY: bool>(
        &self,
        instances: &Instances,
        ray: &Ray,
        mut best: RawHit,
        filter: &mut Filter,
    ) -> RawHit {
        let mut place = MaybeUninit::uninit();
        if !Walk::begin::<Mbvh>(&mut place, ChildRef::ROOT, ray, 0) {
            return best;
        }
        // SAFETY: it has begun.
        let walk = unsafe { place.assume_init_mut() };
        while !ANY || best.is_miss() {
            let tmax = if best.is_miss() { ray.tmax } else { best.t };
            let instance = self.kernels().next_box(&instances.top, walk, tmax);
            if instance == NONE {
                break;
            }
            let at = &instances.placed[instance as usize];
            filter.first_triangle = at.first_triangle;
            let found = self.filtered_in::<ANY>(self.tree_of(instances, at.tree), &to_mesh(at, ray, tmax), filter);
            best.add(found, at.first_triangle);
        }
        best
    }
}
