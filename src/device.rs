//! The device: threads of its own, the ISA chosen at run time, the log and the memory accounts.

use crate::base::array::Array;
use crate::base::callback;
use crate::base::error::{Error, Result, invalid_argument};
use crate::base::memory::{MemoryFn, MemoryMonitor, try_zeroed_as_needed};
use crate::base::progress::Progress;
use crate::base::scratch_files::{ScratchFiles, Storage};
use crate::base::threads::{self, Threads, Work};
use crate::simd::{Isa, LIMIT_VARIABLE};
use bytemuck::Pod;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Severity of a log message.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u32)]
pub enum LogLevel {
    /// A failure that no result reports.
    Error = 0,
    /// Something about the input or the run that deserves attention.
    Warning = 1,
    /// Progress of the work.
    Info = 2,
}

/// Receives log messages, from any thread.
pub type LogFn = dyn Fn(LogLevel, &str) + Send + Sync;

/// Maximum number of threads of a device: more than the logical cores of most machines, and few enough for the default
/// limits of operating systems.
pub const MAX_THREADS: usize = 1024;

/// Environment variable that shows log messages on standard error, see [`DeviceOptions::log`].
const LOG_VARIABLE: &str = "BAKELITE_LOG";

/// Options for creating a [`Device`].
#[derive(Default)]
pub struct DeviceOptions {
    /// Number of worker threads, at most [`MAX_THREADS`]; 0: one per logical core, up to that maximum.
    pub num_threads: usize,
    /// The ISA to use; `None`: the best that this machine has and the environment variable `BAKELITE_ISA` allows
    /// (`portable`, `avx2`, `avx512`; unset: all).
    pub isa: Option<Isa>,
    /// Receives log messages. `None`: they go to standard error as far as the environment variable `BAKELITE_LOG` asks
    /// for it (`error`, `warning`, or `info`, which any other word means too), else nowhere.
    pub log: Option<Box<LogFn>>,
    /// Called before large allocations.
    pub memory: Option<Box<MemoryFn>>,
    /// Folder in which unwraps are kept by their content, for the next light map and the next run; it is made if needed.
    /// `None`: none are kept.
    pub cache_folder: Option<PathBuf>,
    /// Folder for files that take the place of memory, where scenes are larger than it: for meshes, trees and what is needed
    /// to build them but for spatial splits, and the charts of light maps. The files have no names, and are gone with what
    /// lies in them. `None`: all is in memory.
    pub scratch_folder: Option<PathBuf>,
}

/// Threads, kernels and accounts that scenes and bakes share.
///
/// Dropping the device joins its threads.
pub struct Device {
    threads: Threads,
    /// An ISA that this machine can run.
    isa: Isa,
    log: Option<Box<LogFn>>,
    memory: Arc<MemoryMonitor>,
    cache_folder: Option<PathBuf>,
    scratch: Option<ScratchFiles>,
}

impl Device {
    /// Starts a device. Fails if the machine lacks the ISA asked for or threads cannot be started.
    pub fn new(options: DeviceOptions) -> Result<Arc<Device>> {
        if options.num_threads > MAX_THREADS {
            return invalid_argument!("num_threads is {}, more than {MAX_THREADS}", options.num_threads);
        }
        let isa = options.isa.unwrap_or_else(Isa::best);
        if !isa.is_available() {
            let message =
                format!("this machine cannot run {}, or {LIMIT_VARIABLE} in the environment forbids it", isa.name());
            return Err(Error::Unsupported(message));
        }
        // (Left to itself, rayon asks the environment for the number first.)
        let num_threads = match options.num_threads {
            0 => std::thread::available_parallelism().map_or(1, |n| n.get()).min(MAX_THREADS),
            n => n,
        };
        let name = |i| format!("bakelite-{i}");
        let device = Device {
            threads: Threads::start(num_threads, name)?,
            isa,
            log: options.log.or_else(|| log_to(std::io::stderr, &std::env::var(LOG_VARIABLE).ok()?)),
            memory: Arc::new(MemoryMonitor::new(options.memory)),
            cache_folder: options.cache_folder,
            scratch: options.scratch_folder.map(ScratchFiles::new),
        };
        device.log_info(|| {
            format!("version {}, {num_threads} threads, instruction set {}", env!("CARGO_PKG_VERSION"), isa.name())
        });
        Ok(Arc::new(device))
    }

    /// Fails in a process that `fork` has made from the one in which the device was created: the threads are not in the
    /// new process, and waiting for them would never end.
    pub fn check_process(&self) -> Result<()> {
        if self.threads.are_in_another_process() {
            let message = "the device was created before a fork, and its threads are not in this process";
            return Err(Error::InvalidState(message.into()));
        }
        Ok(())
    }

