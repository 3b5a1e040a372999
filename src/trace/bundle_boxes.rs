//! [Bundles](super::packet) of rays from a pinhole through the tree over [instances](super::instances): its boxes are tested
//! against the frustum around all rays. At an instance, those rays that meet its box are transformed, and go through its
//! mesh together.

use super::box_lists::{MAX_RAYS, OnVisit, Room, Visit};
use super::bundle::{LEAST, bundle};
use super::packet::{self, AtLeaf, Bundle, Shared};
use super::tree::{Leaf, Tree, beyond};
use crate::bvh::ChildRef;
use crate::bvh::instances::Instances;
use crate::simd::{Lanes, Mask, Simd};
use std::mem::MaybeUninit;

/// Takes the first `count` rays that `room` has taken, nearly all of them in bundles, through the tree over instances. Calls
/// `visit` with each that any of them meets.
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
pub(super) unsafe fn trace<S: Simd>(instances: &Instances, count: usize, room: &mut Room, visit: OnVisit) {
    assert!(room.is_full() && count <= MAX_RAYS);
    room.alone.clear();
    room.has_ended = false;
    let mut start = 0;
    while start < count {
        // SAFETY: forwarded.
        let length = unsafe { bundle::<S>(&room.rays[start..count]) };
        if length < LEAST {
            let end = start + length.max(1);
            room.alone.extend(start as u16..end as u16);
            start = end;
            continue;
        }
        let rays = &room.rays[start..start + length];
        let beside = instances.margin.beside(rays[0].origin);
        let mut place = MaybeUninit::uninit();
        // SAFETY: the rays are a bundle. The caller vouches for the ISA.
        unsafe {
            let (rays, shared, frustum) = packet::begin::<S>(rays, beside, &mut place);
            let boxes = &mut Boxes { instances, room, start, end: start + length, visit };
            packet::walk::<S>(&instances.top, ChildRef::ROOT, rays, &shared, frustum, boxes);
        }
        start += length;
    }
}

/// Leaves that stand for instances.
struct Boxes<'a, 'b> {
    instances: &'a Instances,
    room: &'a mut Room,
    /// The bundle's rays in the room.
    start: usize,
    end: usize,
    visit: &'a mut (dyn FnMut(Visit) + 'b),
}

impl<S: Simd> AtLeaf<S> for Boxes<'_, '_> {
    #[inline(always)]
    unsafe fn visit(
        &mut self,
        rays: &mut Bundle,
        shared: &Shared,
        leaf: ChildRef,
        planes: &[[S::Packet; 2]; 3],
        first: usize,
    ) -> bool {
        let mut met = 0;
        for g in first..shared.groups {
            let from = self.start + g * S::Packet::WIDTH;
            // SAFETY: one of the bundle's groups. The caller vouches for the ISA.
            let mut lanes = unsafe { rays.meet::<S::Packet>(planes, shared.tmin, g) }.bits();
            // Lanes behind the last ray hold no ray.
            lanes &= ((1u64 << (self.end - from).min(S::Packet::WIDTH)) - 1) as u32;
            while lanes != 0 {
                self.room.numbers[met] = (from + lanes.trailing_zeros() as usize) as u16;
                lanes &= lanes - 1;
                met += 1;
            }
        }
        // SAFETY: the tree's leaves hold one box each; numbers are those of rays. The caller vouches for the ISA.
        unsafe {
            let instance = Tree::leaf::<S>(&self.instances.top, leaf).number(0);
            self.room.visit::<S>(self.instances, instance, 0..met, self.visit);
        }
        let has_ended = std::mem::take(&mut self.room.has_ended);
        if has_ended {
            for &number in &self.room.numbers[..met] {
                let number = number as usize;
                rays.limit[number - self.start] = beyond(self.room.rays[number].tmax);
            }
        }
        has_ended
    }
}
