//! Creates light maps: unwraps, lays out pages, maps texels to triangles and finds the texels that can be seen.

use super::atlas::Atlas;
use super::atlas::buried::Search;
use super::atlas::chart_index::ChartIndex;
use super::atlas::chart_map::ChartMap;
use super::atlas::charts::{Charts, automatic_density};
use super::atlas::earlier::{Earlier, TakenOver};
use super::atlas::ids::{ChartId, GatherMap, LightMap, Map, RadianceMap};
use super::atlas::known::{Known, Patch};
use super::atlas::layout::Layout;
use super::atlas::pieces::KnownPieces;
use super::atlas::seen::{self, Seen};
use super::atlas::seen_from;
use super::atlas::texels::TexelMap;
use super::atlas::two_sided;
use super::plan::Plan;
use super::{BakeParams, Lightmap, LightmapDesc, LightmapInfo};
use crate::base::error::Result;
use crate::base::memory::try_collect;
use crate::base::progress::{Progress, Stage};
use crate::device::LogLevel;
use crate::direct::DirectLight;
use crate::scene::Scene;
use crate::scene::precision::too_few_digits;
use std::sync::{Arc, OnceLock};
use std::time::Instant;

/// Number of pages that a scene fills, roughly, with the automatic density.
const AUTOMATIC_PAGES: f64 = 1.0;

/// Offset of rays from surfaces above which a warning is logged, as a fraction of a texel.
const OFFSET_PART: f32 = 0.25;

/// Minimum page size of the gather and radiance maps.
const MIN_PAGE_SIZE: u32 = 64;

impl Lightmap {
    /// Creates a light map: unwraps meshes without usable UVs, lays out the pages and maps texels to triangles.
    pub fn create(scene: &Arc<Scene>, desc: &LightmapDesc, progress: &Progress) -> Result<Lightmap> {
        desc.validate()?;
        let lay_out = || Self::lay_out(scene, desc, None, None, progress);
        scene.while_unchanged(|| scene.device().run(progress, lay_out))
    }

    /// Creates a light map as [`create`](Self::create) does, of a scene of which that of an `earlier` light map is a
    /// revision: of meshes, or triangles in them, that both scenes have, curved surfaces keep their charts, and texels far from
    /// what has changed are not searched for those that nobody can see. For meshes that were added, removed or edited;
    /// [`bake_changed_from`](Self::bake_changed_from) then keeps their light.
    ///
    /// Far is more than four texels from boxes around what has changed, and more than its width from a chart with a side that
    /// is seen now and was not, or the other way round. With another description or density, or if a lamp was moved, added or
    /// removed, charts are kept and all texels are searched.
    pub fn create_from(
        scene: &Arc<Scene>,
        desc: &LightmapDesc,
        earlier: &Lightmap,
        progress: &Progress,
    ) -> Result<Lightmap> {
        desc.validate()?;
        let lay_out = || {
            let earlier = scene.device().install(|| Earlier::new(&earlier.atlas, scene, progress))?;
            Self::lay_out(scene, desc, None, Some(&earlier), progress)
        };
        let of_both = || scene.while_unchanged(|| scene.device().run(progress, lay_out));
        earlier.atlas.scene.while_unchanged(of_both)
    }

