//! Results: saving the light of all baked texels of a light map to a file, and loading it.
//!
//! A file holds records (`super::records`): `RSLT` with fingerprint and counts, `PLAN`, `BACK` (the sides that are
//! shown), `GUID` (what photons after a change have in common with those of the bake, if known), `RADI` (the radiance map, in runs), `TEXL` (direct and indirect light and state of runs of texels), each
//! followed by `DIRL` (their light by direction) if that was asked for and `SPRD` (error and halves of their light) after
//! several passes, `DONE`.
//! Light is saved as it was before seams were stitched. Loading the last texels stitches anew, so that light maps
//! assembled from several results have the bits of one bake.

use super::fingerprint::Fingerprint;
use super::records::{self, MAGIC, Next, RUN, Records, Tag, take, take_one};
use super::{damaged, foreign, unreadable};
use crate::base::directional::Directional;
use crate::base::error::{Error, Result};
use crate::base::files;
use crate::base::memory::{try_collect, try_push, try_to_vec, try_vec, try_with_capacity};
use crate::base::progress::Progress;
use crate::lightmap::indirect::radiance_map::Radiance;
use crate::lightmap::indirect::split_texels;
use crate::lightmap::plan::Plan;
use crate::lightmap::{BakeStats, Light, Lightmap, Spread, TexelState};
use crate::photon::Guidance;
use crate::scene::MOST_LIGHT;
use bytemuck::{Pod, Zeroable};
use glam::Vec3;
use std::io::BufReader;
use std::ops::Range;
use std::path::Path;
use std::sync::Arc;

const HEAD: Tag = *b"RSLT";
const PLAN: Tag = *b"PLAN";
const BACKS: Tag = *b"BACK";
const RADIANCE: Tag = *b"RADI";
const TEXELS: Tag = *b"TEXL";
const DIRECTIONAL: Tag = *b"DIRL";
const SPREAD: Tag = *b"SPRD";
const GUIDANCE: Tag = *b"GUID";
const DONE: Tag = *b"DONE";

/// The content of the first record.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct Head {
    fingerprint: Fingerprint,
    /// Bits of [`left_out`](crate::lightmap::plan::left_out), before stitching.
    left_out: u64,
    /// Number of texels of the radiance map; 0 if there is none.
    radiance: u64,
    /// Number of texels in the file.
    texels: u64,
}

impl Lightmap {
    /// Writes the light of all texels that have been baked so far to a file, which is replaced as a whole. Fails
    /// with `InvalidState` before a bake, if the scene has moved since, or if bakes with different parameters or lights
    /// filled the texels.
    pub fn save_result(&self, path: &Path, progress: &Progress) -> Result<()> {
        let light = self.light()?;
        if self.before.is_some() {
            return Err(Error::InvalidState("the scene has moved since the light was baked: bake first".into()));
        }
        let Some(origin) = &light.origin else {
            return Err(Error::InvalidState(
                "the light map holds light of bakes that differ in parameters or lights, which are no one result"
                    .into(),
            ));
        };
        let runs = runs(&light.state)?;
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
            records::append(&mut out, HEAD, &[bytemuck::bytes_of(&head)])?;
            records::append(&mut out, PLAN, &[light.plan.text().as_bytes()])?;
            records::append(&mut out, BACKS, &[bytemuck::cast_slice(&light.backs)])?;
            if let Some(guidance) = &light.radiance.guidance {
                records::append(&mut out, GUIDANCE, &[bytemuck::cast_slice(&guidance.words()?)])?;
            }
            for values in light.radiance.values.chunks(RUN) {
                records::append(&mut out, RADIANCE, &[bytemuck::cast_slice(values)])?;
                write(&mut out, values.len())?;
            }
            for run in runs.iter().flat_map(|r| r.clone().step_by(RUN).map(|i| i..r.end.min(i + RUN))) {
                append_texels(light, run.clone(), &mut out)?;
                write(&mut out, run.len())?;
            }
            records::append(&mut out, DONE, &[])?;
            write(&mut out, 0)
        };
        self.atlas.scene.device().run(progress, || files::prepare(path, write_file))?.finish()
    }

    /// Loads the light of a result that was saved from a light map of the same scene, lights and layout. Texels that
    /// the file does not have keep the light that was baked or loaded before, which must be of a bake with the same
    /// parameters. A file that is refused changes nothing.
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

    /// Returns the present light, without stitching, merged with that of a file.
    fn merged(&self, path: &Path, progress: &Progress) -> Result<Light> {
        let mut file = Loading::open(path, self)?;
        let texels = self.atlas.map.len();
        let memory = self.atlas.scene.device().memory();
        let origin = file.head.fingerprint.origin();
        let directional = if origin.params.directional == 0 { 0 } else { texels };
        let spread = if origin.params.passes > 1 || origin.params.target_error > 0.0 { texels } else { 0 };
        let bytes = texels * 25
            + directional * size_of::<Directional>()
            + spread * size_of::<Spread>()
            + file.head.radiance as usize * size_of::<Vec3>();
        let memory = memory.reserve(bytes, "the result of a bake")?;
        let mut light = Light {
            direct: try_vec(texels, "direct light")?,
            indirect: try_vec(texels, "indirect light")?,
            directional: try_vec(directional, "light by direction")?,
            spread: try_vec(spread, "the spread of passes")?,
            state: try_vec(texels, "validity")?,
            radiance: Radiance::default(),
            backs: Vec::new(),
            stitch: None,
            origin: Some(origin),
            plan: Plan::default(),
            _memory: memory,
        };
        if let Some(old) = self.current_light().filter(|_| (file.head.texels as usize) < texels) {
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
            light.directional.copy_from_slice(&old.directional);
            light.spread.copy_from_slice(&old.spread);
            light.state.copy_from_slice(&old.state);
            if let Some(stitch) = &old.stitch {
                stitch.copy_former(&mut light);
            }
        }
        file.read_into(&mut light, self.atlas.charts.charts.len(), progress)?;
        // Not kept, since few rays find them again, when all files are read.
        if light.state.iter().all(|&state| state != TexelState::Unbaked) {
            light.radiance.split = split_texels::find(&self.atlas, &light.radiance.values, &mut 0, progress)?;
        }
        Ok(light)
    }
}

