//! Objects that are unwrapped alike: instances of one mesh whose transforms differ in rotation, translation and a factor
//! of all lengths alone. One of them is unwrapped, and the others get its pieces.
//!
//! Invariant: an isometry changes neither which regions are flat or smooth nor the angles of charts, and pieces have the
//! lengths of the surface.

use super::pieces::{CHARTS, Piece};
use crate::base::error::Result;
use crate::base::memory::{try_collect, try_push, try_with_capacity};
use crate::scene::Scene;
use glam::{DMat3, DVec3};

/// Which object's pieces an object gets, and the factor of their lengths.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Source {
    /// Index of the object, at most that of this one.
    pub index: usize,
    pub factor: f32,
}

/// Greatest difference of transforms that count as alike, as a fraction of their lengths: charts are stretched by so much.
const SAME: f64 = 1e-5;

/// Number of differently transformed instances of a mesh among which like ones are looked for.
const MOST_COMPARED: usize = 16;

/// Finds the sources of objects, given by their valid triangles (global numbers, ascending).
pub(super) fn sources(scene: &Scene, of_objects: &[&[u32]]) -> Result<Vec<Source>> {
    let mut sources = try_with_capacity(of_objects.len(), CHARTS)?;
    let mut known: Vec<Vec<(usize, f64, [DVec3; 2])>> = try_collect(scene.meshes().iter().map(|_| Vec::new()), CHARTS)?;
    for (index, triangles) in of_objects.iter().enumerate() {
        let own = Source { index, factor: 1.0 };
        let object = scene.locate(triangles[0]).0;
        let Some(instance) = object.checked_sub(scene.meshes().len() as u32) else {
            sources.push(own);
            continue;
        };
        let instance = scene.instances()[instance as usize];
        let (length, shape) = shape(instance.transform.matrix3.into());
        let others = &mut known[instance.mesh as usize];
        let is_alike = |&&(other, _, its): &&(usize, f64, [DVec3; 2])| {
            let same_triangles = || {
                let [a, b] = [of_objects[other], triangles].map(|t| (t, scene.first_triangle(scene.locate(t[0]).0)));
                a.0.len() == b.0.len() && a.0.iter().zip(b.0).all(|(x, y)| x - a.1 == y - b.1)
            };
            (0..2).all(|i| (its[i] - shape[i]).abs().max_element() <= SAME) && same_triangles()
        };
        match others.iter().rev().take(MOST_COMPARED).find(is_alike) {
            Some(&(index, of_source, _)) => sources.push(Source { index, factor: (length / of_source) as f32 }),
            None => {
                try_push(others, (index, length, shape), CHARTS)?;
                sources.push(own);
            }
        }
    }
    Ok(sources)
}

/// The factor of lengths, and the squared lengths and products of the images of the axes without it: the same for
/// transforms that differ by a rotation.
fn shape(matrix: glam::Mat3) -> (f64, [DVec3; 2]) {
    let DMat3 { x_axis: x, y_axis: y, z_axis: z } = matrix.as_dmat3();
    let length = x.cross(y).dot(z).abs().cbrt();
    let squares = DVec3::new(x.dot(x), y.dot(y), z.dot(z));
    let products = DVec3::new(x.dot(y), y.dot(z), z.dot(x));
    (length, [squares, products].map(|v| v / (length * length)))
}

/// Copies pieces to another object: `shift` is added to the numbers of triangles (modulo 2^32).
pub(super) fn copy(pieces: &[Piece], shift: u32, factor: f32) -> Result<Vec<Piece>> {
    let mut copies = try_with_capacity(pieces.len(), CHARTS)?;
    for piece in pieces {
        copies.push(Piece {
            triangles: try_collect(piece.triangles.iter().map(|t| t.wrapping_add(shift)), CHARTS)?,
            corners: try_collect(piece.corners.iter().map(|c| c.map(|uv| uv.map(|x| x * factor))), CHARTS)?,
            given: None,
        });
    }
    Ok(copies)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::progress::Progress;
    use crate::lightmap::atlas::charts::triangle_area;
    use crate::lightmap::{Lightmap, LightmapDesc};
    use crate::scene::{Instance, Material, SceneData, shapes::MeshBuilder};
    use glam::{Affine3A, Quat, Vec3};

    /// A ball and what stands for a curved part of it, as instances with these transforms.
    fn scene(transforms: &[Affine3A]) -> std::sync::Arc<Scene> {
        let mut data = SceneData::new();
        let material = data.add_material(Material::default()).unwrap();
        let mut ball = MeshBuilder::new();
        ball.sphere(Vec3::ZERO, 1.0, 3, material);
        let mesh = data.add_mesh(ball.finish()).unwrap();
        for &transform in transforms {
            data.add_instance(Instance { mesh, transform }).unwrap();
        }
        data.committed()
    }

    fn at(scale: Vec3, turn: f32, x: f32) -> Affine3A {
        let turn = Quat::from_axis_angle(Vec3::new(1.0, 2.0, 2.0) / 3.0, turn);
        Affine3A::from_scale_rotation_translation(scale, turn, Vec3::X * x)
    }

    #[test]
    fn like_instances_share_an_unwrap_and_others_do_not() {
        let (even, flat) = (Vec3::ONE, Vec3::new(1.0, 0.5, 1.0));
        let scene =
            scene(&[at(even, 0.0, 0.0), at(2.0 * even, 1.0, 5.0), at(flat, 0.3, 9.0), at(3.0 * flat, 2.0, 20.0)]);
        let objects: Vec<Vec<u32>> = (1..=4).map(|o| scene.triangles_of(o).collect()).collect();
        let objects: Vec<&[u32]> = objects.iter().map(|o| &o[..]).collect();
        let sources = sources(&scene, &objects).unwrap();
        assert_eq!(sources.iter().map(|s| s.index).collect::<Vec<_>>(), [0, 0, 2, 2]);
        let factors = sources.iter().map(|s| s.factor);
        assert!(factors.zip([1.0, 2.0, 1.0, 3.0]).all(|(a, b)| (a - b).abs() < 1e-5 * b), "{sources:?}");
    }

    #[test]
    fn charts_of_copies_keep_their_area() {
        let scene = scene(&[at(Vec3::ONE, 0.0, 0.0), at(Vec3::splat(2.0), 1.0, 5.0), at(Vec3::splat(0.5), 2.5, -4.0)]);
        let desc = LightmapDesc { texels_per_unit: 8.0, ..Default::default() };
        let map = Lightmap::create(&scene, &desc, &Progress::none()).unwrap();
        let page = map.info().width as f64;
        let mut charts = Vec::new();
        for object in 1..=3 {
            let (uvs, pages) = map.object_uvs(object).unwrap();
            assert!(pages.iter().all(|p| *p == 0));
            let texels = |[a, b, c]: [[f32; 2]; 3]| {
                let [a, b, c] = [a, b, c].map(|p| glam::DVec2::from_array(p.map(f64::from)) * page);
                0.5 * (b - a).perp_dot(c - a).abs()
            };
            let in_map: f64 = uvs.iter().map(|t| texels(*t)).sum();
            let area: f64 = scene.triangles_of(object).map(|t| triangle_area(&scene, t)).sum();
            // Charts are scaled to whole texels.
            assert!((in_map / (64.0 * area) - 1.0).abs() < 0.1, "{in_map} {area}");
            charts.push(uvs);
        }
        // No two instances share texels.
        let lower = |uvs: &[[[f32; 2]; 3]]| uvs[0][0];
        assert!(lower(&charts[0]) != lower(&charts[1]) && lower(&charts[1]) != lower(&charts[2]));
    }
}
