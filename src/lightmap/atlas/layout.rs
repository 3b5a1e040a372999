//! Layouts: the placement of each chart in the pages of a map of a given resolution (thesis 3.2.3).
//!
//! The light map, the gather map and the radiance map show the same charts at different densities.
//! Each packs them anew, so that no texel of a coarse map is shared by two charts. Only the light
//! map keeps the caller's placement.
//!
//! Rectangles are packed along a skyline (bottom left), highest first, after Jylänki, *A Thousand
//! Ways to Pack the Bin* (2010). Shelves (the crate `etagere`) took more pages for the same
//! rectangles: 12 instead of 10 for Sponza's light map, 25 instead of 11 for its radiance map.

use super::charts::{Chart, Charts, MAX_TEXELS, padded_extent};
use super::ids::{ChartId, PlacementId};
use super::pieces::Given;
use crate::base::error::{Error, Result, invalid_argument};
use crate::base::memory::{try_collect, try_filled, try_to_vec, try_with_capacity};
use crate::base::progress::Progress;
use std::ops::Index;

/// Name of the buffers in error messages.
const LAYOUT: &str = "the layout of the charts";

/// Placement of a chart in a page. Texel coordinates of a page are continuous: texel i covers [i, i + 1].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Placement {
    /// Number of the page.
    pub page: u32,
    /// First column of the rectangle of texels that the chart owns, padding included. (The rectangles of given charts
    /// may overlap.)
    pub x: u16,
    /// First row of the rectangle.
    pub y: u16,
    /// Columns of the rectangle.
    pub w: u16,
    /// Rows of the rectangle.
    pub h: u16,
    /// Whether the chart is turned: its two local coordinates are swapped before scale and offset are applied.
    pub swap: bool,
    /// Texels per unit of local coordinates: texel coordinate = `offset` + `scale` · local.
    pub scale: [f32; 2],
    /// Texel coordinate of the local origin.
    pub offset: [f32; 2],
}

impl Placement {
    /// Returns the texel coordinate of a point of the chart.
    #[inline]
    pub fn texel_coord(&self, local: [f32; 2]) -> [f32; 2] {
        let [s, t] = if self.swap { [local[1], local[0]] } else { local };
        [self.offset[0] + self.scale[0] * s, self.offset[1] + self.scale[1] * t]
    }

    /// Returns the point of the chart's plane at a texel coordinate.
    #[inline]
    pub fn local(&self, coord: [f32; 2]) -> [f32; 2] {
        let [s, t] = [0, 1].map(|i| (coord[i] - self.offset[i]) / self.scale[i]);
        if self.swap { [t, s] } else { [s, t] }
    }
}

/// Placements of all charts in the square pages of a map; indexed by [`PlacementId`].
#[derive(Debug, PartialEq)]
pub struct Layout {
    /// Width and height of a page in texels.
    pub page_size: u32,
    /// Number of pages.
    pub page_count: u32,
    /// Texels per scene unit, except for given and reduced charts.
    pub density: f32,
    /// Placements: one per chart, by chart number, then one per back side.
    pub placements: Vec<Placement>,
    /// Charts of the back sides: placement `charts.len() + k` is the back of chart `back_of[k]`.
    pub back_of: Vec<ChartId>,
    /// Number of placements by the caller, which come first, ordered by page.
    pub given: u32,
    /// Charts reduced in density because they would not fit a page.
    pub reduced: u32,
    /// Texels that unseen charts would have had, but for the one that they have, padding not counted.
    pub spared: u64,
    /// Placement of each chart's back, [`PlacementId::NONE`] if it has none. Empty without back sides.
    backs: Vec<PlacementId>,
}

impl Index<PlacementId> for Layout {
    type Output = Placement;

    #[inline]
    fn index(&self, placement: PlacementId) -> &Placement {
        &self.placements[placement.index()]
    }
}

impl Layout {
    /// Copies the layout.
    pub(crate) fn try_clone(&self) -> Result<Layout> {
        Ok(Layout {
            placements: try_to_vec(&self.placements, LAYOUT)?,
            back_of: try_to_vec(&self.back_of, LAYOUT)?,
            backs: try_to_vec(&self.backs, LAYOUT)?,
            ..*self
        })
    }

