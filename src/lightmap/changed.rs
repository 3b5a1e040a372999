//! Which light a bake after a change computes anew: where the scene has moved, or a light was set.
//!
//! Photons and the radiance map are made anew, with the same random numbers. The light map is cut into cells of 8 × 8
//! texels of the gather map. Indirect light of a cell is computed anew if
//!
//! - its surface or what it shows moved, or what moved is so near or so large that light may differ within the cell, or
//! - one of its [probes](super::indirect::probes) gathers another light than before: rays from a few of its texels, traced
//!   in both states of the scene, each with its radiance map.
//!
//! Direct light of a texel is computed anew if what moved lies, or lay, between it and a light. All other texels keep
//! their light. Those that are computed anew get the bits of a bake from nothing, as their random numbers, the radiance
//! map and the texels around them are the same.

mod sources;

use super::atlas::Atlas;
use super::atlas::ids::{LightTexel, PlacementId};
use super::direct_blur;
use super::indirect::probes::{PROBE_RAYS, Probe, ProbeRays, State};
use super::indirect::radiance_map::Radiance;
use super::indirect::sample_set::SampleSet;
use super::indirect::upsample::Asked;
use super::moved::{Bounds, Moved};
use super::plan::{Plan, left_out};
use super::stages::purpose;
use super::tiles::TILE;
use super::{BakeParams, BakeStats, Light, Lightmap, Origin, TexelState};
use crate::base::error::{Result, invalid_argument};
use crate::base::memory::{
    Reservation, try_collect, try_filled, try_par_collect_ok, try_par_gather, try_push, try_vec,
};
use crate::base::parallel::ParallelLoop;
use crate::base::progress::Progress;
use crate::base::sampling::{mix, purpose_seed};
use crate::base::scratch::Scratch;
use crate::direct::DirectLight;
use crate::trace::Ray;
use rayon::prelude::*;
use sources::{Source, part_of_light};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// Width of a cell in texels of the gather map.
const CELL: u32 = 8;

/// Maximum number of probes of a cell, and the number of its texels in the light map from which on it has so many: of
/// smaller ones, many may be one small object.
const PROBES: usize = 2;
const PROBED_TEXELS: u32 = 256;

/// Part of the light of a surface, by a bound of its form factor, from which on what moved may cast shadows and reflect
/// light that differ within a cell, whatever the probes find.
const NEAR: f32 = 0.15;

/// Texels darker than this part of the mean light count as if they were so bright.
const DARK: f32 = 0.1;

/// Number of pairs of a source and of what moved between it and a cell, beyond which all texels of the cell count as
/// shadowed: testing each takes longer than its direct light.
const MOST_CUTS: usize = 16;

const CHANGED: &str = "which light has changed";

/// What a bake computes anew.
pub(super) struct Redo {
    /// Whether indirect light is, by texel of the light map.
    pub indirect: Vec<bool>,
    /// The same for direct light.
    pub direct: Vec<bool>,
    /// Texels whose direct light before its [blur](super::direct_blur) is needed for that.
    pub lit: Vec<bool>,
    /// Texels of the light map that texels with new indirect light may be blurred with.
    pub around: Vec<bool>,
    /// Texels of the gather map that are needed for them.
    pub gather: Vec<bool>,
    /// Whether a placement has any of these texels.
    pub placements: Vec<bool>,
    /// Number of rays of probes.
    pub rays: u64,
    _memory: Reservation,
}

impl Lightmap {
    /// Bakes again after lights were [set](crate::scene::Scene::set_light) or the scene [has moved](Lightmap::follow).
    /// Texels whose light has changed by less than `keep_error` (finite, ≥ 0), as far as probes tell, keep it; it is
    /// relative to their light or, if that is more, to a tenth of the mean light. All others get the bits of
    /// [`bake`](Self::bake).
    ///
    /// `params` are those of the last bake, for all texels and without a target error. If others were used, or there is
    /// no light yet, all is baked. Many small changes that are each let stand add up: now and then bake from nothing.
    pub fn bake_changed(&mut self, params: &BakeParams, keep_error: f32, progress: &Progress) -> Result<BakeStats> {
        params.validate()?;
        if !(keep_error >= 0.0 && keep_error.is_finite()) {
            return invalid_argument!("keep_error is {keep_error}, not a finite number ≥ 0");
        }
        let total = self.atlas.map.len() as u64;
        if params.target_error > 0.0 || params.texel_begin > 0 || !(params.texel_end == 0 || params.texel_end == total)
        {
            return invalid_argument!("a bake of changes is of all texels and has no target_error");
        }
        self.bake_all(params, None, None, Some(keep_error), progress)
    }

