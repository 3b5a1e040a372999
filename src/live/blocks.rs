//! Blocks: tiles of 8 × 8 gather texels of one placement of a chart, the unit in which live light is computed,
//! shown and uploaded, and the order of their texels by level of detail (LOD).
//!
//! LOD l computes every 2^(top − l)-th texel along each axis (thesis 3.3.2: each LOD doubles the
//! resolution); the texels of a lower LOD are among those of the next, so that no ray is lost when
//! the detail grows, and what two LODs share at the border of two blocks has one value.

use crate::base::directional::Directional;
use crate::base::error::Result;
use crate::base::memory::{try_collect, try_to_vec, try_vec, try_with_capacity};
use crate::base::progress::Progress;
use crate::lightmap::atlas::Atlas;
use crate::lightmap::atlas::ids::{GatherTexel, LightTexel, PlacementId};
use crate::lightmap::atlas::layout::Placement;
use crate::lightmap::indirect::gather::Gathered;
use glam::Vec3;
use rayon::prelude::*;
use std::sync::Arc;

/// Gather texels along a side of a block.
pub(super) const TILE: i32 = 8;

/// Gather texels of a block, at most.
pub(super) const BLOCK_TEXELS: usize = (TILE * TILE) as usize;

/// The most LODs: the lowest then computes one texel of a block.
pub const MAX_LODS: usize = 4;

/// A rectangle of texels, from (x0, y0) up to, without, (x1, y1).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Rect {
    pub x0: i32,
    pub y0: i32,
    pub x1: i32,
    pub y1: i32,
}

impl Rect {
    pub fn of(p: &Placement) -> Rect {
        let (x0, y0) = (p.x as i32, p.y as i32);
        Rect { x0, y0, x1: x0 + p.w as i32, y1: y0 + p.h as i32 }
    }

    pub fn width(&self) -> usize {
        self.x1.saturating_sub(self.x0).max(0) as usize
    }

    pub fn height(&self) -> usize {
        self.y1.saturating_sub(self.y0).max(0) as usize
    }

    pub fn area(&self) -> usize {
        self.width() * self.height()
    }

    pub fn grown(&self, by: i32) -> Rect {
        Rect { x0: self.x0 - by, y0: self.y0 - by, x1: self.x1 + by, y1: self.y1 + by }
    }

    pub fn times(&self, factor: i32) -> Rect {
        Rect { x0: self.x0 * factor, y0: self.y0 * factor, x1: self.x1 * factor, y1: self.y1 * factor }
    }

    pub fn clipped(&self, to: &Rect) -> Rect {
        Rect { x0: self.x0.max(to.x0), y0: self.y0.max(to.y0), x1: self.x1.min(to.x1), y1: self.y1.min(to.y1) }
    }

    pub fn union(&self, other: &Rect) -> Rect {
        Rect {
            x0: self.x0.min(other.x0),
            y0: self.y0.min(other.y0),
            x1: self.x1.max(other.x1),
            y1: self.y1.max(other.y1),
        }
    }

    /// All texels, row by row.
    pub fn texels(self) -> impl Iterator<Item = (i32, i32)> {
        (self.y0..self.y1).flat_map(move |y| (self.x0..self.x1).map(move |x| (x, y)))
    }
}

/// Direct light of the light map texels around a block, at full resolution.
#[derive(Clone, Debug)]
pub(super) struct DirectTile {
    pub rect: Rect,
    /// Light row by row; only the values of the block's own texels are meaningful.
    pub values: Box<[Vec3]>,
    /// The same by direction; empty if nobody asks for it.
    pub directional: Box<[Directional]>,
}

/// The constant part of a block.
#[derive(Debug)]
pub(super) struct Tile {
    pub placement: PlacementId,
    /// The block's rectangle in the gather map.
    pub rect: Rect,
    /// Gather texels of the block, by LOD.
    pub texels: Box<[GatherTexel]>,
    /// The texels of LOD l are the first `lod_end[l]`.
    pub lod_end: [u16; MAX_LODS],
    pub centre: Vec3,
    /// Approximate number of light map texels around the block.
    pub map_texels: u32,
    /// Cell of the light map grid.
    pub cell: u32,
}

