//! Commit: checks the triangles, builds the acceleration structure and records which features the scene uses.

use super::committed::{SceneStats, Uses, object_of};
use super::emitters::{EMITTERS, add_emitters, emissive_triangles};
use super::instance_trees;
use super::kept_trees::{EarlierTrees, KeptTree};
use super::precision::too_few_digits;
use super::{Emitter, Material, Mesh, MeshMaterials, NONE, Scene, SceneData, is_valid_triangle};
use crate::base::error::{Error, Result};
use crate::base::geometry::MAX_COORDINATE;
use crate::base::memory::{Reservation, try_with_capacity};
use crate::base::progress::Progress;
use crate::base::scratch_files::{LEAST_IN_SCRATCH, Storage};
use crate::bvh::instances::Instances;
use crate::bvh::{self, BuildOptions, BuildStorage, References, Tree};
use crate::device::{Device, LogLevel};
use glam::Vec3;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, RwLock};
use std::time::Instant;

/// Minimum offset of rays from surfaces at which a warning is logged, as a fraction of the scene's diagonal. (The
/// Cornell box at 1,000 times its size from the origin: 1/900, irradiance wrong by 0.7 %; at 10,000: 14 %.)
const OFFSET_PART: f32 = 1.0 / 256.0;

impl Uses {
    fn of(data: &SceneData) -> Uses {
        // Cut-outs need texels that are less opaque than the cutoff.
        let has_holes = |m: &Material| {
            m.alpha_cutoff > 0.0
                && data.textures.get(m.albedo_texture as usize).is_some_and(|t| t.least_alpha() < m.alpha_cutoff)
        };
        let could: Vec<bool> = data.materials.iter().map(has_holes).collect();
        let (mut uses, mut holes) = (Uses::default(), false);
        for mesh in data.meshes.iter().filter(|m| !m.indices.is_empty()) {
            let mut note = |id: u32| {
                let material = &data.materials[id as usize];
                let has_uvs = !mesh.uvs.is_empty();
                uses.textures |= has_uvs && material.albedo_texture != NONE;
                holes |= has_uvs && could[id as usize];
                uses.transmission |= material.transmits();
                uses.solids |= !material.two_sided && !material.transmits();
            };
            match &mesh.materials {
                MeshMaterials::One(id) => note(*id),
                MeshMaterials::PerTriangle(ids) => ids.iter().for_each(|id| note(*id)),
            }
        }
        uses.holes = if holes { could } else { Vec::new() };
        uses
    }
}

impl Scene {
    /// Builds the acceleration structure. On an error, a panic included, `data` is returned unchanged.
    // Called once per scene: the returned error may be large.
    #[allow(clippy::result_large_err)]
    pub fn commit(
        device: &Arc<Device>,
        data: SceneData,
        options: &BuildOptions,
        progress: &Progress,
    ) -> std::result::Result<Arc<Scene>, (SceneData, Error)> {
        Self::commit_with(device, data, options, None, progress)
    }

    /// Commits a scene as [`commit`](Self::commit) does, and takes over trees of an `earlier` one of any device: that of
    /// the meshes without instances, if these have the same triangles in the same order, and that of each mesh with
    /// instances that had the same triangles and some instance there. Placement, materials and all else may be others.
    /// Trees in which a refit has moved a mesh, or that are compact where `options` asks for full ones (or the other way
    /// round), are built anew. Other options are those with which the trees were built. Rays hit the same as without, but
    /// for what [`BuildOptions::compact`] says of spatial splits.
    #[allow(clippy::result_large_err)]
    pub fn commit_from(
        device: &Arc<Device>,
        data: SceneData,
        options: &BuildOptions,
        earlier: &Scene,
        progress: &Progress,
    ) -> std::result::Result<Arc<Scene>, (SceneData, Error)> {
        Self::commit_with(device, data, options, Some(earlier), progress)
    }

