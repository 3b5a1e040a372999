//! What the fuzz targets share. Its files are also those of `capi-tests/rust/damaged_files.rs`, a short run with the
//! stable toolchain.

pub mod damaged_files;
pub mod live_state;
pub mod records;
pub mod room;
pub mod saved;
pub mod scene_file;
pub mod seeds;
pub mod shares;
