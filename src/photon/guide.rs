//! Emission guided by a pilot: more photons go where they lead to surfaces that light reaches only by reflection.
//!
//! Most photons of the sun hit roofs and are lost; rooms are lit through a few windows. So a part of the photons is
//! traced first, as a pilot, and the square of random numbers by which a light chooses directions or start points of
//! its photons is divided into cells. A cell gets photons in proportion to the root mean square of the number of
//! photons that its pilot photons left on surfaces after a reflection (the allocation of Neyman, *On the Two Different
//! Aspects of the Representative Method*, 1934), each with as much less power. (Dutré and Willems, *Potential-Driven
//! Monte Carlo Particle Tracing for Diffuse Environments with Adaptive Probability Density Functions*, 1995, guide all
//! reflections in this way, by their contribution to a picture.)
//!
//! Around a house on a wide ground one photon in thousands is useful. So cells are small, and the estimate for a cell is the
//! mean of its own pilot photons and of [`PRIOR`] imaginary ones with the average of the block of 2 × 2 cells that it belongs
//! to; that average is found in the same way. The pilot is traced in rounds, each guided by those before.
//!
//! Each light has a guide of its own. Measured: docs/experiments.md#photon-guiding.

use crate::base::error::Result;
use crate::base::memory::{try_collect, try_filled, try_push, try_to_vec};
use std::ops::AddAssign;

/// Minimum number of pilot photons per cell, in the mean.
const PER_CELL: usize = 4;

/// Maximum number of cells along an axis, for lights with 2^16 pilot photons or more.
const MAX_SIDE: usize = 128;

/// Number of imaginary pilot photons in a cell, which left as much as those of the block around it. (With 8 indirect light of
/// rooms under a sky had more noise: docs/experiments.md#photon-guiding.)
const PRIOR: f32 = 32.0;

/// Minimum density of a cell, relative to that without a guide.
const LEAST: f32 = 0.5;

/// Minimum gain of photons on surfaces for which a guide is used: powers that differ are noise too.
const GAIN: f32 = 1.25;

/// Minimum density of a cell in guides of files; those that are made have more.
const LEAST_POSSIBLE: f32 = 0.1;

/// Name of guides in error messages.
const GUIDES: &str = "the guides of lights";

/// A photon of the pilot.
#[derive(Clone, Copy, Debug)]
pub(super) struct PilotPhoton {
    /// Position in the unit square.
    pub place: [f32; 2],
    /// Number of times it was left on a surface after a reflection.
    pub left: u32,
    /// Number of photons without a guide that it stands for: the reciprocal of the guide's density there.
    pub weight: f32,
}

/// Sums over pilot photons of a cell.
#[derive(Clone, Copy, Default)]
struct Sums {
    /// Of weights, and of their squares.
    weights: f32,
    squares: f32,
    /// Of [`PilotPhoton::left`] and of its square, by weight.
    left: [f32; 2],
}

impl AddAssign for Sums {
    fn add_assign(&mut self, other: Sums) {
        self.weights += other.weights;
        self.squares += other.squares;
        self.left.iter_mut().zip(other.left).for_each(|(sum, more)| *sum += more);
    }
}

impl Sums {
    fn of(photon: &PilotPhoton, weight: f32) -> Sums {
        let left = photon.left as f32;
        Sums { weights: weight, squares: weight * weight, left: [weight * left, weight * left * left] }
    }

    /// Returns the mean number of photons left and the mean of its square, given those of the block around and how many
    /// photons they count as.
    fn means(&self, block: [f32; 2], prior: f32) -> [f32; 2] {
        if !(self.squares > 0.0) {
            return block;
        }
        // Photons of unequal weight tell as much as so many equal ones (Kish, *Survey Sampling*, 1965).
        let photons = self.weights * self.weights / self.squares;
        std::array::from_fn(|i| (photons * self.left[i] / self.weights + prior * block[i]) / (photons + prior))
    }
}

/// Returns the [means](Sums::means) of `side`² cells. `weighted` has the same photons by their weights.
fn means(of_cells: &[Sums], weighted: &[Sums], side: usize) -> Result<Vec<[f32; 2]>> {
    if side == 1 {
        return try_collect(of_cells.iter().map(|sums| sums.means([0.0; 2], 0.0)), GUIDES);
    }
    let half = side / 2;
    let block_of = |cell: usize| cell / side / 2 * half + cell % side / 2;
    let mut blocks = try_filled(half * half, Sums::default(), GUIDES)?;
    weighted.iter().enumerate().for_each(|(cell, &sums)| blocks[block_of(cell)] += sums);
    let of_blocks = means(&blocks, &blocks, half)?;
    let own = of_cells.iter().enumerate().map(|(cell, sums)| sums.means(of_blocks[block_of(cell)], PRIOR));
    try_collect(own, GUIDES)
}

