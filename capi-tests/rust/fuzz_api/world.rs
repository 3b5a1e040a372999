//! What the calls of a sequence act on: handles that are alive as long as somebody uses them, callbacks that
//! refuse, cancel and call back, and the checks that hold for every call.

use crate::source::Source;
use bakelite::capi::device::*;
use bakelite::capi::error::*;
use bakelite::capi::lightmap::*;
use bakelite::capi::live::*;
use bakelite::capi::photons::*;
use bakelite::capi::scene::*;
use std::cell::{Cell, RefCell};
use std::collections::BTreeMap;
use std::ffi::{CStr, c_char, c_void};
use std::sync::atomic::{AtomicBool, AtomicI64, AtomicU64, Ordering::SeqCst};
use std::sync::{Arc, Mutex, OnceLock, Weak};
use std::time::{Duration, Instant};

/// Bytes that a device's memory callback grants at most: hostile sizes shall not take the machine's memory.
const GRANTED: i64 = 192 << 20;

pub static CALLS: AtomicU64 = AtomicU64::new(0);
pub static SEED: AtomicU64 = AtomicU64::new(0);
/// Prints each call before it is made.
pub static TRACE: AtomicBool = AtomicBool::new(false);
/// Calls, and those of them that gave an error, per function.
pub static COUNTS: Mutex<BTreeMap<&'static str, [u64; 2]>> = Mutex::new(BTreeMap::new());
/// What each thread is in, outermost first.
pub static RUNNING: Mutex<BTreeMap<u64, Vec<&'static str>>> = Mutex::new(BTreeMap::new());

thread_local! {
    /// Callbacks that this thread is in.
    static DEPTH: Cell<u32> = const { Cell::new(0) };
    static THREAD: u64 = {
        static NEXT: AtomicU64 = AtomicU64::new(0);
        NEXT.fetch_add(1, SeqCst)
    };
    /// The last calls of this thread.
    static LAST: RefCell<Vec<&'static str>> = const { RefCell::new(Vec::new()) };
}

/// Says which promise was broken, and where, and ends the process: what comes after would prove nothing.
pub fn broken(promise: &str) -> ! {
    eprintln!("BROKEN: {promise}");
    eprintln!("  seed {}, this thread's last calls: {}", SEED.load(SeqCst), LAST.with_borrow(|l| l.join(" ")));
    std::process::abort()
}

/// A call that is being made.
pub struct Running;

impl Running {
    pub fn new(name: &'static str) -> Running {
        CALLS.fetch_add(1, SeqCst);
        if TRACE.load(SeqCst) {
            eprintln!("{:>2}{} {name}", THREAD.with(|t| *t), "  ".repeat(DEPTH.get() as usize));
        }
        LAST.with_borrow_mut(|l| {
            if l.len() == 60 {
                l.drain(..30);
            }
            l.push(name);
        });
        COUNTS.lock().unwrap().entry(name).or_default()[0] += 1;
        RUNNING.lock().unwrap().entry(THREAD.with(|t| *t)).or_default().push(name);
        Running
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let mut running = RUNNING.lock().unwrap();
        let thread = THREAD.with(|t| *t);
        let calls = running.get_mut(&thread).unwrap();
        calls.pop();
        if calls.is_empty() {
            running.remove(&thread);
        }
    }
}

/// `bk!(function(arguments))`: makes a call.
macro_rules! bk {
    ($function:ident($($argument:expr),* $(,)?)) => {{
        let _running = $crate::world::Running::new(stringify!($function));
        #[allow(unused_unsafe)]
        // SAFETY: the caller keeps the contract of C: handles are alive or NULL, and pointers are valid for what
        // the header says is read and written.
        unsafe { $function($($argument),*) }
    }};
}
pub(crate) use bk;

/// `ask!(function(arguments))`: makes a call and checks what holds for every result.
macro_rules! ask {
    ($function:ident($($argument:expr),* $(,)?)) => {{
        let result = $crate::world::bk!($function($($argument),*));
        $crate::world::check_result(stringify!($function), result)
    }};
}
pub(crate) use ask;

pub fn last_error() -> String {
    let text = bk!(bk_last_error());
    // SAFETY: never NULL, and valid until this thread's next call.
    unsafe { CStr::from_ptr(text) }.to_str().unwrap_or_else(|_| broken("the last error is not UTF-8")).to_string()
}

