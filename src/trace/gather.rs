//! Shared-origin gather: packets of up to 32 rays from one point through the 4-wide tree (thesis
//! 3.2.5; Wald et al., *Interactive Rendering with Coherent Ray Tracing*, 2001, for packets).
//!
//! What depends on the origin alone is done once per packet: box planes relative to the origin, the
//! distance of boxes for the order of children, and all of a triangle but three dot products per
//! ray. Rays that miss a box are masked; a packet of few rays left goes on as single rays.

use super::single::{
    Best, FAR_SCALE, PARALLEL, PARALLEL_RECIPROCAL, RaySetup, T_SCALE, barycentrics, direction_scale, nudge, traverse,
};
use super::triangle::{OriginTriangle, V3};
use super::{PACKET_SIZE, Packet, RawHit, Ray};
use crate::bvh::layout::{ChildRef, Mbvh, Node, STACK_SIZE};
use crate::scene::NONE;
use crate::simd::{Halves, Lanes, Mask, Simd};
use glam::Vec3;
use std::mem::MaybeUninit;

/// With this many active rays or fewer, single rays are faster.
const FEW: u32 = 4;

/// Component arrays of a packet.
#[derive(Clone, Copy)]
#[repr(align(64))]
struct Rows([[f32; PACKET_SIZE]; 3]);

/// A packet under way.
struct State {
    direction: Rows,
    reciprocal: Rows,
    /// Closest t so far.
    t: [f32; PACKET_SIZE],
    u: [f32; PACKET_SIZE],
    v: [f32; PACKET_SIZE],
    sum: [f32; PACKET_SIZE],
    /// Triangle numbers, as bits.
    triangle: [f32; PACKET_SIZE],
    /// Length of each direction.
    length: [f32; PACKET_SIZE],
    tmin: f32,
}

#[derive(Clone, Copy)]
struct Entry {
    child: ChildRef,
    /// Rays that met the box.
    mask: u32,
    /// Distance of the box from the origin.
    distance: f32,
}

/// Box planes of a node relative to the origin, and each box's distance from it.
struct RelativeNode {
    planes: [[f32; 8]; 3],
    distance: [f32; 16],
}

/// Origin in the forms that nodes and leaves want.
struct Origin<S: Simd> {
    /// Moved a little up for minima and down for maxima (see [`nudge`]).
    planes: V3<S::F8>,
    point: V3<S::F4>,
}

impl<S: Simd> Origin<S> {
    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    unsafe fn new(origin: Vec3) -> Self {
        let plane = |o: f32| {
            let (low, high) = ([o + nudge(o); 4], [o - nudge(o); 4]);
            // SAFETY: arrays of four floats; the caller vouches for the ISA.
            unsafe { S::F8::load_halves(low.as_ptr(), high.as_ptr()) }
        };
        let planes = V3 { x: plane(origin.x), y: plane(origin.y), z: plane(origin.z) };
        // SAFETY: the caller vouches for the ISA.
        Origin { planes, point: unsafe { V3::splat(origin.to_array()) } }
    }

    /// # Safety
    /// The CPU must have the ISA.
    #[inline(always)]
    unsafe fn node(&self, node: &Node) -> RelativeNode {
        let mut relative = RelativeNode { planes: [[0.0; 8]; 3], distance: [0.0; 16] };
        // SAFETY (all): rows of eight floats; the caller vouches for the ISA.
        let zero = unsafe { S::F4::splat(0.0) };
        let mut axis = |a: usize, o: S::F8| {
            let r = unsafe { S::F8::load(node.bounds[a].as_ptr()) } - o;
            unsafe { r.store(relative.planes[a].as_mut_ptr()) };
            let d = r.low().max(zero - r.high()).max(zero);
            d * d
        };
        let (x, y, z) = (axis(0, self.planes.x), axis(1, self.planes.y), axis(2, self.planes.z));
        relative.distance = (x + y + z).to_array();
        relative
    }
}

