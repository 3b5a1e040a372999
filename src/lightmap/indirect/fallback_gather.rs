//! Fallback gathers: texels of the light map that trace a few rays themselves, instead of interpolating between gather
//! texels. The result is averaged with those of such texels nearby, as far as they do not differ by more than noise.
//! [Upsampling](super::upsample) chooses them. Buried texels among them trace none: they take the light of the texel in
//! which their samples lie.
//!
//! Measured: docs/experiments.md#fallback-gather.

use super::blur::{Mean, Noisy, Window};
use super::gather::{Gathered, Tile, TileTexel};
use super::interpolation_contrast::{GatherLight, weight_of_own};
use super::near_hits::HitRadiance;
use super::sample_set::SampleSet;
use super::upsample::Upsampling;
use crate::base::directional::{Directional, Linear};
use crate::base::error::Result;
use crate::base::memory::{try_collect, try_filled, try_parts, try_vec, try_with_capacity};
use crate::base::parallel::{ParallelLoop, one_by_one};
use crate::base::progress::Stage;
use crate::base::sampling::combine;
use crate::base::scratch::Scratch;
use crate::lightmap::atlas::Atlas;
use crate::lightmap::atlas::ids::{GatherMap, LightTexel, PerTexel};
use crate::lightmap::tiles::places_in_order;
use glam::Vec3;
use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// Number of fallback gathers that a thread computes at a time, and the number whose blur it does: enough for several
/// squares of texels beside each other in wide charts.
const BLOCK: usize = 4096;
const BLURRED: usize = 256;

/// Radius of the blur of fallback gathers, in texels of the light map.
const RADIUS: i32 = 4;

/// Factor on the estimated variance of a fallback gather when it is compared with others: its few rays are stratified, and
/// vary less than independent ones, as which they are estimated. (The choice of bright patches, which are drawn systematically,
/// has been reduced before.) (With 1 the blur has a bias: a furnished room has 1.05 times the error of a radius of 2, with this
/// factor 0.94 times.)
const STRATIFIED: f32 = 0.35;

/// Ratio of interpolated light up to which fallback gathers are averaged where their differences from it are alike. (Without
/// it the light of a bright room counts as that of a dark one at the other side of a thin wall, where neither differs by more
/// than noise: the error of `partition` is 1.4e-2 instead of 1.2e-3.)
const RATIO: f32 = 2.0;

/// A fallback gather is lone if there are no more than `FEW`, itself counted, within `NEAR` texels, as on the edges of
/// pilasters and ribs. There is little to blur it with, and it has twice the rays. (Sponza by two
/// lamps: noise² 6.5e-3 → 5.5e-3 in the same time; with all rays alike, what is left shows as dots along edges.)
const NEAR: i32 = 2;
const FEW: usize = 12;

/// Distance in texels of the light map up to which fallback gathers change the light of others: those they are blurred
/// with, and those that make these lone or not.
pub(in crate::lightmap) const REACH: u32 = (RADIUS + NEAR) as u32;

/// Indirect irradiance of the fallback gathers of an [`Upsampling`], in its order; `None` inside solids.
pub(crate) type OwnLight = Vec<Option<Vec3>>;

/// Indirect light by direction of the fallback gathers; empty if nobody asks for it.
pub(crate) type OwnDirectional = Vec<Option<Directional>>;

/// Inputs of fallback gathers.
pub(crate) struct OwnRays<'a> {
    pub radiance: HitRadiance<'a>,
    /// Sample sets of texels and of lone ones, of which the first round is used.
    pub samples: [&'a SampleSet; 2],
    pub seed: u32,
    /// Whether light by direction is asked for.
    pub directional: bool,
    /// The gather map, if what some of the texels gather is weighed against it.
    pub gathered: Option<&'a GatherLight<'a>>,
}

