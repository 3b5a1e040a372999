//! Bundles of rays from a pinhole: consecutive rays with one origin that go nearly the same way pass
//! the 8-wide tree together (Overbeck, Ramamoorthi and Mark, *Large Ray Packets for Real-time Whitted
//! Ray Tracing*, 2008; Wald et al., *Interactive Rendering with Coherent Ray Tracing*, 2001).
//!
//! ```text
//! push the root, with group 0                     (a group: as many rays as there are lanes)
//! while a child is popped, with the first group that may hit it:
//!     advance that group until one hits the child's box; if none does, pop the next child
//!     leaf:  for each group from there on that hits the leaf's box, test the leaf's triangles,
//!            or take the rays that hit it to an instance: see `bundle_boxes`
//!     node:  test the frustum around all rays against the node's eight children at once;
//!            push those that it overlaps, the nearest last, each with that first group
//! ```
//!
//! So coherent rays cost one or two tests per node.
//!
//! Hits are those of [`single`], bit for bit: groups do its arithmetic, lane by lane. The frustum may let
//! through more boxes, but a triangle counts only for rays that hit the box of its leaf, and since
//! rounding is monotonic these rays hit all boxes around it.
//!
//! Tried for final gathering, with an origin per ray: slower, see docs/experiments.md#bundles-for-final-gathering.
//!
//! The file is long because all of it is inlined into one entry point per instruction set, and again into that for instances.

use super::bundle::{LEAST, SIZE, bundle, directions_and_ends};
use super::single;
use super::tree::{BEYOND, EPSILON, OFFSET_ERROR, beyond};
use super::triangle::{GRAZING, Projected, Shear, V3, accurate_distance, barycentrics};
use super::{RawHit, Ray};
use crate::base::geometry::NONE;
use crate::bvh::layout::{ChildRef, MAX_LEAF, Mbvh, Node, STACK_SIZE, WIDTH};
use crate::simd::{self, Compress, Lanes, Mask, Simd};
use std::mem::MaybeUninit;

/// Closest hits of as many rays as both slices have below the node `root`: bundles are traced together, other rays one by one.
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
pub(super) unsafe fn block<S: Simd>(bvh: &Mbvh, root: ChildRef, rays: &[Ray], out: &mut [RawHit]) {
    let n = rays.len().min(out.len());
    let (rays, out) = (&rays[..n], &mut out[..n]);
    let mut start = 0;
    while start < n {
        let (mut end, mut length) = (start, 0);
        while end < n {
            // SAFETY: forwarded.
            length = unsafe { bundle::<S>(&rays[end..]) };
            if length >= LEAST {
                break;
            }
            end += length.max(1);
            length = 0;
        }
        if start < end {
            let (rays, out) = (&rays[start..end], &mut out[start..end]);
            // SAFETY: forwarded.
            unsafe { single::many::<S, _, false>(bvh, root, rays.len(), |i| rays[i], |i, hit| out[i] = hit) }
        }
        if length > 0 {
            // SAFETY: forwarded; `bundle` has said that these are one.
            unsafe { trace::<S>(bvh, root, &rays[end..end + length], &mut out[end..end + length]) }
        }
        start = end + length;
    }
}

/// A value per ray.
type Column = [f32; SIZE];

/// The rays of a bundle, and the best hits so far as in [`single::Best`].
#[repr(C, align(64))]
pub(super) struct Bundle {
    direction: [Column; 3],
    /// Reciprocals of directions, as in `RaySetup`.
    reciprocal: [Column; 3],
    near_offset: [Column; 3],
    far_offset: [Column; 3],
    /// Shears of the rays' frames, as in [`Shear`].
    shear: [Column; 2],
    grazing: Column,
    /// The largest component of the direction: factor from t to the distance along its axis.
    length: Column,
    /// Conservative tmax: boxes that begin behind it are not entered. Near the least float for lanes behind the last ray.
    pub(super) limit: Column,
    t: Column,
    u: Column,
    v: Column,
    sum: Column,
    /// Triangle numbers, stored as the bits of floats.
    triangle: Column,
}

