//! Rays that pass through some of what they meet: holes that textures cut out, and thin sheets that
//! transmit light.
//!
//! The ordinary kernels know nothing of them. Where one has reported a hole, or an occluder that may be
//! one or transmit, the ray is traced again by a kernel that asks a [`Filter`] about every triangle met:
//! from the beginning, since from the hit on it would lose what coincides with it.

use super::RawHit;
use super::triangle::barycentrics;
use crate::scene::Scene;

/// Which hits count, asked for each that could be the best so far.
pub(super) trait Accept {
    /// Whether any may be refused. If not, nothing is asked.
    const FILTERS: bool;

    /// Whether a hit counts: `t` as the kernel has it, `weights` of corners 1, 2 and 0 up to a factor.
    fn accepts(&mut self, triangle: u32, t: f32, weights: [f32; 3]) -> bool;
}

/// All hits count.
pub(super) struct All;

impl Accept for All {
    const FILTERS: bool = false;

    #[inline(always)]
    fn accepts(&mut self, _: u32, _: f32, _: [f32; 3]) -> bool {
        true
    }
}

/// A sheet that a ray passes through.
#[derive(Clone, Copy)]
pub(crate) struct Crossing {
    pub hit: RawHit,
    pub(super) on_edge: bool,
}

/// Refuses holes and, if asked to, takes down and refuses sheets that transmit.
pub(crate) struct Filter<'a> {
    pub(super) scene: &'a Scene,
    pub(super) crossings: Option<&'a mut Vec<Crossing>>,
}

impl Accept for Filter<'_> {
    const FILTERS: bool = true;

    #[inline(never)]
    fn accepts(&mut self, triangle: u32, t: f32, [u, v, w]: [f32; 3]) -> bool {
        let sum = u + v + w;
        let on_edge = u == 0.0 || v == 0.0 || w == 0.0;
        let (u, v) = barycentrics(u, v, sum);
        if self.scene.is_hole(triangle, u, v) {
            return false;
        }
        match &mut self.crossings {
            Some(crossings) if self.scene.material(triangle).transmits() => {
                crossings.push(Crossing { hit: RawHit { t, u, v, triangle, front: sum > 0.0 }, on_edge });
                false
            }
            _ => true,
        }
    }
}
