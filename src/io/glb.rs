//! A scene with its light maps as one GLB file (glTF 2.0, binary), so that any viewer shows it.
//!
//! Each pair of light map page and material is a primitive. Its material is unlit
//! (`KHR_materials_unlit`): `baseColorFactor` is the albedo, `baseColorTexture` the page, read
//! through `TEXCOORD_1`. A viewer multiplies the two, so with pages that hold tone-mapped irradiance
//! E it shows albedo × E × exposure, bent by the shoulder of [`super::image::tone_map`]: what an eye
//! at the surface sees, albedo/π · E, up to a constant, as nothing but diffuse light is baked.
//! Emissive materials are not unlit, since unlit ones do not glow: they carry `emissiveFactor` and
//! `KHR_materials_emissive_strength`. Triangles without a chart show their albedo alone. Triangles both sides of which
//! have places in the light map are written twice, the second time turned round, with one-sided materials.
//!
//! Pages are embedded as PNG files, row 0 at v = 0, without a flip (see [`super::image`]).
//! `TEXCOORD_0` holds the mesh's first texture coordinates, or zeros. Normals are left out. Triangles
//! that the scene skips (degenerate or not finite) are left out too.

use crate::error::{Error, Result, invalid_argument};
use crate::files;
use crate::lightmap::Lightmap;
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
    /// Its number in the mesh.
    pub triangle: u32,
    /// Of its corners, in the order of the front, in [0, 1].
    pub corner_uvs: [[f32; 2]; 3],
    pub page: u32,
}

impl GlbMesh {
    /// Of a mesh of a light map.
    pub fn of(lightmap: &Lightmap, mesh: u32) -> Result<GlbMesh> {
        let (corner_uvs, pages) = lightmap.mesh_uvs(mesh)?;
        let ((back_uvs, back_pages), own) = lightmap.mesh_back_uvs(mesh)?;
        let back = |t: usize| GlbBack { triangle: t as u32, corner_uvs: back_uvs[t], page: back_pages[t] };
        let backs = (0..own.len()).filter(|&t| own[t]).map(back).collect();
        Ok(GlbMesh { corner_uvs, pages, backs })
    }
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
    files::replace_with(path, &encode_glb(scene, lightmap)?)
}

/// The bytes of the file that [`write_glb`] writes.
pub fn encode_glb(scene: &Scene, lightmap: &GlbLightmap) -> Result<Vec<u8>> {
    check(scene, lightmap)?;
    let mut file = File::default();
    for ((page, material, one_sided), triangles) in group(scene, lightmap) {
        let primitive = Primitive::new(scene, &triangles);
        let material = scene.materials()[material as usize];
        let material = Material { two_sided: material.two_sided && !one_sided, ..material };
        file.add_primitive(&primitive, page, &material);
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
}

/// The valid triangles of each (page, material, whether this side alone is to be shown).
fn group(scene: &Scene, lightmap: &GlbLightmap) -> BTreeMap<(u32, u32, bool), Vec<Triangle>> {
    let mut groups = BTreeMap::<_, Vec<_>>::new();
    for (m, (mesh, uvs)) in (0..).zip(scene.meshes().iter().zip(&lightmap.meshes)) {
        let first = scene.first_triangle(m);
        let backs: HashMap<usize, &GlbBack> = uvs.backs.iter().map(|b| (b.triangle as usize, b)).collect();
        for t in (0..mesh.indices.len()).filter(|t| scene.is_valid(first + *t as u32)) {
            let (vertices, back) = (mesh.indices[t], backs.get(&t));
            let mut add = |page: u32, vertices, corner_uvs| {
                let key = (page, mesh.material(t), back.is_some());
                groups.entry(key).or_default().push(Triangle { mesh: m, vertices, corner_uvs });
            };
            add(uvs.pages[t], vertices, uvs.corner_uvs[t]);
            if let Some(back) = back {
                let turn = [0, 2, 1];
                add(back.page, turn.map(|i| vertices[i]), turn.map(|i| back.corner_uvs[i]));
            }
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
    fn new(scene: &Scene, triangles: &[Triangle]) -> Self {
        let mut result = Primitive::default();
        let mut vertex_of = HashMap::<(u32, u32, [u32; 2]), u32>::new();
        for t in triangles {
            let mesh = &scene.meshes()[t.mesh as usize];
            for (&v, &lightmap_uv) in t.vertices.iter().zip(&t.corner_uvs) {
                let vertex = *vertex_of.entry((t.mesh, v, lightmap_uv.map(f32::to_bits))).or_insert_with(|| {
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

#[cfg(test)]
pub(super) mod tests {
    use super::super::image::encode_png_rgb8;
    use super::*;
    use crate::io::tests::{albedos, corners, load_bytes};

    use crate::scene::{Mesh, MeshMaterials, SceneData};
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
        (scene, GlbLightmap { meshes, pages })
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
