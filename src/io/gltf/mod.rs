//! glTF 2.0 and GLB: the triangles of the default scene with node transforms applied. Large meshes that several nodes
//! show, or one with `EXT_mesh_gpu_instancing`, become meshes with instances, unless a transform mirrors.
//!
//! - Albedo is `baseColorFactor` × `baseColorTexture` (metalness is ignored), emission is `emissiveFactor` ×
//!   `KHR_materials_emissive_strength` without its texture, sidedness is `doubleSided`.
//! - `alphaMode` `MASK` makes cut-outs, except in surfaces that emit; `BLEND` counts as opaque.
//!   `KHR_materials_transmission`: its factor of `baseColorFactor` passes straight through, as through a thin
//!   sheet; textures do not change that.
//! - Images (PNG, JPEG) come from buffer views, data URIs and files beside or below the scene. All repeat, whatever
//!   their sampler says, and `KHR_texture_transform` is ignored.
//! - `TEXCOORD_0` becomes [`Mesh::uvs`](crate::scene::Mesh::uvs), `TEXCOORD_1` the light map coordinates. Their page is
//!   the number of the material's texture that uses them, among all textures that are used so (as our
//!   own export writes them), else 0. A mesh that several nodes show has no unique coordinates: none
//!   are taken.
//! - `KHR_lights_punctual`: candela is taken as W/sr and lux as W/m²; `range` is ignored.
//! - Nodes that mirror flip the winding. Skins and morph targets stay in their rest pose.
//! - Buffers: the binary chunk, data URIs, files beside or below the scene. Sparse accessors are read,
//!   `KHR_mesh_quantization` too; compressed geometry is refused as unsupported.
//!
//! | file | what it does |
//! |---|---|
//! | `document` | JSON and binary chunk of a file, the parsed document, its nodes in the world |
//! | `text` | the JSON without long data URIs, base64 |
//! | `buffers` | bytes of buffers and of what URIs name |
//! | `accessors` | typed values in buffers, with all bounds checked |
//! | `materials` | materials and images |
//! | `meshes` | primitives as meshes |
//! | `instances` | places of meshes, and which of them are instances |
//!
//! The crate `gltf` reads the JSON; accessors are read here, because the crate's readers trust sizes
//! in the file.

mod accessors;
mod buffers;
mod document;
mod instances;
mod materials;
mod meshes;
#[cfg(test)]
pub(super) mod tests;
mod text;

use super::Import;
use super::source::Opened;
use crate::base::error::{Error, Result};
use crate::scene::Light;
use glam::DMat4;
use gltf::khr_lights_punctual::Kind;
use gltf::mesh::Semantic;
use std::borrow::Cow;
use std::collections::{BTreeSet, HashMap, HashSet};
use text::Text;

pub(super) fn load(import: &mut Import, opened: Opened) -> Result<()> {
    let bytes = import.read_opened(opened)?;
    let (json, blob) = document::split(import, &bytes)?;
    let mut text = Text::new(import, json)?;
    let instancing = instances::attributes_of_nodes(import, &text.short)?;
    let document = document::parse(import, &mut text)?;
    let mut buffers = import.account.list(document.buffers().len(), "the buffers")?;
    for buffer in document.buffers() {
        buffers.push(buffers::read(import, &buffer, &text, blob)?);
    }
    let mut reader = Reader {
        buffers: &buffers,
        text: &text,
        document: &document,
        materials: HashMap::new(),
        images: HashMap::new(),
        pages: materials::lightmap_pages(&document),
        mesh_uses: vec![0; document.meshes().len()],
        instancing,
        shared: HashMap::new(),
        sorted: HashSet::new(),
        number: Vec::new(),
        triangles: 0,
        textured: BTreeSet::new(),
        blended: BTreeSet::new(),
        skipped_primitives: 0,
        invisible_primitives: 0,
        place: String::new(),
        import,
    };
    let placed = document::place_nodes(reader.import, &document)?;
    for (node, transform) in &placed {
        if let Some(light) = node.light() {
            reader.add_light(&light, transform)?;
        }
        if let Some(mesh) = node.mesh() {
            reader.mesh_uses[mesh.index()] += reader.count_places(node)?;
        }
    }
    for (node, transform) in &placed {
        let Some(mesh) = node.mesh() else { continue };
        let places = reader.places(node, transform)?;
        for transform in &places {
            for primitive in mesh.primitives() {
                reader.place = format!("mesh {}, primitive {}", mesh.index(), primitive.index());
                reader.import.check()?;
                reader.add_placed(mesh.index(), &primitive, transform)?;
            }
        }
        reader.import.account.give_back(size_of_val(&places[..]));
    }
    reader.warn();
    if import.scene.triangle_count() == 0 {
        return Err(import.error("there are no triangles in it"));
    }
    Ok(())
}

