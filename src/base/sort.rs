//! Sorting of many keys that can be cancelled: halved about the median by quickselect (Hoare, *Algorithm 65: Find*, 1961),
//! in parallel, until parts are small. Values have one order, so the result does not depend on the threads. And the
//! greatest of numbered values.

use crate::base::error::Result;

/// Number of values that are sorted between two checks for a cancel: some 2 ms.
const PART: usize = 1 << 16;

/// Sorts values and calls `check` between parts of them, up to its first error. Takes no memory. (3 million keys of 16 bytes,
/// San Miguel's edges, took up to 90 ms without a look for a cancel.)
pub(crate) fn sort<T: Ord + Send>(values: &mut [T], check: &(impl Fn() -> Result<()> + Sync)) -> Result<()> {
    check()?;
    if values.len() <= PART {
        values.sort_unstable();
        return Ok(());
    }
    let (low, _, high) = values.select_nth_unstable(values.len() / 2);
    let (low, high) = rayon::join(|| sort(low, check), || sort(high, check));
    low.and(high)
}

/// A value and a number.
type Numbered = (f32, u32);

/// Puts the `count` greatest of numbered values first, in descending order, of equal ones that with the lowest number
/// first; returns them and the others. (Not generic: the library would have this code for each of its callers.)
pub(crate) fn greatest_first(values: &mut [Numbered], count: usize) -> (&mut [Numbered], &mut [Numbered]) {
    let order = |a: &Numbered, b: &Numbered| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1));
    if count < values.len() {
        values.select_nth_unstable_by(count, order);
    }
    let (first, others) = values.split_at_mut(count.min(values.len()));
    first.sort_unstable_by(order);
    (first, others)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::error::Error;
    use crate::base::sampling::mix;
    use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

    #[test]
    fn the_order_is_that_of_any_sort_and_each_check_may_end_it() {
        let values: Vec<u32> = (0..300_000).map(|i| mix(i) % 100_000).collect();
        let (mut expected, mut sorted) = (values.clone(), values.clone());
        expected.sort();
        let checks = AtomicUsize::new(0);
        let count = || {
            checks.fetch_add(1, Relaxed);
            Ok(())
        };
        sort(&mut sorted, &count).unwrap();
        assert_eq!(sorted, expected);
        let all = checks.into_inner();
        assert!(all >= 300_000 / PART);
        for last in 0..all {
            let checks = AtomicUsize::new(0);
            let fail = || if checks.fetch_add(1, Relaxed) == last { Err(Error::Cancelled) } else { Ok(()) };
            assert_eq!(sort(&mut values.clone(), &fail), Err(Error::Cancelled));
        }
    }

    #[test]
    fn the_greatest_come_first() {
        let values: Vec<(f32, u32)> = (0..500).map(|i| ((mix(i) % 50) as f32 - 25.0, i)).collect();
        let mut expected = values.clone();
        expected.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        for count in [0, 1, 30, 499, 500, 501] {
            let mut values = values.clone();
            let (first, others) = greatest_first(&mut values, count);
            assert_eq!(first, &expected[..count.min(500)]);
            assert_eq!(first.len() + others.len(), 500);
            others.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
            assert_eq!(others, &expected[count.min(500)..]);
        }
    }
}
