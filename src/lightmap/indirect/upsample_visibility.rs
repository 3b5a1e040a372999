//! Finds texels of the gather map that are behind walls or across creases.
//!
//! If a wall stands on a floor, a texel of the light map may lie on one side of it and some of the surrounding gather
//! texels on the other. Gather texels that are occluded, as seen from a little above the surface, are left out, and so
//! are those whose normals differ much from the texel's own, as on either side of a fold. (Probes behind walls are left
//! out in a similar way in Majercik, Guertin, Nowrouzezahrai and McGuire, *Dynamic Diffuse Global Illumination with
//! Ray-Traced Irradiance Fields*, 2019.)
//!
//! Measured: docs/experiments.md#walls-and-creases.

use super::sights::Sights;
use crate::base::error::Result;
use crate::base::memory::{try_collect, try_filled, try_push, try_with_capacity};
use crate::base::progress::Stage;
use crate::lightmap::atlas::Atlas;
use crate::lightmap::atlas::chart_map::ChartMap;
use crate::lightmap::atlas::ids::{GatherTexel, LightMap, LightTexel, PlacementId, ShownMap, TexelId, TexelRange};
use crate::lightmap::tiles::places_in_order;
use crate::scene::{NONE, Scene};
use crate::trace::Ray;
use glam::Vec3;

/// Number of texels of a placement between two checks for a cancel.
pub(in crate::lightmap) const TEXELS_PER_CHECK: usize = 64;

/// Height above the surface at which lines of sight between texels start and end, in texels of the gather map.
const ABOVE: f32 = 0.125;

/// Cosine of the angle between normals below which two texels lie on different sides of a crease.
const CREASE: f32 = 0.8;

/// Number of pairs of texels that are decided together.
const PAIRS: usize = 4096;

/// Name of the buffers in error messages.
const WALLS: &str = "texels behind walls";

/// End of a texel's lines of sight, and its normal.
#[derive(Clone, Copy)]
struct Eye {
    position: Vec3,
    normal: Vec3,
}

impl Eye {
    fn at<M: ShownMap>(atlas: &Atlas, map: &ChartMap<M>, backs: &[bool], texel: TexelId<M>, above: f32) -> Eye {
        let receiver = atlas.receiver(map, backs, texel);
        Eye { position: receiver.origin + receiver.geometric * above, normal: receiver.normal }
    }

    fn ray_to(self, other: Eye) -> Ray {
        Ray::new(self.position, other.position - self.position).within(0.0, 1.0)
    }
}

/// Returns the pairs of texels of a placement in the light map and in the gather map between which there is a wall or a
/// crease, in ascending order. `backs` says which charts without separate texels for their backs show the back. Adds
/// the rays traced to `rays`; `stage` may cancel.
pub(in crate::lightmap) fn between(
    atlas: &Atlas,
    placement: PlacementId,
    backs: &[bool],
    stage: &Stage,
    rays: &mut u64,
) -> Result<Vec<(LightTexel, GatherTexel)>> {
    let (gather, map) = (&atlas.gather, &atlas.map);
    let scale = gather.layout[placement].scale;
    let above = ABOVE / scale[0].min(scale[1]);
    let own = gather.texels_of(placement);
    let mut eyes: Vec<Eye> = try_with_capacity(own.len(), WALLS)?;
    for (i, texel) in own.clone().enumerate() {
        if i % TEXELS_PER_CHECK == 0 {
            stage.check()?;
        }
        eyes.push(Eye::at(atlas, gather, backs, texel, above));
    }
    let eye_of = |s: GatherTexel| eyes[own.place(s)];
    let mut groups = Groups::find(atlas, placement, stage)?;
    let mut sights = Sights::default();
    let firsts: Vec<GatherTexel> = try_collect(groups.all.iter().map(|group| group.around[0]), WALLS)?;
    let order = places_in_order(gather, &firsts)?;
    for (number, i) in order.iter().map(|&i| i as usize).enumerate() {
        let Group { around, is_split } = &mut groups.all[i];
        let around = in_use(around);
        // Most groups of gather texels surround many texels, and are on one side. A group of a single gather texel, as
        // on narrow charts, says nothing about the texel.
        let pairs =
            || (1..around.len()).flat_map(|i| (0..i).map(move |j| [i, j])).map(|of| of.map(|i| eye_of(around[i])));
        *is_split = around[0] == around[around.len() - 1] || pairs().any(|[a, b]| are_across(a, b));
        if !*is_split {
            pairs().try_for_each(|[a, b]| sights.push(a.ray_to(b), i as u32))?;
        }
        if sights.is_full() || number + 1 == order.len() {
            stage.check()?;
            sights.trace(&atlas.scene, rays, |i, is_hidden| groups.all[i as usize].is_split |= is_hidden)?;
        }
    }
    let mut normals = LastNormal::default();
    // Pairs of which some are not known to be apart before the lines of sight are traced.
    let mut pairs: Vec<(LightTexel, GatherTexel, bool)> = Vec::new();
    let mut found = Vec::new();
    let mut flush = |pairs: &mut Vec<(LightTexel, GatherTexel, bool)>, sights: &mut Sights| {
        stage.check()?;
        sights.trace(&atlas.scene, rays, |i, is_hidden| pairs[i as usize].2 |= is_hidden)?;
        let apart = pairs.iter().filter(|(.., are_apart)| *are_apart);
        apart.into_iter().try_for_each(|&(texel, s, _)| try_push(&mut found, (texel, s), WALLS))?;
        pairs.clear();
        Ok(())
    };
    let of_map = map.texels_of(placement);
    for (texels, group) in groups.runs(&of_map) {
        let around = in_use(&group.around);
        for texel in texels {
            if group.is_split {
                let from = Eye::at(atlas, map, backs, texel, above);
                for &s in around {
                    let are_apart = are_across(from, eye_of(s));
                    if !are_apart {
                        sights.push(from.ray_to(eye_of(s)), pairs.len() as u32)?;
                    }
                    try_push(&mut pairs, (texel, s, are_apart), WALLS)?;
                }
            } else {
                let normal = normals.of(&atlas.scene, map[texel].triangle, || atlas.receiver(map, backs, texel).normal);
                if normal.dot(eye_of(around[0]).normal) < CREASE {
                    around.iter().try_for_each(|&s| try_push(&mut pairs, (texel, s, true), WALLS))?;
                }
            }
        }
        if pairs.len() >= PAIRS {
            flush(&mut pairs, &mut sights)?;
        }
    }
    flush(&mut pairs, &mut sights)?;
    Ok(found)
}

