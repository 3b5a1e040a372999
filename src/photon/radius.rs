//! The automatic search radius: chosen so that the average disc on the surfaces that photons reached holds about K
//! photons, π r² · stored / lit area = K.
//!
//! The lit area is measured by counting: photons are put into cubic cells of the size at which an
//! occupied cell holds some 16 of the photons looked at, so that few lit cells are missed. A plane
//! of area A with normal n cuts, on average over its position, A·(|nx| + |ny| + |nz|)/s² cells of
//! size s (the sum of its three projections); each occupied cell therefore represents
//! s²/(|nx| + |ny| + |nz|). Photons are counted apart by the axis that their normal is closest to,
//! so that the walls of a corner or the two sides of a thin wall count one by one.
//!
//! All cell sizes s = extent/2^level come out of one sort, by class and Morton code. The cells' origin
//! is shifted by fractions of the extent that have nothing to do with one another, because surfaces
//! in special positions (in a diagonal of the cells, in their borders) cut other numbers of them.

use super::trace::StoredPhoton;
use crate::base::error::Result;
use crate::base::memory::{try_collect, try_par_collect};
use glam::{DVec3, Vec3};
use rayon::prelude::*;

/// Name of these buffers in error messages.
const SAMPLED: &str = "the photons that tell the search radius";
/// Maximum number of photons sampled: evenly spaced ones in order of emission.
const SAMPLES: usize = 1 << 17;
/// Minimum average number of samples per occupied cell.
const PER_CELL: usize = 16;
/// Number of bits per axis of the finest cells.
const LEVELS: u32 = 20;
/// Offset of the cells' corner below the photons, in extents.
const SHIFT: DVec3 = DVec3::new(0.3713, 0.7237, 0.1829);

/// The radius with which the average disc holds `per_disc` photons; at most `diagonal`, also if there are no photons.
/// Positive for every `diagonal` > 0.
pub(super) fn automatic(blocks: &[Vec<StoredPhoton>], diagonal: f32, per_disc: f64) -> Result<f32> {
    let stored: usize = blocks.iter().map(Vec::len).sum();
    let area = lit_area(blocks, stored)?;
    if area == 0.0 {
        return Ok(diagonal);
    }
    let radius = (per_disc * area / (std::f64::consts::PI * stored as f64)).sqrt();
    Ok((radius as f32).clamp(f32::MIN_POSITIVE, diagonal.max(f32::MIN_POSITIVE)))
}

/// Area of the surfaces that photons reached.
fn lit_area(blocks: &[Vec<StoredPhoton>], stored: usize) -> Result<f64> {
    let stride = stored.div_ceil(SAMPLES).max(1);
    let samples = try_collect(blocks.iter().flatten().step_by(stride), SAMPLED)?;
    let lower = samples.iter().fold(Vec3::INFINITY, |b, p| b.min(p.position)).as_dvec3();
    let upper = samples.iter().fold(Vec3::NEG_INFINITY, |b, p| b.max(p.position)).as_dvec3();
    let extent = 2.0 * (upper - lower).max_element();
    if samples.is_empty() || extent <= 0.0 {
        return Ok(0.0);
    }
    let lower = lower - SHIFT * (0.5 * extent);
    let fine = (1u64 << LEVELS) as f64;
    let key = |p: &&StoredPhoton| {
        let cell = (p.position.as_dvec3() - lower) * (fine / extent);
        let [x, y, z] = cell.to_array().map(|c| spread((c as u64).min((1 << LEVELS) - 1)));
        let n = p.normal.abs();
        (facing(p.normal) << (3 * LEVELS) | x | y << 1 | z << 2, n.element_sum())
    };
    let mut keys: Vec<(u64, f32)> = try_par_collect(samples.par_iter().map(key), SAMPLED)?;
    keys.par_sort_unstable_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));

    // The finest level with enough samples per cell. Class bits are above all levels.
    let cell = |key: u64, level: u32| key >> (3 * (LEVELS - level));
    let occupied = |level| 1 + keys.windows(2).filter(|w| cell(w[0].0, level) != cell(w[1].0, level)).count();
    let level = (0..=LEVELS).take_while(|&l| occupied(l) * PER_CELL <= keys.len()).last().unwrap_or(0);
    let size = extent / (1u64 << level) as f64;
    let areas = keys
        .chunk_by(|a, b| cell(a.0, level) == cell(b.0, level))
        .map(|run| size * size * run.len() as f64 / run.iter().map(|k| k.1 as f64).sum::<f64>());
    Ok(areas.sum())
}

