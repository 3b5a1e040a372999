//! Rays through the compact tree of [`crate::bvh::compact`]: planes are decoded when they are tested, corners are read
//! from the meshes through their indices.
//!
//! Triangles are tested by the same arithmetic as in full trees. Boxes are larger than there, so that a ray reaches
//! leaves whose exact box it misses; a hit counts only if the ray intersects that box, computed from the corners. So
//! hits are those of full trees, bit for bit.

use super::tree::{Leaf, LeafRows, RaySetup, Tree};
use super::triangle::{Projected, Shear, V3, accurate_distance};
use crate::bvh::compact::{Compact, CompactNode, GONE, NUMBER, ORDER};
use crate::bvh::layout::{ChildRef, MAX_LEAF, WIDTH};
use crate::bvh::outwards;
use crate::scene::Mesh;
use crate::simd::{Eight, Four, Lanes, Simd, prefetch};
use glam::Vec3;
use std::mem::{MaybeUninit, offset_of};

/// A compact tree together with the meshes that it was built of.
#[derive(Clone, Copy)]
pub(crate) struct View<'a> {
    tree: &'a Compact,
    meshes: &'a [Mesh],
    /// First global triangle number per mesh, and the total at the end.
    first_triangle: &'a [u32],
}

impl<'a> View<'a> {
    /// # Safety
    /// The tree must have been built of these meshes, of which only positions may have changed since, not
    /// their number; the meshes must be [valid](Mesh::validate).
    #[inline(always)]
    pub(crate) unsafe fn new(tree: &'a Compact, meshes: &'a [Mesh], first_triangle: &'a [u32]) -> Self {
        View { tree, meshes, first_triangle }
    }

    /// Whether a child is a node of this tree.
    #[inline]
    pub(crate) fn has_node(&self, node: ChildRef) -> bool {
        node.node_index() < self.tree.nodes.len()
    }

    /// The corners of a triangle.
    ///
    /// # Safety
    /// The triangle must be one of the scene.
    #[inline(always)]
    unsafe fn corners(&self, triangle: u32) -> [*const f32; 3] {
        // SAFETY: forwarded.
        let (mut mesh, last) = unsafe { self.tree.mesh_range(triangle) };
        if mesh != last {
            let firsts = &self.first_triangle[mesh as usize + 1..=last as usize];
            mesh += firsts.partition_point(|&first| first <= triangle) as u32;
        }
        // SAFETY: meshes of the tree's blocks exist; the triangle is one of this mesh, which is valid, so that
        // its vertices exist.
        unsafe {
            let first = *self.first_triangle.get_unchecked(mesh as usize);
            let mesh = self.meshes.get_unchecked(mesh as usize);
            let vertices = mesh.indices.get_unchecked((triangle - first) as usize);
            let positions = mesh.positions.as_ptr();
            let [a, b, c] = *vertices;
            [positions.add(a as usize).cast(), positions.add(b as usize).cast(), positions.add(c as usize).cast()]
        }
    }
}

