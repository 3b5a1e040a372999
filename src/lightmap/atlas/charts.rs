//! Charts: pieces of surface that are flat in the light map (thesis 3.2.3).
//!
//! Charts come from the caller's UVs where those are usable, else from `super::unwrap`. They do not depend on texels:
//! their coordinates are in scene units, and each map packs them at its own density ([`super::layout`]).

use super::alike::{self, Source};
use super::ids::ChartId;
pub use super::pieces::Given;
use super::pieces::{CHARTS, Groups, KnownPieces, Piece, connected, float_key, surface_kind, triangle_area};
pub use super::sheets::Chart;
use super::sheets::{Place, Shape, Sheet, scaled};
use super::unwrap;
use crate::base::bounds::Bounds;
use crate::base::error::{Error, Result, invalid_argument};
use crate::base::memory::{try_collect, try_push, try_with_capacity};
use crate::base::progress::{Progress, Stage};
use crate::device::LogLevel;
use crate::scene::{LightmapUvs, Mesh, Scene};
use crate::simd::prefetch;
use glam::{DVec2, Vec2};
use std::collections::BTreeMap;
use std::ops::{Index, Range};
use std::time::Instant;

/// Maximum number of texels in all pages of a map. Samples and indices of this many take 10 GB.
pub const MAX_TEXELS: u64 = 1 << 29;

/// Maximum size of a page, in texels along an axis: texels are addressed in 16 bits.
pub const MAX_PAGE_SIZE: u32 = 16384;

/// Maximum number of times that given UVs may cover a page. If they cover it more often, they cannot have been meant to
/// be unique (an engine's per-mesh UVs without page numbers, for instance), and the triangles are unwrapped instead. Up
/// to this limit, overlaps are accepted and counted.
const MAX_PAGE_COVER: f64 = 2.0;

/// Numbers about the UVs of a scene.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct UvReport {
    /// Charts taken from the caller's UVs.
    pub given_charts: u32,
    /// Charts made by unwrapping.
    pub unwrapped_charts: u32,
    /// Triangles with UVs outside [0, 1] or not finite; unwrapped instead.
    pub out_of_range: u64,
    /// Triangles without area in UV space though not in space; unwrapped instead.
    pub degenerate: u64,
    /// Triangles on pages that the given UVs cover more than twice over; unwrapped instead.
    pub overlapping: u64,
    /// Texels whose centre is covered by several triangles with given UVs.
    pub overlapping_texels: u64,
    /// Charts reduced in density to fit a page.
    pub reduced_charts: u32,
    /// Duration of unwrapping in seconds.
    pub seconds: f64,
}

/// All charts of a scene, indexed by [`ChartId`]: those of meshes, of which those with given placement come first,
/// ordered by page, then those of instances.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Charts {
    /// The charts, by number.
    pub charts: Vec<Chart>,
    /// The meshes that stand in the scene themselves, with the global numbers of their triangles.
    pub(in crate::lightmap) own: Sheet,
    /// The sheets of instances.
    pub(in crate::lightmap) shared: Vec<Sheet>,
    /// The instances.
    pub(in crate::lightmap) places: Vec<Place>,
}

impl Index<ChartId> for Charts {
    type Output = Chart;

    #[inline]
    fn index(&self, chart: ChartId) -> &Chart {
        &self.charts[chart.index()]
    }
}

impl Charts {
    /// Makes the charts of a scene: from the caller's UVs where they are usable, else by unwrapping.
    ///
    /// A triangle's UVs are usable if all are within half a texel of [0, 1] and enclose an area. `texels_per_unit`
    /// (finite, > 0), `page_size` and `padding` (texels) are those of the finest map: unwrapped charts that would not
    /// fit its pages are cut along triangle borders, if possible. `OutOfMemory` if the surface would take more than
    /// [`MAX_TEXELS`] at this density, `InvalidArgument` if pages up to a given page number would.
    ///
    /// Reports as stage "unwrap" from 0 to 0.5 of the bar.
    pub fn of_scene(
        scene: &Scene,
        texels_per_unit: f32,
        page_size: u32,
        padding: u32,
        progress: &Progress,
    ) -> Result<(Charts, UvReport)> {
        Self::of_scene_with(scene, texels_per_unit, page_size, padding, None, progress)
    }

