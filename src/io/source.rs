//! The files that a scene consists of: which of them may be opened, how much of them may be read, and reading that
//! counts progress and can be cancelled.
//!
//! A scene file may come from anywhere, so it may name only files that its author could have put beside it.
//! So names are resolved against the folder of the file that names them, and must stay below one base folder: neither
//! `..` nor an absolute path nor a symbolic link leads out of it. Only regular files are read.

use super::LoadOptions;
use super::account::Account;
use crate::base::error::{Error, Result};
use crate::base::files;
use std::fs::File;
use std::io::{self, BufRead, BufReader, Read, Seek, SeekFrom};
use std::path::{Component, Path, PathBuf};

/// Bytes read between two looks for a cancel: 1 to 5 ms of work for the slowest reader.
const CHUNK: usize = 128 << 10;

/// Counts bytes as read, makes progress reports when they are due, and fails with `Cancelled` once the caller has
/// asked to stop.
pub(super) type Advance<'a> = &'a dyn Fn(u64) -> Result<()>;

/// Either the thing asked for, or a sentence that says why the scene is loaded without it. The outer error ends the
/// load.
pub(super) type Attempt<T> = Result<std::result::Result<T, String>>;

/// Opens files for one scene.
pub(super) struct Files {
    /// Folder that named files must lie in, without symbolic links; `None`: anywhere.
    base: Option<PathBuf>,
    /// Bytes that may still be read.
    bytes_left: u64,
    most_bytes: u64,
}

/// A file that was opened, and its size in bytes.
pub(super) struct Opened {
    pub file: File,
    pub size: u64,
    pub path: PathBuf,
}

impl Files {
    /// The source of files for the scene file `scene`.
    pub fn new(scene: &Path, options: &LoadOptions) -> Result<Files> {
        let base = match &options.base_folder {
            _ if options.any_folder => None,
            Some(base) => Some(real(base).map_err(|e| {
                Error::InvalidArgument(format!("base_folder is {}, which cannot be opened: {e}", base.display()))
            })?),
            // A scene whose folder is not there cannot be opened itself.
            None => Some(real(folder_of(scene)).unwrap_or_else(|_| folder_of(scene).to_owned())),
        };
        Ok(Files { base, bytes_left: options.max_file_bytes, most_bytes: options.max_file_bytes })
    }

    /// Opens the scene file itself, which the caller has chosen: it may lie anywhere.
    pub fn open_scene(&mut self, path: &Path) -> Result<Opened> {
        let fail = |e: io::Error| Error::Io(format!("{}: {e}", path.display()));
        let file = files::open(path).map_err(fail)?;
        let size = file.metadata().map_err(fail)?.len();
        self.count(size, path)?;
        Ok(Opened { file, size, path: path.to_owned() })
    }

    /// Opens the file that another one in `folder` calls `name`.
    pub fn open(&mut self, folder: &Path, name: &str) -> Attempt<Opened> {
        let opened = self.resolve(folder, name).and_then(|path| {
            let fail = |e: io::Error| format!("{}: {e}", folder.join(name).display());
            let file = files::open(&path).map_err(fail)?;
            // What had the name before may have been replaced by a link since.
            if self.base.is_some() && real(&path).map_err(fail)? != path {
                return Err(format!("{name:?} was just replaced"));
            }
            let size = file.metadata().map_err(fail)?.len();
            Ok(Opened { file, size, path })
        });
        match opened {
            Ok(opened) => {
                self.count(opened.size, &opened.path)?;
                Ok(Ok(opened))
            }
            Err(what) => Ok(Err(what)),
        }
    }

    fn count(&mut self, size: u64, path: &Path) -> Result<()> {
        match self.bytes_left.checked_sub(size) {
            Some(left) => {
                self.bytes_left = left;
                Ok(())
            }
            None => Err(Error::OutOfMemory(format!(
                "{} has {size} bytes, with which the scene's files exceed the {} of max_file_bytes",
                path.display(),
                self.most_bytes
            ))),
        }
    }

