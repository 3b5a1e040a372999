//! How much surface there is in the disc of an irradiance estimate.
//!
//! The estimate divides the power in a disc by the disc's area. Where part of the disc lies beside the
//! surface – along every edge and in every corner – that is too dark, to half at an edge and to a
//! quarter in the corner of a box. So short rays along the normal probe the cylinder of the estimate for what
//! the estimate accepts: surfaces that face as its own. The part of them that meet some, weighted by the filter,
//! is the part of the disc that photons could lie on, by which the estimate is to be divided (Jensen 2001,
//! section 7.5, and Hey and Purgathofer, *Advanced Radiance Estimation for Photon Map Global Illumination*,
//! 2002, divide by the area of the surfaces in the same spirit). Where all of the disc is covered that is
//! exactly 1. (Pieces of all surfaces in a grid of their own, summed as photons are, left more bias in a furnished
//! room – 1.4 % of the median point instead of 0.5 % – and were three times as many there as photons.)

use super::PhotonMap;
use super::estimate::SAME_SURFACE;
use crate::sampling::{concentric_disc, orthonormal_basis, sobol_2d};
use crate::scene::Scene;
use crate::trace::Ray;
use crate::trace::offset::offset_ray_origin;
use glam::Vec3;

/// Estimates are raised by a factor of four at most, as the corner of a box needs: on scraps of surface that
/// hardly any photon hits, more would make single photons shine.
const LEAST: f32 = 0.25;

/// Probes of a disc.
const PROBES: u32 = 32;

/// If these of them all meet surface, so do the others, it is supposed: at most points there is no edge nearby.
const FIRST: u32 = 8;

/// What the estimate of `map` at a point is to be divided by, in [1/4, 1]. `is_buried` tells of a point that rays
/// may start from, and its normal, that no light gets there. Counts the probes in `rays`, not what that takes.
pub(crate) fn coverage(
    map: &PhotonMap,
    position: Vec3,
    normal: Vec3,
    seed: u32,
    is_buried: impl Fn(Vec3, Vec3) -> bool,
    rays: &mut u64,
) -> f32 {
    let scene = map.scene();
    let (radius, height) = (map.cylinder.radius, map.cylinder.radius * map.cylinder.half_height);
    let (x, y) = orthonormal_basis(normal);
    let (mut covered, mut all) = (0.0, 0.0);
    for i in 0..PROBES {
        if i == FIRST && covered == all {
            return 1.0;
        }
        let d = glam::Vec2::from(concentric_disc(sobol_2d(i, seed)));
        let weight = map.cylinder.filter(d.length());
        all += weight;
        *rays += 1;
        let surface = probe(scene, position + radius * (d.x * x + d.y * y), normal, height);
        if surface.is_some_and(|(point, facing)| !is_buried(offset_ray_origin(point, facing, scene), facing)) {
            covered += weight;
        }
    }
    (covered / all).max(LEAST)
}

/// The surface that faces as `normal` within `height` of a point along it, and its normal on that side.
fn probe(scene: &Scene, position: Vec3, normal: Vec3, height: f32) -> Option<(Vec3, Vec3)> {
    let ray = Ray { tmax: 2.0 * height, ..Ray::new(position + height * normal, -normal) };
    let hit = scene.intersect_raw(&ray);
    if hit.is_miss() || !(hit.front || scene.material(hit.triangle).two_sided) {
        return None;
    }
    let facing = if hit.front { scene.normal(hit.triangle) } else { -scene.normal(hit.triangle) };
    (facing.dot(normal) >= SAME_SURFACE).then(|| (position + (height - hit.t) * normal, facing))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bvh::BuildOptions;
    use crate::device::{Device, DeviceOptions};
    use crate::photon::PhotonParams;
    use crate::progress::Progress;
    use crate::scene::shapes::MeshBuilder;
    use crate::scene::{Light, Material, Scene, SceneData};

    #[test]
    fn edges_and_corners_of_a_square_get_their_light_back() {
        let device = Device::new(DeviceOptions { num_threads: 1, ..Default::default() }).unwrap();
        let mut data = SceneData::new();
        let m = data.add_material(Material::default()).unwrap();
        let mut builder = MeshBuilder::new();
        let p = |x: f32, y: f32| Vec3::new(x, y, 0.0);
        builder.quad(p(0.0, 0.0), p(1.0, 0.0), p(1.0, 1.0), p(0.0, 1.0), m);
        data.add_mesh(builder.finish()).unwrap();
        data.add_light(Light::Directional { direction: -Vec3::Z, irradiance: [2.0; 3], angular_radius: 0.0 }).unwrap();
        let scene = Scene::commit(&device, data, &BuildOptions::default(), &Progress::none()).map_err(|e| e.1).unwrap();
        let params = PhotonParams { photon_count: 1 << 18, radius: 0.1, ..Default::default() };
        let map = PhotonMap::trace(&scene, &params, &Progress::none()).unwrap();
        let of = |position, normal, seed| coverage(&map, position, normal, seed, |_, _| false, &mut 0);
        for (x, y, part) in [(0.5, 0.5, 1.0), (0.0, 0.4, 0.5), (1.0, 0.0, 0.25)] {
            let seeds = 64;
            let found = (0..seeds).map(|s| of(p(x, y), Vec3::Z, s)).sum::<f32>() / seeds as f32;
            let e = map.estimate(p(x, y), Vec3::Z)[0];
            assert!((found / part - 1.0).abs() < 0.05, "{x} {y}: {found}");
            assert!((e / found / 2.0 - 1.0).abs() < 0.05, "{x} {y}: {e} by {found}");
        }
        // Surfaces that face elsewhere do not count, nor do those that no light gets to.
        assert_eq!(of(p(0.5, 0.5), Vec3::X, 0), LEAST);
        assert_eq!(of(p(0.5, 0.5), -Vec3::Z, 0), LEAST);
        assert_eq!(coverage(&map, p(0.5, 0.5), Vec3::Z, 0, |_, _| true, &mut 0), LEAST);
    }
}