    /// Same as [`of_scene`](Self::of_scene), but curved triangles whose charts are `known` are not unwrapped.
    pub(in crate::lightmap) fn of_scene_with(
        scene: &Scene,
        texels_per_unit: f32,
        page_size: u32,
        padding: u32,
        known: Option<KnownPieces>,
        progress: &Progress,
    ) -> Result<(Charts, UvReport)> {
        let start = Instant::now();
        let max_extent = padded_extent(page_size, padding)? as f64 / texels_per_unit as f64;
        check_density(surface_area(scene)?, texels_per_unit)?;
        let stage = progress.stage("unwrap", 0.0, 0.5, scene.triangle_count() as u64 + 1);
        let sources = alike::sources(scene, &stage)?;
        let made = (0..).zip(&sources).filter(|(i, source)| source.instance == *i).map(|(i, _)| i);
        let made: Vec<u32> = try_collect(made.map(|i: u32| scene.object_of_instance(i)), CHARTS)?;
        // Memory of pieces and charts, which exist at the same time, and of the meshes that are unwrapped.
        let objects = || (0..scene.meshes().len() as u32).chain(made.iter().copied());
        let total: usize = objects().map(|o| scene.triangles_of(o).len()).sum();
        let vertices = objects().map(|o| scene.object(o).mesh().positions.len()).sum();
        let bytes = scene.device().in_memory(2 * Self::BYTES_PER_TRIANGLE * total)
            + unwrap::bytes(total, vertices, scene.device().num_threads());
        let _memory = scene.device().memory().reserve(bytes, CHARTS)?;
        let (charts, mut report) = scene.device().install(|| {
            let mut report = UvReport::default();
            let (mut pieces, rest) = given_pieces(scene, page_size, &mut report, &stage)?;
            let own = scene.triangles_of_meshes();
            stage.advance(own.len() as u64 - rest.len() as u64)?;
            report.given_charts = pieces.len() as u32;
            for piece in unwrap::unwrap(scene, &rest, known, &stage)? {
                stage.check()?;
                split_to_fit(piece, max_extent as f32, &mut pieces)?;
            }
            for &object in &made {
                let valid = try_collect(scene.triangles_of(object).filter(|&t| scene.is_valid(t)), CHARTS)?;
                stage.advance((scene.triangles_of(object).len() - valid.len()) as u64)?;
                // As small as the largest of the instances needs them.
                let instance = object - scene.object_of_instance(0);
                let largest = sources.iter().filter(|s| s.instance == instance).fold(1.0f32, |m, s| m.max(s.factor));
                for piece in unwrap::unwrap(scene, &valid, known, &stage)? {
                    stage.check()?;
                    split_to_fit(piece, max_extent as f32 / largest, &mut pieces)?;
                }
            }
            let charts = Charts::assemble(scene, pieces, &sources, &stage)?;
            report.unwrapped_charts = charts.charts.len() as u32 - report.given_charts;
            Ok((charts, report))
        })?;
        stage.advance(1)?;
        report.seconds = start.elapsed().as_secs_f64();
        log_report(scene, &report);
        Ok((charts, report))
    }

    /// Size in bytes of a triangle's entries, for memory accounts.
    pub(crate) const BYTES_PER_TRIANGLE: usize = 24 + 4 + 4;

    /// Returns the size in bytes.
    pub fn bytes(&self) -> usize {
        self.sheets().map(|(sheet, _)| sheet.bytes()).sum::<usize>()
            + size_of_val(&self.charts[..])
            + size_of_val(&self.places[..])
    }

    /// Returns the numbers of all charts.
    pub fn ids(&self) -> impl ExactSizeIterator<Item = ChartId> + use<> {
        (0..self.charts.len()).map(ChartId::new)
    }

