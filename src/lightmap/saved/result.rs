//! Results: the light of all baked texels of a light map in a file, and back.
//!
//! A file holds records (`super::records`): `RSLT` with fingerprint and counts, `PLAN`, `BACK` (which sides are shown),
//! `RADI` (the radiance map, in runs), `TEXL` (direct and indirect light and state of runs of texels), `DONE`. Light is
//! kept as it was before seams were stitched: what loads the last texels stitches anew, so that light maps put
//! together of several results have the bits of one bake.

use super::fingerprint::Fingerprint;
use super::records::{self, MAGIC, Next, Records, Tag, take};
use super::{another_kind, damaged, foreign};
use crate::error::{Error, Result};
use crate::files;
use crate::lightmap::indirect::bright_patches::Bright;
use crate::lightmap::indirect::radiance_map::Radiance;
use crate::lightmap::plan::Plan;
use crate::lightmap::{BakeStats, Light, Lightmap, TexelState};
use crate::memory::try_vec;
use crate::progress::Progress;
use bytemuck::{Pod, Zeroable};
use glam::Vec3;
use std::io::{BufReader, Read};
use std::ops::Range;
use std::path::Path;

const HEAD: Tag = *b"RSLT";
const PLAN: Tag = *b"PLAN";
const BACKS: Tag = *b"BACK";
const RADIANCE: Tag = *b"RADI";
const TEXELS: Tag = *b"TEXL";
const DONE: Tag = *b"DONE";

/// Texels of a record.
const RUN: usize = 1 << 14;

/// The content of the first record.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct Head {
    fingerprint: Fingerprint,
    /// Bits of [`left_out`](crate::lightmap::plan::left_out), before stitching.
    left_out: u64,
    /// Texels of the radiance map; 0 if there is none.
    radiance: u64,
    /// Texels that follow.
    texels: u64,
}

impl Lightmap {
    /// Writes the light of all texels that have been baked so far to a file, which is replaced as a whole. Fails
    /// with `InvalidState` before a bake, or if bakes with different parameters or lights filled the texels.
    pub fn save_result(&self, path: &Path, progress: &Progress) -> Result<()> {
        let light = self.light()?;
        let Some(origin) = &light.origin else {
            return Err(Error::InvalidState(
                "the light map holds light of bakes that differ in parameters or lights, which are no one result"
                    .into(),
            ));
        };
        let runs = runs(&light.state);
        let texels: usize = runs.iter().map(Range::len).sum();
        let head = Head {
            fingerprint: Fingerprint::new(&self.atlas, origin, [0; 2]),
            left_out: light.plan.left_out.into(),
            radiance: light.radiance.values.len() as u64,
            texels: texels as u64,
        };
        let stage = progress.stage("saving", 0.0, 1.0, head.radiance + head.texels);
        let write_file = |file: &mut files::Replacement| {
            let mut out = MAGIC.to_vec();
            let mut write = |out: &mut Vec<u8>, items: usize| {
                file.append(out, |_| stage.advance(0))?;
                out.clear();
                stage.advance(items as u64)
            };
            records::append(&mut out, HEAD, &[bytemuck::bytes_of(&head)]);
            records::append(&mut out, PLAN, &[light.plan.text().as_bytes()]);
            let backs: Vec<u8> = light.backs.iter().map(|&b| b.into()).collect();
            records::append(&mut out, BACKS, &[&backs]);
            for values in light.radiance.values.chunks(RUN) {
                records::append(&mut out, RADIANCE, &[bytemuck::cast_slice(values)]);
                write(&mut out, values.len())?;
            }
            for run in runs.iter().flat_map(|r| r.clone().step_by(RUN).map(|i| i..r.end.min(i + RUN))) {
                append_texels(light, run.clone(), &mut out);
                write(&mut out, run.len())?;
            }
            records::append(&mut out, DONE, &[]);
            write(&mut out, 0)
        };
        self.atlas.scene.device().run(progress, || files::prepare(path, write_file))?.finish()
    }

