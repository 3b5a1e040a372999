//! The atlas: charts and texels of a scene, the side of its chart that each texel shows, and which texels can be seen.

pub(in crate::lightmap) mod alike;
pub(crate) mod buried;
pub(crate) mod chart_index;
pub(crate) mod chart_map;
pub mod charts;
pub(in crate::lightmap) mod earlier;
pub(crate) mod fill;
pub(crate) mod flat_triangle;
pub mod ids;
pub(in crate::lightmap) mod known;
pub mod layout;
pub(crate) mod pieces;
mod planar;
mod repeats;
pub(crate) mod seen;
pub(crate) mod seen_from;
pub(in crate::lightmap) mod sheets;
pub mod texels;
pub(crate) mod two_sided;
mod unwrap;
#[cfg(feature = "unwrap")]
mod unwrap_cache;
mod welded;

use super::{LightmapDesc, LightmapInfo};
use crate::base::memory::Reservation;
use crate::direct::Receiver;
use crate::direct::guide::SkySeen;
use crate::scene::Scene;
use chart_index::ChartIndex;
use chart_map::{ChartMap, Receivers};
use charts::Charts;
use glam::Vec3;
use ids::{GatherMap, GatherTexel, LightMap, LightTexel, PlacementId, RadianceMap, ShownMap, TexelId};
use seen::Seen;
use std::sync::{Arc, OnceLock};

/// Charts and texels of a scene: all of a light map but its light. Immutable, and shared with live updates.
pub(crate) struct Atlas {
    pub scene: Arc<Scene>,
    /// Charts and their index are shared with the atlases of the scene in other states ([`follow`]).
    ///
    /// [`follow`]: crate::lightmap::Lightmap::follow
    pub charts: Arc<Charts>,
    pub index: Arc<ChartIndex>,
    pub map: ChartMap<LightMap>,
    pub gather: ChartMap<GatherMap>,
    pub radiance: ChartMap<RadianceMap>,
    pub padding: u32,
    /// What the light map was created with: its description, whether a sun or a sky shone, and the places of lamps.
    pub(in crate::lightmap) desc: LightmapDesc,
    pub(in crate::lightmap) is_outdoors: bool,
    pub(in crate::lightmap) lamps: Vec<Option<Vec3>>,
    pub info: LightmapInfo,
    pub seen: Arc<Seen>,
    /// Whether each texel of the light map is buried, with the sample point of another one. Empty if none is.
    pub buried: Vec<bool>,
    /// Where the texels of the radiance map see the sky, as far as somebody has looked.
    pub(in crate::lightmap) sky_seen: OnceLock<SkySeen>,
    pub(in crate::lightmap) _memory: Arc<Reservation>,
}

impl Atlas {
    /// Whether a texel shows the back: as a separate texel for the back, or because of `backs` (per chart; empty:
    /// fronts).
    pub(crate) fn is_back<M: ShownMap>(&self, map: &ChartMap<M>, backs: &[bool], texel: TexelId<M>) -> bool {
        let chart = self.charts.chart_of(map[texel].triangle);
        map.is_back(texel) || backs.get(chart.index()).is_some_and(|&b| b)
    }

    /// Returns the sample of a texel as a receiver, on the side that it shows.
    pub(crate) fn receiver<M: ShownMap>(&self, map: &ChartMap<M>, backs: &[bool], texel: TexelId<M>) -> Receiver {
        map.receiver(&self.scene, texel, self.is_back(map, backs, texel)).1
    }

    /// Returns what makes [`receiver`](Self::receiver)s of texels that mostly follow one another in a triangle.
    pub(crate) fn receivers<'a, M: ShownMap>(
        &'a self,
        map: &'a ChartMap<M>,
        backs: &'a [bool],
    ) -> impl FnMut(TexelId<M>) -> Receiver + 'a {
        let mut receivers = Receivers::new(&self.scene);
        move |texel| receivers.of(&map[texel], self.is_back(map, backs, texel))
    }

    /// Returns the local coordinates of a texel of the light map in its chart. For a buried texel, these are not those
    /// of its sample, which lies in another texel.
    pub(crate) fn texel_local(&self, placement: PlacementId, texel: LightTexel) -> [f32; 2] {
        let t = &self.map[texel];
        match self.buried.get(texel.index()) {
            Some(true) => self.map.layout[placement].local([t.x, t.y].map(|c| f32::from(c) + 0.5)),
            _ => self.charts.local(t.triangle, t.u, t.v),
        }
    }

    /// Returns the texel in which the sample of a buried texel lies, whose light it takes; `None` for other texels, and
    /// where rounding leaves no such texel.
    pub(crate) fn source_of_buried(&self, texel: LightTexel) -> Option<LightTexel> {
        let is_buried = |texel: LightTexel| self.buried.get(texel.index()) == Some(&true);
        if !is_buried(texel) {
            return None;
        }
        let sample = &self.map[texel];
        let placement = self.map.placement_of(&self.charts, texel);
        let local = self.charts.local(sample.triangle, sample.u, sample.v);
        let [x, y] = self.map.layout.texel_coord(placement, local).map(|c| c.floor() as i32);
        // The window of given charts may contain another chart.
        let of_placement = self.map.texels_of(placement);
        self.map.at(placement, x, y).filter(|&source| of_placement.contains(source) && !is_buried(source))
    }

    /// Calls `visit` with the gather texels around a texel of the light map and their bilinear weights.
    #[inline]
    pub(crate) fn gather_around(&self, texel: LightTexel, visit: impl FnMut(GatherTexel, f32)) {
        let t = &self.map[texel];
        // The gather map has the light map's placements.
        let placement = self.map.placement_of(&self.charts, texel);
        self.gather.bilinear(placement, self.charts.local(t.triangle, t.u, t.v), visit);
    }
}
