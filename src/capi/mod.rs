//! The C ABI behind `include/bakelite.h`: handles, checks, errors and callbacks, and no algorithms.
//!
//! One file per section of the header, in its order: [`error`], [`device`], [`scene`], [`files`], [`textures`], [`meshes`],
//! [`instances`], [`lights`], [`rays`], [`photons`], [`lightmap`], [`bake`], [`read`], [`live`]. cbindgen makes the
//! header from exactly these files (`capi-tests/header/lib.rs`); their `//!` heads become the sections'
//! heads and every public item's documentation becomes the manual, so both are written for the C
//! reader. `handles`, `shared` and `args` hold what the sections
//! share.
//!
//! # Safety
//!
//! Every entry point believes what C cannot prove: that a handle that is not NULL is one that has
//! been created and not yet released, and that a pointer is valid for the size which its
//! documentation states. Everything else (NULL, sizes, strides, alignment, overlap, flags, state,
//! concurrent use) is checked, and a panic ends at the boundary.

// The items are named as C names them. Their safety contract is stated once, above.
#![allow(non_camel_case_types, clippy::missing_safety_doc)]

mod args;
mod handles;
mod shared;

pub mod bake;
pub mod device;
pub mod error;
pub mod files;
pub mod instances;
pub mod lightmap;
pub mod lights;
pub mod live;
pub mod meshes;
pub mod photons;
pub mod rays;
pub mod read;
pub mod scene;
pub mod textures;
