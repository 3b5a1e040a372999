//! Ray streams: rays that start near one another go down the tree as lists (Barringer and Akenine-Möller, *Dynamic Ray
//! Stream Traversal*, 2014; Tsakok, *Faster Incoherent Rays: Multi-BVH Ray Stream Tracing*, 2009).
//!
//! ```text
//! for each octant of directions, with all of its rays:
//! push (root, all rays)
//! while (child, list) is popped:
//!     node:  test each ray of the list against the children's boxes, whose planes stay in registers;
//!            for each child that any ray hits, from far to near, or to any hit from least to most worth:
//!            push (child, list of these rays)
//!     leaf:  test each ray of the list against the triangles, two rays at a time
//! ```
//!
//! A ray is in as many lists as it hits boxes, and leaves them on its own: unlike a packet, a list holds no ray that
//! misses. What a node or a leaf costs beside its tests (fetching it, waiting for it, guessing what comes next) is paid
//! once per list.
//!
//! Rays to any hit that go the same way are faster in packs: [`beams`].
//!
//! Hits are those of [`single`](super::single), bit for bit: boxes and triangles are tested by the same arithmetic, and
//! which of a leaf's hits is the closest does not depend on the order of visits. Rays that need special treatment in a
//! test, rays of octants that few rays have, and rays whose lists find no room are traced one by one.

use super::groups::{ChildBoxes, Group};
use super::stream_rays::{MAX_RAYS, Room, sort, sort_rest};
use super::tree::{Leaf, RaySetup, Tree, beyond};
use super::triangle::{Projected, V3, accurate_distance};
use super::{RawHit, Ray, beams, single};
use crate::base::geometry::NONE;
use crate::bvh::layout::{ChildRef, STACK_SIZE};
use crate::simd::{Eight, Lanes, Mask, Simd};
use std::mem::MaybeUninit;

/// Minimum number of rays of an octant that go down the tree as lists.
const LEAST: usize = 24;

/// Traces rays to their closest hits below the node `root`, or with `ANY` to any hit, whose result says only whether
/// there is one. `done` receives the hits by the number of the ray, in any order.
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
pub(super) unsafe fn stream<S: Simd, T: Tree, const ANY: bool>(
    tree: &T,
    root: ChildRef,
    rays: &[Ray],
    mut done: impl FnMut(usize, RawHit),
) {
    let Some(mut room) = Room::take() else {
        // SAFETY: forwarded.
        return unsafe { single::many::<S, T, ANY>(tree, root, rays.len(), |i| rays[i], done) };
    };
    for (chunk, rays) in rays.chunks(MAX_RAYS).enumerate() {
        let first = chunk * MAX_RAYS;
        let starts = match tree.whole() {
            Some(tree) if ANY => {
                let Room { keys, beams, rest, .. } = &mut *room;
                let done = |number: usize, is_hit: bool| {
                    let triangle = if is_hit { 0 } else { NONE };
                    done(first + number, RawHit { triangle, ..RawHit::MISS });
                };
                // SAFETY: forwarded.
                unsafe { beams::trace::<S>(tree, root, rays, beams, keys, rest, done) };
                sort_rest(&mut room)
            }
            // SAFETY: forwarded.
            _ => unsafe { sort::<S>(rays, &mut room) },
        };
        for octant in 0..8 {
            let group = Group::new(octant, &starts);
            if group.len() < LEAST {
                room.leave_alone(group.begin..group.end());
                continue;
            }
            // SAFETY: the rays of the group have been sorted into it; the caller vouches for the ISA.
            unsafe {
                room.set_up::<S>(rays, &group);
                Traversal { tree, rays, room: &mut room, group: &group }.run::<S, ANY>(root);
            }
            room.report::<ANY>(&group, |i, hit| done(first + i, hit));
        }
        room.leave_alone(starts[24]..starts[25]);
        let alone = std::mem::take(&mut room.alone);
        let ray = |i: usize| rays[alone[i] as usize];
        // SAFETY: forwarded.
        unsafe {
            single::many::<S, T, ANY>(tree, root, alone.len(), ray, |i, hit| done(first + alone[i] as usize, hit))
        };
        room.alone = alone;
        room.alone.clear();
    }
    room.give_back();
}

