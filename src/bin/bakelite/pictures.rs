//! The three pictures that the thesis compares, from one camera: the path traced reference; the
//! indirect light of the light map plus direct light by shadow rays at each pixel; the composite
//! light map alone. All show outgoing radiance, albedo/π · E plus emission, at the same exposure.

use crate::plot::font;
use bakelite::direct::{DirectLight, Receiver};
use bakelite::io::image::{auto_exposure, tone_map};
use bakelite::lightmap::{Layer, Lightmap};
use bakelite::reference::PathTracer;
use bakelite::sampling::{combine, sobol_2d};
use bakelite::scene::{Camera, Sky};
use bakelite::trace::offset::{SurfacePoint, offset_ray_origin};
use bakelite::trace::{RawHit, Ray};
use bakelite::{Progress, Result, Scene};
use glam::Vec3;
use rayon::prelude::*;
use std::f32::consts::PI;
use std::time::Instant;

/// Linear RGB, row by row.
pub type Pixels = Vec<[f32; 3]>;

/// Captions, in the pictures' order.
pub const TITLES: [&str; 3] = ["Path traced reference", "Indirect map + shadow rays", "Light map alone"];

/// File names without extension, in the pictures' order.
pub const NAMES: [&str; 3] = ["reference", "indirect-and-shadow-rays", "light-map"];

/// Primary rays per pixel of the pictures made from the light map: a (0,2)-net, so that edges along
/// rows and columns, of which buildings are full, get sixteen levels.
pub const PRIMARY_RAYS: u32 = 16;

/// Shadow rays per primary ray and area light.
const SHADOW_RAYS: u32 = 2;

/// What lies behind the scene, in units of white. Shown, but not part of any RMSE.
const BACKGROUND: [f32; 3] = [0.55, 0.68, 0.85];

/// What to render.
pub struct View<'a> {
    pub camera: Camera,
    pub width: usize,
    pub height: usize,
    /// Paths per pixel of the reference, rendered as two halves.
    pub reference_spp: u32,
    pub seed: u64,
    pub lightmap: &'a Lightmap,
}

/// The pictures: linear radiance, row by row from the top left, and what was measured.
pub struct Pictures {
    pub images: [Vec<[f32; 3]>; 3],
    pub seconds: [f64; 3],
    /// Root mean square error over all channels of the pixels in which every primary ray meets the
    /// scene, divided by the reference's mean over the same. The squared error of x is estimated by
    /// (x − a)(x − b), where a and b are the reference's halves: as their noise is independent, the
    /// noise of the reference is not part of it. Not a number where the noise hides the error.
    pub rmse: [f64; 3],
    /// The reference's own noise in the same measure: half the difference of its two halves.
    pub noise: f64,
    pub exposure: f32,
    width: usize,
    /// Part of each pixel that shows the background.
    background: Vec<f32>,
}

