//! Origins of shadow rays on smooth normals: Hanika, *Hacking the Shadow Terminator* (Ray Tracing Gems II, 2021,
//! chapter 4).
//!
//! Normals that are interpolated over flat triangles let light arrive at points that their own or a neighbouring
//! triangle shades: black facets where the smooth surface would still be lit. The paper raises the point to a surface
//! between the planes perpendicular to the corners' normals, which clears the triangles of a convex surface and leaves
//! the points of concave ones where they are.
//!
//! Two conditions prevent that from lighting points that must be dark. Corners whose normals lean far from the
//! triangle's are hard edges that a modelling tool has smoothed (a box: 55°): they raise nothing. And geometry between
//! the surface and the raised point keeps the point down.

use crate::scene::Scene;
use crate::trace::Ray;
use crate::trace::offset::ray_epsilon;
use glam::{DVec3, Vec3};

/// Minimum cosine between a corner's normal and the triangle's with which the corner raises points: 45°. A sphere of
/// twenty triangles, the coarsest that is meant as one, has 37°.
const LEAST_COSINE: f32 = 0.7;

/// The raised point of a triangle on the side of `geometric`; `None` if it stays where it is. `normals`: those of the
/// corners, turned to that side. `origin`: origin of rays from the surface.
pub(crate) fn raised(
    scene: &Scene,
    corners: [Vec3; 3],
    normals: [Vec3; 3],
    [u, v]: [f32; 2],
    geometric: Vec3,
    origin: Vec3,
) -> Option<Vec3> {
    // A point rises by no more than an edge times what the normals lean: by nothing in flat walls that have normals.
    let leaning = normals.iter().map(|n| (*n - geometric).length_squared()).fold(0.0, f32::max);
    let [a, b, c] = corners;
    let longest = (b - a).length_squared().max((c - a).length_squared()).max((c - b).length_squared());
    let rounding = 1e-14;
    if 2.0 * (leaning + rounding) * longest <= (0.5 * ray_epsilon(origin, scene)).powi(2) {
        return None;
    }
    let weights = [1.0 - u as f64 - v as f64, u as f64, v as f64];
    let corners = corners.map(|c| c.as_dvec3());
    let point: DVec3 = corners.iter().zip(weights).map(|(c, w)| *c * w).sum();
    let mut lift = DVec3::ZERO;
    for i in 0..3 {
        let normal = normals[i].normalize_or_zero();
        if !(normal.dot(geometric) >= LEAST_COSINE) {
            return None;
        }
        let normal = normal.as_dvec3();
        lift -= normal * ((point - corners[i]).dot(normal).min(0.0) * weights[i]);
    }
    let lift = lift.as_vec3();
    if lift.length() <= ray_epsilon(origin, scene) {
        return None;
    }
    let is_free = !scene.occluded(&Ray::new(origin, lift).within(0.0, 1.0));
    is_free.then(|| origin + lift)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::demo::shapes::MeshBuilder;
    use crate::scene::{Material, Mesh, SceneData};
    use std::sync::Arc;

    /// A triangle in the plane y = 0, and perhaps another over it.
    fn scene(roof: Option<f32>) -> Arc<Scene> {
        let mut data = SceneData::new();
        data.add_material(Material::default()).unwrap();
        data.add_mesh(Mesh {
            positions: CORNERS.to_vec().into(),
            indices: vec![[0, 1, 2]].into(),
            ..Default::default()
        })
        .unwrap();
        if let Some(y) = roof {
            let mut mesh = MeshBuilder::new();
            let [a, b, c] = CORNERS.map(|c| c + Vec3::Y * y);
            mesh.triangle(a, b, c, 0);
            data.add_mesh(mesh.finish()).unwrap();
        }
        data.committed()
    }

    const CORNERS: [Vec3; 3] = [Vec3::ZERO, Vec3::Z, Vec3::X];
    const MIDDLE: [f32; 2] = [1.0 / 3.0, 1.0 / 3.0];

    /// Normals that lean from the middle by `lean`, < 0: towards it.
    fn normals(lean: f32) -> [Vec3; 3] {
        let middle = (CORNERS[0] + CORNERS[1] + CORNERS[2]) / 3.0;
        CORNERS.map(|c| (Vec3::Y + lean * (c - middle)).normalize())
    }

    fn height(scene: &Scene, lean: f32, uv: [f32; 2]) -> Option<f32> {
        let origin = CORNERS[0] + uv[0] * CORNERS[1] + uv[1] * CORNERS[2] + Vec3::Y * 1e-5;
        raised(scene, CORNERS, normals(lean), uv, Vec3::Y, origin).map(|p| p.y)
    }

    #[test]
    fn convex_surfaces_are_raised_between_corners_and_others_are_not() {
        let scene = scene(None);
        let middle = height(&scene, 0.5, MIDDLE).unwrap();
        // Above it the planes on the corners' normals are d²/2 / (1 + d²/4) high, d² = 2/9, 5/9 and 5/9 being the
        // squared distances of the corners.
        let expected = (2.0 / 19.0 + 2.0 * 10.0 / 41.0) / 3.0;
        assert!((middle - expected).abs() < 2e-5, "{middle}");
        assert_eq!(height(&scene, 0.5, [0.0, 0.0]), None);
        assert_eq!(height(&scene, 0.0, MIDDLE), None);
        assert_eq!(height(&scene, -0.5, MIDDLE), None);
    }

    #[test]
    fn smoothed_hard_edges_and_what_is_over_the_surface_keep_points_down() {
        assert_eq!(height(&scene(None), 4.0, MIDDLE), None);
        assert_eq!(height(&scene(Some(0.01)), 0.5, MIDDLE), None);
        assert!(height(&scene(Some(0.5)), 0.5, MIDDLE).is_some());
    }
}
