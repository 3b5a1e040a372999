//! `include/bakelite.h` is generated from `src/capi` and committed. A test generates it again
//! and fails on a difference; `BAKELITE_UPDATE_HEADER=1 cargo test -p bakelite-header` writes it.
//! `check_header.py` judges what it says, `abi.py` whether it is still the same interface.
//!
//! cbindgen sorts a file's items by kind (constants, types, functions). So that the header reads by
//! subject, it is made section by section: one per source file, headed by the file's `//!` text.

use cbindgen::{
    Builder, Config, DocumentationLength, DocumentationStyle, ExportConfig, FunctionConfig, Language, SortKey, Style,
};
use std::path::Path;

/// The sections of the header, in order.
const SECTIONS: [&str; 14] = [
    "error",
    "device",
    "scene",
    "files",
    "textures",
    "meshes",
    "instances",
    "lights",
    "rays",
    "photons",
    "lightmap",
    "bake",
    "read",
    "live",
];

const HEAD: &str = "\
/**
 * @file bakelite.h
 * Bakelite: SIMD light-baking kernels.
 *
 * A bake takes these calls, each of which is described below:
 *
 *     bk_device_create      threads and instruction set
 *     bk_scene_create       then bk_scene_load_file, or bk_scene_add_material, bk_scene_add_mesh
 *     bk_scene_add_light    lights that are not in the file
 *     bk_scene_commit       builds the acceleration structure; from here on bk_intersect works
 *     bk_lightmap_create    unwraps and lays out pages of texels
 *     bk_bake               computes the light
 *     bk_lightmap_read      texels, with bk_lightmap_mesh_uvs; or files: bk_lightmap_save
 *
 * bk_live_create refines the light of a scene while it is shown, instead of a bake.
 *
 * Generated from src/capi by cbindgen; do not edit. To update it:
 *     BAKELITE_UPDATE_HEADER=1 cargo test -p bakelite-header
 */
#ifndef BAKELITE_H
#define BAKELITE_H

#include <stddef.h>
#include <stdint.h>

/* Programs that link the static library on Windows define BK_STATIC. */
#ifndef BK_API
#if defined(_WIN32) && !defined(BK_STATIC)
#define BK_API __declspec(dllimport)
#else
#define BK_API
#endif
#endif

/* Declares functions that may still change: see the first section. */
#ifndef BK_EXPERIMENTAL
#define BK_EXPERIMENTAL BK_API
#endif

#ifdef __cplusplus
extern \"C\" {
#endif
";

const TAIL: &str = "
#ifdef __cplusplus
} /* extern \"C\" */
#endif

#endif /* BAKELITE_H */
";

/// Makes the text of the header from the sources of the library in the folder `root`.
pub fn header(root: &Path) -> String {
    let sections: Vec<String> =
        SECTIONS.iter().map(|name| section(&root.join(format!("src/capi/{name}.rs")))).collect();
    format!("{HEAD}{}{TAIL}", sections.concat())
}

fn section(source: &Path) -> String {
    let mut out = Vec::new();
    let bindings = Builder::new().with_config(config()).with_src(source).generate();
    bindings.unwrap_or_else(|e| panic!("{}: {e}", source.display())).write(&mut out);
    let items = String::from_utf8(out).expect("cbindgen writes UTF-8");
    format!("\n{}\n{}\n\n/** @}} */\n", heading(source), tidy(&items).trim_end())
}

/// The file's `//!` text below a ruler, as the head of a group for Doxygen. The first line is the title.
fn heading(source: &Path) -> String {
    let text = std::fs::read_to_string(source).expect("the source can be read");
    let mut head = text.lines().map_while(|l| l.strip_prefix("//!"));
    let name = source.file_stem().expect("a file").to_string_lossy().into_owned();
    let title = head.next().expect("a title").trim();
    let text: String = head.map(|l| format!(" *{l}\n")).collect();
    let ruler = "=".repeat(94);
    format!("/* {ruler} */\n/**\n * @defgroup {name} {title}\n{text} *\n * @{{\n */\n/* {ruler} */\n")
}

/// Types are known by their typedefs: drops the `struct` where it is not needed. Constants get the
/// look that C programmers expect: negative ones in parentheses, all bits set in hexadecimal.
///
/// Functions whose text has a paragraph that begins with "Experimental:" are declared so.
fn tidy(items: &str) -> String {
    let mut out = String::with_capacity(items.len());
    let mut experimental = false;
    for line in items.lines() {
        experimental |= line.starts_with("/// Experimental:");
        if line.starts_with("BK_API") {
            let api = if std::mem::take(&mut experimental) { "BK_EXPERIMENTAL" } else { "BK_API" };
            out += &line.replace("struct bk_", "bk_").replacen("BK_API", api, 1);
            out.push('\n');
            continue;
        }
        if let Some((name, value)) = line.strip_prefix("#define ").and_then(|l| l.split_once(' ')) {
            match value {
                "4294967295" => out += &format!("#define {name} 0xffffffffu\n"),
                _ if value.starts_with('-') => out += &format!("#define {name} ({value})\n"),
                _ => out += &format!("{line}\n"),
            }
            continue;
        }
        let definition = line.starts_with("typedef struct");
        out += &if definition { line.to_string() } else { line.replace("struct bk_", "bk_") };
        out.push('\n');
    }
    out
}

fn config() -> Config {
    Config {
        language: Language::C,
        style: Style::Both,
        no_includes: true,
        usize_is_size_t: true,
        // Comments that Doxygen reads.
        documentation_style: DocumentationStyle::Cxx,
        documentation_length: DocumentationLength::Full,
        // Used by other sections than the one that defines it.
        export: ExportConfig { include: vec!["bk_progress_fn".into()], ..Default::default() },
        line_length: 110,
        sort_by: SortKey::None,
        function: FunctionConfig { prefix: Some("BK_API".into()), sort_by: Some(SortKey::None), ..Default::default() },
        ..Default::default()
    }
}

#[cfg(test)]
mod tests {
    use super::header;
    use std::path::Path;

    #[test]
    fn the_committed_header_is_what_the_sources_say() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        let (path, header) = (root.join("include/bakelite.h"), header(&root));
        if std::env::var_os("BAKELITE_UPDATE_HEADER").is_some() {
            std::fs::write(&path, &header).expect("include/bakelite.h can be written");
        }
        let committed = std::fs::read_to_string(&path).unwrap_or_default();
        let difference = header.lines().zip(committed.lines()).position(|(a, b)| a != b);
        assert!(
            header == committed,
            "include/bakelite.h differs from src/capi, first at line {}: \
             run `BAKELITE_UPDATE_HEADER=1 cargo test -p bakelite-header` and commit it",
            difference.unwrap_or(header.lines().count().min(committed.lines().count())) + 1
        );
    }
}
