//! Seams: edges at which a smooth surface is cut open in the light map, so that the two sides are filtered separately
//! and show different light along the edge.
//!
//! After Iwanicki, *Lighting Technology of "The Last of Us"* (SIGGRAPH talks 2013): at points along the edges, the
//! values A and B of the two sides are written as weighted sums of texels, and the texels x are changed from x₀, as
//! little as possible, so that both agree: minimise Σ l (A − B)² + λ Σ (x − x₀)², where l is the length of the part of
//! the edge around a point, in texels. (Ray et al., *Invisible Seams*, EGSR 2010, make both sides agree exactly, for
//! which the texel grids of both sides must be aligned.) The normal equations are solved by conjugate gradients
//! (Hestenes and Stiefel 1952), one set of texels for each layer of light.
//!
//! If the two sides have very different light, or their texels face different ways, one of them is not visible there: its
//! texels show the other face of the surface, or it lies in a narrow gap, or the surface bends within a texel. Stitching
//! would spread its light to the visible side, so such points are left unstitched. (Measured:
//! docs/experiments.md#seams-at-rounded-edges.)
//!
//! Edges are compared by the positions of their ends: T-junctions, where a vertex lies inside another triangle's edge,
//! are not found.

mod sides;
mod solver;

use super::atlas::Atlas;
use super::atlas::ids::{ChartId, LightTexel, PlacementId};
use super::atlas::sheets::{Place, Sheet};
use super::atlas::texels::TexelSample;
use super::plan::{Plan, left_out};
use super::{BakeParams, BakeStats, Light, Lightmap, TexelState};
use crate::base::directional::Directional;
use crate::base::error::{Error, Result};
use crate::base::memory::{
    Reservation, try_append, try_collect, try_par_collect, try_par_filter, try_par_gather, try_push, try_to_vec,
    try_vec,
};
use crate::base::parallel::ParallelLoop;
use crate::base::progress::{Progress, Stage};
use crate::base::sort::sort;
use crate::scene::NONE;
use glam::{Vec2, Vec3, Vec3A};
use rayon::prelude::*;
use sides::{Side, Sides, for_each_edge};
use solver::{CHUNK, POINTS, Point, System};
use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::Instant;

/// Cosine of the greatest angle (30 degrees) between the normals of a smooth surface, at an edge and of the texels on its
/// two sides. Sharper edges are not stitched.
const SMOOTH_COSINE: f32 = 0.866;

/// Points whose sides differ by more than this factor in indirect light, or in all light, are not stitched. (For indirect
/// light, 2 is no better, and 8 is no better than no limit: docs/experiments.md#seams-at-rounded-edges.)
const CONTRAST: f32 = 4.0;

/// Distance between the points of an edge, in texels: both sides are linear between texels, each in its own grid.
const SPACING: f32 = 0.5;

/// Name of the seams in error messages.
const SEAMS: &str = "the seams";

/// Points that stand for less than this length, in texels, and lie between the same texels become one: else memory and time
/// of the solution grow with the triangles along seams.
const SHORTEST: f32 = 0.125;

/// Number of points before a short one that are looked at for one that it can join: along most seams the next edges in the
/// mesh lie beside one another.
const LOOK_BACK: usize = 16;

/// Number of edges whose points a thread computes at a time.
const EDGES: usize = 256;

/// Stitched texels and their light: before the stitching or after it, whichever the light map does not hold.
pub(crate) struct Stitch {
    /// Ascending.
    texels: Vec<u32>,
    direct: Vec<Vec3>,
    indirect: Vec<Vec3>,
    /// Empty if there is no light by direction.
    directional: Vec<Directional>,
    _memory: Reservation,
}

impl Stitch {
    /// Undoes the stitching in a copy of the stitched light.
    pub(super) fn copy_former(&self, light: &mut Light) {
        self.former_where(light, |_| (true, true));
    }

    /// Undoes the stitching in a copy of the light of a range of texels.
    pub(super) fn former_of(
        &self,
        range: &Range<usize>,
        direct: &mut [Vec3],
        indirect: &mut [Vec3],
        directional: &mut [Directional],
    ) {
        let first = self.texels.partition_point(|&t| (t as usize) < range.start);
        for i in (first..self.texels.len()).take_while(|&i| (self.texels[i] as usize) < range.end) {
            let at = self.texels[i] as usize - range.start;
            (direct[at], indirect[at]) = (self.direct[i], self.indirect[i]);
            if let Some((to, from)) = directional.get_mut(at).zip(self.directional.get(i)) {
                *to = *from;
            }
        }
    }

