//! The Menger sponge, of which the thesis's Appendix A measures how the rate of rays falls with triangles: a cube of
//! which a cross of seven of its 27 parts is taken away, then of each part left, and so on.

use crate::base::error::{Result, invalid_argument};
use crate::base::memory::{try_filled, try_push, try_with_capacity};
use crate::scene::camera::Camera;
use crate::scene::light::Light;
use crate::scene::material::Material;
use crate::scene::mesh::{Mesh, MeshMaterials};
use crate::scene::{MAX_TRIANGLES, NONE, SceneData};
use glam::{IVec3, Vec3};

const SPONGE: &str = "the Menger sponge";

/// Maximum level: the next one has more triangles than a scene may have.
const MAX_LEVEL: u32 = 6;

/// Makes the sponge of a level in the unit cube, two triangles for each square, with a sun. Each triangle is divided into
/// `parts`² (at least 1): the same surface of more triangles, as the thesis's Appendix A has it with powers of 2.
pub(super) fn menger(level: u32, parts: u32) -> Result<SceneData> {
    if level > MAX_LEVEL {
        return invalid_argument!("a Menger sponge of level {level}, more than {MAX_LEVEL}");
    }
    let triangles = (parts as usize).checked_pow(2).and_then(|n| n.checked_mul(menger_triangles(level)));
    let Some(triangles) = triangles.filter(|n| (1..=MAX_TRIANGLES).contains(n)) else {
        return invalid_argument!(
            "a Menger sponge whose triangles are divided into {parts}²: more than {MAX_TRIANGLES}, or none"
        );
    };
    let mut scene = SceneData::new();
    scene.add_material(Material { albedo: [0.7; 3], ..Default::default() })?;
    let sponge = sponge(level)?;
    scene.add_mesh(if parts == 1 { sponge } else { divided(&sponge, parts, triangles)? })?;
    let direction = Vec3::new(-0.5, -0.8, -0.6).normalize();
    scene.add_light(Light::Directional { direction, irradiance: [10.0; 3], angular_radius: 0.0 })?;
    Ok(scene)
}

/// Number of triangles: two for each of the 2 · 20^level + 4 · 8^level squares.
pub(super) fn menger_triangles(level: u32) -> usize {
    2 * (2 * 20usize.pow(level) + 4 * 8usize.pow(level))
}

/// Whether the sponge has a cell: no digit to the base 3 is 1 in two of its coordinates.
fn has_cell(cell: IVec3, side: i32) -> bool {
    if cell.min_element() < 0 || cell.max_element() >= side {
        return false;
    }
    let (mut cell, mut size) = (cell, side);
    while size > 1 {
        let ones = cell.to_array().map(|c| (c % 3 == 1) as u32);
        if ones[0] + ones[1] + ones[2] > 1 {
            return false;
        }
        (cell, size) = (cell / 3, size / 3);
    }
    true
}

/// Makes the mesh layer by layer, so that only the vertices of two planes of the lattice are looked up.
fn sponge(level: u32) -> Result<Mesh> {
    let side = 3i32.pow(level);
    let points = side as usize + 1;
    let mut positions = Vec::new();
    let mut indices = try_with_capacity(menger_triangles(level), SPONGE)?;
    // Vertices of the planes below and above a layer.
    let mut planes = [try_filled(points * points, NONE, SPONGE)?, try_filled(points * points, NONE, SPONGE)?];
    for z in 0..side {
        for (x, y) in (0..side).flat_map(|y| (0..side).map(move |x| (x, y))) {
            let cell = IVec3::new(x, y, z);
            if !has_cell(cell, side) {
                continue;
            }
            for (axis, upper) in (0..3).flat_map(|axis| [(axis, 0), (axis, 1)]) {
                if has_cell(cell + IVec3::AXES[axis] * (2 * upper - 1), side) {
                    continue;
                }
                let mut corners = [0; 4];
                for (corner, [u, v]) in corners.iter_mut().zip([[0, 0], [1, 0], [1, 1], [0, 1]]) {
                    let along = IVec3::AXES[axis] * upper;
                    let point = cell + along + IVec3::AXES[(axis + 1) % 3] * u + IVec3::AXES[(axis + 2) % 3] * v;
                    let vertex = &mut planes[(point.z - z) as usize][point.y as usize * points + point.x as usize];
                    if *vertex == NONE {
                        *vertex = positions.len() as u32;
                        try_push(&mut positions, point.as_vec3() / side as f32, SPONGE)?;
                    }
                    *corner = *vertex;
                }
                if upper == 0 {
                    corners.reverse();
                }
                let [a, b, c, d] = corners;
                indices.extend([[a, b, c], [a, c, d]]);
            }
        }
        planes.swap(0, 1);
        planes[1].fill(NONE);
    }
    Ok(Mesh {
        positions: positions.into(),
        indices: indices.into(),
        materials: MeshMaterials::One(0),
        ..Default::default()
    })
}

