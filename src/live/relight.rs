//! What live updates are lit by: lights, radiance map and sides, and their renewal in the background
//! when a light changes.
//!
//! Direct light follows at once. Indirect light needs new photons and a new radiance map, which one
//! thread computes beside the updates: first with a sixteenth of the photons, so that the change is
//! soon seen, then with all. So few photons cannot tell which side of a sheet is the lit one (with
//! them, Sponza showed 8 % error for a second): sides change with all photons only.

use crate::device::{Device, DeviceOptions};
use crate::error::{Error, Result};
use crate::lightmap::bake::Bake;
use crate::lightmap::direct::DirectLight;
use crate::lightmap::plan::{Plan, left_out};
use crate::lightmap::radiance::Radiance;
use crate::lightmap::upsample::Upsampling;
use crate::lightmap::{Atlas, BakeParams, BakeStats};
use crate::progress::Progress;
use glam::Vec3;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::mpsc::{Receiver, TryRecvError, channel};
use std::sync::{Arc, Mutex};

/// The first renewal takes this part of the photons.
const QUICK_PART: u64 = 16;

/// Light as texels see it.
#[derive(Clone)]
pub(super) struct Illumination {
    pub direct: Arc<DirectLight>,
    /// By sample of the radiance map.
    pub radiance: Arc<Radiance>,
    /// Per chart with one place, whether its back is shown.
    pub backs: Arc<Vec<bool>>,
    /// What the light map shows of the gather map on these sides; all as it comes without indirect light.
    pub upsampling: Arc<Upsampling>,
    /// Whether there is, or ever was, any indirect light.
    pub has_indirect: bool,
    /// Numbers that change with the parts.
    pub direct_epoch: u32,
    pub indirect_epoch: u32,
}

/// Radiance map and sides.
pub(super) struct Indirect {
    radiance: Radiance,
    /// Which backs are shown, and upsampling there; `None`: as they were.
    sides: Option<(Vec<bool>, Upsampling)>,
    has_indirect: bool,
}

/// Computes radiance map and, `with_sides`, sides under the scene's lights of now.
fn illuminate(
    atlas: &Atlas,
    params: &BakeParams,
    direct: &DirectLight,
    with_sides: bool,
    progress: &Progress,
) -> Result<Indirect> {
    let two_sided = !atlas.radiance.layout.back_of.is_empty();
    let plan = Plan::new(&atlas.scene, direct, params, two_sided, false);
    let bake = Bake { atlas, params, plan: &plan, direct, range: 0..atlas.map.len(), progress };
    let radiance = bake.illuminate(&mut BakeStats::default())?;
    let has_indirect = plan.runs(left_out::INDIRECT);
    let sides = if with_sides {
        let backs = bake.backs(&radiance.values);
        let placements = if has_indirect { atlas.map.layout.placements.len() as u32 } else { 0 };
        let upsampling = bake.upsampling(&radiance, &backs, 0..placements)?;
        Some((backs, upsampling))
    } else {
        None
    };
    Ok(Indirect { radiance, sides, has_indirect })
}

impl Illumination {
    /// Of the scene's lights of now, with all photons.
    pub fn new(atlas: &Atlas, params: &BakeParams, progress: &Progress) -> Result<Illumination> {
        let direct = DirectLight::new(&atlas.scene);
        let i = illuminate(atlas, params, &direct, true, progress)?;
        let (backs, upsampling) = i.sides.unwrap_or_default();
        Ok(Illumination {
            direct: Arc::new(direct),
            radiance: Arc::new(i.radiance),
            backs: Arc::new(backs),
            upsampling: Arc::new(upsampling),
            has_indirect: i.has_indirect,
            direct_epoch: 1,
            indirect_epoch: 1,
        })
    }

    /// With new indirect light.
    pub fn renewed(&self, new: Indirect) -> Illumination {
        let mut light = Illumination { indirect_epoch: self.indirect_epoch + 1, ..self.clone() };
        if new.has_indirect {
            light.radiance = Arc::new(new.radiance);
            if let Some((backs, upsampling)) = new.sides {
                light.upsampling = Arc::new(upsampling);
                if *light.backs != backs {
                    // Other sides are shown: their direct light is another one too.
                    light.direct_epoch += 1;
                    light.backs = Arc::new(backs);
                }
            }
            light.has_indirect = true;
        } else {
            // All went dark: what is there fades to black, on the sides that are shown.
            light.upsampling = Arc::default();
            light.radiance =
                Arc::new(Radiance { values: vec![Vec3::ZERO; self.radiance.values.len()], ..Default::default() });
        }
        light
    }
}