    /// The ISA in use, which this machine can run.
    #[inline]
    pub fn isa(&self) -> Isa {
        self.isa
    }

    /// The number of worker threads.
    pub fn num_threads(&self) -> usize {
        self.threads.pool().current_num_threads()
    }

    /// Runs `f` on the device's threads; rayon calls inside use them alone. When called in a callback, which may be on
    /// one of the threads, `f` runs on a thread of its own.
    ///
    /// Unwinds with an [`Error`] if [`check_process`](Self::check_process) fails, which should be called first.
    pub fn install<R: Send>(&self, f: impl FnOnce() -> R + Send) -> R {
        let (mut f, mut result) = (Some(f), None);
        self.install_work(&mut || result = f.take().map(|f| f()));
        result.expect("the work has been done, or it has unwound")
    }

    /// Does the work of [`install`](Self::install). Compiled once: when rayon's part of it was compiled for each
    /// caller, the library had 9 % more code and took 10 % longer to compile.
    fn install_work(&self, work: Work) {
        if callback::is_running() {
            return threads::on_extra_thread(work);
        }
        if threads::is_apart() {
            return work();
        }
        if let Err(e) = self.check_process() {
            std::panic::resume_unwind(Box::new(e));
        }
        self.threads.pool().install(work)
    }

    /// Runs `f` on the device's threads, as [`install`](Self::install) does, while the calling thread makes the reports
    /// of `progress`. If the caller is a thread of the device, which has to work, reports are made when work is
    /// counted.
    ///
    /// Fails if `f` fails or if the callback of `progress` has cancelled, in any report: so `f` must leave to its
    /// caller any action that cannot be undone.
    pub fn run<R: Send>(&self, progress: &Progress, f: impl FnOnce() -> Result<R> + Send) -> Result<R> {
        let done = self.run_attended(progress, f)?;
        // The last report may come when all work is done.
        progress.check()?;
        Ok(done)
    }

    fn run_attended<R: Send>(&self, progress: &Progress, f: impl FnOnce() -> R + Send) -> R {
        let (mut f, mut result) = (Some(f), None);
        self.run_work(progress, &mut || result = f.take().map(|f| f()));
        result.expect("the work has been done, or it has unwound")
    }

    fn run_work(&self, progress: &Progress, work: Work) {
        let pool = self.threads.pool();
        let is_busy = callback::is_running() || threads::is_apart() || pool.current_thread_index().is_some();
        if is_busy || self.threads.are_in_another_process() || !progress.wants_attendance() {
            return self.install_work(work);
        }
        pool.in_place_scope(|scope| {
            progress.attend(|attended| {
                scope.spawn(move |_| {
                    let _attended = attended;
                    work();
                });
            });
        });
    }

    /// Runs `f` on one of the device's threads and returns at once. Work that it would [`install`](Self::install) in
    /// any device runs on this one's threads too: this is for long work in the background that must not keep the
    /// threads of another device from short work. `f` must not panic.
    pub(crate) fn spawn(&self, f: impl FnOnce() + Send + 'static) {
        self.threads.pool().spawn(move || threads::apart(f));
    }

    /// Sends a message to the log callback.
    pub fn log(&self, level: LogLevel, message: &str) {
        if let Some(log) = &self.log {
            callback::run(|| log(level, message));
        }
    }

    /// Sends a message about the progress of the work to the log callback. The message is made only if there is one.
    pub(crate) fn log_info(&self, message: impl FnOnce() -> String) {
        if self.log.is_some() {
            self.log(LogLevel::Info, &message());
        }
    }

    /// See [`DeviceOptions::cache_folder`].
    pub fn cache_folder(&self) -> Option<&Path> {
        self.cache_folder.as_deref()
    }

    /// Makes an array of zeros that may be large: in a scratch file, if there is a folder for them. `what`: its name in error
    /// messages.
    pub(crate) fn zeroed<T: Pod>(&self, len: usize, what: &str) -> Result<Array<T>> {
        let array = self.storage().zeroed(len, try_zeroed_as_needed, what)?;
        array.at_random();
        Ok(array)
    }

    /// Copies the elements of a slice to an array that may be large, as [`zeroed`](Self::zeroed) makes it.
    pub(crate) fn copy<T: Pod>(&self, values: &[T], what: &str) -> Result<Array<T>> {
        let mut array = self.zeroed(values.len(), what)?;
        array.copy_from_slice(values);
        Ok(array)
    }

