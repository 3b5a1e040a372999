//! `bakelite report quality`: error of the light against run time, for every knob of a bake, for path
//! tracing each texel with the same kernels, and for the photon map alone.

pub mod directional;
mod measure;
mod places;
mod ssim;
mod texel_paths;
mod view;

use crate::args::ReportArgs;
use crate::files;
use crate::job::Job;
use crate::plot::curves::{Plot, Series};
use crate::report::measure::median;
use bakelite::direct::{DirectLight, Receiver};
use bakelite::lightmap::{BakeParams, Layer, Lightmap, LightmapDesc};
use bakelite::photon::{PhotonMap, PhotonParams};
use bakelite::trace::PACKET_SIZE;
use bakelite::trace::offset::SurfacePoint;
use bakelite::{Error, Progress, Result};
use measure::{Errors, Points, Values, errors, relative_square};
use std::fmt::{Display, Write};
use std::time::Instant;
use texel_paths::TexelPaths;
use view::ViewReference;

const GATHER_RAYS: [u32; 7] = [16, 32, 64, 128, 256, 512, 1024];
const PHOTONS: [u64; 4] = [10_000, 100_000, 1_000_000, 4_000_000];
/// In units of the automatic one.
const RADII: [f32; 4] = [0.5, 1.0, 2.0, 4.0];
const BLURS: [u32; 4] = [0, 1, 2, 4];
const GATHER_DIVISORS: [u32; 4] = [1, 2, 4, 8];
const RADIANCE_DIVISORS: [u32; 4] = [2, 4, 8, 16];
const DIRECT_SAMPLES: [u32; 3] = [4, 16, 64];
const PASSES: [u32; 4] = [2, 4, 8, 16];
/// Rounds of [`PACKET_SIZE`] paths per texel.
const PATH_ROUNDS: [u32; 5] = [1, 2, 4, 8, 16];
/// Pixels across the view that is compared.
const VIEW_WIDTH: usize = 160;
const PHOTONS_ALONE: [u64; 4] = [100_000, 1_000_000, 4_000_000, 16_000_000];

/// Root mean square errors that people ask for.
const GOALS: [f64; 3] = [0.1, 0.05, 0.01];

/// One setting of one way to compute light.
struct Row {
    /// The knob that is turned, or another way to compute light.
    series: String,
    value: String,
    /// For the light of all texels.
    seconds: f64,
    indirect: Errors,
    /// Direct light too, where it is part of what was computed.
    all: Option<Errors>,
    /// Direct light alone, likewise.
    direct: Option<Errors>,
    /// Structural similarity of a view with the path traced one, where the view can be rendered.
    ssim: Option<f64>,
    /// Relative MSE that the bake itself estimates at the points, if it had several passes.
    estimated: Option<f64>,
}

/// Runs the report.
pub fn run(args: &ReportArgs) -> Result<()> {
    files::make_folder(&args.bake.out)?;
    let mut job = Job::new(&args.bake);
    let mut lightmap = job.unbaked()?;
    let params = args.bake.params;
    job.bars.show("bake", |p| lightmap.bake(&params, p))?;
    let camera = job.camera(&lightmap);
    let start = Instant::now();
    let seen = match &args.reference {
        Some(file) => Points::read(file, &lightmap)?,
        None => job.bars.show("reference", |p| {
            let chosen = Points::chosen(&lightmap, &camera, args.points, args.points_seed)?;
            chosen.with_reference(&lightmap, args.paths, p)
        })?,
    };
    let at_points = seen.csv(&seen.of_bake(&lightmap, Layer::Indirect)?);
    let points = seen.shown_by(&lightmap)?;
    let reference_seconds = start.elapsed().as_secs_f64();
    if points.all[0].iter().flatten().all(|&c| c == 0.0) {
        return Err(Error::InvalidArgument("no light arrives at any of the points compared".into()));
    }
    let (width, height) = (args.bake.width, args.bake.height);
    let size = [VIEW_WIDTH, (VIEW_WIDTH * height / width).max(1)];
    let mut view = None;
    if args.view_paths > 0 {
        view = Some(job.bars.show("view", |p| ViewReference::new(&lightmap, camera, size, args.view_paths, p))?);
    }
    let mut measure = Measure { args, points: &points, view: view.as_ref(), rows: Vec::new() };
    measure.bakes(&job, &mut lightmap)?;
    if measure.varies("path-tracing") {
        measure.paths(&job, &lightmap)?;
    }
    if measure.varies("photons-alone") {
        measure.photons_alone(&job, &lightmap)?;
    }
    let rows = measure.rows;

    let text = markdown(args, &lightmap, [&seen, &points], reference_seconds, view.as_ref(), &rows);
    for (name, content) in [
        ("quality.md", &text),
        ("quality.csv", &csv(&rows)),
        ("quality-points.csv", &at_points),
        ("quality.svg", &plot(&rows)),
    ] {
        files::write_text(&args.bake.out.join(name), content)?;
    }
    if !args.bake.quiet {
        println!(
            "{text}\nWrote to {}: quality.md, quality.csv, quality-points.csv, quality.svg",
            args.bake.out.display()
        );
    }
    Ok(())
}

