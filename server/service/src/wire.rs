//! The wire's messages ↔ the library's types; the only place, with the adapters of `api`, that sees generated code.
//!
//! Everything that arrives is checked here, once. An error names the field by its path in the request.

pub mod cache;
pub mod camera;
pub mod datasets;
pub mod frames;
#[cfg(test)]
mod fuzz;
pub mod jobs;
pub mod replay;
pub mod scenes;
pub mod settings;

use std::time::Duration;

use lumisphere::textures::ContentHash;
pub use lumisphere_proto::{
    ERROR_DOMAIN, FILE_DESCRIPTOR_SET, MAX_CHUNK_BYTES, MAX_FRAME_MESSAGE_BYTES, MAX_LINK_PAYLOAD_BYTES, MAX_REQUEST_BYTES,
    v1alpha1 as proto,
};

use crate::errors::{ApiError, Reason};

/// The package that is served.
pub const API: &str = "lumisphere.v1alpha1";

/// Name of a reason in `ErrorInfo`.
pub fn reason_name(reason: Reason) -> &'static str {
    let name = reason.as_str_name();
    name.strip_prefix("ERROR_REASON_").unwrap_or(name)
}

/// A field that must be there.
pub fn required<T>(value: Option<T>, field: &str) -> Result<T, ApiError> {
    value.ok_or_else(|| ApiError::field(field, "missing"))
}

/// A BLAKE3 in hexadecimal.
pub fn hash(text: &str, field: &str) -> Result<ContentHash, ApiError> {
    let expected = "64 lower-case hexadecimal digits expected";
    text.parse().map_err(|_| ApiError::field(field, format!("{:?}, {expected}", clipped(text))))
}

/// A dataset's name: `[a-z0-9][a-z0-9._-]{0,62}`.
pub fn dataset_name(text: &str, field: &str) -> Result<String, ApiError> {
    let plain = |b: u8| b.is_ascii_lowercase() || b.is_ascii_digit();
    let valid = text.len() <= 63 && text.bytes().next().is_some_and(plain) && text.bytes().all(|b| plain(b) || b"._-".contains(&b));
    match valid {
        true => Ok(text.into()),
        false => Err(ApiError::field(field, format!("{:?}, a name matching [a-z0-9][a-z0-9._-]{{0,62}} expected", clipped(text)))),
    }
}

/// A number within bounds; NaN is not.
pub fn within(value: f32, least: f32, greatest: f32, field: &str) -> Result<f32, ApiError> {
    match value >= least && value <= greatest {
        true => Ok(value),
        false => Err(ApiError::field(field, format!("{value}, {least} to {greatest} expected"))),
    }
}

/// A positive finite number.
pub fn positive(value: f32, field: &str) -> Result<f32, ApiError> {
    match value > 0.0 && value.is_finite() {
        true => Ok(value),
        false => Err(ApiError::field(field, format!("{value}, a finite number above 0 expected"))),
    }
}

/// A count within bounds, 0 standing for its default.
pub fn count(value: u32, default: u32, least: u32, greatest: u32, field: &str) -> Result<u32, ApiError> {
    match value {
        0 => Ok(default),
        n if (least..=greatest).contains(&n) => Ok(n),
        n => Err(ApiError::field(field, format!("{n}, {least} to {greatest} expected"))),
    }
}

/// `page_size`: 1 to 1000, default 100.
pub fn page_size(value: i32, field: &str) -> Result<usize, ApiError> {
    match value {
        0 => Ok(100),
        1..=1000 => Ok(value as usize),
        n => Err(ApiError::field(field, format!("{n}, 1 to 1000 expected"))),
    }
}

/// The job number below which the next page begins.
pub fn job_page_token(text: &str, field: &str) -> Result<u64, ApiError> {
    match text {
        "" => Ok(u64::MAX),
        token => token.parse().map_err(|_| ApiError::field(field, format!("{:?}, a token of an earlier answer expected", clipped(token)))),
    }
}

/// A moment.
pub fn timestamp(unix_millis: u64) -> prost_types::Timestamp {
    prost_types::Timestamp { seconds: (unix_millis / 1000) as i64, nanos: (unix_millis % 1000) as i32 * 1_000_000 }
}

/// The caller's `grpc-timeout`, at most a day.
pub fn timeout(metadata: &tonic::metadata::MetadataMap) -> Option<Duration> {
    let text = metadata.get("grpc-timeout")?.to_str().ok()?;
    let (digits, unit) = text.split_at_checked(text.len().checked_sub(1)?)?;
    let value: u64 = digits.parse().ok().filter(|_| digits.len() <= 8)?;
    let timeout = match unit {
        "H" => Duration::from_secs(value * 3600),
        "M" => Duration::from_secs(value * 60),
        "S" => Duration::from_secs(value),
        "m" => Duration::from_millis(value),
        "u" => Duration::from_micros(value),
        "n" => Duration::from_nanos(value),
        _ => return None,
    };
    Some(timeout.min(Duration::from_secs(86_400)))
}

/// So much of a foreign text as a message may repeat.
pub fn clipped(text: &str) -> String {
    clipped_to(text, 80)
}

/// So many characters of a text.
pub fn clipped_to(text: &str, chars: usize) -> String {
    match text.char_indices().nth(chars) {
        Some((end, _)) => format!("{}…", &text[..end]),
        None => text.into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_and_hashes_are_what_the_wire_says() {
        for good in ["a", "0", "teapot.v2_x-1", &"a".repeat(63)] {
            assert_eq!(dataset_name(good, "f").unwrap(), good);
        }
        for bad in ["", ".a", "-a", "A", "a/b", "..", "a b", "ä", &"a".repeat(64)] {
            assert_eq!(dataset_name(bad, "f").unwrap_err().reason(), Reason::FieldInvalid, "{bad}");
        }
        assert!(hash(&"0f".repeat(32), "f").is_ok());
        for bad in ["", "0F", &"0F".repeat(32), &"0g".repeat(32), &"00".repeat(33)] {
            assert!(hash(bad, "f").is_err(), "{bad}");
        }
    }

    #[test]
    fn bounds_refuse_nan_and_zero_is_the_default() {
        assert!(within(f32::NAN, 0.0, 1.0, "f").is_err() && positive(f32::NAN, "f").is_err() && positive(f32::INFINITY, "f").is_err());
        assert_eq!((count(0, 7, 1, 9, "f").unwrap(), count(9, 7, 1, 9, "f").unwrap()), (7, 9));
        assert!(count(10, 7, 1, 9, "f").is_err() && page_size(-1, "f").is_err() && page_size(1001, "f").is_err());
    }

    #[test]
    fn the_callers_timeout_is_understood() {
        let with = |text: &str| {
            let mut map = tonic::metadata::MetadataMap::new();
            map.insert("grpc-timeout", text.parse().unwrap());
            timeout(&map)
        };
        assert_eq!(with("250m"), Some(Duration::from_millis(250)));
        assert_eq!(with("1S"), Some(Duration::from_secs(1)));
        assert_eq!(with("99999999H"), Some(Duration::from_secs(86_400)));
        assert_eq!((with("1x"), with("S"), with("-1S"), with("999999999S")), (None, None, None, None));
    }
}
