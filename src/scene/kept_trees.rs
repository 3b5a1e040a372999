//! Trees that a commit takes over from an earlier scene: those of meshes that are as they were there, wherever they are placed
//! and whatever they are made of. A scene of many meshes is then built in the time of those that changed, where each that
//! may change has an instance and so a tree of its own.

use super::{Mesh, Scene, SceneData};
use crate::base::array::Array;
use crate::base::error::Result;
use crate::base::memory::{try_collect, try_par_collect_ok, try_to_vec};
use crate::base::parallel::ParallelLoop;
use crate::base::progress::Progress;
use crate::base::scratch_files::Storage;
use crate::bvh::instances::MeshTree;
use crate::bvh::{Compact, Tree};
use bytemuck::Pod;
use rayon::prelude::*;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};

/// Name of this memory in error messages.
const KEPT: &str = "trees of an earlier scene";

/// The trees of an earlier scene.
pub(super) struct EarlierTrees<'a, 'p> {
    scene: &'a Scene,
    /// Whether compact trees are wanted; others are of no use then, and the other way round.
    compact: bool,
    /// Where copies of trees lie.
    storage: Storage<'a>,
    progress: &'a Progress<'p>,
    /// Indices of trees of meshes with instances, in order of what [`key`] returns for the mesh.
    by_key: Vec<(Key, usize)>,
    /// Number of triangles in the trees that were taken over.
    kept: AtomicU64,
}

/// The tree of the meshes without instances.
pub(super) struct KeptTree {
    pub tree: Tree,
    pub skipped: Vec<u32>,
    pub sah_cost: f32,
}

impl<'a, 'p> EarlierTrees<'a, 'p> {
    pub fn of(scene: &'a Scene, compact: bool, storage: Storage<'a>, progress: &'a Progress<'p>) -> Result<Self> {
        let trees = scene.instances.as_ref().map_or(&[][..], |i| &i.trees);
        let keys = trees.par_iter().map(|t| {
            progress.check()?;
            Ok(key(&scene.data.meshes[t.mesh as usize]))
        });
        let keys = try_par_collect_ok(keys, KEPT)?;
        let mut by_key = try_collect(keys.into_iter().zip(0..), KEPT)?;
        by_key.sort_unstable();
        Ok(EarlierTrees { scene, compact, storage, progress, by_key, kept: AtomicU64::new(0) })
    }

    /// Returns the tree of the meshes without instances, if these are the same in the same order; `first_triangle`: their
    /// first triangles, and the number of all.
    pub fn own(&self, data: &SceneData, first_triangle: &[u32]) -> Result<Option<KeptTree>> {
        let Scene { tree, skipped, stats, is_refitted, data: earlier, .. } = self.scene;
        if *is_refitted || !self.is_wanted(tree) || own(data).map(size).ne(own(earlier).map(size)) {
            return Ok(None);
        }
        for (a, b) in own(data).zip(own(earlier)) {
            if !self.are_same(a, b)? {
                return Ok(None);
            }
        }
        self.kept.fetch_add(data.own_triangles as u64, Relaxed);
        let tree = self.copy(tree, first_triangle)?;
        Ok(Some(KeptTree { tree, skipped: try_to_vec(skipped, KEPT)?, sah_cost: stats.sah_cost }))
    }

    /// Returns the tree of a mesh with instances, if there was such a mesh.
    pub fn of_mesh(&self, mesh: &Mesh, number: u32) -> Result<Option<MeshTree>> {
        let key = key(mesh);
        let first = self.by_key.partition_point(|(k, _)| *k < key);
        for &(_, i) in self.by_key[first..].iter().take_while(|(k, _)| *k == key) {
            let t = &self.scene.instances.as_ref().expect("they have trees").trees[i];
            let earlier = &self.scene.data.meshes[t.mesh as usize];
            if !t.is_refitted && self.is_wanted(&t.tree) && self.are_same(mesh, earlier)? {
                self.kept.fetch_add(t.range[1].into(), Relaxed);
                let tree = self.copy(&t.tree, &t.range)?;
                return Ok(Some(MeshTree { mesh: number, tree, skipped: try_to_vec(&t.skipped, KEPT)?, ..*t }));
            }
        }
        Ok(None)
    }

    /// Number of triangles in the trees that were taken over.
    pub fn kept(&self) -> u64 {
        self.kept.load(Relaxed)
    }

    fn is_wanted(&self, tree: &Tree) -> bool {
        matches!(tree, Tree::Compact(_)) == self.compact && !tree.is_nothing()
    }

