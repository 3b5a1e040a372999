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

    /// Pushes up to `n` shadow rays, whose sum is the irradiance without bias. Returns the unoccluded irradiance by the
    /// same samples, summed over the channels.
    pub(crate) fn push(&self, receiver: &Receiver, n: u32, seed: u32, shadow: &mut ShadowRays) -> f32 {
        shadow.normal = receiver.normal;
        let mut choice = std::mem::take(shadow.choice);
        self.find_candidates(receiver, n * self.candidates, seed, &shadow.near, &mut choice);
        let total = push_some(receiver, n, seed, &choice.candidates, shadow);
        *shadow.choice = choice;
        total
    }

    /// Finds `n` candidates at most; lights that are sampled apart, since they are `near`, are left out.
    fn find_candidates(&self, receiver: &Receiver, n: u32, seed: u32, near: &Near, choice: &mut Choice) {
        let Choice { descent, candidates } = choice;
        candidates.clear();
        let offset = sobol_2d(0, combine(seed, 1))[0];
        let mut next = 0;
        let at = (receiver.origin, receiver.normal);
        // A light that is due several candidates gets that number rounded down or up and divides its light among them.
        let share_of = |due: f32, count: u32| 1.0 / if due >= 1.0 { count as f32 } else { due };
        let lights = match &self.sources {
            Sources::Lights(lights) => lights,
            Sources::Patches(patches) => {
                let prefetch = |i: usize| simd::prefetch(&patches[i]);
                self.tree.sample(at, n, offset, descent, prefetch, |i, due, count| {
                    if let Some(light) = patches[i].light(receiver) {
                        let light = light * (share_of(due, count) * count as f32);
                        candidates.push(Candidate { target: patches[i].position, light });
                    }
                });
                return;
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
