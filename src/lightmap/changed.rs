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

use super::atlas::Atlas;
use super::atlas::ids::{LightTexel, PlacementId};
use super::direct_blur;
use super::indirect::probes::{PROBE_RAYS, Probe, ProbeRays, State};
use super::indirect::radiance_map::Radiance;
use super::indirect::sample_set::SampleSet;
use super::indirect::upsample::Asked;
use super::moved::{Bounds, Moved, merged};
use super::plan::{Plan, left_out};
use super::stages::purpose;
use super::tiles::TILE;
use super::{BakeParams, Light, TexelState};
use crate::base::error::Result;
use crate::base::memory::{
    Reservation, try_collect, try_filled, try_par_collect_ok, try_par_gather, try_push, try_vec,
};
use crate::base::progress::Progress;
use crate::base::sampling::{mix, purpose_seed};
use crate::base::scratch::Scratch;
use crate::scene::{Light as Lamp, Scene};
use crate::trace::Ray;
use glam::Vec3;
use rayon::prelude::*;
use std::f32::consts::PI;
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

/// Maximum number of boxes around emissive triangles.
const MOST_EMITTERS: usize = 64;

/// Number of pairs of a source and of what moved between it and a cell, beyond which all texels of the cell count as
/// shadowed: testing each takes longer than its direct light.
const MOST_CUTS: usize = 16;

/// Radius in radians from which on the disc of a directional light counts as a sky.
const WIDE: f32 = 0.5;

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
        Asked { placements: Some(&self.placements), alone: Some(&self.around) }
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
        let job = Job { before, atlas, params, backs, cells: &cells, sources: sources(&atlas.scene)?, progress };
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
        parts.into_par_iter().try_for_each(|part| job.mark(part, &states, all_direct))?;
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

/// Where light comes from.
enum Source {
    /// From a box, which may be a point.
    Near(Bounds),
    /// From infinitely far away, up to an angle with this tangent from a direction.
    Far { direction: Vec3, spread: f32 },
    /// From everywhere.
    Sky,
}

/// Returns what gives direct light.
fn sources(scene: &Scene) -> Result<Vec<Source>> {
    let mut sources = Vec::new();
    let around = |points: &[Vec3]| {
        let mut bounds = Bounds::EMPTY;
        points.iter().for_each(|&point| bounds.add(point));
        bounds
    };
    for light in scene.lights().iter().filter(|light| light.color() != [0.0; 3]) {
        let source = match *light {
            Lamp::Point { position, .. } | Lamp::Spot { position, .. } => Source::Near(around(&[position])),
            Lamp::Rect { position, edge_u, edge_v, .. } => {
                Source::Near(around(&[Vec3::ZERO, edge_u, edge_v, edge_u + edge_v].map(|edge| position + edge)))
            }
            Lamp::Directional { angular_radius, .. } if angular_radius > WIDE => Source::Sky,
            Lamp::Directional { direction, angular_radius, .. } => {
                Source::Far { direction: -direction.normalize_or_zero(), spread: angular_radius.tan() }
            }
            Lamp::Sky { .. } => Source::Sky,
        };
        try_push(&mut sources, source, CHANGED)?;
    }
    let emitters =
        scene.emitters().iter().map(|e| around(&[Vec3::ZERO, e.edge_u, e.edge_v].map(|edge| e.corner + edge)));
    for bounds in merged(try_collect(emitters, CHANGED)?, MOST_EMITTERS) {
        try_push(&mut sources, Source::Near(bounds), CHANGED)?;
    }
    Ok(sources)
}

impl Source {
    /// Whether what moved may lie between points and the source. `part`: a bound of the part of the hemisphere that all
    /// of it takes, and the part that matters.
    fn is_cut(&self, points: &Bounds, moved: &Bounds, part: (f32, f32)) -> bool {
        match *self {
            Source::Near(end) => points.sweeps(end.lower - points.lower, end.upper - points.upper, 1.0, moved),
            Source::Far { direction, spread } => {
                // A unit vector of a cone differs from its axis by no more in any coordinate.
                points.sweeps(direction - spread, direction + spread, f32::INFINITY, moved)
            }
            Source::Sky => part.0 > part.1,
        }
    }
}