    /// Whether two meshes of the same size have the same triangles, by bits of coordinates.
    fn are_same(&self, a: &Mesh, b: &Mesh) -> Result<bool> {
        Ok(self.are_equal(&a.positions, &b.positions)? && self.are_equal(&a.indices, &b.indices)?)
    }

    fn are_equal<T: Pod + Send + Sync>(&self, a: &Array<T>, b: &Array<T>) -> Result<bool> {
        let differs = AtomicBool::new(false);
        let parts = a.par_chunks(PART).zip(b.par_chunks(PART)).enumerate();
        parts.try_each(|(i, (part, other))| {
            self.progress.check()?;
            b.will_need(i * PART..i * PART + other.len());
            if !differs.load(Relaxed) && bytes(part) != bytes(other) {
                differs.store(true, Relaxed);
            }
            Ok(())
        })?;
        Ok(!differs.into_inner())
    }

    /// Copies a tree. Numbers of meshes, which compact trees have, may be others now.
    fn copy(&self, tree: &Tree, first_triangle: &[u32]) -> Result<Tree> {
        Ok(match tree.copy(self.storage, self.progress)? {
            Tree::Compact(t) => Tree::Compact(Compact::new(t.nodes, t.triangles, tree.bounds(), first_triangle)?),
            whole => whole,
        })
    }
}

/// Number of elements of meshes that are compared between two looks for a cancel.
const PART: usize = 1 << 18;

/// The meshes without instances that have triangles.
fn own(data: &SceneData) -> impl Iterator<Item = &Mesh> {
    (0..).zip(&data.meshes).filter(|&(m, mesh)| !data.is_instanced(m) && !mesh.indices.is_empty()).map(|(_, mesh)| mesh)
}

fn size(mesh: &Mesh) -> [usize; 2] {
    [mesh.positions.len(), mesh.indices.len()]
}

/// Numbers of vertices and triangles, and checksum of the positions: that few meshes share it.
type Key = ([usize; 2], u32);

fn key(mesh: &Mesh) -> Key {
    (size(mesh), crc32fast::hash(bytes(&mesh.positions)))
}

fn bytes<T: Pod>(values: &[T]) -> &[u8] {
    bytemuck::cast_slice(values)
}

#[cfg(test)]
mod tests {
    use crate::base::error::Error;
    use crate::base::progress::Progress;
    use crate::base::sampling::uniform;
    use crate::bvh::BuildOptions;
    use crate::scene::{Instance, Material, Mesh, Scene, SceneData};
    use crate::trace::{Hit, Ray};
    use glam::{Affine3A, Vec3, Vec3Swizzles};
    use std::sync::Arc;

    /// A cloud of `n` triangles, of which one is none.
    fn cloud(n: u32, seed: u32) -> Mesh {
        let corner = |i: u32, k: u32| {
            let at = |c| Vec3::from_array([0, 1, 2].map(|a| uniform(3 * i + c, a, seed)));
            if i == 7 { Vec3::ZERO } else { at(0) + 0.3 * at(k) }
        };
        Mesh {
            positions: (0..3 * n).map(|v| corner(v / 3, v % 3)).collect::<Vec<_>>().into(),
            indices: (0..n).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect::<Vec<_>>().into(),
            ..Default::default()
        }
    }

    /// The meshes, of which those of the numbers have instances, one after the other.
    fn scene(meshes: &[Mesh], instanced: &[u32]) -> SceneData {
        let mut data = SceneData::new();
        data.add_material(Material::default()).unwrap();
        meshes.iter().for_each(|mesh| _ = data.add_mesh(mesh.clone()).unwrap());
        for (i, &mesh) in instanced.iter().enumerate() {
            let transform = Affine3A::from_translation(Vec3::X * (i + 1) as f32);
            data.add_instance(Instance::new(mesh, transform)).unwrap();
        }
        data
    }

    fn compact(compact: bool) -> BuildOptions {
        BuildOptions { compact, ..Default::default() }
    }

    /// What rays between places all over the clouds hit.
    fn hits_of(scene: &Scene) -> Vec<Hit> {
        let point = |i, k: u32| Vec3::from_array([0, 1, 2].map(|a| uniform(i, k + a, 5))) * Vec3::new(4.0, 1.0, 1.0);
        let ray = |i| {
            let (from, to) = (point(i, 0), point(i, 3));
            let direction = (to - from).to_array();
            Ray { origin: from.to_array(), tmin: 0.0, direction, tmax: f32::INFINITY }
        };
        let hits: Vec<Hit> = (0..500).map(|i| scene.intersect(&ray(i))).collect();
        let count = hits.iter().filter(|hit| hit.triangle != u32::MAX).count();
        assert!(count > 50, "{count}");
        hits
    }

