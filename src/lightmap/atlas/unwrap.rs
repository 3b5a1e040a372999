//! Unwrapping by parts, in parallel, for triangles without usable UVs (thesis 3.2.3).
//!
//! Triangles are grouped into parts of bounded size, each part is unwrapped separately by the crate `uvunwrap` (region
//! growing, LSCM refined as rigidly as possible), and only its charts are kept: packing is done by the layout. The
//! parts depend on the mesh alone, so the charts do not depend on the number of threads.
//!
//! Without the feature `unwrap`, and for triangles that the crate cannot unwrap, charts are single triangles and pairs
//! of nearly coplanar triangles, projected on their plane: poor, but valid by construction.

use super::pieces::{CHARTS, Groups, ITEMS_PER_CHECK, Piece, connected, float_key, surface_kind};
use crate::error::Result;
use crate::memory::{
    try_append, try_collect, try_filled, try_par_collect, try_par_gather, try_push, try_to_vec, try_with_capacity,
};
use crate::progress::Stage;
use crate::scene::{NONE, Scene};
use glam::{DVec2, DVec3, Vec3};
use rayon::prelude::*;

/// Maximum number of triangles in a part, unless they are one flat region. Large enough that few charts are cut at part
/// borders, small enough that parts keep many threads busy and a cancel is seen in time.
const PART_TRIANGLES: usize = 30_000;

/// Cosine of the greatest angle between the normals of a flat region's triangles and of its first one (a quarter
/// degree, as in `uvunwrap`). Parts never cut a flat region.
const FLAT_COSINE: f64 = 1.0 - 1e-5;

/// Cosine of the greatest angle between the normals of two triangles that share a planar chart (5 degrees).
const PAIR_COSINE: f64 = 0.9962;

/// Unwraps `triangles` (valid global numbers, ascending). Advances `stage` by one per triangle.
pub(in crate::lightmap) fn unwrap(scene: &Scene, triangles: &[u32], stage: &Stage) -> Result<Vec<Piece>> {
    let of_meshes = triangles.chunk_by(|&a, &b| scene.locate(a).0 == scene.locate(b).0);
    let of_meshes = try_collect(of_meshes, CHARTS)?;
    let parts = try_par_gather(of_meshes.len(), CHARTS, |i, out| {
        stage.check()?;
        out.append(&mut parts(scene, of_meshes[i], stage)?);
        Ok(())
    })?;
    let charted = try_par_gather(parts.len(), CHARTS, |i, out: &mut Vec<Piece>| {
        stage.check()?;
        *out = unwrap_part(&Geometry::of(scene, &parts[i], stage)?, scene, stage)?;
        stage.advance(parts[i].len() as u64)
    })?;
    Ok(charted)
}

/// Some triangles of one mesh with welded vertices.
struct Geometry {
    /// Global triangle numbers, ascending.
    triangles: Vec<u32>,
    /// Vertices of each triangle; equal positions are one vertex.
    indices: Vec<[u32; 3]>,
    positions: Vec<DVec3>,
    /// Unit normals of the triangles.
    normals: Vec<DVec3>,
    /// Kind of surface of each triangle, see [`surface_kind`].
    kinds: Vec<u32>,
}

impl Geometry {
    fn of(scene: &Scene, triangles: &[u32], stage: &Stage) -> Result<Geometry> {
        let corners = try_par_collect(triangles.par_iter().map(|&t| scene.corners(t)), CHARTS)?;
        let key = |corner: u32| corners[corner as usize / 3][corner as usize % 3].to_array().map(float_key);
        let mut order = try_collect(0..3 * triangles.len() as u32, CHARTS)?;
        stage.check()?;
        order.par_sort_unstable_by_key(|&c| (key(c), c));
        stage.check()?;
        let normal = |c: &[Vec3; 3]| {
            let [a, b, c] = c.map(|c| c.as_dvec3());
            (b - a).cross(c - a).normalize_or_zero()
        };
        let mut geometry = Geometry {
            indices: try_filled(triangles.len(), [0; 3], CHARTS)?,
            positions: Vec::new(),
            normals: try_par_collect(corners.par_iter().map(normal), CHARTS)?,
            kinds: try_par_collect(triangles.par_iter().map(|&t| surface_kind(scene.material(t))), CHARTS)?,
            triangles: try_to_vec(triangles, CHARTS)?,
        };
        for (i, same) in order.chunk_by(|&a, &b| key(a) == key(b)).enumerate() {
            if i % ITEMS_PER_CHECK == 0 {
                stage.check()?;
            }
            let (t, k) = (same[0] as usize / 3, same[0] as usize % 3);
            for &c in same {
                geometry.indices[c as usize / 3][c as usize % 3] = geometry.positions.len() as u32;
            }
            try_push(&mut geometry.positions, corners[t][k].as_dvec3(), CHARTS)?;
        }
        Ok(geometry)
    }

