//! `bakelite report coherence`: rates of rays by tree, way and coherence against the number of triangles, with the exponents of
//! the powers that fit them: the study of the thesis's Appendix A, which has 13·x^(1/8), 8.9·x^(1/7), 2.7·x^(1/5) and
//! 36.6·x^(1/8) for its four kernels. Plots have a line where a scene is as large as a cache.

use crate::args::{BakeArgs, ReportArgs};
use crate::files;
use crate::job::Job;
use crate::pictures::PrimaryRays;
use crate::plot::curves::{Plot, Series};
use crate::report::measure::{exponent, median, surface_rays};
use bakelite::bvh::BinaryBvh;
use bakelite::sampling::{orthonormal_basis, uniform, uniform_cone};
use bakelite::scene::builtin_camera;
use bakelite::trace::four_wide::FourWide;
use bakelite::trace::{Hit, RawHit, Ray, baseline};
use bakelite::{Error, Progress, Result, Scene};
use glam::Vec3;
use std::fmt::Write;
use std::time::Instant;

/// Rays of each kind.
const RAYS: u32 = 1 << 16;

/// Width and height of the view, a ray per pixel.
const VIEW: usize = 256;

/// Times that rays are timed after a first round, of which the median counts.
const ROUNDS: usize = 3;

/// Most triangles of which there is a binary and a 4-wide tree beside the scene's.
const MOST_TWICE: u32 = 20_000_000;

/// Half-angle in degrees of the cone around a packet's direction at the highest coherence; it doubles with each level below.
const NARROWEST: f32 = 0.1;

const WAYS: [&str; 6] =
    ["binary tree", "4-wide, one by one", "4-wide, stream", "8-wide, one by one", "8-wide, many", "8-wide, stream"];

/// Rays that are traced together, and how many they are.
struct Kind {
    name: String,
    rays: Vec<Ray>,
    together: usize,
}

struct Trees<'a> {
    scene: &'a Scene,
    others: Option<(Vec<[Vec3; 3]>, BinaryBvh, FourWide)>,
}

/// Prints a table in Markdown for each way, and writes `coherence.csv` and plots. Rays are traced on one thread unless
/// `--threads` asks for more.
pub fn run(args: &ReportArgs) -> Result<()> {
    files::make_folder(&args.bake.out)?;
    let caches: Vec<String> = caches().iter().map(|c| format!("L{} {} {}", c.level, c.kind, c.size)).collect();
    println!("caches of a core: {}; {} threads\n", caches.join(", "), args.bake.threads.max(1));
    let mut names: Vec<String> = Vec::new();
    let mut rows: Vec<(f64, f64, Vec<Vec<f64>>)> = Vec::new();
    for name in &args.scenes {
        let of_scene = BakeArgs { scene: name.clone(), ..args.bake.clone() };
        let mut job = Job::new(&of_scene);
        let device = job.device()?;
        let scene = job.scene_on(&device)?;
        let kinds = kinds(&of_scene, &scene)?;
        let trees = Trees::new(&scene, &of_scene)?;
        let threads = of_scene.threads.max(1);
        let rates = (0..WAYS.len()).map(|way| kinds.iter().map(|kind| trees.rate(way, kind, threads)).collect());
        rows.push((scene.stats().triangles as f64, scene.stats().bytes as f64, rates.collect()));
        names = kinds.into_iter().map(|kind| kind.name).collect();
    }
    let points = |way: usize, kind: usize| -> Vec<[f64; 2]> {
        rows.iter().map(|row| [row.0, row.2[way][kind]]).filter(|p| p[1] > 0.0).collect()
    };
    for (way, name) in WAYS.iter().enumerate() {
        println!("{name}, million rays per second\n\n| triangles | MB | {} |", names.join(" | "));
        println!("|---|---|{}", "---|".repeat(names.len()));
        for row in rows.iter().filter(|row| row.2[way][0] > 0.0) {
            let rates: Vec<String> = row.2[way].iter().map(|rate| format!("{rate:.2}")).collect();
            println!("| {} | {:.1} | {} |", row.0, row.1 * 1e-6, rates.join(" | "));
        }
        let exponents = (0..names.len()).map(|kind| exponent(&points(way, kind)));
        let exponents: Vec<String> = exponents.map(|e| e.map_or(String::new(), |e| format!("{e:+.3}"))).collect();
        println!("| exponent | | {} |\n", exponents.join(" | "));
        let series = names.iter().enumerate().map(|(kind, name)| Series { name, points: points(way, kind) });
        let (x_label, y_label) = ("triangles", "million rays per second");
        let marks = marks(&rows.iter().map(|row| [row.0, row.1]).collect::<Vec<_>>());
        let plot = Plot { title: name, x_label, y_label, series: series.collect(), marks };
        files::write_text(&args.bake.out.join(format!("coherence-{way}.svg")), &plot.svg())?;
    }
    let mut csv = format!("triangles,bytes,way,{}\n", names.join(","));
    for (triangles, bytes, rates) in &rows {
        for (way, rates) in WAYS.iter().zip(rates) {
            let rates: String = rates.iter().map(|rate| format!(",{rate}")).collect();
            let _ = writeln!(csv, "{triangles},{bytes},\"{way}\"{rates}");
        }
    }
    files::write_text(&args.bake.out.join("coherence.csv"), &csv)
}