    /// Commits with trees of `earlier`, checks that rays hit what they do without, and returns the number of triangles
    /// whose trees were taken over.
    fn kept(data: SceneData, earlier: &Arc<Scene>, options: &BuildOptions) -> u64 {
        let none = Progress::none();
        let device = earlier.device();
        let fresh = Scene::commit(device, data.try_clone().unwrap(), options, &none).map_err(|e| e.1).unwrap();
        let scene = Scene::commit_from(device, data, options, earlier, &none).map_err(|e| e.1).unwrap();
        let mut hits = 0;
        for i in 0..500 {
            let point = |k: u32| Vec3::from_array([0, 1, 2].map(|a| uniform(i, k + a, 5)));
            let (from, to) = (point(0) * Vec3::new(4.0, 1.0, 1.0), point(3) * Vec3::new(4.0, 1.0, 1.0));
            let ray =
                Ray { origin: from.to_array(), tmin: 0.0, direction: (to - from).to_array(), tmax: f32::INFINITY };
            assert_eq!(scene.intersect(&ray), fresh.intersect(&ray));
            hits += usize::from(scene.intersect(&ray).triangle != u32::MAX);
        }
        assert!(hits > 50, "{hits}");
        let (a, b) = (scene.stats(), fresh.stats());
        assert_eq!((a.sah_cost, a.nodes, a.skipped_degenerate), (b.sah_cost, b.nodes, b.skipped_degenerate));
        assert_eq!((scene.bounds(), b.kept_triangles), (fresh.bounds(), 0));
        a.kept_triangles
    }

    #[test]
    fn trees_of_meshes_that_are_as_they_were_are_taken_over() {
        let [a, b, c] = [(50, 1), (60, 2), (60, 3)].map(|(n, seed)| cloud(n, seed));
        for options in [compact(false), compact(true)] {
            let earlier = |data: SceneData| {
                let device = crate::device::Device::new(Default::default()).unwrap();
                Scene::commit(&device, data, &options, &Progress::none()).map_err(|e| e.1).unwrap()
            };
            let before = earlier(scene(&[a.clone(), b.clone(), c.clone()], &[1, 2]));
            // All, where instances are others and elsewhere.
            assert_eq!(kept(scene(&[a.clone(), b.clone(), c.clone()], &[2, 1, 2]), &before, &options), 170);
            // A mesh without instances is another one; those with some have other numbers.
            let other = cloud(50, 9);
            assert_eq!(kept(scene(&[c.clone(), other, b.clone()], &[0, 2]), &before, &options), 120);
            // A mesh with instances has changed by one coordinate.
            let mut moved = b.clone();
            moved.positions[5].y += 1e-3;
            assert_eq!(kept(scene(&[a.clone(), moved, c.clone()], &[1, 2]), &before, &options), 110);
            // A mesh between those of the tree of all, which has others' numbers now: nothing of that tree.
            assert_eq!(kept(scene(&[b.clone(), a.clone()], &[]), &before, &options), 0);
            // Trees of the other kind are of no use.
            let other_kind = compact(!options.compact);
            assert_eq!(kept(scene(&[a.clone(), b.clone(), c.clone()], &[1, 2]), &before, &other_kind), 0);
        }
    }

    #[test]
    fn numbers_of_meshes_in_compact_trees_follow() {
        let [a, b] = [(700, 1), (600, 2)].map(|(n, seed)| cloud(n, seed));
        let before = scene(&[a.clone(), b.clone()], &[]).committed();
        let device = before.device().clone();
        let options = compact(true);
        let none = Progress::none();
        let before =
            Scene::commit(&device, before.data.try_clone().unwrap(), &options, &none).map_err(|e| e.1).unwrap();
        assert_eq!(kept(scene(&[cloud(40, 3), a, cloud(9, 4), b], &[0, 2]), &before, &options), 1300);
    }

