//! Rays against triangles in f64: by brute force, and through a plain binary BVH (binned surface
//! area heuristic, Wald 2007; ordered traversal).
//!
//! The triangle test takes the signs of three edge functions d · (p × q) with p, q relative to the
//! ray's origin. For the two triangles of an edge they are exact negatives of each other, and what
//! may be zero counts as inside, so that no ray passes between them.

use crate::scene::{MAX_COORDINATE, Mesh};
use crate::trace::Ray;
use glam::{DVec3, Vec3};

/// A ray in f64: points `origin + t · direction` with `tmin < t ≤ tmax`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray64 {
    /// Origin, in scene units.
    pub origin: DVec3,
    /// Direction, of any length.
    pub direction: DVec3,
    /// Lower limit of t, exclusive, in multiples of the direction's length.
    pub tmin: f64,
    /// Upper limit of t, inclusive.
    pub tmax: f64,
}

impl Ray64 {
    /// The ray from `origin` along `direction` with `0 < t`.
    pub fn new(origin: DVec3, direction: DVec3) -> Self {
        Ray64 { origin, direction, tmin: 0.0, tmax: f64::INFINITY }
    }
}

impl From<&Ray> for Ray64 {
    fn from(ray: &Ray) -> Self {
        Ray64 {
            origin: Vec3::from_array(ray.origin).as_dvec3(),
            direction: Vec3::from_array(ray.direction).as_dvec3(),
            tmin: ray.tmin as f64,
            tmax: ray.tmax as f64,
        }
    }
}

/// A closest hit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit64 {
    /// Distance in multiples of the direction's length.
    pub t: f64,
    /// Weight of corner 1.
    pub u: f64,
    /// Weight of corner 2.
    pub v: f64,
    /// Global triangle number.
    pub triangle: u32,
}

/// Bound of the rounding error of d · (p × q) relative to |d| · |p| · |q|: ten operations deep at most.
const ROUNDING: f64 = 10.0 * f64::EPSILON;

/// A triangle and its global number.
#[derive(Clone, Copy, Debug)]
pub(super) struct Triangle {
    pub corners: [Vec3; 3],
    pub number: u32,
}

/// The edge functions of a ray and a triangle.
pub(super) struct Edges {
    /// Corners relative to the ray's origin.
    pub corners: [DVec3; 3],
    /// d · (p × q) for the edge opposite to each corner.
    pub weights: [f64; 3],
}

impl Triangle {
    #[inline(always)]
    pub fn edges(&self, ray: &Ray64) -> Edges {
        let [a, b, c] = self.corners.map(|p| p.as_dvec3() - ray.origin);
        let d = ray.direction;
        Edges { corners: [a, b, c], weights: [d.dot(b.cross(c)), d.dot(c.cross(a)), d.dot(a.cross(b))] }
    }

    /// The hit with `tmin < t ≤ limit`.
    #[inline(always)]
    fn hit(&self, ray: &Ray64, limit: f64) -> Option<Hit64> {
        let Edges { corners: [a, b, c], weights } = self.edges(ray);
        let normal = (b - a).cross(c - a);
        let slope = normal.dot(ray.direction);
        let outside = weights.map(|w| w * -slope.signum()).into_iter().fold(0.0, f64::max);
        if outside > 0.0 {
            // Edge functions within their rounding error count as 0, or a ray through a vertex
            // might find itself outside of all triangles around it.
            let reach = a.length_squared().max(b.length_squared()).max(c.length_squared());
            if outside * outside > ROUNDING * ROUNDING * ray.direction.length_squared() * reach * reach {
                return None;
            }
        }
        let t = normal.dot(a) / slope;
        let sum = weights[0] + weights[1] + weights[2];
        // A NaN or infinite t (the ray lies in the plane) fails.
        (t > ray.tmin && t <= limit && t.is_finite() && sum != 0.0).then(|| Hit64 {
            t,
            u: weights[1] / sum,
            v: weights[2] / sum,
            triangle: self.number,
        })
    }
}

