//! Blur of direct light that is sampled, where it is noisy.
//!
//! The light of skies, of area lights and of many lights is estimated from a few dozen shadow rays per texel: enough in
//! the open, but in a room whose window fills a hundredth of the hemisphere each texel has an error of its own of half its
//! light. Texels whose difference is within their noise are therefore averaged with those around them, as the [gather
//! map](super::indirect::blur) is. Light without penumbrae and that of discs, whose edges are narrow, has no part in the
//! noise, so that shadows in the sun stay as sharp as they are; and where there is no noise, nothing changes.
//!
//! The light of a texel depends on that of texels up to [`RADIUS`] away in its chart, before the blur: shards and blocks
//! of live updates light those too.
//!
//! Measured: docs/experiments.md#noise-of-direct-light.

use super::BakeParams;
use super::atlas::Atlas;
use super::atlas::ids::{LightTexel, PlacementId};
use super::indirect::blur::{Noisy, Window};
use super::plan::{Plan, left_out};
use crate::base::directional::{Directional, Linear};
use crate::base::error::Result;
use crate::base::memory::{try_parts, try_to_vec};
use crate::base::parallel::{ParallelLoop, one_by_one};
use crate::base::progress::Stage;
use crate::direct::DirectLight;
use glam::Vec3;
use rayon::prelude::*;
use std::ops::Range;

/// Radius in texels of the light map.
pub(crate) const RADIUS: i32 = 4;

/// Bytes per texel of the light map while a bake blurs it: its variance, and its light before.
pub(crate) const TEXEL_BYTES: usize = size_of::<f32>() + size_of::<Vec3>();

/// Texels that a thread blurs at a time.
const BLOCK: usize = 1024;

/// Standard deviation, as a fraction of the light, below which noise is not seen.
const LEAST: f32 = 0.02;

/// Whether a bake's direct light has noise to blur.
pub(crate) fn is_needed(direct: &DirectLight, params: &BakeParams, plan: &Plan) -> bool {
    plan.runs(left_out::DIRECT) && params.blur_radius > 0 && direct.has_wide()
}

/// Returns the texels whose light before the blur a range of texels needs.
pub(crate) fn needed(atlas: &Atlas, range: &Range<usize>) -> Range<usize> {
    atlas.map.with_rows_around(range, RADIUS)
}

/// Blurs the direct light of the texels of `range` that are new: `direct`, by texel, and `directed`, if it is asked for by
/// direction, whose first texel and that of `variances` is the first of those that are `lit`. To be called on the device's
/// threads. Advances `stage` by one per texel.
pub(crate) fn blur(
    atlas: &Atlas,
    lit: &Range<usize>,
    range: &Range<usize>,
    is_new: impl Fn(usize) -> bool + Sync,
    (variances, direct, directed): (&[f32], &mut [Vec3], &mut [Directional]),
    stage: &Stage,
) -> Result<()> {
    let (what, n) = ("direct light before the blur", directed.len());
    let before = try_to_vec(&direct[lit.clone()], what)?;
    let before_directed = try_to_vec(directed, what)?;
    let out = direct[range.clone()].par_chunks_mut(BLOCK);
    let own = if n == 0 { 0..0 } else { range.start - lit.start..range.end - lit.start };
    let out = out.zip(try_parts(&mut directed[own], BLOCK, range.len())?).enumerate();
    one_by_one(out).try_each(|(block, (out, directed))| {
        let mut blur = DirectBlur::new(atlas);
        let place = |texel: LightTexel| texel.index() - lit.start;
        let noisy = |texel| Some((before[place(texel)], variances[place(texel)]));
        let first = range.start + block * BLOCK;
        for (i, out) in out.iter_mut().enumerate().filter(|(i, _)| is_new(first + i)) {
            let texel = LightTexel::new(first + i);
            *out = blur.mean(texel, noisy, |s| before[place(s)]);
            if let Some(out) = directed.get_mut(i) {
                *out = blur.mean(texel, noisy, |s| before_directed[place(s)]);
            }
        }
        stage.advance(out.len() as u64)
    })
}

