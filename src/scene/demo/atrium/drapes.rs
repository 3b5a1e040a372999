//! Drapes between the upper columns.

use super::measures::{BAY, FLOOR, Palette, SIDES, Side, UPPER_SPRING};
use super::part::Part;
use glam::Vec3;
use std::f32::consts::TAU;

/// Way in which a drape hangs.
#[derive(Clone, Copy)]
pub(super) enum Hang {
    /// Cloth across the bay.
    Full,
    /// Cloth in two halves, tied back to the columns.
    Tied,
}

/// Cloth between the upper columns, on rods.
pub(super) fn drapes(part: &mut Part, p: &Palette) {
    let colours = [p.red, p.blue, p.green];
    for (s, side) in SIDES.into_iter().enumerate() {
        for (b, middle) in side.bays().enumerate() {
            let hang = match (side.long, b) {
                (true, 0 | 4) => Hang::Tied,
                (true, 2) => Hang::Full,
                (false, _) => Hang::Tied,
                _ if s == 0 => Hang::Full,
                _ => continue,
            };
            let colour = colours[(b + s) % 3];
            let d = side.axis() + 0.25;
            rod(
                part,
                side,
                [middle - BAY / 2.0 + 0.335, middle + BAY / 2.0 - 0.335],
                d,
                UPPER_SPRING - 0.055,
                p.bronze,
            );
            match hang {
                Hang::Full => Drape { side, d, from: middle - 0.98, to: middle + 0.98, tie: None }.build(part, colour),
                Hang::Tied => {
                    for sign in [-1.0, 1.0] {
                        let (from, to) = (middle + sign * 1.02, middle + sign * 0.06);
                        Drape { side, d, from, to, tie: Some(0.34) }.build(part, colour);
                    }
                }
            }
        }
    }
}

/// A horizontal rod between two abaci.
pub(super) fn rod(part: &mut Part, side: Side, [from, to]: [f32; 2], d: f32, y: f32, material: u32) {
    const SEGMENTS: usize = 10;
    let ring: Vec<Vec3> = (0..=SEGMENTS)
        .map(|i| {
            let (sin, cos) = (TAU * (i % SEGMENTS) as f32 / SEGMENTS as f32).sin_cos();
            side.out * cos + Vec3::Y * sin
        })
        .collect();
    let circle = |a: f32| -> Vec<Vec3> { ring.iter().map(|r| side.at(a, d, y) + 0.018 * r).collect() };
    part.strip(&circle(from), &circle(to), &ring, material);
}

/// A sheet with vertical folds.
pub(super) struct Drape {
    side: Side,
    /// Distance from the middle of the court.
    d: f32,
    /// Positions along the side, at the rod, of the fixed edge and the free one.
    from: f32,
    to: f32,
    /// Width at the tie, as a fraction; `None`: it hangs free.
    tie: Option<f32>,
}

impl Drape {
    /// A point of the sheet: s in [0, 1] from the fixed edge, t in [0, 1] downwards.
    fn at(&self, s: f32, t: f32) -> Vec3 {
        let (top, bottom) = (UPPER_SPRING - 0.08, FLOOR + 0.06);
        let smooth = |x: f32| x.clamp(0.0, 1.0).powi(2) * (3.0 - 2.0 * x.clamp(0.0, 1.0));
        let width = match self.tie {
            None => 1.0,
            // Tied at 55 % of its height, half free again below.
            Some(w) if t < 0.55 => 1.0 + (w - 1.0) * smooth(t / 0.55),
            Some(w) => w + 0.16 * smooth((t - 0.55) / 0.3),
        };
        let folds = ((self.to - self.from).abs() * 3.2).round();
        let phase = TAU * folds * s + 0.7 * (3.0 * t + 5.0 * s).sin();
        // Gathered at the rod, deeper folds below; where the cloth is drawn together there are more
        // of them to the metre, so they are shallower.
        let depth = (0.03 + 0.03 * smooth(t / 0.4)) * (0.1 + 0.9 * width);
        let hem = if self.tie.is_some() { 0.0 } else { 0.02 * phase.cos() * t };
        let along = self.from + (self.to - self.from) * width * s;
        self.side.at(along, self.d + depth * phase.sin(), top + (bottom - top) * t + hem)
    }

    /// Unit normal of the front, which looks into the court.
    fn normal(&self, s: f32, t: f32) -> Vec3 {
        const STEP: f32 = 1e-3;
        let n = (self.at(s + STEP, t) - self.at(s - STEP, t)).cross(self.at(s, t + STEP) - self.at(s, t - STEP));
        (n * -n.dot(self.side.out).signum()).normalize()
    }

    fn build(&self, part: &mut Part, material: u32) {
        let (columns, rows) = (((self.to - self.from).abs() * 34.0).round() as usize, 14);
        let row = |j: usize| -> (Vec<Vec3>, Vec<Vec3>) {
            let t = j as f32 / rows as f32;
            (0..=columns).map(|i| i as f32 / columns as f32).map(|s| (self.at(s, t), self.normal(s, t))).unzip()
        };
        for j in 0..rows {
            let ((a, na), (b, nb)) = (row(j), row(j + 1));
            part.curved_strip(&a, &b, &na, &nb, material);
        }
    }
}
