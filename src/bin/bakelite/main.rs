//! The command line: bakes a scene, writes its light maps and compares pictures of it; measures
//! live updates.
//!
//! | file | what it does |
//! |---|---|
//! | `args` | flags, help, and what is wrong with them |
//! | `bar` | progress on standard error |
//! | `cancel_report` | how long calls are silent, and how soon they end when cancelled |
//! | `camera` | a view for scenes that come without one |
//! | `pictures`, `font` | the three pictures that the thesis compares |
//! | `output` | light map pages, the scene and texts as files |
//! | `table`, `report` | what a run took, for people and for programs |
//! | `live_measure`, `live_report`, `plot` | live updates: measurements, tables, plots |
//! | `measure` | what measurements share |
//! | `memory_report` | a scene's memory by part, and what little of it costs rays |
//! | `pipeline_report`, `bar_chart` | the stages of a bake, and what bounds each |
//! | `quality_measure`, `quality_report` | error of the light against run time |
//! | `quality_places` | where somebody can stand, who looks at it |
//! | `quality_view`, `ssim` | likeness of views of it |
//! | `stability`, `stability_*` | stiff and extreme cases against what is known of them |
//! | `texel_paths` | path tracing every texel, which a bake is compared with |

mod args;
mod bar;
mod bar_chart;
mod camera;
mod cancel_report;
mod font;
mod live_measure;
mod live_report;
mod measure;
mod memory_report;
mod output;
mod pictures;
mod pipeline_report;
mod plot;
mod quality_measure;
mod quality_places;
mod quality_report;
mod quality_view;
mod report;
mod ssim;
mod stability;
mod stability_light;
mod stability_limits;
mod stability_space;
mod table;
mod texel_paths;

use args::{BakeArgs, Command};
use bakelite::bvh::BuildOptions;
use bakelite::device::LogLevel;
use bakelite::io::image::write_png_rgb8;
use bakelite::lightmap::{BakeStats, CheckpointParams, Lightmap};
use bakelite::scene::{Camera, builtin, builtin_camera, is_builtin};
use bakelite::{Device, DeviceOptions, Error, Light, Progress, Result, Scene, SceneData};
use bar::Bars;
use pictures::{NAMES, Pictures, View};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Instant;
use table::Stage;

/// Exit code for wrong arguments.
const USAGE: u8 = 2;

fn main() -> ExitCode {
    let result = match args::parse(std::env::args_os().skip(1)) {
        Ok(Command::Help) => {
            print!("{}", args::HELP);
            Ok(())
        }
        Ok(Command::Version) => {
            println!("bakelite {}", env!("CARGO_PKG_VERSION"));
            Ok(())
        }
        Ok(Command::Bake(bake)) => Job::new(&bake).run(),
        Ok(Command::ReportCancel(args)) => cancel_report::run(&args),
        Ok(Command::ReportLive(report)) => live_report::run(&report),
        Ok(Command::ReportMemory(args)) => memory_report::run(&args),
        Ok(Command::ReportPipeline(args)) => pipeline_report::run(&args),
        Ok(Command::ReportQuality(report)) => quality_report::run(&report),
        Ok(Command::ReportStability(args)) => stability::run(&args),
        Err(e) => {
            eprintln!("bakelite: {e}\nTry bakelite --help");
            return ExitCode::from(USAGE);
        }
    };
    if let Err(e) = result {
        eprintln!("bakelite: {e}");
        return ExitCode::from(if matches!(e, Error::InvalidArgument(_)) { USAGE } else { 1 });
    }
    ExitCode::SUCCESS
}

/// One run of `bakelite bake`, whose first steps are those of other commands too.
struct Job<'a> {
    args: &'a BakeArgs,
    bars: Bars,
    stages: Vec<Stage>,
    warnings: Vec<String>,
    files: Vec<PathBuf>,
}

impl<'a> Job<'a> {
    fn new(args: &'a BakeArgs) -> Self {
        let bars = Bars::new(args.quiet);
        Job { args, bars, stages: Vec::new(), warnings: Vec::new(), files: Vec::new() }
    }

    fn run(mut self) -> Result<()> {
        let start = Instant::now();
        output::make_folder(&self.args.out)?;
        let mut lightmap = self.unbaked()?;
        let bake = self.light(&mut lightmap)?;
        self.write_maps(&lightmap)?;
        let camera = self.camera(&lightmap);
        let pictures = self.pictures(&lightmap, camera)?;
        let seconds = start.elapsed().as_secs_f64();

        let path = self.args.out.join("report.json");
        self.files.push(path.clone());
        let run = report::Run {
            args: self.args,
            lightmap: &lightmap,
            bake: &bake,
            stages: &self.stages,
            pictures: pictures.as_ref(),
            camera,
            warnings: &self.warnings,
            files: &self.files,
            seconds,
        };
        let text = format!("{:#}\n", report::report(&run));
        output::write_text(&path, &text)?;
        // All that it stands for is written.
        if let Some(path) = &self.args.checkpoint {
            let _ = std::fs::remove_file(path);
        }
        if !self.args.quiet {
            self.print(&lightmap, &bake, pictures.as_ref(), seconds);
        }
        Ok(())
    }

