//! `bakelite bake`: bakes a scene, writes its light maps and compares pictures of it.

mod exr;
mod pages;
mod record;

use crate::args::BakeArgs;
use crate::files;
use crate::job::Job;
use crate::pictures::{self, NAMES, Pictures, View};
use crate::stages::{self, Stage};
use bakelite::Result;
use bakelite::io::image::write_png_rgb8;
use bakelite::lightmap::{BakeStats, Lightmap};
use bakelite::scene::Camera;
use std::time::Instant;

/// Runs the command.
pub fn run(args: &BakeArgs) -> Result<()> {
    let mut job = Job::new(args);
    let start = Instant::now();
    if !args.scene_is_given {
        job.bars.say(&first_words(args));
    }
    files::make_folder(&args.out)?;
    let mut lightmap = job.unbaked()?;
    let bake = job.light(&mut lightmap)?;
    job.write_maps(&lightmap)?;
    let camera = job.camera(&lightmap);
    let pictures = job.pictures(&lightmap, camera)?;
    let seconds = start.elapsed().as_secs_f64();

    let path = args.out.join("report.json");
    job.files.push(path.clone());
    let run = record::Run {
        args,
        lightmap: &lightmap,
        bake: &bake,
        stages: &job.stages,
        pictures: pictures.as_ref(),
        camera,
        warnings: &job.warnings,
        files: &job.files,
        seconds,
    };
    files::write_text(&path, &format!("{:#}\n", record::json(&run)))?;
    // All that it stands for is written.
    if let Some(path) = &args.checkpoint {
        let _ = std::fs::remove_file(path);
    }
    if !args.quiet {
        job.print(&lightmap, &bake, pictures.as_ref(), seconds);
    }
    Ok(())
}

/// Text that a run without a scene shows first.
fn first_words(args: &BakeArgs) -> String {
    let time = if args.reference_spp > 0 {
        "half a minute on two cores, most of it for a path traced picture to compare with (--reference-spp 0: none)"
    } else {
        "a quarter of a minute on two cores"
    };
    format!(
        "No scene is given: baking the built-in atrium into {}/, which takes {time}.\n\
         A scene of your own: bakelite bake SCENE; all flags: bakelite help bake.",
        args.out.display()
    )
}

impl Job<'_> {
    fn write_maps(&mut self, lightmap: &Lightmap) -> Result<()> {
        let start = Instant::now();
        let exposure = bakelite::io::lightmaps::exposure(lightmap)?;
        let files = self.bars.show("files", |p| pages::write_pages(self.args, lightmap, exposure, p))?;
        self.files.extend(files);
        if self.args.formats.glb {
            let scene = self.bars.show("scene.glb", |p| pages::write_scene(&self.args.out, lightmap, exposure, p))?;
            self.files.push(scene);
        }
        let bytes = self.files.iter().filter_map(|f| std::fs::metadata(f).ok()).map(|m| m.len()).sum();
        self.stage("files", start).bytes = bytes;
        Ok(())
    }

    fn pictures(&mut self, lightmap: &Lightmap, camera: Camera) -> Result<Option<Pictures>> {
        let has_reference = self.args.reference_spp > 0;
        if !has_reference && self.args.camera.is_none() {
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
        if !has_reference {
            let start = Instant::now();
            let pixels = self.bars.show("picture", |p| view.light_map_alone(p))?;
            self.stage("picture: light map", start);
            self.write_picture("light-map", view.width, view.height, &pixels)?;
            return Ok(None);
        }
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
        println!("{}", stages::table(&self.stages, seconds));
        println!("{}", lightmap.plan_text());
        if bake.passes > 1 {
            let (passes, error) = (bake.passes, pictures::percent(bake.error));
            println!("The light is the mean of {passes} passes; estimated noise that is left: {error} (RMS).\n");
        }
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
        let formats = self.args.formats;
        if formats.exr || formats.exr_half || formats.png {
            let layers: Vec<String> = self.args.layers.iter().map(|l| format!("-{}", l.name)).collect();
            let endings = match (formats.exr || formats.exr_half, formats.png) {
                (true, true) => ".exr and .png",
                (true, false) => ".exr",
                _ => ".png",
            };
            println!("  pageN{}: light map pages as {endings}", layers.join(", "));
        }
        if self.args.formats.glb {
            println!("  scene.glb: the scene with its light map, for any glTF viewer");
        }
        if pictures.is_some() {
            println!("  pictures.png: reference, indirect map + shadow rays, light map; each also alone");
        }
        println!("  report.json: all of the above and more, for programs");
    }
}
