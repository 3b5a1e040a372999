//! Direct light of a thousand lights: error against shadow rays and time, of the library's light tree
//! and of the lights chosen by power alone that it replaced.
//!
//! Prints a table: relative MSE (mean of squared error over squared value, the latter not below that of
//! a tenth of the mean irradiance), rays and microseconds per point. On the atrium, or on the scene
//! file that `BAKELITE_BENCH_SCENE` names.

use bakelite::bvh::BuildOptions;
use bakelite::direct::{DirectLight, Receiver};
use bakelite::sampling::{combine, sobol_2d, uniform, uniform_sphere, uniform_triangle};
use bakelite::scene::Material;
use bakelite::scene::shapes::MeshBuilder;
use bakelite::trace::Ray;
use bakelite::trace::offset::offset_ray_origin;
use bakelite::{Device, DeviceOptions, Light, Progress, Scene, SceneData};
use glam::Vec3;
use std::sync::Arc;
use std::time::Instant;

const LIGHTS: u32 = 1000;
const POINTS: u32 = 2000;
/// Samples asked of the library; it traces up to four times as many rays.
const SAMPLES: [u32; 5] = [1, 4, 16, 64, 256];

/// A place for light `i`, away from the outer walls.
fn place(i: u32, (lower, upper): (Vec3, Vec3)) -> Vec3 {
    lower + (upper - lower) * (0.1 + 0.8 * Vec3::from([0, 1, 2].map(|d| uniform(i, d, 7))))
}

/// Powers over two decades.
fn strength(i: u32) -> f32 {
    10f32.powf(2.0 * uniform(i, 3, 7) - 1.0)
}

fn commit(data: SceneData) -> Arc<Scene> {
    let device = Device::new(DeviceOptions { num_threads: 1, ..Default::default() }).expect("device");
    Scene::commit(&device, data, &BuildOptions::default(), &Progress::none()).map_err(|e| e.1).expect("commit")
}

/// Without the scene's own lights.
fn dark() -> (SceneData, (Vec3, Vec3)) {
    let mut data = common::data();
    for i in 0..data.lights().len() as u32 {
        data.set_light(i, Light::Point { position: Vec3::ZERO, intensity: [0.0; 3] }).expect("light");
    }
    let positions = || data.meshes().iter().flat_map(|m| &m.positions);
    let lower = positions().fold(Vec3::INFINITY, |a, &b| a.min(b));
    let upper = positions().fold(Vec3::NEG_INFINITY, |a, &b| a.max(b));
    (data, (lower, upper))
}

fn with_points() -> Arc<Scene> {
    let (mut data, bounds) = dark();
    for i in 0..LIGHTS {
        data.add_light(Light::Point { position: place(i, bounds), intensity: [strength(i); 3] }).expect("light");
    }
    commit(data)
}

fn with_triangles() -> Arc<Scene> {
    let (mut data, bounds) = dark();
    let size = 0.01 * (bounds.1 - bounds.0).length();
    for i in 0..LIGHTS {
        let emission = [10.0 * strength(i); 3];
        let m = data.add_material(Material { emission, ..Default::default() }).expect("material");
        let arm = |d| size * uniform_sphere([uniform(i, d, 8), uniform(i, d + 1, 8)]);
        let (p, mut builder) = (place(i, bounds), MeshBuilder::new());
        builder.triangle(p + arm(0), p + arm(2), p + arm(4), m);
        data.add_mesh(builder.finish()).expect("mesh");
    }
    commit(data)
}

/// What the library did before: lights by power, points on them by area.
struct ByPower {
    scene: Arc<Scene>,
    cdf: Vec<f32>,
}

impl ByPower {
    fn new(scene: &Arc<Scene>) -> ByPower {
        let points = scene.lights().iter().map(|l| l.color()[0]).collect::<Vec<_>>();
        let areas = scene.emitters().iter().map(|e| e.radiance[0] * e.area);
        let power: Vec<f32> = points.into_iter().chain(areas).collect();
        let (total, mut below) = (power.iter().sum::<f32>(), 0.0);
        let cdf = power.iter().map(|p| {
            below += p / total;
            below
        });
        ByPower { cdf: cdf.collect(), scene: scene.clone() }
    }

