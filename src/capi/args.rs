//! Arguments: structures that carry their size, arrays with strides, outputs, flags, callbacks.

use super::handles::is_null;
use crate::base::error::{Error, Result, invalid_argument};
use bytemuck::{AnyBitPattern, Pod};
use std::ffi::{CStr, c_char, c_void};
use std::mem::size_of;

/// A structure that starts with `uint32_t struct_size` and may grow at its end.
///
/// # Safety
/// `repr(C)`, starts with a `u32` that holds the size, and every bit pattern of it is valid. It must not end in padding
/// either, into which a later field could slip: `capi-tests/abi.py` checks that.
pub(super) unsafe trait SizedStruct: Copy {
    const NAME: &'static str;
    /// Its size in the first release that had it: the least that a caller may state.
    const FIRST_SIZE: usize;
    /// The defaults, with `struct_size` set.
    fn defaults() -> Self;
}

/// Implements [`SizedStruct`]. A structure that has grown since its first release states the last field which that
/// release had, with its type: `sized_struct!(bk_x, last: field: u32, defaults: …)`.
macro_rules! sized_struct {
    ($name:ident, $(last: $last:ident: $type:ty,)? defaults: $defaults:expr) => {
        // SAFETY: the size comes first, as is asserted; fields are integers, floats, pointers and optional
        // function pointers. (The last are only ever copied from a caller's structure of the same type.)
        unsafe impl $crate::capi::args::SizedStruct for $name {
            const NAME: &'static str = stringify!($name);
            const FIRST_SIZE: usize = {
                assert!(std::mem::offset_of!($name, struct_size) == 0);
                let first = size_of::<$name>();
                $( let first = { let _ = first; std::mem::offset_of!($name, $last) + size_of::<$type>() }; )?
                first
            };
            fn defaults() -> Self {
                $defaults
            }
        }
    };
}
pub(super) use sized_struct;

/// The size of the caller's structure, checked.
///
/// # Safety
/// `p` is NULL or points to a structure whose first field is its size.
unsafe fn caller_size<T: SizedStruct>(p: *const T, name: &str) -> Result<usize> {
    if p.is_null() {
        return Err(is_null(name));
    }
    // SAFETY: by contract the size is there to be read.
    let size = unsafe { p.cast::<u32>().read_unaligned() } as usize;
    if (T::FIRST_SIZE..=size_of::<T>()).contains(&size) {
        return Ok(size);
    }
    let (first, now) = (T::FIRST_SIZE, size_of::<T>());
    let sizes = if first == now { format!("{now}") } else { format!("{first} to {now}") };
    invalid_argument!("{}.struct_size is {size}, this library knows {sizes}: call {0}_init first", T::NAME)
}

/// Reads an input structure; fields that the caller's version lacks get their defaults.
///
/// # Safety
/// `p` is NULL or points to a structure of the size that its first field states.
pub(super) unsafe fn read_struct<T: SizedStruct>(p: *const T, name: &str) -> Result<T> {
    // SAFETY: by contract.
    let size = unsafe { caller_size(p, name) }?;
    let mut value = T::defaults();
    // SAFETY: the caller's structure holds `size` bytes, ours at least as many, and they are a
    // prefix of a T, of which every bit pattern is valid.
    unsafe { std::ptr::copy_nonoverlapping(p.cast::<u8>(), (&raw mut value).cast::<u8>(), size) };
    Ok(value)
}

/// An output structure of the caller: where to write, and how much of it.
pub(super) struct OutStruct<T> {
    p: *mut T,
    size: usize,
}

impl<T: SizedStruct> OutStruct<T> {
    /// Checks the caller's structure. Done before the work, so that a wrong size costs nothing.
    ///
    /// # Safety
    /// Same as for [`read_struct`]; the structure stays writable until [`write`](Self::write).
    pub(super) unsafe fn new(p: *mut T, name: &str) -> Result<Self> {
        // SAFETY: by contract.
        let size = unsafe { caller_size(p, name) }?;
        Ok(OutStruct { p, size })
    }

