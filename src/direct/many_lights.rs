//! Sampling of many lights, or of [bright patches](crate::lightmap::indirect::bright_patches): candidates from the
//! light tree, of which a few get shadow rays.
//!
//! Resampled importance sampling (Talbot, Cline and Egbert, *Importance Resampling for Global Illumination*, 2005),
//! with systematic sampling in both steps: a light that is due at least one candidate is one, with its exact share; the
//! unoccluded light of the candidates is computed, and those that contribute much of it get a ray each, the others in
//! proportion.
//!
//! At equal time 10 to 40 times less error than lights chosen by power; see docs/experiments.md#many-lights.

use super::area_light::AreaLight;
use super::light_node::Bounds;
use super::light_tree::{LIGHT_TREE, LightTree};
use super::point_light::point_light;
use super::receiver::Receiver;
use super::shadow_rays::{Candidate, Choice, Near, ShadowRays, shadow_ray};
use crate::base::error::Result;
use crate::base::memory::try_collect;
use crate::base::sampling::{combine, sobol_2d};
use crate::scene::Light;
use crate::simd::{self, Isa};
use glam::Vec3;
use std::f32::consts::{FRAC_PI_2, PI};

/// Number of candidates per shadow ray to lights.
const CANDIDATES: u32 = 8;

/// Number of candidates per shadow ray to patches: the tree knows nearly all about a patch, and shadow rays of tiles
/// cost no more than candidates do. (Less noise in less time than with four times the candidates and half the rays:
/// docs/experiments.md#bright-patches-as-lights.)
const CANDIDATES_OF_PATCHES: u32 = 2;

/// Part of the variance of independent samples that systematic ones are taken to have. (It is 0.2 to 0.6 in the test below
/// where nothing is hidden. What more and less do: docs/experiments.md#bright-patches-as-lights.)
const SYSTEMATIC: f32 = 0.6;

#[derive(Clone, Copy)]
enum Source {
    /// A point or spot light.
    Point(Light),
    Area(AreaLight),
}

/// Lights of a set. Patches are so many that other lights' size would not fit the caches.
enum Sources {
    Lights(Vec<Source>),
    Patches(Vec<Patch>),
}

/// A small part of a surface, as a light.
#[derive(Clone, Copy)]
pub(crate) struct Patch {
    /// Position, slightly off the surface.
    pub position: Vec3,
    /// Unit normal on the emitting side.
    pub normal: Vec3,
    /// Radiance times area.
    pub flux: Vec3,
    /// Square of the distance within which the patch does not shine on receivers.
    pub near2: f32,
}

impl Patch {
    /// Unoccluded irradiance at a receiver.
    fn light(&self, receiver: &Receiver) -> Option<Vec3> {
        let way = self.position - receiver.origin;
        let d2 = way.length_squared();
        // (The square of d2 would overflow in scenes of 1e9 units.)
        let direction = way / d2.sqrt();
        let (here, there) = (direction.dot(receiver.normal), -direction.dot(self.normal));
        (d2 > self.near2 && here > 0.0 && there > 0.0 && receiver.faces(way)).then(|| self.flux * (here * there / d2))
    }
}

/// Light of shadow rays if nothing occludes them, summed over the channels.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Unoccluded {
    sum: f32,
    /// Number of rays that were asked for.
    rays: u32,
    /// Estimated variance by the choice of patches; 0 for other lights.
    of_choice: f32,
}

impl Unoccluded {
    /// Returns the variance of the sum over the channels of what arrives.
    pub(crate) fn variance(&self, arrived: Vec3) -> f32 {
        if !(self.sum > 0.0) {
            return 0.0;
        }
        let sum = arrived.element_sum();
        // Rays bring about the same amount each, or nothing; and a patch that is rarely chosen may be all that arrives. (Without
        // the latter part texels that had got its light looked as sure as those that had got none of it:
        // docs/experiments.md#bright-patches-as-lights.) Which of the light that was chosen has arrived is not known: all of it is
        // taken to arrive alike.
        let of_occlusion = sum * (self.sum - sum).max(0.0) / self.rays as f32;
        of_occlusion + self.of_choice * (sum / self.sum).min(1.0)
    }
}

/// Patches that samples have fallen on, without those that are due at least one, whose light is exact.
#[derive(Default)]
struct Drawn {
    count: f32,
    /// Sum of their unoccluded light divided by the probability of each, and that of its squares; both summed over the channels.
    sum: f32,
    squares: f32,
}

impl Drawn {
    /// Adds a patch that is due a number of samples and has such light; `None`: it does not shine on the receiver.
    fn add(&mut self, light: Option<Vec3>, due: f32) {
        if due < 1.0 {
            let light = light.map_or(0.0, |light| light.element_sum());
            (self.count, self.sum, self.squares) = (self.count + 1.0, self.sum + light, self.squares + light * light);
        }
    }

    /// Returns the estimated variance of the sum (Hansen and Hurwitz, *On the Theory of Sampling from Finite Populations*, 1943,
    /// for independent samples).
    fn variance(&self) -> f32 {
        // A patch alone may as well not have been chosen. (Too much for one that was due nearly one sample.)
        let n = self.count.max(2.0);
        SYSTEMATIC * (n * self.squares - self.sum * self.sum).max(0.0) / (n - 1.0)
    }
}

