//! Devices and callbacks
//!
//! A device owns worker threads, the choice of instruction set, the log and the memory accounts.
//!
//! Ownership: handles (bk_device, bk_scene, bk_photon_map, bk_lightmap, bk_live) are opaque and
//! reference-counted. A create function hands out one reference, which the caller releases with
//! bk_..._release; bk_..._retain adds one. An object keeps its parents alive, so they may be
//! released first.
//!
//! Callbacks may run on any thread and must not throw exceptions or jump out. Inside a callback,
//! functions that work on a device's threads (commit, refit, create, bake, load, save, live
//! updates, BK_RAYS_PARALLEL) and changes to the object whose call is running fail with
//! BK_ERROR_INVALID_STATE; all others are allowed, releases among them. Strings passed to callbacks
//! are valid during the callback only.
//!
//! Floating-point state: all functions compute with rounding to nearest, with denormals and with
//! all exceptions masked, whatever the calling thread has set (in MXCSR on x86-64, in FPCR on
//! AArch64; on other architectures nothing is set), and restore the caller's state before they
//! return. Callbacks see the caller's state on the caller's thread and the default state on others;
//! their changes to it last until they return. Saving and restoring costs about 6 ns per call where
//! the caller's state is the default and 10 ns where it is not, once for all rays of
//! bk_intersect_many, bk_occluded_many and bk_gather.
//!
//! Stacks: the calling thread needs 64 KB of stack for queries (bk_intersect, bk_occluded,
//! bk_intersect_many, bk_occluded_many, bk_gather, bk_photon_map_estimate) and 256 KB for all other
//! functions. Each thread of the library reserves 4 MB of address space for its stack; only used
//! pages take memory.
//!
//! fork: a device's threads do not exist in the child process. There, calls that need them fail
//! with BK_ERROR_INVALID_STATE; queries without BK_RAYS_PARALLEL, releases, and devices created in
//! the child work. An object that another thread was changing during the fork stays locked in the
//! child: calls with it fail with BK_ERROR_INVALID_STATE.
//!
//! Thread safety: any thread, all functions at the same time.
//!
//! Cost: bk_device_create starts threads, in about 0.1 ms each, and the last release joins them;
//! the other functions take nanoseconds.

use super::args::{UserPointer, init, read_struct, sized_struct, text, write};
use super::error::{bk_result, c_string, call, call_or};
use super::handles::{create, hold, object, release, retain};
use crate::base::callback;
use crate::base::error::{Error, Result, invalid_argument};
use crate::base::progress::Progress;
use crate::device::{Device, DeviceOptions};
use crate::simd::Isa;
use std::ffi::{c_char, c_void};
use std::sync::Arc;

/// Instruction set: the best that the machine has.
pub const BK_ISA_AUTO: u32 = 0;
/// Instruction set: the baseline of the target (SSE2 on x86-64, NEON on AArch64).
pub const BK_ISA_PORTABLE: u32 = 1;
/// Instruction set: AVX2 with FMA.
pub const BK_ISA_AVX2: u32 = 2;
/// Instruction set: AVX-512 F, VL, DQ and BW.
pub const BK_ISA_AVX512: u32 = 3;

/// Log level: a failure that no result code reports.
pub const BK_LOG_ERROR: u32 = 0;
/// Log level: something about the input or the run that deserves attention, for example skipped
/// triangles.
pub const BK_LOG_WARNING: u32 = 1;
/// Log level: progress of the work. One message each for a device, a commit, a light map and a bake,
/// with sizes, times and the text of bk_plan_describe.
pub const BK_LOG_INFO: u32 = 2;

/// Reports the progress of a call, and can cancel it.
///
/// Runs on the thread that made the call, and only until that call returns: when a stage starts and
/// about every 15 ms, at most 100 times in any second. (A stage that starts when 20 others have
/// just started is reported with the next call.) The library's own threads go on working meanwhile.
/// NULL is allowed wherever a function takes a progress callback.
///
/// @param user  pointer that was passed beside the callback
/// @param fraction  part of the work that is done, in [0, 1], never falling
/// @param stage  name of the stage, for example "gather"
/// @return  0 to cancel: the call then ends with BK_ERROR_CANCELLED, as a rule within 50 ms; any
///   other value to go on
pub type bk_progress_fn = Option<unsafe extern "C" fn(user: *mut c_void, fraction: f32, stage: *const c_char) -> i32>;

/// Receives log messages, from any thread and several at a time.
///
/// @param user  bk_device_desc.user
/// @param level  one of the BK_LOG values
/// @param message  UTF-8, valid during the call only
pub type bk_log_fn = Option<unsafe extern "C" fn(user: *mut c_void, level: u32, message: *const c_char)>;

/// Allows or refuses a large allocation, and is notified when it is freed.
///
/// Runs on any thread, several calls at a time; for the last time when the last object of the
/// device is released. After a refusal the call that needed the memory ends with
/// BK_ERROR_OUT_OF_MEMORY.
///
/// @param user  bk_device_desc.user
/// @param bytes  size of the allocation in bytes; negative after a free
/// @return  0 to refuse the allocation, any other value to allow it; ignored after a free
pub type bk_memory_fn = Option<unsafe extern "C" fn(user: *mut c_void, bytes: i64) -> i32>;

/// Handle of a device.
pub struct bk_device {
    device: Arc<Device>,
}

impl bk_device {
    pub(super) fn device(&self) -> &Arc<Device> {
        &self.device
    }
}