    /// Same as [`new`](Self::new); NULL means that the caller does not want the output.
    ///
    /// # Safety
    /// Same as for [`new`](Self::new).
    pub(super) unsafe fn optional(p: *mut T, name: &str) -> Result<Option<Self>> {
        // SAFETY: by contract.
        if p.is_null() { Ok(None) } else { unsafe { Self::new(p, name) }.map(Some) }
    }

    /// Writes `value` up to the caller's size, and leaves its `struct_size` as it is.
    pub(super) fn write(self, value: T) {
        let (from, to) = ((&raw const value).cast::<u8>(), self.p.cast::<u8>());
        let skip = size_of::<u32>();
        // SAFETY: the caller's structure holds `size` bytes, of which the first four stay.
        unsafe { std::ptr::copy_nonoverlapping(from.add(skip), to.add(skip), self.size - skip) };
    }
}

/// The body of every `bk_..._init`: NULL is ignored.
///
/// # Safety
/// `p` is NULL or points to room for a `T`.
pub(super) unsafe fn init<T: SizedStruct>(p: *mut T) {
    if !p.is_null() {
        // SAFETY: by contract.
        unsafe { p.write_unaligned(T::defaults()) }
    }
}

/// Copies an array of `count` elements that lie `stride` bytes apart (0: packed). Neither alignment
/// nor anything behind the last element is needed.
///
/// # Safety
/// `p` is NULL or valid for reading every element.
pub(super) unsafe fn read_strided<T: AnyBitPattern>(
    p: *const impl Copy,
    stride: usize,
    count: usize,
    name: &str,
) -> Result<Vec<T>> {
    let element = size_of::<T>();
    if count == 0 {
        return Ok(Vec::new());
    }
    if p.is_null() {
        return invalid_argument!("{name} is NULL where {count} elements are expected");
    }
    if stride != 0 && stride < element {
        return invalid_argument!("the stride of {name} is {stride}, less than the {element} bytes of an element");
    }
    let stride = if stride == 0 { element } else { stride };
    let bytes = (count - 1).checked_mul(stride).and_then(|b| b.checked_add(element));
    if bytes.is_none_or(|b| b > isize::MAX as usize) {
        return invalid_argument!("{name} with {count} elements, {stride} bytes apart, is larger than memory");
    }
    let mut out = Vec::new();
    out.try_reserve_exact(count).map_err(|_| Error::OutOfMemory(format!("{name} needs {count} × {element} bytes")))?;
    // SAFETY: the offsets stay within an array that, by contract, the caller holds; the sum above
    // shows that none overflows.
    out.extend((0..count).map(|i| unsafe { p.cast::<u8>().add(i * stride).cast::<T>().read_unaligned() }));
    Ok(out)
}

/// An array that is only there if its pointer is.
///
/// # Safety
/// Same as for [`read_strided`].
pub(super) unsafe fn read_optional<T: AnyBitPattern>(
    p: *const impl Copy,
    stride: usize,
    count: usize,
    name: &str,
) -> Result<Vec<T>> {
    // SAFETY: by contract.
    if p.is_null() { Ok(Vec::new()) } else { unsafe { read_strided(p, stride, count, name) } }
}

/// Borrows a packed array for the call; NULL is fine for no elements.
///
/// # Safety
/// `p` is NULL or valid for reading `count` elements, and nobody writes them during `'a`.
pub(super) unsafe fn slice<'a, T: AnyBitPattern>(p: *const T, count: usize, name: &str) -> Result<&'a [T]> {
    if count == 0 {
        return Ok(&[]);
    }
    check_array(p, count, name)?;
    // SAFETY: not NULL, aligned, of a possible size, and valid by contract.
    Ok(unsafe { std::slice::from_raw_parts(p, count) })
}

