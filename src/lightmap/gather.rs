//! Gather map (thesis 3.2.5): indirect irradiance by final gathering. From each texel a packet of
//! cosine-distributed rays is traced; a hit looks the outgoing radiance up in the radiance map.
//!
//! The sample set is made once: Sobol points, sorted along a Morton curve so that each packet of 32
//! is a narrow bundle. Each texel shifts it digitally (XOR), which keeps both the stratification
//! and the bundles.

use super::direct::Receiver;
use super::radiance::RadianceMap;
use crate::sampling::{combine, concentric_disc, orthonormal_basis, sobol_2d_bits, unit_float};
use crate::scene::Scene;
use crate::trace::{PACKET_SIZE, Packet, RawHit};
use glam::Vec3;
use std::f32::consts::PI;

/// A texel more than this fraction of whose rays meet the backs of one-sided surfaces lies inside a
/// solid.
const MAX_BACK_FACES: f32 = 0.5;

/// Points of the unit square, in fixed point, that every texel uses in its own shift.
pub(super) struct SampleSet {
    points: Vec<[u32; 2]>,
}

impl SampleSet {
    pub(super) fn new(count: u32, seed: u32) -> SampleSet {
        let mut points: Vec<[u32; 2]> = (0..count).map(|i| sobol_2d_bits(i, seed)).collect();
        points.sort_unstable_by_key(|&[x, y]| morton(x >> 16, y >> 16));
        SampleSet { points }
    }

    pub(super) fn len(&self) -> usize {
        self.points.len()
    }
}

/// Bits of two 16-bit numbers interleaved.
fn morton(x: u32, y: u32) -> u32 {
    let spread = |mut v: u32| {
        v = (v | v << 8) & 0x00ff_00ff;
        v = (v | v << 4) & 0x0f0f_0f0f;
        v = (v | v << 2) & 0x3333_3333;
        (v | v << 1) & 0x5555_5555
    };
    spread(x) | spread(y) << 1
}

/// What a texel gathered.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Gathered {
    /// Indirect irradiance, W/m².
    pub irradiance: [f32; 3],
    /// Whether the texel can be seen at all.
    pub valid: bool,
}

/// Gathers at a receiver; `seed` is the texel's own.
pub(super) fn gather(
    scene: &Scene,
    radiance: &RadianceMap,
    receiver: &Receiver,
    samples: &SampleSet,
    seed: u32,
) -> Gathered {
    let shift = [combine(seed, 1), combine(seed, 2)];
    let (tangent, bitangent) = orthonormal_basis(receiver.normal);
    let mut hits = [RawHit::MISS; PACKET_SIZE];
    let (mut sum, mut backs) = (Vec3::ZERO, 0u32);
    for bundle in samples.points.chunks(PACKET_SIZE) {
        let mut packet = Packet::default();
        for p in bundle {
            let [x, y] = concentric_disc([unit_float(p[0] ^ shift[0]), unit_float(p[1] ^ shift[1])]);
            let z = (1.0 - x * x - y * y).max(0.0).sqrt();
            packet.push(x * tangent + y * bitangent + z * receiver.normal);
        }
        scene.gather_packet(receiver.origin, &packet, 0.0, f32::INFINITY, &mut hits);
        for (i, hit) in hits[..packet.count].iter().enumerate() {
            if hit.is_miss() {
                continue;
            }
            // Under the true surface where the shading normal leans away from it: no light.
            let d = Vec3::new(packet.x[i], packet.y[i], packet.z[i]);
            if d.dot(receiver.geometric) <= 0.0 {
                continue;
            }
            match radiance.reflected(hit) {
                Some(l) => sum += l,
                None => backs += 1,
            }
        }
    }
    let n = samples.points.len() as f32;
    Gathered { irradiance: (sum * (PI / n)).to_array(), valid: backs as f32 <= MAX_BACK_FACES * n }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_packet_of_a_set_is_a_narrow_bundle() {
        let set = SampleSet::new(1024, 5);
        for shift in [[0, 0], [0x1234_5678, 0x9abc_def0]] {
            for bundle in set.points.chunks(PACKET_SIZE) {
                let extent = |k: usize| {
                    let values = bundle.iter().map(|p| unit_float(p[k] ^ shift[k]));
                    values.clone().fold(0.0, f32::max) - values.fold(1.0, f32::min)
                };
                // 32 bundles: 4 × 8 or 8 × 4 cells of the unit square.
                assert!(extent(0) <= 0.25 && extent(1) <= 0.25, "{} {}", extent(0), extent(1));
            }
        }
    }
}
