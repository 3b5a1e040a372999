//! Which light a bake after a change computes anew: where the scene has moved, or a light was set.
//!
//! Photons are traced again with the same random numbers, and texels of the radiance map that they and lamps reach as
//! before are [kept](radiance). The light map is cut into cells of 8 × 8 texels of the gather map. Indirect light of a
//! cell is computed anew if
//!
//! - its surface or what it shows moved, or what moved is so near or so large that light may differ within the cell, or
//! - one of its [probes](super::indirect::probes) gathers another light than before: rays from a few of its texels, traced
//!   in both states of the scene, each with its radiance map.
//!
//! Direct light of a texel is computed anew if what moved lies, or lay, between it and a light. All other texels keep
//! their light. Those that are computed anew get the light of a bake from nothing, as their random numbers and the texels
//! around them are the same; its bits, if no difference is let stand and so the radiance map is made anew, too.

pub(crate) mod comparison;
pub(crate) mod correspondence;
mod radiance;
mod sources;

use super::atlas::Atlas;
use super::atlas::ids::PlacementId;
use super::direct_blur;
use super::indirect::fallback_gather::REACH;
use super::indirect::radiance_map::Radiance;
use super::indirect::upsample::Asked;
use super::moved::Moved;
use super::plan::{Plan, left_out};
use super::{BakeParams, BakeStats, Light, Lightmap, Origin, TexelState};
use crate::base::error::{Result, invalid_argument};
use crate::base::memory::{Reservation, try_filled, try_push, try_vec};
use crate::base::parallel::ParallelLoop;
use crate::base::progress::Progress;
use crate::direct::DirectLight;
use comparison::{CELL, CHANGED, Cell, Comparison, SceneState};
use correspondence::Correspondence;
use rayon::prelude::*;
use std::sync::OnceLock;

/// What a bake computes anew.
pub(super) struct Redo {
    /// Whether indirect light is, by texel of the light map.
    pub indirect: Vec<bool>,
    /// The same for direct light.
    pub direct: Vec<bool>,
    /// Texels whose direct light before its [blur](super::direct_blur) is needed for that.
    pub lit: Vec<bool>,
    /// Texels of the light map that texels with new indirect light may be blurred with.
    pub around: Vec<bool>,
    /// Texels of the gather map that are needed for them.
    pub gather: Vec<bool>,
    /// Whether a placement has any of these texels.
    pub placements: Vec<bool>,
    /// Number of rays of probes.
    pub rays: u64,
    _memory: Reservation,
}

impl Lightmap {
    /// Bakes again after lights were [set](crate::scene::Scene::set_light) or the scene [has moved](Lightmap::follow).
    /// Texels whose light has changed by less than `keep_error` (finite, ≥ 0), as far as probes tell, keep it; it is
    /// relative to their light or, if that is more, to a tenth of the mean light. So do texels of the radiance map. All others
    /// get the light of [`bake`](Self::bake); if `keep_error` is 0, its bits.
    ///
    /// `params` are those of the last bake, for all texels and without a target error. If others were used, or there is
    /// no light yet, all is baked. Many small changes that are each let stand add up: now and then bake from nothing.
    /// With several passes the mean of their radiance maps is compared with that of the new first pass, so that texels
    /// whose light did not change are kept only if `keep_error` is above that noise.
    pub fn bake_changed(&mut self, params: &BakeParams, keep_error: f32, progress: &Progress) -> Result<BakeStats> {
        self.check_changed(params, keep_error)?;
        self.bake_all(params, None, None, Some(Keep { keep_error, keeps_radiance: true, earlier: None }), progress)
    }

    /// Bakes and keeps light of an `earlier` light map, of a scene of which this light map's is a revision: texels of
    /// meshes, or of triangles in them, that both scenes have keep the light that they had, like those of
    /// [`bake_changed`](Self::bake_changed), to which this is what that is to a scene that has moved. For meshes that were
    /// added, removed or edited.
    ///
    /// The same surfaces have the same texels if both light maps have the same `texels_per_unit`, which is not 0, the same
    /// divisors, and the same charts. Surfaces with other texels, or another material, are baked. If the light map has light
    /// already, that is replaced.
    pub fn bake_changed_from(
        &mut self,
        earlier: &Lightmap,
        params: &BakeParams,
        keep_error: f32,
        progress: &Progress,
    ) -> Result<BakeStats> {
        self.check_changed(params, keep_error)?;
        let scene = earlier.atlas.scene.clone();
        let keep = Keep { keep_error, keeps_radiance: true, earlier: Some(earlier) };
        scene.while_unchanged(|| self.bake_all(params, None, None, Some(keep), progress))
    }

