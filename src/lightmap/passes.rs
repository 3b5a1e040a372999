//! Passes: whole bakes with different random numbers, whose mean is the light and whose spread tells its error (the
//! sample variance of the mean).
//!
//! All that is random differs between passes: photons, gather rays, bright patches, shadow rays. So the spread holds the
//! noise of every stage. What all passes have in common (resolution of the maps, blur, the radiance map's texels where
//! gather rays hit nearby) is not part of it; [`BakeParams::near_hits`] and the light map's divisors lessen that.
//! How far the estimate is right: docs/accuracy.md#estimated-error.

use super::{BakeParams, BakeStats, Light, Spread, StageStats};
use crate::base::directional::Directional;
use crate::base::error::Result;
use crate::base::memory::try_vec;
use crate::base::parallel::ParallelLoop;
use crate::scene::MOST_LIGHT;
use glam::Vec3;
use rayon::prelude::*;
use std::ops::Range;

/// Distance between the seeds of passes. The first pass has the caller's.
const SEED_STEP: u64 = 1 << 48;

/// Least number of passes that decide whether an error is small enough: two or three may agree by chance.
const LEAST: u32 = 4;

/// Maximum number of passes.
pub(crate) const MAX_PASSES: u32 = 4096;

/// Texels darker than this part of the mean light count as if they were so bright.
const DARK: f64 = 0.1;

/// Texels per task.
const BLOCK: usize = 1 << 14;

/// Returns the parameters of a pass.
pub(super) fn params_of(params: &BakeParams, pass: u32) -> BakeParams {
    BakeParams { seed: params.seed.wrapping_add(u64::from(pass).wrapping_mul(SEED_STEP)), ..*params }
}

/// Light of the passes so far.
pub(super) struct Passes {
    /// Mean light. Its [`Spread`]s hold, until the end, the sum over the passes of squared differences from the mean in
    /// place of the error, and that of the light of every second pass less that of the others in place of the difference.
    pub light: Light,
    pub stats: BakeStats,
    pub count: u32,
}

impl Passes {
    /// Begins with the first pass, of some texels of the light map.
    pub fn begin(mut light: Light, stats: BakeStats, range: &Range<usize>) -> Result<Passes> {
        let what = "the spread of passes";
        light._memory.grow(light.direct.len() * size_of::<Spread>(), what)?;
        light.spread = try_vec(light.direct.len(), what)?;
        for i in range.clone() {
            light.spread[i].difference = [light.direct[i], light.indirect[i]];
        }
        Ok(Passes { light, stats, count: 1 })
    }

    /// Returns the size of the buffers.
    pub fn bytes(&self) -> usize {
        self.light.bytes()
    }

    /// Adds a pass (Welford's update of mean and squared differences).
    pub fn add(&mut self, new: &Light, stats: &BakeStats, range: &Range<usize>) {
        self.count += 1;
        let sign = if self.count.is_multiple_of(2) { -1.0 } else { 1.0 };
        let part = 1.0 / self.count as f32;
        let mix = |mean: &mut Vec3, new: Vec3| *mean += (new - *mean) * part;
        let old = &mut self.light;
        let light =
            old.direct[range.clone()].par_chunks_mut(BLOCK).zip(old.indirect[range.clone()].par_chunks_mut(BLOCK));
        let states = old.state[range.clone()].par_chunks_mut(BLOCK);
        let states = states.zip(old.spread[range.clone()].par_chunks_mut(BLOCK));
        light.zip(states).enumerate().each(|(block, ((direct, indirect), (state, spread)))| {
            let first = range.start + block * BLOCK;
            for (i, s) in (first..).zip(0..direct.len()) {
                let all = new.direct[i] + new.indirect[i];
                let before = all - (direct[s] + indirect[s]);
                mix(&mut direct[s], new.direct[i]);
                mix(&mut indirect[s], new.indirect[i]);
                // Both differences have the same sign but for rounding.
                let spread = &mut spread[s];
                spread.error += (before * (all - (direct[s] + indirect[s]))).max(Vec3::ZERO);
                let sums = spread.difference.iter_mut().zip([new.direct[i], new.indirect[i]]);
                sums.for_each(|(sum, new)| *sum += new * sign);
                state[s] = state[s].max(new.state[i]);
            }
        });
        let mix_directional =
            |(mean, new): (&mut Directional, &Directional)| *mean = *mean * (1.0 - part) + *new * part;
        if !old.directional.is_empty() {
            let of_range = old.directional[range.clone()].par_iter_mut().zip(&new.directional[range.clone()]);
            of_range.with_min_len(BLOCK).each(mix_directional);
        }
        let radiance = old.radiance.values.par_iter_mut().zip(&new.radiance.values);
        radiance.with_min_len(BLOCK).each(|(mean, &new)| mix(mean, new));
        add_stats(&mut self.stats, stats);
    }