    #[allow(clippy::result_large_err)]
    fn commit_with(
        device: &Arc<Device>,
        mut data: SceneData,
        options: &BuildOptions,
        earlier: Option<&Scene>,
        progress: &Progress,
    ) -> std::result::Result<Arc<Scene>, (SceneData, Error)> {
        // The build changes nothing but where arrays of `data` lie, and a panic drops everything that the build has made.
        let build = AssertUnwindSafe(|| {
            device.run(progress, || {
                data.check_own_triangles()?;
                if device.has_scratch() {
                    let _held = device.memory().reserve(data.bytes_in_memory(), "the scene")?;
                    device.install(|| data.move_to(device.storage(), progress))?;
                }
                let build = || Self::build(device, &data, options, earlier, progress);
                earlier.map_or_else(build, |earlier| earlier.while_unchanged(build))
            })
        });
        let built = catch_unwind(build).unwrap_or_else(|payload| Err(Error::of_panic(payload)));
        match built {
            Ok(parts) => {
                let scene = Arc::new(parts.into_scene(device.clone(), data));
                scene.warn_of_few_digits();
                device.log_info(|| {
                    let s = scene.stats();
                    format!("committed {} triangles: {} bytes, {:.3} s", s.triangles, s.bytes, s.build_seconds)
                });
                Ok(scene)
            }
            Err(e) => Err((data, e)),
        }
    }

    /// Logs a warning if the scene lies so far from the origin, for its size, that light is inaccurate.
    pub(super) fn warn_of_few_digits(&self) {
        if let Some(message) = too_few_digits(self, "a scene with a diagonal", self.diagonal(), OFFSET_PART) {
            self.device.log(LogLevel::Warning, &message);
        }
    }

    fn build(
        device: &Arc<Device>,
        data: &SceneData,
        options: &BuildOptions,
        earlier: Option<&Scene>,
        progress: &Progress,
    ) -> Result<Parts> {
        let start = Instant::now();
        let total = data.triangle_count();
        if total == 0 {
            return Err(Error::InvalidState("the scene has no triangles".into()));
        }
        let stage = progress.stage("bvh", 0.0, 1.0, 1);
        let first_triangle = data.first_triangles()?;
        let own = data.own_triangles;
        options.validate()?;
        let work = device.files_for_work();
        let storage = BuildStorage::new(device.storage(), Storage::new(work.as_ref()), options);
        // Of small trees some arrays are in memory.
        let is_in_memory = |triangles: usize| !storage.work.is_files() || triangles < LEAST_IN_SCRATCH;
        let estimate = if is_in_memory(own) { bvh::estimated_bytes(own, options) } else { 0 }
            + instance_trees::estimated_bytes(data, options, is_in_memory);
        let of_instances = bytes_of_instances(data, &first_triangle);
        let memory = device.memory().reserve(data.bytes_in_memory() + of_instances + estimate, "the scene")?;
        let earlier = earlier.map(|e| device.install(|| EarlierTrees::of(e, options.compact, storage.tree, progress)));
        let earlier = earlier.transpose()?;
        let build = || instance_trees::build(data, &first_triangle, options, storage, earlier.as_ref(), progress);
        let instances = device.install(build)?;
        let of_own = &first_triangle[..=data.meshes.len()];
        let kept = earlier.as_ref().map(|e| device.install(|| e.own(data, of_own))).transpose()?.flatten();
        let KeptTree { tree, skipped, sah_cost } = match kept {
            Some(kept) => kept,
            None => device.install(|| own_tree(data, &first_triangle, options, storage, progress))?,
        };
        progress.check()?;
        if tree.is_nothing() && !instances.as_ref().is_some_and(Instances::are_hit) {
            return Err(Error::InvalidState(format!(
                "all {total} triangles of the scene are degenerate, not finite or beyond {MAX_COORDINATE:e} units"
            )));
        }
        let all_skipped = skipped.len() + instances.as_ref().map_or(0, Instances::skipped);
        if all_skipped > 0 {
            device.log(
                LogLevel::Warning,
                &format!("{all_skipped} of {total} triangles are degenerate or not finite and were skipped"),
            );
        }
        stage.advance(1)?;
        let built = Built { first_triangle, tree, skipped, instances, sah_cost };
        let mut parts = device.install(|| Parts::of(data, built, memory, start))?;
        parts.stats.kept_triangles = earlier.map_or(0, |e| e.kept());
        let trees = parts.instances.iter().flat_map(|i| i.trees.iter().map(|t| &t.tree)).chain([&parts.tree]);
        let in_files = data.bytes() - data.bytes_in_memory() + trees.map(Tree::mapped_bytes).sum::<usize>();
        if in_files > 0 {
            data.meshes.iter().for_each(Mesh::at_random);
            parts.stats.mapped_bytes = in_files as u64;
            let in_memory = parts.stats.bytes as usize - in_files;
            parts.memory.grow(in_memory, "the scene")?;
            parts.memory.shrink(in_memory);
        }
        Ok(parts)
    }
}

