//! Curves in log-log axes, as SVG.

use super::svg::{COLORS, text};
use std::fmt::Write;
use std::ops::Range;

/// A curve: its points are marked and joined.
pub struct Series<'a> {
    pub name: &'a str,
    /// Those that are not both greater than 0 have no place in the plot and are left out.
    pub points: Vec<[f64; 2]>,
}

/// A plot of curves. Both axes are logarithmic.
pub struct Plot<'a> {
    pub title: &'a str,
    pub x_label: &'a str,
    pub y_label: &'a str,
    pub series: Vec<Series<'a>>,
    /// Values of x with a dashed line and a name. Those beyond the curves are left out.
    pub marks: Vec<(f64, String)>,
}

const WIDTH: f64 = 720.0;
const HEIGHT: f64 = 420.0;
/// Around the axes: left, right (for the legend), top, bottom.
const MARGIN: [f64; 4] = [72.0, 130.0, 40.0, 52.0];

/// A logarithmic axis over whole decades, from `from` to `to` in the picture.
struct Axis {
    decades: Range<i32>,
    from: f64,
    to: f64,
}

impl Axis {
    /// The decades that hold all values; 1 to 10 if there are none.
    fn new(values: impl Iterator<Item = f64>, from: f64, to: f64) -> Axis {
        let (low, high) = values.fold((f64::INFINITY, 0f64), |(low, high), v| (low.min(v), high.max(v)));
        let (low, high) = if low <= high { (low, high) } else { (1.0, 10.0) };
        let first = low.log10().floor() as i32;
        Axis { decades: first..(high.log10().ceil() as i32).max(first + 1), from, to }
    }

    fn at(&self, value: f64) -> f64 {
        let part = (value.log10() - self.decades.start as f64) / self.decades.len() as f64;
        self.from + part * (self.to - self.from)
    }

    /// Values with a line across the plot, and whether they have a label too.
    fn ticks(&self) -> impl Iterator<Item = (f64, bool)> {
        let inner = |decade: i32| (1..10).map(move |n| (n as f64 * 10f64.powi(decade), n == 1));
        self.decades.clone().flat_map(inner).chain([(10f64.powi(self.decades.end), true)])
    }
}

impl Plot<'_> {
    /// The plot as an SVG document.
    pub fn svg(&self) -> String {
        let [left, right, top, bottom] = MARGIN;
        let shown = |s: &Series| s.points.iter().copied().filter(|p| p.iter().all(|&c| c > 0.0)).collect::<Vec<_>>();
        let curves: Vec<Vec<[f64; 2]>> = self.series.iter().map(shown).collect();
        let x = Axis::new(curves.iter().flatten().map(|p| p[0]), left, WIDTH - right);
        let y = Axis::new(curves.iter().flatten().map(|p| p[1]), HEIGHT - bottom, top);
        let mut out = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" font-family=\"sans-serif\" \
             font-size=\"12\">\n<rect width=\"{WIDTH}\" height=\"{HEIGHT}\" fill=\"white\"/>\n"
        );
        grid(&mut out, &x, &y);
        let is_shown = |value: f64| (x.from..=x.to).contains(&x.at(value));
        for (value, name) in self.marks.iter().filter(|m| m.0 > 0.0 && is_shown(m.0)) {
            let (at, [low, high]) = (x.at(*value), [y.from, y.to]);
            let _ = writeln!(
                out,
                "<line x1=\"{at:.1}\" y1=\"{low:.1}\" x2=\"{at:.1}\" y2=\"{high:.1}\" stroke=\"#606060\" \
                 stroke-dasharray=\"5 4\"/>"
            );
            text(&mut out, [at + 4.0, y.from - 6.0], "start", "", name);
        }
        let middle = [(x.from + x.to) / 2.0, (y.from + y.to) / 2.0];
        text(&mut out, [middle[0], 24.0], "middle", "font-size=\"15\"", self.title);
        text(&mut out, [middle[0], HEIGHT - 14.0], "middle", "", self.x_label);
        let upright = format!("transform=\"rotate(-90 18 {:.1})\"", middle[1]);
        text(&mut out, [18.0, middle[1]], "middle", &upright, self.y_label);
        for (i, (series, points)) in self.series.iter().zip(&curves).enumerate() {
            let color = COLORS[i % COLORS.len()];
            curve(&mut out, color, points.iter().map(|p| [x.at(p[0]), y.at(p[1])]));
            let (lx, ly) = (x.to + 14.0, top + 10.0 + 20.0 * i as f64);
            curve(&mut out, color, [[lx, ly], [lx + 18.0, ly]].into_iter());
            text(&mut out, [lx + 26.0, ly + 4.0], "start", "", series.name);
        }
        out.push_str("</svg>\n");
        out
    }
}

