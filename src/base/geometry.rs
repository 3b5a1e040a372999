//! Triangles and boxes: validity of triangles, normals, and areas.

use glam::Vec3;

/// Index that means "no triangle", "no chart", …: never a valid one.
pub const NONE: u32 = u32::MAX;

/// Coordinates up to this magnitude are valid: products of three of them stay finite in f32, as the
/// triangle test needs.
pub const MAX_COORDINATE: f32 = 1e12;

/// Whether a triangle has finite corners in the valid range and an area. Corners on a line count as having no area only
/// if the f64 cross product is exactly zero: slivers are kept.
#[inline]
pub fn is_valid_triangle(corners: [Vec3; 3]) -> bool {
    let in_range = corners.iter().all(|c| c.abs().max_element() <= MAX_COORDINATE && !c.is_nan());
    let [a, b, c] = corners.map(|c| c.as_dvec3());
    in_range && (b - a).cross(c - a).length_squared() > 0.0
}

/// Unit normal of a valid triangle, computed in f64.
#[inline]
pub fn unit_normal(corners: [Vec3; 3]) -> Vec3 {
    let [a, b, c] = corners.map(|c| c.as_dvec3());
    (b - a).cross(c - a).normalize_or_zero().as_vec3()
}

/// Half the surface area of a box. Computed in f64: sums over huge scenes neither overflow nor cancel.
pub(crate) fn half_area(lower: Vec3, upper: Vec3) -> f64 {
    let d = (upper - lower).max(Vec3::ZERO).as_dvec3();
    d.x * d.y + d.y * d.z + d.z * d.x
}
