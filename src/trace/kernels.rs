//! One table of kernel entry points per ISA.
//!
//! Each [entry point](entry_point) carries the ISA's `#[target_feature]`s; the generic kernels are
//! `#[inline(always)]` and so are compiled for them.

use super::compact::View;
use super::filter::Filter;
use super::single::Walk;
use super::tree::{Leaf, Tree};
use super::{
    PACKET_SIZE, Packet, RawHit, Ray, box_lists, bundle, bundle_boxes, gather, packet, single, stream, two_levels,
};
use crate::base::geometry::NONE;
use crate::bvh::instances::Instances;
use crate::bvh::{ChildRef, Mbvh};
use crate::device::Device;
use crate::scene::Scene;
use crate::simd::{self, Isa, Lanes, Simd, entry_point, isa_features};
use glam::Vec3;

/// Kernels of one ISA. Tables exist for every ISA, but [`Kernels::of`] returns only those that the machine can run:
/// that makes the methods safe.
pub(crate) struct Kernels {
    intersect: unsafe fn(&Mbvh, &Ray) -> RawHit,
    intersect_block: unsafe fn(&Mbvh, ChildRef, &[Ray], &mut [RawHit]),
    occluded: unsafe fn(&Mbvh, &Ray) -> bool,
    occluded_block: unsafe fn(&Mbvh, ChildRef, &[Ray], &mut [u8]),
    /// Without and with VBMI2. `None`: as blocks. (On the portable lanes, of four, lists save nothing: tiles 1.00, one
    /// origin 0.7 to 0.97 times as fast with SSE2; and they take 0.2 MB of the library.)
    streams: Option<[&'static Streams; 2]>,
    gather: unsafe fn(&Mbvh, Vec3, &Packet, f32, f32, &mut [RawHit; PACKET_SIZE]),
    compact_intersect: unsafe fn(&View, ChildRef, &[Ray], &mut [RawHit]),
    compact_occluded: unsafe fn(&View, ChildRef, &[Ray], &mut [u8]),
    /// Closest hit and any hit, among those that a filter accepts.
    filtered: [unsafe fn(&Mbvh, &Ray, &mut Filter) -> RawHit; 2],
    compact_filtered: [unsafe fn(&View, &Ray, &mut Filter) -> RawHit; 2],
    next_box: unsafe fn(&Mbvh, &mut Walk, f32) -> u32,
    list_instances: unsafe fn(&Instances, usize, &mut box_lists::Room, box_lists::OnVisit),
    /// `None`: as lists. (On the portable lanes bundles take 27 kB of the library.)
    bundle_instances: Option<unsafe fn(&Instances, usize, &mut box_lists::Room, box_lists::OnVisit)>,
    next_bundles: unsafe fn(&[Ray]) -> (usize, usize),
    intersect_instances: unsafe fn(&Scene, &Instances, &[Ray], &mut [RawHit]),
    occluded_instances: unsafe fn(&Scene, &Instances, &[Ray], &mut [u8]),
}

/// Kernels of streams. On AVX-512 there are two of each: with VBMI2 and without.
#[derive(Clone, Copy)]
struct Streams {
    closest: unsafe fn(&Mbvh, ChildRef, &[Ray], &mut [RawHit]),
    any: unsafe fn(&Mbvh, ChildRef, &[Ray], &mut [u8]),
    compact_closest: unsafe fn(&View, ChildRef, &[Ray], &mut [RawHit]),
    compact_any: unsafe fn(&View, ChildRef, &[Ray], &mut [u8]),
}

macro_rules! streams {
    ($module:ident, $isa:ident) => {
        mod $module {
            use super::*;
            use simd::$isa as S;

            isa_features! { $isa => entry_point! {
                fn stream(bvh: &Mbvh, root: ChildRef, rays: &[Ray], out: &mut [RawHit]) {
                    let n = rays.len().min(out.len());
                    stream::stream::<S, _, false>(bvh, root, &rays[..n], |i, hit| out[i] = hit)
                }
            } }
            isa_features! { $isa => entry_point! {
                fn stream_occluded(bvh: &Mbvh, root: ChildRef, rays: &[Ray], out: &mut [u8]) {
                    let n = rays.len().min(out.len());
                    stream::stream::<S, _, true>(bvh, root, &rays[..n], |i, hit| out[i] = !hit.is_miss() as u8)
                }
            } }
            isa_features! { $isa => entry_point! {
                fn compact_stream(tree: &View, root: ChildRef, rays: &[Ray], out: &mut [RawHit]) {
                    let n = rays.len().min(out.len());
                    stream::stream::<S, _, false>(tree, root, &rays[..n], |i, hit| out[i] = hit)
                }
            } }
            isa_features! { $isa => entry_point! {
                fn compact_stream_occluded(tree: &View, root: ChildRef, rays: &[Ray], out: &mut [u8]) {
                    let n = rays.len().min(out.len());
                    stream::stream::<S, _, true>(tree, root, &rays[..n], |i, hit| out[i] = !hit.is_miss() as u8)
                }
            } }

            pub(super) static TABLE: Streams = Streams {
                closest: stream,
                any: stream_occluded,
                compact_closest: compact_stream,
                compact_any: compact_stream_occluded,
            };
        }
    };
}

macro_rules! table {
    ($name:ident, $module:ident, $isa:ident, $streams:expr) => {
        mod $module {
            use super::*;
            use simd::$isa as S;

            isa_features! { $isa => entry_point! {
                fn intersect(bvh: &Mbvh, ray: &Ray) -> RawHit { single::one::<S, _, false>(bvh, ray) }
            } }
            isa_features! { $isa => entry_point! {
                fn intersect_block(bvh: &Mbvh, root: ChildRef, rays: &[Ray], out: &mut [RawHit]) { packet::block::<S>(bvh, root, rays, out) }
            } }
            isa_features! { $isa => entry_point! {
                fn occluded(bvh: &Mbvh, ray: &Ray) -> bool { !single::one::<S, _, true>(bvh, ray).is_miss() }
            } }
            isa_features! { $isa => entry_point! {
                fn occluded_block(bvh: &Mbvh, root: ChildRef, rays: &[Ray], out: &mut [u8]) {
                    let n = rays.len().min(out.len());
                    single::many::<S, _, true>(bvh, root, n, |i| rays[i], |i, hit| out[i] = !hit.is_miss() as u8)
                }
            } }
            isa_features! { $isa => entry_point! {
                fn gather(
                    bvh: &Mbvh, origin: Vec3, packet: &Packet, tmin: f32, tmax: f32, out: &mut [RawHit; PACKET_SIZE]
                ) {
                    gather::gather::<S>(bvh, origin, packet, tmin, tmax, out)
                }
            } }
            isa_features! { $isa => entry_point! {
                fn compact_intersect(tree: &View, root: ChildRef, rays: &[Ray], out: &mut [RawHit]) {
                    let n = rays.len().min(out.len());
                    match rays {
                        [ray] if n == 1 && root == ChildRef::ROOT => out[0] = single::one::<S, _, false>(tree, ray),
                        _ => single::many::<S, _, false>(tree, root, n, |i| rays[i], |i, hit| out[i] = hit),
                    }
                }
            } }
            isa_features! { $isa => entry_point! {
                fn compact_occluded(tree: &View, root: ChildRef, rays: &[Ray], out: &mut [u8]) {
                    let n = rays.len().min(out.len());
                    match rays {
                        [ray] if n == 1 && root == ChildRef::ROOT => out[0] = !single::one::<S, _, true>(tree, ray).is_miss() as u8,
                        _ => single::many::<S, _, true>(tree, root, n, |i| rays[i], |i, hit| out[i] = !hit.is_miss() as u8),
                    }
                }
            } }
            isa_features! { $isa => entry_point! {
                fn filtered[const ANY: bool](tree: &Mbvh, ray: &Ray, filter: &mut Filter) -> RawHit {
                    single::one_of::<S, _, _, ANY>(tree, ray, filter)
                }
            } }
            isa_features! { $isa => entry_point! {
                fn compact_filtered[const ANY: bool](tree: &View, ray: &Ray, filter: &mut Filter) -> RawHit {
                    single::one_of::<S, _, _, ANY>(tree, ray, filter)
                }
            } }

            isa_features! { $isa => entry_point! {
                fn next_box(boxes: &Mbvh, walk: &mut Walk, tmax: f32) -> u32 {
                    match walk.next_leaf::<S, _>(boxes, tmax) {
                        ChildRef::EMPTY => NONE,
                        leaf => Tree::leaf::<S>(boxes, leaf).number(0),
                    }
                }
            } }

            isa_features! { $isa => entry_point! {
                fn list_instances(
                    instances: &Instances, count: usize, room: &mut box_lists::Room, visit: box_lists::OnVisit
                ) {
                    box_lists::trace::<S>(instances, count, room, visit)
                }
            } }
            isa_features! { $isa => entry_point! {
                fn bundle_instances(
                    instances: &Instances, count: usize, room: &mut box_lists::Room, visit: box_lists::OnVisit
                ) {
                    bundle_boxes::trace::<S>(instances, count, room, visit)
                }
            } }
            isa_features! { $isa => entry_point! {
                fn next_bundles(rays: &[Ray]) -> (usize, usize) { bundle::next::<S>(rays) }
            } }
            isa_features! { $isa => entry_point! {
                fn intersect_instances(scene: &Scene, instances: &Instances, rays: &[Ray], out: &mut [RawHit]) {
                    two_levels::trace::<S, _, false>(scene, instances, rays, out)
                }
            } }
            isa_features! { $isa => entry_point! {
                fn occluded_instances(scene: &Scene, instances: &Instances, rays: &[Ray], out: &mut [u8]) {
                    two_levels::trace::<S, _, true>(scene, instances, rays, out)
                }
            } }

            pub(super) const TABLE: Kernels = Kernels {
                intersect,
                intersect_block,
                occluded,
                occluded_block,
                streams: $streams,
                gather,
                compact_intersect,
                compact_occluded,
                filtered: [filtered::<false>, filtered::<true>],
                compact_filtered: [compact_filtered::<false>, compact_filtered::<true>],
                next_box,
                list_instances,
                bundle_instances: match <<S as Simd>::Packet as Lanes>::WIDTH {
                    0..=4 => None,
                    _ => Some(bundle_instances),
                },
                next_bundles,
                intersect_instances,
                occluded_instances,
            };
        }
        static $name: Kernels = $module::TABLE;
    };
}

#[cfg(target_arch = "x86_64")]
streams!(avx2_streams, Avx2);
#[cfg(target_arch = "x86_64")]
streams!(avx512_streams, Avx512);
#[cfg(target_arch = "x86_64")]
streams!(vbmi2_streams, Avx512Vbmi2);

table!(PORTABLE, portable, Portable, None);
#[cfg(target_arch = "x86_64")]
table!(AVX2, avx2, Avx2, Some([&avx2_streams::TABLE; 2]));
/// Compact trees do without VBMI2, which would take another 60 kB for them.
#[cfg(target_arch = "x86_64")]
static VBMI2_STREAMS: Streams =
    Streams { closest: vbmi2_streams::TABLE.closest, any: vbmi2_streams::TABLE.any, ..avx512_streams::TABLE };
#[cfg(target_arch = "x86_64")]
table!(AVX512, avx512, Avx512, Some([&avx512_streams::TABLE, &VBMI2_STREAMS]));

impl Kernels {
    /// The kernels of a device's ISA.
    #[inline]
    pub(crate) fn of(device: &Device) -> &'static Kernels {
        // Devices exist only with an ISA that the machine can run.
        Self::table(device.isa())
    }

