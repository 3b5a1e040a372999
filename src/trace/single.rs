//! Single rays through a wide tree: ordered closest hit and any hit (thesis 3.1.2; Wald,
//! Benthin and Boulos, *Getting Rid of Packets*, 2008; Dammertz et al. 2008).
//!
//! The box test is conservative (Ize, *Robust BVH Ray Traversal*, 2013): the builder moves planes, and
//! a ray its origin, by more than rounding can.

use super::filter::{Accept, All};
use super::tree::{Children, Leaf, RaySetup, Tree, beyond, direction_scale};
use super::triangle::barycentrics;
use super::{RawHit, Ray};
use crate::base::geometry::NONE;
use crate::bvh::Mbvh;
use crate::bvh::instances::Margin;
use crate::bvh::layout::{ChildRef, STACK_SIZE, WIDTH};
use crate::simd::{Compress, Lanes, Mask, Simd};
use std::cell::Cell;
use std::marker::PhantomData;
use std::mem::MaybeUninit;

/// The best hit of a ray so far, with edge functions in place of barycentrics.
#[derive(Clone, Copy)]
pub(super) struct Best {
    pub t: f32,
    pub triangle: u32,
    pub u: f32,
    pub v: f32,
    /// u + v + w: positive if the ray hits the front.
    pub sum: f32,
}

impl Best {
    #[inline(always)]
    pub(super) fn none(tmax: f32) -> Self {
        Best { t: tmax, triangle: NONE, u: 0.0, v: 0.0, sum: 1.0 }
    }

    #[inline(always)]
    pub(super) fn hit(&self) -> RawHit {
        if self.triangle == NONE {
            return RawHit::MISS;
        }
        let (u, v) = barycentrics(self.u, self.v, self.sum);
        RawHit { t: self.t, u, v, triangle: self.triangle, front: self.sum > 0.0 }
    }
}

/// Tests a ray against the triangles of a leaf and updates `best`; `ANY`: stops at the first hit. Returns whether
/// `best` has changed.
///
/// # Safety
/// The CPU must have the ISA; `leaf` must be a leaf of `tree`.
#[inline(always)]
unsafe fn leaf<S: Simd, T: Tree, A: Accept, const ANY: bool>(
    tree: &T,
    leaf: ChildRef,
    ray: &RaySetup,
    limit: f32,
    best: &mut Best,
    accept: &mut A,
) -> bool {
    // SAFETY: forwarded.
    let leaf = unsafe { tree.leaf::<S>(leaf) };
    let count = leaf.count();
    let mut improved = false;
    let mut first = 0;
    while first < count {
        // SAFETY: `first < count`; the caller vouches for the ISA.
        let projected = unsafe { leaf.project::<S::F4>(first, &ray.shear) };
        let lanes = if count - first >= 4 { 0xf } else { (1u32 << (count - first)) - 1 };
        // SAFETY: as above.
        let mut candidates = unsafe { projected.inside() }.bits() & lanes;
        if candidates != 0 {
            // SAFETY: as above.
            let (t, is_accurate) = unsafe { projected.distances(&ray.shear) };
            let mut t = t.to_array();
            let mut inaccurate = candidates & !is_accurate.bits();
            while inaccurate != 0 {
                let i = inaccurate.trailing_zeros() as usize;
                inaccurate &= inaccurate - 1;
                let weights = [projected.u, projected.v, projected.w].map(|l| l.to_array()[i]);
                // If all vanish, the ray lies in the plane.
                let is_seen = weights[0] + weights[1] + weights[2] != 0.0;
                // SAFETY: `candidates` has no lane beyond the count.
                t[i] = if is_seen { unsafe { leaf.accurate_distance(first + i, &ray.shear) } } else { f32::NAN };
            }
            let (u, v, w) = (projected.u.to_array(), projected.v.to_array(), projected.w.to_array());
            while candidates != 0 {
                let i = candidates.trailing_zeros() as usize;
                candidates &= candidates - 1;
                if !(ray.tmin < t[i] && t[i] <= best.t) {
                    continue;
                }
                // SAFETY: first + i < count.
                if !unsafe { leaf.counts::<S>(first + i, ray, limit) } {
                    continue;
                }
                // SAFETY: as above.
                if A::FILTERS && !accept.accepts(unsafe { leaf.number(first + i) }, t[i], [u[i], v[i], w[i]]) {
                    continue;
                }
                if ANY {
                    // Any triangle number marks a hit.
                    best.triangle = 0;
                    return true;
                }
                // SAFETY: as above.
                let id = unsafe { leaf.number(first + i) };
                if t[i] < best.t || id < best.triangle {
                    *best = Best { t: t[i], triangle: id, u: u[i], v: v[i], sum: u[i] + v[i] + w[i] };
                    improved = true;
                }
            }
        }
        first += 4;
    }
    improved
}

