//! Checkpoints: the finished work of a bake, kept in a file, so that a bake whose process was killed can continue.
//!
//! The file holds records (`super::records`): `CKPT` with the fingerprint of the bake, then finished work in the order
//! in which threads finish it: `RADI` (runs of the radiance map), `RDNE` (bright patches and, if known, what photons after a
//! change have in common with these; the radiance map is complete), `BACK` (the sides that are shown), `OWNL` (fallback
//! gathers), `GAT2` (blocks of the gather map), `DRC2` (blocks of direct light; `GATH` and `DRCT` were smaller ones), and
//! `OWND`, `GATD` and `DRCD` for light by direction.
//! All of it is independent of the number of threads and the order, so missing work is done again and gives the same
//! bits. Photons, upsampling, blur and seams are not kept: they take a small part of a bake. The numbers of blocks hold
//! the pass that they belong to.
//!
//! Records are only ever appended. If the process is killed, at most the last of them is incomplete; after a power
//! failure, data that was not flushed may be incomplete or zero. Either is cut off.

use super::fingerprint::{Fingerprint, Origin};
use super::records::{self, MAGIC, Next, Tag, take, take_one};
use super::result::{is_light, read_guidance};
use super::{damaged, foreign, unreadable};
use crate::base::directional::Directional;
use crate::base::error::{Error, Result, invalid_argument};
use crate::base::memory::{try_collect, try_vec};
use crate::base::progress::Progress;
use crate::device::LogLevel;
use crate::lightmap::TexelState;
use crate::lightmap::atlas::Atlas;
use crate::lightmap::indirect::fallback_gather::{OwnDirectional, OwnLight};
use crate::lightmap::indirect::find_bright_patches::{self, MAX_SHADOW_RAYS};
use crate::lightmap::indirect::radiance_map::Radiance;
use crate::lightmap::indirect::split_texels;
use crate::scene::Scene;
use glam::Vec3;
use std::collections::HashMap;
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{BufReader, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, Instant};

const HEAD: Tag = *b"CKPT";
const RADIANCE: Tag = *b"RADI";
const RADIANCE_DONE: Tag = *b"RDNE";
const BACKS: Tag = *b"BACK";
const OWN: Tag = *b"OWNL";
const GATHER: Tag = *b"GAT2";
const DIRECT: Tag = *b"DRC2";
const OWN_DIRECTIONAL: Tag = *b"OWND";
const GATHER_DIRECTIONAL: Tag = *b"GATD";
const DIRECT_DIRECTIONAL: Tag = *b"DRCD";

/// Number of texels of the radiance map in a record.
const RUN: usize = 1 << 14;

/// Place of the number of a pass in the numbers of records: there are fewer than 2^40 blocks of texels.
const PASS_SHIFT: u32 = 40;

/// File of a checkpoint, and how often a bake writes to it.
#[derive(Clone, Debug, PartialEq)]
pub struct CheckpointParams {
    /// Path of the file. If it exists, it must be a checkpoint of the same bake, which then continues from it.
    pub path: PathBuf,
    /// Seconds between two writes, finite, ≥ 0. If the process is killed, at most the work of this time is lost; 0:
    /// only that of unfinished blocks.
    pub seconds: f64,
}

impl CheckpointParams {
    /// Makes parameters of a checkpoint that is written every ten seconds.
    pub fn new(path: impl Into<PathBuf>) -> CheckpointParams {
        CheckpointParams { path: path.into(), seconds: 10.0 }
    }

    /// Checks the range documented on the field.
    pub fn validate(&self) -> Result<()> {
        // The upper limit fits a duration.
        if !(self.seconds >= 0.0 && self.seconds <= 1e9) {
            return invalid_argument!("checkpoint_seconds is {}, outside 0 to 1e9", self.seconds);
        }
        Ok(())
    }
}

/// The checkpoint of a bake in progress. Used from all threads.
pub(crate) struct Checkpoint<'a> {
    scene: &'a Scene,
    path: PathBuf,
    interval: Duration,
    file: Mutex<Output<File>>,
    pending: Mutex<Pending>,
    /// Finished work of earlier runs, by kind and number.
    done: Mutex<HashMap<(Tag, u64), Vec<u8>>>,
    /// The pass in progress, which is part of the numbers.
    pass: AtomicU32,
}

