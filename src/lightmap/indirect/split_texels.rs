//! Texels of the radiance map that lie on both sides of a wall.
//!
//! A texel has one value. Where a wall stands on a floor that goes on behind it, as floors of buildings do below outer
//! walls, the texels below the wall have the light of one side, or some of both, and gather rays that hit them on the
//! other side would see the sun through the wall. Therefore the light that is seen of such a texel is that of a neighbour
//! on the side of the hit, reflected by the texel's own albedo.
//!
//! Only texels are looked at whose light differs from a neighbour's. Lines of sight from a texel's sample to other points
//! of it tell which of them are behind a wall; the plane of the triangle that hides them tells where it stands.
//!
//! Measured: docs/experiments.md#texels-on-both-sides-of-a-wall.

use super::texel_albedo::albedo;
use super::texel_set::TexelSet;
use crate::base::error::Result;
use crate::base::memory::{Reservation, try_par_gather, try_push};
use crate::base::progress::Progress;
use crate::direct::Receiver;
use crate::lightmap::atlas::Atlas;
use crate::lightmap::atlas::chart_map::{ChartMap, receiver_of};
use crate::lightmap::atlas::ids::{PlacementId, RadianceMap, RadianceTexel};
use crate::lightmap::atlas::texels::TexelSample;
use crate::lightmap::texel_light::TexelAreas;
use crate::scene::Scene;
use crate::trace::{RawHit, Ray};
use glam::{DMat3, DVec3, Vec2, Vec3};
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// Radiance of two texels differs if one has more than this many times the other's.
const CONTRAST: f32 = 1.25;

/// Maximum number of points of a texel that are looked for behind a wall.
const POINTS: usize = 16;

/// On the side of its sample a texel keeps its own light if at most this fraction of its points is behind the wall.
const FEW: f32 = 0.125;

/// A plane is that of a wall if it has at least this fraction of a texel's points on the right side.
const AGREE: f32 = 0.75;

/// Number of a texel's points on a side from which a neighbour is looked for.
const LOOKS: usize = 4;

/// Number of neighbours beside a texel, which come before those at its corners.
const BESIDE: usize = 4;

/// Height of lines of sight above the surface, in widths of a texel.
const ABOVE: f32 = 0.125;

/// Number of texels that a thread takes at a time.
const BLOCK: usize = 1024;

/// Name of the buffers in error messages.
const SPLIT: &str = "texels on both sides of a wall";

/// Texels on both sides of a wall. There are none by default.
#[derive(Default)]
pub(crate) struct SplitTexels {
    set: TexelSet<RadianceMap>,
    /// By number in the set.
    walls: Vec<Wall>,
    _memory: Option<Reservation>,
}

/// A wall on a texel.
#[derive(Clone, Copy)]
struct Wall {
    texel: RadianceTexel,
    /// Factors of the coordinates in the texel, and a summand: the sum is negative on the far side of the wall, as seen from
    /// the texel's sample.
    line: [f32; 3],
    /// Radiance on the side of the sample and on the far side.
    radiance: [Vec3; 2],
}

impl SplitTexels {
    #[cfg(test)]
    pub fn is_empty(&self) -> bool {
        self.walls.is_empty()
    }

    /// Whether a texel is one of them.
    #[inline]
    pub fn has(&self, texel: RadianceTexel) -> bool {
        self.set.has(texel)
    }

    /// Returns the radiance of a texel on the sides of its wall; `None` if it is not one of them.
    pub fn both(&self, texel: RadianceTexel) -> Option<[Vec3; 2]> {
        Some(self.walls[self.set.rank(texel)?].radiance)
    }

    /// Returns the radiance of a texel of a placement at a place in the chart; `None` if the texel is not one of them.
    pub fn radiance(
        &self,
        map: &ChartMap<RadianceMap>,
        placement: PlacementId,
        texel: RadianceTexel,
        local: [f32; 2],
    ) -> Option<Vec3> {
        let Wall { line: [x, y, one], radiance, .. } = self.walls[self.set.rank(texel)?];
        let at = within(map, placement, texel, local);
        Some(radiance[usize::from(x * at.x + y * at.y + one < 0.0)])
    }
}

/// Returns the coordinates of a place in a chart relative to a texel's corner.
fn within(map: &ChartMap<RadianceMap>, placement: PlacementId, texel: RadianceTexel, local: [f32; 2]) -> Vec2 {
    let (x, y) = map.position(texel);
    Vec2::from(map.layout.texel_coord(placement, local)) - Vec2::new(x as f32, y as f32)
}