impl Tree for View<'_> {
    type Node = CompactNode;
    type Leaf<'a>
        = CompactLeaf<'a>
    where
        Self: 'a;

    const WIDTH: usize = WIDTH;
    type Lanes<S: Simd> = S::F8;
    const ROW: u32 = WIDTH as u32;
    /// Their order is by place.
    const IS_BY_WORTH: bool = false;

    #[inline(always)]
    fn prefetch(&self, child: ChildRef) {
        prefetch(self.tree.address(child));
    }

    /// Prefetches the first cache line alone: a node has 80 bytes, and a leaf only refers to its triangles.
    #[inline(always)]
    fn prefetch_whole(&self, child: ChildRef) {
        prefetch(self.tree.address(child));
    }

    #[inline(always)]
    unsafe fn node(&self, node: ChildRef) -> &CompactNode {
        // SAFETY: forwarded.
        unsafe { self.tree.node(node) }
    }

    #[inline(always)]
    unsafe fn planes<S: Simd>(node: &CompactNode, axis: usize, row: u32) -> S::F8 {
        let bytes = std::ptr::from_ref(node).cast::<u8>();
        // SAFETY: rows of eight bytes begin at `lower`; the caller vouches for the ISA. The product is exact,
        // so that the sum is the same with or without FMA.
        unsafe {
            let cells = S::F8::from_bytes(bytes.add(offset_of!(CompactNode, lower) + row as usize));
            cells.mul_add(S::F8::splat(node.cell(axis)), S::F8::splat(node.origin[axis]))
        }
    }

    #[inline(always)]
    fn names(node: &CompactNode, room: &mut MaybeUninit<[u32; WIDTH]>) -> *const u32 {
        room.write(node.names()).as_ptr()
    }

    #[inline(always)]
    fn order(_: &CompactNode) -> *const u32 {
        ORDER.as_ptr()
    }

    #[inline(always)]
    unsafe fn leaf<S: Simd>(&self, leaf: ChildRef) -> CompactLeaf<'_> {
        // SAFETY: forwarded.
        let triangles = unsafe { self.tree.leaf(leaf) };
        // SAFETY: eight numbers are readable from every leaf; the caller vouches for the ISA. No leaf holds
        // more, but here nothing shall depend on it.
        let ends = unsafe { S::F8::highest_bits(triangles) } | 1 << (MAX_LEAF - 1);
        CompactLeaf { view: self, triangles, count: ends.trailing_zeros() as usize + 1 }
    }
}

/// A leaf of a compact tree.
pub(super) struct CompactLeaf<'a> {
    view: &'a View<'a>,
    triangles: *const u32,
    count: usize,
}

impl CompactLeaf<'_> {
    /// # Safety
    /// `i` must be below the count.
    #[inline(always)]
    unsafe fn corners(&self, i: usize) -> [*const f32; 3] {
        // SAFETY: the leaf has `count` numbers, of triangles of the scene.
        unsafe { self.view.corners(self.triangles.add(i).read() & NUMBER) }
    }

    /// The box that this leaf has in a full tree without cut triangles.
    #[cold]
    fn outer_box(&self) -> (Vec3, Vec3) {
        let (mut lower, mut upper) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        for i in 0..self.count {
            // SAFETY: `i` is below the count. Corners are three floats.
            unsafe {
                if self.triangles.add(i).read() & GONE != 0 {
                    continue;
                }
                for corner in self.corners(i) {
                    let corner = corner.cast::<Vec3>().read();
                    (lower, upper) = (lower.min(corner), upper.max(corner));
                }
            }
        }
        outwards(lower, upper)
    }
}

/// Vectors from four corners to the origin, in the ray's frame. (Functions: closures were not inlined.)
///
/// # Safety
/// The CPU must have the ISA, and three floats must be readable at each pointer.
#[inline(always)]
unsafe fn relative<L: Four>(corners: [*const f32; 4], ray: &Shear) -> V3<L> {
    // SAFETY: forwarded.
    unsafe { V3 { x: along(corners, ray, 0), y: along(corners, ray, 1), z: along(corners, ray, 2) } }
}

/// # Safety
/// As for [`relative`]; the axis must be 0 to 2.
#[inline(always)]
unsafe fn along<L: Four>([a, b, c, d]: [*const f32; 4], ray: &Shear, axis: usize) -> L {
    let from = ray.axes[axis] as usize;
    // SAFETY: forwarded.
    unsafe { L::splat(ray.origin[axis]) - L::gather([a.add(from), b.add(from), c.add(from), d.add(from)]) }
}