/// Keeps the nearer of two hits, of equally near ones that with the lower number.
#[inline(always)]
fn keep_nearer(best: &mut Option<Hit64>, hit: Hit64) {
    if best.is_none_or(|b| (hit.t, hit.triangle) < (b.t, b.triangle)) {
        *best = Some(hit);
    }
}

/// 32 bytes. The corners are f32 numbers, so their bounds are exact.
#[derive(Clone, Copy, Debug)]
struct Node {
    lower: Vec3,
    /// Leaf: its first triangle. Inner node: its second child; the first is the next node.
    first: u32,
    upper: Vec3,
    /// Triangles of a leaf; 0: an inner node.
    count: u32,
}

const BINS: usize = 16;
const MAX_LEAF: usize = 4;
/// Below this depth nodes are halved by count, which bounds the depth at this plus 28.
const MAX_SAH_DEPTH: usize = 60;
const STACK: usize = 96;

/// All valid triangles of a scene.
pub struct Geometry {
    triangles: Vec<Triangle>,
    nodes: Vec<Node>,
    lower: DVec3,
    upper: DVec3,
}

impl Geometry {
    /// Takes the triangles of `meshes`, numbered through, leaving out those without area and those
    /// with coordinates that are not valid.
    pub fn new(meshes: &[Mesh]) -> Self {
        let mut triangles = Vec::new();
        let mut number = 0;
        for mesh in meshes {
            for t in 0..mesh.indices.len() {
                let triangle = Triangle { corners: mesh.corners(t), number };
                if has_area(&triangle) {
                    triangles.push(triangle);
                }
                number += 1;
            }
        }
        let mut builder = Builder { triangles, nodes: Vec::new() };
        builder.build();
        let Builder { triangles, nodes } = builder;
        let (lower, upper) = nodes.first().map_or(Default::default(), |n| (n.lower.as_dvec3(), n.upper.as_dvec3()));
        Geometry { triangles, nodes, lower, upper }
    }

    /// Lower and upper corner of the bounding box.
    pub fn bounds(&self) -> (DVec3, DVec3) {
        (self.lower, self.upper)
    }

    /// Closest hit, by testing every triangle.
    pub fn closest_brute(&self, ray: &Ray64) -> Option<Hit64> {
        let mut best = None;
        self.triangles.iter().filter_map(|t| t.hit(ray, ray.tmax)).for_each(|h| keep_nearer(&mut best, h));
        best
    }

    /// Closest hit; of several at equal t that with the lowest number.
    pub fn closest(&self, ray: &Ray64) -> Option<Hit64> {
        self.closest_of(ray, |_| true)
    }

    /// The same among the hits that `accept` accepts. It is asked about every hit that is nearer than what it has
    /// accepted so far, once.
    pub(super) fn closest_of(&self, ray: &Ray64, mut accept: impl FnMut(&Hit64) -> bool) -> Option<Hit64> {
        let mut best: Option<Hit64> = None;
        self.traverse(ray, 0.0, |triangle, limit| {
            if let Some(hit) = triangle.hit(ray, limit)
                && accept(&hit)
            {
                keep_nearer(&mut best, hit);
            }
            best.map_or(ray.tmax, |b| b.t)
        });
        best
    }

    /// Whether anything lies on the ray.
    pub fn occluded(&self, ray: &Ray64) -> bool {
        let mut found = false;
        self.traverse(ray, 0.0, |triangle, limit| {
            found |= triangle.hit(ray, limit).is_some();
            // A limit that nothing satisfies ends the traversal.
            if found { f64::NEG_INFINITY } else { limit }
        });
        found
    }

