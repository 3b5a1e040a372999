//! Scenes made by code, for tests, examples and first steps, and the shapes that they are made of.

mod atrium;
pub(super) mod builtin;
mod rooms;
pub mod shapes;