    /// Creates a light map whose description is checked. What is `known` is not searched for, and what can be taken over from
    /// an `earlier` one is.
    pub(super) fn lay_out(
        scene: &Arc<Scene>,
        desc: &LightmapDesc,
        mut known: Option<Known>,
        earlier: Option<&Earlier>,
        progress: &Progress,
    ) -> Result<Lightmap> {
        let start = Instant::now();
        let (is_outdoors, lamps) = (seen::is_outdoors(scene), seen::lamps(scene)?);
        let density = match desc.texels_per_unit {
            0.0 => automatic_density(scene, desc.page_size, AUTOMATIC_PAGES)?,
            d => d,
        };
        let (charts, mut uvs) = match &mut known {
            Some(known) => (std::mem::take(&mut known.charts), known.uvs),
            None => {
                let pieces = earlier.map(|e| move |triangles: &[u32], stage: &Stage| e.pieces(scene, triangles, stage));
                let pieces = pieces.as_ref().map(|pieces| pieces as KnownPieces);
                Charts::of_scene_with(scene, density, desc.page_size, desc.padding, pieces, progress)?
            }
        };
        let unwrap_seconds = start.elapsed().as_secs_f64();
        let index = ChartIndex::new(scene.device(), &charts)?;
        let two_sided: Vec<ChartId> =
            try_collect(charts.ids().filter(|&c| charts[c].two_sided), "the two-sided charts")?;
        let Maps { map, gather, radiance, seen, with_backs, buried, sight_rays, kept_charts } =
            Maps::lay_out(scene, desc, &charts, &index, &two_sided, density, known.as_mut(), earlier, progress)?;
        uvs.overlapping_texels = map.texels.overlapping_texels;
        uvs.reduced_charts = map.layout.reduced;
        let device = scene.device();
        let own_bytes = device.in_memory(charts.bytes()) + seen.bytes() + buried.len();
        let bytes = own_bytes + device.in_memory(index.bytes()) + map.bytes() + gather.bytes() + radiance.bytes();
        let info = LightmapInfo {
            page_count: map.layout.page_count,
            width: map.layout.page_size,
            height: map.layout.page_size,
            charts: charts.charts.len() as u32,
            texels: map.len() as u64,
            gather_texels: gather.len() as u64,
            radiance_texels: radiance.len() as u64,
            bytes: bytes as u64,
            unwrap_seconds,
            texels_per_unit: density,
            uvs,
            both_sided_charts: with_backs.len() as u32,
            back_texels: (map.len() - map.back_start.index()) as u64,
            buried_texels: buried.iter().filter(|&&b| b).count() as u64,
            open_places: seen.places,
            unseen_charts: seen.unseen.iter().filter(|&&unseen| unseen).count() as u32,
            spared_texels: map.layout.spared,
            sight_rays,
            kept_charts,
        };
        let memory = scene.device().memory().reserve(own_bytes, "the charts")?;
        if let Some(message) = too_few_digits(scene, "texels", 1.0 / density, OFFSET_PART) {
            scene.device().log(LogLevel::Warning, &message);
        }
        scene.device().log_info(|| summary(&info, start.elapsed().as_secs_f64()));
        let direct = DirectLight::try_new(scene)?;
        let mut plan =
            Plan::new(scene, &direct, &BakeParams::default(), !two_sided.is_empty(), uvs.unwrapped_charts > 0);
        plan.note_sides(&info);
        let scene = scene.clone();
        let atlas = Atlas {
            scene,
            charts: Arc::new(charts),
            index: Arc::new(index),
            map,
            gather,
            radiance,
            padding: desc.padding,
            desc: desc.clone(),
            is_outdoors,
            lamps,
            info,
            seen: Arc::new(seen),
            buried,
            sky_seen: OnceLock::new(),
            _memory: Arc::new(memory),
        };
        Ok(Lightmap { atlas: Arc::new(atlas), plan, light: None, before: None })
    }
}

impl Lightmap {
    /// Finds the texels that show other points than their places have, by making them anew: they are not kept, as few
    /// light maps are saved.
    pub(super) fn patches(&self, progress: &Progress) -> Result<[Vec<Patch>; 3]> {
        fn of<M: Map>(a: &Atlas, map: &ChartMap<M>, buried: &[bool], stage: &Stage) -> Result<Vec<Patch>> {
            Patch::all(map, &ChartMap::new(&a.scene, &a.charts, map.layout.try_clone()?, stage)?, buried)
        }
        let a = &self.atlas;
        let layouts = [&a.map.layout, &a.gather.layout, &a.radiance.layout];
        let stage = &progress.stage("texels", 0.0, 0.5, layouts.into_iter().map(TexelMap::work).sum());
        Ok([of(a, &a.map, &a.buried, stage)?, of(a, &a.gather, &[], stage)?, of(a, &a.radiance, &[], stage)?])
    }
}

/// Places of the charts in the three maps, and the counts that laying them out brought.
struct Maps {
    map: ChartMap<LightMap>,
    gather: ChartMap<GatherMap>,
    radiance: ChartMap<RadianceMap>,
    seen: Seen,
    /// Two-sided charts whose backs have texels of their own.
    with_backs: Vec<ChartId>,
    /// By texel of the light map; empty if none is.
    buried: Vec<bool>,
    sight_rays: u64,
    /// Number of charts of which texels were taken over from an earlier light map.
    kept_charts: u32,
}

