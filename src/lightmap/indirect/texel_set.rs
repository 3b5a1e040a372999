//! A set of texels, and their numbers in it (a bit vector with ranks: Jacobson, *Space-efficient Static Trees and Graphs*,
//! 1989).

use crate::base::error::Result;
use crate::base::memory::{try_vec, try_with_capacity};
use crate::lightmap::atlas::ids::{Map, TexelId};
use std::marker::PhantomData;

/// Texels of map `M`, a bit for each; no bits if there are none.
#[derive(Default)]
pub(crate) struct TexelSet<M: Map> {
    words: Vec<u64>,
    /// Number of texels in the words before each.
    before: Vec<u32>,
    of: PhantomData<M>,
}

impl<M: Map> TexelSet<M> {
    pub(super) fn new<'a>(texels: impl Iterator<Item = &'a TexelId<M>>, n: usize, what: &str) -> Result<TexelSet<M>> {
        let mut words = Vec::new();
        for i in texels.map(|texel| texel.index()) {
            if words.is_empty() {
                words = try_vec(n.div_ceil(64), what)?;
            }
            words[i / 64] |= 1 << (i % 64);
        }
        let mut before = try_with_capacity(words.len(), what)?;
        let mut count = 0;
        before.extend(words.iter().map(|word: &u64| {
            count += word.count_ones();
            count - word.count_ones()
        }));
        Ok(TexelSet { words, before, of: PhantomData })
    }

    /// Returns the number of texels before a texel of the set; `None` if it is not in the set.
    #[inline]
    pub(super) fn rank(&self, texel: TexelId<M>) -> Option<usize> {
        let (i, bit) = (texel.index() / 64, 1u64 << (texel.index() % 64));
        let word = *self.words.get(i)?;
        (word & bit != 0).then(|| self.before[i] as usize + (word & (bit - 1)).count_ones() as usize)
    }

    #[inline]
    pub(in crate::lightmap) fn has(&self, texel: TexelId<M>) -> bool {
        let i = texel.index();
        self.words.get(i / 64).is_some_and(|word| word >> (i % 64) & 1 != 0)
    }

    pub(super) fn is_empty(&self) -> bool {
        self.words.is_empty()
    }

    pub(super) fn bytes(&self) -> usize {
        size_of_val(&self.words[..]) + size_of_val(&self.before[..])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lightmap::atlas::ids::{LightMap, LightTexel};

    #[test]
    fn texels_are_numbered_in_ascending_order() {
        let texels: Vec<LightTexel> = [0, 1, 63, 64, 200, 255].map(LightTexel::new).into();
        let set = TexelSet::<LightMap>::new(texels.iter(), 256, "texels").unwrap();
        let ranks: Vec<usize> = LightTexel::range(0..256).filter_map(|s| set.rank(s)).collect();
        assert_eq!(ranks, (0..texels.len()).collect::<Vec<_>>());
        assert!(
            LightTexel::range(0..300).all(|s| set.has(s) == texels.contains(&s) && set.has(s) == set.rank(s).is_some())
        );
        assert!(TexelSet::<LightMap>::new([].iter(), 256, "texels").unwrap().is_empty());
    }
}
