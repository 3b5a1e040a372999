//! Directions of shadow rays to skies, guided by where the sky has been seen from nearby.
//!
//! In a room with a window that fills a hundredth of the hemisphere, 99 of 100 rays distributed by cosine end on walls. A
//! guide has the unit square, which [`cosine_hemisphere`](crate::base::sampling::cosine_hemisphere) maps to directions, cut
//! into 8 × 8 bins, and says in which of them the sky has been seen. Samples are warped by it, row by row and column by
//! column (importance sampling of a piecewise constant density; Pharr, Jakob and Humphreys, *Physically Based Rendering*,
//! 3rd ed., 13.6.7), and weighted by its density: the estimate stays without bias, whatever the guide says, since a part of
//! the samples goes everywhere. Where the guide knows little, or where it is little needed, that part is greater. The density
//! of least variance is in proportion to the root of the part of a bin in which the sky is seen; bins beside those in which it
//! is seen get samples, too.

use crate::base::error::Result;
use crate::base::memory::{MemoryMonitor, Reservation, try_collect};
use crate::base::sampling::orthonormal_basis;
use glam::Vec3;
use std::f32::consts::PI;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::{Acquire, Relaxed, Release};

/// Number of bins to a side.
const SIDE: usize = 8;

/// Number of bins, and of the bits that tell in which of them the sky is seen.
pub(crate) const BINS: usize = SIDE * SIDE;

/// Part of the samples that is distributed as if there were no guide, at least: what it does not know gets so many.
const UNGUIDED: f32 = 0.25;

/// Part of the hemisphere, weighted by cosine, from which on there is no guide if the sky fills it. Samples by cosine are good
/// there, and a guide that is not quite right makes more noise than it spares.
const MOST: f32 = 0.1;

/// Weight of a place next to where samples begin: behind a corner all others may see nothing, or something else.
const NEAR: u8 = 4;

/// Least weight of a bin, as a part of that of the greatest of the bins around it, before the root: such a bin has half the
/// density of that one. An opening shifts over the hemisphere from place to place; where it reaches a bin that nobody knows of,
/// samples would be few and of great weight, and leave single bright texels.
const BESIDE: f32 = 0.25;

/// Number of places up to which there is no guide: they miss bins in which little of the sky is seen. (With more, and with
/// fewer: docs/experiments.md#shadow-rays-guided-to-the-sky.)
pub(crate) const FEW: usize = 4;

/// A density over the unit square, constant in each bin.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Guide {
    /// Share of the samples that lie below the end of each row.
    rows: [f32; SIDE],
    /// Of the samples of a row, the share that lies before the end of each column.
    columns: [[f32; SIDE]; SIDE],
}

impl Guide {
    /// Returns the guide by what `seen` says of up to 200 places: a bit per bin, set where the sky was seen, and whether the
    /// place is next to where the samples begin, as at most 9 of them are. `None` if the sky was seen nowhere, if it fills much
    /// of the hemisphere, or if there are no more than [`FEW`] places.
    pub(crate) fn new(seen: impl Iterator<Item = (u64, bool)>) -> Option<Guide> {
        let (mut counts, mut places, mut all) = ([0u8; BINS], 0, 0);
        let (mut near_places, mut near) = (0, 0);
        for (bits, is_near) in seen {
            let weight = if is_near { NEAR } else { 1 };
            counts.iter_mut().enumerate().for_each(|(bin, count)| *count += weight * (bits >> bin & 1) as u8);
            (places, all) = (places + 1, all + bits.count_ones());
            if is_near {
                (near_places, near) = (near_places + 1, near + bits.count_ones());
            }
        }
        let share = |bits: u32, places: usize| bits as f32 / (places * BINS).max(1) as f32;
        let part = share(all, places).max(share(near, near_places));
        let unguided = UNGUIDED.max(part / MOST).max(FEW as f32 / places as f32);
        if all == 0 || !(unguided < 1.0) {
            return None;
        }
        let roots = with_bins_beside(counts).map(f32::sqrt);
        let guided = (1.0 - unguided) / roots.iter().sum::<f32>();
        let mut guide = Guide { rows: [0.0; SIDE], columns: [[0.0; SIDE]; SIDE] };
        let mut below = 0.0;
        for ((row, columns), roots) in guide.rows.iter_mut().zip(&mut guide.columns).zip(roots.as_chunks().0) {
            let roots: &[f32; SIDE] = roots;
            let mut before = 0.0;
            for (column, root) in columns.iter_mut().zip(roots) {
                before += guided * root + unguided / BINS as f32;
                *column = before;
            }
            columns.iter_mut().for_each(|column| *column /= before);
            columns[SIDE - 1] = 1.0;
            below += before;
            *row = below;
        }
        guide.rows[SIDE - 1] = 1.0;
        Some(guide)
    }