/// Finds the texels of a radiance map that lie on both sides of a wall, given the map's values. Adds the rays traced to
/// `rays`. To be called on the device's threads.
pub(crate) fn find(atlas: &Atlas, values: &[Vec3], rays: &mut u64, progress: &Progress) -> Result<SplitTexels> {
    let look = Look { atlas, areas: atlas.areas(&atlas.radiance), values };
    let (traced, count) = (AtomicU64::new(0), values.len());
    let walls = try_par_gather(count.div_ceil(BLOCK), SPLIT, |block, out: &mut Vec<Wall>| {
        progress.check()?;
        let mut rays = 0;
        for texel in RadianceTexel::range(block * BLOCK..count.min((block + 1) * BLOCK)) {
            if let Some(wall) = look.at(texel, &mut rays) {
                try_push(out, wall, SPLIT)?;
            }
        }
        traced.fetch_add(rays, Relaxed);
        Ok(())
    })?;
    *rays += traced.into_inner();
    let set = TexelSet::new(walls.iter().map(|wall| &wall.texel), count, SPLIT)?;
    let memory = atlas.scene.device().memory().reserve(set.bytes() + size_of_val(&walls[..]), SPLIT)?;
    Ok(SplitTexels { set, walls, _memory: Some(memory) })
}

/// A point of a texel.
#[derive(Clone, Copy)]
struct Point {
    receiver: Receiver,
    /// Coordinates in the texel.
    at: Vec2,
    /// Whether it cannot be seen from the texel's sample.
    is_hidden: bool,
}

/// The plane of a wall; its normal points to the texel's sample.
#[derive(Clone, Copy, Default)]
struct Plane {
    normal: Vec3,
    point: Vec3,
}

impl Plane {
    /// Returns the plane of the triangle that hides two points from one another.
    fn of(scene: &Scene, sight: &Ray, hit: &RawHit) -> Plane {
        let [a, b, c] = scene.corners(hit.triangle);
        let (normal, along) = ((b - a).cross(c - a).normalize_or_zero(), Vec3::from(sight.direction));
        let normal = if normal.dot(along) > 0.0 { -normal } else { normal };
        Plane { normal, point: Vec3::from(sight.origin) + hit.t * along }
    }

    fn distance(&self, receiver: &Receiver) -> f32 {
        self.normal.dot(receiver.origin - self.point)
    }

    /// Returns the number of points on the right side.
    fn agreeing(&self, points: &[Point]) -> usize {
        points.iter().filter(|p| (self.distance(&p.receiver) < 0.0) == p.is_hidden).count()
    }

    /// Returns factors of the coordinates in a texel and a summand that make the distance from the plane: those with the
    /// least squares of what is left at some points, as the surface may be curved.
    fn line(&self, points: &[Point]) -> [f32; 3] {
        // A little is added for points that lie on a line.
        let (mut matrix, mut sum) = (DMat3::from_diagonal(DVec3::new(1e-3, 1e-3, 0.0)), DVec3::ZERO);
        for p in points {
            let x = p.at.as_dvec2().extend(1.0);
            matrix += DMat3::from_cols(x * x.x, x * x.y, x);
            sum += x * f64::from(self.distance(&p.receiver));
        }
        (matrix.inverse() * sum).as_vec3().to_array()
    }
}

/// Whether two values of radiance differ.
fn differ(a: Vec3, b: Vec3) -> bool {
    let [a, b] = [a, b].map(Vec3::element_sum);
    a.max(b) > CONTRAST * a.min(b)
}

struct Look<'a> {
    atlas: &'a Atlas,
    areas: TexelAreas<'a, RadianceMap>,
    values: &'a [Vec3],
}

