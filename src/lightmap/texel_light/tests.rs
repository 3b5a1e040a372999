//! Tests of the direct light of texels.

use super::*;
use crate::base::progress::Progress;
use crate::direct::direct_light::DirectLight;
use crate::lightmap::atlas::ids::PlacementId;
use crate::lightmap::{BakeParams, Lightmap, LightmapDesc};
use crate::scene::demo::shapes::MeshBuilder;
use crate::scene::{Light, Material, SceneData, builtin};
use std::sync::Arc;

fn created(scene: &Arc<Scene>, texels_per_unit: f32) -> Lightmap {
    let desc = LightmapDesc { texels_per_unit, page_size: 512, both_sides: false, ..Default::default() };
    Lightmap::create(scene, &desc, &Progress::none()).unwrap()
}

#[test]
fn points_of_a_texel_lie_in_it_and_on_its_chart() {
    let scene = builtin("atrium").unwrap().committed();
    let map = created(&scene, 5.0);
    let atlas = map.atlas();
    let areas = atlas.areas(&atlas.radiance);
    let (mut found, mut other_triangles) = (0, 0);
    for sample in atlas.radiance.all().step_by(11) {
        let own = atlas.radiance[sample];
        let placement = atlas.radiance.placement_of(&atlas.charts, sample);
        for number in 0..16 {
            let Some(p) = areas.point(sample, number, 3) else { continue };
            assert_eq!(atlas.charts.chart_of(p.triangle), atlas.charts.chart_of(own.triangle));
            let at = atlas.radiance.layout.texel_coord(placement, atlas.charts.local(p.triangle, p.u, p.v));
            let within = Vec2::from(at) - Vec2::new(own.x as f32, own.y as f32);
            assert!(within.min_element() > -0.01 && within.max_element() < 1.01, "{within}");
            found += 1;
            other_triangles += (p.triangle != own.triangle) as u32;
        }
    }
    assert!(found > 1000 && other_triangles > 100, "{found} points, {other_triangles} on other triangles");
}

/// A floor below a roof that ends at x = `edge`, or has a slit there, `slit` wide, under the sun at the zenith.
fn under_a_roof(edge: f32, slit: f32, angular_radius: f32) -> Arc<Scene> {
    let mut data = SceneData::new();
    let m = data.add_material(Material { albedo: [0.5; 3], two_sided: true, ..Default::default() }).unwrap();
    let mut builder = MeshBuilder::new();
    let p = |x: f32, y: f32, z: f32| Vec3::new(x, y, z);
    builder.quad(p(0.0, 0.0, 0.0), p(4.0, 0.0, 0.0), p(4.0, 4.0, 0.0), p(0.0, 4.0, 0.0), m);
    let mut roof = |x0: f32, x1: f32| {
        builder.quad(p(x0, -1.0, 1.0), p(x1, -1.0, 1.0), p(x1, 5.0, 1.0), p(x0, 5.0, 1.0), m);
    };
    roof(edge, 5.0);
    if slit > 0.0 {
        roof(-1.0, edge - slit);
    }
    data.add_mesh(builder.finish()).unwrap();
    let direction = -Vec3::Z;
    data.add_light(Light::Directional { direction, irradiance: [2.0; 3], angular_radius }).unwrap();
    data.committed()
}

#[test]
fn a_texel_that_a_shadow_edge_crosses_has_the_part_of_the_light_that_falls_on_it() {
    for angular_radius in [0.0, 0.004] {
        for edge in [1.93, 2.0, 2.07] {
            let scene = under_a_roof(edge, 0.0, angular_radius);
            let mut map = created(&scene, 4.0);
            let params = BakeParams { gather_rays: 0, ..Default::default() };
            map.bake(&params, &Progress::none()).unwrap();
            let (atlas, light) = (map.atlas(), map.light.as_ref().unwrap());
            let (mut crossed, mut sum, mut expected) = (0, 0.0, 0.0);
            for (sample, direct) in light.direct.iter().enumerate() {
                let t = &atlas.map.texels.samples[sample];
                let x = t.position(&scene);
                if x.z > 0.5 {
                    continue;
                }
                let part = ((edge - x.x) * 4.0 + 0.5).clamp(0.0, 1.0);
                assert!((direct.x / 2.0 - part).abs() < 0.1, "edge {edge}: {} at {x}, not {part}", direct.x / 2.0);
                crossed += (part > 0.0 && part < 1.0) as u32;
                sum += direct.x / 2.0;
                expected += part;
            }
            assert!(crossed > 10 || edge == 2.0, "{crossed} texels are crossed by the edge at {edge}");
            // Of the 16 points of a texel that the edge crosses one lies in the light or not by chance, with a standard
            // deviation of at most 1/32 of the texel.
            let deviation = (crossed as f32).sqrt() / 32.0;
            let tolerance = (3.0 * deviation).max(2e-3 * expected);
            assert!((sum - expected).abs() < tolerance, "{sum} instead of {expected}");
        }
    }
}

