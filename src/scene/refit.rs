//! Refits: vertices move, the tree keeps its topology, and all data that depend on positions are updated.

use super::committed::object_of;
use super::emitters::{EMITTERS, add_emitters, emissive_triangles};
use super::instance_trees;
use super::{Emitter, Instance, Scene, is_valid_triangle};
use crate::base::error::{Error, Result, invalid_argument};
use crate::base::geometry::MAX_COORDINATE;
use crate::base::memory::{try_to_vec, try_with_capacity};
use crate::base::progress::Progress;
use crate::bvh;
use crate::bvh::instances::Instances;
use crate::device::LogLevel;
use glam::{Affine3A, Vec3};
use rayon::prelude::*;
use std::collections::{HashMap, HashSet};
use std::sync::Arc;
use std::time::Instant;

/// Name of this memory in error messages.
const COPY: &str = "a copy of the scene to refit";

impl Scene {
    /// Moves vertices: `moved` names meshes and the new positions of all their vertices. (If a mesh is named twice, the
    /// last entry counts.) The tree keeps its shape and gets new boxes, which takes a fraction of a commit; so it
    /// serves well as long as neighbours stay neighbours, and [`wide_sah_cost`](super::SceneStats::wide_sah_cost) shows
    /// when a new commit would be better. Emitters, bounds and statistics are renewed; shading normals, texture and
    /// light map coordinates stay as they were given.
    ///
    /// If `scene` is the only reference, it is changed in place; otherwise it is replaced by a copy, and holders of
    /// other references (light maps, live objects) keep the old geometry and share the lights.
    ///
    /// Triangles that become degenerate or not finite are not hit while they are; those that were so at the commit are
    /// not in the tree and stay out in any case. After a build with spatial splits, boxes become those of whole
    /// triangles: right, but larger than before.
    ///
    /// Fails, and leaves `scene` as it was, if a mesh does not exist, has another number of vertices or is
    /// strict and gets a degenerate triangle or a vertex that is not finite; if no triangle would be left that
    /// a ray can hit; or if memory is refused.
    pub fn refit(scene: &mut Arc<Scene>, moved: &[(u32, &[Vec3])]) -> Result<()> {
        Self::refit_with(scene, moved, &[])
    }

    /// Moves vertices as [`refit`](Self::refit) does, and instances: `placed` names them with their new transforms.
    pub fn refit_with(scene: &mut Arc<Scene>, moved: &[(u32, &[Vec3])], placed: &[(u32, Affine3A)]) -> Result<()> {
        let start = Instant::now();
        for &(mesh, positions) in moved {
            scene.check_positions(mesh, positions)?;
        }
        for &(instance, transform) in placed {
            scene.check_transform(instance, transform)?;
        }
        if !scene.any_left(moved, placed) {
            return Err(Error::InvalidState(format!(
                "all triangles of the scene would be degenerate, not finite or beyond {MAX_COORDINATE:e} units"
            )));
        }
        // All memory is allocated before anything changes.
        let emitters = try_with_capacity(emissive_triangles(&scene.data), EMITTERS)?;
        let own = scene.tree.room_to_refit()?;
        let trees = scene.instances.iter().flat_map(|i| &i.trees);
        let mut rooms = try_with_capacity(trees.clone().count(), COPY)?;
        for tree in trees {
            rooms.push(tree.tree.room_to_refit()?);
        }
        if Arc::get_mut(scene).is_none() {
            let copy = scene.copy()?;
            scene.check_file()?;
            *scene = Arc::new(copy);
        }
        scene.check_file()?;
        let device = scene.device.clone();
        let scene = Arc::get_mut(scene).expect("a new Arc, or the only one");
        for &(mesh, positions) in moved {
            scene.data.meshes[mesh as usize].positions.copy_from_slice(positions);
        }
        for &(instance, transform) in placed {
            scene.data.instances[instance as usize].transform = transform;
        }
        let moved: HashSet<u32> = moved.iter().map(|m| m.0).collect();
        let has_moved = |mesh: u32| moved.contains(&mesh);
        device.install(|| scene.follow_positions(emitters, own, rooms, has_moved));
        scene.stats.refits += 1;
        scene.stats.refit_seconds = start.elapsed().as_secs_f64();
        Ok(())
    }

    /// Checks whether [`refit`](Self::refit) accepts these positions for a mesh.
    pub fn check_positions(&self, mesh: u32, positions: &[Vec3]) -> Result<()> {
        let meshes = self.meshes();
        match meshes.get(mesh as usize) {
            None => invalid_argument!("mesh {mesh} does not exist, the scene has {}", meshes.len()),
            Some(m) => m.check_positions(positions),
        }
    }

    /// Checks whether [`refit_with`](Self::refit_with) accepts this transform of an instance.
    pub fn check_transform(&self, instance: u32, transform: Affine3A) -> Result<()> {
        match self.data.instances.get(instance as usize) {
            None => {
                invalid_argument!("instance {instance} does not exist, the scene has {}", self.data.instances.len())
            }
            Some(i) => Instance { transform, ..*i }.validate(self.data.meshes.len()),
        }
    }

