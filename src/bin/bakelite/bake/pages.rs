//! The files of a bake: pages layer by layer, and the scene with its light map.

use super::exr;
use crate::args::{BakeArgs, NamedLayer};
use bakelite::files::replace_with;
use bakelite::io::image::{tone_map, write_png_rgb8};
use bakelite::lightmap::{Layer, LayerData, Lightmap};
use bakelite::{Progress, Result};
use rayon::prelude::*;
use std::f32::consts::PI;
use std::path::{Path, PathBuf};

/// Writes the layers asked for as `pageN-LAYER.exr` (values) and `.png` (tone mapped), and returns their paths.
pub fn write_pages(args: &BakeArgs, lightmap: &Lightmap, exposure: f32, progress: &Progress) -> Result<Vec<PathBuf>> {
    let info = lightmap.info();
    let (formats, seed) = (args.formats, args.params.seed);
    if !formats.exr && !formats.exr_half && !formats.png {
        return Ok(Vec::new());
    }
    let jobs: Vec<(u32, &NamedLayer)> =
        (0..info.page_count).flat_map(|page| args.layers.iter().map(move |layer| (page, layer))).collect();
    let stage = progress.stage("pages", 0.0, 1.0, jobs.len() as u64);
    let write = |&(page, layer): &(u32, &NamedLayer)| -> Result<Vec<PathBuf>> {
        let values = lightmap.read(page, layer.layer)?;
        let path = |ending: &str| args.out.join(format!("page{page}-{}.{ending}", layer.name));
        let mut written = Vec::new();
        if formats.exr || formats.exr_half {
            // Half floats are too coarse for positions.
            let half = formats.exr_half && layer.layer != Layer::Position;
            replace_with(&path("exr"), &exr::encode(lightmap, page, layer, &values, half, seed)?)?;
            written.push(path("exr"));
        }
        if formats.png
            && layer.is_light
            && let LayerData::Rgb(pixels) = &values
        {
            // Radiance is albedo/π times irradiance: π brings it to the brightness of the others.
            let exposure = if layer.layer == Layer::Radiance { exposure * PI } else { exposure };
            let mapped: Vec<[u8; 3]> = pixels.iter().map(|&p| tone_map(exposure, p)).collect();
            write_png_rgb8(&path("png"), info.width, info.height, &mapped)?;
            written.push(path("png"));
        }
        stage.advance(1)?;
        Ok(written)
    };
    let files: Result<Vec<_>> = lightmap.scene().device().run(progress, || jobs.par_iter().map(write).collect());
    Ok(files?.into_iter().flatten().collect())
}

/// Writes the scene with its light map as `scene.glb` and returns its path.
pub fn write_scene(folder: &Path, lightmap: &Lightmap, exposure: f32, progress: &Progress) -> Result<PathBuf> {
    let path = folder.join("scene.glb");
    bakelite::io::lightmaps::write_scene(lightmap, &path, Some(exposure), progress)?;
    Ok(path)
}
