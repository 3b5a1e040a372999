//! Shares of the photons and of the radiance map, which all texels of a bake need: each of several machines computes
//! one and writes it to a file, and all read those of the others. What comes out has the bits of one machine, since
//! photons are put together in the order of their numbers, and a texel of the radiance map depends on no other's.
//!
//! A file holds records (`super::records`): `SHAR` with the fingerprint and what share it is, `PHOT` (runs of photons) or
//! `RADI` (runs of texels of the radiance map), in order, `DONE`.

use super::fingerprint::{Fingerprint, Origin, compare};
use super::records::{self, MAGIC, Next, RUN, Records, Tag, take};
use super::result::is_light;
use super::{damaged, foreign, unreadable};
use crate::base::error::{Error, Result, invalid_argument};
use crate::base::files::{self, Replacement};
use crate::base::memory::try_with_capacity;
use crate::base::progress::{Progress, Stage};
use crate::base::share::Share;
use crate::direct::DirectLight;
use crate::lightmap::atlas::Atlas;
use crate::lightmap::indirect::radiance_map::{self, Radiance};
use crate::lightmap::passes;
use crate::lightmap::plan::left_out;
use crate::lightmap::stages::{self, Inputs};
use crate::lightmap::{BakeParams, BakeStats, Lightmap};
use crate::photon::trace::Traced;
use bytemuck::{Pod, Zeroable};
use glam::Vec3;
use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};
use std::time::Instant;

const HEAD: Tag = *b"SHAR";
const PHOTONS: Tag = *b"PHOT";
const RADIANCE: Tag = *b"RADI";
const DONE: Tag = *b"DONE";

/// Maximum number of shares.
const MAX_SHARES: u32 = 1 << 16;

/// Files of the shares of a bake.
#[derive(Clone, Debug, PartialEq)]
pub struct ShareParams {
    /// What all names of files begin with: a folder with a slash, or more. They go on with `photons` or `radiance`,
    /// `-NUMBER-of-COUNT`, `-pass-NUMBER` from the second pass on, and `.bkshare`.
    pub prefix: PathBuf,
    /// Number of shares, 1 to 65,536.
    pub count: u32,
}

impl ShareParams {
    /// Checks the range documented on the field, and whether bakes with these parameters can have shares.
    pub fn validate(&self, params: &BakeParams) -> Result<()> {
        if !(1..=MAX_SHARES).contains(&self.count) {
            return invalid_argument!("share_count is {}, outside 1 to {MAX_SHARES}", self.count);
        }
        if params.target_error > 0.0 {
            return invalid_argument!(
                "with target_error there are no shares: the number of passes is not known before"
            );
        }
        Ok(())
    }
}

/// What is divided into shares.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(u32)]
pub enum ShareStage {
    /// Tracing of photons.
    Photons = 0,
    /// The radiance map, for which the photons of all shares are needed.
    Radiance = 1,
}

/// The content of the first record.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct Head {
    fingerprint: Fingerprint,
    /// 0: photons, 1: radiance.
    stage: u32,
    pass: u32,
    share: u32,
    share_count: u32,
    /// Number of photons that were emitted for all shares.
    emitted: u64,
    /// Number of photons stored: of this share, in a file of radiance of all.
    stored: u64,
    /// Number of photons or texels in the file.
    items: u64,
}

/// Reads and writes the shares of a bake.
pub(in crate::lightmap) struct Shares<'a> {
    params: &'a ShareParams,
    atlas: &'a Atlas,
    needed: Fingerprint,
}

