//! Places where somebody can stand in the rooms of a scene, from which reports look at its light.
//!
//! From interior positions that are known (the camera's, those of lamps), free space is explored by lines of sight as
//! wide as a body, which do not fit through cracks and into hollow walls. A place has surfaces around it, no backs of
//! one-sided ones, and a floor below.

use bakelite::Scene;
use bakelite::sampling::{orthonormal_basis, uniform, uniform_sphere};
use bakelite::trace::{RawHit, Ray};
use glam::Vec3;

/// Places that are looked for.
const PLACES: usize = 50;

/// Fewer of them with a floor below are not enough: the others count, too.
const FEW: usize = 8;

/// Free space around a place, as a part of the [size](size_around) of what is around it.
const BODY: f32 = 0.01;

/// A floor is at most so far below, as a part of that [size](size_around).
const STANDING: f32 = 0.1;

/// The size of what is around a place is at most this many times the median distance to what is seen from there, so that a wide
/// ground around a house does not count.
const LARGE: f32 = 20.0;

/// Part of the directions in which a place inside sees surfaces, and a place beside an object.
const ENCLOSED: f32 = 0.5;
const BESIDE: f32 = 0.03;

/// Directions that tell what surrounds a place.
const PROBES: u32 = 64;

/// Places tried before they may be closer together.
const TRIES: u32 = 2000;

/// Distance of places to begin with, as a part of that [size](size_around), what it shrinks by, and how often it does.
const SPREAD: f32 = 0.2;
const SHRINK: f32 = 0.7;
const ROUNDS: i32 = 16;

/// Finds places that can be reached from some of `known`, spread evenly, others for each seed. Empty if none of `known` is in
/// free space.
pub fn find(scene: &Scene, known: &[Vec3], up: Vec3, seed: u32) -> Vec<Vec3> {
    let sizes: Vec<(Vec3, f32)> = known.iter().map(|&place| (place, size_around(scene, place))).collect();
    let free = |enclosed: f32| -> Vec<(Vec3, f32)> {
        sizes.iter().copied().filter(|&(place, size)| is_free(scene, place, enclosed, BODY * size)).collect()
    };
    let indoors = free(ENCLOSED);
    let (enclosed, known) = if indoors.is_empty() { (BESIDE, free(BESIDE)) } else { (ENCLOSED, indoors) };
    // A lamp in its housing sees nothing but that.
    let size = known.iter().map(|&(_, size)| size).fold(0.0, f32::max);
    let body = BODY * size;
    let mut found: Vec<Vec3> =
        known.iter().map(|&(place, _)| place).filter(|&p| is_free(scene, p, enclosed, body)).collect();
    let stands = |p: &&Vec3| {
        let floor = Ray::new(**p, -up).within(0.0, STANDING * size);
        !scene.intersect_raw(&floor).is_miss()
    };
    for round in 0..ROUNDS {
        if found.is_empty() || found.iter().filter(stands).count() >= PLACES {
            break;
        }
        let spread = SPREAD * size * SHRINK.powi(round);
        for i in 0..TRIES {
            let random = |dimension| uniform(i, dimension, seed.wrapping_mul(ROUNDS as u32) + round as u32);
            let from = found[(random(0) * found.len() as f32) as usize];
            let direction = uniform_sphere([random(1), random(2)]);
            let place = from + direction * (random(3) * way(scene, from, direction, body));
            let is_new = found.iter().all(|p| p.distance(place) >= spread);
            if is_new && is_free(scene, place, enclosed, body) {
                found.push(place);
            }
        }
    }
    let standing: Vec<Vec3> = found.iter().filter(stands).copied().collect();
    if standing.len() < FEW { found } else { standing }
}

/// How far a body gets from a place.
fn way(scene: &Scene, from: Vec3, direction: Vec3, body: f32) -> f32 {
    let (x, y) = orthonormal_basis(direction);
    let free = |aside: Vec3| scene.intersect_raw(&Ray::new(from + 0.7 * body * aside, direction)).t;
    let nearest = [Vec3::ZERO, x, -x, y, -y].into_iter().map(free).fold(scene.diagonal(), f32::min);
    (nearest - body).max(0.0)
}

/// What rays in all directions from a place hit; misses are left out.
fn look_around(scene: &Scene, place: Vec3) -> impl Iterator<Item = RawHit> {
    let direction = |i| uniform_sphere([uniform(i, 0, 1), uniform(i, 1, 1)]);
    (0..PROBES).map(move |i| scene.intersect_raw(&Ray::new(place, direction(i)))).filter(|hit| !hit.is_miss())
}

