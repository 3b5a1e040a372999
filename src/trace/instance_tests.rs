use crate::base::progress::Progress;
use crate::base::sampling::{uniform, uniform_sphere};
use crate::bvh::{BuildOptions, BuildQuality};
use crate::device::{Device, DeviceOptions};
use crate::scene::{Instance, Material, Mesh, MeshMaterials, NONE, Scene, SceneData, Texture};
use crate::simd::Isa;
use crate::trace::offset::{SurfacePoint, offset_ray_origin};
use crate::trace::single::Walk;
use crate::trace::{Hit, PACKET_SIZE, Packet, RawHit, Ray};
use glam::{Affine3A, Mat3, Quat, Vec2, Vec3};
use std::f32::consts::FRAC_PI_2;
use std::mem::MaybeUninit;
use std::sync::Arc;

fn vector(i: u32, dimension: u32, seed: u32) -> Vec3 {
    Vec3::from_array([0, 1, 2].map(|a| uniform(i, dimension + a, seed))) * 2.0 - 1.0
}

/// Triangles around the origin.
fn soup(n: u32, seed: u32, material: u32) -> Mesh {
    let corners = |i: u32| {
        let a = vector(i, 0, seed);
        [a, a + 0.4 * vector(i, 3, seed), a + 0.4 * vector(i, 6, seed)]
    };
    Mesh {
        positions: (0..n).flat_map(corners).collect(),
        indices: (0..n).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect(),
        uvs: (0..3 * n).map(|i| Vec2::new(uniform(i, 9, seed), uniform(i, 10, seed)) * 3.0).collect(),
        materials: MeshMaterials::One(material),
        ..Default::default()
    }
}

fn transform(i: u32, seed: u32) -> Affine3A {
    let turn =
        Quat::from_axis_angle(uniform_sphere([uniform(i, 20, seed), uniform(i, 21, seed)]), 6.0 * uniform(i, 22, seed));
    let scale = (0.7 * vector(i, 23, seed)).exp();
    Affine3A::from_scale_rotation_translation(scale, turn, 2.5 * vector(i, 26, seed))
}

/// Solid, cut-out and transmissive meshes; two of five stand in the scene as they are, the others `copies` times.
fn data(copies: u32, only_instances: bool) -> SceneData {
    let mut data = SceneData::new();
    let solid = data.add_material(Material::default()).unwrap();
    let stripes = Texture { width: 2, height: 1, rgba8: vec![[255, 255, 255, 0], [255; 4]] };
    let albedo_texture = data.add_texture(stripes).unwrap();
    let hole = data.add_material(Material { albedo_texture, alpha_cutoff: 0.5, ..Default::default() }).unwrap();
    let sheet = Material { transmission: [0.5; 3], albedo: [0.2; 3], two_sided: true, ..Default::default() };
    let sheet = data.add_material(sheet).unwrap();
    if !only_instances {
        data.add_mesh(soup(60, 1, solid)).unwrap();
        data.add_mesh(soup(20, 2, hole)).unwrap();
    }
    for (seed, material, n) in [(3, solid, 80), (4, hole, 40), (5, sheet, 40)] {
        let mut mesh = soup(n, seed, material);
        // One that no tree holds.
        mesh.indices[7] = [1; 3];
        let mesh = data.add_mesh(mesh).unwrap();
        for i in 0..copies {
            data.add_instance(Instance::new(mesh, transform(i, seed))).unwrap();
        }
    }
    data
}

fn flattened(data: &SceneData) -> SceneData {
    let mut flat = SceneData::new();
    for texture in data.textures() {
        flat.add_texture(Texture::clone(texture)).unwrap();
    }
    data.materials().iter().for_each(|m| _ = flat.add_material(*m).unwrap());
    data.flattened().iter().for_each(|m| _ = flat.add_mesh(m.clone()).unwrap());
    flat
}

fn commit(isa: Isa, build: BuildOptions, data: &SceneData) -> Arc<Scene> {
    let options = DeviceOptions { isa: Some(isa), num_threads: 1, ..Default::default() };
    let device = Device::new(options).unwrap();
    Scene::commit(&device, data.clone(), &build, &Progress::none()).map_err(|e| e.1).unwrap()
}

fn builds() -> impl Iterator<Item = (Isa, BuildOptions)> {
    let compact = BuildOptions { compact: true, ..Default::default() };
    let high = BuildOptions { quality: BuildQuality::High, ..Default::default() };
    Isa::available().flat_map(move |isa| [BuildOptions::default(), compact, high].map(|b| (isa, b)))
}

