//! A hall of as many triangles as asked for, to measure how time and memory grow with them: finely divided flat walls
//! and floor, a coffered ceiling, and two rows of fluted columns, in about equal parts.

use super::lattice::{lathe, lathe_triangles, room};
use crate::base::error::{Result, invalid_argument};
use crate::scene::camera::Camera;
use crate::scene::light::Light;
use crate::scene::material::Material;
use crate::scene::mesh::Mesh;
use crate::scene::{Instance, MAX_TRIANGLES, SceneData};
use glam::{Affine3A, UVec3, Vec3};
use std::f32::consts::TAU;

/// Length, height and width in metres.
pub(super) const SIZE: UVec3 = UVec3::new(40, 12, 20);

/// Columns in both rows, 4 m from one another.
const COLUMNS: [u32; 2] = [9, 2];

/// Flutes of a column.
const FLUTES: u32 = 24;

/// Minimum number of triangles: flutes have one at least.
const MIN_TRIANGLES: usize = 20_000;

/// Maximum number of triangles: half of them are one mesh.
const MAX_HALL: usize = 2 * MAX_TRIANGLES;

/// Makes a hall of about `triangles` triangles: mesh 0 is the room, the others are the columns. Where they are too many for
/// one tree, each mesh has one of its own, as an instance where it is.
pub(super) fn hall(triangles: usize) -> Result<SceneData> {
    if !(MIN_TRIANGLES..=MAX_HALL).contains(&triangles) {
        return invalid_argument!("a hall of {triangles} triangles, not of {MIN_TRIANGLES} to {MAX_HALL}");
    }
    let add = |scene: &mut SceneData, mesh: Mesh| -> Result<()> {
        let mesh = scene.add_mesh(mesh)?;
        if triangles > MAX_TRIANGLES {
            scene.add_instance(Instance { mesh, transform: Affine3A::IDENTITY, light_of: None })?;
        }
        Ok(())
    };
    let mut scene = SceneData::new();
    let plaster = scene.add_material(Material { albedo: [0.7, 0.67, 0.6], ..Default::default() })?;
    let stone = scene.add_material(Material { albedo: [0.6, 0.55, 0.48], ..Default::default() })?;
    // Squares along a metre, so that the room takes half of the triangles.
    let of_room = 4 * (SIZE.x * SIZE.y + SIZE.y * SIZE.z + SIZE.z * SIZE.x) as usize;
    let per_metre = ((0.5 * triangles as f64 / of_room as f64).sqrt() as u32).max(1);
    let place = |p: [u32; 3]| {
        let mut place = UVec3::from_array(p).as_vec3() / per_metre as f32;
        if p[1] == SIZE.y * per_metre {
            place.y += coffer(place.x, place.z);
        }
        place
    };
    add(&mut scene, room((SIZE * per_metre).to_array(), plaster, place)?)?;

    let of_column = (triangles - scene.triangle_count()) / (COLUMNS[0] * COLUMNS[1]) as usize;
    for row in 0..COLUMNS[1] {
        for n in 0..COLUMNS[0] {
            let foot = Vec3::new(4.0 * (n + 1) as f32, 0.0, 6.0 + 8.0 * row as f32);
            add(&mut scene, column(of_column, foot, stone)?)?;
        }
    }
    for x in [8.0, 16.0, 24.0, 32.0] {
        let position = Vec3::new(x - 1.0, SIZE.y as f32 - 0.5, 9.0);
        let (edge_u, edge_v) = (2.0 * Vec3::X, 2.0 * Vec3::Z);
        scene.add_light(Light::Rect { position, edge_u, edge_v, radiance: [20.0, 18.0, 15.0] })?;
    }
    Ok(scene)
}

/// Makes a column of about `triangles` triangles.
pub(super) fn column(triangles: usize, foot: Vec3, material: u32) -> Result<Mesh> {
    let (cells, head) = (column_cells(triangles), foot + SIZE.y as f32 * Vec3::Y);
    lathe(cells, [foot, head], material, |i, j| {
        let (angle, height) = (i as f32 / cells[0] as f32, j as f32 / cells[1] as f32);
        let radius = column_radius(angle, SIZE.y as f32 * height);
        let (sin, cos) = (TAU * angle).sin_cos();
        foot + Vec3::new(radius * cos, SIZE.y as f32 * height, radius * sin)
    })
}

/// Height of the ceiling above its beams, which divide it into coffers of 2 m with slanting sides.
fn coffer(x: f32, z: f32) -> f32 {
    // 0 on the middle of a beam, 1 in that of a coffer.
    let from_beam = |x: f32| 1.0 - (x.rem_euclid(2.0) - 1.0).abs();
    let depth = |x: f32| ((from_beam(x) - 0.2) / 0.2).clamp(0.0, 1.0);
    0.5 * depth(x).min(depth(z))
}

/// Quads around and along a column of about so many triangles.
fn column_cells(triangles: usize) -> [u32; 2] {
    // Nearly squares: a column is 3.8 times as high as it is around.
    let per_flute = ((triangles as f64 / 7.6).sqrt() / FLUTES as f64).round().max(1.0) as u32;
    let around = FLUTES * per_flute;
    let ring = lathe_triangles([around, 0]);
    [around, ((triangles / ring).max(9) - 1) as u32]
}

/// Radius of a column at a part of its turn and a height in metres: a torus as its foot, a shaft with flutes that
/// becomes thinner, and a head that becomes wider.
fn column_radius(turn: f32, height: f32) -> f32 {
    let top = SIZE.y as f32;
    let shaft = 0.5 - 0.08 * height / top;
    let torus = 0.2 * (1.0 - ((height - 0.25) / 0.25).powi(2)).max(0.0).sqrt();
    let head = 0.35 * ((height - (top - 0.8)) / 0.8).max(0.0).powi(2);
    let fluted = ((height - 0.6) / 0.2).min((top - 1.0 - height) / 0.2).clamp(0.0, 1.0);
    let flute = 0.06 * fluted * (0.5 * TAU * (turn * FLUTES as f32).fract()).sin();
    shaft * (1.0 - flute) + torus + head
}

pub(super) fn hall_camera() -> Camera {
    Camera { position: Vec3::new(2.0, 1.7, 9.0), target: Vec3::new(30.0, 5.0, 11.0), up: Vec3::Y, fov_y: 1.1 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::demo::shapes::enclosed_volume;

    #[test]
    fn a_hall_has_about_as_many_triangles_as_asked_for_and_is_closed() {
        for triangles in [20_000, 50_000, 300_000] {
            let scene = hall(triangles).unwrap();
            let count = scene.triangle_count();
            assert!(count.abs_diff(triangles) < triangles / 20, "{count} for {triangles}");
            let [room, columns @ ..] = scene.meshes() else { panic!("there is a room") };
            let of_room = enclosed_volume(room).expect("the room is not closed");
            assert!(of_room < -9_600.0 && of_room > -10_100.0, "{of_room} m³ and coffers");
            assert_eq!(columns.len(), 18);
            for column in columns {
                let volume = enclosed_volume(column).expect("a column is not closed");
                assert!(volume > 6.0 && volume < 9.0, "{volume} m³");
            }
            let scene = scene.committed();
            assert_eq!(scene.stats().skipped_degenerate, 0);
        }
    }

    #[test]
    fn a_hall_of_no_triangles_is_refused() {
        assert!(hall(100).unwrap_err().to_string().contains("20000"));
    }
}
