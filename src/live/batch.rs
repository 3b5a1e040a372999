//! Blocks that several threads work on: during an update, or between updates. The blocks are moved
//! into the batch and taken back from it, so that nothing is locked that anybody else reads.

use super::blocks::{Block, Blocks};
use super::limit::Limit;
use super::work::{Context, Done, Step};
use crate::base::error::{Error, Result};
use crate::base::memory::try_with_capacity;
use crate::device::Device;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering::Relaxed};
use std::sync::{Arc, Condvar, Mutex, MutexGuard};
use std::time::Duration;

/// A block while it is in a batch.
pub(super) struct Item {
    pub number: u32,
    pub block: Block,
    /// Bytes that the block held before the work.
    pub bytes: usize,
    pub done: Done,
}

/// Blocks, the most urgent first, with the work to be done on them.
pub(super) struct Batch {
    context: Context,
    items: Vec<Mutex<Item>>,
    step: Step,
    limit: Limit,
    /// Time that showing a completed block will take, to be kept free.
    showing: Duration,
    next: AtomicUsize,
    completed: AtomicUsize,
    panicked: AtomicBool,
}

/// The result of a batch: its blocks, the rays traced, and an error if a thread panicked.
pub(super) type Outcome = (Vec<Mutex<Item>>, u64, Result<()>);

impl Batch {
    /// Takes those of the `chosen` blocks that are not away. If it fails, none is taken.
    pub fn new(
        context: Context,
        blocks: &mut Blocks,
        chosen: &[u32],
        step: Step,
        limit: Limit,
        showing: Duration,
    ) -> Result<Batch> {
        let mut items = try_with_capacity(chosen.len(), "blocks to be worked on")?;
        items.extend(chosen.iter().filter_map(|&number| {
            let block = blocks.take(number)?;
            Some(Mutex::new(Item { number, bytes: block.work.bytes(), block, done: Done::default() }))
        }));
        Ok(Batch {
            context,
            items,
            step,
            limit,
            showing,
            next: AtomicUsize::new(0),
            completed: AtomicUsize::new(0),
            panicked: AtomicBool::new(false),
        })
    }

    /// Works on the threads of the pool that this is called in, as many as come, and waits for those.
    /// (`rayon::broadcast` waits for all. While light is recomputed on a third thread of a machine with two
    /// cores that cost p90 of the overshoot 2 to 4 ms, a scheduler's time slice, instead of 0.4; p99 is a
    /// time slice still. Did not help: one thread fewer meanwhile; a lower priority of that third thread.)
    pub fn run(self) -> Outcome {
        rayon::scope(|scope| {
            for _ in 1..rayon::current_num_threads() {
                scope.spawn(|_| self.work());
            }
            self.work();
        });
        self.outcome()
    }

    fn work(&self) {
        // A panic must not cross into the pool, where it would abort.
        let result = catch_unwind(AssertUnwindSafe(|| {
            let Some(mut room) = self.limit.granted(self.context.room()) else { return };
            while let Some(item) = self.items.get(self.next.fetch_add(1, Relaxed)) {
                let showing = self.showing * self.completed.load(Relaxed) as u32;
                if self.limit.reached_after(showing) {
                    break;
                }
                let mut item = item.lock().unwrap_or_else(|e| e.into_inner());
                let tile = &self.context.map.tiles[item.number as usize];
                item.done = item.block.work(&self.context, tile, self.step, &mut room, &self.limit);
                self.completed.fetch_add(item.done.any() as usize, Relaxed);
            }
        }));
        if result.is_err() {
            self.panicked.store(true, Relaxed);
        }
    }

    fn outcome(self) -> Outcome {
        let result = if self.panicked.into_inner() {
            Err(Error::Internal("work on a block of texels panicked".into()))
        } else {
            self.limit.check_memory()
        };
        (self.items, self.limit.traced(), result)
    }
}

/// A batch that a device's threads work on while the caller does something else.
///
/// Jobs that a busy pool starts late, when the batch has been taken back, find it closed: they hold no reference to the
/// batch, hence none to the scene, whose last reference must not end on such a thread.
pub(super) struct Background {
    door: Arc<Door>,
}

#[derive(Default)]
struct Door {
    state: Mutex<Inside>,
    idle: Condvar,
}

#[derive(Default)]
struct Inside {
    /// The batch; `None` once it is closed.
    batch: Option<Arc<Batch>>,
    /// Number of threads at work.
    active: usize,
}

impl Background {
    /// Starts work on the device's threads and returns at once.
    pub fn start(batch: Batch, device: &Device) -> Background {
        let inside = Inside { batch: Some(Arc::new(batch)), active: 0 };
        let door = Arc::new(Door { state: Mutex::new(inside), ..Default::default() });
        for _ in 0..device.num_threads() {
            let door = door.clone();
            device.spawn(move || {
                let Some(batch) = door.enter() else { return };
                batch.work();
                door.leave(batch);
            });
        }
        Background { door }
    }

    /// Stops the work and takes the blocks back. Waits for threads that are at work, each of which finishes its current
    /// texels, and calls no callback meanwhile; afterwards no thread holds a reference to the batch.
    pub fn finish(self) -> Outcome {
        let mut inside = self.door.inside();
        let Some(batch) = inside.batch.take() else { return (Vec::new(), 0, Ok(())) };
        batch.limit.stop();
        while inside.active > 0 {
            inside = self.door.idle.wait(inside).unwrap_or_else(|e| e.into_inner());
        }
        match Arc::try_unwrap(batch) {
            Ok(batch) => batch.outcome(),
            Err(_) => unreachable!("threads drop their references before they count themselves out"),
        }
    }
}

impl Door {
    fn inside(&self) -> MutexGuard<'_, Inside> {
        self.state.lock().unwrap_or_else(|e| e.into_inner())
    }

    fn enter(&self) -> Option<Arc<Batch>> {
        let mut inside = self.inside();
        let batch = inside.batch.clone()?;
        inside.active += 1;
        Some(batch)
    }

    fn leave(&self, batch: Arc<Batch>) {
        drop(batch);
        self.inside().active -= 1;
        self.idle.notify_all();
    }
}
