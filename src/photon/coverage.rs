//! Visible part of the disc of an irradiance estimate.
//!
//! The estimate divides the power of all photons in a disc by the disc's area. Where part of the disc lies beside the
//! surface – along every edge and in every corner – that is too dark, to half at an edge and to a quarter in the corner
//! of a box. And where the disc reaches through a wall, light of the other room comes in. So short rays probe the disc:
//! those along the normal find where the surface continues; others test whether the surface points they find, and the
//! photons themselves, are visible from above the disc's centre. The estimate is multiplied by the part of its light
//! that comes from visible photons, and divided by the area of the visible surface as a part of the disc's, weighted by
//! the filter (Jensen 2001, section 7.5, and Hey and Purgathofer, *Advanced Radiance Estimation for Photon Map Global
//! Illumination*, 2002, divide by the area of the surfaces in the same spirit). Where all of the disc is visible and
//! flat both are exactly 1. (Pieces of all surfaces in a grid of their own, summed as photons are, left more bias in a furnished
//! room – 1.4 % of the median point instead of 0.5 % – and were three times as many there as photons.)
//!
//! The discs of a tile of texels trace their rays together, as [streams](crate::trace), step by step: a disc has the
//! same bits alone and in a tile.

use super::PhotonMap;
use super::cylinder::SAME_SURFACE;
use super::noted::Noted;
use crate::base::error::Result;
use crate::base::memory::{try_filled, try_with_capacity};
use crate::base::sampling::{concentric_disc, orthonormal_basis, sobol_2d};
use crate::trace::offset::offset_ray_origin;
use crate::trace::{RawHit, Ray};
use glam::{Vec2, Vec3};
use std::ops::Range;

/// Minimum of the visible part of a disc: estimates are raised by a factor of sixteen at most. On scraps of surface that
/// hardly any photon hits, more would make single photons shine. (With a quarter, San Miguel, whose relief is finer than
/// discs, has 2.5 % less light: docs/experiments.md#narrow-surfaces-in-the-radiance-map.)
const LEAST: f32 = 1.0 / 16.0;

/// Maximum number of photons of a disc that are tested. If there are no more, the visible part of their light is exact.
const PHOTONS: u32 = 16;

/// Number of first tests after which, if all were visible, the rest are assumed to be visible too: at most points there
/// is no edge nearby. Of a part p that is hidden, p (1 − p)⁸ escapes notice in the mean, 4 % at most.
const FIRST: u32 = 8;

/// Number of probes of a disc after which no more follow if most of them found visible surface. (32: the same error in four
/// scenes: docs/experiments.md#look-ups-in-the-radiance-map.)
const PROBES: u32 = 16;

/// Number of probes of a disc if no more than [`SMALL`] of it is found to be visible surface. Estimates are divided by this
/// part: the error of few probes would make them too bright in the mean, as 1/x is convex.
const MOST_PROBES: u32 = 64;

/// Part of a disc that [`PROBES`] probes find, up to which more follow. Discs that are probed again only if too little was
/// found of them have too large a part in the mean, so the limit lies where few discs do: between the half at an edge and the
/// quarter in a corner. (With a half, edges were 1 to 3 % too dark.)
const SMALL: f32 = 0.375;

/// Cosine of the angle up to which surface counts as parallel to the disc: 8 degrees, an error of half a percent at most.
/// Nearly all discs on smooth surface are whole after the first probes then.
const PARALLEL: f32 = 0.99;

/// Discs around the points of a tile, whose rays are traced together.
pub(crate) struct Discs {
    discs: Vec<Disc>,
    noted: Noted,
    rays: Vec<Ray>,
    /// The disc that each ray is for, and what it carries.
    carried: Vec<(u32, Vec3)>,
    hits: Vec<RawHit>,
    occluded: Vec<u8>,
}

