//! Reads a file of any content and checks what may come of it: a valid scene or image, or an error and nothing else.

use crate::live_state::LiveState;
use crate::saved::Saved;
use crate::scene_file::SceneFile;
use crate::shares::Shares;
use bakelite::scene::{SceneData, is_valid_triangle};
use bakelite::{Error, Progress, io};
use std::path::{Path, PathBuf};
use std::sync::{LazyLock, Mutex, OnceLock};

const TRIANGLES: &str = "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl red\nf 1/1 2/1 3/1\nusemtl lamp\n\
    f 1/1 2/1 3/1\nusemtl cut\nf 1/1 2/1 3/1\n";

static RESULT: LazyLock<Mutex<Saved>> = LazyLock::new(|| Mutex::new(Saved::result()));
static SCENE: LazyLock<Mutex<SceneFile>> = LazyLock::new(|| Mutex::new(SceneFile::of_room(folder())));
static LIVE_STATE: LazyLock<Mutex<LiveState>> = LazyLock::new(|| Mutex::new(LiveState::of_room()));
static SHARES: LazyLock<Mutex<Shares>> = LazyLock::new(|| Mutex::new(Shares::of_room()));
static CHECKPOINT: LazyLock<Mutex<Saved>> = LazyLock::new(|| Mutex::new(Saved::checkpoint()));

/// The folder of this process. It holds an OBJ file, a library and an image that inputs may name.
fn folder() -> &'static Path {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    FOLDER.get_or_init(|| {
        let shared_memory = Path::new("/dev/shm");
        let parent = if shared_memory.is_dir() { shared_memory.to_owned() } else { std::env::temp_dir() };
        let folder = parent.join(format!("bakelite-damaged-{}", std::process::id()));
        std::fs::create_dir_all(&folder).expect("a folder");
        for (name, content) in [
            ("triangles.obj", TRIANGLES),
            ("a.mtl", "newmtl red\nmap_Kd image\nmap_d image\n"),
            ("beside.bin", &"0".repeat(200)),
        ] {
            std::fs::write(folder.join(name), content).expect("a file");
        }
        folder
    })
}

/// Reads `bytes` as a file of the kind `target`, or as changes to one that was saved. Panics if what comes of it is not
/// in order.
pub fn read(target: &str, bytes: &[u8]) {
    let write = |name: &str| {
        let path = folder().join(name);
        std::fs::write(&path, bytes).expect("a file");
        path
    };
    match target {
        "obj" | "ply" | "gltf" | "glb" => load(&write(&format!("input.{target}"))),
        "mtl" => {
            write("a.mtl");
            load(&folder().join("triangles.obj"));
        }
        "png" | "jpeg" => {
            write("image");
            load(&folder().join("triangles.obj"));
        }
        "live_restore" => LIVE_STATE.lock().expect("no earlier panic").restore(bytes),
        "scene_file" => SCENE.lock().expect("no earlier panic").open(bytes),
        "saved_result" => RESULT.lock().expect("no earlier panic").load(bytes),
        "checkpoint" => CHECKPOINT.lock().expect("no earlier panic").resume(bytes),
        "share" => SHARES.lock().expect("no earlier panic").read(bytes),
        _ => match io::image::read_environment(&write("sky")) {
            Ok(sky) => assert!(sky.rgb().as_flattened().iter().all(|c| c.is_finite() && *c >= 0.0)),
            Err(e) => check_error(&e),
        },
    }
}

fn load(path: &Path) {
    let mut data = SceneData::new();
    let options = io::LoadOptions { max_texture_bytes: 16 << 20, max_file_bytes: 16 << 20, ..Default::default() };
    match io::load_with(path, &options, &Progress::none(), &mut data) {
        Ok(info) => {
            assert!(info.triangles > 0 && info.triangles == data.triangle_count() as u64);
            for mesh in data.meshes() {
                assert!(mesh.validate(data.materials().len()).is_ok());
                assert!(mesh.positions.iter().all(|p| p.is_finite()));
                let _ = (0..mesh.indices.len()).filter(|&t| is_valid_triangle(mesh.corners(t))).count();
            }
            assert!(data.textures().iter().all(|t| t.validate().is_ok()));
        }
        Err(e) => {
            check_error(&e);
            let left = data.meshes().len() + data.materials().len() + data.textures().len() + data.lights().len();
            assert_eq!(left, 0, "a load that fails leaves nothing");
        }
    }
}

fn check_error(e: &Error) {
    assert!(matches!(e, Error::Io(_) | Error::Unsupported(_) | Error::OutOfMemory(_)), "{e}");
}
