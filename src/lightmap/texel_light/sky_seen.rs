//! From where the sky is seen: what guides the shadow rays to it.
//!
//! From each texel of the radiance map one ray goes through each bin of a [guide](crate::direct::guide), and a bit says
//! whether it leaves the scene. Points of a texel, of whatever map, are guided by the radiance texels around it on the same
//! side of its chart. These are looked from when a texel asks for them first, and what they see depends on the atlas alone:
//! bakes, shards, edits and live updates have the same bits. The rays are no samples of the light, which would depend on the
//! guide.
//!
//! Measured: docs/experiments.md#shadow-rays-guided-to-the-sky.

use super::TexelLight;
use crate::base::error::Result;
use crate::base::sampling::{combine, cosine_hemisphere, uniform};
use crate::direct::DirectLight;
use crate::direct::guide::{BINS, FEW, Guide, SkySeen, frame};
use crate::lightmap::atlas::Atlas;
use crate::lightmap::atlas::chart_map::ChartMap;
use crate::lightmap::atlas::ids::{Map, PlacementId, RadianceMap, RadianceTexel, TexelId};
use crate::scene::Scene;
use crate::trace::Ray;

/// Radiance texels to each side of a texel by which it is guided.
const REACH: i32 = 4;

impl Atlas {
    /// Makes room for what is seen of the sky, if there is one. It is kept for the next bakes, and for live updates.
    pub(crate) fn make_room_for_sky_seen(&self, direct: &DirectLight) -> Result<()> {
        if direct.sky_count() > 0 && self.sky_seen.get().is_none() {
            // (Another thread may have made it meanwhile.)
            let _ = self.sky_seen.set(SkySeen::new(self.radiance.len(), self.scene.device().memory())?);
        }
        Ok(())
    }
}

/// The guide at a texel of the radiance map.
#[derive(Clone, Copy)]
struct Kept {
    placement: PlacementId,
    at: [i32; 2],
    guide: Option<Guide>,
}

/// Guides of a tile of texels, which lie in few texels of the radiance map: of 2 × 2 of them, by the last bits of their
/// columns and rows.
#[derive(Clone, Copy, Default)]
pub(super) struct Guides([Option<Kept>; 4]);

impl Guides {
    /// Returns the guide of a texel, on its back if so said; `None` if its surroundings [have none](Guide::new), or if shadow
    /// rays are not guided. Adds the rays traced to `rays`.
    pub(super) fn of<M: Map>(
        &mut self,
        light: &TexelLight<M>,
        (texel, back): (TexelId<M>, bool),
        rays: &mut u64,
    ) -> Option<Guide> {
        let atlas = light.sky_from.filter(|_| light.direct.sky_count() > 0)?;
        let (map, seen) = (&atlas.radiance, atlas.sky_seen.get()?);
        let (own, areas) = (&light.areas.map[texel], &light.areas);
        let placement = map.layout.place_of(areas.charts.chart_of(own.triangle), !back);
        let at = map.layout.texel_coord(placement, areas.charts.local(own.triangle, own.u, own.v));
        let [x, y] = at.map(|v| v.floor() as i32);
        let kept = &mut self.0[(x & 1 | (y & 1) << 1) as usize];
        if let Some(kept) = kept.filter(|kept| (kept.placement, kept.at) == (placement, [x, y])) {
            return kept.guide;
        }
        let around = (-REACH..=REACH).flat_map(|dy| (-REACH..=REACH).map(move |dx| (dx, dy)));
        let near = |(dx, dy): (i32, i32)| Some((map.at(placement, x + dx, y + dy)?, dx.abs().max(dy.abs()) <= 1));
        let texels = around.filter_map(near);
        let look_from = |t: RadianceTexel, rays: &mut u64| seen.from(t.index(), rays, || look(areas.scene, map, t));
        let guide = match texels.clone().nth(FEW) {
            Some(_) => Guide::new(texels.map(|(texel, is_near)| (look_from(texel, rays), is_near))),
            None => None,
        };
        *kept = Some(Kept { placement, at: [x, y], guide });
        guide
    }
}

/// Looks from a texel into each bin.
fn look(scene: &Scene, map: &ChartMap<RadianceMap>, texel: RadianceTexel) -> u64 {
    let (_, receiver) = map.receiver(scene, texel, map.is_back(texel));
    let seed = combine(map.seed(texel), 34);
    let (t, b) = frame(receiver.normal);
    let mut rays = [Ray::new(receiver.shadow_origin, receiver.normal); BINS];
    let mut hidden = [0u8; BINS];
    for (bin, (ray, hidden)) in (0..).zip(rays.iter_mut().zip(&mut hidden)) {
        let place = |k: u32| ((bin >> (3 * k) & 7) as f32 + uniform(bin, k, seed)) / 8.0;
        let d = cosine_hemisphere([place(0), place(1)]);
        let direction = t * d.x + b * d.y + receiver.normal * d.z;
        *ray = Ray::new(receiver.shadow_origin, direction);
        *hidden = u8::from(!receiver.faces(direction));
    }
    occluded(scene, &rays, &mut hidden);
    hidden.iter().enumerate().fold(0, |bits, (bin, &hidden)| bits | u64::from(hidden == 0) << bin)
}

