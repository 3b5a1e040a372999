//! The committed scene: acceleration structure, emitters, bounds and numbers.

use super::mesh::is_valid_triangle;
use super::{Environment, Light, MAX_ALBEDO, Material, Mesh, MeshMaterials, NONE, SceneData, Sky, Texture};
use crate::bvh::{self, BuildOptions, Tree};
use crate::device::{Device, LogLevel};
use crate::error::{Error, Result, invalid_argument};
use crate::memory::{Reservation, try_par_filter, try_to_vec, try_with_capacity};
use crate::progress::Progress;
use crate::trace::offset::too_few_digits;
use crate::trace::{Hit, RawHit, Ray, TreeView, View};
use glam::{Vec2, Vec3};
use rayon::prelude::*;
use std::collections::HashMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, RwLock};
use std::time::Instant;

/// Triangles that a thread takes at a time.
const CHUNK: usize = 1 << 12;

/// The offset of rays from surfaces from which on a warning is due, as a part of the scene's diagonal. (The
/// Cornell box at 1,000 times its size from the origin: 1/900, irradiance wrong by 0.7 %; at 10,000: 14 %.)
const OFFSET_PART: f32 = 1.0 / 256.0;

/// An emissive triangle, as a light.
#[derive(Clone, Copy, Debug)]
pub struct Emitter {
    /// Global triangle number.
    pub triangle: u32,
    /// Corner 0 and the edges to corners 1 and 2.
    pub corner: Vec3,
    pub edge_u: Vec3,
    pub edge_v: Vec3,
    /// Unit geometric normal.
    pub normal: Vec3,
    pub area: f32,
    /// W/(m²·sr).
    pub radiance: [f32; 3],
    pub two_sided: bool,
}

/// Numbers about a committed scene.
#[derive(Clone, Copy, Debug, Default)]
pub struct SceneStats {
    /// Triangles in all meshes.
    pub triangles: u64,
    /// Of those, degenerate or not finite at the commit, or since a refit: not in the tree, or in it and
    /// never hit.
    pub skipped_degenerate: u64,
    /// 8-wide nodes.
    pub nodes: u64,
    /// Bytes of the acceleration structure.
    pub bvh_bytes: u64,
    /// Of these, of its nodes.
    pub node_bytes: u64,
    /// Bytes of the whole committed scene.
    pub bytes: u64,
    /// Surface area heuristic cost of the binary tree, traversal and intersection costing 1 each. A refit
    /// leaves it as it was.
    pub sah_cost: f32,
    /// Wall time of the build.
    pub build_seconds: f64,
    /// Surface area heuristic cost of the 8-wide tree as it is now, per node and per triangle 1: compared with
    /// its value after the commit, it tells how much a refitted tree has lost.
    pub wide_sah_cost: f32,
    /// Refits since the commit.
    pub refits: u32,
    /// Wall time of the last refit, 0 if there was none.
    pub refit_seconds: f64,
}

/// A committed scene. Queries are safe from any number of threads.
pub struct Scene {
    device: Arc<Device>,
    data: SceneData,
    /// One for a scene and all copies that refits make of it: light maps go on following the lights.
    lights: Arc<RwLock<Arc<Vec<Light>>>>,
    emitters: Vec<Emitter>,
    /// First global triangle number per mesh, and the total at the end.
    first_triangle: Vec<u32>,
    bounds: (Vec3, Vec3),
    tree: Tree,
    /// Triangles that are not in the tree, ascending.
    skipped: Vec<u32>,
    uses: Uses,
    stats: SceneStats,
    _memory: Reservation,
}

/// What a scene uses of what materials can do.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Uses {
    /// Whether a texture colours a surface.
    pub textures: bool,
    /// By material, whether it has holes; empty if none that a surface has does.
    pub holes: Vec<bool>,
    /// Whether light passes through a surface.
    pub transmission: bool,
    /// Whether a surface is opaque and shows one side only, as those of solids: light does not get behind it.
    pub solids: bool,
}

