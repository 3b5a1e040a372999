//! Wavefront OBJ: polygons with materials and, by a convention of ours, light map coordinates.
//!
//! - Polygons are split into fans from their first corner, in file order.
//! - `usemtl NAME|lmN`: the `vt` of the faces that follow are light map coordinates on page N, as
//!   exported from game levels; a negative N means that they have none. The material is the exact
//!   name if a library has it, else what stands before the `|`. Other `vt` become
//!   [`Mesh::uvs`], unchanged.
//! - Normals and coordinates belong to whole meshes here and to single faces in the file: a new mesh
//!   starts wherever faces with begin or end. So triangles keep their global order.
//! - Images have v = 0 at their bottom and are turned over, for here it is row 0. Where one has alpha (that of
//!   `map_d`, else that of `map_Kd`) below one half are cut-outs, except in surfaces that emit.
//! - Groups, smoothing and free forms are ignored, and points and lines too.
//!
//! Why not the crate `tobj` (which the tests compare with): it forgets the names of materials that no
//! library describes, and with them the light map pages; makes triangles of lines and two-cornered
//! faces; mixes up coordinates when only some faces have them; panics on `Kd 0.5` and, where
//! overflow is checked, on out-of-range indices; and says no line. It takes about as long.

mod materials;
mod mtl;
#[cfg(test)]
pub(super) mod tests;

use super::source::{Opened, Source, folder_of, read_error};
use super::{Import, is_valid_position};
use crate::base::error::{Error, Result};
use crate::scene::{LightmapUvs, Mesh, MeshMaterials, NONE};
use glam::{Vec2, Vec3};
use mtl::{Library, finite, split_keyword};
use std::collections::{HashMap, HashSet};
use std::fmt::Display;
use std::ops::Range;

/// Light map pages run below this: a page costs memory even if almost empty.
const MAX_PAGES: i64 = 4096;

pub(super) fn load(import: &mut Import, opened: Opened) -> Result<()> {
    let mut source = Source::new(opened, import.advance);
    let mut reader = Reader::new(import);
    reader.read(&mut source)?;
    reader.finish()
}

/// A `usemtl` name.
struct Name {
    text: Vec<u8>,
    /// Meaning of its `vt`.
    coordinates: Coordinates,
    /// Number of faces that use it.
    faces: u64,
}

#[derive(Clone, Copy, PartialEq)]
enum Coordinates {
    Texture,
    Lightmap(u32),
    Nothing,
}

/// The properties that all faces of one mesh share.
#[derive(Clone, Copy, Default, PartialEq)]
struct Kind {
    lightmap: bool,
    uvs: bool,
    normals: bool,
}

/// Position, texture coordinate and normal of a corner, from 0; [`NONE`] where there is none.
type Corner = [u32; 3];

struct Reader<'a, 's> {
    import: &'a mut Import<'s>,
    line: usize,
    positions: Vec<Vec3>,
    uvs: Vec<Vec2>,
    normals: Vec<Vec3>,
    library: Library,
    /// Texts of `mtllib` lines so far: a library that is named a thousand times is read once.
    libraries: HashSet<String>,
    names: Vec<Name>,
    name_ids: HashMap<Vec<u8>, u32>,
    /// Number of the current name.
    name: u32,
    kind: Kind,
    /// The mesh being filled; its materials are numbers of names.
    mesh: Mesh,
    triangle_names: Vec<u32>,
    pages: Vec<u32>,
    vertex_of: HashMap<Corner, u32>,
    done: Vec<(Mesh, Vec<u32>)>,
    triangles: usize,
    /// Corners of the face being read.
    corners: Vec<Corner>,
    ignored_elements: u64,
    faces_without_lightmap_uvs: u64,
}

impl<'a, 's> Reader<'a, 's> {
    fn new(import: &'a mut Import<'s>) -> Self {
        Reader {
            import,
            line: 0,
            positions: Vec::new(),
            uvs: Vec::new(),
            normals: Vec::new(),
            library: Library::new(),
            libraries: HashSet::new(),
            names: vec![Name { text: Vec::new(), coordinates: Coordinates::Texture, faces: 0 }],
            name_ids: HashMap::from([(Vec::new(), 0)]),
            name: 0,
            kind: Kind::default(),
            mesh: Mesh::default(),
            triangle_names: Vec::new(),
            pages: Vec::new(),
            vertex_of: HashMap::new(),
            done: Vec::new(),
            triangles: 0,
            corners: Vec::new(),
            ignored_elements: 0,
            faces_without_lightmap_uvs: 0,
        }
    }

