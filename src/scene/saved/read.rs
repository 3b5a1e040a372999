//! Opening a saved scene.
//!
//! All bytes are read once, for checksums and for the checks without which a damaged file could make kernels read beyond
//! arrays: they index without checks of their own.

use super::format::*;
use crate::base::array::{Array, Mapping};
use crate::base::error::{Error, Result};
use crate::base::files;
use crate::base::geometry::NONE;
use crate::base::memory::{Reservation, prefer_large_pages, try_collect, try_to_vec, try_with_capacity};
use crate::base::progress::Progress;
use crate::base::watched_file::WatchedFile;
use crate::bvh::instances::MeshTree;
use crate::bvh::{BuildOptions, Compact, Mbvh, Tree};
use crate::device::Device;
use crate::scene::build::{Built, Parts, bytes_of_instances};
use crate::scene::waiting::WaitingRays;
use crate::scene::{
    Environment, Instance, LightmapUvs, Mesh, MeshMaterials, Scene, SceneData, Texture, instance_trees,
};
use bytemuck::AnyBitPattern;
use glam::{Affine3A, Vec2, Vec3};
use memmap2::{MmapMut, MmapOptions};
use rayon::prelude::*;
use std::io::{self, Read};
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

/// How a scene file is opened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OpenOptions {
    /// Whether the file takes the place of memory: parts are read when they are needed, and the system drops them when it
    /// needs the memory; what a refit changes stays in memory. While the scene lives, the file must not be changed or cut
    /// short (saving under its name is fine). Otherwise the file is read once, and rays are faster by what large pages
    /// bring. Default: true.
    pub map: bool,
    /// Whether rays wait at parts of the tree until enough of them do, for scenes that are larger than memory: then a part
    /// is read for many rays at once. The scene has threads of its own for that, 128 per thread of the device but no more
    /// than 512 that bring rays, and no more than 64 that trace them. Hits and light stay the same, bit for bit. Other
    /// scenes take longer so, and a cancel is noticed when the rays that wait have been traced. A refit brings all to
    /// memory, and ends it. Default: false.
    pub ray_queues: bool,
}

impl Default for OpenOptions {
    fn default() -> Self {
        OpenOptions { map: true, ray_queues: false }
    }
}

/// Name of this memory in error messages.
const FILE: &str = "a scene file";

/// Number of bytes that a thread checks at a time.
const PART: usize = 4 << 20;

impl Scene {
    /// Opens a scene that [`save`](Scene::save) has written. Nothing is built: what rays hit, and all light, has the bits of
    /// the scene that was saved. A file that is damaged, or that another version or a machine of another byte order wrote,
    /// is refused.
    ///
    /// Reads all of the file once, at the speed of disk and memory.
    pub fn open(device: &Arc<Device>, path: &Path, options: &OpenOptions, progress: &Progress) -> Result<Arc<Scene>> {
        let start = Instant::now();
        let scene = device.run(progress, || {
            let file = File::open(device, path, options, progress)?;
            let mut scene = file.scene(device, path, start)?;
            if options.ray_queues {
                scene.parts = Some(Box::new(WaitingRays::of(&scene)?));
            }
            Ok(scene)
        })?;
        scene.warn_of_few_digits();
        device.log_info(|| {
            let s = scene.stats();
            let (mapped, seconds) = (s.mapped_bytes, s.build_seconds);
            format!("opened {} triangles: {} bytes, {mapped} of them mapped, {seconds:.3} s", s.triangles, s.bytes)
        });
        Ok(Arc::new(scene))
    }
}

fn damaged(path: &Path, what: &str) -> Error {
    Error::Io(format!("{} is damaged: {what}", path.display()))
}

/// A file whose checksums fit.
struct File {
    map: Arc<Mapping>,
    table: Vec<Entry>,
    /// The file, if it is mapped.
    mapped: Option<WatchedFile>,
    memory: Reservation,
}

