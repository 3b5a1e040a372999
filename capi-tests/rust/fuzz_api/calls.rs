//! One function per group of calls: random arguments, and what must hold of the results.

use crate::source::Source;
use crate::world::*;
use bakelite::capi::bake::*;
use bakelite::capi::device::*;
use bakelite::capi::error::*;
use bakelite::capi::files::*;
use bakelite::capi::instances::*;
use bakelite::capi::lightmap::*;
use bakelite::capi::lights::*;
use bakelite::capi::live::*;
use bakelite::capi::meshes::*;
use bakelite::capi::photons::*;
use bakelite::capi::rays::*;
use bakelite::capi::read::*;
use bakelite::capi::scene::*;
use bakelite::capi::textures::*;
use std::ffi::{CStr, CString, c_void};
use std::mem::MaybeUninit;
use std::ptr::{null, null_mut};
use std::sync::Arc;

type W = Arc<World>;

/// `defaults!(bk_x, bk_x_init)`: a structure as its init function leaves it.
macro_rules! defaults {
    ($type:ty, $init:ident) => {{
        let mut value = MaybeUninit::<$type>::zeroed();
        bk!($init(value.as_mut_ptr()));
        // SAFETY: of integers, floats and pointers that may be NULL, all set.
        unsafe { value.assume_init() }
    }};
}

/// Any call.
pub fn any(w: &W, s: &mut Source) {
    match s.below(100) {
        0 => create_device(w, s),
        1..=4 => create_scene(w, s),
        5 => load_scene(w, s),
        6 => scene_files(w, s),
        7..=10 => material(w, s),
        11..=16 => mesh(w, s),
        17 => instances(w, s),
        18..=19 => image(w, s),
        20..=23 => light(w, s),
        24..=30 => commit(w, s),
        31..=34 => refit(w, s),
        35..=37 => scene_numbers(w, s),
        38..=55 => rays(w, s),
        56..=58 => photons(w, s),
        59..=62 => photon_numbers(w, s),
        63..=65 => lightmap(w, s),
        66..=68 => lightmap_numbers(w, s),
        69 => bake(w, s),
        70 => edit(w, s),
        71..=76 => read(w, s),
        77 => save(w, s),
        78..=80 => live(w, s),
        81..=84 => live_update(w, s),
        85..=90 => live_numbers(w, s),
        91 => live_files(w, s),
        92..=93 => small_talk(w, s),
        94..=95 => null_handles(s),
        96..=97 => again(w, s),
        _ => w.forget(any_kind(s), s),
    }
}

fn any_kind(s: &mut Source) -> Kind {
    [Kind::Device, Kind::Scene, Kind::Photons, Kind::Lightmap, Kind::Live][s.below(5)]
}

fn again(w: &W, s: &mut Source) {
    if let Some(h) = w.pick(any_kind(s), s) {
        w.add(h.again());
    }
}

pub fn create_device(w: &W, s: &mut Source) {
    let (account, life) = account(w, s);
    let mut desc = defaults!(bk_device_desc, bk_device_desc_init);
    desc.num_threads = match s.below(12) {
        0 => u32::MAX,
        1 => 1 << 20,
        n => 1 + n as u32 % 3,
    };
    desc.isa = if s.one_in(6) { s.integer() } else { s.below(4) as u32 };
    desc.struct_size = if s.one_in(20) { s.integer() } else { desc.struct_size };
    desc.log = s.one_in(2).then_some(log);
    desc.memory = Some(memory);
    desc.user = std::ptr::from_ref(account).cast_mut().cast();
    let mut out = std::ptr::dangling_mut();
    let result = ask!(bk_device_create(&desc, &mut out));
    check_created("bk_device_create", result, out.cast());
    if result == BK_OK {
        let device = Handle::new(out, Kind::Device, &life);
        let isa = bk!(bk_device_isa(out));
        if isa == BK_ISA_AUTO || (desc.isa != BK_ISA_AUTO && isa != desc.isa) {
            broken(&format!("bk_device_isa is {isa} where {} was asked for", desc.isa));
        }
        if bk!(bk_device_num_threads(out)) != desc.num_threads {
            broken("bk_device_num_threads is not what was asked for");
        }
        w.add(device);
    }
}

pub fn create_scene(w: &W, s: &mut Source) {
    let Some(device) = w.pick(Kind::Device, s) else { return };
    let mut out = std::ptr::dangling_mut();
    let result = ask!(bk_scene_create(device.p(), &mut out));
    check_created("bk_scene_create", result, out.cast());
    if result != BK_OK {
        return;
    }
    let scene = Handle::new(out, Kind::Scene, device.life());
    w.add(scene.clone());
    match s.below(10) {
        0..=3 => _ = ask!(bk_scene_load_builtin(scene.p(), c"cornell".as_ptr())),
        4 => _ = ask!(bk_scene_load_builtin(scene.p(), c"furnace".as_ptr())),
        5 => return,
        _ => {
            let desc = defaults!(bk_material_desc, bk_material_desc_init);
            ask!(bk_scene_add_material(scene.p(), &desc, null_mut()));
            add_mesh(&scene, s, false);
            light_of(&scene, s);
        }
    }
    if s.one_in(2) {
        ask!(bk_scene_commit(scene.p(), None, null_mut()));
    }
}

/// A scene to describe, or to be refused.
fn scene(w: &W, s: &mut Source) -> Option<Arc<Handle>> {
    w.pick(Kind::Scene, s)
}

fn c_text(text: &str) -> CString {
    CString::new(text.replace('\0', "")).unwrap()
}

/// Small files of every kind, whole, cut and with bytes changed; and names of what is no scene.
fn load_scene(w: &W, s: &mut Source) {
    let Some(scene) = scene(w, s) else { return };
    let mut info = defaults!(bk_load_info, bk_load_info_init);
    let out = if s.one_in(3) { null_mut() } else { &raw mut info };
    if s.one_in(3) {
        let names = [c"cornell", c"furnace", c"", c"atrium ", c"\xff\xfe", c"CORNELL"];
        ask!(bk_scene_load_builtin(scene.p(), names[s.below(names.len())].as_ptr()));
        return;
    }
    let path = match s.below(8) {
        0 => c_text(["", "/", "/dev/null", "/nonexistent/x.obj", ".obj", "x.fbx"][s.below(6)]),
        1 => CString::new([0xff, 0xfe, b'.', b'o', b'b', b'j']).unwrap(),
        2 => c_text(&("a/".repeat(3000) + ".obj")),
        _ => {
            let (name, text): (&str, &[u8]) = FILES[s.below(FILES.len())];
            let mut bytes = text.to_vec();
            for _ in 0..s.below(4) {
                let at = s.below(bytes.len());
                match s.below(3) {
                    0 => bytes[at] = s.next() as u8,
                    1 => bytes.truncate(at + 1),
                    _ => bytes[at] = b"0123456789-./e\n {}[]"[s.below(20)],
                }
            }
            let path = format!("{}/{}-{name}", w.folder, s.below(4));
            std::fs::write(&path, bytes).expect("the temporary folder can be written");
            c_text(&path)
        }
    };
    let mut params = defaults!(bk_load_params, bk_load_params_init);
    params.flags = if s.one_in(8) { s.integer() } else { s.below(2) as u32 };
    params.struct_size = if s.one_in(20) { s.integer() } else { params.struct_size };
    if s.one_in(4) {
        params.max_file_bytes = s.integer() as u64;
        params.max_texture_bytes = s.integer() as u64;
    }
    let base = c_text(["", "/", "/nonexistent", &w.folder][s.below(4)]);
    if s.one_in(4) {
        params.base_folder = base.as_ptr();
    }
    let params = if s.one_in(3) { null() } else { &raw const params };
    let watched = Watched::new(w, s);
    let result = ask!(bk_scene_load_file(scene.p(), path.as_ptr(), params, Some(progress), watched.user(), out));
    watched.end("bk_scene_load_file", result);
}

