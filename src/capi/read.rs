//! Reading and saving light maps

use super::device::{bk_progress_fn, call_with_file, progress};
use super::error::{bk_result, call};
use super::handles::{is_null, object};
use super::lightmap::bk_lightmap;
use crate::error::{Error, Result, invalid_argument};
use crate::lightmap::{Layer, LayerData, Lightmap};
use crate::progress::Progress;
use std::ffi::{c_char, c_void};

/// Irradiance, direct and indirect, in W/m2. RGB: BK_FORMAT_RGB32F or BK_FORMAT_RGBA16F.
pub const BK_LAYER_COMBINED: u32 = 0;
/// Irradiance by way of other surfaces, in W/m2. RGB.
pub const BK_LAYER_INDIRECT: u32 = 1;
/// Irradiance straight from lights, in W/m2. RGB.
pub const BK_LAYER_DIRECT: u32 = 2;
/// Outgoing radiance as gather rays see it, in W/(m2 sr). RGB.
pub const BK_LAYER_RADIANCE: u32 = 3;
/// 1 for a texel that a triangle covers; 0.5 for one whose light is filled in from its neighbours, because
/// it lies in the padding around a chart or inside a solid; 0 for an empty one. After a bake of some
/// texels, those that are not baked yet, and the padding that repeats them, are 0 too; before the first
/// bake covered texels are 1. BK_FORMAT_R32F.
pub const BK_LAYER_VALIDITY: u32 = 4;
/// Position of the texel's sample in the scene; 0 where no triangle covers the texel. RGB.
pub const BK_LAYER_POSITION: u32 = 5;
/// Unit normal of the texel's sample, on the side whose light it holds (before a bake the front, but for
/// backs with texels of their own); 0 where no triangle covers the texel. RGB.
pub const BK_LAYER_NORMAL: u32 = 6;
/// Number of the triangle that covers the texel, counted through all meshes in their order; BK_NONE
/// where there is none. BK_FORMAT_R32U.
pub const BK_LAYER_TRIANGLE: u32 = 7;

/// Three floats: 12 bytes per texel.
pub const BK_FORMAT_RGB32F: u32 = 1;
/// Four half floats: 8 bytes per texel. Alpha is 1; values beyond 65504 are clamped to it.
pub const BK_FORMAT_RGBA16F: u32 = 2;
/// One float: 4 bytes per texel.
pub const BK_FORMAT_R32F: u32 = 3;
/// One uint32_t: 4 bytes per texel.
pub const BK_FORMAT_R32U: u32 = 4;

/// Copies one layer of one page.
///
/// layer: one of the BK_LAYER values. BK_LAYER_COMBINED, INDIRECT, DIRECT and RADIANCE hold light and need
/// a bake; VALIDITY, POSITION, NORMAL and TRIANGLE can be read at any time but during one. In the layers
/// of light each texel of the padding repeats the nearest covered texel. format: one of the BK_FORMAT
/// values that suits the layer, as stated there. dst: receives height rows, row_stride bytes apart, of
/// width texels; needs no alignment. row_stride: at least the bytes of a row of texels; 0: just that many.
///
/// Fails with BK_ERROR_INVALID_ARGUMENT if page, layer or format does not exist or row_stride is too
/// small, BK_ERROR_INVALID_STATE if the layer holds light and there was no bake, or during a bake,
/// BK_ERROR_OUT_OF_MEMORY if a page does not fit.
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
        let layer = core_layer(layer)?;
        let texel = texel_bytes(format)?;
        let (info, data) = lightmap.read(|l| Ok((l.info(), l.read(page, layer)?)))?;
        let packed = info.width as usize * texel;
        let stride = if row_stride == 0 { packed } else { row_stride };
        if stride < packed {
            return invalid_argument!("row_stride is {row_stride}, less than the {packed} bytes of a row");
        }
        let bytes = encode(&data, format).ok_or_else(|| {
            Error::InvalidArgument(format!("format is {format}, which does not suit the layer {layer:?}"))
        })?;
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