/// Which of the rays of `mask` meet child `i` of a node.
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
unsafe fn child_mask<S: Simd>(state: &State, node: &RelativeNode, i: usize, mask: u32) -> u32 {
    type P<S> = <S as Simd>::Packet;
    let width = P::<S>::WIDTH;
    // SAFETY (all): rows of PACKET_SIZE floats read at multiples of WIDTH, which divides it; the
    // caller vouches for the ISA.
    let plane = |a: usize| unsafe { (P::<S>::splat(node.planes[a][i]), P::<S>::splat(node.planes[a][4 + i])) };
    let ((lx, hx), (ly, hy), (lz, hz)) = (plane(0), plane(1), plane(2));
    let tmin = unsafe { P::<S>::splat(state.tmin) };
    let scale = unsafe { P::<S>::splat(FAR_SCALE) };
    let t_scale = unsafe { P::<S>::splat(T_SCALE) };
    let mut hits = 0;
    for k in (0..PACKET_SIZE).step_by(width) {
        if mask >> k & ((1u64 << width) - 1) as u32 == 0 {
            continue;
        }
        let load = |row: &[f32; PACKET_SIZE]| unsafe { P::<S>::load(row.as_ptr().add(k)) };
        let r = &state.reciprocal.0;
        let (rx, ry, rz) = (load(&r[0]), load(&r[1]), load(&r[2]));
        let (x0, x1, y0, y1, z0, z1) = (lx * rx, hx * rx, ly * ry, hy * ry, lz * rz, hz * rz);
        let near = x0.min(x1).max(y0.min(y1)).max(z0.min(z1).max(tmin));
        let far = (x0.max(x1).min(y0.max(y1)).min(z0.max(z1)) * scale).min(load(&state.t) * t_scale);
        hits |= near.le(far).bits() << k;
    }
    hits & mask
}

/// Tests the triangles of a leaf against the rays of `mask`; says whether any t fell.
///
/// # Safety
/// The CPU must have the ISA; `leaf` must be a leaf of `bvh`.
#[inline(always)]
unsafe fn leaf<S: Simd>(bvh: &Mbvh, leaf: ChildRef, origin: &Origin<S>, state: &mut State, mask: u32) -> bool {
    let (rows, count) = (bvh.leaf(leaf), leaf.leaf_count());
    let mut improved = false;
    for first in (0..count).step_by(4) {
        // SAFETY: `rows` is a leaf of `count`, and `first < count`.
        let four = unsafe { OriginTriangle::<S::F4>::load(rows, count, first, origin.point) };
        let [u, v, w, n] = [four.u, four.v, four.w, four.normal].map(|e| [e.x, e.y, e.z].map(|c| c.to_array()));
        let distance = four.distance.to_array();
        for i in 0..(count - first).min(4) {
            let lane = |e: &[[f32; 16]; 3]| [e[0][i], e[1][i], e[2][i]];
            // SAFETY: row 9 of the leaf holds `count` numbers, and first + i < count.
            let id = unsafe { rows.add(9 * count + first + i).read() };
            // SAFETY: the caller vouches for the ISA.
            let triangle = unsafe {
                OriginTriangle::<S::Packet> {
                    u: V3::splat(lane(&u)),
                    v: V3::splat(lane(&v)),
                    w: V3::splat(lane(&w)),
                    normal: V3::splat(lane(&n)),
                    distance: S::Packet::splat(distance[i]),
                }
            };
            // SAFETY: as above.
            improved |= unsafe { one_triangle::<S>(&triangle, id, state, mask) };
        }
    }
    improved
}

