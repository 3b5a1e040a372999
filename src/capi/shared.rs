//! A lock for data that many threads read and one may change; nobody ever waits for it.
//!
//! Readers count themselves in on one of several counters, each on a cache line of its own, so that
//! threads which trace single rays do not take a line from each other. (One `RwLock` would make them.)
//! A writer raises a flag and then looks at the counters; a reader counts and then looks at the flag: at
//! least one sees the other, and who sees the other gives up.
//!
//! crossbeam's `ShardedLock` takes as long and more instructions, and can wait: docs/experiments.md.

use crate::base::error::{Error, Result};
use std::cell::{Cell, UnsafeCell};
use std::ops::Deref;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicUsize, Ordering::SeqCst};

/// Counters; threads take them in turn.
const COUNTERS: usize = 32;

/// Two lines of 64 bytes, because they are fetched in pairs.
#[derive(Default)]
#[repr(align(128))]
struct Counter(AtomicU32);

pub(super) struct Shared<T> {
    value: UnsafeCell<T>,
    readers: [Counter; COUNTERS],
    writing: AtomicBool,
}

// SAFETY: `&T` is handed to several threads while `writing` was seen lowered, `&mut T` to one that has seen
// no reader; as in `std::sync::RwLock`.
unsafe impl<T: Send + Sync> Sync for Shared<T> {}

impl<T> Shared<T> {
    pub(super) fn new(value: T) -> Self {
        Shared { value: UnsafeCell::new(value), readers: Default::default(), writing: AtomicBool::new(false) }
    }

    /// Fails while somebody writes, and for good if a panic ended the writing.
    #[inline]
    pub(super) fn read(&self) -> Result<Reading<'_, T>> {
        let reader = &self.readers[own_counter()].0;
        reader.fetch_add(1, SeqCst);
        // Counts down again on the error too.
        let reading = Reading { shared: self, reader };
        if self.writing.load(SeqCst) { Err(changing()) } else { Ok(reading) }
    }

    /// Fails, without calling `change`, while somebody reads or writes.
    pub(super) fn write<R>(&self, change: impl FnOnce(&mut T) -> R) -> Result<R> {
        if self.writing.swap(true, SeqCst) {
            return Err(changing());
        }
        if self.readers.iter().any(|r| r.0.load(SeqCst) != 0) {
            self.writing.store(false, SeqCst);
            return Err(Error::InvalidState("another call is using the scene at the same time".into()));
        }
        // SAFETY: this call alone raised the flag, and saw no readers after that; who has come since sees
        // the flag and does not read.
        let result = change(unsafe { &mut *self.value.get() });
        // Not after a panic, which may have left the data half changed.
        self.writing.store(false, SeqCst);
        Ok(result)
    }
}

#[cold]
fn changing() -> Error {
    Error::InvalidState("another call is changing the scene at the same time, or an internal error ended it".into())
}

/// Access to a [`Shared`] value that nobody changes meanwhile.
pub(super) struct Reading<'a, T> {
    shared: &'a Shared<T>,
    reader: &'a AtomicU32,
}

impl<T> Deref for Reading<'_, T> {
    type Target = T;

    #[inline]
    fn deref(&self) -> &T {
        // SAFETY: this reader is counted, and saw no writer after that.
        unsafe { &*self.shared.value.get() }
    }
}

impl<T> Drop for Reading<'_, T> {
    #[inline]
    fn drop(&mut self) {
        self.reader.fetch_sub(1, SeqCst);
    }
}

#[inline]
fn own_counter() -> usize {
    static NEXT: AtomicUsize = AtomicUsize::new(0);
    thread_local! {
        static OWN: Cell<usize> = const { Cell::new(usize::MAX) };
    }
    // During a thread's destruction the slot may be gone.
    OWN.try_with(|own| {
        if own.get() == usize::MAX {
            own.set(NEXT.fetch_add(1, SeqCst) % COUNTERS);
        }
        own.get()
    })
    .unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn readers_share_and_a_writer_is_alone() {
        let s = Shared::new(1);
        let (a, b) = (s.read().unwrap(), s.read().unwrap());
        assert!(s.write(|_| ()).is_err());
        drop(a);
        std::thread::scope(|scope| {
            scope.spawn(|| assert!(s.write(|_| ()).is_err() && *s.read().unwrap() == 1));
        });
        drop(b);
        s.write(|v| {
            *v = 2;
            assert!(s.read().is_err() && s.write(|_| ()).is_err());
        })
        .unwrap();
        assert_eq!(*s.read().unwrap(), 2);
    }

    #[test]
    fn nobody_sees_what_a_panic_left() {
        let s = Shared::new(1);
        let caught = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| s.write(|_| panic!("half way"))));
        assert!(caught.is_err() && s.read().is_err() && s.write(|_| ()).is_err());
    }

    #[test]
    fn no_reader_sees_a_half_written_value() {
        let s = Shared::new([0u64; 64]);
        std::thread::scope(|scope| {
            for _ in 0..3 {
                scope.spawn(|| {
                    for _ in 0..if cfg!(miri) { 50 } else { 20_000 } {
                        if let Ok(v) = s.read() {
                            assert!(v.iter().all(|x| *x == v[0]));
                        }
                    }
                });
            }
            scope.spawn(|| (1..if cfg!(miri) { 20 } else { 2000 }).for_each(|i| drop(s.write(|v| v.fill(i)))));
        });
    }
}