/// A disc and what has been found out about it so far.
#[derive(Clone, Copy)]
struct Disc {
    position: Vec3,
    normal: Vec3,
    seed: u32,
    estimate: Vec3,
    /// Photons of the estimate that may be looked at, and how many there are.
    photons: [u32; PHOTONS as usize],
    photon_count: usize,
    /// Point above the position, in the cylinder of the estimate, and in the same room.
    apex: Vec3,
    /// Height of the apex above the position.
    up: f32,
    /// Light of the photons that were looked at, by channel, and of those that are visible.
    all_light: Vec3,
    seen: Vec3,
    some_are_hidden: bool,
    /// Weights of the probes, and of those that found visible surface, which count more if it is inclined.
    all: f32,
    covered: f32,
    /// Whether the first [`PROBES`] probes found no more than [`SMALL`] of the disc.
    is_small: bool,
}

impl Discs {
    /// Allocates room for a number of discs.
    pub(crate) fn new(most: usize) -> Result<Discs> {
        let (what, rays) = ("the discs of a tile", most * PROBES.max(PHOTONS) as usize);
        Ok(Discs {
            discs: try_with_capacity(most, what)?,
            noted: Noted::new(),
            rays: try_with_capacity(rays, what)?,
            carried: try_with_capacity(rays, what)?,
            hits: try_filled(rays, RawHit::MISS, what)?,
            occluded: try_filled(rays, 0, what)?,
        })
    }

    /// Computes the irradiance at points (position, normal, seed) from the photons and the surface that are visible
    /// from each. Adds the rays traced to `rays`.
    pub(crate) fn irradiance(
        &mut self,
        map: &PhotonMap,
        points: impl Iterator<Item = (Vec3, Vec3, u32)>,
        rays: &mut u64,
        mut out: impl FnMut(usize, Vec3),
    ) {
        self.discs.clear();
        let noted = &mut self.noted;
        self.discs.extend(points.map(|(position, normal, seed)| Disc::new(map, position, normal, seed, noted)));
        self.find_apexes(map, rays);
        self.look_at_photons(map, 0..FIRST as usize, |_| true, rays);
        self.look_at_photons(map, FIRST as usize..PHOTONS as usize, |d| d.some_are_hidden, rays);
        self.find_surface(map, rays);
        self.discs.iter().enumerate().for_each(|(i, disc)| out(i, disc.irradiance()));
    }

    fn find_apexes(&mut self, map: &PhotonMap, rays: &mut u64) {
        let (scene, height) = (map.scene(), half_height(map));
        self.clear_rays();
        for (i, disc) in (0..).zip(&self.discs).filter(|(_, d)| d.is_lit()) {
            let origin = offset_ray_origin(disc.position, disc.normal, scene);
            self.rays.push(Ray::new(origin, disc.normal).within(0.0, 2.0 * height));
            self.carried.push((i, Vec3::ZERO));
        }
        *rays += self.rays.len() as u64;
        scene.intersect_stream(&self.rays, &mut self.hits);
        for (&(i, _), free) in self.carried.iter().zip(&self.hits) {
            let disc = &mut self.discs[i as usize];
            disc.up = if free.is_miss() { height } else { 0.5 * free.t };
            disc.apex = disc.position + disc.up * disc.normal;
        }
    }

    /// Tests which photons are visible, those of the given numbers of each disc that `goes_on`.
    fn look_at_photons(
        &mut self,
        map: &PhotonMap,
        numbers: Range<usize>,
        goes_on: impl Fn(&Disc) -> bool,
        rays: &mut u64,
    ) {
        let (photons, cylinder) = (map.columns(), &map.cylinder);
        let vector = |columns: &[&[f32]; 3], i: usize| Vec3::new(columns[0][i], columns[1][i], columns[2][i]);
        self.clear_rays();
        for (k, disc) in (0..).zip(&self.discs).filter(|(_, d)| d.is_lit() && goes_on(d)) {
            let photons_of = &disc.photons[..disc.photon_count];
            for &i in photons_of.iter().take(numbers.end).skip(numbers.start) {
                let i = i as usize;
                let Some(weight) = cylinder.weight(&photons, i, disc.position, disc.normal) else { continue };
                let (point, facing) = (vector(&photons.position, i), vector(&photons.normal, i));
                self.rays.push(line_of_sight(map, point, facing, disc.apex));
                self.carried.push((k, weight * vector(&photons.power, i)));
            }
        }
        self.trace_lines_of_sight(map, rays);
        for (&(k, power), &occluded) in self.carried.iter().zip(&self.occluded) {
            let disc = &mut self.discs[k as usize];
            disc.all_light += power;
            if occluded == 0 {
                disc.seen += power;
            } else {
                disc.some_are_hidden = true;
            }
        }
    }

