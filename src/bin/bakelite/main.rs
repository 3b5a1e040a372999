//! The command line: bakes a scene, writes its light maps and compares pictures of it; measures what the library does.
//!
//! | file | what it does |
//! |---|---|
//! | `args` | flags, help, and what is wrong with them |
//! | `bake` | `bakelite bake`: its files, pictures and record |
//! | `report` | `bakelite report`: measurements, one file or folder each |
//! | `job` | the steps that bakes and reports share |
//! | `stages` | what each step took |
//! | `camera` | a view for scenes that come without one |
//! | `files` | folders and texts |
//! | `pictures` | the three pictures that the thesis compares |
//! | `plot` | curves, bars and letters in pictures |
//! | `progress_bar` | progress on standard error |

mod args;
mod bake;
mod camera;
mod files;
mod job;
mod pictures;
mod plot;
mod progress_bar;
mod repeat;
mod report;
mod stages;

use args::Command;
use bakelite::Error;
use std::process::ExitCode;

/// Exit code for wrong arguments.
const USAGE: u8 = 2;

fn main() -> ExitCode {
    let result = match args::parse(std::env::args_os().skip(1)) {
        Ok(Command::Bake(bake)) => bake::run(&bake),
        Ok(Command::Commit(args)) => job::commit(&args),
        Ok(Command::ReportCancel(args)) => report::cancel::run(&args),
        Ok(Command::ReportEdits(report)) => report::edits::run(&report),
        Ok(Command::ReportLive(report)) => report::live::run(&report),
        Ok(Command::ReportMemory(args)) => report::memory::run(&args),
        Ok(Command::ReportPipeline(args)) => report::pipeline::run(&args),
        Ok(Command::ReportDirectional(report)) => report::quality::directional::run(&report),
        Ok(Command::ReportQuality(report)) => report::quality::run(&report),
        Ok(Command::ReportCoherence(report)) => report::coherence::run(&report),
        Ok(Command::ReportScaling(report)) => report::scaling::run(&report),
        Ok(Command::ReportStability(args)) => report::stability::run(&args),
        // Help and the version, too.
        Err(e) => {
            let _ = e.print();
            return ExitCode::from(if e.use_stderr() { USAGE } else { 0 });
        }
    };
    if let Err(e) = result {
        eprintln!("bakelite: {e}");
        return ExitCode::from(if matches!(e, Error::InvalidArgument(_)) { USAGE } else { 1 });
    }
    ExitCode::SUCCESS
}