/// Progress of a block. It may be read at any time, also while a thread works on the block: it then has the values from
/// when the work began.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct BlockStatus {
    /// The highest LOD whose texels have all been gathered, under whatever light.
    pub lod: u8,
    /// The LOD whose texels have all been gathered under the current light, at most `lod`, and how many rounds they
    /// have; 0 rounds: no step has been completed under that light.
    pub fresh_lod: u8,
    pub rounds: u16,
    /// Epoch of the radiance map that was gathered.
    pub indirect_epoch: u32,
    /// Epochs of the lights of the coarse direct light, and of the direct light at full resolution.
    pub coarse_epoch: u32,
    pub direct_epoch: u32,
    /// Estimated relative error of indirect light; the mean of that light, and of coarse direct light, by
    /// the sum of the channels.
    pub error: f32,
    pub mean: f32,
    pub direct_mean: f32,
}

/// Direct light at full resolution that is being computed.
#[derive(Debug)]
pub(super) struct DirectWork {
    pub tile: DirectTile,
    /// Light before the [blur](crate::lightmap::direct_blur), of the tile and the texels around it that the blur needs;
    /// `None` if it has no noise.
    pub before: Option<NoisyTile>,
    /// The next texel of the tile that is lit first, and the next of the block's own to be blurred.
    pub next: u32,
    pub next_blurred: u32,
    /// Epoch of the lights under which it is computed.
    pub epoch: u32,
    /// Light without penumbrae at the samples of the tile that is lit first and of one more row and column on each side;
    /// NaN where it has not been computed yet.
    pub sharp: Box<[Vec3]>,
    /// The same by direction; empty if nobody asks for it.
    pub sharp_directional: Box<[Directional]>,
}

/// Direct light before the blur, and its variance.
#[derive(Debug)]
pub(super) struct NoisyTile {
    pub tile: DirectTile,
    pub variances: Box<[f32]>,
}

impl DirectWork {
    /// The tile whose texels are lit first.
    pub fn lit(&mut self) -> &mut DirectTile {
        match &mut self.before {
            Some(before) => &mut before.tile,
            None => &mut self.tile,
        }
    }

    pub fn bytes(&self) -> usize {
        let before = self.before.as_ref().map_or(0, |b| b.tile.bytes() + size_of_val(&b.variances[..]));
        before + self.tile.bytes() + size_of_val(&self.sharp[..]) + size_of_val(&self.sharp_directional[..])
    }
}

/// Accumulated light of a block. It moves to the thread that works on the block; the shown light is kept by the
/// display.
#[derive(Debug, Default)]
pub(super) struct BlockWork {
    /// Sums gathered by the texels that have been worked on so far.
    pub gathered: Vec<Gathered>,
    /// Sums of their light by direction; empty if nobody asks for it.
    pub directional: Vec<Directional>,
    /// Light of an earlier epoch, by texel, that fades out while new rays come in; may be empty.
    pub prior: Box<[Vec3]>,
    pub prior_directional: Box<[Directional]>,
    /// The next texel of the step under way.
    pub cursor: u16,
    pub direct: Option<DirectWork>,
    /// Finished light on its way to the display: coarse direct light of the lowest LOD's texels, and
    /// direct light at full resolution.
    pub new_coarse: Box<[Vec3]>,
    pub new_coarse_directional: Box<[Directional]>,
    pub new_direct: Option<DirectTile>,
    /// Sum of squared deviations of the rounds from the mean so far, summed over the channels, and their number.
    pub deviations: f32,
    pub deviation_count: u32,
}

/// A block while one thread works on it.
#[derive(Debug, Default)]
pub(super) struct Block {
    pub status: BlockStatus,
    pub work: BlockWork,
}

/// All blocks. The work of some may be away, in a [`Batch`](super::batch::Batch); their status never is.
pub(super) struct Blocks {
    status: Vec<BlockStatus>,
    /// Work of each block; `None` while it is away.
    work: Vec<Option<BlockWork>>,
}

