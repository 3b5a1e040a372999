//! Flags with their help, defaults and ranges. Lengths are in scene units, colours are linear.

use super::values::{self, GivenLight, of};
use bakelite::Isa;
use bakelite::bvh::{BuildOptions, BuildQuality};
use bakelite::lightmap::quality::Quality;
use bakelite::lightmap::{BakeParams, LightmapDesc, Region};
use bakelite::scene::Camera;
use clap::builder::PossibleValuesParser;
use clap::{Args, Parser, Subcommand};
use std::path::PathBuf;

/// Bakes light maps
///
/// Without a command, `bake` is meant; without a scene, the built-in atrium.
#[derive(Parser)]
#[command(name = "bakelite", version, override_usage = USAGE, after_help = EXAMPLES)]
pub struct CommandLine {
    #[command(subcommand)]
    pub verb: Verb,
}

const USAGE: &str = "bakelite [bake] [SCENE] [OPTIONS]
       bakelite report WHAT [SCENE] [OPTIONS]";

const EXAMPLES: &str = "Examples:
  bakelite                                     bakes the built-in atrium into out/
  bakelite bake scene.glb --light sky:1,1,1    bakes a scene under a grey sky
  bakelite help bake                           lists all flags of a bake
  bakelite help report                         lists what there is to report";

#[derive(Subcommand)]
pub enum Verb {
    /// Bakes the light of a scene into light maps
    Bake(Box<Flags>),
    /// Builds a scene's tree and writes both to --save-scene, to be given as SCENE then
    Commit(Box<Flags>),
    /// Measures instead, and writes tables, plots and CSV
    #[command(subcommand)]
    Report(Report),
}

#[derive(Subcommand)]
pub enum Report {
    /// How long each call is silent, and how soon it ends when it is cancelled
    Cancel(Box<Flags>),
    /// Rates of rays by tree, way and coherence against the number of triangles, with fitted exponents
    Coherence(Box<CoherenceFlags>),
    /// Light by direction under a normal map: error beside irradiance alone, time and memory
    Directional(Box<DirectionalFlags>),
    /// Seconds to right light after an object has moved, and the difference from a bake from nothing
    Edits(Box<EditsFlags>),
    /// Live updates: error against time and rays, budgets, traffic, memory
    Live(Box<LiveFlags>),
    /// The scene's memory, default and compact, and what that costs rays
    Memory(Box<Flags>),
    /// What each stage of a bake takes, and what bounds it
    Pipeline(Box<Flags>),
    /// Error of the light and likeness of a view against run time, for every knob of a bake, path tracing and photons
    /// alone
    Quality(Box<QualityFlags>),
    /// Time, memory and rates of rays against the number of triangles, with fitted exponents
    Scaling(Box<ScalingFlags>),
    /// Stiff and extreme cases, each against what is known of it (SCENE: its energy balance too)
    Stability(Box<Flags>),
}

impl Verb {
    /// The flags that all commands have.
    pub fn flags(&mut self) -> &mut Flags {
        match self {
            Verb::Bake(flags) | Verb::Commit(flags) => flags,
            Verb::Report(report) => match report {
                Report::Cancel(flags) | Report::Memory(flags) | Report::Pipeline(flags) | Report::Stability(flags) => {
                    flags
                }
                Report::Coherence(of_report) => &mut of_report.flags,
                Report::Directional(of_report) => &mut of_report.flags,
                Report::Edits(of_report) => &mut of_report.flags,
                Report::Live(of_report) => &mut of_report.flags,
                Report::Quality(of_report) => &mut of_report.flags,
                Report::Scaling(of_report) => &mut of_report.flags,
            },
        }
    }
}

#[derive(Args)]
pub struct EditsFlags {
    /// Objects that move, one after another
    #[arg(long, value_name = "N", help_heading = "Report edits", default_value_t = 3,
          value_parser = clap::value_parser!(u64).range(1..))]
    pub objects: u64,
    #[command(flatten)]
    pub flags: Flags,
}