/// Rays from one place, from places near one another, and from anywhere.
fn rays(seed: u32) -> Vec<Ray> {
    let direction = |i: u32| uniform_sphere([uniform(i, 0, seed), uniform(i, 1, seed)]);
    let ray = |i: u32| {
        let origin = match i % 3 {
            0 => Vec3::new(0.2, 3.0, 0.1),
            1 => Vec3::splat(-2.0) + 0.1 * vector(i, 2, seed),
            _ => 4.0 * vector(i, 2, seed),
        };
        let ray = Ray::new(origin, direction(i) * if i.is_multiple_of(11) { 1e-9 } else { 1.0 });
        if i.is_multiple_of(7) { ray.within(0.5, 4.0) } else { ray }
    };
    let mut rays: Vec<Ray> = (0..2400).map(ray).collect();
    rays.sort_by_key(|r| r.origin[1].to_bits());
    rays[3].direction = [f32::NAN; 3];
    rays[4].direction = [0.0; 3];
    rays
}

fn bits(h: &RawHit) -> [u32; 4] {
    [h.t.to_bits(), h.u.to_bits(), h.v.to_bits(), h.triangle]
}

#[test]
fn instances_are_hit_where_copies_of_their_mesh_are() {
    for (copies, only_instances) in [(6, true), (7, false)] {
        let (data, rays) = (data(copies, only_instances), rays(8));
        let flat = commit(Isa::Portable, BuildOptions::default(), &flattened(&data));
        for (isa, build) in builds() {
            let scene = commit(isa, build, &data);
            assert_eq!(scene.triangle_count(), flat.triangle_count());
            let (mut met, mut others) = (0, 0);
            for ray in &rays {
                let (a, b) = (scene.intersect_raw(ray), flat.intersect_raw(ray));
                let same = a.triangle == b.triangle
                    && a.front == b.front
                    && (a.is_miss()
                        || (a.t - b.t).abs() <= 1e-5 * (b.t.abs() + 1.0 / Vec3::from(ray.direction).length()));
                others += u32::from(!same);
                met += u32::from(!b.is_miss());
                let light = scene.transmittance(ray) - flat.transmittance(ray);
                others += u32::from(light != Vec3::ZERO);
            }
            // Transformed rays have other roundings: at edges they hit what is beside or behind.
            assert!(met > 200 && others <= 4, "{isa:?} {build:?}: {others} of {met}");
        }
    }
}

#[test]
fn all_queries_give_the_same_bits() {
    for only_instances in [false, true] {
        all_queries_agree(&data(7, only_instances));
    }
}

fn all_queries_agree(data: &SceneData) {
    let rays = rays(9);
    let mut expected: Option<Vec<RawHit>> = None;
    for (isa, build) in builds() {
        let scene = commit(isa, build, data);
        let single: Vec<RawHit> = rays.iter().map(|r| scene.intersect_raw(r)).collect();
        let occluded: Vec<u8> = rays.iter().map(|r| scene.occluded(r) as u8).collect();
        many_rays_agree(&scene, &rays, &single, &occluded);
        assert!(occluded.iter().zip(&single).all(|(&any, hit)| (any == 1) != hit.is_miss()));

        let mut many = vec![Hit::MISS; rays.len()];
        scene.intersect_many(&rays, true, &mut many).unwrap();
        for (hit, raw) in many.iter().zip(&single) {
            assert_eq!(*hit, scene.to_hit(*raw));
            if hit.instance != NONE {
                assert_eq!(scene.instances()[hit.instance as usize].mesh, hit.mesh);
                let object = scene.object_of_instance(hit.instance);
                assert_eq!(scene.first_triangle(object) + hit.triangle, raw.triangle);
            }
        }
        assert!(many.iter().filter(|h| h.instance != NONE).count() > 200);

        let origin = Vec3::new(0.2, 3.0, 0.1);
        let mut packet = Packet { count: PACKET_SIZE, ..Default::default() };
        for i in 0..PACKET_SIZE {
            let d = uniform_sphere([uniform(i as u32, 0, 5), uniform(i as u32, 1, 5)]);
            (packet.x[i], packet.y[i], packet.z[i]) = (d.x, d.y, d.z);
        }
        let mut of_packet = [RawHit::MISS; PACKET_SIZE];
        scene.gather_packet(origin, &packet, 0.0, 50.0, &mut of_packet);
        for (i, hit) in of_packet.iter().enumerate() {
            let ray = Ray::new(origin, Vec3::new(packet.x[i], packet.y[i], packet.z[i])).within(0.0, 50.0);
            assert_eq!(*hit, scene.intersect_raw(&ray));
        }
        // Spatial splits change which of several triangles on an edge is hit, and the portable lanes round products.
        if build.quality == BuildQuality::Default && isa != Isa::Portable {
            let expected = expected.get_or_insert(single.clone());
            let differing = single.iter().zip(expected).filter(|(a, b)| *a != *b).count();
            assert_eq!(differing, 0, "{isa:?} {build:?}");
        }
    }
}

