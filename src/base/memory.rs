//! Accounts of large allocations: a running total with its peak, an optional monitor that may
//! refuse, and budgets for single calls.

use crate::base::error::{Error, Result};
use crate::base::parallel::{ParallelLoop, one_by_one};
use rayon::prelude::*;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering::SeqCst};

/// Called before a large allocation with its size in bytes, and with a negative size after it is freed. `false` refuses
/// (the answer to a negative size is ignored).
pub type MemoryFn = dyn Fn(i64) -> bool + Send + Sync;

/// The accounts of one device.
#[derive(Default)]
pub struct MemoryMonitor {
    callback: Option<Box<MemoryFn>>,
    current: AtomicI64,
    peak: AtomicI64,
}

impl MemoryMonitor {
    /// Makes accounts that ask `callback`, if there is one.
    pub fn new(callback: Option<Box<MemoryFn>>) -> Self {
        MemoryMonitor { callback, ..Default::default() }
    }

    /// Number of bytes held now.
    pub fn current(&self) -> i64 {
        self.current.load(SeqCst)
    }

    /// Maximum number of bytes held at once since the last [`reset_peak`](Self::reset_peak).
    pub fn peak(&self) -> i64 {
        self.peak.load(SeqCst)
    }

    /// Resets the peak to the bytes held now.
    pub fn reset_peak(&self) {
        self.peak.store(self.current(), SeqCst);
    }

    /// Announces `bytes` for `what`; they are given back when the reservation is dropped. It must be held beside the
    /// buffer that it accounts for.
    pub fn reserve(self: &Arc<Self>, bytes: usize, what: &str) -> Result<Reservation> {
        let bytes = i64::try_from(bytes).map_err(|_| Error::OutOfMemory(format!("{what} would take {bytes} bytes")))?;
        if let Some(callback) = &self.callback
            && !crate::base::callback::run(|| callback(bytes))
        {
            return Err(Error::OutOfMemory(format!("the memory monitor refused {bytes} bytes for {what}")));
        }
        let now = self.current.fetch_add(bytes, SeqCst) + bytes;
        self.peak.fetch_max(now, SeqCst);
        Ok(Reservation { monitor: self.clone(), bytes })
    }
}

/// Asks the system for large pages behind a buffer that is read at random; to be called before the buffer is first
/// written. (Most systems give them only on demand. Random rays take 8 % less time in Sponza's tree of 18 MB, 17 % in
/// San Miguel's.) This is a hint: nothing happens on systems without large pages, or to a small buffer.
pub(crate) fn prefer_large_pages<T>(buffer: &[T]) {
    #[cfg(all(target_os = "linux", not(miri)))]
    {
        let page = LARGE_PAGE;
        let range = buffer.as_ptr_range();
        // Whole pages only, so that nothing else is asked for.
        let (start, end) = ((range.start as usize).next_multiple_of(page), range.end as usize & !(page - 1));
        if end > start {
            // SAFETY: advice does not change what memory holds. A failure is as good as no wish.
            unsafe { libc::madvise(start as *mut libc::c_void, end - start, libc::MADV_HUGEPAGE) };
        }
    }
    #[cfg(any(not(target_os = "linux"), miri))]
    let _ = buffer;
}

/// Size of large pages on x86-64, and on AArch64 with small pages of 4 KB.
#[cfg(all(target_os = "linux", not(miri)))]
const LARGE_PAGE: usize = 2 << 20;

/// Bytes announced to a [`MemoryMonitor`], given back on drop.
pub struct Reservation {
    monitor: Arc<MemoryMonitor>,
    bytes: i64,
}

impl Reservation {
    /// Size in bytes.
    pub fn bytes(&self) -> usize {
        self.bytes as usize
    }

    /// Announces more bytes, so that `bytes` are held in all; a refusal changes nothing.
    pub fn grow(&mut self, bytes: usize, what: &str) -> Result<()> {
        let mut more = self.monitor.reserve(bytes.saturating_sub(self.bytes()), what)?;
        self.bytes += std::mem::take(&mut more.bytes);
        Ok(())
    }

    /// Gives back all but `bytes`, if there are more.
    pub fn shrink(&mut self, bytes: usize) {
        let more = self.bytes - self.bytes.min(bytes as i64);
        self.bytes -= more;
        drop(Reservation { monitor: self.monitor.clone(), bytes: more });
    }
}

impl Drop for Reservation {
    fn drop(&mut self) {
        if self.bytes == 0 {
            return;
        }
        self.monitor.current.fetch_sub(self.bytes, SeqCst);
        if let Some(callback) = &self.monitor.callback {
            crate::base::callback::run(|| callback(-self.bytes));
        }
    }
}