    /// Calls `visit(triangle, limit)` for the triangles whose boxes, grown by `margin`, the ray
    /// enters before `limit`, roughly from near to far; `visit` returns the new limit.
    #[inline(always)]
    pub(super) fn traverse(&self, ray: &Ray64, margin: f64, mut visit: impl FnMut(&Triangle, f64) -> f64) {
        let slabs = Slabs::new(ray, margin);
        let mut limit = ray.tmax;
        let mut stack = [(0u32, 0.0f64); STACK];
        let mut depth = 0;
        let Some(root) = self.nodes.first() else { return };
        let Some(mut near) = slabs.enter(root, limit) else { return };
        let mut current = 0u32;
        loop {
            let node = &self.nodes[current as usize];
            if near <= limit {
                if node.count > 0 {
                    for triangle in &self.triangles[node.first as usize..(node.first + node.count) as usize] {
                        limit = visit(triangle, limit);
                    }
                } else {
                    let (a, b) = (current + 1, node.first);
                    let hits =
                        (slabs.enter(&self.nodes[a as usize], limit), slabs.enter(&self.nodes[b as usize], limit));
                    match hits {
                        (Some(ta), Some(tb)) => {
                            let (first, second) = if ta <= tb { ((a, ta), (b, tb)) } else { ((b, tb), (a, ta)) };
                            stack[depth] = second;
                            depth += 1;
                            (current, near) = first;
                            continue;
                        }
                        (Some(ta), None) => {
                            (current, near) = (a, ta);
                            continue;
                        }
                        (None, Some(tb)) => {
                            (current, near) = (b, tb);
                            continue;
                        }
                        (None, None) => {}
                    }
                }
            }
            if depth == 0 {
                return;
            }
            depth -= 1;
            (current, near) = stack[depth];
        }
    }
}

fn has_area(triangle: &Triangle) -> bool {
    let valid = triangle.corners.iter().flat_map(|c| c.to_array()).all(|x| x.abs() <= MAX_COORDINATE);
    let [a, b, c] = triangle.corners.map(|c| c.as_dvec3());
    valid && (b - a).cross(c - a).length_squared() > 0.0
}

/// A ray prepared for box tests.
struct Slabs {
    origin: DVec3,
    inverse: DVec3,
    margin: DVec3,
    tmin: f64,
}

impl Slabs {
    fn new(ray: &Ray64, margin: f64) -> Self {
        // A direction component of 0 would make 0 · ∞ = NaN. With this one instead, and no box flat,
        // a ray within a box's face is inside for all t that matter.
        let nonzero = |d: f64| if d.abs() < 1e-200 { 1e-200f64.copysign(d) } else { d };
        let margin = margin.max(1e-100);
        let d = ray.direction;
        let inverse = DVec3::new(nonzero(d.x), nonzero(d.y), nonzero(d.z)).recip();
        Slabs { origin: ray.origin, inverse, margin: DVec3::splat(margin), tmin: ray.tmin }
    }

    /// Distance at which the ray enters the node's box, if that is before `limit`. Never misses by rounding:
    /// both ends move outward by more than the error of a subtraction and a product.
    #[inline(always)]
    fn enter(&self, node: &Node, limit: f64) -> Option<f64> {
        let a = ((node.lower.as_dvec3() - self.origin) - self.margin) * self.inverse;
        let b = ((node.upper.as_dvec3() - self.origin) + self.margin) * self.inverse;
        let (near, far) = (a.min(b), a.max(b));
        let grow = |t: f64, sign: f64| t + sign * 4.0 * f64::EPSILON * t.abs();
        let near = grow(near.x.max(near.y).max(near.z), -1.0).max(self.tmin);
        let far = grow(far.x.min(far.y).min(far.z), 1.0);
        (near <= far && near <= limit).then_some(near)
    }
}

struct Builder {
    triangles: Vec<Triangle>,
    nodes: Vec<Node>,
}

/// A growing box.
#[derive(Clone, Copy)]
struct Bounds(Vec3, Vec3);

impl Bounds {
    const EMPTY: Bounds = Bounds(Vec3::INFINITY, Vec3::NEG_INFINITY);

    fn of(triangle: &Triangle) -> Self {
        let [a, b, c] = triangle.corners;
        Bounds(a.min(b).min(c), a.max(b).max(c))
    }

    fn join(self, other: Bounds) -> Bounds {
        Bounds(self.0.min(other.0), self.1.max(other.1))
    }