    /// Finds the part of each disc where there is visible surface.
    fn find_surface(&mut self, map: &PhotonMap, rays: &mut u64) {
        self.probe(map, 0..FIRST, |_| true, rays);
        self.probe(map, FIRST..PROBES, |d| d.covered != d.all, rays);
        self.discs.iter_mut().for_each(|d| d.is_small = d.covered <= SMALL * d.all);
        for first in (PROBES..MOST_PROBES).step_by(PROBES as usize) {
            self.probe(map, first..first + PROBES, |d| d.is_small, rays);
        }
    }

    /// Probes of the given numbers find where there is visible surface in each disc that `goes_on`: rays down from
    /// points at the apex's height, and lines of sight from surfaces that they find, if these face as the normal does.
    fn probe(&mut self, map: &PhotonMap, numbers: Range<u32>, goes_on: impl Fn(&Disc) -> bool, rays: &mut u64) {
        let (scene, height, radius) = (map.scene(), half_height(map), map.cylinder.radius);
        self.clear_rays();
        for (k, disc) in (0..).zip(&mut self.discs).filter(|(_, d)| d.light() != Vec3::ZERO && goes_on(d)) {
            let (x, y) = orthonormal_basis(disc.normal);
            for i in numbers.clone() {
                let d = Vec2::from(concentric_disc(sobol_2d(i, disc.seed)));
                let weight = map.cylinder.filter(d.length());
                disc.all += weight;
                let above = disc.apex + radius * (d.x * x + d.y * y);
                self.rays.push(Ray::new(above, -disc.normal).within(0.0, disc.up + height));
                self.carried.push((k, Vec3::splat(weight)));
            }
        }
        *rays += self.rays.len() as u64;
        scene.intersect_stream(&self.rays, &mut self.hits);
        let mut found = 0;
        for i in 0..self.rays.len() {
            let (hit, carried) = (self.hits[i], self.carried[i]);
            let disc = &self.discs[carried.0 as usize];
            if hit.is_miss() || !(hit.front || scene.material(hit.triangle).two_sided) {
                continue;
            }
            let facing = if hit.front { scene.normal(hit.triangle) } else { -scene.normal(hit.triangle) };
            let cosine = facing.dot(disc.normal);
            if cosine >= SAME_SURFACE {
                let point = Vec3::from(self.rays[i].origin) - hit.t * disc.normal;
                self.rays[found] = line_of_sight(map, point, facing, disc.apex);
                // The area of inclined surface is 1 / cosine times what the probe sees of it. Photons on it count if they
                // come from above the disc: the part (1 + cosine) / 2 of light that is the same from all directions.
                let area = if cosine < PARALLEL { 0.5 * (1.0 + 1.0 / cosine) } else { 1.0 };
                self.carried[found] = (carried.0, carried.1 * area);
                found += 1;
            }
        }
        self.rays.truncate(found);
        self.carried.truncate(found);
        self.trace_lines_of_sight(map, rays);
        for (&(k, weight), _) in self.carried.iter().zip(&self.occluded).filter(|(_, occluded)| **occluded == 0) {
            self.discs[k as usize].covered += weight.x;
        }
    }

    fn clear_rays(&mut self) {
        self.rays.clear();
        self.carried.clear();
    }

    fn trace_lines_of_sight(&mut self, map: &PhotonMap, rays: &mut u64) {
        *rays += self.rays.len() as u64;
        map.scene().occluded_stream(&self.rays, &mut self.occluded);
    }
}

