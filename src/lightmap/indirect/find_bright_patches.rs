//! Chooses the texels of a radiance map that become [bright patches](super::bright_patches), and tests whether they
//! reduce noise enough.

use super::bright_patches::{Bright, near2};
use super::gather::{Gathered, Round};
use super::near_hits::HitRadiance;
use super::radiance_map::{Radiance, RadianceLookup};
use super::sample_set::{ROUND, SampleSet};
use crate::base::error::Result;
use crate::base::memory::{try_append, try_collect, try_par_collect, try_par_collect_ok, try_par_gather, try_push};
use crate::base::progress::Progress;
use crate::base::sampling::{combine, cosine_around, sobol_2d, uniform};
use crate::direct::many_lights::{ManyLights, Patch};
use crate::lightmap::atlas::Atlas;
use crate::lightmap::atlas::ids::{ChartId, PlacementId, RadianceTexel};
use crate::trace::Ray;
use crate::trace::offset::{SurfacePoint, offset_ray_origin};
use glam::{Mat2, Vec2, Vec3};
use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// Limit of the radiance that gather rays see, as a multiple of its mean.
const LIMIT: f32 = 4.0;

/// Bright patches are not tried unless the limit reduces the mean square of the radiance that gather rays see below
/// this fraction.
const GAIN: f32 = 0.8;

/// Bright patches are dropped unless they reduce the variance of gathered light below this fraction. (Rounds take up to
/// two and a half times as long with them, but gather rays are only a part of a bake.)
const PAYS: f32 = 0.65;

/// Number of lit texels of the radiance map from which rays estimate the radiance that gather rays see, and of rays
/// from each.
const VIEWS: usize = 2048;
const RAYS: u32 = 16;

/// Number of lit texels from which rounds of gather rays estimate the variance of gathered light, and of rounds from
/// each.
const TRIALS: usize = 4096;
const ROUNDS: u32 = 2;

/// Light weaker than this fraction of the mean is judged by its absolute error rather than the relative one.
const LEAST: f32 = 0.1;

/// Number of shadow rays per round of gather rays, to be multiplied by the patches' fraction of the light; at least one
/// is traced.
pub(crate) const MAX_SHADOW_RAYS: u32 = 32;

/// Maximum number of texels that become lights. Of more, about this many are chosen at random and weighted up.
const MAX_PATCHES: usize = 1 << 16;

/// Approximate number of grid points on all patches together, which give the position and the area of each, and the
/// minimum and maximum number along an axis of a texel. (Sponza by two lamps, light reflected once: with 2 along each
/// axis gathered light is 0.977 of the reference's, with these 0.981: at edges of triangles a few points are too few to
/// estimate a texel's area, and few texels make most of the light.)
const PLACES: usize = 1 << 18;
const PLACES_ALONG_AXIS: [u32; 2] = [2, 16];

/// The same minimum in charts with texels of which only one side of a wall is bright: their points lie alike, and a strip that
/// a wall leaves of each would have none, or too many.
const LEAST_AT_WALLS: u32 = 8;

/// Number of triangles that a thread searches for bright texels at a time.
const TRIANGLES: u32 = 64;

/// Makes lights of the bright patches of an atlas's radiance map, which has none yet, if they reduce noise enough. To
/// be called on the device's threads. Adds the rays traced to `rays`.
pub(crate) fn find(atlas: &Atlas, radiance: &mut Radiance, rays: &mut u64, progress: &Progress) -> Result<()> {
    let seen = seen_by_gather_rays(atlas, radiance, rays, progress)?;
    let mean = seen.iter().sum::<f32>() / seen.len().max(1) as f32;
    let limit = LIMIT * mean;
    let square = |l: f32| seen.iter().map(|s| s.min(l).powi(2)).sum::<f32>();
    let (square, limited) = (square(f32::INFINITY), square(limit));
    let may_pay = limited < GAIN * square && limit > 0.0 && square.is_finite();
    if !may_pay {
        return Ok(());
    }
    let beyond: f32 = seen.iter().map(|s| (s - limit).max(0.0)).sum();
    let share = beyond / (mean * seen.len() as f32);
    let patches = patches(atlas, radiance, limit, MAX_PATCHES, rays, progress)?;
    if patches.is_empty() {
        return Ok(());
    }
    let patches = ManyLights::of_patches(atlas.scene.device().isa(), patches)?;
    progress.check()?;
    let memory = atlas.scene.device().memory().reserve(patches.bytes(), "bright patches")?;
    let shadow_rays = ((MAX_SHADOW_RAYS as f32 * share).ceil() as u32).clamp(1, MAX_SHADOW_RAYS);
    let bright = Bright { limit, patches: Some(patches), shadow_rays, _memory: Some(memory) };
    let [without, with] = trials(atlas, radiance, [&Bright::default(), &bright], rays, progress)?;
    if pays(&with, &without) {
        radiance.bright = bright;
    }
    Ok(())
}

