//! Path tracer: the light transport equation of diffuse surfaces by Monte Carlo (Kajiya 1986), with
//! next event estimation at every vertex and Russian roulette.
//!
//! The model is that of the library: one-sided surfaces seen or hit from behind are black
//! and absorb, two-sided ones reflect and emit on both sides, rect lights emit from one side and are
//! not hit by rays, the background is black but for skies. Textures colour surfaces and make cut-outs; sheets
//! that transmit are passed straight or reflect, by chance.

use super::geometry::{Geometry, Hit64, Ray64};
use super::lights::Lights;
use super::proposal::rgb;
use super::random::{Random, cosine_direction};
use super::surfaces::Surfaces;
use crate::base::error::{Result, invalid_argument};
use crate::base::progress::Progress;
use crate::device::Device;
use crate::scene::{Camera, Environment, Light, Material, Mesh, Scene, SceneData, Texture};
use glam::{DVec3, Vec3};
use rayon::prelude::*;
use std::f64::consts::PI;
use std::sync::Arc;

/// Independent estimates from whose spread the standard error is taken.
const BATCHES: u32 = 16;

/// Rays leave surfaces from this far above them, relative to the size of the scene and its
/// coordinates: more than the rounding of points that were computed in f32.
const OFFSET: f64 = 1e-7;

/// Russian roulette lets a path go on with this times its throughput. Measured on the Cornell box,
/// error² · time: 1.79 for 1, 1.33 for 2, 1.50 for 4.
const ROULETTE: f64 = 2.0;

/// Images are computed in square tiles of this many pixels a side: small, so that a cancel is
/// noticed soon.
const TILE: usize = 8;

/// A point on a surface, where irradiance is wanted.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfacePoint {
    /// Position in scene units.
    pub position: DVec3,
    /// Unit normal of the side that receives light.
    pub normal: DVec3,
}

impl SurfacePoint {
    /// The point of a global triangle with weights `u` and `v` of corners 1 and 2, on its front.
    pub fn on_triangle(scene: &Scene, triangle: u32, u: f64, v: f64) -> Self {
        let [a, b, c] = scene.corners(triangle).map(Vec3::as_dvec3);
        SurfacePoint { position: a * (1.0 - u - v) + b * u + c * v, normal: (b - a).cross(c - a).normalize_or_zero() }
    }
}

/// Irradiance at a point in W/m², by Monte Carlo.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Irradiance {
    /// From lights and emissive triangles that the point sees.
    pub direct: [f64; 3],
    /// Reflected at least once.
    pub indirect: [f64; 3],
    /// Standard error of `direct + indirect`, per channel.
    pub standard_error: [f64; 3],
}

impl Irradiance {
    /// `direct + indirect`.
    pub fn total(&self) -> [f64; 3] {
        std::array::from_fn(|c| self.direct[c] + self.indirect[c])
    }
}

/// Direct and indirect parts of a sum.
#[derive(Clone, Copy, Default)]
struct Split {
    direct: DVec3,
    indirect: DVec3,
}

/// A scene prepared for path tracing.
pub struct PathTracer {
    geometry: Geometry,
    surfaces: Surfaces,
    /// Corners by global triangle number.
    corners: Vec<[Vec3; 3]>,
    lights: Lights,
    offset: f64,
    max_bounces: u32,
}

impl PathTracer {
    /// Prepares a committed scene, with its present lights.
    pub fn new(scene: &Scene) -> Self {
        Self::from_parts(&scene.flattened(), scene.materials(), scene.textures(), scene.environments(), &scene.lights())
    }

    /// Prepares a scene that has not been committed.
    pub fn from_data(data: &SceneData) -> Self {
        Self::from_parts(&data.flattened(), data.materials(), data.textures(), data.environments(), data.lights())
    }

    fn from_parts(
        meshes: &[Mesh],
        materials: &[Material],
        textures: &[Arc<Texture>],
        environments: &[Arc<Environment>],
        lights: &[Light],
    ) -> Self {
        let geometry = Geometry::new(meshes);
        let all = || meshes.iter().flat_map(|m| (0..m.indices.len()).map(move |t| (m, t)));
        let (lower, upper) = geometry.bounds();
        let largest = lower.abs().max(upper.abs()).max_element();
        PathTracer {
            surfaces: Surfaces::new(meshes, materials, textures),
            corners: all().map(|(m, t)| m.corners(t)).collect(),
            lights: Lights::new(meshes, materials, environments, lights),
            offset: OFFSET * (largest + (upper - lower).length()),
            geometry,
            max_bounces: u32::MAX,
        }
    }

