//! Rays through instances (the two levels of [`crate::bvh::instances`]): each ray goes from box to box through the tree
//! over instances, and at each box through the tree of the instance's mesh, up to its best hit so far.
//!
//! Rays that go alike do so [as lists](super::box_lists), those of a pinhole [as bundles](super::bundle_boxes), others
//! [one by one](super::two_levels), many at a time.
//! Transformed rays keep the length of their direction, so that distances are those in the scene. Hits are the same, bit for
//! bit, for one ray and for many: the arithmetic of a transformed ray does not depend on the rays beside it, and no ray
//! enters a box behind what it hits there, so that the order of boxes does not matter: see
//! [`margin`](crate::scene::Instance::margin).

use super::box_lists::{self, MAX_RAYS};
use super::filter::Filter;
use super::queries::TreeView;
use super::single::Walk;
use super::{Kernels, RawHit, Ray};
use crate::base::geometry::NONE;
use crate::bvh::ChildRef;
use crate::bvh::instances::{Instances, PlacedTree};
use crate::scene::Scene;
use glam::{Vec3, Vec3A};
use std::cell::Cell;
use std::mem::MaybeUninit;

/// Least number of rays at one instance that are traced as a stream.
const LEAST_STREAM: usize = 16;

/// What is known of a ray so far.
pub(super) trait Answer: Copy {
    const MISS: Self;

    /// What a hit says.
    fn of(hit: RawHit) -> Self;

    /// The buffer of answers in a room.
    fn buffer(room: &mut Buffers) -> &mut Vec<Self>;

    /// How far the ray goes on; `None` if its answer cannot change.
    fn tmax(&self, ray: &Ray) -> Option<f32>;

    /// Traces rays through instances, one by one.
    fn trace_instances(scene: &Scene, instances: &Instances, rays: &[Ray], answers: &mut [Self]);

    /// Number of rays before the first that are faster together, and of those.
    fn next_bundles(kernels: &Kernels, rays: &[Ray]) -> (usize, usize);

    /// Traces rays through what is below a node of a tree; `alike`: as a stream if there are enough.
    fn trace(scene: &Scene, tree: TreeView, root: ChildRef, rays: &[Ray], alike: bool, out: &mut [Self]);

    /// Adds what a ray has found in an instance; returns whether that changes the answer.
    fn add(&mut self, found: Self, first_triangle: u32) -> bool;
}

impl Answer for RawHit {
    const MISS: RawHit = RawHit::MISS;

    #[inline]
    fn of(hit: RawHit) -> RawHit {
        hit
    }

    fn buffer(room: &mut Buffers) -> &mut Vec<RawHit> {
        &mut room.hits
    }

    #[inline]
    fn tmax(&self, ray: &Ray) -> Option<f32> {
        Some(if self.is_miss() { ray.tmax } else { self.t })
    }

    fn trace_instances(scene: &Scene, instances: &Instances, rays: &[Ray], answers: &mut [RawHit]) {
        scene.kernels().intersect_instances(scene, instances, rays, answers);
    }

    fn next_bundles(kernels: &Kernels, rays: &[Ray]) -> (usize, usize) {
        kernels.next_bundles(rays)
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
    fn add(&mut self, mut found: RawHit, first_triangle: u32) -> bool {
        if found.is_miss() {
            return false;
        }
        found.triangle += first_triangle;
        let is_closer = self.is_miss() || found.t < self.t || (found.t == self.t && found.triangle < self.triangle);
        if is_closer {
            *self = found;
        }
        is_closer
    }
}

/// Whether anything lies on a ray: 1 or 0.
impl Answer for u8 {
    const MISS: u8 = 0;

    #[inline]
    fn of(hit: RawHit) -> u8 {
        !hit.is_miss() as u8
    }

    fn buffer(room: &mut Buffers) -> &mut Vec<u8> {
        &mut room.occluded
    }

    #[inline]
    fn tmax(&self, ray: &Ray) -> Option<f32> {
        (*self == 0).then_some(ray.tmax)
    }

    fn trace_instances(scene: &Scene, instances: &Instances, rays: &[Ray], answers: &mut [u8]) {
        scene.kernels().occluded_instances(scene, instances, rays, answers);
    }