const FILES: [(&str, &[u8]); 4] = [
    ("a.obj", b"mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nvn 0 0 1\nvt 0 1\nusemtl m\nf 1//1 2//1 3//1\nf 2/1 4/1 3/1\nf -1 -2 -3\n"),
    ("a.mtl", b"newmtl m\nKd 0.5 0.4 0.3\nKe 1 1 1\nd 0.5\nmap_Kd missing.png\n"),
    ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n1 1 0\n3 0 1 2\n3 1 3 2\n"),
    ("a.gltf", br#"{"asset":{"version":"2.0"},"scene":0,"scenes":[{"nodes":[0]}],"nodes":[{"mesh":0}],"meshes":[{"primitives":[{"attributes":{"POSITION":0}}]}],"accessors":[{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3","min":[0,0,0],"max":[1,1,0]}],"bufferViews":[{"buffer":0,"byteLength":36}],"buffers":[{"byteLength":36,"uri":"data:application/octet-stream;base64,AAAAAAAAAAAAAAAAAACAPwAAAAAAAAAAAAAAAAAAgD8AAAAA"}]}"#),
];

/// Scenes are saved under a few names, and opened from them and from files with bytes changed.
fn scene_files(w: &W, s: &mut Source) {
    let Some(scene) = scene(w, s) else { return };
    let path = format!("{}/{}.scene", w.folder, s.below(3));
    let name = c_text(&path);
    let watched = Watched::new(w, s);
    if s.one_in(2) {
        let result = ask!(bk_scene_save(scene.p(), name.as_ptr(), Some(progress), watched.user()));
        return watched.end("bk_scene_save", result);
    }
    let changed = format!("{path}-changed");
    let name = match std::fs::read(&path) {
        Ok(mut bytes) if s.one_in(3) && !bytes.is_empty() => {
            let at = s.below(bytes.len());
            bytes[at] ^= 1 << s.below(8);
            // A new file: scenes may have the old one mapped.
            let _ = std::fs::remove_file(&changed);
            std::fs::write(&changed, bytes).expect("the temporary folder can be written");
            c_text(&changed)
        }
        _ => name,
    };
    let mut params = defaults!(bk_open_params, bk_open_params_init);
    params.map = if s.one_in(8) { s.integer() } else { s.below(2) as u32 };
    params.ray_queues = if s.one_in(8) { s.integer() } else { s.below(2) as u32 };
    params.struct_size = if s.one_in(20) { s.integer() } else { params.struct_size };
    let params = if s.one_in(3) { null() } else { &raw const params };
    let result = ask!(bk_scene_open(scene.p(), name.as_ptr(), params, Some(progress), watched.user()));
    watched.end("bk_scene_open", result);
}

fn material(w: &W, s: &mut Source) {
    let Some(scene) = scene(w, s) else { return };
    let mut desc = defaults!(bk_material_desc, bk_material_desc_init);
    if s.one_in(2) {
        desc.flags = BK_MATERIAL_TWO_SIDED;
    }
    if s.one_in(3) {
        desc.emission = std::array::from_fn(|_| s.unit());
    }
    if s.one_in(4) {
        desc.albedo_texture = s.index();
        desc.alpha_cutoff = s.unit();
    }
    if s.one_in(6) {
        desc.transmission = [0.3; 3];
    }
    s.mutate(&mut desc);
    let mut id = 0;
    ask!(bk_scene_add_material(scene.p(), &desc, if s.one_in(2) { &mut id } else { null_mut() }));
}

/// A room, scattered triangles, or degenerate ones.
fn triangles(s: &mut Source, hostile: bool) -> (Vec<[f32; 3]>, Vec<[u32; 3]>) {
    match s.below(4) {
        0 => {
            let positions = (0..8).map(|i| [(i & 1) as f32, (i >> 1 & 1) as f32, (i >> 2) as f32]).collect();
            let quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]];
            (positions, quads.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).collect())
        }
        kind => {
            let vertices = 3 + s.below(30);
            let positions = (0..vertices)
                .map(|_| {
                    let mut p: [f32; 3] = std::array::from_fn(|_| s.unit() * 2.0);
                    if hostile {
                        p = s.point();
                    }
                    if kind == 3 { [p[0], 0.0, 0.0] } else { p }
                })
                .collect();
            let count = 1 + s.below(40);
            (positions, (0..count).map(|_| std::array::from_fn(|_| s.below(vertices) as u32)).collect())
        }
    }
}

fn mesh(w: &W, s: &mut Source) {
    if let Some(scene) = scene(w, s) {
        let hostile = s.one_in(3);
        add_mesh(&scene, s, hostile);
    }
}

fn add_mesh(scene: &Handle, s: &mut Source, hostile: bool) -> bk_result {
    let (positions, mut indices) = triangles(s, hostile);
    let n = positions.len();
    let mut desc = defaults!(bk_mesh_desc, bk_mesh_desc_init);
    (desc.positions, desc.vertex_count) = (positions.as_ptr().cast(), n);
    let vectors: Vec<[f32; 3]> = (0..n).map(|_| s.point()).collect();
    let uvs: Vec<[f32; 2]> =
        (0..n).map(|_| if s.one_in(200) { [s.float(); 2] } else { [s.unit(), s.unit()] }).collect();
    let pages: Vec<u32> = (0..indices.len()).map(|_| [0, 0, 1, 2][s.below(4)]).collect();
    let materials: Vec<u32> = (0..indices.len()).map(|_| if hostile { s.index() } else { 0 }).collect();
    if s.one_in(4) {
        desc.normals = vectors.as_ptr().cast();
    }
    if s.one_in(3) {
        desc.uvs = uvs.as_ptr().cast();
    }
    if s.one_in(3) {
        desc.lightmap_uvs = uvs.as_ptr().cast();
        if s.one_in(3) {
            desc.lightmap_page = pages.as_ptr();
        }
    }
    if hostile {
        if s.one_in(2) {
            desc.triangle_materials = materials.as_ptr();
        }
        desc.material = s.index();
        desc.flags = s.below(3) as u32;
        if s.one_in(8) {
            indices[0][s.below(3)] = s.integer();
        }
        match s.below(12) {
            0 => (desc.vertex_count, desc.positions) = (usize::MAX, null()),
            1 => desc.position_stride = s.below(12),
            2 => desc.uv_stride = usize::MAX,
            3 => desc.vertex_count = 0,
            4 => desc.struct_size = s.integer(),
            _ => {}
        }
    }
    (desc.indices, desc.triangle_count) = (indices.as_ptr().cast(), indices.len());
    if hostile && s.one_in(10) {
        (desc.triangle_count, desc.indices) = if s.one_in(2) { (0, null()) } else { (usize::MAX / 2, null()) };
    }
    let mut id = 0;
    let result = ask!(bk_scene_add_mesh(scene.p(), &desc, &mut id));
    if result == BK_OK {
        let mut meshes = scene.meshes.lock().unwrap();
        let count = meshes.len().max(id as usize + 1);
        meshes.resize(count, 0);
        meshes[id as usize] = n;
    }
    result
}

/// Mostly one that is accepted: axes that are nearly perpendicular.
fn transform(s: &mut Source) -> [f32; 12] {
    let mut columns = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0];
    columns[..9].iter_mut().for_each(|x| *x += 0.2 * (s.unit() - 0.5));
    columns[9..].copy_from_slice(&s.point());
    if s.one_in(8) {
        columns[s.below(12)] = s.float();
    }
    columns
}

