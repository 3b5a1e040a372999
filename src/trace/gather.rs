//! Shared-origin gather: traces a packet of rays from one point (thesis 3.2.5).
//!
//! The rays are traced one by one, several under way at a time. Packets that traverse the tree together, with planes
//! and triangles relative to the origin once for all, were slower: 32 rays of a hemisphere diverge within two levels of
//! an 8-wide tree (Sponza: 0.59 of `rtcIntersect1`, against 0.97 one by one on the same day).

use super::single::many;
use super::{PACKET_SIZE, Packet, RawHit, Ray};
use crate::bvh::layout::{ChildRef, Mbvh};
use crate::simd::Simd;
use glam::Vec3;

/// Closest hits of up to [`PACKET_SIZE`] rays from `origin`, `tmin < t ≤ tmax`.
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
pub(super) unsafe fn gather<S: Simd>(
    bvh: &Mbvh,
    origin: Vec3,
    packet: &Packet,
    tmin: f32,
    tmax: f32,
    out: &mut [RawHit; PACKET_SIZE],
) {
    let count = packet.count.min(PACKET_SIZE);
    let ray = |i: usize| Ray::new(origin, Vec3::new(packet.x[i], packet.y[i], packet.z[i])).within(tmin, tmax);
    // SAFETY: forwarded.
    unsafe { many::<S, _, false>(bvh, ChildRef::ROOT, count, ray, |i, hit| out[i] = hit) }
}
