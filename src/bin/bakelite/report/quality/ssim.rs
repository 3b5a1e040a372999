//! Structural similarity of two pictures: Wang, Bovik, Sheikh and Simoncelli, *Image Quality
//! Assessment: From Error Visibility to Structural Similarity*, IEEE Transactions on Image Processing
//! 13(4), 2004, with the constants and the Gaussian window of section III.C.

/// Pixels across the window, and the standard deviation of its Gaussian.
const WINDOW: usize = 11;
const SIGMA: f64 = 1.5;

/// (K₁ L)² and (K₂ L)² for levels up to L = 255.
const C1: f64 = 0.01 * 255.0 * 0.01 * 255.0;
const C2: f64 = 0.03 * 255.0 * 0.03 * 255.0;

/// Luma of an sRGB colour (ITU-R BT.601), as in the paper's own program.
fn luma([r, g, b]: [u8; 3]) -> f64 {
    0.299 * r as f64 + 0.587 * g as f64 + 0.114 * b as f64
}

/// The window along one axis, with sum 1. (The Gaussian in two dimensions is the product of two.)
fn window() -> [f64; WINDOW] {
    let weights: [f64; WINDOW] = std::array::from_fn(|i| {
        let x = i as f64 - (WINDOW / 2) as f64;
        (-x * x / (2.0 * SIGMA * SIGMA)).exp()
    });
    let sum: f64 = weights.iter().sum();
    weights.map(|w| w / sum)
}

/// Mean similarity over all windows that lie within the pictures, of sRGB pixels row by row: 1 if the
/// pictures are alike. `None` if they are smaller than the window.
pub fn ssim(a: &[[u8; 3]], b: &[[u8; 3]], width: usize) -> Option<f64> {
    let height = a.len().min(b.len()) / width.max(1);
    if width < WINDOW || height < WINDOW {
        return None;
    }
    // Means of a, b, a², b² and ab along the rows of windows, then down their columns.
    let moments = |i: usize| {
        let (a, b) = (luma(a[i]), luma(b[i]));
        [a, b, a * a, b * b, a * b]
    };
    let weights = window();
    let mean = |at: &dyn Fn(usize) -> [f64; 5]| -> [f64; 5] {
        (0..WINDOW).fold([0.0; 5], |sum, k| {
            let m = at(k);
            std::array::from_fn(|j| sum[j] + weights[k] * m[j])
        })
    };
    let columns = width - WINDOW + 1;
    let rows: Vec<[f64; 5]> = (0..height * columns)
        .map(|i| {
            let start = i / columns * width + i % columns;
            mean(&|k| moments(start + k))
        })
        .collect();
    let windows = (height - WINDOW + 1) * columns;
    let sum: f64 = (0..windows).map(|i| of_window(mean(&|k| rows[i + k * columns]))).sum();
    Some(sum / windows as f64)
}

/// Equation 13, from the means of a, b, a², b² and ab.
fn of_window([a, b, aa, bb, ab]: [f64; 5]) -> f64 {
    let (variance_a, variance_b, covariance) = (aa - a * a, bb - b * b, ab - a * b);
    (2.0 * a * b + C1) * (2.0 * covariance + C2) / ((a * a + b * b + C1) * (variance_a + variance_b + C2))
}

#[cfg(test)]
mod tests {
    use super::*;
    use bakelite::sampling::uniform;

    fn grey(values: impl Iterator<Item = u8>) -> Vec<[u8; 3]> {
        values.map(|v| [v; 3]).collect()
    }

    /// A gradient with noise of an amplitude.
    fn picture(amplitude: f32, seed: u32) -> Vec<[u8; 3]> {
        let level = |i: u32| 60.0 + (i % 40) as f32 * 3.0 + amplitude * (uniform(i, 0, seed) - 0.5);
        grey((0..40 * 30).map(|i| level(i) as u8))
    }

    #[test]
    fn a_picture_is_like_itself_and_noise_makes_it_less_so() {
        assert!((ssim(&picture(50.0, 1), &picture(50.0, 1), 40).unwrap() - 1.0).abs() < 1e-12);
        let noisy = [5.0, 20.0, 80.0].map(|amplitude| ssim(&picture(0.0, 1), &picture(amplitude, 2), 40).unwrap());
        assert!(1.0 > noisy[0] && noisy[0] > noisy[1] && noisy[1] > noisy[2] && noisy[2] > 0.0, "{noisy:?}");
        assert_eq!(ssim(&picture(0.0, 1), &picture(0.0, 1), 10), None);
    }

    /// Flat pictures of different levels: what is left of equation 13 is (2ab + C₁) / (a² + b² + C₁).
    #[test]
    fn flat_pictures_differ_by_their_levels_alone() {
        let (a, b) = (grey([100; 200].into_iter()), grey([150; 200].into_iter()));
        let expected = (2.0 * 100.0 * 150.0 + 6.5025) / (100.0 * 100.0 + 150.0 * 150.0 + 6.5025);
        assert!((ssim(&a, &b, 11).unwrap() - expected).abs() < 1e-12);
    }

    /// One window, by its definition: weights over two dimensions, moments around the means.
    #[test]
    fn a_window_has_the_value_of_the_definition() {
        let (a, b) = (|i: usize| (i * 37 % 251) as u8, |i: usize| (i * 53 % 199) as u8);
        let (mut weights, mut sum) = (Vec::new(), 0.0);
        for i in 0..121 {
            let (x, y) = ((i % 11) as f64 - 5.0, (i / 11) as f64 - 5.0);
            weights.push((-(x * x + y * y) / 4.5).exp());
            sum += weights[i];
        }
        let mean = |of: &dyn Fn(usize) -> f64| (0..121).map(|i| weights[i] / sum * of(i)).sum::<f64>();
        let (ma, mb) = (mean(&|i| a(i) as f64), mean(&|i| b(i) as f64));
        let va = mean(&|i| (a(i) as f64 - ma).powi(2));
        let vb = mean(&|i| (b(i) as f64 - mb).powi(2));
        let vab = mean(&|i| (a(i) as f64 - ma) * (b(i) as f64 - mb));
        let expected =
            (2.0 * ma * mb + 6.5025) * (2.0 * vab + 58.5225) / ((ma * ma + mb * mb + 6.5025) * (va + vb + 58.5225));
        let got = ssim(&grey((0..121).map(a)), &grey((0..121).map(b)), 11).unwrap();
        assert!((got - expected).abs() < 1e-9, "{got}, not {expected}");
    }
}
