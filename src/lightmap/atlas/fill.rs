//! Filling of holes ring by ring: missing texels beside known ones get a value from these, then the texels beside
//! those, and so on. The result depends on the known texels alone, not on what missing ones held.

use super::chart_map::ChartMap;
use super::charts::Charts;
use super::ids::{GatherMap, GatherTexel, Map, PlacementId, TexelId};
use crate::base::directional::Linear;
use crate::base::error::Result;
use crate::base::memory::{try_collect, try_with_capacity};
use crate::base::progress::Progress;

/// Maximum number of rings: a hole wider than twice this many texels stays partly unfilled.
const MAX_RINGS: usize = 64;

/// Number of texels between two checks for a cancel.
const TEXELS_PER_CHECK: usize = 1024;

/// Name of the buffers in error messages.
const FILLED: &str = "the texels to be filled";

/// A texel and its eight neighbours, row by row.
pub(crate) fn around((x, y): (i32, i32)) -> impl Iterator<Item = (i32, i32)> {
    (0..9).map(move |i| (x + i % 3 - 1, y + i / 3 - 1))
}

/// Missing texels, and room for the values of one ring of them.
pub(crate) struct Hole<M: Map, T> {
    missing: Vec<TexelId<M>>,
    ring: Vec<(TexelId<M>, T)>,
}

impl<M: Map, T> Hole<M, T> {
    /// Prepares to fill `missing` texels. Filling allocates no memory.
    pub(crate) fn new(missing: Vec<TexelId<M>>) -> Result<Self> {
        let ring = try_with_capacity(missing.len(), FILLED)?;
        Ok(Hole { missing, ring })
    }

    /// Fills the hole. `value` returns what a missing texel gets from the texels that are known so far, if any of these
    /// lies beside it, and `set` makes it known. `check` fails on a cancel, with part of the texels filled.
    pub(crate) fn fill<Known>(
        mut self,
        known: &mut Known,
        check: impl Fn() -> Result<()>,
        value: impl Fn(&Known, TexelId<M>) -> Option<T>,
        mut set: impl FnMut(&mut Known, TexelId<M>, T),
    ) -> Result<()> {
        for _ in 0..MAX_RINGS {
            for part in self.missing.chunks(TEXELS_PER_CHECK) {
                check()?;
                self.ring.extend(part.iter().filter_map(|&texel| Some((texel, value(known, texel)?))));
            }
            if self.ring.is_empty() {
                break;
            }
            let mut filled = self.ring.iter().map(|(texel, _)| *texel).peekable();
            self.missing.retain(|texel| filled.next_if_eq(texel).is_none());
            self.ring.drain(..).for_each(|(texel, value)| set(known, texel, value));
        }
        Ok(())
    }
}

/// Returns the mean of the values that a texel and its neighbours in a placement have.
#[inline]
pub(crate) fn mean_around<M: Map, T: Linear>(
    map: &ChartMap<M>,
    placement: PlacementId,
    texel: TexelId<M>,
    value: impl Fn(TexelId<M>) -> Option<T>,
) -> Option<T> {
    let (mut sum, mut n) = (T::default(), 0.0);
    for (x, y) in around(map.position(texel)) {
        if let Some(value) = map.at(placement, x, y).and_then(&value) {
            sum += value;
            n += 1.0;
        }
    }
    (n > 0.0).then(|| sum / n)
}

/// Light of texels of the gather map that cannot be seen, from those that can.
pub(crate) struct Filling<T> {
    known: Vec<bool>,
    hole: Hole<GatherMap, T>,
}

impl<T: Linear> Filling<T> {
    /// Prepares to fill the `missing` ones of `n` texels from the `known` ones: each gets the mean of its known
    /// neighbours in the chart. Charts without a known texel are left unchanged. Filling allocates no memory.
    pub(crate) fn new(n: usize, known: impl Fn(usize) -> bool, missing: impl Fn(usize) -> bool) -> Result<Self> {
        let missing = try_collect((0..n).filter(|&i| missing(i)).map(GatherTexel::new), FILLED)?;
        let known = if missing.is_empty() { Vec::new() } else { try_collect((0..n).map(known), FILLED)? };
        Ok(Filling { known, hole: Hole::new(missing)? })
    }

    /// Fills the texels. Fails only on a cancel, with part of the texels filled.
    pub(crate) fn fill(
        self,
        charts: &Charts,
        map: &ChartMap<GatherMap>,
        values: &mut [T],
        progress: &Progress,
    ) -> Result<()> {
        let mean = |(known, values): &(Vec<bool>, &mut [T]), texel: GatherTexel| {
            let value = |near: GatherTexel| known[near.index()].then(|| values[near.index()]);
            mean_around(map, map.placement_of(charts, texel), texel, value)
        };
        self.hole.fill(
            &mut (self.known, values),
            || progress.check(),
            mean,
            |(known, values), texel, value| {
                values[texel.index()] = value;
                known[texel.index()] = true;
            },
        )
    }
}
