//! Charts of flat surface, projected on their plane: exact, and in linear time.
//!
//! Most triangles of buildings lie in flat regions with creases all around, which a chart could not cross anyway. Such a
//! region is a chart of its own if it does not overlap itself in projection, as tested for every two triangles that are
//! near each other; what is left goes to [`unwrap`](super::unwrap).

use super::pieces::{CHARTS, ITEMS_PER_CHECK, Piece};
use super::welded::Geometry;
use crate::base::error::Result;
use crate::base::memory::{try_collect, try_filled, try_push, try_with_capacity};
use crate::base::progress::Stage;
use crate::device::Device;
use crate::scene::NONE;
use glam::{DVec2, DVec3};

/// Cosine of the greatest angle between the normals of a flat region's triangles and of its first one (a quarter
/// degree, as in `uvunwrap`). Parts never cut a flat region.
const FLAT_COSINE: f64 = 1.0 - 1e-5;

/// Cosine of the least angle between a flat region and its neighbours over which no chart reaches (60 degrees, the
/// largest angle between a triangle and its chart in `uvunwrap`).
const CREASE_COSINE: f64 = 0.5;

/// Cosine of the greatest angle between the normals of two triangles that share a planar chart (5 degrees).
const PAIR_COSINE: f64 = 0.9962;

/// Depth to which triangles may overlap in projection, as a fraction of the region's extent: rounding of positions.
const TOUCH: f64 = 1e-6;

/// Maximum number of cells that triangles are put into to be tested for overlaps, and of tests, per triangle. Where
/// there are more, triangles are long and thin.
const CELLS_PER_TRIANGLE: usize = 16;
const TESTS_PER_TRIANGLE: usize = 128;

/// Flat regions, ordered by their lowest triangles, which come first in each.
pub(super) struct Regions {
    members: Vec<u32>,
    /// Where each region begins in `members`, and where the last one ends.
    starts: Vec<u32>,
}

impl Regions {
    /// Bytes per triangle, if each is a region.
    pub(super) const BYTES_PER_TRIANGLE: usize = 4 + 4 + 1;

    pub(super) fn len(&self) -> usize {
        self.starts.len() - 1
    }

    pub(super) fn get(&self, region: usize) -> &[u32] {
        &self.members[self.starts[region] as usize..self.starts[region + 1] as usize]
    }
}

/// Finds the flat regions of `triangles` (ascending): connected triangles with nearly equal normals.
pub(super) fn flat_regions(
    geometry: &Geometry,
    neighbours: &[[u32; 3]],
    triangles: &[u32],
    stage: &Stage,
) -> Result<Regions> {
    let mut taken = try_filled(geometry.indices.len(), false, CHARTS)?;
    let mut members: Vec<u32> = try_with_capacity(triangles.len(), CHARTS)?;
    let mut starts = Vec::new();
    for (i, &seed) in triangles.iter().enumerate() {
        if i % ITEMS_PER_CHECK == 0 {
            stage.check()?;
        }
        if std::mem::replace(&mut taken[seed as usize], true) {
            continue;
        }
        let mut next = members.len();
        try_push(&mut starts, next as u32, CHARTS)?;
        try_push(&mut members, seed, CHARTS)?;
        while let Some(&t) = members.get(next) {
            next += 1;
            if next.is_multiple_of(ITEMS_PER_CHECK) {
                stage.check()?;
            }
            for n in neighbours[t as usize] {
                let flat = n != NONE && geometry.normals[n as usize].dot(geometry.normals[seed as usize]) > FLAT_COSINE;
                if flat && !std::mem::replace(&mut taken[n as usize], true) {
                    try_push(&mut members, n, CHARTS)?;
                }
            }
        }
    }
    try_push(&mut starts, members.len() as u32, CHARTS)?;
    Ok(Regions { members, starts })
}