    /// Takes over the light of a result that was saved of a light map of the same scene, lights and layout. What was
    /// baked or loaded before stays where the file has no texels; it must be of a bake with the same parameters. A
    /// file that is refused changes nothing.
    pub fn load_result(&mut self, path: &Path, progress: &Progress) -> Result<()> {
        let device = self.atlas.scene.device().clone();
        let (light, plan, stitch) = device.run(progress, || {
            let light = self.merged(path, progress)?;
            let (mut plan, mut stats) = (light.plan.clone(), BakeStats::default());
            let (all, params) = (0..self.atlas.map.len(), light.origin.map(|o| o.params).unwrap_or_default());
            let stitch = self.stitch(&light, &all, &params, &mut plan, &mut stats, progress)?;
            Ok((light, plan, stitch))
        })?;
        let all = 0..self.atlas.map.len();
        self.plan = plan;
        device.install(|| self.store(light, all, stitch));
        Ok(())
    }

    /// The light that there is, not stitched, with that of a file.
    fn merged(&self, path: &Path, progress: &Progress) -> Result<Light> {
        let mut file = Loading::open(path, self)?;
        let texels = self.atlas.map.len();
        let memory = self.atlas.scene.device().memory();
        let bytes = texels * 25 + file.head.radiance as usize * size_of::<Vec3>();
        let memory = memory.reserve(bytes, "the result of a bake")?;
        let origin = file.head.fingerprint.origin();
        let mut light = Light {
            direct: try_vec(texels, "direct light")?,
            indirect: try_vec(texels, "indirect light")?,
            state: try_vec(texels, "validity")?,
            radiance: Radiance::default(),
            backs: Vec::new(),
            stitch: None,
            origin: Some(origin),
            plan: Plan::default(),
            _memory: memory,
        };
        if let Some(old) = self.light.as_ref().filter(|_| (file.head.texels as usize) < texels) {
            if old.origin != Some(origin) {
                return Err(Error::InvalidState(format!(
                    "{} holds {} of {texels} texels, and the light map holds light of another bake, with other \
                     parameters or lights",
                    path.display(),
                    file.head.texels
                )));
            }
            light.direct.copy_from_slice(&old.direct);
            light.indirect.copy_from_slice(&old.indirect);
            light.state.copy_from_slice(&old.state);
            if let Some(stitch) = &old.stitch {
                stitch.copy_former(&mut light);
            }
        }
        file.read_into(&mut light, self.atlas.charts.charts.len(), progress)?;
        Ok(light)
    }
}

/// Runs of baked texels.
fn runs(state: &[TexelState]) -> Vec<Range<usize>> {
    let mut runs: Vec<Range<usize>> = Vec::new();
    for i in (0..state.len()).filter(|&i| state[i] != TexelState::Unbaked) {
        match runs.last_mut() {
            Some(last) if last.end == i => last.end = i + 1,
            _ => runs.push(i..i + 1),
        }
    }
    runs
}

fn append_texels(light: &Light, run: Range<usize>, out: &mut Vec<u8>) {
    let (mut direct, mut indirect) = (light.direct[run.clone()].to_vec(), light.indirect[run.clone()].to_vec());
    if let Some(stitch) = &light.stitch {
        stitch.former_of(&run, &mut direct, &mut indirect);
    }
    let states: Vec<u8> = light.state[run.clone()].iter().map(|s| s.to_byte()).collect();
    let place = [run.start as u64, run.len() as u64];
    let parts =
        [bytemuck::cast_slice(&place), bytemuck::cast_slice(&direct), bytemuck::cast_slice(&indirect), &states[..]];
    records::append(out, TEXELS, &parts);
}

/// Whether all are what light can be.
pub(super) fn is_light(values: &[Vec3]) -> bool {
    values.iter().all(|v| v.is_finite() && v.min_element() >= 0.0)
}

/// A result that is being read.
struct Loading<'a> {
    path: &'a Path,
    records: Records<BufReader<std::fs::File>>,
    head: Head,
}