/// Whether a crease lies between two texels.
fn are_across(a: Eye, b: Eye) -> bool {
    a.normal.dot(b.normal) < CREASE
}

/// The gather texels around texels of the light map.
struct Group {
    /// In ascending order; the rest, if there are fewer, is [`GatherTexel::NONE`].
    around: [GatherTexel; 4],
    /// Whether something separates some of them.
    is_split: bool,
}

/// Returns the gather texels of a group.
fn in_use(around: &[GatherTexel; 4]) -> &[GatherTexel] {
    &around[..around.iter().filter(|&&s| s != GatherTexel::NONE).count()]
}

/// The groups of a placement. (Some are there several times.)
struct Groups {
    all: Vec<Group>,
    /// The first of consecutive texels with the same group, as its place in the placement, and the group; the number of
    /// groups stands for none.
    begins: Vec<[u32; 2]>,
}

impl Groups {
    fn find(atlas: &Atlas, placement: PlacementId, stage: &Stage) -> Result<Groups> {
        let own = atlas.gather.texels_of(placement);
        // The last group that begins with each gather texel.
        let mut last_of = try_filled(own.len(), NONE, WALLS)?;
        let mut groups = Groups { all: Vec::new(), begins: Vec::new() };
        let mut last = None;
        for (i, texel) in atlas.map.texels_of(placement).enumerate() {
            if i % TEXELS_PER_CHECK == 0 {
                stage.check()?;
            }
            let (mut around, mut n) = ([GatherTexel::NONE; 4], 0);
            atlas.gather_around(texel, |s, _| {
                around[n] = s;
                n += 1;
            });
            around.sort_unstable();
            if last == Some(around) {
                continue;
            }
            last = Some(around);
            let group = match n {
                0 => NONE,
                _ => {
                    let last_of = &mut last_of[own.place(around[0])];
                    if groups.all.get(*last_of as usize).is_none_or(|group| group.around != around) {
                        *last_of = groups.all.len() as u32;
                        try_push(&mut groups.all, Group { around, is_split: false }, WALLS)?;
                    }
                    *last_of
                }
            };
            try_push(&mut groups.begins, [i as u32, group], WALLS)?;
        }
        Ok(groups)
    }

    /// Returns the texels of the placement that have a group, run by run.
    fn runs<'a>(&'a self, texels: &'a TexelRange<LightMap>) -> impl Iterator<Item = (TexelRange<LightMap>, &'a Group)> {
        let first = texels.indices().start;
        let ends = self.begins.iter().skip(1).map(|[begin, _]| *begin as usize).chain([texels.len()]);
        let runs = self.begins.iter().zip(ends);
        runs.filter_map(move |(&[begin, group], end)| {
            Some((TexelId::range(first + begin as usize..first + end), self.all.get(group as usize)?))
        })
    }
}