    /// Packs `charts` at `density` texels per scene unit (finite, > 0) in as many pages of `page_size` (1 to
    /// [`MAX_PAGE_SIZE`](super::charts::MAX_PAGE_SIZE)) as they need, with `padding` texels around each.
    ///
    /// If `honour_given`, the charts that the caller placed stay where they are, and the others go to further pages.
    /// The charts of `with_backs`, ascending, get a second placement for their backs. A chart too long for a page is
    /// shown at a lower density along that axis, and one that is `unseen` (empty: none is) in a single texel. `OutOfMemory` if the pages would hold more than [`MAX_TEXELS`].
    pub fn pack(
        charts: &Charts,
        density: f32,
        page_size: u32,
        padding: u32,
        honour_given: bool,
        with_backs: &[ChartId],
        unseen: &[bool],
        progress: &Progress,
    ) -> Result<Layout> {
        let max_extent = padded_extent(page_size, padding)?;
        if !(density > 0.0 && density.is_finite()) {
            return invalid_argument!("the density is {density} texels per unit, not a finite number above 0");
        }
        let charts = &charts.charts[..];
        let given = if honour_given { charts.iter().take_while(|c| c.given.is_some()).count() } else { 0 };
        let mut layout = Layout {
            page_size,
            page_count: 0,
            density,
            placements: try_with_capacity(charts.len() + with_backs.len(), LAYOUT)?,
            back_of: Vec::new(),
            given: given as u32,
            reduced: 0,
            spared: 0,
            backs: Vec::new(),
        };
        layout.placements.extend(charts[..given].iter().filter_map(|c| Some(given_placement(c, &c.given?, page_size))));
        let first_page = layout.placements.iter().map(|p| p.page + 1).max().unwrap_or(0);
        for (c, chart) in charts.iter().enumerate().skip(given) {
            layout.push(chart, max_extent, padding, unseen.get(c).is_some_and(|&unseen| unseen));
        }
        if !with_backs.is_empty() {
            layout.backs = try_filled(charts.len(), PlacementId::NONE, LAYOUT)?;
            layout.back_of = try_with_capacity(with_backs.len(), LAYOUT)?;
            for &c in with_backs {
                layout.backs[c.index()] = PlacementId::new(layout.placements.len());
                layout.back_of.push(c);
                layout.push(&charts[c.index()], max_extent, padding, false);
            }
        }
        layout.check_size(first_page)?;
        layout.page_count = first_page;
        layout.place(progress)?;
        layout.check_pages()?;
        Ok(layout)
    }

    /// Returns the chart that a placement shows.
    #[inline]
    pub fn chart_of(&self, placement: PlacementId) -> ChartId {
        let charts = self.placements.len() - self.back_of.len();
        let place = placement.index();
        if place < charts { ChartId::new(place) } else { self.back_of[place - charts] }
    }

    /// Whether a placement shows the back of its chart.
    #[inline]
    pub fn is_back(&self, placement: PlacementId) -> bool {
        placement.index() >= self.placements.len() - self.back_of.len()
    }

    /// Returns the placement of a chart's back side, if the layout has one.
    #[inline]
    pub fn back(&self, chart: ChartId) -> Option<PlacementId> {
        self.backs.get(chart.index()).copied().filter(|&p| p != PlacementId::NONE)
    }

    /// Returns the placement for exactly this side of a chart, if the layout has one.
    #[inline]
    pub fn side(&self, chart: ChartId, front: bool) -> Option<PlacementId> {
        if front { Some(PlacementId::front_of(chart)) } else { self.back(chart) }
    }

    /// Returns the placement that shows a side of a chart: a back without a separate placement shares the front's.
    #[inline]
    pub fn place_of(&self, chart: ChartId, front: bool) -> PlacementId {
        self.side(chart, front).unwrap_or(PlacementId::front_of(chart))
    }

    /// Returns the texel coordinate of a point of a placed chart.
    #[inline]
    pub fn texel_coord(&self, placement: PlacementId, local: [f32; 2]) -> [f32; 2] {
        self[placement].texel_coord(local)
    }

    /// Returns the number of texels in all pages.
    pub fn texels(&self) -> u64 {
        self.page_count as u64 * (self.page_size as u64).pow(2)
    }

    /// Returns the fraction of the packed pages that rectangles of charts, padding included, take.
    pub fn utilisation(&self) -> f64 {
        let given = &self.placements[..self.given as usize];
        let pages = self.page_count - given.last().map_or(0, |p| p.page + 1);
        let texels: u64 = self.placements[given.len()..].iter().map(|p| p.w as u64 * p.h as u64).sum();
        texels as f64 / (pages as f64 * (self.page_size as f64).powi(2)).max(1.0)
    }

