//! Material libraries of OBJ files: of each `newmtl`, `Kd` (diffuse reflectance, linear) and `Ke`
//! (here: emitted radiance in W/(m²·sr)). Everything else is skipped; textures are counted.

use crate::error::{Error, Result};
use std::collections::HashMap;
use std::fmt::Display;
use std::io::BufRead;
use std::path::Path;

/// What a library says about a material.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Entry {
    /// `None` where there is no `Kd`, or one in a form that is not RGB.
    pub albedo: Option<[f32; 3]>,
    pub emission: [f32; 3],
    /// Whether a `map_Kd` was ignored.
    pub textured: bool,
}

/// Materials by name. Of several of one name the last is kept.
pub(super) type Library = HashMap<Vec<u8>, Entry>;

/// Adds the materials of a library, read from `source`; `path` is for the errors.
pub(super) fn read(source: &mut impl BufRead, path: &Path, library: &mut Library) -> Result<()> {
    let fail = |line: usize, what: &dyn Display| Error::Io(format!("{}, line {line}: {what}", path.display()));
    let mut current: Option<Vec<u8>> = None;
    let mut text = Vec::new();
    for line in 1.. {
        text.clear();
        if source.read_until(b'\n', &mut text).map_err(|e| fail(line, &e))? == 0 {
            break;
        }
        let (keyword, rest) = split_keyword(&text);
        if keyword == b"newmtl" {
            if rest.is_empty() {
                return Err(fail(line, &"newmtl without a name"));
            }
            current = Some(rest.to_vec());
            library.insert(rest.to_vec(), Entry::default());
        }
        let Some(entry) = current.as_ref().and_then(|name| library.get_mut(name)) else { continue };
        match keyword {
            b"Kd" => entry.albedo = color(rest).map_err(|what| fail(line, &format_args!("Kd {what}")))?,
            b"Ke" => {
                let emission = color(rest).map_err(|what| fail(line, &format_args!("Ke {what}")))?;
                entry.emission = emission.unwrap_or_default();
                if let Some(e) = entry.emission.iter().find(|e| **e < 0.0) {
                    return Err(fail(line, &format_args!("Ke contains {e}, less than 0")));
                }
            }
            b"map_Kd" => entry.textured = true,
            _ => {}
        }
    }
    Ok(())
}

/// The first word of a line and what follows it, without the white space around.
pub(super) fn split_keyword(line: &[u8]) -> (&[u8], &[u8]) {
    let line = line.trim_ascii();
    let end = line.iter().position(|c| c.is_ascii_whitespace()).unwrap_or(line.len());
    (&line[..end], line[end..].trim_ascii_start())
}

/// `r [g b]`; one number stands for all three. `None` for the `spectral` and `xyz` forms.
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

    fn parse(text: &str) -> Result<Library> {
        let mut library = Library::new();
        read(&mut text.as_bytes(), Path::new("a.mtl"), &mut library)?;
        Ok(library)
    }

    #[test]
    fn colors_are_read_by_material() {
        let l = parse("Kd 9 9 9\nnewmtl a b\r\nKd 0.1 .2 3e-1 # red\nmap_Kd x.png\nnewmtl c\n Ke 5\n").unwrap();
        assert_eq!(l.len(), 2);
        assert_eq!(l[&b"a b"[..]], Entry { albedo: Some([0.1, 0.2, 0.3]), emission: [0.0; 3], textured: true });
        assert_eq!(l[&b"c"[..]], Entry { albedo: None, emission: [5.0; 3], textured: false });
        assert_eq!(parse("newmtl a\nKd spectral x.rfl\n").unwrap()[&b"a"[..]].albedo, None);
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
