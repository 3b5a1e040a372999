//! Irradiance from a polygon of uniform radiance, unoccluded: Lambert's formula of 1760 (in the
//! vector form of Arvo, *Analytic Methods for Simulated Light Transport*, 1995), with the polygon
//! clipped at the receiver's horizon.

use glam::DVec3;

/// Form factor × π of a polygon seen from the origin with unit normal `normal`: the irradiance if its radiance is 1.
/// Corners may be in either order; the sign is dropped. Computed in f64: the corner directions of small or distant
/// lights differ little.
pub(crate) fn irradiance(corners: &[DVec3], normal: DVec3) -> f64 {
    let mut clipped = [DVec3::ZERO; 5];
    let n = clip_to_horizon(corners, normal, &mut clipped);
    if n < 3 {
        return 0.0;
    }
    let mut sum = DVec3::ZERO;
    for i in 0..n {
        let (a, b) = (clipped[i], clipped[(i + 1) % n]);
        let cross = a.cross(b);
        let sine = cross.length();
        if sine > 0.0 {
            // atan2 is accurate for small angles, unlike acos of the dot product.
            sum += cross * (sine.atan2(a.dot(b)) / sine);
        }
    }
    0.5 * sum.dot(normal).abs()
}

/// The part of a triangle or quadrilateral above the plane through the origin (Sutherland-Hodgman).
fn clip_to_horizon(corners: &[DVec3], normal: DVec3, out: &mut [DVec3; 5]) -> usize {
    let mut n = 0;
    for (i, &a) in corners.iter().enumerate() {
        let b = corners[(i + 1) % corners.len()];
        let (da, db) = (a.dot(normal), b.dot(normal));
        if da >= 0.0 {
            out[n] = a;
            n += 1;
        }
        if (da > 0.0 && db < 0.0) || (da < 0.0 && db > 0.0) {
            out[n] = a + (b - a) * (da / (da - db));
            n += 1;
        }
    }
    n
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    #[test]
    fn a_polygon_that_fills_the_sky_gives_pi() {
        let s = 1e7;
        let square = [[-s, -s], [s, -s], [s, s], [-s, s]].map(|[x, y]| DVec3::new(x, y, 1.0));
        assert!((irradiance(&square, DVec3::Z) - PI).abs() < 1e-5);
    }

    #[test]
    fn a_parallel_square_has_the_textbook_form_factor() {
        // Differential element below the corner of an a × b rectangle at height c (Howell, B-4).
        let (a, b, c) = (1.3f64, 0.7f64, 0.9f64);
        let rect = [[0.0, 0.0], [a, 0.0], [a, b], [0.0, b]].map(|[x, y]| DVec3::new(x, y, c));
        let (x, y) = (a / c, b / c);
        let (sx, sy) = ((1.0 + x * x).sqrt(), (1.0 + y * y).sqrt());
        let factor = (x / sx * (y / sx).atan() + y / sy * (x / sy).atan()) / (2.0 * PI);
        assert!((irradiance(&rect, DVec3::Z) - PI * factor).abs() < 1e-12);
    }

    #[test]
    fn what_is_below_the_horizon_does_not_count() {
        let wall =
            |lo: f64, hi: f64| [[-1.0, lo], [1.0, lo], [1.0, hi], [-1.0, hi]].map(|[y, z]| DVec3::new(1.0, y, z));
        let (upper, whole) = (irradiance(&wall(0.0, 1.0), DVec3::Z), irradiance(&wall(-3.0, 1.0), DVec3::Z));
        assert!((upper - whole).abs() < 1e-12 && upper > 0.1);
        assert_eq!(irradiance(&wall(-2.0, -1.0), DVec3::Z), 0.0);
    }

    #[test]
    fn a_small_distant_light_follows_the_inverse_square() {
        let e = 1e-4;
        let light = [[-e, -e], [e, -e], [e, e], [-e, e]].map(|[x, y]| DVec3::new(x, y, 100.0));
        let expected = 4.0 * e * e / 1e4;
        assert!((irradiance(&light, DVec3::Z) / expected - 1.0).abs() < 1e-6);
    }
}
