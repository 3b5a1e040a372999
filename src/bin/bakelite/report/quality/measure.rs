//! Measurements of the error of light: the points compared, their reference, and the error of several
//! runs with different seeds, bias and variance apart.

use super::places;
use bakelite::lightmap::atlas::texels::TexelSample;
use bakelite::lightmap::{Layer, LayerData, Lightmap, MeshUvs};
use bakelite::reference::{PathTracer, SurfacePoint};
use bakelite::sampling::{uniform, uniform_sphere};
use bakelite::scene::{Camera, Light, NONE};
use bakelite::trace::Ray;
use bakelite::{Error, Progress, Result};
use glam::{DVec3, Vec2, Vec3};
use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::fmt::Write;
use std::path::Path;

/// Attempts per point, most of which fail where little is enclosed.
const TRIES: u32 = 100;

/// The part of the points that is left out with the worst.
const WORST: f64 = 0.01;

/// Irradiance at each point.
pub type Values = Vec<[f64; 3]>;

/// Points of surfaces, as often as they are seen from places in the scene where somebody can stand.
#[derive(Clone, Default)]
pub struct Points {
    /// Global triangle, whether it is its front, and weights of its corners 1 and 2.
    pub on: Vec<(u32, bool, f32, f32)>,
    /// Unit normals of the sides that are seen.
    pub normals: Vec<Vec3>,
    pub positions: Vec<Vec3>,
    /// Irradiance of the reference, indirect and all, as two halves with independent noise.
    pub indirect: [Values; 2],
    pub all: [Values; 2],
}

/// What a file of points has of each: where it is, the light of a bake, to look at, and the reference.
const COLUMNS: &str = "triangle,u,v,x,y,z,nx,ny,nz,bake_r,bake_g,bake_b,\
                       indirect_a_r,indirect_a_g,indirect_a_b,indirect_b_r,indirect_b_g,indirect_b_b,\
                       all_a_r,all_a_g,all_a_b,all_b_r,all_b_g,all_b_b";

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
    /// `mse` without the worst hundredth of the points.
    pub trimmed: f64,
    /// Standard error of `mse` over the points.
    pub uncertainty: f64,
}

impl Points {
    /// Path traces the reference at the points, with `paths` in f64 per point.
    pub fn with_reference(mut self, lightmap: &Lightmap, paths: u32, progress: &Progress) -> Result<Points> {
        let points = &mut self;
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
        Ok(self)
    }

    /// Chooses `count` points of surfaces, others for each seed, that are seen from places that can be reached from
    /// `camera` and from the lamps, on whatever side; without a reference. More points begin with fewer ones.
    pub fn chosen(lightmap: &Lightmap, camera: &Camera, count: usize, seed: u32) -> Result<Points> {
        let mut points = Points::default();
        points.choose(lightmap, camera, count, seed)?;
        let none = || std::array::from_fn(|_| vec![[0.0; 3]; points.len()]);
        (points.indirect, points.all) = (none(), none());
        Ok(points)
    }

