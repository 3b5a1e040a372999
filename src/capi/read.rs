//! Reading and saving light maps
//!
//! Thread safety: any thread; during a bake of the light map these functions fail with
//! BK_ERROR_INVALID_STATE.
//!
//! Cost: reading copies a page, in up to 0.2 s per million texels; writing files takes the time of
//! compression and of the disk.

use super::args::slice;
use super::device::{bk_progress_fn, call_with_file, progress, refuse_in_callback};
use super::error::{bk_result, call};
use super::handles::{hold, is_null, object};
use super::lightmap::bk_lightmap;
use crate::base::error::{Error, Result, invalid_argument};
use crate::base::memory::{try_collect, try_with_capacity};
use crate::base::progress::Progress;
use crate::lightmap::{Half, Layer, LayerData, Lightmap, packed_ratio};
use half::f16;
use half::slice::HalfFloatSliceExt;
use std::ffi::{c_char, c_void};

/// Layer: irradiance in W/m2, direct and indirect. RGB: BK_FORMAT_RGB32F or BK_FORMAT_RGBA16F.
pub const BK_LAYER_COMBINED: u32 = 0;
/// Layer: irradiance in W/m2 that was reflected by other surfaces. RGB.
pub const BK_LAYER_INDIRECT: u32 = 1;
/// Layer: irradiance in W/m2 that comes straight from lights. RGB.
pub const BK_LAYER_DIRECT: u32 = 2;
/// Layer: outgoing radiance in W/(m2 sr), as gather rays see it. RGB.
pub const BK_LAYER_RADIANCE: u32 = 3;
/// Layer: 1 for a texel that a triangle covers; 0.5 for one whose light is copied from its
/// neighbours, because it lies in the padding around a chart or inside a solid; 0 for an empty one.
/// After a bake of a range of texels, texels that are not baked yet and the padding that repeats
/// them are 0 too; before the first bake covered texels are 1. BK_FORMAT_R32F.
pub const BK_LAYER_VALIDITY: u32 = 4;
/// Layer: position of the texel's sample in scene units; 0 where no triangle covers the texel. RGB.
pub const BK_LAYER_POSITION: u32 = 5;
/// Layer: unit normal of the texel's sample, on the side whose light it holds (before a bake the
/// front, but for separate texels of backs); 0 where no triangle covers the texel. RGB.
pub const BK_LAYER_NORMAL: u32 = 6;
/// Layer: number of the triangle that covers the texel, counted through all meshes in their order;
/// BK_NONE where there is none. BK_FORMAT_R32U.
pub const BK_LAYER_TRIANGLE: u32 = 7;
/// Layer: mean radiance over the sphere, of which the half below the surface is dark, in W/(m2 sr),
/// of the light that bk_bake_params.directional_indirect and directional_direct asked for:
/// 1 / (4 pi) times the integral of radiance. RGB. The guide ("Normal maps") has shader code.
pub const BK_LAYER_L0: u32 = 8;
/// Layer: the same mean of radiance times the x coordinate of the direction it comes from, in the
/// axes of the scene, in W/(m2 sr): -L0 to L0. RGB.
pub const BK_LAYER_L1X: u32 = 9;
/// Layer: the same for y. RGB.
pub const BK_LAYER_L1Y: u32 = 10;
/// Layer: the same for z. RGB.
pub const BK_LAYER_L1Z: u32 = 11;
/// Layer: L1X / L0, -1 to 1; 0 where there is no light. RGB, or BK_FORMAT_RGBA8 as 0.5 + 0.5 times
/// the ratio.
pub const BK_LAYER_RATIO_X: u32 = 12;
/// Layer: L1Y / L0. RGB or BK_FORMAT_RGBA8.
pub const BK_LAYER_RATIO_Y: u32 = 13;
/// Layer: L1Z / L0. RGB or BK_FORMAT_RGBA8.
pub const BK_LAYER_RATIO_Z: u32 = 14;
/// Layer: dominant direction, L1 / L0 of the sum of the channels: a vector (x, y, z) towards the
/// light whose length is 1 if all comes from one direction and 0.5 under a uniform sky. RGB or
/// BK_FORMAT_RGBA8.
pub const BK_LAYER_DIRECTION: u32 = 15;
/// Layer: standard error of the irradiance in COMBINED, in W/m2: the noise that is left after a bake
/// of several passes (bk_bake_params.passes), estimated from as many values. RGB.
pub const BK_LAYER_ERROR: u32 = 16;
/// Layer: number of the chart whose light the texel holds or, in the padding around the chart,
/// repeats; separate texels of a chart's back have another number. BK_NONE where there is none. A
/// filter that stays within texels of one number crosses no border of a chart. BK_FORMAT_R32U.
pub const BK_LAYER_CHART: u32 = 17;

