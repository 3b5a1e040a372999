//! Gather map (thesis 3.2.5): indirect irradiance by final gathering. From each texel cosine-distributed rays are
//! traced; where a ray hits, the outgoing radiance is looked up in the radiance map.
//!
//! Rays come in rounds of 64, so that a texel can be refined at any time: its sum over k rounds has
//! the same bits however they were spread over bakes and live updates. The sample set is made once:
//! the Sobol sequence, in each round sorted along a Morton curve. Each texel shifts it digitally (XOR), which keeps the
//! stratification. The rays of neighbouring texels pass the tree together as a [stream](crate::trace), and so do their
//! shadow rays to bright patches.
//!
//! Tried, and not worth it: more rays where their variance is largest, and rays guided by photons or by what neighbouring
//! texels found; see docs/experiments.md#adaptive-and-guided-gather-rays.

use super::near_hits::HitRadiance;
use super::sample_set::{ROUND, SampleSet};
use crate::base::directional::Directional;
use crate::base::error::Result;
use crate::base::memory::try_filled;
use crate::base::sampling::{combine, concentric_disc, orthonormal_basis, unit_float};
use crate::direct::Receiver;
use crate::direct::many_lights::Unoccluded;
use crate::direct::shadow_rays::{PointRoom, TileRoom};
use crate::lightmap::tiles::TILE;
use crate::scene::Scene;
use crate::trace::{RawHit, Ray};
use glam::Vec3;
use std::f32::consts::PI;

/// Fraction of rays that may hit backs of one-sided surfaces; a texel with more lies inside a solid.
const MAX_BACK_FACES: f32 = 0.5;

/// Maximum number of texels whose rounds are traced together, if these have few rays.
const MOST_TEXELS: usize = 4 * TILE;

/// Sums that a texel has gathered so far.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Gathered {
    /// Sum of the radiance seen by the rays, W/(m²·sr).
    pub sum: Vec3,
    /// Gather rays traced.
    pub rays: u32,
    /// Number of gather rays that hit the back of a one-sided surface.
    pub backs: u32,
    /// Sum of the squares of the rays' radiance, summed over the channels.
    pub squares: f32,
}

impl Gathered {
    /// Returns the indirect irradiance, W/m².
    pub(crate) fn irradiance(&self) -> Vec3 {
        // Paths from near hits on bright patches may subtract more than other rays bring.
        (self.sum * self.weight()).max(Vec3::ZERO)
    }

    /// Returns the weight of a ray's radiance in the irradiance.
    fn weight(&self) -> f32 {
        PI / self.rays as f32
    }

    /// Returns the variance of the [`irradiance`](Self::irradiance)'s sum over the channels, from the spread of the
    /// rays (an overestimate, since the rays are stratified; its users allow for that). Where bright patches bring much of the
    /// light it is too small, as the square of all light is subtracted from that of the rays' light:
    /// docs/experiments.md#bright-patches-as-lights.
    pub(crate) fn variance(&self) -> f32 {
        let n = self.rays as f32;
        let mean = self.sum.element_sum() / n;
        let spread = (self.squares / n - mean * mean).max(0.0);
        PI * PI * spread / (n - 1.0).max(1.0)
    }

    /// Whether the texel can be seen at all.
    pub(crate) fn is_visible(&self) -> bool {
        is_visible(self.backs, self.rays)
    }

    /// Returns the indirect light by direction from its `sum`, weighted as [`sum`](Self::sum) is.
    pub(crate) fn directional(&self, sum: Directional) -> Directional {
        // Paths from near hits on bright patches may subtract more than other rays bring.
        (sum * self.weight()).valid()
    }

    /// Adds what rays have found that have been traced. Returns the number of further rays.
    pub(super) fn add_traced(
        &mut self,
        scene: &Scene,
        radiance: &HitRadiance,
        receiver: &Receiver,
        round: &Round,
    ) -> u64 {
        let &Round { ref rays, ref hits, count, seed } = round;
        let (rays, mut traced) = (&rays[..count], 0);
        let mut bright = (Vec3::ZERO, Unoccluded::default());
        if radiance.lookup.bright().len() > 0 {
            let mut room = PointRoom::new();
            let mut shadow = room.begin(scene);
            bright.1 = radiance.lookup.bright().push(receiver, rays.len(), seed, &mut shadow);
            bright.0 = shadow.finish(&mut traced)[0];
        }
        self.add(scene, radiance, receiver, seed, rays, hits, bright, None, &mut traced);
        traced
    }

