//! Renewal of the light that live updates show, in the background: when a light changes, when the scene has moved, and
//! after a quick start.
//!
//! Direct light follows at once. Indirect light needs new photons and a new radiance map, which one
//! thread computes beside the updates: first with a sixteenth of the photons, so that the change is
//! soon seen, then with all; after a quick start with all at once. So few photons cannot tell which side of a sheet is the
//! lit one (with them, Sponza showed 8 % error for a second): sides change with all photons only.

use super::Live;
use super::blocks::{BlockMap, Tile};
use super::display::Display;
use super::follow::Following;
use super::illumination::{Illumination, Indirect, Part, Sides, illuminate};
use super::show::Marking;
use crate::base::error::{Error, Result, invalid_argument};
use crate::base::gate::{Closed, Gate};
use crate::base::memory::try_vec;
use crate::base::progress::Progress;
use crate::device::{Device, DeviceOptions};
use crate::direct::DirectLight;
use crate::lightmap::BakeParams;
use crate::lightmap::atlas::Atlas;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::mpsc::{Receiver, TryRecvError, channel};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// Divisor of the photon count in the first, quick renewal.
const QUICK_PART: u64 = 16;

/// Renews indirect light on a thread of its own.
#[derive(Default)]
pub(super) struct Relight {
    /// Device with one thread, created at the first renewal.
    device: Option<Arc<Device>>,
    running: Option<Running>,
    /// Where the thread waits during updates, if there is no core for it beside the threads of these: it would take their
    /// time slices.
    gate: Option<Arc<Gate>>,
    /// Whether light changed while a renewal of before was under way, or while on hold.
    again: bool,
    on_hold: bool,
    /// What renewals are compared with, if all that has changed is that the scene has moved or was described anew.
    pub following: Option<Following>,
}

struct Running {
    /// The state of the scene whose light it computes.
    atlas: Arc<Atlas>,
    /// Receives the results; disconnected when the renewal has ended.
    results: Mutex<Receiver<Result<Indirect>>>,
    /// Cancels the part with all photons; set when a light changes.
    cancel: Arc<AtomicBool>,
    /// Cancels the quick part too; set when the live object ends.
    abandon: Arc<AtomicBool>,
}

impl Relight {
    /// Relighting beside updates on `threads` threads.
    pub fn beside(threads: usize) -> Relight {
        let cores = std::thread::available_parallelism().map_or(usize::MAX, |n| n.get());
        let mut relight = Relight::default();
        relight.gate = (threads >= cores).then(Arc::default);
        relight
    }

    /// Keeps the thread waiting, if it should, until the result is dropped.
    pub fn make_way(&self) -> Option<Closed> {
        let gate = self.gate.as_ref().filter(|_| self.running.is_some());
        gate.map(|gate| gate.close())
    }

    /// Begins a renewal, or makes another one follow the one under way. The quick part of the latter is always
    /// finished: lights that move all the time are followed in steps. It keeps the shown `sides`.
    pub fn start(&mut self, map: &Arc<BlockMap>, params: &BakeParams, sides: &Arc<Sides>) -> Result<()> {
        if let Some(running) = &self.running {
            running.cancel.store(true, Relaxed);
        }
        if self.running.is_some() || self.on_hold {
            self.again = true;
            return Ok(());
        }
        self.begin(map, params, Some(sides.clone()))
    }

    /// Begins the computation with all photons that follows a first impression.
    pub fn follow_first_impression(&mut self, map: &Arc<BlockMap>, params: &BakeParams) -> Result<()> {
        self.begin(map, params, None)
    }