    /// Adds a chart, long side along x, whose position is found later.
    fn push(&mut self, chart: &Chart, max_extent: u32, padding: u32, unseen: bool) {
        let swap = chart.size[1] > chart.size[0];
        let size = if swap { [chart.size[1], chart.size[0]] } else { chart.size };
        // Margin for rounding: coordinates in the page are exact to an ulp of the page's size, and a chart must not
        // touch the next texel by that much.
        let slack = self.page_size as f64 / (1 << 20) as f64;
        let (mut reduced, mut spared) = (false, 1);
        let [(w, sx, ox), (h, sy, oy)] = size.map(|s| {
            let wanted = s as f64 * self.density as f64;
            let texels = (wanted - 4.0 * slack).ceil().clamp(1.0, max_extent as f64);
            spared *= texels as u64;
            let texels = if unseen { 1.0 } else { texels };
            let fitting = texels - 2.0 * slack;
            reduced |= !unseen && wanted > max_extent as f64 + 1.0;
            let scale = if wanted > fitting { fitting / s as f64 } else { self.density as f64 };
            // The chart is centred, so that the centres of border texels lie in it if possible.
            let margin = 0.5 * (texels - scale * s as f64);
            (texels as u16 + 2 * padding as u16, scale as f32, (margin + padding as f64) as f32)
        });
        self.reduced += reduced as u32;
        self.spared += if unseen { spared - 1 } else { 0 };
        self.placements.push(Placement { page: 0, x: 0, y: 0, w, h, swap, scale: [sx, sy], offset: [ox, oy] });
    }

    /// Refuses a layout that is too large, before it is packed.
    fn check_size(&self, given_pages: u32) -> Result<()> {
        let packed = &self.placements[self.given as usize..];
        let rects: u64 = packed.iter().map(|p| p.w as u64 * p.h as u64).sum();
        let texels = rects + given_pages as u64 * (self.page_size as u64).pow(2);
        if texels > MAX_TEXELS {
            return Err(Error::OutOfMemory(format!(
                "{} charts at {} texels per unit take {texels} texels, more than {MAX_TEXELS}",
                self.placements.len(),
                self.density
            )));
        }
        Ok(())
    }

    fn check_pages(&self) -> Result<()> {
        if self.texels() > MAX_TEXELS {
            return Err(Error::OutOfMemory(format!(
                "{} charts at {} texels per unit take {} pages of {2}×{2} texels, together more than {MAX_TEXELS}",
                self.placements.len(),
                self.density,
                self.page_size
            )));
        }
        Ok(())
    }

    /// Packs all but the given charts.
    fn place(&mut self, progress: &Progress) -> Result<()> {
        // The highest first, of these the widest.
        let key = |p: &Placement| u32::from(!p.h) << 16 | u32::from(!p.w);
        let charts = self.given..self.placements.len() as u32;
        let mut order = try_collect(charts.map(|p| (key(&self.placements[p as usize]), p)), LAYOUT)?;
        order.sort_unstable();
        let first_page = self.page_count;
        let mut pages: Vec<Skyline> = Vec::new();
        for (_, n) in order {
            progress.check()?;
            let p = &mut self.placements[n as usize];
            let (w, h) = (p.w as u32, p.h as u32);
            let found = pages.iter_mut().enumerate().find_map(|(i, page)| Some((i, page.insert(w, h)?)));
            let (page, [x, y]) = found.unwrap_or_else(|| {
                let mut page = Skyline::new(self.page_size);
                let place = page.insert(w, h).unwrap_or([0, 0]);
                pages.push(page);
                (pages.len() - 1, place)
            });
            p.page = first_page + page as u32;
            (p.x, p.y) = (x as u16, y as u16);
            p.offset = [p.offset[0] + x as f32, p.offset[1] + y as f32];
        }
        self.page_count = first_page + pages.len() as u32;
        Ok(())
    }
}

fn given_placement(chart: &Chart, given: &Given, page_size: u32) -> Placement {
    let size = page_size as f32;
    let scale = given.scale.map(|s| s * size);
    let offset = given.offset.map(|o| o * size);
    let [(x, w), (y, h)] = [0, 1].map(|axis| {
        let last = page_size as f32 - 1.0;
        let lower = offset[axis].floor().clamp(0.0, last);
        let upper = (offset[axis] + scale[axis] * chart.size[axis]).floor().clamp(lower, last);
        (lower as u16, (upper - lower) as u16 + 1)
    });
    Placement { page: given.page, x, y, w, h, swap: false, scale, offset }
}

