//! glTF 2.0 and GLB: the triangles of the default scene with node transforms applied.
//!
//! - Albedo is `baseColorFactor` × `baseColorTexture` (metalness is ignored), emission is `emissiveFactor` ×
//!   `KHR_materials_emissive_strength` without its texture, sidedness is `doubleSided`.
//! - `alphaMode` `MASK` cuts holes, except into surfaces that emit; `BLEND` counts as opaque.
//!   `KHR_materials_transmission`: its factor of `baseColorFactor` passes straight through, as through a thin
//!   sheet; textures do not change that.
//! - Images (PNG, JPEG) come from buffer views, data URIs and files beside or below the scene. All repeat, whatever their
//!   sampler says, and `KHR_texture_transform` is ignored.
//! - `TEXCOORD_0` becomes [`Mesh::uvs`], `TEXCOORD_1` the light map coordinates. Their page is the
//!   number of the material's texture that uses them, among all textures that are used so (as our
//!   own export writes them), else 0. A mesh that several nodes show has no unique coordinates: none
//!   are taken.
//! - `KHR_lights_punctual`: candela is taken as W/sr and lux as W/m²; `range` is ignored.
//! - Nodes that mirror flip the winding. Skins and morph targets stay in their rest pose.
//! - Buffers: the binary chunk, data URIs, files beside or below the scene. Sparse accessors are read,
//!   `KHR_mesh_quantization` too; compressed geometry is refused as unsupported.
//!
//! The crate `gltf` reads the JSON; accessors are read here, because the crate's readers trust sizes
//! in the file.

use super::source::{Attempt, Checked, Opened, folder_of};
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
use std::borrow::Cow;
use std::collections::{BTreeSet, HashMap, HashSet};
use std::io::BufReader;
use std::ops::Range;

/// Required extensions that change nothing about shapes: they may be ignored.
const HARMLESS_EXTENSIONS: [&str; 5] =
    ["KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_mesh_quantization", "KHR_xmp"];

pub(super) fn load(import: &mut Import, opened: Opened) -> Result<()> {
    let bytes = import.read_opened(opened)?;
    let (json, blob) = split(import, &bytes)?;
    let mut text = Text::new(import, json)?;
    let document = parse(import, &mut text)?;
    let mut buffers = import.account.list(document.buffers().len(), "the buffers")?;
    for buffer in document.buffers() {
        buffers.push(read_buffer(import, &buffer, &text, blob)?);
    }
    let mut reader = Reader {
        buffers: &buffers,
        text: &text,
        document: &document,
        materials: HashMap::new(),
        images: HashMap::new(),
        pages: lightmap_pages(&document),
        mesh_uses: vec![0; document.meshes().len()],
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
            reader.import.check()?;
            reader.add_primitive(&primitive, transform, reader.mesh_uses[mesh] == 1)?;
        }
    }
    reader.warn();
    if import.scene.triangle_count() == 0 {
        return Err(import.error("there are no triangles in it"));
    }
    Ok(())
}

/// The JSON of a file and its binary chunk, without copies.
fn split<'b>(import: &Import, bytes: &'b [u8]) -> Result<(&'b [u8], Option<&'b [u8]>)> {
    if !bytes.starts_with(b"glTF") {
        return Ok((bytes, None));
    }
    // The crate subtracts the header's size from the length that the header states.
    let stated = bytes.get(8..12).map_or(0, |b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]));
    if stated < 12 {
        return Err(import.error("the GLB header is cut off"));
    }
    let glb = gltf::binary::Glb::from_slice(bytes).map_err(|e| explain(import, e))?;
    let borrowed = |chunk: Cow<'b, [u8]>| match chunk {
        Cow::Borrowed(bytes) => Ok(bytes),
        Cow::Owned(_) => Err(Error::Internal("a chunk was copied".into())),
    };
    Ok((borrowed(glb.json)?, glb.bin.map(borrowed).transpose()?))
}

/// A JSON text without its long data URIs, which the parser would copy: each is replaced by its number.
struct Text<'b> {
    short: Vec<u8>,
    whole: &'b [u8],
    /// Places of data URIs in the whole text, without quotes.
    uris: Vec<Range<usize>>,
}

/// What stands for data URI 7: `data:#7`.
const REPLACED: &str = "data:#";

/// Data URIs up to this length may stay.
const SHORT_URI: usize = 1 << 10;

