//! Unwrapping by parts, in parallel, for triangles without usable UVs (thesis 3.2.3).
//!
//! Flat regions between creases are projected ([`planar`](super::planar)). The other triangles are grouped into parts
//! of bounded size, but for what [repeats](super::repeats). Each part is unwrapped separately by the crate `uvunwrap`
//! (region growing, LSCM refined as rigidly as possible), and only its charts are kept: packing is done by the layout.
//! The parts depend on the mesh alone, so the charts do not depend on the number of threads.
//!
//! Without the feature `unwrap`, and for triangles that the crate cannot unwrap, charts are single triangles and pairs
//! of nearly coplanar triangles, projected on their plane: poor, but valid by construction.

use super::pieces::{CHARTS, Groups, KnownPieces, Piece, connected_by_vertices};
use super::planar::{Regions, flat_piece, flat_regions, planar_pieces};
use super::repeats::Components;
use super::welded::Geometry;
use crate::base::array::Array;
use crate::base::error::Result;
use crate::base::memory::{try_append, try_collect, try_filled, try_par_gather, try_push, try_with_capacity};
use crate::base::progress::Stage;
use crate::scene::Scene;
use glam::DVec3;

/// Maximum number of triangles in a part, unless they are one flat region. Large enough that few charts are cut at part
/// borders, small enough that parts keep many threads busy and a cancel is seen in time.
const PART_TRIANGLES: usize = 30_000;

/// Number of flat regions that a thread takes at a time.
const REGIONS_PER_JOB: usize = 256;

/// Bytes per triangle of the flat regions, and of what is cut into parts: the component and the middle of each region.
const BYTES_OF_REGIONS: usize = Regions::BYTES_PER_TRIANGLE + 4 + 32 + Components::BYTES_PER_TRIANGLE;

/// Bytes per triangle of a part that is being unwrapped. (Measured: some 275 in the bunny, whose parts are all curved.)
const BYTES_IN_PART: usize = 300;

/// Estimates the bytes that unwrapping takes on a number of threads, without the pieces that it makes.
pub(in crate::lightmap) fn bytes(triangles: usize, vertices: usize, threads: usize) -> usize {
    let [of_triangle, of_vertex] = Geometry::BYTES_OF_NEIGHBOURS;
    triangles * (Geometry::BYTES_PER_TRIANGLE + of_triangle + BYTES_OF_REGIONS)
        + vertices.min(3 * triangles) * (Geometry::BYTES_PER_VERTEX + of_vertex)
        + triangles.min(threads * PART_TRIANGLES) * BYTES_IN_PART
}

/// Unwraps `triangles` (valid global numbers, ascending), object by object, but for curved ones whose charts are `known`.
/// Advances `stage` by one per triangle.
pub(in crate::lightmap) fn unwrap(
    scene: &Scene,
    triangles: &[u32],
    known: Option<KnownPieces>,
    stage: &Stage,
) -> Result<Vec<Piece>> {
    let of_objects = triangles.chunk_by(|&a, &b| scene.locate(a).0 == scene.locate(b).0);
    let of_objects = try_collect(of_objects, CHARTS)?;
    try_par_gather(of_objects.len(), CHARTS, |i, out| {
        stage.check()?;
        *out = unwrap_mesh(scene, of_objects[i], known, stage)?;
        Ok(())
    })
}