/// Finds the runs of baked texels.
fn runs(state: &[TexelState]) -> Result<Vec<Range<usize>>> {
    let mut runs: Vec<Range<usize>> = Vec::new();
    for i in (0..state.len()).filter(|&i| state[i] != TexelState::Unbaked) {
        match runs.last_mut() {
            Some(last) if last.end == i => last.end = i + 1,
            _ => try_push(&mut runs, i..i + 1, "the runs of baked texels")?,
        }
    }
    Ok(runs)
}

fn append_texels(light: &Light, run: Range<usize>, out: &mut Vec<u8>) -> Result<()> {
    let copy = |of: &[Vec3]| try_to_vec(&of[run.clone()], "texels to be saved");
    let (mut direct, mut indirect) = (copy(&light.direct)?, copy(&light.indirect)?);
    let directional = light.directional.get(run.clone()).unwrap_or_default();
    let mut directional = try_to_vec(directional, "texels to be saved")?;
    if let Some(stitch) = &light.stitch {
        stitch.former_of(&run, &mut direct, &mut indirect, &mut directional);
    }
    let states = try_collect(light.state[run.clone()].iter().map(|s| s.to_byte()), "texels to be saved")?;
    let place = [run.start as u64, run.len() as u64];
    let parts =
        [bytemuck::cast_slice(&place), bytemuck::cast_slice(&direct), bytemuck::cast_slice(&indirect), &states[..]];
    records::append(out, TEXELS, &parts)?;
    if !directional.is_empty() {
        records::append(out, DIRECTIONAL, &[bytemuck::cast_slice(&place), bytemuck::cast_slice(&directional)])?;
    }
    match light.spread.get(run) {
        Some(spread) => records::append(out, SPREAD, &[bytemuck::cast_slice(&place), bytemuck::cast_slice(spread)]),
        None => Ok(()),
    }
}