/// A density on the unit square, constant in each of `side`² cells.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Guide {
    side: usize,
    /// Cumulative distribution of the rows, from 0 to 1.
    rows: Vec<f32>,
    /// Cumulative distribution of the columns of each row, from 0 to 1.
    columns: Vec<f32>,
}

impl Guide {
    /// Makes a guide from the pilot photons of a light; `None` if it would not pay.
    pub(super) fn new(pilot: &[PilotPhoton]) -> Result<Option<Guide>> {
        let mut side = 1;
        while 4 * side * side * PER_CELL <= pilot.len() && side < MAX_SIDE {
            side *= 2;
        }
        // The cells of earlier guides are as large or larger, so that each round spread its photons evenly over a cell: there all
        // count the same. In blocks of cells they count by their weights.
        let of_cells = |weight: fn(&PilotPhoton) -> f32| -> Result<Vec<Sums>> {
            let mut of_cells = try_filled(side * side, Sums::default(), GUIDES)?;
            pilot.iter().for_each(|photon| of_cells[cell(photon.place, side)] += Sums::of(photon, weight(photon)));
            Ok(of_cells)
        };
        let means = means(&of_cells(|_| 1.0)?, &of_cells(|photon| photon.weight)?, side)?;
        let cells = means.len() as f32;
        let wanted = means.iter().map(|[_, squares]| squares.sqrt());
        let average = wanted.clone().sum::<f32>() / cells;
        if !(average > 0.0) {
            return Ok(None);
        }
        let raised = try_collect(wanted.map(|w| (w / average).max(LEAST)), GUIDES)?;
        let total = raised.iter().sum::<f32>() / cells;
        let left = || means.iter().map(|[left, _]| left);
        let guided: f32 = raised.iter().zip(left()).map(|(w, left)| w / total * left).sum();
        if guided < GAIN * left().sum::<f32>() {
            return Ok(None);
        }
        let sums = try_collect(raised.chunks(side).map(|row| row.iter().sum()), GUIDES)?;
        let columns = try_collect(raised.chunks(side).flat_map(cumulative), GUIDES)?;
        Ok(Some(Guide { side, rows: cumulative(&sums), columns }))
    }

    /// Appends the guide as words of files: its side, then its distributions.
    pub(super) fn append_words(&self, words: &mut Vec<u32>) -> Result<()> {
        let sums = self.rows.iter().chain(&self.columns).map(|sum| sum.to_bits());
        std::iter::once(self.side as u32).chain(sums).try_for_each(|word| try_push(words, word, GUIDES))
    }

    /// Reads a guide of some side from the words that follow it; `None` if they are no distributions.
    pub(super) fn take_words(side: u32, words: &mut &[u32]) -> Result<Option<Guide>> {
        let side = side as usize;
        if !side.is_power_of_two() || side > MAX_SIDE {
            return Ok(None);
        }
        let Some((own, rest)) = words.split_at_checked((side + 1) * (side + 1)) else { return Ok(None) };
        *words = rest;
        let sums = try_collect(own.iter().map(|&word| f32::from_bits(word)), GUIDES)?;
        let ends = |sums: &[f32]| sums[0] == 0.0 && sums[side] == 1.0;
        let (rows, columns) = sums.split_at(side + 1);
        // No cell is so small that its photons would be too bright.
        let density = |pair: &[f32]| (pair[1] - pair[0]) * side as f32;
        let mut of_rows = rows.windows(2).map(density).zip(columns.chunks(side + 1));
        let is_possible = |(row, columns): (f32, &[f32])| {
            row > 0.0 && ends(columns) && columns.windows(2).all(|pair| row * density(pair) >= LEAST_POSSIBLE)
        };
        if !ends(rows) || !of_rows.all(is_possible) {
            return Ok(None);
        }
        Ok(Some(Guide { side, rows: try_to_vec(rows, GUIDES)?, columns: try_to_vec(columns, GUIDES)? }))
    }