/// Makes a chart of a flat region; `None` if it must not be one: it has neighbours that a chart may reach, or overlaps
/// itself.
pub(super) fn flat_piece(
    geometry: &Geometry,
    neighbours: &[[u32; 3]],
    region: &[u32],
    stage: &Stage,
) -> Result<Option<Piece>> {
    let seed = geometry.normals[region[0] as usize];
    let is_inner = |n: u32| geometry.normals[n as usize].dot(seed) > FLAT_COSINE;
    for (i, &t) in region.iter().enumerate() {
        if i % ITEMS_PER_CHECK == ITEMS_PER_CHECK - 1 {
            stage.check()?;
        }
        for n in neighbours[t as usize] {
            // A flat neighbour is in the region, unless an earlier one has taken it.
            if n != NONE
                && geometry.normals[n as usize].dot(geometry.normals[t as usize]) > CREASE_COSINE
                && !is_inner(n)
            {
                return Ok(None);
            }
        }
    }
    let mut members = try_collect(region.iter().copied(), CHARTS)?;
    members.sort_unstable();
    stage.check()?;
    let normal: DVec3 = members.iter().map(|&t| doubled_area(geometry.corners(t as usize))).sum();
    let normal = normal.normalize_or(DVec3::Z);
    let x = normal.any_orthonormal_vector();
    let y = normal.cross(x);
    let origin = geometry.corners(members[0] as usize)[0];
    let project = |p: DVec3| DVec2::new((p - origin).dot(x), (p - origin).dot(y));
    let flat = members.iter().map(|&t| geometry.corners(t as usize).map(project));
    let mut flat: Vec<[DVec2; 3]> = try_collect(flat, CHARTS)?;
    let mut border = Vec::new();
    for (i, (&t, corners)) in members.iter().zip(&flat).enumerate() {
        if i % ITEMS_PER_CHECK == ITEMS_PER_CHECK - 1 {
            stage.check()?;
        }
        for (k, n) in neighbours[t as usize].into_iter().enumerate() {
            if n == NONE || !is_inner(n) {
                try_push(&mut border, corners[k], CHARTS)?;
            }
        }
    }
    turn_upright(&mut flat, &mut border)?;
    stage.check()?;
    if members.len() > 2 && overlaps_itself(&flat, stage)? {
        return Ok(None);
    }
    Ok(Some(Piece {
        triangles: try_collect(members.iter().map(|&t| geometry.triangles[t as usize]), CHARTS)?.into(),
        corners: try_collect(flat.iter().map(|t| t.map(|p| p.as_vec2().to_array())), CHARTS)?.into(),
        given: None,
    }))
}

/// The vector of a triangle's normal whose length is twice its area.
pub(super) fn doubled_area([a, b, c]: [DVec3; 3]) -> DVec3 {
    (b - a).cross(c - a)
}

/// Turns triangles so that the box around them is the smallest there is: one of its sides lies along the convex hull of
/// their `border`, which has the starts of all border edges.
fn turn_upright(triangles: &mut [[DVec2; 3]], border: &mut [DVec2]) -> Result<()> {
    let hull = convex_hull(border)?;
    let edges = (0..hull.len()).map(|i| (i, hull[(i + 1) % hull.len()] - hull[i]));
    let mut edges: Vec<(usize, DVec2)> = try_collect(edges, CHARTS)?;
    edges.sort_unstable_by(|(i, a), (j, b)| b.length_squared().total_cmp(&a.length_squared()).then(i.cmp(j)));
    let turned = |x: DVec2, p: DVec2| DVec2::new(x.dot(p), x.perp_dot(p));
    let box_area = |x: DVec2| {
        let points = || hull.iter().map(|&p| turned(x, p));
        let size = points().fold(DVec2::NEG_INFINITY, DVec2::max) - points().fold(DVec2::INFINITY, DVec2::min);
        size.x * size.y
    };
    let tried = edges.into_iter().take(EDGES_TRIED).filter_map(|(_, e)| e.try_normalize()).map(|x| (box_area(x), x));
    let best = tried.fold((f64::INFINITY, DVec2::X), |m, t| if t.0 < m.0 { t } else { m }).1;
    triangles.iter_mut().for_each(|t| *t = t.map(|p| turned(best, p)));
    Ok(())
}

/// Corners of the convex hull, counter-clockwise (Andrew 1979). Sorts the points.
fn convex_hull(points: &mut [DVec2]) -> Result<Vec<DVec2>> {
    points.sort_unstable_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
    let mut hull: Vec<DVec2> = Vec::new();
    // Once along the lower side and once back along the upper one.
    for back in [false, true] {
        let start = hull.len();
        for i in 0..points.len() {
            let p = points[if back { points.len() - 1 - i } else { i }];
            while let [.., a, b] = hull[start..]
                && (b - a).perp_dot(p - b) <= 0.0
            {
                hull.pop();
            }
            try_push(&mut hull, p, CHARTS)?;
        }
        hull.pop();
    }
    Ok(hull)
}

