//! Radiance where gather rays hit nearby: computed by short paths, since the radiance map is too coarse there. (Jensen,
//! *Global Illumination using Photon Maps*, 1996, computes radiance accurately where a ray is short.)
//!
//! A texel of the radiance map shows one average. Rays that are long see many texels at once; one that is short, as in
//! corners, in gaps behind furniture and under mouldings, sees a single one. So where a ray hits nearer than some texels
//! of the map, the light reflected there is sampled: direct light by shadow rays, indirect light by one more ray, which
//! looks up the radiance map. If all hits are near, paths go on until Russian roulette ends them. What is seen through
//! transmissive sheets is always looked up.
//!
//! What they are worth and cost: docs/accuracy.md#near-hits.

use super::radiance_map::{Place, RadianceLookup};
use crate::base::sampling::{combine, cosine_around, uniform};
use crate::direct::DirectLight;
use crate::direct::shadow_rays::PointRoom;
use crate::lightmap::atlas::chart_map::receiver_at;
use crate::lightmap::atlas::ids::PlacementId;
use crate::scene::Scene;
use crate::trace::{RawHit, Ray};
use glam::Vec3;
use std::f32::consts::PI;

/// Maximum number of vertices of a path from a near hit; the last one looks up the map. (In narrow cavities all hits
/// are near, and longer paths take twice the extra time: docs/experiments.md#near-hits.)
const VERTICES: u32 = 2;

/// The same if all hits are near.
const MOST_VERTICES: u32 = 64;

/// Vertices after which paths end by Russian roulette.
const SURE: u32 = 3;

/// Which hits are near, and what lights them.
#[derive(Clone, Copy)]
pub(crate) struct NearHits<'a> {
    pub direct: &'a DirectLight,
    /// Distance up to which a hit is near, in texels of the radiance map.
    pub texels: f32,
}

/// What gather rays see where they hit.
pub(crate) struct HitRadiance<'a> {
    pub lookup: RadianceLookup<'a>,
    near: Option<NearHits<'a>>,
}

impl<'a> HitRadiance<'a> {
    /// Looks up the radiance map, but where gather rays hit nearby.
    pub(crate) fn new(lookup: RadianceLookup<'a>, near: NearHits<'a>) -> Self {
        HitRadiance { lookup, near: (near.texels > 0.0).then_some(near) }
    }

    /// Looks up the radiance map everywhere.
    pub(crate) fn of_map(lookup: RadianceLookup<'a>) -> Self {
        HitRadiance { lookup, near: None }
    }
}

impl HitRadiance<'_> {
    /// Whether a hit at a distance is near.
    #[inline]
    fn is_near(&self, near: &NearHits, placement: PlacementId, distance: f32) -> bool {
        placement != PlacementId::NONE
            && distance * distance < near.texels * near.texels * self.lookup.texel_area(placement)
    }

    /// Returns the radiance reflected towards a gather ray at its hit, whose place in the map is given, as
    /// [`RadianceLookup::seen`] does, but computed where the hit is near. `seed` is the ray's own. Adds the rays traced to
    /// `rays`.
    #[inline]
    pub(super) fn towards(&self, scene: &Scene, hit: &RawHit, place: &Place, seed: u32, rays: &mut u64) -> Vec3 {
        let (placement, cached) = self.lookup.at(place);
        let seen = self.lookup.bright().seen(cached, self.lookup.map(), placement, hit.t);
        match &self.near {
            // The bright part, which gather rays leave to shadow rays, is that of the map.
            Some(near) if self.is_near(near, placement, hit.t) => {
                let computed = self.computed(near, scene, hit, seed, rays);
                if seen == cached { computed } else { seen + computed - cached }
            }
            _ => seen,
        }
    }

    /// Estimates the radiance reflected at a hit.
    #[inline(never)]
    fn computed(&self, near: &NearHits, scene: &Scene, hit: &RawHit, seed: u32, rays: &mut u64) -> Vec3 {
        let (mut sum, mut throughput) = (Vec3::ZERO, Vec3::ONE);
        let mut hit = *hit;
        let vertices = if near.texels.is_finite() { VERTICES } else { MOST_VERTICES };
        for vertex in 0..vertices {
            let own = |purpose: u32| combine(seed, 4 * vertex + purpose);
            throughput *= scene.albedo(hit.triangle, hit.u, hit.v);
            if vertex >= SURE {
                let going_on = throughput.max_element().min(1.0);
                if uniform(0, 0, own(0)) >= going_on {
                    break;
                }
                throughput /= going_on;
            }
            if throughput == Vec3::ZERO {
                break;
            }
            let (_, receiver) = receiver_at(scene, hit.triangle, [hit.u, hit.v], !hit.front);
            sum += throughput * near.direct.unbiased(&receiver, 1, own(1), rays) / PI;
            if self.lookup.bright().len() > 0 {
                let mut room = PointRoom::new();
                let mut shadow = room.begin(scene);
                self.lookup.bright().push(&receiver, 1, own(2), &mut shadow);
                sum += throughput * shadow.finish(rays)[0] / PI;
            }
            let direction = cosine_around(receiver.normal, [uniform(0, 1, own(3)), uniform(0, 2, own(3))]);
            if direction.dot(receiver.geometric) <= 0.0 {
                break;
            }
            let ray = Ray::new(receiver.origin, direction);
            let next = scene.intersect_raw(&ray);
            *rays += 1;
            if next.is_miss() {
                break;
            }
            if scene.uses().transmission && scene.material(next.triangle).transmits() {
                sum += throughput * self.lookup.through(scene, &ray, &mut Vec::new());
                break;
            }
            let Some((placement, cached)) = self.lookup.met(&next) else { break };
            sum += throughput * self.lookup.bright().seen(cached, self.lookup.map(), placement, next.t);
            if !self.is_near(near, placement, next.t) || vertex + 1 == vertices {
                break;
            }
            sum -= throughput * cached;
            hit = next;
        }
        sum
    }
}