    /// The points and the reference of an earlier report of the same scene, as [`csv`](Self::csv) writes them.
    pub fn read(path: &Path, lightmap: &Lightmap) -> Result<Points> {
        let scene = lightmap.scene();
        let invalid = |what: String| Error::InvalidArgument(format!("{}: {what}", path.display()));
        let text = std::fs::read_to_string(path).map_err(|e| Error::Io(format!("{}: {e}", path.display())))?;
        let mut lines = text.lines();
        if lines.next() != Some(COLUMNS) {
            return Err(invalid("not the quality-points.csv of a report".into()));
        }
        let mut points = Points::default();
        for line in lines {
            let numbers: Vec<f64> = line.split(',').map_while(|n| n.parse().ok()).collect();
            let &[triangle, u, v, x, y, z, nx, ny, nz, _, _, _, ref halves @ ..] = &numbers[..] else {
                return Err(invalid(format!("no point: {line}")));
            };
            let &[ir, ig, ib, jr, jg, jb, ar, ag, ab, br, bg, bb] = halves else {
                return Err(invalid(format!("no point: {line}")));
            };
            let (triangle, u, v) = (triangle as u32, u as f32, v as f32);
            let (position, normal) = (DVec3::new(x, y, z).as_vec3(), DVec3::new(nx, ny, nz).as_vec3());
            let sample = TexelSample { triangle, u, v, ..Default::default() };
            if triangle as usize >= scene.stats().triangles as usize
                || sample.position(scene).distance(position) > 1e-3 * scene.diagonal()
            {
                return Err(invalid(format!("of another scene: {line}")));
            }
            let front = normal.dot(scene.normal(triangle)) > 0.0;
            points.on.push((triangle, front, u, v));
            points.positions.push(position);
            points.normals.push(normal);
            for (values, value) in points.indirect.iter_mut().zip([[ir, ig, ib], [jr, jg, jb]]) {
                values.push(value);
            }
            for (values, value) in points.all.iter_mut().zip([[ar, ag, ab], [br, bg, bb]]) {
                values.push(value);
            }
        }
        if points.len() == 0 {
            return Err(invalid("no points".into()));
        }
        Ok(points)
    }

    /// The points on sides that a light map shows.
    pub fn shown_by(&self, lightmap: &Lightmap) -> Result<Points> {
        let shown: Vec<usize> = (0..self.len()).filter(|&i| lightmap.shows(self.on[i].0, self.on[i].1)).collect();
        if shown.is_empty() {
            return Err(Error::InvalidArgument("no point is on a side that the light map shows".into()));
        }
        let values = |all: &[Values; 2]| all.each_ref().map(|v| shown.iter().map(|&i| v[i]).collect());
        Ok(Points {
            on: shown.iter().map(|&i| self.on[i]).collect(),
            normals: shown.iter().map(|&i| self.normals[i]).collect(),
            positions: shown.iter().map(|&i| self.positions[i]).collect(),
            indirect: values(&self.indirect),
            all: values(&self.all),
        })
    }

    /// Direct light of the reference.
    pub fn direct(&self) -> [Values; 2] {
        std::array::from_fn(|half| {
            let (all, indirect) = (&self.all[half], &self.indirect[half]);
            all.iter().zip(indirect).map(|(a, i)| std::array::from_fn(|c| a[c] - i[c])).collect()
        })
    }

    /// The points and the reference, with the light of a `bake` beside it.
    pub fn csv(&self, bake: &Values) -> String {
        let mut out = format!("{COLUMNS}\n");
        for i in 0..self.len() {
            let (t, _, u, v) = self.on[i];
            let (p, n) = (self.positions[i], self.normals[i]);
            let _ = write!(out, "{t},{u:e},{v:e},{},{},{},{},{},{}", p.x, p.y, p.z, n.x, n.y, n.z);
            for [r, g, b] in [bake, &self.indirect[0], &self.indirect[1], &self.all[0], &self.all[1]].map(|v| v[i]) {
                let _ = write!(out, ",{r:e},{g:e},{b:e}");
            }
            out.push('\n');
        }
        out
    }

    /// Hits of random rays from places in turn.
    fn choose(&mut self, lightmap: &Lightmap, camera: &Camera, count: usize, seed: u32) -> Result<()> {
        let scene = lightmap.scene();
        let places = places::find(scene, &known_places(lightmap, camera), camera.up.normalize(), seed);
        for i in 0..count as u32 * TRIES {
            if places.is_empty() || self.len() == count {
                break;
            }
            let place = places[i as usize % places.len()];
            let look = uniform_sphere([uniform(i, 2, seed), uniform(i, 3, seed)]);
            let hit = scene.intersect_raw(&Ray::new(place, look));
            if hit.is_miss() || !hit.front && !scene.material(hit.triangle).two_sided {
                continue;
            }
            let side = if hit.front { 1.0 } else { -1.0 };
            let sample = TexelSample { triangle: hit.triangle, u: hit.u, v: hit.v, ..Default::default() };
            self.on.push((hit.triangle, hit.front, hit.u, hit.v));
            self.positions.push(sample.position(scene));
            self.normals.push(side * sample.shading_normal(scene));
        }
        match self.len() {
            0 => Err(Error::InvalidArgument("no surface is seen from around the camera or the lamps".into())),
            _ => Ok(()),
        }
    }