/// Flag added to BK_LAYER_COMBINED, INDIRECT or DIRECT: from half of the passes of the bake alone, the
/// first pass and every second one after it. The two halves have independent noise, and their mean
/// is the layer. For denoisers; see the guide ("Denoising").
pub const BK_LAYER_FIRST_HALF: u32 = 0x100;
/// Flag added to BK_LAYER_COMBINED, INDIRECT or DIRECT: from the other half of the passes.
pub const BK_LAYER_SECOND_HALF: u32 = 0x200;

/// Format: three floats, 12 bytes per texel.
pub const BK_FORMAT_RGB32F: u32 = 1;
/// Format: four half floats, 8 bytes per texel. Alpha is 1; values beyond 65504 are clamped to it.
pub const BK_FORMAT_RGBA16F: u32 = 2;
/// Format: one float, 4 bytes per texel.
pub const BK_FORMAT_R32F: u32 = 3;
/// Format: one uint32_t, 4 bytes per texel.
pub const BK_FORMAT_R32U: u32 = 4;
/// Format: four bytes, each 255 times a value from 0 to 1, for layers of ratios. Alpha is 255.
pub const BK_FORMAT_RGBA8: u32 = 5;

/// Copies one layer of one page.
///
/// In the layers of light each texel of the padding repeats the nearest covered texel.
///
/// @param lightmap  light map; baked, if the layer holds light
/// @param page  number of the page
/// @param layer  one of the BK_LAYER values; COMBINED, INDIRECT, DIRECT, RADIANCE and those from L0 to
///   ERROR hold light. COMBINED, INDIRECT and DIRECT with or without one of the flags of halves
/// @param format  one of the BK_FORMAT values that the layer allows
/// @param dst  receives bk_lightmap_info.height rows of bk_lightmap_info.width texels; needs no
///   alignment
/// @param row_stride  distance between rows in bytes, at least the bytes of a row; 0: packed
/// @retval BK_ERROR_INVALID_ARGUMENT  page or layer does not exist, the format does not suit the
///   layer, or `row_stride` is too small
/// @retval BK_ERROR_INVALID_STATE  the layer holds light and there was no bake, or none that
///   asked for light by direction (layers from L0 to DIRECTION) or had several passes (ERROR and
///   halves), or the light map is being baked
/// @retval BK_ERROR_OUT_OF_MEMORY  a page does not fit
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_lightmap_read(
    lightmap: *const bk_lightmap,
    page: u32,
    layer: u32,
    format: u32,
    dst: *mut c_void,
    row_stride: usize,
) -> bk_result {
    call(|| {
        let lightmap = object!(lightmap);
        if dst.is_null() {
            return Err(is_null("dst"));
        }
        let (layer, half) = half_of(layer)?;
        let texel = texel_bytes(format)?;
        let (info, data) = lightmap.read(|l| {
            let data = match half {
                Some(half) => l.read_half(page, layer, half)?,
                None => l.read(page, layer)?,
            };
            Ok((l.info(), data))
        })?;
        let packed = info.width as usize * texel;
        let stride = if row_stride == 0 { packed } else { row_stride };
        if stride < packed {
            return invalid_argument!("row_stride is {row_stride}, less than the {packed} bytes of a row");
        }
        let bytes = encode(&data, layer.is_ratio(), format)?.ok_or_else(|| unsuitable(format, layer))?;
        if bytes.len() != packed * info.height as usize {
            return Err(Error::Internal(format!("page {page} has {} bytes in layer {layer:?}", bytes.len())));
        }
        // SAFETY: the caller has room for `height` rows `stride` bytes apart, and there are just that
        // many.
        unsafe { copy_rows(&bytes, packed, dst, stride) };
        Ok(())
    })
}