fn instances(w: &W, s: &mut Source) {
    let Some(scene) = scene(w, s) else { return };
    for _ in 0..1 + s.below(3) {
        let (mesh, transform) = (s.index(), transform(s));
        let mut id = 0;
        let result = ask!(bk_scene_add_instance(scene.p(), mesh, transform.as_ptr(), &mut id));
        // 0: another thread has begun to commit the scene, or to load a file.
        let count = bk!(bk_scene_instance_count(scene.p()));
        if result == BK_OK && count > 0 && id >= count {
            broken("an instance's number is not below their count");
        }
    }
}

fn image(w: &W, s: &mut Source) {
    let Some(scene) = scene(w, s) else { return };
    let texels: Vec<f32> = (0..3 * 64).map(|_| if s.one_in(300) { s.float() } else { s.unit() }).collect();
    let mut desc = defaults!(bk_texture_desc, bk_texture_desc_init);
    desc.format = if s.one_in(8) { s.integer() } else { s.below(2) as u32 };
    (desc.width, desc.height) = (1 + s.below(8) as u32, 1 + s.below(8) as u32);
    desc.data = texels.as_ptr().cast();
    if s.one_in(5) {
        (desc.width, desc.height, desc.data) = (s.integer(), s.integer(), null());
    }
    if s.one_in(8) {
        desc.row_stride = s.below(11);
    }
    let id = &mut 0u32 as *mut u32;
    if s.one_in(2) {
        ask!(bk_scene_add_texture(scene.p(), &desc, if s.one_in(2) { null_mut() } else { id }));
    } else {
        if s.one_in(2) {
            desc.format = BK_TEXTURE_RGB32F;
        }
        ask!(bk_scene_add_environment(scene.p(), &desc, if s.one_in(2) { null_mut() } else { id }));
    }
}

fn light(w: &W, s: &mut Source) {
    if let Some(scene) = scene(w, s) {
        light_of(&scene, s);
    }
}

fn light_of(scene: &Handle, s: &mut Source) {
    let mut desc = defaults!(bk_light_desc, bk_light_desc_init);
    desc.r#type = 1 + s.below(5) as u32;
    desc.position = [0.5, 0.5, 0.6];
    desc.direction = [0.1, -1.0, 0.3];
    (desc.edge_u, desc.edge_v) = ([0.2, 0.0, 0.0], [0.0, 0.2, 0.0]);
    desc.angular_radius = if s.one_in(2) { 0.1 } else { 0.0 };
    desc.environment = if s.one_in(3) { s.index() } else { BK_NONE };
    s.mutate(&mut desc);
    let count = bk!(bk_scene_light_count(scene.p()));
    if count < 4 || s.one_in(10) {
        ask!(bk_scene_add_light(scene.p(), &desc, null_mut()));
    }
    ask!(bk_scene_set_light(scene.p(), if s.one_in(6) { s.index() } else { s.below(count as usize) as u32 }, &desc));
}

fn commit(w: &W, s: &mut Source) {
    let Some(scene) = scene(w, s) else { return };
    if s.one_in(2) {
        let mut params = defaults!(bk_build_params, bk_build_params_init);
        params.quality = s.below(2) as u32;
        params.compact = s.below(2) as u32;
        s.mutate(&mut params);
        ask!(bk_scene_set_build(scene.p(), &params));
    }
    if s.one_in(3) {
        ask!(bk_scene_commit(scene.p(), None, null_mut()));
        return;
    }
    let earlier = if s.one_in(3) { w.pick(Kind::Scene, s) } else { None };
    let watched = Watched::new(w, s);
    let result = match earlier {
        Some(earlier) => ask!(bk_scene_commit_from(scene.p(), earlier.p(), Some(progress), watched.user())),
        None => ask!(bk_scene_commit(scene.p(), Some(progress), watched.user())),
    };
    watched.end("bk_scene_commit or bk_scene_commit_from", result);
}

fn refit(w: &W, s: &mut Source) {
    let Some(scene) = scene(w, s) else { return };
    let meshes = scene.meshes.lock().unwrap().clone();
    for _ in 0..1 + s.below(2) {
        let mesh = if s.one_in(6) { s.index() } else { s.below(meshes.len()) as u32 };
        let n = meshes.get(mesh as usize).copied().unwrap_or(5);
        let positions: Vec<[f32; 3]> = (0..n).map(|_| s.point()).collect();
        let count = if s.one_in(20) { s.below(n + 1) } else { n };
        let stride = if s.one_in(20) { s.below(12) } else { 0 };
        ask!(bk_mesh_set_positions(scene.p(), mesh, positions.as_ptr().cast(), count, stride));
    }
    if s.one_in(2) {
        let transform = transform(s);
        let instance = s.index();
        ask!(bk_instance_set_transform(scene.p(), instance, transform.as_ptr()));
        let (mut mesh, mut back) = (7, [0f32; 12]);
        if ask!(bk_scene_get_instance(scene.p(), instance, &mut mesh, back.as_mut_ptr())) == BK_OK
            && mesh >= bk!(bk_scene_mesh_count(scene.p()))
        {
            broken("an instance names a mesh that does not exist");
        }
        ask!(bk_instance_share_light(scene.p(), instance, s.index()));
        let mut of = 0;
        if ask!(bk_instance_light_of(scene.p(), instance, &mut of)) == BK_OK && of > instance {
            broken("an instance shows the light of a later one");
        }
    }
    ask!(bk_scene_refit(scene.p()));
}

fn scene_numbers(w: &W, s: &mut Source) {
    let Some(scene) = scene(w, s) else { return };
    let mut stats = defaults!(bk_scene_stats, bk_scene_stats_init);
    if ask!(bk_scene_get_stats(scene.p(), &mut stats)) == BK_OK && stats.skipped_degenerate > stats.triangles {
        broken("more triangles are skipped than there are");
    }
    let (mut lower, mut upper) = ([0f32; 3], [0f32; 3]);
    let result = ask!(bk_scene_bounds(scene.p(), lower.as_mut_ptr(), upper.as_mut_ptr()));
    if result == BK_OK && !(0..3).all(|a| lower[a] <= upper[a] && lower[a] >= -1e12 && upper[a] <= 1e12) {
        broken(&format!("a scene's bounds are {lower:?} to {upper:?}"));
    }
    let count = bk!(bk_scene_mesh_count(scene.p()));
    let mesh = if s.one_in(4) { s.index() } else { s.below(count as usize) as u32 };
    let mut view = defaults!(bk_mesh_view, bk_mesh_view_init);
    // Another thread may move the triangles, which ends the life of the pointers.
    if ask!(bk_scene_get_mesh(scene.p(), mesh, &mut view)) == BK_OK && w.is_alone && !view.indices.is_null() {
        // SAFETY: valid until the next refit.
        let indices = unsafe { std::slice::from_raw_parts(view.indices, 3 * view.triangle_count) };
        if indices.iter().any(|&i| i as usize >= view.vertex_count) {
            broken("a mesh has a vertex that it has not");
        }
    }
    // As many of each as there are, or one behind them.
    let one_of = |count: u32, s: &mut Source| if s.one_in(4) { s.index() } else { s.below(count as usize) as u32 };
    let id = one_of(bk!(bk_scene_material_count(scene.p())), s);
    let mut material = defaults!(bk_material_desc, bk_material_desc_init);
    if ask!(bk_scene_get_material(scene.p(), id, &mut material)) == BK_OK && !(0.0..=1.0).contains(&material.albedo[0])
    {
        broken("a material reflects more than there is");
    }
    let id = one_of(bk!(bk_scene_light_count(scene.p())), s);
    let mut light = defaults!(bk_light_desc, bk_light_desc_init);
    if ask!(bk_scene_get_light(scene.p(), id, &mut light)) == BK_OK && !(1..=5).contains(&light.r#type) {
        broken("a light has no type");
    }
    let mut image = defaults!(bk_texture_desc, bk_texture_desc_init);
    let id = one_of(bk!(bk_scene_texture_count(scene.p())), s);
    if ask!(bk_scene_get_texture(scene.p(), id, &mut image)) == BK_OK {
        // SAFETY: valid while the scene lives, which is held.
        let texels = unsafe { std::slice::from_raw_parts(image.data.cast::<u8>(), image_bytes(&image, 4)) };
        std::hint::black_box(texels.iter().fold(0, |a, b| a ^ b));
    }
    let id = one_of(bk!(bk_scene_environment_count(scene.p())), s);
    if ask!(bk_scene_get_environment(scene.p(), id, &mut image)) == BK_OK {
        // SAFETY: as above; three floats per texel.
        let texels = unsafe { std::slice::from_raw_parts(image.data.cast::<f32>(), image_bytes(&image, 12) / 4) };
        if texels.iter().any(|t| !(*t >= 0.0 && t.is_finite())) {
            broken("a sky has light that is none");
        }
    }
}