fn unwrap_mesh(scene: &Scene, triangles: &[u32], known: Option<KnownPieces>, stage: &Stage) -> Result<Vec<Piece>> {
    let geometry = Geometry::of(scene, triangles, stage)?;
    let neighbours = geometry.neighbours(scene.device(), stage)?;
    let all = try_collect(0..triangles.len() as u32, CHARTS)?;
    let regions = flat_regions(&geometry, &neighbours, &all, stage)?;
    let flat = try_par_gather(regions.len().div_ceil(REGIONS_PER_JOB), CHARTS, |i, out| {
        stage.check()?;
        let mut done = 0;
        for region in i * REGIONS_PER_JOB..regions.len().min((i + 1) * REGIONS_PER_JOB) {
            if let Some(piece) = flat_piece(&geometry, &neighbours, regions.get(region), stage)? {
                done += piece.triangles.len();
                try_push(out, (region, piece), CHARTS)?;
            }
        }
        stage.advance(done as u64)
    })?;
    let mut is_curved = try_filled(triangles.len(), true, CHARTS)?;
    for (region, _) in &flat {
        regions.get(*region).iter().for_each(|&t| is_curved[t as usize] = false);
    }
    drop((regions, all));
    let mut flat = try_collect(flat.into_iter().map(|(_, piece)| piece), CHARTS)?;
    let curved = match is_curved.contains(&true) {
        true => curved_pieces(scene, &geometry, neighbours, &is_curved, &mut flat, known, stage)?,
        false => Vec::new(),
    };
    let mut pieces = try_with_capacity(flat.len() + curved.len(), CHARTS)?;
    for piece in flat.into_iter().chain(curved) {
        pieces.push(piece.kept(scene.device())?);
    }
    Ok(pieces)
}

/// Makes the pieces of a mesh that are not `flat`: those that are `known`, those that are unwrapped, and copies of both. Removes
/// the flat ones of which another piece has triangles then.
fn curved_pieces(
    scene: &Scene,
    geometry: &Geometry,
    neighbours: Array<[u32; 3]>,
    is_curved: &[bool],
    flat: &mut Vec<Piece>,
    known: Option<KnownPieces>,
    stage: &Stage,
) -> Result<Vec<Piece>> {
    let triangles = &geometry.triangles;
    let all = || 0..triangles.len() as u32;
    let place = |t: &u32| triangles.binary_search(t).expect("it is one of them");
    let mut components = Components::of(geometry, is_curved, stage)?;
    let (mut pieces, mut is_taken) = (Vec::new(), try_filled(triangles.len(), false, CHARTS)?);
    if let Some(known) = known {
        // What is flat in curved surface, too: it may have had the chart of what its surface is a copy of.
        let offered = all().filter(|&t| components.is_curved(t as usize)).map(|t| triangles[t as usize]);
        pieces = known(&try_collect(offered, CHARTS)?, stage)?;
        for piece in &pieces {
            stage.check()?;
            piece.triangles.iter().for_each(|t| is_taken[place(t)] = true);
        }
    }
    components.find_copies(geometry, |t| is_taken[t as usize], stage)?;
    let is_copied = |t: usize| components.is_copied(t);
    flat.retain(|piece| !is_copied(place(&piece.triangles[0])) && !piece.triangles.iter().any(|t| is_taken[place(t)]));
    let settled = all().filter(|&t| is_curved[t as usize] && (is_taken[t as usize] || is_copied(t as usize))).count();
    let mut has_piece = is_taken;
    for piece in flat.iter() {
        stage.check()?;
        piece.triangles.iter().for_each(|t| has_piece[place(t)] = true);
    }
    let firsts = try_collect(all().filter(|&t| !has_piece[t as usize] && !is_copied(t as usize)), CHARTS)?;
    drop(has_piece);
    let unwrap_parts = |parts: Vec<Vec<u32>>| {
        try_par_gather(parts.len(), CHARTS, |i, out: &mut Vec<Piece>| {
            stage.check()?;
            *out = unwrap_part(&geometry.part(&parts[i], stage)?, scene, stage)?;
            stage.advance(parts[i].len() as u64)
        })
    };
    let of_firsts = parts(geometry, &neighbours, &firsts, stage)?;
    drop((neighbours, firsts));
    add(&mut pieces, unwrap_parts(of_firsts)?)?;
    let (copies, without) = components.copies(geometry, flat.iter().chain(&pieces), stage)?;
    stage.advance(settled as u64)?;
    add(&mut pieces, copies)?;
    if !without.is_empty() {
        let neighbours = geometry.neighbours(scene.device(), stage)?;
        add(&mut pieces, unwrap_parts(parts(geometry, &neighbours, &without, stage)?)?)?;
    }
    Ok(pieces)
}