/// Returns a bound of the part of the light of a surface in `from` that a box takes: of a convex body at distance d, at
/// most half of its surface is seen, and all of it as if facing the surface.
fn part_of_light(from: &Bounds, moved: &Bounds) -> f32 {
    let d = from.distance(moved);
    if d > 0.0 { 0.5 * moved.area() / (PI * d * d) } else { f32::INFINITY }
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
}

impl Job<'_, '_> {
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
mod tests {
    use super::super::{Lightmap, LightmapDesc, directional};
    use super::*;
    use crate::base::error::Error;
    use crate::scene::demo::shapes::MeshBuilder;
    use crate::scene::{Material, SceneData};
    use std::sync::Arc;

    /// Two rooms of 4 × 4 × 3 m with a door between them, a lamp in each, and a block in the first one: mesh 1.
    fn rooms() -> (Arc<Scene>, Lightmap) {
        rooms_with(|x| Lamp::Point { position: Vec3::new(x, 1.9, 2.7), intensity: [5.0; 3] })
    }

    fn rooms_with(lamp: impl Fn(f32) -> Lamp) -> (Arc<Scene>, Lightmap) {
        let mut data = SceneData::new();
        let white = data.add_material(Material { albedo: [0.7; 3], ..Default::default() }).unwrap();
        let mut walls = MeshBuilder::new();
        walls.box_(Vec3::ZERO, Vec3::new(8.0, 4.0, 3.0), true, white);
        walls.box_(Vec3::new(3.9, 0.0, 0.0), Vec3::new(4.1, 2.8, 3.0), false, white);
        data.add_mesh(walls.finish()).unwrap();
        let mut block = MeshBuilder::new();
        block.box_(Vec3::new(0.6, 0.6, 0.0), Vec3::new(1.0, 1.0, 0.5), false, white);
        data.add_mesh(block.finish()).unwrap();
        for x in [2.0, 6.0] {
            data.add_light(lamp(x)).unwrap();
        }
        let scene = data.committed();
        let desc = LightmapDesc { texels_per_unit: 24.0, page_size: 512, ..Default::default() };
        let map = Lightmap::create(&scene, &desc, &Progress::none()).unwrap();
        (scene, map)
    }

    fn params() -> BakeParams {
        BakeParams { photon_count: 20_000, gather_rays: 16, stitch: false, seed: 4, ..Default::default() }
    }

    fn move_block(scene: &mut Arc<Scene>, by: Vec3) {
        let moved: Vec<Vec3> = scene.meshes()[1].positions.iter().map(|&p| p + by).collect();
        Scene::refit(scene, &[(1, &moved)]).unwrap();
    }

    fn light(map: &Lightmap) -> [Vec<Vec3>; 2] {
        let light = map.light.as_ref().unwrap();
        [light.direct.clone(), light.indirect.clone()]
    }

