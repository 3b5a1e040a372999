//! Which texels of two light maps show the same, so that one keeps light of the other: after meshes were added, removed or
//! edited.
//!
//! Charts are matched whose [triangles](crate::lightmap::surfaces) are, with the same coordinates in the chart, and with
//! them their texels: these are numbered alike in a placement. What only one of the scenes has counts as [moved](Moved).

use crate::base::directional::Directional;
use crate::base::error::Result;
use crate::base::memory::{try_collect, try_par_collect, try_vec};
use crate::base::parallel::one_by_one;
use crate::base::progress::Progress;
use crate::lightmap::atlas::Atlas;
use crate::lightmap::atlas::chart_map::ChartMap;
use crate::lightmap::atlas::ids::{ChartId, GatherTexel, LightTexel, Map, PlacementId, RadianceTexel, TexelId};
use crate::lightmap::atlas::layout::Placement;
use crate::lightmap::atlas::texels::TexelSample;
use crate::lightmap::indirect::radiance_map::Radiance;
use crate::lightmap::moved::Moved;
use crate::lightmap::plan::Plan;
use crate::lightmap::surfaces::{MATCHED, Rest, Surfaces};
use crate::lightmap::{Light, Spread};
use glam::Vec3;
use rayon::prelude::*;

/// Distance, in texels, up to which two points are the same: where charts lie on their pages depends on all of them, and
/// rounding on where they lie.
const SAME: f32 = 0.01;

/// Distance up to which two unit normals are the same: light differs by as small a part of itself.
const SAME_NORMAL: f32 = 1e-3;

/// For the texels of a light map, the same ones of an earlier one.
pub(crate) struct Correspondence {
    pub(super) surfaces: Surfaces,
    /// By chart, the same one; [`ChartId::NONE`]: there was none.
    charts: Vec<ChartId>,
    /// By placement of the light map, that of the same texels; [`PlacementId::NONE`]: there was none.
    placements: Vec<PlacementId>,
    /// The same of the gather map and of the radiance map.
    gather_placements: Vec<PlacementId>,
    radiance_placements: Vec<PlacementId>,
}

impl Correspondence {
    /// Matches the surfaces of two atlases; returns also what only one of them has. To be called on the device's threads.
    pub fn between(old: &Atlas, new: &Atlas, progress: &Progress) -> Result<(Correspondence, Moved)> {
        let (surfaces, Rest { boxes, emits }) = Surfaces::between([&old.scene, &new.scene], progress)?;
        let charts = 0..new.charts.charts.len();
        let most = SAME / new.map.layout.density;
        let former = |chart| surfaces.chart(&new.scene, [&old.charts, &new.charts], ChartId::new(chart), most);
        let former_chart = |chart| former(chart).unwrap_or(ChartId::NONE);
        let charts = try_par_collect(one_by_one(charts.into_par_iter().map(former_chart)), MATCHED)?;
        let has_moved = charts.iter().map(|&chart| chart == ChartId::NONE);
        let moved = Moved::new(try_collect(has_moved, MATCHED)?, boxes, emits);
        let found = Correspondence {
            placements: try_collect(Self::former_placements(&old.map, &new.map, &charts), MATCHED)?,
            gather_placements: try_collect(Self::former_placements(&old.gather, &new.gather, &charts), MATCHED)?,
            radiance_placements: try_collect(Self::former_placements(&old.radiance, &new.radiance, &charts), MATCHED)?,
            surfaces,
            charts,
        };
        Ok((found, moved))
    }