fn image_bytes(image: &bk_texture_desc, per_texel: usize) -> usize {
    image.width as usize * image.height as usize * per_texel
}

fn ray(s: &mut Source) -> bk_ray {
    let mut ray = bk_ray {
        origin: std::array::from_fn(|_| s.unit()),
        tmin: 0.0,
        direction: std::array::from_fn(|_| s.unit() - 0.5),
        tmax: f32::INFINITY,
    };
    s.mutate(&mut ray);
    ray
}

fn check_hit(ray: &bk_ray, hit: &bk_hit, meshes: u32) {
    let is_miss =
        hit.t == f32::INFINITY && hit.u == 0.0 && hit.v == 0.0 && hit.mesh == BK_NONE && hit.triangle == BK_NONE;
    let weights = hit.u >= 0.0 && hit.v >= 0.0 && hit.u + hit.v <= 1.0 + 1e-5;
    // t of extreme directions is scaled, which rounds it once more, perhaps to tmin.
    let near = hit.t >= ray.tmin - 1e-6 * ray.tmin.abs() && hit.t <= ray.tmax + 1e-6 * ray.tmax.abs();
    let is_hit = weights && near && hit.mesh < meshes;
    if !(is_miss || is_hit) {
        broken(&format!("{ray:?} of a scene of {meshes} meshes gives {hit:?}"));
    }
}

/// What mesh numbers of hits are below. While another thread changes the scene, the count says 0.
fn mesh_bound(w: &W, scene: *const bk_scene) -> u32 {
    let count = bk!(bk_scene_mesh_count(scene));
    if count == 0 && !w.is_alone { BK_NONE } else { count }
}

fn rays(w: &W, s: &mut Source) {
    let Some(scene) = scene(w, s) else { return };
    let meshes = mesh_bound(w, scene.p());
    let mut hit = bk_hit { t: f32::NAN, u: 7.0, v: 7.0, triangle: 7, mesh: 7, instance: 7 };
    let one = ray(s);
    match s.below(8) {
        0..=2 => {
            bk!(bk_intersect(scene.p(), &one, &mut hit));
            check_hit(&one, &hit, meshes);
        }
        3 => {
            if !(0..=1).contains(&bk!(bk_occluded(scene.p(), &one))) {
                broken("bk_occluded gave neither 0 nor 1");
            }
        }
        kind => {
            let n = s.below(70);
            let rays: Vec<bk_ray> =
                (0..n).map(|_| if kind < 6 { bk_ray { origin: one.origin, ..ray(s) } } else { ray(s) }).collect();
            let mut hits = vec![hit; n];
            let mut shadows = vec![7u8; n];
            let flags = if s.one_in(10) { s.integer() } else { s.below(2) as u32 };
            let result = ask!(bk_intersect_many(scene.p(), rays.as_ptr(), n, flags, hits.as_mut_ptr()));
            if result == BK_OK {
                rays.iter().zip(&hits).for_each(|(r, h)| check_hit(r, h, meshes));
                if n > 0 && w.is_alone {
                    let i = s.below(n);
                    bk!(bk_intersect(scene.p(), &rays[i], &mut hit));
                    if bytemuck::bytes_of(&hit) != bytemuck::bytes_of(&hits[i]) {
                        broken(&format!("{:?} alone gives {hit:?}, among many {:?}", rays[i], hits[i]));
                    }
                }
            }
            let result = ask!(bk_occluded_many(scene.p(), rays.as_ptr(), n, flags, shadows.as_mut_ptr()));
            if result == BK_OK && shadows.iter().any(|&b| b > 1) {
                broken("bk_occluded_many gave neither 0 nor 1");
            }
            let directions: Vec<[f32; 3]> = rays.iter().map(|r| r.direction).collect();
            let (directions, out) = (directions.as_ptr().cast(), hits.as_mut_ptr());
            ask!(bk_gather(scene.p(), one.origin.as_ptr(), directions, n, one.tmax, flags, out));
            // Sizes that no memory has, arrays that overlap.
            ask!(bk_intersect_many(scene.p(), rays.as_ptr(), usize::MAX, 0, out));
            ask!(bk_occluded_many(scene.p(), null(), 1 + n, 0, shadows.as_mut_ptr()));
        }
    }
}

fn photons(w: &W, s: &mut Source) {
    let Some(scene) = scene(w, s) else { return };
    let mut params = defaults!(bk_photon_params, bk_photon_params_init);
    params.photon_count = 1 + s.below(3000) as u64;
    params.flags = s.below(2) as u32;
    params.max_bounces = s.below(4) as u32;
    s.mutate(&mut params);
    let mut out = std::ptr::dangling_mut();
    let watched = Watched::new(w, s);
    let result = ask!(bk_photon_map_create(scene.p(), &params, Some(progress), watched.user(), &mut out));
    watched.end("bk_photon_map_create", result);
    check_created("bk_photon_map_create", result, out.cast());
    if result == BK_OK {
        w.add(Handle::new(out, Kind::Photons, scene.life()));
    }
}

fn photon_numbers(w: &W, s: &mut Source) {
    let Some(map) = w.pick(Kind::Photons, s) else { return };
    let n = s.below(40);
    let positions: Vec<[f32; 3]> = (0..n).map(|_| s.point()).collect();
    let normals: Vec<[f32; 3]> =
        (0..n).map(|_| if s.one_in(10) { s.point() } else { [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]][s.below(2)] }).collect();
    let mut out = vec![f32::NAN; 3 * n];
    let (p, normals) = (positions.as_ptr().cast(), normals.as_ptr().cast());
    if ask!(bk_photon_map_estimate(map.p(), p, normals, n, out.as_mut_ptr())) == BK_OK {
        check_light("bk_photon_map_estimate", &out);
        if let Some(v) = out.iter().find(|v| **v > 1e30) {
            broken(&format!("bk_photon_map_estimate gave {v}"));
        }
    }
    let mut view = defaults!(bk_photon_view, bk_photon_view_init);
    if ask!(bk_photon_map_get_photons(map.p(), &mut view)) == BK_OK && view.count > 0 {
        // SAFETY: valid while the map lives.
        let power = unsafe { std::slice::from_raw_parts(view.power, 3 * view.count) };
        check_light("bk_photon_map_get_photons", power);
    }
}