fn many_rays_agree(scene: &Scene, rays: &[Ray], single: &[RawHit], occluded: &[u8]) {
    let isa = scene.device().isa();
    let mut hits = vec![RawHit::MISS; rays.len()];
    scene.intersect_stream(rays, &mut hits);
    assert!(hits == single, "{isa:?}");
    scene.intersect_block(rays, &mut hits);
    assert!(hits == single, "{isa:?}");
    let mut any = vec![2; rays.len()];
    scene.occluded_stream(rays, &mut any);
    assert!(any == occluded, "{isa:?}");
    scene.occluded_block(rays, &mut any);
    assert!(any == occluded, "{isa:?}");
}

/// Checks rays together against rays alone, and these against the same scene without instances; returns how many hit
/// something.
fn check(data: &SceneData, rays: &[Ray]) -> usize {
    let flat = commit(Isa::Portable, BuildOptions::default(), &flattened(data));
    let mut met = 0;
    for (isa, build) in builds() {
        let scene = commit(isa, build, data);
        let single: Vec<RawHit> = rays.iter().map(|r| scene.intersect_raw(r)).collect();
        let occluded: Vec<u8> = rays.iter().map(|r| scene.occluded(r) as u8).collect();
        many_rays_agree(&scene, rays, &single, &occluded);
        let others = rays.iter().zip(&single).filter(|(ray, hit)| flat.intersect_raw(ray).triangle != hit.triangle);
        // Transformed rays have other roundings.
        assert!(others.count() <= rays.len() / 500, "{isa:?} {build:?}");
        met = single.iter().filter(|hit| !hit.is_miss()).count();
    }
    met
}

#[test]
fn rays_of_a_camera_hit_instances_as_rays_alone() {
    // From farther away than the boxes' margin is made for, too.
    for distance in [7.0, 2000.0] {
        let place = Vec3::new(0.3, -0.2, -distance);
        let ray = |i: u32| {
            // Tiles of 8 x 8 pixels; some rays end early.
            let (tile, pixel) = (i / 64, i % 64);
            let (x, y) = (8 * (tile % 8) + pixel % 8, 8 * (tile / 8) + pixel / 8);
            let ray = Ray::new(place, Vec3::new(x as f32 / 64.0 - 0.48, y as f32 / 64.0 - 0.49, distance / 7.0));
            if i.is_multiple_of(5) { ray.within(0.0, 7.0 + (uniform(i, 0, 3) - 1.0) * 7.0 / distance) } else { ray }
        };
        let rays: Vec<Ray> = (0..64 * 64).map(ray).collect();
        assert!(check(&data(9, true), &rays) > 400);
    }
}

#[test]
fn rays_that_are_scaled_in_instances_hit_them_as_copies() {
    for scale in [1e-8, 1e8f32] {
        let mut data = SceneData::new();
        let material = data.add_material(Material::default()).unwrap();
        for seed in [3, 4] {
            let mut mesh = soup(60, seed, material);
            mesh.positions.iter_mut().for_each(|p| *p /= scale);
            let mesh = data.add_mesh(mesh).unwrap();
            let transform = transform(seed, 9) * Affine3A::from_scale(Vec3::splat(scale));
            data.add_instance(Instance::new(mesh, transform)).unwrap();
        }
        let rays: Vec<Ray> = (0..6000).map(|i| Ray::new(4.0 * vector(i, 0, 2), vector(i, 3, 2))).collect();
        assert!(check(&data, &rays) > 100);
    }
}

