//! `bakelite report memory`: bytes per triangle of a committed scene by part, of default and compact trees,
//! and the rate of rays in compact ones.

use crate::args::BakeArgs;
use crate::job::Job;
use crate::report::measure::{median, surface_rays};
use bakelite::bvh::BuildOptions;
use bakelite::trace::{Hit, Ray};
use bakelite::{Result, Scene};
use std::time::Instant;

/// Rays that are timed together.
const RAYS: u32 = 100_000;

/// Rays from each point, of streams.
const RAYS_PER_POINT: u32 = 256;

/// Times that each tree traces them, by turns.
const PAIRS: usize = 9;

/// Prints the report as a table in Markdown; where the two trees differ, default / compact.
pub fn run(args: &BakeArgs) -> Result<()> {
    let mut job = Job::new(args);
    let data = job.load_dark()?;
    // A device each, for accounts of their own.
    let mut commit = |compact| {
        let device = job.device()?;
        job.commit_on(&device, data.clone(), &BuildOptions { compact, ..args.build })
    };
    let scenes = [commit(false)?, commit(true)?];
    let [random, streams] = [1, RAYS_PER_POINT].map(|per_point| surface_rays(&scenes[0], RAYS, per_point));
    let [random, occluded] = rates(&scenes, &random)?;
    let [streams, streams_occluded] = rates(&scenes, &streams)?;
    let [default, compact] = scenes.each_ref().map(|s| bytes(s));
    let both = |i: usize| format!("{:.1} / {:.1}", default[i], compact[i]);
    let (nodes, leaves, sum, peak) = (both(0), both(1), both(5), both(6));
    let [positions, indices, others] = [2, 3, 4].map(|i| format!("{:.1}", default[i]));
    let ratios = [random, occluded, streams, streams_occluded].map(|r| format!("{r:.2}")).join(" | ");
    print!("| scene | nodes | leaves | positions | indices | others | sum | while building ");
    println!("| random | occluded | streams of {RAYS_PER_POINT} | occluded |");
    println!("|{}", "---|".repeat(12));
    println!(
        "| {} | {nodes} | {leaves} | {positions} | {indices} | {others} | {sum} | {peak} | {ratios} |",
        args.scene
    );
    Ok(())
}

/// Bytes per triangle: nodes, leaves, positions, indices, the rest of the meshes, all of these, and the most
/// that is announced to a memory monitor while building.
fn bytes(scene: &Scene) -> [f64; 7] {
    let (stats, meshes) = (scene.stats(), scene.meshes());
    let positions: u64 = meshes.iter().map(|m| size_of_val(&m.positions[..]) as u64).sum();
    let indices: u64 = meshes.iter().map(|m| size_of_val(&m.indices[..]) as u64).sum();
    let leaves = stats.bvh_bytes - stats.node_bytes;
    let others = stats.bytes - stats.bvh_bytes - positions - indices;
    let peak = scene.device().memory().peak() as u64;
    [stats.node_bytes, leaves, positions, indices, others, stats.bytes, peak].map(|b| b as f64 / stats.triangles as f64)
}

/// Rate of the second scene over that of the first, of closest hits and of occlusion: medians of pairs.
fn rates(scenes: &[std::sync::Arc<Scene>; 2], rays: &[Ray]) -> Result<[f64; 2]> {
    let mut hits = [vec![Hit::MISS; rays.len()], vec![Hit::MISS; rays.len()]];
    let mut occluded = [vec![0; rays.len()], vec![0; rays.len()]];
    let mut ratios = [Vec::new(), Vec::new()];
    for _ in 0..PAIRS {
        let mut seconds = [[0.0; 2]; 2];
        for (i, scene) in scenes.iter().enumerate() {
            let start = Instant::now();
            scene.intersect_many(rays, false, &mut hits[i])?;
            seconds[0][i] = start.elapsed().as_secs_f64();
            let start = Instant::now();
            scene.occluded_many(rays, false, &mut occluded[i])?;
            seconds[1][i] = start.elapsed().as_secs_f64();
        }
        ratios.iter_mut().zip(seconds).for_each(|(r, [default, compact])| r.push(default / compact));
    }
    // After spatial splits, rays that graze an edge may.
    let differing = hits[0].iter().zip(&hits[1]).filter(|(a, b)| a != b).count();
    if differing > 0 {
        eprintln!("{differing} of {} rays have other hits in the compact tree", rays.len());
    }
    Ok(ratios.map(median))
}
