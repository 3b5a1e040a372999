//! Boxes of four lanes, and the references to triangles that builders sort.

use crate::base::array::Array;
use crate::base::error::Result;
use crate::base::geometry::half_area;
use crate::base::memory::{try_par_collect_ok, try_push, try_with_capacity, try_zeroed};
use crate::base::progress::Progress;
use crate::base::scratch_files::Storage;
use bytemuck::{Pod, Zeroable};
use glam::{Mat4, Vec3, Vec4, Vec4Swizzles};
use rayon::prelude::*;

/// Name of this memory in error messages.
const REFERENCES: &str = "references to triangles";

/// Number of references that one thread takes of a range at a time.
pub(super) const CHUNK: usize = 1 << 12;

/// A box stored as its negated lower and its upper corner, so that one maximum of eight lanes joins two.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C, align(32))]
pub(super) struct Box4 {
    pub(super) neg_lower: Vec4,
    pub(super) upper: Vec4,
}

impl Box4 {
    pub(super) const EMPTY: Box4 = Box4 { neg_lower: Vec4::NEG_INFINITY, upper: Vec4::NEG_INFINITY };

    pub(super) fn new(lower: Vec3, upper: Vec3) -> Box4 {
        // −0 + 0 = +0: of two zeros, min and max return one by operand order, not by sign.
        Box4 { neg_lower: (-(lower + Vec3::ZERO)).extend(0.0), upper: (upper + Vec3::ZERO).extend(0.0) }
    }

    pub(super) fn corners(&self) -> (Vec3, Vec3) {
        (-self.neg_lower.truncate(), self.upper.truncate())
    }

    #[inline(always)]
    pub(super) fn join(self, o: Box4) -> Box4 {
        Box4 { neg_lower: self.neg_lower.max(o.neg_lower), upper: self.upper.max(o.upper) }
    }

    #[inline(always)]
    pub(super) fn add(&mut self, p: Vec4) {
        *self = self.join(Box4 { neg_lower: -p, upper: p });
    }

    /// The intersection of two boxes, which may be empty.
    pub(super) fn meet(self, o: Box4) -> Box4 {
        Box4 { neg_lower: self.neg_lower.min(o.neg_lower), upper: self.upper.min(o.upper) }
    }

    pub(super) fn is_empty(&self) -> bool {
        (self.upper + self.neg_lower).cmplt(Vec4::ZERO).bitmask() & 7 != 0
    }

    /// Half the surface area, 0 if empty.
    pub(super) fn half_area(&self) -> f64 {
        let (lower, upper) = self.corners();
        if self.is_empty() { 0.0 } else { half_area(lower, upper) }
    }

    /// Extent per axis, 0 if empty.
    #[inline(always)]
    pub(super) fn extent(&self) -> Vec4 {
        (self.upper + self.neg_lower).max(Vec4::ZERO)
    }
}

/// The box of a triangle.
#[inline(always)]
pub(super) fn triangle_box([a, b, c]: [Vec3; 3]) -> Box4 {
    Box4::new(a.min(b).min(c), a.max(b).max(c))
}

/// Bounds of the centres of boxes.
#[derive(Clone, Copy)]
pub(super) struct Range4 {
    pub(super) lower: Vec4,
    pub(super) upper: Vec4,
}

impl Range4 {
    pub(super) const EMPTY: Range4 = Range4 { lower: Vec4::INFINITY, upper: Vec4::NEG_INFINITY };

    #[inline(always)]
    pub(super) fn grow(&mut self, c: Vec4) {
        self.lower = self.lower.min(c);
        self.upper = self.upper.max(c);
    }

    pub(super) fn join(self, o: Range4) -> Range4 {
        Range4 { lower: self.lower.min(o.lower), upper: self.upper.max(o.upper) }
    }
}

/// The box of a triangle; its number is stored in `neg_lower.w` as the low bits of a normal float (arithmetic on
/// denormals would be slow), which no result depends on.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(transparent)]
pub(super) struct Reference(pub(super) Box4);

impl Default for Reference {
    fn default() -> Self {
        Reference(Box4 { neg_lower: Vec4::ZERO, upper: Vec4::ZERO })
    }
}

impl Reference {
    const NORMAL: u32 = 0x4000_0000;

    pub(super) fn new(id: u32, corners: [Vec3; 3]) -> Self {
        Reference::of_box(id, triangle_box(corners))
    }

    pub(super) fn of_box(id: u32, mut b: Box4) -> Self {
        debug_assert!(id < Self::NORMAL);
        b.neg_lower.w = f32::from_bits(id | Self::NORMAL);
        Reference(b)
    }

    pub(super) fn bounds(&self) -> Box4 {
        self.0
    }

    pub(super) fn id(&self) -> u32 {
        self.0.neg_lower.w.to_bits() & (Self::NORMAL - 1)
    }

    /// Twice the box's centre: without the rounding of a division; all comparisons are the same.
    #[inline(always)]
    pub(super) fn centre(&self) -> Vec4 {
        self.0.upper - self.0.neg_lower
    }
}

/// Half the surface areas of boxes with extents `d`, one per lane.
#[inline(always)]
pub(super) fn half_areas(d: [Vec4; 4]) -> Vec4 {
    let [a, b, c, d] = d.map(|d| d * d.yzxw());
    let sums = Mat4::from_cols(a, b, c, d).transpose();
    sums.x_axis + sums.y_axis + sums.z_axis
}