/// Makes the patches again that an earlier [`find`] kept, from the same radiance map.
pub(crate) fn again(atlas: &Atlas, radiance: &Radiance, limit: f32, shadow_rays: u32) -> Result<Bright> {
    if !(limit > 0.0) {
        return Ok(Bright::default());
    }
    let patches = patches(atlas, radiance, limit, MAX_PATCHES, &mut 0, &Progress::none())?;
    let patches = ManyLights::of_patches(atlas.scene.device().isa(), patches)?;
    let memory = atlas.scene.device().memory().reserve(patches.bytes(), "bright patches")?;
    Ok(Bright { limit, patches: Some(patches), shadow_rays, _memory: Some(memory) })
}

/// Name of the buffers in error messages.
const TEXELS: &str = "lit texels that are looked from";

/// Returns about `count` of the lit texels of a radiance map, at regular intervals.
fn lit_texels(values: &[Vec3], count: usize) -> Result<Vec<RadianceTexel>> {
    let lit = || RadianceTexel::range(0..values.len()).filter(|s| values[s.index()] != Vec3::ZERO);
    let step = (lit().count() / count).max(1);
    try_collect(lit().skip(step / 2).step_by(step), TEXELS)
}

/// Mean and variance of the light that trials gather from a texel, summed over the channels.
type Trial = (f32, f32);

/// Traces rounds of gather rays from texels all over the lit surfaces and returns their light with each of the given sets
/// of bright patches.
fn trials(
    atlas: &Atlas,
    radiance: &Radiance,
    bright: [&Bright; 2],
    rays: &mut u64,
    progress: &Progress,
) -> Result<[Vec<Trial>; 2]> {
    let lookup =
        |bright| HitRadiance::of_map(RadianceLookup::new(&atlas.charts, &atlas.radiance, radiance).with(bright));
    let lookups = bright.map(lookup);
    let samples = SampleSet::new(ROUND as u32, 0)?;
    let at = |&texel: &RadianceTexel| {
        progress.check()?;
        let (_, receiver) = atlas.radiance.receiver(&atlas.scene, texel, atlas.radiance.is_back(texel));
        let (mut light, mut traced) = ([[0.0; ROUNDS as usize]; 2], 0);
        let seed = atlas.radiance.seed(texel);
        for i in 0..ROUNDS {
            // The rays do not depend on the patches.
            let round = Round::trace(&atlas.scene, &receiver, &samples, 0, combine(seed, i));
            traced += round.count as u64;
            for (light, lookup) in light.iter_mut().zip(&lookups) {
                let mut gathered = Gathered::default();
                traced += gathered.add_traced(&atlas.scene, lookup, &receiver, &round);
                light[i as usize] = gathered.irradiance().element_sum();
            }
        }
        let trial = |light: [f32; ROUNDS as usize]| {
            let mean = light.iter().sum::<f32>() / ROUNDS as f32;
            let squares: f32 = light.iter().map(|e| (e - mean).powi(2)).sum();
            (mean, squares / (ROUNDS - 1) as f32)
        };
        Ok((light.map(trial), traced))
    };
    let lit = lit_texels(&radiance.values, TRIALS)?;
    let found: Vec<([Trial; 2], u64)> = try_par_collect_ok(lit.par_iter().map(at), TEXELS)?;
    *rays += found.iter().map(|f| f.1).sum::<u64>();
    let of = |set: usize| try_collect(found.iter().map(|(trials, _)| trials[set]), TEXELS);
    Ok([of(0)?, of(1)?])
}

