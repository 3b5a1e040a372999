//! Shares of the photons of a map: what several machines trace, each some blocks, is put together to the map that one
//! machine makes of all, bit for bit, since photons are sorted in the order of their blocks.

use super::trace::{self, Account, StoredPhoton, Traced};
use super::{PhotonParams, PhotonStats};
use crate::base::error::{Error, Result};
use crate::base::memory::{try_push, try_vec};
use crate::base::progress::Progress;
use crate::base::share::Share;
use crate::scene::Scene;
use std::sync::Arc;
use std::time::Instant;

/// Number of photons to a run, at most.
const RUN: usize = 1 << 14;

impl Traced {
    /// Bytes of a photon in a [run](Self::runs).
    pub const ITEM: usize = size_of::<StoredPhoton>();

    /// Traces a share of the photons. To be called on the device's threads; reports over `[from, to]` of the bar.
    ///
    /// `InvalidArgument` for parameters out of range, `InvalidState` if the scene has no lights, `OutOfMemory` if
    /// `memory_budget` or the memory monitor refuses.
    pub fn trace(
        scene: &Arc<Scene>,
        params: &PhotonParams,
        share: Share,
        progress: &Progress,
        of_bar: (f32, f32),
    ) -> Result<Traced> {
        params.validate()?;
        let lights = scene.lights();
        if lights.is_empty() && scene.emitters().is_empty() {
            return Err(Error::InvalidState("the scene has no lights: add a light or a material with emission".into()));
        }
        let start = Instant::now();
        let mut traced = trace::trace(scene, &lights, params, share, progress, of_bar)?;
        traced.stats.trace_seconds = start.elapsed().as_secs_f64();
        Ok(traced)
    }

    /// No photons, to which others are [added](Self::add). `emitted`: number of photons emitted in all.
    pub fn none(scene: &Scene, params: &PhotonParams, emitted: u64) -> Traced {
        let memory = Account::new(scene.device().memory().clone(), params.memory_budget);
        Traced { blocks: Vec::new(), stats: PhotonStats { emitted, ..Default::default() }, memory, guides: None }
    }

    /// Returns the photons in runs, as bytes.
    pub fn runs(&self) -> impl Iterator<Item = &[u8]> {
        self.blocks.iter().flat_map(|block| block.chunks(RUN)).map(bytemuck::cast_slice)
    }

    /// Adds a [run](Self::runs) behind the others and returns the number of its photons; `None`, if it can be none.
    pub fn add(&mut self, run: &[u8]) -> Result<Option<usize>> {
        let count = run.len() / size_of::<StoredPhoton>();
        if count > RUN || !run.len().is_multiple_of(size_of::<StoredPhoton>()) {
            return Ok(None);
        }
        self.memory.grow(run.len())?;
        let mut block: Vec<StoredPhoton> = try_vec(count, "the photons being read")?;
        bytemuck::cast_slice_mut(&mut block).copy_from_slice(run);
        if !block.iter().all(StoredPhoton::is_possible) {
            return Ok(None);
        }
        self.stats.stored += count as u64;
        try_push(&mut self.blocks, block, "the photons being read")?;
        Ok(Some(count))
    }
}
