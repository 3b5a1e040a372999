//! Files on disk: only regular ones are read, and a file is replaced as a whole or not at all.
//!
//! [`replace`] writes a file beside the target, flushes it to disk and renames it. If that ends early (a full disk, a
//! cancel, a kill, a power failure), the old file is unchanged. Only a kill leaves the file beside the target,
//! `NAME.part` (for a name too long for that its checksum, `CHECKSUM.part`); the next save of the same name overwrites
//! it.

use crate::base::error::{Error, Result};
use std::fs::{File, Metadata, OpenOptions, TryLockError};
use std::io::{self, ErrorKind, Read, Write};
use std::path::{Path, PathBuf};

/// Number of bytes between two flushes to disk, between which a call can end. A slow disk takes 13 ms for so many, and
/// 40 ms for four times as many, in which it would write a third faster; several threads that flush wait for each
/// other.
const SYNC_BYTES: usize = 1 << 20;

/// Opens a regular file to read. Fails for folders, devices, FIFOs and sockets, and never waits for one of them: the
/// check examines the file that was opened, not the one that had the name before.
pub fn open(path: &Path) -> io::Result<File> {
    let mut options = OpenOptions::new();
    options.read(true);
    do_not_wait(&mut options, false);
    let file = options.open(path)?;
    check_regular(&file.metadata()?)?;
    Ok(file)
}

/// Reads a regular file of at most `most` bytes. The error names the file.
pub fn read(path: &Path, most: u64) -> Result<Vec<u8>> {
    let fail = |e: io::Error| Error::Io(format!("cannot read {}: {e}", path.display()));
    let file = open(path).map_err(fail)?;
    let size = file.metadata().map_err(fail)?.len();
    let too_large = || Error::OutOfMemory(format!("{} has more than {most} bytes", path.display()));
    if size > most {
        return Err(too_large());
    }
    let mut bytes = Vec::new();
    bytes
        .try_reserve_exact(size as usize + 1)
        .map_err(|_| Error::OutOfMemory(format!("{} needs {size} bytes", path.display())))?;
    // A file that grows meanwhile is read to its first size; one byte more shows that it has grown.
    file.take(size + 1).read_to_end(&mut bytes).map_err(fail)?;
    if bytes.len() as u64 > size && size == most {
        return Err(too_large());
    }
    bytes.truncate(size as usize);
    Ok(bytes)
}

/// Keeps an `open` from waiting for the other end of a FIFO; `follow_no_link`: it fails at a symbolic link.
fn do_not_wait(options: &mut OpenOptions, follow_no_link: bool) {
    #[cfg(target_os = "linux")]
    {
        use std::os::unix::fs::OpenOptionsExt;
        let link = if follow_no_link { libc::O_NOFOLLOW } else { 0 };
        options.custom_flags(libc::O_NONBLOCK | libc::O_NOCTTY | link);
    }
    #[cfg(not(target_os = "linux"))]
    let _ = (options, follow_no_link);
}

fn check_regular(metadata: &Metadata) -> io::Result<()> {
    if metadata.is_file() {
        return Ok(());
    }
    let what = if metadata.is_dir() { "it is a folder" } else { "it is a device, a FIFO or a socket, not a file" };
    Err(io::Error::new(ErrorKind::InvalidInput, what))
}

/// Replaces the file `path` by the data that `write` writes. If that fails, the old file is unchanged.
///
/// The new file has the permissions of the old one. A symbolic link stays and its target is replaced. A device or FIFO
/// is written to directly. Fails if another call is writing the same file at the time, and if the old file is
/// read-only.
pub fn replace(path: &Path, write: impl FnOnce(&mut Replacement) -> Result<()>) -> Result<()> {
    prepare(path, write)?.finish()
}

/// The slow part of [`replace`]: writes a file beside the old one, which stays until [`finish`](Replacement::finish).
pub fn prepare(path: &Path, write: impl FnOnce(&mut Replacement) -> Result<()>) -> Result<Replacement> {
    let mut new = Replacement::begin(path)?;
    write(&mut new)?;
    if new.beside.is_some() {
        new.file.sync_all().map_err(|e| write_error(path, e))?;
    }
    Ok(new)
}

