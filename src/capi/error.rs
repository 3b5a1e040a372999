//! Results and version
//!
//! Functions that can fail return a `bk_result`: BK_OK, or a negative code. `bk_last_error()` then
//! returns a sentence that names the argument and the value at fault. A call that fails changes
//! nothing unless its description says otherwise, and every object can still be used.
//!
//! These rules hold for all functions; descriptions state exceptions only:
//!
//! - Pointers must not be NULL unless the description of the parameter allows it. NULL elsewhere, a
//!   value or flag that is not listed, and a wrong `struct_size` give BK_ERROR_INVALID_ARGUMENT.
//! - Pointers to input are read during the call only; the library copies all that it needs later.
//! - Pointers to output must be valid for the whole call. Output is written on success only, except
//!   that a create function sets its `out` to NULL on failure.
//! - Any function with a `bk_result` can return BK_ERROR_INTERNAL, and is listed with the other
//!   codes it can return.
//!
//! Enums and flags are passed as uint32_t constants. Numbers of meshes, materials, lights and
//! images count from 0 in the order of addition. Strings are UTF-8 and end with a NUL.
//!
//! Every structure whose name ends in _desc, _params, _info, _stats or _view, and bk_camera and
//! bk_budget, start with `uint32_t struct_size`. The function `bk_..._init` sets that size and the
//! default of every other field. Later versions of the library add fields at the end only and
//! accept the size of an older version: missing fields of an input have their defaults, and an
//! output is written up to the size.
//!
//! Functions that are declared with BK_EXPERIMENTAL, and fields whose description begins with
//! "Experimental:", may change or disappear in any release, without the care that the rest gets.
//! Define BK_EXPERIMENTAL before including this header, for example as a deprecation attribute, to
//! find their uses.
//!
//! Versions: until 1.0, a new minor version may change or remove functions and fields, so that
//! programs must be recompiled; a new patch version corrects behaviour or adds functions and fields,
//! and runs programs compiled with earlier ones. From 1.0 on the major version takes the part of
//! the minor one, and the minor version grows when functions or fields are added. The name of the
//! shared library (libbakelite.so.0.1), the CMake package and the Rust crate follow this rule.
//!
//! Thread safety: any thread; bk_last_error is per thread.
//!
//! Cost: none of these functions allocates or waits.

use crate::base::error::{Error, Result};
use crate::base::float_state::LibraryState;
use std::cell::RefCell;
use std::ffi::{CStr, CString, c_char};
use std::panic::{AssertUnwindSafe, catch_unwind};

/// Major version; see "Versions" above.
pub const BK_VERSION_MAJOR: u32 = 0;
/// Minor version. Programs must be recompiled when it changes and the major version is 0.
pub const BK_VERSION_MINOR: u32 = 1;
/// Patch version. Programs run with a later one without being recompiled.
pub const BK_VERSION_PATCH: u32 = 0;
/// Version of this header: major << 16 | minor << 8 | patch.
pub const BK_VERSION: u32 = BK_VERSION_MAJOR << 16 | BK_VERSION_MINOR << 8 | BK_VERSION_PATCH;

/// "None" where an index is expected or reported.
pub const BK_NONE: u32 = 0xffff_ffff;

/// Result code of a function: BK_OK, or one of the negative BK_ERROR codes.
pub type bk_result = i32;

/// The call succeeded.
pub const BK_OK: bk_result = 0;
/// An argument is NULL or out of its documented range.
pub const BK_ERROR_INVALID_ARGUMENT: bk_result = -1;
/// The object does not allow the call in its present state, or another thread is changing it.
pub const BK_ERROR_INVALID_STATE: bk_result = -2;
/// Memory ran out, a memory budget is too small, or the memory callback refused.
pub const BK_ERROR_OUT_OF_MEMORY: bk_result = -3;
/// The progress callback returned 0.
pub const BK_ERROR_CANCELLED: bk_result = -4;
/// This build of the library or this machine does not support the request.
pub const BK_ERROR_UNSUPPORTED: bk_result = -5;
/// A file could not be read or written, or its content is malformed.
pub const BK_ERROR_IO: bk_result = -6;
/// A bug in the library, caught before it reached the caller.
pub const BK_ERROR_INTERNAL: bk_result = -7;

/// Returns the version of the library in use, to compare with BK_VERSION.
///
/// @return  major << 16 | minor << 8 | patch
#[unsafe(no_mangle)]
pub extern "C" fn bk_version() -> u32 {
    BK_VERSION
}

/// Returns the name of a result code, for example "BK_OK".
///
/// @param result  any value
/// @return  a constant string that is never NULL; "unknown bk_result" for a value that is no code
#[unsafe(no_mangle)]
pub extern "C" fn bk_result_string(result: bk_result) -> *const c_char {
    let name: &CStr = match result {
        BK_OK => c"BK_OK",
        BK_ERROR_INVALID_ARGUMENT => c"BK_ERROR_INVALID_ARGUMENT",
        BK_ERROR_INVALID_STATE => c"BK_ERROR_INVALID_STATE",
        BK_ERROR_OUT_OF_MEMORY => c"BK_ERROR_OUT_OF_MEMORY",
        BK_ERROR_CANCELLED => c"BK_ERROR_CANCELLED",
        BK_ERROR_UNSUPPORTED => c"BK_ERROR_UNSUPPORTED",
        BK_ERROR_IO => c"BK_ERROR_IO",
        BK_ERROR_INTERNAL => c"BK_ERROR_INTERNAL",
        _ => c"unknown bk_result",
    };
    name.as_ptr()
}

