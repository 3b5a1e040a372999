//! A square grove of fluted columns under the sky, all of them instances of one, of as many triangles as asked for: to
//! measure what instances save and cost.

use super::hall::{SIZE, column};
use super::shapes::MeshBuilder;
use crate::base::error::{Result, invalid_argument};
use crate::base::sampling::uniform;
use crate::scene::camera::Camera;
use crate::scene::light::Light;
use crate::scene::material::Material;
use crate::scene::{Instance, MAX_PLACED_TRIANGLES, MAX_TRIANGLES, NONE, SceneData};
use glam::{Affine3A, Quat, Vec3};
use std::f32::consts::TAU;

/// Triangles of a column, of which there are at least [`LEAST_COLUMNS`]; fewer if the scene is small.
const COLUMN: usize = 100_000;
const LEAST_COLUMNS: usize = 64;

/// Minimum number of triangles: flutes have one at least.
const MIN_TRIANGLES: usize = 100_000;

/// Distance of the columns' axes.
const STEP: f32 = 4.0;

/// Makes a grove of columns of about `triangles` triangles. `copies`: each is a mesh, instead of an instance of mesh 1;
/// mesh 0 is the ground.
pub(super) fn colonnade(triangles: usize, copies: bool) -> Result<SceneData> {
    // Copies have one tree.
    let most = if copies { MAX_TRIANGLES } else { MAX_PLACED_TRIANGLES };
    if !(MIN_TRIANGLES..=most).contains(&triangles) {
        return invalid_argument!("a colonnade of {triangles} triangles, not of {MIN_TRIANGLES} to {most}");
    }
    let side = ((triangles / COLUMN).max(LEAST_COLUMNS) as f64).sqrt().round() as u32;
    let mut scene = SceneData::new();
    let ground = scene.add_material(Material { albedo: [0.45, 0.42, 0.36], ..Default::default() })?;
    let stone = scene.add_material(Material { albedo: [0.6, 0.55, 0.48], ..Default::default() })?;
    let length = STEP * side as f32;
    let mut shapes = MeshBuilder::new();
    let at = |x: f32, z: f32| Vec3::new(x * length, 0.0, z * length);
    shapes.grid_quad(at(0.0, 0.0), at(0.0, 1.0), at(1.0, 1.0), at(1.0, 0.0), side, side, ground);
    scene.add_mesh(shapes.finish())?;
    let mesh = column(triangles / (side * side) as usize, Vec3::ZERO, stone)?;
    let number = if copies { NONE } else { scene.add_mesh(mesh.clone())? };
    for i in 0..side * side {
        let foot = Vec3::new((i % side) as f32 + 0.5, 0.0, (i / side) as f32 + 0.5) * STEP;
        let turn = Quat::from_rotation_y(TAU * uniform(i, 0, 1));
        let scale = Vec3::splat(0.6 + 0.6 * uniform(i, 1, 1));
        let transform = Affine3A::from_scale_rotation_translation(scale, turn, foot);
        if copies {
            let mut mesh = mesh.clone();
            mesh.positions.iter_mut().for_each(|p| *p = transform.transform_point3(*p));
            scene.add_mesh(mesh)?;
        } else {
            scene.add_instance(Instance::new(number, transform))?;
        }
    }
    scene.add_light(Light::Sky { radiance: [0.6, 0.8, 1.0], environment: NONE, up: Vec3::Y, rotation: 0.0 })?;
    let direction = Vec3::new(0.5, -0.7, 0.3).normalize();
    scene.add_light(Light::Directional { direction, irradiance: [6.0, 5.4, 4.4], angular_radius: 0.005 })?;
    Ok(scene)
}

pub(super) fn colonnade_camera() -> Camera {
    let eye = Vec3::new(2.0 * STEP, 1.7, 1.0 * STEP);
    Camera { position: eye, target: eye + Vec3::new(10.0, 1.5 + SIZE.y as f32 / 8.0, 14.0), up: Vec3::Y, fov_y: 1.1 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_colonnade_has_about_as_many_triangles_as_asked_for_and_copies_stand_where_instances_do() {
        for triangles in [200_000, 1_500_000] {
            let (placed, copies) = (colonnade(triangles, false).unwrap(), colonnade(triangles, true).unwrap());
            let count = placed.triangle_count();
            assert!(count.abs_diff(triangles) < triangles / 10, "{count} for {triangles}");
            assert_eq!(count, copies.triangle_count());
            let (last, flat) = (&copies.meshes()[copies.meshes().len() - 1], placed.flattened());
            let flat = &flat[flat.len() - 1];
            let far = |(a, b): (&Vec3, &Vec3)| a.distance(*b) > 1e-4;
            assert!(!last.positions.iter().zip(&flat.positions).any(far));
        }
        assert!(colonnade(1_000_000_000, false).is_ok(), "a billion, of one column");
    }
}
