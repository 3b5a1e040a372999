//! The ray kernels: rays, hits, and the table of kernels per ISA.
//!
//! A closest hit is the one with the least t in `tmin < t ≤ tmax`; among exactly equal t the
//! triangle with the lowest global number wins, on every path, so that single rays, packets and
//! every ISA agree on coincident triangles.
//!
//! Points that a texture cuts out are no hits. In scenes that have some, hits and occlusion are
//! [checked](filter) after the kernels, which are those of all scenes.

pub mod baseline;
mod compact;
pub(crate) mod filter;
mod gather;
mod kernels;
pub mod offset;
mod packet;
mod single;
mod tree;
mod triangle;

pub(crate) use compact::View;
pub(crate) use kernels::Kernels;

use crate::bvh::Mbvh;
use crate::error::{Result, invalid_argument};
use crate::scene::{NONE, Scene};
use bytemuck::{Pod, Zeroable};
use glam::Vec3;
use rayon::prelude::*;

/// A ray: points `origin + t · direction` with `tmin < t ≤ tmax`. The direction need not be
/// normalised. A ray with a NaN, an origin beyond 1e18 or a zero direction hits nothing.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Ray {
    pub origin: [f32; 3],
    pub tmin: f32,
    pub direction: [f32; 3],
    pub tmax: f32,
}

impl Ray {
    /// The ray from `origin` along `direction` with `0 < t`.
    pub fn new(origin: Vec3, direction: Vec3) -> Self {
        Ray { origin: origin.to_array(), tmin: 0.0, direction: direction.to_array(), tmax: f32::INFINITY }
    }

    /// The same ray limited to `tmin < t ≤ tmax`.
    pub fn within(self, tmin: f32, tmax: f32) -> Self {
        Ray { tmin, tmax, ..self }
    }
}

/// A hit by global triangle number, as kernels report it. A miss has `t = +inf`, triangle [`NONE`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RawHit {
    pub t: f32,
    /// Barycentric weight of vertex 1.
    pub u: f32,
    /// Barycentric weight of vertex 2.
    pub v: f32,
    /// Global triangle number.
    pub triangle: u32,
    /// Whether the ray met the front, from which the corners go round counter-clockwise.
    pub front: bool,
}

impl RawHit {
    /// No hit.
    pub const MISS: RawHit = RawHit { t: f32::INFINITY, u: 0.0, v: 0.0, triangle: NONE, front: false };

    /// Whether nothing was hit.
    #[inline]
    pub fn is_miss(&self) -> bool {
        self.triangle == NONE
    }
}

/// A hit by mesh and triangle, as callers see it.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Hit {
    pub t: f32,
    pub u: f32,
    pub v: f32,
    pub triangle: u32,
    pub mesh: u32,
    pub instance: u32,
}

impl Hit {
    /// No hit.
    pub const MISS: Hit = Hit { t: f32::INFINITY, u: 0.0, v: 0.0, triangle: NONE, mesh: NONE, instance: NONE };
}

/// Rays in a gather packet.
pub const PACKET_SIZE: usize = 32;

/// Directions of up to [`PACKET_SIZE`] rays with one origin, component by component.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
pub struct Packet {
    pub x: [f32; PACKET_SIZE],
    pub y: [f32; PACKET_SIZE],
    pub z: [f32; PACKET_SIZE],
    /// How many of the directions count, from the first.
    pub count: usize,
}

impl Default for Packet {
    fn default() -> Self {
        Packet { x: [0.0; PACKET_SIZE], y: [0.0; PACKET_SIZE], z: [0.0; PACKET_SIZE], count: 0 }
    }
}

impl Packet {
    /// Adds a direction. The packet must not be full.
    #[inline]
    pub fn push(&mut self, d: Vec3) {
        (self.x[self.count], self.y[self.count], self.z[self.count]) = (d.x, d.y, d.z);
        self.count += 1;
    }
}

