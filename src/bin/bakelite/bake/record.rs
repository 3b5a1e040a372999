//! `report.json`: everything about a run, for programs.

use crate::args::BakeArgs;
use crate::pictures::{NAMES, Pictures};
use crate::stages::Stage;
use bakelite::lightmap::{BakeStats, Lightmap};
use bakelite::scene::NONE;
use bakelite::{Light, Scene};
use glam::Vec3;
use serde_json::{Value, json};
use std::path::PathBuf;

/// What a run leaves to record.
pub struct Run<'a> {
    pub args: &'a BakeArgs,
    pub lightmap: &'a Lightmap,
    pub bake: &'a BakeStats,
    pub stages: &'a [Stage],
    pub pictures: Option<&'a Pictures>,
    pub camera: bakelite::scene::Camera,
    pub warnings: &'a [String],
    pub files: &'a [PathBuf],
    pub seconds: f64,
}

/// The record. Units are in the names; rates per second; colours and vectors are arrays of three.
pub fn json(run: &Run) -> Value {
    let scene = run.lightmap.scene();
    json!({
        "bakelite": env!("CARGO_PKG_VERSION"),
        "parameters": parameters(run.args),
        "machine": {
            "isa": scene.device().isa().name(),
            "threads": scene.device().num_threads(),
        },
        "scene": describe_scene(scene, &run.args.scene, run.warnings),
        "light_map": describe_lightmap(run.lightmap),
        "plan": run.lightmap.plan_text().lines().collect::<Vec<_>>(),
        "stages": run.stages.iter().map(|s| stage(s, run.seconds)).collect::<Vec<_>>(),
        "bake": {
            "seconds": run.bake.seconds,
            "photons_emitted": run.bake.photons_emitted,
            "photons_stored": run.bake.photons_stored,
            "peak_bytes": run.bake.peak_bytes,
            "left_out": run.bake.left_out,
            "back_charts": run.bake.back_charts,
            "passes": run.bake.passes,
            "error": run.bake.error,
            "seams": {
                "points": run.bake.seam_points,
                "rms_before": run.bake.seam_rms_before,
                "rms_after": run.bake.seam_rms_after,
                "seconds": run.bake.seam_seconds,
            },
        },
        "camera": {
            "position": run.camera.position.to_array(),
            "target": run.camera.target.to_array(),
            "up": run.camera.up.to_array(),
            "fov_y_degrees": run.camera.fov_y.to_degrees(),
        },
        "pictures": run.pictures.map(|p| pictures(p, run.args)),
        "files": run.files.iter().map(|f| f.display().to_string()).collect::<Vec<_>>(),
        "process_peak_bytes": process_peak_bytes(),
        "seconds": run.seconds,
    })
}

fn parameters(args: &BakeArgs) -> Value {
    let (d, p) = (&args.desc, &args.params);
    json!({
        "scene": args.scene,
        "texels_per_unit": d.texels_per_unit,
        "page_size": d.page_size,
        "padding": d.padding,
        "gather_divisor": d.gather_divisor,
        "radiance_divisor": d.radiance_divisor,
        "both_sides": d.both_sides,
        "seen_from": d.seen_from.iter().map(|r| [r.lower.to_array(), r.upper.to_array()]).collect::<Vec<_>>(),
        "photons": p.photon_count,
        "bounces": p.max_bounces,
        "gather_rays": p.gather_rays,
        "radius": p.radius,
        "near_hits": p.near_hits,
        "interpolation_error": p.interpolation_error,
        "interpolation_contrast": p.interpolation_contrast,
        "own_rays": p.own_rays,
        "blur": p.blur_radius,
        "direct_samples": p.direct_samples,
        "seed": p.seed,
        "stitch": p.stitch,
        "passes": p.passes,
        "target_error": p.target_error,
        "threads": args.threads,
        "isa": args.isa.map_or("auto", |i| i.name()),
        "bins": args.build.bins,
        "leaf": args.build.max_leaf,
        "build": args.build.quality.name(),
        "compact": args.build.compact,
        "width": args.width,
        "height": args.height,
        "reference_spp": args.reference_spp,
        "layers": args.layers.iter().map(|l| l.name).collect::<Vec<_>>(),
        "formats": {
            "exr": args.formats.exr,
            "exr_half": args.formats.exr_half,
            "png": args.formats.png,
            "glb": args.formats.glb,
        },
    })
}

