//! Layouts: where each chart lies in the pages of a map of a given resolution (thesis 3.2.3).
//!
//! The light map, the gather map and the radiance map show the same charts at different densities.
//! Each packs them anew, so that no texel of a coarse map is shared by two charts. Only the light
//! map keeps the caller's placement.
//!
//! Rectangles are packed along a skyline (bottom left), highest first, after Jylänki, *A Thousand
//! Ways to Pack the Bin* (2010).

use super::charts::{Chart, Charts, Given};
use crate::error::{Error, Result, invalid_argument};
use crate::scene::NONE;

/// The most texels in all pages of a map. Samples and indices of as many take 10 GB.
pub const MAX_TEXELS: u64 = 1 << 29;

/// The largest page, in texels along an axis: texels are addressed in 16 bits.
pub const MAX_PAGE_SIZE: u32 = 16384;

/// Where a chart lies. Texel coordinates of a page are continuous: texel i covers [i, i + 1].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Placement {
    pub page: u32,
    /// The rectangle of texels that the chart owns, padding included. (Given charts need not own
    /// theirs alone.)
    pub x: u16,
    pub y: u16,
    pub w: u16,
    pub h: u16,
    /// Whether the chart lies on its side: local coordinates change places before the rest.
    pub swap: bool,
    /// Texel coordinate = `offset` + `scale` · local.
    pub scale: [f32; 2],
    pub offset: [f32; 2],
}

impl Placement {
    /// The texel coordinate of a point of the chart.
    #[inline]
    pub fn texel_coord(&self, local: [f32; 2]) -> [f32; 2] {
        let [s, t] = if self.swap { [local[1], local[0]] } else { local };
        [self.offset[0] + self.scale[0] * s, self.offset[1] + self.scale[1] * t]
    }
}

/// Where all charts lie in the square pages of a map.
#[derive(Clone, Debug, PartialEq)]
pub struct Layout {
    /// Width and height of a page in texels.
    pub page_size: u32,
    pub page_count: u32,
    /// Texels per scene unit, except for given and reduced charts.
    pub density: f32,
    /// One per chart, by chart number, then one per back side.
    pub placements: Vec<Placement>,
    /// Charts of the back sides: placement `charts.len() + k` is the back of chart `back_of[k]`.
    pub back_of: Vec<u32>,
    /// The first so many placements are the caller's, ordered by page.
    pub given: u32,
    /// Charts reduced in density because they would not fit a page.
    pub reduced: u32,
    /// Placement of each chart's back, [`NONE`] if it has none. Empty without back sides.
    backs: Vec<u32>,
}

