//! Material libraries of OBJ files: of each `newmtl`, `Kd` (diffuse reflectance, linear) with `map_Kd`, `Ke`
//! (here: emitted radiance in W/(m²·sr)), `map_d` (cut-outs), and `Tf` (transmission) if
//! `illum` is one of the models with transparency, 4, 6, 7 and 9. Options of maps and everything else are
//! skipped.

use crate::base::error::{Error, Result};
use crate::io::account::Account;
use crate::io::source::{Source, folder_of, read_error};
use std::collections::HashMap;
use std::fmt::Display;
use std::path::{Path, PathBuf};

/// A material as a library describes it.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Entry {
    /// `None` where there is no `Kd`, or one in a form that is not RGB.
    pub albedo: Option<[f32; 3]>,
    pub emission: [f32; 3],
    /// `Tf` and `illum`.
    filter: [f32; 3],
    model: i32,
    /// Files of `map_Kd` and `map_d`.
    pub color_map: Option<MapFile>,
    pub alpha_map: Option<MapFile>,
}

/// A file that a library names, and the library's folder.
#[derive(Clone, Debug, Eq, Hash, PartialEq)]
pub(super) struct MapFile {
    pub folder: PathBuf,
    pub name: String,
}

impl Entry {
    /// Fraction of light that passes straight through.
    pub fn transmission(&self) -> [f32; 3] {
        if matches!(self.model, 4 | 6 | 7 | 9) { self.filter } else { [0.0; 3] }
    }
}

/// Materials by name. Of several of one name the last is kept.
pub(super) type Library = HashMap<Vec<u8>, Entry>;

/// Adds the materials of a library, read from `source`; `path` is for the errors.
pub(super) fn read(source: &mut Source, path: &Path, library: &mut Library, account: &mut Account) -> Result<()> {
    let mut text = Vec::new();
    let mut entries = Entries { path, library, current: None };
    for line in 1.. {
        text.clear();
        if source.read_line(&mut text, account).map_err(|e| read_error(e, path.display()))? == 0 {
            break;
        }
        if text.starts_with(b"newmtl") {
            account.hold(2 * (text.len() + size_of::<Entry>()), "a material library")?;
        }
        entries.statement(line, &text)?;
    }
    Ok(())
}

/// A library being read.
struct Entries<'a> {
    path: &'a Path,
    library: &'a mut Library,
    current: Option<Vec<u8>>,
}

impl Entries<'_> {
    fn statement(&mut self, line: usize, text: &[u8]) -> Result<()> {
        let path = self.path;
        let fail = |line: usize, what: &dyn Display| Error::Io(format!("{}, line {line}: {what}", path.display()));
        let (keyword, rest) = split_keyword(text);
        if keyword == b"newmtl" {
            if rest.is_empty() {
                return Err(fail(line, &"newmtl without a name"));
            }
            self.current = Some(rest.to_vec());
            self.library.insert(rest.to_vec(), Entry::default());
        }
        let Some(entry) = self.current.as_ref().and_then(|name| self.library.get_mut(name)) else { return Ok(()) };
        match keyword {
            b"Kd" => entry.albedo = color(rest).map_err(|what| fail(line, &format_args!("Kd {what}")))?,
            b"Ke" => {
                let emission = color(rest).map_err(|what| fail(line, &format_args!("Ke {what}")))?;
                entry.emission = emission.unwrap_or_default();
                if let Some(e) = entry.emission.iter().find(|e| **e < 0.0) {
                    return Err(fail(line, &format_args!("Ke contains {e}, less than 0")));
                }
            }
            b"Tf" => {
                entry.filter = color(rest).map_err(|what| fail(line, &format_args!("Tf {what}")))?.unwrap_or_default();
            }
            b"illum" => {
                let model = finite(rest).map_err(|what| fail(line, &format_args!("illum {what}")))?;
                entry.model = model as i32;
            }
            b"map_Kd" => entry.color_map = map_file(rest, path),
            b"map_d" => entry.alpha_map = map_file(rest, path),
            _ => {}
        }
        Ok(())
    }
}

/// The first word of a line and what follows it, without the white space around.
pub(super) fn split_keyword(line: &[u8]) -> (&[u8], &[u8]) {
    let line = line.trim_ascii();
    let end = line.iter().position(|c| c.is_ascii_whitespace()).unwrap_or(line.len());
    (&line[..end], line[end..].trim_ascii_start())
}

/// Reads `r [g b]`; a single number is the value of all three. `None` for the forms `spectral` and `xyz`.
fn color(text: &[u8]) -> std::result::Result<Option<[f32; 3]>, String> {
    if text.starts_with(b"spectral") || text.starts_with(b"xyz") {
        return Ok(None);
    }
    let mut values = Vec::with_capacity(3);
    for word in text.split(|c| c.is_ascii_whitespace()).filter(|w| !w.is_empty()).take_while(|w| w[0] != b'#').take(3) {
        values.push(finite(word)?);
    }
    match values[..] {
        [grey] => Ok(Some([grey; 3])),
        [r, g, b] => Ok(Some([r, g, b])),
        _ => Err(format!("needs 1 or 3 numbers, not {}", values.len())),
    }
}

