//! `bakelite report pipeline`: what each stage of a bake takes, and what bounds it.

use crate::args::BakeArgs;
use bakelite::Result;

/// Runs the report.
pub fn run(_args: &BakeArgs) -> Result<()> {
    todo!()
}
