//! The triangles of a mesh with welded vertices, and which lie next to which.

use super::pieces::{CHARTS, ITEMS_PER_CHECK, float_key, surface_kind};
use crate::base::array::Array;
use crate::base::error::Result;
use crate::base::memory::{try_collect, try_filled, try_with_capacity};
use crate::base::parallel::ParallelLoop;
use crate::base::progress::Stage;
use crate::base::sort::sort;
use crate::device::Device;
use crate::scene::{NONE, Scene};
use bytemuck::Pod;
use glam::{DVec3, Vec3};
use rayon::prelude::*;

/// Some triangles of one mesh with welded vertices.
pub(super) struct Geometry {
    /// Global triangle numbers, ascending.
    pub triangles: Array<u32>,
    /// Vertices of each triangle; equal positions are one vertex.
    pub indices: Array<[u32; 3]>,
    /// Positions by ascending bits, x first, so that they do not depend on the order of the mesh's vertices.
    pub positions: Array<Vec3>,
    /// Unit normals of the triangles.
    pub normals: Array<DVec3>,
    /// Kind of surface of each triangle, see [`surface_kind`].
    pub kinds: Array<u32>,
}

/// Computes something of each triangle, in parallel.
fn of_each<T: Pod + Send + Sync>(scene: &Scene, triangles: &[u32], f: impl Fn(&u32) -> T + Sync) -> Result<Array<T>> {
    let mut all = scene.device().zeroed(triangles.len(), CHARTS)?;
    all.par_iter_mut().zip(triangles).each(|(out, t)| *out = f(t));
    Ok(all)
}

impl Geometry {
    /// Bytes that a triangle takes.
    pub(super) const BYTES_PER_TRIANGLE: usize = 4 + 12 + 24 + 4;
    /// Bytes that a vertex takes. (Welding takes 20 more, but nothing else is there yet.)
    pub(super) const BYTES_PER_VERTEX: usize = 12;
    /// Bytes per triangle and per vertex that finding neighbours takes, the neighbours included.
    pub(super) const BYTES_OF_NEIGHBOURS: [usize; 2] = [12 + 12, 4];

    /// Welds `triangles`, which are most of the valid ones of one object (global numbers, ascending).
    pub(super) fn of(scene: &Scene, triangles: &[u32], stage: &Stage) -> Result<Geometry> {
        let (number, _) = scene.locate(triangles[0]);
        let (object, first) = (scene.object(number), scene.first_triangle(number));
        let mesh = object.mesh();
        let corners = |t: u32| mesh.indices[(t - first) as usize];
        let mut welded = try_filled(mesh.positions.len(), NONE, CHARTS)?;
        for (i, &t) in triangles.iter().enumerate() {
            if i % ITEMS_PER_CHECK == 0 {
                stage.check()?;
            }
            corners(t).into_iter().for_each(|v| welded[v as usize] = 0);
        }
        let key = |v: u32| object.position(v).to_array().map(float_key);
        let used = (0..mesh.positions.len() as u32).filter(|&v| welded[v as usize] == 0);
        let mut order = try_collect(used.map(|v| (key(v), v)), CHARTS)?;
        sort(&mut order, &|| stage.check())?;
        let mut positions = try_with_capacity(order.len(), CHARTS)?;
        for same in order.chunk_by(|a, b| a.0 == b.0) {
            same.iter().for_each(|&(_, v)| welded[v as usize] = positions.len() as u32);
            positions.push(object.position(same[0].1));
        }
        drop(order);
        stage.check()?;
        let normal = |&t: &u32| {
            let [a, b, c] = object.corners(t - first).map(|c| c.as_dvec3());
            (b - a).cross(c - a).normalize_or_zero()
        };
        let kind = |&t: &u32| surface_kind(&scene.materials()[mesh.material((t - first) as usize) as usize]);
        Ok(Geometry {
            indices: of_each(scene, triangles, |&t| corners(t).map(|v| welded[v as usize]))?,
            positions: positions.into(),
            normals: of_each(scene, triangles, normal)?,
            kinds: of_each(scene, triangles, kind)?,
            triangles: scene.device().copy(triangles, CHARTS)?,
        })
    }

