//! What live updates are lit by: lights, radiance map and sides, and their renewal in the background
//! when a light changes.
//!
//! Direct light follows at once. Indirect light needs new photons and a new radiance map, which one
//! thread computes beside the updates: first with a sixteenth of the photons, so that the change is
//! soon seen, then with all.

use crate::device::{Device, DeviceOptions};
use crate::error::{Error, Result};
use crate::lightmap::bake::Bake;
use crate::lightmap::direct::DirectLight;
use crate::lightmap::plan::{Plan, left_out};
use crate::lightmap::{Atlas, BakeParams, BakeStats};
use crate::progress::Progress;
use glam::Vec3;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::mpsc::{Receiver, TryRecvError, channel};

/// The first renewal takes this part of the photons.
const QUICK_PART: u64 = 16;

/// Light as texels see it.
pub(super) struct Illumination {
    pub direct: DirectLight,
    /// By sample of the radiance map.
    pub radiance: Vec<Vec3>,
    /// Per chart, whether its back is shown.
    pub backs: Vec<bool>,
    /// Whether there is any indirect light.
    pub has_indirect: bool,
    /// Numbers that change with the parts.
    pub direct_epoch: u32,
    pub indirect_epoch: u32,
}

/// Radiance map and sides.
pub(super) struct Indirect {
    radiance: Vec<Vec3>,
    backs: Vec<bool>,
    has_indirect: bool,
}

/// Computes radiance map and sides under the scene's lights of now.
pub(super) fn illuminate(
    atlas: &Atlas,
    params: &BakeParams,
    direct: &DirectLight,
    progress: &Progress,
) -> Result<Indirect> {
    let two_sided = !atlas.radiance.layout.back_of.is_empty();
    let plan = Plan::new(&atlas.scene, direct, params, two_sided, false);
    let bake = Bake { atlas, params, plan: &plan, direct, range: 0..atlas.map.len(), progress };
    let (radiance, backs) = bake.illuminate(&mut BakeStats::default())?;
    Ok(Indirect { radiance, backs, has_indirect: plan.runs(left_out::INDIRECT) })
}

impl Illumination {
    /// Of the scene's lights of now, with all photons.
    pub fn new(atlas: &Atlas, params: &BakeParams, progress: &Progress) -> Result<Illumination> {
        let direct = DirectLight::new(&atlas.scene);
        let i = illuminate(atlas, params, &direct, progress)?;
        Ok(Illumination {
            direct,
            radiance: i.radiance,
            backs: i.backs,
            has_indirect: i.has_indirect,
            direct_epoch: 1,
            indirect_epoch: 1,
        })
    }

    /// Takes new indirect light over.
    pub fn renew(&mut self, new: Indirect) {
        if self.backs != new.backs {
            // Other sides are shown: their direct light is another one too.
            self.direct_epoch += 1;
        }
        (self.radiance, self.backs, self.has_indirect) = (new.radiance, new.backs, new.has_indirect);
        self.indirect_epoch += 1;
    }
}

/// Renews indirect light on a thread of its own.
#[derive(Default)]
pub(super) struct Relight {
    /// One thread, from the first renewal on.
    device: Option<Arc<Device>>,
    running: Option<Running>,
    /// The lights changed while a renewal under older ones was under way.
    again: bool,
}

struct Running {
    /// Closed when the renewal has ended.
    results: Receiver<Result<Indirect>>,
    cancel: Arc<AtomicBool>,
}

impl Relight {
    /// Begins a renewal, or has the one under way followed by another. The quick part of that one is
    /// always finished: lights that move all the time are followed in steps.
    pub fn start(&mut self, atlas: &Arc<Atlas>, params: &BakeParams) -> Result<()> {
        if let Some(running) = &self.running {
            running.cancel.store(true, Relaxed);
            self.again = true;
            return Ok(());
        }
        let device = match &self.device {
            Some(device) => device.clone(),
            None => Device::new(DeviceOptions {
                num_threads: 1,
                isa: Some(atlas.scene.device().isa()),
                ..Default::default()
            })?,
        };
        let (atlas, params) = (atlas.clone(), *params);
        let (sender, results) = channel();
        let cancel = Arc::new(AtomicBool::new(false));
        let cancelled = cancel.clone();
        let send = move |params: &BakeParams, progress: &Progress| {
            let direct = DirectLight::new(&atlas.scene);
            let result = catch_unwind(AssertUnwindSafe(|| illuminate(&atlas, params, &direct, progress)));
            // Nobody listens any more when the live object is gone.
            let _ = sender.send(result.unwrap_or_else(|_| Err(Error::Internal("relighting panicked".into()))));
        };
        device.spawn(move || {
            let quick = BakeParams { photon_count: params.photon_count.div_ceil(QUICK_PART), ..params };
            send(&quick, &Progress::none());
            send(&params, &Progress::new(|_, _| !cancelled.load(Relaxed)));
        });
        self.device = Some(device);
        self.running = Some(Running { results, cancel });
        Ok(())
    }

    /// Whether results are still to come.
    pub fn is_pending(&self) -> bool {
        self.running.is_some()
    }

    /// The newest finished result. Does not wait.
    pub fn poll(&mut self, atlas: &Arc<Atlas>, params: &BakeParams) -> Result<Option<Indirect>> {
        let Some(running) = &self.running else { return Ok(None) };
        let mut newest = None;
        loop {
            match running.results.try_recv() {
                Ok(Ok(indirect)) => newest = Some(indirect),
                // Because of yet another change.
                Ok(Err(Error::Cancelled)) => {}
                Ok(Err(e)) => {
                    self.running = None;
                    return Err(e);
                }
                Err(TryRecvError::Empty) => break,
                Err(TryRecvError::Disconnected) => {
                    self.running = None;
                    if std::mem::take(&mut self.again) {
                        self.start(atlas, params)?;
                    }
                    break;
                }
            }
        }
        Ok(newest)
    }
}

impl Drop for Relight {
    fn drop(&mut self) {
        if let Some(running) = &self.running {
            running.cancel.store(true, Relaxed);
        }
    }
}
