//! Cases of `bakelite report stability` about light: how much there is, and where lights are.

use super::lab::{Case, Lab, Row, Texel, deviation, diffuse, largest, mean, scenes, small_bake, small_desc, texels};
use bakelite::lightmap::{BakeParams, Layer, LightmapDesc};
use bakelite::photon::{PhotonMap, PhotonParams};
use bakelite::reference::{PathTracer, SurfacePoint};
use bakelite::scene::builtin;
use bakelite::scene::shapes::MeshBuilder;
use bakelite::{Light, Material, Progress, Result, SceneData};
use glam::{DVec3, Vec3};
use std::f64::consts::PI;
use std::time::Instant;

pub const CASES: [(&str, Case); 9] = [
    ("furnace", furnace),
    ("energy", energy),
    ("light power", light_power),
    ("point light near a wall", point_near_wall),
    ("point light near a ceiling", point_near_ceiling),
    ("rect light on a wall", rect_on_wall),
    ("emissive quad in a wall", emissive_in_wall),
    ("point light in a solid", light_in_solid),
    ("half floats", half_floats),
];

/// Photons that surfaces of the furnace meet, at most: Russian roulette lets a photon meet 1/(1 − albedo).
const FURNACE_HITS: f64 = 2e6;

/// A closed box that emits E glows at E/(1 − albedo).
fn furnace(lab: &Lab, rows: &mut Vec<Row>) -> Result<()> {
    for albedo in lab.some(&[0.1, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99, 0.999]) {
        let mut data = SceneData::new();
        let walls =
            data.add_material(Material { albedo: [albedo as f32; 3], emission: [1.0; 3], ..Default::default() })?;
        let mut cube = MeshBuilder::new();
        cube.box_(Vec3::ZERO, Vec3::ONE, true, walls);
        data.add_mesh(cube.finish())?;
        let hits = if lab.quick { FURNACE_HITS / 4.0 } else { FURNACE_HITS };
        let params =
            BakeParams { photon_count: (hits * (1.0 - albedo)).ceil() as u64, gather_rays: 128, ..small_bake() };
        let start = Instant::now();
        let mut map = bakelite::lightmap::Lightmap::create(&lab.commit(data)?, &small_desc(), &Progress::none())?;
        let stats = map.bake(&params, &Progress::none())?;
        let got = mean(&texels(&map, Layer::Combined)?);
        let cost = format!(
            "{} photons met {:.2} M surfaces, {:.1} s",
            stats.photons_emitted,
            stats.photons_stored as f64 * 1e-6,
            start.elapsed().as_secs_f64()
        );
        let expected = PI / (1.0 - albedo as f32 as f64);
        rows.push(Row::new("furnace", albedo, 1.0 / (1.0 - albedo), expected, got).within(0.01).note(cost));
    }
    Ok(())
}

/// Absorbed plus escaped plus truncated power is what was emitted, within the sampling error of roulette: its
/// standard deviation is at most the power of the photons times the square root of their number.
fn energy(lab: &Lab, rows: &mut Vec<Row>) -> Result<()> {
    let most = lab.args.params.photon_count.clamp(100, bakelite::photon::MAX_PHOTONS);
    for (name, data) in scenes(lab.args)? {
        if lab.quick && name == "atrium" {
            continue;
        }
        let scene = lab.commit(data)?;
        let counts = [100, 1_000, 10_000, 100_000, 1_000_000].into_iter().filter(|&n| n < most).chain([most]);
        for photon_count in counts.filter(|&n| !lab.quick || n <= 10_000) {
            let params = PhotonParams { photon_count, ..Default::default() };
            let stats = PhotonMap::trace(&scene, &params, &Progress::none())?.stats();
            let sum = |p: [f64; 3]| p.iter().sum::<f64>();
            let got = sum(stats.absorbed_power) + sum(stats.escaped_power) + sum(stats.truncated_power);
            let row = Row::new(
                "energy",
                format!("{name}, {photon_count} photons"),
                photon_count as f64,
                sum(stats.emitted_power),
                got,
            );
            let lost = sum(stats.truncated_power) / sum(stats.emitted_power);
            let row = row.within(4.0 / (photon_count as f64).sqrt());
            rows.push(if lost > 0.0 { row.note(format!("truncated {lost:.1e}")) } else { row });
        }
    }
    Ok(())
}

