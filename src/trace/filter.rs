//! Filters for rays that pass through some of the surfaces that they hit: cut-outs of textures, and thin sheets that
//! transmit light.
//!
//! The ordinary kernels know nothing of them. If one has reported a hit on a cut-out, or an occluder that may be one or
//! transmit, the ray is traced again by a kernel that asks a [`Filter`] about every triangle it hits: from the
//! beginning, since from the hit on it would lose surfaces that coincide with it.

use super::RawHit;
use super::triangle::barycentrics;
use crate::scene::Scene;

/// Decides which hits count; asked for each that could be the best so far.
pub(super) trait Accept {
    /// Whether any hit may be rejected. If not, nothing is asked.
    const FILTERS: bool;

    /// Whether a hit counts: `t` is the kernel's, `weights` are those of corners 1, 2 and 0 up to a factor.
    fn accepts(&mut self, triangle: u32, t: f32, weights: [f32; 3]) -> bool;
}

/// Accepts all hits.
pub(super) struct All;

impl Accept for All {
    const FILTERS: bool = false;

    #[inline(always)]
    fn accepts(&mut self, _: u32, _: f32, _: [f32; 3]) -> bool {
        true
    }
}

/// A hit on a transmissive sheet, which the ray passes through.
#[derive(Clone, Copy)]
pub(crate) struct Crossing {
    pub hit: RawHit,
    pub(super) on_edge: bool,
}

/// Rejects cut-outs; if asked to, records transmissive sheets and passes through them.
pub(crate) struct Filter<'a> {
    pub(super) scene: &'a Scene,
    pub(super) crossings: Option<&'a mut Vec<Crossing>>,
    /// What is added to the numbers of triangles in the tree to give global ones.
    pub(super) first_triangle: u32,
}

impl Accept for Filter<'_> {
    const FILTERS: bool = true;

    #[inline(never)]
    fn accepts(&mut self, triangle: u32, t: f32, [u, v, w]: [f32; 3]) -> bool {
        let sum = u + v + w;
        let on_edge = u == 0.0 || v == 0.0 || w == 0.0;
        let (u, v) = barycentrics(u, v, sum);
        let triangle = self.first_triangle + triangle;
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
