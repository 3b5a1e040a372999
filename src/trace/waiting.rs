//! Rays through a tree in parts, at which they wait for others: see [`crate::scene::waiting`]. Each ray goes from part to
//! part, nearest first, up to its best hit. Hits are those of the whole tree, bit for bit.

use super::Ray;
use super::instances::Answer;
use super::single::Walk;
use super::tree::beyond;
use crate::base::geometry::NONE;
use crate::bvh::ChildRef;
use crate::bvh::instances::Margin;
use crate::bvh::parts::Part;
use crate::scene::Scene;
use crate::scene::waiting::{self, WaitingRays};
use std::mem::MaybeUninit;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

/// Least number of rays that wait; fewer are traced at once. (The pages that they need are read while other threads go on.)
const LEAST: usize = 32;

/// Rays that were given to a query together.
struct Batch<A> {
    /// The scene, which exists as long as rays wait.
    scene: *const Scene,
    rays: Mutex<Rays<A>>,
    /// No ray waits any more.
    is_done: Condvar,
    alike: bool,
}

// SAFETY: the query that made the batch keeps the scene until no ray waits, and other threads use it no longer than that; a
// scene can be used on any thread.
unsafe impl<A: Send> Send for Batch<A> {}
// SAFETY: as above; the rest is behind a mutex.
unsafe impl<A: Send> Sync for Batch<A> {}

struct Rays<A> {
    rays: Vec<Ray>,
    answers: Vec<A>,
    /// The parts that each ray meets, nearest first, ray by ray.
    parts: Vec<u32>,
    /// Place among `parts` where each ray's begin, and where the last one's end.
    begin: Vec<u32>,
    /// Number of its parts that each ray has done with.
    done: Vec<u32>,
    /// The part where each ray waits; [`NONE`]: nowhere any more.
    at: Vec<u32>,
    /// Number of rays that wait.
    waiting: usize,
    /// Whether a panic has ended the tracing.
    has_failed: bool,
}

impl<A: Answer> Rays<A> {
    /// Goes on to the next part of a ray that may change its answer.
    fn go_on(&mut self, ray: usize, all: &[Part]) -> u32 {
        let (first, end) = (self.begin[ray] as usize, self.begin[ray + 1] as usize);
        self.at[ray] = NONE;
        if let Some(tmax) = self.answers[ray].tmax(&self.rays[ray]) {
            let limit = f64::from(beyond(beyond(tmax)));
            for i in first + self.done[ray] as usize..end {
                let part = self.parts[i];
                self.done[ray] += 1;
                if begins(&self.rays[ray], &all[part as usize]) <= limit {
                    self.at[ray] = part;
                    break;
                }
            }
        }
        self.at[ray]
    }
}

/// Where a ray that meets a part's box enters it, or before.
fn begins(ray: &Ray, part: &Part) -> f64 {
    let (lower, upper) = part.bounds;
    let mut t = f64::NEG_INFINITY;
    for a in 0..3 {
        let (o, d) = (f64::from(ray.origin[a]), f64::from(ray.direction[a]));
        let near = f64::from(if d > 0.0 { lower[a] } else { upper[a] });
        if d != 0.0 {
            t = t.max((near - o) / d);
        }
    }
    t
}

impl<A: Answer> Batch<A> {
    /// `None` if there is not enough memory.
    fn new(scene: &Scene, parts: &WaitingRays, rays: &[Ray], alike: bool, answers: &[A]) -> Option<Batch<A>> {
        let mut all = Rays {
            rays: copy(rays)?,
            answers: copy(answers)?,
            parts: Vec::new(),
            begin: with_capacity(rays.len() + 1)?,
            done: with_capacity(rays.len())?,
            at: with_capacity(rays.len())?,
            waiting: 0,
            has_failed: false,
        };
        all.done.resize(rays.len(), 0);
        all.at.resize(rays.len(), NONE);
        let mut place = MaybeUninit::uninit();
        for (ray, answer) in rays.iter().zip(answers) {
            all.begin.push(u32::try_from(all.parts.len()).ok()?);
            let Some(tmax) = answer.tmax(ray) else { continue };
            if !Walk::begin_in_boxes(&mut place, ray, 0, Margin::NONE) {
                continue;
            }
            // SAFETY: it has begun.
            let walk = unsafe { place.assume_init_mut() };
            loop {
                let part = scene.kernels().next_box(&parts.tree.top, walk, tmax);
                if part == NONE {
                    break;
                }
                all.parts.try_reserve(1).ok()?;
                all.parts.push(part);
            }
        }
        all.begin.push(u32::try_from(all.parts.len()).ok()?);
        for ray in 0..rays.len() {
            all.waiting += usize::from(all.go_on(ray, &parts.tree.parts) != NONE);
        }
        Some(Batch { scene, rays: Mutex::new(all), is_done: Condvar::new(), alike })
    }

