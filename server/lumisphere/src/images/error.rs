//! What can go wrong with images at the edge of the program.

use std::path::PathBuf;

/// A foreign image format.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// OpenEXR: linear, float or half, any channels.
    Exr,
    /// Radiance .hdr: linear, shared exponent.
    Hdr,
    /// PNG: sRGB-encoded, 8 or 16 bits.
    Png,
    /// JPEG: sRGB-encoded, 8 bits, lossy.
    Jpeg,
    /// TIFF: photographs, 8 or 16 bits, taken as sRGB.
    Tiff,
}

impl std::fmt::Display for Format {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Exr => "OpenEXR",
            Self::Hdr => "Radiance HDR",
            Self::Png => "PNG",
            Self::Jpeg => "JPEG",
            Self::Tiff => "TIFF",
        })
    }
}

/// Why an image could not be read, converted or written. Variants by what the caller can do about it.
#[derive(Debug, thiserror::Error)]
pub enum ImageError {
    /// The operating system refused.
    #[error("cannot access image: {0}")]
    Io(#[from] std::io::Error),
    /// The bytes begin like none of the formats that are read.
    #[error("neither an OpenEXR, Radiance HDR, PNG, JPEG nor TIFF image")]
    UnknownFormat,
    /// The bytes are cut off or contradict themselves.
    #[error("malformed or truncated {format} image: {reason}")]
    Malformed {
        /// Which format they claim to be.
        format: Format,
        /// What the decoder says.
        reason: String,
    },
    /// A valid image that uses something this program does not read or write.
    #[error("{format} image not supported: {feature}")]
    Unsupported {
        /// Its format.
        format: Format,
        /// What it uses.
        feature: String,
    },
    /// The header announces more samples than the caller allows; nothing of that size was allocated.
    #[error("image too large: {width} × {height} pixels with {channels} channels, limit {max_samples} samples")]
    TooLarge {
        /// Pixels along a row.
        width: usize,
        /// Rows.
        height: usize,
        /// Channels of all layers together.
        channels: usize,
        /// The limit that was exceeded.
        max_samples: usize,
    },
    /// A sample is NaN, and the caller asked for such images to be refused.
    #[error("not a number in channel {channel} at column {column}, row {row}")]
    NotANumber {
        /// The channel's name, or its number where it has none.
        channel: String,
        /// From the left, from 0.
        column: usize,
        /// From the top, from 0.
        row: usize,
    },
    /// A channel or layer that the caller needs is not there.
    #[error("no {wanted} in the image, which has {present}")]
    Missing {
        /// What was asked for.
        wanted: String,
        /// What is there.
        present: String,
    },
    /// Data to be written do not have the shape that was announced.
    #[error("wrong shape: expected {expected}, got {actual}")]
    Shape {
        /// What the format or the function needs.
        expected: String,
        /// What was passed.
        actual: String,
    },
    /// Any of the above, in a file.
    #[error("{error}: {}", path.display())]
    InFile {
        /// What happened.
        #[source]
        error: Box<ImageError>,
        /// Where.
        path: PathBuf,
    },
}

impl ImageError {
    /// The same error with the file it happened in.
    pub fn in_file(self, path: impl Into<PathBuf>) -> Self {
        Self::InFile { error: Box::new(self), path: path.into() }
    }
}
