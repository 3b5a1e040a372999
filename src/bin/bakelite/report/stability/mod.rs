//! `bakelite report stability`: stiff and extreme cases, each against what is known of it, by analysis
//! or from the f64 path tracer.
//!
//! A case that fails is printed as such; the report itself then still succeeds.

mod lab;
mod light;
mod limits;
mod space;

use crate::args::BakeArgs;
use crate::files;
use crate::plot::curves::{Plot, Series};
use bakelite::Result;
use lab::{Case, Lab, Row, Verdict};
use std::fmt::Write;
use std::time::Instant;

/// By name, in the order of the report.
fn cases() -> Vec<(&'static str, Case)> {
    [&light::CASES[..], &space::CASES[..], &limits::CASES[..]].concat()
}

/// Runs the report.
pub fn run(args: &BakeArgs) -> Result<()> {
    files::make_folder(&args.out)?;
    let lab = Lab::new(args, false)?;
    let start = Instant::now();
    let mut rows = Vec::new();
    let mut seconds = Vec::new();
    for (name, case) in cases() {
        let start = Instant::now();
        lab.take_warnings();
        if let Err(e) = case(&lab, &mut rows) {
            rows.push(Row::of_error(name, "", 0.0, 0.0).note(format!("ended early: {e}")));
        }
        seconds.push((name, start.elapsed().as_secs_f64()));
        if !args.quiet {
            println!("{name}: {:.1} s", start.elapsed().as_secs_f64());
        }
    }
    let text = markdown(&rows, &seconds, start.elapsed().as_secs_f64());
    println!("\n{text}");
    for (name, content) in [("stability.csv", csv(&rows)), ("stability.svg", plot(&rows)), ("stability.md", text)] {
        files::write_text(&args.out.join(name), &content)?;
    }
    Ok(())
}

fn number(x: f64) -> String {
    if x != 0.0 && !(1e-3..1e6).contains(&x.abs()) { format!("{x:.3e}") } else { format!("{x:.6}") }
}

fn csv(rows: &[Row]) -> String {
    let mut out = String::from("case,parameter,value,expected,got,error,verdict,note\n");
    for r in rows {
        let quoted = |s: &str| format!("\"{}\"", s.replace('"', "'"));
        let numbers = [r.x, r.expected, r.got, r.error].map(|x| format!("{x:e}")).join(",");
        let _ = writeln!(
            out,
            "{},{},{numbers},{},{}",
            quoted(r.case),
            quoted(&r.parameter),
            r.verdict.text(),
            quoted(&r.note)
        );
    }
    out
}

/// Errors over parameters of the cases that have a sweep.
fn plot(rows: &[Row]) -> String {
    let sweeps = [
        ("furnace", "furnace, 1/(1-albedo)"),
        ("scale", "scene scale"),
        ("offset", "offset / size"),
        ("light power", "light power"),
        ("point light near a wall", "distance to wall"),
        ("energy", "photons"),
    ];
    let series = sweeps.iter().map(|&(case, name)| Series {
        name,
        points: rows.iter().filter(|r| r.case == case && r.error > 0.0).map(|r| [r.x, r.error]).collect(),
    });
    let series = series.filter(|s| !s.points.is_empty()).collect();
    Plot { title: "Stability", x_label: "parameter", y_label: "relative error", series, marks: Vec::new() }.svg()
}

fn markdown(rows: &[Row], seconds: &[(&str, f64)], total: f64) -> String {
    let count = |v: Verdict| rows.iter().filter(|r| r.verdict == v).count();
    let mut out = format!(
        "# Stability\n\n{} measurements in {total:.0} s: {} ok, {} degrade as documented, {} fail.\n",
        rows.len(),
        count(Verdict::Ok),
        count(Verdict::Degrades),
        count(Verdict::Fails)
    );
    let failing: Vec<&Row> = rows.iter().filter(|r| r.verdict == Verdict::Fails).collect();
    if !failing.is_empty() {
        out.push_str("\nWhat fails:\n\n");
        for r in failing {
            let _ = writeln!(out, "- {} {}: error {} ({})", r.case, r.parameter, number(r.error), r.note);
        }
    }
    out.push_str("\n| case | parameter | expected | got | error | verdict | note |\n|---|---|---|---|---|---|---|\n");
    for r in rows {
        let numbers = [r.expected, r.got, r.error].map(number).join(" | ");
        let note = r.note.replace('|', "/").replace('\n', " ");
        let _ = writeln!(out, "| {} | {} | {numbers} | {} | {note} |", r.case, r.parameter, r.verdict.text());
    }
    out.push_str("\nSeconds: ");
    let seconds: Vec<String> = seconds.iter().map(|(name, s)| format!("{name} {s:.1}")).collect();
    out.push_str(&seconds.join(", "));
    out.push_str(".\n");
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use bakelite::lightmap::BakeParams;

    #[test]
    fn failures_are_listed_first_and_numbers_are_in_the_csv() {
        let rows = [
            Row::new("furnace", "0.5", 2.0, 1.0, 1.001).within(0.01),
            Row::new("scale", "1e-6", 1e-6, 1.0, 0.5).within(0.01),
        ];
        let text = markdown(&rows, &[("furnace", 1.0)], 1.0);
        assert!(text.contains("1 ok, 0 degrade as documented, 1 fail"), "{text}");
        assert!(text.contains("- scale 1e-6: error 0.5"), "{text}");
        assert!(csv(&rows).lines().nth(2).unwrap().contains(",FAILS,"));
        assert!(plot(&rows).contains("scene scale"));
    }

    /// What the library promises about stiff and extreme cases.
    #[test]
    fn all_cases_hold() {
        let args = BakeArgs { params: BakeParams { photon_count: 10_000, ..Default::default() }, ..Default::default() };
        let lab = Lab::new(&args, true).unwrap();
        let mut rows = Vec::new();
        for (name, case) in cases() {
            lab.take_warnings();
            case(&lab, &mut rows).unwrap_or_else(|e| panic!("{name}: {e}"));
        }
        for r in &rows {
            assert!(r.verdict != Verdict::Fails, "{r:?}");
        }
        assert!(rows.len() > 50, "{}", rows.len());
    }
}