/// The codes that the header lists for a function, and the one that it does not repeat.
fn listed(function: &str) -> &'static [bk_result] {
    static LISTED: OnceLock<BTreeMap<&str, Vec<bk_result>>> = OnceLock::new();
    let all = LISTED.get_or_init(|| {
        let (mut all, mut codes) = (BTreeMap::new(), vec![BK_ERROR_INVALID_ARGUMENT]);
        for line in include_str!("../../../include/bakelite.h").lines() {
            if let Some(text) = line.strip_prefix("/// @retval ") {
                codes.extend((BK_ERROR_INTERNAL..BK_OK).find(|&code| {
                    // SAFETY: never NULL, and constant.
                    let name = unsafe { CStr::from_ptr(bk_result_string(code)) };
                    text.split(' ').next() == name.to_str().ok()
                }));
            } else if line.starts_with(['B', 'b'])
                && let Some((before, _)) = line.split_once('(')
                && let Some(at) = before.rfind("bk_")
            {
                all.insert(&before[at..], std::mem::replace(&mut codes, vec![BK_ERROR_INVALID_ARGUMENT]));
            }
        }
        all
    });
    all.get(function).map_or(&[], |codes| codes)
}

pub fn check_result(name: &'static str, result: bk_result) -> bk_result {
    if result == BK_OK {
        return result;
    }
    COUNTS.lock().unwrap().entry(name).or_default()[1] += 1;
    let error = last_error();
    if TRACE.load(SeqCst) {
        eprintln!("  {}= {result}: {error}", "  ".repeat(DEPTH.get() as usize));
    }
    if result == BK_ERROR_INTERNAL {
        broken(&format!("{name} gave BK_ERROR_INTERNAL: {error}"));
    }
    if !(BK_ERROR_INTERNAL..BK_OK).contains(&result) {
        broken(&format!("{name} gave {result}, which is no result"));
    }
    if !listed(name).contains(&result) {
        // SAFETY: never NULL, and constant.
        let code = unsafe { CStr::from_ptr(bk_result_string(result)) };
        broken(&format!("{name} gave {code:?}, which the header does not list for it: {error}"));
    }
    if error.is_empty() {
        broken(&format!("{name} gave {result} and no error text"));
    }
    result
}

/// What a call hands out: an object, or NULL with an error.
pub fn check_created(name: &str, result: bk_result, p: *mut c_void) {
    if (result == BK_OK) == p.is_null() {
        broken(&format!("{name} gave {result} and left {p:?} in out"));
    }
}

pub fn check_light(name: &str, values: &[f32]) {
    if let Some(v) = values.iter().find(|v| !(v.is_finite() && **v >= 0.0)) {
        broken(&format!("{name} gave light of {v}"));
    }
}

/// A device's memory account and the behaviour of its callbacks. Never freed, so that a call back after the
/// last release is seen.
pub struct Account {
    bytes: AtomicI64,
    asked: AtomicU64,
    /// Refuse every so-manieth request; 0: none but those beyond `GRANTED`; `u64::MAX`: none at all.
    refuse_every: AtomicU64,
    closed: AtomicBool,
    /// The last release came from a callback, which cannot wait for the thread that it runs on.
    released_inside: AtomicBool,
    seed: u64,
    world: Mutex<Option<Weak<World>>>,
}

/// Alive while anything made from a device is.
pub struct DeviceLife(&'static Account);

impl Drop for DeviceLife {
    fn drop(&mut self) {
        let a = self.0;
        // From a callback the threads cannot be joined: they end on their own.
        let deadline = Instant::now() + Duration::from_secs(20);
        while a.released_inside.load(SeqCst)
            && DEPTH.get() == 0
            && a.bytes.load(SeqCst) != 0
            && Instant::now() < deadline
        {
            std::thread::sleep(Duration::from_millis(1));
        }
        let left = a.bytes.load(SeqCst);
        if DEPTH.get() == 0 {
            if left != 0 {
                broken(&format!("{left} bytes are left in the memory accounts after the last release"));
            }
            a.closed.store(!a.released_inside.load(SeqCst), SeqCst);
        }
        a.world.lock().unwrap().take();
    }
}

#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Kind {
    Device,
    Scene,
    Photons,
    Lightmap,
    Live,
}

/// A reference to an object of the library, given back when the last user of it has gone.
pub struct Handle {
    p: *mut c_void,
    kind: Kind,
    /// Vertices of each mesh of a scene that this harness added.
    pub meshes: Mutex<Vec<usize>>,
    life: Arc<DeviceLife>,
}

// SAFETY: handles may be used and released from any thread.
unsafe impl Send for Handle {}
// SAFETY: as above; what one thread at a time may do is refused by the library.
unsafe impl Sync for Handle {}

impl Handle {
    /// Takes over one reference.
    pub fn new<T>(p: *mut T, kind: Kind, life: &Arc<DeviceLife>) -> Arc<Handle> {
        Arc::new(Handle { p: p.cast(), kind, meshes: Mutex::new(Vec::new()), life: life.clone() })
    }

    pub fn p<T>(&self) -> *mut T {
        self.p.cast()
    }