/// The signed axis closest to `n`: 0 to 5.
fn facing(n: Vec3) -> u64 {
    let axis = n.abs().max_position();
    2 * axis as u64 + (n[axis] < 0.0) as u64
}

/// Moves bit i of a 21-bit x to bit 3i: halves move apart, then quarters, …
fn spread(x: u64) -> u64 {
    let x = (x | x << 32) & 0x001f_0000_0000_ffff;
    let x = (x | x << 16) & 0x001f_0000_ff00_00ff;
    let x = (x | x << 8) & 0x100f_00f0_0f00_f00f;
    let x = (x | x << 4) & 0x10c3_0c30_c30c_30c3;
    (x | x << 2) & 0x1249_2492_4924_9249
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::sampling::sobol_2d;

    fn on_rectangle(n: u32, corner: Vec3, u: Vec3, v: Vec3, seed: u32) -> Vec<StoredPhoton> {
        let photon = |i| {
            let [a, b] = sobol_2d(i, seed);
            StoredPhoton { position: corner + u * a + v * b, normal: u.cross(v).normalize(), ..Default::default() }
        };
        (0..n).map(photon).collect()
    }

    #[test]
    fn the_area_of_a_rectangle_is_found_at_any_angle_size_and_count() {
        for (n, scale) in [(2_000, 1.0), (300_000, 1e-9), (50_000, 1e9)] {
            for (u, v) in [
                (Vec3::X * 3.0, Vec3::Y * 2.0),
                (Vec3::new(1.0, 1.0, 0.0), Vec3::Z),
                (Vec3::new(1.0, -1.0, 0.0), Vec3::new(1.0, 1.0, -2.0)),
                (Vec3::new(5.0, 0.3, 0.2), Vec3::new(0.0, 0.4, 0.5)),
            ] {
                let photons = on_rectangle(n, Vec3::splat(7.0 * scale), u * scale, v * scale, 3);
                let exact = (u * scale).as_dvec3().cross((v * scale).as_dvec3()).length();
                let found = lit_area(&[photons], n as usize).unwrap();
                assert!((0.8..1.6).contains(&(found / exact)), "{n} {u} {v}: {found} for {exact}");
            }
        }
    }

    #[test]
    fn spreading_moves_bit_i_to_bit_3i() {
        for x in [0, 1, 0xfffff, 0xa5a5a, 0x12345, 0x80001] {
            assert_eq!(spread(x), (0..LEVELS).fold(0, |s, i| s | (x >> i & 1) << (3 * i)));
        }
    }

    #[test]
    fn both_sides_of_a_thin_wall_count() {
        let front = on_rectangle(40_000, Vec3::ZERO, Vec3::X, Vec3::Y, 1);
        let back = on_rectangle(40_000, Vec3::Z * 1e-4, Vec3::Y, Vec3::X, 2);
        let found = lit_area(&[front, back], 80_000).unwrap();
        assert!((1.8..2.5).contains(&found), "{found}");
    }

    #[test]
    fn no_photons_and_coincident_photons_give_a_radius_too() {
        assert_eq!(automatic(&[], 3.0, 60.0).unwrap(), 3.0);
        assert_eq!(automatic(&[vec![StoredPhoton::default(); 100]], 3.0, 60.0).unwrap(), 3.0);
    }
}
