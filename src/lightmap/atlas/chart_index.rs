//! Point location in charts: finds the triangle that a point of a chart's plane belongs to.
//!
//! Every chart of more than a few triangles has a uniform grid over its local coordinates; a cell lists the triangles
//! that overlap it. All maps share the index, whatever their resolution.

use super::charts::{Chart, Charts};
use super::flat_triangle::Flat;
use super::ids::ChartId;
use super::layout::Placement;
use super::sheets::{Shape, Sheet};
use super::texels::TexelSample;
use crate::base::array::Array;
use crate::base::error::Result;
use crate::base::memory::{Reservation, try_collect, try_vec, try_with_capacity};
use crate::base::parallel::{ParallelLoop, one_by_one};
use crate::device::Device;
use glam::{DVec2, Vec2};
use rayon::prelude::*;
use std::ops::Range;

/// Maximum number of triangles of a chart without a grid: all of them are tested.
const SMALL: usize = 4;

/// Charts of more triangles than this have the area of [`MANY_PER_CELL`] triangles in a cell, others that of one: the
/// index takes some 9 bytes less per triangle of theirs. (With as many in smaller charts, direct light in the living
/// room took 3 % longer.)
const MANY: usize = 1 << 14;
const MANY_PER_CELL: usize = 4;

/// A grid is made coarser until its cells list at most this many triangles per triangle of the chart.
const ENTRIES_PER_TRIANGLE: usize = 8;

/// Maximum number of triangles tested for one point. Only charts with fans of very many slivers have more in a cell; a
/// point that is not found among these counts as outside.
const MAX_TESTS: usize = 256;

/// Tolerance of barycentric weights below 0, so that no point falls between two triangles.
const TOLERANCE: f64 = 1e-6;

/// Finds triangles of charts by local coordinates.
pub(crate) struct ChartIndex {
    /// Grids, by chart of all sheets.
    grids: Vec<Grid>,
    _memory: Reservation,
}

/// The grid of one chart; without cells if the chart is small.
#[derive(Default)]
struct Grid {
    columns: u32,
    rows: u32,
    /// Cells per unit of the sheet's local coordinates.
    scale: Vec2,
    /// First entry of each cell, and the number of entries.
    start: Array<u32>,
    /// Triangles by their numbers in the sheet, ascending in each cell.
    triangles: Array<u32>,
}

impl Grid {
    fn new(device: &Device, sheet: &Sheet, chart: &Chart) -> Result<Grid> {
        let triangles = &sheet.triangles[chart.triangles.start as usize..chart.triangles.end as usize];
        let size = Vec2::from(chart.size);
        if triangles.len() <= SMALL || !(size.min_element() > 0.0) || !size.is_finite() {
            return Ok(Grid::default());
        }
        let mut cells = if triangles.len() > MANY { triangles.len() / MANY_PER_CELL } else { triangles.len() };
        loop {
            let columns = (cells as f64 * size.x as f64 / size.y as f64).sqrt().clamp(1.0, cells as f64) as u32;
            let rows = (cells as u32 / columns).max(1);
            let scale = Vec2::new(columns as f32, rows as f32) / size;
            let limit = ENTRIES_PER_TRIANGLE * triangles.len();
            if let Some(grid) = Grid::of_cells(device, sheet, triangles, [columns, rows], scale, limit)? {
                return Ok(grid);
            }
            if cells == 1 {
                return Ok(Grid::default());
            }
            cells /= 4;
            cells = cells.max(1);
        }
    }

    /// Makes a grid of given size; `None` if the cells would list more than `limit` triangles.
    fn of_cells(
        device: &Device,
        sheet: &Sheet,
        triangles: &[u32],
        [columns, rows]: [u32; 2],
        scale: Vec2,
        limit: usize,
    ) -> Result<Option<Grid>> {
        if !scale.is_finite() {
            return Ok(None);
        }
        let size = [columns as i64, rows as i64];
        let flat = |t: u32| Flat(sheet.corners[t as usize].map(|c| Vec2::from(c).as_dvec2() * scale.as_dvec2()));
        let what = "the index of a chart";
        let mut start: Vec<u32> = try_vec(columns as usize * rows as usize + 1, what)?;
        let mut entries = 0;
        for &t in triangles {
            flat(t).for_each_touched(size, |x, y| {
                start[(y * size[0] + x) as usize + 1] += 1;
                entries += 1;
            });
            if entries > limit {
                return Ok(None);
            }
        }
        for i in 1..start.len() {
            start[i] += start[i - 1];
        }
        let (mut next, mut listed): (Vec<u32>, Vec<u32>) = (try_vec(start.len(), what)?, try_vec(entries, what)?);
        next.copy_from_slice(&start);
        for &t in triangles {
            flat(t).for_each_touched(size, |x, y| {
                let next = &mut next[(y * size[0] + x) as usize];
                listed[*next as usize] = t;
                *next += 1;
            });
        }
        Ok(Some(Grid {
            columns,
            rows,
            scale,
            start: device.copy(&start, what)?,
            triangles: device.copy(&listed, what)?,
        }))
    }

    fn around(&self, local: Vec2) -> &[u32] {
        let cell = (local * self.scale).max(Vec2::ZERO);
        let (x, y) = ((cell.x as u32).min(self.columns - 1), (cell.y as u32).min(self.rows - 1));
        let cell = (y * self.columns + x) as usize;
        &self.triangles[self.start[cell] as usize..self.start[cell + 1] as usize]
    }