/// Traversal stack of a ray, nearest entry on top: children still to be visited and the distances at which their boxes
/// begin. No box begins behind the closest hit so far. The lowest [`BOTTOM`] entries are [`ChildRef::EMPTY`], which end
/// the traversal.
struct Stack {
    near: [MaybeUninit<f32>; BOTTOM + OUTER + STACK_SIZE],
    child: [MaybeUninit<ChildRef>; BOTTOM + OUTER + STACK_SIZE],
    count: usize,
}

/// Room for what waits in another tree while a ray goes through one: see [`Walk::enter`].
const OUTER: usize = 128;

/// Number of sentinels at the bottom of the stack: enough that no group of eight entries, counted from the top, reaches
/// below the stack.
const BOTTOM: usize = WIDTH;

/// The order of lanes that keeps them as they are.
static IN_ORDER: [u32; WIDTH] = [0, 1, 2, 3, 4, 5, 6, 7];

impl Stack {
    /// Pushes the children of a node that are set in `mask`, far ones first; `ANY`: in the node's own order if that is
    /// [by worth](Tree::IS_BY_WORTH). Returns the set of their positions in that order.
    ///
    /// # Safety
    /// The CPU must have the ISA; `node` must be a node of the tree that the stack is used for.
    #[inline(always)]
    unsafe fn push<S: Simd, T: Tree, const ANY: bool>(
        &mut self,
        node: &T::Node,
        shift: u32,
        near: T::Lanes<S>,
        mask: <T::Lanes<S> as Lanes>::Mask,
    ) -> u32 {
        let mut room = MaybeUninit::uninit();
        let (order, shift) = if ANY && T::IS_BY_WORTH { (IN_ORDER.as_ptr(), 0) } else { (T::order(node), shift) };
        // SAFETY: the builder bounds the trees' depth so that there is room (see `STACK_SIZE`, and `OUTER`).
        let set = unsafe {
            near.compress(
                T::names(node, &mut room),
                order,
                shift,
                mask,
                self.near.as_mut_ptr().add(self.count).cast(),
                self.child.as_mut_ptr().add(self.count).cast(),
            )
        };
        self.count += set.count_ones() as usize;
        set
    }

    /// The entry that lies under `above` others.
    ///
    /// # Safety
    /// `above` must be below [`BOTTOM`] - 1, and at most one of the lowest [`BOTTOM`] entries must have been popped
    /// since the count was set.
    #[inline(always)]
    unsafe fn peek(&self, above: usize) -> ChildRef {
        // SAFETY: entries below `count` have been written.
        unsafe { self.child.get_unchecked(self.count - 1 - above).assume_init() }
    }

    /// Removes and returns the top entry.
    ///
    /// # Safety
    /// At most one of the lowest [`BOTTOM`] entries must have been popped since the count was set.
    #[inline(always)]
    unsafe fn pop(&mut self) -> ChildRef {
        self.count -= 1;
        // SAFETY: entries below `count` have been written.
        unsafe { self.child.get_unchecked(self.count).assume_init() }
    }