impl File {
    fn open(device: &Device, path: &Path, options: &OpenOptions, progress: &Progress) -> Result<File> {
        let fail = |e: io::Error| Error::Io(format!("cannot read {}: {e}", path.display()));
        let refused = |e: io::Error| match e.kind() {
            io::ErrorKind::OutOfMemory => Error::OutOfMemory(format!("there is no memory for {}", path.display())),
            _ => fail(e),
        };
        let mut file = files::open(path).map_err(fail)?;
        let size = file.metadata().map_err(fail)?.len();
        let another_kind = || Error::Io(format!("{} is no scene file", path.display()));
        if size < (size_of::<Head>() + size_of::<Foot>()) as u64 {
            return Err(another_kind());
        }
        let bytes = usize::try_from(size).map_err(|_| damaged(path, "it is too large"))?;
        // (As it is before it is checked.)
        let watched = if options.map {
            Some(file.try_clone().and_then(|f| WatchedFile::new(f, path)).map_err(fail)?)
        } else {
            None
        };
        let memory = device.memory().reserve(if options.map { 0 } else { bytes }, FILE)?;
        let map = if options.map {
            // SAFETY: what `OpenOptions::map` asks of the caller. (Writes to a private map stay in memory.)
            unsafe { MmapOptions::new().no_reserve_swap().map_copy(&file) }.map_err(refused)?
        } else {
            let mut map = MmapMut::map_anon(bytes).map_err(refused)?;
            prefer_large_pages(&map[..]);
            for part in map.chunks_mut(PART) {
                progress.check()?;
                file.read_exact(part).map_err(fail)?;
            }
            map
        };
        let head: Head = bytemuck::pod_read_unaligned(&map[..size_of::<Head>()]);
        if head.magic != MAGIC {
            return Err(another_kind());
        }
        if head.byte_order != BYTE_ORDER || head.version != VERSION {
            let what = "is a scene file of another version, or of a machine with another order of bytes";
            return Err(Error::Io(format!("{} {what}", path.display())));
        }
        let table = table(&map, &head).ok_or_else(|| damaged(path, "its end is missing, or its table is wrong"))?;
        let stage = progress.stage("checking", 0.0, 0.9, size);
        for entry in &table {
            let section = &map[entry.offset as usize..][..entry.bytes as usize];
            let sum = |part: &[u8]| {
                let mut sum = crc32fast::Hasher::new();
                sum.update(part);
                stage.advance(part.len() as u64)?;
                Ok(sum)
            };
            let join = |mut first: crc32fast::Hasher, then: crc32fast::Hasher| {
                first.combine(&then);
                Ok(first)
            };
            let sum = section.par_chunks(PART).map(sum).try_reduce_with(join).transpose()?;
            if sum.map_or(0, crc32fast::Hasher::finalize) != entry.checksum {
                return Err(damaged(path, "a checksum does not fit"));
            }
        }
        progress.check()?;
        // Rays need a page here and a page there. (Systems that read 8 MB around each would read little else where the scene
        // does not fit into memory.)
        #[cfg(unix)]
        if options.map {
            let _ = map.advise(memmap2::Advice::Random);
        }
        Ok(File { map: Arc::new(Mapping::new(map)), table, mapped: watched, memory })
    }

