//! Direct light of a bake: averaged over texels, with its variance where noise is blurred.

use super::{BLOCK, Bake};
use crate::base::directional::Directional;
use crate::base::error::Result;
use crate::base::memory::{try_collect, try_parts, try_vec, try_with_capacity};
use crate::base::parallel::{ParallelLoop, one_by_one};
use crate::base::progress::Stage;
use crate::base::sampling::purpose_seed;
use crate::base::scratch::Scratch;
use crate::lightmap::atlas::ids::{LightMap, LightTexel};
use crate::lightmap::changed::Redo;
use crate::lightmap::stages::purpose;
use crate::lightmap::texel_light::averages::{Averaged, Variation};
use crate::lightmap::texel_light::{TexelLight, TilePoints};
use crate::lightmap::tiles::{TILE, in_order, texels_per_tile};
use crate::lightmap::{TexelState, direct_blur};
use glam::Vec3;
use rayon::prelude::*;
use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

impl Bake<'_, '_> {
    /// Returns the texels that keep their direct light although that of before the blur is computed for others, with what
    /// they keep.
    pub(super) fn lit_only(&self, redo: Option<&Redo>, direct: &[Vec3]) -> Result<Vec<(u32, Vec3)>> {
        let Some(redo) = redo.filter(|_| self.blurs_direct()) else { return Ok(Vec::new()) };
        let texels = (0..direct.len()).filter(|&i| redo.lit[i] && !redo.direct[i]);
        try_collect(texels.map(|i| (i as u32, direct[i])), "direct light that is kept")
    }

    /// Whether direct light has noise to blur.
    pub(super) fn blurs_direct(&self) -> bool {
        direct_blur::is_needed(self.direct, self.params, self.plan)
    }

    /// Returns the computation of direct light for the light map's texels.
    pub(super) fn texel_light(&self) -> TexelLight<'_, LightMap> {
        TexelLight {
            areas: self.atlas.areas(&self.atlas.map),
            direct: self.direct,
            samples: self.params.direct_samples,
            seed: purpose_seed(self.params.seed, purpose::DIRECT),
            sky_from: Some(self.atlas),
        }
    }

    /// Replaces direct light without penumbrae at the samples of a range by all direct light, averaged over texels, and
    /// finds its variance if there is room for it. Returns the number of rays.
    pub(super) fn average_direct(
        &self,
        texels: &TexelLight<LightMap>,
        backs: &[bool],
        (known, redo): (&[bool], Option<&Redo>),
        range: &Range<usize>,
        (direct, directed, variances): (&mut [Vec3], &mut [Directional], &mut [f32]),
        state: &[TexelState],
        stage: &Stage,
    ) -> Result<u64> {
        let l = self.atlas;
        let is_new = |texel: usize| redo.is_none_or(|redo| redo.lit[texel]);
        let rays = AtomicU64::new(0);
        let mut variations: Vec<Variation> = try_vec(range.len(), "where direct light varies")?;
        let tiles = Scratch::new();
        let new_tile = if directed.is_empty() { TilePoints::new } else { TilePoints::by_direction };
        l.scene.device().install(|| {
            let sharp = &direct[..];
            one_by_one(variations.par_chunks_mut(BLOCK).enumerate()).each(|(block, out)| {
                let mut traced = 0;
                let first = range.start + block * BLOCK;
                for (i, variation) in out.iter_mut().enumerate().filter(|(i, _)| !known[block] && is_new(first + i)) {
                    let texel = LightTexel::new(first + i);
                    // Neighbours that another shard bakes, that a checkpoint has or that keep their light are computed
                    // here too.
                    let is_here = |i: usize| range.contains(&i) && !known[(i - range.start) / BLOCK] && is_new(i);
                    *variation = texels.varies(texel, sharp[texel.index()], |near| match is_here(near.index()) {
                        true => sharp[near.index()],
                        false => texels.sharp(&l.receiver(&l.map, backs, near), &mut traced),
                    });
                }
                rays.fetch_add(traced, Relaxed);
            });
            let blocks = direct[range.clone()].par_chunks_mut(BLOCK).zip(state[range.clone()].par_chunks(BLOCK));
            let sums =
                try_parts(directed, BLOCK, range.len())?.into_par_iter().zip(try_parts(variances, BLOCK, range.len())?);
            let blocks = blocks.zip(variations.par_chunks(BLOCK)).zip(sums).enumerate();
            one_by_one(blocks).try_each(|(block, (((direct, state), variations), (directed, variances)))| {
                if known[block] {
                    return stage.advance(direct.len() as u64);
                }
                let (mut traced, first) = (0, range.start + block * BLOCK);
                let mut tile = tiles.take(|| new_tile(TILE))?;
                let mut of_tile = try_with_capacity(TILE, "the texels of a tile")?;
                let mut order = in_order(&l.map, first..first + direct.len())?;
                // The others have their light. (Direct light of Sponza in the sun, 12 texels/m: 0.85 of the time with
                // their receivers.)
                order.retain(|t| {
                    let varies = self.direct.has_soft() || variations[t.index() - first] != Variation::None;
                    varies && is_new(t.index())
                });
                let mut receiver = l.receivers(&l.map, backs);
                for some in order.chunks(texels_per_tile(texels.samples)) {
                    self.progress.check()?;
                    of_tile.clear();
                    of_tile.extend(some.iter().map(|&texel| Averaged {
                        texel,
                        back: l.is_back(&l.map, backs, texel),
                        receiver: receiver(texel),
                        sharp: direct[texel.index() - first],
                        sharp_directional: directed.get(texel.index() - first).copied().unwrap_or_default(),
                        variation: variations[texel.index() - first],
                    }));
                    let place = |i: usize| some[i].index() - first;
                    texels.irradiance(&of_tile, &mut tile, &mut traced, |i, e, variance, by_direction| {
                        direct[place(i)] = e;
                        if let Some(of_texel) = variances.get_mut(place(i)) {
                            *of_texel = variance;
                        }
                        if let Some(directed) = directed.get_mut(place(i)) {
                            *directed = *by_direction;
                        }
                    });
                }
                if let Some(c) = self.from.checkpoint {
                    c.keep_lit(block, direct, variances, state, directed);
                }
                rays.fetch_add(traced, Relaxed);
                stage.advance(direct.len() as u64)
            })
        })?;
        Ok(rays.into_inner())
    }
}