#[derive(Args)]
pub struct LiveFlags {
    #[command(flatten)]
    pub flags: Flags,
    /// Most time per curve of errors
    #[arg(long, value_name = "F", help_heading = "Report live", default_value_t = 20.0, value_parser = values::positive)]
    pub seconds: f64,
    /// Updates per time budget; 0: budgets are not measured
    #[arg(long, value_name = "N", help_heading = "Report live", default_value_t = 10_000)]
    pub updates: u32,
    /// Time budgets in ms
    #[arg(long, value_name = "F,...", help_heading = "Report live", value_delimiter = ',',
          default_values_t = [1.0, 2.0, 4.0, 8.0], value_parser = values::positive)]
    pub budgets: Vec<f64>,
    /// Most KB of texels that an update gives out; 0: no limit
    #[arg(long, value_name = "N,...", help_heading = "Report live", value_delimiter = ',', default_values_t = [0])]
    pub dirty_kb: Vec<u32>,
    /// Milliseconds from one update to the next, in which a program would do something else; 0: updates follow at once
    #[arg(long, value_name = "F", help_heading = "Report live", default_value_t = 0.0, value_parser = values::not_negative)]
    pub frame_ms: f64,
    /// Leaves out errors against time, and the references that they need
    #[arg(long, help_heading = "Report live")]
    pub no_errors: bool,
    /// Begins with a first impression of indirect light
    #[arg(long, help_heading = "Report live")]
    pub quick_start: bool,
    /// Levels of detail
    #[arg(long, value_name = "N", help_heading = "Report live", default_value_t = 3,
          value_parser = clap::value_parser!(u32).range(1..=4))]
    pub lods: u32,
    /// Rounds of 64 rays until a texel is finished, where errors are followed
    #[arg(long, value_name = "N", help_heading = "Report live", default_value_t = 16,
          value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub rounds: u32,
    /// Rounds of all texels of a cell before it shows its next level of detail, at most --rounds
    #[arg(long, value_name = "N", help_heading = "Report live", default_value_t = 1,
          value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub promote: u32,
    /// Edge of a grid cell [default: a sixteenth of the scene's longest side]
    #[arg(long, value_name = "F", help_heading = "Report live", value_parser = values::positive)]
    pub cell_size: Option<f64>,
    /// Most rays of an update; 0: no limit
    #[arg(long, value_name = "N", help_heading = "Report live", default_value_t = 0)]
    pub update_rays: u32,
}

/// What a report of quality varies.
pub const KNOBS: [&str; 10] = [
    "gather-rays",
    "photons",
    "radius",
    "blur",
    "direct-samples",
    "passes",
    "gather-divisor",
    "radiance-divisor",
    "path-tracing",
    "photons-alone",
];

#[derive(Args)]
#[command(next_help_heading = "Report quality")]
pub struct QualityFlags {
    /// Points at which light is compared
    #[arg(long, value_name = "N", default_value_t = 400, value_parser = clap::value_parser!(u32).range(1..))]
    pub points: u32,
    /// Seed of the places and the points. (--seed is that of the bakes, and leaves them where they are.)
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub points_seed: u32,
    /// Bakes per setting, to tell noise from bias
    #[arg(long, value_name = "N", default_value_t = 4, value_parser = clap::value_parser!(u64).range(1..))]
    pub seeds: u64,
    /// Paths per point of the path traced reference
    #[arg(long, value_name = "N", default_value_t = 4096, value_parser = clap::value_parser!(u32).range(1..))]
    pub paths: u32,
    /// Points and reference of an earlier report of the same scene and lights: its quality-points.csv
    #[arg(long, value_name = "FILE")]
    pub reference: Option<PathBuf>,
    /// Paths per pixel of a path traced view, 1024 or times that; 0: no view
    #[arg(long, value_name = "N", default_value_t = 1024)]
    pub view_paths: u32,
    /// What to vary [default: all but none]
    #[arg(long, value_name = "A,B,..", value_delimiter = ',', default_values = KNOBS, hide_default_value = true,
          value_parser = PossibleValuesParser::new(KNOBS.into_iter().chain(["none"])))]
    pub knobs: Vec<String>,
    #[command(flatten)]
    pub flags: Flags,
}