    /// Returns all elements of a section, which may be asked for once.
    fn section<T: AnyBitPattern>(&self, kind: Kind) -> Option<Section<'_, T>> {
        let entry = self.table.iter().find(|e| e.kind == kind as u32);
        let (offset, bytes) = entry.map_or((0, 0), |e| (e.offset as usize, e.bytes as usize));
        let is_whole = bytes.is_multiple_of(size_of::<T>()) && offset.is_multiple_of(align_of::<T>());
        is_whole.then_some(Section { map: &self.map, offset, left: bytes / size_of::<T>(), of: Default::default() })
    }

    /// Returns the records of a section.
    fn records<T: AnyBitPattern>(&self, kind: Kind) -> Option<Array<T>> {
        let mut section = self.section(kind)?;
        section.take(section.left as u64)
    }

    fn scene(mut self, device: &Arc<Device>, path: &Path, start: Instant) -> Result<Scene> {
        let what = |e: Error| match e {
            Error::InvalidArgument(e) | Error::InvalidState(e) => damaged(path, &e),
            e => e,
        };
        let missing = || damaged(path, "the lengths of its sections do not fit");
        let images = |e: &&Entry| [Kind::Texels as u32, Kind::Pixels as u32].contains(&e.kind);
        let copied: u64 = self.table.iter().filter(images).map(|e| e.bytes).sum();
        self.memory.grow(self.memory.bytes() + copied as usize, FILE)?;
        let data = self.data().map_err(what)?.ok_or_else(missing)?;
        let (first_triangle, trees) = (data.first_triangles()?, self.records::<SavedTree>(Kind::Trees));
        let of_instances = bytes_of_instances(&data, &first_triangle)
            + instance_trees::estimated_bytes_of_places(data.instances().len(), &BuildOptions::default());
        self.memory.grow(self.memory.bytes() + of_instances, FILE)?;
        let trees = trees.ok_or_else(missing)?;
        let mut arrays = Trees {
            nodes: self.section(Kind::Nodes).ok_or_else(missing)?,
            leaves: self.section(Kind::Leaves).ok_or_else(missing)?,
            compact_nodes: self.section(Kind::CompactNodes).ok_or_else(missing)?,
            compact_leaves: self.section(Kind::CompactLeaves).ok_or_else(missing)?,
            skipped: self.section(Kind::Skipped).ok_or_else(missing)?,
        };
        let mut trees = trees.iter();
        let own = trees.next().filter(|t| t.mesh == NONE).ok_or_else(missing)?;
        let ranges = &first_triangle[..=data.meshes.len()];
        let (tree, skipped) = arrays.next(own, ranges).map_err(what)?.ok_or_else(missing)?;
        let mut of_meshes = try_with_capacity(instance_trees::instanced(&data).count(), FILE)?;
        for mesh in instance_trees::instanced(&data) {
            let saved = trees.next().filter(|t| t.mesh == mesh).ok_or_else(missing)?;
            let range = [0, data.meshes[mesh as usize].indices.len() as u32];
            let (tree, skipped) = arrays.next(saved, &range).map_err(what)?.ok_or_else(missing)?;
            let gone = saved.gone.min(u64::from(range[1])) as usize;
            let is_refitted = saved.is_refitted != 0;
            of_meshes.push(MeshTree { mesh, range, tree, skipped, gone, is_refitted });
        }
        if trees.next().is_some() || !arrays.are_used_up() {
            return Err(missing());
        }
        let trees = || [&tree].into_iter().chain(of_meshes.iter().map(|t| &t.tree));
        if !trees().zip([ranges].into_iter().chain(of_meshes.iter().map(|t| &t.range[..]))).all(|(tree, ranges)| {
            let triangles = *ranges.last().expect("never empty") as usize;
            match tree {
                Tree::Whole(t) => t.is_sound(triangles),
                Tree::Compact(t) => triangles > 0 && t.is_sound(triangles),
            }
        }) {
            return Err(damaged(path, "a tree in it is none"));
        }
        let is_refitted = own.is_refitted != 0;
        let own_gone = own.gone.min(data.own_triangles as u64) as usize;
        let gone = own_gone + of_meshes.iter().map(|t| t.gone).sum::<usize>();
        let instances = match of_meshes.is_empty() {
            true => None,
            false => Some(instance_trees::place(&data, &first_triangle, of_meshes, &Progress::none())?),
        };
        let built = Built { first_triangle, tree, skipped, instances, sah_cost: own.sah_cost };
        let mut parts = Parts::of(&data, built, self.memory, start)?;
        parts.stats.skipped_degenerate += gone as u64;
        parts.stats.build_seconds = start.elapsed().as_secs_f64();
        let mut scene = parts.into_scene(device.clone(), data);
        scene.is_refitted = is_refitted;
        let is_in_place = |e: &&Entry| IN_PLACE.iter().any(|&kind| kind as u32 == e.kind);
        if self.mapped.is_some() {
            scene.stats.mapped_bytes = self.table.iter().filter(is_in_place).map(|e| e.bytes).sum();
        }
        scene.file = self.mapped.take();
        scene.check_file()?;
        Ok(scene)
    }

    /// Reads what the caller of the saved scene had described; `None` if lengths do not fit.
    fn data(&self) -> Result<Option<SceneData>> {
        let mut data = SceneData::new();
        if self.images(&mut data)?.is_none() {
            return Ok(None);
        }
        let Some(materials) = self.records::<SavedMaterial>(Kind::Materials) else { return Ok(None) };
        for material in &materials {
            data.add_material(material.material())?;
        }
        if self.meshes(&mut data)?.is_none() {
            return Ok(None);
        }
        let Some(instances) = self.records::<SavedInstance>(Kind::Instances) else { return Ok(None) };
        for i in &instances {
            data.add_instance(Instance::new(i.mesh, Affine3A::from_cols_array(&i.transform)))?;
        }
        let Some(shared) = self.records::<SavedSharedLight>(Kind::SharedLight) else { return Ok(None) };
        for &SavedSharedLight { instance, of } in &shared[..] {
            data.share_light(instance, of)?;
        }
        let Some(lights) = self.records::<SavedLight>(Kind::Lights) else { return Ok(None) };
        for saved in &lights {
            let Some(light) = saved.light() else { return Ok(None) };
            // As it was, and not normalised once more, which might change its last bits.
            data.add_light(light)?;
            let last = data.lights.last_mut().expect("just added");
            if !SavedLight::new(last).is_nearly(saved) {
                return Ok(None);
            }
            *last = light;
        }
        data.check_own_triangles()?;
        Ok(Some(data))
    }

    fn images(&self, data: &mut SceneData) -> Result<Option<()>> {
        let (Some(textures), Some(mut texels)) = (self.records(Kind::Textures), self.section(Kind::Texels)) else {
            return Ok(None);
        };
        for &SavedImage { width, height } in &textures {
            let Some(part) = texels.take(u64::from(width) * u64::from(height)) else { return Ok(None) };
            data.add_texture(Texture { width, height, rgba8: try_to_vec(&part, "a texture")? })?;
        }
        let (Some(images), Some(mut pixels)) = (self.records(Kind::Environments), self.section(Kind::Pixels)) else {
            return Ok(None);
        };
        for &SavedImage { width, height } in &images {
            let Some(part) = pixels.take(u64::from(width) * u64::from(height)) else { return Ok(None) };
            data.add_environment(Environment::new(width, height, try_to_vec(&part, "an environment")?)?);
        }
        Ok((texels.left == 0 && pixels.left == 0).then_some(()))
    }

    fn meshes(&self, data: &mut SceneData) -> Result<Option<()>> {
        let sections = || {
            Some(Meshes {
                meshes: self.records(Kind::Meshes)?,
                positions: self.section(Kind::Positions)?,
                indices: self.section(Kind::Indices)?,
                normals: self.section(Kind::Normals)?,
                uvs: self.section(Kind::Uvs)?,
                lightmap_uvs: self.section(Kind::LightmapUvs)?,
                pages: self.section(Kind::LightmapPages)?,
                materials: self.section(Kind::TriangleMaterials)?,
            })
        };
        let Some(mut sections) = sections() else { return Ok(None) };
        for m in std::mem::take(&mut sections.meshes).iter() {
            let Some(mesh) = sections.next(m) else { return Ok(None) };
            let number = data.add_mesh(mesh)?;
            data.meshes[number as usize].strict = m.flags & IS_STRICT != 0;
        }
        Ok(sections.are_used_up().then_some(()))
    }
}