    fn bytes(&self) -> usize {
        size_of::<Grid>() + 4 * (self.start.len() + self.triangles.len())
    }
}

impl ChartIndex {
    /// Indexes all charts.
    pub(crate) fn new(device: &Device, charts: &Charts) -> Result<ChartIndex> {
        let shapes = charts.sheets().flat_map(|(sheet, charts)| charts.iter().map(move |chart| (sheet, chart)));
        let shapes = try_collect(shapes, "the index of the charts")?;
        let mut grids: Vec<Grid> = try_with_capacity(shapes.len(), "the index of the charts")?;
        grids.resize_with(shapes.len(), Grid::default);
        device.install(|| {
            one_by_one(grids.par_iter_mut().zip(shapes)).try_each(|(grid, (sheet, chart))| {
                *grid = Grid::new(device, sheet, chart)?;
                Ok(())
            })
        })?;
        let bytes = device.in_memory(grids.iter().map(Grid::bytes).sum());
        Ok(ChartIndex { grids, _memory: device.memory().reserve(bytes, "the index of the charts")? })
    }

    /// Returns the size in bytes.
    pub(crate) fn bytes(&self) -> usize {
        self.grids.iter().map(Grid::bytes).sum()
    }

    /// Returns the point of a chart at local coordinates, `None` outside of its triangles. If triangles overlap,
    /// `first` is preferred, then the lowest number.
    pub(crate) fn locate(&self, charts: &Charts, chart: ChartId, local: Vec2, first: u32) -> Option<TexelSample> {
        let Shape { sheet, first_triangle, factor, number } = charts.shape(chart);
        let local = local / factor;
        let inside = |t: u32| {
            let [u, v] = weights(sheet.corners[t as usize], local)?;
            Some(TexelSample { triangle: first_triangle + t, u, v, ..Default::default() })
        };
        let grid = &self.grids[number];
        let Range { start, end } = charts[chart].triangles;
        let all = &sheet.triangles[start as usize..end as usize];
        let triangles = if grid.columns > 0 { grid.around(local) } else { all };
        inside(first - first_triangle).or_else(|| triangles.iter().take(MAX_TESTS).find_map(|&t| inside(t)))
    }

    /// Returns the point of a sample's chart at a place in the sample's texel, (0, 0) to (1, 1); `None` outside of the chart's
    /// triangles. `placement` is the sample's. If triangles overlap, the sample's is preferred.
    pub(crate) fn in_texel(
        &self,
        charts: &Charts,
        placement: &Placement,
        sample: &TexelSample,
        [x, y]: [f32; 2],
    ) -> Option<TexelSample> {
        let local = placement.local([f32::from(sample.x) + x, f32::from(sample.y) + y]);
        let point = self.locate(charts, charts.chart_of(sample.triangle), local.into(), sample.triangle)?;
        Some(TexelSample { x: sample.x, y: sample.y, ..point })
    }
}

/// Returns the barycentric weights of corners 1 and 2 for a point in a triangle.
fn weights(corners: [[f32; 2]; 3], p: Vec2) -> Option<[f32; 2]> {
    let [a, b, c] = corners.map(|c| Vec2::from(c).as_dvec2());
    let (p, edge_u, edge_v): (DVec2, DVec2, DVec2) = (p.as_dvec2() - a, b - a, c - a);
    let twice_area = edge_u.perp_dot(edge_v);
    let (u, v) = (p.perp_dot(edge_v) / twice_area, edge_u.perp_dot(p) / twice_area);
    // The comparison is false for the NaN of triangles without area.
    let inside = u >= -TOLERANCE && v >= -TOLERANCE && u + v <= 1.0 + TOLERANCE;
    inside.then(|| {
        let (u, v) = (u.clamp(0.0, 1.0), v.clamp(0.0, 1.0));
        let sum = (u + v).max(1.0);
        [(u / sum) as f32, (v / sum) as f32]
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::progress::Progress;
    use crate::base::sampling::{sobol_2d, uniform_triangle};
    use crate::scene::builtin;

    #[test]
    fn every_point_of_every_triangle_is_found_where_it_is() {
        for name in ["cornell", "atrium"] {
            let scene = builtin(name).unwrap().committed();
            let (charts, _) = Charts::of_scene(&scene, 20.0, 1024, 2, &Progress::none()).unwrap();
            let index = ChartIndex::new(scene.device(), &charts).unwrap();
            let mut gridded = 0;
            for t in (0..scene.triangle_count()).step_by(7).filter(|&t| scene.is_valid(t)) {
                let chart = charts.chart_of(t);
                gridded += (index.grids[chart.index()].columns > 0) as u32;
                for i in 0..4 {
                    let [u, v] = uniform_triangle(sobol_2d(i, t));
                    let local = Vec2::from(charts.local(t, u, v));
                    // By way of the grid alone: another triangle is named as the first.
                    let other = charts.triangles_of(chart).next().unwrap();
                    let found = index.locate(&charts, chart, local, other).expect("a point of the chart");
                    let place = Vec2::from(charts.local(found.triangle, found.u, found.v));
                    assert!(place.distance(local) < 1e-4 * (1.0 + local.length()), "{place} {local}");
                }
                let outside = Vec2::from(charts[chart].size) * 1.01 + 0.01;
                assert!(index.locate(&charts, chart, outside, t).is_none());
            }
            assert!(gridded > 0 || name == "cornell", "no chart of {name} has a grid");
        }
    }
}
