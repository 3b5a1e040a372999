//! The part of `bakelite report edits` about new scenes: an object is taken away and put back, each time by a scene that is
//! described and committed anew, whose light map and live light keep light of those before.

use super::{
    CLEARLY, KEEP_ERRORS, Light, PASSES, Piece, Time, difference, differences, finish, light, live_params, shown,
};
use crate::args::ReportArgs;
use bakelite::lightmap::{BakeParams, Layer, Lightmap};
use bakelite::live::{Live, LiveParams};
use bakelite::scene::MeshMaterials;
use bakelite::{Progress, Result, Scene, SceneData};
use std::collections::HashSet;
use std::sync::Arc;
use std::time::Instant;

/// A difference of light that lets all light stand which can be kept: only surfaces that are new are baked.
const ALL: f32 = 1e9;

/// Difference of live light that is let stand.
const KEEP_LIVE: f32 = 0.03;

/// Prints two tables in Markdown. `map` is a light map of `scene`.
pub fn run(args: &ReportArgs, scene: &Arc<Scene>, map: &mut Lightmap, pieces: &[Piece]) -> Result<()> {
    println!("\nScenes described anew, without an object and with it again:\n");
    println!(
        "| triangles | size | | commit, s | charts and texels: those that changed, s | from nothing, s | charts kept | \
         texels changed | keep_error | what changed, s | from nothing, s | kept | error, in these texels: what changed | \
         from nothing | old light |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|");
    let mut live = Vec::new();
    for piece in pieces {
        map.bake(&args.bake.params, &Progress::none())?;
        let mut less = revise(args, scene, map, Some(piece), piece)?;
        live_rows(args, [map, &less], (piece, "taken away"), &mut live)?;
        less.bake(&args.bake.params, &Progress::none())?;
        let again = revise(args, scene, &less, None, piece)?;
        live_rows(args, [&less, &again], (piece, "put back"), &mut live)?;
    }
    println!("\nLive light of scenes described anew, keep_error {KEEP_LIVE}:\n");
    println!(
        "| triangles | size | | quick start | created from that before, s | until all is gathered, s | from nothing: created, s | \
         all gathered, s | kept | difference of indirect light as soon as it is created: from that before | from nothing | \
         at the end: indirect | direct | old light: indirect | direct |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|");
    live.iter().for_each(|row| println!("{row}"));
    Ok(())
}

/// Adds rows about live light of the second of two light maps, which keeps light of that of the first.
fn live_rows(
    args: &ReportArgs,
    [earlier, map]: [&Lightmap; 2],
    (piece, change): (&Piece, &str),
    rows: &mut Vec<String>,
) -> Result<()> {
    let progress = Progress::none();
    for quick_start in [false, true] {
        let params = LiveParams { quick_start, ..live_params(args) };
        let mut before = Live::new(earlier, &params, &progress)?;
        finish(&mut before)?;
        // The light of before, at the texels of the new light map that show the same.
        let mut old = Live::create_from(map, &mut before, ALL, &progress)?;
        finish(&mut old)?;
        let (mut live, of_live) = Time::of(|| Live::create_from(map, &mut before, KEEP_LIVE, &progress))?;
        let (at_once, of_before) = (shown(&live, map, Layer::Indirect)?, live.sums()?);
        let (_, gathered) = Time::of(|| finish(&mut live))?;
        let (mut fresh, of_fresh) = Time::of(|| Live::new(map, &params, &progress))?;
        let coarse = shown(&fresh, map, Layer::Indirect)?;
        let (_, all) = Time::of(|| finish(&mut fresh))?;
        let kept = live.sums()?.iter().zip(&of_before).filter(|(new, old)| new == old).count() as f64;
        let kept = kept / of_before.len() as f64;
        let right = [shown(&fresh, map, Layer::Indirect)?, shown(&fresh, map, Layer::Direct)?];
        let everywhere = vec![true; right[0].len()];
        let wrong = |light: &Light, right: &Light| difference(light, right, &everywhere);
        rows.push(format!(
            "| {} | {:.2} | {change} | {} | {} | {} | {} | {} | {:.1} % | {:.1e} | {:.1e} | {:.1e} | {:.1e} | {:.1e} | {:.1e} |",
            piece.triangles,
            piece.size,
            if quick_start { "yes" } else { "no" },
            of_live.text(),
            gathered.text(),
            of_fresh.text(),
            all.text(),
            100.0 * kept,
            wrong(&at_once, &right[0]),
            wrong(&coarse, &right[0]),
            wrong(&shown(&live, map, Layer::Indirect)?, &right[0]),
            wrong(&shown(&live, map, Layer::Direct)?, &right[1]),
            wrong(&shown(&old, map, Layer::Indirect)?, &right[0]),
            wrong(&shown(&old, map, Layer::Direct)?, &right[1]),
        ));
    }
    Ok(())
}