    fn error(&self, what: impl Display) -> Error {
        self.import.error(format_args!("line {}: {what}", self.line))
    }

    fn read(&mut self, source: &mut Source) -> Result<()> {
        let mut text = Vec::new();
        loop {
            text.clear();
            let mut lines = 0;
            // A backslash at its end continues a line.
            loop {
                let read = source.read_line(&mut text, &mut self.import.account);
                let read = read.map_err(|e| read_error(e, self.import.path.display()))?;
                lines += (read > 0) as usize;
                let used = text.trim_ascii_end().len();
                if read == 0 || text[..used].last() != Some(&b'\\') {
                    break;
                }
                text.truncate(used - 1);
                text.push(b' ');
            }
            if lines == 0 {
                return Ok(());
            }
            self.line += 1;
            self.statement(&text)?;
            self.line += lines - 1;
        }
    }

    fn statement(&mut self, text: &[u8]) -> Result<()> {
        let (keyword, rest) = split_keyword(text);
        match keyword {
            b"v" => self.position(rest),
            b"vt" => self.texture_coordinate(rest),
            b"vn" => self.normal(rest),
            b"f" | b"fo" => self.face(rest),
            b"usemtl" => self.use_material(rest),
            b"mtllib" => self.open_libraries(rest),
            b"p" | b"l" | b"curv" | b"curv2" | b"surf" => {
                self.ignored_elements += 1;
                Ok(())
            }
            _ => Ok(()),
        }
    }

    /// Reads `N` numbers, of which the first `required` must be present; the others are 0 without.
    fn numbers<const N: usize>(&self, keyword: &str, text: &[u8], required: usize) -> Result<[f32; N]> {
        let mut values = [0.0; N];
        let mut words = words(text);
        for (i, value) in values.iter_mut().enumerate() {
            match words.next() {
                Some(word) => *value = finite(word).map_err(|what| self.error(format_args!("{keyword} {what}")))?,
                None if i < required => {
                    return Err(self.error(format_args!("{keyword} has {i} numbers, not {required}")));
                }
                None => {}
            }
        }
        Ok(values)
    }

    fn position(&mut self, text: &[u8]) -> Result<()> {
        let p = Vec3::from(self.numbers("v", text, 3)?);
        if !is_valid_position(p) {
            return Err(self.error(format_args!("the vertex {p} is out of range")));
        }
        self.import.account.push(&mut self.positions, p, "the vertices")
    }

    fn texture_coordinate(&mut self, text: &[u8]) -> Result<()> {
        let uv = Vec2::from(self.numbers("vt", text, 1)?);
        self.import.account.push(&mut self.uvs, uv, "the texture coordinates")
    }

    fn normal(&mut self, text: &[u8]) -> Result<()> {
        let n = Vec3::from(self.numbers("vn", text, 3)?);
        let n = n.as_dvec3().normalize_or_zero().as_vec3();
        self.import.account.push(&mut self.normals, n, "the normals")
    }

    fn use_material(&mut self, name: &[u8]) -> Result<()> {
        if let Some(&id) = self.name_ids.get(name) {
            self.name = id;
            return Ok(());
        }
        let coordinates = coordinates_of(name).map_err(|what| self.error(what))?;
        // Two copies of the name, in a list and a map.
        self.import.account.hold(2 * name.len() + 4 * size_of::<Name>(), "the names of materials")?;
        self.name = self.names.len() as u32;
        self.name_ids.insert(name.to_vec(), self.name);
        self.names.push(Name { text: name.to_vec(), coordinates, faces: 0 });
        Ok(())
    }

