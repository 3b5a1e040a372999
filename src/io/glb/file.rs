//! The JSON and the binary chunk of the file.

use super::primitives::Primitive;
use crate::base::error::Result;
use crate::io::account::Account;
use crate::scene::{Material, NONE};
use glam::Vec3;
use serde_json::{Value, json};

/// Description of the encoding of pages, for the readers of a file. The constants are those of
/// [`super::image::tone_map`].
const ENCODING: &str = "8-bit sRGB. To irradiance in W/m2 (per square unit of length): make c linear; m = max(c.r, c.g, \
                        c.b); if m > 0.6, c = c * (0.6 - 0.4 * ln(1 - (m - 0.6) / 0.4)) / m; irradiance = c / exposure.";

// Names of numbers in glTF.
const FLOAT: u32 = 5126;
const UNSIGNED_INT: u32 = 5125;
const ARRAY_BUFFER: u32 = 34962;
const ELEMENT_ARRAY_BUFFER: u32 = 34963;
const LINEAR: u32 = 9729;
const CLAMP_TO_EDGE: u32 = 33071;
const REPEAT: u32 = 10497;
pub(super) const LIGHTMAP_SAMPLER: usize = 0;
pub(super) const TEXTURE_SAMPLER: usize = 1;

/// The file being made.
pub(super) struct File<'a> {
    pub account: &'a mut Account,
    pub binary: Vec<u8>,
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

impl<'a> File<'a> {
    pub(super) fn new(account: &'a mut Account) -> Self {
        File { account, binary: Vec::new(), parts: Parts::default(), unlit: false, emissive_strength: false }
    }

    /// The scene's textures that materials use: their images follow those of the pages in this order.
    pub(super) fn take_own_textures(&mut self) -> Vec<u32> {
        std::mem::take(&mut self.parts.own_textures)
    }

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

    pub(super) fn add_primitive(
        &mut self,
        primitive: &Primitive,
        page: u32,
        material: &Material,
        pages: usize,
    ) -> Result<()> {
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

    /// `pages`: number of textures that are light map pages.
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

    pub(super) fn add_image(&mut self, png: &[u8], name: &str, sampler: usize) -> Result<()> {
        let view = self.add_view(png, None)?;
        let source = self.parts.images.len();
        self.parts.images.push(json!({ "bufferView": view, "mimeType": "image/png", "name": name }));
        self.parts.textures.push(json!({ "source": source, "sampler": sampler }));
        Ok(())
    }

    /// The JSON chunk, padded.
    pub(super) fn json(&mut self, exposure: f32) -> Vec<u8> {
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

/// Bytes of values as the file stores them.
#[cfg(target_endian = "little")]
fn little_endian<T: bytemuck::NoUninit>(values: &[T]) -> std::borrow::Cow<'_, [u8]> {
    bytemuck::cast_slice(values).into()
}

/// Bytes of values of 4 bytes each, as the file stores them.
#[cfg(target_endian = "big")]
fn little_endian<T: bytemuck::NoUninit>(values: &[T]) -> std::borrow::Cow<'_, [u8]> {
    let mut bytes: Vec<u8> = bytemuck::cast_slice(values).to_vec();
    bytes.as_chunks_mut::<4>().0.iter_mut().for_each(|b| b.reverse());
    bytes.into()
}