#[test]
fn a_floor_that_goes_on_below_a_block_has_no_dark_rim_around_it() {
    let mut data = SceneData::new();
    let m = data.add_material(Material { albedo: [0.5; 3], ..Default::default() }).unwrap();
    let mut builder = MeshBuilder::new();
    let p = |x: f32, y: f32| Vec3::new(x, y, 0.0);
    builder.quad(p(0.0, 0.0), p(4.0, 0.0), p(4.0, 4.0), p(0.0, 4.0), m);
    builder.box_(Vec3::new(1.0, 1.0, -1.0), Vec3::new(2.1, 2.1, 1.0), false, m);
    data.add_mesh(builder.finish()).unwrap();
    let (direction, irradiance) = (-Vec3::Z, [2.0; 3]);
    data.add_light(Light::Directional { direction, irradiance, angular_radius: 0.0 }).unwrap();
    let scene = data.committed();
    let mut map = created(&scene, 4.0);
    map.bake(&BakeParams { gather_rays: 0, ..Default::default() }, &Progress::none()).unwrap();
    let (atlas, light) = (map.atlas(), map.light.as_ref().unwrap());
    let floor = |s: &usize| {
        let t = &atlas.map.texels.samples[*s];
        t.geometric_normal(&scene).z > 0.9 && t.position(&scene).z.abs() < 1e-3
    };
    let lit: Vec<f32> = (0..light.direct.len()).filter(floor).map(|s| light.direct[s].x).collect();
    assert!(lit.len() > 200 && lit.iter().all(|e| (e - 2.0).abs() < 1e-4), "{lit:?}");
}

#[test]
fn the_sun_does_not_leak_below_a_wall_into_the_texels_of_a_dark_room() {
    for wall in [2.03, 2.2] {
        let mut data = SceneData::new();
        let m = data.add_material(Material { albedo: [0.5; 3], two_sided: true, ..Default::default() }).unwrap();
        let mut builder = MeshBuilder::new();
        let p = Vec3::new;
        builder.quad(p(0.0, 0.0, 0.0), p(4.0, 0.0, 0.0), p(4.0, 4.0, 0.0), p(0.0, 4.0, 0.0), m);
        builder.quad(p(wall, -9.0, 0.0), p(wall, 9.0, 0.0), p(wall, 9.0, 9.0), p(wall, -9.0, 9.0), m);
        data.add_mesh(builder.finish()).unwrap();
        let (direction, irradiance) = (p(-1.0, 0.0, -1.0).normalize(), [2.0; 3]);
        data.add_light(Light::Directional { direction, irradiance, angular_radius: 0.0 }).unwrap();
        let scene = data.committed();
        let mut map = created(&scene, 4.0);
        map.bake(&BakeParams { gather_rays: 0, ..Default::default() }, &Progress::none()).unwrap();
        let (atlas, light) = (map.atlas(), map.light.as_ref().unwrap());
        let mut lit = 0;
        for (t, e) in atlas.map.texels.samples.iter().zip(&light.direct) {
            let at = t.position(&scene);
            if scene.normal(t.triangle).z > 0.9 {
                let expected = if at.x > wall { std::f32::consts::SQRT_2 } else { 0.0 };
                assert!((e.x - expected).abs() < 1e-4, "{} at {at}, wall at {wall}", e.x);
                lit += (expected > 0.0) as u32;
            }
        }
        assert!(lit > 100);
    }
}