    /// Yields the former placement of each placement of a map, given the former charts.
    fn former_placements<'a, M: Map>(
        old: &'a ChartMap<M>,
        new: &'a ChartMap<M>,
        charts: &'a [ChartId],
    ) -> impl Iterator<Item = PlacementId> + use<'a, M> {
        let layouts = [&old.layout, &new.layout];
        (0..layouts[1].placements.len()).map(PlacementId::new).map(move |placement| {
            let chart = charts[layouts[1].chart_of(placement).index()];
            if chart == ChartId::NONE {
                return PlacementId::NONE;
            }
            let former = layouts[0].side(chart, !layouts[1].is_back(placement));
            let is_alike = |&p: &PlacementId| old.texels_of(p).len() == new.texels_of(placement).len();
            former.filter(is_alike).unwrap_or(PlacementId::NONE)
        })
    }

    /// Returns the former number of a texel of a placement, if it showed the same point, or neither shows one of its own,
    /// being buried.
    pub fn texel(&self, old: &Atlas, new: &Atlas, placement: PlacementId, texel: LightTexel) -> Option<LightTexel> {
        let former = self.in_placement((&old.map, &new.map), self.placements[placement.index()], placement, texel)?;
        let is_buried = |atlas: &Atlas, texel: LightTexel| atlas.buried.get(texel.index()).is_some_and(|&b| b);
        let shows_same = || self.shows_same((old, new), &old.map[former], &new.map[texel], new.map.layout.density);
        (is_buried(new, texel) && is_buried(old, former) || shows_same()).then_some(former)
    }

    /// Bytes held beside those of the [surfaces](Surfaces).
    pub fn bytes(&self) -> usize {
        let placements = self.placements.len() + self.gather_placements.len() + self.radiance_placements.len();
        placements * size_of::<PlacementId>() + size_of_val(&self.charts[..])
    }

    /// Returns the former number of a chart.
    pub fn chart(&self, chart: ChartId) -> Option<ChartId> {
        Some(self.charts[chart.index()]).filter(|&former| former != ChartId::NONE)
    }

    /// Returns the former number of a placement of the gather map, if it had as many texels of the same chart.
    pub fn gather_placement(&self, placement: PlacementId) -> Option<PlacementId> {
        Some(self.gather_placements[placement.index()]).filter(|&former| former != PlacementId::NONE)
    }

    /// Returns the former number of a texel of a placement of the gather map, if it showed the same point.
    pub fn gather_texel(
        &self,
        old: &Atlas,
        new: &Atlas,
        placement: PlacementId,
        texel: GatherTexel,
    ) -> Option<GatherTexel> {
        let former = self.gather_placements[placement.index()];
        self.same_in_placement((old, new), (&old.gather, &new.gather), former, placement, texel)
    }

    /// Returns which charts show their backs, given which did before (empty: none); those that are new do not.
    pub fn backs(&self, former: &[bool]) -> Result<Vec<bool>> {
        let charts = if former.is_empty() { &[][..] } else { &self.charts[..] };
        try_collect(charts.iter().map(|chart| former.get(chart.index()).is_some_and(|&back| back)), MATCHED)
    }

    /// Returns the former number of a texel of a placement of the radiance map, if it showed the same point.
    pub fn radiance_texel(
        &self,
        old: &Atlas,
        new: &Atlas,
        placement: PlacementId,
        texel: RadianceTexel,
    ) -> Option<RadianceTexel> {
        let former = self.radiance_placements[placement.index()];
        self.same_in_placement((old, new), (&old.radiance, &new.radiance), former, placement, texel)
    }

    /// Returns the texel at the same place in the former placement, if it showed the same point.
    fn same_in_placement<M: Map>(
        &self,
        atlases: (&Atlas, &Atlas),
        maps: (&ChartMap<M>, &ChartMap<M>),
        former: PlacementId,
        placement: PlacementId,
        texel: TexelId<M>,
    ) -> Option<TexelId<M>> {
        let former = self.in_placement(maps, former, placement, texel)?;
        let shows_same = self.shows_same(atlases, &maps.0[former], &maps.1[texel], maps.1.layout.density);
        shows_same.then_some(former)
    }

    /// Returns the texel at the same place in the former placement.
    fn in_placement<M: Map>(
        &self,
        (old, new): (&ChartMap<M>, &ChartMap<M>),
        former: PlacementId,
        placement: PlacementId,
        texel: TexelId<M>,
    ) -> Option<TexelId<M>> {
        if former == PlacementId::NONE {
            return None;
        }
        let place = texel.index() - new.texels_of(placement).indices().start;
        let former_texel = TexelId::new(old.texels_of(former).indices().start + place);
        let within = |texel: &TexelSample, rect: &Placement| (texel.x - rect.x, texel.y - rect.y);
        let is_alike = within(&new[texel], &new.layout[placement]) == within(&old[former_texel], &old.layout[former]);
        is_alike.then_some(former_texel)
    }

    /// Whether a texel shows the point that another one showed, given the density of their map.
    fn shows_same(&self, (old, new): (&Atlas, &Atlas), there: &TexelSample, here: &TexelSample, density: f32) -> bool {
        let former = self.surfaces.triangle(&new.scene, here.triangle);
        // Rounding decides which of two triangles an edge is part of.
        let is_alike = || here.shading_normal(&new.scene).distance(there.shading_normal(&old.scene)) <= SAME_NORMAL;
        here.position(&new.scene).distance(there.position(&old.scene)) <= SAME / density
            && former.is_some_and(|former| former == there.triangle || is_alike())
    }

    /// Copies light of the earlier atlas, as it was before seams were stitched, to the texels that are the same in the new
    /// one; others are dark. Without radiance map and states of texels.
    pub(in crate::lightmap) fn carried(&self, light: &Light, old: &Atlas, new: &Atlas) -> Result<Light> {
        let n = new.map.len();
        let of = |is_asked: bool| if is_asked { n } else { 0 };
        let (directional, spread) = (of(!light.directional.is_empty()), of(!light.spread.is_empty()));
        let bytes = n * 2 * size_of::<Vec3>() + directional * size_of::<Directional>() + spread * size_of::<Spread>();
        let mut out = Light {
            direct: try_vec(n, MATCHED)?,
            indirect: try_vec(n, MATCHED)?,
            directional: try_vec(directional, MATCHED)?,
            spread: try_vec(spread, MATCHED)?,
            state: Vec::new(),
            radiance: Radiance::default(),
            backs: self.backs(&light.backs)?,
            stitch: None,
            origin: light.origin,
            plan: Plan::default(),
            _memory: new.scene.device().memory().reserve(bytes, MATCHED)?,
        };
        for (p, &former) in self.placements.iter().enumerate().filter(|(_, former)| **former != PlacementId::NONE) {
            let placement = PlacementId::new(p);
            let (to, from) = (new.map.texels_of(placement).indices(), old.map.texels_of(former).indices());
            let direct = &mut out.direct[to.clone()];
            let indirect = &mut out.indirect[to.clone()];
            direct.copy_from_slice(&light.direct[from.clone()]);
            indirect.copy_from_slice(&light.indirect[from.clone()]);
            let directional = out.directional.get_mut(to.clone()).unwrap_or_default();
            directional.copy_from_slice(light.directional.get(from.clone()).unwrap_or_default());
            if let Some(stitch) = &light.stitch {
                stitch.former_of(&from, direct, indirect, directional);
            }
            let spread = out.spread.get_mut(to).unwrap_or_default();
            spread.copy_from_slice(light.spread.get(from).unwrap_or_default());
        }
        Ok(out)
    }
}