    /// Undoes the stitching in a copy of the stitched light of some texels: `of` returns for a texel whether in its direct
    /// light, and whether in its indirect light and light by direction.
    pub(super) fn former_where(&self, light: &mut Light, of: impl Fn(usize) -> (bool, bool)) {
        for (i, texel) in self.texels.iter().map(|&t| t as usize).enumerate() {
            let (direct, indirect) = of(texel);
            if direct {
                light.direct[texel] = self.direct[i];
            }
            if indirect {
                light.indirect[texel] = self.indirect[i];
                if let Some((to, from)) = light.directional.get_mut(texel).zip(self.directional.get(i)) {
                    *to = *from;
                }
            }
        }
    }

    /// Undoes the stitching in a copy of the stitched light by direction.
    pub(super) fn former_directional(&self, directional: &mut [Directional]) {
        for (&texel, former) in self.texels.iter().zip(&self.directional) {
            directional[texel as usize] = *former;
        }
    }

    /// Swaps the light of the stitched texels in the light map with the light held here.
    pub(super) fn swap(&mut self, light: &mut Light) {
        for (i, &texel) in self.texels.iter().enumerate() {
            std::mem::swap(&mut self.direct[i], &mut light.direct[texel as usize]);
            std::mem::swap(&mut self.indirect[i], &mut light.indirect[texel as usize]);
            if let Some((here, there)) = self.directional.get_mut(i).zip(light.directional.get_mut(texel as usize)) {
                std::mem::swap(here, there);
            }
        }
    }
}

impl Lightmap {
    /// Stitches the light map that [`store`](Lightmap::store) will make from the `new` light of a range of samples.
    /// `None` if there is nothing to stitch, or if texels are still to be baked: then the last shard stitches. Changes
    /// nothing yet, so that it can be cancelled.
    pub(super) fn stitch(
        &self,
        new: &Light,
        range: &Range<usize>,
        params: &BakeParams,
        plan: &mut Plan,
        stats: &mut BakeStats,
        progress: &Progress,
    ) -> Result<Option<Stitch>> {
        let start = Instant::now();
        let view = View { new, range, old: self.current_light() };
        let dark = !plan.runs(left_out::DIRECT) && !plan.runs(left_out::INDIRECT);
        let why = if !params.stitch {
            "stitch is 0"
        } else if dark {
            "no light emits"
        } else if view.has_unbaked(self.atlas.map.len()) {
            "some texels are not baked yet"
        } else {
            let stage = progress.stage("seams", 1.0, 1.0, 1);
            let job = Job { atlas: &self.atlas, backs: &new.backs, budget: params.memory_budget, stage: &stage };
            let stitch = self.atlas.scene.device().install(|| job.run(&view, plan, stats))?;
            stage.advance(1)?;
            stats.seam_seconds = start.elapsed().as_secs_f64();
            stats.seconds += stats.seam_seconds;
            if let Some((stitch, [edges, unlike])) = stitch {
                plan.run_seams(edges, unlike);
                return Ok(Some(stitch));
            }
            "no edge of a smooth surface is a seam between sides that face alike and have similar light"
        };
        plan.leave_out_seams(why);
        Ok(None)
    }
}

/// The light of all texels after the bake is stored, without stitching.
struct View<'a> {
    new: &'a Light,
    range: &'a Range<usize>,
    old: Option<&'a Light>,
}

