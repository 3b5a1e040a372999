//! Closest hits, primary rays and occlusion against other ray tracers that crates.io offers, on the same
//! rays of the same scene (common/mod.rs), on one thread:
//!
//!     cargo bench -p bakelite-benches --bench peers
//!
//! - `obvhs`: 8-wide nodes of quantised boxes (Ylitie, Karras and Laine 2017) over PLOC with reinsertion,
//!   traversed with SSE2, in Rust. Its presets `medium_build` and `very_slow_build`; the latter cuts triangles.
//! - `tinybvh-rs` 0.1.0-beta.3 is left out: it needs a C++20 compiler, shows its one fast kernel, `BVH8_CPU`, only to
//!   code that is compiled for AVX2, and that kernel crashes on the first of these rays.
//!
//! obvhs is not watertight. A rate is a median, a ratio the median over alternating pairs (ours, theirs) of our
//! rate to theirs. Hits agree if both name the same triangle or the same t, up to 1e-4 relative; what is counted
//! as "lost" one side hits and the other does not. Denormals are flushed to zero for all.

use bakelite::bvh::BuildQuality;
use bakelite::trace::{Hit, RawHit, Ray};
use bakelite::{Isa, Scene};
use common::{camera, commit, incoherent, segments};
use glam::Vec3A;
use obvhs::BvhBuildParams;
use obvhs::cwbvh::builder::build_cwbvh_from_tris;
use obvhs::ray::RayHit;
use obvhs::triangle::Triangle;
use std::hint::black_box;
use std::time::{Duration, Instant};

const RAYS: u32 = 200_000;
const SIDE: u32 = 448;
const PAIRS: usize = 5;

/// t, infinite for a miss, and the global triangle number.
type Answer = (f32, u32);
type Closest = Box<dyn Fn(&[Ray], &mut [Answer])>;
type Occluded = Box<dyn Fn(&[Ray], &mut [u8])>;

struct Peer {
    name: &'static str,
    build: Duration,
    closest: Closest,
    occluded: Option<Occluded>,
}

/// Triangles that can be hit, and their global numbers.
fn triangles(scene: &Scene) -> (Vec<Triangle>, Vec<u32>) {
    let ids: Vec<u32> = (0..scene.triangle_count()).filter(|&t| scene.is_valid(t)).collect();
    let corners = |&t: &u32| {
        let [v0, v1, v2] = scene.corners(t).map(Vec3A::from);
        Triangle { v0, v1, v2 }
    };
    (ids.iter().map(corners).collect(), ids)
}

fn obvhs(name: &'static str, scene: &Scene, params: BvhBuildParams) -> Peer {
    let (triangles, ids) = triangles(scene);
    let start = Instant::now();
    let tree = std::rc::Rc::new(build_cwbvh_from_tris(&triangles, params, &mut Duration::default()));
    // In the order of the leaves, as its documentation advises.
    let order = |&i: &u32| (triangles[i as usize], ids[i as usize]);
    let (triangles, ids): (Vec<Triangle>, Vec<u32>) = tree.primitive_indices.iter().map(order).unzip();
    let build = start.elapsed();
    let ray = |r: &Ray| obvhs::ray::Ray::new(r.origin.into(), r.direction.into(), r.tmin, r.tmax);
    let (tree_again, triangles_again) = (tree.clone(), triangles.clone());
    let closest = move |rays: &[Ray], out: &mut [Answer]| {
        for (r, out) in rays.iter().zip(out) {
            let mut hit = RayHit::none();
            let found = tree.ray_traverse(ray(r), &mut hit, |ray, i| triangles[i].intersect(ray));
            *out = if found { (hit.t, ids[hit.primitive_id as usize]) } else { (f32::INFINITY, u32::MAX) };
        }
    };
    let occluded = move |rays: &[Ray], out: &mut [u8]| {
        for (r, out) in rays.iter().zip(out) {
            *out = !tree_again.ray_traverse_miss(ray(r), |ray, i| triangles_again[i].intersect(ray)) as u8;
        }
    };
    Peer { name, build, closest: Box::new(closest), occluded: Some(Box::new(occluded)) }
}

