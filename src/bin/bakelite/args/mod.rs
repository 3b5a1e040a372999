//! Arguments of the command line.
//!
//! | file | what it does |
//! |---|---|
//! | `flags` | flags with their help, defaults and ranges |
//! | `values` | values in forms of their own: lights, cameras, parts |

mod flags;
#[cfg(test)]
mod tests;
mod values;

use bakelite::Isa;
use bakelite::bvh::{BuildOptions, BuildQuality};
use bakelite::io::LoadOptions;
use bakelite::lightmap::quality::Quality;
use bakelite::lightmap::{BakeParams, Layer, LightmapDesc, directional};
use bakelite::live::LiveParams;
use bakelite::scene::{Camera, is_builtin};
use clap::error::ErrorKind;
use clap::parser::ValueSource;
use clap::{CommandFactory, FromArgMatches};
use flags::{CommandLine, Flags, Report, Verb};
use glam::Vec3;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
pub use values::{GivenLight, is_scene_file};

/// What to do.
pub enum Command {
    Bake(Box<BakeArgs>),
    Commit(Box<BakeArgs>),
    ReportCancel(Box<BakeArgs>),
    ReportDirectional(Box<ReportArgs>),
    ReportLive(Box<ReportArgs>),
    ReportMemory(Box<BakeArgs>),
    ReportPipeline(Box<BakeArgs>),
    ReportQuality(Box<ReportArgs>),
    ReportEdits(Box<ReportArgs>),
    ReportCoherence(Box<ReportArgs>),
    ReportScaling(Box<ReportArgs>),
    ReportStability(Box<BakeArgs>),
}

/// A layer of the light map that can become pages.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NamedLayer {
    /// On the command line and in file names.
    pub name: &'static str,
    pub layer: Layer,
    /// Unit of its values; empty: none.
    pub unit: &'static str,
    /// Whether it is light, which can be tone mapped.
    pub is_light: bool,
}

const fn layer(name: &'static str, layer: Layer, unit: &'static str, is_light: bool) -> NamedLayer {
    NamedLayer { name, layer, unit, is_light }
}

/// The layers of which images make sense, those that are written unless others are asked for first.
pub const LAYERS: [NamedLayer; 16] = [
    layer("combined", Layer::Combined, "W/m2", true),
    layer("indirect", Layer::Indirect, "W/m2", true),
    layer("direct", Layer::Direct, "W/m2", true),
    layer("radiance", Layer::Radiance, "W/(m2 sr)", true),
    layer("validity", Layer::Validity, "", false),
    layer("position", Layer::Position, "scene units", false),
    layer("normal", Layer::Normal, "", false),
    layer("l0", Layer::L0, "W/(m2 sr)", false),
    layer("l1x", Layer::L1X, "W/(m2 sr)", false),
    layer("l1y", Layer::L1Y, "W/(m2 sr)", false),
    layer("l1z", Layer::L1Z, "W/(m2 sr)", false),
    layer("ratio-x", Layer::RatioX, "", false),
    layer("ratio-y", Layer::RatioY, "", false),
    layer("ratio-z", Layer::RatioZ, "", false),
    layer("direction", Layer::Direction, "", false),
    layer("error", Layer::Error, "W/m2", false),
];

/// The layers that are written unless others are asked for, and those that come with light by direction.
pub const DEFAULT_LAYERS: [&str; 4] = ["combined", "indirect", "direct", "radiance"];
const DIRECTIONAL_LAYERS: [&str; 4] = ["l0", "ratio-x", "ratio-y", "ratio-z"];

/// The kinds of files that a bake writes.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Formats {
    /// Pages as floats.
    pub exr: bool,
    /// Pages as half floats.
    pub exr_half: bool,
    /// Pages tone mapped.
    pub png: bool,
    /// The scene with its light map.
    pub glb: bool,
}

