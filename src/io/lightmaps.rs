//! Baked light maps as files: pages layer by layer as EXR or PNG, or the lit scene as GLB.

use super::account::Account;
use super::glb::prepare_glb;
use super::image::{encode_png, exposure_of, luminance, tone_map, write_exr_with, write_png_with};
use super::source::Advance;
use crate::base::error::{Error, Result};
use crate::base::memory::{Reservation, try_vec};
use crate::base::parallel::one_by_one;
use crate::base::progress::Progress;
use crate::lightmap::{Layer, LayerData, Lightmap, packed_ratio};
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

/// Layers of light by direction, of light maps that have it. PNG shows the ratios alone, as 0.5 plus half of the value.
const DIRECTIONAL: [(Layer, &str); 4] =
    [(Layer::L0, "l0"), (Layer::RatioX, "ratio-x"), (Layer::RatioY, "ratio-y"), (Layer::RatioZ, "ratio-z")];

/// Error of light maps of several passes; PNG does not show it.
const ERROR: [(Layer, &str); 1] = [(Layer::Error, "error")];

/// One exposure for all pages (see [`auto_exposure`](super::image::auto_exposure)), from the texels that are lit.
pub fn exposure(lightmap: &Lightmap) -> Result<f32> {
    let mut account = Account::new(lightmap.scene().device().memory())?;
    let mut luminances = Vec::new();
    for page in 0..lightmap.info().page_count {
        let page = rgb(lightmap, page, Layer::Combined)?;
        account.make_room(&mut luminances, page.len(), "the exposure")?;
        luminances.extend(page.into_iter().map(luminance));
    }
    Ok(exposure_of(&mut luminances))
}

/// Writes the light layers as floats, `PREFIXpageN-LAYER.exr`, and returns the paths.
///
/// Each file replaces an older one as a whole. When the call fails or is cancelled, files that were written before
/// stay.
pub fn write_exr_pages(lightmap: &Lightmap, prefix: &str, progress: &Progress) -> Result<Vec<PathBuf>> {
    let info = lightmap.info();
    lightmap.scene().device().run(progress, || {
        each_page(
            lightmap,
            |_| true,
            progress,
            |page, layer, name, advance| {
                let path = PathBuf::from(format!("{prefix}page{page}-{name}.exr"));
                write_exr_with(&path, info.width, info.height, &rgb(lightmap, page, layer)?, advance)?;
                Ok(path)
            },
        )
    })
}

/// Writes the light layers tone mapped, `PREFIXpageN-LAYER.png`, and returns the paths. `exposure`: `None` chooses
/// [one](exposure). Otherwise same as [`write_exr_pages`].
pub fn write_png_pages(
    lightmap: &Lightmap,
    prefix: &str,
    exposure: Option<f32>,
    progress: &Progress,
) -> Result<Vec<PathBuf>> {
    let info = lightmap.info();
    lightmap.scene().device().run(progress, || {
        let exposure = exposure.map_or_else(|| self::exposure(lightmap), Ok)?;
        each_page(
            lightmap,
            |layer| !matches!(layer, Layer::L0 | Layer::Error),
            progress,
            |page, layer, name, advance| {
                let path = PathBuf::from(format!("{prefix}page{page}-{name}.png"));
                // Radiance is albedo/π times irradiance: π brings it to the brightness of the others.
                let exposure = if layer == Layer::Radiance { exposure * PI } else { exposure };
                let pixels = match layer.is_ratio() {
                    true => packed(lightmap, page, layer)?,
                    false => tone_mapped(lightmap, page, layer, exposure)?,
                };
                write_png_with(&path, info.width, info.height, &pixels, advance)?;
                Ok(path)
            },
        )
    })
}