#[derive(Args)]
pub struct CoherenceFlags {
    /// Scenes by ascending number of triangles; SCENE is not used
    #[arg(long, value_name = "A,B,..", help_heading = "Report coherence", value_delimiter = ',', value_parser = values::scene,
          default_values = ["menger:2:1", "menger:2:4", "menger:2:16"])]
    pub scenes: Vec<String>,
    #[command(flatten)]
    pub flags: Flags,
}

#[derive(Args)]
pub struct ScalingFlags {
    /// Scenes by ascending number of triangles; SCENE is not used
    #[arg(long, value_name = "A,B,..", help_heading = "Report scaling", value_delimiter = ',', value_parser = values::scene,
          default_values = ["hall:100000", "hall:300000", "hall:1000000"])]
    pub scenes: Vec<String>,
    /// Measure trees and rays alone, and no light maps
    #[arg(long, help_heading = "Report scaling")]
    pub rays_only: bool,
    /// Bake each scene with these texels per unit, one after another, to measure growth with texels
    #[arg(long, value_name = "A,B,..", help_heading = "Report scaling", value_delimiter = ',',
        value_parser = of(|d: &mut LightmapDesc, v| d.texels_per_unit = v), conflicts_with = "rays_only")]
    pub densities: Vec<f32>,
    #[command(flatten)]
    pub flags: Flags,
}

#[derive(Args)]
#[command(next_help_heading = "Report directional")]
pub struct DirectionalFlags {
    /// Points at which light is compared
    #[arg(long, value_name = "N", default_value_t = 400, value_parser = clap::value_parser!(u32).range(1..))]
    pub points: u32,
    /// Paths per point of the path traced reference, for each angle of the normal map
    #[arg(long, value_name = "N", default_value_t = 4096, value_parser = clap::value_parser!(u32).range(1..))]
    pub paths: u32,
    /// Bakes with and without light by direction, of which the median times are given
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..))]
    pub runs: u64,
    #[command(flatten)]
    pub flags: Flags,
}

// Flags of all commands. (A doc comment would be what the commands are about.)
#[derive(Args)]
pub struct Flags {
    /// A file (.obj, .ply, .gltf, .glb; .bkscene: see --save-scene) or a built-in scene (atrium, cornell, furnace; to measure massive scenes
    /// hall:TRIANGLES, colonnade:TRIANGLES and menger:LEVEL) [default: atrium]
    #[arg(value_parser = values::scene)]
    pub scene: Option<String>,
    /// The same
    #[arg(long = "scene", value_name = "SCENE", conflicts_with = "scene", value_parser = values::scene)]
    pub scene_flag: Option<String>,
    #[command(flatten)]
    pub file: FileFlags,
    #[command(flatten)]
    pub lights: LightFlags,
    #[command(flatten)]
    pub lightmap: LightmapFlags,
    #[command(flatten)]
    pub bake: BakeFlags,
    #[command(flatten)]
    pub parts: PartFlags,
    #[command(flatten)]
    pub machine: MachineFlags,
    #[command(flatten)]
    pub pictures: PictureFlags,
    #[command(flatten)]
    pub output: OutputFlags,
}

#[derive(Args)]
#[command(next_help_heading = "Scene file")]
pub struct FileFlags {
    /// Files that the scene names must lie in DIR or below [default: the folder of the scene]
    #[arg(long, value_name = "DIR")]
    pub base_folder: Option<PathBuf>,
    /// They may lie anywhere: for scenes you trust
    #[arg(long)]
    pub any_folder: bool,
    /// Most MiB of all its images, decoded
    #[arg(long, value_name = "N", default_value_t = 2 << 10)]
    pub max_texture_mb: u64,
    /// Most MiB of all its files
    #[arg(long, value_name = "N", default_value_t = 16 << 10)]
    pub max_file_mb: u64,
    /// Write the scene with its lights and its tree to FILE.bkscene, which is mapped instead of built when it is given as
    /// SCENE
    #[arg(long, value_name = "FILE", value_parser = values::scene_file)]
    pub save_scene: Option<PathBuf>,
    /// Take over trees of FILE.bkscene where meshes are as they were there, instead of building them
    #[arg(long, value_name = "FILE", value_parser = values::scene_file)]
    pub trees_from: Option<PathBuf>,
    /// Read SCENE.bkscene to memory instead of mapping it
    #[arg(long)]
    pub read_scene: bool,
    /// Let rays wait at parts of SCENE.bkscene, which is larger than memory, until enough of them do
    #[arg(long)]
    pub ray_queues: bool,
    /// Put the scene N times beside itself, in a square grid, to measure larger scenes; lights stay as they are
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=1 << 20))]
    pub repeat: u32,
    /// As instances instead of copies
    #[arg(long, requires = "repeat")]
    pub instances: bool,
    /// Let all instances of a mesh show the light of the first one, without texels of their own
    #[arg(long)]
    pub share_light: bool,
}