/// Replaces a file as [`replace`] does, by `bytes`.
pub fn replace_with(path: &Path, bytes: &[u8]) -> Result<()> {
    replace(path, |file| file.append(bytes, |_| Ok(())))
}

/// A file being written, which will replace another. Dropped before that, it leaves nothing behind.
pub struct Replacement {
    file: File,
    /// Name of the file as given by the caller, for errors.
    name: PathBuf,
    target: PathBuf,
    /// Path of the file beside the target; `None`: writes directly to a device.
    beside: Option<PathBuf>,
    unsynced: usize,
}

impl Replacement {
    fn begin(path: &Path) -> Result<Replacement> {
        let fail = |e: io::Error| write_error(path, e);
        let old = match std::fs::metadata(path) {
            Ok(old) => Some(old),
            Err(e) if e.kind() == ErrorKind::NotFound => None,
            Err(e) => return Err(fail(e)),
        };
        let name = path.to_owned();
        if old.as_ref().is_some_and(|old| !old.is_file()) {
            let file = OpenOptions::new().write(true).open(path).map_err(fail)?;
            return Ok(Replacement { file, target: name.clone(), name, beside: None, unsynced: 0 });
        }
        if old.as_ref().is_some_and(|old| old.permissions().readonly()) {
            return Err(fail(io::Error::new(ErrorKind::PermissionDenied, "it is read-only")));
        }
        let target = if old.is_some() { std::fs::canonicalize(path) } else { end_of_links(path) }.map_err(fail)?;
        let [mut beside, short] = names_beside(&target);
        let file = open_beside(&beside).or_else(|e| match e.kind() {
            ErrorKind::InvalidFilename => {
                beside = short;
                open_beside(&beside)
            }
            _ => Err(e),
        });
        let file = file.map_err(fail)?;
        let new = Replacement { file, name, target, beside: Some(beside), unsynced: 0 };
        new.file.set_len(0).map_err(fail)?;
        if let Some(old) = old {
            new.file.set_permissions(old.permissions()).map_err(fail)?;
        }
        Ok(new)
    }

    /// Appends bytes; `advance` is called with their number at least every MiB, and ends the call by returning an
    /// error.
    pub fn append(&mut self, bytes: &[u8], mut advance: impl FnMut(u64) -> Result<()>) -> Result<()> {
        for part in bytes.chunks(SYNC_BYTES) {
            self.write_all(part).map_err(|e| write_error(&self.name, e))?;
            advance(part.len() as u64)?;
        }
        Ok(())
    }

    /// Replaces the old file by the new one.
    pub fn finish(mut self) -> Result<()> {
        let Some(beside) = self.beside.take() else { return Ok(()) };
        if let Err(e) = std::fs::rename(&beside, &self.target) {
            self.beside = Some(beside);
            return Err(write_error(&self.name, e));
        }
        // The new name should survive a power failure, too. If the folder cannot be flushed, nothing more can be done.
        #[cfg(unix)]
        {
            let folder = self.target.parent().filter(|f| !f.as_os_str().is_empty()).unwrap_or(Path::new("."));
            let _ = File::open(folder).and_then(|folder| folder.sync_all());
        }
        Ok(())
    }
}