    /// Removes the entries that begin behind `tmax`. (Entry by entry, without branches, random rays in Sponza took some
    /// 10 % longer.)
    ///
    /// # Safety
    /// The CPU must have the ISA; there must be at least [`BOTTOM`] entries.
    #[inline(always)]
    unsafe fn cut<S: Simd>(&mut self, tmax: f32) {
        let (nears, children) = (self.near.as_mut_ptr().cast::<f32>(), self.child.as_mut_ptr().cast::<u32>());
        // The skipped entries, fewer than eight, are sentinels.
        let mut kept = self.count % WIDTH;
        for first in (kept..self.count).step_by(WIDTH) {
            // SAFETY: entries below `count` have been written, and these eight are; `kept ≤ first`, so that only
            // what has been read is overwritten. The caller vouches for the ISA.
            unsafe {
                let near = S::F8::load(nears.add(first));
                let mask = near.le(S::F8::splat(tmax));
                let names = children.add(first);
                let set = near.compress(names, IN_ORDER.as_ptr(), 0, mask, nears.add(kept), children.add(kept));
                kept += set.count_ones() as usize;
            }
        }
        self.count = kept;
    }
}

/// Traversal state of a ray.
pub(super) struct Walk {
    ray: RaySetup,
    best: Best,
    /// Conservative tmax: boxes that begin behind it are not entered.
    limit: f32,
    /// Child to be visited now.
    current: ChildRef,
    /// Factor from the traversal's t to the ray's own t.
    scale: f32,
    /// Number of the ray in its batch, or of the walk among those under way.
    pub(super) number: usize,
    stack: Stack,
}

impl Walk {
    /// Begins the traversal of a ray in `place`; returns whether there is anything to traverse: some rays cannot hit
    /// anything.
    #[inline(always)]
    pub(super) fn begin<T: Tree>(place: &mut MaybeUninit<Walk>, root: ChildRef, ray: &Ray, number: usize) -> bool {
        // SAFETY: `place` is that of a setup.
        let write = |p, d, tmin| unsafe { RaySetup::write::<T>(p, ray.origin, d, tmin) };
        Self::begin_with(place, root, ray, number, write)
    }

    /// As [`begin`](Self::begin), for a walk through the boxes of instances by [`next_leaf`](Self::next_leaf), with their
    /// `margin`.
    #[inline(always)]
    pub(super) fn begin_in_boxes(place: &mut MaybeUninit<Walk>, ray: &Ray, number: usize, margin: Margin) -> bool {
        // SAFETY: `place` is that of a setup.
        let write = |p, d, tmin| unsafe { RaySetup::write_for_boxes::<Mbvh>(p, ray.origin, d, tmin, margin) };
        Self::begin_with(place, ChildRef::ROOT, ray, number, write)
    }

    #[inline(always)]
    fn begin_with(
        place: &mut MaybeUninit<Walk>,
        root: ChildRef,
        ray: &Ray,
        number: usize,
        write: impl FnOnce(*mut RaySetup, [f32; 3], f32),
    ) -> bool {
        let Some(scale) = direction_scale(ray) else { return false };
        let (mut d, mut tmin, mut tmax) = (ray.direction, ray.tmin, ray.tmax);
        if scale != 1.0 {
            (d, tmin, tmax) = (d.map(|d| d * scale), tmin / scale, tmax / scale);
        }
        // False for NaN.
        if !(tmax > tmin) {
            return false;
        }
        let p = place.as_mut_ptr();
        // SAFETY: the pointers lead into `place`. Everything but entries of the stack is written, and
        // those are `MaybeUninit` themselves.
        unsafe {
            write(&raw mut (*p).ray, d, tmin);
            (&raw mut (*p).best).write(Best::none(tmax));
            (&raw mut (*p).limit).write(beyond(tmax));
            (&raw mut (*p).current).write(root);
            (&raw mut (*p).scale).write(scale);
            (&raw mut (*p).number).write(number);
            (&raw mut (*p).stack.count).write(BOTTOM);
            // Sentinels never begin behind a hit, so that `cut` keeps them.
            (&raw mut (*p).stack.near).cast::<[f32; BOTTOM]>().write([f32::NEG_INFINITY; BOTTOM]);
            (&raw mut (*p).stack.child).cast::<[ChildRef; BOTTOM]>().write([ChildRef::EMPTY; BOTTOM]);
        }
        true
    }

