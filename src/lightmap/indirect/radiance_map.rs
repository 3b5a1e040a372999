//! Radiance map (thesis 3.2.4): outgoing radiance of the surfaces, looked up where gather rays hit.
//!
//! Reflected radiance is albedo/π times irradiance: direct light by shadow rays plus, for light that
//! was reflected before, the photon map's estimate. (Direct light by photons too, as in the thesis,
//! blurs its shadows over the search radius and darkens every edge; by shadow rays it costs a
//! percent or two of a bake.) Emission is not part of it: the emitters are sampled as lights
//! wherever light is gathered, and would count twice.
//!
//! Tried: look-ups that interpolate, and a radius per texel; see docs/experiments.md#look-ups-in-the-radiance-map.

use super::bright_patches::Bright;
use super::split_texels::SplitTexels;
use super::texel_albedo::albedo;
use crate::base::error::Result;
use crate::base::memory::{try_to_vec, try_zeroed, try_zeroed_as_needed};
use crate::base::parallel::{ParallelLoop, one_by_one};
use crate::base::progress::Stage;
use crate::base::sampling::combine;
use crate::base::scratch::Scratch;
use crate::base::share::Share;
use crate::device::Device;
use crate::lightmap::atlas::chart_map::ChartMap;
use crate::lightmap::atlas::charts::Charts;
use crate::lightmap::atlas::ids::{ChartId, PerTexel, PlacementId, RadianceMap, RadianceTexel};
use crate::lightmap::atlas::texels::TexelSample;
use crate::lightmap::texel_light::looks::Look;
use crate::lightmap::texel_light::{TexelAreas, TexelLight, TilePoints};
use crate::lightmap::tiles::{TILE, in_order, texels_per_tile};
use crate::photon::coverage::Discs;
use crate::photon::{Guidance, PhotonMap};
use crate::scene::{NONE, Scene};
use crate::simd::prefetch;
use crate::trace::filter::Crossing;
use crate::trace::{RawHit, Ray};
use glam::Vec3;
use rayon::prelude::*;
use std::f32::consts::PI;
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// Number of texels that a thread processes at a time.
const BLOCK: usize = 1024;

/// Reflected radiance per texel, with the charts and the map that a look-up needs.
pub(crate) struct RadianceLookup<'a> {
    charts: &'a Charts,
    map: &'a ChartMap<RadianceMap>,
    values: &'a [Vec3],
    bright: &'a Bright,
    split: &'a SplitTexels,
}

/// Reflected radiance per texel, front sides first; W/(m²·sr).
#[derive(Default)]
pub(crate) struct Radiance {
    pub values: Vec<Vec3>,
    pub bright: Bright,
    /// Texels on both sides of a wall, whose light depends on where they are hit.
    pub(crate) split: SplitTexels,
    /// What photons after a change have in common with those of this map; `None`: unknown, or there were none.
    pub guidance: Option<Arc<Guidance>>,
}

impl<'a> RadianceLookup<'a> {
    pub(crate) fn new(charts: &'a Charts, map: &'a ChartMap<RadianceMap>, radiance: &'a Radiance) -> Self {
        RadianceLookup { charts, map, values: &radiance.values, bright: &radiance.bright, split: &radiance.split }
    }

    /// The same radiance with other bright patches.
    pub(super) fn with(self, bright: &'a Bright) -> Self {
        RadianceLookup { bright, ..self }
    }

    /// Returns the map that is looked up.
    pub(super) fn map(&self) -> &ChartMap<RadianceMap> {
        self.map
    }

    /// Returns the area of a placement's texels in the scene.
    pub(super) fn texel_area(&self, placement: PlacementId) -> f32 {
        let [x, y] = self.map.layout[placement].scale;
        1.0 / (x * y)
    }

    /// Returns the radiance reflected towards a ray at its hit; `None` on the back of a one-sided surface.
    pub(crate) fn reflected(&self, hit: &RawHit) -> Option<Vec3> {
        self.met(hit).map(|(_, radiance)| radiance)
    }

    /// Returns the part of the reflected radiance that a gather ray sees; the rest is sampled by
    /// [`bright`](Self::bright).
    #[inline]
    pub(crate) fn seen(&self, hit: &RawHit) -> Option<Vec3> {
        let (placement, radiance) = self.met(hit)?;
        Some(self.bright.seen(radiance, self.map, placement, hit.t))
    }

