//! `bakelite report live`: measures live updates of a scene and writes tables, plots and figures.

mod measure;

use crate::args::{BakeArgs, ReportArgs};
use crate::files;
use crate::job::Job;
use crate::pictures::percent;
use crate::plot::curves::{Plot, Series};
use crate::stages::Stage;
use bakelite::lightmap::{BakeParams, Lightmap};
use bakelite::live::LiveParams;
use bakelite::scene::Camera;
use bakelite::{Error, Light, Result};
use measure::{CHANGE_INTERVAL, Curve, FOLLOW_MS, Frame, MODES, ModeRun, Point, Seen, Walk, Watch};
use measure::{bake, live_camera, moved_light, ray_count, walk};
use std::fmt::Write;

/// Gather rays of the bakes that updates are compared with.
const BAKE_RAYS: [u32; 5] = [64, 128, 256, 512, 1024];

/// Gather rays of the references.
const REFERENCE_RAYS: u32 = 4096;

/// Rounds on walks, so many that work remains.
const WALK_ROUNDS: u32 = 1024;

const THREADS: [usize; 2] = [1, 2];

/// Errors that people ask for.
const GOALS: [f64; 2] = [0.1, 0.01];

/// Of a texel that is uploaded as RGBA of half floats.
const TEXEL_BYTES: u64 = 8;

/// The errors under one light.
struct Phase {
    /// In file names and in `live-errors.csv`.
    name: &'static str,
    title: String,
    curves: Vec<Curve>,
}

/// All that is measured.
#[derive(Default)]
struct Measured {
    phases: Vec<Phase>,
    runs: Vec<ModeRun>,
    walks: Vec<Walk>,
    /// What loading and laying out took.
    stages: Vec<Stage>,
    /// What was done to light 0.
    change: Option<String>,
    seen: usize,
}

/// Runs the report.
pub fn run(args: &ReportArgs) -> Result<()> {
    files::make_folder(&args.bake.out)?;
    let mut job = Job::new(&args.bake);
    let mut lightmap = job.unbaked()?;
    let (mut measured, camera) =
        if args.errors { errors(&job, args, &mut lightmap)? } else { (Measured::default(), job.camera(&lightmap)) };
    if args.updates > 0 {
        measured.walks = walks(&job, args, &lightmap, &camera)?;
    }
    measured.stages = std::mem::take(&mut job.stages);
    let mut names = Vec::new();
    let mut save = |name: String, text: &str| {
        let path = args.bake.out.join(&name);
        names.push(name);
        files::write_text(&path, text)
    };
    save("live.md".into(), &markdown(args, &lightmap, &camera, &measured))?;
    if args.errors {
        save("live-errors.csv".into(), &errors_csv(&measured.phases))?;
    }
    if args.updates > 0 {
        save("live-updates.csv".into(), &updates_csv(&measured.walks))?;
    }
    for phase in &measured.phases {
        for axis in [TIME, RAYS] {
            save(plot_name(phase, &axis), &plot(phase, &axis))?;
        }
    }
    if !args.bake.quiet {
        println!("Wrote to {}: {}", args.bake.out.display(), names.join(", "));
    }
    Ok(())
}

fn aspect(args: &BakeArgs) -> f32 {
    args.width as f32 / args.height as f32
}