const LIGHTS: &str = "A light, added to those of the scene; may be repeated

point:X,Y,Z:R,G,B - intensity in W/sr
spot:X,Y,Z:DX,DY,DZ:INNER,OUTER:R,G,B - cone angles in degrees, intensity in W/sr
sun:DX,DY,DZ:R,G,B[:DEGREES] - direction of travel, irradiance in W/m2, radius of its disc [0; the sun's: 0.27]
sky:R,G,B - the same radiance from all directions
sky:FILE.hdr|.exr[:SCALE] - an image by longitude and latitude, its zenith along --up, times SCALE
rect:X,Y,Z:UX,UY,UZ:VX,VY,VZ:R,G,B - corner and edges, shines along u x v, radiance in W/(m2 sr)";

#[derive(Args)]
#[command(next_help_heading = "Lights")]
pub struct LightFlags {
    #[arg(long, value_name = "LIGHT", value_parser = values::light, help = LIGHTS)]
    pub light: Vec<GivenLight>,
}

#[derive(Args)]
#[command(next_help_heading = "Light map")]
pub struct LightmapFlags {
    /// Sets divisors, photons, rays, hits, blur, samples and passes that are not given themselves
    #[arg(long, value_name = "NAME", default_value = "medium",
          value_parser = PossibleValuesParser::new(Quality::ALL.map(|(_, name)| name)))]
    pub quality: String,
    /// Density; 0: about one page [default: 0; the atrium: 30]
    #[arg(long, value_name = "F", value_parser = of(|d: &mut LightmapDesc, v| d.texels_per_unit = v))]
    pub texels_per_unit: Option<f32>,
    /// Width and height of a page in texels
    #[arg(long, value_name = "N", default_value_t = LightmapDesc::default().page_size,
          value_parser = of(|d: &mut LightmapDesc, v| d.page_size = v))]
    pub page_size: u32,
    /// Texels around each chart
    #[arg(long, value_name = "N", default_value_t = LightmapDesc::default().padding,
          value_parser = of(|d: &mut LightmapDesc, v| d.padding = v))]
    pub padding: u32,
    /// Charts and texels from this file; if it does not exist, they are found and written to it
    #[arg(long, value_name = "FILE")]
    pub layout: Option<PathBuf>,
    /// Keep unwraps in DIR by their content, so that parts that have not changed are not unwrapped again
    #[arg(long, value_name = "DIR")]
    pub cache: Option<PathBuf>,
    /// Keep meshes, trees and what charts have per triangle in files of this folder instead of memory, for scenes that are
    /// larger than it
    #[arg(long, value_name = "FOLDER")]
    pub scratch: Option<PathBuf>,
    /// Light map texels per gather map texel and axis
    #[arg(long, value_name = "N", default_value_t = LightmapDesc::default().gather_divisor,
          value_parser = of(|d: &mut LightmapDesc, v| d.gather_divisor = v))]
    pub gather_divisor: u32,
    /// Light map texels per radiance map texel and axis
    #[arg(long, value_name = "N", default_value_t = LightmapDesc::default().radiance_divisor,
          value_parser = of(|d: &mut LightmapDesc, v| d.radiance_divisor = v))]
    pub radiance_divisor: u32,
    /// From where the scene is looked at, a point or a box; may be repeated. What cannot be seen from there gets hardly any texels
    #[arg(long, value_name = "X,Y,Z[:X,Y,Z]", value_parser = values::region)]
    pub seen_from: Vec<Region>,
    /// One side of each two-sided chart, also where both are seen
    #[arg(long)]
    pub one_side: bool,
}