    /// Maps a uniform point of the unit square to one with the guide's density; returns that density too.
    pub(super) fn place(&self, [x, y]: [f32; 2]) -> ([f32; 2], f32) {
        let (row, y, of_row) = invert(&self.rows, y);
        let stride = self.side + 1;
        let (column, x, of_column) = invert(&self.columns[row * stride..(row + 1) * stride], x);
        let place = |cell: usize, within: f32| (cell as f32 + within) / self.side as f32;
        // Rounding must not put the point into the next cell, whose density is different; nor on 1.
        let inside = |cell: usize, p: f32| p.min((cell + 1) as f32 / self.side as f32 * (1.0 - f32::EPSILON));
        ([inside(column, place(column, x)), inside(row, place(row, y))], of_row * of_column)
    }
}

/// The cell of a point of the unit square.
fn cell([x, y]: [f32; 2], side: usize) -> usize {
    let at = |v: f32| ((v * side as f32) as usize).min(side - 1);
    at(y) * side + at(x)
}

/// Cumulative sums of parts of the whole: of the first 0, 1, … parts.
fn cumulative(parts: &[f32]) -> Vec<f32> {
    let whole: f64 = parts.iter().map(|&p| f64::from(p)).sum();
    let mut sum = 0.0;
    let mut sums: Vec<f32> = std::iter::once(0.0)
        .chain(parts.iter().map(|&p| {
            sum += f64::from(p);
            (sum / whole) as f32
        }))
        .collect();
    sums[parts.len()] = 1.0;
    sums
}