/// The upper outline of the rectangles in a page: steps, each of one height, from left to right.
struct Skyline {
    size: u32,
    /// Left end and height of each step, which ends where the next begins.
    steps: Vec<[u32; 2]>,
    lowest: u32,
}

impl Skyline {
    fn new(size: u32) -> Self {
        Skyline { size, steps: vec![[0, 0]], lowest: 0 }
    }

    /// Places a rectangle as low as it goes, then as far left, and returns its corner.
    fn insert(&mut self, w: u32, h: u32) -> Option<[u32; 2]> {
        if self.lowest + h > self.size {
            return None;
        }
        let mut best = None;
        let mut limit = self.size - h + 1;
        for (i, &[x, _]) in self.steps.iter().enumerate() {
            if x + w > self.size {
                break;
            }
            if let Some(y) = self.rest(i, x + w, limit) {
                (best, limit) = (Some((i, [x, y])), y);
            }
        }
        let (i, corner) = best?;
        self.raise(i, corner[0] + w, corner[1] + h);
        Some(corner)
    }

    /// Returns the height on which a rectangle from step `i` to `right` rests, if below `limit`.
    fn rest(&self, i: usize, right: u32, limit: u32) -> Option<u32> {
        let mut y = 0;
        for &[x, top] in &self.steps[i..] {
            if x >= right {
                break;
            }
            y = y.max(top);
            if y >= limit {
                return None;
            }
        }
        Some(y)
    }

