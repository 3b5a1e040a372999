//! Baked light maps as files: pages layer by layer as EXR or PNG, or the lit scene as GLB.

use super::glb::{GlbLightmap, GlbMesh, write_glb};
use super::image::{auto_exposure, encode_png_rgb8, tone_map, write_exr, write_png_rgb8};
use crate::error::{Error, Result};
use crate::lightmap::{Layer, LayerData, Lightmap};
use crate::progress::{Progress, Stage};
use rayon::prelude::*;
use std::f32::consts::PI;
use std::path::{Path, PathBuf};

/// Layers that become images, with their part of the file's name.
const LAYERS: [(Layer, &str); 4] = [
    (Layer::Combined, "combined"),
    (Layer::Indirect, "indirect"),
    (Layer::Direct, "direct"),
    (Layer::Radiance, "radiance"),
];

/// One exposure for all pages (see [`auto_exposure`]), from the texels that are lit.
pub fn exposure(lightmap: &Lightmap) -> Result<f32> {
    let mut pixels = Vec::new();
    for page in 0..lightmap.info().page_count {
        pixels.extend(rgb(lightmap, page, Layer::Combined)?);
    }
    Ok(auto_exposure(&pixels, |_| true))
}

/// Writes the light layers as floats, `PREFIXpageN-LAYER.exr`, and returns the paths.
pub fn write_exr_pages(lightmap: &Lightmap, prefix: &str, progress: &Progress) -> Result<Vec<PathBuf>> {
    let info = lightmap.info();
    each_page(lightmap, progress, |page, layer, name| {
        let path = PathBuf::from(format!("{prefix}page{page}-{name}.exr"));
        write_exr(&path, info.width, info.height, &rgb(lightmap, page, layer)?)?;
        Ok(path)
    })
}

/// Writes the light layers tone mapped, `PREFIXpageN-LAYER.png`, and returns the paths.
pub fn write_png_pages(lightmap: &Lightmap, prefix: &str, exposure: f32, progress: &Progress) -> Result<Vec<PathBuf>> {
    let info = lightmap.info();
    each_page(lightmap, progress, |page, layer, name| {
        let path = PathBuf::from(format!("{prefix}page{page}-{name}.png"));
        // Radiance is albedo/π times irradiance: π brings it to the brightness of the others.
        let exposure = if layer == Layer::Radiance { exposure * PI } else { exposure };
        write_png_rgb8(&path, info.width, info.height, &tone_mapped(lightmap, page, layer, exposure)?)?;
        Ok(path)
    })
}

/// Writes the scene with its light map to the GLB file `path`.
pub fn write_scene(lightmap: &Lightmap, path: &Path, exposure: f32) -> Result<()> {
    let info = lightmap.info();
    let meshes =
        (0..lightmap.scene().meshes().len() as u32).map(|mesh| GlbMesh::of(lightmap, mesh)).collect::<Result<_>>()?;
    let page =
        |page| encode_png_rgb8(info.width, info.height, &tone_mapped(lightmap, page, Layer::Combined, exposure)?);
    let pages = (0..info.page_count).map(page).collect::<Result<_>>()?;
    write_glb(path, lightmap.scene(), &GlbLightmap { meshes, pages })
}

/// Runs `write` for each light layer of each page, in parallel.
fn each_page(
    lightmap: &Lightmap,
    progress: &Progress,
    write: impl Fn(u32, Layer, &str) -> Result<PathBuf> + Sync,
) -> Result<Vec<PathBuf>> {
    let jobs: Vec<(u32, Layer, &str)> =
        (0..lightmap.info().page_count).flat_map(|page| LAYERS.map(|(layer, name)| (page, layer, name))).collect();
    let stage: Stage = progress.stage("pages", 0.0, 1.0, jobs.len() as u64);
    lightmap.scene().device().run(progress, || {
        let written = jobs.par_iter().map(|&(page, layer, name)| {
            let path = write(page, layer, name)?;
            stage.advance(1)?;
            Ok(path)
        });
        written.collect()
    })
}

/// A light layer of a page.
fn rgb(lightmap: &Lightmap, page: u32, layer: Layer) -> Result<Vec<[f32; 3]>> {
    match lightmap.read(page, layer)? {
        LayerData::Rgb(pixels) => Ok(pixels),
        _ => Err(Error::Internal(format!("layer {layer:?} is not RGB"))),
    }
}

fn tone_mapped(lightmap: &Lightmap, page: u32, layer: Layer, exposure: f32) -> Result<Vec<[u8; 3]>> {
    Ok(rgb(lightmap, page, layer)?.iter().map(|&p| tone_map(exposure, p)).collect())
}