impl Blocks {
    /// Creates `count` idle blocks.
    pub fn new(count: usize) -> Result<Blocks> {
        let mut blocks = Blocks::away(&try_vec(count, STATE)?)?;
        blocks.work.fill_with(|| Some(BlockWork::default()));
        Ok(blocks)
    }

    /// Creates blocks whose work is all away.
    pub fn away(status: &[BlockStatus]) -> Result<Blocks> {
        let mut work = try_with_capacity(status.len(), STATE)?;
        work.resize_with(status.len(), || None);
        Ok(Blocks { status: try_to_vec(status, STATE)?, work })
    }

    /// Replaces those of these blocks that are not away.
    pub fn replace_by(&mut self, new: Blocks) {
        for (b, (status, work)) in (0..).zip(new.status.into_iter().zip(new.work)) {
            if let Some(work) = work {
                self.put(b, Block { status, work });
            }
        }
    }

    pub fn len(&self) -> usize {
        self.status.len()
    }

    /// Iterates over all blocks, so many at a time, for threads that work on them in place.
    pub fn par_chunks_mut(
        &mut self,
        size: usize,
    ) -> impl IndexedParallelIterator<Item = (&mut [BlockStatus], &mut [Option<BlockWork>])> {
        self.status.par_chunks_mut(size).zip(self.work.par_chunks_mut(size))
    }

    /// Progress of the blocks, by number.
    pub fn status(&self) -> &[BlockStatus] {
        &self.status
    }

    pub fn status_mut(&mut self) -> &mut [BlockStatus] {
        &mut self.status
    }

    /// Accumulated light of a block; `None` while it is away.
    pub fn work(&self, b: u32) -> Option<&BlockWork> {
        self.work[b as usize].as_ref()
    }

    pub fn work_mut(&mut self, b: u32) -> Option<&mut BlockWork> {
        self.work[b as usize].as_mut()
    }

    /// Takes a block out to be worked on; `None` if it is away already.
    pub fn take(&mut self, b: u32) -> Option<Block> {
        let work = self.work[b as usize].take()?;
        Some(Block { status: self.status[b as usize], work })
    }

    /// Puts a block back.
    pub fn put(&mut self, b: u32, block: Block) {
        self.status[b as usize] = block.status;
        self.work[b as usize] = Some(block.work);
    }

    /// Bytes held by blocks that are not away, beside the structures themselves.
    pub fn bytes(&self) -> usize {
        self.work.iter().flatten().map(|w| w.bytes()).sum()
    }
}

impl DirectTile {
    pub fn bytes(&self) -> usize {
        size_of_val(&self.values[..]) + size_of_val(&self.directional[..])
    }
}

impl Tile {
    /// Bytes held, those of an idle block included.
    pub fn bytes(&self) -> usize {
        size_of::<Tile>() + size_of::<BlockStatus>() + size_of::<Option<BlockWork>>() + self.texels.len() * 4
    }
}

impl BlockWork {
    /// Bytes held, without the structure itself.
    pub fn bytes(&self) -> usize {
        self.gathered.capacity() * size_of::<Gathered>()
            + self.directional.capacity() * size_of::<Directional>()
            + size_of_val(&self.prior[..])
            + size_of_val(&self.prior_directional[..])
            + self.direct.as_ref().map_or(0, DirectWork::bytes)
    }
}

/// Name of these buffers in error messages.
const STATE: &str = "the state of blocks";

/// All blocks of an atlas, with their positions.
pub(super) struct BlockMap {
    pub atlas: Arc<Atlas>,
    pub tiles: Vec<Tile>,
    /// First block of each placement.
    first: Vec<u32>,
    /// Corner of each placement's grid of blocks, in texels of the gather map, and the number of its columns.
    origin: Vec<(i32, i32, i32)>,
    /// Lowest LOD that each gather texel belongs to.
    pub lod_of: Vec<u8>,
    /// By block, the rectangle of light map texels elsewhere that show its light: buried ones, which are filled from
    /// the nearest texel that can be seen. Empty if there are none.
    shown_elsewhere: Vec<Option<Rect>>,
    top: u8,
}

