//! Tests that go through [`load`](super::load), and what the tests of the readers share.

use super::{LoadInfo, load};
use crate::base::error::{Error, Result};
use crate::scene::{Light, Material, Mesh, MeshMaterials, SceneData};
use glam::Vec3;
use proptest::prelude::*;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

/// A folder for one test, removed at its end.
pub(super) struct Folder(PathBuf);

impl Folder {
    pub fn new() -> Self {
        static NEXT: AtomicU32 = AtomicU32::new(0);
        let name = format!("bakelite-io-{}-{}", std::process::id(), NEXT.fetch_add(1, Relaxed));
        let path = std::env::temp_dir().join(name);
        std::fs::create_dir_all(&path).unwrap();
        Folder(path)
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// Loads a file of this name and content, alone in its folder.
pub(super) fn load_bytes(name: &str, bytes: impl AsRef<[u8]>) -> Result<(SceneData, LoadInfo)> {
    let folder = Folder::new();
    std::fs::write(folder.path(name), bytes).unwrap();
    load_path(&folder.path(name))
}

pub(super) fn load_path(path: &Path) -> Result<(SceneData, LoadInfo)> {
    let mut scene = SceneData::new();
    load(path, &mut scene).map(|info| (scene, info))
}

/// The sentence of the `Error::Io` that loading gives, behind the file's name.
pub(super) fn refusal(name: &str, bytes: impl AsRef<[u8]>) -> String {
    match load_bytes(name, bytes) {
        Err(Error::Io(message)) => match message.split_once(name) {
            Some((_, rest)) => rest.trim_start_matches([':', ',']).trim_start().to_string(),
            None => panic!("{message:?} does not name {name}"),
        },
        Err(e) => panic!("{e}"),
        Ok((_, info)) => panic!("{info:?}"),
    }
}

/// The materials of all triangles, mesh by mesh.
pub(super) fn albedos(scene: &SceneData) -> Vec<[f32; 3]> {
    let of_mesh = |m: &Mesh| (0..m.indices.len()).map(|t| m.material(t)).collect::<Vec<_>>();
    scene.meshes().iter().flat_map(of_mesh).map(|m| scene.materials()[m as usize].albedo).collect()
}

/// The corners of all triangles, mesh by mesh.
pub(super) fn corners(scene: &SceneData) -> Vec<[Vec3; 3]> {
    scene.meshes().iter().flat_map(|m| (0..m.indices.len()).map(|t| m.corners(t)).collect::<Vec<_>>()).collect()
}

const TRIANGLE: &str = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n";

#[test]
fn the_extension_decides_in_any_case() {
    assert_eq!(load_bytes("A.ObJ", TRIANGLE).unwrap().1.triangles, 1);
    for name in ["a.stl", "obj", "a.obj.gz"] {
        let Err(Error::Unsupported(message)) = load_bytes(name, TRIANGLE) else { panic!("{name} was read") };
        assert!(message.contains(name) && message.ends_with("not obj, ply, gltf or glb"), "{message}");
    }
}

#[test]
fn missing_files_and_folders_are_named() {
    let folder = Folder::new();
    for name in ["a.obj", "a.ply", "a.gltf", "a.glb"] {
        let Err(Error::Io(message)) = load_path(&folder.path(name)) else { panic!("{name} was read") };
        assert!(message.contains(name), "{message}");
        std::fs::create_dir(folder.path(name)).unwrap();
        assert!(matches!(load_path(&folder.path(name)), Err(Error::Io(_))));
    }
}

#[test]
fn loading_appends_and_a_failure_changes_nothing() {
    let folder = Folder::new();
    std::fs::write(folder.path("a.mtl"), "newmtl m\nKd 0.1 0.2 0.3\n").unwrap();
    std::fs::write(folder.path("a.obj"), format!("mtllib a.mtl\nusemtl m\n{TRIANGLE}")).unwrap();
    std::fs::write(folder.path("b.obj"), format!("{TRIANGLE}f 1 2 9\n")).unwrap();
    let mut scene = SceneData::new();
    let own = scene.add_material(Material::default()).unwrap();
    let light = Light::Point { position: Vec3::ZERO, intensity: [1.0; 3] };
    scene.add_light(light).unwrap();
    scene.add_mesh(Mesh { materials: MeshMaterials::One(own), ..Mesh::default() }).unwrap();

    assert!(load(&folder.path("b.obj"), &mut scene).is_err());
    assert_eq!((scene.meshes().len(), scene.materials().len(), scene.lights().len()), (1, 1, 1));

    let info = load(&folder.path("a.obj"), &mut scene).unwrap();
    assert_eq!((info.meshes, info.triangles, info.vertices, info.materials, info.lights), (1, 1, 3, 1, 0));
    assert_eq!(scene.meshes()[1].materials, MeshMaterials::One(1));
    assert_eq!(albedos(&scene), [[0.1, 0.2, 0.3]]);
    assert!(info.warnings.is_empty() && info.seconds > 0.0);
}

/// The folder of the real scenes, or `None` with a message.
fn shared_scenes() -> Option<PathBuf> {
    let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/scenes");
    let folder = std::env::var_os("BAKELITE_SCENES").map_or(beside, PathBuf::from);
    if !folder.is_dir() {
        eprintln!("skipped: there are no scenes in {}; set BAKELITE_SCENES", folder.display());
        return None;
    }
    Some(folder)
}

#[test]
fn the_shared_scenes_load_as_described() {
    let Some(folder) = shared_scenes() else { return };
    // Triangles, degenerate ones included, and distinct positions, as the files' heads say.
    for (name, triangles, materials) in [
        ("sponza_crytek.obj", 262_267, 25),
        ("living_room_2.obj", 414_841, 63),
        ("san_miguel_architecture.ply", 1_012_685, 1),
        ("q3_oa_dm5.obj", 40_246, 1),
        ("stanford_bunny.obj", 69_451, 1),
    ] {
        let (scene, info) = load_path(&folder.join(name)).unwrap();
        eprintln!("{name}: {info:?}");
        assert_eq!((info.triangles, info.materials), (triangles, materials), "{name}");
        assert_eq!(info.has_lightmap_uvs, name == "q3_oa_dm5.obj", "{name}");
        assert_eq!(scene.triangle_count() as u64, triangles);
        assert_eq!((info.albedos_clamped, info.faces_triangulated), (0, 0), "{name}");
    }
}

#[test]
fn the_living_room_has_its_four_emitters() {
    let Some(folder) = shared_scenes() else { return };
    let (scene, _) = load_path(&folder.join("living_room_2.obj")).unwrap();
    let emissive: Vec<_> = scene.materials().iter().filter(|m| m.is_emissive()).collect();
    assert_eq!(emissive.len(), 1);
    assert_eq!(emissive[0].emission, [13.75; 3]);
    let emits = |m: &Mesh, t: usize| scene.materials()[m.material(t) as usize].is_emissive();
    let triangles: usize = scene.meshes().iter().map(|m| (0..m.indices.len()).filter(|&t| emits(m, t)).count()).sum();
    assert_eq!(triangles, 8, "four rectangles");
}

#[test]
fn the_level_has_its_own_light_map_pages() {
    let Some(folder) = shared_scenes() else { return };
    let (scene, _) = load_path(&folder.join("q3_oa_dm5.obj")).unwrap();
    let lightmaps = || scene.meshes().iter().filter_map(|m| m.lightmap.as_ref());
    let pages: std::collections::BTreeSet<_> = lightmaps().flat_map(|l| l.pages.iter().copied()).collect();
    assert_eq!(pages.into_iter().collect::<Vec<_>>(), [0, 1, 2, 3, 4, 5]);
    assert!(scene.meshes().iter().any(|m| m.lightmap.is_none()), "some faces are lit by vertex");
    let in_range =
        |l: &&crate::scene::LightmapUvs| l.uvs.iter().all(|uv| uv.min_element() >= 0.0 && uv.max_element() <= 1.0);
    assert!(lightmaps().all(|l| in_range(&l)));
}

/// Our reader and `tobj`, which shares no code with it, must see the same triangles.
#[test]
fn obj_files_read_as_by_tobj() {
    let Some(folder) = shared_scenes() else { return };
    for name in ["sponza_crytek.obj", "living_room_2.obj", "stanford_bunny.obj"] {
        let (scene, _) = load_path(&folder.join(name)).unwrap();
        let (models, materials) = tobj::load_obj(folder.join(name), &tobj::GPU_LOAD_OPTIONS).unwrap();
        let materials = materials.unwrap_or_default();
        let (mut theirs, mut their_uvs, mut their_albedos) = (Vec::new(), Vec::new(), Vec::new());
        for mesh in models.iter().map(|m| &m.mesh) {
            let albedo = mesh.material_id.map_or([0.5; 3], |m| materials[m].diffuse.unwrap());
            for t in mesh.indices.chunks(3) {
                theirs.push([0, 1, 2].map(|k| Vec3::from_slice(&mesh.positions[t[k] as usize * 3..])));
                if !mesh.texcoords.is_empty() {
                    their_uvs.extend(t.iter().map(|&v| [0, 1].map(|k| mesh.texcoords[v as usize * 2 + k])));
                }
                their_albedos.push(albedo);
            }
        }
        assert!(corners(&scene) == theirs, "{name}: positions");
        assert!(albedos(&scene) == their_albedos, "{name}: materials");
        let with_uvs = scene.meshes().iter().filter(|m| !m.uvs.is_empty());
        let uvs: Vec<_> =
            with_uvs.flat_map(|m| m.indices.as_flattened().iter().map(|&v| m.uvs[v as usize].to_array())).collect();
        assert!(uvs == their_uvs, "{name}: texture coordinates");
    }
}

/// A small valid file of each format, for damaging.
static SAMPLES: LazyLock<Vec<(&str, Vec<u8>)>> = LazyLock::new(|| {
    vec![
        ("a.obj", super::obj::tests::SAMPLE.into()),
        ("a.ply", super::ply::tests::ascii_sample()),
        ("b.ply", super::ply::tests::binary_sample(true)),
        ("c.ply", super::ply::tests::binary_sample(false)),
        ("a.gltf", super::gltf::tests::sample().gltf()),
        ("a.glb", super::gltf::tests::sample().glb()),
        ("b.glb", super::glb::tests::sample()),
    ]
});

#[test]
fn the_samples_are_valid() {
    for (name, bytes) in SAMPLES.iter() {
        load_bytes(name, bytes).unwrap_or_else(|e| panic!("{name}: {e}"));
    }
}

#[test]
fn a_file_cut_anywhere_is_read_or_refused() {
    for (name, bytes) in SAMPLES.iter() {
        let folder = Folder::new();
        for length in 0..bytes.len() {
            std::fs::write(folder.path(name), &bytes[..length]).unwrap();
            let result = load_path(&folder.path(name));
            // Text may still make sense, binary data does not.
            if bytes.starts_with(b"glTF") || ["b.ply", "c.ply"].contains(name) || length == 0 {
                assert!(matches!(result, Err(Error::Io(_))), "{name} cut at {length}: {result:?}");
            }
        }
    }
}

/// A number that tends to be too much, too little or odd.
fn odd_number() -> impl Strategy<Value = &'static str> {
    const NUMBERS: &[&str] =
        &["-1", "0", "1e9", "4294967295", "4294967296", "18446744073709551615", "1e39", "nan", "-0.5", "", "x", "999"];
    prop::sample::select(NUMBERS)
}

/// `bytes` with the `n`th run of digits replaced.
fn replace_number(bytes: &[u8], n: usize, number: &str) -> Vec<u8> {
    let starts: Vec<usize> =
        (0..bytes.len()).filter(|&i| bytes[i].is_ascii_digit() && (i == 0 || !bytes[i - 1].is_ascii_digit())).collect();
    let Some(&start) = starts.get(n % starts.len().max(1)) else { return bytes.to_vec() };
    let end = bytes[start..].iter().position(|c| !c.is_ascii_digit()).map_or(bytes.len(), |n| start + n);
    [&bytes[..start], number.as_bytes(), &bytes[end..]].concat()
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn a_damaged_file_is_read_or_refused(
        which in 0..7usize,
        flips in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..6),
        numbers in prop::collection::vec((any::<usize>(), odd_number()), 0..3),
        cut in prop::option::weighted(0.2, any::<prop::sample::Index>()),
    ) {
        let (name, mut bytes) = SAMPLES[which].clone();
        for (n, number) in numbers {
            bytes = replace_number(&bytes, n, number);
        }
        for (at, value) in flips {
            let at = at.index(bytes.len());
            bytes[at] = value;
        }
        if let Some(cut) = cut {
            bytes.truncate(cut.index(bytes.len()));
        }
        let mut scene = SceneData::new();
        let folder = Folder::new();
        std::fs::write(folder.path(name), bytes).unwrap();
        match load(&folder.path(name), &mut scene) {
            Ok(info) => {
                // What was read is a valid scene with finite vertices.
                prop_assert!(info.triangles > 0 && info.triangles < 1000);
                prop_assert!(corners(&scene).iter().flatten().all(|c| c.is_finite()));
            }
            Err(e) => {
                prop_assert!(matches!(e, Error::Io(_) | Error::Unsupported(_)), "{e}");
                prop_assert_eq!(scene.triangle_count() + scene.materials().len() + scene.lights().len(), 0);
            }
        }
    }

    #[test]
    fn garbage_is_refused(name in prop::sample::select(&["a.obj", "a.ply", "a.gltf", "a.glb"][..]), bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        prop_assert!(matches!(load_bytes(name, bytes), Err(Error::Io(_))));
    }
}
