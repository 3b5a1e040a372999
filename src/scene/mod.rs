//! Scenes: the caller's description ([`SceneData`]), checked as it is added, and the committed form that the kernels
//! work on ([`Scene`]), compact and immutable.

mod build;
mod camera;
mod committed;
pub(crate) mod demo;
mod emitters;
mod environment;
mod instance;
mod instance_trees;
mod kept_trees;
mod light;
mod material;
mod mesh;
pub(crate) mod precision;
mod refit;
mod saved;
mod texture;
pub(crate) mod waiting;

pub use crate::base::geometry::{MAX_COORDINATE, NONE, is_valid_triangle, unit_normal};
pub use camera::Camera;
pub use committed::{Scene, SceneStats};
pub use demo::builtin::{BUILTIN_NAMES, builtin, builtin_camera, is_builtin};
pub use demo::shapes;
pub use emitters::Emitter;
pub use environment::{Environment, MAX_ENVIRONMENT_SIZE, Sky};
pub use instance::{Instance, Object};
pub use light::Light;
pub use material::{MAX_ALBEDO, Material};
pub use mesh::{LightmapUvs, Mesh, MeshMaterials};
pub use saved::OpenOptions;
pub use texture::{MAX_TEXTURE_SIZE, Texture};

use crate::base::error::{Error, Result, invalid_argument};
use crate::base::memory::{try_filled, try_push, try_to_vec, try_with_capacity};
use crate::base::progress::Progress;
use crate::base::scratch_files::Storage;
use std::borrow::Cow;
use std::sync::Arc;

/// Maximum number of triangles in a mesh, and in all meshes without instances of a committed scene together: leaf
/// references hold 28 bits.
pub const MAX_TRIANGLES: usize = 1 << 28;

/// Maximum number of instances: the boxes of instances are leaves, too.
pub const MAX_INSTANCES: usize = MAX_TRIANGLES - 2;

/// Maximum number of triangles in a scene, those of every instance counted: global numbers have 32 bits, and the last
/// one is [`NONE`].
pub const MAX_PLACED_TRIANGLES: usize = u32::MAX as usize - 1;

/// Maximum irradiance in W/m², to which each light is clamped: that of a light of 10¹² at a distance of 10⁻⁹. Sums of
/// thousands of such values are still finite.
pub const BRIGHTEST: f32 = 1e30;

/// Upper bound of all light, as each light is clamped to [`BRIGHTEST`]: files with larger values are damaged.
pub(crate) const MOST_LIGHT: f32 = 1e37;

