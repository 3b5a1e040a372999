//! Directions uniform in the solid angle of a triangle: Arvo, *Stratified Sampling of Spherical
//! Triangles*, SIGGRAPH 1995.
//!
//! Samples uniform in area crowd, as seen from a point close to a light, where the light is far and matters little. If
//! they are uniform in solid angle, the contribution of each is its cosine at the point: bounded.

use glam::DVec3;

/// A triangle on the unit sphere.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SphericalTriangle {
    a: DVec3,
    b: DVec3,
    /// Unit direction at `a` towards the third corner.
    towards_c: DVec3,
    /// Angle at `a`, its sine and cosine.
    alpha: f64,
    sin_alpha: f64,
    cos_alpha: f64,
    /// Cosine of the arc from `a` to `b`.
    cos_ab: f64,
    solid_angle: f64,
}

/// Solid angle of the triangle with unit corner directions (Van Oosterom and Strackee, *The Solid
/// Angle of a Plane Triangle*, 1983).
fn solid_angle([a, b, c]: [DVec3; 3]) -> f64 {
    2.0 * a.dot(b.cross(c)).abs().atan2(1.0 + a.dot(b) + b.dot(c) + c.dot(a))
}

impl SphericalTriangle {
    /// Makes a triangle from corners seen from the origin, in any order; `None` if one of them is the origin or they
    /// lie in a plane with it.
    pub(crate) fn new(corners: [DVec3; 3]) -> Option<SphericalTriangle> {
        let [a, b, c] = corners.map(DVec3::normalize_or_zero);
        let solid_angle = solid_angle([a, b, c]);
        let (to_b, to_c) = (b.reject_from_normalized(a), c.reject_from_normalized(a));
        let (sine, cosine) = (to_b.cross(to_c).length(), to_b.dot(to_c));
        let (alpha, length) = (sine.atan2(cosine), (sine * sine + cosine * cosine).sqrt());
        let (sin_alpha, cos_alpha) = (sine / length, cosine / length);
        // False for NaN, as of corners in the same direction.
        let valid = solid_angle > 0.0 && sin_alpha > 0.0 && (a.length_squared() * b.length_squared()) > 0.0;
        let towards_c = to_c.normalize_or_zero();
        valid.then(|| SphericalTriangle { a, b, towards_c, alpha, sin_alpha, cos_alpha, cos_ab: a.dot(b), solid_angle })
    }

    /// Solid angle in steradians.
    pub(crate) fn solid_angle(&self) -> f64 {
        self.solid_angle
    }

    /// A unit direction, uniform in the triangle for `u` uniform in the unit square.
    pub(crate) fn sample(&self, u: [f32; 2]) -> DVec3 {
        // Corner on ac of the part of the triangle that has the side ab and u₀ times the area of the whole.
        let (s, t) = (u[0] as f64 * self.solid_angle - self.alpha).sin_cos();
        let (p, q) = (t - self.cos_alpha, s + self.sin_alpha * self.cos_ab);
        let cos_side = ((q * t - p * s) * self.cos_alpha - q) / ((q * s + p * t) * self.sin_alpha);
        // Rounding may leave 0/0 at u₀ = 0.
        let cos_side = if cos_side.is_nan() { 1.0 } else { cos_side.clamp(-1.0, 1.0) };
        let corner = at_cosine(self.a, self.towards_c, cos_side);
        // The direction lies on the arc from b to that corner.
        let between = corner.dot(self.b);
        let towards_corner = (corner - self.b * between).normalize_or_zero();
        at_cosine(self.b, towards_corner, 1.0 - u[1] as f64 * (1.0 - between))
    }
}

/// The direction on the arc that begins at `from` with the unit direction `towards`, at the angle whose cosine is `cosine`.
fn at_cosine(from: DVec3, towards: DVec3, cosine: f64) -> DVec3 {
    from * cosine + towards * (1.0 - cosine * cosine).max(0.0).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::sampling::sobol_2d;
    use std::f64::consts::PI;

    #[test]
    fn an_octant_is_an_eighth_of_the_sphere() {
        let t = SphericalTriangle::new([DVec3::X * 3.0, DVec3::Y, DVec3::Z * 0.1]).unwrap();
        assert!((t.solid_angle() - PI / 2.0).abs() < 1e-12);
    }

    #[test]
    fn directions_are_uniform_in_the_solid_angle() {
        let triangles = [
            [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            [[-3.0, -1.0, 0.01], [2.0, -1.0, 0.01], [0.3, 4.0, 0.01]],
            [[1.0, 0.1, 0.2], [1.2, -0.4, 0.2], [0.8, 0.3, -0.5]],
            [[5.0, 0.0, 1.0], [0.0, 0.05, 1.0], [0.0, 0.0, 1.0]],
        ];
        for corners in triangles {
            let corners = corners.map(DVec3::from_array);
            for order in [[0, 1, 2], [2, 1, 0], [1, 2, 0]] {
                let t = SphericalTriangle::new(order.map(|i| corners[i])).unwrap();
                // Each part of the triangle, cut by the great circle from a corner through a point of
                // the opposite side, gets directions in proportion to its own solid angle.
                let cut = (corners[1] + corners[2]) * 0.5;
                let part = SphericalTriangle::new([corners[0], corners[1], cut]).unwrap().solid_angle();
                let side = corners[0].cross(cut);
                let (n, mut inside) = (1 << 14, 0);
                for i in 0..n {
                    let d = t.sample(sobol_2d(i, 5));
                    assert!((d.length() - 1.0).abs() < 1e-9);
                    for e in 0..3 {
                        let plane = corners[e].cross(corners[(e + 1) % 3]).normalize();
                        let outside = plane.dot(d) * plane.dot(corners[(e + 2) % 3]).signum();
                        assert!(outside > -1e-9, "{corners:?}: {d} is {outside} outside");
                    }
                    inside += (side.dot(d) * side.dot(corners[1]) > 0.0) as u32;
                }
                let (got, expected) = (inside as f64 / n as f64, part / t.solid_angle());
                assert!((got - expected).abs() < 1e-3, "{corners:?}: {got}, not {expected}");
            }
        }
    }
}
