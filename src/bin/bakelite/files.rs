//! Folders and texts.

use bakelite::{Error, Result};
use std::path::Path;

/// Makes the folder that all files go to.
pub fn make_folder(folder: &Path) -> Result<()> {
    std::fs::create_dir_all(folder).map_err(|e| Error::Io(format!("{}: {e}", folder.display())))
}

/// Writes a text file.
pub fn write_text(path: &Path, text: &str) -> Result<()> {
    bakelite::files::replace_with(path, text.as_bytes())
}