    fn irradiance(&self, r: &Receiver, n: u32, seed: u32) -> f32 {
        let (lights, offset) = (self.scene.lights(), sobol_2d(0, combine(seed, 1))[0]);
        let mut sum = 0.0;
        for k in 0..n {
            let target = (k as f32 + offset) / n as f32;
            let i = self.cdf.partition_point(|&c| c <= target).min(self.cdf.len() - 1);
            let p = (self.cdf[i] - if i == 0 { 0.0 } else { self.cdf[i - 1] }) * n as f32;
            let (to, light) = if let Some(Light::Point { position, intensity }) = lights.get(i) {
                let way = position - r.origin;
                (*position, intensity[0] * way.dot(r.normal).max(0.0) / way.length().powi(3))
            } else {
                let e = &self.scene.emitters()[i - lights.len()];
                let [u, v] = uniform_triangle(sobol_2d(k, combine(seed, 2)));
                let to = e.corner + u * e.edge_u + v * e.edge_v;
                let way = to - r.origin;
                let cosines = way.dot(r.normal).max(0.0) * -way.dot(e.normal).min(0.0);
                (to, e.radiance[0] * e.area * cosines / way.length_squared().powi(2))
            };
            let ray = Ray::new(r.origin, to - r.origin).within(0.0, 1.0 - 1e-4);
            if light > 0.0 && !self.scene.occluded(&ray) {
                sum += light / p;
            }
        }
        sum
    }
}

fn report(name: &str, scene: &Arc<Scene>) {
    let receivers: Vec<Receiver> = common::origins(scene, POINTS)
        .into_iter()
        .map(|(position, n)| {
            let origin = offset_ray_origin(position, n, scene);
            Receiver { origin, normal: n, geometric: n, position, shadow_origin: origin, raised: false }
        })
        .collect();
    let (direct, by_power) = (DirectLight::new(scene), ByPower::new(scene));
    let exact = |r: &Receiver, rays: &mut u64| -> f32 {
        let mut sum = 0.0;
        for l in scene.lights().iter() {
            let Light::Point { position, intensity } = *l else { continue };
            let way = position - r.origin;
            let light = intensity[0] * way.dot(r.normal) / way.length().powi(3);
            if light > 0.0 {
                *rays += 1;
                sum += light * !scene.occluded(&Ray::new(r.origin, way).within(0.0, 1.0 - 1e-4)) as u32 as f32;
            }
        }
        sum
    };
    let has_points = scene.emitters().is_empty();
    let start = Instant::now();
    let (mut rays, mut all_rays) = (0, 0);
    let truth: Vec<f32> = receivers
        .iter()
        .map(|r| if has_points { exact(r, &mut rays) } else { direct.irradiance(r, 2048, 999, &mut all_rays).x })
        .collect();
    let n = receivers.len() as f64;
    let micros = |start: Instant| start.elapsed().as_secs_f64() * 1e6 / n;
    println!("{name}: {} lights, mean irradiance {:.3}", LIGHTS, truth.iter().sum::<f32>() as f64 / n);
    println!("  {:<24} {:>10} {:>10} {:>12}", "method", "rays", "us", "rel. MSE");
    if has_points {
        println!("  {:<24} {:>10.1} {:>10.1} {:>12}", "a ray to each", rays as f64 / n, micros(start), 0);
    }
    let floor = 0.1 * truth.iter().sum::<f32>() as f64 / n;
    let error = |values: &[f32]| {
        let each = values.iter().zip(&truth).map(|(&v, &t)| ((v - t) as f64 / (t as f64).max(floor)).powi(2));
        each.sum::<f64>() / n
    };
    for samples in SAMPLES {
        let (start, mut rays) = (Instant::now(), 0);
        let values: Vec<f32> =
            (0..).zip(&receivers).map(|(i, r)| direct.irradiance(r, samples, i, &mut rays).x).collect();
        let (time, rays) = (micros(start), rays as f64 / n);
        println!("  {:<24} {rays:>10.1} {time:>10.1} {:>12.3e}", "light tree", error(&values));
    }
    for samples in SAMPLES {
        let start = Instant::now();
        let values: Vec<f32> = (0..).zip(&receivers).map(|(i, r)| by_power.irradiance(r, 4 * samples, i)).collect();
        println!("  {:<24} {:>10} {:>10.1} {:>12.3e}", "by power", 4 * samples, micros(start), error(&values));
    }
}

fn main() {
    report("point lights", &with_points());
    report("emissive triangles", &with_triangles());
}
