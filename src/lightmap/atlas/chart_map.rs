//! A map of one resolution: the layout of the charts in it, and its texels.

use super::charts::Charts;
use super::ids::{ChartId, Map, PlacementId, TexelId, TexelRange};
use super::layout::Layout;
use super::texels::{TexelMap, TexelSample};
use crate::base::error::Result;
use crate::base::memory::try_par_collect;
use crate::base::progress::Stage;
use crate::base::sampling::combine;
use crate::direct::Receiver;
use crate::scene::{NONE, Object, Scene};
use crate::trace::offset::{Facet, SurfacePoint};
use glam::Vec3;
use rayon::prelude::*;
use std::marker::PhantomData;
use std::ops::{Index, Range};

/// Layout and texels of map `M`: the light map, the gather map or the radiance map. Indexed by texels, it returns the
/// sample of each.
pub(crate) struct ChartMap<M: Map> {
    pub layout: Layout,
    pub texels: TexelMap,
    /// First of the separate texels for backs.
    pub back_start: TexelId<M>,
    /// What is added to the number of a texel, by placement, to make its [`seed`](Self::seed).
    seeds: Vec<u32>,
    of: PhantomData<M>,
}

impl<M: Map> Index<TexelId<M>> for ChartMap<M> {
    type Output = TexelSample;

    #[inline]
    fn index(&self, texel: TexelId<M>) -> &TexelSample {
        &self.texels.samples[texel.index()]
    }
}

impl<M: Map> ChartMap<M> {
    pub(crate) fn new(scene: &Scene, charts: &Charts, layout: Layout, stage: &Stage) -> Result<Self> {
        let texels = TexelMap::build(scene, charts, &layout, stage)?;
        let fronts = layout.placements.len() - layout.back_of.len();
        let back_start = TexelId::new(texels.chart_start[fronts] as usize);
        let seeds = seeds(scene, charts, &layout, &texels)?;
        Ok(ChartMap { layout, texels, back_start, seeds, of: PhantomData })
    }

    /// Copies the map, with the samples of placements that are `anew` as [`new`](Self::new) makes them.
    pub(in crate::lightmap) fn copied(
        &self,
        scene: &Scene,
        charts: &Charts,
        anew: &(dyn Fn(PlacementId) -> bool + Sync),
        stage: &Stage,
    ) -> Result<Self> {
        let texels = self.texels.copied(scene, charts, &self.layout, anew, stage)?;
        let seeds = seeds(scene, charts, &self.layout, &texels)?;
        Ok(ChartMap { layout: self.layout.try_clone()?, texels, back_start: self.back_start, seeds, of: PhantomData })
    }

    /// Returns the number of texels that show a surface.
    pub(crate) fn len(&self) -> usize {
        self.texels.samples.len()
    }

    pub(crate) fn bytes(&self) -> usize {
        self.texels.bytes() + size_of_val(&self.layout.placements[..]) + size_of_val(&self.seeds[..])
    }

    /// Returns all texels.
    pub(crate) fn all(&self) -> TexelRange<M> {
        TexelId::range(0..self.len())
    }

    /// Returns column and row of a texel in its page.
    #[inline]
    pub(crate) fn position(&self, texel: TexelId<M>) -> (i32, i32) {
        let t = &self[texel];
        (t.x as i32, t.y as i32)
    }

    /// Returns the texels of a placement.
    pub(crate) fn texels_of(&self, placement: PlacementId) -> TexelRange<M> {
        let r = self.texels.samples_of(placement);
        TexelId::range(r.start as usize..r.end as usize)
    }

    /// Returns a seed of random numbers for a texel. It goes by where its chart lies and by its place in it: in a scene with
    /// more or fewer meshes, texels of the others draw the same numbers, so that their light differs by what the meshes
    /// change alone.
    #[inline]
    pub(crate) fn seed(&self, texel: TexelId<M>) -> u32 {
        self.seed_in(self.texels.placement_of(texel.index() as u32), texel)
    }

    /// Returns the [`seed`](Self::seed) of a texel of a placement.
    #[inline]
    pub(crate) fn seed_in(&self, placement: PlacementId, texel: TexelId<M>) -> u32 {
        self.seeds[placement.index()].wrapping_add(texel.index() as u32)
    }