/// Lines at the ticks of both axes, and their labels.
fn grid(out: &mut String, x: &Axis, y: &Axis) {
    let mut line = |a: [f64; 2], b: [f64; 2], strong: bool| {
        let color = if strong { "#b0b0b0" } else { "#e8e8e8" };
        let ([x1, y1], [x2, y2]) = (a, b);
        let _ = writeln!(
            out,
            "<line x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\" stroke=\"{color}\" stroke-width=\"1\"/>"
        );
    };
    // Decades over the lines between them.
    for decades in [false, true] {
        x.ticks().filter(|t| t.1 == decades).for_each(|(v, s)| line([x.at(v), y.from], [x.at(v), y.to], s));
        y.ticks().filter(|t| t.1 == decades).for_each(|(v, s)| line([x.from, y.at(v)], [x.to, y.at(v)], s));
    }
    for (value, _) in x.ticks().filter(|t| t.1) {
        text(out, [x.at(value), y.from + 18.0], "middle", "", &tick_label(value));
    }
    for (value, _) in y.ticks().filter(|t| t.1) {
        text(out, [x.from - 8.0, y.at(value) + 4.0], "end", "", &tick_label(value));
    }
}

/// Short for any power of ten.
fn tick_label(value: f64) -> String {
    if (1e-4..1e5).contains(&value) { format!("{value}") } else { format!("{value:e}") }
}

fn curve(out: &mut String, color: &str, points: impl Iterator<Item = [f64; 2]> + Clone) {
    let path: Vec<String> = points.clone().map(|[x, y]| format!("{x:.1},{y:.1}")).collect();
    let _ = writeln!(
        out,
        "<polyline points=\"{}\" fill=\"none\" stroke=\"{color}\" stroke-width=\"1.5\"/>",
        path.join(" ")
    );
    for [x, y] in points {
        let _ = writeln!(out, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"2.5\" fill=\"{color}\"/>");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_cover_whole_decades_and_are_logarithmic() {
        let axis = Axis::new([0.02, 5.0].into_iter(), 100.0, 400.0);
        assert_eq!(axis.decades, -2..1);
        for (value, at) in [(0.01, 100.0), (0.1, 200.0), (1.0, 300.0), (10.0, 400.0)] {
            assert!((axis.at(value) - at).abs() < 1e-9, "{value}");
        }
        let labels: Vec<f64> = axis.ticks().filter(|t| t.1).map(|t| t.0).collect();
        assert_eq!(labels, [0.01, 0.1, 1.0, 10.0]);
        assert_eq!(Axis::new([1.0].into_iter(), 0.0, 1.0).decades, 0..1);
        assert_eq!(Axis::new([].into_iter(), 0.0, 1.0).decades, 0..1);
    }

    #[test]
    fn what_has_no_logarithm_is_left_out() {
        let points = vec![[0.0, 1.0], [1.0, 0.0], [f64::NAN, 1.0], [2.0, 0.5], [3.0, 0.25]];
        let series = vec![Series { name: "a < b", points }];
        let svg = Plot {
            title: "t & u",
            x_label: "x",
            y_label: "y",
            series,
            marks: vec![(2.5, "m & n".into()), (1e9, "far".into())],
        }
        .svg();
        assert!(svg.contains("m &amp; n") && svg.matches("dasharray").count() == 1 && !svg.contains("far"));
        // Two points of the curve and two in the legend.
        assert_eq!(svg.matches("<circle").count(), 4);
        assert!(svg.contains("a &lt; b") && svg.contains("t &amp; u") && !svg.contains("NaN") && !svg.contains("inf"));
    }
}
