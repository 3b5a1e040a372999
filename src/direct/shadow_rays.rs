//! Shadow rays, collected and traced together, with the unoccluded light of each.
//!
//! Those of a tile of texels go down the tree as a [stream](crate::trace). The light that arrives is added up per slot
//! in the order of the rays, whatever is traced together: a point has the same bits alone and in a tile.

use super::guide::Guide;
use super::light_tree::Descent;
use super::receiver::Receiver;
use crate::base::directional::Directional;
use crate::base::error::Result;
use crate::base::memory::try_filled;
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

/// Number of shadow rays of one point that are traced together. (Direct light of the living room, 20 texels/m: 1.4 s;
/// one by one 2.15 s.)
const TOGETHER: usize = 32;

/// Maximum number of shadow rays of a tile that are traced together, and the minimum that are worth a stream.
const STREAM: usize = 2048;
const LEAST_STREAM: usize = 32;

/// Number of parts of a point's light that are estimated in different ways.
pub(crate) const KINDS: usize = 4;

/// A shadow ray's light if nothing occludes it, and the sum that it belongs to.
#[derive(Clone, Copy, Default)]
pub(crate) struct Carried {
    light: Vec3,
    slot: u32,
}

/// A point on a light that may get a shadow ray, and its unoccluded light divided by the probability of the candidate.
pub(crate) struct Candidate {
    pub(crate) target: Vec3,
    pub(crate) light: Vec3,
}

/// Lists by which shadow rays are chosen among many lights, which keep their room for the next point.
#[derive(Default)]
pub(crate) struct Choice {
    pub(crate) descent: Descent,
    pub(crate) candidates: Vec<Candidate>,
}

/// Room for the shadow rays of points: in arrays on the stack for one point, in vectors for tiles.
pub(crate) struct Room<R, C, O, V> {
    rays: R,
    carried: C,
    occluded: O,
    visible: V,
    choice: Choice,
    /// `None`: rays are too few to be traced light by light.
    by_light: Option<ByLight>,
    /// `None`: nobody asks for light by direction.
    directed: Option<Directed>,
}

/// Shadow rays in the order of the lights that they go to: those to one light go the same way, and pass the tree
/// together faster (six lamps in a level: in
/// 0.53 of the time).
struct ByLight {
    /// Number of the light that each ray goes to.
    numbers: Vec<u8>,
    /// Numbers of the rays, by light.
    order: Vec<u16>,
    rays: Vec<Ray>,
    occluded: Vec<u8>,
}

impl ByLight {
    /// Traces rays as [`Scene::occluded_stream`] does.
    fn trace(&mut self, scene: &Scene, rays: &[Ray], occluded: &mut [u8]) {
        let count = rays.len();
        let numbers = &self.numbers[..count];
        let mut ends = [0; 1 << u8::BITS];
        numbers.iter().for_each(|&light| ends[light as usize] += 1);
        if ends[numbers[0] as usize] == count {
            return scene.occluded_stream(rays, occluded);
        }
        let mut sum = 0;
        for end in &mut ends {
            (sum, *end) = (sum + *end, sum);
        }
        for (i, &light) in numbers.iter().enumerate() {
            let place = &mut ends[light as usize];
            (self.order[*place], self.rays[*place]) = (i as u16, rays[i]);
            *place += 1;
        }
        let mut begin = 0;
        for end in ends {
            // Rays to lights that few go to are traced with those to the next.
            if end - begin >= LEAST_STREAM || end == count && begin < end {
                scene.occluded_stream(&self.rays[begin..end], &mut self.occluded[begin..end]);
                begin = end;
            }
        }
        self.order[..count].iter().zip(&self.occluded).for_each(|(&i, &o)| occluded[i as usize] = o);
    }
}

/// Light by direction: that of each ray if nothing occludes it, and what has arrived, by slot.
struct Directed {
    carried: Vec<Directional>,
    visible: Vec<Directional>,
}

/// Room for one point.
pub(crate) type PointRoom = Room<[Ray; TOGETHER], [Carried; TOGETHER], [u8; TOGETHER], [Vec3; KINDS]>;

/// Room for a tile.
pub(crate) type TileRoom = Room<Vec<Ray>, Vec<Carried>, Vec<u8>, Vec<Vec3>>;

const NOTHING: Ray = Ray { origin: [0.0; 3], tmin: 0.0, direction: [0.0; 3], tmax: 0.0 };

impl PointRoom {
    pub(crate) fn new() -> Self {
        Room {
            rays: [NOTHING; TOGETHER],
            carried: [Carried::default(); TOGETHER],
            occluded: [0; TOGETHER],
            visible: [Vec3::ZERO; KINDS],
            choice: Choice::default(),
            by_light: None,
            directed: None,
        }
    }

