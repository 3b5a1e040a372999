//! Rays that wait at the parts of a tree until enough of them do (Pharr, Kolb, Gershbein and Hanrahan, *Rendering Complex
//! Scenes with Memory-Coherent Ray Tracing*, 1997), so that a part of a scene that is larger than memory is read from disk
//! for many rays at once.
//!
//! Threads that trace rays bring them in batches and wait; the rays of all batches that wait at one part are traced
//! together, by one of these threads: always at the part where most wait. The more threads there are, the more rays wait.

use super::Scene;
use crate::base::error::Result;
use crate::base::memory::{Reservation, try_filled};
use crate::bvh::parts::Parts;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Size of a part in bytes: of trees of any size some hundreds, but none so small that a disk reads it slowly, nor so large
/// that few rays need much of it.
const PART_BYTES: std::ops::RangeInclusive<usize> = 16 << 10..=8 << 20;
const PARTS: usize = 256;

/// Number of rays for which a part is visited at once. For fewer, threads that are about to bring more are given
/// [`QUIET`].
const PLENTY: usize = 1 << 15;

/// Time without a new batch after which nobody is about to bring one.
const QUIET: Duration = Duration::from_millis(1);

/// Number of rays from which on all of a part is read; the pages that fewer need are read one by one.
const WORTH_READING: usize = 1 << 10;

/// A batch of rays.
pub(crate) trait Batch: Send + Sync {
    /// Traces the rays that wait at a part, and calls `go_on` with the parts at which they wait then, and their numbers.
    fn visit(&self, scene: &Scene, part: u32, go_on: &mut dyn FnMut(u32, usize));

    /// Whether no ray waits any more.
    fn is_done(&self) -> bool;
}

/// The tree of a scene in parts, and the rays that wait there.
pub(crate) struct WaitingRays {
    pub tree: Parts,
    queues: Mutex<Queues>,
    changed: Condvar,
    /// Maximum number of parts that are visited at the same time: one per core, as far as there are threads.
    most: usize,
    _memory: Reservation,
}

struct Queues {
    /// By part.
    queues: Vec<Queue>,
    /// Number of parts that are being visited.
    visited: usize,
    /// When the last batch came.
    last: Instant,
}

/// What waits at a part.
#[derive(Clone, Default)]
struct Queue {
    batches: Vec<Arc<dyn Batch>>,
    rays: usize,
}

impl Queues {
    fn add(&mut self, batch: &Arc<dyn Batch>, part: u32, rays: usize) {
        let queue = &mut self.queues[part as usize];
        queue.batches.push(batch.clone());
        queue.rays += rays;
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
        let cores = std::thread::available_parallelism().map_or(1, |n| n.get());
        Ok(WaitingRays {
            tree,
            queues: Mutex::new(Queues { queues, visited: 0, last: Instant::now() }),
            changed: Condvar::new(),
            most: cores.min(scene.device().num_threads()),
            _memory: memory,
        })
    }

    fn lock(&self) -> MutexGuard<'_, Queues> {
        self.queues.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Traces a batch to its end. `first`: the parts at which its rays wait at first, with their numbers.
    pub(crate) fn trace(&self, scene: &Scene, batch: &Arc<dyn Batch>, first: impl Iterator<Item = (u32, usize)>) {
        let mut queues = self.lock();
        first.for_each(|(part, rays)| queues.add(batch, part, rays));
        queues.last = Instant::now();
        while !batch.is_done() {
            let fullest = (0..).zip(&queues.queues).max_by_key(|(_, q)| q.rays);
            let (part, rays) = fullest.map_or((0, 0), |(part, queue)| (part, queue.rays));
            if rays == 0 || queues.visited >= self.most {
                queues = self.changed.wait(queues).unwrap_or_else(PoisonError::into_inner);
                continue;
            }
            let since = queues.last.elapsed();
            if rays < PLENTY && since < QUIET {
                let waited = self.changed.wait_timeout(queues, QUIET - since);
                queues = waited.unwrap_or_else(PoisonError::into_inner).0;
                continue;
            }
            let Queue { batches, .. } = std::mem::take(&mut queues.queues[part as usize]);
            queues.visited += 1;
            drop(queues);
            if rays >= WORTH_READING {
                scene.acceleration().0.will_need(&self.tree.parts[part as usize]);
            }
            let mut onward = Vec::new();
            for batch in &batches {
                batch.visit(scene, part, &mut |part, rays| onward.push((batch, part, rays)));
            }
            queues = self.lock();
            onward.into_iter().for_each(|(batch, part, rays)| queues.add(batch, part, rays));
            queues.visited -= 1;
            self.changed.notify_all();
        }
    }
}

/// Name of this memory in error messages.
const QUEUES: &str = "queues of rays";