impl BlockMap {
    /// Cuts the charts of an atlas into blocks. `lods`: 1 to [`MAX_LODS`]; `end`: the progress when it is done.
    pub fn new(atlas: &Arc<Atlas>, lods: u32, end: f32, progress: &Progress) -> Result<BlockMap> {
        let top = (lods - 1) as u8;
        // The light map has as many placements, of the same sides of the same charts.
        let placements = &atlas.gather.layout.placements;
        let mut map = BlockMap {
            atlas: atlas.clone(),
            tiles: Vec::new(),
            first: try_with_capacity(placements.len() + 1, STATE)?,
            origin: try_with_capacity(placements.len(), STATE)?,
            lod_of: try_vec(atlas.gather.len(), "the LODs of the gather map")?,
            shown_elsewhere: Vec::new(),
            top,
        };
        map.lod_of.fill(top);
        let tiles = |p: &Placement| p.w.div_ceil(TILE as u16) as usize * p.h.div_ceil(TILE as u16) as usize;
        let count = placements.iter().map(tiles).sum();
        map.tiles = try_with_capacity(count, STATE)?;
        let mut texels = Vec::with_capacity(BLOCK_TEXELS);
        let stage = progress.stage("blocks", 0.0, end, count as u64);
        for (number, p) in placements.iter().enumerate() {
            map.first.push(map.tiles.len() as u32);
            let (x, y, w, h) = (p.x as i32, p.y as i32, p.w as i32, p.h as i32);
            let (columns, rows) = ((w + TILE - 1) / TILE, (h + TILE - 1) / TILE);
            map.origin.push((x, y, columns));
            for (i, j) in (0..rows).flat_map(|j| (0..columns).map(move |i| (i, j))) {
                let (x0, y0) = (x + i * TILE, y + j * TILE);
                let rect = Rect { x0, y0, x1: (x0 + TILE).min(x + w), y1: (y0 + TILE).min(y + h) };
                let tile = map.tile(atlas, PlacementId::new(number), rect, &mut texels)?;
                map.tiles.push(tile);
                stage.advance(1)?;
            }
        }
        map.first.push(map.tiles.len() as u32);
        map.shown_elsewhere = map.find_shown_elsewhere()?;
        Ok(map)
    }

    fn find_shown_elsewhere(&self) -> Result<Vec<Option<Rect>>> {
        let atlas = &self.atlas;
        if !atlas.buried.contains(&true) {
            return Ok(Vec::new());
        }
        let mut shown: Vec<Option<Rect>> = try_vec(self.tiles.len(), "where buried texels get their light")?;
        for buried in atlas.map.all().filter(|s| atlas.buried[s.index()]) {
            let (x, y) = atlas.map.position(buried);
            let texel = Rect { x0: x, y0: y, x1: x + 1, y1: y + 1 };
            let placement = atlas.map.placement_of(&atlas.charts, buried);
            atlas.gather_around(buried, |s, _| {
                let (gx, gy) = atlas.gather.position(s);
                let of_block = &mut shown[self.block_at(placement, gx, gy) as usize];
                *of_block = Some(of_block.map_or(texel, |r| r.union(&texel)));
            });
        }
        Ok(shown)
    }

    /// Makes the block of a rectangle. `texels` is scratch space.
    fn tile(
        &mut self,
        atlas: &Atlas,
        placement: PlacementId,
        rect: Rect,
        texels: &mut Vec<(u8, GatherTexel)>,
    ) -> Result<Tile> {
        texels.clear();
        texels.extend(
            rect.texels().filter_map(|(x, y)| Some((self.lod_at(placement, x, y), atlas.gather.at(placement, x, y)?))),
        );
        texels.sort_by_key(|t| t.0);
        // Every block must have light: its first texel is on the lowest LOD if no other texel falls on that grid.
        if let Some(t) = texels.first_mut() {
            t.0 = 0;
        }
        let lod_end = std::array::from_fn(|l| texels.iter().filter(|t| t.0 as usize <= l).count() as u16);
        let mut centre = glam::DVec3::ZERO;
        for &(lod, texel) in &*texels {
            self.lod_of[texel.index()] = lod;
            centre += atlas.gather[texel].position(&atlas.scene).as_dvec3();
        }
        let centre = (centre / texels.len().max(1) as f64).as_vec3();
        let map_texels = rect_in_light_map(atlas, placement, &rect).area() as u32;
        let texels = try_collect(texels.iter().map(|t| t.1), STATE)?.into_boxed_slice();
        Ok(Tile { placement, rect, texels, lod_end, centre, map_texels, cell: 0 })
    }