struct Measure<'a> {
    args: &'a ReportArgs,
    points: &'a Points,
    view: Option<&'a ViewReference>,
    rows: Vec<Row>,
}

impl Measure<'_> {
    /// Bakes with one knob turned at a time.
    fn bakes(&mut self, job: &Job, lightmap: &mut Lightmap) -> Result<()> {
        let args = &self.args.bake;
        self.bake(job, lightmap, "as given", String::new(), &args.params)?;
        self.sweep(job, lightmap, "gather-rays", GATHER_RAYS, |_, p, n| p.gather_rays = n)?;
        self.sweep(job, lightmap, "photons", PHOTONS, |_, p, n| p.photon_count = n)?;
        if self.varies("radius") {
            let photon_count = args.params.photon_count;
            let photons = PhotonParams { photon_count, store_direct: false, ..Default::default() };
            let automatic = PhotonMap::trace(lightmap.scene(), &photons, &Progress::none())?.radius();
            self.sweep(job, lightmap, "radius", RADII.map(|f| f * automatic), |_, p, r| p.radius = r)?;
        }
        self.sweep(job, lightmap, "blur", BLURS, |_, p, n| p.blur_radius = n)?;
        if DirectLight::new(lightmap.scene()).area_light_count() > 0 {
            self.sweep(job, lightmap, "direct-samples", DIRECT_SAMPLES, |_, p, n| p.direct_samples = n)?;
        }
        self.sweep(job, lightmap, "passes", PASSES, |_, p, n| p.passes = n)?;
        self.sweep(job, lightmap, "gather-divisor", GATHER_DIVISORS, |d, _, n| d.gather_divisor = n)?;
        self.sweep(job, lightmap, "radiance-divisor", RADIANCE_DIVISORS, |d, _, n| d.radiance_divisor = n)
    }

    /// Bakes with all values of a knob, which `set` turns, if it is to be varied.
    fn sweep<V: Copy + Display>(
        &mut self,
        job: &Job,
        lightmap: &mut Lightmap,
        knob: &str,
        values: impl IntoIterator<Item = V>,
        set: fn(&mut LightmapDesc, &mut BakeParams, V),
    ) -> Result<()> {
        if !self.varies(knob) {
            return Ok(());
        }
        let given = self.args.bake.desc.clone();
        for value in values {
            let (mut desc, mut params) = (given.clone(), self.args.bake.params);
            set(&mut desc, &mut params, value);
            // (Of whole numbers all digits are shown.)
            let (series, value) = (knob.replace('-', " "), format!("{value:.4}"));
            if desc == given {
                self.bake(job, lightmap, &series, value, &params)?;
            } else {
                let mut other = Lightmap::create(lightmap.scene(), &desc, &Progress::none())?;
                self.bake(job, &mut other, &series, value, &params)?;
            }
        }
        Ok(())
    }

    fn varies(&self, knob: &str) -> bool {
        self.args.knobs.iter().any(|k| k == knob)
    }

    /// One setting with all seeds.
    fn bake(
        &mut self,
        job: &Job,
        lightmap: &mut Lightmap,
        series: &str,
        value: String,
        params: &BakeParams,
    ) -> Result<()> {
        job.bars.say(&format!("{series} {value}"));
        let (mut indirect, mut direct, mut all) = (Vec::new(), Vec::new(), Vec::new());
        let (mut seconds, mut ssim, mut estimated) = (Vec::new(), Some(0.0), None);
        for seed in 0..self.args.seeds {
            let params = BakeParams { seed: params.seed + seed, ..*params };
            seconds.push(lightmap.bake(&params, &Progress::none())?.seconds);
            indirect.push(self.points.of_bake(lightmap, Layer::Indirect)?);
            direct.push(self.points.of_bake(lightmap, Layer::Direct)?);
            all.push(self.points.of_bake(lightmap, Layer::Combined)?);
            let one = self.view.map(|view| view.of_bake(lightmap)).transpose()?.flatten();
            ssim = ssim.zip(one).map(|(sum, one)| sum + one / self.args.seeds as f64);
            if lightmap.has_error() {
                let of_seed = relative_square(&self.points.of_bake(lightmap, Layer::Error)?, &self.points.all);
                *estimated.get_or_insert(0.0) += of_seed / self.args.seeds as f64;
            }
        }
        self.rows.push(Row {
            series: series.to_owned(),
            value,
            seconds: median(seconds),
            indirect: errors(&indirect, &self.points.indirect),
            all: Some(errors(&all, &self.points.all)),
            direct: Some(errors(&direct, &self.points.direct())),
            ssim,
            estimated,
        });
        Ok(())
    }

    /// Paths from every texel.
    fn paths(&mut self, job: &Job, lightmap: &Lightmap) -> Result<()> {
        let scene = lightmap.scene();
        let receivers: Vec<Receiver> = (0..self.points.len())
            .map(|i| {
                let (triangle, front, u, v) = self.points.on[i];
                let point = SurfacePoint::new(scene.corners(triangle), u, v, scene);
                Receiver::new(scene, &point, Some(self.points.normals[i]), !front)
            })
            .collect();
        let paths = TexelPaths::new(scene);
        let all_texels = lightmap.info().texels as f64 / receivers.len() as f64;
        for rounds in PATH_ROUNDS {
            job.bars.say(&format!("{} paths per texel", rounds * PACKET_SIZE as u32));
            let start = Instant::now();
            let runs: Vec<Values> = (0..self.args.seeds)
                .map(|seed| paths.indirect(&receivers, rounds, seed as u32 + 1))
                .collect::<Result<_>>()?;
            self.rows.push(Row {
                series: "path tracing".into(),
                value: (rounds * PACKET_SIZE as u32).to_string(),
                seconds: start.elapsed().as_secs_f64() / self.args.seeds as f64 * all_texels,
                indirect: errors(&runs, &self.points.indirect),
                all: None,
                direct: None,
                ssim: None,
                estimated: None,
            });
        }
        Ok(())
    }

    /// The photon map's estimate at every texel.
    fn photons_alone(&mut self, job: &Job, lightmap: &Lightmap) -> Result<()> {
        let positions: Vec<[f32; 3]> = self.points.positions.iter().map(|p| p.to_array()).collect();
        let normals: Vec<[f32; 3]> = self.points.normals.iter().map(|n| n.to_array()).collect();
        let all_texels = lightmap.info().texels as f64 / positions.len() as f64;
        for photon_count in PHOTONS_ALONE {
            job.bars.say(&format!("{photon_count} photons alone"));
            let (mut runs, mut seconds) = (Vec::new(), Vec::new());
            for seed in 0..self.args.seeds {
                let params = PhotonParams { photon_count, seed, store_direct: false, ..Default::default() };
                let map = PhotonMap::trace(lightmap.scene(), &params, &Progress::none())?;
                let start = Instant::now();
                let mut out = vec![[0.0; 3]; positions.len()];
                map.estimate_many(&positions, &normals, &mut out, &Progress::none())?;
                let stats = map.stats();
                let estimates = start.elapsed().as_secs_f64() * all_texels;
                seconds.push(stats.trace_seconds + stats.grid_seconds + estimates);
                runs.push(out.iter().map(|e| e.map(f64::from)).collect());
            }
            self.rows.push(Row {
                series: "photons alone".into(),
                value: photon_count.to_string(),
                seconds: median(seconds),
                indirect: errors(&runs, &self.points.indirect),
                all: None,
                direct: None,
                ssim: None,
                estimated: None,
            });
        }
        Ok(())
    }
}

