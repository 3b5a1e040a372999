//! Points that receive light, on the side of the surface that they are on.

use super::shadow_terminator;
use crate::scene::Scene;
use crate::trace::offset::{SurfacePoint, offset_ray_origin};
use glam::Vec3;

/// A point that receives light.
#[derive(Clone, Copy, Debug)]
pub struct Receiver {
    /// Where its rays start.
    pub origin: Vec3,
    /// Unit normal of the irradiance.
    pub normal: Vec3,
    /// Unit geometric normal on the same side.
    pub geometric: Vec3,
    /// The point whose light is wanted: on the surface, or raised from it.
    pub position: Vec3,
    /// Where its shadow rays start.
    pub shadow_origin: Vec3,
    /// Raised to the smooth surface that its normals stand on: the flat one shades nothing there.
    pub raised: bool,
}

impl Receiver {
    /// The front (or back) of a point of a triangle. `shading` is the interpolated normal, if the
    /// mesh has any; it is turned to the side.
    pub fn new(scene: &Scene, point: &SurfacePoint, shading: Option<Vec3>, back: bool) -> Receiver {
        let geometric = if back { -point.normal } else { point.normal };
        let normal = match shading {
            Some(n) if n.dot(geometric) < 0.0 => -n,
            Some(n) => n,
            None => geometric,
        };
        let origin = offset_ray_origin(point.interior, geometric, scene);
        Receiver { origin, normal, geometric, position: point.position, shadow_origin: origin, raised: false }
    }

    /// The same on a mesh with normals: those of the corners of the point's triangle.
    pub(crate) fn smooth(self, scene: &Scene, corners: [Vec3; 3], normals: [Vec3; 3], uv: [f32; 2]) -> Receiver {
        let normals = normals.map(|n| if n.dot(self.geometric) < 0.0 { -n } else { n });
        match shadow_terminator::raised(scene, corners, normals, uv, self.geometric, self.origin) {
            Some(p) => Receiver { position: p, shadow_origin: p, raised: true, ..self },
            None => self,
        }
    }

    /// Whether the flat surface faces what lies in a direction, as far as that matters.
    pub(crate) fn faces(&self, direction: Vec3) -> bool {
        self.raised || direction.dot(self.geometric) > 0.0
    }
}
