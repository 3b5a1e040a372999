//! A view for scenes that come without one.
//!
//! Candidate eyes are spread over the scene's bounds, at heights where people stand, and, if none of
//! these has a view, above floors at any height. An eye is inside if most rays from it meet something,
//! on the front where materials are one-sided and mostly on sides that the light map shows, and there
//! is a level floor below. From each inside eye the level directions with the longest free views over
//! lit surfaces are scored by the mean of length times light in a bundle of rays as wide as the
//! picture, by how far its middle goes, and by how many kinds of surface these meet: a bare wall is
//! nothing to look at. The best view with some air round the eye and little open sky wins. If no
//! inside eye sees light, or the eye is in a hollow object that is far brighter outside, the scene is
//! an object: it is looked at from outside, from where most of it is lit.

use bakelite::Scene;
use bakelite::lightmap::{Layer, Lightmap};
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
/// Directions from which an object is tried.
const SIDES: u32 = 16;
/// An inside eye sees at least this part of the probes end on something.
const ENCLOSED: f32 = 0.75;
/// The light map shows at least this part of what an eye sees.
const SHOWN: f32 = 0.8;
/// The floor is level and at most so far below, as a part of the scene's diagonal.
const LEVEL: f32 = 0.9;
const STANDING: f32 = 0.1;
/// How far above its floor an eye is that was put there, as a part of the diagonal.
const EYE_HEIGHT: f32 = 0.02;
/// Length that counts half as much as the longest, as a part of the diagonal: a view is more than its far end.
const FAR: f32 = 0.1;
/// Half of the angles that a picture covers, across and upwards, in rays of the bundle from its middle.
const ACROSS: i32 = 4;
const UPWARDS: i32 = 2;
/// Angle between two of them.
const STEP: f32 = 0.18;
/// A view shows at least this much light, where 1 is all surfaces far brighter than the usual.
const LIT: f32 = 0.25;
/// A hollow object shows this part of its surface from behind to an eye inside, and is this many times brighter outside.
const TURNED_OUT: f32 = 0.95;
const BRIGHTER: f32 = 5.0;
/// Vertical field of view.
const FOV: f32 = 60.0;

/// A view of a baked scene, whose up axis is the unit vector `up`. Depends on scene and light alone.
pub fn choose(lightmap: &Lightmap, up: Vec3) -> Camera {
    // The lower half of bounds that something far above widens has few floors.
    let (camera, is_inside) = view(lightmap, up, candidate);
    if is_inside { camera } else { view(lightmap, up, above_floor).0 }
}

/// The best view from the given candidates, or else from outside; and whether it is from inside.
fn view(lightmap: &Lightmap, up: Vec3, candidate: fn(&Scene, Vec3, u32) -> Vec3) -> (Camera, bool) {
    let scene = &**lightmap.scene();
    let eyes: Vec<(Vec3, (f32, f32))> = (0..EYES)
        .map(|i| candidate(scene, up, i))
        .filter(|&eye| stands(scene, up, eye) && is_shown(lightmap, eye))
        .filter_map(|eye| clearance(scene, eye).map(|air| (eye, air)))
        .collect();
    let light = Brightness::new(lightmap, eyes.iter().map(|&(eye, _)| eye));
    let views = eyes.iter().map(|&(eye, (air, enclosed))| {
        let (direction, score, lit) = best_view(scene, up, eye, &light);
        // Air counts up to 5 % of the diagonal: enough not to stare at a pillar.
        let air = (air / (0.05 * scene.diagonal())).min(1.0);
        (score * air * enclosed, lit, eye, direction)
    });
    let best = views.filter(|v| v.1 >= LIT).max_by(|a, b| a.0.total_cmp(&b.0));
    let from_outside = outside(scene, up, &light);
    let is_room = |eye: Vec3| {
        let (brightness, backs) = light.around(eye);
        backs < TURNED_OUT || light.seen_from(&from_outside) < BRIGHTER * brightness
    };
    match best {
        Some((_, _, eye, direction)) if is_room(eye) => {
            (Camera { position: eye, target: eye + direction, up, fov_y: FOV.to_radians() }, true)
        }
        _ => (from_outside, false),
    }
}

/// How bright surfaces are, relative to what is usual in the scene.
struct Brightness<'a> {
    lightmap: &'a Lightmap,
    /// The median irradiance of the lit surfaces that the eyes see.
    usual: f32,
}