    /// Estimates the relative error of the mean over all passes: the root of the mean over texels and channels of
    /// variance by squared light. There must have been several.
    fn error(&self, range: &Range<usize>) -> f64 {
        let light = &self.light;
        let all = |i: usize| (light.direct[range.start + i] + light.indirect[range.start + i]).as_dvec3();
        // Sums of blocks are added in order: the same bits on any number of threads.
        let sum = |of: &(dyn Fn(usize) -> f64 + Sync)| -> f64 {
            let blocks = (0..range.len().div_ceil(BLOCK)).into_par_iter();
            let of_block = |b: usize| (b * BLOCK..range.len().min((b + 1) * BLOCK)).map(of).sum();
            blocks.map(of_block).collected().iter().sum()
        };
        let values = 3.0 * range.len().max(1) as f64;
        let mean = sum(&|i| all(i).element_sum()) / values;
        let least = (DARK * mean).powi(2);
        let passes = f64::from(self.count);
        let squares = sum(&|i| {
            let weight = (all(i) * all(i) + least).recip();
            let relative = light.spread[range.start + i].error.as_dvec3() * weight;
            // Where all is dark there is no error.
            if least > 0.0 { relative.element_sum() } else { 0.0 }
        });
        (squares / (values * passes * (passes - 1.0))).sqrt()
    }

    /// Returns how many passes are needed, as far as one knows now.
    pub fn needed(&self, params: &BakeParams, range: &Range<usize>) -> u32 {
        if params.target_error == 0.0 {
            return params.passes;
        }
        let (least, target) = (params.passes.max(LEAST), f64::from(params.target_error));
        if self.count < least {
            return least;
        }
        let error = self.error(range);
        if error <= target {
            return self.count;
        }
        // The variance falls in proportion to the passes.
        let forecast = f64::from(self.count) * (error / target).powi(2);
        (forecast as u32).max(self.count + 1).min(MAX_PASSES)
    }

    /// Returns the mean light of several passes, with its standard error and the difference of its halves.
    pub fn finish(mut self, range: &Range<usize>) -> (Light, BakeStats) {
        self.stats.passes = self.count;
        self.stats.error = self.error(range);
        // Squares of the strongest light are infinite.
        let most = Vec3::splat(MOST_LIGHT);
        let n = self.count as f32;
        let scale = 1.0 / (n * (n - 1.0));
        // The passes of both halves; the sums of their light follow from the mean of all and the difference.
        let (a, b) = (self.count.div_ceil(2) as f32, (self.count / 2) as f32);
        let (of_mean, of_difference) = (0.5 * n * (1.0 / a - 1.0 / b), 0.5 * (1.0 / a + 1.0 / b));
        let Light { direct, indirect, spread, .. } = &mut self.light;
        let light = direct[range.clone()].par_iter().zip(&indirect[range.clone()]);
        spread[range.clone()].par_iter_mut().zip(light).with_min_len(BLOCK).each(|(spread, (direct, indirect))| {
            spread.error = (spread.error * scale).map(f32::sqrt).min(most);
            for (difference, mean) in spread.difference.iter_mut().zip([direct, indirect]) {
                *difference = (*difference * of_difference + *mean * of_mean).clamp(-most, most);
            }
        });
        (self.light, self.stats)
    }
}

