//! Which texels of the radiance map a bake after a change computes anew.
//!
//! Photons are traced again, and those of paths that met what moved are [told apart](crate::photon::Change). A texel is
//! computed anew if
//!
//! - its surface or what it shows moved, or what moved is so near that it may hide a part of its disc of photons,
//! - what moved lies, or lay, between it and a light, or
//! - by the photons in its disc that came and those that went, its radiance changes by more than `keep_error`, relative to its
//!   radiance or, if that is more, to a tenth of the mean.
//!
//! All others keep their radiance, bit for bit, so that rays which end on them tell no difference but where other patches
//! count as bright.

use super::Before;
use super::comparison::{CHANGED, DARK};
use super::sources::Shadows;
use crate::base::bounds::Bounds;
use crate::base::error::Result;
use crate::base::memory::{try_collect, try_par_gather};
use crate::base::progress::Progress;
use crate::lightmap::BakeStats;
use crate::lightmap::atlas::Atlas;
use crate::lightmap::atlas::ids::{PlacementId, RadianceTexel};
use crate::lightmap::indirect::radiance_map::Radiance;
use crate::lightmap::indirect::texel_albedo;
use crate::lightmap::plan::{Plan, left_out};
use crate::lightmap::stages::{self, Inputs};
use crate::photon::{Change, Difference};
use crate::scene::{NONE, Scene};
use glam::Vec3;
use std::f32::consts::PI;
use std::ops::Range;

/// Number of texels of a placement, beside one another in it, that are compared with sources of light together.
const RUN: usize = 64;

/// How much more of a disc's photons may be gone than their light tells, as the estimate is divided by the visible part of the
/// disc: at an edge of a surface half of it, in a corner a quarter.
const AT_EDGES: f32 = 4.0;

/// Width of the rim around a texel, in texels, at whose points its direct light may be computed.
const RIM: f32 = 2.0;

impl Before<'_> {
    /// Computes the radiance map after the change, keeping what it can of the former one; `None` if it cannot keep any.
    pub fn illuminate(&self, inputs: &Inputs, plan: &Plan, stats: &mut BakeStats) -> Result<Option<Radiance>> {
        let lights_stay = !self.has_other_lights && !self.moved.emits;
        if !self.keeps_radiance || !lights_stay || !plan.runs(left_out::PHOTONS) {
            return Ok(None);
        }
        // Others round differently, so that their paths are not the former ones.
        let rounds_alike = |scene: &Scene| scene.device().isa().is_fused();
        if rounds_alike(&self.atlas.scene) != rounds_alike(&inputs.atlas.scene) {
            return Ok(None);
        }
        let Some(guidance) = &self.radiance.guidance else { return Ok(None) };
        let change = Change { old: &self.atlas.scene, boxes: &self.moved.boxes, guidance };
        let Some((photons, difference)) = stages::photons_again(inputs, &change, stats)? else { return Ok(None) };
        let (atlas, old) = (inputs.atlas, &self.radiance.values);
        let sum: f64 = old.iter().map(|v| f64::from(v.element_sum())).sum();
        let search = Search {
            before: self,
            atlas,
            progress: inputs.progress,
            shadows: Shadows::new(&atlas.scene, &self.moved.boxes, self.keep_error)?,
            difference,
            dark: DARK * (sum / old.len().max(1) as f64) as f32,
        };
        let placements = atlas.radiance.layout.placements.len();
        let find = || try_par_gather(placements, CHANGED, |p, out| search.look(PlacementId::new(p), out));
        let former: Vec<u32> = atlas.scene.device().install(find)?;
        let bytes = former.len() * (size_of::<u32>() + size_of::<bool>());
        let _memory = atlas.scene.device().memory().reserve(bytes, CHANGED)?;
        let kept = |&former: &u32| old.get(former as usize).copied().unwrap_or_default();
        let values = try_collect(former.iter().map(kept), "the radiance map")?;
        let anew = try_collect(former.iter().map(|&former| former == NONE), CHANGED)?;
        drop(search);
        let count = anew.iter().filter(|&&anew| !anew).count() as u64;
        let radiance = stages::radiance_again(inputs, &photons, guidance.clone(), (values, &anew), stats)?;
        self.kept_radiance.get_or_init(|| count);
        Ok(Some(radiance))
    }
}

