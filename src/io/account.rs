//! Memory for the contents of a file: announced to the device's memory monitor before it is allocated. Where there is
//! none, that is an error and not an abort.

use crate::base::error::{Error, Result};
use crate::base::memory::{MemoryMonitor, Reservation};
use std::collections::HashMap;
use std::hash::Hash;
use std::sync::Arc;

/// Bytes are announced in such steps, so that the monitor is not asked for every small array.
const STEP: usize = 1 << 20;

/// Memory held by one call that reads a file.
pub(super) struct Account {
    held: usize,
    reservation: Reservation,
}

impl Account {
    pub fn new(monitor: &Arc<MemoryMonitor>) -> Result<Account> {
        Ok(Account { held: 0, reservation: monitor.reserve(0, "a file")? })
    }

    /// Announces `bytes` more.
    pub fn hold(&mut self, bytes: usize, what: &str) -> Result<()> {
        let held = self.held.checked_add(bytes).ok_or_else(|| no_room(bytes, what))?;
        if held > self.reservation.bytes() {
            self.reservation.grow(held.checked_next_multiple_of(STEP).unwrap_or(held), what)?;
        }
        self.held = held;
        Ok(())
    }

    /// Gives back `bytes` of the memory that is held.
    pub fn give_back(&mut self, bytes: usize) {
        self.held = self.held.saturating_sub(bytes);
        self.reservation.shrink(self.held.next_multiple_of(STEP));
    }

    /// Appends a value. The capacity doubles when it is used up.
    #[inline]
    pub fn push<T>(&mut self, list: &mut Vec<T>, value: T, what: &str) -> Result<()> {
        if list.len() == list.capacity() {
            self.make_room(list, 1, what)?;
        }
        list.push(value);
        Ok(())
    }

    /// Reserves capacity for `more` values, and at least doubles it.
    #[cold]
    pub fn make_room<T>(&mut self, list: &mut Vec<T>, more: usize, what: &str) -> Result<()> {
        if list.capacity() - list.len() >= more {
            return Ok(());
        }
        let wanted = list.len().checked_add(more).ok_or_else(|| no_room(more, what))?.max(2 * list.capacity()).max(4);
        self.hold((wanted - list.capacity()).saturating_mul(size_of::<T>()), what)?;
        list.try_reserve_exact(wanted - list.len()).map_err(|_| no_room(wanted.saturating_mul(size_of::<T>()), what))
    }

    /// An empty list with capacity for `len` values.
    pub fn list<T>(&mut self, len: usize, what: &str) -> Result<Vec<T>> {
        let mut list = Vec::new();
        self.hold(len.saturating_mul(size_of::<T>()), what)?;
        list.try_reserve_exact(len).map_err(|_| no_room(len.saturating_mul(size_of::<T>()), what))?;
        Ok(list)
    }

    /// Reserves capacity for one more entry.
    #[inline]
    pub fn make_room_in_map<K: Eq + Hash, V>(&mut self, map: &mut HashMap<K, V>, what: &str) -> Result<()> {
        if map.len() < map.capacity() {
            return Ok(());
        }
        let more = map.len().max(4);
        // An entry and a byte of the table, at a load of 7/8 or less.
        let bytes = 2 * more * (size_of::<(K, V)>() + 1);
        self.hold(bytes, what)?;
        map.try_reserve(more).map_err(|_| no_room(bytes, what))
    }
}

#[cold]
fn no_room(bytes: usize, what: &str) -> Error {
    Error::OutOfMemory(format!("{what} needs {bytes} bytes"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_list_is_announced_before_it_grows_and_a_refusal_is_an_error() {
        let monitor = Arc::new(MemoryMonitor::new(Some(Box::new(|bytes| bytes < 10 << 20))));
        let mut account = Account::new(&monitor).unwrap();
        let mut list = Vec::new();
        let refused = (0u64..).find_map(|i| account.push(&mut list, i, "the list").err()).unwrap();
        assert!(matches!(refused, Error::OutOfMemory(e) if e.contains("the list")));
        assert!(monitor.current() as usize >= list.capacity() * 8 && list.len() == list.capacity());
        assert!(matches!(account.list::<u64>(usize::MAX / 4, "a list"), Err(Error::OutOfMemory(_))));
        drop(account);
        assert_eq!(monitor.current(), 0);
    }
}