impl View<'_> {
    /// Returns the light, new or old, that a sample comes from.
    fn source(&self, sample: usize) -> &Light {
        self.old.filter(|_| !self.range.contains(&sample)).unwrap_or(self.new)
    }

    fn has_unbaked(&self, samples: usize) -> bool {
        let unbaked = |i| self.source(i).state[i] == TexelState::Unbaked;
        (0..samples).any(unbaked)
    }

    /// Returns direct and indirect light of a sample before stitching.
    fn light(&self, sample: usize) -> [Vec3; 2] {
        let source = self.source(sample);
        let stitched = source.stitch.as_ref();
        match stitched.and_then(|s| Some((s, s.texels.binary_search(&(sample as u32)).ok()?))) {
            Some((before, i)) => [before.direct[i], before.indirect[i]],
            None => [source.direct[sample], source.indirect[sample]],
        }
    }

    /// Returns the light by direction of a sample before stitching.
    fn directional(&self, sample: usize) -> Directional {
        let source = self.source(sample);
        let stitched = source.stitch.as_ref().and_then(|s| {
            let i = s.texels.binary_search(&(sample as u32)).ok()?;
            s.directional.get(i)
        });
        stitched.or(source.directional.get(sample)).copied().unwrap_or_default()
    }

    /// Whether both sides of a point have light of the same order, indirect light and all.
    fn are_alike(&self, p: &Point) -> bool {
        let shown = |side: Range<usize>| {
            side.fold([0.0; 2], |[indirect, all], k| {
                let light = self.light(p.texels[k] as usize).map(|l| p.weights[k].abs() * l.element_sum());
                [indirect + light[1], all + light[0] + light[1]]
            })
        };
        let (a, b) = (shown(0..4), shown(4..8));
        a.into_iter().zip(b).all(|(a, b): (f32, f32)| a.max(b) <= CONTRAST * a.min(b))
    }

    /// Whether a sample may be changed: hidden ones repeat texels around them, and values that have overflowed must not
    /// spread.
    fn is_valid(&self, sample: usize) -> bool {
        let source = self.source(sample);
        let finite = source.direct[sample].is_finite() && source.indirect[sample].is_finite();
        source.state[sample] == TexelState::Visible && finite
    }
}

struct Job<'a, 'p, 'c> {
    atlas: &'a Atlas,
    /// Whether the back is shown, for each chart without separate texels for it; empty: all show fronts.
    backs: &'a [bool],
    budget: u64,
    stage: &'a Stage<'p, 'c>,
}