/// Description of a scene under construction. Everything added is checked; a refused addition changes nothing.
#[derive(Clone, Debug, Default)]
pub struct SceneData {
    meshes: Vec<Mesh>,
    instances: Vec<Instance>,
    /// Whether each mesh has instances; shorter than the meshes where none follows.
    has_instances: Vec<bool>,
    /// Number of triangles of all meshes without instances.
    own_triangles: usize,
    /// Number of triangles of all instances.
    instance_triangles: usize,
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
        let own = self.own_triangles + mesh.indices.len();
        Self::check_triangles(own, self.instance_triangles)?;
        self.own_triangles = own;
        self.meshes.push(mesh);
        Ok(self.meshes.len() as u32 - 1)
    }

    /// Adds an instance and returns its number. Its mesh must have been added before; from its first instance on it stands
    /// where its instances do, and nowhere else.
    pub fn add_instance(&mut self, instance: Instance) -> Result<u32> {
        instance.validate(self.meshes.len())?;
        if let Some(of) = instance.light_of {
            self.check_shared_light(self.instances.len() as u32, instance.mesh, of)?;
        }
        let mesh = instance.mesh as usize;
        let triangles = self.meshes[mesh].indices.len();
        let own = self.own_triangles - if self.is_instanced(instance.mesh) { 0 } else { triangles };
        Self::check_triangles(own, self.instance_triangles + triangles)?;
        Self::check_instances(self.meshes.len(), self.instances.len() + 1)?;
        let more = (mesh + 1).saturating_sub(self.has_instances.len());
        if self.has_instances.try_reserve(more).is_err() {
            return Err(Error::OutOfMemory("there is no room for another instance".into()));
        }
        try_push(&mut self.instances, instance, "the instances")?;
        self.has_instances.resize(self.has_instances.len() + more, false);
        self.has_instances[mesh] = true;
        self.own_triangles = own;
        self.instance_triangles += triangles;
        Ok(self.instances.len() as u32 - 1)
    }

    /// Lets an instance show the texels and the light of another one, `of`, of the same mesh and with a lower number, instead
    /// of some of its own. If that shows those of a third one, both do.
    pub fn share_light(&mut self, instance: u32, of: u32) -> Result<()> {
        let Some(&Instance { mesh, .. }) = self.instances.get(instance as usize) else {
            return invalid_argument!("instance {instance} does not exist, the scene has {}", self.instances.len());
        };
        self.check_shared_light(instance, mesh, of)?;
        self.instances[instance as usize].light_of = Some(self.light_of_instance(of));
        Ok(())
    }

    /// Lets all instances of each mesh show the texels and the light of the first one.
    pub fn share_light_of_meshes(&mut self) -> Result<()> {
        let mut firsts: Vec<Option<u32>> = try_filled(self.meshes.len(), None, "the instances")?;
        for (number, instance) in (0..).zip(&mut self.instances) {
            let first = &mut firsts[instance.mesh as usize];
            instance.light_of = *first;
            first.get_or_insert(number);
        }
        Ok(())
    }

    /// Checks that an instance of a mesh, by its number, may show the light of another one.
    fn check_shared_light(&self, instance: u32, mesh: u32, of: u32) -> Result<()> {
        match self.instances.get(of as usize).filter(|_| of < instance) {
            Some(other) if other.mesh == mesh => Ok(()),
            Some(other) => invalid_argument!(
                "instance {instance} is of mesh {mesh} and cannot show the light of instance {of}, which is of mesh {}",
                other.mesh
            ),
            None => invalid_argument!("instance {instance} can show the light of those before it, and {of} is not"),
        }
    }

    /// Returns the instance whose texels and light an instance shows: itself, or another one with some of its own.
    pub fn light_of_instance(&self, instance: u32) -> u32 {
        let mut shown = instance;
        while let Some(of) = self.instances[shown as usize].light_of {
            shown = of;
        }
        shown
    }

    /// Whether an [object](Self::object) is an instance that shows the light of another one.
    pub(crate) fn shows_light_of_other(&self, object: u32) -> bool {
        let instance = (object as usize).checked_sub(self.meshes.len()).and_then(|i| self.instances.get(i));
        instance.is_some_and(|instance| instance.light_of.is_some())
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
        let (own, placed) =
            (self.own_triangles + other.own_triangles, self.instance_triangles + other.instance_triangles);
        Self::check_triangles(own, placed)?;
        Self::check_instances(self.meshes.len() + other.meshes.len(), self.instances.len() + other.instances.len())?;
        (self.own_triangles, self.instance_triangles) = (own, placed);
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
        if !other.instances.is_empty() {
            self.has_instances.resize(self.meshes.len(), false);
            self.has_instances.append(&mut other.has_instances);
            other.instances.iter_mut().for_each(|i| i.mesh += self.meshes.len() as u32);
            self.instances.append(&mut other.instances);
        }
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
        self.copy(Storage::MEMORY)
    }

    /// Copies the data, the meshes to `storage`.
    fn copy(&self, storage: Storage) -> Result<SceneData> {
        let mut meshes = try_with_capacity(self.meshes.len(), "a copy of the scene")?;
        for mesh in &self.meshes {
            meshes.push(mesh.copy(storage)?);
        }
        let SceneData { materials, lights, textures, environments, .. } = self;
        let what = "a copy of the scene";
        Ok(SceneData {
            meshes,
            instances: try_to_vec(&self.instances, what)?,
            has_instances: try_to_vec(&self.has_instances, what)?,
            own_triangles: self.own_triangles,
            instance_triangles: self.instance_triangles,
            materials: try_to_vec(materials, what)?,
            lights: try_to_vec(lights, what)?,
            textures: try_to_vec(textures, what)?,
            environments: try_to_vec(environments, what)?,
        })
    }

    /// Whether nothing has been added.
    pub fn is_empty(&self) -> bool {
        let SceneData { meshes, materials, lights, textures, environments, .. } = self;
        meshes.is_empty() && materials.is_empty() && lights.is_empty() && textures.is_empty() && environments.is_empty()
    }

    /// Size of the arrays of meshes, textures and environments in bytes.
    pub fn bytes(&self) -> usize {
        let textures: usize = self.textures.iter().map(|t| t.bytes()).sum();
        let environments: usize = self.environments.iter().map(|e| e.bytes()).sum();
        self.mesh_bytes() + textures + environments
    }

    /// Moves the arrays of meshes that are in memory to scratch files, if these are the storage.
    pub(crate) fn move_to(&mut self, storage: Storage, progress: &Progress) -> Result<()> {
        self.meshes.iter_mut().try_for_each(|mesh| mesh.move_to(storage, progress))
    }

    /// The same without the arrays of meshes that lie in files.
    pub(crate) fn bytes_in_memory(&self) -> usize {
        self.bytes() - self.meshes.iter().map(Mesh::mapped_bytes).sum::<usize>()
    }

    /// Size of the arrays of meshes and instances in bytes.
    pub(crate) fn mesh_bytes(&self) -> usize {
        self.meshes.iter().map(Mesh::bytes).sum::<usize>() + size_of_val(&self.instances[..])
    }

    /// The meshes, by number.
    pub fn meshes(&self) -> &[Mesh] {
        &self.meshes
    }

    /// The instances, by number.
    pub fn instances(&self) -> &[Instance] {
        &self.instances
    }

    /// Whether a mesh has instances.
    pub(crate) fn is_instanced(&self, mesh: u32) -> bool {
        self.has_instances.get(mesh as usize).is_some_and(|&has| has)
    }

    /// Object number `number`, which must exist: see [`Object`].
    #[inline]
    pub(crate) fn object(&self, number: u32) -> Object<'_> {
        match self.meshes.get(number as usize) {
            Some(mesh) => Object::new(mesh, None),
            None => {
                let instance = &self.instances[number as usize - self.meshes.len()];
                Object::new(&self.meshes[instance.mesh as usize], Some(&instance.transform))
            }
        }
    }

    /// The first global triangle number of each object, and the total at the end.
    pub(crate) fn first_triangles(&self) -> Result<Vec<u32>> {
        let mut first = try_with_capacity(self.meshes.len() + self.instances.len() + 1, "the scene")?;
        let mut next = 0;
        for (m, mesh) in (0..).zip(&self.meshes) {
            first.push(next);
            next += if self.is_instanced(m) { 0 } else { mesh.indices.len() as u32 };
        }
        for instance in &self.instances {
            first.push(next);
            next += self.meshes[instance.mesh as usize].indices.len() as u32;
        }
        first.push(next);
        Ok(first)
    }

    /// The [objects](Object), by number, as meshes: those with instances without triangles.
    pub fn flattened(&self) -> Cow<'_, [Mesh]> {
        if self.instances.is_empty() {
            return Cow::Borrowed(&self.meshes);
        }
        let own = (0..).zip(&self.meshes).map(|(m, mesh)| match self.is_instanced(m) {
            true => Mesh::default(),
            false => mesh.clone(),
        });
        let first_instance = self.meshes.len() as u32;
        let flat = |object| self.object(object).flattened();
        Cow::Owned(own.chain((first_instance..first_instance + self.instances.len() as u32).map(flat)).collect())
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

    /// Number of triangles in the scene, those of every instance counted and degenerate ones included.
    pub fn triangle_count(&self) -> usize {
        self.own_triangles + self.instance_triangles
    }

    /// Checks that objects can be numbered.
    fn check_instances(meshes: usize, instances: usize) -> Result<()> {
        if instances > MAX_INSTANCES || meshes + instances >= u32::MAX as usize {
            return invalid_argument!("the scene would have {instances} instances, more than {MAX_INSTANCES}");
        }
        Ok(())
    }

    /// Checks numbers of triangles of meshes without instances and of instances.
    fn check_triangles(own: usize, of_instances: usize) -> Result<()> {
        let total = own + of_instances;
        if total > MAX_PLACED_TRIANGLES {
            return invalid_argument!("the scene would have {total} triangles, more than {MAX_PLACED_TRIANGLES}");
        }
        Ok(())
    }

    /// Checks the number of triangles of all meshes without instances, which have one tree. Only a whole scene can be
    /// checked, as each mesh is without instances until its first one is added.
    fn check_own_triangles(&self) -> Result<()> {
        let own = self.own_triangles;
        if own > MAX_TRIANGLES {
            return Err(Error::InvalidState(format!(
                "the meshes without instances have {own} triangles together, more than {MAX_TRIANGLES}: give the large ones \
                 an instance each"
            )));
        }
        Ok(())
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
