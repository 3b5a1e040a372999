//! Numbers of charts, placements and texels as types: the compiler refuses a number of one kind where another is meant,
//! and a texel of one map in another map.
//!
//! All are `u32` in memory. [`index`](ChartId::index) makes an index of a number, for arrays with an entry per chart,
//! placement or texel; charts, layouts and maps are indexed by these types themselves.

use std::fmt::Debug;
use std::hash::Hash;
use std::marker::PhantomData;
use std::ops::Range;

/// Declares the number of something, with a value that stands for none.
macro_rules! number {
    ($(#[$doc:meta])* $name:ident) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, bytemuck::Pod, bytemuck::Zeroable)]
        #[repr(transparent)]
        pub struct $name(u32);

        impl $name {
            /// Stands for none, where an `Option` would take twice the memory.
            pub const NONE: $name = $name(crate::scene::NONE);

            /// Makes a number of an index, which fits 32 bits.
            #[inline]
            pub fn new(index: usize) -> Self {
                $name(index as u32)
            }

            /// Returns the number as an index.
            #[inline]
            pub fn index(self) -> usize {
                self.0 as usize
            }
        }
    };
}

number! {
    /// Number of a chart: the same in all three maps.
    ChartId
}

number! {
    /// Number of a chart's place in a layout: first the fronts, by chart, then the backs that have places of their own.
    /// The light map and the gather map give places to the same backs, the radiance map to those of all two-sided
    /// charts.
    PlacementId
}

impl PlacementId {
    /// Returns the place of a chart's front, which has the chart's number in every layout.
    #[inline]
    pub fn front_of(chart: ChartId) -> Self {
        PlacementId(chart.0)
    }
}

/// One of the three maps of an atlas, as a type.
pub trait Map: Copy + Default + Ord + Hash + Debug + Send + Sync + 'static {}

/// The light map or the gather map, which show one side of a two-sided chart unless both have places of their own.
pub trait ShownMap: Map {}

/// Irradiance for display.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct LightMap;

/// Indirect irradiance, coarser than the light map.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct GatherMap;

/// Outgoing radiance, which gather rays look up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct RadianceMap;

impl Map for LightMap {}
impl Map for GatherMap {}
impl Map for RadianceMap {}
impl ShownMap for LightMap {}
impl ShownMap for GatherMap {}

/// Number of a covered texel of map `M`, placement by placement.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[repr(transparent)]
pub struct TexelId<M: Map>(u32, PhantomData<M>);

/// A texel of the light map.
pub type LightTexel = TexelId<LightMap>;

/// A texel of the gather map.
pub type GatherTexel = TexelId<GatherMap>;

/// A texel of the radiance map.
pub type RadianceTexel = TexelId<RadianceMap>;

impl<M: Map> TexelId<M> {
    /// Stands for none, where an `Option` would take twice the memory.
    pub const NONE: Self = TexelId(crate::scene::NONE, PhantomData);

    /// Makes a number of an index, which fits 32 bits.
    #[inline]
    pub fn new(index: usize) -> Self {
        TexelId(index as u32, PhantomData)
    }

    /// Returns the number as an index.
    #[inline]
    pub fn index(self) -> usize {
        self.0 as usize
    }

    /// Returns the texels of a range of indices.
    #[inline]
    pub fn range(range: Range<usize>) -> TexelRange<M> {
        TexelRange { indices: range.start as u32..range.end as u32, of: PhantomData }
    }
}

/// Consecutive texels of map `M`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TexelRange<M: Map> {
    indices: Range<u32>,
    of: PhantomData<M>,
}

impl<M: Map> TexelRange<M> {
    /// Returns the indices of the texels.
    #[inline]
    pub fn indices(&self) -> Range<usize> {
        self.indices.start as usize..self.indices.end as usize
    }

    /// Whether a texel is one of them.
    #[inline]
    pub fn contains(&self, texel: TexelId<M>) -> bool {
        self.indices.contains(&texel.0)
    }

    /// Returns the place of a texel in an array with an entry for each of these.
    #[inline]
    pub fn place(&self, texel: TexelId<M>) -> usize {
        texel.0 as usize - self.indices.start as usize
    }
}

impl<M: Map> Iterator for TexelRange<M> {
    type Item = TexelId<M>;

    #[inline]
    fn next(&mut self) -> Option<TexelId<M>> {
        self.indices.next().map(|i| TexelId(i, PhantomData))
    }

    #[inline]
    fn nth(&mut self, n: usize) -> Option<TexelId<M>> {
        self.indices.nth(n).map(|i| TexelId(i, PhantomData))
    }

    #[inline]
    fn size_hint(&self) -> (usize, Option<usize>) {
        self.indices.size_hint()
    }
}

impl<M: Map> ExactSizeIterator for TexelRange<M> {}

/// Values per texel of map `M`, to be read by texels of this map alone.
#[derive(Clone, Copy, Debug)]
pub struct PerTexel<'a, M: Map, T> {
    values: &'a [T],
    of: PhantomData<M>,
}

impl<'a, M: Map, T> PerTexel<'a, M, T> {
    /// Takes values in the order of the map's texels.
    #[inline]
    pub fn new(values: &'a [T]) -> Self {
        PerTexel { values, of: PhantomData }
    }
}

impl<M: Map, T> std::ops::Index<TexelId<M>> for PerTexel<'_, M, T> {
    type Output = T;

    #[inline]
    fn index(&self, texel: TexelId<M>) -> &T {
        &self.values[texel.index()]
    }
}