/// What is left of the sections of meshes.
struct Meshes<'a> {
    meshes: Array<SavedMesh>,
    positions: Section<'a, Vec3>,
    indices: Section<'a, [u32; 3]>,
    normals: Section<'a, Vec3>,
    uvs: Section<'a, Vec2>,
    lightmap_uvs: Section<'a, Vec2>,
    pages: Section<'a, u32>,
    materials: Section<'a, u32>,
}

impl Meshes<'_> {
    /// Takes the next mesh; `None` if there is not so much left.
    fn next(&mut self, m: &SavedMesh) -> Option<Mesh> {
        let has = |flag: u32, count: u64| if m.flags & flag != 0 { count } else { 0 };
        Some(Mesh {
            positions: self.positions.take(m.vertices)?,
            indices: self.indices.take(m.triangles)?,
            normals: self.normals.take(has(HAS_NORMALS, m.vertices))?,
            uvs: self.uvs.take(has(HAS_UVS, m.vertices))?,
            lightmap: match m.flags & HAS_LIGHTMAP_UVS {
                0 => None,
                _ => Some(LightmapUvs {
                    uvs: self.lightmap_uvs.take(m.vertices)?,
                    pages: self.pages.take(has(HAS_LIGHTMAP_PAGES, m.triangles))?,
                }),
            },
            materials: match m.flags & HAS_TRIANGLE_MATERIALS {
                0 => MeshMaterials::One(m.material),
                _ => MeshMaterials::PerTriangle(self.materials.take(m.triangles)?),
            },
            // Vertices may have left their places since they were checked.
            strict: false,
        })
    }

    fn are_used_up(&self) -> bool {
        let of_vertices = [self.positions.left, self.normals.left, self.uvs.left, self.lightmap_uvs.left];
        of_vertices == [0; 4] && [self.indices.left, self.pages.left, self.materials.left] == [0; 3]
    }
}

