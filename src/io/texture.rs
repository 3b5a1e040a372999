//! Images of materials: PNG and JPEG files. What is wrong with one is told as a warning, and its material does
//! without: a scene is worth having without an image.

use crate::scene::{MAX_TEXTURE_SIZE, Texture};
use image::{DynamicImage, ImageFormat, ImageReader, Limits};
use std::io::Cursor;
use std::path::Path;

/// Alpha below which surfaces of formats that know no cutoff are holes.
pub(super) const CUTOFF: f32 = 0.5;

/// An image from the bytes of a file, row 0 being its top row.
pub(super) fn decode(bytes: &[u8]) -> Result<Texture, String> {
    let image = open(bytes)?.into_rgba8();
    let (width, height) = image.dimensions();
    Ok(Texture { width, height, rgba8: image.into_raw().as_chunks::<4>().0.to_vec() })
}

/// The same of a file by its name.
pub(super) fn read(path: &Path) -> Result<Texture, String> {
    decode(&std::fs::read(path).map_err(|e| e.to_string())?)
}

fn open(bytes: &[u8]) -> Result<DynamicImage, String> {
    let mut reader = ImageReader::new(Cursor::new(bytes)).with_guessed_format().map_err(|e| e.to_string())?;
    if !matches!(reader.format(), Some(ImageFormat::Png | ImageFormat::Jpeg)) {
        return Err("it is neither PNG nor JPEG".into());
    }
    let mut limits = Limits::default();
    (limits.max_image_width, limits.max_image_height) = (Some(MAX_TEXTURE_SIZE), Some(MAX_TEXTURE_SIZE));
    reader.limits(limits);
    reader.decode().map_err(|e| e.to_string())
}

/// Alpha from an image of its own: its alpha or, where that is opaque all over, its first channel. Where sizes
/// differ, the nearest texel counts; without colours all are white.
pub(super) fn with_alpha(color: Option<Texture>, alpha: &Texture) -> Texture {
    let channel = if is_opaque(alpha) { 0 } else { 3 };
    let mut out = color.unwrap_or_else(|| Texture {
        width: alpha.width,
        height: alpha.height,
        rgba8: vec![[255; 4]; alpha.rgba8.len()],
    });
    let nearest = |i: usize, size: u32, of: u32| (2 * i + 1) * of as usize / (2 * size as usize);
    let (width, height) = (out.width, out.height);
    for (i, texel) in out.rgba8.iter_mut().enumerate() {
        let x = nearest(i % width as usize, width, alpha.width);
        let y = nearest(i / width as usize, height, alpha.height);
        texel[3] = alpha.rgba8[y * alpha.width as usize + x][channel];
    }
    out
}

pub(super) fn is_opaque(texture: &Texture) -> bool {
    texture.rgba8.iter().all(|t| t[3] == 255)
}

/// Turned upside down, for formats that have v = 0 at the bottom.
pub(super) fn flipped(mut texture: Texture) -> Texture {
    let width = texture.width as usize;
    let rows = texture.rgba8.chunks_exact(width).rev();
    texture.rgba8 = rows.flatten().copied().collect();
    texture
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use image::codecs::jpeg::JpegEncoder;
    use image::codecs::png::PngEncoder;
    use image::{ExtendedColorType, ImageEncoder};

    /// A PNG file of RGBA texels.
    pub fn png(width: u32, height: u32, rgba8: &[[u8; 4]]) -> Vec<u8> {
        let mut file = Vec::new();
        let bytes = rgba8.as_flattened();
        PngEncoder::new(&mut file).write_image(bytes, width, height, ExtendedColorType::Rgba8).unwrap();
        file
    }

    #[test]
    fn png_and_jpeg_are_read_and_others_refused() {
        let texels = [[1, 2, 3, 4], [5, 6, 7, 8]];
        let read = decode(&png(1, 2, &texels)).unwrap();
        assert_eq!((read.width, read.height, &read.rgba8[..]), (1, 2, &texels[..]));
        assert_eq!(flipped(read).rgba8, [texels[1], texels[0]]);
        let mut file = Vec::new();
        JpegEncoder::new_with_quality(&mut file, 100)
            .write_image(&[200; 8 * 8 * 3], 8, 8, ExtendedColorType::Rgb8)
            .unwrap();
        let read = decode(&file).unwrap();
        assert_eq!((read.width, read.height), (8, 8));
        assert!(read.rgba8.iter().all(|t| t[..3].iter().all(|c| c.abs_diff(200) < 3) && t[3] == 255));
        for bad in [&b"GIF89a"[..], b"", &file[..100], &png(1, 2, &texels)[..40]] {
            assert!(decode(bad).is_err());
        }
    }

    #[test]
    fn alpha_comes_from_its_own_image_at_any_size() {
        let grey = |v: u8| [v, v, v, 255];
        let mask = Texture { width: 2, height: 1, rgba8: vec![grey(10), grey(250)] };
        let color = Texture { width: 4, height: 2, rgba8: vec![[1, 2, 3, 255]; 8] };
        let both = with_alpha(Some(color), &mask);
        let alphas: Vec<u8> = both.rgba8.iter().map(|t| t[3]).collect();
        assert_eq!((alphas, &both.rgba8[0][..3]), (vec![10, 10, 250, 250, 10, 10, 250, 250], &[1, 2, 3][..]));
        let mask = Texture { width: 2, height: 1, rgba8: vec![[9, 9, 9, 77], [9, 9, 9, 255]] };
        assert_eq!(with_alpha(None, &mask).rgba8, [[255, 255, 255, 77], [255; 4]]);
    }
}
