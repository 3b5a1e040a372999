//! Shapes for the built-in scenes and the tests.
//!
//! A [`MeshBuilder`] collects triangles with a material each and welds corners at equal positions,
//! so that a closed shape becomes a closed mesh: every edge is used by two triangles, once in each
//! direction. Quads are given counter-clockwise as seen from their front.

use crate::scene::mesh::{Mesh, MeshMaterials};
use glam::{DVec3, Vec3};
use std::collections::HashMap;
use std::f64::consts::{PI, TAU};

/// Collects shapes into one mesh.
#[derive(Clone, Debug, Default)]
pub struct MeshBuilder {
    positions: Vec<Vec3>,
    indices: Vec<[u32; 3]>,
    materials: Vec<u32>,
    /// Vertex by the bits of its position; only looked up, never iterated.
    vertex_at: HashMap<[u32; 3], u32>,
}

impl MeshBuilder {
    /// No triangles yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// The mesh. Its materials are those that the shapes were given.
    pub fn finish(self) -> Mesh {
        Mesh {
            positions: self.positions.into(),
            indices: self.indices.into(),
            materials: MeshMaterials::PerTriangle(self.materials.into()),
            ..Default::default()
        }
    }

    /// Triangles so far.
    pub fn triangle_count(&self) -> usize {
        self.indices.len()
    }

    fn vertex(&mut self, position: Vec3) -> u32 {
        // Adding 0 turns −0 into 0: they are the same place.
        let position = position + Vec3::ZERO;
        let next = self.positions.len() as u32;
        let vertex = *self.vertex_at.entry(position.to_array().map(f32::to_bits)).or_insert(next);
        if vertex == next {
            self.positions.push(position);
        }
        vertex
    }

    /// A triangle, counter-clockwise from its front. Nothing if two corners are the same.
    pub fn triangle(&mut self, a: Vec3, b: Vec3, c: Vec3, material: u32) {
        let [a, b, c] = [a, b, c].map(|p| self.vertex(p));
        if a != b && b != c && c != a {
            self.indices.push([a, b, c]);
            self.materials.push(material);
        }
    }

    /// Two triangles, divided from `a` to `c`.
    pub fn quad(&mut self, a: Vec3, b: Vec3, c: Vec3, d: Vec3, material: u32) {
        self.triangle(a, b, c, material);
        self.triangle(a, c, d, material);
    }

