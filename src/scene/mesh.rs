//! Triangle meshes as given by the caller.

use super::MAX_TRIANGLES;
use crate::base::array::Array;
use crate::base::error::{Result, invalid_argument};
use crate::base::geometry::is_valid_triangle;
use crate::base::memory::try_to_vec;
use glam::{Vec2, Vec3};

/// Assignment of materials to triangles.
#[derive(Clone, Debug, PartialEq)]
pub enum MeshMaterials {
    /// One material for the whole mesh.
    One(u32),
    /// One material per triangle.
    PerTriangle(Array<u32>),
}

/// Light map coordinates given by the caller.
#[derive(Clone, Debug, PartialEq)]
pub struct LightmapUvs {
    /// One coordinate pair per vertex. They should be unique and in [0, 1]; triangles that violate this are counted and
    /// reported when the light map is created, and repaired by unwrapping.
    pub uvs: Array<Vec2>,
    /// Page per triangle; empty: all on page 0.
    pub pages: Array<u32>,
}

/// An indexed triangle mesh, counter-clockwise front faces.
#[derive(Clone, Debug, PartialEq)]
pub struct Mesh {
    /// Vertex positions.
    pub positions: Array<Vec3>,
    /// Three vertices per triangle.
    pub indices: Array<[u32; 3]>,
    /// Shading normals, one per vertex, or empty: the geometric normal is used.
    pub normals: Array<Vec3>,
    /// First texture coordinates, one per vertex, or empty.
    pub uvs: Array<Vec2>,
    /// The caller's light map coordinates, if any.
    pub lightmap: Option<LightmapUvs>,
    /// Materials by number.
    pub materials: MeshMaterials,
    /// Whether to refuse degenerate triangles and non-finite vertices, naming the first, rather than skip and count
    /// them.
    pub strict: bool,
}

impl Default for Mesh {
    fn default() -> Self {
        Mesh {
            positions: Array::default(),
            indices: Array::default(),
            normals: Array::default(),
            uvs: Array::default(),
            lightmap: None,
            materials: MeshMaterials::One(0),
            strict: false,
        }
    }
}

impl Mesh {
    /// The material of `triangle`.
    #[inline]
    pub fn material(&self, triangle: usize) -> u32 {
        match &self.materials {
            MeshMaterials::One(m) => *m,
            MeshMaterials::PerTriangle(m) => m[triangle],
        }
    }

    /// The texture coordinates of a point of `triangle` with weights `u` and `v` of its corners 1 and 2.
    #[inline]
    pub fn texture_coordinates(&self, triangle: usize, u: f32, v: f32) -> Option<Vec2> {
        if self.uvs.is_empty() {
            return None;
        }
        let [a, b, c] = self.indices[triangle].map(|i| self.uvs[i as usize]);
        Some(a + (b - a) * u + (c - a) * v)
    }

    /// Size of the mesh's arrays in bytes.
    pub(super) fn bytes(&self) -> usize {
        let per_triangle = if let MeshMaterials::PerTriangle(m) = &self.materials { size_of_val(&m[..]) } else { 0 };
        let lightmap = self.lightmap.as_ref().map_or(0, |l| size_of_val(&l.uvs[..]) + size_of_val(&l.pages[..]));
        size_of_val(&self.positions[..])
            + size_of_val(&self.indices[..])
            + size_of_val(&self.normals[..])
            + size_of_val(&self.uvs[..])
            + lightmap
            + per_triangle
    }

    /// Frees unused capacity of the arrays: as much again in the worst case, after files are read.
    pub(super) fn shrink_to_fit(&mut self) {
        self.positions.shrink_to_fit();
        self.indices.shrink_to_fit();
        self.normals.shrink_to_fit();
        self.uvs.shrink_to_fit();
        if let Some(l) = &mut self.lightmap {
            l.uvs.shrink_to_fit();
            l.pages.shrink_to_fit();
        }
        if let MeshMaterials::PerTriangle(m) = &mut self.materials {
            m.shrink_to_fit();
        }
    }