fn add(pieces: &mut Vec<Piece>, more: Vec<Piece>) -> Result<()> {
    more.into_iter().try_for_each(|piece| try_push(pieces, piece, CHARTS))
}

/// Divides some triangles of a mesh (ascending) into parts: connected components stay together, and large ones are cut
/// in space.
fn parts(geometry: &Geometry, neighbours: &[[u32; 3]], triangles: &[u32], stage: &Stage) -> Result<Vec<Vec<u32>>> {
    if triangles.is_empty() {
        return Ok(Vec::new());
    }
    let mut parts = Vec::new();
    let mut open: Vec<u32> = Vec::new();
    let corners = triangles.iter().map(|&t| geometry.indices[t as usize]);
    let components = Groups::new(&connected_by_vertices(corners, geometry.positions.len(), stage)?, stage)?;
    for component in components.iter() {
        let component = try_collect(component.iter().map(|&i| triangles[i as usize]), CHARTS)?;
        if component.len() > PART_TRIANGLES {
            let regions = flat_regions(geometry, neighbours, &component, stage)?;
            parts.append(&mut cut(geometry, &regions, stage)?);
            continue;
        }
        if open.len() + component.len() > PART_TRIANGLES {
            parts.push(std::mem::take(&mut open));
        }
        try_append(&mut open, &component, CHARTS)?;
    }
    parts.push(open);
    parts.retain(|p| !p.is_empty());
    for part in &mut parts {
        stage.check()?;
        part.sort_unstable();
    }
    Ok(parts)
}

/// Halves regions in space, along the longest side, until no part is too large.
fn cut(geometry: &Geometry, regions: &Regions, stage: &Stage) -> Result<Vec<Vec<u32>>> {
    let middle = |region: usize| {
        let members = regions.get(region);
        let sum: DVec3 = members.iter().flat_map(|&t| geometry.corners(t as usize)).sum();
        (sum / (3 * members.len()) as f64, region as u32)
    };
    let mut middles = try_collect((0..regions.len()).map(middle), CHARTS)?;
    let size = |r: &(DVec3, u32)| regions.get(r.1 as usize).len();
    let mut parts = Vec::new();
    let mut stack = vec![&mut middles[..]];
    while let Some(some) = stack.pop() {
        let total: usize = some.iter().map(size).sum();
        if total <= PART_TRIANGLES || some.len() == 1 {
            let mut part = try_with_capacity(total, CHARTS)?;
            some.iter().for_each(|r| part.extend_from_slice(regions.get(r.1 as usize)));
            parts.push(part);
            continue;
        }
        let lower = some.iter().fold(DVec3::INFINITY, |m, r| m.min(r.0));
        let upper = some.iter().fold(DVec3::NEG_INFINITY, |m, r| m.max(r.0));
        let axis = (upper - lower).max_position();
        stage.check()?;
        some.sort_unstable_by(|a, b| a.0[axis].total_cmp(&b.0[axis]).then(a.1.cmp(&b.1)));
        let mut seen = 0;
        let half = some.iter().position(|r| {
            seen += size(r);
            seen * 2 >= total
        });
        let half = half.unwrap_or(0).clamp(1, some.len() - 1);
        let (lower_half, upper_half) = some.split_at_mut(half);
        stack.extend([upper_half, lower_half]);
    }
    Ok(parts)
}

#[cfg(not(feature = "unwrap"))]
fn unwrap_part(geometry: &Geometry, scene: &Scene, stage: &Stage) -> Result<Vec<Piece>> {
    planar_pieces(scene.device(), geometry, &try_filled(geometry.triangles.len(), true, CHARTS)?, stage)
}

