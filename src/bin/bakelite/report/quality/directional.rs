//! `bakelite report directional`: light on a generated normal map, from irradiance alone and from light by direction (SH
//! L1), against path tracing with the same normals; what light by direction takes in time and memory.
//!
//! The normal map tilts the normal of each point by a given angle, to any side.

use super::measure::{Points, Values, errors};
use crate::args::ReportArgs;
use crate::files;
use crate::job::Job;
use crate::report::measure::median;
use bakelite::Result;
use bakelite::lightmap::normal_maps::irradiance_on;
use bakelite::lightmap::{BakeParams, Layer, Lightmap, directional, packed_ratio};
use bakelite::reference::{Irradiance, PathTracer, SurfacePoint};
use bakelite::sampling::{orthonormal_basis, uniform};
use glam::{DVec3, Vec3};
use std::f32::consts::{PI, TAU};
use std::fmt::Write;

/// Angles of the normal map's normals to the surface, in degrees.
const ANGLES: [f32; 4] = [0.0, 15.0, 30.0, 45.0];

/// Least cosine of the dominant direction.
const LEAST_COSINE: f32 = 0.1;

/// Light of a point: irradiance, L0, L1, dominant direction, and the point's normal.
struct Lit {
    e: Vec3,
    l0: Vec3,
    l1: [Vec3; 3],
    direction: Vec3,
    normal: Vec3,
}

/// A way to shade a normal of the normal map.
type Way = fn(&Lit, Vec3) -> Vec3;

const WAYS: [(&str, Way); 6] = [
    ("irradiance alone", |lit, _| lit.e),
    ("SH L1, linear: π (L0 + 2 L1 · m)", |lit, m| (PI * (lit.l0 + 2.0 * along(&lit.l1, m))).max(Vec3::ZERO)),
    ("SH L1, curve of Geomerics", geomerics),
    ("SH L1, shader of the guide", |lit, m| irradiance_on(lit.e, lit.l0, lit.l1, lit.normal, m)),
    ("the same, L1 / L0 in 8 bits", |lit, m| {
        let packed = |x: f32| f32::from(packed_ratio(x)) / 127.5 - 1.0;
        let l1 = lit.l1.map(|x| (x / lit.l0.max(Vec3::splat(1e-12))).map(packed) * lit.l0);
        irradiance_on(lit.e, lit.l0, l1, lit.normal, m)
    }),
    ("the same, irradiance and dominant direction", |lit, m| {
        let l0 = lit.e / (4.0 * PI * lit.direction.dot(lit.normal).max(LEAST_COSINE));
        irradiance_on(lit.e, l0, lit.direction.to_array().map(|x| x * l0), lit.normal, m)
    }),
];

fn along(l1: &[Vec3; 3], m: Vec3) -> Vec3 {
    m.x * l1[0] + m.y * l1[1] + m.z * l1[2]
}

/// Sloan and others, *Improved spherical harmonics irradiance* (Enlighten 2015), for each channel.
fn geomerics(lit: &Lit, m: Vec3) -> Vec3 {
    let channel = |c: usize| {
        let l1 = Vec3::from(lit.l1.map(|x| x[c]));
        let ratio = (l1.length() / lit.l0[c].max(1e-12)).min(1.0);
        let q = 0.5 + 0.5 * l1.normalize_or_zero().dot(m);
        let (p, a) = (1.0 + 2.0 * ratio, (1.0 - ratio) / (1.0 + ratio));
        PI * lit.l0[c] * (a + (1.0 - a) * (p + 1.0) * q.powf(p))
    };
    Vec3::new(channel(0), channel(1), channel(2))
}

/// Normals of the normal map at points.
fn tilted(points: &Points, degrees: f32) -> Vec<Vec3> {
    let (sin, cos) = degrees.to_radians().sin_cos();
    let one = |(i, n): (u32, &Vec3)| {
        let (x, y) = orthonormal_basis(*n);
        let (b, a) = (TAU * uniform(i, 7, 0)).sin_cos();
        (n * cos + (x * a + y * b) * sin).normalize()
    };
    (0..).zip(&points.normals).map(one).collect()
}

/// Normals of the normal map, and two halves of the reference for them.
type Reference = (Vec<Vec3>, [Vec<Irradiance>; 2]);