    /// Some of these triangles (by their place here, ascending) with the vertices that they need.
    pub(super) fn part(&self, triangles: &[u32], stage: &Stage) -> Result<Geometry> {
        let mut used = try_with_capacity(3 * triangles.len(), CHARTS)?;
        used.extend(triangles.iter().flat_map(|&t| self.indices[t as usize]));
        stage.check()?;
        used.sort_unstable();
        used.dedup();
        let place = |v: u32| used.binary_search(&v).unwrap_or_default() as u32;
        let of = |t: &u32| *t as usize;
        Ok(Geometry {
            indices: try_collect(triangles.iter().map(|t| self.indices[of(t)].map(place)), CHARTS)?.into(),
            positions: try_collect(used.iter().map(|v| self.positions[of(v)]), CHARTS)?.into(),
            normals: try_collect(triangles.iter().map(|t| self.normals[of(t)]), CHARTS)?.into(),
            kinds: try_collect(triangles.iter().map(|t| self.kinds[of(t)]), CHARTS)?.into(),
            triangles: try_collect(triangles.iter().map(|t| self.triangles[of(t)]), CHARTS)?.into(),
        })
    }

    pub(super) fn corners(&self, triangle: usize) -> [DVec3; 3] {
        self.indices[triangle].map(|i| self.positions[i as usize].as_dvec3())
    }

    /// Returns the triangle across each edge (corners k and k + 1). It is [`NONE`] if there is none, if more than two
    /// triangles share the edge, if the winding differs, or if the materials must not share a chart.
    pub(super) fn neighbours(&self, device: &Device, stage: &Stage) -> Result<Array<[u32; 3]>> {
        let ends = |edge: u32| {
            let (i, k) = (self.indices[edge as usize / 3], edge as usize % 3);
            [i[k], i[(k + 1) % 3]]
        };
        let (lower, upper) = (|edge| ends(edge)[0].min(ends(edge)[1]), |edge| ends(edge)[0].max(ends(edge)[1]));
        // Edges, as three times their triangle plus their number in it, by their lower vertex: counted, and put in
        // place from behind. (To sort all edges with their vertices takes more than twice the memory.)
        let count = 3 * self.indices.len() as u32;
        let mut starts = try_filled(self.positions.len() + 1, 0u32, CHARTS)?;
        for edge in 0..count {
            if (edge as usize).is_multiple_of(ITEMS_PER_CHECK) {
                stage.check()?;
            }
            starts[lower(edge) as usize] += 1;
        }
        let mut sum = 0;
        for start in &mut starts {
            sum += *start;
            *start = sum;
        }
        let mut edges: Array<u32> = device.zeroed(count as usize, CHARTS)?;
        for edge in (0..count).rev() {
            if (edge as usize).is_multiple_of(ITEMS_PER_CHECK) {
                stage.check()?;
            }
            let start = &mut starts[lower(edge) as usize];
            *start -= 1;
            edges[*start as usize] = edge;
        }
        let mut neighbours: Array<[u32; 3]> = device.zeroed(self.indices.len(), CHARTS)?;
        neighbours.fill([NONE; 3]);
        // Edges of a vertex behind their upper ones.
        let most = starts.windows(2).map(|range| range[1] - range[0]).max().unwrap_or(0);
        let mut of_vertex: Vec<(u32, u32)> = try_with_capacity(most as usize, CHARTS)?;
        for (vertex, range) in starts.windows(2).enumerate() {
            if vertex % ITEMS_PER_CHECK == 0 {
                stage.check()?;
            }
            let edges = &edges[range[0] as usize..range[1] as usize];
            of_vertex.clear();
            of_vertex.extend(edges.iter().map(|&edge| (upper(edge), edge)));
            of_vertex.sort_unstable();
            for same in of_vertex.chunk_by(|a, b| a.0 == b.0) {
                let &[(_, a), (_, b)] = same else { continue };
                let [t, other] = [a, b].map(|edge| edge / 3);
                if ends(a)[0] != ends(b)[0] && self.kinds[t as usize] == self.kinds[other as usize] {
                    neighbours[t as usize][a as usize % 3] = other;
                    neighbours[other as usize][b as usize % 3] = t;
                }
            }
        }
        Ok(neighbours)
    }
}