    /// Light counts only if it was reflected at most `bounces` times; 0: direct light only. Without
    /// this there is no limit.
    pub fn with_max_bounces(self, bounces: u32) -> Self {
        PathTracer { max_bounces: bounces, ..self }
    }

    /// The rays' view of the scene.
    pub fn geometry(&self) -> &Geometry {
        &self.geometry
    }

    /// Irradiance at a point. `samples` ≥ 16 is rounded down to 16 · k²: sixteen independent
    /// estimates, each stratified k × k in the first direction and the place on area lights.
    /// `stream` is a number that differs between points with the same seed.
    pub fn irradiance(&self, point: &SurfacePoint, samples: u32, seed: u64, stream: u64) -> Irradiance {
        self.irradiance_on(point, point.normal, samples, seed, stream)
    }

    /// Irradiance at a point for another unit `normal`, as of a normal map. No light comes from below the surface.
    pub fn irradiance_on(
        &self,
        point: &SurfacePoint,
        normal: DVec3,
        samples: u32,
        seed: u64,
        stream: u64,
    ) -> Irradiance {
        let k = (samples / BATCHES).isqrt().max(1);
        let mut random = Random::new(seed, stream);
        let batches: [Split; BATCHES as usize] = std::array::from_fn(|_| self.batch(point, normal, k, &mut random));
        let n = BATCHES as f64;
        let direct = batches.iter().map(|b| b.direct).sum::<DVec3>() / n;
        let indirect = batches.iter().map(|b| b.indirect).sum::<DVec3>() / n;
        let deviation = |b: &Split| b.direct + b.indirect - direct - indirect;
        let squares: DVec3 = batches.iter().map(|b| deviation(b) * deviation(b)).sum();
        Irradiance {
            direct: direct.to_array(),
            indirect: indirect.to_array(),
            standard_error: (squares / (n * (n - 1.0))).sqrt().to_array(),
        }
    }

    /// Irradiance at many points, on the device's threads. The result depends on the seed alone.
    pub fn irradiance_many(
        &self,
        device: &Device,
        points: &[SurfacePoint],
        samples: u32,
        seed: u64,
        progress: &Progress,
    ) -> Result<Vec<Irradiance>> {
        let normals: Vec<DVec3> = points.iter().map(|p| p.normal).collect();
        self.irradiance_many_on(device, points, &normals, samples, seed, progress)
    }

    /// [`irradiance_on`](Self::irradiance_on) at many points, each with its normal, on the device's threads.
    pub fn irradiance_many_on(
        &self,
        device: &Device,
        points: &[SurfacePoint],
        normals: &[DVec3],
        samples: u32,
        seed: u64,
        progress: &Progress,
    ) -> Result<Vec<Irradiance>> {
        let stage = progress.stage("reference", 0.0, 1.0, points.len() as u64);
        let one = |(i, (point, &normal)): (usize, (&SurfacePoint, &DVec3))| {
            let result = self.irradiance_on(point, normal, samples, seed, i as u64);
            stage.advance(1).map(|()| result)
        };
        device.run(progress, || points.par_iter().zip(normals).enumerate().map(one).collect())
    }

    /// One estimate of irradiance from `k` × `k` samples.
    fn batch(&self, point: &SurfacePoint, normal: DVec3, k: u32, random: &mut Random) -> Split {
        let origin = point.position + point.normal * self.offset;
        let mut sum = Split::default();
        for cell in 0..k * k {
            let (x, y) = (cell % k, cell / k);
            let square = random.cell(x, y, k);
            sum.direct += self.direct(origin, [normal, point.normal], square, random);
            let (direction, cosine) = cosine_direction(normal, random.cell(x, y, k));
            if direction.dot(point.normal) <= 0.0 {
                continue;
            }
            let incident = self.incident(origin, direction, Some(cosine / PI), random);
            sum.direct += incident.direct * PI;
            sum.indirect += incident.indirect * PI;
        }
        let n = (k * k) as f64;
        Split { direct: sum.direct / n, indirect: sum.indirect / n }
    }