    /// The table of an ISA; that of the portable one if the machine cannot run `isa`.
    #[cfg(test)]
    pub(crate) fn for_isa(isa: Isa) -> &'static Kernels {
        Self::table(if isa.is_available() { isa } else { Isa::Portable })
    }

    #[inline]
    fn table(isa: Isa) -> &'static Kernels {
        match isa {
            #[cfg(target_arch = "x86_64")]
            Isa::Avx2 => &AVX2,
            #[cfg(target_arch = "x86_64")]
            Isa::Avx512 => &AVX512,
            _ => &PORTABLE,
        }
    }

    fn streams(&self) -> Option<&Streams> {
        Some(self.streams?[usize::from(Isa::has_vbmi2())])
    }

    /// Closest hit.
    #[inline]
    pub(crate) fn intersect(&self, bvh: &Mbvh, ray: &Ray) -> RawHit {
        // SAFETY: `of` vouches that the machine has the ISA.
        unsafe { (self.intersect)(bvh, ray) }
    }

    /// Closest hits of as many rays as both slices have below a node of the tree.
    pub(crate) fn intersect_block(&self, bvh: &Mbvh, root: ChildRef, rays: &[Ray], out: &mut [RawHit]) {
        assert!(bvh.has_node(root));
        // SAFETY: see `intersect`; the root is a node.
        unsafe { (self.intersect_block)(bvh, root, rays, out) }
    }

    /// Any hit.
    #[inline]
    pub(crate) fn occluded(&self, bvh: &Mbvh, ray: &Ray) -> bool {
        // SAFETY: see `intersect`.
        unsafe { (self.occluded)(bvh, ray) }
    }

    /// Any hit of as many rays as both slices have below a node: 1 or 0.
    pub(crate) fn occluded_block(&self, bvh: &Mbvh, root: ChildRef, rays: &[Ray], out: &mut [u8]) {
        assert!(bvh.has_node(root));
        // SAFETY: see `intersect`; the root is a node.
        unsafe { (self.occluded_block)(bvh, root, rays, out) }
    }

    /// Closest hits of as many rays as both slices have below a node, as a stream.
    pub(crate) fn stream(&self, bvh: &Mbvh, root: ChildRef, rays: &[Ray], out: &mut [RawHit]) {
        assert!(bvh.has_node(root));
        // SAFETY: see `intersect`; the root is a node.
        unsafe { self.streams().map_or(self.intersect_block, |s| s.closest)(bvh, root, rays, out) }
    }

    /// Any hit of as many rays as both slices have below a node, as a stream: 1 or 0.
    pub(crate) fn stream_occluded(&self, bvh: &Mbvh, root: ChildRef, rays: &[Ray], out: &mut [u8]) {
        assert!(bvh.has_node(root));
        // SAFETY: see `intersect`; the root is a node.
        unsafe { self.streams().map_or(self.occluded_block, |s| s.any)(bvh, root, rays, out) }
    }

    /// Closest hits of as many rays as both slices have, below a node of a compact tree, as a stream.
    pub(crate) fn compact_stream(&self, tree: &View, root: ChildRef, rays: &[Ray], out: &mut [RawHit]) {
        assert!(tree.has_node(root));
        // SAFETY: see `intersect`; the root is a node.
        unsafe { self.streams().map_or(self.compact_intersect, |s| s.compact_closest)(tree, root, rays, out) }
    }

    /// Any hit of as many rays as both slices have, below a node of a compact tree, as a stream: 1 or 0.
    pub(crate) fn compact_stream_occluded(&self, tree: &View, root: ChildRef, rays: &[Ray], out: &mut [u8]) {
        assert!(tree.has_node(root));
        // SAFETY: see `intersect`; the root is a node.
        unsafe { self.streams().map_or(self.compact_occluded, |s| s.compact_any)(tree, root, rays, out) }
    }

    /// Closest hits of a packet of rays from one origin.
    #[inline]
    pub(crate) fn gather(
        &self,
        bvh: &Mbvh,
        origin: Vec3,
        packet: &Packet,
        tmin: f32,
        tmax: f32,
        out: &mut [RawHit; PACKET_SIZE],
    ) {
        // SAFETY: see `intersect`.
        unsafe { (self.gather)(bvh, origin, packet, tmin, tmax, out) }
    }

    /// Closest hits of as many rays as both slices have below a node of a compact tree.
    pub(crate) fn compact_intersect(&self, tree: &View, root: ChildRef, rays: &[Ray], out: &mut [RawHit]) {
        assert!(tree.has_node(root));
        // SAFETY: see `intersect`; the root is a node.
        unsafe { (self.compact_intersect)(tree, root, rays, out) }
    }

    /// Any hit of as many rays as both slices have below a node of a compact tree: 1 or 0.
    pub(crate) fn compact_occluded(&self, tree: &View, root: ChildRef, rays: &[Ray], out: &mut [u8]) {
        assert!(tree.has_node(root));
        // SAFETY: see `intersect`; the root is a node.
        unsafe { (self.compact_occluded)(tree, root, rays, out) }
    }

    /// Closest hit (`ANY`: any hit) among those that a filter accepts.
    pub(crate) fn filtered<const ANY: bool>(&self, tree: &Mbvh, ray: &Ray, filter: &mut Filter) -> RawHit {
        // SAFETY: see `intersect`.
        unsafe { (self.filtered[ANY as usize])(tree, ray, filter) }
    }

    /// Closest hit (`ANY`: any hit) in a compact tree, among those that a filter accepts.
    pub(crate) fn compact_filtered<const ANY: bool>(&self, tree: &View, ray: &Ray, filter: &mut Filter) -> RawHit {
        // SAFETY: see `intersect`.
        unsafe { (self.compact_filtered[ANY as usize])(tree, ray, filter) }
    }

    /// Number of the next box that a ray meets before `tmax`, nearest first; [`NONE`] after the last. `walk` must have
    /// been begun, and go through these boxes alone.
    #[inline]
    pub(super) fn next_box(&self, boxes: &Mbvh, walk: &mut Walk, tmax: f32) -> u32 {
        // SAFETY: see `intersect`.
        unsafe { (self.next_box)(boxes, walk, tmax) }
    }

    /// Takes rays that go alike through the tree over instances: see [`box_lists::trace`].
    pub(super) fn list_instances(
        &self,
        instances: &Instances,
        count: usize,
        room: &mut box_lists::Room,
        visit: box_lists::OnVisit,
    ) {
        // SAFETY: see `intersect`.
        unsafe { (self.list_instances)(instances, count, room, visit) }
    }

    /// Takes bundles of rays through the tree over instances: see [`bundle_boxes::trace`].
    pub(super) fn bundle_instances(
        &self,
        instances: &Instances,
        count: usize,
        room: &mut box_lists::Room,
        visit: box_lists::OnVisit,
    ) {
        // SAFETY: see `intersect`.
        unsafe { self.bundle_instances.unwrap_or(self.list_instances)(instances, count, room, visit) }
    }

    /// Number of rays before the first that are faster together, and of those.
    pub(super) fn next_bundles(&self, rays: &[Ray]) -> (usize, usize) {
        // SAFETY: see `intersect`.
        unsafe { (self.next_bundles)(rays) }
    }

    /// Closest hits of rays in instances, one by one, where they are nearer than what `out` says.
    pub(super) fn intersect_instances(&self, scene: &Scene, instances: &Instances, rays: &[Ray], out: &mut [RawHit]) {
        // SAFETY: see `intersect`.
        unsafe { (self.intersect_instances)(scene, instances, rays, out) }
    }

    /// Any hit of rays in instances, one by one, of those that have none according to `out`.
    pub(super) fn occluded_instances(&self, scene: &Scene, instances: &Instances, rays: &[Ray], out: &mut [u8]) {
        // SAFETY: see `intersect`.
        unsafe { (self.occluded_instances)(scene, instances, rays, out) }
    }
}