/// Light is linear: the same picture, brighter.
fn light_power(lab: &Lab, rows: &mut Vec<Row>) -> Result<()> {
    let bake = |factor: f32| -> Result<_> {
        let mut data = builtin("cornell")?;
        let Light::Rect { position, edge_u, edge_v, radiance } = data.lights()[0] else { return Ok(Vec::new()) };
        data.set_light(0, Light::Rect { position, edge_u, edge_v, radiance: radiance.map(|r| r * factor) })?;
        texels(&lab.baked(data, &small_desc(), &small_bake())?, Layer::Combined)
    };
    let one = bake(1.0)?;
    for power in lab.some(&[-9, -6, -3, 0, 3, 6, 9]) {
        // A power of two, so that the scaled light has the same digits: what adapts to light (points in texels where it
        // varies) must decide the same everywhere, which other factors would upset by a rounding here and there.
        let exponent = (f64::from(power) * 10f64.log2()).round() as i32;
        let factor = 2f64.powi(exponent);
        let got = bake(factor as f32)?;
        let pairs = || got.iter().zip(&one);
        let worst = pairs().map(|(a, b)| (a.value.as_dvec3() / factor - b.value.as_dvec3()).abs().max_element());
        let error = worst.fold(0.0, f64::max) / largest(&one);
        let error = if mean(&got).is_nan() || got.len() != one.len() { f64::NAN } else { error };
        rows.push(
            Row::of_error("light power", format!("2^{exponent}"), factor, error)
                .within(1e-6)
                .note("largest difference of a texel from the scaled picture"),
        );
    }
    Ok(())
}

/// A floor of 1 x 1, looking up.
fn floor(material: u32) -> MeshBuilder {
    let mut floor = MeshBuilder::new();
    floor.quad(Vec3::ZERO, Vec3::Z, Vec3::new(1.0, 0.0, 1.0), Vec3::X, material);
    floor
}

/// The solid angle of a square of an edge `size` around a point `aside` (x, z) of a plane, seen from `height` above it:
/// by what a point light of unit intensity brings to the square, the mean irradiance times the area.
fn solid_angle([x, z]: [f64; 2], size: f64, height: f64) -> f64 {
    let corner = |x: f64, z: f64| (x * z).atan2(height * (x * x + z * z + height * height).sqrt());
    let ([x0, x1], [z0, z1]) = ([x - 0.5 * size, x + 0.5 * size], [z - 0.5 * size, z + 0.5 * size]);
    corner(x1, z1) - corner(x0, z1) - corner(x1, z0) + corner(x0, z0)
}

/// The mean of the irradiance h I / d³ over every texel, at any height.
fn point_near_wall(lab: &Lab, rows: &mut Vec<Row>) -> Result<()> {
    for height in lab.some(&[1e-1f32, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 0.0]) {
        let mut data = SceneData::new();
        let grey = data.add_material(diffuse(0.5))?;
        data.add_mesh(floor(grey).finish())?;
        let position = Vec3::new(0.4871, height, 0.5317);
        data.add_light(Light::Point { position, intensity: [1.0; 3] })?;
        let map = lab.baked(data, &small_desc(), &small_bake())?;
        let texels = texels(&map, Layer::Combined)?;
        let size = 1.0 / f64::from(map.info().texels_per_unit);
        let expected = |p: Vec3| {
            let way = (position - p).as_dvec3();
            solid_angle([way.x, way.z], size, way.y) / (size * size)
        };
        let case = "point light near a wall";
        let row = if height > 0.0 {
            Row::of_error(case, format!("{height:e}"), height as f64, deviation(&texels, |t| expected(t.position)))
        } else {
            Row::of_error(case, "0", 0.0, largest(&texels))
        };
        // Rays start 32 rounding steps of the scene above the floor: a light below that shines from behind.
        let sound = !mean(&texels).is_nan();
        rows.push(row.within(0.01).or_degrades(sound && height < 1e-5).note(if sound {
            "finite"
        } else {
            "not finite"
        }));
    }
    Ok(())
}