    /// Radiance that arrives at `origin` against `direction` (any length): one random sample.
    pub fn radiance(&self, origin: DVec3, direction: DVec3, random: &mut Random) -> [f64; 3] {
        let sample = self.incident(origin, direction.normalize(), None, random);
        (sample.direct + sample.indirect).to_array()
    }

    /// Irradiance by one light sample, weighted against directions sampled by cosine. `point` is
    /// already off the surface, whose normal is the second one.
    fn direct(&self, point: DVec3, [normal, surface]: [DVec3; 2], square: [f64; 2], random: &mut Random) -> DVec3 {
        let Some(light) = self.lights.propose(point, normal, square, random) else { return DVec3::ZERO };
        if light.direction.dot(surface) <= 0.0 {
            return DVec3::ZERO;
        }
        let shadow = Ray64 { tmax: light.distance - self.offset, ..Ray64::new(point, light.direction) };
        light.irradiance * self.surfaces.transmittance(&self.geometry, &shadow)
    }

    /// Radiance along a ray, split in emitted and reflected. `density` is that of the direction, if
    /// it was sampled by cosine at a point where [`direct`](Self::direct) was evaluated too; without
    /// it, emission counts in full and rect lights are not seen.
    fn incident(&self, origin: DVec3, direction: DVec3, density: Option<f64>, random: &mut Random) -> Split {
        let mut result = Split::default();
        let mut throughput = DVec3::ONE;
        let (mut ray, mut density) = (Ray64::new(origin, direction), density);
        // Where the ray was last reflected, and how far it has come since, through sheets.
        let (mut start, mut passed) = (origin, 0.0);
        let mut bounce = 0;
        loop {
            let hit = self.surfaces.closest(&self.geometry, &ray);
            let emitted = throughput * self.emitted(&ray, hit.as_ref(), density, start, passed);
            if bounce == 0 {
                result.direct += emitted;
            } else {
                result.indirect += emitted;
            }
            let Some(hit) = hit else { break };
            let (material, point, is_lit) = self.surface(&ray, &hit);
            let reflected = if is_lit { self.surfaces.albedo(&hit) } else { DVec3::ZERO };
            let transmitted = rgb(material.transmission);
            let (r, t) = (reflected.max_element(), transmitted.max_element());
            let mut chance = 1.0;
            if t > 0.0 {
                if random.uniform() * (r + t) < t {
                    throughput *= transmitted * ((r + t) / t);
                    passed += hit.t;
                    ray = Ray64::new(point.position - point.normal * (2.0 * self.offset), ray.direction);
                    continue;
                }
                chance = r / (r + t);
            }
            throughput *= reflected / chance;
            if bounce >= self.max_bounces || throughput == DVec3::ZERO {
                break;
            }
            let square = random.square();
            result.indirect += throughput * self.direct(point.position, [point.normal; 2], square, random) / PI;
            let survival = (throughput.max_element() * ROULETTE).min(1.0);
            if random.uniform() >= survival {
                break;
            }
            throughput /= survival;
            let (direction, cosine) = cosine_direction(point.normal, random.square());
            ray = Ray64::new(point.position, direction);
            density = Some(cosine / PI);
            (start, passed) = (point.position, 0.0);
            bounce += 1;
        }
        result
    }

    /// Emission along a ray up to its hit, weighted. It comes from `start`, `passed` before its origin.
    fn emitted(&self, ray: &Ray64, hit: Option<&Hit64>, density: Option<f64>, start: DVec3, passed: f64) -> DVec3 {
        let mut sum = DVec3::ZERO;
        if let Some(density) = density {
            let limit = hit.map_or(f64::INFINITY, |h| passed + h.t);
            sum += self.lights.rects_along(start, ray.direction, [passed, limit], density);
        }
        let Some(hit) = hit else { return sum + self.lights.skies_along(ray.direction, density) };
        let (material, point, is_lit) = self.surface(ray, hit);
        if material.is_emissive() && is_lit {
            let cosine = point.normal.dot(ray.direction);
            let weight = density.map_or(1.0, |d| self.lights.emission_weight(material, cosine, passed + hit.t, d));
            sum += rgb(material.emission) * weight;
        }
        sum
    }

