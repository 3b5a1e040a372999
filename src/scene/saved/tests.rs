use super::format::{Entry, Foot, Head, KINDS, Kind, SavedTree};
use super::*;
use crate::base::progress::Progress;
use crate::base::sampling::uniform;
use crate::bvh::{BuildOptions, BuildQuality};
use crate::device::{Device, DeviceOptions};
use crate::scene::{
    Environment, Instance, Light, LightmapUvs, Material, Mesh, MeshMaterials, Scene, SceneData, Texture,
};
use crate::trace::Ray;
use glam::{Affine3A, Quat, Vec2, Vec3};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A file of one test, removed at its end.
struct Place(PathBuf);

impl Place {
    fn new(name: &str) -> Place {
        Place(std::env::temp_dir().join(format!("bakelite-scene-{}-{name}", std::process::id())))
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.0);
    }
}

fn device() -> Arc<Device> {
    Device::new(DeviceOptions { num_threads: 2, ..Default::default() }).unwrap()
}

fn soup(triangles: u32, seed: u32, size: f32) -> Mesh {
    let corner = |i: u32, k: u32| Vec3::from_array([0, 1, 2].map(|a| uniform(i, 3 * k + a, seed)));
    let of = |i: u32| [0, 1, 2].map(|k| 4.0 * corner(i, 3) + size * corner(i, k));
    Mesh {
        positions: (0..triangles).flat_map(of).collect(),
        indices: (0..triangles).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect(),
        ..Default::default()
    }
}

/// A scene with all that a file can hold: degenerate triangles, and if asked instances.
fn data(instances: bool) -> SceneData {
    let mut data = SceneData::new();
    let rgba8 = vec![[255, 0, 0, 255], [0, 255, 0, 100], [9, 9, 9, 9], [1, 2, 3, 4], [5, 6, 7, 8], [0; 4]];
    let albedo_texture = data.add_texture(Texture { width: 3, height: 2, rgba8 }).unwrap();
    data.add_material(Material::default()).unwrap();
    let leaf = Material { albedo_texture, alpha_cutoff: 0.5, two_sided: true, ..Default::default() };
    data.add_material(leaf).unwrap();
    data.add_material(Material { emission: [1.0, 2.0, 3.0], transmission: [0.1; 3], ..Default::default() }).unwrap();
    let environment = data.add_environment(Environment::new(2, 1, vec![[1.0, 2.0, 3.0], [0.0, 0.5, 0.25]]).unwrap());
    for light in [
        Light::Point { position: Vec3::ONE, intensity: [1.0, 2.0, 3.0] },
        Light::Spot {
            position: Vec3::X,
            direction: Vec3::new(1.0, 2.0, -3.0),
            inner: 0.1,
            outer: 0.7,
            intensity: [4.0; 3],
        },
        Light::Directional { direction: Vec3::new(-1.0, -2.0, 0.3), irradiance: [5.0; 3], angular_radius: 0.01 },
        Light::Rect { position: Vec3::Y, edge_u: Vec3::X, edge_v: Vec3::new(0.1, 0.0, 2.0), radiance: [6.0; 3] },
        Light::Sky { radiance: [0.1; 3], environment, up: Vec3::new(0.2, 1.0, 0.1), rotation: 0.4 },
    ] {
        data.add_light(light).unwrap();
    }
    let mut first = soup(700, 1, 0.3);
    first.positions[4] = Vec3::NAN;
    first.normals = first.positions.iter().map(|_| Vec3::Z).collect();
    first.materials = MeshMaterials::PerTriangle((0..700).map(|i| i % 3).collect());
    data.add_mesh(first).unwrap();
    let mut second = soup(300, 2, 0.2);
    second.uvs = second.positions.iter().map(|p| Vec2::new(p.x, p.y)).collect();
    let uvs = second.positions.iter().map(|p| Vec2::new(p.x, p.y) / 9.0).collect();
    second.lightmap = Some(LightmapUvs { uvs, pages: (0..300).map(|i| i % 2).collect() });
    second.materials = MeshMaterials::One(1);
    second.strict = true;
    data.add_mesh(second).unwrap();
    if instances {
        let mut third = soup(200, 3, 0.4);
        third.positions[7] = third.positions[6];
        third.positions[8] = third.positions[6];
        let mesh = data.add_mesh(third).unwrap();
        for i in 0..5u32 {
            let turn = Quat::from_rotation_y(i as f32);
            let transform = Affine3A::from_scale_rotation_translation(Vec3::ONE, turn, Vec3::X * i as f32);
            data.add_instance(Instance::new(mesh, transform)).unwrap();
        }
        data.share_light(3, 1).unwrap();
        data.share_light(4, 3).unwrap();
    }
    data
}

