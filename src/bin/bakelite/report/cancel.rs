//! `bakelite report cancel`: how long each long call is silent, stage by stage, and how soon it ends when it is
//! cancelled at random times.

use crate::args::BakeArgs;
use crate::job::Job;
use bakelite::lightmap::Lightmap;
use bakelite::live::{Live, LiveParams};
use bakelite::photon::{PhotonMap, PhotonParams};
use bakelite::sampling::uniform;
use bakelite::{Error, Progress, Result, Scene};
use std::collections::BTreeMap;
use std::time::{Duration, Instant};

/// Cancels per call, unless they take longer than [`SECONDS`].
const CANCELS: u32 = 40;

/// They go through the call's time in steps of so many of its parts: some fall into each part of it, even if only the
/// first few are made.
const STEP: u32 = 17;

/// Seconds of cancels per call, after which no further one is begun.
const SECONDS: f64 = 60.0;

/// What is known of one stage of a call.
#[derive(Default)]
struct StageTimes {
    /// Order of appearance.
    number: usize,
    seconds: f64,
    longest_silence: f64,
    /// Seconds from the wish to cancel to the end of the call.
    latencies: Vec<f64>,
}

/// Prints the report as a table in Markdown.
pub fn run(args: &BakeArgs) -> Result<()> {
    let mut job = Job::new(args);
    let data = job.load()?;
    let device = job.device()?;
    println!(
        "| call | stage | seconds | longest silence ms | most reports in a second | cancels | p50 ms | p99 ms | max ms |"
    );
    println!("|---|---|---|---|---|---|---|---|---|");

    // Copied before the call is timed; what is cancelled gives it back.
    let mut descriptions = vec![data.clone()];
    measure("commit", |progress| {
        let data = descriptions.pop().unwrap_or_else(|| data.clone());
        Scene::commit(&device, data, &args.build, progress).map(drop).map_err(|(data, e)| {
            descriptions.push(data);
            e
        })
    })?;
    let scene = job.commit_on(&device, data, &args.build)?;
    let photons = PhotonParams { photon_count: args.params.photon_count, ..Default::default() };
    measure("photon map", |progress| PhotonMap::trace(&scene, &photons, progress).map(drop))?;
    measure("light map", |progress| Lightmap::create(&scene, &args.desc, progress).map(drop))?;
    let mut lightmap = Lightmap::create(&scene, &args.desc, &Progress::none())?;
    measure("bake", |progress| lightmap.bake(&args.params, progress).map(drop))?;
    let prefix = args.out.join("page").to_string_lossy().into_owned();
    crate::files::make_folder(&args.out)?;
    measure("pages", |progress| bakelite::io::lightmaps::write_exr_pages(&lightmap, &prefix, progress).map(drop))?;
    let params = LiveParams::default();
    measure("live", |progress| Live::new(&lightmap, &params, progress).map(drop))?;
    let mut live = Live::new(&lightmap, &params, &Progress::none())?;
    let state = args.out.join("live");
    measure("live save", |progress| live.save(&state, progress))?;
    live.save(&state, &Progress::none())?;
    measure("live restore", |progress| live.restore(&state, progress))?;
    std::fs::remove_file(&state).map_err(|e| Error::Io(format!("cannot remove {}: {e}", state.display())))
}

/// Measures a call, first undisturbed, then cancelled.
fn measure(name: &str, mut call: impl FnMut(&Progress) -> Result<()>) -> Result<()> {
    let mut stages: BTreeMap<String, StageTimes> = BTreeMap::new();
    let mut reports: Vec<(Duration, String)> = Vec::new();
    let start = Instant::now();
    call(&Progress::new(|_, stage| {
        reports.push((start.elapsed(), stage.to_owned()));
        true
    }))?;
    let total = start.elapsed();
    let begins = std::iter::once(Duration::ZERO).chain(reports.iter().map(|r| r.0));
    let ends = reports.iter().map(|r| r.0).chain([total]);
    let first = reports.first().map_or("", |r| &r.1);
    let during = std::iter::once(first).chain(reports.iter().map(|r| r.1.as_str()));
    for ((begin, end), stage) in begins.zip(ends).zip(during) {
        let number = stages.len();
        let times = stages.entry(stage.to_owned()).or_insert(StageTimes { number, ..Default::default() });
        let silence = (end - begin).as_secs_f64();
        times.seconds += silence;
        times.longest_silence = times.longest_silence.max(silence);
    }
    let after = |i: usize| reports[i..].iter().take_while(|r| r.0 < reports[i].0 + Duration::from_secs(1)).count();
    let busiest = (0..reports.len()).map(after).max().unwrap_or(0);
    cancel_at_random(total, &mut stages, &mut call)?;
    print_table(name, busiest, stages);
    Ok(())
}

/// Calls again and again and wishes to cancel at random times of the `total` time that it takes.
fn cancel_at_random(
    total: Duration,
    stages: &mut BTreeMap<String, StageTimes>,
    call: &mut impl FnMut(&Progress) -> Result<()>,
) -> Result<()> {
    let begin = Instant::now();
    for i in 0..CANCELS {
        if begin.elapsed().as_secs_f64() > SECONDS {
            break;
        }
        let part = i * STEP % CANCELS;
        let wish = total.mul_f32((part as f32 + uniform(i, 0, 0)) / CANCELS as f32);
        let mut cancelled_in = String::new();
        let start = Instant::now();
        let result = call(&Progress::new(|_, stage| {
            if start.elapsed() < wish {
                return true;
            }
            cancelled_in = stage.to_owned();
            false
        }));
        let latency = start.elapsed().saturating_sub(wish).as_secs_f64();
        match result {
            // It may have been faster than before.
            Ok(()) => {}
            Err(Error::Cancelled) => {
                let number = stages.len();
                let stage = stages.entry(cancelled_in).or_insert(StageTimes { number, ..Default::default() });
                stage.latencies.push(latency);
            }
            Err(e) => return Err(e),
        }
    }
    Ok(())
}

fn print_table(name: &str, busiest: usize, stages: BTreeMap<String, StageTimes>) {
    let mut stages: Vec<(String, StageTimes)> = stages.into_iter().collect();
    stages.sort_by_key(|(_, s)| s.number);
    for (stage, mut s) in stages {
        s.latencies.sort_by(f64::total_cmp);
        let n = s.latencies.len();
        let at = |part: f64| match s.latencies.get(((n as f64 * part) as usize).min(n.saturating_sub(1))) {
            Some(seconds) => format!("{:.0}", seconds * 1e3),
            None => "".to_owned(),
        };
        let (seconds, silence) = (s.seconds, s.longest_silence * 1e3);
        let [p50, p99, max] = [0.5, 0.99, 1.0].map(at);
        println!("| {name} | {stage} | {seconds:.2} | {silence:.0} | {busiest} | {n} | {p50} | {p99} | {max} |");
    }
}
