//! Sorting of many keys that can be cancelled: halved about the median by quickselect (Hoare, *Algorithm 65: Find*, 1961),
//! in parallel, until parts are small. Values have one order, so the result does not depend on the threads.

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
}
