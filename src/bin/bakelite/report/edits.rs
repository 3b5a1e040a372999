//! `bakelite report edits`: an object of a scene moves; seconds to right light by baking what has changed, beside a bake
//! from nothing, and the difference of the two; the same of live light that follows, beside live light made anew; and of
//! scenes that are described anew, without the object and with it again, and their live light.
//!
//! Objects are pieces whose triangles hang together. Some are chosen at random among those of a size that a person
//! would move, and move by their own size across the floor.

mod revisions;

use crate::args::ReportArgs;
use crate::job::Job;
use crate::report::measure::pick;
use bakelite::lightmap::{BakeParams, Layer, LayerData, Lightmap};
use bakelite::live::{Budget, Live, LiveCamera, LiveParams, Mode, PageRect};
use bakelite::sampling::combine;
use bakelite::{Error, Progress, Result, Scene};
use glam::{Quat, Vec3};
use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Sizes of objects that move, as fractions of the scene's diagonal.
const SIZES: std::ops::Range<f32> = 0.01..0.1;

/// Differences of light that are let stand.
const KEEP_ERRORS: [f32; 3] = [0.01, 0.03, 0.1];

/// Texels darker than this part of the mean light count as if they were so bright.
const DARK: f64 = 0.1;

/// Passes of the light that errors are told by.
const PASSES: u32 = 8;

/// Relative difference of light from which on a texel counts as changed.
const CLEARLY: f64 = 0.1;

/// Light by place of the pages; `None` where no texel shows light of its own.
type Light = Vec<Option<Vec3>>;

/// A piece of a mesh.
struct Piece {
    mesh: u32,
    vertices: Vec<u32>,
    triangles: usize,
    size: f32,
}

/// Duration of a call.
struct Time {
    seconds: f64,
    /// Seconds of all of the process's threads; `None` where the system does not report them.
    of_processor: Option<f64>,
}

impl Time {
    fn of<T>(call: impl FnOnce() -> Result<T>) -> Result<(T, Time)> {
        let (start, before) = (Instant::now(), processor_seconds());
        let result = call()?;
        let of_processor = before.zip(processor_seconds()).map(|(before, after)| after - before);
        Ok((result, Time { seconds: start.elapsed().as_secs_f64(), of_processor }))
    }

    fn text(&self) -> String {
        let of_processor = self.of_processor.map_or(String::new(), |seconds| format!(" ({seconds:.2})"));
        format!("{:.2}{of_processor}", self.seconds)
    }
}

/// Processor seconds of this process so far, from Linux's `/proc`, in hundredths.
fn processor_seconds() -> Option<f64> {
    let stat = std::fs::read_to_string("/proc/self/stat").ok()?;
    // The name of the process, in brackets, may hold anything; user and system time are fields 14 and 15.
    let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
    let ticks = |i: usize| fields.get(i)?.parse::<f64>().ok();
    Some((ticks(11)? + ticks(12)?) / 100.0)
}