impl Maps {
    /// Lays out the radiance map first: rays from its texels count which sides can be seen, and the sides decide which
    /// charts need a second place in the other two maps.
    fn lay_out(
        scene: &Arc<Scene>,
        desc: &LightmapDesc,
        charts: &Charts,
        index: &ChartIndex,
        two_sided: &[ChartId],
        density: f32,
        known: Option<&mut Known>,
        earlier: Option<&Earlier>,
        progress: &Progress,
    ) -> Result<Maps> {
        let pack = |divisor: u32, padding: u32, given: bool, with_backs: &[ChartId], unseen: &[bool]| {
            let page_size = if divisor == 1 { desc.page_size } else { (desc.page_size / divisor).max(MIN_PAGE_SIZE) };
            Layout::pack(charts, density / divisor as f32, page_size, padding, given, with_backs, unseen, progress)
        };
        let radiance = pack(desc.radiance_divisor, 0, false, two_sided, &[])?;
        let stage = progress.stage("texels", 0.5, 0.6, TexelMap::work(&radiance));
        let mut radiance = ChartMap::new(scene, charts, radiance, &stage)?;
        let texel = 1.0 / density;
        let stage =
            progress.stage("sides", 0.6, 0.65, Seen::work(&radiance) + seen_from::work(charts, &desc.seen_from));
        let mut known = known;
        let seen = match &mut known {
            Some(known) => std::mem::take(&mut known.seen),
            None => scene.install(|| {
                let mut seen = Seen::count(scene, charts, &radiance, texel, &stage)?;
                if !desc.seen_from.is_empty() {
                    seen_from::look(scene, charts, &radiance, &desc.seen_from, &stage, &mut seen)?;
                }
                Ok(seen)
            })?,
        };
        let with_backs =
            if desc.both_sides { two_sided::seen_from_both(&seen, &radiance, two_sided)? } else { Vec::new() };
        let map = pack(1, desc.padding, true, &with_backs, &seen.unseen)?;
        let gather = pack(desc.gather_divisor, 0, false, &with_backs, &seen.unseen)?;
        let stage = progress.stage("texels", 0.65, 0.8, TexelMap::work(&map) + TexelMap::work(&gather));
        let mut map = ChartMap::new(scene, charts, map, &stage)?;
        let mut gather = ChartMap::new(scene, charts, gather, &stage)?;
        if let Some(known) = known {
            let buried = known.patch(0, charts, &mut map)?;
            known.patch(1, charts, &mut gather)?;
            known.patch(2, charts, &mut radiance)?;
            let sight_rays = known.sight_rays;
            return Ok(Maps { map, gather, radiance, seen, with_backs, buried, sight_rays, kept_charts: 0 });
        }
        let placements = [&map.layout, &gather.layout, &radiance.layout].map(|layout| layout.placements.len() as u64);
        let stage = progress.stage("buried texels", 0.8, 1.0, placements.iter().sum());
        let (near, outdoors) = (texel.min(seen::ROOM * scene.diagonal()), seen::is_outdoors(scene));
        let find = |e: &Earlier| e.texels(scene, charts, (&map, &gather, &radiance), &seen, near, &stage);
        let taken = earlier.map(|e| Ok((e, scene.install(|| find(e))?))).transpose()?;
        let copy = |(e, taken): &(&Earlier, TakenOver)| {
            scene.install(|| e.copy(scene, charts, taken, (&mut map, &mut gather, &mut radiance), &stage))
        };
        let were_buried = taken.as_ref().map(copy).transpose()?.unwrap_or_default();
        let only = taken.as_ref().map(|(_, taken)| taken.only());
        let search = Search { scene, charts, index, seen: &seen, near, outdoors, only };
        let (mut buried, rays) = scene.install(|| {
            let (_, of_radiance) = search.move_buried(&mut radiance, &stage)?;
            let (_, of_gather) = search.move_buried(&mut gather, &stage)?;
            let (buried, of_map) = search.move_buried(&mut map, &stage)?;
            Ok((buried, of_radiance + of_gather + of_map))
        })?;
        let sight_rays = seen.rays + rays;
        let mut kept_charts = 0;
        if let Some((_, taken)) = &taken {
            taken.add_buried(&were_buried, charts, &map, &mut buried)?;
            kept_charts = taken.charts();
        }
        Ok(Maps { map, gather, radiance, seen, with_backs, buried, sight_rays, kept_charts })
    }
}

/// The log's line for a light map that was created.
fn summary(i: &LightmapInfo, seconds: f64) -> String {
    format!(
        "light map: {} pages of {} x {}, {:.3} texels per unit, {} charts, {} texels ({} gather, {} radiance), \
         {} bytes, {seconds:.3} s of which unwrapping {:.3}",
        i.page_count,
        i.width,
        i.height,
        i.texels_per_unit,
        i.charts,
        i.texels,
        i.gather_texels,
        i.radiance_texels,
        i.bytes,
        i.unwrap_seconds
    )
}
