//! The steps that bakes and reports share: from the arguments to a scene, a light map and its light.

use crate::args::{BakeArgs, is_scene_file};
use crate::camera;
use crate::progress_bar::Bars;
use crate::repeat::repeat;
use crate::stages::Stage;
use bakelite::bvh::BuildOptions;
use bakelite::device::LogLevel;
use bakelite::lightmap::{BakeStats, CheckpointParams, Lightmap};
use bakelite::scene::{Camera, OpenOptions, builtin, builtin_camera, is_builtin};
use bakelite::{Device, DeviceOptions, Error, Light, Progress, Result, Scene, SceneData};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

/// One run of the command line.
pub struct Job<'a> {
    pub args: &'a BakeArgs,
    /// Shows the progress of each step.
    pub bars: Bars,
    /// What each step took.
    pub stages: Vec<Stage>,
    /// What the scene file's reader ignored or replaced.
    pub warnings: Vec<String>,
    /// Files that were written.
    pub files: Vec<PathBuf>,
}

impl<'a> Job<'a> {
    /// A run with these arguments, of which nothing is done.
    pub fn new(args: &'a BakeArgs) -> Self {
        let bars = Bars::new(args.quiet);
        Job { args, bars, stages: Vec::new(), warnings: Vec::new(), files: Vec::new() }
    }

    /// The light map of the scene, without light.
    pub fn unbaked(&mut self) -> Result<Lightmap> {
        let device = self.device()?;
        let scene = self.scene_on(&device)?;
        self.layout(&scene)
    }

    /// The committed scene: opened if it is a file of one, otherwise loaded and committed; saved if that is asked for.
    pub fn scene_on(&mut self, device: &Arc<Device>) -> Result<Arc<Scene>> {
        let scene = if is_scene_file(&self.args.scene) {
            self.open_on(device)?
        } else {
            let data = self.load()?;
            self.commit_on(device, data, &self.args.build)?
        };
        if let Some(path) = &self.args.save_scene {
            let start = Instant::now();
            self.bars.show("save scene", |p| scene.save(path, p))?;
            self.files.push(path.clone());
            self.stage("save scene", start);
        }
        Ok(scene)
    }

    fn open_on(&mut self, device: &Arc<Device>) -> Result<Arc<Scene>> {
        if !self.args.lights.is_empty() {
            let name = &self.args.scene;
            return Err(Error::InvalidArgument(format!(
                "{name} has the lights that it was saved with; --light adds none"
            )));
        }
        if self.args.repeat > 1 {
            let name = &self.args.scene;
            return Err(Error::InvalidArgument(format!("{name} is opened as it was saved; --repeat does not apply")));
        }
        if self.args.trees_from.is_some() {
            let name = &self.args.scene;
            return Err(Error::InvalidArgument(format!("{name} has its trees; --trees-from does not apply")));
        }
        if self.args.share_light {
            let name = &self.args.scene;
            return Err(Error::InvalidArgument(format!(
                "{name} is opened as it was saved; --share-light does not apply"
            )));
        }
        let start = Instant::now();
        let options = OpenOptions { map: !self.args.read_scene, ray_queues: self.args.ray_queues };
        let path = Path::new(&self.args.scene);
        let scene = self.bars.show("open", |p| Scene::open(device, path, &options, p))?;
        self.stage("open", start).bytes = scene.stats().bytes;
        Ok(scene)
    }

    /// Reads or makes the scene and adds the lights of the command line.
    pub fn load(&mut self) -> Result<SceneData> {
        let data = self.load_dark()?;
        let shines = !data.lights().is_empty() || data.materials().iter().any(|m| m.is_emissive());
        if !shines {
            let name = &self.args.scene;
            return Err(Error::InvalidArgument(format!("{name} has no lights; give some with --light (see --help)")));
        }
        Ok(data)
    }