/// Random rays, packets of squares of pixels, packets of one size whose rays go more and more apart, and gather rays.
fn kinds(args: &BakeArgs, scene: &Scene) -> Result<Vec<Kind>> {
    let Some(camera) = args.camera.or(builtin_camera(&args.scene)) else {
        return Err(Error::InvalidArgument("the scene has no camera: give --camera".into()));
    };
    let view = PrimaryRays::new(&camera, VIEW, VIEW);
    let pixel = |x: usize, y: usize| view.of_pixel(x, y).next().expect("a pixel has rays");
    let squares = |side: usize| -> Vec<Ray> {
        let corner = |square: usize| [square % (VIEW / side) * side, square / (VIEW / side) * side];
        let of = |square: usize| (0..side * side).map(move |i| (corner(square), [i % side, i / side]));
        (0..(VIEW / side).pow(2)).flat_map(of).map(|([x, y], [dx, dy])| pixel(x + dx, y + dy)).collect()
    };
    let mut kinds = vec![Kind { name: "random".into(), rays: surface_rays(scene, RAYS, 1), together: 1024 }];
    kinds.extend([2, 4, 8, 16, 32].map(|side| Kind {
        name: format!("{side}x{side} pixels"),
        rays: squares(side),
        together: side * side,
    }));
    kinds.extend((1..=10).rev().map(|level| {
        let cos_max = (NARROWEST * (1 << (10 - level)) as f32).to_radians().cos();
        let rays = (0..RAYS).map(|i| {
            let packet = (i / 256) as usize;
            let axis = pixel(packet % 16 * (VIEW / 16) + VIEW / 32, packet / 16 * (VIEW / 16) + VIEW / 32);
            let (forward, within) =
                (Vec3::from(axis.direction), uniform_cone([uniform(i, 0, 3), uniform(i, 1, 3)], cos_max));
            let (right, up) = orthonormal_basis(forward);
            Ray::new(Vec3::from(axis.origin), right * within.x + up * within.y + forward * within.z)
        });
        Kind { name: format!("coherence {level}"), rays: rays.collect(), together: 256 }
    }));
    kinds.extend([64, 256].map(|together| Kind {
        name: format!("gather {together}"),
        rays: surface_rays(scene, RAYS, together),
        together: together as usize,
    }));
    Ok(kinds)
}