/// A closed room of 1 x 1 x 1 with dark or grey walls.
fn room(data: &mut SceneData, albedo: f32) -> Result<()> {
    let walls = data.add_material(diffuse(albedo))?;
    let mut cube = MeshBuilder::new();
    cube.box_(Vec3::ZERO, Vec3::ONE, true, walls);
    data.add_mesh(cube.finish()).map(drop)
}

/// Mean irradiance by the f64 path tracer and by a bake, of some `count` texels among those that `choose`, and
/// whether all texels are sound.
fn against_path_tracer(
    lab: &Lab,
    reference: &SceneData,
    data: SceneData,
    count: usize,
    choose: impl Fn(Vec3) -> bool,
) -> Result<(f64, f64, bool)> {
    let tracer = PathTracer::from_data(reference);
    let desc = LightmapDesc { page_size: 256, ..small_desc() };
    let params = BakeParams { gather_rays: 256, direct_samples: 64, photon_count: 200_000, ..small_bake() };
    let all = texels(&lab.baked(data, &desc, &params)?, Layer::Combined)?;
    let chosen: Vec<_> = all.iter().filter(|t| choose(t.position)).copied().collect();
    let some: Vec<_> = chosen.iter().step_by((chosen.len() / count).max(1)).copied().collect();
    let points: Vec<SurfacePoint> =
        some.iter().map(|t| SurfacePoint { position: t.position.as_dvec3(), normal: t.normal.as_dvec3() }).collect();
    let samples = if lab.quick { 256 } else { 4096 };
    let reference = tracer.irradiance_many(&lab.device, &points, samples, 1, &Progress::none())?;
    let expected = reference.iter().map(|e| e.total()[0]).sum::<f64>() / points.len() as f64;
    Ok((expected, mean(&some), !mean(&all).is_nan()))
}

/// A lamp just below the ceiling, which reflects half of its light from a spot much smaller than a texel: the same as a lamp that
/// shines downwards alone, and a small rect light in place of the spot.
fn point_near_ceiling(lab: &Lab, rows: &mut Vec<Row>) -> Result<()> {
    for height in lab.some(&[1e-2f32, 1e-3, 1e-4]) {
        let position = Vec3::new(0.47, 1.0 - height, 0.56);
        let lit = |lights: &[Light]| -> Result<SceneData> {
            let mut data = SceneData::new();
            room(&mut data, ALBEDO)?;
            for &light in lights {
                data.add_light(light)?;
            }
            Ok(data)
        };
        const ALBEDO: f32 = 0.5;
        const SIDE: f32 = 0.01;
        let (inner, outer) = (89.9f32.to_radians(), 90f32.to_radians());
        let below = Light::Spot { position, direction: -Vec3::Y, inner, outer, intensity: [1.0; 3] };
        let (edge_u, edge_v) = (Vec3::X * SIDE, Vec3::Z * SIDE);
        let corner = Vec3::new(position.x, 1.0 - 1e-4, position.z) - 0.5 * (edge_u + edge_v);
        let radiance = [2.0 * ALBEDO / (SIDE * SIDE); 3];
        let reference = lit(&[below, Light::Rect { position: corner, edge_u, edge_v, radiance }])?;
        let lamp = lit(&[Light::Point { position, intensity: [1.0; 3] }])?;
        let (expected, got, sound) = against_path_tracer(lab, &reference, lamp, 200, |p| p.y < 0.9)?;
        let got = if sound { got } else { f64::NAN };
        let name = "point light near a ceiling";
        rows.push(
            Row::new(name, format!("{height:e}"), height as f64, expected, got).within(0.02).note("f64 path tracer"),
        );
    }
    Ok(())
}