    /// The light map of the scene, without light.
    fn unbaked(&mut self) -> Result<Lightmap> {
        let data = self.load()?;
        let scene = self.commit(data)?;
        self.layout(&scene)
    }

    /// Reads or makes the scene and adds the lights of the command line.
    fn load(&mut self) -> Result<SceneData> {
        let data = self.load_dark()?;
        let shines = !data.lights().is_empty() || data.materials().iter().any(|m| m.is_emissive());
        if !shines {
            let name = &self.args.scene;
            return Err(Error::InvalidArgument(format!("{name} has no lights; give some with --light (see --help)")));
        }
        Ok(data)
    }

    /// The same for what needs no light.
    fn load_dark(&mut self) -> Result<SceneData> {
        let start = Instant::now();
        let name = self.args.scene.as_str();
        let mut data = if is_builtin(name) {
            builtin(name)?
        } else {
            let mut data = SceneData::new();
            let options = self.args.load_options();
            let load = |p: &Progress| bakelite::io::load_with(Path::new(name), &options, p, &mut data);
            let loaded = self.bars.show("load", load);
            self.warnings = loaded.map_err(name_flags)?.warnings;
            data
        };
        for given in &self.args.lights {
            let mut light = given.light;
            if let Light::Sky { environment, up, .. } = &mut light {
                *up = self.args.up;
                if let Some(path) = &given.image {
                    *environment = data.add_environment(bakelite::io::image::read_environment(path)?);
                }
            }
            data.add_light(light)?;
        }
        for warning in &self.warnings {
            self.bars.say(&format!("warning: {warning}"));
        }
        self.stage("load", start);
        Ok(data)
    }

    fn commit(&mut self, data: SceneData) -> Result<Arc<Scene>> {
        let device = self.device()?;
        self.commit_on(&device, data, &self.args.build)
    }

    fn commit_on(&mut self, device: &Arc<Device>, data: SceneData, build: &BuildOptions) -> Result<Arc<Scene>> {
        let start = Instant::now();
        let scene = self.bars.show("scene", |p| Scene::commit(device, data, build, p).map_err(|(_, e)| e))?;
        self.stage("tree", start).bytes = scene.stats().bvh_bytes;
        Ok(scene)
    }

    fn device(&self) -> Result<Arc<Device>> {
        let quiet = self.args.quiet;
        let log = move |level: LogLevel, message: &str| {
            if level == LogLevel::Error || !quiet {
                eprintln!("{message}");
            }
        };
        Device::new(DeviceOptions {
            num_threads: self.args.threads,
            isa: self.args.isa,
            log: Some(Box::new(log)),
            memory: None,
        })
    }

    fn layout(&mut self, scene: &Arc<Scene>) -> Result<Lightmap> {
        let start = Instant::now();
        let lightmap = self.bars.show("charts", |p| Lightmap::create(scene, &self.args.desc, p))?;
        self.stage("charts and texels", start).bytes = lightmap.info().bytes;
        Ok(lightmap)
    }

    /// Bakes, or takes the light from results, and saves the result if that is asked for.
    fn light(&mut self, lightmap: &mut Lightmap) -> Result<BakeStats> {
        let stats = if self.args.load_results.is_empty() { self.bake(lightmap)? } else { self.load_results(lightmap)? };
        if let Some(path) = &self.args.save_result {
            let start = Instant::now();
            self.bars.show("result", |p| lightmap.save_result(path, p))?;
            self.files.push(path.clone());
            self.stage("save result", start);
        }
        Ok(stats)
    }

    fn load_results(&mut self, lightmap: &mut Lightmap) -> Result<BakeStats> {
        let start = Instant::now();
        for path in &self.args.load_results {
            self.bars.show("result", |p| lightmap.load_result(path, p))?;
        }
        self.stage("load results", start);
        Ok(BakeStats::default())
    }

    fn bake(&mut self, lightmap: &mut Lightmap) -> Result<BakeStats> {
        let mut params = self.args.params;
        if let Some([shard, of]) = self.args.shard {
            let texels = lightmap.info().texels;
            let cut = |i: u64| (texels as u128 * i as u128 / of as u128) as u64;
            (params.texel_begin, params.texel_end) = (cut(shard), cut(shard + 1));
            if params.texel_begin == params.texel_end {
                return Err(Error::InvalidArgument(format!(
                    "--shard {}/{of} has none of the {texels} texels",
                    shard + 1
                )));
            }
        }
        let seconds = self.args.checkpoint_seconds;
        let checkpoint = self.args.checkpoint.clone().map(|path| CheckpointParams { path, seconds });
        let stats = self.bars.show("bake", |p| lightmap.bake_with(&params, checkpoint.as_ref(), p))?;
        let parts = [
            ("photons", stats.photons),
            ("radiance map", stats.radiance),
            ("gather map", stats.gather),
            ("direct light", stats.direct),
            ("composition", stats.compose),
        ];
        for (name, s) in parts {
            let photons = if name == "photons" { stats.photons_emitted } else { 0 };
            self.stages.push(Stage { name, seconds: s.seconds, rays: s.rays, photons, bytes: s.bytes });
        }
        if stats.seam_points > 0 {
            self.stages.push(Stage { name: "seams", seconds: stats.seam_seconds, ..Default::default() });
        }
        Ok(stats)
    }