/// Data that all rays of a bundle share.
pub(super) struct Shared {
    origin: [f32; 3],
    pub(super) tmin: f32,
    /// The scene's axes in the order of the rays' frame, as in [`Shear`].
    axes: [usize; 3],
    /// The origin in the order of `axes`.
    frame_origin: [f32; 3],
    negative: [bool; 3],
    /// Shift that selects the rays' octant in [`Node::order`].
    shift: u32,
    /// Number of lane groups that have rays.
    pub(super) groups: usize,
}

/// Frustum that encloses the rays. Distances are along the longest axis; they differ from t by a factor per ray, so the
/// three intervals of a box are independent, and the test is exact but for rounding: a common distance exists if and
/// only if one exists for any two of them.
pub(super) struct Frustum {
    /// 1 or −1: planes × `sign` + `near` or `far` are distances from the origin along the axis.
    sign: [f32; 3],
    near: [f32; 3],
    far: [f32; 3],
    /// Least and greatest reciprocal slopes of the rays.
    least: [f32; 3],
    most: [f32; 3],
    /// Range of distances of the rays.
    begin: f32,
    end: f32,
}

/// Relative margin, larger than the rounding error of the frustum's tests.
const SLACK: f32 = 2e-6;

impl Frustum {
    /// Near distances of a node's boxes, and a mask of the boxes that the frustum overlaps.
    ///
    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    unsafe fn node<S: Simd>(&self, node: &Node, negative: [bool; 3]) -> (S::F8, <S::F8 as Lanes>::Mask) {
        // SAFETY: forwarded.
        let [(nx, fx), (ny, fy), (nz, fz)] = unsafe {
            [self.axis::<S>(node, 0, negative), self.axis::<S>(node, 1, negative), self.axis::<S>(node, 2, negative)]
        };
        // SAFETY: the caller vouches for the ISA.
        let (begin, end) = unsafe { (S::F8::splat(self.begin), S::F8::splat(self.end)) };
        let near = nx.max(ny).max(nz.max(begin));
        let far = fx.min(fy).min(fz.min(end));
        (near, near.le(far))
    }

    /// Distances of a node's near and far planes across an axis. (A function: as a closure it was not inlined.)
    ///
    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    unsafe fn axis<S: Simd>(&self, node: &Node, a: usize, negative: [bool; 3]) -> (S::F8, S::F8) {
        let (near, far) = planes(node, a, negative);
        // SAFETY: the caller vouches for the ISA; rows have eight floats.
        unsafe {
            let sign = S::F8::splat(self.sign[a]);
            let near = S::F8::load(near.as_ptr()).mul_add(sign, S::F8::splat(self.near[a]));
            let far = S::F8::load(far.as_ptr()).mul_add(sign, S::F8::splat(self.far[a]));
            let (least, most) = (S::F8::splat(self.least[a]), S::F8::splat(self.most[a]));
            ((near * least).min(near * most), (far * least).max(far * most))
        }
    }
}

/// Near and far planes of a node's children.
#[inline(always)]
fn planes(node: &Node, a: usize, negative: [bool; 3]) -> (&[f32; WIDTH], &[f32; WIDTH]) {
    if negative[a] { (&node.upper[a], &node.lower[a]) } else { (&node.lower[a], &node.upper[a]) }
}

/// Traversal stack of a bundle, nearest child on top.
struct Stack {
    near: [MaybeUninit<f32>; STACK_SIZE],
    /// Child to be visited: 8 · the parent's number + its index there. (There are fewer nodes than triangle slots, of
    /// 2^28.)
    child: [MaybeUninit<u32>; STACK_SIZE],
    /// First group of rays that may hit the child.
    first: [MaybeUninit<u8>; STACK_SIZE],
}