    pub fn life(&self) -> &Arc<DeviceLife> {
        &self.life
    }

    fn retain(&self) {
        match self.kind {
            Kind::Device => bk!(bk_device_retain(self.p())),
            Kind::Scene => bk!(bk_scene_retain(self.p())),
            Kind::Photons => bk!(bk_photon_map_retain(self.p())),
            Kind::Lightmap => bk!(bk_lightmap_retain(self.p())),
            Kind::Live => bk!(bk_live_retain(self.p())),
        }
    }

    fn release(&self) {
        match self.kind {
            Kind::Device => bk!(bk_device_release(self.p())),
            Kind::Scene => bk!(bk_scene_release(self.p())),
            Kind::Photons => bk!(bk_photon_map_release(self.p())),
            Kind::Lightmap => bk!(bk_lightmap_release(self.p())),
            Kind::Live => bk!(bk_live_release(self.p())),
        }
    }

    /// A second handle of the same object.
    pub fn again(&self) -> Arc<Handle> {
        self.retain();
        let meshes = Mutex::new(self.meshes.lock().unwrap().clone());
        Arc::new(Handle { p: self.p, kind: self.kind, meshes, life: self.life.clone() })
    }
}

impl Drop for Handle {
    fn drop(&mut self) {
        if DEPTH.get() > 0 {
            self.life.0.released_inside.store(true, SeqCst);
        }
        self.release();
    }
}

/// The objects of a sequence.
pub struct World {
    handles: [Mutex<Vec<Arc<Handle>>>; 5],
    pub folder: String,
    /// Whether only one thread makes calls: pointers into a scene may be followed then.
    pub is_alone: bool,
    /// Makes any call, from within callbacks.
    call: fn(&Arc<World>, &mut Source),
}

impl World {
    pub fn new(folder: &str, is_alone: bool, call: fn(&Arc<World>, &mut Source)) -> Arc<World> {
        Arc::new(World { handles: Default::default(), folder: folder.into(), is_alone, call })
    }

    pub fn add(&self, handle: Arc<Handle>) {
        let mut all = self.handles[handle.kind as usize].lock().unwrap();
        all.push(handle);
        // More would only make each of them rarer.
        let old = if all.len() > 4 { Some(all.remove(0)) } else { None };
        drop(all);
        drop(old);
    }

    pub fn pick(&self, kind: Kind, s: &mut Source) -> Option<Arc<Handle>> {
        let all = self.handles[kind as usize].lock().unwrap();
        if all.is_empty() { None } else { Some(all[s.below(all.len())].clone()) }
    }

    pub fn all(&self, kind: Kind) -> Vec<Arc<Handle>> {
        self.handles[kind as usize].lock().unwrap().clone()
    }

    /// Gives one handle up.
    pub fn forget(&self, kind: Kind, s: &mut Source) {
        let mut all = self.handles[kind as usize].lock().unwrap();
        let handle = if all.is_empty() { None } else { Some(s.below(all.len())) }.map(|i| all.remove(i));
        drop(all);
        drop(handle);
    }

    /// No more refusals: for the calls that must work.
    pub fn grant_all(&self) {
        for kind in [Kind::Device, Kind::Scene, Kind::Photons, Kind::Lightmap, Kind::Live] {
            for h in self.all(kind) {
                h.life.0.refuse_every.store(u64::MAX, SeqCst);
            }
        }
    }
}

/// Keeps what callbacks get until the process ends, since a wrong library could call them at any time. The list lets
/// LeakSanitizer tell it from what the library leaks.
fn kept<T: Send + Sync>(value: T) -> &'static T {
    static KEPT: Mutex<Vec<usize>> = Mutex::new(Vec::new());
    let value: &'static T = Box::leak(Box::new(value));
    KEPT.lock().unwrap().push(std::ptr::from_ref(value) as usize);
    value
}

/// An account for a device of `world`, and the pointer that its callbacks get.
pub fn account(world: &Arc<World>, s: &mut Source) -> (&'static Account, Arc<DeviceLife>) {
    let refuse_every = if s.one_in(3) { 1 + s.below(30) as u64 } else { 0 };
    let account = kept(Account {
        bytes: AtomicI64::new(0),
        asked: AtomicU64::new(0),
        refuse_every: AtomicU64::new(refuse_every),
        closed: AtomicBool::new(false),
        released_inside: AtomicBool::new(false),
        seed: s.next(),
        world: Mutex::new(Some(Arc::downgrade(world))),
    });
    (account, Arc::new(DeviceLife(account)))
}