    /// Whether any triangle can be hit after vertices and instances have moved.
    fn any_left(&self, moved: &[(u32, &[Vec3])], placed: &[(u32, Affine3A)]) -> bool {
        let new: HashMap<u32, &[Vec3]> = moved.iter().copied().collect();
        let left_of = |m: u32| {
            let mesh = &self.meshes()[m as usize];
            let positions = new.get(&m).copied().unwrap_or(&mesh.positions);
            let corners = move |i: &[u32; 3]| i.map(|i| positions[i as usize]);
            let all = (0..).zip(&mesh.indices).map(move |(t, i)| (t, corners(i)));
            all.filter(move |&(t, corners)| is_valid_triangle(corners) && !self.is_skipped_in_mesh(m, t))
        };
        let mut own = (0..self.meshes().len() as u32).filter(|&m| !self.data.is_instanced(m));
        if own.any(|m| left_of(m).next().is_some()) {
            return true;
        }
        let Some(instances) = self.instances.as_deref() else { return false };
        // All of an instance may be beyond the greatest coordinate, as all of a mesh may.
        let transforms: HashMap<u32, Affine3A> = placed.iter().copied().collect();
        let mut boxes = HashMap::new();
        instances.in_top().any(|i| {
            let old = &self.data.instances[i as usize];
            let instance = Instance { transform: transforms.get(&i).copied().unwrap_or(old.transform), ..*old };
            let of_mesh = *boxes.entry(instance.mesh).or_insert_with(|| match new.contains_key(&instance.mesh) {
                true => {
                    left_of(instance.mesh).fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), (_, corners)| {
                        corners.into_iter().fold((low, high), |(low, high), c| (low.min(c), high.max(c)))
                    })
                }
                false => instances.trees[instances.placed[i as usize].tree as usize].tree.bounds(),
            });
            is_valid_triangle(Instances::corners_of_box(instance_trees::box_of(&instance, of_mesh)))
        })
    }

    /// Updates all data that depend on positions. `emitters` has capacity for all there may be; the rooms are those of
    /// the tree of meshes without instances and of the trees of the others.
    fn follow_positions(
        &mut self,
        mut emitters: Vec<Emitter>,
        own: bvh::RefitRoom,
        rooms: Vec<bvh::RefitRoom>,
        has_moved: impl Fn(u32) -> bool + Sync,
    ) {
        let (first, data) = (&self.first_triangle, &self.data);
        let corners = |t: u32| {
            let object = object_of(first, t);
            data.object(object as u32).corners(t - first[object])
        };
        let own_triangles = data.own_triangles as u32;
        let has_own_moved = (0..data.meshes.len() as u32).any(|m| !data.is_instanced(m) && has_moved(m));
        self.is_refitted |= has_own_moved;
        if has_own_moved && own_triangles > self.skipped.len() as u32 {
            self.tree.refit(&corners, own);
        }
        let mut gone = 0;
        if let Some(instances) = self.instances.as_deref_mut() {
            gone += instance_trees::refit(data, instances, rooms, &has_moved);
        }
        let is_gone = |&t: &u32| !is_valid_triangle(corners(t)) && self.skipped.binary_search(&t).is_err();
        gone += (0..own_triangles).into_par_iter().filter(is_gone).count();
        if gone > 0 {
            let total = self.stats.triangles;
            let message = format!("{gone} of {total} triangles are degenerate or not finite after the refit");
            self.device.log(LogLevel::Warning, &message);
        }
        (self.bounds, self.extent) =
            instance_trees::bounds_and_extent(&self.data, &self.tree, self.instances.as_deref());
        add_emitters(&self.data, &self.first_triangle, |o, t| self.is_skipped(o, t), &mut emitters);
        self.emitters = emitters;
        self.stats.skipped_degenerate =
            (self.skipped.len() + self.instances.as_deref().map_or(0, Instances::skipped) + gone) as u64;
        self.stats.wide_sah_cost = self.tree.sah_cost();
        self.warn_of_few_digits();
    }

    /// Copies the scene; the lights are shared.
    fn copy(&self) -> Result<Scene> {
        // Textures and environments are shared.
        let of_instances = self.instances.as_ref().map_or(0, |i| i.bytes());
        let bytes = self.tree.bytes() + of_instances + self.data.mesh_bytes();
        let storage = self.device.storage();
        let memory = self.device.memory().reserve(self.device.in_memory(bytes), COPY)?;
        let mut copy = Scene {
            device: self.device.clone(),
            data: self.data.copy(storage)?,
            lights: self.lights.clone(),
            emitters: Vec::new(),
            first_triangle: try_to_vec(&self.first_triangle, COPY)?,
            bounds: self.bounds,
            extent: self.extent,
            tree: self.tree.copy(storage, &Progress::none())?,
            is_refitted: self.is_refitted,
            skipped: try_to_vec(&self.skipped, COPY)?,
            instances: match &self.instances {
                Some(instances) => Some(Box::new(instances.copy(storage)?)),
                None => None,
            },
            // Rays wait at parts of a scene file, which this is no more.
            parts: None,
            file: None,
            uses: self.uses.clone(),
            stats: self.stats,
            _memory: memory,
        };
        copy.stats.mapped_bytes = copy.bytes_in_files() as u64;
        copy._memory.grow(bytes.saturating_sub(copy.bytes_in_files()), COPY)?;
        Ok(copy)
    }
}
