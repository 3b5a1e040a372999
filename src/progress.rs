//! Progress reports and cancelling.
//!
//! A long call gets one [`Progress`]. Its stages each own a share of the bar and count work from
//! any thread; the callback is called by one thread at a time, with a fraction that never falls.

use crate::error::{Error, Result};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::time::{Duration, Instant};

/// Called with the fraction done in [0, 1] and the stage's name; `false` cancels.
pub type ProgressFn<'a> = dyn FnMut(f32, &str) -> bool + Send + 'a;

/// A report is made at most this often, so that tiny work items do not queue on the callback.
const REPORT_INTERVAL: Duration = Duration::from_millis(10);

struct Reporter<'a> {
    callback: Box<ProgressFn<'a>>,
    last: Option<Instant>,
    fraction: f32,
}

/// The progress of one call.
#[derive(Default)]
pub struct Progress<'a> {
    reporter: Option<Mutex<Reporter<'a>>>,
    cancelled: AtomicBool,
}

impl<'a> Progress<'a> {
    /// Reports to `callback`.
    pub fn new(callback: impl FnMut(f32, &str) -> bool + Send + 'a) -> Self {
        let reporter = Reporter { callback: Box::new(callback), last: None, fraction: 0.0 };
        Progress { reporter: Some(Mutex::new(reporter)), cancelled: AtomicBool::new(false) }
    }

    /// Reports to nobody and is never cancelled.
    pub fn none() -> Self {
        Progress { reporter: None, cancelled: AtomicBool::new(false) }
    }

    /// Whether the callback has asked to stop. Cheap enough for every tile of work.
    pub fn is_cancelled(&self) -> bool {
        self.cancelled.load(Relaxed)
    }

    /// `Err(Cancelled)` once the callback has asked to stop.
    pub fn check(&self) -> Result<()> {
        if self.is_cancelled() { Err(Error::Cancelled) } else { Ok(()) }
    }

    /// Starts a stage of `total` work items that covers `[from, to]` of the bar, and reports its
    /// start (so that a callback sees every stage, and can cancel in it).
    pub fn stage<'p>(&'p self, name: &'p str, from: f32, to: f32, total: u64) -> Stage<'p, 'a> {
        let stage = Stage { progress: self, name, from, to, total: total.max(1), done: AtomicU64::new(0) };
        stage.report(from, true);
        stage
    }
}

/// A part of a [`Progress`] bar, advanced from any thread.
pub struct Stage<'p, 'a> {
    progress: &'p Progress<'a>,
    name: &'p str,
    from: f32,
    to: f32,
    total: u64,
    done: AtomicU64,
}

impl Stage<'_, '_> {
    /// Counts `items` more as done; `Err(Cancelled)` once the callback has asked to stop.
    pub fn advance(&self, items: u64) -> Result<()> {
        let done = (self.done.fetch_add(items, Relaxed) + items).min(self.total);
        self.report(self.from + (self.to - self.from) * (done as f64 / self.total as f64) as f32, done == self.total);
        self.progress.check()
    }

    /// Whether the callback has asked to stop.
    pub fn is_cancelled(&self) -> bool {
        self.progress.is_cancelled()
    }

    fn report(&self, fraction: f32, must: bool) {
        let Some(reporter) = &self.progress.reporter else { return };
        // Workers never wait for a callback that another worker is in, except for the reports
        // that must not be lost.
        let guard = if must { reporter.lock().ok() } else { reporter.try_lock().ok() };
        let Some(mut r) = guard else { return };
        if self.progress.is_cancelled() {
            return;
        }
        let now = Instant::now();
        if !must && r.last.is_some_and(|t| now - t < REPORT_INTERVAL) {
            return;
        }
        r.last = Some(now);
        r.fraction = r.fraction.max(fraction);
        let fraction = r.fraction;
        if !(r.callback)(fraction, self.name) {
            self.progress.cancelled.store(true, Relaxed);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fraction_never_falls_and_every_stage_is_seen() {
        let mut seen: Vec<(f32, String)> = Vec::new();
        {
            let p = Progress::new(|f, s| {
                seen.push((f, s.to_string()));
                true
            });
            p.stage("a", 0.0, 0.5, 4).advance(4).unwrap();
            p.stage("b", 0.5, 1.0, 2).advance(2).unwrap();
        }
        assert!(seen.windows(2).all(|w| w[0].0 <= w[1].0));
        assert_eq!(seen.last().unwrap(), &(1.0, "b".to_string()));
        assert!(seen.iter().any(|s| s.1 == "a"));
    }

    #[test]
    fn a_callback_that_says_no_cancels() {
        let p = Progress::new(|f, _| f < 0.5);
        let s = p.stage("work", 0.0, 1.0, 2);
        assert_eq!(s.advance(2), Err(Error::Cancelled));
        assert!(p.is_cancelled());
    }
}