impl Uses {
    fn of(data: &SceneData) -> Uses {
        // Holes need texels that are less opaque than the cutoff.
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
    /// Builds the acceleration structure. On an error, a panic included, `data` comes back unharmed.
    // Once per scene: what is handed back may be large.
    #[allow(clippy::result_large_err)]
    pub fn commit(
        device: &Arc<Device>,
        data: SceneData,
        options: &BuildOptions,
        progress: &Progress,
    ) -> std::result::Result<Arc<Scene>, (SceneData, Error)> {
        // The build only reads `data`, and what it has made of it is gone with a panic.
        let build = AssertUnwindSafe(|| device.run(progress, || Self::build(device, &data, options, progress)));
        let built = catch_unwind(build).unwrap_or_else(|payload| Err(Error::of_panic(payload)));
        match built {
            Ok(parts) => {
                let scene = Arc::new(parts.into_scene(device.clone(), data));
                scene.warn_of_few_digits();
                Ok(scene)
            }
            Err(e) => Err((data, e)),
        }
    }

    /// Moves vertices: `moved` names meshes and the new positions of all their vertices. (Of a mesh that is
    /// named twice the last holds.) The tree keeps its shape and gets new boxes, which takes a fraction of a
    /// commit; so it serves well as long as neighbours stay neighbours, and
    /// [`wide_sah_cost`](SceneStats::wide_sah_cost) tells when a new commit would be better. Emitters, bounds
    /// and numbers are renewed; shading normals, texture and light map coordinates stay as they were given.
    ///
    /// If `scene` is the only reference, it is changed in place; otherwise it is replaced by a copy, and who
    /// holds the other references (light maps, live objects) keeps the old geometry and shares the lights.
    ///
    /// Triangles that become degenerate or not finite are not hit while they are; those that were so at the
    /// commit are not in the tree and stay out whatever becomes of them. After a build with spatial splits,
    /// boxes become those of whole triangles: right, but larger than before.
    ///
    /// Fails, and leaves `scene` as it was, if a mesh does not exist, has another number of vertices or is
    /// strict and gets a degenerate triangle or a vertex that is not finite; if no triangle would be left that
    /// a ray can hit; or if memory is refused.
    pub fn refit(scene: &mut Arc<Scene>, moved: &[(u32, &[Vec3])]) -> Result<()> {
        let start = Instant::now();
        for &(mesh, positions) in moved {
            scene.check_positions(mesh, positions)?;
        }
        if !scene.any_left(moved) {
            return Err(Error::InvalidState("all triangles of the scene would be degenerate or not finite".into()));
        }
        // All memory before anything changes.
        let emitters = try_with_capacity(emissive_triangles(&scene.data), EMITTERS)?;
        let room = scene.tree.room_to_refit()?;
        if Arc::get_mut(scene).is_none() {
            *scene = Arc::new(scene.copy()?);
        }
        let device = scene.device.clone();
        let scene = Arc::get_mut(scene).expect("a new Arc, or the only one");
        for &(mesh, positions) in moved {
            scene.data.meshes[mesh as usize].positions.copy_from_slice(positions);
        }
        device.install(|| scene.follow_positions(emitters, room));
        scene.stats.refits += 1;
        scene.stats.refit_seconds = start.elapsed().as_secs_f64();
        Ok(())
    }

    /// Whether [`refit`](Self::refit) takes these positions for a mesh.
    pub fn check_positions(&self, mesh: u32, positions: &[Vec3]) -> Result<()> {
        let meshes = self.meshes();
        match meshes.get(mesh as usize) {
            None => invalid_argument!("mesh {mesh} does not exist, the scene has {}", meshes.len()),
            Some(m) => m.check_positions(positions),
        }
    }

    /// Whether a triangle of the tree could be hit with vertices moved.
    fn any_left(&self, moved: &[(u32, &[Vec3])]) -> bool {
        let new: HashMap<u32, &[Vec3]> = moved.iter().copied().collect();
        (0..).zip(self.meshes()).zip(&self.first_triangle).any(|((m, mesh), &first)| {
            let positions = new.get(&m).copied().unwrap_or(&mesh.positions);
            (first..).zip(&mesh.indices).any(|(t, i)| {
                is_valid_triangle(i.map(|i| positions[i as usize])) && self.skipped.binary_search(&t).is_err()
            })
        })
    }

    /// Logs a warning if the scene lies so far from the origin, for its size, that light is wrong.
    fn warn_of_few_digits(&self) {
        if let Some(message) = too_few_digits(self, "a scene with a diagonal", self.diagonal(), OFFSET_PART) {
            self.device.log(LogLevel::Warning, &message);
        }
    }

    /// Brings up to date what follows from the positions. `emitters` has room for all there may be.
    fn follow_positions(&mut self, mut emitters: Vec<Emitter>, room: bvh::RefitRoom) {
        let (first, meshes) = (&self.first_triangle, &self.data.meshes);
        let corners = |t: u32| {
            let m = first.partition_point(|&first| first <= t) - 1;
            meshes[m].corners((t - first[m]) as usize)
        };
        let out = self.tree.refit(&corners, room);
        if !out.is_empty() {
            let total = self.stats.triangles;
            let message = format!("{} of {total} triangles are degenerate or not finite after the refit", out.len());
            self.device.log(LogLevel::Warning, &message);
        }
        self.bounds = self.tree.bounds();
        add_emitters(&self.data, &self.first_triangle, &self.skipped, &mut emitters);
        self.emitters = emitters;
        self.stats.skipped_degenerate = (self.skipped.len() + out.len()) as u64;
        self.stats.wide_sah_cost = self.tree.sah_cost();
        self.warn_of_few_digits();
    }

    /// A scene of its own that is equal, lights shared.
    fn copy(&self) -> Result<Scene> {
        // Textures and environments are shared.
        let bytes = self.tree.bytes() + self.data.mesh_bytes();
        let memory = self.device.memory().reserve(bytes, COPY)?;
        Ok(Scene {
            device: self.device.clone(),
            data: self.data.try_clone()?,
            lights: self.lights.clone(),
            emitters: Vec::new(),
            first_triangle: try_to_vec(&self.first_triangle, COPY)?,
            bounds: self.bounds,
            tree: self.tree.try_clone()?,
            skipped: try_to_vec(&self.skipped, COPY)?,
            uses: self.uses.clone(),
            stats: self.stats,
            _memory: memory,
        })
    }

    fn build(device: &Arc<Device>, data: &SceneData, options: &BuildOptions, progress: &Progress) -> Result<Parts> {
        let start = Instant::now();
        let total = data.triangle_count();
        if total == 0 {
            return Err(Error::InvalidState("the scene has no triangles".into()));
        }
        let stage = progress.stage("bvh", 0.0, 1.0, 1);
        let mut first_triangle = try_with_capacity(data.meshes.len() + 1, "the scene")?;
        let mut corners = crate::memory::try_vec::<[Vec3; 3]>(total, "the triangles to build from")?;
        let valid = device.install(|| {
            let mut next = 0;
            for mesh in &data.meshes {
                first_triangle.push(next as u32);
                let corners = &mut corners[next..next + mesh.indices.len()];
                corners.par_iter_mut().with_min_len(CHUNK).enumerate().for_each(|(t, c)| *c = mesh.corners(t));
                next += mesh.indices.len();
            }
            first_triangle.push(next as u32);
            try_par_filter(total, "the triangles to build from", |t| is_valid_triangle(corners[t as usize]))
        })?;
        progress.check()?;
        if valid.is_empty() {
            return Err(Error::InvalidState(format!(
                "all {total} triangles of the scene are degenerate or not finite"
            )));
        }
        let skipped: Vec<u32> = if valid.len() == total {
            Vec::new()
        } else {
            try_par_filter(total, "the triangles that are skipped", |t| !is_valid_triangle(corners[t as usize]))?
        };
        if !skipped.is_empty() {
            device.log(
                LogLevel::Warning,
                &format!("{} of {total} triangles are degenerate or not finite and were skipped", skipped.len()),
            );
        }
        let meshes = data.bytes();
        let mut memory = device.memory().reserve(meshes + bvh::estimated_bytes(valid.len(), options), "the scene")?;
        let (tree, sah_cost) = device.install(|| bvh::build(&corners, &valid, &first_triangle, options, progress))?;
        progress.check()?;

        let mut emitters = try_with_capacity(emissive_triangles(data), EMITTERS)?;
        add_emitters(data, &first_triangle, &skipped, &mut emitters);
        stage.advance(1)?;
        let bytes = tree.bytes() + meshes;
        memory.shrink(bytes);
        let bounds = tree.bounds();
        let wide_sah_cost = device.install(|| tree.sah_cost());
        let stats = SceneStats {
            triangles: total as u64,
            skipped_degenerate: skipped.len() as u64,
            nodes: tree.node_count() as u64,
            bvh_bytes: tree.bytes() as u64,
            node_bytes: tree.node_bytes() as u64,
            bytes: bytes as u64,
            sah_cost,
            build_seconds: start.elapsed().as_secs_f64(),
            wide_sah_cost,
            refits: 0,
            refit_seconds: 0.0,
        };
        Ok(Parts { emitters, first_triangle, bounds, tree, skipped, uses: Uses::of(data), stats, memory })
    }

    /// The device that the scene lives on.
    pub fn device(&self) -> &Arc<Device> {
        &self.device
    }

    /// The meshes, by number.
    pub fn meshes(&self) -> &[Mesh] {
        &self.data.meshes
    }

    /// The materials, by number.
    pub fn materials(&self) -> &[Material] {
        &self.data.materials
    }

    /// The textures, by number.
    pub fn textures(&self) -> &[Arc<Texture>] {
        &self.data.textures
    }

    /// What it uses of what materials can do.
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

    /// A sky light as it is sampled; `None` for other lights.
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
        // A copy, if a bake holds them.
        Arc::make_mut(&mut lights)[id as usize] = light.normalized();
        Ok(())
    }