/// Copies rows of `packed` bytes to rows `stride` bytes apart.
///
/// # Safety
/// `dst` has room for all rows of `bytes`.
unsafe fn copy_rows(bytes: &[u8], packed: usize, dst: *mut c_void, stride: usize) {
    for (row, from) in bytes.chunks_exact(packed).enumerate() {
        // SAFETY: by contract.
        unsafe { std::ptr::copy_nonoverlapping(from.as_ptr(), dst.cast::<u8>().add(row * stride), packed) };
    }
}

/// Copies RGB texels of a layer, `width` per row, in a format of theirs.
///
/// # Safety
/// `dst` has room for all rows of texels, `stride` bytes apart.
pub(super) unsafe fn copy_rgb(
    texels: Vec<[f32; 3]>,
    layer: Layer,
    format: u32,
    width: usize,
    dst: *mut c_void,
    stride: usize,
) -> Result<()> {
    let bytes = LayerData::Rgb(texels);
    let bytes = encode(&bytes, layer.is_ratio(), format)?.ok_or_else(|| unsuitable(format, layer))?;
    if width > 0 {
        // SAFETY: by contract.
        unsafe { copy_rows(&bytes, width * texel_bytes(format)?, dst, stride) };
    }
    Ok(())
}

/// Replaces layers of a baked light map by light of the caller's, for example by denoised light. All
/// that reads, samples, saves or writes the light map uses it from then on, until the next bake.
///
/// Values of texels with validity 1 are taken (BK_LAYER_VALIDITY); others, as in the padding, are
/// ignored: texels inside of solids get the new light of the texel that they repeat. Seams are
/// stitched anew, if the bake stitched them. BK_LAYER_RADIANCE and BK_LAYER_ERROR stay those of the
/// bake, and halves differ by as much as before. A call that fails changes nothing.
///
/// Cost: copying the texels, and bk_bake_stats.seam_seconds.
///
/// @param lightmap  light map of which all texels are baked
/// @param layers  layers to replace, each once: BK_LAYER_DIRECT, BK_LAYER_INDIRECT and, after a bake with
///   light by direction, BK_LAYER_L0, BK_LAYER_L1X, BK_LAYER_L1Y and BK_LAYER_L1Z; where L1 is longer
///   than L0, it is shortened
/// @param layer_count  number of elements of `layers`
/// @param format  BK_FORMAT_RGB32F or BK_FORMAT_RGBA16F, whose alpha is ignored
/// @param texels  for each of `layers`, its pages one after the other, each of them
///   bk_lightmap_info.height packed rows; finite, up to 1e30, and >= 0 but for L1; needs no alignment
/// @param progress,user  progress callback and its pointer; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  a layer cannot be written or comes twice, the format is another
///   one, or a value is none of light; bk_last_error names the texel
/// @retval BK_ERROR_INVALID_STATE  not all texels are baked, there was no light by direction, or
///   another call is using the light map
/// @retval BK_ERROR_OUT_OF_MEMORY  a copy of the light does not fit
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_lightmap_write(
    lightmap: *mut bk_lightmap,
    layers: *const u32,
    layer_count: usize,
    format: u32,
    texels: *const c_void,
    progress: bk_progress_fn,
    user: *mut c_void,
) -> bk_result {
    call(|| {
        refuse_in_callback()?;
        // SAFETY: a handle, or NULL.
        let lightmap = unsafe { hold(lightmap, "lightmap") }?;
        // SAFETY: the caller's array, or NULL.
        let layers = unsafe { slice(layers, layer_count, "layers") }?;
        let layers = try_collect(layers.iter().map(|&layer| core_layer(layer)), "layers")?;
        let layers = layers.into_iter().collect::<Result<Vec<Layer>>>()?;
        if format != BK_FORMAT_RGB32F && format != BK_FORMAT_RGBA16F {
            return invalid_argument!("format is {format}, neither BK_FORMAT_RGB32F nor BK_FORMAT_RGBA16F");
        }
        let texel = texel_bytes(format)?;
        lightmap.change(|l| {
            let info = l.info();
            let [pages, width, height] = [info.page_count, info.width, info.height].map(|n| n as usize);
            let bytes = (pages * width * height * texel).checked_mul(layers.len());
            let Some(bytes) = bytes.filter(|&b| isize::try_from(b).is_ok()) else {
                return invalid_argument!("layer_count is {layer_count}, of which no memory holds the texels");
            };
            // SAFETY: the caller's array of so many bytes, or NULL.
            let bytes = unsafe { slice(texels.cast::<u8>(), bytes, "texels") }?;
            let value = |layer: usize, page: u32, x: u32, y: u32| {
                let at = ((layer * pages + page as usize) * height + y as usize) * width + x as usize;
                decode(&bytes[at * texel..][..texel])
            };
            l.write(&layers, value, &self::progress(progress, user))
        })
    })
}