    fn corners(&self, triangle: usize) -> [DVec3; 3] {
        self.indices[triangle].map(|i| self.positions[i as usize])
    }

    /// Returns the triangle across each edge (corners k and k + 1). It is [`NONE`] if there is none, if more than two
    /// triangles share the edge, if the winding differs, or if the materials must not share a chart.
    fn neighbours(&self, stage: &Stage) -> Result<Vec<[u32; 3]>> {
        let mut edges = try_with_capacity(3 * self.indices.len(), CHARTS)?;
        for (t, i) in self.indices.iter().enumerate() {
            for k in 0..3 {
                let (a, b) = (i[k], i[(k + 1) % 3]);
                edges.push(((a.min(b), a.max(b)), t as u32, k as u8, a < b));
            }
        }
        stage.check()?;
        edges.par_sort_unstable();
        let mut neighbours = try_filled(self.indices.len(), [NONE; 3], CHARTS)?;
        for (i, same) in edges.chunk_by(|a, b| a.0 == b.0).enumerate() {
            if i % ITEMS_PER_CHECK == 0 {
                stage.check()?;
            }
            if let &[(_, t, k, forward), (_, t2, k2, forward2)] = same
                && forward != forward2
                && self.kinds[t as usize] == self.kinds[t2 as usize]
            {
                neighbours[t as usize][k as usize] = t2;
                neighbours[t2 as usize][k2 as usize] = t;
            }
        }
        Ok(neighbours)
    }
}

/// Divides the triangles of one mesh into parts: connected components stay together, and large ones are cut in space.
fn parts(scene: &Scene, triangles: &[u32], stage: &Stage) -> Result<Vec<Vec<u32>>> {
    if triangles.len() <= PART_TRIANGLES {
        return Ok(vec![try_to_vec(triangles, CHARTS)?]);
    }
    let geometry = Geometry::of(scene, triangles, stage)?;
    let mut keys = try_with_capacity(3 * triangles.len(), CHARTS)?;
    keys.extend(geometry.indices.iter().zip(0..).flat_map(|(i, t)| i.map(|i| (i, t))));
    let mut parts = Vec::new();
    let mut open: Vec<u32> = Vec::new();
    let mut neighbours = Vec::new();
    stage.check()?;
    let components = Groups::new(&connected(triangles.len(), keys, stage)?, stage)?;
    for component in components.iter() {
        if component.len() > PART_TRIANGLES {
            if neighbours.is_empty() {
                neighbours = geometry.neighbours(stage)?;
            }
            parts.append(&mut cut(flat_regions(&geometry, &neighbours, component, stage)?, stage)?);
            continue;
        }
        if open.len() + component.len() > PART_TRIANGLES {
            parts.push(std::mem::take(&mut open));
        }
        try_append(&mut open, component, CHARTS)?;
    }
    parts.push(open);
    parts.retain(|p| !p.is_empty());
    for part in &mut parts {
        stage.check()?;
        part.sort_unstable();
        part.iter_mut().for_each(|t| *t = triangles[*t as usize]);
    }
    Ok(parts)
}

/// A flat region, preceded by its middle.
type Region = (DVec3, Vec<u32>);

/// Finds the flat regions of a component: connected triangles with nearly equal normals.
fn flat_regions(geometry: &Geometry, neighbours: &[[u32; 3]], component: &[u32], stage: &Stage) -> Result<Vec<Region>> {
    let mut taken = try_filled(geometry.indices.len(), false, CHARTS)?;
    let mut regions = Vec::new();
    for (i, &seed) in component.iter().enumerate() {
        if i % ITEMS_PER_CHECK == 0 {
            stage.check()?;
        }
        if std::mem::replace(&mut taken[seed as usize], true) {
            continue;
        }
        let mut members = vec![seed];
        let mut next = 0;
        while let Some(&t) = members.get(next) {
            next += 1;
            for n in neighbours[t as usize] {
                let flat = n != NONE && geometry.normals[n as usize].dot(geometry.normals[seed as usize]) > FLAT_COSINE;
                if flat && !std::mem::replace(&mut taken[n as usize], true) {
                    try_push(&mut members, n, CHARTS)?;
                }
            }
        }
        let sum: DVec3 = members.iter().flat_map(|&t| geometry.corners(t as usize)).sum();
        try_push(&mut regions, (sum / (3 * members.len()) as f64, members), CHARTS)?;
    }
    Ok(regions)
}

