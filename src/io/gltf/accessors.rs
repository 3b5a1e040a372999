//! Typed values in buffers. Sizes, offsets and counts are those of the file and trusted no further than they are
//! checked.

use super::{PART, Reader};
use crate::base::error::Result;
use gltf::accessor::{DataType, Dimensions};

/// Elements in a buffer, whose bounds have been checked.
struct Elements<'b> {
    bytes: &'b [u8],
    stride: usize,
    size: usize,
}

impl<'b> Elements<'b> {
    fn get(&self, k: usize) -> &'b [u8] {
        &self.bytes[k * self.stride..][..self.size]
    }
}

/// Vectors of an accessor.
pub(super) struct Column<'b, const N: usize> {
    values: Elements<'b>,
    pub(super) count: usize,
    data_type: DataType,
    normalized: bool,
    sparse: Option<Sparse<'b>>,
}

impl<const N: usize> Column<'_, N> {
    /// Integers are converted to floats.
    pub(super) fn get(&self, vertex: u32) -> [f32; N] {
        let v = vertex as usize;
        let replaced = self.sparse.as_ref().and_then(|sparse| sparse.get(v));
        let bytes = replaced.unwrap_or_else(|| self.values.get(v));
        let part = self.data_type.size();
        std::array::from_fn(|k| component(&bytes[k * part..], self.data_type, self.normalized))
    }
}

/// Values that replace others, in the order of their elements.
struct Sparse<'b> {
    at: Elements<'b>,
    index_type: DataType,
    values: Elements<'b>,
    count: usize,
}

impl<'b> Sparse<'b> {
    fn index(&self, k: usize) -> usize {
        unsigned(self.at.get(k), self.index_type) as usize
    }

    fn get(&self, element: usize) -> Option<&'b [u8]> {
        // Binary search.
        let (mut low, mut high) = (0, self.count);
        while low < high {
            let middle = low + (high - low) / 2;
            if self.index(middle) < element {
                low = middle + 1;
            } else {
                high = middle;
            }
        }
        (low < self.count && self.index(low) == element).then(|| self.values.get(low))
    }
}

/// One component as a float; `normalized` integers map to [0, 1] or [-1, 1] (glTF 2.0, 3.6.2.2).
fn component(bytes: &[u8], data_type: DataType, normalized: bool) -> f32 {
    let (value, full) = match data_type {
        DataType::I8 => (bytes[0] as i8 as f32, i8::MAX as f32),
        DataType::U8 => (bytes[0] as f32, u8::MAX as f32),
        DataType::I16 => (i16::from_le_bytes([bytes[0], bytes[1]]) as f32, i16::MAX as f32),
        DataType::U16 => (u16::from_le_bytes([bytes[0], bytes[1]]) as f32, u16::MAX as f32),
        DataType::U32 => (u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]) as f32, u32::MAX as f32),
        DataType::F32 => return f32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]),
    };
    if normalized { (value / full).max(-1.0) } else { value }
}

/// A little-endian unsigned integer of 1, 2 or 4 bytes.
fn unsigned(bytes: &[u8], data_type: DataType) -> u32 {
    match data_type {
        DataType::U8 => bytes[0] as u32,
        DataType::U16 => u16::from_le_bytes([bytes[0], bytes[1]]) as u32,
        _ => u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]),
    }
}