/// Follows the error of visible texels, from nothing and after light 0 has moved.
fn errors(job: &Job, args: &ReportArgs, lightmap: &mut Lightmap) -> Result<(Measured, Camera)> {
    // Live light is not stitched.
    let params = BakeParams { stitch: false, ..args.bake.params };
    let reference_params = BakeParams { gather_rays: REFERENCE_RAYS, ..params };
    job.bars.show("reference", |p| lightmap.bake(&reference_params, p))?;
    let camera = job.camera(lightmap);
    let seen = Seen::new(lightmap, &camera, aspect(&args.bake))?;
    let reference = seen.of_bake(lightmap)?;
    if reference.iter().flatten().all(|&c| c == 0.0) {
        return Err(Error::InvalidArgument("the camera sees nothing that is lit; give another with --camera".into()));
    }
    let bakes = |lightmap: &mut Lightmap, reference: &[[f32; 3]]| -> Result<Curve> {
        let one = |gather_rays| bake(lightmap, &BakeParams { gather_rays, ..params }, &seen, reference);
        Ok(Curve { name: "bakes", points: BAKE_RAYS.into_iter().map(one).collect::<Result<_>>()? })
    };
    job.bars.say("bakes to compare with");
    let mut phases =
        vec![Phase { name: "start", title: "From nothing".into(), curves: vec![bakes(lightmap, &reference)?] }];

    let (moved, change) = moved_light(lightmap.scene(), args.bake.up).unzip();
    let mut moved_reference: Option<(Light, Vec<[f32; 3]>)> = None;
    if let Some(moved) = moved {
        let original = lightmap.scene().lights()[0];
        lightmap.scene().set_light(0, moved)?;
        job.bars.show("reference", |p| lightmap.bake(&reference_params, p))?;
        let reference = seen.of_bake(lightmap)?;
        job.bars.say("bakes to compare with");
        let curves = vec![bakes(lightmap, &reference)?];
        lightmap.scene().set_light(0, original)?;
        phases.push(Phase { name: "moved", title: "After a light has moved".into(), curves });
        moved_reference = Some((moved, reference));
    }

    let watch = Watch { seen: &seen, camera: live_camera(&camera, aspect(&args.bake)), seconds: args.seconds };
    let mut runs = Vec::new();
    for (mode, name) in MODES {
        job.bars.say(&format!("{name} updates"));
        let params = LiveParams { mode, ..args.live };
        let after = moved_reference.as_ref().map(|(light, reference)| (*light, &reference[..]));
        let mut run = watch.run(lightmap, &params, &reference, after)?;
        phases[0].curves.push(Curve { name, points: std::mem::take(&mut run.from_nothing) });
        if let Some(points) = run.after_move.take() {
            phases[1].curves.push(Curve { name, points });
        }
        runs.push(run);
    }
    Ok((Measured { phases, runs, change, seen: seen.count(), ..Default::default() }, camera))
}

/// Walks with all budgets, in fresh states, on one thread and on two, or on as many as were asked for.
fn walks(job: &Job, args: &ReportArgs, lightmap: &Lightmap, camera: &Camera) -> Result<Vec<Walk>> {
    let mut walks = Vec::new();
    let given = [args.bake.threads];
    for &threads in if given == [0] { &THREADS[..] } else { &given[..] } {
        // Threads belong to the device, and so does the scene.
        let again = BakeArgs { threads, quiet: true, ..args.bake.clone() };
        let other = if given == [0] { Some(Job::new(&again).unbaked()?) } else { None };
        let lightmap = other.as_ref().unwrap_or(lightmap);
        let params = LiveParams { max_rounds: WALK_ROUNDS, ..args.live };
        for (&budget, &kb) in args.budgets_ms.iter().flat_map(|b| args.dirty_kb.iter().map(move |kb| (b, kb))) {
            job.bars.say(&format!("{} updates of {budget} ms and {kb} KB, threads: {threads}", args.updates));
            let camera = live_camera(camera, aspect(&args.bake));
            walks.push(walk(lightmap, &params, &camera, (budget, kb), args.updates, args.frame_ms)?);
        }
    }
    Ok(walks)
}

/// What errors are plotted against.
struct Horizontal {
    name: &'static str,
    label: &'static str,
    value: fn(&Point) -> f64,
}

const TIME: Horizontal = Horizontal { name: "time", label: "seconds", value: |p| p.seconds };
const RAYS: Horizontal =
    Horizontal { name: "rays", label: "gather, shadow and primary rays", value: |p| p.rays as f64 };

fn plot_name(phase: &Phase, axis: &Horizontal) -> String {
    format!("live-{}-{}.svg", phase.name, axis.name)
}

fn plot(phase: &Phase, axis: &Horizontal) -> String {
    let points = |c: &Curve| c.points.iter().map(|p| [(axis.value)(p), p.error]).collect();
    let series = phase.curves.iter().map(|c| Series { name: c.name, points: points(c) }).collect();
    let y_label = "relative error of visible texels";
    Plot { title: &phase.title, x_label: axis.label, y_label, series, marks: Vec::new() }.svg()
}

