//! Interpolates the light map's indirect light from the coarser gather map: joint bilateral upsampling (Kopf, Cohen,
//! Lischinski and Uyttendaele, 2007).
//!
//! A texel of the light map interpolates between those of the surrounding gather texels that are in the same class,
//! inside or outside a [narrow gap](super::narrow_gaps), and are not behind a [wall or
//! crease](super::upsample_visibility); if there are none, the class does not matter, and if all are behind walls or
//! creases, these do not matter either. A texel that is not in a known narrow gap and has no valid gather texel around
//! it outside gaps, as on a narrow face of a moulding, gets a [fallback gather](super::fallback_gather). So does a texel
//! where interpolation is [estimated](super::interpolation_error) to be wrong, as in corners and under arches, or where the
//! light of the gather texels around [differs](super::interpolation_contrast): the density of the rays adapts to the scene.

use super::interpolation_contrast::GatherLight;
use super::interpolation_error::{MeanPosition, Surroundings, surroundings};
use super::narrow_gaps::are_in_gaps;
use super::texel_set::TexelSet;
use super::upsample_visibility::{self, LastNormal, TEXELS_PER_CHECK};
use crate::base::directional::Linear;
use crate::base::error::Result;
use crate::base::memory::{Reservation, try_append, try_collect, try_par_gather, try_push};
use crate::base::progress::Stage;
use crate::lightmap::atlas::Atlas;
use crate::lightmap::atlas::ids::{GatherMap, GatherTexel, LightMap, LightTexel, PerTexel, PlacementId, TexelRange};
use glam::Vec3;
use std::ops::Range;

/// Name of the buffers in error messages.
const SHOWN: &str = "what the light map shows of the gather map";

/// Interpolation constraints of the light map's texels. They depend on the scene and the sides that are shown, and not on
/// light unless fallback gathers are [added](Self::add_where_light_differs) by it.
#[derive(Default)]
pub(crate) struct Upsampling {
    /// Gather texels in narrow gaps.
    gather_gaps: TexelSet<GatherMap>,
    /// Texels of the light map in narrow gaps. Only texels with at least one gather texel in a gap around them are
    /// tested.
    map_gaps: TexelSet<LightMap>,
    /// Texels of the light map that are in `walls`.
    walled: TexelSet<LightMap>,
    /// Pairs of a texel of the light map and one of the gather map that a wall or a crease separates, in ascending
    /// order; never all gather texels around a texel.
    walls: Vec<(LightTexel, GatherTexel)>,
    /// Texels of the light map that are in `alone`, by which their places there are found.
    pub(super) is_alone: TexelSet<LightMap>,
    /// Texels of the light map with a fallback gather, in ascending order.
    pub(super) alone: Vec<LightTexel>,
    /// Those whose light counts only as far as it differs from interpolated light by more than noise, if the gather map
    /// is known: chosen by the [contrast](Self::add_where_light_differs) alone, or because gather texels are on one side.
    pub(super) is_weighed: TexelSet<LightMap>,
    /// Number of rays traced to find the constraints.
    pub rays: u64,
    _memory: Option<Reservation>,
}

/// What is asked for of an [`Upsampling`], where that is not all.
#[derive(Clone, Copy)]
pub(crate) struct Asked<'a> {
    /// Whether each placement is.
    pub placements: &'a [bool],
    /// Whether the fallback gather of each texel of the light map is, if it has one.
    pub alone: &'a [bool],
}