/// Returns the sections of a file, whose bytes lie apart; `None` if that is no table.
fn table(file: &[u8], head: &Head) -> Option<Vec<Entry>> {
    let foot_at = file.len() - size_of::<Foot>();
    let foot: Foot = bytemuck::pod_read_unaligned(&file[foot_at..]);
    let table = usize::try_from(foot.table).ok()?;
    (foot.magic == MAGIC && foot.bytes == file.len() as u64 && foot.sections <= KINDS).then_some(())?;
    (table.checked_add(foot.sections as usize * size_of::<Entry>())? == foot_at).then_some(())?;
    let entries = file[table..foot_at].chunks_exact(size_of::<Entry>()).map(bytemuck::pod_read_unaligned);
    let entries: Vec<Entry> = try_collect(entries, FILE).ok()?;
    (foot.checksum == foot.checksum_with(head, &entries)).then_some(())?;
    let (mut end, mut seen) = (size_of::<Head>() as u64, 0u64);
    for e in &entries {
        let is_new = (1..=KINDS).contains(&e.kind) && seen >> e.kind & 1 == 0;
        (is_new && e.offset.is_multiple_of(ALIGN) && e.offset >= end).then_some(())?;
        seen |= 1 << e.kind;
        end = e.offset.checked_add(e.bytes)?;
    }
    (end <= foot.table).then_some(entries)
}

/// What is left of a section.
struct Section<'a, T> {
    map: &'a Arc<Mapping>,
    offset: usize,
    left: usize,
    of: std::marker::PhantomData<T>,
}

impl<T: AnyBitPattern> Section<'_, T> {
    /// Takes the next `count` elements; `None` if there are fewer.
    fn take(&mut self, count: u64) -> Option<Array<T>> {
        let count = usize::try_from(count).ok().filter(|&count| count <= self.left)?;
        if count == 0 {
            return Some(Array::default());
        }
        // SAFETY: any bits are an element. No two sections have bytes in common, each is asked for once, and what is taken
        // is left out from then on.
        let taken = unsafe { Array::mapped(self.map, self.offset, count) }?;
        self.offset += count * size_of::<T>();
        self.left -= count;
        Some(taken)
    }
}

/// What is left of the sections of trees.
struct Trees<'a> {
    nodes: Section<'a, crate::bvh::Node>,
    leaves: Section<'a, f32>,
    compact_nodes: Section<'a, crate::bvh::compact::CompactNode>,
    compact_leaves: Section<'a, u32>,
    skipped: Section<'a, u32>,
}

impl Trees<'_> {
    /// Takes the next tree, of meshes whose triangles have these `ranges` of numbers, and the triangles that are not in it;
    /// `None` if lengths or numbers do not fit.
    fn next(&mut self, saved: &SavedTree, ranges: &[u32]) -> Result<Option<(Tree, Vec<u32>)>> {
        let triangles = *ranges.last().expect("never empty");
        let bounds = (Vec3::from(saved.lower), Vec3::from(saved.upper));
        let tree = match saved.is_compact {
            0 => match (self.nodes.take(saved.nodes), self.leaves.take(saved.leaves)) {
                (Some(nodes), Some(leaves)) => Tree::Whole(Mbvh { nodes, leaves, bounds }),
                _ => return Ok(None),
            },
            1 if triangles > 0 => {
                match (self.compact_nodes.take(saved.nodes), self.compact_leaves.take(saved.leaves)) {
                    (Some(nodes), Some(leaves)) => Tree::Compact(Compact::new(nodes, leaves, bounds, ranges)?),
                    _ => return Ok(None),
                }
            }
            _ => return Ok(None),
        };
        let Some(skipped) = self.skipped.take(saved.skipped) else { return Ok(None) };
        let ascend = skipped.windows(2).all(|pair| pair[0] < pair[1]) && skipped.last().is_none_or(|&t| t < triangles);
        Ok(match ascend {
            true => Some((tree, try_to_vec(&skipped, FILE)?)),
            false => None,
        })
    }

    fn are_used_up(&self) -> bool {
        let trees = [self.nodes.left, self.leaves.left, self.compact_nodes.left, self.compact_leaves.left];
        trees == [0; 4] && self.skipped.left == 0
    }
}
