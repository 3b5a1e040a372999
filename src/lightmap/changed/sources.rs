//! What gives direct light, as volumes, to tell whether what moved lies between them and a surface.

use crate::base::bounds::Bounds;
use crate::base::error::Result;
use crate::base::memory::{try_collect, try_push};
use crate::lightmap::moved::merged;
use crate::scene::{Environment, Light as Lamp, Scene};
use glam::Vec3;
use std::f32::consts::PI;

const SOURCES: &str = "what gives direct light";

/// Number of pairs of a source and of what moved between it and points, beyond which all of these count as shadowed: testing
/// each takes longer than its direct light.
const MOST_CUTS: usize = 16;

/// Radius in radians from which on the disc of a directional light counts as a sky.
const WIDE: f32 = 0.5;

/// Maximum number of boxes around emissive triangles.
const MOST_EMITTERS: usize = 64;

/// Where light comes from.
enum Source {
    /// From a box, which may be a point.
    Near(Bounds),
    /// From infinitely far away, up to an angle with this tangent from a direction.
    Far { direction: Vec3, spread: f32 },
    /// From everywhere: the brightest radiance, as a multiple of the mean.
    Sky(f32),
}

/// Returns what gives direct light.
fn sources(scene: &Scene) -> Result<Vec<Source>> {
    let mut sources = Vec::new();
    let around = |points: &[Vec3]| {
        let mut bounds = Bounds::EMPTY;
        points.iter().for_each(|&point| bounds.add(point));
        bounds
    };
    for light in scene.lights().iter().filter(|light| light.color() != [0.0; 3]) {
        let source = match *light {
            Lamp::Point { position, .. } | Lamp::Spot { position, .. } => Source::Near(around(&[position])),
            Lamp::Rect { position, edge_u, edge_v, .. } => {
                Source::Near(around(&[Vec3::ZERO, edge_u, edge_v, edge_u + edge_v].map(|edge| position + edge)))
            }
            Lamp::Directional { angular_radius, .. } if angular_radius > WIDE => Source::Sky(1.0),
            Lamp::Directional { direction, angular_radius, .. } => {
                Source::Far { direction: -direction.normalize_or_zero(), spread: angular_radius.tan() }
            }
            Lamp::Sky { environment, .. } => {
                Source::Sky(scene.environments().get(environment as usize).map_or(1.0, |e| contrast(e)))
            }
        };
        try_push(&mut sources, source, SOURCES)?;
    }
    let emitters =
        scene.emitters().iter().map(|e| around(&[Vec3::ZERO, e.edge_u, e.edge_v].map(|edge| e.corner + edge)));
    for bounds in merged(try_collect(emitters, SOURCES)?, MOST_EMITTERS) {
        try_push(&mut sources, Source::Near(bounds), SOURCES)?;
    }
    Ok(sources)
}

/// Returns the brightest radiance of an environment as a multiple of the mean of its pixels.
fn contrast(environment: &Environment) -> f32 {
    let sums = || environment.rgb().iter().map(|pixel| pixel.iter().sum::<f32>());
    let mean = sums().map(f64::from).sum::<f64>() / sums().count().max(1) as f64;
    if mean > 0.0 { (f64::from(sums().fold(0.0, f32::max)) / mean) as f32 } else { 1.0 }
}

impl Source {
    /// Whether what moved may lie between points and the source. `part`: a bound of the part of the hemisphere that all
    /// of it takes, and the part that matters.
    fn is_cut(&self, points: &Bounds, moved: &Bounds, part: (f32, f32)) -> bool {
        match *self {
            Source::Near(end) => points.sweeps(end.lower - points.lower, end.upper - points.upper, 1.0, moved),
            Source::Far { direction, spread } => {
                // A unit vector of a cone differs from its axis by no more in any coordinate.
                points.sweeps(direction - spread, direction + spread, f32::INFINITY, moved)
            }
            // A sun in a sky may be hidden by what takes next to nothing of the hemisphere.
            Source::Sky(contrast) => part.0 * contrast > part.1,
        }
    }
}

/// Pairs of a source and of what moved, by number, that may lie between it and points.
pub(super) type Cuts = Vec<(u32, u32)>;

