//! Unwraps of parts, kept on disk by their content: a part with the same triangles is not unwrapped again, whatever has
//! changed around it. A file holds the part itself beside its charts, so that two parts are never taken for one.
//!
//! Files are only ever made anew, as a whole. One that is damaged, or of another version, counts as not there.

use super::pieces::{CHARTS, Piece};
use super::welded::Geometry;
use crate::base::error::Result;
use crate::base::files;
use crate::base::memory::{try_collect, try_filled, try_with_capacity};
use crate::device::{Device, LogLevel};
use bytemuck::{cast_slice, pod_read_unaligned};
use std::hash::{DefaultHasher, Hasher};
use std::path::PathBuf;

/// First bytes of a file. What makes charts may change with each version.
const MAGIC: &[u8] = concat!("bk-unwrap ", env!("CARGO_PKG_VERSION"), "\n").as_bytes();

/// Greatest coordinate of a chart, in diagonals of its part.
const FARTHEST: f32 = 1e3;

/// The file of a part, and what it begins with.
pub(super) struct Entry {
    path: PathBuf,
    part: Vec<u8>,
    triangles: usize,
    farthest: f32,
}

impl Entry {
    /// Returns the entry of a part; `None` if the device keeps none.
    pub fn of(device: &Device, geometry: &Geometry) -> Result<Option<Entry>> {
        let Some(folder) = device.cache_folder() else { return Ok(None) };
        let Geometry { indices, positions, kinds, .. } = geometry;
        let sizes = [positions.len() as u64, indices.len() as u64];
        let parts: [&[u8]; 5] =
            [MAGIC, cast_slice(&sizes), cast_slice(positions), cast_slice(indices), cast_slice(kinds)];
        let mut part = try_with_capacity(parts.iter().map(|p| p.len()).sum(), CHARTS)?;
        parts.iter().for_each(|p| part.extend_from_slice(p));
        let mut hasher = DefaultHasher::new();
        hasher.write(&part);
        let path = folder.join(format!("{:016x}.unwrap", hasher.finish()));
        let far = positions
            .iter()
            .fold([glam::Vec3::INFINITY, glam::Vec3::NEG_INFINITY], |[low, high], &p| [low.min(p), high.max(p)]);
        let farthest = FARTHEST * (far[1] - far[0]).length();
        Ok(Some(Entry { path, part, triangles: indices.len(), farthest }))
    }

    /// Returns the charts of the part, whose triangles have these global numbers; `None` if they are not known.
    pub fn load(&self, numbers: &[u32]) -> Result<Option<Vec<Piece>>> {
        // Per triangle a chart of its own at most: its size, its number and its corners.
        let most = self.part.len() + 4 + self.triangles * (4 + 4 + 24) + 4;
        let Ok(file) = files::read(&self.path, most as u64) else { return Ok(None) };
        let Some(rest) = file.strip_prefix(&self.part[..]) else { return Ok(None) };
        let Some((charts, sum)) = rest.split_last_chunk::<4>() else { return Ok(None) };
        if crc32fast::hash(charts) != u32::from_ne_bytes(*sum) {
            return Ok(None);
        }
        self.pieces(charts, numbers)
    }

    fn pieces(&self, charts: &[u8], numbers: &[u32]) -> Result<Option<Vec<Piece>>> {
        let Some((count, mut rest)) = charts.split_first_chunk::<4>() else { return Ok(None) };
        let count = u32::from_ne_bytes(*count) as usize;
        if count > self.triangles {
            return Ok(None);
        }
        let mut pieces = try_with_capacity(count, CHARTS)?;
        let mut is_there = try_filled(self.triangles, false, CHARTS)?;
        for _ in 0..count {
            let Some((size, behind)) = rest.split_first_chunk::<4>() else { return Ok(None) };
            let size = u32::from_ne_bytes(*size) as usize;
            if size == 0 || size > self.triangles || behind.len() < size * (4 + 24) {
                return Ok(None);
            }
            let (triangles, behind) = behind.split_at(4 * size);
            let (corners, behind) = behind.split_at(24 * size);
            rest = behind;
            let triangles = try_collect(triangles.chunks_exact(4).map(pod_read_unaligned::<u32>), CHARTS)?;
            for (i, &t) in triangles.iter().enumerate() {
                let ascends = i == 0 || triangles[i - 1] < t;
                if !ascends || is_there.get(t as usize) != Some(&false) {
                    return Ok(None);
                }
                is_there[t as usize] = true;
            }
            let corners = try_collect(corners.chunks_exact(24).map(pod_read_unaligned::<[[f32; 2]; 3]>), CHARTS)?;
            // NaN, too.
            if !corners.as_flattened().as_flattened().iter().all(|x| x.abs() <= self.farthest) {
                return Ok(None);
            }
            let triangles = try_collect(triangles.iter().map(|&t| numbers[t as usize]), CHARTS)?;
            pieces.push(Piece { triangles: triangles.into(), corners: corners.into(), given: None });
        }
        Ok(rest.is_empty().then_some(pieces))
    }