/// Renews indirect light on a thread of its own.
#[derive(Default)]
pub(super) struct Relight {
    /// One thread, from the first renewal on.
    device: Option<Arc<Device>>,
    running: Option<Running>,
    /// The lights changed while a renewal under older ones was under way, or while on hold.
    again: bool,
    on_hold: bool,
}

struct Running {
    /// Closed when the renewal has ended.
    results: Mutex<Receiver<Result<Indirect>>>,
    cancel: Arc<AtomicBool>,
}

impl Relight {
    /// Begins a renewal, or has the one under way followed by another. The quick part of that one is
    /// always finished: lights that move all the time are followed in steps.
    pub fn start(&mut self, atlas: &Arc<Atlas>, params: &BakeParams) -> Result<()> {
        if let Some(running) = &self.running {
            running.cancel.store(true, Relaxed);
        }
        if self.running.is_some() || self.on_hold {
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
        let compute = move |params: &BakeParams, with_sides: bool, progress: &Progress| {
            let direct = DirectLight::new(&atlas.scene);
            let result = catch_unwind(AssertUnwindSafe(|| illuminate(&atlas, params, &direct, with_sides, progress)));
            result.unwrap_or_else(|_| Err(Error::Internal("relighting panicked".into())))
        };
        device.spawn(move || {
            let quick = BakeParams { photon_count: params.photon_count.div_ceil(QUICK_PART), ..params };
            // Nobody listens any more when the live object is gone.
            let _ = sender.send(compute(&quick, false, &Progress::none()));
            let _ = sender.send(compute(&params, true, &Progress::new(|_, _| !cancelled.load(Relaxed))));
        });
        self.device = Some(device);
        self.running = Some(Running { results: Mutex::new(results), cancel });
        Ok(())
    }

    /// Whether results are still to come.
    pub fn is_pending(&self) -> bool {
        self.running.is_some() || self.again
    }

    /// Breaks a renewal off, to be begun again when it is no longer on hold.
    pub fn hold(&mut self, on_hold: bool, atlas: &Arc<Atlas>, params: &BakeParams) -> Result<()> {
        self.on_hold = on_hold;
        if on_hold {
            if let Some(running) = &self.running {
                running.cancel.store(true, Relaxed);
                self.again = true;
            }
            return Ok(());
        }
        if self.running.is_none() && std::mem::take(&mut self.again) {
            self.start(atlas, params)?;
        }
        Ok(())
    }

    /// The newest finished result. Does not wait.
    pub fn poll(&mut self, atlas: &Arc<Atlas>, params: &BakeParams) -> Result<Option<Indirect>> {
        let Some(running) = &mut self.running else { return Ok(None) };
        let results = running.results.get_mut().unwrap_or_else(|e| e.into_inner());
        let mut newest = None;
        loop {
            match results.try_recv() {
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
                    if !self.on_hold && std::mem::take(&mut self.again) {
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::builtin;

    #[test]
    fn few_photons_turn_no_sides_over() {
        let scene = builtin("cornell").unwrap().committed();
        let plain = |value: Vec3| Radiance { values: vec![value; 3], ..Default::default() };
        let before = Illumination {
            direct: Arc::new(DirectLight::new(&scene)),
            radiance: Arc::new(plain(Vec3::ZERO)),
            backs: Arc::new(vec![false, true]),
            upsampling: Arc::default(),
            has_indirect: true,
            direct_epoch: 1,
            indirect_epoch: 1,
        };
        let new = |sides| Indirect { radiance: plain(Vec3::ONE), sides, has_indirect: true };
        let quick = before.renewed(new(None));
        assert_eq!((quick.direct_epoch, quick.indirect_epoch, quick.radiance.values[0]), (1, 2, Vec3::ONE));
        assert_eq!(quick.backs, before.backs);
        let full = quick.renewed(new(Some((vec![true, true], Upsampling::default()))));
        assert_eq!((full.direct_epoch, full.indirect_epoch), (2, 3));
        assert_eq!(*full.backs, [true, true]);
        // Texels that gather for themselves must not go on shining.
        let dark = full.renewed(Indirect { has_indirect: false, ..new(None) });
        assert!(!Arc::ptr_eq(&dark.upsampling, &full.upsampling));
    }
}
