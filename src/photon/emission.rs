//! Photon emission: the choice of a light, and start, direction and power of each photon.
//!
//! Lights get photons in proportion to their power (thesis 3.2.2) by systematic allotment: photon i
//! stands at (i + offset)/N of the total power, so a light gets its share rounded down or up, and
//! the photons of one light have consecutive numbers. A light that is due at least one photon
//! divides its exact power among those it gets; fainter ones get one photon or none, which carries
//! the power that makes the expectation right. Positions and directions are pairs of Owen-scrambled
//! Sobol dimensions over the photon number: any run of consecutive numbers is stratified.
//!
//! Photons are aimed at the scene where that is exact and cheap. A parallel light emits them through
//! the faces of the scene's bounding box on which it falls, which is the whole of its light that can
//! reach the scene. Discs and skies shine through discs around the scene's bounding sphere, each
//! perpendicular to its photon. A point light outside the box's bounding sphere emits into the cone of that sphere; the
//! rest of its power is counted as escaped without being traced. [Guides](super::guide) send more photons where they
//! are more useful.

use super::guide::{Guide, PilotPhoton};
use super::spot::SpotProfile;
use crate::base::error::{Error, Result};
use crate::base::memory::{try_filled, try_push, try_to_vec, try_with_capacity};
use crate::base::sampling::{concentric_disc, cosine_around, orthonormal_basis, uniform_triangle};
use crate::scene::{Emitter, Light, Scene, Sky};
use crate::trace::offset::{offset_ray_origin, ray_epsilon};
use glam::{DVec3, Vec3};
use std::f64::consts::PI;
use std::sync::Arc;

/// A photon as it leaves its light.
#[derive(Clone, Copy, Debug)]
pub(super) struct Emitted {
    pub(super) origin: Vec3,
    /// Unit direction of travel.
    pub(super) direction: Vec3,
    /// Power in W per channel.
    pub(super) power: Vec3,
}

/// Distribution of start points and directions of the photons of a light without geometry.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Shape {
    /// Emission from a point into the cone around `axis`, uniformly; `height` is 1 − cos of its half-angle.
    Cone {
        position: Vec3,
        axis: Vec3,
        height: f64,
    },
    Spot {
        position: Vec3,
        axis: Vec3,
        profile: SpotProfile,
    },
    /// Emission from a parallelogram along `direction`.
    Beam {
        corner: Vec3,
        edge_u: Vec3,
        edge_v: Vec3,
        direction: Vec3,
    },
    /// Emission from all around, in the cone around `axis`, uniformly; `height` as above.
    Disc {
        axis: Vec3,
        height: f64,
    },
    /// Emission from all around, in proportion to the radiance of a sky (by number).
    Sky(usize),
    /// Emission from a parallelogram, cosine-distributed around `normal`.
    Rect {
        corner: Vec3,
        edge_u: Vec3,
        edge_v: Vec3,
        normal: Vec3,
    },
}

/// The pair of random numbers that a guide changes.
#[derive(Clone, Copy, PartialEq)]
enum Square {
    Position,
    Direction,
}