/// Loads the lanes of group `g`.
///
/// # Safety
/// The CPU must have the ISA; the group must lie in the column.
#[inline(always)]
unsafe fn lanes<L: Lanes>(column: &Column, g: usize) -> L {
    debug_assert!((g + 1) * L::WIDTH <= SIZE);
    // SAFETY: forwarded.
    unsafe { L::load(column.as_ptr().add(g * L::WIDTH)) }
}

/// # Safety
/// The group must lie in the column.
#[inline(always)]
unsafe fn store<L: Lanes>(column: &mut Column, g: usize, x: L) {
    debug_assert!((g + 1) * L::WIDTH <= SIZE);
    // SAFETY: forwarded.
    unsafe { x.store(column.as_mut_ptr().add(g * L::WIDTH)) }
}

/// # Safety
/// The CPU must have the ISA; the group must lie in the column.
#[inline(always)]
unsafe fn replace<L: Lanes>(column: &mut Column, g: usize, mask: L::Mask, x: L) {
    // SAFETY: forwarded.
    unsafe { store(column, g, L::select(mask, x, lanes(column, g))) }
}

/// Closest hits of a bundle.
///
/// # Safety
/// The CPU must have the ISA; [`bundle`] must have said that all `rays` are one.
#[inline(always)]
unsafe fn trace<S: Simd>(bvh: &Mbvh, root: ChildRef, rays: &[Ray], out: &mut [RawHit]) {
    let mut place = MaybeUninit::uninit();
    // SAFETY: forwarded.
    unsafe {
        let (rays, shared, frustum) = begin::<S>(rays, 0.0, &mut place);
        walk::<S>(bvh, root, rays, &shared, frustum, &mut Triangles(bvh));
        finish(rays, out);
    }
}

/// What is done with a bundle at a leaf.
pub(super) trait AtLeaf<S: Simd> {
    /// `planes` are the leaf's box, for which groups before `first` need not be tested. Returns whether any ray's end has
    /// changed.
    ///
    /// # Safety
    /// The CPU must have the ISA; `leaf` must be a leaf of the tree, and `first` a group of the rays.
    unsafe fn visit(
        &mut self,
        rays: &mut Bundle,
        shared: &Shared,
        leaf: ChildRef,
        planes: &[[S::Packet; 2]; 3],
        first: usize,
    ) -> bool;
}

/// Leaves with triangles.
struct Triangles<'a>(&'a Mbvh);

impl<S: Simd> AtLeaf<S> for Triangles<'_> {
    #[inline(always)]
    unsafe fn visit(
        &mut self,
        rays: &mut Bundle,
        shared: &Shared,
        leaf: ChildRef,
        planes: &[[S::Packet; 2]; 3],
        first: usize,
    ) -> bool {
        // SAFETY: forwarded.
        unsafe { rays.leaf::<S>(self.0, leaf, shared, planes, first) }
    }
}

