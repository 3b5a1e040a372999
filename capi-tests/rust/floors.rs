//! Each module (floor) of the library imports only from those above it in docs/architecture.md, and no
//! two folders or files import each other in a circle. Nor do those of the command line.
//!
//! Paths that begin with `crate::` or `super::` are looked at, tests apart. What `lib.rs` re-exports is for users of
//! the library: inside, imports name the module that an item is defined in.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// From the top: light flows downwards, imports go upwards in this list.
const FLOORS: &[&str] = &[
    "base",
    "simd",
    "device",
    "bvh",
    "scene",
    "trace",
    "photon",
    "direct",
    "lightmap",
    "live",
    "reference",
    "io",
    "capi",
];

/// A file of the library, by its module path.
struct File {
    path: PathBuf,
    module: Vec<String>,
    /// Without comments and tests.
    text: String,
}

/// A crate whose files are looked at.
#[derive(Clone, Copy)]
enum Crate {
    Library,
    CommandLine,
}

impl Crate {
    fn root(self) -> PathBuf {
        let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
        match self {
            Crate::Library => source,
            Crate::CommandLine => source.join("bin/bakelite"),
        }
    }
}

fn files(of: Crate) -> Vec<File> {
    let root = of.root();
    let (mut folders, mut found) = (vec![root.clone()], Vec::new());
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).unwrap() {
            let path = entry.unwrap().path();
            let relative = path.strip_prefix(&root).unwrap();
            if relative.starts_with("bin") || relative == Path::new("lib.rs") || relative == Path::new("main.rs") {
                continue;
            }
            if path.is_dir() {
                folders.push(path);
                continue;
            }
            let mut module: Vec<String> =
                relative.with_extension("").iter().map(|s| s.to_str().unwrap().to_owned()).collect();
            if module.last().unwrap() == "mod" {
                module.pop();
            }
            if module.last().unwrap() == "tests" {
                continue;
            }
            let text = without_tests(&std::fs::read_to_string(&path).unwrap());
            found.push(File { path, module, text });
        }
    }
    found.sort_by(|a, b| a.module.cmp(&b.module));
    let least = match of {
        Crate::Library => 100,
        Crate::CommandLine => 25,
    };
    assert!(found.len() > least, "{} files", found.len());
    found
}

/// The text up to the module of tests, which is the last item of a file, without items for tests alone and comments.
fn without_tests(text: &str) -> String {
    let end = text.find("#[cfg(test)]\nmod tests").or(text.find("#[cfg(test)]\npub(super) mod tests"));
    let mut out = String::new();
    let mut lines = text[..end.unwrap_or(text.len())].lines();
    while let Some(line) = lines.next() {
        if line.trim() == "#[cfg(test)]" {
            // An item at the same indentation, or one line.
            let indent = line.len() - line.trim_start().len();
            for line in lines.by_ref() {
                let ends = line.trim_end().ends_with([';', '}']) && line.len() - line.trim_start().len() == indent;
                if ends {
                    break;
                }
            }
            continue;
        }
        out.push_str(line.split("//").next().unwrap());
        out.push('\n');
    }
    out
}

/// The paths below the crate that a file names, each as its segments. `{a, b::c}` is taken apart.
fn paths(file: &File) -> BTreeSet<Vec<String>> {
    let mut found = BTreeSet::new();
    let text: String = file.text.clone();
    for (start, _) in text.match_indices("crate::") {
        let is_word = text[..start].chars().next_back().is_some_and(|c| c.is_alphanumeric() || c == '_' || c == '$');
        if !is_word {
            expand(&text[start + "crate::".len()..], &[], &mut found);
        }
    }
    for (start, _) in text.match_indices("super::") {
        // The first of a chain.
        let before = text[..start].trim_end();
        if before.ends_with("super::") || before.ends_with("in ") {
            continue;
        }
        let mut rest = &text[start..];
        let mut base = file.module.clone();
        base.pop();
        rest = rest.strip_prefix("super::").unwrap();
        while let Some(further) = rest.strip_prefix("super::") {
            base.pop();
            rest = further;
        }
        expand(rest, &base, &mut found);
    }
    found
}

fn expand(text: &str, before: &[String], found: &mut BTreeSet<Vec<String>>) {
    let word: String = text.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect();
    let mut path = before.to_vec();
    if word.is_empty() {
        let Some(inner) = text.strip_prefix('{') else {
            found.insert(path);
            return;
        };
        let (mut depth, mut start) = (1, 0);
        for (i, c) in inner.char_indices() {
            match c {
                '{' => depth += 1,
                '}' => depth -= 1,
                _ => {}
            }
            if depth == 0 || (depth == 1 && c == ',') {
                let item = inner[start..i].trim();
                if !item.is_empty() {
                    expand(item, before, found);
                }
                start = i + 1;
            }
            if depth == 0 {
                break;
            }
        }
        return;
    }
    path.push(word.clone());
    match text[word.len()..].strip_prefix("::") {
        Some(rest) => expand(rest, &path, found),
        None => {
            found.insert(path);
        }
    }
}

/// The floor of a path below the crate.
fn floor(path: &[String]) -> Option<usize> {
    let first = path.first()?;
    FLOORS.iter().position(|f| f == first)
}

