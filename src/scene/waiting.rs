//! Rays that wait at the parts of a tree until enough of them do (Pharr, Kolb, Gershbein and Hanrahan, *Rendering Complex
//! Scenes with Memory-Coherent Ray Tracing*, 1997), so that a part of a scene that is larger than memory is read from disk
//! for many rays at once.
//!
//! Threads that need hits bring rays in batches and wait for them. Other threads go from part to part, in the order of the
//! file, and trace what waits there of all batches. There are many more of those that wait than there are cores, so that
//! many rays wait; what each does between its batches is the same as ever.

use super::Scene;
use crate::base::callback;
use crate::base::error::Result;
use crate::base::memory::{Reservation, try_filled, try_with_capacity};
use crate::base::threads::{self, Threads, Work};
use crate::bvh::parts::Parts;
use std::ops::RangeInclusive;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Size of a part in bytes: of trees of any size some hundreds, but none so small that a disk reads it slowly, nor so large
/// that few rays need much of it.
const PART_BYTES: RangeInclusive<usize> = 16 << 10..=8 << 20;
const PARTS: usize = 256;

/// Threads that wait, per thread of the device, and the most in all.
const THREADS: usize = 128;
const MOST_THREADS: usize = 512;

/// Threads that trace what waits, per thread of the device, and the most in all: most of their time they wait for the disk.
const TRACING: usize = 8;
const MOST_TRACING: usize = 64;

/// Number of rays from which on all of a part is read; the pages that fewer need are read one by one.
const WORTH_READING: usize = 1 << 10;

/// A batch of rays.
pub(crate) trait Batch: Send + Sync {
    /// Asks the system to read a part. Called only while rays of the batch wait.
    fn prepare(&self, part: u32);

    /// Traces the rays that wait at a part, and calls `go_on` with the parts at which they wait then, and their numbers.
    /// Called only while rays of the batch wait.
    fn visit(&self, part: u32, go_on: &mut dyn FnMut(u32, usize));

    /// Ends the wait for the rays, as a visit has panicked: who waits panics, too.
    fn fail(&self);
}

/// The tree of a scene in parts, and the rays that wait there.
pub(crate) struct WaitingRays {
    pub tree: Parts,
    queues: Arc<Queues>,
    waiting: Threads,
    tracing: Vec<JoinHandle<()>>,
    _memory: Reservation,
}

/// What waiting and tracing threads share.
struct Queues {
    state: Mutex<State>,
    /// Rays have come, or the scene goes.
    changed: Condvar,
}

struct State {
    /// By part.
    queues: Vec<Queue>,
    /// Number of rays that wait at all parts.
    rays: usize,
    /// The part after the last one that was visited.
    next: usize,
    /// When the last batch came.
    last: Instant,
    /// Mean time of the last visits.
    visit: Duration,
    is_over: bool,
}

/// What waits at a part.
#[derive(Clone, Default)]
struct Queue {
    batches: Vec<Arc<dyn Batch>>,
    rays: usize,
}

impl State {
    fn add(&mut self, batch: &Arc<dyn Batch>, part: u32, rays: usize) {
        let queue = &mut self.queues[part as usize];
        queue.batches.push(batch.clone());
        queue.rays += rays;
        self.rays += rays;
    }

    /// The next part at which not much fewer rays wait than on average. (Where only few wait, more will come.)
    fn next(&self) -> Option<usize> {
        let parts = self.queues.iter().filter(|queue| queue.rays > 0).count();
        let is_worth_it = |&part: &usize| self.queues[part].rays > 0 && 2 * parts * self.queues[part].rays >= self.rays;
        (self.next..self.queues.len()).chain(0..self.next).find(is_worth_it)
    }
}