fn lightmap(w: &W, s: &mut Source) {
    let Some(scene) = scene(w, s) else { return };
    let mut desc = defaults!(bk_lightmap_desc, bk_lightmap_desc_init);
    desc.page_size = [16, 24, 32, 64][s.below(4)];
    desc.texels_per_unit = if s.one_in(4) { 0.0 } else { 1.0 + 5.0 * s.unit() };
    desc.padding = 1 + s.below(3) as u32;
    (desc.gather_divisor, desc.radiance_divisor) = (1 + s.below(4) as u32, 1 + s.below(4) as u32);
    desc.both_sides = s.below(2) as u32;
    s.mutate(&mut desc);
    // The one pointer among them.
    let mut boxes = [0.0f32; 12];
    boxes.fill_with(|| if s.one_in(9) { s.float() } else { s.unit() });
    if s.one_in(2) {
        [3, 4, 5, 9, 10, 11].into_iter().for_each(|upper| boxes[upper] += 1.0);
    }
    desc.seen_from = if s.one_in(3) { boxes.as_ptr() } else { null() };
    desc.seen_from_count = if s.one_in(20) && desc.seen_from.is_null() { s.integer() } else { s.below(3) as u32 };
    if desc.seen_from.is_null() && !s.one_in(10) {
        desc.seen_from_count = 0;
    }
    if (129..=16_384).contains(&desc.page_size) {
        desc.page_size = 128;
    }
    let mut out = std::ptr::dangling_mut();
    let watched = Watched::new(w, s);
    let (name, result) = if s.one_in(4) {
        let from = path(w, s, "layout");
        let result =
            ask!(bk_lightmap_load_layout(scene.p(), &desc, from.as_ptr(), Some(progress), watched.user(), &mut out));
        ("bk_lightmap_load_layout", result)
    } else if let Some(earlier) = w.pick(Kind::Lightmap, s).filter(|_| s.one_in(4)) {
        let result =
            ask!(bk_lightmap_create_from(scene.p(), &desc, earlier.p(), Some(progress), watched.user(), &mut out));
        ("bk_lightmap_create_from", result)
    } else {
        let result = ask!(bk_lightmap_create(scene.p(), &desc, Some(progress), watched.user(), &mut out));
        ("bk_lightmap_create", result)
    };
    watched.end(name, result);
    check_created(name, result, out.cast());
    if result == BK_OK {
        w.add(Handle::new(out, Kind::Lightmap, scene.life()));
    }
}

fn info(lightmap: &Handle) -> Option<bk_lightmap_info> {
    let mut info = defaults!(bk_lightmap_info, bk_lightmap_info_init);
    (ask!(bk_lightmap_get_info(lightmap.p(), &mut info)) == BK_OK).then_some(info)
}

fn lightmap_numbers(w: &W, s: &mut Source) {
    let Some(lightmap) = w.pick(Kind::Lightmap, s) else { return };
    let mut text = vec![7u8; s.below(300)];
    let length = bk!(bk_plan_describe(lightmap.p(), text.as_mut_ptr().cast(), text.len()));
    if length > 0 && !text.is_empty() && CStr::from_bytes_until_nul(&text).is_err() {
        broken("bk_plan_describe wrote no NUL");
    }
    bk!(bk_plan_describe(lightmap.p(), null_mut(), 0));
    // Room for the largest mesh that this harness makes or loads.
    let (mut uvs, mut pages, mut own) = (vec![f32::NAN; 6 * 4096], vec![7u32; 4096], vec![7u8; 4096]);
    let mesh = s.index();
    let (uvs_p, pages_p) = (uvs.as_mut_ptr(), if s.one_in(3) { null_mut() } else { pages.as_mut_ptr() });
    let own = if s.one_in(3) { null_mut() } else { own.as_mut_ptr() };
    let result = match s.below(4) {
        0 => ask!(bk_lightmap_mesh_uvs(lightmap.p(), mesh, uvs_p, pages_p)),
        1 => ask!(bk_lightmap_mesh_back_uvs(lightmap.p(), mesh, uvs_p, pages_p, own)),
        2 => ask!(bk_lightmap_instance_uvs(lightmap.p(), mesh, uvs_p, pages_p)),
        _ => ask!(bk_lightmap_instance_back_uvs(lightmap.p(), mesh, uvs_p, pages_p, own)),
    };
    let is_wrong = |uv: &&f32| !(0.0..=1.0).contains(*uv);
    if result == BK_OK
        && let Some(uv) = uvs.iter().take_while(|uv| !uv.is_nan()).find(is_wrong)
    {
        broken(&format!("a light map coordinate is {uv}"));
    }
}

fn bake_params(w: &W, s: &mut Source) -> bk_bake_params {
    _ = w;
    let mut params = defaults!(bk_bake_params, bk_bake_params_init);
    params.photon_count = s.below(2000) as u64;
    params.gather_rays = [0, 1, 7, 64][s.below(4)];
    params.direct_samples = 1 + s.below(3) as u32;
    params.near_hits = [0.0, 2.0, 2.0, 9.0, f32::INFINITY][s.below(5)];
    params.own_rays = [0, 1, 64][s.below(3)];
    params.interpolation_error = [0.5, 1.0, f32::INFINITY][s.below(3)];
    params.interpolation_contrast = [0.1, 0.3, f32::INFINITY][s.below(3)];
    params.blur_radius = s.below(3) as u32;
    params.max_bounces = s.below(3) as u32;
    params.stitch = s.below(2) as u32;
    params.directional_indirect = s.below(2) as u32;
    params.directional_direct = s.below(2) as u32;
    params.passes = 1 + s.below(3) as u32;
    params.target_error = if s.one_in(4) { 10.0 } else { 0.0 };
    params.seed = s.next();
    if s.one_in(8) {
        let quality = if s.one_in(4) { s.integer() } else { s.below(2) as u32 };
        let result = ask!(bk_quality_set(quality, null_mut(), &mut params));
        if (result == BK_OK) != (quality < 4) {
            broken(&format!("bk_quality_set of {quality} gave {result}"));
        }
        params.photon_count = params.photon_count.min(2000);
        params.gather_rays = params.gather_rays.min(16);
    }
    params
}

fn bake(w: &W, s: &mut Source) {
    let Some(lightmap) = w.pick(Kind::Lightmap, s) else { return };
    let mut params = bake_params(w, s);
    if s.one_in(4) {
        params.texel_begin = s.below(100) as u64;
        params.texel_end = s.below(200) as u64;
    }
    s.mutate(&mut params);
    // Thousands of passes are allowed, and take as long.
    params.passes = if params.passes <= 4096 { params.passes.min(5) } else { params.passes };
    if params.target_error > 0.0 && params.target_error.is_finite() {
        params.target_error = params.target_error.max(10.0);
    }
    // The two pointers among them.
    let checkpoint = path(w, s, "checkpoint");
    let shares = c_text(&[format!("{}/shares-{}-", w.folder, s.below(2)), "/nonexistent/f".into()][s.below(8) / 7]);
    params.checkpoint = if s.one_in(4) { checkpoint.as_ptr() } else { null() };
    params.shares = if s.one_in(3) { shares.as_ptr() } else { null() };
    if !params.shares.is_null() && !s.one_in(4) {
        // More take as long.
        params.share_count = 1 + s.below(3) as u32;
        params.target_error = 0.0;
        bake_shares(&lightmap, &params, w, s);
    }
    let mut stats = defaults!(bk_bake_stats, bk_bake_stats_init);
    let out = if s.one_in(2) { &raw mut stats } else { null_mut() };
    let watched = Watched::new(w, s);
    let result = ask!(bk_bake(lightmap.p(), &params, Some(progress), watched.user(), out));
    watched.end("bk_bake", result);
}

/// Shares for a bake to read: all, or some.
fn bake_shares(lightmap: &Handle, params: &bk_bake_params, w: &W, s: &mut Source) {
    for stage in [BK_SHARE_PHOTONS, BK_SHARE_RADIANCE] {
        for share in 0..params.share_count {
            let (stage, share) = if s.one_in(12) { (s.integer(), s.integer()) } else { (stage, share) };
            let mut stats = defaults!(bk_bake_stats, bk_bake_stats_init);
            let out = if s.one_in(2) { &raw mut stats } else { null_mut() };
            let watched = Watched::new(w, s);
            let result = ask!(bk_bake_share(lightmap.p(), params, stage, share, Some(progress), watched.user(), out));
            watched.end("bk_bake_share", result);
        }
    }
}

