//! Images of materials: PNG and JPEG files. An image that cannot be read is a warning, and its material has no texture:
//! a scene is useful without one of its images.

use super::Import;
use super::account::Account;
use super::source::{Attempt, Checked};
use crate::base::error::{Error, Result};
use crate::scene::{MAX_TEXTURE_SIZE, Texture};
use image::{ColorType, ImageDecoder, ImageFormat, ImageReader, Limits};
use std::path::Path;

/// Alpha below which surfaces are cut out, for formats without a cutoff of their own.
pub(super) const CUTOFF: f32 = 0.5;

/// Decodes the bytes of a file to an image whose row 0 is the top row. The memory that it takes is checked first.
pub(super) fn decode(import: &mut Import, bytes: &[u8]) -> Attempt<Texture> {
    let decoder = match open(import, bytes) {
        Ok(decoder) => decoder,
        Err(what) => return import.check().map(|()| Err(what)),
    };
    let (width, height) = decoder.dimensions();
    let wanted = 4 * u64::from(width) * u64::from(height);
    let Some(left) = import.texture_bytes_left.checked_sub(wanted) else {
        return Err(Error::OutOfMemory(format!(
            "{}: an image of {width} × {height} texels takes {wanted} bytes, more than the {} that max_texture_bytes \
             leaves",
            import.path.display(),
            import.texture_bytes_left
        )));
    };
    let texels = import.account.list::<[u8; 4]>(width as usize * height as usize, "an image")?;
    let read = rgba8(decoder, texels, &mut import.account)?;
    import.check()?;
    Ok(read.map(|rgba8| {
        import.texture_bytes_left = left;
        Texture { width, height, rgba8 }
    }))
}

/// Decodes the file that another one in `folder` names.
pub(super) fn read(import: &mut Import, folder: &Path, name: &str) -> Attempt<Texture> {
    let bytes = match import.read_named(folder, name)? {
        Ok(bytes) => bytes,
        Err(what) => return Ok(Err(what)),
    };
    let texture = decode(import, &bytes);
    import.account.give_back(bytes.capacity());
    texture
}

fn open<'b>(import: &Import<'b>, bytes: &'b [u8]) -> std::result::Result<impl ImageDecoder + use<'b>, String> {
    let reader = ImageReader::new(Checked::new(bytes, import.advance));
    let mut reader = reader.with_guessed_format().map_err(|e| e.to_string())?;
    if !matches!(reader.format(), Some(ImageFormat::Png | ImageFormat::Jpeg)) {
        return Err("it is neither PNG nor JPEG".into());
    }
    let mut limits = Limits::default();
    (limits.max_image_width, limits.max_image_height) = (Some(MAX_TEXTURE_SIZE), Some(MAX_TEXTURE_SIZE));
    reader.limits(limits);
    reader.into_decoder().map_err(|e| e.to_string())
}

/// Decodes all texels into memory that was announced. The file's own format takes as much again while it is converted.
fn rgba8(decoder: impl ImageDecoder, mut texels: Vec<[u8; 4]>, account: &mut Account) -> Attempt<Vec<[u8; 4]>> {
    let (width, height) = decoder.dimensions();
    let (color, count) = (decoder.color_type(), width as usize * height as usize);
    if color == ColorType::Rgba8 {
        texels.resize(count, [0; 4]);
        let read = decoder.read_image(texels.as_flattened_mut());
        return Ok(read.map(|()| texels).map_err(|e| e.to_string()));
    }
    let size = count * usize::from(color.bytes_per_pixel());
    let mut raw = account.list::<u8>(size, "an image")?;
    raw.resize(size, 0);
    if let Err(e) = decoder.read_image(&mut raw) {
        return Ok(Err(e.to_string()));
    }
    // 65535 is 255 times 257.
    let narrow = |c: &[u8]| ((u32::from(u16::from_ne_bytes([c[0], c[1]])) + 128) / 257) as u8;
    match color {
        ColorType::L8 => texels.extend(raw.iter().map(|&l| [l, l, l, 255])),
        ColorType::La8 => texels.extend(raw.as_chunks().0.iter().map(|&[l, a]| [l, l, l, a])),
        ColorType::Rgb8 => texels.extend(raw.as_chunks().0.iter().map(|&[r, g, b]| [r, g, b, 255])),
        ColorType::L16 => texels.extend(raw.as_chunks::<2>().0.iter().map(|l| [narrow(l), narrow(l), narrow(l), 255])),
        ColorType::La16 => {
            texels.extend(raw.as_chunks::<4>().0.iter().map(|c| [narrow(c), narrow(c), narrow(c), narrow(&c[2..])]))
        }
        ColorType::Rgb16 => {
            texels.extend(raw.as_chunks::<6>().0.iter().map(|c| [narrow(c), narrow(&c[2..]), narrow(&c[4..]), 255]))
        }
        ColorType::Rgba16 => texels.extend(
            raw.as_chunks::<8>().0.iter().map(|c| [narrow(c), narrow(&c[2..]), narrow(&c[4..]), narrow(&c[6..])]),
        ),
        other => return Ok(Err(format!("its colours are {other:?}"))),
    }
    account.give_back(size);
    Ok(Ok(texels))
}