impl<'b> Text<'b> {
    fn new(import: &mut Import, whole: &'b [u8]) -> Result<Text<'b>> {
        let mut text = Text { short: Vec::new(), whole, uris: Vec::new() };
        // Where a string began, and whether the byte before was a backslash in it.
        let (mut string, mut escaped) = (None, false);
        let mut copied = 0;
        for (at, &c) in whole.iter().enumerate() {
            if at.is_multiple_of(1 << 20) {
                import.check()?;
            }
            match string {
                None if c == b'"' => string = Some(at + 1),
                None => {}
                Some(_) if escaped => escaped = false,
                Some(_) if c == b'\\' => escaped = true,
                Some(start) if c == b'"' => {
                    string = None;
                    let uri = &whole[start..at];
                    if uri.starts_with(b"data:") && (uri.len() > SHORT_URI || uri.starts_with(REPLACED.as_bytes())) {
                        text.append(import, &whole[copied..start])?;
                        let number = format!("{REPLACED}{}", text.uris.len());
                        text.append(import, number.as_bytes())?;
                        import.account.push(&mut text.uris, start..at, "the data URIs")?;
                        copied = at;
                    }
                }
                Some(_) => {}
            }
        }
        text.append(import, &whole[copied..])?;
        Ok(text)
    }

    fn append(&mut self, import: &mut Import, bytes: &[u8]) -> Result<()> {
        import.account.make_room(&mut self.short, bytes.len(), "the JSON text")?;
        self.short.extend_from_slice(bytes);
        Ok(())
    }

    /// What a data URI holds, without `data:`; `None` if it is none.
    fn data<'t>(&'t self, uri: &'t str) -> Option<&'t [u8]> {
        let content = uri.strip_prefix("data:")?;
        let number = content.strip_prefix('#').and_then(|n| n.parse::<usize>().ok());
        Some(match number.and_then(|n| self.uris.get(n)) {
            Some(range) => &self.whole[range.start + "data:".len()..range.end],
            None => content.as_bytes(),
        })
    }

    /// The bytes that a data URI holds in base64. `None` if it is none; the account counts them.
    fn decoded(&self, import: &mut Import, uri: &str) -> Option<Attempt<Vec<u8>>> {
        const MARK: &[u8] = b";base64,";
        let data = self.data(uri)?;
        let Some(mark) = data.windows(MARK.len()).position(|w| w == MARK) else {
            return Some(Ok(Err("a data URI without base64".into())));
        };
        let encoded = data[mark + MARK.len()..].trim_ascii_end();
        if !encoded.contains(&b'\\') {
            return Some(decode_base64(import, encoded));
        }
        // Some writers of JSON escape the slash, some the plus sign.
        let plain = import.account.list(encoded.len(), "a data URI").map(|mut plain| {
            unescape(encoded, &mut plain);
            plain
        });
        Some(plain.and_then(|plain| {
            let decoded = decode_base64(import, &plain);
            import.account.give_back(plain.capacity());
            decoded
        }))
    }
}

/// Appends a JSON string without its escapes, as far as base64 goes: one of anything else stays a backslash, which is
/// none.
fn unescape(mut text: &[u8], out: &mut Vec<u8>) {
    while let Some(at) = text.iter().position(|c| *c == b'\\') {
        out.extend_from_slice(&text[..at]);
        let code = |hex: &[u8]| u8::from_str_radix(str::from_utf8(hex).ok()?, 16).ok();
        let (plain, length) = match &text[at + 1..] {
            [b'/', ..] => (b'/', 2),
            [b'u', b'0', b'0', hex @ ..] => (hex.get(..2).and_then(code).unwrap_or(b'\\'), 6),
            _ => (b'\\', 1),
        };
        out.push(plain);
        text = text.get(at + length..).unwrap_or_default();
    }
    out.extend_from_slice(text);
}

fn decode_base64(import: &mut Import, encoded: &[u8]) -> Attempt<Vec<u8>> {
    // Of a multiple of 4, so that pieces are decoded alone.
    const PIECE: usize = 1 << 20;
    let size = encoded.len() / 4 * 3 + 3;
    let mut bytes = import.account.list(size, "a data URI")?;
    let mut piece = import.account.list::<u8>(PIECE / 4 * 3 + 3, "a data URI")?;
    piece.resize(PIECE / 4 * 3 + 3, 0);
    let pieces = encoded.len().div_ceil(PIECE);
    for (i, text) in encoded.chunks(PIECE).enumerate() {
        import.check()?;
        // Padding ends it all.
        if i + 1 < pieces && text.ends_with(b"=") {
            return Ok(Err("padding in the middle of base64".into()));
        }
        match base64::prelude::BASE64_STANDARD.decode_slice(text, &mut piece) {
            Ok(count) => bytes.extend_from_slice(&piece[..count]),
            Err(e) => return Ok(Err(e.to_string())),
        }
    }
    import.account.give_back(piece.capacity());
    Ok(Ok(bytes))
}

fn parse(import: &mut Import, text: &mut Text) -> Result<gltf::Document> {
    // What the parser makes of the text takes several times as much, and is not ours to allocate.
    let estimate = text.short.len().saturating_mul(4);
    import.account.hold(estimate, "the JSON of the scene")?;
    // The parser asks for single bytes.
    let reader = BufReader::new(Checked::new(&text.short, import.advance));
    let mut root = json::Root::from_reader(reader).map_err(|e| import.error(e))?;
    let size = text.short.capacity();
    text.short = Vec::new();
    import.account.give_back(size);
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
    gltf::Document::from_json(root).map_err(|e| explain(import, e))
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
fn read_buffer<'b>(
    import: &mut Import,
    buffer: &gltf::Buffer,
    text: &Text,
    blob: Option<&'b [u8]>,
) -> Result<Cow<'b, [u8]>> {
    let read = match buffer.source() {
        gltf::buffer::Source::Bin => Ok(blob.map(Cow::Borrowed).ok_or("there is no binary chunk and no uri".into())),
        gltf::buffer::Source::Uri(uri) => read_uri(import, text, uri).map(|read| read.map(Cow::Owned)),
    };
    let fail = |what: &dyn std::fmt::Display| import.error(format_args!("buffer {}: {what}", buffer.index()));
    let bytes: Cow<[u8]> = read?.map_err(|what| fail(&what))?;
    if bytes.len() < buffer.length() {
        return Err(fail(&format_args!("it has {} bytes, not {}", bytes.len(), buffer.length())));
    }
    Ok(bytes)
}