/// The rows of each series, in order.
fn series(rows: &[Row]) -> Vec<&[Row]> {
    rows.chunk_by(|a, b| a.series == b.series).collect()
}

/// Slope of error against time in log-log axes, by least squares; 0.5 is that of plain Monte Carlo.
fn slope(rows: &[Row]) -> Option<f64> {
    let points: Vec<[f64; 2]> = rows
        .iter()
        .filter(|r| r.seconds > 0.0 && r.indirect.mse > 0.0)
        .map(|r| [r.seconds.ln(), 0.5 * r.indirect.mse.ln()])
        .collect();
    let n = points.len() as f64;
    let [x, y] = [0, 1].map(|c| points.iter().map(|p| p[c]).sum::<f64>() / n);
    let xx: f64 = points.iter().map(|p| (p[0] - x).powi(2)).sum();
    let xy: f64 = points.iter().map(|p| (p[0] - x) * (p[1] - y)).sum();
    (points.len() > 1 && xx > 0.0).then(|| xy / xx)
}

/// Whether the error of the last setting but one falls to that of the last as noise does, by its slope.
fn still_noise(a: &Row, b: &Row) -> bool {
    let slope = 0.5 * (b.indirect.mse / a.indirect.mse).ln() / (b.seconds / a.seconds).ln();
    slope < -0.35
}

