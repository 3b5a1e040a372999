//! A scene with its light maps as one GLB file (glTF 2.0, binary), for viewers and engines.
//!
//! Each pair of light map page and material is a primitive, or several if it has millions of triangles. `TEXCOORD_0`
//! holds the mesh's first texture coordinates, or zeros; `TEXCOORD_1` those of the light map. glTF has no slot for light
//! maps, so it depends on the material where the page goes:
//! - A material without a texture is unlit (`KHR_materials_unlit`): `baseColorFactor` is the albedo,
//!   `baseColorTexture` the page on `TEXCOORD_1`. A viewer multiplies the two, so it shows albedo × E × exposure, bent
//!   by the shoulder of [`crate::io::image::tone_map`]: what an eye at the surface sees, albedo/π · E, up to a
//!   constant.
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
//! have texels in the light map are written twice, the second time turned round, with one-sided materials.
//!
//! Images are embedded as PNG files, row 0 at v = 0, without a flip (see [`crate::io::image`]). Cut-outs become
//! `alphaMode` `MASK`. Normals are written where meshes bring them. Triangles that the scene skips (degenerate or not
//! finite) are left out.

mod file;
mod primitives;
#[cfg(test)]
pub(super) mod tests;

use super::account::Account;
use super::image::encode_png;
use super::source::Advance;
use crate::base::error::{Error, Result, invalid_argument};
use crate::base::files;
use crate::base::memory::try_append;
use crate::lightmap::Lightmap;
use crate::scene::{MAX_TRIANGLES, Material, NONE, Scene};
use file::{File, LIGHTMAP_SAMPLER, TEXTURE_SAMPLER};
use primitives::{Primitive, group};
use std::path::Path;

/// Where the sides of triangles lie in a light map.
pub(super) trait Places {
    /// Returns the light map coordinates of the corners of a triangle's front, by its object, its number in it and its
    /// global number, and its page; [`NONE`]: it has no chart.
    fn front(&self, object: u32, triangle: u32, global: u32) -> ([[f32; 2]; 3], u32);
    /// Returns the same of its back, if that has a place of its own, with the corners in the order of the front.
    fn back(&self, object: u32, triangle: u32, global: u32) -> Option<([[f32; 2]; 3], u32)>;
}

impl Places for Lightmap {
    fn front(&self, _: u32, _: u32, global: u32) -> ([[f32; 2]; 3], u32) {
        self.triangle_uvs(global, true)
    }

    fn back(&self, _: u32, _: u32, global: u32) -> Option<([[f32; 2]; 3], u32)> {
        self.has_both_sides(global).then(|| self.triangle_uvs(global, false))
    }
}

impl Places for GlbLightmap {
    fn front(&self, mesh: u32, triangle: u32, _: u32) -> ([[f32; 2]; 3], u32) {
        let mesh = &self.meshes[mesh as usize];
        (mesh.corner_uvs[triangle as usize], mesh.pages[triangle as usize])
    }

    fn back(&self, mesh: u32, triangle: u32, _: u32) -> Option<([[f32; 2]; 3], u32)> {
        let backs = &self.meshes[mesh as usize].backs;
        let back = backs.binary_search_by_key(&triangle, |back| back.triangle).ok()?;
        Some((backs[back].corner_uvs, backs[back].page))
    }
}

/// Light map coordinates of one mesh.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GlbMesh {
    /// Light map coordinates of the corners of each triangle, in [0, 1].
    pub corner_uvs: Vec<[[f32; 2]; 3]>,
    /// Page of each triangle; [`NONE`]: it has no chart.
    pub pages: Vec<u32>,
    /// Triangles whose backs have places of their own, ascending.
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

/// The light maps of a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct GlbLightmap {
    /// One per mesh of the scene.
    pub meshes: Vec<GlbMesh>,
    /// One PNG file per page, as [`super::image::encode_png_rgb8`] makes them.
    pub pages: Vec<Vec<u8>>,
    /// Factor by which irradiance was multiplied in the pages.
    pub exposure: f32,
}

/// Writes `scene` and its light maps to the file `path`, which is replaced as a whole.
pub fn write_glb(path: &Path, scene: &Scene, lightmap: &GlbLightmap) -> Result<()> {
    check(scene, lightmap)?;
    prepare_glb(path, scene, lightmap, &lightmap.pages, lightmap.exposure, &|_| Ok(()))?.finish()
}