impl<'i> Reader<'i, '_> {
    /// The buffer view that holds an accessor's values. (Without one they would all be zeros, so many
    /// as the file likes to say.)
    fn base_view<'a>(&self, accessor: &gltf::Accessor<'a>) -> Result<gltf::buffer::View<'a>> {
        match accessor.view() {
            Some(view) => Ok(view),
            None => self.malformed(format_args!("accessor {} has no buffer view", accessor.index())),
        }
    }

    /// The `count` elements of `size` bytes in a buffer view, checked to lie in it.
    fn elements(&self, view: gltf::buffer::View, offset: usize, count: usize, size: usize) -> Result<Elements<'i>> {
        let stride = view.stride().unwrap_or(size);
        if stride < size || stride == 0 {
            return self.malformed(format_args!("buffer view {} has stride {stride}, less than {size}", view.index()));
        }
        let buffer = &self.buffers[view.buffer().index()];
        let bytes = view.offset().checked_add(view.length()).and_then(|end| buffer.get(view.offset()..end));
        let wanted = match count {
            0 => Some(0),
            _ => stride.checked_mul(count - 1).and_then(|n| n.checked_add(size)),
        };
        let end = wanted.and_then(|n| n.checked_add(offset));
        match bytes.and_then(|bytes| bytes.get(offset..end?)) {
            Some(bytes) => Ok(Elements { bytes, stride, size }),
            None => self.malformed(format_args!("{count} elements do not fit into buffer view {}", view.index())),
        }
    }

    /// An accessor of `N` components each. Values are converted when they are asked for: a primitive may use few of
    /// very many.
    pub(super) fn column<const N: usize>(&mut self, accessor: &gltf::Accessor) -> Result<Column<'i, N>> {
        let dimensions = [Dimensions::Vec2, Dimensions::Vec3, Dimensions::Vec4][N - 2];
        if accessor.dimensions() != dimensions {
            return self.malformed(format_args!("accessor {} is not of {N}-vectors", accessor.index()));
        }
        let (data_type, normalized) = (accessor.data_type(), accessor.normalized());
        let size = data_type.size() * N;
        let count = accessor.count();
        let values = self.elements(self.base_view(accessor)?, accessor.offset(), count, size)?;
        let sparse = match accessor.sparse() {
            Some(sparse) => Some(self.sparse(accessor.index(), &sparse, count, size)?),
            None => None,
        };
        Ok(Column { values, count, data_type, normalized, sparse })
    }

    fn sparse(
        &mut self,
        accessor: usize,
        sparse: &gltf::accessor::sparse::Sparse,
        count: usize,
        size: usize,
    ) -> Result<Sparse<'i>> {
        let indices = sparse.indices();
        let index_type = match indices.index_type() {
            gltf::accessor::sparse::IndexType::U8 => DataType::U8,
            gltf::accessor::sparse::IndexType::U16 => DataType::U16,
            gltf::accessor::sparse::IndexType::U32 => DataType::U32,
        };
        let at = self.elements(indices.view(), indices.offset(), sparse.count(), index_type.size())?;
        let values = self.elements(sparse.values().view(), sparse.values().offset(), sparse.count(), size)?;
        let sparse = Sparse { at, index_type, values, count: sparse.count() };
        if !self.sorted.contains(&accessor) {
            let mut next = 0;
            for k in 0..sparse.count {
                if k.is_multiple_of(PART) {
                    self.import.check()?;
                }
                let i = sparse.index(k);
                if i >= count {
                    return self.malformed(format_args!("a sparse value is for element {i}, there are {count}"));
                }
                if i < next {
                    return self
                        .malformed(format_args!("sparse values are not in order: {i} comes after {}", next - 1));
                }
                next = i + 1;
            }
            self.sorted.insert(accessor);
        }
        Ok(sparse)
    }

    /// Vertex numbers, checked to be less than `vertices`.
    pub(super) fn indices(&mut self, accessor: &gltf::Accessor, vertices: usize) -> Result<Vec<u32>> {
        let data_type = accessor.data_type();
        let unsigned_type = matches!(data_type, DataType::U8 | DataType::U16 | DataType::U32);
        if accessor.dimensions() != Dimensions::Scalar || !unsigned_type || accessor.sparse().is_some() {
            return self.malformed(format_args!("accessor {} is not of plain unsigned integers", accessor.index()));
        }
        let (view, count) = (self.base_view(accessor)?, accessor.count());
        let elements = self.elements(view, accessor.offset(), count, data_type.size())?;
        let mut indices = self.import.account.list(count, "the corners")?;
        for k in 0..count {
            if k.is_multiple_of(PART) {
                self.import.check()?;
            }
            let i = unsigned(elements.get(k), data_type);
            if i as usize >= vertices {
                return self.malformed(format_args!("an index names vertex {i}, there are {vertices}"));
            }
            indices.push(i);
        }
        Ok(indices)
    }
}
