//! Cameras for views of scenes.

use glam::Vec3;

/// A pinhole camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Position in scene units.
    pub position: Vec3,
    /// Point in the middle of the picture.
    pub target: Vec3,
    /// Upward direction, not parallel to the direction of view.
    pub up: Vec3,
    /// Vertical field of view in radians.
    pub fov_y: f32,
}
