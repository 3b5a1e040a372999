//! The parsed JSON of a file, and its nodes in the world.

use super::text::Text;
use crate::base::error::{Error, Result};
use crate::io::Import;
use crate::io::source::Checked;
use glam::{DMat4, Mat4};
use gltf::json;
use gltf::mesh::Semantic;
use std::borrow::Cow;
use std::collections::BTreeSet;
use std::io::BufReader;

/// Required extensions that may be ignored, since they change no shapes.
const HARMLESS_EXTENSIONS: [&str; 6] =
    ["KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_mesh_quantization", "KHR_xmp", "EXT_mesh_gpu_instancing"];

/// The JSON of a file and its binary chunk, without copies.
pub(super) fn split<'b>(import: &Import, bytes: &'b [u8]) -> Result<(&'b [u8], Option<&'b [u8]>)> {
    if !bytes.starts_with(b"glTF") {
        return Ok((bytes, None));
    }
    // The crate subtracts the header's size from the length that the header states.
    let stated = bytes.get(8..12).map_or(0, |b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]));
    if stated < 12 {
        return Err(import.error("the GLB header is cut off"));
    }
    let glb = gltf::binary::Glb::from_slice(bytes).map_err(|e| explain(import, e))?;
    let borrowed = |chunk: Cow<'b, [u8]>| match chunk {
        Cow::Borrowed(bytes) => Ok(bytes),
        Cow::Owned(_) => Err(Error::Internal("a chunk was copied".into())),
    };
    Ok((borrowed(glb.json)?, glb.bin.map(borrowed).transpose()?))
}

pub(super) fn parse(import: &mut Import, text: &mut Text) -> Result<gltf::Document> {
    // What the parser makes of the text takes several times as much, and is not ours to allocate.
    let estimate = text.short.len().saturating_mul(4);
    import.account.hold(estimate, "the JSON of the scene")?;
    // The parser asks for single bytes.
    let reader = BufReader::new(Checked::new(&text.short, import.advance));
    let mut root = json::Root::from_reader(reader).map_err(|e| import.error(e))?;
    let size = text.short.capacity();
    text.short = Vec::new();
    import.account.give_back(size);
    root.extensions_required.retain(|e| !HARMLESS_EXTENSIONS.iter().any(|harmless| e.starts_with(harmless)));
    // The crate's validation looks at the positions' accessor before it has checked its number.
    for (m, mesh) in root.meshes.iter().enumerate() {
        for attributes in mesh.primitives.iter().map(|p| &p.attributes) {
            if let Some(a) = attributes.get(&json::validation::Checked::Valid(Semantic::Positions))
                && a.value() >= root.accessors.len()
            {
                let count = root.accessors.len();
                return Err(import.error(format_args!("mesh {m} names accessor {a}, there are {count}")));
            }
        }
    }
    gltf::Document::from_json(root).map_err(|e| explain(import, e))
}

fn explain(import: &Import, e: gltf::Error) -> Error {
    match e {
        gltf::Error::Validation(errors) => match errors.first() {
            Some((path, json::validation::Error::Unsupported)) => {
                Error::Unsupported(format!("{}: it requires {path}", import.path.display()))
            }
            Some((path, what)) => import.error(format_args!("{path}: {what}")),
            None => import.error("it is not valid"),
        },
        gltf::Error::Binary(e) => import.error(format_args!("GLB: {e}")),
        e => import.error(e),
    }
}

/// The nodes of the default scene (or the first, or all roots) with their transforms to the world,
/// parents before children, in the order of the file.
pub(super) fn place_nodes<'a>(
    import: &mut Import,
    document: &'a gltf::Document,
) -> Result<Vec<(gltf::Node<'a>, DMat4)>> {
    let roots: Vec<_> = match document.default_scene().or_else(|| document.scenes().next()) {
        Some(scene) => scene.nodes().collect(),
        None => {
            let children: BTreeSet<_> = document.nodes().flat_map(|n| n.children()).map(|n| n.index()).collect();
            document.nodes().filter(|n| !children.contains(&n.index())).collect()
        }
    };
    let count = document.nodes().len();
    let mut seen = import.account.list(count, "the nodes")?;
    seen.resize(count, false);
    let mut placed = import.account.list(count, "the nodes")?;
    let mut stack: Vec<_> = roots.into_iter().rev().map(|node| (node, DMat4::IDENTITY)).collect();
    while let Some((node, parent)) = stack.pop() {
        if placed.len().is_multiple_of(1024) {
            import.check()?;
        }
        if std::mem::replace(&mut seen[node.index()], true) {
            return Err(import.error(format_args!("node {} has several parents", node.index())));
        }
        let transform = parent * Mat4::from_cols_array_2d(&node.transform().matrix()).as_dmat4();
        stack.extend(node.children().map(|child| (child, transform)).collect::<Vec<_>>().into_iter().rev());
        placed.push((node, transform));
    }
    Ok(placed)
}