    /// Begins a renewal; with a quick part if there are sides that this keeps.
    fn begin(&mut self, map: &Arc<BlockMap>, params: &BakeParams, shown: Option<Arc<Sides>>) -> Result<()> {
        let device = match &self.device {
            Some(device) => device.clone(),
            None => Device::new(DeviceOptions {
                num_threads: 1,
                isa: Some(map.atlas.scene.device().isa()),
                ..Default::default()
            })?,
        };
        let (of, params, following) = (map.clone(), *params, self.following.clone());
        let (sender, results) = channel();
        let cancel = Arc::new(AtomicBool::new(false));
        let abandon = Arc::new(AtomicBool::new(false));
        let (cancelled, abandoned) = (cancel.clone(), abandon.clone());
        let gate = self.gate.clone();
        let compute = move |params: &BakeParams, sides: Option<Arc<Sides>>, progress: &Progress| {
            let result = catch_unwind(AssertUnwindSafe(|| {
                let atlas = &of.atlas;
                let mut new = illuminate(atlas, params, &DirectLight::try_new(&atlas.scene)?, sides, progress)?;
                if new.part == Part::Whole {
                    // Here, since it would take an update longer than it has.
                    new.alone = try_vec(of.tiles.len(), "texels on their own")?;
                    Display::find_alone(&of, &new.sides, &mut new.alone);
                    if let Some(following) = &following {
                        new.kept = following.kept(atlas, &new, params, progress)?;
                    }
                }
                Ok(new)
            }));
            result.unwrap_or_else(|_| Err(Error::Internal("relighting panicked".into())))
        };
        device.spawn(move || {
            let quick = BakeParams { photon_count: params.photon_count.div_ceil(QUICK_PART), ..params };
            // Nobody receives the result when the live object is gone.
            let waiting = |progress: Progress<'static>| match gate.clone() {
                Some(gate) => progress.waiting_at(gate),
                None => progress,
            };
            let progress = waiting(Progress::new(move |_, _| !abandoned.load(Relaxed)));
            if shown.is_some() {
                let _ = sender.send(compute(&quick, shown, &progress));
            }
            let progress = waiting(Progress::new(move |_, _| !cancelled.load(Relaxed)));
            let _ = sender.send(compute(&params, None, &progress));
        });
        self.device = Some(device);
        self.running = Some(Running { atlas: map.atlas.clone(), results: Mutex::new(results), cancel, abandon });
        Ok(())
    }

    /// Requests a new computation of the last result, which was lost.
    pub fn redo(&mut self) {
        self.again = true;
    }

    /// Whether results are still expected.
    pub fn is_pending(&self) -> bool {
        self.running.is_some() || self.again
    }

    /// Stops a renewal; it begins again when the hold is over.
    pub fn hold(&mut self, on_hold: bool, map: &Arc<BlockMap>, params: &BakeParams, sides: &Arc<Sides>) -> Result<()> {
        self.on_hold = on_hold;
        if on_hold {
            if let Some(running) = &self.running {
                running.cancel.store(true, Relaxed);
                self.again = true;
            }
            return Ok(());
        }
        if self.running.is_none() && std::mem::take(&mut self.again) {
            self.start(map, params, sides)?;
        }
        Ok(())
    }

    /// Returns the newest finished result. Does not wait.
    pub fn poll(&mut self, map: &Arc<BlockMap>, params: &BakeParams, sides: &Arc<Sides>) -> Result<Option<Indirect>> {
        if self.running.is_none() && !self.on_hold && std::mem::take(&mut self.again) {
            self.start(map, params, sides)?;
        }
        let Some(running) = &mut self.running else { return Ok(None) };
        let results = running.results.get_mut().unwrap_or_else(|e| e.into_inner());
        let mut newest: Option<Indirect> = None;
        loop {
            match results.try_recv() {
                // The scene has moved since: what it was compared with is out of date. Another one follows.
                Ok(Ok(new)) if new.part == Part::Whole && !Arc::ptr_eq(&running.atlas, &map.atlas) => {}
                Ok(Ok(indirect)) => newest = Some(indirect),
                // Cancelled because of another change of light.
                Ok(Err(Error::Cancelled)) => {}
                Ok(Err(e)) => {
                    // A computation that failed for lack of memory may succeed another time. Its other part is
                    // cancelled.
                    self.retire();
                    self.again = true;
                    return Err(e);
                }
                Err(TryRecvError::Empty) => break,
                Err(TryRecvError::Disconnected) => {
                    self.running = None;
                    if !self.on_hold && std::mem::take(&mut self.again) {
                        // Uses the sides that the caller will show.
                        let newer = newest.as_ref().filter(|new| new.has_indirect).map(|new| &new.sides);
                        self.start(map, params, newer.unwrap_or(sides))?;
                    }
                    break;
                }
            }
        }
        Ok(newest)
    }
}