/// Writes the scene with its light map to the GLB file `path`, see [`super::glb`]. `exposure`: `None` chooses
/// [one](exposure). Otherwise same as [`write_exr_pages`].
pub fn write_scene(lightmap: &Lightmap, path: &Path, exposure: Option<f32>, progress: &Progress) -> Result<()> {
    let info = lightmap.info();
    let new = lightmap.scene().device().run(progress, || {
        let stage = progress.stage("scene with light map", 0.0, 1.0, u64::from(info.page_count) + 2);
        let exposure = exposure.map_or_else(|| self::exposure(lightmap), Ok)?;
        let page = |page| {
            let _encoder = encoder_memory(lightmap)?;
            let pixels = tone_mapped(lightmap, page, Layer::Combined, exposure)?;
            let file =
                encode_png(info.width, info.height, &pixels, png::ColorType::Rgb, &|parts| stage.advance(parts))?;
            stage.advance(1)?;
            Ok(file)
        };
        let pages = (0..info.page_count).into_par_iter().map(page).collect::<Result<Vec<_>>>()?;
        let new = prepare_glb(path, lightmap.scene(), lightmap, &pages, exposure, &|parts| stage.advance(parts))?;
        lightmap.scene().check_file()?;
        Ok(new)
    })?;
    new.finish()
}

/// Announces the memory that an encoder allocates by itself for a page: the filtered rows and the file.
fn encoder_memory(lightmap: &Lightmap) -> Result<Reservation> {
    let info = lightmap.info();
    let bytes = 24 * info.width as usize * info.height as usize;
    lightmap.scene().device().memory().reserve(bytes, "a page being encoded")
}

/// Runs `write` for each light layer of each page that is wanted, in parallel.
fn each_page(
    lightmap: &Lightmap,
    is_wanted: impl Fn(Layer) -> bool,
    progress: &Progress,
    write: impl Fn(u32, Layer, &str, Advance) -> Result<PathBuf> + Sync,
) -> Result<Vec<PathBuf>> {
    let directional = if lightmap.has_directional() { &DIRECTIONAL[..] } else { &[] };
    let error = if lightmap.has_error() { &ERROR[..] } else { &[] };
    let layers = || LAYERS.iter().chain(directional).chain(error).filter(|(layer, _)| is_wanted(*layer));
    let jobs: Vec<(u32, Layer, &str)> = (0..lightmap.info().page_count)
        .flat_map(|page| layers().map(move |&(layer, name)| (page, layer, name)))
        .collect();
    let stage = progress.stage("pages", 0.0, 1.0, jobs.len() as u64);
    let written = one_by_one(jobs.par_iter()).map(|&(page, layer, name)| {
        stage.advance(0)?;
        let _encoder = encoder_memory(lightmap)?;
        let path = write(page, layer, name, &|parts| stage.advance(parts))?;
        stage.advance(1)?;
        Ok(path)
    });
    written.collect()
}

/// A light layer of a page.
fn rgb(lightmap: &Lightmap, page: u32, layer: Layer) -> Result<Vec<[f32; 3]>> {
    match lightmap.read(page, layer)? {
        LayerData::Rgb(pixels) => Ok(pixels),
        _ => Err(Error::Internal(format!("layer {layer:?} is not RGB"))),
    }
}

/// A layer of ratios, −1 to 1, as bytes.
fn packed(lightmap: &Lightmap, page: u32, layer: Layer) -> Result<Vec<[u8; 3]>> {
    let pixels = rgb(lightmap, page, layer)?;
    let mut bytes = try_vec::<[u8; 3]>(pixels.len(), "a page being encoded")?;
    bytes.iter_mut().zip(&pixels).for_each(|(to, from)| *to = from.map(packed_ratio));
    Ok(bytes)
}

fn tone_mapped(lightmap: &Lightmap, page: u32, layer: Layer, exposure: f32) -> Result<Vec<[u8; 3]>> {
    let pixels = rgb(lightmap, page, layer)?;
    let mut mapped = try_vec::<[u8; 3]>(pixels.len(), "a page being encoded")?;
    mapped.iter_mut().zip(&pixels).for_each(|(to, &from)| *to = tone_map(exposure, from));
    Ok(mapped)
}
