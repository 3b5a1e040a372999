//! Point and spot lights by place: those near a point are found.

use crate::scene::Light;
use glam::Vec3;

/// Point and spot lights in the order of their positions along one axis.
pub(crate) struct NearLights {
    lights: Vec<Light>,
    axis: usize,
}

impl NearLights {
    /// Sorts point and spot lights along the axis in which they are spread most.
    pub(crate) fn new(mut lights: Vec<Light>) -> NearLights {
        let positions = || lights.iter().map(position);
        let lower = positions().fold(Vec3::INFINITY, Vec3::min);
        let axis = (positions().fold(Vec3::NEG_INFINITY, Vec3::max) - lower).max_position();
        lights.sort_by(|a, b| position(a)[axis].total_cmp(&position(b)[axis]));
        NearLights { lights, axis }
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.lights.is_empty()
    }

    /// Returns the lights within the root of `distance2` of a point, each with its position.
    pub(crate) fn within(&self, distance2: f32, of: Vec3) -> impl Iterator<Item = (&Light, Vec3)> {
        let (axis, distance) = (self.axis, distance2.sqrt() * (1.0 + f32::EPSILON));
        let first = self.lights.partition_point(|light| position(light)[axis] < of[axis] - distance);
        let placed = self.lights[first..].iter().map(|light| (light, position(light)));
        let along = placed.take_while(move |(_, at)| at[axis] <= of[axis] + distance);
        along.filter(move |(_, at)| at.distance_squared(of) <= distance2)
    }
}

fn position(light: &Light) -> Vec3 {
    match *light {
        Light::Point { position, .. } | Light::Spot { position, .. } => position,
        _ => unreachable!("only point and spot lights are put in order"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::sampling::uniform;

    #[test]
    fn all_lights_within_a_distance_are_found() {
        let at = |i: u32, seed: u32| Vec3::new(uniform(i, 0, seed), uniform(i, 1, seed), uniform(i, 2, seed));
        // In a cube, and on a plane.
        for spread in [Vec3::ONE, Vec3::new(0.0, 0.7, 1.0)] {
            let positions: Vec<Vec3> = (0..500).map(|i| at(i, 1) * spread).collect();
            let lights = positions.iter().map(|&position| Light::Point { position, intensity: [1.0; 3] });
            let near = NearLights::new(lights.collect());
            let mut all = 0;
            for i in 0..100 {
                let (of, distance2) = (at(i, 2) * spread, 0.1 * uniform(i, 3, 2));
                let found = near.within(distance2, of).count();
                assert_eq!(found, positions.iter().filter(|p| p.distance_squared(of) <= distance2).count());
                all += found;
            }
            assert!(all > 100, "{all}");
        }
    }
}
