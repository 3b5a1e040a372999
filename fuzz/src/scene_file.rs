//! Scene files with words changed and all checksums put right: whatever is accepted can be traced, refitted and saved.

use bakelite::bvh::BuildOptions;
use bakelite::scene::{OpenOptions, builtin};
use bakelite::trace::Ray;
use bakelite::{Device, DeviceOptions, Error, Progress, Scene};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Sizes of the foot and of an entry of the table (docs/scene_file.md).
const FOOT: usize = 32;
const ENTRY: usize = 24;

/// True files of a small scene, one with a full tree and one with a compact tree.
pub struct SceneFile {
    device: Arc<Device>,
    files: [Vec<u8>; 2],
    /// Where damaged ones are put.
    input: PathBuf,
}

fn number<const N: usize>(file: &[u8], at: usize) -> Option<[u8; N]> {
    file.get(at..at.checked_add(N)?)?.try_into().ok()
}

/// Makes all checksums fit, as far as there is a table.
fn seal(file: &mut [u8]) -> Option<()> {
    let foot = file.len().checked_sub(FOOT)?;
    let table = u64::from_le_bytes(number(file, foot)?) as usize;
    let sections = u32::from_le_bytes(number(file, foot + 16)?) as usize;
    for i in 0..sections.min(64) {
        let entry = table.checked_add(i * ENTRY)?;
        let offset = u64::from_le_bytes(number(file, entry + 8)?) as usize;
        let bytes = u64::from_le_bytes(number(file, entry + 16)?) as usize;
        if let Some(section) = file.get(offset..offset.saturating_add(bytes)) {
            let sum = crc32fast::hash(section);
            file.get_mut(entry + 4..entry + 8)?.copy_from_slice(&sum.to_le_bytes());
        }
    }
    let mut sum = crc32fast::Hasher::new();
    sum.update(file.get(..16)?);
    sum.update(file.get(table..foot)?);
    sum.update(file.get(foot..foot + 20)?);
    file[foot + 20..foot + 24].copy_from_slice(&sum.finalize().to_le_bytes());
    Some(())
}

impl SceneFile {
    /// Files of the Cornell box; damaged ones are put into `folder`.
    pub fn of_room(folder: &Path) -> SceneFile {
        let device = Device::new(DeviceOptions { num_threads: 1, ..Default::default() }).expect("a device");
        let truth = folder.join("true.bkscene");
        let files = [false, true].map(|compact| {
            let options = BuildOptions { compact, ..Default::default() };
            let scene = Scene::commit(&device, builtin("cornell").expect("a scene"), &options, &Progress::none());
            scene.map_err(|e| e.1).expect("a scene").save(&truth, &Progress::none()).expect("a file");
            std::fs::read(&truth).expect("a file")
        });
        SceneFile { device, files, input: folder.join("input.bkscene") }
    }

    /// Opens a true file with changes: a byte that says which file, then eight each, of a place and what is written there.
    pub fn open(&self, changes: &[u8]) {
        let (&which, mut rest) = changes.split_first().unwrap_or((&0, &[]));
        let mut file = self.files[usize::from(which & 1)].clone();
        while let Some((&[a, b, c, d, ref word @ ..], more)) = rest.split_first_chunk::<8>() {
            let at = 4 * (u32::from_le_bytes([a, b, c, d]) as usize % (file.len() / 4));
            file[at..at + 4].copy_from_slice(word);
            rest = more;
        }
        // A new file: nobody has it mapped.
        let _ = std::fs::remove_file(&self.input);
        let _ = seal(&mut file);
        std::fs::write(&self.input, &file).expect("a file");
        let options = OpenOptions { map: which & 2 == 0, ray_queues: which & 4 != 0 };
        let mut scene = match Scene::open(&self.device, &self.input, &options, &Progress::none()) {
            Ok(scene) => scene,
            Err(e) => return assert!(matches!(e, Error::Io(_) | Error::OutOfMemory(_)), "{e}"),
        };
        let ray = |i: u32| {
            let [x, y, z] = [1, 3, 9].map(|k| (i * k % 16) as f32 / 8.0 - 1.0);
            Ray { origin: [0.5 * x, 0.5 * y, 0.5 * z], tmin: 0.0, direction: [y, z, 1.0], tmax: f32::INFINITY }
        };
        let rays: Vec<Ray> = (0..64).map(ray).collect();
        let mut hits = vec![scene.intersect(&rays[0]); rays.len()];
        scene.intersect_many(&rays, false, &mut hits).expect("as many hits as rays");
        for hit in hits.iter().filter(|hit| hit.triangle != u32::MAX) {
            assert!((hit.mesh as usize) < scene.meshes().len());
        }
        let _ = rays.iter().filter(|ray| scene.occluded(ray)).count();
        if let Some(mesh) = scene.meshes().first() {
            let positions = mesh.positions.to_vec();
            let _ = Scene::refit(&mut scene, &[(0, &positions)]);
        }
        let again = self.input.with_extension("again");
        scene.save(&again, &Progress::none()).expect("a file");
        Scene::open(&self.device, &again, &options, &Progress::none()).expect("what was saved can be opened");
    }
}
