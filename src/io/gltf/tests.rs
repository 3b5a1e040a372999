//! Files that are written here, as they should be and damaged.

use crate::base::error::Error;
use crate::io::tests::{Folder, albedos, corners, load_bytes, load_path, refusal};
use crate::scene::{Light, NONE};
use base64::Engine;
use glam::{Affine3A, Vec2, Vec3};
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
    for source in [json!({}), json!({ "uri": "no.png" }), json!({ "uri": "http://x/y.png" }), json!({ "uri": "a.glb" })]
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
    for extras in [json!(null), json!(7.5), json!("text"), json!([1, [2], {"a": 3}]), json!({"a": [4]}), json!([])] {
        let file = changed(|root| {
            let places = ["", "/asset", "/scenes/0", "/nodes/1", "/meshes/0", "/meshes/0/primitives/0", "/materials/0"];
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
    assert_eq!(info.warnings, ["1 meshes appear several times, so their TEXCOORD_1 is not unique and was left out"]);
}

/// The sample with a finely divided square in place of its own as mesh 0, shown by nodes as `nodes` says, with more
/// accessors of floats behind the square's.
fn divided(nodes: Value, more: &[(&str, Vec<f32>)]) -> Vec<u8> {
    const N: usize = 24;
    let mut sample = sample();
    let mut binary = Vec::new();
    let mut views = Vec::new();
    let mut accessors = Vec::new();
    let mut add = |bytes: Vec<u8>, kind: &str, component: u32, count: usize| {
        views.push(json!({ "buffer": 0, "byteOffset": binary.len(), "byteLength": bytes.len() }));
        let mut accessor =
            json!({ "bufferView": views.len() - 1, "componentType": component, "count": count, "type": kind });
        if accessors.is_empty() {
            (accessor["min"], accessor["max"]) = (json!([0, 0, 0]), json!([N, N, 0]));
        }
        accessors.push(accessor);
        binary.extend(bytes);
    };
    let points = (0..=N).flat_map(|j| (0..=N).map(move |i| [i as f32, j as f32, 0.0]));
    add(points.flatten().flat_map(f32::to_le_bytes).collect(), "VEC3", 5126, (N + 1) * (N + 1));
    let at = |i: usize, j: usize| (j * (N + 1) + i) as u32;
    let cell = |i, j| [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j), at(i + 1, j + 1), at(i, j + 1)];
    let corners = (0..N).flat_map(|j| (0..N).flat_map(move |i| cell(i, j)));
    add(corners.flat_map(u32::to_le_bytes).collect(), "SCALAR", 5125, 6 * N * N);
    for (kind, values) in more {
        let width = kind[3..].parse::<usize>().unwrap();
        add(values.iter().flat_map(|v| v.to_le_bytes()).collect(), kind, 5126, values.len() / width);
    }
    sample.root["buffers"][0]["byteLength"] = binary.len().into();
    (sample.root["bufferViews"], sample.root["accessors"]) = (views.into(), accessors.into());
    sample.root["meshes"] = json!([{ "primitives": [{ "attributes": { "POSITION": 0 }, "indices": 1 }] }]);
    sample.root["scenes"] = json!([{ "nodes": (0..nodes.as_array().unwrap().len()).collect::<Vec<_>>() }]);
    sample.root["nodes"] = nodes;
    sample.binary = binary;
    sample.glb()
}

#[test]
fn large_meshes_in_several_places_become_instances() {
    let nodes = json!([
        { "mesh": 0 },
        { "mesh": 0, "translation": [1, 2, 3], "scale": [2, 2, 2] },
        { "mesh": 0, "scale": [-1, 1, 1] },
    ]);
    let (scene, info) = load_bytes("a.glb", divided(nodes, &[])).unwrap();
    assert_eq!((info.meshes, info.instances, info.triangles), (2, 2, 3 * 1152));
    let instances = scene.instances();
    assert_eq!((instances[0].mesh, instances[0].transform), (0, Affine3A::IDENTITY));
    let p = instances[1].transform.transform_point3(scene.meshes()[0].positions[1]);
    assert_eq!((instances[1].mesh, p), (0, Vec3::new(3.0, 2.0, 3.0)));
    assert_eq!(scene.meshes()[1].positions[1], Vec3::new(-1.0, 0.0, 0.0), "a mirrored one is a mesh of its own");
}

#[test]
fn gpu_instancing_gives_places_of_a_node() {
    let extension = |attributes: Value| {
        json!([{ "mesh": 0, "translation": [0, 0, 10],
            "extensions": { "EXT_mesh_gpu_instancing": { "attributes": attributes } } }])
    };
    let half = 0.5f32.sqrt();
    let values = [
        ("VEC3", vec![1.0, 0.0, 0.0, 5.0, 0.0, 0.0]),
        ("VEC4", vec![0.0, 0.0, 0.0, 1.0, 0.0, 0.0, half, half]),
        ("VEC3", vec![1.0; 3]),
    ];
    let nodes = extension(json!({ "TRANSLATION": 2, "ROTATION": 3 }));
    let (scene, info) = load_bytes("a.glb", divided(nodes, &values)).unwrap();
    assert_eq!((info.meshes, info.instances, info.triangles), (1, 2, 2 * 1152));
    let of = |i: usize| scene.instances()[i].transform.transform_point3(scene.meshes()[0].positions[1]);
    assert!(of(0).distance(Vec3::new(2.0, 0.0, 10.0)) < 1e-6 && of(1).distance(Vec3::new(5.0, 1.0, 10.0)) < 1e-6);

    let of = |attributes| refusal("a.glb", divided(extension(attributes), &values));
    assert!(of(json!({ "TRANSLATION": 2, "SCALE": 4 })).contains("different counts"));
    assert!(of(json!({ "TRANSLATION": 77 })).contains("TRANSLATION names no accessor"));
    assert!(of(json!({ "ROTATION": 2 })).contains("is not of 4-vectors"));
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
    assert!(with(|root| root["nodes"][2]["scale"] = json!([0, 0, 0])).starts_with("light 0: the light's direction"));
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
    for harmless in ["KHR_texture_transform", "KHR_materials_unlit", "KHR_mesh_quantization", "KHR_lights_punctual"] {
        assert_eq!(with(harmless).unwrap().1.triangles, 2, "{harmless}");
    }
}
