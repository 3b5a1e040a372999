//! What the measurements of several reports share.

use bakelite::lightmap::{Layer, LayerData, Lightmap};
use bakelite::sampling::{combine, cosine_around, mix, uniform, uniform_triangle};
use bakelite::trace::Ray;
use bakelite::{Error, Result, Scene};
use glam::Vec3;

/// The middle one of some values; of an even number the upper one.
pub fn median(mut values: Vec<f64>) -> f64 {
    values.sort_unstable_by(f64::total_cmp);
    values[values.len() / 2]
}

/// The exponent b of the power a · x^b that fits points best, by least squares of logarithms. `None` if that is
/// undefined: fewer than two different x, or a y that is not above 0.
pub fn exponent(points: &[[f64; 2]]) -> Option<f64> {
    let logs: Vec<[f64; 2]> = points.iter().map(|p| p.map(f64::ln)).collect();
    let n = logs.len() as f64;
    let mean = [0, 1].map(|i| logs.iter().map(|l| l[i]).sum::<f64>() / n);
    let moment = |i: usize| logs.iter().map(|l| (l[0] - mean[0]) * (l[i] - mean[i])).sum::<f64>();
    let exponent = moment(1) / moment(0);
    exponent.is_finite().then_some(exponent)
}

/// One of `all` by a number whose neighbours choose others.
pub fn pick<T: Copy>(all: &[T], number: u32) -> T {
    all[((mix(number) as u64 * all.len() as u64) >> 32) as usize]
}

/// Rays from random points on random triangles over the hemisphere, `per_point` from each.
pub fn surface_rays(scene: &Scene, rays: u32, per_point: u32) -> Vec<Ray> {
    let any = (0..).map(|i| (i, ((mix(i) as u64 * scene.triangle_count() as u64) >> 32) as u32));
    let valid = any.filter(|&(_, t)| scene.is_valid(t)).take((rays / per_point) as usize);
    let of_point = |(i, t): (u32, u32)| {
        let [u, v] = uniform_triangle([uniform(i, 0, 1), uniform(i, 1, 1)]);
        let (normal, [a, b, c]) = (scene.normal(t), scene.corners(t));
        let ray = move |k: u32| {
            let n = if k == 0 { i } else { combine(i, k) };
            Ray::new(a + u * (b - a) + v * (c - a), cosine_around(normal, [uniform(n, 2, 1), uniform(n, 3, 1)]))
        };
        (0..per_point).map(ray)
    };
    valid.flat_map(of_point).collect()
}

/// Positions and normals of all texels that are not inside solids: at least one.
pub fn visible_texels(lightmap: &Lightmap) -> Result<Vec<[Vec3; 2]>> {
    let mut texels = Vec::new();
    for page in 0..lightmap.info().page_count {
        let read = |layer| lightmap.read(page, layer);
        let layers = (read(Layer::Validity)?, read(Layer::Position)?, read(Layer::Normal)?);
        let (LayerData::Scalar(validity), LayerData::Rgb(positions), LayerData::Rgb(normals)) = layers else {
            return Err(Error::Internal("a layer is of another type".into()));
        };
        let all = validity.into_iter().zip(positions.into_iter().zip(normals));
        texels.extend(all.filter(|(v, _)| *v == 1.0).map(|(_, (p, n))| [Vec3::from(p), Vec3::from(n)]));
    }
    match texels.len() {
        0 => Err(Error::InvalidArgument("no texel of the scene can be seen".into())),
        _ => Ok(texels),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn powers_have_their_exponents() {
        let of = |power: f64| [1e3, 2e4, 5e6].map(|x: f64| [x, 7.0 * x.powf(power)]);
        for power in [1.0, 0.125, -0.3] {
            assert!((exponent(&of(power)).unwrap() - power).abs() < 1e-9);
        }
        assert_eq!(exponent(&[[1e3, 2.0]]), None);
        assert_eq!(exponent(&[[1e3, 2.0], [2e3, 0.0]]), None);
    }
}
