//! Files that are written here, as they should be and malformed, and the reader of `tobj`.

use super::*;
use crate::io::source::Files;
use crate::io::tests::{Folder, albedos, corners, load_bytes, load_path, refusal};
use crate::io::{DEFAULT_ALBEDO, LoadInfo, LoadOptions, TWO_SIDED_UNLESS_SAID};
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
        load_bytes("a.obj", "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0.5 2 0\nv 0 1 0\nf 1 2 3\nf 1 2 3 4 5\nf 3 1 2\n").unwrap();
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
    crate::io::load_with(&folder.path("a.obj"), &options, &crate::base::progress::Progress::none(), &mut scene)
        .unwrap();
    assert_eq!(albedos(&scene), [[0.25; 3]]);
}

#[test]
fn malformed_libraries_are_refused_with_the_line() {
    let Err(Error::Io(message)) = load_with_library("mtllib a.mtl\n", "newmtl a\nKd 1 x 1\n") else { panic!() };
    assert!(message.ends_with("a.mtl, line 2: Kd contains \"x\", not a finite number"), "{message}");
}

#[test]
fn faces_that_name_a_page_without_coordinates_are_counted() {
    let (scene, info) = load_bytes("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl a|lm1\nf 1/1 2/1 3\n").unwrap();
    assert!(scene.meshes()[0].lightmap.is_none());
    assert_eq!(info.warnings[1], "1 faces name a light map page but have no texture coordinates");
}