impl Upsampling {
    /// Traces the fallback gathers. Returns their light, that by direction, and the number of rays. Advances `stage` by
    /// [`own_work`](Self::own_work).
    pub(crate) fn own_light(
        &self,
        atlas: &Atlas,
        backs: &[bool],
        rays: &OwnRays,
        stage: &Stage,
    ) -> Result<(OwnLight, OwnDirectional, u64)> {
        let (what, n) = ("texels on their own", self.alone.len());
        let traced = AtomicU64::new(0);
        let mut own = try_filled(n, Own::default(), what)?;
        let sources = self.sources_of_buried(atlas)?;
        let bytes = size_of_val(&own[..]) + size_of_val(&sources[..]);
        let _memory = atlas.scene.device().memory().reserve(bytes, what)?;
        let mut light: OwnLight = try_filled(n, None, what)?;
        let n = if rays.directional { n } else { 0 };
        let mut directional: Vec<Directional> = try_vec(n, what)?;
        let mut blurred: OwnDirectional = try_filled(n, None, what)?;
        let mut weights = try_filled(n, 1.0, what)?;
        let tiles = Scratch::new();
        let new_tile = if rays.directional { Tile::by_direction } else { Tile::new };
        atlas.scene.device().install(|| {
            let blocks = own.par_chunks_mut(BLOCK).zip(self.alone.par_chunks(BLOCK));
            one_by_one(blocks.zip(try_parts(&mut directional, BLOCK, self.alone.len())?)).try_each(
                |((own, texels), directional)| {
                    let mut tile = tiles.take(new_tile)?;
                    traced.fetch_add(
                        self.gather_for(atlas, backs, rays, texels, (own, directional), &mut tile, stage)?,
                        Relaxed,
                    );
                    stage.advance(texels.len() as u64)
                },
            )?;
            let of_light = light.par_chunks_mut(BLURRED).zip(try_parts(&mut weights, BLURRED, self.alone.len())?);
            one_by_one(of_light.enumerate()).try_each(|(block, (light, weights))| {
                let mut window = Window::new(RADIUS);
                let value = |k: usize| own[k].light.map_or(Vec3::ZERO, |l| l.value);
                let gathered = rays.gathered.map(|g| g.irradiance);
                for (k, light) in light.iter_mut().enumerate() {
                    let i = block * BLURRED + k;
                    let Some(mean) = self.blurred(atlas, &mut window, &own, value, i) else { continue };
                    let texel = self.alone[i];
                    let weight = own[i].difference.and(gathered).map_or(1.0, |gathered| {
                        weight_of_own(mean.value, self.interpolated(atlas, gathered, texel), mean.variance)
                    });
                    *light = Some(self.weighed(atlas, gathered, texel, mean.value, weight));
                    if let Some(out) = weights.get_mut(k) {
                        *out = weight;
                    }
                }
                stage.advance(light.len() as u64)
            })?;
            one_by_one(blurred.par_chunks_mut(BLURRED).enumerate()).each(|(block, blurred)| {
                let mut window = Window::new(RADIUS);
                for (i, blurred) in (block * BLURRED..).zip(blurred) {
                    let mean = self.blurred(atlas, &mut window, &own, |k| directional[k], i);
                    let gathered = rays.gathered.map(|g| PerTexel::new(g.directional));
                    *blurred = mean.map(|mean| self.weighed(atlas, gathered, self.alone[i], mean.value, weights[i]));
                }
            });
            Ok(())
        })?;
        for &(i, source) in &sources {
            light[i as usize] = light[source as usize];
            if rays.directional {
                blurred[i as usize] = blurred[source as usize];
            }
        }
        Ok((light, blurred, traced.into_inner()))
    }

    /// Returns the fallback gathers of buried texels that take the light of another one, by their places, and the places of
    /// those.
    fn sources_of_buried(&self, atlas: &Atlas) -> Result<Vec<(u32, u32)>> {
        let of = |(i, &texel): (usize, &LightTexel)| Some((i as u32, self.source(atlas, texel)? as u32));
        try_collect(self.alone.iter().enumerate().filter_map(of), "buried texels on their own")
    }

    /// Returns the place of the fallback gather whose light that of a buried texel takes, if there is one.
    fn source(&self, atlas: &Atlas, texel: LightTexel) -> Option<usize> {
        self.is_alone.rank(atlas.source_of_buried(texel)?)
    }

    /// Returns the number of steps of [`own_light`](Self::own_light).
    pub(crate) fn own_work(&self) -> u64 {
        2 * self.alone.len() as u64
    }

