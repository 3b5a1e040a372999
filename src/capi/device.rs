//! Devices and callbacks
//!
//! A device owns worker threads, the choice of instruction set, the log and the memory accounts.
//!
//! Handles (bk_device, bk_scene, bk_photon_map, bk_lightmap) are opaque and reference-counted: a
//! create function hands out one reference, bk_..._retain adds one, bk_..._release gives one back,
//! and NULL is ignored by both. What is made from an object keeps what it needs of it alive, so
//! parents may be released first. Retaining and releasing is safe from any thread.
//!
//! Callbacks may run on any thread and must not throw or jump out. They may call functions that do
//! not work on a device's threads, releases among them; the others (commit, create, bake, save,
//! BK_RAYS_PARALLEL), and changes to the object whose call they are in, fail with
//! BK_ERROR_INVALID_STATE. Strings given to callbacks are valid during the callback only.
//!
//! Floating-point state: all functions compute with rounding to nearest, with denormals and with all
//! exceptions masked, whatever the calling thread has set (in MXCSR on x86-64, in FPCR on AArch64; on
//! other architectures nothing is set), and restore the caller's state before they return. Callbacks
//! see the caller's state on the caller's thread and the default state on others; what they change of
//! it lasts until they return. That costs a call about 6 ns where the caller's state is the default
//! and 10 ns where it is not, once for all rays of bk_intersect_many, bk_occluded_many and bk_gather.
//!
//! Stacks: the calling thread needs 64 KB of stack for queries (bk_intersect, bk_occluded, their like
//! for many rays, bk_gather, bk_photon_map_estimate) and 256 KB for all other functions. The stacks of
//! the library's own threads have 4 MB, of which only what is used takes memory.
//!
//! fork: a device's threads do not follow into the child process. There, calls that need them fail
//! with BK_ERROR_INVALID_STATE; queries without BK_RAYS_PARALLEL and releases work, and so does a device
//! that is created in the child. An object that another thread is changing during the fork stays
//! locked in the child: calls with it fail with BK_ERROR_INVALID_STATE too.

use super::args::{UserPointer, init, read_struct, sized_struct, text, write};
use super::error::{bk_result, c_string, call, call_or};
use super::handles::{create, hold, object, release, retain};
use crate::callback;
use crate::device::{Device, DeviceOptions};
use crate::error::{Error, Result, invalid_argument};
use crate::progress::Progress;
use crate::simd::Isa;
use std::ffi::{c_char, c_void};
use std::sync::Arc;

/// The best instruction set that the machine has.
pub const BK_ISA_AUTO: u32 = 0;
/// The baseline of the target: SSE2 on x86-64, NEON on AArch64.
pub const BK_ISA_PORTABLE: u32 = 1;
/// AVX2 with FMA.
pub const BK_ISA_AVX2: u32 = 2;
/// AVX-512 F, VL, DQ and BW.
pub const BK_ISA_AVX512: u32 = 3;

/// Log level: something failed that no result reports.
pub const BK_LOG_ERROR: u32 = 0;
/// Log level: something about the input or the run deserves attention, as skipped triangles.
pub const BK_LOG_WARNING: u32 = 1;
/// Log level: what is going on.
pub const BK_LOG_INFO: u32 = 2;

/// Told how far a call is: fraction in [0, 1], never falling, and the name of the stage, as
/// "gather". Called on the thread that made the call, and only until that call returns: when a stage
/// starts and about every 15 ms, at most 100 times in any second. (A stage that starts when 20 others
/// just have is reported with the next call.) The library's own threads go on working meanwhile.
/// Return 0 to cancel: the call then ends with BK_ERROR_CANCELLED, as a rule within 50 ms. NULL is
/// allowed wherever one is taken.
pub type bk_progress_fn = Option<unsafe extern "C" fn(user: *mut c_void, fraction: f32, stage: *const c_char) -> i32>;

/// Receives log messages (UTF-8) with one of the BK_LOG levels, from any thread, several at a time.
pub type bk_log_fn = Option<unsafe extern "C" fn(user: *mut c_void, level: u32, message: *const c_char)>;

/// Asked before a large allocation, with its size in bytes: return 0 to refuse, and the call that
/// wanted it ends with BK_ERROR_OUT_OF_MEMORY. Told after a free, with the size negative; the
/// answer is ignored then. From any thread, several at a time; for the last time when the last
/// object of the device is released.
pub type bk_memory_fn = Option<unsafe extern "C" fn(user: *mut c_void, bytes: i64) -> i32>;

/// Worker threads, instruction set, log and memory accounts. All functions on a device are safe
/// from any thread.
pub struct bk_device {
    device: Arc<Device>,
}

impl bk_device {
    pub(super) fn device(&self) -> &Arc<Device> {
        &self.device
    }
}

/// What to create a device with.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_device_desc {
    /// Size of this structure in bytes, set by bk_device_desc_init.
    pub struct_size: u32,
    /// Worker threads, at most 1024; 0, the default: one per logical core, as far as that allows.
    /// Results do not depend on it.
    pub num_threads: u32,
    /// One of the BK_ISA values. Default: BK_ISA_AUTO.
    pub isa: u32,
    /// Receives log messages. Default: NULL.
    pub log: bk_log_fn,
    /// Asked before large allocations. Default: NULL.
    pub memory: bk_memory_fn,
    /// Handed to log and memory; must outlive the device and all that was made from it.
    pub user: *mut c_void,
}

