//! Working memory of the tasks of a parallel loop, which they hand on to one another: as much is made as tasks run at a
//! time, instead of once per task.

use crate::base::error::Result;
use std::ops::{Deref, DerefMut};
use std::sync::{Mutex, PoisonError};

/// Working memory that no task uses now.
pub(crate) struct Scratch<T>(Mutex<Vec<T>>);

impl<T> Scratch<T> {
    pub(crate) fn new() -> Self {
        Scratch(Mutex::new(Vec::new()))
    }

    /// Returns memory that another task has given back, with what that left in it, or else makes some.
    pub(crate) fn take(&self, make: impl FnOnce() -> Result<T>) -> Result<Taken<'_, T>> {
        let idle = self.0.lock().unwrap_or_else(PoisonError::into_inner).pop();
        Ok(Taken { memory: Some(idle.map_or_else(make, Ok)?), scratch: self })
    }
}

/// Working memory of a task; dropping it gives it back.
pub(crate) struct Taken<'a, T> {
    /// `None` while it is dropped.
    memory: Option<T>,
    scratch: &'a Scratch<T>,
}

impl<T> Deref for Taken<'_, T> {
    type Target = T;

    fn deref(&self) -> &T {
        self.memory.as_ref().expect("it is there until it is dropped")
    }
}

impl<T> DerefMut for Taken<'_, T> {
    fn deref_mut(&mut self) -> &mut T {
        self.memory.as_mut().expect("it is there until it is dropped")
    }
}

impl<T> Drop for Taken<'_, T> {
    fn drop(&mut self) {
        self.scratch.0.lock().unwrap_or_else(PoisonError::into_inner).extend(self.memory.take());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_given_back_is_taken_next() {
        let scratch = Scratch::new();
        let (mut first, second) = (scratch.take(|| Ok(1)).unwrap(), scratch.take(|| Ok(2)).unwrap());
        *first += 10;
        drop(first);
        assert_eq!(*scratch.take(|| Ok(3)).unwrap(), 11);
        drop(second);
        assert_eq!(scratch.0.into_inner().unwrap(), [11, 2]);
    }
}
