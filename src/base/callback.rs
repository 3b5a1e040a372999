//! Calls of the caller's functions: progress, log and memory callbacks.
//!
//! A callback may run on one of a device's threads, in the middle of a call. If it started work on the device's threads
//! and waited for it, its thread would take up other work of that call meanwhile, and report it to the callback that
//! has not returned yet; with one thread it would wait for itself. So code that starts such work asks [`is_running`]
//! first.

use crate::base::float_state::CallersState;
use std::cell::Cell;

thread_local! {
    /// Number of callbacks that this thread is in.
    static DEPTH: Cell<u32> = const { Cell::new(0) };
}

/// Runs a callback, in the caller's floating-point state.
pub(crate) fn run<R>(callback: impl FnOnce() -> R) -> R {
    struct Leave;
    impl Drop for Leave {
        fn drop(&mut self) {
            let _ = DEPTH.try_with(|depth| depth.set(depth.get() - 1));
        }
    }
    // While a thread ends, the slot may be gone; no library call is under way on it then.
    let _leave = DEPTH.try_with(|depth| depth.set(depth.get() + 1)).is_ok().then_some(Leave);
    let _state = CallersState::enter();
    callback()
}

/// Whether the calling thread is in a callback.
pub(crate) fn is_running() -> bool {
    DEPTH.try_with(|depth| depth.get() > 0).unwrap_or(false)
}