    /// Returns the chart of a global triangle, [`ChartId::NONE`] for degenerate ones.
    #[inline]
    pub fn chart_of(&self, triangle: u32) -> ChartId {
        match self.own.of_triangles.get(triangle as usize) {
            Some(&chart) => chart,
            None => self.of_instance(triangle).expect("a triangle of the scene"),
        }
    }

    /// Returns the chart of what may be a triangle of an instance; `None` if there is no such triangle.
    fn of_instance(&self, triangle: u32) -> Option<ChartId> {
        let (place, sheet, own) = self.shown_by(triangle)?;
        Some(match sheet.of_triangles[own as usize] {
            ChartId::NONE => ChartId::NONE,
            chart => ChartId::new(place.first_chart.index() + chart.index()),
        })
    }

    /// Asks for chart and corners of a triangle of a mesh. (Those of instances are found by a search first.)
    #[inline]
    pub(in crate::lightmap) fn prefetch(&self, triangle: u32) {
        if let (Some(chart), Some(corners)) =
            (self.own.of_triangles.get(triangle as usize), self.own.corners.get(triangle as usize))
        {
            prefetch(chart);
            prefetch(corners);
        }
    }

    /// Returns the chart of what may be a global triangle; `None` if there is no such triangle, or it has no chart.
    pub(in crate::lightmap) fn find(&self, triangle: u32) -> Option<ChartId> {
        let own = self.own.of_triangles.get(triangle as usize).copied();
        own.or_else(|| self.of_instance(triangle)).filter(|&chart| chart != ChartId::NONE)
    }

