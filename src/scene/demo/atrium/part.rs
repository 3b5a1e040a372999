//! A mesh under construction, face by face.

use super::measures::{SIDES, inset};
use crate::scene::mesh::{Mesh, MeshMaterials};
use glam::{Vec2, Vec3};
use std::collections::HashMap;
use std::f32::consts::TAU;

/// Choice of the faces that a block has.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Faces {
    All,
    NoBottom,
    Sides,
}

/// Normals of a lathed surface.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Shading {
    /// Smooth round the axis and along the profile.
    Smooth,
    /// Smooth round the axis, hard edges between the profile's pieces.
    Faceted,
}

/// A mesh under construction. Every face is given with the direction that it faces, and is wound to match.
#[derive(Default)]
pub(super) struct Part {
    positions: Vec<Vec3>,
    normals: Vec<Vec3>,
    indices: Vec<[u32; 3]>,
    materials: Vec<u32>,
    /// Vertices by the bits of position and normal: adjacent faces share them.
    known: HashMap<[u32; 6], u32>,
}

impl Part {
    fn vertex(&mut self, position: Vec3, normal: Vec3) -> u32 {
        // Adding zero makes -0 and 0 the same.
        let (p, n) = (position + Vec3::ZERO, normal + Vec3::ZERO);
        let key = [p.x, p.y, p.z, n.x, n.y, n.z].map(f32::to_bits);
        *self.known.entry(key).or_insert_with(|| {
            self.positions.push(p);
            self.normals.push(n);
            self.positions.len() as u32 - 1
        })
    }

    /// Adds a triangle, wound to face as its vertices' normals do. One without area is left out.
    pub(super) fn triangle(&mut self, corners: [(Vec3, Vec3); 3], material: u32) {
        let [(a, na), (b, nb), (c, nc)] = corners;
        let cross = (b - a).as_dvec3().cross((c - a).as_dvec3());
        // Smaller than a hundredth of a square millimetre: the tip of a strip.
        if cross.length() < 1e-8 {
            return;
        }
        let flip = cross.dot((na + nb + nc).as_dvec3()) < 0.0;
        let [i, j, k] = corners.map(|(p, n)| self.vertex(p, n));
        self.indices.push(if flip { [i, k, j] } else { [i, j, k] });
        self.materials.push(material);
    }

    /// Adds a flat quadrilateral that faces `normal`, with its corners in either order round it.
    pub(super) fn quad(&mut self, corners: [Vec3; 4], normal: Vec3, material: u32) {
        let normal = normal.normalize();
        let [a, b, c, d] = corners.map(|p| (p, normal));
        self.triangle([a, b, c], material);
        self.triangle([a, c, d], material);
    }

    /// Adds the band between two polylines of equal length, with a normal per step.
    pub(super) fn strip(&mut self, a: &[Vec3], b: &[Vec3], normals: &[Vec3], material: u32) {
        self.curved_strip(a, b, normals, normals, material);
    }

    /// Adds the band between two polylines of equal length, with a normal per point.
    pub(super) fn curved_strip(&mut self, a: &[Vec3], b: &[Vec3], na: &[Vec3], nb: &[Vec3], material: u32) {
        for i in 0..a.len() - 1 {
            let j = i + 1;
            self.triangle([(a[i], na[i]), (b[i], nb[i]), (b[j], nb[j])], material);
            self.triangle([(a[i], na[i]), (b[j], nb[j]), (a[j], na[j])], material);
        }
    }

    /// A profile of (inset, height) carried round a rectangle with mitred corners. It looks to the
    /// left of the profile's way when inwards is to the left of upwards: upwards along a wall, it
    /// looks inwards.
    pub(super) fn sweep(&mut self, rectangle: Vec2, profile: &[(f32, f32)], material: u32) {
        for side in SIDES {
            for ends in profile.windows(2) {
                let [(d0, y0), (d1, y1)] = [ends[0], ends[1]];
                let at = |end: f32, d: f32, y: f32| {
                    let (distance, half) = side.halves(inset(rectangle, d));
                    side.at(end * half, distance, y)
                };
                let normal = -side.out * (y1 - y0) + Vec3::Y * (d0 - d1);
                self.quad([at(-1.0, d0, y0), at(1.0, d0, y0), at(1.0, d1, y1), at(-1.0, d1, y1)], normal, material);
            }
        }
    }