    fn lock(&self) -> MutexGuard<'_, Rays<A>> {
        self.rays.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn with_capacity<T>(count: usize) -> Option<Vec<T>> {
    let mut v = Vec::new();
    v.try_reserve_exact(count).ok()?;
    Some(v)
}

fn copy<T: Copy>(all: &[T]) -> Option<Vec<T>> {
    let mut v = with_capacity(all.len())?;
    v.extend_from_slice(all);
    Some(v)
}

/// Calls `each` with each part among those where rays wait, and the number of these.
fn count(mut parts: Vec<u32>, each: &mut dyn FnMut(u32, usize)) {
    parts.sort_unstable();
    for run in parts.chunk_by(|a, b| a == b) {
        if run[0] != NONE {
            each(run[0], run.len());
        }
    }
}

impl<A: Answer + Send + 'static> waiting::Batch for Batch<A> {
    fn prepare(&self, part: u32) {
        let all = self.lock();
        if all.waiting == 0 {
            return;
        }
        // SAFETY: rays wait, and the query can go on only when it has the lock: the scene is there.
        let scene = unsafe { &*self.scene };
        if let Some(parts) = scene.parts() {
            scene.acceleration().0.will_need(&parts.tree.parts[part as usize]);
        }
    }

    fn visit(&self, part: u32, go_on: &mut dyn FnMut(u32, usize)) {
        let mut all = self.lock();
        if all.waiting == 0 {
            return;
        }
        // SAFETY: as in `prepare`.
        let scene = unsafe { &*self.scene };
        let Some(parts) = scene.parts() else { return };
        let here: Vec<u32> = (0..).zip(&all.at).filter(|(_, at)| **at == part).map(|(ray, _)| ray).collect();
        let turned = |&number: &u32| {
            let ray = all.rays[number as usize];
            Ray { tmax: all.answers[number as usize].tmax(&ray).unwrap_or(0.0), ..ray }
        };
        let rays: Vec<Ray> = here.iter().map(turned).collect();
        let mut found = vec![A::MISS; rays.len()];
        let root = parts.tree.parts[part as usize].root;
        A::trace(scene, scene.whole_tree(), root, &rays, self.alike, &mut found);
        let mut next = Vec::with_capacity(here.len());
        for (&ray, &found) in here.iter().zip(&found) {
            all.answers[ray as usize].add(found, 0);
            next.push(all.go_on(ray as usize, &parts.tree.parts));
        }
        all.waiting -= next.iter().filter(|&&part| part == NONE).count();
        count(next, go_on);
        if all.waiting == 0 {
            self.is_done.notify_all();
        }
    }

    fn fail(&self) {
        let mut all = self.lock();
        (all.waiting, all.has_failed) = (0, true);
        self.is_done.notify_all();
    }
}