#[test]
fn the_radiance_map_has_the_energy_of_a_patch_of_sun_smaller_than_its_texels() {
    for (edge, angular_radius) in [(1.63, 0.0), (2.11, 0.0), (2.38, 0.0), (2.11, 0.004)] {
        let scene = under_a_roof(edge, 0.1, angular_radius);
        let map = created(&scene, 10.0);
        let atlas = map.atlas();
        let direct = DirectLight::new(&scene);
        let light =
            TexelLight { areas: atlas.areas(&atlas.radiance), direct: &direct, samples: 4, seed: 5, sky_from: None };
        let input =
            crate::lightmap::indirect::radiance_map::RadianceInput { light, photons: None, quick: false, anew: None };
        let mut values = vec![Vec3::ZERO; atlas.radiance.len()];
        let progress = Progress::none();
        let stage = progress.stage("radiance", 0.0, 1.0, 1);
        crate::lightmap::indirect::radiance_map::bake(scene.device(), &input, 0..values.len(), &mut values, &stage)
            .unwrap();
        // Texels are 0.4 wide, and 10 of them have the floor's width. Per metre of the slit:
        let on_floor = |s: &usize| atlas.radiance.texels.samples[*s].position(&scene).z.abs() < 0.5;
        let sum: f32 = (0..values.len()).filter(on_floor).map(|s| values[s].x * 0.16).sum();
        let energy = sum * std::f32::consts::PI / 0.5 / 4.0;
        assert!((energy / (2.0 * 0.1) - 1.0).abs() < 0.03, "{energy} instead of 0.2, edge {edge}");
    }
}

/// Texels of the floor of a box with two blocks on it, of which strips look out from under the blocks.
#[test]
fn what_lies_under_a_block_does_not_darken_texels_beside_it() {
    let scene = builtin("cornell").unwrap().committed();
    let lightmap = created(&scene, 40.0);
    let atlas = lightmap.atlas();
    let direct = DirectLight::new(&scene);
    let light =
        TexelLight { areas: atlas.areas(&atlas.radiance), direct: &direct, samples: 16, seed: 3, sky_from: None };
    let (mut dark, mut lit) = (0, 0);
    for texel in atlas.radiance.all() {
        let (point, receiver) = atlas.radiance.receiver(&scene, texel, false);
        if point.position.y > 0.01 {
            continue;
        }
        let own = direct.irradiance(&receiver, 16, 5, &mut 0);
        let mut tile = TilePoints::new(1).unwrap();
        light.first_look(&[texel], &mut tile, &mut 0, |_, look| {
            if own.x > 0.1 && look.irradiance.x < 0.2 * own.x {
                dark += 1;
            }
            lit += u32::from(own.x > 0.1);
        });
    }
    assert!(lit > 1000 && dark == 0, "{dark} of {lit}");
}

#[test]
fn a_wall_that_reaches_into_floor_and_ceiling_has_no_dark_line_at_its_foot() {
    let scene = builtin("partition").unwrap().committed();
    let mut map = created(&scene, 40.0);
    map.bake(&BakeParams { gather_rays: 0, ..Default::default() }, &Progress::none()).unwrap();
    let (atlas, light) = (map.atlas(), map.light.as_ref().unwrap());
    let (mut beside, mut away, mut on_wall) = ([0.0, 0.0], [0.0, 0.0], 0);
    for (t, e) in atlas.map.texels.samples.iter().zip(&light.direct) {
        let (at, normal) = (t.position(&scene), t.geometric_normal(&scene));
        if normal.x < -0.9 && (at.x - 2.99).abs() < 1e-3 {
            // What lies outside of the room takes its light from what can be seen.
            assert!(at.min_element() > -1e-4 && at.y < 2.6001, "{at}");
            on_wall += 1;
        }
        if normal.y > 0.9 && at.y.abs() < 1e-3 && at.x < 2.99 && at.z > 0.2 && at.z < 3.4 {
            let sum = if at.x > 2.965 { &mut beside } else { &mut away };
            if at.x > 2.89 {
                *sum = [sum[0] + e.x, sum[1] + 1.0];
            }
        }
    }
    assert!(on_wall > 1000 && beside[1] > 100.0 && away[1] > 100.0, "{on_wall}, {beside:?}, {away:?}");
    let ratio = beside[0] / beside[1] / (away[0] / away[1]);
    assert!((0.96..1.01).contains(&ratio), "{ratio}");
}

