//! Triangles in texel coordinates: the texels that they touch, and the part of a texel that they cover.
//!
//! Geometry is computed in f64. Triangles that share an edge compute the same crossings with texel rows, so that no
//! centre falls between them.

use glam::DVec2;

/// A triangle in texel coordinates.
#[derive(Clone, Copy, Debug)]
pub(in crate::lightmap) struct Flat(pub(in crate::lightmap) [DVec2; 3]);

impl Flat {
    pub(in crate::lightmap) fn bounds(&self) -> (DVec2, DVec2) {
        let [a, b, c] = self.0;
        (a.min(b).min(c), a.max(b).max(c))
    }

    /// Returns the number of texels of the bounding box that lie in a window of `size`, at least 1.
    pub(in crate::lightmap) fn box_texels(&self, size: [i64; 2]) -> u64 {
        let (lower, upper) = self.bounds();
        let extent = (upper - lower + 1.0).clamp(DVec2::ONE, DVec2::new(size[0] as f64, size[1] as f64));
        (extent.x * extent.y) as u64
    }

    /// Whether the triangle lies in at most four texels of a window of `size`, and all of them are `such`: few of the
    /// triangles that are smaller than texels need a closer look. (With a cheaper comparison of instances, charts and texels
    /// of 20 million took 3.5 instead of 4.2 s.)
    pub(in crate::lightmap) fn lies_in_few(&self, size: [i64; 2], such: impl Fn(i64, i64) -> bool) -> bool {
        let (lower, upper) = self.bounds();
        let range = |from: f64, to: f64, size: i64| {
            let first = (from.floor() as i64).clamp(0, size - 1);
            first..=(to.floor() as i64).clamp(first, size - 1)
        };
        let (rows, columns) = (range(lower.y, upper.y, size[1]), range(lower.x, upper.x, size[0]));
        rows.end() - rows.start() <= 1
            && columns.end() - columns.start() <= 1
            && rows.into_iter().all(|y| columns.clone().all(|x| such(x, y)))
    }

    /// Returns the ends of the longest edge, as numbers of corners.
    pub(in crate::lightmap) fn longest_edge(&self) -> (usize, usize) {
        let length = |(i, j): (usize, usize)| self.0[i].distance_squared(self.0[j]);
        [(0, 1), (1, 2), (2, 0)].into_iter().fold((0, 1), |m, e| if length(e) > length(m) { e } else { m })
    }

    /// Returns least and greatest x of the triangle's part with y in [y0, y1]; (+∞, −∞) if there is none.
    pub(in crate::lightmap) fn slab(&self, y0: f64, y1: f64) -> (f64, f64) {
        let (mut left, mut right) = (f64::INFINITY, f64::NEG_INFINITY);
        let mut include = |x: f64| (left, right) = (left.min(x), right.max(x));
        for k in 0..3 {
            // Ends are ordered, so that both triangles of an edge compute equal crossings.
            let (p, q) = (self.0[k], self.0[(k + 1) % 3]);
            let (p, q) = if (p.y, p.x) <= (q.y, q.x) { (p, q) } else { (q, p) };
            for end in [p, q] {
                if (y0..=y1).contains(&end.y) {
                    include(end.x);
                }
            }
            for y in [y0, y1] {
                if p.y < y && y < q.y {
                    let x = p.x + (y - p.y) / (q.y - p.y) * (q.x - p.x);
                    include(x.clamp(p.x.min(q.x), p.x.max(q.x)));
                }
            }
        }
        (left, right)
    }

    /// Calls `f` with each texel of a window of `size` whose square the triangle overlaps, row by
    /// row. A triangle without width in a direction lies in the texel above and to the right.
    pub(in crate::lightmap) fn for_each_touched(&self, size: [i64; 2], mut f: impl FnMut(i64, i64)) {
        let (lower, upper) = self.bounds();
        let texels = |from: f64, to: f64, size: i64| {
            let first = (from.floor() as i64).clamp(0, size - 1);
            first..=((to.ceil() as i64) - 1).clamp(first, size - 1)
        };
        for y in texels(lower.y, upper.y, size[1]) {
            let (left, right) = self.slab(y as f64, y as f64 + 1.0);
            // Outside the window in y (rounding, or given UVs just beyond the page): nearest row.
            let (left, right) = if left <= right { (left, right) } else { (lower.x, upper.x) };
            for x in texels(left, right, size[0]) {
                f(x, y);
            }
        }
    }

    /// Returns the part of the triangle in the square of texel (x, y).
    pub(in crate::lightmap) fn clip(&self, x: i64, y: i64) -> Polygon {
        let mut polygon = Polygon { points: [DVec2::ZERO; 8], count: 3 };
        polygon.points[..3].copy_from_slice(&self.0);
        let (x, y) = (x as f64, y as f64);
        for (axis, bound, sign) in [(0, x, 1.0), (0, x + 1.0, -1.0), (1, y, 1.0), (1, y + 1.0, -1.0)] {
            polygon = polygon.cut(axis, bound, sign);
        }
        polygon
    }

