//! Elementary functions as polynomials: faster than those of the C library, and with the same bits on every machine, which
//! those do not promise.
//!
//! The coefficients are those of Moshier's Cephes library (`sinf`, `cosf` and `expf`).

/// Sine and cosine of an angle in [-π/4, π/4], to about a unit in the last place.
#[inline]
pub(crate) fn sin_cos(x: f32) -> (f32, f32) {
    let z = x * x;
    let sin = ((-1.951_529_6e-4 * z + 8.332_161e-3) * z - 0.166_666_55) * z * x + x;
    let cos = ((2.443_315_7e-5 * z - 1.388_731_6e-3) * z + 4.166_664_6e-2) * z * z - 0.5 * z + 1.0;
    (sin, cos)
}

/// e to the power of `x`, which is at most 0, to about a unit in the last place; 0 below -87 and of what is not a number.
#[inline]
pub(crate) fn exp_of_negative(x: f32) -> f32 {
    if !(x >= -87.0) {
        return 0.0;
    }
    const LOG2_E: f32 = std::f32::consts::LOG2_E;
    let n = (x * LOG2_E - 0.5) as i32;
    let whole = n as f32;
    // ln 2 in two parts, the first of which has few digits.
    let r = x - whole * 0.693_359_4 + whole * 2.121_944_4e-4;
    let p = 1.987_569_1e-4;
    let p = ((((p * r + 1.398_199_9e-3) * r + 8.333_452e-3) * r + 4.166_579_6e-2) * r + 0.166_666_65) * r + 0.5;
    let fraction = p * r * r + r + 1.0;
    fraction * f32::from_bits(((n + 127) as u32) << 23)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::FRAC_PI_4;

    #[test]
    fn they_are_those_of_f64_to_about_a_unit_in_the_last_place() {
        for i in -10_000..=10_000 {
            let x = (f64::from(i) / 10_000.0 * FRAC_PI_4) as f32;
            let (sin, cos) = sin_cos(x);
            let exact = f64::from(x).sin_cos();
            assert!((f64::from(sin) - exact.0).abs() <= 1.2e-7 * exact.0.abs(), "sin {x}");
            assert!((f64::from(cos) - exact.1).abs() <= 1.2e-7, "cos {x}");
        }
        for i in 0..=87_000 {
            let x = -(i as f32) / 1000.0;
            let exact = f64::from(x).exp();
            assert!((f64::from(exp_of_negative(x)) / exact - 1.0).abs() <= 2e-7, "exp {x}");
        }
    }

    #[test]
    fn ends_and_nonsense() {
        assert_eq!(sin_cos(0.0), (0.0, 1.0));
        assert_eq!([0.0, -0.0].map(exp_of_negative), [1.0; 2]);
        assert_eq!([-88.0, -1e30, f32::NEG_INFINITY, f32::NAN].map(exp_of_negative), [0.0; 4]);
    }
}