#[cfg(feature = "unwrap")]
fn unwrap_part(geometry: &Geometry, scene: &Scene, stage: &Stage) -> Result<Vec<Piece>> {
    use super::unwrap_cache::Entry;
    use crate::base::error::Error;
    use crate::device::LogLevel;
    let (device, numbers) = (scene.device(), &geometry.triangles);
    let known = Entry::of(device, geometry)?;
    if let Some(entry) = &known
        && let Some(pieces) = entry.load(numbers)?
    {
        return Ok(pieces);
    }
    match charts_of_part(geometry, longest_component(geometry, stage)?, stage) {
        Ok((mut pieces, left)) => {
            for piece in planar_pieces(device, geometry, &left, stage)? {
                try_push(&mut pieces, piece, CHARTS)?;
            }
            if let Some(entry) = known {
                entry.save(&pieces, numbers, device);
            }
            Ok(pieces)
        }
        Err(uvunwrap::Error::Cancelled) => Err(Error::Cancelled),
        Err(e) => {
            let (count, first) = (numbers.len(), numbers[0]);
            device.log(
                LogLevel::Warning,
                &format!(
                    "{count} triangles from triangle {first} on could not be unwrapped and get planar charts: {e}"
                ),
            );
            planar_pieces(device, geometry, &try_filled(count, true, CHARTS)?, stage)
        }
    }
}

/// Returns the longest diagonal of the boxes around a part's connected components.
#[cfg(feature = "unwrap")]
fn longest_component(geometry: &Geometry, stage: &Stage) -> Result<f64> {
    let count = geometry.triangles.len();
    let component_of = connected_by_vertices(geometry.indices.iter().copied(), geometry.positions.len(), stage)?;
    let mut boxes = try_filled(count, [DVec3::INFINITY, DVec3::NEG_INFINITY], CHARTS)?;
    for (t, &component) in component_of.iter().enumerate() {
        let [lower, upper] = &mut boxes[component as usize];
        for corner in geometry.corners(t) {
            (*lower, *upper) = (lower.min(corner), upper.max(corner));
        }
    }
    Ok(boxes.iter().map(|[lower, upper]| (*upper - *lower).length()).filter(|d| d.is_finite()).fold(0.0, f64::max))
}

/// Returns the charts that `uvunwrap` makes of a part whose components are no longer than `longest`, and flags for the
/// triangles without one (too thin for its single-precision UVs).
#[cfg(feature = "unwrap")]
fn charts_of_part(
    geometry: &Geometry,
    longest: f64,
    stage: &Stage,
) -> std::result::Result<(Vec<Piece>, Vec<bool>), uvunwrap::Error> {
    // Positions are normalised, so that huge, tiny and far-off parts lose no precision.
    let points = || geometry.positions.iter().map(|p| p.as_dvec3());
    let (lower, upper) = (points().fold(DVec3::INFINITY, DVec3::min), points().fold(DVec3::NEG_INFINITY, DVec3::max));
    let (middle, size) = (0.5 * (lower + upper), (upper - lower).length());
    let positions: Vec<[f32; 3]> = points().map(|p| ((p - middle) / size).as_vec3().to_array()).collect();
    let area: f64 = (0..geometry.triangles.len())
        .map(|t| {
            let [a, b, c] = geometry.corners(t).map(|p| p / size);
            0.5 * (b - a).cross(c - a).length()
        })
        .sum();
    // Only the pages' size matters of their packing, since UVs are relative to it.
    let density = (PACKING_TEXELS / area).sqrt().min(MAX_PACKING_DENSITY) as f32;
    let mesh = uvunwrap::MeshInput {
        face_materials: Some(&geometry.kinds),
        ..uvunwrap::MeshInput::new(&positions, geometry.indices.as_flattened())
    };
    let page_size = (CHART_EXTENT * longest / size * density as f64).max(PACKING_TEXELS.sqrt()).ceil() as u32;
    let options = |page_size| uvunwrap::Options {
        max_chart_angle: MAX_CHART_ANGLE,
        max_area_distortion: MAX_AREA_DISTORTION,
        density: uvunwrap::Density::Fixed { texels_per_unit: density, page_size },
        padding: 0,
        allow_rotation: false,
        packing: uvunwrap::Packing::Fast,
        ..Default::default()
    };
    let unwrap = |page_size| uvunwrap::generate_with_progress(&[mesh], &options(page_size), |_| stage.check().is_ok());
    let atlas = match unwrap(Some(page_size)) {
        Err(uvunwrap::Error::ChartTooLarge { .. }) => unwrap(None)?,
        result => result?,
    };
    Ok(read_charts(geometry, &atlas, size / density as f64))
}

