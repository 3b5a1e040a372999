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
