//! Blur of the gather map (thesis 3.2.5) that stays inside charts and does not cross walls.

use crate::base::directional::Linear;
use crate::base::error::Result;
use crate::base::functions::exp_of_negative;
use crate::base::memory::try_parts;
use crate::base::parallel::{ParallelLoop, one_by_one};
use crate::base::progress::Stage;
use crate::device::Device;
use crate::lightmap::atlas::chart_map::ChartMap;
use crate::lightmap::atlas::charts::Charts;
use crate::lightmap::atlas::ids::{GatherMap, GatherTexel, Map, TexelId};
use glam::Vec3;
use rayon::prelude::*;

/// Largest blur radius in texels.
pub const MAX_BLUR_RADIUS: u32 = 16;

/// Width of the largest window.
const MAX_WINDOW: usize = 2 * MAX_BLUR_RADIUS as usize + 1;

/// Number of texels that a thread processes at a time.
const BLOCK: usize = 1024;

/// Difference of two texels, in standard deviations of their noise, up to which they are taken for equally lit.
const LIKE: f32 = 2.0;

/// Inputs of a blur, by texel of the gather map.
#[derive(Clone, Copy)]
pub(crate) struct Texels<'a> {
    pub values: &'a [Vec3],
    /// Variance of the values' sums over the channels; infinite if unknown.
    pub variances: &'a [f32],
    pub valid: &'a [bool],
    pub normals: &'a [Vec3],
}

impl Texels<'_> {
    fn get(&self, texel: GatherTexel) -> Option<Noisy> {
        let i = texel.index();
        self.valid[i].then(|| Noisy { value: self.values[i], variance: self.variances[i], normal: self.normals[i] })
    }
}

/// Light of a texel before the blur.
#[derive(Clone, Copy)]
pub(in crate::lightmap) struct Noisy {
    pub value: Vec3,
    /// Variance of the value's sum over the channels; infinite if unknown.
    pub variance: f32,
    pub normal: Vec3,
}

/// Blurs each valid texel over the valid texels within a square of `radius`, by a Gaussian that leaves out texels that
/// differ by more than noise: the weight falls with the difference of two texels by the standard deviation of that
/// difference (the range filter of Tomasi and Manduchi, *Bilateral filtering*, 1998, its width from the samples'
/// variance as in Rousselle, Knaus and Zwicker, *Adaptive rendering with non-local means filtering*, 2012). Shadows of
/// indirect light therefore stay sharp where there is little noise, and the blur's bias vanishes with the noise. A
/// texel takes part only if a path of valid texels of the same chart, within the square, leads to it: light on one side
/// of a wall that stands on the chart does not cross the hidden texels below the wall. What is blurred so is `of`, by
/// texel: the irradiance itself, or light by direction. `variances`, unless it is empty, gets the variance of the blurred
/// values' sums over the channels.
pub(crate) fn blur<T: Linear>(
    device: &Device,
    charts: &Charts,
    map: &ChartMap<GatherMap>,
    (texels, of): (Texels, &[T]),
    radius: u32,
    (out, variances): (&mut [T], &mut [f32]),
    stage: &Stage,
) -> Result<()> {
    let radius = radius.min(MAX_BLUR_RADIUS) as i32;
    let variances = try_parts(variances, BLOCK, out.len())?;
    device.install(|| {
        one_by_one(out.par_chunks_mut(BLOCK).zip(variances).enumerate()).try_each(|(block, (out, variances))| {
            let mut window = Window::new(radius);
            for (i, out) in out.iter_mut().enumerate() {
                stage.check()?;
                let texel = GatherTexel::new(block * BLOCK + i);
                let mean = window.mean(charts, map, texel, |s| texels.get(s), |s| of[s.index()]);
                *out = mean.value;
                if let Some(out) = variances.get_mut(i) {
                    *out = mean.variance;
                }
            }
            stage.advance(out.len() as u64)
        })
    })
}

/// A weighted mean over texels.
pub(in crate::lightmap) struct Mean<T> {
    pub value: T,
    /// Variance of the same mean of the values by which weights are chosen.
    pub variance: f32,
}

/// Scratch space for one texel's neighbourhood.
pub(crate) struct Window {
    radius: i32,
    /// Gaussian weight by squared distance.
    weights: Vec<f32>,
    seen: [u64; MAX_WINDOW],
    queue: Vec<(i32, i32)>,
}

impl Window {
    pub(crate) fn new(radius: i32) -> Window {
        // The radius is two standard deviations.
        let s = 2.0 / (radius as f32 * radius as f32).max(1.0);
        let weights = (0..=2 * radius * radius).map(|d2| (-(d2 as f32) * s).exp()).collect();
        Window { radius, weights, seen: [0; MAX_WINDOW], queue: Vec::new() }
    }

    /// Returns the blurred value of one valid texel; as in [`blur`], of `of`.
    pub(crate) fn blur<T: Linear>(
        &mut self,
        charts: &Charts,
        map: &ChartMap<GatherMap>,
        texel: GatherTexel,
        texels: Texels,
        of: &[T],
    ) -> T {
        self.mean(charts, map, texel, |s| texels.get(s), |s| of[s.index()]).value
    }

    /// Returns the mean of `of` with the weights with which one valid texel is blurred; where the texel has no value, `of`
    /// it alone, without noise. `get`: the values by which weights are chosen, where there are any.
    pub(in crate::lightmap) fn mean<M: Map, T: Linear>(
        &mut self,
        charts: &Charts,
        map: &ChartMap<M>,
        texel: TexelId<M>,
        get: impl Fn(TexelId<M>) -> Option<Noisy>,
        of: impl Fn(TexelId<M>) -> T,
    ) -> Mean<T> {
        let Some(own) = get(texel) else { return Mean { value: of(texel), variance: 0.0 } };
        let brightness = own.value.element_sum();
        let (x, y) = map.position(texel);
        let placement = map.placement_of(charts, texel);
        self.seen = [0; MAX_WINDOW];
        self.queue.clear();
        self.visit(0, 0);
        let (mut sum, mut total, mut variance) = (T::default(), 0.0, 0.0);
        let mut next = 0;
        while next < self.queue.len() {
            let (dx, dy) = self.queue[next];
            next += 1;
            let Some(s) = map.at(placement, x + dx, y + dy) else { continue };
            let Some(other) = get(s) else { continue };
            // Charts may bend, and texels with other normals receive other light.
            let bend = own.normal.dot(other.normal).max(0.0);
            let bend = bend * bend * bend * bend;
            let deviation = (own.variance + other.variance).sqrt() + f32::MIN_POSITIVE;
            let difference = (other.value.element_sum() - brightness) / (LIKE * deviation);
            // The difference is not a number if light overflows.
            let like = if s == texel { 1.0 } else { exp_of_negative(-0.5 * difference * difference) };
            let w = self.weights[(dx * dx + dy * dy) as usize] * bend * like;
            sum += of(s) * w;
            total += w;
            variance += w * w * other.variance;
            for (nx, ny) in [(dx - 1, dy), (dx + 1, dy), (dx, dy - 1), (dx, dy + 1)] {
                if nx.abs() <= self.radius && ny.abs() <= self.radius {
                    self.visit(nx, ny);
                }
            }
        }
        Mean { value: sum / total, variance: variance / (total * total) }
    }

    fn visit(&mut self, dx: i32, dy: i32) {
        let (row, bit) = ((dy + self.radius) as usize, 1u64 << (dx + self.radius));
        if self.seen[row] & bit == 0 {
            self.seen[row] |= bit;
            self.queue.push((dx, dy));
        }
    }
}