/// Whether the relative variance of the trials is sufficiently less with patches than without.
fn pays(with: &[(f32, f32)], without: &[(f32, f32)]) -> bool {
    let light: Vec<f32> = with.iter().zip(without).map(|(a, b)| 0.5 * (a.0 + b.0)).collect();
    let least = LEAST * light.iter().sum::<f32>() / light.len().max(1) as f32;
    let relative = |of: &[(f32, f32)]| -> f32 {
        of.iter().zip(&light).map(|((_, variance), light)| variance / (light * light + least * least)).sum()
    };
    relative(with) < PAYS * relative(without)
}

/// Returns the radiance that gather rays see from texels all over the lit surfaces, summed over the channels, if it is
/// not zero.
fn seen_by_gather_rays(atlas: &Atlas, radiance: &Radiance, rays: &mut u64, progress: &Progress) -> Result<Vec<f32>> {
    let (scene, map, values) = (&atlas.scene, &atlas.radiance, &radiance.values);
    let lookup = RadianceLookup::new(&atlas.charts, map, radiance);
    let lit = lit_texels(values, VIEWS)?;
    *rays += lit.len() as u64 * u64::from(RAYS);
    let from = |&texel: &RadianceTexel| {
        progress.check()?;
        let (_, receiver) = map.receiver(scene, texel, map.is_back(texel));
        let (lookup, seed) = (&lookup, map.seed(texel));
        let along = move |i: u32| {
            let d = cosine_around(receiver.geometric, sobol_2d(i, seed));
            let hit = scene.intersect_raw(&Ray::new(receiver.origin, d));
            if hit.is_miss() {
                return None;
            }
            lookup.reflected(&hit).map(|l| l.element_sum()).filter(|&s| s > 0.0)
        };
        try_collect((0..RAYS).filter_map(along), TEXELS)
    };
    let seen: Vec<Vec<f32>> = try_par_collect_ok(lit.par_iter().map(from), TEXELS)?;
    let mut all = Vec::new();
    for one in &seen {
        try_append(&mut all, one, TEXELS)?;
    }
    Ok(all)
}

/// A grid point on a bright texel, on the side that the texel shows.
struct Place {
    texel: RadianceTexel,
    /// Radiance there.
    radiance: Vec3,
    /// What it lies on: several instances may show the light of a texel.
    object: u32,
    /// Number among the points of all texels.
    number: u32,
    placement: PlacementId,
    /// Area of the surface around the point.
    area: f32,
    position: Vec3,
    normal: Vec3,
}

/// Makes patches of the bright texels or, if there are more, of about `most` of them.
fn patches(
    atlas: &Atlas,
    radiance: &Radiance,
    limit: f32,
    most: usize,
    rays: &mut u64,
    progress: &Progress,
) -> Result<Vec<Patch>> {
    let (scene, map, charts) = (&atlas.scene, &atlas.radiance, &atlas.charts);
    let Radiance { values, split, .. } = radiance;
    let is_bright = |texel: &RadianceTexel| {
        let [a, b] = split.both(*texel).unwrap_or([values[texel.index()]; 2]);
        a.element_sum().max(b.element_sum()) > limit
    };
    let of_placement = |p: usize| {
        let placement = PlacementId::new(p);
        let count = map.texels_of(placement).filter(is_bright).count();
        count * charts.times_shown(map.layout.chart_of(placement)) as usize
    };
    let count: usize = (0..map.layout.placements.len()).into_par_iter().map(of_placement).sum();
    let chance = (most as f32 / count.max(1) as f32).min(1.0);
    let is_light = |texel: RadianceTexel| is_bright(&texel) && uniform(map.seed(texel), 0, 0) < chance;
    let [fewest, most_along_axis] = PLACES_ALONG_AXIS;
    let along_axis = ((PLACES / count.clamp(1, most.max(1))).isqrt() as u32).clamp(fewest, most_along_axis);
    let traced = AtomicU64::new(0);
    let mut places = places(atlas, radiance, limit, along_axis, is_light, &traced, progress)?;
    *rays += traced.into_inner();
    places.sort_unstable_by_key(|p| (p.texel, p.object, p.number));
    let patch = |of_texel: &[Place]| {
        let area: f32 = of_texel.iter().map(|p| p.area).sum();
        let first = &of_texel[0];
        let shown = first.object.wrapping_sub(scene.locate(map[first.texel].triangle).0);
        let mut at = area * uniform(map.seed(first.texel), 1, shown);
        let chosen = of_texel.iter().find(|p| {
            at -= p.area;
            at < 0.0
        });
        let Place { radiance, placement, position, normal, .. } = *chosen.unwrap_or(&of_texel[0]);
        let flux = radiance * ((1.0 - limit / radiance.element_sum()) * area / chance);
        Patch { position, normal, flux, near2: near2(map, placement) }
    };
    try_collect(places.chunk_by(|a, b| (a.texel, a.object) == (b.texel, b.object)).map(patch), "bright patches")
}

