//! Cuts triangles at a plane: the boxes of the parts, for [spatial splits](super::spatial).
//!
//! A reference's box holds its part of the triangle with a margin. The kernels decide hits on
//! corners that the subtraction of the ray's origin has rounded, by up to 2^-24 of the distance
//! between them. Around a whole triangle, the box test's own margin covers that; at a cut it may not, because the
//! corners can be much farther away than the box. So parts are padded by a little more than this rounding over the
//! triangle's extent, and no ray slips past a cut.

use super::references::Box4;
use glam::{DVec3, Vec3};

/// Padding of parts as a fraction of the triangle's extent: four times the distance that rounding moves its corners.
const PADDING: f64 = 1.0 / (1 << 22) as f64;

/// Relative bound of the rounding error of a cut's f64 coordinates, by the greatest coordinate.
const ROUNDING: f64 = 1.0 / (1u64 << 48) as f64;

/// The parts of a triangle below and above `position` on `axis`, within `bounds`; an empty box for an empty part.
pub(super) fn cut(corners: &[Vec3; 3], bounds: Box4, axis: usize, position: f32) -> [Box4; 2] {
    let v = corners.map(|c| c.as_dvec3());
    let plane = f64::from(position);
    let mut parts = [(DVec3::INFINITY, DVec3::NEG_INFINITY); 2];
    let mut grow = |side: usize, p: DVec3| parts[side] = (parts[side].0.min(p), parts[side].1.max(p));
    for i in 0..3 {
        let (a, b) = (v[i], v[(i + 1) % 3]);
        if a[axis] <= plane {
            grow(0, a);
        }
        if a[axis] >= plane {
            grow(1, a);
        }
        if (a[axis] < plane && plane < b[axis]) || (b[axis] < plane && plane < a[axis]) {
            let p = a + (b - a) * ((plane - a[axis]) / (b[axis] - a[axis]));
            grow(0, p);
            grow(1, p);
        }
    }
    let lower = v[0].min(v[1]).min(v[2]);
    let upper = v[0].max(v[1]).max(v[2]);
    let pad = PADDING * (upper - lower).max_element() + ROUNDING * lower.abs().max(upper.abs()).max_element();
    parts[0].1[axis] = parts[0].1[axis].min(plane);
    parts[1].0[axis] = parts[1].0[axis].max(plane);
    parts.map(|(lower, upper)| {
        let lower = (lower - pad).to_array().map(round_down);
        let upper = (upper + pad).to_array().map(|x| -round_down(-x));
        Box4::new(lower.into(), upper.into()).meet(bounds)
    })
}

/// The greatest f32 that is not above `x`.
fn round_down(x: f64) -> f32 {
    let y = x as f32;
    if f64::from(y) > x { y.next_down() } else { y }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_parts_of_a_cut_meet_at_the_plane_and_stay_in_the_box() {
        let t = [Vec3::ZERO, Vec3::new(4.0, 0.0, 0.0), Vec3::new(4.0, 2.0, 0.0)];
        let whole = Box4::new(Vec3::ZERO, Vec3::new(4.0, 2.0, 0.0));
        let [a, b] = cut(&t, whole, 0, 1.0).map(|b| b.corners());
        assert!(a.1.x >= 1.0 && a.1.x < 1.0001 && a.1.y >= 0.5 && a.1.y < 0.5001);
        assert!(b.0.x <= 1.0 && b.0.x > 0.9999 && b.0.y == 0.0 && b.1 == Vec3::new(4.0, 2.0, 0.0));
        assert!(cut(&t, whole, 0, -1.0)[0].is_empty());
        assert!(cut(&t, whole, 1, 3.0)[1].is_empty());
    }
}
