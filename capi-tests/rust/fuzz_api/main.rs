//! Random sequences of calls of the whole C header: hostile numbers, callbacks that refuse, cancel and call back,
//! releases in any order, several threads.
//!
//!     cargo test --release --all-features --test fuzz_api                     (a few seconds, fixed seeds)
//!     cargo test --release --all-features --test fuzz_api -- --seconds 3600 --jobs 2 --seed 1000
//!     cargo test --release --all-features --test fuzz_api -- --seed 1234 --sequences 1 --trace
//!
//! The first run is what continuous integration does; the second looks for what no run has met yet; the third
//! repeats a sequence that failed and prints its calls. Sequences run in a process of their own, so that one
//! that ends it is reported, with its seed, and the next goes on.
//!
//! What must hold: nothing crashes, hangs or panics; results are those that are listed, and come with an error
//! text; a failed create hands out NULL; light is finite and not negative; objects still work after failures;
//! no callback comes after the last release, or after its call; the memory accounts end at 0.

mod calls;
mod source;
mod world;

use source::Source;
use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Write};
use std::process::{Command, ExitCode, Stdio};
use std::sync::atomic::Ordering::SeqCst;
use std::time::{Duration, Instant};
use world::World;

/// A call that takes longer hangs.
const HANGS: Duration = Duration::from_secs(120);

struct Options {
    seed: u64,
    sequences: u64,
    seconds: f64,
    jobs: u64,
    trace: bool,
    worker: bool,
}

fn options() -> Options {
    let mut o = Options { seed: 1, sequences: u64::MAX, seconds: f64::INFINITY, jobs: 1, trace: false, worker: false };
    let mut args = std::env::args().skip(1);
    while let Some(arg) = args.next() {
        let mut value = || args.next().and_then(|v| v.parse::<f64>().ok()).expect("a number");
        match arg.as_str() {
            "--seed" => o.seed = value() as u64,
            "--sequences" => o.sequences = value() as u64,
            "--seconds" => o.seconds = value(),
            "--jobs" => o.jobs = value() as u64,
            "--trace" => o.trace = true,
            "--worker" => o.worker = true,
            // What cargo hands to every test program.
            _ => {}
        }
    }
    if o.sequences == u64::MAX && o.seconds.is_infinite() {
        o.sequences = 150;
    }
    o
}

fn main() -> ExitCode {
    let options = options();
    if options.worker {
        work(&options);
        return ExitCode::SUCCESS;
    }
    let missing = functions_without_calls();
    let runs: Vec<_> = std::thread::scope(|scope| {
        let options = &options;
        let threads: Vec<_> = (0..options.jobs).map(|job| scope.spawn(move || supervise(options, job))).collect();
        threads.into_iter().map(|t| t.join().expect("a supervisor does not panic")).collect()
    });
    let mut counts: BTreeMap<String, [u64; 2]> = BTreeMap::new();
    for (name, [calls, errors]) in runs.iter().flat_map(|r| &r.counts) {
        let sum = counts.entry(name.clone()).or_default();
        *sum = [sum[0] + calls, sum[1] + errors];
    }
    if options.seconds.is_finite() {
        counts.iter().for_each(|(name, [calls, errors])| println!("{calls:>12} {errors:>12} errors  {name}"));
    }
    let calls: u64 = counts.values().map(|c| c[0]).sum();
    let sequences: u64 = runs.iter().map(|r| r.sequences).sum();
    let failures: Vec<&String> = runs.iter().flat_map(|r| &r.failures).collect();
    println!("{sequences} sequences, {calls} calls of {} functions, {} failures", counts.len(), failures.len());
    failures.iter().for_each(|f| println!("{f}"));
    missing.iter().for_each(|f| println!("include/bakelite.h has {f}, which no sequence calls"));
    let failed = failures.len() + missing.len();
    println!(
        "test result: {}. {} passed; {failed} failed",
        if failed == 0 { "ok" } else { "FAILED" },
        (failed == 0) as u32
    );
    if failed == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// Functions of the header that the sequences never call.
fn functions_without_calls() -> Vec<&'static str> {
    let calls = concat!(include_str!("calls.rs"), include_str!("world.rs"));
    let declared = include_str!("../../../include/bakelite.h").lines().filter(|l| !l.trim_start().starts_with("//"));
    let names = declared.flat_map(|line| line.match_indices('(').map(|(at, _)| &line[..at])).filter_map(|before| {
        let start = before.rfind(|c: char| !c.is_ascii_alphanumeric() && c != '_').map_or(0, |i| i + 1);
        before[start..].starts_with("bk_").then_some(&before[start..])
    });
    names.filter(|name| !calls.contains(&format!("{name}(")) && !calls.contains(&format!("{name})"))).collect()
}