    /// Checks the arguments of a bake that keeps light.
    fn check_changed(&self, params: &BakeParams, keep_error: f32) -> Result<()> {
        params.validate()?;
        if !(keep_error >= 0.0 && keep_error.is_finite()) {
            return invalid_argument!("keep_error is {keep_error}, not a finite number ≥ 0");
        }
        let total = self.atlas.map.len() as u64;
        if params.target_error > 0.0 || params.texel_begin > 0 || !(params.texel_end == 0 || params.texel_end == total)
        {
            return invalid_argument!("a bake of changes is of all texels and has no target_error");
        }
        Ok(())
    }

    /// Returns the light from before a change, if a bake with these parameters can keep any of it.
    pub(super) fn before<'a>(
        &'a self,
        params: &BakeParams,
        plan: &Plan,
        direct: &DirectLight,
        origin: &Origin,
        keep: Keep<'a>,
        progress: &Progress,
    ) -> Result<Option<Before<'a>>> {
        let of = keep.earlier.unwrap_or(self);
        let Some(light) = of.light.as_ref().filter(|light| can_keep(light, params, plan)) else {
            return Ok(None);
        };
        let atlas = of.before.as_ref().unwrap_or(&of.atlas);
        let (former, moved) = match keep.earlier {
            Some(_) => {
                let match_surfaces = || Correspondence::between(atlas, &self.atlas, progress);
                let (former, moved) = self.atlas.scene.device().install(match_surfaces)?;
                (Some(former), moved)
            }
            None => (None, Moved::between(&atlas.scene, &self.atlas.scene, &self.atlas.charts)?),
        };
        let kept = match &former {
            Some(former) => Kept::Carried(Box::new(former.carried(light, atlas, &self.atlas)?)),
            None => Kept::InPlace(light),
        };
        let has_other_lights = !light.origin.is_some_and(|of_light| of_light.has_lights_of(origin))
            || keep.earlier.is_some() && atlas.scene.environments() != self.atlas.scene.environments();
        Ok(Some(Before {
            atlas,
            former,
            radiance: &light.radiance,
            kept,
            moved,
            has_other_lights,
            blurs_direct: direct_blur::is_needed(direct, params, plan),
            keep_error: keep.keep_error,
            keeps_radiance: keep.keeps_radiance && params.passes == 1 && keep.keep_error > 0.0,
            redo: OnceLock::new(),
            kept_radiance: OnceLock::new(),
        }))
    }
}

/// Which light a bake may keep.
#[derive(Clone, Copy)]
pub(super) struct Keep<'a> {
    /// Relative difference of light that is let stand.
    pub keep_error: f32,
    /// Whether texels of the radiance map may be kept, too: else all that is computed has the bits of a bake from nothing.
    pub keeps_radiance: bool,
    /// The light map that has it, if another one.
    pub earlier: Option<&'a Lightmap>,
}

/// Light that may be kept, by texel of the light map.
enum Kept<'a> {
    InPlace(&'a Light),
    /// From another light map, by [`Correspondence::carried`].
    Carried(Box<Light>),
}

/// The light of a light map before a change.
pub(super) struct Before<'a> {
    pub atlas: &'a Atlas,
    /// How its surfaces were numbered, if they are those of another scene.
    former: Option<Correspondence>,
    radiance: &'a Radiance,
    kept: Kept<'a>,
    pub moved: Moved,
    /// Whether a light was set since.
    pub has_other_lights: bool,
    /// Whether direct light is blurred.
    pub blurs_direct: bool,
    /// Relative difference of light that is let stand.
    pub keep_error: f32,
    /// Whether texels of the radiance map may be kept.
    keeps_radiance: bool,
    /// What is computed anew, once that is known.
    pub redo: OnceLock<Redo>,
    /// Number of texels of the radiance map that are kept, once that is known.
    pub kept_radiance: OnceLock<u64>,
}

impl Before<'_> {
    fn light(&self) -> &Light {
        match &self.kept {
            Kept::InPlace(light) => light,
            Kept::Carried(light) => light,
        }
    }

    /// Copies what is kept into new light that is dark.
    pub fn keep(&self, redo: &Redo, new: &mut Light) {
        let old = self.light();
        for (is_new, (new, old)) in redo.direct.iter().zip(new.direct.iter_mut().zip(&old.direct)) {
            if !is_new {
                *new = *old;
            }
        }
        let directional =
            new.directional.iter_mut().zip(&old.directional).map(Some).chain(std::iter::repeat_with(|| None));
        let indirect = new.indirect.iter_mut().zip(&old.indirect).zip(directional);
        for (_, ((new, old), directional)) in redo.indirect.iter().zip(indirect).filter(|(is_new, _)| !**is_new) {
            *new = *old;
            if let Some((new, old)) = directional {
                *new = *old;
            }
        }
        if let Some(stitch) = &old.stitch {
            stitch.former_where(new, |texel| (!redo.direct[texel], !redo.indirect[texel]));
        }
    }

    /// Copies the spread of passes where all light is kept.
    pub fn keep_spread(&self, new: &mut Light) {
        let Some(redo) = self.redo.get() else { return };
        let spread = new.spread.iter_mut().zip(&self.light().spread);
        for (_, (new, old)) in redo.indirect.iter().zip(spread).filter(|(is_new, _)| !**is_new) {
            *new = *old;
        }
    }
}