impl Job<'_, '_, '_> {
    /// Returns the stitched light, the number of edges, and the number of points whose sides differ too much. `None` if
    /// there is nothing to stitch.
    fn run(&self, view: &View, plan: &Plan, stats: &mut BakeStats) -> Result<Option<(Stitch, [u64; 2])>> {
        let edges = self.edges()?;
        self.stage.advance(0)?;
        let _edges = self.reserve(size_of_val(&edges[..]), SEAMS)?;
        let unlike = AtomicU64::new(0);
        let is_stitched = |p: &Point| {
            if !is_cut(p) || !p.texels.iter().all(|&t| view.is_valid(t as usize)) {
                return false;
            }
            let alike = self.bends_little(p) && view.are_alike(p);
            unlike.fetch_add(u64::from(!alike), Relaxed);
            alike
        };
        let mut points = try_par_gather(edges.len().div_ceil(EDGES), POINTS, |part, out| {
            self.stage.check()?;
            for e in &edges[part * EDGES..edges.len().min((part + 1) * EDGES)] {
                for p in self.points(e).filter(&is_stitched) {
                    let joined = |before: &&mut Point| before.length < SHORTEST && before.texels == p.texels;
                    match out.iter_mut().rev().take(LOOK_BACK).find(joined) {
                        Some(before) if p.length < SHORTEST => before.join(&p),
                        _ => try_push(out, p, POINTS)?,
                    }
                }
            }
            Ok(())
        })?;
        if points.is_empty() {
            return Ok(None);
        }
        let count = edges.len();
        drop(edges);
        let uses = 8 * size_of::<(u32, f32)>();
        let bytes = points.len() * (size_of::<Point>() + uses + size_of::<Vec3A>()) + self.atlas.map.len() * 4;
        let _memory = self.reserve(bytes, POINTS)?;
        self.stage.advance(0)?;
        let texels = number(&mut points, self.atlas.map.len(), self.stage)?;
        let n = texels.len();
        let directional = if view.new.directional.is_empty() { 0 } else { size_of::<Directional>() };
        let memory = self.reserve(n * (2 * size_of::<Vec3>() + directional), "the light of the seams' texels")?;
        let _vectors = self.reserve(n * 8 * size_of::<Vec3A>(), "the seams' vectors")?;
        let system = System::new(points, n, self.stage)?;
        let light = try_par_collect(texels.par_iter().map(|&t| view.light(t as usize)), POINTS)?;
        let layer = |layer: usize| try_par_collect(light.par_iter().map(|l| Vec3A::from(l[layer])), POINTS);
        let mut before = [layer(0)?, layer(1)?];
        let mut after = [try_to_vec(&before[0], POINTS)?, try_to_vec(&before[1], POINTS)?];
        for (layer, bit) in [left_out::DIRECT, left_out::INDIRECT].into_iter().enumerate() {
            if plan.runs(bit) {
                system.solve(&before[layer], &mut after[layer], 0.0, self.stage)?;
            }
        }
        stats.seam_points = system.points.len() as u64;
        self.stage.check()?;
        stats.seam_rms_before = system.relative_rms(&combine(&mut before));
        self.stage.check()?;
        let layer = |layer: usize| try_collect(after[layer].iter().map(|&v| Vec3::from(v)), POINTS);
        let (direct, indirect) = (layer(0)?, layer(1)?);
        stats.seam_rms_after = system.relative_rms(&combine(&mut after));
        let directional = match directional {
            0 => Vec::new(),
            _ => self.directional(&system, view, &texels)?,
        };
        let stitch = Stitch { texels, direct, indirect, directional, _memory: memory };
        Ok(Some((stitch, [count as u64, unlike.into_inner()])))
    }

    /// Whether the surface bends little between what the texels on the two sides of a point show. Where an edge is rounded
    /// by strips that are narrower than a texel, each bend is smooth, but the texels on both sides face different ways.
    fn bends_little(&self, p: &Point) -> bool {
        let map = &self.atlas.map;
        let normal = |side: Range<usize>| -> Vec3 {
            let of_texel = |k: usize| {
                let texel = LightTexel::new(p.texels[k] as usize);
                let (_, normal) = map.surface(&self.atlas.scene, texel);
                let sign = if self.atlas.is_back(map, self.backs, texel) { -1.0 } else { 1.0 };
                normal * (sign * p.weights[k].abs())
            };
            side.map(of_texel).sum()
        };
        let (a, b) = (normal(0..4), normal(4..8));
        a.dot(b) > SMOOTH_COSINE * a.length() * b.length()
    }

    /// Returns the stitched light by direction, of which each coefficient is a layer.
    fn directional(&self, system: &System, view: &View, texels: &[u32]) -> Result<Vec<Directional>> {
        let of = |t: &u32| view.directional(*t as usize);
        let mut stitched = try_par_collect(texels.par_iter().map(of), POINTS)?;
        for k in 0..4 {
            let part = |d: &Directional| Vec3A::from(if k == 0 { d.l0 } else { d.l1[k - 1] });
            let before = try_par_collect(stitched.par_iter().map(part), POINTS)?;
            let mut after = try_to_vec(&before, POINTS)?;
            system.solve(&before, &mut after, if k == 0 { 0.0 } else { f32::MIN }, self.stage)?;
            for (d, after) in stitched.iter_mut().zip(after) {
                *(if k == 0 { &mut d.l0 } else { &mut d.l1[k - 1] }) = after.into();
            }
        }
        stitched.par_iter_mut().each(|d| *d = d.valid());
        Ok(stitched)
    }

    fn reserve(&self, bytes: usize, what: &str) -> Result<Reservation> {
        if self.budget != 0 && bytes as u64 > self.budget {
            return Err(Error::OutOfMemory(format!(
                "{what} take {bytes} bytes, more than memory_budget {}",
                self.budget
            )));
        }
        self.atlas.scene.device().memory().reserve(bytes, what)
    }

    /// Finds the edges that are cut open, each with its two sides. If three or more triangles share an edge, another
    /// surface stands on this one, and light need not continue below it.
    fn edges(&self) -> Result<Vec<[Side; 2]>> {
        let charts = &self.atlas.charts;
        let (mut edges, mut others) = (Vec::new(), Vec::new());
        for (number, sheet) in (0..).zip(&charts.shared) {
            let [inside, alone] = self.edges_of(sheet)?;
            // Of instances that show another one's light, neighbours in the scene are not neighbours of that light.
            let own = (0..).zip(&charts.places).filter(|&(i, place)| place.sheet == number && place.shown == i);
            let places = try_collect(own.map(|(_, place)| place), SEAMS)?;
            let shift = |place: &Place| place.first_triangle.wrapping_sub(sheet.first_triangle);
            let found = try_par_gather(places.len(), SEAMS, |i, out| {
                self.stage.check()?;
                inside.iter().try_for_each(|edge| self.push_seams(edge.map(|side| side.shifted(shift(places[i]))), out))
            })?;
            if edges.is_empty() {
                edges = found;
            } else {
                try_append(&mut edges, &found, SEAMS)?;
            }
            for place in places {
                others.try_reserve(alone.len()).map_err(|e| Error::OutOfMemory(format!("{SEAMS}: {e}")))?;
                others.extend(alone.iter().map(|[side, _]| side.shifted(shift(place))));
            }
        }
        let sides = Sides { triangles: &charts.own.triangles, first_triangle: 0, others: &others };
        let found = self.for_each_edge(&sides, &|same, out| match *same {
            [(_, a), (_, b)] => self.push_seams([a, b], out),
            _ => Ok(()),
        })?;
        try_append(&mut edges, &found, SEAMS)?;
        // Sorted, since neighbours in the scene use the same texels.
        sort(&mut edges, &|| self.stage.check())?;
        Ok(edges)
    }

    /// Returns the edges between two triangles of a sheet that may be seams, and the sides that one triangle has alone
    /// (twice each), all where the sheet was made.
    fn edges_of(&self, sheet: &Sheet) -> Result<[Vec<[Side; 2]>; 2]> {
        let sides = Sides { triangles: &sheet.triangles, first_triangle: sheet.first_triangle, others: &[] };
        let found = self.for_each_edge(&sides, &|same, out| match *same {
            [(_, a)] => try_push(out, [a, a], SEAMS),
            [(_, a), (_, b)] if self.may_be_cut([a, b]) => try_push(out, [a, b], SEAMS),
            _ => Ok(()),
        })?;
        let part = |alone: bool| try_collect(found.iter().copied().filter(|[a, b]| (a == b) == alone), SEAMS);
        Ok([part(false)?, part(true)?])
    }

    fn for_each_edge<T: Send>(&self, sides: &Sides, visit: &sides::Visit<'_, T>) -> Result<Vec<T>> {
        let scene = &self.atlas.scene;
        let _memory =
            self.reserve(sides::bytes(sides.len(), scene.device().num_threads()), "the edges of the charts")?;
        for_each_edge(scene, sides, self.stage, visit)
    }

    /// Adds the seams of an edge in all pairs of placements.
    fn push_seams(&self, edge: [Side; 2], out: &mut Vec<[Side; 2]>) -> Result<()> {
        let mut seams = self.in_places(edge).filter(|&edge| self.is_seam(edge));
        seams.try_for_each(|edge| try_push(out, edge, SEAMS))
    }

    /// Whether the two triangles of an edge have different charts, or it has different places in their chart, or the
    /// chart has placements for both sides: else the light map continues across it in every instance.
    fn may_be_cut(&self, edge: [Side; 2]) -> bool {
        let [a, b] = edge;
        let [at_a, at_b] = self.in_charts(edge);
        self.chart(a) != self.chart(b) || self.atlas.charts[self.chart(a)].two_sided || at_a != at_b
    }

    fn chart(&self, side: Side) -> ChartId {
        self.atlas.charts.chart_of(side.triangle())
    }

    /// Returns the edge in all pairs of placements of its two triangles.
    fn in_places(&self, edge: [Side; 2]) -> impl Iterator<Item = [Side; 2]> + use<> {
        let [a, b] = edge.map(|side| {
            let second = self.atlas.map.layout.back(self.chart(side)).map(|_| side.second());
            [Some(side), second].into_iter().flatten()
        });
        a.flat_map(move |a| b.clone().map(move |b| [a, b]))
    }

    fn placement(&self, side: Side) -> PlacementId {
        self.atlas.map.layout.place_of(self.chart(side), !side.is_second())
    }

    fn is_back(&self, side: Side) -> bool {
        side.is_second() || self.backs.get(self.chart(side).index()).is_some_and(|&b| b)
    }

    /// Whether the second side runs from the first one's end to its start, as in a mesh of consistent winding.
    fn runs_back(&self, [a, b]: [Side; 2]) -> bool {
        let [start, _] = a.ends(self.atlas.scene.corners(a.triangle()));
        let [_, end] = b.ends(self.atlas.scene.corners(b.triangle()));
        start == end
    }

    /// Whether the surface continues smoothly across an edge, on the sides that are shown, but the light map does not.
    fn is_seam(&self, edge: [Side; 2]) -> bool {
        let [a, b] = edge;
        let ends = edge.map(|s| s.ends(self.atlas.scene.corners(s.triangle())));
        let runs_back = self.runs_back(edge);
        let other = if runs_back { [ends[1][1], ends[1][0]] } else { ends[1] };
        if ends[0] != other || runs_back == (self.is_back(a) != self.is_back(b)) {
            return false;
        }
        let [at_a, at_b] = self.in_charts(edge);
        let apart = |i: usize| (self.texel(a, at_a[i]) - self.texel(b, at_b[i])).length() > 1e-3;
        if self.placement(a) == self.placement(b) && !apart(0) && !apart(1) {
            return false;
        }
        let normal = |side: Side, s: f32| {
            // Weights of the corners 1 and 2.
            let [u, v] = [[s, 0.0], [1.0 - s, s], [0.0, 1.0 - s]][side.corner()];
            let n = TexelSample { triangle: side.triangle(), u, v, x: 0, y: 0 }.shading_normal(&self.atlas.scene);
            if self.is_back(side) { -n } else { n }
        };
        [0.0, 1.0].into_iter().all(|s| {
            let along_b = if runs_back { 1.0 - s } else { s };
            normal(a, s).dot(normal(b, along_b)) > SMOOTH_COSINE
        })
    }

    /// Returns start and end of an edge in the charts of both sides.
    fn in_charts(&self, edge: [Side; 2]) -> [[Vec2; 2]; 2] {
        let corners = |s: Side| s.ends(self.atlas.charts.corners(s.triangle()).map(Vec2::from_array));
        let [a, [start, end]] = edge.map(corners);
        [a, if self.runs_back(edge) { [end, start] } else { [start, end] }]
    }

    /// Returns the texel coordinate of a point of a side's chart.
    fn texel(&self, side: Side, local: Vec2) -> Vec2 {
        self.atlas.map.layout.texel_coord(self.placement(side), local.to_array()).into()
    }

    /// Returns the length of an edge in texels, on the side where it is longer.
    fn length(&self, edge: &[Side; 2]) -> f32 {
        let locals = self.in_charts(*edge);
        let length = |i: usize| (self.texel(edge[i], locals[i][0]) - self.texel(edge[i], locals[i][1])).length();
        length(0).max(length(1))
    }

    fn point_count(&self, edge: &[Side; 2]) -> usize {
        ((self.length(edge) / SPACING).ceil() as usize).max(1)
    }

    fn points(&self, edge: &[Side; 2]) -> impl Iterator<Item = Point> {
        let (edge, locals, n) = (*edge, self.in_charts(*edge), self.point_count(edge));
        let length = self.length(&edge) / n as f32;
        (0..n).map(move |i| {
            let s = (i as f32 + 0.5) / n as f32;
            let mut point = Point { length, ..Default::default() };
            for (side, sign) in [(0, 1.0), (1, -1.0)] {
                let local = locals[side][0].lerp(locals[side][1], s);
                let mut at = 4 * side;
                self.atlas.map.bilinear(self.placement(edge[side]), local.to_array(), |texel, weight| {
                    (point.texels[at], point.weights[at]) = (texel.index() as u32, sign * weight);
                    at += 1;
                });
                // Unused entries repeat a used texel, with weight 0.
                let used = point.texels[4 * side];
                point.texels[at..4 * side + 4].fill(used);
            }
            point
        })
    }
}

