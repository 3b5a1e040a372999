//! The files of a bake: pages layer by layer, and the scene with its light map.

use bakelite::io::image::{tone_map, write_exr, write_png_rgb8};
use bakelite::lightmap::{Layer, LayerData, Lightmap};
use bakelite::{Error, Progress, Result};
use rayon::prelude::*;
use std::f32::consts::PI;
use std::path::{Path, PathBuf};

/// Layers that are written, with their names in file names.
const LAYERS: [(Layer, &str); 4] = [
    (Layer::Combined, "combined"),
    (Layer::Indirect, "indirect"),
    (Layer::Direct, "direct"),
    (Layer::Radiance, "radiance"),
];

/// A light layer of a page.
fn rgb(lightmap: &Lightmap, page: u32, layer: Layer) -> Result<Vec<[f32; 3]>> {
    match lightmap.read(page, layer)? {
        LayerData::Rgb(pixels) => Ok(pixels),
        _ => Err(Error::Internal(format!("layer {layer:?} is not RGB"))),
    }
}

/// Writes `pageN-LAYER.exr` (values) and `.png` (tone mapped) and returns their paths.
pub fn write_pages(folder: &Path, lightmap: &Lightmap, exposure: f32, progress: &Progress) -> Result<Vec<PathBuf>> {
    let info = lightmap.info();
    let jobs: Vec<(u32, Layer, &str)> =
        (0..info.page_count).flat_map(|page| LAYERS.map(|(layer, name)| (page, layer, name))).collect();
    let stage = progress.stage("pages", 0.0, 1.0, jobs.len() as u64);
    let write = |&(page, layer, name): &(u32, Layer, &str)| -> Result<[PathBuf; 2]> {
        let pixels = rgb(lightmap, page, layer)?;
        let [exr, png] = ["exr", "png"].map(|e| folder.join(format!("page{page}-{name}.{e}")));
        write_exr(&exr, info.width, info.height, &pixels)?;
        // Radiance is albedo/π times irradiance: π brings it to the brightness of the others.
        let exposure = if layer == Layer::Radiance { exposure * PI } else { exposure };
        let mapped: Vec<[u8; 3]> = pixels.iter().map(|&p| tone_map(exposure, p)).collect();
        write_png_rgb8(&png, info.width, info.height, &mapped)?;
        stage.advance(1)?;
        Ok([exr, png])
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