    /// The LOD on whose grid a texel of the gather map lies.
    fn lod_at(&self, placement: PlacementId, x: i32, y: i32) -> u8 {
        let (ox, oy, _) = self.origin[placement.index()];
        let zeros = ((x - ox) | (y - oy)).trailing_zeros();
        self.top - zeros.min(self.top as u32) as u8
    }

    /// The highest LOD.
    pub fn top(&self) -> u8 {
        self.top
    }

    /// Corner of a placement's grid of texels.
    pub fn origin(&self, placement: PlacementId) -> (i32, i32) {
        let (x, y, _) = self.origin[placement.index()];
        (x, y)
    }

    /// The block of a texel of the gather map, which must be one of the placement's rectangle; others
    /// are clamped to it.
    pub fn block_at(&self, placement: PlacementId, x: i32, y: i32) -> u32 {
        let (ox, oy, columns) = self.origin[placement.index()];
        let (first, end) = (self.first[placement.index()], self.first[placement.index() + 1]);
        let rows = (end - first) as i32 / columns.max(1);
        let (i, j) = (((x - ox) / TILE).clamp(0, columns - 1), ((y - oy) / TILE).clamp(0, rows - 1));
        first + (j * columns + i) as u32
    }

    /// The block that a texel of the light map lies in.
    pub fn block_of(&self, texel: LightTexel) -> u32 {
        let atlas = &self.atlas;
        let placement = atlas.map.placement_of(&atlas.charts, texel);
        // Coordinates are not negative, so truncation rounds down.
        let at = atlas.gather.layout.texel_coord(placement, atlas.texel_local(placement, texel));
        self.block_at(placement, at[0] as i32, at[1] as i32)
    }

    /// The rectangle of a placement in the gather map.
    pub fn own_rect(&self, placement: PlacementId) -> Rect {
        Rect::of(&self.atlas.gather.layout[placement])
    }

    /// The blocks of a placement.
    pub fn of_placement(&self, placement: PlacementId) -> std::ops::Range<u32> {
        self.first[placement.index()]..self.first[placement.index() + 1]
    }

    /// The up to eight blocks around a block in its placement.
    pub fn neighbours(&self, b: u32) -> impl Iterator<Item = u32> + '_ {
        let tile = &self.tiles[b as usize];
        let (_, _, columns) = self.origin[tile.placement.index()];
        let range = self.of_placement(tile.placement);
        let rows = (range.end - range.start) as i32 / columns.max(1);
        let at = (b - range.start) as i32;
        let (i, j) = (at % columns, at / columns);
        let around = (-1..=1).flat_map(|dj| (-1..=1).map(move |di| (di, dj))).filter(|&d| d != (0, 0));
        around
            .map(move |(di, dj)| (i + di, j + dj))
            .filter(move |&(i, j)| i >= 0 && i < columns && j >= 0 && j < rows)
            .map(move |(i, j)| range.start + (j * columns + i) as u32)
    }

    /// The rectangle of the light map that shows a rectangle of a placement's gather texels, buried texels included.
    pub fn shown_in_light_map(&self, placement: PlacementId, rect: &Rect) -> Rect {
        let mut shown = self.rect_in_light_map(placement, rect);
        if !self.shown_elsewhere.is_empty() {
            let (_, _, columns) = self.origin[placement.index()];
            let first = self.first[placement.index()] as i32;
            let [low, high] = [(rect.x0, rect.y0), (rect.x1 - 1, rect.y1 - 1)]
                .map(|(x, y)| self.block_at(placement, x, y) as i32 - first);
            for j in low / columns..=high / columns {
                for i in low % columns..=high % columns {
                    if let Some(elsewhere) = self.shown_elsewhere[(first + j * columns + i) as usize] {
                        shown = shown.union(&elsewhere);
                    }
                }
            }
        }
        shown
    }

    /// The rectangle of the light map in which a rectangle of a placement's gather texels lies: the smallest that
    /// contains them all, within the placement's own rectangle.
    pub fn rect_in_light_map(&self, placement: PlacementId, rect: &Rect) -> Rect {
        rect_in_light_map(&self.atlas, placement, rect)
    }

    /// Bytes held, those of idle blocks included.
    pub fn bytes(&self) -> usize {
        let tiles: usize = self.tiles.iter().map(Tile::bytes).sum();
        let elsewhere = size_of_val(&self.shown_elsewhere[..]);
        self.first.len() * 4 + self.origin.len() * 12 + self.lod_of.len() + elsewhere + tiles
    }
}

