//! Rays of a [stream](super::stream), prepared for its tests: sorted by octant and by the longest axis of their
//! directions, then set up eight at a time.

use super::beams;
use super::groups::{ChildBoxes, Group};
use super::ray_keys::{SPECIAL, is_uniform, keys_of};
use super::tree::{BEYOND, OFFSET_ERROR};
use super::triangle::{GRAZING, Shear, barycentrics};
use super::{RawHit, Ray};
use crate::base::geometry::NONE;
use crate::simd::{Eight, Lanes, Simd};
use bytemuck::Zeroable;
use std::cell::Cell;
use std::ops::Range;

/// Maximum number of rays in a stream. The data of an octant's rays should stay in the L2 cache.
pub(super) const MAX_RAYS: usize = 4096;

/// Room for numbers in lists. (Tiles in Sponza take up to some 20,000.)
const NUMBERS: usize = 1 << 16;

/// What the box test reads of a ray: see [`RaySetup`](super::tree::RaySetup).
#[derive(Clone, Copy, Zeroable)]
#[repr(C, align(64))]
pub(super) struct Slab {
    reciprocal: [f32; 3],
    near_offset: [f32; 3],
    far_offset: [f32; 3],
    tmin: f32,
    /// Conservative tmax: boxes that begin behind it are not hit; −∞ for rays that shall hit no box any more.
    pub limit: f32,
    unused: [f32; 5],
}

/// What the triangle test reads of a ray, and its closest hit: see [`Shear`] and [`Best`](super::single::Best).
#[derive(Clone, Copy, Zeroable)]
#[repr(C, align(64))]
pub(super) struct Target {
    origin: [f32; 3],
    shear_x: f32,
    back: [f32; 3],
    shear_y: f32,
    grazing: f32,
    pub tmin: f32,
    /// Distance of the closest hit so far.
    pub t: f32,
    /// Whether the ray is traced by itself.
    pub is_alone: u32,
    pub triangle: u32,
    pub u: f32,
    pub v: f32,
    pub sum: f32,
}

impl Target {
    /// The ray in its own frame.
    pub(super) fn shear(&self, axes: &[u32; 3]) -> Shear {
        Shear {
            axes: *axes,
            origin: self.origin,
            back: self.back,
            shear: [self.shear_x, self.shear_y],
            grazing: self.grazing,
        }
    }
}

impl<L: Lanes> ChildBoxes<L> {
    /// Mask of the boxes that a ray intersects, by the arithmetic of [`RaySetup::boxes`](super::tree::RaySetup::boxes).
    ///
    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    pub(super) unsafe fn hits(&self, ray: &Slab) -> L::Mask {
        // SAFETY: the caller vouches for the ISA.
        unsafe {
            let [rx, ry, rz] = [L::splat(ray.reciprocal[0]), L::splat(ray.reciprocal[1]), L::splat(ray.reciprocal[2])];
            let nx = self.near[0].mul_add(rx, L::splat(ray.near_offset[0]));
            let ny = self.near[1].mul_add(ry, L::splat(ray.near_offset[1]));
            let nz = self.near[2].mul_add(rz, L::splat(ray.near_offset[2]));
            let fx = self.far[0].mul_add(rx, L::splat(ray.far_offset[0]));
            let fy = self.far[1].mul_add(ry, L::splat(ray.far_offset[1]));
            let fz = self.far[2].mul_add(rz, L::splat(ray.far_offset[2]));
            let near = nx.max(ny).max(nz.max(L::splat(ray.tmin)));
            let far = fx.min(fy).min(fz.min(L::splat(ray.limit)));
            near.le(far)
        }
    }
}

/// Working memory of streams: 0.7 MB per thread that traces any.
pub(super) struct Room {
    /// Keys of the rays: 3 · octant + axis, or [`SPECIAL`].
    pub keys: Vec<u8>,
    /// Numbers of the rays, by key.
    pub order: Vec<u16>,
    /// Rays of a group.
    pub slabs: Vec<Slab>,
    pub targets: Vec<Target>,
    /// Room of rays in packs, and the numbers of those that are left.
    pub beams: beams::Room,
    pub rest: Vec<u16>,
    /// Boxes that the rays of a list hit, bit i for child i.
    pub masks: Vec<u8>,
    /// Lists of numbers of rays within the group.
    pub numbers: Vec<u16>,
    /// Numbers of rays that are traced one by one.
    pub alone: Vec<u16>,
}

thread_local! {
    static ROOM: Cell<Option<Box<Room>>> = const { Cell::new(None) };
}

/// A vector of `count` zeros; `None` if there is not enough memory.
fn zeros<T: Zeroable + Clone>(count: usize) -> Option<Vec<T>> {
    let mut v = Vec::new();
    v.try_reserve_exact(count).ok()?;
    v.resize(count, T::zeroed());
    Some(v)
}