#[test]
fn floors_import_only_from_those_above_them() {
    let (mut upward, mut through_lib) = (Vec::new(), Vec::new());
    for file in files(Crate::Library) {
        let own = floor(&file.module).unwrap_or_else(|| panic!("{} is on no floor", file.path.display()));
        for path in paths(&file) {
            let import = format!("{} imports {}", file.module.join("::"), path.join("::"));
            match floor(&path) {
                None => through_lib.push(import),
                Some(to) if to > own => upward.push(import),
                Some(_) => {}
            }
        }
    }
    assert!(upward.is_empty(), "imports from lower floors:\n{}", upward.join("\n"));
    assert!(through_lib.is_empty(), "imports of what lib.rs re-exports:\n{}", through_lib.join("\n"));
}

/// Lines of code in a file, without comments, blank lines and tests, from which on its head has to say why it is long.
const LONG: usize = 500;

#[test]
fn long_files_say_why() {
    for of in [Crate::Library, Crate::CommandLine] {
        for file in files(of) {
            let lines = file.text.lines().filter(|line| !line.trim().is_empty()).count();
            let whole = std::fs::read_to_string(&file.path).unwrap();
            let head: String = whole.lines().take_while(|line| line.starts_with("//!")).collect();
            let is_explained = head.contains("The file is long because");
            assert!(lines <= LONG || is_explained, "{} has {lines} lines of code", file.path.display());
        }
    }
}

/// Nodes that lie on a circle of edges.
fn circles(edges: &BTreeMap<String, BTreeSet<String>>) -> Vec<String> {
    let reaches = |from: &String| {
        let (mut seen, mut open) = (BTreeSet::new(), vec![from]);
        while let Some(n) = open.pop() {
            for to in edges.get(n).into_iter().flatten() {
                if seen.insert(to) {
                    open.push(to);
                }
            }
        }
        seen
    };
    edges.keys().filter(|n| reaches(n).contains(n)).cloned().collect()
}

/// Edges between files, or between folders below the floors. A file's own folder, which re-exports it, does not count.
fn edges(of_crate: Crate, by_folder: bool, of: impl Fn(&[String]) -> String) -> BTreeMap<String, BTreeSet<String>> {
    let all = files(of_crate);
    let modules: BTreeSet<Vec<String>> = all.iter().map(|f| f.module.clone()).collect();
    let mut edges: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for file in &all {
        for path in paths(file) {
            let mut path = path;
            // The longest prefix that is a file.
            while !path.is_empty() && !modules.contains(&path) {
                path.pop();
            }
            if path.is_empty() || path == file.module || file.module.starts_with(&path) {
                continue;
            }
            let (from, to) = (of(&file.module), of(&path));
            // What lies in a folder and its folders is looked at file by file.
            let nested = from.starts_with(&format!("{to}::")) || to.starts_with(&format!("{from}::"));
            if from != to && !(nested && by_folder) {
                edges.entry(from).or_default().insert(to);
            }
        }
    }
    assert!(edges.len() > 5, "{edges:?}");
    edges
}

#[test]
fn folders_do_not_import_each_other_in_a_circle() {
    for of in [Crate::Library, Crate::CommandLine] {
        let folder = |module: &[String]| {
            let is_folder = of.root().join(module.join("/")).is_dir();
            let depth = if is_folder { module.len() } else { module.len() - 1 };
            module[..depth.max(1)].join("::")
        };
        let found = circles(&edges(of, true, folder));
        assert!(found.is_empty(), "folders in circles: {}", found.join(", "));
    }
}

#[test]
fn files_do_not_import_each_other_in_a_circle() {
    for of in [Crate::Library, Crate::CommandLine] {
        let found = circles(&edges(of, false, |module| module.join("::")));
        assert!(found.is_empty(), "files in circles: {}", found.join(", "));
    }
}

#[test]
fn the_parser_sees_what_it_is_for() {
    let file = |module: &str, text: &str| File {
        path: PathBuf::from(format!("src/{}.rs", module.replace("::", "/"))),
        module: module.split("::").map(str::to_owned).collect(),
        text: without_tests(text),
    };
    let of = |f: &File| paths(f).into_iter().map(|p| p.join("::")).collect::<Vec<_>>();
    let text = "use crate::live::{self, Live, save::{A, B}};\nuse super::x::Y;\nlet a = crate::trace::offset(1);\n\
                #[cfg(test)]\nfn t() {\n    crate::capi::no()\n}\n// crate::io\n\
                #[cfg(test)]\nmod tests { use crate::io; }";
    let expected = ["lightmap::x::Y", "live::Live", "live::save::A", "live::save::B", "live::self", "trace::offset"];
    assert_eq!(of(&file("lightmap::bake", text)), expected);
    assert_eq!([floor(&["scene".into(), "x".into()]), floor(&["Scene".into()])], [Some(4), None]);
    let edge = |a: &str, b: &str| (a.to_owned(), BTreeSet::from([b.to_owned()]));
    assert_eq!(circles(&BTreeMap::from([edge("a", "b"), edge("b", "c"), edge("c", "b")])), ["b", "c"]);
}