    /// Material and point of a hit, on the side that the ray comes from and already off the surface, and whether
    /// that side reflects and emits: the back of a one-sided surface does not.
    fn surface(&self, ray: &Ray64, hit: &Hit64) -> (&Material, SurfacePoint, bool) {
        let material = self.surfaces.material(hit.triangle);
        let [a, b, c] = self.corners[hit.triangle as usize].map(|c| c.as_dvec3());
        let front = (b - a).cross(c - a).normalize_or_zero();
        let from_behind = front.dot(ray.direction) > 0.0;
        let normal = if from_behind { -front } else { front };
        // From the corners rather than along the ray: on the plane whatever the distance.
        let on_plane = a + (b - a) * hit.u + (c - a) * hit.v;
        let point = SurfacePoint { position: on_plane + normal * self.offset, normal };
        (material, point, !from_behind || material.two_sided)
    }

    /// An image: linear radiance per pixel, row by row from the top left, `samples` paths per pixel
    /// spread evenly over its area. Runs on the device's threads; depends on the seed alone.
    #[allow(clippy::too_many_arguments)]
    pub fn render(
        &self,
        device: &Device,
        camera: &Camera,
        width: usize,
        height: usize,
        samples: u32,
        seed: u64,
        progress: &Progress,
    ) -> Result<Vec<[f32; 3]>> {
        if width == 0 || height == 0 || samples == 0 {
            return invalid_argument!("an image of {width} × {height} pixels with {samples} samples has none");
        }
        let view = View::new(camera, width, height);
        let (columns, rows) = (width.div_ceil(TILE), height.div_ceil(TILE));
        let stage = progress.stage("reference", 0.0, 1.0, (columns * rows) as u64);
        let pixels = |tile: usize| {
            let (x, y) = (tile % columns * TILE, tile / columns * TILE);
            (y..height.min(y + TILE)).flat_map(move |y| (x..width.min(x + TILE)).map(move |x| (x, y)))
        };
        let render_tile = |tile: usize| -> Result<Vec<[f32; 3]>> {
            let mut out = Vec::with_capacity(TILE * TILE);
            for (x, y) in pixels(tile) {
                progress.check()?;
                let mut random = Random::new(seed, (y * width + x) as u64);
                let sum: DVec3 = (0..samples)
                    .map(|_| {
                        let [dx, dy] = random.square();
                        let direction = view.direction(x as f64 + dx, y as f64 + dy);
                        DVec3::from_array(self.radiance(view.position, direction, &mut random))
                    })
                    .sum();
                out.push((sum / samples as f64).as_vec3().to_array());
            }
            stage.advance(1).map(|()| out)
        };
        let tiles: Vec<_> =
            device.run(progress, || (0..columns * rows).into_par_iter().map(render_tile).collect::<Result<_>>())?;
        let mut image = vec![[0.0; 3]; width * height];
        for (tile, colors) in tiles.into_iter().enumerate() {
            for ((x, y), color) in pixels(tile).zip(colors) {
                image[y * width + x] = color;
            }
        }
        Ok(image)
    }
}

/// A camera for an image of a given size.
struct View {
    position: DVec3,
    forward: DVec3,
    /// To the right and down, from the middle of the image to its border.
    right: DVec3,
    down: DVec3,
    size: (f64, f64),
}

impl View {
    fn new(camera: &Camera, width: usize, height: usize) -> Self {
        let [position, target, up] = [camera.position, camera.target, camera.up].map(Vec3::as_dvec3);
        let forward = (target - position).normalize();
        let right = forward.cross(up).normalize();
        let half = (0.5 * camera.fov_y as f64).tan();
        let size = (width as f64, height as f64);
        View { position, forward, right: right * (half * size.0 / size.1), down: forward.cross(right) * half, size }
    }