/// The file that a map names behind its options, beside the library at `path`.
fn map_file(mut text: &[u8], path: &Path) -> Option<MapFile> {
    while text.starts_with(b"-") {
        let (option, rest) = split_keyword(text);
        let numbers = match option {
            b"-o" | b"-s" | b"-t" => 3,
            b"-mm" => 2,
            _ => 1,
        };
        text = rest;
        for i in 0..numbers {
            let (word, rest) = split_keyword(text);
            // Of three numbers the last two may be left out.
            if i > 0 && finite(word).is_err() {
                break;
            }
            text = rest;
        }
    }
    let name = String::from_utf8_lossy(text).replace('\\', "/");
    (!name.is_empty()).then(|| MapFile { folder: folder_of(path).to_owned(), name })
}

/// A finite number.
pub(super) fn finite(word: &[u8]) -> std::result::Result<f32, String> {
    match std::str::from_utf8(word).ok().and_then(|s| s.parse::<f32>().ok()) {
        Some(value) if value.is_finite() => Ok(value),
        _ => Err(format!("contains {:?}, not a finite number", String::from_utf8_lossy(word))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse_as(path: &str, text: &str) -> Result<Library> {
        let mut library = Library::new();
        let mut entries = Entries { path: Path::new(path), library: &mut library, current: None };
        for (line, text) in (1..).zip(text.lines()) {
            entries.statement(line, text.as_bytes())?;
        }
        Ok(library)
    }

    fn parse(text: &str) -> Result<Library> {
        parse_as("a.mtl", text)
    }

    #[test]
    fn colors_are_read_by_material() {
        let l = parse("Kd 9 9 9\nnewmtl a b\r\nKd 0.1 .2 3e-1 # red\nmap_Kd x.png\nnewmtl c\n Ke 5\n").unwrap();
        assert_eq!(l.len(), 2);
        let color_map = Some(MapFile { folder: ".".into(), name: "x.png".into() });
        assert_eq!(l[&b"a b"[..]], Entry { albedo: Some([0.1, 0.2, 0.3]), color_map, ..Default::default() });
        assert_eq!(l[&b"c"[..]], Entry { emission: [5.0; 3], ..Default::default() });
        assert_eq!(parse("newmtl a\nKd spectral x.rfl\n").unwrap()[&b"a"[..]].albedo, None);
    }

    #[test]
    fn maps_are_files_beside_the_library_whatever_their_options() {
        for (map, expected) in [
            ("map_Kd a b.png", Some("a b.png")),
            ("map_Kd -s 2 2 -o 0.5 -clamp on -bm 1 sub\\c.jpg", Some("sub/c.jpg")),
            ("map_Kd -s 1 1 1 7.png", Some("7.png")),
            ("map_Kd -mm 0 1 x", Some("x")),
            ("map_Kd", None),
            ("map_Kd -s 1", None),
        ] {
            let library = parse_as("lib/a.mtl", &format!("newmtl a\n{map}\n")).unwrap();
            let expected = expected.map(|name| MapFile { folder: "lib".into(), name: name.into() });
            assert_eq!(library[&b"a"[..]].color_map, expected, "{map}");
        }
    }

    #[test]
    fn only_transparent_models_transmit() {
        for (model, transmits) in [(0, false), (1, false), (2, false), (4, true), (6, true), (7, true), (9, true)] {
            let l = parse(&format!("newmtl a\nTf 0.8 0.1 0.2\nillum {model}\n")).unwrap();
            let expected = if transmits { [0.8, 0.1, 0.2] } else { [0.0; 3] };
            assert_eq!(l[&b"a"[..]].transmission(), expected, "{model}");
        }
        assert_eq!(parse("newmtl a\nTf 1\n").unwrap()[&b"a"[..]].transmission(), [0.0; 3]);
    }

    #[test]
    fn errors_name_file_and_line() {
        let message = |text| parse(text).unwrap_err().to_string();
        assert_eq!(message("newmtl\n"), "input/output: a.mtl, line 1: newmtl without a name");
        assert_eq!(message("newmtl a\nKd 1 2\n"), "input/output: a.mtl, line 2: Kd needs 1 or 3 numbers, not 2");
        assert_eq!(
            message("newmtl a\nKd 1 2 nan\n"),
            "input/output: a.mtl, line 2: Kd contains \"nan\", not a finite number"
        );
        assert_eq!(message("newmtl a\n\nKe 1 -2 1\n"), "input/output: a.mtl, line 3: Ke contains -2, less than 0");
    }
}