/// Maximum number of edges of the hull that are tried, longest first.
const EDGES_TRIED: usize = 64;

/// Whether any two of some triangles, which all turn the same way, may overlap.
fn overlaps_itself(triangles: &[[DVec2; 3]], stage: &Stage) -> Result<bool> {
    let corners = || triangles.iter().flatten().copied();
    let lower = corners().fold(DVec2::INFINITY, DVec2::min);
    let extent = corners().fold(DVec2::NEG_INFINITY, DVec2::max) - lower;
    let touch = TOUCH * extent.max_element();
    let Some(cells) = Cells::of(triangles, lower, extent, stage)? else { return Ok(true) };
    let (mut tests, mut since_check) = (0, 0);
    for w in cells.starts.windows(2) {
        let here = &cells.items[w[0] as usize..w[1] as usize];
        tests += here.len() * here.len() / 2;
        if tests > TESTS_PER_TRIANGLE * triangles.len() {
            return Ok(true);
        }
        for (k, &a) in here.iter().enumerate() {
            let others = &here[k + 1..];
            since_check += 1 + others.len();
            if since_check > ITEMS_PER_CHECK {
                stage.check()?;
                since_check = 0;
            }
            if others.iter().any(|&b| overlap(&triangles[a as usize], &triangles[b as usize], touch)) {
                return Ok(true);
            }
        }
    }
    Ok(false)
}

/// A grid of about as many cells as triangles, with the triangles whose boxes meet each cell.
struct Cells {
    /// Where those of each cell begin in `items`, and where the last ones end.
    starts: Vec<u32>,
    items: Vec<u32>,
}

impl Cells {
    /// Puts triangles, which have these bounds, into cells; `None` if they have no extent, or meet too many cells.
    fn of(triangles: &[[DVec2; 3]], lower: DVec2, extent: DVec2, stage: &Stage) -> Result<Option<Cells>> {
        let n = triangles.len();
        let side = (extent.x * extent.y / n as f64).sqrt().max(extent.max_element() / n as f64);
        if !(side > 0.0) {
            return Ok(None);
        }
        let cells = (extent / side).ceil().max(DVec2::ONE).min(DVec2::splat(n as f64));
        let columns = cells.x as usize;
        let cell = |p: DVec2| {
            let c = ((p - lower) / side).floor().clamp(DVec2::ZERO, cells - 1.0);
            [c.x as usize, c.y as usize]
        };
        let mut starts = try_filled(columns * cells.y as usize + 1, 0u32, CHARTS)?;
        // Computed twice: kept, they take 32 bytes per triangle.
        let ranges = || triangles.iter().map(|[a, b, c]| [cell(a.min(*b).min(*c)), cell(a.max(*b).max(*c))]);
        let mut total = 0;
        for (i, [from, to]) in ranges().enumerate() {
            if i % ITEMS_PER_CHECK == 0 {
                stage.check()?;
            }
            total += (to[0] - from[0] + 1) * (to[1] - from[1] + 1);
            if total > CELLS_PER_TRIANGLE * n {
                return Ok(None);
            }
            for y in from[1]..=to[1] {
                starts[y * columns + from[0]..=y * columns + to[0]].iter_mut().for_each(|s| *s += 1);
            }
        }
        let mut sum = 0;
        for s in &mut starts {
            sum += *s;
            *s = sum;
        }
        let mut items = try_filled(total, 0u32, CHARTS)?;
        for (i, [from, to]) in ranges().enumerate() {
            if i % ITEMS_PER_CHECK == 0 {
                stage.check()?;
            }
            for y in from[1]..=to[1] {
                for s in &mut starts[y * columns + from[0]..=y * columns + to[0]] {
                    *s -= 1;
                    items[*s as usize] = i as u32;
                }
            }
        }
        Ok(Some(Cells { starts, items }))
    }
}

/// Whether two counter-clockwise triangles overlap by more than `touch`: no edge of either separates them.
fn overlap(a: &[DVec2; 3], b: &[DVec2; 3], touch: f64) -> bool {
    let separates = |from: &[DVec2; 3], other: &[DVec2; 3]| {
        (0..3).any(|k| {
            let edge = from[(k + 1) % 3] - from[k];
            let inside = |p: &DVec2| edge.perp_dot(*p - from[k]) > touch * edge.length();
            !other.iter().any(inside)
        })
    };
    !separates(a, b) && !separates(b, a)
}