    /// Half the surface area, in f64: extents up to 1e18 do not overflow.
    fn half_area(self) -> f64 {
        let e = (self.1.as_dvec3() - self.0.as_dvec3()).max(DVec3::ZERO);
        e.x * e.y + e.y * e.z + e.z * e.x
    }
}

/// Twice the centre of a triangle's box.
fn centroid(triangle: &Triangle) -> Vec3 {
    let Bounds(lower, upper) = Bounds::of(triangle);
    lower + upper
}

impl Builder {
    fn build(&mut self) {
        if !self.triangles.is_empty() {
            self.nodes.reserve(self.triangles.len());
            self.node(0, self.triangles.len(), 0);
        }
    }

    /// Makes the node of a range of triangles, and those below it.
    fn node(&mut self, first: usize, count: usize, depth: usize) {
        let range = &self.triangles[first..first + count];
        let bounds = range.iter().map(Bounds::of).fold(Bounds::EMPTY, Bounds::join);
        let index = self.nodes.len();
        self.nodes.push(Node { lower: bounds.0, first: first as u32, upper: bounds.1, count: count as u32 });
        let Some(left) = self.split(first, count, depth) else { return };
        self.node(first, left, depth + 1);
        let second = self.nodes.len() as u32;
        self.nodes[index] = Node { first: second, count: 0, ..self.nodes[index] };
        self.node(first + left, count - left, depth + 1);
    }

    /// Sorts a range of triangles into two sides and returns how many are on the first; `None`: a leaf.
    fn split(&mut self, first: usize, count: usize, depth: usize) -> Option<usize> {
        if count <= MAX_LEAF {
            return None;
        }
        let range = &mut self.triangles[first..first + count];
        let centers = range.iter().map(centroid).fold(Bounds::EMPTY, |b, c| b.join(Bounds(c, c)));
        let extent = centers.1 - centers.0;
        let axis = (0..3).fold(0, |best, i| if extent[i] > extent[best] { i } else { best });
        if extent[axis] > 0.0 && depth < MAX_SAH_DEPTH {
            let bin = |t: &Triangle| {
                let x = (centroid(t)[axis] - centers.0[axis]) / extent[axis];
                ((x * BINS as f32) as usize).min(BINS - 1)
            };
            let plane = best_plane(range, bin);
            let left = partition(range, |t| bin(t) < plane);
            if left > 0 && left < count {
                return Some(left);
            }
        }
        let middle = count / 2;
        range.select_nth_unstable_by(middle, |a, b| {
            centroid(a)[axis].total_cmp(&centroid(b)[axis]).then(a.number.cmp(&b.number))
        });
        Some(middle)
    }
}

/// The first bin of the second side where the surface area heuristic's cost is least.
fn best_plane(range: &[Triangle], bin: impl Fn(&Triangle) -> usize) -> usize {
    let mut bins = [(Bounds::EMPTY, 0usize); BINS];
    for t in range {
        let (bounds, count) = &mut bins[bin(t)];
        *bounds = bounds.join(Bounds::of(t));
        *count += 1;
    }
    let side = |bins: &mut dyn Iterator<Item = &(Bounds, usize)>| {
        let (bounds, count) = bins.fold((Bounds::EMPTY, 0), |(b, n), x| (b.join(x.0), n + x.1));
        if count == 0 { 0.0 } else { bounds.half_area() * count as f64 }
    };
    let cost = |plane: &usize| side(&mut bins[..*plane].iter()) + side(&mut bins[*plane..].iter());
    (1..BINS).min_by(|a, b| cost(a).total_cmp(&cost(b))).unwrap_or(1)
}

/// Moves those that satisfy `first` to the front and returns how many they are.
fn partition(range: &mut [Triangle], first: impl Fn(&Triangle) -> bool) -> usize {
    let mut count = 0;
    for i in 0..range.len() {
        if first(&range[i]) {
            range.swap(i, count);
            count += 1;
        }
    }
    count
}

#[cfg(test)]
mod tests {
    use super::super::Random;
    use super::*;
    use crate::scene::demo::shapes::MeshBuilder;
    use proptest::prelude::*;