/// Takes a bundle through a tree.
///
/// # Safety
/// The CPU must have the ISA; the bundle must have been [begun](begin).
#[inline(always)]
pub(super) unsafe fn walk<S: Simd>(
    bvh: &Mbvh,
    root: ChildRef,
    rays: &mut Bundle,
    shared: &Shared,
    mut frustum: Frustum,
    leaves: &mut impl AtLeaf<S>,
) {
    let mut stack = MaybeUninit::<Stack>::uninit();
    let stack = stack.as_mut_ptr();
    // SAFETY: addresses within the stack; nothing is read.
    let (nears, children, firsts) = unsafe {
        (
            (&raw mut (*stack).near).cast::<f32>(),
            (&raw mut (*stack).child).cast::<u32>(),
            (&raw mut (*stack).first).cast::<u8>(),
        )
    };
    let (mut count, mut number, mut first) = (0, root.node_index(), 0);
    loop {
        // SAFETY: `number` is the root's or comes from a node of this tree. The builder bounds the tree's depth so
        // that there is room for eight more children (see `STACK_SIZE`). The caller vouches for the ISA.
        unsafe {
            let node = bvh.nodes.get_unchecked(number);
            let (near, mask) = frustum.node::<S>(node, shared.negative);
            let names: [u32; WIDTH] = std::array::from_fn(|i| (number * WIDTH + i) as u32);
            let (nears, children) = (nears.add(count), children.add(count));
            let set = near.compress(names.as_ptr(), node.order.as_ptr(), shared.shift, mask, nears, children);
            firsts.add(count).cast::<[u8; WIDTH]>().write([first as u8; WIDTH]);
            count += set.count_ones() as usize;
        }
        loop {
            if count == 0 {
                return;
            }
            count -= 1;
            // SAFETY: entries below the count have been written, and name children of this tree's nodes. Groups
            // are below `shared.groups`. The caller vouches for the ISA.
            unsafe {
                if *nears.add(count) > frustum.end {
                    continue;
                }
                let name = *children.add(count) as usize;
                first = *firsts.add(count) as usize;
                let (node, lane) = (bvh.nodes.get_unchecked(name / WIDTH), name % WIDTH);
                let child = node.children[lane];
                // Prefetches the child that most likely comes next.
                if count > 0 {
                    let next = *children.add(count - 1) as usize;
                    bvh.prefetch(bvh.nodes.get_unchecked(next / WIDTH).children[next % WIDTH]);
                }
                let plane = |a: usize| {
                    let (near, far) = planes(node, a, shared.negative);
                    [S::Packet::splat(near[lane]), S::Packet::splat(far[lane])]
                };
                let planes = [plane(0), plane(1), plane(2)];
                while first < shared.groups && !rays.meet::<S::Packet>(&planes, shared.tmin, first).any() {
                    first += 1;
                }
                if first == shared.groups {
                    continue;
                }
                if !child.is_leaf() {
                    number = child.node_index();
                    break;
                }
                if leaves.visit(rays, shared, child, &planes, first) {
                    frustum.end = rays.end::<S::Packet>(shared.groups);
                }
            }
        }
    }
}