    /// There are no bundles to any hit.
    fn next_bundles(_: &Kernels, rays: &[Ray]) -> (usize, usize) {
        (rays.len(), 0)
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
    fn add(&mut self, found: u8, _: u32) -> bool {
        *self |= found;
        found != 0
    }
}

/// The ray in the coordinates of an instance's mesh.
#[inline(always)]
pub(super) fn to_mesh(at: &PlacedTree, ray: &Ray, tmax: f32) -> Ray {
    let turned = |v: Vec3A| at.to_mesh.x_axis * v.x + at.to_mesh.y_axis * v.y + at.to_mesh.z_axis * v.z;
    let (origin, direction) = (turned(Vec3A::from(ray.origin) - at.origin), turned(Vec3A::from(ray.direction)));
    Ray { origin: origin.into(), tmin: ray.tmin, direction: direction.into(), tmax }
}

/// Working memory of a thread for rays that go as lists, kept for the next ones.
#[derive(Default)]
struct Room {
    lists: box_lists::Room,
    /// Rays that are in no list.
    alone: Vec<Ray>,
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
        Cell::new(Room { lists: box_lists::Room::new(), alone: Vec::new(), found })
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
        if rays.len() == 1 {
            return A::trace_instances(self, instances, rays, answers);
        }
        let mut start = 0;
        while start < rays.len() {
            let rest = &rays[start..];
            let (apart, together) = if alike { (0, rest.len()) } else { A::next_bundles(self.kernels(), rest) };
            if apart > 0 {
                A::trace_instances(self, instances, &rest[..apart], &mut answers[start..start + apart]);
            }
            if together > 0 {
                let these = apart..apart + together;
                self.meet_as_lists(instances, &rest[these], alike, &mut answers[start + apart..][..together]);
            }
            start += apart + together;
        }
    }

    /// Traces a ray through instances with a walk of its own through each, whatever its length and theirs.
    #[cold]
    pub(super) fn meet_one_by_one<A: Answer>(&self, instances: &Instances, ray: &Ray, answer: &mut A) {
        let kernels = self.kernels();
        let mut place = MaybeUninit::uninit();
        if answer.tmax(ray).is_none() || !Walk::begin_in_boxes(&mut place, ray, 0, instances.margin) {
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

    fn meet_as_lists<A: Answer>(&self, instances: &Instances, rays: &[Ray], alike: bool, answers: &mut [A]) {
        let mut room = ROOM.try_with(Cell::take).unwrap_or_default();
        let has_memory = room.lists.has_memory()
            && box_lists::fill(&mut room.alone, MAX_RAYS, Ray::new(Vec3::ZERO, Vec3::ZERO))
            && box_lists::fill(A::buffer(&mut room.found), MAX_RAYS, A::MISS);
        if has_memory {
            for (rays, answers) in rays.chunks(MAX_RAYS).zip(answers.chunks_mut(MAX_RAYS)) {
                self.meet_list(instances, rays, alike, answers, &mut room);
            }
        } else {
            A::trace_instances(self, instances, rays, answers);
        }
        let _ = ROOM.try_with(|kept| kept.set(room));
    }

    /// At most [`MAX_RAYS`] rays; `room` has memory for them.
    fn meet_list<A: Answer>(
        &self,
        instances: &Instances,
        rays: &[Ray],
        alike: bool,
        answers: &mut [A],
        Room { lists, found, alone }: &mut Room,
    ) {
        let found = A::buffer(found);
        let count = lists.take(rays.iter().zip(&*answers).map(|(ray, answer)| (ray, answer.tmax(ray))));
        let mut at_instance = |mut visit: box_lists::Visit| {
            let at = &instances.placed[visit.instance as usize];
            let found = &mut found[..visit.rays.len()];
            A::trace(self, self.tree_of(instances, at.tree), ChildRef::ROOT, visit.rays, alike, found);
            for (&number, &found) in visit.numbers.iter().zip(&*found) {
                let answer = &mut answers[number as usize];
                if answer.add(found, at.first_triangle) {
                    visit.end(number, answer.tmax(&rays[number as usize]));
                }
            }
        };
        match alike {
            true => self.kernels().list_instances(instances, count, lists, &mut at_instance),
            false => self.kernels().bundle_instances(instances, count, lists, &mut at_instance),
        }
        let numbers = lists.alone();
        if !numbers.is_empty() {
            for (i, &number) in numbers.iter().enumerate() {
                (alone[i], found[i]) = (rays[number as usize], answers[number as usize]);
            }
            A::trace_instances(self, instances, &alone[..numbers.len()], &mut found[..numbers.len()]);
            numbers.iter().zip(&*found).for_each(|(&number, &found)| answers[number as usize] = found);
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
        if !Walk::begin_in_boxes(&mut place, ray, 0, instances.margin) {
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