    fn soup(corners: &[[Vec3; 3]]) -> Geometry {
        let positions = corners.concat();
        let indices = (0..corners.len() as u32).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
        Geometry::new(&[Mesh { positions: positions.into(), indices, ..Default::default() }])
    }

    /// Points on a coarse grid: many coincident and axis-parallel things.
    fn grid_point() -> impl Strategy<Value = Vec3> {
        [-3i8..4, -3i8..4, -3i8..4].prop_map(|p| Vec3::from_array(p.map(|x| x as f32 * 0.5)))
    }

    proptest! {
        #[test]
        fn the_tree_finds_what_brute_force_finds(
            corners in prop::collection::vec([grid_point(), grid_point(), grid_point()], 1..80),
            origin in grid_point(),
            target in grid_point(),
        ) {
            let geometry = soup(&corners);
            let ray = Ray64::new(origin.as_dvec3(), (target - origin).as_dvec3());
            let expected = geometry.closest_brute(&ray);
            prop_assert_eq!(geometry.closest(&ray), expected);
            prop_assert_eq!(geometry.occluded(&ray), expected.is_some());
            if let Some(hit) = expected {
                let short = Ray64 { tmax: hit.t, ..ray };
                prop_assert_eq!(geometry.closest(&short), expected);
                let shorter = Ray64 { tmax: hit.t * (1.0 - 1e-12), ..ray };
                prop_assert!(!geometry.occluded(&shorter));
            }
        }
    }

    #[test]
    fn a_large_soup_gives_the_same_hits_through_the_tree() {
        let mut random = Random::new(5, 0);
        let corners: Vec<[Vec3; 3]> = (0..3000)
            .map(|_| {
                let center = (random.direction() * random.uniform() * 3.0).as_vec3();
                std::array::from_fn(|_| center + (random.direction() * 0.2).as_vec3())
            })
            .collect();
        let geometry = soup(&corners);
        let mut hits = 0;
        for _ in 0..2000 {
            let ray = Ray64::new(random.direction() * 4.0, random.direction());
            let expected = geometry.closest_brute(&ray);
            assert_eq!(geometry.closest(&ray), expected);
            hits += expected.is_some() as u32;
        }
        assert!(hits > 100, "{hits}");
    }

    #[test]
    fn no_ray_leaves_a_closed_sphere_through_its_edges_or_vertices() {
        let mut builder = MeshBuilder::new();
        builder.sphere(Vec3::new(0.3, -0.2, 0.1), 1.0, 3, 0);
        let mesh = builder.finish();
        let geometry = Geometry::new(std::slice::from_ref(&mesh));
        let mut random = Random::new(6, 0);
        for t in 0..mesh.indices.len() {
            let origin = DVec3::new(0.3, -0.2, 0.1) + random.direction() * 0.7;
            let [a, b, _] = mesh.corners(t).map(Vec3::as_dvec3);
            for target in [a, (a + b) * 0.5, a.lerp(b, random.uniform())] {
                assert!(geometry.closest(&Ray64::new(origin, target - origin)).is_some());
                assert!(geometry.closest(&Ray64::new(origin, (target - origin).normalize())).is_some());
            }
        }
    }

    #[test]
    fn a_hit_is_where_its_barycentric_weights_say() {
        let corners = [Vec3::new(0.0, 0.0, 2.0), Vec3::new(3.0, 0.0, 1.0), Vec3::new(0.0, 2.0, 4.0)];
        let geometry = soup(&[corners]);
        let target = [0.5, 0.2, 0.3].iter().zip(corners).map(|(w, c)| c.as_dvec3() * *w).sum::<DVec3>();
        let origin = DVec3::new(-1.0, 7.0, -3.0);
        let hit = geometry.closest(&Ray64::new(origin, (target - origin) * 0.25)).unwrap();
        assert!((hit.t - 4.0).abs() < 1e-12 && (hit.u - 0.2).abs() < 1e-12 && (hit.v - 0.3).abs() < 1e-12);
    }
}