impl Upsampling {
    /// Finds the constraints for some `placements` of an atlas. `backs` says which charts without separate texels for
    /// their backs show the back. Where the estimated error of interpolation is more than `most_error`, texels gather
    /// for themselves. What is not `asked` for is left out (`None`: nothing is). Advances `stage` by one per placement.
    pub(crate) fn find(
        atlas: &Atlas,
        placements: Range<usize>,
        backs: &[bool],
        most_error: f32,
        asked: Option<Asked>,
        stage: &Stage,
    ) -> Result<Upsampling> {
        let of_placement = |placement: usize| {
            if asked.is_some_and(|asked| !asked.placements[placement]) {
                stage.advance(1)?;
                return Ok(Found::default());
            }
            let mut found = Found::in_placement(atlas, backs, PlacementId::new(placement), most_error, stage)?;
            if let Some(asked) = asked {
                found.alone.retain(|texel| asked.alone[texel.index()]);
                found.weighed.retain(|texel| asked.alone[texel.index()]);
            }
            stage.advance(1)?;
            Ok(found)
        };
        let device = atlas.scene.device();
        let first = placements.start;
        let found = device.install(|| {
            try_par_gather(placements.len(), SHOWN, |i, out: &mut Vec<Found>| {
                try_push(out, of_placement(first + i)?, SHOWN)
            })
        })?;
        stage.check()?;
        let gather_gaps = TexelSet::new(found.iter().flat_map(|f| &f.gather_gaps), atlas.gather.len(), SHOWN)?;
        let map_gaps = TexelSet::new(found.iter().flat_map(|f| &f.map_gaps), atlas.map.len(), SHOWN)?;
        let walls = try_collect(found.iter().flat_map(|f| &f.walls).copied(), SHOWN)?;
        let walled = TexelSet::new(walls.iter().map(|(texel, _)| texel), atlas.map.len(), SHOWN)?;
        stage.check()?;
        let alone = try_collect(found.iter().flat_map(|f| &f.alone).copied(), SHOWN)?;
        let is_alone = TexelSet::new(alone.iter(), atlas.map.len(), SHOWN)?;
        let is_weighed = TexelSet::new(found.iter().flat_map(|f| &f.weighed), atlas.map.len(), SHOWN)?;
        let rays = found.iter().map(|f| f.rays).sum();
        let mut found =
            Upsampling { gather_gaps, map_gaps, walled, walls, is_alone, alone, is_weighed, rays, _memory: None };
        found._memory = Some(device.memory().reserve(found.bytes(), SHOWN)?);
        Ok(found)
    }

    /// Returns the bytes held, and those of the light of the [fallback gathers](super::fallback_gather).
    fn bytes(&self) -> usize {
        let bits: usize =
            [&self.map_gaps, &self.walled, &self.is_alone, &self.is_weighed].map(TexelSet::bytes).iter().sum();
        let own = self.alone.len() * size_of::<Option<Vec3>>();
        self.gather_gaps.bytes() + bits + size_of_val(&self.walls[..]) + size_of_val(&self.alone[..]) + own
    }

    /// Adds fallback gathers where the light of the gather texels between which texels of some `placements` interpolate
    /// has a [contrast](super::interpolation_contrast) of more than `most`. What is not `asked` for is left out (`None`:
    /// nothing is). Advances `stage` by one per placement.
    pub(crate) fn add_where_light_differs(
        &mut self,
        atlas: &Atlas,
        placements: Range<usize>,
        backs: &[bool],
        light: &GatherLight,
        most: f32,
        asked: Option<Asked>,
        stage: &Stage,
    ) -> Result<()> {
        let device = atlas.scene.device();
        let first = placements.start;
        let of_placement = |placement: usize, out: &mut Vec<LightTexel>| {
            let placement = PlacementId::new(placement);
            let is_asked = asked.is_none_or(|asked| asked.placements[placement.index()]);
            let may_differ = is_asked && is_coarse(atlas, backs, placement);
            for (i, texel) in atlas.map.texels_of(placement).enumerate() {
                if i % TEXELS_PER_CHECK == 0 {
                    stage.check()?;
                }
                let differs = || {
                    may_differ
                        && asked.is_none_or(|asked| asked.alone[texel.index()])
                        && light.contrast_exceeds(most, self.sources(atlas, texel).iter())
                };
                if self.is_alone.has(texel) || differs() {
                    try_push(out, texel, SHOWN)?;
                }
            }
            stage.advance(1)
        };
        let alone =
            device.install(|| try_par_gather(placements.len(), SHOWN, |i, out| of_placement(first + i, out)))?;
        stage.check()?;
        let weighed = alone.iter().filter(|texel| !self.is_alone.has(**texel) || self.is_weighed.has(**texel));
        self.is_weighed = TexelSet::new(weighed, atlas.map.len(), SHOWN)?;
        self.is_alone = TexelSet::new(alone.iter(), atlas.map.len(), SHOWN)?;
        self.alone = alone;
        self._memory = None;
        self._memory = Some(device.memory().reserve(self.bytes(), SHOWN)?);
        Ok(())
    }

    /// Returns the texels with a fallback gather, in ascending order.
    pub(crate) fn alone(&self) -> &[LightTexel] {
        &self.alone
    }

    /// Interpolates a gather map's `values` at a texel of the light map, or returns the light of its fallback gather
    /// from `own` ([`OwnLight`](super::fallback_gather::OwnLight)).
    #[inline]
    pub(crate) fn at<T: Linear>(
        &self,
        atlas: &Atlas,
        values: PerTexel<GatherMap, T>,
        own: &[Option<T>],
        texel: LightTexel,
    ) -> T {
        if let Some(irradiance) = self.is_alone.rank(texel).and_then(|i| own[i]) {
            return irradiance;
        }
        self.interpolated(atlas, values, texel)
    }