    /// The path without symbolic links of a file that another one in `folder` calls `name`.
    fn resolve(&self, folder: &Path, name: &str) -> std::result::Result<PathBuf, String> {
        if name.is_empty() || name.contains('\0') {
            return Err(format!("{name:?} is no file name"));
        }
        let scheme = name.split_once(':').map(|(scheme, _)| scheme);
        if scheme.is_some_and(|s| s.len() > 1 && s.chars().all(|c| c.is_ascii_alphanumeric() || "+-.".contains(c))) {
            return Err(format!("{name:?} is a URI, not the name of a file"));
        }
        let outside = |base: &Path| {
            format!(
                "{name:?} is not below {}; whoever trusts the scene can allow other folders or name a base folder",
                base.display()
            )
        };
        let fail = |e: io::Error| format!("{}: {e}", folder.join(name).display());
        let Some(base) = &self.base else { return real(&folder.join(name)).map_err(fail) };
        // First by the name alone: nobody learns from errors what there is elsewhere.
        let folder = real(folder).map_err(fail)?;
        let drive = scheme.is_some_and(|s| s.len() == 1 && s.chars().all(|c| c.is_ascii_alphabetic()));
        if drive || !normalized(&folder.join(name)).starts_with(base) {
            return Err(outside(base));
        }
        let path = real(&folder.join(name)).map_err(fail)?;
        if path.starts_with(base) { Ok(path) } else { Err(outside(base)) }
    }
}

/// The library's own error, if a reader's error wraps one; else the error that the file cannot be read.
pub(super) fn read_error(e: io::Error, name: impl std::fmt::Display) -> Error {
    match e.downcast::<Error>() {
        Ok(own) => own,
        Err(e) => Error::Io(format!("{name}: {e}")),
    }
}

/// The folder that a file lies in.
pub(super) fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

fn real(path: &Path) -> io::Result<PathBuf> {
    std::fs::canonicalize(path)
}

/// `.` and `..` resolved by the text alone.
fn normalized(path: &Path) -> PathBuf {
    let mut result = PathBuf::new();
    for part in path.components() {
        match part {
            Component::ParentDir => _ = result.pop(),
            Component::CurDir => {}
            part => result.push(part),
        }
    }
    result
}

/// Reads an opened file, counts what was read, and fails once the caller has asked to stop. No more is read than the
/// file had when it was opened.
pub(super) struct Source<'a> {
    reader: BufReader<io::Take<File>>,
    advance: Advance<'a>,
    uncounted: usize,
    /// Bytes that may still be read.
    limit: Option<usize>,
}

impl<'a> Source<'a> {
    pub fn new(opened: Opened, advance: Advance<'a>) -> Self {
        let reader = BufReader::with_capacity(CHUNK, opened.file.take(opened.size));
        Source { reader, advance, uncounted: 0, limit: None }
    }

    /// Makes reading fail after so many bytes.
    pub fn limit(&mut self, bytes: Option<usize>) {
        self.limit = bytes;
    }

    /// Appends the next line, with its end if it has one, and returns its length; 0 at the end of the file.
    pub fn read_line(&mut self, line: &mut Vec<u8>, account: &mut Account) -> io::Result<usize> {
        let mut length = 0;
        loop {
            let available = self.fill_buf()?;
            let end = available.iter().position(|c| *c == b'\n');
            let part = &available[..end.map_or(available.len(), |end| end + 1)];
            account.make_room(line, part.len(), "a line").map_err(io::Error::other)?;
            line.extend_from_slice(part);
            let count = part.len();
            self.consume(count);
            length += count;
            if end.is_some() || count == 0 {
                return Ok(length);
            }
        }
    }
}

/// [`Read::read`] of a reader that has a buffer.
fn read_buffered(from: &mut impl BufRead, buffer: &mut [u8]) -> io::Result<usize> {
    let available = from.fill_buf()?;
    let count = available.len().min(buffer.len());
    buffer[..count].copy_from_slice(&available[..count]);
    from.consume(count);
    Ok(count)
}

/// The place that [`Seek::seek`] goes to from `at` in `length` bytes; it may lie behind them.
pub(super) fn place(to: SeekFrom, at: usize, length: usize) -> io::Result<usize> {
    let place = match to {
        SeekFrom::Start(place) => i64::try_from(place).ok(),
        SeekFrom::End(by) => (length as i64).checked_add(by),
        SeekFrom::Current(by) => (at as i64).checked_add(by),
    };
    let place = place.and_then(|place| usize::try_from(place).ok());
    place.ok_or_else(|| io::Error::new(io::ErrorKind::InvalidInput, "a place before the beginning"))
}

impl Read for Source<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        read_buffered(self, buffer)
    }
}