    /// Makes room for light by direction too. (A KiB and a half, for few points.)
    pub(crate) fn by_direction() -> Self {
        let nothing = Directional::default();
        let directed = Directed { carried: vec![nothing; TOGETHER], visible: vec![nothing; KINDS] };
        Room { directed: Some(directed), ..Self::new() }
    }
}

impl TileRoom {
    /// Allocates room for the rays of a number of points and for `slots` sums. (More rays are traced in parts.)
    pub(crate) fn new(slots: usize, points: usize) -> Result<Self> {
        let what = "the shadow rays of a tile";
        let most = (2 * points).clamp(TOGETHER, STREAM);
        Ok(Room {
            rays: try_filled(most, NOTHING, what)?,
            carried: try_filled(most, Carried::default(), what)?,
            occluded: try_filled(most, 0, what)?,
            visible: try_filled(slots, Vec3::ZERO, what)?,
            choice: Choice::default(),
            by_light: Some(ByLight {
                numbers: try_filled(most, 0, what)?,
                order: try_filled(most, 0, what)?,
                rays: try_filled(most, NOTHING, what)?,
                occluded: try_filled(most, 0, what)?,
            }),
            directed: None,
        })
    }

    /// Allocates room for light by direction too.
    pub(crate) fn by_direction(self) -> Result<Self> {
        let (what, nothing) = ("the shadow rays of a tile", Directional::default());
        let carried = try_filled(self.rays.len(), nothing, what)?;
        let directed = Directed { carried, visible: try_filled(self.visible.len(), nothing, what)? };
        Ok(Room { directed: Some(directed), ..self })
    }
}

impl<R: AsMut<[Ray]>, C: AsMut<[Carried]>, O: AsMut<[u8]>, V: AsMut<[Vec3]>> Room<R, C, O, V> {
    /// Returns shadow rays in a scene, none so far, whose sums are 0.
    pub(crate) fn begin<'a>(&'a mut self, scene: &'a Scene) -> ShadowRays<'a> {
        let visible = self.visible.as_mut();
        visible.fill(Vec3::ZERO);
        if let Some(directed) = &mut self.directed {
            directed.visible.fill(Directional::default());
        }
        ShadowRays {
            scene,
            rays: self.rays.as_mut(),
            carried: self.carried.as_mut(),
            occluded: self.occluded.as_mut(),
            visible,
            choice: &mut self.choice,
            count: 0,
            traced: 0,
            slot: 0,
            light: 0,
            normal: Vec3::ZERO,
            near: Near::default(),
            guide: None,
            by_light: self.by_light.as_mut(),
            directed: self.directed.as_mut(),
        }
    }
}

/// Point and spot lights whose light is sampled [apart](crate::lightmap::texel_light) at receivers nearby.
#[derive(Clone, Copy, Default)]
pub(crate) struct Near {
    /// Square of the distance up to which it is; 0: nowhere.
    pub distance2: f32,
    /// The lights are those within the root of `reach2` of a place.
    pub of: Vec3,
    pub reach2: f32,
}

impl Near {
    /// Whether what a receiver gets of the light at a position is sampled apart.
    pub(crate) fn has(&self, position: Vec3, receiver: &Receiver) -> bool {
        position.distance_squared(receiver.position) < self.distance2
            && position.distance_squared(self.of) <= self.reach2
    }
}

/// Shadow rays, each with the light that it carries if nothing occludes it.
pub(crate) struct ShadowRays<'a> {
    scene: &'a Scene,
    rays: &'a mut [Ray],
    carried: &'a mut [Carried],
    occluded: &'a mut [u8],
    /// Light that has arrived, by slot.
    visible: &'a mut [Vec3],
    pub(crate) choice: &'a mut Choice,
    count: usize,
    traced: u64,
    /// The sum that the next rays belong to.
    pub(crate) slot: usize,
    /// Number of the light that the next rays go to, all in about one direction; 0 if they do not. (Area lights apart:
    /// 1.1 times the time of their rays in the living room.) Lights from [`u8::MAX`] on count as one.
    pub(super) light: usize,
    /// Unit normal of the receiver of the next rays.
    pub(crate) normal: Vec3,
    /// Lights that do not shine on the next receivers, mostly none.
    pub(crate) near: Near,
    /// Where the next receivers may see the sky.
    pub(crate) guide: Option<Guide>,
    by_light: Option<&'a mut ByLight>,
    directed: Option<&'a mut Directed>,
}

