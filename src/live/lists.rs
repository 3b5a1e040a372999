//! Very many short lists of numbers in two buffers: however many lists there are, only two allocations can fail.

use crate::base::error::{Error, Result};
use crate::base::memory::try_vec;

/// Immutable lists of numbers.
pub(super) struct Lists {
    /// Start of each list, and the end of the last.
    first: Vec<u32>,
    items: Vec<u32>,
}

impl Lists {
    /// Makes `count` lists. `visit` calls its argument with the index of a list and the next number in it. It is called
    /// twice and must do the same both times.
    pub fn new(count: usize, what: &str, visit: impl Fn(&mut dyn FnMut(usize, u32))) -> Result<Lists> {
        let mut first: Vec<u32> = try_vec(count + 1, what)?;
        let mut total = 0u64;
        visit(&mut |list, _| {
            first[list] += 1;
            total += 1;
        });
        if total > u64::from(u32::MAX) {
            return Err(Error::OutOfMemory(format!("{what} would have {total} entries")));
        }
        let mut next = 0;
        for length in &mut first {
            next += std::mem::replace(length, next);
        }
        let mut items = try_vec(total as usize, what)?;
        visit(&mut |list, item| {
            items[first[list] as usize] = item;
            first[list] += 1;
        });
        // Each entry is now the end of its list, which is the start of the next one.
        first.rotate_right(1);
        first[0] = 0;
        Ok(Lists { first, items })
    }

    pub fn get(&self, list: usize) -> &[u32] {
        &self.items[self.first[list] as usize..self.first[list + 1] as usize]
    }

    /// The number of lists.
    pub fn len(&self) -> usize {
        self.first.len() - 1
    }

    /// Length of the longest list.
    pub fn longest(&self) -> usize {
        (0..self.len()).map(|list| self.get(list).len()).max().unwrap_or(0)
    }

    pub fn bytes(&self) -> usize {
        size_of_val(&self.first[..]) + size_of_val(&self.items[..])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_keep_the_order_of_their_items() {
        let entries = [(2, 7), (0, 1), (2, 5), (2, 6), (0, 0)];
        let lists = Lists::new(4, "lists", |add| entries.iter().for_each(|&(list, item)| add(list, item))).unwrap();
        let all: Vec<&[u32]> = (0..lists.len()).map(|list| lists.get(list)).collect();
        assert_eq!(all, [&[1, 0][..], &[], &[7, 5, 6], &[]]);
        assert_eq!((lists.longest(), Lists::new(0, "lists", |_| ()).unwrap().len()), (3, 0));
    }
}