impl Look<'_> {
    fn value(&self, texel: RadianceTexel) -> Vec3 {
        self.values[texel.index()]
    }

    /// Returns the radiance that a texel would have in the light of another one.
    fn in_light_of(&self, texel: RadianceTexel, other: RadianceTexel) -> Vec3 {
        if texel == other {
            return self.value(texel);
        }
        let [own, others] = [texel, other].map(|texel| albedo(&self.areas, texel));
        // A neighbour that reflects nothing does not tell what light it gets.
        Vec3::select(others.cmpgt(Vec3::ZERO), self.value(other) * own / others, self.value(texel))
    }

    /// Returns the wall on a texel, if there is one and different light on both sides.
    #[inline(never)]
    fn at(&self, texel: RadianceTexel, rays: &mut u64) -> Option<Wall> {
        let neighbours = self.areas.neighbours(texel);
        if !neighbours.iter().flatten().any(|&near| differ(self.value(texel), self.value(near))) {
            return None;
        }
        let (map, scene) = (&self.atlas.radiance, &self.atlas.scene);
        let (placement, back) = (map.texels.placement_of(texel.index() as u32), map.is_back(texel));
        let [x, y] = map.layout[placement].scale;
        let mut sight = |from: &Receiver, to: &Receiver| {
            *rays += 1;
            let [from, to] = [from, to].map(|r| r.origin + ABOVE / x.min(y) * r.geometric);
            let ray = Ray::new(from, to - from).within(0.0, 1.0);
            (ray, scene.intersect_raw(&ray))
        };
        let point = |on: &TexelSample| {
            let local = self.atlas.charts.local(on.triangle, on.u, on.v);
            let (_, receiver) = receiver_of(scene, on, back);
            Point { receiver, at: within(map, placement, texel, local), is_hidden: false }
        };
        let own = point(&map[texel]);
        let (mut points, mut count) = ([own; POINTS + 1], 1);
        let (mut planes, mut hidden) = ([Plane::default(); POINTS], 0);
        let seed = map.seed_in(placement, texel);
        for on in (0..POINTS as u32).filter_map(|i| self.areas.point(texel, i, seed)) {
            let to = point(&on);
            let (ray, hit) = sight(&own.receiver, &to.receiver);
            points[count] = Point { is_hidden: !hit.is_miss(), ..to };
            count += 1;
            if !hit.is_miss() {
                planes[hidden] = Plane::of(scene, &ray, &hit);
                hidden += 1;
            }
        }
        let points = &points[..count];
        let plane = planes[..hidden].iter().max_by_key(|plane| plane.agreeing(points))?;
        if (plane.agreeing(points) as f32) < AGREE * count as f32 {
            return None;
        }
        // On each side, the neighbour farthest from the wall gives its light, of those beside the texel if there are any.
        let mut best = |side: f32, from: &dyn Fn(&Point) -> bool| {
            let (mut best, mut farthest) = (texel, 0.0);
            for (i, &near) in (0..).zip(&neighbours) {
                if i == BESIDE && farthest > 0.0 {
                    break;
                }
                let Some(near) = near else { continue };
                let (_, receiver) = map.receiver(scene, near, back);
                let distance = side * plane.distance(&receiver);
                let mut looks = points.iter().filter(|p| from(p)).take(LOOKS);
                if distance > farthest && looks.any(|p| sight(&p.receiver, &receiver).1.is_miss()) {
                    (best, farthest) = (near, distance);
                }
            }
            best
        };
        let is_own = hidden as f32 <= FEW * count as f32;
        let here = if is_own { texel } else { best(1.0, &|p| !p.is_hidden) };
        let there = best(-1.0, &|p| p.is_hidden);
        // Neighbours with another albedo may have the same light.
        let radiance = [here, there].map(|other| self.in_light_of(texel, other));
        let is_needed = radiance.iter().any(|&radiance| differ(radiance, self.value(texel)));
        is_needed.then(|| Wall { texel, line: plane.line(points), radiance })
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::lightmap::{BakeParams, Lightmap, LightmapDesc};
    use crate::scene::demo::shapes::MeshBuilder;
    use crate::scene::{Light, Material, SceneData};

    /// A closed box in the sun, 4 by 3 and 2.5 high, whose floor goes on for 7 cm behind its walls.
    pub(in super::super) fn closed_box() -> Lightmap {
        let mut data = SceneData::new();
        let m = data.add_material(Material { albedo: [0.7; 3], ..Default::default() }).unwrap();
        let p = Vec3::new;
        let (mut walls, mut floor) = (MeshBuilder::new(), MeshBuilder::new());
        walls.box_(p(0.0, -0.1, 0.0), p(4.0, 2.5, 3.0), true, m);
        let (lower, upper) = (-0.07, [4.07, 3.07]);
        let corner = |x, z| p(x, 0.0, z);
        floor.quad(
            corner(lower, lower),
            corner(lower, upper[1]),
            corner(upper[0], upper[1]),
            corner(upper[0], lower),
            m,
        );
        data.add_mesh(walls.finish()).unwrap();
        data.add_mesh(floor.finish()).unwrap();
        let direction = p(0.3, -1.0, 0.2).normalize();
        data.add_light(Light::Directional { direction, irradiance: [10.0; 3], angular_radius: 0.0 }).unwrap();
        let desc = LightmapDesc { texels_per_unit: 10.0, ..Default::default() };
        let mut lightmap = Lightmap::create(&data.committed(), &desc, &Progress::none()).unwrap();
        let params = BakeParams { photon_count: 100_000, ..Default::default() };
        lightmap.bake(&params, &Progress::none()).unwrap();
        lightmap
    }

    #[test]
    fn the_sun_does_not_shine_below_walls() {
        let lightmap = closed_box();
        let (atlas, light) = (lightmap.atlas(), lightmap.light.as_ref().unwrap());
        let of_walls = atlas.map.all().filter(|&texel| {
            let y = atlas.map.surface(&atlas.scene, texel).0.y;
            atlas.map[texel].triangle < 12 && y > 0.05 && y < 1.0
        });
        let (mut sum, mut count) = (0.0, 0);
        of_walls.for_each(|texel| (sum, count) = (sum + light.indirect[texel.index()].x, count + 1));
        println!("light {sum} in {count} texels");
        // Without the rule it is 0.06 per texel.
        assert!(count > 1000 && sum < 0.005 * count as f32, "{sum} {count}");
    }

    #[test]
    fn the_light_of_another_texel_is_reflected_by_a_texels_own_albedo() {
        let mut data = SceneData::new();
        let (mut mesh, colours) = (MeshBuilder::new(), [[0.8, 0.4, 0.0], [0.1, 0.2, 0.3]]);
        for (colour, z) in colours.into_iter().zip([0.0, 1.0]) {
            let m = data.add_material(Material { albedo: colour, ..Default::default() }).unwrap();
            let p = |x: f32, y: f32| Vec3::new(x, y, z);
            mesh.quad(p(0.0, 0.0), p(1.0, 0.0), p(1.0, 1.0), p(0.0, 1.0), m);
        }
        data.add_mesh(mesh.finish()).unwrap();
        let desc = LightmapDesc { texels_per_unit: 10.0, ..Default::default() };
        let lightmap = Lightmap::create(&data.committed(), &desc, &Progress::none()).unwrap();
        let atlas = lightmap.atlas();
        let map = &atlas.radiance;
        let of = |triangle: u32| map.all().find(|&texel| map[texel].triangle / 2 == triangle / 2).unwrap();
        let [a, b] = [of(0), of(2)];
        // Irradiance is π and 2 π.
        let mut values = vec![Vec3::ZERO; map.len()];
        (values[a.index()], values[b.index()]) = (Vec3::from(colours[0]), 2.0 * Vec3::from(colours[1]));
        let look = Look { atlas, areas: atlas.areas(map), values: &values };
        let is_like = |found: Vec3, expected: [f32; 3]| found.abs_diff_eq(expected.into(), 1e-6);
        assert!(is_like(look.in_light_of(a, a), colours[0]) && is_like(look.in_light_of(a, b), [1.6, 0.8, 0.0]));
        // Where the other one is black, the light of the texel stays.
        assert!(is_like(look.in_light_of(b, a), [0.1, 0.2, 0.6]));
    }

    #[test]
    fn light_is_seen_of_a_texel_on_the_side_of_the_hit() {
        let lightmap = closed_box();
        let (atlas, light) = (lightmap.atlas(), lightmap.light.as_ref().unwrap());
        let (map, areas, split) = (&atlas.radiance, atlas.areas(&atlas.radiance), &light.radiance.split);
        let is_inside = |p: Vec3| p.x > 0.0 && p.x < 4.0 && p.z > 0.0 && p.z < 3.0;
        let (mut places, mut wrong, mut lit) = (0, 0, 0);
        for texel in map.all().filter(|&texel| split.has(texel) && map[texel].triangle >= 12) {
            let placement = map.placement_of(&atlas.charts, texel);
            for on in (0..64).filter_map(|i| areas.point(texel, i, 7)) {
                let local = atlas.charts.local(on.triangle, on.u, on.v);
                let radiance = split.radiance(map, placement, texel, local).unwrap();
                // The sun makes 2.2, of which a texel may keep an eighth on its own side.
                let is_lit = radiance.x > 0.5;
                // The strip outside may have no texel of its own.
                wrong += usize::from(is_inside(on.position(&atlas.scene)) && is_lit);
                lit += usize::from(is_lit);
                places += 1;
            }
        }
        println!("{wrong} of {places}");
        // At corners of the box two walls stand on a texel.
        assert!(places > 500 && wrong * 100 < places, "{wrong} of {places}");
        assert!(lit > 50, "{lit} of {places}");
    }
}
