//! Visible part of the disc of an irradiance estimate.
//!
//! The estimate divides the power of all photons in a disc by the disc's area. Where part of the disc lies beside the
//! surface – along every edge and in every corner – that is too dark, to half at an edge and to a quarter in the corner
//! of a box. And where the disc reaches through a wall, light of the other room comes in. So short rays probe the disc:
//! those along the normal find where the surface continues; others test whether the surface points they find, and the
//! photons themselves, are visible from above the disc's centre. The estimate is multiplied by the part of its light
//! that comes from visible photons, and divided by the part of the disc, weighted by the filter, where surface is
//! visible (Jensen 2001, section 7.5, and Hey and Purgathofer, *Advanced Radiance Estimation for Photon Map Global
//! Illumination*, 2002, divide by the area of the surfaces in the same spirit). Where all of the disc is visible both
//! are exactly 1. (Pieces of all surfaces in a grid of their own, summed as photons are, left more bias in a furnished
//! room – 1.4 % of the median point instead of 0.5 % – and were three times as many there as photons.)

use super::PhotonMap;
use super::cylinder::SAME_SURFACE;
use crate::sampling::{concentric_disc, orthonormal_basis, sobol_2d};
use crate::trace::Ray;
use crate::trace::offset::offset_ray_origin;
use glam::{Vec2, Vec3};

/// Minimum of the visible part of a disc: estimates are raised by a factor of four at most, as the corner of a box
/// needs. On scraps of surface that hardly any photon hits, more would make single photons shine.
const LEAST: f32 = 0.25;

/// Maximum number of probes of a disc, and of photons tested. If there are no more photons, the visible part of their
/// light is exact. (16 or 64, or twice [`FIRST`]: the living room 0.125 to 0.126, Sponza by two lamps 9.4e-3 to 1.1e-2,
/// in the sun 5.2e-2 to 5.9e-2 with four seeds, in no order.)
const PROBES: u32 = 32;

/// Number of first tests after which, if all were visible, the rest are assumed to be visible too: at most points there
/// is no edge nearby. Of a part p that is hidden, p (1 − p)⁸ escapes notice in the mean, 4 % at most.
const FIRST: u32 = 8;

/// Irradiance at a point from the photons and the surface that are visible from it. Adds the rays traced to `rays`.
pub(crate) fn irradiance(map: &PhotonMap, position: Vec3, normal: Vec3, seed: u32, rays: &mut u64) -> Vec3 {
    let estimate = Vec3::from(map.estimate(position, normal));
    if estimate == Vec3::ZERO {
        return estimate;
    }
    let disc = Disc::new(map, position, normal, rays);
    let light = disc.light(seed, rays);
    if light == Vec3::ZERO { light } else { estimate * light / disc.surface(seed, rays) }
}

struct Disc<'a> {
    map: &'a PhotonMap,
    position: Vec3,
    normal: Vec3,
    /// Point above the position, in the cylinder of the estimate, and in the same room.
    apex: Vec3,
    /// Height of the apex above the position.
    up: f32,
    /// Half the height of the cylinder.
    height: f32,
}

impl<'a> Disc<'a> {
    fn new(map: &'a PhotonMap, position: Vec3, normal: Vec3, rays: &mut u64) -> Self {
        let scene = map.scene();
        let height = (map.cylinder.radius * map.cylinder.half_height).min(scene.diagonal());
        let origin = offset_ray_origin(position, normal, scene);
        *rays += 1;
        let free = scene.intersect_raw(&Ray::new(origin, normal).within(0.0, 2.0 * height));
        let up = if free.is_miss() { height } else { 0.5 * free.t };
        Disc { map, position, normal, apex: position + up * normal, up, height }
    }

    /// The part of the disc, weighted by the filter, where surface is visible; in [1/4, 1].
    fn surface(&self, seed: u32, rays: &mut u64) -> f32 {
        let (x, y) = orthonormal_basis(self.normal);
        let (mut covered, mut all) = (0.0, 0.0);
        for i in 0..PROBES {
            if i == FIRST && covered == all {
                return 1.0;
            }
            let d = Vec2::from(concentric_disc(sobol_2d(i, seed)));
            let weight = self.map.cylinder.filter(d.length());
            all += weight;
            let above = self.apex + self.map.cylinder.radius * (d.x * x + d.y * y);
            if self.probe(above, rays).is_some_and(|(point, facing)| self.sees(point, facing, rays)) {
                covered += weight;
            }
        }
        (covered / all).max(LEAST)
    }

