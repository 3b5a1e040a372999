//! `bakelite report pipeline`: what each stage of a bake takes (thesis 4.2), and what bounds it: rays per second
//! beside those of the bare kernels on rays of the same distribution, bytes per second beside what the memory
//! gives. And where the power of the lights goes, at several photon counts.

use crate::args::BakeArgs;
use crate::files;
use crate::job::Job;
use crate::plot::bars::{self, Bar};
use crate::report::measure::{median, pick, visible_texels};
use bakelite::lightmap::{BakeStats, Lightmap, StageStats};
use bakelite::photon::{PhotonMap, PhotonParams, PhotonStats, photon_rays};
use bakelite::sampling::{cosine_hemisphere, mix, orthonormal_basis, sobol_2d};
use bakelite::trace::offset::offset_ray_origin;
use bakelite::trace::{Hit, PACKET_SIZE, Packet, RawHit, Ray};
use bakelite::{Error, Light, Progress, Result, Scene};
use glam::Vec3;
use rayon::prelude::*;
use std::fmt::Write;
use std::sync::Arc;
use std::time::Instant;

/// Bakes, and runs of each bare kernel; medians are reported.
const RUNS: usize = 5;

/// Photons whose rays are traced by the bare kernel.
const PHOTONS: u64 = 200_000;

/// Photon counts for which power is accounted.
const ENERGY_PHOTONS: [u64; 4] = [1_000, 10_000, 100_000, 1_000_000];

/// Places that bare gather rays and shadow rays start from.
const PLACES: usize = 4096;

/// Packets per place.
const PACKETS: usize = 2;

/// Bytes that are copied to measure memory.
const COPIED: usize = 256 << 20;

const UNWRAPPING: &str = "unwrapping";

/// One line of the table.
struct Row {
    stage: &'static str,
    seconds: f64,
    rays: u64,
    bytes: u64,
    /// Rays per second of the bare kernel, where the stage traces any.
    bare: Option<f64>,
}

/// Runs the report.
pub fn run(args: &BakeArgs) -> Result<()> {
    files::make_folder(&args.out)?;
    let mut job = Job::new(args);
    let mut lightmap = job.unbaked()?;
    let mut bakes: Vec<BakeStats> = Vec::new();
    for _ in 0..RUNS {
        bakes.push(job.bars.show("bake", |p| lightmap.bake(&args.params, p))?);
    }
    let scene = lightmap.scene().clone();
    let places = places(&lightmap)?;
    let photons = median((0..RUNS).map(|_| photons_rate(&scene)).collect::<Result<_>>()?);
    let gather = median((0..RUNS).map(|_| gather_rate(&scene, &places)).collect());
    let shadow = median((0..RUNS).map(|_| shadow_rate(&scene, &places)).collect::<Result<_>>()?);
    let memory = median((0..RUNS).map(|_| copy_rate(&scene)).collect());

    let before = |name: &str| {
        let stage = job.stages.iter().find(|s| s.name == name);
        stage.map_or((0.0, 0), |s| (s.seconds, s.bytes))
    };
    let of = |stage: fn(&BakeStats) -> StageStats| {
        let s = stage(&bakes[0]);
        StageStats { seconds: median(bakes.iter().map(|b| stage(b).seconds).collect()), ..s }
    };
    let row = |stage, s: StageStats, bare| Row { stage, seconds: s.seconds, rays: s.rays, bytes: s.bytes, bare };
    let unwrap = lightmap.info().unwrap_seconds;
    let (tree, texels) = (before("tree"), before("charts and texels"));
    let rayless = |stage, (seconds, bytes): (f64, u64)| Row { stage, seconds, rays: 0, bytes, bare: None };
    let rows = [
        rayless("acceleration structure", tree),
        rayless(UNWRAPPING, (unwrap, 0)),
        rayless("packing and texels", (texels.0 - unwrap, texels.1)),
        row("photons", of(|b| b.photons), Some(photons)),
        row("radiance map", of(|b| b.radiance), Some(shadow)),
        row("gather map", of(|b| b.gather), Some(gather)),
        row("direct light", of(|b| b.direct), Some(shadow)),
        row("composition", of(|b| b.compose), None),
        rayless("seams", (median(bakes.iter().map(|b| b.seam_seconds).collect()), 0)),
    ];
    let energy = ENERGY_PHOTONS.into_iter().map(|n| energy(&scene, n)).collect::<Result<Vec<_>>>()?;
    let text = markdown(args, &lightmap, &rows, memory) + &energy_table(&energy);
    for (name, content) in [("pipeline.csv", &csv(&rows)), ("pipeline.svg", &chart(&rows)), ("pipeline.md", &text)] {
        files::write_text(&args.out.join(name), content)?;
    }
    if !args.quiet {
        println!("{text}\nWrote to {}: pipeline.md, pipeline.csv, pipeline.svg", args.out.display());
    }
    Ok(())
}