/// Sets up a bundle in `place`, with all lanes of its groups; `beside`: by how much its rays may lie beside where they are.
///
/// # Safety
/// As for [`trace`].
#[inline(always)]
pub(super) unsafe fn begin<'a, S: Simd>(
    rays: &[Ray],
    beside: f32,
    place: &'a mut MaybeUninit<Bundle>,
) -> (&'a mut Bundle, Shared, Frustum) {
    let width = S::Packet::WIDTH;
    let Ray { origin, direction, tmin, .. } = rays[0];
    let axes = Shear::new(origin, direction).axes.map(|a| a as usize);
    let negative = direction.map(|d| d < 0.0);
    let shift = 3 * (negative[0] as u32 | (negative[1] as u32) << 1 | (negative[2] as u32) << 2);
    let frame_origin = axes.map(|a| origin[a]);
    let shared = Shared { origin, tmin, axes, frame_origin, negative, shift, groups: rays.len().div_ceil(width) };
    // SAFETY: zeros are f32s.
    let b = unsafe {
        place.as_mut_ptr().write_bytes(0, 1);
        place.assume_init_mut()
    };
    let (eights, rest) = rays.as_chunks::<8>();
    for (g, eight) in eights.iter().enumerate() {
        // SAFETY: the caller vouches for the ISA; columns have room for as many eights.
        unsafe {
            let (directions, tmax) = directions_and_ends::<S>(eight);
            b.direction.iter_mut().zip(directions).for_each(|(column, d)| store(column, g, d));
            store(&mut b.t, g, tmax);
        }
    }
    for i in 8 * eights.len()..shared.groups * width {
        let ray = rest.get(i - 8 * eights.len());
        let (d, tmax) = ray.map_or((direction, f32::MIN), |ray| (ray.direction, ray.tmax));
        (b.direction[0][i], b.direction[1][i], b.direction[2][i]) = (d[0], d[1], d[2]);
        b.t[i] = tmax;
    }
    // SAFETY: the caller vouches for the ISA; groups are of the bundle.
    unsafe {
        let splat = |x: f32| S::Packet::splat(x);
        let zero = splat(0.0);
        let abs = |x: S::Packet| x.max(zero - x);
        let [i, j, k] = axes;
        let (mut least, mut most) = ([splat(f32::INFINITY); 3], [zero; 3]);
        let (mut shortest, mut longest) = (splat(f32::INFINITY), zero);
        for g in 0..shared.groups {
            let d: [S::Packet; 3] = [lanes(&b.direction[0], g), lanes(&b.direction[1], g), lanes(&b.direction[2], g)];
            let length = abs(d[k]);
            let reciprocal = d.map(|d| splat(1.0).div(d));
            for (a, r) in reciprocal.into_iter().enumerate() {
                let offset = splat(-origin[a]) * r;
                let error = splat(OFFSET_ERROR) * abs(offset);
                store(&mut b.reciprocal[a], g, r);
                let (mut near, mut far) = (offset - error, offset + error);
                if beside > 0.0 {
                    let beside = splat(beside) * abs(r);
                    (near, far) = (near - beside, far + beside);
                }
                store(&mut b.near_offset[a], g, near);
                store(&mut b.far_offset[a], g, far);
                let r = abs(r) * length;
                (least[a], most[a]) = (least[a].min(r), most[a].max(r));
            }
            (shortest, longest) = (shortest.min(length), longest.max(length));
            let inverse = zero - reciprocal[k];
            store(&mut b.shear[0], g, d[i] * inverse);
            store(&mut b.shear[1], g, d[j] * inverse);
            store(&mut b.grazing, g, splat(GRAZING) * (abs(d[0]) + abs(d[1]) + abs(d[2])));
            store(&mut b.length, g, length);
            let t = lanes::<S::Packet>(&b.t, g);
            // As `beyond`.
            store(&mut b.limit, g, t + splat(BEYOND) * abs(t));
            store(&mut b.u, g, zero);
            store(&mut b.v, g, zero);
            store(&mut b.sum, g, splat(1.0));
            store(&mut b.triangle, g, splat(f32::from_bits(NONE)));
        }
        // (Lanes behind the last ray hold the first one.)
        let begin = tmin * if tmin < 0.0 { simd::greatest(longest) } else { simd::least(shortest) };
        let sign = negative.map(|n| if n { -1.0 } else { 1.0 });
        // Larger than the margin for rounding of a single ray's test; all rays have that one.
        let margin = origin.map(|o| 16.0 * EPSILON * o.abs() + beside);
        let frustum = Frustum {
            sign,
            near: [0, 1, 2].map(|a| -origin[a] * sign[a] - margin[a]),
            far: [0, 1, 2].map(|a| -origin[a] * sign[a] + margin[a]),
            least: least.map(|r| simd::least(r) * (1.0 - SLACK)),
            most: most.map(|r| simd::greatest(r) * (1.0 + SLACK)),
            begin: begin - SLACK * begin.abs(),
            end: b.end::<S::Packet>(shared.groups),
        };
        (b, shared, frustum)
    }
}

/// Writes hits out, with barycentrics.
#[inline(always)]
fn finish(rays: &Bundle, out: &mut [RawHit]) {
    // Written like this, the divisions are vectorised.
    let (mut u, mut v): (Column, Column) = ([0.0; SIZE], [0.0; SIZE]);
    for i in 0..SIZE {
        (u[i], v[i]) = barycentrics(rays.u[i], rays.v[i], rays.sum[i]);
    }
    for (i, out) in out.iter_mut().enumerate() {
        let hit =
            RawHit { t: rays.t[i], u: u[i], v: v[i], triangle: rays.triangle[i].to_bits(), front: rays.sum[i] > 0.0 };
        *out = if hit.is_miss() { RawHit::MISS } else { hit };
    }
}

