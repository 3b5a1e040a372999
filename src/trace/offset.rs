//! Ray origins on surfaces that do not hit the surface that they start from.
//!
//! After Wächter and Binder, *A Fast and Robust Method for Avoiding Self-Intersection*, Ray Tracing
//! Gems (2019), chapter 6: the origin moves along the geometric normal by a multiple of the
//! rounding step, `tmin` stays 0. They take the rounding step of each coordinate of the point, with
//! a floor near zero that suits scenes of everyday size. Here the step is that of the largest
//! coordinate or of the scene's extent, whichever is more: a point near zero on a triangle of a
//! hundred metres is as imprecise as the triangle's corners, and scenes come in any unit.

use crate::scene::Scene;
pub use crate::scene::precision::ray_epsilon;
use glam::{DVec3, Vec3};

/// The origin for a ray that leaves a surface at `position` on the side that `normal` points to
/// (unit geometric normal, turned to the ray's side). Trace from it with `tmin` 0.
#[inline]
pub fn offset_ray_origin(position: Vec3, normal: Vec3, scene: &Scene) -> Vec3 {
    position + normal * ray_epsilon(position, scene)
}

/// Distance from the edges of its triangle at which a ray starts, in [`ray_epsilon`]s: with the offset along the normal
/// that is inside of walls that meet at 8° or more.
const EDGE_DISTANCE: f64 = 8.0;

/// Maximum distance by which a point moves away from edges, in [`ray_epsilon`]s: enough for corners of 30° and more.
const MAX_MOVE: f64 = 4.0 * EDGE_DISTANCE;

/// A point of a triangle with all that a path needs to continue from it.
pub struct SurfacePoint {
    /// The hit point, rounded once.
    pub position: Vec3,
    /// Unit geometric normal of the front.
    pub normal: Vec3,
    /// The hit point, or, where that is nearer than eight [`ray_epsilon`]s to an edge, the nearest
    /// point that is not (of a narrow triangle: nearer than half its inradius). Rays start here
    /// (offset along the normal), because a point at an edge, rounded and offset, may lie behind the
    /// wall that it shares the edge with, and its rays would leak out. It is never further than 32
    /// [`ray_epsilon`]s from the hit point, so that no shadow is seen to move with it.
    pub interior: Vec3,
}

/// A triangle, with what all of its points share.
#[derive(Clone, Copy)]
pub(crate) struct Facet {
    corners: [DVec3; 3],
    twice_area: f64,
    normal: Vec3,
}

impl SurfacePoint {
    /// The point of a triangle with barycentric weights `u` and `v` of vertices 1 and 2.
    #[inline]
    pub fn new(corners: [Vec3; 3], u: f32, v: f32, scene: &Scene) -> SurfacePoint {
        Facet::new(corners).point(u, v, scene)
    }
}

impl Facet {
    #[inline]
    pub fn new(corners: [Vec3; 3]) -> Facet {
        let corners = corners.map(|c| c.as_dvec3());
        let [a, b, c] = corners;
        let cross = (b - a).cross(c - a);
        let twice_area = cross.length();
        Facet { corners, twice_area, normal: (cross / twice_area).as_vec3() }
    }

    /// The point with barycentric weights `u` and `v` of vertices 1 and 2.
    #[inline]
    pub fn point(&self, u: f32, v: f32, scene: &Scene) -> SurfacePoint {
        let Facet { corners, twice_area, normal } = *self;
        let [a, b, c] = corners;
        let (edge_u, edge_v) = (b - a, c - a);
        let (u, v) = (u as f64, v as f64);
        let position = a + edge_u * u + edge_v * v;
        let rounded = position.as_vec3();
        let epsilon = ray_epsilon(rounded, scene) as f64;
        let weights = [1.0 - u - v, u, v];
        let edges = [c - b, edge_v, edge_u];
        // Nearly all points are so far from all edges that neither lengths nor the inradius matter: no roots. (Direct
        // light of Sponza at 31.5 texels/m takes 0.95 of the time.)
        let is_far = |i: usize| {
            let (height, far) = (weights[i] * twice_area, EDGE_DISTANCE * epsilon);
            height > 0.0 && height * height >= (1.0 + 1e-9) * far * far * edges[i].length_squared()
        };
        if is_far(0) && is_far(1) && is_far(2) {
            return SurfacePoint { position: rounded, normal, interior: rounded };
        }
        let lengths = edges.map(DVec3::length);
        let inradius = twice_area / (lengths[0] + lengths[1] + lengths[2]);
        let distance = (EDGE_DISTANCE * epsilon).min(0.5 * inradius);
        let interior = if (0..3).all(|i| weights[i] * twice_area >= distance * lengths[i]) {
            rounded
        } else {
            let target = nearest_on_inner_triangle(corners, lengths, distance / inradius, position);
            (position + (target - position).clamp_length_max(MAX_MOVE * epsilon)).as_vec3()
        };
        SurfacePoint { position: rounded, normal, interior }
    }
}