fn too_large<T>(len: usize, what: &str) -> Error {
    Error::OutOfMemory(format!("{what} needs {} bytes", len as u128 * size_of::<T>() as u128))
}

/// Makes an empty `Vec` with capacity for `capacity` elements, in large pages if there are any. As in all functions
/// here, an allocation that fails is an error, not an abort.
pub fn try_with_capacity<T>(capacity: usize, what: &str) -> Result<Vec<T>> {
    let mut v = Vec::new();
    v.try_reserve_exact(capacity).map_err(|_| too_large::<T>(capacity, what))?;
    prefer_large_pages(v.spare_capacity_mut());
    Ok(v)
}

/// Makes a `Vec` of `len` default values.
pub fn try_vec<T: Default + Clone>(len: usize, what: &str) -> Result<Vec<T>> {
    try_filled(len, T::default(), what)
}

/// Makes a `Vec` of `len` equal values.
pub fn try_filled<T: Clone>(len: usize, value: T, what: &str) -> Result<Vec<T>> {
    let mut v = try_with_capacity(len, what)?;
    v.resize(len, value);
    Ok(v)
}

/// Makes a `Vec` of `len` zeros, which take no memory until they are written.
pub fn try_zeroed<T: bytemuck::Zeroable>(len: usize, what: &str) -> Result<Vec<T>> {
    let v = bytemuck::allocation::try_zeroed_vec(len).map_err(|_| too_large::<T>(len, what))?;
    prefer_large_pages(&v);
    Ok(v)
}

/// Makes a `Vec` of `len` zeros of which large parts may never be written: in small pages, as untouched ones then take
/// no memory.
pub fn try_zeroed_as_needed<T: bytemuck::Zeroable>(len: usize, what: &str) -> Result<Vec<T>> {
    bytemuck::allocation::try_zeroed_vec(len).map_err(|_| too_large::<T>(len, what))
}

/// Copies a slice.
pub fn try_to_vec<T: Clone>(values: &[T], what: &str) -> Result<Vec<T>> {
    let mut v = try_with_capacity(values.len(), what)?;
    v.extend_from_slice(values);
    Ok(v)
}

/// Adds the elements of a slice to the end.
pub fn try_append<T: Clone>(v: &mut Vec<T>, values: &[T], what: &str) -> Result<()> {
    v.try_reserve(values.len()).map_err(|_| too_large::<T>(v.len() + values.len(), what))?;
    v.extend_from_slice(values);
    Ok(())
}

/// Adds an element to the end.
#[inline]
pub fn try_push<T>(v: &mut Vec<T>, value: T, what: &str) -> Result<()> {
    if v.len() == v.capacity() {
        v.try_reserve(1).map_err(|_| too_large::<T>(2 * v.len(), what))?;
    }
    v.push(value);
    Ok(())
}

/// Collects the items of an iterator in a `Vec` that grows as needed.
pub fn try_collect<T>(values: impl IntoIterator<Item = T>, what: &str) -> Result<Vec<T>> {
    let values = values.into_iter();
    let mut v = try_with_capacity(values.size_hint().0, what)?;
    for value in values {
        try_push(&mut v, value, what)?;
    }
    Ok(v)
}

/// Collects the items of a parallel iterator of known length, in order.
pub fn try_par_collect<T: Send>(values: impl IndexedParallelIterator<Item = T>, what: &str) -> Result<Vec<T>> {
    let mut v = try_with_capacity(values.len(), what)?;
    values.collect_into_capacity(&mut v);
    Ok(v)
}

/// Collects the items of an iterator, up to its first error.
pub fn try_collect_ok<T>(values: impl IntoIterator<Item = Result<T>>, what: &str) -> Result<Vec<T>> {
    let values = values.into_iter();
    let mut v = try_with_capacity(values.size_hint().0, what)?;
    for value in values {
        try_push(&mut v, value?, what)?;
    }
    Ok(v)
}

/// Collects the items of a parallel iterator of known length, in order, or returns the first of its errors. (All items
/// are computed: work that can be cancelled must check for that itself.) Each item should take long.
pub fn try_par_collect_ok<T: Send>(
    values: impl IndexedParallelIterator<Item = Result<T>>,
    what: &str,
) -> Result<Vec<T>> {
    try_collect_ok(try_par_collect(one_by_one(values), what)?, what)
}

