//! glTF 2.0 and GLB: the triangles of the default scene with node transforms applied.
//!
//! - Albedo is `baseColorFactor` × `baseColorTexture` (metalness is ignored), emission is `emissiveFactor` ×
//!   `KHR_materials_emissive_strength` without its texture, sidedness is `doubleSided`.
//! - `alphaMode` `MASK` cuts holes, except into surfaces that emit; `BLEND` counts as opaque.
//!   `KHR_materials_transmission`: its factor of `baseColorFactor` passes straight through, as through a thin
//!   sheet; textures do not change that.
//! - Images (PNG, JPEG) come from buffer views, data URIs and files beside the scene. All repeat, whatever their
//!   sampler says, and `KHR_texture_transform` is ignored.
//! - `TEXCOORD_0` becomes [`Mesh::uvs`], `TEXCOORD_1` the light map coordinates. Their page is the
//!   number of the material's texture that uses them, among all textures that are used so (as our
//!   own export writes them), else 0. A mesh that several nodes show has no unique coordinates: none
//!   are taken.
//! - `KHR_lights_punctual`: candela is taken as W/sr and lux as W/m²; `range` is ignored.
//! - Nodes that mirror flip the winding. Skins and morph targets stay in their rest pose.
//! - Buffers: the binary chunk, data URIs, files beside the scene. Sparse accessors are read,
//!   `KHR_mesh_quantization` too; compressed geometry is refused as unsupported.
//!
//! The crate `gltf` reads the JSON; accessors are read here, because the crate's readers trust sizes
//! in the file.

use super::{Import, is_valid_position, texture};
use crate::error::{Error, Result};
use crate::scene::{Light, LightmapUvs, Material, Mesh, MeshMaterials, NONE, Texture};
use base64::Engine;
use glam::{DMat3, DMat4, DVec3, Mat4, Vec2, Vec3};
use gltf::accessor::{DataType, Dimensions};
use gltf::json;
use gltf::khr_lights_punctual::Kind;
use gltf::material::AlphaMode;
use gltf::mesh::{Mode, Semantic};
use std::collections::{BTreeSet, HashMap};
use std::path::Path;

/// Required extensions that change nothing about shapes: they may be ignored.
const HARMLESS_EXTENSIONS: [&str; 5] =
    ["KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_mesh_quantization", "KHR_xmp"];

pub(super) fn load(import: &mut Import) -> Result<()> {
    let bytes = std::fs::read(&import.path).map_err(|e| import.error(e))?;
    let (document, blob) = parse(import, &bytes)?;
    drop(bytes);
    let buffers = document
        .buffers()
        .map(|buffer| read_buffer(import, &buffer, blob.as_deref()))
        .collect::<Result<Vec<Vec<u8>>>>()?;
    let mut reader = Reader {
        buffers,
        document: &document,
        materials: HashMap::new(),
        images: HashMap::new(),
        pages: lightmap_pages(&document),
        mesh_uses: vec![0; document.meshes().len()],
        triangles: 0,
        textured: BTreeSet::new(),
        blended: BTreeSet::new(),
        skipped_primitives: 0,
        invisible_primitives: 0,
        place: String::new(),
        import,
    };
    let placed = place_nodes(reader.import, &document)?;
    for mesh in placed.iter().filter_map(|(node, _)| node.mesh()) {
        reader.mesh_uses[mesh.index()] += 1;
    }
    for (node, transform) in &placed {
        if let Some(light) = node.light() {
            reader.add_light(&light, transform)?;
        }
        for primitive in node.mesh().iter().flat_map(|mesh| mesh.primitives()) {
            let mesh = node.mesh().map_or(0, |mesh| mesh.index());
            reader.place = format!("mesh {mesh}, primitive {}", primitive.index());
            reader.add_primitive(&primitive, transform, reader.mesh_uses[mesh] == 1)?;
        }
    }
    reader.warn();
    if import.scene.triangle_count() == 0 {
        return Err(import.error("there are no triangles in it"));
    }
    Ok(())
}

fn parse(import: &Import, bytes: &[u8]) -> Result<(gltf::Document, Option<Vec<u8>>)> {
    // The crate subtracts the header's size from the length that the header states.
    if bytes.starts_with(b"glTF") {
        let stated = bytes.get(8..12).map_or(0, |b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]));
        if stated < 12 {
            return Err(import.error("the GLB header is cut off"));
        }
    }
    let parsed = gltf::Gltf::from_slice_without_validation(bytes).map_err(|e| explain(import, e))?;
    let (blob, mut root) = (parsed.blob, parsed.document.into_json());
    root.extensions_required.retain(|e| !HARMLESS_EXTENSIONS.iter().any(|harmless| e.starts_with(harmless)));
    // The crate's validation looks at the positions' accessor before it has checked its number.
    for (m, mesh) in root.meshes.iter().enumerate() {
        for attributes in mesh.primitives.iter().map(|p| &p.attributes) {
            if let Some(a) = attributes.get(&json::validation::Checked::Valid(Semantic::Positions))
                && a.value() >= root.accessors.len()
            {
                let count = root.accessors.len();
                return Err(import.error(format_args!("mesh {m} names accessor {a}, there are {count}")));
            }
        }
    }
    let document = gltf::Document::from_json(root).map_err(|e| explain(import, e))?;
    Ok((document, blob))
}

fn explain(import: &Import, e: gltf::Error) -> Error {
    match e {
        gltf::Error::Validation(errors) => match errors.first() {
            Some((path, json::validation::Error::Unsupported)) => {
                Error::Unsupported(format!("{}: it requires {path}", import.path.display()))
            }
            Some((path, what)) => import.error(format_args!("{path}: {what}")),
            None => import.error("it is not valid"),
        },
        gltf::Error::Binary(e) => import.error(format_args!("GLB: {e}")),
        e => import.error(e),
    }
}