/// Arguments of `bakelite bake`.
#[derive(Clone, Debug)]
pub struct BakeArgs {
    /// A file or a built-in name.
    pub scene: String,
    /// Whether the scene was named, and is not that of a first try.
    pub scene_is_given: bool,
    /// Which files it may consist of, and how much of them.
    pub base_folder: Option<PathBuf>,
    pub any_folder: bool,
    pub max_texture_mb: u64,
    pub max_file_mb: u64,
    pub save_scene: Option<PathBuf>,
    pub trees_from: Option<PathBuf>,
    pub read_scene: bool,
    pub ray_queues: bool,
    /// How often the scene stands beside itself, and whether as instances.
    pub repeat: u32,
    pub instances: bool,
    /// Whether all instances of a mesh show the light of the first one.
    pub share_light: bool,
    pub lights: Vec<GivenLight>,
    pub desc: LightmapDesc,
    pub layout: Option<PathBuf>,
    pub cache: Option<PathBuf>,
    pub scratch: Option<PathBuf>,
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
    pub layers: Vec<NamedLayer>,
    pub formats: Formats,
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

#[cfg(test)]
impl Default for BakeArgs {
    /// Those of a bake of the atrium, at the library's density.
    fn default() -> Self {
        let Ok(Command::Bake(mut bake)) = parse(["bake".into()]) else { panic!("a bake without flags is refused") };
        bake.desc = LightmapDesc::default();
        *bake
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
    /// Live: time budgets in milliseconds, and most KB of texels that an update gives out (0: no limit).
    pub budgets_ms: Vec<f32>,
    pub dirty_kb: Vec<u32>,
    /// Live: milliseconds from one update to the next.
    pub frame_ms: f64,
    /// Live: whether errors are followed.
    pub errors: bool,
    /// Live: parameters of the updates.
    pub live: LiveParams,
    /// Quality: points at which light is compared.
    pub points: usize,
    /// Quality: seed of the places and the points.
    pub points_seed: u32,
    /// Edits: objects that move, one after another.
    pub objects: usize,
    /// Quality: bakes per setting.
    pub seeds: u64,
    /// Quality: paths per point of the reference.
    pub paths: u32,
    /// Quality: the points of an earlier report.
    pub reference: Option<PathBuf>,
    /// Quality: paths per pixel of the reference's view; 0: no view.
    pub view_paths: u32,
    /// Quality: what to vary, of [`flags::KNOBS`].
    pub knobs: Vec<String>,
    /// Scaling: what is baked, one after another.
    pub scenes: Vec<String>,
    /// Scaling: whether light maps are left out.
    pub rays_only: bool,
    /// Scaling: texels per unit with which each scene is baked, instead of the one of the light map.
    pub densities: Vec<f32>,
}

/// Light map texels per metre of the atrium unless a density is given: it takes so many to show the
/// shadows of its balusters.
const ATRIUM_DENSITY: f32 = 30.0;

/// Paths per pixel of the reference of built-in scenes unless a number is given: for a first look. Scenes of one's own
/// have no pictures unless asked for: paths can take longer than the bake.
const BUILTIN_SPP: u32 = 32;

/// Parses the arguments after the program's name. The error is also what `--help` and `--version` print.
pub fn parse(args: impl IntoIterator<Item = OsString>) -> Result<Command, clap::Error> {
    let mut args: Vec<OsString> = args.into_iter().collect();
    // Without a command, `bake` is meant. A word that looks like no scene is left to clap, which says what it is like.
    let names_verb = args.first().is_some_and(|first| {
        let first = first.to_string_lossy();
        match first.strip_prefix('-') {
            Some(flag) => matches!(flag, "h" | "-help" | "V" | "-version"),
            None => command().find_subcommand(&*first).is_some() || !values::is_scene(&first),
        }
    });
    if !names_verb {
        args.insert(0, "bake".into());
    }
    args.insert(0, "bakelite".into());
    let mut command = command();
    let matches = command.try_get_matches_from_mut(args)?;
    let mut line = CommandLine::from_arg_matches(&matches)?;
    let mut of_command = &matches;
    while let Some((_, deeper)) = of_command.subcommand() {
        of_command = deeper;
    }
    let is_given = |id: &str| of_command.value_source(id) == Some(ValueSource::CommandLine);
    set_quality(line.verb.flags(), &is_given);
    command_of(line, &is_given).map_err(|e| command.error(ErrorKind::ValueValidation, e))
}

/// Sets the flags of the quality that was asked for, but for those that are given themselves.
fn set_quality(flags: &mut Flags, is_given: &dyn Fn(&str) -> bool) {
    let Some((quality, _)) = Quality::ALL.into_iter().find(|(_, name)| *name == flags.lightmap.quality) else { return };
    let (mut desc, mut params) = (LightmapDesc::default(), BakeParams::default());
    quality.set_desc(&mut desc);
    quality.set_params(&mut params);
    fn set<T>(flag: &mut T, value: T, is_given: bool) {
        if !is_given {
            *flag = value;
        }
    }
    let (map, bake) = (&mut flags.lightmap, &mut flags.bake);
    set(&mut map.gather_divisor, desc.gather_divisor, is_given("gather_divisor"));
    set(&mut map.radiance_divisor, desc.radiance_divisor, is_given("radiance_divisor"));
    set(&mut bake.photons, params.photon_count, is_given("photons"));
    set(&mut bake.gather_rays, params.gather_rays, is_given("gather_rays"));
    set(&mut bake.near_hits, params.near_hits, is_given("near_hits"));
    set(&mut bake.interpolation_error, params.interpolation_error, is_given("interpolation_error"));
    set(&mut bake.blur, params.blur_radius, is_given("blur"));
    set(&mut bake.direct_samples, params.direct_samples, is_given("direct_samples"));
    set(&mut bake.passes, params.passes, is_given("passes"));
}

/// The whole command line. Negative numbers are values everywhere, so that errors say which flag has them.
fn command() -> clap::Command {
    fn negative_numbers(command: clap::Command) -> clap::Command {
        let value = |arg: clap::Arg| match arg.get_action().takes_values() {
            true => arg.allow_negative_numbers(true),
            false => arg,
        };
        command.mut_args(value).mut_subcommands(negative_numbers)
    }
    negative_numbers(CommandLine::command())
}

fn command_of(line: CommandLine, is_given: &dyn Fn(&str) -> bool) -> Result<Command, String> {
    let boxed = |flags: Box<Flags>| bake_args(*flags).map(Box::new);
    Ok(match line.verb {
        Verb::Bake(flags) => Command::Bake(boxed(flags)?),
        Verb::Commit(flags) => {
            if flags.file.save_scene.is_none() {
                return Err("--save-scene is missing: where the scene is written to".into());
            }
            Command::Commit(boxed(flags)?)
        }
        Verb::Report(Report::Cancel(flags)) => Command::ReportCancel(boxed(flags)?),
        Verb::Report(Report::Memory(flags)) => Command::ReportMemory(boxed(flags)?),
        Verb::Report(Report::Pipeline(flags)) => Command::ReportPipeline(boxed(flags)?),
        Verb::Report(Report::Stability(flags)) => Command::ReportStability(boxed(flags)?),
        Verb::Report(Report::Directional(d)) => Command::ReportDirectional(Box::new(ReportArgs {
            points: d.points as usize,
            paths: d.paths,
            seeds: d.runs,
            ..report_args(d.flags)?
        })),
        Verb::Report(Report::Live(live)) => {
            if live.promote > live.rounds {
                return Err(format!("--promote is {}, more than --rounds {}", live.promote, live.rounds));
            }
            let mut args = ReportArgs {
                seconds: live.seconds,
                updates: live.updates,
                budgets_ms: live.budgets.iter().map(|&b| b as f32).collect(),
                dirty_kb: live.dirty_kb,
                frame_ms: live.frame_ms,
                errors: !live.no_errors,
                ..report_args(live.flags)?
            };
            let bake = &args.bake.params;
            args.live = LiveParams {
                lod_count: live.lods,
                max_rounds: live.rounds,
                promote_threshold: live.promote,
                cell_size: live.cell_size.unwrap_or(0.0) as f32,
                rays_per_update: live.update_rays,
                blur: bake.blur_radius,
                seed: bake.seed,
                photon_count: bake.photon_count,
                max_bounces: bake.max_bounces,
                direct_samples: bake.direct_samples,
                radius: bake.radius,
                near_hits: bake.near_hits,
                directional: bake.directional,
                quick_start: live.quick_start,
                ..Default::default()
            };
            // Live updates have defaults of their own.
            if is_given("interpolation_error") {
                args.live.interpolation_error = bake.interpolation_error;
            }
            if is_given("own_rays") && bake.own_rays > 0 {
                args.live.own_rays = bake.own_rays;
            }
            Command::ReportLive(Box::new(args))
        }
        Verb::Report(Report::Edits(edits)) => {
            Command::ReportEdits(Box::new(ReportArgs { objects: edits.objects as usize, ..report_args(edits.flags)? }))
        }
        Verb::Report(Report::Coherence(coherence)) => {
            let scenes = coherence.scenes;
            Command::ReportCoherence(Box::new(ReportArgs { scenes, ..report_args(coherence.flags)? }))
        }
        Verb::Report(Report::Scaling(scaling)) => {
            let (scenes, rays_only, densities) = (scaling.scenes, scaling.rays_only, scaling.densities);
            let flags = report_args(scaling.flags)?;
            Command::ReportScaling(Box::new(ReportArgs { scenes, rays_only, densities, ..flags }))
        }
        Verb::Report(Report::Quality(quality)) => Command::ReportQuality(Box::new(ReportArgs {
            points: quality.points as usize,
            points_seed: quality.points_seed,
            seeds: quality.seeds,
            paths: quality.paths,
            reference: quality.reference,
            view_paths: quality.view_paths,
            knobs: quality.knobs.into_iter().filter(|k| k != "none").collect(),
            ..report_args(quality.flags)?
        })),
    })
}

/// A report's arguments without those of its own.
fn report_args(flags: Flags) -> Result<ReportArgs, String> {
    Ok(ReportArgs {
        bake: bake_args(flags)?,
        seconds: 0.0,
        updates: 0,
        budgets_ms: Vec::new(),
        dirty_kb: Vec::new(),
        frame_ms: 0.0,
        errors: true,
        live: LiveParams::default(),
        points: 0,
        points_seed: 0,
        objects: 0,
        seeds: 0,
        paths: 0,
        reference: None,
        view_paths: 0,
        knobs: Vec::new(),
        scenes: Vec::new(),
        rays_only: false,
        densities: Vec::new(),
    })
}

fn bake_args(f: Flags) -> Result<BakeArgs, String> {
    let given = f.scene.or(f.scene_flag);
    let scene_is_given = given.is_some();
    let scene = given.unwrap_or_else(|| "atrium".into());
    let desc = LightmapDesc {
        texels_per_unit: f.lightmap.texels_per_unit.unwrap_or(if scene == "atrium" { ATRIUM_DENSITY } else { 0.0 }),
        page_size: f.lightmap.page_size,
        padding: f.lightmap.padding,
        gather_divisor: f.lightmap.gather_divisor,
        radiance_divisor: f.lightmap.radiance_divisor,
        both_sides: !f.lightmap.one_side,
        seen_from: f.lightmap.seen_from,
    };
    // Each value is in its range; together they may still not be.
    desc.validate().map_err(|e| format!("--padding {} with --page-size {}: {e}", desc.padding, desc.page_size))?;
    let bits = match f.bake.directional.as_str() {
        "indirect" => directional::INDIRECT,
        "direct" => directional::DIRECT,
        "all" => directional::INDIRECT | directional::DIRECT,
        _ => 0,
    };
    let params = BakeParams {
        photon_count: f.bake.photons,
        max_bounces: f.bake.bounces,
        gather_rays: f.bake.gather_rays,
        radius: f.bake.radius,
        near_hits: f.bake.near_hits,
        interpolation_error: f.bake.interpolation_error,
        interpolation_contrast: f.bake.interpolation_contrast,
        own_rays: f.bake.own_rays,
        blur_radius: f.bake.blur,
        direct_samples: f.bake.direct_samples,
        seed: f.bake.seed,
        stitch: !f.bake.no_stitch,
        directional: bits,
        passes: f.bake.passes,
        target_error: f.bake.target_error,
        ..Default::default()
    };
    let build = BuildOptions {
        bins: f.machine.bins,
        max_leaf: f.machine.leaf,
        quality: BuildQuality::ALL.into_iter().find(|q| q.name() == f.machine.build).unwrap_or_default(),
        compact: f.machine.compact,
        ..Default::default()
    };
    let has = |format: &str| f.output.format.iter().any(|f| f == format);
    let formats =
        Formats { exr: has("exr"), exr_half: has("exr-half"), png: has("png"), glb: has("glb") && !f.output.no_glb };
    if formats.exr && formats.exr_half {
        return Err("--format has exr and exr-half, which would be the same files".into());
    }
    let mut asked: Vec<&str> = f.output.layers.iter().map(String::as_str).collect();
    let has_floats = formats.exr || formats.exr_half;
    if asked == DEFAULT_LAYERS && bits != 0 && has_floats {
        asked.extend(DIRECTIONAL_LAYERS);
    }
    let has_error = params.passes > 1 || params.target_error > 0.0;
    if asked.starts_with(&DEFAULT_LAYERS) && has_error && has_floats {
        asked.push("error");
    }
    let layers: Vec<NamedLayer> = LAYERS.into_iter().filter(|l| asked.contains(&l.name)).collect();
    let by_direction = |l: &&NamedLayer| (Layer::L0 as u32..=Layer::Direction as u32).contains(&(l.layer as u32));
    if let Some(layer) = layers.iter().find(by_direction)
        && bits == 0
    {
        return Err(format!("--layers has {}, for which there is --directional", layer.name));
    }
    if layers.iter().any(|l| l.layer == Layer::Error) && !has_error {
        return Err("--layers has error, which takes --passes of 2 or more, or --target-error".into());
    }
    if let Some(layer) = layers.iter().find(|l| !l.is_light && (l.layer != Layer::Error || !has_error))
        && formats.png
        && !has_floats
    {
        return Err(format!("--layers has {}, which no PNG can show: --format exr", layer.name));
    }
    Ok(BakeArgs {
        reference_spp: f.pictures.reference_spp.unwrap_or(if is_builtin(&scene) { BUILTIN_SPP } else { 0 }),
        scene,
        scene_is_given,
        base_folder: f.file.base_folder,
        any_folder: f.file.any_folder,
        max_texture_mb: f.file.max_texture_mb,
        max_file_mb: f.file.max_file_mb,
        save_scene: f.file.save_scene,
        trees_from: f.file.trees_from,
        read_scene: f.file.read_scene,
        ray_queues: f.file.ray_queues,
        repeat: f.file.repeat,
        instances: f.file.instances,
        share_light: f.file.share_light,
        lights: f.lights.light,
        desc,
        layout: f.lightmap.layout,
        cache: f.lightmap.cache,
        scratch: f.lightmap.scratch,
        params,
        build,
        threads: f.machine.threads,
        isa: Isa::ALL.into_iter().find(|i| i.name() == f.machine.isa),
        camera: f.pictures.camera,
        up: match f.pictures.up.as_str() {
            "x" => Vec3::X,
            "z" => Vec3::Z,
            _ => Vec3::Y,
        },
        width: f.pictures.width as usize,
        height: f.pictures.height as usize,
        out: f.output.out,
        layers,
        formats,
        quiet: f.output.quiet,
        checkpoint: f.parts.checkpoint,
        checkpoint_seconds: f.parts.checkpoint_seconds,
        shard: f.parts.shard,
        save_result: f.parts.save_result,
        load_results: f.parts.load_result,
    })
}
