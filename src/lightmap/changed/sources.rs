//! What gives direct light, as volumes, to tell whether what moved lies between them and a surface.

use crate::base::bounds::Bounds;
use crate::base::error::Result;
use crate::base::memory::{try_collect, try_push};
use crate::lightmap::moved::merged;
use crate::scene::{Light as Lamp, Scene};
use glam::Vec3;
use std::f32::consts::PI;

const SOURCES: &str = "what gives direct light";

/// Radius in radians from which on the disc of a directional light counts as a sky.
const WIDE: f32 = 0.5;

/// Maximum number of boxes around emissive triangles.
const MOST_EMITTERS: usize = 64;

/// Where light comes from.
pub(in crate::lightmap) enum Source {
    /// From a box, which may be a point.
    Near(Bounds),
    /// From infinitely far away, up to an angle with this tangent from a direction.
    Far { direction: Vec3, spread: f32 },
    /// From everywhere.
    Sky,
}

/// Returns what gives direct light.
pub(in crate::lightmap) fn sources(scene: &Scene) -> Result<Vec<Source>> {
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
            Lamp::Directional { angular_radius, .. } if angular_radius > WIDE => Source::Sky,
            Lamp::Directional { direction, angular_radius, .. } => {
                Source::Far { direction: -direction.normalize_or_zero(), spread: angular_radius.tan() }
            }
            Lamp::Sky { .. } => Source::Sky,
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

impl Source {
    /// Whether what moved may lie between points and the source. `part`: a bound of the part of the hemisphere that all
    /// of it takes, and the part that matters.
    pub fn is_cut(&self, points: &Bounds, moved: &Bounds, part: (f32, f32)) -> bool {
        match *self {
            Source::Near(end) => points.sweeps(end.lower - points.lower, end.upper - points.upper, 1.0, moved),
            Source::Far { direction, spread } => {
                // A unit vector of a cone differs from its axis by no more in any coordinate.
                points.sweeps(direction - spread, direction + spread, f32::INFINITY, moved)
            }
            Source::Sky => part.0 > part.1,
        }
    }
}

/// Returns a bound of the part of the light of a surface in `from` that a box takes: of a convex body at distance d, at
/// most half of its surface is seen, and all of it as if facing the surface.
pub(super) fn part_of_light(from: &Bounds, moved: &Bounds) -> f32 {
    let d = from.distance(moved);
    if d > 0.0 { 0.5 * moved.area() / (PI * d * d) } else { f32::INFINITY }
}