/// Prints a table in Markdown.
pub fn run(args: &ReportArgs) -> Result<()> {
    let mut job = Job::new(&args.bake);
    let device = job.device()?;
    let mut scene = job.scene_on(&device)?;
    let (params, progress) = (args.bake.params, Progress::none());
    let start = Instant::now();
    let mut map = job.layout(&scene)?;
    println!("charts and texels: {:.2} s, {} texels", start.elapsed().as_secs_f64(), map.info().texels);
    let pieces = chosen(&scene, args.objects, params.seed);
    if pieces.is_empty() {
        return Err(Error::InvalidArgument("the scene has no object of a size to be moved".into()));
    }
    let path = std::env::temp_dir().join(format!("bakelite-edits-{}", std::process::id()));
    map.bake(&params, &progress)?;
    map.save_result(&path, &progress)?;
    println!("Seconds in brackets are the processor's, of all threads.\n");
    println!(
        "| triangles moved | size | texels changed | refit, follow, s | keep_error | what changed, s | of these photons, radiance map | from nothing, s | kept | \
         error, in these texels: what changed | from nothing | old light |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|---|---|");
    for (number, piece) in pieces.iter().enumerate() {
        let [here, there] = places(&scene, piece, number, args.bake.up);
        let old = light(&map)?;
        let refit = move_to(&mut scene, piece.mesh, &there)?;
        let start = Instant::now();
        map.follow(&scene, &progress)?;
        let follow = start.elapsed().as_secs_f64();
        let (_, whole) = Time::of(|| map.bake(&params, &progress))?;
        let from_nothing_light = light(&map)?;
        let reference = BakeParams { seed: params.seed + 1, passes: PASSES, ..params };
        map.bake(&reference, &progress)?;
        let right = light(&map)?;
        // Where the light of both bakes with the same random numbers differs clearly, the move has changed it.
        let changed = differences(&old, &from_nothing_light);
        let changed: Vec<bool> = changed.into_iter().map(|d| d.is_some_and(|d| d > CLEARLY)).collect();
        let (all, part) = (vec![true; changed.len()], changed.iter().filter(|&&c| c).count() as f64);
        let part = 100.0 * part / map.info().texels as f64;
        let errors = |light: &Light| [&all, &changed].map(|which| difference(light, &right, which));
        let (noise, stale) = (errors(&from_nothing_light), errors(&old));
        for keep_error in KEEP_ERRORS {
            move_to(&mut scene, piece.mesh, &here)?;
            map.follow(&scene, &progress)?;
            map.load_result(&path, &progress)?;
            move_to(&mut scene, piece.mesh, &there)?;
            map.follow(&scene, &progress)?;
            let (stats, time) = Time::of(|| map.bake_changed(&params, keep_error, &progress))?;
            let new = light(&map)?;
            let error = errors(&new);
            let text = |[all, changed]: [f64; 2]| format!("{all:.2e}, {changed:.2e}");
            println!(
                "| {} | {:.2} | {part:.2} % | {refit:.2}, {follow:.2} | {keep_error} | {} | {:.2}, {:.2} | {} | {:.1} % | {} | {} | {} |",
                piece.triangles,
                piece.size,
                time.text(),
                stats.photons.seconds,
                stats.radiance.seconds,
                whole.text(),
                100.0 * stats.kept_texels as f64 / map.info().texels as f64,
                text(error),
                text(noise),
                text(stale),
            );
        }
        move_to(&mut scene, piece.mesh, &here)?;
        map.follow(&scene, &progress)?;
        map.load_result(&path, &progress)?;
    }
    std::fs::remove_file(&path).map_err(|e| Error::Io(e.to_string()))?;
    live_light(args, &mut scene, &mut map, &pieces)?;
    revisions::run(args, &scene, &mut map, &pieces)
}

/// Prints a table of live light that follows the pieces. Updates without a camera have no limit of time.
fn live_light(args: &ReportArgs, scene: &mut Arc<Scene>, map: &mut Lightmap, pieces: &[Piece]) -> Result<()> {
    let params = live_params(args);
    let progress = Progress::none();
    let anew = |map: &Lightmap| {
        Time::of(|| {
            let mut live = Live::new(map, &params, &progress)?;
            finish(&mut live)?;
            Ok(live)
        })
    };
    println!("\nLive light:\n");
    println!(
        "| triangles moved | size | refit, light map, live follow, s | keep_error | all gathered, s | made anew, s | kept | \
         difference of indirect light | of direct light | of old light: indirect | direct |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|---|");
    for (number, piece) in pieces.iter().enumerate() {
        let [here, there] = places(scene, piece, number, args.bake.up);
        for keep_error in KEEP_ERRORS {
            let (mut live, _) = anew(map)?;
            let before = live.sums()?;
            let refit = move_to(scene, piece.mesh, &there)?;
            let (_, of_map) = Time::of(|| map.follow(scene, &progress))?;
            let old = [Layer::Indirect, Layer::Direct].map(|layer| shown(&live, map, layer));
            let (_, of_live) = Time::of(|| live.follow(map, keep_error, &progress))?;
            let (_, gathered) = Time::of(|| finish(&mut live))?;
            let kept = live.sums()?.iter().zip(&before).filter(|(new, old)| new == old).count() as f64;
            let (fresh, whole) = anew(map)?;
            let mut differ = Vec::new();
            for (layer, old) in [Layer::Indirect, Layer::Direct].into_iter().zip(old) {
                let right = shown(&fresh, map, layer)?;
                let all = vec![true; right.len()];
                differ.push([shown(&live, map, layer)?, old?].map(|light| difference(&light, &right, &all)));
            }
            println!(
                "| {} | {:.2} | {refit:.2}, {:.2}, {:.2} | {keep_error} | {} | {} | {:.1} % | {:.1e} | {:.1e} | {:.1e} | {:.1e} |",
                piece.triangles,
                piece.size,
                of_map.seconds,
                of_live.seconds,
                gathered.text(),
                whole.text(),
                100.0 * kept / before.len() as f64,
                differ[0][0],
                differ[1][0],
                differ[0][1],
                differ[1][1],
            );
            move_to(scene, piece.mesh, &here)?;
            map.follow(scene, &progress)?;
        }
    }
    Ok(())
}