/// Adds the work of a pass to that of those before.
pub(super) fn add_stats(all: &mut BakeStats, pass: &BakeStats) {
    let add = |all: &mut StageStats, pass: &StageStats| {
        all.seconds += pass.seconds;
        all.rays += pass.rays;
        all.bytes = all.bytes.max(pass.bytes);
    };
    add(&mut all.photons, &pass.photons);
    add(&mut all.radiance, &pass.radiance);
    add(&mut all.gather, &pass.gather);
    add(&mut all.direct, &pass.direct);
    add(&mut all.compose, &pass.compose);
    all.photons_emitted += pass.photons_emitted;
    all.photons_stored += pass.photons_stored;
    all.seconds += pass.seconds;
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::error::Error;
    use crate::base::progress::Progress;
    use crate::bvh::BuildOptions;
    use crate::device::{Device, DeviceOptions};
    use crate::lightmap::{CheckpointParams, Layer, LayerData, Lightmap, LightmapDesc};
    use crate::scene::Scene;
    use crate::scene::builtin;

    fn cornell(threads: usize) -> Lightmap {
        let device = Device::new(DeviceOptions { num_threads: threads, ..Default::default() }).unwrap();
        let (data, options) = (builtin("cornell").unwrap(), BuildOptions::default());
        let scene = Scene::commit(&device, data, &options, &Progress::none()).map_err(|(_, e)| e).unwrap();
        let desc = LightmapDesc { texels_per_unit: 8.0, page_size: 128, ..Default::default() };
        Lightmap::create(&scene, &desc, &Progress::none()).unwrap()
    }

    const PARAMS: BakeParams = BakeParams {
        photon_count: 20_000,
        max_bounces: 0,
        gather_rays: 32,
        radius: 0.0,
        near_hits: 0.0,
        interpolation_error: 1.0,
        interpolation_contrast: 0.15,
        own_rays: 0,
        blur_radius: 2,
        direct_samples: 8,
        seed: 3,
        memory_budget: 0,
        texel_begin: 0,
        texel_end: 0,
        stitch: false,
        directional: 1,
        passes: 3,
        target_error: 0.0,
    };

    fn bake(map: &mut Lightmap, params: &BakeParams) -> BakeStats {
        map.bake(params, &Progress::none()).unwrap()
    }

    fn light(map: &Lightmap) -> Vec<Vec3> {
        let light = map.light.as_ref().unwrap();
        light.direct.iter().zip(&light.indirect).map(|(&direct, &indirect)| direct + indirect).collect()
    }

    fn bits(map: &Lightmap) -> Vec<u32> {
        let light = map.light.as_ref().unwrap();
        let directional = light.directional.iter().flat_map(|d| [d.l0, d.l1[0], d.l1[1], d.l1[2]]);
        let all = light.direct.iter().chain(&light.indirect).copied().chain(directional);
        let of_passes = |s: &Spread| [s.error, s.difference[0], s.difference[1]];
        let all = all.chain(light.spread.iter().flat_map(of_passes));
        all.flat_map(|v| v.to_array()).map(f32::to_bits).collect()
    }

    #[test]
    fn the_light_is_the_mean_of_bakes_and_the_error_is_their_spread() {
        let mut map = cornell(2);
        let single = |map: &mut Lightmap, pass| {
            let params = BakeParams { passes: 1, ..params_of(&PARAMS, pass) };
            let stats = bake(map, &params);
            assert_eq!((stats.passes, stats.error), (1, 0.0));
            light(map)
        };
        let bakes: Vec<_> = (0..3).map(|pass| single(&mut map, pass)).collect();
        let not_told = map.read(0, Layer::Error);
        assert!(matches!(not_told, Err(Error::InvalidState(_))), "{not_told:?}");
        let stats = bake(&mut map, &PARAMS);
        assert_eq!((stats.passes, stats.photons_emitted), (3, 60_000));
        let (mean, spread) = (light(&map), &map.light.as_ref().unwrap().spread);
        let mut relative = 0.0;
        let all = mean.iter().map(|m| m.element_sum() as f64).sum::<f64>() / (3 * mean.len()) as f64;
        for (i, &m) in mean.iter().enumerate() {
            let expected = bakes.iter().map(|b| b[i]).sum::<Vec3>() / 3.0;
            assert!((m - expected).abs().cmple(1e-5 * expected + 1e-7).all(), "{m} for {expected}");
            let squares = bakes.iter().map(|b| (b[i] - expected) * (b[i] - expected)).sum::<Vec3>();
            let expected = (squares / 6.0).map(f32::sqrt);
            let Spread { error, difference: [direct, indirect] } = spread[i];
            assert!((error - expected).abs().cmple(1e-3 * expected + 1e-4 * m).all(), "{error} for {expected}");
            // Passes 1 and 3, and pass 2.
            let halves = (bakes[0][i] + bakes[2][i]) / 2.0 - bakes[1][i];
            let wrong = (direct + indirect - halves).abs();
            assert!(wrong.cmple(1e-4 * m + 1e-6).all(), "{direct} + {indirect} for {halves}");
            let (e, m) = (error.as_dvec3(), m.as_dvec3());
            relative += (e * e / (m * m + (0.1 * all).powi(2))).element_sum();
        }
        let relative = (relative / (3 * mean.len()) as f64).sqrt();
        assert!((stats.error - relative).abs() < 1e-4 * relative && relative > 1e-3, "{} for {relative}", stats.error);
        let LayerData::Rgb(page) = map.read(0, Layer::Error).unwrap() else { panic!("not RGB") };
        assert!(page.iter().flatten().any(|&e| e > 0.0));
    }

    #[test]
    fn passes_have_the_same_bits_on_any_threads_and_shards_and_in_results_and_after_a_cancel() {
        let mut whole = cornell(2);
        bake(&mut whole, &PARAMS);
        let mut shards = cornell(1);
        let texels = shards.info().texels;
        for (texel_begin, texel_end) in [(0, texels / 3), (texels / 3, texels)] {
            bake(&mut shards, &BakeParams { texel_begin, texel_end, ..PARAMS });
        }
        assert!(bits(&shards) == bits(&whole));

        let folder = std::env::temp_dir().join(format!("bakelite-passes-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let (result, checkpoint) = (folder.join("result"), CheckpointParams::new(folder.join("checkpoint")));
        whole.save_result(&result, &Progress::none()).unwrap();
        let mut loaded = cornell(1);
        loaded.load_result(&result, &Progress::none()).unwrap();
        assert!(bits(&loaded) == bits(&whole));

        let checkpoint = CheckpointParams { seconds: 0.0, ..checkpoint };
        let mut resumed = cornell(2);
        // The second pass begins at a third of the bar.
        let stop = Progress::new(|fraction, _| fraction < 0.5);
        assert_eq!(resumed.bake_with(&PARAMS, Some(&checkpoint), &stop).err(), Some(Error::Cancelled));
        let other = BakeParams { passes: 4, ..PARAMS };
        let refused = resumed.bake_with(&other, Some(&checkpoint), &Progress::none());
        assert!(matches!(&refused, Err(Error::InvalidArgument(e)) if e.contains("passes")), "{refused:?}");
        let rest = resumed.bake_with(&PARAMS, Some(&checkpoint), &Progress::none()).unwrap();
        assert!(bits(&resumed) == bits(&whole));
        // The first pass was not traced again.
        assert!(rest.photons_emitted <= 40_000, "{}", rest.photons_emitted);
        std::fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn the_estimate_is_right_within_a_factor_of_1_5_and_a_target_is_met() {
        let mut map = cornell(2);
        let params = BakeParams { directional: 0, ..PARAMS };
        bake(&mut map, &BakeParams { passes: 48, seed: 9, ..params });
        let reference = light(&map);
        let all = reference.iter().map(|m| m.element_sum() as f64).sum::<f64>() / (3 * reference.len()) as f64;
        for (passes, target_error) in [(4, 0.0), (1, 0.02)] {
            let stats = bake(&mut map, &BakeParams { passes, target_error, ..params });
            let square = |(a, b): (&Vec3, &Vec3)| {
                let (difference, b) = ((*a - *b).as_dvec3(), b.as_dvec3());
                (difference * difference / (b * b + (0.1 * all).powi(2))).element_sum()
            };
            let squares: f64 = light(&map).iter().zip(&reference).map(square).sum();
            let error = (squares / (3 * reference.len()) as f64).sqrt();
            let ratio = stats.error / error;
            assert!((1.0 / 1.5..=1.5).contains(&ratio), "{} passes: {} for {error}", stats.passes, stats.error);
            if target_error > 0.0 {
                assert!(stats.error <= target_error.into() && stats.passes >= LEAST, "{stats:?}");
            }
        }
        let range = BakeParams { target_error: 0.1, texel_end: 5, ..params };
        assert!(matches!(map.bake(&range, &Progress::none()), Err(Error::InvalidArgument(_))));
    }
}
