//! PLY (Stanford polygon format), ASCII and binary of both byte orders, through `ply-rs-bw`:
//! `vertex` with `x y z`, optionally `nx ny nz` and `s t` or `u v`; `face` with `vertex_indices`.
//! Other elements and properties are skipped. A face of more than three corners becomes a fan from
//! its first. The format has no materials: all is grey ([`DEFAULT_ALBEDO`]).

use super::source::{Opened, Source, read_error};
use super::{DEFAULT_ALBEDO, Import, TWO_SIDED_UNLESS_SAID, is_valid_position};
use crate::base::error::Result;
use crate::scene::{Material, Mesh, MeshMaterials};
use glam::{Vec2, Vec3};
use ply_rs_bw::parser::{Parser, Reader};
use ply_rs_bw::ply::{
    BeginList, ElementDef, Encoding, Header, Property, PropertyAccess, PropertyAccessResult, PropertyType, ScalarType,
};

const NORMAL_NAMES: [&str; 3] = ["nx", "ny", "nz"];
const INDEX_NAMES: [&str; 2] = ["vertex_indices", "vertex_index"];

/// Bytes of a header: the parser keeps all of it.
const MAX_HEADER: usize = 1 << 20;

pub(super) fn load(import: &mut Import, opened: Opened) -> Result<()> {
    let bytes = opened.size;
    let mut reader = Reader::new(Source::new(opened, import.advance));
    reader.get_mut().limit(Some(MAX_HEADER));
    let header = Parser::<Skipped>::new().read_header(&mut reader).map_err(|e| import.error(one_line(&e)))?;
    reader.get_mut().limit(None);
    check_header(import, &header, bytes)?;
    let mut body = Body { line: reader.line(), encoding: header.encoding, text: Vec::new() };

    let material = import.add_material(Material {
        albedo: [DEFAULT_ALBEDO; 3],
        two_sided: TWO_SIDED_UNLESS_SAID,
        ..Default::default()
    })?;
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

/// Refuses headers without coordinates, and counts for which the file is too short (before
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

/// Minimum size of a property in bytes.
fn smallest_size(data_type: &PropertyType) -> u64 {
    let (PropertyType::Scalar(scalar) | PropertyType::List(scalar, _)) = data_type;
    match scalar {
        ScalarType::Char | ScalarType::UChar => 1,
        ScalarType::Short | ScalarType::UShort => 2,
        ScalarType::Int | ScalarType::UInt | ScalarType::Float => 4,
        ScalarType::Double => 8,
    }
}

/// The position in the part of the file behind the header.
struct Body {
    encoding: Encoding,
    /// Line number of the next element, in an ASCII file.
    line: usize,
    text: Vec<u8>,
}

impl Body {
    /// Reads the elements of one kind, one by one.
    fn each<E: PropertyAccess>(
        &mut self,
        import: &mut Import,
        source: &mut Source,
        element: &ElementDef,
        mut use_it: impl FnMut(&mut Import, usize, E) -> Result<()>,
    ) -> Result<()> {
        let parser = Parser::<E>::new();
        for i in 0..element.count {
            let read = match self.encoding {
                Encoding::Ascii => {
                    self.text.clear();
                    self.line += 1;
                    match source.read_line(&mut self.text, &mut import.account) {
                        Ok(0) => Err("the file ends here".to_string()),
                        Ok(_) => match str::from_utf8(&self.text) {
                            Ok(text) => parser.read_ascii_element(text, element).map_err(|e| one_line(&e)),
                            Err(e) => Err(e.to_string()),
                        },
                        Err(e) => return Err(read_error(e, import.path.display())),
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

/// A message of the crate on one line: its own ones quote lines of the file on further lines.
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
    source: &mut Source,
    element: &ElementDef,
    mesh: &mut Mesh,
) -> Result<()> {
    let has = |name: &str| element.properties.contains_key(name);
    let normals = NORMAL_NAMES.into_iter().all(has);
    let uvs = (has("s") && has("t")) || (has("u") && has("v"));
    import.account.make_room(&mut mesh.positions.as_vec(), element.count, "the vertices")?;
    import.account.make_room(&mut mesh.normals.as_vec(), if normals { element.count } else { 0 }, "the normals")?;
    import.account.make_room(&mut mesh.uvs.as_vec(), if uvs { element.count } else { 0 }, "the texture coordinates")?;
    body.each::<Vertex>(import, source, element, |import, i, vertex| {
        if !is_valid_position(vertex.position) {
            return Err(import.error(format_args!("vertex {i} is {}, not finite or out of range", vertex.position)));
        }
        mesh.positions.as_vec().push(vertex.position);
        if normals {
            mesh.normals.as_vec().push(vertex.normal.as_dvec3().normalize_or_zero().as_vec3());
        }
        if uvs {
            if !vertex.uv.is_finite() {
                return Err(import.error(format_args!("vertex {i} has the texture coordinates {}", vertex.uv)));
            }
            mesh.uvs.as_vec().push(vertex.uv);
        }
        Ok(())
    })
}

fn read_faces(
    import: &mut Import,
    body: &mut Body,
    source: &mut Source,
    element: &ElementDef,
    mesh: &mut Mesh,
) -> Result<()> {
    import.account.make_room(&mut mesh.indices.as_vec(), element.count, "the triangles")?;
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
            import.account.push(&mut mesh.indices.as_vec(), [first, previous, next], "the triangles")?;
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

/// An element that is skipped.
struct Skipped;

impl PropertyAccess for Skipped {
    fn new() -> Self {
        Skipped
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::io::tests::{corners, load_bytes, refusal};
    use crate::scene::SceneData;

    const HEADER: &str = "comment a quad and a triangle
element vertex 5
property float x
property float y
property double z
property uchar red
property float nx
property float ny
property float nz
property float s
property float t
element tag 1
property list uchar short values
element face 2
property list uchar int vertex_indices
property float quality
end_header
";

    pub fn ascii_sample() -> Vec<u8> {
        let body =
            "0 0 0 255 0 0 2 0 0\n1 0 0 255 0 0 1 1 0\n1 1 0 255 0 0 1 1 1\n0 1 0 255 0 0 1 0 1\n0 0 1 255 0 0 1 0 0
3 1 -2 3\n4 0 1 2 3 0.5\n3 0 1 4 0.5\n";
        format!("ply\nformat ascii 1.0\n{HEADER}{body}").into()
    }

    pub fn binary_sample(little: bool) -> Vec<u8> {
        let order = if little { "little" } else { "big" };
        let mut bytes = format!("ply\nformat binary_{order}_endian 1.0\n{HEADER}").into_bytes();
        let mut put = |big: &[u8]| match little {
            true => bytes.extend(big.iter().rev()),
            false => bytes.extend(big),
        };
        for (i, p) in
            [[0f32, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].iter().enumerate()
        {
            put(&p[0].to_be_bytes());
            put(&p[1].to_be_bytes());
            put(&f64::from(p[2]).to_be_bytes());
            put(&[255]);
            for x in [0.0, 0.0, if i == 0 { 2.0 } else { 1.0 }, p[0], p[1]] {
                put(&f32::to_be_bytes(x));
            }
        }
        put(&[3]);
        [1i16, -2, 3].iter().for_each(|v| put(&v.to_be_bytes()));
        for face in [&[0i32, 1, 2, 3][..], &[0, 1, 4]] {
            put(&[face.len() as u8]);
            face.iter().for_each(|v| put(&v.to_be_bytes()));
            put(&0.5f32.to_be_bytes());
        }
        bytes
    }

    #[test]
    fn all_encodings_read_the_same() {
        let (scene, info) = load_bytes("a.ply", ascii_sample()).unwrap();
        let mesh = &scene.meshes()[0];
        assert_eq!(mesh.indices, [[0, 1, 2], [0, 2, 3], [0, 1, 4]]);
        assert_eq!(corners(&scene)[2], [Vec3::ZERO, Vec3::X, Vec3::Z]);
        assert_eq!(mesh.normals, [Vec3::Z; 5]);
        assert_eq!(mesh.uvs[2], Vec2::ONE);
        assert_eq!((info.faces_triangulated, info.materials, info.vertices), (1, 1, 5));
        assert_eq!(scene.materials()[0].albedo, [DEFAULT_ALBEDO; 3]);
        assert_eq!(scene.materials()[0].two_sided, TWO_SIDED_UNLESS_SAID);
        for little in [true, false] {
            let (binary, _) = load_bytes("a.ply", binary_sample(little)).unwrap();
            assert_eq!(binary.meshes(), scene.meshes());
        }
    }

    fn simple(vertices: &str, face_type: &str, faces: &str) -> String {
        let (v, f) = (vertices.lines().count(), faces.lines().count());
        format!(
            "ply\nformat ascii 1.0\nelement vertex {v}\nproperty float x\nproperty float y\nproperty float z
element face {f}\nproperty list {face_type} vertex_index\nend_header\n{vertices}{faces}"
        )
    }

    const CORNERS: &str = "0 0 0\n1 0 0\n0 1 0\n";

    #[test]
    fn indices_may_have_any_integer_type() {
        let indices = |t: &str| -> SceneData { load_bytes("a.ply", simple(CORNERS, t, "3 2 1 0\n")).unwrap().0 };
        for t in ["uchar char", "int uchar", "uchar short", "uchar ushort", "uint int", "uchar uint32"] {
            assert_eq!(indices(t).meshes()[0].indices, [[2, 1, 0]], "{t}");
        }
    }

    #[test]
    fn malformed_files_are_refused_with_the_place() {
        let int = |faces: &str| refusal("a.ply", simple(CORNERS, "uchar int", faces));
        assert_eq!(int("2 0 1\n"), "face 0 has 2 corners, fewer than 3");
        assert_eq!(int("0\n"), "face 0 has 0 corners, fewer than 3");
        assert_eq!(int("3 0 1 2\n3 0 1 -1\n"), "face 1 names vertex -1");
        assert_eq!(int("3 0 1 3\n"), "a face names vertex 3, there are 3");
        assert!(int("3 0 1\n").starts_with("line 13, face 0: "), "{}", int("3 0 1\n"));
        assert!(int("3 0 1 x\n").starts_with("line 13, face 0: "));
        assert_eq!(int(""), "there are no faces in it");
        let text = refusal("a.ply", simple("0 0 0\n1 nan 0\n0 1 0\n", "uchar int", "3 0 1 2\n"));
        assert!(text.starts_with("line 11, vertex 1: "), "{text}");
        let mut binary = binary_sample(true);
        let y = String::from_utf8_lossy(&binary).find("end_header\n").unwrap() + 11 + 37 + 4;
        binary[y..y + 4].copy_from_slice(&f32::NAN.to_le_bytes());
        assert_eq!(refusal("a.ply", binary), "vertex 1 is [1, NaN, 0], not finite or out of range");
        assert_eq!(
            refusal("a.ply", simple(CORNERS, "uchar int", "3 0 1 2\n").replace("face 1", "face 2")),
            "line 14, face 1: the file ends here"
        );
        let float = refusal("a.ply", simple(CORNERS, "uchar float", "3 0 1 2\n"));
        assert!(float.contains("vertex_index"), "{float}");
    }

    #[test]
    fn impossible_headers_are_refused_before_memory_is_taken() {
        let text = simple(CORNERS, "uchar int", "3 0 1 2\n");
        let with = |from: &str, to: &str| refusal("a.ply", text.replace(from, to));
        let bytes = text.len() + 12;
        assert_eq!(
            with("vertex 3", "vertex 3000000000000"),
            format!("3000000000000 elements vertex do not fit into {bytes} bytes")
        );
        assert!(with("face 1", "face 18446744073709551615").contains("elements face do not fit"));
        assert!(
            with("face 1", "face 99999999999999999999").starts_with("Line 7: "),
            "{}",
            with("face 1", "face 99999999999999999999")
        );
        assert_eq!(with("property float y\n", ""), "the header has no vertex property y");
        assert_eq!(with("element face", "element fact"), "the header has no element face");
        assert_eq!(
            with("list uchar int vertex_index", "int vertex_index"),
            "the header has no face property list vertex_indices"
        );
        let empty = text.replace("end_header", "element nothing 99\nend_header");
        assert_eq!(refusal("a.ply", empty), "the header's element nothing has no properties");
        // A list that claims more than the file has.
        let mut list = binary_sample(true);
        let counts = String::from_utf8_lossy(&list).find("end_header\n").unwrap() + 11 + 5 * 37 + 1 + 6;
        assert_eq!(list[counts], 4);
        list[counts] = 255;
        assert!(refusal("a.ply", &list).starts_with("face 0: "));
    }

    #[test]
    fn an_empty_file_is_refused() {
        assert!(refusal("a.ply", "").len() > 5);
        assert!(refusal("a.ply", "ply\n").len() > 5);
    }
}