    /// `mtllib NAME…`: the rest of the line as one file name, or, as the format says, several names.
    fn open_libraries(&mut self, names: &[u8]) -> Result<()> {
        let folder = folder_of(&self.import.path).to_owned();
        let names = String::from_utf8_lossy(names).replace('\\', "/");
        if !self.libraries.insert(names.clone()) {
            return Ok(());
        }
        self.import.account.hold(2 * names.len(), "the names of libraries")?;
        if let Ok(whole) = self.import.files.open(&folder, &names)? {
            return self.read_library(whole);
        }
        for name in names.split_whitespace() {
            match self.import.files.open(&folder, name)? {
                Ok(opened) => self.read_library(opened)?,
                Err(what) => self.import.warn(format!("the material library {name:?} cannot be opened ({what})")),
            }
        }
        Ok(())
    }

    fn read_library(&mut self, opened: Opened) -> Result<()> {
        let path = opened.path.clone();
        let mut source = Source::new(opened, self.import.advance);
        mtl::read(&mut source, &path, &mut self.library, &mut self.import.account)
    }

    fn face(&mut self, text: &[u8]) -> Result<()> {
        let mut corners = std::mem::take(&mut self.corners);
        corners.clear();
        for word in words(text) {
            let corner = self.corner(word)?;
            self.import.account.push(&mut corners, corner, "the corners of a face")?;
        }
        if corners.len() < 3 {
            return Err(self.error(format_args!("a face has {} corners, fewer than 3", corners.len())));
        }
        self.triangles += corners.len() - 2;
        self.import.check_triangle_count(self.triangles)?;
        self.import.info.faces_triangulated += (corners.len() > 3) as u64;
        self.add_face(&corners)?;
        self.corners = corners;
        Ok(())
    }

    /// `v`, `v/vt`, `v//vn` or `v/vt/vn`, from 1, or negative: back from the last.
    fn corner(&self, word: &[u8]) -> Result<Corner> {
        let mut corner = [NONE; 3];
        let counts = [self.positions.len(), self.uvs.len(), self.normals.len()];
        let mut parts = word.split(|&c| c == b'/');
        for (k, what) in ["vertex", "texture coordinate", "normal"].into_iter().enumerate() {
            let part = parts.next().unwrap_or_default();
            if part.is_empty() && k > 0 {
                continue;
            }
            let number = integer(part)
                .ok_or_else(|| self.error(format_args!("a face has the corner {:?}", String::from_utf8_lossy(word))))?;
            let count = counts[k] as i64;
            let index = if number < 0 { count + number } else { number - 1 };
            if !(0..count.min(NONE as i64)).contains(&index) {
                return Err(self.error(format_args!("a face names {what} {number}, so far there are {count}")));
            }
            corner[k] = index as u32;
        }
        if parts.next().is_some() {
            return Err(self.error(format_args!("a face has the corner {:?}", String::from_utf8_lossy(word))));
        }
        Ok(corner)
    }

    fn add_face(&mut self, corners: &[Corner]) -> Result<()> {
        let name = &mut self.names[self.name as usize];
        name.faces += 1;
        let has = |k: usize| corners.iter().all(|c| c[k] != NONE);
        let mut kind = Kind { normals: has(2), ..Kind::default() };
        match name.coordinates {
            Coordinates::Texture => kind.uvs = has(1),
            Coordinates::Lightmap(_) => {
                kind.lightmap = has(1);
                self.faces_without_lightmap_uvs += !kind.lightmap as u64;
            }
            Coordinates::Nothing => {}
        }
        let page = if let Coordinates::Lightmap(page) = name.coordinates { page } else { 0 };
        if kind != self.kind {
            self.finish_mesh()?;
            self.kind = kind;
        }
        let (first, mut previous) = (self.vertex(corners[0])?, self.vertex(corners[1])?);
        for corner in &corners[2..] {
            let next = self.vertex(*corner)?;
            let account = &mut self.import.account;
            account.push(&mut self.mesh.indices.as_vec(), [first, previous, next], "the triangles")?;
            account.push(&mut self.triangle_names, self.name, "the triangles")?;
            if kind.lightmap {
                account.push(&mut self.pages, page, "the triangles")?;
            }
            previous = next;
        }
        Ok(())
    }