/// A power of two near 1 / greatest extent, so that f32 areas of boxes inside neither over- nor
/// underflow, and scaling is exact.
#[inline(always)]
pub(super) fn area_scale(b: &Box4) -> f32 {
    let exponent = b.extent().truncate().max_element().to_bits() & 0x7f80_0000;
    f32::from_bits((0x7f00_0000 - exponent.min(0x7e80_0000)).max(1 << 23))
}

/// Bounds of boxes and of their centres.
#[derive(Clone, Copy)]
pub(super) struct Extent {
    pub(super) boxes: Box4,
    pub(super) centres: Range4,
}

impl Extent {
    pub(super) const EMPTY: Extent = Extent { boxes: Box4::EMPTY, centres: Range4::EMPTY };

    pub(super) fn of(refs: &[Reference]) -> Extent {
        let mut e = Extent::EMPTY;
        for r in refs {
            e.boxes = e.boxes.join(r.0);
            e.centres.grow(r.centre());
        }
        e
    }

    pub(super) fn join(self, o: Extent) -> Extent {
        Extent { boxes: self.boxes.join(o.boxes), centres: self.centres.join(o.centres) }
    }
}

/// References to all triangles that a tree is built over, and their extent.
pub(crate) struct References {
    /// In order of their numbers, on which trees with spatial splits depend.
    pub(super) refs: Array<Reference>,
    pub(super) extent: Extent,
    /// The numbers of the triangles that are not valid, ascending.
    pub(crate) skipped: Vec<u32>,
}

/// What a thread found of a chunk of references.
struct Filled {
    /// Number of references, which lie at the beginning of the chunk.
    count: usize,
    extent: Extent,
    skipped: Vec<u32>,
}

impl References {
    /// References to the triangles with numbers below `count` whose corners are `valid`. They lie in `storage`.
    pub(crate) fn of_valid(
        count: usize,
        corners: &(impl Fn(u32) -> [Vec3; 3] + Sync),
        valid: impl Fn([Vec3; 3]) -> bool + Sync,
        storage: Storage,
        progress: &Progress,
    ) -> Result<References> {
        let reference = |i| {
            let corners = corners(i as u32);
            valid(corners).then(|| Reference::new(i as u32, corners))
        };
        References::collect(count, reference, storage, progress)
    }

    /// References to some triangles by their numbers.
    pub(super) fn of(triangles: &[u32], corners: &(impl Fn(u32) -> [Vec3; 3] + Sync)) -> Result<References> {
        let reference = |i| Some(Reference::new(triangles[i], corners(triangles[i])));
        References::collect(triangles.len(), reference, Storage::MEMORY, &Progress::none())
    }

    fn collect(
        count: usize,
        reference: impl Fn(usize) -> Option<Reference> + Sync,
        storage: Storage,
        progress: &Progress,
    ) -> Result<References> {
        let mut refs = storage.zeroed::<Reference>(count, try_zeroed, REFERENCES)?;
        let fill = |(i, chunk): (usize, &mut [Reference])| {
            let (mut n, mut skipped) = (0, Vec::new());
            progress.check()?;
            for number in i * CHUNK..i * CHUNK + chunk.len() {
                match reference(number) {
                    Some(reference) => {
                        chunk[n] = reference;
                        n += 1;
                    }
                    None => try_push(&mut skipped, number as u32, REFERENCES)?,
                }
            }
            Ok(Filled { count: n, extent: Extent::of(&chunk[..n]), skipped })
        };
        let chunks = try_par_collect_ok(refs.par_chunks_mut(CHUNK).enumerate().map(fill), REFERENCES)?;
        // Chunks move up to those before.
        let mut all = 0;
        for (i, chunk) in chunks.iter().enumerate() {
            if all < i * CHUNK {
                refs.copy_within(i * CHUNK..i * CHUNK + chunk.count, all);
            }
            all += chunk.count;
        }
        refs.truncate(all);
        let mut skipped = try_with_capacity(count - all, REFERENCES)?;
        chunks.iter().for_each(|c| skipped.extend_from_slice(&c.skipped));
        Ok(References { refs, extent: chunks.iter().fold(Extent::EMPTY, |e, c| e.join(c.extent)), skipped })
    }

    pub(crate) fn len(&self) -> usize {
        self.refs.len()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::sampling::uniform;

    #[test]
    fn references_are_those_of_valid_triangles_and_the_others_are_named() {
        let corners = |i: u32| [0.0, 1.0, 2.0].map(|x| Vec3::new(i as f32 + x, x * x, 0.0));
        for (count, part) in [(1, 1.0), (CHUNK, 0.0), (3 * CHUNK + 17, 0.5), (2 * CHUNK + 1, 0.999), (5 * CHUNK, 0.01)]
        {
            let is_valid = |i: u32| uniform(i, 0, count as u32) < part;
            let by_corners = |c: [Vec3; 3]| is_valid(c[0].x as u32);
            let found = References::of_valid(count, &corners, by_corners, Storage::MEMORY, &Progress::none()).unwrap();
            let ids: Vec<u32> = found.refs.iter().map(Reference::id).collect();
            let (valid, skipped): (Vec<u32>, Vec<u32>) = (0..count as u32).partition(|&i| is_valid(i));
            assert_eq!((ids, &found.skipped), (valid, &skipped));
            assert!(found.refs.iter().all(|r| r.bounds().corners() == triangle_box(corners(r.id())).corners()));
            let extent = Extent::of(&found.refs);
            assert_eq!(found.extent.boxes.corners(), extent.boxes.corners());
        }
    }
}
