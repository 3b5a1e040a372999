//! Parallel loops. They are halved as rayon halves them, but all by one call of `rayon::join`, which is compiled once: rayon
//! itself compiles its division of work among threads anew for every loop that it is given
//! (docs/experiments.md#what-is-worth-optimising).

use crate::base::error::{Error, Result};
use rayon::iter::MaxLen;
use rayon::iter::plumbing::{Producer, ProducerCallback};
use rayon::prelude::*;
use std::sync::OnceLock;

/// Number of parts per thread, unless the iterator limits their lengths.
const PARTS_PER_THREAD: usize = 32;

/// Loops over the items of a parallel iterator, in any order.
pub(crate) trait ParallelLoop: IndexedParallelIterator {
    /// Calls `f` with each item.
    fn each(self, f: impl Fn(Self::Item) + Sync) {
        in_parts(self, &Each(f));
    }

    /// Calls `f` with each item. After an error the other items are left out as far as possible, and one of the errors is
    /// returned.
    fn try_each(self, f: impl Fn(Self::Item) -> Result<()> + Sync) -> Result<()> {
        self.try_each_with(|| (), |(), item| f(item))
    }

    /// Calls `f` with each item, as [`try_each`](Self::try_each), and with a value that `new` makes for each part of the
    /// loop: scratch memory.
    fn try_each_with<S>(
        self,
        new: impl Fn() -> S + Sync,
        f: impl Fn(&mut S, Self::Item) -> Result<()> + Sync,
    ) -> Result<()> {
        let work = TryEach { new, f, failed: OnceLock::new() };
        in_parts(self, &work);
        work.failed.into_inner().map_or(Ok(()), Err)
    }

    /// Collects the items in order.
    fn collected(self) -> Vec<Self::Item> {
        let mut items = Vec::with_capacity(self.len());
        self.collect_into_capacity(&mut items);
        items
    }

    /// Collects the items in order into an empty `Vec` whose capacity suffices.
    fn collect_into_capacity(self, items: &mut Vec<Self::Item>) {
        let len = self.len();
        assert!(items.is_empty());
        let places = items.spare_capacity_mut()[..len].par_iter_mut();
        places.zip(self).each(|(place, item)| _ = place.write(item));
        // SAFETY: the loop visits each of the `len` places once, and it returns only when all have been written.
        unsafe { items.set_len(len) }
    }
}

impl<I: IndexedParallelIterator> ParallelLoop for I {}

/// Lets every thread that is idle take any item that no thread has begun. (By itself rayon cuts a loop into a few parts
/// per thread, and halves only what another thread takes: on two threads the first quarter stays with the first thread,
/// even if it takes as long as all the rest. Radiance map of Sponza in the sun: 3.4 → 2.4 s.)
pub(crate) fn one_by_one<I: IndexedParallelIterator>(items: I) -> MaxLen<I> {
    items.with_max_len(1)
}

/// What a loop does with the items of one part.
trait Work<T>: Sync {
    fn of(&self, items: impl Iterator<Item = T>);
}

struct Each<F>(F);

impl<T, F: Fn(T) + Sync> Work<T> for Each<F> {
    fn of(&self, items: impl Iterator<Item = T>) {
        items.for_each(&self.0);
    }
}

struct TryEach<N, F> {
    new: N,
    f: F,
    failed: OnceLock<Error>,
}

impl<T, S, N: Fn() -> S + Sync, F: Fn(&mut S, T) -> Result<()> + Sync> Work<T> for TryEach<N, F> {
    fn of(&self, items: impl Iterator<Item = T>) {
        let mut state = (self.new)();
        for item in items {
            if self.failed.get().is_some() {
                return;
            }
            if let Err(error) = (self.f)(&mut state, item) {
                // If another thread has failed, too, its error stays.
                let _ = self.failed.set(error);
            }
        }
    }
}