/// A light map that follows a scene, live light that follows it, and what changed is baked.
fn edit(w: &W, s: &mut Source) {
    let Some(lightmap) = w.pick(Kind::Lightmap, s) else { return };
    let mut params = bake_params(w, s);
    if !s.one_in(4) {
        (params.target_error, params.passes) = (0.0, params.passes.min(2));
        // Otherwise there is light of other parameters, and all is baked.
        ask!(bk_bake(lightmap.p(), &params, None, null_mut(), null_mut()));
    }
    if let Some(scene) = w.pick(Kind::Scene, s) {
        let watched = Watched::new(w, s);
        let result = ask!(bk_lightmap_follow(lightmap.p(), scene.p(), Some(progress), watched.user()));
        watched.end("bk_lightmap_follow", result);
    }
    let keep_error = [0.0, 0.03, 1.0, -1.0, f32::NAN, f32::INFINITY][s.below(6)];
    if let Some(live) = w.pick(Kind::Live, s) {
        let watched = Watched::new(w, s);
        let result = ask!(bk_live_follow(live.p(), lightmap.p(), keep_error, Some(progress), watched.user()));
        watched.end("bk_live_follow", result);
    }
    let watched = Watched::new(w, s);
    let mut stats = defaults!(bk_bake_stats, bk_bake_stats_init);
    let result = ask!(bk_bake_changed(lightmap.p(), &params, keep_error, Some(progress), watched.user(), &mut stats));
    watched.end("bk_bake_changed", result);
    if result == BK_OK && !keep_error.is_finite() {
        broken("a keep_error that is not finite is accepted");
    }
    if let Some(earlier) = w.pick(Kind::Lightmap, s) {
        let watched = Watched::new(w, s);
        let params = bake_params(w, s);
        let result = ask!(bk_bake_changed_from(
            lightmap.p(),
            earlier.p(),
            &params,
            keep_error,
            Some(progress),
            watched.user(),
            &mut stats
        ));
        watched.end("bk_bake_changed_from", result);
        if result == BK_OK && (!keep_error.is_finite() || std::ptr::eq::<bk_lightmap>(lightmap.p(), earlier.p())) {
            broken("light of a light map is kept by itself, or with a keep_error that is not finite");
        }
    }
}

/// Bytes of a texel of a format, if it is one.
fn texel_bytes(format: u32) -> usize {
    match format & 0xff {
        BK_FORMAT_RGB32F => 12,
        BK_FORMAT_RGBA16F => 8,
        _ => 4,
    }
}

fn floats(bytes: &[u8]) -> Vec<f32> {
    bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect()
}

fn write(lightmap: &Handle, info: &bk_lightmap_info, s: &mut Source) {
    let layers: Vec<u32> =
        (0..s.below(4)).map(|_| if s.one_in(10) { s.integer() } else { s.below(12) as u32 }).collect();
    let format = if s.one_in(10) { s.integer() } else { 1 + s.below(2) as u32 };
    let (pages, size) = (info.page_count as usize, info.width as usize * info.height as usize);
    let value = if s.one_in(4) { s.float() } else { s.unit() };
    let texels = vec![value; 3 * layers.len() * pages * size];
    let p = texels.as_ptr().cast::<c_void>();
    ask!(bk_lightmap_write(lightmap.p(), layers.as_ptr(), layers.len(), format, p, None, null_mut()));
}

fn read(w: &W, s: &mut Source) {
    let Some(lightmap) = w.pick(Kind::Lightmap, s) else { return };
    let Some(info) = info(&lightmap) else { return };
    let page = if s.one_in(10) { s.index() } else { s.below(info.page_count as usize) as u32 };
    if s.one_in(8) {
        return write(&lightmap, &info, s);
    }
    let half = if s.one_in(8) { BK_LAYER_FIRST_HALF << s.below(2) } else { 0 };
    let layer = if s.one_in(20) { s.integer() } else { half | s.below(18) as u32 };
    let format = match layer {
        _ if s.one_in(10) => s.integer(),
        0..=3 => 1 + s.below(2) as u32,
        BK_LAYER_VALIDITY => BK_FORMAT_R32F,
        BK_LAYER_TRIANGLE | BK_LAYER_CHART => BK_FORMAT_R32U,
        BK_LAYER_RATIO_X..=BK_LAYER_DIRECTION if s.one_in(2) => BK_FORMAT_RGBA8,
        _ => BK_FORMAT_RGB32F,
    };
    let row = info.width as usize * texel_bytes(format);
    let stride = match s.below(10) {
        0 => s.below(row),
        1 => row + s.below(9),
        _ => 0,
    };
    let mut dst = vec![0u8; info.height as usize * row.max(stride) + 1];
    // At an odd address.
    let p = dst[1..].as_mut_ptr().cast::<c_void>();
    let result = ask!(bk_lightmap_read(lightmap.p(), page, layer, format, p, stride));
    if result == BK_OK && stride == 0 && format == BK_FORMAT_RGB32F && layer <= BK_LAYER_RADIANCE {
        check_light("bk_lightmap_read", &floats(&dst[1..]));
    }
    let is_ratio = (BK_LAYER_RATIO_X..=BK_LAYER_DIRECTION).contains(&layer);
    if result == BK_OK && stride == 0 && format == BK_FORMAT_RGB32F && layer == BK_LAYER_ERROR {
        check_light("bk_lightmap_read", &floats(&dst[1..]));
    }
    if result == BK_OK && stride == 0 && format == BK_FORMAT_RGB32F && is_ratio {
        let values = floats(&dst[1..]);
        if let Some(v) = values.iter().find(|v| !(v.abs() <= 1.001)) {
            broken(&format!("a ratio of light by direction is {v}"));
        }
    }
    if result == BK_OK && stride == 0 && layer == BK_LAYER_VALIDITY {
        let validity = floats(&dst[1..]);
        if let Some(v) = validity.iter().find(|v| ![0.0, 0.5, 1.0].contains(*v)) {
            broken(&format!("the validity of a texel is {v}"));
        }
    }
}

/// A file of this process, damaged now and then, or one that cannot be.
fn path(w: &W, s: &mut Source, name: &str) -> CString {
    if s.one_in(6) {
        return c_text(["/nonexistent/f", "/dev/full", "/dev/null", "", "/proc/x", "/"][s.below(6)]);
    }
    let path = format!("{}/{name}-{}", w.folder, s.below(2));
    if s.one_in(5)
        && let Ok(mut bytes) = std::fs::read(&path)
        && !bytes.is_empty()
    {
        let at = s.below(bytes.len());
        bytes[at] ^= 1 << s.below(8);
        if s.one_in(3) {
            bytes.truncate(at);
        }
        std::fs::write(&path, bytes).expect("the temporary folder can be written");
    }
    c_text(&path)
}

fn save(w: &W, s: &mut Source) {
    let Some(lightmap) = w.pick(Kind::Lightmap, s) else { return };
    let prefix = match s.below(6) {
        0 => c_text("/nonexistent/folder/x"),
        1 => c_text("/dev/full/"),
        2 => c_text("/proc/bakelite-"),
        3 => CString::new([0xc0, 0x80]).unwrap(),
        _ => c_text(&format!("{}/save-", w.folder)),
    };
    let format = if s.one_in(6) { s.integer() } else { 1 + s.below(3) as u32 };
    let watched = Watched::new(w, s);
    let result = match s.below(4) {
        3 => {
            let to = path(w, s, "layout");
            ask!(bk_lightmap_save_layout(lightmap.p(), to.as_ptr(), Some(progress), watched.user()))
        }
        0 => ask!(bk_lightmap_save(lightmap.p(), prefix.as_ptr(), format, Some(progress), watched.user())),
        1 => {
            let to = path(w, s, "result");
            ask!(bk_lightmap_save_result(lightmap.p(), to.as_ptr(), Some(progress), watched.user()))
        }
        _ => {
            let from = path(w, s, "result");
            ask!(bk_lightmap_load_result(lightmap.p(), from.as_ptr(), Some(progress), watched.user()))
        }
    };
    watched.end("a call of files", result);
}