/// Tests one triangle against the rays of `mask`; says whether any t fell.
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
unsafe fn one_triangle<S: Simd>(triangle: &OriginTriangle<S::Packet>, id: f32, state: &mut State, mask: u32) -> bool {
    type P<S> = <S as Simd>::Packet;
    let width = P::<S>::WIDTH;
    // SAFETY (all): rows of PACKET_SIZE floats accessed at multiples of WIDTH, which divides it; the
    // caller vouches for the ISA.
    let zero = unsafe { P::<S>::splat(0.0) };
    let mut improved = false;
    for k in (0..PACKET_SIZE).step_by(width) {
        let active = mask >> k & ((1u64 << width) - 1) as u32;
        if active == 0 {
            continue;
        }
        let load = |row: &[f32; PACKET_SIZE]| unsafe { P::<S>::load(row.as_ptr().add(k)) };
        let d = &state.direction.0;
        let d = V3 { x: load(&d[0]), y: load(&d[1]), z: load(&d[2]) };
        let (u, v, w, inside) = triangle.edges(d, zero);
        if inside.bits() & active == 0 {
            continue;
        }
        let den = triangle.normal.dot(d);
        let t = triangle.distance.div(den);
        let best = load(&state.t);
        // A lane outside `active` may pass: it met no box of this leaf, so within rounding it
        // cannot hit; and if it does, the hit is true all the same. Only t decides.
        let ahead = unsafe { P::<S>::splat(state.tmin) }.lt(t);
        let closer = inside.and(ahead).and(t.lt(best));
        let ties = inside.and(ahead).and(t.eq(best)).bits();
        // In the plane: t is infinite or NaN, and `lt` fails for both.
        if closer.any() {
            let update = |row: &mut [f32; PACKET_SIZE], new: P<S>| unsafe {
                let p = row.as_mut_ptr().add(k);
                P::<S>::select(closer, new, P::<S>::load(p)).store(p);
            };
            update(&mut state.t, t);
            update(&mut state.u, u);
            update(&mut state.v, v);
            update(&mut state.sum, u + v + w);
            update(&mut state.triangle, unsafe { P::<S>::splat(id) });
            improved = true;
        }
        if ties != 0 {
            resolve_ties(state, k, ties & !den.eq(zero).bits(), id, u.to_array(), v.to_array(), w.to_array());
        }
    }
    improved
}

/// Among equal t the lowest triangle number wins.
#[cold]
fn resolve_ties(state: &mut State, k: usize, mut ties: u32, id: f32, u: [f32; 16], v: [f32; 16], w: [f32; 16]) {
    while ties != 0 {
        let i = ties.trailing_zeros() as usize;
        ties &= ties - 1;
        if id.to_bits() < state.triangle[k + i].to_bits() {
            state.triangle[k + i] = id;
            (state.u[k + i], state.v[k + i], state.sum[k + i]) = (u[i], v[i], u[i] + v[i] + w[i]);
        }
    }
}

impl State {
    fn new(packet: &Packet, tmin: f32, tmax: f32) -> (State, u32) {
        let mut state = State {
            direction: Rows([packet.x, packet.y, packet.z]),
            reciprocal: Rows([[PARALLEL_RECIPROCAL; PACKET_SIZE]; 3]),
            t: [tmax; PACKET_SIZE],
            u: [0.0; PACKET_SIZE],
            v: [0.0; PACKET_SIZE],
            sum: [1.0; PACKET_SIZE],
            triangle: [f32::from_bits(NONE); PACKET_SIZE],
            length: [0.0; PACKET_SIZE],
            tmin,
        };
        let mut mask = 0;
        for i in 0..packet.count {
            let d = [packet.x[i], packet.y[i], packet.z[i]];
            let parallel = PARALLEL * d[0].abs().max(d[1].abs()).max(d[2].abs());
            for (a, d) in d.into_iter().enumerate() {
                if d.abs() > parallel {
                    state.reciprocal.0[a][i] = 1.0 / d;
                }
            }
            state.length[i] = Vec3::from_array(d).length();
            mask |= 1 << i;
        }
        // Lanes without a ray have direction 0 and no t that any hit could be below.
        for i in packet.count..PACKET_SIZE {
            state.t[i] = f32::NEG_INFINITY;
            (0..3).for_each(|a| state.direction.0[a][i] = 0.0);
        }
        (state, mask)
    }

    /// No active ray can hit anything at this distance from the origin or beyond.
    fn reach(&self, mask: u32) -> f32 {
        let mut reach = 0.0f32;
        for i in 0..PACKET_SIZE {
            if mask >> i & 1 == 1 {
                reach = reach.max(self.t[i] * self.length[i]);
            }
        }
        reach * T_SCALE
    }

    /// Goes on with the rays of `mask` one by one below `child`.
    ///
    /// # Safety
    /// The CPU must have the ISA; `child` must be a child reference of `bvh`.
    #[inline(always)]
    unsafe fn single_rays<S: Simd>(&mut self, bvh: &Mbvh, child: ChildRef, origin: Vec3, mut mask: u32) {
        while mask != 0 {
            let i = mask.trailing_zeros() as usize;
            mask &= mask - 1;
            let d = self.direction.0.map(|row| row[i]);
            // SAFETY: forwarded.
            let setup = unsafe { RaySetup::<S>::new(origin.to_array(), d, self.tmin) };
            let triangle = self.triangle[i].to_bits();
            let mut best = Best { t: self.t[i], triangle, u: self.u[i], v: self.v[i], sum: self.sum[i] };
            // SAFETY: forwarded.
            unsafe { traverse::<S, false>(bvh, child, &setup, &mut best) };
            (self.t[i], self.u[i], self.v[i], self.sum[i]) = (best.t, best.u, best.v, best.sum);
            self.triangle[i] = f32::from_bits(best.triangle);
        }
    }
}