impl Relight {
    /// Cancels the renewal under way.
    fn retire(&mut self) {
        if let Some(running) = self.running.take() {
            running.cancel.store(true, Relaxed);
            running.abandon.store(true, Relaxed);
        }
    }
}

impl Drop for Relight {
    /// Cancels a renewal and waits for its thread, unless this is that thread (the last reference was released in a
    /// callback that it called): the renewal then ends after the callback has returned.
    fn drop(&mut self) {
        self.retire();
        // Nobody else holds the device, so its thread is joined here.
        self.device = None;
    }
}

impl Live {
    /// Takes over new indirect light, if there is any, and all of what that before has changed is marked.
    pub(super) fn take_new_light(&mut self) -> Result<()> {
        if self.paused || self.marking.is_some() {
            return Ok(());
        }
        let Some(mut new) = self.relight.poll(&self.context.map, &self.bake, &self.context.light.sides)? else {
            return Ok(());
        };
        let (part, kept, alone) = (new.part, std::mem::take(&mut new.kept), std::mem::take(&mut new.alone));
        let has_moved = part == Part::Whole && self.relight.following.is_some();
        let before = self.context.light.clone();
        let renewed = before.renewed(new).inspect_err(|_| self.relight.redo())?;
        self.context.light = Arc::new(renewed);
        self.display.begin_indirect_epoch();
        self.keep_indirect(before.indirect_epoch, part, &kept);
        if self.context.light.direct_epoch != before.direct_epoch {
            self.display.begin_direct_epoch();
            let (map, backs) = (self.context.map.clone(), [before.sides.clone(), self.context.light.sides.clone()]);
            // New indirect light may turn some charts over.
            self.keep_direct(before.direct_epoch, |_, tile| {
                let chart = map.atlas.gather.layout.chart_of(tile.placement).index();
                backs[0].backs.get(chart) == backs[1].backs.get(chart)
            });
        }
        if !Arc::ptr_eq(&before.sides, &self.context.light.sides) {
            self.alone = alone;
        }
        self.marking = Some(Marking::of(before.sides.clone(), has_moved));
        self.chooser.note_all(&self.context, self.blocks.status());
        Ok(())
    }

    /// Keeps the direct light of an epoch valid in the present one, in blocks of which `is_same` says so.
    pub(super) fn keep_direct(&mut self, before_epoch: u32, is_same: impl Fn(u32, &Tile) -> bool) {
        let light = self.context.light.clone();
        for (b, tile) in (0u32..).zip(&self.context.map.tiles) {
            if !is_same(b, tile) {
                continue;
            }
            let renew = |epoch: &mut u32| {
                let is_good = *epoch == before_epoch;
                *epoch = if is_good { light.direct_epoch } else { *epoch };
                is_good
            };
            let status = &mut self.blocks.status_mut()[b as usize];
            if renew(&mut status.coarse_epoch) {
                if renew(&mut status.direct_epoch) {
                    self.display.keep_tile(b);
                }
                if let Some(work) = self.blocks.work_mut(b).and_then(|w| w.direct.as_mut()) {
                    renew(&mut work.epoch);
                }
            }
        }
    }