/// Builds the tree of the meshes without instances.
fn own_tree(
    data: &SceneData,
    first_triangle: &[u32],
    options: &BuildOptions,
    storage: BuildStorage,
    progress: &Progress,
) -> Result<KeptTree> {
    let corners = |t: u32| {
        let object = object_of(first_triangle, t);
        data.object(object as u32).corners(t - first_triangle[object])
    };
    let mut references = References::of_valid(data.own_triangles, &corners, is_valid_triangle, storage.work, progress)?;
    progress.check()?;
    let skipped = std::mem::take(&mut references.skipped);
    let own = &first_triangle[..=data.meshes.len()];
    let (tree, sah_cost) = match references.len() {
        0 => (Tree::nothing(), 0.0),
        _ => bvh::build(&corners, references, own, options, storage, progress)?,
    };
    Ok(KeptTree { tree, skipped, sah_cost })
}

/// Size of what there is of each triangle of an instance, and not of each of a mesh alone.
pub(super) fn bytes_of_instances(data: &SceneData, first_triangle: &[u32]) -> usize {
    match data.instances.is_empty() {
        true => 0,
        false => emissive_triangles(data) * size_of::<Emitter>() + size_of_val(first_triangle),
    }
}

/// What takes the time of a commit.
pub(super) struct Built {
    pub first_triangle: Vec<u32>,
    pub tree: Tree,
    pub skipped: Vec<u32>,
    pub instances: Option<Instances>,
    pub sah_cost: f32,
}

/// A committed scene without what it consists of.
pub(super) struct Parts {
    emitters: Vec<Emitter>,
    first_triangle: Vec<u32>,
    bounds: (Vec3, Vec3),
    extent: f32,
    tree: Tree,
    skipped: Vec<u32>,
    instances: Option<Box<Instances>>,
    uses: Uses,
    pub stats: SceneStats,
    memory: Reservation,
}

impl Parts {
    /// Computes what follows from the description and the trees. To be called on the device's threads. `memory` holds what
    /// has been announced for the scene, of which what it takes is kept.
    pub(super) fn of(data: &SceneData, built: Built, mut memory: Reservation, start: Instant) -> Result<Parts> {
        let Built { first_triangle, tree, skipped, instances, sah_cost } = built;
        let mut emitters = try_with_capacity(emissive_triangles(data), EMITTERS)?;
        let is_skipped = |object: u32, t: u32| {
            let first = first_triangle[object as usize];
            instance_trees::is_skipped(data, &skipped, instances.as_ref(), object, t, first)
        };
        add_emitters(data, &first_triangle, is_skipped, &mut emitters);
        let trees = || [&tree].into_iter().chain(instances.iter().flat_map(|i| i.trees.iter().map(|t| &t.tree)));
        let top = instances.as_ref().map_or(0, |i| i.top.node_count());
        let bvh_bytes = tree.bytes() + instances.as_ref().map_or(0, Instances::bytes);
        let bytes = bvh_bytes + data.bytes() + bytes_of_instances(data, &first_triangle);
        memory.shrink(bytes);
        let stats = SceneStats {
            triangles: data.triangle_count() as u64,
            skipped_degenerate: (skipped.len() + instances.as_ref().map_or(0, Instances::skipped)) as u64,
            nodes: (trees().map(Tree::node_count).sum::<usize>() + top) as u64,
            bvh_bytes: bvh_bytes as u64,
            node_bytes: trees().map(Tree::node_bytes).sum::<usize>() as u64
                + instances.as_ref().map_or(0, |i| size_of_val(&i.top.nodes[..]) as u64),
            bytes: bytes as u64,
            mapped_bytes: 0,
            sah_cost,
            build_seconds: start.elapsed().as_secs_f64(),
            wide_sah_cost: tree.sah_cost(),
            refits: 0,
            refit_seconds: 0.0,
            kept_triangles: 0,
        };
        let (bounds, extent) = instance_trees::bounds_and_extent(data, &tree, instances.as_ref());
        let instances = instances.map(Box::new);
        let uses = Uses::of(data);
        Ok(Parts { emitters, first_triangle, bounds, extent, tree, skipped, instances, uses, stats, memory })
    }

