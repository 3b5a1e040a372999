//! A scene with its light maps as one GLB file (glTF 2.0, binary), for viewers and engines.
//!
//! Each pair of light map page and material is a primitive. `TEXCOORD_0` holds the mesh's first texture coordinates,
//! or zeros; `TEXCOORD_1` those of the light map. glTF has no slot for light maps, so it depends on the material where
//! the page goes:
//! - A material without a texture is unlit (`KHR_materials_unlit`): `baseColorFactor` is the albedo,
//!   `baseColorTexture` the page on `TEXCOORD_1`. A viewer multiplies the two, so it shows albedo × E × exposure, bent
//!   by the shoulder of [`super::image::tone_map`]: what an eye at the surface sees, albedo/π · E, up to a constant.
//! - A material with a texture keeps it as `baseColorTexture` on `TEXCOORD_0`, and has the page as `occlusionTexture`
//!   on `TEXCOORD_1`. That is the one slot besides the base colour by which renderers multiply: viewers that light
//!   the scene by an environment (three.js, Babylon.js, model-viewer) dim the texture by the page's red channel.
//!   Importers keep image and coordinates together there: three.js as `aoMap` (to be moved to `lightMap`, for which
//!   it uses the same second coordinates), Blender as image and UV map at the occlusion input, Godot as the ambient
//!   occlusion texture (to be set to the second coordinates). `emissiveTexture`, the other candidate, is added and not
//!   multiplied: it would hide the texture under the light.
//!
//! `extras` of the asset say how pages are encoded, `extras` of each material which texture is its page.
//! Emissive materials are not unlit, since unlit ones do not glow: they carry `emissiveFactor` and
//! `KHR_materials_emissive_strength`. Triangles without a chart show their albedo alone. Triangles both sides of which
//! have places in the light map are written twice, the second time turned round, with one-sided materials.
//!
//! Images are embedded as PNG files, row 0 at v = 0, without a flip (see [`super::image`]). Holes become `alphaMode`
//! `MASK`. Normals are written where meshes bring them. Triangles that the scene skips (degenerate or not finite) are
//! left out.

use super::account::Account;
use super::image::encode_png;
use super::source::Advance;
use crate::error::{Error, Result, invalid_argument};
use crate::files;
use crate::lightmap::Lightmap;
use crate::memory::{try_append, try_collect};
use crate::scene::{Material, NONE, Scene};
use glam::{Vec2, Vec3};
use serde_json::{Value, json};
use std::collections::{BTreeMap, HashMap};
use std::path::Path;

/// Light map coordinates of one mesh.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GlbMesh {
    /// Of the corners of each triangle, in [0, 1].
    pub corner_uvs: Vec<[[f32; 2]; 3]>,
    /// Page of each triangle; [`NONE`]: it has no chart.
    pub pages: Vec<u32>,
    /// Triangles whose backs have places of their own.
    pub backs: Vec<GlbBack>,
}

/// Where the back of a triangle lies in the light map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GlbBack {
    /// Number of the triangle in the mesh.
    pub triangle: u32,
    /// Light map coordinates of its corners, in the order of the front, in [0, 1].
    pub corner_uvs: [[f32; 2]; 3],
    /// Number of the page.
    pub page: u32,
}

impl GlbMesh {
    /// Of a mesh of a light map.
    pub fn of(lightmap: &Lightmap, mesh: u32) -> Result<GlbMesh> {
        let (corner_uvs, pages) = lightmap.mesh_uvs(mesh)?;
        let ((back_uvs, back_pages), own) = lightmap.mesh_back_uvs(mesh)?;
        let back = |t: usize| GlbBack { triangle: t as u32, corner_uvs: back_uvs[t], page: back_pages[t] };
        let backs = try_collect((0..own.len()).filter(|&t| own[t]).map(back), "the backs of a mesh")?;
        Ok(GlbMesh { corner_uvs, pages, backs })
    }
}

/// The light maps of a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct GlbLightmap {
    /// One per mesh of the scene.
    pub meshes: Vec<GlbMesh>,
    /// One PNG file per page, as [`super::image::encode_png_rgb8`] makes them.
    pub pages: Vec<Vec<u8>>,
    /// By which irradiance was multiplied in the pages.
    pub exposure: f32,
}

/// How pages are encoded, for the readers of a file. Constants as in [`super::image::tone_map`].
const ENCODING: &str = "8-bit sRGB. To irradiance in W/m2 (per square unit of length): make c linear; m = max(c.r, c.g, \
                        c.b); if m > 0.6, c = c * (0.6 - 0.4 * ln(1 - (m - 0.6) / 0.4)) / m; irradiance = c / exposure.";

/// Writes `scene` and its light maps to the file `path`, which is replaced as a whole.
pub fn write_glb(path: &Path, scene: &Scene, lightmap: &GlbLightmap) -> Result<()> {
    prepare_glb(path, scene, lightmap, &|_| Ok(()))?.finish()
}