    /// Returns a range of texels with those beside it, up to a number of rows away, of the placements that it cuts.
    pub(crate) fn with_rows_around(&self, range: &Range<usize>, rows: i32) -> Range<usize> {
        let placement = |i: usize| self.texels_of(self.texels.placement_of(i as u32)).indices();
        // Texels of a placement are numbered row by row.
        let row = |i: usize| self.position(TexelId::new(i)).1;
        let Range { mut start, mut end } = *range;
        if start < end {
            let (first, last) = (placement(start).start, placement(end - 1).end);
            let (lowest, highest) = (row(start) - rows, row(end - 1) + rows);
            while start > first && row(start - 1) >= lowest {
                start -= 1;
            }
            while end < last && row(end) <= highest {
                end += 1;
            }
        }
        start..end
    }

    /// Returns the texel at a column and row of a placement's page, if it is covered and lies in the placement's
    /// rectangle.
    #[inline]
    pub(crate) fn at(&self, placement: PlacementId, x: i32, y: i32) -> Option<TexelId<M>> {
        if x < 0 || y < 0 {
            return None;
        }
        covered(self.texels.texel_index(placement, x as u32, y as u32))
    }

    /// Returns the texels at some offsets from a texel of a placement, as far as they are covered and of the same placement.
    #[inline]
    pub(crate) fn around<const N: usize>(
        &self,
        placement: PlacementId,
        texel: TexelId<M>,
        offsets: [(i32, i32); N],
    ) -> [Option<TexelId<M>>; N] {
        let (x, y) = self.position(texel);
        let own = self.texels.samples_of(placement);
        let found = self.texels.around(placement, x, y, offsets);
        found.map(|s| covered(s).filter(|_| own.contains(&s)))
    }

    /// Returns the texel nearest to a point of a placed chart; `None` if the placement has no texel (a given chart
    /// that others cover).
    #[inline]
    pub(crate) fn nearest(&self, placement: PlacementId, local: [f32; 2]) -> Option<TexelId<M>> {
        covered(self.texels.nearest(placement, self.layout.texel_coord(placement, local)))
    }

    /// Calls `visit` with the texels to interpolate between and their weights, which sum to 1; not
    /// at all if the placement has no texel.
    #[inline(always)] // sums stay in registers: reading live light takes 69 ns per texel, otherwise 80
    pub(crate) fn bilinear(&self, placement: PlacementId, local: [f32; 2], mut visit: impl FnMut(TexelId<M>, f32)) {
        let b = self.texels.bilinear(placement, self.layout.texel_coord(placement, local));
        for (s, w) in b.samples.into_iter().zip(b.weights) {
            if let Some(texel) = covered(s).filter(|_| w > 0.0) {
                visit(texel, w);
            }
        }
    }

    /// Returns the point of a texel's sample, and one side of it as a receiver.
    pub(crate) fn receiver(&self, scene: &Scene, texel: TexelId<M>, back: bool) -> (SurfacePoint, Receiver) {
        receiver_of(scene, &self[texel], back)
    }

    /// Whether a texel is one of the separate texels for backs.
    #[inline]
    pub(crate) fn is_back(&self, texel: TexelId<M>) -> bool {
        texel >= self.back_start
    }

    /// Returns the placement of a texel.
    #[inline]
    pub(crate) fn placement_of(&self, charts: &Charts, texel: TexelId<M>) -> PlacementId {
        self.layout.place_of(charts.chart_of(self[texel].triangle), !self.is_back(texel))
    }

    /// Whether a texel's sample lies in the texel.
    pub(in crate::lightmap) fn is_of_own(&self, charts: &Charts, texel: TexelId<M>) -> bool {
        let t = &self[texel];
        let local = charts.local(t.triangle, t.u, t.v);
        let at = self.layout.texel_coord(self.placement_of(charts, texel), local);
        at.map(|c| c.floor() as i32) == [t.x, t.y].map(i32::from)
    }

    /// Returns position and normal of a texel's sample.
    pub(crate) fn surface(&self, scene: &Scene, texel: TexelId<M>) -> (Vec3, Vec3) {
        let t = &self[texel];
        (t.position(scene), t.shading_normal(scene))
    }
}

