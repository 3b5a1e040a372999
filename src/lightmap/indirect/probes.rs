//! Probes: what single texels of the light map gather in two states of a scene, by the same rays. Where these see the same
//! in both, the difference has no noise (common random numbers), so that few rays tell whether light has changed.

use super::gather::{aim, is_visible, points_of};
use super::radiance_map::{Radiance, RadianceLookup};
use super::sample_set::SampleSet;
use crate::base::error::Result;
use crate::base::memory::{try_filled, try_with_capacity};
use crate::base::sampling::combine;
use crate::lightmap::atlas::Atlas;
use crate::lightmap::atlas::ids::LightTexel;
use crate::lightmap::tiles::TILE;
use crate::trace::{RawHit, Ray};
use glam::Vec3;
use std::f32::consts::PI;

/// A state of a scene, and its light.
pub(in crate::lightmap) struct State<'a> {
    atlas: &'a Atlas,
    backs: &'a [bool],
    lookup: RadianceLookup<'a>,
}

impl<'a> State<'a> {
    pub fn new(atlas: &'a Atlas, backs: &'a [bool], radiance: &'a Radiance) -> Self {
        State { atlas, backs, lookup: RadianceLookup::new(&atlas.charts, &atlas.radiance, radiance) }
    }
}

/// What a texel gathers.
#[derive(Clone, Copy, Debug, Default)]
pub(in crate::lightmap) struct Probe {
    /// Indirect irradiance, W/m².
    pub irradiance: Vec3,
    /// Whether the texel lies in the open, and not inside a solid.
    pub is_visible: bool,
}

/// Maximum number of rays of a probe.
pub(in crate::lightmap) const PROBE_RAYS: u32 = 32;

/// Rays of up to [`TILE`] probes.
pub(in crate::lightmap) struct ProbeRays {
    rays: Vec<Ray>,
    /// Hits in the old and in the new state.
    hits: [Vec<RawHit>; 2],
    /// Rays that are traced in the old state, too, their numbers and hits in the old state.
    through: (Vec<Ray>, Vec<u32>, Vec<RawHit>),
}

impl ProbeRays {
    pub fn new() -> Result<ProbeRays> {
        let (what, n, ray) = ("the rays of probes", TILE * PROBE_RAYS as usize, Ray::new(Vec3::ZERO, Vec3::ZERO));
        let hits = || try_filled(n, RawHit::MISS, what);
        Ok(ProbeRays {
            rays: try_filled(n, ray, what)?,
            hits: [hits()?, hits()?],
            through: (try_with_capacity(n, what)?, try_with_capacity(n, what)?, hits()?),
        })
    }

    /// Gathers, in the old and the new state, what at most [`TILE`] texels see by the first of the `samples`' rays.
    /// `former` gives a ray's hit in the old state if it follows from that in the new one; other rays are traced in both.
    /// Bright patches count like other surfaces, since a ray that hits one has the same noise in both. Returns the number
    /// of rays.
    pub fn gather(
        &mut self,
        [old, new]: [&State; 2],
        texels: &[LightTexel],
        samples: &SampleSet,
        seed: u32,
        former: impl Fn(&Ray, &RawHit) -> Option<RawHit>,
        out: &mut [[Probe; 2]; TILE],
    ) -> u64 {
        let points = points_of(samples, 0);
        let points = &points[..points.len().min(PROBE_RAYS as usize)];
        let count = texels.len() * points.len();
        for (&texel, rays) in texels.iter().zip(self.rays.chunks_mut(points.len())) {
            let receiver = new.atlas.receiver(&new.atlas.map, new.backs, texel);
            aim(&receiver, points, combine(seed, new.atlas.map.seed(texel)), rays);
        }
        let rays = &self.rays[..count];
        let [old_hits, new_hits] = &mut self.hits;
        new.atlas.scene.intersect_stream(rays, new_hits);
        old_hits[..count].copy_from_slice(&new_hits[..count]);
        let (through, numbers, through_hits) = &mut self.through;
        through.clear();
        numbers.clear();
        for (i, (ray, hit)) in (0..).zip(rays.iter().zip(&mut old_hits[..count])) {
            match former(ray, hit) {
                Some(former) => *hit = former,
                None => {
                    through.push(*ray);
                    numbers.push(i);
                }
            }
        }
        old.atlas.scene.intersect_stream(through, through_hits);
        for (&i, hit) in numbers.iter().zip(&*through_hits) {
            old_hits[i as usize] = *hit;
        }
        for (state, (side, hits)) in [old, new].into_iter().zip(self.hits.iter().enumerate()) {
            let of_texels = rays.chunks(points.len()).zip(hits.chunks(points.len()));
            for (out, (rays, hits)) in out.iter_mut().zip(of_texels) {
                out[side] = state.seen(rays, hits);
            }
        }
        (count + through.len()) as u64
    }
}

impl State<'_> {
    /// Sums up what the rays of a texel see.
    fn seen(&self, rays: &[Ray], hits: &[RawHit]) -> Probe {
        let scene = &self.atlas.scene;
        let (transmits, mut crossings) = (scene.uses().transmission, Vec::new());
        let (mut sum, mut backs) = (Vec3::ZERO, 0);
        for (ray, hit) in rays.iter().zip(hits).filter(|(_, hit)| !hit.is_miss()) {
            let seen = match transmits && scene.material(hit.triangle).transmits() {
                true => Some(self.lookup.through(scene, ray, &mut crossings)),
                false => self.lookup.reflected(hit),
            };
            match seen {
                Some(radiance) => sum += radiance,
                None => backs += 1,
            }
        }
        let n = rays.len() as u32;
        Probe { irradiance: sum * (PI / n as f32), is_visible: is_visible(backs, n) }
    }
}
