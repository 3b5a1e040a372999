//! Triangles that emit light.

use super::{Material, Mesh, MeshMaterials, SceneData, is_valid_triangle};
use glam::Vec3;

/// Name of this memory in error messages.
pub(super) const EMITTERS: &str = "the emissive triangles";

/// An emissive triangle as a light.
#[derive(Clone, Copy, Debug)]
pub struct Emitter {
    /// Global triangle number.
    pub triangle: u32,
    /// Corner 0.
    pub corner: Vec3,
    /// Edge from corner 0 to corner 1.
    pub edge_u: Vec3,
    /// Edge from corner 0 to corner 2.
    pub edge_v: Vec3,
    /// Unit geometric normal.
    pub normal: Vec3,
    /// Area in square scene units.
    pub area: f32,
    /// Emitted radiance in W/(m²·sr).
    pub radiance: [f32; 3],
    /// Whether the back emits too.
    pub two_sided: bool,
}

/// Number of triangles with a material that emits.
pub(super) fn emissive_triangles(data: &SceneData) -> usize {
    let emits = |m: u32| data.materials[m as usize].is_emissive();
    let of_mesh = |mesh: &Mesh| match &mesh.materials {
        MeshMaterials::One(m) if mesh.indices.is_empty() || !emits(*m) => 0,
        MeshMaterials::One(_) => mesh.indices.len(),
        MeshMaterials::PerTriangle(materials) => materials.iter().filter(|&&m| emits(m)).count(),
    };
    data.meshes.iter().map(of_mesh).sum()
}

/// Adds the emissive triangles that are valid and not `skipped`.
pub(super) fn add_emitters(data: &SceneData, first_triangle: &[u32], skipped: &[u32], emitters: &mut Vec<Emitter>) {
    for (m, mesh) in data.meshes.iter().enumerate() {
        if let MeshMaterials::One(material) = mesh.materials
            && !data.materials[material as usize].is_emissive()
        {
            continue;
        }
        for t in 0..mesh.indices.len() {
            let (material, id) = (&data.materials[mesh.material(t) as usize], first_triangle[m] + t as u32);
            if material.is_emissive() && is_valid_triangle(mesh.corners(t)) && skipped.binary_search(&id).is_err() {
                emitters.push(emitter(id, mesh.corners(t), material));
            }
        }
    }
}

fn emitter(triangle: u32, corners: [Vec3; 3], material: &Material) -> Emitter {
    let [a, b, c] = corners;
    let cross = (b - a).as_dvec3().cross((c - a).as_dvec3());
    Emitter {
        triangle,
        corner: a,
        edge_u: b - a,
        edge_v: c - a,
        normal: cross.normalize_or_zero().as_vec3(),
        area: (0.5 * cross.length()) as f32,
        radiance: material.emission,
        two_sided: material.two_sided,
    }
}