    /// The emissive triangles.
    pub fn emitters(&self) -> &[Emitter] {
        &self.emitters
    }

    /// Lower and upper corner of the bounding box of all valid triangles.
    pub fn bounds(&self) -> (Vec3, Vec3) {
        self.bounds
    }

    /// Length of the bounding box's diagonal.
    pub fn diagonal(&self) -> f32 {
        (self.bounds.1 - self.bounds.0).length()
    }

    /// Numbers about the scene.
    pub fn stats(&self) -> &SceneStats {
        &self.stats
    }

    /// Triangles in all meshes; global triangle numbers run below this.
    pub fn triangle_count(&self) -> u32 {
        *self.first_triangle.last().expect("never empty")
    }

    /// The mesh and the triangle in it of a global triangle number.
    #[inline]
    pub fn locate(&self, triangle: u32) -> (u32, u32) {
        let mesh = self.first_triangle.partition_point(|&first| first <= triangle) - 1;
        (mesh as u32, triangle - self.first_triangle[mesh])
    }

    /// The global number of a mesh's first triangle.
    pub fn first_triangle(&self, mesh: u32) -> u32 {
        self.first_triangle[mesh as usize]
    }

    /// The corners of a global triangle number.
    #[inline]
    pub fn corners(&self, triangle: u32) -> [Vec3; 3] {
        let (m, t) = self.locate(triangle);
        self.data.meshes[m as usize].corners(t as usize)
    }

