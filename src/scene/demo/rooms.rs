//! Small rooms for measurements of light, each with one difficulty. Units are metres, y is up.

use super::shapes::MeshBuilder;
use crate::base::error::Result;
use crate::scene::SceneData;
use crate::scene::camera::Camera;
use crate::scene::light::Light;
use crate::scene::material::Material;
use glam::Vec3;

/// Makes a room with a lamp at its ceiling, and things that are closed boxes in it.
fn room(size: Vec3, lamp: Vec3, things: &[[Vec3; 2]]) -> Result<SceneData> {
    let mut scene = SceneData::new();
    let white = scene.add_material(Material { albedo: [0.7, 0.68, 0.62], ..Default::default() })?;
    let wood = scene.add_material(Material { albedo: [0.45, 0.3, 0.2], ..Default::default() })?;
    let mut walls = MeshBuilder::new();
    walls.box_(Vec3::ZERO, size, true, white);
    scene.add_mesh(walls.finish())?;
    for &[lower, upper] in things {
        let mut thing = MeshBuilder::new();
        thing.box_(lower, upper, false, wood);
        scene.add_mesh(thing.finish())?;
    }
    scene.add_light(Light::Rect { position: lamp, edge_u: Vec3::X, edge_v: Vec3::Z, radiance: [10.0; 3] })?;
    Ok(scene)
}

/// A room with a wardrobe 1 cm, a sideboard 2 cm and a hanging shelf 3 cm off the walls, and a moulding 5 mm before
/// one.
pub(super) fn furniture() -> Result<SceneData> {
    let p = Vec3::new;
    let things = [
        [p(0.01, 0.0, 0.8), p(0.6, 2.0, 2.0)],
        [p(1.2, 0.0, 0.02), p(2.8, 0.8, 0.5)],
        [p(3.3, 0.4, 1.0), p(3.97, 1.8, 2.4)],
        [p(0.3, 2.2, 0.005), p(3.7, 2.3, 0.06)],
    ];
    room(p(4.0, 2.6, 4.0), p(1.5, 2.59, 1.5), &things)
}

/// Two rooms with a wall of 2 cm between them, which leaves a gap of 40 cm at one end; the lamp is in the first.
pub(super) fn partition() -> Result<SceneData> {
    let p = Vec3::new;
    room(p(6.0, 2.6, 4.0), p(1.0, 2.59, 1.5), &[[p(2.99, -0.01, -0.01), p(3.01, 2.61, 3.6)]])
}

pub(super) fn furniture_camera() -> Camera {
    Camera { position: Vec3::new(3.6, 1.6, 3.6), target: Vec3::new(1.2, 0.9, 0.8), up: Vec3::Y, fov_y: 1.2 }
}

pub(super) fn partition_camera() -> Camera {
    Camera { position: Vec3::new(1.0, 1.6, 0.5), target: Vec3::new(3.2, 1.0, 3.8), up: Vec3::Y, fov_y: 1.2 }
}