    /// Towards a place in the image in pixels, from the top left.
    fn direction(&self, x: f64, y: f64) -> DVec3 {
        self.forward + self.right * (2.0 * x / self.size.0 - 1.0) + self.down * (2.0 * y / self.size.1 - 1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::DeviceOptions;
    use crate::scene::demo::shapes::MeshBuilder;
    use crate::scene::{MeshMaterials, builtin};

    const UP: SurfacePoint = SurfacePoint { position: DVec3::ZERO, normal: DVec3::Z };

    fn material(albedo: f32, emission: f32, two_sided: bool) -> Material {
        Material { albedo: [albedo; 3], emission: [emission; 3], two_sided, ..Default::default() }
    }

    fn square(half: f32, z: f32, material: u32) -> Mesh {
        let p = |x: f32, y: f32| Vec3::new(x * half, y * half, z);
        let mut builder = MeshBuilder::new();
        builder.quad(p(-1.0, -1.0), p(1.0, -1.0), p(1.0, 1.0), p(-1.0, 1.0), material);
        builder.finish()
    }

    /// A grey floor at z = 0 that looks up, under `light`.
    fn floor_under(light: Light) -> PathTracer {
        let mut data = SceneData::new();
        let m = data.add_material(material(0.5, 0.0, false)).unwrap();
        data.add_mesh(square(10.0, 0.0, m)).unwrap();
        data.add_light(light).unwrap();
        PathTracer::from_data(&data)
    }

    /// Whether the first channel of an estimate is what it should be: within `relative` and within
    /// four and a half standard errors (which are themselves known to 18 % only).
    #[track_caller]
    fn assert_irradiance(e: &Irradiance, expected: f64, relative: f64) {
        let (total, error) = (e.total()[0], e.standard_error[0]);
        assert!((total - expected).abs() <= relative * expected, "{total} ± {error} is not {expected}");
        assert!((total - expected).abs() <= 4.5 * error + 1e-6 * expected, "{total} ± {error} is not {expected}");
    }

    /// Irradiance from a polygon of radiance 1 (Lambert 1760): ½ Σ angle · (unit edge normal · n).
    /// The polygon lies above the horizon, counter-clockwise as seen from the point.
    fn lambert(point: &SurfacePoint, polygon: &[DVec3]) -> f64 {
        let arms: Vec<DVec3> = polygon.iter().map(|p| (*p - point.position).normalize()).collect();
        let edge = |i: usize| {
            let (a, b) = (arms[i], arms[(i + 1) % arms.len()]);
            a.angle_between(b) * a.cross(b).normalize().dot(point.normal)
        };
        0.5 * (0..arms.len()).map(edge).sum::<f64>().abs()
    }

    #[test]
    fn a_point_light_gives_intensity_times_cosine_over_squared_distance() {
        let e = floor_under(Light::Point { position: Vec3::new(3.0, 0.0, 4.0), intensity: [50.0, 5.0, 0.0] })
            .irradiance(&UP, 16, 0, 0);
        assert!((e.direct[0] - 50.0 * 0.8 / 25.0).abs() < 1e-6 * e.direct[0]);
        assert!((e.direct[1] - 5.0 * 0.8 / 25.0).abs() < 1e-6 * e.direct[1]);
        assert_eq!((e.direct[2], e.indirect), (0.0, [0.0; 3]));
        assert!(e.standard_error[0] < 1e-15, "nothing is random here");
    }

    #[test]
    fn a_spot_light_is_full_inside_half_between_and_dark_outside_its_cones() {
        let at = |degrees: f64| {
            let (sin, cos) = degrees.to_radians().sin_cos();
            let direction = -DVec3::new(sin, 0.0, cos).as_vec3();
            let (inner, outer) = (20f32.to_radians(), 40f32.to_radians());
            let position = Vec3::new(0.0, 0.0, 2.0);
            floor_under(Light::Spot { position, direction, inner, outer, intensity: [8.0; 3] })
                .irradiance(&UP, 16, 0, 0)
                .direct[0]
        };
        let half = ((20f64.to_radians().cos() + 40f64.to_radians().cos()) / 2.0).acos().to_degrees();
        for (degrees, expected) in [(10.0, 2.0), (half, 1.0), (41.0, 0.0)] {
            assert!((at(degrees) - expected).abs() < 1e-5, "{degrees}: {}", at(degrees));
        }
    }

    #[test]
    fn the_sun_gives_its_irradiance_times_cosine() {
        let e = floor_under(Light::Directional {
            direction: Vec3::new(-3.0, 0.0, -4.0),
            irradiance: [2.0; 3],
            angular_radius: 0.0,
        })
        .irradiance(&UP, 16, 0, 0);
        assert!((e.direct[0] - 1.6).abs() < 1e-6);
        assert_eq!(e.indirect, [0.0; 3]);
    }

    #[test]
    fn lamberts_formula_agrees_with_the_configuration_factor_of_a_parallel_rectangle() {
        // Howell, *A Catalog of Radiation Heat Transfer Configuration Factors*, B-3: the element is
        // below a corner of an a × b rectangle at distance 1.
        let (a, b) = (0.7f64, 1.9f64);
        let (ra, rb) = ((1.0 + a * a).sqrt(), (1.0 + b * b).sqrt());
        let factor = (a / ra * (b / ra).atan() + b / rb * (a / rb).atan()) / (2.0 * PI);
        let corner = |x: f64, y: f64| DVec3::new(x, y, 1.0);
        let polygon = [corner(0.0, 0.0), corner(a, 0.0), corner(a, b), corner(0.0, b)];
        assert!((lambert(&UP, &polygon) - PI * factor).abs() < 1e-12);
    }

    #[test]
    fn rectangles_of_light_follow_lamberts_formula_as_lights_and_as_emissive_triangles() {
        // Near, far, tilted, slanted (a parallelogram), and one that all but touches the point.
        let rects = [
            ([-1.0, -1.0, 1.0], [0.0, 2.0, 0.0], [2.0, 0.0, 0.0]),
            ([4.0, 3.0, 5.0], [0.0, 2.0, 0.0], [2.0, 0.0, 0.0]),
            ([1.0, -1.0, 0.2], [0.0, 2.0, 0.5], [0.5, 0.1, 2.0]),
            ([-2.0, 0.5, 0.5], [1.0, 3.0, 0.0], [2.0, 1.0, 0.3]),
            ([-1.0, 1e-3, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 1.0]),
        ];
        for (i, (corner, u, v)) in rects.into_iter().enumerate() {
            let [c, u, v] = [corner, u, v].map(Vec3::from_array);
            let polygon = [c, c + u, c + u + v, c + v].map(Vec3::as_dvec3);
            let expected = 3.0 * lambert(&UP, &polygon);
            let faces_point = u.cross(v).dot(-c) > 0.0;
            let (u, v) = if faces_point { (u, v) } else { (v, u) };
            let light = floor_under(Light::Rect { position: c, edge_u: u, edge_v: v, radiance: [3.0; 3] });
            assert_irradiance(&light.irradiance(&UP, 1 << 14, 1, i as u64), expected, 0.01);
            let behind = floor_under(Light::Rect { position: c, edge_u: v, edge_v: u, radiance: [3.0; 3] });
            assert_eq!(behind.irradiance(&UP, 256, 1, 0).total(), [0.0; 3]);

            let mut data = SceneData::new();
            let m = data.add_material(material(0.0, 3.0, false)).unwrap();
            let mut builder = MeshBuilder::new();
            builder.quad(c, c + u, c + u + v, c + v, m);
            data.add_mesh(builder.finish()).unwrap();
            let emissive = PathTracer::from_data(&data);
            assert_irradiance(&emissive.irradiance(&UP, 1 << 14, 1, i as u64), expected, 0.01);
        }
    }

    #[test]
    fn a_light_that_touches_the_surface_makes_no_fireflies() {
        let light = Light::Rect {
            position: Vec3::new(-1.0, 1e-3, 0.0),
            edge_u: Vec3::X * 2.0,
            edge_v: Vec3::Z,
            radiance: [1.0; 3],
        };
        let e = floor_under(light).irradiance(&UP, 4096, 3, 0);
        assert!(e.standard_error[0] < 0.01 * e.direct[0], "{e:?}");
    }

    #[test]
    fn light_adds_up_and_shadows_take_it_away() {
        let mut data = SceneData::new();
        let m = data.add_material(material(0.0, 0.0, false)).unwrap();
        data.add_mesh(square(1.0, 2.0, m)).unwrap();
        for x in [0.0, 3.0, -3.0] {
            data.add_light(Light::Point { position: Vec3::new(x, 0.0, 4.0), intensity: [25.0; 3] }).unwrap();
        }
        let sun = Vec3::new(0.0, -5.0, -1.0);
        data.add_light(Light::Directional { direction: sun, irradiance: [26f32.sqrt(); 3], angular_radius: 0.0 })
            .unwrap();
        // The square above the point hides the middle light; the sun comes in below it.
        let e = PathTracer::from_data(&data).irradiance(&UP, 1 << 14, 0, 0);
        assert_irradiance(&e, 2.0 * 25.0 * 0.8 / 25.0 + 1.0, 0.01);
    }

    #[test]
    fn one_sided_surfaces_are_black_from_behind_and_two_sided_ones_are_not() {
        for two_sided in [false, true] {
            let mut data = SceneData::new();
            let m = data.add_material(material(0.5, 2.0, two_sided)).unwrap();
            data.add_mesh(square(1.0, -1.0, m)).unwrap();
            let tracer = PathTracer::from_data(&data);
            let corners = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]];
            let polygon = corners.map(|[x, y]| DVec3::new(x, y, -1.0));
            let behind = SurfacePoint { position: DVec3::Z * -2.0, normal: DVec3::Z };
            let before = SurfacePoint { position: DVec3::ZERO, normal: DVec3::NEG_Z };
            let full = 2.0 * lambert(&before, &polygon);
            assert_irradiance(&tracer.irradiance(&before, 1 << 12, 0, 0), full, 0.02);
            let seen = tracer.irradiance(&behind, 1 << 12, 0, 1);
            if two_sided {
                assert_irradiance(&seen, full, 0.02);
            } else {
                assert_eq!(seen.total(), [0.0; 3]);
            }
        }
    }

