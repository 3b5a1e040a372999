//! The bytes of buffers, and of files and data that URIs name.

use super::text::Text;
use crate::base::error::Result;
use crate::io::Import;
use crate::io::source::{Attempt, folder_of};
use std::borrow::Cow;

/// The bytes of a buffer, at least as many as it says.
pub(super) fn read<'b>(
    import: &mut Import,
    buffer: &gltf::Buffer,
    text: &Text,
    blob: Option<&'b [u8]>,
) -> Result<Cow<'b, [u8]>> {
    let read = match buffer.source() {
        gltf::buffer::Source::Bin => Ok(blob.map(Cow::Borrowed).ok_or("there is no binary chunk and no uri".into())),
        gltf::buffer::Source::Uri(uri) => read_uri(import, text, uri).map(|read| read.map(Cow::Owned)),
    };
    let fail = |what: &dyn std::fmt::Display| import.error(format_args!("buffer {}: {what}", buffer.index()));
    let bytes: Cow<[u8]> = read?.map_err(|what| fail(&what))?;
    if bytes.len() < buffer.length() {
        return Err(fail(&format_args!("it has {} bytes, not {}", bytes.len(), buffer.length())));
    }
    Ok(bytes)
}

/// The bytes that a URI names: in the URI itself, or in a file beside the scene. The account counts them.
pub(super) fn read_uri(import: &mut Import, text: &Text, uri: &str) -> Attempt<Vec<u8>> {
    if let Some(data) = text.decoded(import, uri) {
        return data;
    }
    match percent_decoded(uri) {
        Some(name) => {
            let folder = folder_of(&import.path).to_owned();
            import.read_named(&folder, &name.replace('\\', "/"))
        }
        None => Ok(Err(format!("the uri {uri:?}"))),
    }
}

/// Resolves `%20` and the like; `None` if malformed.
fn percent_decoded(uri: &str) -> Option<String> {
    let mut bytes = Vec::with_capacity(uri.len());
    let mut rest = uri.as_bytes();
    while let [first, tail @ ..] = rest {
        rest = tail;
        if *first == b'%' {
            let hex = std::str::from_utf8(tail.get(..2)?).ok()?;
            bytes.push(u8::from_str_radix(hex, 16).ok()?);
            rest = &tail[2..];
        } else {
            bytes.push(*first);
        }
    }
    String::from_utf8(bytes).ok()
}