/// The wall that a rect light lies on, at 0 and near it, does not shade the room.
fn rect_on_wall(lab: &Lab, rows: &mut Vec<Row>) -> Result<()> {
    for gap in lab.some(&[0.0f32, 1e-7, 1e-5, 1e-3]) {
        let lit = |gap: f32| -> Result<SceneData> {
            let mut data = SceneData::new();
            room(&mut data, 0.5)?;
            let position = Vec3::new(0.3, 1.0 - gap, 0.3);
            data.add_light(Light::Rect { position, edge_u: Vec3::X * 0.4, edge_v: Vec3::Z * 0.4, radiance: [5.0; 3] })?;
            Ok(data)
        };
        // The path tracer's rays at the lights see the wall where both are in one plane.
        let (expected, got, sound) = against_path_tracer(lab, &lit(gap.max(1e-7))?, lit(gap)?, 200, |p| p.y < 0.9)?;
        let got = if sound { got } else { f64::NAN };
        let name = "rect light on a wall";
        rows.push(Row::new(name, format!("{gap:e}"), gap as f64, expected, got).within(0.02).note("f64 path tracer"));
    }
    Ok(())
}

/// A lamp that is an emissive quad in the plane of the ceiling, or close below it. In the very plane half of the
/// rays see the ceiling instead, but the lamp shines by shadow rays.
fn emissive_in_wall(lab: &Lab, rows: &mut Vec<Row>) -> Result<()> {
    for gap in lab.some(&[0.0f32, 1e-6, 1e-4, 1e-2]) {
        let mut data = SceneData::new();
        room(&mut data, 0.5)?;
        let lamp = data.add_material(Material { albedo: [0.5; 3], emission: [5.0; 3], ..Default::default() })?;
        let y = 1.0 - gap;
        let at = |x: f32, z: f32| Vec3::new(x, y, z);
        let mut quad = MeshBuilder::new();
        quad.quad(at(0.3, 0.3), at(0.7, 0.3), at(0.7, 0.7), at(0.3, 0.7), lamp);
        data.add_mesh(quad.finish())?;
        let (expected, got, sound) = if gap > 0.0 {
            against_path_tracer(lab, &data.clone(), data, 200, |p| p.y < 0.9)?
        } else {
            // The path tracer has no rule for what lies in one plane either.
            let all = texels(&lab.baked(data, &small_desc(), &small_bake())?, Layer::Direct)?;
            let floor: Vec<_> = all.iter().filter(|t| t.position.y < 1e-3).copied().collect();
            (form_factor_mean(&floor), mean(&floor), !mean(&all).is_nan())
        };
        let got = if sound { got } else { f64::NAN };
        let (name, note) = ("emissive quad in a wall", if gap > 0.0 { "f64 path tracer" } else { "direct, analytic" });
        rows.push(Row::new(name, format!("{gap:e}"), gap as f64, expected, got).within(0.02).note(note));
    }
    Ok(())
}

/// Mean irradiance of points on the floor from the lamp of [`emissive_in_wall`], by the midpoint rule.
fn form_factor_mean(floor: &[Texel]) -> f64 {
    const N: usize = 40;
    let one = |p: DVec3| {
        let cells = (0..N * N).map(|i| {
            let place = |k: usize| 0.3 + 0.4 * (k as f64 + 0.5) / N as f64;
            let way = DVec3::new(place(i % N), 1.0, place(i / N)) - p;
            way.y * way.y / way.length_squared().powi(2)
        });
        5.0 * cells.sum::<f64>() * (0.4 * 0.4) / (N * N) as f64
    };
    floor.iter().map(|t| one(t.position.as_dvec3())).sum::<f64>() / floor.len().max(1) as f64
}