/// The bytes of a buffer, at least as many as it says.
fn read_buffer(import: &Import, buffer: &gltf::Buffer, blob: Option<&[u8]>) -> Result<Vec<u8>> {
    let fail = |what: &dyn std::fmt::Display| import.error(format_args!("buffer {}: {what}", buffer.index()));
    let bytes = match buffer.source() {
        gltf::buffer::Source::Bin => blob.ok_or_else(|| fail(&"there is no binary chunk and no uri"))?.to_vec(),
        gltf::buffer::Source::Uri(uri) => match uri.strip_prefix("data:") {
            Some(data) => {
                let (_, text) = data.split_once(";base64,").ok_or_else(|| fail(&"a data URI without base64"))?;
                base64::prelude::BASE64_STANDARD.decode(text.trim_end()).map_err(|e| fail(&e))?
            }
            None => {
                let name = percent_decoded(uri).ok_or_else(|| fail(&format_args!("the uri {uri:?}")))?;
                if name.contains("://") {
                    return Err(Error::Unsupported(format!(
                        "{}: buffer {} is at {name:?}, not beside the scene",
                        import.path.display(),
                        buffer.index()
                    )));
                }
                let path = import.path.parent().unwrap_or(Path::new("")).join(&name);
                std::fs::read(&path).map_err(|e| fail(&format_args!("{}: {e}", path.display())))?
            }
        },
    };
    if bytes.len() < buffer.length() {
        return Err(fail(&format_args!("it has {} bytes, not {}", bytes.len(), buffer.length())));
    }
    Ok(bytes)
}

/// `%20` and the like resolved; `None` if malformed.
fn percent_decoded(uri: &str) -> Option<String> {
    let mut bytes = Vec::with_capacity(uri.len());
    let mut rest = uri.as_bytes();
    while let [first, tail @ ..] = rest {
        rest = tail;
        if *first == b'%' {
            let hex = std::str::from_utf8(tail.get(..2)?).ok()?;
            bytes.push(u8::from_str_radix(hex, 16).ok()?);
            rest = &tail[2..];
        } else {
            bytes.push(*first);
        }
    }
    String::from_utf8(bytes).ok()
}

/// The nodes of the default scene (or the first, or all roots) with their transforms to the world,
/// parents before children, in the order of the file.
fn place_nodes<'a>(import: &Import, document: &'a gltf::Document) -> Result<Vec<(gltf::Node<'a>, DMat4)>> {
    let roots: Vec<_> = match document.default_scene().or_else(|| document.scenes().next()) {
        Some(scene) => scene.nodes().collect(),
        None => {
            let children: BTreeSet<_> = document.nodes().flat_map(|n| n.children()).map(|n| n.index()).collect();
            document.nodes().filter(|n| !children.contains(&n.index())).collect()
        }
    };
    let mut seen = vec![false; document.nodes().len()];
    let mut placed = Vec::new();
    let mut stack: Vec<_> = roots.into_iter().rev().map(|node| (node, DMat4::IDENTITY)).collect();
    while let Some((node, parent)) = stack.pop() {
        if std::mem::replace(&mut seen[node.index()], true) {
            return Err(import.error(format_args!("node {} has several parents", node.index())));
        }
        let transform = parent * Mat4::from_cols_array_2d(&node.transform().matrix()).as_dmat4();
        stack.extend(node.children().map(|child| (child, transform)).collect::<Vec<_>>().into_iter().rev());
        placed.push((node, transform));
    }
    Ok(placed)
}

/// Texture that a material reads through `TEXCOORD_1`.
fn lightmap_texture(material: &gltf::Material) -> Option<usize> {
    let base = material.pbr_metallic_roughness().base_color_texture();
    let textures = [
        base.map(|t| (t.tex_coord(), t.texture().index())),
        material.occlusion_texture().map(|t| (t.tex_coord(), t.texture().index())),
        material.emissive_texture().map(|t| (t.tex_coord(), t.texture().index())),
    ];
    textures.into_iter().flatten().find(|(tex_coord, _)| *tex_coord == 1).map(|(_, texture)| texture)
}

/// The light map page of each texture that is used as one.
fn lightmap_pages(document: &gltf::Document) -> HashMap<usize, u32> {
    let textures: BTreeSet<_> = document.materials().filter_map(|m| lightmap_texture(&m)).collect();
    textures.into_iter().zip(0..).collect()
}

struct Reader<'i> {
    import: &'i mut Import,
    buffers: Vec<Vec<u8>>,
    document: &'i gltf::Document,
    /// Our material by theirs; `None` is glTF's default material. [`NONE`]: nothing can be seen of it.
    materials: HashMap<Option<usize>, u32>,
    /// Our texture by their image; [`NONE`] if it cannot be read.
    images: HashMap<usize, u32>,
    pages: HashMap<usize, u32>,
    /// How many nodes show each mesh.
    mesh_uses: Vec<u32>,
    triangles: usize,
    /// Materials with a base colour texture by other than the first coordinates.
    textured: BTreeSet<usize>,
    /// Materials that are blended.
    blended: BTreeSet<usize>,
    skipped_primitives: u32,
    /// Primitives that are holes all over.
    invisible_primitives: u32,
    /// The primitive at hand, for errors.
    place: String,
}