/// Returns what is added to texel numbers to make seeds of them, by placement. Both sides of a chart draw the same numbers.
fn seeds(scene: &Scene, charts: &Charts, layout: &Layout, texels: &TexelMap) -> Result<Vec<u32>> {
    let of_placement = |number: usize| {
        let placement = PlacementId::new(number);
        seed_of(scene, charts, layout.chart_of(placement)).wrapping_sub(texels.samples_of(placement).start)
    };
    let placements = (0..layout.placements.len()).into_par_iter();
    scene.device().install(|| try_par_collect(placements.map(of_placement), "seeds of random numbers"))
}

/// Returns a seed by where a chart lies, which is that of its first triangle. Coordinates are rounded to 2⁻¹⁸ of the largest
/// one: rounding seldom makes another seed, and a scene that is larger or smaller has the same light.
fn seed_of(scene: &Scene, charts: &Charts, chart: ChartId) -> u32 {
    let first = charts.triangles_of(chart).next();
    let corners = first.map_or([Vec3::ZERO; 3], |triangle| scene.corners(triangle));
    let largest = corners.iter().map(|corner| corner.abs().max_element()).fold(0.0, f32::max);
    // What is not a number becomes 0.
    let rounded = |c: f32| (c / largest * (1 << 18) as f32).round() as i32 as u32;
    corners.iter().flat_map(|corner| corner.to_array()).map(rounded).fold(0, combine)
}

/// Returns the texel of an entry of an index of texels; `None` where there is none.
#[inline]
fn covered<M: Map>(entry: u32) -> Option<TexelId<M>> {
    (entry != NONE).then(|| TexelId::new(entry as usize))
}

/// Returns a point of a triangle, and its front or back as a receiver.
pub(in crate::lightmap) fn receiver_of(scene: &Scene, t: &TexelSample, back: bool) -> (SurfacePoint, Receiver) {
    receiver_at(scene, t.triangle, [t.u, t.v], back)
}

/// Makes receivers of texels, many of which follow one another in a triangle: what its points share is computed once.
pub(in crate::lightmap) struct Receivers<'a> {
    scene: &'a Scene,
    /// The last triangle of a mesh without normals.
    last: Option<(u32, Facet)>,
}

impl<'a> Receivers<'a> {
    pub fn new(scene: &'a Scene) -> Receivers<'a> {
        Receivers { scene, last: None }
    }

    /// Returns the receiver of [`receiver_of`].
    #[inline]
    pub fn of(&mut self, t: &TexelSample, back: bool) -> Receiver {
        let facet = match self.last {
            Some((triangle, facet)) if triangle == t.triangle => facet,
            _ => {
                let (object, triangle) = self.scene.locate(t.triangle);
                let object = self.scene.object(object);
                if !object.mesh().normals.is_empty() {
                    return receiver_of(self.scene, t, back).1;
                }
                let facet = Facet::new(object.corners(triangle));
                self.last = Some((t.triangle, facet));
                facet
            }
        };
        Receiver::new(self.scene, &facet.point(t.u, t.v, self.scene), None, back)
    }
}

/// Returns a point of a triangle by its barycentric weights, and its front or back as a receiver.
pub(in crate::lightmap) fn receiver_at(
    scene: &Scene,
    triangle: u32,
    [u, v]: [f32; 2],
    back: bool,
) -> (SurfacePoint, Receiver) {
    let t = &TexelSample { x: 0, y: 0, triangle, u, v };
    let (object, triangle) = scene.locate(triangle);
    let object = scene.object(object);
    let (mesh, corners) = (object.mesh(), object.corners(triangle));
    let point = SurfacePoint::new(corners, t.u, t.v, scene);
    if mesh.normals.is_empty() {
        let receiver = Receiver::new(scene, &point, None, back);
        return (point, receiver);
    }
    let receiver = smooth_receiver(scene, (object, triangle, corners), t, &point, back);
    (point, receiver)
}

/// Returns a point of a triangle of a mesh with normals as a receiver. (Apart, as the registers that it takes make flat
/// ones slower.)
#[inline(never)]
fn smooth_receiver(
    scene: &Scene,
    (object, triangle, corners): (Object, u32, [Vec3; 3]),
    t: &TexelSample,
    point: &SurfacePoint,
    back: bool,
) -> Receiver {
    let receiver = Receiver::new(scene, point, Some(t.normal_in(object, triangle, corners)), back);
    let normals = object.mesh().indices[triangle as usize].map(|i| object.normal(i));
    receiver.smooth(scene, corners, normals, [t.u, t.v])
}
