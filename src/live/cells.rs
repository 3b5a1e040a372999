//! The light map grid (thesis 3.3.2): a uniform grid over the scene. A block of texels belongs to one cell, with all
//! its LODs. A cell shows its next LOD when all its blocks have it.

use super::blocks::{BlockStatus, MAX_LODS, Tile};
use super::lists::Lists;
use crate::base::error::{Result, invalid_argument};
use crate::base::memory::{try_collect, try_vec};
use glam::{UVec3, Vec3};

/// Number of cells along the longest side unless the size is given.
const AUTOMATIC_CELLS: f32 = 16.0;

/// Maximum number of cells; more would make an unreasonably large 3D texture.
const MAX_CELLS: u64 = 1 << 24;

/// The LOD reported for cells without surfaces.
pub const NO_LOD: u8 = 255;

/// Geometry of the light map grid.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CellInfo {
    /// Lower corner of the first cell, in scene units.
    pub origin: Vec3,
    /// Edge of a cell in scene units.
    pub cell_size: f32,
    /// Number of cells along x, y and z.
    pub dimensions: [u32; 3],
}

/// The light map grid with its blocks.
pub(super) struct Grid {
    pub info: CellInfo,
    /// Blocks of each cell.
    blocks: Lists,
    /// Cells with blocks.
    pub occupied: Vec<u32>,
}

impl CellInfo {
    /// The number of cells, at most 2^24.
    pub(super) fn cells(&self) -> usize {
        self.dimensions.iter().product::<u32>() as usize
    }

    /// The cell of a position; positions outside are clamped.
    pub(super) fn cell(&self, position: Vec3) -> u32 {
        let at = ((position - self.origin) / self.cell_size).floor().max(Vec3::ZERO).as_uvec3();
        let at = at.min(UVec3::from(self.dimensions) - 1);
        at.x + self.dimensions[0] * (at.y + self.dimensions[1] * at.z)
    }

    pub(super) fn contains(&self, position: Vec3) -> bool {
        let at = (position - self.origin) / self.cell_size;
        let size = UVec3::from(self.dimensions).as_vec3();
        // A position on the upper face belongs to the last cell.
        position.is_finite() && at.cmpge(Vec3::ZERO).all() && at.cmple(size).all()
    }

    /// Distance from a position to a cell.
    pub(super) fn distance(&self, cell: u32, position: Vec3) -> f32 {
        let [nx, ny, _] = self.dimensions;
        let at = UVec3::new(cell % nx, cell / nx % ny, cell / nx / ny).as_vec3();
        let lower = self.origin + at * self.cell_size;
        position.distance(position.clamp(lower, lower + self.cell_size))
    }
}

impl Grid {
    /// Assigns blocks to the cells of their centres. `size` 0: automatic.
    pub fn new(lower: Vec3, upper: Vec3, size: f32, tiles: &mut [Tile]) -> Result<Grid> {
        if !(size >= 0.0 && size.is_finite()) {
            return invalid_argument!("cell_size is {size}, not a finite number ≥ 0");
        }
        let extent = upper - lower;
        let cell_size = if size > 0.0 { size } else { (extent.max_element() / AUTOMATIC_CELLS).max(f32::MIN_POSITIVE) };
        let cells = (extent / cell_size).ceil().max(Vec3::ONE);
        if cells.x as f64 * cells.y as f64 * cells.z as f64 > MAX_CELLS as f64 {
            return invalid_argument!("cell_size {cell_size} makes {cells} cells, more than {MAX_CELLS}");
        }
        Grid::with(CellInfo { origin: lower, cell_size, dimensions: cells.as_uvec3().to_array() }, tiles)
    }

    /// Assigns blocks to the cells of a grid; those outside of it to the nearest.
    pub fn with(info: CellInfo, tiles: &mut [Tile]) -> Result<Grid> {
        tiles.iter_mut().filter(|t| !t.texels.is_empty()).for_each(|tile| tile.cell = info.cell(tile.centre));
        let blocks = Lists::new(info.cells(), "the cells of the grid", |add| {
            let with_texels = (0..).zip(tiles.iter()).filter(|(_, t)| !t.texels.is_empty());
            with_texels.for_each(|(b, tile)| add(tile.cell as usize, b));
        })?;
        let mut grid = Grid { info, blocks, occupied: Vec::new() };
        let is_occupied = |&c: &u32| !grid.blocks_of(c).is_empty();
        grid.occupied = try_collect((0..grid.blocks.len() as u32).filter(is_occupied), "the cells with blocks")?;
        Ok(grid)
    }

    pub fn blocks_of(&self, cell: u32) -> &[u32] {
        self.blocks.get(cell as usize)
    }

    /// The lowest of the LODs that the blocks of a cell show.
    pub fn lod(&self, cell: u32, shown: &[u8]) -> u8 {
        self.blocks_of(cell).iter().map(|&b| shown[b as usize]).min().unwrap_or(NO_LOD)
    }

    /// Number of blocks of the cell that has most.
    pub fn most_blocks(&self) -> usize {
        self.blocks.longest()
    }

    pub fn bytes(&self) -> usize {
        self.blocks.bytes() + size_of_val(&self.occupied[..])
    }
}

/// Detects when all blocks of a cell have reached a LOD.
pub(super) struct Promotion {
    /// LOD of the work, by block.
    lods: Vec<u8>,
    /// Number of blocks at each LOD, by cell.
    counts: Vec<[u32; MAX_LODS]>,
    /// The LOD that all blocks of a cell have reached.
    common: Vec<u8>,
}

impl Promotion {
    pub fn new(tiles: &[Tile], grid: &Grid) -> Result<Promotion> {
        Ok(Promotion {
            lods: try_vec(tiles.len(), "the LODs of blocks")?,
            counts: try_vec(grid.blocks.len(), "the LODs of cells")?,
            common: try_vec(grid.blocks.len(), "the LODs of cells")?,
        })
    }

    pub fn bytes(&self) -> usize {
        self.lods.len() + self.counts.len() * (size_of::<[u32; MAX_LODS]>() + 1)
    }

    /// The LOD that all blocks of a cell have reached.
    pub fn common(&self, cell: u32) -> u8 {
        self.common[cell as usize]
    }

    /// Counts all blocks anew.
    pub fn count(&mut self, tiles: &[Tile], blocks: &[BlockStatus]) {
        self.counts.fill([0; MAX_LODS]);
        for ((tile, block), lod) in tiles.iter().zip(blocks).zip(&mut self.lods) {
            *lod = block.lod;
            if !tile.texels.is_empty() {
                self.counts[tile.cell as usize][block.lod as usize] += 1;
            }
        }
        for (common, counts) in self.common.iter_mut().zip(&self.counts) {
            *common = lowest(counts);
        }
    }

    /// Records the LOD of a block; returns that of its whole cell if it has risen.
    pub fn note(&mut self, b: u32, cell: u32, lod: u8) -> Option<u8> {
        let old = std::mem::replace(&mut self.lods[b as usize], lod);
        let counts = &mut self.counts[cell as usize];
        counts[old as usize] -= 1;
        counts[lod as usize] += 1;
        let now = lowest(counts);
        (std::mem::replace(&mut self.common[cell as usize], now) < now).then_some(now)
    }
}

/// The lowest LOD that any block has.
fn lowest(counts: &[u32; MAX_LODS]) -> u8 {
    counts.iter().position(|&n| n > 0).unwrap_or(0) as u8
}