    /// Returns the global triangle numbers of a chart, ascending.
    pub fn triangles_of(&self, chart: ChartId) -> impl ExactSizeIterator<Item = u32> + Clone + use<'_> {
        let Range { start, end } = self[chart].triangles;
        let Shape { sheet, first_triangle, .. } = self.shape(chart);
        sheet.triangles[start as usize..end as usize].iter().map(move |&t| first_triangle + t)
    }

    /// Returns a box around a chart.
    pub(in crate::lightmap) fn bounds(&self, scene: &Scene, chart: ChartId) -> Bounds {
        let mut bounds = Bounds::EMPTY;
        for triangle in self.triangles_of(chart) {
            let (object, of_object) = scene.locate(triangle);
            scene.object(object).corners(of_object).into_iter().for_each(|corner| bounds.add(corner));
        }
        bounds
    }

    /// Returns the local coordinates of the corners of a global triangle.
    #[inline]
    pub fn corners(&self, triangle: u32) -> [[f32; 2]; 3] {
        match self.own.corners.get(triangle as usize) {
            Some(&corners) => corners,
            None => self.corners_in_instance(triangle),
        }
    }

    fn corners_in_instance(&self, triangle: u32) -> [[f32; 2]; 3] {
        let (place, sheet, own) = self.shown_by(triangle).expect("a triangle of the scene");
        scaled(sheet.corners[own as usize], place.factor)
    }

    /// Returns the local coordinates of the point of a global triangle with weights `u` and `v` of its corners 1 and 2.
    #[inline]
    pub fn local(&self, triangle: u32, u: f32, v: f32) -> [f32; 2] {
        let [a, b, c] = self.corners(triangle).map(Vec2::from_array);
        (a * (1.0 - u - v) + b * u + c * v).to_array()
    }

    /// Number of charts of meshes that stand in the scene themselves, which come first.
    pub(super) fn own_charts(&self) -> usize {
        self.places.first().map_or(self.charts.len(), |place| place.first_chart.index())
    }

    /// Returns the place whose charts a triangle of an instance has, its sheet, and the triangle's number in that; `None` if
    /// there is no such triangle.
    fn shown_by(&self, triangle: u32) -> Option<(&Place, &Sheet, u32)> {
        let after = self.places.partition_point(|place| place.first_triangle <= triangle);
        let place = self.places.get(after.checked_sub(1)?)?;
        let (sheet, own) = (&self.shared[place.sheet as usize], triangle - place.first_triangle);
        let shown = &self.places[place.shown as usize];
        ((own as usize) < sheet.of_triangles.len()).then_some((shown, sheet, own))
    }

    /// Whether a triangle has texels of its own, if it has any: it is not of an instance that shows another one's.
    pub(in crate::lightmap) fn is_own(&self, triangle: u32) -> bool {
        let after = self.places.partition_point(|place| place.first_triangle <= triangle);
        after.checked_sub(1).is_none_or(|number| self.places[number].shown as usize == number)
    }

    /// Returns the number of objects that have a chart.
    pub(in crate::lightmap) fn times_shown(&self, chart: ChartId) -> u32 {
        if chart.index() < self.own_charts() { 1 } else { self.place_with(chart).times }
    }

    /// Returns the instance that has a chart of its own.
    fn place_with(&self, chart: ChartId) -> &Place {
        // The last place from whose first chart on it lies: those without charts come before the next one that has some.
        &self.places[self.places.partition_point(|place| place.first_chart <= chart) - 1]
    }

    /// Returns a chart as it is in its sheet.
    pub(in crate::lightmap) fn shape(&self, chart: ChartId) -> Shape<'_> {
        if chart.index() < self.own_charts() {
            return Shape { sheet: &self.own, first_triangle: 0, factor: 1.0, number: chart.index() };
        }
        let place = self.place_with(chart);
        let sheet = &self.shared[place.sheet as usize];
        let number = sheet.first_shape as usize + chart.index() - place.first_chart.index();
        Shape { sheet, first_triangle: place.first_triangle, factor: place.factor, number }
    }

    /// Returns all sheets, with their charts where they were made.
    pub(in crate::lightmap) fn sheets(&self) -> impl Iterator<Item = (&Sheet, &[Chart])> {
        let charts = |sheet: &Sheet| &self.charts[sheet.charts.start as usize..sheet.charts.end as usize];
        std::iter::once(&self.own).chain(&self.shared).map(move |sheet| (sheet, charts(sheet)))
    }

    /// Makes charts of pieces with global triangle numbers: those of meshes, of which those with given placement come
    /// first, ordered by page; then those of each instance that is its own source.
    pub(in crate::lightmap) fn assemble(
        scene: &Scene,
        pieces: Vec<Piece>,
        sources: &[Source],
        stage: &Stage,
    ) -> Result<Charts> {
        let mut charts = Vec::new();
        let mut pieces = pieces.into_iter().peekable();
        let mut of_range = |range: Range<u32>, charts: &mut Vec<Chart>, first_shape: usize| {
            let end = range.end;
            let of_range = std::iter::from_fn(|| pieces.next_if(|piece| piece.triangles[0] < end));
            Sheet::new(scene, range, of_range, charts, first_shape, stage)
        };
        let own = of_range(scene.triangles_of_meshes(), &mut charts, 0)?;
        let mut shapes = charts.len();
        let mut shared: Vec<Sheet> = Vec::new();
        let mut places: Vec<Place> = try_with_capacity(sources.len(), CHARTS)?;
        for (instance, source) in (0..).zip(sources) {
            stage.check()?;
            let triangles = scene.triangles_of(scene.object_of_instance(instance));
            let (first_triangle, first_chart) = (triangles.start, ChartId::new(charts.len()));
            let mut shown = instance;
            let sheet = if let Some(of) = scene.instances()[instance as usize].light_of {
                stage.advance(triangles.len() as u64)?;
                let other: &Place = &places[of as usize];
                shown = other.shown;
                other.sheet
            } else if source.instance == instance {
                try_push(&mut shared, of_range(triangles, &mut charts, shapes)?, CHARTS)?;
                shapes += charts.len() - first_chart.index();
                shared.len() as u32 - 1
            } else {
                let sheet = places[source.instance as usize].sheet;
                for of_source in shared[sheet as usize].charts.clone() {
                    let Chart { ref triangles, size, area, two_sided, given } = charts[of_source as usize];
                    let (triangles, size) = (triangles.clone(), size.map(|x| x * source.factor));
                    let area = area * source.factor * source.factor;
                    try_push(&mut charts, Chart { triangles, size, area, two_sided, given }, CHARTS)?;
                }
                stage.advance(triangles.len() as u64)?;
                sheet
            };
            places.push(Place { first_triangle, first_chart, shown, times: 0, sheet, factor: source.factor });
            places[shown as usize].times += 1;
            if charts.len() as u64 > MAX_TEXELS {
                return Err(Error::OutOfMemory(format!("instances have more than {MAX_TEXELS} charts")));
            }
        }
        Ok(Charts { charts, own, shared, places })
    }
}