    /// Where arrays that may be large lie.
    pub(crate) fn storage(&self) -> Storage<'_> {
        Storage::new(self.scratch.as_ref())
    }

    /// Files for large arrays that are needed for a while, apart from those of others, so that their room is free when they
    /// are gone; `None` if there is no folder for them.
    pub(crate) fn files_for_work(&self) -> Option<ScratchFiles> {
        self.scratch.as_ref().map(ScratchFiles::another)
    }

    /// Whether arrays that may be large lie in scratch files.
    pub(crate) fn has_scratch(&self) -> bool {
        self.scratch.is_some()
    }

    /// Number of bytes of memory that arrays made by [`zeroed`](Self::zeroed) take, which have `bytes` in all.
    pub(crate) fn in_memory(&self, bytes: usize) -> usize {
        if self.has_scratch() { 0 } else { bytes }
    }

    /// The memory accounts.
    pub fn memory(&self) -> &Arc<MemoryMonitor> {
        &self.memory
    }
}

/// A log that writes messages up to a level to a stream; `None` for an empty word. A message that cannot be written,
/// because the stream is closed, is lost.
fn log_to<W: Write>(stream: impl Fn() -> W + Send + Sync + 'static, level: &str) -> Option<Box<LogFn>> {
    let most = match level {
        "" => return None,
        "error" => LogLevel::Error,
        "warning" => LogLevel::Warning,
        _ => LogLevel::Info,
    };
    Some(Box::new(move |level, message| {
        if level <= most {
            drop(writeln!(stream(), "bakelite: {message}"));
        }
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rayon::prelude::*;
    use std::cell::RefCell;
    use std::sync::atomic::{AtomicU32, Ordering::SeqCst};

    /// Counts the calling thread when it ends, which takes it a while.
    fn count_at_exit(ended: &Arc<AtomicU32>) {
        struct CountsOnDrop(Arc<AtomicU32>);
        impl Drop for CountsOnDrop {
            fn drop(&mut self) {
                std::thread::sleep(std::time::Duration::from_millis(20));
                self.0.fetch_add(1, SeqCst);
            }
        }
        thread_local!(static AT_EXIT: RefCell<Option<CountsOnDrop>> = const { RefCell::new(None) });
        AT_EXIT.with(|c| *c.borrow_mut() = Some(CountsOnDrop(ended.clone())));
    }

    #[test]
    fn dropping_a_device_joins_its_threads() {
        let ended = Arc::new(AtomicU32::new(0));
        let device = Device::new(DeviceOptions { num_threads: 3, ..Default::default() }).unwrap();
        device.threads.pool().broadcast(|_| count_at_exit(&ended));
        drop(device);
        assert_eq!(ended.load(SeqCst), 3);
    }

    #[test]
    fn a_device_can_be_dropped_on_one_of_its_threads() {
        let device = Device::new(DeviceOptions { num_threads: 2, ..Default::default() }).unwrap();
        let (sender, receiver) = std::sync::mpsc::channel();
        let last = device.clone();
        device.threads.pool().spawn(move || {
            while Arc::strong_count(&last) > 1 {
                std::thread::yield_now();
            }
            drop(last);
            sender.send(()).unwrap();
        });
        drop(device);
        receiver.recv().unwrap();
    }

    #[test]
    fn a_cancel_counts_that_comes_when_the_work_has_looked_for_the_last_time() {
        let device = Device::new(DeviceOptions { num_threads: 1, ..Default::default() }).unwrap();
        let all_is_done = AtomicU32::new(0);
        let progress = Progress::new(|_, stage| stage != "work" || all_is_done.load(SeqCst) == 0);
        let done = device.run(&progress, || {
            let stage = progress.stage("work", 0.0, 1.0, 1);
            stage.advance(1)?;
            progress.check()?;
            all_is_done.store(1, SeqCst);
            // As long as the calling thread waits between two reports, and longer.
            std::thread::sleep(std::time::Duration::from_millis(60));
            Ok(())
        });
        assert_eq!(done, Err(Error::Cancelled));
    }

    #[test]
    fn an_absurd_thread_count_is_refused_by_name() {
        let e = Device::new(DeviceOptions { num_threads: MAX_THREADS + 1, ..Default::default() }).err().unwrap();
        assert!(e.to_string().contains("num_threads is 1025, more than 1024"));
    }

    #[test]
    fn work_in_a_callback_does_not_touch_the_threads_that_called_back() {
        let device = Device::new(DeviceOptions { num_threads: 1, ..Default::default() }).unwrap();
        let name = || std::thread::current().name().map(str::to_owned);
        let (outer, sums) = device.install(|| {
            // The only thread is in a callback, so that nothing else would ever be done on it.
            let inner = callback::run(|| {
                let nested = || device.install(|| (name(), rayon::current_num_threads()));
                device.install(|| (nested(), (0..1000u64).into_par_iter().sum::<u64>()))
            });
            (name(), inner)
        });
        assert_eq!(sums.1, 499_500);
        assert!(sums.0.1 == 1 && sums.0.0 != outer, "{sums:?}");
    }

    #[test]
    fn the_thread_for_work_in_a_callback_has_ended_when_the_work_has() {
        let device = Device::new(DeviceOptions { num_threads: 1, ..Default::default() }).unwrap();
        let ended = Arc::new(AtomicU32::new(0));
        callback::run(|| device.install(|| count_at_exit(&ended)));
        assert_eq!(ended.load(SeqCst), 1);
    }

    #[test]
    fn work_in_the_background_stays_on_its_device_after_it_has_run_other_such_work() {
        let device = || Device::new(DeviceOptions { num_threads: 1, ..Default::default() }).unwrap();
        let (background, other) = (device(), device());
        let (sender, receiver) = std::sync::mpsc::channel();
        let of_both = (background.clone(), other);
        background.spawn(move || {
            let (background, other) = of_both;
            background.spawn(|| ());
            // As a thread does that waits for a part of its work which another one has taken.
            assert_eq!(rayon::yield_now(), Some(rayon::Yield::Executed));
            let name = || std::thread::current().name().map(str::to_owned);
            sender.send((std::thread::current().id(), other.install(|| std::thread::current().id()), name())).unwrap();
            drop((background, other));
        });
        let (outer, inner, name) = receiver.recv().unwrap();
        assert_eq!(outer, inner, "{name:?}");
    }

    #[test]
    fn a_panic_in_a_callback_s_work_comes_through() {
        let device = Device::new(DeviceOptions { num_threads: 1, ..Default::default() }).unwrap();
        let work = || callback::run(|| device.install(|| -> u32 { std::panic::panic_any("as expected") }));
        let payload = std::panic::catch_unwind(std::panic::AssertUnwindSafe(work)).unwrap_err();
        assert_eq!(Error::of_panic(payload), Error::Internal("a panic was caught: as expected".into()));
        assert!(!callback::is_running());
    }

    #[test]
    fn the_log_of_the_environment_writes_up_to_its_level() {
        #[derive(Clone, Default)]
        struct Written(Arc<std::sync::Mutex<Vec<u8>>>);
        impl Write for Written {
            fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
                self.0.lock().unwrap().write(bytes)
            }
            fn flush(&mut self) -> std::io::Result<()> {
                Ok(())
            }
        }
        let written = |level: &str| {
            let all = Written::default();
            let stream = all.clone();
            let log = log_to(move || stream.clone(), level).unwrap();
            for level in [LogLevel::Error, LogLevel::Warning, LogLevel::Info] {
                log(level, &format!("{level:?}"));
            }
            String::from_utf8(all.0.lock().unwrap().clone()).unwrap()
        };
        assert_eq!(written("error"), "bakelite: Error\n");
        assert_eq!(written("warning"), "bakelite: Error\nbakelite: Warning\n");
        assert_eq!(written("info"), "bakelite: Error\nbakelite: Warning\nbakelite: Info\n");
        assert_eq!(written("1"), written("info"));
        assert!(log_to(std::io::stderr, "").is_none());
    }

    #[test]
    fn every_available_isa_makes_a_device() {
        for isa in Isa::available() {
            let d = Device::new(DeviceOptions { isa: Some(isa), num_threads: 1, ..Default::default() }).unwrap();
            assert_eq!(d.isa(), isa);
        }
    }

    /// The environment is read once per process, so each limit has a process of its own, which runs this test.
    #[test]
    fn the_environment_forbids_better_isas() {
        let variable = "BAKELITE_TEST_BEST";
        if let Ok(expected) = std::env::var(variable) {
            match Device::new(DeviceOptions { num_threads: 1, ..Default::default() }) {
                Ok(device) => assert_eq!(device.isa().name(), expected),
                Err(e) => assert!(expected.is_empty() && e.to_string().contains(LIMIT_VARIABLE), "{e}"),
            }
            let better = Isa::ALL.into_iter().skip_while(|isa| isa.name() != expected).skip(1);
            for isa in better {
                assert!(Device::new(DeviceOptions { isa: Some(isa), num_threads: 1, ..Default::default() }).is_err());
            }
            return;
        }
        let names = Isa::available().map(|isa| (isa.name(), isa.name()));
        for (limit, expected) in names.chain([("avx", ""), ("", "")]) {
            let test = "device::tests::the_environment_forbids_better_isas";
            let status = std::process::Command::new(std::env::current_exe().unwrap())
                .args(["--exact", test])
                .env(LIMIT_VARIABLE, limit)
                .env(variable, expected)
                .status();
            assert!(status.unwrap().success(), "{limit}");
        }
    }
}