/// Lights that are sampled because they are many.
pub(crate) struct ManyLights {
    sources: Sources,
    tree: LightTree,
    /// Number of candidates per shadow ray.
    candidates: u32,
}

impl ManyLights {
    /// Makes the set of point and spot lights that shine, and of area lights.
    pub(crate) fn new(isa: Isa, points: &[Light], areas: &[AreaLight]) -> Result<ManyLights> {
        let sources = points.iter().map(|&p| Source::Point(p)).chain(areas.iter().map(|&a| Source::Area(a)));
        ManyLights::of(isa, Sources::Lights(try_collect(sources, LIGHT_TREE)?), CANDIDATES)
    }

    /// Makes the set of small parts of surfaces.
    pub(crate) fn of_patches(isa: Isa, patches: Vec<Patch>) -> Result<ManyLights> {
        ManyLights::of(isa, Sources::Patches(patches), CANDIDATES_OF_PATCHES)
    }

    fn of(isa: Isa, sources: Sources, candidates: u32) -> Result<ManyLights> {
        let bounds = match &sources {
            Sources::Lights(lights) => try_collect(lights.iter().map(bounds), LIGHT_TREE)?,
            Sources::Patches(patches) => try_collect(patches.iter().map(bounds_of_patch), LIGHT_TREE)?,
        };
        Ok(ManyLights { tree: LightTree::new(isa, &bounds)?, sources, candidates })
    }

    pub(crate) fn bytes(&self) -> usize {
        let sources = match &self.sources {
            Sources::Lights(lights) => size_of_val(&lights[..]),
            Sources::Patches(patches) => size_of_val(&patches[..]),
        };
        sources + self.tree.bytes()
    }

    pub(crate) fn len(&self) -> usize {
        match &self.sources {
            Sources::Lights(lights) => lights.len(),
            Sources::Patches(patches) => patches.len(),
        }
    }

    /// Pushes up to `n` shadow rays, whose sum is the irradiance without bias. Returns what they would bring if nothing
    /// occluded them.
    pub(crate) fn push(&self, receiver: &Receiver, n: u32, seed: u32, shadow: &mut ShadowRays) -> Unoccluded {
        shadow.normal = receiver.normal;
        let mut choice = std::mem::take(shadow.choice);
        let drawn = self.find_candidates(receiver, n * self.candidates, seed, &shadow.near, &mut choice);
        let sum = push_some(receiver, n, seed, &choice.candidates, shadow);
        *shadow.choice = choice;
        Unoccluded { sum, rays: n, of_choice: drawn.variance() }
    }

    /// Finds `n` candidates at most; lights that are sampled apart, since they are `near`, are left out. Returns
    /// the light of the patches among them.
    fn find_candidates(&self, receiver: &Receiver, n: u32, seed: u32, near: &Near, choice: &mut Choice) -> Drawn {
        let Choice { descent, candidates } = choice;
        candidates.clear();
        let offset = sobol_2d(0, combine(seed, 1))[0];
        let (mut next, mut drawn) = (0, Drawn::default());
        let at = (receiver.origin, receiver.normal);
        // A light that is due several candidates gets that number rounded down or up and divides its light among them.
        let share_of = |due: f32, count: u32| 1.0 / if due >= 1.0 { count as f32 } else { due };
        let lights = match &self.sources {
            Sources::Lights(lights) => lights,
            Sources::Patches(patches) => {
                let prefetch = |i: usize| simd::prefetch(&patches[i]);
                self.tree.sample(at, n, offset, descent, prefetch, |i, due, count| {
                    let light = patches[i].light(receiver).map(|light| light * (share_of(due, count) * count as f32));
                    drawn.add(light, due);
                    if let Some(light) = light {
                        candidates.push(Candidate { target: patches[i].position, light });
                    }
                });
                return drawn;
            }
        };
        self.tree.sample(
            at,
            n,
            offset,
            descent,
            |_| (),
            |light, due, count| {
                let share = share_of(due, count);
                match &lights[light] {
                    Source::Point(light) => {
                        let light = point_light(light, receiver);
                        if let Some((target, light)) = light.filter(|&(at, _)| !near.has(at, receiver)) {
                            candidates.push(Candidate { target, light: light * (share * count as f32) });
                        }
                    }
                    Source::Area(area) => {
                        let Some(sampler) = area.sampler(receiver) else { return };
                        for _ in 0..count {
                            let (target, weight) = area.sample(&sampler, receiver, sobol_2d(next, combine(seed, 2)));
                            next += 1;
                            if weight > 0.0 && weight.is_finite() {
                                candidates.push(Candidate { target, light: area.radiance * (weight * share) });
                            }
                        }
                    }
                }
            },
        );
        drawn
    }
}