fn rays() -> Vec<Ray> {
    let of = |i: u32| {
        let at = |k: u32| Vec3::from_array([0, 1, 2].map(|a| 5.0 * uniform(i, k + a, 9)));
        let (origin, end) = (at(0), at(3));
        Ray { origin: origin.into(), tmin: 0.0, direction: (end - origin).into(), tmax: f32::INFINITY }
    };
    (0..500).map(of).collect()
}

/// What can be compared of two scenes: all that rays hit, with the light that is there.
fn seen(scene: &Scene) -> String {
    let hit = |ray: &Ray| {
        let hit = scene.intersect(ray);
        format!("{:?} {:?}", hit, scene.occluded(ray))
    };
    let shared = (0..scene.instances().len() as u32).map(|i| format!("{i} shows {}", scene.light_of_instance(i)));
    shared.chain(rays().iter().map(hit)).collect::<Vec<_>>().join("\n")
}

fn commit(device: &Arc<Device>, data: SceneData, options: &BuildOptions) -> Arc<Scene> {
    Scene::commit(device, data, options, &Progress::none()).map_err(|e| e.1).unwrap()
}

fn open(device: &Arc<Device>, path: &Path, map: bool) -> crate::Result<Arc<Scene>> {
    Scene::open(device, path, &OpenOptions { map, ..Default::default() }, &Progress::none())
}

#[test]
fn an_opened_scene_is_the_one_that_was_saved() {
    let (place, device) = (Place::new("same"), device());
    let all = [
        (false, BuildOptions::default()),
        (true, BuildOptions::default()),
        (true, BuildOptions { compact: true, ..Default::default() }),
        (true, BuildOptions { quality: BuildQuality::High, ..Default::default() }),
        (false, BuildOptions { quality: BuildQuality::High, compact: true, ..Default::default() }),
    ];
    for (instances, options) in all {
        let mut scene = commit(&device, data(instances), &options);
        for refitted in [false, true] {
            if refitted {
                let mut moved: Vec<Vec3> = scene.meshes()[0].positions.iter().map(|p| *p * 1.1).collect();
                moved[9] = moved[10];
                moved[11] = moved[10];
                Scene::refit(&mut scene, &[(0, &moved)]).unwrap();
                scene.set_light(0, Light::Point { position: Vec3::Z, intensity: [7.0; 3] }).unwrap();
            }
            scene.save(&place.0, &Progress::none()).unwrap();
            for map in [true, false] {
                let mut again = open(&device, &place.0, map).unwrap();
                assert!(seen(&scene) == seen(&again), "{instances} {options:?} {refitted} {map}");
                assert!(format!("{:?}", scene.data) == format!("{:?}", again.data) || refitted);
                assert_eq!(*scene.lights(), *again.lights());
                assert!(scene.materials() == again.materials() && scene.instances() == again.instances());
                assert!(format!("{:?}", scene.emitters()) == format!("{:?}", again.emitters()));
                assert_eq!((scene.bounds(), scene.extent), (again.bounds(), again.extent));
                let (a, b) = (*scene.stats(), *again.stats());
                let counts = |s: &crate::scene::SceneStats| (s.triangles, s.skipped_degenerate, s.nodes, s.bvh_bytes);
                assert_eq!(counts(&a), counts(&b));
                assert_eq!((a.bytes, a.sah_cost, a.wide_sah_cost), (b.bytes, b.sah_cost, b.wide_sah_cost));
                assert_eq!(b.mapped_bytes > 0, map);
                assert!(b.mapped_bytes <= b.bytes);
                // A refit writes to what is mapped, and not to the file.
                let bytes = std::fs::read(&place.0).unwrap();
                let moved: Vec<Vec3> = again.meshes()[0].positions.iter().map(|p| *p + Vec3::X).collect();
                Scene::refit(&mut again, &[(0, &moved)]).unwrap();
                assert!(seen(&again) != seen(&scene) && bytes == std::fs::read(&place.0).unwrap());
            }
        }
    }
}