#[derive(Args)]
#[command(next_help_heading = "Bake")]
pub struct BakeFlags {
    /// Photons emitted
    #[arg(long, value_name = "N", default_value_t = BakeParams::default().photon_count,
          value_parser = of(|p: &mut BakeParams, v| p.photon_count = v))]
    pub photons: u64,
    /// Most reflections; 0: Russian roulette alone decides
    #[arg(long, value_name = "N", default_value_t = BakeParams::default().max_bounces,
          value_parser = of(|p: &mut BakeParams, v| p.max_bounces = v))]
    pub bounces: u32,
    /// Rays per gather map texel; 0: no indirect light
    #[arg(long, value_name = "N", default_value_t = BakeParams::default().gather_rays,
          value_parser = of(|p: &mut BakeParams, v| p.gather_rays = v))]
    pub gather_rays: u32,
    /// Photon search radius; 0: automatic
    #[arg(long, value_name = "F", default_value_t = BakeParams::default().radius,
          value_parser = of(|p: &mut BakeParams, v| p.radius = v))]
    pub radius: f32,
    /// Radiance map texels up to which hits of gather rays go on as paths; inf: always
    #[arg(long, value_name = "F", default_value_t = BakeParams::default().near_hits,
          value_parser = of(|p: &mut BakeParams, v| p.near_hits = v))]
    pub near_hits: f32,
    /// Estimated error of interpolation above which texels gather for themselves; inf: never
    #[arg(long, value_name = "F", default_value_t = BakeParams::default().interpolation_error,
          value_parser = of(|p: &mut BakeParams, v| p.interpolation_error = v))]
    pub interpolation_error: f32,
    /// Contrast of the gather texels around above which texels gather for themselves; inf: never
    #[arg(long, value_name = "F", default_value_t = BakeParams::default().interpolation_contrast,
          value_parser = of(|p: &mut BakeParams, v| p.interpolation_contrast = v))]
    pub interpolation_contrast: f32,
    /// Rays of texels that gather for themselves; 0: a gather texel's, at most 64
    #[arg(long, value_name = "N", default_value_t = BakeParams::default().own_rays,
          value_parser = of(|p: &mut BakeParams, v| p.own_rays = v))]
    pub own_rays: u32,
    /// Blur radius in gather map texels
    #[arg(long, value_name = "N", default_value_t = BakeParams::default().blur_radius,
          value_parser = of(|p: &mut BakeParams, v| p.blur_radius = v))]
    pub blur: u32,
    /// Shadow rays per texel and area light
    #[arg(long, value_name = "N", default_value_t = BakeParams::default().direct_samples,
          value_parser = of(|p: &mut BakeParams, v| p.direct_samples = v))]
    pub direct_samples: u32,
    /// The same seed gives the same bits
    #[arg(long, value_name = "N", default_value_t = BakeParams::default().seed,
          value_parser = of(|p: &mut BakeParams, v| p.seed = v))]
    pub seed: u64,
    /// Leave the seams between charts as they are
    #[arg(long)]
    pub no_stitch: bool,
    /// Which light to compute by direction too, for normal maps; its layers are then written as well
    #[arg(long, value_name = "LIGHT", default_value = "none",
          value_parser = ["none", "indirect", "direct", "all"])]
    pub directional: String,
    /// Bakes with different random numbers, whose mean is the light; from two on their error is told
    #[arg(long, value_name = "N", default_value_t = BakeParams::default().passes,
          value_parser = of(|p: &mut BakeParams, v| p.passes = v))]
    pub passes: u32,
    /// As many passes as it takes until the estimated relative error, as far as it is noise, is F or less; 0: `--passes`
    #[arg(long, value_name = "F", default_value_t = BakeParams::default().target_error,
          value_parser = of(|p: &mut BakeParams, v| p.target_error = v))]
    pub target_error: f32,
}