    /// Visits the current node and goes on to the next child. `ALONE`: takes the nearest child from the node itself,
    /// which gives it sooner than the stack, but at the cost of another branch. (Rays one by one take 4 to 7 % less
    /// time.)
    ///
    /// # Safety
    /// The CPU must have the ISA; the walk must have been begun in `tree`, and `current` be a node.
    #[inline(always)]
    unsafe fn visit_node<S: Simd, T: Tree, const ALONE: bool, const ANY: bool>(&mut self, tree: &T) -> ChildRef {
        // SAFETY: forwarded; a bit of `set` is below the node's eight children.
        unsafe {
            let node = tree.node(self.current);
            let boxes = Children::<S, T> { node, isa: PhantomData };
            let (near, mask) = self.ray.boxes::<T::Lanes<S>>(&boxes, self.limit);
            let set = self.stack.push::<S, T, ANY>(node, self.ray.shift, near, mask);
            self.current = if ALONE && set != 0 {
                self.stack.count -= 1;
                let place = set.ilog2();
                let lane = match ANY && T::IS_BY_WORTH {
                    true => place,
                    false => T::order(node).add(place as usize).read() >> self.ray.shift & 7,
                };
                let mut room = MaybeUninit::uninit();
                T::names(node, &mut room).add(lane as usize).cast::<ChildRef>().read()
            } else {
                self.stack.pop()
            };
            self.current
        }
    }

    /// Visits the current leaf and goes on to the next child, which is [`ChildRef::EMPTY`] when there is none, or when
    /// `ANY` is set and the ray has hit something.
    ///
    /// # Safety
    /// The CPU must have the ISA; the walk must have been begun in `tree`, and `current` be a leaf.
    #[inline(always)]
    unsafe fn visit_leaf<S: Simd, T: Tree, A: Accept, const ANY: bool>(
        &mut self,
        tree: &T,
        accept: &mut A,
    ) -> ChildRef {
        // SAFETY: forwarded.
        unsafe {
            if leaf::<S, T, A, ANY>(tree, self.current, &self.ray, self.limit, &mut self.best, accept) {
                if ANY {
                    self.stack.count = BOTTOM;
                } else {
                    self.limit = beyond(self.best.t);
                    self.stack.cut::<S>(self.limit);
                }
            }
            self.current = self.stack.pop();
        }
        self.current
    }

    /// Goes on to the next leaf that begins before `tmax`, which is in lengths of the ray's direction and falls from
    /// call to call; nearest first. Returns [`ChildRef::EMPTY`] after the last one.
    ///
    /// # Safety
    /// The CPU must have the ISA; the walk must have been begun in `tree`, and only this function have been called, or inner
    /// trees have been entered and left.
    #[inline(always)]
    pub(super) unsafe fn next_leaf<S: Simd, T: Tree>(&mut self, tree: &T, tmax: f32) -> ChildRef {
        let limit = beyond(tmax / self.scale);
        // SAFETY: forwarded.
        unsafe {
            if limit < self.limit {
                self.limit = limit;
                self.stack.cut::<S>(limit);
            }
            if self.current.is_leaf() {
                self.current = self.stack.pop();
            }
            while self.current != ChildRef::EMPTY && !self.current.is_leaf() {
                self.visit_node::<S, T, true, false>(tree);
            }
        }
        self.current
    }

