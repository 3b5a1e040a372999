//! Settings and lights drawn over their whole ranges, and beyond them: whatever they are, light is finite and
//! not negative, or the call is refused with a sentence. Nothing panics. Work per case is bounded, so that
//! what would hang shows.
//!
//! Each case is a function of its number, which a failure prints: run it alone with BAKELITE_CASE=number, or
//! other numbers of cases than 300 with BAKELITE_CASES=number.

use bakelite::bvh::BuildOptions;
use bakelite::lightmap::{BakeParams, Layer, LayerData, Lightmap, LightmapDesc, Region};
use bakelite::live::{Budget, Live, LiveCamera, LiveParams, Mode, PageRect};
use bakelite::photon::{PhotonMap, PhotonParams};
use bakelite::reference::Random;
use bakelite::scene::shapes::MeshBuilder;
use bakelite::scene::{NONE, builtin};
use bakelite::{Device, DeviceOptions, Error, Light, Material, Mesh, Progress, Result, Scene, SceneData};
use glam::Vec3;
use std::sync::Arc;
use std::time::Instant;

/// Texels of the light map, at most, where it is not refused: keeps a case short.
const TEXELS: f64 = 3_000.0;

struct Draw(Random);

impl Draw {
    fn of(case: u64) -> Draw {
        Draw(Random::new(0xba5e, case))
    }

    fn below(&mut self, n: usize) -> usize {
        ((self.0.uniform() * n as f64) as usize).min(n - 1)
    }

    fn one_in(&mut self, n: usize) -> bool {
        self.below(n) == 0
    }

    fn pick<T: Copy>(&mut self, of: &[T]) -> T {
        of[self.below(of.len())]
    }

    /// Log-uniform in [10^low, 10^high].
    fn log(&mut self, low: f64, high: f64) -> f32 {
        10f64.powf(low + (high - low) * self.0.uniform()) as f32
    }

    /// A float in its range, mostly; else one of those that code forgets.
    fn float(&mut self, low: f64, high: f64) -> f32 {
        match self.below(12) {
            0 => self.pick(&[0.0, -0.0, -1.0, f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MIN_POSITIVE]),
            1 => self.pick(&[1e-45, 1e-40, f32::MAX, f32::EPSILON, 1e12, 1.0]),
            _ => self.log(low, high),
        }
    }

    /// A count: from a list, or log-uniform up to `most`.
    fn count(&mut self, list: &[u32], most: f64) -> u32 {
        if self.one_in(2) { self.pick(list) } else { self.log(0.0, most.log10()) as u32 }
    }

    fn point(&mut self, size: f32) -> Vec3 {
        let mut x = || (self.0.uniform() as f32 * 2.0 - 1.0) * size;
        Vec3::new(x(), x(), x())
    }

    fn color(&mut self) -> [f32; 3] {
        let most = self.pick(&[1.0, 1.0, 1e-30, 1e-44, 1e9, 1e12]);
        std::array::from_fn(|_| if self.one_in(4) { 0.0 } else { self.0.uniform() as f32 * most })
    }

    fn light(&mut self, size: f32) -> Light {
        let position = if self.one_in(4) { Vec3::ZERO } else { self.point(size) };
        let direction = self.point(1.0);
        match self.below(5) {
            0 => Light::Point { position, intensity: self.color() },
            1 => {
                let outer = self.pick(&[1e-7, 1e-3, 0.5, 3.1415925]);
                let inner = outer * self.pick(&[0.0, 0.5, 1.0]);
                Light::Spot { position, direction, inner, outer, intensity: self.color() }
            }
            2 => {
                let angular_radius = self.pick(&[0.0, 1e-5, 5e-3, 0.5, 1.57]);
                Light::Directional { direction, irradiance: self.color(), angular_radius }
            }
            3 => Light::Sky { radiance: self.color(), environment: NONE, up: direction, rotation: self.log(-3.0, 3.0) },
            _ => {
                let flat = self.pick(&[1.0, 1e-6]);
                let (edge_u, edge_v) = (self.point(size), self.point(size * flat));
                Light::Rect { position, edge_u, edge_v, radiance: self.color() }
            }
        }
    }

    fn material(&mut self) -> Material {
        let albedo = std::array::from_fn(|_| self.pick(&[0.0, 0.3, 0.9, 0.99]));
        let emission = if self.one_in(3) { self.color() } else { [0.0; 3] };
        // Where albedo is as high as may be, light passes through nothing.
        let transmission = albedo.map(|a: f32| if self.one_in(4) { 0.5 * (1.0 - a) } else { 0.0 });
        Material { albedo, emission, two_sided: self.one_in(2), transmission, ..Default::default() }
    }