/// Returns a sentence about the last call of the calling thread that failed.
///
/// The sentence names the argument and the value at fault. Functions without a `bk_result`, for
/// example bk_intersect, report their failures here too; a call that succeeds leaves the text as it
/// is.
///
/// @return  a string that is never NULL, owned by the library and valid until the thread's next
///   call into it; empty if no call has failed yet
#[unsafe(no_mangle)]
pub extern "C" fn bk_last_error() -> *const c_char {
    // During a thread's destruction the slot may be gone.
    LAST_ERROR.try_with(|e| e.borrow().as_ptr()).unwrap_or(c"".as_ptr())
}

thread_local! {
    static LAST_ERROR: RefCell<CString> = RefCell::default();
}

/// Runs the body of an entry point: catches a panic, and keeps an error for `bk_last_error`.
pub(super) fn call(body: impl FnOnce() -> Result<()>) -> bk_result {
    match catch(body) {
        Ok(()) => BK_OK,
        Err(e) => {
            let result = code(&e);
            remember(&e);
            result
        }
    }
}

/// Same as [`call`], for entry points that return a value: `fallback` on failure.
#[inline]
pub(super) fn call_or<T>(fallback: T, body: impl FnOnce() -> Result<T>) -> T {
    match catch(body) {
        Ok(value) => value,
        Err(e) => {
            remember(&e);
            fallback
        }
    }
}

/// Nothing that a panic may leave half changed is reachable afterwards: the locks of handles are
/// poisoned then, and refuse.
#[inline]
fn catch<T>(body: impl FnOnce() -> Result<T>) -> Result<T> {
    let _state = LibraryState::enter();
    catch_unwind(AssertUnwindSafe(body)).unwrap_or_else(|payload| Err(Error::of_panic(payload)))
}

#[cold]
fn remember(e: &Error) {
    let text = c_string(&e.to_string());
    let _ = LAST_ERROR.try_with(|slot| *slot.borrow_mut() = text);
}

/// A C string; a NUL inside (a path from a file may hold anything) is shown as U+FFFD.
pub(super) fn c_string(text: &str) -> CString {
    CString::new(text.replace('\0', "\u{fffd}")).unwrap_or_default()
}

fn code(e: &Error) -> bk_result {
    match e {
        Error::InvalidArgument(_) => BK_ERROR_INVALID_ARGUMENT,
        Error::InvalidState(_) => BK_ERROR_INVALID_STATE,
        Error::OutOfMemory(_) => BK_ERROR_OUT_OF_MEMORY,
        Error::Cancelled => BK_ERROR_CANCELLED,
        Error::Unsupported(_) => BK_ERROR_UNSUPPORTED,
        Error::Io(_) => BK_ERROR_IO,
        Error::Internal(_) => BK_ERROR_INTERNAL,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn last_error() -> String {
        // SAFETY: the pointer is never NULL and read before this thread's next call.
        unsafe { CStr::from_ptr(bk_last_error()) }.to_str().unwrap().to_string()
    }

    #[test]
    fn the_header_carries_the_crate_version() {
        assert_eq!(
            format!("{BK_VERSION_MAJOR}.{BK_VERSION_MINOR}.{BK_VERSION_PATCH}"),
            env!("CARGO_PKG_VERSION"),
            "update the BK_VERSION constants"
        );
        assert_eq!(bk_version(), BK_VERSION);
    }

    #[test]
    fn a_panic_becomes_an_internal_error_with_its_message() {
        assert_eq!(call(|| panic!("node {} is missing", 7)), BK_ERROR_INTERNAL);
        assert_eq!(last_error(), "internal error: a panic was caught: node 7 is missing");
        assert_eq!(call_or(5, || panic!("plain")), 5);
        assert!(last_error().ends_with("plain"));
    }

    #[test]
    fn the_last_error_survives_success_and_stays_in_its_thread() {
        assert_eq!(call(|| Err(Error::Io("no such file: a\0b".into()))), BK_ERROR_IO);
        assert_eq!(call(|| Ok(())), BK_OK);
        assert_eq!(last_error(), "input/output: no such file: a\u{fffd}b");
        std::thread::spawn(|| assert_eq!(last_error(), "")).join().unwrap();
    }

    #[test]
    fn every_code_has_its_name() {
        for result in BK_ERROR_INTERNAL..=BK_OK {
            // SAFETY: the pointer is never NULL and the string is constant.
            let name = unsafe { CStr::from_ptr(bk_result_string(result)) };
            assert!(name.to_str().unwrap().starts_with("BK_"), "{result}");
        }
    }
}