/// Records that are still to be written.
struct Pending {
    bytes: Vec<u8>,
    since: Instant,
}

/// Operations on the file of a checkpoint. (Tests have implementations that fail.)
trait Storage: Write + Seek {
    fn set_len(&self, bytes: u64) -> std::io::Result<()>;
    fn sync_data(&self) -> std::io::Result<()>;
}

impl Storage for File {
    fn set_len(&self, bytes: u64) -> std::io::Result<()> {
        File::set_len(self, bytes)
    }

    fn sync_data(&self) -> std::io::Result<()> {
        File::sync_data(self)
    }
}

/// The file, locked against other bakes.
struct Output<F> {
    file: F,
    /// Bytes of whole records.
    whole: u64,
    /// Whether the last write failed and may have left an incomplete record.
    failed: bool,
    /// Time of the last flush to disk; its duration is `flush_time`.
    flushed: Instant,
    flush_time: Duration,
}

/// Reciprocal of the fraction of the time that flushes to disk may take. They matter for power failures only: data that
/// was written survives a killed process. (A flush of a block takes from 1 to more than 100 ms.)
const FLUSH_SHARE: u32 = 100;

impl<F: Storage> Output<F> {
    fn new(file: F, whole: u64) -> Output<F> {
        Output { file, whole, failed: false, flushed: Instant::now(), flush_time: Duration::ZERO }
    }

    /// Appends whole records. The rest of a failed write is cut off first, since records behind it could not be read.
    fn append(&mut self, bytes: &[u8]) -> std::io::Result<()> {
        if self.failed {
            self.cut()?;
        }
        self.failed = true;
        self.file.write_all(bytes)?;
        if self.flushed.elapsed() >= FLUSH_SHARE * self.flush_time {
            let start = Instant::now();
            self.file.sync_data()?;
            self.flushed = Instant::now();
            self.flush_time = self.flushed - start;
        }
        self.whole += bytes.len() as u64;
        self.failed = false;
        Ok(())
    }

    /// Cuts the file to its whole records.
    fn cut(&mut self) -> std::io::Result<()> {
        self.file.set_len(self.whole)?;
        self.file.seek(SeekFrom::Start(self.whole))?;
        Ok(())
    }
}

