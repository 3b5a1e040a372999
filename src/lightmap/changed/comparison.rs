//! Compares two states of a scene, cell by cell, to tell where light may differ: for bakes after a change, and for live
//! light that follows its scene. A cell is a square of 8 × 8 texels of the gather map.

use super::correspondence::Correspondence;
use super::sources::{Cuts, Shadows, part_of_light};
use crate::base::bounds::Bounds;
use crate::base::error::Result;
use crate::base::memory::{try_collect, try_filled, try_par_collect_ok, try_par_gather};
use crate::base::progress::Progress;
use crate::base::sampling::{mix, purpose_seed};
use crate::base::scratch::Scratch;
use crate::lightmap::BakeParams;
use crate::lightmap::atlas::Atlas;
use crate::lightmap::atlas::ids::{LightTexel, PlacementId};
use crate::lightmap::indirect::probes::{PROBE_RAYS, Probe, ProbeRays, State};
use crate::lightmap::indirect::radiance_map::Radiance;
use crate::lightmap::indirect::sample_set::SampleSet;
use crate::lightmap::moved::Moved;
use crate::lightmap::stages::purpose;
use crate::lightmap::tiles::TILE;
use crate::trace::{RawHit, Ray};
use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// Width of a cell in texels of the gather map.
pub(crate) const CELL: u32 = 8;

/// Maximum number of probes of a cell, and the number of its texels in the light map from which on it has so many: of
/// smaller ones, many may be one small object.
const PROBES: usize = 2;
const PROBED_TEXELS: u32 = 256;

/// Part of the light of a surface, by a bound of its form factor, from which on what moved may cast shadows and reflect
/// light that differ within a cell, whatever the probes find.
const NEAR: f32 = 0.15;

/// Texels darker than this part of the mean light count as if they were so bright.
pub(super) const DARK: f32 = 0.1;

/// Name of these lists in error messages.
pub(super) const CHANGED: &str = "which light has changed";

/// Where the cells of all placements lie.
pub(super) struct CellGrid<'a> {
    atlas: &'a Atlas,
    /// First cell of each placement, and the number of cells at the end.
    first: Vec<u32>,
}

impl<'a> CellGrid<'a> {
    fn new(atlas: &'a Atlas) -> Result<Self> {
        let mut sum = 0;
        let sizes = atlas.gather.layout.placements.iter().map(|p| [p.w, p.h].map(|n| u32::from(n).div_ceil(CELL)));
        let ends = sizes.map(|[columns, rows]| {
            sum += columns * rows;
            sum
        });
        Ok(CellGrid { atlas, first: try_collect(std::iter::once(0).chain(ends), CHANGED)? })
    }

    pub fn placements(&self) -> usize {
        self.first.len() - 1
    }

    /// Returns the first cell of a placement.
    pub fn first(&self, placement: PlacementId) -> usize {
        self.first[placement.index()] as usize
    }

    /// Returns the number of cells of a placement.
    pub fn count(&self, placement: PlacementId) -> usize {
        (self.first[placement.index() + 1] - self.first[placement.index()]) as usize
    }

    pub fn columns(&self, placement: PlacementId) -> u32 {
        u32::from(self.atlas.gather.layout[placement].w).div_ceil(CELL)
    }

    /// Returns the column and row in the gather map at a texel of the light map, relative to the placement's.
    pub fn place(&self, placement: PlacementId, texel: LightTexel) -> [u32; 2] {
        let (atlas, rect) = (self.atlas, &self.atlas.gather.layout[placement]);
        let t = &atlas.map[texel];
        let coord = rect.texel_coord(atlas.charts.local(t.triangle, t.u, t.v));
        let within = |c: f32, begin: u16, size: u16| ((c - f32::from(begin)) as u32).min(u32::from(size.max(1)) - 1);
        [within(coord[0], rect.x, rect.w), within(coord[1], rect.y, rect.h)]
    }