/// Whether the two sides of a point use different texels, or the same ones with different weights. (Charts that the
/// caller placed side by side share texels. A placement without texels has weights 0.)
fn is_cut(p: &Point) -> bool {
    let sum: f32 = p.weights.iter().map(|w| w.abs()).sum();
    let part = |t: u32| p.texels.iter().zip(&p.weights).filter(|(u, _)| **u == t).map(|(_, w)| w).sum::<f32>();
    sum > 1.5 && p.texels.iter().any(|&t| part(t).abs() > 1e-3)
}

/// Replaces texels by their numbers among the texels that points use. Returns those texels, ascending.
fn number(points: &mut [Point], texels: usize, stage: &Stage) -> Result<Vec<u32>> {
    let mut number_of: Vec<u32> = try_vec(texels, "the numbers of the seams' texels")?;
    number_of.fill(NONE);
    for part in points.chunks(CHUNK) {
        stage.check()?;
        part.iter().flat_map(|p| p.texels).for_each(|t| number_of[t as usize] = 0);
    }
    let used = try_par_filter(texels, POINTS, |t| number_of[t as usize] != NONE)?;
    stage.check()?;
    (0..).zip(&used).for_each(|(i, &t)| number_of[t as usize] = i);
    points.par_iter_mut().each(|p| p.texels = p.texels.map(|t| number_of[t as usize]));
    Ok(used)
}

/// Adds the second layer to the first.
fn combine(layers: &mut [Vec<Vec3A>; 2]) -> Vec<Vec3A> {
    let [first, second] = layers;
    first.iter_mut().zip(second).for_each(|(a, b)| *a += *b);
    std::mem::take(first)
}

#[cfg(test)]
mod tests;