    /// Adds a flat ring between two rectangles that faces up.
    pub(super) fn ring(&mut self, y: f32, inner: Vec2, outer: Vec2, material: u32) {
        for side in SIDES {
            let at = |end: f32, rectangle: Vec2| {
                let (distance, half) = side.halves(rectangle);
                side.at(end * half, distance, y)
            };
            self.quad([at(-1.0, inner), at(1.0, inner), at(1.0, outer), at(-1.0, outer)], Vec3::Y, material);
        }
    }

    /// Adds an upright box around an axis.
    pub(super) fn block(&mut self, axis: Vec2, half: Vec2, y0: f32, y1: f32, faces: Faces, material: u32) {
        let at = |x: f32, z: f32, y: f32| Vec3::new(axis.x + half.x * x, y, axis.y + half.y * z);
        for (x, z) in [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)] {
            let normal = Vec3::new(x, 0.0, z);
            let [(x0, z0), (x1, z1)] = [(x - z, z - x), (x + z, z + x)];
            self.quad([at(x0, z0, y0), at(x1, z1, y0), at(x1, z1, y1), at(x0, z0, y1)], normal, material);
        }
        let square = |y: f32| [at(-1.0, -1.0, y), at(1.0, -1.0, y), at(1.0, 1.0, y), at(-1.0, 1.0, y)];
        if faces != Faces::Sides {
            self.quad(square(y1), Vec3::Y, material);
        }
        if faces == Faces::All {
            self.quad(square(y0), Vec3::NEG_Y, material);
        }
    }

    /// A profile of (radius, height) turned round a vertical axis. It looks outwards where the
    /// profile runs upwards, and up where it runs inwards.
    pub(super) fn lathe(&mut self, axis: Vec2, profile: &[[f32; 2]], segments: usize, material: u32, shading: Shading) {
        let along = |a: [f32; 2], b: [f32; 2]| Vec2::new(b[1] - a[1], a[0] - b[0]).normalize();
        let last = profile.len() - 1;
        // Normals (outward, up) at both ends of each piece of the profile.
        let normals = |i: usize| {
            let flat = along(profile[i], profile[i + 1]);
            if shading == Shading::Faceted {
                return [flat, flat];
            }
            let at = |k: usize| {
                let before = if k > 0 { along(profile[k - 1], profile[k]) } else { flat };
                let after = if k < last { along(profile[k], profile[k + 1]) } else { flat };
                (before + after).normalize()
            };
            [at(i), at(i + 1)]
        };
        let directions: Vec<Vec2> = (0..=segments)
            .map(|s| {
                let (sin, cos) = (TAU * (s % segments) as f32 / segments as f32).sin_cos();
                Vec2::new(cos, sin)
            })
            .collect();
        for i in 0..last {
            let [n0, n1] = normals(i);
            let row = |[r, y]: [f32; 2], n: Vec2| -> (Vec<Vec3>, Vec<Vec3>) {
                let turn =
                    |d: &Vec2| (Vec3::new(axis.x + r * d.x, y, axis.y + r * d.y), Vec3::new(n.x * d.x, n.y, n.x * d.y));
                directions.iter().map(turn).unzip()
            };
            let ((a, na), (b, nb)) = (row(profile[i], n0), row(profile[i + 1], n1));
            self.curved_strip(&a, &b, &na, &nb, material);
        }
    }

    pub(super) fn into_mesh(self) -> Mesh {
        Mesh {
            positions: self.positions.into(),
            normals: self.normals.into(),
            indices: self.indices.into(),
            materials: MeshMaterials::PerTriangle(self.materials.into()),
            strict: true,
            ..Default::default()
        }
    }
}