    pub(super) fn into_scene(self, device: Arc<Device>, data: SceneData) -> Scene {
        let Parts { emitters, first_triangle, bounds, extent, tree, skipped, instances, uses, stats, memory } = self;
        let lights = Arc::new(RwLock::new(Arc::new(data.lights.clone())));
        Scene {
            device,
            data,
            lights,
            emitters,
            first_triangle,
            bounds,
            extent,
            tree,
            is_refitted: false,
            skipped,
            instances,
            parts: None,
            file: None,
            uses,
            stats,
            _memory: memory,
        }
    }
}

#[cfg(test)]
impl SceneData {
    /// The scene on a device of two threads, for tests; it has no error.
    pub(crate) fn committed(self) -> Arc<Scene> {
        let device = Device::new(crate::device::DeviceOptions { num_threads: 2, ..Default::default() }).unwrap();
        Scene::commit(&device, self, &BuildOptions::default(), &Progress::none()).map_err(|e| e.1).unwrap()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::DeviceOptions;
    use crate::scene::{Instance, Light, MAX_ALBEDO, MAX_TRIANGLES, Mesh, Texture};
    use crate::trace::{Hit, Ray};
    use glam::{Affine3A, Vec2};

    /// A floor (mesh 0), a lamp over it (mesh 1, emissive), and a triangle that is none (mesh 2).
    fn scene() -> Arc<Scene> {
        let mut data = SceneData::new();
        data.add_material(Material::default()).unwrap();
        data.add_material(Material { emission: [2.0; 3], ..Default::default() }).unwrap();
        let light = Light::Point { position: Vec3::Z, intensity: [1.0; 3] };
        data.add_light(light).unwrap();
        let mesh = |positions: Vec<Vec3>, material| Mesh {
            indices: (0..positions.len() as u32 / 3).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect(),
            positions: positions.into(),
            materials: MeshMaterials::One(material),
            ..Default::default()
        };
        data.add_mesh(mesh([FLOOR, FLOOR.map(|c| c + 2.0 * Vec3::Y)].concat(), 0)).unwrap();
        data.add_mesh(mesh(FLOOR.map(|c| c + 3.0 * Vec3::Z).to_vec(), 1)).unwrap();
        data.add_mesh(mesh(vec![Vec3::ZERO; 3], 1)).unwrap();
        data.committed()
    }

    const FLOOR: [Vec3; 3] = [Vec3::ZERO, Vec3::X, Vec3::Y];

    #[test]
    fn a_texture_is_multiplied_with_the_albedo_which_stays_below_one() {
        let mut data = SceneData::new();
        let texture = Texture { width: 1, height: 1, rgba8: vec![[255, 128, 128, 255]] };
        let albedo_texture = data.add_texture(texture).unwrap();
        data.add_material(Material { albedo: [1.0, 1.0, 0.5], albedo_texture, ..Default::default() }).unwrap();
        let plain = Mesh { positions: FLOOR.to_vec().into(), indices: vec![[0, 1, 2]].into(), ..Default::default() };
        data.add_mesh(Mesh { uvs: vec![Vec2::ZERO; 3].into(), ..plain.clone() }).unwrap();
        data.add_mesh(plain).unwrap();
        let scene = data.committed();
        // ((128/255 + 0.055) / 1.055)^2.4.
        let expected = Vec3::new(MAX_ALBEDO, 0.215_861, 0.5 * 0.215_861);
        assert!((scene.albedo(0, 0.2, 0.3) - expected).abs().max_element() < 1e-6);
        assert_eq!(scene.albedo(1, 0.2, 0.3), Vec3::new(MAX_ALBEDO, MAX_ALBEDO, 0.5));
    }

    #[test]
    fn large_meshes_without_instances_get_them_after_a_refused_commit() {
        let device = Device::new(DeviceOptions { num_threads: 1, ..Default::default() }).unwrap();
        let mut data = SceneData::new();
        data.add_material(Material::default()).unwrap();
        data.add_mesh(Mesh { positions: FLOOR.to_vec().into(), indices: vec![[0, 1, 2]].into(), ..Default::default() })
            .unwrap();
        // As if another mesh had so many; they do not fit into memory here.
        data.own_triangles += MAX_TRIANGLES;
        let commit = |data| Scene::commit(&device, data, &BuildOptions::default(), &Progress::none()).map_err(Box::new);
        let (mut data, e) = *commit(data).err().unwrap();
        let message = "have 268435457 triangles together, more than 268435456: give the large ones an instance each";
        assert!(matches!(&e, Error::InvalidState(m) if m.contains(message)), "{e}");
        data.add_instance(Instance::new(0, Affine3A::IDENTITY)).unwrap();
        assert_eq!(data.own_triangles, MAX_TRIANGLES);
        data.check_own_triangles().unwrap();
    }

    #[test]
    fn a_commit_that_panics_or_is_cancelled_gives_the_description_back() {
        let device = Device::new(DeviceOptions { num_threads: 1, ..Default::default() }).unwrap();
        let mut data = SceneData::new();
        data.add_material(Material::default()).unwrap();
        let mesh = || Mesh { positions: FLOOR.to_vec().into(), indices: vec![[0, 1, 2]].into(), ..Default::default() };
        data.add_mesh(mesh()).unwrap();
        let commit = |data, progress: &Progress| {
            Scene::commit(&device, data, &BuildOptions::default(), progress).map_err(Box::new)
        };
        let (mut data, e) = *commit(data, &Progress::new(|_, _| false)).err().unwrap();
        assert_eq!(e, Error::Cancelled);
        // Past all checks: a mesh without triangles whose material does not exist.
        data.meshes.push(Mesh { materials: MeshMaterials::One(7), ..Default::default() });
        let (mut data, e) = *commit(data, &Progress::none()).err().unwrap();
        assert!(matches!(&e, Error::Internal(s) if s.contains("panic")), "{e}");
        assert_eq!(device.memory().current(), 0);
        data.meshes.pop();
        assert_eq!(commit(data, &Progress::none()).map_err(|e| e.1).unwrap().triangle_count(), 1);
    }

    #[test]
    fn a_scene_far_from_the_origin_for_its_size_is_warned_of() {
        let warnings = |offset: f32| {
            let messages = Arc::new(std::sync::Mutex::new(Vec::<String>::new()));
            let log = {
                let messages = messages.clone();
                move |level: LogLevel, message: &str| {
                    if level == LogLevel::Warning {
                        messages.lock().unwrap().push(message.to_owned());
                    }
                }
            };
            let options = DeviceOptions { num_threads: 1, log: Some(Box::new(log)), ..Default::default() };
            let device = Device::new(options).unwrap();
            let mut data = SceneData::new();
            data.add_material(Material::default()).unwrap();
            let positions = FLOOR.map(|c| c + Vec3::splat(offset)).to_vec();
            data.add_mesh(Mesh { positions: positions.into(), indices: vec![[0, 1, 2]].into(), ..Default::default() })
                .unwrap();
            Scene::commit(&device, data, &BuildOptions::default(), &Progress::none()).map_err(|e| e.1).unwrap();
            messages.lock().unwrap().clone()
        };
        assert!(warnings(0.0).is_empty() && warnings(1e3).is_empty());
        let far = warnings(1e4);
        assert!(far.len() == 1 && far[0].contains("too few digits"), "{far:?}");
    }

    fn up(scene: &Scene) -> Hit {
        scene.intersect(&Ray { origin: [0.2, 0.2, 0.5], tmin: 0.0, direction: [0.0, 0.0, 1.0], tmax: f32::INFINITY })
    }

    #[test]
    fn all_that_follows_from_positions_follows_a_refit() {
        let mut s = scene();
        let (address, before) = (Arc::as_ptr(&s), *s.stats());
        assert_eq!((up(&s).t, up(&s).mesh, s.emitters()[0].area, before.skipped_degenerate), (2.5, 1, 0.5, 1));
        let lamp = FLOOR.map(|c| 2.0 * c + 5.0 * Vec3::Z);
        Scene::refit(&mut s, &[(1, &lamp)]).unwrap();
        assert_eq!(Arc::as_ptr(&s), address, "nobody else holds it");
        assert_eq!((up(&s).t, up(&s).mesh), (4.5, 1));
        let e = s.emitters();
        assert_eq!((e.len(), e[0].area, e[0].corner, e[0].triangle), (1, 2.0, 5.0 * Vec3::Z, 2));
        assert_eq!(s.bounds(), (Vec3::ZERO, Vec3::new(2.0, 3.0, 5.0)));
        assert_eq!(s.corners(2), lamp);
        let after = s.stats();
        assert_eq!((after.refits, after.sah_cost, after.skipped_degenerate), (1, before.sah_cost, 1));
        assert!(after.wide_sah_cost > 0.0 && after.refit_seconds > 0.0);
    }

    #[test]
    fn the_accounts_hold_what_the_scene_takes() {
        let s = scene();
        let memory = s.device().memory();
        // Positions and indices, and what the tree says of itself.
        assert_eq!(s.stats().bytes - s.stats().bvh_bytes, 12 * (6 + 3 + 3) + 12 * (2 + 1 + 1));
        assert_eq!(memory.current() as u64, s.stats().bytes);
        assert!(memory.peak() > memory.current(), "the build takes more");
    }

    #[test]
    fn who_holds_the_scene_keeps_its_geometry_and_shares_its_lights() {
        let mut s = scene();
        let old = s.clone();
        Scene::refit(&mut s, &[(1, &FLOOR.map(|c| c + 4.0 * Vec3::Z))]).unwrap();
        assert_eq!((up(&old).t, up(&s).t), (2.5, 3.5));
        assert_eq!((old.emitters()[0].corner.z, s.emitters()[0].corner.z), (3.0, 4.0));
        let light = Light::Point { position: Vec3::X, intensity: [3.0; 3] };
        s.set_light(0, light).unwrap();
        assert_eq!(old.lights()[0], s.lights()[0]);
        let held = s.device().memory().current();
        drop(old);
        assert!(s.device().memory().current() < held);
    }

    #[test]
    fn triangles_go_and_come_back_but_those_that_never_were_stay_out() {
        let mut s = scene();
        Scene::refit(&mut s, &[(1, &[Vec3::NAN; 3]), (2, &FLOOR.map(|c| c + Vec3::Z))]).unwrap();
        assert!(up(&s).triangle == NONE && s.emitters().is_empty() && !s.is_valid(2) && !s.is_valid(3));
        assert_eq!(s.stats().skipped_degenerate, 2);
        Scene::refit(&mut s, &[(1, &FLOOR.map(|c| c + 3.0 * Vec3::Z))]).unwrap();
        assert!(up(&s).t == 2.5 && s.emitters().len() == 1 && s.is_valid(2) && !s.is_valid(3));
        assert_eq!(s.stats().skipped_degenerate, 1);
    }

    #[test]
    fn a_refused_refit_changes_nothing() {
        let mut s = scene();
        let fine = FLOOR.map(|c| c + 9.0 * Vec3::Z);
        let nothing = [Vec3::ZERO; 6];
        type Moves<'a> = &'a [(u32, &'a [Vec3])];
        let refused: [(Moves, &str); 3] = [
            (&[(1, &fine), (7, &fine)], "mesh 7 does not exist"),
            (&[(1, &fine), (0, &fine)], "positions has 3 entries for 6 vertices"),
            (&[(0, &nothing), (1, &nothing[..3])], "all triangles"),
        ];
        for (moved, culprit) in refused {
            let e = Scene::refit(&mut s, moved).unwrap_err().to_string();
            assert!(e.contains(culprit), "{e}");
            assert_eq!((up(&s).t, s.stats().refits, s.corners(2)[0].z), (2.5, 0, 3.0));
        }
    }
}
