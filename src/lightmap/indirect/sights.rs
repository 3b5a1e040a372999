//! Lines of sight of neighbouring texels, which are collected and traced together: does anything lie between two points?

use crate::base::error::Result;
use crate::base::memory::{try_filled, try_push};
use crate::scene::Scene;
use crate::trace::Ray;

/// Number of rays that are traced together, and of those that are worth a stream.
const MOST: usize = 4096;
const LEAST_STREAM: usize = 32;

const SIGHTS: &str = "lines of sight";

/// Rays that wait, each with a number.
#[derive(Default)]
pub(super) struct Sights {
    rays: Vec<Ray>,
    numbers: Vec<u32>,
    occluded: Vec<u8>,
}

impl Sights {
    /// Adds a ray of a number.
    pub fn push(&mut self, ray: Ray, number: u32) -> Result<()> {
        try_push(&mut self.rays, ray, SIGHTS)?;
        try_push(&mut self.numbers, number, SIGHTS)
    }

    /// Whether there are so many rays that they should be traced.
    pub fn is_full(&self) -> bool {
        self.rays.len() >= MOST
    }

    /// Traces the rays and calls `visit` with the number of each and whether it hits anything, in order; adds them to
    /// `rays`.
    pub fn trace(&mut self, scene: &Scene, rays: &mut u64, mut visit: impl FnMut(u32, bool)) -> Result<()> {
        if self.occluded.len() < self.rays.len() {
            self.occluded = try_filled(self.rays.len(), 0, SIGHTS)?;
        }
        let occluded = &mut self.occluded[..self.rays.len()];
        match self.rays.len() < LEAST_STREAM {
            true => scene.occluded_block(&self.rays, occluded),
            false => scene.occluded_stream(&self.rays, occluded),
        }
        *rays += self.rays.len() as u64;
        self.numbers.iter().zip(&*occluded).for_each(|(&number, &is)| visit(number, is != 0));
        self.rays.clear();
        self.numbers.clear();
        Ok(())
    }
}