    fn scene(&mut self) -> Result<SceneData> {
        let size = if self.one_in(3) { self.log(-12.0, 11.5) } else { 1.0 };
        let mut data = SceneData::new();
        let kind = self.below(5);
        if kind == 0 {
            data = builtin("cornell")?;
        } else {
            let (a, b) = (self.material(), self.material());
            data.add_material(a)?;
            data.add_material(b)?;
            let mut mesh = MeshBuilder::new();
            match kind {
                1 => (0..2).for_each(|i| mesh.triangle(self.point(size), self.point(size), self.point(size), i)),
                2 => {
                    for _ in 0..6 {
                        let (from, along) = (self.point(size), self.point(size));
                        let across = self.point(size * 1e-6);
                        mesh.triangle(from, from + along, from + 0.5 * along + across, 0);
                    }
                }
                3 => mesh.box_(Vec3::ZERO, Vec3::splat(size), true, 0),
                _ => mesh.sphere(Vec3::ZERO, size, 0, 1),
            }
            let mut mesh: Mesh = mesh.finish();
            if self.one_in(2) {
                mesh.normals =
                    mesh.positions.iter().map(|_| self.pick(&[1.0, 1.0, 0.0, f32::NAN]) * self.point(1.0)).collect();
            }
            data.add_mesh(mesh)?;
        }
        for _ in 0..self.below(3) {
            let light = self.light(if kind == 0 { 5.0 } else { size });
            data.add_light(light)?;
        }
        Ok(data)
    }

    /// In range with few texels, or out of range, or with more texels than there can be.
    fn desc(&mut self, scene: &Scene) -> LightmapDesc {
        let area: f64 = (0..scene.triangle_count())
            .filter(|&t| scene.is_valid(t))
            .map(|t| {
                let [a, b, c] = scene.corners(t).map(|c| c.as_dvec3());
                0.5 * (b - a).cross(c - a).length()
            })
            .sum();
        let most = (TEXELS / area).sqrt();
        let texels_per_unit = match self.below(8) {
            0 => self.pick(&[-1.0, f32::NAN, f32::INFINITY, f32::MAX]),
            1 => (most * 1e4) as f32,
            2 => self.pick(&[f32::MIN_POSITIVE, 1e-40]).min(most as f32),
            _ => (most as f32) * self.log(-4.0, 0.0),
        };
        let mut desc = LightmapDesc {
            texels_per_unit,
            page_size: self.pick(&[16, 17, 64, 100, 128]),
            padding: self.pick(&[1, 1, 2, 4]),
            gather_divisor: self.pick(&[1, 2, 3, 64]),
            radiance_divisor: self.pick(&[1, 2, 5, 64]),
            both_sides: self.one_in(2),
            seen_from: Vec::new(),
        };
        if self.one_in(4) {
            let lower = self.point(1.0);
            let size = self.pick(&[0.0, 1.0, 1e6, f32::NAN, -1.0]);
            desc.seen_from.push(Region { lower, upper: lower + size });
        }
        match self.below(20) {
            0 => desc.page_size = self.pick(&[0, 15, 20_000, u32::MAX]),
            1 => desc.padding = self.pick(&[0, 16, 64, u32::MAX]),
            2 => desc.gather_divisor = self.pick(&[0, 65, u32::MAX]),
            3 => desc.radiance_divisor = self.pick(&[0, 65, u32::MAX]),
            _ => {}
        }
        desc
    }

    fn bake(&mut self, texels: u64) -> BakeParams {
        let range = texels as usize + 2;
        let mut params = BakeParams {
            photon_count: self.count(&[0, 1, 2, 100], 3e3) as u64,
            max_bounces: self.count(&[0, 1, 2, u32::MAX], 100.0),
            gather_rays: self.count(&[0, 1, 31, 33, 64], 100.0),
            radius: if self.one_in(2) { 0.0 } else { self.log(-37.9, 38.0) },
            interpolation_error: self.pick(&[1e-3, 1.0, 1.0, f32::INFINITY]),
            interpolation_contrast: self.pick(&[1e-3, 0.3, 0.3, f32::INFINITY]),
            near_hits: self.pick(&[0.0, 2.0, 2.0, 30.0, f32::INFINITY]),
            blur_radius: self.count(&[0, 1, 16], 16.0),
            direct_samples: self.count(&[1, 2], 20.0),
            seed: self.0.next_u64(),
            ..Default::default()
        };
        match self.below(20) {
            0 => params.photon_count = 1 << 33,
            1 => params.gather_rays = self.pick(&[65_537, u32::MAX]),
            2 => params.radius = self.float(-45.0, 38.0),
            3 => params.blur_radius = self.pick(&[17, u32::MAX]),
            4 => params.direct_samples = self.pick(&[0, 4097, u32::MAX]),
            5 => params.memory_budget = self.pick(&[1, 100_000, u64::MAX]),
            6..8 => params.texel_begin = self.below(range) as u64,
            8..10 => params.texel_end = self.below(range) as u64,
            _ => {}
        }
        params
    }