fn rect_in_light_map(atlas: &Atlas, placement: PlacementId, rect: &Rect) -> Rect {
    let gather = &atlas.gather.layout[placement];
    let map = &atlas.map.layout[placement];
    let corner = |x: i32, y: i32| {
        let at = [x as f32, y as f32];
        let mut local: [f32; 2] = std::array::from_fn(|k| (at[k] - gather.offset[k]) / gather.scale[k]);
        if gather.swap {
            local.swap(0, 1);
        }
        map.texel_coord(local)
    };
    let corners =
        [corner(rect.x0, rect.y0), corner(rect.x1, rect.y0), corner(rect.x0, rect.y1), corner(rect.x1, rect.y1)];
    // Vertices may be as far away as floats go: coordinates are clipped while they are floats, so that no integer
    // overflows.
    let whole = Rect::of(map);
    let ends = [(whole.x0, whole.x1), (whole.y0, whole.y1)];
    let [(x0, x1), (y0, y1)] = std::array::from_fn(|k| {
        let (first, end) = ends[k];
        let bound = |f: fn(f32, f32) -> f32| corners[1..].iter().fold(corners[0][k], |b, c| f(b, c[k]));
        let inside = |v: f32| v.clamp(first as f32, end as f32) as i32;
        let (low, high) = (inside(bound(f32::min).floor() - 1.0), inside(bound(f32::max).ceil() + 1.0));
        // If coordinates have lost all precision, the position can be anywhere in the placement.
        let is_known = corners.iter().all(|c| c[k].is_finite()) && low < high;
        if is_known { (low, high) } else { (first, end) }
    });
    Rect { x0, y0, x1, y1 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lightmap::{Lightmap, LightmapDesc};
    use crate::scene::{Material, Mesh, MeshMaterials, SceneData};

    /// A sheet with one vertex far away: its texels are so large that coordinates of neighbours round to one another.
    #[test]
    fn rectangles_of_blocks_lie_on_their_placement_however_far_a_vertex_is() {
        for far in [1.0, 1e6, 1e12, -1e12] {
            let mut data = SceneData::new();
            let material = data.add_material(Material { two_sided: true, ..Default::default() }).unwrap();
            let positions = vec![Vec3::ZERO, Vec3::new(far, 0.3, 0.0), Vec3::new(0.1, 1.0, 0.2), Vec3::ONE];
            let (indices, materials) = (vec![[0, 1, 2], [1, 3, 2]], MeshMaterials::One(material));
            data.add_mesh(Mesh {
                positions: positions.into(),
                indices: indices.into(),
                materials,
                ..Default::default()
            })
            .unwrap();
            let scene = data.committed();
            let desc = LightmapDesc { page_size: 64, ..Default::default() };
            let lightmap = Lightmap::create(&scene, &desc, &Progress::none()).unwrap();
            let map = BlockMap::new(lightmap.atlas(), 3, 1.0, &Progress::none()).unwrap();
            assert!(!map.tiles.is_empty());
            for tile in &map.tiles {
                let whole = Rect::of(&map.atlas.map.layout[tile.placement]);
                for grown in [0, 1, 20, 1 << 20] {
                    let r = map.rect_in_light_map(tile.placement, &tile.rect.grown(grown));
                    assert!(r.area() > 0 && r.clipped(&whole) == r, "{far}: {r:?} is not within {whole:?}");
                }
            }
        }
    }
}
