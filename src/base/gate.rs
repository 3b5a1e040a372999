//! A gate at which work in the background waits while something urgent runs on the same cores.
//!
//! Work in the background passes the gate every few microseconds, which costs one load while it is open. It waits at most
//! as long as it may then go on, so that it gets half of the time at least, however often the gate is closed.

use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Maximum time to wait at once.
const MOST: Duration = Duration::from_millis(20);

/// A gate that is open at first.
#[derive(Default)]
pub(crate) struct Gate {
    is_closed: AtomicBool,
    /// Until when work passes even a closed gate, because it has waited.
    free_until: Mutex<Option<Instant>>,
    opened: Condvar,
}

/// Keeps a gate closed until it is dropped.
pub(crate) struct Closed(Arc<Gate>);

impl Gate {
    pub fn close(self: &Arc<Gate>) -> Closed {
        self.is_closed.store(true, Relaxed);
        Closed(self.clone())
    }

    /// Waits while the gate is closed.
    #[inline]
    pub fn pass(&self) {
        if self.is_closed.load(Relaxed) {
            self.wait();
        }
    }

    #[cold]
    fn wait(&self) {
        let mut free_until = self.free_until.lock().unwrap_or_else(PoisonError::into_inner);
        let start = Instant::now();
        if free_until.is_some_and(|free| start < free) {
            return;
        }
        let is_closed = |_: &mut Option<Instant>| self.is_closed.load(Relaxed);
        let waited = self.opened.wait_timeout_while(free_until, MOST, is_closed);
        free_until = waited.unwrap_or_else(PoisonError::into_inner).0;
        *free_until = Some(Instant::now() + start.elapsed());
    }
}

impl Drop for Closed {
    fn drop(&mut self) {
        // The lock is held so that no thread falls asleep between its look at the gate and its wait.
        let guard = self.0.free_until.lock().unwrap_or_else(PoisonError::into_inner);
        self.0.is_closed.store(false, Relaxed);
        drop(guard);
        self.0.opened.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn work_waits_while_the_gate_is_closed_and_then_goes_on_for_as_long() {
        let gate = Arc::new(Gate::default());
        gate.pass();
        let closed = gate.close();
        let start = Instant::now();
        std::thread::scope(|s| {
            let worker = s.spawn(|| {
                gate.pass();
                start.elapsed()
            });
            std::thread::sleep(Duration::from_millis(5));
            drop(closed);
            assert!(worker.join().unwrap() >= Duration::from_millis(5));
        });
        // It has waited, and passes the closed gate for as long.
        *gate.free_until.lock().unwrap() = Some(Instant::now() + Duration::from_secs(100));
        let _closed = gate.close();
        gate.pass();
        assert!(start.elapsed() < Duration::from_secs(50));
        // A gate that stays closed stops nobody for ever.
        *gate.free_until.lock().unwrap() = None;
        gate.pass();
        assert!(gate.free_until.lock().unwrap().is_some());
    }
}
