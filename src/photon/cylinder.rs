//! The cylinder in which photons count for an estimate, and Jensen's cone filter in it.

use super::PhotonView;
use glam::Vec3;

/// Minimum cosine between a photon's surface normal and the estimate's: 60°, coarse tessellations of columns and vaults
/// included.
pub(super) const SAME_SURFACE: f32 = 0.5;

/// The searched volume, with its filter.
#[derive(Clone, Copy, Debug)]
pub(super) struct Cylinder {
    pub(super) radius: f32,
    /// Half the height, as a fraction of the radius.
    pub(super) half_height: f32,
    pub(super) inverse_k: f32,
    /// Factor from filtered power to irradiance.
    pub(super) scale: f64,
}

impl Cylinder {
    /// Makes the cylinder from parameters that have been checked.
    pub(super) fn new(radius: f32, half_height: f32, cone_k: f32) -> Self {
        let r = radius as f64;
        let inverse_k = 1.0 / cone_k as f64;
        let area = (1.0 - inverse_k * 2.0 / 3.0) * std::f64::consts::PI * r * r;
        Cylinder { radius, half_height, inverse_k: inverse_k as f32, scale: 1.0 / area }
    }

    /// Weight of a photon at a distance from the axis, in radii.
    pub(super) fn filter(&self, distance: f32) -> f32 {
        1.0 - distance * self.inverse_k
    }

    /// Weight of photon `i` in the estimate at a point; `None` if it does not count.
    pub(super) fn weight(&self, photons: &PhotonView, i: usize, position: Vec3, normal: Vec3) -> Option<f32> {
        let dot = |columns: &[&[f32]; 3]| Vec3::new(columns[0][i], columns[1][i], columns[2][i]).dot(normal);
        let [x, y, z] = photons.position.map(|column| column[i]);
        let d = (Vec3::new(x, y, z) - position) / self.radius;
        let height = d.dot(normal);
        let radial2 = d.length_squared() - height * height;
        let inside = radial2 <= 1.0 && height.abs() <= self.half_height;
        let counts = inside && dot(&photons.direction) < 0.0 && dot(&photons.normal) >= SAME_SURFACE;
        counts.then(|| self.filter(radial2.max(0.0).sqrt()))
    }
}
