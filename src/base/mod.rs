//! Common basis of all modules: errors, progress, memory accounts, files, samples, geometry, and the state of threads
//! that call or are called.

pub mod array;
pub(crate) mod bounds;
pub(crate) mod callback;
pub(crate) mod directional;
pub mod error;
pub mod files;
pub(crate) mod float_state;
pub(crate) mod functions;
pub(crate) mod gate;
pub mod geometry;
pub mod memory;
pub(crate) mod parallel;
pub mod progress;
pub mod sampling;
pub(crate) mod scratch;
pub(crate) mod scratch_files;
pub(crate) mod share;
pub(crate) mod sort;
pub(crate) mod threads;
pub(crate) mod watched_file;
