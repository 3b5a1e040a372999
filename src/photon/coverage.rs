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
use crate::trace::solids::is_buried;
use glam::{Vec2, Vec3};

/// Estimates are raised by a factor of four at most, as the corner of a box needs: on scraps of surface that
/// hardly any photon hits, more would make single photons shine.
const LEAST: f32 = 0.25;

/// Probes of a disc.
const PROBES: u32 = 32;

/// If these of them all meet surface, so do the others, it is supposed: at most points there is no edge nearby.
const FIRST: u32 = 8;

/// What the estimate of `map` at a point is to be divided by, in [1/4, 1]. Counts the rays that takes.
pub(crate) fn coverage(map: &PhotonMap, position: Vec3, normal: Vec3, seed: u32, rays: &mut u64) -> f32 {
    let scene = map.scene();
    let (radius, height) = (map.cylinder.radius, map.cylinder.radius * map.cylinder.half_height);
    let (x, y) = orthonormal_basis(normal);
    let (mut covered, mut all) = (0.0, 0.0);
    for i in 0..PROBES {
        if i == FIRST && covered == all {
            return 1.0;
        }
        let d = Vec2::from(concentric_disc(sobol_2d(i, seed)));
        let weight = map.cylinder.filter(d.length());
        all += weight;
        *rays += 1;
        let surface = probe(scene, position + radius * (d.x * x + d.y * y), normal, height);
        let gets_light = |(point, facing)| !is_buried(scene, offset_ray_origin(point, facing, scene), facing, rays);
        if surface.is_some_and(gets_light) {
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
    use crate::photon::PhotonParams;
    use crate::photon::tests::commit;
    use crate::progress::Progress;
    use crate::scene::shapes::MeshBuilder;
    use crate::scene::{Light, Material, SceneData};

    /// Photons with a search radius of 0.1 on a square below a light that gives it 2 W/m², and on what `add` puts there.
    fn square(add: impl Fn(&mut MeshBuilder, u32)) -> PhotonMap {
        let mut data = SceneData::new();
        let m = data.add_material(Material { albedo: [0.0; 3], ..Default::default() }).unwrap();
        let mut builder = MeshBuilder::new();
        builder.quad(at(0.0, 0.0), at(1.0, 0.0), at(1.0, 1.0), at(0.0, 1.0), m);
        add(&mut builder, m);
        data.add_mesh(builder.finish()).unwrap();
        data.add_light(Light::Directional { direction: -Vec3::Z, irradiance: [2.0; 3], angular_radius: 0.0 }).unwrap();
        let params = PhotonParams { photon_count: 1 << 20, radius: 0.1, ..Default::default() };
        PhotonMap::trace(&commit(data), &params, &Progress::none()).unwrap()
    }

    fn at(x: f32, y: f32) -> Vec3 {
        Vec3::new(x, y, 0.0)
    }

    /// The mean over many seeds.
    fn mean_coverage(map: &PhotonMap, position: Vec3, normal: Vec3) -> f32 {
        let seeds = 64;
        (0..seeds).map(|s| coverage(map, position, normal, s, &mut 0)).sum::<f32>() / seeds as f32
    }

    #[test]
    fn edges_and_corners_of_a_square_get_their_light_back() {
        let map = square(|_, _| ());
        assert_eq!(mean_coverage(&map, at(0.5, 0.5), Vec3::Z), 1.0);
        // In the corner, what is found less than a quarter by chance counts as a quarter: 2.5% too much.
        for (x, y, part, tolerance) in [(0.5, 0.5, 1.0, 1e-3), (0.0, 0.4, 0.5, 1e-3), (1.0, 0.0, 0.25, 0.05)] {
            let found = mean_coverage(&map, at(x, y), Vec3::Z);
            let e = map.estimate(at(x, y), Vec3::Z)[0] / found / 2.0;
            assert!((found / part - 1.0).abs() < tolerance, "{x} {y}: {found}");
            assert!((e - 1.0).abs() < tolerance, "{x} {y}: {e}");
        }
        // Surfaces that face elsewhere do not count.
        assert_eq!(mean_coverage(&map, at(0.5, 0.5), Vec3::X), LEAST);
        assert_eq!(mean_coverage(&map, at(0.5, 0.5), -Vec3::Z), LEAST);
    }

    #[test]
    fn what_lies_below_a_box_gets_no_light_and_does_not_count() {
        let map = square(|b, m| b.box_(Vec3::new(0.5, -0.1, -0.1), Vec3::new(1.1, 1.1, 0.1), false, m));
        let (beside, mut rays) = (at(0.5, 0.5), 0);
        let found = mean_coverage(&map, beside, Vec3::Z);
        let e = map.estimate(beside, Vec3::Z)[0] / found / 2.0;
        assert!((found / 0.5 - 1.0).abs() < 1e-3, "{found}");
        assert!((e - 1.0).abs() < 1e-3, "{e}");
        assert_eq!(mean_coverage(&map, at(0.8, 0.5), Vec3::Z), LEAST);
        // Each probe that meets the square costs a ray, and each below the box five.
        coverage(&map, at(0.8, 0.5), Vec3::Z, 0, &mut rays);
        assert_eq!(rays, 6 * u64::from(PROBES));
    }
}