/// Red, green and blue of a texel: of three floats, or of four halves.
fn decode(texel: &[u8]) -> [f32; 3] {
    std::array::from_fn(|c| match texel.len() {
        12 => bytemuck::pod_read_unaligned(&texel[4 * c..][..4]),
        _ => f16::from_bits(bytemuck::pod_read_unaligned(&texel[2 * c..][..2])).to_f32(),
    })
}

/// The layer, and the half of the passes that a flag names.
fn half_of(layer: u32) -> Result<(Layer, Option<Half>)> {
    let half = match layer & (BK_LAYER_FIRST_HALF | BK_LAYER_SECOND_HALF) {
        0 => return Ok((core_layer(layer)?, None)),
        BK_LAYER_FIRST_HALF => Half::First,
        BK_LAYER_SECOND_HALF => Half::Second,
        _ => return invalid_argument!("layer is {layer}, which has the flags of both halves"),
    };
    Ok((core_layer(layer & 0xff)?, Some(half)))
}

fn unsuitable(format: u32, layer: Layer) -> Error {
    Error::InvalidArgument(format!("format is {format}, which does not suit the layer {layer:?}"))
}

pub(super) fn core_layer(layer: u32) -> Result<Layer> {
    Ok(match layer {
        BK_LAYER_COMBINED => Layer::Combined,
        BK_LAYER_INDIRECT => Layer::Indirect,
        BK_LAYER_DIRECT => Layer::Direct,
        BK_LAYER_RADIANCE => Layer::Radiance,
        BK_LAYER_VALIDITY => Layer::Validity,
        BK_LAYER_POSITION => Layer::Position,
        BK_LAYER_NORMAL => Layer::Normal,
        BK_LAYER_TRIANGLE => Layer::Triangle,
        BK_LAYER_L0 => Layer::L0,
        BK_LAYER_L1X => Layer::L1X,
        BK_LAYER_L1Y => Layer::L1Y,
        BK_LAYER_L1Z => Layer::L1Z,
        BK_LAYER_RATIO_X => Layer::RatioX,
        BK_LAYER_RATIO_Y => Layer::RatioY,
        BK_LAYER_RATIO_Z => Layer::RatioZ,
        BK_LAYER_DIRECTION => Layer::Direction,
        BK_LAYER_ERROR => Layer::Error,
        BK_LAYER_CHART => Layer::Chart,
        other => return invalid_argument!("layer is {other}, not one of the BK_LAYER values"),
    })
}