sized_struct!(bk_device_desc, defaults: bk_device_desc {
    struct_size: size_of::<bk_device_desc>() as u32,
    num_threads: 0,
    isa: BK_ISA_AUTO,
    log: None,
    memory: None,
    user: std::ptr::null_mut(),
});

/// Fills in the defaults.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_device_desc_init(desc: *mut bk_device_desc) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(desc) }
}

/// Starts a device.
///
/// desc: NULL for the defaults. out: receives the device, NULL on failure.
///
/// Fails with BK_ERROR_UNSUPPORTED if the machine lacks the instruction set asked for, with
/// BK_ERROR_OUT_OF_MEMORY if the threads cannot be started.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_device_create(desc: *const bk_device_desc, out: *mut *mut bk_device) -> bk_result {
    // SAFETY: desc and out are the caller's, or NULL.
    call(|| unsafe {
        write(out, std::ptr::null_mut(), "out")?;
        let options = if desc.is_null() { DeviceOptions::default() } else { options(read_struct(desc, "desc")?)? };
        write(out, create(bk_device { device: Device::new(options)? }), "out")
    })
}

/// Counts one more reference. NULL is ignored.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_device_retain(device: *mut bk_device) {
    // SAFETY: a handle or NULL.
    unsafe { retain(device) }
}

/// Gives one reference back. When the last is given back, of the device and of all that was made
/// from it, its threads are joined. NULL is ignored.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_device_release(device: *mut bk_device) {
    // SAFETY: a handle whose reference the caller gives up, or NULL.
    call_or((), || unsafe {
        release(device);
        Ok(())
    })
}

/// Returns the instruction set in use: a BK_ISA value other than BK_ISA_AUTO; BK_ISA_AUTO if device is NULL.
///
/// BK_ISA_AVX2 and BK_ISA_AVX512 give the same bits of hits and light. BK_ISA_PORTABLE rounds products and
/// sums apart where the others fuse them, so its bits differ: results and checkpoints of bakes are not exchanged
/// between it and the others.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_device_isa(device: *const bk_device) -> u32 {
    call_or(BK_ISA_AUTO, || Ok(object!(device).device.isa() as u32))
}

/// The number of worker threads; 0 if device is NULL.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_device_num_threads(device: *const bk_device) -> u32 {
    call_or(0, || Ok(object!(device).device.num_threads() as u32))
}

fn options(desc: bk_device_desc) -> Result<DeviceOptions> {
    let isa = match desc.isa {
        BK_ISA_AUTO => None,
        BK_ISA_PORTABLE => Some(Isa::Portable),
        BK_ISA_AVX2 => Some(Isa::Avx2),
        BK_ISA_AVX512 => Some(Isa::Avx512),
        other => return invalid_argument!("isa is {other}, not one of the BK_ISA values"),
    };
    let user = UserPointer::new(desc.user);
    let mut options = DeviceOptions { num_threads: desc.num_threads as usize, isa, ..Default::default() };
    if let Some(log) = desc.log {
        options.log = Some(Box::new(move |level, message| {
            // SAFETY: the caller's function, with its own pointer, as documented.
            unsafe { log(user.get(), level as u32, c_string(message).as_ptr()) }
        }));
    }
    if let Some(memory) = desc.memory {
        // SAFETY: as above.
        options.memory = Some(Box::new(move |bytes| unsafe { memory(user.get(), bytes) != 0 }));
    }
    Ok(options)
}

/// The progress of one call, reported to the caller's function.
pub(super) fn progress<'a>(callback: bk_progress_fn, user: *mut c_void) -> Progress<'a> {
    let user = UserPointer::new(user);
    match callback {
        None => Progress::none(),
        Some(callback) => Progress::new(move |fraction, stage| {
            // SAFETY: the caller's function, with its own pointer, as documented.
            unsafe { callback(user.get(), fraction, c_string(stage).as_ptr()) != 0 }
        }),
    }
}

/// Refuses to start work on a device's threads from a callback: see [`callback`].
pub(super) fn refuse_in_callback() -> Result<()> {
    if callback::is_running() {
        return Err(Error::InvalidState("a callback must not start work on a device's threads".into()));
    }
    Ok(())
}

/// Runs the body of a call that reads or writes a file with the object behind `handle`, which is held: callbacks may
/// release the caller's reference. `name` and `path_name` are those of the arguments.
///
/// # Safety
/// `handle` is NULL or that of a living object; `path` is NULL or a string that ends with a NUL.
pub(super) unsafe fn call_with_file<T>(
    (handle, name): (*const T, &str),
    (path, path_name): (*const c_char, &str),
    body: impl FnOnce(&T, &str) -> Result<()>,
) -> bk_result {
    call(|| {
        refuse_in_callback()?;
        // SAFETY: by contract.
        let object = unsafe { hold(handle, name) }?;
        // SAFETY: by contract.
        body(&object, unsafe { text(path, path_name) }?)
    })
}
