//! Receivers: points that receive light, each on one side of its surface.

use super::shadow_terminator;
use crate::scene::Scene;
use crate::trace::offset::{SurfacePoint, offset_ray_origin};
use glam::Vec3;

/// A point that receives light.
#[derive(Clone, Copy, Debug)]
pub struct Receiver {
    /// Origin of rays from the point.
    pub origin: Vec3,
    /// Unit normal of the irradiance.
    pub normal: Vec3,
    /// Unit geometric normal on the same side.
    pub geometric: Vec3,
    /// The point at which light is computed: on the surface, or raised from it.
    pub position: Vec3,
    /// Origin of shadow rays from the point.
    pub shadow_origin: Vec3,
    /// Whether the point is raised to the smooth surface of its normals, where the flat one must not shade it.
    pub raised: bool,
}

impl Receiver {
    /// Makes a receiver on the front (or back) of a triangle at a point. `shading` is the interpolated normal, if the
    /// mesh has any; it is turned to that side.
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

    /// Raises the receiver on a mesh with normals, given those of the corners of the point's triangle.
    pub(crate) fn smooth(self, scene: &Scene, corners: [Vec3; 3], normals: [Vec3; 3], uv: [f32; 2]) -> Receiver {
        let normals = normals.map(|n| if n.dot(self.geometric) < 0.0 { -n } else { n });
        match shadow_terminator::raised(scene, corners, normals, uv, self.geometric, self.origin) {
            Some(p) => Receiver { position: p, shadow_origin: p, raised: true, ..self },
            None => self,
        }
    }

    /// Whether the flat surface faces a direction; always true for raised points, where that does not matter.
    pub(crate) fn faces(&self, direction: Vec3) -> bool {
        self.raised || direction.dot(self.geometric) > 0.0
    }
}
