//! What is shown: indirect light of every gather texel, from its own rays or interpolated from those
//! of a lower LOD, filled where it cannot be seen, blurred; and its composition with direct light
//! when a page is read. The sums of the texels are left alone.

use super::blocks::{Block, BlockIndex, Rect, TILE};
use crate::device::Device;
use crate::lightmap::Atlas;
use crate::lightmap::blur::Window;
use crate::memory::try_vec;
use crate::scene::NONE;
use glam::Vec3;
use rayon::prelude::*;
use std::collections::{BTreeMap, HashMap};

/// Rings of unseen texels that are filled around those that are seen.
const MAX_FILL_ROUNDS: usize = 64;

/// Per gather texel.
pub(super) struct Display {
    /// Indirect irradiance, not blurred.
    plain: Vec<Vec3>,
    /// What is shown of it.
    shown: Vec<Vec3>,
    /// Direct irradiance of the lowest LOD, interpolated: shown until a block has more.
    pub coarse_direct: Vec<Vec3>,
    normals: Vec<Vec3>,
    /// Whether a texel can be seen, as far as is known.
    visible: Vec<bool>,
    /// Texels that cannot, by chart.
    unseen: HashMap<u32, Vec<u32>>,
    blur: i32,
}

/// Where changes of the shown light lie in the light map: a rectangle of a page.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Changed {
    pub page: u32,
    pub rect: Rect,
}

impl Display {
    pub fn new(atlas: &Atlas, blur: u32) -> crate::Result<Display> {
        let n = atlas.gather.len();
        let mut normals = try_vec(n, "the gather map's normals")?;
        atlas.scene.device().install(|| {
            normals.par_iter_mut().enumerate().for_each(|(i, normal): (usize, &mut Vec3)| {
                *normal = atlas.receiver(&atlas.gather, &[], i).normal;
            });
        });
        let mut visible = try_vec(n, "the gather map's validity")?;
        visible.fill(true);
        Ok(Display {
            plain: try_vec(n, "live indirect light")?,
            shown: try_vec(n, "shown indirect light")?,
            coarse_direct: try_vec(n, "live direct light")?,
            normals,
            visible,
            unseen: HashMap::new(),
            blur: blur as i32,
        })
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        self.plain.len() * (4 * size_of::<Vec3>() + 1)
    }

    /// Shows what `changed` blocks know now; returns where that changes the light map.
    pub fn refresh(
        &mut self,
        device: &Device,
        atlas: &Atlas,
        index: &BlockIndex,
        blocks: &[Block],
        changed: &[u32],
    ) -> Vec<Changed> {
        let top = index.top();
        // Neighbours that interpolate do so between texels of these blocks too.
        let mut all: Vec<u32> = changed.to_vec();
        for &b in changed {
            all.extend(index.neighbours(blocks, b).filter(|&n| blocks[n as usize].shown_lod < top));
        }
        all.sort_unstable();
        all.dedup();

        // What has rays of its own first: the others need it.
        let own: Vec<(u32, Option<Vec3>, bool)> = changed
            .iter()
            .flat_map(|&b| {
                let block = &blocks[b as usize];
                (0..block.lod_end[block.shown_lod as usize] as usize)
                    .map(|i| (block.texels[i], block.estimate(i), block.is_visible(i)))
            })
            .collect();
        for (sample, value, visible) in own {
            if let Some(value) = value {
                self.plain[sample as usize] = value;
            }
            self.note_visible(atlas, sample, visible);
        }
        let interpolate = |&b: &u32| -> Vec<(u32, Vec3)> {
            let block = &blocks[b as usize];
            let known =
                |s: u32, x, y| index.lod_of[s as usize] <= blocks[index.block_at(block.chart, x, y) as usize].shown_lod;
            let lod = block.shown_lod;
            let value = |s: u32| self.interpolate(atlas, index, block, lod, s, &self.plain, known);
            block.texels[block.lod_end[lod as usize] as usize..].iter().map(|&s| (s, value(s))).collect()
        };
        let interpolated: Vec<(u32, Vec3)> = device.install(|| all.par_iter().flat_map_iter(interpolate).collect());
        for (sample, value) in interpolated {
            self.plain[sample as usize] = value;
        }
        let mut charts: BTreeMap<u32, Vec<u32>> = BTreeMap::new();
        for &b in &all {
            charts.entry(blocks[b as usize].chart).or_default().push(b);
        }
        let mut touched = Vec::new();
        for (&chart, of_chart) in &charts {
            let filled = self.fill(atlas, chart);
            let own = self.own_rect(atlas, chart);
            for &b in of_chart {
                touched.push((chart, blocks[b as usize].rect.grown(self.blur).clipped(&own)));
            }
            touched.extend(filled.map(|rect| (chart, rect.clipped(&own))));
        }

        let shown: Vec<(u32, Vec3)> = device.install(|| {
            touched
                .par_iter()
                .flat_map_iter(|&(chart, rect)| {
                    let mut window = Window::new(self.blur);
                    rect.texels()
                        .filter_map(|(x, y)| {
                            let s = atlas.gather.at(chart, x, y);
                            (s != NONE).then(|| (s, self.blurred(atlas, &mut window, s as usize)))
                        })
                        .collect::<Vec<_>>()
                })
                .collect()
        });
        for (sample, value) in shown {
            self.shown[sample as usize] = value;
        }
        let changed = |&(chart, rect): &(u32, Rect)| {
            // A texel of the light map interpolates between four of the gather map.
            let rect = super::blocks::rect_in_light_map(atlas, chart, &rect.grown(1));
            Changed { page: atlas.map.layout.placements[chart as usize].page, rect }
        };
        touched.iter().map(changed).collect()
    }