    /// Returns the radiance that a gather ray sees of transmissive sheets and of the surface behind them. `crossings` is a
    /// buffer.
    #[cold]
    pub(super) fn through(&self, scene: &Scene, ray: &Ray, crossings: &mut Vec<Crossing>) -> Vec3 {
        let behind = scene.intersect_through(ray, crossings);
        let (mut sum, mut part) = (Vec3::ZERO, Vec3::ONE);
        for c in crossings.iter() {
            sum += part * self.seen(&c.hit).unwrap_or_default();
            part *= Vec3::from(scene.material(c.hit.triangle).transmission);
        }
        if behind.is_miss() { sum } else { sum + part * self.seen(&behind).unwrap_or_default() }
    }

    /// Returns the bright patches, whose full radiance gather rays do not see.
    pub(crate) fn bright(&self) -> &Bright {
        self.bright
    }

    /// Returns placement and radiance at a hit.
    #[inline]
    pub(super) fn met(&self, hit: &RawHit) -> Option<(PlacementId, Vec3)> {
        Some(self.at(&self.find(hit)?))
    }

    /// Finds where the map has a hit; `None` on the back of a one-sided surface.
    #[inline]
    fn find(&self, hit: &RawHit) -> Option<Place> {
        self.place(hit, &self.entry(hit)?)
    }

    /// Begins to find where the map has a hit, and asks for what [`place`](Self::place) reads; `None` on the back of a
    /// one-sided surface.
    #[inline]
    pub(super) fn entry(&self, hit: &RawHit) -> Option<Entry> {
        let chart = self.charts.chart_of(hit.triangle);
        if chart == ChartId::NONE {
            return Some(Entry { placement: PlacementId::NONE, number: 0 });
        }
        let placement = self.map.layout.side(chart, hit.front)?;
        let local = self.charts.local(hit.triangle, hit.u, hit.v);
        let number = self.map.texels.entry(placement, self.map.layout.texel_coord(placement, local));
        self.map.texels.prefetch(number);
        Some(Entry { placement, number })
    }

    /// Finds the place of a hit, and asks for its radiance; `None` if its placement has no texel.
    #[inline]
    pub(super) fn place(&self, hit: &RawHit, entry: &Entry) -> Option<Place> {
        let &Entry { placement, number } = entry;
        if placement == PlacementId::NONE {
            return Some(Place { placement, texel: NONE, beside_wall: None });
        }
        let texel = self.map.texels.nearest_of(placement, number);
        if texel != NONE && self.split.has(RadianceTexel::new(texel as usize)) {
            return Some(Place { placement, texel, beside_wall: self.beside_wall(hit, placement, texel) });
        }
        if let Some(value) = self.values.get(texel as usize) {
            prefetch(value);
        }
        (texel != NONE).then_some(Place { placement, texel, beside_wall: None })
    }

    /// Returns the radiance at a hit on a texel that lies on both sides of a wall.
    #[cold]
    #[inline(never)]
    fn beside_wall(&self, hit: &RawHit, placement: PlacementId, texel: u32) -> Option<Vec3> {
        let local = self.charts.local(hit.triangle, hit.u, hit.v);
        self.split.radiance(self.map, placement, RadianceTexel::new(texel as usize), local)
    }

    /// Asks for what is read to find a hit.
    #[inline]
    pub(super) fn prefetch_hit(&self, hit: &RawHit) {
        self.charts.prefetch(hit.triangle);
    }

    /// Returns placement and radiance at a place.
    #[inline]
    pub(super) fn at(&self, place: &Place) -> (PlacementId, Vec3) {
        let value = || if place.texel == NONE { Vec3::ZERO } else { self.values[place.texel as usize] };
        (place.placement, place.beside_wall.unwrap_or_else(value))
    }
}

/// A place in the radiance map; no texel where a surface has no chart.
#[derive(Clone, Copy)]
pub(super) struct Place {
    placement: PlacementId,
    texel: u32,
    /// Radiance there, if the texel lies on both sides of a wall.
    beside_wall: Option<Vec3>,
}

/// An entry of the map's index; no placement where a surface has no chart.
#[derive(Clone, Copy)]
pub(super) struct Entry {
    placement: PlacementId,
    number: usize,
}