impl Scene {
    /// Adds what rays find in the parts of the tree, if it is in parts, to `answers`, which hold what they find near its
    /// root: as many as both slices have. `alike`: whether the rays are those of a stream.
    #[inline]
    pub(super) fn meet_parts<A: Answer + Send + 'static>(&self, rays: &[Ray], alike: bool, answers: &mut [A]) {
        if let Some(parts) = self.parts() {
            let n = rays.len().min(answers.len());
            self.wait_at_parts(parts, &rays[..n], alike, &mut answers[..n]);
        }
    }

    fn wait_at_parts<A: Answer + Send + 'static>(
        &self,
        parts: &WaitingRays,
        rays: &[Ray],
        alike: bool,
        answers: &mut [A],
    ) {
        let batch = if rays.len() < LEAST { None } else { Batch::new(self, parts, rays, alike, answers) };
        let Some(batch) = batch else {
            for (ray, answer) in rays.iter().zip(answers) {
                if let Some(tmax) = answer.tmax(ray) {
                    let mut found = [A::MISS];
                    A::trace(self, self.whole_tree(), ChildRef::ROOT, &[Ray { tmax, ..*ray }], false, &mut found);
                    answer.add(found[0], 0);
                }
            }
            return;
        };
        let batch = Arc::new(batch);
        let mut first = Vec::new();
        count(batch.lock().at.clone(), &mut |part, rays| first.push((part, rays)));
        let shared: Arc<dyn waiting::Batch> = batch.clone();
        parts.bring(&shared, first.into_iter());
        let mut all = batch.lock();
        while all.waiting > 0 {
            all = batch.is_done.wait(all).unwrap_or_else(PoisonError::into_inner);
        }
        assert!(!all.has_failed, "a thread that traced these rays has panicked");
        answers.copy_from_slice(&all.answers);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::progress::Progress;
    use crate::base::sampling::{uniform, uniform_sphere};
    use crate::bvh::{BuildOptions, BuildQuality};
    use crate::device::{Device, DeviceOptions};
    use crate::scene::{Material, Mesh, MeshMaterials, OpenOptions, SceneData, Texture};
    use crate::simd::Isa;
    use crate::trace::{PACKET_SIZE, Packet, RawHit};
    use glam::{Vec2, Vec3};

    /// Small triangles in a cube, and a few that are as large as all of it, one of them with holes.
    fn data() -> SceneData {
        let mut data = SceneData::new();
        let (hole, solid) = ([255, 255, 255, 0], [255; 4]);
        let albedo_texture = data.add_texture(Texture { width: 2, height: 1, rgba8: vec![hole, solid] }).unwrap();
        data.add_material(Material::default()).unwrap();
        data.add_material(Material { albedo_texture, alpha_cutoff: 0.5, ..Default::default() }).unwrap();
        let point = |i: u32, k: u32| Vec3::from_array([0, 1, 2].map(|a| 10.0 * uniform(i, k + a, 1)));
        for (count, size, material) in [(4000, 0.04, 0), (3, 1.0, 0), (2, 0.7, 1)] {
            let corners = |i: u32| [0, 3, 6].map(|k| point(i + count, 9) * (1.0 - size) + size * point(i, k));
            let mesh = Mesh {
                positions: (0..count).flat_map(corners).collect(),
                indices: (0..count).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect(),
                uvs: (0..count).flat_map(|_| [Vec2::ZERO, Vec2::X, Vec2::Y]).collect(),
                materials: MeshMaterials::One(material),
                ..Default::default()
            };
            data.add_mesh(mesh).unwrap();
        }
        data
    }

    fn rays(seed: u32) -> Vec<Ray> {
        let ray = |i: u32| {
            let u = |k: u32| uniform(i, k, seed);
            // Some start at one place, and some are short.
            let origin = if i.is_multiple_of(4) { Vec3::splat(5.0) } else { 10.0 * Vec3::new(u(0), u(1), u(2)) };
            let ray = Ray::new(origin, uniform_sphere([u(3), u(4)]) * (0.5 + u(5)));
            if i.is_multiple_of(7) { ray.within(0.01, 1.0) } else { ray }
        };
        let mut rays: Vec<Ray> = (0..600).map(ray).collect();
        rays[3].direction = [0.0, 0.0, 1.0];
        rays[5].direction = [0.0; 3];
        rays[6].origin[1] = f32::NAN;
        rays
    }

    fn bits(hit: &RawHit) -> [u32; 4] {
        [hit.t.to_bits(), hit.u.to_bits(), hit.v.to_bits(), hit.triangle]
    }

    /// Compares what many rays hit in a scene in parts with what each hits alone in the whole one.
    fn compare(scene: &Scene, whole: &Scene, seed: u32) {
        let rays = rays(seed);
        let hits: Vec<_> = rays.iter().map(|ray| whole.intersect_raw(ray)).collect();
        let expected: Vec<_> = hits.iter().map(bits).collect();
        let occluded: Vec<_> = rays.iter().map(|ray| u8::from(whole.occluded(ray))).collect();
        let (mut found, mut any) = (vec![RawHit::MISS; rays.len()], vec![2; rays.len()]);
        for trace in [Scene::intersect_stream, Scene::intersect_block] {
            trace(scene, &rays, &mut found);
            assert!(found.iter().map(bits).eq(expected.iter().copied()));
        }
        for trace in [Scene::occluded_stream, Scene::occluded_block] {
            trace(scene, &rays, &mut any);
            assert_eq!(any, occluded);
        }
        assert!(hits.iter().filter(|hit| !hit.is_miss()).count() > 100);
        let directions = |i: usize| uniform_sphere([uniform(i as u32, 0, seed), uniform(i as u32, 1, seed)]);
        let mut packet = Packet { count: PACKET_SIZE, ..Default::default() };
        (0..PACKET_SIZE).for_each(|i| [packet.x[i], packet.y[i], packet.z[i]] = directions(i).to_array());
        let (mut of_packet, mut alone) = ([RawHit::MISS; PACKET_SIZE], [RawHit::MISS; PACKET_SIZE]);
        scene.gather_packet(Vec3::splat(4.0), &packet, 0.0, 9.0, &mut of_packet);
        whole.gather_packet(Vec3::splat(4.0), &packet, 0.0, 9.0, &mut alone);
        assert!(of_packet.iter().map(bits).eq(alone.iter().map(bits)));
        for (ray, hit) in rays.iter().zip(&expected).take(50) {
            assert_eq!((bits(&scene.intersect_raw(ray)), scene.occluded(ray)), (*hit, whole.occluded(ray)));
        }
    }

    /// A batch whose visits panic.
    struct Broken(std::sync::mpsc::Sender<()>);

    impl waiting::Batch for Broken {
        fn prepare(&self, _: u32) {}

        fn visit(&self, _: u32, _: &mut dyn FnMut(u32, usize)) {
            panic!("as expected");
        }

        fn fail(&self) {
            self.0.send(()).unwrap();
        }
    }

    #[test]
    fn a_panic_while_rays_are_traced_ends_the_wait_for_them_and_no_other() {
        let path = std::env::temp_dir().join(format!("bakelite-broken-{}", std::process::id()));
        let device = Device::new(DeviceOptions { num_threads: 1, ..Default::default() }).unwrap();
        let options = BuildOptions::default();
        let whole = Scene::commit(&device, data(), &options, &Progress::none()).map_err(|e| e.1).unwrap();
        whole.save(&path, &Progress::none()).unwrap();
        let open = OpenOptions { ray_queues: true, ..Default::default() };
        let scene = Scene::open(&device, &path, &open, &Progress::none()).unwrap();
        let (sender, failed) = std::sync::mpsc::channel();
        let broken: Arc<dyn waiting::Batch> = Arc::new(Broken(sender));
        // More panics than there are threads that trace.
        for part in 0..100 {
            scene.parts().unwrap().bring(&broken, std::iter::once((part % 4, 1)));
            failed.recv_timeout(std::time::Duration::from_secs(60)).unwrap();
        }
        compare(&scene, &whole, 1);
        // Once the wait is over, a batch does not touch its scene, which may be gone.
        let rays = rays(2);
        let answers = vec![RawHit::MISS; rays.len()];
        let batch = Batch::new(&scene, scene.parts().unwrap(), &rays, false, &answers).unwrap();
        waiting::Batch::fail(&batch);
        drop((scene, broken));
        waiting::Batch::visit(&batch, 0, &mut |_, _| panic!("visited"));
        assert!(batch.lock().has_failed);
        std::fs::remove_file(path).unwrap();
    }

    #[test]
    fn rays_that_wait_hit_what_they_hit_alone() {
        let path = std::env::temp_dir().join(format!("bakelite-waiting-{}", std::process::id()));
        let builds = [(false, BuildQuality::Default), (false, BuildQuality::High), (true, BuildQuality::Default)];
        for isa in Isa::available() {
            let device = Device::new(DeviceOptions { num_threads: 3, isa: Some(isa), ..Default::default() }).unwrap();
            for (compact, quality) in builds {
                let options = BuildOptions { compact, quality, ..Default::default() };
                let whole = Scene::commit(&device, data(), &options, &Progress::none()).map_err(|e| e.1).unwrap();
                whole.save(&path, &Progress::none()).unwrap();
                let open = OpenOptions { ray_queues: true, ..Default::default() };
                let scene = Scene::open(&device, &path, &open, &Progress::none()).unwrap();
                let parts = &scene.parts().unwrap().tree;
                assert!(parts.parts.len() > 5, "{isa:?} {options:?}: {} parts", parts.parts.len());
                std::thread::scope(|s| {
                    for seed in 0..5 {
                        let (scene, whole) = (&scene, &whole);
                        s.spawn(move || compare(scene, whole, seed));
                    }
                });
            }
        }
        std::fs::remove_file(path).unwrap();
    }
}