fn live(w: &W, s: &mut Source) {
    let Some(lightmap) = w.pick(Kind::Lightmap, s) else { return };
    let mut params = defaults!(bk_live_params, bk_live_params_init);
    params.mode = s.below(3) as u32;
    params.lod_count = 1 + s.below(4) as u32;
    params.photon_count = s.below(2000) as u64;
    params.max_rounds = 1 + s.below(3) as u32;
    params.direct_samples = 1 + s.below(2) as u32;
    params.background = s.one_in(3) as u32;
    params.directional_indirect = s.one_in(3) as u32;
    params.directional_direct = s.one_in(3) as u32;
    params.cell_size = if s.one_in(4) { s.unit() } else { 0.0 };
    s.mutate(&mut params);
    if (2001..=1 << 32).contains(&params.photon_count) {
        params.photon_count = 2000;
    }
    if (9..=4096).contains(&params.direct_samples) {
        params.direct_samples = 8;
    }
    let mut out = std::ptr::dangling_mut();
    let watched = Watched::new(w, s);
    let (name, result) = if let Some(earlier) = w.pick(Kind::Live, s).filter(|_| s.one_in(3)) {
        let keep_error = [0.0, 0.03, 1.0, -1.0, f32::NAN, f32::INFINITY][s.below(6)];
        let (map, earlier) = (lightmap.p(), earlier.p());
        let result = ask!(bk_live_create_from(map, earlier, keep_error, Some(progress), watched.user(), &mut out));
        ("bk_live_create_from", result)
    } else {
        ("bk_live_create", ask!(bk_live_create(lightmap.p(), &params, Some(progress), watched.user(), &mut out)))
    };
    watched.end(name, result);
    check_created(name, result, out.cast());
    if result == BK_OK {
        w.add(Handle::new(out, Kind::Live, lightmap.life()));
    }
}

fn camera(s: &mut Source) -> bk_camera {
    let mut camera = defaults!(bk_camera, bk_camera_init);
    camera.position = std::array::from_fn(|_| s.unit());
    camera.forward = std::array::from_fn(|_| s.unit() - 0.5);
    s.mutate(&mut camera);
    camera
}

fn live_update(w: &W, s: &mut Source) {
    let Some(live) = w.pick(Kind::Live, s) else { return };
    let camera = camera(s);
    let mut budget = defaults!(bk_budget, bk_budget_init);
    budget.milliseconds = [0.0, 0.5, 2.0][s.below(3)];
    budget.rays = if s.one_in(2) { 0 } else { s.below(5000) as u64 };
    budget.max_dirty_bytes = [0, 0, 1024, 20_000][s.below(4)];
    s.mutate(&mut budget);
    // Seconds of work are no news.
    if budget.milliseconds.is_finite() && budget.milliseconds > 5.0 {
        budget.milliseconds = 5.0;
    }
    if budget.milliseconds == 0.0 && budget.rays > 5000 {
        budget.rays = 5000;
    }
    let mut stats = defaults!(bk_live_stats, bk_live_stats_init);
    if ask!(bk_live_update(live.p(), &camera, &budget, &mut stats)) == BK_OK {
        let parts = [stats.finished, stats.visible_finished];
        check_light("bk_live_update", &[stats.visible_error, stats.milliseconds]);
        if !parts.iter().all(|p| (0.0..=1.0).contains(p)) || stats.light_pending > 1 {
            broken(&format!("an update is finished to {parts:?}, light pending {}", stats.light_pending));
        }
        if budget.max_dirty_bytes > 0 && stats.dirty_bytes > budget.max_dirty_bytes {
            broken(&format!("an update gives out {} bytes, more than {}", stats.dirty_bytes, budget.max_dirty_bytes));
        }
    }
}

fn live_numbers(w: &W, s: &mut Source) {
    let Some(live) = w.pick(Kind::Live, s) else { return };
    match s.below(6) {
        0 => {
            let mut rects = [bk_rect { page: 0, lod: 0, x: 0, y: 0, width: 0, height: 0 }; 9];
            let (mut count, capacity) = (usize::MAX, s.below(10));
            let out = if capacity == 0 { null_mut() } else { rects.as_mut_ptr() };
            if ask!(bk_live_dirty_rects(live.p(), out, capacity, &mut count)) == BK_OK {
                if count > capacity {
                    broken("more rectangles than there is room for");
                }
                for r in &rects[..count] {
                    let ends = [r.x.checked_add(r.width), r.y.checked_add(r.height)];
                    if r.width == 0 || r.height == 0 || !ends.iter().all(|e| e.is_some_and(|e| e <= 128)) {
                        broken(&format!("a rectangle off the page: {:?}", [r.x, r.y, r.width, r.height]));
                    }
                }
            }
        }
        1 => {
            let mut info = defaults!(bk_cell_info, bk_cell_info_init);
            let mut lods = vec![0u8; s.below(20_000)];
            let out = if lods.is_empty() { null_mut() } else { lods.as_mut_ptr() };
            ask!(bk_live_cell_lods(live.p(), &mut info, out, lods.len()));
        }
        2 => {
            let p = s.point();
            let lod = bk!(bk_live_lod_at(live.p(), p.as_ptr()));
            if lod > 3 && lod != BK_NONE {
                broken(&format!("the LOD somewhere is {lod}"));
            }
        }
        3 => {
            ask!(bk_live_light_changed(live.p(), s.index()));
        }
        4 => {
            let paused = if s.one_in(8) { s.integer() } else { s.below(2) as u32 };
            ask!(bk_live_pause(live.p(), paused));
        }
        _ => live_read(&live, s),
    }
}

fn live_read(live: &Handle, s: &mut Source) {
    let mut rect = bk_rect {
        page: 0,
        lod: 0,
        x: s.below(20) as u32,
        y: s.below(20) as u32,
        width: s.below(16) as u32,
        height: s.below(16) as u32,
    };
    if s.one_in(4) {
        // What a rectangle of these sizes would take is there.
        (rect.x, rect.y) = (s.integer(), s.integer());
    }
    let format = match s.below(12) {
        0 => s.integer(),
        n => 1 + n as u32 % 2,
    };
    let layer = if s.one_in(8) { s.integer() } else { s.below(17) as u32 };
    let (whole, stride) = (s.one_in(4), if s.one_in(8) { s.below(400) } else { 0 });
    // Pages are at most 128 texels wide.
    let rows = if whole { 128 } else { 16 };
    let mut dst = vec![0u8; rows * (rows * 12).max(stride)];
    let (rect, lod, page) = (if whole { null() } else { &raw const rect }, s.index(), s.index());
    let result = ask!(bk_live_read(live.p(), page, lod, layer, format, rect, dst.as_mut_ptr().cast(), stride));
    if result == BK_OK && format == BK_FORMAT_RGB32F && stride == 0 && layer <= BK_LAYER_L0 {
        check_light("bk_live_read", &floats(&dst));
    }
}

fn live_files(w: &W, s: &mut Source) {
    let Some(live) = w.pick(Kind::Live, s) else { return };
    let file = path(w, s, "live");
    let watched = Watched::new(w, s);
    let result = if s.one_in(2) {
        ask!(bk_live_save(live.p(), file.as_ptr(), Some(progress), watched.user()))
    } else {
        ask!(bk_live_restore(live.p(), file.as_ptr(), Some(progress), watched.user()))
    };
    watched.end("a call of live files", result);
}

