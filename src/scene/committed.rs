//! The committed scene: its contents, and access to its parts by number.

use super::instance_trees;
use super::waiting::WaitingRays;
use super::{
    Emitter, Environment, Instance, Light, MAX_ALBEDO, Material, Mesh, Object, SceneData, Sky, Texture,
    is_valid_triangle, unit_normal,
};
use crate::base::error::{Result, invalid_argument};
use crate::base::memory::Reservation;
use crate::base::watched_file::WatchedFile;
use crate::bvh::Tree;
use crate::bvh::instances::Instances;
use crate::device::Device;
use glam::{Vec2, Vec3};
use std::borrow::Cow;
use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::{Arc, RwLock};

/// Statistics of a committed scene.
#[derive(Clone, Copy, Debug, Default)]
pub struct SceneStats {
    /// Number of triangles, those of every instance counted.
    pub triangles: u64,
    /// Number of triangles that were degenerate or not finite at the commit, or are since a refit: they are not in the
    /// tree, or in it and never hit. Those of a mesh with instances are counted once.
    pub skipped_degenerate: u64,
    /// Number of 8-wide nodes, of all trees.
    pub nodes: u64,
    /// Size of the acceleration structure in bytes.
    pub bvh_bytes: u64,
    /// Size of the acceleration structure's nodes in bytes.
    pub node_bytes: u64,
    /// Size of the whole committed scene in bytes.
    pub bytes: u64,
    /// Bytes of those that are in a mapped file (see [`OpenOptions`](super::OpenOptions)) and not in memory, but for what
    /// the system keeps there as long as it has room.
    pub mapped_bytes: u64,
    /// Surface area heuristic cost of the binary tree of the meshes without instances, traversal and intersection
    /// costing 1 each; 0 if all have some. A refit does not change it.
    pub sah_cost: f32,
    /// Wall time of the build.
    pub build_seconds: f64,
    /// Surface area heuristic cost of the current 8-wide tree of the meshes without instances, 1 per node and per
    /// triangle: compared with its value after the commit, it shows how much quality a refitted tree has lost.
    pub wide_sah_cost: f32,
    /// Number of refits since the commit.
    pub refits: u32,
    /// Wall time of the last refit, 0 if there was none.
    pub refit_seconds: f64,
    /// Number of triangles, those of a mesh with instances counted once, whose trees were taken over from an earlier scene
    /// ([`commit_from`](Scene::commit_from)).
    pub kept_triangles: u64,
}

/// A committed scene. Queries are safe from any number of threads.
pub struct Scene {
    pub(super) device: Arc<Device>,
    pub(super) data: SceneData,
    /// Lights, shared by a scene and all copies that refits make of it: light maps keep following them.
    pub(super) lights: Arc<RwLock<Arc<Vec<Light>>>>,
    pub(super) emitters: Vec<Emitter>,
    /// First global triangle number per object, and the total at the end.
    pub(super) first_triangle: Vec<u32>,
    pub(super) bounds: (Vec3, Vec3),
    /// Length of the bounding box's diagonal, or the largest coordinate that placing instances goes through, if that is
    /// more: the precision of rays follows it, beside the point where they start.
    pub(super) extent: f32,
    /// Tree of the meshes without instances.
    pub(super) tree: Tree,
    /// Whether a refit has moved a mesh in it: a tree built anew may be better, and have triangles that were none.
    pub(super) is_refitted: bool,
    /// Triangles that are not in that tree, ascending.
    pub(super) skipped: Vec<u32>,
    /// Trees of meshes with instances; `None` if there are none.
    pub(super) instances: Option<Box<Instances>>,
    /// The tree in parts at which rays wait, if that was asked for.
    pub(super) parts: Option<Box<WaitingRays>>,
    /// The file that the scene lies in, if it was mapped.
    pub(super) file: Option<WatchedFile>,
    pub(super) uses: Uses,
    pub(super) stats: SceneStats,
    pub(super) _memory: Reservation,
}

/// Features of materials that a scene uses.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Uses {
    /// Whether a texture colours a surface.
    pub textures: bool,
    /// Whether each material has cut-outs; empty if no surface has any.
    pub holes: Vec<bool>,
    /// Whether light passes through a surface.
    pub transmission: bool,
    /// Whether a surface is opaque and one-sided, as those of solids: light does not get behind it.
    pub solids: bool,
}

impl Scene {
    /// The device of the scene.
    pub fn device(&self) -> &Arc<Device> {
        &self.device
    }

    /// Number of bytes of meshes and trees that lie in scratch files, or in the file that the scene was opened from.
    pub(super) fn bytes_in_files(&self) -> usize {
        let trees = self.instances.iter().flat_map(|i| i.trees.iter().map(|t| &t.tree)).chain([&self.tree]);
        self.data.bytes() - self.data.bytes_in_memory() + trees.map(Tree::mapped_bytes).sum::<usize>()
    }

    /// Fails if the scene lies in a mapped file that somebody has changed since: nothing that was computed after that can
    /// be believed.
    pub(crate) fn check_file(&self) -> Result<()> {
        self.file.as_ref().map_or(Ok(()), WatchedFile::check)
    }

