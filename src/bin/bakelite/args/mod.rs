//! Arguments of the command line. Errors are sentences that name the flag and the value at fault.

use bakelite::bvh::{BuildOptions, BuildQuality};
use bakelite::io::LoadOptions;
use bakelite::lightmap::{BakeParams, LightmapDesc};
use bakelite::scene::{Camera, NONE};
use bakelite::{Isa, Light};
use glam::Vec3;
use lexopt::Arg;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// What `--help` prints.
pub const HELP: &str = "\
Bakes light maps.

Usage: bakelite [bake] [SCENE] [OPTIONS]
       bakelite report cancel|live|memory|pipeline|quality|stability [SCENE] [OPTIONS]

SCENE, or --scene SCENE, is a file (.obj .ply .gltf .glb) or a built-in scene (atrium, cornell,
furnace). Without it, the atrium is baked. Lengths are in scene units, colours
are linear r,g,b.

Reports measure instead, and write tables, plots and CSV:
  cancel    how long each call is silent, and how soon it ends when it is cancelled
  live      live updates: error against time and rays, budgets, traffic, memory
  memory    the scene's memory, default and compact, and what that costs rays
  pipeline  what each stage of a bake takes, and what bounds it
  quality   error of the light and likeness of a view against run time, for every
            knob of a bake, path tracing and photons alone
  stability stiff and extreme cases, each against what is known of it (SCENE:
            its energy balance too)

Scene file:
  --base-folder DIR      files that the scene names must lie in DIR or below
                         [the folder of the scene]
  --any-folder           they may lie anywhere: for scenes you trust
  --max-texture-mb N     most MiB of all its images, decoded [2048]
  --max-file-mb N        most MiB of all its files [16384]
