//! Scenes: the caller's description ([`SceneData`]), checked as it is added, and the committed form that the kernels
//! work on ([`Scene`]), compact and immutable.

mod build;
mod camera;
mod committed;
pub(crate) mod demo;
mod emitters;
mod environment;
mod light;
mod material;
mod mesh;
pub(crate) mod precision;
mod refit;
mod texture;

pub use crate::base::geometry::{MAX_COORDINATE, NONE, is_valid_triangle, unit_normal};
pub use camera::Camera;
pub use committed::{Scene, SceneStats};
pub use demo::builtin::{BUILTIN_NAMES, builtin, builtin_camera, is_builtin};
pub use demo::shapes;
pub use emitters::Emitter;
pub use environment::{Environment, MAX_ENVIRONMENT_SIZE, Sky};
pub use light::Light;
pub use material::{MAX_ALBEDO, Material};
pub use mesh::{LightmapUvs, Mesh, MeshMaterials};
pub use texture::{MAX_TEXTURE_SIZE, Texture};

use crate::base::error::{Error, Result, invalid_argument};
use crate::base::memory::{try_to_vec, try_with_capacity};
use std::sync::Arc;

/// Maximum number of triangles in a scene: leaf references hold 28 bits.
pub const MAX_TRIANGLES: usize = 1 << 28;

/// Maximum irradiance in W/m², to which each light is clamped: that of a light of 10¹² at a distance of 10⁻⁹. Sums of
/// thousands of such values are still finite.
pub const BRIGHTEST: f32 = 1e30;

/// Upper bound of all light, as each light is clamped to [`BRIGHTEST`]: files with larger values are damaged.
pub(crate) const MOST_LIGHT: f32 = 1e37;

/// Description of a scene under construction. Everything added is checked; a refused addition changes nothing.
#[derive(Clone, Debug, Default)]
pub struct SceneData {
    meshes: Vec<Mesh>,
    /// Number of triangles of all meshes.
    triangles: usize,
    materials: Vec<Material>,
    lights: Vec<Light>,
    /// Textures, shared by the copies that refits make.
    textures: Vec<Arc<Texture>>,
    environments: Vec<Arc<Environment>>,
}

impl SceneData {
    /// An empty scene.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds a texture and returns its number, for materials.
    pub fn add_texture(&mut self, mut texture: Texture) -> Result<u32> {
        texture.validate()?;
        texture.rgba8.shrink_to_fit();
        self.textures.push(Arc::new(texture));
        Ok(self.textures.len() as u32 - 1)
    }

    /// Adds a material and returns its number. Its texture must have been added before.
    pub fn add_material(&mut self, material: Material) -> Result<u32> {
        material.validate(self.textures.len())?;
        self.materials.push(material);
        Ok(self.materials.len() as u32 - 1)
    }

    /// Adds a mesh and returns its number. Its materials must have been added before.
    pub fn add_mesh(&mut self, mut mesh: Mesh) -> Result<u32> {
        mesh.validate(self.materials.len())?;
        mesh.shrink_to_fit();
        self.triangles = self.triangles_with(mesh.indices.len())?;
        self.meshes.push(mesh);
        Ok(self.meshes.len() as u32 - 1)
    }

    /// Adds a light and returns its number.
    pub fn add_light(&mut self, light: Light) -> Result<u32> {
        light.validate()?;
        light.check_environment(self.environments.len())?;
        self.lights.push(light.normalized());
        Ok(self.lights.len() as u32 - 1)
    }

    /// Adds an image for skies and returns its number.
    pub fn add_environment(&mut self, environment: Environment) -> u32 {
        self.environments.push(Arc::new(environment));
        self.environments.len() as u32 - 1
    }

