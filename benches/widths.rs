//! Primary, incoherent and gather rays through the binary tree, the 4-wide and the 8-wide one, and as streams: the rays
//! of the thesis's tables 4.1 to 4.3.
//!
//!     cargo bench -p bakelite-benches --bench widths -- SCENE... [ISA...]
//!
//! One thread; every way traces the same rays, by turns; medians of five rounds, in million rays per second. Primary
//! rays are those of a pinhole (90 degrees, in tiles of 4 × 4 pixels), incoherent ones go from points of triangles taken
//! at random into the hemisphere (4.1.2), gather rays come from tiles of 8 × 8 texels, 64 each, at places that are
//! uniform over the surface, and, 256 and 32 each, from single places. Hits that are not those of single rays in the
//! 8-wide tree are counted: of the binary tree, whose triangle test has other arithmetic, by the triangle, else by all
//! bits.

use bakelite::bvh::{BinaryBvh, BuildOptions};
use bakelite::trace::four_wide::FourWide;
use bakelite::trace::{Hit, RawHit, Ray, baseline};
use bakelite::{Device, DeviceOptions, Isa, Progress, Scene};
use common::{areas, camera, incoherent, load, median, tile};
use glam::Vec3;
use std::path::Path;
use std::time::Instant;

/// Number of rays of a stream or a call.
const BATCH: usize = 4096;

/// Names of the ways to trace rays, in the order of `trace`.
const WAYS: [&str; 7] = [
    "binary tree",
    "4-wide, one by one",
    "4-wide, many",
    "4-wide, stream",
    "8-wide, one by one",
    "8-wide, `intersect_many`",
    "8-wide, stream",
];

struct Trees<'a> {
    scene: &'a Scene,
    corners: Vec<[Vec3; 3]>,
    binary: BinaryBvh,
    four: FourWide,
}

impl Trees<'_> {
    fn new(scene: &Scene) -> Trees<'_> {
        let corners: Vec<[Vec3; 3]> = (0..scene.triangle_count()).map(|t| scene.corners(t)).collect();
        let valid: Vec<u32> = (0..scene.triangle_count()).filter(|&t| scene.is_valid(t)).collect();
        let options = BuildOptions::default();
        let binary =
            BinaryBvh::build(&|t| corners[t as usize], &valid, &options, &Progress::none()).expect("binary tree");
        let four = FourWide::new(scene, &options).expect("4-wide tree");
        Trees { scene, corners, binary, four }
    }

    /// Traces a batch in the way with this index.
    fn trace(&self, way: usize, rays: &[Ray], out: &mut [RawHit], hits: &mut [Hit]) {
        let one_by_one = |out: &mut [RawHit], trace: &dyn Fn(&Ray) -> RawHit| {
            rays.iter().zip(out).for_each(|(ray, out)| *out = trace(ray));
        };
        match way {
            0 => one_by_one(out, &|ray| baseline::closest(&self.binary, &self.corners, ray)),
            1 => one_by_one(out, &|ray| self.four.intersect(ray)),
            2 => self.four.intersect_many(rays, out),
            3 => self.four.stream(rays, out),
            4 => one_by_one(out, &|ray| self.scene.intersect_raw(ray)),
            5 => self.scene.intersect_many(rays, false, &mut hits[..rays.len()]).expect("rays"),
            _ => self.scene.intersect_stream(rays, out),
        }
    }

    /// Million rays per second of each way, and how many hits are not those of single rays.
    fn rates(&self, rays: &[Ray]) -> [(f64, usize); WAYS.len()] {
        let mut times = [const { Vec::new() }; WAYS.len()];
        let mut out = vec![RawHit::MISS; BATCH];
        let mut hits = vec![Hit::MISS; BATCH];
        // The first round warms caches up.
        for round in 0..6 {
            for (way, times) in times.iter_mut().enumerate() {
                let start = Instant::now();
                rays.chunks(BATCH).for_each(|batch| self.trace(way, batch, &mut out, &mut hits));
                if round > 0 {
                    times.push(start.elapsed().as_secs_f64());
                }
            }
        }
        let differ = |way: usize| {
            let mut count = 0;
            for batch in rays.chunks(BATCH) {
                let mut out = vec![RawHit::MISS; BATCH];
                self.trace(way, batch, &mut out, &mut vec![Hit::MISS; BATCH]);
                let is_other = |(ray, hit): &(&Ray, &RawHit)| {
                    let expected = self.scene.intersect_raw(ray);
                    if way == 0 { expected.triangle != hit.triangle } else { expected != **hit }
                };
                count += batch.iter().zip(&out).filter(is_other).count();
            }
            count
        };
        let mut ways = times.into_iter().enumerate();
        std::array::from_fn(|_| {
            let (way, times) = ways.next().expect("a way");
            // `intersect_many` converts its hits.
            (rays.len() as f64 / median(times) / 1e6, if way == 5 { 0 } else { differ(way) })
        })
    }
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with('-')).collect();
    let is_isa = |a: &String| Isa::ALL.iter().any(|isa| isa.name() == a);
    let wanted: Vec<&String> = arguments.iter().filter(|&a| is_isa(a)).collect();
    for file in arguments.iter().filter(|&a| !is_isa(a)) {
        let data = load(file);
        for isa in Isa::available().filter(|isa| wanted.is_empty() || wanted.iter().any(|a| *a == isa.name())) {
            let device =
                Device::new(DeviceOptions { isa: Some(isa), num_threads: 1, ..Default::default() }).expect("device");
            let scene = Scene::commit(&device, data.clone(), &BuildOptions::default(), &Progress::none())
                .map_err(|e| e.1)
                .expect("commit");
            let trees = Trees::new(&scene);
            let areas = areas(&scene);
            let spacing = 0.12 * (areas[areas.len() - 1] / 7000.0).sqrt();
            let tiles = |count: u32, side: u32, rays: u32| -> Vec<Ray> {
                (0..count).flat_map(|i| tile(&scene, &areas, i, side, rays, spacing)).collect()
            };
            let kinds = [
                ("primary", camera(&scene, 448)),
                ("incoherent", incoherent(&scene, 100_000)),
                ("gather, tiles 8x8x64", tiles(32, 8, 64)),
                ("gather 256", tiles(400, 1, 256)),
                ("gather 32", tiles(3200, 1, 32)),
            ];
            let hit_by = |rays: &[Ray]| {
                let hits = rays.iter().filter(|ray| !scene.intersect_raw(ray).is_miss()).count();
                format!("{:.0} %", 100.0 * hits as f64 / rays.len() as f64)
            };
            let rates = kinds.each_ref().map(|(_, rays)| trees.rates(rays));
            println!(
                "\n{}, {} triangles, {}; 4-wide nodes {}, 8-wide nodes {}\n",
                Path::new(file).file_stem().unwrap_or_default().to_string_lossy(),
                scene.triangle_count(),
                isa.name(),
                trees.four.node_count(),
                scene.stats().nodes
            );
            println!("| |{}", kinds.each_ref().map(|(name, _)| format!(" {name} |")).concat());
            println!("|---|{}", "---|".repeat(kinds.len()));
            for (way, name) in WAYS.iter().enumerate() {
                println!("| {name} |{}", rates.map(|kind| format!(" {:.2} |", kind[way].0)).concat());
            }
            let differ = |kind: &[(f64, usize); WAYS.len()]| kind.map(|way| way.1.to_string()).join(", ");
            println!("\nrays that hit: {}", kinds.each_ref().map(|(_, rays)| hit_by(rays)).join("; "));
            println!("hits that differ, by way: {}", rates.each_ref().map(differ).join("; "));
        }
    }
}
