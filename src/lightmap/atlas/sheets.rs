//! Sheets: unwrapped surfaces with numbers of triangles and charts of their own. The meshes that stand in the scene
//! themselves are one sheet. An instance has the sheet of the first instance that is unwrapped [alike](super::alike), with
//! a factor of its lengths: however many instances there are, their charts take memory and time once.

use super::ids::ChartId;
use super::pieces::{CHARTS, Given, Piece, triangle_area};
use crate::base::array::Array;
use crate::base::error::Result;
use crate::base::memory::try_push;
use crate::base::progress::Stage;
use crate::scene::Scene;
use glam::Vec2;
use std::ops::Range;

/// A piece of surface with continuous texture coordinates.
#[derive(Clone, Debug, PartialEq)]
pub struct Chart {
    /// Triangles of the chart, as a range of its sheet's.
    pub triangles: Range<u32>,
    /// Extent of the chart's local coordinates, which start at (0, 0), in scene units.
    pub size: [f32; 2],
    /// Surface area, in squared scene units.
    pub area: f32,
    /// Whether the chart's material is two-sided.
    pub two_sided: bool,
    /// Placement in the light map by the caller's UVs, if any.
    pub given: Option<Given>,
}

/// An unwrapped surface.
#[derive(Clone, Debug, Default, PartialEq)]
pub(in crate::lightmap) struct Sheet {
    /// Triangles by their numbers in the sheet, chart by chart, ascending in each.
    pub triangles: Array<u32>,
    /// Number in the sheet of each triangle's chart, [`ChartId::NONE`] for degenerate ones.
    pub of_triangles: Array<ChartId>,
    /// Local coordinates of the corners of each triangle, in units of the object that the sheet was made of.
    pub corners: Array<[[f32; 2]; 3]>,
    /// Where the sheet was made: global number of its first triangle, and its charts among those of the scene.
    pub first_triangle: u32,
    pub charts: Range<u32>,
    /// Number of its first chart among those of all sheets.
    pub first_shape: u32,
}

/// Where a sheet stands in the scene: an instance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in crate::lightmap) struct Place {
    /// Global number of the first triangle.
    pub first_triangle: u32,
    /// Its first chart; of an instance without charts of its own, the next one's.
    pub first_chart: ChartId,
    /// Number of the instance whose charts it has: another one's if it shows the light of that.
    pub shown: u32,
    /// Number of instances that have its charts; 0 if it has none of its own.
    pub times: u32,
    /// Index among the sheets of instances.
    pub sheet: u32,
    /// Scene units per unit of the sheet's local coordinates, in the instance whose charts it has.
    pub factor: f32,
}

/// A chart as it is in its sheet.
pub(in crate::lightmap) struct Shape<'a> {
    pub sheet: &'a Sheet,
    /// Global number of the sheet's first triangle.
    pub first_triangle: u32,
    /// Scene units per unit of the sheet's local coordinates.
    pub factor: f32,
    /// Number among the charts of all sheets.
    pub number: usize,
}

impl Sheet {
    /// Makes a sheet of pieces, with global triangle numbers of `range`, and appends its charts to `charts`.
    pub(super) fn new(
        scene: &Scene,
        range: Range<u32>,
        pieces: impl Iterator<Item = Piece>,
        charts: &mut Vec<Chart>,
        first_shape: usize,
        stage: &Stage,
    ) -> Result<Sheet> {
        let (total, device) = (range.len(), scene.device());
        let first_chart = charts.len();
        let mut sheet = Sheet {
            // Untouched until a piece is moved there, which is then freed.
            triangles: device.zeroed(total, CHARTS)?,
            of_triangles: device.zeroed(total, CHARTS)?,
            corners: device.zeroed(total, CHARTS)?,
            first_triangle: range.start,
            charts: first_chart as u32..first_chart as u32,
            first_shape: first_shape as u32,
        };
        sheet.of_triangles.fill(ChartId::NONE);
        let mut count = 0;
        for piece in pieces {
            stage.check()?;
            let points = piece.corners.iter().flatten().map(|&p| Vec2::from_array(p));
            let (lower, upper) =
                points.fold((Vec2::INFINITY, Vec2::NEG_INFINITY), |(lo, hi), p| (lo.min(p), hi.max(p)));
            let first = count as u32;
            let mut area = 0.0;
            for (&t, corners) in piece.triangles.iter().zip(&piece.corners) {
                let own = t - range.start;
                sheet.of_triangles[own as usize] = ChartId::new(charts.len() - first_chart);
                sheet.corners[own as usize] = corners.map(|c| (Vec2::from_array(c) - lower).to_array());
                sheet.triangles[count] = own;
                count += 1;
                area += triangle_area(scene, t);
            }
            let chart = Chart {
                triangles: first..count as u32,
                size: (upper - lower).to_array(),
                area: area as f32,
                two_sided: scene.material(piece.triangles[0]).two_sided,
                given: piece.given,
            };
            try_push(charts, chart, CHARTS)?;
        }
        sheet.charts.end = charts.len() as u32;
        sheet.triangles.truncate(count);
        Ok(sheet)
    }

    pub(super) fn bytes(&self) -> usize {
        self.corners.len() * 24 + (self.triangles.len() + self.of_triangles.len()) * 4
    }
}

impl Shape<'_> {
    /// Returns the local coordinates of the corners of a triangle of the sheet.
    #[inline]
    pub fn corners(&self, triangle: u32) -> [[f32; 2]; 3] {
        scaled(self.sheet.corners[triangle as usize], self.factor)
    }
}

/// Scales local coordinates by a factor. (By 1, bits stay.)
#[inline]
pub(super) fn scaled(corners: [[f32; 2]; 3], factor: f32) -> [[f32; 2]; 3] {
    corners.map(|c| c.map(|x| x * factor))
}