/// Returns the area of all valid triangles that have texels of their own, in squared scene units.
pub fn surface_area(scene: &Scene) -> Result<f64> {
    let area = |object: u32| -> f64 {
        scene.triangles_of(object).filter(|&t| scene.is_valid(t)).map(|t| triangle_area(scene, t)).sum()
    };
    let of_meshes: f64 = (0..scene.meshes().len() as u32).map(area).sum();
    let mut of_instances: Vec<f64> = try_with_capacity(scene.instances().len(), CHARTS)?;
    for (instance, source) in (0..).zip(alike::sources_by_transform(scene)?) {
        let object = scene.object_of_instance(instance);
        of_instances.push(if scene.shows_light_of_other(object) {
            0.0
        } else if source.instance == instance {
            area(object)
        } else {
            of_instances[source.instance as usize] * f64::from(source.factor).powi(2)
        });
    }
    Ok(of_meshes + of_instances.iter().sum::<f64>())
}

/// Returns the density in texels per scene unit at which the scene's surface fills about `pages` pages, two thirds of
/// each page's texels being covered.
pub fn automatic_density(scene: &Scene, page_size: u32, pages: f64) -> Result<f32> {
    let texels = pages * (page_size as f64).powi(2) * 2.0 / 3.0;
    Ok(((texels / surface_area(scene)?).sqrt() as f32).clamp(f32::MIN_POSITIVE, f32::MAX))
}

/// Returns the number of texels that a chart may take along an axis of a page; checks page size and padding.
pub(in crate::lightmap) fn padded_extent(page_size: u32, padding: u32) -> Result<u32> {
    if !(1..=MAX_PAGE_SIZE).contains(&page_size) {
        return invalid_argument!("page_size is {page_size}, outside 1 to {MAX_PAGE_SIZE}");
    }
    match page_size.checked_sub(padding.saturating_mul(2)) {
        Some(extent) if extent > 0 => Ok(extent),
        _ => invalid_argument!("padding {padding} on both sides leaves nothing of page_size {page_size}"),
    }
}

fn check_density(area: f64, texels_per_unit: f32) -> Result<()> {
    if !(texels_per_unit > 0.0 && texels_per_unit.is_finite()) {
        return invalid_argument!("texels_per_unit is {texels_per_unit}, not a finite number above 0");
    }
    let texels = area * (texels_per_unit as f64).powi(2);
    if texels > MAX_TEXELS as f64 {
        return Err(Error::OutOfMemory(format!(
            "texels_per_unit {texels_per_unit} on a surface of {area:.3} squared units makes {texels:.3e} texels, \
             more than {MAX_TEXELS}"
        )));
    }
    Ok(())
}

fn log_report(scene: &Scene, report: &UvReport) {
    let unusable = report.out_of_range + report.degenerate + report.overlapping;
    if unusable > 0 {
        scene.device().log(
            LogLevel::Warning,
            &format!(
                "the light map UVs of {unusable} triangles are not usable and were replaced by unwrapping \
                 ({} out of range, {} without area, {} on pages covered more than twice over)",
                report.out_of_range, report.degenerate, report.overlapping
            ),
        );
    }
}

/// Returns lower and upper corner of local coordinates.
fn bounds(corners: &[[[f32; 2]; 3]]) -> (Vec2, Vec2) {
    let points = corners.iter().flatten().map(|&p| Vec2::from_array(p));
    points.fold((Vec2::INFINITY, Vec2::NEG_INFINITY), |(lo, hi), p| (lo.min(p), hi.max(p)))
}

