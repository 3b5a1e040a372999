//! Light maps (thesis 3.2.3 to 3.2.6). PLACEHOLDER: signatures that the other modules use.

pub mod charts;
pub mod layout;
pub mod texels;

use crate::error::Result;
use crate::progress::Progress;
use crate::scene::Scene;
use std::sync::Arc;

/// How a light map is laid out.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LightmapDesc {
    /// Texels per scene unit; 0: chosen so that the scene fills about four pages.
    pub texels_per_unit: f32,
    /// Width and height of a page in texels, 16 to 16384.
    pub page_size: u32,
    /// Texels around each chart that filtering may read, ≥ 1.
    pub padding: u32,
    /// Light map texels per gather map texel, along each axis.
    pub gather_divisor: u32,
    /// Light map texels per radiance map texel, along each axis.
    pub radiance_divisor: u32,
}

impl Default for LightmapDesc {
    fn default() -> Self {
        LightmapDesc { texels_per_unit: 0.0, page_size: 1024, padding: 2, gather_divisor: 4, radiance_divisor: 8 }
    }
}

/// Numbers about a light map.
#[derive(Clone, Copy, Debug, Default)]
pub struct LightmapInfo {
    pub page_count: u32,
    pub width: u32,
    pub height: u32,
    pub charts: u32,
    /// Texels that a triangle covers.
    pub texels: u64,
    pub gather_texels: u64,
    pub radiance_texels: u64,
    pub bytes: u64,
    pub unwrap_seconds: f64,
    pub texels_per_unit: f32,
    pub uvs: charts::UvReport,
}

/// How to bake.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BakeParams {
    pub photon_count: u64,
    /// 0: Russian roulette alone.
    pub max_bounces: u32,
    /// Rays per gather map texel; 0: no indirect light.
    pub gather_rays: u32,
    /// Photon search radius; 0: automatic.
    pub radius: f32,
    /// Radius of the gather map's blur in its texels; 0: none.
    pub blur_radius: u32,
    /// Shadow rays per light map texel and area light.
    pub direct_samples: u32,
    pub seed: u64,
    /// Bytes that the bake may take in addition; 0: no limit.
    pub memory_budget: u64,
    /// Only these of the light map's covered texels, in chart order; `texel_end` 0: all.
    pub texel_begin: u64,
    pub texel_end: u64,
}

impl Default for BakeParams {
    fn default() -> Self {
        BakeParams {
            photon_count: 1_000_000,
            max_bounces: 0,
            gather_rays: 64,
            radius: 0.0,
            blur_radius: 2,
            direct_samples: 16,
            seed: 0,
            memory_budget: 0,
            texel_begin: 0,
            texel_end: 0,
        }
    }
}

/// Wall time and work of one stage.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StageStats {
    pub seconds: f64,
    pub rays: u64,
    pub bytes: u64,
}

/// What a bake did.
#[derive(Clone, Copy, Debug, Default)]
pub struct BakeStats {
    pub photons: StageStats,
    pub photons_emitted: u64,
    pub photons_stored: u64,
    pub radiance: StageStats,
    pub gather: StageStats,
    pub direct: StageStats,
    pub compose: StageStats,
    pub seconds: f64,
    pub peak_bytes: u64,
    /// Bits of [`left_out`].
    pub left_out: u32,
}

/// What a bake can read out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum Layer {
    /// Irradiance, direct plus indirect (RGB, W/m²).
    Combined = 0,
    Indirect = 1,
    Direct = 2,
    /// Outgoing radiance (RGB, W/(m²·sr)).
    Radiance = 3,
    /// 1 where a valid texel, 0.5 where filled from neighbours, 0 elsewhere.
    Validity = 4,
    /// World position of the texel's sample (RGB).
    Position = 5,
    /// Unit normal of the texel's sample (RGB).
    Normal = 6,
    /// Global triangle number (u32), [`crate::scene::NONE`] where there is none.
    Triangle = 7,
}

/// The content of one layer of one page, row-major, row 0 at v = 0.
#[derive(Clone, Debug)]
pub enum LayerData {
    Rgb(Vec<[f32; 3]>),
    Scalar(Vec<f32>),
    Integer(Vec<u32>),
}

/// Light maps of a scene: layout, texels and, after [`bake`](Lightmap::bake), light.
pub struct Lightmap {
    scene: Arc<Scene>,
}

impl Lightmap {
    /// Unwraps what brings no UVs, lays out the pages and maps texels to triangles.
    pub fn create(scene: &Arc<Scene>, desc: &LightmapDesc, progress: &Progress) -> Result<Lightmap> {
        let _ = (desc, progress);
        Ok(Lightmap { scene: scene.clone() })
    }
    pub fn scene(&self) -> &Arc<Scene> {
        &self.scene
    }
    pub fn info(&self) -> LightmapInfo {
        LightmapInfo::default()
    }
    /// Light map UV in [0, 1] of each corner, and the page of each triangle of `mesh` (page
    /// [`crate::scene::NONE`] for triangles without texels).
    pub fn mesh_uvs(&self, mesh: u32) -> Result<(Vec<[[f32; 2]; 3]>, Vec<u32>)> {
        let _ = mesh;
        Ok((vec![], vec![]))
    }
    /// Runs the pipeline. On an error or a cancel what was baked before is kept.
    pub fn bake(&mut self, params: &BakeParams, progress: &Progress) -> Result<BakeStats> {
        let _ = (params, progress);
        Ok(BakeStats::default())
    }
    /// One layer of one page. Light layers need a bake (`InvalidState` before).
    pub fn read(&self, page: u32, layer: Layer) -> Result<LayerData> {
        let _ = (page, layer);
        Ok(LayerData::Rgb(vec![]))
    }
    /// What a bake runs and what it leaves out and why, as text.
    pub fn plan_text(&self) -> String {
        String::new()
    }
    /// Irradiance (direct + indirect) as a shader would see it: filtered light map at a point of a
    /// global triangle (barycentric weights of vertices 1 and 2). Zero before a bake.
    pub fn sample(&self, layer: Layer, triangle: u32, u: f32, v: f32) -> [f32; 3] {
        let _ = (layer, triangle, u, v);
        [0.0; 3]
    }
}