    /// The rectangle of the light map that shows the direct light of a block.
    pub fn direct_rect(atlas: &Atlas, block: &Block) -> Changed {
        let rect = super::blocks::rect_in_light_map(atlas, block.chart, &block.rect.grown(1));
        Changed { page: atlas.map.layout.placements[block.chart as usize].page, rect }
    }

    fn own_rect(&self, atlas: &Atlas, chart: u32) -> Rect {
        let p = &atlas.gather.layout.placements[chart as usize];
        let (x0, y0) = (p.x as i32, p.y as i32);
        Rect { x0, y0, x1: x0 + p.w as i32, y1: y0 + p.h as i32 }
    }

    fn blurred(&self, atlas: &Atlas, window: &mut Window, sample: usize) -> Vec3 {
        if self.blur == 0 || !self.visible[sample] {
            return self.plain[sample];
        }
        window.blur(&atlas.charts, &atlas.gather, sample, &self.plain, &self.visible, &self.normals)
    }

    fn note_visible(&mut self, atlas: &Atlas, sample: u32, visible: bool) {
        if self.visible[sample as usize] == visible {
            return;
        }
        self.visible[sample as usize] = visible;
        let chart = atlas.charts.chart_of[atlas.gather.texels.samples[sample as usize].triangle as usize];
        let list = self.unseen.entry(chart).or_default();
        if visible {
            list.retain(|&s| s != sample);
        } else {
            list.push(sample);
            list.sort_unstable();
        }
    }

    /// The value of a texel that has none of its own at LOD `lod`: bilinear between the corners of that
    /// LOD's grid that are `known`; else the mean of the block's own by inverse square distance.
    fn interpolate(
        &self,
        atlas: &Atlas,
        index: &BlockIndex,
        block: &Block,
        lod: u8,
        sample: u32,
        values: &[Vec3],
        known: impl Fn(u32, i32, i32) -> bool,
    ) -> Vec3 {
        let (x, y) = atlas.gather.position(sample as usize);
        let (ox, oy) = index.origin(block.chart);
        let step = 1 << (index.top() - lod);
        let (x0, y0) = (x - (x - ox) % step, y - (y - oy) % step);
        let (fx, fy) = ((x - x0) as f32 / step as f32, (y - y0) as f32 / step as f32);
        let (mut sum, mut total) = (Vec3::ZERO, 0.0);
        for (cx, cy, w) in [
            (x0, y0, (1.0 - fx) * (1.0 - fy)),
            (x0 + step, y0, fx * (1.0 - fy)),
            (x0, y0 + step, (1.0 - fx) * fy),
            (x0 + step, y0 + step, fx * fy),
        ] {
            let s = atlas.gather.at(block.chart, cx, cy);
            if w > 0.0 && s != NONE && self.visible[s as usize] && known(s, cx, cy) {
                sum += w * values[s as usize];
                total += w;
            }
        }
        if total > 0.2 {
            return sum / total;
        }
        for &s in &block.texels[..block.lod_end[lod as usize] as usize] {
            let (sx, sy) = atlas.gather.position(s as usize);
            let weight = if self.visible[s as usize] { 1.0 } else { 1e-3 };
            let w = weight / ((sx - x).pow(2) + (sy - y).pow(2)).max(1) as f32;
            sum += w * values[s as usize];
            total += w;
        }
        if total > 0.0 { sum / total } else { Vec3::ZERO }
    }