/// Time at which a series reaches a root mean square error: between two settings along the line in
/// log-log axes, beyond the last one along the slope of pure noise if the error still falls so.
fn time_to(rows: &[Row], goal: f64) -> String {
    let error = |r: &Row| r.indirect.mse.max(0.0).sqrt();
    let mut sorted: Vec<&Row> = rows.iter().collect();
    sorted.sort_by(|a, b| a.seconds.total_cmp(&b.seconds));
    let Some(at) = sorted.iter().position(|r| error(r) <= goal) else {
        let best = sorted.iter().map(|r| error(r)).fold(f64::INFINITY, f64::min);
        return match sorted[..] {
            [.., a, b] if still_noise(a, b) => format!("about {}", seconds(b.seconds * (error(b) / goal).powi(2))),
            _ => format!("not reached: {:.1} %", 100.0 * best),
        };
    };
    if at == 0 {
        return format!("< {}", seconds(sorted[0].seconds));
    }
    let (a, b) = (sorted[at - 1], sorted[at]);
    let part = (error(a) / goal).ln() / (error(a) / error(b)).ln();
    seconds(a.seconds * (b.seconds / a.seconds).powf(part))
}

fn seconds(s: f64) -> String {
    if s < 10.0 { format!("{s:.2} s") } else { format!("{s:.0} s") }
}

fn csv(rows: &[Row]) -> String {
    let mut out = String::from(
        "series,value,seconds,indirect_mse,variance,bias2,mean,uncertainty,indirect_mse_to_mean,all_mse,all_mse_to_mean,ssim,estimated\n",
    );
    for r in rows {
        let e = &r.indirect;
        let all = r.all.map_or(",".into(), |a| format!("{:.6e},{:.6e}", a.mse, a.to_mean));
        let ssim = r.ssim.map_or(String::new(), |s| format!("{s:.6}"));
        let estimated = r.estimated.map_or(String::new(), |e| format!("{e:.6e}"));
        let _ = writeln!(
            out,
            "{},{},{:.4},{:.6e},{:.6e},{:.6e},{:.6},{:.6e},{:.6e},{all},{ssim},{estimated}",
            r.series, r.value, r.seconds, e.mse, e.variance, e.bias2, e.mean, e.uncertainty, e.to_mean
        );
    }
    out
}