/// Returns points on bright texels from a grid that divides texels evenly, shifted at random for each triangle. The
/// area of texels that lie in one triangle is exact, that of others right on average.
fn places(
    atlas: &Atlas,
    radiance: &Radiance,
    limit: f32,
    along_axis: u32,
    is_light: impl Fn(RadianceTexel) -> bool + Sync,
    rays: &AtomicU64,
    progress: &Progress,
) -> Result<Vec<Place>> {
    let (scene, charts, map) = (&atlas.scene, &atlas.charts, &atlas.radiance);
    let Radiance { values, split, .. } = radiance;
    let placements = (0..map.layout.placements.len()).into_par_iter();
    // Number of points along an axis of a texel; 0: there is no light.
    let along = |p: usize| {
        let mut texels = map.texels_of(PlacementId::new(p));
        match texels.clone().any(&is_light) {
            false => 0,
            true if texels.any(|texel| split.has(texel)) => along_axis.max(LEAST_AT_WALLS),
            true => along_axis,
        }
    };
    let along = try_par_collect(placements.map(along), "bright patches")?;
    let on_side = |t: u32, front: bool| -> Vec<Place> {
        let placement = map.layout.side(charts.chart_of(t), front).filter(|&p| along[p.index()] > 0);
        let Some(placement) = placement else { return Vec::new() };
        let ([a, b, c], object) = (scene.corners(t), scene.locate(t).0);
        let area = 0.5 * (b - a).cross(c - a).length();
        let texel = |u, v| Vec2::from(map.layout.texel_coord(placement, charts.local(t, u, v)));
        let (origin, scale) = (texel(0.0, 0.0), 1.0 / along[placement.index()] as f32);
        let [a2, b2, c2] = [origin, texel(1.0, 0.0), texel(0.0, 1.0)].map(|c| c / scale);
        let weights = Mat2::from_cols(b2 - a2, c2 - a2);
        let cell = area / (0.5 * weights.determinant().abs());
        if !cell.is_finite() {
            return Vec::new();
        }
        let weights = weights.inverse();
        let place = |p: Vec2| {
            let w = weights * (p - a2);
            let (u, v) = (w.x.max(0.0), w.y.max(0.0));
            let local = charts.local(t, u, v);
            let texel = map.nearest(placement, local)?;
            let radiance = split.radiance(map, placement, texel, local).unwrap_or(values[texel.index()]);
            if radiance.element_sum() <= limit || !is_light(texel) {
                return None;
            }
            let point = SurfacePoint::new([a, b, c], u, v, scene);
            let normal = if front { point.normal } else { -point.normal };
            let position = offset_ray_origin(point.interior, normal, scene);
            // Points in cut-outs do not count, nor points that another triangle covers.
            rays.fetch_add(1, Relaxed);
            let is_seen = scene.intersect_raw(&Ray::new(position, -normal)).triangle == t;
            is_seen.then_some(Place { texel, radiance, object, number: 0, placement, area: cell, position, normal })
        };
        let offset = Vec2::new(uniform(t, 2, 0), uniform(t, 3, 0));
        grid_points([a2, b2, c2], offset).filter_map(place).collect()
    };
    let triangles = scene.triangle_count();
    let mut places = try_par_gather(triangles.div_ceil(TRIANGLES) as usize, "bright patches", |part, out| {
        progress.check()?;
        let first = part as u32 * TRIANGLES;
        for t in (first..triangles.min(first + TRIANGLES)).filter(|&t| charts.chart_of(t) != ChartId::NONE) {
            for place in [true, false].into_iter().flat_map(|front| on_side(t, front)) {
                try_push(out, place, "bright patches")?;
            }
        }
        Ok(())
    })?;
    (0..).zip(&mut places).for_each(|(number, place)| place.number = number);
    Ok(places)
}