    /// Returns the light from before a change, if a bake with these parameters can keep any of it.
    pub(super) fn before(
        &self,
        params: &BakeParams,
        plan: &Plan,
        direct: &DirectLight,
        origin: &Origin,
        keep_error: f32,
    ) -> Result<Option<Before<'_>>> {
        let Some(light) = self.light.as_ref().filter(|light| can_keep(light, params, plan)) else {
            return Ok(None);
        };
        let atlas = self.before.as_ref().unwrap_or(&self.atlas);
        let moved = Moved::between(&atlas.scene, &self.atlas.scene, &self.atlas.charts)?;
        let has_other_lights = !light.origin.is_some_and(|of_light| of_light.has_lights_of(origin));
        let blurs_direct = direct_blur::is_needed(direct, params, plan);
        let redo = OnceLock::new();
        Ok(Some(Before { atlas, light, moved, has_other_lights, blurs_direct, keep_error, redo }))
    }
}

/// The light of a light map before a change.
pub(super) struct Before<'a> {
    pub atlas: &'a Atlas,
    pub light: &'a Light,
    pub moved: Moved,
    /// Whether a light was set since.
    pub has_other_lights: bool,
    /// Whether direct light is blurred.
    pub blurs_direct: bool,
    /// Relative difference of light that is let stand.
    pub keep_error: f32,
    /// What is computed anew, once that is known.
    pub redo: OnceLock<Redo>,
}

impl Before<'_> {
    /// Copies what is kept into new light that is dark.
    pub fn keep(&self, redo: &Redo, new: &mut Light) {
        let old = self.light;
        for (is_new, (new, old)) in redo.direct.iter().zip(new.direct.iter_mut().zip(&old.direct)) {
            if !is_new {
                *new = *old;
            }
        }
        let directional =
            new.directional.iter_mut().zip(&old.directional).map(Some).chain(std::iter::repeat_with(|| None));
        let indirect = new.indirect.iter_mut().zip(&old.indirect).zip(directional);
        for (_, ((new, old), directional)) in redo.indirect.iter().zip(indirect).filter(|(is_new, _)| !**is_new) {
            *new = *old;
            if let Some((new, old)) = directional {
                *new = *old;
            }
        }
        if let Some(stitch) = &old.stitch {
            stitch.former_where(new, |texel| (!redo.direct[texel], !redo.indirect[texel]));
        }
    }

    /// Copies the spread of passes where all light is kept.
    pub fn keep_spread(&self, new: &mut Light) {
        let Some(redo) = self.redo.get() else { return };
        let spread = new.spread.iter_mut().zip(&self.light.spread);
        for (_, (new, old)) in redo.indirect.iter().zip(spread).filter(|(is_new, _)| !**is_new) {
            *new = *old;
        }
    }
}

