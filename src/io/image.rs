//! Image files: OpenEXR for values, PNG for looking at, and the tone mapping between them; skies from
//! OpenEXR and Radiance HDR files.
//!
//! Rows are written in the order in which they are given, nothing is flipped: row 0 of a light map
//! page is v = 0 and becomes the top row of the file, which is where glTF and Vulkan have v = 0.
//! (OpenGL tools that expect v = 0 at the bottom show such files upside down.)

use super::source::{Advance, place};
use crate::base::error::{Error, Result, invalid_argument};
use crate::base::files;
use crate::base::memory::try_collect;
use crate::scene::{Environment, MAX_COORDINATE, MAX_ENVIRONMENT_SIZE};
use image::ExtendedColorType::Rgb32F;
use image::codecs::openexr::OpenExrEncoder;
use image::{ImageEncoder, ImageFormat};
use png::ColorType;
use std::io::{self, Cursor, Seek, SeekFrom, Write};
use std::path::Path;

/// Writes linear RGB values as an OpenEXR file of 32-bit floats.
pub fn write_exr(path: &Path, width: u32, height: u32, pixels: &[[f32; 3]]) -> Result<()> {
    write_exr_with(path, width, height, pixels, &|_| Ok(()))
}

/// Same as [`write_exr`]; `advance` is called often and ends the call by an error.
pub(super) fn write_exr_with(
    path: &Path,
    width: u32,
    height: u32,
    pixels: &[[f32; 3]],
    advance: Advance,
) -> Result<()> {
    check_size(width, height, pixels.len())?;
    let mut file = Encoded::new(advance);
    let written = OpenExrEncoder::new(&mut file).write_image(bytemuck::cast_slice(pixels), width, height, Rgb32F);
    let bytes = file.finish(written.map_err(|e| fail(path, e)))?;
    files::replace(path, |file| file.append(&bytes, |_| advance(0)))
}

/// A file in memory that an encoder writes to. Writing fails where there is no memory, and once the caller has asked
/// to stop.
struct Encoded<'a> {
    bytes: Vec<u8>,
    at: usize,
    advance: Advance<'a>,
    error: Option<Error>,
}

impl<'a> Encoded<'a> {
    fn new(advance: Advance<'a>) -> Self {
        Encoded { bytes: Vec::new(), at: 0, advance, error: None }
    }

    /// The file, or the error of the writer, which encoders do not pass on.
    fn finish(self, written: Result<()>) -> Result<Vec<u8>> {
        match self.error {
            Some(own) => Err(own),
            None => written.map(|()| self.bytes),
        }
    }

    fn make_room(&mut self, end: usize) -> Result<()> {
        (self.advance)(0)?;
        let more = end.saturating_sub(self.bytes.len());
        self.bytes.try_reserve(more).map_err(|_| Error::OutOfMemory(format!("an image file needs {end} bytes")))?;
        self.bytes.resize(self.bytes.len() + more, 0);
        Ok(())
    }
}

impl Write for Encoded<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let end = self.at + bytes.len();
        if let Err(e) = self.make_room(end) {
            self.error = Some(e);
            return Err(io::Error::other("the image cannot be written"));
        }
        self.bytes[self.at..end].copy_from_slice(bytes);
        self.at = end;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Seek for Encoded<'_> {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.at = place(to, self.at, self.bytes.len())?;
        Ok(self.at as u64)
    }
}

/// Most bytes of a sky as it is decoded: 8192 × 4096 texels of four floats.
const MAX_ENVIRONMENT_BYTES: u64 = 512 << 20;

/// Reads the image of a sky from an OpenEXR or Radiance HDR file, in linear RGB. Negative values and those
/// that are not numbers, which cameras and filters leave in such files, become 0; too large ones the largest.
pub fn read_environment(path: &Path) -> Result<Environment> {
    // A texel of 4 bytes at least.
    let bytes = files::read(path, 4 * (MAX_ENVIRONMENT_SIZE as u64).pow(2))?;
    let reader = image::ImageReader::new(Cursor::new(&bytes)).with_guessed_format();
    let mut reader = reader.map_err(|e| fail(path, e))?;
    let mut limits = image::Limits::default();
    (limits.max_image_width, limits.max_image_height) = (Some(MAX_ENVIRONMENT_SIZE), Some(MAX_ENVIRONMENT_SIZE));
    limits.max_alloc = Some(MAX_ENVIRONMENT_BYTES);
    reader.limits(limits);
    match reader.format() {
        Some(ImageFormat::Hdr | ImageFormat::OpenExr) => {}
        _ => return Err(fail(path, "neither an OpenEXR nor a Radiance HDR file")),
    }
    let image = reader.decode().map_err(|e| fail(path, e))?.into_rgb32f();
    let (width, height) = image.dimensions();
    let value = |c: f32| if c > 0.0 { c.min(MAX_COORDINATE) } else { 0.0 };
    let rgb = try_collect(image.pixels().map(|p| p.0.map(value)), "the image of a sky")?;
    Environment::new(width, height, rgb).map_err(|e| fail(path, e))
}