    /// Whether a global triangle number is a valid triangle (not skipped by the build, and not made degenerate
    /// by a refit).
    pub fn is_valid(&self, triangle: u32) -> bool {
        is_valid_triangle(self.corners(triangle)) && self.skipped.binary_search(&triangle).is_err()
    }

    /// The material of a global triangle number.
    #[inline]
    pub fn material(&self, triangle: u32) -> &Material {
        &self.data.materials[self.material_id(triangle) as usize]
    }

    /// The material number of a global triangle number.
    #[inline]
    pub fn material_id(&self, triangle: u32) -> u32 {
        let (m, t) = self.locate(triangle);
        self.data.meshes[m as usize].material(t as usize)
    }

    /// Diffuse reflectance at a point of a global triangle number, with weights `u` and `v` of its corners 1
    /// and 2: the material's, multiplied with its texture.
    #[inline]
    pub fn albedo(&self, triangle: u32, u: f32, v: f32) -> Vec3 {
        let (m, t) = self.locate(triangle);
        let mesh = &self.data.meshes[m as usize];
        let material = &self.data.materials[mesh.material(t as usize) as usize];
        self.albedo_at(material, || mesh.texture_coordinates(t as usize, u, v))
    }

    /// The same of a material at the texture coordinates that `uv` tells, which textured ones ask for.
    #[inline]
    pub(crate) fn albedo_at(&self, material: &Material, uv: impl FnOnce() -> Option<Vec2>) -> Vec3 {
        let factor = Vec3::from(material.albedo);
        match self.data.textures.get(material.albedo_texture as usize) {
            None => factor,
            Some(texture) => uv().map_or(factor, |uv| factor * texture.color(uv)).min(Vec3::splat(MAX_ALBEDO)),
        }
    }