    /// A closed unit cube seen from inside.
    fn furnace(albedo: f32) -> PathTracer {
        let mut data = SceneData::new();
        let m = data.add_material(material(albedo, 1.0, false)).unwrap();
        let mut builder = MeshBuilder::new();
        builder.box_(Vec3::ZERO, Vec3::ONE, true, m);
        data.add_mesh(builder.finish()).unwrap();
        PathTracer::from_data(&data)
    }

    const WALL: SurfacePoint = SurfacePoint { position: DVec3::new(0.3, 0.0, 0.9), normal: DVec3::Y };

    #[test]
    fn a_closed_box_glows_at_its_emission_over_one_minus_its_reflectance() {
        for albedo in [0.5f32, 0.9] {
            let tracer = furnace(albedo);
            let radiosity = 1.0 / (1.0 - albedo as f64);
            assert_irradiance(&tracer.irradiance(&WALL, 1 << 16, 0, 0), PI * radiosity, 0.01);
            let mut random = Random::new(0, 0);
            let n = 1 << 16;
            let seen: f64 =
                (0..n).map(|_| tracer.radiance(DVec3::splat(0.4), DVec3::new(0.2, 0.9, -0.3), &mut random)[0]).sum();
            assert!((seen / n as f64 / radiosity - 1.0).abs() < 0.02, "{albedo}: {}", seen / n as f64);
        }
    }