    /// Copies the mesh; fails if there is not enough memory.
    pub(super) fn try_clone(&self) -> Result<Mesh> {
        let what = "a copy of a mesh";
        Ok(Mesh {
            positions: try_to_vec(&self.positions, what)?.into(),
            indices: try_to_vec(&self.indices, what)?.into(),
            normals: try_to_vec(&self.normals, what)?.into(),
            uvs: try_to_vec(&self.uvs, what)?.into(),
            lightmap: match &self.lightmap {
                Some(l) => Some(LightmapUvs {
                    uvs: try_to_vec(&l.uvs, what)?.into(),
                    pages: try_to_vec(&l.pages, what)?.into(),
                }),
                None => None,
            },
            materials: match &self.materials {
                MeshMaterials::One(m) => MeshMaterials::One(*m),
                MeshMaterials::PerTriangle(m) => MeshMaterials::PerTriangle(try_to_vec(m, what)?.into()),
            },
            strict: self.strict,
        })
    }

    /// The corners of `triangle`.
    #[inline]
    pub fn corners(&self, triangle: usize) -> [Vec3; 3] {
        // Not by `map`: that writes coordinates to the stack in two pieces and reads them in one, for which the processor waits.
        let [a, b, c] = self.indices[triangle];
        let at = |i: u32| self.positions[i as usize];
        [at(a), at(b), at(c)]
    }

    /// Checks sizes and index ranges, and the vertices if `strict`.
    pub fn validate(&self, material_count: usize) -> Result<()> {
        let vertices = self.positions.len();
        if self.indices.len() > MAX_TRIANGLES {
            return invalid_argument!("the mesh has {} triangles, more than {MAX_TRIANGLES}", self.indices.len());
        }
        for (t, tri) in self.indices.iter().enumerate() {
            if let Some(i) = tri.iter().find(|&&i| i as usize >= vertices) {
                return invalid_argument!("triangle {t} names vertex {i}, the mesh has {vertices}");
            }
        }
        for (name, len) in [("normals", self.normals.len()), ("uvs", self.uvs.len())] {
            if len != 0 && len != vertices {
                return invalid_argument!("{name} has {len} entries for {vertices} vertices");
            }
        }
        if let Some(l) = &self.lightmap {
            if l.uvs.len() != vertices {
                return invalid_argument!("lightmap_uvs has {} entries for {vertices} vertices", l.uvs.len());
            }
            if !l.pages.is_empty() && l.pages.len() != self.indices.len() {
                return invalid_argument!(
                    "lightmap_page has {} entries for {} triangles",
                    l.pages.len(),
                    self.indices.len()
                );
            }
        }
        match &self.materials {
            // Checked for a mesh without triangles too: code that looks the material up need not check for triangles
            // first.
            MeshMaterials::One(m) if *m as usize >= material_count => {
                return invalid_argument!("the mesh names material {m}, the scene has {material_count}");
            }
            MeshMaterials::One(_) => {}
            MeshMaterials::PerTriangle(m) => {
                if m.len() != self.indices.len() {
                    return invalid_argument!(
                        "triangle_materials has {} entries for {} triangles",
                        m.len(),
                        self.indices.len()
                    );
                }
                if let Some((t, m)) = m.iter().enumerate().find(|(_, m)| **m as usize >= material_count) {
                    return invalid_argument!("triangle {t} names material {m}, the scene has {material_count}");
                }
            }
        }
        self.check_positions(&self.positions)
    }

    /// Checks positions that might replace the mesh's own: their number, and their values if `strict`.
    pub(super) fn check_positions(&self, positions: &[Vec3]) -> Result<()> {
        if positions.len() != self.positions.len() {
            let (new, old) = (positions.len(), self.positions.len());
            return invalid_argument!("positions has {new} entries for {old} vertices");
        }
        let corners = |t: usize| self.indices[t].map(|i| positions[i as usize]);
        if self.strict
            && let Some(t) = (0..self.indices.len()).find(|&t| !is_valid_triangle(corners(t)))
        {
            let [a, b, c] = corners(t);
            return invalid_argument!("triangle {t} is degenerate or not finite: {a}, {b}, {c}");
        }
        Ok(())
    }
}