    /// The vertex of the current mesh for a corner.
    fn vertex(&mut self, [v, vt, vn]: Corner) -> Result<u32> {
        let Kind { lightmap, uvs, normals } = self.kind;
        let key = [v, if uvs || lightmap { vt } else { NONE }, if normals { vn } else { NONE }];
        if let Some(vertex) = self.vertex_of.get(&key) {
            return Ok(*vertex);
        }
        let (account, mesh) = (&mut self.import.account, &mut self.mesh);
        account.make_room_in_map(&mut self.vertex_of, "the vertices")?;
        let vertex = mesh.positions.len() as u32;
        account.push(&mut mesh.positions.as_vec(), self.positions[v as usize], "the vertices")?;
        if uvs || lightmap {
            account.push(&mut mesh.uvs.as_vec(), self.uvs[vt as usize], "the texture coordinates")?;
        }
        if normals {
            account.push(&mut mesh.normals.as_vec(), self.normals[vn as usize], "the normals")?;
        }
        self.vertex_of.insert(key, vertex);
        Ok(vertex)
    }

    fn finish_mesh(&mut self) -> Result<()> {
        // To clear a map takes as long as its room is large, which a large mesh before may have made.
        if self.vertex_of.capacity() / 8 > self.vertex_of.len() {
            self.vertex_of = HashMap::new();
        } else {
            self.vertex_of.clear();
        }
        let mut mesh = std::mem::take(&mut self.mesh);
        let pages = std::mem::take(&mut self.pages);
        let names = std::mem::take(&mut self.triangle_names);
        if mesh.indices.is_empty() {
            return Ok(());
        }
        if self.kind.lightmap {
            mesh.lightmap = Some(LightmapUvs { uvs: std::mem::take(&mut mesh.uvs), pages: pages.into() });
        }
        self.import.account.push(&mut self.done, (mesh, names), "the meshes")
    }

    fn finish(mut self) -> Result<()> {
        self.finish_mesh()?;
        if self.done.is_empty() {
            return Err(self.import.error("there are no faces in it"));
        }
        let materials = self.add_materials()?;
        for (mut mesh, mut names) in std::mem::take(&mut self.done) {
            self.import.check()?;
            names.iter_mut().for_each(|name| *name = materials[*name as usize]);
            mesh.materials = match names.iter().all(|m| *m == names[0]) {
                true => MeshMaterials::One(names[0]),
                false => MeshMaterials::PerTriangle(names.into()),
            };
            self.import.add_mesh(mesh)?;
        }
        self.warn();
        Ok(())
    }

    fn warn(&mut self) {
        if self.ignored_elements > 0 {
            self.import.warn(format!("{} points, lines and free forms were ignored", self.ignored_elements));
        }
        if self.faces_without_lightmap_uvs > 0 {
            let count = self.faces_without_lightmap_uvs;
            self.import.warn(format!("{count} faces name a light map page but have no texture coordinates"));
        }
    }
}

/// The words of a line up to a comment.
fn words(text: &[u8]) -> impl Iterator<Item = &[u8]> {
    text.split(|c| c.is_ascii_whitespace()).filter(|w| !w.is_empty()).take_while(|w| w[0] != b'#')
}

fn integer(text: &[u8]) -> Option<i64> {
    std::str::from_utf8(text).ok()?.parse().ok()
}

/// A material name without what stands behind the last `|`.
fn base_name(name: &[u8]) -> &[u8] {
    &name[..name.iter().rposition(|c| *c == b'|').unwrap_or(name.len())]
}

/// Meaning of the `vt` of a material's faces: with `…|lmN` coordinates on light map page N, with a negative N none.
fn coordinates_of(name: &[u8]) -> std::result::Result<Coordinates, String> {
    let suffix: Range<usize> = (base_name(name).len() + 1).min(name.len())..name.len();
    match name[suffix].strip_prefix(b"lm").and_then(integer) {
        None => Ok(Coordinates::Texture),
        Some(page) if page < 0 => Ok(Coordinates::Nothing),
        Some(page) if page < MAX_PAGES => Ok(Coordinates::Lightmap(page as u32)),
        Some(page) => Err(format!("light map page {page} is not below {MAX_PAGES}")),
    }
}
