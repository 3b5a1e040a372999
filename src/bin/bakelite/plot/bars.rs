//! Bars of one quantity, one below the other, as SVG.

use super::svg::{COLORS, text};
use std::fmt::Write;

/// A bar. It begins at 0.
pub struct Bar<'a> {
    pub name: &'a str,
    /// Finite and at least 0.
    pub value: f64,
    /// Behind the bar.
    pub note: String,
    /// In another colour.
    pub apart: bool,
}

const WIDTH: f64 = 720.0;
/// Left (for the names), right (for the notes), top, bottom.
const MARGIN: [f64; 4] = [160.0, 190.0, 40.0, 52.0];
/// From one bar to the next, and the part of it that the bar fills.
const PITCH: f64 = 28.0;
const THICKNESS: f64 = 18.0;

/// The chart as an SVG document.
pub fn svg(title: &str, x_label: &str, bars: &[Bar]) -> String {
    let [left, right, top, bottom] = MARGIN;
    let (end, base) = (WIDTH - right, top + PITCH * bars.len() as f64);
    let height = base + bottom;
    let step = step(bars.iter().map(|b| b.value).fold(0.0, f64::max));
    let most = bars.iter().map(|b| (b.value / step).ceil()).fold(1.0, f64::max) * step;
    let x = |value: f64| left + value / most * (end - left);
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {height}\" font-family=\"sans-serif\" \
         font-size=\"12\">\n<rect width=\"{WIDTH}\" height=\"{height}\" fill=\"white\"/>\n"
    );
    let middle = (left + end) / 2.0;
    text(&mut out, [middle, 24.0], "middle", "font-size=\"15\"", title);
    text(&mut out, [middle, height - 14.0], "middle", "", x_label);
    for i in 0..=(most / step).round() as u32 {
        let value = i as f64 * step;
        let _ = writeln!(
            out,
            "<line x1=\"{0:.1}\" y1=\"{top}\" x2=\"{0:.1}\" y2=\"{base}\" stroke=\"#b0b0b0\" stroke-width=\"1\"/>",
            x(value)
        );
        // (Rounded, for 3 times 0.1.)
        let tick = (value * 1e6).round() / 1e6;
        text(&mut out, [x(value), base + 18.0], "middle", "", &tick.to_string());
    }
    for (i, bar) in bars.iter().enumerate() {
        let y = top + PITCH * i as f64 + (PITCH - THICKNESS) / 2.0;
        let (width, color) = (x(bar.value) - left, COLORS[bar.apart as usize]);
        let _ = writeln!(
            out,
            "<rect x=\"{left}\" y=\"{y:.1}\" width=\"{width:.1}\" height=\"{THICKNESS}\" fill=\"{color}\"/>"
        );
        text(&mut out, [left - 8.0, y + THICKNESS - 5.0], "end", "", bar.name);
        text(&mut out, [left + width + 6.0, y + THICKNESS - 5.0], "start", "", &bar.note);
    }
    out.push_str("</svg>\n");
    out
}

/// Between ticks: 1, 2 or 5 times a power of ten, so that there are three to eight up to `most`.
fn step(most: f64) -> f64 {
    if !(most > 0.0) {
        return 1.0;
    }
    let decade = 10f64.powf((most / 4.0).log10().floor());
    [1.0, 2.0, 5.0].map(|n| n * decade).into_iter().rfind(|s| most / s >= 3.0).unwrap_or(decade)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_few_and_round() {
        for (most, expected) in [(1.0, 0.2), (3.3, 0.5), (0.07, 0.02), (900.0, 200.0), (0.0, 1.0), (8.0, 2.0)] {
            assert!((step(most) / expected - 1.0).abs() < 1e-9, "{most}: {}", step(most));
        }
    }

    #[test]
    fn bars_are_as_long_as_their_values() {
        let bar = |name, value| Bar { name, value, note: String::new(), apart: false };
        let svg = svg("t & u", "x", &[bar("a < b", 1.0), bar("c", 0.5), bar("d", 0.0)]);
        // 370 wide, up to a tick at 1.
        for width in ["370.0", "185.0", "0.0"] {
            assert_eq!(svg.matches(&format!("width=\"{width}\"")).count(), 1, "{svg}");
        }
        assert!(svg.contains("a &lt; b") && svg.contains("t &amp; u") && !svg.contains("NaN"));
    }
}
