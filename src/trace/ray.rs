//! Rays, packets of them, and hits.

use crate::base::geometry::NONE;
use bytemuck::{Pod, Zeroable};
use glam::Vec3;

/// A ray: points `origin + t · direction` with `tmin < t ≤ tmax`. The direction need not be
/// normalised. A ray with a NaN, an origin beyond 1e18 or a zero direction hits nothing.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Ray {
    /// Origin, in scene units.
    pub origin: [f32; 3],
    /// Lower limit of t, exclusive, in multiples of the direction's length.
    pub tmin: f32,
    /// Direction, of any length but 0.
    pub direction: [f32; 3],
    /// Upper limit of t, inclusive; may be infinite.
    pub tmax: f32,
}

impl Ray {
    /// The ray from `origin` along `direction` with `0 < t`.
    pub fn new(origin: Vec3, direction: Vec3) -> Self {
        Ray { origin: origin.to_array(), tmin: 0.0, direction: direction.to_array(), tmax: f32::INFINITY }
    }

    /// Restricts the ray to `tmin < t ≤ tmax`.
    pub fn within(self, tmin: f32, tmax: f32) -> Self {
        Ray { tmin, tmax, ..self }
    }
}

/// A hit by global triangle number, as kernels report it. A miss has `t = +inf` and triangle [`NONE`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RawHit {
    /// Distance in multiples of the direction's length.
    pub t: f32,
    /// Barycentric weight of vertex 1.
    pub u: f32,
    /// Barycentric weight of vertex 2.
    pub v: f32,
    /// Global triangle number.
    pub triangle: u32,
    /// Whether the ray hit the front, on which the corners go round counter-clockwise.
    pub front: bool,
}

impl RawHit {
    /// A miss.
    pub const MISS: RawHit = RawHit { t: f32::INFINITY, u: 0.0, v: 0.0, triangle: NONE, front: false };

    /// Whether nothing was hit.
    #[inline]
    pub fn is_miss(&self) -> bool {
        self.triangle == NONE
    }
}

/// A hit by mesh and triangle, as callers get it.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Hit {
    /// Distance in multiples of the direction's length.
    pub t: f32,
    /// Barycentric weight of vertex 1.
    pub u: f32,
    /// Barycentric weight of vertex 2.
    pub v: f32,
    /// Number of the triangle in its mesh.
    pub triangle: u32,
    /// Number of the mesh.
    pub mesh: u32,
    /// Number of the instance: always [`NONE`], as scenes have no instances yet.
    pub instance: u32,
}

impl Hit {
    /// A miss.
    pub const MISS: Hit = Hit { t: f32::INFINITY, u: 0.0, v: 0.0, triangle: NONE, mesh: NONE, instance: NONE };
}

/// Maximum number of rays in a gather packet.
pub const PACKET_SIZE: usize = 32;

/// Directions of up to [`PACKET_SIZE`] rays with one origin, component by component.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
pub struct Packet {
    /// Components along x.
    pub x: [f32; PACKET_SIZE],
    /// Components along y.
    pub y: [f32; PACKET_SIZE],
    /// Components along z.
    pub z: [f32; PACKET_SIZE],
    /// Number of valid directions, counted from the first.
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
