//! Rays that go alike through the tree over [instances](super::instances): as lists, like those of a
//! [stream](super::stream), with meshes in place of triangles, so that rays that came together go through a mesh
//! together.
//!
//! ```text
//! push (root, all rays)
//! while (child, list) is popped:
//!     node:  test each ray of the list against the children's boxes;
//!            for each child that any ray hits, from far to near on average: push (child, list of these rays)
//!     leaf:  drop the rays that have hit something before its box; the others go through its mesh
//! ```
//!
//! Rays of a list keep their order and need not be of one octant, since turned instances would mix octants anyway.

use super::Ray;
use super::ray_keys::{SPECIAL, keys_of};
use super::stream_rays::{Offsets, offsets};
use super::tree::{Leaf, Tree, beyond};
use crate::bvh::instances::{Instances, Margin, PlacedTree};
use crate::bvh::layout::{ChildRef, Mbvh, Node, STACK_SIZE, WIDTH};
use crate::simd::{Eight, Lanes, Mask, Simd};
use bytemuck::Zeroable;
use std::mem::MaybeUninit;

/// Maximum number of rays that go together.
pub(super) const MAX_RAYS: usize = 1024;

/// Room for numbers in lists.
const NUMBERS: usize = 32 * MAX_RAYS;

/// What the box test reads of a ray: see [`RaySetup`](super::tree::RaySetup).
#[derive(Clone, Copy, Zeroable)]
#[repr(C, align(64))]
struct Slab {
    reciprocal: [f32; 3],
    near_offset: [f32; 3],
    far_offset: [f32; 3],
    tmin: f32,
    /// Conservative tmax: boxes that begin behind it are not hit.
    limit: f32,
    /// Offset in bytes from the first row of a node's planes to the near ones, per axis.
    near: [u32; 3],
    unused: [f32; 2],
}

/// Working memory: 0.25 MB per thread that traces such rays.
#[derive(Default)]
pub(super) struct Room {
    /// Rays, with how far they go now.
    pub(super) rays: Vec<Ray>,
    slabs: Vec<Slab>,
    /// Boxes that the rays of a list hit, bit i for child i.
    masks: Vec<u8>,
    /// Lists of numbers of rays.
    pub(super) numbers: Vec<u16>,
    /// Rays that are in no list: those that need special treatment in a test, those whose lists found no room, and those
    /// in no bundle.
    pub(super) alone: Vec<u16>,
    /// The rays at an instance, in the coordinates of its mesh.
    turned: Vec<Ray>,
    /// Whether any ray's end has changed since the rays were set up.
    pub(super) has_ended: bool,
}

/// The rays at an instance.
pub(super) struct Visit<'a> {
    pub instance: u32,
    /// Their numbers, and what they are in the coordinates of the mesh.
    pub numbers: &'a [u16],
    pub rays: &'a [Ray],
    ends: &'a mut [Ray],
    slabs: &'a mut [Slab],
    has_ended: &'a mut bool,
}

/// What is done with the rays at an instance.
pub(super) type OnVisit<'a> = &'a mut dyn FnMut(Visit);

impl Visit<'_> {
    /// Tells how far a ray goes on; `None`: no further.
    #[inline(always)]
    pub(super) fn end(&mut self, number: u16, tmax: Option<f32>) {
        let tmax = tmax.unwrap_or(f32::NEG_INFINITY);
        *self.has_ended = true;
        self.ends[number as usize].tmax = tmax;
        self.slabs[number as usize].limit = if tmax == f32::NEG_INFINITY { tmax } else { beyond(tmax) };
    }
}

impl Room {
    pub(super) const fn new() -> Room {
        Room {
            rays: Vec::new(),
            slabs: Vec::new(),
            masks: Vec::new(),
            numbers: Vec::new(),
            alone: Vec::new(),
            turned: Vec::new(),
            has_ended: false,
        }
    }

    /// Whether there is memory for as many rays as go together.
    pub(super) fn has_memory(&mut self) -> bool {
        let nothing = Ray::zeroed();
        self.alone.try_reserve_exact(MAX_RAYS.saturating_sub(self.alone.len())).is_ok()
            && fill(&mut self.rays, MAX_RAYS, nothing)
            && fill(&mut self.slabs, MAX_RAYS, Slab::zeroed())
            && fill(&mut self.masks, MAX_RAYS + 64, 0)
            && fill(&mut self.numbers, NUMBERS, 0)
            && fill(&mut self.turned, MAX_RAYS, nothing)
    }

