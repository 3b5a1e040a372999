//! Pieces of surface from which charts are made, and how they are connected.

use crate::base::array::Array;
use crate::base::error::Result;
use crate::base::memory::{try_collect, try_filled, try_push};
use crate::base::progress::Stage;
use crate::base::sort::sort;
use crate::device::Device;
use crate::scene::{Material, NONE, Scene};

/// Name of the buffers in error messages.
pub(in crate::lightmap) const CHARTS: &str = "the charts";

/// Placement by the caller's UVs: uv = `offset` + `scale` · local.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Given {
    /// Number of the page.
    pub page: u32,
    /// UV of the local origin.
    pub offset: [f32; 2],
    /// UV per unit of local coordinates.
    pub scale: [f32; 2],
}

/// A piece of surface that becomes a chart. Local coordinates need not start at (0, 0).
pub(in crate::lightmap) struct Piece {
    /// Global triangle numbers, ascending.
    pub triangles: Array<u32>,
    /// Local coordinates of the corners, per entry of `triangles`.
    pub corners: Array<[[f32; 2]; 3]>,
    pub given: Option<Given>,
}

/// Makes pieces of those of some triangles of an object (global numbers, ascending) whose charts are known. To be called on
/// the device's threads.
pub(in crate::lightmap) type KnownPieces<'a> = &'a (dyn Fn(&[u32], &Stage) -> Result<Vec<Piece>> + Sync);

impl Piece {
    /// Moves the piece to where it takes no memory, if there is a folder for scratch files.
    pub fn kept(self, device: &Device) -> Result<Piece> {
        if !device.has_scratch() {
            return Ok(self);
        }
        Ok(Piece {
            triangles: device.copy(&self.triangles, CHARTS)?,
            corners: device.copy(&self.corners, CHARTS)?,
            given: self.given,
        })
    }
}

/// Returns the kind of surface of a material. Different kinds must not share a chart: two-sided and one-sided surfaces,
/// and emissive surfaces and others (a texel of the radiance map belongs to one or the other).
pub(in crate::lightmap) fn surface_kind(material: &Material) -> u32 {
    material.two_sided as u32 | (material.is_emissive() as u32) << 1
}

/// Returns a key that is equal for equal floats, +0 and −0 included.
pub(in crate::lightmap) fn float_key(x: f32) -> u32 {
    (x + 0.0).to_bits()
}

/// Finds connected items among `count` and returns, for each item, the lowest item connected to it. `keys` are pairs of
/// a key and an item; items with equal keys are connected.
pub(in crate::lightmap) fn connected<K: Ord + Send>(
    count: usize,
    mut keys: Vec<(K, u32)>,
    stage: &Stage,
) -> Result<Vec<u32>> {
    sort(&mut keys, &|| stage.check())?;
    let mut parent = try_collect(0..count as u32, CHARTS)?;
    for (i, pair) in keys.windows(2).enumerate() {
        if i % ITEMS_PER_CHECK == 0 {
            stage.check()?;
        }
        if pair[0].0 == pair[1].0 {
            let (a, b) = (root(&mut parent, pair[0].1), root(&mut parent, pair[1].1));
            // The lower one becomes the root, so that roots do not depend on the order of joins.
            parent[a.max(b) as usize] = a.min(b);
        }
    }
    for i in 0..count as u32 {
        parent[i as usize] = root(&mut parent, i);
    }
    Ok(parent)
}

/// Finds connected items as [`connected`] does, where the keys of an item are three of `vertices` vertices: in linear
/// time.
pub(in crate::lightmap) fn connected_by_vertices(
    items: impl ExactSizeIterator<Item = [u32; 3]>,
    vertices: usize,
    stage: &Stage,
) -> Result<Vec<u32>> {
    let mut parent = try_collect(0..items.len() as u32, CHARTS)?;
    let mut first_at = try_filled(vertices, NONE, CHARTS)?;
    for (i, corners) in (0..).zip(items) {
        if (i as usize).is_multiple_of(ITEMS_PER_CHECK) {
            stage.check()?;
        }
        for v in corners {
            let first = &mut first_at[v as usize];
            if *first == NONE {
                *first = i;
            }
            let (a, b) = (root(&mut parent, *first), root(&mut parent, i));
            parent[a.max(b) as usize] = a.min(b);
        }
    }
    for i in 0..parent.len() as u32 {
        parent[i as usize] = root(&mut parent, i);
    }
    Ok(parent)
}

/// Number of items between two checks for a cancel.
pub(in crate::lightmap) const ITEMS_PER_CHECK: usize = 1 << 14;

fn root(parent: &mut [u32], mut i: u32) -> u32 {
    while parent[i as usize] != i {
        let next = parent[parent[i as usize] as usize];
        parent[i as usize] = next;
        i = next;
    }
    i
}

/// Items by root (as from [`connected`]), ordered by root, ascending in each group.
pub(in crate::lightmap) struct Groups {
    items: Vec<u32>,
    /// Index of each group's first item; the last element is the number of items.
    starts: Vec<u32>,
}

impl Groups {
    pub(in crate::lightmap) fn new(roots: &[u32], stage: &Stage) -> Result<Groups> {
        // A root is the lowest item of its group: it comes first.
        let mut group_of = try_filled(roots.len(), NONE, CHARTS)?;
        let mut starts: Vec<u32> = Vec::new();
        for (i, &root) in roots.iter().enumerate() {
            if root as usize == i {
                group_of[i] = starts.len() as u32;
                try_push(&mut starts, 0, CHARTS)?;
            }
            starts[group_of[root as usize] as usize] += 1;
        }
        stage.check()?;
        let mut next = 0;
        for start in &mut starts {
            next += std::mem::replace(start, next);
        }
        let mut items = try_filled(roots.len(), 0, CHARTS)?;
        for (i, &root) in roots.iter().enumerate() {
            let place = &mut starts[group_of[root as usize] as usize];
            items[*place as usize] = i as u32;
            *place += 1;
        }
        // Each start has moved to the end of its group, where the next begins.
        try_push(&mut starts, 0, CHARTS)?;
        starts.rotate_right(1);
        Ok(Groups { items, starts })
    }

    pub(in crate::lightmap) fn len(&self) -> usize {
        self.starts.len() - 1
    }

    pub(in crate::lightmap) fn get(&self, group: usize) -> &[u32] {
        &self.items[self.starts[group] as usize..self.starts[group + 1] as usize]
    }

    pub(in crate::lightmap) fn iter(&self) -> impl Iterator<Item = &[u32]> {
        (0..self.len()).map(|group| self.get(group))
    }
}

/// Returns the area of a global triangle, in squared scene units.
pub(in crate::lightmap) fn triangle_area(scene: &Scene, triangle: u32) -> f64 {
    let [a, b, c] = scene.corners(triangle).map(|c| c.as_dvec3());
    0.5 * (b - a).cross(c - a).length()
}
