//! Small files of every kind that is read, made by code: where fuzzing starts.

use image::codecs::hdr::HdrEncoder;
use image::codecs::jpeg::JpegEncoder;
use image::codecs::openexr::OpenExrEncoder;
use image::codecs::png::PngEncoder;
use image::{ExtendedColorType as Color, ImageEncoder, Rgb};
use std::io::Cursor;

/// The targets: kinds of files.
pub const TARGETS: [&str; 14] = [
    "obj",
    "mtl",
    "ply",
    "gltf",
    "glb",
    "png",
    "jpeg",
    "hdr",
    "exr",
    "scene_file",
    "saved_result",
    "checkpoint",
    "live_restore",
    "share",
];

/// Valid files, each with its target, and changes to saved ones.
pub fn seeds() -> Vec<(&'static str, Vec<u8>)> {
    let mut all: Vec<(&str, Vec<u8>)> = Vec::new();
    all.extend(OBJ.map(|text| ("obj", text.into())));
    all.extend(MTL.map(|text| ("mtl", text.into())));
    all.extend([("ply", ascii_ply()), ("ply", binary_ply(true)), ("ply", binary_ply(false))]);
    let (root, binary) = gltf_parts();
    let uri = format!(
        r#"{{"byteLength":{},"uri":"data:application/octet-stream;base64,{}"}}"#,
        binary.len(),
        base64(&binary)
    );
    all.push(("gltf", root.replace("BUFFER", &uri).into()));
    all.push(("gltf", root.replace("BUFFER", r#"{"byteLength":200,"uri":"beside%2ebin"}"#).into()));
    all.push(("glb", glb(&root.replace("BUFFER", &format!(r#"{{"byteLength":{}}}"#, binary.len())), &binary)));
    all.extend(pngs().into_iter().map(|file| ("png", file)));
    all.extend([Color::L8, Color::Rgb8].map(|color| ("jpeg", jpeg(color))));
    all.extend([("hdr", hdr(2)), ("hdr", hdr(16)), ("exr", exr())]);
    all.extend(["saved_result", "checkpoint"].into_iter().flat_map(|target| changes().map(move |c| (target, c))));
    let of_shares = |first: u8| changes().map(move |c| ("share", [&[first][..], &c].concat()));
    all.extend([0, 1].into_iter().flat_map(of_shares));
    all.extend(scene_changes().map(|c| ("scene_file", c)));
    all.extend(live_changes().map(|c| ("live_restore", c)));
    all
}

/// Changes of each kind to the first and to later records (see `saved`), and none at all.
fn changes() -> impl Iterator<Item = Vec<u8>> {
    let to = |record: u8| (0..8).map(move |what| [&[record, 64 + what, 9, 0][..], &[0xff; 8]].concat());
    [Vec::new()].into_iter().chain((0..8).flat_map(to))
}

/// A word of zeros, ones or one more at places throughout both files (see `scene_file`), and no changes.
fn scene_changes() -> impl Iterator<Item = Vec<u8>> {
    let at = |i: u32| {
        [0, 1, u32::MAX].map(|new: u32| [&[i as u8][..], &(97 * i).to_le_bytes(), &new.to_le_bytes()].concat())
    };
    [vec![0], vec![1]].into_iter().chain((0..200).flat_map(at))
}

/// Four bytes of ones, zeros and a negative number at places throughout a live state (see `live_state`), and none.
fn live_changes() -> impl Iterator<Item = Vec<u8>> {
    let at =
        |i: u16| [[0xff; 4], [0; 4], [0, 0, 0x80, 0xbf]].map(|new| [&(997 * i).to_le_bytes(), &[4][..], &new].concat());
    [Vec::new()].into_iter().chain((0..8).flat_map(at))
}

const OBJ: [&str; 3] = [
    "# a bit of everything\nmtllib a.mtl\no thing\nv 0 0 0\nv 1 0 0 1.0\nv 1 1 0 0.5 0.5 0.5\nv 0 1 0\nvt 0 0\nvt 1 0\n\
     vt 1 1 0\nvt 0 1\nvn 0 0 2\ng part\nusemtl red\nf 1/1/1 2/2/1 3/3/1 4/4/1\nusemtl red|lm2\nf 1/1 2/2 3/3\n\
     f -4//-1 -3//-1 \\\n -2//-1\nusemtl lamp|lm-1\ns off\nl 1 2\np 1\nf 1 2 3\n",
    "v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 0 1\nf 1 2 3\nf 1//1 2//1 3//1\nf 3 2 1\nf 3//1 2//1 1//1\n",
    "mtllib a.mtl b c.mtl\nusemtl cut\nv 1e3 -2.5e-3 +4\nv 1e12 0 0\nv 0 1 0\nvt 0.5\nf 1/1 2/1 3/1\n",
];

const MTL: [&str; 2] = [
    "newmtl red\nKd 0.8 0.1 0.1\nmap_Kd -s 2 2 -o 0.5 -clamp on a.png\nmap_d a.png\nnewmtl lamp\nKe 5\n\
     newmtl cut\nTf 0.5 0.6 0.7\nillum 4\nd 0.5\n",
    "newmtl red\nKd spectral x.rfl\nmap_Kd sub\\..\\..\\a.png\nnewmtl lamp\nmap_Kd /dev/zero\nnewmtl cut\nmap_Kd %2e%2e/a.png\n",
];

const PLY_HEADER: &str = "comment a quad and a triangle\nelement vertex 5\nproperty float x\nproperty float y\n\
    property double z\nproperty uchar red\nproperty float nx\nproperty float ny\nproperty float nz\nproperty float s\n\
    property float t\nelement tag 1\nproperty list uchar short values\nelement face 2\n\
    property list uchar int vertex_indices\nproperty float quality\nend_header\n";

fn ascii_ply() -> Vec<u8> {
    format!(
        "ply\nformat ascii 1.0\n{PLY_HEADER}0 0 0 255 0 0 2 0 0\n1 0 0 255 0 0 1 1 0\n1 1 0 255 0 0 1 1 1\n\
         0 1 0 255 0 0 1 0 1\n0 0 1 255 0 0 1 0 0\n3 1 -2 3\n4 0 1 2 3 0.5\n3 0 1 4 0.5\n"
    )
    .into()
}

fn binary_ply(little: bool) -> Vec<u8> {
    let order = if little { "little" } else { "big" };
    let mut file = format!("ply\nformat binary_{order}_endian 1.0\n{PLY_HEADER}").into_bytes();
    let mut put = |big: &[u8]| match little {
        true => file.extend(big.iter().rev()),
        false => file.extend(big),
    };
    for p in [[0f32, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]] {
        put(&p[0].to_be_bytes());
        put(&p[1].to_be_bytes());
        put(&f64::from(p[2]).to_be_bytes());
        put(&[255]);
        [0.0, 0.0, 1.0, p[0], p[1]].iter().for_each(|x: &f32| put(&x.to_be_bytes()));
    }
    put(&[3]);
    [1i16, -2, 3].iter().for_each(|v| put(&v.to_be_bytes()));
    for face in [&[0i32, 1, 2, 3][..], &[0, 1, 4]] {
        put(&[face.len() as u8]);
        face.iter().for_each(|v| put(&v.to_be_bytes()));
        put(&0.5f32.to_be_bytes());
    }
    file
}

/// A textured quad below a moving node, a lamp, and a sparse accessor. `BUFFER` stands for the buffer.
fn gltf_parts() -> (String, Vec<u8>) {
    let mut binary: Vec<u8> = Vec::new();
    let positions = [0f32, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0, 0.0];
    positions.iter().for_each(|x| binary.extend(x.to_le_bytes()));
    [0u16, 0, 65535, 0, 65535, 65535, 0, 65535].iter().for_each(|x| binary.extend(x.to_le_bytes()));
    [0u16, 1, 2, 0, 2, 3].iter().for_each(|x| binary.extend(x.to_le_bytes()));
    [1u16, 2].iter().for_each(|x| binary.extend(x.to_le_bytes()));
    let image = pngs().swap_remove(0);
    let root = format!(
        r#"{{"asset":{{"version":"2.0"}},"extensionsUsed":["KHR_lights_punctual"],"scene":0,"scenes":[{{"nodes":[0]}}],
"nodes":[{{"children":[1,2],"translation":[10,0,0]}},{{"mesh":0,"scale":[-2,1,1]}},
{{"rotation":[-0.70710678,0,0,0.70710678],"extensions":{{"KHR_lights_punctual":{{"light":0}}}}}}],
"meshes":[{{"primitives":[{{"attributes":{{"POSITION":0,"TEXCOORD_0":1,"TEXCOORD_1":1}},"indices":2,"material":0}},
{{"attributes":{{"POSITION":3}},"mode":5}}]}}],
"materials":[{{"pbrMetallicRoughness":{{"baseColorFactor":[1,0.5,0.25,1],"baseColorTexture":{{"index":0}}}},
"occlusionTexture":{{"index":1,"texCoord":1}},"alphaMode":"MASK","doubleSided":true}}],
"extensions":{{"KHR_lights_punctual":{{"lights":[{{"type":"spot","intensity":10,"spot":{{"outerConeAngle":0.5}}}}]}}}},
"textures":[{{"source":0}},{{"source":1}}],
"images":[{{"bufferView":4,"mimeType":"image/png"}},{{"uri":"../a%20.png"}}],
"accessors":[{{"bufferView":0,"componentType":5126,"count":4,"type":"VEC3","min":[0,0,0],"max":[1,1,0]}},
{{"bufferView":1,"componentType":5123,"normalized":true,"count":4,"type":"VEC2"}},
{{"bufferView":2,"componentType":5123,"count":6,"type":"SCALAR"}},
{{"bufferView":0,"componentType":5126,"count":4,"type":"VEC3","min":[0,0,0],"max":[1,1,0],"sparse":{{"count":2,
"indices":{{"bufferView":3,"componentType":5123}},"values":{{"bufferView":0}}}}}}],
"bufferViews":[{{"buffer":0,"byteLength":48}},{{"buffer":0,"byteOffset":48,"byteLength":16,"byteStride":4}},
{{"buffer":0,"byteOffset":64,"byteLength":12}},{{"buffer":0,"byteOffset":76,"byteLength":4}},
{{"buffer":0,"byteOffset":80,"byteLength":{}}}],"buffers":[BUFFER]}}"#,
        image.len()
    );
    binary.extend(image);
    (root, binary)
}

fn glb(root: &str, binary: &[u8]) -> Vec<u8> {
    let mut json = root.as_bytes().to_vec();
    json.resize(json.len().next_multiple_of(4), b' ');
    let mut binary = binary.to_vec();
    binary.resize(binary.len().next_multiple_of(4), 0);
    let mut file = b"glTF\x02\0\0\0".to_vec();
    file.extend((28 + json.len() as u32 + binary.len() as u32).to_le_bytes());
    for (kind, chunk) in [(b"JSON", &json), (b"BIN\0", &binary)] {
        file.extend((chunk.len() as u32).to_le_bytes());
        file.extend(kind);
        file.extend(chunk);
    }
    file
}

fn base64(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::new();
    for group in bytes.chunks(3) {
        let n = group.iter().chain(&[0; 2]).take(3).fold(0u32, |n, b| n << 8 | u32::from(*b));
        let digit = |i: usize| if i <= group.len() { DIGITS[(n >> (18 - 6 * i) & 63) as usize] as char } else { '=' };
        text.extend((0..4).map(digit));
    }
    text
}

fn pngs() -> Vec<Vec<u8>> {
    let kinds = [(Color::Rgba8, 4), (Color::Rgb8, 3), (Color::L8, 1), (Color::La8, 2), (Color::Rgb16, 6)];
    let encode = |(color, size)| {
        let mut file = Vec::new();
        let bytes: Vec<u8> = (0..4 * 3 * size).map(|i| (i * 37) as u8).collect();
        PngEncoder::new(&mut file).write_image(&bytes, 4, 3, color).expect("a small image");
        file
    };
    kinds.into_iter().map(encode).collect()
}

fn jpeg(color: Color) -> Vec<u8> {
    let mut file = Vec::new();
    let channels = if color == Color::L8 { 1 } else { 3 };
    let bytes: Vec<u8> = (0..17 * 9 * channels).map(|i| (i * 7) as u8).collect();
    JpegEncoder::new_with_quality(&mut file, 50).write_image(&bytes, 17, 9, color).expect("a small image");
    file
}

fn hdr(width: usize) -> Vec<u8> {
    let mut file = Vec::new();
    let pixels: Vec<Rgb<f32>> = (0..width * 3).map(|i| Rgb([i as f32, 0.5, 1e-3])).collect();
    HdrEncoder::new(&mut file).encode(&pixels, width, 3).expect("a small image");
    file
}

fn exr() -> Vec<u8> {
    let mut file = Cursor::new(Vec::new());
    let pixels: Vec<u8> = (0..5 * 3 * 3).flat_map(|i| (i as f32).to_le_bytes()).collect();
    OpenExrEncoder::new(&mut file).write_image(&pixels, 5, 3, Color::Rgb32F).expect("a small image");
    file.into_inner()
}
