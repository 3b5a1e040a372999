//! `bakelite report scaling`: seconds and bytes of the stages of a bake, and rates of rays, against the number of
//! triangles, or with `--densities` against that of texels, with the exponents of the powers that fit them (least squares of logarithms).
//!
//! The thesis's Appendix A fitted 13·x^(1/8), 8.9·x^(1/7), 2.7·x^(1/5) and 36.6·x^(1/8) for its four kernels.

use crate::args::{BakeArgs, ReportArgs};
use crate::files;
use crate::job::Job;
use crate::pictures::PrimaryRays;
use crate::plot::curves::{Plot, Series};
use crate::report::measure::{exponent, median, surface_rays};
use bakelite::lightmap::{Lightmap, LightmapDesc};
use bakelite::scene::builtin_camera;
use bakelite::trace::{Hit, Ray};
use bakelite::{Result, Scene};
use std::fmt::Write;
use std::time::Instant;

/// Rays of each kind that are timed together.
const RAYS: u32 = 1 << 16;

/// Rays from each point, of streams.
const RAYS_PER_POINT: u32 = 256;

/// Times that they are timed, of which the median counts.
const RUNS: usize = 5;

/// Width and height of the view of primary rays, each pixel of which has four.
const VIEW: usize = 128;

/// What is measured: names, and whether they grow with the scene, or are rates that fall.
const STAGES: [&str; 8] =
    ["tree", "charts and texels", "photons", "radiance map", "gather map", "direct light", "seams", "all"];
const BYTES: [&str; 5] = ["scene", "building", "light map", "charting", "baking"];
const RATES: [&str; 3] = ["single random", "streams of 256", "primary"];

/// One scene's measurements.
struct Row {
    scene: String,
    triangles: f64,
    texels: u64,
    /// The one of them that grows.
    x: f64,
    seconds: [f64; STAGES.len()],
    /// Announced per triangle: what the scene holds, and at most while it is built; the same of the light map; at most
    /// while it is baked.
    bytes: [f64; BYTES.len()],
    /// Millions per second, on one thread.
    rates: [f64; RATES.len()],
}

/// Prints the tables in Markdown, and writes `scaling.csv` and plots.
pub fn run(args: &ReportArgs) -> Result<()> {
    files::make_folder(&args.bake.out)?;
    let mut rows = Vec::new();
    let by_texels = !args.densities.is_empty();
    for scene in &args.scenes {
        let of_scene = BakeArgs { scene: scene.clone(), ..args.bake.clone() };
        if !by_texels {
            rows.push(measure(&of_scene, args.rays_only)?);
        }
        for &texels_per_unit in &args.densities {
            let desc = LightmapDesc { texels_per_unit, ..of_scene.desc.clone() };
            let row = measure(&BakeArgs { desc, ..of_scene.clone() }, false)?;
            rows.push(Row { x: row.texels as f64, ..row });
        }
    }
    table("seconds", &STAGES, &rows, |r| &r.seconds);
    table("bytes per triangle", &BYTES, &rows, |r| &r.bytes);
    table("million rays per second, one thread", &RATES, &rows, |r| &r.rates);
    let path = |name: &str| args.bake.out.join(name);
    files::write_text(&path("scaling.csv"), &csv(&rows))?;
    let plot = |file: &str, y_label, names: &[&str], of: fn(&Row) -> &[f64]| {
        let series = names.iter().enumerate().map(|(i, &name)| Series { name, points: points(&rows, i, of) });
        let x_label = if by_texels { "texels" } else { "triangles" };
        let plot = Plot { title: "Scaling", x_label, y_label, series: series.collect(), marks: Vec::new() };
        files::write_text(&path(file), &plot.svg())
    };
    plot("scaling-seconds.svg", "seconds", &STAGES, |r| &r.seconds)?;
    plot("scaling-bytes.svg", "bytes per triangle", &BYTES, |r| &r.bytes)?;
    plot("scaling-rays.svg", "million rays per second", &RATES, |r| &r.rates)
}