impl Leaf for CompactLeaf<'_> {
    const ALWAYS_COUNTS: bool = false;

    #[inline(always)]
    fn rows(&self, room: &mut MaybeUninit<LeafRows>) -> *const f32 {
        let rows = room.write([0.0; size_of::<LeafRows>() / 4]);
        for i in 0..self.count {
            // SAFETY: `i` is below the count. Corners are three floats.
            let corners = unsafe { self.corners(i).map(|c| c.cast::<[f32; 3]>().read()) };
            for (k, corner) in corners.iter().enumerate() {
                for (a, &value) in corner.iter().enumerate() {
                    rows[(3 * k + a) * self.count + i] = value;
                }
            }
        }
        rows.as_ptr()
    }

    #[inline(always)]
    fn count(&self) -> usize {
        self.count
    }

    #[inline(always)]
    unsafe fn project<L: Four>(&self, first: usize, ray: &Shear) -> Projected<L> {
        let last = self.count - 1;
        // SAFETY: the last triangle takes the place of those beyond the count; the caller vouches for the ISA.
        unsafe {
            let [a0, b0, c0] = self.corners(first.min(last));
            let [a1, b1, c1] = self.corners((first + 1).min(last));
            let [a2, b2, c2] = self.corners((first + 2).min(last));
            let [a3, b3, c3] = self.corners((first + 3).min(last));
            let corners =
                [relative([a0, a1, a2, a3], ray), relative([b0, b1, b2, b3], ray), relative([c0, c1, c2, c3], ray)];
            Projected::new(corners, [L::splat(ray.shear[0]), L::splat(ray.shear[1])])
        }
    }

    #[inline(always)]
    unsafe fn accurate_distance(&self, i: usize, ray: &Shear) -> f32 {
        // SAFETY: forwarded; corners are three floats, which make a leaf of one triangle.
        unsafe {
            let rows = self.corners(i).map(|c| c.cast::<[f32; 3]>().read());
            accurate_distance(rows.as_ptr().cast(), 1, 0, ray)
        }
    }

    #[inline(always)]
    unsafe fn number(&self, i: usize) -> u32 {
        // SAFETY: the leaf has `count` numbers.
        unsafe { self.triangles.add(i).read() & NUMBER }
    }

    #[inline(always)]
    unsafe fn counts<S: Simd>(&self, i: usize, ray: &RaySetup, limit: f32) -> bool {
        // SAFETY: forwarded.
        if unsafe { self.triangles.add(i).read() } & GONE != 0 {
            return false;
        }
        let (lower, upper) = self.outer_box();
        // SAFETY: the caller vouches for the ISA.
        unsafe { ray.meets::<S, View>(lower, upper, limit) }
    }
}

#[cfg(test)]
mod tests {
    use crate::base::progress::Progress;
    use crate::base::sampling::{uniform, uniform_sphere};
    use crate::bvh::{BuildOptions, BuildQuality};
    use crate::device::{Device, DeviceOptions};
    use crate::scene::{Material, Mesh, Scene, SceneData};
    use crate::simd::Isa;
    use crate::trace::{Hit, Ray};
    use glam::Vec3;
    use proptest::prelude::*;
    use std::sync::{Arc, LazyLock};

    static DEVICES: LazyLock<Vec<Arc<Device>>> = LazyLock::new(|| {
        let device = |isa| Device::new(DeviceOptions { isa: Some(isa), num_threads: 1, ..Default::default() }).unwrap();
        Isa::available().map(device).collect()
    });

    fn point(i: u32, dimension: u32, seed: u32) -> Vec3 {
        Vec3::from_array([0, 1, 2].map(|a| uniform(i, dimension + a, seed))) * 2.0 - 1.0
    }

    /// Triangles of a kind within some units of 0.
    fn triangles(kind: u32, n: u32, seed: u32) -> Vec<[Vec3; 3]> {
        let snap = |v: Vec3| (3.0 * v).round();
        (0..n)
            .map(|i| {
                let (a, b, c) = (point(i, 0, seed), point(i, 3, seed), point(i, 6, seed));
                match kind {
                    0 => [a, a + 0.3 * b, a + 0.3 * c],
                    // Slivers.
                    1 => [a, a + b, a + 0.5 * b + 1e-6 * c],
                    // On a grid, many of them coincident, some of them degenerate.
                    2 => [snap(a), snap(b), snap(c)],
                    // Across an axis.
                    3 => [a, Vec3::new(b.x, a.y, b.z), Vec3::new(c.x, a.y, c.z)],
                    // Of all sizes.
                    _ => [a, a + b * 10f32.powi(-(i as i32 % 7)), a + c * 10f32.powi(-(i as i32 % 7))],
                }
            })
            .collect()
    }