    /// Returns the cell of a texel, counted from the placement's first.
    pub fn of(&self, placement: PlacementId, texel: LightTexel) -> usize {
        let [x, y] = self.place(placement, texel);
        (y / CELL * self.columns(placement) + x / CELL) as usize
    }
}

/// What is known of a cell.
#[derive(Clone, Copy)]
pub(crate) struct Cell {
    /// Box around its texels.
    bounds: Bounds,
    /// Whether its indirect light is computed anew.
    pub is_new: bool,
    /// Whether what moved may lie between it and a light.
    pub is_shadowed: bool,
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

/// A state of a scene, and which charts show their backs (empty: none), by their number in the new state.
#[derive(Clone, Copy)]
pub(crate) struct SceneState<'a> {
    pub atlas: &'a Atlas,
    pub backs: &'a [bool],
    /// How this state's surfaces are numbered, if not as those of the new state.
    pub former: Option<&'a Correspondence>,
}

impl SceneState<'_> {
    /// Returns the number in this state of a texel of the new one, if it shows the same point.
    fn texel(&self, new: &Atlas, placement: PlacementId, texel: LightTexel) -> Option<LightTexel> {
        match self.former {
            Some(former) => former.texel(self.atlas, new, placement, texel),
            None => (new.map[texel] == self.atlas.map[texel]).then_some(texel),
        }
    }
}

/// Two states of a scene that are compared.
pub(crate) struct Comparison<'a, 'p> {
    old: SceneState<'a>,
    new: SceneState<'a>,
    pub(super) moved: &'a Moved,
    /// Relative difference of light that is let stand.
    keep_error: f32,
    pub(super) grid: CellGrid<'a>,
    /// What gives direct light in the new state, and what moved.
    shadows: Shadows<'a>,
    pub(super) progress: &'a Progress<'p>,
}

