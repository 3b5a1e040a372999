//! Pages as OpenEXR files: ZIP, floats or half floats, and attributes that say what the values are.

use crate::args::NamedLayer;
use bakelite::lightmap::{LayerData, Lightmap};
use bakelite::{Error, Result};
use exr::image::write::channels::WritableChannels;
use exr::meta::attribute::{AttributeValue, Text};
use exr::prelude::{Encoding, Image, Layer, LayerAttributes, SpecificChannels, Vec2, WritableImage, f16};
use std::io::Cursor;

/// Encodes a page. Attributes: `units`, `page` (from 0), `pages`, `seed`, `texelsPerUnit`, and `software` with the
/// version.
pub fn encode(
    lightmap: &Lightmap,
    page: u32,
    layer: &NamedLayer,
    values: &LayerData,
    half: bool,
    seed: u64,
) -> Result<Vec<u8>> {
    let info = lightmap.info();
    let mut attributes = LayerAttributes::named(layer.name);
    attributes.software_name = Some(Text::from(concat!("bakelite ", env!("CARGO_PKG_VERSION"))));
    let text = |text: &str| AttributeValue::Text(Text::from(text));
    attributes.other.extend([
        ("page".into(), AttributeValue::I32(page as i32)),
        ("pages".into(), AttributeValue::I32(info.page_count as i32)),
        // There are no integers of 64 bits.
        ("seed".into(), text(&seed.to_string())),
        ("texelsPerUnit".into(), AttributeValue::F32(info.texels_per_unit)),
    ]);
    if !layer.unit.is_empty() {
        attributes.other.insert("units".into(), text(layer.unit));
    }
    let size = Vec2(info.width as usize, info.height as usize);
    let at = |p: Vec2<usize>| p.1 * size.0 + p.0;
    match values {
        LayerData::Rgb(v) if half => {
            let pixel = |p| v[at(p)].map(nearest_half);
            write(&image(attributes, size, SpecificChannels::rgb(|p| <(f16, f16, f16)>::from(pixel(p)))))
        }
        LayerData::Rgb(v) => {
            write(&image(attributes, size, SpecificChannels::rgb(|p| <(f32, f32, f32)>::from(v[at(p)]))))
        }
        LayerData::Scalar(v) => {
            let channels = SpecificChannels::build().with_channel("Y").with_pixel_fn(|p| (v[at(p)],));
            write(&image(attributes, size, channels))
        }
        LayerData::Integer(_) => Err(Error::Internal(format!("the layer {} is of integers", layer.name))),
    }
}

/// What is too large becomes the largest half.
fn nearest_half(x: f32) -> f16 {
    f16::from_f32(x.clamp(f16::MIN.to_f32(), f16::MAX.to_f32()))
}

fn image<'c, C: WritableChannels<'c> + 'c>(
    attributes: LayerAttributes,
    size: Vec2<usize>,
    channels: C,
) -> Image<Layer<C>> {
    Image::from_layer(Layer::new(size, attributes, Encoding::SMALL_LOSSLESS, channels))
}

fn write<'i, C: WritableChannels<'i>>(image: &'i Image<Layer<C>>) -> Result<Vec<u8>> {
    let mut file = Cursor::new(Vec::new());
    // Pages are written side by side.
    let written = image.write().non_parallel().to_buffered(&mut file);
    written.map_err(|e| Error::Io(format!("encoding an EXR: {e}")))?;
    let mut file = file.into_inner();
    sort_attributes(&mut file);
    Ok(file)
}

/// Sorts the attributes of a file's header by name. `exr` keeps them in a hash map and writes them in any order; equal
/// bakes shall make equal files.
fn sort_attributes(file: &mut [u8]) {
    // Magic number and version.
    const BEGIN: usize = 8;
    let mut attributes: Vec<Vec<u8>> = Vec::new();
    let mut at = BEGIN;
    // Each is a name, a type, both with a zero at the end, the number of bytes, and these; an empty name ends the
    // header.
    while file.get(at).is_some_and(|&byte| byte != 0) {
        let end_of_text = |from: usize| file[from..].iter().position(|&byte| byte == 0).map(|n| from + n + 1);
        let Some(size_at) = end_of_text(at).and_then(end_of_text) else { return };
        let Some(size) = file.get(size_at..size_at + 4) else { return };
        let end = size_at + 4 + u32::from_le_bytes([size[0], size[1], size[2], size[3]]) as usize;
        let Some(attribute) = file.get(at..end) else { return };
        attributes.push(attribute.to_vec());
        at = end;
    }
    attributes.sort();
    file[BEGIN..at].copy_from_slice(&attributes.concat());
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::args::{BakeArgs, LAYERS};
    use crate::job::Job;
    use bakelite::lightmap::LightmapDesc;
    use exr::prelude::{MetaData, read_first_flat_layer_from_file};

    #[test]
    fn files_hold_the_values_and_say_what_they_are() {
        let desc = LightmapDesc { page_size: 64, ..Default::default() };
        let args = BakeArgs { scene: "cornell".into(), desc, quiet: true, ..Default::default() };
        let map = Job::new(&args).unbaked().unwrap();
        let info = map.info();
        let position = LAYERS.iter().find(|l| l.name == "position").unwrap();
        let values = map.read(0, position.layer).unwrap();
        let LayerData::Rgb(expected) = &values else { panic!() };
        let folder = std::env::temp_dir().join(format!("bakelite-exr-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let path = folder.join("a.exr");
        for half in [false, true] {
            let seed = u64::MAX;
            let file = encode(&map, 0, position, &values, half, seed).unwrap();
            // (Of five attributes in a hash map, ten in the same order would be chance.)
            for _ in 0..10 {
                assert!(encode(&map, 0, position, &values, half, seed).unwrap() == file, "files of one page differ");
            }
            std::fs::write(&path, file).unwrap();
            let meta = MetaData::read_from_file(&path, true).unwrap();
            let header = &meta.headers[0];
            assert_eq!(header.compression, exr::prelude::Compression::ZIP16);
            let own = &header.own_attributes;
            assert_eq!(own.software_name, Some(format!("bakelite {}", env!("CARGO_PKG_VERSION")).as_str().into()));
            let text = |t: &str| Some(AttributeValue::Text(t.into()));
            let attribute = |name: &str| own.other.get(&Text::from(name)).cloned();
            assert_eq!((attribute("units"), attribute("seed")), (text("scene units"), text("18446744073709551615")));
            assert_eq!(attribute("page"), Some(AttributeValue::I32(0)));
            assert_eq!(attribute("pages"), Some(AttributeValue::I32(info.page_count as i32)));
            assert_eq!(attribute("texelsPerUnit"), Some(AttributeValue::F32(info.texels_per_unit)));
            let layer = read_first_flat_layer_from_file(&path).unwrap().layer_data;
            assert_eq!(layer.size, Vec2(info.width as usize, info.height as usize));
            // Channels are sorted by name: B, G, R.
            for (channel, c) in layer.channel_data.list.iter().zip([2, 1, 0]) {
                for (got, e) in channel.sample_data.values_as_f32().zip(expected) {
                    let e = if half { f16::from_f32(e[c]).to_f32() } else { e[c] };
                    assert_eq!(got.to_bits(), e.to_bits());
                }
            }
        }
        std::fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn halves_are_clamped() {
        assert_eq!([1e9, -1e9, f32::INFINITY].map(nearest_half), [f16::MAX, f16::MIN, f16::MAX]);
    }
}