    /// Goes into the tree that the current leaf stands for, with the ray in its coordinates. What waits in the outer tree stays on the
    /// stack, and comes up after the inner one has ended: see [`Self::leave`]. Returns false, and changes nothing, for some
    /// rays, which need a walk of their own.
    ///
    /// # Safety
    /// The walk must have been begun, and not be in an inner tree. Until it leaves that, it may be in no tree but a `T`.
    #[inline(always)]
    pub(super) unsafe fn enter<T: Tree>(&mut self, ray: &Ray) -> bool {
        let can_enter = direction_scale(ray) == Some(1.0)
            && self.scale == 1.0
            && ray.tmax > ray.tmin
            && self.stack.count < BOTTOM + OUTER;
        if !can_enter {
            return false;
        }
        // SAFETY: the walk's own.
        unsafe { RaySetup::write::<T>(&raw mut self.ray, ray.origin, ray.direction, ray.tmin) }
        self.best = Best::none(ray.tmax);
        self.limit = beyond(ray.tmax);
        self.current = ChildRef::ROOT;
        self.stack.near[self.stack.count].write(f32::NEG_INFINITY);
        self.stack.child[self.stack.count].write(ChildRef::EMPTY);
        self.stack.count += 1;
        true
    }

    /// Comes out of an inner tree that has ended, with the ray in the coordinates of the outer one, and the margin of
    /// [`begin_in_boxes`](Self::begin_in_boxes). Returns false if nothing waits there.
    #[inline(always)]
    pub(super) fn leave(&mut self, ray: &Ray, margin: Margin) -> bool {
        let has_more = self.stack.count > BOTTOM;
        if has_more {
            let place = &raw mut self.ray;
            // SAFETY: the walk's own.
            unsafe { RaySetup::write_for_boxes::<Mbvh>(place, ray.origin, ray.direction, ray.tmin, margin) }
        }
        has_more
    }

    /// Goes on to the end of the tree, and returns what has been found there.
    ///
    /// # Safety
    /// The CPU must have the ISA; the walk must be in `tree`.
    #[inline(always)]
    pub(super) unsafe fn run<S: Simd, T: Tree, A: Accept, const ANY: bool>(
        &mut self,
        tree: &T,
        accept: &mut A,
    ) -> RawHit {
        while self.current != ChildRef::EMPTY {
            // SAFETY: forwarded.
            unsafe {
                if self.current.is_leaf() {
                    self.visit_leaf::<S, T, A, ANY>(tree, accept);
                } else {
                    self.visit_node::<S, T, true, ANY>(tree);
                    // Prefetches what is next, before it is known to be a node or a leaf, and two entries that follow.
                    // (One entry alone takes 1 to 3 % more time; more are no faster:
                    // docs/experiments.md#single-rays.)
                    tree.prefetch(self.current);
                    tree.prefetch(self.stack.peek(0));
                    tree.prefetch(self.stack.peek(1));
                }
            }
        }
        self.hit()
    }

    #[inline(always)]
    pub(super) fn hit(&self) -> RawHit {
        let mut hit = self.best.hit();
        hit.t *= self.scale;
        hit
    }
}

/// Traces one ray to its closest hit; `ANY`: to any hit, whose result says only whether there is one.
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
pub(super) unsafe fn one<S: Simd, T: Tree, const ANY: bool>(tree: &T, ray: &Ray) -> RawHit {
    // SAFETY: forwarded.
    unsafe { one_of::<S, T, All, ANY>(tree, ray, &mut All) }
}

/// Traces one ray as `one` does, but counts only the hits that `accept` accepts.
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
pub(super) unsafe fn one_of<S: Simd, T: Tree, A: Accept, const ANY: bool>(
    tree: &T,
    ray: &Ray,
    accept: &mut A,
) -> RawHit {
    let mut place = MaybeUninit::uninit();
    if !Walk::begin::<T>(&mut place, ChildRef::ROOT, ray, 0) {
        return RawHit::MISS;
    }
    // SAFETY: it has begun. The caller vouches for the ISA.
    unsafe { place.assume_init_mut().run::<S, T, A, ANY>(tree, accept) }
}

