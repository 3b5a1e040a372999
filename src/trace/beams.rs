//! Beams: rays of a [stream](super::stream) to any hit that go the same way, as shadow rays of a tile to a lamp do,
//! pass the tree in packs of sixteen (packets of shadow rays: Wald et al., *Interactive Rendering with Coherent Ray
//! Tracing*, 2001; what encloses them: Haines and Wallace, *Shaft Culling for Efficient Ray-Cast Radiosity*, 1991).
//!
//! ```text
//! push (root, the packs of an octant)
//! while (child, packs) is popped, without the packs whose rays all have their hit:
//!     node:  test the shaft around each pack against the eight children;
//!            for each child that any meets, from least to most worth: push (child, packs that meet it)
//!     leaf:  for each pack, find the rays that hit the leaf's box, and test them against one triangle after another
//! ```
//!
//! A shaft encloses the ways of a pack's rays, from origins to ends. All go the same way along each axis. So what
//! bounds them, at a fraction of the way, are straight lines from the outermost origin to the outermost end, and they
//! are in a box from where the leading line enters it to where the trailing one leaves it: the test of a ray, whose
//! slopes are others for near planes and for far ones. A pack costs at a node what a ray costs in a list.
//!
//! Answers are those of [`single`](super::single), bit for bit. A triangle counts for rays that hit the box of its leaf
//! by the arithmetic of single rays. As rounding is monotonic, such rays hit all boxes around it; and so does the
//! shaft, since it is wider than its rays by more than rounding ([`MARGIN`]).

use super::Ray;
use super::groups::{ChildBoxes, Group};
use super::tree::{BEYOND, EPSILON, FARTHEST_ORIGIN, OFFSET_ERROR, Tree, beyond};
use super::triangle::{GRAZING, Projected, Shear, V3, accurate_distance};
use crate::bvh::Mbvh;
use crate::bvh::layout::{ChildRef, STACK_SIZE};
use crate::simd::{Eight, Lanes, Mask, Simd};
use bytemuck::Zeroable;
use std::array::from_fn;
use std::mem::MaybeUninit;

/// Number of rays of a pack.
pub(super) const SIZE: usize = 16;

/// Number of packs that go down the tree together.
pub(super) const PACKS: usize = 32;

/// By how much a shaft is wider than its rays, as a part of the largest coordinate: more than the errors of a ray's
/// test of a plane ([`OFFSET_ERROR`], and the rounding of its fused sum) and of a shaft's test.
const MARGIN: f32 = 32.0 * EPSILON;

/// Greatest extent of a pack's origins and ends, as a fraction of its length, at which it is worth a shaft.
const WIDEST: f32 = 1.0;

/// Number of leaves after which a pack's trial ends, and the number of rays per test of a leaf that must have hit its box
/// until then and from then on. (Against 4 leaves and two rays per test, for all packs of a group together: rays to a
/// lamp are 1.1 to 1.55 times as fast, those to a light of four times the tile's size 1.0 to 1.3 times; without
/// the trial the latter have 0.03 to 0.21 times the speed.)
const TRIAL: u32 = 16;
const LEAST_MET: u32 = 1;

/// A value per ray.
type Column = [f32; SIZE];

/// The rays of a pack.
#[derive(Clone, Copy, Zeroable)]
#[repr(C, align(64))]
pub(super) struct Pack {
    /// Origin, tmin, direction and tmax, as in [`Ray`].
    ray: [Column; 8],
    /// As in [`RaySetup`](super::tree::RaySetup).
    reciprocal: [Column; 3],
    near_offset: [Column; 3],
    far_offset: [Column; 3],
    /// Conservative tmax.
    limit: Column,
    /// As in [`Shear`].
    shear: [Column; 2],
    axes: [u32; 3],
    /// Rays that have no hit yet.
    left: u32,
    /// Number of tests against leaves, and of rays that hit their boxes.
    tests: u32,
    met: u32,
}

/// What encloses the rays of a pack: the fraction of the way at which a line is in a plane is reciprocal · plane +
/// offset.
#[derive(Clone, Copy, Zeroable)]
#[repr(C, align(64))]
pub(super) struct Shaft {
    near_reciprocal: [f32; 3],
    near_offset: [f32; 3],
    far_reciprocal: [f32; 3],
    far_offset: [f32; 3],
    /// Which rays of the group these are.
    first: u32,
    count: u32,
    axis: u32,
    unused: u32,
}