/// Size of what is around a place: the scene's diagonal, unless most of what is seen is much nearer.
fn size_around(scene: &Scene, place: Vec3) -> f32 {
    let mut distances: Vec<f32> = look_around(scene, place).map(|hit| hit.t).collect();
    distances.sort_unstable_by(f32::total_cmp);
    distances.get(distances.len() / 2).map_or(0.0, |median| (LARGE * median).min(scene.diagonal()))
}

/// Whether a place has room for a `body` of that radius, sees surfaces in a part `enclosed` of all directions, and none from inside a
/// solid.
fn is_free(scene: &Scene, place: Vec3, enclosed: f32, body: f32) -> bool {
    let (mut hits, mut backs, mut nearest) = (0, 0, f32::INFINITY);
    for hit in look_around(scene, place) {
        hits += 1;
        backs += u32::from(!hit.front && !scene.material(hit.triangle).two_sided);
        nearest = nearest.min(hit.t);
    }
    hits as f32 >= enclosed * PROBES as f32 && backs * 20 <= hits && nearest > body
}

#[cfg(test)]
mod tests {
    use super::*;
    use bakelite::bvh::BuildOptions;
    use bakelite::scene::shapes::MeshBuilder;
    use bakelite::scene::{Material, SceneData};
    use bakelite::{Device, Progress};
    use std::sync::Arc;

    /// Two rooms with a door between them, and a solid block in the first; walls are hollow.
    fn rooms(two_sided: bool) -> Arc<Scene> {
        let mut data = SceneData::new();
        let m = data.add_material(Material { two_sided, ..Default::default() }).unwrap();
        let p = Vec3::new;
        let mut b = MeshBuilder::new();
        b.box_(p(0.0, 0.0, 0.0), p(10.0, 3.0, 5.0), true, m);
        b.box_(p(-0.3, -0.3, -0.3), p(10.3, 3.3, 5.3), false, m);
        // The wall between the rooms leaves a door of 1 m.
        b.box_(p(4.9, -0.1, -0.1), p(5.1, 3.1, 4.0), false, m);
        b.box_(p(1.0, 0.0, 1.0), p(2.5, 2.0, 2.5), false, m);
        data.add_mesh(b.finish()).unwrap();
        let device = Device::new(Default::default()).unwrap();
        Scene::commit(&device, data, &BuildOptions::default(), &Progress::none()).map_err(|e| e.1).unwrap()
    }

    #[test]
    fn places_are_in_all_rooms_and_neither_in_walls_nor_solids_nor_outside() {
        for two_sided in [false, true] {
            let scene = rooms(two_sided);
            let places = find(&scene, &[Vec3::new(0.5, 1.5, 4.0), Vec3::new(-9.0, 1.0, 1.0)], Vec3::Y, 0);
            assert!(places.len() >= PLACES, "{}", places.len());
            for p in &places {
                let block = p.x > 1.0 && p.x < 2.5 && p.y < 2.0 && p.z > 1.0 && p.z < 2.5;
                let in_room = p.cmpgt(Vec3::ZERO).all() && p.cmplt(Vec3::new(10.0, 3.0, 5.0)).all();
                let in_wall = p.x > 4.9 && p.x < 5.1 && p.z < 4.0;
                assert!(in_room && !block && !in_wall, "{p}");
            }
            let beyond = places.iter().filter(|p| p.x > 5.1).count();
            assert!(beyond * 4 > places.len(), "{beyond} of {} in the second room", places.len());
        }
    }

    #[test]
    fn places_are_in_a_room_on_a_wide_ground() {
        let mut data = SceneData::new();
        let m = data.add_material(Material { two_sided: true, ..Default::default() }).unwrap();
        let p = Vec3::new;
        let mut b = MeshBuilder::new();
        b.box_(p(0.0, 0.0, 0.0), p(4.0, 3.0, 5.0), true, m);
        b.quad(p(-500.0, -0.2, -500.0), p(-500.0, -0.2, 500.0), p(500.0, -0.2, 500.0), p(500.0, -0.2, -500.0), m);
        data.add_mesh(b.finish()).unwrap();
        let device = Device::new(Default::default()).unwrap();
        let scene = Scene::commit(&device, data, &BuildOptions::default(), &Progress::none()).map_err(|e| e.1).unwrap();
        // The second is high above.
        let places = find(&scene, &[p(1.0, 1.6, 1.0), p(30.0, 40.0, 30.0)], Vec3::Y, 0);
        assert!(places.len() >= PLACES, "{}", places.len());
        assert!(places.iter().all(|p| p.cmpgt(Vec3::ZERO).all() && p.cmplt(Vec3::new(4.0, 3.0, 5.0)).all()));
    }

    #[test]
    fn nothing_is_found_from_inside_a_solid() {
        assert!(find(&rooms(false), &[Vec3::new(1.7, 1.0, 1.7)], Vec3::Y, 0).is_empty());
    }
}
