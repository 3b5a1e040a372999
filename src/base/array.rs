//! Arrays that lie in memory of their own, or in a file that is mapped.

use memmap2::MmapMut;
use std::fmt;
use std::mem::ManuallyDrop;
use std::ops::{Deref, DerefMut, Range};
use std::ptr::NonNull;
use std::sync::Arc;

/// A file mapped to memory that nobody else changes: private to the process, so that what is written to the memory is never
/// written to the file, or one without a name. Pages are read when they are first touched; the system may drop those that
/// are unchanged, and write out the others of a file without a name.
pub(crate) struct Mapping {
    start: NonNull<u8>,
    bytes: usize,
    /// Unmaps on drop.
    map: MmapMut,
}

// SAFETY: the mapping owns the memory, which only arrays refer to, each a part of its own.
unsafe impl Send for Mapping {}
// SAFETY: as above; the mapping itself gives no access.
unsafe impl Sync for Mapping {}

impl Mapping {
    pub fn new(mut map: MmapMut) -> Mapping {
        let start = NonNull::new(map.as_mut_ptr()).expect("a slice has an address");
        Mapping { start, bytes: map.len(), map }
    }

    /// Tells the system that a page here and a page there will be used.
    pub fn at_random(&self) {
        // What rays hit lies here and there, and what the system reads around it drives out what is needed: a bake of 20
        // million triangles in 1 GB of memory read 1.6 TB in 2,500 s, without 95 GB in 830 s.
        self.advise(Use::AtRandom, 0, self.bytes);
    }

    /// Tells the system how a part of the file is going to be used. (Nothing depends on it.)
    fn advise(&self, of: Use, offset: usize, bytes: usize) {
        #[cfg(unix)]
        {
            let advice = match of {
                Use::Soon => memmap2::Advice::WillNeed,
                Use::AtRandom => memmap2::Advice::Random,
            };
            let _ = self.map.advise_range(advice, offset, bytes);
        }
        #[cfg(not(unix))]
        let _ = (&self.map, of, offset, bytes);
    }
}

/// How memory is going to be used.
#[derive(Clone, Copy)]
enum Use {
    Soon,
    AtRandom,
}

/// A slice that owns its memory: all of an allocation, as a `Vec` without its methods to grow, or a part of a file that
/// is mapped. To read, neither is slower than a slice.
pub struct Array<T> {
    start: NonNull<T>,
    len: usize,
    owner: Owner,
}

enum Owner {
    Vec { capacity: usize },
    Mapping { map: Arc<Mapping> },
}

// SAFETY: it owns its elements, as a `Vec` does.
unsafe impl<T: Send> Send for Array<T> {}
// SAFETY: as above.
unsafe impl<T: Sync> Sync for Array<T> {}

impl<T> Array<T> {
    /// Returns `len` elements of a mapping, `offset` bytes from its start; `None` if they do not lie in it, or not as `T`
    /// must.
    ///
    /// # Safety
    /// The bytes must be elements, and no other array may have any of them.
    pub(crate) unsafe fn mapped(map: &Arc<Mapping>, offset: usize, len: usize) -> Option<Array<T>> {
        let end = len.checked_mul(size_of::<T>())?.checked_add(offset)?;
        // SAFETY: within the mapping or at its end.
        let start = (end <= map.bytes).then(|| unsafe { map.start.add(offset) }.cast::<T>())?;
        start.is_aligned().then(|| Array { start, len, owner: Owner::Mapping { map: map.clone() } })
    }

    /// Asks the system to read these elements now, if they lie in a mapped file. (Else pages come one by one, when they are
    /// touched.)
    pub(crate) fn will_need(&self, elements: Range<usize>) {
        self.advise(Use::Soon, elements);
    }

    /// Tells the system, if the elements lie in a mapped file, that one will be read here and one there, so that what lies
    /// around them is not worth reading.
    pub(crate) fn at_random(&self) {
        self.advise(Use::AtRandom, 0..self.len());
    }

    fn advise(&self, of: Use, elements: Range<usize>) {
        let Owner::Mapping { map } = &self.owner else { return };
        let elements = &self[elements];
        let offset = elements.as_ptr().addr() - map.start.addr().get();
        map.advise(of, offset, size_of_val(elements));
    }

    /// Whether the elements lie in a mapped file.
    pub(crate) fn is_mapped(&self) -> bool {
        matches!(self.owner, Owner::Mapping { .. })
    }

    /// Lends the elements as a `Vec`, to add some or to take some away. (Those of a mapped file are copied.)
    pub fn as_vec(&mut self) -> impl DerefMut<Target = Vec<T>> {
        let elements = Vec::from(std::mem::take(self));
        Lent { array: self, elements }
    }

    /// Leaves the first `len` elements alone, if there are more; memory of the others is not freed.
    pub(crate) fn truncate(&mut self, len: usize)
    where
        T: Copy,
    {
        self.len = self.len.min(len);
    }

    /// Frees unused capacity.
    pub(crate) fn shrink_to_fit(&mut self) {
        if matches!(self.owner, Owner::Vec { capacity } if capacity > self.len) {
            self.as_vec().shrink_to_fit();
        }
    }
}

/// The elements of an array as a `Vec`, until they are given back.
struct Lent<'a, T> {
    array: &'a mut Array<T>,
    elements: Vec<T>,
}

impl<T> Drop for Lent<'_, T> {
    fn drop(&mut self) {
        *self.array = std::mem::take(&mut self.elements).into();
    }
}

impl<T> Deref for Lent<'_, T> {
    type Target = Vec<T>;

    fn deref(&self) -> &Vec<T> {
        &self.elements
    }
}

impl<T> DerefMut for Lent<'_, T> {
    fn deref_mut(&mut self) -> &mut Vec<T> {
        &mut self.elements
    }
}