    #[test]
    fn each_bounce_adds_its_term_of_the_geometric_series() {
        let mut expected = 0.0;
        for bounces in 0..4 {
            expected += PI * 0.5f64.powi(bounces as i32);
            let e = furnace(0.5).with_max_bounces(bounces).irradiance(&WALL, 1 << 14, 0, 0);
            assert_irradiance(&e, expected, 0.02);
            assert!((e.direct[0] - PI).abs() < 0.02);
        }
    }

    #[test]
    fn a_closed_box_absorbs_the_power_of_its_lamp() {
        let mut data = SceneData::new();
        let m = data.add_material(material(0.8, 0.0, false)).unwrap();
        let mut builder = MeshBuilder::new();
        builder.box_(Vec3::ZERO, Vec3::new(1.0, 2.0, 3.0), true, m);
        let mesh = builder.finish();
        data.add_mesh(mesh.clone()).unwrap();
        data.add_light(Light::Point { position: Vec3::new(0.3, 1.5, 1.0), intensity: [1.0; 3] }).unwrap();
        let tracer = PathTracer::from_data(&data);
        let mut random = Random::new(4, 0);
        let (mut absorbed, mut variance) = (0.0, 0.0);
        let k = 8;
        for t in 0..mesh.indices.len() {
            let [a, b, c] = mesh.corners(t).map(Vec3::as_dvec3);
            let doubled = (b - a).cross(c - a);
            // Stratified over the triangle; the differences of neighbours estimate the variance.
            for cell in 0..k * k {
                let mut one = || {
                    let [u, v] = super::super::random::triangle_point(random.cell(cell % k, cell / k, k));
                    let position = a + (b - a) * u + (c - a) * v;
                    let point = SurfacePoint { position, normal: doubled.normalize() };
                    let e = tracer.irradiance(&point, 64, random.next_u64(), 0).total()[0];
                    e * 0.5 * doubled.length() * (1.0 - 0.8f32 as f64) / (2 * k * k) as f64
                };
                let (x, y) = (one(), one());
                absorbed += x + y;
                variance += (x - y) * (x - y);
            }
        }
        let emitted = 4.0 * PI;
        assert!((absorbed - emitted).abs() < 4.0 * variance.sqrt(), "{absorbed} ± {} W", variance.sqrt());
        assert!((absorbed - emitted).abs() < 0.02 * emitted, "{absorbed} W of {emitted} W");
    }