/// Borrows a packed array for writing; `inputs` are the ranges of bytes that it must not overlap.
///
/// # Safety
/// `p` is NULL or valid for writing `count` elements, and nobody else uses them during `'a`.
pub(super) unsafe fn slice_mut<'a, T: Pod>(
    p: *mut T,
    count: usize,
    name: &str,
    inputs: &[(&[u8], &str)],
) -> Result<&'a mut [T]> {
    if count == 0 {
        return Ok(&mut []);
    }
    check_array(p, count, name)?;
    let (begin, end) = (p as usize, p as usize + count * size_of::<T>());
    for (input, input_name) in inputs {
        let at = input.as_ptr() as usize;
        if begin < at + input.len() && at < end {
            return invalid_argument!("{name} overlaps {input_name}");
        }
    }
    // SAFETY: not NULL, aligned, of a possible size, disjoint from the inputs, and valid by
    // contract. Plain numbers have no invalid values, so whatever C left there will do.
    Ok(unsafe { std::slice::from_raw_parts_mut(p, count) })
}

fn check_array<T>(p: *const T, count: usize, name: &str) -> Result<()> {
    if p.is_null() {
        return invalid_argument!("{name} is NULL where {count} elements are expected");
    }
    if !p.is_aligned() {
        return invalid_argument!("{name} is at {p:?}, not aligned to {} bytes", align_of::<T>());
    }
    if count.checked_mul(size_of::<T>()).is_none_or(|b| b > isize::MAX as usize) {
        return invalid_argument!("{name} with {count} elements is larger than memory");
    }
    Ok(())
}

/// Three floats.
///
/// # Safety
/// `p` is NULL or valid for reading three floats.
pub(super) unsafe fn read_vec3(p: *const f32, name: &str) -> Result<glam::Vec3> {
    if p.is_null() {
        return Err(is_null(name));
    }
    // SAFETY: by contract.
    Ok(glam::Vec3::from_array(unsafe { p.cast::<[f32; 3]>().read_unaligned() }))
}

/// Writes one output value.
///
/// # Safety
/// `p` is NULL or valid for writing a `T`.
pub(super) unsafe fn write<T>(p: *mut T, value: T, name: &str) -> Result<()> {
    if p.is_null() {
        return Err(is_null(name));
    }
    // SAFETY: by contract.
    unsafe { p.write_unaligned(value) };
    Ok(())
}

/// Same as [`write`]; NULL means that the caller does not want the output.
///
/// # Safety
/// Same as for [`write`].
pub(super) unsafe fn write_optional<T>(p: *mut T, value: T) -> Result<()> {
    // SAFETY: by contract.
    if p.is_null() { Ok(()) } else { unsafe { write(p, value, "") } }
}

/// Text from C.
///
/// # Safety
/// `p` is NULL or a NUL-terminated string that stays unchanged during `'a`.
pub(super) unsafe fn text<'a>(p: *const c_char, name: &str) -> Result<&'a str> {
    if p.is_null() {
        return Err(is_null(name));
    }
    // SAFETY: by contract.
    let text = unsafe { CStr::from_ptr(p) };
    text.to_str().map_err(|_| Error::InvalidArgument(format!("{name} is not UTF-8: {text:?}")))
}

/// Refuses flags that are not in `known`.
pub(super) fn check_flags(flags: u32, known: u32, name: &str) -> Result<()> {
    match flags & !known {
        0 => Ok(()),
        unknown => invalid_argument!("{name} is {flags:#x}, of which {unknown:#x} is unknown"),
    }
}

/// Reads a field that is 0 or 1.
pub(super) fn read_bool(value: u32, name: &str) -> Result<bool> {
    match value {
        0 => Ok(false),
        1 => Ok(true),
        other => invalid_argument!("{name} is {other}, not 0 or 1"),
    }
}

/// The caller's `user` pointer on its way to a callback.
#[derive(Clone, Copy)]
pub(super) struct UserPointer(*mut c_void);

// SAFETY: the library never looks behind the pointer; it only hands it back to the caller's own
// callbacks, which are documented to run on any thread.
unsafe impl Send for UserPointer {}
// SAFETY: as above.
unsafe impl Sync for UserPointer {}

impl UserPointer {
    pub(super) fn new(p: *mut c_void) -> Self {
        UserPointer(p)
    }

