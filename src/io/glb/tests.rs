//! Files that are written here, read by the crate `gltf` and by our own reader.

use super::*;
use crate::io::image::encode_png_rgb8;
use crate::io::tests::{albedos, corners, load_bytes};
use crate::scene::{Mesh, MeshMaterials, SceneData, Texture};
use glam::{Vec2, Vec3};
use serde_json::{Value, json};
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
    let positions: Vec<Vec3> = (0..4).map(|i| Vec3::new((i & 1) as f32 * 1.1, (i >> 1) as f32 * 0.7, -0.3)).collect();
    data.add_mesh(Mesh {
        uvs: positions.iter().map(|p| p.truncate() * 3.0).collect(),
        positions: positions.clone().into(),
        indices: vec![[0, 1, 2], [1, 3, 2], [1, 3, 2]].into(),
        materials: MeshMaterials::PerTriangle(vec![0, 0, 1].into()),
        ..Default::default()
    })
    .unwrap();
    data.add_mesh(Mesh {
        positions: positions.iter().map(|p| *p + Vec3::Z).collect(),
        indices: vec![[0, 1, 2], [1, 1, 2], [1, 3, 2]].into(),
        materials: MeshMaterials::PerTriangle(vec![2, 0, 0].into()),
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
    let expected = [(Some((0, 1)), 0.1, 6, 4), (Some((1, 1)), 0.4, 3, 3), (Some((1, 1)), 0.5, 3, 3), (None, 0.1, 3, 3)];
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
        positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y].into(),
        indices: vec![[0, 1, 2]].into(),
        normals: vec![Vec3::new(0.0, 0.6, 0.8); 3].into(),
        uvs: vec![Vec2::ZERO, Vec2::new(7.0, 0.0), Vec2::new(0.0, -3.0)].into(),
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
fn primitives_of_too_many_triangles_are_several() {
    let (scene, lightmap) = scene_and_lightmap();
    let counts = |most: usize| -> Vec<u64> {
        let mut account = Account::new(scene.device().memory()).unwrap();
        let (pages, exposure) = (&lightmap.pages, lightmap.exposure);
        let (json, _) = parts(&scene, &lightmap, pages, exposure, most, &mut account, &|_| Ok(())).unwrap();
        let json: Value = serde_json::from_slice(&json).unwrap();
        let primitives = json["meshes"][0]["primitives"].as_array().unwrap();
        let count = |p: &Value| json["accessors"][p["indices"].as_u64().unwrap() as usize]["count"].as_u64().unwrap();
        primitives.iter().map(count).collect()
    };
    assert_eq!(counts(MOST_TRIANGLES), [6, 3, 3, 3]);
    assert_eq!(counts(1), [3, 3, 3, 3, 3]);
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