impl View<'_> {
    /// Renders all three.
    pub fn render(&self, progress: &Progress) -> Result<Pictures> {
        let scene = self.lightmap.scene();
        let start = Instant::now();
        let (reference, halves) = self.reference(progress)?;
        let reference_seconds = start.elapsed().as_secs_f64();

        let start = Instant::now();
        let (size, seed) = ([self.width, self.height], self.seed as u32);
        let direct = DirectLight::new(scene);
        let by_shadow_rays = render(scene, &self.camera, size, seed, progress, "shadow rays", |seen| {
            let e = direct.irradiance(&receiver(scene, &seen.hit), SHADOW_RAYS, seen.seed, &mut 0);
            Ok(e + Vec3::from(self.lightmap.sample(
                Layer::Indirect,
                seen.hit.triangle,
                seen.hit.front,
                seen.hit.u,
                seen.hit.v,
            )))
        })?;
        let shadow_seconds = start.elapsed().as_secs_f64();

        let start = Instant::now();
        let composite = self.light_map(progress)?;
        let composite_seconds = start.elapsed().as_secs_f64();

        let missed = missed(scene, &self.camera, size);
        let covered = |i: usize| missed[i] == 0.0;
        let exposure = auto_exposure(&reference, covered);
        let rmse = [&reference, &by_shadow_rays, &composite].map(|image| relative_rmse(image, &halves, covered));
        let noise = 0.5 * difference(&halves[0], &halves[1], covered) / mean(&reference, covered);
        Ok(Pictures {
            images: [reference, by_shadow_rays, composite],
            seconds: [reference_seconds, shadow_seconds, composite_seconds],
            rmse,
            noise,
            exposure,
            width: self.width,
            background: background(scene, missed),
        })
    }

    /// What the light map alone shows.
    fn light_map(&self, progress: &Progress) -> Result<Pixels> {
        let size = [self.width, self.height];
        render(self.lightmap.scene(), &self.camera, size, self.seed as u32, progress, "light map", |seen| {
            Ok(self.lightmap.sample(Layer::Combined, seen.hit.triangle, seen.hit.front, seen.hit.u, seen.hit.v).into())
        })
    }

    /// The same, tone mapped by itself, for a look without a reference.
    pub fn light_map_alone(&self, progress: &Progress) -> Result<Vec<[u8; 3]>> {
        let (scene, pixels) = (self.lightmap.scene(), self.light_map(progress)?);
        let missed = missed(scene, &self.camera, [self.width, self.height]);
        let exposure = auto_exposure(&pixels, |i| missed[i] == 0.0);
        Ok(tone_mapped(&pixels, &background(scene, missed), exposure))
    }

    /// The reference as the mean of two independent halves, and these.
    fn reference(&self, progress: &Progress) -> Result<(Pixels, [Pixels; 2])> {
        let scene = self.lightmap.scene();
        let tracer = PathTracer::new(scene);
        let half = |seed: u64| {
            let spp = self.reference_spp.div_ceil(2);
            tracer.render(scene.device(), &self.camera, self.width, self.height, spp, seed, progress)
        };
        let halves = [half(2 * self.seed)?, half(2 * self.seed + 1)?];
        let mean = |(a, b): (&[f32; 3], &[f32; 3])| std::array::from_fn(|c| 0.5 * (a[c] + b[c]));
        Ok((halves[0].iter().zip(&halves[1]).map(mean).collect(), halves))
    }
}

/// A picture of albedo/π · E + Le, with E from `irradiance`.
pub fn render(
    scene: &Scene,
    camera: &Camera,
    [width, height]: [usize; 2],
    seed: u32,
    progress: &Progress,
    name: &'static str,
    irradiance: impl Fn(&Seen) -> Result<Vec3> + Sync,
) -> Result<Pixels> {
    let rays = PrimaryRays::new(camera, width, height);
    let skies = skies(scene);
    let stage = progress.stage(name, 0.0, 1.0, height as u64);
    let mut pixels = vec![[0.0; 3]; width * height];
    let row = |(y, row): (usize, &mut [[f32; 3]])| {
        for (x, pixel) in row.iter_mut().enumerate() {
            let mut sum = Vec3::ZERO;
            for (k, ray) in rays.of_pixel(x, y).enumerate() {
                let seed = combine(combine(seed, (y * width + x) as u32), k as u32);
                sum += radiance(scene, &skies, &ray, seed, &irradiance)?;
            }
            *pixel = (sum / PRIMARY_RAYS as f32).to_array();
        }
        stage.advance(1)
    };
    scene.device().run(progress, || pixels.par_chunks_mut(width).enumerate().try_for_each(row))?;
    Ok(pixels)
}

/// Part of each pixel where nothing is.
pub fn missed(scene: &Scene, camera: &Camera, [width, height]: [usize; 2]) -> Vec<f32> {
    let rays = PrimaryRays::new(camera, width, height);
    let part = |i: usize| {
        let misses = rays.of_pixel(i % width, i / width).filter(|r| scene.intersect_raw(r).is_miss());
        misses.count() as f32 / PRIMARY_RAYS as f32
    };
    scene.device().install(|| (0..width * height).into_par_iter().map(part).collect())
}

/// The skies that shine.
fn skies(scene: &Scene) -> Vec<Sky> {
    let skies = scene.lights().iter().filter_map(|light| scene.sky(light)).collect::<Vec<_>>();
    skies.into_iter().filter(|sky| !sky.is_dark()).collect()
}

/// Part of each pixel that shows the background, of that where nothing is: none of it where a sky is seen.
pub fn background(scene: &Scene, missed: Vec<f32>) -> Vec<f32> {
    if skies(scene).is_empty() { missed } else { vec![0.0; missed.len()] }
}

/// Linear radiance as sRGB, with the background where nothing is.
pub fn tone_mapped(pixels: &[[f32; 3]], background: &[f32], exposure: f32) -> Vec<[u8; 3]> {
    let pixel = |(p, &part): (&[f32; 3], &f32)| {
        let shown = std::array::from_fn(|c| p[c] + part * BACKGROUND[c] / exposure);
        tone_map(exposure, shown)
    };
    pixels.iter().zip(background).map(pixel).collect()
}