/// Makes charts for the triangles marked in `which`: pairs of nearly coplanar triangles, longest shared edges first,
/// and single triangles. The triangles of a pair lie on different sides of their edge, so they do not overlap in
/// projection.
pub(super) fn planar_pieces(device: &Device, geometry: &Geometry, which: &[bool], stage: &Stage) -> Result<Vec<Piece>> {
    if !which.contains(&true) {
        return Ok(Vec::new());
    }
    let neighbours = geometry.neighbours(device, stage)?;
    let mut candidates = Vec::new();
    for t in (0..which.len()).filter(|&t| which[t]) {
        for (k, &n) in neighbours[t].iter().enumerate() {
            let open = n != NONE && which[n as usize] && n as usize > t;
            if open && geometry.normals[t].dot(geometry.normals[n as usize]) > PAIR_COSINE {
                let corners = geometry.corners(t);
                let length = corners[k].distance_squared(corners[(k + 1) % 3]);
                try_push(&mut candidates, (length, t, n as usize), CHARTS)?;
            }
        }
    }
    candidates.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    let mut partner = try_filled(which.len(), None, CHARTS)?;
    for (_, a, b) in candidates {
        if partner[a].is_none() && partner[b].is_none() {
            (partner[a], partner[b]) = (Some(b), Some(a));
        }
    }
    let first = (0..which.len()).filter(|&t| which[t] && partner[t].is_none_or(|p| p > t));
    try_collect(first.map(|t| planar_piece(geometry, t, partner[t])), CHARTS)
}

