//! Work between updates, on the device's threads.

use super::batch::{Background, Batch};
use super::choose::Choice;
use super::limit::Limit;
use super::{Live, LiveCamera, LiveStats};
use crate::base::error::Result;
use std::time::Duration;

/// Maximum number of blocks that are worked on between two updates.
const BACKGROUND_BLOCKS: usize = 256;

/// Number of texels whose rays are traced together between two updates: the next update waits for these.
const TOGETHER: usize = 16;

impl Live {
    /// Lets the thread pool continue with the blocks that the camera saw last.
    pub(super) fn start_background(&mut self, camera: &LiveCamera) -> Result<()> {
        if !self.params.background || self.paused {
            return Ok(());
        }
        let from = Choice {
            context: &self.context,
            blocks: self.blocks.status(),
            grid: &self.grid,
            visibility: &self.visibility,
        };
        let (step, mut chosen) = self.chooser.next(&from, self.params.mode, camera, BACKGROUND_BLOCKS);
        // The work of blocks that wait to be shown must stay available to the display.
        chosen.retain(|&b| !self.is_waiting[b as usize]);
        if chosen.is_empty() {
            return Ok(());
        }
        self.reserve_for(&chosen)?;
        let most_rays = Some(self.params.rays_per_update as u64).filter(|&r| r > 0).unwrap_or(u64::MAX);
        let limit = Limit::new(None, most_rays, TOGETHER);
        let batch = Batch::new(self.context.clone(), &mut self.blocks, &chosen, step, limit, Duration::ZERO)?;
        self.background = Some(Background::start(batch, &self.device()));
        Ok(())
    }

    /// Stops background work and takes over its blocks and results, complete or not.
    pub(super) fn collect(&mut self, stats: &mut LiveStats) -> Result<()> {
        let Some(background) = self.background.take() else { return Ok(()) };
        let (items, traced, result) = background.finish();
        stats.rays += traced;
        let device = self.device();
        device.install(|| self.take_over(items, stats));
        result
    }

    /// Does the work of [`collect`](Self::collect) outside of updates.
    pub(crate) fn collect_now(&mut self) -> Result<()> {
        let mut stats = LiveStats::default();
        let result = self.collect(&mut stats);
        self.total_rays += stats.rays;
        result
    }

    /// Stops work in the background (refinement between updates, and the recomputation of indirect light), or lets it
    /// go on with the next update.
    pub fn pause(&mut self, paused: bool) -> Result<()> {
        self.paused = paused;
        self.relight.hold(paused, &self.context.map, &self.bake, &self.context.light.sides)?;
        self.collect_now()
    }
}

impl Drop for Live {
    fn drop(&mut self) {
        if let Some(background) = self.background.take() {
            if self.device().check_process().is_err() {
                // The threads that it would wait for are in another process.
                std::mem::forget(background);
            } else {
                // An error is ignored: the object ends here and nothing is lost.
                let _ = background.finish();
            }
        }
        // Drops the relighting before the scene: the last reference to the scene then ends here, not on the thread that
        // relights.
        drop(std::mem::take(&mut self.relight));
    }
}