/// Closest hits of a packet whose directions all have a largest component near 1.
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
unsafe fn packet_closest<S: Simd>(bvh: &Mbvh, origin: Vec3, packet: &Packet, tmin: f32, tmax: f32) -> State {
    let (mut state, all) = State::new(packet, tmin, tmax);
    // SAFETY (all): the caller vouches for the ISA; references come from the tree.
    let o = unsafe { Origin::<S>::new(origin) };
    let mut stack = [const { MaybeUninit::<Entry>::uninit() }; STACK_SIZE];
    stack[0].write(Entry { child: ChildRef::node(0), mask: all, distance: 0.0 });
    let mut top = 1;
    let mut reach = f32::INFINITY;
    while top > 0 {
        top -= 1;
        // SAFETY: entries below `top` have been written; see `STACK_SIZE` for why they fit.
        let Entry { child, mask, distance } = unsafe { stack[top].assume_init() };
        if distance > reach {
            continue;
        }
        if child.is_leaf() {
            if unsafe { leaf::<S>(bvh, child, &o, &mut state, mask) } {
                reach = state.reach(all);
            }
            continue;
        }
        if mask.count_ones() <= FEW {
            unsafe { state.single_rays::<S>(bvh, child, origin, mask) };
            reach = state.reach(all);
            continue;
        }
        let node = &bvh.nodes[child.node_index()];
        let relative = unsafe { o.node(node) };
        let base = top;
        for i in 0..4 {
            if node.children[i] == ChildRef::EMPTY {
                break;
            }
            let hits = unsafe { child_mask::<S>(&state, &relative, i, mask) };
            if hits == 0 {
                continue;
            }
            // Insertion in order of falling distance: the nearest ends on top.
            let e = Entry { child: node.children[i], mask: hits, distance: relative.distance[i].sqrt() };
            let mut j = top;
            while j > base {
                // SAFETY: entries base .. top have been written.
                let below = unsafe { stack[j - 1].assume_init() };
                if below.distance >= e.distance {
                    break;
                }
                stack[j].write(below);
                j -= 1;
            }
            stack[j].write(e);
            top += 1;
        }
    }
    state
}

/// Closest hits of up to [`PACKET_SIZE`] rays from `origin`, `tmin < t ≤ tmax`.
///
/// # Safety
/// The CPU must have the ISA.
#[inline(always)]
pub(super) unsafe fn gather<S: Simd>(
    bvh: &Mbvh,
    origin: Vec3,
    packet: &Packet,
    tmin: f32,
    tmax: f32,
    out: &mut [RawHit; PACKET_SIZE],
) {
    let count = packet.count.min(PACKET_SIZE);
    let ray = |i: usize| Ray::new(origin, Vec3::new(packet.x[i], packet.y[i], packet.z[i])).within(tmin, tmax);
    let usual = (0..count).all(|i| direction_scale(&ray(i)) == Some(1.0));
    if !usual || !(tmax > tmin) {
        // Extreme or unusable directions: one by one, where they are scaled or refused.
        for (i, out) in out.iter_mut().enumerate().take(count) {
            // SAFETY: forwarded.
            *out = unsafe { super::single::closest::<S>(bvh, &ray(i)) };
        }
        return;
    }
    // SAFETY: forwarded.
    let state = unsafe { packet_closest::<S>(bvh, origin, packet, tmin, tmax) };
    for (i, out) in out.iter_mut().enumerate().take(count) {
        let triangle = state.triangle[i].to_bits();
        *out = if triangle == NONE {
            RawHit::MISS
        } else {
            let (u, v) = barycentrics(state.u[i], state.v[i], state.sum[i]);
            RawHit { t: state.t[i], u, v, triangle, front: state.sum[i] < 0.0 }
        };
    }
}
