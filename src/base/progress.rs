//! Progress reports and cancelling.
//!
//! A long call gets one [`Progress`]. Its stages each own a share of the bar and count work from any thread. While
//! [`Device::run`](crate::device::Device::run) carries the work out on the device's threads, the thread that made the
//! call waits for it and makes all reports: the same stage is reported again when no thread gets to count anything, no
//! worker ever waits for a callback, and a callback that waits for workers does not block them. Work that is not run
//! that way reports whenever it counts, on the thread that counts.

use crate::base::error::{Error, Result};
use crate::base::gate::Gate;
use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Called with the fraction done in [0, 1] and the stage's name; `false` cancels.
pub type ProgressFn<'a> = dyn FnMut(f32, &str) -> bool + Send + 'a;

/// Time between two reports of the same stage.
const INTERVAL: Duration = Duration::from_millis(15);

/// Maximum number of reports of starting stages that may follow each other at once.
const BURST: f64 = 20.0;

/// Average number of reports per second. With [`BURST`] there are at most 100 in any second.
const RATE: f64 = 80.0;

/// Decides which reports are made: those of the same stage at intervals, those of starting stages at once, and never
/// more than 100 in a second (a token bucket).
struct Pace {
    last_report: Option<Duration>,
    credit: f64,
    credit_at: Duration,
}

impl Pace {
    fn new() -> Self {
        Pace { last_report: None, credit: BURST, credit_at: Duration::ZERO }
    }

    /// Whether to report at the time `now`; if so, counts the report.
    fn allows(&mut self, now: Duration, starts_stage: bool) -> bool {
        if !starts_stage && self.last_report.is_some_and(|last| now.saturating_sub(last) < INTERVAL) {
            return false;
        }
        let passed = now.saturating_sub(self.credit_at).as_secs_f64();
        self.credit = (self.credit + RATE * passed).min(BURST);
        self.credit_at = now;
        if self.credit < 1.0 {
            return false;
        }
        self.credit -= 1.0;
        self.last_report = Some(now);
        true
    }
}

/// The caller's function with the progress reported to it.
struct Callback<'a> {
    function: Box<ProgressFn<'a>>,
    pace: Pace,
    fraction: f32,
}

/// News that are still to be reported.
#[derive(Default)]
struct News {
    /// Fraction and name of stages that have started, and of the end, not yet reported.
    starts: VecDeque<(f32, &'static str)>,
    stage: &'static str,
    /// Set when the attended work ends.
    ended: bool,
}

struct Reporter<'a> {
    begin: Instant,
    callback: Mutex<Callback<'a>>,
    news: Mutex<News>,
    wake: Condvar,
    /// The largest fraction counted, stored as bits (which are ordered as the fractions are).
    fraction: AtomicU32,
    /// Whether a thread waits in [`Progress::attend`] and makes the reports.
    attended: AtomicBool,
}

impl Reporter<'_> {
    fn news(&self) -> MutexGuard<'_, News> {
        // No panic leaves the news half changed.
        self.news.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Makes the reports that are due; returns whether the callback wants the call to continue.
    fn report(&self, callback: &mut Callback) -> bool {
        loop {
            let start = self.news().starts.pop_front();
            let now = || (f32::from_bits(self.fraction.load(Relaxed)), self.news().stage);
            let (fraction, stage) = start.unwrap_or_else(now);
            if stage.is_empty() {
                // No stage has started yet.
                return true;
            }
            if callback.pace.allows(self.begin.elapsed(), start.is_some()) {
                callback.fraction = callback.fraction.max(fraction);
                if !crate::base::callback::run(|| (callback.function)(callback.fraction, stage)) {
                    return false;
                }
            }
            if start.is_none() {
                return true;
            }
        }
    }
}

/// The progress of one call.
#[derive(Default)]
pub struct Progress<'a> {
    reporter: Option<Reporter<'a>>,
    cancelled: AtomicBool,
    /// Where the work waits for something more urgent.
    gate: Option<Arc<Gate>>,
    /// Part of the bar that stages to come share; `None`: all of it.
    part: Mutex<Option<(f32, f32)>>,
}

impl<'a> Progress<'a> {
    /// Makes a progress that reports to `callback`.
    pub fn new(callback: impl FnMut(f32, &str) -> bool + Send + 'a) -> Self {
        let reporter = Reporter {
            begin: Instant::now(),
            callback: Mutex::new(Callback { function: Box::new(callback), pace: Pace::new(), fraction: 0.0 }),
            news: Mutex::new(News { stage: "start", ..News::default() }),
            wake: Condvar::new(),
            fraction: AtomicU32::new(0),
            attended: AtomicBool::new(false),
        };
        Progress { reporter: Some(reporter), ..Progress::default() }
    }

    /// The same progress of work that waits at `gate` whenever it counts or checks.
    pub(crate) fn waiting_at(self, gate: Arc<Gate>) -> Self {
        Progress { gate: Some(gate), ..self }
    }