/// Writes single values as an OpenEXR file of 32-bit floats, the same in R, G and B.
pub fn write_exr_grey(path: &Path, width: u32, height: u32, pixels: &[f32]) -> Result<()> {
    write_exr(path, width, height, &try_collect(pixels.iter().map(|&v| [v; 3]), "an image")?)
}

/// Writes sRGB colours as a PNG file.
pub fn write_png_rgb8(path: &Path, width: u32, height: u32, pixels: &[[u8; 3]]) -> Result<()> {
    write_png_with(path, width, height, pixels, &|_| Ok(()))
}

/// Same as [`write_png_rgb8`]; `advance` is called often and ends the call by an error.
pub(super) fn write_png_with(path: &Path, width: u32, height: u32, pixels: &[[u8; 3]], advance: Advance) -> Result<()> {
    let file = encode_png(width, height, pixels, ColorType::Rgb, advance)?;
    files::replace(path, |new| new.append(&file, |_| advance(0)))
}

/// Writes grey values as a PNG file.
pub fn write_png_grey8(path: &Path, width: u32, height: u32, pixels: &[u8]) -> Result<()> {
    let pixels: &[[u8; 1]] = bytemuck::cast_slice(pixels);
    files::replace_with(path, &encode_png(width, height, pixels, ColorType::Grayscale, &|_| Ok(()))?)
}

/// The bytes of a PNG file of sRGB colours.
pub fn encode_png_rgb8(width: u32, height: u32, pixels: &[[u8; 3]]) -> Result<Vec<u8>> {
    encode_png(width, height, pixels, ColorType::Rgb, &|_| Ok(()))
}

/// The bytes of a PNG file of colours of `N` channels. `advance` is called with every few rows and ends the call by an
/// error.
pub(super) fn encode_png<const N: usize>(
    width: u32,
    height: u32,
    pixels: &[[u8; N]],
    color: ColorType,
    advance: Advance,
) -> Result<Vec<u8>> {
    check_size(width, height, pixels.len())?;
    let mut file = Encoded::new(advance);
    let written = write_rows(&mut file, width, height, pixels.as_flattened(), color, advance);
    file.finish(written)
}

/// Bytes of an image between two looks for a cancel: they are filtered and compressed in some milliseconds.
const ROWS: usize = 64 << 10;

fn write_rows(
    file: &mut Encoded,
    width: u32,
    height: u32,
    bytes: &[u8],
    color: ColorType,
    advance: Advance,
) -> Result<()> {
    let fail = |e: &dyn std::fmt::Display| Error::Io(format!("encoding a PNG: {e}"));
    let mut encoder = png::Encoder::new(file, width, height);
    encoder.set_color(color);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_compression(png::Compression::Balanced);
    encoder.set_filter(png::Filter::Adaptive);
    let mut header = encoder.write_header().map_err(|e| fail(&e))?;
    let mut rows = header.stream_writer().map_err(|e| fail(&e))?;
    for part in bytes.chunks(ROWS) {
        advance(0)?;
        rows.write_all(part).map_err(|e| fail(&e))?;
    }
    rows.finish().map_err(|e| fail(&e))?;
    header.finish().map_err(|e| fail(&e))
}

fn check_size(width: u32, height: u32, pixels: usize) -> Result<()> {
    if pixels == 0 || width as u64 * height as u64 != pixels as u64 {
        return invalid_argument!("an image of {width} × {height} pixels is given by {pixels} values");
    }
    Ok(())
}

fn fail(path: &Path, e: impl std::fmt::Display) -> Error {
    Error::Io(format!("{}: {e}", path.display()))
}

/// Where [`tone_map`] starts to bend, in units of white.
const SHOULDER: f32 = 0.6;