/// What a URI names: data in itself, or a file beside the scene. The account counts it.
fn read_uri(import: &mut Import, text: &Text, uri: &str) -> Attempt<Vec<u8>> {
    if let Some(data) = text.decoded(import, uri) {
        return data;
    }
    match percent_decoded(uri) {
        Some(name) => {
            let folder = folder_of(&import.path).to_owned();
            import.read_named(&folder, &name.replace('\\', "/"))
        }
        None => Ok(Err(format!("the uri {uri:?}"))),
    }
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
fn place_nodes<'a>(import: &mut Import, document: &'a gltf::Document) -> Result<Vec<(gltf::Node<'a>, DMat4)>> {
    let roots: Vec<_> = match document.default_scene().or_else(|| document.scenes().next()) {
        Some(scene) => scene.nodes().collect(),
        None => {
            let children: BTreeSet<_> = document.nodes().flat_map(|n| n.children()).map(|n| n.index()).collect();
            document.nodes().filter(|n| !children.contains(&n.index())).collect()
        }
    };
    let count = document.nodes().len();
    let mut seen = import.account.list(count, "the nodes")?;
    seen.resize(count, false);
    let mut placed = import.account.list(count, "the nodes")?;
    let mut stack: Vec<_> = roots.into_iter().rev().map(|node| (node, DMat4::IDENTITY)).collect();
    while let Some((node, parent)) = stack.pop() {
        if placed.len().is_multiple_of(1024) {
            import.check()?;
        }
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

struct Reader<'i, 's> {
    import: &'i mut Import<'s>,
    buffers: &'i [Cow<'i, [u8]>],
    text: &'i Text<'i>,
    document: &'i gltf::Document,
    /// Our material by theirs; `None` is glTF's default material. [`NONE`]: nothing can be seen of it.
    materials: HashMap<Option<usize>, u32>,
    /// Our texture by their image; [`NONE`] if it cannot be read.
    images: HashMap<usize, u32>,
    pages: HashMap<usize, u32>,
    /// How many nodes show each mesh.
    mesh_uses: Vec<u32>,
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
    /// Primitives that are holes all over.
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
        let id = match self.import.image(image, read)? {
            Some(texture) => self.import.add_texture(texture)?,
            None => NONE,
        };
        self.images.insert(image, id);
        Ok(id)
    }

    /// (From the JSON: the crate's view of images panics at those that are neither here nor there.)
    fn image(&mut self, image: usize) -> Attempt<Texture> {
        let Some(json) = self.document.as_json().images.get(image) else {
            return Ok(Err("there is none of this number".into()));
        };
        if let Some(view) = &json.buffer_view {
            let Some(view) = self.document.views().nth(view.value()) else {
                return Ok(Err("its buffer view is missing".into()));
            };
            let buffer = &self.buffers[view.buffer().index()];
            let bytes = view.offset().checked_add(view.length()).and_then(|end| buffer.get(view.offset()..end));
            return match bytes {
                Some(bytes) => texture::decode(self.import, bytes),
                None => Ok(Err("its buffer view does not fit its buffer".into())),
            };
        }
        let Some(uri) = json.uri.as_deref() else {
            return Ok(Err("it has neither a buffer view nor a uri".into()));
        };
        let bytes = match read_uri(self.import, self.text, uri)? {
            Ok(bytes) => bytes,
            Err(what) => return Ok(Err(what)),
        };
        let texture = texture::decode(self.import, &bytes);
        self.import.account.give_back(bytes.capacity());
        texture
    }

    /// Adds a primitive as a mesh. `unique`: no other node shows it.
    fn add_primitive(&mut self, primitive: &gltf::Primitive, transform: &DMat4, unique: bool) -> Result<()> {
        let mode = primitive.mode();
        if !matches!(mode, Mode::Triangles | Mode::TriangleStrip | Mode::TriangleFan) {
            self.skipped_primitives += 1;
            return Ok(());
        }
        let Some(accessor) = primitive.get(&Semantic::Positions) else { return self.malformed("it has no positions") };
        let positions = self.column::<3>(&accessor)?;
        let vertices = positions.count;
        let corners = match primitive.indices() {
            Some(indices) => self.indices(&indices, vertices)?,
            None => {
                let count = u32::try_from(vertices).or_else(|_| self.malformed("it has too many vertices"))?;
                let mut corners = self.import.account.list(vertices, "the corners")?;
                corners.extend(0..count);
                corners
            }
        };
        let count = match triangle_count(mode, corners.len()) {
            Some(count) => count,
            None => return self.malformed(format_args!("{} vertices do not make triangles", corners.len())),
        };
        self.triangles += count;
        self.import.check_triangle_count(self.triangles)?;
        let mut indices = self.import.account.list(count, "the triangles")?;
        add_triangles(mode, &corners, &mut indices);
        self.import.account.give_back(4 * corners.capacity());
        drop(corners);
        if transform.determinant() < 0.0 {
            indices.iter_mut().for_each(|t| t.swap(1, 2));
        }
        let used = self.keep_used(&mut indices, vertices)?;
        let mut mesh = Mesh { indices, positions: self.room(&used)?, ..Default::default() };
        for part in used.chunks(PART) {
            self.import.check()?;
            for &v in part {
                let position = transform.transform_point3(Vec3::from(positions.get(v)).as_dvec3()).as_vec3();
                if !is_valid_position(position) {
                    return self.malformed(format_args!("vertex {v} is {position}, not finite or out of range"));
                }
                mesh.positions.push(position);
            }
        }
        mesh.normals = self.normals(primitive, transform, &used, vertices)?;
        mesh.uvs = self.uvs(primitive, 0, &used, vertices)?;
        let material = primitive.material();
        let lightmap_uvs = if unique { self.uvs(primitive, 1, &used, vertices)? } else { Vec::new() };
        self.import.account.give_back(4 * used.capacity());
        if !lightmap_uvs.is_empty() {
            let page = lightmap_texture(&material).and_then(|t| self.pages.get(&t)).copied().unwrap_or(0);
            let mut pages = Vec::new();
            if page != 0 {
                pages = self.import.account.list(mesh.indices.len(), "the light map pages")?;
                pages.resize(mesh.indices.len(), page);
            }
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

    /// Room for a value of each used vertex.
    fn room<T>(&mut self, used: &[u32]) -> Result<Vec<T>> {
        self.import.account.list(used.len(), "the vertices")
    }

    /// Renumbers vertices so that only used ones remain, in their order, and returns their old numbers.
    fn keep_used(&mut self, triangles: &mut [[u32; 3]], vertices: usize) -> Result<Vec<u32>> {
        if self.number.len() < vertices {
            let more = vertices - self.number.len();
            self.import.account.make_room(&mut self.number, more, "the vertices")?;
            self.number.resize(vertices, NONE);
        }
        let mut used = self.import.account.list(vertices.min(3 * triangles.len()), "the vertices")?;
        for &v in triangles.iter().flatten() {
            if std::mem::replace(&mut self.number[v as usize], 0) == NONE {
                used.push(v);
            }
        }
        used.sort_unstable();
        used.iter().zip(0..).for_each(|(&v, new)| self.number[v as usize] = new);
        triangles.iter_mut().flatten().for_each(|v| *v = self.number[*v as usize]);
        used.iter().for_each(|&v| self.number[v as usize] = NONE);
        Ok(used)
    }

    fn normals(
        &mut self,
        primitive: &gltf::Primitive,
        transform: &DMat4,
        used: &[u32],
        vertices: usize,
    ) -> Result<Vec<Vec3>> {
        let Some(accessor) = primitive.get(&Semantic::Normals) else { return Ok(Vec::new()) };
        let normals = self.column::<3>(&accessor)?;
        if normals.count != vertices {
            return self.malformed(format_args!("it has {} normals for {vertices} vertices", normals.count));
        }
        // The cofactor matrix: the inverse transpose without the division by the determinant. Its
        // sign turns normals round where the winding is turned too.
        let m = DMat3::from_mat4(*transform);
        let flip = if m.determinant() < 0.0 { -1.0 } else { 1.0 };
        let cofactors =
            DMat3::from_cols(m.y_axis.cross(m.z_axis), m.z_axis.cross(m.x_axis), m.x_axis.cross(m.y_axis)) * flip;
        let turn = |n: [f32; 3]| -> DVec3 { (cofactors * Vec3::from(n).as_dvec3()).normalize_or_zero() };
        let mut turned = self.room(used)?;
        for part in used.chunks(PART) {
            self.import.check()?;
            turned.extend(part.iter().map(|&v| turn(normals.get(v)).as_vec3()));
        }
        Ok(turned)
    }

    /// Texture coordinates of the used vertices; empty if there are none.
    fn uvs(&mut self, primitive: &gltf::Primitive, set: u32, used: &[u32], vertices: usize) -> Result<Vec<Vec2>> {
        let Some(accessor) = primitive.get(&Semantic::TexCoords(set)) else { return Ok(Vec::new()) };
        let column = self.column::<2>(&accessor)?;
        if column.count != vertices {
            return self.malformed(format_args!("TEXCOORD_{set} has {} entries for {vertices} vertices", column.count));
        }
        let mut uvs = self.room(used)?;
        for part in used.chunks(PART) {
            self.import.check()?;
            uvs.extend(part.iter().map(|&v| Vec2::from(column.get(v))));
        }
        match used.iter().zip(&uvs).find(|(_, uv)| !uv.is_finite()) {
            Some((v, _)) => self.malformed(format_args!("TEXCOORD_{set} of vertex {v} is not finite")),
            None => Ok(uvs),
        }
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
    fn elements(&self, view: gltf::buffer::View, offset: usize, count: usize, size: usize) -> Result<Elements<'i>> {
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
            Some(bytes) => Ok(Elements { bytes, stride, size }),
            None => self.malformed(format_args!("{count} elements do not fit into buffer view {}", view.index())),
        }
    }

    /// An accessor of `N` components each. Values are converted when they are asked for: a primitive may use few of
    /// very many.
    fn column<const N: usize>(&mut self, accessor: &gltf::Accessor) -> Result<Column<'i, N>> {
        if accessor.dimensions() != if N == 2 { Dimensions::Vec2 } else { Dimensions::Vec3 } {
            return self.malformed(format_args!("accessor {} is not of {N}-vectors", accessor.index()));
        }
        let (data_type, normalized) = (accessor.data_type(), accessor.normalized());
        let size = data_type.size() * N;
        let count = accessor.count();
        let values = self.elements(self.base_view(accessor)?, accessor.offset(), count, size)?;
        let sparse = match accessor.sparse() {
            Some(sparse) => Some(self.sparse(accessor.index(), &sparse, count, size)?),
            None => None,
        };
        Ok(Column { values, count, data_type, normalized, sparse })
    }

    fn sparse(
        &mut self,
        accessor: usize,
        sparse: &gltf::accessor::sparse::Sparse,
        count: usize,
        size: usize,
    ) -> Result<Sparse<'i>> {
        let indices = sparse.indices();
        let index_type = match indices.index_type() {
            gltf::accessor::sparse::IndexType::U8 => DataType::U8,
            gltf::accessor::sparse::IndexType::U16 => DataType::U16,
            gltf::accessor::sparse::IndexType::U32 => DataType::U32,
        };
        let at = self.elements(indices.view(), indices.offset(), sparse.count(), index_type.size())?;
        let values = self.elements(sparse.values().view(), sparse.values().offset(), sparse.count(), size)?;
        let sparse = Sparse { at, index_type, values, count: sparse.count() };
        if !self.sorted.contains(&accessor) {
            let mut next = 0;
            for k in 0..sparse.count {
                if k.is_multiple_of(PART) {
                    self.import.check()?;
                }
                let i = sparse.index(k);
                if i >= count {
                    return self.malformed(format_args!("a sparse value is for element {i}, there are {count}"));
                }
                if i < next {
                    return self
                        .malformed(format_args!("sparse values are not in order: {i} comes after {}", next - 1));
                }
                next = i + 1;
            }
            self.sorted.insert(accessor);
        }
        Ok(sparse)
    }

    /// Vertex numbers, checked to be less than `vertices`.
    fn indices(&mut self, accessor: &gltf::Accessor, vertices: usize) -> Result<Vec<u32>> {
        let data_type = accessor.data_type();
        let unsigned_type = matches!(data_type, DataType::U8 | DataType::U16 | DataType::U32);
        if accessor.dimensions() != Dimensions::Scalar || !unsigned_type || accessor.sparse().is_some() {
            return self.malformed(format_args!("accessor {} is not of plain unsigned integers", accessor.index()));
        }
        let (view, count) = (self.base_view(accessor)?, accessor.count());
        let elements = self.elements(view, accessor.offset(), count, data_type.size())?;
        let mut indices = self.import.account.list(count, "the corners")?;
        for k in 0..count {
            if k.is_multiple_of(PART) {
                self.import.check()?;
            }
            let i = unsigned(elements.get(k), data_type);
            if i as usize >= vertices {
                return self.malformed(format_args!("an index names vertex {i}, there are {vertices}"));
            }
            indices.push(i);
        }
        Ok(indices)
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

/// Values that are worked on between two looks for a cancel: a millisecond or less.
const PART: usize = 1 << 16;

/// Elements in a buffer, whose bounds have been checked.
struct Elements<'b> {
    bytes: &'b [u8],
    stride: usize,
    size: usize,
}