    /// Keeps the charts of the part, whose triangles have these global numbers (ascending). A file that cannot be written is
    /// a warning.
    pub fn save(&self, pieces: &[Piece], numbers: &[u32], device: &Device) {
        if let Err(e) = self.write(pieces, numbers) {
            device.log(LogLevel::Warning, &format!("an unwrap is not kept: {e}"));
        }
    }

    fn write(&self, pieces: &[Piece], numbers: &[u32]) -> Result<()> {
        let size = 4 + pieces.iter().map(|p| 4 + 28 * p.triangles.len()).sum::<usize>();
        let mut charts = try_with_capacity(size, CHARTS)?;
        charts.extend_from_slice(&(pieces.len() as u32).to_ne_bytes());
        for piece in pieces {
            charts.extend_from_slice(&(piece.triangles.len() as u32).to_ne_bytes());
            for t in &piece.triangles {
                let place = numbers.binary_search(t).expect("a triangle of the part");
                charts.extend_from_slice(&(place as u32).to_ne_bytes());
            }
            charts.extend_from_slice(cast_slice(&piece.corners));
        }
        if let Some(folder) = self.path.parent().filter(|f| !f.exists()) {
            // (If that fails, so does the file in it, with a better message.)
            let _ = std::fs::create_dir_all(folder);
        }
        files::replace(&self.path, |file| {
            for part in [&self.part, &charts, &crc32fast::hash(&charts).to_ne_bytes()[..]] {
                file.append(part, |_| Ok(()))?;
            }
            Ok(())
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::files::Folder;
    use crate::base::progress::Progress;
    use crate::bvh::BuildOptions;
    use crate::device::DeviceOptions;
    use crate::lightmap::atlas::charts::tests::grid;
    use crate::lightmap::atlas::planar::planar_pieces;
    use crate::lightmap::{Lightmap, LightmapDesc};
    use crate::scene::{Material, Mesh, Scene, SceneData};
    use glam::Vec3;
    use std::path::Path;
    use std::sync::Arc;

    fn files(folder: &Folder) -> Vec<PathBuf> {
        folder.names().iter().map(|name| folder.0.join(name)).collect()
    }

    fn ground(shift: f32) -> Mesh {
        let mut mesh = grid(30, 20, |x, y| ((x * 7 + y * 5) % 9) as f32 * 0.1);
        mesh.positions.iter_mut().for_each(|p| *p += shift * Vec3::X);
        mesh
    }

    /// The charts of two curved grounds, the second shifted.
    fn charts(folder: Option<&Path>, shift: f32) -> (String, Arc<Scene>) {
        let options = DeviceOptions { num_threads: 2, cache_folder: folder.map(Into::into), ..Default::default() };
        let device = Device::new(options).unwrap();
        let mut data = SceneData::new();
        data.add_material(Material::default()).unwrap();
        data.add_mesh(ground(0.0)).unwrap();
        data.add_mesh(ground(shift)).unwrap();
        let scene = Scene::commit(&device, data, &BuildOptions::default(), &Progress::none()).map_err(|e| e.1).unwrap();
        let desc = LightmapDesc { texels_per_unit: 4.0, ..Default::default() };
        let lightmap = Lightmap::create(&scene, &desc, &Progress::none()).unwrap();
        let charts = &lightmap.atlas.charts;
        (format!("{:?} {:?} {:?}", charts.charts, charts.own.triangles, charts.own.corners), scene)
    }

    #[test]
    fn what_has_not_changed_is_not_unwrapped_again() {
        let folder = Folder::new("unwraps-same");
        let without = charts(None, 50.0).0;
        assert!(charts(Some(&folder.0), 50.0).0 == without, "a first run");
        let first = files(&folder);
        let times =
            |files: &[PathBuf]| files.iter().map(|f| f.metadata().unwrap().modified().unwrap()).collect::<Vec<_>>();
        let written = times(&first);
        assert_eq!(first.len(), 2);
        assert!(charts(Some(&folder.0), 50.0).0 == without && times(&files(&folder)) == written, "a second run");
        // One of two has moved.
        assert!(charts(Some(&folder.0), 60.0).0 == charts(None, 60.0).0);
        assert!(files(&folder).len() == 3 && times(&first) == written);
    }

    #[test]
    fn damaged_files_count_as_missing_and_are_made_anew() {
        let folder = Folder::new("unwraps-damaged");
        let without = charts(Some(&folder.0), 50.0).0;
        for path in files(&folder) {
            let whole = std::fs::read(&path).unwrap();
            let changes: [fn(&mut Vec<u8>); 6] = [
                |f| f.clear(),
                |f| f.truncate(f.len() / 2),
                |f| f[0] ^= 1,
                |f| *f.last_mut().unwrap() ^= 1,
                |f| {
                    let at = f.len() - 40;
                    f[at] ^= 1;
                },
                |f| f.push(0),
            ];
            for change in changes {
                let mut file = whole.clone();
                change(&mut file);
                std::fs::write(&path, file).unwrap();
                assert!(charts(Some(&folder.0), 50.0).0 == without && std::fs::read(&path).unwrap() == whole);
            }
        }
    }

    #[test]
    fn charts_that_cannot_be_are_refused_though_the_checksum_fits() {
        let folder = Folder::new("unwraps-forged");
        let (_, scene) = charts(Some(&folder.0), 50.0);
        let numbers: Vec<u32> = (0..scene.triangle_count() / 2).collect();
        let progress = Progress::none();
        let stage = progress.stage("unwrap", 0.0, 1.0, 1);
        let geometry = Geometry::of(&scene, &numbers, &stage).unwrap();
        let entry = Entry::of(scene.device(), &geometry).unwrap().unwrap();
        let pieces = planar_pieces(scene.device(), &geometry, &vec![true; numbers.len()], &stage).unwrap();
        entry.save(&pieces, &numbers, scene.device());
        let loaded = entry.load(&numbers).unwrap().unwrap();
        let content =
            |pieces: &[Piece]| pieces.iter().map(|p| format!("{:?} {:?}", p.triangles, p.corners)).collect::<Vec<_>>();
        assert!(content(&pieces) == content(&loaded));
        let whole = std::fs::read(&entry.path).unwrap();
        let at = entry.part.len();
        for (place, value) in [
            (at, 0),
            (at, u32::MAX),
            (at + 4, 0),
            (at + 4, 1 << 30),
            (at + 8, 7),
            (at + 8, u32::MAX),
            (whole.len() - 8, f32::NAN.to_bits()),
            (whole.len() - 8, f32::INFINITY.to_bits()),
            (whole.len() - 8, 1e30f32.to_bits()),
        ] {
            let mut file = whole.clone();
            file[place..place + 4].copy_from_slice(&value.to_ne_bytes());
            let end = file.len() - 4;
            let sum = crc32fast::hash(&file[at..end]);
            file[end..].copy_from_slice(&sum.to_ne_bytes());
            std::fs::write(&entry.path, file).unwrap();
            assert!(entry.load(&numbers).unwrap().is_none(), "{place}, {value}");
        }
    }

    #[test]
    fn a_folder_that_cannot_be_made_is_no_error() {
        let folder = Folder::new("unwraps-file");
        let file = folder.0.join("file");
        std::fs::write(&file, "a file").unwrap();
        assert!(charts(Some(&file.join("x")), 50.0).0 == charts(None, 50.0).0);
    }
}