    /// Returns the mean `value` of fallback gather `i` and those around it in the same chart that are like it.
    fn blurred<T: Linear>(
        &self,
        atlas: &Atlas,
        window: &mut Window,
        own: &[Own],
        value: impl Fn(usize) -> T,
        i: usize,
    ) -> Option<Mean<T>> {
        let texel = self.alone[i];
        own[i].light?;
        let placement = atlas.map.placement_of(&atlas.charts, texel);
        let of_placement = atlas.map.texels_of(placement);
        // The window of given charts may contain another chart, which other shards bake.
        let place = |s: LightTexel| self.is_alone.rank(s).filter(|_| of_placement.contains(s));
        let interpolated = own[i].interpolated();
        let get = |s| {
            let other = own[place(s)?];
            let Some(of_this) = interpolated else { return other.light };
            let of_other = other.interpolated()?;
            other.difference.filter(|_| of_this <= RATIO * of_other && of_other <= RATIO * of_this)
        };
        Some(window.mean(&atlas.charts, &atlas.map, texel, get, |s| place(s).map_or(T::default(), &value)))
    }

    /// Returns the mean of a fallback gather's light, of a `weight`, and of what its texel interpolates of the `gathered` light,
    /// which may be missing where the weight is 1.
    fn weighed<T: Linear>(
        &self,
        atlas: &Atlas,
        gathered: Option<PerTexel<GatherMap, T>>,
        texel: LightTexel,
        own: T,
        weight: f32,
    ) -> T {
        let Some(gathered) = gathered.filter(|_| weight < 1.0) else { return own };
        let mut mean = self.interpolated(atlas, gathered, texel) * (1.0 - weight);
        mean += own * weight;
        mean
    }

    /// Returns what a texel's fallback gather has found, before the blur.
    fn own(&self, atlas: &Atlas, gathered: Option<&GatherLight>, texel: LightTexel, traced: &TileTexel) -> Own {
        let TileTexel { receiver, gathered: own, .. } = traced;
        if !own.is_visible() {
            return Own::default();
        }
        let light = Noisy { value: own.irradiance(), variance: STRATIFIED * own.variance(), normal: receiver.normal };
        let difference = gathered.filter(|_| self.is_weighed.has(texel)).map(|gathered| {
            // The rays of gather texels tell more of the noise than the texel's own, which may all have missed what is bright.
            // (Of stratified variance, dapples stay: docs/experiments.md#light-that-differs-around-a-texel.)
            let of_gather_texels = self.interpolated(atlas, gathered.unblurred, texel);
            let expected = of_gather_texels * (gathered.rays as f32 / own.rays as f32);
            let value = light.value - self.interpolated(atlas, gathered.irradiance, texel);
            Noisy { value, variance: own.variance().max(expected), ..light }
        });
        Own { light: Some(light), difference }
    }

    /// Traces the fallback gathers of some texels of the light map and returns the number of rays.
    fn gather_for(
        &self,
        atlas: &Atlas,
        backs: &[bool],
        own: &OwnRays,
        texels: &[LightTexel],
        (out, directional): (&mut [Own], &mut [Directional]),
        tile: &mut Tile,
        stage: &Stage,
    ) -> Result<u64> {
        let mut receiver = atlas.receivers(&atlas.map, backs);
        let mut texel = |&place: &u32| TileTexel {
            receiver: receiver(texels[place as usize]),
            seed: combine(own.seed, atlas.map.seed(texels[place as usize])),
            gathered: Gathered::default(),
            directional: own.directional.then(Directional::default),
        };
        let mut rays = 0;
        let mut places = places_in_order(&atlas.map, texels)?;
        let mut lone = try_with_capacity(places.len(), "lone texels")?;
        places.retain(|&place| self.source(atlas, texels[place as usize]).is_none());
        places.retain(|&place| {
            let is_lone = self.is_lone(atlas, texels[place as usize]);
            if is_lone {
                lone.push(place);
            }
            !is_lone
        });
        for (places, samples) in [places, lone].iter().zip(own.samples) {
            for places in places.chunks(Tile::texels(samples)) {
                stage.check()?;
                let mut of_tile = try_collect(places.iter().map(&mut texel), "the texels of a tile")?;
                rays += tile.add_round(&atlas.scene, &own.radiance, &mut of_tile, samples, 0);
                for (&place, texel) in places.iter().zip(&of_tile) {
                    out[place as usize] = self.own(atlas, own.gathered, texels[place as usize], texel);
                    if let Some(out) = directional.get_mut(place as usize) {
                        *out = texel.directional();
                    }
                }
            }
        }
        Ok(rays)
    }