    /// Whether all buffers have their lengths.
    pub(super) fn is_full(&self) -> bool {
        let has_lists =
            self.slabs.len() == MAX_RAYS && self.numbers.len() == NUMBERS && self.masks.len() >= MAX_RAYS + 64;
        has_lists && self.rays.len() == MAX_RAYS && self.turned.len() == MAX_RAYS
    }

    /// Takes the rays of a list, which lies within `numbers`, to an instance.
    ///
    /// # Safety
    /// The CPU must have the ISA; the numbers of the list must be those of rays.
    #[inline(always)]
    pub(super) unsafe fn visit<S: Simd>(
        &mut self,
        instances: &Instances,
        instance: u32,
        list: std::ops::Range<usize>,
        visit: OnVisit,
    ) {
        // SAFETY: forwarded.
        unsafe { turn::<S::F8>(&instances.placed[instance as usize], list.clone(), self) }
        let Room { rays, slabs, numbers, turned, has_ended, .. } = self;
        let turned = &turned[..list.len()];
        visit(Visit { instance, numbers: &numbers[list], rays: turned, ends: rays, slabs, has_ended });
    }

    /// Takes rays, at most [`MAX_RAYS`], with how far they go: `None` if they do not. Returns their number.
    #[inline]
    pub(super) fn take<'a>(&mut self, rays: impl Iterator<Item = (&'a Ray, Option<f32>)>) -> usize {
        let mut count = 0;
        for (place, (ray, tmax)) in self.rays.iter_mut().zip(rays) {
            *place = Ray { tmax: tmax.unwrap_or(f32::NEG_INFINITY), ..*ray };
            count += 1;
        }
        count
    }

    /// Numbers of the rays that were in no list, or in one that found no room: they are still to be traced.
    pub(super) fn alone(&self) -> &[u16] {
        &self.alone
    }
}

/// Gives a buffer its length, if it has not got it yet. Returns false if there is not enough memory.
pub(super) fn fill<T: Clone>(v: &mut Vec<T>, count: usize, value: T) -> bool {
    let has_memory = v.try_reserve_exact(count.saturating_sub(v.len())).is_ok();
    if has_memory {
        v.resize(count, value);
    }
    has_memory
}

/// A child that waits for its visit, the rays that hit its box, and where its planes are.
#[derive(Clone, Copy)]
struct Entry {
    child: ChildRef,
    /// Place of its list among the numbers.
    start: u32,
    count: u32,
    parent: ChildRef,
    lane: u32,
}

/// Takes the first `count` rays that `room` has taken through the tree over instances. Calls `visit` with each that any of
/// them meets.
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
pub(super) unsafe fn trace<S: Simd>(instances: &Instances, count: usize, room: &mut Room, visit: OnVisit) {
    let top = &instances.top;
    assert!(room.is_full() && count <= MAX_RAYS);
    // SAFETY: forwarded.
    let all = unsafe { set_up::<S::F8>(count, instances.margin, room) };
    let mut stack = [const { MaybeUninit::<Entry>::uninit() }; STACK_SIZE];
    stack[0].write(Entry { child: ChildRef::ROOT, start: 0, count: all as u32, parent: ChildRef::ROOT, lane: 0 });
    let mut depth = usize::from(all > 0);
    room.has_ended = false;
    while depth > 0 {
        depth -= 1;
        // SAFETY: entries below `depth` have been written; children of the tree are its nodes and leaves, of one box
        // each; the builder bounds the tree's depth so that there is room on the stack (see `STACK_SIZE`). The caller
        // vouches for the ISA.
        unsafe {
            let mut entry = stack.get_unchecked(depth).assume_init();
            if !entry.child.is_leaf() {
                depth += visit_node::<S>(top, entry, room, stack.as_mut_ptr().add(depth).cast());
                continue;
            }
            if room.has_ended {
                entry.count = keep_those_that_hit::<S>(top, entry, room);
            }
            if entry.count > 0 {
                let instance = Tree::leaf::<S>(top, entry.child).number(0);
                let numbers = entry.start as usize..(entry.start + entry.count) as usize;
                room.visit::<S>(instances, instance, numbers, visit);
            }
        }
    }
}

