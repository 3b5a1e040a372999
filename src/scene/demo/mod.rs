//! Scenes made by code, for tests, examples and first steps, and the shapes that they are made of.

mod atrium;
pub(super) mod builtin;
mod colonnade;
mod hall;
mod lattice;
mod menger;
mod rooms;
pub mod shapes;