    /// Interpolates a gather map's `values` at a texel of the light map, whether it has a fallback gather or not.
    #[inline]
    pub(super) fn interpolated<T: Linear>(
        &self,
        atlas: &Atlas,
        values: PerTexel<GatherMap, T>,
        texel: LightTexel,
    ) -> T {
        let sources = self.sources(atlas, texel);
        let (mut sum, mut part) = (T::default(), 0.0);
        for (s, w) in sources.iter() {
            sum += values[s] * w;
            part += w;
        }
        // Weights need not add up to 1 exactly. If no gather texel is left out, the sum must not be divided by them: a
        // bake of some texels, among which there are no gaps or walls, gives the bits of a whole one.
        if sources.are_all { sum } else { sum / part }
    }

    /// Returns the gather texels between which a texel of the light map interpolates: of those around, the ones that are
    /// joined and alike, or else those that are joined, or else all.
    #[inline]
    fn sources(&self, atlas: &Atlas, texel: LightTexel) -> Sources {
        let mut all = Sources { texels: [(GatherTexel::new(0), 0.0); 4], count: 0, are_all: true };
        atlas.gather_around(texel, |s, w| all.push(s, w));
        if self.is_plain() {
            return all;
        }
        let (mut joined, mut alike) = (all.none(), all.none());
        for (s, w) in all.iter().filter(|&(s, _)| !self.are_apart(texel, s)) {
            joined.push(s, w);
            if self.are_alike(texel, s) {
                alike.push(s, w);
            }
        }
        let has_weight = |of: &Sources| of.iter().any(|(_, w)| w > 0.0);
        let mut found = [alike, joined].into_iter().find(has_weight).unwrap_or(all);
        found.are_all = found.count == all.count;
        found
    }

    /// Whether a texel of the light map and one of the gather map both lie in narrow gaps, or neither does.
    #[inline]
    fn are_alike(&self, map: LightTexel, gather: GatherTexel) -> bool {
        self.map_gaps.has(map) == self.gather_gaps.has(gather)
    }

    #[inline]
    fn are_apart(&self, map: LightTexel, gather: GatherTexel) -> bool {
        self.walled.has(map) && self.walls.binary_search(&(map, gather)).is_ok()
    }

    /// Whether there are no constraints other than fallback gathers.
    #[inline]
    pub(in crate::lightmap) fn is_plain(&self) -> bool {
        self.gather_gaps.is_empty() && self.walls.is_empty()
    }
}

/// Gather texels between which a texel of the light map interpolates, and their weights.
#[derive(Clone, Copy)]
struct Sources {
    texels: [(GatherTexel, f32); 4],
    count: usize,
    /// Whether these are all gather texels around.
    are_all: bool,
}

impl Sources {
    #[inline]
    fn none(&self) -> Sources {
        Sources { count: 0, ..*self }
    }

    #[inline]
    fn push(&mut self, texel: GatherTexel, weight: f32) {
        self.texels[self.count] = (texel, weight);
        self.count += 1;
    }

    #[inline]
    fn iter(&self) -> impl Iterator<Item = (GatherTexel, f32)> + Clone {
        self.texels[..self.count].iter().copied()
    }
}

/// Interpolation constraints of one placement.
#[derive(Default)]
struct Found {
    gather_gaps: Vec<GatherTexel>,
    map_gaps: Vec<LightTexel>,
    walls: Vec<(LightTexel, GatherTexel)>,
    alone: Vec<LightTexel>,
    /// Those of `alone` that are there only because gather texels are on one side.
    weighed: Vec<LightTexel>,
    rays: u64,
}

