//! What the stages of a run took, and the table of them that is printed at the end.

use std::fmt::Write;

/// What one stage took and did.
#[derive(Clone, Debug, Default)]
pub struct Stage {
    pub name: &'static str,
    pub seconds: f64,
    /// Rays traced, if it traces any that are counted.
    pub rays: u64,
    /// Photons emitted.
    pub photons: u64,
    /// Memory that its result takes, or bytes written.
    pub bytes: u64,
}

impl Stage {
    /// Rays per second, if there are any.
    pub fn rays_per_second(&self) -> Option<f64> {
        rate(self.rays, self.seconds)
    }

    /// Photons emitted per second, if there are any.
    pub fn photons_per_second(&self) -> Option<f64> {
        rate(self.photons, self.seconds)
    }
}

fn rate(count: u64, seconds: f64) -> Option<f64> {
    (count > 0 && seconds > 0.0).then(|| count as f64 / seconds)
}

/// The table as text. `total` is the time of the whole run.
pub fn table(stages: &[Stage], total: f64) -> String {
    let mut out = String::new();
    let rule = "-".repeat(72);
    let _ =
        writeln!(out, "{:<22}{:>9}{:>8}{:>11}{:>12}{:>10}", "stage", "seconds", "share", "Mrays/s", "photons/s", "MB");
    let _ = writeln!(out, "{rule}");
    for s in stages {
        let millions = |r: Option<f64>| r.map_or(String::new(), |r| format!("{:.2}", r * 1e-6));
        let photons = s.photons_per_second().map_or(String::new(), |p| format!("{p:.0}"));
        let bytes = if s.bytes > 0 { format!("{:.1}", s.bytes as f64 * 1e-6) } else { String::new() };
        let share = 100.0 * s.seconds / total.max(f64::MIN_POSITIVE);
        let rays = millions(s.rays_per_second());
        let _ = writeln!(out, "{:<22}{:>9.3}{:>7.1}%{rays:>11}{photons:>12}{bytes:>10}", s.name, s.seconds, share);
    }
    let _ = writeln!(out, "{rule}");
    let _ = writeln!(out, "{:<22}{:>9.3}{:>7.1}%", "total", total, 100.0);
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_are_shown_only_where_something_was_counted() {
        let stages = [
            Stage { name: "gather", seconds: 2.0, rays: 3_000_000, bytes: 1_500_000, ..Default::default() },
            Stage { name: "photons", seconds: 0.5, photons: 1000, ..Default::default() },
            Stage { name: "instant", seconds: 0.0, rays: 5, ..Default::default() },
        ];
        let text = table(&stages, 4.0);
        let line =
            |name: &str| text.lines().find(|l| l.starts_with(name)).unwrap().split_whitespace().collect::<Vec<_>>();
        assert_eq!(line("gather"), ["gather", "2.000", "50.0%", "1.50", "1.5"]);
        assert_eq!(line("photons"), ["photons", "0.500", "12.5%", "2000"]);
        assert_eq!(line("instant"), ["instant", "0.000", "0.0%"]);
    }
}
