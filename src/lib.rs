//! Bakelite: SIMD light-baking kernels.
//!
//! Bakelite precomputes global illumination for large static scenes. It is used from C and C++
//! through `include/bakelite.h`, or from Rust through this crate. The pipeline follows Schouls,
//! *Fast Preprocessed Global Illumination for Massive Scenes with Live Updates* (2017).
//!
//! Light flows through the modules in one direction; each uses only those above it:
//!
//! | module | what is in it |
//! |---|---|
//! | [`error`], [`progress`], [`memory`], [`device`] | manners: errors, cancelling, memory accounts, threads and ISA |
//! | [`files`] | files that are read only if regular, and replaced as a whole |
//! | [`sampling`] | counter-based low-discrepancy samples and the maps from the square |
//! | `simd` | lanes over `wide` and over `core::arch`; ISA detection |
//! | [`scene`] | meshes, materials, lights; validation; the built-in scenes; commit |
//! | [`bvh`] | binned SAH builder, collapse to the 8-wide MBVH, whole or compact |
//! | [`trace`] | the ray kernels: single rays, shared-origin gather, occlusion |
//! | [`photon`] | emission, photon tracing, uniform grid, radiance estimate |
//! | [`lightmap`] | charts, texels, radiance map, gather map, direct light, composition |
//! | `reference` | f64 path tracer and brute-force oracles (feature `reference`) |
//! | `io` | scene files in, images and scenes out (feature `io`) |
//! | [`capi`] | the C ABI |
//!
//! # Units and conventions
//!
//! Right-handed coordinates, any up axis, counter-clockwise front faces, linear RGB. Point and
//! spot lights are given by radiant intensity (W/sr), directional lights by irradiance on a
//! perpendicular plane (W/m²), area lights, skies and emissive materials by radiance (W/(m²·sr)). Light
//! maps hold irradiance E (W/m²): a shader shows albedo/π · E. All surfaces are diffuse.

pub(crate) mod base;
pub mod bvh;
pub mod capi;
pub mod device;
pub mod direct;
#[cfg(feature = "io")]
pub mod io;
pub mod lightmap;
pub mod live;
pub mod photon;
#[cfg(feature = "reference")]
pub mod reference;
pub mod scene;
pub(crate) mod simd;
pub mod trace;

pub(crate) use base::{callback, float_state};
pub use base::{error, files, memory, progress, sampling};
pub use device::{Device, DeviceOptions};
pub use error::{Error, Result};
pub use progress::Progress;
pub use scene::{Light, Material, Mesh, Scene, SceneData};
pub use simd::Isa;