impl Redo {
    /// Returns what is asked for of the interpolation.
    pub fn asked(&self) -> Asked<'_> {
        Asked { placements: &self.placements, alone: &self.around }
    }

    /// Returns how many texels keep all of their light.
    pub fn kept(&self) -> u64 {
        self.indirect.iter().zip(&self.direct).filter(|(indirect, direct)| !**indirect && !**direct).count() as u64
    }

    /// Finds what is to be computed anew, given the new radiance map and sides of charts. To be called on the device's
    /// threads.
    pub fn find(
        before: &Before,
        atlas: &Atlas,
        params: &BakeParams,
        plan: &Plan,
        (radiance, backs): (&Radiance, &[bool]),
        progress: &Progress,
    ) -> Result<Redo> {
        let cells = Cells::new(atlas)?;
        let job =
            Job { before, atlas, params, backs, cells: &cells, sources: sources::sources(&atlas.scene)?, progress };
        let mut states = try_par_gather(cells.placements(), CHANGED, |p, out| job.look(PlacementId::new(p), out))?;
        let mut rays = 0;
        if !plan.runs(left_out::INDIRECT) {
            states.iter_mut().for_each(|cell| cell.is_new = true);
        } else {
            rays = job.probe(&mut states, radiance)?;
        }
        let all_direct = before.has_other_lights || before.moved.emits || !plan.runs(left_out::DIRECT);
        // Light by direction is the sum of both kinds, and the spread of passes is of that: both are made anew together.
        if params.directional != 0 || params.passes > 1 {
            states.iter_mut().for_each(|cell| cell.is_new |= all_direct || cell.is_shadowed);
            states.iter_mut().for_each(|cell| cell.is_shadowed &= !cell.is_new);
        }
        let n = atlas.map.len();
        let bytes = 4 * n + atlas.gather.len() + cells.placements();
        let mut redo = Redo {
            indirect: try_vec(n, CHANGED)?,
            direct: try_vec(n, CHANGED)?,
            lit: try_vec(n, CHANGED)?,
            around: try_vec(n, CHANGED)?,
            gather: try_vec(atlas.gather.len(), CHANGED)?,
            placements: try_vec(cells.placements(), CHANGED)?,
            rays,
            _memory: atlas.scene.device().memory().reserve(bytes, CHANGED)?,
        };
        // By placement, since texels are numbered by placement.
        let (mut indirect, mut direct) = (&mut redo.indirect[..], &mut redo.direct[..]);
        let (mut lit, mut around, mut gather) = (&mut redo.lit[..], &mut redo.around[..], &mut redo.gather[..]);
        let mut parts = Vec::new();
        for (p, is_new) in redo.placements.iter_mut().enumerate() {
            let placement = PlacementId::new(p);
            let (texels, of_gather) = (atlas.map.texels_of(placement), atlas.gather.texels_of(placement));
            let part = Part {
                placement,
                is_new,
                indirect: indirect.split_off_mut(..texels.len()).unwrap_or_default(),
                direct: direct.split_off_mut(..texels.len()).unwrap_or_default(),
                lit: lit.split_off_mut(..texels.len()).unwrap_or_default(),
                around: around.split_off_mut(..texels.len()).unwrap_or_default(),
                gather: gather.split_off_mut(..of_gather.len()).unwrap_or_default(),
            };
            try_push(&mut parts, part, CHANGED)?;
        }
        parts.into_par_iter().try_each(|part| job.mark(part, &states, all_direct))?;
        Ok(redo)
    }
}

/// Results for a placement.
struct Part<'a> {
    placement: PlacementId,
    is_new: &'a mut bool,
    indirect: &'a mut [bool],
    direct: &'a mut [bool],
    lit: &'a mut [bool],
    around: &'a mut [bool],
    gather: &'a mut [bool],
}

/// Cells of all placements.
struct Cells<'a> {
    atlas: &'a Atlas,
    /// First cell of each placement, and the number of cells at the end.
    first: Vec<u32>,
}

impl<'a> Cells<'a> {
    fn new(atlas: &'a Atlas) -> Result<Self> {
        let mut sum = 0;
        let sizes = atlas.gather.layout.placements.iter().map(|p| [p.w, p.h].map(|n| u32::from(n).div_ceil(CELL)));
        let ends = sizes.map(|[columns, rows]| {
            sum += columns * rows;
            sum
        });
        Ok(Cells { atlas, first: try_collect(std::iter::once(0).chain(ends), CHANGED)? })
    }

    fn placements(&self) -> usize {
        self.first.len() - 1
    }

    /// Returns the number of cells of a placement.
    fn count(&self, placement: PlacementId) -> usize {
        (self.first[placement.index() + 1] - self.first[placement.index()]) as usize
    }

    fn columns(&self, placement: PlacementId) -> u32 {
        u32::from(self.atlas.gather.layout[placement].w).div_ceil(CELL)
    }

