//! Primitives as meshes: triangles, vertices in use, transforms.

use super::materials::lightmap_texture;
use super::{PART, Reader};
use crate::base::error::Result;
use crate::io::is_valid_position;
use crate::scene::{LightmapUvs, Mesh, MeshMaterials, NONE};
use glam::{DMat3, DMat4, DVec3, Vec2, Vec3};
use gltf::mesh::{Mode, Semantic};

impl Reader<'_, '_> {
    /// Adds a primitive as a mesh. `unique`: no other node shows it.
    pub(super) fn add_primitive(&mut self, primitive: &gltf::Primitive, transform: &DMat4, unique: bool) -> Result<()> {
        let mode = primitive.mode();
        if !matches!(mode, Mode::Triangles | Mode::TriangleStrip | Mode::TriangleFan) {
            self.skipped_primitives += 1;
            return Ok(());
        }
        let Some(accessor) = primitive.get(&Semantic::Positions) else { return self.malformed("it has no positions") };
        let positions = self.column::<3>(&accessor)?;
        let vertices = positions.count;
        let corners = match primitive.indices() {
            Some(indices) => self.indices(&indices, vertices)?,
            None => {
                let count = u32::try_from(vertices).or_else(|_| self.malformed("it has too many vertices"))?;
                let mut corners = self.import.account.list(vertices, "the corners")?;
                corners.extend(0..count);
                corners
            }
        };
        let count = match triangle_count(mode, corners.len()) {
            Some(count) => count,
            None => return self.malformed(format_args!("{} vertices do not make triangles", corners.len())),
        };
        self.triangles += count;
        self.import.check_triangle_count(self.triangles)?;
        let mut indices = self.import.account.list(count, "the triangles")?;
        add_triangles(mode, &corners, &mut indices);
        self.import.account.give_back(4 * corners.capacity());
        drop(corners);
        if transform.determinant() < 0.0 {
            indices.iter_mut().for_each(|t| t.swap(1, 2));
        }
        let used = self.keep_used(&mut indices, vertices)?;
        let mut mesh = Mesh { indices: indices.into(), positions: self.room(&used)?.into(), ..Default::default() };
        for part in used.chunks(PART) {
            self.import.check()?;
            for &v in part {
                let position = transform.transform_point3(Vec3::from(positions.get(v)).as_dvec3()).as_vec3();
                if !is_valid_position(position) {
                    return self.malformed(format_args!("vertex {v} is {position}, not finite or out of range"));
                }
                mesh.positions.as_vec().push(position);
            }
        }
        mesh.normals = self.normals(primitive, transform, &used, vertices)?.into();
        mesh.uvs = self.uvs(primitive, 0, &used, vertices)?.into();
        let material = primitive.material();
        let lightmap_uvs = if unique { self.uvs(primitive, 1, &used, vertices)? } else { Vec::new() };
        self.import.account.give_back(4 * used.capacity());
        if !lightmap_uvs.is_empty() {
            let page = lightmap_texture(&material).and_then(|t| self.pages.get(&t)).copied().unwrap_or(0);
            let mut pages = Vec::new();
            if page != 0 {
                pages = self.import.account.list(mesh.indices.len(), "the light map pages")?;
                pages.resize(mesh.indices.len(), page);
            }
            mesh.lightmap = Some(LightmapUvs { uvs: lightmap_uvs.into(), pages: pages.into() });
        }
        let material = self.material(&material)?;
        if material == NONE {
            self.invisible_primitives += 1;
            return Ok(());
        }
        mesh.materials = MeshMaterials::One(material);
        match mesh.indices.is_empty() {
            true => Ok(()),
            false => self.import.add_mesh(mesh),
        }
    }

    /// An empty list with capacity for a value of each used vertex.
    fn room<T>(&mut self, used: &[u32]) -> Result<Vec<T>> {
        self.import.account.list(used.len(), "the vertices")
    }