    /// The part of the photons' light that comes from visible photons, by channel.
    fn light(&self, seed: u32, rays: &mut u64) -> Vec3 {
        let (mut seen, mut all, mut looked_at, mut hidden) = (Vec3::ZERO, Vec3::ZERO, 0, 0);
        let (photons, cylinder) = (self.map.columns(), &self.map.cylinder);
        let vector = |columns: &[&[f32]; 3], i: usize| Vec3::new(columns[0][i], columns[1][i], columns[2][i]);
        let grid = &self.map.grid;
        grid.spread(&grid.search(self.position, self.normal, cylinder), seed, |i| {
            let Some(weight) = cylinder.weight(&photons, i, self.position, self.normal) else { return true };
            let power = weight * vector(&photons.power, i);
            all += power;
            looked_at += 1;
            if self.sees(vector(&photons.position, i), vector(&photons.normal, i), rays) {
                seen += power;
            } else {
                hidden += 1;
            }
            looked_at < if hidden == 0 { FIRST } else { PROBES }
        });
        if hidden == 0 { Vec3::ONE } else { seen / all.max(Vec3::splat(f32::MIN_POSITIVE)) }
    }

    /// Finds the surface below a point at the apex's height, if it faces as the normal does; returns the point and its
    /// normal on that side.
    fn probe(&self, above: Vec3, rays: &mut u64) -> Option<(Vec3, Vec3)> {
        let (scene, normal) = (self.map.scene(), self.normal);
        *rays += 1;
        let hit = scene.intersect_raw(&Ray::new(above, -normal).within(0.0, self.up + self.height));
        if hit.is_miss() || !(hit.front || scene.material(hit.triangle).two_sided) {
            return None;
        }
        let facing = if hit.front { scene.normal(hit.triangle) } else { -scene.normal(hit.triangle) };
        (facing.dot(normal) >= SAME_SURFACE).then(|| (above - hit.t * normal, facing))
    }