impl<'a> Loading<'a> {
    /// Opens a result and compares its fingerprint with a light map's.
    fn open(path: &'a Path, lightmap: &Lightmap) -> Result<Self> {
        let fail = |e| Error::Io(format!("cannot read {}: {e}", path.display()));
        let file = files::open(path).map_err(fail)?;
        let size = file.metadata().map_err(fail)?.len();
        let mut file = BufReader::with_capacity(1 << 16, file);
        let mut magic = [0; MAGIC.len()];
        let is_ours = file.read_exact(&mut magic).is_ok() && magic == MAGIC;
        if !is_ours {
            return Err(another_kind(path, "result of a bake"));
        }
        let mut records = Records::new(file, size);
        let head: Head = match records.next().map_err(fail)? {
            Next::Record(HEAD, content) if content.len() == size_of::<Head>() => bytemuck::pod_read_unaligned(&content),
            Next::Record(..) => return Err(another_kind(path, "result of a bake")),
            _ => return Err(damaged(path)),
        };
        let atlas = &lightmap.atlas;
        // Whatever the parameters were, they are taken over: only scene, lights and layout must be those of here.
        let origin = super::fingerprint::Origin::new(&head.fingerprint.params(), &atlas.scene.lights());
        let needed = Fingerprint::new(atlas, &origin, [0; 2]);
        if let Some(differences) = head.fingerprint.difference(&needed) {
            return Err(foreign(path, &differences));
        }
        head.fingerprint.params().validate().map_err(|_| damaged(path))?;
        let radiance = atlas.radiance.len() as u64;
        if head.texels > atlas.map.len() as u64 || (head.radiance != 0 && head.radiance != radiance) {
            return Err(damaged(path));
        }
        Ok(Loading { path, records, head })
    }

    /// Reads all records after the first.
    fn read_into(&mut self, light: &mut Light, charts: usize, progress: &Progress) -> Result<()> {
        let stage = progress.stage("loading", 0.0, 1.0, self.head.radiance + self.head.texels);
        let mut texels = 0;
        light.radiance = Radiance { values: Vec::new(), bright: Bright::default() };
        light.radiance.values.try_reserve_exact(self.head.radiance as usize).map_err(|_| {
            Error::OutOfMemory(format!(
                "the radiance map of {} takes {} texels",
                self.path.display(),
                self.head.radiance
            ))
        })?;
        loop {
            let next = self.records.next();
            let next = next.map_err(|e| Error::Io(format!("cannot read {}: {e}", self.path.display())))?;
            let Next::Record(tag, content) = next else { return Err(damaged(self.path)) };
            let read = match tag {
                PLAN => String::from_utf8(content)
                    .ok()
                    .map(|text| light.plan = Plan::from_text(self.head.left_out as u32, &text))
                    .map(|()| 0),
                BACKS => read_backs(&content, charts).map(|backs| light.backs = backs).map(|()| 0),
                RADIANCE => read_radiance(&content, self.head.radiance as usize, &mut light.radiance.values),
                TEXELS => read_texels(&content, light).inspect(|&n| texels += n as u64),
                DONE => break,
                _ => None,
            };
            stage.advance(read.ok_or_else(|| damaged(self.path))? as u64)?;
        }
        if texels != self.head.texels || light.radiance.values.len() as u64 != self.head.radiance {
            return Err(damaged(self.path));
        }
        Ok(())
    }
}

fn read_backs(content: &[u8], charts: usize) -> Option<Vec<bool>> {
    let fits = content.is_empty() || content.len() == charts;
    (fits && content.iter().all(|&b| b <= 1)).then(|| content.iter().map(|&b| b == 1).collect())
}

/// Appends a run of the radiance map; returns its length.
fn read_radiance(mut content: &[u8], all: usize, values: &mut Vec<Vec3>) -> Option<usize> {
    let count = content.len() / size_of::<Vec3>();
    let run: Vec<Vec3> = take(&mut content, count)?;
    if !content.is_empty() || !is_light(&run) || values.len() + run.len() > all {
        return None;
    }
    values.extend_from_slice(&run);
    Some(run.len())
}

/// Reads a run of texels; returns its length.
fn read_texels(mut content: &[u8], light: &mut Light) -> Option<usize> {
    let place: Vec<u64> = take(&mut content, 2)?;
    let (first, count) = (place[0] as usize, place[1] as usize);
    let run = first..first.checked_add(count)?;
    if run.end > light.state.len() || count > RUN {
        return None;
    }
    let (direct, indirect) = (take(&mut content, count)?, take(&mut content, count)?);
    let states = content.iter().map(|&b| TexelState::from_byte(b)).collect::<Option<Vec<_>>>()?;
    if states.len() != count || !is_light(&direct) || !is_light(&indirect) || states.contains(&TexelState::Unbaked) {
        return None;
    }
    light.direct[run.clone()].copy_from_slice(&direct);
    light.indirect[run.clone()].copy_from_slice(&indirect);
    light.state[run].copy_from_slice(&states);
    Some(count)
}