    /// Appends everything in `other`; its material, texture and environment numbers are shifted. A refusal changes
    /// nothing here.
    pub fn append(&mut self, mut other: SceneData) -> Result<()> {
        self.triangles = self.triangles_with(other.triangles)?;
        let shift = self.materials.len() as u32;
        for mesh in &mut other.meshes {
            match &mut mesh.materials {
                MeshMaterials::One(m) => *m += shift,
                MeshMaterials::PerTriangle(materials) => materials.iter_mut().for_each(|m| *m += shift),
            }
        }
        let shift = self.textures.len() as u32;
        for material in other.materials.iter_mut().filter(|m| m.albedo_texture != NONE) {
            material.albedo_texture += shift;
        }
        self.textures.append(&mut other.textures);
        for light in &mut other.lights {
            if let Light::Sky { environment, .. } = light
                && *environment != NONE
            {
                *environment += self.environments.len() as u32;
            }
        }
        self.environments.append(&mut other.environments);
        self.meshes.append(&mut other.meshes);
        self.materials.append(&mut other.materials);
        self.lights.append(&mut other.lights);
        Ok(())
    }

    /// Replaces light `id`.
    pub fn set_light(&mut self, id: u32, light: Light) -> Result<()> {
        light.validate()?;
        light.check_environment(self.environments.len())?;
        let count = self.lights.len();
        match self.lights.get_mut(id as usize) {
            Some(l) => *l = light.normalized(),
            None => return invalid_argument!("light {id} does not exist, the scene has {count}"),
        }
        Ok(())
    }

    /// Copies the data as [`clone`](Clone::clone) does, but fails if there is not enough memory.
    pub fn try_clone(&self) -> Result<SceneData> {
        let mut meshes = try_with_capacity(self.meshes.len(), "a copy of the scene")?;
        for mesh in &self.meshes {
            meshes.push(mesh.try_clone()?);
        }
        let SceneData { materials, lights, textures, environments, .. } = self;
        let what = "a copy of the scene";
        Ok(SceneData {
            meshes,
            triangles: self.triangles,
            materials: try_to_vec(materials, what)?,
            lights: try_to_vec(lights, what)?,
            textures: try_to_vec(textures, what)?,
            environments: try_to_vec(environments, what)?,
        })
    }

    /// Size of the arrays of meshes, textures and environments in bytes.
    pub fn bytes(&self) -> usize {
        let textures: usize = self.textures.iter().map(|t| t.bytes()).sum();
        let environments: usize = self.environments.iter().map(|e| e.bytes()).sum();
        self.mesh_bytes() + textures + environments
    }

    /// Size of the arrays of meshes in bytes.
    pub(crate) fn mesh_bytes(&self) -> usize {
        self.meshes.iter().map(Mesh::bytes).sum()
    }

    /// The meshes, by number.
    pub fn meshes(&self) -> &[Mesh] {
        &self.meshes
    }

    /// The materials, by number.
    pub fn materials(&self) -> &[Material] {
        &self.materials
    }

    /// The textures, by number.
    pub fn textures(&self) -> &[Arc<Texture>] {
        &self.textures
    }

    /// The lights, by number.
    pub fn lights(&self) -> &[Light] {
        &self.lights
    }

    /// The images of skies, by number.
    pub fn environments(&self) -> &[Arc<Environment>] {
        &self.environments
    }

    /// Number of triangles in all meshes, degenerate ones included.
    pub fn triangle_count(&self) -> usize {
        self.triangles
    }

    /// Number of triangles after `more` are added.
    fn triangles_with(&self, more: usize) -> Result<usize> {
        let total = self.triangles + more;
        if total > MAX_TRIANGLES {
            return invalid_argument!("the scene would have {total} triangles, more than {MAX_TRIANGLES}");
        }
        Ok(total)
    }
}

/// Refuses NaN, infinities, and magnitudes beyond [`MAX_COORDINATE`].
pub(crate) fn check_finite(what: &str, values: &[f32]) -> Result<()> {
    match values.iter().find(|v| !(v.abs() <= MAX_COORDINATE)) {
        Some(v) => {
            Err(Error::InvalidArgument(format!("{what} contains {v}, not a number of magnitude ≤ {MAX_COORDINATE:e}")))
        }
        None => Ok(()),
    }
}

/// Refuses NaN, infinities and negative values in a colour or power.
pub(crate) fn check_energy(what: &str, values: &[f32; 3]) -> Result<()> {
    check_finite(what, values)?;
    match values.iter().find(|v| **v < 0.0) {
        Some(v) => Err(Error::InvalidArgument(format!("{what} contains {v}, less than 0"))),
        None => Ok(()),
    }
}