impl<'a, 'p> Comparison<'a, 'p> {
    /// Prepares to compare two states between which `moved` moved.
    pub fn new(
        [old, new]: [SceneState<'a>; 2],
        moved: &'a Moved,
        keep_error: f32,
        progress: &'a Progress<'p>,
    ) -> Result<Self> {
        let shadows = Shadows::new(&new.atlas.scene, &moved.boxes, keep_error)?;
        Ok(Comparison { old, new, moved, keep_error, grid: CellGrid::new(new.atlas)?, shadows, progress })
    }

    /// Returns the cells by placement, row by row: [new](Cell::is_new) are those whose surface moved or that are near what
    /// moved, [shadowed](Cell::is_shadowed) those between which and a light something moved. To be called on the device's
    /// threads.
    pub fn cells(&self) -> Result<Vec<Cell>> {
        try_par_gather(self.grid.placements(), CHANGED, |p, out| self.look(PlacementId::new(p), out))
    }

    /// Appends the cells of a placement.
    fn look(&self, placement: PlacementId, out: &mut Vec<Cell>) -> Result<()> {
        self.progress.check()?;
        let (atlas, moved) = (self.new.atlas, self.moved);
        let count = self.grid.count(placement);
        let chart = atlas.map.layout.chart_of(placement);
        let back = |backs: &[bool]| backs.get(chart.index()).is_some_and(|&b| b);
        let is_other_side = back(self.new.backs) != back(self.old.backs);
        let width = 1.0 / atlas.info.texels_per_unit;
        let nothing = Cell {
            bounds: Bounds::EMPTY,
            is_new: is_other_side || moved.has(chart),
            is_shadowed: false,
            texels: 0,
            probes: [LightTexel::NONE; PROBES],
        };
        let mut cells = try_filled(count, nothing, CHANGED)?;
        let seed = |texel| atlas.map.seed_in(placement, texel);
        for texel in atlas.map.texels_of(placement) {
            let cell = &mut cells[self.grid.of(placement, texel)];
            cell.bounds.add(atlas.map[texel].position(&atlas.scene));
            let is_buried = |atlas: &Atlas, texel: LightTexel| atlas.buried.get(texel.index()).is_some_and(|&b| b);
            let former = self.old.texel(atlas, placement, texel);
            cell.is_new |= former.is_none_or(|former| is_buried(atlas, texel) != is_buried(self.old.atlas, former));
            if is_buried(atlas, texel) {
                continue;
            }
            // Those with the smallest random numbers: some anywhere in the cell.
            cell.texels += 1;
            let mut texel = texel;
            for probe in &mut cell.probes {
                if *probe == LightTexel::NONE || mix(seed(texel)) < mix(seed(*probe)) {
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
            cell.is_shadowed = self.shadows.is_any_cut(&cell.bounds.grown(2.0 * width), part);
        }
        out.append(&mut cells);
        Ok(())
    }

    /// Marks cells where a probe gathers another light in the new state than in the old one, each with its radiance map;
    /// returns the number of rays. `light` yields the light that a texel has, by the sum of its channels, and `mean` is
    /// its mean. To be called on the device's threads.
    pub fn probe(
        &self,
        cells: &mut [Cell],
        radiance: [&Radiance; 2],
        params: &BakeParams,
        light: impl Fn(LightTexel) -> f32 + Sync,
        mean: f32,
    ) -> Result<u64> {
        let probes = cells.iter().filter(|cell| !cell.is_new);
        let probes = try_collect(probes.flat_map(Cell::probes), CHANGED)?;
        let [old, new] = [(self.old, radiance[0]), (self.new, radiance[1])]
            .map(|(s, radiance)| State::new(s.atlas, s.backs, radiance));
        let samples =
            SampleSet::new(params.gather_rays.min(PROBE_RAYS), purpose_seed(params.seed, purpose::GATHER_SET))?;
        let seed = purpose_seed(params.seed, purpose::PROBE);
        let dark = DARK * mean;
        let boxes = &self.moved.boxes;
        // What moved lies, in both states, in the boxes: a ray that passes none has the same hit in both. A miss is
        // infinitely far away.
        let former = |ray: &Ray, hit: &RawHit| {
            let passes = |moved: &Bounds| moved.is_hit(ray.origin.into(), ray.direction.into(), hit.t);
            let former = match self.old.former {
                Some(former) if !hit.is_miss() => former.surfaces.triangle(&self.new.atlas.scene, hit.triangle),
                _ => Some(hit.triangle),
            };
            let triangle = former.filter(|_| !boxes.iter().any(passes))?;
            Some(RawHit { triangle, ..*hit })
        };
        let (rooms, rays) = (Scratch::new(), AtomicU64::new(0));
        let differ = |texels: &[LightTexel]| -> Result<Vec<bool>> {
            self.progress.check()?;
            let mut room = rooms.take(ProbeRays::new)?;
            let mut found = [[Probe::default(); 2]; TILE];
            rays.fetch_add(room.gather([&old, &new], texels, &samples, seed, former, &mut found), Relaxed);
            let differs = |(&texel, [old, new]): (&LightTexel, &[Probe; 2])| {
                let difference = (new.irradiance - old.irradiance).abs().element_sum();
                // What is not a number differs.
                old.is_visible != new.is_visible || !(difference <= self.keep_error * light(texel).max(dark))
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

    /// Returns what lies between a cell and lights.
    pub(super) fn cuts(&self, cell: &Cell) -> Result<Cuts> {
        self.shadows.cuts(&cell.bounds.grown(2.0 / self.new.atlas.info.texels_per_unit))
    }

    /// Whether what moved lies between a texel and a source, of these `cuts` of its cell.
    pub(super) fn is_cut(&self, texel: LightTexel, cuts: &[(u32, u32)]) -> bool {
        let atlas = self.new.atlas;
        let at = atlas.map[texel].position(&atlas.scene);
        // Direct light is averaged where that of neighbours differs.
        let around = Bounds { lower: at, upper: at }.grown(2.0 / atlas.info.texels_per_unit);
        self.shadows.is_cut(&around, cuts)
    }
}
