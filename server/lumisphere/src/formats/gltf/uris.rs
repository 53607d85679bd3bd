//! URIs inside glTF files: `data:` with base64, and percent-encoded paths.

use super::{FormatError, wrong};

/// What follows "data:": a media type, then ";base64," and the data.
pub(super) fn data_uri(data: &str) -> Result<Vec<u8>, FormatError> {
    let encoded = data.split_once(";base64,").map(|(_, encoded)| encoded);
    encoded.and_then(base64).ok_or_else(|| wrong("data URI is not base64"))
}

/// None for text that is not base64, padded or not.
pub(super) fn base64(text: &str) -> Option<Vec<u8>> {
    let digit = |c: u8| match c {
        b'A'..=b'Z' => Some(c - b'A'),
        b'a'..=b'z' => Some(c - b'a' + 26),
        b'0'..=b'9' => Some(c - b'0' + 52),
        b'+' => Some(62),
        b'/' => Some(63),
        _ => None,
    };
    let digits: Vec<u8> = text.trim_end_matches('=').bytes().map(digit).collect::<Option<_>>()?;
    let mut bytes = Vec::with_capacity(digits.len() / 4 * 3 + 2);
    for group in digits.chunks(4) {
        let word = group.iter().enumerate().fold(0u32, |w, (i, d)| w | (*d as u32) << (18 - 6 * i));
        bytes.extend(&word.to_be_bytes()[1..group.len()]);
    }
    (digits.len() % 4 != 1).then_some(bytes)
}

/// `%20` and the like resolved.
pub(super) fn percent_decoded(uri: &str) -> String {
    let bytes = uri.as_bytes();
    let (mut out, mut i) = (Vec::new(), 0);
    while i < bytes.len() {
        let code = (bytes[i] == b'%').then(|| uri.get(i + 1..i + 3)).flatten().and_then(|h| u8::from_str_radix(h, 16).ok());
        out.push(code.unwrap_or(bytes[i]));
        i += if code.is_some() { 3 } else { 1 };
    }
    String::from_utf8_lossy(&out).into_owned()
}