    /// Returns the column and row in the gather map at a texel of the light map, relative to the placement's.
    fn place(&self, placement: PlacementId, texel: LightTexel) -> [u32; 2] {
        let (atlas, rect) = (self.atlas, &self.atlas.gather.layout[placement]);
        let t = &atlas.map[texel];
        let coord = rect.texel_coord(atlas.charts.local(t.triangle, t.u, t.v));
        let within = |c: f32, begin: u16, size: u16| ((c - f32::from(begin)) as u32).min(u32::from(size.max(1)) - 1);
        [within(coord[0], rect.x, rect.w), within(coord[1], rect.y, rect.h)]
    }

    /// Returns the cell of a texel, counted from the placement's first.
    fn of(&self, placement: PlacementId, texel: LightTexel) -> usize {
        let [x, y] = self.place(placement, texel);
        (y / CELL * self.columns(placement) + x / CELL) as usize
    }
}

/// What is known of a cell.
#[derive(Clone, Copy)]
struct Cell {
    /// Box around its texels.
    bounds: Bounds,
    /// Whether its indirect light is computed anew.
    is_new: bool,
    /// Whether what moved may lie between it and a light.
    is_shadowed: bool,
    /// Number of its texels in the light map that are not buried.
    texels: u32,
    /// The texels for probes, [`LightTexel::NONE`] from the last one on.
    probes: [LightTexel; PROBES],
}

impl Cell {
    /// Returns the texels that are probed.
    fn probes(&self) -> impl Iterator<Item = LightTexel> + use<> {
        let count = if self.texels < PROBED_TEXELS { 1 } else { PROBES };
        self.probes.into_iter().take(count).filter(|&texel| texel != LightTexel::NONE)
    }
}

struct Job<'a, 'p> {
    before: &'a Before<'a>,
    atlas: &'a Atlas,
    params: &'a BakeParams,
    backs: &'a [bool],
    cells: &'a Cells<'a>,
    sources: Vec<Source>,
    progress: &'a Progress<'p>,
}

impl Job<'_, '_> {
    /// Appends the cells of a placement.
    fn look(&self, placement: PlacementId, out: &mut Vec<Cell>) -> Result<()> {
        self.progress.check()?;
        let (atlas, old, moved) = (self.atlas, self.before.atlas, &self.before.moved);
        let count = self.cells.count(placement);
        let chart = atlas.map.layout.chart_of(placement);
        let back = |backs: &[bool]| backs.get(chart.index()).is_some_and(|&b| b);
        let is_other_side = back(self.backs) != back(&self.before.light.backs);
        let width = 1.0 / atlas.info.texels_per_unit;
        let nothing = Cell {
            bounds: Bounds::EMPTY,
            is_new: is_other_side || moved.has(chart),
            is_shadowed: false,
            texels: 0,
            probes: [LightTexel::NONE; PROBES],
        };
        let mut cells = try_filled(count, nothing, CHANGED)?;
        for texel in atlas.map.texels_of(placement) {
            let cell = &mut cells[self.cells.of(placement, texel)];
            let (new, former) = (&atlas.map[texel], &old.map[texel]);
            cell.bounds.add(new.position(&atlas.scene));
            let is_buried = |atlas: &Atlas| atlas.buried.get(texel.index()).is_some_and(|&b| b);
            cell.is_new |= new != former || is_buried(atlas) != is_buried(old);
            if is_buried(atlas) {
                continue;
            }
            // Those with the smallest random numbers: some anywhere in the cell.
            cell.texels += 1;
            let mut texel = texel;
            for probe in &mut cell.probes {
                if *probe == LightTexel::NONE || mix(texel.seed()) < mix(probe.seed()) {
                    std::mem::swap(&mut texel, probe);
                }
                if texel == LightTexel::NONE {
                    break;
                }
            }
        }
        for cell in &mut cells {
            let radius = 0.5 * cell.bounds.diagonal();
            if cell.bounds.is_empty() {
                continue;
            }
            let mut part = 0.0;
            for moved in &moved.boxes {
                part += part_of_light(&cell.bounds, moved);
                cell.is_new |= cell.bounds.distance(moved) < radius;
            }
            cell.is_new |= part > NEAR;
            let (part, bounds) = ((part, self.before.keep_error), cell.bounds.grown(2.0 * width));
            let is_cut = |moved: &Bounds| self.sources.iter().any(|s| s.is_cut(&bounds, moved, part));
            cell.is_shadowed = moved.boxes.iter().any(is_cut);
        }
        out.append(&mut cells);
        Ok(())
    }