fn measure(args: &BakeArgs, rays_only: bool) -> Result<Row> {
    let mut job = Job::new(args);
    let device = job.device()?;
    let memory = device.memory().clone();
    let scene = job.scene_on(&device)?;
    // What is opened was built by another run.
    let (tree, building) = (scene.stats().build_seconds, memory.peak());
    let rates = rates(args, &scene)?;
    let triangles = scene.stats().triangles as f64;
    let mut row = Row {
        scene: args.title(),
        triangles,
        texels: 0,
        x: triangles,
        seconds: [tree, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, tree],
        bytes: [scene.stats().bytes as i64, building, 0, 0, 0].map(|bytes| bytes as f64 / triangles),
        rates,
    };
    if rays_only {
        return Ok(row);
    }
    memory.reset_peak();
    let start = Instant::now();
    let mut lightmap = job.bars.show("charts", |p| Lightmap::create(&scene, &args.desc, p))?;
    let (charts, charting) = (start.elapsed().as_secs_f64(), memory.peak());
    memory.reset_peak();
    let stats = job.bars.show("bake", |p| lightmap.bake(&args.params, p))?;
    let baking = memory.peak();
    let stages = [stats.photons, stats.radiance, stats.gather, stats.direct];
    row.seconds[1] = charts;
    row.seconds[2..6].iter_mut().zip(stages).for_each(|(to, stage)| *to = stage.seconds);
    row.seconds[6] = stats.seam_seconds;
    row.seconds[7] = tree + charts + stats.seconds;
    let of_map = [lightmap.info().bytes as i64, charting, baking];
    row.bytes[2..].iter_mut().zip(of_map).for_each(|(to, bytes)| *to = bytes as f64 / triangles);
    row.texels = lightmap.info().texels;
    Ok(row)
}

/// Rates of rays one by one from random points, of streams from random points, and of primary rays if the scene has a
/// camera.
fn rates(args: &BakeArgs, scene: &Scene) -> Result<[f64; RATES.len()]> {
    let random = surface_rays(scene, RAYS, 1);
    let streams = surface_rays(scene, RAYS, RAYS_PER_POINT);
    let mut primary = Vec::new();
    if let Some(camera) = args.camera.or(builtin_camera(&args.scene)) {
        let view = PrimaryRays::new(&camera, VIEW, VIEW);
        primary = (0..VIEW * VIEW).flat_map(|pixel| view.of_pixel(pixel % VIEW, pixel / VIEW)).collect();
    }
    let mut hits = vec![Hit::MISS; random.len().max(primary.len())];
    let mut many = |rays: &[Ray]| scene.intersect_many(rays, false, &mut hits[..rays.len()]);
    let one_by_one = || {
        std::hint::black_box(random.iter().filter(|ray| scene.intersect(ray).t.is_finite()).count());
        Ok(())
    };
    Ok([
        rate(random.len(), one_by_one)?,
        rate(streams.len(), || many(&streams))?,
        rate(primary.len(), || many(&primary))?,
    ])
}

/// Median rate in millions per second; 0 without rays.
fn rate(rays: usize, mut trace: impl FnMut() -> Result<()>) -> Result<f64> {
    let mut rates = Vec::new();
    for _ in 0..RUNS {
        let start = Instant::now();
        trace()?;
        rates.push(rays as f64 * 1e-6 / start.elapsed().as_secs_f64().max(f64::MIN_POSITIVE));
    }
    Ok(median(rates))
}

fn points(rows: &[Row], column: usize, of: impl Fn(&Row) -> &[f64]) -> Vec<[f64; 2]> {
    rows.iter().map(|r| [r.x, of(r)[column]]).collect()
}

fn table(title: &str, names: &[&str], rows: &[Row], of: impl Fn(&Row) -> &[f64]) {
    println!("\n{title}\n\n| scene | triangles | texels | {} |", names.join(" | "));
    println!("|---|---|---|{}", "---|".repeat(names.len()));
    for row in rows {
        let values: Vec<String> = of(row).iter().map(|v| format!("{v:.2}")).collect();
        println!("| {} | {} | {} | {} |", row.scene, row.triangles, row.texels, values.join(" | "));
    }
    let exponents = (0..names.len()).map(|i| exponent(&points(rows, i, &of)));
    let exponents: Vec<String> = exponents.map(|e| e.map_or("".into(), |e| format!("{e:+.3}"))).collect();
    println!("| exponent | | | {} |", exponents.join(" | "));
}

fn csv(rows: &[Row]) -> String {
    let names = |prefix: &str, names: &[&str]| names.iter().map(|n| format!(",{prefix} {n}")).collect::<String>();
    let mut out = "scene,triangles,texels".to_owned();
    out += &(names("seconds", &STAGES) + &names("bytes per triangle", &BYTES) + &names("Mrays/s", &RATES) + "\n");
    for row in rows {
        let _ = write!(out, "{},{},{}", row.scene, row.triangles, row.texels);
        for value in row.seconds.iter().chain(&row.bytes).chain(&row.rates) {
            let _ = write!(out, ",{value}");
        }
        out.push('\n');
    }
    out
}