/// What a file holds.
enum Content<'a> {
    Head(&'a Head),
    Run(&'a [u8]),
}

/// The share, stage and pass of a file.
#[derive(Clone, Copy)]
struct Which {
    stage: ShareStage,
    share: u32,
    pass: u32,
}

impl<'a> Shares<'a> {
    pub fn new(params: &'a ShareParams, atlas: &'a Atlas, origin: &Origin) -> Shares<'a> {
        Shares { params, atlas, needed: Fingerprint::new(atlas, origin, [0; 2]) }
    }

    fn path(&self, Which { stage, share, pass }: Which) -> PathBuf {
        let kind = if stage == ShareStage::Photons { "photons" } else { "radiance" };
        let pass = if pass == 0 { String::new() } else { format!("-pass-{}", pass + 1) };
        let mut name = self.params.prefix.clone().into_os_string();
        name.push(format!("{kind}-{share}-of-{}{pass}.bkshare", self.params.count));
        name.into()
    }

    /// Opens the file of a share and checks that it is what it should be.
    fn open(&self, which: Which, path: &Path) -> Result<(Records<BufReader<File>>, Head)> {
        let fail = |e| unreadable(path, e);
        let file = files::open(path).map_err(fail)?;
        let size = file.metadata().map_err(fail)?.len();
        let (records, head): (_, Head) = records::begin(BufReader::new(file), size, HEAD, path, "share of a bake")?;
        let mut all: Vec<String> = head.fingerprint.difference(&self.needed).into_iter().collect();
        compare(&mut all, "the stage", head.stage, which.stage as u32);
        compare(&mut all, "the pass", head.pass, which.pass);
        compare(&mut all, "the share", head.share, which.share);
        compare(&mut all, "the number of shares", head.share_count, self.params.count);
        if !all.is_empty() {
            return Err(foreign(path, &all.join(", ")));
        }
        Ok((records, head))
    }

    /// Reads the file of a share: `take` is given its head and each run, and returns the number of the items that it has
    /// taken, or `None` if they are impossible. Advances `stage` by one.
    fn read(&self, which: Which, stage: &Stage, take: &mut dyn FnMut(Content) -> Result<Option<usize>>) -> Result<()> {
        let path = &self.path(which);
        let (mut records, head) = self.open(which, path)?;
        let expected = if which.stage == ShareStage::Photons { PHOTONS } else { RADIANCE };
        take(Content::Head(&head))?.ok_or_else(|| damaged(path))?;
        let mut items = 0;
        loop {
            stage.check()?;
            match records.next().map_err(|e| unreadable(path, e))? {
                Next::Record(tag, content) if tag == expected => {
                    items += take(Content::Run(&content))?.ok_or_else(|| damaged(path))? as u64;
                }
                Next::Record(DONE, _) if items == head.items => break,
                _ => return Err(damaged(path)),
            }
        }
        if !matches!(records.next(), Ok(Next::End)) {
            return Err(damaged(path));
        }
        stage.advance(1)
    }

    /// Whether the file of a share is there and whole, so that it need not be made again.
    fn is_there(&self, which: Which, stage: &Stage) -> Result<bool> {
        let item = if which.stage == ShareStage::Photons { Traced::ITEM } else { size_of::<Vec3>() };
        let mut count = |content: Content| match content {
            Content::Head(_) => Ok(Some(0)),
            Content::Run(run) => Ok(run.len().is_multiple_of(item).then_some(run.len() / item)),
        };
        match self.read(which, stage, &mut count) {
            Ok(()) => Ok(true),
            Err(Error::Cancelled) => Err(Error::Cancelled),
            Err(_) => Ok(false),
        }
    }

    /// Writes the file of a share.
    fn write(
        &self,
        which: Which,
        [emitted, stored, items]: [u64; 3],
        runs: &mut dyn Iterator<Item = &[u8]>,
        progress: &Progress,
    ) -> Result<()> {
        let (tag, item) = match which.stage {
            ShareStage::Photons => (PHOTONS, Traced::ITEM),
            ShareStage::Radiance => (RADIANCE, size_of::<Vec3>()),
        };
        let Which { stage, share, pass } = which;
        let share_count = self.params.count;
        let head =
            Head { fingerprint: self.needed, stage: stage as u32, pass, share, share_count, emitted, stored, items };
        let stage = progress.stage("saving", 0.95, 1.0, items);
        let write = |file: &mut Replacement| {
            let mut out = MAGIC.to_vec();
            records::append(&mut out, HEAD, &[bytemuck::bytes_of(&head)])?;
            for run in runs {
                records::append(&mut out, tag, &[run])?;
                file.append(&out, |_| stage.advance(0))?;
                out.clear();
                stage.advance((run.len() / item) as u64)?;
            }
            records::append(&mut out, DONE, &[])?;
            file.append(&out, |_| stage.advance(0))
        };
        files::prepare(&self.path(which), write)?.finish()
    }

    /// Reads the photons of all shares.
    fn photons(&self, inputs: &Inputs, pass: u32) -> Result<Traced> {
        let params = stages::photon_params(inputs);
        let mut photons = Traced::none(&self.atlas.scene, &params, 0);
        let stage = inputs.progress.stage("loading", 0.0, 0.2, self.params.count.into());
        let mut take = |content: Content| match content {
            Content::Head(head) => {
                photons.stats.emitted = head.emitted;
                Ok((head.emitted <= params.photon_count).then_some(0))
            }
            Content::Run(run) => photons.add(run),
        };
        for share in 0..self.params.count {
            self.read(Which { stage: ShareStage::Photons, share, pass }, &stage, &mut take)?;
        }
        Ok(photons)
    }

    /// Reads the radiance map of all shares, and finds its bright patches.
    pub fn radiance(&self, inputs: &Inputs, pass: u32, stats: &mut BakeStats) -> Result<Radiance> {
        let start = Instant::now();
        let all = self.atlas.radiance.len();
        let mut values: Vec<Vec3> = try_with_capacity(all, "the radiance map of shares")?;
        let stage = inputs.progress.stage("loading", 0.2, 0.28, self.params.count.into());
        let (mut emitted, mut stored) = (0, 0);
        for number in 0..self.params.count {
            let range = radiance_map::share(&self.atlas.radiance, Share { number, count: self.params.count });
            let which = Which { stage: ShareStage::Radiance, share: number, pass };
            let mut take = |content: Content| match content {
                Content::Head(head) => {
                    (emitted, stored) = (head.emitted, head.stored);
                    Ok((head.items == range.len() as u64).then_some(0))
                }
                Content::Run(run) => Ok(add_radiance(&mut values, run, all)),
            };
            self.read(which, &stage, &mut take)?;
        }
        if values.len() != all {
            return Err(damaged(&self.path(Which { stage: ShareStage::Radiance, share: 0, pass })));
        }
        let (mut radiance, mut rays) = (Radiance { values, ..Default::default() }, 0);
        stages::complete(inputs, &mut radiance, &mut rays)?;
        (stats.photons_emitted, stats.photons_stored) = (emitted, stored);
        stats.radiance.seconds = start.elapsed().as_secs_f64();
        stats.radiance.rays = rays;
        stats.radiance.bytes = (all * size_of::<Vec3>() + self.atlas.radiance.bytes()) as u64;
        Ok(radiance)
    }
}

