//! Curves and bars as SVG, and letters for pictures.

pub mod bars;
pub mod curves;
pub mod font;
mod svg;
