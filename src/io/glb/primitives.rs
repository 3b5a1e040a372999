//! The triangles of each pair of light map page and material, with their own vertices.

use super::Places;
use crate::base::error::Result;
use crate::io::account::Account;
use crate::io::source::Advance;
use crate::scene::Scene;
use glam::{Vec2, Vec3};
use std::collections::{BTreeMap, HashMap};

/// A side of a triangle to write: its global number (28 bits), and [`BACK`].
#[derive(Clone, Copy)]
pub(super) struct Side(u32);

const BACK: u32 = 1 << 31;

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

/// The sides of valid triangles of each page and material.
pub(super) fn group(
    scene: &Scene,
    places: &impl Places,
    account: &mut Account,
    advance: Advance,
) -> Result<BTreeMap<Key, Vec<Side>>> {
    let mut groups = BTreeMap::<Key, Vec<_>>::new();
    for m in 0..scene.object_count() {
        let (mesh, triangles) = (scene.object(m).mesh(), scene.triangles_of(m));
        let first = triangles.start;
        let normals = !mesh.normals.is_empty();
        for t in 0..triangles.len() as u32 {
            if t.is_multiple_of(1 << 14) {
                advance(0)?;
            }
            if !scene.is_valid(first + t) {
                continue;
            }
            let back = places.back(m, t, first + t);
            let mut add = |page, side| {
                let key = Key { page, material: mesh.material(t as usize), one_sided: back.is_some(), normals };
                account.push(groups.entry(key).or_default(), Side(side), "the triangles")
            };
            add(places.front(m, t, first + t).1, first + t)?;
            if let Some((_, page)) = back {
                add(page, (first + t) | BACK)?;
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
        places: &impl Places,
        sides: &[Side],
        normals: bool,
        account: &mut Account,
        advance: Advance,
    ) -> Result<Self> {
        let mut result = Primitive { indices: account.list(3 * sides.len(), "the corners")?, ..Default::default() };
        let mut vertex_of = HashMap::<(u32, u32, [u32; 2], bool), u32>::new();
        for (i, &Side(side)) in sides.iter().enumerate() {
            if i.is_multiple_of(1 << 14) {
                advance(0)?;
            }
            let (global, is_back) = (side & !BACK, side & BACK != 0);
            let (m, t) = scene.locate(global);
            let object = scene.object(m);
            let mesh = object.mesh();
            let (corner_uvs, _) = match is_back {
                true => places.back(m, t, global).unwrap_or_default(),
                false => places.front(m, t, global),
            };
            // A back is turned round, so that it is a front.
            let order = if is_back { [0, 2, 1] } else { [0, 1, 2] };
            for (v, lightmap_uv) in order.map(|k| (mesh.indices[t as usize][k], corner_uvs[k])) {
                let key = (m, v, lightmap_uv.map(f32::to_bits), is_back);
                if let Some(vertex) = vertex_of.get(&key) {
                    result.indices.push(*vertex);
                    continue;
                }
                let vertex = result.positions.len() as u32;
                account.make_room_in_map(&mut vertex_of, "the vertices")?;
                vertex_of.insert(key, vertex);
                account.push(&mut result.positions, object.position(v), "the vertices")?;
                if normals {
                    let normal = object.normal(v).normalize_or(Vec3::Y);
                    let normal = if is_back { -normal } else { normal };
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