fn errors_csv(phases: &[Phase]) -> String {
    let mut out = String::from("phase,series,seconds,rays,error\n");
    for phase in phases {
        for curve in &phase.curves {
            for p in &curve.points {
                let (phase, curve) = (phase.name, curve.name);
                let _ = writeln!(out, "{phase},{curve},{:.6},{},{:.6}", p.seconds, p.rays, p.error);
            }
        }
    }
    out
}

fn updates_csv(walks: &[Walk]) -> String {
    let mut out = String::from(
        "threads,budget_ms,limit_kb,update,used_ms,relighting,work_left,dirty_rects,dirty_bytes,read_ms\n",
    );
    for walk in walks {
        for (i, f) in walk.frames.iter().enumerate() {
            let (threads, budget, bytes) = (walk.threads, walk.budget_ms, f.texels * TEXEL_BYTES);
            let (relighting, work) = (f.relighting as u8, f.has_work as u8);
            let (used, rects, read, kb) = (f.used_ms, f.rects, f.read_ms, walk.dirty_kb);
            let _ =
                writeln!(out, "{threads},{budget},{kb},{i},{used:.4},{relighting},{work},{rects},{bytes},{read:.4}");
        }
    }
    out
}

/// Median, 99th percentile and maximum (nearest rank), as cells of a table.
fn spread(values: impl Iterator<Item = f64>, digits: usize) -> String {
    let mut sorted: Vec<f64> = values.collect();
    sorted.sort_unstable_by(f64::total_cmp);
    let Some(&max) = sorted.last() else { return "– | – | –".into() };
    let rank = |part: f64| sorted[((part * sorted.len() as f64).ceil() as usize).max(1) - 1];
    format!("{:.digits$} | {:.digits$} | {max:.digits$}", rank(0.5), rank(0.99))
}

fn markdown(args: &ReportArgs, lightmap: &Lightmap, camera: &Camera, measured: &Measured) -> String {
    let mut out = introduction(args, lightmap, camera, measured);
    first_light(&mut out, measured);
    for phase in &measured.phases {
        let _ = writeln!(out, "## {}\n", phase.title);
        if let (true, Some(change)) = (phase.name == "moved", &measured.change) {
            let _ = writeln!(
                out,
                "Light 0 {change}. Time and rays count from `light_changed`; bakes are those of the whole light map \
                 under the new light. While indirect light is being recomputed in the background, measuring errors \
                 counts as time.\n"
            );
        }
        errors_table(&mut out, phase);
    }
    if args.errors && measured.change.is_none() {
        out.push_str("## After a light has moved\n\nNot measured: the scene has no lights but emissive materials.\n\n");
    }
    if !measured.walks.is_empty() {
        walk_tables(&mut out, args, &measured.walks);
    }
    if args.errors {
        memory_table(&mut out, &measured.runs);
    }
    out
}

fn introduction(args: &ReportArgs, lightmap: &Lightmap, camera: &Camera, measured: &Measured) -> String {
    let (scene, info, params) = (lightmap.scene(), lightmap.info(), &args.bake.params);
    let device = scene.device();
    let (position, target) = (camera.position, camera.target);
    let cells = match args.live.cell_size {
        0.0 => "cells of the automatic size".into(),
        size => format!("cells of {size}"),
    };
    let errors = match args.errors {
        true => format!(
            "Errors are those of irradiance as shown, direct and indirect: the root of the sum of squared differences \
             over the sum of the reference's squares, at the texels that {seen} of {rays} primary rays hit. The \
             reference is a bake with {REFERENCE_RAYS} gather rays and otherwise the same parameters, blur and photons \
             included: what is left is the noise of gathering. As its first rays are those of the others, errors are \
             slightly too small, by about an eighth with {last} rays. Rays are those for gathering, for direct light \
             and, in live updates, for what the camera sees; those of photons and radiance map are left out. The time \
             of live updates includes that of creating the live state but not that of measuring errors. They end when \
             all that is seen is finished, or after {seconds} s.\n\n",
            seen = measured.seen,
            rays = ray_count(aspect(&args.bake)),
            last = args.live.max_rounds * 64,
            seconds = args.seconds,
        ),
        false => String::new(),
    };
    format!(
        "# Live updates: {}\n\n\
         {triangles} triangles, {texels} texels ({gather} of them gather) on {pages} pages of {width} × {height}; \
         {lights} lights, {emitters} emissive triangles; {photons} photons, {samples} shadow rays per area light, \
         blur {blur}, seed {seed}; threads: {threads}, {isa}. Camera at {position}, looking at {target}.\n\n\
         Live updates are of {FOLLOW_MS} ms, with at most {rounds} rounds of 64 rays per texel, {lods} levels of detail, \
         cells that show the next after {promote} rounds, and {cells}.\n\n{errors}",
        args.bake.title(),
        triangles = scene.stats().triangles,
        texels = info.texels,
        gather = info.gather_texels,
        pages = info.page_count,
        width = info.width,
        height = info.height,
        lights = scene.lights().len(),
        emitters = scene.emitters().len(),
        photons = params.photon_count,
        samples = params.direct_samples,
        blur = params.blur_radius,
        seed = params.seed,
        threads = device.num_threads(),
        isa = device.isa().name(),
        rounds = args.live.max_rounds,
        lods = args.live.lod_count,
        promote = args.live.promote_threshold,
    )
}