fn plot(rows: &[Row]) -> String {
    let shown = ["gather rays", "photons", "gather divisor", "radiance divisor", "path tracing", "photons alone"];
    let points = |rows: &[Row]| rows.iter().map(|r| [r.seconds, r.indirect.mse.max(0.0).sqrt()]).collect();
    let series = series(rows)
        .into_iter()
        .filter(|s| shown.contains(&s[0].series.as_str()))
        .map(|s| Series { name: &s[0].series, points: points(s) })
        .collect();
    let title = "Indirect light: error against run time";
    Plot {
        title,
        x_label: "seconds for all texels",
        y_label: "relative root mean square error of indirect light",
        series,
        marks: Vec::new(),
    }
    .svg()
}

fn markdown(
    args: &ReportArgs,
    lightmap: &Lightmap,
    [seen, points]: [&Points; 2],
    reference_seconds: f64,
    view: Option<&ViewReference>,
    rows: &[Row],
) -> String {
    let mut out = introduction(args, lightmap, [seen, points], reference_seconds);
    if let Some(view) = view {
        add_view(&mut out, view);
    }
    add_times(&mut out, rows);
    add_settings(&mut out, rows);
    out
}

/// Says which points are compared with which reference, and how to read the figures.
fn introduction(
    args: &ReportArgs,
    lightmap: &Lightmap,
    [seen, points]: [&Points; 2],
    reference_seconds: f64,
) -> String {
    let (scene, info, params) = (lightmap.scene(), lightmap.info(), &args.bake.params);
    let reference = match &args.reference {
        Some(file) => format!("those in {}", file.display()),
        None => format!("{} paths per point ({reference_seconds:.0} s)", args.paths),
    };
    format!(
        "# Quality: {}\n\n\
         {triangles} triangles; {texels} texels at {density:.2} per unit, {gather} gather and {radiance} radiance \
         texels; {photons} photons, {rays} gather rays, blur {blur} unless another value is named; threads: {threads}, \
         {isa}.\n\n\
         Errors are of irradiance at {count} points that are seen from places where somebody can stand, reached from the \
         camera and from lamps, as a shader reads it there, against {reference} of an \
         independent path tracer in f64. Relative MSE is the mean of the squared error by the square of the reference \
         (what is darker than a tenth of its mean counts as so bright), RMS its root; to mean, the mean of the squared \
         error by the square of the reference's mean. The reference's own noise is not part of them: they are products \
         of the differences from its two halves. {others} more points, {part:.1} % of all that were seen, lie on sides \
         that the light map does not show, and are left out. But worst is the relative MSE without the worst hundredth of \
         the points; Σ the sum of the light baked by that of the reference. Noise is what differs between {seeds} seeds, bias what \
         does not; MSE = noise² + bias². Estimated noise² is what a bake of several passes itself says of all light at these points. ± is one standard error of the MSE, from the points chosen. Seconds are those \
         of the bake, without charts; of path tracing and photons alone those at the points compared, scaled to \
         all.\n\n",
        args.bake.title(),
        triangles = scene.stats().triangles,
        texels = info.texels,
        density = info.texels_per_unit,
        gather = info.gather_texels,
        radiance = info.radiance_texels,
        photons = params.photon_count,
        rays = params.gather_rays,
        blur = params.blur_radius,
        threads = scene.device().num_threads(),
        isa = scene.device().isa().name(),
        count = points.len(),
        others = seen.len() - points.len(),
        part = 100.0 * (1.0 - points.len() as f64 / seen.len() as f64),
        seeds = args.seeds,
    )
}