    /// Whether a point of a global triangle number, with weights `u` and `v` of its corners 1 and 2, is a hole.
    pub fn is_hole(&self, triangle: u32, u: f32, v: f32) -> bool {
        if self.uses.holes.is_empty() {
            return false;
        }
        let (m, t) = self.locate(triangle);
        let mesh = &self.data.meshes[m as usize];
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

    /// Unit geometric normal of a global triangle number (f64 inside: right for slivers too).
    #[inline]
    pub fn normal(&self, triangle: u32) -> Vec3 {
        unit_normal(self.corners(triangle))
    }

    /// The acceleration structure, for kernels.
    #[inline]
    pub(crate) fn tree(&self) -> TreeView<'_> {
        match &self.tree {
            Tree::Whole(tree) => TreeView::Whole(tree),
            Tree::Compact(tree) => {
                // SAFETY: the tree was built of these meshes, which `SceneData` has validated; refits change
                // positions alone.
                TreeView::Compact(unsafe { View::new(tree, &self.data.meshes, &self.first_triangle) })
            }
        }
    }

    /// Closest hit with `tmin < t ≤ tmax`.
    pub fn intersect(&self, ray: &Ray) -> Hit {
        self.to_hit(self.intersect_raw(ray))
    }

    /// From global to (mesh, triangle) numbers.
    #[inline]
    pub fn to_hit(&self, hit: RawHit) -> Hit {
        if hit.triangle == NONE {
            return Hit::MISS;
        }
        let (mesh, triangle) = self.locate(hit.triangle);
        Hit { t: hit.t, u: hit.u, v: hit.v, triangle, mesh, instance: NONE }
    }

    /// The same of many. Neighbours mostly hit the same mesh, which is then looked up once.
    pub(crate) fn to_hits(&self, hits: &[RawHit], out: &mut [Hit]) {
        let (mut mesh, mut begin, mut end) = (0, 0, 0);
        for (out, hit) in out.iter_mut().zip(hits) {
            if hit.triangle == NONE {
                *out = Hit::MISS;
                continue;
            }
            if !(begin..end).contains(&hit.triangle) {
                mesh = self.locate(hit.triangle).0;
                begin = self.first_triangle[mesh as usize];
                end = self.first_triangle.get(mesh as usize + 1).copied().unwrap_or(u32::MAX);
            }
            *out = Hit { t: hit.t, u: hit.u, v: hit.v, triangle: hit.triangle - begin, mesh, instance: NONE };
        }
    }
}

/// Unit normal of a valid triangle, computed in f64.
#[inline]
pub fn unit_normal(corners: [Vec3; 3]) -> Vec3 {
    let [a, b, c] = corners.map(|c| c.as_dvec3());
    (b - a).cross(c - a).normalize_or_zero().as_vec3()
}

struct Parts {
    emitters: Vec<Emitter>,
    first_triangle: Vec<u32>,
    bounds: (Vec3, Vec3),
    tree: Tree,
    skipped: Vec<u32>,
    uses: Uses,
    stats: SceneStats,
    memory: Reservation,
}

impl Parts {
    fn into_scene(self, device: Arc<Device>, data: SceneData) -> Scene {
        let Parts { emitters, first_triangle, bounds, tree, skipped, uses, stats, memory } = self;
        let lights = Arc::new(RwLock::new(Arc::new(data.lights.clone())));
        Scene { device, data, lights, emitters, first_triangle, bounds, tree, skipped, uses, stats, _memory: memory }
    }
}

/// What buffers are for, in errors.
const COPY: &str = "a copy of the scene to refit";
const EMITTERS: &str = "the emissive triangles";