/// What gives direct light, and what moved, which may hide it.
pub(super) struct Shadows<'a> {
    sources: Vec<Source>,
    boxes: &'a [Bounds],
    /// Relative difference of light that is let stand.
    keep_error: f32,
}

impl<'a> Shadows<'a> {
    pub fn new(scene: &Scene, boxes: &'a [Bounds], keep_error: f32) -> Result<Shadows<'a>> {
        Ok(Shadows { sources: sources(scene)?, boxes, keep_error })
    }

    /// Whether anything that moved may lie between points and a source. `part`: a bound of the part of the hemisphere that all
    /// of it takes.
    pub fn is_any_cut(&self, points: &Bounds, part: f32) -> bool {
        let is_cut = |moved: &Bounds| self.sources.iter().any(|s| s.is_cut(points, moved, (part, self.keep_error)));
        self.boxes.iter().any(is_cut)
    }

    /// Returns which of what moved may lie between points and which sources: at most one pair more than [`MOST_CUTS`].
    pub fn cuts(&self, points: &Bounds) -> Result<Cuts> {
        let part = self.part(points);
        let pairs = (0..).zip(&self.sources).flat_map(|(s, source)| {
            let cut = (0..).zip(self.boxes).filter(move |(_, moved)| source.is_cut(points, moved, part));
            cut.map(move |(b, _)| (s, b))
        });
        try_collect(pairs.take(MOST_CUTS + 1), SOURCES)
    }

    /// Whether what moved may lie between points and a source, given the cuts of a region around them.
    pub fn is_cut(&self, points: &Bounds, cuts: &[(u32, u32)]) -> bool {
        if cuts.is_empty() || cuts.len() > MOST_CUTS {
            return !cuts.is_empty();
        }
        let part = self.part(points);
        cuts.iter().any(|&(s, b)| self.sources[s as usize].is_cut(points, &self.boxes[b as usize], part))
    }

    /// A bound of the part of light that all of what moved takes, and the part that matters.
    fn part(&self, points: &Bounds) -> (f32, f32) {
        (self.boxes.iter().map(|moved| part_of_light(points, moved)).sum(), self.keep_error)
    }
}

/// Returns a bound of the part of the light of a surface in `from` that a box takes: of a convex body at distance d, at
/// most half of its surface is seen, and all of it as if facing the surface.
pub(super) fn part_of_light(from: &Bounds, moved: &Bounds) -> f32 {
    let d = from.distance(moved);
    if d > 0.0 { 0.5 * moved.area() / (PI * d * d) } else { f32::INFINITY }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::SceneData;
    use crate::scene::demo::shapes::MeshBuilder;
    use crate::scene::{Material, NONE};

    #[test]
    fn what_hides_the_sun_of_a_sky_lies_between_however_small_it_is() {
        let is_cut = |image: Option<f32>| {
            let mut data = SceneData::new();
            let material = data.add_material(Material::default()).unwrap();
            let mut room = MeshBuilder::new();
            room.box_(Vec3::ZERO, Vec3::ONE, false, material);
            data.add_mesh(room.finish()).unwrap();
            let pixel = |sun: f32, i: usize| [if i == 40 { sun } else { 1.0 }; 3];
            let environment = image.map_or(NONE, |sun| {
                let pixels = (0..128).map(|i| pixel(sun, i)).collect();
                data.add_environment(Environment::new(16, 8, pixels).unwrap())
            });
            data.add_light(Lamp::Sky { radiance: [1.0; 3], environment, up: Vec3::Y, rotation: 0.0 }).unwrap();
            let sources = sources(&data.committed()).unwrap();
            let (from, moved) = ([Vec3::ZERO; 2], [Vec3::new(9.0, 9.0, 9.0), Vec3::splat(10.0)]);
            let [from, moved] = [from, moved].map(|[lower, upper]| Bounds { lower, upper });
            let part = part_of_light(&from, &moved);
            assert!((0.001..0.01).contains(&part), "{part}");
            sources[0].is_cut(&from, &moved, (part, 0.03))
        };
        assert_eq!([None, Some(1.0), Some(1000.0)].map(is_cut), [false, false, true]);
    }
}
