//! Path tracing every texel with the library's own kernels: what a bake has to beat.
//!
//! As good as it gets without anything shared between texels: the first bounce goes in packets with a
//! shared origin, further ones in blocks, direct light is sampled at each vertex, paths end by Russian
//! roulette, which also decides whether they pass a sheet that transmits, and the first direction of
//! each texel is an Owen-scrambled Sobol sequence.

use bakelite::direct::{DirectLight, Receiver};
use bakelite::sampling::{combine, cosine_around, cosine_hemisphere, orthonormal_basis, sobol_2d, uniform};
use bakelite::scene::NONE;
use bakelite::trace::offset::{SurfacePoint, offset_ray_origin};
use bakelite::trace::{Hit, PACKET_SIZE, Packet, RawHit, Ray};
use bakelite::{Result, Scene};
use glam::{DVec3, Vec3};
use rayon::prelude::*;
use std::f32::consts::PI;
use std::sync::Arc;

/// Receivers whose paths go through the kernels together.
const BLOCK: usize = 32;

/// A path on its way.
struct Path {
    receiver: usize,
    throughput: Vec3,
    seed: u32,
    direction: Vec3,
}

pub struct TexelPaths {
    scene: Arc<Scene>,
    direct: DirectLight,
}

impl TexelPaths {
    pub fn new(scene: &Arc<Scene>) -> TexelPaths {
        TexelPaths { scene: scene.clone(), direct: DirectLight::new(scene) }
    }

    /// Indirect irradiance at each receiver from `rounds` × [`PACKET_SIZE`] paths, on the device's
    /// threads.
    pub fn indirect(&self, receivers: &[Receiver], rounds: u32, seed: u32) -> Result<Vec<[f64; 3]>> {
        let blocks = receivers.par_chunks(BLOCK).enumerate();
        let results: Vec<Vec<[f64; 3]>> = self.scene.device().install(|| {
            blocks.map(|(i, block)| self.block(block, rounds, combine(seed, i as u32))).collect::<Result<_>>()
        })?;
        Ok(results.concat())
    }

    /// The same at one receiver, on the caller's thread.
    pub fn indirect_at(&self, receiver: &Receiver, rounds: u32, seed: u32) -> Result<Vec3> {
        let e = self.block(std::slice::from_ref(receiver), rounds, seed)?;
        Ok(DVec3::from(e[0]).as_vec3())
    }

    fn block(&self, receivers: &[Receiver], rounds: u32, seed: u32) -> Result<Vec<[f64; 3]>> {
        let mut sums = vec![DVec3::ZERO; receivers.len()];
        for round in 0..rounds {
            let (mut paths, mut hits) = (Vec::new(), Vec::new());
            for (i, receiver) in receivers.iter().enumerate() {
                self.first_bounce(i, receiver, round, combine(seed, i as u32), &mut paths, &mut hits);
            }
            while !paths.is_empty() {
                let mut rays = Vec::with_capacity(paths.len());
                let mut alive = Vec::with_capacity(paths.len());
                for (path, hit) in paths.into_iter().zip(&hits) {
                    if let Some((path, ray)) = self.interact(path, hit, &mut sums) {
                        alive.push(path);
                        rays.push(ray);
                    }
                }
                hits = vec![Hit::MISS; rays.len()];
                self.scene.intersect_many(&rays, false, &mut hits)?;
                paths = alive;
            }
        }
        let scale = PI as f64 / (rounds as f64 * PACKET_SIZE as f64);
        Ok(sums.into_iter().map(|s| (s * scale).to_array()).collect())
    }

    /// One packet of paths leaves a receiver.
    fn first_bounce(
        &self,
        index: usize,
        receiver: &Receiver,
        round: u32,
        seed: u32,
        paths: &mut Vec<Path>,
        hits: &mut Vec<Hit>,
    ) {
        let (tangent, bitangent) = orthonormal_basis(receiver.normal);
        let mut packet = Packet::default();
        for k in 0..PACKET_SIZE as u32 {
            let d = cosine_hemisphere(sobol_2d(round * PACKET_SIZE as u32 + k, seed));
            packet.push(d.x * tangent + d.y * bitangent + d.z * receiver.normal);
        }
        let mut found = [RawHit::MISS; PACKET_SIZE];
        self.scene.gather_packet(receiver.origin, &packet, 0.0, f32::INFINITY, &mut found);
        for (k, hit) in found.into_iter().enumerate() {
            let direction = Vec3::new(packet.x[k], packet.y[k], packet.z[k]);
            if direction.dot(receiver.geometric) > 0.0 {
                let seed = combine(combine(seed, 1), round * PACKET_SIZE as u32 + k as u32);
                paths.push(Path { receiver: index, throughput: Vec3::ONE, seed, direction });
                hits.push(self.scene.to_hit(hit));
            }
        }
    }