    /// Returns the triangle's point in texel (x, y), which it touches, that is nearest to the texel's centre, and its
    /// squared distance.
    pub(in crate::lightmap) fn nearest_in_texel(&self, x: i64, y: i64) -> (DVec2, f64) {
        let corner = DVec2::new(x as f64, y as f64);
        let centre = corner + 0.5;
        let polygon = self.clip(x, y);
        let mut best = (corner, f64::INFINITY);
        let mut consider = |p: DVec2| {
            let p = p.clamp(corner, corner + 1.0);
            if p.distance_squared(centre) < best.1 {
                best = (p, p.distance_squared(centre));
            }
        };
        let points = &polygon.points[..polygon.count];
        for (k, &p) in points.iter().enumerate() {
            consider(nearest_on_segment(p, points[(k + 1) % points.len()], centre));
        }
        // If rounding leaves no part, the triangle's border is used, moved into the texel.
        if points.is_empty() {
            for k in 0..3 {
                consider(nearest_on_segment(self.0[k], self.0[(k + 1) % 3], centre));
            }
        }
        best
    }

    /// Returns the centroid of the triangle's part in texel (x, y), which it touches; for a part without width, the
    /// point nearest to the texel's centre.
    pub(in crate::lightmap) fn centroid_in_texel(&self, x: i64, y: i64) -> DVec2 {
        let corner = DVec2::new(x as f64, y as f64);
        let (area, centroid) = self.clip(x, y).area_and_centroid();
        if area > THIN { centroid.clamp(corner, corner + 1.0) } else { self.nearest_in_texel(x, y).0 }
    }

    /// Returns the weights of corners 1 and 2 for a point of the triangle; points just outside are moved in.
    ///
    /// The position along the longest edge comes first, which is well defined in every triangle. The position across
    /// it, in a sliver a quotient of rounding errors, is then limited to the triangle. So the weights' point is never
    /// farther from `p` than the triangle is high.
    pub(in crate::lightmap) fn weights(&self, p: DVec2) -> [f64; 2] {
        let (i, j) = self.longest_edge();
        let k = 3 - i - j;
        let [origin, edge, apex] = [self.0[i], self.0[j] - self.0[i], self.0[k] - self.0[i]];
        let along = fraction_on_segment(origin, self.0[j], p);
        let apex_along = fraction_on_segment(origin, self.0[j], self.0[k]);
        let height = edge.perp_dot(apex);
        let across = if height != 0.0 { edge.perp_dot(p - origin) / height } else { 0.0 };
        let most_of = |along: f64, apex_along: f64| if apex_along > 0.0 { along / apex_along } else { f64::INFINITY };
        let most = most_of(along, apex_along).min(most_of(1.0 - along, 1.0 - apex_along));
        let mut weights = [0.0; 3];
        weights[k] = across.max(0.0).min(most);
        weights[j] = (along - weights[k] * apex_along).max(0.0);
        weights[i] = 1.0 - weights[j] - weights[k];
        [weights[1].max(0.0), weights[2].max(0.0)]
    }
}

/// Area of parts of texels below which they are taken for lines, as it would be a difference of rounding errors.
const THIN: f64 = 1e-9;

/// A triangle clipped by up to four half-planes.
pub(in crate::lightmap) struct Polygon {
    points: [DVec2; 8],
    count: usize,
}

impl Polygon {
    /// Returns the part in which sign · coordinate ≥ sign · bound (Sutherland and Hodgman 1974).
    pub(in crate::lightmap) fn cut(&self, axis: usize, bound: f64, sign: f64) -> Polygon {
        let mut out = Polygon { points: [DVec2::ZERO; 8], count: 0 };
        let mut push = |p: DVec2| {
            // A convex polygon gains at most one corner per cut; rounding cannot exceed the array.
            if out.count < 8 {
                out.points[out.count] = p;
                out.count += 1;
            }
        };
        let points = &self.points[..self.count];
        for (k, &p) in points.iter().enumerate() {
            let q = points[(k + 1) % points.len()];
            let (dp, dq) = (sign * (p[axis] - bound), sign * (q[axis] - bound));
            if dp >= 0.0 {
                push(p);
            }
            if (dp > 0.0 && dq < 0.0) || (dp < 0.0 && dq > 0.0) {
                let mut crossing = p + (q - p) * (dp / (dp - dq));
                crossing[axis] = bound;
                push(crossing);
            }
        }
        out
    }

    /// Returns area and centroid; the centroid is meaningless if there is no area.
    pub(in crate::lightmap) fn area_and_centroid(&self) -> (f64, DVec2) {
        let points = &self.points[..self.count];
        let origin = points.first().copied().unwrap_or_default();
        let (mut area, mut sum) = (0.0, DVec2::ZERO);
        for w in points.windows(2) {
            let (p, q) = (w[0] - origin, w[1] - origin);
            let part = 0.5 * p.perp_dot(q).abs();
            area += part;
            sum += part * (p + q) / 3.0;
        }
        (area, origin + sum / area)
    }
}

fn fraction_on_segment(a: DVec2, b: DVec2, p: DVec2) -> f64 {
    let length = (b - a).length_squared();
    if length > 0.0 { ((p - a).dot(b - a) / length).clamp(0.0, 1.0) } else { 0.0 }
}

fn nearest_on_segment(a: DVec2, b: DVec2, p: DVec2) -> DVec2 {
    a + (b - a) * fraction_on_segment(a, b, p)
}
