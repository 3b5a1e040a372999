//! The committed scene: acceleration structure, emitters, bounds and numbers.

use super::mesh::is_valid_triangle;
use super::{Light, Material, Mesh, MeshMaterials, NONE, SceneData};
use crate::bvh::{self, BuildOptions, Mbvh};
use crate::device::{Device, LogLevel};
use crate::error::{Error, Result};
use crate::memory::Reservation;
use crate::progress::Progress;
use crate::trace::{Hit, RawHit, Ray};
use glam::Vec3;
use rayon::prelude::*;
use std::sync::{Arc, RwLock};
use std::time::Instant;

/// Triangles that a thread takes at a time.
const CHUNK: usize = 1 << 12;

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
    /// Of those, skipped as degenerate or not finite.
    pub skipped_degenerate: u64,
    /// 4-wide nodes.
    pub nodes: u64,
    /// Bytes of the acceleration structure.
    pub bvh_bytes: u64,
    /// Bytes of the whole committed scene.
    pub bytes: u64,
    /// Surface area heuristic cost of the binary tree, traversal and intersection costing 1 each.
    pub sah_cost: f32,
    /// Wall time of the build.
    pub build_seconds: f64,
}

/// A committed scene. Queries are safe from any number of threads.
pub struct Scene {
    device: Arc<Device>,
    data: SceneData,
    lights: RwLock<Arc<Vec<Light>>>,
    emitters: Vec<Emitter>,
    /// First global triangle number per mesh, and the total at the end.
    first_triangle: Vec<u32>,
    bounds: (Vec3, Vec3),
    mbvh: Mbvh,
    stats: SceneStats,
    _memory: Reservation,
}

impl Scene {
    /// Builds the acceleration structure. On an error, `data` comes back unharmed.
    pub fn commit(
        device: &Arc<Device>,
        data: SceneData,
        options: &BuildOptions,
        progress: &Progress,
    ) -> std::result::Result<Arc<Scene>, (SceneData, Error)> {
        match Self::build(device, &data, options, progress) {
            Ok(parts) => Ok(Arc::new(parts.into_scene(device.clone(), data))),
            Err(e) => Err((data, e)),
        }
    }