/// Cuts a piece in halves, along triangle borders, until each is at most `max_extent` wide and high. If that does not
/// help (large triangles reach across the cut), the piece stays, and the layout reduces its density.
fn split_to_fit(piece: Piece, max_extent: f32, out: &mut Vec<Piece>) -> Result<()> {
    let mut stack = vec![piece];
    while let Some(piece) = stack.pop() {
        let (lower, upper) = bounds(&piece.corners);
        let axis = if upper.x - lower.x >= upper.y - lower.y { 0 } else { 1 };
        let extent = (upper - lower)[axis];
        if extent <= max_extent || piece.triangles.len() == 1 {
            try_push(out, piece, CHARTS)?;
            continue;
        }
        let middle = (0.5 * (lower + upper))[axis];
        let is_low = |c: &[[f32; 2]; 3]| (c[0][axis] + c[1][axis] + c[2][axis]) / 3.0 < middle;
        let half = |low: bool| -> Result<Piece> {
            let kept = || piece.triangles.iter().zip(&piece.corners).filter(|(_, c)| is_low(c) == low);
            let triangles = try_collect(kept().map(|(&t, _)| t), CHARTS)?;
            let corners = try_collect(kept().map(|(_, &c)| c), CHARTS)?;
            Ok(Piece { triangles: triangles.into(), corners: corners.into(), given: None })
        };
        let halves = [half(true)?, half(false)?];
        let shrinks = |p: &Piece| {
            let (lower, upper) = bounds(&p.corners);
            // A cut that leaves a half longer than this adds border texels and hardly makes charts smaller.
            !p.triangles.is_empty() && (upper - lower)[axis] <= 0.8 * extent
        };
        if halves.iter().all(shrinks) {
            let [low, high] = halves;
            stack.extend([high, low]);
        } else {
            try_push(out, piece, CHARTS)?;
        }
    }
    Ok(())
}

/// Returns pieces from the caller's UVs, ordered by page, and the other valid triangles of meshes, ascending. (The UVs of an
/// instanced mesh do not count: all its instances would have the same place.)
fn given_pieces(scene: &Scene, page_size: u32, report: &mut UvReport, stage: &Stage) -> Result<(Vec<Piece>, Vec<u32>)> {
    let mut rest = Vec::new();
    let mut usable = Vec::new();
    let mut cover = BTreeMap::<u32, f64>::new();
    for m in 0..scene.meshes().len() as u32 {
        let triangles = scene.triangles_of(m);
        let (mesh, first) = (scene.object(m).mesh(), triangles.start);
        for t in (0..triangles.len()).filter(|&t| scene.is_valid(first + t as u32)) {
            stage.check()?;
            let Some(lightmap) = &mesh.lightmap else {
                try_push(&mut rest, first + t as u32, CHARTS)?;
                continue;
            };
            let page = given_page(lightmap, m, t, page_size)?;
            match uv_area(mesh, lightmap, t, page_size) {
                Some(area) if area > 0.0 => {
                    *cover.entry(page).or_default() += area;
                    try_push(&mut usable, (first + t as u32, page), CHARTS)?;
                    continue;
                }
                Some(_) => report.degenerate += 1,
                None => report.out_of_range += 1,
            }
            try_push(&mut rest, first + t as u32, CHARTS)?;
        }
    }
    let is_kept = |page: u32| cover[&page] <= MAX_PAGE_COVER;
    let without_overlapping = rest.len();
    for &(t, _) in usable.iter().filter(|(_, page)| !is_kept(*page)) {
        try_push(&mut rest, t, CHARTS)?;
    }
    report.overlapping = (rest.len() - without_overlapping) as u64;
    rest.sort_unstable();
    let mut kept = usable;
    kept.retain(|(_, page)| is_kept(*page));

    let mut pieces = Vec::new();
    for of_mesh in kept.chunk_by(|a, b| scene.locate(a.0).0 == scene.locate(b.0).0) {
        for piece in islands(scene, of_mesh, stage)? {
            try_push(&mut pieces, piece, CHARTS)?;
        }
    }
    pieces.sort_unstable_by_key(|p: &Piece| (p.given.map(|g| g.page), p.triangles[0]));
    Ok((pieces, rest))
}