#[derive(Args)]
#[command(next_help_heading = "Checkpoints and shards")]
pub struct PartFlags {
    /// Keeps what is done in FILE and goes on from it after a kill; deleted in the end
    #[arg(long, value_name = "FILE")]
    pub checkpoint: Option<PathBuf>,
    /// Between two writes of it
    #[arg(long, value_name = "F", default_value_t = 10.0, value_parser = values::checkpoint_seconds)]
    pub checkpoint_seconds: f64,
    /// Bakes the I-th of N parts of the texels, 1/N to N/N
    #[arg(long, value_name = "I/N", value_parser = values::shard)]
    pub shard: Option<[u64; 2]>,
    /// The light of the texels, for --load-result
    #[arg(long, value_name = "FILE")]
    pub save_result: Option<PathBuf>,
    /// Light to take over instead of baking; may be repeated, for shards
    #[arg(long, value_name = "FILE")]
    pub load_result: Vec<PathBuf>,
}

#[derive(Args)]
#[command(next_help_heading = "Machine")]
pub struct MachineFlags {
    /// 0: one per logical core
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub threads: usize,
    /// Instructions of the ray kernels
    #[arg(long, value_name = "NAME", default_value = "auto",
          value_parser = PossibleValuesParser::new(Isa::ALL.map(Isa::name).into_iter().chain(["auto"])))]
    pub isa: String,
    /// Bins of the tree builder
    #[arg(long, value_name = "N", default_value_t = BuildOptions::default().bins,
          value_parser = of(|o: &mut BuildOptions, v| o.bins = v))]
    pub bins: u32,
    /// Most triangles per leaf
    #[arg(long, value_name = "N", default_value_t = BuildOptions::default().max_leaf,
          value_parser = of(|o: &mut BuildOptions, v| o.max_leaf = v))]
    pub leaf: u32,
    /// How to build the tree; high: with spatial splits, for faster rays
    #[arg(long, value_name = "NAME", default_value = BuildOptions::default().quality.name(),
          value_parser = PossibleValuesParser::new(BuildQuality::ALL.map(BuildQuality::name)))]
    pub build: String,
    /// The tree in a fifth of the memory, for slower rays
    #[arg(long)]
    pub compact: bool,
}

/// Images beyond this width or height are a slip of the finger.
const MAX_PICTURE: i64 = 16384;

#[derive(Args)]
#[command(next_help_heading = "Pictures (path traced reference; indirect map and shadow rays; light map alone)")]
pub struct PictureFlags {
    /// PX,PY,PZ:TX,TY,TZ[:FOV]: position, target, vertical degrees [60]; without it, a view is looked for
    #[arg(long, value_name = "CAMERA", allow_hyphen_values = true, value_parser = values::camera)]
    pub camera: Option<Camera>,
    /// Up axis of the scene, for the camera and skies
    #[arg(long, value_name = "AXIS", default_value = "y", value_parser = ["x", "y", "z"])]
    pub up: String,
    /// Width of each
    #[arg(long, value_name = "N", default_value_t = 480, value_parser = clap::value_parser!(u32).range(1..=MAX_PICTURE))]
    pub width: u32,
    /// Height of each
    #[arg(long, value_name = "N", default_value_t = 270, value_parser = clap::value_parser!(u32).range(1..=MAX_PICTURE))]
    pub height: u32,
    /// Paths per pixel of the reference; 0: no pictures, but that of the light map alone if --camera is given [default: 0;
    /// built-in scenes: 32]
    #[arg(long, value_name = "N")]
    pub reference_spp: Option<u32>,
}

#[derive(Args)]
#[command(next_help_heading = "Output")]
pub struct OutputFlags {
    /// Where all files go
    #[arg(long, value_name = "DIR", default_value = "out")]
    pub out: PathBuf,
    /// Layers of the light map that become pages
    #[arg(long, value_name = "A,B,..", value_delimiter = ',', default_values = ["combined", "indirect", "direct", "radiance"],
          value_parser = PossibleValuesParser::new(super::LAYERS.map(|l| l.name)))]
    pub layers: Vec<String>,
    /// Files to write: pages as floats or half floats (EXR), pages tone mapped (PNG; layers of light alone), the scene
    /// with its light map (GLB)
    #[arg(long, value_name = "A,B,..", value_delimiter = ',', default_values = ["exr", "png", "glb"],
          value_parser = ["exr", "exr-half", "png", "glb"])]
    pub format: Vec<String>,
    /// No GLB, whatever --format says
    #[arg(long)]
    pub no_glb: bool,
    /// No progress, no table
    #[arg(long)]
    pub quiet: bool,
}