/// A light inside of a closed solid, of any thickness, lights nothing outside.
fn light_in_solid(lab: &Lab, rows: &mut Vec<Row>) -> Result<()> {
    for size in lab.some(&[1e-1f32, 1e-3, 1e-5]) {
        let mut data = SceneData::new();
        room(&mut data, 0.5)?;
        let centre = Vec3::new(0.51, 0.47, 0.53);
        let mut solid = MeshBuilder::new();
        solid.box_(centre - size, centre + size, false, 0);
        data.add_mesh(solid.finish())?;
        data.add_light(Light::Point { position: centre, intensity: [1e3; 3] })?;
        let all = texels(&lab.baked(data, &small_desc(), &small_bake())?, Layer::Combined)?;
        rows.push(Row::of_error("point light in a solid", format!("{size:e}"), size as f64, largest(&all)).within(0.0));
    }
    Ok(())
}

/// Light beyond what half floats hold is clamped to 65504 when read as such, by way of the C API.
fn half_floats(lab: &Lab, rows: &mut Vec<Row>) -> Result<()> {
    use bakelite::capi::{bake, device, files, lightmap, lights, read, scene};
    let radiances: Vec<f32> = lab.some(&[1e-9, 1.0, 1e6, 1e12]);
    for radiance in radiances {
        let (mut d, mut s, mut l) = (std::ptr::null_mut(), std::ptr::null_mut(), std::ptr::null_mut());
        let mut halves = vec![0u16; 4 * 128 * 128];
        // SAFETY: handles are used between their creation and release, structures are initialised by the
        // library's own functions, and `halves` holds the 128 x 128 texels of a page.
        let results = unsafe {
            let mut light = std::mem::zeroed::<lights::bk_light_desc>();
            lights::bk_light_desc_init(&mut light);
            light.position = [2.78, 3.0, 2.8];
            light.color = [radiance; 3];
            let mut desc = std::mem::zeroed::<lightmap::bk_lightmap_desc>();
            lightmap::bk_lightmap_desc_init(&mut desc);
            desc.page_size = 128;
            let mut params = std::mem::zeroed::<bake::bk_bake_params>();
            bake::bk_bake_params_init(&mut params);
            params.photon_count = 10_000;
            let results = [
                device::bk_device_create(std::ptr::null(), &mut d),
                scene::bk_scene_create(d, &mut s),
                files::bk_scene_load_builtin(s, c"cornell".as_ptr()),
                lights::bk_scene_set_light(s, 0, &light),
                scene::bk_scene_commit(s, None, std::ptr::null_mut()),
                lightmap::bk_lightmap_create(s, &desc, None, std::ptr::null_mut(), &mut l),
                bake::bk_bake(l, &params, None, std::ptr::null_mut(), std::ptr::null_mut()),
                read::bk_lightmap_read(
                    l,
                    0,
                    read::BK_LAYER_COMBINED,
                    read::BK_FORMAT_RGBA16F,
                    halves.as_mut_ptr().cast(),
                    0,
                ),
            ];
            lightmap::bk_lightmap_release(l);
            scene::bk_scene_release(s);
            device::bk_device_release(d);
            results
        };
        // Exponent 31 is infinity and NaN; bit 15 the sign.
        let unsound = halves.iter().filter(|&&h| h & 0x7c00 == 0x7c00 || h > 0x8000).count();
        let clamped = halves.iter().filter(|&&h| h == 0x7bff).count();
        let failed = results.iter().filter(|&&r| r != 0).count();
        rows.push(
            Row::of_error("half floats", format!("{radiance:e}"), radiance as f64, (unsound + failed) as f64)
                .within(0.0)
                .note(format!("values that are not finite or negative; {clamped} are 65504")),
        );
    }
    Ok(())
}