/// The search for texels whose radiance may stay.
struct Search<'a, 'b, 'p> {
    before: &'a Before<'b>,
    atlas: &'a Atlas,
    progress: &'a Progress<'p>,
    shadows: Shadows<'a>,
    difference: Difference,
    /// Texels darker than this, by the sum of channels, count as if they were so bright.
    dark: f32,
}

impl Search<'_, '_, '_> {
    /// Appends the former texel of each texel of a placement, [`NONE`] for those that are computed anew.
    fn look(&self, placement: PlacementId, out: &mut Vec<u32>) -> Result<()> {
        let (map, moved) = (&self.atlas.radiance, &self.before.moved);
        let texels = map.texels_of(placement).indices();
        if moved.has(map.layout.chart_of(placement)) {
            out.extend(std::iter::repeat_n(NONE, texels.len()));
            return Ok(());
        }
        for first in texels.clone().step_by(RUN) {
            self.look_at_run(placement, first..texels.end.min(first + RUN), out)?;
        }
        Ok(())
    }

    /// Does the work of [`look`](Self::look) for a run of texels, whose light is compared with sources together.
    fn look_at_run(&self, placement: PlacementId, texels: Range<usize>, out: &mut Vec<u32>) -> Result<()> {
        self.progress.check()?;
        let (atlas, boxes) = (self.atlas, &self.before.moved.boxes);
        let (map, n) = (&atlas.radiance, texels.len());
        let [x, y] = map.layout[placement].scale;
        // Of a texel with its rim, in scene units.
        let width = RIM / x.min(y);
        let (mut positions, mut normals) = ([[0.0; 3]; RUN], [[0.0; 3]; RUN]);
        let (mut changes, mut room) = ([[0.0; 3]; RUN], [[0.0; 3]; RUN]);
        let mut bounds = Bounds::EMPTY;
        for (i, texel) in texels.clone().map(RadianceTexel::new).enumerate() {
            let (point, receiver) = map.receiver(&atlas.scene, texel, map.is_back(texel));
            bounds.add(point.position);
            (positions[i], normals[i]) = (point.position.to_array(), receiver.geometric.to_array());
        }
        if !self.difference.is_none() {
            self.difference.irradiance(&positions[..n], &normals[..n], &mut room[..n], &mut changes[..n]);
        }
        let near = width + self.difference.radius();
        let is_near = boxes.iter().any(|moved| bounds.distance(moved) < near);
        let cuts = self.shadows.cuts(&bounds.grown(width))?;
        for (i, texel) in texels.map(RadianceTexel::new).enumerate() {
            let position = Vec3::from(positions[i]);
            let point = Bounds { lower: position, upper: position };
            let keeps = || {
                let former = self.former(placement, texel)?;
                let hides = is_near && boxes.iter().any(|moved| point.distance(moved) < near);
                let is_kept = !hides
                    && !self.shadows.is_cut(&point.grown(width), &cuts)
                    && self.is_like(texel, former, changes[i]);
                is_kept.then_some(former.index() as u32)
            };
            out.push(keeps().unwrap_or(NONE));
        }
        Ok(())
    }

    /// Returns the former number of a texel, if it showed the same point.
    fn former(&self, placement: PlacementId, texel: RadianceTexel) -> Option<RadianceTexel> {
        let old = self.before.atlas;
        match &self.before.former {
            Some(former) => former.radiance_texel(old, self.atlas, placement, texel),
            None => (self.atlas.radiance[texel] == old.radiance[texel]).then_some(texel),
        }
    }

    /// Whether a change of irradiance is small enough for a texel to keep its radiance.
    fn is_like(&self, texel: RadianceTexel, former: RadianceTexel, change: [f32; 3]) -> bool {
        if change == [0.0; 3] {
            return true;
        }
        let albedo = texel_albedo::albedo(&self.atlas.areas(&self.atlas.radiance), texel);
        let change = AT_EDGES * (albedo * Vec3::from(change)).abs().element_sum() / PI;
        let radiance = self.before.radiance.values[former.index()].element_sum();
        // What is not a number differs.
        change <= self.before.keep_error * radiance.max(self.dark)
    }
}