    /// Compares what the probes of cells gather before and after the change; returns the number of rays.
    fn probe(&self, cells: &mut [Cell], radiance: &Radiance) -> Result<u64> {
        let (before, light) = (self.before, self.before.light);
        let probes = cells.iter().filter(|cell| !cell.is_new);
        let probes = try_collect(probes.flat_map(Cell::probes), CHANGED)?;
        let states =
            [&State::new(before.atlas, &light.backs, &light.radiance), &State::new(self.atlas, self.backs, radiance)];
        let samples = SampleSet::new(
            self.params.gather_rays.min(PROBE_RAYS),
            purpose_seed(self.params.seed, purpose::GATHER_SET),
        );
        let seed = purpose_seed(self.params.seed, purpose::PROBE);
        let total = |texel: usize| (light.direct[texel] + light.indirect[texel]).element_sum();
        let sums = (0..light.direct.len()).map(|i| f64::from(total(i))).sum::<f64>();
        let dark = DARK * (sums / light.direct.len().max(1) as f64) as f32;
        let boxes = &before.moved.boxes;
        let passes =
            |ray: &Ray, t: f32| boxes.iter().any(|moved| moved.is_hit(ray.origin.into(), ray.direction.into(), t));
        let (rooms, rays) = (Scratch::new(), AtomicU64::new(0));
        let differ = |texels: &[LightTexel]| -> Result<Vec<bool>> {
            self.progress.check()?;
            let mut room = rooms.take(ProbeRays::new)?;
            let mut found = [[Probe::default(); 2]; TILE];
            rays.fetch_add(room.gather(states, texels, &samples, seed, passes, &mut found), Relaxed);
            let differs = |(texel, [old, new]): (&LightTexel, &[Probe; 2])| {
                let difference = (new.irradiance - old.irradiance).abs().element_sum();
                // What is not a number differs.
                old.is_visible != new.is_visible || !(difference <= before.keep_error * total(texel.index()).max(dark))
            };
            try_collect(texels.iter().zip(&found).map(differs), CHANGED)
        };
        let found = try_par_collect_ok(probes.par_chunks(TILE).map(differ), CHANGED)?;
        let mut found = found.into_iter().flatten();
        for cell in cells.iter_mut().filter(|cell| !cell.is_new) {
            for _ in cell.probes() {
                cell.is_new |= found.next().unwrap_or(true);
            }
        }
        Ok(rays.into_inner())
    }

    /// Returns sources, and boxes of what moved that may lie between them and a cell: at most one more than
    /// [`MOST_CUTS`].
    fn cuts(&self, cell: &Cell) -> Result<Vec<(u32, u32)>> {
        let boxes = &self.before.moved.boxes;
        let around = cell.bounds.grown(2.0 / self.atlas.info.texels_per_unit);
        let part = (boxes.iter().map(|moved| part_of_light(&around, moved)).sum(), self.before.keep_error);
        let pairs = (0..).zip(&self.sources).flat_map(|(s, source)| {
            let cut = (0..).zip(boxes).filter(move |(_, moved)| source.is_cut(&around, moved, part));
            cut.map(move |(b, _)| (s, b))
        });
        try_collect(pairs.take(MOST_CUTS + 1), CHANGED)
    }