impl<'a> Checkpoint<'a> {
    /// Opens the checkpoint of the bake of `range`, or creates one.
    pub(in crate::lightmap) fn open(
        params: &CheckpointParams,
        atlas: &'a Atlas,
        origin: &Origin,
        range: [u64; 2],
    ) -> Result<Checkpoint<'a>> {
        let path = &params.path;
        let needed = Fingerprint::new(atlas, origin, range);
        let mut head = MAGIC.to_vec();
        records::append(&mut head, HEAD, &[bytemuck::bytes_of(&needed)])?;
        let mut file = open_locked(path)?;
        let fail = |e| Error::Io(format!("cannot use the checkpoint {}: {e}", path.display()));
        let size = file.metadata().map_err(fail)?.len();
        let mut done = HashMap::new();
        let whole = if size < head.len() as u64 && is_beginning_of(&mut file, &head).map_err(fail)? {
            // The file is new, or the process was killed as it wrote the head.
            file.seek(SeekFrom::Start(0)).and_then(|_| file.write_all(&head)).map_err(fail)?;
            head.len() as u64
        } else {
            file.seek(SeekFrom::Start(0)).map_err(fail)?;
            read(&file, size, path, &needed, &mut done)?
        };
        let mut output = Output::new(file, whole);
        output.cut().map_err(fail)?;
        Ok(Checkpoint {
            scene: &atlas.scene,
            path: path.clone(),
            interval: Duration::from_secs_f64(params.seconds),
            file: Mutex::new(output),
            pending: Mutex::new(Pending { bytes: Vec::new(), since: Instant::now() }),
            done: Mutex::new(done),
            pass: AtomicU32::new(0),
        })
    }

    /// Returns the radiance map of an earlier run, if it was completed. To be called on the device's threads.
    pub fn radiance(&self, atlas: &Atlas, progress: &Progress) -> Result<Option<Radiance>> {
        let Some(end) = self.take(RADIANCE_DONE, 0) else { return Ok(None) };
        let mut values: Vec<Vec3> = try_vec(atlas.radiance.len(), "the radiance map of a checkpoint")?;
        for (run, of_run) in (0..).zip(values.chunks_mut(RUN)) {
            let Some(content) = self.take(RADIANCE, run) else { return Ok(None) };
            if content.len() != size_of_val(of_run) || take(&mut &content[..], of_run).is_none() {
                return Ok(None);
            }
        }
        let mut rest = &end[..];
        let (Some(limit), Some(shadow_rays)) = (take_one::<f32>(&mut rest), take_one::<u32>(&mut rest)) else {
            return Ok(None);
        };
        let is_possible = limit.is_finite() && (limit <= 0.0 || (1..=MAX_SHADOW_RAYS).contains(&shadow_rays));
        let guidance = if rest.is_empty() { None } else { read_guidance(rest)?.map(Arc::new) };
        if !is_light(&values) || !is_possible || guidance.is_none() != rest.is_empty() {
            return Ok(None);
        }
        let mut radiance = Radiance { values, guidance, ..Default::default() };
        // Not kept, since few rays find them again.
        radiance.split = split_texels::find(atlas, &radiance.values, &mut 0, progress)?;
        radiance.bright = find_bright_patches::again(atlas, &radiance, limit, shadow_rays)?;
        Ok(Some(radiance))
    }

    pub fn keep_radiance(&self, radiance: &Radiance) {
        for (run, values) in radiance.values.chunks(RUN).enumerate() {
            self.keep(RADIANCE, run as u64, &[bytemuck::cast_slice(values)]);
        }
        let (limit, shadow_rays) = radiance.bright.parts();
        // Without memory for them, the radiance map is made again.
        if let Ok(words) = radiance.guidance.as_ref().map_or(Ok(Vec::new()), |guidance| guidance.words()) {
            let parts = [&limit.to_ne_bytes(), &shadow_rays.to_ne_bytes(), bytemuck::cast_slice(&words)];
            self.keep(RADIANCE_DONE, 0, &parts);
        }
    }

    /// Returns for each chart whether its back is shown, from an earlier run.
    pub fn backs(&self, charts: usize) -> Result<Option<Vec<bool>>> {
        let Some(content) = self.take(BACKS, 0) else { return Ok(None) };
        let fits = content.is_empty() || content.len() == charts;
        fits.then(|| try_collect(content.iter().map(|&b| b != 0), "the sides of a checkpoint")).transpose()
    }

    pub fn keep_backs(&self, backs: &[bool]) {
        self.keep(BACKS, 0, &[bytemuck::cast_slice(backs)]);
    }

    /// Returns the light of `count` fallback gathers from an earlier run.
    pub fn own_light(&self, count: usize) -> Result<Option<OwnLight>> {
        let Some(content) = self.take(OWN, 0) else { return Ok(None) };
        if content.len() != count * size_of::<Vec3>() {
            return Ok(None);
        }
        // Texels inside solids are stored as infinite.
        let known = |v: Vec3| if v.x == f32::INFINITY { None } else { Some(v) };
        let values = content.chunks_exact(size_of::<Vec3>()).map(bytemuck::pod_read_unaligned::<Vec3>);
        let light = try_collect(values.map(known), "light of a checkpoint")?;
        Ok(light.iter().flatten().all(|&v| is_light(&[v])).then_some(light))
    }

    pub fn keep_own_light(&self, light: &OwnLight) {
        match try_collect(light.iter().map(|v| v.unwrap_or(Vec3::INFINITY)), "light of a checkpoint") {
            Ok(values) => self.keep(OWN, 0, &[bytemuck::cast_slice(&values)]),
            Err(e) => self.warn(&e),
        }
    }

    /// Returns the light by direction of `count` fallback gathers from an earlier run, which has light where `light` has.
    pub fn own_directional(&self, light: &OwnLight) -> Result<Option<OwnDirectional>> {
        let mut values: Vec<Directional> = try_vec(light.len(), "light of a checkpoint")?;
        if !self.directional(OWN_DIRECTIONAL, 0, &mut values) {
            return Ok(None);
        }
        let known = light.iter().zip(values).map(|(light, d)| light.map(|_| d));
        try_collect(known, "light of a checkpoint").map(Some)
    }

    pub fn keep_own_directional(&self, light: &OwnDirectional) {
        match try_collect(light.iter().map(|v| v.unwrap_or_default()), "light of a checkpoint") {
            Ok(values) => self.keep(OWN_DIRECTIONAL, 0, &[bytemuck::cast_slice(&values)]),
            Err(e) => self.warn(&e),
        }
    }

    /// Fills in the light by direction of a block if an earlier run has finished it; returns whether it has. `values` may
    /// be empty: then there is nothing to fill in.
    fn directional(&self, tag: Tag, block: usize, values: &mut [Directional]) -> bool {
        if values.is_empty() {
            return true;
        }
        let Some(content) = self.take(tag, block as u64) else { return false };
        let fits = content.len() == size_of_val(values) && take(&mut &content[..], values).is_some();
        fits && values.iter().all(Directional::is_possible)
    }

    fn keep_directional(&self, tag: Tag, block: usize, values: &[Directional]) {
        if !values.is_empty() {
            self.keep(tag, block as u64, &[bytemuck::cast_slice(values)]);
        }
    }

    /// Fills in a block of the gather map (irradiance, variance and validity of each texel) if an earlier run has
    /// finished it; returns whether it has.
    pub fn gathered(
        &self,
        block: usize,
        values: &mut [Vec3],
        variances: &mut [f32],
        valid: &mut [bool],
        directional: &mut [Directional],
    ) -> bool {
        let read = || {
            let content = self.take(GATHER, block as u64)?;
            let mut rest = &content[..];
            // These vectors are small: they hold one block.
            let (mut light, mut spread) = (vec![Vec3::ZERO; values.len()], vec![0f32; values.len()]);
            take(&mut rest, &mut light)?;
            take(&mut rest, &mut spread)?;
            let fits = rest.len() == values.len() && is_light(&light) && spread.iter().all(|&v| v >= 0.0);
            fits.then(|| (light, spread, rest.to_vec()))
        };
        let Some((light, spread, flags)) = read() else { return false };
        if !self.directional(GATHER_DIRECTIONAL, block, directional) {
            return false;
        }
        values.copy_from_slice(&light);
        variances.copy_from_slice(&spread);
        valid.iter_mut().zip(flags).for_each(|(valid, flag)| *valid = flag != 0);
        true
    }

    pub fn keep_gathered(
        &self,
        block: usize,
        values: &[Vec3],
        variances: &[f32],
        valid: &[bool],
        directional: &[Directional],
    ) {
        self.keep_directional(GATHER_DIRECTIONAL, block, directional);
        let parts = [bytemuck::cast_slice(values), bytemuck::cast_slice(variances), bytemuck::cast_slice(valid)];
        self.keep(GATHER, block as u64, &parts);
    }

    /// Fills in a block of direct light and the state of its texels if an earlier run has finished it; returns whether
    /// it has.
    pub(in crate::lightmap) fn lit(
        &self,
        block: usize,
        direct: &mut [Vec3],
        variances: &mut [f32],
        state: &mut [TexelState],
        directional: &mut [Directional],
    ) -> bool {
        let read = || {
            let content = self.take(DIRECT, block as u64)?;
            let mut rest = &content[..];
            let mut light = vec![Vec3::ZERO; direct.len()];
            take(&mut rest, &mut light)?;
            let mut noises = vec![0.0; variances.len()];
            take(&mut rest, &mut noises)?;
            let states = rest.iter().map(|&b| TexelState::from_byte(b)).collect::<Option<Vec<_>>>()?;
            let fits = states.len() == direct.len() && is_light(&light) && !states.contains(&TexelState::Unbaked);
            fits.then_some((light, noises, states))
        };
        let Some((light, noises, states)) = read() else { return false };
        if !self.directional(DIRECT_DIRECTIONAL, block, directional) {
            return false;
        }
        direct.copy_from_slice(&light);
        variances.copy_from_slice(&noises);
        state.copy_from_slice(&states);
        true
    }

    pub(in crate::lightmap) fn keep_lit(
        &self,
        block: usize,
        direct: &[Vec3],
        variances: &[f32],
        state: &[TexelState],
        directional: &[Directional],
    ) {
        self.keep_directional(DIRECT_DIRECTIONAL, block, directional);
        let states: Vec<u8> = state.iter().map(|s| s.to_byte()).collect();
        self.keep(DIRECT, block as u64, &[bytemuck::cast_slice(direct), bytemuck::cast_slice(variances), &states]);
    }

    /// Tells that work of another pass follows.
    pub fn begin_pass(&self, pass: u32) {
        self.pass.store(pass, Relaxed);
    }

    /// Returns the number of a record of the pass in progress.
    fn in_pass(&self, number: u64) -> u64 {
        number | u64::from(self.pass.load(Relaxed)) << PASS_SHIFT
    }

    fn take(&self, tag: Tag, number: u64) -> Option<Vec<u8>> {
        lock(&self.done).remove(&(tag, self.in_pass(number)))
    }

    fn keep(&self, tag: Tag, number: u64, parts: &[&[u8]]) {
        let number = self.in_pass(number).to_ne_bytes();
        let all: Vec<&[u8]> = [&number[..]].into_iter().chain(parts.iter().copied()).collect();
        let bytes = {
            let mut pending = lock(&self.pending);
            let mut appended = records::append(&mut pending.bytes, tag, &all);
            if appended.is_err() && !pending.bytes.is_empty() {
                // The pending records may take most of the memory: they are written, and it is tried again.
                let bytes = std::mem::take(&mut pending.bytes);
                self.write(&bytes);
                drop(bytes);
                appended = records::append(&mut pending.bytes, tag, &all);
            }
            if let Err(e) = appended {
                self.warn(&e);
                return;
            }
            if pending.since.elapsed() < self.interval {
                return;
            }
            pending.since = Instant::now();
            std::mem::take(&mut pending.bytes)
        };
        self.write(&bytes);
    }

    /// Writes the pending records.
    pub fn flush(&self) {
        let bytes = std::mem::take(&mut lock(&self.pending).bytes);
        self.write(&bytes);
    }

    /// Appends to the file. A bake does not fail because its checkpoint cannot be written: records already in the file
    /// stay valid, and later ones are still tried.
    fn write(&self, bytes: &[u8]) {
        if bytes.is_empty() {
            return;
        }
        // What was computed from a changed file must not be kept.
        if let Err(e) = self.scene.check_file() {
            self.warn(&e);
            return;
        }
        let mut output = lock(&self.file);
        let had_failed = output.failed;
        if let Err(e) = output.append(bytes) {
            // The rest is cut off at once, if possible, in case the process is killed before the next write.
            let _ = output.cut();
            drop(output);
            if !had_failed {
                self.warn(&e);
            }
        }
    }

    /// Logs that the checkpoint could not be written; the bake goes on.
    fn warn(&self, e: &dyn std::fmt::Display) {
        let message = format!("cannot write the checkpoint {}: {e}; the bake continues without", self.path.display());
        self.scene.device().log(LogLevel::Warning, &message);
    }
}