    fn build(device: &Arc<Device>, data: &SceneData, options: &BuildOptions, progress: &Progress) -> Result<Parts> {
        let start = Instant::now();
        let total = data.triangle_count();
        if total == 0 {
            return Err(Error::InvalidState("the scene has no triangles".into()));
        }
        let stage = progress.stage("bvh", 0.0, 1.0, 1);
        let mut first_triangle = Vec::with_capacity(data.meshes.len() + 1);
        let mut corners = crate::memory::try_vec::<[Vec3; 3]>(total, "the triangles to build from")?;
        let valid: Vec<u32> = device.install(|| {
            let mut next = 0;
            for mesh in &data.meshes {
                first_triangle.push(next as u32);
                let corners = &mut corners[next..next + mesh.indices.len()];
                corners.par_iter_mut().with_min_len(CHUNK).enumerate().for_each(|(t, c)| *c = mesh.corners(t));
                next += mesh.indices.len();
            }
            first_triangle.push(next as u32);
            let triangles = (0..total as u32).into_par_iter().with_min_len(CHUNK);
            triangles.filter(|&t| is_valid_triangle(corners[t as usize])).collect()
        });
        progress.check()?;
        let skipped = total - valid.len();
        if valid.is_empty() {
            return Err(Error::InvalidState(format!(
                "all {total} triangles of the scene are degenerate or not finite"
            )));
        }
        if skipped > 0 {
            device.log(
                LogLevel::Warning,
                &format!("{skipped} of {total} triangles are degenerate or not finite and were skipped"),
            );
        }
        let memory = device.memory().reserve(bvh::estimated_bytes(valid.len(), options), "the scene")?;
        let (mbvh, sah_cost) = device.install(|| bvh::build(&corners, &valid, options, progress))?;
        progress.check()?;

        let mut emitters = Vec::new();
        for (m, mesh) in data.meshes.iter().enumerate() {
            if let MeshMaterials::One(material) = mesh.materials
                && !data.materials[material as usize].is_emissive()
            {
                continue;
            }
            for t in 0..mesh.indices.len() {
                let material = &data.materials[mesh.material(t) as usize];
                if material.is_emissive() && is_valid_triangle(mesh.corners(t)) {
                    emitters.push(emitter(first_triangle[m] + t as u32, mesh.corners(t), material));
                }
            }
        }
        stage.advance(1)?;
        let bounds = mbvh.bounds();
        let stats = SceneStats {
            triangles: total as u64,
            skipped_degenerate: skipped as u64,
            nodes: mbvh.node_count() as u64,
            bvh_bytes: mbvh.bytes() as u64,
            bytes: (mbvh.bytes() + mesh_bytes(&data.meshes)) as u64,
            sah_cost,
            build_seconds: start.elapsed().as_secs_f64(),
        };
        Ok(Parts { emitters, first_triangle, bounds, mbvh, stats, memory })
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

    /// A snapshot of the lights, by number.
    pub fn lights(&self) -> Arc<Vec<Light>> {
        self.lights.read().unwrap_or_else(|e| e.into_inner()).clone()
    }

    /// Replaces light `id`. Bakes that are running keep the lights that they started with.
    pub fn set_light(&self, id: u32, light: Light) -> Result<()> {
        light.validate()?;
        let mut lights = self.lights.write().unwrap_or_else(|e| e.into_inner());
        let mut new = (**lights).clone();
        match new.get_mut(id as usize) {
            Some(l) => *l = light.normalized(),
            None => {
                return Err(Error::InvalidArgument(format!("light {id} does not exist, the scene has {}", new.len())));
            }
        }
        *lights = Arc::new(new);
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

    /// Whether a global triangle number is a valid triangle (not skipped by the build).
    pub fn is_valid(&self, triangle: u32) -> bool {
        is_valid_triangle(self.corners(triangle))
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

    /// Unit geometric normal of a global triangle number (f64 inside: right for slivers too).
    #[inline]
    pub fn normal(&self, triangle: u32) -> Vec3 {
        unit_normal(self.corners(triangle))
    }

    /// The acceleration structure, for kernels.
    #[inline]
    pub fn mbvh(&self) -> &Mbvh {
        &self.mbvh
    }

    /// Closest hit with `tmin < t ≤ tmax`, by global triangle number.
    #[inline]
    pub fn intersect_raw(&self, ray: &Ray) -> RawHit {
        self.device.kernels().intersect(&self.mbvh, ray)
    }

    /// Closest hit with `tmin < t ≤ tmax`.
    pub fn intersect(&self, ray: &Ray) -> Hit {
        self.to_hit(self.intersect_raw(ray))
    }

    /// Whether anything lies on the ray with `tmin < t ≤ tmax`.
    #[inline]
    pub fn occluded(&self, ray: &Ray) -> bool {
        self.device.kernels().occluded(&self.mbvh, ray)
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
    mbvh: Mbvh,
    stats: SceneStats,
    memory: Reservation,
}

impl Parts {
    fn into_scene(self, device: Arc<Device>, data: SceneData) -> Scene {
        let Parts { emitters, first_triangle, bounds, mbvh, stats, memory } = self;
        let lights = RwLock::new(Arc::new(data.lights.clone()));
        Scene { device, data, lights, emitters, first_triangle, bounds, mbvh, stats, _memory: memory }
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

fn mesh_bytes(meshes: &[Mesh]) -> usize {
    meshes
        .iter()
        .map(|m| {
            m.positions.len() * 12
                + m.indices.len() * 12
                + m.normals.len() * 12
                + m.uvs.len() * 8
                + m.lightmap.as_ref().map_or(0, |l| l.uvs.len() * 8 + l.pages.len() * 4)
                + if let MeshMaterials::PerTriangle(v) = &m.materials { v.len() * 4 } else { 0 }
        })
        .sum()
}