/// A visible point.
pub struct Seen {
    pub hit: RawHit,
    /// For the random numbers of this point.
    pub seed: u32,
}

/// A hit as a point that receives light, on the side that was hit, with its interpolated normal.
pub fn receiver(scene: &Scene, hit: &RawHit) -> Receiver {
    let (object, triangle) = scene.locate(hit.triangle);
    let object = scene.object(object);
    let mesh = object.mesh();
    let normal = |corner: usize| object.normal(mesh.indices[triangle as usize][corner]);
    let interpolated = || (normal(0) * (1.0 - hit.u - hit.v) + normal(1) * hit.u + normal(2) * hit.v).try_normalize();
    let shading = if mesh.normals.is_empty() { None } else { interpolated() };
    let point = SurfacePoint::new(scene.corners(hit.triangle), hit.u, hit.v, scene);
    Receiver::new(scene, &point, shading, !hit.front)
}

/// Radiance along a primary ray. The backs of one-sided materials are black.
fn radiance(
    scene: &Scene,
    skies: &[Sky],
    ray: &Ray,
    seed: u32,
    irradiance: &impl Fn(&Seen) -> Result<Vec3>,
) -> Result<Vec3> {
    let hit = scene.intersect_raw(ray);
    if hit.is_miss() {
        return Ok(skies.iter().map(|sky| sky.at(ray.direction.into()).0).sum());
    }
    let material = scene.material(hit.triangle);
    let mut through = Vec3::ZERO;
    if material.transmits() {
        let point = SurfacePoint::new(scene.corners(hit.triangle), hit.u, hit.v, scene);
        let onwards = if hit.front { -point.normal } else { point.normal };
        let behind = Ray::new(offset_ray_origin(point.interior, onwards, scene), ray.direction.into());
        through = Vec3::from(material.transmission) * radiance(scene, skies, &behind, seed, irradiance)?;
    }
    if !hit.front && !material.two_sided {
        return Ok(through);
    }
    let reflected = scene.albedo(hit.triangle, hit.u, hit.v) / PI * irradiance(&Seen { hit, seed })?;
    Ok(through + reflected + Vec3::from(material.emission))
}

/// The rays of a pinhole camera.
pub struct PrimaryRays {
    position: Vec3,
    forward: Vec3,
    /// To the right and down, from the middle of the image to its border.
    right: Vec3,
    down: Vec3,
    width: usize,
    height: usize,
}

impl PrimaryRays {
    pub fn new(camera: &Camera, width: usize, height: usize) -> Self {
        let forward = (camera.target - camera.position).normalize();
        let right = forward.cross(camera.up).normalize();
        let half = (0.5 * camera.fov_y).tan();
        let down = forward.cross(right) * half;
        let right = right * half * width as f32 / height as f32;
        PrimaryRays { position: camera.position, forward, right, down, width, height }
    }

    /// Spread evenly over a pixel.
    pub fn of_pixel(&self, x: usize, y: usize) -> impl Iterator<Item = Ray> {
        let seed = combine(y as u32, x as u32);
        (0..PRIMARY_RAYS).map(move |k| {
            let [dx, dy] = sobol_2d(k, seed);
            let u = 2.0 * (x as f32 + dx) / self.width as f32 - 1.0;
            let v = 2.0 * (y as f32 + dy) / self.height as f32 - 1.0;
            Ray::new(self.position, (self.forward + self.right * u + self.down * v).normalize())
        })
    }
}

/// Mean of all channels of the pixels that `mask` includes.
fn mean(image: &[[f32; 3]], mask: impl Fn(usize) -> bool) -> f64 {
    let included = image.iter().enumerate().filter(|(i, _)| mask(*i)).map(|(_, p)| p.iter().map(|&c| c as f64).sum());
    let (sum, count) = included.fold((0.0, 0), |(s, n): (f64, usize), x: f64| (s + x, n + 3));
    sum / count.max(1) as f64
}

/// Root mean square difference of all channels of the pixels that `mask` includes.
fn difference(a: &[[f32; 3]], b: &[[f32; 3]], mask: impl Fn(usize) -> bool) -> f64 {
    let squares = a.iter().zip(b).map(|(a, b)| std::array::from_fn(|c| (a[c] - b[c]).powi(2)));
    mean(&squares.collect::<Vec<_>>(), mask).sqrt()
}

