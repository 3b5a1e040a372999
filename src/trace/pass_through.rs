//! Queries of scenes with cut-outs and transmissive sheets: corrects the results of the ordinary kernels, and computes
//! the light that sheets transmit, by the kernels with a [`Filter`].

use super::filter::{Crossing, Filter};
use super::queries::TreeView;
use super::tree::direction_scale;
use super::{Packet, RawHit, Ray};
use crate::scene::Scene;
use glam::Vec3;

/// Two hits of a ray on an edge are one if they have one material and their distances differ by less than this
/// fraction: the ray then hits both triangles of the edge.
const SAME_EDGE: f32 = 1e-5;

impl Scene {
    /// Traces rays again whose closest hit is a cut-out.
    #[cold]
    pub(super) fn leave_holes(&self, rays: &[Ray], hits: &mut [RawHit]) {
        for (ray, hit) in rays.iter().zip(hits) {
            if !hit.is_miss() && self.is_hole(hit.triangle, hit.u, hit.v) {
                *hit = self.filtered::<false>(ray, None);
            }
        }
    }

    /// Traces those rays of a packet again whose closest hit is a cut-out.
    #[cold]
    pub(super) fn leave_holes_of_packet(
        &self,
        origin: Vec3,
        packet: &Packet,
        tmin: f32,
        tmax: f32,
        hits: &mut [RawHit],
    ) {
        for i in 0..packet.count.min(hits.len()) {
            let ray = Ray::new(origin, Vec3::new(packet.x[i], packet.y[i], packet.z[i])).within(tmin, tmax);
            self.leave_holes(&[ray], &mut hits[i..=i]);
        }
    }

    /// Corrects occlusion that is by cut-outs alone.
    #[cold]
    pub(super) fn look_through_holes(&self, rays: &[Ray], occluded: &mut [u8]) {
        for (ray, occluded) in rays.iter().zip(occluded).filter(|(_, occluded)| **occluded != 0) {
            *occluded = !self.filtered::<true>(ray, None).is_miss() as u8;
        }
    }

    /// The fraction of light, per channel, that passes along a ray: 0 if anything opaque lies on it, else the product
    /// of the transmittances of the sheets on it.
    pub fn transmittance(&self, ray: &Ray) -> Vec3 {
        if !self.uses().transmission {
            return if self.occluded(ray) { Vec3::ZERO } else { Vec3::ONE };
        }
        if !self.anything_on(ray) {
            return Vec3::ONE;
        }
        let mut crossings = Vec::new();
        if !self.filtered::<true>(ray, Some(&mut crossings)).is_miss() {
            return Vec3::ZERO;
        }
        self.tidy(&mut crossings, &RawHit::MISS);
        crossings.iter().map(|c| Vec3::from(self.material(c.hit.triangle).transmission)).product()
    }

    /// The closest hit on something opaque and, in order, the transmissive sheets before it.
    pub(crate) fn intersect_through(&self, ray: &Ray, crossings: &mut Vec<Crossing>) -> RawHit {
        crossings.clear();
        let hit = self.filtered::<false>(ray, Some(crossings));
        self.tidy(crossings, &hit);
        hit
    }

    /// The closest hit (`ANY`: any hit) that counts, found by tracing the ray from its beginning.
    #[cold]
    fn filtered<const ANY: bool>(&self, ray: &Ray, crossings: Option<&mut Vec<Crossing>>) -> RawHit {
        let mut filter = Filter { scene: self, crossings, first_triangle: 0 };
        let hit = self.filtered_in::<ANY>(self.whole_tree(), ray, &mut filter);
        match self.instance_trees() {
            Some(instances) if !ANY || hit.is_miss() => self.meet_filtered::<ANY>(instances, ray, hit, &mut filter),
            _ => hit,
        }
    }

    /// The closest hit (`ANY`: any hit) in one tree that counts.
    pub(super) fn filtered_in<const ANY: bool>(&self, tree: TreeView, ray: &Ray, filter: &mut Filter) -> RawHit {
        let before = filter.crossings.as_ref().map_or(0, |c| c.len());
        let hit = match tree {
            TreeView::Whole(tree) => self.kernels().filtered::<ANY>(tree, ray, filter),
            TreeView::Compact(tree) => self.kernels().compact_filtered::<ANY>(&tree, ray, filter),
        };
        if let Some(crossings) = &mut filter.crossings {
            // The kernels' unit is the direction's length but for a power of two.
            let scale = direction_scale(ray).unwrap_or(1.0);
            crossings[before..].iter_mut().for_each(|c| c.hit.t *= scale);
        }
        hit
    }