/// Parameters of bk_device_create.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct bk_device_desc {
    /// Size of this structure in bytes, set by bk_device_desc_init.
    pub struct_size: u32,
    /// Number of worker threads, at most 1024; 0: one per logical core, at most 1024. Results do
    /// not depend on it. Default: 0.
    pub num_threads: u32,
    /// One of the BK_ISA values; BK_ISA_AUTO is the best that the machine has. The environment
    /// variable BAKELITE_ISA ("portable", "avx2" or "avx512") forbids better ones than it names.
    /// Default: BK_ISA_AUTO.
    pub isa: u32,
    /// Log callback, or NULL: messages then go to standard error if the environment variable
    /// BAKELITE_LOG is set to "error", "warning" or "info", the least important level to write, and
    /// else nowhere. Default: NULL.
    pub log: bk_log_fn,
    /// Memory callback, or NULL. Default: NULL.
    pub memory: bk_memory_fn,
    /// Pointer passed to `log` and `memory`; must stay valid until the device and all that was made
    /// from it are gone. Default: NULL.
    pub user: *mut c_void,
    /// Folder in which the unwraps of light maps are kept by their content, for the next light map
    /// and the next run of the program: parts of meshes that are as they were are not unwrapped
    /// again. It is made if needed; files in it may be deleted at any time. It should be writable for
    /// this user only: files are checked, but charts that somebody else put there would be used.
    /// UTF-8; NULL: none are kept. Default: NULL.
    pub cache_folder: *const c_char,
    /// Folder for files that take the place of memory, where scenes are larger than it (see
    /// bk_open_params.ray_queues): for copies of meshes, the acceleration structure (up to 250 bytes
    /// per triangle while a scene is committed, up to 110 after it) and the charts of light maps
    /// (some 50 bytes per triangle, three times that while a light map is created). The folder must
    /// exist; the files have no names in it, and their room is free again when scene and light map
    /// are gone (64 MB of it: when the device is), however the process ends. The library never
    /// writes more to them than there is room on the disk. Arrays of less than 4 KB, textures and
    /// texels are in memory as ever, and scenes from bk_scene_open in their file. UTF-8; NULL: all is in memory. Default: NULL.
    pub scratch_folder: *const c_char,
}

sized_struct!(bk_device_desc, defaults: bk_device_desc {
    struct_size: size_of::<bk_device_desc>() as u32,
    num_threads: 0,
    isa: BK_ISA_AUTO,
    log: None,
    memory: None,
    user: std::ptr::null_mut(),
    cache_folder: std::ptr::null(),
    scratch_folder: std::ptr::null(),
});

/// Sets `struct_size` and fills in the defaults.
///
/// @param desc  structure to fill in; NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_device_desc_init(desc: *mut bk_device_desc) {
    // SAFETY: the caller's structure, or NULL.
    unsafe { init(desc) }
}

/// Creates a device and starts its threads.
///
/// @param desc  parameters; NULL for the defaults
/// @param out  receives the device, which the caller releases with bk_device_release; NULL on
///   failure
/// @retval BK_ERROR_UNSUPPORTED  the machine lacks the requested instruction set, or BAKELITE_ISA
///   forbids it (a word that names none forbids all)
/// @retval BK_ERROR_OUT_OF_MEMORY  the threads cannot be started
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_device_create(desc: *const bk_device_desc, out: *mut *mut bk_device) -> bk_result {
    // SAFETY: desc and out are the caller's, or NULL.
    call(|| unsafe {
        write(out, std::ptr::null_mut(), "out")?;
        let options = if desc.is_null() { DeviceOptions::default() } else { options(read_struct(desc, "desc")?)? };
        write(out, create(bk_device { device: Device::new(options)? }), "out")
    })
}

/// Adds one reference.
///
/// @param device  NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_device_retain(device: *mut bk_device) {
    // SAFETY: a handle or NULL.
    unsafe { retain(device) }
}

/// Releases one reference. The last release of the device and of all that was made from it joins
/// the threads; no callback comes afterwards.
///
/// @param device  NULL is ignored
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_device_release(device: *mut bk_device) {
    // SAFETY: a handle whose reference the caller gives up, or NULL.
    call_or((), || unsafe {
        release(device);
        Ok(())
    })
}

/// Returns the instruction set in use.
///
/// BK_ISA_AVX2 and BK_ISA_AVX512 give the same bits of hits and light. BK_ISA_PORTABLE rounds
/// products and sums separately where the others fuse them, so its bits differ: results and
/// checkpoints of bakes cannot be exchanged between it and the others.
///
/// @param device  NULL gives BK_ISA_AUTO
/// @return  a BK_ISA value other than BK_ISA_AUTO
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_device_isa(device: *const bk_device) -> u32 {
    call_or(BK_ISA_AUTO, || Ok(object!(device).device.isa() as u32))
}

/// Returns the number of worker threads.
///
/// @param device  NULL gives 0
/// @return  number of threads, 1 to 1024
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_device_num_threads(device: *const bk_device) -> u32 {
    call_or(0, || Ok(object!(device).device.num_threads() as u32))
}

/// # Safety
/// `cache_folder` and `scratch_folder` are NULL or texts.
unsafe fn options(desc: bk_device_desc) -> Result<DeviceOptions> {
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
    if !desc.cache_folder.is_null() {
        // SAFETY: by contract.
        options.cache_folder = Some(unsafe { text(desc.cache_folder, "cache_folder") }?.into());
    }
    if !desc.scratch_folder.is_null() {
        // SAFETY: by contract.
        options.scratch_folder = Some(unsafe { text(desc.scratch_folder, "scratch_folder") }?.into());
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