    /// Applies a change of light `id` of the scene: to direct light in the next updates, to indirect light when it has
    /// been recomputed in the background.
    pub fn light_changed(&mut self, id: u32) -> Result<()> {
        let lights = self.scene().lights();
        let count = lights.len();
        if id as usize >= count {
            return invalid_argument!("light {id} does not exist, the scene has {count}");
        }
        let direct = Arc::new(DirectLight::try_new(self.scene())?);
        self.context.map.atlas.make_room_for_sky_seen(&direct)?;
        self.collect_now()?;
        self.make_room_for_epochs()?;
        let following = self.relight.following.take();
        let started = self.relight.start(&self.context.map, &self.bake, &self.context.light.sides);
        started.inspect_err(|_| self.relight.following = following)?;
        // Nothing can fail from here on.
        self.display.begin_direct_epoch();
        self.lights = lights;
        self.context.light = Arc::new(Illumination {
            direct,
            direct_epoch: self.context.light.direct_epoch + 1,
            ..(*self.context.light).clone()
        });
        self.chooser.note_all(&self.context, self.blocks.status());
        Ok(())
    }

    /// Whether new indirect light is expected, or some of what it changes is not marked yet.
    pub(super) fn is_light_pending(&self) -> bool {
        self.relight.is_pending() || self.marking.is_some()
    }