/// A child that waits for its visit, the packs that meet its box, and where its planes are.
#[derive(Clone, Copy)]
struct Entry {
    child: ChildRef,
    packs: u32,
    parent: ChildRef,
    lane: u32,
}

/// Traces the rays of a group to any hit in packs, as far as that is worth it. `order` has the numbers of the group's
/// rays; `done` receives them, and whether these rays hit anything. The rays of packs that were given up without a hit
/// stay in the group.
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
pub(super) unsafe fn trace<S: Simd>(
    tree: &Mbvh,
    root: ChildRef,
    group: &mut Group,
    rays: &[Ray],
    order: &mut [u16],
    shafts: &mut [Shaft],
    packs: &mut [Pack],
    mut done: impl FnMut(usize, bool),
) {
    let (mut count, mut narrow) = (0, 0);
    // SAFETY: forwarded.
    let exit = unsafe { Exit::<S>::new(tree, group.octant) };
    for axis in 0..3 {
        for first in (group.runs[axis]..group.runs[axis + 1]).step_by(SIZE) {
            let places = first..group.runs[axis + 1].min(first + SIZE);
            let length = places.len() as u32;
            let pack = order[places].iter().map(|&number| &rays[number as usize]);
            // SAFETY: forwarded.
            let Some((shaft, is_narrow)) = (unsafe { Shaft::new::<S>(pack, group.octant, &exit) }) else {
                return;
            };
            shafts[count] = Shaft { first: first as u32, count: length, axis: axis as u32, ..shaft };
            count += 1;
            narrow += usize::from(is_narrow);
        }
    }
    if 4 * narrow < 3 * count {
        return;
    }
    // (The group's rays lie in the order of the packs, and so those that are kept move to places that have been read.)
    let mut kept = [0; 3];
    let mut place = 0;
    for shafts in shafts[..count].chunks(PACKS) {
        // (All are loaded before any is set up: what has just been stored in halves is slow to load.)
        for (pack, shaft) in packs.iter_mut().zip(shafts) {
            let ray = |i: usize| &rays[order[(shaft.first + (i as u32).min(shaft.count - 1)) as usize] as usize];
            // SAFETY: forwarded.
            unsafe { pack.load::<S>(ray) };
        }
        for (pack, shaft) in packs.iter_mut().zip(shafts) {
            // SAFETY: forwarded.
            unsafe { pack.set_up::<S>(group.axes(shaft.axis as usize), shaft.count) };
        }
        // SAFETY: forwarded.
        let given_up = unsafe { Traversal { tree, shafts, packs: &mut *packs, octant: group.octant }.run::<S>(root) };
        for (i, (pack, shaft)) in packs.iter().zip(shafts).enumerate() {
            let is_given_up = given_up >> i & 1 != 0;
            for i in 0..shaft.count {
                let (number, is_hit) = (order[(shaft.first + i) as usize], pack.left >> i & 1 == 0);
                if is_hit || !is_given_up {
                    done(number as usize, is_hit);
                } else {
                    order[place] = number;
                    place += 1;
                    kept[shaft.axis as usize] += 1;
                }
            }
        }
    }
    group.runs = [0, kept[0], kept[0] + kept[1], place];
}

/// Where rays of an octant leave the scene: what bounds rays to infinity, as those to a sun.
struct Exit<S: Simd> {
    /// The last planes that such rays reach, by axis.
    far: S::F4,
    /// Signs of the directions.
    sign: S::F4,
    /// What planes are moved outwards by.
    margin: S::F4,
}

impl<S: Simd> Exit<S> {
    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    unsafe fn new(tree: &Mbvh, octant: usize) -> Self {
        let (lower, upper) = tree.bounds();
        let most = lower.abs().max(upper.abs()).max_element();
        let of = |up: [f32; 3], down: [f32; 3]| {
            let [x, y, z] = from_fn(|a| if octant >> a & 1 != 0 { down[a] } else { up[a] });
            // SAFETY: four floats are read. The caller vouches for the ISA.
            unsafe { S::F4::load([x, y, z, 0.0].as_ptr()) }
        };
        let (far, sign) = (of(upper.into(), lower.into()), of([1.0; 3], [-1.0; 3]));
        // SAFETY: the caller vouches for the ISA.
        Exit { far, sign, margin: unsafe { S::F4::splat(MARGIN * most) } }
    }

