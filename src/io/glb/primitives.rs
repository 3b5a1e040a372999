//! The triangles of each pair of light map page and material, with their own vertices.

use super::GlbLightmap;
use crate::base::error::Result;
use crate::io::account::Account;
use crate::io::source::Advance;
use crate::scene::Scene;
use glam::{Vec2, Vec3};
use std::collections::{BTreeMap, HashMap};

/// A side of a triangle to write.
pub(super) struct Triangle {
    mesh: u32,
    /// Vertices and light map coordinates of its corners, in the order in which the side is a front.
    vertices: [u32; 3],
    corner_uvs: [[f32; 2]; 3],
    is_back: bool,
}

/// The properties that all triangles of a primitive share.
#[derive(Clone, Copy, Eq, Ord, PartialEq, PartialOrd)]
pub(super) struct Key {
    pub page: u32,
    pub material: u32,
    /// Whether this side alone is to be shown.
    pub one_sided: bool,
    /// Whether the meshes bring normals.
    pub normals: bool,
}

/// The valid triangles of each primitive.
pub(super) fn group(
    scene: &Scene,
    lightmap: &GlbLightmap,
    account: &mut Account,
) -> Result<BTreeMap<Key, Vec<Triangle>>> {
    let mut groups = BTreeMap::<Key, Vec<_>>::new();
    for (m, (mesh, uvs)) in (0..).zip(scene.meshes().iter().zip(&lightmap.meshes)) {
        let first = scene.first_triangle(m);
        let mut backs = uvs.backs.iter().peekable();
        for t in 0..mesh.indices.len() {
            let back = backs.next_if(|back| back.triangle as usize == t);
            if !scene.is_valid(first + t as u32) {
                continue;
            }
            let vertices = mesh.indices[t];
            let mut add = |page, vertices, corner_uvs, is_back| {
                let (material, normals) = (mesh.material(t), !mesh.normals.is_empty());
                let key = Key { page, material, one_sided: back.is_some(), normals };
                let triangle = Triangle { mesh: m, vertices, corner_uvs, is_back };
                account.push(groups.entry(key).or_default(), triangle, "the triangles")
            };
            add(uvs.pages[t], vertices, uvs.corner_uvs[t], false)?;
            if let Some(back) = back {
                let turn = [0, 2, 1];
                add(back.page, turn.map(|i| vertices[i]), turn.map(|i| back.corner_uvs[i]), true)?;
            }
        }
    }
    Ok(groups)
}

/// Indexed triangles with vertices shared by corners of one position and light map coordinate.
#[derive(Default)]
pub(super) struct Primitive {
    pub positions: Vec<Vec3>,
    /// Empty if there are none.
    pub normals: Vec<Vec3>,
    pub uvs: Vec<Vec2>,
    pub lightmap_uvs: Vec<[f32; 2]>,
    pub indices: Vec<u32>,
}

impl Primitive {
    pub(super) fn new(
        scene: &Scene,
        triangles: &[Triangle],
        normals: bool,
        account: &mut Account,
        advance: Advance,
    ) -> Result<Self> {
        let mut result = Primitive { indices: account.list(3 * triangles.len(), "the corners")?, ..Default::default() };
        let mut vertex_of = HashMap::<(u32, u32, [u32; 2], bool), u32>::new();
        for (i, t) in triangles.iter().enumerate() {
            if i.is_multiple_of(1 << 14) {
                advance(0)?;
            }
            let mesh = &scene.meshes()[t.mesh as usize];
            for (&v, &lightmap_uv) in t.vertices.iter().zip(&t.corner_uvs) {
                let key = (t.mesh, v, lightmap_uv.map(f32::to_bits), t.is_back);
                if let Some(vertex) = vertex_of.get(&key) {
                    result.indices.push(*vertex);
                    continue;
                }
                let vertex = result.positions.len() as u32;
                account.make_room_in_map(&mut vertex_of, "the vertices")?;
                vertex_of.insert(key, vertex);
                account.push(&mut result.positions, mesh.positions[v as usize], "the vertices")?;
                if normals {
                    let normal = mesh.normals[v as usize].normalize_or(Vec3::Y);
                    let normal = if t.is_back { -normal } else { normal };
                    account.push(&mut result.normals, normal, "the normals")?;
                }
                let uv = mesh.uvs.get(v as usize).copied().filter(|uv| uv.is_finite()).unwrap_or_default();
                account.push(&mut result.uvs, uv, "the texture coordinates")?;
                account.push(&mut result.lightmap_uvs, lightmap_uv, "the texture coordinates")?;
                result.indices.push(vertex);
            }
        }
        Ok(result)
    }
}
