//! The light that live updates show: lights, radiance map and sides of charts, as a bake has them or, at a quick start, a
//! first impression of them.

use super::blocks::Rect;
use crate::base::error::Result;
use crate::base::memory::{try_collect, try_to_vec, try_vec};
use crate::base::parallel::ParallelLoop;
use crate::base::progress::Progress;
use crate::direct::DirectLight;
use crate::lightmap::atlas::Atlas;
use crate::lightmap::atlas::ids::RadianceTexel;
use crate::lightmap::changed::correspondence::Correspondence;
use crate::lightmap::indirect::fallback_gather::{OwnDirectional, OwnLight};
use crate::lightmap::indirect::radiance_map::Radiance;
use crate::lightmap::indirect::split_texels;
use crate::lightmap::indirect::upsample::Upsampling;
use crate::lightmap::plan::{Plan, left_out};
use crate::lightmap::stages::{self, Inputs, Own};
use crate::lightmap::{BakeParams, BakeStats, directional};
use rayon::prelude::*;
use std::sync::Arc;

/// Number of texels of the radiance map that a thread takes over at a time.
const TEXELS: usize = 1 << 12;

/// The shown sides of charts.
#[derive(Default)]
pub(super) struct Sides {
    /// Per chart with one placement, whether its back is shown.
    pub backs: Vec<bool>,
    /// Interpolation from the gather map to the light map for these sides; unconstrained without indirect light, and in
    /// first impressions.
    pub upsampling: Upsampling,
    pub is_first_impression: bool,
}

/// Light as gathered and shown by texels.
#[derive(Clone)]
pub(super) struct Illumination {
    pub direct: Arc<DirectLight>,
    /// The radiance map, by sample.
    pub radiance: Arc<Radiance>,
    pub sides: Arc<Sides>,
    /// Light of the texels that gather for themselves, as no gather texel can be interpolated for them.
    pub own: Arc<OwnLight>,
    pub own_directional: Arc<OwnDirectional>,
    /// Whether there is any indirect light, or ever was.
    pub has_indirect: bool,
    /// Epochs of direct and indirect light: they change with the data.
    pub direct_epoch: u32,
    pub indirect_epoch: u32,
}

/// New radiance map and sides; the sides may be those that were shown before.
pub(super) struct Indirect {
    pub radiance: Radiance,
    pub sides: Arc<Sides>,
    pub own: Own,
    pub has_indirect: bool,
    pub part: Part,
    /// Blocks whose light a move does not change; empty: none.
    pub kept: Vec<bool>,
    /// By block, the rectangle of the texels that gather for themselves, which the thread that renews light finds; empty if
    /// the sides are those of before.
    pub alone: Vec<Rect>,
}

/// Part of a renewal of indirect light: with few photons, or with all.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Part {
    Quick,
    Whole,
}

/// Computes radiance map and sides under the scene's current lights, or the quick part of that, which keeps `sides`.
pub(super) fn illuminate(
    atlas: &Atlas,
    params: &BakeParams,
    direct: &DirectLight,
    sides: Option<Arc<Sides>>,
    progress: &Progress,
) -> Result<Indirect> {
    let two_sided = !atlas.radiance.layout.back_of.is_empty();
    let plan = Plan::new(&atlas.scene, direct, params, two_sided, false);
    let inputs = Inputs { atlas, direct, params, progress };
    let radiance = stages::illuminate(&inputs, &plan, &mut BakeStats::default())?;
    let has_indirect = plan.runs(left_out::INDIRECT);
    let part = if sides.is_some() { Part::Quick } else { Part::Whole };
    let sides = match sides {
        Some(sides) => sides,
        None => {
            let backs = stages::backs(&inputs, &radiance.values)?;
            let placements = if has_indirect { atlas.map.layout.placements.len() } else { 0 };
            let upsampling = stages::upsampling(&inputs, &backs, 0..placements, None)?;
            Arc::new(Sides { backs, upsampling, is_first_impression: false })
        }
    };
    // Without indirect light there is no radiance map to look up.
    let own = match has_indirect {
        true => {
            let asks = params.directional & directional::INDIRECT != 0;
            stages::own_light(&inputs, &radiance, &sides.backs, &sides.upsampling, None, asks, (0.315, 0.32))?
        }
        false => Own::default(),
    };
    Ok(Indirect { radiance, sides, own, has_indirect, part, kept: Vec::new(), alone: Vec::new() })
}

/// Computes a first impression of radiance map and sides. Texels neither gather for themselves nor know of walls between
/// them and the gather texels around.
fn illuminate_quickly(
    atlas: &Atlas,
    params: &BakeParams,
    direct: &DirectLight,
    progress: &Progress,
) -> Result<Indirect> {
    let plan = Plan::new(&atlas.scene, direct, params, !atlas.radiance.layout.back_of.is_empty(), false);
    let inputs = Inputs { atlas, direct, params, progress };
    let radiance = stages::illuminate_quickly(&inputs, &plan)?;
    let backs = stages::backs(&inputs, &radiance.values)?;
    let sides = Arc::new(Sides { backs, is_first_impression: true, ..Default::default() });
    let has_indirect = plan.runs(left_out::INDIRECT);
    let (own, part) = (Own::default(), Part::Quick);
    Ok(Indirect { radiance, sides, own, has_indirect, part, kept: Vec::new(), alone: Vec::new() })
}

