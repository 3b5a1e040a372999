//! Bakelite: SIMD light-baking kernels.
//!
//! Bakelite precomputes global illumination for large static scenes. It is used from C and C++
//! through `include/bakelite.h`, or from Rust through this crate. The pipeline follows Schouls,
//! *Fast Preprocessed Global Illumination for Massive Scenes with Live Updates* (2017).
//!
//! Start with a [`Device`], describe a scene as [`SceneData`], [commit](Scene::commit) it, query it or create a
//! [`Lightmap`](lightmap::Lightmap) and [bake](lightmap::Lightmap::bake) it.
//!
//! Light flows through the modules in one direction; each uses only those above it:
//!
//! | module | contents |
//! |---|---|
//! | [`error`], [`progress`], [`memory`] | errors, progress and cancellation, memory accounting |
//! | [`files`] | reading of regular files only, replacement of files as a whole |
//! | [`sampling`] | counter-based low-discrepancy samples and the maps from the square |
//! | `simd` | lanes over `wide` and over `core::arch`, ISA detection, entry points |
//! | [`device`] | thread pool, instruction set, log |
//! | [`bvh`] | binned SAH builder, collapse to the 8-wide MBVH, full and compact layouts, refits |
//! | [`scene`] | meshes, materials, lights, textures; validation, commit, built-in scenes |
//! | [`trace`] | ray kernels: single rays, ray packets, ray streams, occlusion; all queries of a scene |
//! | [`photon`] | emission, photon tracing, uniform grid, irradiance estimate |
//! | [`direct`] | direct light by shadow rays: point, spot and area lights, sun and sky, many lights |
//! | [`lightmap`] | charts, texels, radiance map, gather map, bake, results on disk |
//! | [`live`] | live updates of a light map's light |
//! | `reference` | f64 path tracer and brute-force oracles (feature `reference`) |
//! | `io` | readers of scene files, writers of images and scenes (feature `io`) |
//! | [`capi`] | the C ABI |
//!
//! # Units and conventions
//!
//! Right-handed coordinates, any up axis, counter-clockwise front faces, linear RGB. Point and
//! spot lights are given by radiant intensity (W/sr), directional lights by irradiance on a
//! perpendicular plane (W/m²), area lights, skies and emissive materials by radiance (W/(m²·sr)). Light
//! maps hold irradiance E (W/m²): a shader shows albedo/π · E. All surfaces are diffuse.

#![deny(missing_docs, rustdoc::broken_intra_doc_links, rustdoc::private_intra_doc_links)]

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

pub use base::array::Array;
pub use base::{error, files, memory, progress, sampling};
pub use device::{Device, DeviceOptions};
pub use error::{Error, Result};
pub use progress::Progress;
pub use scene::{Light, Material, Mesh, Scene, SceneData};
pub use simd::Isa;
