//! The ray kernels, the table of them per ISA, and the queries of scenes that use them.
//!
//! A closest hit is the one with the least t in `tmin < t ≤ tmax`; among exactly equal t the
//! triangle with the lowest global number wins, on every path, so that single rays, packets and
//! every ISA agree on coincident triangles.

pub mod baseline;
mod beams;
mod box_lists;
mod bundle;
mod bundle_boxes;
mod compact;
pub(crate) mod filter;
#[cfg(any(test, feature = "reference"))]
pub mod four_wide;
mod gather;
mod groups;
mod instances;
mod kernels;
pub mod offset;
mod packet;
mod packs;
mod pass_through;
mod queries;
mod ray;
mod ray_keys;
mod single;
mod stream;
mod stream_rays;
mod tree;
mod triangle;
mod two_levels;
mod waiting;
mod whole;

pub(crate) use kernels::Kernels;
pub use ray::{Hit, PACKET_SIZE, Packet, RawHit, Ray};

#[cfg(test)]
mod instance_tests;
#[cfg(test)]
mod stream_tests;
#[cfg(test)]
mod tests;