    #[test]
    fn texels_keep_their_light_or_get_that_of_a_bake_from_nothing() {
        let none = Progress::none();
        let both = directional::INDIRECT | directional::DIRECT;
        for (stitch, directional, passes, is_area) in [
            (false, 0, 1, false),
            (false, both, 2, false),
            (true, 0, 1, false),
            (false, 0, 1, true),
            (false, both, 1, true),
        ] {
            let params = BakeParams { stitch, directional, passes, ..params() };
            // The direct light of areas is blurred.
            let area = |x| Lamp::Rect {
                position: Vec3::new(x, 1.5, 2.9),
                edge_u: Vec3::new(0.0, 1.0, 0.0),
                edge_v: Vec3::new(1.0, 0.0, 0.0),
                radiance: [5.0; 3],
            };
            let (mut scene, mut map) = if is_area { rooms_with(area) } else { rooms() };
            map.bake(&params, &none).unwrap();
            let old = light(&map);
            move_block(&mut scene, Vec3::new(0.3, 0.2, 0.0));
            map.follow(&scene, &none).unwrap();
            assert!(light(&map) == old, "light stays until the next bake");
            let stats = map.bake_changed(&params, 0.05, &none).unwrap();
            let changed = light(&map);
            map.bake(&params, &none).unwrap();
            let new = light(&map);
            let n = new[0].len();
            let part = stats.kept_texels as f32 / n as f32;
            assert!((0.3..0.97).contains(&part), "{part} kept");
            assert!(stitch || map.plan_text().lines().all(|line| !line.contains("has changed by less")));
            if stitch {
                // Texels at seams take light of their neighbours, kept or not.
                continue;
            }
            for (kind, what) in ["direct", "indirect"].iter().enumerate() {
                let differs = |i: usize, from: &[Vec<Vec3>; 2]| changed[kind][i] != from[kind][i];
                let neither = (0..n).filter(|&i| differs(i, &old) && differs(i, &new)).count();
                assert_eq!(neither, 0, "{what} light that is neither old nor new, {passes} passes, areas: {is_area}");
                // What is kept is much like what would be new; all of what was shadowed or lit is new.
                let mean = new[kind].iter().map(|l| l.element_sum()).sum::<f32>() / n as f32;
                let wrong = |i: &usize| (changed[kind][*i] - new[kind][*i]).abs().element_sum() / mean;
                let worst = (0..n).map(|i| wrong(&i)).fold(0.0, f32::max);
                assert!(worst < 0.25, "{what} light is wrong by {worst} of the mean");
                let old_worst =
                    (0..n).map(|i| (old[kind][i] - new[kind][i]).abs().element_sum() / mean).fold(0.0, f32::max);
                assert!(old_worst > 0.15, "{what} light changed by {old_worst} only");
            }
        }
    }

    #[test]
    fn nothing_changed_keeps_all_and_back_again_gives_the_same_light() {
        let none = Progress::none();
        let (mut scene, mut map) = rooms();
        let params = params();
        let first = map.bake_changed(&params, 0.1, &none).unwrap();
        assert_eq!(first.kept_texels, 0, "there was no light");
        let old = light(&map);
        let again = map.bake_changed(&params, 0.0, &none).unwrap();
        assert_eq!(again.kept_texels as usize, old[0].len());
        assert!(light(&map) == old);
        // With a difference of 0, all that changes is new: the way there and back ends where it began.
        let there = Vec3::new(0.2, 0.1, 0.0);
        for by in [there, -there] {
            move_block(&mut scene, by);
            map.follow(&scene, &none).unwrap();
            map.bake_changed(&params, 0.0, &none).unwrap();
        }
        let (fresh_scene, mut fresh) = rooms();
        drop(fresh_scene);
        let moved_back = scene.meshes()[1].positions[0] - Vec3::new(0.6, 0.6, 0.0);
        assert!(moved_back.length() < 1e-6);
        fresh.bake(&params, &none).unwrap();
        let (here, fresh) = (light(&map), light(&fresh));
        let mean = fresh[1].iter().map(|l| l.element_sum()).sum::<f32>() / fresh[1].len() as f32;
        let worst =
            here[1].iter().zip(&fresh[1]).map(|(a, b)| (*a - *b).abs().element_sum() / mean).fold(0.0, f32::max);
        assert!(worst < 0.05, "{worst}");
    }

    #[test]
    fn a_light_that_is_set_is_seen_where_it_shines() {
        let none = Progress::none();
        let (scene, mut map) = rooms();
        let params = params();
        map.bake(&params, &none).unwrap();
        let old = light(&map);
        scene.set_light(0, Lamp::Point { position: Vec3::new(2.0, 1.9, 2.7), intensity: [10.0; 3] }).unwrap();
        let stats = map.bake_changed(&params, 0.05, &none).unwrap();
        let changed = light(&map);
        assert_eq!(stats.kept_texels, 0, "direct light is always new");
        map.bake(&params, &none).unwrap();
        let new = light(&map);
        assert!(changed[0] == new[0]);
        let kept = (0..old[1].len()).filter(|&i| changed[1][i] == old[1][i]).count();
        let renewed = (0..old[1].len()).filter(|&i| changed[1][i] == new[1][i]).count();
        assert!(kept + renewed >= old[1].len() && renewed > old[1].len() / 3, "{kept} kept, {renewed} new");
    }