/// The same up to [`finish`](files::Replacement::finish), with reports: `advance` is told of 2 parts, and ends the call
/// by an error.
pub(super) fn prepare_glb(
    path: &Path,
    scene: &Scene,
    lightmap: &GlbLightmap,
    advance: Advance,
) -> Result<files::Replacement> {
    let mut account = Account::new(scene.device().memory())?;
    let (json, binary) = parts(scene, lightmap, &mut account, advance)?;
    let headers = headers(&json, &binary)?;
    advance(1)?;
    let new = files::prepare(path, |file| {
        for part in [&headers[0][..], &json, &headers[1], &binary] {
            file.append(part, |_| advance(0))?;
        }
        Ok(())
    })?;
    advance(1)?;
    Ok(new)
}

/// The bytes of the file that [`write_glb`] writes.
pub fn encode_glb(scene: &Scene, lightmap: &GlbLightmap) -> Result<Vec<u8>> {
    let mut account = Account::new(scene.device().memory())?;
    let (json, binary) = parts(scene, lightmap, &mut account, &|_| Ok(()))?;
    let headers = headers(&json, &binary)?;
    let mut file = Vec::new();
    for part in [&headers[0][..], &json, &headers[1], &binary] {
        try_append(&mut file, part, "the GLB file")?;
    }
    Ok(file)
}

/// The two chunks of the file, without their headers.
fn parts(scene: &Scene, lightmap: &GlbLightmap, account: &mut Account, advance: Advance) -> Result<(Vec<u8>, Vec<u8>)> {
    check(scene, lightmap)?;
    let mut file =
        File { account, binary: Vec::new(), parts: Parts::default(), unlit: false, emissive_strength: false };
    for (key, triangles) in group(scene, lightmap, file.account)? {
        advance(0)?;
        let primitive = Primitive::new(scene, &triangles, key.normals, file.account, advance)?;
        let material = scene.materials()[key.material as usize];
        let material = Material { two_sided: material.two_sided && !key.one_sided, ..material };
        let textures = lightmap.pages.len();
        file.add_primitive(&primitive, key.page, &material, textures)?;
    }
    for (page, png) in lightmap.pages.iter().enumerate() {
        file.add_image(png, &format!("light map page {page}"), LIGHTMAP_SAMPLER)?;
    }
    for number in std::mem::take(&mut file.parts.own_textures) {
        advance(0)?;
        let texture = &scene.textures()[number as usize];
        file.account.hold(2 * texture.bytes(), "an image")?;
        let png = encode_png(texture.width, texture.height, &texture.rgba8, png::ColorType::Rgba, advance)?;
        file.account.give_back(2 * texture.bytes());
        file.add_image(&png, &format!("texture {number}"), TEXTURE_SAMPLER)?;
    }
    let exposure = lightmap.exposure;
    Ok((file.json(exposure), file.binary))
}

fn check(scene: &Scene, lightmap: &GlbLightmap) -> Result<()> {
    let meshes = scene.meshes();
    if lightmap.meshes.len() != meshes.len() {
        return invalid_argument!("light map UVs of {} meshes for {}", lightmap.meshes.len(), meshes.len());
    }
    let page_count = lightmap.pages.len();
    for (m, (uvs, mesh)) in lightmap.meshes.iter().zip(meshes).enumerate() {
        let triangles = mesh.indices.len();
        if uvs.corner_uvs.len() != triangles || uvs.pages.len() != triangles {
            let (corners, pages) = (uvs.corner_uvs.len(), uvs.pages.len());
            return invalid_argument!("mesh {m} has {triangles} triangles, {corners} light map UVs, {pages} pages");
        }
        if let Some(back) = uvs.backs.iter().find(|b| b.triangle as usize >= triangles) {
            return invalid_argument!("mesh {m} has {triangles} triangles, and a back of number {}", back.triangle);
        }
        let pages = || uvs.pages.iter().filter(|p| **p != NONE).chain(uvs.backs.iter().map(|b| &b.page));
        if let Some(page) = pages().find(|p| **p as usize >= page_count) {
            return invalid_argument!("mesh {m} names page {page}, there are {page_count}");
        }
        let all = || uvs.corner_uvs.iter().chain(uvs.backs.iter().map(|b| &b.corner_uvs)).flatten().flatten();
        if let Some(uv) = all().find(|uv| !uv.is_finite()) {
            return invalid_argument!("mesh {m} has the light map coordinate {uv}");
        }
    }
    Ok(())
}

/// A side of a triangle to write.
struct Triangle {
    mesh: u32,
    /// Vertices and light map coordinates of its corners, in the order in which the side is a front.
    vertices: [u32; 3],
    corner_uvs: [[f32; 2]; 3],
    is_back: bool,
}

/// What the triangles of a primitive have in common.
#[derive(Clone, Copy, Eq, Ord, PartialEq, PartialOrd)]
struct Key {
    page: u32,
    material: u32,
    /// Whether this side alone is to be shown.
    one_sided: bool,
    /// Whether the meshes bring normals.
    normals: bool,
}