/// The tree of a scene, for kernels.
#[derive(Clone, Copy)]
pub(crate) enum TreeView<'a> {
    Whole(&'a Mbvh),
    Compact(View<'a>),
}

/// Work items are handed to threads in blocks of this many rays.
const BLOCK: usize = 1024;

impl Scene {
    /// Closest hits of many rays, in order. `parallel`: spread over the device's threads.
    ///
    /// Consecutive rays of a pinhole camera, with one origin and range, pass the tree together and are several
    /// times as fast as others: best in small square tiles of pixels. Hits are the same, bit for bit.
    pub fn intersect_many(&self, rays: &[Ray], parallel: bool, out: &mut [Hit]) -> Result<()> {
        if rays.len() != out.len() {
            return invalid_argument!("{} rays, but room for {} hits", rays.len(), out.len());
        }
        let block = |rays: &[Ray], out: &mut [Hit]| {
            let mut raw = [RawHit::MISS; 256];
            for (rays, out) in rays.chunks(256).zip(out.chunks_mut(256)) {
                self.intersect_block(rays, &mut raw);
                self.to_hits(&raw, out);
            }
        };
        if parallel {
            self.device()
                .install(|| rays.par_chunks(BLOCK).zip(out.par_chunks_mut(BLOCK)).for_each(|(r, o)| block(r, o)));
        } else {
            block(rays, out);
        }
        Ok(())
    }

    /// Whether each of many rays hits anything, in order: 1 or 0.
    pub fn occluded_many(&self, rays: &[Ray], parallel: bool, out: &mut [u8]) -> Result<()> {
        if rays.len() != out.len() {
            return invalid_argument!("{} rays, but room for {} answers", rays.len(), out.len());
        }
        let block = |rays: &[Ray], out: &mut [u8]| self.occluded_block(rays, out);
        if parallel {
            self.device()
                .install(|| rays.par_chunks(BLOCK).zip(out.par_chunks_mut(BLOCK)).for_each(|(r, o)| block(r, o)));
        } else {
            block(rays, out);
        }
        Ok(())
    }

    /// Closest hits of rays that share an origin, `0 < t ≤ tmax`, in order: those of
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
        let block = |directions: &[[f32; 3]], out: &mut [Hit]| {
            // (Blocks of 128 through `intersect_block` are a fifth slower: it looks for bundles.)
            let mut raw = [RawHit::MISS; PACKET_SIZE];
            for (d, o) in directions.chunks(PACKET_SIZE).zip(out.chunks_mut(PACKET_SIZE)) {
                let mut packet = Packet::default();
                d.iter().for_each(|&d| packet.push(Vec3::from_array(d)));
                self.gather_packet(origin, &packet, 0.0, tmax, &mut raw);
                o.iter_mut().zip(&raw).for_each(|(o, &r)| *o = self.to_hit(r));
            }
        };
        if parallel {
            self.device().install(|| {
                directions.par_chunks(BLOCK).zip(out.par_chunks_mut(BLOCK)).for_each(|(d, o)| block(d, o));
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
        match self.tree() {
            TreeView::Whole(tree) => self.device().kernels().gather(tree, origin, packet, tmin, tmax, out),
            TreeView::Compact(tree) => {
                let count = packet.count.min(PACKET_SIZE);
                let rays: [Ray; PACKET_SIZE] = std::array::from_fn(|i| {
                    Ray::new(origin, Vec3::new(packet.x[i], packet.y[i], packet.z[i])).within(tmin, tmax)
                });
                self.device().kernels().compact_intersect(&tree, &rays[..count], out);
            }
        }
        if self.has_holes() {
            self.leave_holes_of_packet(origin, packet, tmin, tmax, out);
        }
    }

    /// Closest hit with `tmin < t ≤ tmax`, by global triangle number.
    #[inline]
    pub fn intersect_raw(&self, ray: &Ray) -> RawHit {
        let mut hit = [match self.tree() {
            TreeView::Whole(tree) => self.device().kernels().intersect(tree, ray),
            TreeView::Compact(tree) => {
                let mut hit = [RawHit::MISS];
                self.device().kernels().compact_intersect(&tree, std::slice::from_ref(ray), &mut hit);
                hit[0]
            }
        }];
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

    /// Whether anything lies on the ray, holes included.
    #[inline]
    fn anything_on(&self, ray: &Ray) -> bool {
        match self.tree() {
            TreeView::Whole(tree) => self.device().kernels().occluded(tree, ray),
            TreeView::Compact(tree) => {
                let mut occluded = [0];
                self.device().kernels().compact_occluded(&tree, std::slice::from_ref(ray), &mut occluded);
                occluded[0] != 0
            }
        }
    }

    /// Closest hits of as many rays as both slices have.
    pub(crate) fn intersect_block(&self, rays: &[Ray], out: &mut [RawHit]) {
        match self.tree() {
            TreeView::Whole(tree) => self.device().kernels().intersect_block(tree, rays, out),
            TreeView::Compact(tree) => self.device().kernels().compact_intersect(&tree, rays, out),
        }
        if self.has_holes() {
            self.leave_holes(rays, out);
        }
    }

    /// Any hit of as many rays as both slices have: 1 or 0.
    pub(crate) fn occluded_block(&self, rays: &[Ray], out: &mut [u8]) {
        match self.tree() {
            TreeView::Whole(tree) => self.device().kernels().occluded_block(tree, rays, out),
            TreeView::Compact(tree) => self.device().kernels().compact_occluded(&tree, rays, out),
        }
        if self.has_holes() {
            self.look_through_holes(rays, out);
        }
    }

    /// Whether hits may be holes.
    #[inline]
    fn has_holes(&self) -> bool {
        !self.uses().holes.is_empty()
    }
}

#[cfg(test)]
mod tests;