/// Appends a run of the radiance map; returns its length.
fn add_radiance(values: &mut Vec<Vec3>, mut run: &[u8], all: usize) -> Option<usize> {
    let (first, count) = (values.len(), run.len() / size_of::<Vec3>());
    if count > all - first {
        return None;
    }
    // The capacity suffices for all values, so this does not allocate.
    values.resize(first + count, Vec3::ZERO);
    take(&mut run, &mut values[first..])?;
    (run.is_empty() && is_light(&values[first..])).then_some(count)
}

impl Lightmap {
    /// Computes one share of the photons or of the radiance map of a bake and writes it to its file, which is replaced as a
    /// whole. A whole file of the same share that is there already is kept. Of the radiance map needs the files of all
    /// shares of the photons. What the [plan](crate::lightmap::plan) leaves out has no files.
    ///
    /// The scene, lights, layout and parameters but `memory_budget` and the range of texels must be those of the bake
    /// that reads the shares. `Io` if a file is missing, damaged or cannot be written, `InvalidArgument` if one is of
    /// another bake.
    pub fn bake_share(
        &self,
        params: &BakeParams,
        shares: &ShareParams,
        stage: ShareStage,
        share: u32,
        progress: &Progress,
    ) -> Result<BakeStats> {
        params.validate()?;
        shares.validate(params)?;
        if share >= shares.count {
            return invalid_argument!("share is {share}, and there are {}", shares.count);
        }
        let (start, scene) = (Instant::now(), &self.atlas.scene);
        let origin = Origin::new(params, &scene.lights());
        let direct = scene.device().install(|| DirectLight::try_new(scene))?;
        let plan = self.planned(&direct, params);
        let mut stats = BakeStats { left_out: plan.left_out, passes: params.passes, ..Default::default() };
        let has_photons = plan.runs(left_out::PHOTONS);
        let is_needed = if stage == ShareStage::Photons { has_photons } else { plan.runs(left_out::INDIRECT) };
        if !is_needed {
            return Ok(stats);
        }
        let work = || {
            let shares = Shares::new(shares, &self.atlas, &origin);
            let number = Share { number: share, count: shares.params.count };
            for pass in 0..params.passes {
                progress.set_part(pass as f32 / params.passes as f32, (pass + 1) as f32 / params.passes as f32);
                let (which, params) = (Which { stage, share, pass }, passes::params_of(params, pass));
                if shares.is_there(which, &progress.stage("loading", 0.0, 0.01, 1))? {
                    continue;
                }
                let inputs = Inputs { atlas: &self.atlas, direct: &direct, params: &params, progress };
                let mut of_pass = BakeStats::default();
                match stage {
                    ShareStage::Photons => {
                        let traced = stages::share_of_photons(&inputs, number, &mut of_pass)?;
                        let counts = [of_pass.photons_emitted, of_pass.photons_stored, of_pass.photons_stored];
                        scene.check_file()?;
                        shares.write(which, counts, &mut traced.runs(), progress)?;
                    }
                    ShareStage::Radiance => {
                        let photons = if has_photons { Some(shares.photons(&inputs, pass)?) } else { None };
                        let bytes = radiance_map::share(&self.atlas.radiance, number).len() * size_of::<Vec3>();
                        let _memory = scene.device().memory().reserve(bytes, "a share of the radiance map")?;
                        let values = stages::share_of_radiance(&inputs, photons, number, &mut of_pass)?;
                        let counts = [of_pass.photons_emitted, of_pass.photons_stored, values.len() as u64];
                        let mut runs = values.chunks(RUN).map(bytemuck::cast_slice);
                        scene.check_file()?;
                        shares.write(which, counts, &mut runs, progress)?;
                    }
                }
                passes::add_stats(&mut stats, &of_pass);
            }
            Ok(())
        };
        scene.while_unchanged(|| scene.device().run(progress, || scene.install(work)))?;
        stats.seconds = start.elapsed().as_secs_f64();
        Ok(stats)
    }
}

#[cfg(test)]
mod tests;
