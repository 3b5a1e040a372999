//! The distance between surfaces and the rays that start on them, which follows from the precision of the scene's
//! coordinates, and a warning if it is too large.

use super::Scene;
use glam::Vec3;

/// Distance of ray origins from surfaces in rounding steps (2^-24 of the magnitude). A hit point interpolated in f64 is
/// within 1, and the triangle tests, relative to the origin, add a handful; the rest is reserve. In a scene of 30 m the
/// distance is 0.06 mm.
const STEPS: f32 = 32.0 / (1 << 24) as f32;

/// Distance in scene units by which [`offset_ray_origin`](crate::trace::offset::offset_ray_origin) moves a point.
#[inline]
pub fn ray_epsilon(position: Vec3, scene: &Scene) -> f32 {
    STEPS * position.abs().max_element().max(scene.extent)
}

/// Returns a warning if rays start further above the scene's surfaces than a `part` of `size`, a length that the caller
/// knows as `what`: so far from the origin, f32 coordinates are not precise enough for it.
pub(crate) fn too_few_digits(scene: &Scene, what: &str, size: f32, part: f32) -> Option<String> {
    let (lower, upper) = scene.bounds();
    let farthest = lower.abs().max(upper.abs());
    let offset = ray_epsilon(farthest, scene);
    (offset > part * size).then(|| {
        format!(
            "coordinates of magnitude {:.2e} have too few digits for {what} of {size:.2e}: rays start {offset:.2e} \
             above surfaces; move the scene nearer to the origin",
            farthest.max_element()
        )
    })
}