#[derive(Default)]
struct Run {
    sequences: u64,
    counts: BTreeMap<String, [u64; 2]>,
    failures: Vec<String>,
}

/// Runs sequences in a process of its own, and another one when it ends before its time.
fn supervise(options: &Options, job: u64) -> Run {
    let mut run = Run::default();
    let started = Instant::now();
    let mut seed = options.seed + job;
    let end = options.seed.saturating_add(options.sequences);
    while seed < end && started.elapsed().as_secs_f64() < options.seconds && run.failures.len() < 20 {
        let left = options.seconds - started.elapsed().as_secs_f64();
        let mut child = Command::new(std::env::current_exe().expect("this program has a path"))
            .args(["--worker", "--seed", &seed.to_string(), "--jobs", &options.jobs.to_string()])
            .args(["--sequences", &(end - seed).to_string(), "--seconds", &left.to_string()])
            .args(options.trace.then_some("--trace"))
            .stdout(Stdio::piped())
            .spawn()
            .expect("this program can be started again");
        let lines = BufReader::new(child.stdout.take().expect("piped")).lines();
        let mut begun = seed;
        for line in lines.map_while(|l| l.ok()) {
            let words: Vec<&str> = line.split(' ').collect();
            match words[..] {
                ["begin", s] => begun = s.parse().unwrap_or(begun),
                ["end"] => run.sequences += 1,
                ["calls", name, calls, errors] => {
                    let count = run.counts.entry(name.into()).or_default();
                    count[0] += calls.parse::<u64>().unwrap_or(0);
                    count[1] += errors.parse::<u64>().unwrap_or(0);
                }
                _ => println!("{line}"),
            }
        }
        let status = child.wait().expect("the process can be waited for");
        if !status.success() {
            run.failures.push(format!("seed {begun}: {status}; again with --seed {begun} --sequences 1 --trace"));
        } else {
            break;
        }
        seed = begun + options.jobs;
    }
    run
}

/// Runs the sequences of the process, and says which on its output.
fn work(options: &Options) {
    world::TRACE.store(options.trace, SeqCst);
    std::thread::spawn(watch);
    let folder = std::env::temp_dir().join(format!("bakelite-fuzz-{}", std::process::id()));
    std::fs::create_dir_all(&folder).expect("there is a temporary folder");
    let started = Instant::now();
    let mut out = std::io::stdout().lock();
    for seed in (0..).map(|i| options.seed + i * options.jobs) {
        let is_over = started.elapsed().as_secs_f64() >= options.seconds;
        if is_over || seed >= options.seed.saturating_add(options.sequences) {
            break;
        }
        writeln!(out, "begin {seed}").and_then(|_| out.flush()).expect("somebody reads");
        sequence(seed, folder.to_str().expect("a name in UTF-8"));
        writeln!(out, "end").expect("somebody reads");
        for (name, [calls, errors]) in std::mem::take(&mut *world::COUNTS.lock().unwrap()) {
            writeln!(out, "calls {name} {calls} {errors}").expect("somebody reads");
        }
    }
    _ = std::fs::remove_dir_all(&folder);
}

/// Ends the process when nothing has been called for too long.
fn watch() {
    let (mut calls, mut since) = (0, Instant::now());
    loop {
        std::thread::sleep(Duration::from_secs(1));
        let now = world::CALLS.load(SeqCst);
        if now != calls {
            (calls, since) = (now, Instant::now());
        } else if since.elapsed() > HANGS {
            world::broken(&format!("a call hangs; the threads are in {:?}", *world::RUNNING.lock().unwrap()));
        }
    }
}

fn sequence(seed: u64, folder: &str) {
    world::SEED.store(seed, SeqCst);
    let mut s = Source::new(seed);
    let threads = if s.one_in(4) { 2 + s.below(3) } else { 1 };
    let w = World::new(folder, threads == 1, calls::any);
    calls::create_device(&w, &mut s);
    calls::create_scene(&w, &mut s);
    let calls = 100 + s.below(300);
    std::thread::scope(|scope| {
        for _ in 1..threads {
            let (w, mut s) = (&w, Source::new(s.next()));
            scope.spawn(move || (0..calls).for_each(|_| calls::any(w, &mut s)));
        }
        (0..calls).for_each(|_| calls::any(&w, &mut s));
    });
    if s.one_in(2) {
        calls::still_work(&w, &mut s);
    }
}