impl Drop for Checkpoint<'_> {
    /// Writes the pending records, whatever ends the bake: an error, a cancel or its completion.
    fn drop(&mut self) {
        self.flush();
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(|e| e.into_inner())
}

/// Opens or creates the file and locks it for one bake.
fn open_locked(path: &Path) -> Result<File> {
    let fail = |e| Error::Io(format!("cannot use the checkpoint {}: {e}", path.display()));
    // The kind of file is checked first, so that opening does not wait for the other end of a FIFO.
    if std::fs::metadata(path).is_ok_and(|m| !m.is_file()) {
        return Err(Error::Io(format!("cannot use the checkpoint {}: it is not a file", path.display())));
    }
    let file = OpenOptions::new().read(true).write(true).create(true).truncate(false).open(path).map_err(fail)?;
    match file.try_lock() {
        Err(TryLockError::WouldBlock) => {
            Err(Error::InvalidState(format!("the checkpoint {} is in use by another bake", path.display())))
        }
        // Some network file systems have no locks.
        Ok(()) | Err(TryLockError::Error(_)) => Ok(file),
    }
}

/// Whether the file consists of the beginning of `head`, and nothing else.
fn is_beginning_of(file: &mut File, head: &[u8]) -> std::io::Result<bool> {
    let mut bytes = Vec::new();
    file.take(head.len() as u64).read_to_end(&mut bytes)?;
    Ok(head.starts_with(&bytes))
}

