//! Arrays in files instead of memory, for what is larger than it: the system writes out what has not been used for long, and
//! reads it again when it is. The files have no names, so that they are gone with the arrays, however the process ends.

use super::array::{Array, Mapping};
use super::error::{Error, Result};
use super::memory::try_zeroed;
use super::parallel::ParallelLoop;
use super::progress::Progress;
use bytemuck::{Pod, cast_slice, cast_slice_mut};
use memmap2::MmapMut;
use rayon::prelude::*;
use std::fs::{File, OpenOptions};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

/// Size in bytes of a file that several arrays share, and of the largest of these.
const SHARED: usize = 64 << 20;
const LARGEST_IN_SHARED: usize = SHARED / 8;

/// Arrays begin at multiples of this.
const ALIGN: usize = 64;

/// Size in bytes of the smallest array that is worth a place in a scratch file.
pub(crate) const LEAST_IN_SCRATCH: usize = 1 << 12;

/// Where arrays that may be large lie: in scratch files, if there is a folder for them, or in memory.
#[derive(Clone, Copy)]
pub(crate) struct Storage<'a>(Option<&'a ScratchFiles>);

impl<'a> Storage<'a> {
    pub const MEMORY: Storage<'static> = Storage(None);

    pub fn new(files: Option<&'a ScratchFiles>) -> Self {
        Storage(files)
    }

    /// Whether it is files.
    pub fn is_files(self) -> bool {
        self.0.is_some()
    }

    /// Makes an array of zeros; in memory by `make`, whose name for it in error messages is `what`.
    pub fn zeroed<T: Pod>(self, len: usize, make: fn(usize, &str) -> Result<Vec<T>>, what: &str) -> Result<Array<T>> {
        match self.0 {
            Some(files) if len.saturating_mul(size_of::<T>()) >= LEAST_IN_SCRATCH => files.zeroed(len),
            _ => make(len, what).map(Array::from),
        }
    }

    /// Copies the elements of an array, on the current threads.
    pub fn copy<T: Pod + Send + Sync>(self, values: &Array<T>, what: &str, progress: &Progress) -> Result<Array<T>> {
        let mut copy = self.zeroed(values.len(), try_zeroed, what)?;
        let size = size_of::<T>().max(1);
        // (What was said to be read here and there would come page by page.)
        let will_need = |bytes: Range<usize>| values.will_need(bytes.start / size..bytes.end.div_ceil(size));
        copy_bytes(cast_slice_mut(&mut copy), cast_slice(values), &will_need, progress)?;
        Ok(copy)
    }

    /// Moves an array that is in memory to files, if these are the storage.
    pub fn take_in<T: Pod + Send + Sync>(self, array: &mut Array<T>, progress: &Progress) -> Result<()> {
        if self.is_files() && !array.is_mapped() && size_of_val(&array[..]) >= LEAST_IN_SCRATCH {
            *array = self.copy(array, "", progress)?;
        }
        Ok(())
    }
}

/// Size in bytes of what is copied between two looks for a cancel.
const PART: usize = 4 << 20;

/// Copies bytes, whose ranges are announced to `will_need` before they are read. (Once for elements of all kinds: the
/// loop would be in the library ten times.)
fn copy_bytes(
    to: &mut [u8],
    from: &[u8],
    will_need: &(dyn Fn(Range<usize>) + Sync),
    progress: &Progress,
) -> Result<()> {
    to.par_chunks_mut(PART).zip(from.par_chunks(PART)).enumerate().try_each(|(i, (to, from))| {
        progress.check()?;
        will_need(i * PART..i * PART + from.len());
        to.copy_from_slice(from);
        Ok(())
    })
}

/// Arrays in files of a folder.
pub(crate) struct ScratchFiles {
    folder: PathBuf,
    /// The file that is being filled, and how many bytes of it are taken.
    shared: Mutex<Option<(Arc<Mapping>, usize)>>,
}

impl ScratchFiles {
    pub fn new(folder: PathBuf) -> ScratchFiles {
        ScratchFiles { folder, shared: Mutex::new(None) }
    }

    /// Arrays in other files of the same folder.
    pub fn another(&self) -> ScratchFiles {
        ScratchFiles::new(self.folder.clone())
    }