impl Queues {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Traces what waits until the scene goes.
    fn trace(&self) {
        let mut state = self.lock();
        while !state.is_over {
            let Some(part) = state.next() else {
                state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
                continue;
            };
            // Threads that are about to bring more are given a quarter of the time that a visit takes.
            let (since, quiet) = (state.last.elapsed(), state.visit / 4);
            if since < quiet {
                let waited = self.changed.wait_timeout(state, quiet - since);
                state = waited.unwrap_or_else(PoisonError::into_inner).0;
                continue;
            }
            let Queue { batches, rays } = std::mem::take(&mut state.queues[part]);
            (state.next, state.rays) = (part + 1, state.rays - rays);
            drop(state);
            let start = Instant::now();
            if rays >= WORTH_READING {
                batches[0].prepare(part as u32);
            }
            let mut onward = Vec::new();
            for batch in &batches {
                let mut go_on = |part, rays| onward.push((batch, part, rays));
                // Nothing of a batch that has failed is read again.
                if catch_unwind(AssertUnwindSafe(|| batch.visit(part as u32, &mut go_on))).is_err() {
                    batch.fail();
                }
            }
            state = self.lock();
            onward.into_iter().for_each(|(batch, part, rays)| state.add(batch, part, rays));
            state.visit = (7 * state.visit + start.elapsed()) / 8;
        }
    }
}

impl WaitingRays {
    /// Cuts the tree of a scene.
    pub(super) fn of(scene: &Scene) -> Result<WaitingRays> {
        let (tree, _) = scene.acceleration();
        let bytes = (tree.bytes() / PARTS).clamp(*PART_BYTES.start(), *PART_BYTES.end());
        let tree = Parts::of(tree, &|t| scene.corners(t), bytes)?;
        let count = tree.parts.len();
        let memory = scene.device().memory().reserve(tree.bytes() + count * size_of::<Queue>(), QUEUES)?;
        let queues = try_filled(count, Queue::default(), QUEUES)?;
        let state = State { queues, rays: 0, next: 0, last: Instant::now(), visit: Duration::ZERO, is_over: false };
        let threads = scene.device().num_threads();
        let tracing = (TRACING * threads).min(MOST_TRACING);
        let mut waiting = WaitingRays {
            tree,
            queues: Arc::new(Queues { state: Mutex::new(state), changed: Condvar::new() }),
            waiting: Threads::start_apart((THREADS * threads).min(MOST_THREADS), |i| format!("bakelite-extra-{i}"))?,
            tracing: try_with_capacity(tracing, QUEUES)?,
            _memory: memory,
        };
        for i in 0..tracing {
            let queues = waiting.queues.clone();
            waiting.tracing.push(threads::start_one(format!("bakelite-rays-{i}"), move || queues.trace())?);
        }
        Ok(waiting)
    }

    /// Brings a batch. `first`: the parts at which its rays wait at first, with their numbers. The batch must not go before
    /// no ray waits any more.
    pub(crate) fn bring(&self, batch: &Arc<dyn Batch>, first: impl Iterator<Item = (u32, usize)>) {
        let mut state = self.queues.lock();
        first.for_each(|(part, rays)| state.add(batch, part, rays));
        state.last = Instant::now();
        drop(state);
        self.queues.changed.notify_one();
    }
}

impl Drop for WaitingRays {
    fn drop(&mut self) {
        if self.waiting.are_in_another_process() {
            // After a fork the threads are not in this process, and may have held the lock.
            std::mem::forget(std::mem::take(&mut self.tracing));
            return;
        }
        self.queues.lock().is_over = true;
        self.queues.changed.notify_all();
        threads::end(&mut self.tracing);
    }
}

impl Scene {
    /// Runs `f` on the threads that trace the scene's rays: the device's or, where rays wait, others, which are many more.
    pub(crate) fn install<R: Send>(&self, f: impl FnOnce() -> R + Send) -> R {
        let (mut f, mut result) = (Some(f), None);
        self.install_work(&mut || result = f.take().map(|f| f()));
        result.expect("the work has been done, or it has unwound")
    }

    fn install_work(&self, work: Work) {
        match self.parts() {
            // What a callback asks for must not wait for threads that may be in it.
            Some(parts) if !callback::is_running() => parts.waiting.pool().install(work),
            _ => self.device().install(work),
        }
    }
}

/// Name of this memory in error messages.
const QUEUES: &str = "queues of rays";