    /// Adds the light that a hit reflects to its path's receiver; the way on, if the path goes on.
    fn interact(&self, path: Path, hit: &Hit, sums: &mut [DVec3]) -> Option<(Path, Ray)> {
        if hit.triangle == NONE {
            return None;
        }
        let object = if hit.instance == NONE { hit.mesh } else { self.scene.object_of_instance(hit.instance) };
        let triangle = self.scene.first_triangle(object) + hit.triangle;
        let material = self.scene.material(triangle);
        let point = SurfacePoint::new(self.scene.corners(triangle), hit.u, hit.v, &self.scene);
        let back = path.direction.dot(point.normal) > 0.0;
        let receiver = Receiver::new(&self.scene, &point, None, back);
        let mut reflected = Vec3::ZERO;
        if !back || material.two_sided {
            reflected = path.throughput * self.scene.albedo(triangle, hit.u, hit.v);
            let e = self.direct.unbiased(&receiver, 1, combine(path.seed, 1), &mut 0);
            sums[path.receiver] += (reflected * e / PI).as_dvec3();
        }
        let passed = path.throughput * Vec3::from(material.transmission);
        let (reflects, passes) = (reflected.max_element(), passed.max_element());
        // More than 1 together where other channels are reflected than pass.
        let all = (reflects + passes).max(1.0);
        let (luck, seed) = (uniform(0, 0, path.seed) * all, combine(path.seed, 2));
        if luck < reflects {
            let direction = cosine_around(receiver.normal, [uniform(0, 1, path.seed), uniform(0, 2, path.seed)]);
            let next = Path { throughput: reflected * (all / reflects), seed, direction, ..path };
            Some((next, Ray::new(receiver.origin, direction)))
        } else if luck < reflects + passes {
            let origin = offset_ray_origin(point.interior, -receiver.geometric, &self.scene);
            let next = Path { throughput: passed * (all / passes), seed, ..path };
            Some((next, Ray::new(origin, path.direction)))
        } else {
            None
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use bakelite::bvh::BuildOptions;
    use bakelite::reference::{self, PathTracer};
    use bakelite::scene::shapes::MeshBuilder;
    use bakelite::scene::{Light, Material, SceneData};
    use bakelite::{Device, Progress};

    /// A room with a lamp of some size, divided by a pane of glass, and a point of its floor.
    #[test]
    fn indirect_light_is_that_of_the_path_tracer_in_f64() {
        let mut data = SceneData::new();
        let walls = data.add_material(Material { albedo: [0.7, 0.5, 0.3], ..Default::default() }).unwrap();
        let glass = Material { albedo: [0.1, 0.4, 0.2], transmission: [0.8, 0.3, 0.1], ..Default::default() };
        let glass = data.add_material(Material { two_sided: true, ..glass }).unwrap();
        let mut room = MeshBuilder::new();
        room.box_(Vec3::ZERO, Vec3::ONE, true, walls);
        let at = |x: f32, z: f32| Vec3::new(x, 0.5, z);
        room.quad(at(0.0, 0.0), at(0.0, 1.0), at(1.0, 1.0), at(1.0, 0.0), glass);
        // Hides a part of the lamp.
        room.box_(Vec3::new(0.4, 0.6, 0.2), Vec3::new(0.5, 0.9, 0.8), false, walls);
        data.add_mesh(room.finish()).unwrap();
        let (edge_u, edge_v) = (Vec3::X * 0.8, Vec3::Z * 0.8);
        data.add_light(Light::Rect { position: Vec3::new(0.1, 0.99, 0.1), edge_u, edge_v, radiance: [5.0; 3] })
            .unwrap();
        let device = Device::new(Default::default()).unwrap();
        let scene = Scene::commit(&device, data, &BuildOptions::default(), &Progress::none()).map_err(|e| e.1).unwrap();
        for place in [Vec3::new(0.7, 0.0, 0.4), Vec3::new(0.2, 1.0, 0.9), Vec3::new(0.0, 0.3, 0.5)] {
            let start = Vec3::new(0.55, place.y.clamp(0.1, 0.95), 0.1);
            let hit = scene.intersect_raw(&Ray::new(start, place - start));
            let point = SurfacePoint::new(scene.corners(hit.triangle), hit.u, hit.v, &scene);
            let receiver = Receiver::new(&scene, &point, None, false);
            let n = 64;
            let runs = TexelPaths::new(&scene).indirect(&vec![receiver; n], 64, 1).unwrap();
            let surface = reference::SurfacePoint::on_triangle(&scene, hit.triangle, hit.u as f64, hit.v as f64);
            let truth = PathTracer::new(&scene).irradiance(&surface, 16 * 100 * 100, 1, 0);
            for c in 0..3 {
                let mean = runs.iter().map(|e| e[c]).sum::<f64>() / n as f64;
                let variance = runs.iter().map(|e| (e[c] - mean).powi(2)).sum::<f64>() / (n * (n - 1)) as f64;
                let error = (variance + truth.standard_error[c].powi(2)).sqrt();
                let off = mean - truth.indirect[c];
                assert!(error < 6e-3 * mean && off.abs() < 3.0 * error, "{place} {c}: {mean} ± {error}, {truth:?}");
            }
        }
    }
}