/// A floor of 2 x 2 under lamps. If `block`, a block stands on it where x > 1.
fn under_lamps(positions: &[Vec3], block: bool) -> Arc<Scene> {
    let mut data = SceneData::new();
    let m = data.add_material(Material { albedo: [0.5; 3], ..Default::default() }).unwrap();
    let mut builder = MeshBuilder::new();
    builder.quad(Vec3::ZERO, Vec3::X * 2.0, Vec3::new(2.0, 2.0, 0.0), Vec3::Y * 2.0, m);
    data.add_mesh(builder.finish()).unwrap();
    if block {
        let mut builder = MeshBuilder::new();
        builder.box_(Vec3::new(1.0, -0.5, -0.1), Vec3::new(2.5, 2.5, 0.6), false, m);
        data.add_mesh(builder.finish()).unwrap();
    }
    for &position in positions {
        data.add_light(Light::Point { position, intensity: [1.0; 3] }).unwrap();
    }
    data.committed()
}

/// The light of the floor up to x = `edge` by a map's texels.
fn light_of_floor<M: Map>(atlas: &Atlas, map: &ChartMap<M>, edge: f32, light: &[f32]) -> f64 {
    const N: u32 = 2000;
    let step = |i: u32, of: f32| of * (i as f32 + 0.5) / N as f32;
    let mut sum = 0.0;
    for (i, k) in (0..N).flat_map(|i| (0..N).map(move |k| (i, k))) {
        let (x, y) = (step(i, edge) / 2.0, step(k, 2.0) / 2.0);
        // The floor is made of the triangles (0, 1, 2) and (0, 2, 3) of its corners.
        let (triangle, u, v) = if x > y { (0, x - y, y) } else { (1, x, y - x) };
        let placement = PlacementId::new(atlas.charts.chart_of(triangle).index());
        let [s, t] = map.layout.texel_coord(placement, atlas.charts.local(triangle, u, v));
        let texel = map.at(placement, s as i32, t as i32).expect("a texel of the floor");
        sum += f64::from(light[texel.index()]);
    }
    sum * f64::from(edge) * 2.0 / f64::from(N * N)
}

/// Half of the light of a lamp close to a surface falls on a spot that is much smaller than a texel.
#[test]
fn texels_have_the_energy_of_lamps_close_to_them() {
    let one = |x, y, height| vec![Vec3::new(x, y, height)];
    // Many enough to be sampled by a tree.
    let many = (0..100).map(|i| Vec3::new(0.107 + 0.2 * (i % 10) as f32, 0.093 + 0.2 * (i / 10) as f32, 0.005));
    let mut cases = vec![(many.collect(), false)];
    for height in [0.1, 0.03, 0.01, 1e-3, 1e-4] {
        cases.extend([(one(1.03, 0.97, height), false), (one(0.5612, 1.274, height), false)]);
        // A part of the texels around the lamp lies under the block.
        cases.push((one(0.985, 1.03, height), true));
    }
    for (lamps, block) in cases {
        let scene = under_lamps(&lamps, block);
        let mut map = created(&scene, 20.0);
        map.bake(&BakeParams { gather_rays: 0, ..Default::default() }, &Progress::none()).unwrap();
        let atlas = map.atlas();
        let edge = if block { 1.0 } else { 2.0 };
        let light: Vec<f32> = map.light.as_ref().unwrap().direct.iter().map(|e| e.x).collect();
        let of_map = light_of_floor(atlas, &atlas.map, edge, &light);
        let direct = DirectLight::new(&scene);
        let light =
            TexelLight { areas: atlas.areas(&atlas.radiance), direct: &direct, samples: 4, seed: 5, sky_from: None };
        let mut tile = TilePoints::new(1).unwrap();
        let mut looks = vec![0.0; atlas.radiance.len()];
        for texel in atlas.radiance.all() {
            light.closer_look(
                &[texel],
                &mut tile,
                |_| Vec3::ONE,
                &mut 0,
                |_, e| {
                    looks[texel.index()] = e.unwrap_or_default().x;
                },
            );
        }
        let of_radiance = light_of_floor(atlas, &atlas.radiance, edge, &looks);
        // The solid angles of the floor's four parts around the foot of each lamp.
        let floor = |lamp: &Vec3| {
            let Vec3 { x, y, z } = *lamp;
            let part = |x: f32, y: f32| (x * y).atan2(z * (x * x + y * y + z * z).sqrt());
            f64::from(part(x, y) + part(edge - x, y) + part(x, 2.0 - y) + part(edge - x, 2.0 - y))
        };
        let expected: f64 = lamps.iter().map(floor).sum();
        for (sum, what, bound) in [(of_map, "light map", 0.02), (of_radiance, "radiance map", 0.02)] {
            let part = sum / expected;
            assert!((part - 1.0).abs() < bound, "{part} in the {what}, lamp at {}, block: {block}", lamps[0]);
        }
    }
}