    /// Makes a progress that reports to nobody and is never cancelled.
    pub fn none() -> Self {
        Progress::default()
    }

    /// Whether the callback has asked to stop. Cheap enough for every tile of work.
    pub fn is_cancelled(&self) -> bool {
        self.cancelled.load(Relaxed)
    }

    /// Returns `Err(Cancelled)` once the callback has asked to stop. If no thread attends to the callback, it is called
    /// here, at its intervals. Cheap enough for every few microseconds of work.
    pub fn check(&self) -> Result<()> {
        self.count(0.0);
        if self.is_cancelled() { Err(Error::Cancelled) } else { Ok(()) }
    }

    /// Gives stages to come a part of the bar, as if it were the whole: for work that is done several times.
    pub(crate) fn set_part(&self, begin: f32, end: f32) {
        *self.part.lock().unwrap_or_else(PoisonError::into_inner) = Some((begin, end));
    }

    /// Starts a stage of `total` work items that covers `[from, to]` of the bar, and reports its
    /// start (so that a callback sees every stage).
    pub fn stage<'p>(&'p self, name: &'static str, from: f32, to: f32, total: u64) -> Stage<'p, 'a> {
        let (begin, end) = self.part.lock().unwrap_or_else(PoisonError::into_inner).unwrap_or((0.0, 1.0));
        let [from, to] = [from, to].map(|at| if (begin, end) == (0.0, 1.0) { at } else { begin + (end - begin) * at });
        let stage = Stage { progress: self, name, from, to, total: total.max(1), done: AtomicU64::new(0) };
        self.start(name, from);
        stage
    }

    fn start(&self, name: &'static str, fraction: f32) {
        let Some(reporter) = &self.reporter else { return };
        reporter.fraction.fetch_max(fraction.to_bits(), Relaxed);
        let mut news = reporter.news();
        news.stage = name;
        news.starts.push_back((fraction, name));
        drop(news);
        if reporter.attended.load(Relaxed) {
            reporter.wake.notify_one();
        } else if let Ok(mut callback) = reporter.callback.lock() {
            self.report(reporter, &mut callback);
        }
    }

    fn count(&self, fraction: f32) {
        if let Some(gate) = &self.gate {
            gate.pass();
        }
        let Some(reporter) = &self.reporter else { return };
        if fraction > 0.0 {
            reporter.fraction.fetch_max(fraction.to_bits(), Relaxed);
        }
        // No thread waits for a callback that another thread is in.
        if !reporter.attended.load(Relaxed)
            && let Ok(mut callback) = reporter.callback.try_lock()
        {
            self.report(reporter, &mut callback);
        }
    }

    fn report(&self, reporter: &Reporter, callback: &mut Callback) {
        if !self.is_cancelled() && !reporter.report(callback) {
            self.cancelled.store(true, Relaxed);
        }
    }

    /// Whether there is a callback to which no thread attends yet.
    pub(crate) fn wants_attendance(&self) -> bool {
        self.reporter.as_ref().is_some_and(|r| !r.attended.load(Relaxed))
    }

    /// Makes all reports of the work that `start` begins, on the calling thread, until that work drops the `Attended`
    /// it gets.
    pub(crate) fn attend<'p>(&'p self, start: impl FnOnce(Attended<'p, 'a>)) {
        let Some(reporter) = &self.reporter else { return start(Attended(self)) };
        reporter.attended.store(true, Relaxed);
        reporter.news().ended = false;
        // A callback that panics must not leave the work running to its end.
        let cancel_on_panic = CancelOnDrop(&self.cancelled);
        start(Attended(self));
        loop {
            if let Ok(mut callback) = reporter.callback.lock() {
                self.report(reporter, &mut callback);
            }
            let news = reporter.news();
            if !news.starts.is_empty() && !self.is_cancelled() {
                continue;
            }
            if news.ended {
                break;
            }
            drop(reporter.wake.wait_timeout(news, INTERVAL));
        }
        std::mem::forget(cancel_on_panic);
        reporter.attended.store(false, Relaxed);
    }
}

/// Held by work that a thread [attends](Progress::attend) to; its drop signals that the work has ended.
pub(crate) struct Attended<'p, 'a>(&'p Progress<'a>);

impl Drop for Attended<'_, '_> {
    fn drop(&mut self) {
        if let Some(reporter) = &self.0.reporter {
            reporter.news().ended = true;
            reporter.wake.notify_one();
        }
    }
}

struct CancelOnDrop<'p>(&'p AtomicBool);

impl Drop for CancelOnDrop<'_> {
    fn drop(&mut self) {
        self.0.store(true, Relaxed);
    }
}

/// A part of the bar of a [`Progress`], advanced from any thread.
pub struct Stage<'p, 'a> {
    progress: &'p Progress<'a>,
    name: &'static str,
    from: f32,
    to: f32,
    total: u64,
    done: AtomicU64,
}

