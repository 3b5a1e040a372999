//! PLY (Stanford polygon format), ASCII and binary of both byte orders, through `ply-rs-bw`:
//! `vertex` with `x y z`, optionally `nx ny nz` and `s t` or `u v`; `face` with `vertex_indices`.
//! Other elements and properties are skipped. A face of more than three corners becomes a fan from
//! its first. The format has no materials: all is grey ([`DEFAULT_ALBEDO`]).

use super::{DEFAULT_ALBEDO, Import, TWO_SIDED_UNLESS_SAID, is_valid_position};
use crate::error::Result;
use crate::scene::{Mesh, MeshMaterials};
use glam::{Vec2, Vec3};
use ply_rs_bw::parser::{Parser, Reader};
use ply_rs_bw::ply::{
    BeginList, ElementDef, Encoding, Header, Property, PropertyAccess, PropertyAccessResult, PropertyType, ScalarType,
};
use std::fs::File;
use std::io::{BufRead, BufReader};

const NORMAL_NAMES: [&str; 3] = ["nx", "ny", "nz"];
const INDEX_NAMES: [&str; 2] = ["vertex_indices", "vertex_index"];

pub(super) fn load(import: &mut Import) -> Result<()> {
    let file = File::open(&import.path).map_err(|e| import.error(e))?;
    let bytes = file.metadata().map_err(|e| import.error(e))?.len();
    let mut reader = Reader::new(BufReader::with_capacity(1 << 20, file));
    let header = Parser::<Skipped>::new().read_header(&mut reader).map_err(|e| import.error(one_line(&e)))?;
    check_header(import, &header, bytes)?;
    let mut body = Body { line: reader.line(), encoding: header.encoding, text: String::new() };

    let material = import.add_material([DEFAULT_ALBEDO; 3], [0.0; 3], TWO_SIDED_UNLESS_SAID)?;
    let mut mesh = Mesh { materials: MeshMaterials::One(material), ..Default::default() };
    for (name, element) in &header.elements {
        match name.as_str() {
            "vertex" => read_vertices(import, &mut body, reader.get_mut(), element, &mut mesh)?,
            "face" => read_faces(import, &mut body, reader.get_mut(), element, &mut mesh)?,
            _ => body.each::<Skipped>(import, reader.get_mut(), element, |_, _, _| Ok(()))?,
        }
    }
    if mesh.indices.is_empty() {
        return Err(import.error("there are no faces in it"));
    }
    // Faces may come before vertices, so this is checked last.
    let vertices = mesh.positions.len();
    if let Some(i) = mesh.indices.iter().flatten().find(|i| **i as usize >= vertices) {
        return Err(import.error(format_args!("a face names vertex {i}, there are {vertices}")));
    }
    import.add_mesh(mesh)
}

/// Refuses what cannot be: missing coordinates, and counts for which the file is too short (before
/// memory is reserved for them).
fn check_header(import: &Import, header: &Header, bytes: u64) -> Result<()> {
    let element = |name: &str| {
        header.elements.get(name).ok_or_else(|| import.error(format_args!("the header has no element {name}")))
    };
    for name in ["x", "y", "z"] {
        if !matches!(element("vertex")?.properties.get(name).map(|p| &p.data_type), Some(PropertyType::Scalar(_))) {
            return Err(import.error(format_args!("the header has no vertex property {name}")));
        }
    }
    let lists = element("face")?.properties.values().filter(|p| INDEX_NAMES.contains(&p.name.as_str()));
    if !lists.clone().any(|p| matches!(p.data_type, PropertyType::List(..))) {
        return Err(import.error("the header has no face property list vertex_indices"));
    }
    for (name, element) in &header.elements {
        let smallest: u64 = match header.encoding {
            Encoding::Ascii => (2 * element.properties.len() as u64).saturating_sub(1),
            _ => element.properties.values().map(|p| smallest_size(&p.data_type)).sum(),
        };
        if element.count > 0 && smallest == 0 {
            return Err(import.error(format_args!("the header's element {name} has no properties")));
        }
        if (element.count as u64).checked_mul(smallest).is_none_or(|size| size > bytes) {
            let count = element.count;
            return Err(import.error(format_args!("{count} elements {name} do not fit into {bytes} bytes")));
        }
    }
    Ok(())
}