/// Halves regions in space, along the longest side, until no part is too large.
fn cut(regions: Vec<Region>, stage: &Stage) -> Result<Vec<Vec<u32>>> {
    let mut parts = Vec::new();
    let mut stack = vec![regions];
    while let Some(mut regions) = stack.pop() {
        let total: usize = regions.iter().map(|r| r.1.len()).sum();
        if total <= PART_TRIANGLES || regions.len() == 1 {
            let mut part = try_with_capacity(total, CHARTS)?;
            regions.iter().for_each(|r| part.extend_from_slice(&r.1));
            parts.push(part);
            continue;
        }
        let lower = regions.iter().fold(DVec3::INFINITY, |m, r| m.min(r.0));
        let upper = regions.iter().fold(DVec3::NEG_INFINITY, |m, r| m.max(r.0));
        let axis = (upper - lower).max_position();
        stage.check()?;
        regions.sort_unstable_by(|a, b| a.0[axis].total_cmp(&b.0[axis]).then(a.1[0].cmp(&b.1[0])));
        let mut seen = 0;
        let half = regions.iter().position(|r| {
            seen += r.1.len();
            seen * 2 >= total
        });
        let half = half.unwrap_or(0).clamp(1, regions.len() - 1);
        let mut upper_half = try_with_capacity(regions.len() - half, CHARTS)?;
        upper_half.extend(regions.drain(half..));
        stack.extend([upper_half, regions]);
    }
    Ok(parts)
}

#[cfg(not(feature = "unwrap"))]
fn unwrap_part(geometry: &Geometry, _: &Scene, stage: &Stage) -> Result<Vec<Piece>> {
    planar_pieces(geometry, &try_filled(geometry.triangles.len(), true, CHARTS)?, stage)
}

#[cfg(feature = "unwrap")]
fn unwrap_part(geometry: &Geometry, scene: &Scene, stage: &Stage) -> Result<Vec<Piece>> {
    use crate::device::LogLevel;
    use crate::error::Error;
    let all = try_filled(geometry.triangles.len(), true, CHARTS)?;
    match charts_of_part(geometry, stage) {
        Ok((mut pieces, left)) => {
            for piece in planar_pieces(geometry, &left, stage)? {
                try_push(&mut pieces, piece, CHARTS)?;
            }
            Ok(pieces)
        }
        Err(uvunwrap::Error::Cancelled) => Err(Error::Cancelled),
        Err(e) => {
            let (count, first) = (geometry.triangles.len(), geometry.triangles[0]);
            scene.device().log(
                LogLevel::Warning,
                &format!(
                    "{count} triangles from triangle {first} on could not be unwrapped and get planar charts: {e}"
                ),
            );
            planar_pieces(geometry, &all, stage)
        }
    }
}