    /// Sorts crossings, and removes those that lie behind `hit` and those that are counted twice.
    fn tidy(&self, crossings: &mut Vec<Crossing>, hit: &RawHit) {
        let before = |c: &Crossing| c.hit.t < hit.t || (c.hit.t == hit.t && c.hit.triangle < hit.triangle);
        crossings.retain(before);
        crossings.sort_unstable_by(|a, b| a.hit.t.total_cmp(&b.hit.t).then(a.hit.triangle.cmp(&b.hit.triangle)));
        // Spatial splits put a triangle into several leaves.
        crossings.dedup_by_key(|c| c.hit.triangle);
        let mut kept = 0;
        for i in 0..crossings.len() {
            let c = crossings[i];
            let same = |k: &Crossing| {
                k.on_edge
                    && c.hit.t - k.hit.t <= SAME_EDGE * c.hit.t.abs()
                    && self.material_id(k.hit.triangle) == self.material_id(c.hit.triangle)
            };
            if !(c.on_edge && crossings[..kept].iter().any(same)) {
                crossings[kept] = c;
                kept += 1;
            }
        }
        crossings.truncate(kept);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::progress::Progress;
    use crate::base::sampling::{uniform, uniform_sphere};
    use crate::bvh::{BuildOptions, BuildQuality};
    use crate::device::{Device, DeviceOptions};
    use crate::scene::{Material, Mesh, MeshMaterials, NONE, SceneData, Texture};
    use crate::simd::Isa;
    use crate::trace::Hit;
    use glam::Vec2;
    use std::sync::Arc;

    const WHOLE: BuildOptions =
        BuildOptions { bins: 64, max_leaf: 4, quality: BuildQuality::Default, split_budget: 0.25, compact: false };

    /// On every ISA: trees whole and compact, of whole triangles and of cut ones.
    fn scenes(data: &SceneData) -> Vec<Arc<Scene>> {
        let split = BuildOptions { quality: BuildQuality::High, split_budget: 2.0, ..WHOLE };
        let builds = [WHOLE, BuildOptions { compact: true, ..WHOLE }, split, BuildOptions { compact: true, ..split }];
        let commit = |(isa, build): (Isa, &BuildOptions)| {
            let options = DeviceOptions { isa: Some(isa), num_threads: 1, ..Default::default() };
            let device = Device::new(options).unwrap();
            Scene::commit(&device, data.clone(), build, &Progress::none()).map_err(|e| e.1).unwrap()
        };
        Isa::available().flat_map(|isa| builds.iter().map(move |b| (isa, b))).map(commit).collect()
    }

    fn soup(n: u32, seed: u32, material: u32) -> Mesh {
        let point = |i: u32, d: u32| Vec3::from_array([0, 1, 2].map(|a| uniform(i, d + a, seed))) * 2.0 - 1.0;
        let corners = |i: u32| {
            let a = point(i, 0);
            [a, a + 0.5 * point(i, 3), a + 0.5 * point(i, 6)]
        };
        Mesh {
            positions: (0..n).flat_map(corners).collect(),
            indices: (0..n).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect(),
            uvs: (0..3 * n).map(|i| Vec2::new(uniform(i, 9, seed), uniform(i, 10, seed)) * 3.0).collect(),
            materials: MeshMaterials::One(material),
            ..Default::default()
        }
    }

    /// A square around the z axis from −1 to 1; u = x and v = y.
    fn square(z: f32, material: u32) -> Mesh {
        let positions = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]].map(|[x, y]| Vec3::new(x, y, z));
        Mesh {
            uvs: positions.iter().map(|p| p.truncate()).collect(),
            positions: positions.to_vec().into(),
            indices: vec![[0, 1, 2], [0, 2, 3]].into(),
            materials: MeshMaterials::One(material),
            ..Default::default()
        }
    }

    /// Alpha 0 at u = 1/4, 1 at u = 3/4 and in proportion between: below one half where u is in (0, 1/2).
    fn stripes() -> Texture {
        Texture { width: 2, height: 1, rgba8: vec![[255, 255, 255, 0], [255; 4]] }
    }

    fn cutout(data: &mut SceneData, texture: Texture) -> u32 {
        let albedo_texture = data.add_texture(texture).unwrap();
        data.add_material(Material { albedo_texture, alpha_cutoff: 0.5, ..Default::default() }).unwrap()
    }

    fn bits(h: &Hit) -> [u32; 5] {
        [h.t.to_bits(), h.u.to_bits(), h.v.to_bits(), h.triangle, h.mesh]
    }

    /// The answers of all queries, checked to be the same.
    fn answers(scene: &Scene, rays: &[Ray]) -> Vec<([u32; 5], bool)> {
        let (mut hits, mut occluded) = (vec![Hit::MISS; rays.len()], vec![2; rays.len()]);
        scene.intersect_many(rays, false, &mut hits).unwrap();
        scene.occluded_many(rays, false, &mut occluded).unwrap();
        for (ray, (hit, o)) in rays.iter().zip(hits.iter().zip(&occluded)) {
            let alone = scene.intersect(ray);
            assert_eq!((bits(&alone), scene.occluded(ray) as u8), (bits(hit), *o), "{ray:?}");
            let mut gathered = [Hit::MISS];
            scene.gather(ray.origin.into(), &[ray.direction], ray.tmax, false, &mut gathered).unwrap();
            assert_eq!(bits(&gathered[0]), bits(hit));
        }
        hits.iter().map(bits).zip(occluded.iter().map(|&o| o == 1)).collect()
    }

    /// Rays from one origin, as bundles, and from many origins.
    fn rays(seed: u32) -> Vec<Ray> {
        let direction = |i: u32| uniform_sphere([uniform(i, 0, seed), uniform(i, 1, seed)]);
        let narrow = |i: u32| Vec3::new(uniform(i, 0, seed), uniform(i, 1, seed), -8.0) * 0.3;
        let origin = |i: u32| 2.0 * uniform_sphere([uniform(i, 2, seed), uniform(i, 3, seed)]);
        let bundle = (0..300).map(|i| Ray::new(Vec3::new(-0.3, -0.3, 2.5), narrow(i)));
        let others = (0..900).map(|i| {
            let ray = Ray::new(origin(i), direction(i) - 0.5 * origin(i));
            if i % 5 == 0 { ray.within(0.0, 1.5) } else { ray }
        });
        bundle.chain(others).collect()
    }

    #[test]
    fn surfaces_that_are_all_holes_change_no_bit_of_any_answer() {
        let (mut without, rays) = (SceneData::new(), rays(1));
        let solid = without.add_material(Material::default()).unwrap();
        without.add_mesh(soup(150, 2, solid)).unwrap();
        let mut with = without.clone();
        let hole = cutout(&mut with, Texture { width: 1, height: 1, rgba8: vec![[255, 255, 255, 127]] });
        with.add_mesh(soup(150, 3, hole)).unwrap();
        // Also where solid triangles are.
        with.add_mesh(soup(150, 2, hole)).unwrap();
        let mut met = 0;
        for (with, without) in scenes(&with).iter().zip(scenes(&without)) {
            let expected = answers(&without, &rays);
            assert_eq!(answers(with, &rays), expected);
            met = expected.iter().filter(|(_, o)| *o).count();
        }
        assert!((300..1100).contains(&met), "{met}");
    }

    #[test]
    fn holes_are_where_the_image_is_less_opaque_than_the_cutoff() {
        let mut data = SceneData::new();
        let solid = data.add_material(Material::default()).unwrap();
        let grate = cutout(&mut data, stripes());
        for z in [0.0, 0.5] {
            data.add_mesh(square(z, grate)).unwrap();
        }
        data.add_mesh(square(-1.0, solid)).unwrap();
        let is_hole = |x: f32| (x - x.floor()) < 0.5;
        for scene in scenes(&data) {
            let mut through = 0;
            for i in 0..2000 {
                let (x, y, slope) =
                    (uniform(i, 0, 7) * 1.8 - 0.9, uniform(i, 1, 7) * 1.8 - 0.9, uniform(i, 2, 7) - 0.5);
                // At x where z = 0.
                let ray = Ray::new(Vec3::new(x + slope, y, 1.0), Vec3::new(-slope, 0.0, -1.0));
                let at = |z: f32| x + slope * z;
                if [at(0.0), at(0.5)].iter().any(|x| (2.0 * x - (2.0 * x).round()).abs() < 1e-4 || x.abs() > 1.0) {
                    continue;
                }
                let expected = if !is_hole(at(0.5)) {
                    (1, 0.5)
                } else if !is_hole(at(0.0)) {
                    (0, 1.0)
                } else if at(-1.0).abs() < 1.0 {
                    (2, 2.0)
                } else {
                    (NONE, f32::INFINITY)
                };
                let hit = scene.intersect(&ray);
                assert_eq!((hit.mesh, hit.t), expected, "{ray:?}");
                assert_eq!(scene.occluded(&ray.within(0.0, 1.5)), expected.1 < 1.5);
                // Light sees what rays see, and from behind it is the same.
                assert_eq!(scene.transmittance(&ray.within(0.0, 1.5)) == Vec3::ONE, expected.1 > 1.5);
                let back = Ray::new(Vec3::new(at(-0.9), y, -0.9), Vec3::new(slope, 0.0, 1.0));
                assert_eq!(scene.occluded(&back), expected.1 < 1.5);
                through += (expected.0 == 2) as u32;
            }
            assert!(through > 200, "{through}");
        }
    }

    #[test]
    fn a_grate_on_a_wall_does_not_let_rays_through_the_wall() {
        // The grate before and after the wall in number: of equal distances the lowest number wins.
        for grate_first in [true, false] {
            let mut data = SceneData::new();
            let solid = data.add_material(Material::default()).unwrap();
            let grate = cutout(&mut data, stripes());
            for material in if grate_first { [grate, solid] } else { [solid, grate] } {
                data.add_mesh(square(0.0, material)).unwrap();
            }
            for scene in scenes(&data) {
                for i in 0..500 {
                    let (x, y) = (uniform(i, 0, 9) * 1.9 - 0.95, uniform(i, 1, 9) * 1.9 - 0.95);
                    let ray = Ray::new(Vec3::new(x, y, 1.0), Vec3::NEG_Z);
                    let hit = scene.intersect(&ray);
                    let is_hole = (x - x.floor()) < 0.5;
                    assert_eq!((hit.t, hit.mesh), (1.0, (grate_first && is_hole) as u32), "{x}");
                    assert!(scene.occluded(&ray));
                }
            }
        }
    }

    /// Spatial splits put a triangle into several leaves, which a ray passes one after the other.
    #[test]
    fn sheets_count_once_however_a_tree_cuts_them() {
        let mut data = SceneData::new();
        let glass = Material { albedo: [0.1; 3], transmission: [0.9, 0.8, 0.7], ..Default::default() };
        let glass = data.add_material(glass).unwrap();
        data.add_mesh(soup(150, 2, glass)).unwrap();
        let scenes = scenes(&data);
        let passed = |scene: &Scene| rays(1).iter().map(|r| scene.transmittance(r)).collect::<Vec<_>>();
        let expected = passed(&scenes[0]);
        assert!(expected.iter().filter(|t| t.x < 0.8).count() > 100);
        for scene in &scenes {
            assert_eq!(passed(scene), expected);
        }
    }

    #[test]
    fn sheets_multiply_and_what_is_opaque_ends_it() {
        let (a, b) = (Vec3::new(0.8, 0.1, 0.5), Vec3::new(0.3, 0.6, 0.0));
        let mut data = SceneData::new();
        let mut sheet =
            |t: Vec3| data.add_material(Material { albedo: [0.1; 3], transmission: t.into(), ..Default::default() });
        let (first, second) = (sheet(a).unwrap(), sheet(b).unwrap());
        let solid = data.add_material(Material::default()).unwrap();
        // Two at the same place; their diagonals are met too.
        for (z, material) in [(0.0, first), (0.0, second), (0.5, first), (-1.0, solid)] {
            data.add_mesh(square(z, material)).unwrap();
        }
        for scene in scenes(&data) {
            for i in 0..400 {
                let x = uniform(i, 0, 9) * 1.9 - 0.95;
                let y = if i % 2 == 0 { x } else { uniform(i, 1, 9) * 1.9 - 0.95 };
                // Directions of other lengths, which kernels scale.
                let length = [1.0, 1e10, 1e-10][i as usize % 3];
                let ray = |from: f32, to: f32| {
                    Ray::new(Vec3::new(x, y, from), Vec3::Z * (to - from) * length).within(0.0, 1.0 / length)
                };
                assert_eq!(scene.transmittance(&ray(1.0, 0.7)), Vec3::ONE);
                assert_eq!(scene.transmittance(&ray(1.0, 0.2)), a);
                assert_eq!(scene.transmittance(&ray(0.2, 1.0)), a);
                assert_eq!(scene.transmittance(&ray(0.2, -0.5)), a * b);
                assert_eq!(scene.transmittance(&ray(-0.5, 1.0)), a * b * a);
                assert_eq!(scene.transmittance(&ray(1.0, -1.5)), Vec3::ZERO);
                assert!(scene.occluded(&ray(1.0, 0.2)), "geometry is met");
                let mut crossings = Vec::new();
                let hit = scene.intersect_through(&ray(1.0, -1.5), &mut crossings);
                assert_eq!(scene.material_id(hit.triangle), solid);
                let passed: Vec<u32> = crossings.iter().map(|c| scene.material_id(c.hit.triangle)).collect();
                assert_eq!(passed, [first, first, second]);
                assert!((crossings[0].hit.t * length - 0.2).abs() < 1e-6 && crossings[0].hit.front);
            }
        }
    }
}