impl<'a> Brightness<'a> {
    fn new(lightmap: &'a Lightmap, eyes: impl Iterator<Item = Vec3>) -> Self {
        let mut all = Brightness { lightmap, usual: 0.0 };
        let mut seen: Vec<f32> =
            eyes.flat_map(probes).filter_map(|ray| all.irradiance(&ray).map(|s| s.0)).filter(|&e| e > 0.0).collect();
        seen.sort_unstable_by(f32::total_cmp);
        all.usual = seen.get(seen.len() / 2).copied().unwrap_or(0.0);
        all
    }

    /// Irradiance where a ray ends, and how far that is. The side whose light is not known is dark.
    fn irradiance(&self, ray: &Ray) -> Option<(f32, f32)> {
        let hit = self.lightmap.scene().intersect_raw(ray);
        if hit.is_miss() {
            return None;
        }
        if !self.lightmap.shows(hit.triangle, hit.front) {
            return Some((0.0, hit.t));
        }
        let e = self.lightmap.sample(Layer::Combined, hit.triangle, hit.front, hit.u, hit.v);
        Some((e.iter().sum::<f32>() / 3.0, hit.t))
    }

    /// Mean irradiance around an eye, and the part of the surfaces there that it sees from behind.
    fn around(&self, eye: Vec3) -> (f32, f32) {
        let (mut sum, mut count, mut backs) = (0.0, 0, 0);
        for ray in probes(eye) {
            if let Some((e, _)) = self.irradiance(&ray) {
                sum += e;
                count += 1;
                backs += u32::from(!self.lightmap.scene().intersect_raw(&ray).front);
            }
        }
        let count = count.max(1) as f32;
        (sum / count, backs as f32 / count)
    }

    /// Mean irradiance of what a camera outside sees.
    fn seen_from(&self, camera: &Camera) -> f32 {
        let scene = self.lightmap.scene();
        let to = |k| camera.target + 0.25 * scene.diagonal() * uniform_sphere(sobol_2d(k, 1));
        let rays = (0..PROBES).map(|k| Ray::new(camera.position, to(k) - camera.position));
        let seen: Vec<f32> = rays.filter_map(|ray| self.irradiance(&ray).map(|s| s.0)).collect();
        seen.iter().sum::<f32>() / seen.len().max(1) as f32
    }

    /// 0 for a dark surface, 1/2 for a usual one, up to 1 for a bright one; and how far it is.
    fn lit(&self, ray: &Ray) -> Option<(f32, f32)> {
        self.irradiance(ray).map(|(e, t)| (if e > 0.0 { e / (e + self.usual) } else { 0.0 }, t))
    }
}

/// Eye number `i`: anywhere in plan, in the lower half by height.
fn candidate(scene: &Scene, up: Vec3, i: u32) -> Vec3 {
    within_bounds(scene, up, i, 0.1 + 0.4 * uniform(i, 2, 0))
}

/// Eye number `i`: anywhere in plan, above the next floor below any height.
fn above_floor(scene: &Scene, up: Vec3, i: u32) -> Vec3 {
    let from = within_bounds(scene, up, i, uniform(i, 2, 0));
    let floor = scene.intersect_raw(&Ray::new(from, -up));
    if floor.is_miss() { from } else { from + up * (EYE_HEIGHT * scene.diagonal() - floor.t) }
}

/// Place number `i` at a height from 0, the lowest of the bounds, to 1.
fn within_bounds(scene: &Scene, up: Vec3, i: u32, height: f32) -> Vec3 {
    let (lower, upper) = scene.bounds();
    let [a, b] = sobol_2d(i, 0);
    let plan = Vec3::new(a, b, height);
    // The third coordinate belongs to the up axis.
    let t = if up.x > 0.5 { Vec3::new(plan.z, plan.x, plan.y) } else { plan };
    let t = if up.y > 0.5 { Vec3::new(plan.x, plan.z, plan.y) } else { t };
    lower + (upper - lower) * t
}

/// Whether somebody can stand there.
fn stands(scene: &Scene, up: Vec3, eye: Vec3) -> bool {
    let (x, body) = (up.any_orthonormal_vector(), 0.01 * scene.diagonal());
    let y = up.cross(x);
    [Vec3::ZERO, x, -x, y, -y].into_iter().all(|aside| {
        let floor = scene.intersect_raw(&Ray::new(eye + body * aside, -up).within(0.0, STANDING * scene.diagonal()));
        !floor.is_miss() && scene.normal(floor.triangle).dot(up).abs() > LEVEL
    })
}

