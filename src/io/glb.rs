//! A scene with its light maps as one GLB file (glTF 2.0, binary), so that any viewer shows it.
//!
//! Each pair of light map page and material is a primitive. Its material is unlit
//! (`KHR_materials_unlit`): `baseColorFactor` is the albedo, `baseColorTexture` the page, read
//! through `TEXCOORD_1`. A viewer multiplies the two, so with pages that hold tone-mapped irradiance
//! E it shows albedo × E × exposure, bent by the shoulder of [`super::image::tone_map`]: what an eye
//! at the surface sees, albedo/π · E, up to a constant, as nothing but diffuse light is baked.
//! Emissive materials are not unlit, since unlit ones do not glow: they carry `emissiveFactor` and
//! `KHR_materials_emissive_strength`. Triangles without a chart show their albedo alone.
//!
//! Pages are embedded as PNG files, row 0 at v = 0, without a flip (see [`super::image`]).
//! `TEXCOORD_0` holds the mesh's first texture coordinates, or zeros. Normals are left out. Triangles
//! that the scene skips (degenerate or not finite) are left out too.

use crate::error::{Error, Result, invalid_argument};
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
}

/// The light maps of a scene.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GlbLightmap {
    /// One per mesh of the scene.
    pub meshes: Vec<GlbMesh>,
    /// One PNG file per page, as [`super::image::encode_png_rgb8`] makes them.
    pub pages: Vec<Vec<u8>>,
}

/// Writes `scene` and its light maps to the file `path`.
pub fn write_glb(path: &Path, scene: &Scene, lightmap: &GlbLightmap) -> Result<()> {
    std::fs::write(path, encode_glb(scene, lightmap)?).map_err(|e| Error::Io(format!("{}: {e}", path.display())))
}

/// The bytes of the file that [`write_glb`] writes.
pub fn encode_glb(scene: &Scene, lightmap: &GlbLightmap) -> Result<Vec<u8>> {
    check(scene, lightmap)?;
    let mut file = File::default();
    for ((page, material), triangles) in group(scene, lightmap) {
        let primitive = Primitive::new(scene, lightmap, &triangles);
        file.add_primitive(&primitive, page, &scene.materials()[material as usize]);
    }
    file.add_pages(&lightmap.pages);
    file.finish()
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
        if let Some(page) = uvs.pages.iter().find(|p| **p != NONE && **p as usize >= page_count) {
            return invalid_argument!("mesh {m} names page {page}, there are {page_count}");
        }
        if let Some(uv) = uvs.corner_uvs.iter().flatten().flatten().find(|uv| !uv.is_finite()) {
            return invalid_argument!("mesh {m} has the light map coordinate {uv}");
        }
    }
    Ok(())
}

/// A triangle by mesh and number in it.
type Triangle = (u32, u32);

/// The valid triangles of each (page, material).
fn group(scene: &Scene, lightmap: &GlbLightmap) -> BTreeMap<(u32, u32), Vec<Triangle>> {
    let mut groups = BTreeMap::<_, Vec<_>>::new();
    for (m, (mesh, uvs)) in scene.meshes().iter().zip(&lightmap.meshes).enumerate() {
        let first = scene.first_triangle(m as u32);
        for t in (0..mesh.indices.len()).filter(|t| scene.is_valid(first + *t as u32)) {
            groups.entry((uvs.pages[t], mesh.material(t))).or_default().push((m as u32, t as u32));
        }
    }
    groups
}

/// Indexed triangles with vertices shared by corners of one position and light map coordinate.
#[derive(Default)]
struct Primitive {
    positions: Vec<Vec3>,
    uvs: Vec<Vec2>,
    lightmap_uvs: Vec<[f32; 2]>,
    indices: Vec<u32>,
}

impl Primitive {
    fn new(scene: &Scene, lightmap: &GlbLightmap, triangles: &[Triangle]) -> Self {
        let mut result = Primitive::default();
        let mut vertex_of = HashMap::<(u32, u32, [u32; 2]), u32>::new();
        for &(m, t) in triangles {
            let mesh = &scene.meshes()[m as usize];
            let corner_uvs = &lightmap.meshes[m as usize].corner_uvs[t as usize];
            for (&v, &lightmap_uv) in mesh.indices[t as usize].iter().zip(corner_uvs) {
                let vertex = *vertex_of.entry((m, v, lightmap_uv.map(f32::to_bits))).or_insert_with(|| {
                    let uv = mesh.uvs.get(v as usize).copied().filter(|uv| uv.is_finite());
                    result.positions.push(mesh.positions[v as usize]);
                    result.uvs.push(uv.unwrap_or_default());
                    result.lightmap_uvs.push(lightmap_uv);
                    result.positions.len() as u32 - 1
                });
                result.indices.push(vertex);
            }
        }
        result
    }
}

// Names of numbers in glTF.
const FLOAT: u32 = 5126;
const UNSIGNED_INT: u32 = 5125;
const ARRAY_BUFFER: u32 = 34962;
const ELEMENT_ARRAY_BUFFER: u32 = 34963;
const LINEAR: u32 = 9729;
const CLAMP_TO_EDGE: u32 = 33071;

/// The file being made.
#[derive(Default)]
struct File {
    binary: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
    primitives: Vec<Value>,
    materials: Vec<Value>,
    images: Vec<Value>,
    textures: Vec<Value>,
    unlit: bool,
    emissive_strength: bool,
}

impl File {
    /// Appends bytes, aligned to 4, as a buffer view.
    fn add_view(&mut self, bytes: impl IntoIterator<Item = u8>, target: Option<u32>) -> usize {
        let offset = self.binary.len();
        self.binary.extend(bytes);
        let mut view = json!({ "buffer": 0, "byteOffset": offset, "byteLength": self.binary.len() - offset });
        if let Some(target) = target {
            view["target"] = target.into();
        }
        self.binary.resize(self.binary.len().next_multiple_of(4), 0);
        self.views.push(view);
        self.views.len() - 1
    }

