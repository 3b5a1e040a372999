//! A map of one resolution: the layout of the charts in it, and its texels.

use super::charts::Charts;
use super::layout::Layout;
use super::texels::{TexelMap, TexelSample};
use crate::base::error::Result;
use crate::base::progress::Stage;
use crate::direct::Receiver;
use crate::scene::{NONE, Scene};
use crate::trace::offset::SurfacePoint;
use glam::Vec3;
use std::ops::Range;

/// Layout and texels of the light map, the gather map or the radiance map.
pub(crate) struct ChartMap {
    pub layout: Layout,
    pub texels: TexelMap,
    /// First sample of the separate texels for backs.
    pub back_start: usize,
}

impl ChartMap {
    pub(crate) fn new(scene: &Scene, charts: &Charts, layout: Layout, stage: &Stage) -> Result<Self> {
        let texels = TexelMap::build(scene, charts, &layout, stage)?;
        let fronts = layout.placements.len() - layout.back_of.len();
        let back_start = texels.chart_start[fronts] as usize;
        Ok(ChartMap { layout, texels, back_start })
    }

    /// Returns the number of texels that show a surface.
    pub(crate) fn len(&self) -> usize {
        self.texels.samples.len()
    }

    pub(crate) fn bytes(&self) -> usize {
        self.texels.bytes() + size_of_val(&self.layout.placements[..])
    }

    /// Returns column and row of a sample in its page.
    #[inline]
    pub(crate) fn position(&self, sample: usize) -> (i32, i32) {
        let t = &self.texels.samples[sample];
        (t.x as i32, t.y as i32)
    }

    /// Returns the samples of a placement.
    pub(crate) fn samples_of(&self, placement: u32) -> Range<usize> {
        let r = self.texels.samples_of(placement);
        r.start as usize..r.end as usize
    }

    /// Returns the sample of a placement at a column and row, [`NONE`] if there is none.
    #[inline]
    pub(crate) fn at(&self, placement: u32, x: i32, y: i32) -> u32 {
        if x < 0 || y < 0 { NONE } else { self.texels.texel_index(placement, x as u32, y as u32) }
    }

    /// Returns the sample nearest to a point of a placed chart; `None` if the placement has no texel (a given chart
    /// that others cover).
    #[inline]
    pub(crate) fn nearest(&self, placement: u32, local: [f32; 2]) -> Option<u32> {
        let sample = self.texels.nearest(placement, self.layout.texel_coord(placement, local));
        (sample != NONE).then_some(sample)
    }

    /// Calls `visit` with the samples to interpolate between and their weights, which sum to 1; not
    /// at all if the placement has no texel.
    #[inline(always)] // sums stay in registers: reading live light takes 69 ns per texel, otherwise 80
    pub(crate) fn bilinear(&self, placement: u32, local: [f32; 2], mut visit: impl FnMut(usize, f32)) {
        let b = self.texels.bilinear(placement, self.layout.texel_coord(placement, local));
        for (s, w) in b.samples.into_iter().zip(b.weights) {
            if w > 0.0 && s != NONE {
                visit(s as usize, w);
            }
        }
    }

    /// Returns the point of a sample, and one side of it as a receiver.
    pub(crate) fn receiver(&self, scene: &Scene, sample: usize, back: bool) -> (SurfacePoint, Receiver) {
        receiver_of(scene, &self.texels.samples[sample], back)
    }

    /// Whether a sample is one of the separate texels for backs.
    #[inline]
    pub(crate) fn is_back(&self, sample: usize) -> bool {
        sample >= self.back_start
    }

    /// Returns the placement of a sample.
    #[inline]
    pub(crate) fn placement_of(&self, charts: &Charts, sample: usize) -> u32 {
        let chart = charts.chart_of[self.texels.samples[sample].triangle as usize];
        if self.is_back(sample) { self.layout.place_of(chart, false) } else { chart }
    }

    /// Returns position and normal of a sample.
    pub(crate) fn surface(&self, scene: &Scene, sample: usize) -> (Vec3, Vec3) {
        let t = &self.texels.samples[sample];
        (t.position(scene), t.shading_normal(scene))
    }
}

/// Returns a point of a triangle, and its front or back as a receiver.
pub(in crate::lightmap) fn receiver_of(scene: &Scene, t: &TexelSample, back: bool) -> (SurfacePoint, Receiver) {
    let point = SurfacePoint::new(scene.corners(t.triangle), t.u, t.v, scene);
    let (mesh, triangle) = scene.locate(t.triangle);
    let mesh = &scene.meshes()[mesh as usize];
    if mesh.normals.is_empty() {
        let receiver = Receiver::new(scene, &point, None, back);
        return (point, receiver);
    }
    let receiver = Receiver::new(scene, &point, Some(t.shading_normal(scene)), back);
    let normals = mesh.indices[triangle as usize].map(|i| mesh.normals[i as usize]);
    let receiver = receiver.smooth(scene, mesh.corners(triangle as usize), normals, [t.u, t.v]);
    (point, receiver)
}