/// What it takes until the first light is shown.
fn first_light(out: &mut String, measured: &Measured) {
    out.push_str("## First light\n\n| | s |\n|---|---|\n");
    let mut total = 0.0;
    let mut row = |name: &str, seconds: f64| {
        total += seconds;
        let _ = writeln!(out, "| {name} | {seconds:.3} |");
    };
    measured.stages.iter().for_each(|s| row(s.name, s.seconds));
    if let Some(walk) = measured.walks.first() {
        walk.create.iter().for_each(|(name, seconds)| row(name, *seconds));
        if let Some(frame) = walk.frames.first() {
            row("first update and reading", 1e-3 * (frame.used_ms + frame.read_ms));
        }
    }
    let _ = writeln!(out, "| all | {total:.3} |\n");
}

fn errors_table(out: &mut String, phase: &Phase) {
    let goals = GOALS.map(|g| format!("to {:.0}%", 100.0 * g));
    let _ = writeln!(out, "| | {} | {} | first error | last error |", goals[0], goals[1]);
    out.push_str("|---|---|---|---|---|\n");
    let work = |p: &Point| format!("{:.3} s, {:.2} Mrays", p.seconds, p.rays as f64 * 1e-6);
    for curve in &phase.curves {
        let cells = GOALS.map(|goal| match curve.first_within(goal) {
            Some(p) => work(p),
            None => format!("not reached: best {}", percent(curve.best())),
        });
        let end = |p: Option<&Point>| p.map_or("–".into(), |p| format!("{} at {}", percent(p.error), work(p)));
        let (first, last) = (end(curve.points.first()), end(curve.points.last()));
        let _ = writeln!(out, "| {} | {} | {} | {first} | {last} |", curve.name, cells[0], cells[1]);
    }
    for axis in [TIME, RAYS] {
        let _ = write!(out, "\n![error against {}]({})\n", axis.name, plot_name(phase, &axis));
    }
    out.push('\n');
}