/// Pushes the shadow rays to about `n` of some candidates, systematically, and returns the light of all.
fn push_some(receiver: &Receiver, n: u32, seed: u32, candidates: &[Candidate], shadow: &mut ShadowRays) -> f32 {
    let total: f32 = candidates.iter().map(|c| c.light.element_sum()).sum();
    if !(total > 0.0 && total.is_finite()) {
        return 0.0;
    }
    let mut at = sobol_2d(0, combine(seed, 3))[0] - 1.0;
    for c in candidates {
        let due = c.light.element_sum() / total * n as f32;
        at += due;
        if due >= 1.0 {
            shadow.push(shadow_ray(receiver, c.target), c.light);
            // The share beyond whole rays does not shift the others' probabilities.
            at -= due;
        } else if at >= 0.0 {
            shadow.push(shadow_ray(receiver, c.target), c.light / due);
            at -= 1.0;
        }
    }
    total
}

fn bounds(source: &Source) -> Bounds {
    let everywhere =
        |position| Bounds { lower: position, upper: position, axis: Vec3::Z, spread: PI, reach: 0.0, power: 0.0 };
    match *source {
        Source::Point(Light::Spot { position, direction, outer, intensity, .. }) => Bounds {
            axis: direction,
            spread: outer,
            power: Vec3::from(intensity).element_sum(),
            ..everywhere(position)
        },
        Source::Point(Light::Point { position, intensity }) => {
            Bounds { power: Vec3::from(intensity).element_sum(), ..everywhere(position) }
        }
        Source::Point(_) => unreachable!("only point and spot lights are made points"),
        Source::Area(a) => {
            let (lower, upper) = a.bounds();
            let spread = if a.two_sided { PI } else { 0.0 };
            Bounds { lower, upper, axis: a.normal, spread, reach: FRAC_PI_2, power: a.radiance.element_sum() * a.area }
        }
    }
}

fn bounds_of_patch(p: &Patch) -> Bounds {
    let power = p.flux.element_sum();
    Bounds { lower: p.position, upper: p.position, axis: p.normal, spread: 0.0, reach: FRAC_PI_2, power }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::sampling::uniform;
    use crate::direct::shadow_rays::PointRoom;
    use crate::scene::demo::shapes::MeshBuilder;
    use crate::scene::{Material, SceneData};

    /// Patches above a floor, one in twenty of which is much brighter than the others; `hidden`: those beyond x = 0.25 are
    /// behind a wall. Returns the variance of the light of a few shadow rays from its middle, and the mean of their estimates of it,
    /// by the square of the light.
    fn variance_and_estimate(rays: u32, hidden: bool) -> [f64; 2] {
        let mut data = SceneData::new();
        let m = data.add_material(Material { two_sided: true, ..Default::default() }).unwrap();
        let mut builder = MeshBuilder::new();
        let p = Vec3::new;
        builder.quad(p(-9.0, -9.0, 0.0), p(9.0, -9.0, 0.0), p(9.0, 9.0, 0.0), p(-9.0, 9.0, 0.0), m);
        if hidden {
            builder.quad(p(0.25, -9.0, 0.0), p(0.25, 9.0, 0.0), p(0.25, 9.0, 9.0), p(0.25, -9.0, 9.0), m);
        }
        data.add_mesh(builder.finish()).unwrap();
        let scene = data.committed();
        let patch = |i: u32| Patch {
            position: p(4.0 * uniform(i, 0, 3) - 2.0, 4.0 * uniform(i, 1, 3) - 2.0, 0.2 + 1.8 * uniform(i, 2, 3)),
            normal: if i.is_multiple_of(3) { -Vec3::Z } else { p(-0.6, 0.0, -0.8) },
            flux: Vec3::splat(if i.is_multiple_of(20) { 1.0 } else { 0.02 }),
            near2: 0.0,
        };
        let lights = ManyLights::of_patches(Isa::Portable, (0..300).map(patch).collect()).unwrap();
        let origin = p(0.0, 0.0, 1e-3);
        let up = Vec3::Z;
        let r =
            Receiver { origin, normal: up, geometric: up, position: Vec3::ZERO, shadow_origin: origin, raised: false };
        let (n, mut sum, mut squares, mut estimates) = (20_000, 0.0, 0.0, 0.0);
        let mut room = PointRoom::new();
        for seed in 0..n {
            let mut shadow = room.begin(&scene);
            let unoccluded = lights.push(&r, rays, combine(seed, 4), &mut shadow);
            let arrived = shadow.finish(&mut 0)[0];
            let light = f64::from(arrived.element_sum());
            (sum, squares) = (sum + light, squares + light * light);
            estimates += f64::from(unoccluded.variance(arrived));
        }
        let mean = sum / f64::from(n);
        [squares / f64::from(n) / (mean * mean) - 1.0, estimates / f64::from(n) / (mean * mean)]
    }

    #[test]
    fn the_estimated_variance_is_about_that_of_the_light() {
        for rays in [2, 8, 32] {
            for hidden in [false, true] {
                let [variance, estimate] = variance_and_estimate(rays, hidden);
                // (0.8 to 6.2: the estimate is for rays that are occluded independently, and systematic ones vary less.)
                let ratio = estimate / variance;
                assert!(variance > 1e-4 && ratio > 0.5 && ratio < 8.0, "{rays} {hidden}: {estimate}, not {variance}");
            }
        }
    }
}