    /// Adds the radiance seen by one round of rays from a receiver, and that of bright patches: what has arrived from
    /// them, and what they would send if nothing occluded it. `directional`: a sum of the light by direction, and what of
    /// it has arrived from bright patches.
    fn add(
        &mut self,
        scene: &Scene,
        radiance: &HitRadiance,
        receiver: &Receiver,
        seed: u32,
        rays: &[Ray],
        hits: &[RawHit],
        (arrived, unoccluded): (Vec3, Unoccluded),
        mut directional: Option<(&mut Directional, Directional)>,
        traced: &mut u64,
    ) {
        let (mut sum, mut squares) = (Vec3::ZERO, 0.0);
        let (transmits, mut crossings) = (scene.uses().transmission, Vec::new());
        // Places are found before they are read, for all rays and step by step: what each waits for overlaps. (Gathering in
        // Sponza in the sun: look-ups take a third of the time.)
        let (mut entries, mut places) = ([None; ROUND], [None; ROUND]);
        hits.iter().filter(|hit| !hit.is_miss()).for_each(|hit| radiance.lookup.prefetch_hit(hit));
        for (entry, hit) in entries.iter_mut().zip(hits).filter(|(_, hit)| !hit.is_miss()) {
            *entry = radiance.lookup.entry(hit);
        }
        for ((place, entry), hit) in places.iter_mut().zip(&entries).zip(hits) {
            *place = entry.and_then(|entry| radiance.lookup.place(hit, &entry));
        }
        for (i, ((ray, hit), place)) in (0..).zip(rays.iter().zip(hits).zip(&places)) {
            if hit.is_miss() {
                continue;
            }
            // A ray below the true surface, possible if the shading normal differs from the geometric one, carries
            // no light.
            if Vec3::from(ray.direction).dot(receiver.geometric) <= 0.0 {
                continue;
            }
            let seen = match transmits && scene.material(hit.triangle).transmits() {
                true => Some(radiance.lookup.through(scene, ray, &mut crossings)),
                false => place.map(|place| radiance.towards(scene, hit, &place, combine(seed, 64 + i), traced)),
            };
            match seen {
                Some(l) => {
                    sum += l;
                    squares += l.element_sum() * l.element_sum();
                    if let Some((directional, _)) = &mut directional {
                        let direction = Vec3::from(ray.direction);
                        **directional += Directional::of(l, direction, direction.dot(receiver.normal));
                    }
                }
                None => self.backs += 1,
            }
        }
        if radiance.lookup.bright().len() > 0 {
            let scale = rays.len() as f32 / PI;
            sum += arrived * scale;
            squares += unoccluded.variance(arrived) * scale * scale;
            if let Some((directional, arrived)) = directional {
                *directional += arrived * scale;
            }
        }
        self.sum += sum;
        self.squares += squares;
        self.rays += rays.len() as u32;
    }
}

/// The rays of one round from a receiver, with their hits.
pub(super) struct Round {
    rays: [Ray; ROUND],
    hits: [RawHit; ROUND],
    pub count: usize,
    /// Seed of the round.
    seed: u32,
}

impl Round {
    /// Traces the rays; `seed` is the texel's own.
    pub(super) fn trace(scene: &Scene, receiver: &Receiver, samples: &SampleSet, round: usize, seed: u32) -> Round {
        let (mut rays, mut hits) = ([Ray::new(Vec3::ZERO, Vec3::ZERO); ROUND], [RawHit::MISS; ROUND]);
        let points = points_of(samples, round);
        aim(receiver, points, seed, &mut rays);
        scene.intersect_stream(&rays[..points.len()], &mut hits);
        Round { rays, hits, count: points.len(), seed: seed_of_round(seed, round) }
    }
}

/// A texel of a tile.
pub(crate) struct TileTexel {
    pub receiver: Receiver,
    /// The texel's own seed.
    pub seed: u32,
    pub gathered: Gathered,
    /// Sum of the light by direction, weighted as [`Gathered::sum`]; `None`: nobody asks for it. Only a tile that has
    /// room for it adds to it.
    pub directional: Option<Directional>,
}

impl TileTexel {
    /// Returns the indirect light by direction; nothing if nobody asked for it.
    pub(crate) fn directional(&self) -> Directional {
        self.gathered.directional(self.directional.unwrap_or_default())
    }
}

/// Rounds of rays from neighbouring texels, which are traced together as a stream: the light of a texel has the bits
/// that it has when gathered alone.
pub(crate) struct Tile {
    rays: Vec<Ray>,
    hits: Vec<RawHit>,
    shadow: TileRoom,
}

impl Tile {
    /// Allocates room for as many texels as [`texels`](Self::texels) returns.
    pub(crate) fn new() -> Result<Tile> {
        let what = "the gather rays of a tile";
        let ray = Ray::new(Vec3::ZERO, Vec3::ZERO);
        let (rays, hits) = (try_filled(TILE * ROUND, ray, what)?, try_filled(TILE * ROUND, RawHit::MISS, what)?);
        Ok(Tile { rays, hits, shadow: TileRoom::new(MOST_TEXELS, TILE * ROUND)? })
    }