impl<'b> Elements<'b> {
    fn get(&self, k: usize) -> &'b [u8] {
        &self.bytes[k * self.stride..][..self.size]
    }
}

/// Vectors of an accessor.
struct Column<'b, const N: usize> {
    values: Elements<'b>,
    count: usize,
    data_type: DataType,
    normalized: bool,
    sparse: Option<Sparse<'b>>,
}

impl<const N: usize> Column<'_, N> {
    /// Integers are converted to floats.
    fn get(&self, vertex: u32) -> [f32; N] {
        let v = vertex as usize;
        let replaced = self.sparse.as_ref().and_then(|sparse| sparse.get(v));
        let bytes = replaced.unwrap_or_else(|| self.values.get(v));
        let part = self.data_type.size();
        std::array::from_fn(|k| component(&bytes[k * part..], self.data_type, self.normalized))
    }
}

/// Values that replace others, in the order of their elements.
struct Sparse<'b> {
    at: Elements<'b>,
    index_type: DataType,
    values: Elements<'b>,
    count: usize,
}

impl<'b> Sparse<'b> {
    fn index(&self, k: usize) -> usize {
        unsigned(self.at.get(k), self.index_type) as usize
    }

    fn get(&self, element: usize) -> Option<&'b [u8]> {
        // Binary search.
        let (mut low, mut high) = (0, self.count);
        while low < high {
            let middle = low + (high - low) / 2;
            if self.index(middle) < element {
                low = middle + 1;
            } else {
                high = middle;
            }
        }
        (low < self.count && self.index(low) == element).then(|| self.values.get(low))
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

/// How many triangles a list of vertices stands for (glTF 2.0, 3.7.2.1); `None` if it is too short.
fn triangle_count(mode: Mode, corners: usize) -> Option<usize> {
    match mode {
        _ if corners < 3 => None,
        Mode::TriangleStrip | Mode::TriangleFan => Some(corners - 2),
        _ => corners.is_multiple_of(3).then_some(corners / 3),
    }
}

/// The triangles themselves.
fn add_triangles(mode: Mode, corners: &[u32], triangles: &mut Vec<[u32; 3]>) {
    match mode {
        Mode::TriangleStrip => {
            let ordered = |(i, w): (usize, &[u32])| if i % 2 == 0 { [w[0], w[1], w[2]] } else { [w[0], w[2], w[1]] };
            triangles.extend(corners.windows(3).enumerate().map(ordered));
        }
        Mode::TriangleFan => triangles.extend(corners[1..].windows(2).map(|w| [corners[0], w[0], w[1]])),
        _ => triangles.extend_from_slice(corners.as_chunks::<3>().0),
    }
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
    fn long_data_uris_are_read_in_pieces_and_may_be_escaped() {
        // A buffer of more than a piece, with many slashes in base64.
        let mut large = sample();
        large.binary.resize(3 << 20, 0xff);
        // In base64 plus signs.
        large.binary[1 << 20..][2..].as_chunks_mut().0.iter_mut().for_each(|c| *c = [0xfb, 0xef, 0xbe]);
        large.root["buffers"][0]["byteLength"] = large.binary.len().into();
        let (inside, _) = load_bytes("a.glb", large.glb()).unwrap();
        let text = String::from_utf8(large.gltf()).unwrap();
        assert!(text.contains("////") && text.contains("++++"));
        for text in [text.clone(), text.replace('/', "\\/"), text.replace('+', "\\u002B").replace("AA", "\\u0041A")] {
            assert_eq!(load_bytes("a.gltf", text).unwrap().0.meshes(), inside.meshes());
        }
        for broken in ["//=/", "//\\n/", "//\\u2f/", "//\\u00e9"] {
            assert!(refusal("a.gltf", text.replacen("////", broken, 1)).starts_with("buffer 0: "), "{broken}");
        }
        // What stands for a long URI in the parser's text means nothing in a file.
        let mut own = sample();
        own.root["buffers"][0]["uri"] = "data:#0".into();
        assert_eq!(refusal("a.gltf", own.root.to_string()), "buffer 0: a data URI without base64");
    }

    #[test]
    fn extras_may_be_any_json_value() {
        let plain = load_bytes("a.glb", sample().glb()).unwrap().0;
        for extras in [json!(null), json!(7.5), json!("text"), json!([1, [2], {"a": 3}]), json!({"a": [4]}), json!([])]
        {
            let file = changed(|root| {
                let places =
                    ["", "/asset", "/scenes/0", "/nodes/1", "/meshes/0", "/meshes/0/primitives/0", "/materials/0"];
                let more = ["/materials/0/pbrMetallicRoughness", "/accessors/0", "/bufferViews/0", "/buffers/0"];
                let light = ["/extensions/KHR_lights_punctual/lights/0"];
                for place in places.iter().chain(&more).chain(&light) {
                    root.pointer_mut(place).unwrap()["extras"] = extras.clone();
                }
            });
            let (scene, _) = load_bytes("a.glb", file).unwrap_or_else(|e| panic!("{extras}: {e}"));
            assert_eq!((scene.meshes(), scene.lights()), (plain.meshes(), plain.lights()));
        }
    }

    #[test]
    fn primitives_that_share_a_large_vertex_buffer_cost_what_they_use() {
        let mut shared = sample();
        let primitive = shared.root["meshes"][0]["primitives"][0].clone();
        shared.root["meshes"][0]["primitives"] = vec![primitive; 50].into();
        let folder = Folder::new();
        std::fs::write(folder.path("a.glb"), shared.glb()).unwrap();
        let (scene, info) = load_path(&folder.path("a.glb")).unwrap();
        assert_eq!((scene.meshes().len(), info.triangles, info.vertices), (50, 100, 200));
        assert!(scene.meshes().iter().all(|mesh| mesh.positions == scene.meshes()[0].positions));
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
