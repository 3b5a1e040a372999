//! Triangles that emit light.

use super::{Material, Mesh, MeshMaterials, SceneData, is_valid_triangle};
use glam::Vec3;

/// Name of this memory in error messages.
pub(super) const EMITTERS: &str = "the emissive triangles";

/// An emissive triangle as a light.
#[derive(Clone, Copy, Debug, PartialEq)]
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
    let own = (0..).zip(&data.meshes).filter(|&(m, _)| !data.is_instanced(m)).map(|(_, mesh)| of_mesh(mesh));
    let of_instances = data.instances.iter().map(|i| of_mesh(&data.meshes[i.mesh as usize]));
    own.chain(of_instances).sum()
}

/// Adds the emissive triangles that are valid and not skipped: `is_skipped` is asked with an object and a triangle of
/// its mesh. `first_triangle`: of each object, and the total at the end.
pub(super) fn add_emitters(
    data: &SceneData,
    first_triangle: &[u32],
    is_skipped: impl Fn(u32, u32) -> bool,
    emitters: &mut Vec<Emitter>,
) {
    for (number, ends) in (0..).zip(first_triangle.windows(2)) {
        let object = data.object(number);
        if let MeshMaterials::One(material) = object.mesh().materials
            && !data.materials[material as usize].is_emissive()
        {
            continue;
        }
        for t in 0..ends[1] - ends[0] {
            let material = &data.materials[object.mesh().material(t as usize) as usize];
            if !material.is_emissive() {
                continue;
            }
            let corners = object.corners(t);
            if is_valid_triangle(corners) && !is_skipped(number, t) {
                emitters.push(emitter(ends[0] + t, corners, material));
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
