//! Files that are mapped and must not be changed meanwhile: what tells whether somebody has.

use super::error::{Error, Result};
use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// A file with its length and time of change as they were when it was opened.
pub(crate) struct WatchedFile {
    file: File,
    path: PathBuf,
    was: (u64, SystemTime),
}

impl WatchedFile {
    pub fn new(file: File, path: &Path) -> io::Result<WatchedFile> {
        let was = state(&file)?;
        Ok(WatchedFile { file, path: path.to_owned(), was })
    }

    /// Fails if the file has been written to or cut short. (Another file that was saved under its name is another file.)
    ///
    /// What was read from the mapping before a call that succeeds is right: a system sets the time of a file before its
    /// bytes. Disks that forget are not noticed.
    pub fn check(&self) -> Result<()> {
        match state(&self.file) {
            Ok(is) if is == self.was => Ok(()),
            Ok(_) => Err(Error::Io(format!("{} was changed while it was in use: open it again", self.path.display()))),
            Err(e) => Err(Error::Io(format!("cannot read {}: {e}", self.path.display()))),
        }
    }
}

fn state(file: &File) -> io::Result<(u64, SystemTime)> {
    let metadata = file.metadata()?;
    Ok((metadata.len(), metadata.modified()?))
}