/// The valid triangles of each primitive.
fn group(scene: &Scene, lightmap: &GlbLightmap, account: &mut Account) -> Result<BTreeMap<Key, Vec<Triangle>>> {
    let mut groups = BTreeMap::<Key, Vec<_>>::new();
    for (m, (mesh, uvs)) in (0..).zip(scene.meshes().iter().zip(&lightmap.meshes)) {
        let first = scene.first_triangle(m);
        let mut backs = uvs.backs.iter().peekable();
        for t in 0..mesh.indices.len() {
            let back = backs.next_if(|back| back.triangle as usize == t);
            if !scene.is_valid(first + t as u32) {
                continue;
            }
            let vertices = mesh.indices[t];
            let mut add = |page, vertices, corner_uvs, is_back| {
                let (material, normals) = (mesh.material(t), !mesh.normals.is_empty());
                let key = Key { page, material, one_sided: back.is_some(), normals };
                let triangle = Triangle { mesh: m, vertices, corner_uvs, is_back };
                account.push(groups.entry(key).or_default(), triangle, "the triangles")
            };
            add(uvs.pages[t], vertices, uvs.corner_uvs[t], false)?;
            if let Some(back) = back {
                let turn = [0, 2, 1];
                add(back.page, turn.map(|i| vertices[i]), turn.map(|i| back.corner_uvs[i]), true)?;
            }
        }
    }
    Ok(groups)
}

/// Indexed triangles with vertices shared by corners of one position and light map coordinate.
#[derive(Default)]
struct Primitive {
    positions: Vec<Vec3>,
    /// Empty if there are none.
    normals: Vec<Vec3>,
    uvs: Vec<Vec2>,
    lightmap_uvs: Vec<[f32; 2]>,
    indices: Vec<u32>,
}

impl Primitive {
    fn new(
        scene: &Scene,
        triangles: &[Triangle],
        normals: bool,
        account: &mut Account,
        advance: Advance,
    ) -> Result<Self> {
        let mut result = Primitive { indices: account.list(3 * triangles.len(), "the corners")?, ..Default::default() };
        let mut vertex_of = HashMap::<(u32, u32, [u32; 2], bool), u32>::new();
        for (i, t) in triangles.iter().enumerate() {
            if i.is_multiple_of(1 << 14) {
                advance(0)?;
            }
            let mesh = &scene.meshes()[t.mesh as usize];
            for (&v, &lightmap_uv) in t.vertices.iter().zip(&t.corner_uvs) {
                let key = (t.mesh, v, lightmap_uv.map(f32::to_bits), t.is_back);
                if let Some(vertex) = vertex_of.get(&key) {
                    result.indices.push(*vertex);
                    continue;
                }
                let vertex = result.positions.len() as u32;
                account.make_room_in_map(&mut vertex_of, "the vertices")?;
                vertex_of.insert(key, vertex);
                account.push(&mut result.positions, mesh.positions[v as usize], "the vertices")?;
                if normals {
                    let normal = mesh.normals[v as usize].normalize_or(Vec3::Y);
                    let normal = if t.is_back { -normal } else { normal };
                    account.push(&mut result.normals, normal, "the normals")?;
                }
                let uv = mesh.uvs.get(v as usize).copied().filter(|uv| uv.is_finite()).unwrap_or_default();
                account.push(&mut result.uvs, uv, "the texture coordinates")?;
                account.push(&mut result.lightmap_uvs, lightmap_uv, "the texture coordinates")?;
                result.indices.push(vertex);
            }
        }
        Ok(result)
    }
}

// Names of numbers in glTF.
const FLOAT: u32 = 5126;
const UNSIGNED_INT: u32 = 5125;
const ARRAY_BUFFER: u32 = 34962;
const ELEMENT_ARRAY_BUFFER: u32 = 34963;
const LINEAR: u32 = 9729;
const CLAMP_TO_EDGE: u32 = 33071;
const REPEAT: u32 = 10497;
const LIGHTMAP_SAMPLER: usize = 0;
const TEXTURE_SAMPLER: usize = 1;

/// The file being made.
struct File<'a> {
    account: &'a mut Account,
    binary: Vec<u8>,
    parts: Parts,
    unlit: bool,
    emissive_strength: bool,
}

/// Arrays of the JSON.
#[derive(Default)]
struct Parts {
    views: Vec<Value>,
    accessors: Vec<Value>,
    primitives: Vec<Value>,
    materials: Vec<Value>,
    images: Vec<Value>,
    textures: Vec<Value>,
    /// The scene's textures that materials use, in the order in which they follow the pages.
    own_textures: Vec<u32>,
}