    /// Returns the point of the unit square that belongs to a uniformly distributed one, and its density.
    pub(crate) fn warp(&self, [x, y]: [f32; 2]) -> ([f32; 2], f32) {
        let (row, y, share) = part(&self.rows, y);
        let (column, x, of_row) = part(&self.columns[row], x);
        let place = |bin: usize, within: f32| ((bin as f32 + within) / SIDE as f32).min(1.0);
        ([place(column, x), place(row, y)], share * of_row * BINS as f32)
    }

    /// Returns the density at a point of the unit square.
    pub(crate) fn density(&self, [x, y]: [f32; 2]) -> f32 {
        let bin = |at: f32| ((at * SIDE as f32) as usize).min(SIDE - 1);
        let share = |ends: &[f32; SIDE], bin: usize| ends[bin] - if bin > 0 { ends[bin - 1] } else { 0.0 };
        share(&self.rows, bin(y)) * share(&self.columns[bin(y)], bin(x)) * BINS as f32
    }
}

/// The bins in which the sky is seen from each of many places; whoever asks for a place first looks from there.
pub(crate) struct SkySeen {
    /// A bit per bin, for each place.
    seen: Vec<AtomicU64>,
    /// A bit per place: whether somebody has looked.
    known: Vec<AtomicU64>,
    _memory: Reservation,
}

impl SkySeen {
    /// Makes room for so many places, and announces it to `memory`.
    pub(crate) fn new(places: usize, memory: &Arc<MemoryMonitor>) -> Result<SkySeen> {
        let (what, parts) = ("where the sky is seen", places.div_ceil(64));
        let zeros = |count| try_collect((0..count).map(|_| AtomicU64::new(0)), what);
        let memory = memory.reserve((places + parts) * size_of::<u64>(), what)?;
        Ok(SkySeen { seen: zeros(places)?, known: zeros(parts)?, _memory: memory })
    }

    /// Returns the bins in which the sky is seen from a place; `look` finds them, with the same result whenever it is called.
    /// Adds the rays traced to `rays`.
    pub(crate) fn from(&self, place: usize, rays: &mut u64, look: impl FnOnce() -> u64) -> u64 {
        let (seen, known, bit) = (&self.seen[place], &self.known[place / 64], 1 << (place % 64));
        if known.load(Acquire) & bit != 0 {
            return seen.load(Relaxed);
        }
        let bits = look();
        seen.store(bits, Relaxed);
        // Other threads may look at the same time, and see the same; the rays count once.
        if known.fetch_or(bit, Release) & bit == 0 {
            *rays += BINS as u64;
        }
        bits
    }
}

/// Returns two unit vectors that are perpendicular to a unit normal and to each other. They turn evenly with the normal except
/// near a direction that no wall has: those of places nearby must not be told apart by the sign of a zero, as those of
/// [`orthonormal_basis`] are on upright walls.
pub(crate) fn frame(normal: Vec3) -> (Vec3, Vec3) {
    const SKEW: Vec3 = Vec3::new(0.373_878, 0.551_216, 0.745_888);
    let across = SKEW.cross(normal);
    if across.length_squared() < 1e-4 {
        return orthonormal_basis(normal);
    }
    let across = across.normalize();
    (across, normal.cross(across))
}