    /// Makes an array of zeros. A file goes when all arrays in it are gone, but the one that is being filled stays.
    pub fn zeroed<T: Pod>(&self, len: usize) -> Result<Array<T>> {
        let (map, offset) = match len.checked_mul(size_of::<T>()) {
            Some(0) => return Ok(Array::default()),
            bytes => self.place(bytes)?,
        };
        // SAFETY: all bits are elements, and no other array gets this part of the file.
        Ok(unsafe { Array::mapped(&map, offset, len) }.expect("it lies in the file, at a multiple of ALIGN"))
    }

    /// Finds a place for so many bytes; none is more than there can be.
    fn place(&self, bytes: Option<usize>) -> Result<(Arc<Mapping>, usize)> {
        match bytes {
            Some(bytes) if bytes <= LARGEST_IN_SHARED => self.part(bytes),
            Some(bytes) if bytes <= isize::MAX as usize - SHARED => Ok((self.file(bytes)?, 0)),
            _ => Err(Error::OutOfMemory("an array is too large for a scratch file".into())),
        }
    }

    /// Takes a part of the file that is being filled.
    fn part(&self, bytes: usize) -> Result<(Arc<Mapping>, usize)> {
        let mut shared = self.shared.lock().unwrap_or_else(PoisonError::into_inner);
        let (map, used) = match shared.take() {
            Some((map, used)) if used + bytes <= SHARED => (map, used),
            _ => {
                let map = self.file(SHARED)?;
                // What of many small arrays is used next lies here and there.
                map.at_random();
                (map, 0)
            }
        };
        *shared = Some((map.clone(), (used + bytes).next_multiple_of(ALIGN)));
        Ok((map, used))
    }

    fn file(&self, bytes: usize) -> Result<Arc<Mapping>> {
        let map = unnamed(&self.folder, bytes).and_then(|file| {
            // SAFETY: the file has no name, so that nobody else can change it or cut it short.
            unsafe { MmapMut::map_mut(&file) }
        });
        let fail =
            |e| Error::Io(format!("cannot make a scratch file of {bytes} bytes in {}: {e}", self.folder.display()));
        Ok(Arc::new(Mapping::new(map.map_err(fail)?)))
    }
}

/// Makes a file without a name.
fn unnamed(folder: &Path, bytes: usize) -> std::io::Result<File> {
    static COUNT: AtomicU64 = AtomicU64::new(0);
    let name = format!(".bakelite-scratch-{}-{}", std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed));
    let path = folder.join(name);
    let file = OpenOptions::new().read(true).write(true).create_new(true).open(&path)?;
    std::fs::remove_file(&path)?;
    file.set_len(bytes as u64)?;
    take_room(&file, bytes)?;
    Ok(file)
}

/// Takes all the room on the disk now: where there is none later, a write to memory would end the process.
#[cfg(target_os = "linux")]
fn take_room(file: &File, bytes: usize) -> std::io::Result<()> {
    use std::os::fd::AsRawFd;
    // SAFETY: the file is open.
    match unsafe { libc::posix_fallocate(file.as_raw_fd(), 0, bytes as libc::off_t) } {
        0 => Ok(()),
        e => Err(std::io::Error::from_raw_os_error(e)),
    }
}

#[cfg(not(target_os = "linux"))]
fn take_room(mut file: &File, bytes: usize) -> std::io::Result<()> {
    use std::io::{Read, copy, repeat};
    copy(&mut repeat(0).take(bytes as u64), &mut file).map(|_| ())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arrays_are_apart_and_leave_no_file() {
        let folder = std::env::temp_dir().join(format!("bakelite-scratch-test-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let files = ScratchFiles::new(folder.clone());
        let sizes =
            [1, 1000, 0, 5 << 20, 1, 100_000, (20 << 20) + 3, 6 << 20, 6 << 20, 7 << 20, 7 << 20, 7 << 20, 7 << 20];
        let mut arrays: Vec<Array<u8>> = sizes.iter().map(|&len| files.zeroed(len).unwrap()).collect();
        let words: Array<[u64; 3]> = files.zeroed(7).unwrap();
        assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 0);
        for (i, array) in arrays.iter_mut().enumerate() {
            assert!(array.iter().all(|&b| b == 0));
            array.fill(i as u8 + 1);
        }
        assert_eq!(words, vec![[0; 3]; 7]);
        drop(files);
        for (i, (array, len)) in arrays.iter().zip(sizes).enumerate() {
            assert!(array.len() == len && array.iter().all(|&b| b == i as u8 + 1));
        }
        std::fs::remove_dir(&folder).unwrap();
        let e = ScratchFiles::new(folder).zeroed::<u8>(1).unwrap_err().to_string();
        assert!(e.contains("scratch file"), "{e}");
    }
}