/// Makes the scene without a piece, or as it is, and prints rows about its light map, which keeps light of `earlier`.
fn revise(
    args: &ReportArgs,
    scene: &Arc<Scene>,
    earlier: &Lightmap,
    without: Option<&Piece>,
    piece: &Piece,
) -> Result<Lightmap> {
    let (params, progress) = (args.bake.params, Progress::none());
    let data = copy(scene, without)?;
    let start = Instant::now();
    let revised = Scene::commit(scene.device(), data, &args.bake.build, &progress).map_err(|(_, e)| e)?;
    let commit = start.elapsed().as_secs_f64();
    let desc = &args.bake.desc;
    let (anew, of_all) = Time::of(|| Lightmap::create(&revised, desc, &progress))?;
    let (mut map, of_changed) = Time::of(|| Lightmap::create_from(&revised, desc, earlier, &progress))?;
    drop(anew);
    let info = map.info();
    let (_, whole) = Time::of(|| map.bake(&params, &progress))?;
    let from_nothing_light = light(&map)?;
    map.bake(&BakeParams { seed: params.seed + 1, passes: PASSES, ..params }, &progress)?;
    let right = light(&map)?;
    map.bake_changed_from(earlier, &params, ALL, &progress)?;
    let old = light(&map)?;
    let changed = differences(&old, &from_nothing_light);
    let changed: Vec<bool> = changed.into_iter().map(|d| d.is_some_and(|d| d > CLEARLY)).collect();
    let (all, count) = (vec![true; changed.len()], changed.iter().filter(|&&c| c).count());
    let texels = map.info().texels as f64;
    let errors = |light: &Light| {
        let [all, changed] = [&all, &changed].map(|which| difference(light, &right, which));
        format!("{all:.2e}, {changed:.2e}")
    };
    for keep_error in KEEP_ERRORS {
        let (stats, time) = Time::of(|| map.bake_changed_from(earlier, &params, keep_error, &progress))?;
        println!(
            "| {} | {:.2} | {} | {commit:.2} | {} | {} | {:.1} % | {:.2} % | {keep_error} | {} | {} | {:.1} % | {} | {} | {} |",
            piece.triangles,
            piece.size,
            if without.is_some() { "taken away" } else { "put back" },
            of_changed.text(),
            of_all.text(),
            100.0 * f64::from(info.kept_charts) / f64::from(info.charts),
            100.0 * count as f64 / texels,
            time.text(),
            whole.text(),
            100.0 * stats.kept_texels as f64 / texels,
            errors(&light(&map)?),
            errors(&from_nothing_light),
            errors(&old),
        );
    }
    Ok(map)
}

/// The description of a scene, without the triangles of a piece.
fn copy(scene: &Scene, without: Option<&Piece>) -> Result<SceneData> {
    let mut data = SceneData::new();
    for texture in scene.textures() {
        data.add_texture(texture.as_ref().clone())?;
    }
    for &material in scene.materials() {
        data.add_material(material)?;
    }
    for environment in scene.environments() {
        data.add_environment(environment.as_ref().clone());
    }
    for &light in scene.lights().iter() {
        data.add_light(light)?;
    }
    for (number, mesh) in (0..).zip(scene.meshes()) {
        let mut mesh = mesh.clone();
        if let Some(piece) = without.filter(|piece| piece.mesh == number) {
            let gone: HashSet<u32> = piece.vertices.iter().copied().collect();
            let stays: Vec<bool> = mesh.indices.iter().map(|corners| !gone.contains(&corners[0])).collect();
            let mut flags = stays.iter();
            let indices: Vec<_> = mesh.indices.iter().copied().filter(|_| flags.next() == Some(&true)).collect();
            mesh.indices = indices.into();
            if let MeshMaterials::PerTriangle(materials) = &mesh.materials {
                let kept = materials.iter().zip(&stays).filter(|(_, stays)| **stays).map(|(&m, _)| m);
                mesh.materials = MeshMaterials::PerTriangle(kept.collect::<Vec<_>>().into());
            }
        }
        data.add_mesh(mesh)?;
    }
    for instance in scene.instances() {
        data.add_instance(*instance)?;
    }
    Ok(data)
}