    /// Allocates room for the texels of a tile and their light by direction.
    pub(crate) fn by_direction() -> Result<Tile> {
        let tile = Tile::new()?;
        Ok(Tile { shadow: tile.shadow.by_direction()?, ..tile })
    }

    /// Returns the maximum number of texels of a tile: [`TILE`], or more if their rounds have fewer rays than others, since
    /// long streams are faster.
    pub(crate) fn texels(samples: &SampleSet) -> usize {
        let rays = samples.points().len().clamp(1, ROUND);
        (TILE * ROUND / rays).min(MOST_TEXELS)
    }

    /// Adds one round of rays from each of at most [`texels`](Self::texels) texels. Returns the rays traced.
    pub(crate) fn add_round(
        &mut self,
        scene: &Scene,
        radiance: &HitRadiance,
        texels: &mut [TileTexel],
        samples: &SampleSet,
        round: usize,
    ) -> u64 {
        let points = points_of(samples, round);
        let count = texels.len() * points.len();
        for (texel, rays) in texels.iter().zip(self.rays.chunks_mut(points.len())) {
            aim(&texel.receiver, points, texel.seed, rays);
        }
        scene.intersect_stream(&self.rays[..count], &mut self.hits);
        let mut traced = count as u64;
        let mut unoccluded = [Unoccluded::default(); MOST_TEXELS];
        let mut shadow = self.shadow.begin(scene);
        if radiance.lookup.bright().len() > 0 {
            for (slot, (texel, unoccluded)) in texels.iter().zip(&mut unoccluded).enumerate() {
                shadow.slot = slot;
                let seed = seed_of_round(texel.seed, round);
                *unoccluded = radiance.lookup.bright().push(&texel.receiver, points.len(), seed, &mut shadow);
            }
        }
        let (bright, directed) = shadow.finish_by_direction(&mut traced);
        let rays = self.rays[..count].chunks(points.len()).zip(self.hits.chunks(points.len()));
        for (slot, (texel, (rays, hits))) in texels.iter_mut().zip(rays).enumerate() {
            let directional = texel.directional.as_mut().zip(directed.get(slot).copied());
            let (seed, bright) = (seed_of_round(texel.seed, round), (bright[slot], unoccluded[slot]));
            texel.gathered.add(scene, radiance, &texel.receiver, seed, rays, hits, bright, directional, &mut traced);
        }
        traced
    }
}

/// Whether a texel can be seen at all, given how many of its rays hit the back of a one-sided surface.
pub(super) fn is_visible(backs: u32, rays: u32) -> bool {
    backs as f32 <= MAX_BACK_FACES * rays as f32
}

/// Seed of a round of a texel with a seed of its own.
fn seed_of_round(seed: u32, round: usize) -> u32 {
    combine(seed, 16 + round as u32)
}

/// The sample points of a round.
pub(super) fn points_of(samples: &SampleSet, round: usize) -> &[[u32; 2]] {
    &samples.points()[round * ROUND..samples.points().len().min((round + 1) * ROUND)]
}

/// Aims a ray from a receiver at each point of a round; `seed` is the texel's own.
pub(super) fn aim(receiver: &Receiver, points: &[[u32; 2]], seed: u32, rays: &mut [Ray]) {
    let shift = [combine(seed, 1), combine(seed, 2)];
    let (tangent, bitangent) = orthonormal_basis(receiver.normal);
    for (ray, p) in rays.iter_mut().zip(points) {
        let [x, y] = concentric_disc([unit_float(p[0] ^ shift[0]), unit_float(p[1] ^ shift[1])]);
        let z = (1.0 - x * x - y * y).max(0.0).sqrt();
        *ray = Ray::new(receiver.origin, x * tangent + y * bitangent + z * receiver.normal);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trace::PACKET_SIZE;

    #[test]
    fn every_packet_is_a_narrower_bundle_than_its_round() {
        let set = SampleSet::new(1024, 5).unwrap();
        for shift in [[0, 0], [0x1234_5678, 0x9abc_def0]] {
            for bundle in set.points().chunks(PACKET_SIZE) {
                let extent = |k: usize| {
                    let values = bundle.iter().map(|p| unit_float(p[k] ^ shift[k]));
                    values.clone().fold(0.0, f32::max) - values.fold(1.0, f32::min)
                };
                // Two bundles a round: halves of the unit square.
                assert!(extent(0).min(extent(1)) <= 0.5, "{} {}", extent(0), extent(1));
            }
        }
    }
}