    #[test]
    fn what_moved_uncovers_texels() {
        let none = Progress::none();
        let (mut scene, mut map) = rooms();
        let buried = |map: &Lightmap| map.info().buried_texels;
        // Below the block and below the wall between the rooms.
        let before = buried(&map);
        move_block(&mut scene, Vec3::new(0.0, 0.0, 1.0));
        map.follow(&scene, &none).unwrap();
        let in_the_air = buried(&map);
        assert!(in_the_air + 50 < before && in_the_air > 0, "{in_the_air} after {before}");
        move_block(&mut scene, Vec3::new(0.5, 0.0, -1.0));
        map.follow(&scene, &none).unwrap();
        let after = buried(&map);
        assert!(after > in_the_air + 50, "{after} after {in_the_air}");
        // As if made in this state.
        let desc = map.atlas.desc.clone();
        let fresh = Lightmap::create(&scene, &desc, &none).unwrap();
        assert_eq!(fresh.info().buried_texels, after);
        let samples = |map: &Lightmap| map.atlas.map.texels.samples.clone();
        assert!(samples(&fresh) == samples(&map));
    }

    #[test]
    fn a_surface_that_is_gone_cannot_be_followed() {
        let none = Progress::none();
        for gone in [Vec3::splat(f32::NAN), Vec3::splat(1e13), Vec3::new(1.0, 1.0, 0.0)] {
            let (mut scene, mut map) = rooms();
            map.bake(&params(), &none).unwrap();
            let before = light(&map);
            // One vertex, or all in one place.
            let moved: Vec<Vec3> = scene.meshes()[1]
                .positions
                .iter()
                .enumerate()
                .map(|(i, &p)| if i == 0 || gone.is_finite() { gone } else { p })
                .collect();
            Scene::refit(&mut scene, &[(1, &moved)]).unwrap();
            let refused = map.follow(&scene, &none);
            assert!(matches!(&refused, Err(Error::InvalidState(e)) if e.contains("mesh 1")), "{gone}: {refused:?}");
            assert!(map.before.is_none() && light(&map) == before);
            map.bake_changed(&params(), 0.1, &none).unwrap();
            assert!(light(&map) == before);
        }
    }

    #[test]
    fn wrong_use_is_refused_and_shards_after_a_move_begin_anew() {
        let none = Progress::none();
        let (mut scene, mut map) = rooms();
        let (other, _) = rooms();
        assert!(map.follow(&other, &none).is_err());
        let params = params();
        map.bake(&params, &none).unwrap();
        for (bad, keep_error) in [
            (params, f32::NAN),
            (params, -0.1),
            (BakeParams { target_error: 0.1, ..params }, 0.1),
            (BakeParams { texel_begin: 1, ..params }, 0.1),
        ] {
            assert!(map.bake_changed(&bad, keep_error, &none).is_err());
        }
        let with_others = BakeParams { gather_rays: 8, ..params };
        assert_eq!(map.bake_changed(&with_others, 1.0, &none).unwrap().kept_texels, 0);
        move_block(&mut scene, Vec3::new(0.2, 0.0, 0.0));
        map.follow(&scene, &none).unwrap();
        let path = std::env::temp_dir().join(format!("bakelite-changed-{}", std::process::id()));
        assert!(map.save_result(&path, &none).is_err(), "the light is of before the move");
        let n = map.info().texels;
        let cancelled = map.bake_changed(&with_others, 0.1, &Progress::new(|fraction, _| fraction < 0.25));
        assert!(cancelled.is_err() && map.before.is_some());
        map.bake(&BakeParams { texel_end: n / 2, ..params }, &none).unwrap();
        let unbaked = map.light.as_ref().unwrap().state.iter().filter(|&&s| s == TexelState::Unbaked).count();
        assert_eq!(unbaked as u64, n - n / 2);
        map.bake(&BakeParams { texel_begin: n / 2, ..params }, &none).unwrap();
        let shards = light(&map);
        map.bake(&params, &none).unwrap();
        assert!(light(&map) == shards);
    }
}