/// Linear radiance or irradiance to an sRGB colour: times `exposure`, then a curve that is linear up
/// to `SHOULDER` and from there approaches 1 exponentially, without a kink, then the sRGB transfer
/// function. The curve works on the largest channel and the others follow in proportion, so hue and
/// saturation stay. Values that are negative or not numbers count as 0.
pub fn tone_map(exposure: f32, rgb: [f32; 3]) -> [u8; 3] {
    let exposed = rgb.map(|c| (c * exposure).clamp(0.0, 1e30)).map(|c| if c.is_nan() { 0.0 } else { c });
    let largest = exposed.iter().fold(0.0f32, |a, &c| a.max(c));
    let scale = if largest > SHOULDER {
        let room = 1.0 - SHOULDER;
        (SHOULDER + room * (1.0 - (-(largest - SHOULDER) / room).exp())) / largest
    } else {
        1.0
    };
    exposed.map(|c| (srgb_from_linear(c * scale) * 255.0).round() as u8)
}

/// The sRGB transfer function (IEC 61966-2-1), [0, 1] to [0, 1].
pub fn srgb_from_linear(c: f32) -> f32 {
    if c <= 0.003_130_8 { 12.92 * c } else { 1.055 * c.powf(1.0 / 2.4) - 0.055 }
}

/// Luminance of linear RGB (Rec. 709 primaries).
pub fn luminance([r, g, b]: [f32; 3]) -> f32 {
    0.2126 * r + 0.7152 * g + 0.0722 * b
}

/// The percentile of luminance that automatic exposure shows at [`SHOULDER`]: a tenth of what is
/// lit, typically patches of sun, goes into the bend.
const EXPOSURE_PERCENTILE: f64 = 0.9;

/// An exposure for [`tone_map`]: it brings the 90th percentile of the luminance to 0.6 of white. Only
/// pixels that `mask` includes by their number count, and of those only lit, finite ones; 1 if there
/// are none.
pub fn auto_exposure(pixels: &[[f32; 3]], mask: impl Fn(usize) -> bool) -> f32 {
    let included = pixels.iter().enumerate().filter(|(i, _)| mask(*i));
    exposure_of(&mut included.map(|(_, p)| luminance(*p)).collect())
}