    /// The sheet `point(u, v)`, u and v in [0, 1], as `nu` × `nv` quads. Its front is where
    /// ∂point/∂u × ∂point/∂v points to.
    pub fn sheet(&mut self, nu: u32, nv: u32, material: u32, point: impl Fn(f32, f32) -> Vec3) {
        let at = |i: u32, j: u32| point(i as f32 / nu as f32, j as f32 / nv as f32);
        for j in 0..nv {
            for i in 0..nu {
                self.quad(at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1), material);
            }
        }
    }

    /// A quad divided into `nu` (from `a` to `b`) × `nv` (from `a` to `d`) quads.
    #[allow(clippy::too_many_arguments)]
    pub fn grid_quad(&mut self, a: Vec3, b: Vec3, c: Vec3, d: Vec3, nu: u32, nv: u32, material: u32) {
        // Exact at both ends, so that grids with a common side, run along in the same direction, weld.
        let mix = |p: Vec3, q: Vec3, t: f32| if t == 1.0 { q } else { p + (q - p) * t };
        self.sheet(nu, nv, material, |u, v| mix(mix(a, b, u), mix(d, c, u), v));
    }

    /// A body with six quads as faces. Bit 0, 1 and 2 of a corner's number choose its side along
    /// three directions that form a right-handed system. The faces look outward, or `inward`.
    pub fn hexahedron(&mut self, corners: [Vec3; 8], inward: bool, material: u32) {
        const FACES: [[usize; 4]; 6] =
            [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        for face in FACES {
            let [a, b, c, d] = face.map(|i| corners[i]);
            if inward {
                self.quad(a, d, c, b, material);
            } else {
                self.quad(a, b, c, d, material);
            }
        }
    }

    /// The axis-aligned box from `lower` to `upper`, its faces looking outward, or `inward`.
    pub fn box_(&mut self, lower: Vec3, upper: Vec3, inward: bool, material: u32) {
        let side = |bit: usize, axis: usize| if bit & 1 == 1 { upper[axis] } else { lower[axis] };
        let corner = |i: usize| Vec3::new(side(i, 0), side(i >> 1, 1), side(i >> 2, 2));
        self.hexahedron(std::array::from_fn(corner), inward, material);
    }

    /// A body of revolution around the line from `base` along `axis` (any length but 0): `profile`
    /// lists (height along the axis, radius) from the bottom up, `segments` ≥ 3 go around. It looks
    /// outward, and is closed if the profile starts and ends with radius 0.
    pub fn revolve(&mut self, base: Vec3, axis: Vec3, profile: &[(f32, f32)], segments: u32, material: u32) {
        let axis = axis.as_dvec3().normalize();
        let (x, y) = axis.any_orthonormal_pair();
        let point = |(height, radius): (f32, f32), s: u32| {
            let angle = TAU * (s % segments) as f64 / segments as f64;
            let around = x * angle.cos() + y * angle.sin();
            (base.as_dvec3() + axis * height as f64 + around * radius as f64).as_vec3()
        };
        for ring in profile.windows(2) {
            for s in 0..segments {
                let [a, b, c, d] = [point(ring[0], s), point(ring[0], s + 1), point(ring[1], s + 1), point(ring[1], s)];
                self.quad(a, b, c, d, material);
            }
        }
    }

    /// A cylinder from `base` to `base + axis`, its side divided into `segments` around and `rings`
    /// along, looking outward; with `caps` it is closed.
    #[allow(clippy::too_many_arguments)]
    pub fn cylinder(
        &mut self,
        base: Vec3,
        axis: Vec3,
        radius: f32,
        segments: u32,
        rings: u32,
        caps: bool,
        material: u32,
    ) {
        let height = axis.as_dvec3().length() as f32;
        let mut profile: Vec<(f32, f32)> = (0..=rings).map(|i| (height * (i as f32 / rings as f32), radius)).collect();
        if caps {
            profile.insert(0, (0.0, 0.0));
            profile.push((height, 0.0));
        }
        self.revolve(base, axis, &profile, segments, material);
    }

    /// The block above a round-arched opening: `left` is the springing point where the opening
    /// begins, `span` the vector across it, `rise` (perpendicular to `span`, longer than half of it)
    /// reaches to the top of the block, `depth` through the wall; `span`, `rise`, −`depth` form a
    /// right-handed system, so that the front looks against `depth`. Closed, `segments` along the arc.
    pub fn arch(&mut self, left: Vec3, span: Vec3, rise: Vec3, depth: Vec3, segments: u32, material: u32) {
        let (left, span, depth) = (left.as_dvec3(), span.as_dvec3(), depth.as_dvec3());
        let (rise, up) = (rise.as_dvec3(), rise.as_dvec3().normalize());
        let point = |p: DVec3, back: bool| (left + p + if back { depth } else { DVec3::ZERO }).as_vec3();
        // The ends are exact so that the arch welds to what it stands on.
        let arc = |i: u32| match i {
            0 => (0.0, 0.0),
            i if i == segments => (1.0, 0.0),
            i => {
                let angle = PI * i as f64 / segments as f64;
                (0.5 - 0.5 * angle.cos(), 0.5 * angle.sin())
            }
        };
        let low = |i: u32, back| point(span * arc(i).0 + up * span.length() * arc(i).1, back);
        let high = |i: u32, back| point(span * arc(i).0 + rise, back);
        for i in 0..segments {
            let j = i + 1;
            self.quad(low(i, false), low(j, false), high(j, false), high(i, false), material);
            self.quad(low(j, true), low(i, true), high(i, true), high(j, true), material);
            self.quad(low(i, true), low(j, true), low(j, false), low(i, false), material);
            self.quad(high(i, false), high(j, false), high(j, true), high(i, true), material);
        }
        let n = segments;
        self.quad(low(0, true), low(0, false), high(0, false), high(0, true), material);
        self.quad(low(n, false), low(n, true), high(n, true), high(n, false), material);
    }

    /// A sphere: an icosahedron whose triangles are divided into four `subdivisions` times
    /// (20 · 4^subdivisions triangles). Closed, looking outward.
    pub fn sphere(&mut self, center: Vec3, radius: f32, subdivisions: u32, material: u32) {
        let place = |p: DVec3| (center.as_dvec3() + p * radius as f64).as_vec3();
        for [a, b, c] in icosphere(subdivisions) {
            self.triangle(place(a), place(b), place(c), material);
        }
    }
}