/// Makes a few calls from within a callback.
fn call_back(world: &Mutex<Option<Weak<World>>>, seed: u64) {
    let mut s = Source::new(seed);
    if DEPTH.get() >= 2 || !s.one_in(12) {
        return;
    }
    let world = world.lock().unwrap().as_ref().and_then(Weak::upgrade);
    let Some(world) = world else { return };
    DEPTH.set(DEPTH.get() + 1);
    for _ in 0..1 + s.below(3) {
        (world.call)(&world, &mut s);
    }
    drop(world);
    DEPTH.set(DEPTH.get() - 1);
}

pub extern "C" fn memory(user: *mut c_void, bytes: i64) -> i32 {
    // SAFETY: the account that the device was created with, which is never freed.
    let a = unsafe { &*user.cast::<Account>() };
    if a.closed.load(SeqCst) {
        broken("the memory callback was called after the last release");
    }
    let n = a.asked.fetch_add(1, SeqCst);
    if bytes > 0 {
        let every = a.refuse_every.load(SeqCst);
        if every > 0 && every < u64::MAX && n % every == every - 1 {
            return 0;
        }
        if a.bytes.fetch_add(bytes, SeqCst) + bytes > GRANTED && every < u64::MAX {
            a.bytes.fetch_sub(bytes, SeqCst);
            return 0;
        }
    } else if a.bytes.fetch_add(bytes, SeqCst) + bytes < 0 {
        broken("more bytes are given back than were asked for");
    }
    call_back(&a.world, a.seed ^ n);
    1
}

pub extern "C" fn log(user: *mut c_void, level: u32, message: *const c_char) {
    // SAFETY: as above.
    let a = unsafe { &*user.cast::<Account>() };
    if a.closed.load(SeqCst) {
        broken("the log callback was called after the last release");
    }
    // SAFETY: a string that is valid during the callback.
    let text = unsafe { CStr::from_ptr(message) }.to_str();
    if level > BK_LOG_INFO || text.is_err() {
        broken(&format!("a log message of level {level}: {text:?}"));
    }
    call_back(&a.world, a.seed ^ a.asked.fetch_add(1, SeqCst));
}

/// The progress of one call. Never freed, so that a report after the call is seen.
pub struct Watched {
    started: Instant,
    limit: Duration,
    cancel_after: u64,
    reports: AtomicU64,
    last: Mutex<f32>,
    inside: AtomicBool,
    cancelled: AtomicBool,
    over: AtomicBool,
    seed: u64,
    world: Mutex<Option<Weak<World>>>,
}

impl Watched {
    pub fn new(world: &Arc<World>, s: &mut Source) -> &'static Watched {
        kept(Watched {
            started: Instant::now(),
            limit: Duration::from_millis(if s.one_in(10) { 300 } else { 25 }),
            cancel_after: if s.one_in(4) { s.below(40) as u64 } else { u64::MAX },
            reports: AtomicU64::new(0),
            last: Mutex::new(0.0),
            inside: AtomicBool::new(false),
            cancelled: AtomicBool::new(false),
            over: AtomicBool::new(false),
            seed: s.next(),
            world: Mutex::new(Some(Arc::downgrade(world))),
        })
    }

    pub fn user(&'static self) -> *mut c_void {
        std::ptr::from_ref(self).cast_mut().cast()
    }

    /// The call has come back.
    pub fn end(&self, name: &str, result: bk_result) {
        self.over.store(true, SeqCst);
        self.world.lock().unwrap().take();
        if self.cancelled.load(SeqCst) && result == BK_OK {
            broken(&format!("{name} was cancelled and gave BK_OK"));
        }
        if result == BK_ERROR_CANCELLED && !self.cancelled.load(SeqCst) {
            broken(&format!("{name} gave BK_ERROR_CANCELLED without having been cancelled"));
        }
    }
}

pub extern "C" fn progress(user: *mut c_void, fraction: f32, stage: *const c_char) -> i32 {
    // SAFETY: what the call was given, which is never freed.
    let w = unsafe { &*user.cast::<Watched>() };
    if w.over.load(SeqCst) {
        broken("the progress callback was called after its call had returned");
    }
    if w.inside.swap(true, SeqCst) {
        broken("two threads are in one progress callback at the same time");
    }
    // SAFETY: a string that is valid during the callback.
    let stage = unsafe { CStr::from_ptr(stage) }.to_str();
    let mut last = w.last.lock().unwrap();
    if !(fraction >= *last && fraction <= 1.0) || stage.is_err() || stage == Ok("") {
        broken(&format!("progress of {fraction} after {last} in stage {stage:?}"));
    }
    *last = fraction;
    drop(last);
    let n = w.reports.fetch_add(1, SeqCst);
    call_back(&w.world, w.seed ^ n);
    let go_on = n < w.cancel_after && w.started.elapsed() < w.limit;
    w.cancelled.fetch_or(!go_on, SeqCst);
    w.inside.store(false, SeqCst);
    go_on as i32
}