/// Where rays start, just above texels chosen at random, and the normals there.
fn places(lightmap: &Lightmap) -> Result<Vec<[Vec3; 2]>> {
    let (scene, texels) = (lightmap.scene(), visible_texels(lightmap)?);
    Ok((0..PLACES as u32).map(|i| pick(&texels, i)).map(|[p, n]| [offset_ray_origin(p, n, scene), n]).collect())
}

/// Rays per second of `rays`, on all threads.
fn rate(scene: &Scene, rays: u64, work: impl FnOnce() + Send) -> f64 {
    let start = Instant::now();
    scene.device().install(work);
    rays as f64 / start.elapsed().as_secs_f64()
}

/// The rays of photons, in their order, without what photons are.
fn photons_rate(scene: &Arc<Scene>) -> Result<f64> {
    let params = PhotonParams { photon_count: PHOTONS, ..Default::default() };
    let rays = photon_rays(scene, &params)?;
    let mut hits = vec![Hit::MISS; rays.len()];
    let start = Instant::now();
    scene.intersect_many(&rays, true, &mut hits)?;
    Ok(rays.len() as f64 / start.elapsed().as_secs_f64())
}

/// Where power went when so many photons were traced.
fn energy(scene: &Arc<Scene>, photon_count: u64) -> Result<PhotonStats> {
    let params = PhotonParams { photon_count, ..Default::default() };
    Ok(PhotonMap::trace(scene, &params, &Progress::none())?.stats())
}

fn energy_table(all: &[PhotonStats]) -> String {
    let mut out = String::from(
        "\n## Power\n\nMean of the channels. The rest is the sampling error of Russian roulette and of guides.\n\n\
         | photons | emitted, W | absorbed | escaped | cut off | rest |\n|---|---|---|---|---|---|\n",
    );
    for s in all {
        let mean = |power: [f64; 3]| power.iter().sum::<f64>() / 3.0;
        let emitted = mean(s.emitted_power);
        let part = |power| 100.0 * mean(power) / emitted;
        let parts = [part(s.absorbed_power), part(s.escaped_power), part(s.truncated_power)];
        let [absorbed, escaped, cut] = parts;
        let rest = 100.0 - parts.iter().sum::<f64>();
        let _ = writeln!(
            out,
            "| {} | {emitted:.5e} | {absorbed:.3} % | {escaped:.3} % | {cut:.3} % | {rest:+.3} % |",
            s.emitted
        );
    }
    out
}

/// Packets as the gather map traces them, without looking anything up.
fn gather_rate(scene: &Scene, places: &[[Vec3; 2]]) -> f64 {
    let rays = (places.len() * PACKETS * PACKET_SIZE) as u64;
    rate(scene, rays, || {
        places.par_iter().enumerate().for_each(|(i, &[origin, normal])| {
            let (x, y) = orthonormal_basis(normal);
            let mut hits = [RawHit::MISS; PACKET_SIZE];
            let mut points: Vec<[f32; 2]> =
                (0..(PACKETS * PACKET_SIZE) as u32).map(|k| sobol_2d(k, mix(i as u32))).collect();
            points.sort_unstable_by(|a, b| a[0].total_cmp(&b[0]));
            for bundle in points.chunks(PACKET_SIZE) {
                let mut packet = Packet::default();
                for &p in bundle {
                    let d = cosine_hemisphere(p);
                    packet.push(d.x * x + d.y * y + d.z * normal);
                }
                scene.gather_packet(origin, &packet, 0.0, f32::INFINITY, &mut hits);
                std::hint::black_box(&hits);
            }
        });
    })
}

/// Shadow rays from the places to the lights.
fn shadow_rate(scene: &Scene, places: &[[Vec3; 2]]) -> Result<f64> {
    let centre = |l: &Light| match *l {
        Light::Point { position, .. } | Light::Spot { position, .. } => position,
        Light::Directional { direction, .. } => -direction * 4.0 * scene.diagonal(),
        Light::Sky { up, .. } => up * 4.0 * scene.diagonal(),
        Light::Rect { position, edge_u, edge_v, .. } => position + 0.5 * (edge_u + edge_v),
    };
    let emitters = scene.emitters().iter().map(|e| e.corner + (e.edge_u + e.edge_v) / 3.0);
    let lights: Vec<Vec3> = scene.lights().iter().map(centre).chain(emitters).collect();
    if lights.is_empty() {
        return Err(Error::InvalidArgument("the scene has a material that emits, but no surface of it".into()));
    }
    let ray = |(i, [p, _]): (usize, &[Vec3; 2])| {
        let light = lights[mix(i as u32) as usize % lights.len()];
        Ray::new(*p, light - *p).within(0.0, 0.9999)
    };
    let rays: Vec<Ray> = (0..16).flat_map(|_| places.iter().enumerate().map(ray)).collect();
    let mut occluded = vec![0; rays.len()];
    let start = Instant::now();
    scene.occluded_many(&rays, true, &mut occluded)?;
    Ok(rays.len() as f64 / start.elapsed().as_secs_f64())
}