impl Reader<'_> {
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

    fn material(&mut self, material: &gltf::Material) -> Result<u32> {
        if let Some(id) = self.materials.get(&material.index()) {
            return Ok(*id);
        }
        let pbr = material.pbr_metallic_roughness();
        let mut albedo_texture = NONE;
        match (pbr.base_color_texture(), material.index()) {
            (Some(info), _) if info.tex_coord() == 0 => {
                albedo_texture = self.texture(info.texture().source().index())?;
            }
            (Some(info), Some(index)) if info.tex_coord() > 1 => drop(self.textured.insert(index)),
            _ => {}
        }
        let [r, g, b, alpha] = pbr.base_color_factor();
        let strength = material.emissive_strength().unwrap_or(1.0);
        let emission = material.emissive_factor().map(|e| e * strength);
        if let Err(Error::InvalidArgument(what)) = crate::scene::check_energy("the emission", &emission) {
            return self.malformed(what);
        }
        let emits = emission.iter().any(|&e| e > 0.0);
        // Of the texture's alpha alone. What is less opaque than that everywhere cannot be seen.
        let mut alpha_cutoff = 0.0;
        match material.alpha_mode() {
            AlphaMode::Mask if !emits => alpha_cutoff = material.alpha_cutoff().unwrap_or(0.5).max(0.0) / alpha,
            AlphaMode::Blend => self.blended.extend(material.index()),
            _ => {}
        }
        let passes = material.transmission().map_or(0.0, |t| t.transmission_factor().clamp(0.0, 1.0));
        let id = if alpha_cutoff > 1.0 {
            NONE
        } else {
            self.import.add_material(Material {
                albedo: [r, g, b].map(|c| c * (1.0 - passes)),
                emission,
                two_sided: material.double_sided(),
                albedo_texture,
                // 0 / 0: no matter what.
                alpha_cutoff: if albedo_texture == NONE || alpha_cutoff.is_nan() { 0.0 } else { alpha_cutoff },
                transmission: [r, g, b].map(|c| c * passes),
            })?
        };
        self.materials.insert(material.index(), id);
        Ok(id)
    }

    /// Our texture for an image, read when first wanted.
    fn texture(&mut self, image: usize) -> Result<u32> {
        if let Some(id) = self.images.get(&image) {
            return Ok(*id);
        }
        let read = self.image(image);
        let id = match self.import.image(image, read) {
            Some(texture) => self.import.add_texture(texture)?,
            None => NONE,
        };
        self.images.insert(image, id);
        Ok(id)
    }

    /// (From the JSON: the crate's view of images panics at those that are neither here nor there.)
    fn image(&self, image: usize) -> std::result::Result<Texture, String> {
        let json = self.document.as_json().images.get(image).ok_or("there is none of this number")?;
        if let Some(view) = &json.buffer_view {
            let view = self.document.views().nth(view.value()).ok_or("its buffer view is missing")?;
            let buffer = &self.buffers[view.buffer().index()];
            let bytes = view.offset().checked_add(view.length()).and_then(|end| buffer.get(view.offset()..end));
            return texture::decode(bytes.ok_or("its buffer view does not fit its buffer")?);
        }
        let uri = json.uri.as_deref().ok_or("it has neither a buffer view nor a uri")?;
        if let Some(data) = uri.strip_prefix("data:") {
            let (_, text) = data.split_once(";base64,").ok_or("a data URI without base64")?;
            let bytes = base64::prelude::BASE64_STANDARD.decode(text.trim_end()).map_err(|e| e.to_string())?;
            return texture::decode(&bytes);
        }
        let name = percent_decoded(uri).ok_or_else(|| format!("the uri {uri:?}"))?;
        if name.contains("://") {
            return Err(format!("it is at {name:?}, not beside the scene"));
        }
        let path = self.import.path.parent().unwrap_or(Path::new("")).join(&name);
        texture::read(&path).map_err(|what| format!("{}: {what}", path.display()))
    }

    /// Adds a primitive as a mesh. `unique`: no other node shows it.
    fn add_primitive(&mut self, primitive: &gltf::Primitive, transform: &DMat4, unique: bool) -> Result<()> {
        let mode = primitive.mode();
        if !matches!(mode, Mode::Triangles | Mode::TriangleStrip | Mode::TriangleFan) {
            self.skipped_primitives += 1;
            return Ok(());
        }
        let Some(accessor) = primitive.get(&Semantic::Positions) else { return self.malformed("it has no positions") };
        let positions = self.vectors::<3>(&accessor)?;
        let corners = match primitive.indices() {
            Some(indices) => self.indices(&indices, positions.len())?,
            None => (0..positions.len() as u32).collect(),
        };
        let mut indices = match triangles_of(mode, &corners) {
            Some(indices) => indices,
            None => return self.malformed(format_args!("{} vertices do not make triangles", corners.len())),
        };
        self.triangles += indices.len();
        self.import.check_triangle_count(self.triangles)?;
        if transform.determinant() < 0.0 {
            indices.iter_mut().for_each(|t| t.swap(1, 2));
        }
        let used = keep_used(&mut indices, positions.len());
        let mut mesh = Mesh { indices, ..Default::default() };
        for &v in &used {
            let position = transform.transform_point3(Vec3::from(positions[v as usize]).as_dvec3()).as_vec3();
            if !is_valid_position(position) {
                return self.malformed(format_args!("vertex {v} is {position}, not finite or out of range"));
            }
            mesh.positions.push(position);
        }
        mesh.normals = self.normals(primitive, transform, &used, positions.len())?;
        mesh.uvs = self.uvs(primitive, 0, &used, positions.len())?;
        let material = primitive.material();
        let lightmap_uvs = if unique { self.uvs(primitive, 1, &used, positions.len())? } else { Vec::new() };
        if !lightmap_uvs.is_empty() {
            let page = lightmap_texture(&material).and_then(|t| self.pages.get(&t)).copied().unwrap_or(0);
            let pages = if page == 0 { Vec::new() } else { vec![page; mesh.indices.len()] };
            mesh.lightmap = Some(LightmapUvs { uvs: lightmap_uvs, pages });
        }
        let material = self.material(&material)?;
        if material == NONE {
            self.invisible_primitives += 1;
            return Ok(());
        }
        mesh.materials = MeshMaterials::One(material);
        match mesh.indices.is_empty() {
            true => Ok(()),
            false => self.import.add_mesh(mesh),
        }
    }

    fn normals(
        &self,
        primitive: &gltf::Primitive,
        transform: &DMat4,
        used: &[u32],
        vertices: usize,
    ) -> Result<Vec<Vec3>> {
        let Some(accessor) = primitive.get(&Semantic::Normals) else { return Ok(Vec::new()) };
        let normals = self.vectors::<3>(&accessor)?;
        if normals.len() != vertices {
            return self.malformed(format_args!("it has {} normals for {vertices} vertices", normals.len()));
        }
        // The cofactor matrix: the inverse transpose without the division by the determinant. Its
        // sign turns normals round where the winding is turned too.
        let m = DMat3::from_mat4(*transform);
        let flip = if m.determinant() < 0.0 { -1.0 } else { 1.0 };
        let cofactors =
            DMat3::from_cols(m.y_axis.cross(m.z_axis), m.z_axis.cross(m.x_axis), m.x_axis.cross(m.y_axis)) * flip;
        let turn = |n: [f32; 3]| -> DVec3 { (cofactors * Vec3::from(n).as_dvec3()).normalize_or_zero() };
        Ok(used.iter().map(|&v| turn(normals[v as usize]).as_vec3()).collect())
    }

    /// Texture coordinates of the used vertices; empty if there are none.
    fn uvs(&self, primitive: &gltf::Primitive, set: u32, used: &[u32], vertices: usize) -> Result<Vec<Vec2>> {
        let Some(accessor) = primitive.get(&Semantic::TexCoords(set)) else { return Ok(Vec::new()) };
        let uvs = self.vectors::<2>(&accessor)?;
        if uvs.len() != vertices {
            return self.malformed(format_args!("TEXCOORD_{set} has {} entries for {vertices} vertices", uvs.len()));
        }
        if let Some(v) = used.iter().find(|v| !uvs[**v as usize].iter().all(|x| x.is_finite())) {
            return self.malformed(format_args!("TEXCOORD_{set} of vertex {v} is not finite"));
        }
        Ok(used.iter().map(|&v| Vec2::from(uvs[v as usize])).collect())
    }

    /// The buffer view that holds an accessor's values. (Without one they would all be zeros, so many
    /// as the file likes to say.)
    fn base_view<'a>(&self, accessor: &gltf::Accessor<'a>) -> Result<gltf::buffer::View<'a>> {
        match accessor.view() {
            Some(view) => Ok(view),
            None => self.malformed(format_args!("accessor {} has no buffer view", accessor.index())),
        }
    }

    /// The `count` elements of `size` bytes in a buffer view, checked to lie in it.
    fn elements(
        &self,
        view: gltf::buffer::View,
        offset: usize,
        count: usize,
        size: usize,
    ) -> Result<impl Iterator<Item = &[u8]> + use<'_>> {
        let stride = view.stride().unwrap_or(size);
        if stride < size || stride == 0 {
            return self.malformed(format_args!("buffer view {} has stride {stride}, less than {size}", view.index()));
        }
        let buffer = &self.buffers[view.buffer().index()];
        let bytes = view.offset().checked_add(view.length()).and_then(|end| buffer.get(view.offset()..end));
        let wanted = match count {
            0 => Some(0),
            _ => stride.checked_mul(count - 1).and_then(|n| n.checked_add(size)),
        };
        let end = wanted.and_then(|n| n.checked_add(offset));
        match bytes.and_then(|bytes| bytes.get(offset..end?)) {
            Some(bytes) => Ok(bytes.chunks(stride).map(move |chunk| &chunk[..size])),
            None => self.malformed(format_args!("{count} elements do not fit into buffer view {}", view.index())),
        }
    }

    /// An accessor of `N` components each, integers converted to floats.
    fn vectors<const N: usize>(&self, accessor: &gltf::Accessor) -> Result<Vec<[f32; N]>> {
        if accessor.dimensions() != if N == 2 { Dimensions::Vec2 } else { Dimensions::Vec3 } {
            return self.malformed(format_args!("accessor {} is not of {N}-vectors", accessor.index()));
        }
        let (data_type, normalized) = (accessor.data_type(), accessor.normalized());
        let (part, size) = (data_type.size(), data_type.size() * N);
        let decode = |bytes: &[u8]| std::array::from_fn(|k| component(&bytes[k * part..], data_type, normalized));
        let view = self.base_view(accessor)?;
        let mut vectors: Vec<[f32; N]> =
            self.elements(view, accessor.offset(), accessor.count(), size)?.map(decode).collect();
        if let Some(sparse) = accessor.sparse() {
            let index_type = match sparse.indices().index_type() {
                gltf::accessor::sparse::IndexType::U8 => DataType::U8,
                gltf::accessor::sparse::IndexType::U16 => DataType::U16,
                gltf::accessor::sparse::IndexType::U32 => DataType::U32,
            };
            let indices = sparse.indices();
            let at = self.elements(indices.view(), indices.offset(), sparse.count(), index_type.size())?;
            let values = self.elements(sparse.values().view(), sparse.values().offset(), sparse.count(), size)?;
            for (i, value) in at.map(|bytes| unsigned(bytes, index_type)).zip(values) {
                let count = vectors.len();
                let Some(vector) = vectors.get_mut(i as usize) else {
                    return self.malformed(format_args!("a sparse value is for element {i}, there are {count}"));
                };
                *vector = decode(value);
            }
        }
        Ok(vectors)
    }

    /// Vertex numbers, checked to be less than `vertices`.
    fn indices(&self, accessor: &gltf::Accessor, vertices: usize) -> Result<Vec<u32>> {
        let data_type = accessor.data_type();
        let unsigned_type = matches!(data_type, DataType::U8 | DataType::U16 | DataType::U32);
        if accessor.dimensions() != Dimensions::Scalar || !unsigned_type || accessor.sparse().is_some() {
            return self.malformed(format_args!("accessor {} is not of plain unsigned integers", accessor.index()));
        }
        let view = self.base_view(accessor)?;
        let elements = self.elements(view, accessor.offset(), accessor.count(), data_type.size())?;
        let indices: Vec<u32> = elements.map(|bytes| unsigned(bytes, data_type)).collect();
        match indices.iter().find(|i| **i as usize >= vertices) {
            Some(i) => self.malformed(format_args!("an index names vertex {i}, there are {vertices}")),
            None => Ok(indices),
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

/// One component as a float; `normalized` integers map to [0, 1] or [-1, 1] (glTF 2.0, 3.6.2.2).
fn component(bytes: &[u8], data_type: DataType, normalized: bool) -> f32 {
    let (value, full) = match data_type {
        DataType::I8 => (bytes[0] as i8 as f32, i8::MAX as f32),
        DataType::U8 => (bytes[0] as f32, u8::MAX as f32),
        DataType::I16 => (i16::from_le_bytes([bytes[0], bytes[1]]) as f32, i16::MAX as f32),
        DataType::U16 => (u16::from_le_bytes([bytes[0], bytes[1]]) as f32, u16::MAX as f32),
        DataType::U32 => (u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]) as f32, u32::MAX as f32),
        DataType::F32 => return f32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]),
    };
    if normalized { (value / full).max(-1.0) } else { value }
}