/// Number of rays under way at the same time. (Sponza, random rays: 4 trace 2.3, 8 trace 2.6, 16 and 32 trace 3.0
/// Mrays/s.)
pub(super) const FLIGHT: usize = 16;

thread_local! {
    /// An empty vector with capacity for [`FLIGHT`] traversals: 90 kB, more than some callers' threads have of stack.
    static ROOM: Cell<Vec<Walk>> = const { Cell::new(Vec::new()) };
}

/// Takes the thread's buffer for [`FLIGHT`] traversals. Its capacity is smaller if memory is short or the thread is
/// ending.
#[inline(never)]
fn take_room() -> Vec<Walk> {
    let mut room = ROOM.try_with(Cell::take).unwrap_or_default();
    // If that fails, one ray is under way at a time.
    let _ = room.try_reserve_exact(FLIGHT);
    room
}

#[inline(never)]
fn give_room_back(room: Vec<Walk>) {
    let _ = ROOM.try_with(|kept| kept.set(room));
}

/// What [`fly`] is to traverse.
///
/// # Safety
/// Where `begin` and `end` return true, the walk must have been begun, be at a node, and be in the tree that `tree` returns.
pub(super) unsafe trait Work<T> {
    /// Begins the next traversal in a place, of that number among those under way. Returns false when nothing is left.
    ///
    /// # Safety
    /// The CPU must have the ISA.
    unsafe fn begin<S: Simd>(&mut self, place: &mut MaybeUninit<Walk>, number: usize) -> bool;

    /// Takes what a traversal has found. Returns true if it has begun another one in its place.
    ///
    /// # Safety
    /// The CPU must have the ISA; the traversal must have ended.
    unsafe fn end<S: Simd>(&mut self, walk: &mut Walk) -> bool;

    /// The tree of a traversal.
    ///
    /// # Safety
    /// The traversal must have begun.
    unsafe fn tree(&self, walk: &Walk) -> &T;
}

/// Rays from 0 to `count`, which `ray` returns, below a node of a tree; `done` receives their hits.
struct Rays<'a, T, R, D> {
    tree: &'a T,
    root: ChildRef,
    next: usize,
    count: usize,
    ray: R,
    done: D,
}

// SAFETY: walks are begun in the one tree, at its root or another node.
unsafe impl<T: Tree, R: Fn(usize) -> Ray, D: FnMut(usize, RawHit)> Work<T> for Rays<'_, T, R, D> {
    #[inline(always)]
    unsafe fn begin<S: Simd>(&mut self, place: &mut MaybeUninit<Walk>, _: usize) -> bool {
        while self.next < self.count {
            let number = self.next;
            self.next += 1;
            if Walk::begin::<T>(place, self.root, &(self.ray)(number), number) {
                return true;
            }
            (self.done)(number, RawHit::MISS);
        }
        false
    }

    #[inline(always)]
    unsafe fn end<S: Simd>(&mut self, walk: &mut Walk) -> bool {
        (self.done)(walk.number, walk.hit());
        false
    }

    #[inline(always)]
    unsafe fn tree(&self, _: &Walk) -> &T {
        self.tree
    }
}

/// Traversals that wait for the same kind of visit: one more than there can be, for a branch-free push.
type Queue = [*mut Walk; FLIGHT + 1];

/// Traces many rays below the node `root`, [`FLIGHT`] of them at a time: `ray` returns the rays from 0 to `count`,
/// `done` receives their hits, in any order.
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
pub(super) unsafe fn many<S: Simd, T: Tree, const ANY: bool>(
    tree: &T,
    root: ChildRef,
    count: usize,
    ray: impl Fn(usize) -> Ray,
    done: impl FnMut(usize, RawHit),
) {
    // SAFETY: forwarded.
    unsafe { fly::<S, T, ANY>(&mut Rays { tree, root, next: 0, count, ray, done }) }
}