fn emptied(mut v: Vec<u16>) -> Vec<u16> {
    v.clear();
    v
}

impl Room {
    /// Takes the thread's memory; `None` if there is not enough.
    #[inline(never)]
    pub(super) fn take() -> Option<Box<Room>> {
        if let Some(room) = ROOM.try_with(Cell::take).ok().flatten() {
            return Some(room);
        }
        Some(Box::new(Room {
            keys: zeros(MAX_RAYS)?,
            order: zeros(MAX_RAYS + 8)?,
            slabs: zeros(MAX_RAYS)?,
            targets: zeros(MAX_RAYS)?,
            beams: beams::Room { shafts: zeros(beams::PACKS)?, packs: zeros(beams::PACKS)?, waiting: zeros(SPECIAL)? },
            rest: emptied(zeros(MAX_RAYS)?),
            masks: zeros(MAX_RAYS + 64)?,
            numbers: zeros(NUMBERS)?,
            alone: emptied(zeros(MAX_RAYS)?),
        }))
    }

    #[inline(never)]
    pub(super) fn give_back(self: Box<Self>) {
        let _ = ROOM.try_with(|kept| kept.set(Some(self)));
    }

    /// Leaves the rays at some places of the order to be traced one by one.
    pub(super) fn leave_alone(&mut self, places: Range<usize>) {
        self.alone.extend_from_slice(&self.order[places]);
    }

    /// Sets up the rays of a group, with the arithmetic of [`RaySetup::new`](super::tree::RaySetup::new) and
    /// [`Shear::new`].
    ///
    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    pub(super) unsafe fn set_up<S: Simd>(&mut self, rays: &[Ray], group: &Group) {
        for axis in 0..3 {
            let axes = group.axes(axis).map(|a| a as usize);
            for first in (group.runs[axis]..group.runs[axis + 1]).step_by(8) {
                let count = (group.runs[axis + 1] - first).min(8);
                // The last ray takes the places of those beyond the run.
                let ray = |i: usize| {
                    let number = self.order[group.begin + first + i.min(count - 1)];
                    std::ptr::from_ref(&rays[number as usize]).cast::<f32>()
                };
                // SAFETY: a ray is eight floats. The caller vouches for the ISA.
                let (slabs, targets) = unsafe {
                    let load = |i: usize| S::F8::load(ray(i));
                    let rows = [load(0), load(1), load(2), load(3), load(4), load(5), load(6), load(7)];
                    set_up::<S::F8>(rows, axes)
                };
                for i in 0..count {
                    let (slab, target) = (&mut self.slabs[first + i], &mut self.targets[first + i]);
                    // SAFETY: each is sixteen floats.
                    unsafe {
                        for half in 0..2 {
                            slabs[half][i].store(std::ptr::from_mut(slab).cast::<f32>().add(8 * half));
                            targets[half][i].store(std::ptr::from_mut(target).cast::<f32>().add(8 * half));
                        }
                    }
                    (target.is_alone, target.triangle) = (0, NONE);
                }
            }
        }
    }

    /// Passes the hits of a group's rays on, with the rays' numbers. `ANY`: a hit says only that there is one.
    #[inline(always)]
    pub(super) fn report<const ANY: bool>(&self, group: &Group, mut done: impl FnMut(usize, RawHit)) {
        for (target, &number) in self.targets.iter().zip(&self.order[group.begin..group.end()]) {
            if target.is_alone != 0 {
                continue;
            }
            let hit = if target.triangle == NONE {
                RawHit::MISS
            } else {
                let (u, v) = barycentrics(target.u, target.v, target.sum);
                RawHit { t: target.t, u, v, triangle: target.triangle, front: target.sum > 0.0 }
            };
            done(number as usize, hit);
        }
    }
}

