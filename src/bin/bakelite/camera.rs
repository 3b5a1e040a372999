//! A view for scenes that come without one.
//!
//! Candidate eyes are spread over the scene's bounds, at heights where people stand. An eye is
//! inside if most rays from it meet something, on the front where materials are one-sided. From each
//! inside eye the level directions with the longest free views are scored by the mean length of a
//! bundle of rays as wide as the picture; the best view with some air round the eye wins. If no eye
//! is inside, the scene is an object: it is looked at from outside.

use bakelite::Scene;
use bakelite::sampling::{sobol_2d, uniform, uniform_sphere};
use bakelite::scene::Camera;
use bakelite::trace::Ray;
use glam::{Quat, Vec3};
use std::f32::consts::TAU;

/// Eyes tried.
const EYES: u32 = 512;
/// Rays that tell what surrounds an eye.
const PROBES: u32 = 64;
/// Directions tried from an eye.
const DIRECTIONS: u32 = 24;
/// An inside eye sees at least this part of the probes end on something.
const ENCLOSED: f32 = 0.6;
/// Vertical field of view.
const FOV: f32 = 60.0;

/// A view of `scene`, whose up axis is the unit vector `up`. Depends on the scene alone.
pub fn choose(scene: &Scene, up: Vec3) -> Camera {
    let best = (0..EYES).filter_map(|i| {
        let eye = candidate(scene, up, i);
        let air = clearance(scene, eye)?;
        let (direction, length) = longest_view(scene, up, eye);
        // Air counts up to 5 % of the diagonal: enough not to stare at a pillar.
        let air = (air / (0.05 * scene.diagonal())).min(1.0);
        Some((length * air, eye, direction))
    });
    let best = best.max_by(|a, b| a.0.total_cmp(&b.0));
    match best {
        Some((_, eye, direction)) => Camera { position: eye, target: eye + direction, up, fov_y: FOV.to_radians() },
        None => outside(scene, up),
    }
}

/// Eye number `i`: anywhere in plan, in the lower half by height.
fn candidate(scene: &Scene, up: Vec3, i: u32) -> Vec3 {
    let (lower, upper) = scene.bounds();
    let [a, b] = sobol_2d(i, 0);
    let plan = Vec3::new(a, b, 0.1 + 0.4 * uniform(i, 2, 0));
    // The third coordinate belongs to the up axis.
    let t = if up.x > 0.5 { Vec3::new(plan.z, plan.x, plan.y) } else { plan };
    let t = if up.y > 0.5 { Vec3::new(plan.x, plan.z, plan.y) } else { t };
    lower + (upper - lower) * t
}

/// Distance to the nearest surface that probes find; `None` if the eye is not inside.
fn clearance(scene: &Scene, eye: Vec3) -> Option<f32> {
    let (mut hits, mut backs, mut nearest) = (0, 0, f32::INFINITY);
    for i in 0..PROBES {
        let direction = uniform_sphere(sobol_2d(i, 1));
        let hit = scene.intersect_raw(&Ray::new(eye, direction));
        if hit.is_miss() {
            continue;
        }
        hits += 1;
        backs += (!scene.material(hit.triangle).two_sided && scene.normal(hit.triangle).dot(direction) > 0.0) as u32;
        nearest = nearest.min(hit.t);
    }
    let inside = hits as f32 >= ENCLOSED * PROBES as f32 && backs * 20 <= hits;
    (inside && nearest > 0.01 * scene.diagonal()).then_some(nearest)
}

/// The level direction in which a bundle of rays gets farthest on average, and how far.
fn longest_view(scene: &Scene, up: Vec3, eye: Vec3) -> (Vec3, f32) {
    let level = up.any_orthonormal_vector();
    let far = scene.diagonal();
    let score = |azimuth: f32| -> f32 {
        let rays = (0..15).map(|i| {
            let turned = Quat::from_axis_angle(up, azimuth + ((i % 5) as f32 - 2.0) * 0.2) * level;
            let direction = (turned + up * ((i / 5) as f32 - 1.0) * 0.2).normalize();
            let hit = scene.intersect_raw(&Ray::new(eye, direction));
            // Into the open is nothing to look at.
            if hit.is_miss() { 0.1 * far } else { hit.t.min(far) }
        });
        rays.sum::<f32>() / 15.0
    };
    let azimuths = (0..DIRECTIONS).map(|i| TAU * i as f32 / DIRECTIONS as f32);
    let (azimuth, length) = azimuths.map(|a| (a, score(a))).max_by(|a, b| a.1.total_cmp(&b.1)).unwrap_or_default();
    (Quat::from_axis_angle(up, azimuth) * level, length)
}

/// From outside, a little from above, so that the bounds' sphere fills the picture.
fn outside(scene: &Scene, up: Vec3) -> Camera {
    let (lower, upper) = scene.bounds();
    let middle = 0.5 * (lower + upper);
    let level = up.any_orthonormal_vector();
    let direction = (level + 0.6 * up.cross(level) + 0.4 * up).normalize();
    let distance = 0.5 * scene.diagonal() / (0.5 * FOV.to_radians()).sin();
    Camera { position: middle + direction * distance, target: middle, up, fov_y: FOV.to_radians() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use bakelite::bvh::BuildOptions;
    use bakelite::scene::{MeshMaterials, builtin};
    use bakelite::{Device, Material, Mesh, Progress, SceneData};
    use std::sync::Arc;

    fn commit(data: SceneData) -> Arc<Scene> {
        let device = Device::new(Default::default()).unwrap();
        Scene::commit(&device, data, &BuildOptions::default(), &Progress::none()).map_err(|e| e.1).unwrap()
    }

    #[test]
    fn the_view_of_a_room_is_inside_it() {
        let scene = commit(builtin("atrium").unwrap());
        let camera = choose(&scene, Vec3::Y);
        assert!(camera.position.x.abs() < 10.0 && camera.position.z.abs() < 5.8, "{camera:?}");
        assert!(clearance(&scene, camera.position).is_some());
        let ray = Ray::new(camera.position, (camera.target - camera.position).normalize());
        assert!(scene.intersect_raw(&ray).t > 4.0);
    }

    #[test]
    fn an_object_is_looked_at_from_outside() {
        let mut data = SceneData::new();
        let material = data.add_material(Material::default()).unwrap();
        let positions = vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z];
        let indices = vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]];
        data.add_mesh(Mesh { positions, indices, materials: MeshMaterials::One(material), ..Default::default() })
            .unwrap();
        let scene = commit(data);
        let camera = choose(&scene, Vec3::Z);
        assert!(camera.position.z > 1.0 && camera.target == Vec3::splat(0.5));
    }
}