impl<T> From<Vec<T>> for Array<T> {
    fn from(v: Vec<T>) -> Self {
        let mut v = ManuallyDrop::new(v);
        let start = NonNull::new(v.as_mut_ptr()).expect("a Vec has an address");
        Array { start, len: v.len(), owner: Owner::Vec { capacity: v.capacity() } }
    }
}

impl<T, const N: usize> From<[T; N]> for Array<T> {
    fn from(values: [T; N]) -> Self {
        Vec::from(values).into()
    }
}

impl<T> From<Array<T>> for Vec<T> {
    /// Without a copy, unless the elements lie in a mapped file.
    fn from(array: Array<T>) -> Self {
        let array = ManuallyDrop::new(array);
        match array.owner {
            // SAFETY: the parts are those of a `Vec`, which nothing else drops.
            Owner::Vec { capacity } => unsafe { Vec::from_raw_parts(array.start.as_ptr(), array.len, capacity) },
            Owner::Mapping { .. } => {
                let mut array = ManuallyDrop::into_inner(array);
                let mut v: Vec<T> = Vec::with_capacity(array.len);
                // SAFETY: the elements move to `v`, and the array is left without any.
                unsafe {
                    v.as_mut_ptr().copy_from_nonoverlapping(array.start.as_ptr(), array.len);
                    v.set_len(array.len);
                }
                array.len = 0;
                v
            }
        }
    }
}

impl<T> Drop for Array<T> {
    fn drop(&mut self) {
        match self.owner {
            // SAFETY: the parts are those of a `Vec`, which nothing else drops.
            Owner::Vec { capacity } => drop(unsafe { Vec::from_raw_parts(self.start.as_ptr(), self.len, capacity) }),
            // SAFETY: these elements are the array's own, and nobody uses them any more.
            Owner::Mapping { .. } => unsafe { NonNull::slice_from_raw_parts(self.start, self.len).drop_in_place() },
        }
    }
}

impl<T> Deref for Array<T> {
    type Target = [T];

    #[inline(always)]
    fn deref(&self) -> &[T] {
        // SAFETY: `len` elements that are the array's own begin there.
        unsafe { NonNull::slice_from_raw_parts(self.start, self.len).as_ref() }
    }
}

impl<T> DerefMut for Array<T> {
    #[inline(always)]
    fn deref_mut(&mut self) -> &mut [T] {
        // SAFETY: as in `deref`; mapped memory is writable, for this process alone.
        unsafe { NonNull::slice_from_raw_parts(self.start, self.len).as_mut() }
    }
}

impl<T> Default for Array<T> {
    fn default() -> Self {
        Vec::new().into()
    }
}

impl<T: Clone> Clone for Array<T> {
    fn clone(&self) -> Self {
        self.to_vec().into()
    }
}

impl<T: fmt::Debug> fmt::Debug for Array<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        (**self).fmt(f)
    }
}

impl<T: PartialEq, A: AsRef<[T]> + ?Sized> PartialEq<A> for Array<T> {
    fn eq(&self, other: &A) -> bool {
        **self == *other.as_ref()
    }
}

impl<T> AsRef<[T]> for Array<T> {
    fn as_ref(&self) -> &[T] {
        self
    }
}

impl<T> FromIterator<T> for Array<T> {
    fn from_iter<I: IntoIterator<Item = T>>(values: I) -> Self {
        Vec::from_iter(values).into()
    }
}

impl<'a, T> IntoIterator for &'a Array<T> {
    type Item = &'a T;
    type IntoIter = std::slice::Iter<'a, T>;

    fn into_iter(self) -> Self::IntoIter {
        self.iter()
    }
}

impl<'a, T> IntoIterator for &'a mut Array<T> {
    type Item = &'a mut T;
    type IntoIter = std::slice::IterMut<'a, T>;

    fn into_iter(self) -> Self::IntoIter {
        self.iter_mut()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_vec_keeps_its_memory_as_an_array_and_back() {
        let mut v = Vec::with_capacity(10);
        v.extend(["a", "b", "c"].map(String::from));
        let address = v.as_ptr();
        let mut array = Array::from(v);
        array[1].push('!');
        assert_eq!(&array[..], ["a", "b!", "c"]);
        let v = Vec::from(array.clone());
        assert!(v.as_ptr() != address && v == ["a", "b!", "c"]);
        let v = Vec::from(array);
        assert!(v.as_ptr() == address && v.capacity() == 10);
        let mut array = Array::from(v);
        array.shrink_to_fit();
        assert_eq!(Vec::from(array).capacity(), 3);
        assert!(Array::<u8>::default().is_empty());
    }

    #[test]
    fn parts_of_a_mapping_are_read_and_written_but_not_to_where_they_came_from() {
        let mut map = MmapMut::map_anon(4096).unwrap();
        map[8..16].copy_from_slice(bytemuck::cast_slice(&[7u32, 9]));
        let map = Arc::new(Mapping::new(map));
        // SAFETY: no two of the arrays that there are have bytes in common.
        let of = |offset, len| unsafe { Array::<u32>::mapped(&map, offset, len) };
        let (first, mut second) = (of(8, 1).unwrap(), of(12, 2).unwrap());
        second[1] = 5;
        assert_eq!((&first[..], &second[..]), (&[7][..], &[9, 5][..]));
        assert_eq!(Vec::from(second), [9, 5]);
        for (offset, len) in [(4096, 1), (4090, 2), (2, 1), (8, usize::MAX), (usize::MAX, 1)] {
            assert!(of(offset, len).is_none(), "{offset}, {len}");
        }
        assert_eq!(of(4096, 0).unwrap().len(), 0);
        drop(map);
        assert_eq!(first, [7]);
    }
}