fn references(job: &Job, lightmap: &Lightmap, points: &Points, paths: u32) -> Result<Vec<Reference>> {
    let scene = lightmap.scene();
    let tracer = PathTracer::new(scene);
    let point = |(&(triangle, front, ..), position): (&(u32, bool, f32, f32), &Vec3)| {
        let normal = scene.normal(triangle).as_dvec3().normalize();
        SurfacePoint { position: position.as_dvec3(), normal: if front { normal } else { -normal } }
    };
    let surface: Vec<SurfacePoint> = points.on.iter().zip(&points.positions).map(point).collect();
    let of_angle = |degrees| {
        let normals = tilted(points, degrees);
        let exact: Vec<DVec3> = normals.iter().map(|n| n.as_dvec3().normalize()).collect();
        let half = |seed| {
            job.bars.show("reference", |p| {
                tracer.irradiance_many_on(scene.device(), &surface, &exact, paths.div_ceil(2), seed, p)
            })
        };
        Ok((normals, [half(77)?, half(78)?]))
    };
    ANGLES.into_iter().map(of_angle).collect()
}

/// Runs the report.
pub fn run(args: &ReportArgs) -> Result<()> {
    files::make_folder(&args.bake.out)?;
    let mut job = Job::new(&args.bake);
    let mut lightmap = job.unbaked()?;
    let all = directional::INDIRECT | directional::DIRECT;
    let asked = [("none", 0), ("indirect", directional::INDIRECT), ("all", all)];
    let (mut seconds, mut peaks) = (asked.map(|_| Vec::new()), [u64::MAX; 3]);
    for _ in 0..args.seeds {
        for (k, (_, bits)) in asked.into_iter().enumerate() {
            let params = BakeParams { directional: bits, ..args.bake.params };
            let stats = job.bars.show("bake", |p| lightmap.bake(&params, p))?;
            seconds[k].push(stats.seconds);
            // Later bakes hold the light of earlier ones too.
            peaks[k] = stats.peak_bytes.min(peaks[k]);
        }
    }
    let camera = job.camera(&lightmap);
    let points = Points::chosen(&lightmap, &camera, args.points, args.points_seed)?.shown_by(&lightmap)?;
    let info = lightmap.info();
    let mut text = format!(
        "# Light by direction: {}\n\n{} texels, {} gather texels; {} points, {} paths each.\n\n\
         | light by direction | seconds, median of {} | bytes at most |\n|---|---|---|\n",
        args.bake.title(),
        info.texels,
        info.gather_texels,
        points.len(),
        args.paths,
        args.seeds,
    );
    for (k, (name, _)) in asked.into_iter().enumerate() {
        let _ = writeln!(text, "| {name} | {:.3} | {} |", median(seconds[k].clone()), peaks[k]);
    }
    let references = references(&job, &lightmap, &points, args.paths)?;
    for (name, bits, layer) in [("Indirect", asked[1].1, Layer::Indirect), ("All", all, Layer::Combined)] {
        let params = BakeParams { directional: bits, ..args.bake.params };
        job.bars.show("bake", |p| lightmap.bake(&params, p))?;
        let angles = ANGLES.map(|a| format!("{a}°")).join(" | ");
        let _ = write!(text, "\n{name} light: relative MSE (without the worst 1 %) by the angle of the normal map\n\n");
        let _ = write!(text, "| | {angles} |\n|---|{}\n", "---|".repeat(ANGLES.len()));
        let lit = lit(&points, &lightmap, layer)?;
        for (title, shade) in WAYS {
            let _ = write!(text, "| {title} |");
            for (normals, halves) in &references {
                let shaded: Values =
                    lit.iter().zip(normals).map(|(lit, &m)| shade(lit, m).as_dvec3().to_array()).collect();
                let of = |e: &Irradiance| if layer == Layer::Indirect { e.indirect } else { e.total() };
                let halves = halves.each_ref().map(|half| half.iter().map(of).collect::<Values>());
                let errors = errors(&[shaded], &halves);
                let _ = write!(text, " {:.2e} ({:.2e}) |", errors.mse, errors.trimmed);
            }
            text.push('\n');
        }
    }
    files::write_text(&args.bake.out.join("directional.md"), &text)?;
    if !args.bake.quiet {
        println!("{text}\nWrote to {}: directional.md", args.bake.out.display());
    }
    Ok(())
}

/// Reads the light of a bake at the points as a shader does.
fn lit(points: &Points, lightmap: &Lightmap, layer: Layer) -> Result<Vec<Lit>> {
    let read = |layer| -> Result<Vec<Vec3>> {
        Ok(points.of_bake(lightmap, layer)?.into_iter().map(|v| DVec3::from(v).as_vec3()).collect())
    };
    let (e, l0, direction) = (read(layer)?, read(Layer::L0)?, read(Layer::Direction)?);
    let l1 = [read(Layer::L1X)?, read(Layer::L1Y)?, read(Layer::L1Z)?];
    let of_point = |i: usize| Lit {
        e: e[i],
        l0: l0[i],
        l1: l1.each_ref().map(|v| v[i]),
        direction: direction[i],
        normal: points.normals[i].normalize(),
    };
    Ok((0..points.len()).map(of_point).collect())
}