    fn write_maps(&mut self, lightmap: &Lightmap) -> Result<()> {
        let start = Instant::now();
        let exposure = bakelite::io::lightmaps::exposure(lightmap)?;
        let files = self.bars.show("files", |p| output::write_pages(&self.args.out, lightmap, exposure, p))?;
        self.files.extend(files);
        if self.args.glb {
            let scene = self.bars.show("scene.glb", |p| output::write_scene(&self.args.out, lightmap, exposure, p))?;
            self.files.push(scene);
        }
        let bytes = self.files.iter().filter_map(|f| std::fs::metadata(f).ok()).map(|m| m.len()).sum();
        self.stage("files", start).bytes = bytes;
        Ok(())
    }

    /// The camera that was given, the built-in scene's, or one that is looked for.
    fn camera(&self, lightmap: &Lightmap) -> Camera {
        match self.args.camera {
            Some(camera) => Camera { up: self.args.up, ..camera },
            None => builtin_camera(&self.args.scene).unwrap_or_else(|| camera::choose(lightmap, self.args.up)),
        }
    }

    fn pictures(&mut self, lightmap: &Lightmap, camera: Camera) -> Result<Option<Pictures>> {
        if self.args.reference_spp == 0 {
            return Ok(None);
        }
        let view = View {
            camera,
            width: self.args.width,
            height: self.args.height,
            reference_spp: self.args.reference_spp,
            seed: self.args.params.seed,
            lightmap,
        };
        let pictures = self.bars.show("pictures", |p| view.render(p))?;
        let names = ["picture: reference", "picture: shadow rays", "picture: light map"];
        for (name, seconds) in names.into_iter().zip(pictures.seconds) {
            self.stages.push(Stage { name, seconds, ..Default::default() });
        }
        for (i, name) in NAMES.into_iter().enumerate() {
            self.write_picture(name, view.width, view.height, &pictures.tone_mapped(i))?;
        }
        let (width, height, pixels) = pictures.side_by_side();
        self.write_picture("pictures", width, height, &pixels)?;
        Ok(Some(pictures))
    }

    fn write_picture(&mut self, name: &str, width: usize, height: usize, pixels: &[[u8; 3]]) -> Result<()> {
        let path = self.args.out.join(format!("{name}.png"));
        write_png_rgb8(&path, width as u32, height as u32, pixels)?;
        self.files.push(path);
        Ok(())
    }

    /// Records a stage that began at `start`.
    fn stage(&mut self, name: &'static str, start: Instant) -> &mut Stage {
        let at = self.stages.len();
        self.stages.push(Stage { name, seconds: start.elapsed().as_secs_f64(), ..Default::default() });
        &mut self.stages[at]
    }

    fn print(&self, lightmap: &Lightmap, bake: &BakeStats, pictures: Option<&Pictures>, seconds: f64) {
        let scene = lightmap.scene();
        let info = lightmap.info();
        println!(
            "\n{}: {} triangles, {} charts, {} texels on {} pages of {} x {}, {} threads, {}\n",
            self.args.scene,
            scene.stats().triangles,
            info.charts,
            info.texels,
            info.page_count,
            info.width,
            info.height,
            scene.device().num_threads(),
            scene.device().isa().name(),
        );
        println!("{}", table::text(&self.stages, seconds));
        println!("{}", lightmap.plan_text());
        if bake.seam_points > 0 {
            println!(
                "Both sides of stitched edges differ by {} of the light there (RMS), before by {}.\n",
                pictures::percent(bake.seam_rms_after),
                pictures::percent(bake.seam_rms_before),
            );
        }
        if let Some(p) = pictures {
            println!(
                "RMSE against the path traced reference, without its own noise of {}:",
                pictures::percent(p.noise)
            );
            for i in 1..3 {
                println!("  {:<28}{:>16}", pictures::TITLES[i], pictures::percent(p.rmse[i]));
            }
            println!();
        }
        println!("Wrote to {}:", self.args.out.display());
        println!("  pageN-combined, -indirect, -direct, -radiance: light map pages as .exr and .png");
        if self.args.glb {
            println!("  scene.glb: the scene with its light map, for any glTF viewer");
        }
        if pictures.is_some() {
            println!("  pictures.png: reference, indirect map + shadow rays, light map; each also alone");
        }
        println!("  report.json: all of the above and more, for programs");
    }
}

/// The library's error, with its limits called by their flags.
fn name_flags(e: Error) -> Error {
    match e {
        Error::OutOfMemory(text) => Error::OutOfMemory(
            text.replace("max_texture_bytes", "--max-texture-mb").replace("max_file_bytes", "--max-file-mb"),
        ),
        Error::InvalidArgument(text) => Error::InvalidArgument(text.replace("base_folder", "--base-folder")),
        e => e,
    }
}