    /// The distance at which a ray has left the scene, by more than rounding.
    ///
    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    unsafe fn distance(&self, origin: S::F4, direction: S::F4) -> f32 {
        // SAFETY: the caller vouches for the ISA.
        let (zero, margin) = unsafe { (S::F4::splat(0.0), S::F4::splat(MARGIN)) };
        let way = ((self.far - origin) * self.sign).max(zero) + self.margin + margin * origin.max(zero - origin);
        let t = way.div(direction * self.sign).to_array();
        t[0].min(t[1]).min(t[2])
    }
}

impl Shaft {
    /// The shaft around rays of an octant, and whether it is narrow; `None` if there cannot be one.
    ///
    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    unsafe fn new<'a, S: Simd>(
        rays: impl Iterator<Item = &'a Ray>,
        octant: usize,
        exit: &Exit<S>,
    ) -> Option<(Shaft, bool)> {
        // SAFETY: the caller vouches for the ISA; a ray is eight floats.
        unsafe {
            let splat = |x: f32| S::F4::splat(x);
            let (zero, one, infinite) = (splat(0.0), splat(1.0), splat(f32::INFINITY));
            let [mut first_low, mut last_low] = [infinite; 2];
            let [mut first_high, mut last_high] = [zero - infinite; 2];
            for ray in rays {
                let p = std::ptr::from_ref(ray).cast::<f32>();
                let (first, direction) = (S::F4::load(p), S::F4::load(p.add(4)));
                let end = if ray.tmax == f32::INFINITY { exit.distance(first, direction) } else { beyond(ray.tmax) };
                let last = direction.mul_add(splat(end), first);
                (first_low, first_high) = (first_low.min(first), first_high.max(first));
                (last_low, last_high) = (last_low.min(last), last_high.max(last));
            }
            let most = first_high.max(zero - first_low).max(last_high.max(zero - last_low));
            // The fourth of the lanes is tmin.
            if most.le(splat(FARTHEST_ORIGIN)).bits() & 7 != 7 || first_low.to_array()[3] < 0.0 {
                return None;
            }
            // (Not less than any number: rays close to 0 that go along the other axes.)
            let margin = (splat(MARGIN) * most).max(splat(1e-30));
            let lines = |near: [S::F4; 2], far: [S::F4; 2]| {
                let (near_reciprocal, far_reciprocal) = (one.div(near[1] - near[0]), one.div(far[1] - far[0]));
                [near_reciprocal, zero - near[0] * near_reciprocal, far_reciprocal, zero - far[0] * far_reciprocal]
                    .map(|line| line.to_array())
            };
            // Of rays that ascend and that descend. Lines do so too, whatever rounding does: by a margin at least.
            let up = lines(
                [first_high + margin, last_high + margin + margin],
                [first_low - margin - margin, last_low - margin],
            );
            let down = lines(
                [first_low - margin, last_low - margin - margin],
                [first_high + margin + margin, last_high + margin],
            );
            let row = |row: usize| from_fn(|a| if octant >> a & 1 != 0 { down[row][a] } else { up[row][a] });
            let sum = |v: S::F4| {
                let [x, y, z] = from_fn(|a| v.to_array()[a]);
                x + y + z
            };
            let way = last_low + last_high - first_low - first_high;
            let length = 0.5 * sum(way.max(zero - way));
            let extent = sum((first_high - first_low) + (last_high - last_low));
            let shaft = Shaft {
                near_reciprocal: row(0),
                near_offset: row(1),
                far_reciprocal: row(2),
                far_offset: row(3),
                ..Shaft::zeroed()
            };
            Some((shaft, extent <= WIDEST * length))
        }
    }

    /// Mask of the boxes that the shaft meets.
    ///
    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    unsafe fn meets<L: Lanes>(&self, boxes: &ChildBoxes<L>) -> L::Mask {
        // SAFETY: the caller vouches for the ISA.
        let splat = |x: f32| unsafe { L::splat(x) };
        let near = |a: usize| boxes.near[a].mul_add(splat(self.near_reciprocal[a]), splat(self.near_offset[a]));
        let far = |a: usize| boxes.far[a].mul_add(splat(self.far_reciprocal[a]), splat(self.far_offset[a]));
        let first = near(0).max(near(1)).max(near(2).max(splat(0.0)));
        let last = far(0).min(far(1)).min(far(2).min(splat(1.0)));
        first.le(last)
    }
}