impl Bundle {
    /// Mask of a group's rays that intersect a box, given by its near and far planes per axis; the arithmetic of
    /// `RaySetup`.
    ///
    /// # Safety
    /// The CPU must have the ISA; the group must be of the bundle.
    #[inline(always)]
    pub(super) unsafe fn meet<L: Lanes>(&self, planes: &[[L; 2]; 3], tmin: f32, g: usize) -> L::Mask {
        // SAFETY: forwarded.
        unsafe {
            let axis = |a: usize| {
                let r = lanes::<L>(&self.reciprocal[a], g);
                (
                    planes[a][0].mul_add(r, lanes(&self.near_offset[a], g)),
                    planes[a][1].mul_add(r, lanes(&self.far_offset[a], g)),
                )
            };
            let ((nx, fx), (ny, fy), (nz, fz)) = (axis(0), axis(1), axis(2));
            let near = nx.max(ny).max(nz.max(L::splat(tmin)));
            near.le(fx.min(fy).min(fz.min(lanes(&self.limit, g))))
        }
    }

    /// Greatest distance, along the longest axis, at which any ray may still hit something.
    ///
    /// # Safety
    /// The CPU must have the ISA; there must be as many groups.
    #[inline(always)]
    unsafe fn end<L: Lanes>(&self, groups: usize) -> f32 {
        // SAFETY: forwarded.
        let end = unsafe {
            let mut end = L::splat(f32::NEG_INFINITY);
            for g in 0..groups {
                end = end.max(lanes::<L>(&self.limit, g) * lanes(&self.length, g));
            }
            simd::greatest(end)
        };
        end + SLACK * end.abs()
    }

    /// Tests the rays, from group `first` on, against the box of `planes` and the triangles of the leaf in it, and
    /// updates their hits; returns whether any has changed.
    ///
    /// # Safety
    /// The CPU must have the ISA; `leaf` must be a leaf of `bvh`.
    #[inline(always)]
    unsafe fn leaf<S: Simd>(
        &mut self,
        bvh: &Mbvh,
        leaf: ChildRef,
        shared: &Shared,
        planes: &[[S::Packet; 2]; 3],
        first: usize,
    ) -> bool {
        // SAFETY: forwarded.
        let (rows, count) = (unsafe { bvh.leaf(leaf) }, leaf.leaf_count());
        // Vectors from corners to the origin, in the frame that all rays share.
        let mut corners = [[0.0f32; MAX_LEAF]; 9];
        for i in (0..count).step_by(4) {
            for a in 0..3 {
                // SAFETY: rows are `count` apart, and the pad behind the last leaf covers reads beyond it;
                // `corners` have room for twice four. The caller vouches for the ISA.
                unsafe {
                    let origin = S::F4::splat(shared.frame_origin[a]);
                    let row = rows.add(i + shared.axes[a] * count);
                    for corner in 0..3 {
                        let relative = origin - S::F4::load(row.add(3 * corner * count));
                        relative.store(corners[3 * corner + a].as_mut_ptr().add(i));
                    }
                }
            }
        }
        let mut improved = false;
        for g in first..shared.groups {
            // SAFETY: one of the bundle's groups. The caller vouches for the ISA.
            let meets = unsafe { self.meet::<S::Packet>(planes, shared.tmin, g) };
            if !meets.any() {
                continue;
            }
            // SAFETY: as above.
            let shear = unsafe { [lanes(&self.shear[0], g), lanes(&self.shear[1], g)] };
            for i in 0..count {
                // SAFETY: the caller vouches for the ISA.
                let corner = |k: usize| unsafe {
                    V3::<S::Packet>::splat([corners[3 * k][i], corners[3 * k + 1][i], corners[3 * k + 2][i]])
                };
                let seen = Projected::new([corner(0), corner(1), corner(2)], shear);
                // SAFETY: as above.
                let candidates = unsafe { seen.inside() }.and(meets);
                if candidates.any() {
                    // SAFETY: `rows` are the leaf's, and `i` is below its count. The caller vouches for the ISA.
                    improved |= unsafe { self.improve(rows, count, i, shared, g, &seen, candidates) };
                }
            }
        }
        improved
    }

