//! Shading of surfaces with normal maps from a light map with light by direction.
//!
//! For a normal m, at an angle α from the surface's normal n, irradiance is an integral over the half above the surface
//! less the part of it that is behind m. Over all of the half it is ∫ L ω dω · m, known exactly from E and L1. The part behind m
//! is a wedge at the horizon, opposite to the tilt, whose light is taken from the linear radiance a + b · ω with the
//! given E, L0 and L1 (clamped there to ≥ 0), times (1 − cos α) / 2, which is what a wedge of uniform light sends. Where
//! |L1| is more than half of L0, more than under a uniform sky, light comes from few directions, which are hardly in the
//! wedge, and its part vanishes as |L1| nears L0.
//!
//! Exact for light from one direction in front of m and for a uniform sky, and E itself for m = n. Plain SH L1,
//! π (L0 + 2 L1 · m), is neither; nor is the curve of Geomerics (Sloan and others, *Improved spherical harmonics
//! irradiance*, Enlighten 2015). Measured: docs/accuracy.md#normal-maps.

use glam::Vec3;
use std::f32::consts::PI;

/// Returns the irradiance for a unit normal `mapped` of a normal map, W/m², for surfaces with the unit normal `normal`.
/// `irradiance`: that of the light map, of the light that was asked for by direction; `l0`, `l1`:
/// [`Layer::L0`](super::Layer::L0) and [`Layer::L1X`](super::Layer::L1X) to `L1Z`. (The shader in docs/guide.md does the same.)
pub fn irradiance_on(irradiance: Vec3, l0: Vec3, l1: [Vec3; 3], normal: Vec3, mapped: Vec3) -> Vec3 {
    let cosine = normal.dot(mapped);
    let tilt = mapped - cosine * normal;
    let side = 4.0 * PI * (tilt.x * l1[0] + tilt.y * l1[1] + tilt.z * l1[2]);
    let in_front = (cosine * irradiance + side).max(Vec3::ZERO);
    let length = (l1[0] * l1[0] + l1[1] * l1[1] + l1[2] * l1[2]).map(f32::sqrt);
    let spread = (2.0 - 2.0 * length / l0.max(Vec3::splat(1e-12))).clamp(Vec3::ZERO, Vec3::ONE);
    let opposite = 8.0 * PI * l0 - 3.0 * irradiance - 1.5 * side / tilt.length().max(1e-4);
    in_front + 0.5 * (1.0 - cosine) * spread * opposite.max(Vec3::ZERO)
}

#[cfg(test)]
mod tests {
    use super::super::{BakeParams, Layer, LayerData, Lightmap, LightmapDesc, TexelState, directional};
    use super::*;
    use crate::base::directional::Directional;
    use crate::base::progress::Progress;
    use crate::base::sampling::{uniform, uniform_sphere};
    use crate::bvh::BuildOptions;
    use crate::device::{Device, DeviceOptions};
    use crate::scene::shapes::MeshBuilder;
    use crate::scene::{Light, Material, NONE, Scene, SceneData, builtin};
    use crate::simd::Isa;

    const ALL: u32 = directional::INDIRECT | directional::DIRECT;

    /// A white or grey floor of 2 × 2 under some lights.
    fn floor(lights: &[Light]) -> Lightmap {
        let mut data = SceneData::new();
        let m = data.add_material(Material { albedo: [0.5; 3], ..Default::default() }).unwrap();
        let mut builder = MeshBuilder::new();
        let p = |x: f32, y: f32| Vec3::new(x, y, 0.0);
        builder.quad(p(-1.0, -1.0), p(1.0, -1.0), p(1.0, 1.0), p(-1.0, 1.0), m);
        data.add_mesh(builder.finish()).unwrap();
        for &light in lights {
            data.add_light(light).unwrap();
        }
        let desc = LightmapDesc { texels_per_unit: 4.0, page_size: 64, ..Default::default() };
        let mut map = Lightmap::create(&data.committed(), &desc, &Progress::none()).unwrap();
        let params = BakeParams { photon_count: 1000, direct_samples: 1024, directional: ALL, ..Default::default() };
        map.bake(&params, &Progress::none()).unwrap();
        map
    }

