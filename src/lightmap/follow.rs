//! Lets a light map follow its scene when vertices or instances have moved ([`Scene::refit_with`]): charts, pages and UVs
//! stay as they are, so that an engine keeps its vertex buffers. Texels near what moved are searched anew for those that
//! nobody can see; which sides of charts are seen stays as it was found when the light map was created.

use super::Lightmap;
use super::atlas::Atlas;
use super::atlas::buried::{Only, Part, Search, Searched, reach};
use super::atlas::chart_map::ChartMap;
use super::atlas::ids::{ChartId, PlacementId};
use super::atlas::seen;
use super::moved::Moved;
use crate::base::bounds::Bounds;
use crate::base::error::{Result, invalid_argument};
use crate::base::memory::{try_collect, try_to_vec, try_vec};
use crate::base::progress::{Progress, Stage};
use crate::scene::Scene;
use std::sync::{Arc, OnceLock};

impl Lightmap {
    /// Takes over another state of the light map's scene, whose vertices or instances have moved. Charts, pages and UVs
    /// stay. Light that has been baked stays too, as it was, until the next bake:
    /// [`bake_changed`](Self::bake_changed) computes what the move changes.
    ///
    /// Fails, and changes nothing, if `scene` is not a state of the light map's scene, if a triangle with texels is
    /// degenerate or not finite in it, without memory, or on a cancel.
    pub fn follow(&mut self, scene: &Arc<Scene>, progress: &Progress) -> Result<()> {
        if Arc::ptr_eq(scene, &self.atlas.scene) {
            return Ok(());
        }
        if !scene.is_state_of(&self.atlas.scene) {
            return invalid_argument!("the light map is of another scene");
        }
        let atlas = scene.device().run(progress, || self.atlas.moved_to(scene, progress))?;
        scene.check_file()?;
        let before = std::mem::replace(&mut self.atlas, Arc::new(atlas));
        if self.light.is_some() && self.before.is_none() {
            self.before = Some(before);
        }
        Ok(())
    }
}

impl Atlas {
    /// Makes the atlas of another state of the scene.
    fn moved_to(&self, scene: &Arc<Scene>, progress: &Progress) -> Result<Atlas> {
        let moved = Moved::between(&self.scene, scene, &self.charts)?;
        let texel = 1.0 / self.info.texels_per_unit;
        let near = texel.min(seen::ROOM * scene.diagonal());
        let boxes: Vec<Bounds> = moved.boxes.iter().map(|bounds| bounds.grown(reach(near, texel))).collect();
        let part = |chart: ChartId| {
            let bounds = self.charts.bounds(scene, chart);
            match moved.has(chart) || boxes.iter().any(|moved| moved.overlaps(&bounds)) {
                true => Part::All,
                false => Part::None,
            }
        };
        let charts = try_collect(self.charts.ids().map(part), "charts near what has moved")?;
        let search = Search {
            scene,
            charts: &self.charts,
            index: &self.index,
            seen: &self.seen,
            near,
            outdoors: self.is_outdoors,
            only: Some(Only { charts: &charts, boxes: &boxes }),
        };
        let work = [&self.map.layout, &self.gather.layout, &self.radiance.layout]
            .map(|layout| 2 * layout.placements.len() as u64);
        let stage = progress.stage("texels", 0.0, 1.0, work.iter().sum());
        let (radiance, _) = follow(&search, &self.radiance, &[], &stage)?;
        let (gather, _) = follow(&search, &self.gather, &[], &stage)?;
        let (map, buried) = follow(&search, &self.map, &self.buried, &stage)?;
        let mut info = self.info;
        info.buried_texels = buried.iter().filter(|&&b| b).count() as u64;
        Ok(Atlas {
            scene: scene.clone(),
            charts: self.charts.clone(),
            index: self.index.clone(),
            map,
            gather,
            radiance,
            padding: self.padding,
            desc: self.desc.clone(),
            is_outdoors: self.is_outdoors,
            lamps: try_to_vec(&self.lamps, "the places of lamps")?,
            info,
            seen: self.seen.clone(),
            buried,
            sky_seen: OnceLock::new(),
            _memory: self._memory.clone(),
        })
    }
}

/// Makes a map anew in the charts that are searched, and copies it in the others. Returns it with its buried texels
/// (empty: none).
fn follow<M: Searched>(
    search: &Search,
    old: &ChartMap<M>,
    was_buried: &[bool],
    stage: &Stage,
) -> Result<(ChartMap<M>, Vec<bool>)> {
    let layout = &old.layout;
    let is_searched =
        |placement| search.only.is_none_or(|only| only.charts[layout.chart_of(placement).index()] != Part::None);
    let mut map = old.copied(search.scene, search.charts, &is_searched, stage)?;
    let (mut buried, _) = search.scene.device().install(|| search.move_buried(&mut map, stage))?;
    if buried.is_empty() && !was_buried.is_empty() {
        buried = try_vec(map.len(), "buried texels")?;
    }
    let placements = 0..map.layout.placements.len();
    let copied =
        try_collect(placements.map(PlacementId::new).filter(|&p| !is_searched(p)), "texels far from what moved")?;
    for placement in copied {
        let texels = map.texels_of(placement).indices();
        map.texels.samples[texels.clone()].copy_from_slice(&old.texels.samples[texels.clone()]);
        if let Some(were) = was_buried.get(texels.clone()) {
            buried[texels].copy_from_slice(were);
        }
    }
    Ok((map, buried))
}
