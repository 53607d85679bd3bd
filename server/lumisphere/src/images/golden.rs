//! Golden images on disk: linear EXR of at most 64 KiB that tests compare their pictures with.
//!
//! Called by tests only, which read `UPDATE_GOLDENS` themselves and pass what they want.

use std::path::{Path, PathBuf};

use super::{ExrStorage, Image, ImageError, Mismatch, Nan, ReadLimits, Tolerance, decode_image, encode_exr_rgb, golden_agrees};

/// Goldens live in the repository; a picture that needs more is too large for its purpose.
pub const GOLDEN_MAX_BYTES: usize = 64 << 10;

/// What to do with a golden.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Golden {
    /// Compare; a missing golden is an error.
    Check,
    /// Write the picture as the new golden.
    Rewrite,
}

/// Why a golden test fails.
#[derive(Debug, thiserror::Error)]
pub enum GoldenError {
    /// No golden, or one that cannot be read or written.
    #[error("golden: {0}")]
    File(#[from] ImageError),
    /// It would be larger than [`GOLDEN_MAX_BYTES`].
    #[error("golden of {bytes} bytes exceeds {GOLDEN_MAX_BYTES}")]
    TooLarge {
        /// Encoded length.
        bytes: usize,
    },
    /// The picture differs; it and the absolute difference were saved.
    #[error("{mismatch}; actual and difference saved beside {}", saved.display())]
    Differs {
        /// How.
        #[source]
        mismatch: Mismatch,
        /// `….actual.exr`; `….difference.exr` stands beside it, unless the shapes differ.
        saved: PathBuf,
    },
}

/// Compares an R G B (A) picture with the golden at `path` by the golden rule, or rewrites it. Goldens are half floats, so the tolerance is
/// F16_STORAGE or wider. `failures` is the folder for pictures that differ; it is made when needed.
pub fn check_golden(path: &Path, actual: &Image, tolerance: &Tolerance, golden: Golden, failures: &Path) -> Result<(), GoldenError> {
    if golden == Golden::Rewrite {
        let bytes = encode_exr_rgb(actual, ExrStorage::Half)?;
        if bytes.len() > GOLDEN_MAX_BYTES {
            return Err(GoldenError::TooLarge { bytes: bytes.len() });
        }
        return write(path, &bytes).map_err(GoldenError::File);
    }
    let limits = ReadLimits { max_samples: 1 << 20, nan: Nan::Reject };
    let read = || decode_image(&std::fs::read(path)?, limits);
    let expected = read().map_err(|error: ImageError| error.in_file(path))?;
    match golden_agrees(&expected, actual, tolerance) {
        Ok(_) => Ok(()),
        Err(mismatch) => Err(GoldenError::Differs { mismatch, saved: save_failure(path, &expected, actual, failures)? }),
    }
}

fn save_failure(path: &Path, expected: &Image, actual: &Image, failures: &Path) -> Result<PathBuf, ImageError> {
    let name = path.file_stem().unwrap_or_default().to_string_lossy();
    let saved = failures.join(format!("{name}.actual.exr"));
    write(&saved, &encode_exr_rgb(actual, ExrStorage::Float)?)?;
    if (expected.width, expected.height, expected.channels()) == (actual.width, actual.height, actual.channels()) {
        let mut difference = expected.clone();
        for (difference, actual) in difference.planes.iter_mut().flatten().zip(actual.planes.iter().flatten()) {
            *difference = (*actual - *difference).abs();
        }
        write(&failures.join(format!("{name}.difference.exr")), &encode_exr_rgb(&difference, ExrStorage::Float)?)?;
    }
    Ok(saved)
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), ImageError> {
    let folder = path.parent().unwrap_or(Path::new("."));
    let written = std::fs::create_dir_all(folder).and_then(|()| std::fs::write(path, bytes));
    written.map_err(|error| ImageError::from(error).in_file(path))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::images::negative_controls::{controls, textured};

    #[test]
    fn a_rewritten_golden_is_agreed_with_and_every_control_is_not() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("goldens/textured.exr");
        let failures = folder.path().join("failures");
        let check = |image: &Image, golden| check_golden(&path, image, &Tolerance::F16_STORAGE, golden, &failures);
        let image = textured();
        assert!(matches!(check(&image, Golden::Check), Err(GoldenError::File(_))), "a missing golden fails");
        check(&image, Golden::Rewrite).unwrap();
        check(&image, Golden::Check).unwrap();
        assert!(!failures.exists());
        for (what, changed) in controls(&image) {
            assert!(check(&changed, Golden::Check).is_err(), "{what}");
        }
        assert!(failures.join("textured.actual.exr").exists() && failures.join("textured.difference.exr").exists());
    }

    #[test]
    fn a_golden_too_large_for_the_repository_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("large.exr");
        let mut image = Image::zeros(256, 256, 3);
        let mut state = 1u32;
        for sample in image.planes.iter_mut().flatten() {
            state = state.wrapping_mul(747_796_405).wrapping_add(2_891_336_453);
            *sample = (state >> 8) as f32 / 16_777_216.0;
        }
        let result = check_golden(&path, &image, &Tolerance::F16_STORAGE, Golden::Rewrite, folder.path());
        assert!(matches!(result, Err(GoldenError::TooLarge { .. })));
        assert!(!path.exists());
    }
}