impl BufRead for Source<'_> {
    fn fill_buf(&mut self) -> io::Result<&[u8]> {
        if self.reader.buffer().is_empty() {
            (self.advance)(std::mem::take(&mut self.uncounted) as u64).map_err(io::Error::other)?;
        }
        if self.limit == Some(0) {
            return Err(io::Error::other("the header is too long"));
        }
        self.reader.fill_buf()
    }

    fn consume(&mut self, count: usize) {
        self.uncounted += count;
        self.limit = self.limit.map(|left| left.saturating_sub(count));
        self.reader.consume(count);
    }
}

/// Bytes in memory for a decoder, in small pieces: it fails once the caller has asked to stop.
pub(super) struct Checked<'b> {
    bytes: &'b [u8],
    at: usize,
    advance: Advance<'b>,
}

impl<'b> Checked<'b> {
    /// An image of a thousand times the size comes out of a piece in a few milliseconds.
    const PIECE: usize = 4096;

    pub fn new(bytes: &'b [u8], advance: Advance<'b>) -> Self {
        Checked { bytes, at: 0, advance }
    }
}

impl Read for Checked<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        read_buffered(self, buffer)
    }
}

impl BufRead for Checked<'_> {
    fn fill_buf(&mut self) -> io::Result<&[u8]> {
        (self.advance)(0).map_err(io::Error::other)?;
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        Ok(&rest[..rest.len().min(Self::PIECE)])
    }

    fn consume(&mut self, count: usize) {
        self.at += count;
    }
}

impl Seek for Checked<'_> {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.at = place(to, self.at, self.bytes.len())?;
        Ok(self.at as u64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::tests::Folder;

    fn open(options: &LoadOptions, folder: &Path, name: &str) -> std::result::Result<Opened, String> {
        Files::new(&folder.join("scene.obj"), options).unwrap().open(folder, name).unwrap()
    }

    #[cfg(unix)]
    #[test]
    fn names_lead_to_files_beside_and_below_and_nowhere_else() {
        use std::os::unix::fs::symlink;
        let all = Folder::new();
        let folder = all.path("scene");
        std::fs::create_dir_all(folder.join("below")).unwrap();
        for name in ["scene/a b.png", "scene/below/b.png", "out.png"] {
            std::fs::write(all.path(name), name).unwrap();
        }
        symlink("below/b.png", folder.join("link inside")).unwrap();
        symlink("../out.png", folder.join("link outside")).unwrap();
        symlink("..", folder.join("below/up")).unwrap();
        symlink("../..", folder.join("below/far up")).unwrap();
        let out = all.path("out.png");
        let absolute = out.to_str().unwrap();
        let uri = format!("file://{absolute}");
        let allowed = ["a b.png", "below/b.png", "./below/../a b.png", "link inside", "below/up/a b.png"];
        let refused = ["../out.png", "below/../../out.png", absolute, "link outside", "below/far up/out.png"];
        let default = LoadOptions::default();
        for name in allowed {
            assert!(open(&default, &folder, name).is_ok(), "{name}");
        }
        for name in refused {
            let what = open(&default, &folder, name).err().unwrap_or_else(|| panic!("{name} was opened"));
            assert!(what.contains("is not below"), "{what}");
        }
        for name in ["", "a\0b", "no.png", "below", &uri, "http://x/y.png", "C:\\out.png", "c:/out.png"] {
            assert!(open(&default, &folder, name).is_err(), "{name:?}");
        }
        // What is elsewhere cannot be asked for: the same answer, whether it is there or not.
        let answer = |name: &str| open(&default, &folder, name).err().unwrap().replace(name, "");
        assert_eq!(answer("../out.png"), answer("../none.png"));

        let base = LoadOptions { base_folder: Some(all.path("")), ..Default::default() };
        let any = LoadOptions { any_folder: true, ..Default::default() };
        for name in refused.into_iter().chain(allowed) {
            assert!(open(&base, &folder, name).is_ok() && open(&any, &folder, name).is_ok(), "{name}");
        }
        assert!(open(&base, &folder, "/etc/passwd").is_err() && open(&any, &folder, "/dev/zero").is_err());
    }

    #[test]
    fn the_sizes_of_all_files_add_up_to_the_limit() {
        let folder = Folder::new();
        std::fs::write(folder.path("a"), [0; 600]).unwrap();
        let options = LoadOptions { max_file_bytes: 1000, ..Default::default() };
        let mut files = Files::new(&folder.path("a"), &options).unwrap();
        files.open_scene(&folder.path("a")).unwrap();
        let Err(Error::OutOfMemory(e)) = files.open(&folder.path(""), "a") else { panic!("opened") };
        assert!(e.contains("max_file_bytes") && e.contains("600 bytes"), "{e}");
    }
}
