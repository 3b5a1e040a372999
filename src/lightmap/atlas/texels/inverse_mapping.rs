//! The two passes of the inverse mapping from texels to points on triangles (thesis 3.2.3): which triangle each texel of a
//! group belongs to, then a sample of each.
//!
//! Geometry is computed in f64 on texel coordinates relative to the rectangle of each group. Triangles that share an
//! edge compute the same crossings with texel rows, so no centre falls between them.

use super::super::charts::Charts;
use super::super::flat_triangle::Flat;
use super::super::ids::PlacementId;
use super::super::layout::Layout;
use super::super::sheets::Shape;
use super::{Group, INDEX, TexelSample};
use crate::base::error::{Error, Result};
use crate::base::memory::try_to_vec;
use crate::base::progress::Stage;
use crate::scene::NONE;
use glam::DVec2;
use std::ops::Range;

/// Inputs of the two passes.
pub(super) struct Job<'a, 'p, 'c> {
    pub charts: &'a Charts,
    pub layout: &'a Layout,
    pub stage: &'a Stage<'p, 'c>,
}

impl Job<'_, '_, '_> {
    /// Returns what of the charts a group shows.
    fn surface<'g>(&'g self, group: &'g Group) -> Surface<'g> {
        let chart_at = |place: u32| self.layout.chart_of(PlacementId::new(place as usize));
        let first = chart_at(group.placements.start);
        let slots = self.charts[first].triangles.start..self.charts[chart_at(group.placements.end - 1)].triangles.end;
        Surface { layout: self.layout, group, slots, shape: self.charts.shape(first) }
    }
}

/// The surface that a group shows: one chart, or some of the given charts, which come first.
struct Surface<'a> {
    layout: &'a Layout,
    group: &'a Group,
    /// Triangles, by their places in the list of their sheet.
    slots: Range<u32>,
    shape: Shape<'a>,
}

impl Surface<'_> {
    /// Returns the global number of a slot's triangle.
    #[inline]
    fn triangle(&self, slot: u32) -> u32 {
        self.shape.first_triangle + self.shape.sheet.triangles[slot as usize]
    }

    /// Returns the place in the group's placements of the one that a slot belongs to.
    #[inline]
    fn placement(&self, slot: u32) -> usize {
        if self.group.placements.len() == 1 {
            return 0;
        }
        // Given charts are charts of meshes, whose sheet has the scene's numbers.
        let chart = self.shape.sheet.of_triangles[self.shape.sheet.triangles[slot as usize] as usize];
        PlacementId::front_of(chart).index() - self.group.placements.start as usize
    }

    /// Returns the corners of a slot's triangle in texels of the group's window.
    fn flat_triangle(&self, slot: u32) -> Flat {
        let group = self.group;
        let triangle = self.shape.sheet.triangles[slot as usize];
        let placement = PlacementId::new(group.placements.start as usize + self.placement(slot));
        let p = &self.layout[placement];
        let origin = DVec2::new(group.window.x as f64, group.window.y as f64);
        let [offset, scale] = [p.offset, p.scale].map(|a| DVec2::new(a[0] as f64, a[1] as f64));
        Flat(self.shape.corners(triangle).map(|[s, t]| {
            let local = if p.swap { DVec2::new(t as f64, s as f64) } else { DVec2::new(s as f64, t as f64) };
            offset + scale * local - origin
        }))
    }
}

/// Marks owners that touch a texel without covering its centre. (Slots have 28 bits.)
const BORDER: u32 = 1 << 31;

/// Number of visited texels between two checks for a cancel.
const TEXELS_PER_CHECK: u64 = 1 << 18;

/// Number of samples made between two checks for a cancel.
const SAMPLES_PER_CHECK: usize = 1 << 14;