/// Blurs the light of one texel at a time.
pub(crate) struct DirectBlur<'a> {
    atlas: &'a Atlas,
    window: Window,
}

impl<'a> DirectBlur<'a> {
    pub(crate) fn new(atlas: &'a Atlas) -> Self {
        DirectBlur { atlas, window: Window::new(RADIUS) }
    }

    /// Returns `of` a texel, averaged with that of the texels around it that have the same light but for noise. `lit`
    /// returns the light of a texel of the same placement and its variance, summed over the channels, both before the
    /// blur; `None` if that is not known. Buried texels take no part.
    pub(crate) fn mean<T: Linear>(
        &mut self,
        texel: LightTexel,
        lit: impl Fn(LightTexel) -> Option<(Vec3, f32)>,
        of: impl Fn(LightTexel) -> T,
    ) -> T {
        let Atlas { scene, charts, map, .. } = self.atlas;
        let placement = map.placement_of(charts, texel);
        let buried = |s: LightTexel| self.atlas.buried.get(s.index()) == Some(&true);
        let lit = |s| lit(s).filter(|_| !buried(s));
        let Some((light, _)) = lit(texel) else { return of(texel) };
        let own = self.smooth(&lit, placement, texel);
        if own <= (LEAST * light.element_sum()).powi(2) {
            return of(texel);
        }
        let triangle = map[texel].triangle;
        let normal = map.surface(scene, texel).1;
        let of_placement = map.texels_of(placement);
        let get = |s: LightTexel| {
            if !of_placement.contains(s) {
                return None;
            }
            let (value, variance) = lit(s)?;
            let normal = if map[s].triangle == triangle { normal } else { map.surface(scene, s).1 };
            Some(Noisy { value, variance: variance.max(own), normal })
        };
        self.window.mean(charts, map, texel, get, of).value
    }

    /// Returns the mean variance of a texel and those beside it: that of a single texel is known from few points.
    fn smooth(
        &self,
        lit: &impl Fn(LightTexel) -> Option<(Vec3, f32)>,
        placement: PlacementId,
        texel: LightTexel,
    ) -> f32 {
        let map = &self.atlas.map;
        let of_placement = map.texels_of(placement);
        let (x, y) = map.position(texel);
        let (mut sum, mut count) = (0.0, 0.0);
        for (dx, dy) in (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (dx, dy))) {
            let near = map.at(placement, x + dx, y + dy).filter(|&s| of_placement.contains(s));
            if let Some((_, variance)) = near.and_then(lit) {
                sum += variance;
                count += 1.0;
            }
        }
        sum / count
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::progress::Progress;
    use crate::lightmap::{BakeParams, Lightmap, LightmapDesc};
    use crate::scene::demo::shapes::MeshBuilder;
    use crate::scene::{Light, Material, NONE, SceneData};

    /// A room of 4 × 4 × 3 m with a window of 1 m² in one wall, under a sky.
    fn room() -> Lightmap {
        let mut data = SceneData::new();
        let m = data.add_material(Material { albedo: [0.5; 3], ..Default::default() }).unwrap();
        let mut walls = MeshBuilder::new();
        walls.box_(Vec3::new(-0.2, -0.2, -0.2), Vec3::new(4.2, 4.2, 0.0), false, m);
        walls.box_(Vec3::new(-0.2, -0.2, 3.0), Vec3::new(4.2, 4.2, 3.2), false, m);
        for (lower, upper) in [
            ([-0.2, -0.2], [4.2, 0.0]),
            ([-0.2, 4.0], [4.2, 4.2]),
            ([-0.2, 0.0], [0.0, 4.0]),
            ([4.0, 0.0], [4.2, 1.5]),
            ([4.0, 2.5], [4.2, 4.0]),
        ] {
            walls.box_(Vec3::new(lower[0], lower[1], 0.0), Vec3::new(upper[0], upper[1], 3.0), false, m);
        }
        walls.box_(Vec3::new(4.0, 1.5, 0.0), Vec3::new(4.2, 2.5, 1.0), false, m);
        walls.box_(Vec3::new(4.0, 1.5, 2.0), Vec3::new(4.2, 2.5, 3.0), false, m);
        data.add_mesh(walls.finish()).unwrap();
        data.add_light(Light::Sky { radiance: [1.0; 3], environment: NONE, up: Vec3::Z, rotation: 0.0 }).unwrap();
        let desc = LightmapDesc { texels_per_unit: 12.0, page_size: 512, ..Default::default() };
        Lightmap::create(&data.committed(), &desc, &Progress::none()).unwrap()
    }