/// Rays from an eye in all directions, which tell what surrounds it.
fn probes(eye: Vec3) -> impl Iterator<Item = Ray> {
    (0..PROBES).map(move |i| Ray::new(eye, uniform_sphere(sobol_2d(i, 1))))
}

/// Whether the light map shows most of what an eye sees, as it does not where nobody gets to, in hollow walls.
fn is_shown(lightmap: &Lightmap, eye: Vec3) -> bool {
    let (mut count, mut shown) = (0, 0);
    for hit in probes(eye).map(|ray| lightmap.scene().intersect_raw(&ray)).filter(|hit| !hit.is_miss()) {
        count += 1;
        shown += u32::from(lightmap.shows(hit.triangle, hit.front));
    }
    shown as f32 >= SHOWN * count as f32
}

/// Distance to the nearest surface that probes find, and a weight by how many find any, from 0 for half of them to 1;
/// `None` if the eye is not inside.
fn clearance(scene: &Scene, eye: Vec3) -> Option<(f32, f32)> {
    let (mut hits, mut backs, mut nearest) = (0, 0, f32::INFINITY);
    for ray in probes(eye) {
        let hit = scene.intersect_raw(&ray);
        if hit.is_miss() {
            continue;
        }
        hits += 1;
        backs += u32::from(!hit.front && !scene.material(hit.triangle).two_sided);
        nearest = nearest.min(hit.t);
    }
    let inside = hits as f32 >= ENCLOSED * PROBES as f32 && backs * 20 <= hits;
    let enclosed = 2.0 * hits as f32 / PROBES as f32 - 1.0;
    (inside && nearest > 0.01 * scene.diagonal()).then_some((nearest, enclosed * enclosed))
}

/// The level direction in which a bundle of rays gets farthest over lit surfaces: the direction, the
/// mean of length (up to a limit) times light, as far as it has variety, and the mean light.
fn best_view(scene: &Scene, up: Vec3, eye: Vec3, light: &Brightness) -> (Vec3, f32, f32) {
    let level = up.any_orthonormal_vector();
    let far = FAR * scene.diagonal();
    let count = ((2 * ACROSS + 1) * (2 * UPWARDS + 1)) as f32;
    let score = |azimuth: f32| -> (Vec3, f32, f32) {
        let forward = Quat::from_axis_angle(up, azimuth) * level;
        let (mut score, mut lit, mut middle) = (0.0, 0.0, 0.0);
        // A ray's kind of surface: which way it faces, and how far away it is, in halves of octaves.
        let mut kinds = Vec::new();
        for (across, upwards) in (-ACROSS..=ACROSS).flat_map(|a| (-UPWARDS..=UPWARDS).map(move |u| (a, u))) {
            let turned = Quat::from_axis_angle(up, across as f32 * STEP) * forward;
            let direction = (turned + up * (upwards as f32 * STEP)).normalize();
            // Into the open is nothing to look at.
            let ray = Ray::new(eye, direction);
            let (l, t) = light.lit(&ray).unwrap_or((LIT, 0.0));
            score += l * t / (t + far) / count;
            // What is in the middle is looked at: not a pillar just in front.
            middle += if across.abs() <= 1 && upwards.abs() <= 1 { t / (t + far) } else { 0.0 };
            lit += l / count;
            if t > 0.0 {
                let normal = scene.normal(scene.intersect_raw(&ray).triangle);
                kinds.push(((2.0 * (t / far).log2()) as i32, (2.0 * normal).round().as_ivec3().to_array()));
            }
        }
        kinds.sort_unstable();
        kinds.dedup();
        (forward, score * middle * kinds.len() as f32 / count, lit)
    };
    let views = (0..DIRECTIONS).map(|i| score(TAU * i as f32 / DIRECTIONS as f32));
    views.max_by(|a, b| a.1.total_cmp(&b.1)).unwrap_or((level, 0.0, 0.0))
}