impl File<'_> {
    /// Appends values as bytes, aligned to 4, as a buffer view.
    fn add_view(&mut self, bytes: &[u8], target: Option<u32>) -> Result<usize> {
        let offset = self.binary.len();
        let end = (offset + bytes.len()).next_multiple_of(4);
        self.account.make_room(&mut self.binary, end - offset, "the GLB file")?;
        self.binary.extend_from_slice(bytes);
        self.binary.resize(end, 0);
        let mut view = json!({ "buffer": 0, "byteOffset": offset, "byteLength": bytes.len() });
        if let Some(target) = target {
            view["target"] = target.into();
        }
        self.parts.views.push(view);
        Ok(self.parts.views.len() - 1)
    }

    fn add_accessor(&mut self, view: usize, component: u32, kind: &str, count: usize) -> usize {
        let accessor = json!({ "bufferView": view, "componentType": component, "type": kind, "count": count });
        self.parts.accessors.push(accessor);
        self.parts.accessors.len() - 1
    }

    fn add_floats<T: bytemuck::NoUninit>(&mut self, vectors: &[T], kind: &str) -> Result<usize> {
        let view = self.add_view(&little_endian(vectors), Some(ARRAY_BUFFER))?;
        Ok(self.add_accessor(view, FLOAT, kind, vectors.len()))
    }

    fn add_primitive(&mut self, primitive: &Primitive, page: u32, material: &Material, pages: usize) -> Result<()> {
        let positions = self.add_floats(&primitive.positions, "VEC3")?;
        let lower = primitive.positions.iter().copied().reduce(Vec3::min).unwrap_or_default();
        let upper = primitive.positions.iter().copied().reduce(Vec3::max).unwrap_or_default();
        self.parts.accessors[positions]["min"] = json!(lower.to_array());
        self.parts.accessors[positions]["max"] = json!(upper.to_array());
        let uvs = self.add_floats(&primitive.uvs, "VEC2")?;
        let lightmap_uvs = self.add_floats(&primitive.lightmap_uvs, "VEC2")?;
        let mut attributes = json!({ "POSITION": positions, "TEXCOORD_0": uvs, "TEXCOORD_1": lightmap_uvs });
        if !primitive.normals.is_empty() {
            attributes["NORMAL"] = self.add_floats(&primitive.normals, "VEC3")?.into();
        }
        let view = self.add_view(&little_endian(&primitive.indices), Some(ELEMENT_ARRAY_BUFFER))?;
        let indices = self.add_accessor(view, UNSIGNED_INT, "SCALAR", primitive.indices.len());
        self.add_material(page, material, pages);
        let material = self.parts.materials.len() - 1;
        self.parts.primitives.push(json!({ "attributes": attributes, "indices": indices, "material": material }));
        Ok(())
    }

    /// `pages`: how many textures are light map pages.
    fn add_material(&mut self, page: u32, material: &Material, pages: usize) {
        let [r, g, b] = material.albedo;
        let mut result = json!({
            "pbrMetallicRoughness": { "baseColorFactor": [r, g, b, 1.0], "metallicFactor": 0, "roughnessFactor": 1 },
            "doubleSided": material.two_sided,
        });
        let is_textured = material.albedo_texture != NONE;
        if is_textured {
            let texture = pages + self.own_texture(material.albedo_texture);
            result["pbrMetallicRoughness"]["baseColorTexture"] = json!({ "index": texture, "texCoord": 0 });
            if material.alpha_cutoff > 0.0 {
                result["alphaMode"] = "MASK".into();
                result["alphaCutoff"] = material.alpha_cutoff.into();
            }
        }
        if page != NONE {
            let lightmap = json!({ "index": page, "texCoord": 1 });
            let slot = if is_textured { "occlusionTexture" } else { "baseColorTexture" };
            match is_textured {
                true => result[slot] = lightmap.clone(),
                false => result["pbrMetallicRoughness"][slot] = lightmap.clone(),
            }
            result["extras"]["lightmap"] = lightmap;
            result["extras"]["lightmap"]["slot"] = slot.into();
        }
        if material.is_emissive() {
            // Factors end at 1; what is beyond goes into the strength.
            let strength = material.emission.iter().fold(1.0f32, |a, &e| a.max(e));
            result["emissiveFactor"] = json!(material.emission.map(|e| e / strength));
            if strength > 1.0 {
                result["extensions"]["KHR_materials_emissive_strength"]["emissiveStrength"] = strength.into();
                self.emissive_strength = true;
            }
        } else if !is_textured || page == NONE {
            result["extensions"]["KHR_materials_unlit"] = json!({});
            self.unlit = true;
        }
        self.parts.materials.push(result);
    }

    /// The place of a texture of the scene among those that are used.
    fn own_texture(&mut self, number: u32) -> usize {
        let own = &mut self.parts.own_textures;
        own.iter().position(|n| *n == number).unwrap_or_else(|| {
            own.push(number);
            own.len() - 1
        })
    }

    fn add_image(&mut self, png: &[u8], name: &str, sampler: usize) -> Result<()> {
        let view = self.add_view(png, None)?;
        let source = self.parts.images.len();
        self.parts.images.push(json!({ "bufferView": view, "mimeType": "image/png", "name": name }));
        self.parts.textures.push(json!({ "source": source, "sampler": sampler }));
        Ok(())
    }

    /// The JSON chunk, padded.
    fn json(&mut self, exposure: f32) -> Vec<u8> {
        let parts = std::mem::take(&mut self.parts);
        let mut root = json!({
            "asset": {
                "version": "2.0",
                "generator": concat!("bakelite ", env!("CARGO_PKG_VERSION")),
                "extras": { "lightmap": { "texCoord": 1, "exposure": exposure, "encoding": ENCODING } },
            },
            "scene": 0,
            "scenes": [{ "nodes": [0] }],
            "nodes": [{ "mesh": 0 }],
            "meshes": [{ "primitives": parts.primitives }],
            "materials": parts.materials,
            "accessors": parts.accessors,
            "bufferViews": parts.views,
            "buffers": [{ "byteLength": self.binary.len() }],
        });
        // glTF allows no empty arrays.
        if !parts.images.is_empty() {
            root["images"] = parts.images.into();
            root["textures"] = parts.textures.into();
            let sampler = |wrap: u32| json!({ "magFilter": LINEAR, "minFilter": LINEAR, "wrapS": wrap, "wrapT": wrap });
            root["samplers"] = json!([sampler(CLAMP_TO_EDGE), sampler(REPEAT)]);
        }
        let used = [("KHR_materials_unlit", self.unlit), ("KHR_materials_emissive_strength", self.emissive_strength)];
        let used: Vec<_> = used.into_iter().filter(|(_, used)| *used).map(|(name, _)| name).collect();
        if !used.is_empty() {
            root["extensionsUsed"] = json!(used);
        }
        let mut json = root.to_string().into_bytes();
        json.resize(json.len().next_multiple_of(4), b' ');
        json
    }
}

