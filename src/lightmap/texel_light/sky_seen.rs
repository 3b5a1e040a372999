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
use crate::base::sampling::{combine, cosine_hemisphere, orthonormal_basis, uniform};
use crate::direct::guide::{BINS, Guide};
use crate::lightmap::atlas::chart_map::ChartMap;
use crate::lightmap::atlas::ids::{Map, PlacementId, RadianceMap, RadianceTexel, TexelId};
use crate::scene::Scene;
use crate::trace::Ray;

/// Radiance texels to each side of a texel by which it is guided.
const REACH: i32 = 4;

/// Guides of a tile of texels, which lie in few texels of the radiance map: of 2 × 2 of them, by the last bits of their
/// columns and rows.
#[derive(Clone, Copy, Default)]
pub(super) struct Guides([Option<(PlacementId, [i32; 2], Option<Guide>)>; 4]);

impl Guides {
    /// Returns the guide of a texel, on its back if so said; `None` if its surroundings see the sky nowhere, or everywhere,
    /// or if shadow rays are not guided. Adds the rays traced to `rays`.
    pub(super) fn of<M: Map>(
        &mut self,
        light: &TexelLight<M>,
        (texel, back): (TexelId<M>, bool),
        rays: &mut u64,
    ) -> Option<Guide> {
        let (map, seen) = (light.sky_from?, light.direct.sky_seen()?);
        let (own, areas) = (&light.areas.map[texel], &light.areas);
        let placement = map.layout.place_of(areas.charts.chart_of(own.triangle), !back);
        let at = map.layout.texel_coord(placement, areas.charts.local(own.triangle, own.u, own.v));
        let [x, y] = at.map(|v| v.floor() as i32);
        let kept = &mut self.0[(x & 1 | (y & 1) << 1) as usize];
        if let Some((of, place, guide)) = kept
            && (*of, *place) == (placement, [x, y])
        {
            return *guide;
        }
        let around = (-REACH..=REACH).flat_map(|dy| (-REACH..=REACH).map(move |dx| (x + dx, y + dy)));
        let texels = around.filter_map(|(x, y)| map.at(placement, x, y));
        let guide = Guide::new(texels.map(|near| seen.from(near.index(), rays, || look(areas.scene, map, near))));
        *kept = Some((placement, [x, y], guide));
        guide
    }
}

/// Looks from a texel into each bin.
fn look(scene: &Scene, map: &ChartMap<RadianceMap>, texel: RadianceTexel) -> u64 {
    let (_, receiver) = map.receiver(scene, texel, map.is_back(texel));
    let seed = combine(map.seed(texel), 34);
    let (t, b) = orthonormal_basis(receiver.normal);
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