/// Returns the points at integer distances from `offset`, in [0, 1)², inside a triangle.
fn grid_points(corners: [Vec2; 3], offset: Vec2) -> impl Iterator<Item = Vec2> {
    let corners = corners.map(|c| c - offset);
    let [lowest, highest] =
        [f32::min as fn(f32, f32) -> f32, f32::max].map(|f| corners.map(|c| c.y).into_iter().reduce(f));
    let rows = lowest.unwrap_or(0.0).ceil() as i32..=highest.unwrap_or(0.0).floor() as i32;
    let row = move |y: i32| {
        let (mut left, mut right) = (f32::INFINITY, f32::NEG_INFINITY);
        for (i, p) in corners.iter().enumerate() {
            let q = corners[(i + 1) % 3];
            // If two edges share an end at this height, only one of them includes it.
            if (p.y <= y as f32) != (q.y <= y as f32) {
                let x = p.x + (q.x - p.x) * ((y as f32 - p.y) / (q.y - p.y));
                (left, right) = (left.min(x), right.max(x));
            }
        }
        let columns = left.ceil() as i32..right.ceil() as i32;
        columns.map(move |x| Vec2::new(x as f32, y as f32) + offset)
    };
    rows.flat_map(row)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::sampling::uniform_triangle;
    use crate::lightmap::indirect::gather::Gathered;
    use crate::lightmap::indirect::sample_set::SampleSet;
    use crate::lightmap::indirect::split_texels::{self, tests::closed_box};
    use crate::lightmap::plan::left_out;
    use crate::lightmap::{BakeParams, Light as Baked, Lightmap, LightmapDesc};
    use crate::scene::demo::shapes::MeshBuilder;
    use crate::scene::{Light, Material, SceneData, builtin};
    use crate::trace::RawHit;

    /// A room, two-sided or not, with a lamp so far from its wall at x = −2, and a screen in the middle of it.
    fn room(two_sided: bool, from_wall: f32) -> Lightmap {
        let mut data = SceneData::new();
        let m = data.add_material(Material { albedo: [0.5, 0.6, 0.7], two_sided, ..Default::default() }).unwrap();
        let mut builder = MeshBuilder::new();
        // Two-sided, its fronts are outside.
        builder.box_(Vec3::splat(-2.0), Vec3::splat(2.0), !two_sided, m);
        builder.box_(Vec3::new(-0.1, -1.0, -1.0), Vec3::new(0.1, 1.0, 1.0), false, m);
        data.add_mesh(builder.finish()).unwrap();
        let position = Vec3::new(-2.0 + from_wall, 0.3, 0.2);
        data.add_light(Light::Point { position, intensity: [1.0, 0.8, 0.6] }).unwrap();
        let desc = LightmapDesc { texels_per_unit: 20.0, ..Default::default() };
        let mut lightmap = Lightmap::create(&data.committed(), &desc, &Progress::none()).unwrap();
        let params = BakeParams { photon_count: 50_000, gather_rays: 1, ..Default::default() };
        lightmap.bake(&params, &Progress::none()).unwrap();
        lightmap
    }

    fn baked(lightmap: &Lightmap) -> &Baked {
        lightmap.light.as_ref().unwrap()
    }

    /// Means of irradiance at every hundredth gather texel over `rounds` rounds, and their mean variance for one round.
    fn gathered(lightmap: &Lightmap, radiance: &Radiance, rounds: usize) -> (Vec<Vec3>, f64) {
        let atlas = lightmap.atlas();
        let lookup = HitRadiance::of_map(RadianceLookup::new(&atlas.charts, &atlas.radiance, radiance));
        let samples = SampleSet::new(64 * rounds as u32, 3).unwrap();
        let (mut means, mut variance) = (Vec::new(), 0.0);
        for texel in atlas.gather.all().step_by(100) {
            let receiver = atlas.receiver(&atlas.gather, &baked(lightmap).backs, texel);
            let each = (0..rounds).map(|round| {
                let mut g = Gathered::default();
                let traced = Round::trace(&atlas.scene, &receiver, &samples, round, atlas.gather.seed(texel));
                g.add_traced(&atlas.scene, &lookup, &receiver, &traced);
                g.irradiance()
            });
            let each: Vec<Vec3> = each.collect();
            let mean = each.iter().sum::<Vec3>() / rounds as f32;
            variance += each.iter().map(|e| f64::from((e - mean).length_squared())).sum::<f64>() / rounds as f64;
            means.push(mean);
        }
        let n = means.len() as f64;
        (means, variance / n)
    }

    #[test]
    fn with_bright_patches_as_lights_the_light_is_the_same_and_its_noise_a_fraction() {
        for two_sided in [false, true] {
            let lightmap = room(two_sided, 0.3);
            let with = &baked(&lightmap).radiance;
            let split = split_texels::find(lightmap.atlas(), &with.values, &mut 0, &Progress::none()).unwrap();
            let without = Radiance { values: with.values.clone(), split, ..Default::default() };
            assert!(with.bright.len() > 20, "{}", with.bright.len());
            let (a, noise) = gathered(&lightmap, with, 256);
            let (b, noise_without) = gathered(&lightmap, &without, 256);
            assert!(noise < 0.25 * noise_without, "{noise} {noise_without}");
            let sum = |v: &[Vec3]| v.iter().sum::<Vec3>();
            assert!((sum(&a) / sum(&b) - 1.0).abs().max_element() < 0.002, "{}", sum(&a) / sum(&b));
            let difference: f64 = a.iter().zip(&b).map(|(a, b)| f64::from((a - b).length_squared())).sum();
            // What noise would explain if the rounds were independent: being parts of one sequence, they are better.
            let expected = (noise + noise_without) / 256.0 * a.len() as f64;
            assert!(difference < 0.4 * expected, "{difference} {expected}");
        }
    }

    /// Returns a limit of radiance, and what the surfaces reflect beyond it.
    fn beyond_a_limit(lightmap: &Lightmap) -> (f32, f32) {
        let (atlas, scene, radiance) = (lightmap.atlas(), &lightmap.atlas().scene, &baked(lightmap).radiance);
        let limit = 0.05 * radiance.values.iter().map(|v| v.element_sum()).fold(0.0, f32::max);
        let lookup = RadianceLookup::new(&atlas.charts, &atlas.radiance, radiance);
        let of_triangle = |t: u32| {
            let [a, b, c] = scene.corners(t);
            let beyond = |i: u32| {
                let [u, v] = uniform_triangle(sobol_2d(i, 1));
                let hit = RawHit { t: 0.0, u, v, triangle: t, front: true };
                (lookup.reflected(&hit).unwrap().element_sum() - limit).max(0.0)
            };
            let n = 1 << 15;
            (0..n).map(beyond).sum::<f32>() / n as f32 * 0.5 * (b - a).cross(c - a).length()
        };
        (limit, (0..scene.triangle_count()).map(of_triangle).sum())
    }

    /// Returns what is beyond the limit of each of about `most` patches.
    fn flux_of_patches(lightmap: &Lightmap, limit: f32, most: usize) -> Vec<f32> {
        let (atlas, radiance) = (lightmap.atlas(), &baked(lightmap).radiance);
        let patches = patches(atlas, radiance, limit, most, &mut 0, &Progress::none()).unwrap();
        assert!(patches.iter().all(|p| p.position.abs().max_element() < 4.1));
        patches.iter().map(|p| p.flux.element_sum()).collect()
    }

    #[test]
    fn patches_reflect_what_is_beyond_the_limit_however_few_they_are() {
        let lightmap = room(false, 0.3);
        let (limit, beyond) = beyond_a_limit(&lightmap);
        let all = flux_of_patches(&lightmap, limit, 1 << 16);
        assert!((all.iter().sum::<f32>() / beyond - 1.0).abs() < 0.01, "{all:?} {beyond}");
        // Of about so many, each one of all by chance, the sum is within three standard deviations.
        for most in [50, 100, 200] {
            let chance = most as f32 / all.len() as f32;
            let few = flux_of_patches(&lightmap, limit, most);
            let deviation = all.iter().map(|flux| flux * flux * (1.0 / chance - 1.0)).sum::<f32>().sqrt();
            assert!(few.len() > most / 2 && few.len() < most * 3 / 2, "{} of {}", few.len(), all.len());
            assert!((few.iter().sum::<f32>() - beyond).abs() < 3.0 * deviation, "{few:?} {beyond} {deviation}");
        }
    }

    #[test]
    fn patches_on_both_sides_of_a_wall_are_bright_on_one() {
        let lightmap = closed_box();
        assert!(!baked(&lightmap).radiance.split.is_empty());
        let (limit, beyond) = beyond_a_limit(&lightmap);
        let all = flux_of_patches(&lightmap, limit, 1 << 16);
        // A third of a texel is in the sun, which few grid points tell to within a tenth; whole texels would have thrice that.
        assert!((all.iter().sum::<f32>() / beyond - 1.0).abs() < 0.1, "{all:?} {beyond}");
    }

    #[test]
    fn triangles_divide_a_grids_points_among_them() {
        let corner = |i: u32| Vec2::new(uniform(i, 0, 9), uniform(i, 1, 9)) * 20.0 - 5.0;
        for i in 0..200 {
            let [a, b, c] = [0, 1, 2].map(|k| corner(3 * i + k));
            let offset = Vec2::new(uniform(i, 2, 9), uniform(i, 3, 9));
            // By more than so much, or by less than nothing.
            let inside = |p: Vec2, by: f32| {
                let side = (b - a).perp_dot(c - a).signum();
                [(a, b), (b, c), (c, a)].iter().all(|(a, b)| (b - a).perp_dot(p - a) * side > by)
            };
            let points: Vec<Vec2> = grid_points([a, b, c], offset).collect();
            assert!(points.iter().all(|&p| inside(p, -1e-3)));
            let all = (-10..30).flat_map(|x| (-10..30).map(move |y| Vec2::new(x as f32, y as f32) + offset));
            for p in all.filter(|&p| inside(p, 1e-3)) {
                assert_eq!(points.iter().filter(|q| q.distance(p) < 1e-3).count(), 1, "{a} {b} {c}");
            }
        }
        // Halves of a square: the shared edge's points once.
        let square = |x: f32, y: f32| Vec2::new(x, y);
        let halves =
            [[square(0., 0.), square(8., 0.), square(8., 8.)], [square(0., 0.), square(8., 8.), square(0., 8.)]];
        assert_eq!(halves.map(|t| grid_points(t, Vec2::ZERO).count()).iter().sum::<usize>(), 64);
    }

    #[test]
    fn lights_pay_if_they_take_away_much_of_the_noise_in_proportion_to_the_light() {
        let noise = |dark: f32, light: f32| [vec![(0.5, 0.25 * dark); 50], vec![(2.0, 4.0 * light); 50]].concat();
        assert!(pays(&noise(0.6, 0.6), &noise(1.0, 1.0)) && !pays(&noise(0.7, 0.7), &noise(1.0, 1.0)));
        // What is dark counts as much as what is light.
        assert!(pays(&noise(0.2, 1.0), &noise(1.0, 1.0)) && pays(&noise(1.0, 0.2), &noise(1.0, 1.0)));
        assert!(!pays(&noise(0.0, 0.0), &noise(0.0, 0.0)) && !pays(&[], &[]));
    }

    #[test]
    fn where_much_is_in_the_sun_trials_find_that_they_do_not_pay() {
        let scene = builtin("atrium").unwrap().committed();
        let desc = LightmapDesc { texels_per_unit: 2.0, ..Default::default() };
        let mut lightmap = Lightmap::create(&scene, &desc, &Progress::none()).unwrap();
        let params = BakeParams { photon_count: 100_000, gather_rays: 1, ..Default::default() };
        lightmap.bake(&params, &Progress::none()).unwrap();
        assert_eq!(baked(&lightmap).radiance.bright.len(), 0);
    }

    #[test]
    fn where_gather_rays_find_all_that_is_bright_there_are_none() {
        let lightmap = room(false, 2.1);
        assert_eq!(baked(&lightmap).radiance.bright.len(), 0);
        assert!(lightmap.plan.left_out & left_out::BRIGHT_PATCHES != 0);
        assert!(room(false, 0.3).plan.left_out & left_out::BRIGHT_PATCHES == 0);
    }
}