    fn sun(to_light: Vec3, irradiance: f32, angular_radius: f32) -> Light {
        Light::Directional { direction: -to_light.normalize(), irradiance: [irradiance; 3], angular_radius }
    }

    /// Irradiance and light by direction of all texels, which must be alike.
    fn of_all(map: &Lightmap, tolerance: f32) -> (Vec3, Directional) {
        let light = map.light.as_ref().unwrap();
        let first = light.directional[0];
        for d in &light.directional {
            let parts = |d: &Directional| [d.l0, d.l1[0], d.l1[1], d.l1[2]];
            let differ = parts(d).iter().zip(parts(&first)).any(|(a, b)| !a.abs_diff_eq(b, tolerance * first.l0.x));
            assert!(!differ, "{d:?} {first:?}");
            assert!(d.is_possible());
        }
        (light.direct[0] + light.indirect[0], first)
    }

    #[test]
    fn a_distant_light_is_where_l1_points_and_shades_any_normal_exactly() {
        for (to_light, radius) in [(Vec3::new(1.0, 0.5, 2.0), 0.0), (Vec3::new(-1.0, 1.0, 0.8), 0.005)] {
            let (e, d) = of_all(&floor(&[sun(to_light, 3.0, radius)]), 1e-2);
            let w = to_light.normalize();
            let ratio = Vec3::from(d.l1.map(|x| x.x / d.l0.x));
            assert!(ratio.abs_diff_eq(w, 1e-3), "{ratio} {w}");
            assert!((e.x - 3.0 * w.z).abs() < 1e-3 && (4.0 * PI * d.l1[2].x / e.x - 1.0).abs() < 1e-3);
            for i in 0..50 {
                let m = (Vec3::Z + 0.5 * uniform_sphere([uniform(i, 0, 1), uniform(i, 1, 1)])).normalize();
                let shaded = irradiance_on(e, d.l0, d.l1, Vec3::Z, m).x;
                assert!((shaded - 3.0 * w.dot(m).max(0.0)).abs() < 0.01, "{shaded}, not {}", 3.0 * w.dot(m));
            }
        }
    }

    #[test]
    fn under_a_uniform_sky_l1_is_half_of_l0_along_the_normal() {
        let sky = Light::Sky { radiance: [2.0; 3], environment: NONE, up: Vec3::Z, rotation: 0.0 };
        let (e, d) = of_all(&floor(&[sky]), 0.05);
        // Directions at the horizon count less: (2 − 0.1) / 2 of L0.
        assert!((d.l0.x - 1.0).abs() < 0.06, "{}", d.l0);
        assert!((d.l1[2].x - 0.5).abs() < 0.01 && d.l1[0].x.abs().max(d.l1[1].x.abs()) < 0.02, "{:?}", d.l1);
        for angle in [0.0f32, 0.3, 0.6] {
            let shaded = irradiance_on(e, d.l0, d.l1, Vec3::Z, Vec3::new(angle.sin(), 0.0, angle.cos())).x;
            let expected = PI * (1.0 + angle.cos());
            assert!((shaded / expected - 1.0).abs() < 0.03, "{shaded}, not {expected}");
        }
    }

    #[test]
    fn lights_on_two_sides_cancel_and_add() {
        let (a, b) = (Vec3::new(1.0, 0.0, 1.0), Vec3::new(-1.0, 0.0, 1.0));
        let (e, d) = of_all(&floor(&[sun(a, 1.0, 0.0), sun(b, 1.0, 0.0)]), 1e-4);
        assert!(d.l1[0].abs().max_element() < 1e-6 && (4.0 * PI * d.l1[2].x - e.x).abs() < 1e-4);
        assert!((4.0 * PI * d.l0.x - 2.0).abs() < 1e-4);
        let (_, one) = of_all(&floor(&[sun(a, 1.0, 0.0)]), 1e-4);
        assert!((one.l0 * 2.0 - d.l0).abs().max_element() < 1e-6);
    }