/// Parameters of live light that ends with as many rays as a bake.
fn live_params(args: &ReportArgs) -> LiveParams {
    let bake = args.bake.params;
    LiveParams {
        mode: Mode::Uniform,
        max_rounds: bake.gather_rays.div_ceil(64),
        photon_count: bake.photon_count,
        direct_samples: bake.direct_samples,
        seed: bake.seed,
        ..Default::default()
    }
}

/// Updates live light until nothing is left to do.
fn finish(live: &mut Live) -> Result<()> {
    let camera = LiveCamera { position: Vec3::ZERO, forward: Vec3::X, up: Vec3::Z, fov_y: 1.0, width: 16, height: 16 };
    let budget = Budget { milliseconds: 100.0, ..Default::default() };
    loop {
        let stats = live.update(&camera, &budget)?;
        if stats.finished == 1.0 && !stats.light_pending {
            return Ok(());
        }
        if stats.milliseconds < 5.0 {
            // Photons are on their way, on a thread that waits during updates if there is no core for it.
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}

/// A layer of the light that live light shows.
fn shown(live: &Live, map: &Lightmap, layer: Layer) -> Result<Light> {
    let (info, lod) = (map.info(), live.params().lod_count - 1);
    let mut all = Vec::new();
    for page in 0..info.page_count {
        let LayerData::Scalar(valid) = map.read(page, Layer::Validity)? else {
            return Err(Error::Internal("a layer of another type".into()));
        };
        let light = live.read(&PageRect { page, x: 0, y: 0, width: info.width, height: info.height }, lod, layer)?;
        all.extend(light.into_iter().zip(valid).map(|(light, valid)| (valid == 1.0).then_some(Vec3::from(light))));
    }
    Ok(all)
}

/// Positions of the mesh of a piece, before and after it has moved.
fn places(scene: &Scene, piece: &Piece, number: usize, up: Vec3) -> [Vec<Vec3>; 2] {
    let here = scene.meshes()[piece.mesh as usize].positions.to_vec();
    let angle = Quat::from_axis_angle(up.normalize(), number as f32 * 2.4);
    let by = angle * up.any_orthonormal_vector() * piece.size;
    let mut there = here.clone();
    piece.vertices.iter().for_each(|&v| there[v as usize] += by);
    [here, there]
}

/// Moves a mesh; returns the seconds.
fn move_to(scene: &mut Arc<Scene>, mesh: u32, positions: &[Vec3]) -> Result<f64> {
    let start = Instant::now();
    Scene::refit(scene, &[(mesh, positions)])?;
    Ok(start.elapsed().as_secs_f64())
}

/// The combined light of a light map.
fn light(map: &Lightmap) -> Result<Light> {
    let mut all = Vec::new();
    for page in 0..map.info().page_count {
        let (LayerData::Rgb(light), LayerData::Scalar(valid)) =
            (map.read(page, Layer::Combined)?, map.read(page, Layer::Validity)?)
        else {
            return Err(Error::Internal("layers of another type".into()));
        };
        all.extend(light.into_iter().zip(valid).map(|(light, valid)| (valid == 1.0).then_some(Vec3::from(light))));
    }
    Ok(all)
}

/// Mean relative difference of two lights, over the places that `counts` and where both show light of their own.
fn difference(light: &Light, right: &Light, counts: &[bool]) -> f64 {
    let all: Vec<f64> =
        differences(light, right).into_iter().zip(counts).filter_map(|(d, c)| d.filter(|_| *c)).collect();
    all.iter().sum::<f64>() / all.len().max(1) as f64
}

/// Relative differences of two lights, by place.
fn differences(light: &Light, right: &Light) -> Vec<Option<f64>> {
    let sum = |v: Vec3| f64::from(v.element_sum());
    let covered = right.iter().flatten().count().max(1) as f64;
    let dark = DARK * right.iter().flatten().map(|v| sum(*v)).sum::<f64>() / covered;
    let of_place = |(a, b): (&Option<Vec3>, &Option<Vec3>)| {
        let (a, b) = ((*a)?, (*b)?);
        Some(sum((a - b).abs()) / sum(b).max(dark))
    };
    light.iter().zip(right).map(of_place).collect()
}

/// Chooses pieces at random.
fn chosen(scene: &Scene, count: usize, seed: u64) -> Vec<Piece> {
    let sizes = SIZES.start * scene.diagonal()..SIZES.end * scene.diagonal();
    let mut all: Vec<Piece> = (0..scene.meshes().len() as u32).flat_map(|mesh| pieces(scene, mesh)).collect();
    all.retain(|piece| sizes.contains(&piece.size) && piece.triangles > 1);
    let mut pieces = Vec::new();
    let mut left: Vec<usize> = (0..all.len()).collect();
    for number in 0..(count as u32).min(left.len() as u32) {
        let chosen = pick(&left, combine(seed as u32, number));
        left.retain(|&piece| piece != chosen);
        pieces.push(chosen);
    }
    let mut all: Vec<Option<Piece>> = all.into_iter().map(Some).collect();
    pieces.into_iter().filter_map(|piece| all[piece].take()).collect()
}

/// Takes a mesh apart into pieces whose triangles share positions.
fn pieces(scene: &Scene, mesh: u32) -> Vec<Piece> {
    let m = &scene.meshes()[mesh as usize];
    if scene.is_instanced(mesh) {
        return Vec::new();
    }
    let mut places = HashMap::new();
    let place: Vec<u32> = m
        .positions
        .iter()
        .enumerate()
        .map(|(i, p)| *places.entry(p.to_array().map(f32::to_bits)).or_insert(i as u32))
        .collect();
    let mut parent: Vec<u32> = (0..place.len() as u32).collect();
    fn root(parent: &mut [u32], mut i: u32) -> u32 {
        while parent[i as usize] != i {
            parent[i as usize] = parent[parent[i as usize] as usize];
            i = parent[i as usize];
        }
        i
    }
    for corners in &m.indices[..] {
        let [a, b, c] = corners.map(|i| root(&mut parent, place[i as usize]));
        parent[b as usize] = a;
        let c = root(&mut parent, c);
        parent[c as usize] = root(&mut parent, a);
    }
    let mut of_roots: HashMap<u32, (Vec<u32>, usize)> = HashMap::new();
    for (i, &at) in place.iter().enumerate() {
        of_roots.entry(root(&mut parent, at)).or_default().0.push(i as u32);
    }
    for corners in &m.indices[..] {
        let root = root(&mut parent, place[corners[0] as usize]);
        if let Some(piece) = of_roots.get_mut(&root) {
            piece.1 += 1;
        }
    }
    let mut pieces: Vec<Piece> = of_roots
        .into_values()
        .map(|(vertices, triangles)| {
            let positions = || vertices.iter().map(|&v| m.positions[v as usize]);
            let lower = positions().fold(Vec3::INFINITY, Vec3::min);
            let upper = positions().fold(Vec3::NEG_INFINITY, Vec3::max);
            Piece { mesh, size: (upper - lower).length(), triangles, vertices }
        })
        .collect();
    pieces.sort_by_key(|piece| piece.vertices[0]);
    pieces
}
