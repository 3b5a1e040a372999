//! Threads: pools that end with what owns them, single threads, and one thread for work in a callback.
//!
//! All have a stack of the library's choice and its floating-point state, and are joined before their owner is gone.

use crate::base::error::{Error, Result};
use crate::base::float_state;
use std::cell::Cell;
use std::thread::JoinHandle;

/// Work that is called once. It keeps its own result.
pub(crate) type Work<'a> = &'a mut (dyn FnMut() + Send);

/// Stack size of a thread in bytes, whatever RUST_MIN_STACK says. Builds recurse by up to 76 levels of half a kilobyte,
/// and a thread that waits for another takes up other work meanwhile, on top of its own. Only the part that is used
/// takes memory.
const STACK_BYTES: usize = 4 << 20;

thread_local! {
    /// Set while a thread keeps to itself, or to its pool, work that is given to a device.
    static APART: Cell<bool> = const { Cell::new(false) };
}

/// Whether work that this thread would give to a device stays on it, or in its pool.
pub(crate) fn is_apart() -> bool {
    APART.get()
}

/// Runs `work` so that what it would give to a device stays on this thread.
pub(crate) fn apart(work: impl FnOnce()) {
    // A thread that waits for a part of its work may run other work meanwhile.
    let before = APART.replace(true);
    work();
    APART.set(before);
}

/// A pool of threads, joined when it is dropped.
pub(crate) struct Threads {
    /// `Some` until the threads end.
    pool: Option<rayon::ThreadPool>,
    threads: Vec<JoinHandle<()>>,
    /// Id of the process in which they were started.
    process: u32,
}

impl Threads {
    /// Starts threads. If that fails, those that were started have ended.
    pub fn start(count: usize, name: impl Fn(usize) -> String) -> Result<Threads> {
        Threads::begin_with(count, name, float_state::set_on_own_thread)
    }

    /// Starts threads that keep work to themselves which they would give to a device.
    pub fn start_apart(count: usize, name: impl Fn(usize) -> String) -> Result<Threads> {
        Threads::begin_with(count, name, || {
            float_state::set_on_own_thread();
            APART.set(true);
        })
    }

    fn begin_with(count: usize, name: impl Fn(usize) -> String, begin: fn()) -> Result<Threads> {
        let mut threads = Vec::with_capacity(count);
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(count)
            .spawn_handler(|worker| {
                threads.push(own_thread(name(worker.index())).spawn(move || {
                    begin();
                    worker.run();
                })?);
                Ok(())
            })
            .build();
        match pool {
            Ok(pool) => Ok(Threads { pool: Some(pool), threads, process: std::process::id() }),
            Err(e) => {
                // The threads have been told to end.
                join(&mut threads);
                Err(Error::OutOfMemory(format!("{count} threads could not be started: {e}")))
            }
        }
    }

    /// The pool. Nothing may wait for it after a fork.
    pub fn pool(&self) -> &rayon::ThreadPool {
        self.pool.as_ref().expect("there until dropped")
    }

    /// Whether this is a process that `fork` has made from the one in which the threads were started: they are not in it.
    pub fn are_in_another_process(&self) -> bool {
        self.process != std::process::id()
    }
}

impl Drop for Threads {
    fn drop(&mut self) {
        if self.are_in_another_process() {
            // In this process the threads can be neither ended nor joined.
            std::mem::forget((self.pool.take(), std::mem::take(&mut self.threads)));
            return;
        }
        drop(self.pool.take());
        end(&mut self.threads);
    }
}

/// Starts a thread that is in no pool.
pub(crate) fn start_one(name: String, work: impl FnOnce() + Send + 'static) -> Result<JoinHandle<()>> {
    let work = || {
        float_state::set_on_own_thread();
        work();
    };
    own_thread(name).spawn(work).map_err(|e| Error::OutOfMemory(format!("a thread could not be started: {e}")))
}

/// Joins threads that are about to end.
pub(crate) fn end(threads: &mut Vec<JoinHandle<()>>) {
    // A callback may drop the last reference on one of the threads. It cannot join itself, nor
    // the others, which end only after the job that it is in: they end on their own.
    let this = std::thread::current().id();
    if !threads.iter().any(|t| t.thread().id() == this) {
        join(threads);
    }
}

/// Runs `work` on a pool of one thread and waits without taking up other work. Unwinds with an [`Error`] if no thread
/// can be started.
pub(crate) fn on_extra_thread(work: Work) {
    let fail = |e: Error| -> ! { std::panic::resume_unwind(Box::new(e)) };
    let wait = || match Threads::start_apart(1, |_| "bakelite-extra".into()) {
        Ok(threads) => threads.pool().install(work),
        Err(e) => fail(e),
    };
    // A worker of a pool that waited for another pool would take up work of its own pool: so another thread waits.
    std::thread::scope(|scope| match own_thread("bakelite-callback".into()).spawn_scoped(scope, wait) {
        Ok(thread) => thread.join().unwrap_or_else(|payload| std::panic::resume_unwind(payload)),
        Err(e) => fail(Error::OutOfMemory(format!("a thread for work in a callback could not be started: {e}"))),
    })
}

/// A thread with a stack of the library's choice.
fn own_thread(name: String) -> std::thread::Builder {
    std::thread::Builder::new().name(name).stack_size(STACK_BYTES)
}

fn join(threads: &mut Vec<JoinHandle<()>>) {
    threads.drain(..).for_each(|t| drop(t.join()));
}