impl Redo {
    /// Returns what is asked for of the interpolation.
    pub fn asked(&self) -> Asked<'_> {
        Asked { placements: &self.placements, alone: &self.around }
    }

    /// Returns how many texels keep all of their light.
    pub fn kept(&self) -> u64 {
        self.indirect.iter().zip(&self.direct).filter(|(indirect, direct)| !**indirect && !**direct).count() as u64
    }

    /// Finds what is to be computed anew, given the new radiance map and sides of charts. To be called on the device's
    /// threads.
    pub fn find(
        before: &Before,
        atlas: &Atlas,
        params: &BakeParams,
        plan: &Plan,
        (radiance, backs): (&Radiance, &[bool]),
        progress: &Progress,
    ) -> Result<Redo> {
        let of_before = before.light();
        let old = SceneState { atlas: before.atlas, backs: &of_before.backs, former: before.former.as_ref() };
        let states = [old, SceneState { atlas, backs, former: None }];
        let comparison = Comparison::new(states, &before.moved, before.keep_error, progress)?;
        let mut cells = comparison.cells()?;
        let mut rays = 0;
        if !plan.runs(left_out::INDIRECT) {
            cells.iter_mut().for_each(|cell| cell.is_new = true);
        } else {
            let light = |texel: usize| (of_before.direct[texel] + of_before.indirect[texel]).element_sum();
            let texels = of_before.direct.len();
            let mean = ((0..texels).map(|i| f64::from(light(i))).sum::<f64>() / texels.max(1) as f64) as f32;
            let radiance = [before.radiance, radiance];
            rays = comparison.probe(&mut cells, radiance, params, |texel| light(texel.index()), mean)?;
        }
        let all_direct = before.has_other_lights || before.moved.emits || !plan.runs(left_out::DIRECT);
        // Light by direction is the sum of both kinds, and the spread of passes is of that: both are made anew together.
        if params.directional != 0 || params.passes > 1 {
            cells.iter_mut().for_each(|cell| cell.is_new |= all_direct || cell.is_shadowed);
            cells.iter_mut().for_each(|cell| cell.is_shadowed &= !cell.is_new);
        }
        let n = atlas.map.len();
        let placements = atlas.gather.layout.placements.len();
        let bytes = 4 * n + atlas.gather.len() + placements;
        let mut redo = Redo {
            indirect: try_vec(n, CHANGED)?,
            direct: try_vec(n, CHANGED)?,
            lit: try_vec(n, CHANGED)?,
            around: try_vec(n, CHANGED)?,
            gather: try_vec(atlas.gather.len(), CHANGED)?,
            placements: try_vec(placements, CHANGED)?,
            rays,
            _memory: atlas.scene.device().memory().reserve(bytes, CHANGED)?,
        };
        // By placement, since texels are numbered by placement.
        let (mut indirect, mut direct) = (&mut redo.indirect[..], &mut redo.direct[..]);
        let (mut lit, mut around, mut gather) = (&mut redo.lit[..], &mut redo.around[..], &mut redo.gather[..]);
        let mut parts = Vec::new();
        for (p, is_new) in redo.placements.iter_mut().enumerate() {
            let placement = PlacementId::new(p);
            let (texels, of_gather) = (atlas.map.texels_of(placement), atlas.gather.texels_of(placement));
            let part = Part {
                placement,
                is_new,
                indirect: indirect.split_off_mut(..texels.len()).unwrap_or_default(),
                direct: direct.split_off_mut(..texels.len()).unwrap_or_default(),
                lit: lit.split_off_mut(..texels.len()).unwrap_or_default(),
                around: around.split_off_mut(..texels.len()).unwrap_or_default(),
                gather: gather.split_off_mut(..of_gather.len()).unwrap_or_default(),
            };
            try_push(&mut parts, part, CHANGED)?;
        }
        let job = Job { before, atlas, params, comparison };
        parts.into_par_iter().try_each(|part| job.mark(part, &cells, all_direct))?;
        Ok(redo)
    }
}

/// Results for a placement.
struct Part<'a> {
    placement: PlacementId,
    is_new: &'a mut bool,
    indirect: &'a mut [bool],
    direct: &'a mut [bool],
    lit: &'a mut [bool],
    around: &'a mut [bool],
    gather: &'a mut [bool],
}