fn walk_tables(out: &mut String, args: &ReportArgs, walks: &[Walk]) {
    let change = walks.iter().map(|w| w.change_ms).fold(0.0, f64::max);
    let _ = writeln!(
        out,
        "## Keeping to the budget\n\n\
         {} view-based updates per budget, with a camera that walks a small circle and looks to and fro. {} Overshoot \
         is the wall time of a call less its budget, in ms; *in need* are the updates that took longer than their \
         budget while something seen was left to do; *calm* are those without indirect light being recomputed beside \
         them, on one more thread.\n",
        args.updates,
        if change > 0.0 {
            format!("Every {CHANGE_INTERVAL} updates a light is said to have changed, which took up to {change:.2} ms.")
        } else {
            "No light changes.".into()
        },
    );
    out.push_str(
        "| threads | budget | limit | p50 | p99 | max | in need | p50 | p99 | max | calm | p50 | p99 | max |\n",
    );
    out.push_str("|---|---|---|---|---|---|---|---|---|---|---|---|---|---|\n");
    for walk in walks {
        let over = |f: &Frame| f.used_ms - walk.budget_ms as f64;
        let cells = |of: &dyn Fn(&&Frame) -> bool| {
            let chosen: Vec<&Frame> = walk.frames.iter().filter(of).collect();
            let part = chosen.len() as f64 / walk.frames.len() as f64;
            format!("{} | {}", percent(part), spread(chosen.into_iter().map(over), 3))
        };
        let all = spread(walk.frames.iter().map(over), 3);
        let (need, calm) = (cells(&|f| f.has_work && over(f) > 0.0), cells(&|f| !f.relighting));
        let _ = writeln!(out, "| {} | {all} | {need} | {calm} |", title_of(walk));
    }
    let _ = writeln!(
        out,
        "\n## Frames\n\nUpdate and reading of what it gives out, in ms: in the first frame, in the slowest of the frames in which \
         a light has changed (with `light_changed`), in all; and their overshoot of the budget.\n"
    );
    out.push_str("| threads | budget | limit | first | change | p50 | p99 | max | overshoot p50 | p99 | max |\n");
    out.push_str("|---|---|---|---|---|---|---|---|---|---|---|\n");
    for walk in walks {
        let whole = |f: &Frame| f.used_ms + f.read_ms;
        let first = walk.frames.first().map_or(0.0, whole);
        let changed = walk.frames.iter().skip(1).filter(|f| f.is_new).map(whole).fold(0.0, f64::max) + walk.change_ms;
        let all = spread(walk.frames.iter().map(whole), 2);
        let over = spread(walk.frames.iter().map(|f| whole(f) - walk.budget_ms as f64), 2);
        let _ = writeln!(out, "| {} | {first:.2} | {changed:.2} | {all} | {over} |", title_of(walk));
    }
    let _ = writeln!(
        out,
        "\n## What changes per update\n\n\
         Dirty rectangles after each of these updates, the bytes of their texels as RGBA of half floats, and the time \
         that `read` takes for all of them.\n"
    );
    out.push_str(
        "| threads | budget | limit | rectangles p50 | p99 | max | KB p50 | p99 | max | read ms p50 | p99 | max |\n",
    );
    out.push_str("|---|---|---|---|---|---|---|---|---|---|---|---|\n");
    for walk in walks {
        let frames = || walk.frames.iter();
        let rects = spread(frames().map(|f| f.rects as f64), 0);
        let bytes = spread(frames().map(|f| (f.texels * TEXEL_BYTES) as f64 * 1e-3), 1);
        let read = spread(frames().map(|f| f.read_ms), 3);
        let _ = writeln!(out, "| {} | {rects} | {bytes} | {read} |", title_of(walk));
    }
    out.push('\n');
}

/// Threads, budget and limit of a walk, as cells of a table.
fn title_of(walk: &Walk) -> String {
    let limit = if walk.dirty_kb == 0 { "none".into() } else { format!("{} KB", walk.dirty_kb) };
    format!("{} | {} ms | {limit}", walk.threads, walk.budget_ms)
}

fn memory_table(out: &mut String, runs: &[ModeRun]) {
    out.push_str(
        "## Memory\n\nOf the live state, in MB: when it has been created, after the updates above, and with all LODs \
         allocated everywhere.\n\n| | at first | in the end | all |\n|---|---|---|---|\n",
    );
    let mb = |bytes: u64| bytes as f64 * 1e-6;
    for ((_, name), run) in MODES.iter().zip(runs) {
        let [first, last] = &run.stats;
        let _ =
            writeln!(out, "| {name} | {:.2} | {:.2} | {:.2} |", mb(first.bytes), mb(last.bytes), mb(last.bytes_full));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_by_nearest_rank() {
        assert_eq!(spread((1..=100).rev().map(f64::from), 0), "50 | 99 | 100");
        assert_eq!(spread([2.5].into_iter(), 1), "2.5 | 2.5 | 2.5");
        assert_eq!(spread([].into_iter(), 1), "– | – | –");
    }

    #[test]
    fn a_goal_is_reached_at_the_first_point_within_it() {
        let point = |seconds, error| Point { seconds, rays: 1_500_000, error };
        let points = vec![point(0.5, 0.2), point(1.0, 0.1), point(2.0, 0.05)];
        let phase = Phase { name: "start", title: String::new(), curves: vec![Curve { name: "a", points }] };
        let mut out = String::new();
        errors_table(&mut out, &phase);
        assert!(out.contains("| a | 1.000 s, 1.50 Mrays | not reached: best 5.00% | 20.00% at 0.500 s"), "{out}");
    }
}