impl Trees<'_> {
    fn new<'a>(scene: &'a Scene, args: &BakeArgs) -> Result<Trees<'a>> {
        if scene.triangle_count() > MOST_TWICE {
            return Ok(Trees { scene, others: None });
        }
        let corners: Vec<[Vec3; 3]> = (0..scene.triangle_count()).map(|t| scene.corners(t)).collect();
        let valid: Vec<u32> = (0..scene.triangle_count()).filter(|&t| scene.is_valid(t)).collect();
        let binary = BinaryBvh::build(&|t| corners[t as usize], &valid, &args.build, &Progress::none())?;
        Ok(Trees { scene, others: Some((corners, binary, FourWide::new(scene, &args.build)?)) })
    }

    /// Traces rays in the way with this index; whether that is possible.
    fn trace(&self, way: usize, rays: &[Ray], out: &mut [RawHit], hits: &mut [Hit]) -> bool {
        let one_by_one = |out: &mut [RawHit], trace: &dyn Fn(&Ray) -> RawHit| {
            rays.iter().zip(out).for_each(|(ray, out)| *out = trace(ray));
        };
        match (way, &self.others) {
            (0, Some((corners, binary, _))) => one_by_one(out, &|ray| baseline::closest(binary, corners, ray)),
            (1, Some((.., four))) => one_by_one(out, &|ray| four.intersect(ray)),
            (2, Some((.., four))) => four.stream(rays, &mut out[..rays.len()]),
            (3, _) => one_by_one(out, &|ray| self.scene.intersect_raw(ray)),
            (4, _) => return self.scene.intersect_many(rays, false, &mut hits[..rays.len()]).is_ok(),
            (5, _) => self.scene.intersect_stream(rays, &mut out[..rays.len()]),
            _ => return false,
        }
        true
    }

    /// Million rays per second; 0 if there is no such tree.
    fn rate(&self, way: usize, kind: &Kind, threads: usize) -> f64 {
        let calls: Vec<&[Ray]> = kind.rays.chunks(kind.together).collect();
        let round = || -> Option<f64> {
            let start = Instant::now();
            let all_traced = std::thread::scope(|scope| {
                let parts = calls.chunks(calls.len().div_ceil(threads)).map(|part| {
                    scope.spawn(move || {
                        let mut out = vec![RawHit::MISS; kind.together];
                        let mut hits = vec![Hit::MISS; kind.together];
                        part.iter().all(|rays| self.trace(way, rays, &mut out, &mut hits))
                    })
                });
                let parts: Vec<_> = parts.collect();
                parts.into_iter().all(|part| part.join().unwrap_or(false))
            });
            all_traced.then(|| kind.rays.len() as f64 * 1e-6 / start.elapsed().as_secs_f64())
        };
        // The first round warms caches up.
        let rates: Option<Vec<f64>> = (0..=ROUNDS).map(|_| round()).collect();
        rates.map_or(0.0, |rates| median(rates[1..].to_vec()))
    }
}

/// Triangles with which a scene is as large as each cache that holds data, by the two scenes (triangles, bytes) whose sizes
/// are next to it.
fn marks(scenes: &[[f64; 2]]) -> Vec<(f64, String)> {
    let mut scenes = scenes.to_vec();
    scenes.sort_by(|a, b| a[1].total_cmp(&b[1]));
    let triangles = |bytes: f64| {
        let [a, b] = scenes.windows(2).map(|w| [w[0], w[1]]).find(|w| (w[0][1]..=w[1][1]).contains(&bytes))?;
        let part = (bytes / a[1]).ln() / (b[1] / a[1]).ln();
        Some(a[0] * (b[0] / a[0]).powf(part))
    };
    let of_data = caches().into_iter().filter(|cache| cache.kind != "Instruction");
    of_data.filter_map(|cache| Some((triangles(cache.bytes()?)?, format!("L{} {}", cache.level, cache.size)))).collect()
}

/// A cache of the first core as the system knows it: kind "Data", "Instruction" or "Unified", size as "32K".
struct Cache {
    level: String,
    kind: String,
    size: String,
}

impl Cache {
    fn bytes(&self) -> Option<f64> {
        let (number, factor) = match (self.size.strip_suffix('K'), self.size.strip_suffix('M')) {
            (Some(number), _) => (number, 1024.0),
            (_, Some(number)) => (number, 1024.0 * 1024.0),
            _ => (&self.size[..], 1.0),
        };
        number.parse::<f64>().ok().map(|number| factor * number)
    }
}

fn caches() -> Vec<Cache> {
    let read = |index: u32, what: &str| {
        let path = format!("/sys/devices/system/cpu/cpu0/cache/index{index}/{what}");
        std::fs::read_to_string(path).ok().map(|text| text.trim().to_owned())
    };
    (0..4)
        .map_while(|i| Some(Cache { level: read(i, "level")?, kind: read(i, "type")?, size: read(i, "size")? }))
        .collect()
}
