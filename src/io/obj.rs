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
//!   `map_d`, else that of `map_Kd`) below one half are holes, except in surfaces that emit.
//! - Groups, smoothing and free forms are ignored, and points and lines too.
//!
//! Why not the crate `tobj` (which the tests compare with): it forgets the names of materials that no
//! library describes, and with them the light map pages; makes triangles of lines and two-cornered
//! faces; mixes up coordinates when only some faces have them; panics on `Kd 0.5` and, where
//! overflow is checked, on out-of-range indices; and says no line. It takes about as long.

use super::mtl::{self, Library, MapFile, finite, split_keyword};
use super::source::{Opened, Source, folder_of, read_error};
use super::{DEFAULT_ALBEDO, Import, TWO_SIDED_UNLESS_SAID, is_valid_position, texture};
use crate::error::{Error, Result};
use crate::scene::{LightmapUvs, Material, Mesh, MeshMaterials, NONE};
use glam::{Vec2, Vec3};
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
    /// What its `vt` are.
    coordinates: Coordinates,
    /// Faces that use it.
    faces: u64,
}

#[derive(Clone, Copy, PartialEq)]
enum Coordinates {
    Texture,
    Lightmap(u32),
    Nothing,
}

/// What the faces of one mesh have in common.
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
    /// What `mtllib` lines have said: a file that names a library a thousand times reads it once.
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

    /// `N` numbers of which the first `required` must be there; the others are 0.
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
            account.push(&mut self.mesh.indices, [first, previous, next], "the triangles")?;
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
        account.push(&mut mesh.positions, self.positions[v as usize], "the vertices")?;
        if uvs || lightmap {
            account.push(&mut mesh.uvs, self.uvs[vt as usize], "the texture coordinates")?;
        }
        if normals {
            account.push(&mut mesh.normals, self.normals[vn as usize], "the normals")?;
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
            mesh.lightmap = Some(LightmapUvs { uvs: std::mem::take(&mut mesh.uvs), pages });
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
                false => MeshMaterials::PerTriangle(names),
            };
            self.import.add_mesh(mesh)?;
        }
        self.warn();
        Ok(())
    }

    /// Adds the materials that faces use, in the order of their names' first use, and returns the
    /// material of each name. Names without a description share one grey material.
    fn add_materials(&mut self) -> Result<Vec<u32>> {
        let mut by_entry = HashMap::<Option<&[u8]>, u32>::new();
        let mut materials = vec![NONE; self.names.len()];
        let (mut unknown, mut images) = (Vec::new(), Images::new());
        for (name, material) in self.names.iter().zip(&mut materials).filter(|(name, _)| name.faces > 0) {
            let base = base_name(&name.text);
            let (key, entry) = match (self.library.get(&name.text), self.library.get(base)) {
                (Some(entry), _) => (Some(&name.text[..]), entry.clone()),
                (None, Some(entry)) => (Some(base), entry.clone()),
                (None, None) => (None, mtl::Entry::default()),
            };
            if key.is_none() && !name.text.is_empty() {
                unknown.push(String::from_utf8_lossy(base));
            }
            *material = match by_entry.get(&key) {
                Some(id) => *id,
                None => {
                    let material = described(self.import, &mut images, &entry)?;
                    let id = self.import.add_material(material)?;
                    by_entry.insert(key, id);
                    id
                }
            };
        }
        unknown.sort();
        unknown.dedup();
        if let [first, ..] = &unknown[..] {
            let what = format!("{} materials have no description (first: {first:?}) and are grey", unknown.len());
            self.import.warn(what);
        }
        Ok(materials)
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

/// Texture and alpha cutoff by the files of `map_Kd` and `map_d`.
type Images = HashMap<(Option<MapFile>, Option<MapFile>), (u32, f32)>;

/// The material of a library's entry.
fn described(import: &mut Import, images: &mut Images, entry: &mtl::Entry) -> Result<Material> {
    let maps = (entry.color_map.clone(), entry.alpha_map.clone());
    let (albedo_texture, alpha_cutoff) = match images.get(&maps) {
        Some(known) => *known,
        None => {
            let image = add_image(import, &maps.0, &maps.1)?;
            *images.entry(maps).or_insert(image)
        }
    };
    // Where a map gives the colour, the factor is white unless said.
    let grey = if entry.color_map.is_some() && albedo_texture != NONE { 1.0 } else { DEFAULT_ALBEDO };
    let emits = entry.emission.iter().any(|&e| e > 0.0);
    Ok(Material {
        albedo: entry.albedo.unwrap_or([grey; 3]),
        emission: entry.emission,
        two_sided: TWO_SIDED_UNLESS_SAID,
        albedo_texture,
        alpha_cutoff: if emits { 0.0 } else { alpha_cutoff },
        transmission: entry.transmission(),
    })
}

/// Reads the images of a material into one; [`NONE`] without any.
fn add_image(import: &mut Import, color: &Option<MapFile>, alpha: &Option<MapFile>) -> Result<(u32, f32)> {
    let mut read = |file: &Option<MapFile>| match file {
        Some(file) => {
            let image = texture::read(import, &file.folder, &file.name);
            import.image(&file.name, image)
        }
        None => Ok(None),
    };
    let colors = read(color)?;
    let alphas = if alpha == color { None } else { read(alpha)? };
    let image = match (colors, alphas) {
        (colors, Some(alpha)) => {
            let both = texture::with_alpha(colors, &alpha, &mut import.account)?;
            import.account.give_back(alpha.bytes());
            both
        }
        (Some(colors), None) => colors,
        (None, None) => return Ok((NONE, 0.0)),
    };
    let cutoff = if texture::is_opaque(&image) { 0.0 } else { texture::CUTOFF };
    Ok((import.add_texture(texture::flipped(image))?, cutoff))
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

/// What the `vt` of a material's faces are: `…|lmN` says light map page N, a negative N nothing.
fn coordinates_of(name: &[u8]) -> std::result::Result<Coordinates, String> {
    let suffix: Range<usize> = (base_name(name).len() + 1).min(name.len())..name.len();
    match name[suffix].strip_prefix(b"lm").and_then(integer) {
        None => Ok(Coordinates::Texture),
        Some(page) if page < 0 => Ok(Coordinates::Nothing),
        Some(page) if page < MAX_PAGES => Ok(Coordinates::Lightmap(page as u32)),
        Some(page) => Err(format!("light map page {page} is not below {MAX_PAGES}")),
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::io::source::Files;
    use crate::io::tests::{Folder, albedos, corners, load_bytes, load_path, refusal};
    use crate::io::{LoadInfo, LoadOptions};
    use crate::scene::SceneData;

    /// A bit of everything.
    pub const SAMPLE: &str = "# sample
mtllib a.mtl
o thing
v 0 0 0
v 1 0 0 1.0
v 1 1 0 0.5 0.5 0.5
v 0 1 0
vt 0 0
vt 1 0
vt 1 1 0
vt 0 1
vn 0 0 2
g part
usemtl wall
f 1/1/1 2/2/1 3/3/1 4/4/1
usemtl floor|lm2
f -4/1 -3/2 -2/3
usemtl floor|lm-3
f 1/1 3/3 4/4
f 1//1 2//1 \\
  3//1 # continued
l 1 2
";

    fn load_with_library(obj: &str, mtl: &str) -> Result<(SceneData, LoadInfo)> {
        let folder = Folder::new();
        std::fs::write(folder.path("a.mtl"), mtl).unwrap();
        std::fs::write(folder.path("a.obj"), obj).unwrap();
        load_path(&folder.path("a.obj"))
    }

    #[test]
    fn polygons_become_fans_in_file_order() {
        let (scene, info) =
            load_bytes("a.obj", "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0.5 2 0\nv 0 1 0\nf 1 2 3\nf 1 2 3 4 5\nf 3 1 2\n")
                .unwrap();
        assert_eq!(info.faces_triangulated, 1);
        assert_eq!(scene.meshes().len(), 1);
        let triangles = [[0, 1, 2], [0, 1, 2], [0, 2, 3], [0, 3, 4], [2, 0, 1]];
        assert_eq!(scene.meshes()[0].indices, triangles);
        assert_eq!(scene.meshes()[0].positions.len(), 5);
        assert!(scene.meshes()[0].normals.is_empty() && scene.meshes()[0].uvs.is_empty());
    }

    #[test]
    fn meshes_split_where_normals_and_coordinates_begin_and_end() {
        let (scene, info) = load_bytes("a.obj", SAMPLE).unwrap();
        let kinds: Vec<_> = scene
            .meshes()
            .iter()
            .map(|m| (m.indices.len(), m.uvs.len(), m.normals.len(), m.lightmap.as_ref().map(|l| l.uvs.len())))
            .collect();
        assert_eq!(kinds, [(2, 4, 4, None), (1, 0, 0, Some(3)), (1, 0, 0, None), (1, 0, 3, None)]);
        assert_eq!(scene.meshes()[0].normals[0], Vec3::Z);
        assert_eq!(scene.meshes()[0].uvs[3], Vec2::new(0.0, 1.0));
        let lightmap = scene.meshes()[1].lightmap.as_ref().unwrap();
        assert_eq!((&lightmap.pages[..], lightmap.uvs[2]), (&[2][..], Vec2::ONE));
        assert_eq!(corners(&scene)[2], [Vec3::ZERO, Vec3::X, Vec3::new(1.0, 1.0, 0.0)]);
        assert!(info.has_lightmap_uvs);
        assert_eq!(info.warnings.len(), 3, "{:?}", info.warnings);
        assert!(info.warnings[0].starts_with("the material library \"a.mtl\" cannot be opened"));
        assert_eq!(info.warnings[1], "2 materials have no description (first: \"floor\") and are grey");
        assert_eq!(info.warnings[2], "1 points, lines and free forms were ignored");
        assert_eq!(albedos(&scene), [[DEFAULT_ALBEDO; 3]; 5]);
    }

    #[test]
    fn vertices_are_shared_unless_their_coordinates_differ() {
        let head = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 0.5 0\n";
        let vertices = |faces: &str| load_bytes("a.obj", format!("{head}{faces}")).unwrap().1.vertices;
        assert_eq!(vertices("f 1 2 3\nf 1 3 4\n"), 4);
        assert_eq!(vertices("f 1/1 2/1 3/1\nf 1/1 3/1 4/1\n"), 4);
        assert_eq!(vertices("f 1/1 2/1 3/1\nf 1/2 3/1 4/1\n"), 5);
        // Coordinates that mean nothing split nothing.
        assert_eq!(vertices("usemtl a|lm-1\nf 1/1 2/1 3/1\nf 1/2 3/1 4/1\n"), 4);
    }

    #[test]
    fn degenerate_faces_are_kept() {
        let (scene, info) = load_bytes("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 1 2\nf 1 2 3\nf 1 1 1\n").unwrap();
        assert_eq!(info.triangles, 3);
        assert_eq!(scene.meshes()[0].indices[0], [0, 0, 1]);
    }

    #[test]
    fn materials_come_from_the_exact_name_or_from_the_base_name() {
        let obj =
            "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl a|lm0\nf 1/1 2/1 3/1\nusemtl a|lm1\nf 1/1 2/1 3/1
usemtl a\nf 1 2 3\nusemtl a|x\nf 1 2 3\nusemtl unused\nusemtl b\nf 1 2 3\n";
        let mtl = "newmtl unused\nKd 1 1 1\nnewmtl a\nKd 1.5 -0.25 0.5\nnewmtl a|lm1\nKd 0.1 0.1 0.1\nmap_Kd x.png\nnewmtl b\nKe 1 2 3\n";
        let (scene, info) = load_with_library(obj, mtl).unwrap();
        let a = [0.98, 0.0, 0.5];
        assert_eq!(albedos(&scene), [a, [0.1; 3], a, a, [DEFAULT_ALBEDO; 3]]);
        assert_eq!((info.materials, info.albedos_clamped), (3, 1));
        let [warning] = &info.warnings[..] else { panic!("{:?}", info.warnings) };
        assert!(warning.starts_with("the image ") && warning.contains("x.png cannot be read ("), "{warning}");
        assert_eq!(scene.materials()[2].emission, [1.0, 2.0, 3.0]);
        assert!(scene.materials().iter().all(|m| m.two_sided == TWO_SIDED_UNLESS_SAID));
    }

    #[test]
    fn images_color_surfaces_and_cut_holes() {
        use crate::io::texture::tests::png;
        let folder = Folder::new();
        let (top, bottom) = ([255, 0, 0, 0], [0, 255, 0, 255]);
        std::fs::write(folder.path("leaf.png"), png(1, 2, &[top, bottom])).unwrap();
        std::fs::write(folder.path("mask.png"), png(2, 1, &[[0, 0, 0, 255], [255; 4]])).unwrap();
        std::fs::write(folder.path("solid.png"), png(1, 1, &[[255; 4]])).unwrap();
        let mtl = "newmtl leaf\nmap_Kd leaf.png\nmap_d leaf.png\nnewmtl bright\nKd 0.9\nKe 1\nmap_Kd leaf.png\n\
                   newmtl masked\nmap_d mask.png\nnewmtl solid\nKd 1 1 1\nmap_Kd solid.png\n\
                   newmtl glass\nKd 0.5\nTf 0.8 0.1 0.1\nillum 4\nnewmtl lost\nKd 0.3\nmap_Kd no.png\nmap_d no2.png\n";
        let mut obj = String::from("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0.25\n");
        for name in ["leaf", "bright", "masked", "solid", "glass", "lost"] {
            obj += &format!("usemtl {name}\nf 1/1 2/1 3/1\n");
        }
        std::fs::write(folder.path("a.mtl"), mtl).unwrap();
        std::fs::write(folder.path("a.obj"), obj).unwrap();
        let (scene, info) = load_path(&folder.path("a.obj")).unwrap();
        let m = scene.materials();
        assert_eq!((m[0].albedo, m[0].albedo_texture, m[0].alpha_cutoff), ([1.0; 3], 0, 0.5));
        // v = 0.25 is in the bottom row.
        assert_eq!(scene.textures()[0].alpha(scene.meshes()[0].uvs[0]), 1.0);
        assert_eq!(scene.textures()[0].rgba8, [bottom, top]);
        // Emits: no holes.
        assert_eq!((m[1].alpha_cutoff, m[1].albedo), (0.0, [0.9; 3]));
        assert_eq!((m[2].albedo, m[2].alpha_cutoff), ([DEFAULT_ALBEDO; 3], 0.5));
        assert_eq!(scene.textures()[m[2].albedo_texture as usize].rgba8, [[255, 255, 255, 0], [255; 4]]);
        assert_eq!((m[3].albedo, m[3].alpha_cutoff), ([1.0; 3], 0.0));
        assert_eq!((m[4].transmission, m[4].albedo), ([0.8, 0.1, 0.1], [0.2f32.min(1.0 - 0.8), 0.5, 0.5]));
        assert_eq!((m[5].albedo, m[5].albedo_texture, m[5].alpha_cutoff), ([0.3; 3], NONE, 0.0));
        assert_eq!((info.textures, info.albedos_clamped, info.warnings.len()), (4, 0, 2), "{:?}", info.warnings);
    }

    #[test]
    fn libraries_may_have_blanks_in_their_names_or_be_several() {
        let folder = Folder::new();
        std::fs::write(folder.path("a b.mtl"), "newmtl m\nKd 0.1\n").unwrap();
        std::fs::write(folder.path("c.mtl"), "newmtl m\nKd 0.2\n").unwrap();
        std::fs::write(folder.path("d.mtl"), "newmtl n\nKd 0.3\n").unwrap();
        for (libraries, m) in [("a b.mtl", 0.1), ("c.mtl  d.mtl", 0.2)] {
            let text = format!("mtllib {libraries}\nusemtl m\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n");
            std::fs::write(folder.path("a.obj"), text).unwrap();
            let (scene, info) = load_path(&folder.path("a.obj")).unwrap();
            assert_eq!((albedos(&scene)[0][0], info.warnings.len()), (m, 0));
        }
    }

    #[test]
    fn malformed_files_are_refused_with_the_line() {
        let after_triangle = |text: &str| refusal("a.obj", format!("v 0 0 0\nv 1 0 0\nv 0 1 0\n{text}"));
        assert_eq!(refusal("a.obj", ""), "there are no faces in it");
        assert_eq!(after_triangle("v 1 2 3\n"), "there are no faces in it");
        assert_eq!(after_triangle("f 1 2\n"), "line 4: a face has 2 corners, fewer than 3");
        assert_eq!(after_triangle("\nf\n"), "line 5: a face has 0 corners, fewer than 3");
        assert_eq!(after_triangle("f 1 2 4\n"), "line 4: a face names vertex 4, so far there are 3");
        assert_eq!(after_triangle("f 1 2 -4\n"), "line 4: a face names vertex -4, so far there are 3");
        assert_eq!(after_triangle("f 0 1 2\n"), "line 4: a face names vertex 0, so far there are 3");
        assert_eq!(after_triangle("f 1/1 2 3\n"), "line 4: a face names texture coordinate 1, so far there are 0");
        assert_eq!(after_triangle("f 1//7 2 3\n"), "line 4: a face names normal 7, so far there are 0");
        assert_eq!(after_triangle("f 1 2 x\n"), "line 4: a face has the corner \"x\"");
        assert_eq!(after_triangle("f 1 2 3/ / /\n"), "line 4: a face has the corner \"/\"");
        assert_eq!(after_triangle("f 1 2 3///1\n"), "line 4: a face has the corner \"3///1\"");
        assert_eq!(after_triangle("v 1 nan 3\n"), "line 4: v contains \"nan\", not a finite number");
        assert_eq!(after_triangle("v 1 1e39 3\n"), "line 4: v contains \"1e39\", not a finite number");
        assert_eq!(after_triangle("v 1 2\n"), "line 4: v has 2 numbers, not 3");
        assert_eq!(after_triangle("v 1 2 1e20\n"), "line 4: the vertex [1, 2, 100000000000000000000] is out of range");
        assert_eq!(after_triangle("vt inf 0\n"), "line 4: vt contains \"inf\", not a finite number");
        assert_eq!(after_triangle("vn 0 0\n"), "line 4: vn has 2 numbers, not 3");
        assert_eq!(after_triangle("usemtl a|lm99999\n"), "line 4: light map page 99999 is not below 4096");
        assert_eq!(after_triangle("# a \\\n b\nf 1 2\n"), "line 6: a face has 2 corners, fewer than 3");
    }

    #[test]
    fn a_kind_of_face_that_changes_often_costs_what_its_faces_do() {
        // A large mesh, then faces with and without normals in turn.
        let mut text = String::from("vn 0 0 1\n");
        (0..3000).for_each(|i| text += &format!("v {i} 0 0\nv {i} 1 0\nv {i} 0 1\n"));
        (0..3000).for_each(|i| text += &format!("f {} {} {}\n", 3 * i + 1, 3 * i + 2, 3 * i + 3));
        text += "f 1//1 2//1 3//1\nf 1 2 3\nf 1//1 2//1 3//1\n";
        let folder = Folder::new();
        std::fs::write(folder.path("a.obj"), text).unwrap();
        let options = LoadOptions::default();
        let mut files = Files::new(&folder.path("a.obj"), &options).unwrap();
        let opened = files.open_scene(&folder.path("a.obj")).unwrap();
        let advance = |_| Ok(());
        let mut import = Import::new(&folder.path("a.obj"), &options, files, &advance).unwrap();
        let mut source = Source::new(opened, import.advance);
        let mut reader = Reader::new(&mut import);
        reader.read(&mut source).unwrap();
        // To clear a map takes as long as it has room.
        assert!(reader.vertex_of.capacity() < 100, "{}", reader.vertex_of.capacity());
    }

    #[test]
    fn a_library_that_is_named_often_is_read_once() {
        let folder = Folder::new();
        std::fs::write(folder.path("a.mtl"), format!("newmtl a\nKd 0.25\n#{}\n", "x".repeat(1000))).unwrap();
        std::fs::write(
            folder.path("a.obj"),
            "mtllib a.mtl\n".repeat(500) + "v 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl a\nf 1 2 3\n",
        )
        .unwrap();
        let options = LoadOptions { max_file_bytes: 10_000, ..Default::default() };
        let mut scene = SceneData::new();
        crate::io::load_with(&folder.path("a.obj"), &options, &crate::Progress::none(), &mut scene).unwrap();
        assert_eq!(albedos(&scene), [[0.25; 3]]);
    }

    #[test]
    fn malformed_libraries_are_refused_with_the_line() {
        let Err(Error::Io(message)) = load_with_library("mtllib a.mtl\n", "newmtl a\nKd 1 x 1\n") else { panic!() };
        assert!(message.ends_with("a.mtl, line 2: Kd contains \"x\", not a finite number"), "{message}");
    }

    #[test]
    fn faces_that_name_a_page_without_coordinates_are_counted() {
        let (scene, info) =
            load_bytes("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl a|lm1\nf 1/1 2/1 3\n").unwrap();
        assert!(scene.meshes()[0].lightmap.is_none());
        assert_eq!(info.warnings[1], "1 faces name a light map page but have no texture coordinates");
    }
}