/// Divides the items into parts and does `work` with each of them.
fn in_parts<I: IndexedParallelIterator>(items: I, work: &impl Work<I::Item>) {
    let len = items.len();
    if len > 0 {
        items.with_producer(Parts { len, work });
    }
}

struct Parts<'a, W> {
    len: usize,
    work: &'a W,
}

impl<T, W: Work<T>> ProducerCallback<T> for Parts<'_, W> {
    type Output = ();

    fn callback<P: Producer<Item = T>>(self, producer: P) {
        let size = size_of_parts(self.len, producer.min_len(), producer.max_len());
        halve(producer, self.len, size, self.work);
    }
}

/// Does `work` with the items of `producer`, `len` in number, in parts of up to `size`: halved until they are that small.
fn halve<P: Producer>(producer: P, len: usize, size: usize, work: &impl Work<P::Item>) {
    if len <= size {
        return work.of(producer.into_iter());
    }
    // Whole parts, so that none is much smaller than others.
    let middle = (len.div_ceil(size) / 2) * size;
    let (first, second) = producer.split_at(middle);
    let (mut first, mut second) = (Some(first), Some(second));
    join(&mut || first.take().into_iter().for_each(|half| halve(half, middle, size, work)), &mut || {
        second.take().into_iter().for_each(|half| halve(half, len - middle, size, work))
    });
}

/// Does both, in parallel if a thread is idle. Compiled once.
#[inline(never)]
fn join(first: &mut (dyn FnMut() + Send), second: &mut (dyn FnMut() + Send)) {
    rayon::join(first, second);
}

/// Returns how many items make a part of a loop over `len` items, parts being allowed to have `least` to `most`.
fn size_of_parts(len: usize, least: usize, most: usize) -> usize {
    let size = len.div_ceil(PARTS_PER_THREAD * rayon::current_num_threads()).min(most);
    size.max(least).max(1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

    #[test]
    fn each_item_is_visited_once_whatever_the_parts() {
        for len in [0, 1, 2, 3, 63, 64, 65, 10_000, 10_001] {
            for (least, most) in [(1, usize::MAX), (1, 1), (100, usize::MAX), (7, 9)] {
                let mut visits = vec![0u32; len];
                let items = visits.par_iter_mut().enumerate().with_min_len(least).with_max_len(most);
                items.each(|(i, v)| *v += 1 + i as u32);
                assert!(visits.iter().enumerate().all(|(i, &v)| v == 1 + i as u32), "{len} {least} {most}");
            }
        }
    }

    #[test]
    fn parts_have_the_lengths_that_the_loop_asks_for() {
        let threads = rayon::current_num_threads();
        assert_eq!(size_of_parts(1000, 1, 1), 1);
        assert_eq!(size_of_parts(10, 100, usize::MAX), 100);
        assert_eq!(size_of_parts(64 * threads, 1, usize::MAX), 2);
    }

    #[test]
    fn an_error_is_returned_and_ends_the_loop() {
        let seen = AtomicUsize::new(0);
        let fails_at_once = || {
            one_by_one((0..4096).into_par_iter()).try_each(|_| {
                seen.fetch_add(1, Relaxed);
                Err(Error::Cancelled)
            })
        };
        // On one thread, as other threads may begin an item before they can know of an error.
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        assert_eq!(pool.install(fails_at_once), Err(Error::Cancelled));
        assert_eq!(seen.into_inner(), 1);
        assert_eq!((0..1000).into_par_iter().try_each(|_| Ok(())), Ok(()));
    }

    #[test]
    fn scratch_is_made_for_each_part_and_used_by_all_its_items() {
        let (made, used) = (AtomicUsize::new(0), AtomicUsize::new(0));
        let new = || made.fetch_add(1, Relaxed);
        (0..1000)
            .into_par_iter()
            .with_min_len(100)
            .try_each_with(new, |_, _| {
                used.fetch_add(1, Relaxed);
                Ok(())
            })
            .unwrap();
        assert!(made.into_inner() <= 10);
        assert_eq!(used.into_inner(), 1000);
    }
}
