//! What README.md and docs/ show is what the tests compile, and their links lead somewhere.
//!
//! A block of C or C++ with an `#include` is a file of its own, and one that starts with `static` one of functions. Any
//! other is a few statements, which are compiled inside a function with the variables of [`FUNCTION`].

use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::process::Command;

/// The Rust program of README.md. It reads a file, so it is not run.
#[cfg(feature = "io")]
#[allow(dead_code)]
#[path = "example.rs"]
mod example;

/// What functions shown in the documents may take for granted.
const HEADERS: &str = "\
#include <bakelite.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
";

/// What statements shown in the documents may take for granted, as docs/guide.md says at its start.
const FUNCTION: &str = "\
void check(bk_result result);
int32_t progress(void *user, float fraction, const char *stage);
void upload(uint32_t page, uint32_t x, uint32_t y, uint32_t width, uint32_t height, const void *rgba16f);
int running(void);
void snippet(bk_device *device, bk_scene *scene, bk_lightmap *map, bk_live *live, const float *vertices,
             size_t vertex_count, const uint32_t *triangles, size_t triangle_count, void *pixels);
void snippet(bk_device *device, bk_scene *scene, bk_lightmap *map, bk_live *live, const float *vertices,
             size_t vertex_count, const uint32_t *triangles, size_t triangle_count, void *pixels)
{
    (void)device, (void)scene, (void)map, (void)live, (void)vertices, (void)vertex_count, (void)triangles;
    (void)triangle_count, (void)pixels;
    {
";

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

/// README.md and what belongs to it, by path from the root.
fn documents() -> Vec<PathBuf> {
    let mut found: Vec<PathBuf> = ["README.md", "CONTRIBUTING.md", "SECURITY.md"]
        .iter()
        .map(PathBuf::from)
        .filter(|p| root().join(p).exists())
        .collect();
    let docs = std::fs::read_dir(root().join("docs")).unwrap().map(|e| Path::new("docs").join(e.unwrap().file_name()));
    found.extend(docs.filter(|p| p.extension().is_some_and(|e| e == "md")));
    found.sort();
    found
}

fn read(document: &Path) -> String {
    std::fs::read_to_string(root().join(document)).unwrap()
}

/// Fenced blocks in `language`, each with the line that it starts in.
fn blocks(text: &str, language: &str) -> Vec<(usize, String)> {
    let mut found = Vec::new();
    let mut lines = text.lines().enumerate();
    while let Some((_, line)) = lines.next() {
        let Some(opened) = line.strip_prefix("```") else { continue };
        let mut block = String::new();
        let mut first = None;
        for (number, line) in lines.by_ref().take_while(|(_, l)| *l != "```") {
            first.get_or_insert(number + 1);
            block += line;
            block.push('\n');
        }
        if opened == language {
            found.push((first.unwrap(), block));
        }
    }
    found
}

#[test]
fn programs_shown_are_the_files_that_stand_beside_the_tests() {
    let rust = blocks(&read(Path::new("README.md")), "rust");
    assert_eq!(rust.len(), 1);
    assert_eq!(rust[0].1, include_str!("example.rs"));
    let c = blocks(&read(Path::new("docs/guide.md")), "c");
    assert_eq!(c.first().map(|b| b.1.as_str()), Some(include_str!("../../examples/bake.c")));
}

#[cfg(unix)]
#[test]
fn blocks_of_c_compile_without_a_warning() {
    let folder = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("snippets");
    std::fs::create_dir_all(&folder).unwrap();
    let (mut count, mut wrong) = (0, String::new());
    for (language, extension, standard, compiler) in
        [("c", "c", "c99", ["CC", "cc"]), ("cpp", "cpp", "c++17", ["CXX", "c++"])]
    {
        let compiler = std::env::var(compiler[0]).unwrap_or(compiler[1].into());
        for document in documents() {
            for (line, block) in blocks(&read(&document), language) {
                let name = document.file_stem().unwrap().to_str().unwrap();
                let file = folder.join(format!("{name}-{line}.{extension}"));
                let shown = format!("#line {line} \"{}\"\n{block}", document.display());
                let source = if block.contains("#include") {
                    shown
                } else if block.starts_with("static") {
                    format!("{HEADERS}{shown}")
                } else {
                    format!("{HEADERS}{FUNCTION}{shown}    }}\n}}\n")
                };
                std::fs::write(&file, source).unwrap();
                let result = Command::new(&compiler)
                    .args(["-fsyntax-only", "-Wall", "-Wextra", "-Werror", "-pedantic", "-Wno-unused-function"])
                    .arg(format!("-std={standard}"))
                    .arg("-I")
                    .arg(root().join("include"))
                    .arg(&file)
                    .output()
                    .unwrap_or_else(|e| panic!("{compiler}: {e}"));
                count += 1;
                if !result.status.success() {
                    wrong += &String::from_utf8_lossy(&result.stderr);
                }
            }
        }
    }
    assert!(wrong.is_empty(), "{wrong}");
    assert!(count > 10, "there are only {count} blocks of C and C++");
}

/// What C++ lacks to take a function in GLSL for one of its own.
#[cfg(unix)]
const GLSL: &str = "\
#include <cmath>
#include <cstdio>
struct vec3 { float x, y, z; };
static vec3 operator+(vec3 a, vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
static vec3 operator-(vec3 a, vec3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
static vec3 operator*(vec3 a, vec3 b) { return {a.x * b.x, a.y * b.y, a.z * b.z}; }
static vec3 operator/(vec3 a, vec3 b) { return {a.x / b.x, a.y / b.y, a.z / b.z}; }
static vec3 all(float f) { return {f, f, f}; }
static vec3 operator*(float f, vec3 a) { return all(f) * a; }
static vec3 operator/(vec3 a, float f) { return a / all(f); }
static vec3 operator-(float f, vec3 a) { return all(f) - a; }
static vec3 operator-(vec3 a, float f) { return a - all(f); }
static float dot(vec3 a, vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
static float length(vec3 a) { return std::sqrt(dot(a, a)); }
static float max(float a, float b) { return a > b ? a : b; }
static vec3 max(vec3 a, float f) { return {max(a.x, f), max(a.y, f), max(a.z, f)}; }
static float clamp(float a, float low, float high) { return a < low ? low : a > high ? high : a; }
static vec3 clamp(vec3 a, float l, float h) { return {clamp(a.x, l, h), clamp(a.y, l, h), clamp(a.z, l, h)}; }
static vec3 sqrt(vec3 a) { return {std::sqrt(a.x), std::sqrt(a.y), std::sqrt(a.z)}; }
";

/// Reads three vectors E, L0, L1 and the normals, and writes what the three functions of the shader make of them; ratios
/// and directions go the way through 8 bits.
#[cfg(unix)]
const SHADES: &str = "\
static vec3 read() { vec3 v; if (std::scanf(\"%f %f %f\", &v.x, &v.y, &v.z) != 3) throw 1; return v; }
static void write(vec3 v) { std::printf(\"%.9g %.9g %.9g\\n\", v.x, v.y, v.z); }
int main() {
    int count;
    for (std::scanf(\"%d\", &count); count > 0; count--) {
        const vec3 E = read(), L0 = read(), x = read(), y = read(), z = read(), n = read(), m = read();
        const vec3 r = read(), s = read(), t = read(), d = read();
        write(irradiance_on(E, L0, x, y, z, n, m));
        write(irradiance_on_ratios(E, L0, r / 255.0f, s / 255.0f, t / 255.0f, n, m));
        write(irradiance_on_direction(E, d / 255.0f, n, m));
    }
}
";

/// The shader, taken for C++, gives what the function in Rust gives; the guide shows it as it is.
#[cfg(unix)]
#[test]
fn the_shader_for_normal_maps_is_the_function_of_the_library() {
    use bakelite::lightmap::normal_maps::irradiance_on;
    use bakelite::lightmap::packed_ratio;
    use bakelite::sampling::{uniform, uniform_sphere};
    use glam::Vec3;
    use std::io::Write;
    use std::process::Stdio;
    let shader = read(Path::new("examples/light_by_direction.glsl"));
    let shown = blocks(&read(Path::new("docs/guide.md")), "glsl");
    let shown = shown.iter().find(|b| b.1.contains("irradiance_on(")).expect("the guide shows the shader");
    assert!(shader.contains(&shown.1), "the guide shows another shader than the file has");
    let folder = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("snippets");
    std::fs::create_dir_all(&folder).unwrap();
    let (source, program) = (folder.join("shader.cpp"), folder.join("shader"));
    std::fs::write(&source, format!("{GLSL}{shader}{SHADES}")).unwrap();
    let compiler = std::env::var("CXX").unwrap_or("c++".into());
    let result = Command::new(&compiler).args(["-std=c++17", "-O1", "-o"]).arg(&program).arg(&source).output().unwrap();
    assert!(result.status.success(), "{}", String::from_utf8_lossy(&result.stderr));

    let (mut input, mut expected) = (String::from("500\n"), Vec::new());
    for i in 0..500 {
        let random = |k| Vec3::new(uniform(i, k, 0), uniform(i, k, 1), uniform(i, k, 2));
        let sphere = |k| uniform_sphere([uniform(i, k, 3), uniform(i, k, 4)]);
        let (e, l0, n) = (5.0 * random(0), random(1), sphere(2));
        let m = (n + 0.7 * uniform(i, 3, 0) * sphere(4)).normalize();
        let direction = (n + sphere(5)).normalize_or_zero() * uniform(i, 6, 0);
        let l1 = [0, 1, 2].map(|axis| l0 * (direction[axis] + 0.1 * (random(7)[axis] - 0.5)));
        // Bytes as the library writes them, and as a texture gives them.
        let bytes = |v: Vec3| v.to_array().map(packed_ratio);
        let unpacked = |b: [u8; 3]| Vec3::from(b.map(|b| f32::from(b) / 127.5 - 1.0));
        let ratios = l1.map(|x| bytes(x / l0.max(Vec3::splat(1e-12))));
        let d = bytes(direction);
        for v in [e, l0, l1[0], l1[1], l1[2], n, m] {
            input += &format!("{} {} {}\n", v.x, v.y, v.z);
        }
        for [r, g, b] in ratios.into_iter().chain([d]) {
            input += &format!("{r} {g} {b}\n");
        }
        expected.push(irradiance_on(e, l0, l1, n, m));
        expected.push(irradiance_on(e, l0, ratios.map(|r| unpacked(r) * l0), n, m));
        let towards = unpacked(d);
        let l0 = e / (4.0 * std::f32::consts::PI * towards.dot(n).max(0.1));
        expected.push(irradiance_on(e, l0, towards.to_array().map(|x| x * l0), n, m));
    }
    let mut run = Command::new(&program).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    let mut stdin = run.stdin.take().unwrap();
    std::thread::spawn(move || stdin.write_all(input.as_bytes()).unwrap());
    let output = String::from_utf8(run.wait_with_output().unwrap().stdout).unwrap();
    let shaded: Vec<f32> = output.split_whitespace().map(|word| word.parse().unwrap()).collect();
    assert_eq!(shaded.len(), 3 * expected.len());
    for (i, (got, expected)) in shaded.chunks_exact(3).map(Vec3::from_slice).zip(&expected).enumerate() {
        assert!(expected.is_finite() && (got - *expected).abs().max_element() < 2e-4, "{i}: {got} for {expected}");
    }
}

/// Where GitHub puts the headings of a text: in lower case, without punctuation, with hyphens for spaces.
fn anchors(text: &str) -> HashSet<String> {
    let mut fenced = false;
    let mut found = HashSet::new();
    for line in text.lines() {
        fenced ^= line.starts_with("```");
        if line.starts_with('#') && !fenced {
            let heading = line.trim_start_matches('#').trim().to_lowercase();
            let kept = heading.chars().filter(|c| c.is_alphanumeric() || matches!(c, ' ' | '-' | '_'));
            found.insert(kept.map(|c| if c == ' ' { '-' } else { c }).collect());
        }
    }
    found
}

#[test]
fn links_between_documents_lead_to_files_and_headings() {
    let mut wrong = Vec::new();
    let mut count = 0;
    for document in documents() {
        let text = read(&document);
        // Code is no text: C++ has `](` in closures.
        let prose: String = text.split("\n```").step_by(2).collect();
        for link in prose.split("](").skip(1).filter_map(|rest| rest.split_once(')')).map(|(link, _)| link) {
            if link.contains("://") || link.starts_with("mailto:") {
                continue;
            }
            count += 1;
            let (path, anchor) = link.split_once('#').map_or((link, None), |(p, a)| (p, Some(a)));
            let target = match path {
                "" => document.clone(),
                _ => document.parent().unwrap().join(path),
            };
            let leads = root().join(&target).exists() && anchor.is_none_or(|a| anchors(&read(&target)).contains(a));
            if !leads {
                wrong.push(format!("{}: {link}", document.display()));
            }
        }
    }
    assert!(count > 0);
    assert!(wrong.is_empty(), "{wrong:#?}");
}

/// The Rust files below a folder.
fn sources(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(root().join(folder)).unwrap() {
        let path = folder.join(entry.unwrap().file_name());
        if root().join(&path).is_dir() {
            sources(&path, found);
        } else if path.extension().is_some_and(|e| e == "rs") {
            found.push(path);
        }
    }
}

#[test]
fn comments_point_to_sections_that_documents_have() {
    let mut files = Vec::new();
    sources(Path::new("src"), &mut files);
    let (mut wrong, mut count) = (Vec::new(), 0);
    for file in files {
        for rest in read(&file).split("docs/").skip(1) {
            let end = rest.find(|c: char| !(c.is_alphanumeric() || "._-#".contains(c))).unwrap_or(rest.len());
            let Some((document, anchor)) = rest[..end].trim_end_matches('.').split_once('#') else { continue };
            count += 1;
            let document = Path::new("docs").join(document);
            if !root().join(&document).exists() || !anchors(&read(&document)).contains(anchor) {
                wrong.push(format!("{}: {}#{anchor}", file.display(), document.display()));
            }
        }
    }
    assert!(count >= 5, "only {count} comments point to documents");
    assert!(wrong.is_empty(), "{wrong:#?}");
}

/// Paths of the repository in code of a text.
fn paths(text: &str) -> impl Iterator<Item = &str> {
    let code = text.split('`').skip(1).step_by(2);
    code.filter(|c| {
        ["src/", "capi-tests/", "examples/", "benches/", "fuzz/", "cmake/", "include/", "docs/"]
            .iter()
            .any(|f| c.starts_with(f))
    })
    .filter(|c| c.chars().all(|c| c.is_alphanumeric() || "/._-".contains(c)))
}

#[test]
fn files_that_documents_name_are_there() {
    let mut wrong = Vec::new();
    let mut count = 0;
    for document in documents() {
        let text = read(&document);
        // Without fenced blocks, whose marks would be taken for code.
        let mut fenced = false;
        let prose = text.lines().filter(|line| {
            let mark = line.starts_with("```");
            fenced ^= mark;
            !fenced && !mark
        });
        for path in paths(&prose.collect::<Vec<_>>().join("\n")) {
            count += 1;
            if !root().join(path).exists() {
                wrong.push(format!("{}: {path}", document.display()));
            }
        }
    }
    assert!(count > 100, "only {count} files are named");
    assert!(wrong.is_empty(), "{wrong:#?}");
}

/// The last section of docs/architecture.md: rows of a question, a path, and words that the file there has.
#[test]
fn one_guess_at_a_path_answers_each_question_of_a_fresh_reader() {
    let text = read(Path::new("docs/architecture.md"));
    let (_, section) = text.split_once("## A fresh reader's test").unwrap();
    let rows: Vec<Vec<&str>> = section
        .lines()
        .filter(|l| l.starts_with("| ") && l.contains("`src/"))
        .map(|l| l.split('|').map(str::trim).collect())
        .collect();
    assert!(rows.len() >= 10, "there are {} questions", rows.len());
    for row in rows {
        let (question, path, words) = (row[1], row[2].trim_matches('`'), row[3].trim_matches('`'));
        let file = std::fs::read_to_string(root().join(path)).unwrap_or_else(|e| panic!("{question} {path}: {e}"));
        assert!(file.contains(words), "{question} {path} does not have \"{words}\"");
    }
}

#[test]
fn the_readme_fits_a_few_screens() {
    let bytes = read(Path::new("README.md")).len();
    assert!(bytes <= 10_240, "README.md has {bytes} bytes: what is not for everybody belongs to docs/");
}