impl Stage<'_, '_> {
    /// Counts `items` more as done; returns `Err(Cancelled)` once the callback has asked to stop.
    pub fn advance(&self, items: u64) -> Result<()> {
        let before = self.done.fetch_add(items, Relaxed).min(self.total);
        let done = (before + items).min(self.total);
        let fraction = self.from + (self.to - self.from) * (done as f64 / self.total as f64) as f32;
        if done == self.total && before < self.total && self.to >= 1.0 {
            self.progress.start(self.name, fraction);
        } else {
            self.progress.count(fraction);
        }
        if self.is_cancelled() { Err(Error::Cancelled) } else { Ok(()) }
    }

    /// Checks for a cancel as [`Progress::check`].
    pub fn check(&self) -> Result<()> {
        self.progress.check()
    }

    /// Whether the callback has asked to stop.
    pub fn is_cancelled(&self) -> bool {
        self.progress.is_cancelled()
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
    fn a_report_before_the_first_stage_has_a_name_too() {
        let mut seen = Vec::new();
        {
            let p = Progress::new(|_, s| {
                seen.push(s.to_string());
                true
            });
            p.attend(drop);
        }
        assert!(!seen.is_empty() && seen.iter().all(|s| s == "start"), "{seen:?}");
    }

    #[test]
    fn a_callback_that_says_no_cancels() {
        let p = Progress::new(|f, _| f < 0.5);
        let s = p.stage("work", 0.0, 1.0, 2);
        assert_eq!(s.advance(2), Err(Error::Cancelled));
        assert!(p.is_cancelled());
    }

    /// Reports that are made when one is offered every `step` for `seconds`, and at which times.
    fn reports(step: Duration, seconds: u32, starts_stage: impl Fn(u32) -> bool) -> Vec<Duration> {
        let mut pace = Pace::new();
        let offers = (0..).map(|i| (i, step * i)).take_while(|(_, now)| now.as_secs() < seconds as u64);
        offers.filter(|&(i, now)| pace.allows(now, starts_stage(i))).map(|(_, now)| now).collect()
    }

    #[test]
    fn no_second_has_more_than_a_hundred_reports() {
        for every in [1, 2, 7, 100] {
            let times = reports(Duration::from_micros(500), 5, |i| i % every == 0);
            for (i, &from) in times.iter().enumerate() {
                let within = times[i..].iter().take_while(|&&t| t < from + Duration::from_secs(1)).count();
                assert!(within <= 100, "{within} in a second from {from:?} with a start in {every}");
            }
        }
    }

    #[test]
    fn a_stage_that_goes_on_is_reported_at_least_every_twenty_milliseconds() {
        let times = reports(Duration::from_millis(1), 3, |_| false);
        assert!(times.windows(2).all(|w| w[1] - w[0] <= Duration::from_millis(20)), "{times:?}");
        assert!(times.len() > 100);
    }

    #[test]
    fn stages_that_start_at_once_are_all_reported() {
        assert_eq!(reports(Duration::from_millis(1), 1, |_| true)[..18].last(), Some(&Duration::from_millis(17)));
    }

    #[test]
    fn the_attending_thread_reports_while_nothing_is_counted() {
        let this = std::thread::current().id();
        let calls = AtomicU64::new(0);
        let progress = Progress::new(|_, stage| {
            assert_eq!(std::thread::current().id(), this);
            // The first report may come before the work has begun its stage.
            assert!(["start", "silence"].contains(&stage), "{stage}");
            calls.fetch_add(1, Relaxed);
            true
        });
        std::thread::scope(|scope| {
            progress.attend(|attended| {
                scope.spawn(|| {
                    let _attended = attended;
                    let _stage = progress.stage("silence", 0.0, 1.0, 1);
                    // Work that counts nothing until it has been asked about a few times.
                    while calls.load(Relaxed) < 5 {
                        std::thread::yield_now();
                    }
                });
            });
        });
        assert!(calls.load(Relaxed) >= 5);
    }

    #[test]
    fn where_no_thread_attends_a_look_for_a_cancel_asks_the_callback() {
        let calls = AtomicU64::new(0);
        let progress = Progress::new(|_, _| calls.fetch_add(1, Relaxed) < 3);
        let _stage = progress.stage("work", 0.0, 1.0, 1);
        while progress.check().is_ok() {
            std::thread::yield_now();
        }
        assert_eq!(calls.load(Relaxed), 4);
    }

    #[test]
    fn no_report_is_made_after_the_first_refusal() {
        let calls = AtomicU64::new(0);
        let progress = Progress::new(|_, _| {
            calls.fetch_add(1, Relaxed);
            false
        });
        std::thread::scope(|scope| {
            progress.attend(|attended| {
                scope.spawn(|| {
                    let _attended = attended;
                    let stage = progress.stage("work", 0.0, 1.0, 10);
                    while !progress.is_cancelled() {
                        std::thread::yield_now();
                    }
                    assert_eq!(stage.advance(10), Err(Error::Cancelled));
                    progress.stage("next", 0.0, 1.0, 1);
                });
            });
        });
        assert_eq!(calls.load(Relaxed), 1);
    }
}