    /// Renumbers vertices so that only used ones remain, in their order, and returns their old numbers.
    fn keep_used(&mut self, triangles: &mut [[u32; 3]], vertices: usize) -> Result<Vec<u32>> {
        if self.number.len() < vertices {
            let more = vertices - self.number.len();
            self.import.account.make_room(&mut self.number, more, "the vertices")?;
            self.number.resize(vertices, NONE);
        }
        let mut used = self.import.account.list(vertices.min(3 * triangles.len()), "the vertices")?;
        for &v in triangles.iter().flatten() {
            if std::mem::replace(&mut self.number[v as usize], 0) == NONE {
                used.push(v);
            }
        }
        used.sort_unstable();
        used.iter().zip(0..).for_each(|(&v, new)| self.number[v as usize] = new);
        triangles.iter_mut().flatten().for_each(|v| *v = self.number[*v as usize]);
        used.iter().for_each(|&v| self.number[v as usize] = NONE);
        Ok(used)
    }

    fn normals(
        &mut self,
        primitive: &gltf::Primitive,
        transform: &DMat4,
        used: &[u32],
        vertices: usize,
    ) -> Result<Vec<Vec3>> {
        let Some(accessor) = primitive.get(&Semantic::Normals) else { return Ok(Vec::new()) };
        let normals = self.column::<3>(&accessor)?;
        if normals.count != vertices {
            return self.malformed(format_args!("it has {} normals for {vertices} vertices", normals.count));
        }
        // The cofactor matrix: the inverse transpose without the division by the determinant. Its
        // sign turns normals round where the winding is turned too.
        let m = DMat3::from_mat4(*transform);
        let flip = if m.determinant() < 0.0 { -1.0 } else { 1.0 };
        let cofactors =
            DMat3::from_cols(m.y_axis.cross(m.z_axis), m.z_axis.cross(m.x_axis), m.x_axis.cross(m.y_axis)) * flip;
        let turn = |n: [f32; 3]| -> DVec3 { (cofactors * Vec3::from(n).as_dvec3()).normalize_or_zero() };
        let mut turned = self.room(used)?;
        for part in used.chunks(PART) {
            self.import.check()?;
            turned.extend(part.iter().map(|&v| turn(normals.get(v)).as_vec3()));
        }
        Ok(turned)
    }

    /// Texture coordinates of the used vertices; empty if there are none.
    fn uvs(&mut self, primitive: &gltf::Primitive, set: u32, used: &[u32], vertices: usize) -> Result<Vec<Vec2>> {
        let Some(accessor) = primitive.get(&Semantic::TexCoords(set)) else { return Ok(Vec::new()) };
        let column = self.column::<2>(&accessor)?;
        if column.count != vertices {
            return self.malformed(format_args!("TEXCOORD_{set} has {} entries for {vertices} vertices", column.count));
        }
        let mut uvs = self.room(used)?;
        for part in used.chunks(PART) {
            self.import.check()?;
            uvs.extend(part.iter().map(|&v| Vec2::from(column.get(v))));
        }
        match used.iter().zip(&uvs).find(|(_, uv)| !uv.is_finite()) {
            Some((v, _)) => self.malformed(format_args!("TEXCOORD_{set} of vertex {v} is not finite")),
            None => Ok(uvs),
        }
    }
}

/// Number of triangles that a list of vertices makes (glTF 2.0, 3.7.2.1); `None` if it is too short.
fn triangle_count(mode: Mode, corners: usize) -> Option<usize> {
    match mode {
        _ if corners < 3 => None,
        Mode::TriangleStrip | Mode::TriangleFan => Some(corners - 2),
        _ => corners.is_multiple_of(3).then_some(corners / 3),
    }
}

/// Appends the triangles that a list of vertices makes.
fn add_triangles(mode: Mode, corners: &[u32], triangles: &mut Vec<[u32; 3]>) {
    match mode {
        Mode::TriangleStrip => {
            let ordered = |(i, w): (usize, &[u32])| if i % 2 == 0 { [w[0], w[1], w[2]] } else { [w[0], w[2], w[1]] };
            triangles.extend(corners.windows(3).enumerate().map(ordered));
        }
        Mode::TriangleFan => triangles.extend(corners[1..].windows(2).map(|w| [corners[0], w[0], w[1]])),
        _ => triangles.extend_from_slice(corners.as_chunks::<3>().0),
    }
}