/// [`auto_exposure`] from luminances, of which those that are not lit or not finite are removed.
pub(super) fn exposure_of(lit: &mut Vec<f32>) -> f32 {
    lit.retain(|l| *l > 0.0 && l.is_finite());
    if lit.is_empty() {
        return 1.0;
    }
    let rank = ((lit.len() - 1) as f64 * EXPOSURE_PERCENTILE) as usize;
    let (_, percentile, _) = lit.select_nth_unstable_by(rank, f32::total_cmp);
    (SHOULDER / *percentile).clamp(f32::MIN_POSITIVE, f32::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::tests::Folder;

    #[test]
    fn exr_files_keep_every_bit_and_row_order() {
        let folder = Folder::new();
        let path = folder.path("a.exr");
        let pixels = [[0.0, 1e-20, 1e20], [1.0, 2.5, -3.0], [0.1, 0.2, 0.3], [f32::MAX, 7.0, 8.0], [4.0; 3], [5.0; 3]];
        write_exr(&path, 2, 3, &pixels).unwrap();
        let back = image::open(&path).unwrap().into_rgb32f();
        assert_eq!(back.dimensions(), (2, 3));
        assert_eq!(back.as_raw()[..], *pixels.as_flattened());
        write_exr_grey(&path, 3, 1, &[1.0, 0.5, 0.25]).unwrap();
        assert_eq!(image::open(&path).unwrap().into_rgb32f().as_raw()[3..6], [0.5; 3]);
    }

    #[test]
    fn skies_are_read_from_exr_and_hdr_files_and_from_nothing_else() {
        let folder = Folder::new();
        let exr = folder.path("sky.exr");
        write_exr(&exr, 2, 1, &[[1.5, -2.0, f32::NAN], [3.0, f32::INFINITY, 0.25]]).unwrap();
        let sky = read_environment(&exr).unwrap();
        assert_eq!((sky.size(), sky.rgb()), ((2, 1), &[[1.5, 0.0, 0.0], [3.0, MAX_COORDINATE, 0.25]][..]));
        let hdr = folder.path("sky.hdr");
        let file = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 2\n\x80\x40\x00\x81\x00\x00\x00\x00";
        std::fs::write(&hdr, file).unwrap();
        assert_eq!(read_environment(&hdr).unwrap().rgb(), [[1.0, 0.5, 0.0], [0.0; 3]]);
        let png = folder.path("sky.png");
        write_png_rgb8(&png, 1, 1, &[[9; 3]]).unwrap();
        for path in [png, folder.path("no.exr")] {
            assert!(
                matches!(read_environment(&path), Err(Error::Io(m)) if m.contains("sky.png") || m.contains("no.exr"))
            );
        }
    }

    #[test]
    fn png_files_keep_colors_and_row_order() {
        let folder = Folder::new();
        let path = folder.path("a.png");
        let pixels = [[0, 1, 2], [255, 254, 253], [9, 8, 7], [100, 50, 25]];
        write_png_rgb8(&path, 1, 4, &pixels).unwrap();
        let back = image::open(&path).unwrap().into_rgb8();
        assert_eq!(back.dimensions(), (1, 4));
        assert_eq!(back.as_raw()[..], *pixels.as_flattened());
        write_png_grey8(&path, 2, 1, &[3, 200]).unwrap();
        assert_eq!(image::open(&path).unwrap().into_luma8().as_raw()[..], [3, 200]);
    }

    #[test]
    fn encoding_ends_soon_after_a_cancel() {
        let pixels: Vec<[u8; 3]> =
            (0..1u32 << 20).map(|i| i.wrapping_mul(0x9e37_79b9).to_le_bytes()).map(|b| [b[0], b[1], b[2]]).collect();
        let folder = Folder::new();
        let calls = std::cell::Cell::new(0);
        let advance = |_| {
            calls.set(calls.get() + 1);
            if calls.get() > 5 { Err(Error::Cancelled) } else { Ok(()) }
        };
        let png = encode_png(1 << 10, 1 << 10, &pixels, ColorType::Rgb, &advance);
        assert_eq!((png, calls.get() < 10), (Err(Error::Cancelled), true));
        calls.set(0);
        let values = vec![[0.5; 3]; 1 << 20];
        let exr = write_exr_with(&folder.path("a.exr"), 1 << 10, 1 << 10, &values, &advance);
        assert_eq!((exr, calls.get() < 10, folder.path("a.exr").exists()), (Err(Error::Cancelled), true, false));
    }

    #[test]
    fn wrong_sizes_and_places_are_errors() {
        let folder = Folder::new();
        let e = write_png_rgb8(&folder.path("a.png"), 2, 2, &[[0; 3]; 3]).unwrap_err();
        assert_eq!(e, Error::InvalidArgument("an image of 2 × 2 pixels is given by 3 values".into()));
        assert!(matches!(write_exr(&folder.path("a.exr"), 0, 5, &[]), Err(Error::InvalidArgument(_))));
        let nowhere = folder.path("no/a.exr");
        let Err(Error::Io(message)) = write_exr(&nowhere, 1, 1, &[[1.0; 3]]) else { panic!("written") };
        assert!(message.contains("a.exr"), "{message}");
    }

    #[test]
    fn the_curve_is_srgb_below_the_shoulder_and_monotonic_above() {
        assert_eq!(tone_map(1.0, [0.0; 3]), [0; 3]);
        // ((128/255 + 0.055) / 1.055)^2.4 = 0.21586.
        assert_eq!(tone_map(2.0, [0.10793; 3]), [128; 3]);
        let levels: Vec<u8> = (0..1000).map(|i| tone_map(1.0, [i as f32 * 0.01; 3])[0]).collect();
        assert!(levels.is_sorted());
        assert_eq!(levels[999], 255);
        assert!(levels[100] < 250, "white is reached only far above 1");
        for odd in [f32::NAN, -1.0, f32::NEG_INFINITY] {
            assert_eq!(tone_map(1.0, [odd; 3]), [0; 3]);
        }
        assert_eq!(tone_map(1.0, [f32::INFINITY; 3]), [255; 3]);
    }

    #[test]
    fn the_shoulder_keeps_the_hue() {
        let linear = |c: u8| {
            let c = c as f64 / 255.0;
            if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }
        };
        let [r, g, b] = tone_map(1.0, [8.0, 4.0, 2.0]).map(linear);
        assert!((g / r - 0.5).abs() < 0.01 && (b / r - 0.25).abs() < 0.01, "{r} {g} {b}");
    }

    #[test]
    fn automatic_exposure_follows_the_light_and_the_mask() {
        let mut pixels = vec![[2.0; 3]; 100];
        pixels.extend([[f32::NAN; 3], [0.0; 3], [-1.0; 3], [f32::INFINITY; 3]]);
        pixels.extend([[1000.0; 3]; 100]);
        let exposure = auto_exposure(&pixels, |i| i < 104);
        assert!((exposure - 0.3).abs() < 1e-6, "{exposure}");
        assert!((auto_exposure(&pixels, |i| i >= 104) - 0.0006).abs() < 1e-9);
        assert_eq!(auto_exposure(&pixels, |_| false), 1.0);
        // A few bright pixels change nothing.
        assert_eq!(auto_exposure(&pixels, |i| i < 109), exposure);
    }
}