    /// Makes one step of height `top` from the left end of step `i` to `right`.
    fn raise(&mut self, i: usize, right: u32, top: u32) {
        let end = self.steps[i..].iter().position(|s| s[0] >= right).map_or(self.steps.len(), |n| i + n);
        let left = self.steps[i][0];
        let cut = self.steps[end - 1][1];
        let ends_at = self.steps.get(end).map_or(self.size, |s| s[0]);
        let rest = (ends_at > right).then_some([right, cut]);
        self.steps.splice(i..end, [[left, top]].into_iter().chain(rest));
        self.lowest = self.steps.iter().map(|s| s[1]).min().unwrap_or(0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn charts_of(sizes: &[[f32; 2]]) -> Charts {
        let chart = |&size: &[f32; 2]| Chart { triangles: 0..0, size, area: 0.0, two_sided: true, given: None };
        Charts { charts: sizes.iter().map(chart).collect(), ..Default::default() }
    }

    fn overlap(a: &Placement, b: &Placement) -> bool {
        a.page == b.page && a.x < b.x + b.w && b.x < a.x + a.w && a.y < b.y + b.h && b.y < a.y + a.h
    }

    /// In their page, apart from each other, each containing its chart and the padding around it.
    fn check(charts: &Charts, layout: &Layout, padding: u32) {
        let size = layout.page_size;
        for (id, p) in (0..).map(PlacementId::new).zip(&layout.placements) {
            assert!(p.page < layout.page_count && (p.x + p.w) as u32 <= size && (p.y + p.h) as u32 <= size);
            let chart = &charts[layout.chart_of(id)];
            let (lower, upper) = (p.texel_coord([0.0; 2]), p.texel_coord(chart.size));
            for (axis, first, count) in [(0, p.x, p.w), (1, p.y, p.h)] {
                assert!(lower[axis] >= first as f32 + padding as f32, "{p:?}");
                assert!(upper[axis] <= (first + count) as f32 - padding as f32, "{p:?} {:?}", chart.size);
            }
        }
        let mut order: Vec<&Placement> = layout.placements.iter().collect();
        order.sort_by_key(|p| (p.page, p.x));
        for (i, a) in order.iter().enumerate() {
            let near = order[i + 1..].iter().take_while(|b| b.page == a.page && b.x < a.x + a.w);
            near.for_each(|b| assert!(!overlap(a, b), "{a:?} and {b:?}"));
        }
    }

    proptest! {
        #[test]
        fn placements_are_apart_and_contain_their_charts(
            sizes in prop::collection::vec([0.0f32..60.0, 0.0f32..20.0], 0..60),
            density in 0.05f32..4.0, padding in 0u32..4, page in 5u32..8, back in any::<bool>(), all in any::<bool>(),
        ) {
            let charts = charts_of(&sizes);
            // All of them, or every third.
            let step = if all { 1 } else { 3 };
            let backs: Vec<ChartId> = charts.ids().step_by(step).filter(|_| back).collect();
            let layout = Layout::pack(&charts, density, 1 << page, padding, false, &backs, &[], &Progress::none()).unwrap();
            check(&charts, &layout, padding);
            prop_assert_eq!(&layout, &Layout::pack(&charts, density, 1 << page, padding, false, &backs, &[], &Progress::none()).unwrap());
            prop_assert_eq!(layout.placements.len(), sizes.len() + backs.len());
            for c in charts.ids() {
                let back = backs.contains(&c).then_some((c, true));
                prop_assert_eq!(layout.back(c).map(|p| (layout.chart_of(p), layout.is_back(p))), back);
            }
        }
    }

    #[test]
    fn many_charts_fill_their_pages() {
        // As of a real scene: most charts are small, few are large.
        let size = |i: u32, k: u32| {
            let bits = (i * 2 + k).wrapping_mul(2_654_435_761) >> 8;
            0.05 / (0.002 + bits as f32 / (1u32 << 24) as f32)
        };
        let charts = charts_of(&(0..20_000).map(|i| [size(i, 0), size(i, 1)]).collect::<Vec<_>>());
        let layout = Layout::pack(&charts, 60.0, 1024, 2, false, &[], &[], &Progress::none()).unwrap();
        check(&charts, &layout, 2);
        assert!(layout.page_count >= 8, "{} pages are too few to say", layout.page_count);
        assert!(layout.utilisation() > 0.85, "{}", layout.utilisation());
    }

    #[test]
    fn a_chart_longer_than_a_page_is_reduced_along_that_axis_alone() {
        let charts = charts_of(&[[1000.0, 3.0], [2.0, 2.0]]);
        let layout = Layout::pack(&charts, 1.0, 64, 2, false, &[], &[], &Progress::none()).unwrap();
        check(&charts, &layout, 2);
        assert_eq!(layout.reduced, 1);
        let p = &layout.placements[0];
        assert!(p.scale[0] < 0.061 && p.scale[1] > 0.999 && p.w == 64 && p.h == 7, "{p:?}");
    }

    #[test]
    fn gigantic_requests_are_refused_before_they_are_packed() {
        let charts = charts_of(&vec![[1.0, 1.0]; 10_000]);
        let e = Layout::pack(&charts, 1e4, 16384, 2, false, &[], &[], &Progress::none()).err().unwrap();
        assert!(matches!(&e, Error::OutOfMemory(s) if s.contains("10000 charts at 10000 texels per unit")), "{e}");
        let given = Given { page: 5000, offset: [0.0; 2], scale: [1.0; 2] };
        let mut far = charts_of(&[[1.0, 1.0]]);
        far.charts[0].given = Some(given);
        let e = Layout::pack(&far, 1.0, 1024, 2, true, &[], &[], &Progress::none()).err().unwrap();
        assert!(matches!(e, Error::OutOfMemory(_)), "{e}");
    }

    #[test]
    fn impossible_arguments_are_refused_by_name() {
        let charts = charts_of(&[[1.0, 1.0]]);
        let error = |density, page_size, padding| {
            Layout::pack(&charts, density, page_size, padding, false, &[], &[], &Progress::none())
                .err()
                .unwrap()
                .to_string()
        };
        assert!(error(0.0, 64, 2).contains("density is 0"));
        assert!(error(f32::INFINITY, 64, 2).contains("density is inf"));
        assert!(error(1.0, 0, 0).contains("page_size is 0"));
        assert!(error(1.0, 20000, 0).contains("page_size is 20000"));
        assert!(error(1.0, 64, 32).contains("padding 32"));
        assert!(error(1.0, 64, u32::MAX).contains("padding 4294967295"));
    }

    #[test]
    fn given_charts_stay_and_others_go_to_further_pages() {
        let mut charts = charts_of(&[[4.0, 2.0], [1.0, 1.0]]);
        charts.charts[0].given = Some(Given { page: 2, offset: [0.25, 0.5], scale: [0.125, 0.125] });
        let layout = Layout::pack(&charts, 1.0, 64, 2, true, &[], &[], &Progress::none()).unwrap();
        assert_eq!((layout.given, layout.page_count), (1, 4));
        let p = layout.placements[0];
        assert_eq!((p.page, p.x, p.y, p.w, p.h), (2, 16, 32, 33, 17));
        assert_eq!(layout.placements[0].texel_coord([4.0, 2.0]), [48.0, 48.0]);
        assert_eq!(layout.placements[1].page, 3);
        let repacked = Layout::pack(&charts, 1.0, 64, 0, false, &[], &[], &Progress::none()).unwrap();
        assert_eq!((repacked.given, repacked.page_count), (0, 1));
    }
}