/// Copies RGB texels, `width` per row, in a format of theirs.
///
/// # Safety
/// `dst` has room for all rows of texels, `stride` bytes apart.
pub(super) unsafe fn copy_rgb(
    texels: Vec<[f32; 3]>,
    format: u32,
    width: usize,
    dst: *mut c_void,
    stride: usize,
) -> Result<()> {
    let bytes = LayerData::Rgb(texels);
    let bytes = encode(&bytes, format)
        .ok_or_else(|| Error::InvalidArgument(format!("format is {format}, not one of the formats of light")))?;
    if width > 0 {
        // SAFETY: by contract.
        unsafe { copy_rows(&bytes, width * texel_bytes(format)?, dst, stride) };
    }
    Ok(())
}

fn core_layer(layer: u32) -> Result<Layer> {
    Ok(match layer {
        BK_LAYER_COMBINED => Layer::Combined,
        BK_LAYER_INDIRECT => Layer::Indirect,
        BK_LAYER_DIRECT => Layer::Direct,
        BK_LAYER_RADIANCE => Layer::Radiance,
        BK_LAYER_VALIDITY => Layer::Validity,
        BK_LAYER_POSITION => Layer::Position,
        BK_LAYER_NORMAL => Layer::Normal,
        BK_LAYER_TRIANGLE => Layer::Triangle,
        other => return invalid_argument!("layer is {other}, not one of the BK_LAYER values"),
    })
}

pub(super) fn texel_bytes(format: u32) -> Result<usize> {
    Ok(match format {
        BK_FORMAT_RGB32F => 12,
        BK_FORMAT_RGBA16F => 8,
        BK_FORMAT_R32F | BK_FORMAT_R32U => 4,
        other => return invalid_argument!("format is {other}, not one of the BK_FORMAT values"),
    })
}

/// The texels of a layer in a format, or `None` if the format does not suit it.
fn encode(data: &LayerData, format: u32) -> Option<std::borrow::Cow<'_, [u8]>> {
    match (data, format) {
        (LayerData::Rgb(rgb), BK_FORMAT_RGB32F) => Some(bytemuck::cast_slice(rgb).into()),
        (LayerData::Rgb(rgb), BK_FORMAT_RGBA16F) => {
            let half = |rgb: &[f32; 3]| [rgb[0], rgb[1], rgb[2], 1.0].map(half_bits);
            Some(rgb.iter().flat_map(|t| bytemuck::cast::<[u16; 4], [u8; 8]>(half(t))).collect())
        }
        (LayerData::Scalar(v), BK_FORMAT_R32F) => Some(bytemuck::cast_slice(v).into()),
        (LayerData::Integer(v), BK_FORMAT_R32U) => Some(bytemuck::cast_slice(v).into()),
        _ => None,
    }
}

/// IEEE 754 half precision, rounded to nearest even; magnitudes beyond the largest half are clamped
/// to it, NaN stays NaN.
fn half_bits(x: f32) -> u16 {
    const LARGEST: f32 = 65504.0;
    const SMALLEST_NORMAL: f32 = 6.103_515_6e-5;
    let sign = (x.to_bits() >> 16) as u16 & 0x8000;
    if x.is_nan() {
        return sign | 0x7e00;
    }
    let magnitude = x.abs().min(LARGEST);
    let half = if magnitude < SMALLEST_NORMAL {
        // Adding 0.5 leaves the units of a subnormal half (2^-24) in the last bits, rounded by the FPU.
        (magnitude + 0.5).to_bits() - 0.5f32.to_bits()
    } else {
        // Exponent bias 127 becomes 15; 13 bits of the fraction go, rounded to even by their top.
        let bits = magnitude.to_bits() - ((127 - 15) << 23);
        (bits + 0xfff + (bits >> 13 & 1)) >> 13
    };
    sign | half as u16
}

/// Float images of the light layers: PREFIXpageN-LAYER.exr, LAYER one of combined, indirect, direct,
/// radiance.
pub const BK_FILE_EXR: u32 = 1;
/// Tone-mapped 8-bit images of the light layers, to look at: PREFIXpageN-LAYER.png.
pub const BK_FILE_PNG: u32 = 2;
/// The scene with its light map, for viewers and engines: PREFIXscene.glb (glTF 2.0). The light map is read through
/// TEXCOORD_1. Materials without a texture of their own are unlit and have the light map as baseColorTexture, so that
/// any viewer shows the light. Others keep their texture as baseColorTexture on TEXCOORD_0 and have the light map as
/// occlusionTexture on TEXCOORD_1: viewers with light of their own dim it by that, and importers find it there.
/// Each page is an 8-bit sRGB image of irradiance times an exposure, bent above 0.6; the extras of the asset and of
/// each material say which texture, the exposure and the curve. Triangles whose back has texels of its own are there
/// twice, one-sided.
pub const BK_FILE_GLB: u32 = 3;