/// From outside, a little from above, so that the bounds' sphere fills the picture.
fn outside(scene: &Scene, up: Vec3, light: &Brightness) -> Camera {
    let (lower, upper) = scene.bounds();
    let middle = 0.5 * (lower + upper);
    let distance = 0.5 * scene.diagonal() / (0.5 * FOV.to_radians()).sin();
    let view = |i: u32| {
        let level = Quat::from_axis_angle(up, TAU * (i as f32 + 0.5) / SIDES as f32) * up.any_orthonormal_vector();
        let position = middle + (level + 0.4 * up).normalize() * distance;
        let rays = (0..PROBES).map(|k| {
            let target = middle + 0.25 * scene.diagonal() * uniform_sphere(sobol_2d(k, 1));
            light.lit(&Ray::new(position, target - position)).map_or(0.0, |l| l.0)
        });
        (position, rays.sum::<f32>())
    };
    let best = (0..SIDES).map(view).max_by(|a, b| a.1.total_cmp(&b.1));
    let position = best.map_or(middle + up * distance, |b| b.0);
    Camera { position, target: middle, up, fov_y: FOV.to_radians() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use bakelite::bvh::BuildOptions;
    use bakelite::lightmap::{BakeParams, LightmapDesc};
    use bakelite::scene::{Light, MeshMaterials, builtin};
    use bakelite::{Device, Material, Mesh, Progress, SceneData};

    fn baked(data: SceneData, texels_per_unit: f32) -> Lightmap {
        let device = Device::new(Default::default()).unwrap();
        let none = Progress::none();
        let scene = Scene::commit(&device, data, &BuildOptions::default(), &none).map_err(|e| e.1).unwrap();
        let desc = LightmapDesc { texels_per_unit, page_size: 256, ..Default::default() };
        let mut lightmap = Lightmap::create(&scene, &desc, &none).unwrap();
        lightmap.bake(&BakeParams { photon_count: 10_000, gather_rays: 16, ..Default::default() }, &none).unwrap();
        lightmap
    }

    #[test]
    fn the_view_of_a_room_is_inside_it_and_shows_light() {
        let lightmap = baked(builtin("atrium").unwrap(), 4.0);
        let scene = lightmap.scene();
        let camera = choose(&lightmap, Vec3::Y);
        assert!(camera.position.x.abs() < 10.0 && camera.position.z.abs() < 5.8, "{camera:?}");
        assert!(clearance(scene, camera.position).is_some());
        let ray = Ray::new(camera.position, (camera.target - camera.position).normalize());
        assert!(scene.intersect_raw(&ray).t > 4.0);
        let light = Brightness::new(&lightmap, [camera.position].into_iter());
        assert!(best_view(scene, Vec3::Y, camera.position, &light).2 >= LIT);
    }

    /// The atrium, and a sheet high above it.
    #[test]
    fn something_far_above_does_not_move_the_view_out_of_the_room() {
        let mut data = builtin("atrium").unwrap();
        let material = data.add_material(Material::default()).unwrap();
        let positions = [Vec3::ZERO, Vec3::X, Vec3::Z].map(|p| p + 120.0 * Vec3::Y);
        data.add_mesh(Mesh {
            positions: positions.to_vec().into(),
            indices: vec![[0, 1, 2]].into(),
            materials: MeshMaterials::One(material),
            ..Default::default()
        })
        .unwrap();
        let camera = choose(&baked(data, 4.0), Vec3::Y);
        assert!(camera.position.x.abs() < 10.0 && camera.position.z.abs() < 5.8, "{camera:?}");
        assert!(camera.position.y < 10.0, "{camera:?}");
    }

    /// A two-sided tetrahedron, which rays from within find closed, but dark.
    #[test]
    fn an_object_is_looked_at_from_outside_and_from_the_lit_side() {
        let mut data = SceneData::new();
        let material = data.add_material(Material { two_sided: true, ..Default::default() }).unwrap();
        let positions = vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z];
        let indices = vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]];
        data.add_mesh(Mesh {
            positions: positions.into(),
            indices: indices.into(),
            materials: MeshMaterials::One(material),
            ..Default::default()
        })
        .unwrap();
        data.add_light(Light::Directional {
            direction: Vec3::new(-1.0, -0.1, -0.2),
            irradiance: [1.0; 3],
            angular_radius: 0.0,
        })
        .unwrap();
        let camera = choose(&baked(data, 16.0), Vec3::Z);
        assert!(camera.position.z > 1.0 && camera.position.x > 1.0 && camera.target == Vec3::splat(0.5), "{camera:?}");
    }
}