fn describe_scene(scene: &Scene, name: &str, warnings: &[String]) -> Value {
    let stats = scene.stats();
    let (lower, upper) = scene.bounds();
    json!({
        "name": name,
        "meshes": scene.meshes().len(),
        "materials": scene.materials().len(),
        "triangles": stats.triangles,
        "skipped_degenerate": stats.skipped_degenerate,
        "lights": scene.lights().iter().map(light).collect::<Vec<_>>(),
        "emissive_triangles": scene.emitters().len(),
        "lower": lower.to_array(),
        "upper": upper.to_array(),
        "nodes": stats.nodes,
        "bvh_bytes": stats.bvh_bytes,
        "bytes": stats.bytes,
        "sah_cost": stats.sah_cost,
        "build_seconds": stats.build_seconds,
        "warnings": warnings,
    })
}

fn light(light: &Light) -> Value {
    let v = |v: Vec3| v.to_array();
    match *light {
        Light::Point { position, intensity } => {
            json!({"kind": "point", "position": v(position), "intensity": intensity})
        }
        Light::Spot { position, direction, inner, outer, intensity } => json!({
            "kind": "spot", "position": v(position), "direction": v(direction),
            "inner_degrees": inner.to_degrees(), "outer_degrees": outer.to_degrees(), "intensity": intensity,
        }),
        Light::Directional { direction, irradiance, angular_radius } => json!({
            "kind": "sun", "direction": v(direction), "irradiance": irradiance,
            "radius_degrees": angular_radius.to_degrees(),
        }),
        Light::Sky { radiance, environment, up, rotation } => json!({
            "kind": "sky", "radiance": radiance, "environment": (environment != NONE).then_some(environment),
            "up": v(up), "rotation_degrees": rotation.to_degrees(),
        }),
        Light::Rect { position, edge_u, edge_v, radiance } => json!({
            "kind": "rect", "corner": v(position), "edge_u": v(edge_u), "edge_v": v(edge_v), "radiance": radiance,
        }),
    }
}

fn describe_lightmap(lightmap: &Lightmap) -> Value {
    let i = lightmap.info();
    json!({
        "pages": i.page_count,
        "width": i.width,
        "height": i.height,
        "charts": i.charts,
        "texels": i.texels,
        "gather_texels": i.gather_texels,
        "radiance_texels": i.radiance_texels,
        "both_sided_charts": i.both_sided_charts,
        "back_texels": i.back_texels,
        "texels_per_unit": i.texels_per_unit,
        "bytes": i.bytes,
        "unwrap_seconds": i.unwrap_seconds,
        "uvs": {
            "given_charts": i.uvs.given_charts,
            "unwrapped_charts": i.uvs.unwrapped_charts,
            "triangles_out_of_range": i.uvs.out_of_range,
            "triangles_degenerate": i.uvs.degenerate,
            "overlapping_texels": i.uvs.overlapping_texels,
            "reduced_charts": i.uvs.reduced_charts,
        },
    })
}

fn stage(s: &Stage, total: f64) -> Value {
    json!({
        "name": s.name,
        "seconds": s.seconds,
        "share": s.seconds / total,
        "rays": s.rays,
        "rays_per_second": s.rays_per_second(),
        "photons": s.photons,
        "photons_per_second": s.photons_per_second(),
        "bytes": s.bytes,
    })
}

fn pictures(p: &Pictures, args: &BakeArgs) -> Value {
    let image = |i: usize| {
        json!({
            "name": NAMES[i],
            "seconds": p.seconds[i],
            "rmse": if i == 0 { Value::Null } else { p.rmse[i].into() },
        })
    };
    json!({
        "width": args.width,
        "height": args.height,
        "exposure": p.exposure,
        "rmse_definition": "root mean square error of linear radiance over all channels of the pixels that the scene \
                            covers, divided by the reference's mean over the same; the squared error of x is estimated \
                            by (x - a)(x - b) from the reference's two halves a and b, so its noise is not part of it",
        "reference_noise": p.noise,
        "images": [image(0), image(1), image(2)],
    })
}

/// The most memory that the process held, where the system tells.
fn process_peak_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|l| l.starts_with("VmHWM:"))?;
    Some(line.split_whitespace().nth(1)?.parse::<u64>().ok()? * 1024)
}
