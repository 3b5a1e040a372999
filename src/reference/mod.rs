//! Independent f64 oracles: what the kernels and the bake are measured against.
//!
//! Nothing here is shared with the kernels, the builder, the photon map or the samplers: the same
//! mistake must not be made twice. Simple beats fast, within what a report can wait for.
//!
//! - [`Geometry`]: closest hit and occlusion in f64, by brute force and through a plain BVH.
//! - [`Agreement`]: whether two answers to a ray differ for a reason or because one is wrong.
//! - [`PathTracer`]: irradiance at points with its standard error, and images.

mod geometry;
mod lights;
mod oracle;
mod path;
mod proposal;
mod random;
mod sky;
mod surfaces;

pub use geometry::{Geometry, Hit64, Ray64};
pub use oracle::{Agreement, Candidate, Verdict};
pub use path::{Irradiance, PathTracer, SurfacePoint};
pub use random::Random;