    /// Direct light of the texels of the floor of the room, and of the wall opposite the window.
    fn light(lightmap: &mut Lightmap, params: BakeParams) -> Vec<f32> {
        lightmap.bake(&BakeParams { gather_rays: 0, ..params }, &Progress::none()).unwrap();
        let atlas = lightmap.atlas();
        let is_inside = |texel: &LightTexel| {
            let p = atlas.map.surface(&atlas.scene, *texel).0;
            p.y > 0.1 && p.y < 3.9 && (p.z.abs() < 1e-3 && p.x > 0.1 && p.x < 3.9 || p.x.abs() < 1e-3 && p.z > 0.1)
        };
        let direct = &lightmap.light.as_ref().unwrap().direct;
        atlas.map.all().filter(is_inside).map(|texel| direct[texel.index()].x).collect()
    }

    #[test]
    fn a_room_with_a_window_has_a_fraction_of_the_noise_and_as_much_light() {
        let mut room = room();
        let truth = light(&mut room, BakeParams { direct_samples: 1024, blur_radius: 0, ..Default::default() });
        let plain = light(&mut room, BakeParams { blur_radius: 0, ..Default::default() });
        let blurred = light(&mut room, BakeParams::default());
        assert!(truth.len() > 3000, "{}", truth.len());
        let mean = truth.iter().sum::<f32>() / truth.len() as f32;
        let error = |of: &[f32]| {
            let squares = of.iter().zip(&truth).map(|(e, t)| ((e - t) / mean).powi(2));
            (squares.sum::<f32>() / truth.len() as f32).sqrt()
        };
        let sum = |of: &[f32]| of.iter().sum::<f32>() / truth.iter().sum::<f32>();
        let (before, after) = (error(&plain), error(&blurred));
        assert!(before > 0.2 && after < 0.35 * before, "{before} before the blur, {after} after it");
        // Against the same samples: against the truth, the error of the samples' own mean, 1 % here, counts too.
        let kept = sum(&blurred) / sum(&plain);
        assert!((kept - 1.0).abs() < 0.015, "{kept}");
    }

    #[test]
    fn a_range_needs_the_rows_beside_it_of_the_charts_that_it_cuts() {
        let room = room();
        let atlas = room.atlas();
        let rows = |i: usize| atlas.map.position(LightTexel::new(i)).1;
        let largest = (0..atlas.map.layout.placements.len())
            .map(|p| atlas.map.texels_of(PlacementId::new(p)).indices())
            .max_by_key(|texels| texels.len())
            .unwrap();
        let middle = (largest.start + largest.end) / 2;
        let of_half = needed(atlas, &(middle..atlas.map.len()));
        assert_eq!((rows(of_half.start), of_half.end), (rows(middle) - RADIUS, atlas.map.len()));
        assert_eq!(rows(of_half.start - 1), rows(middle) - RADIUS - 1);
        assert_eq!(needed(atlas, &largest), largest);
        assert_eq!(needed(atlas, &(middle..middle)), middle..middle);
    }
}