    fn photons(&mut self) -> PhotonParams {
        PhotonParams {
            photon_count: self.count(&[1, 2], 3e3) as u64 - self.one_in(20) as u64,
            max_bounces: self.count(&[0, 1, u32::MAX], 100.0),
            radius: if self.one_in(10) { self.float(-45.0, 38.0) } else { self.log(-37.9, 38.0) },
            half_height: if self.one_in(10) { self.float(-45.0, 38.0) } else { self.log(-37.9, 38.0) },
            cone_k: if self.one_in(10) { self.float(0.0, 38.0) } else { 1.0 + self.log(-7.0, 38.0) },
            seed: self.0.next_u64(),
            memory_budget: self.pick(&[0, 0, 0, 0, 0, 0, 1, 100_000]),
            store_direct: self.one_in(2),
            ..PhotonParams::default()
        }
    }

    fn live(&mut self) -> LiveParams {
        let mut params = LiveParams {
            mode: self.pick(&[Mode::View, Mode::Position, Mode::Uniform]),
            lod_count: self.pick(&[1, 2, 3]),
            promote_threshold: 1,
            max_rounds: self.pick(&[1, 2, 3]),
            rays_per_update: self.pick(&[0, 1, 1000, u32::MAX]),
            blur: self.pick(&[0, 2, 16]),
            photon_count: self.count(&[0, 1], 1e3) as u64,
            direct_samples: self.pick(&[1, 4]),
            radius: if self.one_in(2) { 0.0 } else { self.log(-37.9, 38.0) },
            directional: self.pick(&[0, 0, 1, 3]),
            ..Default::default()
        };
        match self.below(12) {
            0 => params.lod_count = self.pick(&[0, 100]),
            1 => params.promote_threshold = self.pick(&[0, 2, u32::MAX]),
            2 => params.max_rounds = self.pick(&[0, 1025]),
            3 => params.blur = 17,
            4..6 => params.cell_size = self.pick(&[1.0, 1e-30, 1e30, f32::NAN, -1.0, f32::INFINITY]),
            _ => {}
        }
        params
    }
}

/// What a refused call may say.
fn is_refusal(e: &Error) -> bool {
    matches!(e, Error::InvalidArgument(_) | Error::InvalidState(_) | Error::OutOfMemory(_))
}

fn is_sound(light: &[[f32; 3]]) -> bool {
    light.iter().flatten().all(|x| x.is_finite() && *x >= 0.0)
}

fn check_light(map: &Lightmap) {
    for page in 0..map.info().page_count {
        for layer in [Layer::Combined, Layer::Direct, Layer::Indirect, Layer::Radiance] {
            let LayerData::Rgb(light) = map.read(page, layer).unwrap() else { panic!("light is RGB") };
            assert!(is_sound(&light), "{layer:?}: {:?}", light.iter().find(|t| !is_sound(&[**t])));
        }
        for layer in [Layer::Position, Layer::Normal] {
            let LayerData::Rgb(places) = map.read(page, layer).unwrap() else { panic!("places are RGB") };
            assert!(places.iter().flatten().all(|x| x.is_finite()), "{layer:?}");
        }
        let LayerData::Integer(triangles) = map.read(page, Layer::Triangle).unwrap() else { panic!("numbers") };
        assert!(triangles.iter().all(|&t| t == NONE || t < map.scene().triangle_count()));
    }
    for t in 0..map.scene().triangle_count() {
        assert!(is_sound(&[map.sample(Layer::Combined, t, true, 0.3, 0.3)]));
    }
}

/// Runs a part of a case: what it gives, or nothing if it was refused.
fn allowed<T>(what: &str, result: Result<T>) -> Option<T> {
    match result {
        Ok(value) => Some(value),
        Err(e) => {
            assert!(is_refusal(&e), "{what}: {e}");
            None
        }
    }
}

