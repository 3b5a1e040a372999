//! Blocks that several threads work on: during an update, or between updates. The blocks are moved
//! into the batch and taken back from it, so that nothing is locked that anybody else reads.

use super::blocks::Block;
use super::work::{Context, Done, Limit, Step};
use crate::device::Device;
use crate::error::{Error, Result};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering::Relaxed};
use std::sync::{Arc, Condvar, Mutex, MutexGuard};
use std::time::{Duration, Instant};

/// A block on its way through a batch.
pub(super) struct Item {
    pub number: u32,
    pub block: Block,
    /// That the block held before.
    pub bytes: usize,
    pub done: Done,
}

/// Blocks, the most urgent first, and the threads at work on them.
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
    /// Threads at work in the background.
    active: Mutex<usize>,
    idle: Condvar,
}

impl Batch {
    pub fn new(
        context: Context,
        blocks: impl Iterator<Item = (u32, Block)>,
        step: Step,
        limit: Limit,
        showing: Duration,
    ) -> Batch {
        let item = |(number, block): (u32, Block)| {
            Mutex::new(Item { number, bytes: block.bytes(), block, done: Done::default() })
        };
        Batch {
            context,
            items: blocks.map(item).collect(),
            step,
            limit,
            showing,
            next: AtomicUsize::new(0),
            completed: AtomicUsize::new(0),
            panicked: AtomicBool::new(false),
            active: Mutex::new(0),
            idle: Condvar::new(),
        }
    }

    /// Works on the threads of the pool that this is called in, as many as come, and waits for those.
    /// (`rayon::broadcast` waits for all. While light is recomputed on a third thread of a machine with two
    /// cores that cost p90 of the overshoot 2 to 4 ms, a scheduler's time slice, instead of 0.4; p99 is a
    /// time slice still. Did not help: one thread fewer meanwhile; a lower priority of that third thread.)
    pub fn run(&self) {
        rayon::scope(|scope| {
            for _ in 1..rayon::current_num_threads() {
                scope.spawn(|_| self.work());
            }
            self.work();
        });
    }

    /// Works on the device's threads and returns at once.
    pub fn start(self: &Arc<Self>, device: &Device) {
        for _ in 0..device.num_threads() {
            let batch = self.clone();
            device.spawn(move || {
                // Whoever stopped the batch does not wait for threads that come later.
                let mut active = batch.active();
                if batch.limit.stopped.load(Relaxed) {
                    return;
                }
                *active += 1;
                drop(active);
                batch.work();
                *batch.active() -= 1;
                batch.idle.notify_all();
            });
        }
    }

    /// Stops the work and takes the blocks back, with the rays traced. Waits for threads that are at
    /// work, each of which ends with the texel it is at.
    pub fn take(&self) -> (Vec<Item>, u64, Result<()>) {
        let mut active = self.active();
        self.limit.stopped.store(true, Relaxed);
        while *active > 0 {
            active = self.idle.wait(active).unwrap_or_else(|e| e.into_inner());
        }
        let take = |item: &Mutex<Item>| {
            let mut item = item.lock().unwrap_or_else(|e| e.into_inner());
            Item { block: std::mem::take(&mut item.block), ..*item }
        };
        let result = match self.panicked.load(Relaxed) {
            true => Err(Error::Internal("work on a block of texels panicked".into())),
            false => Ok(()),
        };
        (self.items.iter().map(take).collect(), self.limit.traced.load(Relaxed), result)
    }

    fn active(&self) -> MutexGuard<'_, usize> {
        self.active.lock().unwrap_or_else(|e| e.into_inner())
    }

    fn work(&self) {
        // A panic must not cross into the pool, where it would abort.
        let result = catch_unwind(AssertUnwindSafe(|| {
            while let Some(item) = self.items.get(self.next.fetch_add(1, Relaxed)) {
                let showing = self.showing * self.completed.load(Relaxed) as u32;
                if self.limit.reached() || self.limit.deadline.is_some_and(|d| Instant::now() + showing >= d) {
                    break;
                }
                let mut item = item.lock().unwrap_or_else(|e| e.into_inner());
                let tile = &self.context.map.tiles[item.number as usize];
                item.done = item.block.work(&self.context, tile, self.step, &self.limit);
                self.completed.fetch_add(item.done.any() as usize, Relaxed);
            }
        }));
        if result.is_err() {
            self.panicked.store(true, Relaxed);
        }
    }
}
