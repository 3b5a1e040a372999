//! The photon map (thesis 3.2.2). PLACEHOLDER: signatures that the other modules use.
use crate::error::Result;
use crate::progress::Progress;
use crate::scene::Scene;
use glam::Vec3;
use std::sync::Arc;

/// Parameters of a photon map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PhotonParams {
    /// Photons emitted.
    pub photon_count: u64,
    /// Most surface interactions per photon; 0: Russian roulette alone ends paths.
    pub max_bounces: u32,
    /// Search radius of the estimate in scene units; 0: chosen from the density of stored photons.
    pub radius: f32,
    /// Half the height of the search cylinder, as a fraction of the radius.
    pub half_height: f32,
    /// Jensen's cone filter constant, ≥ 1; infinity: no filter.
    pub cone_k: f32,
    pub seed: u64,
    /// Bytes that the map may take; 0: no limit.
    pub memory_budget: u64,
    /// Whether photons are stored at their first surface too (direct light).
    pub store_direct: bool,
}

impl Default for PhotonParams {
    fn default() -> Self {
        PhotonParams {
            photon_count: 1_000_000,
            max_bounces: 0,
            radius: 0.0,
            half_height: 0.25,
            cone_k: 1.1,
            seed: 0,
            memory_budget: 0,
            store_direct: true,
        }
    }
}

/// What tracing did.
#[derive(Clone, Copy, Debug, Default)]
pub struct PhotonStats {
    pub emitted: u64,
    pub stored: u64,
    pub rays: u64,
    /// Power of all lights, W per channel.
    pub emitted_power: [f64; 3],
    pub absorbed_power: [f64; 3],
    pub escaped_power: [f64; 3],
    pub trace_seconds: f64,
    pub grid_seconds: f64,
}

/// Photons on the surfaces of a scene, in a uniform grid.
pub struct PhotonMap {
    scene: Arc<Scene>,
}

impl PhotonMap {
    /// Emits, traces and sorts photons.
    pub fn trace(scene: &Arc<Scene>, params: &PhotonParams, progress: &Progress) -> Result<PhotonMap> {
        let _ = (params, progress);
        Ok(PhotonMap { scene: scene.clone() })
    }
    /// The scene that it was made from.
    pub fn scene(&self) -> &Arc<Scene> {
        &self.scene
    }
    /// Numbers about the tracing.
    pub fn stats(&self) -> PhotonStats {
        PhotonStats::default()
    }
    /// Search radius in use.
    pub fn radius(&self) -> f32 {
        0.0
    }
    /// Bytes held.
    pub fn bytes(&self) -> usize {
        0
    }
    /// Irradiance (W/m²) at `position` on the side that the unit vector `normal` points to.
    pub fn estimate(&self, position: Vec3, normal: Vec3) -> [f32; 3] {
        let _ = (position, normal);
        [0.0; 3]
    }
    /// Stored photons: positions, directions of travel (unit), powers.
    pub fn photons(&self) -> (&[[f32; 3]], &[[f32; 3]], &[[f32; 3]]) {
        (&[], &[], &[])
    }
}