#[test]
fn only_what_is_in_memory_is_in_the_accounts() {
    let (place, device) = (Place::new("accounts"), device());
    let scene = commit(&device, data(true), &BuildOptions::default());
    scene.save(&place.0, &Progress::none()).unwrap();
    drop(scene);
    let memory = device.memory().clone();
    assert_eq!(memory.current(), 0);
    let mapped = open(&device, &place.0, true).unwrap();
    let (held, stats) = (memory.current() as u64, *mapped.stats());
    assert!(
        held < stats.bytes - stats.mapped_bytes + 20_000 && stats.mapped_bytes > stats.bytes / 2,
        "{held} {stats:?}"
    );
    drop(mapped);
    let read = open(&device, &place.0, false).unwrap();
    assert_eq!(memory.current() as u64, read.stats().bytes);
    drop(read);
    assert_eq!(memory.current(), 0);
}

/// Changes a file and makes its checksums fit again.
fn forge(file: &[u8], change: impl FnOnce(&mut Vec<u8>, &mut Vec<Entry>)) -> Vec<u8> {
    let foot_at = file.len() - size_of::<Foot>();
    let mut foot: Foot = bytemuck::pod_read_unaligned(&file[foot_at..]);
    let head: Head = bytemuck::pod_read_unaligned(&file[..size_of::<Head>()]);
    let table = foot.table as usize;
    let mut entries: Vec<Entry> =
        file[table..foot_at].chunks_exact(size_of::<Entry>()).map(bytemuck::pod_read_unaligned).collect();
    let mut content = file[..table].to_vec();
    change(&mut content, &mut entries);
    for e in &mut entries {
        if let Some(section) = content.get(e.offset as usize..(e.offset + e.bytes) as usize) {
            e.checksum = crc32fast::hash(section);
        }
    }
    foot.table = content.len() as u64;
    content.extend_from_slice(bytemuck::cast_slice(&entries));
    foot.bytes = (content.len() + size_of::<Foot>()) as u64;
    foot.sections = entries.len() as u32;
    foot.checksum = foot.checksum_with(&head, &entries);
    content.extend_from_slice(bytemuck::bytes_of(&foot));
    content
}

#[test]
fn damage_anywhere_is_refused() {
    let (place, device) = (Place::new("damaged"), device());
    for compact in [false, true] {
        let scene = commit(&device, data(true), &BuildOptions { compact, ..Default::default() });
        scene.save(&place.0, &Progress::none()).unwrap();
        let file = std::fs::read(&place.0).unwrap();
        let refused = |bytes: &[u8]| {
            std::fs::write(&place.0, bytes).unwrap();
            for map in [false, true] {
                let Err(e) = open(&device, &place.0, map) else { return false };
                let e = e.to_string();
                assert!(e.contains("damaged") || e.contains("scene file"), "{e}");
            }
            true
        };
        assert!(!refused(&file));
        for cut in [0, 1, 15, 40, 4095, 5000, file.len() / 2, file.len() - 41, file.len() - 1] {
            assert!(refused(&file[..cut]), "{cut}");
        }
        assert!(refused(&[&file[..], &[0]].concat()));
        // Gaps between sections alone may hold anything.
        let foot: Foot = bytemuck::pod_read_unaligned(&file[file.len() - size_of::<Foot>()..]);
        let entries: Vec<Entry> = file[foot.table as usize..file.len() - size_of::<Foot>()]
            .chunks_exact(size_of::<Entry>())
            .map(bytemuck::pod_read_unaligned)
            .collect();
        let in_section = |i: usize| entries.iter().any(|e| (e.offset..e.offset + e.bytes).contains(&(i as u64)));
        for i in (0..16).chain((16..file.len()).step_by(1009)).chain(foot.table as usize..file.len()) {
            let mut bytes = file.clone();
            bytes[i] ^= 4;
            let is_gap = i >= 16 && i < foot.table as usize && !in_section(i);
            assert_eq!(refused(&bytes), !is_gap, "byte {i}");
        }
    }
}