impl Shape {
    /// The pair of random numbers that best separates useful photons from useless ones; `None`: no guide.
    fn square(&self) -> Option<Square> {
        match self {
            Shape::Cone { .. } | Shape::Spot { .. } => Some(Square::Direction),
            Shape::Beam { .. } | Shape::Disc { .. } | Shape::Sky(_) => Some(Square::Position),
            Shape::Rect { .. } => None,
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct Source {
    shape: Shape,
    /// Power in W per channel.
    power: DVec3,
}

/// The emitters of a scene with the allotment of photons to them.
pub(super) struct Emission<'a> {
    scene: &'a Scene,
    sources: Vec<Source>,
    skies: Vec<Sky>,
    /// Sphere around the scene.
    centre: Vec3,
    radius: f32,
    /// First photon of each source, then of each emissive triangle, then the number of photons.
    first: Vec<u64>,
    /// Guide of each source, if it has one.
    guides: Vec<Option<Arc<Guide>>>,
    /// Photons per watt (of the mean over the channels).
    photons_per_watt: f64,
    /// Power of all lights, W per channel.
    pub(super) power: DVec3,
    /// Part of that power that is not aimed at the scene.
    pub(super) unaimed: DVec3,
}

impl<'a> Emission<'a> {
    /// Allots `count` photons to `lights` and to the scene's emissive triangles. `offset` in [0, 1)
    /// places the first photon.
    pub(super) fn new(scene: &'a Scene, lights: &[Light], count: u64, offset: f32) -> Result<Self> {
        let (mut sources, mut skies) = (Vec::new(), Vec::new());
        let mut unaimed = DVec3::ZERO;
        for light in lights {
            // Capacity for as many sources as any light makes.
            sources.try_reserve(MOST_SOURCES).map_err(|_| no_room(lights.len()))?;
            unaimed += add_sources(scene, light, &mut sources, &mut skies);
        }
        let powers = || sources.iter().map(|s| s.power).chain(scene.emitters().iter().map(emitter_power));
        let aimed: DVec3 = powers().sum();
        let total = mean(aimed);
        let photons_per_watt = if total > 0.0 { count as f64 / total } else { 0.0 };
        let mut first = try_with_capacity(sources.len() + scene.emitters().len() + 1, "the photons of each light")?;
        let mut below = 0.0;
        for power in powers() {
            first.push(((below * photons_per_watt - offset as f64).ceil().max(0.0) as u64).min(count));
            below += mean(power);
        }
        first.push(if total > 0.0 { count } else { 0 });
        let (centre, radius) = sphere_of_scene(scene);
        let power = aimed + unaimed;
        let guides = try_filled(sources.len(), None, "the guides of lights")?;
        Ok(Emission { scene, sources, skies, centre, radius, first, guides, photons_per_watt, power, unaimed })
    }

    /// Photons to emit: the count asked for, or 0 if no light has any power.
    pub(super) fn count(&self) -> u64 {
        *self.first.last().expect("never empty")
    }

    /// The light of photon `index` (numbered as in `first`) and the power that each of its photons
    /// carries.
    fn light_of(&self, index: u64) -> (usize, DVec3) {
        let light = self.first.partition_point(|&f| f <= index) - 1;
        let power = match self.sources.get(light) {
            Some(s) => s.power,
            None => emitter_power(&self.scene.emitters()[light - self.sources.len()]),
        };
        let due = mean(power) * self.photons_per_watt;
        let share = if due >= 1.0 { (self.first[light + 1] - self.first[light]) as f64 } else { due };
        (light, power / share)
    }

    /// The source that pilot photon `index` comes from, given its random numbers as in [`emit`](Self::emit), and the photon,
    /// which left nothing yet; `None` for lights with an area.
    pub(super) fn guidable(&self, index: u64, p: [f32; 2], d: [f32; 2]) -> Option<(usize, PilotPhoton)> {
        let (light, _) = self.light_of(index);
        let square = self.sources.get(light)?.shape.square()?;
        let at = if square == Square::Direction { d } else { p };
        let (place, density) = self.guides[light].as_ref().map_or((at, 1.0), |guide| guide.place(at));
        Some((light, PilotPhoton { place, left: 0, weight: 1.0 / density }))
    }

    /// Whether any light could have a guide.
    pub(super) fn can_be_guided(&self) -> bool {
        self.sources.iter().any(|s| s.shape.square().is_some())
    }

    /// Guides the emission from now on by pilot photons, each given with its source.
    pub(super) fn guide(&mut self, pilot: impl Iterator<Item = (usize, PilotPhoton)>) -> Result<()> {
        let what = "the pilot photons of lights";
        let mut of_source: Vec<Vec<PilotPhoton>> = try_filled(self.sources.len(), Vec::new(), what)?;
        for (source, photon) in pilot {
            try_push(&mut of_source[source], photon, what)?;
        }
        for (guide, photons) in self.guides.iter_mut().zip(&of_source) {
            *guide = Guide::new(photons)?.map(Arc::new);
        }
        Ok(())
    }

    /// The guide of each source.
    pub(super) fn guides(&self) -> &[Option<Arc<Guide>>] {
        &self.guides
    }

    /// Guides the emission by guides that were made for another one; returns whether they are for as many sources.
    pub(super) fn guide_by(&mut self, guides: &[Option<Arc<Guide>>]) -> Result<bool> {
        let is_for_these = guides.len() == self.sources.len();
        if is_for_these {
            self.guides = try_to_vec(guides, "the guides of lights")?;
        }
        Ok(is_for_these)
    }

    /// Whether photons leave the lights alike in another state of the scene, given the same guides.
    pub(super) fn is_like(&self, other: &Emission<'a>) -> bool {
        // Triangles may have other numbers.
        let emitters = |scene: &'a Scene| scene.emitters().iter().map(|e| Emitter { triangle: 0, ..*e });
        self.sources == other.sources
            && self.skies == other.skies
            && self.first == other.first
            && self.photons_per_watt.to_bits() == other.photons_per_watt.to_bits()
            && (self.centre, self.radius) == (other.centre, other.radius)
            && emitters(self.scene).eq(emitters(other.scene))
    }

    /// Emits photon `index`; `p` chooses its position on the light and `d` its direction, both uniform in the unit
    /// square.
    pub(super) fn emit(&self, index: u64, p: [f32; 2], d: [f32; 2]) -> Emitted {
        let (light, power) = self.light_of(index);
        let mut power = power.as_vec3();
        let (mut p, mut d) = (p, d);
        if let Some(guide) = self.guides.get(light).and_then(Option::as_ref) {
            let is_direction = self.sources[light].shape.square() == Some(Square::Direction);
            let square = if is_direction { &mut d } else { &mut p };
            let (place, density) = guide.place(*square);
            *square = place;
            power /= density;
        }
        let (origin, direction) = match self.sources.get(light) {
            Some(Source { shape: Shape::Sky(sky), .. }) => {
                let (from, tint) = self.sky_direction(&self.skies[*sky], d);
                power *= tint;
                (self.all_around(-from, p), -from)
            }
            Some(source) => self.leave(&source.shape, p, d),
            None => self.leave_triangle(&self.scene.emitters()[light - self.sources.len()], p, d),
        };
        Emitted { origin, direction, power }
    }

    fn leave(&self, shape: &Shape, p: [f32; 2], d: [f32; 2]) -> (Vec3, Vec3) {
        match *shape {
            Shape::Cone { position, axis, height } => {
                (position, around(axis, concentric_disc(d), |r2| height * r2 as f64))
            }
            Shape::Spot { position, axis, profile } => {
                (position, around(axis, concentric_disc(d), |r2| profile.height(r2 as f64)))
            }
            Shape::Disc { axis, height } => {
                let direction = around(axis, concentric_disc(d), |r2| height * r2 as f64);
                (self.all_around(direction, p), direction)
            }
            Shape::Sky(_) => unreachable!("skies colour their photons: see emit"),
            Shape::Beam { corner, edge_u, edge_v, direction } => (corner + edge_u * p[0] + edge_v * p[1], direction),
            Shape::Rect { corner, edge_u, edge_v, normal } => {
                let position = corner + edge_u * p[0] + edge_v * p[1];
                (offset_ray_origin(position, normal, self.scene), cosine_around(normal, d))
            }
        }
    }

    /// A point of the disc through which light along `direction` enters the scene's sphere.
    fn all_around(&self, direction: Vec3, p: [f32; 2]) -> Vec3 {
        let (t, b) = orthonormal_basis(direction);
        let [x, y] = concentric_disc(p);
        // The point lies a little before the sphere, so that rounding leaves all surfaces ahead.
        self.centre + (t * x + b * y - direction * 1.01) * self.radius
    }

    /// A direction from which a sky shines, and its colour there relative to the mean of all photons.
    fn sky_direction(&self, sky: &Sky, d: [f32; 2]) -> (Vec3, Vec3) {
        let (from, radiance, density) = sky.sample(d);
        let mean = sky.integral().as_vec3();
        let part = |c: usize| if mean[c] > 0.0 { radiance[c] / density / mean[c] } else { 0.0 };
        (from, Vec3::new(part(0), part(1), part(2)))
    }

    fn leave_triangle(&self, e: &Emitter, p: [f32; 2], mut d: [f32; 2]) -> (Vec3, Vec3) {
        let mut normal = e.normal;
        if e.two_sided {
            // Each half of one dimension serves one side of the triangle, so that each stays stratified.
            d[0] *= 2.0;
            if d[0] >= 1.0 {
                d[0] -= 1.0;
                normal = -normal;
            }
        }
        let [u, v] = uniform_triangle(p);
        let position = e.corner + e.edge_u * u + e.edge_v * v;
        (offset_ray_origin(position, normal, self.scene), cosine_around(normal, d))
    }
}

/// Maximum number of sources that one light makes: a beam through each of three faces.
const MOST_SOURCES: usize = 3;

#[cold]
fn no_room(lights: usize) -> Error {
    Error::OutOfMemory(format!("the sources of {lights} lights"))
}

/// Adds the sources that make up `light` and returns its power that is not aimed at the scene.
fn add_sources(scene: &Scene, light: &Light, sources: &mut Vec<Source>, skies: &mut Vec<Sky>) -> DVec3 {
    let color = DVec3::from_array(light.color().map(f64::from));
    let mut add = |shape, factor: f64| sources.push(Source { shape, power: color * factor });
    match *light {
        Light::Point { position, .. } => {
            let (axis, height) = cone_of_scene(scene, position);
            add(Shape::Cone { position, axis, height }, 2.0 * PI * height);
            return color * (2.0 * PI * (2.0 - height));
        }
        Light::Spot { position, direction, inner, outer, .. } => {
            let profile = SpotProfile::new(inner, outer);
            add(Shape::Spot { position, axis: direction, profile }, profile.solid_angle());
        }
        Light::Directional { direction, angular_radius, .. } if angular_radius > 0.0 => {
            // 1 − cos of the radius; radiance times solid angle times the cross-section of the sphere.
            let height = 2.0 * (0.5 * angular_radius as f64).sin().powi(2);
            let (radius, sine) = (sphere_of_scene(scene).1 as f64, (angular_radius as f64).sin());
            let solid_angles = 2.0 * height / (sine * sine);
            add(Shape::Disc { axis: direction, height }, solid_angles * PI * radius * radius);
        }
        Light::Sky { .. } => {
            let Some(sky) = scene.sky(light).filter(|s| !s.is_dark()) else { return DVec3::ZERO };
            let radius = sphere_of_scene(scene).1 as f64;
            let power = sky.integral() * (PI * radius * radius);
            sources.push(Source { shape: Shape::Sky(skies.len()), power });
            skies.push(sky);
        }
        Light::Directional { direction, .. } => {
            for (corner, edge_u, edge_v) in lit_faces(scene, direction) {
                let flux = edge_u.as_dvec3().cross(edge_v.as_dvec3()).dot(direction.as_dvec3()).abs();
                add(Shape::Beam { corner, edge_u, edge_v, direction }, flux);
            }
        }
        Light::Rect { position, edge_u, edge_v, .. } => {
            let cross = edge_u.as_dvec3().cross(edge_v.as_dvec3());
            let normal = cross.normalize().as_vec3();
            add(Shape::Rect { corner: position, edge_u, edge_v, normal }, PI * cross.length());
        }
    }
    DVec3::ZERO
}

/// Centre and radius of the sphere around the scene's bounding box.
fn sphere_of_scene(scene: &Scene) -> (Vec3, f32) {
    let (lower, upper) = scene.bounds();
    let (l, u) = (lower.as_dvec3(), upper.as_dvec3());
    // The sphere is slightly enlarged, so that points moved outside by rounding are covered too.
    let radius = 0.5005 * (u - l).length() + ray_epsilon(lower.abs().max(upper.abs()), scene) as f64;
    (((l + u) * 0.5).as_vec3(), radius as f32)
}

/// Axis and 1 − cos(half-angle) of the cone in which the scene's bounding sphere appears from
/// `position`; the whole sphere of directions from inside of it.
fn cone_of_scene(scene: &Scene, position: Vec3) -> (Vec3, f64) {
    let (lower, upper) = scene.bounds();
    let (lower, upper) = (lower.as_dvec3(), upper.as_dvec3());
    let to_centre = (lower + upper) * 0.5 - position.as_dvec3();
    let distance = to_centre.length();
    // The cone is slightly larger than the sphere's, so that rounded directions cover its rim too.
    let radius = 0.5005 * (upper - lower).length() + ray_epsilon(position, scene) as f64;
    if distance <= radius {
        return (Vec3::Z, 2.0);
    }
    let sin2 = (radius / distance).powi(2);
    // 1 − cos without cancellation for distant lights.
    ((to_centre / distance).as_vec3(), sin2 / (1.0 + (1.0 - sin2).sqrt()))
}

/// The up to three faces of the scene's bounding box through which parallel light along `direction` enters, as corner
/// and edges, moved back against the light so that surfaces in a face are ahead.
fn lit_faces(scene: &Scene, direction: Vec3) -> Vec<(Vec3, Vec3, Vec3)> {
    let (lower, upper) = scene.bounds();
    let size = upper - lower;
    let back = (0.01 * scene.diagonal()).max(4.0 * ray_epsilon(lower.abs().max(upper.abs()), scene));
    let edge = |axis: usize| Vec3::AXES[axis] * size[axis];
    (0..3)
        .filter(|&axis| direction[axis] != 0.0)
        .map(|axis| {
            let mut corner = lower;
            if direction[axis] < 0.0 {
                corner[axis] = upper[axis];
            }
            (corner - direction * back, edge((axis + 1) % 3), edge((axis + 2) % 3))
        })
        .collect()
}

fn emitter_power(e: &Emitter) -> DVec3 {
    let sides = if e.two_sided { 2.0 } else { 1.0 };
    DVec3::from_array(e.radiance.map(f64::from)) * (sides * PI * e.area as f64)
}

fn mean(power: DVec3) -> f64 {
    power.element_sum() / 3.0
}

/// The direction around `axis` with the azimuth of a point of the unit disc and 1 − cos of its
/// angle to the axis given by `height` of the point's squared radius (uniform in [0, 1]).
#[inline]
fn around(axis: Vec3, [x, y]: [f32; 2], height: impl Fn(f32) -> f64) -> Vec3 {
    let r2 = (x * x + y * y).min(1.0);
    let h = height(r2);
    // sin θ / r; at the centre of the disc the direction is the axis.
    let spread = if r2 > 0.0 { (h * (2.0 - h) / r2 as f64).max(0.0).sqrt() as f32 } else { 0.0 };
    let (t, b) = orthonormal_basis(axis);
    (t * (x * spread) + b * (y * spread) + axis * (1.0 - h) as f32).normalize()
}
