//! `include/bakelite.h` is generated from `src/capi` and committed. This test generates it again
//! and fails on a difference; `BAKELITE_UPDATE_HEADER=1 cargo test --test header` writes it.
//!
//! cbindgen sorts a file's items by kind (constants, types, functions). So that the header reads by
//! subject, it is made section by section: one per source file, headed by the file's `//!` text.

use cbindgen::{
    Builder, Config, DocumentationLength, DocumentationStyle, ExportConfig, FunctionConfig, Language, SortKey, Style,
};
use std::path::Path;

/// The sections of the header, in order.
const SECTIONS: [&str; 12] =
    ["error", "device", "scene", "textures", "meshes", "lights", "rays", "photons", "lightmap", "bake", "read", "live"];

const HEAD: &str = "\
/*
 * Bakelite: SIMD light-baking kernels.
 *
 * Generated from src/capi by cbindgen; do not edit. To update it:
 *     BAKELITE_UPDATE_HEADER=1 cargo test --test header
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

#[test]
fn the_committed_header_is_what_the_sources_say() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let path = root.join("include/bakelite.h");
    let sections: Vec<String> =
        SECTIONS.iter().map(|name| section(&root.join(format!("src/capi/{name}.rs")))).collect();
    let header = format!("{HEAD}{}{TAIL}", sections.concat());
    if std::env::var_os("BAKELITE_UPDATE_HEADER").is_some() {
        std::fs::write(&path, &header).expect("include/bakelite.h can be written");
    }
    let committed = std::fs::read_to_string(&path).unwrap_or_default();
    let difference = header.lines().zip(committed.lines()).position(|(a, b)| a != b);
    assert!(
        header == committed,
        "include/bakelite.h differs from src/capi, first at line {}: \
         run `BAKELITE_UPDATE_HEADER=1 cargo test --test header` and commit it",
        difference.unwrap_or(header.lines().count().min(committed.lines().count())) + 1
    );
}

fn section(source: &Path) -> String {
    let mut out = Vec::new();
    let bindings = Builder::new().with_config(config()).with_src(source).generate();
    bindings.unwrap_or_else(|e| panic!("{}: {e}", source.display())).write(&mut out);
    let items = String::from_utf8(out).expect("cbindgen writes UTF-8");
    format!("\n{}\n{}", heading(source), tidy(&items))
}

/// The file's `//!` text between rulers.
fn heading(source: &Path) -> String {
    let text = std::fs::read_to_string(source).expect("the source can be read");
    let head: Vec<String> = text.lines().map_while(|l| l.strip_prefix("//!")).map(|l| format!(" *{l}\n")).collect();
    format!("/* {0}\n{1} * {0} */\n", "=".repeat(96), head.concat())
}

/// Types are known by their typedefs: drops the `struct` where it is not needed. Constants get the
/// look that C programmers expect: negative ones in parentheses, all bits set in hexadecimal.
fn tidy(items: &str) -> String {
    let mut out = String::with_capacity(items.len());
    for line in items.lines() {
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
        documentation_style: DocumentationStyle::C99,
        documentation_length: DocumentationLength::Full,
        // Used by other sections than the one that defines it.
        export: ExportConfig { include: vec!["bk_progress_fn".into()], ..Default::default() },
        line_length: 110,
        sort_by: SortKey::None,
        function: FunctionConfig { prefix: Some("BK_API".into()), sort_by: Some(SortKey::None), ..Default::default() },
        ..Default::default()
    }
}