/// Sets up rays, and lists those that need no special treatment. Returns the length of the list.
///
/// # Safety
/// The CPU must have the ISA; the room must have its full length.
#[inline(always)]
unsafe fn set_up<L: Eight>(count: usize, margin: Margin, room: &mut Room) -> usize {
    room.alone.clear();
    let mut listed = 0;
    for first in (0..count).step_by(8) {
        // SAFETY: a ray is eight floats, a slab sixteen; `MAX_RAYS` is a multiple of eight. The caller vouches for the
        // ISA.
        let keys = unsafe {
            let rays = L::transpose(std::array::from_fn(|i| L::load(std::ptr::from_ref(&room.rays[first + i]).cast())));
            let [ox, oy, oz, tmin, dx, dy, dz, tmax] = rays;
            let Offsets { reciprocal, mut near, mut far, limit } = offsets([ox, oy, oz], [dx, dy, dz], tmax);
            let zero = L::splat(0.0);
            let abs = |x: L| x.max(zero - x);
            // As in `RaySetup::write_for_boxes`.
            let most = abs(ox).max(abs(oy)).max(abs(oz));
            if L::splat(margin.reach).lt(most).any() {
                for a in 0..3 {
                    let beside = L::splat(margin.part) * most * abs(reciprocal[a]);
                    (near[a], far[a]) = (near[a] - beside, far[a] + beside);
                }
            }
            let row = |axis: u32, d: L| {
                let row = |place: u32| L::splat(f32::from_bits(Mbvh::<WIDTH>::ROW * place));
                L::select(d.lt(zero), row(axis + 3), row(axis))
            };
            let low = [reciprocal[0], reciprocal[1], reciprocal[2], near[0], near[1], near[2], far[0], far[1]];
            let low = L::transpose(low);
            let high = L::transpose([far[2], tmin, limit, row(0, dx), row(1, dy), row(2, dz), zero, zero]);
            for i in 0..8 {
                let slab = std::ptr::from_mut(&mut room.slabs[first + i]).cast::<f32>();
                low[i].store(slab);
                high[i].store(slab.add(8));
            }
            keys_of(rays)
        };
        for (number, key) in (first..count).zip(keys) {
            if key as usize == SPECIAL {
                room.alone.push(number as u16);
            } else {
                room.numbers[listed] = number as u16;
                listed += 1;
            }
        }
    }
    listed
}

/// Transforms the rays of a list to the coordinates of an instance's mesh, with the arithmetic of
/// [`to_mesh`](super::instances::to_mesh).
///
/// # Safety
/// The CPU must have the ISA; the list must lie within `numbers`, and its numbers be those of rays.
#[inline(always)]
unsafe fn turn<L: Eight>(at: &PlacedTree, list: std::ops::Range<usize>, room: &mut Room) {
    let numbers = &room.numbers[list];
    let (m, place) = (at.to_mesh.to_cols_array_2d(), at.origin.to_array());
    for (eight, turned) in numbers.chunks(8).zip(room.turned.chunks_exact_mut(8)) {
        // SAFETY: a ray is eight floats. The caller vouches for the ISA.
        unsafe {
            let ray = |i: usize| L::load(std::ptr::from_ref(&room.rays[eight[i.min(eight.len() - 1)] as usize]).cast());
            let rows = [ray(0), ray(1), ray(2), ray(3), ray(4), ray(5), ray(6), ray(7)];
            let [ox, oy, oz, tmin, dx, dy, dz, tmax] = L::transpose(rows);
            let [ox, oy, oz] = [ox - L::splat(place[0]), oy - L::splat(place[1]), oz - L::splat(place[2])];
            let row =
                |a: usize, x: L, y: L, z: L| L::splat(m[0][a]) * x + L::splat(m[1][a]) * y + L::splat(m[2][a]) * z;
            let origin = [row(0, ox, oy, oz), row(1, ox, oy, oz), row(2, ox, oy, oz)];
            let direction = [row(0, dx, dy, dz), row(1, dx, dy, dz), row(2, dx, dy, dz)];
            let rows = [origin[0], origin[1], origin[2], tmin, direction[0], direction[1], direction[2], tmax];
            for (ray, turned) in L::transpose(rows).into_iter().zip(turned) {
                ray.store(std::ptr::from_mut(turned).cast());
            }
        }
    }
}