/// Writes a baked light map to files.
///
/// path_prefix: UTF-8, put before the file names that the BK_FILE values state, as "out/" for files
/// in the folder out, which must exist. file_format: one of the BK_FILE values. progress, user: told how far it is,
/// and may cancel; NULL if not wanted.
///
/// Each file is written beside the old one of its name (NAME.part), flushed to disk, and renamed: whatever ends the
/// call early, a full disk, a cancel or a kill, each old file is there as a whole or replaced as a whole. After a kill
/// NAME.part may be left; the next save writes over it.
///
/// Fails with BK_ERROR_IO, naming the file, if it cannot be written or another call is writing it, with
/// BK_ERROR_INVALID_STATE before a bake or inside a callback, with BK_ERROR_CANCELLED, with BK_ERROR_OUT_OF_MEMORY,
/// with BK_ERROR_UNSUPPORTED if the library was built without files or a GLB file would have more than 4 GiB.
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

/// Writes the light of all texels that have been baked so far to a file, from which bk_lightmap_load_result brings
/// it back, in another process or on another machine.
///
/// path: UTF-8; the file is replaced as a whole or not at all. progress, user: the progress callback and its
/// pointer; progress may be NULL.
///
/// Fails with BK_ERROR_INVALID_STATE before a bake, during one, or if bakes that differ in parameters or lights filled
/// the texels; with BK_ERROR_IO, naming the file, if it cannot be written; with BK_ERROR_CANCELLED if
/// progress says so.
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

/// Takes over the light of a file that bk_lightmap_save_result wrote for a light map of the same scene, lights and
/// layout. Light of texels that the file does not have stays: so machines can bake some texels each (texel_begin
/// and texel_end of bk_bake_params, all else equal) and one of them loads all files, in any order; the light then
/// has the bits of one bake, and seams are stitched with the last texels.
///
/// path: UTF-8. progress, user: the progress callback and its pointer; progress may be NULL.
///
/// Fails with BK_ERROR_INVALID_ARGUMENT if the file is of another scene, light map or version of the library, of other
/// lights, or of another instruction set (AVX2 and AVX-512 are the same in this), and bk_last_error says which;
/// with BK_ERROR_INVALID_STATE if the file has some texels alone and the light map holds light of a bake with other
/// parameters, or another call is using the light map; with BK_ERROR_IO, naming the file, if it cannot be read, is
/// damaged, or is no result; with BK_ERROR_OUT_OF_MEMORY if it does not fit; with BK_ERROR_CANCELLED if progress says
/// so. A call that fails changes nothing.
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
            assert_eq!(half_bits(half_value(bits) as f32), bits);
        }
    }

    #[test]
    fn between_two_halves_the_nearer_is_taken_and_in_the_middle_the_even_one() {
        for bits in 0..0x7bffu16 {
            let (low, high) = (half_value(bits), half_value(bits + 1));
            let middle = ((low + high) / 2.0) as f32;
            assert_eq!(half_bits(middle), bits + (bits & 1));
            assert_eq!(half_bits(middle.next_down()), bits);
            assert_eq!(half_bits(middle.next_up()), bits + 1);
        }
    }

    #[test]
    fn halves_are_clamped_and_nan_stays() {
        assert_eq!([1e9, f32::INFINITY, -1e9].map(half_bits), [0x7bff, 0x7bff, 0xfbff]);
        assert_eq!(half_bits(f32::NAN) & 0x7fff, 0x7e00);
    }

    #[test]
    fn a_format_that_does_not_suit_the_layer_is_none() {
        assert!(encode(&LayerData::Rgb(vec![[1.0; 3]]), BK_FORMAT_R32F).is_none());
        assert!(encode(&LayerData::Integer(vec![1]), BK_FORMAT_R32F).is_none());
        let rgb = LayerData::Rgb(vec![[1.0, 0.5, 0.0]]);
        let half = encode(&rgb, BK_FORMAT_RGBA16F).unwrap();
        assert_eq!(*half, *bytemuck::cast_slice::<u16, u8>(&[0x3c00, 0x3800, 0, 0x3c00]));
    }
}