/// The normal of a triangle, for texels that follow one another in it.
#[derive(Default)]
pub(super) struct LastNormal {
    /// `None`: normals vary in it.
    triangle: Option<u32>,
    normal: Vec3,
}

impl LastNormal {
    /// Returns the normal of a texel in a triangle, which `compute` returns. All texels are of one placement.
    #[inline]
    pub fn of(&mut self, scene: &Scene, triangle: u32, compute: impl FnOnce() -> Vec3) -> Vec3 {
        if self.triangle != Some(triangle) {
            let is_flat = scene.object(scene.locate(triangle).0).mesh().normals.is_empty();
            *self = LastNormal { triangle: is_flat.then_some(triangle), normal: compute() };
        }
        self.normal
    }
}

#[cfg(test)]
mod tests {
    use crate::base::progress::Progress;
    use crate::lightmap::atlas::Atlas;
    use crate::lightmap::atlas::chart_map::ChartMap;
    use crate::lightmap::atlas::ids::{LightTexel, Map, PerTexel, PlacementId, TexelId};
    use crate::lightmap::indirect::upsample::tests::{dark, find, floor_with_wall};
    use crate::lightmap::{Lightmap, LightmapDesc};
    use crate::scene::demo::shapes::MeshBuilder;
    use crate::scene::{LightmapUvs, Material, SceneData};
    use glam::{Vec2, Vec3};

    /// Texels of the only chart that show some of a light on gather texels with x < `edge`, but for those to `skip`,
    /// and whether interpolation has anything to heed.
    fn mixed(lightmap: &Lightmap, edge: f32, skip: impl Fn(f32) -> bool) -> (usize, bool) {
        let atlas = lightmap.atlas();
        let upsampling = find(atlas, 0..1, &[]);
        fn x<M: Map>(atlas: &Atlas, map: &ChartMap<M>, texel: TexelId<M>) -> f32 {
            map.surface(&atlas.scene, texel).0.x
        }
        let light = |s| Vec3::splat(f32::from(u8::from(x(atlas, &atlas.gather, s) < edge)));
        let values: Vec<Vec3> = atlas.gather.all().map(light).collect();
        let is_mixed = |s: &LightTexel| {
            let shown = upsampling.at(atlas, PerTexel::new(&values), &dark(&upsampling), *s).x;
            !skip(x(atlas, &atlas.map, *s)) && shown > 0.01 && shown < 0.99
        };
        let only = PlacementId::front_of(atlas.charts.chart_of(0));
        (atlas.map.texels_of(only).filter(is_mixed).count(), !upsampling.is_plain())
    }

    #[test]
    fn light_does_not_go_through_walls_by_interpolation() {
        for wall in [true, false] {
            // Below the wall nothing is seen.
            let (mixed, heeds) =
                mixed(&floor_with_wall(wall.then_some(1.0), 20.0), 0.035, |x| (0.02..0.05).contains(&x));
            assert_eq!((mixed > 0, heeds), (!wall, wall), "{mixed}");
        }
    }

    #[test]
    fn light_does_not_go_around_creases_by_interpolation() {
        for degrees in [60.0f32, -60.0, 20.0] {
            let (sin, cos) = degrees.to_radians().sin_cos();
            let mut data = SceneData::new();
            let m = data.add_material(Material::default()).unwrap();
            let mut builder = MeshBuilder::new();
            builder.sheet(2, 1, m, |u, v| {
                let x = 4.0 * u - 2.0;
                Vec3::new(if x > 0.0 { cos * x } else { x }, 4.0 * v - 2.0, sin * x.max(0.0))
            });
            let mut mesh = builder.finish();
            let unfolded = |p: &Vec3| Vec2::new(if p.x > 0.0 { p.x / cos } else { p.x }, p.y) * 0.2 + 0.5;
            mesh.lightmap =
                Some(LightmapUvs { uvs: mesh.positions.iter().map(unfolded).collect(), pages: Vec::new().into() });
            data.add_mesh(mesh).unwrap();
            let desc = LightmapDesc { texels_per_unit: 20.0, gather_divisor: 4, ..Default::default() };
            let lightmap = Lightmap::create(&data.committed(), &desc, &Progress::none()).unwrap();
            assert_eq!(lightmap.atlas().charts.charts.len(), 1);
            let (mixed, heeds) = mixed(&lightmap, 0.0, |x| x.abs() < 0.01);
            assert_eq!((mixed > 0, heeds), (degrees == 20.0, degrees != 20.0), "{mixed} at {degrees}");
        }
    }
}