    #[test]
    fn what_is_summed_with_weights_stays_valid_and_what_is_not_is_made_valid() {
        let random = |i: u32, k: u32| {
            let u = |j| uniform(i, 4 * k + j, 3);
            let direction = uniform_sphere([u(0), u(1)]);
            Directional::of(Vec3::new(u(2), u(3), 1.0), direction, direction.z.abs()) * (10.0 * u(2))
        };
        for i in 0..500 {
            let all: Vec<Directional> = (0..8).map(|k| random(i, k)).collect();
            let mut sum = Directional::default();
            all.iter().enumerate().for_each(|(k, d)| sum += *d * uniform(i, 40 + k as u32, 3));
            assert!(
                sum.is_possible() && (sum / 7.0).is_possible() && sum.scaled(Vec3::new(0.1, 0.0, 3.0)).is_possible()
            );
            // As stitching may leave it.
            let off = all[0] + all[1] * -uniform(i, 60, 3);
            let valid = off.valid();
            assert!(valid.is_possible(), "{off:?} {valid:?}");
            assert!(!off.is_possible() || (valid.l0 - off.l0).abs().max_element() == 0.0);
        }
        assert_eq!(Directional::default().valid(), Directional::default());
    }

    /// Bits of all layers of light by direction, and of the irradiance.
    fn bits(map: &Lightmap) -> Vec<u32> {
        let layers = [Layer::Combined, Layer::L0, Layer::L1X, Layer::L1Y, Layer::L1Z, Layer::RatioX, Layer::Direction];
        let page = |layer| match map.read(0, layer).unwrap() {
            LayerData::Rgb(v) => v.into_iter().flatten().map(f32::to_bits).collect::<Vec<u32>>(),
            _ => panic!("not light"),
        };
        layers.into_iter().flat_map(page).collect()
    }

    fn cornell(threads: usize, isa: Isa) -> Lightmap {
        let device = Device::new(DeviceOptions { num_threads: threads, isa: Some(isa), ..Default::default() }).unwrap();
        let (data, options) = (builtin("cornell").unwrap(), BuildOptions::default());
        let scene = Scene::commit(&device, data, &options, &Progress::none()).map_err(|(_, e)| e).unwrap();
        let desc = LightmapDesc { texels_per_unit: 10.0, page_size: 128, ..Default::default() };
        Lightmap::create(&scene, &desc, &Progress::none()).unwrap()
    }

    const PARAMS: BakeParams = BakeParams {
        photon_count: 20_000,
        max_bounces: 0,
        gather_rays: 64,
        radius: 0.0,
        near_hits: 1.0,
        interpolation_error: 1.0,
        interpolation_contrast: 0.15,
        own_rays: 0,
        blur_radius: 2,
        direct_samples: 16,
        seed: 3,
        memory_budget: 0,
        texel_begin: 0,
        texel_end: 0,
        stitch: true,
        directional: ALL,
        passes: 1,
        target_error: 0.0,
    };