pub(super) fn texel_bytes(format: u32) -> Result<usize> {
    Ok(match format {
        BK_FORMAT_RGB32F => 12,
        BK_FORMAT_RGBA16F => 8,
        BK_FORMAT_R32F | BK_FORMAT_R32U | BK_FORMAT_RGBA8 => 4,
        other => return invalid_argument!("format is {other}, not one of the BK_FORMAT values"),
    })
}

/// The texels of a layer, of ratios or not, in a format, or `None` if the format does not suit it.
fn encode(data: &LayerData, is_ratio: bool, format: u32) -> Result<Option<std::borrow::Cow<'_, [u8]>>> {
    Ok(match (data, format) {
        (LayerData::Rgb(rgb), BK_FORMAT_RGB32F) => Some(bytemuck::cast_slice(rgb).into()),
        (LayerData::Rgb(rgb), BK_FORMAT_RGBA16F) => {
            let half = |&[r, g, b]: &[f32; 3]| half_bits([r, g, b, 1.0]);
            let mut bytes = try_with_capacity(8 * rgb.len(), "a page")?;
            bytes.extend(rgb.iter().flat_map(|t| bytemuck::cast::<[u16; 4], [u8; 8]>(half(t))));
            Some(bytes.into())
        }
        (LayerData::Rgb(rgb), BK_FORMAT_RGBA8) if is_ratio => {
            let mut bytes = try_with_capacity(4 * rgb.len(), "a page")?;
            let bytes_of = |t: &[f32; 3]| t.map(packed_ratio);
            bytes.extend(rgb.iter().map(bytes_of).flat_map(|[r, g, b]| [r, g, b, 255]));
            Some(bytes.into())
        }
        (LayerData::Scalar(v), BK_FORMAT_R32F) => Some(bytemuck::cast_slice(v).into()),
        (LayerData::Integer(v), BK_FORMAT_R32U) => Some(bytemuck::cast_slice(v).into()),
        _ => None,
    })
}

/// IEEE 754 half precision, rounded to nearest even; magnitudes beyond the largest half are clamped
/// to it, NaN stays NaN.
fn half_bits(values: [f32; 4]) -> [u16; 4] {
    let largest = f32::from(f16::MAX);
    let mut halves = [f16::ZERO; 4];
    halves.convert_from_f32_slice(&values.map(|x| x.clamp(-largest, largest)));
    halves.map(f16::to_bits)
}

/// Kind of file: float images of the light layers, PREFIXpageN-LAYER.exr with LAYER one of
/// combined, indirect, direct, radiance; with light by direction also l0, ratio-x, ratio-y, ratio-z.
pub const BK_FILE_EXR: u32 = 1;
/// Kind of file: tone-mapped 8-bit images of the light layers for viewing, PREFIXpageN-LAYER.png;
/// with light by direction also its ratios, as in BK_FORMAT_RGBA8.
pub const BK_FILE_PNG: u32 = 2;
/// Kind of file: the scene with its light map for viewers and engines, PREFIXscene.glb (glTF 2.0).
///
/// The light map is addressed by TEXCOORD_1. Materials without a texture are unlit and have the
/// light map as baseColorTexture, so that any viewer shows the light. The others keep their texture
/// as baseColorTexture on TEXCOORD_0 and have the light map as occlusionTexture on TEXCOORD_1:
/// viewers with lights of their own dim those by it, and importers find it there. Each page is an
/// 8-bit sRGB image of irradiance times an exposure, compressed above 0.6; the extras of the asset
/// and of each material state texture, exposure and curve. Triangles whose backs have separate
/// texels are written twice, one-sided.
pub const BK_FILE_GLB: u32 = 3;