/// Returns the charts that `uvunwrap` makes of a part, and flags for the triangles without one (too thin for its
/// single-precision UVs).
#[cfg(feature = "unwrap")]
fn charts_of_part(geometry: &Geometry, stage: &Stage) -> std::result::Result<(Vec<Piece>, Vec<bool>), uvunwrap::Error> {
    // Positions are normalised, so that huge, tiny and far-off parts lose no precision.
    let lower = geometry.positions.iter().fold(DVec3::INFINITY, |m, &p| m.min(p));
    let upper = geometry.positions.iter().fold(DVec3::NEG_INFINITY, |m, &p| m.max(p));
    let (middle, size) = (0.5 * (lower + upper), (upper - lower).length());
    let positions: Vec<[f32; 3]> =
        geometry.positions.iter().map(|&p| ((p - middle) / size).as_vec3().to_array()).collect();
    let area: f64 = (0..geometry.triangles.len())
        .map(|t| {
            let [a, b, c] = geometry.corners(t).map(|p| p / size);
            0.5 * (b - a).cross(c - a).length()
        })
        .sum();
    // Only the page's size matters of its packing, since UVs are relative to it.
    let density = (PACKING_TEXELS / area).sqrt().min(MAX_PACKING_DENSITY) as f32;
    let mesh = uvunwrap::MeshInput {
        face_materials: Some(&geometry.kinds),
        ..uvunwrap::MeshInput::new(&positions, geometry.indices.as_flattened())
    };
    let options = uvunwrap::Options {
        max_chart_angle: MAX_CHART_ANGLE,
        max_area_distortion: MAX_AREA_DISTORTION,
        density: uvunwrap::Density::Fixed { texels_per_unit: density, page_size: None },
        padding: 0,
        allow_rotation: false,
        packing: uvunwrap::Packing::Fast,
        ..Default::default()
    };
    let atlas = uvunwrap::generate_with_progress(&[mesh], &options, |_| stage.check().is_ok())?;
    Ok(read_charts(geometry, &atlas, size / density as f64))
}

/// Number of texels of the page that `uvunwrap` packs a part into: few, since its packing takes time and is discarded
/// (San Miguel took 21 s of processor time with 512², 14.5 s with 128²). Not fewer, since charts take at least a texel
/// and UVs are rounded to single precision of the whole page.
#[cfg(feature = "unwrap")]
const PACKING_TEXELS: f64 = 128.0 * 128.0;
/// Maximum number of texels that a part's diagonal may take in that page, for parts with hardly any area.
#[cfg(feature = "unwrap")]
const MAX_PACKING_DENSITY: f64 = 65536.0;
/// Largest angle between a triangle and its chart, in degrees.
#[cfg(feature = "unwrap")]
const MAX_CHART_ANGLE: f32 = 60.0;
/// Largest ratio of a triangle's share of the chart's texels to its share of the surface.
#[cfg(feature = "unwrap")]
const MAX_AREA_DISTORTION: f32 = 2.0;

/// Reads the charts of an atlas whose texels are `texel` scene units wide.
#[cfg(feature = "unwrap")]
fn read_charts(geometry: &Geometry, atlas: &uvunwrap::Atlas, texel: f64) -> (Vec<Piece>, Vec<bool>) {
    let unit = DVec2::new(atlas.width as f64, atlas.height as f64) * texel;
    let empty = || Piece { triangles: Vec::new(), corners: Vec::new(), given: None };
    let mut pieces: Vec<Piece> = (0..atlas.chart_count).map(|_| empty()).collect();
    let mut left = vec![false; geometry.triangles.len()];
    let mesh = &atlas.meshes[0];
    for (t, corners) in mesh.indices.chunks_exact(3).enumerate() {
        let corners = [0, 1, 2].map(|k| mesh.vertices[corners[k] as usize]);
        let local = corners.map(|v| DVec2::from_array(v.uv.map(f64::from)) * unit);
        let [a, b, c] = local;
        // Triangles without a chart are degenerate in UV space, at a point of some chart.
        match corners[0].chart {
            Some(chart) if (b - a).perp_dot(c - a) > 0.0 => {
                pieces[chart as usize].triangles.push(geometry.triangles[t]);
                pieces[chart as usize].corners.push(local.map(|p| p.as_vec2().to_array()));
            }
            _ => left[t] = true,
        }
    }
    pieces.retain(|p| !p.triangles.is_empty());
    (pieces, left)
}

/// Makes charts for the triangles marked in `which`: pairs of nearly coplanar triangles, longest shared edges first,
/// and single triangles. The triangles of a pair lie on different sides of their edge, so they do not overlap in
/// projection.
fn planar_pieces(geometry: &Geometry, which: &[bool], stage: &Stage) -> Result<Vec<Piece>> {
    if !which.contains(&true) {
        return Ok(Vec::new());
    }
    let neighbours = geometry.neighbours(stage)?;
    let mut candidates = Vec::new();
    for t in (0..which.len()).filter(|&t| which[t]) {
        for (k, &n) in neighbours[t].iter().enumerate() {
            let open = n != NONE && which[n as usize] && n as usize > t;
            if open && geometry.normals[t].dot(geometry.normals[n as usize]) > PAIR_COSINE {
                let corners = geometry.corners(t);
                let length = corners[k].distance_squared(corners[(k + 1) % 3]);
                try_push(&mut candidates, (length, t, n as usize), CHARTS)?;
            }
        }
    }
    candidates.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    let mut partner = try_filled(which.len(), None, CHARTS)?;
    for (_, a, b) in candidates {
        if partner[a].is_none() && partner[b].is_none() {
            (partner[a], partner[b]) = (Some(b), Some(a));
        }
    }
    let first = (0..which.len()).filter(|&t| which[t] && partner[t].is_none_or(|p| p > t));
    try_collect(first.map(|t| planar_piece(geometry, t, partner[t])), CHARTS)
}