/// Takes alpha from a second image: its alpha or, where that is opaque all over, its first channel. Where sizes
/// differ, the nearest texel counts; without colours all are white.
pub(super) fn with_alpha(color: Option<Texture>, alpha: &Texture, account: &mut Account) -> Result<Texture> {
    let channel = if is_opaque(alpha) { 0 } else { 3 };
    let mut out = match color {
        Some(color) => color,
        None => {
            let mut rgba8 = account.list(alpha.rgba8.len(), "an image")?;
            rgba8.resize(alpha.rgba8.len(), [255; 4]);
            Texture { width: alpha.width, height: alpha.height, rgba8 }
        }
    };
    let nearest = |i: usize, size: u32, of: u32| (2 * i + 1) * of as usize / (2 * size as usize);
    let (width, height) = (out.width, out.height);
    for (i, texel) in out.rgba8.iter_mut().enumerate() {
        let x = nearest(i % width as usize, width, alpha.width);
        let y = nearest(i / width as usize, height, alpha.height);
        texel[3] = alpha.rgba8[y * alpha.width as usize + x][channel];
    }
    Ok(out)
}

pub(super) fn is_opaque(texture: &Texture) -> bool {
    texture.rgba8.iter().all(|t| t[3] == 255)
}

/// Turns an image upside down, for formats that have v = 0 at the bottom.
pub(super) fn flipped(mut texture: Texture) -> Texture {
    let (width, rows) = (texture.width as usize, texture.height as usize);
    let (top, bottom) = texture.rgba8.split_at_mut(width * (rows / 2));
    for (a, b) in top.chunks_exact_mut(width).zip(bottom.chunks_exact_mut(width).rev()) {
        a.swap_with_slice(b);
    }
    texture
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::base::memory::MemoryMonitor;
    use crate::io::LoadOptions;
    use crate::io::source::{Advance, Files};
    use image::codecs::jpeg::JpegEncoder;
    use image::codecs::png::PngEncoder;
    use image::{ExtendedColorType, ImageEncoder};
    use std::sync::Arc;
    use std::sync::atomic::{AtomicI64, Ordering::Relaxed};

    /// A PNG file of RGBA texels.
    pub fn png(width: u32, height: u32, rgba8: &[[u8; 4]]) -> Vec<u8> {
        let mut file = Vec::new();
        let bytes = rgba8.as_flattened();
        PngEncoder::new(&mut file).write_image(bytes, width, height, ExtendedColorType::Rgba8).unwrap();
        file
    }

    fn import<'a>(options: &LoadOptions, advance: Advance<'a>) -> Import<'a> {
        let path = Path::new("a.obj");
        Import::new(path, options, Files::new(path, options).unwrap(), advance).unwrap()
    }

    /// Decodes with these limits.
    fn decode_with(options: &LoadOptions, bytes: &[u8]) -> Attempt<Texture> {
        let advance = |_| Ok(());
        let mut import = import(options, &advance);
        super::decode(&mut import, bytes)
    }

    fn decode(bytes: &[u8]) -> std::result::Result<Texture, String> {
        decode_with(&LoadOptions::default(), bytes).unwrap()
    }

    #[test]
    fn every_kind_of_png_gives_what_the_image_crate_makes_of_it() {
        for (color, size) in [
            (ExtendedColorType::L8, 1),
            (ExtendedColorType::La8, 2),
            (ExtendedColorType::Rgb8, 3),
            (ExtendedColorType::Rgba8, 4),
            (ExtendedColorType::L16, 2),
            (ExtendedColorType::La16, 4),
            (ExtendedColorType::Rgb16, 6),
            (ExtendedColorType::Rgba16, 8),
        ] {
            let bytes: Vec<u8> = (0..50 * 30 * size).map(|i| (i * i / 7) as u8).collect();
            let mut file = Vec::new();
            PngEncoder::new(&mut file).write_image(&bytes, 50, 30, color).unwrap();
            let theirs = image::load_from_memory(&file).unwrap().into_rgba8().into_raw();
            assert_eq!(decode(&file).unwrap().rgba8.as_flattened(), theirs, "{color:?}");
        }
    }

    #[test]
    fn an_image_beyond_the_limit_is_refused_before_it_is_decoded() {
        // A header that promises 16384 × 16384 texels, and little behind it.
        let mut file = Vec::new();
        PngEncoder::new(&mut file).write_image(&[0; 4], 2, 2, ExtendedColorType::L8).unwrap();
        let header = file.windows(4).position(|w| w == b"IHDR").unwrap();
        file[header + 4..header + 12].copy_from_slice(&[0, 0, 0x40, 0, 0, 0, 0x40, 0]);
        let mut crc = !0u32;
        for byte in &file[header..header + 17] {
            crc ^= u32::from(*byte);
            (0..8).for_each(|_| crc = (crc >> 1) ^ (0xedb8_8320 * (crc & 1)));
        }
        file[header + 17..header + 21].copy_from_slice(&(!crc).to_be_bytes());
        let asked = Arc::new(AtomicI64::new(0));
        let largest = asked.clone();
        let monitor = move |bytes| {
            largest.fetch_max(bytes, Relaxed);
            true
        };
        let memory = Arc::new(MemoryMonitor::new(Some(Box::new(monitor))));
        let options = LoadOptions { max_texture_bytes: 1 << 28, memory: memory.clone(), ..Default::default() };
        let Err(Error::OutOfMemory(e)) = decode_with(&options, &file) else { panic!("decoded") };
        assert!(e.contains("16384 × 16384") && e.contains("max_texture_bytes"), "{e}");
        assert_eq!((asked.load(Relaxed), memory.current()), (0, 0));
        // The limit is one on the sum.
        let small = png(2, 1, &[[9; 4]; 2]);
        let advance = |_| Ok(());
        let options = LoadOptions { max_texture_bytes: 12, ..Default::default() };
        let mut import = import(&options, &advance);
        assert!(super::decode(&mut import, &small).unwrap().is_ok());
        assert!(matches!(super::decode(&mut import, &small), Err(Error::OutOfMemory(_))));
    }

    #[test]
    fn a_large_image_can_be_cancelled_while_it_is_decoded() {
        let file = png(1000, 1000, &vec![[1, 2, 3, 4]; 1_000_000]);
        let calls = std::cell::Cell::new(0);
        let advance = |_| {
            calls.set(calls.get() + 1);
            if calls.get() > 2 { Err(Error::Cancelled) } else { Ok(()) }
        };
        let mut import = import(&LoadOptions::default(), &advance);
        assert_eq!(super::decode(&mut import, &file).err(), Some(Error::Cancelled));
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
        let mut account = Account::new(&Arc::default()).unwrap();
        let both = with_alpha(Some(color), &mask, &mut account).unwrap();
        let alphas: Vec<u8> = both.rgba8.iter().map(|t| t[3]).collect();
        assert_eq!((alphas, &both.rgba8[0][..3]), (vec![10, 10, 250, 250, 10, 10, 250, 250], &[1, 2, 3][..]));
        let mask = Texture { width: 2, height: 1, rgba8: vec![[9, 9, 9, 77], [9, 9, 9, 255]] };
        assert_eq!(with_alpha(None, &mask, &mut account).unwrap().rgba8, [[255, 255, 255, 77], [255; 4]]);
    }
}