/// Values as the file has them.
#[cfg(target_endian = "little")]
fn little_endian<T: bytemuck::NoUninit>(values: &[T]) -> std::borrow::Cow<'_, [u8]> {
    bytemuck::cast_slice(values).into()
}

/// Values as the file has them: all are of 4 bytes.
#[cfg(target_endian = "big")]
fn little_endian<T: bytemuck::NoUninit>(values: &[T]) -> std::borrow::Cow<'_, [u8]> {
    let mut bytes: Vec<u8> = bytemuck::cast_slice(values).to_vec();
    bytes.as_chunks_mut::<4>().0.iter_mut().for_each(|b| b.reverse());
    bytes.into()
}

/// What comes before each chunk of the GLB container (glTF 2.0, chapter 4).
fn headers(json: &[u8], binary: &[u8]) -> Result<[Vec<u8>; 2]> {
    let total = 12 + 8 + json.len() + 8 + binary.len();
    let Ok(length) = u32::try_from(total) else {
        return Err(Error::Unsupported(format!("a GLB file of {total} bytes: the format ends at 4 GiB")));
    };
    let chunk = |kind: &[u8], size: usize| [&(size as u32).to_le_bytes(), kind].concat();
    let first = [&b"glTF\x02\0\0\0"[..], &length.to_le_bytes(), &chunk(b"JSON", json.len())].concat();
    Ok([first, chunk(b"BIN\0", binary.len())])
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::image::encode_png_rgb8;
    use super::*;
    use crate::io::tests::{albedos, corners, load_bytes};

    use crate::scene::{Mesh, MeshMaterials, SceneData, Texture};
    use std::sync::Arc;

    const PAGE_COLORS: [[u8; 3]; 2] = [[200, 100, 50], [10, 20, 30]];

    /// Two meshes on two pages: a quad with two materials, and a lamp, a degenerate triangle and one
    /// without a chart.
    fn scene_and_lightmap() -> (Arc<Scene>, GlbLightmap) {
        let mut data = SceneData::new();
        for (albedo, emission, two_sided) in
            [([0.1, 0.2, 0.3], [0.0; 3], false), ([0.4; 3], [0.0; 3], true), ([0.5; 3], [10.0, 5.0, 0.0], false)]
        {
            data.add_material(Material { albedo, emission, two_sided, ..Default::default() }).unwrap();
        }
        let positions: Vec<Vec3> =
            (0..4).map(|i| Vec3::new((i & 1) as f32 * 1.1, (i >> 1) as f32 * 0.7, -0.3)).collect();
        data.add_mesh(Mesh {
            uvs: positions.iter().map(|p| p.truncate() * 3.0).collect(),
            positions: positions.clone(),
            indices: vec![[0, 1, 2], [1, 3, 2], [1, 3, 2]],
            materials: MeshMaterials::PerTriangle(vec![0, 0, 1]),
            ..Default::default()
        })
        .unwrap();
        data.add_mesh(Mesh {
            positions: positions.iter().map(|p| *p + Vec3::Z).collect(),
            indices: vec![[0, 1, 2], [1, 1, 2], [1, 3, 2]],
            materials: MeshMaterials::PerTriangle(vec![2, 0, 0]),
            ..Default::default()
        })
        .unwrap();
        let scene = data.committed();

        let low = [[0.0, 0.0], [0.5, 0.0], [0.0, 0.5]];
        let high = [[0.5, 0.0], [0.5, 0.5], [0.0, 0.5]];
        let seam = [[0.9, 0.0], [0.5, 0.5], [0.0, 0.5]];
        let pages = PAGE_COLORS.map(|color| encode_png_rgb8(2, 2, &[color; 4]).unwrap()).to_vec();
        let meshes = vec![
            GlbMesh { corner_uvs: vec![low, high, high], pages: vec![0, 0, 1], backs: Vec::new() },
            GlbMesh { corner_uvs: vec![low, low, seam], pages: vec![1, NONE, NONE], backs: Vec::new() },
        ];
        (scene, GlbLightmap { meshes, pages, exposure: 0.25 })
    }

    pub fn sample() -> Vec<u8> {
        let (scene, lightmap) = scene_and_lightmap();
        encode_glb(&scene, &lightmap).unwrap()
    }

    fn floats<const N: usize>(binary: &[u8], accessor: &gltf::Accessor) -> Vec<[f32; N]> {
        let view = accessor.view().unwrap();
        let bytes = &binary[view.offset()..view.offset() + view.length()];
        let values: Vec<f32> = bytes.chunks(4).map(|c| f32::from_le_bytes(c.try_into().unwrap())).collect();
        assert_eq!(values.len(), accessor.count() * N);
        values.as_chunks().0.to_vec()
    }

    #[test]
    fn the_file_is_a_valid_container() {
        let file = sample();
        let word = |i: usize| u32::from_le_bytes(file[i..i + 4].try_into().unwrap()) as usize;
        assert_eq!((word(8), file.len() % 4), (file.len(), 0));
        let json_length = word(12);
        assert_eq!((json_length % 4, word(20 + json_length) % 4), (0, 0));
        assert_eq!(file.len(), 28 + json_length + word(20 + json_length));
    }

    #[test]
    fn accessors_are_aligned_and_say_their_true_bounds() {
        let parsed = gltf::Gltf::from_slice(&sample()).unwrap();
        let binary = parsed.blob.as_deref().unwrap();
        for accessor in parsed.accessors() {
            let view = accessor.view().unwrap();
            assert_eq!((view.offset() % 4, accessor.offset()), (0, 0));
            assert_eq!(view.length(), accessor.count() * accessor.size());
        }
        for view in parsed.views() {
            assert!(view.offset() + view.length() <= binary.len());
        }
        for primitive in parsed.meshes().flat_map(|m| m.primitives()) {
            let accessor = primitive.get(&gltf::Semantic::Positions).unwrap();
            let positions: Vec<Vec3> = floats::<3>(binary, &accessor).into_iter().map(Vec3::from).collect();
            let lower = positions.iter().copied().reduce(Vec3::min).unwrap();
            let upper = positions.iter().copied().reduce(Vec3::max).unwrap();
            assert_eq!(accessor.min().unwrap(), json!(lower.to_array()));
            assert_eq!(accessor.max().unwrap(), json!(upper.to_array()));
            for set in [0, 1] {
                let uvs = primitive.get(&gltf::Semantic::TexCoords(set)).unwrap();
                assert_eq!(uvs.count(), positions.len());
            }
        }
    }

    #[test]
    fn there_is_a_primitive_per_page_and_material() {
        let parsed = gltf::Gltf::from_slice(&sample()).unwrap();
        let primitives: Vec<_> = parsed.meshes().flat_map(|m| m.primitives()).collect();
        let found: Vec<_> = primitives
            .iter()
            .map(|p| {
                let pbr = p.material().pbr_metallic_roughness();
                let texture = pbr.base_color_texture().map(|t| (t.texture().index(), t.tex_coord()));
                let vertices = p.get(&gltf::Semantic::Positions).unwrap().count();
                (texture, pbr.base_color_factor()[0], p.indices().unwrap().count(), vertices)
            })
            .collect();
        // The quad's triangles share two vertices; the degenerate triangle is gone.
        let expected =
            [(Some((0, 1)), 0.1, 6, 4), (Some((1, 1)), 0.4, 3, 3), (Some((1, 1)), 0.5, 3, 3), (None, 0.1, 3, 3)];
        assert_eq!(found, expected);
        let materials: Vec<_> = primitives.iter().map(|p| p.material()).collect();
        assert_eq!([0, 1, 2, 3].map(|i| materials[i].unlit()), [true, true, false, true]);
        assert_eq!([0, 1, 2, 3].map(|i| materials[i].double_sided()), [false, true, false, false]);
        assert_eq!((materials[2].emissive_factor(), materials[2].emissive_strength()), ([1.0, 0.5, 0.0], Some(10.0)));
    }

    #[test]
    fn a_triangle_with_a_place_for_its_back_is_written_twice_and_one_sided() {
        let (scene, mut lightmap) = scene_and_lightmap();
        // The only two-sided triangle.
        let (triangle, corner_uvs) = (2, [[0.5, 0.25], [0.75, 0.25], [0.75, 0.5]]);
        lightmap.meshes[0].backs = vec![GlbBack { triangle, corner_uvs, page: 0 }];
        let file = encode_glb(&scene, &lightmap).unwrap();
        let parsed = gltf::Gltf::from_slice(&file).unwrap();
        let materials: Vec<_> = parsed
            .meshes()
            .flat_map(|m| m.primitives())
            .map(|p| (p.material().double_sided(), p.material().pbr_metallic_roughness().base_color_factor()[0]))
            .collect();
        assert_eq!(materials, [(false, 0.1), (false, 0.4), (false, 0.4), (false, 0.5), (false, 0.1)]);
        let (back, _) = load_bytes("a.glb", file).unwrap();
        let [a, b, c] = scene.meshes()[0].corners(2);
        assert_eq!([corners(&back)[2], corners(&back)[3]], [[a, c, b], [a, b, c]]);
        let mesh = &back.meshes()[1];
        let light = mesh.lightmap.as_ref().unwrap();
        let [a, b, c] = corner_uvs;
        assert_eq!(mesh.indices[0].map(|v| light.uvs[v as usize].to_array()), [a, c, b]);
    }

    /// One triangle, its back with a place of its own, with normals and a texture with holes.
    fn textured() -> (Arc<Scene>, GlbLightmap) {
        let mut data = SceneData::new();
        data.add_texture(Texture { width: 1, height: 1, rgba8: vec![[9; 4]] }).unwrap();
        let texels = vec![[255, 0, 0, 255], [0, 255, 0, 0]];
        let albedo_texture = data.add_texture(Texture { width: 2, height: 1, rgba8: texels }).unwrap();
        let material = Material { albedo: [0.5; 3], albedo_texture, alpha_cutoff: 0.25, ..Default::default() };
        data.add_material(Material { two_sided: true, ..material }).unwrap();
        data.add_mesh(Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y],
            indices: vec![[0, 1, 2]],
            normals: vec![Vec3::new(0.0, 0.6, 0.8); 3],
            uvs: vec![Vec2::ZERO, Vec2::new(7.0, 0.0), Vec2::new(0.0, -3.0)],
            ..Default::default()
        })
        .unwrap();
        let corner_uvs = [[0.1, 0.2], [0.3, 0.2], [0.1, 0.4]];
        let backs = vec![GlbBack { triangle: 0, corner_uvs, page: 1 }];
        let meshes = vec![GlbMesh { corner_uvs: vec![corner_uvs], pages: vec![0], backs }];
        let pages = PAGE_COLORS.map(|color| encode_png_rgb8(2, 2, &[color; 4]).unwrap()).to_vec();
        (data.committed(), GlbLightmap { meshes, pages, exposure: 0.25 })
    }

    #[test]
    fn a_material_keeps_its_own_texture_and_has_the_light_map_on_the_second_coordinates() {
        let (scene, lightmap) = textured();
        let file = encode_glb(&scene, &lightmap).unwrap();
        let parsed = gltf::Gltf::from_slice(&file).unwrap();
        let materials: Vec<_> = parsed.materials().collect();
        assert_eq!(materials.len(), 2);
        for (page, material) in materials.iter().enumerate() {
            let base = material.pbr_metallic_roughness().base_color_texture().unwrap();
            assert_eq!((base.texture().index(), base.tex_coord()), (2, 0));
            assert_eq!(material.pbr_metallic_roughness().base_color_factor(), [0.5, 0.5, 0.5, 1.0]);
            let light = material.occlusion_texture().unwrap();
            assert_eq!((light.texture().index(), light.tex_coord()), (page, 1));
            assert_eq!((material.unlit(), material.double_sided()), (false, false));
            assert_eq!((material.alpha_mode(), material.alpha_cutoff()), (gltf::material::AlphaMode::Mask, Some(0.25)));
            assert_eq!(base.texture().sampler().wrap_s(), gltf::texture::WrappingMode::Repeat);
            assert_eq!(light.texture().sampler().wrap_s(), gltf::texture::WrappingMode::ClampToEdge);
        }
        // Read back: own texture, light map page and coordinates.
        let (back, info) = load_bytes("a.glb", file).unwrap();
        assert_eq!((info.warnings.len(), back.textures().len()), (0, 1));
        assert_eq!(*back.textures()[0], *scene.textures()[1]);
        let [front, behind] = back.meshes() else { panic!() };
        let pages = [front, behind].map(|m| m.lightmap.as_ref().unwrap().pages.first().copied().unwrap_or(0));
        assert_eq!(pages, [0, 1]);
        assert_eq!(front.uvs[1], Vec2::new(7.0, 0.0));
    }

    #[test]
    fn the_copy_for_a_back_is_turned_round_with_its_normals() {
        let (scene, lightmap) = textured();
        let (back, _) = load_bytes("a.glb", encode_glb(&scene, &lightmap).unwrap()).unwrap();
        let given = Vec3::new(0.0, 0.6, 0.8);
        for (mesh, sign) in back.meshes().iter().zip([1.0, -1.0]) {
            let [a, b, c] = mesh.corners(0);
            assert_eq!((b - a).cross(c - a), sign * Vec3::Z);
            assert!(mesh.normals.iter().all(|n| n.abs_diff_eq(given * sign, 1e-6)), "{:?}", mesh.normals);
        }
    }

    /// What `extras` say of the encoding, in code.
    fn irradiance(exposure: f64, texel: [u8; 3]) -> [f64; 3] {
        let linear = |c: u8| {
            let c = f64::from(c) / 255.0;
            if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }
        };
        let c = texel.map(linear);
        let m = c[0].max(c[1]).max(c[2]);
        let scale = if m > 0.6 { (0.6 - 0.4 * (1.0 - (m - 0.6) / 0.4).ln()) / m } else { 1.0 };
        c.map(|c| c * scale / exposure)
    }

    #[test]
    fn the_extras_say_how_to_read_irradiance_from_a_page() {
        let (scene, lightmap) = textured();
        let file = encode_glb(&scene, &lightmap).unwrap();
        let length = u32::from_le_bytes(file[12..16].try_into().unwrap()) as usize;
        let root: Value = serde_json::from_slice(&file[20..20 + length]).unwrap();
        let said = &root["asset"]["extras"]["lightmap"];
        assert_eq!((said["exposure"].as_f64(), said["texCoord"].as_u64()), (Some(0.25), Some(1)));
        assert!(said["encoding"].as_str().unwrap().contains("0.6 - 0.4 * ln(1 - (m - 0.6) / 0.4)"));
        let slots: Vec<_> = root["materials"].as_array().unwrap().iter().map(|m| &m["extras"]["lightmap"]).collect();
        assert_eq!(
            slots,
            [
                &json!({ "index": 0, "texCoord": 1, "slot": "occlusionTexture" }),
                &json!({ "index": 1, "texCoord": 1, "slot": "occlusionTexture" })
            ]
        );
        // As it says: irradiance up to four times white comes back within the steps of 8 bits.
        for e in [[0.1, 0.2, 0.3], [2.0, 1.0, 0.5], [3.0, 4.0, 2.0], [6.0, 1.0, 0.0]] {
            let read = irradiance(0.25, crate::io::image::tone_map(0.25, e));
            for (read, e) in read.into_iter().zip(e) {
                assert!((read - f64::from(e)).abs() < 0.02 * f64::from(e) + 0.01, "{e}: {read}");
            }
        }
    }

    #[test]
    fn pages_are_embedded_as_png() {
        let parsed = gltf::Gltf::from_slice(&sample()).unwrap();
        let binary = parsed.blob.as_deref().unwrap();
        for (texture, color) in parsed.textures().zip(PAGE_COLORS) {
            let gltf::image::Source::View { view, mime_type } = texture.source().source() else { panic!() };
            assert_eq!(mime_type, "image/png");
            let png = &binary[view.offset()..view.offset() + view.length()];
            let image = ::image::load_from_memory(png).unwrap().into_rgb8();
            assert_eq!((image.dimensions(), image.get_pixel(1, 1).0), ((2, 2), color));
        }
        assert_eq!(parsed.textures().len(), 2);
    }

    #[test]
    fn what_was_written_reads_back() {
        let (scene, lightmap) = scene_and_lightmap();
        let (back, info) = load_bytes("a.glb", encode_glb(&scene, &lightmap).unwrap()).unwrap();
        let given = |m: usize, t: usize| scene.meshes()[m].corners(t);
        assert_eq!(corners(&back), [given(0, 0), given(0, 1), given(0, 2), given(1, 0), given(1, 2)]);
        assert_eq!(albedos(&back), [[0.1, 0.2, 0.3], [0.1, 0.2, 0.3], [0.4; 3], [0.5; 3], [0.1, 0.2, 0.3]]);
        let mesh = &back.meshes()[0];
        let lightmap_of = |mesh: &Mesh, t: usize| {
            let l = mesh.lightmap.as_ref().unwrap();
            mesh.indices[t].map(|v| l.uvs[v as usize].to_array())
        };
        assert_eq!(
            [0, 1].map(|t| lightmap_of(mesh, t)),
            [lightmap.meshes[0].corner_uvs[0], lightmap.meshes[0].corner_uvs[1]]
        );
        assert_eq!(mesh.uvs[mesh.indices[0][1] as usize], Vec2::new(1.1, 0.0) * 3.0);
        let pages: Vec<_> = back.meshes().iter().map(|m| m.lightmap.as_ref().unwrap().pages.first().copied()).collect();
        assert_eq!(pages, [None, Some(1), Some(1), None]);
        assert!(info.warnings.is_empty());
    }

    #[test]
    fn a_seam_in_the_light_map_splits_vertices() {
        let (scene, mut lightmap) = scene_and_lightmap();
        let count = |lightmap: &GlbLightmap| {
            let file = encode_glb(&scene, lightmap).unwrap();
            gltf::Gltf::from_slice(&file).unwrap().accessors().next().unwrap().count()
        };
        assert_eq!(count(&lightmap), 4);
        lightmap.meshes[0].corner_uvs[1][0] = [0.6, 0.0];
        assert_eq!(count(&lightmap), 5);
    }

    #[test]
    fn light_maps_of_other_scenes_are_refused() {
        let (scene, lightmap) = scene_and_lightmap();
        let message = |change: fn(&mut GlbLightmap)| {
            let mut lightmap = lightmap.clone();
            change(&mut lightmap);
            encode_glb(&scene, &lightmap).unwrap_err().to_string()
        };
        let pop = message(|l| drop(l.meshes.pop()));
        assert_eq!(pop, "invalid argument: light map UVs of 1 meshes for 2");
        assert!(message(|l| _ = l.meshes[1].pages.pop()).contains("mesh 1 has 3 triangles"));
        assert!(message(|l| l.meshes[0].pages[2] = 2).contains("mesh 0 names page 2, there are 2"));
        fn back(triangle: u32, page: u32, u: f32) -> Vec<GlbBack> {
            vec![GlbBack { triangle, corner_uvs: [[u; 2]; 3], page }]
        }
        assert!(message(|l| l.meshes[0].backs = back(2, 7, 0.0)).contains("mesh 0 names page 7, there are 2"));
        assert!(message(|l| l.meshes[0].backs = back(3, 0, 0.0)).contains("a back of number 3"));
        assert!(message(|l| l.meshes[0].backs = back(2, 0, f32::INFINITY)).contains("inf"));
        assert!(message(|l| l.meshes[0].corner_uvs[2][1][0] = f32::NAN).contains("NaN"));
    }
}