/// Divides each triangle of a mesh into `parts`². Points on an edge are the same from both sides, bit for bit.
fn divided(mesh: &Mesh, parts: u32, triangles: usize) -> Result<Mesh> {
    let per_triangle = ((parts + 1) * (parts + 2) / 2) as usize;
    let mut positions = try_with_capacity(per_triangle * mesh.indices.len(), SPONGE)?;
    let mut indices = try_with_capacity(triangles, SPONGE)?;
    for t in 0..mesh.indices.len() {
        let [a, b, c] = mesh.corners(t).map(Vec3::as_dvec3);
        // Rows of points from the edge a b to the corner c.
        for row in 0..=parts {
            let first = positions.len() as u32;
            for i in 0..=parts - row {
                let point = (a * (parts - row - i) as f64 + b * i as f64 + c * row as f64) / parts as f64;
                positions.push(point.as_vec3());
            }
            let next = first + parts - row + 1;
            indices.extend((0..parts - row).map(|i| [first + i, first + i + 1, next + i]));
            indices.extend((1..parts - row).map(|i| [first + i, next + i, next + i - 1]));
        }
    }
    Ok(Mesh {
        positions: positions.into(),
        indices: indices.into(),
        materials: MeshMaterials::One(0),
        ..Default::default()
    })
}

pub(super) fn menger_camera() -> Camera {
    Camera { position: Vec3::new(2.2, 1.5, 1.8), target: Vec3::splat(0.5), up: Vec3::Y, fov_y: 0.7 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sponges_are_closed_and_have_the_surface_and_the_volume_of_the_formulas() {
        for level in 0..4 {
            let mesh = sponge(level).unwrap();
            assert_eq!(mesh.indices.len(), menger_triangles(level));
            let sides = |[a, b, c]: [u32; 3]| [(a, b), (b, c), (c, a)];
            let mut edges: Vec<_> = mesh.indices.iter().copied().flat_map(sides).collect();
            let mut reversed: Vec<_> = edges.iter().map(|&(a, b)| (b, a)).collect();
            edges.sort_unstable();
            reversed.sort_unstable();
            assert!(edges == reversed, "level {level} is not closed");
            let volume = |t: usize| {
                let [a, b, c] = mesh.corners(t).map(Vec3::as_dvec3);
                a.dot(b.cross(c)) / 6.0
            };
            let volume: f64 = (0..mesh.indices.len()).map(volume).sum();
            assert!((volume - (20f64 / 27.0).powi(level as i32)).abs() < 1e-6, "{volume} m³ at level {level}");
        }
    }

    #[test]
    fn divided_sponges_are_closed_and_have_the_same_surface() {
        let whole = sponge(2).unwrap();
        for parts in 1..6 {
            let mesh = divided(&whole, parts, whole.indices.len() * (parts * parts) as usize).unwrap();
            assert_eq!(mesh.indices.len(), whole.indices.len() * (parts * parts) as usize);
            let bits = |p: Vec3| p.to_array().map(f32::to_bits);
            let sides = |t: usize| {
                let [a, b, c] = mesh.corners(t).map(bits);
                [(a, b), (b, c), (c, a)]
            };
            let mut edges: Vec<_> = (0..mesh.indices.len()).flat_map(sides).collect();
            let mut reversed: Vec<_> = edges.iter().map(|&(a, b)| (b, a)).collect();
            edges.sort_unstable();
            reversed.sort_unstable();
            assert!(edges == reversed, "{parts} is not closed");
            let area = |mesh: &Mesh| -> f64 {
                let of = |t: usize| {
                    let [a, b, c] = mesh.corners(t).map(Vec3::as_dvec3);
                    0.5 * (b - a).cross(c - a).length()
                };
                (0..mesh.indices.len()).map(of).sum()
            };
            assert!((area(&mesh) / area(&whole) - 1.0).abs() < 1e-6, "{parts}");
        }
    }

    #[test]
    fn a_level_too_high_is_refused() {
        assert!(menger_triangles(MAX_LEVEL) <= crate::scene::MAX_TRIANGLES);
        assert!(menger_triangles(MAX_LEVEL + 1) > crate::scene::MAX_TRIANGLES);
        assert!(menger(MAX_LEVEL + 1, 1).is_err());
        assert!(menger(MAX_LEVEL, 2).is_err() && menger(1, 0).is_err() && menger(1, u32::MAX).is_err());
    }
}