/// Does `work`, [`FLIGHT`] traversals at a time.
///
/// While one ray waits for memory, others go on; and visits of nodes and of leaves are done by turns
/// for all rays under way, so that the kind of the next child is not a branch to be mispredicted.
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
pub(super) unsafe fn fly<S: Simd, T: Tree, const ANY: bool>(work: &mut impl Work<T>) {
    let mut room = take_room();
    let mut place = MaybeUninit::uninit();
    let (first, flight) = match room.capacity() {
        FLIGHT.. => (room.as_mut_ptr(), FLIGHT),
        _ => (place.as_mut_ptr(), 1),
    };
    let mut idle: Queue = std::array::from_fn(|i| first.wrapping_add(i));
    let (mut at_nodes, mut at_leaves): (Queue, Queue) = ([std::ptr::null_mut(); _], [std::ptr::null_mut(); _]);
    let (idle, at_nodes, at_leaves) = (idle.as_mut_ptr(), at_nodes.as_mut_ptr(), at_leaves.as_mut_ptr());
    let (mut idle_count, mut node_count, mut leaf_count) = (flight, 0, 0);
    // Every traversal is in one queue, so that no queue holds more than FLIGHT; the blocks below rely on that.
    loop {
        while idle_count > 0 {
            // SAFETY: the queue's last entry, which names one of the places; nothing else refers to an idle one. The
            // caller vouches for the ISA.
            unsafe {
                let walk = *idle.add(idle_count - 1);
                if !work.begin::<S>(&mut *walk.cast(), walk.offset_from_unsigned(first)) {
                    break;
                }
                idle_count -= 1;
                // The walk was idle, so that there is room among those at nodes.
                *at_nodes.add(node_count) = walk;
                node_count += 1;
            }
        }
        if idle_count == flight {
            return give_room_back(room);
        }
        // Puts a traversal into the queue of its next visit: it is written to both queues, but counted in one, at or
        // before the position that is read next.
        let enqueue = |walk: *mut Walk, child: ChildRef, nodes: &mut usize, leaves: &mut usize| {
            // SAFETY: at most FLIGHT walks are counted in a queue, and each has room for one more.
            unsafe {
                *at_nodes.add(*nodes) = walk;
                *at_leaves.add(*leaves) = walk;
            }
            *leaves += child.is_leaf() as usize;
            *nodes += !child.is_leaf() as usize;
        };
        let visits = std::mem::take(&mut node_count);
        for k in 0..visits {
            // SAFETY: one of the queue's walks, which have begun in this tree and are at a node. The caller
            // vouches for the ISA.
            let (walk, child) = unsafe {
                let walk = *at_nodes.add(k);
                let tree = work.tree(&*walk);
                let child = (*walk).visit_node::<S, T, false, ANY>(tree);
                tree.prefetch(child);
                (walk, child)
            };
            enqueue(walk, child, &mut node_count, &mut leaf_count);
        }
        let visits = std::mem::take(&mut leaf_count);
        for k in 0..visits {
            // SAFETY: one of the queue's walks, which have begun; nothing else refers to it now.
            let walk = unsafe { &mut **at_leaves.add(k) };
            let mut child = walk.current;
            if child != ChildRef::EMPTY {
                // SAFETY: it has begun in this tree, and is at a leaf. The caller vouches for the ISA.
                let tree = unsafe { work.tree(walk) };
                // SAFETY: as above.
                child = unsafe { walk.visit_leaf::<S, T, All, ANY>(tree, &mut All) };
                if child != ChildRef::EMPTY {
                    tree.prefetch(child);
                    enqueue(walk, child, &mut node_count, &mut leaf_count);
                    continue;
                }
            }
            // SAFETY: the walk has ended. The caller vouches for the ISA.
            if unsafe { work.end::<S>(walk) } {
                enqueue(walk, walk.current, &mut node_count, &mut leaf_count);
                continue;
            }
            // SAFETY: the walk was in another queue, so that there is room among the idle ones.
            unsafe { *idle.add(idle_count) = walk };
            idle_count += 1;
        }
    }
}