Lights, added to those of the scene; may be repeated:
  --light point:X,Y,Z:R,G,B               intensity in W/sr
  --light spot:X,Y,Z:DX,DY,DZ:INNER,OUTER:R,G,B
                                          cone angles in degrees, intensity in W/sr
  --light sun:DX,DY,DZ:R,G,B[:DEGREES]    direction of travel, irradiance in W/m2,
                                          radius of its disc [0; the sun's: 0.27]
  --light sky:R,G,B                       the same radiance from all directions
  --light sky:FILE.hdr|.exr[:SCALE]       an image by longitude and latitude, its
                                          zenith along --up, times SCALE
  --light rect:X,Y,Z:UX,UY,UZ:VX,VY,VZ:R,G,B
                                          corner and edges, shines along u x v,
                                          radiance in W/(m2 sr)
Light map:
  --texels-per-unit F    density; 0: about one page [0; the atrium: 30]
  --page-size N          width and height of a page in texels [1024]
  --padding N            texels around each chart [2]
  --gather-divisor N     light map texels per gather map texel and axis [4]
  --radiance-divisor N   light map texels per radiance map texel and axis [4]
  --one-side             one side of each two-sided chart, also where both are seen
Bake:
  --photons N            photons emitted [1000000]
  --bounces N            most reflections; 0: Russian roulette alone decides [0]
  --gather-rays N        rays per gather map texel; 0: no indirect light [64]
  --radius F             photon search radius; 0: automatic [0]
  --blur N               blur radius in gather map texels [2]
  --direct-samples N     shadow rays per texel and area light [16]
  --seed N               the same seed gives the same bits [0]
  --no-stitch            leave the seams between charts as they are
  --checkpoint FILE      keeps what is done in FILE and goes on from it after a kill;
                         deleted in the end
  --checkpoint-seconds F between two writes of it [10]
  --shard I/N            bakes the I-th of N parts of the texels, 1/N to N/N
  --save-result FILE     the light of the texels, for --load-result
  --load-result FILE     light to take over instead of baking; may be repeated, for shards
Machine:
  --threads N            0: one per logical core [0]
  --isa NAME             portable, avx2, avx512 or auto [auto]
  --bins N               bins of the tree builder [64]
  --leaf N               most triangles per leaf [4]
  --build NAME           default, or high: with spatial splits, for faster rays [default]
  --compact              the tree in a fifth of the memory, for slower rays
Pictures (path traced reference; indirect map + shadow rays; light map alone):
  --camera PX,PY,PZ:TX,TY,TZ[:FOV]        position, target, vertical degrees [60];
                                          without it, a view is looked for
  --up x|y|z             up axis of the scene, for the camera [y]
  --width N --height N   size of each [480 x 270]
  --reference-spp N      paths per pixel of the reference; 0: no pictures [32]
Report live (live.md with its tables and plots):
  --seconds F            most time per curve of errors [20]
  --updates N            updates per time budget, of 1, 2, 4 and 8 ms [10000]
Report quality (quality.md):
  --points N             points at which light is compared [400]
  --seeds N              bakes per setting, to tell noise from bias [4]
  --paths N              paths per point of the path traced reference [4096]
  --reference FILE       points and reference of an earlier report of the same scene and
                         lights: its quality-points.csv
  --view-paths N         paths per pixel of a path traced view, 1,024 or times that;
                         0: no view [1024]
  --knobs A,B,..         what to vary, of gather-rays, photons, radius, blur,
                         direct-samples, gather-divisor, radiance-divisor,
                         path-tracing, photons-alone, or none [all of these]
Output:
  --out DIR              where all files go [out]
  --no-glb               do not write the scene with its light maps as GLB
  --quiet                no progress, no table
  --help, --version
";

/// What to do.
#[derive(Debug)]
pub enum Command {
    Bake(Box<BakeArgs>),
    ReportCancel(Box<BakeArgs>),
    ReportLive(Box<ReportArgs>),
    ReportMemory(Box<BakeArgs>),
    ReportPipeline(Box<BakeArgs>),
    ReportQuality(Box<ReportArgs>),
    ReportStability(Box<BakeArgs>),
    Help,
    Version,
}

/// A light of the command line.
#[derive(Clone, Debug)]
pub struct GivenLight {
    /// Of a sky, up is still to be set.
    pub light: Light,
    /// Of a sky.
    pub image: Option<PathBuf>,
}

/// Arguments of `bakelite bake`.
#[derive(Clone, Debug)]
pub struct BakeArgs {
    /// A file or a built-in name.
    pub scene: String,
    /// Which files it may consist of, and how much of them.
    pub base_folder: Option<PathBuf>,
    pub any_folder: bool,
    pub max_texture_mb: u64,
    pub max_file_mb: u64,
    pub lights: Vec<GivenLight>,
    pub desc: LightmapDesc,
    pub params: BakeParams,
    pub build: BuildOptions,
    pub threads: usize,
    pub isa: Option<Isa>,
    /// Its `up` is not set: that is what [`up`](Self::up) is for.
    pub camera: Option<Camera>,
    pub up: Vec3,
    pub width: usize,
    pub height: usize,
    /// 0: no pictures.
    pub reference_spp: u32,
    pub out: PathBuf,
    pub glb: bool,
    pub quiet: bool,
    pub checkpoint: Option<PathBuf>,
    pub checkpoint_seconds: f64,
    /// Which part of the texels is baked, counted from 0, and of how many.
    pub shard: Option<[u64; 2]>,
    pub save_result: Option<PathBuf>,
    /// Instead of baking.
    pub load_results: Vec<PathBuf>,
}

impl BakeArgs {
    /// How to read the scene file.
    pub fn load_options(&self) -> LoadOptions {
        LoadOptions {
            base_folder: self.base_folder.clone(),
            any_folder: self.any_folder,
            max_texture_bytes: self.max_texture_mb.saturating_mul(1 << 20),
            max_file_bytes: self.max_file_mb.saturating_mul(1 << 20),
            ..Default::default()
        }
    }

    /// The scene's name for titles: its folders say more about the machine than about the scene.
    pub fn title(&self) -> String {
        let name = Path::new(&self.scene).file_name();
        name.map_or_else(|| self.scene.clone(), |n| n.to_string_lossy().into_owned())
    }
}

impl Default for BakeArgs {
    fn default() -> Self {
        BakeArgs {
            scene: "atrium".into(),
            base_folder: None,
            any_folder: false,
            max_texture_mb: 2 << 10,
            max_file_mb: 16 << 10,
            lights: Vec::new(),
            desc: LightmapDesc::default(),
            params: BakeParams::default(),
            build: BuildOptions::default(),
            threads: 0,
            isa: None,
            camera: None,
            up: Vec3::Y,
            width: 480,
            height: 270,
            reference_spp: 32,
            out: "out".into(),
            glb: true,
            quiet: false,
            checkpoint: None,
            checkpoint_seconds: 10.0,
            shard: None,
            save_result: None,
            load_results: Vec::new(),
        }
    }
}

/// Arguments of the reports that have their own.
#[derive(Clone, Debug)]
pub struct ReportArgs {
    /// Scene, lights, light map and machine. What a report varies is for it to choose.
    pub bake: BakeArgs,
    /// Live: most time per curve of errors.
    pub seconds: f64,
    /// Live: updates per time budget; 0: budgets are not measured.
    pub updates: u32,
    /// Quality: points at which light is compared.
    pub points: usize,
    /// Quality: bakes per setting.
    pub seeds: u64,
    /// Quality: paths per point of the reference.
    pub paths: u32,
    /// Quality: the points of an earlier report.
    pub reference: Option<PathBuf>,
    /// Quality: paths per pixel of the reference's view; 0: no view.
    pub view_paths: u32,
    /// Quality: what to vary, of [`KNOBS`].
    pub knobs: Vec<String>,
}

impl Default for ReportArgs {
    fn default() -> Self {
        ReportArgs {
            bake: BakeArgs::default(),
            seconds: 20.0,
            updates: 10_000,
            points: 400,
            seeds: 4,
            paths: 4096,
            reference: None,
            view_paths: 1024,
            knobs: KNOBS.map(String::from).to_vec(),
        }
    }
}

/// What there is to report.
const REPORTS: [&str; 6] = ["cancel", "live", "memory", "pipeline", "quality", "stability"];

/// What a report of quality varies.
const KNOBS: [&str; 9] = [
    "gather-rays",
    "photons",
    "radius",
    "blur",
    "direct-samples",
    "gather-divisor",
    "radiance-divisor",
    "path-tracing",
    "photons-alone",
];

/// Light map texels per metre of the atrium unless a density is given: it takes so many to show the
/// shadows of its balusters.
const ATRIUM_DENSITY: f32 = 30.0;

/// Images beyond this width or height are a slip of the finger.
const MAX_PICTURE: usize = 16384;

/// Parses the arguments after the program's name.
pub fn parse(args: impl IntoIterator<Item = OsString>) -> Result<Command, String> {
    let mut parser = lexopt::Parser::from_args(args);
    let mut report = ReportArgs::default();
    let (mut first, mut reported, mut scene, mut density) = (true, String::new(), None, None);
    // Flags that only one report has.
    let mut of_report: Vec<(&str, &str)> = Vec::new();
    while let Some(arg) = parser.next().map_err(|e| e.to_string())? {
        match arg {
            Arg::Short('h') | Arg::Long("help") => return Ok(Command::Help),
            Arg::Short('V') | Arg::Long("version") => return Ok(Command::Version),
            Arg::Value(v) if first && v == "bake" => {}
            Arg::Value(v) if first && v == "report" => {
                let there_are = REPORTS.join(", ");
                reported = match parser.value().ok() {
                    Some(kind) if REPORTS.iter().any(|r| kind == *r) => text("report", kind)?,
                    Some(kind) => return Err(format!("there is no report {kind:?}; there are: {there_are}")),
                    None => return Err(format!("report needs what to report; there are: {there_are}")),
                }
            }
            Arg::Value(v) => name_scene(&mut scene, text("SCENE", v)?)?,
            Arg::Long("scene") => name_scene(&mut scene, value("--scene", &mut parser)?)?,
            Arg::Short(c) => return Err(format!("there is no flag -{c}")),
            Arg::Long("texels-per-unit") => {
                density = Some(number("--texels-per-unit", &value("--texels-per-unit", &mut parser)?)?);
            }
            Arg::Long("seconds") => {
                of_report.push(("--seconds", "live"));
                report.seconds = seconds(&value("--seconds", &mut parser)?)?;
            }
            Arg::Long("updates") => {
                of_report.push(("--updates", "live"));
                report.updates = number("--updates", &value("--updates", &mut parser)?)?;
            }
            Arg::Long("points") => {
                of_report.push(("--points", "quality"));
                report.points = at_least_one("--points", &value("--points", &mut parser)?)? as usize;
            }
            Arg::Long("seeds") => {
                of_report.push(("--seeds", "quality"));
                report.seeds = at_least_one("--seeds", &value("--seeds", &mut parser)?)?;
            }
            Arg::Long("paths") => {
                of_report.push(("--paths", "quality"));
                report.paths = at_least_one("--paths", &value("--paths", &mut parser)?)?.min(u32::MAX.into()) as u32;
            }
            Arg::Long("view-paths") => {
                of_report.push(("--view-paths", "quality"));
                report.view_paths = number("--view-paths", &value("--view-paths", &mut parser)?)?;
            }
            Arg::Long("reference") => {
                of_report.push(("--reference", "quality"));
                report.reference = Some(PathBuf::from(value("--reference", &mut parser)?));
            }
            Arg::Long("knobs") => {
                of_report.push(("--knobs", "quality"));
                report.knobs = knobs(&value("--knobs", &mut parser)?)?;
            }
            Arg::Long(name) => {
                let name = name.to_owned();
                option(&name, &mut parser, &mut report.bake)?;
            }
        }
        first = false;
    }
    let bake = &mut report.bake;
    if let Some(scene) = scene {
        bake.scene = scene;
    }
    bake.desc.texels_per_unit = density.unwrap_or(if bake.scene == "atrium" { ATRIUM_DENSITY } else { 0.0 });
    if let Some((flag, kind)) = of_report.iter().find(|(_, kind)| *kind != reported) {
        return Err(format!("{flag} is for `report {kind}` alone"));
    }
    Ok(match reported.as_str() {
        "cancel" => Command::ReportCancel(Box::new(report.bake)),
        "live" => Command::ReportLive(Box::new(report)),
        "memory" => Command::ReportMemory(Box::new(report.bake)),
        "pipeline" => Command::ReportPipeline(Box::new(report.bake)),
        "quality" => Command::ReportQuality(Box::new(report)),
        "stability" => Command::ReportStability(Box::new(report.bake)),
        _ => Command::Bake(Box::new(report.bake)),
    })
}

/// Takes the scene's name, which may be given once.
fn name_scene(scene: &mut Option<String>, name: String) -> Result<(), String> {
    match scene.replace(name) {
        Some(first) => Err(format!("there are two scenes, {first:?} and {:?}", scene.as_deref().unwrap_or_default())),
        None => Ok(()),
    }
}

/// Takes one `--name` with its value.
fn option(name: &str, parser: &mut lexopt::Parser, bake: &mut BakeArgs) -> Result<(), String> {
    let flag = format!("--{name}");
    let mut value = || value(&flag, parser);
    let (desc, params) = (&mut bake.desc, &mut bake.params);
    match name {
        "base-folder" => bake.base_folder = Some(value()?.into()),
        "any-folder" => bake.any_folder = true,
        "max-texture-mb" => bake.max_texture_mb = number(&flag, &value()?)?,
        "max-file-mb" => bake.max_file_mb = number(&flag, &value()?)?,
        "light" => bake.lights.push(light(&value()?)?),
        "page-size" => desc.page_size = number(&flag, &value()?)?,
        "padding" => desc.padding = number(&flag, &value()?)?,
        "gather-divisor" => desc.gather_divisor = number(&flag, &value()?)?,
        "radiance-divisor" => desc.radiance_divisor = number(&flag, &value()?)?,
        "one-side" => desc.both_sides = false,
        "photons" => params.photon_count = number(&flag, &value()?)?,
        "bounces" => params.max_bounces = number(&flag, &value()?)?,
        "gather-rays" => params.gather_rays = number(&flag, &value()?)?,
        "radius" => params.radius = number(&flag, &value()?)?,
        "blur" => params.blur_radius = number(&flag, &value()?)?,
        "direct-samples" => params.direct_samples = number(&flag, &value()?)?,
        "seed" => params.seed = number(&flag, &value()?)?,
        "no-stitch" => params.stitch = false,
        "checkpoint" => bake.checkpoint = Some(value()?.into()),
        "checkpoint-seconds" => bake.checkpoint_seconds = number(&flag, &value()?)?,
        "shard" => bake.shard = Some(shard(&value()?)?),
        "save-result" => bake.save_result = Some(value()?.into()),
        "load-result" => bake.load_results.push(value()?.into()),
        "threads" => bake.threads = number(&flag, &value()?)?,
        "isa" => bake.isa = isa(&value()?)?,
        "bins" => bake.build.bins = number(&flag, &value()?)?,
        "leaf" => bake.build.max_leaf = number(&flag, &value()?)?,
        "build" => bake.build.quality = build_quality(&value()?)?,
        "compact" => bake.build.compact = true,
        "camera" => bake.camera = Some(camera(&value()?)?),
        "up" => bake.up = axis(&value()?)?,
        "width" => bake.width = picture_size(&flag, &value()?)?,
        "height" => bake.height = picture_size(&flag, &value()?)?,
        "reference-spp" => bake.reference_spp = number(&flag, &value()?)?,
        "out" => bake.out = value()?.into(),
        "no-glb" => bake.glb = false,
        "quiet" => bake.quiet = true,
        _ => return Err(unknown(&flag)),
    }
    Ok(())
}

/// The value of the flag that was just taken.
fn value(flag: &str, parser: &mut lexopt::Parser) -> Result<String, String> {
    match parser.value() {
        Ok(v) => text(flag, v),
        Err(_) => Err(format!("{flag} needs a value")),
    }
}

/// Names an unknown flag, and the known one that begins like it.
fn unknown(flag: &str) -> String {
    let known = HELP.split_whitespace().map(|w| w.trim_matches(|c| c == '[' || c == ']' || c == ','));
    let alike = |known: &str| {
        known.starts_with("--") && known.bytes().zip(flag.bytes()).take_while(|(a, b)| a == b).count() > 4
    };
    match known.filter(|k| alike(k)).max_by_key(|k| k.bytes().zip(flag.bytes()).take_while(|(a, b)| a == b).count()) {
        Some(k) => format!("there is no flag {flag}; did you mean {k}?"),
        None => format!("there is no flag {flag}"),
    }
}

fn text(what: &str, value: OsString) -> Result<String, String> {
    value.into_string().map_err(|v| format!("{what} is not valid UTF-8: {}", v.to_string_lossy()))
}

fn number<T: FromStr>(flag: &str, value: &str) -> Result<T, String> {
    let kind = if "0.5".parse::<T>().is_ok() { "a number" } else { "a whole number in range" };
    value.parse().map_err(|_| format!("{flag} is {value:?}, not {kind}"))
}

fn seconds(value: &str) -> Result<f64, String> {
    match number("--seconds", value)? {
        s if s > 0.0 && f64::is_finite(s) => Ok(s),
        s => Err(format!("--seconds is {s}, not a finite number greater than 0")),
    }
}

fn shard(value: &str) -> Result<[u64; 2], String> {
    let parts: Option<(u64, u64)> = value.split_once('/').and_then(|(i, n)| Some((i.parse().ok()?, n.parse().ok()?)));
    match parts {
        Some((i, n)) if (1..=n).contains(&i) => Ok([i - 1, n]),
        _ => Err(format!("--shard is {value:?}, not I/N with I from 1 to N")),
    }
}

fn knobs(value: &str) -> Result<Vec<String>, String> {
    let known = |name: &str| match KNOBS.contains(&name) {
        true => Ok(name.to_owned()),
        false => Err(format!("--knobs: there is no {name:?}; there are: {}", KNOBS.join(", "))),
    };
    if value == "none" {
        return Ok(Vec::new());
    }
    value.split(',').map(known).collect()
}

fn at_least_one(flag: &str, value: &str) -> Result<u64, String> {
    match number(flag, value)? {
        0 => Err(format!("{flag} is 0, not 1 or more")),
        n => Ok(n),
    }
}

fn picture_size(flag: &str, value: &str) -> Result<usize, String> {
    match number(flag, value)? {
        n if (1..=MAX_PICTURE).contains(&n) => Ok(n),
        n => Err(format!("{flag} is {n}, outside 1 to {MAX_PICTURE}")),
    }
}

fn build_quality(value: &str) -> Result<BuildQuality, String> {
    BuildQuality::ALL
        .into_iter()
        .find(|q| q.name() == value)
        .ok_or_else(|| format!("--build is {value:?}, neither default nor high"))
}

fn isa(value: &str) -> Result<Option<Isa>, String> {
    if value == "auto" {
        return Ok(None);
    }
    match Isa::ALL.into_iter().find(|i| i.name() == value) {
        Some(isa) => Ok(Some(isa)),
        None => Err(format!("--isa is {value:?}, not portable, avx2, avx512 or auto")),
    }
}

fn axis(value: &str) -> Result<Vec3, String> {
    match value {
        "x" => Ok(Vec3::X),
        "y" => Ok(Vec3::Y),
        "z" => Ok(Vec3::Z),
        _ => Err(format!("--up is {value:?}, not x, y or z")),
    }
}

/// `N` numbers with commas between them.
fn tuple<const N: usize>(flag: &str, what: &str, value: &str) -> Result<[f32; N], String> {
    let numbers: Result<Vec<f32>, _> = value.split(',').map(|n| n.trim().parse::<f32>()).collect();
    numbers.ok().and_then(|n| n.try_into().ok()).ok_or_else(|| {
        let form = if N == 2 { "a,b" } else { "a,b,c" };
        format!("{flag}: the {what} {value:?} is not {N} numbers {form}")
    })
}

fn light(value: &str) -> Result<GivenLight, String> {
    let flag = format!("--light {value}");
    let fields: Vec<&str> = value.split(':').collect();
    let vector = |i: usize, what: &str| tuple::<3>(&flag, what, fields[i]).map(Vec3::from);
    let color = |i: usize| tuple::<3>(&flag, "colour", fields[i]);
    let light = match (fields[0], fields.len()) {
        ("point", 3) => Light::Point { position: vector(1, "position")?, intensity: color(2)? },
        ("sun", 3 | 4) => {
            let degrees = if fields.len() == 4 { number::<f32>(&flag, fields[3])? } else { 0.0 };
            let (direction, irradiance) = (vector(1, "direction")?, color(2)?);
            Light::Directional { direction, irradiance, angular_radius: degrees.to_radians() }
        }
        ("sky", 2 | 3) => return sky(&flag, &fields),
        ("spot", 5) => {
            let [inner, outer] = tuple::<2>(&flag, "cone", fields[3])?.map(f32::to_radians);
            let (position, direction) = (vector(1, "position")?, vector(2, "direction")?);
            Light::Spot { position, direction, inner, outer, intensity: color(4)? }
        }
        ("rect", 5) => Light::Rect {
            position: vector(1, "corner")?,
            edge_u: vector(2, "edge u")?,
            edge_v: vector(3, "edge v")?,
            radiance: color(4)?,
        },
        (kind @ ("point" | "sun" | "spot" | "rect" | "sky"), n) => {
            let expected = match kind {
                "point" => "3",
                "sun" => "3 or 4",
                "sky" => "2 or 3",
                _ => "5",
            };
            return Err(format!("{flag} has {n} parts between colons, a {kind} has {expected} (see --help)"));
        }
        (kind, _) => return Err(format!("{flag}: the kind {kind:?} is not point, spot, sun, sky or rect")),
    };
    light.validate().map_err(|e| format!("{flag}: {e}"))?;
    Ok(GivenLight { light, image: None })
}

/// A colour for all directions, or an image.
fn sky(flag: &str, fields: &[&str]) -> Result<GivenLight, String> {
    let sky = |radiance| Light::Sky { radiance, environment: NONE, up: Vec3::Y, rotation: 0.0 };
    let is_image = [".hdr", ".exr"].iter().any(|e| fields[1].to_lowercase().ends_with(e));
    let given = if is_image {
        let scale = if fields.len() == 3 { number(flag, fields[2])? } else { 1.0 };
        GivenLight { light: sky([scale; 3]), image: Some(fields[1].into()) }
    } else if fields.len() == 3 {
        return Err(format!("{flag}: {:?} is not a .hdr or .exr file, and a colour has no scale", fields[1]));
    } else {
        GivenLight { light: sky(tuple::<3>(flag, "colour", fields[1])?), image: None }
    };
    given.light.validate().map_err(|e| format!("{flag}: {e}"))?;
    Ok(given)
}

fn camera(value: &str) -> Result<Camera, String> {
    let flag = format!("--camera {value}");
    let fields: Vec<&str> = value.split(':').collect();
    if !(2..=3).contains(&fields.len()) {
        return Err(format!("{flag} is not position:target or position:target:fov"));
    }
    let position = Vec3::from(tuple::<3>(&flag, "position", fields[0])?);
    let target = Vec3::from(tuple::<3>(&flag, "target", fields[1])?);
    let degrees: f32 = fields.get(2).map_or(Ok(60.0), |f| number("--camera: the field of view", f))?;
    if !position.is_finite() || !target.is_finite() || position == target {
        return Err(format!("{flag}: position and target are not two finite points"));
    }
    if !(0.1..=170.0).contains(&degrees) {
        return Err(format!("{flag}: the field of view is {degrees}, outside 0.1 to 170 degrees"));
    }
    Ok(Camera { position, target, up: Vec3::ZERO, fov_y: degrees.to_radians() })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bake(line: &str) -> Result<BakeArgs, String> {
        match parse(line.split_whitespace().map(OsString::from))? {
            Command::Bake(b) => Ok(*b),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn no_arguments_bake_the_atrium() {
        let b = bake("").unwrap();
        assert_eq!((b.scene.as_str(), b.out.to_str().unwrap(), b.glb), ("atrium", "out", true));
        assert_eq!(bake("bake").unwrap().scene, "atrium");
        let density = |line: &str| bake(line).unwrap().desc.texels_per_unit;
        assert_eq!((density(""), density("--texels-per-unit 0"), density("x.obj")), (ATRIUM_DENSITY, 0.0, 0.0));
    }

    #[test]
    fn a_scene_may_be_called_bake_the_second_time() {
        assert_eq!(bake("bake bake").unwrap().scene, "bake");
        assert_eq!(bake("x.obj").unwrap().scene, "x.obj");
        assert!(bake("bake a b").unwrap_err().contains("two scenes, \"a\" and \"b\""));
    }

    #[test]
    fn a_report_takes_the_flags_of_a_bake_and_its_own() {
        let report = |line: &str| match parse(line.split_whitespace().map(OsString::from)) {
            Ok(Command::ReportLive(r)) => *r,
            other => panic!("{line}: {other:?}"),
        };
        let r = report("report live --scene s.obj --photons 5 --seconds 2.5 --updates 7");
        assert_eq!((r.bake.scene.as_str(), r.bake.params.photon_count), ("s.obj", 5));
        assert_eq!((r.seconds, r.updates), (2.5, 7));
        let r = report("report live");
        assert_eq!((r.bake.scene.as_str(), r.bake.desc.texels_per_unit), ("atrium", ATRIUM_DENSITY));
        assert_eq!(bake("report.obj").unwrap().scene, "report.obj");
    }

    #[test]
    fn every_flag_of_the_help_is_known_and_takes_hold() {
        let b = bake(
            "bake s.obj --light point:1,2,3:4,5,6 --light spot:0,0,0:0,-1,0:20,30:1,1,1 --light sun:0,-1,0:7,8,9 \
             --light sun:0,-1,0:7,8,9:90 --light sky:1,2,3 --light sky:a.HDR:2.5 \
             --light rect:0,0,0:1,0,0:0,0,1:2,2,2 --texels-per-unit 2.5 --page-size 256 --padding 3 --gather-divisor 2 \
             --radiance-divisor 16 --photons 5 --bounces 6 --gather-rays 7 --radius 0.5 --blur 8 --direct-samples 9 \
             --seed 10 --threads 2 --isa portable --bins 32 --leaf 4 --build high --compact --camera 0,1,2:3,4,5:40 --up z --width 64 \
             --height 48 --reference-spp 3 --out o --no-glb --one-side --quiet --checkpoint c --checkpoint-seconds 2.5 \
             --shard 2/3 --save-result r --load-result a --load-result b",
        )
        .unwrap();
        assert_eq!(b.lights.len(), 7);
        assert_eq!(b.lights[0].light, Light::Point { position: Vec3::new(1.0, 2.0, 3.0), intensity: [4.0, 5.0, 6.0] });
        let Light::Directional { angular_radius, .. } = b.lights[3].light else { panic!() };
        assert!((angular_radius - std::f32::consts::FRAC_PI_2).abs() < 1e-6);
        assert_eq!((b.lights[4].light.color(), &b.lights[4].image), ([1.0, 2.0, 3.0], &None));
        assert_eq!((b.lights[5].light.color(), b.lights[5].image.as_deref()), ([2.5; 3], Some("a.HDR".as_ref())));
        for bad in ["sky", "sky:a.png", "sky:1,2,3:4", "sky:-1,0,0", "sun:0,-1,0:7,8,9:91"] {
            assert!(bake(&format!("bake s.obj --light {bad}")).is_err(), "{bad}");
        }
        assert_eq!((b.checkpoint.as_deref(), b.checkpoint_seconds), (Some("c".as_ref()), 2.5));
        assert_eq!((b.shard, b.save_result.as_deref()), (Some([1, 3]), Some("r".as_ref())));
        assert_eq!(b.load_results, [PathBuf::from("a"), PathBuf::from("b")]);
        for bad in ["0/3", "4/3", "1", "1/x"] {
            assert!(bake(&format!("bake s.obj --shard {bad}")).is_err(), "{bad}");
        }
        assert_eq!((b.desc.texels_per_unit, b.desc.page_size, b.desc.padding), (2.5, 256, 3));
        assert_eq!((b.desc.gather_divisor, b.desc.radiance_divisor, b.desc.both_sides), (2, 16, false));
        let p = &b.params;
        assert_eq!((p.photon_count, p.max_bounces, p.gather_rays, p.radius, p.blur_radius), (5, 6, 7, 0.5, 8));
        assert_eq!((p.direct_samples, p.seed, b.threads, b.isa), (9, 10, 2, Some(Isa::Portable)));
        assert_eq!((b.build.bins, b.build.max_leaf, b.build.quality, b.up), (32, 4, BuildQuality::High, Vec3::Z));
        assert!(b.build.compact);
        let camera = b.camera.unwrap();
        assert_eq!((camera.position, camera.target), (Vec3::new(0.0, 1.0, 2.0), Vec3::new(3.0, 4.0, 5.0)));
        assert!((camera.fov_y.to_degrees() - 40.0).abs() < 1e-4);
        assert_eq!((b.width, b.height, b.reference_spp), (64, 48, 3));
        assert_eq!((b.out.to_str().unwrap(), b.glb, b.quiet), ("o", false, true));
        assert_eq!(bake("--scene s.obj").unwrap().scene, "s.obj");
        let flags = HELP.split(|c: char| c.is_whitespace() || c == ',').filter(|w| w.starts_with("--"));
        for flag in flags.filter(|f| !matches!(*f, "--help" | "--version")) {
            let found = bake(&format!("{flag} ?")).err();
            assert!(!found.is_some_and(|e| e.contains("no flag")), "{flag} is in the help but unknown");
        }
    }

    #[test]
    fn errors_name_the_flag_and_the_value() {
        for (line, part) in [
            ("--photon 5", "no flag --photon; did you mean --photons?"),
            ("--nonsense", "no flag --nonsense"),
            ("-x", "no flag -x"),
            ("--photons", "--photons needs a value"),
            ("--photons many", "--photons is \"many\", not a whole number"),
            ("--photons -3", "--photons is \"-3\", not a whole number"),
            ("--texels-per-unit dense", "--texels-per-unit is \"dense\", not a number"),
            ("--light point:1,2:3,4,5", "the position \"1,2\" is not 3 numbers"),
            ("--light point:1,2,3:a,4,5", "the colour \"a,4,5\" is not 3 numbers"),
            ("--light rect:1,2,3:1,1,1", "has 3 parts between colons, a rect has 5"),
            ("--light lamp:1,2,3", "the kind \"lamp\" is not point"),
            ("--light sun:0,0,0:1,1,1", "direction is zero"),
            ("--light rect:0,0,0:1,0,0:1,0,0:1,1,1", "no area"),
            ("--light point:0,0,0:-1,0,0", "less than 0"),
            ("--isa sse9", "--isa is \"sse9\""),
            ("--up w", "--up is \"w\""),
            ("--camera 1,2,3", "is not position:target"),
            ("--camera 1,2,3:1,2,3", "not two finite points"),
            ("--camera 0,0,0:1,2,3:200", "field of view is 200"),
            ("--width 0", "--width is 0, outside 1"),
            ("a --scene b", "two scenes, \"a\" and \"b\""),
            ("report", "report needs what to report; there are: cancel, live, memory, pipeline, quality, stability"),
            (
                "report dead",
                "there is no report \"dead\"; there are: cancel, live, memory, pipeline, quality, stability",
            ),
            ("report live --seconds 0", "--seconds is 0, not a finite number greater than 0"),
            ("report live --seconds inf", "--seconds is inf"),
            ("report live --updates 1.5", "--updates is \"1.5\", not a whole number"),
            ("report memory --updates 5", "--updates is for `report live` alone"),
            ("--updates 5", "--updates is for `report live` alone"),
            ("report live --seeds 5", "--seeds is for `report quality` alone"),
            ("report quality --knobs photon", "there is no \"photon\"; there are: gather-rays, photons,"),
            ("report quality --points 0", "--points is 0, not 1 or more"),
        ] {
            let e = bake(line).unwrap_err();
            assert!(e.contains(part), "{line}: {e}");
        }
    }
}