    /// Whether a texel with a fallback gather is [lone](FEW).
    fn is_lone(&self, atlas: &Atlas, texel: LightTexel) -> bool {
        let map = &atlas.map;
        let (x, y) = map.position(texel);
        let placement = map.placement_of(&atlas.charts, texel);
        // As for the blur.
        let of_placement = map.texels_of(placement);
        let square = (-NEAR..=NEAR).flat_map(|dy| (-NEAR..=NEAR).map(move |dx| (x + dx, y + dy)));
        let beside = square.filter_map(|(x, y)| map.at(placement, x, y));
        let gathers = |n: LightTexel| self.is_alone.has(n) && self.source(atlas, n).is_none();
        beside.filter(|&n| of_placement.contains(n) && gathers(n)).take(FEW + 1).count() <= FEW
    }
}

/// Result of a fallback gather before the blur: a texel that has a `difference` is averaged with those around it whose
/// differences and interpolated light are like its own, and any other with those whose `light` is.
#[derive(Clone, Copy, Default)]
struct Own {
    /// `None` inside a solid.
    light: Option<Noisy>,
    /// Difference from interpolated light, which changes less from texel to texel, where the texel's light is
    /// [weighed](Upsampling::is_weighed) against it.
    difference: Option<Noisy>,
}

impl Own {
    /// Returns the sum over the channels of the interpolated light that it differs from.
    fn interpolated(&self) -> Option<f32> {
        Some((self.light?.value - self.difference?.value).element_sum())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::progress::Progress;
    use crate::lightmap::atlas::chart_map::ChartMap;
    use crate::lightmap::atlas::ids::{Map, PerTexel, PlacementId, RadianceTexel, TexelId};
    use crate::lightmap::indirect::radiance_map::{Radiance, RadianceLookup};
    use crate::lightmap::indirect::texel_set::TexelSet;
    use crate::lightmap::indirect::upsample::tests::{find, folded, plank};
    use crate::lightmap::{Lightmap, LightmapDesc};
    use crate::scene::demo::shapes::MeshBuilder;
    use crate::scene::{Light, Material, SceneData};
    use std::ops::Range;

    const OWN_RAYS: u32 = 16;

    /// What texels gather for themselves where each texel of the radiance map sends out its own radiance; and the rays.
    fn own_light(atlas: &Atlas, upsampling: &Upsampling, radiance: impl Fn(RadianceTexel) -> f32) -> (OwnLight, u64) {
        let values = atlas.radiance.all().map(|s| Vec3::splat(radiance(s))).collect();
        let radiance = Radiance { values, ..Default::default() };
        let samples = SampleSet::new(OWN_RAYS, 0).unwrap();
        let rays = OwnRays {
            radiance: HitRadiance::of_map(RadianceLookup::new(&atlas.charts, &atlas.radiance, &radiance)),
            samples: [&samples; 2],
            seed: 0,
            directional: false,
            gathered: None,
        };
        let progress = Progress::none();
        let stage = progress.stage("own light", 0.0, 1.0, upsampling.own_work());
        let (light, _, rays) = upsampling.own_light(atlas, &[], &rays, &stage).unwrap();
        (light, rays)
    }

    /// A face 60 mm high across a sheet: no gather texel is on it.
    #[test]
    fn narrow_faces_gather_for_themselves() {
        let lightmap = folded(&[&[[-2.0, 0.0], [0.013, 0.0], [0.013, 0.06], [2.0, 0.06]]]);
        let atlas = lightmap.atlas();
        fn is_on_face<M: Map>(atlas: &Atlas, map: &ChartMap<M>, texel: TexelId<M>) -> bool {
            map.surface(&atlas.scene, texel).1.x.abs() > 0.5
        }
        let only = PlacementId::new(0);
        assert_eq!(atlas.gather.texels_of(only).filter(|&s| is_on_face(atlas, &atlas.gather, s)).count(), 0);
        let upsampling = find(atlas, 0..1, &[]);
        let (own, rays) = own_light(atlas, &upsampling, |_| 1.0);
        let dark = vec![Vec3::ZERO; atlas.gather.len()];
        let (mut on_face, mut elsewhere) = (0, 0);
        for s in atlas.map.texels_of(only) {
            let shown = upsampling.at(atlas, PerTexel::new(&dark), &own, s).x;
            if is_on_face(atlas, &atlas.map, s) {
                assert!((shown - std::f32::consts::PI).abs() < 1e-5, "{shown} on the face");
                on_face += 1;
            } else {
                elsewhere += u32::from(shown != 0.0);
            }
        }
        assert!(on_face >= 400 && elsewhere <= on_face / 4, "{on_face} and {elsewhere}");
        assert_eq!(rays, u64::from(OWN_RAYS) * own.len() as u64);
    }

    /// A solid block on the floor of a room.
    #[test]
    fn buried_texels_take_the_light_of_those_beside_them_without_rays() {
        let mut data = SceneData::new();
        let m = data.add_material(Material::default()).unwrap();
        let block = [Vec3::new(1.0, -0.1, 1.0), Vec3::new(1.6, 1.0, 1.6)];
        for ([lower, upper], inward) in [([Vec3::ZERO, Vec3::splat(4.0)], true), (block, false)] {
            let mut builder = MeshBuilder::new();
            builder.box_(lower, upper, inward, m);
            data.add_mesh(builder.finish()).unwrap();
        }
        data.add_light(Light::Point { position: Vec3::new(2.0, 2.5, 3.5), intensity: [9.0; 3] }).unwrap();
        let desc = LightmapDesc { texels_per_unit: 20.0, ..Default::default() };
        let lightmap = Lightmap::create(&data.committed(), &desc, &Progress::none()).unwrap();
        let atlas = lightmap.atlas();
        let (placements, progress) = (atlas.map.layout.placements.len(), Progress::none());
        let stage = progress.stage("upsampling", 0.0, 1.0, placements as u64);
        let upsampling = Upsampling::find(atlas, 0..placements, &[], 1.5, None, &stage).unwrap();
        // Each texel of the radiance map has another radiance.
        let (light, rays) = own_light(atlas, &upsampling, |s| s.index() as f32);
        let (mut taken, mut gathered) = (0, 0);
        for (i, &texel) in upsampling.alone.iter().enumerate() {
            let Some(source) = atlas.source_of_buried(texel) else {
                gathered += 1;
                continue;
            };
            let (x, y) = atlas.map.position(source);
            let placement = atlas.map.placement_of(&atlas.charts, texel);
            let sample = &atlas.map[texel];
            let at = atlas.map.layout.texel_coord(placement, atlas.charts.local(sample.triangle, sample.u, sample.v));
            assert!((at[0] - x as f32 - 0.5).abs() <= 0.5 && (at[1] - y as f32 - 0.5).abs() <= 0.5);
            match upsampling.is_alone.rank(source) {
                Some(source) => {
                    assert!(light[i].is_some() && light[i] == light[source]);
                    taken += 1;
                }
                None => gathered += 1,
            }
        }
        assert!(taken > 80 && gathered > 80, "{taken} of {}", upsampling.alone.len());
        assert_eq!(rays, u64::from(OWN_RAYS) * gathered);
    }

    /// Texels chosen by contrast, each of whose light is its own by far more than noise.
    #[test]
    fn light_is_averaged_where_its_differences_from_interpolation_are_alike() {
        let lightmap = plank();
        let atlas = lightmap.atlas();
        let mut upsampling = find(atlas, 0..3, &[]);
        let floor = atlas.map.texels_of(PlacementId::new(0)).collect::<Vec<_>>();
        upsampling.is_alone = TexelSet::new(floor.iter(), atlas.map.len(), "test").unwrap();
        upsampling.alone = floor;
        let n = upsampling.alone.len();
        let noisy = |value: f32| Some(Noisy { value: Vec3::splat(value), variance: 1e-6, normal: Vec3::Z });
        let changed = |light: fn(usize) -> f32, difference: fn(usize) -> Option<f32>| {
            let own = |k: usize| Own { light: noisy(light(k)), difference: difference(k).and_then(noisy) };
            let own: Vec<Own> = (0..n).map(own).collect();
            let mut window = Window::new(RADIUS);
            let differs = |&i: &usize| {
                let mean = upsampling.blurred(atlas, &mut window, &own, light, i).unwrap();
                (mean.value - light(i)).abs() > 1e-3
            };
            (0..n).step_by(97).filter(differs).count()
        };
        let all = (0..n).step_by(97).count();
        let light = |k: usize| 8.0 + (k % 7) as f32;
        assert_eq!(changed(light, |_| None), 0);
        assert_eq!(changed(light, |k| Some((k % 7) as f32)), 0);
        // Means of few texels may meet their middle's light.
        assert!(changed(light, |_| Some(0.5)) > all / 2);
        // Not where what is interpolated is far brighter or darker, as behind a wall.
        assert_eq!(changed(|k| 3.0f32.powi((k % 7) as i32), |_| Some(0.0)), 0);
    }

    /// Faces of two charts beside each other in the page: shards bake one without the other.
    #[test]
    fn what_texels_gather_is_blurred_within_their_chart() {
        let face = [[0.0, 0.0], [0.0, 0.06], [2.0, 0.06]];
        let lightmap = folded(&[&[[-2.0, -0.06], [-0.3, -0.06], [-0.3, 0.0]], &face]);
        let atlas = lightmap.atlas();
        assert_eq!(atlas.map.layout.given, 2);
        let at = |s| (atlas.map.position(s), atlas.map.placement_of(&atlas.charts, s).index());
        let both = find(atlas, 0..2, &[]).alone;
        let beside = |&((x, y), placement): &((i32, i32), usize)| {
            placement == 0 && both.iter().any(|&s| at(s) == ((x + 1, y), 1))
        };
        assert!(both.iter().map(|&s| at(s)).filter(beside).count() > 50);
        // Unequal rays, so that what is blurred shows whom with.
        let own =
            |placements: Range<usize>| own_light(atlas, &find(atlas, placements, &[]), |s| (s.index() % 7) as f32).0;
        assert_eq!(own(0..2), [own(0..1), own(1..2)].concat());
    }

    /// A gather map that is brighter on one side of a line of the floor than on the other, where all rays of the texels that
    /// this chooses miss.
    #[test]
    fn texels_chosen_by_contrast_interpolate_where_noise_explains_what_they_gather() {
        let lightmap = plank();
        let atlas = lightmap.atlas();
        let is_bright = |s| atlas.gather.surface(&atlas.scene, s).0.x > 1.0;
        let light = |s| Vec3::splat(if is_bright(s) { 2.0 } else { 1.0 });
        let irradiance: Vec<Vec3> = atlas.gather.all().map(light).collect();
        let of_texel = |s| Directional::of(light(s), Vec3::Z, 1.0);
        let directional: Vec<Directional> = atlas.gather.all().map(of_texel).collect();
        let radiance = Radiance { values: vec![Vec3::ZERO; atlas.radiance.len()], ..Default::default() };
        let (sure, samples, progress) =
            (vec![0.0; atlas.gather.len()], SampleSet::new(OWN_RAYS, 0).unwrap(), Progress::none());
        let [sure_of, unsure] = [0.0, 1e9].map(|noise| {
            let unblurred = vec![noise; atlas.gather.len()];
            let gathered = GatherLight {
                irradiance: PerTexel::new(&irradiance),
                variances: PerTexel::new(&sure),
                unblurred: PerTexel::new(&unblurred),
                rays: 64,
                directional: &directional,
            };
            let mut upsampling = find(atlas, 0..3, &[]);
            let before = upsampling.alone.clone();
            let stage = progress.stage("contrast", 0.0, 1.0, 3);
            upsampling.add_where_light_differs(atlas, 0..3, &[], &gathered, 0.2, None, &stage).unwrap();
            let rays = OwnRays {
                radiance: HitRadiance::of_map(RadianceLookup::new(&atlas.charts, &atlas.radiance, &radiance)),
                samples: [&samples; 2],
                seed: 0,
                directional: true,
                gathered: Some(&gathered),
            };
            let stage = progress.stage("own light", 0.0, 1.0, upsampling.own_work());
            let (own, own_directional, _) = upsampling.own_light(atlas, &[], &rays, &stage).unwrap();
            let all = upsampling.alone.iter().zip(own.into_iter().zip(own_directional));
            all.map(|(&texel, (light, directional))| {
                let values = PerTexel::new(gathered.directional);
                let between = upsampling.interpolated(atlas, gathered.irradiance, texel);
                let between_directional = upsampling.interpolated(atlas, values, texel);
                let interpolates = (light, directional) == (Some(between), Some(between_directional));
                let is_own = (light, directional) == (Some(Vec3::ZERO), Some(Directional::default()));
                (before.binary_search(&texel).is_err(), interpolates, is_own)
            })
            .collect::<Vec<_>>()
        });
        let chosen = sure_of.iter().zip(&unsure).filter(|(texel, _)| texel.0);
        assert!(chosen.clone().count() > 7 * 320);
        assert!(chosen.clone().all(|(sure_of, unsure)| sure_of.2 && unsure.1 && !unsure.2));
        // Those that geometry has chosen keep what they gather.
        assert!(sure_of.iter().zip(&unsure).filter(|(texel, _)| !texel.0).all(|(a, b)| a == b));
    }
}
