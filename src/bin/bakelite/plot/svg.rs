//! Colours and texts of plots.

use std::fmt::Write;

/// Told apart by the colour-blind too (Okabe and Ito 2008).
pub const COLORS: [&str; 6] = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#000000"];

/// Adds a text; `more`: further attributes.
pub fn text(out: &mut String, [x, y]: [f64; 2], anchor: &str, more: &str, text: &str) {
    let escaped = text.replace('&', "&amp;").replace('<', "&lt;");
    let _ = writeln!(out, "<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\" {more}>{escaped}</text>");
}
