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
        keys.extend(TexelId::<M>::range(begin..end).map(|s| key(map, s, s.index())));
        keys.sort_unstable();
        order.extend(keys.iter().map(|&key| TexelId::new(key as u32 as usize)));
        begin = end;
    }
    Ok(order)
}

/// Returns the places of some texels, of which those of a placement follow one another, in the same order.
pub(crate) fn places_in_order<M: Map>(map: &ChartMap<M>, texels: &[TexelId<M>]) -> Result<Vec<u32>> {
    let mut order: Vec<u32> = try_with_capacity(texels.len(), "the order of texels")?;
    let mut keys: Vec<u64> = try_with_capacity(texels.len(), "the order of texels")?;
    while order.len() < texels.len() {
        let begin = order.len();
        let of_placement = map.texels_of(map.texels.placement_of(texels[begin].index() as u32));
        let rest = texels[begin..].iter().enumerate().take_while(|(_, s)| of_placement.contains(**s));
        keys.clear();
        keys.extend(rest.map(|(i, &s)| key(map, s, begin + i)));
        keys.sort_unstable();
        order.extend(keys.iter().map(|&key| key as u32));
    }
    Ok(order)
}

/// Returns the number by which texels of a placement are sorted: their square, and a number of their own.
fn key<M: Map>(map: &ChartMap<M>, texel: TexelId<M>, number: usize) -> u64 {
    let t = &map[texel];
    let (x, y) = (u64::from(t.x >> WIDTH_BITS), u64::from(t.y >> WIDTH_BITS));
    (y << 16 | x) << 32 | number as u64
}