    /// Rays from in and around the scene, to corners, edges and anywhere, and along axes.
    fn rays(triangles: &[[Vec3; 3]], n: u32, seed: u32, scale: f32, offset: Vec3) -> Vec<Ray> {
        (0..n)
            .map(|i| {
                let pick = |d| triangles[(uniform(i, d, seed) * triangles.len() as f32) as usize % triangles.len()];
                let (from, to) = (pick(20), pick(21));
                let origin = match i % 4 {
                    0 => point(i, 22, seed) * 2.0 * scale + offset,
                    1 => from[0],
                    2 => (from[0] + from[1] + from[2]) / 3.0,
                    _ => point(i, 22, seed) * 1e6 * scale + offset,
                };
                let direction = match i / 4 % 5 {
                    0 => uniform_sphere([uniform(i, 25, seed), uniform(i, 26, seed)]),
                    1 => to[1] - origin,
                    2 => 0.5 * to[0] + 0.5 * to[2] - origin,
                    3 => Vec3::AXES[i as usize / 20 % 3] * if i % 8 < 4 { 1.0 } else { -1.0 },
                    _ => (to[0] + to[1] + to[2]) / 3.0 - origin,
                };
                let ray = Ray::new(origin, direction);
                if i % 7 == 0 { ray.within(-1.0, 2.0 * scale) } else { ray }
            })
            .collect()
    }

    /// Two meshes, the first of `first` triangles.
    fn scene(device: &Arc<Device>, triangles: &[[Vec3; 3]], first: usize, build: &BuildOptions) -> Option<Arc<Scene>> {
        let mut data = SceneData::new();
        data.add_material(Material::default()).unwrap();
        for part in [&triangles[..first], &triangles[first..]] {
            let indices = (0..part.len() as u32).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
            data.add_mesh(Mesh { positions: part.concat().into(), indices, ..Default::default() }).unwrap();
        }
        Scene::commit(device, data, build, &Progress::none()).ok()
    }

    fn assert_same(whole: &Scene, compact: &Scene, rays: &[Ray]) -> usize {
        let isa = whole.device().isa();
        let bits = |h: &Hit| [h.t.to_bits(), h.u.to_bits(), h.v.to_bits(), h.triangle, h.mesh];
        let mut hits = [vec![Hit::MISS; rays.len()], vec![Hit::MISS; rays.len()]];
        let mut shadows = [vec![2; rays.len()], vec![3; rays.len()]];
        for (i, s) in [whole, compact].into_iter().enumerate() {
            s.intersect_many(rays, false, &mut hits[i]).unwrap();
            s.occluded_many(rays, false, &mut shadows[i]).unwrap();
        }
        for (i, ray) in rays.iter().enumerate() {
            assert_eq!(bits(&hits[0][i]), bits(&hits[1][i]), "{isa:?} {ray:?} {:?} {:?}", hits[0][i], hits[1][i]);
            assert_eq!(shadows[0][i], shadows[1][i], "{isa:?} {ray:?}");
            assert_eq!(bits(&compact.intersect(ray)), bits(&hits[0][i]), "{isa:?} alone {ray:?}");
            assert_eq!(compact.occluded(ray), shadows[0][i] == 1, "{isa:?} alone {ray:?}");
            assert_eq!(whole.intersect_raw(ray).front, compact.intersect_raw(ray).front);
        }
        // Of one origin.
        let directions: Vec<[f32; 3]> = rays.iter().map(|r| r.direction).collect();
        for (s, hits) in [whole, compact].into_iter().zip(&mut hits) {
            s.gather(rays[0].origin.into(), &directions, f32::INFINITY, false, hits).unwrap();
        }
        assert!(hits[0].iter().map(bits).eq(hits[1].iter().map(bits)), "{isa:?} gather");
        shadows[0].iter().filter(|&&s| s == 1).count()
    }