    /// Takes over the direct light of the lowest LOD's texels, and interpolates it to all others.
    pub fn spread_direct(
        &mut self,
        device: &Device,
        atlas: &Atlas,
        index: &BlockIndex,
        blocks: &[Block],
        known: &[(u32, Vec3)],
    ) {
        for &(sample, value) in known {
            self.coarse_direct[sample as usize] = value;
        }
        let others = |block: &Block| -> Vec<(u32, Vec3)> {
            let lowest = |s: u32, _, _| index.lod_of[s as usize] == 0;
            let value = |s: u32| self.interpolate(atlas, index, block, 0, s, &self.coarse_direct, lowest);
            block.texels[block.lod_end[0] as usize..].iter().map(|&s| (s, value(s))).collect()
        };
        let others: Vec<(u32, Vec3)> = device.install(|| blocks.par_iter().flat_map_iter(others).collect());
        for (sample, value) in others {
            self.coarse_direct[sample as usize] = value;
        }
    }

    /// Gives the unseen texels of a chart the mean of their neighbours, ring by ring, as a bake does;
    /// returns the rectangle around them.
    fn fill(&mut self, atlas: &Atlas, chart: u32) -> Option<Rect> {
        let unseen = self.unseen.get(&chart).filter(|u| !u.is_empty())?;
        let mut missing = unseen.clone();
        let mut filled: HashMap<u32, Vec3> = HashMap::new();
        for _ in 0..MAX_FILL_ROUNDS {
            let ring: Vec<(u32, Vec3)> = missing
                .iter()
                .filter_map(|&s| {
                    let (x, y) = atlas.gather.position(s as usize);
                    let (mut sum, mut n) = (Vec3::ZERO, 0.0);
                    for (nx, ny) in (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (x + dx, y + dy))) {
                        let t = atlas.gather.at(chart, nx, ny);
                        if t == NONE {
                            continue;
                        }
                        let value = if self.visible[t as usize] {
                            Some(self.plain[t as usize])
                        } else {
                            filled.get(&t).copied()
                        };
                        if let Some(value) = value {
                            sum += value;
                            n += 1.0;
                        }
                    }
                    (n > 0.0).then(|| (s, sum / n))
                })
                .collect();
            if ring.is_empty() {
                break;
            }
            filled.extend(ring);
            missing.retain(|s| !filled.contains_key(s));
        }
        let mut around: Option<Rect> = None;
        for (s, value) in filled {
            self.plain[s as usize] = value;
            let (x, y) = atlas.gather.position(s as usize);
            let texel = Rect { x0: x, y0: y, x1: x + 1, y1: y + 1 };
            around = Some(around.map_or(texel, |r| r.union(&texel)));
        }
        around
    }

    /// Irradiance shown at a sample of the light map; `with_direct` false: indirect light alone.
    pub fn irradiance(
        &self,
        atlas: &Atlas,
        index: &BlockIndex,
        blocks: &[Block],
        sample: u32,
        with_direct: bool,
    ) -> Vec3 {
        let t = &atlas.map.texels.samples[sample as usize];
        let chart = atlas.charts.chart_of[t.triangle as usize];
        let local = atlas.charts.local(t.triangle, t.u, t.v);
        let (mut sum, mut coarse) = (Vec3::ZERO, Vec3::ZERO);
        atlas.gather.bilinear(chart, local, |s, w| {
            sum += w * self.shown[s];
            coarse += w * self.coarse_direct[s];
        });
        if !with_direct {
            return sum;
        }
        let at = atlas.gather.layout.texel_coord(chart, local);
        let block = &blocks[index.block_at(chart, at[0].floor() as i32, at[1].floor() as i32) as usize];
        let fine = block.direct.as_ref().and_then(|tile| {
            let (x, y) = atlas.map.position(sample as usize);
            let r = &tile.rect;
            let inside = x >= r.x0 && x < r.x1 && y >= r.y0 && y < r.y1;
            inside.then(|| tile.values[(y - r.y0) as usize * r.width() + (x - r.x0) as usize]).filter(|v| v.is_finite())
        });
        sum + fine.unwrap_or(coarse)
    }
}

impl BlockIndex {
    /// The up to eight blocks around a block in its chart.
    fn neighbours<'a>(&'a self, blocks: &'a [Block], b: u32) -> impl Iterator<Item = u32> + 'a {
        let block = &blocks[b as usize];
        let range = self.of_chart(block.chart);
        let offsets = (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (dx * TILE, dy * TILE)));
        let at = offsets.map(move |(dx, dy)| self.block_at(block.chart, block.rect.x0 + dx, block.rect.y0 + dy));
        at.filter(move |&n| n != b && range.contains(&n))
    }
}