    pub fn len(&self) -> usize {
        self.on.len()
    }

    /// Light that a light map of the same scene has at the points, read from its pages as a shader does: bilinearly, at
    /// the UVs of the side that is seen.
    pub fn of_bake(&self, lightmap: &Lightmap, layer: Layer) -> Result<Values> {
        let (scene, size) = (lightmap.scene(), lightmap.info().width as usize);
        let mut uvs: BTreeMap<u32, [MeshUvs; 2]> = BTreeMap::new();
        let mut at: Vec<Option<(u32, [f32; 2])>> = Vec::new();
        for &(t, front, u, v) in &self.on {
            let (object, triangle) = scene.locate(t);
            if let Entry::Vacant(entry) = uvs.entry(object) {
                entry.insert([lightmap.object_back_uvs(object)?.0, lightmap.object_uvs(object)?]);
            }
            let (corners, pages) = &uvs[&object][usize::from(front)];
            let [a, b, c] = corners[triangle as usize].map(Vec2::from);
            let page = pages[triangle as usize];
            at.push((page != NONE).then(|| (page, ((a + (b - a) * u + (c - a) * v) * size as f32 - 0.5).to_array())));
        }
        let mut values = vec![[0.0; 3]; self.len()];
        for page in 0..lightmap.info().page_count {
            let LayerData::Rgb(texels) = lightmap.read(page, layer)? else {
                return Err(Error::Internal("a layer of light has other values".into()));
            };
            for (value, at) in values.iter_mut().zip(&at) {
                if let Some((_, at)) = at.filter(|(on, _)| *on == page) {
                    *value = bilinear(&texels, size, at);
                }
            }
        }
        Ok(values)
    }
}

/// Positions that are likely to be in the rooms: the camera's and some before it, and those of lamps.
fn known_places(lightmap: &Lightmap, camera: &Camera) -> Vec<Vec3> {
    let scene = lightmap.scene();
    let direction = (camera.target - camera.position).normalize();
    let free = scene.intersect_raw(&Ray::new(camera.position, direction)).t.min(scene.diagonal());
    let ahead = [0.25, 0.5, 0.75].map(|part| camera.position + part * free * direction);
    let lamps = scene.lights();
    let lamps = lamps.iter().filter_map(|light| match *light {
        Light::Point { position, .. } | Light::Spot { position, .. } => Some(position),
        _ => None,
    });
    [camera.position].into_iter().chain(ahead).chain(lamps).collect()
}

/// A page of `size` × `size` texels at texel coordinates of which (0, 0) is the first texel's centre.
fn bilinear(texels: &[[f32; 3]], size: usize, at: [f32; 2]) -> [f64; 3] {
    let [(x, fx), (y, fy)] = at.map(|a| (a.floor(), f64::from(a - a.floor())));
    let texel = |x: f32, y: f32| {
        let [x, y] = [x, y].map(|a| a.clamp(0.0, size as f32 - 1.0) as usize);
        texels[y * size + x].map(f64::from)
    };
    let [a, b, c, d] = [texel(x, y), texel(x + 1.0, y), texel(x, y + 1.0), texel(x + 1.0, y + 1.0)];
    std::array::from_fn(|k| (a[k] * (1.0 - fx) + b[k] * fx) * (1.0 - fy) + (c[k] * (1.0 - fx) + d[k] * fx) * fy)
}