/// Whether all values are possible for light.
pub(super) fn is_light(values: &[Vec3]) -> bool {
    values.iter().all(|v| v.cmpge(Vec3::ZERO).all() && v.cmple(Vec3::splat(MOST_LIGHT)).all())
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
        let fail = |e| unreadable(path, e);
        let file = files::open(path).map_err(fail)?;
        let size = file.metadata().map_err(fail)?.len();
        let file = BufReader::with_capacity(1 << 16, file);
        let (records, head): (_, Head) = records::begin(file, size, HEAD, path, "result of a bake")?;
        let atlas = &lightmap.atlas;
        // Parameters are taken from the file: only scene, lights and layout must be those of this light map.
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
        let (mut texels, mut directional, mut spread) = (0, 0, 0);
        light.radiance = Radiance::default();
        light.radiance.values = try_with_capacity(self.head.radiance as usize, "the radiance map of a result")?;
        loop {
            let next = self.records.next();
            let next = next.map_err(|e| unreadable(self.path, e))?;
            let Next::Record(tag, content) = next else { return Err(damaged(self.path)) };
            let read = match tag {
                PLAN => String::from_utf8(content)
                    .ok()
                    .map(|text| light.plan = Plan::from_text(self.head.left_out as u32, &text))
                    .map(|()| 0),
                BACKS => read_backs(&content, charts)?.map(|backs| light.backs = backs).map(|()| 0),
                GUIDANCE => read_guidance(&content)?
                    .map(|guidance| light.radiance.guidance = Some(Arc::new(guidance)))
                    .map(|()| 0),
                RADIANCE => read_radiance(&content, self.head.radiance as usize, &mut light.radiance.values),
                TEXELS => read_texels(&content, light).inspect(|&n| texels += n as u64),
                DIRECTIONAL => read_directional(&content, light).inspect(|&n| directional += n as u64).map(|_| 0),
                SPREAD => read_spread(&content, light).inspect(|&n| spread += n as u64).map(|_| 0),
                DONE => break,
                _ => None,
            };
            stage.advance(read.ok_or_else(|| damaged(self.path))? as u64)?;
        }
        let asked = |is_empty| if is_empty { 0 } else { self.head.texels };
        if texels != self.head.texels
            || directional != asked(light.directional.is_empty())
            || spread != asked(light.spread.is_empty())
            || light.radiance.values.len() as u64 != self.head.radiance
        {
            return Err(damaged(self.path));
        }
        Ok(())
    }
}

fn read_backs(content: &[u8], charts: usize) -> Result<Option<Vec<bool>>> {
    let fits = content.is_empty() || content.len() == charts;
    let are_possible = fits && content.iter().all(|&b| b <= 1);
    are_possible.then(|| try_collect(content.iter().map(|&b| b == 1), "the sides of charts")).transpose()
}

/// Reads what photons after a change have in common with those of a bake; `None` if it is damaged.
pub(super) fn read_guidance(content: &[u8]) -> Result<Option<Guidance>> {
    let words = content.chunks_exact(size_of::<u32>()).map(bytemuck::pod_read_unaligned::<u32>);
    let is_whole = content.len().is_multiple_of(size_of::<u32>());
    if is_whole { Guidance::from_words(&try_collect(words, "the result of a bake")?) } else { Ok(None) }
}

/// Appends a run of the radiance map; returns its length.
fn read_radiance(mut content: &[u8], all: usize, values: &mut Vec<Vec3>) -> Option<usize> {
    let (first, count) = (values.len(), content.len() / size_of::<Vec3>());
    if first + count > all {
        return None;
    }
    // The capacity suffices for all values, so this does not allocate.
    values.resize(first + count, Vec3::ZERO);
    take(&mut content, &mut values[first..])?;
    (content.is_empty() && is_light(&values[first..])).then_some(count)
}

/// Reads the light by direction of a run of texels; returns its length.
fn read_directional(mut content: &[u8], light: &mut Light) -> Option<usize> {
    let [first, count] = take_one::<[u64; 2]>(&mut content)?.map(|n| n as usize);
    let values = light.directional.get_mut(first..first.checked_add(count)?)?;
    take(&mut content, values)?;
    (content.is_empty() && values.iter().all(Directional::is_possible)).then_some(count)
}

/// Reads error and halves of a run of texels; returns its length.
fn read_spread(mut content: &[u8], light: &mut Light) -> Option<usize> {
    let [first, count] = take_one::<[u64; 2]>(&mut content)?.map(|n| n as usize);
    let values = light.spread.get_mut(first..first.checked_add(count)?)?;
    take(&mut content, values)?;
    let is_possible = |s: &Spread| is_light(&[s.error]) && is_light(&s.difference.map(Vec3::abs));
    (content.is_empty() && values.iter().all(is_possible)).then_some(count)
}

/// Reads a run of texels; returns its length. If it is refused, some texels may have been written.
fn read_texels(mut content: &[u8], light: &mut Light) -> Option<usize> {
    let [first, count] = take_one::<[u64; 2]>(&mut content)?.map(|n| n as usize);
    let run = first..first.checked_add(count)?;
    if run.end > light.state.len() || count > RUN {
        return None;
    }
    let (direct, indirect) = (&mut light.direct[run.clone()], &mut light.indirect[run.clone()]);
    take(&mut content, direct)?;
    take(&mut content, indirect)?;
    if content.len() != count || !is_light(direct) || !is_light(indirect) {
        return None;
    }
    for (state, &byte) in light.state[run].iter_mut().zip(content) {
        *state = TexelState::from_byte(byte).filter(|&s| s != TexelState::Unbaked)?;
    }
    Some(count)
}
