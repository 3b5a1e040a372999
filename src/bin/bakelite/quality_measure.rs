//! Measurements of the error of light: the points compared, their reference, and the error of several
//! runs with different seeds, bias and variance apart.

use crate::measure::{pick, visible_texels};
use bakelite::lightmap::texels::TexelSample;
use bakelite::lightmap::{Layer, Lightmap};
use bakelite::reference::{PathTracer, SurfacePoint};
use bakelite::sampling::{cosine_around, uniform, uniform_sphere};
use bakelite::trace::Ray;
use bakelite::trace::offset::offset_ray_origin;
use bakelite::{Error, Progress, Result};
use glam::Vec3;

/// Attempts per point, most of which fail where little is enclosed.
const TRIES: u32 = 100;

/// Gaps narrower than this part of the scene's diagonal are not where anybody looks from.
const MIN_ROOM: f32 = 0.02;

/// Irradiance at each point.
pub type Values = Vec<[f64; 3]>;

/// Points of surfaces, as often as they are seen from places in the scene.
pub struct Points {
    /// Global triangle, whether it is its front, and weights of its corners 1 and 2.
    pub on: Vec<(u32, bool, f32, f32)>,
    /// Unit normals of the sides that the light map holds.
    pub normals: Vec<Vec3>,
    pub positions: Vec<Vec3>,
    /// Irradiance of the reference, indirect and all, as two halves with independent noise.
    pub indirect: [Values; 2],
    pub all: [Values; 2],
    /// How many more were seen, on sides that the light map does not hold.
    pub of_other_sides: usize,
}

/// Texels darker than this part of the mean are judged as if they were so bright: a picture exposed for
/// the mean shows no more.
pub const DARK: f64 = 0.1;

/// Errors over many seeds.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Errors {
    /// Mean over texels and channels of the squared error by the squared reference.
    pub mse: f64,
    /// The part of `mse` that differs from seed to seed.
    pub variance: f64,
    /// The part that does not. May come out below 0 where it is hidden by noise.
    pub bias2: f64,
    /// Mean of the squared error by the square of the reference's mean: bright texels count most.
    pub to_mean: f64,
    /// Mean of the error by the mean of the reference: how much too bright.
    pub mean: f64,
    /// Standard error of `mse` over the points.
    pub uncertainty: f64,
}

impl Points {
    /// Chooses `count` points of the surfaces of a baked light map and path traces the reference there, with `paths` in
    /// f64 per point.
    pub fn new(lightmap: &Lightmap, count: usize, paths: u32, progress: &Progress) -> Result<Points> {
        let mut points = Points {
            on: Vec::new(),
            normals: Vec::new(),
            positions: Vec::new(),
            indirect: Default::default(),
            all: Default::default(),
            of_other_sides: 0,
        };
        points.choose(lightmap, count)?;
        let scene = lightmap.scene();
        let tracer = PathTracer::new(scene);
        let surface: Vec<SurfacePoint> = (0..points.on.len())
            .map(|i| SurfacePoint {
                position: points.positions[i].as_dvec3(),
                normal: points.normals[i].as_dvec3().normalize(),
            })
            .collect();
        for half in 0..2 {
            let e = tracer.irradiance_many(scene.device(), &surface, paths.div_ceil(2), half as u64 + 77, progress)?;
            points.indirect[half] = e.iter().map(|e| e.indirect).collect();
            points.all[half] = e.iter().map(|e| e.total()).collect();
        }
        Ok(points)
    }

    /// Points that are seen from places in the air: halfway between a random texel and what it sees, in
    /// random directions.
    fn choose(&mut self, lightmap: &Lightmap, count: usize) -> Result<()> {
        let scene = lightmap.scene();
        let texels = visible_texels(lightmap)?;
        let room = MIN_ROOM * scene.diagonal();
        for i in 0..count as u32 * TRIES {
            if self.len() == count {
                return Ok(());
            }
            let [position, normal] = pick(&texels, i);
            let direction = cosine_around(normal, [uniform(i, 0, 0), uniform(i, 1, 0)]);
            let origin = offset_ray_origin(position, normal, scene);
            let t = scene.intersect_raw(&Ray::new(origin, direction)).t;
            if !(t.is_finite() && t > room) {
                continue;
            }
            let look = uniform_sphere([uniform(i, 2, 0), uniform(i, 3, 0)]);
            let hit = scene.intersect_raw(&Ray::new(origin + 0.5 * t * direction, look));
            if hit.is_miss() {
                continue;
            }
            if !lightmap.shows(hit.triangle, hit.front) {
                self.of_other_sides += 1;
                continue;
            }
            let side = if hit.front { 1.0 } else { -1.0 };
            let sample = TexelSample { triangle: hit.triangle, u: hit.u, v: hit.v, ..Default::default() };
            self.on.push((hit.triangle, hit.front, hit.u, hit.v));
            self.positions.push(sample.position(scene));
            self.normals.push(side * sample.shading_normal(scene));
        }
        match self.len() {
            0 => Err(Error::InvalidArgument("no surface of the scene is seen from another".into())),
            _ => Ok(()),
        }
    }