impl Found {
    fn in_placement(
        atlas: &Atlas,
        backs: &[bool],
        placement: PlacementId,
        most_error: f32,
        stage: &Stage,
    ) -> Result<Found> {
        let (gather, map) = (&atlas.gather, &atlas.map);
        let mut found = Found::default();
        let apart = upsample_visibility::between(atlas, placement, backs, stage, &mut found.rays)?;
        let scale = gather.layout[placement].scale;
        let width = 1.0 / scale[0].min(scale[1]);
        let of_gather = gather.texels_of(placement);
        let most_error = if is_coarse(atlas, backs, placement) { most_error } else { f32::INFINITY };
        let refines = most_error < f32::INFINITY;
        let around = match refines {
            true => surroundings(atlas, placement, backs, width, stage, &mut found.rays)?,
            false => {
                let texels = try_collect(of_gather.clone(), SHOWN)?;
                let gaps = are_in_gaps(atlas, gather, backs, &texels, width, stage, &mut found.rays)?;
                try_collect(gaps.into_iter().map(Surroundings::unknown), SHOWN)?
            }
        };
        let in_gaps = of_gather.clone().filter(|&s| around[of_gather.place(s)].is_gap);
        found.gather_gaps = try_collect(in_gaps, SHOWN)?;
        let mut end = 0;
        let mut normals = LastNormal::default();
        // Texels that may lie in narrow gaps, and those that gather for themselves unless they do.
        let (mut maybe_in_gaps, mut maybe_alone) = (Vec::new(), Vec::new());
        for (i, texel) in map.texels_of(placement).enumerate() {
            if i % TEXELS_PER_CHECK == 0 {
                stage.check()?;
            }
            let begin = end;
            end += apart[begin..].iter().take_while(|(s, _)| *s == texel).count();
            let apart = &apart[begin..end];
            if apart.is_empty() && found.gather_gaps.is_empty() && !refines {
                continue;
            }
            let sample = &map[texel];
            let normal = match refines {
                true => normals.of(&atlas.scene, sample.triangle, || sample.shading_normal(&atlas.scene)),
                false => Vec3::ZERO,
            };
            let (mut n, mut has_gap, mut sees_open, mut error) = (0, false, false, 0.0);
            let mut mean = MeanPosition::default();
            atlas.gather_around(texel, |s, w| {
                let around = &around[of_gather.place(s)];
                let is_apart = apart.contains(&(texel, s));
                n += 1;
                has_gap |= around.is_gap;
                sees_open |= !around.is_gap && !is_apart;
                if refines {
                    error += w * around.error_at(normal);
                    if !is_apart {
                        mean.add(around, w);
                    }
                }
            });
            let is_wrong = error > most_error;
            let is_beside = refines && error + mean.error_at(sample.position(&atlas.scene), width) > most_error;
            if (has_gap || is_beside) && !is_wrong {
                try_push(&mut maybe_in_gaps, texel, SHOWN)?;
            }
            if (!sees_open || is_wrong || is_beside) && n > 0 {
                try_push(&mut maybe_alone, texel, SHOWN)?;
                if sees_open && !is_wrong {
                    try_push(&mut found.weighed, texel, SHOWN)?;
                }
            }
            if apart.len() < n {
                try_append(&mut found.walls, apart, SHOWN)?;
            }
        }
        let gaps = are_in_gaps(atlas, map, backs, &maybe_in_gaps, width, stage, &mut found.rays)?;
        let in_gaps = maybe_in_gaps.iter().zip(gaps).filter_map(|(&texel, is)| is.then_some(texel));
        found.map_gaps = try_collect(in_gaps, SHOWN)?;
        maybe_alone.retain(|texel| found.map_gaps.binary_search(texel).is_err());
        found.weighed.retain(|texel| found.map_gaps.binary_search(texel).is_err());
        found.alone = maybe_alone;
        Ok(found)
    }
}

/// Whether a placement is worth more than the gather map: at the light map's own density there is little to interpolate,
/// and sides that no open place sees, as inside hollow walls, are not worth the rays.
fn is_coarse(atlas: &Atlas, backs: &[bool], placement: PlacementId) -> bool {
    let (gather, map) = (&atlas.gather, &atlas.map);
    let has_detail = gather.layout[placement].scale != map.layout[placement].scale;
    has_detail && !is_hidden(atlas, backs, &gather.texels_of(placement))
}