    #[test]
    fn no_light_enters_a_sealed_box() {
        let data = builtin("sealed").unwrap();
        let tracer = PathTracer::from_data(&data);
        let inside = &data.meshes()[1];
        let mut random = Random::new(7, 0);
        for t in 0..inside.indices.len() {
            let [a, b, c] = inside.corners(t).map(Vec3::as_dvec3);
            for i in 0..20 {
                let [u, v] = super::super::random::triangle_point(random.square());
                let position = a + (b - a) * u + (c - a) * v;
                let point = SurfacePoint { position, normal: (b - a).cross(c - a).normalize() };
                assert_eq!(tracer.irradiance(&point, 1024, t as u64, i).total(), [0.0; 3]);
            }
        }
        let outside = SurfacePoint { position: DVec3::new(0.5, 0.0, 0.5), normal: DVec3::Y };
        assert!(tracer.irradiance(&outside, 1024, 0, 0).total()[0] > 0.1);
    }

    #[test]
    fn images_do_not_depend_on_the_number_of_threads_and_show_what_the_camera_sees() {
        // A white emitter fills the upper right quarter of the image.
        let mut data = SceneData::new();
        let m = data.add_material(material(0.5, 1.0, true)).unwrap();
        let p = |x: f32, y: f32| Vec3::new(x, 0.0, y);
        let mesh = Mesh {
            positions: vec![p(0.0, 0.0), p(9.0, 0.0), p(9.0, 9.0), p(0.0, 9.0)].into(),
            indices: vec![[0, 1, 2], [0, 2, 3]].into(),
            materials: MeshMaterials::One(m),
            ..Default::default()
        };
        data.add_mesh(mesh).unwrap();
        let tracer = PathTracer::from_data(&data);
        let camera = Camera { position: Vec3::NEG_Y, target: Vec3::ZERO, up: Vec3::Z, fov_y: 1.0 };
        let image = |threads| {
            let device = Device::new(DeviceOptions { num_threads: threads, ..Default::default() }).unwrap();
            tracer.render(&device, &camera, 22, 18, 3, 0, &Progress::none()).unwrap()
        };
        let one = image(1);
        assert_eq!(one, image(3));
        for (i, color) in one.iter().enumerate() {
            let (x, y) = (i % 22, i / 22);
            assert_eq!(*color, [if x >= 11 && y < 9 { 1.0 } else { 0.0 }; 3], "({x}, {y})");
        }
    }

    #[test]
    fn rendering_and_many_points_can_be_cancelled() {
        let device = Device::new(DeviceOptions { num_threads: 2, ..Default::default() }).unwrap();
        let tracer = furnace(0.5);
        let camera = Camera { position: Vec3::splat(0.5), target: Vec3::X, up: Vec3::Y, fov_y: 1.0 };
        let progress = Progress::new(|fraction, _| fraction == 0.0);
        let image = tracer.render(&device, &camera, 640, 480, 64, 0, &progress);
        assert_eq!(image.err(), Some(crate::base::error::Error::Cancelled));
        let progress = Progress::new(|fraction, _| fraction == 0.0);
        let many = tracer.irradiance_many(&device, &[WALL; 1000], 4096, 0, &progress);
        assert_eq!(many.err(), Some(crate::base::error::Error::Cancelled));
    }
}