/// The triangles of a unit icosphere.
fn icosphere(subdivisions: u32) -> Vec<[DVec3; 3]> {
    let golden = (1.0 + 5f64.sqrt()) / 2.0;
    // Corners ±1, ±φ on the three coordinate planes.
    let corner = |i: usize| {
        let (s, t) = (1.0 - 2.0 * (i & 1) as f64, golden * (1.0 - (i & 2) as f64));
        match i / 4 {
            0 => DVec3::new(s, t, 0.0),
            1 => DVec3::new(0.0, s, t),
            _ => DVec3::new(t, 0.0, s),
        }
        .normalize()
    };
    // A face is three corners at the edge length from each other; its winding is put outward.
    let corners: [DVec3; 12] = std::array::from_fn(corner);
    let near = |a: DVec3, b: DVec3| a.dot(b) > 0.4;
    let mut triangles = Vec::new();
    for (i, &a) in corners.iter().enumerate() {
        for (j, &b) in corners.iter().enumerate().skip(i + 1) {
            for &c in corners.iter().skip(j + 1) {
                if near(a, b) && near(b, c) && near(c, a) {
                    let outward = (b - a).cross(c - a).dot(a) > 0.0;
                    triangles.push(if outward { [a, b, c] } else { [a, c, b] });
                }
            }
        }
    }
    for _ in 0..subdivisions {
        triangles = triangles
            .into_iter()
            .flat_map(|[a, b, c]| {
                let [ab, bc, ca] = [a + b, b + c, c + a].map(DVec3::normalize);
                [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
            })
            .collect();
    }
    triangles
}

/// Volume enclosed by a mesh, by the divergence theorem: positive if its faces look outward;
/// `None` if it is not closed. Vertices count as equal by number.
#[cfg(test)]
pub(crate) fn enclosed_volume(mesh: &Mesh) -> Option<f64> {
    let mut edges: Vec<(u32, u32)> = mesh.indices.iter().flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)]).collect();
    let mut reversed: Vec<(u32, u32)> = edges.iter().map(|&(a, b)| (b, a)).collect();
    edges.sort_unstable();
    reversed.sort_unstable();
    let once = edges.windows(2).all(|w| w[0] != w[1]);
    let volume = |t: usize| {
        let [a, b, c] = mesh.corners(t).map(Vec3::as_dvec3);
        a.dot(b.cross(c)) / 6.0
    };
    (once && edges == reversed).then(|| (0..mesh.indices.len()).map(volume).sum())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::is_valid_triangle;

    /// The volume that `build` encloses; fails if the mesh is open or has degenerate triangles.
    fn volume(build: impl Fn(&mut MeshBuilder)) -> f64 {
        let mut b = MeshBuilder::new();
        build(&mut b);
        let mesh = b.finish();
        assert!((0..mesh.indices.len()).all(|t| is_valid_triangle(mesh.corners(t))));
        enclosed_volume(&mesh).expect("the mesh is not closed")
    }

    fn assert_near(a: f64, b: f64) {
        assert!((a - b).abs() < 1e-5 * b.abs(), "{a} is not {b}");
    }

    #[test]
    fn a_box_is_closed_and_looks_where_it_is_told() {
        let (lower, upper) = (Vec3::new(-1.0, 2.0, 3.0), Vec3::new(1.5, 3.0, 5.0));
        assert_near(volume(|b| b.box_(lower, upper, false, 0)), 5.0);
        assert_near(volume(|b| b.box_(lower, upper, true, 0)), -5.0);
    }

    #[test]
    fn a_capped_cylinder_is_closed_and_looks_outward() {
        let axis = Vec3::new(1.0, 2.0, -2.0);
        let polygon = 0.5 * 12.0 * (TAU / 12.0).sin() * 0.25;
        let build = |b: &mut MeshBuilder| b.cylinder(Vec3::new(4.0, 5.0, 6.0), axis, 0.5, 12, 4, true, 0);
        assert_near(volume(build), 3.0 * polygon);
    }

    #[test]
    fn an_arch_is_closed_and_encloses_the_wall_without_the_opening() {
        let (span, rise, depth) = (Vec3::new(0.0, 0.0, 2.0), Vec3::new(0.0, 1.5, 0.0), Vec3::new(0.4, 0.0, 0.0));
        let opening = 0.5 * 16.0 * (PI / 16.0).sin();
        let right_handed = span.cross(rise).dot(-depth) > 0.0;
        assert!(right_handed);
        assert_near(volume(|b| b.arch(Vec3::new(1.0, 2.0, 3.0), span, rise, depth, 16, 0)), (3.0 - opening) * 0.4);
    }

    #[test]
    fn a_sphere_is_closed_welded_and_looks_outward() {
        for n in 0..5 {
            let mut b = MeshBuilder::new();
            b.sphere(Vec3::new(10.0, -3.0, 0.25), 2.0, n, 0);
            let mesh = b.finish();
            assert_eq!(mesh.indices.len(), 20 << (2 * n));
            assert_eq!(mesh.positions.len(), 2 + (10 << (2 * n)), "Euler: V = 2 + F/2");
            for t in 0..mesh.indices.len() {
                let [a, b, c] = mesh.corners(t);
                assert!((b - a).cross(c - a).dot(a - Vec3::new(10.0, -3.0, 0.25)) > 0.0);
            }
            assert!(enclosed_volume(&mesh).is_some());
        }
        assert!((volume(|b| b.sphere(Vec3::ZERO, 1.0, 5, 0)) - 4.0 / 3.0 * PI).abs() < 0.01);
    }

    #[test]
    fn grids_with_a_common_side_weld() {
        let mut b = MeshBuilder::new();
        let p = |x: f32, y: f32| Vec3::new(x, y, x * 0.3 + y * 0.7);
        b.grid_quad(p(0.1, 0.2), p(1.3, 0.2), p(1.3, 2.7), p(0.1, 2.7), 3, 5, 0);
        b.grid_quad(p(1.3, 0.2), p(2.9, 0.2), p(2.9, 2.7), p(1.3, 2.7), 4, 5, 0);
        let mesh = b.finish();
        assert_eq!(mesh.indices.len(), 2 * 7 * 5);
        assert_eq!(mesh.positions.len(), 8 * 6);
    }
}