/// Returns how many places have seen the sky in each bin, but at least [`BESIDE`] times as many as in each of the up to eight
/// bins around it.
fn with_bins_beside(counts: [u8; BINS]) -> [f32; BINS] {
    let around = |at: usize| at.saturating_sub(1)..(at + 2).min(SIDE);
    std::array::from_fn(|bin| {
        let bins = around(bin / SIDE).flat_map(|y| around(bin % SIDE).map(move |x| y * SIDE + x));
        let most = bins.map(|bin| counts[bin]).max().unwrap_or(0);
        f32::from(counts[bin]).max(BESIDE * f32::from(most))
    })
}

/// Returns the part of [0, 1] that a number lies in, given the parts' ends; its place there, and the width of the part.
fn part(ends: &[f32; SIDE], at: f32) -> (usize, f32, f32) {
    let bin = ends[..SIDE - 1].iter().filter(|&&end| at >= end).count();
    let begin = if bin > 0 { ends[bin - 1] } else { 0.0 };
    let width = ends[bin] - begin;
    (bin, (at - begin) / width, width)
}

/// Returns the point of the unit square that [`cosine_hemisphere`](crate::base::sampling::cosine_hemisphere) maps to a
/// direction above (x, y), to 1e-5.
pub(crate) fn square_of(x: f32, y: f32) -> [f32; 2] {
    let radius = (x * x + y * y).sqrt().min(1.0);
    let (along, across) = if x.abs() > y.abs() { (x, y) } else { (y, x) };
    let r = radius.copysign(along);
    let t = across / along;
    let angle = if t.is_finite() { arc_tangent(t) } else { 0.0 };
    let other = r * (4.0 / PI * angle);
    let [a, b] = if x.abs() > y.abs() { [r, other] } else { [other, r] };
    [0.5 * (a + 1.0), 0.5 * (b + 1.0)]
}