/// A child that waits for its visit, and the rays that hit its box.
#[derive(Clone, Copy)]
struct Entry {
    child: ChildRef,
    /// Place of its list among the numbers.
    start: u32,
    count: u32,
}

/// The traversal of a group of rays.
struct Traversal<'a, T> {
    tree: &'a T,
    rays: &'a [Ray],
    room: &'a mut Room,
    group: &'a Group,
}

impl<T: Tree> Traversal<'_, T> {
    /// # Safety
    /// The CPU must have the ISA, and the rays of the group must have been set up.
    #[inline(always)]
    unsafe fn run<S: Simd, const ANY: bool>(&mut self, root: ChildRef) {
        let mut stack = [const { MaybeUninit::<Entry>::uninit() }; STACK_SIZE];
        let all = self.group.len();
        for (i, number) in self.room.numbers[..all].iter_mut().enumerate() {
            *number = i as u16;
        }
        stack[0].write(Entry { child: root, start: 0, count: all as u32 });
        let mut depth = 1;
        while depth > 0 {
            depth -= 1;
            // SAFETY: entries below `depth` have been written; children of the tree are its nodes and leaves; the
            // builder bounds the tree's depth so that there is room on the stack (see `STACK_SIZE`).
            unsafe {
                let mut entry = stack.get_unchecked(depth).assume_init();
                if ANY {
                    entry.count = self.drop_done(entry);
                    if entry.count == 0 {
                        continue;
                    }
                }
                if entry.child.is_leaf() {
                    self.visit_leaf::<S, ANY>(entry);
                } else {
                    depth += self.visit_node::<S, ANY>(entry, stack.as_mut_ptr().add(depth).cast());
                }
            }
        }
    }

    /// Drops rays from a list that hit no further box, for they have their hit. Returns how many are left.
    ///
    /// # Safety
    /// `entry` must have been pushed.
    #[inline(always)]
    unsafe fn drop_done(&mut self, entry: Entry) -> u32 {
        let mut left = 0;
        // SAFETY: the list lies within `numbers`, which are those of slabs that were set up.
        unsafe {
            let numbers = self.room.numbers.as_mut_ptr().add(entry.start as usize);
            let slabs = self.room.slabs.as_ptr();
            for i in 0..entry.count as usize {
                let number = *numbers.add(i);
                *numbers.add(left) = number;
                left += usize::from((*slabs.add(number as usize)).limit != f32::NEG_INFINITY);
            }
        }
        left as u32
    }

    /// Tests the rays of a list against the children of a node, and pushes those that any ray hits. Returns how many.
    ///
    /// # Safety
    /// The CPU must have the ISA; `entry` must be of a node of the tree, and `stack` have room for eight entries.
    #[inline(always)]
    unsafe fn visit_node<S: Simd, const ANY: bool>(&mut self, entry: Entry, stack: *mut Entry) -> usize {
        let (start, count) = (entry.start as usize, entry.count as usize);
        let room = &mut *self.room;
        // SAFETY: a list's numbers are below the number of slabs that were set up, and the list lies within `numbers`.
        // There are as many masks as rays, rounded up to 32, and more.
        unsafe {
            let node = self.tree.node(entry.child);
            let boxes = ChildBoxes::new::<S, T>(node, self.group.octant);
            let (numbers, masks) = (room.numbers.as_mut_ptr(), room.masks.as_mut_ptr());
            let slabs = room.slabs.as_ptr();
            let mut met = 0;
            for i in 0..count {
                let slab = &*slabs.add(*numbers.add(start + i) as usize);
                let bits = boxes.hits(slab).bits();
                *masks.add(i) = bits as u8;
                met |= bits;
            }
            if met == 0 {
                return 0;
            }
            // What `pick` reads beyond the masks.
            masks.add(count).cast::<[u8; 32]>().write_unaligned([0; 32]);
            let mut top = start + count;
            // `pick` reads and writes up to 31 numbers beyond a list.
            if top + met.count_ones() as usize * count + 32 > room.numbers.len() {
                self.leave_alone(start..top);
                return 0;
            }
            let mut names = MaybeUninit::uninit();
            let (names, order) = (T::names(node, &mut names), T::order(node));
            // The nearest child is visited as soon as the lists have been made. (All lines of all children before,
            // instead of the first of each with its list: 1 to 4 % faster.)
            let mut children = met;
            while children != 0 {
                let child = names.add(children.trailing_zeros() as usize).cast::<ChildRef>().read();
                self.tree.prefetch_whole(child);
                children &= children - 1;
            }
            let mut pushed = 0;
            for place in 0..T::WIDTH {
                // (By worth, shadow rays of tiles to a lamp are 1.45 times as fast in Sponza, 1.3 times in the living
                // room.)
                let lane = match ANY && T::IS_BY_WORTH {
                    true => place as u32,
                    false => order.add(place).read() >> (3 * self.group.octant) & 7,
                };
                if met >> lane & 1 == 0 {
                    continue;
                }
                let child = names.add(lane as usize).cast::<ChildRef>().read();
                let picked = S::pick(masks, numbers.add(start), count, lane, numbers.add(top));
                stack.add(pushed).write(Entry { child, start: top as u32, count: picked as u32 });
                pushed += 1;
                top += picked;
            }
            pushed
        }
    }

    /// Leaves the rays of a list to be traced one by one. They hit no further box.
    #[cold]
    fn leave_alone(&mut self, list: std::ops::Range<usize>) {
        for place in list {
            let i = self.room.numbers[place] as usize;
            let slab = &mut self.room.slabs[i];
            // A ray that hits no further box has been left alone already, or, of rays to any hit, has its hit.
            if slab.limit != f32::NEG_INFINITY {
                slab.limit = f32::NEG_INFINITY;
                self.room.targets[i].t = f32::NEG_INFINITY;
                self.room.targets[i].is_alone = 1;
                self.room.alone.push(self.room.order[self.group.begin + i]);
            }
        }
    }

    /// Tests the rays of a list against the triangles of a leaf.
    ///
    /// # Safety
    /// The CPU must have the ISA; `entry` must be of a leaf of the tree.
    #[inline(always)]
    unsafe fn visit_leaf<S: Simd, const ANY: bool>(&mut self, entry: Entry) {
        // SAFETY: forwarded.
        let leaf = unsafe { self.tree.leaf::<S>(entry.child) };
        let mut room = MaybeUninit::uninit();
        let (rows, count) = (leaf.rows(&mut room), leaf.count());
        let list = entry.start as usize..(entry.start + entry.count) as usize;
        let mut next = list.start;
        // Numbers ascend, and rays were sorted by axis: the list is three runs of rays with the same axes.
        for axis in 0..3 {
            let end = self.group.runs[axis + 1];
            let first = next;
            // SAFETY: lists lie within `numbers`.
            while next < list.end && (unsafe { *self.room.numbers.get_unchecked(next) } as usize) < end {
                next += 1;
            }
            if first < next {
                let axes = self.group.axes(axis);
                for row in (0..count).step_by(4) {
                    // SAFETY: forwarded; `row` is below the count.
                    unsafe { self.test::<S, ANY>(&leaf, rows, axes, row, first..next) };
                }
            }
        }
    }

    /// Tests rays with the same axes against up to four triangles of a leaf.
    ///
    /// # Safety
    /// The CPU must have the ISA; `rows` must be those of the leaf, `first` below its count, and `list` lie within
    /// `numbers`.
    #[inline(always)]
    unsafe fn test<S: Simd, const ANY: bool>(
        &mut self,
        leaf: &T::Leaf<'_>,
        rows: *const f32,
        axes: &'static [u32; 3],
        first: usize,
        list: std::ops::Range<usize>,
    ) {
        let count = leaf.count();
        let lanes = if count - first >= 4 { 0xf } else { (1u32 << (count - first)) - 1 };
        let lanes = lanes | lanes << 4;
        // SAFETY: rows are `count` apart, and four more floats are readable behind the last.
        let row = |corner: usize, a: usize| unsafe {
            let p = rows.add(first + (3 * corner + axes[a] as usize) * count);
            S::F8::pair(p, p)
        };
        let corners: [[S::F8; 3]; 3] =
            [[row(0, 0), row(0, 1), row(0, 2)], [row(1, 0), row(1, 1), row(1, 2)], [row(2, 0), row(2, 1), row(2, 2)]];
        let targets = self.room.targets.as_mut_ptr();
        for place in list.clone().step_by(2) {
            // SAFETY: the list's numbers are below the number of targets that were set up. A target is four times four
            // floats. The caller vouches for the ISA.
            unsafe {
                let i = *self.room.numbers.get_unchecked(place) as usize;
                // The last of an odd number is its own partner.
                let j = *self.room.numbers.get_unchecked((place + 1).min(list.end - 1)) as usize;
                let (a, b) = (targets.add(i).cast::<f32>(), targets.add(j).cast::<f32>());
                let origin = S::F8::pair(a, b);
                let back = S::F8::pair(a.add(4), b.add(4));
                let range = S::F8::pair(a.add(8), b.add(8));
                let (x, y, z) = (origin.spread::<0>(), origin.spread::<1>(), origin.spread::<2>());
                let [ca, cb, cc] = corners;
                let projected = Projected::new(
                    [
                        V3 { x: x - ca[0], y: y - ca[1], z: z - ca[2] },
                        V3 { x: x - cb[0], y: y - cb[1], z: z - cb[2] },
                        V3 { x: x - cc[0], y: y - cc[1], z: z - cc[2] },
                    ],
                    [origin.spread::<3>(), back.spread::<3>()],
                );
                let inside = projected.inside();
                let back = V3 { x: back.spread::<0>(), y: back.spread::<1>(), z: back.spread::<2>() };
                let (t, is_accurate) = projected.distances_along(back, range.spread::<0>());
                let in_range = range.spread::<1>().lt(t).and(t.le(range.spread::<2>()));
                let inside = inside.bits() & lanes;
                let inaccurate = inside & !is_accurate.bits();
                let candidates = inside & (in_range.bits() | inaccurate);
                if candidates != 0 {
                    let hits = Candidates { t, u: projected.u, v: projected.v, w: projected.w, inaccurate };
                    self.improve::<S, ANY>(leaf, rows, axes, first, [i, j], candidates, hits);
                }
            }
        }
    }

    /// Takes over the hits that are closer than what two rays have hit.
    ///
    /// # Safety
    /// As for `test`; `pair` must be numbers of rays that were set up, and `candidates` have no lane beyond the count.
    #[inline(always)]
    unsafe fn improve<S: Simd, const ANY: bool>(
        &mut self,
        leaf: &T::Leaf<'_>,
        rows: *const f32,
        axes: &'static [u32; 3],
        first: usize,
        pair: [usize; 2],
        mut candidates: u32,
        hits: Candidates<S::F8>,
    ) {
        let (t, u, v, w) = (hits.t.to_array(), hits.u.to_array(), hits.v.to_array(), hits.w.to_array());
        while candidates != 0 {
            let lane = candidates.trailing_zeros() as usize;
            candidates &= candidates - 1;
            let (number, triangle) = (pair[lane / 4], first + lane % 4);
            let sum = u[lane] + v[lane] + w[lane];
            // SAFETY: forwarded.
            unsafe {
                let target = &mut *self.room.targets.as_mut_ptr().add(number);
                let mut t = t[lane];
                if hits.inaccurate >> lane & 1 != 0 {
                    // If all weights vanish, the ray lies in the plane.
                    if sum == 0.0 {
                        continue;
                    }
                    t = accurate_distance(rows, leaf.count(), triangle, &target.shear(axes));
                }
                if !(target.tmin < t && t <= target.t) {
                    continue;
                }
                let slab = &mut *self.room.slabs.as_mut_ptr().add(number);
                if !T::Leaf::ALWAYS_COUNTS {
                    let ray = &self.rays[self.room.order[self.group.begin + number] as usize];
                    let setup = RaySetup::new::<T>(ray.origin, ray.direction, ray.tmin);
                    if !leaf.counts::<S>(triangle, &setup, slab.limit) {
                        continue;
                    }
                }
                if ANY {
                    // Any triangle number marks a hit.
                    target.triangle = 0;
                    (target.t, slab.limit) = (f32::NEG_INFINITY, f32::NEG_INFINITY);
                    continue;
                }
                let id = leaf.number(triangle);
                if t < target.t || id < target.triangle {
                    (target.t, target.triangle) = (t, id);
                    (target.u, target.v, target.sum) = (u[lane], v[lane], sum);
                    slab.limit = beyond(t);
                }
            }
        }
    }
}

/// Results of a test of two rays against four triangles.
struct Candidates<L> {
    t: L,
    u: L,
    v: L,
    w: L,
    /// Lanes whose distance f32 does not give.
    inaccurate: u32,
}