    /// Does work that reads the scene. If its mapped file is changed meanwhile, that is the error, whatever the work came to:
    /// even panics, as of numbers that lead nowhere.
    pub(crate) fn while_unchanged<R>(&self, work: impl FnOnce() -> Result<R>) -> Result<R> {
        let Some(file) = &self.file else { return work() };
        file.check()?;
        let done = catch_unwind(AssertUnwindSafe(work));
        file.check()?;
        done.unwrap_or_else(|panic| resume_unwind(panic))
    }

    /// The meshes, by number.
    pub fn meshes(&self) -> &[Mesh] {
        &self.data.meshes
    }

    /// The instances, by number.
    pub fn instances(&self) -> &[Instance] {
        self.data.instances()
    }

    /// The objects as meshes: see [`SceneData::flattened`].
    pub fn flattened(&self) -> Cow<'_, [Mesh]> {
        self.data.flattened()
    }

    /// Number of [objects](Object).
    pub fn object_count(&self) -> u32 {
        self.first_triangle.len() as u32 - 1
    }

    /// Object number `number`, which must exist.
    #[inline]
    pub fn object(&self, number: u32) -> Object<'_> {
        self.data.object(number)
    }

    /// The global numbers of an object's triangles.
    #[inline]
    pub fn triangles_of(&self, object: u32) -> Range<u32> {
        self.first_triangle[object as usize]..self.first_triangle[object as usize + 1]
    }

    /// The global numbers of the triangles of all meshes without instances.
    pub fn triangles_of_meshes(&self) -> Range<u32> {
        0..self.first_triangle[self.data.meshes.len()]
    }

    /// Whether a mesh has instances, and stands nowhere else.
    pub fn is_instanced(&self, mesh: u32) -> bool {
        self.data.is_instanced(mesh)
    }

    /// Returns the instance whose texels and light an instance, which must exist, shows: itself, or another one.
    pub fn light_of_instance(&self, instance: u32) -> u32 {
        self.data.light_of_instance(instance)
    }

    /// Whether an object is an instance that shows the light of another one.
    pub(crate) fn shows_light_of_other(&self, object: u32) -> bool {
        self.data.shows_light_of_other(object)
    }

    /// Whether `other` is this scene in another state: as it was before refits, or is after them.
    pub(crate) fn is_state_of(&self, other: &Scene) -> bool {
        Arc::ptr_eq(&self.lights, &other.lights)
    }

    /// The number of the object that an instance is.
    pub fn object_of_instance(&self, instance: u32) -> u32 {
        self.data.meshes.len() as u32 + instance
    }

    /// The materials, by number.
    pub fn materials(&self) -> &[Material] {
        &self.data.materials
    }

    /// The textures, by number.
    pub fn textures(&self) -> &[Arc<Texture>] {
        &self.data.textures
    }

    /// The features of materials that the scene uses.
    #[inline]
    pub(crate) fn uses(&self) -> &Uses {
        &self.uses
    }

    /// The images of skies, by number.
    pub fn environments(&self) -> &[Arc<Environment>] {
        &self.data.environments
    }

    /// A snapshot of the lights, by number.
    pub fn lights(&self) -> Arc<Vec<Light>> {
        self.lights.read().unwrap_or_else(|e| e.into_inner()).clone()
    }

    /// A sky light prepared for sampling; `None` for other lights.
    pub fn sky(&self, light: &Light) -> Option<Sky> {
        let Light::Sky { radiance, environment, up, rotation } = *light else { return None };
        Some(Sky::new(radiance, environment, up, rotation, self.environments()))
    }

    /// Replaces light `id`. Bakes that are running keep the lights that they started with.
    pub fn set_light(&self, id: u32, light: Light) -> Result<()> {
        light.validate()?;
        light.check_environment(self.environments().len())?;
        let mut lights = self.lights.write().unwrap_or_else(|e| e.into_inner());
        let count = lights.len();
        if id as usize >= count {
            return invalid_argument!("light {id} does not exist, the scene has {count}");
        }
        // Makes a copy if a bake holds the lights.
        Arc::make_mut(&mut lights)[id as usize] = light.normalized();
        Ok(())
    }

    /// The emissive triangles.
    pub fn emitters(&self) -> &[Emitter] {
        &self.emitters
    }

    /// Lower and upper corner of the bounding box of all valid triangles; for instances, of the boxes around their meshes'.
    pub fn bounds(&self) -> (Vec3, Vec3) {
        self.bounds
    }

    /// Length of the bounding box's diagonal.
    pub fn diagonal(&self) -> f32 {
        (self.bounds.1 - self.bounds.0).length()
    }

    /// Statistics of the scene.
    pub fn stats(&self) -> &SceneStats {
        &self.stats
    }

    /// Number of triangles of all objects; global triangle numbers are below it.
    pub fn triangle_count(&self) -> u32 {
        *self.first_triangle.last().expect("never empty")
    }

    /// The number of the [object](Object), and the triangle in its mesh, of a global triangle number.
    #[inline]
    pub fn locate(&self, triangle: u32) -> (u32, u32) {
        let object = object_of(&self.first_triangle, triangle);
        (object as u32, triangle - self.first_triangle[object])
    }

    /// The global number of an object's first triangle.
    pub fn first_triangle(&self, object: u32) -> u32 {
        self.first_triangle[object as usize]
    }

    /// The corners of a triangle by its global number.
    #[inline]
    pub fn corners(&self, triangle: u32) -> [Vec3; 3] {
        let (o, t) = self.locate(triangle);
        self.object(o).corners(t)
    }

    /// Whether a triangle, by its global number, is valid (not skipped by the build, and not made degenerate by a
    /// refit).
    pub fn is_valid(&self, triangle: u32) -> bool {
        let (o, t) = self.locate(triangle);
        is_valid_triangle(self.object(o).corners(t)) && !self.is_skipped(o, t)
    }

    /// Whether a triangle of a mesh, whether that has instances or not, is in no tree.
    pub(super) fn is_skipped_in_mesh(&self, mesh: u32, triangle: u32) -> bool {
        let of_instances = || {
            let trees = &self.instance_trees()?.trees;
            trees.binary_search_by_key(&mesh, |t| t.mesh).ok().map(|i| &trees[i])
        };
        match of_instances() {
            Some(tree) => tree.skipped.binary_search(&triangle).is_ok(),
            None => self.is_skipped(mesh, triangle),
        }
    }

    /// Whether a triangle of an object is in no tree.
    pub(super) fn is_skipped(&self, object: u32, triangle: u32) -> bool {
        let first = self.first_triangle(object);
        instance_trees::is_skipped(&self.data, &self.skipped, self.instance_trees(), object, triangle, first)
    }

    /// The material of a triangle by its global number.
    #[inline]
    pub fn material(&self, triangle: u32) -> &Material {
        &self.data.materials[self.material_id(triangle) as usize]
    }

    /// The material number of a triangle by its global number.
    #[inline]
    pub fn material_id(&self, triangle: u32) -> u32 {
        let (o, t) = self.locate(triangle);
        self.object(o).mesh().material(t as usize)
    }

    /// Diffuse reflectance at a point of a triangle, given by its global number, with weights `u` and `v` of its
    /// corners 1 and 2: the material's, multiplied with its texture.
    #[inline]
    pub fn albedo(&self, triangle: u32, u: f32, v: f32) -> Vec3 {
        let (o, t) = self.locate(triangle);
        let mesh = self.object(o).mesh();
        let material = &self.data.materials[mesh.material(t as usize) as usize];
        self.albedo_at(material, || mesh.texture_coordinates(t as usize, u, v))
    }

    /// Diffuse reflectance of a material at the texture coordinates that `uv` returns; `uv` is called for textured
    /// materials only.
    #[inline]
    pub(crate) fn albedo_at(&self, material: &Material, uv: impl FnOnce() -> Option<Vec2>) -> Vec3 {
        let factor = Vec3::from(material.albedo);
        match self.data.textures.get(material.albedo_texture as usize) {
            None => factor,
            Some(texture) => uv().map_or(factor, |uv| factor * texture.color(uv)).min(Vec3::splat(MAX_ALBEDO)),
        }
    }

    /// Whether a point of a triangle, given by its global number, with weights `u` and `v` of its corners 1 and 2, is
    /// cut out.
    pub fn is_hole(&self, triangle: u32, u: f32, v: f32) -> bool {
        if self.uses.holes.is_empty() {
            return false;
        }
        let (o, t) = self.locate(triangle);
        let mesh = self.object(o).mesh();
        let id = mesh.material(t as usize) as usize;
        if !self.uses.holes[id] {
            return false;
        }
        let material = &self.data.materials[id];
        let texture = self.data.textures.get(material.albedo_texture as usize);
        match (texture, mesh.texture_coordinates(t as usize, u, v)) {
            (Some(texture), Some(uv)) => texture.alpha(uv) < material.alpha_cutoff,
            _ => false,
        }
    }

    /// Unit geometric normal of a triangle by its global number (computed in f64: accurate for slivers too).
    #[inline]
    pub fn normal(&self, triangle: u32) -> Vec3 {
        unit_normal(self.corners(triangle))
    }

    /// The tree of the meshes without instances, with the first global triangle number per object and the total at
    /// the end.
    #[inline]
    pub(crate) fn acceleration(&self) -> (&Tree, &[u32]) {
        (&self.tree, &self.first_triangle)
    }

    /// The same tree in parts at which rays wait, if that was asked for.
    #[inline]
    pub(crate) fn parts(&self) -> Option<&WaitingRays> {
        self.parts.as_deref()
    }

    /// The trees of meshes with instances, if there are any.
    #[inline]
    pub(crate) fn instance_trees(&self) -> Option<&Instances> {
        self.instances.as_deref()
    }
}

/// The object of a global triangle number, given the first triangle of each.
#[inline]
pub(super) fn object_of(first_triangle: &[u32], triangle: u32) -> usize {
    first_triangle.partition_point(|&first| first <= triangle) - 1
}