/// The arc tangent of a number from -1 to 1, to 1e-5 (Abramowitz and Stegun, 4.4.49 has the form), the same on every machine.
fn arc_tangent(t: f32) -> f32 {
    let s = t * t;
    t * (0.999_866 + s * (-0.330_299_5 + s * (0.180_141 + s * (-0.085_133 + s * 0.020_835_1))))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::sampling::{cosine_hemisphere, sobol_2d, uniform};

    fn guide() -> Guide {
        // A bin seen from all places, some from a third of them, most from none.
        let seen = [1 << 9 | 1 << 10 | 3 << 40, 1 << 9, 1 << 9 | 1 << 63];
        Guide::new(seen.into_iter().cycle().take(81).map(|bits| (bits, false))).unwrap()
    }

    #[test]
    fn samples_have_the_density_that_is_said() {
        let guide = guide();
        let (n, mut sum) = (1 << 14, [0.0f64; BINS]);
        for k in 0..n {
            let (at, density) = guide.warp(sobol_2d(k, 7));
            assert!((0.0..=1.0).contains(&at[0]) && (0.0..=1.0).contains(&at[1]));
            assert!(density >= 0.99 * UNGUIDED && (guide.density(at) / density - 1.0).abs() < 1e-4, "{at:?}");
            let bin = at.map(|v| ((v * SIDE as f32) as usize).min(SIDE - 1));
            sum[bin[1] * SIDE + bin[0]] += 1.0 / f64::from(density);
        }
        // By their weights the samples are uniform.
        assert!(sum.iter().all(|s| (s / n as f64 * BINS as f64 - 1.0).abs() < 0.05), "{sum:?}");
        assert!(guide.density([1.5 / 8.0, 1.5 / 8.0]) > 4.0);
    }

    #[test]
    fn bins_beside_those_in_which_the_sky_is_seen_have_samples_too() {
        let guide = Guide::new(std::iter::repeat_n((1 << 31 | 1 << 42, false), 81)).unwrap();
        let place = |i: usize| (i as f32 + 0.5) / SIDE as f32;
        let density = |bin: usize| guide.density([place(bin % SIDE), place(bin / SIDE)]);
        let guided = |bin: usize| density(bin) - density(7);
        // Bin 31 is the last one of its row; 32 is the first of the next, at the other edge.
        let beside = [22, 23, 30, 38, 39, 33, 34, 35, 41, 43, 49, 50, 51];
        for bin in 0..BINS {
            let part = guided(bin) / guided(31);
            let expected = if [31, 42].contains(&bin) {
                1.0
            } else if beside.contains(&bin) {
                0.5
            } else {
                0.0
            };
            assert!((part - expected).abs() < 1e-4, "{bin}: {part}");
        }
    }

    #[test]
    fn where_little_is_known_or_much_is_seen_there_is_no_guide() {
        let guide = |bits: u64, places: usize| Guide::new(std::iter::repeat_n((bits, false), places));
        assert!(guide(0, 81).is_none() && guide(u64::MAX, 81).is_none() && guide(0xff, 81).is_none());
        assert!(guide(1, 0).is_none() && guide(1, FEW).is_none());
        // The sky fills a part of what is seen next to the samples, which the other places do not see.
        assert!(Guide::new((0..81).map(|i| if i < 9 { (0xff, true) } else { (0, false) })).is_none());
        // What little is known counts little.
        let of_bin = |guide: Option<Guide>| guide.unwrap().density([0.05, 0.05]);
        let [few, many] = [FEW + 1, 81].map(|places| of_bin(guide(1, places)));
        assert!(1.0 < few && few < 0.4 * many, "{few} {many}");
        // The bin in the corner of the square has weight 1, three around it have the root of a quarter.
        let expected = (1.0 - UNGUIDED) * BINS as f32 / 2.5 + UNGUIDED;
        assert!((many / expected - 1.0).abs() < 1e-3, "{many}");
    }

    #[test]
    fn normals_that_differ_by_rounding_have_the_same_frame() {
        for normal in [Vec3::X, Vec3::NEG_X, Vec3::Y, Vec3::NEG_Y, Vec3::Z, Vec3::NEG_Z, Vec3::new(0.6, -0.8, 0.0)] {
            let (t, b) = frame(normal);
            assert!(t.dot(normal).abs() < 1e-6 && b.dot(normal).abs() < 1e-6 && t.dot(b).abs() < 1e-6);
            assert!((t.length() - 1.0).abs() < 1e-6 && t.cross(b).dot(normal) > 0.999);
            for by in [0.0, -0.0, 1e-7, -1e-7] {
                let (other, _) = frame((normal + Vec3::splat(by)).normalize());
                assert!(other.distance(t) < 1e-5, "{normal}");
            }
        }
        let skew = Vec3::new(0.373_878, 0.551_216, 0.745_888);
        assert!(frame(skew).0.is_finite() && (frame(-skew).0.length() - 1.0).abs() < 1e-5);
    }

    #[test]
    fn directions_are_mapped_back_to_the_square() {
        for i in 0..2000 {
            let u = [uniform(i, 0, 1), uniform(i, 1, 1)];
            let d = cosine_hemisphere(u);
            let back = square_of(d.x, d.y);
            assert!((0..2).all(|k| (back[k] - u[k]).abs() < 2e-5), "{u:?}: {back:?}");
        }
        for [x, y] in [[0.0, 0.0], [1.0, 0.0], [0.0, -1.0], [-0.0, 0.0], [0.5, 0.5], [-0.5, 0.5]] {
            assert!(square_of(x, y).into_iter().all(|v| (0.0..=1.0).contains(&v)), "{x} {y}");
        }
    }
}