    /// Whether nothing lies between the apex and a surface point.
    fn sees(&self, point: Vec3, facing: Vec3, rays: &mut u64) -> bool {
        let origin = offset_ray_origin(point, facing, self.map.scene());
        *rays += 1;
        !self.map.scene().occluded(&Ray::new(origin, self.apex - origin).within(0.0, 1.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::photon::PhotonParams;
    use crate::progress::Progress;
    use crate::scene::shapes::MeshBuilder;
    use crate::scene::{Light, Material, SceneData};

    fn square(add: impl Fn(&mut MeshBuilder, u32)) -> PhotonMap {
        square_of(1 << 20, add)
    }

    /// Photons with a search radius of 0.1 on a square below a light that gives it 2 W/m², and on what `add` puts
    /// there.
    fn square_of(photon_count: u64, add: impl Fn(&mut MeshBuilder, u32)) -> PhotonMap {
        let mut data = SceneData::new();
        let m = data.add_material(Material { albedo: [0.0; 3], ..Default::default() }).unwrap();
        let mut builder = MeshBuilder::new();
        builder.quad(at(0.0, 0.0), at(1.0, 0.0), at(1.0, 1.0), at(0.0, 1.0), m);
        add(&mut builder, m);
        data.add_mesh(builder.finish()).unwrap();
        data.add_light(Light::Directional { direction: -Vec3::Z, irradiance: [2.0; 3], angular_radius: 0.0 }).unwrap();
        let params = PhotonParams { photon_count, radius: 0.1, ..Default::default() };
        PhotonMap::trace(&data.committed(), &params, &Progress::none()).unwrap()
    }

    fn at(x: f32, y: f32) -> Vec3 {
        Vec3::new(x, y, 0.0)
    }

    /// The mean over many seeds.
    fn mean_surface(map: &PhotonMap, position: Vec3, normal: Vec3) -> f32 {
        let (seeds, disc) = (64, Disc::new(map, position, normal, &mut 0));
        (0..seeds).map(|s| disc.surface(s, &mut 0)).sum::<f32>() / seeds as f32
    }

    #[test]
    fn edges_and_corners_of_a_square_get_their_light_back() {
        let map = square(|_, _| ());
        assert_eq!(mean_surface(&map, at(0.5, 0.5), Vec3::Z), 1.0);
        // In the corner, what is found less than a quarter by chance counts as a quarter: 2.5% too much.
        for (x, y, part, tolerance) in [(0.5, 0.5, 1.0, 1e-3), (0.0, 0.4, 0.5, 1e-3), (1.0, 0.0, 0.25, 0.05)] {
            let found = mean_surface(&map, at(x, y), Vec3::Z);
            let e = map.estimate(at(x, y), Vec3::Z)[0] / found / 2.0;
            assert!((found / part - 1.0).abs() < tolerance, "{x} {y}: {found}");
            assert!((e - 1.0).abs() < tolerance, "{x} {y}: {e}");
        }
        // Surfaces that face elsewhere do not count.
        assert_eq!(mean_surface(&map, at(0.5, 0.5), Vec3::X), LEAST);
        assert_eq!(mean_surface(&map, at(0.5, 0.5), -Vec3::Z), LEAST);
    }

    /// The mean over many seeds.
    fn mean_irradiance(map: &PhotonMap, position: Vec3) -> f32 {
        let seeds = 64;
        (0..seeds).map(|s| irradiance(map, position, Vec3::Z, s, &mut 0).x).sum::<f32>() / seeds as f32
    }

    #[test]
    fn what_lies_below_a_box_gets_no_light_and_does_not_count() {
        let map = square(|b, m| b.box_(Vec3::new(0.5, -0.1, -0.1), Vec3::new(1.1, 1.1, 0.1), false, m));
        let found = mean_surface(&map, at(0.499_99, 0.5), Vec3::Z);
        assert!((found / 0.5 - 1.0).abs() < 1e-3, "{found}");
        let e = mean_irradiance(&map, at(0.49, 0.5));
        assert!((e / 2.0 - 1.0).abs() < 0.01, "{e}");
        assert_eq!(mean_irradiance(&map, at(0.51, 0.5)), 0.0);
    }

    /// A wall across the square, thinner than a hair, and a roof behind it.
    #[test]
    fn no_light_comes_through_a_wall_and_none_is_lost_beside_it() {
        let map = square(|b, m| {
            let p = |x: f32, y: f32, z: f32| Vec3::new(x, y, z);
            b.quad(p(0.5, 0.0, 0.0), p(0.5, 0.0, 1.0), p(0.5, 1.0, 1.0), p(0.5, 1.0, 0.0), m);
            b.quad(p(0.5, 0.0, 0.5), p(1.0, 0.0, 0.5), p(1.0, 1.0, 0.5), p(0.5, 1.0, 0.5), m);
        });
        for distance in [0.001, 0.02, 0.06, 0.09, 0.2] {
            let plain = map.estimate(at(0.5 + distance, 0.5), Vec3::Z)[0];
            assert_eq!(plain > 0.0, distance < 0.1, "{distance}");
            let [lit, dark] = [-distance, distance].map(|d| mean_irradiance(&map, at(0.5 + d, 0.5)));
            assert!((lit / 2.0 - 1.0).abs() < 0.02, "{distance} before the wall: {lit}");
            assert_eq!(dark, 0.0, "{distance} behind the wall");
        }
    }

    #[test]
    fn the_parts_that_are_seen_are_exact_where_few_photons_are() {
        // Both rooms are lit: the part of light that comes through the wall is counted one by one here.
        let wall = |b: &mut MeshBuilder, m: u32| {
            b.quad(at(0.5, 0.0), at(0.5, 0.0) + Vec3::Z, at(0.5, 1.0) + Vec3::Z, at(0.5, 1.0), m);
        };
        let map = square_of(800, wall);
        let position = at(0.47, 0.5);
        let photons = map.columns();
        let (mut seen, mut all, mut count) = (0.0, 0.0, 0);
        for i in 0..photons.position[0].len() {
            let place = Vec3::new(photons.position[0][i], photons.position[1][i], photons.position[2][i]);
            let distance = place.distance(position) / 0.1;
            if distance <= 1.0 && place.z == 0.0 {
                let power = photons.power[0][i] * map.cylinder.filter(distance);
                all += power;
                seen += if place.x < 0.5 { power } else { 0.0 };
                count += 1;
            }
        }
        assert!((9..=PROBES).contains(&count) && seen > 0.0 && seen < all, "{count}: {seen} of {all}");
        let disc = Disc::new(&map, position, Vec3::Z, &mut 0);
        let mut rays = 0;
        assert!((disc.light(3, &mut rays).x - seen / all).abs() < 1e-5);
        assert_eq!(rays, u64::from(count));
    }

    #[test]
    fn below_a_low_shelf_what_lies_around_is_seen() {
        let map = square(|b, m| {
            let p = |x: f32, y: f32| Vec3::new(0.5 + x, 0.5 + y, 0.02);
            b.quad(p(-0.02, -0.02), p(0.02, -0.02), p(0.02, 0.02), p(-0.02, 0.02), m);
        });
        // All but what lies on the shelf, a part of 0.111 by the filter, unless the first photons all lie around it.
        let expected = 2.0 * (1.0 - 0.111 * (1.0 - 0.889f32.powi(FIRST as i32)));
        let e = mean_irradiance(&map, at(0.5, 0.5));
        assert!((e / expected - 1.0).abs() < 0.03, "{e}, {expected}");
    }

    #[test]
    fn an_open_place_takes_few_rays_and_a_dark_one_none() {
        let map = square(|_, _| ());
        let rays_at = |position| {
            let mut rays = 0;
            irradiance(&map, position, Vec3::Z, 0, &mut rays);
            rays
        };
        // To the apex, to each photon, and two per probe.
        assert_eq!(rays_at(at(0.5, 0.5)), u64::from(1 + FIRST + 2 * FIRST));
        assert_eq!(rays_at(at(5.0, 0.5)), 0);
    }
}