/// The number of triangles with a material that emits.
fn emissive_triangles(data: &SceneData) -> usize {
    let emits = |m: u32| data.materials[m as usize].is_emissive();
    let of_mesh = |mesh: &Mesh| match &mesh.materials {
        MeshMaterials::One(m) if mesh.indices.is_empty() || !emits(*m) => 0,
        MeshMaterials::One(_) => mesh.indices.len(),
        MeshMaterials::PerTriangle(materials) => materials.iter().filter(|&&m| emits(m)).count(),
    };
    data.meshes.iter().map(of_mesh).sum()
}

/// Adds the emissive triangles that are valid and not `skipped`.
fn add_emitters(data: &SceneData, first_triangle: &[u32], skipped: &[u32], emitters: &mut Vec<Emitter>) {
    for (m, mesh) in data.meshes.iter().enumerate() {
        if let MeshMaterials::One(material) = mesh.materials
            && !data.materials[material as usize].is_emissive()
        {
            continue;
        }
        for t in 0..mesh.indices.len() {
            let (material, id) = (&data.materials[mesh.material(t) as usize], first_triangle[m] + t as u32);
            if material.is_emissive() && is_valid_triangle(mesh.corners(t)) && skipped.binary_search(&id).is_err() {
                emitters.push(emitter(id, mesh.corners(t), material));
            }
        }
    }
}

fn emitter(triangle: u32, corners: [Vec3; 3], material: &Material) -> Emitter {
    let [a, b, c] = corners;
    let cross = (b - a).as_dvec3().cross((c - a).as_dvec3());
    Emitter {
        triangle,
        corner: a,
        edge_u: b - a,
        edge_v: c - a,
        normal: cross.normalize_or_zero().as_vec3(),
        area: (0.5 * cross.length()) as f32,
        radiance: material.emission,
        two_sided: material.two_sided,
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

    /// A floor (mesh 0), a lamp over it (mesh 1, emissive), and a triangle that is none (mesh 2).
    fn scene() -> Arc<Scene> {
        let mut data = SceneData::new();
        data.add_material(Material::default()).unwrap();
        data.add_material(Material { emission: [2.0; 3], ..Default::default() }).unwrap();
        let light = Light::Point { position: Vec3::Z, intensity: [1.0; 3] };
        data.add_light(light).unwrap();
        let mesh = |positions: Vec<Vec3>, material| Mesh {
            indices: (0..positions.len() as u32 / 3).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect(),
            positions,
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
        let plain = Mesh { positions: FLOOR.to_vec(), indices: vec![[0, 1, 2]], ..Default::default() };
        data.add_mesh(Mesh { uvs: vec![Vec2::ZERO; 3], ..plain.clone() }).unwrap();
        data.add_mesh(plain).unwrap();
        let scene = data.committed();
        // ((128/255 + 0.055) / 1.055)^2.4.
        let expected = Vec3::new(MAX_ALBEDO, 0.215_861, 0.5 * 0.215_861);
        assert!((scene.albedo(0, 0.2, 0.3) - expected).abs().max_element() < 1e-6);
        assert_eq!(scene.albedo(1, 0.2, 0.3), Vec3::new(MAX_ALBEDO, MAX_ALBEDO, 0.5));
    }

    #[test]
    fn a_commit_that_panics_or_is_cancelled_gives_the_description_back() {
        let device = Device::new(DeviceOptions { num_threads: 1, ..Default::default() }).unwrap();
        let mut data = SceneData::new();
        data.add_material(Material::default()).unwrap();
        let mesh = || Mesh { positions: FLOOR.to_vec(), indices: vec![[0, 1, 2]], ..Default::default() };
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
                move |_: LogLevel, message: &str| messages.lock().unwrap().push(message.to_owned())
            };
            let options = DeviceOptions { num_threads: 1, log: Some(Box::new(log)), ..Default::default() };
            let device = Device::new(options).unwrap();
            let mut data = SceneData::new();
            data.add_material(Material::default()).unwrap();
            let positions = FLOOR.map(|c| c + Vec3::splat(offset)).to_vec();
            data.add_mesh(Mesh { positions, indices: vec![[0, 1, 2]], ..Default::default() }).unwrap();
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