#[test]
fn rays_whose_lists_find_no_room_at_instances_hit_them_as_rays_alone() {
    let mut data = SceneData::new();
    let material = data.add_material(Material::default()).unwrap();
    // Little in a large box, so that rays meet thousands of boxes.
    let mut mesh = soup(2, 6, material);
    let corners: [Vec3; 2] = [Vec3::splat(-1.0), Vec3::ONE];
    for (i, p) in mesh.positions.iter_mut().enumerate() {
        *p = corners[i / 3] + 0.01 * vector(i as u32, 40, 1);
    }
    let mesh = data.add_mesh(mesh).unwrap();
    for i in 0..5000 {
        data.add_instance(Instance::new(mesh, Affine3A::from_translation(0.05 * vector(i, 0, 8)))).unwrap();
    }
    let ray = |i: u32| {
        let target = Vec3::splat(if i.is_multiple_of(4) { 1.0 } else { 0.0 }) + 0.1 * vector(i, 3, 7);
        let origin = Vec3::new(0.1, 0.2, -3.0) + 0.01 * vector(i, 6, 7);
        Ray::new(origin, target - origin)
    };
    let rays: Vec<Ray> = (0..1024).map(ray).collect();
    let scene = commit(Isa::best(), BuildOptions::default(), &data);
    let single: Vec<RawHit> = rays.iter().map(|r| scene.intersect_raw(r)).collect();
    let occluded: Vec<u8> = rays.iter().map(|r| scene.occluded(r) as u8).collect();
    many_rays_agree(&scene, &rays, &single, &occluded);
    assert!(occluded.iter().filter(|&&o| o == 1).count() > 20);
}

#[test]
fn no_ray_enters_the_box_of_an_instance_behind_what_it_hits_there() {
    let corner = |i: u32| Vec3::from_array([0, 1, 2].map(|a| (i >> a & 1) as f32 - 0.5));
    let faces = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let cube = Mesh {
        positions: (0..8).map(corner).collect(),
        indices: faces.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).collect(),
        ..Default::default()
    };
    let shear = Mat3::from_cols(Vec3::X, Vec3::new(9.0, 1.0, 0.0), Vec3::new(0.0, 4.0, 1.0));
    let turns = [Mat3::IDENTITY, Mat3::from_rotation_y(0.5), Mat3::from_rotation_x(FRAC_PI_2), shear];
    for turn in turns {
        let mut data = SceneData::new();
        data.add_material(Material::default()).unwrap();
        let mesh = data.add_mesh(cube.clone()).unwrap();
        let transform = Affine3A::from_mat3_translation(turn, Vec3::splat(3.0));
        data.add_instance(Instance::new(mesh, transform)).unwrap();
        for isa in Isa::available() {
            let scene = commit(isa, BuildOptions::default(), &data);
            let instances = scene.instance_trees().unwrap();
            let bounds = scene.bounds();
            let mut met = 0;
            for i in 0..40_000 {
                // From far away, rays graze the sides of the box.
                let (a, distance) = (i as usize % 3, 4f32.powi((i / 3 % 8) as i32));
                let mut target = bounds.0 + (bounds.1 - bounds.0) * (0.5 + 0.5 * vector(i, 0, 5));
                target[a] = [bounds.0[a], bounds.1[a]][i as usize & 1];
                let mut direction = uniform_sphere([uniform(i, 5, 5), uniform(i, 6, 5)]);
                direction[a] *= 0.03;
                let ray = Ray::new(target - distance * direction, direction);
                let hit = scene.intersect_raw(&ray);
                if hit.is_miss() {
                    continue;
                }
                met += 1;
                let mut place = MaybeUninit::uninit();
                assert!(Walk::begin_in_boxes(&mut place, &ray.within(0.0, hit.t), 0, instances.margin));
                // SAFETY: it has begun.
                let walk = unsafe { place.assume_init_mut() };
                assert_eq!(scene.kernels().next_box(&instances.top, walk, hit.t), 0, "{isa:?} {turn} {i}");
            }
            assert!(met > 3000, "{met}");
        }
    }
}