/// Where a ray enters the boxes of a node's children, and a mask of those that it hits, by the arithmetic of
/// [`RaySetup::boxes`](super::tree::RaySetup::boxes).
///
/// # Safety
/// The CPU must have the ISA; the slab must have been set up.
#[inline(always)]
unsafe fn boxes<S: Simd>(node: &Node, slab: &Slab) -> (S::F8, <S::F8 as Lanes>::Mask) {
    const SUM: [u32; 3] = [3 * ROW, 5 * ROW, 7 * ROW];
    const ROW: u32 = <Mbvh as Tree>::ROW;
    // SAFETY: forwarded; rows are those of the axes.
    unsafe {
        let near = |a: usize| {
            let planes = <Mbvh as Tree>::planes::<S>(node, a, slab.near[a]);
            planes.mul_add(S::F8::splat(slab.reciprocal[a]), S::F8::splat(slab.near_offset[a]))
        };
        let far = |a: usize| {
            let planes = <Mbvh as Tree>::planes::<S>(node, a, SUM[a] - slab.near[a]);
            planes.mul_add(S::F8::splat(slab.reciprocal[a]), S::F8::splat(slab.far_offset[a]))
        };
        let begin = near(0).max(near(1)).max(near(2).max(S::F8::splat(slab.tmin)));
        let end = far(0).min(far(1)).min(far(2).min(S::F8::splat(slab.limit)));
        (begin, begin.le(end))
    }
}

/// Keeps those rays of a list that hit the box of its child before what they have hit by now. Returns how many.
///
/// # Safety
/// The CPU must have the ISA; `entry` must have been pushed.
#[inline(always)]
unsafe fn keep_those_that_hit<S: Simd>(top: &Mbvh, entry: Entry, room: &mut Room) -> u32 {
    let mut kept = 0;
    // SAFETY: forwarded; the parent of a child is a node, and the numbers of a list are those of rays.
    unsafe {
        let node = Tree::node(top, entry.parent);
        let list = room.numbers.as_mut_ptr().add(entry.start as usize);
        for i in 0..entry.count as usize {
            let number = *list.add(i);
            let hits = boxes::<S>(node, room.slabs.get_unchecked(number as usize)).1.bits();
            *list.add(kept) = number;
            kept += (hits >> entry.lane & 1) as usize;
        }
    }
    kept as u32
}

/// Tests the rays of a list against the children of a node, and pushes those that any ray hits. Returns how many.
///
/// # Safety
/// The CPU must have the ISA; `entry` must be of a node of the tree, and `stack` have room for eight entries.
#[inline(always)]
unsafe fn visit_node<S: Simd>(top: &Mbvh, entry: Entry, room: &mut Room, stack: *mut Entry) -> usize {
    let (start, count) = (entry.start as usize, entry.count as usize);
    // SAFETY: forwarded. A list's numbers are those of rays, and the list lies within `numbers`. There are as many masks
    // as rays, rounded up to 32, and more.
    unsafe {
        let node = Tree::node(top, entry.child);
        let (zero, one) = (S::F8::splat(0.0), S::F8::splat(1.0));
        let (mut sums, mut counts, mut met) = (zero, zero, 0);
        for i in 0..count {
            let number = *room.numbers.get_unchecked(start + i) as usize;
            let (near, mask) = boxes::<S>(node, room.slabs.get_unchecked(number));
            sums = sums + S::F8::select(mask, near, zero);
            counts = counts + S::F8::select(mask, one, zero);
            let bits = mask.bits();
            *room.masks.get_unchecked_mut(i) = bits as u8;
            met |= bits;
        }
        if met == 0 {
            return 0;
        }
        // What `pick` reads beyond the masks.
        room.masks.as_mut_ptr().add(count).cast::<[u8; 32]>().write_unaligned([0; 32]);
        let mut end = start + count;
        // `pick` reads and writes up to 31 numbers beyond a list.
        if end + met.count_ones() as usize * count + 32 > room.numbers.len() {
            room.has_ended = true;
            for place in start..end {
                let number = room.numbers[place];
                if std::mem::replace(&mut room.slabs[number as usize].limit, f32::NEG_INFINITY) != f32::NEG_INFINITY {
                    room.alone.push(number);
                }
            }
            return 0;
        }
        let means = sums.div(counts).to_array();
        let (mut order, mut found) = ([0; WIDTH], 0);
        while met != 0 {
            let lane = met.trailing_zeros();
            met &= met - 1;
            // Far children first.
            let mut place = found;
            while place > 0 && means[order[place - 1] as usize] < means[lane as usize] {
                order[place] = order[place - 1];
                place -= 1;
            }
            order[place] = lane;
            found += 1;
        }
        for (i, &lane) in order[..found].iter().enumerate() {
            let numbers = room.numbers.as_mut_ptr();
            let picked = S::pick(room.masks.as_ptr(), numbers.add(start), count, lane, numbers.add(end));
            let child = node.children[lane as usize];
            stack.add(i).write(Entry { child, start: end as u32, count: picked as u32, parent: entry.child, lane });
            end += picked;
        }
        found
    }
}