/// Sorts rays by key: fills in `order`. Returns where the rays of each key begin, and at the end the number of rays.
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
pub(super) unsafe fn sort<S: Simd>(rays: &[Ray], room: &mut Room) -> [usize; SPECIAL + 2] {
    let mut counts = [0usize; SPECIAL + 1];
    for (rays, keys) in rays.chunks(8).zip(room.keys.chunks_exact_mut(8)) {
        let ray = |i: usize| std::ptr::from_ref(&rays[i.min(rays.len() - 1)]).cast::<f32>();
        // SAFETY: a ray is eight floats. The caller vouches for the ISA.
        let found = unsafe {
            let load = |i: usize| S::F8::load(ray(i));
            let rows = [load(0), load(1), load(2), load(3), load(4), load(5), load(6), load(7)];
            keys_of::<S::F8>(S::F8::transpose(rows))
        };
        keys.copy_from_slice(&found);
        match is_uniform(found) {
            true => counts[found[0] as usize] += rays.len(),
            false => found.iter().take(rays.len()).for_each(|&key| counts[key as usize] += 1),
        }
    }
    let mut starts = [0; SPECIAL + 2];
    for key in 0..=SPECIAL {
        starts[key + 1] = starts[key] + counts[key];
    }
    let mut next = starts;
    for (i, keys) in room.keys[..rays.len()].chunks(8).enumerate() {
        let numbers = (8 * i as u16..).take(keys.len());
        if keys.try_into().is_ok_and(is_uniform) {
            let place = &mut next[keys[0] as usize];
            room.order[*place..*place + 8].iter_mut().zip(numbers).for_each(|(order, number)| *order = number);
            *place += 8;
            continue;
        }
        for (&key, number) in keys.iter().zip(numbers) {
            let place = &mut next[key as usize];
            room.order[*place] = number;
            *place += 1;
        }
    }
    starts
}

/// Sorts what beams have left of the rays by their keys, as [`sort`] does.
pub(super) fn sort_rest(room: &mut Room) -> [usize; SPECIAL + 2] {
    let mut starts = [0; SPECIAL + 2];
    for &number in &room.rest {
        starts[room.keys[number as usize] as usize + 1] += 1;
    }
    for key in 0..=SPECIAL {
        starts[key + 1] += starts[key];
    }
    let mut next = starts;
    for &number in &room.rest {
        let place = &mut next[room.keys[number as usize] as usize];
        room.order[*place] = number;
        *place += 1;
    }
    room.rest.clear();
    starts
}

/// What the box test needs of rays: see [`RaySetup`](super::tree::RaySetup).
pub(super) struct Offsets<L> {
    pub reciprocal: [L; 3],
    pub near: [L; 3],
    pub far: [L; 3],
    /// Conservative tmax.
    pub limit: L,
}

/// Prepares rays for the box test, with the arithmetic of [`RaySetup::new`](super::tree::RaySetup::new).
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
pub(super) unsafe fn offsets<L: Lanes>(origin: [L; 3], direction: [L; 3], tmax: L) -> Offsets<L> {
    // SAFETY: the caller vouches for the ISA.
    let splat = |x: f32| unsafe { L::splat(x) };
    let (zero, one, minus) = (splat(0.0), splat(1.0), splat(-1.0));
    let abs = |x: L| x.max(zero - x);
    let [dx, dy, dz] = direction;
    let reciprocal = [one.div(dx), one.div(dy), one.div(dz)];
    let offset = |a: usize| minus * origin[a] * reciprocal[a];
    let offset = [offset(0), offset(1), offset(2)];
    let error = |a: usize| splat(OFFSET_ERROR) * abs(offset[a]);
    let error = [error(0), error(1), error(2)];
    Offsets {
        reciprocal,
        near: [offset[0] - error[0], offset[1] - error[1], offset[2] - error[2]],
        far: [offset[0] + error[0], offset[1] + error[1], offset[2] + error[2]],
        limit: tmax + splat(BEYOND) * abs(tmax),
    }
}

/// Slabs and targets of eight rays with the same [axes](Shear::axes), as halves of eight floats.
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
unsafe fn set_up<L: Eight>(rays: [L; 8], axes: [usize; 3]) -> ([[L; 8]; 2], [[L; 8]; 2]) {
    let [ox, oy, oz, tmin, dx, dy, dz, tmax] = L::transpose(rays);
    // SAFETY: the caller vouches for the ISA.
    let splat = |x: f32| unsafe { L::splat(x) };
    let (zero, one, minus) = (splat(0.0), splat(1.0), splat(-1.0));
    let abs = |x: L| x.max(zero - x);
    let (origin, direction) = ([ox, oy, oz], [dx, dy, dz]);
    // SAFETY: forwarded.
    let Offsets { reciprocal, near, far, limit } = unsafe { offsets(origin, direction, tmax) };
    let inverse = minus.div(direction[axes[2]]);
    let slabs = [
        L::transpose([reciprocal[0], reciprocal[1], reciprocal[2], near[0], near[1], near[2], far[0], far[1]]),
        L::transpose([far[2], tmin, limit, zero, zero, zero, zero, zero]),
    ];
    let targets = [
        L::transpose([
            origin[axes[0]],
            origin[axes[1]],
            origin[axes[2]],
            direction[axes[0]] * inverse,
            minus * direction[axes[0]],
            minus * direction[axes[1]],
            minus * direction[axes[2]],
            direction[axes[1]] * inverse,
        ]),
        L::transpose([splat(GRAZING) * (abs(dx) + abs(dy) + abs(dz)), tmin, tmax, zero, zero, zero, zero, one]),
    ];
    (slabs, targets)
}
