//! Gather rays of tiles of neighbouring texels and of one origin: as streams, and in packets whose rays are traced one
//! by one; shadow rays of tiles to a lamp: as streams, and by one call each.
//!
//!     cargo bench -p bakelite-benches --bench tiles -- SCENE... [ISA...] [8x8x64... lamp]
//!
//! Instruction sets (portable, avx2, avx512) and kinds of tiles (side × side texels × rays) that are named are the only
//! ones.
//!
//! Alternating pairs in one process, one thread; medians, and a count of hits whose bits differ.

use bakelite::bvh::BuildOptions;
use bakelite::sampling::uniform;
use bakelite::trace::{PACKET_SIZE, Packet, RawHit, Ray};
use bakelite::{Device, DeviceOptions, Isa, Progress, Scene};
use common::{areas, load, median, tile};
use glam::Vec3;
use std::path::Path;
use std::time::Instant;

/// Kinds of tiles: texels along a side, and rays per texel.
const KINDS: [(u32, u32); 7] = [(8, 64), (8, 32), (16, 64), (1, 1024), (1, 256), (1, 64), (1, 32)];

/// Name of the kind of shadow rays from tiles of 16 × 16 texels to a lamp.
const LAMP: &str = "lamp";

fn name_of((side, rays): (u32, u32)) -> String {
    format!("{side}x{side}x{rays}")
}

/// Traces the rays of each origin in packets, one by one.
fn packets(scene: &Scene, rays: &[Ray], out: &mut [RawHit]) {
    for (rays, out) in rays.chunks(PACKET_SIZE).zip(out.chunks_mut(PACKET_SIZE)) {
        let mut packet = Packet::default();
        rays.iter().for_each(|r| packet.push(Vec3::from(r.direction)));
        let mut hits = [RawHit::MISS; PACKET_SIZE];
        scene.gather_packet(Vec3::from(rays[0].origin), &packet, 0.0, f32::INFINITY, &mut hits);
        out.copy_from_slice(&hits[..out.len()]);
    }
}

/// Alternating runs over all tiles. Returns the time of the second way and the ratio of the first to it, medians of
/// six.
fn compare(tiles: &[Vec<Ray>], mut first: impl FnMut(&[Ray]), mut second: impl FnMut(&[Ray])) -> (f64, f64) {
    let (mut ratios, mut times) = (vec![], vec![]);
    for round in 0..7 {
        let start = Instant::now();
        tiles.iter().for_each(|t| first(t));
        let one = start.elapsed().as_secs_f64();
        let start = Instant::now();
        tiles.iter().for_each(|t| second(t));
        let two = start.elapsed().as_secs_f64();
        if round > 0 {
            ratios.push(one / two);
            times.push(two);
        }
    }
    (median(times), median(ratios))
}

/// Shadow rays of tiles of 16 × 16 texels to points off other surfaces, or to random places in cubes there, of a size
/// in tiles, or all in one direction if that is infinite.
fn shadows(scene: &Scene, areas: &[f32], spacing: f32, size: f32, label: &str) {
    let tiles: Vec<Vec<Ray>> = (0..1500)
        .map(|i| {
            let lamp = {
                let r = tile(scene, areas, 10_000 + i, 1, 1, spacing)[0];
                Vec3::from(r.origin) + 0.5 * Vec3::from(r.direction)
            };
            let texels = tile(scene, areas, i, 16, 1, spacing);
            let to_sun = Vec3::from(texels[0].direction);
            let ray = |(k, r): (usize, &Ray)| {
                if size == f32::INFINITY {
                    return Ray::new(r.origin.into(), to_sun);
                }
                let at = |dimension: u32| uniform(256 * i + k as u32, dimension, 7) - 0.5;
                let end = lamp + 16.0 * spacing * size * Vec3::new(at(0), at(1), at(2));
                Ray::new(r.origin.into(), end - Vec3::from(r.origin)).within(0.0, 1.0)
            };
            texels.iter().enumerate().map(ray).collect()
        })
        .collect();
    let (mut a, mut b) = (vec![0; 256], vec![0; 256]);
    let (time, ratio) = compare(
        &tiles,
        |t| t.iter().zip(&mut a).for_each(|(ray, out)| *out = u8::from(scene.occluded(ray))),
        |t| scene.occluded_stream(t, &mut b),
    );
    let (mut differ, mut hits, mut count) = (0, 0, 0);
    for t in &tiles {
        scene.occluded_stream(t, &mut b);
        differ += t.iter().zip(&b).filter(|(ray, b)| u8::from(scene.occluded(ray)) != **b).count();
        hits += b.iter().filter(|&&b| b != 0).count();
        count += t.len();
    }
    println!(
        "{label}: {:.2} Mrays/s stream, ratio {ratio:.2}, {differ} of {count} differ, {hits} hit",
        count as f64 / time / 1e6
    );
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with('-')).collect();
    let is_isa = |a: &String| Isa::ALL.iter().any(|isa| isa.name() == a);
    let is_kind = |a: &String| a == LAMP || KINDS.iter().any(|&kind| name_of(kind) == *a);
    let is_wanted = |name: &str, is_of: &dyn Fn(&String) -> bool| {
        let mut named = arguments.iter().filter(|a| is_of(a)).peekable();
        named.peek().is_none() || named.any(|a| a == name)
    };
    for file in arguments.iter().filter(|a| !is_isa(a) && !is_kind(a)) {
        let data = load(file);
        for isa in Isa::available().filter(|isa| is_wanted(isa.name(), &is_isa)) {
            let device =
                Device::new(DeviceOptions { isa: Some(isa), num_threads: 1, ..Default::default() }).expect("device");
            let scene = Scene::commit(&device, data.clone(), &BuildOptions::default(), &Progress::none())
                .map_err(|e| e.1)
                .expect("commit");
            let areas = areas(&scene);
            let spacing = 0.12 * (areas[areas.len() - 1] / 7000.0).sqrt();
            let label = |kind: &str| {
                format!("{} {} {kind}", Path::new(file).file_stem().unwrap().to_string_lossy(), isa.name())
            };
            if is_wanted(LAMP, &is_kind) {
                for size in [0.0, 0.25, 1.0, 4.0, f32::INFINITY] {
                    shadows(&scene, &areas, spacing, size, &label(&format!("{LAMP} {size}")));
                }
            }
            for (side, per_texel) in KINDS.into_iter().filter(|&kind| is_wanted(&name_of(kind), &is_kind)) {
                let n = (400_000 / (side * side * per_texel)).max(8);
                let tiles: Vec<Vec<Ray>> = (0..n).map(|i| tile(&scene, &areas, i, side, per_texel, spacing)).collect();
                let count: usize = tiles.iter().map(Vec::len).sum();
                let mut a = vec![RawHit::MISS; 16384];
                let mut b = vec![RawHit::MISS; 16384];
                let (time, ratio) =
                    compare(&tiles, |t| packets(&scene, t, &mut a[..t.len()]), |t| scene.intersect_stream(t, &mut b));
                let mut differ = 0;
                for t in &tiles {
                    packets(&scene, t, &mut a[..t.len()]);
                    scene.intersect_stream(t, &mut b);
                    differ += (0..t.len()).filter(|&i| a[i] != b[i]).count();
                }
                println!(
                    "{}: {:.2} Mrays/s stream, ratio {:.2}, {differ} of {count} differ",
                    label(&name_of((side, per_texel))),
                    count as f64 / time / 1e6,
                    ratio
                );
            }
        }
    }
}