    #[test]
    fn trees_that_were_refitted_are_built_anew() {
        let [a, b] = [(50, 1), (60, 2)].map(|(n, seed)| cloud(n, seed));
        let mut earlier = scene(&[a.clone(), b.clone()], &[1]).committed();
        let as_is = |s: &Arc<Scene>| s.data.try_clone().unwrap();
        // Where instances stand is no matter.
        Scene::refit_with(&mut earlier, &[], &[(0, Affine3A::IDENTITY)]).unwrap();
        assert_eq!(kept(as_is(&earlier), &earlier, &compact(false)), 110);
        let moved: Vec<Vec3> = b.positions.iter().map(|p| *p + 0.1 * p.yzx()).collect();
        Scene::refit(&mut earlier, &[(1, &moved)]).unwrap();
        assert_eq!(kept(as_is(&earlier), &earlier, &compact(false)), 50);
        let moved: Vec<Vec3> = a.positions.iter().map(|p| *p + 0.1 * p.yzx()).collect();
        Scene::refit(&mut earlier, &[(0, &moved)]).unwrap();
        assert_eq!(kept(as_is(&earlier), &earlier, &compact(false)), 0);
    }

    #[test]
    fn triangles_that_a_refit_has_made_valid_are_there_again() {
        let collapsed = |mesh: &Mesh| Mesh {
            positions: vec![Vec3::ZERO; mesh.positions.len()].into(),
            indices: mesh.indices.clone(),
            ..Default::default()
        };
        let [a, b] = [(50, 1), (60, 2)].map(|(n, seed)| cloud(n, seed));
        let file = std::env::temp_dir().join(format!("bakelite-kept-trees-{}.bkscene", std::process::id()));
        // A mesh none of whose triangles is in a tree, with an instance and without; then one triangle of the others.
        for (first, moved, instanced, kept_after) in [
            ([a.clone(), collapsed(&b)], 1, &[1][..], 50),
            ([collapsed(&a), b.clone()], 0, &[1], 60),
            ([a.clone(), b.clone()], 1, &[1], 50),
        ] {
            let mut earlier = scene(&first, instanced).committed();
            let mut all_valid = [&a, &b][moved].positions.to_vec();
            (0..3).for_each(|corner| all_valid[21 + corner] = Vec3::splat(0.5) + Vec3::AXES[corner]);
            Scene::refit(&mut earlier, &[(moved as u32, &all_valid)]).unwrap();
            let described = earlier.data.try_clone().unwrap();
            earlier.save(&file, &Progress::none()).unwrap();
            let opened = Scene::open(earlier.device(), &file, &Default::default(), &Progress::none()).unwrap();
            for earlier in [&earlier, &opened] {
                assert_eq!(kept(described.try_clone().unwrap(), earlier, &compact(false)), kept_after);
            }
        }
        std::fs::remove_file(&file).unwrap();
    }

    #[test]
    fn trees_are_taken_to_scratch_files_and_from_them() {
        let data = || scene(&[cloud(5_000, 1), cloud(6_000, 2)], &[1, 1]);
        let scratch = crate::device::DeviceOptions { scratch_folder: Some(std::env::temp_dir()), ..Default::default() };
        let devices = [scratch, Default::default()].map(|options| crate::device::Device::new(options).unwrap());
        for options in [compact(false), compact(true)] {
            let none = Progress::none();
            let in_files = Scene::commit(&devices[0], data(), &options, &none).map_err(|e| e.1).unwrap();
            let plain = Scene::commit(&devices[1], data(), &options, &none).map_err(|e| e.1).unwrap();
            let mapped = in_files.stats().mapped_bytes;
            assert!(mapped > in_files.stats().bytes / 2 && plain.stats().mapped_bytes == 0);
            assert_eq!(devices[0].memory().current() as u64, in_files.stats().bytes - mapped);
            for earlier in [&in_files, &plain] {
                assert_eq!(kept(data(), earlier, &options), 11_000);
            }
            // Moved in a copy, then in place.
            let (mut moved, mut plain) = (in_files.clone(), plain);
            for seed in [7, 8] {
                let positions = cloud(5_000, seed).positions;
                Scene::refit(&mut moved, &[(0, &positions)]).unwrap();
                Scene::refit(&mut plain, &[(0, &positions)]).unwrap();
                assert_eq!(hits_of(&moved), hits_of(&plain));
                assert_eq!(moved.stats().mapped_bytes, mapped);
            }
        }
        assert_eq!(devices[0].memory().current(), 0);
    }

    #[test]
    fn a_commit_that_is_cancelled_gives_the_description_back() {
        let earlier = scene(&[cloud(50, 1)], &[]).committed();
        let cancelled = Scene::commit_from(
            earlier.device(),
            scene(&[cloud(50, 1)], &[]),
            &compact(false),
            &earlier,
            &Progress::new(|_, _| false),
        );
        let (data, e) = cancelled.err().unwrap();
        assert_eq!((data.meshes().len(), e), (1, Error::Cancelled));
    }
}
