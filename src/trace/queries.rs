//! Queries of a committed scene: closest hits, occlusion and shared-origin gathers, one ray or many.
//!
//! Hits on cut-outs of textures do not count. In scenes that have some, hits and occlusion are
//! [checked](super::pass_through) after the kernels, which are those of all scenes.

use super::compact::View;
use super::{Hit, Kernels, PACKET_SIZE, Packet, RawHit, Ray};
use crate::base::error::{Result, invalid_argument};
use crate::base::geometry::NONE;
use crate::base::memory::try_filled;
use crate::base::parallel::ParallelLoop;
use crate::bvh::instances::{Instances, MeshTree};
use crate::bvh::{ChildRef, Mbvh, Tree};
use crate::scene::Scene;
use crate::simd::Isa;
use glam::Vec3;
use rayon::prelude::*;

/// The tree of a scene, in the form that kernels take.
#[derive(Clone, Copy)]
pub(super) enum TreeView<'a> {
    Whole(&'a Mbvh),
    Compact(View<'a>),
}

/// Maximum number of rays of a stream that queries make.
const STREAM: usize = 4096;

/// Minimum number of rays of a stream that queries make.
const LEAST_STREAM: usize = 64;

/// Greatest extent of the origins of a stream's rays, as a fraction of the scene's.
const NEAR: f32 = 0.1;

/// Smallest group of consecutive rays that is worth tracing as a part of a stream.
const GROUP: usize = 8;

/// Greatest distance between the first and the last origin of such a group, as a fraction of the scene's extent.
const NEXT: f32 = 0.01;

/// Cosine of the greatest angle between two rays of a bundle that follow each other.
const BUNDLED: f32 = 0.995;

/// Number of rays whose hits tell whether the rays after them are traced as a stream.
const TRIAL: usize = 64;

/// Number of different triangles among those hits above which they are. (In Menger sponges of 8,448 to 2 million triangles bundles
/// are never slower with 38, with 28 and fewer they are for the narrowest packets.)
const FINE: usize = 38;

/// Number of rays, and of pairs of rays, that are looked at to tell how rays go.
const PAIRS: usize = 16;

/// Number of rays that are handed to a thread at a time: some blocks per thread, but long streams.
fn block_size(rays: usize) -> usize {
    rays.div_ceil(4 * rayon::current_num_threads()).clamp(512, STREAM)
}

impl Scene {
    /// The kernels of the ISA of the scene's device.
    #[inline]
    pub(super) fn kernels(&self) -> &'static Kernels {
        Kernels::of(self.device())
    }

    /// The acceleration structure, for kernels; if it is [in parts](super::waiting), what lies near its root.
    #[inline]
    pub(super) fn tree(&self) -> TreeView<'_> {
        match self.parts() {
            None => self.whole_tree(),
            Some(parts) => TreeView::Whole(&parts.tree.near_root),
        }
    }

    /// The acceleration structure where rays begin; `None` if all meshes have instances.
    #[inline]
    fn first_tree(&self) -> Option<TreeView<'_>> {
        (self.instance_trees().is_none() || !self.acceleration().0.is_nothing()).then(|| self.tree())
    }

    /// The acceleration structure, for kernels.
    #[inline]
    pub(super) fn whole_tree(&self) -> TreeView<'_> {
        let (tree, first_triangle) = self.acceleration();
        match tree {
            Tree::Whole(tree) => TreeView::Whole(tree),
            Tree::Compact(tree) => {
                // SAFETY: the tree was built of these meshes, which `SceneData` has validated; refits change
                // positions alone.
                TreeView::Compact(unsafe { View::new(tree, self.meshes(), &first_triangle[..=self.meshes().len()]) })
            }
        }
    }

    /// The tree of a mesh with instances, for kernels.
    #[inline]
    pub(super) fn tree_of<'a>(&'a self, instances: &'a Instances, tree: u32) -> TreeView<'a> {
        let MeshTree { mesh, range, tree, .. } = &instances.trees[tree as usize];
        match tree {
            Tree::Whole(tree) => TreeView::Whole(tree),
            Tree::Compact(tree) => {
                // SAFETY: as above, with triangles by their number in this mesh.
                TreeView::Compact(unsafe {
                    View::new(tree, std::slice::from_ref(&self.meshes()[*mesh as usize]), range)
                })
            }
        }
    }

    /// Closest hit with `tmin < t ≤ tmax`.
    pub fn intersect(&self, ray: &Ray) -> Hit {
        self.to_hit(self.intersect_raw(ray))
    }

    /// Converts a global triangle number to mesh and triangle.
    #[inline]
    pub fn to_hit(&self, hit: RawHit) -> Hit {
        if hit.triangle == NONE {
            return Hit::MISS;
        }
        let (object, triangle) = self.locate(hit.triangle);
        let (mesh, instance) = self.mesh_and_instance(object);
        Hit { t: hit.t, u: hit.u, v: hit.v, triangle, mesh, instance }
    }

    /// The mesh of an object, and the instance that it is; [`NONE`]: it is none.
    #[inline]
    fn mesh_and_instance(&self, object: u32) -> (u32, u32) {
        match object.checked_sub(self.meshes().len() as u32) {
            None => (object, NONE),
            Some(instance) => (self.instances()[instance as usize].mesh, instance),
        }
    }

    /// Converts many hits as `to_hit`. Neighbours mostly hit the same object, which is then looked up once.
    pub(crate) fn to_hits(&self, hits: &[RawHit], out: &mut [Hit]) {
        let first_triangle = self.acceleration().1;
        let (mut mesh, mut instance, mut begin, mut end) = (0, NONE, 0, 0);
        for (out, hit) in out.iter_mut().zip(hits) {
            if hit.triangle == NONE {
                *out = Hit::MISS;
                continue;
            }
            if !(begin..end).contains(&hit.triangle) {
                let object = self.locate(hit.triangle).0;
                (mesh, instance) = self.mesh_and_instance(object);
                begin = first_triangle[object as usize];
                end = first_triangle.get(object as usize + 1).copied().unwrap_or(u32::MAX);
            }
            *out = Hit { t: hit.t, u: hit.u, v: hit.v, triangle: hit.triangle - begin, mesh, instance };
        }
    }

    /// Closest hits of many rays, in order. `parallel`: spread over the device's threads.
    ///
    /// Consecutive rays of a pinhole camera, with one origin and `tmin`, traverse the tree together and are several
    /// times as fast as others: best in small square tiles of pixels. Hits are the same, bit for bit.
    pub fn intersect_many(&self, rays: &[Ray], parallel: bool, out: &mut [Hit]) -> Result<()> {
        if rays.len() != out.len() {
            return invalid_argument!("{} rays, but room for {} hits", rays.len(), out.len());
        }
        let block = |rays: &[Ray], out: &mut [Hit]| {
            for (rays, out) in rays.chunks(STREAM).zip(out.chunks_mut(STREAM)) {
                if self.go_alike(rays) {
                    // Room for the hits of a stream; without, rays are traced in smaller blocks.
                    if let Ok(mut raw) = try_filled(rays.len(), RawHit::MISS, "hits") {
                        self.intersect_stream(rays, &mut raw);
                        self.to_hits(&raw, out);
                        continue;
                    }
                }
                let mut raw = [RawHit::MISS; 256];
                let mut traced = 0;
                while traced < rays.len() {
                    let end = rays.len().min(traced + if traced == 0 { TRIAL } else { 256 });
                    self.intersect_block(&rays[traced..end], &mut raw);
                    self.to_hits(&raw[..end - traced], &mut out[traced..end]);
                    if traced == 0
                        && end < rays.len()
                        && self.is_fine(&rays[..end], &raw[..end])
                        && let Ok(mut raw) = try_filled(rays.len() - end, RawHit::MISS, "hits")
                    {
                        self.intersect_stream(&rays[end..], &mut raw);
                        self.to_hits(&raw, &mut out[end..]);
                        break;
                    }
                    traced = end;
                }
            }
        };
        if parallel {
            self.install(|| {
                let size = block_size(rays.len());
                rays.par_chunks(size).zip(out.par_chunks_mut(size)).each(|(r, o)| block(r, o));
            });
        } else {
            block(rays, out);
        }
        Ok(())
    }

    /// Whether streams are faster than many single rays. On the portable lanes, of four, lists save nothing (tiles 1.00,
    /// one origin 0.7 to 0.97 times as fast with SSE2).
    fn has_fast_streams(&self) -> bool {
        self.device().isa() != Isa::Portable
    }

    /// Whether rays are worth tracing as a stream: many, all from places near one another, or most in groups that are.
    /// (16 places with 256 rays each: 1.6 to 1.9 times as fast as one by one, 512 with 8 each: 1.0 to 1.1 times.) Rays of a
    /// pinhole camera are not: they are faster as bundles.
    fn go_alike(&self, rays: &[Ray]) -> bool {
        if rays.len() < LEAST_STREAM || !self.has_fast_streams() {
            return false;
        }
        let (mut lower, mut upper) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        for ray in rays.iter().step_by(rays.len() / PAIRS) {
            let origin = Vec3::from(ray.origin);
            (lower, upper) = (lower.min(origin), upper.max(origin));
        }
        let bounds = self.bounds();
        let diagonal = (bounds.1 - bounds.0).length();
        let pairs = |apart: usize| rays.windows(apart + 1).step_by(rays.len() / PAIRS);
        let is_near =
            |pair: &[Ray]| Vec3::from(pair[0].origin).distance(pair[GROUP - 1].origin.into()) <= NEXT * diagonal;
        // False for NaN.
        let is_compact = (upper - lower).length() <= NEAR * diagonal;
        if !is_compact && pairs(GROUP - 1).filter(|pair| is_near(pair)).count() < 3 * PAIRS / 4 {
            return false;
        }
        let is_bundled = |pair: &[Ray]| {
            let [a, b] = [pair[0], pair[1]].map(|ray| Vec3::from(ray.direction));
            pair[0].origin == pair[1].origin && a.dot(b) > BUNDLED * (a.length_squared() * b.length_squared()).sqrt()
        };
        pairs(1).filter(|pair| is_bundled(pair)).count() < PAIRS / 2
    }

    /// Whether triangles are so small beside the distance of rays from one origin that few hit the same: as bundles such rays
    /// test each triangle for all, as streams they do not. (Menger sponges, `bakelite report coherence`.)
    fn is_fine(&self, rays: &[Ray], hits: &[RawHit]) -> bool {
        let has_one_origin = rays.windows(2).all(|pair| pair[0].origin == pair[1].origin);
        let mut triangles = [NONE; TRIAL];
        triangles.iter_mut().zip(hits).for_each(|(triangle, hit)| *triangle = hit.triangle);
        triangles.sort_unstable();
        let different = triangles.windows(2).filter(|pair| pair[0] != pair[1]).count();
        self.has_fast_streams() && has_one_origin && different > FINE
    }

    /// Whether each of many rays hits anything, in order: 1 or 0.
    pub fn occluded_many(&self, rays: &[Ray], parallel: bool, out: &mut [u8]) -> Result<()> {
        if rays.len() != out.len() {
            return invalid_argument!("{} rays, but room for {} answers", rays.len(), out.len());
        }
        let block = |rays: &[Ray], out: &mut [u8]| {
            for (rays, out) in rays.chunks(STREAM).zip(out.chunks_mut(STREAM)) {
                match self.go_alike(rays) {
                    true => self.occluded_stream(rays, out),
                    false => self.occluded_block(rays, out),
                }
            }
        };
        if parallel {
            self.install(|| {
                let size = block_size(rays.len());
                rays.par_chunks(size).zip(out.par_chunks_mut(size)).each(|(r, o)| block(r, o));
            });
        } else {
            block(rays, out);
        }
        Ok(())
    }

    /// Closest hits of rays that share an origin, `0 < t ≤ tmax`, in order: the same as those of
    /// [`intersect_many`](Self::intersect_many).
    pub fn gather(
        &self,
        origin: Vec3,
        directions: &[[f32; 3]],
        tmax: f32,
        parallel: bool,
        out: &mut [Hit],
    ) -> Result<()> {
        if directions.len() != out.len() {
            return invalid_argument!("{} directions, but room for {} hits", directions.len(), out.len());
        }
        let nothing = Ray::new(Vec3::ZERO, Vec3::ZERO);
        let trace = |directions: &[[f32; 3]], rays: &mut [Ray], raw: &mut [RawHit], out: &mut [Hit]| {
            for (directions, out) in directions.chunks(rays.len()).zip(out.chunks_mut(rays.len())) {
                let ray = |d: &[f32; 3]| Ray::new(origin, Vec3::from(*d)).within(0.0, tmax);
                rays.iter_mut().zip(directions).for_each(|(r, d)| *r = ray(d));
                let rays = &rays[..directions.len()];
                match self.has_fast_streams() {
                    true => self.intersect_stream(rays, raw),
                    false => self.intersect_block(rays, raw),
                }
                self.to_hits(&raw[..directions.len()], out);
            }
        };
        let block = |directions: &[[f32; 3]], out: &mut [Hit]| {
            // Long streams are faster, but their rays need memory.
            const SHORT: usize = 256;
            let size = directions.len().min(STREAM);
            let room =
                (size > SHORT).then(|| (try_filled(size, nothing, "rays"), try_filled(size, RawHit::MISS, "hits")));
            match room {
                Some((Ok(mut rays), Ok(mut raw))) => trace(directions, &mut rays, &mut raw, out),
                _ => trace(directions, &mut [nothing; SHORT], &mut [RawHit::MISS; SHORT], out),
            }
        };
        if parallel {
            self.install(|| {
                let size = block_size(directions.len());
                directions.par_chunks(size).zip(out.par_chunks_mut(size)).each(|(d, o)| block(d, o));
            });
        } else {
            block(directions, out);
        }
        Ok(())
    }

    /// Closest hits of one packet, `tmin < t ≤ tmax`. Entries of `out` beyond the packet's count
    /// are left alone.
    #[inline]
    pub fn gather_packet(&self, origin: Vec3, packet: &Packet, tmin: f32, tmax: f32, out: &mut [RawHit; PACKET_SIZE]) {
        match self.first_tree() {
            None => out[..packet.count.min(PACKET_SIZE)].fill(RawHit::MISS),
            Some(TreeView::Whole(tree)) => self.kernels().gather(tree, origin, packet, tmin, tmax, out),
            Some(TreeView::Compact(tree)) => {
                let count = packet.count.min(PACKET_SIZE);
                let rays: [Ray; PACKET_SIZE] = std::array::from_fn(|i| {
                    Ray::new(origin, Vec3::new(packet.x[i], packet.y[i], packet.z[i])).within(tmin, tmax)
                });
                self.kernels().compact_intersect(&tree, ChildRef::ROOT, &rays[..count], out);
            }
        }
        if self.instance_trees().is_some() || self.parts().is_some() {
            let ray = |i: usize| Ray::new(origin, Vec3::new(packet.x[i], packet.y[i], packet.z[i])).within(tmin, tmax);
            let rays: [Ray; PACKET_SIZE] = std::array::from_fn(ray);
            let count = packet.count.min(PACKET_SIZE);
            self.meet_parts(&rays[..count], false, out);
            self.meet_instances(&rays[..count], false, out);
        }
        if self.has_holes() {
            self.leave_holes_of_packet(origin, packet, tmin, tmax, out);
        }
    }

    /// Closest hit with `tmin < t ≤ tmax`, by global triangle number.
    #[inline]
    pub fn intersect_raw(&self, ray: &Ray) -> RawHit {
        let mut hit = [match self.first_tree() {
            None => RawHit::MISS,
            Some(TreeView::Whole(tree)) => self.kernels().intersect(tree, ray),
            Some(TreeView::Compact(tree)) => {
                let mut hit = [RawHit::MISS];
                self.kernels().compact_intersect(&tree, ChildRef::ROOT, std::slice::from_ref(ray), &mut hit);
                hit[0]
            }
        }];
        self.meet_parts(std::slice::from_ref(ray), false, &mut hit);
        self.meet_instances(std::slice::from_ref(ray), false, &mut hit);
        if self.has_holes() {
            self.leave_holes(std::slice::from_ref(ray), &mut hit);
        }
        hit[0]
    }

    /// Whether anything lies on the ray with `tmin < t ≤ tmax`.
    #[inline]
    pub fn occluded(&self, ray: &Ray) -> bool {
        let mut occluded = [self.anything_on(ray) as u8];
        if self.has_holes() {
            self.look_through_holes(std::slice::from_ref(ray), &mut occluded);
        }
        occluded[0] != 0
    }

    /// Whether anything lies on the ray, cut-outs included.
    #[inline]
    pub(super) fn anything_on(&self, ray: &Ray) -> bool {
        let mut occluded = [0];
        match self.first_tree() {
            None => {}
            Some(TreeView::Whole(tree)) => occluded[0] = self.kernels().occluded(tree, ray) as u8,
            Some(TreeView::Compact(tree)) => {
                self.kernels().compact_occluded(&tree, ChildRef::ROOT, std::slice::from_ref(ray), &mut occluded);
            }
        }
        self.meet_parts(std::slice::from_ref(ray), false, &mut occluded);
        self.meet_instances(std::slice::from_ref(ray), false, &mut occluded);
        occluded[0] != 0
    }

    /// Closest hits of as many rays as both slices have.
    pub(crate) fn intersect_block(&self, rays: &[Ray], out: &mut [RawHit]) {
        match self.first_tree() {
            None => out.iter_mut().take(rays.len()).for_each(|out| *out = RawHit::MISS),
            Some(TreeView::Whole(tree)) => self.kernels().intersect_block(tree, ChildRef::ROOT, rays, out),
            Some(TreeView::Compact(tree)) => self.kernels().compact_intersect(&tree, ChildRef::ROOT, rays, out),
        }
        self.meet_parts(rays, false, out);
        self.meet_instances(rays, false, out);
        if self.has_holes() {
            self.leave_holes(rays, out);
        }
    }

    /// Closest hits of as many rays as both slices have, which start near one another: traced as a stream. The hits are
    /// those of [`intersect_raw`](Self::intersect_raw), bit for bit.
    pub fn intersect_stream(&self, rays: &[Ray], out: &mut [RawHit]) {
        match self.first_tree() {
            None => out.iter_mut().take(rays.len()).for_each(|out| *out = RawHit::MISS),
            Some(TreeView::Whole(tree)) => self.kernels().stream(tree, ChildRef::ROOT, rays, out),
            Some(TreeView::Compact(tree)) => self.kernels().compact_stream(&tree, ChildRef::ROOT, rays, out),
        }
        self.meet_parts(rays, true, out);
        self.meet_instances(rays, true, out);
        if self.has_holes() {
            self.leave_holes(rays, out);
        }
    }

    /// Any hit of as many rays as both slices have, which start near one another, traced as a stream: 1 or 0.
    pub fn occluded_stream(&self, rays: &[Ray], out: &mut [u8]) {
        match self.first_tree() {
            None => out.iter_mut().take(rays.len()).for_each(|out| *out = 0),
            Some(TreeView::Whole(tree)) => self.kernels().stream_occluded(tree, ChildRef::ROOT, rays, out),
            Some(TreeView::Compact(tree)) => self.kernels().compact_stream_occluded(&tree, ChildRef::ROOT, rays, out),
        }
        self.meet_parts(rays, true, out);
        self.meet_instances(rays, true, out);
        if self.has_holes() {
            self.look_through_holes(rays, out);
        }
    }

    /// Any hit of as many rays as both slices have: 1 or 0.
    pub(crate) fn occluded_block(&self, rays: &[Ray], out: &mut [u8]) {
        match self.first_tree() {
            None => out.iter_mut().take(rays.len()).for_each(|out| *out = 0),
            Some(TreeView::Whole(tree)) => self.kernels().occluded_block(tree, ChildRef::ROOT, rays, out),
            Some(TreeView::Compact(tree)) => self.kernels().compact_occluded(&tree, ChildRef::ROOT, rays, out),
        }
        self.meet_parts(rays, false, out);
        self.meet_instances(rays, false, out);
        if self.has_holes() {
            self.look_through_holes(rays, out);
        }
    }

    /// Whether hits may be on cut-outs.
    #[inline]
    fn has_holes(&self) -> bool {
        !self.uses().holes.is_empty()
    }
}