/// Number of texels that `uvunwrap` packs a part into: few, since its packing takes time and is discarded
/// (San Miguel took 21 s of processor time with 512², 14.5 s with 128²). Not fewer, since charts take at least a texel
/// and UVs are rounded to single precision of the whole page.
#[cfg(feature = "unwrap")]
const PACKING_TEXELS: f64 = 128.0 * 128.0;

/// Width of the pages that charts are packed into, in diagonals of the largest component: as normals of a chart lie
/// within [`MAX_CHART_ANGLE`] of its own, hardly any chart is larger. (Without a given width the packing tries seven.)
#[cfg(feature = "unwrap")]
const CHART_EXTENT: f64 = 2.0;
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
    let unit = glam::DVec2::new(atlas.width as f64, atlas.height as f64) * texel;
    let mut charts = vec![(Vec::new(), Vec::new()); atlas.chart_count as usize];
    let mut left = vec![false; geometry.triangles.len()];
    let mesh = &atlas.meshes[0];
    for (t, corners) in mesh.indices.chunks_exact(3).enumerate() {
        let corners = [0, 1, 2].map(|k| mesh.vertices[corners[k] as usize]);
        let local = corners.map(|v| glam::DVec2::from_array(v.uv.map(f64::from)) * unit);
        let [a, b, c] = local;
        // Triangles without a chart are degenerate in UV space, at a point of some chart.
        match corners[0].chart {
            Some(chart) if (b - a).perp_dot(c - a) > 0.0 => {
                let (triangles, corners) = &mut charts[chart as usize];
                triangles.push(geometry.triangles[t]);
                corners.push(local.map(|p| p.as_vec2().to_array()));
            }
            _ => left[t] = true,
        }
    }
    let piece = |(triangles, corners): (Vec<_>, Vec<_>)| {
        let is_there = !triangles.is_empty();
        is_there.then(|| Piece { triangles: triangles.into(), corners: corners.into(), given: None })
    };
    (charts.into_iter().filter_map(piece).collect(), left)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::progress::Progress;
    use crate::lightmap::atlas::charts::tests::{grid, scene_on};

    #[test]
    fn parts_are_bounded_and_hold_each_triangle_once() {
        let scene = scene_on(2, grid(200, 170, |x, y| ((x * 31 + y * 17) % 11) as f32 * 0.1));
        let triangles: Vec<u32> = (0..scene.triangle_count()).collect();
        let progress = Progress::none();
        let stage = progress.stage("unwrap", 0.0, 1.0, 1);
        let geometry = Geometry::of(&scene, &triangles, &stage).unwrap();
        let neighbours = geometry.neighbours(scene.device(), &stage).unwrap();
        let parts = parts(&geometry, &neighbours, &triangles, &stage).unwrap();
        assert!(parts.len() >= 3 && parts.iter().all(|p| p.len() <= PART_TRIANGLES && p.is_sorted()));
        let mut all = parts.concat();
        all.sort_unstable();
        assert_eq!(all, triangles);
    }
}