impl Pack {
    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    unsafe fn load<'a, S: Simd>(&mut self, ray: impl Fn(usize) -> &'a Ray) {
        for first in (0..SIZE).step_by(8) {
            // SAFETY: a ray is eight floats, and columns have room for twice eight. The caller vouches for the ISA.
            unsafe {
                let load = |i: usize| S::F8::load(std::ptr::from_ref(ray(first + i)).cast::<f32>());
                let rows = [load(0), load(1), load(2), load(3), load(4), load(5), load(6), load(7)];
                for (column, lanes) in self.ray.iter_mut().zip(S::F8::transpose(rows)) {
                    lanes.store(column.as_mut_ptr().add(first));
                }
            }
        }
    }

    /// Sets up the rays with the arithmetic of [`RaySetup::new`](super::tree::RaySetup::new) and [`Shear::new`].
    ///
    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    unsafe fn set_up<S: Simd>(&mut self, axes: &[u32; 3], count: u32) {
        (self.axes, self.left) = (*axes, (1 << count) - 1);
        (self.tests, self.met) = (0, 0);
        let [i, j, k] = axes.map(|a| 4 + a as usize);
        for first in (0..SIZE).step_by(S::Packet::WIDTH) {
            // SAFETY: columns have a multiple of the lanes. The caller vouches for the ISA.
            unsafe {
                let splat = |x: f32| S::Packet::splat(x);
                let abs = |x: S::Packet| x.max(splat(0.0) - x);
                for a in 0..3 {
                    let reciprocal = splat(1.0).div(at(&self.ray[4 + a], first));
                    let offset = splat(-1.0) * at::<S::Packet>(&self.ray[a], first) * reciprocal;
                    let error = splat(OFFSET_ERROR) * abs(offset);
                    put(&mut self.reciprocal[a], first, reciprocal);
                    put(&mut self.near_offset[a], first, offset - error);
                    put(&mut self.far_offset[a], first, offset + error);
                }
                let tmax: S::Packet = at(&self.ray[7], first);
                put(&mut self.limit, first, tmax + splat(BEYOND) * abs(tmax));
                let inverse = splat(-1.0).div(at(&self.ray[k], first));
                put(&mut self.shear[0], first, at::<S::Packet>(&self.ray[i], first) * inverse);
                put(&mut self.shear[1], first, at::<S::Packet>(&self.ray[j], first) * inverse);
            }
        }
    }

    /// Tests as many rays as there are lanes, from `first` on, against the box of a leaf, given by its near and far
    /// planes, and against its triangles. Returns how many of those that have no hit yet hit the box.
    ///
    /// # Safety
    /// The CPU must have the ISA; `rows` must be those of a leaf of `count` triangles.
    #[inline(always)]
    unsafe fn test<S: Simd>(&mut self, first: usize, planes: &[[f32; 2]; 3], rows: *const f32, count: usize) -> u32 {
        // SAFETY: the caller vouches for the ISA and the leaf; rows are `count` apart.
        unsafe {
            let splat = |x: f32| S::Packet::splat(x);
            let axis = |a: usize| {
                let reciprocal = at(&self.reciprocal[a], first);
                (
                    splat(planes[a][0]).mul_add(reciprocal, at(&self.near_offset[a], first)),
                    splat(planes[a][1]).mul_add(reciprocal, at(&self.far_offset[a], first)),
                )
            };
            let ((nx, fx), (ny, fy), (nz, fz)) = (axis(0), axis(1), axis(2));
            let near = nx.max(ny).max(nz.max(at(&self.ray[3], first)));
            let far = fx.min(fy).min(fz.min(at(&self.limit, first)));
            let mut open = near.le(far).bits() & self.left >> first;
            if open == 0 {
                return 0;
            }
            let met = open.count_ones();
            let [i, j, k] = self.axes.map(|a| a as usize);
            let (x, y, z): (S::Packet, S::Packet, S::Packet) =
                (at(&self.ray[i], first), at(&self.ray[j], first), at(&self.ray[k], first));
            let shear = [at(&self.shear[0], first), at(&self.shear[1], first)];
            for triangle in 0..count {
                let corner = |c: usize| {
                    let row = |a: usize| splat(rows.add(triangle + (3 * c + a) * count).read());
                    V3 { x: x - row(i), y: y - row(j), z: z - row(k) }
                };
                let seen = Projected::new([corner(0), corner(1), corner(2)], shear);
                let candidates = seen.inside().bits() & open;
                if candidates == 0 {
                    continue;
                }
                let hits = self.hits::<S>(first, rows, count, triangle, &seen, candidates);
                self.left &= !(hits << first);
                open &= !hits;
                if open == 0 {
                    break;
                }
            }
            met
        }
    }

    /// Which of the candidates, counted from `first` on, hit a triangle within their range.
    ///
    /// # Safety
    /// As for `test`; `triangle` must be below the count.
    #[inline(always)]
    unsafe fn hits<S: Simd>(
        &self,
        first: usize,
        rows: *const f32,
        count: usize,
        triangle: usize,
        seen: &Projected<S::Packet>,
        candidates: u32,
    ) -> u32 {
        // SAFETY: the caller vouches for the ISA and the triangle.
        unsafe {
            let zero = S::Packet::splat(0.0);
            let abs = |x: S::Packet| x.max(zero - x);
            let direction: [S::Packet; 3] = from_fn(|a| at(&self.ray[4 + a], first));
            let back = |a: usize| zero - direction[self.axes[a] as usize];
            let back = V3 { x: back(0), y: back(1), z: back(2) };
            let [x, y, z] = direction.map(abs);
            let (t, is_accurate) = seen.distances_along(back, S::Packet::splat(GRAZING) * (x + y + z));
            let [tmin, tmax]: [S::Packet; 2] = [at(&self.ray[3], first), at(&self.ray[7], first)];
            let accurate = is_accurate.bits();
            let hits = candidates & accurate & tmin.lt(t).and(t.le(tmax)).bits();
            let inaccurate = candidates & !accurate;
            if inaccurate == 0 {
                return hits;
            }
            // If all weights vanish, the ray lies in the plane.
            let inaccurate = inaccurate & zero.lt(abs(seen.u + seen.v + seen.w)).bits();
            // Distances in f64 are slow, and mostly the corners tell enough.
            let (within, outside) = seen.depths(back.z, tmin, tmax);
            let mut hits = hits | inaccurate & within.bits();
            let mut unknown = inaccurate & !within.bits() & !outside.bits();
            while unknown != 0 {
                let lane = unknown.trailing_zeros() as usize;
                unknown &= unknown - 1;
                let ray = |c: usize| self.ray[c][first + lane];
                let shear = Shear::new([ray(0), ray(1), ray(2)], [ray(4), ray(5), ray(6)]);
                let t = accurate_distance(rows, count, triangle, &shear);
                hits |= u32::from(ray(3) < t && t <= ray(7)) << lane;
            }
            hits
        }
    }
}

