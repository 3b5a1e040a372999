//! Closed meshes over regular grids, for scenes of millions of triangles: vertices have numbers by formula, so that
//! nothing is held beside the mesh itself.
//!
//! Invariant: every edge is used by two triangles, once in each direction.

use crate::base::error::Result;
use crate::base::memory::{try_filled, try_with_capacity};
use crate::scene::mesh::{Mesh, MeshMaterials};
use glam::Vec3;

const MESH: &str = "a built-in scene";

/// A mesh that takes triangles up to a number known before.
pub(super) struct Counted {
    positions: Vec<Vec3>,
    indices: Vec<[u32; 3]>,
}

impl Counted {
    /// Makes room for a mesh; all vertices are at the origin until they are placed.
    pub(super) fn new(vertices: usize, triangles: usize) -> Result<Counted> {
        Ok(Counted { positions: try_filled(vertices, Vec3::ZERO, MESH)?, indices: try_with_capacity(triangles, MESH)? })
    }

    fn place(&mut self, vertex: u32, position: Vec3) -> u32 {
        self.positions[vertex as usize] = position;
        vertex
    }

    /// Adds two triangles, counter-clockwise from their front, divided from corner 0 to corner 2.
    pub(super) fn quad(&mut self, [a, b, c, d]: [u32; 4]) {
        self.indices.extend([[a, b, c], [a, c, d]]);
    }

    pub(super) fn finish(self, material: u32) -> Mesh {
        let Counted { positions, indices } = self;
        Mesh {
            positions: positions.into(),
            indices: indices.into(),
            materials: MeshMaterials::One(material),
            ..Default::default()
        }
    }
}

/// Makes a box that looks inward, its sides divided into squares: `cells` of them along each axis, with the points of
/// the lattice where `position` puts them.
pub(super) fn room(cells: [u32; 3], material: u32, position: impl Fn([u32; 3]) -> Vec3) -> Result<Mesh> {
    let [a, b, c] = cells;
    // Points of a whole layer at the bottom and the top, and of the ring around each layer between.
    let (layer, ring) = ((a + 1) * (c + 1), 2 * (a + c));
    let vertex = |[i, j, k]: [u32; 3]| match j {
        0 => k * (a + 1) + i,
        j if j == b => layer + (b - 1) * ring + k * (a + 1) + i,
        j => {
            let around = match (i, k) {
                (i, 0) => i,
                (i, k) if i == a => a + k,
                (i, k) if k == c => a + c + (a - i),
                (_, k) => 2 * a + c + (c - k),
            };
            layer + (j - 1) * ring + around
        }
    };
    let quads = a * b + b * c + c * a;
    let mut mesh = Counted::new((2 * layer + (b - 1) * ring) as usize, 4 * quads as usize)?;
    for axis in 0..3 {
        // u × v points along the axis.
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        for side in [0, cells[axis]] {
            for j in 0..cells[v] {
                for i in 0..cells[u] {
                    let mut corners = [[0, 0], [1, 0], [1, 1], [0, 1]].map(|[du, dv]| {
                        let mut point = [0; 3];
                        (point[axis], point[u], point[v]) = (side, i + du, j + dv);
                        mesh.place(vertex(point), position(point))
                    });
                    if side != 0 {
                        corners.reverse();
                    }
                    mesh.quad(corners);
                }
            }
        }
    }
    Ok(mesh.finish(material))
}

/// Makes a body around an upright axis, looking outward: `around` × `along` quads as its side, with the points where
/// `position` puts them, and fans to the points `ends` at the bottom and the top.
pub(super) fn lathe(
    [around, along]: [u32; 2],
    ends: [Vec3; 2],
    material: u32,
    position: impl Fn(u32, u32) -> Vec3,
) -> Result<Mesh> {
    let rings = around * (along + 1);
    let mut mesh = Counted::new(rings as usize + 2, lathe_triangles([around, along]))?;
    let bottom = mesh.place(rings, ends[0]);
    let top = mesh.place(rings + 1, ends[1]);
    for j in 0..=along {
        for i in 0..around {
            mesh.place(j * around + i, position(i, j));
        }
    }
    for i in 0..around {
        let next = (i + 1) % around;
        for j in 0..along {
            // From above the numbers go around clockwise.
            mesh.quad([j * around + i, (j + 1) * around + i, (j + 1) * around + next, j * around + next]);
        }
        mesh.indices.push([bottom, i, next]);
        mesh.indices.push([top, along * around + next, along * around + i]);
    }
    Ok(mesh.finish(material))
}

/// Number of triangles of a [`lathe`].
pub(super) fn lathe_triangles([around, along]: [u32; 2]) -> usize {
    2 * around as usize * (along as usize + 1)
}