/// Adds how the view was compared.
fn add_view(out: &mut String, view: &ViewReference) {
    let _ = write!(
        out,
        "SSIM (Wang 2004) compares the light map alone, as the camera shows it in {} × {} pixels, with the same view \
         path traced by the bake's kernels with {} paths per pixel ({:.0} s), both tone mapped alike. Two halves of \
         the reference, with half the paths each, have an SSIM of {}: an exact bake would have more than that, but \
         not 1.\n\n",
        view.size[0],
        view.size[1],
        view.paths,
        view.seconds,
        likeness(view.of_halves),
    );
}

/// Adds the seconds that each method takes to reach some errors.
fn add_times(out: &mut String, rows: &[Row]) {
    out.push_str("## Time to an error of indirect light\n\n| | 10 % | 5 % | 1 % | slope |\n|---|---|---|---|---|\n");
    for s in series(rows)
        .into_iter()
        .filter(|s| ["gather rays", "path tracing", "photons alone"].contains(&s[0].series.as_str()))
    {
        let [a, b, c] = GOALS.map(|g| time_to(s, g));
        let slope = slope(s).map_or("–".into(), |s| format!("{s:.2}"));
        let name = if s[0].series == "gather rays" { "this bake, by gather rays" } else { &s[0].series };
        let _ = writeln!(out, "| {name} | {a} | {b} | {c} | {slope} |");
    }
}

/// Adds the curves, and a row for each setting.
fn add_settings(out: &mut String, rows: &[Row]) {
    out.push_str(
        "\n![error against time](quality.svg)\n\n## All settings\n\n\
         | | | seconds | RMS | relative MSE | ± | but worst | noise² | bias² | Σ | to mean | direct light: MSE | but worst | Σ | all light: MSE | but worst | Σ | SSIM | estimated noise² |\n\
         |---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|\n",
    );
    for r in rows {
        let e = &r.indirect;
        let [direct, all] = [r.direct, r.all].map(|e| {
            e.map_or("– | – | –".into(), |e| format!("{:.1e} | {:.1e} | {:.3}", e.mse, e.trimmed, 1.0 + e.mean))
        });
        let _ = writeln!(
            out,
            "| {} | {} | {:.2} | {:.2} % | {:.1e} | {:.0e} | {:.1e} | {:.1e} | {:.1e} | {:.3} | {:.1e} | {direct} | {all} | {} | {} |",
            r.series,
            r.value,
            r.seconds,
            100.0 * e.mse.max(0.0).sqrt(),
            e.mse,
            e.uncertainty,
            e.trimmed,
            e.variance,
            e.bias2,
            1.0 + e.mean,
            e.to_mean,
            likeness(r.ssim),
            r.estimated.map_or("–".into(), |e| format!("{e:.1e}")),
        );
    }
}

/// A similarity for people.
fn likeness(ssim: Option<f64>) -> String {
    ssim.map_or("–".into(), |s| format!("{s:.4}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(seconds: f64, mse: f64, bias2: f64) -> Row {
        let indirect = Errors { mse, bias2, variance: mse - bias2, ..Default::default() };
        Row {
            series: "s".into(),
            value: String::new(),
            seconds,
            indirect,
            all: None,
            direct: None,
            ssim: None,
            estimated: None,
        }
    }

    #[test]
    fn times_are_found_between_settings_and_beyond_unbiased_ones() {
        let rows = [row(1.0, 0.04, 0.0), row(4.0, 0.01, 0.0), row(16.0, 0.0025, 0.0)];
        assert_eq!(time_to(&rows, 0.1), "4.00 s");
        assert_eq!(time_to(&rows, 0.05), "16 s");
        assert_eq!(time_to(&rows, 0.01), "about 400 s");
        assert_eq!(time_to(&rows, 0.3), "< 1.00 s");
        assert!((slope(&rows).unwrap() + 0.5).abs() < 1e-9);
        let biased = [row(1.0, 0.04, 0.03), row(4.0, 0.0325, 0.03)];
        assert_eq!(time_to(&biased, 0.05), "not reached: 18.0 %");
    }
}
