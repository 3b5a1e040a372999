//! Tiles: groups of neighbouring texels, whose rays are traced together as [streams](crate::trace).
//!
//! Texels are numbered row by row, and a run of them may be a long line. What is traced together changes no bit of any
//! texel, so that a block of texels may be worked on in any order.

use super::atlas::chart_map::ChartMap;
use super::atlas::ids::{Map, TexelId};
use crate::base::error::Result;
use crate::base::memory::try_with_capacity;
use std::ops::Range;

/// Maximum number of texels of a tile.
pub(crate) const TILE: usize = 64;

/// Number of texels to a tile, given the samples of direct light of each: [`TILE`] unless they are so many that a
/// cancel would wait for a tile too long.
pub(crate) fn texels_per_tile(samples: u32) -> usize {
    const SAMPLES: usize = 4096;
    (SAMPLES / samples.max(1) as usize).clamp(1, TILE)
}

/// Bits of the width of the squares.
const WIDTH_BITS: u16 = 3;

/// Returns the texels of a range in the order of squares of 8 × 8 texels, placement by placement: runs of [`TILE`] of
/// them, or of a few times as many, are tiles.
pub(crate) fn in_order<M: Map>(map: &ChartMap<M>, range: Range<usize>) -> Result<Vec<TexelId<M>>> {
    let mut order: Vec<TexelId<M>> = try_with_capacity(range.len(), "the order of texels")?;
    let mut keys: Vec<u64> = try_with_capacity(range.len(), "the order of texels")?;
    let mut begin = range.start;
    while begin < range.end {
        let placement = map.texels.placement_of(begin as u32);
        let end = map.texels_of(placement).indices().end.min(range.end);
        // (Keys made once and not at each comparison: a third of the time.)
        keys.clear();
        keys.extend(TexelId::<M>::range(begin..end).map(|s| {
            let texel = &map[s];
            let (x, y) = (u64::from(texel.x >> WIDTH_BITS), u64::from(texel.y >> WIDTH_BITS));
            (y << 16 | x) << 32 | s.index() as u64
        }));
        keys.sort_unstable();
        order.extend(keys.iter().map(|&key| TexelId::new(key as u32 as usize)));
        begin = end;
    }
    Ok(order)
}
