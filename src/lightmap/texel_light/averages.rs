//! Direct light of texels of the light map: light without penumbrae at their samples, whether it varies, and averages
//! of points.

use super::{AROUND, FEW, MAX_POINTS, Point, TexelLight, TilePoints, Wanted, add_points, differ, is_hidden, vary};
use crate::base::directional::Directional;
use crate::base::sampling::combine;
use crate::direct::Receiver;
use crate::direct::direct_light::{Lights, PointLight};
use crate::direct::shadow_rays::KINDS;
use crate::lightmap::atlas::ids::{LightMap, LightTexel};
use crate::lightmap::tiles::TILE;
use crate::scene::Scene;
use glam::Vec3;

/// Light of two texels or points differs if the difference is more than this fraction of the greater.
const DIFFERENCE: f32 = 0.15;

/// Factor of the variance of stratified rays to area lights. (With 1 penumbrae of a few texels are blurred: direct light of the
/// Cornell box at 8 texels/m has 1.7 times the error.)
const STRATIFIED: f32 = 0.25;

/// Factor of the variance of skies and many lights, of which few texels may have most light: the blur leaves these out of
/// others' means. (A room with a window loses 2.1 % of its direct light by what is left out; with 1, 2.6 %.)
const SKEWED: f32 = 2.0;

/// A texel whose direct light is to be averaged.
#[derive(Clone, Copy)]
pub(crate) struct Averaged {
    pub texel: LightTexel,
    pub back: bool,
    /// The texel's sample.
    pub receiver: Receiver,
    /// The light of its sample without penumbrae, and that light by direction.
    pub sharp: Vec3,
    pub sharp_directional: Directional,
    pub variation: Variation,
}

/// Whether light without penumbrae varies in a texel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum Variation {
    #[default]
    None,
    /// Not known: the texel is at the border of its chart.
    Unknown,
    Some,
}

impl TexelLight<'_, LightMap> {
    /// Computes light without penumbrae at the sample itself.
    pub(crate) fn sharp(&self, receiver: &Receiver, rays: &mut u64) -> Vec3 {
        if !self.direct.has_sharp() {
            return Vec3::ZERO;
        }
        self.direct.at_point(receiver, Lights::Sharp, 0, 0, rays).sharp
    }

    /// Computes light without penumbrae at samples: at most [`MAX_POINTS`] times as many as `tile` has room for texels.
    pub(crate) fn sharp_of_tile(
        &self,
        receivers: impl Iterator<Item = Receiver>,
        tile: &mut TilePoints,
        rays: &mut u64,
        mut out: impl FnMut(usize, Vec3, Option<&Directional>),
    ) {
        let mut shadow = tile.room.begin(self.areas.scene);
        let mut count = 0;
        for receiver in receivers {
            shadow.slot = KINDS * count;
            self.direct.push(&receiver, 0, Lights::Sharp, 0, 0, &mut shadow);
            count += 1;
        }
        let mut light = PointLight::default();
        let (arrived, directed) = shadow.finish_by_direction(rays);
        for (i, sums) in arrived.chunks_exact(KINDS).take(count).enumerate() {
            light.take(sums);
            out(i, light.sharp, directed.get(KINDS * i));
        }
    }

    /// Whether light without penumbrae varies in a texel, because [lamps](super::near) are close to it or judged by its neighbours: `sharp` is the texel's own light,
    /// and `of` returns a neighbour's.
    pub(crate) fn varies(&self, texel: LightTexel, sharp: Vec3, mut of: impl FnMut(LightTexel) -> Vec3) -> Variation {
        if self.near(texel).distance2 > 0.0 {
            return Variation::Some;
        }
        if !self.direct.has_sharp() {
            return Variation::None;
        }
        let mut variation = Variation::None;
        for ((dx, dy), near) in AROUND.into_iter().zip(self.areas.neighbours(texel)) {
            match near {
                Some(s) if differ(sharp, of(s), DIFFERENCE) => return Variation::Some,
                // Diagonal neighbours are missed at every second edge.
                None if dx == 0 || dy == 0 => variation = Variation::Unknown,
                _ => {}
            }
        }
        variation
    }

    /// Computes the direct light of the texels of a tile, its variance by sampling, summed over the channels, and that
    /// light by direction, which is 0 if nobody asks for it.
    pub(crate) fn irradiance(
        &self,
        texels: &[Averaged],
        tile: &mut TilePoints,
        rays: &mut u64,
        mut out: impl FnMut(usize, Vec3, f32, &Directional),
    ) {
        let soft = self.direct.has_soft();
        let lights_of = |variation| match (variation, soft) {
            (Variation::None, false) => None,
            (Variation::None, true) => Some(Lights::Soft),
            (_, false) => Some(Lights::Sharp),
            (_, true) => Some(Lights::All),
        };
        let few = |variation| if variation == Variation::Some { MAX_POINTS as u32 } else { FEW };
        let wanted = |place: usize, t: &Averaged, numbers| {
            let lights = lights_of(t.variation)?;
            Some(Wanted { place, texel: t.texel, back: t.back, numbers, lights })
        };
        let first = texels.iter().enumerate().filter_map(|(i, t)| wanted(i, t, 0..few(t.variation)));
        tile.clear();
        tile.light(self, first, rays);
        let mut goes_on = [false; TILE];
        for (i, (t, goes_on)) in texels.iter().zip(&mut goes_on).enumerate() {
            let points = tile.of(i);
            *goes_on = few(t.variation) == FEW
                && (has_penumbra(points)
                    || (t.variation == Variation::Unknown && vary(points, PointLight::narrow, DIFFERENCE)));
        }
        let more = texels.iter().enumerate().filter(|(i, _)| goes_on[*i]);
        tile.light(self, more.filter_map(|(i, t)| wanted(i, t, FEW..MAX_POINTS as u32)), rays);
        tile.find_buried(texels.len(), &self.areas, |i| texels[i].receiver, rays);
        for (i, t) in texels.iter().enumerate() {
            let mut directional = t.sharp_directional;
            let (e, variance) = match lights_of(t.variation) {
                Some(_) => self.average(t, tile.of_mut(i), goes_on[i], &mut directional, rays),
                None => (t.sharp, 0.0),
            };
            out(i, e, variance, &directional);
        }
    }

    /// Averages the light of a texel's points, and returns its variance too; `goes_on`: more than the first few have been
    /// lit. If light by direction is asked for, `out` receives it.
    fn average(
        &self,
        t: &Averaged,
        (points, directional): (&mut [Point], &[[Directional; KINDS]]),
        goes_on: bool,
        out: &mut Directional,
        rays: &mut u64,
    ) -> (Vec3, f32) {
        let (scene, sharp) = (self.areas.scene, t.sharp);
        let points = match t.variation {
            Variation::None => points,
            _ => without_other_rooms(points, scene, &t.receiver, sharp, rays),
        };
        let mut sum = PointLight::default();
        let n = add_points(points, &mut sum, |_| Vec3::ONE);
        if n == Vec3::ZERO {
            // All points miss a small part of a chart, or lie inside solids: the sample alone is lit.
            let seed = combine(self.seed, self.areas.map.seed(t.texel));
            if directional.is_empty() {
                let soft = self.direct.at_point(&t.receiver, Lights::Soft, self.samples, seed, rays);
                return (sharp + soft.value(), 0.0);
            }
            let soft = self.direct.at_point_by_direction(&t.receiver, Lights::Soft, self.samples, seed, rays);
            *out = t.sharp_directional + soft.1;
            return (sharp + soft.0.value(), 0.0);
        }
        let is_even = t.variation == Variation::Unknown
            && !goes_on
            && !points.iter().any(|p| differ(p.light.sharp, sharp, DIFFERENCE));
        if is_even {
            // The sample lies in the middle of the chart's part in the texel, whereas the few points lie anywhere in
            // it.
            sum.sharp = sharp * n;
        }
        let near = self.near(t.texel);
        let mut near_directional = Directional::default();
        if near.distance2 > 0.0 {
            let directional = (!directional.is_empty()).then_some(&mut near_directional);
            let light = self.sample_near((t.texel, t.back), &near, &t.receiver, |_| Vec3::ONE, directional, rays);
            sum.sharp += light * n;
        }
        let e = sum.value() / n;
        if !directional.is_empty() {
            *out = average_by_direction(t, points, (directional, near_directional * n.x), (&sum, n.x), is_even);
        }
        (if t.variation == Variation::None { sharp + e } else { e }, variance(points))
    }
}