/// Writes a baked light map to files.
///
/// Each file is written beside the old one of its name (NAME.part), flushed to disk, and renamed:
/// whatever ends the call early, for example a full disk, a cancel or a kill, each old file is kept
/// or replaced as a whole. After a kill NAME.part may be left over; the next save overwrites it.
///
/// @param lightmap  baked light map
/// @param path_prefix  beginning of the file names that the BK_FILE values state, for example
///   "out/" for files in the folder out, which must exist; UTF-8
/// @param file_format  one of the BK_FILE values
/// @param progress,user  progress callback and its pointer; may be NULL
/// @retval BK_ERROR_IO  a file cannot be written or another call is writing it; bk_last_error names
///   it
/// @retval BK_ERROR_INVALID_STATE  there was no bake, or the light map is being baked
/// @retval BK_ERROR_UNSUPPORTED  the library was built without files, or a GLB file would have more
///   than 4 GiB
/// @retval BK_ERROR_OUT_OF_MEMORY  the images do not fit or the memory callback refuses
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_lightmap_save(
    lightmap: *const bk_lightmap,
    path_prefix: *const c_char,
    file_format: u32,
    progress: bk_progress_fn,
    user: *mut c_void,
) -> bk_result {
    // SAFETY: a handle or NULL; path_prefix is the caller's, or NULL.
    unsafe {
        call_with_file((lightmap, "lightmap"), (path_prefix, "path_prefix"), |lightmap, prefix| {
            lightmap.read(|l| save(l, prefix, file_format, &self::progress(progress, user)))
        })
    }
}

#[cfg(feature = "io")]
fn save(lightmap: &Lightmap, prefix: &str, file_format: u32, progress: &Progress) -> Result<()> {
    use crate::io::lightmaps;
    match file_format {
        BK_FILE_EXR => lightmaps::write_exr_pages(lightmap, prefix, progress).map(drop),
        BK_FILE_PNG => lightmaps::write_png_pages(lightmap, prefix, None, progress).map(drop),
        BK_FILE_GLB => lightmaps::write_scene(lightmap, format!("{prefix}scene.glb").as_ref(), None, progress),
        other => invalid_argument!("file_format is {other}, not one of the BK_FILE values"),
    }
}

#[cfg(not(feature = "io"))]
fn save(_: &Lightmap, prefix: &str, _: u32, _: &Progress) -> Result<()> {
    Err(Error::Unsupported(format!("the library was built without files and cannot write {prefix}")))
}

/// Saves the light of all texels that have been baked so far, to be loaded by
/// bk_lightmap_load_result in another process or on another machine.
///
/// Experimental: another version of the library may refuse the file.
///
/// @param lightmap  baked light map
/// @param path  name of the file, which is replaced as a whole or not at all; UTF-8
/// @param progress,user  progress callback and its pointer; may be NULL
/// @retval BK_ERROR_INVALID_STATE  there was no bake, the light map is being baked, or bakes with
///   different parameters or lights filled the texels
/// @retval BK_ERROR_OUT_OF_MEMORY  a buffer does not fit
/// @retval BK_ERROR_IO  the file cannot be written; bk_last_error names it
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_lightmap_save_result(
    lightmap: *const bk_lightmap,
    path: *const c_char,
    progress: bk_progress_fn,
    user: *mut c_void,
) -> bk_result {
    // SAFETY: a handle or NULL; path is the caller's, or NULL.
    unsafe {
        call_with_file((lightmap, "lightmap"), (path, "path"), |lightmap, path| {
            lightmap.read(|l| l.save_result(path.as_ref(), &self::progress(progress, user)))
        })
    }
}