/// Bytes that a property takes at least.
fn smallest_size(data_type: &PropertyType) -> u64 {
    let (PropertyType::Scalar(scalar) | PropertyType::List(scalar, _)) = data_type;
    match scalar {
        ScalarType::Char | ScalarType::UChar => 1,
        ScalarType::Short | ScalarType::UShort => 2,
        ScalarType::Int | ScalarType::UInt | ScalarType::Float => 4,
        ScalarType::Double => 8,
    }
}

/// Where we are behind the header.
struct Body {
    encoding: Encoding,
    /// Of the next element, in an ASCII file.
    line: usize,
    text: String,
}

impl Body {
    /// Reads the elements of one kind, one by one.
    fn each<E: PropertyAccess>(
        &mut self,
        import: &mut Import,
        source: &mut impl BufRead,
        element: &ElementDef,
        mut use_it: impl FnMut(&mut Import, usize, E) -> Result<()>,
    ) -> Result<()> {
        let parser = Parser::<E>::new();
        for i in 0..element.count {
            let read = match self.encoding {
                Encoding::Ascii => {
                    self.text.clear();
                    self.line += 1;
                    match source.read_line(&mut self.text) {
                        Ok(0) => Err("the file ends here".to_string()),
                        Ok(_) => parser.read_ascii_element(&self.text, element).map_err(|e| one_line(&e)),
                        Err(e) => Err(e.to_string()),
                    }
                }
                Encoding::BinaryBigEndian => parser.read_big_endian_element(source, element).map_err(|e| one_line(&e)),
                Encoding::BinaryLittleEndian => {
                    parser.read_little_endian_element(source, element).map_err(|e| one_line(&e))
                }
            };
            let read = match (read, self.encoding) {
                (Ok(read), _) => read,
                (Err(what), Encoding::Ascii) => {
                    return Err(import.error(format_args!("line {}, {} {i}: {what}", self.line - 1, element.name)));
                }
                (Err(what), _) => return Err(import.error(format_args!("{} {i}: {what}", element.name))),
            };
            use_it(import, i, read)?;
        }
        Ok(())
    }
}

/// The crate's messages quote lines of the file on lines of their own.
fn one_line(e: &ply_rs_bw::parser::ParseError) -> String {
    let text = e.to_string();
    let mut line = text.split_whitespace().collect::<Vec<_>>().join(" ");
    if line.len() > 200 {
        let end = (0..=200).rev().find(|&i| line.is_char_boundary(i)).unwrap_or(0);
        line.truncate(end);
        line.push('…');
    }
    line
}

fn read_vertices(
    import: &mut Import,
    body: &mut Body,
    source: &mut impl BufRead,
    element: &ElementDef,
    mesh: &mut Mesh,
) -> Result<()> {
    let has = |name: &str| element.properties.contains_key(name);
    let normals = NORMAL_NAMES.into_iter().all(has);
    let uvs = (has("s") && has("t")) || (has("u") && has("v"));
    mesh.positions.reserve_exact(element.count);
    mesh.normals.reserve_exact(if normals { element.count } else { 0 });
    mesh.uvs.reserve_exact(if uvs { element.count } else { 0 });
    body.each::<Vertex>(import, source, element, |import, i, vertex| {
        if !is_valid_position(vertex.position) {
            return Err(import.error(format_args!("vertex {i} is {}, not finite or out of range", vertex.position)));
        }
        mesh.positions.push(vertex.position);
        if normals {
            mesh.normals.push(vertex.normal.as_dvec3().normalize_or_zero().as_vec3());
        }
        if uvs {
            if !vertex.uv.is_finite() {
                return Err(import.error(format_args!("vertex {i} has the texture coordinates {}", vertex.uv)));
            }
            mesh.uvs.push(vertex.uv);
        }
        Ok(())
    })
}

