//! Point and spot lights by place: those near a point are found.

use crate::scene::Light;
use glam::Vec3;

/// Point and spot lights, sorted along x.
pub(crate) struct NearLights {
    lights: Vec<Light>,
}

impl NearLights {
    /// Sorts point and spot lights; others are left out.
    pub(crate) fn new(mut lights: Vec<Light>) -> NearLights {
        lights.retain(|light| place(light).is_some());
        let x = |light: &Light| place(light).map_or(0.0, |at| at.x);
        lights.sort_unstable_by(|a, b| x(a).total_cmp(&x(b)));
        NearLights { lights }
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.lights.is_empty()
    }

    /// Returns the lights within a distance of a point, each with its position, in an order of their own.
    pub(crate) fn within(&self, distance: f32, of: Vec3) -> impl Iterator<Item = (&Light, Vec3)> {
        let placed = self.lights.iter().filter_map(|light| Some((light, place(light)?)));
        let first = self.lights.partition_point(|light| place(light).is_some_and(|at| at.x < of.x - distance));
        let along = placed.skip(first).take_while(move |(_, at)| at.x <= of.x + distance);
        along.filter(move |(_, at)| at.distance_squared(of) <= distance * distance)
    }
}

fn place(light: &Light) -> Option<Vec3> {
    match *light {
        Light::Point { position, .. } | Light::Spot { position, .. } => Some(position),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::sampling::uniform;

    #[test]
    fn all_lights_within_a_distance_are_found() {
        let at = |i: u32, seed: u32| Vec3::new(uniform(i, 0, seed), uniform(i, 1, seed), uniform(i, 2, seed));
        let positions: Vec<Vec3> = (0..500).map(|i| at(i, 1)).collect();
        let lights = positions.iter().map(|&position| Light::Point { position, intensity: [1.0; 3] });
        let near = NearLights::new(lights.collect());
        let mut all = 0;
        for i in 0..100 {
            let (of, distance) = (at(i, 2), 0.3 * uniform(i, 3, 2));
            let found = near.within(distance, of).count();
            assert_eq!(found, positions.iter().filter(|p| p.distance_squared(of) <= distance * distance).count());
            all += found;
        }
        assert!(all > 100, "{all}");
    }
}