impl Layout {
    /// Places `charts` at `density` texels per scene unit (finite, > 0) in as many pages of
    /// `page_size` (1 to [`MAX_PAGE_SIZE`]) as they need, with `padding` texels around each.
    ///
    /// With `honour_given` the charts that the caller placed stay where they are, and the others
    /// go to further pages. With `back_sides` the charts of two-sided materials get a second place.
    /// A chart too long for a page is shown at a lower density along that axis. `OutOfMemory` if
    /// the pages would hold more than [`MAX_TEXELS`].
    pub fn pack(
        charts: &Charts,
        density: f32,
        page_size: u32,
        padding: u32,
        honour_given: bool,
        back_sides: bool,
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
            placements: Vec::with_capacity(charts.len()),
            back_of: Vec::new(),
            given: given as u32,
            reduced: 0,
            backs: Vec::new(),
        };
        layout.placements.extend(charts[..given].iter().filter_map(|c| Some(given_placement(c, &c.given?, page_size))));
        let first_page = layout.placements.iter().map(|p| p.page + 1).max().unwrap_or(0);
        for chart in &charts[given..] {
            layout.push(chart, max_extent, padding);
        }
        if back_sides {
            layout.backs = vec![NONE; charts.len()];
            for (c, chart) in charts.iter().enumerate().filter(|(_, c)| c.two_sided) {
                layout.backs[c] = layout.placements.len() as u32;
                layout.back_of.push(c as u32);
                layout.push(chart, max_extent, padding);
            }
        }
        layout.check_size(first_page)?;
        layout.page_count = first_page;
        layout.place();
        layout.check_pages()?;
        Ok(layout)
    }

    /// The chart that a placement shows.
    #[inline]
    pub fn chart_of(&self, placement: u32) -> u32 {
        let charts = self.placements.len() - self.back_of.len();
        if (placement as usize) < charts { placement } else { self.back_of[placement as usize - charts] }
    }

    /// Whether a placement shows the back of its chart.
    #[inline]
    pub fn is_back(&self, placement: u32) -> bool {
        placement as usize >= self.placements.len() - self.back_of.len()
    }

    /// The placement of a chart's back side, if the layout has one.
    #[inline]
    pub fn back(&self, chart: u32) -> Option<u32> {
        self.backs.get(chart as usize).copied().filter(|&p| p != NONE)
    }

    /// The texel coordinate of a point of a placed chart.
    #[inline]
    pub fn texel_coord(&self, placement: u32, local: [f32; 2]) -> [f32; 2] {
        self.placements[placement as usize].texel_coord(local)
    }

    /// Texels in all pages.
    pub fn texels(&self) -> u64 {
        self.page_count as u64 * (self.page_size as u64).pow(2)
    }

    /// Share of the packed pages that rectangles of charts, padding included, take.
    pub fn utilisation(&self) -> f64 {
        let given = &self.placements[..self.given as usize];
        let pages = self.page_count - given.last().map_or(0, |p| p.page + 1);
        let texels: u64 = self.placements[given.len()..].iter().map(|p| p.w as u64 * p.h as u64).sum();
        texels as f64 / (pages as f64 * (self.page_size as f64).powi(2)).max(1.0)
    }

    /// Adds a chart whose place is yet to be found, long side along x.
    fn push(&mut self, chart: &Chart, max_extent: u32, padding: u32) {
        let swap = chart.size[1] > chart.size[0];
        let size = if swap { [chart.size[1], chart.size[0]] } else { chart.size };
        // Room for rounding: coordinates in the page are exact to an ulp of the page's size, and
        // a chart must not touch the next texel by as much.
        let slack = self.page_size as f64 / (1 << 20) as f64;
        let mut reduced = false;
        let [(w, sx, ox), (h, sy, oy)] = size.map(|s| {
            let wanted = s as f64 * self.density as f64;
            let texels = (wanted - 4.0 * slack).ceil().clamp(1.0, max_extent as f64);
            let fitting = texels - 2.0 * slack;
            reduced |= wanted > max_extent as f64 + 1.0;
            let scale = if wanted > fitting { fitting / s as f64 } else { self.density as f64 };
            // In the middle, so that the centres of border texels lie in the chart if they can.
            let margin = 0.5 * (texels - scale * s as f64);
            (texels as u16 + 2 * padding as u16, scale as f32, (margin + padding as f64) as f32)
        });
        self.reduced += reduced as u32;
        self.placements.push(Placement { page: 0, x: 0, y: 0, w, h, swap, scale: [sx, sy], offset: [ox, oy] });
    }

    /// Refuses what cannot be packed before it is tried.
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

    /// Finds a place for all but the given charts.
    fn place(&mut self) {
        let mut order: Vec<u32> = (self.given..self.placements.len() as u32).collect();
        let key = |p: &Placement| (std::cmp::Reverse(p.h), std::cmp::Reverse(p.w));
        order.sort_by_key(|&p| (key(&self.placements[p as usize]), p));
        let first_page = self.page_count;
        let mut pages: Vec<Skyline> = Vec::new();
        for n in order {
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
    }
}

/// Texels that a chart may take along an axis of a page; checks page size and padding.
pub(super) fn padded_extent(page_size: u32, padding: u32) -> Result<u32> {
    if !(1..=MAX_PAGE_SIZE).contains(&page_size) {
        return invalid_argument!("page_size is {page_size}, outside 1 to {MAX_PAGE_SIZE}");
    }
    match page_size.checked_sub(padding.saturating_mul(2)) {
        Some(extent) if extent > 0 => Ok(extent),
        _ => invalid_argument!("padding {padding} on both sides leaves nothing of page_size {page_size}"),
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

/// The upper outline of what a page holds: steps of equal height from left to right.
struct Skyline {
    size: u32,
    /// Left end and height of each step; it ends where the next begins.
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

    /// The height on which a rectangle from step `i` to `right` rests, if below `limit`.
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