impl ShadowRays<'_> {
    pub(crate) fn push(&mut self, ray: Ray, light: Vec3) {
        if self.count == self.rays.len() {
            self.trace();
        }
        self.rays[self.count] = ray;
        self.carried[self.count] = Carried { light, slot: self.slot as u32 };
        if let Some(by_light) = &mut self.by_light {
            by_light.numbers[self.count] = self.light.min(u8::MAX as usize) as u8;
        }
        if self.directed.is_some() {
            self.carry_by_direction(&ray, light);
        }
        self.count += 1;
    }

    /// Notes the direction of a ray that is being pushed. (Out of line: inlined, it slows down those who do not ask.)
    #[inline(never)]
    fn carry_by_direction(&mut self, ray: &Ray, light: Vec3) {
        if let Some(directed) = &mut self.directed {
            let direction = Vec3::from(ray.direction).normalize_or_zero();
            directed.carried[self.count] = Directional::of(light, direction, direction.dot(self.normal));
        }
    }

    /// Pushes the ray to a point light. It ends as far before the light as rays start from surfaces: a light may lie on
    /// a wall, but also close inside of a housing that must block it.
    pub(crate) fn push_point(&mut self, receiver: &Receiver, position: Vec3, light: Vec3) {
        let way = position - receiver.shadow_origin;
        let margin = (ray_epsilon(position, self.scene) / way.length()).min(LIGHT_MARGIN);
        self.push(Ray::new(receiver.shadow_origin, way).within(0.0, 1.0 - margin), light);
    }

    fn trace(&mut self) {
        let scene = self.scene;
        let (rays, carried) = (&self.rays[..self.count], &self.carried[..self.count]);
        if scene.uses().transmission {
            for (i, (ray, c)) in rays.iter().zip(carried).enumerate() {
                let passed = scene.transmittance(ray);
                self.visible[c.slot as usize] += c.light * passed;
                if let Some(d) = &mut self.directed {
                    d.visible[c.slot as usize] += d.carried[i].scaled(passed);
                }
            }
        } else {
            let occluded = &mut self.occluded[..self.count];
            match &mut self.by_light {
                _ if self.count < LEAST_STREAM => scene.occluded_block(rays, occluded),
                Some(by_light) => by_light.trace(scene, rays, occluded),
                None => scene.occluded_stream(rays, occluded),
            }
            for (c, _) in carried.iter().zip(&*occluded).filter(|(_, occluded)| **occluded == 0) {
                self.visible[c.slot as usize] += c.light;
            }
            if let Some(d) = &mut self.directed {
                for (i, (c, _)) in carried.iter().zip(&*occluded).enumerate().filter(|(_, (_, o))| **o == 0) {
                    d.visible[c.slot as usize] += d.carried[i];
                }
            }
        }
        self.traced += self.count as u64;
        self.count = 0;
    }

    /// Traces the remaining rays and returns the light that has arrived, by slot; adds the rays traced to `rays`.
    pub(crate) fn finish(&mut self, rays: &mut u64) -> &[Vec3] {
        self.finish_by_direction(rays).0
    }

    /// Does the work of [`finish`](Self::finish), and returns the light by direction too; empty if there is no room for it.
    pub(crate) fn finish_by_direction(&mut self, rays: &mut u64) -> (&[Vec3], &[Directional]) {
        self.trace();
        *rays += std::mem::take(&mut self.traced);
        (self.visible, self.directed.as_ref().map_or(&[], |d| &d.visible))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::sampling::uniform;
    use crate::scene::builtin;

    #[test]
    fn rays_that_are_traced_light_by_light_bring_what_they_bring_one_by_one() {
        let scene = builtin("atrium").unwrap().committed();
        let (lower, upper) = scene.bounds();
        let point = |i: u32, of: u32| {
            lower + (upper - lower) * Vec3::new(uniform(i, 0, of), uniform(i, 1, of), uniform(i, 2, of))
        };
        // More rays than are traced at a time, to a few lights and to one that few go to; some slots get several.
        let light = |i: u32| if i.is_multiple_of(500) { 300 } else { (i % 5) as usize };
        let rays = (0..3000).map(|i| {
            let origin = point(i % 7, 2) + 0.01 * point(i, 3);
            (i, Ray::new(origin, point(light(i) as u32, 4) - origin).within(0.0, 0.999))
        });
        let mut room = TileRoom::new(1000, 3000).unwrap();
        let mut shadow = room.begin(&scene);
        let (mut expected, mut traced, mut lit) = (vec![Vec3::ZERO; 1000], 0, 0);
        for (i, ray) in rays {
            let carried = Vec3::splat(uniform(i, 5, 5));
            (shadow.slot, shadow.light) = (i as usize % 1000, light(i));
            shadow.push(ray, carried);
            if !scene.occluded(&ray) {
                expected[i as usize % 1000] += carried;
                lit += 1;
            }
        }
        assert_eq!(shadow.finish(&mut traced), expected);
        assert_eq!(traced, 3000);
        assert!(lit > 200 && lit < 2800, "{lit}");
    }
}