#[test]
fn files_with_right_checksums_and_wrong_content_are_refused_or_harmless() {
    let (place, device) = (Place::new("forged"), device());
    let rays = rays();
    let mut opened = 0;
    for (compact, quality) in
        [(false, BuildQuality::Default), (true, BuildQuality::Default), (true, BuildQuality::High)]
    {
        let scene = commit(&device, data(true), &BuildOptions { compact, quality, ..Default::default() });
        scene.save(&place.0, &Progress::none()).unwrap();
        let file = std::fs::read(&place.0).unwrap();
        let mut random = 0u32;
        let mut next = |below: usize| {
            random += 1;
            (uniform(random, 7, 5) as f64 * below as f64) as usize
        };
        for round in 0..600 {
            let bytes = forge(&file, |content, entries| {
                // A word of a section, most often of one that says where others are.
                let kinds =
                    [Kind::Nodes, Kind::CompactNodes, Kind::Trees, Kind::CompactLeaves, Kind::Leaves, Kind::Indices];
                let wanted = match round % 4 {
                    0 => next(KINDS as usize) as u32 + 1,
                    _ => kinds[next(kinds.len())] as u32,
                };
                let Some(e) = entries.iter().find(|e| e.kind == wanted) else { return };
                let at = e.offset as usize + 4 * next(e.bytes as usize / 4);
                let word = u32::from_le_bytes(content[at..at + 4].try_into().unwrap());
                let new = match next(6) {
                    0 => 0,
                    1 => u32::MAX,
                    2 => word ^ 1 << next(32),
                    3 => word.wrapping_add(1),
                    4 => f32::NAN.to_bits(),
                    _ => f32::INFINITY.to_bits(),
                };
                content[at..at + 4].copy_from_slice(&new.to_le_bytes());
            });
            std::fs::write(&place.0, bytes).unwrap();
            // What is opened can be used.
            if let Ok(mut scene) = open(&device, &place.0, round % 2 == 0) {
                opened += 1;
                let mut hits = vec![scene.intersect(&rays[0]); rays.len()];
                scene.intersect_many(&rays, true, &mut hits).unwrap();
                seen(&scene);
                if let Some(mesh) = scene.meshes().first() {
                    let positions = mesh.positions.to_vec();
                    let _ = Scene::refit(&mut scene, &[(0, &positions)]);
                }
                scene.save(&place.0, &Progress::none()).unwrap();
            }
        }
    }
    assert!(opened > 100, "{opened}");
}

#[test]
fn what_lies_elsewhere_or_twice_is_refused() {
    let (place, device) = (Place::new("table"), device());
    commit(&device, data(false), &BuildOptions::default()).save(&place.0, &Progress::none()).unwrap();
    let file = std::fs::read(&place.0).unwrap();
    type Change = fn(&mut Vec<u8>, &mut Vec<Entry>);
    let changes: [Change; 9] = [
        |_, entries| entries[1].offset = entries[0].offset,
        |_, entries| entries[1].offset += 4,
        |_, entries| entries[1].kind = entries[0].kind,
        |_, entries| entries[1].kind = KINDS + 1,
        |_, entries| entries[1].kind = 0,
        |_, entries| entries[1].bytes = u64::MAX,
        |_, entries| entries.last_mut().unwrap().bytes += 4096,
        |_, entries| _ = entries.remove(2),
        |content, entries| {
            let e = entries.iter().find(|e| e.kind == Kind::Trees as u32).unwrap();
            let at = e.offset as usize + std::mem::offset_of!(SavedTree, nodes);
            content[at] -= 1;
        },
    ];
    for (i, change) in changes.into_iter().enumerate() {
        std::fs::write(&place.0, forge(&file, change)).unwrap();
        assert!(open(&device, &place.0, true).is_err(), "{i}");
    }
    std::fs::write(&place.0, forge(&file, |_, _| ())).unwrap();
    assert!(open(&device, &place.0, true).is_ok());
}

#[test]
fn a_cancelled_or_refused_call_leaves_the_old_file_and_no_scene() {
    let (place, device) = (Place::new("cancel"), device());
    let scene = commit(&device, data(false), &BuildOptions::default());
    std::fs::write(&place.0, "old").unwrap();
    assert_eq!(scene.save(&place.0, &Progress::new(|_, _| false)), Err(crate::Error::Cancelled));
    assert_eq!(std::fs::read(&place.0).unwrap(), b"old");
    assert!(open(&device, &place.0, true).err().unwrap().to_string().contains("no scene file"));
    scene.save(&place.0, &Progress::none()).unwrap();
    let cancelled = Scene::open(&device, &place.0, &OpenOptions::default(), &Progress::new(|_, _| false));
    assert_eq!(cancelled.err(), Some(crate::Error::Cancelled));
    let e = open(&device, Path::new("/nowhere/x"), true).err().unwrap();
    assert!(e.to_string().contains("/nowhere/x"));
}