/// A little-endian unsigned integer of 1, 2 or 4 bytes.
fn unsigned(bytes: &[u8], data_type: DataType) -> u32 {
    match data_type {
        DataType::U8 => bytes[0] as u32,
        DataType::U16 => u16::from_le_bytes([bytes[0], bytes[1]]) as u32,
        _ => u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]),
    }
}

/// The triangles that a list of vertices stands for (glTF 2.0, 3.7.2.1); `None` if it is too short.
fn triangles_of(mode: Mode, corners: &[u32]) -> Option<Vec<[u32; 3]>> {
    if corners.len() < 3 || (mode == Mode::Triangles && !corners.len().is_multiple_of(3)) {
        return None;
    }
    Some(match mode {
        Mode::TriangleStrip => {
            let ordered = |(i, w): (usize, &[u32])| if i % 2 == 0 { [w[0], w[1], w[2]] } else { [w[0], w[2], w[1]] };
            corners.windows(3).enumerate().map(ordered).collect()
        }
        Mode::TriangleFan => corners[1..].windows(2).map(|w| [corners[0], w[0], w[1]]).collect(),
        _ => corners.as_chunks::<3>().0.to_vec(),
    })
}

/// Renumbers vertices so that only used ones remain, in their order, and returns their old numbers.
/// (Primitives often share one large vertex buffer.)
fn keep_used(triangles: &mut [[u32; 3]], vertices: usize) -> Vec<u32> {
    let mut number = vec![NONE; vertices];
    triangles.iter().flatten().for_each(|&v| number[v as usize] = 0);
    let used: Vec<u32> = (0..vertices as u32).filter(|&v| number[v as usize] == 0).collect();
    used.iter().zip(0..).for_each(|(&v, new)| number[v as usize] = new);
    triangles.iter_mut().flatten().for_each(|v| *v = number[*v as usize]);
    used
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::io::tests::{Folder, albedos, corners, load_bytes, load_path, refusal};
    use serde_json::{Value, json};
    use std::f32::consts::FRAC_1_SQRT_2;

    /// A file in parts, so that tests can change them.
    pub struct Sample {
        pub root: Value,
        pub binary: Vec<u8>,
    }

    /// A quad of two triangles, mirrored and moved by its node, and a lamp below the same root.
    pub fn sample() -> Sample {
        let mut binary = Vec::new();
        let positions = [[0f32, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]];
        let normals = [[0f32, 0.0, 1.0]; 4];
        let uvs = [[0u16, 0], [65535, 0], [65535, 65535], [0, 65535]];
        binary.extend(positions.as_flattened().iter().flat_map(|x| x.to_le_bytes()));
        binary.extend(normals.as_flattened().iter().flat_map(|x| x.to_le_bytes()));
        binary.extend(uvs.as_flattened().iter().flat_map(|x| x.to_le_bytes()));
        binary.extend([0u16, 1, 2, 0, 2, 3].iter().flat_map(|x| x.to_le_bytes()));
        let root = json!({
            "asset": { "version": "2.0" },
            "extensionsUsed": ["KHR_lights_punctual"],
            "scene": 0,
            "scenes": [{ "nodes": [0] }],
            "nodes": [
                { "children": [1, 2], "translation": [10, 0, 0] },
                { "mesh": 0, "scale": [-2, 1, 1] },
                { "rotation": [-FRAC_1_SQRT_2, 0, 0, FRAC_1_SQRT_2], "translation": [0, 5, 0],
                  "extensions": { "KHR_lights_punctual": { "light": 0 } } },
            ],
            "meshes": [{ "primitives": [{
                "attributes": { "POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 2, "TEXCOORD_1": 2 },
                "indices": 3, "material": 0,
            }] }],
            "materials": [{
                "pbrMetallicRoughness": { "baseColorFactor": [1, 0.5, 0.25, 1] }, "emissiveFactor": [1, 0.5, 0],
                "extensions": { "KHR_materials_emissive_strength": { "emissiveStrength": 4 } }, "doubleSided": true,
            }],
            "extensions": { "KHR_lights_punctual": { "lights": [
                { "type": "spot", "intensity": 10, "color": [1, 0.5, 0], "spot": { "outerConeAngle": 0.5 } },
            ] } },
            "accessors": [
                { "bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 0] },
                { "bufferView": 0, "byteOffset": 48, "componentType": 5126, "count": 4, "type": "VEC3" },
                { "bufferView": 1, "componentType": 5123, "normalized": true, "count": 4, "type": "VEC2" },
                { "bufferView": 2, "componentType": 5123, "count": 6, "type": "SCALAR" },
            ],
            "bufferViews": [
                { "buffer": 0, "byteLength": 96 },
                { "buffer": 0, "byteOffset": 96, "byteLength": 16, "byteStride": 4 },
                { "buffer": 0, "byteOffset": 112, "byteLength": 12 },
            ],
            "buffers": [{ "byteLength": 124 }],
        });
        Sample { root, binary }
    }

    impl Sample {
        /// As a glTF file with a data URI.
        pub fn gltf(&self) -> Vec<u8> {
            let mut root = self.root.clone();
            let data = base64::prelude::BASE64_STANDARD.encode(&self.binary);
            root["buffers"][0]["uri"] = format!("data:application/octet-stream;base64,{data}").into();
            root.to_string().into()
        }

        pub fn glb(&self) -> Vec<u8> {
            let mut text = self.root.to_string().into_bytes();
            text.resize(text.len().next_multiple_of(4), b' ');
            let length = 28 + text.len() + self.binary.len();
            let mut file = b"glTF\x02\0\0\0".to_vec();
            file.extend((length as u32).to_le_bytes());
            for (kind, chunk) in [(b"JSON", &text), (b"BIN\0", &self.binary)] {
                file.extend((chunk.len() as u32).to_le_bytes());
                file.extend(kind);
                file.extend(chunk);
            }
            file
        }
    }

    /// The sample with a change to its JSON.
    fn changed(change: impl FnOnce(&mut Value)) -> Vec<u8> {
        let mut sample = sample();
        change(&mut sample.root);
        sample.glb()
    }

    #[test]
    fn transforms_are_applied_and_mirrors_keep_the_front() {
        let (scene, info) = load_bytes("a.glb", sample().glb()).unwrap();
        let mesh = &scene.meshes()[0];
        let p = |x: f32, y: f32| Vec3::new(x, y, 0.0);
        assert_eq!(mesh.positions, [p(10.0, 0.0), p(8.0, 0.0), p(8.0, 1.0), p(10.0, 1.0)]);
        assert_eq!(mesh.normals, [Vec3::Z; 4]);
        for [a, b, c] in corners(&scene) {
            assert!((b - a).cross(c - a).z > 0.0, "the front still faces +z");
        }
        assert_eq!(mesh.uvs, [Vec2::ZERO, Vec2::X, Vec2::ONE, Vec2::Y]);
        let lightmap = mesh.lightmap.as_ref().unwrap();
        assert_eq!((&lightmap.uvs, lightmap.pages.len()), (&mesh.uvs, 0));
        assert_eq!((info.triangles, info.vertices, info.lights, info.has_lightmap_uvs), (2, 4, 1, true));
        assert!(info.warnings.is_empty(), "{:?}", info.warnings);
    }

    #[test]
    fn factors_become_materials() {
        let (scene, info) = load_bytes("a.glb", sample().glb()).unwrap();
        let material = scene.materials()[0];
        assert_eq!(material.albedo, [0.98, 0.5, 0.25]);
        assert_eq!((material.emission, material.two_sided), ([4.0, 2.0, 0.0], true));
        assert_eq!(info.albedos_clamped, 1);
        let bare = changed(|root| drop(root["meshes"][0]["primitives"][0].as_object_mut().unwrap().remove("material")));
        let (scene, _) = load_bytes("a.glb", bare).unwrap();
        assert_eq!(albedos(&scene)[0], [0.98; 3]);
        assert!(!scene.materials()[0].two_sided);
    }

    #[test]
    fn base_color_textures_come_from_views_data_and_files() {
        use crate::io::texture::tests::png;
        let image = png(2, 1, &[[10, 20, 30, 0], [40, 50, 60, 255]]);
        let textured = |source: Value, material: Value| {
            let mut sample = sample();
            let offset = sample.binary.len();
            sample.binary.extend(&image);
            sample.root["buffers"][0]["byteLength"] = sample.binary.len().into();
            let views = sample.root["bufferViews"].as_array_mut().unwrap();
            views.push(json!({ "buffer": 0, "byteOffset": offset, "byteLength": image.len() }));
            sample.root["images"] = json!([source]);
            sample.root["textures"] = json!([{ "source": 0 }]);
            let mut base = json!({ "pbrMetallicRoughness": {
                "baseColorFactor": [1, 0.5, 0.25, 0.8], "baseColorTexture": { "index": 0 } } });
            base.as_object_mut().unwrap().extend(material.as_object().unwrap().clone());
            sample.root["materials"][0] = base;
            let folder = Folder::new();
            std::fs::write(folder.path("an image.png"), &image).unwrap();
            std::fs::write(folder.path("a.glb"), sample.glb()).unwrap();
            load_path(&folder.path("a.glb")).unwrap()
        };
        let mask = json!({ "alphaMode": "MASK", "alphaCutoff": 0.4, "doubleSided": true });
        let data = format!("data:image/png;base64,{}", base64::prelude::BASE64_STANDARD.encode(&image));
        for source in [
            json!({ "bufferView": 3, "mimeType": "image/png" }),
            json!({ "bufferView": 3 }),
            json!({ "uri": data }),
            json!({ "uri": "an%20image.png" }),
        ] {
            let (scene, info) = textured(source, mask.clone());
            assert_eq!((info.textures, &info.warnings[..]), (1, &[][..]));
            assert_eq!(scene.textures()[0].rgba8, [[10, 20, 30, 0], [40, 50, 60, 255]]);
            let m = scene.materials()[0];
            assert_eq!((m.albedo, m.albedo_texture, m.two_sided), ([1.0, 0.5, 0.25], 0, true));
            // Of the texture's alpha: the factor has 0.8.
            assert_eq!(m.alpha_cutoff, 0.5);
            assert_eq!(info.albedos_clamped, 0);
        }
        let inside = || json!({ "bufferView": 3 });
        assert_eq!(textured(inside(), json!({ "alphaMode": "MASK" })).0.materials()[0].alpha_cutoff, 0.5 / 0.8);
        assert_eq!(textured(inside(), json!({})).0.materials()[0].alpha_cutoff, 0.0);
        let (scene, info) = textured(inside(), json!({ "alphaMode": "BLEND" }));
        assert_eq!(scene.materials()[0].alpha_cutoff, 0.0);
        assert_eq!(info.warnings, ["1 materials are blended (alphaMode BLEND) and count as opaque"]);
        let emits = json!({ "alphaMode": "MASK", "emissiveFactor": [1, 1, 1] });
        assert_eq!(textured(inside(), emits).0.materials()[0].alpha_cutoff, 0.0);
        // Images that are not there, or not images.
        for source in
            [json!({}), json!({ "uri": "no.png" }), json!({ "uri": "http://x/y.png" }), json!({ "uri": "a.glb" })]
        {
            let (scene, info) = textured(source, mask.clone());
            let m = scene.materials()[0];
            assert_eq!((m.albedo, m.albedo_texture, m.alpha_cutoff), ([0.98, 0.5, 0.25], NONE, 0.0));
            let [warning] = &info.warnings[..] else { panic!("{:?}", info.warnings) };
            assert!(warning.starts_with("the image 0 cannot be read ("), "{warning}");
        }
    }

    #[test]
    fn masked_factors_hide_and_transmission_lets_through() {
        let with = |alpha: f32| {
            changed(|root| {
                root["materials"][0] =
                    json!({ "pbrMetallicRoughness": { "baseColorFactor": [1, 1, 1, alpha] }, "alphaMode": "MASK" });
                root["nodes"][2]["mesh"] = 0.into();
            })
        };
        assert_eq!(load_bytes("a.glb", with(0.6)).unwrap().0.materials()[0].alpha_cutoff, 0.0);
        for alpha in [0.4, 0.0] {
            assert!(refusal("a.glb", with(alpha)).ends_with("there are no triangles in it"));
        }
        let glass = changed(|root| {
            root["materials"][0] = json!({
                "pbrMetallicRoughness": { "baseColorFactor": [0.8, 0.4, 0.1, 1] },
                "extensions": { "KHR_materials_transmission": { "transmissionFactor": 0.75 } },
            });
        });
        let m = load_bytes("a.glb", glass).unwrap().0.materials()[0];
        assert_eq!(m.transmission, [0.8f32, 0.4, 0.1].map(|c| c * 0.75));
        assert_eq!(m.albedo, [0.8f32, 0.4, 0.1].map(|c| c * 0.25));
    }

    #[test]
    fn punctual_lights_follow_their_nodes() {
        let lamp = |change: Value| {
            let file = changed(|root| {
                root["extensions"]["KHR_lights_punctual"]["lights"][0] = change;
            });
            load_bytes("a.glb", file).unwrap().0.lights()[0]
        };
        let spot = json!({ "type": "spot", "intensity": 10, "color": [1, 0.5, 0], "spot": { "outerConeAngle": 0.5 } });
        let Light::Spot { position, direction, inner, outer, intensity } = lamp(spot) else { panic!() };
        assert_eq!((position, inner, outer), (Vec3::new(10.0, 5.0, 0.0), 0.0, 0.5));
        assert!(direction.abs_diff_eq(Vec3::NEG_Y, 1e-6), "{direction}");
        assert_eq!(intensity, [10.0, 5.0, 0.0]);
        let point = lamp(json!({ "type": "point" }));
        assert_eq!(point, Light::Point { position: Vec3::new(10.0, 5.0, 0.0), intensity: [1.0; 3] });
        let Light::Directional { direction, irradiance, .. } = lamp(json!({ "type": "directional", "intensity": 3 }))
        else {
            panic!()
        };
        assert!(direction.abs_diff_eq(Vec3::NEG_Y, 1e-6) && irradiance == [3.0; 3]);
    }

    #[test]
    fn buffers_may_be_inside_or_beside_the_file() {
        let (inside, _) = load_bytes("a.glb", sample().glb()).unwrap();
        assert_eq!(load_bytes("a.gltf", sample().gltf()).unwrap().0.meshes(), inside.meshes());
        let folder = Folder::new();
        let mut beside = sample();
        beside.root["buffers"][0]["uri"] = "da%20ta.bin".into();
        std::fs::write(folder.path("da ta.bin"), &beside.binary).unwrap();
        std::fs::write(folder.path("a.gltf"), beside.root.to_string()).unwrap();
        assert_eq!(load_path(&folder.path("a.gltf")).unwrap().0.meshes(), inside.meshes());
        std::fs::remove_file(folder.path("da ta.bin")).unwrap();
        let Err(Error::Io(message)) = load_path(&folder.path("a.gltf")) else { panic!() };
        assert!(message.contains("buffer 0") && message.contains("da ta.bin"), "{message}");
    }

    #[test]
    fn strips_fans_and_lists_without_indices_become_triangles() {
        let indices = |mode: u32| {
            let file = changed(|root| {
                let primitive = root["meshes"][0]["primitives"][0].as_object_mut().unwrap();
                primitive.remove("indices");
                primitive.insert("mode".into(), mode.into());
                root["nodes"][1].as_object_mut().unwrap().remove("scale");
            });
            load_bytes("a.glb", file).map(|(scene, _)| scene.meshes()[0].indices.clone())
        };
        assert_eq!(indices(5).unwrap(), [[0, 1, 2], [1, 3, 2]]);
        assert_eq!(indices(6).unwrap(), [[0, 1, 2], [0, 2, 3]]);
        let Err(Error::Io(message)) = indices(4) else { panic!() };
        assert!(message.ends_with("mesh 0, primitive 0: 4 vertices do not make triangles"), "{message}");
        let Err(Error::Io(message)) = indices(1) else { panic!() };
        assert!(message.ends_with("there are no triangles in it"), "{message}");
    }

    #[test]
    fn only_vertices_in_use_are_kept() {
        let file = changed(|root| {
            root["accessors"][3]["count"] = 3.into();
            root["accessors"][3]["byteOffset"] = 6.into();
        });
        let (scene, _) = load_bytes("a.glb", file).unwrap();
        assert_eq!(scene.meshes()[0].positions.len(), 3);
        assert_eq!(scene.meshes()[0].indices, [[0, 2, 1]]);
        assert_eq!(scene.meshes()[0].uvs, [Vec2::ZERO, Vec2::ONE, Vec2::Y]);
    }

    #[test]
    fn sparse_values_replace_others() {
        let mut sample = sample();
        let offset = sample.binary.len();
        sample.binary.extend([2u8, 0, 0, 0]);
        sample.binary.extend([5f32, 6.0, 7.0].iter().flat_map(|x| x.to_le_bytes()));
        sample.root["buffers"][0]["byteLength"] = sample.binary.len().into();
        let views = sample.root["bufferViews"].as_array_mut().unwrap();
        views.push(json!({ "buffer": 0, "byteOffset": offset, "byteLength": 16 }));
        let sparse = |index: u64| {
            json!({ "count": 1, "indices": { "bufferView": 3, "byteOffset": index, "componentType": 5121 },
                "values": { "bufferView": 3, "byteOffset": 4 } })
        };
        sample.root["accessors"][0]["sparse"] = sparse(0);
        let (scene, _) = load_bytes("a.glb", sample.glb()).unwrap();
        assert_eq!(scene.meshes()[0].positions[2], Vec3::new(0.0, 6.0, 7.0));
        // The byte at 7 is part of 5.0: 0x40.
        sample.root["accessors"][0]["sparse"] = sparse(7);
        assert!(refusal("a.glb", sample.glb()).ends_with("a sparse value is for element 64, there are 4"));
    }

    #[test]
    fn a_mesh_that_appears_twice_has_no_unique_coordinates() {
        let file = changed(|root| root["nodes"][2]["mesh"] = 0.into());
        let (scene, info) = load_bytes("a.glb", file).unwrap();
        assert_eq!(scene.meshes().len(), 2);
        assert!(!info.has_lightmap_uvs);
        assert_eq!(
            info.warnings,
            ["1 meshes appear several times, so their TEXCOORD_1 is not unique and was left out"]
        );
    }

    #[test]
    fn malformed_files_are_refused_with_the_place() {
        let with = |change: fn(&mut Value)| refusal("a.glb", changed(change));
        let vertex = with(|root| {
            root["accessors"][3]["bufferView"] = 1.into();
            root["accessors"][3]["count"] = 3.into();
        });
        assert_eq!(vertex, "mesh 0, primitive 0: an index names vertex 65535, there are 4");
        assert_eq!(
            with(|root| root["accessors"][0]["count"] = 9_000_000_000_000_000_000u64.into()),
            "mesh 0, primitive 0: 9000000000000000000 elements do not fit into buffer view 0"
        );
        assert_eq!(
            with(|root| root["bufferViews"][0]["byteLength"] = u64::MAX.into()),
            "mesh 0, primitive 0: 4 elements do not fit into buffer view 0"
        );
        assert_eq!(with(|root| root["buffers"][0]["byteLength"] = 125.into()), "buffer 0: it has 124 bytes, not 125");
        assert_eq!(
            with(|root| root["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = 7.into()),
            "mesh 0 names accessor 7, there are 4"
        );
        assert_eq!(with(|root| root["nodes"][2]["children"] = json!([0])), "node 0 has several parents");
        assert_eq!(with(|root| root["nodes"][2]["children"] = json!([1])), "node 1 has several parents");
        assert_eq!(
            with(|root| root["materials"][0]["emissiveFactor"] = json!([-1, 0, 0])),
            "mesh 0, primitive 0: the emission contains -4, less than 0"
        );
        assert!(with(|root| root["nodes"][1]["scale"] = json!([1e38, 1, 1])).contains("vertex 1 is"));
        let light = with(|root| root["extensions"]["KHR_lights_punctual"]["lights"][0]["intensity"] = (-1).into());
        assert!(light.starts_with("light 0: the light's color contains -1"), "{light}");
        assert!(
            with(|root| root["nodes"][2]["scale"] = json!([0, 0, 0])).starts_with("light 0: the light's direction")
        );
        assert!(with(|root| root["accessors"][0]["type"] = "VEC2".into()).ends_with("accessor 0 is not of 3-vectors"));
        assert!(with(|root| root["bufferViews"][0]["byteStride"] = 4.into()).ends_with("stride 4, less than 12"));
        assert_eq!(refusal("a.glb", b"glTF\x02\0\0\0"), "the GLB header is cut off");
        for nothing in ["", "{}", "null", "[1", "{\"asset\":{\"version\":\"2.0\"}}"] {
            assert!(!refusal("a.gltf", nothing).is_empty());
        }
    }

    #[test]
    fn vertices_that_are_not_numbers_are_refused() {
        let mut sample = sample();
        sample.binary[12..16].copy_from_slice(&f32::NAN.to_le_bytes());
        let message = refusal("a.glb", sample.glb());
        assert!(message.starts_with("mesh 0, primitive 0: vertex 1 is [NaN"), "{message}");
    }

    #[test]
    fn compressed_geometry_is_unsupported_but_harmless_extensions_are_not() {
        let with = |name: &str| load_bytes("a.glb", changed(|root| root["extensionsRequired"] = json!([name])));
        let Err(Error::Unsupported(message)) = with("KHR_draco_mesh_compression") else { panic!() };
        assert!(message.contains("a.glb") && message.contains("KHR_draco_mesh_compression"), "{message}");
        for harmless in ["KHR_texture_transform", "KHR_materials_unlit", "KHR_mesh_quantization", "KHR_lights_punctual"]
        {
            assert_eq!(with(harmless).unwrap().1.triangles, 2, "{harmless}");
        }
    }
}