    pub fn len(&self) -> usize {
        self.on.len()
    }

    /// Light that a light map of the same scene has at the points.
    pub fn of_bake(&self, lightmap: &Lightmap, layer: Layer) -> Values {
        self.on.iter().map(|&(t, front, u, v)| lightmap.sample(layer, t, front, u, v).map(f64::from)).collect()
    }
}

/// Errors of several runs against the two halves of a reference. The squared error of x is estimated by
/// (x − a)(x − b) from the halves a and b: as their noise is independent, the noise of the reference is not
/// part of it.
pub fn errors(runs: &[Values], [a, b]: &[Values; 2]) -> Errors {
    let (points, k) = (a.len() as f64, runs.len() as f64);
    let mean_of = |v: &Values| v.iter().flatten().sum::<f64>() / (3.0 * points);
    let mean = 0.5 * (mean_of(a) + mean_of(b));
    let least = (DARK * mean).powi(2);
    let (mut mse, mut variance, mut squares, mut to_mean) = (0.0, 0.0, 0.0, 0.0);
    for i in 0..a.len() {
        let mut of_point = 0.0;
        for c in 0..3 {
            let weight = 1.0 / ((0.5 * (a[i][c] + b[i][c])).powi(2) + least) / 3.0;
            let square = runs.iter().map(|x| (x[i][c] - a[i][c]) * (x[i][c] - b[i][c])).sum::<f64>() / k;
            of_point += weight * square;
            to_mean += square / (3.0 * points * mean * mean);
            if runs.len() > 1 {
                let mean = runs.iter().map(|x| x[i][c]).sum::<f64>() / k;
                variance += weight * runs.iter().map(|x| (x[i][c] - mean).powi(2)).sum::<f64>() / (k - 1.0);
            }
        }
        mse += of_point / points;
        squares += of_point * of_point / points;
    }
    variance /= points;
    Errors {
        mse,
        variance,
        bias2: mse - variance,
        to_mean,
        mean: runs.iter().map(mean_of).sum::<f64>() / k / mean - 1.0,
        uncertainty: ((squares - mse * mse).max(0.0) / points).sqrt(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use bakelite::sampling::mix;

    #[test]
    fn bias_variance_and_the_noise_of_the_reference_come_apart() {
        // Truth 2 everywhere; runs are 10 % too bright and differ by ± 0.3; halves differ by ± 0.04.
        let points = 4000;
        let sign = |i: usize, k: u32| if mix(i as u32 * 64 + k) & 1 == 0 { 1.0 } else { -1.0 };
        let values = |x: &dyn Fn(usize) -> f64| (0..points).map(|i| [x(i); 3]).collect::<Values>();
        let halves = [values(&|i| 2.0 + 0.04 * sign(i, 0)), values(&|i| 2.0 + 0.04 * sign(i, 1))];
        let runs: Vec<Values> = (2..18).map(|k| values(&|i| 2.2 + 0.3 * sign(i, k))).collect();
        let e = errors(&runs, &halves);
        // What is darker than a tenth of the mean counts as so bright: a part of a hundred here.
        let dark = 1.01;
        assert!((e.variance * dark - 0.0225).abs() < 4e-4, "{e:?}");
        assert!((e.bias2 * dark - 0.01).abs() < 4e-4, "{e:?}");
        assert!((e.mse * dark - 0.0325).abs() < 8e-4, "{e:?}");
        assert!((e.to_mean - 0.0325).abs() < 8e-4, "{e:?}");
        assert!((e.mean - 0.1).abs() < 2e-3, "{e:?}");
    }
}