    /// The same for what needs no light.
    pub fn load_dark(&mut self) -> Result<SceneData> {
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
        if self.args.repeat > 1 {
            repeat(&mut data, self.args.repeat, self.args.instances)?;
        }
        if self.args.share_light {
            data.share_light_of_meshes()?;
        }
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

    /// Commits the scene and notes what its tree took.
    pub fn commit_on(&mut self, device: &Arc<Device>, data: SceneData, build: &BuildOptions) -> Result<Arc<Scene>> {
        let earlier = match &self.args.trees_from {
            Some(path) => Some(self.bars.show("open", |p| Scene::open(device, path, &OpenOptions::default(), p))?),
            None => None,
        };
        let start = Instant::now();
        let commit = |p: &Progress| match &earlier {
            Some(earlier) => Scene::commit_from(device, data, build, earlier, p).map_err(|(_, e)| e),
            None => Scene::commit(device, data, build, p).map_err(|(_, e)| e),
        };
        let scene = self.bars.show("scene", commit)?;
        if earlier.is_some() {
            let all: usize = scene.meshes().iter().map(|m| m.indices.len()).sum();
            let kept = scene.stats().kept_triangles;
            self.bars.say(&format!("trees of {kept} of {all} triangles were taken over"));
        }
        self.stage("tree", start).bytes = scene.stats().bvh_bytes;
        Ok(scene)
    }

    /// The device that the arguments ask for. Its warnings go to standard error.
    pub fn device(&self) -> Result<Arc<Device>> {
        let quiet = self.args.quiet;
        let log = move |level: LogLevel, message: &str| {
            if level == LogLevel::Error || level == LogLevel::Warning && !quiet {
                eprintln!("{message}");
            }
        };
        Device::new(DeviceOptions {
            num_threads: self.args.threads,
            isa: self.args.isa,
            log: Some(Box::new(log)),
            memory: None,
            cache_folder: self.args.cache.clone(),
            scratch_folder: self.args.scratch.clone(),
        })
    }

    pub fn layout(&mut self, scene: &Arc<Scene>) -> Result<Lightmap> {
        let start = Instant::now();
        let desc = &self.args.desc;
        let lightmap = match &self.args.layout {
            Some(path) if path.exists() => self.bars.show("charts", |p| Lightmap::load_layout(scene, desc, path, p))?,
            to => {
                let lightmap = self.bars.show("charts", |p| Lightmap::create(scene, desc, p))?;
                if let Some(path) = to {
                    self.bars.show("layout", |p| lightmap.save_layout(path, p))?;
                    self.files.push(path.clone());
                }
                lightmap
            }
        };
        self.stage("charts and texels", start).bytes = lightmap.info().bytes;
        Ok(lightmap)
    }

    /// Bakes, or takes the light from results, and saves the result if that is asked for.
    pub fn light(&mut self, lightmap: &mut Lightmap) -> Result<BakeStats> {
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

    /// The camera that was given, the built-in scene's, or one that is looked for.
    pub fn camera(&self, lightmap: &Lightmap) -> Camera {
        match self.args.camera {
            Some(camera) => Camera { up: self.args.up, ..camera },
            None => builtin_camera(&self.args.scene).unwrap_or_else(|| camera::choose(lightmap, self.args.up)),
        }
    }

    /// Records a stage that began at `start`.
    pub fn stage(&mut self, name: &'static str, start: Instant) -> &mut Stage {
        let at = self.stages.len();
        self.stages.push(Stage { name, seconds: start.elapsed().as_secs_f64(), ..Default::default() });
        &mut self.stages[at]
    }
}

/// `bakelite commit`: builds a scene's tree and writes both to a file.
pub fn commit(args: &BakeArgs) -> Result<()> {
    let (mut job, start) = (Job::new(args), Instant::now());
    let device = job.device()?;
    let scene = job.scene_on(&device)?;
    if !args.quiet {
        let stats = scene.stats();
        println!("{}: {} triangles, {} bytes in memory", args.title(), stats.triangles, stats.bytes);
        print!("{}", crate::stages::table(&job.stages, start.elapsed().as_secs_f64()));
    }
    Ok(())
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