fn given_page(lightmap: &LightmapUvs, mesh: u32, triangle: usize, page_size: u32) -> Result<u32> {
    let page = lightmap.pages.get(triangle).copied().unwrap_or(0);
    let limit = MAX_TEXELS / (page_size as u64).pow(2);
    if page as u64 >= limit {
        return invalid_argument!(
            "lightmap_page of triangle {triangle} of mesh {mesh} is {page}; with pages of {page_size}×{page_size} \
             texels there can be {limit}"
        );
    }
    Ok(page)
}

/// Returns the area of a triangle in UV space, `None` if its UVs are not finite or more than half a texel outside [0,
/// 1].
fn uv_area(mesh: &Mesh, lightmap: &LightmapUvs, triangle: usize, page_size: u32) -> Option<f64> {
    let tolerance = 0.5 / page_size as f32;
    let uvs = mesh.indices[triangle].map(|i| lightmap.uvs[i as usize]);
    let inside = |uv: &Vec2| uv.to_array().iter().all(|c| (-tolerance..=1.0 + tolerance).contains(c));
    let [a, b, c] = uvs.map(|uv| uv.as_dvec2());
    uvs.iter().all(inside).then(|| 0.5 * (b - a).perp_dot(c - a).abs())
}

/// Returns the pieces of one mesh: its `triangles` with usable UVs and their pages, connected through equal vertices.
fn islands(scene: &Scene, triangles: &[(u32, u32)], stage: &Stage) -> Result<Vec<Piece>> {
    let mesh = scene.object(scene.locate(triangles[0].0).0).mesh();
    let uvs = &mesh.lightmap.as_ref().expect("the mesh has UVs").uvs;
    let corner = |t: u32, k: usize| mesh.indices[scene.locate(t).1 as usize][k] as usize;
    let mut keys = try_with_capacity(triangles.len() * 3, CHARTS)?;
    for (n, &(t, page)) in triangles.iter().enumerate() {
        let kind = surface_kind(scene.material(t));
        for k in 0..3 {
            let i = corner(t, k);
            let [u, v] = uvs[i].to_array().map(float_key);
            keys.push(((page, kind, [u, v], mesh.positions[i].to_array().map(float_key)), n as u32));
        }
    }
    stage.check()?;
    let groups = Groups::new(&connected(triangles.len(), keys, stage)?, stage)?;
    let mut pieces = Vec::new();
    for group in groups.iter() {
        stage.check()?;
        let page = triangles[group[0] as usize].1;
        let numbers = try_collect(group.iter().map(|&n| triangles[n as usize].0), CHARTS)?;
        let corners = try_collect(numbers.iter().map(|&t| [0, 1, 2].map(|k| uvs[corner(t, k)])), CHARTS)?;
        try_push(&mut pieces, given_piece(scene, page, numbers, &corners)?, CHARTS)?;
    }
    Ok(pieces)
}

/// Makes a piece from UVs: local coordinates are scaled so that the piece keeps its area, and its placement maps them
/// back to the UVs.
fn given_piece(scene: &Scene, page: u32, triangles: Vec<u32>, uvs: &[[Vec2; 3]]) -> Result<Piece> {
    let lower = uvs.iter().flatten().fold(Vec2::INFINITY, |m, &p| m.min(p));
    let twice_area = |[a, b, c]: [DVec2; 3]| (b - a).perp_dot(c - a).abs();
    let area_uv: f64 = uvs.iter().map(|t| 0.5 * twice_area(t.map(|uv| uv.as_dvec2()))).sum();
    let area: f64 = triangles.iter().map(|&t| triangle_area(scene, t)).sum();
    let scale = (area / area_uv).sqrt();
    let local = |uv: Vec2| ((uv - lower).as_dvec2() * scale).as_vec2().to_array();
    Ok(Piece {
        triangles: triangles.into(),
        corners: try_collect(uvs.iter().map(|t| t.map(local)), CHARTS)?.into(),
        given: Some(Given { page, offset: lower.to_array(), scale: [(1.0 / scale) as f32; 2] }),
    })
}

#[cfg(test)]
pub(super) mod tests;