    #[test]
    fn light_by_direction_has_the_same_bits_on_any_threads_and_shards_and_leaves_the_irradiance_as_it_is() {
        let isa = Isa::best();
        let mut whole = cornell(2, isa);
        whole.bake(&PARAMS, &Progress::none()).unwrap();
        let light = whole.light.as_ref().unwrap();
        assert!(light.directional.iter().all(Directional::is_possible));
        assert!(light.state.contains(&TexelState::Visible));
        let mut shards = cornell(1, isa);
        let n = shards.info().texels;
        for range in [[0, n / 3], [n / 3, n / 2], [n / 2, n]] {
            let params = BakeParams { texel_begin: range[0], texel_end: range[1], ..PARAMS };
            shards.bake(&params, &Progress::none()).unwrap();
        }
        assert!(bits(&whole) == bits(&shards));
        let mut without = cornell(2, isa);
        without.bake(&BakeParams { directional: 0, ..PARAMS }, &Progress::none()).unwrap();
        let irradiance = |map: &Lightmap| {
            let light = map.light.as_ref().unwrap();
            (light.direct.clone(), light.indirect.clone())
        };
        assert!(irradiance(&whole) == irradiance(&without));
        assert!(without.light.as_ref().unwrap().directional.is_empty());
        assert!(without.read(0, Layer::L0).is_err() && without.plan_text().contains("left out: light by direction"));
        for other in Isa::ALL.into_iter().filter(|i| i.is_available() && i.is_fused() && *i != isa) {
            let mut map = cornell(2, other);
            map.bake(&PARAMS, &Progress::none()).unwrap();
            assert!(bits(&whole) == bits(&map), "{other:?}");
        }
    }

    #[test]
    fn l1_along_the_normal_is_the_irradiance() {
        let mut map = cornell(0, Isa::best());
        map.bake(&BakeParams { stitch: false, ..PARAMS }, &Progress::none()).unwrap();
        let light = map.light.as_ref().unwrap();
        let atlas = map.atlas();
        let (mut worst, mut sum, mut count) = (0f32, 0.0, 0.0);
        for (texel, d) in atlas.map.all().zip(&light.directional) {
            let n = atlas.receiver(&atlas.map, &light.backs, texel).normal;
            let e = light.direct[texel.index()] + light.indirect[texel.index()];
            let along = 4.0 * PI * (n.x * d.l1[0] + n.y * d.l1[1] + n.z * d.l1[2]);
            if e.min_element() > 0.0 {
                worst = worst.max((along / e - 1.0).abs().max_element());
                sum += (along / e).element_sum() / 3.0;
                count += 1.0;
            }
        }
        // What comes from the horizon counts less.
        let mean = sum / count;
        assert!(count > 400.0 && (mean - 1.0).abs() < 0.01 && worst < 0.2, "{mean} {worst}");
    }

    #[test]
    fn results_and_checkpoints_hold_light_by_direction() {
        let folder = std::env::temp_dir();
        let file = |name: &str| folder.join(format!("bakelite-directional-{name}-{}", std::process::id()));
        let (result, checkpoint) = (file("result"), file("checkpoint"));
        let mut map = cornell(2, Isa::best());
        map.bake(&PARAMS, &Progress::none()).unwrap();
        map.save_result(&result, &Progress::none()).unwrap();
        let mut loaded = cornell(1, Isa::best());
        loaded.load_result(&result, &Progress::none()).unwrap();
        assert!(bits(&map) == bits(&loaded));
        let at =
            crate::lightmap::CheckpointParams { seconds: 0.0, ..crate::lightmap::CheckpointParams::new(&checkpoint) };
        // Cancelled in every stage that keeps something.
        for part in [0.4, 0.62, 0.8, 0.99, 2.0] {
            let mut again = cornell(2, Isa::best());
            let progress = Progress::new(|f, _| f < part);
            let done = again.bake_with(&PARAMS, Some(&at), &progress);
            assert!(done.is_ok() || part < 1.0, "{done:?}");
            assert!(done.is_err() || bits(&map) == bits(&again), "{part}");
        }
        let mut other = cornell(2, Isa::best());
        let params = BakeParams { directional: directional::DIRECT, ..PARAMS };
        let refused = other.bake_with(&params, Some(&at), &Progress::none()).unwrap_err();
        assert!(refused.to_string().contains("directional (3, here 2)"), "{refused}");
        [result, checkpoint].iter().for_each(|f| drop(std::fs::remove_file(f)));
    }
}
