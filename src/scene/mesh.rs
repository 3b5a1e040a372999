//! Triangle meshes as given by the caller.

use super::MAX_TRIANGLES;
use crate::base::array::Array;
use crate::base::error::{Result, invalid_argument};
use crate::base::geometry::is_valid_triangle;
use crate::base::progress::Progress;
use crate::base::scratch_files::Storage;
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
        self.bytes_of_arrays(|_| true)
    }

    /// Size in bytes of those arrays that lie in files.
    pub(crate) fn mapped_bytes(&self) -> usize {
        self.bytes_of_arrays(|is_mapped| is_mapped)
    }

    /// Sums the sizes of the arrays that count, by whether they lie in files.
    fn bytes_of_arrays(&self, counts: impl Fn(bool) -> bool) -> usize {
        fn size<T>(array: &Array<T>, counts: impl Fn(bool) -> bool) -> usize {
            if counts(array.is_mapped()) { size_of_val(&array[..]) } else { 0 }
        }
        let per_triangle = if let MeshMaterials::PerTriangle(m) = &self.materials { size(m, &counts) } else { 0 };
        let lightmap = self.lightmap.as_ref().map_or(0, |l| size(&l.uvs, &counts) + size(&l.pages, &counts));
        size(&self.positions, &counts)
            + size(&self.indices, &counts)
            + size(&self.normals, &counts)
            + size(&self.uvs, &counts)
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

    /// Moves arrays that are in memory to scratch files, if these are the storage.
    pub(crate) fn move_to(&mut self, storage: Storage, progress: &Progress) -> Result<()> {
        storage.take_in(&mut self.positions, progress)?;
        storage.take_in(&mut self.indices, progress)?;
        storage.take_in(&mut self.normals, progress)?;
        storage.take_in(&mut self.uvs, progress)?;
        if let Some(l) = &mut self.lightmap {
            storage.take_in(&mut l.uvs, progress)?;
            storage.take_in(&mut l.pages, progress)?;
        }
        if let MeshMaterials::PerTriangle(m) = &mut self.materials {
            storage.take_in(m, progress)?;
        }
        Ok(())
    }

    /// Tells the system that rays will read what they need and lies in files here and there.
    pub(super) fn at_random(&self) {
        self.positions.at_random();
        self.indices.at_random();
        self.normals.at_random();
        self.uvs.at_random();
        if let MeshMaterials::PerTriangle(m) = &self.materials {
            m.at_random();
        }
    }

    /// Copies the mesh to `storage`; fails if there is not enough room.
    pub(super) fn copy(&self, storage: Storage) -> Result<Mesh> {
        let (what, none) = ("a copy of a mesh", Progress::none());
        Ok(Mesh {
            positions: storage.copy(&self.positions, what, &none)?,
            indices: storage.copy(&self.indices, what, &none)?,
            normals: storage.copy(&self.normals, what, &none)?,
            uvs: storage.copy(&self.uvs, what, &none)?,
            lightmap: match &self.lightmap {
                Some(l) => Some(LightmapUvs {
                    uvs: storage.copy(&l.uvs, what, &none)?,
                    pages: storage.copy(&l.pages, what, &none)?,
                }),
                None => None,
            },
            materials: match &self.materials {
                MeshMaterials::One(m) => MeshMaterials::One(*m),
                MeshMaterials::PerTriangle(m) => MeshMaterials::PerTriangle(storage.copy(m, what, &none)?),
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
