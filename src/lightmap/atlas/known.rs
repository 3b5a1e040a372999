//! What of an atlas takes long to find and little room to keep: charts, which sides of them are seen, and the texels that
//! show another point than their own. Pages and all other texels follow from these.

use super::chart_map::ChartMap;
use super::charts::{Charts, UvReport};
use super::ids::Map;
use super::seen::Seen;
use super::texels::TexelSample;
use crate::base::error::{Error, Result};
use crate::base::memory::{try_push, try_vec};
use bytemuck::{Pod, Zeroable};

/// How far weights of corners may lie outside of a triangle, by rounding.
const TOLERANCE: f32 = 1e-3;

/// Parts of an atlas that are known already.
pub(in crate::lightmap) struct Known {
    pub charts: Charts,
    pub uvs: UvReport,
    pub seen: Seen,
    /// Number of rays that were traced to find the rest.
    pub sight_rays: u64,
    /// Texels that show other points, of the light map, the gather map and the radiance map.
    pub patches: [Vec<Patch>; 3],
    /// Where the rest is from, for errors.
    pub name: String,
}

/// A texel that shows another point than the one that its place has: buried, or with a part that can be seen.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(in crate::lightmap) struct Patch {
    pub sample: u32,
    triangle: u32,
    u: f32,
    v: f32,
    is_buried: u32,
}

impl Patch {
    /// Finds the texels of `map` that differ from those of `fresh`, the same map before buried texels were moved.
    pub fn all<M: Map>(map: &ChartMap<M>, fresh: &ChartMap<M>, buried: &[bool]) -> Result<Vec<Patch>> {
        let mut patches = Vec::new();
        for (i, (t, own)) in map.texels.samples.iter().zip(&fresh.texels.samples).enumerate() {
            let is_buried = buried.get(i).is_some_and(|&b| b);
            if is_buried || t != own {
                let (sample, is_buried) = (i as u32, is_buried.into());
                try_push(&mut patches, Patch { sample, triangle: t.triangle, u: t.u, v: t.v, is_buried }, "texels")?;
            }
        }
        Ok(patches)
    }

    fn is_possible(&self, charts: &Charts, own: &TexelSample) -> bool {
        let is_weight = |w: f32| (-TOLERANCE..=1.0 + TOLERANCE).contains(&w);
        charts.find(self.triangle) == Some(charts.chart_of(own.triangle))
            && charts.is_own(self.triangle)
            && is_weight(self.u)
            && is_weight(self.v)
            && is_weight(self.u + self.v)
            && self.is_buried <= 1
    }
}

impl Known {
    /// Applies the patches of map `number`; returns which texels are buried, empty if none is.
    pub fn patch<M: Map>(&self, number: usize, charts: &Charts, map: &mut ChartMap<M>) -> Result<Vec<bool>> {
        let impossible = || Error::Io(format!("{} is damaged: a texel in it cannot be", self.name));
        let patches = &self.patches[number];
        let mut buried = match patches.iter().any(|p| p.is_buried != 0) {
            true => try_vec(map.len(), "buried texels")?,
            false => Vec::new(),
        };
        for patch in patches {
            let texel = map.texels.samples.get_mut(patch.sample as usize).ok_or_else(impossible)?;
            if !patch.is_possible(charts, texel) {
                return Err(impossible());
            }
            (texel.triangle, texel.u, texel.v) = (patch.triangle, patch.u, patch.v);
            if patch.is_buried != 0 {
                buried[patch.sample as usize] = true;
            }
        }
        Ok(buried)
    }
}
