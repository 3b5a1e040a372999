//! Texels of the radiance map that lie on both sides of a wall.
//!
//! A texel shows one value. Where a wall stands on a floor that goes on behind it, as floors of buildings do below outer
//! walls, the texels below the wall have the light of one side, or some of both, and gather rays that hit them on the
//! other side would see the sun through the wall. If [near hits](super::near_hits) are computed by short paths, these are
//! too, from however far away.
//!
//! Such texels are found where a line of sight is blocked to a neighbour that has very different light, or, at borders of
//! charts, where there may be no neighbour to compare with, to another point of the texel itself with different direct
//! light.
//!
//! Measured: docs/experiments.md#texels-on-both-sides-of-a-wall.

use super::radiance_map::Radiance;
use super::texel_set::TexelSet;
use crate::base::error::Result;
use crate::base::memory::{try_collect, try_par_gather, try_push};
use crate::base::progress::Progress;
use crate::direct::{DirectLight, Receiver};
use crate::lightmap::atlas::Atlas;
use crate::lightmap::atlas::chart_map::receiver_of;
use crate::lightmap::atlas::ids::{RadianceMap, RadianceTexel};
use crate::lightmap::texel_light::TexelAreas;
use crate::trace::Ray;
use std::f32::consts::PI;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// The light of neighbours is very different if one has more than this many times the other's.
const CONTRAST: f32 = 4.0;

/// Direct light differs within a texel if the radiance that it makes differs by more than this fraction of the texel's.
const DIFFERENCE: f32 = 0.5;

/// Maximum number of points of a texel that are looked for behind a wall, and number of samples of the direct light of one.
const POINTS: u32 = 16;
const SAMPLES: u32 = 4;

/// Height of lines of sight above the surface, in widths of a texel.
const ABOVE: f32 = 0.125;

/// Number of texels that a thread takes at a time.
const BLOCK: usize = 1024;

/// Name of the buffers in error messages.
const SPLIT: &str = "texels on both sides of a wall";

/// Finds the texels of a complete radiance map that lie on both sides of a wall. Adds the rays traced to `rays`. To be
/// called on the device's threads.
pub(crate) fn find(
    atlas: &Atlas,
    radiance: &Radiance,
    direct: &DirectLight,
    rays: &mut u64,
    progress: &Progress,
) -> Result<TexelSet<RadianceMap>> {
    let look = Look { atlas, areas: atlas.areas(&atlas.radiance), radiance, direct };
    let (traced, count) = (AtomicU64::new(0), atlas.radiance.len());
    let found = try_par_gather(count.div_ceil(BLOCK), SPLIT, |block, out: &mut Vec<u32>| {
        progress.check()?;
        let mut rays = 0;
        for texel in RadianceTexel::range(block * BLOCK..count.min((block + 1) * BLOCK)) {
            if look.is_split(texel, &mut rays) {
                try_push(out, texel.index() as u32, SPLIT)?;
            }
        }
        traced.fetch_add(rays, Relaxed);
        Ok(())
    })?;
    *rays += traced.into_inner();
    let found = try_collect(found.iter().map(|&i| RadianceTexel::new(i as usize)), SPLIT)?;
    TexelSet::new(found.iter(), count, SPLIT)
}

struct Look<'a> {
    atlas: &'a Atlas,
    areas: TexelAreas<'a, RadianceMap>,
    radiance: &'a Radiance,
    direct: &'a DirectLight,
}

impl Look<'_> {
    #[inline(never)]
    fn is_split(&self, texel: RadianceTexel, rays: &mut u64) -> bool {
        let (map, scene) = (&self.atlas.radiance, &self.atlas.scene);
        let placement = map.texels.placement_of(texel.index() as u32);
        let scale = map.layout[placement].scale;
        let above = ABOVE / scale[0].min(scale[1]);
        let back = map.is_back(texel);
        let own = map.receiver(scene, texel, back).1;
        let mut is_hidden = |other: &Receiver| {
            *rays += 1;
            let [from, to] = [&own, other].map(|r| r.origin + above * r.geometric);
            scene.occluded(&Ray::new(from, to - from).within(0.0, 1.0))
        };
        let value = |texel: RadianceTexel| self.radiance.values[texel.index()].element_sum();
        let (neighbours, own_value) = (self.areas.neighbours(texel), value(texel));
        for near in neighbours.into_iter().flatten() {
            let (a, b) = (own_value, value(near));
            if a.max(b) > CONTRAST * a.min(b) && is_hidden(&map.receiver(scene, near, back).1) {
                return true;
            }
        }
        if neighbours.iter().all(Option::is_some) {
            return false;
        }
        let seed = map.seed_in(placement, texel);
        let behind = (0..POINTS).find_map(|i| {
            let point = self.areas.point(texel, i, seed)?;
            let other = receiver_of(scene, &point, back).1;
            is_hidden(&other).then_some((point, other))
        });
        let Some((point, other)) = behind else { return false };
        let albedo = scene.albedo(point.triangle, point.u, point.v);
        let [here, there] = [&own, &other].map(|r| {
            let irradiance = self.direct.irradiance(r, SAMPLES, seed, rays);
            (albedo * irradiance).element_sum() / PI
        });
        (here - there).abs() > DIFFERENCE * own_value
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lightmap::{BakeParams, Lightmap, LightmapDesc};
    use crate::scene::demo::shapes::MeshBuilder;
    use crate::scene::{Light, Material, SceneData};
    use glam::Vec3;

    /// Light that reaches the inside of a closed box in the sun, whose floor goes on for 7 cm behind its walls, as a sum over
    /// texels near the foot of the walls, and the number of those texels; and whether the map has texels on both sides of a wall.
    fn light_inside(near_hits: f32) -> (f32, usize, bool) {
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
        let params = BakeParams { near_hits, photon_count: 100_000, ..Default::default() };
        lightmap.bake(&params, &Progress::none()).unwrap();
        let (atlas, light) = (lightmap.atlas(), lightmap.light.as_ref().unwrap());
        let of_walls = atlas.map.all().filter(|&texel| {
            let y = atlas.map.surface(&atlas.scene, texel).0.y;
            atlas.map[texel].triangle < 12 && y > 0.05 && y < 1.0
        });
        let (mut sum, mut count) = (0.0, 0);
        of_walls.for_each(|texel| (sum, count) = (sum + light.indirect[texel.index()].x, count + 1));
        (sum, count, !light.radiance.split.is_empty())
    }

    #[test]
    fn the_sun_does_not_shine_below_walls() {
        let (without, count, found) = light_inside(0.0);
        assert!(count > 1000 && !found && without > 0.01 * count as f32, "{without} {count}");
        let (with, _, found) = light_inside(0.01);
        println!("{with} instead of {without}");
        assert!(found && with < 0.1 * without, "{with} {without}");
    }
}