/// Whether the side that a placement's texels show can hardly be seen from any open place.
fn is_hidden(atlas: &Atlas, backs: &[bool], texels: &TexelRange<GatherMap>) -> bool {
    let (gather, seen) = (&atlas.gather, &atlas.seen);
    // All of them are on the same side of one chart.
    texels
        .indices()
        .next()
        .map(GatherTexel::new)
        .is_some_and(|s| seen.is_hidden(atlas.charts.chart_of(gather[s].triangle), !atlas.is_back(gather, backs, s)))
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::base::progress::Progress;
    use crate::lightmap::{Lightmap, LightmapDesc};
    use crate::scene::demo::shapes::MeshBuilder;
    use crate::scene::{Light, LightmapUvs, Material, SceneData};
    use glam::{Vec2, Vec3};
    use std::f32::consts::FRAC_PI_2;

    /// A floor from −2 to 2 m, and the top and the bottom of a plank 1 cm above it where x < 0: too far away for its
    /// texels to be buried.
    pub(crate) fn plank() -> Lightmap {
        let mut data = SceneData::new();
        let m = data.add_material(Material::default()).unwrap();
        for (right, z, up) in [(2.0, 0.0, true), (0.0, 0.02, true), (0.0, 0.01, false)] {
            let mut corners = [[-2.0, -2.0], [right, -2.0], [right, 2.0], [-2.0, 2.0]].map(|[x, y]| Vec3::new(x, y, z));
            if !up {
                corners.reverse();
            }
            let mut builder = MeshBuilder::new();
            builder.quad(corners[0], corners[1], corners[2], corners[3], m);
            data.add_mesh(builder.finish()).unwrap();
        }
        data.add_light(Light::Directional { direction: -Vec3::Z, irradiance: [1.0; 3], angular_radius: 0.0 }).unwrap();
        let scene = data.committed();
        let desc = LightmapDesc { texels_per_unit: 80.0, gather_divisor: 16, ..Default::default() };
        Lightmap::create(&scene, &desc, &Progress::none()).unwrap()
    }

    /// Upsampling of some placements.
    pub(crate) fn find(atlas: &Atlas, placements: Range<usize>, backs: &[bool]) -> Upsampling {
        let progress = Progress::none();
        let stage = progress.stage("upsampling", 0.0, 1.0, placements.len() as u64);
        Upsampling::find(atlas, placements, backs, f32::INFINITY, None, &stage).unwrap()
    }

    /// No light of their own.
    pub(crate) fn dark(upsampling: &Upsampling) -> Vec<Option<Vec3>> {
        vec![Some(Vec3::ZERO); upsampling.alone.len()]
    }

    #[test]
    fn what_lies_below_a_sheet_is_in_a_gap_and_what_lies_beside_it_is_not() {
        let lightmap = plank();
        let atlas = lightmap.atlas();
        let [floor, top, bottom] = [0, 2, 4].map(|t| PlacementId::front_of(atlas.charts.chart_of(t)));
        let gaps = find(atlas, 0..3, &[]);
        for s in atlas.gather.texels_of(floor) {
            let x = atlas.gather.surface(&atlas.scene, s).0.x;
            assert!(gaps.gather_gaps.has(s) == (x < 0.0) || x.abs() < 0.05, "gather texel at {x}");
        }
        // Near the edge of the plank a ray more or less gets out.
        let x = |s: LightTexel| atlas.map.surface(&atlas.scene, s).0.x;
        let below: Vec<LightTexel> = atlas.map.texels_of(floor).filter(|&s| x(s) > -0.1 && x(s) < -0.05).collect();
        let found = below.iter().filter(|s| gaps.map_gaps.has(**s)).count();
        assert!(below.len() >= 80 && found > below.len() / 2, "{found} of {}", below.len());
        assert_eq!(atlas.map.texels_of(floor).filter(|&s| x(s) > 0.0 && gaps.map_gaps.has(s)).count(), 0);
        assert!(atlas.gather.texels_of(top).all(|s| !gaps.gather_gaps.has(s)));
        assert_eq!(atlas.map.texels_of(top).filter(|&s| gaps.map_gaps.has(s)).count(), 0);
        let is_inner = |s: &GatherTexel| {
            let p = atlas.gather.surface(&atlas.scene, *s).0;
            p.x > -1.8 && p.x < -0.2 && p.y.abs() < 1.8
        };
        assert!(atlas.gather.texels_of(bottom).filter(is_inner).all(|s| gaps.gather_gaps.has(s)));
    }

    #[test]
    fn light_is_interpolated_within_gaps_and_outside_of_them() {
        let lightmap = plank();
        let atlas = lightmap.atlas();
        let gaps = find(atlas, 0..3, &[]);
        let light = |s: GatherTexel| if gaps.gather_gaps.has(s) { Vec3::ZERO } else { Vec3::ONE };
        let values: Vec<Vec3> = atlas.gather.all().map(light).collect();
        let values = PerTexel::new(&values);
        let mut mixed = 0;
        for s in atlas.map.all() {
            let (mut around, mut alike) = (0, 0);
            atlas.gather_around(s, |g, _| {
                around += 1;
                alike += u32::from(gaps.are_alike(s, g));
            });
            let shown = gaps.at(atlas, values, &dark(&gaps), s);
            let plain = Upsampling::default().at(atlas, values, &[], s);
            let expected =
                if alike > 0 && alike < around { Vec3::splat(!gaps.map_gaps.has(s) as u32 as f32) } else { plain };
            // Beside the plank, with gather texels below it alone.
            let expected = if gaps.is_alone.has(s) { Vec3::ZERO } else { expected };
            assert!(shown.abs_diff_eq(expected, 1e-6), "{shown} is not {expected}");
            mixed += u32::from(!shown.abs_diff_eq(plain, 1e-6));
        }
        assert!(mixed > 100, "{mixed} texels between light and dark");
        // Without gaps nothing is held.
        let none = find(atlas, 1..1, &[]);
        let bits = [&none.map_gaps, &none.walled, &none.is_alone].map(TexelSet::bytes);
        assert!(none.is_plain() && none.alone.is_empty() && none.gather_gaps.bytes() == 0 && bits == [0; 3]);
    }

    /// Of gather texels around a texel, one lies in a gap and all others are behind walls, or the other way around.
    #[test]
    fn what_a_texel_sees_goes_before_what_is_like_it() {
        let lightmap = plank();
        let atlas = lightmap.atlas();
        let floor = PlacementId::front_of(atlas.charts.chart_of(0));
        let this = atlas.map.texels_of(floor).nth(100 * 320 + 234).unwrap();
        let mut around = Vec::new();
        atlas.gather_around(this, |s, _| around.push(s));
        around.sort_unstable();
        assert_eq!(around.len(), 4);
        let (one, others) = (&around[..1], &around[1..]);
        let light = |s: GatherTexel| if one.contains(&s) { Vec3::ZERO } else { Vec3::ONE };
        let values: Vec<Vec3> = atlas.gather.all().map(light).collect();
        let values = PerTexel::new(&values);
        let shown = |in_gap: &[LightTexel], behind_walls: &[GatherTexel], own: &[Option<Vec3>]| {
            let upsampling = Upsampling {
                gather_gaps: TexelSet::new(one.iter(), atlas.gather.len(), SHOWN).unwrap(),
                map_gaps: TexelSet::new(in_gap.iter(), atlas.map.len(), SHOWN).unwrap(),
                walled: TexelSet::new([this].iter(), atlas.map.len(), SHOWN).unwrap(),
                walls: behind_walls.iter().map(|&s| (this, s)).collect(),
                is_alone: TexelSet::new(own.iter().map(|_| &this), atlas.map.len(), SHOWN).unwrap(),
                alone: own.iter().map(|_| this).collect(),
                ..Default::default()
            };
            upsampling.at(atlas, values, own, this).x
        };
        assert_eq!((shown(&[this], others, &[]), shown(&[], others, &[])), (0.0, 0.0));
        assert!((shown(&[this], one, &[]) - 1.0).abs() < 1e-6 && (shown(&[], one, &[]) - 1.0).abs() < 1e-6);
        assert_eq!(shown(&[], others, &[Some(Vec3::splat(0.5))]), 0.5);
        // Inside of a solid.
        assert!((shown(&[], one, &[None]) - 1.0).abs() < 1e-6);
    }

    /// Folded sheets 4 m long in a closed room, each along a profile of (x, z) that it is unfolded from, side by side
    /// in one page without a gap.
    pub(crate) fn folded(profiles: &[&[[f32; 2]]]) -> Lightmap {
        let mut data = SceneData::new();
        let m = data.add_material(Material { two_sided: true, ..Default::default() }).unwrap();
        let mut start = 0.0;
        for profile in profiles {
            let mut builder = MeshBuilder::new();
            let parts = profile.len() as u32 - 1;
            builder.sheet(parts, 1, m, |u, v| {
                let [x, z] = profile[(u * parts as f32).round() as usize];
                Vec3::new(x, 4.0 * v - 2.0, z)
            });
            let mut mesh = builder.finish();
            let along = |p: &Vec3| (p.x - profile[0][0]).abs() + (p.z - profile[0][1]).abs();
            let unfolded = |p: &Vec3| Vec2::new(start + 0.2 * along(p), 0.2 * p.y + 0.5);
            mesh.lightmap =
                Some(LightmapUvs { uvs: mesh.positions.iter().map(unfolded).collect(), pages: Vec::new().into() });
            start = mesh.positions.iter().map(|p| unfolded(p).x).fold(0.0, f32::max);
            data.add_mesh(mesh).unwrap();
        }
        let mut room = MeshBuilder::new();
        room.box_(Vec3::splat(-5.0), Vec3::splat(5.0), true, m);
        data.add_mesh(room.finish()).unwrap();
        let desc = LightmapDesc { texels_per_unit: 50.0, gather_divisor: 8, ..Default::default() };
        Lightmap::create(&data.committed(), &desc, &Progress::none()).unwrap()
    }

    /// A floor that ends at a wall, and a quarter of a barrel.
    #[test]
    fn texels_gather_for_themselves_where_surfaces_are_near_or_bend() {
        let arch: Vec<[f32; 2]> =
            (0..=8).map(|i| (i as f32 / 8.0 * FRAC_PI_2).sin_cos()).map(|(x, z)| [0.4 * x - 4.0, 0.4 * z]).collect();
        let lightmap = folded(&[&[[-1.5, 0.0], [0.5, 0.0], [0.5, 1.0]], &arch]);
        let atlas = lightmap.atlas();
        let progress = Progress::none();
        let stage = progress.stage("upsampling", 0.0, 1.0, 4);
        let alone = |most_error| Upsampling::find(atlas, 0..2, &[], most_error, None, &stage).unwrap().alone;
        let (few, many) = (alone(f32::INFINITY), alone(0.2));
        assert!(few.iter().all(|s| many.binary_search(s).is_ok()) && many.len() > 2 * few.len());
        let part = |placement: usize, is_there: &dyn Fn(Vec3) -> bool| {
            let texels = atlas.map.texels_of(PlacementId::new(placement));
            let there: Vec<_> = texels.filter(|&s| is_there(atlas.map.surface(&atlas.scene, s).0)).collect();
            there.iter().filter(|s| many.binary_search(s).is_ok()).count() as f32 / there.len() as f32
        };
        let is_between = |p: Vec3, from: f32, to: f32| p.z < 0.01 && p.x > from && p.x < to && p.y.abs() < 1.5;
        let (near, far) = (part(0, &|p| is_between(p, 0.42, 0.48)), part(0, &|p| is_between(p, -1.3, -0.8)));
        let bent = part(1, &|_| true);
        assert!(
            near > 0.95 && far < 0.05 && bent > 0.5,
            "{near} near, {far} far from the wall, {bent} of what is bent"
        );
    }

    /// A floor of 4 × 4 with a thin wall of a height on it at x = 0.03, or none, and gather texels of 0.2.
    pub(crate) fn floor_with_wall(height: Option<f32>, texels_per_unit: f32) -> Lightmap {
        let mut data = SceneData::new();
        let m = data.add_material(Material { two_sided: true, ..Default::default() }).unwrap();
        let p = Vec3::new;
        let mut builder = MeshBuilder::new();
        builder.quad(p(-2.0, -2.0, 0.0), p(2.0, -2.0, 0.0), p(2.0, 2.0, 0.0), p(-2.0, 2.0, 0.0), m);
        if let Some(height) = height {
            builder.box_(p(0.03, -3.0, -0.01), p(0.04, 3.0, height), false, m);
        }
        data.add_mesh(builder.finish()).unwrap();
        let gather_divisor = (0.2 * texels_per_unit) as u32;
        let desc = LightmapDesc { texels_per_unit, gather_divisor, ..Default::default() };
        Lightmap::create(&data.committed(), &desc, &Progress::none()).unwrap()
    }

    /// The wall is a kerb, too low to be near in many directions.
    #[test]
    fn texels_gather_for_themselves_where_all_gather_texels_are_on_one_side() {
        for kerb in [None, Some(0.04)] {
            let lightmap = floor_with_wall(kerb, 50.0);
            let atlas = lightmap.atlas();
            let progress = Progress::none();
            let stage = progress.stage("upsampling", 0.0, 1.0, 1);
            let found = Upsampling::find(atlas, 0..1, &[], 1.5, None, &stage).unwrap();
            // Gather texels are at x = ±0.1, and those beyond the kerb are left out: at x = 0 the others are half the width
            // of a gather texel away.
            let part = |from: f32, to: f32| {
                let x = |s| atlas.map.surface(&atlas.scene, s).0;
                let texels = atlas.map.texels_of(PlacementId::front_of(atlas.charts.chart_of(0)));
                let there: Vec<_> = texels.filter(|&s| x(s).x > from && x(s).x < to && x(s).y.abs() < 1.8).collect();
                // Nothing else has chosen them, so that noise does not show.
                assert!(there.iter().all(|&s| found.is_alone.has(s) == found.is_weighed.has(s)));
                there.iter().filter(|s| found.is_alone.has(**s)).count() as f32 / there.len() as f32
            };
            let (beside, near, far) = (part(0.0, 0.025), part(-0.1, -0.04), part(-1.0, -0.2));
            assert!(if kerb.is_some() { beside > 0.95 } else { beside == 0.0 }, "{beside} beside the kerb");
            assert!(near < 0.05 && far == 0.0, "{near} near, {far} far");
        }
    }

    /// Light that doubles across a line of the floor.
    #[test]
    fn texels_gather_for_themselves_where_light_differs_by_more_than_noise() {
        let lightmap = plank();
        let atlas = lightmap.atlas();
        let x = |s| atlas.map.surface(&atlas.scene, s).0.x;
        let floor = atlas.map.texels_of(PlacementId::front_of(atlas.charts.chart_of(0)));
        let light = |s| Vec3::splat(if atlas.gather.surface(&atlas.scene, s).0.x < 1.0 { 1.0 } else { 2.0 });
        let irradiance: Vec<Vec3> = atlas.gather.all().map(light).collect();
        let progress = Progress::none();
        let stage = progress.stage("contrast", 0.0, 1.0, 12);
        let added = |noise: f32, asked: Option<Asked>| {
            let variances = vec![noise; irradiance.len()];
            let variances = PerTexel::new(&variances);
            let irradiance = PerTexel::new(&irradiance);
            let light = GatherLight { irradiance, variances, unblurred: variances, rays: 64, directional: &[] };
            let mut found = find(atlas, 0..3, &[]);
            let before = found.alone.clone();
            found.add_where_light_differs(atlas, 0..3, &[], &light, 0.2, asked, &stage).unwrap();
            assert!(found.alone.is_sorted() && before.iter().all(|s| found.alone.binary_search(s).is_ok()));
            let ranks = found.alone.iter().map(|&s| found.is_alone.rank(s));
            assert!(ranks.eq((0..found.alone.len()).map(Some)));
            found.alone.retain(|s| before.binary_search(s).is_err());
            found.alone
        };
        // Between gather texels 20 cm apart, at a part p of the way, contrast is √(p (1 − p)) / (1 + p).
        let edge = added(0.0, None);
        assert!(edge.iter().all(|&s| floor.contains(s) && (x(s) - 1.0).abs() < 0.1), "{}", edge.len());
        let half_way: Vec<_> = floor.clone().filter(|&s| (x(s) - 1.0).abs() < 0.05).collect();
        assert!(half_way.len() >= 7 * 320 && half_way.iter().all(|s| edge.binary_search(s).is_ok()));
        // Variances of the sums of three channels, times three: what is beyond the contrast is at most 9 · 0.164.
        let few = added(0.33, None);
        assert!(!few.is_empty() && few.len() < edge.len() && few.iter().all(|s| edge.binary_search(s).is_ok()));
        assert!(added(0.5, None).is_empty());
        // What nobody asks for has no rays.
        let (some, none) = (vec![true; 3], vec![false; atlas.map.len()]);
        assert!(added(0.0, Some(Asked { placements: &some, alone: &none })).is_empty());
        let (none, all) = (vec![false; 3], vec![true; atlas.map.len()]);
        assert!(added(0.0, Some(Asked { placements: &none, alone: &all })).is_empty());
    }

    /// A hollow wall of 4 cm in a room, both of two-sided surface, the fronts inside.
    #[test]
    fn texels_inside_of_hollow_walls_do_not_gather_for_themselves() {
        let mut data = SceneData::new();
        let m = data.add_material(Material { two_sided: true, ..Default::default() }).unwrap();
        let wall = [Vec3::new(0.4, -1.7, -1.7), Vec3::new(0.44, 0.7, 0.0)];
        for [lower, upper] in [[Vec3::splat(-2.0), Vec3::splat(2.0)], wall] {
            let mut builder = MeshBuilder::new();
            builder.box_(lower, upper, true, m);
            data.add_mesh(builder.finish()).unwrap();
        }
        data.add_light(Light::Point { position: Vec3::ONE, intensity: [1.0; 3] }).unwrap();
        let desc = LightmapDesc { texels_per_unit: 20.0, ..Default::default() };
        let lightmap = Lightmap::create(&data.committed(), &desc, &Progress::none()).unwrap();
        let atlas = lightmap.atlas();
        let progress = Progress::none();
        let stage = progress.stage("upsampling", 0.0, 1.0, 4);
        let charts = atlas.charts.charts.len();
        let (mut refined, mut hidden) = (0, 0);
        for placement in 0..charts {
            let texels = atlas.gather.texels_of(PlacementId::new(placement));
            let only = placement..placement + 1;
            let alone = |most_error| {
                let found = Upsampling::find(atlas, only.clone(), &[], most_error, None, &stage);
                found.unwrap().alone.len()
            };
            // Some have nothing to interpolate.
            let (few, many) = (alone(f32::INFINITY), alone(0.1));
            match is_hidden(atlas, &[], &texels) {
                true => {
                    assert_eq!(few, many);
                    hidden += 1;
                }
                false => refined += usize::from(many > few),
            }
        }
        assert!(hidden >= 2 && refined >= 3, "{hidden} of {charts} charts are hidden, {refined} refined");
    }
}