/// Calls `part` with each of the numbers below `parts`, in parallel, and concatenates the items that it adds to its
/// `Vec`, in order of the numbers. Each part should be small, all together may be many.
pub fn try_par_gather<T: Send>(
    parts: usize,
    what: &str,
    part: impl Fn(usize, &mut Vec<T>) -> Result<()> + Sync,
) -> Result<Vec<T>> {
    par_gather(parts, what, &part)
}

/// Does the work of [`try_par_gather`], compiled once for all that gather a type.
fn par_gather<T: Send>(
    parts: usize,
    what: &str,
    part: &(dyn Fn(usize, &mut Vec<T>) -> Result<()> + Sync),
) -> Result<Vec<T>> {
    let one = |i: usize| {
        let mut of_part = Vec::new();
        part(i, &mut of_part).map(|()| of_part)
    };
    let found = try_par_collect(one_by_one((0..parts).into_par_iter().map(one)), what)?;
    let total = found.iter().map(|f| f.as_ref().map_or(0, Vec::len)).sum();
    let mut all = try_with_capacity(total, what)?;
    for of_part in found {
        all.append(&mut of_part?);
    }
    Ok(all)
}

/// The numbers below `count` that `keep` accepts, ascending. Computed in parallel.
pub fn try_par_filter(count: usize, what: &str, keep: impl Fn(u32) -> bool + Sync) -> Result<Vec<u32>> {
    try_par_gather(count.div_ceil(FILTER_PART), what, |i, out| {
        let part = i * FILTER_PART..count.min((i + 1) * FILTER_PART);
        part.map(|n| n as u32).filter(|&n| keep(n)).try_for_each(|n| try_push(out, n, what))
    })
}

/// Number of candidates that [`try_par_filter`] gives to a thread at a time.
const FILTER_PART: usize = 1 << 12;

/// Cuts `values`, of which there are `count` or none at all, into parts of `size`. There are as many parts either way; they
/// are empty if there are no values.
pub(crate) fn try_parts<T>(values: &mut [T], size: usize, count: usize) -> Result<Vec<&mut [T]>> {
    let mut parts: Vec<&mut [T]> = try_with_capacity(count.div_ceil(size), "parts of values")?;
    parts.extend(values.chunks_mut(size));
    parts.resize_with(count.div_ceil(size), Default::default);
    Ok(parts)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wish_for_large_pages_changes_nothing() {
        for len in [0, 1, 1 << 23] {
            let bytes = vec![7u8; len];
            prefer_large_pages(&bytes);
            assert!(bytes.iter().all(|&b| b == 7));
        }
    }

    #[test]
    fn reservations_add_up_and_go() {
        let m = Arc::new(MemoryMonitor::new(None));
        let a = m.reserve(10, "a").unwrap();
        let b = m.reserve(5, "b").unwrap();
        drop(a);
        assert_eq!((m.current(), m.peak()), (5, 15));
        drop(b);
        assert_eq!(m.current(), 0);
    }

    #[test]
    fn a_reservation_grows_and_goes_as_a_whole() {
        let m = Arc::new(MemoryMonitor::new(Some(Box::new(|bytes| bytes < 100))));
        let mut a = m.reserve(10, "a").unwrap();
        a.grow(90, "a").unwrap();
        assert!(a.grow(300, "a").is_err());
        assert_eq!((a.bytes(), m.current()), (90, 90));
        drop(a);
        assert_eq!(m.current(), 0);
    }

    #[test]
    fn a_reservation_shrinks_but_not_to_more() {
        let given_back = Arc::new(AtomicI64::new(0));
        let seen = given_back.clone();
        let callback = move |bytes: i64| {
            seen.fetch_sub(bytes.min(0), SeqCst);
            true
        };
        let m = Arc::new(MemoryMonitor::new(Some(Box::new(callback))));
        let mut a = m.reserve(100, "a").unwrap();
        a.shrink(200);
        assert_eq!((a.bytes(), given_back.load(SeqCst)), (100, 0));
        a.shrink(30);
        assert_eq!((a.bytes(), m.current(), m.peak(), given_back.load(SeqCst)), (30, 30, 100, 70));
        drop(a);
        assert_eq!((m.current(), given_back.load(SeqCst)), (0, 100));
    }

    #[test]
    fn a_monitor_can_refuse() {
        let m = Arc::new(MemoryMonitor::new(Some(Box::new(|bytes| bytes < 100))));
        assert!(m.reserve(99, "small").is_ok());
        let e = m.reserve(100, "the photon map").err().unwrap();
        assert_eq!(e, Error::OutOfMemory("the memory monitor refused 100 bytes for the photon map".into()));
        assert_eq!(m.current(), 0);
    }
}