impl Write for Replacement {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.file.write(&bytes[..bytes.len().min(SYNC_BYTES)])?;
        self.unsynced += written;
        if self.unsynced >= SYNC_BYTES && self.beside.is_some() {
            self.unsynced = 0;
            self.file.sync_data()?;
        }
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

impl Drop for Replacement {
    fn drop(&mut self) {
        if let Some(beside) = &self.beside {
            let _ = std::fs::remove_file(beside);
        }
    }
}

/// Names of the file beside the target: the second is for when the first is too long for the file system.
fn names_beside(target: &Path) -> [PathBuf; 2] {
    let mut long = target.as_os_str().to_owned();
    long.push(".part");
    let sum = crc32fast::hash(target.file_name().unwrap_or_default().as_encoded_bytes());
    [long.into(), target.with_file_name(format!("{sum:08x}.part"))]
}

/// Opens the file beside the target, including one left by a killed process, and locks it: of two calls that save under
/// one name, in one process or in two, the second fails.
fn open_beside(path: &Path) -> io::Result<File> {
    loop {
        let mut options = OpenOptions::new();
        options.write(true).create(true).truncate(false);
        do_not_wait(&mut options, true);
        let file = options.open(path)?;
        check_regular(&file.metadata()?)?;
        match file.try_lock() {
            Err(TryLockError::WouldBlock) => {
                return Err(io::Error::new(ErrorKind::ResourceBusy, "another call is just writing it"));
            }
            // Some network file systems have no locks.
            Ok(()) | Err(TryLockError::Error(_)) => {}
        }
        // Between the two calls above another call may have renamed the file: then it is a finished file.
        if is_still_at(&file, path)? {
            return Ok(file);
        }
    }
}

#[cfg(unix)]
fn is_still_at(file: &File, path: &Path) -> io::Result<bool> {
    use std::os::unix::fs::MetadataExt;
    let opened = file.metadata()?;
    match std::fs::symlink_metadata(path) {
        Ok(there) => Ok((there.dev(), there.ino()) == (opened.dev(), opened.ino())),
        Err(e) if e.kind() == ErrorKind::NotFound => Ok(false),
        Err(e) => Err(e),
    }
}

/// On these systems an open file cannot be renamed by others.
#[cfg(not(unix))]
fn is_still_at(_: &File, _: &Path) -> io::Result<bool> {
    Ok(true)
}

/// Follows symbolic links to a path that is none; there need not be a file.
fn end_of_links(path: &Path) -> io::Result<PathBuf> {
    let mut path = path.to_owned();
    // (As many links as Linux follows. Between two calls anybody may make a circle of them.)
    for _ in 0..40 {
        if !std::fs::symlink_metadata(&path).is_ok_and(|m| m.is_symlink()) {
            return Ok(path);
        }
        let to = std::fs::read_link(&path)?;
        path = path.parent().unwrap_or(Path::new("")).join(to);
    }
    Err(io::Error::other("too many symbolic links"))
}

fn write_error(path: &Path, e: io::Error) -> Error {
    Error::Io(format!("cannot write {}: {e}", path.display()))
}

/// A folder of one test, removed at its end.
#[cfg(test)]
pub(crate) struct Folder(pub PathBuf);

#[cfg(test)]
impl Folder {
    pub fn new(name: &str) -> Folder {
        let path = std::env::temp_dir().join(format!("bakelite-files-{}-{name}", std::process::id()));
        std::fs::create_dir_all(&path).unwrap();
        Folder(path)
    }

    pub fn names(&self) -> Vec<String> {
        let mut names: Vec<_> = std::fs::read_dir(&self.0)
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        names
    }
}

#[cfg(test)]
impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_replaced_as_a_whole_and_nothing_is_left_beside() {
        let folder = Folder::new("whole");
        let path = folder.0.join("a");
        for content in [&b"first"[..], b"", &vec![7; SYNC_BYTES * 2 + 5]] {
            replace_with(&path, content).unwrap();
            assert_eq!((std::fs::read(&path).unwrap() == content, folder.names()), (true, vec!["a".into()]));
        }
    }

    #[test]
    fn a_failure_half_way_leaves_the_old_file_and_nothing_beside() {
        let folder = Folder::new("failure");
        let path = folder.0.join("a");
        replace_with(&path, b"old").unwrap();
        let e = replace(&path, |file| file.append(&vec![1; SYNC_BYTES * 3], |_| Err(Error::Cancelled))).unwrap_err();
        assert_eq!(e, Error::Cancelled);
        assert_eq!((std::fs::read(&path).unwrap(), folder.names()), (b"old".to_vec(), vec!["a".into()]));
        let e = replace(&folder.0.join("no/b"), |_| Ok(())).unwrap_err().to_string();
        assert!(e.contains("no/b"), "{e}");
        assert!(replace_with(&folder.0, b"x").unwrap_err().to_string().contains("failure"));
    }

    #[test]
    fn what_a_killed_process_left_is_written_over() {
        let folder = Folder::new("stale");
        let path = folder.0.join("a");
        std::fs::write(folder.0.join("a.part"), "much longer than the new content").unwrap();
        replace_with(&path, b"new").unwrap();
        assert_eq!((std::fs::read(&path).unwrap(), folder.names()), (b"new".to_vec(), vec!["a".into()]));
    }