#[test]
fn instances_that_move_are_hit_where_they_are_then() {
    let rays = rays(10);
    for (isa, build) in builds() {
        let mut moved = data(5, false);
        let mut scene = commit(isa, build, &moved);
        let held = scene.clone();
        let before: Vec<_> = rays.iter().map(|r| bits(&scene.intersect_raw(r))).collect();
        let positions: Vec<Vec3> = moved.meshes()[3].positions.iter().map(|p| 1.3 * *p).collect();
        let places: Vec<_> = [0, 3, 11].map(|i| (i, transform(i, 77))).to_vec();
        Scene::refit_with(&mut scene, &[(3, &positions)], &places).unwrap();
        assert!(rays.iter().map(|r| bits(&held.intersect_raw(r))).eq(before));

        // The same scene, described anew.
        let mut other = SceneData::new();
        for texture in moved.textures() {
            other.add_texture(Texture::clone(texture)).unwrap();
        }
        moved.materials().iter().for_each(|m| _ = other.add_material(*m).unwrap());
        for (m, mesh) in moved.meshes().iter().enumerate() {
            let positions = if m == 3 { positions.clone() } else { mesh.positions.to_vec() };
            other.add_mesh(Mesh { positions: positions.into(), ..mesh.clone() }).unwrap();
        }
        for (i, instance) in (0..).zip(moved.instances()) {
            let transform = places.iter().find(|p| p.0 == i).map_or(instance.transform, |p| p.1);
            other.add_instance(Instance { transform, ..*instance }).unwrap();
        }
        moved = other;
        let anew = commit(isa, build, &moved);
        let differing = rays.iter().filter(|r| bits(&scene.intersect_raw(r)) != bits(&anew.intersect_raw(r))).count();
        assert!(differing <= if build.quality == BuildQuality::High { 2 } else { 0 }, "{isa:?} {build:?}: {differing}");
        assert!(scene.bounds().0.distance(anew.bounds().0) < 1e-5);
    }
}

#[test]
fn instances_that_vanish_come_back_and_unmoved_trees_stay() {
    let rays = rays(12);
    for (isa, build) in builds() {
        let described = data(3, false);
        let mut scene = commit(isa, build, &described);
        let before: Vec<_> = rays.iter().map(|r| scene.intersect_raw(r)).collect();
        let nowhere: Vec<Vec<Vec3>> =
            described.meshes()[2..].iter().map(|m| vec![Vec3::ZERO; m.positions.len()]).collect();
        let gone: Vec<(u32, &[Vec3])> = (2..).zip(&nowhere).map(|(m, p)| (m, &p[..])).collect();
        Scene::refit(&mut scene, &gone).unwrap();
        assert!(rays.iter().all(|r| scene.to_hit(scene.intersect_raw(r)).instance == NONE));
        assert!(scene.bounds().0.is_finite() && scene.bounds().1.is_finite());
        assert_eq!(scene.stats().skipped_degenerate, 80 + 40 + 40);
        let back: Vec<(u32, &[Vec3])> =
            (2..).zip(&described.meshes()[2..]).map(|(m, p)| (m, &p.positions[..])).collect();
        Scene::refit(&mut scene, &back).unwrap();
        assert_eq!(scene.stats().skipped_degenerate, 3);
        let after = rays.iter().map(|r| scene.intersect_raw(r));
        let differing = after.zip(&before).filter(|(a, b)| a != *b).count();
        assert!(differing <= if build.quality == BuildQuality::High { 2 } else { 0 }, "{isa:?} {build:?}: {differing}");
    }
}

/// The largest coordinate that placing an instance goes through bounds the precision of its surface.
#[test]
fn rays_from_instances_do_not_hit_them_again_however_far_their_mesh_is_from_its_origin() {
    for far in [0.0, 1e2, 1e4, 1e5] {
        let offset = far * Vec3::new(1.0, -0.7, 0.9);
        let mut data = SceneData::new();
        let material = data.add_material(Material::default()).unwrap();
        let mut mesh = soup(200, 21, material);
        mesh.positions.iter_mut().for_each(|p| *p += offset);
        let mesh = data.add_mesh(mesh).unwrap();
        for i in 0..4 {
            let turn = Affine3A::from_quat(transform(i, 5).to_scale_rotation_translation().1);
            let back = Affine3A::from_translation(3.0 * vector(i, 3, 4) - turn.transform_vector3(offset));
            data.add_instance(Instance::new(mesh, back * turn)).unwrap();
        }
        let scene = commit(Isa::Portable, BuildOptions::default(), &data);
        let mut tested = 0;
        for (i, ray) in (0..).zip(rays(13)) {
            let hit = scene.intersect_raw(&ray);
            let corners = if hit.is_miss() { continue } else { scene.corners(hit.triangle) };
            let point = SurfacePoint::new(corners, hit.u, hit.v, &scene);
            let away = uniform_sphere([uniform(i, 40, 1), uniform(i, 41, 1)]);
            let side = point.normal * if away.dot(point.normal) > 0.0 { 1.0 } else { -1.0 };
            if away.dot(side) < 0.1 {
                continue;
            }
            let next = scene.intersect_raw(&Ray::new(offset_ray_origin(point.interior, side, &scene), away));
            assert!(next.triangle != hit.triangle, "{far}: t = {}", next.t);
            tested += 1;
        }
        assert!(tested > 50, "{far}: {tested}");
    }
}

