//! Path tracing every texel with the library's own kernels: what a bake has to beat.
//!
//! As good as it gets without anything shared between texels: the first bounce goes in packets with a
//! shared origin, further ones in blocks, direct light is sampled at each vertex as in a bake, paths
//! end by Russian roulette, and the first direction of each texel is an Owen-scrambled Sobol sequence.

use bakelite::lightmap::direct::{DirectLight, Receiver};
use bakelite::sampling::{combine, cosine_hemisphere, orthonormal_basis, sobol_2d, uniform};
use bakelite::scene::NONE;
use bakelite::trace::offset::SurfacePoint;
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
        let triangle = self.scene.first_triangle(hit.mesh) + hit.triangle;
        let material = self.scene.material(triangle);
        let point = SurfacePoint::new(self.scene.corners(triangle), hit.u, hit.v, &self.scene);
        let back = path.direction.dot(point.normal) > 0.0;
        if back && !material.two_sided {
            return None;
        }
        let receiver = Receiver::new(&self.scene, &point, None, back);
        let throughput = path.throughput * self.scene.albedo(triangle, hit.u, hit.v);
        let e = self.direct.irradiance(&receiver, 1, combine(path.seed, 1), &mut 0);
        sums[path.receiver] += (throughput * e / PI).as_dvec3();
        let survival = throughput.max_element().min(1.0);
        if !(uniform(0, 0, path.seed) < survival) {
            return None;
        }
        let d = cosine_hemisphere([uniform(0, 1, path.seed), uniform(0, 2, path.seed)]);
        let (tangent, bitangent) = orthonormal_basis(receiver.normal);
        let direction = d.x * tangent + d.y * bitangent + d.z * receiver.normal;
        let next = Path { throughput: throughput / survival, seed: combine(path.seed, 2), direction, ..path };
        Some((next, Ray::new(receiver.origin, direction)))
    }
}