/// Bytes per second read and written by copying, on all threads.
fn copy_rate(scene: &Scene) -> f64 {
    let (from, mut to) = (vec![1u8; COPIED], vec![0u8; COPIED]);
    let part = COPIED / scene.device().num_threads().max(1) + 1;
    let start = Instant::now();
    scene.device().install(|| {
        to.par_chunks_mut(part).zip(from.par_chunks(part)).for_each(|(to, from)| to.copy_from_slice(from));
    });
    std::hint::black_box(&to);
    2.0 * COPIED as f64 / start.elapsed().as_secs_f64()
}

fn csv(rows: &[Row]) -> String {
    let mut out = String::from("stage,seconds,rays,bytes,bare_rays_per_second\n");
    for r in rows {
        let bare = r.bare.map_or(String::new(), |b| format!("{b:.0}"));
        let _ = writeln!(out, "{},{:.5},{},{},{bare}", r.stage, r.seconds, r.rays, r.bytes);
    }
    out
}

/// Seconds of all stages, and without unwrapping.
fn seconds(rows: &[Row]) -> [f64; 2] {
    let sum = |unwrapping: bool| {
        let counted = rows.iter().filter(|r| unwrapping || r.stage != UNWRAPPING);
        counted.map(|r| r.seconds).sum()
    };
    [sum(true), sum(false)]
}

/// Seconds of each stage, and its share of all with and without unwrapping.
fn chart(rows: &[Row]) -> String {
    let [all, others] = seconds(rows);
    let bar = |r: &Row| {
        let apart = r.stage == UNWRAPPING;
        let mut note = format!("{:.3} s, {:.1} %", r.seconds, 100.0 * r.seconds / all);
        if !apart {
            let _ = write!(note, " ({:.1} %)", 100.0 * r.seconds / others);
        }
        Bar { name: r.stage, value: r.seconds, note, apart }
    };
    let title = format!("Stages of a bake: {all:.2} s, {others:.2} s without unwrapping");
    bars::svg(&title, "seconds (share of all, and of all but unwrapping)", &rows.iter().map(bar).collect::<Vec<_>>())
}

fn markdown(args: &BakeArgs, lightmap: &Lightmap, rows: &[Row], memory: f64) -> String {
    let (scene, info) = (lightmap.scene(), lightmap.info());
    let [total, without_unwrapping] = seconds(rows);
    let mut out = format!(
        "# Pipeline: {}\n\n\
         {} triangles; {} texels at {:.2} per unit, {} gather and {} radiance texels, {} charts; {} photons, {} gather \
         rays; threads: {}, {}. Medians of {RUNS} bakes. The bare kernel's rays have the same distribution as the \
         stage's: photon paths in their order, shared-origin packets from texels, shadow rays from texels. Copying \
         memory moves {:.1} GB/s.\n\n\
         | stage | seconds | share | rays | Mrays/s | of the bare kernel's | MB | GB/s |\n|---|---|---|---|---|---|---|---|\n",
        args.title(),
        scene.stats().triangles,
        info.texels,
        info.texels_per_unit,
        info.gather_texels,
        info.radiance_texels,
        info.charts,
        args.params.photon_count,
        args.params.gather_rays,
        scene.device().num_threads(),
        scene.device().isa().name(),
        memory * 1e-9,
    );
    for r in rows {
        let rate = r.rays as f64 / r.seconds;
        let (rays, mrays) = if r.rays > 0 {
            (format!("{:.2} M", r.rays as f64 * 1e-6), format!("{:.2}", rate * 1e-6))
        } else {
            ("–".into(), "–".into())
        };
        let bare = match r.bare {
            Some(b) if r.rays > 0 => format!("{:.0} % of {:.2}", 100.0 * rate / b, b * 1e-6),
            _ => "–".into(),
        };
        let (mb, gb) = (r.bytes as f64 * 1e-6, r.bytes as f64 / r.seconds * 1e-9);
        let bytes = if r.bytes > 0 { format!("{mb:.1} | {gb:.2}") } else { "– | –".into() };
        let (stage, seconds, share) = (r.stage, r.seconds, 100.0 * r.seconds / total);
        let _ = writeln!(out, "| {stage} | {seconds:.3} | {share:.1} % | {rays} | {mrays} | {bare} | {bytes} |");
    }
    let _ = writeln!(
        out,
        "| sum | {total:.3} | | | | | | |\n| sum without unwrapping | {without_unwrapping:.3} | | | | | | |\n\n\
         ![seconds of each stage](pipeline.svg)\n\n## Plan\n",
    );
    for line in lightmap.plan_text().lines() {
        let _ = writeln!(out, "- {line}");
    }
    out
}