/// Same as `write_glb` up to [`finish`](files::Replacement::finish), with reports: `advance` is called with each of 2
/// parts, and ends the call by an error.
pub(super) fn prepare_glb(
    path: &Path,
    scene: &Scene,
    places: &impl Places,
    pages: &[Vec<u8>],
    exposure: f32,
    advance: Advance,
) -> Result<files::Replacement> {
    let mut account = Account::new(scene.device().memory())?;
    let (json, binary) = parts(scene, places, pages, exposure, MOST_TRIANGLES, &mut account, advance)?;
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
    check(scene, lightmap)?;
    let mut account = Account::new(scene.device().memory())?;
    let (pages, exposure) = (&lightmap.pages, lightmap.exposure);
    let (json, binary) = parts(scene, lightmap, pages, exposure, MOST_TRIANGLES, &mut account, &|_| Ok(()))?;
    let headers = headers(&json, &binary)?;
    let mut file = Vec::new();
    for part in [&headers[0][..], &json, &headers[1], &binary] {
        try_append(&mut file, part, "the GLB file")?;
    }
    Ok(file)
}

/// Maximum number of triangles of a primitive: what is looked up while it is made stays small. Further ones go into
/// another primitive of the same material.
const MOST_TRIANGLES: usize = 1 << 20;

/// The two chunks of the file, without their headers. `most`: maximum number of triangles of a primitive.
fn parts(
    scene: &Scene,
    places: &impl Places,
    pages: &[Vec<u8>],
    exposure: f32,
    most: usize,
    account: &mut Account,
    advance: Advance,
) -> Result<(Vec<u8>, Vec<u8>)> {
    let mut file = File::new(account);
    for (key, sides) in group(scene, places, file.account, advance)? {
        let material = scene.materials()[key.material as usize];
        let material = Material { two_sided: material.two_sided && !key.one_sided, ..material };
        for some in sides.chunks(most) {
            let mut held = Account::new(scene.device().memory())?;
            let primitive = Primitive::new(scene, places, some, key.normals, &mut held, advance)?;
            file.add_primitive(&primitive, key.page, &material, pages.len())?;
        }
        file.account.give_back(size_of_val(&sides[..]));
    }
    for (page, png) in pages.iter().enumerate() {
        file.add_image(png, &format!("light map page {page}"), LIGHTMAP_SAMPLER)?;
    }
    for number in file.take_own_textures() {
        advance(0)?;
        let texture = &scene.textures()[number as usize];
        file.account.hold(2 * texture.bytes(), "an image")?;
        let png = encode_png(texture.width, texture.height, &texture.rgba8, png::ColorType::Rgba, advance)?;
        file.account.give_back(2 * texture.bytes());
        file.add_image(&png, &format!("texture {number}"), TEXTURE_SAMPLER)?;
    }
    Ok((file.json(exposure), file.binary))
}

fn check(scene: &Scene, lightmap: &GlbLightmap) -> Result<()> {
    // Sides of triangles have one bit more than their numbers (primitives.rs).
    if scene.triangle_count() as usize > MAX_TRIANGLES {
        return Err(Error::Unsupported(format!("a GLB file of {} triangles", scene.triangle_count())));
    }
    let count = scene.object_count();
    if lightmap.meshes.len() != count as usize {
        return invalid_argument!("light map UVs of {} meshes for {count}", lightmap.meshes.len());
    }
    let page_count = lightmap.pages.len();
    for (m, uvs) in (0..).zip(&lightmap.meshes) {
        let triangles = scene.triangles_of(m).len();
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

/// The header of a chunk of the GLB container (glTF 2.0, chapter 4).
fn headers(json: &[u8], binary: &[u8]) -> Result<[Vec<u8>; 2]> {
    let total = 12 + 8 + json.len() + 8 + binary.len();
    let Ok(length) = u32::try_from(total) else {
        return Err(Error::Unsupported(format!("a GLB file of {total} bytes: the format ends at 4 GiB")));
    };
    let chunk = |kind: &[u8], size: usize| [&(size as u32).to_le_bytes(), kind].concat();
    let first = [&b"glTF\x02\0\0\0"[..], &length.to_le_bytes(), &chunk(b"JSON", json.len())].concat();
    Ok([first, chunk(b"BIN\0", binary.len())])
}