/// Makes a chart of a triangle and its partner, if any, projected on their plane, with the longest outer edge along x.
fn planar_piece(geometry: &Geometry, triangle: usize, partner: Option<usize>) -> Piece {
    let members: Vec<usize> = [Some(triangle), partner].into_iter().flatten().collect();
    let normal = members.iter().map(|&t| geometry.normals[t]).sum::<DVec3>().normalize_or(DVec3::Z);
    let inner = |edge: [u32; 2]| {
        let other = partner.map_or([NONE; 3], |p| geometry.indices[p]);
        other.contains(&edge[0]) && other.contains(&edge[1])
    };
    let ends = geometry.indices[triangle];
    let longest = (0..3)
        .map(|k| [ends[k], ends[(k + 1) % 3]])
        .filter(|&e| !inner(e))
        .map(|e| geometry.positions[e[1] as usize] - geometry.positions[e[0] as usize])
        .max_by(|a, b| a.length_squared().total_cmp(&b.length_squared()));
    let x =
        longest.map_or(DVec3::ZERO, |e| e.reject_from_normalized(normal)).normalize_or(normal.any_orthonormal_vector());
    let y = normal.cross(x);
    let origin = geometry.corners(triangle)[0];
    let project = |p: DVec3| DVec2::new((p - origin).dot(x), (p - origin).dot(y)).as_vec2().to_array();
    Piece {
        triangles: members.iter().map(|&t| geometry.triangles[t]).collect(),
        corners: members.iter().map(|&t| geometry.corners(t).map(project)).collect(),
        given: None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lightmap::atlas::charts::tests::{grid, scene_on};
    use crate::progress::Progress;

    #[test]
    fn planar_charts_hold_each_triangle_once_in_true_shape() {
        let scene = scene_on(1, grid(9, 7, |x, y| ((x * x + y) % 4) as f32 * 0.02));
        let progress = Progress::none();
        let stage = progress.stage("unwrap", 0.0, 1.0, 1);
        let triangles: Vec<u32> = (0..scene.triangle_count()).collect();
        let geometry = Geometry::of(&scene, &triangles, &stage).unwrap();
        let pieces = planar_pieces(&geometry, &vec![true; geometry.triangles.len()], &stage).unwrap();
        let mut triangles: Vec<u32> = pieces.iter().flat_map(|p| p.triangles.clone()).collect();
        triangles.sort_unstable();
        assert!(triangles.iter().copied().eq(0..scene.triangle_count()));
        // Nearly all pair up across a diagonal.
        assert!(pieces.len() < 80, "{} charts for 63 squares", pieces.len());
        for p in &pieces {
            for (t, c) in p.triangles.iter().zip(&p.corners) {
                let corners = geometry.corners(*t as usize);
                for k in 0..3 {
                    let flat = DVec2::new((c[k][0] - c[(k + 1) % 3][0]) as f64, (c[k][1] - c[(k + 1) % 3][1]) as f64);
                    let length = corners[k].distance(corners[(k + 1) % 3]);
                    assert!((flat.length() / length - 1.0).abs() < 0.005);
                }
            }
        }
    }

    #[test]
    fn parts_are_bounded_and_hold_each_triangle_once() {
        let scene = scene_on(2, grid(200, 170, |x, y| ((x * 31 + y * 17) % 11) as f32 * 0.1));
        let triangles: Vec<u32> = (0..scene.triangle_count()).collect();
        let progress = Progress::none();
        let parts = parts(&scene, &triangles, &progress.stage("unwrap", 0.0, 1.0, 1)).unwrap();
        assert!(parts.len() >= 3 && parts.iter().all(|p| p.len() <= PART_TRIANGLES && p.is_sorted()));
        let mut all = parts.concat();
        all.sort_unstable();
        assert_eq!(all, triangles);
    }
}