/// Loads light that bk_lightmap_save_result wrote for a light map of the same scene, lights and
/// layout.
///
/// Light of texels that the file does not hold stays. So several machines can bake some texels each
/// (texel_begin and texel_end of bk_bake_params, all else equal), and one of them loads all files,
/// in any order: the light then has the bits of one bake, and seams are stitched with the last
/// texels. A call that fails changes nothing.
///
/// Files from untrusted sources are safe to load: every number is checked, and light is finite and
/// >= 0. It may be any such light, though.
///
/// Experimental: another version of the library may refuse the file.
///
/// @param lightmap  any light map
/// @param path  name of the file; UTF-8
/// @param progress,user  progress callback and its pointer; may be NULL
/// @retval BK_ERROR_INVALID_ARGUMENT  the file is of another scene, light map, version of the
///   library or instruction set (AVX2 and AVX-512 count as one), or of other lights; bk_last_error
///   says which
/// @retval BK_ERROR_INVALID_STATE  another call is using the light map, or the file holds some
///   texels only and the light map holds light of a bake with other parameters
/// @retval BK_ERROR_IO  the file cannot be read, is damaged, or is another kind of file;
///   bk_last_error names it
/// @retval BK_ERROR_OUT_OF_MEMORY  the light does not fit
/// @retval BK_ERROR_CANCELLED  the progress callback returned 0
#[unsafe(no_mangle)]
pub unsafe extern "C" fn bk_lightmap_load_result(
    lightmap: *mut bk_lightmap,
    path: *const c_char,
    progress: bk_progress_fn,
    user: *mut c_void,
) -> bk_result {
    // SAFETY: a handle or NULL; path is the caller's, or NULL.
    unsafe {
        call_with_file((lightmap.cast_const(), "lightmap"), (path, "path"), |lightmap, path| {
            lightmap.change(|l| l.load_result(path.as_ref(), &self::progress(progress, user)))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The value of a half, by its definition.
    fn half_value(bits: u16) -> f64 {
        let (exponent, fraction) = (i32::from(bits >> 10 & 31), f64::from(bits & 0x3ff));
        let magnitude = match exponent {
            0 => fraction * 2f64.powi(-24),
            e => (1.0 + fraction / 1024.0) * 2f64.powi(e - 15),
        };
        if bits & 0x8000 != 0 { -magnitude } else { magnitude }
    }

    #[test]
    fn every_finite_half_survives_the_way_through_f32() {
        for bits in (0..=0x7bffu16).chain(0x8000..=0xfbff) {
            assert_eq!(half_bits([half_value(bits) as f32; 4]), [bits; 4]);
        }
    }

    #[test]
    fn between_two_halves_the_nearer_is_taken_and_in_the_middle_the_even_one() {
        for bits in 0..0x7bffu16 {
            let (low, high) = (half_value(bits), half_value(bits + 1));
            let middle = ((low + high) / 2.0) as f32;
            let rounded = half_bits([middle, middle.next_down(), middle.next_up(), -middle]);
            let even = bits + (bits & 1);
            assert_eq!(rounded, [even, bits, bits + 1, even | 0x8000]);
        }
    }

    #[test]
    fn halves_are_clamped_and_nan_stays() {
        let halves = half_bits([1e9, f32::INFINITY, -1e9, f32::NAN]);
        assert_eq!((&halves[..3], halves[3] & 0x7fff), (&[0x7bff, 0x7bff, 0xfbff][..], 0x7e00));
    }

    #[test]
    fn a_format_that_does_not_suit_the_layer_is_none() {
        assert_eq!(encode(&LayerData::Rgb(vec![[1.0; 3]]), false, BK_FORMAT_R32F), Ok(None));
        assert_eq!(encode(&LayerData::Integer(vec![1]), false, BK_FORMAT_R32F), Ok(None));
        assert_eq!(encode(&LayerData::Rgb(vec![[1.0; 3]]), false, BK_FORMAT_RGBA8), Ok(None));
        let rgb = LayerData::Rgb(vec![[1.0, 0.5, 0.0]]);
        let half = encode(&rgb, false, BK_FORMAT_RGBA16F).unwrap().unwrap();
        assert_eq!(*half, *bytemuck::cast_slice::<u16, u8>(&[0x3c00, 0x3800, 0, 0x3c00]));
        let ratios = LayerData::Rgb(vec![[-1.0, 0.0, 0.5]]);
        let bytes = encode(&ratios, true, BK_FORMAT_RGBA8).unwrap().unwrap();
        assert_eq!(*bytes, [0, 128, 191, 255]);
    }
}
