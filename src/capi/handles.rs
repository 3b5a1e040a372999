//! Handles: objects that C holds by a counted reference.
//!
//! A handle is the pointer of an `Arc`, so that retain and release are its counts. Children hold
//! `Arc`s of what they need of their parents, which therefore outlive them.

use crate::base::error::{Error, Result};
use std::sync::Arc;

/// Hands a new object to C, which owns the one reference.
pub(super) fn create<T>(object: T) -> *mut T {
    Arc::into_raw(Arc::new(object)).cast_mut()
}

/// Counts one more reference; NULL is fine.
///
/// # Safety
/// `handle` is NULL or comes from [`create`] and has not been released for good.
pub(super) unsafe fn retain<T>(handle: *const T) {
    if !handle.is_null() {
        // SAFETY: by contract the pointer is that of a living Arc.
        unsafe { Arc::increment_strong_count(handle) }
    }
}

/// Gives one reference back; NULL is fine.
///
/// # Safety
/// Same as for [`retain`]; the reference that is given back must be the caller's.
pub(super) unsafe fn release<T>(handle: *const T) {
    if !handle.is_null() {
        // SAFETY: by contract the pointer is that of a living Arc, and one count of it is ours.
        unsafe { Arc::decrement_strong_count(handle) }
    }
}

/// Borrows the object for a call that runs no callback, not even that of memory; NULL is an error that names the
/// argument. Faster than [`hold`] by two atomic operations.
///
/// # Safety
/// `handle` is NULL or valid, and stays so for `'a`.
#[inline]
pub(super) unsafe fn borrow<'a, T>(handle: *const T, name: &str) -> Result<&'a T> {
    // SAFETY: by contract valid unless NULL.
    unsafe { handle.as_ref() }.ok_or_else(|| is_null(name))
}

/// Same as [`borrow`], with a reference of its own: the caller might release the handle in a callback of the call.
///
/// # Safety
/// Same as for [`retain`].
pub(super) unsafe fn hold<T>(handle: *const T, name: &str) -> Result<Arc<T>> {
    if handle.is_null() {
        return Err(is_null(name));
    }
    // SAFETY: by contract the pointer is that of a living Arc; the count just added is the new Arc's.
    unsafe {
        Arc::increment_strong_count(handle);
        Ok(Arc::from_raw(handle))
    }
}

#[cold]
pub(super) fn is_null(name: &str) -> Error {
    Error::InvalidArgument(format!("{name} is NULL"))
}

/// `object!(scene)`: a reference to the object behind the handle in the argument `scene`, or an early return with
/// "scene is NULL". The caller's contract (capi's head) makes the pointer valid.
macro_rules! object {
    ($handle:ident) => {{
        #[allow(unused_unsafe)] // some callers are in an unsafe block already
        // SAFETY: C promises that a handle that is not NULL is alive as the call begins.
        let object = unsafe { $crate::capi::handles::hold($handle, stringify!($handle)) }?;
        object
    }};
}
pub(super) use object;

/// Same as `object!`, but [borrowed](borrow): for queries that are called by the million.
macro_rules! borrowed {
    ($handle:ident) => {{
        #[allow(unused_unsafe)] // some callers are in an unsafe block already
        // SAFETY: C promises that a handle that is not NULL is alive during the call, which runs no callback.
        let object = unsafe { $crate::capi::handles::borrow($handle, stringify!($handle)) }?;
        object
    }};
}
pub(super) use borrowed;
