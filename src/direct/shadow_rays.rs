//! Shadow rays, collected and traced together, with the unoccluded light of each.

use super::receiver::Receiver;
use crate::scene::Scene;
use crate::trace::Ray;
use crate::trace::offset::ray_epsilon;
use glam::Vec3;

/// Fraction of the way by which shadow rays end before a light; before a point at most.
const LIGHT_MARGIN: f32 = 1e-4;

/// The shadow ray to a point on a light.
pub(crate) fn shadow_ray(receiver: &Receiver, target: Vec3) -> Ray {
    Ray::new(receiver.shadow_origin, target - receiver.shadow_origin).within(0.0, 1.0 - LIGHT_MARGIN)
}

/// Number of shadow rays that are traced together. (Direct light of the living room, 20 texels/m: 1.4 s; one by one
/// 2.15 s.)
const TOGETHER: usize = 32;

/// Number of sums of light that [`ShadowRays`] keeps apart.
const SLOTS: usize = KINDS * MAX_POINTS;

/// Shadow rays, each with the light that it carries if nothing occludes it.
pub(crate) struct ShadowRays<'a> {
    scene: &'a Scene,
    rays: [Ray; TOGETHER],
    light: [Vec3; TOGETHER],
    slots: [u8; TOGETHER],
    count: usize,
    pub(super) traced: u64,
    /// The sum that the next rays belong to.
    pub(super) slot: u8,
    pub(super) visible: [Vec3; SLOTS],
}

impl<'a> ShadowRays<'a> {
    pub(crate) fn new(scene: &'a Scene) -> Self {
        ShadowRays {
            scene,
            rays: [Ray::new(Vec3::ZERO, Vec3::ZERO); TOGETHER],
            light: [Vec3::ZERO; TOGETHER],
            slots: [0; TOGETHER],
            count: 0,
            traced: 0,
            slot: 0,
            visible: [Vec3::ZERO; SLOTS],
        }
    }

    pub(crate) fn push(&mut self, ray: Ray, light: Vec3) {
        if self.count == TOGETHER {
            self.trace();
        }
        (self.rays[self.count], self.light[self.count], self.slots[self.count]) = (ray, light, self.slot);
        self.count += 1;
    }

    /// Pushes the ray to a point light. It ends as far before the light as rays start from surfaces: a light may lie on
    /// a wall, but also close inside of a housing that must block it.
    pub(crate) fn push_point(&mut self, receiver: &Receiver, position: Vec3, light: Vec3) {
        let way = position - receiver.shadow_origin;
        let margin = (ray_epsilon(position, self.scene) / way.length()).min(LIGHT_MARGIN);
        self.push(Ray::new(receiver.shadow_origin, way).within(0.0, 1.0 - margin), light);
    }

    pub(super) fn trace(&mut self) {
        let scene = self.scene;
        let lit = self.light[..self.count].iter().zip(&self.slots);
        if scene.uses().transmission {
            for (ray, (light, &slot)) in self.rays[..self.count].iter().zip(lit) {
                self.visible[slot as usize] += *light * scene.transmittance(ray);
            }
        } else {
            let mut occluded = [0; TOGETHER];
            scene.occluded_block(&self.rays[..self.count], &mut occluded);
            for ((light, &slot), _) in lit.zip(occluded).filter(|(_, occluded)| *occluded == 0) {
                self.visible[slot as usize] += *light;
            }
        }
        self.traced += self.count as u64;
        self.count = 0;
    }

    /// Traces the remaining rays and returns the light that arrives; adds the rays traced to `rays`.
    pub(crate) fn finish(mut self, rays: &mut u64) -> Vec3 {
        self.trace();
        *rays += self.traced;
        self.visible[0]
    }
}

/// Maximum number of points that are lit together.
pub(crate) const MAX_POINTS: usize = 16;

/// Number of parts of a point's light that are estimated in different ways.
pub(crate) const KINDS: usize = 4;
