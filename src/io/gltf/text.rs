//! The JSON of a file without its long data URIs, and the data in these.

use crate::base::error::Result;
use crate::io::Import;
use crate::io::source::Attempt;
use base64::Engine;
use std::ops::Range;

/// A JSON text without its long data URIs, which the parser would copy: each is replaced by its number.
pub(super) struct Text<'b> {
    pub(super) short: Vec<u8>,
    whole: &'b [u8],
    /// Places of data URIs in the whole text, without quotes.
    uris: Vec<Range<usize>>,
}

/// Start of a replaced data URI; number 7 is `data:#7`.
const REPLACED: &str = "data:#";

/// Data URIs up to this length may stay.
const SHORT_URI: usize = 1 << 10;

impl<'b> Text<'b> {
    pub(super) fn new(import: &mut Import, whole: &'b [u8]) -> Result<Text<'b>> {
        let mut text = Text { short: Vec::new(), whole, uris: Vec::new() };
        // Where a string began, and whether the byte before was a backslash in it.
        let (mut string, mut escaped) = (None, false);
        let mut copied = 0;
        for (at, &c) in whole.iter().enumerate() {
            if at.is_multiple_of(1 << 20) {
                import.check()?;
            }
            match string {
                None if c == b'"' => string = Some(at + 1),
                None => {}
                Some(_) if escaped => escaped = false,
                Some(_) if c == b'\\' => escaped = true,
                Some(start) if c == b'"' => {
                    string = None;
                    let uri = &whole[start..at];
                    if uri.starts_with(b"data:") && (uri.len() > SHORT_URI || uri.starts_with(REPLACED.as_bytes())) {
                        text.append(import, &whole[copied..start])?;
                        let number = format!("{REPLACED}{}", text.uris.len());
                        text.append(import, number.as_bytes())?;
                        import.account.push(&mut text.uris, start..at, "the data URIs")?;
                        copied = at;
                    }
                }
                Some(_) => {}
            }
        }
        text.append(import, &whole[copied..])?;
        Ok(text)
    }

    fn append(&mut self, import: &mut Import, bytes: &[u8]) -> Result<()> {
        import.account.make_room(&mut self.short, bytes.len(), "the JSON text")?;
        self.short.extend_from_slice(bytes);
        Ok(())
    }

    /// The text of a data URI behind `data:`; `None` if it is none.
    fn data<'t>(&'t self, uri: &'t str) -> Option<&'t [u8]> {
        let content = uri.strip_prefix("data:")?;
        let number = content.strip_prefix('#').and_then(|n| n.parse::<usize>().ok());
        Some(match number.and_then(|n| self.uris.get(n)) {
            Some(range) => &self.whole[range.start + "data:".len()..range.end],
            None => content.as_bytes(),
        })
    }

    /// The bytes that a data URI holds in base64. `None` if it is none; the account counts them.
    pub(super) fn decoded(&self, import: &mut Import, uri: &str) -> Option<Attempt<Vec<u8>>> {
        const MARK: &[u8] = b";base64,";
        let data = self.data(uri)?;
        let Some(mark) = data.windows(MARK.len()).position(|w| w == MARK) else {
            return Some(Ok(Err("a data URI without base64".into())));
        };
        let encoded = data[mark + MARK.len()..].trim_ascii_end();
        if !encoded.contains(&b'\\') {
            return Some(decode_base64(import, encoded));
        }
        // Some writers of JSON escape the slash, some the plus sign.
        let plain = import.account.list(encoded.len(), "a data URI").map(|mut plain| {
            unescape(encoded, &mut plain);
            plain
        });
        Some(plain.and_then(|plain| {
            let decoded = decode_base64(import, &plain);
            import.account.give_back(plain.capacity());
            decoded
        }))
    }
}

/// Appends a JSON string without its escapes, as far as base64 goes: one of anything else stays a backslash, which is
/// none.
fn unescape(mut text: &[u8], out: &mut Vec<u8>) {
    while let Some(at) = text.iter().position(|c| *c == b'\\') {
        out.extend_from_slice(&text[..at]);
        let code = |hex: &[u8]| u8::from_str_radix(str::from_utf8(hex).ok()?, 16).ok();
        let (plain, length) = match &text[at + 1..] {
            [b'/', ..] => (b'/', 2),
            [b'u', b'0', b'0', hex @ ..] => (hex.get(..2).and_then(code).unwrap_or(b'\\'), 6),
            _ => (b'\\', 1),
        };
        out.push(plain);
        text = text.get(at + length..).unwrap_or_default();
    }
    out.extend_from_slice(text);
}

fn decode_base64(import: &mut Import, encoded: &[u8]) -> Attempt<Vec<u8>> {
    // Of a multiple of 4, so that pieces are decoded alone.
    const PIECE: usize = 1 << 20;
    let size = encoded.len() / 4 * 3 + 3;
    let mut bytes = import.account.list(size, "a data URI")?;
    let mut piece = import.account.list::<u8>(PIECE / 4 * 3 + 3, "a data URI")?;
    piece.resize(PIECE / 4 * 3 + 3, 0);
    let pieces = encoded.len().div_ceil(PIECE);
    for (i, text) in encoded.chunks(PIECE).enumerate() {
        import.check()?;
        // Padding ends it all.
        if i + 1 < pieces && text.ends_with(b"=") {
            return Ok(Err("padding in the middle of base64".into()));
        }
        match base64::prelude::BASE64_STANDARD.decode_slice(text, &mut piece) {
            Ok(count) => bytes.extend_from_slice(&piece[..count]),
            Err(e) => return Ok(Err(e.to_string())),
        }
    }
    import.account.give_back(piece.capacity());
    Ok(Ok(bytes))
}