/// Mean over points and channels of the square of an error by the square of the reference, weighted as in [`Errors::mse`].
pub fn relative_square(error: &Values, [a, b]: &[Values; 2]) -> f64 {
    let reference = |i: usize, c: usize| 0.5 * (a[i][c] + b[i][c]);
    let values = || (0..error.len()).flat_map(|i| (0..3).map(move |c| (i, c)));
    let count = 3.0 * error.len() as f64;
    let mean = values().map(|(i, c)| reference(i, c)).sum::<f64>() / count;
    let least = (DARK * mean).powi(2);
    values().map(|(i, c)| error[i][c].powi(2) / (reference(i, c).powi(2) + least)).sum::<f64>() / count
}

/// Errors of several runs against the two halves of a reference. The squared error of x is estimated by
/// (x − a)(x − b) from the halves a and b: as their noise is independent, the noise of the reference is not
/// part of it.
pub fn errors(runs: &[Values], [a, b]: &[Values; 2]) -> Errors {
    let (points, k) = (a.len() as f64, runs.len() as f64);
    let mean_of = |v: &Values| v.iter().flatten().sum::<f64>() / (3.0 * points);
    let mean = 0.5 * (mean_of(a) + mean_of(b));
    let least = (DARK * mean).powi(2);
    let (mut variance, mut squares, mut to_mean) = (0.0, 0.0, 0.0);
    let mut of_points = Vec::with_capacity(a.len());
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
        of_points.push(of_point);
        squares += of_point * of_point / points;
    }
    variance /= points;
    let mse = of_points.iter().sum::<f64>() / points;
    of_points.sort_unstable_by(f64::total_cmp);
    let but_worst = of_points.len() - (WORST * points).ceil() as usize;
    Errors {
        mse,
        variance,
        bias2: mse - variance,
        to_mean,
        mean: runs.iter().map(mean_of).sum::<f64>() / k / mean - 1.0,
        trimmed: of_points[..but_worst].iter().sum::<f64>() / (but_worst as f64).max(1.0),
        uncertainty: ((squares - mse * mse).max(0.0) / points).sqrt(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::args::BakeArgs;
    use crate::job::Job;
    use bakelite::lightmap::{BakeParams, LightmapDesc};
    use bakelite::sampling::mix;
    use bakelite::scene::builtin_camera;

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

    #[test]
    fn points_are_the_same_when_read_again_and_none_of_another_scene() {
        let lightmap = |scene: &str| {
            let desc = LightmapDesc { texels_per_unit: 40.0, page_size: 128, ..Default::default() };
            let args = BakeArgs { scene: scene.into(), desc, threads: 1, quiet: true, ..Default::default() };
            let mut lightmap = Job::new(&args).unbaked().unwrap();
            let params = BakeParams { photon_count: 1000, gather_rays: 4, direct_samples: 1, ..Default::default() };
            lightmap.bake(&params, &Progress::none()).unwrap();
            lightmap
        };
        let cornell = lightmap("cornell");
        let camera = builtin_camera("cornell").unwrap();
        let points = Points::chosen(&cornell, &camera, 20, 0).unwrap();
        let others = Points::chosen(&cornell, &camera, 20, 1).unwrap();
        assert!(others.len() == 20 && points.positions.iter().all(|p| !others.positions.contains(p)));
        let points = points.with_reference(&cornell, 4, &Progress::none()).unwrap();
        let file = std::env::temp_dir().join(format!("bakelite-points-{}.csv", std::process::id()));
        std::fs::write(&file, points.csv(&points.of_bake(&cornell, Layer::Indirect).unwrap())).unwrap();
        let again = Points::read(&file, &cornell);
        let elsewhere = Points::read(&file, &lightmap("furnace"));
        std::fs::remove_file(&file).unwrap();
        let again = again.unwrap();
        assert_eq!((&points.on, &points.positions), (&again.on, &again.positions));
        assert_eq!((&points.normals, &points.indirect, &points.all), (&again.normals, &again.indirect, &again.all));
        assert!(matches!(elsewhere, Err(Error::InvalidArgument(_))));
    }
}
