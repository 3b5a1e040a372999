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
//! Each light has a guide of its own. Measured: docs/experiments.md#photon-guiding.

use crate::base::error::Result;
use crate::base::memory::{try_collect, try_push, try_to_vec};

/// Minimum number of pilot photons per cell.
const PER_CELL: usize = 32;

/// Maximum number of cells along an axis.
const MAX_SIDE: usize = 64;

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
    pub(super) fn new(pilot: &[PilotPhoton]) -> Option<Guide> {
        let mut side = 1;
        while 4 * side * side * PER_CELL <= pilot.len() && side < MAX_SIDE {
            side *= 2;
        }
        let (mut count, mut left, mut squares) =
            (vec![0.0f32; side * side], vec![0.0f32; side * side], vec![0.0f32; side * side]);
        for photon in pilot {
            let (cell, n) = (cell(photon.place, side), photon.left as f32);
            count[cell] += 1.0;
            left[cell] += n;
            squares[cell] += n * n;
        }
        let mean = |sums: &[f32]| -> Vec<f32> { sums.iter().zip(&count).map(|(s, n)| s / n.max(1.0)).collect() };
        let wanted: Vec<f32> = mean(&squares).into_iter().map(f32::sqrt).collect();
        let average = wanted.iter().sum::<f32>() / wanted.len() as f32;
        if !(average > 0.0) {
            return None;
        }
        let raised: Vec<f32> = wanted.iter().map(|w| (w / average).max(LEAST)).collect();
        let total: f32 = raised.iter().sum::<f32>() / raised.len() as f32;
        let density = raised.iter().map(|w| w / total);
        let left = mean(&left);
        let guided: f32 = density.zip(&left).map(|(d, n)| d * n).sum();
        if guided < GAIN * left.iter().sum::<f32>() {
            return None;
        }
        let sums: Vec<f32> = raised.chunks(side).map(|row| row.iter().sum()).collect();
        Some(Guide { side, rows: cumulative(&sums), columns: raised.chunks(side).flat_map(cumulative).collect() })
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
            PilotPhoton { place: [x, y], left }
        };
        (0..1 << 14).map(photon).collect()
    }

    #[test]
    fn photons_go_where_they_leave_something_and_weigh_as_much_less() {
        let guide = Guide::new(&pilot()).unwrap();
        assert_eq!(guide.side, 16);
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
        let guide = Guide::new(&pilot()).unwrap();
        let mut of_cell = vec![0.0; 256];
        for i in 0..1 << 14 {
            let (place, density) = guide.place(sobol_2d(i, 3));
            let cell = &mut of_cell[cell(place, 16)];
            assert!(*cell == 0.0 || (*cell / density - 1.0f32).abs() < 1e-3);
            *cell = density;
        }
        let least = of_cell.iter().copied().fold(f32::INFINITY, f32::min);
        assert!(least > 0.7 * LEAST && least < 1.0, "{least}");
        // The largest number below 1.
        let last = 1.0 - 0.5 * f32::EPSILON;
        let (place, density) = guide.place([last; 2]);
        assert!(place[0] < 1.0 && place[1] < 1.0 && density > 0.0);
    }

    #[test]
    fn a_guide_in_a_file_is_itself_and_damaged_ones_are_refused() {
        let guide = Guide::new(&pilot()).unwrap();
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
        let alike =
            |left: u32| -> Vec<_> { (0..1 << 14).map(|i| PilotPhoton { place: sobol_2d(i, 1), left }).collect() };
        assert_eq!(Guide::new(&alike(2)), None);
        assert_eq!(Guide::new(&alike(0)), None);
        assert_eq!(Guide::new(&pilot()[..100]), None);
        assert_eq!(Guide::new(&[]), None);
    }
}