/// Lanes of a column, from `first` on.
///
/// # Safety
/// The CPU must have the ISA, and the column as many values from there.
#[inline(always)]
unsafe fn at<L: Lanes>(column: &Column, first: usize) -> L {
    // SAFETY: forwarded.
    unsafe { L::load(column.as_ptr().add(first)) }
}

/// Writes lanes to a column, from `first` on.
///
/// # Safety
/// The column must have as many values from there.
#[inline(always)]
unsafe fn put<L: Lanes>(column: &mut Column, first: usize, lanes: L) {
    // SAFETY: forwarded.
    unsafe { lanes.store(column.as_mut_ptr().add(first)) }
}

/// The traversal of up to [`PACKS`] packs of an octant.
struct Traversal<'a> {
    tree: &'a Mbvh,
    shafts: &'a [Shaft],
    packs: &'a mut [Pack],
    octant: usize,
}

impl Traversal<'_> {
    /// Returns the packs that were given up: too few of their rays hit the leaves that their shafts meet.
    ///
    /// # Safety
    /// The CPU must have the ISA, and as many packs as there are shafts must have been set up.
    #[inline(always)]
    unsafe fn run<S: Simd>(&mut self, root: ChildRef) -> u32 {
        let mut given_up = 0;
        let mut stack = [const { MaybeUninit::<Entry>::uninit() }; STACK_SIZE];
        let mut left = u32::MAX >> (PACKS - self.shafts.len());
        stack[0].write(Entry { child: root, packs: left, parent: root, lane: 0 });
        let mut depth = 1;
        while depth > 0 {
            depth -= 1;
            // SAFETY: entries below `depth` have been written; children of the tree are its nodes and leaves; the
            // builder bounds the tree's depth so that there is room on the stack (see `STACK_SIZE`).
            unsafe {
                let mut entry = stack.get_unchecked(depth).assume_init();
                entry.packs &= left;
                if entry.packs == 0 {
                    continue;
                }
                if entry.child.is_leaf() {
                    let (finished, useless) = self.visit_leaf::<S>(entry);
                    left &= !finished & !useless;
                    given_up |= useless;
                } else {
                    depth += self.visit_node::<S>(entry, stack.as_mut_ptr().add(depth).cast());
                }
            }
        }
        given_up
    }

    /// Tests packs against the children of a node, and pushes those that any meets. Returns how many.
    ///
    /// # Safety
    /// The CPU must have the ISA; `entry` must be of a node of the tree, and `stack` have room for eight entries.
    #[inline(always)]
    unsafe fn visit_node<S: Simd>(&self, entry: Entry, stack: *mut Entry) -> usize {
        // SAFETY: forwarded; packs are below the number of shafts, which is up to that of masks.
        unsafe {
            let node = self.tree.node(entry.child);
            let boxes = ChildBoxes::new::<S, Mbvh>(node, self.octant);
            let mut masks = [0u8; PACKS];
            let (mut met, mut packs) = (0, entry.packs);
            while packs != 0 {
                let pack = packs.trailing_zeros() as usize;
                packs &= packs - 1;
                let bits = self.shafts.get_unchecked(pack).meets(&boxes).bits();
                *masks.get_unchecked_mut(pack) = bits as u8;
                met |= bits;
            }
            let name = |lane: u32| *node.children.get_unchecked(lane as usize);
            let mut children = met;
            while children != 0 {
                self.tree.prefetch_whole(name(children.trailing_zeros()));
                children &= children - 1;
            }
            let mut pushed = 0;
            while met != 0 {
                let lane = met.trailing_zeros();
                met &= met - 1;
                let packs = S::column(&masks, lane);
                stack.add(pushed).write(Entry { child: name(lane), packs, parent: entry.child, lane });
                pushed += 1;
            }
            pushed
        }
    }

    /// Tests packs against a leaf. Returns those whose rays all have their hit, and those that are given up.
    ///
    /// # Safety
    /// The CPU must have the ISA; `entry` must be of a leaf of the tree.
    #[inline(always)]
    unsafe fn visit_leaf<S: Simd>(&mut self, entry: Entry) -> (u32, u32) {
        // SAFETY: forwarded; packs are below the number of those that were set up.
        unsafe {
            let (rows, count) = (self.tree.leaf(entry.child), entry.child.leaf_count());
            let (node, lane) = (self.tree.node(entry.parent), entry.lane as usize);
            let planes = from_fn(|a| {
                let [lower, upper] = [*node.lower[a].get_unchecked(lane), *node.upper[a].get_unchecked(lane)];
                if self.octant >> a & 1 != 0 { [upper, lower] } else { [lower, upper] }
            });
            let (mut packs, mut finished, mut useless) = (entry.packs, 0, 0);
            while packs != 0 {
                let number = packs.trailing_zeros();
                packs &= packs - 1;
                let pack = self.packs.get_unchecked_mut(number as usize);
                pack.tests += 1;
                for first in (0..SIZE).step_by(S::Packet::WIDTH) {
                    pack.met += pack.test::<S>(first, &planes, rows, count);
                }
                finished |= u32::from(pack.left == 0) << number;
                useless |= u32::from(pack.tests > TRIAL && pack.met < LEAST_MET * pack.tests) << number;
            }
            (finished, useless & !finished)
        }
    }
}