    /// Marks the texels of a placement.
    fn mark(&self, part: Part, cells: &[Cell], all_direct: bool) -> Result<()> {
        self.progress.check()?;
        let (atlas, placement, boxes) = (self.atlas, part.placement, &self.before.moved.boxes);
        let cells = &cells[self.cells.first[placement.index()] as usize..];
        let width = 1.0 / self.atlas.info.texels_per_unit;
        let columns = self.cells.columns(placement);
        let is_new = |x: u32, y: u32| cells[(y / CELL * columns + x / CELL) as usize].is_new;
        // Blurred light reads texels so far away, and interpolation those beside them.
        let margin = self.params.blur_radius.max(1) + 1;
        let rect = &atlas.gather.layout[placement];
        let is_needed = |[x, y]: [u32; 2]| {
            let last = |i: u32, size: u16| (i + margin).min(u32::from(size) - 1);
            let [x0, y0] = [x, y].map(|i| i.saturating_sub(margin));
            let (x1, y1) = (last(x, rect.w), last(y, rect.h));
            // The margin may be wider than a cell.
            (y0 / CELL..=y1 / CELL).any(|cy| (x0 / CELL..=x1 / CELL).any(|cx| is_new(cx * CELL, cy * CELL)))
        };
        let mut cuts: Vec<Option<Vec<(u32, u32)>>> = try_filled(self.cells.count(placement), None, CHANGED)?;
        for (i, texel) in atlas.map.texels_of(placement).enumerate() {
            let place = self.cells.place(placement, texel);
            let cell = &cells[self.cells.of(placement, texel)];
            part.indirect[i] = cell.is_new;
            part.around[i] = is_needed(place);
            part.direct[i] = all_direct
                || cell.is_new
                || cell.is_shadowed && {
                    let number = self.cells.of(placement, texel);
                    if cuts[number].is_none() {
                        cuts[number] = Some(self.cuts(cell)?);
                    }
                    let at = atlas.map[texel].position(&atlas.scene);
                    // Direct light is averaged where that of neighbours differs.
                    let around = Bounds { lower: at, upper: at }.grown(2.0 * width);
                    let part = (boxes.iter().map(|moved| part_of_light(&around, moved)).sum(), self.before.keep_error);
                    let cuts = cuts[number].as_deref().unwrap_or_default();
                    cuts.len() > MOST_CUTS
                        || cuts.iter().any(|&(s, b)| self.sources[s as usize].is_cut(&around, &boxes[b as usize], part))
                };
        }
        self.mark_lit(placement, part.direct, part.lit);
        *part.is_new = part.around.iter().any(|&b| b);
        for (needed, texel) in part.gather.iter_mut().zip(atlas.gather.texels_of(placement)) {
            let (x, y) = atlas.gather.position(texel);
            *needed = is_needed([x as u32 - u32::from(rect.x), y as u32 - u32::from(rect.y)]);
        }
        Ok(())
    }

    /// Marks the texels of a placement whose direct light is needed for that of those that get new direct light.
    fn mark_lit(&self, placement: PlacementId, direct: &[bool], lit: &mut [bool]) {
        lit.copy_from_slice(direct);
        if !self.before.blurs_direct {
            return;
        }
        let (map, texels) = (&self.atlas.map, self.atlas.map.texels_of(placement));
        for texel in texels.clone().filter(|&texel| direct[texels.place(texel)]) {
            let (x, y) = map.position(texel);
            let near = |dx: i32, dy: i32| map.at(placement, x + dx, y + dy).filter(|&near| texels.contains(near));
            let is_inner = |(dx, dy)| near(dx, dy).is_some_and(|near| direct[texels.place(near)]);
            if [(-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (1, -1), (-1, 1), (1, 1)].into_iter().all(is_inner) {
                continue;
            }
            let side = -direct_blur::RADIUS..=direct_blur::RADIUS;
            for near in side.clone().flat_map(|dy| side.clone().filter_map(move |dx| near(dx, dy))) {
                lit[texels.place(near)] = true;
            }
        }
    }
}

/// Whether a bake with these parameters can keep any of the light.
pub(super) fn can_keep(light: &Light, params: &BakeParams, plan: &Plan) -> bool {
    !light.state.contains(&TexelState::Unbaked)
        && light.origin.is_some_and(|origin| origin.has_params(params))
        && (!plan.runs(left_out::INDIRECT) || !light.radiance.values.is_empty())
}

#[cfg(test)]
mod tests;