fn read_faces(
    import: &mut Import,
    body: &mut Body,
    source: &mut impl BufRead,
    element: &ElementDef,
    mesh: &mut Mesh,
) -> Result<()> {
    mesh.indices.reserve(element.count);
    body.each::<Face>(import, source, element, |import, i, face| {
        let corners = &face.corners;
        if let Some(negative) = face.signed.iter().find(|v| **v < 0) {
            return Err(import.error(format_args!("face {i} names vertex {negative}")));
        }
        let signed = face.signed.iter().map(|v| *v as u32);
        let count = corners.len() + signed.len();
        if count < 3 {
            return Err(import.error(format_args!("face {i} has {count} corners, fewer than 3")));
        }
        import.info.faces_triangulated += (count > 3) as u64;
        let mut fan = corners.iter().copied().chain(signed);
        let (Some(first), Some(mut previous)) = (fan.next(), fan.next()) else { return Ok(()) };
        for next in fan {
            mesh.indices.push([first, previous, next]);
            previous = next;
        }
        import.check_triangle_count(mesh.indices.len())
    })
}

#[derive(Default)]
struct Vertex {
    position: Vec3,
    normal: Vec3,
    uv: Vec2,
}

impl PropertyAccess for Vertex {
    fn new() -> Self {
        Self::default()
    }

    fn set_property(&mut self, name: &str, value: Property) -> PropertyAccessResult {
        let Some(value) = value.to_f32_lossy() else { return PropertyAccessResult::Ignored };
        match name {
            "x" => self.position.x = value,
            "y" => self.position.y = value,
            "z" => self.position.z = value,
            "nx" => self.normal.x = value,
            "ny" => self.normal.y = value,
            "nz" => self.normal.z = value,
            "s" | "u" => self.uv.x = value,
            "t" | "v" => self.uv.y = value,
            _ => return PropertyAccessResult::Ignored,
        }
        PropertyAccessResult::Set
    }
}

/// The corners are in one of the two lists, depending on their type in the file.
#[derive(Default)]
struct Face {
    corners: Vec<u32>,
    signed: Vec<i32>,
}

impl PropertyAccess for Face {
    fn new() -> Self {
        Self::default()
    }

    fn set_property(&mut self, name: &str, value: Property) -> PropertyAccessResult {
        if !INDEX_NAMES.contains(&name) {
            return PropertyAccessResult::Ignored;
        }
        match value {
            Property::ListUChar(v) => self.corners = v.into_iter().map(u32::from).collect(),
            Property::ListUShort(v) => self.corners = v.into_iter().map(u32::from).collect(),
            Property::ListUInt(v) => self.corners = v,
            Property::ListChar(v) => self.signed = v.into_iter().map(i32::from).collect(),
            Property::ListShort(v) => self.signed = v.into_iter().map(i32::from).collect(),
            Property::ListInt(v) => self.signed = v,
            _ => return PropertyAccessResult::UnsupportedType,
        }
        PropertyAccessResult::Set
    }

    // The common types, without a detour through `Property`.
    fn begin_list_int(&mut self, name: &str, _len: usize) -> BeginList<'_, i32> {
        if INDEX_NAMES.contains(&name) { BeginList::Fill(&mut self.signed) } else { BeginList::UseSetter }
    }

    fn begin_list_uint(&mut self, name: &str, _len: usize) -> BeginList<'_, u32> {
        if INDEX_NAMES.contains(&name) { BeginList::Fill(&mut self.corners) } else { BeginList::UseSetter }
    }
}

/// An element that we have no use for.
struct Skipped;

impl PropertyAccess for Skipped {
    fn new() -> Self {
        Skipped
    }
}