    /// A method, so that closures capture the whole (and with it `Send`), not the field.
    pub(super) fn get(self) -> *mut c_void {
        self.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[repr(C)]
    #[derive(Clone, Copy, Debug, PartialEq)]
    struct grown_desc {
        struct_size: u32,
        old: u32,
        added: f32,
    }

    sized_struct!(grown_desc, last: old: u32, defaults: grown_desc { struct_size: 12, old: 1, added: 2.5 });

    fn message<T>(r: Result<T>) -> String {
        r.err().unwrap().to_string()
    }

    #[test]
    fn an_older_structure_gets_defaults_for_what_it_lacks() {
        let old = [8u32, 7];
        // SAFETY: the structure is as long as it says.
        let read: grown_desc = unsafe { read_struct(old.as_ptr().cast(), "desc") }.unwrap();
        assert_eq!((read.old, read.added), (7, 2.5));
    }

    #[test]
    fn an_older_output_is_written_as_far_as_it_reaches() {
        let mut old = [8u32, 0, 0xdead];
        // SAFETY: the structure is as long as it says.
        let out = unsafe { OutStruct::<grown_desc>::new(old.as_mut_ptr().cast(), "out") }.unwrap();
        out.write(grown_desc { struct_size: 12, old: 9, added: 1.0 });
        assert_eq!(old, [8, 9, 0xdead]);
    }

    #[test]
    fn sizes_that_never_were_are_refused_by_name() {
        for size in [0, 4, 7, 13, u32::MAX] {
            let desc = grown_desc { struct_size: size, old: 0, added: 0.0 };
            // SAFETY: only the size is read before it is refused.
            let e = message(unsafe { read_struct(&desc, "desc") });
            assert!(e.contains(&format!("grown_desc.struct_size is {size}")), "{e}");
        }
    }

    #[test]
    fn strided_arrays_need_neither_alignment_nor_tail() {
        let values = [[1.0f32, 2.0, 3.0], [4.0, 5.0, 6.0]];
        let mut bytes = [0u8; 1 + 17 + 12];
        for (i, v) in values.iter().enumerate() {
            bytes[1 + i * 17..][..12].copy_from_slice(bytemuck::bytes_of(v));
        }
        // SAFETY: both elements lie within the bytes.
        let read: Vec<[f32; 3]> = unsafe { read_strided(bytes[1..].as_ptr(), 17, 2, "positions") }.unwrap();
        assert_eq!(read, values);
    }

    #[test]
    fn impossible_strides_and_counts_are_refused_by_name() {
        let read = |stride, count| {
            // SAFETY: nothing is read where the arguments are refused.
            message(unsafe { read_strided::<[f32; 3]>([0f32; 3].as_ptr(), stride, count, "positions") })
        };
        assert!(read(8, 2).contains("the stride of positions is 8"));
        assert!(read(usize::MAX / 2, 4).contains("larger than memory"));
        assert!(read(0, usize::MAX / 2).contains("larger than memory"));
        // SAFETY: NULL is allowed.
        let null = message(unsafe { read_strided::<f32>(std::ptr::null::<f32>(), 0, 3, "normals") });
        assert!(null.contains("normals is NULL"));
    }

    #[test]
    fn an_output_that_overlaps_its_input_is_refused() {
        let mut a = [0u32; 8];
        let p = a.as_mut_ptr();
        // SAFETY: within the array; the overlap is refused before it matters.
        unsafe {
            let input = slice(p.cast_const(), 4, "rays").unwrap();
            let bytes: &[u8] = bytemuck::cast_slice(input);
            assert_eq!(slice_mut(p.add(4), 4, "out", &[(bytes, "rays")]).unwrap().len(), 4);
            assert!(message(slice_mut(p.add(3), 4, "out", &[(bytes, "rays")])).contains("out overlaps rays"));
            assert!(message(slice(p.cast::<u8>().add(1).cast::<u32>(), 1, "rays")).contains("not aligned"));
        }
    }

    #[test]
    fn unknown_flags_are_refused() {
        assert!(check_flags(3, 7, "flags").is_ok());
        assert!(message(check_flags(9, 1, "flags")).contains("flags is 0x9, of which 0x8 is unknown"));
    }
}