/// Reads all whole records into `done`; returns the position of their end.
fn read(
    file: &File,
    size: u64,
    path: &Path,
    needed: &Fingerprint,
    done: &mut HashMap<(Tag, u64), Vec<u8>>,
) -> Result<u64> {
    let fail = |e| unreadable(path, e);
    let from = BufReader::with_capacity(1 << 16, file);
    let (mut records, found): (_, Fingerprint) = records::begin(from, size, HEAD, path, "checkpoint")?;
    if let Some(differences) = found.difference(needed) {
        return Err(foreign(path, &differences));
    }
    loop {
        match records.next().map_err(fail)? {
            Next::Record(tag, mut content) => {
                let number: u64 = take_one(&mut &content[..]).ok_or_else(|| damaged(path))?;
                content.drain(..8);
                let no_room = |_| Error::OutOfMemory(format!("the checkpoint {}", path.display()));
                done.try_reserve(1).map_err(no_room)?;
                done.insert((tag, number), content);
            }
            Next::End | Next::Torn => return Ok(records.whole),
            Next::Damaged(end) => {
                let whole = records.whole;
                // The position of the file may change, as it is not needed any more.
                let mut file = file;
                let torn = records::ends_in_zeros(&mut file, whole, end, size).map_err(fail)?;
                return if torn { Ok(whole) } else { Err(damaged(path)) };
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Cursor;

    /// A disk that takes so many bytes more, and may refuse to cut files.
    struct Disk {
        content: std::cell::RefCell<Cursor<Vec<u8>>>,
        room: usize,
        can_cut: bool,
    }

    impl Write for Disk {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            let n = bytes.len().min(self.room);
            if n == 0 {
                return Err(std::io::ErrorKind::StorageFull.into());
            }
            self.room -= n;
            self.content.get_mut().write(&bytes[..n])
        }

        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }

    impl Seek for Disk {
        fn seek(&mut self, to: SeekFrom) -> std::io::Result<u64> {
            self.content.get_mut().seek(to)
        }
    }

    impl Storage for Disk {
        fn set_len(&self, bytes: u64) -> std::io::Result<()> {
            if !self.can_cut {
                return Err(std::io::ErrorKind::PermissionDenied.into());
            }
            self.content.borrow_mut().get_mut().truncate(bytes as usize);
            Ok(())
        }

        fn sync_data(&self) -> std::io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn no_record_is_written_behind_one_that_was_torn() {
        let disk = Disk { content: Default::default(), room: 5, can_cut: false };
        let mut output = Output::new(disk, 0);
        output.append(b"one").unwrap();
        assert!(output.append(b"three").is_err());
        output.cut().unwrap_err();
        // There is room again, but the torn record is still there.
        output.file.room = 100;
        assert!(output.append(b"four").is_err());
        assert_eq!(output.file.content.borrow().get_ref(), b"oneth");
        output.file.can_cut = true;
        output.append(b"five").unwrap();
        output.append(b"six").unwrap();
        assert_eq!(output.file.content.borrow().get_ref(), b"onefivesix");
    }
}