/// Boxes of instances beyond the greatest coordinate are in no tree.
#[test]
fn scenes_of_which_nothing_can_be_hit_are_refused() {
    let far = Affine3A::from_translation(Vec3::splat(1e12));
    for (isa, build) in builds() {
        let mut data = SceneData::new();
        let material = data.add_material(Material::default()).unwrap();
        let mesh = data.add_mesh(soup(20, 3, material)).unwrap();
        data.add_instance(Instance::new(mesh, far)).unwrap();
        let device = Device::new(DeviceOptions { isa: Some(isa), num_threads: 1, ..Default::default() }).unwrap();
        match Scene::commit(&device, data.clone(), &build, &Progress::none()) {
            Ok(scene) => panic!("{isa:?} {build:?}: a scene with bounds {:?}", scene.bounds()),
            Err((_, e)) => assert!(e.to_string().contains("beyond 1e12"), "{e}"),
        }
        // One that is met, which then goes where the other is, by its transform and by its mesh; and both at once back.
        data.add_instance(Instance::new(mesh, transform(1, 3))).unwrap();
        let mut scene = commit(isa, build, &data);
        let at_end = vec![Vec3::splat(1e12); data.meshes()[0].positions.len()];
        let positions = &data.meshes()[0].positions[..];
        let gone: Vec<Vec3> = positions.iter().map(|&p| 0.5e12 * (p + 1.5)).collect();
        let half = Affine3A::from_translation(Vec3::splat(0.9e12));
        for (moved, placed) in [
            (&[][..], &[(1, far)][..]),
            (&[(0, &at_end[..])], &[]),
            (&[(0, &gone[..])], &[(1, half)]),
            // What no tree holds stays out wherever it goes.
            (&[], &[(0, transform(1, 3)), (1, far)]),
        ] {
            let e = Scene::refit_with(&mut scene, moved, placed).expect_err(&format!("{isa:?} {build:?}")).to_string();
            assert!(e.contains("beyond 1e12"), "{e}");
            assert_eq!(scene.stats().refits, 0);
        }
        let small: Vec<Vec3> = positions.iter().map(|&p| 0.1 * p).collect();
        Scene::refit_with(&mut scene, &[(0, &small)], &[(1, transform(2, 3))]).unwrap();
        assert!(scene.bounds().0.cmple(scene.bounds().1).all());
    }
}

#[test]
fn refused_moves_of_instances_change_nothing() {
    let mut scene = commit(Isa::Portable, BuildOptions::default(), &data(2, false));
    let mirrored = Affine3A::from_scale(Vec3::new(-1.0, 1.0, 1.0));
    for (place, culprit) in [((0, mirrored), "mirrors"), ((6, Affine3A::IDENTITY), "instance 6 does not exist")] {
        let good = (1, Affine3A::from_translation(Vec3::X));
        let e = Scene::refit_with(&mut scene, &[], &[good, place]).unwrap_err().to_string();
        assert!(e.contains(culprit), "{e}");
        assert_eq!((scene.stats().refits, scene.instances()[1].transform), (0, transform(1, 3)));
    }
}

#[test]
fn what_instances_share_takes_memory_once() {
    let mesh = |data: &mut SceneData, n| {
        let material = data.add_material(Material::default()).unwrap();
        data.add_mesh(soup(n, 3, material)).unwrap()
    };
    let mut once = SceneData::new();
    mesh(&mut once, 5000);
    let once = commit(Isa::Portable, BuildOptions::default(), &once);
    let mut many = SceneData::new();
    let mesh = mesh(&mut many, 5000);
    for i in 0..100 {
        many.add_instance(Instance::new(mesh, transform(i, 3))).unwrap();
    }
    let many = commit(Isa::Portable, BuildOptions::default(), &many);
    assert_eq!(many.stats().triangles, 100 * once.stats().triangles);
    assert!(many.stats().bytes < once.stats().bytes + 100 * 300, "{:?} {:?}", many.stats(), once.stats());
    assert_eq!(many.device().memory().current() as u64, many.stats().bytes);
}
