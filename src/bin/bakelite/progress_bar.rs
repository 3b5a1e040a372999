//! Progress on standard error: a bar on a terminal, a line per stage elsewhere.

use bakelite::Progress;
use indicatif::{ProgressBar, ProgressStyle};
use std::io::IsTerminal;
use std::time::Duration;

/// How to show progress.
#[derive(Clone, Copy)]
enum Mode {
    Quiet,
    Lines,
    Bar,
}

/// Shows the progress of one call after another.
pub struct Bars(Mode);

impl Bars {
    pub fn new(quiet: bool) -> Bars {
        Bars(match quiet {
            true => Mode::Quiet,
            false if std::io::stderr().is_terminal() => Mode::Bar,
            false => Mode::Lines,
        })
    }

    /// A line of news.
    pub fn say(&self, text: &str) {
        if !matches!(self.0, Mode::Quiet) {
            eprintln!("{text}");
        }
    }

    /// Runs `work`, a call of the library that is about `what`, and shows how it gets on.
    pub fn show<R>(&self, what: &str, work: impl FnOnce(&Progress) -> R) -> R {
        match self.0 {
            Mode::Quiet => work(&Progress::none()),
            Mode::Lines => {
                let mut last = String::new();
                work(&Progress::new(|_, stage| {
                    if stage != last {
                        eprintln!("{what}: {stage}");
                        last = stage.to_owned();
                    }
                    true
                }))
            }
            Mode::Bar => {
                let bar = ProgressBar::new(1000).with_prefix(what.to_owned());
                if let Ok(style) = ProgressStyle::with_template("{prefix:>9} [{bar:40}] {percent:>3}% {elapsed} {msg}")
                {
                    bar.set_style(style.progress_chars("=> "));
                }
                bar.enable_steady_tick(Duration::from_millis(100));
                let result = work(&Progress::new(|fraction, stage| {
                    bar.set_position((fraction * 1000.0) as u64);
                    if bar.message() != stage {
                        bar.set_message(stage.to_owned());
                    }
                    true
                }));
                bar.finish_and_clear();
                result
            }
        }
    }
}