    #[test]
    fn many_small_meshes_are_told_apart() {
        let triangles = triangles(0, 2000, 3);
        for device in DEVICES.iter() {
            let [whole, compact] = [false, true].map(|compact| {
                let mut data = SceneData::new();
                data.add_material(Material::default()).unwrap();
                let mut rest = &triangles[..];
                for size in [1usize, 0, 3, 700, 0, 5].into_iter().cycle() {
                    let (part, others) = rest.split_at(size.min(rest.len()));
                    let indices = (0..part.len() as u32).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
                    data.add_mesh(Mesh { positions: part.concat().into(), indices, ..Default::default() }).unwrap();
                    rest = others;
                    if rest.is_empty() {
                        break;
                    }
                }
                let build = BuildOptions { compact, ..Default::default() };
                Scene::commit(device, data, &build, &Progress::none()).map_err(|e| e.1).unwrap()
            });
            assert!(assert_same(&whole, &compact, &rays(&triangles, 3000, 4, 1.0, Vec3::ZERO)) > 1000);
        }
    }

    #[test]
    fn compact_trees_after_spatial_splits_find_the_same() {
        let triangles = triangles(4, 3000, 5);
        let rays = rays(&triangles, 3000, 6, 1.0, Vec3::ZERO);
        for device in DEVICES.iter() {
            let build = BuildOptions { quality: BuildQuality::High, split_budget: 1.0, ..Default::default() };
            let whole = scene(device, &triangles, 10, &build).unwrap();
            let compact = scene(device, &triangles, 10, &BuildOptions { compact: true, ..build }).unwrap();
            assert_same(&whole, &compact, &rays);
        }
    }

    #[test]
    fn the_accounts_hold_what_a_compact_scene_takes() {
        let triangles = triangles(0, 20_000, 1);
        let bytes = [false, true].map(|compact| {
            let device = Device::new(DeviceOptions { num_threads: 1, ..Default::default() }).unwrap();
            let scene = scene(&device, &triangles, 0, &BuildOptions { compact, ..Default::default() }).unwrap();
            assert_eq!(device.memory().current() as u64, scene.stats().bytes);
            scene.stats().bytes - 48 * 20_000
        });
        assert!(5 * bytes[1] < bytes[0], "{bytes:?}");
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 60, failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn compact_trees_have_the_hits_of_whole_ones_bit_for_bit(
            kind in 0u32..5,
            n in 1u32..300,
            seed in any::<u32>(),
            max_leaf in 1u32..=8,
            exponent in prop_oneof![Just(0i32), -60i32..38],
            far in prop_oneof![Just(0f32), Just(1e3), Just(1e7)],
            moves in prop::collection::vec((any::<prop::sample::Index>(), -2.0f32..3.0, 0u32..5), 0..40),
        ) {
            let scale = 2f32.powi(exponent);
            let offset = far * scale * Vec3::new(1.0, -0.3, 0.01);
            let place = |t: [Vec3; 3]| t.map(|v| v * scale + offset);
            let from: Vec<[Vec3; 3]> = triangles(kind, n, seed).into_iter().map(place).collect();
            let first = n as usize / 3;
            let mut to = from.clone();
            for (which, by, what) in &moves {
                let t = which.index(to.len());
                match what {
                    0 => to[t] = to[t].map(|c| c + by * scale * Vec3::new(1.0, 0.5, -0.25)),
                    1 => to[t][t % 3] *= *by,
                    2 => to[t][2] = to[t][1],
                    3 => to[t][0].y = f32::NAN,
                    _ => to[t].swap(0, 1),
                }
            }
            let rays = rays(&from, 400, seed ^ 1, scale, offset);
            for device in DEVICES.iter() {
                let build = BuildOptions { max_leaf, ..Default::default() };
                let Some(mut whole) = scene(device, &from, first, &build) else { return Ok(()) };
                let mut compact = scene(device, &from, first, &BuildOptions { compact: true, ..build }).unwrap();
                assert_same(&whole, &compact, &rays);
                let (a, b) = (to[..first].concat(), to[first..].concat());
                let moved: [(u32, &[Vec3]); 2] = [(0, &a), (1, &b)];
                if Scene::refit(&mut whole, &moved).is_ok() {
                    Scene::refit(&mut compact, &moved).unwrap();
                    assert_eq!(whole.bounds(), compact.bounds());
                    assert_eq!(whole.stats().skipped_degenerate, compact.stats().skipped_degenerate);
                    assert_same(&whole, &compact, &rays);
                }
            }
        }
    }
}