impl Illumination {
    /// Computes the light of the scene's current lights, with all photons, or a first impression of it.
    pub fn new(atlas: &Atlas, params: &BakeParams, quick: bool, progress: &Progress) -> Result<Illumination> {
        let direct = DirectLight::try_new(&atlas.scene)?;
        let indirect = match quick {
            true => illuminate_quickly(atlas, params, &direct, progress)?,
            false => illuminate(atlas, params, &direct, None, progress)?,
        };
        Illumination::of(atlas, direct, indirect)
    }

    fn of(atlas: &Atlas, direct: DirectLight, indirect: Indirect) -> Result<Illumination> {
        atlas.make_room_for_sky_seen(&direct)?;
        Ok(Illumination {
            direct: Arc::new(direct),
            radiance: Arc::new(indirect.radiance),
            sides: indirect.sides,
            own: Arc::new(indirect.own.light),
            own_directional: Arc::new(indirect.own.directional),
            has_indirect: indirect.has_indirect,
            direct_epoch: 1,
            indirect_epoch: 1,
        })
    }

    /// Computes light of a scene that was described anew, with that of `before` it where surfaces show the same, and a first
    /// impression elsewhere. `former`: how surfaces were numbered, in the atlas of before.
    pub fn carried(
        atlas: &Atlas,
        params: &BakeParams,
        before: &Illumination,
        (old, former): (&Atlas, &Correspondence),
        progress: &Progress,
    ) -> Result<Illumination> {
        let direct = DirectLight::try_new(&atlas.scene)?;
        let mut indirect = illuminate_quickly(atlas, params, &direct, progress)?;
        if !indirect.has_indirect || !before.has_indirect || before.radiance.values.is_empty() {
            return Illumination::of(atlas, direct, indirect);
        }
        // Bright patches are left to all photons: until then gather rays find them.
        indirect.radiance = Radiance { values: indirect.radiance.values, ..Default::default() };
        let map = &atlas.radiance;
        indirect.radiance.values.par_chunks_mut(TEXELS).enumerate().try_each(|(part, values)| {
            progress.check()?;
            for (i, value) in (part * TEXELS..).zip(values) {
                let texel = RadianceTexel::new(i);
                let placement = map.placement_of(&atlas.charts, texel);
                if let Some(former) = former.radiance_texel(old, atlas, placement, texel) {
                    *value = before.radiance.values[former.index()];
                }
            }
            Ok(())
        })?;
        indirect.radiance.split = split_texels::find(atlas, &indirect.radiance.values, &mut 0, progress)?;
        // A chart shows its former side, unless it has texels for both now, or had, or is mostly seen from another side.
        let mut backs = try_to_vec(&indirect.sides.backs, "which sides of charts are shown")?;
        for (chart, shows_back) in atlas.charts.ids().zip(&mut backs) {
            let side = |atlas: &Atlas, chart| (atlas.map.layout.back(chart).is_some(), atlas.seen.shows_back(chart));
            if let Some(former) = former.chart(chart).filter(|&former| side(old, former) == side(atlas, chart)) {
                *shows_back = before.sides.backs.get(former.index()).is_some_and(|&back| back);
            }
        }
        let inputs = Inputs { atlas, direct: &direct, params, progress };
        let upsampling = stages::upsampling(&inputs, &backs, 0..atlas.map.layout.placements.len(), None)?;
        let asks = params.directional & directional::INDIRECT != 0;
        indirect.own = stages::own_light(&inputs, &indirect.radiance, &backs, &upsampling, None, asks, (0.315, 0.32))?;
        indirect.sides = Arc::new(Sides { backs, upsampling, is_first_impression: false });
        Illumination::of(atlas, direct, indirect)
    }

    /// Makes a copy with new indirect light.
    pub fn renewed(&self, new: Indirect) -> Result<Illumination> {
        let mut light = Illumination { indirect_epoch: self.indirect_epoch + 1, ..self.clone() };
        if new.has_indirect {
            light.radiance = Arc::new(new.radiance);
            if light.sides.backs != new.sides.backs {
                // Other sides are shown: their direct light differs too.
                light.direct_epoch += 1;
            }
            (light.sides, light.own) = (new.sides, Arc::new(new.own.light));
            light.own_directional = Arc::new(new.own.directional);
            light.has_indirect = true;
        } else {
            // All lights have gone dark: the shown light fades to black, on the shown sides.
            let values = try_vec(self.radiance.values.len(), "the radiance map")?;
            light.radiance = Arc::new(Radiance { values, ..Default::default() });
            light.own = Arc::new(darkened(&self.own)?);
            light.own_directional = Arc::new(darkened(&self.own_directional)?);
        }
        Ok(light)
    }
}

/// The light of texels that gather for themselves when all is dark.
fn darkened<T: Default>(own: &[Option<T>]) -> Result<Vec<Option<T>>> {
    try_collect(own.iter().map(|own| own.as_ref().map(|_| T::default())), "texels on their own")
}