/// The part that a number in [0, 1) falls in, the position in it, and the density there.
fn invert(sums: &[f32], at: f32) -> (usize, f32, f32) {
    let part = (sums.partition_point(|&s| s <= at) - 1).min(sums.len() - 2);
    let width = sums[part + 1] - sums[part];
    (part, (at - sums[part]) / width, width * (sums.len() - 1) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::sampling::sobol_2d;

    /// Pilot of a light most of whose photons are lost: one in a corner leaves three, others one by chance.
    fn pilot() -> Vec<PilotPhoton> {
        let photon = |i: u32| {
            let [x, y] = sobol_2d(i, 1);
            let left = if x < 0.2 && y > 0.7 { 3 } else { u32::from(i.is_multiple_of(50)) };
            PilotPhoton { place: [x, y], left, weight: 1.0 }
        };
        (0..1 << 14).map(photon).collect()
    }

    #[test]
    fn photons_go_where_they_leave_something_and_weigh_as_much_less() {
        let guide = Guide::new(&pilot()).unwrap().unwrap();
        assert_eq!(guide.side, 64);
        let n = 1 << 16;
        let (mut whole, mut moment, mut corner) = (0.0, 0.0, 0);
        for i in 0..n {
            let (place, density) = guide.place(sobol_2d(i, 2));
            let [x, y] = place.map(f64::from);
            assert!((0.0..1.0).contains(&x) && (0.0..1.0).contains(&y));
            whole += 1.0 / f64::from(density) / f64::from(n);
            moment += x * y * y / f64::from(density) / f64::from(n);
            corner += u32::from(x < 0.2 && y > 0.7);
        }
        assert!((whole - 1.0).abs() < 1e-3 && (moment - 1.0 / 6.0).abs() < 1e-3, "{whole} {moment}");
        assert!(corner > n / 4, "{corner}");
    }

    #[test]
    fn the_density_is_that_of_the_cell_and_not_less_than_the_least() {
        let guide = Guide::new(&pilot()).unwrap().unwrap();
        let mut of_cell = vec![0.0; 64 * 64];
        for i in 0..1 << 14 {
            let (place, density) = guide.place(sobol_2d(i, 3));
            let cell = &mut of_cell[cell(place, 64)];
            assert!(*cell == 0.0 || (*cell / density - 1.0f32).abs() < 1e-3);
            *cell = density;
        }
        let least = of_cell.iter().copied().filter(|&density| density > 0.0).fold(f32::INFINITY, f32::min);
        assert!(least > 0.7 * LEAST && least < 1.0, "{least}");
        // The largest number below 1.
        let last = 1.0 - 0.5 * f32::EPSILON;
        let (place, density) = guide.place([last; 2]);
        assert!(place[0] < 1.0 && place[1] < 1.0 && density > 0.0);
    }

    /// A guide sent 20 of 21 photons to a quarter of the square, where each left one.
    #[test]
    fn photons_of_rounds_count_by_their_weights_in_blocks_and_alike_in_cells() {
        let photon = |i: u32, scale: f32, left, weight| {
            let [x, y] = sobol_2d(i, 4);
            PilotPhoton { place: [scale * x, scale * y], left, weight }
        };
        let sparse = (0..1 << 8).map(|i| photon(i, 1.0, 0, 4.0)).filter(|p| p.place[0].max(p.place[1]) >= 0.5);
        let photons: Vec<PilotPhoton> = (0..15 << 8).map(|i| photon(i, 0.5, 1, 1.0 / 15.0)).chain(sparse).collect();
        let sums = |side: usize, weight: &dyn Fn(&PilotPhoton) -> f32| {
            let mut sums = vec![Sums::default(); side * side];
            photons.iter().for_each(|p| sums[cell(p.place, side)] += Sums::of(p, weight(p)));
            sums
        };
        let [left, squares] = means(&sums(1, &|p| p.weight), &[], 1).unwrap()[0];
        assert!((left - 0.25).abs() < 0.01 && left == squares, "{left} {squares}");
        let cells = means(&sums(2, &|_| 1.0), &sums(2, &|p| p.weight), 2).unwrap();
        // As of 3,840 photons and 32 of 0.25, or of 64 and 32.
        let expected = [(3840.0 + 32.0 * left) / 3872.0, 32.0 * left / 96.0];
        assert!((cells[0][0] - expected[0]).abs() < 1e-3 && (cells[3][0] - expected[1]).abs() < 0.01, "{cells:?}");
    }

    /// One photon in five thousand is useful, all of them in a window.
    #[test]
    fn rounds_lead_to_a_place_that_few_photons_find() {
        let is_in_window = |[x, y]: [f32; 2]| (0.5..0.514).contains(&x) && (0.3..0.314).contains(&y);
        let (mut guide, mut photons, mut shares) = (None::<Guide>, Vec::new(), Vec::new());
        for round in 0..3 {
            for i in 0..1 << 14 {
                let at = sobol_2d(i, round);
                let (place, density) = guide.as_ref().map_or((at, 1.0), |guide| guide.place(at));
                let left = if is_in_window(place) { 2 } else { 0 };
                photons.push(PilotPhoton { place, left, weight: 1.0 / density });
            }
            guide = Guide::new(&photons).unwrap();
            let found = (0..1 << 14).map(|i| guide.as_ref().unwrap().place(sobol_2d(i, 7)));
            let (mut share, mut whole) = (0.0, 0.0);
            for (place, density) in found {
                share += f32::from(u8::from(is_in_window(place))) / 16384.0;
                whole += 1.0 / density / 16384.0;
            }
            assert!((whole - 1.0f32).abs() < 0.01, "{whole}");
            shares.push(share);
        }
        assert!(shares[0] > 10.0 * 2e-4 && shares[2] > 2.0 * shares[0] && shares[2] > 0.05, "{shares:?}");
    }

    #[test]
    fn a_guide_in_a_file_is_itself_and_damaged_ones_are_refused() {
        let guide = Guide::new(&pilot()).unwrap().unwrap();
        let mut words = Vec::new();
        guide.append_words(&mut words).unwrap();
        words.push(7);
        let read = |words: &[u32]| {
            let mut rest = &words[1..];
            Guide::take_words(words[0], &mut rest).unwrap().map(|guide| (guide, rest.len()))
        };
        assert_eq!(read(&words), Some((guide, 1)));
        for (place, word) in [(0, 3), (0, 0), (0, 128), (0, 32), (1, 1), (2, 0), (3, f32::NAN.to_bits()), (20, 0)] {
            let mut damaged = words.clone();
            damaged[place] = word;
            assert_eq!(read(&damaged), None, "{place} {word}");
        }
        assert_eq!(read(&words[..words.len() - 2]), None);
    }

    #[test]
    fn where_all_photons_do_alike_none_do_or_few_there_is_no_guide() {
        let alike = |left: u32| -> Vec<_> {
            (0..1 << 14).map(|i| PilotPhoton { place: sobol_2d(i, 1), left, weight: 1.0 }).collect()
        };
        assert_eq!(Guide::new(&alike(2)).unwrap(), None);
        assert_eq!(Guide::new(&alike(0)).unwrap(), None);
        // One photon that left a lot is chance.
        let mut few = alike(1)[..64].to_vec();
        few[5].left = 50;
        assert_eq!(Guide::new(&few).unwrap(), None);
        assert_eq!(Guide::new(&[]).unwrap(), None);
    }
}