/// Writes the owner of each texel of a group (a slot, perhaps with [`BORDER`]; [`NONE`]) and the number of texels of
/// each placement, which are 0; returns the number of centres covered more than once.
pub(super) fn cover_group(
    job: &Job,
    group: &Group,
    owners: &mut [u32],
    scratch: &mut Vec<f64>,
    counts: &mut [u32],
) -> Result<u64> {
    owners.fill(NONE);
    let surface = job.surface(group);
    let size = [group.window.w as i64, group.window.h as i64];
    let mut overlapping = 0;
    let mut visited = 0;
    let mut check = |texels: u64| {
        visited += texels;
        if visited < TEXELS_PER_CHECK {
            return Ok(());
        }
        visited = 0;
        job.stage.check()
    };
    for slot in surface.slots.clone() {
        let flat = surface.flat_triangle(slot);
        overlapping += cover_centres(&flat, slot, size, owners);
        check(flat.box_texels(size))?;
    }
    // By a triangle that covers the centre.
    let is_owned = |owner: u32| owner != NONE && owner & BORDER == 0;
    // Squared distance of the nearest triangle to the centre, for texels whose centre is in none.
    scratch.clear();
    scratch.try_reserve(owners.len()).map_err(|e| Error::OutOfMemory(format!("{INDEX}: {e}")))?;
    scratch.resize(owners.len(), f64::INFINITY);
    for slot in surface.slots.clone() {
        let flat = surface.flat_triangle(slot);
        if flat.lies_in_few(size, |x, y| is_owned(owners[(y * size[0] + x) as usize])) {
            continue;
        }
        flat.for_each_touched(size, |x, y| {
            let i = (y * size[0] + x) as usize;
            if !is_owned(owners[i]) {
                let distance = flat.nearest_in_texel(x, y).1;
                // Rounding must not decide between triangles that share the nearest point.
                if distance < scratch[i] - 1e-9 {
                    scratch[i] = distance;
                    owners[i] = slot | BORDER;
                }
            }
        });
        check(flat.box_texels(size))?;
    }
    for &owner in owners.iter().filter(|&&o| o != NONE) {
        counts[surface.placement(owner & !BORDER)] += 1;
    }
    Ok(overlapping)
}

/// Claims the free texels whose centre a triangle covers; returns the number of those that were claimed before.
pub(super) fn cover_centres(flat: &Flat, slot: u32, size: [i64; 2], owners: &mut [u32]) -> u64 {
    // Triangles that overlap by less than this may just touch.
    const TOUCH: f64 = 1e-3;
    let (lower, upper) = flat.bounds();
    let mut overlapping = 0;
    let last_row = ((upper.y - 0.5).floor() as i64).min(size[1] - 1);
    for y in ((lower.y - 0.5).ceil() as i64).max(0)..=last_row {
        let centre = y as f64 + 0.5;
        let (left, right) = flat.slab(centre, centre);
        let last = ((right - 0.5).floor() as i64).min(size[0] - 1);
        let inner_row = centre - lower.y > TOUCH && upper.y - centre > TOUCH;
        for x in ((left - 0.5).ceil() as i64).max(0)..=last {
            let owner = &mut owners[(y * size[0] + x) as usize];
            if *owner == NONE {
                *owner = slot;
            } else if inner_row && x as f64 + 0.5 - left > TOUCH && right - x as f64 - 0.5 > TOUCH {
                overlapping += 1;
            }
        }
    }
    overlapping
}

/// Writes the samples of a group, and their numbers over the owners.
pub(super) fn sample_group(
    job: &Job,
    group: &Group,
    chart_start: &[u32],
    owners: &mut [u32],
    samples: &mut [TexelSample],
) -> Result<()> {
    let surface = job.surface(group);
    let first = chart_start[group.placements.start as usize];
    let mut next = try_to_vec(&chart_start[group.placements.start as usize..group.placements.end as usize], INDEX)?;
    // Neighbouring texels mostly show the same triangle.
    let mut last = (NONE, Flat([DVec2::ZERO; 3]));
    for (i, owner) in owners.iter_mut().enumerate() {
        if i % SAMPLES_PER_CHECK == 0 {
            job.stage.check()?;
        }
        if *owner == NONE {
            continue;
        }
        let (x, y) = (i as u32 % group.window.w as u32, i as u32 / group.window.w as u32);
        let slot = *owner & !BORDER;
        if slot != last.0 {
            last = (slot, surface.flat_triangle(slot));
        }
        let point = match *owner & BORDER {
            0 => DVec2::new(x as f64 + 0.5, y as f64 + 0.5),
            _ => last.1.centroid_in_texel(x as i64, y as i64),
        };
        let [u, v] = last.1.weights(point);
        let number = &mut next[surface.placement(slot)];
        samples[(*number - first) as usize] = TexelSample {
            x: group.window.x + x as u16,
            y: group.window.y + y as u16,
            triangle: surface.triangle(slot),
            u: u as f32,
            v: v as f32,
        };
        *owner = *number;
        *number += 1;
    }
    Ok(())
}