fn peers(scene: &Scene) -> Vec<Peer> {
    let peers = vec![
        obvhs("obvhs, medium build", scene, BvhBuildParams::medium_build()),
        obvhs("obvhs, very slow build", scene, BvhBuildParams::very_slow_build()),
    ];
    peers.iter().for_each(|p| println!("  build of {:<32} {:8.1} ms", p.name, p.build.as_secs_f64() * 1e3));
    peers
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Prints both rates and their ratio.
fn compare(what: &str, peer: &str, rays: usize, mut ours: impl FnMut(), mut theirs: impl FnMut()) {
    let seconds = |f: &mut dyn FnMut()| {
        let start = Instant::now();
        f();
        start.elapsed().as_secs_f64()
    };
    let pairs: Vec<(f64, f64)> = (0..PAIRS).map(|_| (seconds(&mut ours), seconds(&mut theirs))).collect();
    let rate = |pick: fn(&(f64, f64)) -> f64| rays as f64 * 1e-6 / median(pairs.iter().map(pick).collect());
    let ratio = median(pairs.iter().map(|(a, b)| b / a).collect());
    print!("  {what:<10} {:8.3} Mrays/s  {peer:<32} {:8.3}  {ratio:5.2}x", rate(|p| p.0), rate(|p| p.1));
}

fn closest(what: &str, scene: &Scene, peers: &[Peer], rays: &[Ray]) {
    for peer in peers {
        let mut hits = vec![Hit::MISS; rays.len()];
        let mut answers = vec![(0.0, 0); rays.len()];
        let ours = || scene.intersect_many(rays, false, black_box(&mut hits)).expect("rays");
        compare(what, peer.name, rays.len(), ours, || (peer.closest)(rays, black_box(&mut answers)));
        let (mut lost, mut other) = (0, 0);
        for (ray, &(t, triangle)) in rays.iter().zip(&answers) {
            let hit: RawHit = scene.intersect_raw(ray);
            if hit.t.is_finite() != t.is_finite() {
                lost += 1;
            } else if hit.t.is_finite() && hit.triangle != triangle && !((hit.t - t).abs() <= 1e-4 * t) {
                other += 1;
            }
        }
        println!("   {} hit, lost {lost}, other t {other}", hits.iter().filter(|h| h.t.is_finite()).count());
    }
}

fn occluded(scene: &Scene, peers: &[Peer], rays: &[Ray]) {
    for peer in peers {
        let Some(occluded) = &peer.occluded else { continue };
        let (mut ours, mut theirs) = (vec![0; rays.len()], vec![0; rays.len()]);
        let trace = || scene.occluded_many(rays, false, black_box(&mut ours)).expect("rays");
        compare("occluded", peer.name, rays.len(), trace, || occluded(rays, black_box(&mut theirs)));
        let lost = ours.iter().zip(&theirs).filter(|(a, b)| a != b).count();
        println!("   {} hit, lost {lost}", ours.iter().filter(|&&o| o == 1).count());
    }
}

fn flush_denormals() {
    #[cfg(target_arch = "x86_64")]
    {
        let mut csr = 0u32;
        // SAFETY: reads and writes MXCSR by way of `csr`. Flush-to-zero and denormals-are-zero change results only
        // where denormals occur, which nothing here depends on.
        unsafe {
            std::arch::asm!("stmxcsr [{}]", in(reg) &mut csr);
            csr |= 0x8040;
            std::arch::asm!("ldmxcsr [{}]", in(reg) &csr);
        }
    }
}

fn main() {
    // Cargo runs benches as tests, too; there is nothing to test.
    if !std::env::args().any(|a| a == "--bench") {
        return;
    }
    flush_denormals();
    for quality in BuildQuality::ALL {
        let scene = commit(Isa::best(), quality);
        println!("{} triangles; ours: {}, {} build", scene.triangle_count(), Isa::best().name(), quality.name());
        println!("  build of {:<32} {:8.1} ms", "ours", scene.stats().build_seconds * 1e3);
        let peers = peers(&scene);
        closest("random", &scene, &peers, &incoherent(&scene, RAYS));
        closest("primary", &scene, &peers, &camera(&scene, SIDE));
        occluded(&scene, &peers, &segments(&scene, RAYS));
    }
}