/// Marks the rays that something occludes.
fn occluded(scene: &Scene, rays: &[Ray; BINS], hidden: &mut [u8; BINS]) {
    if scene.uses().transmission {
        for (ray, hidden) in rays.iter().zip(hidden) {
            *hidden |= u8::from(*hidden == 0 && scene.transmittance(ray).max_element() <= 0.0);
        }
        return;
    }
    let mut out = [0; BINS];
    scene.occluded_stream(rays, &mut out);
    hidden.iter_mut().zip(out).for_each(|(hidden, out)| *hidden |= out);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::progress::Progress;
    use crate::lightmap::atlas::ids::LightMap;
    use crate::lightmap::{BakeParams, Lightmap, LightmapDesc};
    use crate::scene::demo::shapes::MeshBuilder;
    use crate::scene::{Light, Material, NONE, SceneData};
    use glam::Vec3;

    /// A room of 4 × 4 × 3 m, its floor and walls of two triangles each, with a window of 0.4 m² high up in one of them.
    fn room(lit: bool) -> Lightmap {
        let mut data = SceneData::new();
        let m = data.add_material(Material { albedo: [0.5; 3], ..Default::default() }).unwrap();
        let mut walls = MeshBuilder::new();
        let p = |x: f32, y: f32, z: f32| Vec3::new(x, y, z);
        let mut quad = |a, b, c, d| walls.quad(a, b, c, d, m);
        quad(p(0., 0., 0.), p(4., 0., 0.), p(4., 4., 0.), p(0., 4., 0.));
        quad(p(0., 0., 3.), p(0., 4., 3.), p(4., 4., 3.), p(4., 0., 3.));
        quad(p(0., 0., 0.), p(0., 4., 0.), p(0., 4., 3.), p(0., 0., 3.));
        quad(p(0., 0., 0.), p(0., 0., 3.), p(4., 0., 3.), p(4., 0., 0.));
        quad(p(0., 4., 0.), p(4., 4., 0.), p(4., 4., 3.), p(0., 4., 3.));
        for (y, z) in [([0., 4.], [0., 2.]), ([0., 4.], [2.8, 3.]), ([0., 1.8], [2., 2.8]), ([2.3, 4.], [2., 2.8])] {
            quad(p(4., y[0], z[0]), p(4., y[0], z[1]), p(4., y[1], z[1]), p(4., y[1], z[0]));
        }
        data.add_mesh(walls.finish()).unwrap();
        let radiance = if lit { [1.0; 3] } else { [0.0; 3] };
        data.add_light(Light::Sky { radiance, environment: NONE, up: Vec3::Z, rotation: 0.0 }).unwrap();
        data.add_light(Light::Point { position: p(2., 2., 1.), intensity: [0.01; 3] }).unwrap();
        let desc = LightmapDesc { texels_per_unit: 10.0, page_size: 256, ..Default::default() };
        Lightmap::create(&data.committed(), &desc, &Progress::none()).unwrap()
    }

    #[test]
    fn texels_of_a_room_are_guided_to_its_window_and_look_once() {
        let lightmap = room(true);
        let atlas = lightmap.atlas();
        let direct = DirectLight::new(&atlas.scene);
        atlas.make_room_for_sky_seen(&direct).unwrap();
        let light = TexelLight {
            areas: atlas.areas(&atlas.map),
            direct: &direct,
            samples: 16,
            seed: 1,
            sky_from: Some(&**atlas),
        };
        let (mut guided, mut rays) = (0, 0);
        for texel in atlas.map.all() {
            let guide = Guides::default().of::<LightMap>(&light, (texel, false), &mut rays);
            guided += usize::from(guide.is_some());
        }
        let looked = rays;
        assert!(guided > atlas.map.len() / 2, "{guided} of {}", atlas.map.len());
        assert!(looked > 0 && looked <= (BINS * atlas.radiance.len()) as u64);
        for texel in atlas.map.all() {
            Guides::default().of::<LightMap>(&light, (texel, false), &mut rays);
        }
        assert_eq!(rays, looked, "what has been seen is not looked at again");
    }

    #[test]
    fn direct_light_of_a_room_has_little_noise_and_as_much_light() {
        let mut lightmap = room(true);
        let mut light = |direct_samples, seed| {
            let params = BakeParams { direct_samples, seed, blur_radius: 0, gather_rays: 0, ..Default::default() };
            lightmap.bake(&params, &Progress::none()).unwrap();
            lightmap.light.as_ref().unwrap().direct.iter().map(|e| f64::from(e.x)).collect::<Vec<_>>()
        };
        let truth = light(2048, 5);
        let seeds: Vec<Vec<f64>> = (0..6).map(|seed| light(16, seed)).collect();
        let sum = |of: &[f64]| of.iter().sum::<f64>();
        let kept = seeds.iter().map(|v| sum(v)).sum::<f64>() / (6.0 * sum(&truth));
        assert!((kept - 1.0).abs() < 0.02, "{kept}");
        let lit =
            |v: &[f64]| v.iter().zip(&truth).filter(|(_, t)| **t > 0.0).map(|(e, t)| (e / t - 1.0).abs()).collect();
        let mut errors: Vec<f64> = seeds.iter().flat_map(|v| -> Vec<f64> { lit(v) }).collect();
        errors.sort_by(f64::total_cmp);
        // Without guides most texels have no ray to the window, and so an error of 1.
        let median = errors[errors.len() / 2];
        assert!(median < 0.5, "{median}");
    }

    #[test]
    fn without_a_sky_nobody_looks() {
        let mut lightmap = room(false);
        lightmap.bake(&BakeParams::default(), &Progress::none()).unwrap();
        assert!(lightmap.atlas().sky_seen.get().is_none());
    }
}
