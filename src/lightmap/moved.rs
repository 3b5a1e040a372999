//! What moved between two states of a scene: charts, and boxes around where they were and where they are.

use super::atlas::charts::Charts;
use super::atlas::ids::ChartId;
use crate::base::bounds::Bounds;
use crate::base::error::{Error, Result};
use crate::base::geometry::is_valid_triangle;
use crate::base::memory::{try_push, try_vec};
use crate::scene::Scene;

/// Maximum number of boxes; those whose union adds least are merged until there are so few.
pub(super) const MOST_BOXES: usize = 32;

/// Boxes that are merged in pairs at most; of more, neighbours in the order of objects are merged first, since trying all
/// pairs takes the square of their number.
const MOST_PAIRED: usize = 256;

const MOVED: &str = "what has moved";

/// What moved between two states of a scene.
pub(crate) struct Moved {
    /// Whether each chart has a corner that moved.
    charts: Vec<bool>,
    /// Boxes around the triangles that moved, before and after; few, and none of them empty.
    pub boxes: Vec<Bounds>,
    /// Whether an emissive triangle moved.
    pub emits: bool,
}

impl Moved {
    /// `charts`: whether each chart has moved.
    pub(super) fn new(charts: Vec<bool>, boxes: Vec<Bounds>, emits: bool) -> Moved {
        Moved { charts, boxes: merged(boxes, MOST_BOXES), emits }
    }

    /// Compares two states of a scene, whose charts are the same. `InvalidState` if a triangle of a chart has become
    /// degenerate or not finite: it has no normal, and its texels no place.
    pub fn between(old: &Scene, new: &Scene, charts: &Charts) -> Result<Moved> {
        let mut moved = Moved::new(try_vec(charts.charts.len(), MOVED)?, Vec::new(), false);
        if std::ptr::eq(old, new) {
            return Ok(moved);
        }
        for number in 0..new.object_count() {
            let (before, after) = (old.object(number), new.object(number));
            if before.stands_as(&after) {
                continue;
            }
            let mut boxes = [Bounds::EMPTY; 2];
            let first = new.first_triangle(number);
            // What shows another object's light has no texels that could move.
            let has_texels = !new.shows_light_of_other(number);
            for triangle in new.triangles_of(number) {
                let corners = [&before, &after].map(|object| object.corners(triangle - first));
                if corners[0].map(|c| c.to_array().map(f32::to_bits))
                    == corners[1].map(|c| c.to_array().map(f32::to_bits))
                {
                    continue;
                }
                if let Some(chart) = charts.find(triangle).filter(|_| has_texels) {
                    if !is_valid_triangle(corners[1]) {
                        return Err(is_gone(new, number, triangle - first));
                    }
                    moved.charts[chart.index()] = true;
                }
                moved.emits |= new.material(triangle).is_emissive();
                for (bounds, corners) in boxes.iter_mut().zip(corners).filter(|(_, c)| is_valid_triangle(*c)) {
                    corners.into_iter().for_each(|corner| bounds.add(corner));
                }
            }
            for bounds in boxes.into_iter().filter(|bounds| !bounds.is_empty()) {
                try_push(&mut moved.boxes, bounds, MOVED)?;
            }
        }
        moved.boxes = merged(moved.boxes, MOST_BOXES);
        Ok(moved)
    }

    /// Whether a corner of a chart moved.
    pub fn has(&self, chart: ChartId) -> bool {
        self.charts[chart.index()]
    }
}

/// The error of a triangle that has texels but is a surface no more.
fn is_gone(scene: &Scene, object: u32, triangle: u32) -> Error {
    let object = match object.checked_sub(scene.meshes().len() as u32) {
        None => format!("mesh {object}"),
        Some(instance) => format!("instance {instance}"),
    };
    Error::InvalidState(format!(
        "triangle {triangle} of {object} has texels, and is degenerate or not finite since the scene has moved"
    ))
}

/// Merges boxes until there are at most `most`, at least 1.
pub(super) fn merged(mut boxes: Vec<Bounds>, most: usize) -> Vec<Bounds> {
    while boxes.len() > MOST_PAIRED {
        for i in 0..boxes.len() / 2 {
            boxes[i] = boxes[2 * i].with(&boxes[2 * i + 1]);
        }
        let half = boxes.len() / 2;
        if boxes.len() % 2 == 1 {
            boxes[half] = boxes[2 * half];
        }
        boxes.truncate(boxes.len().div_ceil(2));
    }
    while boxes.len() > most {
        let mut best = (f32::INFINITY, 0, 1);
        for i in 0..boxes.len() {
            for j in i + 1..boxes.len() {
                let more = boxes[i].with(&boxes[j]).area() - boxes[i].area() - boxes[j].area();
                if more < best.0 {
                    best = (more, i, j);
                }
            }
        }
        let (_, i, j) = best;
        boxes[i] = boxes[i].with(&boxes[j]);
        boxes.swap_remove(j);
    }
    boxes
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    fn unit_box(at: Vec3) -> Bounds {
        Bounds { lower: at, upper: at + 1.0 }
    }

    #[test]
    fn merged_boxes_are_few_and_hold_all() {
        for count in [0, 3, 32, 33, 257, 1000] {
            let all: Vec<Bounds> =
                (0..count).map(|i| unit_box(Vec3::new(i as f32 * 1.5, (i % 7) as f32, 0.0))).collect();
            let few = merged(all.clone(), MOST_BOXES);
            assert!(few.len() <= MOST_BOXES && (count > MOST_BOXES || few == all));
            let holds = |small: &Bounds| few.iter().any(|large| large.with(small) == *large);
            assert!(all.iter().all(holds), "{count}");
        }
    }
}