    /// Updates the hits of `candidates` of group `g` by triangle `i` of a leaf; returns whether any has changed.
    ///
    /// # Safety
    /// The CPU must have the ISA; `rows` must be a leaf of `count` triangles, more than `i`.
    #[inline(always)]
    unsafe fn improve<L: Lanes>(
        &mut self,
        rows: *const f32,
        count: usize,
        i: usize,
        shared: &Shared,
        g: usize,
        seen: &Projected<L>,
        candidates: L::Mask,
    ) -> bool {
        // SAFETY: the caller vouches for the ISA, the group and the leaf.
        unsafe {
            let zero = L::splat(0.0);
            let [i0, i1, i2] = shared.axes;
            let back = V3 {
                x: zero - lanes(&self.direction[i0], g),
                y: zero - lanes(&self.direction[i1], g),
                z: zero - lanes(&self.direction[i2], g),
            };
            let (mut t, is_accurate) = seen.distances_along(back, lanes(&self.grazing, g));
            let sum = seen.u + seen.v + seen.w;
            let inaccurate = candidates.bits() & !is_accurate.bits();
            if inaccurate != 0 {
                let mut array = t.to_array();
                self.accurate(rows, count, i, shared, g * L::WIDTH, &sum.to_array(), inaccurate, &mut array);
                t = L::load(array.as_ptr());
            }
            let best = lanes::<L>(&self.t, g);
            let in_range = candidates.and(L::splat(shared.tmin).lt(t));
            // Among equal t, the lowest number wins.
            let number = rows.add(9 * count + i).read();
            let mut equal = in_range.and(t.le(best)).and(best.le(t)).bits();
            let nearer = in_range.and(t.lt(best));
            let mut improved = nearer.any();
            if improved {
                replace(&mut self.t, g, nearer, t);
                replace(&mut self.u, g, nearer, seen.u);
                replace(&mut self.v, g, nearer, seen.v);
                replace(&mut self.sum, g, nearer, sum);
                replace(&mut self.triangle, g, nearer, L::splat(number));
                // Conservative tmax, as `beyond`.
                replace(&mut self.limit, g, nearer, t + L::splat(BEYOND) * t.max(zero - t));
            }
            if equal != 0 {
                let (t, u, v, sum) = (t.to_array(), seen.u.to_array(), seen.v.to_array(), sum.to_array());
                while equal != 0 {
                    let lane = equal.trailing_zeros() as usize;
                    equal &= equal - 1;
                    let ray = g * L::WIDTH + lane;
                    if number.to_bits() < self.triangle[ray].to_bits() {
                        (self.t[ray], self.u[ray], self.v[ray], self.sum[ray]) = (t[lane], u[lane], v[lane], sum[lane]);
                        (self.triangle[ray], self.limit[ray]) = (number, beyond(t[lane]));
                        improved = true;
                    }
                }
            }
            improved
        }
    }

    /// Recomputes the distances of `inaccurate` rays, counted from `first` on, as for single rays.
    ///
    /// # Safety
    /// `rows` must be a leaf of `count` triangles, more than `i`.
    #[cold]
    unsafe fn accurate(
        &self,
        rows: *const f32,
        count: usize,
        i: usize,
        shared: &Shared,
        first: usize,
        sums: &[f32; 16],
        mut inaccurate: u32,
        t: &mut [f32; 16],
    ) {
        while inaccurate != 0 {
            let lane = inaccurate.trailing_zeros() as usize;
            inaccurate &= inaccurate - 1;
            let direction = [0, 1, 2].map(|a| self.direction[a][first + lane]);
            // If all edge functions vanish, the ray lies in the plane.
            t[lane] = if sums[lane] != 0.0 {
                // SAFETY: forwarded.
                unsafe { accurate_distance(rows, count, i, &Shear::new(shared.origin, direction)) }
            } else {
                f32::NAN
            };
        }
    }
}
