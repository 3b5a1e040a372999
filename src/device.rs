//! The device: a thread pool of its own, the ISA chosen at run time with its table of kernels, the
//! log and the memory accounts.

use crate::error::{Error, Result, invalid_argument};
use crate::memory::{MemoryFn, MemoryMonitor};
use crate::progress::Progress;
use crate::simd::Isa;
use crate::trace::Kernels;
use std::cell::Cell;
use std::sync::Arc;
use std::thread::JoinHandle;

/// How much a log message matters.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u32)]
pub enum LogLevel {
    Error = 0,
    Warning = 1,
    Info = 2,
}

/// Receives log messages, from any thread.
pub type LogFn = dyn Fn(LogLevel, &str) + Send + Sync;

thread_local! {
    /// Set while a thread runs what was given to [`Device::spawn`].
    static APART: Cell<bool> = const { Cell::new(false) };
}

/// The most threads a device accepts: a guard against garbage in the argument.
pub const MAX_THREADS: usize = 4096;

/// What to create a [`Device`] with.
#[derive(Default)]
pub struct DeviceOptions {
    /// Worker threads; 0: one per logical core.
    pub num_threads: usize,
    /// `None`: the best that this machine has.
    pub isa: Option<Isa>,
    /// Receives log messages.
    pub log: Option<Box<LogFn>>,
    /// Asked before large allocations.
    pub memory: Option<Box<MemoryFn>>,
}

/// Threads, kernels and accounts that scenes and bakes share.
///
/// Dropping the device joins its threads.
pub struct Device {
    /// `Some` until dropped.
    pool: Option<rayon::ThreadPool>,
    threads: Vec<JoinHandle<()>>,
    kernels: &'static Kernels,
    log: Option<Box<LogFn>>,
    memory: Arc<MemoryMonitor>,
}

impl Device {
    /// Starts a device. Fails if the machine lacks the ISA asked for or threads cannot be started.
    pub fn new(options: DeviceOptions) -> Result<Arc<Device>> {
        if options.num_threads > MAX_THREADS {
            return invalid_argument!("num_threads is {}, more than {MAX_THREADS}", options.num_threads);
        }
        let isa = options.isa.unwrap_or_else(Isa::best);
        if !isa.is_available() {
            return Err(Error::Unsupported(format!("this machine cannot run {}", isa.name())));
        }
        let mut threads = Vec::new();
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(options.num_threads)
            .spawn_handler(|worker| {
                let name = format!("bakelite-{}", worker.index());
                threads.push(std::thread::Builder::new().name(name).spawn(|| worker.run())?);
                Ok(())
            })
            .build()
            .map_err(|e| Error::OutOfMemory(format!("the worker threads could not be started: {e}")))?;
        Ok(Arc::new(Device {
            pool: Some(pool),
            threads,
            kernels: Kernels::for_isa(isa),
            log: options.log,
            memory: Arc::new(MemoryMonitor::new(options.memory)),
        }))
    }

    /// The ISA in use.
    pub fn isa(&self) -> Isa {
        self.kernels.isa
    }

    /// The number of worker threads.
    pub fn num_threads(&self) -> usize {
        self.threads.len()
    }

    /// Runs `f` on the device's threads; rayon calls inside use them alone.
    pub fn install<R: Send>(&self, f: impl FnOnce() -> R + Send) -> R {
        if APART.get() {
            return f();
        }
        self.pool.as_ref().expect("there until dropped").install(f)
    }

    /// Runs `f` on the device's threads, as [`install`](Self::install) does, while the calling thread makes the
    /// reports of `progress`. On a thread of the device, which has to work, reports are made when work is counted.
    pub fn run<R: Send>(&self, progress: &Progress, f: impl FnOnce() -> R + Send) -> R {
        let pool = self.pool.as_ref().expect("there until dropped");
        if APART.get() || pool.current_thread_index().is_some() || !progress.wants_attendance() {
            return self.install(f);
        }
        let mut result = None;
        let out = &mut result;
        pool.in_place_scope(|scope| {
            progress.attend(|attended| {
                scope.spawn(move |_| {
                    let _attended = attended;
                    *out = Some(f());
                });
            });
        });
        result.expect("the scope waits for what it spawned, and passes its panic on")
    }

    /// Runs `f` on one of the device's threads and returns at once. What it would
    /// [`install`](Self::install) in any device runs on this one's threads too: long work in the
    /// background that must not keep the threads of another device from short work. `f` must not
    /// panic.
    pub(crate) fn spawn(&self, f: impl FnOnce() + Send + 'static) {
        self.pool.as_ref().expect("there until dropped").spawn(|| {
            APART.set(true);
            f();
            APART.set(false);
        });
    }

    /// Sends a message to the log callback.
    pub fn log(&self, level: LogLevel, message: &str) {
        if let Some(log) = &self.log {
            log(level, message);
        }
    }

    /// The memory accounts.
    pub fn memory(&self) -> &Arc<MemoryMonitor> {
        &self.memory
    }

    pub(crate) fn kernels(&self) -> &'static Kernels {
        self.kernels
    }
}

impl Drop for Device {
    fn drop(&mut self) {
        drop(self.pool.take());
        // A callback may drop the last reference on one of the threads. It cannot join itself, nor
        // the others, which end only after the job that it is in: they end on their own.
        let this = std::thread::current().id();
        if self.threads.iter().any(|t| t.thread().id() == this) {
            return;
        }
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::cell::RefCell;
    use std::sync::atomic::{AtomicU32, Ordering::SeqCst};

    #[test]
    fn dropping_a_device_joins_its_threads() {
        struct CountsOnDrop(Arc<AtomicU32>);
        impl Drop for CountsOnDrop {
            fn drop(&mut self) {
                std::thread::sleep(std::time::Duration::from_millis(20));
                self.0.fetch_add(1, SeqCst);
            }
        }
        thread_local!(static AT_EXIT: RefCell<Option<CountsOnDrop>> = const { RefCell::new(None) });
        let ended = Arc::new(AtomicU32::new(0));
        let device = Device::new(DeviceOptions { num_threads: 3, ..Default::default() }).unwrap();
        let pool = device.pool.as_ref().unwrap();
        pool.broadcast(|_| AT_EXIT.with(|c| *c.borrow_mut() = Some(CountsOnDrop(ended.clone()))));
        drop(device);
        assert_eq!(ended.load(SeqCst), 3);
    }

    #[test]
    fn a_device_can_be_dropped_on_one_of_its_threads() {
        let device = Device::new(DeviceOptions { num_threads: 2, ..Default::default() }).unwrap();
        let (sender, receiver) = std::sync::mpsc::channel();
        let last = device.clone();
        device.pool.as_ref().unwrap().spawn(move || {
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
    fn an_absurd_thread_count_is_refused_by_name() {
        let e = Device::new(DeviceOptions { num_threads: 1 << 20, ..Default::default() }).err().unwrap();
        assert!(e.to_string().contains("num_threads is 1048576"));
    }

    #[test]
    fn every_available_isa_makes_a_device() {
        for isa in Isa::available() {
            let d = Device::new(DeviceOptions { isa: Some(isa), num_threads: 1, ..Default::default() }).unwrap();
            assert_eq!(d.isa(), isa);
        }
    }
}