    fn add_accessor(&mut self, view: usize, component: u32, kind: &str, count: usize) -> usize {
        self.accessors.push(json!({ "bufferView": view, "componentType": component, "type": kind, "count": count }));
        self.accessors.len() - 1
    }

    fn add_floats<const N: usize>(&mut self, vectors: impl ExactSizeIterator<Item = [f32; N]>, kind: &str) -> usize {
        let count = vectors.len();
        let view = self.add_view(vectors.flatten().flat_map(f32::to_le_bytes), Some(ARRAY_BUFFER));
        self.add_accessor(view, FLOAT, kind, count)
    }

    fn add_primitive(&mut self, primitive: &Primitive, page: u32, material: &Material) {
        let positions = self.add_floats(primitive.positions.iter().map(Vec3::to_array), "VEC3");
        let lower = primitive.positions.iter().copied().reduce(Vec3::min).unwrap_or_default();
        let upper = primitive.positions.iter().copied().reduce(Vec3::max).unwrap_or_default();
        self.accessors[positions]["min"] = json!(lower.to_array());
        self.accessors[positions]["max"] = json!(upper.to_array());
        let uvs = self.add_floats(primitive.uvs.iter().map(Vec2::to_array), "VEC2");
        let lightmap_uvs = self.add_floats(primitive.lightmap_uvs.iter().copied(), "VEC2");
        let bytes = primitive.indices.iter().flat_map(|i| i.to_le_bytes());
        let view = self.add_view(bytes, Some(ELEMENT_ARRAY_BUFFER));
        let indices = self.add_accessor(view, UNSIGNED_INT, "SCALAR", primitive.indices.len());
        self.add_material(page, material);
        self.primitives.push(json!({
            "attributes": { "POSITION": positions, "TEXCOORD_0": uvs, "TEXCOORD_1": lightmap_uvs },
            "indices": indices,
            "material": self.materials.len() - 1,
        }));
    }

    fn add_material(&mut self, page: u32, material: &Material) {
        let [r, g, b] = material.albedo;
        let mut result = json!({
            "pbrMetallicRoughness": { "baseColorFactor": [r, g, b, 1.0], "metallicFactor": 0, "roughnessFactor": 1 },
            "doubleSided": material.two_sided,
        });
        if page != NONE {
            result["pbrMetallicRoughness"]["baseColorTexture"] = json!({ "index": page, "texCoord": 1 });
        }
        if material.is_emissive() {
            // Factors end at 1; what is beyond goes into the strength.
            let strength = material.emission.iter().fold(1.0f32, |a, &e| a.max(e));
            result["emissiveFactor"] = json!(material.emission.map(|e| e / strength));
            if strength > 1.0 {
                result["extensions"]["KHR_materials_emissive_strength"]["emissiveStrength"] = strength.into();
                self.emissive_strength = true;
            }
        } else {
            result["extensions"]["KHR_materials_unlit"] = json!({});
            self.unlit = true;
        }
        self.materials.push(result);
    }

    fn add_pages(&mut self, pages: &[Vec<u8>]) {
        for (page, png) in pages.iter().enumerate() {
            let view = self.add_view(png.iter().copied(), None);
            let name = format!("light map page {page}");
            self.images.push(json!({ "bufferView": view, "mimeType": "image/png", "name": name }));
            self.textures.push(json!({ "source": page, "sampler": 0 }));
        }
    }

    fn finish(self) -> Result<Vec<u8>> {
        let mut root = json!({
            "asset": { "version": "2.0", "generator": concat!("bakelite ", env!("CARGO_PKG_VERSION")) },
            "scene": 0,
            "scenes": [{ "nodes": [0] }],
            "nodes": [{ "mesh": 0 }],
            "meshes": [{ "primitives": self.primitives }],
            "materials": self.materials,
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{ "byteLength": self.binary.len() }],
        });
        // glTF allows no empty arrays.
        if !self.images.is_empty() {
            root["images"] = self.images.into();
            root["textures"] = self.textures.into();
            let sampler =
                json!({ "magFilter": LINEAR, "minFilter": LINEAR, "wrapS": CLAMP_TO_EDGE, "wrapT": CLAMP_TO_EDGE });
            root["samplers"] = json!([sampler]);
        }
        let used = [("KHR_materials_unlit", self.unlit), ("KHR_materials_emissive_strength", self.emissive_strength)];
        let used: Vec<_> = used.into_iter().filter(|(_, used)| *used).map(|(name, _)| name).collect();
        if !used.is_empty() {
            root["extensionsUsed"] = json!(used);
        }
        container(root.to_string().into_bytes(), &self.binary)
    }
}

/// The GLB container (glTF 2.0, chapter 4): header, JSON chunk, binary chunk.
fn container(mut json: Vec<u8>, binary: &[u8]) -> Result<Vec<u8>> {
    json.resize(json.len().next_multiple_of(4), b' ');
    let total = 12 + 8 + json.len() + 8 + binary.len();
    let Ok(length) = u32::try_from(total) else {
        return Err(Error::Unsupported(format!("a GLB file of {total} bytes: the format ends at 4 GiB")));
    };
    let mut file = Vec::with_capacity(total);
    file.extend(b"glTF");
    file.extend([2, length].map(u32::to_le_bytes).as_flattened());
    for (kind, chunk) in [(b"JSON", &json[..]), (b"BIN\0", binary)] {
        file.extend((chunk.len() as u32).to_le_bytes());
        file.extend(kind);
        file.extend(chunk);
    }
    Ok(file)
}
