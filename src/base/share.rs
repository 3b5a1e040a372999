//! Shares of work that is divided among machines.

use std::ops::Range;

/// One of several parts of about the same size.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Share {
    pub number: u32,
    pub count: u32,
}

impl Share {
    /// The only share.
    pub const ALL: Share = Share { number: 0, count: 1 };

    /// Returns the items that belong to the share, of `items` in all.
    pub fn of(self, items: usize) -> Range<usize> {
        let at = |number: u32| (items as u128 * u128::from(number) / u128::from(self.count)) as usize;
        at(self.number)..at(self.number + 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_follow_one_another_and_are_all() {
        for items in [0, 1, 5, 1000, 1 << 40] {
            for count in [1, 2, 3, 7, 65_536] {
                let mut end = 0;
                for number in 0..count {
                    let share = Share { number, count }.of(items);
                    assert_eq!(share.start, end);
                    assert!(share.len().abs_diff(items / count as usize) <= 1);
                    end = share.end;
                }
                assert_eq!(end, items);
            }
        }
    }
}
