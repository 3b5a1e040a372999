//! Lets a light map follow its scene when vertices or instances have moved ([`Scene::refit_with`]): charts, pages and UVs
//! stay as they are, so that an engine keeps its vertex buffers. Texels near what moved are searched anew for those that
//! nobody can see; which sides of charts are seen stays as it was found when the light map was created.

use super::Lightmap;
use super::atlas::Atlas;
use super::atlas::buried::Search;
use super::atlas::chart_map::ChartMap;
use super::atlas::ids::{ChartId, Map, PlacementId};
use super::atlas::seen;
use super::moved::Moved;
use crate::base::bounds::Bounds;
use crate::base::error::{Result, invalid_argument};
use crate::base::memory::{try_collect, try_vec};
use crate::base::progress::{Progress, Stage};
use crate::scene::Scene;
use std::sync::Arc;

/// What lies within this many times the distance at which surfaces cover texels may cover some.
const REACH: f32 = 4.0;

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
        let boxes: Vec<Bounds> = moved.boxes.iter().map(|bounds| bounds.grown(REACH * near)).collect();
        let is_near = |chart: ChartId| {
            let mut bounds = Bounds::EMPTY;
            for triangle in self.charts.triangles_of(chart) {
                let (object, of_object) = scene.locate(triangle);
                scene.object(object).corners(of_object).into_iter().for_each(|corner| bounds.add(corner));
            }
            moved.has(chart) || boxes.iter().any(|moved| moved.overlaps(&bounds))
        };
        let charts = try_collect(self.charts.ids().map(is_near), "charts near what has moved")?;
        let search = Search {
            scene,
            charts: &self.charts,
            index: &self.index,
            seen: &self.seen,
            near,
            outdoors: self.is_outdoors,
            only: Some(&charts),
        };
        let work = [&self.map.layout, &self.gather.layout, &self.radiance.layout]
            .map(|layout| 2 * layout.placements.len() as u64);
        let stage = progress.stage("texels", 0.0, 1.0, work.iter().sum());
        let (radiance, _) = follow(&search, &self.radiance, &[], true, &stage)?;
        let (gather, _) = follow(&search, &self.gather, &[], false, &stage)?;
        let (map, buried) = follow(&search, &self.map, &self.buried, true, &stage)?;
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
            info,
            seen: self.seen.clone(),
            buried,
            _memory: self._memory.clone(),
        })
    }
}

/// Makes a map anew in the charts that are searched, and copies it in the others. Returns it with its buried texels
/// (empty: none).
fn follow<M: Map>(
    search: &Search,
    old: &ChartMap<M>,
    was_buried: &[bool],
    by_parts: bool,
    stage: &Stage,
) -> Result<(ChartMap<M>, Vec<bool>)> {
    let layout = &old.layout;
    let is_searched = |placement| search.only.is_none_or(|only| only[layout.chart_of(placement).index()]);
    let mut map = old.copied(search.scene, search.charts, &is_searched, stage)?;
    let (mut buried, _) = search.scene.device().install(|| search.move_buried(&mut map, by_parts, stage))?;
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