/// Inputs of the stage.
pub(crate) struct RadianceInput<'a> {
    pub light: TexelLight<'a, RadianceMap>,
    /// Photons that have been reflected at least once; `None`: their light is left out.
    pub photons: Option<&'a PhotonMap>,
    /// Whether a first impression is enough: few points of each texel, and photons without a look at what hides them.
    pub quick: bool,
    /// The texels to compute, if not all; the others keep their values. Not for a first impression.
    pub anew: Option<&'a Anew<'a>>,
}

/// Which texels of the map are computed, if not all.
pub(crate) struct Anew<'a> {
    /// By texel.
    texels: &'a [bool],
    /// Those whose first look is needed: the texels and their neighbours.
    looked_at: Vec<bool>,
}

impl<'a> Anew<'a> {
    pub(crate) fn new(areas: &TexelAreas<RadianceMap>, texels: &'a [bool]) -> Result<Anew<'a>> {
        let mut looked_at = try_to_vec(texels, "texels of the radiance map")?;
        for i in (0..texels.len()).filter(|&i| texels[i]) {
            areas
                .neighbours(RadianceTexel::new(i))
                .into_iter()
                .flatten()
                .for_each(|near| looked_at[near.index()] = true);
        }
        Ok(Anew { texels, looked_at })
    }
}

/// Texels whose work of [`bake`] is done for a range of them: those of the first look, with the neighbours, and the range.
pub(crate) fn work(map: &ChartMap<RadianceMap>, range: &Range<usize>) -> u64 {
    (looked_at(map, range).len() + range.len()) as u64
}

/// The texels that get a first look for a range of texels, in whole blocks.
fn looked_at(map: &ChartMap<RadianceMap>, range: &Range<usize>) -> Range<usize> {
    // The neighbours of a texel are those of its row and the two beside it.
    let Range { start, end } = map.with_rows_around(range, 1);
    start / BLOCK * BLOCK..end.next_multiple_of(BLOCK).min(map.len())
}

/// The range of a share of the texels of a map: whole blocks.
pub(crate) fn share(map: &ChartMap<RadianceMap>, share: Share) -> Range<usize> {
    let Range { start, end } = share.of(map.len().div_ceil(BLOCK));
    start * BLOCK..(end * BLOCK).min(map.len())
}

/// Computes `values` of a range of texels of the map, which begins with a block; returns the number of rays. Advances
/// `stage` by [`work`].
///
/// Direct light is averaged over texels: first by a few points each, then by more if it varies between those points or
/// those of neighbouring texels.
pub(crate) fn bake(
    device: &Device,
    input: &RadianceInput,
    range: Range<usize>,
    values: &mut [Vec3],
    stage: &Stage,
) -> Result<u64> {
    let rays = AtomicU64::new(0);
    if input.quick {
        device.install(|| bake_quickly(input, values, &rays, stage))?;
        return Ok(rays.into_inner());
    }
    let map = input.light.areas.map;
    let per_tile = texels_per_tile(input.light.samples);
    let (tiles, rooms) = (Scratch::new(), Scratch::new());
    let (what, needed) = ("direct light of the radiance map", looked_at(map, &range));
    // Of memory for all texels, what no texel of a share needs is never touched.
    let zeroed = if needed.len() == map.len() { try_zeroed } else { try_zeroed_as_needed };
    let mut looks: Vec<Look> = zeroed(map.len(), what)?;
    let _memory = device.memory().reserve(needed.len() * size_of::<Look>(), what)?;
    device.install(|| {
        one_by_one(looks[needed.clone()].par_chunks_mut(BLOCK).enumerate()).try_each(|(block, out)| {
            let (mut traced, first) = (0, needed.start + block * BLOCK);
            let mut tile = tiles.take(|| TilePoints::new(TILE))?;
            let mut order = in_order(map, first..first + out.len())?;
            order.retain(|texel| input.anew.is_none_or(|anew| anew.looked_at[texel.index()]));
            for texels in order.chunks(per_tile) {
                stage.check()?;
                let place = |i: usize| texels[i].index() - first;
                input.light.first_look(texels, &mut tile, &mut traced, |i, look| out[place(i)] = look);
            }
            rays.fetch_add(traced, Relaxed);
            stage.advance(out.len() as u64)
        })?;
        one_by_one(values.par_chunks_mut(BLOCK).enumerate()).try_each(|(block, out)| {
            let (mut traced, first) = (0, range.start + block * BLOCK);
            let make = || Ok(RadianceTile { points: TilePoints::new(TILE)?, discs: Discs::new(TILE)? });
            let mut room = rooms.take(make)?;
            let mut order = in_order(map, first..first + out.len())?;
            order.retain(|texel| input.anew.is_none_or(|anew| anew.texels[texel.index()]));
            for texels in order.chunks(per_tile) {
                stage.check()?;
                let place = |i: usize| texels[i].index() - first;
                room.radiance(input, PerTexel::new(&looks), texels, &mut traced, |i, value| out[place(i)] = value);
            }
            rays.fetch_add(traced, Relaxed);
            stage.advance(out.len() as u64)
        })
    })?;
    Ok(rays.into_inner())
}

/// Computes a first impression of `values`.
fn bake_quickly(input: &RadianceInput, values: &mut [Vec3], rays: &AtomicU64, stage: &Stage) -> Result<()> {
    let (light, areas) = (&input.light, &input.light.areas);
    let (per_tile, tiles) = (texels_per_tile(light.samples), Scratch::new());
    one_by_one(values.par_chunks_mut(BLOCK).enumerate()).try_each(|(block, out)| {
        let (mut traced, first) = (0, block * BLOCK);
        let mut tile = tiles.take(|| TilePoints::new(TILE))?;
        for texels in in_order(areas.map, first..first + out.len())?.chunks(per_tile) {
            stage.check()?;
            light.quick_look(texels, &mut tile, &mut traced, |i, irradiance| {
                let texel = texels[i];
                let albedo = albedo(areas, texel);
                let reflected = input.photons.filter(|_| albedo != Vec3::ZERO).map_or(Vec3::ZERO, |photons| {
                    let (point, receiver) = areas.map.receiver(areas.scene, texel, areas.map.is_back(texel));
                    Vec3::from(photons.estimate(point.position, receiver.geometric))
                });
                out[texel.index() - first] = albedo * (irradiance + reflected) / PI;
            });
        }
        rays.fetch_add(traced, Relaxed);
        stage.advance(2 * out.len() as u64)
    })
}

/// Working memory for a tile of the radiance map.
struct RadianceTile {
    points: TilePoints,
    discs: Discs,
}

impl RadianceTile {
    /// Computes the radiance of the texels of a tile.
    fn radiance(
        &mut self,
        input: &RadianceInput,
        looks: PerTexel<RadianceMap, Look>,
        texels: &[RadianceTexel],
        rays: &mut u64,
        mut out: impl FnMut(usize, Vec3),
    ) {
        let (light, areas) = (&input.light, &input.light.areas);
        let (mut albedos, mut sums) = ([Vec3::ZERO; TILE], [Vec3::ZERO; TILE]);
        // The places in the tile of texels that reflect light, and of those that need more points.
        let (mut reflecting, mut reflecting_count) = ([0; TILE], 0);
        let (mut looked_at, mut looked_at_count) = ([0; TILE], 0);
        for (i, &texel) in texels.iter().enumerate() {
            albedos[i] = albedo(areas, texel);
            if albedos[i] != Vec3::ZERO {
                sums[i] = looks[texel].irradiance;
                reflecting[reflecting_count] = i;
                reflecting_count += 1;
                if light.needs_closer_look(texel, looks) {
                    looked_at[looked_at_count] = i;
                    looked_at_count += 1;
                }
            }
        }
        let (reflecting, looked_at) = (&reflecting[..reflecting_count], &looked_at[..looked_at_count]);
        let mut closer = [RadianceTexel::default(); TILE];
        let closer = &mut closer[..looked_at.len()];
        closer.iter_mut().zip(looked_at).for_each(|(texel, &i)| *texel = texels[i]);
        let at = |t: &TexelSample| areas.scene.albedo(t.triangle, t.u, t.v);
        light.closer_look(closer, &mut self.points, at, rays, |k, e| {
            if let Some(e) = e {
                sums[looked_at[k]] = e;
            }
        });
        if let Some(photons) = input.photons {
            let disc = |&i: &usize| {
                let texel = texels[i];
                let (point, receiver) = areas.map.receiver(areas.scene, texel, areas.map.is_back(texel));
                (point.position, receiver.geometric, combine(light.seed, areas.map.seed(texel)))
            };
            self.discs.irradiance(photons, reflecting.iter().map(disc), rays, |k, e| sums[reflecting[k]] += e);
        }
        for i in 0..texels.len() {
            out(i, albedos[i] * sums[i] / PI);
        }
    }
}