/// Returns the variance of the mean of points' light by its sampling, summed over the channels: of skies and many lights by
/// its spread, of area lights by what each point sees of them, since the edge of a penumbra between points is no noise.
fn variance(points: &[Point]) -> f32 {
    let n = points.len() as f32;
    let mean = points.iter().map(|p| p.light.sampled()).sum::<f32>() / n;
    let squares: f32 = points.iter().map(|p| (p.light.sampled() - mean).powi(2)).sum();
    let of_areas = points.iter().map(|p| p.light.variance_of_areas());
    let (rays, areas) = of_areas.fold((0, 0.0), |(rays, sum), (r, v)| (rays + r, sum + v));
    // The variance of the mean of n stratified rays to a light with an edge in it falls by n^-3/2 instead of n^-1 (Mitchell,
    // *Consequences of Stratified Sampling in Graphics*, 1996).
    SKEWED * squares / (n * (n - 1.0)).max(1.0) + STRATIFIED * areas / (n * n * (rays as f32).sqrt().max(1.0))
}

/// Averages the light by direction of a texel's points, and adds that of lamps close to it. `sum`: their light, and the number of
/// points that count.
#[inline(never)]
fn average_by_direction(
    t: &Averaged,
    points: &[Point],
    (directional, near): (&[[Directional; KINDS]], Directional),
    (sum, n): (&PointLight, f32),
    is_even: bool,
) -> Directional {
    // Points inside of solids, which do not count, have none.
    let mut kinds = [Directional::default(); KINDS];
    for point in points {
        kinds.iter_mut().zip(directional[point.place as usize]).for_each(|(sum, of_point)| *sum += of_point);
    }
    if is_even {
        kinds[0] = t.sharp_directional * n;
    }
    kinds[0] += near;
    let average = sum.by_direction(&kinds) / n;
    if t.variation == Variation::None { t.sharp_directional + average } else { average }
}

/// Whether some point lies in the penumbra of a disc.
fn has_penumbra(points: &[Point]) -> bool {
    points.iter().any(|p| p.light.is_in_a_penumbra_of_discs()) || vary(points, PointLight::of_discs, DIFFERENCE)
}

/// Returns the points that are seen from the texel's sample, `own`, whose light without penumbrae is `sharp`. Points
/// with the same light are kept without a test, unless light of lamps close to them is sampled apart.
fn without_other_rooms<'p>(
    points: &'p mut [Point],
    scene: &Scene,
    own: &Receiver,
    sharp: Vec3,
    rays: &mut u64,
) -> &'p mut [Point] {
    let mut kept = 0;
    for i in 0..points.len() {
        let point = points[i];
        let is_alike = !point.is_near_lamps && !differ(point.light.sharp, sharp, DIFFERENCE);
        if !is_alike && is_hidden(scene, own, &point.receiver, rays) {
            continue;
        }
        points[kept] = point;
        kept += 1;
    }
    &mut points[..kept]
}