    #[test]
    fn names_may_be_as_long_as_the_file_system_allows() {
        let folder = Folder::new("long");
        for length in [250, 251, 255] {
            let name = "n".repeat(length);
            let path = folder.0.join(&name);
            replace_with(&path, b"old").unwrap();
            replace(&path, |file| {
                let e = replace_with(&path, b"second").unwrap_err().to_string();
                assert!(e.contains("another call"), "{e}");
                file.append(b"new", |_| Ok(()))
            })
            .unwrap();
            assert_eq!((std::fs::read(&path).unwrap(), folder.names()), (b"new".to_vec(), vec![name]));
            std::fs::remove_file(&path).unwrap();
        }
        assert!(matches!(replace_with(&folder.0.join("n".repeat(256)), b"x"), Err(Error::Io(_))));
        assert!(folder.names().is_empty());
    }

    #[test]
    fn two_calls_for_one_file_do_not_mix() {
        let folder = Folder::new("two");
        let path = folder.0.join("a");
        replace(&path, |first| {
            let e = replace_with(&path, b"second").unwrap_err().to_string();
            assert!(e.contains("another call"), "{e}");
            first.append(b"first", |_| Ok(()))
        })
        .unwrap();
        assert_eq!((std::fs::read(&path).unwrap(), folder.names()), (b"first".to_vec(), vec!["a".into()]));
        std::thread::scope(|s| {
            for c in 0..8u8 {
                let path = &path;
                s.spawn(move || (0..20).for_each(|_| drop(replace_with(path, &[c; 10_000]))));
            }
        });
        let content = std::fs::read(&path).unwrap();
        assert!(content.len() == 10_000 && content.iter().all(|c| *c == content[0]));
        assert_eq!(folder.names(), ["a"]);
    }

    #[cfg(unix)]
    #[test]
    fn permissions_and_links_stay_and_devices_are_written_to() {
        use std::os::unix::fs::{PermissionsExt, symlink};
        let folder = Folder::new("links");
        let (path, link) = (folder.0.join("a"), folder.0.join("link"));
        std::fs::write(&path, "old").unwrap();
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o640)).unwrap();
        symlink("a", &link).unwrap();
        replace_with(&link, b"new").unwrap();
        assert!(std::fs::symlink_metadata(&link).unwrap().is_symlink());
        assert_eq!(std::fs::read(&path).unwrap(), b"new");
        assert_eq!(std::fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o640);
        std::fs::remove_file(&path).unwrap();
        replace_with(&link, b"newer").unwrap();
        assert!(std::fs::symlink_metadata(&link).unwrap().is_symlink());
        assert_eq!(std::fs::read(&path).unwrap(), b"newer");
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o440)).unwrap();
        assert!(replace_with(&path, b"x").unwrap_err().to_string().contains("read-only"));
        replace_with(Path::new("/dev/null"), b"x").unwrap();
        assert_eq!(folder.names(), ["a", "link"]);
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn a_full_disk_is_an_error() {
        let e = replace_with(Path::new("/dev/full"), b"x").unwrap_err().to_string();
        assert!(e.contains("/dev/full"), "{e}");
    }

    #[test]
    fn only_regular_files_are_read_and_only_up_to_the_limit() {
        let folder = Folder::new("read");
        let path = folder.0.join("a");
        std::fs::write(&path, "content").unwrap();
        assert_eq!(read(&path, 7).unwrap(), b"content");
        assert!(matches!(read(&path, 6), Err(Error::OutOfMemory(e)) if e.contains("more than 6 bytes")));
        assert!(matches!(read(&folder.0, 100), Err(Error::Io(e)) if e.contains("folder")));
        #[cfg(target_os = "linux")]
        {
            let fifo = folder.0.join("fifo");
            let name = std::ffi::CString::new(fifo.to_str().unwrap()).unwrap();
            // SAFETY: a NUL-terminated path that lives through the call.
            assert_eq!(unsafe { libc::mkfifo(name.as_ptr(), 0o600) }, 0);
            let _socket = std::os::unix::net::UnixListener::bind(folder.0.join("socket")).unwrap();
            for bad in [Path::new("/dev/zero"), Path::new("/dev/null"), &fifo, &folder.0.join("socket")] {
                assert!(matches!(read(bad, 100), Err(Error::Io(_))), "{}", bad.display());
            }
        }
    }
}