/// The point nearest to `p`, which lies outside of it, of a triangle shrunk towards its incentre by a
/// fraction of its inradius. `lengths`: of the edges opposite to the corners.
#[cold]
fn nearest_on_inner_triangle(corners: [DVec3; 3], lengths: [f64; 3], fraction: f64, p: DVec3) -> DVec3 {
    let [a, b, c] = corners;
    let incentre = (a * lengths[0] + b * lengths[1] + c * lengths[2]) / (lengths[0] + lengths[1] + lengths[2]);
    let inner = corners.map(|c| c + (incentre - c) * fraction);
    let on_edge = |i: usize| {
        let (from, edge) = (inner[i], inner[(i + 1) % 3] - inner[i]);
        let t = (p - from).dot(edge) / edge.length_squared();
        // NaN for an edge of no length.
        from + edge * if t > 0.0 { t.min(1.0) } else { 0.0 }
    };
    let points = [on_edge(0), on_edge(1), on_edge(2)];
    points.into_iter().min_by(|x, y| x.distance_squared(p).total_cmp(&y.distance_squared(p))).unwrap_or(p)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Material, Mesh, SceneData};
    use crate::trace::Ray;
    use proptest::prelude::*;
    use std::sync::Arc;

    fn one_triangle(corners: [Vec3; 3]) -> Arc<Scene> {
        let mut data = SceneData::new();
        data.add_material(Material::default()).unwrap();
        data.add_mesh(Mesh {
            positions: corners.to_vec().into(),
            indices: vec![[0, 1, 2]].into(),
            ..Default::default()
        })
        .unwrap();
        data.committed()
    }

    proptest! {
        #![proptest_config(ProptestConfig { failure_persistence: None, ..Default::default() })]
        #[test]
        fn rays_from_a_surface_do_not_hit_it_again(
            shape in prop::array::uniform9(-1.0f32..1.0),
            shift in prop::array::uniform3(-1.0f32..1.0),
            size in -12i32..12,
            distance in -12i32..12,
            (u, v) in (0.0f32..1.0, 0.0f32..1.0),
            towards in prop::array::uniform3(-1.0f32..1.0),
        ) {
            let (size, distance) = (10f32.powi(size), 10f32.powi(distance.min(size + 4)));
            let corner = |i: usize| Vec3::from_slice(&shape[i * 3..]) * size + Vec3::from_array(shift) * distance;
            let corners = [corner(0), corner(1), corner(2)];
            let [a, b, c] = corners.map(|c| c.as_dvec3());
            let fatness = (b - a).cross(c - a).length() / (b - a).length_squared().max((c - a).length_squared());
            prop_assume!(fatness > 1e-2);
            let direction = Vec3::from_array(towards);
            prop_assume!(direction.length() > 1e-3);
            let scene = one_triangle(corners);
            let (u, v) = if u + v > 1.0 { (1.0 - u, 1.0 - v) } else { (u, v) };
            let point = SurfacePoint::new(corners, u, v, &scene);
            let side = point.normal * direction.dot(point.normal).signum();
            for start in [point.position, point.interior] {
                let ray = Ray::new(offset_ray_origin(start, side, &scene), direction);
                prop_assert!(scene.intersect_raw(&ray).is_miss(), "{:?} {}", corners, start);
            }
        }

        #[test]
        fn the_interior_point_keeps_its_distance_from_every_edge(
            (u, v) in (0.0f32..1.0, 0.0f32..1.0),
            edge in 0..4,
        ) {
            let corners = [Vec3::new(3.0, 1.0, 2.0), Vec3::new(4.5, 1.5, 2.0), Vec3::new(3.2, 2.5, 3.0)];
            let scene = one_triangle(corners);
            let (u, v) = match edge { 0 => (0.0, v), 1 => (u, 0.0), 2 => (u, 1.0 - u), _ => (0.0, 0.0) };
            let p = SurfacePoint::new(corners, u, v, &scene);
            for i in 0..3 {
                let (a, b) = (corners[i].as_dvec3(), corners[(i + 1) % 3].as_dvec3());
                let inward = p.normal.as_dvec3().cross(b - a).normalize();
                let distance = (p.interior.as_dvec3() - a).dot(inward);
                prop_assert!(distance > 0.9 * EDGE_DISTANCE * ray_epsilon(p.position, &scene) as f64, "{distance:e} from edge {i}");
            }
        }

        /// Slivers are included: their shadows once moved by a third of their length.
        #[test]
        fn the_interior_point_is_in_the_triangle_and_near_the_point(
            (u, v) in (0.0f32..=1.0, 0.0f32..=1.0),
            width in -6.0f32..0.0,
            lean in -1.0f32..2.0,
        ) {
            let corners = [Vec3::ZERO, Vec3::new(10.0, 0.0, 0.0), Vec3::new(10.0 * lean, 10f32.powf(width), 0.0)];
            let scene = one_triangle(corners);
            let (u, v) = if u + v > 1.0 { (1.0 - u, 1.0 - v) } else { (u, v) };
            let p = SurfacePoint::new(corners, u, v, &scene);
            let epsilon = ray_epsilon(p.position, &scene);
            prop_assert!(p.interior.distance(p.position) <= 1.01 * MAX_MOVE as f32 * epsilon);
            for i in 0..3 {
                let (a, b) = (corners[i].as_dvec3(), corners[(i + 1) % 3].as_dvec3());
                let inward = p.normal.as_dvec3().cross(b - a).normalize();
                let distance = (p.interior.as_dvec3() - a).dot(inward);
                prop_assert!(distance > -0.1 * epsilon as f64, "{distance:e} beyond edge {i}");
            }
        }
    }
}