/// Values that are worked on between two looks for a cancel: a millisecond or less.
const PART: usize = 1 << 16;

struct Reader<'i, 's> {
    import: &'i mut Import<'s>,
    buffers: &'i [Cow<'i, [u8]>],
    text: &'i Text<'i>,
    document: &'i gltf::Document,
    /// The scene's material by the file's; `None` is glTF's default material. [`NONE`]: it is invisible.
    materials: HashMap<Option<usize>, u32>,
    /// The scene's texture by the file's image; [`NONE`] if it cannot be read.
    images: HashMap<usize, u32>,
    pages: HashMap<usize, u32>,
    /// Number of places where each mesh stands.
    mesh_uses: Vec<usize>,
    /// What `EXT_mesh_gpu_instancing` says of nodes.
    instancing: HashMap<usize, instances::Attributes>,
    /// The scene's mesh of a mesh and primitive that has instances; `None`: it is invisible.
    shared: HashMap<(usize, usize), Option<u32>>,
    /// Sparse accessors whose indices were found to increase.
    sorted: HashSet<usize>,
    /// New numbers of vertices, [`NONE`] between primitives: many may share one large vertex buffer.
    number: Vec<u32>,
    triangles: usize,
    /// Materials with a base colour texture by other than the first coordinates.
    textured: BTreeSet<usize>,
    /// Materials that are blended.
    blended: BTreeSet<usize>,
    skipped_primitives: u32,
    /// Number of primitives that are cut out entirely.
    invisible_primitives: u32,
    /// The primitive at hand, for errors.
    place: String,
}

impl<'i> Reader<'i, '_> {
    fn malformed<T>(&self, what: impl std::fmt::Display) -> Result<T> {
        Err(self.import.error(format_args!("{}: {what}", self.place)))
    }

    fn add_light(&mut self, light: &gltf::khr_lights_punctual::Light, transform: &DMat4) -> Result<()> {
        let position = transform.w_axis.truncate().as_vec3();
        // Lights shine along their node's -z axis. In f64, so that extreme scales keep a direction.
        let direction = (-transform.z_axis.truncate()).normalize_or_zero().as_vec3();
        let color = light.color().map(|c| c * light.intensity());
        let light = match light.kind() {
            Kind::Point => Light::Point { position, intensity: color },
            Kind::Spot { inner_cone_angle: inner, outer_cone_angle: outer } => {
                Light::Spot { position, direction, inner, outer, intensity: color }
            }
            Kind::Directional => Light::Directional { direction, irradiance: color, angular_radius: 0.0 },
        };
        let number = self.import.scene.lights().len();
        match self.import.scene.add_light(light) {
            Ok(_) => Ok(()),
            Err(Error::InvalidArgument(what)) => Err(self.import.error(format_args!("light {number}: {what}"))),
            Err(e) => Err(e),
        }
    }

    fn warn(&mut self) {
        let document = self.document;
        let uses =
            self.mesh_uses.iter().zip(document.meshes()).filter(|(uses, mesh)| {
                **uses > 1 && mesh.primitives().any(|p| p.get(&Semantic::TexCoords(1)).is_some())
            });
        let shared = uses.count();
        for (count, what) in [
            (self.textured.len(), "materials have a base colour texture by other than TEXCOORD_0, which is not read"),
            (self.blended.len(), "materials are blended (alphaMode BLEND) and count as opaque"),
            (self.skipped_primitives as usize, "primitives are points or lines and were ignored"),
            (self.invisible_primitives as usize, "primitives are masked all over and were left out"),
            (document.skins().len(), "skins are left in their rest pose"),
            (shared, "meshes appear several times, so their TEXCOORD_1 is not unique and was left out"),
        ] {
            if count > 0 {
                self.import.warn(format!("{count} {what}"));
            }
        }
    }
}
