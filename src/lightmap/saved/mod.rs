//! Baked light on disk: results, which can be loaded into a light map and may be parts of a bake that several machines
//! share, the photons and radiance that all parts of it need, and checkpoints, from which a bake continues after its process has ended. And layouts, from which a light map
//! is made without unwrapping anew.
//!
//! | file | what it does |
//! |---|---|
//! | `records` | the container: tagged records, each with checksums |
//! | `fingerprint` | what a file must agree with: scene, lights, layout, parameters |
//! | `layout` | charts and texels of a light map |
//! | `result` | saving and loading the light of a light map |
//! | `share` | photons and the radiance map, of which each of several machines computes a part |
//! | `checkpoint` | the progress of a bake: written as it goes on, read when it starts again |

pub(crate) mod checkpoint;
pub(crate) mod fingerprint;
mod layout;
mod records;
mod result;
pub(crate) mod share;

pub use checkpoint::CheckpointParams;

use crate::base::error::Error;
use std::io;
use std::path::Path;

/// Makes the error for a file with impossible content.
fn damaged(path: &Path) -> Error {
    Error::Io(format!("{} is damaged: a checksum or a length in it does not fit", path.display()))
}

/// Makes the error for a failed read.
fn unreadable(path: &Path, e: io::Error) -> Error {
    let message = format!("cannot read {}: {e}", path.display());
    if e.kind() == io::ErrorKind::OutOfMemory { Error::OutOfMemory(message) } else { Error::Io(message) }
}

/// Makes the error for a file of another bake.
fn foreign(path: &Path, differences: &str) -> Error {
    Error::InvalidArgument(format!("{} is of another bake; it differs in {differences}", path.display()))
}

/// Makes the error for a file of another kind.
fn another_kind(path: &Path, kind: &str) -> Error {
    Error::Io(format!("{} is no {kind} of this version of the library", path.display()))
}

#[cfg(test)]
mod tests;