impl Disc {
    fn new(map: &PhotonMap, position: Vec3, normal: Vec3, seed: u32, noted: &mut Noted) -> Disc {
        let estimate = Vec3::from(map.estimate_and_note(position, normal, noted));
        let mut photons = [0; PHOTONS as usize];
        let photon_count = noted.spread(seed, &mut photons);
        Disc {
            position,
            normal,
            seed,
            estimate,
            photons,
            photon_count,
            apex: position,
            up: 0.0,
            all_light: Vec3::ZERO,
            seen: Vec3::ZERO,
            some_are_hidden: false,
            all: 0.0,
            covered: 0.0,
            is_small: false,
        }
    }

    /// Whether there is any light. Nothing is traced for discs without.
    fn is_lit(&self) -> bool {
        self.estimate != Vec3::ZERO
    }

    /// The part of the estimate's light that comes from visible photons, by channel; 0 if there is no light.
    fn light(&self) -> Vec3 {
        match (self.is_lit(), self.some_are_hidden) {
            (false, _) => Vec3::ZERO,
            (true, false) => Vec3::ONE,
            (true, true) => self.seen / self.all_light.max(Vec3::splat(f32::MIN_POSITIVE)),
        }
    }

    fn irradiance(&self) -> Vec3 {
        let light = self.light();
        if light == Vec3::ZERO { light } else { self.estimate * light / self.surface() }
    }

    /// The area of visible surface as a part of the disc's, weighted by the filter: at least [`LEAST`], and more than 1 where
    /// much of it is inclined.
    fn surface(&self) -> f32 {
        if self.covered == self.all { 1.0 } else { (self.covered / self.all).max(LEAST) }
    }
}

/// Half the height of the cylinder of an estimate.
fn half_height(map: &PhotonMap) -> f32 {
    (map.cylinder.radius * map.cylinder.half_height).min(map.scene().diagonal())
}