    /// Waits for indirect light that is being recomputed, and takes it over.
    pub fn finish_relighting(&mut self) -> Result<()> {
        self.collect_now()?;
        while self.is_light_pending() && !self.paused {
            self.take_new_light()?;
            self.mark_new_light(usize::MAX);
            std::thread::sleep(Duration::from_millis(1));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::directional::Directional;
    use crate::lightmap::indirect::fallback_gather::OwnLight;
    use crate::lightmap::indirect::radiance_map::Radiance;
    use crate::lightmap::stages::Own;
    use crate::lightmap::{Lightmap, LightmapDesc};
    use crate::live::LiveParams;
    use crate::scene::{Light, builtin};
    use glam::Vec3;

    #[test]
    fn few_photons_turn_no_sides_over() {
        let scene = builtin("cornell").unwrap().committed();
        let plain = |value: Vec3| Radiance { values: vec![value; 3], ..Default::default() };
        let sides = |backs: [bool; 2]| Arc::new(Sides { backs: backs.to_vec(), ..Default::default() });
        let shown = sides([false, true]);
        let before = Illumination {
            direct: Arc::new(DirectLight::new(&scene)),
            radiance: Arc::new(plain(Vec3::ZERO)),
            sides: shown.clone(),
            own: Arc::new(vec![Some(Vec3::X), None]),
            own_directional: Arc::new(vec![Some(Directional::of(Vec3::X, Vec3::Y, 1.0)), None]),
            has_indirect: true,
            direct_epoch: 1,
            indirect_epoch: 1,
        };
        let new = |sides: &Arc<Sides>, light: OwnLight| Indirect {
            radiance: plain(Vec3::ONE),
            sides: sides.clone(),
            own: Own { directional: vec![Some(Directional::default()); light.len()], light, rays: 0 },
            has_indirect: true,
            part: Part::Whole,
            kept: Vec::new(),
            alone: Vec::new(),
        };
        let quick = before.renewed(new(&shown, vec![Some(Vec3::Y), None])).unwrap();
        assert_eq!((quick.direct_epoch, quick.indirect_epoch, quick.radiance.values[0]), (1, 2, Vec3::ONE));
        assert_eq!((&quick.sides.backs, quick.own[0]), (&before.sides.backs, Some(Vec3::Y)));
        let full = quick.renewed(new(&sides([true, true]), vec![Some(Vec3::Z)])).unwrap();
        assert_eq!((full.direct_epoch, full.indirect_epoch), (2, 3));
        assert_eq!((&full.sides.backs[..], &full.own[..]), (&[true, true][..], &[Some(Vec3::Z)][..]));
        // Texels that gather for themselves must not go on shining.
        let dark = quick.renewed(Indirect { has_indirect: false, ..new(&sides([true, true]), Vec::new()) }).unwrap();
        assert_eq!((&dark.sides.backs, &dark.own[..]), (&shown.backs, &[Some(Vec3::ZERO), None][..]));
        assert_eq!(before.renewed(new(&shown, Vec::new())).unwrap().own_directional.len(), 0);
        let gone_dark = before.renewed(Indirect { has_indirect: false, ..new(&shown, Vec::new()) }).unwrap();
        assert_eq!(gone_dark.own_directional[..], [Some(Directional::default()), None]);
    }

    #[test]
    fn what_new_light_changes_is_marked_in_steps() {
        let scene = builtin("cornell").unwrap().committed();
        let desc = LightmapDesc { texels_per_unit: 200.0, ..Default::default() };
        let lightmap = Lightmap::create(&scene, &desc, &Progress::none()).unwrap();
        let params = LiveParams { quick_start: true, photon_count: 20_000, ..Default::default() };
        let mut live = Live::new(&lightmap, &params, &Progress::none()).unwrap();
        while live.dirty.bytes_left() > 0 {
            live.dirty.take(usize::MAX, |_, _| ());
        }
        while live.marking.is_none() {
            live.take_new_light().unwrap();
            std::thread::sleep(Duration::from_millis(1));
        }
        assert!(!live.context.light.sides.is_first_impression && live.dirty.bytes_left() == 0);
        let (blocks, mut steps, mut left) = (live.blocks.len(), 0, 0);
        while live.marking.is_some() {
            assert!(live.is_light_pending());
            live.mark_new_light(7);
            steps += 1;
            assert!(live.dirty.bytes_left() >= left, "marks are lost");
            left = live.dirty.bytes_left();
        }
        assert!(blocks > 70 && steps == blocks.div_ceil(7), "{blocks} blocks in {steps} steps");
        // As after a restart, where all is marked at once.
        live.dirty.mark_all();
        assert!(10 * left > 9 * live.dirty.bytes_left(), "{left} of {} bytes", live.dirty.bytes_left());
    }

    /// The result of a renewal with few photons fits the shown sides, whatever sides are found later.
    #[test]
    fn a_quick_renewal_keeps_the_sides_and_renews_what_texels_gather_for_themselves() {
        let scene = builtin("atrium").unwrap().committed();
        let desc = LightmapDesc { texels_per_unit: 3.0, ..Default::default() };
        let lightmap = Lightmap::create(&scene, &desc, &Progress::none()).unwrap();
        let (atlas, params) = (lightmap.atlas(), BakeParams { photon_count: 20_000, ..Default::default() });
        let map = Arc::new(BlockMap::new(atlas, 3, 0.0, &Progress::none()).unwrap());
        let light = Illumination::new(atlas, &params, false, &Progress::none()).unwrap();
        assert!(light.own.iter().any(|own| own.is_some_and(|e| e != Vec3::ZERO)));
        let renewals = || {
            let (mut relight, mut results) = (Relight::default(), Vec::new());
            relight.start(&map, &params, &light.sides).unwrap();
            while relight.is_pending() {
                results.extend(relight.poll(&map, &params, &light.sides).unwrap());
                std::thread::sleep(std::time::Duration::from_millis(1));
            }
            results
        };
        let mut results = renewals();
        let last = results.pop().unwrap();
        assert!(!Arc::ptr_eq(&last.sides, &light.sides) && last.own.light == *light.own);
        if let Some(quick) = results.first() {
            assert!(Arc::ptr_eq(&quick.sides, &light.sides) && quick.own.light != *light.own);
        }
        // All lights go out.
        for id in 0..scene.lights().len() as u32 {
            let off = Light::Point { position: Vec3::ZERO, intensity: [0.0; 3] };
            scene.set_light(id, off).unwrap();
        }
        for new in renewals() {
            assert!(!new.has_indirect);
            let dark = light.renewed(new).unwrap();
            assert!(dark.own.len() == light.own.len() && dark.own.iter().flatten().all(|&e| e == Vec3::ZERO));
        }
    }
}
