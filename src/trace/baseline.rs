//! Readable baseline: ordered single-ray traversal of the binary tree, one box and one triangle at a time (thesis
//! 3.1.1). The tables compare the kernels with it; nothing else uses it.

use super::{RawHit, Ray};
use crate::bvh::{BinaryBvh, BinaryNode};
use glam::Vec3;

/// Closest hit with `tmin < t ≤ tmax` among the triangles `corners` that `bvh` was built over.
pub fn closest(bvh: &BinaryBvh, corners: &[[Vec3; 3]], ray: &Ray) -> RawHit {
    let (origin, direction) = (Vec3::from(ray.origin), Vec3::from(ray.direction));
    let reciprocal = direction.recip();
    let mut best = RawHit { t: ray.tmax, ..RawHit::MISS };
    let mut stack = Vec::with_capacity(64);
    stack.push((0u32, f32::NEG_INFINITY));
    while let Some((index, near)) = stack.pop() {
        if near > best.t {
            continue;
        }
        let node = &bvh.nodes[index as usize];
        // The index of an inner node is a node number: there is nothing to slice.
        let leaf = if node.count == 0 { &[] } else { &bvh.triangles[node.index as usize..][..node.count as usize] };
        for &triangle in leaf {
            if let Some(hit) = intersect(&corners[triangle as usize], triangle, origin, direction)
                && hit.t > ray.tmin
                && (hit.t < best.t || (hit.t == best.t && triangle < best.triangle))
            {
                best = hit;
            }
        }
        if node.count == 0 {
            let enter = |child: u32| (child, slab(&bvh.nodes[child as usize], origin, reciprocal, ray.tmin, best.t));
            let (left, right) = (enter(index + 1), enter(node.index));
            let (first, second) = if left.1 <= right.1 { (left, right) } else { (right, left) };
            stack.extend([second, first].into_iter().filter(|c| c.1 < f32::INFINITY));
        }
    }
    if best.is_miss() { RawHit::MISS } else { best }
}

/// Distance at which the ray enters a box, +inf if it does not (slab test, Kay and Kajiya 1986).
fn slab(node: &BinaryNode, origin: Vec3, reciprocal: Vec3, tmin: f32, tmax: f32) -> f32 {
    let (a, b) = ((node.lower - origin) * reciprocal, (node.upper - origin) * reciprocal);
    // 0 · ∞ if the origin lies on a plane of a slab that the ray is parallel to: inside.
    let a = Vec3::select(a.is_nan_mask(), Vec3::NEG_INFINITY, a);
    let b = Vec3::select(b.is_nan_mask(), Vec3::INFINITY, b);
    let near = a.min(b).max_element().max(tmin);
    let far = a.max(b).min_element() * super::tree::FAR_SCALE;
    if near <= far.min(super::tree::beyond(tmax)) { near } else { f32::INFINITY }
}

/// Ray-triangle test by edge functions in 3D (Kensler and Shirley 2006): other arithmetic than that of the kernels.
fn intersect(corners: &[Vec3; 3], triangle: u32, origin: Vec3, direction: Vec3) -> Option<RawHit> {
    let [v0, v1, v2] = corners.map(|c| c - origin);
    let u = (v2 - v0).cross(v2 + v0).dot(direction);
    let v = (v0 - v1).cross(v0 + v1).dot(direction);
    let w = (v1 - v2).cross(v1 + v2).dot(direction);
    if u.min(v).min(w) < 0.0 && u.max(v).max(w) > 0.0 {
        return None;
    }
    let normal = (v2 - v0).cross(v0 - v1);
    let den = normal.dot(direction);
    if den == 0.0 {
        return None;
    }
    let sum = u + v + w;
    let (u, v) = super::triangle::barycentrics(u, v, sum);
    Some(RawHit { t: normal.dot(v0) / den, u, v, triangle, front: sum < 0.0 })
}