/// The ray from a surface point to the apex of a disc.
fn line_of_sight(map: &PhotonMap, point: Vec3, facing: Vec3, apex: Vec3) -> Ray {
    let origin = offset_ray_origin(point, facing, map.scene());
    Ray::new(origin, apex - origin).within(0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::progress::Progress;
    use crate::photon::PhotonParams;
    use crate::scene::demo::shapes::MeshBuilder;
    use crate::scene::{Light, Material, SceneData};

    /// Number of seeds over which means are taken.
    const SEEDS: u32 = 512;

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

    /// A disc at a point by each seed, as if there were light.
    fn discs_at(map: &PhotonMap, position: Vec3, normal: Vec3, seeds: Range<u32>) -> Discs {
        let mut discs = Discs::new(seeds.len()).unwrap();
        let mut noted = Noted::new();
        let lit = |seed| Disc { estimate: Vec3::ONE, ..Disc::new(map, position, normal, seed, &mut noted) };
        discs.discs.extend(seeds.map(lit));
        discs.find_apexes(map, &mut 0);
        discs
    }

    /// The mean over many seeds.
    fn mean_surface(map: &PhotonMap, position: Vec3, normal: Vec3) -> f32 {
        let mut discs = discs_at(map, position, normal, 0..SEEDS);
        discs.find_surface(map, &mut 0);
        discs.discs.iter().map(Disc::surface).sum::<f32>() / SEEDS as f32
    }

    #[test]
    fn edges_and_corners_of_a_square_get_their_light_back() {
        let map = square(|_, _| ());
        assert_eq!(mean_surface(&map, at(0.5, 0.5), Vec3::Z), 1.0);
        for (x, y, part, tolerance) in [(0.5, 0.5, 1.0, 1e-3), (0.0, 0.4, 0.5, 1e-3), (1.0, 0.0, 0.25, 0.01)] {
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
        let (mut discs, mut sum) = (Discs::new(SEEDS as usize).unwrap(), 0.0);
        discs.irradiance(map, (0..SEEDS).map(|s| (position, Vec3::Z, s)), &mut 0, |_, e| sum += e.x);
        sum / SEEDS as f32
    }

    /// The top of a board that is a tenth as wide as the search radius.
    #[test]
    fn narrow_surfaces_get_their_light_back() {
        let map = square(|b, m| {
            let p = |x: f32, y: f32| Vec3::new(0.5 + x, y, 0.5);
            b.quad(p(0.0, 0.0), p(0.01, 0.0), p(0.01, 1.0), p(0.0, 1.0), m);
        });
        for x in [0.501, 0.505] {
            let e = mean_irradiance(&map, Vec3::new(x, 0.5, 0.5));
            assert!((e / 2.0 - 1.0).abs() < 0.05, "{e}");
        }
    }

    /// A roof of two slopes of 25 degrees in a furnace, each of which lies partly in the discs of the other.
    #[test]
    fn inclined_surfaces_count_with_their_area() {
        let mut data = SceneData::new();
        let glowing = Material { emission: [1.0; 3], albedo: [0.0; 3], ..Default::default() };
        let glowing = data.add_material(glowing).unwrap();
        let m = data.add_material(Material { albedo: [0.0; 3], ..Default::default() }).unwrap();
        let mut builder = MeshBuilder::new();
        builder.box_(Vec3::splat(-1.0), Vec3::splat(1.0), true, glowing);
        let (sin, cos) = 25f32.to_radians().sin_cos();
        builder.sheet(2, 1, m, |u, v| Vec3::new(cos * (u - 0.5), v - 0.5, sin * (0.5 - (u - 0.5).abs())));
        data.add_mesh(builder.finish()).unwrap();
        let params = PhotonParams { photon_count: 1 << 20, radius: 0.1, ..Default::default() };
        let map = PhotonMap::trace(&data.committed(), &params, &Progress::none()).unwrap();
        let (mut discs, mut sum) = (Discs::new(SEEDS as usize).unwrap(), 0.0);
        let point = |seed: u32| {
            let (y, beside) = (0.8 * seed as f32 / SEEDS as f32 - 0.4, 0.01);
            (Vec3::new(cos * beside, y, sin * (0.5 - beside)), Vec3::new(sin, 0.0, cos), seed)
        };
        discs.irradiance(&map, (0..SEEDS).map(point), &mut 0, |_, e| sum += e.x);
        let e = sum / SEEDS as f32 / std::f32::consts::PI;
        assert!((e - 1.0).abs() < 0.03, "{e}");
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
        let map = square_of(400, wall);
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
        assert!((9..=PHOTONS).contains(&count) && seen > 0.0 && seen < all, "{count}: {seen} of {all}");
        // Unless the first that a disc looks at are all on its side of the wall.
        let mut noticed = 0;
        for seed in 0..16 {
            let (mut discs, mut rays) = (discs_at(&map, position, Vec3::Z, seed..seed + 1), 0);
            discs.look_at_photons(&map, 0..FIRST as usize, |_| true, &mut rays);
            discs.look_at_photons(&map, FIRST as usize..PHOTONS as usize, |d| d.some_are_hidden, &mut rays);
            let (disc, light) = (&discs.discs[0], discs.discs[0].light().x);
            let expected = if disc.some_are_hidden { (seen / all, count) } else { (1.0, FIRST) };
            assert!((light - expected.0).abs() < 1e-5 && rays == u64::from(expected.1), "{light}, {rays} rays");
            noticed += u32::from(disc.some_are_hidden);
        }
        assert!(noticed >= 12, "{noticed}");
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
            let mut discs = Discs::new(1).unwrap();
            discs.irradiance(&map, [(position, Vec3::Z, 0)].into_iter(), &mut rays, |_, _| ());
            rays
        };
        // To the apex, to each photon, and two per probe.
        assert_eq!(rays_at(at(0.5, 0.5)), u64::from(1 + FIRST + 2 * FIRST));
        assert_eq!(rays_at(at(5.0, 0.5)), 0);
    }
}