/// Makes a chart of a triangle and its partner, if any, projected on their plane, with the longest outer edge along x.
fn planar_piece(geometry: &Geometry, triangle: usize, partner: Option<usize>) -> Piece {
    let members: Vec<usize> = [Some(triangle), partner].into_iter().flatten().collect();
    let normal = members.iter().map(|&t| geometry.normals[t]).sum::<DVec3>().normalize_or(DVec3::Z);
    let inner = |edge: [u32; 2]| {
        let other = partner.map_or([NONE; 3], |p| geometry.indices[p]);
        other.contains(&edge[0]) && other.contains(&edge[1])
    };
    let ends = geometry.indices[triangle];
    let longest = (0..3)
        .map(|k| [ends[k], ends[(k + 1) % 3]])
        .filter(|&e| !inner(e))
        .map(|e| e.map(|v| geometry.positions[v as usize].as_dvec3()))
        .map(|[start, end]| end - start)
        .max_by(|a, b| a.length_squared().total_cmp(&b.length_squared()));
    let x =
        longest.map_or(DVec3::ZERO, |e| e.reject_from_normalized(normal)).normalize_or(normal.any_orthonormal_vector());
    let y = normal.cross(x);
    let origin = geometry.corners(triangle)[0];
    let project = |p: DVec3| DVec2::new((p - origin).dot(x), (p - origin).dot(y)).as_vec2().to_array();
    Piece {
        triangles: members.iter().map(|&t| geometry.triangles[t]).collect(),
        corners: members.iter().map(|&t| geometry.corners(t).map(project)).collect(),
        given: None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::progress::Progress;
    use crate::lightmap::atlas::charts::tests::{grid, scene_on};

    #[test]
    fn planar_charts_hold_each_triangle_once_in_true_shape() {
        let scene = scene_on(1, grid(9, 7, |x, y| ((x * x + y) % 4) as f32 * 0.02));
        let progress = Progress::none();
        let stage = progress.stage("unwrap", 0.0, 1.0, 1);
        let triangles: Vec<u32> = (0..scene.triangle_count()).collect();
        let geometry = Geometry::of(&scene, &triangles, &stage).unwrap();
        let pieces = planar_pieces(scene.device(), &geometry, &vec![true; geometry.triangles.len()], &stage).unwrap();
        let mut triangles: Vec<u32> = pieces.iter().flat_map(|p| p.triangles.to_vec()).collect();
        triangles.sort_unstable();
        assert!(triangles.iter().copied().eq(0..scene.triangle_count()));
        // Nearly all pair up across a diagonal.
        assert!(pieces.len() < 80, "{} charts for 63 squares", pieces.len());
        for p in &pieces {
            for (t, c) in p.triangles.iter().zip(&p.corners) {
                let corners = geometry.corners(*t as usize);
                for k in 0..3 {
                    let flat = DVec2::new((c[k][0] - c[(k + 1) % 3][0]) as f64, (c[k][1] - c[(k + 1) % 3][1]) as f64);
                    let length = corners[k].distance(corners[(k + 1) % 3]);
                    assert!((flat.length() / length - 1.0).abs() < 0.005);
                }
            }
        }
    }

    fn triangles(points: &[[f64; 6]]) -> Vec<[DVec2; 3]> {
        points.iter().map(|p| [0, 2, 4].map(|i| DVec2::new(p[i], p[i + 1]))).collect()
    }

    #[test]
    fn overlaps_are_found_and_contacts_are_none() {
        let progress = Progress::none();
        let stage = progress.stage("unwrap", 0.0, 1.0, 1);
        let fan = [[0.0, 0.0, 1.0, 0.0, 1.0, 1.0], [0.0, 0.0, 1.0, 1.0, 0.0, 1.0], [0.0, 0.0, 0.0, 1.0, -1.0, 1.0]];
        let with = |more: [f64; 6]| overlaps_itself(&triangles(&[&fan[..], &[more]].concat()), &stage).unwrap();
        // Beside, with a common edge, with a common corner.
        assert!(!with([2.0, 0.0, 3.0, 0.0, 3.0, 1.0]));
        assert!(!with([0.0, 0.0, -1.0, 1.0, -1.0, 0.0]));
        assert!(!with([1.0, 1.0, 2.0, 1.0, 2.0, 2.0]));
        // The same again, one inside, one across, and one that only just reaches in.
        assert!(with(fan[1]));
        assert!(with([0.7, 0.3, 0.8, 0.3, 0.8, 0.4]));
        assert!(with([-2.0, 0.4, 2.0, 0.4, 2.0, 0.6]));
        assert!(with([0.99, 0.5, 2.0, 0.0, 2.0, 1.0]));
    }

    #[test]
    fn rectangles_lie_straight() {
        // A rectangle of 2 by 1, turned, with points within.
        let x = DVec2::from_angle(0.3);
        let at = |u: f64, v: f64| u * x + v * x.perp();
        let mut points = vec![at(0.0, 0.0), at(1.0, 0.5), at(2.0, 1.0), at(0.0, 1.0), at(2.0, 0.0), at(1.0, 0.0)];
        let mut triangles =
            vec![[at(0.0, 0.0), at(2.0, 0.0), at(2.0, 1.0)], [at(0.0, 0.0), at(2.0, 1.0), at(0.0, 1.0)]];
        assert_eq!(convex_hull(&mut points.clone()).unwrap().len(), 4);
        turn_upright(&mut triangles, &mut points).unwrap();
        let corners = || triangles.iter().flatten().copied();
        let size = corners().fold(DVec2::NEG_INFINITY, DVec2::max) - corners().fold(DVec2::INFINITY, DVec2::min);
        assert!(size.distance(DVec2::new(2.0, 1.0)) < 1e-9, "{size}");
        assert!(convex_hull(&mut []).unwrap().is_empty());
    }

    #[test]
    fn a_flat_region_between_creases_is_projected_and_one_beside_a_bend_is_not() {
        // Two halves of a floor, bent in the middle.
        let pieces_at = |slope: f32| {
            let scene = scene_on(1, grid(8, 4, |x, _| slope * x.saturating_sub(4) as f32));
            let progress = Progress::none();
            let stage = progress.stage("unwrap", 0.0, 1.0, 1);
            let all: Vec<u32> = (0..scene.triangle_count()).collect();
            let geometry = Geometry::of(&scene, &all, &stage).unwrap();
            let neighbours = geometry.neighbours(scene.device(), &stage).unwrap();
            let regions = flat_regions(&geometry, &neighbours, &all, &stage).unwrap();
            let piece = |r| flat_piece(&geometry, &neighbours, regions.get(r), &stage).unwrap();
            (0..regions.len()).filter_map(piece).map(|p| p.triangles.len()).collect::<Vec<_>>()
        };
        assert_eq!(pieces_at(0.0), [64]);
        assert_eq!(pieces_at(0.5), [0; 0]);
        assert_eq!(pieces_at(100.0), [32, 32]);
    }
}
