//! Conditions that end work on blocks.

use crate::base::error::{Error, Result};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::time::{Duration, Instant};

/// Conditions that end the work of an update.
pub(super) struct Limit {
    deadline: Option<Instant>,
    /// Number of rays that may be traced; `u64::MAX`: any number.
    rays: u64,
    /// Maximum number of texels whose rays are traced together, during which the work cannot be stopped.
    together: usize,
    traced: AtomicU64,
    /// Set to get the work back.
    stopped: AtomicBool,
    /// Set when memory for the work could not be allocated.
    out_of_memory: AtomicBool,
}

impl Limit {
    pub fn new(deadline: Option<Instant>, rays: u64, together: usize) -> Limit {
        Limit {
            deadline,
            rays,
            together,
            traced: AtomicU64::new(0),
            stopped: AtomicBool::new(false),
            out_of_memory: AtomicBool::new(false),
        }
    }

    /// Returns an error if memory for the work could not be allocated.
    pub fn check_memory(&self) -> Result<()> {
        if self.out_of_memory.load(Relaxed) {
            return Err(Error::OutOfMemory("the light of a block of texels".into()));
        }
        Ok(())
    }

    /// Unwraps the result of an allocation; records a failure.
    pub fn granted<T>(&self, result: Result<T>) -> Option<T> {
        result.inspect_err(|_| self.note_out_of_memory()).ok()
    }

    pub fn note_out_of_memory(&self) {
        self.out_of_memory.store(true, Relaxed);
    }

    /// Records rays that have been traced.
    pub fn add(&self, rays: u64) {
        self.traced.fetch_add(rays, Relaxed);
    }

    /// Number of rays that have been traced.
    pub fn traced(&self) -> u64 {
        self.traced.load(Relaxed)
    }

    /// Asks threads for the work back.
    pub fn stop(&self) {
        self.stopped.store(true, Relaxed);
    }

    /// Whether the limit has been reached; asked before some texels are worked on.
    pub fn reached(&self) -> bool {
        self.reached_after(Duration::ZERO)
    }

    /// Whether the limit has been reached, or will have been after some time.
    pub fn reached_after(&self, time: Duration) -> bool {
        self.stopped.load(Relaxed)
            || self.traced() >= self.rays
            || self.deadline.is_some_and(|d| Instant::now() + time >= d)
    }
}

/// Duration of work on a texel, by what it has taken lately.
pub(super) struct Pace {
    seconds: f64,
}

impl Pace {
    /// The pace before anything is known, in seconds per texel: slow rather than fast.
    pub fn new(seconds: f64) -> Pace {
        Pace { seconds }
    }

    /// Number of texels to work on before the limit is looked at again, at least one, if each takes a number of rays: as
    /// many as take half of the time that is left.
    pub fn texels(&self, limit: &Limit, rays: u64) -> usize {
        let left = limit.rays.saturating_sub(limit.traced());
        let by_rays = usize::try_from(left.div_ceil(rays)).unwrap_or(usize::MAX);
        let by_time = limit.deadline.map_or(usize::MAX, |deadline| {
            (0.5 * deadline.saturating_duration_since(Instant::now()).as_secs_f64() / self.seconds) as usize
        });
        limit.together.min(by_rays).min(by_time).max(1)
    }

    /// Notes that work on some texels has begun at a time and ends now.
    pub fn note(&mut self, begun: Instant, texels: usize) {
        let seconds = begun.elapsed().as_secs_f64() / texels.max(1) as f64;
        // So that a pause of the thread is not forgotten at once, nor for long.
        self.seconds = (self.seconds + 0.25 * (seconds - self.seconds)).max(1e-9);
    }
}
