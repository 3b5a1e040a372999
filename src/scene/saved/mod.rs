//! Committed scenes on disk: the caller's description and the trees, laid out so that a file can be mapped to memory and
//! used as it is. (docs/scene_file.md has the format for other programs.)
//!
//! | file | what it does |
//! |---|---|
//! | `format` | head, table, and the records of sections |
//! | `write` | saving |
//! | `read` | opening: mapping, checksums, and checks of all that others rely on |

mod format;
mod read;
mod write;

pub use read::OpenOptions;

#[cfg(test)]
mod tests;