/// Which parts of a case ran.
#[derive(Default, Debug)]
struct Ran {
    scenes: u32,
    maps: u32,
    bakes: u32,
    photons: u32,
    lives: u32,
}

fn run(device: &Arc<Device>, case: u64, ran: &mut Ran) {
    let mut draw = Draw::of(case);
    let Some(data) = allowed("scene", draw.scene()) else { return };
    let commit = Scene::commit(device, data, &BuildOptions::default(), &Progress::none());
    let Some(scene) = allowed("commit", commit.map_err(|(_, e)| e)) else { return };
    ran.scenes += 1;

    let photons = draw.photons();
    if let Some(map) = allowed("photons", PhotonMap::trace(&scene, &photons, &Progress::none())) {
        let s = map.stats();
        for power in [s.emitted_power, s.absorbed_power, s.escaped_power, s.truncated_power] {
            assert!(power.iter().all(|p| p.is_finite() && *p >= -1e-9 * s.emitted_power.iter().sum::<f64>()), "{s:?}");
        }
        let t = draw.below(scene.triangle_count() as usize) as u32;
        let corners = scene.corners(t);
        for p in [corners[0], (corners[0] + corners[1] + corners[2]) / 3.0, Vec3::MAX, Vec3::ZERO] {
            let e = map.estimate(p, scene.normal(t));
            assert!(is_sound(&[e]), "estimate {e:?} with {photons:?}");
        }
        // Where photons are, discs of any size hold one.
        let photons = map.photons().unwrap();
        for i in (0..photons.position.len()).step_by(97) {
            let e = map.estimate(photons.position[i].into(), -Vec3::from(photons.direction[i]));
            assert!(is_sound(&[e]), "estimate {e:?} at a photon with radius {}", map.radius());
        }
        ran.photons += 1;
    }

    let desc = draw.desc(&scene);
    let Some(mut map) = allowed("light map", Lightmap::create(&scene, &desc, &Progress::none())) else { return };
    assert!(map.info().texels < 40_000, "{} texels of {desc:?}", map.info().texels);
    ran.maps += 1;
    for _ in 0..2 {
        let params = draw.bake(map.info().texels);
        if allowed("bake", map.bake(&params, &Progress::none())).is_some() {
            check_light(&map);
            ran.bakes += 1;
        }
    }
    if map.info().texels < 2_000
        && let Some(mut live) = allowed("live", Live::new(&map, &draw.live(), &Progress::none()))
    {
        let [position, forward, up] = [draw.point(2.0), draw.point(1.0), draw.point(1.0)];
        let fov_y = draw.pick(&[1.0, 1e-6, 3.1, 0.0, f32::NAN]);
        let camera = LiveCamera { position, forward, up, fov_y, width: draw.pick(&[64, 1, 0]), height: 48 };
        for rays in [5_000, 1] {
            allowed("update", live.update(&camera, &Budget { milliseconds: 0.0, rays, max_dirty_bytes: 0 }));
        }
        let rect = PageRect { page: 0, x: 0, y: 0, width: map.info().width, height: map.info().height };
        if let Some(light) = allowed("read", live.read(&rect, live.params().lod_count - 1, Layer::Combined)) {
            assert!(is_sound(&light), "live light {:?}", light.iter().find(|t| !is_sound(&[**t])));
        }
        ran.lives += 1;
    }
}

#[test]
fn no_setting_panics_or_gives_light_that_is_none() {
    let device = Device::new(DeviceOptions { num_threads: 2, ..Default::default() }).unwrap();
    let mut ran = Ran::default();
    let number = |name: &str| std::env::var(name).ok().and_then(|c| c.parse::<u64>().ok());
    let cases = match (number("BAKELITE_CASE"), number("BAKELITE_CASES")) {
        (Some(case), _) => case..case + 1,
        (None, count) => 0..count.unwrap_or(300),
    };
    let alone = cases.end - cases.start < 300;
    let mut failed = Vec::new();
    let mut slowest = (0.0, 0);
    for case in cases {
        let start = Instant::now();
        if std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| run(&device, case, &mut ran))).is_err() {
            failed.push(case);
        }
        let seconds = start.elapsed().as_secs_f64();
        slowest = if seconds > slowest.0 { (seconds, case) } else { slowest };
    }
    println!("slowest: case {} in {:.2} s", slowest.1, slowest.0);
    assert!(failed.is_empty(), "cases {failed:?}");
    println!("{ran:?}");
    assert!(
        alone || (ran.scenes > 250 && ran.maps > 150 && ran.bakes > 200 && ran.photons > 150 && ran.lives > 50),
        "{ran:?}"
    );
}