struct Job<'a, 'p> {
    before: &'a Before<'a>,
    atlas: &'a Atlas,
    params: &'a BakeParams,
    comparison: Comparison<'a, 'p>,
}

impl Job<'_, '_> {
    /// Marks the texels of a placement.
    fn mark(&self, part: Part, cells: &[Cell], all_direct: bool) -> Result<()> {
        let Comparison { grid, progress, .. } = &self.comparison;
        progress.check()?;
        let (atlas, placement) = (self.atlas, part.placement);
        let cells = &cells[grid.first(placement)..];
        let columns = grid.columns(placement);
        let is_new = |x: u32, y: u32| cells[(y / CELL * columns + x / CELL) as usize].is_new;
        let rect = &atlas.gather.layout[placement];
        // Fallback gathers read those around them.
        let width = |axis: usize| atlas.gather.layout[placement].scale[axis] / atlas.map.layout[placement].scale[axis];
        let of_own = (REACH as f32 * width(0).max(width(1))).ceil() as u32 + 1;
        // Blurred light reads texels so far away, and interpolation those beside them: of texels with new light, or of all
        // that may gather for themselves where the gather map tells whether they do.
        let compares = self.params.interpolation_contrast < f32::INFINITY;
        let of_gather = self.params.blur_radius.max(1) + 1 + if compares { of_own } else { 0 };
        let is_needed = |[x, y]: [u32; 2], margin: u32| {
            let last = |i: u32, size: u16| (i + margin).min(u32::from(size) - 1);
            let [x0, y0] = [x, y].map(|i| i.saturating_sub(margin));
            let (x1, y1) = (last(x, rect.w), last(y, rect.h));
            // The margin may be wider than a cell.
            (y0 / CELL..=y1 / CELL).any(|cy| (x0 / CELL..=x1 / CELL).any(|cx| is_new(cx * CELL, cy * CELL)))
        };
        let mut cuts: Vec<Option<Vec<(u32, u32)>>> = try_filled(grid.count(placement), None, CHANGED)?;
        for (i, texel) in atlas.map.texels_of(placement).enumerate() {
            let place = grid.place(placement, texel);
            let number = grid.of(placement, texel);
            let cell = &cells[number];
            part.indirect[i] = cell.is_new;
            part.around[i] = is_needed(place, of_own);
            part.direct[i] = all_direct
                || cell.is_new
                || cell.is_shadowed && {
                    if cuts[number].is_none() {
                        cuts[number] = Some(self.comparison.cuts(cell)?);
                    }
                    self.comparison.is_cut(texel, cuts[number].as_deref().unwrap_or_default())
                };
        }
        self.mark_lit(placement, part.direct, part.lit);
        for (needed, texel) in part.gather.iter_mut().zip(atlas.gather.texels_of(placement)) {
            let (x, y) = atlas.gather.position(texel);
            *needed = is_needed([x as u32 - u32::from(rect.x), y as u32 - u32::from(rect.y)], of_gather);
        }
        *part.is_new = part.around.iter().any(|&b| b) || part.gather.iter().any(|&b| b);
        Ok(())
    }

    /// Marks the texels of a placement whose direct light is needed for that of those that get new direct light.
    fn mark_lit(&self, placement: PlacementId, direct: &[bool], lit: &mut [bool]) {
        lit.copy_from_slice(direct);
        if !self.before.blurs_direct {
            return;
        }
        let (map, texels) = (&self.atlas.map, self.atlas.map.texels_of(placement));
        for texel in texels.clone().filter(|&texel| direct[texels.place(texel)]) {
            let (x, y) = map.position(texel);
            let near = |dx: i32, dy: i32| map.at(placement, x + dx, y + dy).filter(|&near| texels.contains(near));
            let is_inner = |(dx, dy)| near(dx, dy).is_some_and(|near| direct[texels.place(near)]);
            if [(-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (1, -1), (-1, 1), (1, 1)].into_iter().all(is_inner) {
                continue;
            }
            let side = -direct_blur::RADIUS..=direct_blur::RADIUS;
            for near in side.clone().flat_map(|dy| side.clone().filter_map(move |dx| near(dx, dy))) {
                lit[texels.place(near)] = true;
            }
        }
    }
}

/// Whether a bake with these parameters can keep any of the light.
pub(super) fn can_keep(light: &Light, params: &BakeParams, plan: &Plan) -> bool {
    !light.state.contains(&TexelState::Unbaked)
        && light.origin.is_some_and(|origin| origin.has_params(params))
        && (!plan.runs(left_out::INDIRECT) || !light.radiance.values.is_empty())
}

#[cfg(test)]
mod tests;