fn small_talk(_: &W, s: &mut Source) {
    if bk!(bk_version()) != BK_VERSION {
        broken("bk_version is not the header's");
    }
    let name = bk!(bk_result_string(s.integer() as i32));
    // SAFETY: never NULL, and constant.
    if unsafe { CStr::from_ptr(name) }.to_bytes().is_empty() {
        broken("a result has no name");
    }
    last_error();
}

/// NULL where a handle or a structure is wanted: an error, or nothing.
fn null_handles(s: &mut Source) {
    let failed = |result: bk_result| {
        if result == BK_OK {
            broken("a NULL handle was taken");
        }
    };
    let words = &mut [0u64; 64];
    match s.below(4) {
        0 => {
            bk!(bk_device_retain(null_mut()));
            bk!(bk_device_release(null_mut()));
            bk!(bk_scene_retain(null_mut()));
            bk!(bk_scene_release(null_mut()));
            bk!(bk_photon_map_retain(null_mut()));
            bk!(bk_photon_map_release(null_mut()));
            bk!(bk_lightmap_retain(null_mut()));
            bk!(bk_lightmap_release(null_mut()));
            bk!(bk_live_retain(null_mut()));
            bk!(bk_live_release(null_mut()));
            bk!(bk_device_desc_init(null_mut()));
            bk!(bk_mesh_desc_init(null_mut()));
        }
        1 => {
            failed(ask!(bk_device_create(null(), null_mut())));
            failed(ask!(bk_scene_create(null_mut(), words.as_mut_ptr().cast())));
            failed(ask!(bk_scene_commit(null_mut(), None, null_mut())));
            failed(ask!(bk_scene_commit_from(null_mut(), null(), None, null_mut())));
            failed(ask!(bk_scene_refit(null_mut())));
            failed(ask!(bk_scene_save(null_mut(), c"x".as_ptr(), None, null_mut())));
            failed(ask!(bk_scene_open(null_mut(), c"x".as_ptr(), null(), None, null_mut())));
            failed(ask!(bk_scene_bounds(null(), null_mut(), null_mut())));
            failed(ask!(bk_mesh_set_positions(null_mut(), 0, null(), 0, 0)));
            if bk!(bk_scene_mesh_count(null())) + bk!(bk_scene_light_count(null())) > 0 {
                broken("no scene has something");
            }
            if bk!(bk_device_isa(null())) + bk!(bk_device_num_threads(null())) > 0 {
                broken("no device has something");
            }
        }
        2 => {
            let mut hit = bk_hit { t: 0.0, u: 0.0, v: 0.0, triangle: 0, mesh: 0, instance: 0 };
            bk!(bk_intersect(null(), null(), &mut hit));
            bk!(bk_intersect(null(), null(), null_mut()));
            if hit.t != f32::INFINITY || bk!(bk_occluded(null(), null())) != 0 {
                broken("no scene is hit");
            }
            failed(ask!(bk_photon_map_create(null(), null(), None, null_mut(), words.as_mut_ptr().cast())));
            failed(ask!(bk_photon_map_get_photons(null(), null_mut())));
            failed(ask!(bk_photon_map_estimate(null(), null(), null(), 1, null_mut())));
        }
        _ => {
            failed(ask!(bk_lightmap_create(null(), null(), None, null_mut(), words.as_mut_ptr().cast())));
            failed(ask!(bk_lightmap_create_from(null(), null(), null(), None, null_mut(), words.as_mut_ptr().cast())));
            failed(ask!(bk_bake(null_mut(), null(), None, null_mut(), null_mut())));
            failed(ask!(bk_bake_changed(null_mut(), null(), 0.0, None, null_mut(), null_mut())));
            failed(ask!(bk_bake_changed_from(null_mut(), null(), null(), 0.0, None, null_mut(), null_mut())));
            failed(ask!(bk_bake_share(null(), null(), 0, 0, None, null_mut(), null_mut())));
            failed(ask!(bk_lightmap_follow(null_mut(), null(), None, null_mut())));
            failed(ask!(bk_live_follow(null_mut(), null(), 0.0, None, null_mut())));
            failed(ask!(bk_lightmap_read(null(), 0, 0, 1, null_mut(), 0)));
            failed(ask!(bk_lightmap_save(null(), null(), 1, None, null_mut())));
            failed(ask!(bk_lightmap_write(null_mut(), null(), 0, 1, null(), None, null_mut())));
            failed(ask!(bk_live_create(null_mut(), null(), None, null_mut(), words.as_mut_ptr().cast())));
            let live = words.as_mut_ptr().cast();
            failed(ask!(bk_live_create_from(null_mut(), null_mut(), 0.0, None, null_mut(), live)));
            failed(ask!(bk_live_update(null_mut(), null(), null(), null_mut())));
            failed(ask!(bk_live_save(null_mut(), null(), None, null_mut())));
            if bk!(bk_plan_describe(null(), null_mut(), 0)) != 0 || bk!(bk_live_lod_at(null(), null())) != BK_NONE {
                broken("no object says something");
            }
        }
    }
}

/// At the end of a sequence, when nothing is refused any more: every object still does what it is for.
pub fn still_work(w: &W, s: &mut Source) {
    let must = |what: &str, result: bk_result| {
        if result != BK_OK {
            broken(&format!("{what} fails with {result} at the end: {}", last_error()));
        }
    };
    w.grant_all();
    for scene in w.all(Kind::Scene) {
        let (mut lower, mut upper) = ([0f32; 3], [0f32; 3]);
        if bk!(bk_scene_bounds(scene.p(), lower.as_mut_ptr(), upper.as_mut_ptr())) == BK_OK {
            let mut hit = bk_hit { t: 0.0, u: 0.0, v: 0.0, triangle: 0, mesh: 0, instance: 0 };
            must("bk_intersect_many", bk!(bk_intersect_many(scene.p(), &ray(s), 1, BK_RAYS_PARALLEL, &mut hit)));
            continue;
        }
        let desc = defaults!(bk_material_desc, bk_material_desc_init);
        must("bk_scene_add_material", bk!(bk_scene_add_material(scene.p(), &desc, null_mut())));
        let (positions, indices) = ([0f32, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0], [0u32, 1, 2]);
        let mut desc = defaults!(bk_mesh_desc, bk_mesh_desc_init);
        (desc.positions, desc.vertex_count) = (positions.as_ptr(), 3);
        (desc.indices, desc.triangle_count) = (indices.as_ptr(), 1);
        must("bk_scene_add_mesh", bk!(bk_scene_add_mesh(scene.p(), &desc, null_mut())));
        must("bk_scene_commit", bk!(bk_scene_commit(scene.p(), None, null_mut())));
    }
    for lightmap in w.all(Kind::Lightmap) {
        let Some(info) = info(&lightmap) else { broken("bk_lightmap_info fails at the end") };
        if info.texels > 3000 || info.texels == 0 || info.width > 64 {
            continue;
        }
        let mut params = bake_params(w, s);
        params.photon_count = 200;
        params.gather_rays = 1;
        must("bk_bake", bk!(bk_bake(lightmap.p(), &params, None, null_mut(), null_mut())));
        let mut light = vec![f32::NAN; 3 * (info.width * info.height) as usize];
        let p = light.as_mut_ptr().cast();
        must("bk_lightmap_read", bk!(bk_lightmap_read(lightmap.p(), 0, 0, BK_FORMAT_RGB32F, p, 0)));
        check_light("bk_lightmap_read", &light);
    }
    for live in w.all(Kind::Live) {
        let camera = defaults!(bk_camera, bk_camera_init);
        let mut budget = defaults!(bk_budget, bk_budget_init);
        budget.rays = 64;
        // The first may still report what was refused to the work in the background.
        bk!(bk_live_update(live.p(), &camera, &budget, null_mut()));
        must("bk_live_update", bk!(bk_live_update(live.p(), &camera, &budget, null_mut())));
    }
}