/// See [`Pictures::rmse`].
fn relative_rmse(image: &[[f32; 3]], [a, b]: &[Vec<[f32; 3]>; 2], mask: impl Fn(usize) -> bool + Copy) -> f64 {
    let product = |i: usize| std::array::from_fn(|c| (image[i][c] - a[i][c]) * (image[i][c] - b[i][c]));
    let squares: Vec<[f32; 3]> = (0..image.len()).map(product).collect();
    let reference = 0.5 * (mean(a, mask) + mean(b, mask));
    // By chance the estimate of a small error can be below 0, and its root is not a number.
    mean(&squares, mask).sqrt() / reference
}

/// For people.
pub fn percent(part: f64) -> String {
    if part.is_finite() { format!("{:.2}%", 100.0 * part) } else { "lost in noise".into() }
}

/// Pixels between the pictures and under the captions.
const GAP: usize = 6;
const TEXT_SCALE: usize = 2;
const PAPER: [u8; 3] = [24, 24, 26];
const INK: [u8; 3] = [225, 222, 214];

impl Pictures {
    /// One picture as sRGB.
    pub fn tone_mapped(&self, picture: usize) -> Vec<[u8; 3]> {
        tone_mapped(&self.images[picture], &self.background, self.exposure)
    }

    /// The three side by side with their captions: width, height and pixels.
    pub fn side_by_side(&self) -> (usize, usize, Vec<[u8; 3]>) {
        let (w, h) = (self.width, self.images[0].len() / self.width);
        let line = font::HEIGHT * TEXT_SCALE + GAP;
        let (width, height) = (3 * w + 4 * GAP, h + 2 * GAP + 2 * line);
        let mut pixels = vec![PAPER; width * height];
        for i in 0..3 {
            let left = GAP + i * (w + GAP);
            for (y, row) in self.tone_mapped(i).chunks(w).enumerate() {
                let start = (GAP + y) * width + left;
                pixels[start..start + w].copy_from_slice(row);
            }
            let second = match i {
                0 => format!("noise {}", percent(self.noise)),
                _ => format!("RMSE {}", percent(self.rmse[i])),
            };
            for (n, text) in [TITLES[i], &second].into_iter().enumerate() {
                // Narrow pictures get small letters.
                let scale = if font::width(text, TEXT_SCALE) <= w { TEXT_SCALE } else { 1 };
                font::draw(&mut pixels, width, left, h + 2 * GAP + n * line, scale, INK, text);
            }
        }
        (width, height, pixels)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rmse_is_relative_to_the_mean_of_the_reference_and_leaves_the_background_out() {
        let reference = || vec![[1.0, 2.0, 3.0], [100.0; 3]];
        let image = [[1.5, 1.5, 3.5], [0.0; 3]];
        assert!((relative_rmse(&image, &[reference(), reference()], |i| i == 0) - 0.25).abs() < 1e-6);
    }

    #[test]
    fn noise_of_the_reference_is_not_part_of_the_rmse() {
        let noisy = |seed: u32| -> Vec<[f32; 3]> {
            (0..40_000)
                .map(|i| std::array::from_fn(|c| 1.0 + bakelite::sampling::uniform(i, c as u32, seed) - 0.5))
                .collect()
        };
        let halves = [noisy(1), noisy(2)];
        let rmse = relative_rmse(&vec![[1.1; 3]; 40_000], &halves, |_| true);
        assert!((rmse - 0.1).abs() < 0.01, "{rmse}");
        assert!(0.5 * difference(&halves[0], &halves[1], |_| true) > 0.15);
    }

    #[test]
    fn primary_rays_cover_the_field_of_view() {
        let camera = Camera { position: Vec3::ZERO, target: Vec3::X, up: Vec3::Y, fov_y: 90f32.to_radians() };
        let rays = PrimaryRays::new(&camera, 200, 100);
        let first = Vec3::from(rays.of_pixel(0, 0).next().unwrap().direction);
        // Top left: up and, looking along +x with y up, towards −z.
        let expected = Vec3::new(1.0, 1.0, -2.0).normalize();
        assert!((first - expected).length() < 0.01, "{first}");
        let middle: Vec3 = rays.of_pixel(100, 50).map(|r| Vec3::from(r.direction)).next().unwrap();
        assert!(middle.x > 0.999);
    }
}
