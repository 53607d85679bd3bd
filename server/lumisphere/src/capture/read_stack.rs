//! Reads photographs with their exposures: JPEG, PNG and TIFF, told by their bytes.
//!
//! Exposures are given as a list, or come from the files' EXIF: exposure time · sensitivity / 100 / aperture², which orders photographs as light does.
//! Where all files lack the aperture (a manual lens) or the sensitivity it counts as 1; where some do the stack is refused.

use std::io::Cursor;
use std::path::{Path, PathBuf};

use exif::{In, Tag, Value};

use super::photograph::{ExposureStack, StackError};
use crate::images::{ImageError, ReadLimits, decode_image_codes};

/// Where exposures come from.
#[derive(Debug, Clone, PartialEq)]
pub enum Exposures {
    /// One per photograph, in any unit that is the same for all.
    Listed(Vec<f64>),
    /// EXIF.
    FromFiles,
}

/// Why photographs could not be read.
#[derive(Debug, thiserror::Error)]
pub enum ReadStackError {
    /// A file could not be read as an image; it names the file.
    #[error(transparent)]
    Image(#[from] ImageError),
    /// The images are no stack.
    #[error(transparent)]
    Stack(#[from] StackError),
    /// A file does not say how it was exposed.
    #[error("no {field} in EXIF, expected {expected}: {}", path.display())]
    NoExposure {
        /// What is missing.
        field: &'static str,
        /// What may stand there.
        expected: &'static str,
        /// The file.
        path: PathBuf,
    },
}

/// What a file says of its exposure.
struct Exposed {
    seconds: f64,
    aperture: Option<f64>,
    sensitivity: Option<f64>,
}

/// Reads a stack. `paths`: in any order, 1 to 255; `load` gives a file's bytes.
pub fn read_stack(
    paths: &[PathBuf],
    load: &dyn Fn(&Path) -> std::io::Result<Vec<u8>>,
    exposures: &Exposures,
) -> Result<ExposureStack, ReadStackError> {
    // Before anything is read: a list of the wrong length is the caller's mistake.
    if let Exposures::Listed(listed) = exposures {
        super::photograph::check_exposures(paths.len(), listed)?;
    }
    let (mut photographs, mut exposed) = (Vec::new(), Vec::new());
    for path in paths {
        let bytes = load(path).map_err(|error| ImageError::Io(error).in_file(path))?;
        photographs.push(decode_image_codes(&bytes, ReadLimits::SCENE).map_err(|error| error.in_file(path))?);
        if *exposures == Exposures::FromFiles {
            exposed.push(read_exposure(&bytes, path)?);
        }
    }
    let exposures = match exposures {
        Exposures::Listed(listed) => listed.clone(),
        Exposures::FromFiles => combine(paths, &exposed)?,
    };
    Ok(ExposureStack::new(photographs, exposures)?)
}

fn read_exposure(bytes: &[u8], path: &Path) -> Result<Exposed, ReadStackError> {
    let missing = || ReadStackError::NoExposure { field: "ExposureTime", expected: "seconds above 0", path: path.into() };
    let exif = exif::Reader::new().read_from_container(&mut Cursor::new(bytes)).map_err(|_| missing())?;
    let number = |tag: Tag| {
        let value = match &exif.get_field(tag, In::PRIMARY)?.value {
            Value::Rational(list) => list.first()?.to_f64(),
            other => other.get_uint(0)?.into(),
        };
        (value > 0.0 && value.is_finite()).then_some(value)
    };
    let seconds = number(Tag::ExposureTime).ok_or_else(missing)?;
    Ok(Exposed { seconds, aperture: number(Tag::FNumber), sensitivity: number(Tag::PhotographicSensitivity) })
}

/// Relative exposures: what no file says is the same for all.
fn combine(paths: &[PathBuf], exposed: &[Exposed]) -> Result<Vec<f64>, ReadStackError> {
    let check = |field: &'static str, of: &dyn Fn(&Exposed) -> Option<f64>| {
        let lacking = exposed.iter().position(|one| of(one).is_none());
        match (lacking, exposed.iter().any(|one| of(one).is_some())) {
            (Some(at), true) => {
                Err(ReadStackError::NoExposure { field, expected: "a number as in the other files", path: paths[at].clone() })
            }
            _ => Ok(()),
        }
    };
    check("FNumber", &|one| one.aperture)?;
    check("PhotographicSensitivity", &|one| one.sensitivity)?;
    let relative = |one: &Exposed| one.seconds * one.sensitivity.unwrap_or(100.0) / 100.0 / one.aperture.unwrap_or(1.0).powi(2);
    Ok(exposed.iter().map(relative).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::images::{JpegQuality, Rgb8, encode_jpeg, encode_png};

    /// A JPEG of one grey whose EXIF has these (tag, numerator, denominator), each a rational; the sensitivity a short.
    fn jpeg(fields: &[(u16, u32, u32)]) -> Vec<u8> {
        let plain = encode_jpeg(&Rgb8::filled(8, 8, [90; 3]), JpegQuality::STREAM).unwrap();
        let mut tiff = b"MM\0\x2a\0\0\0\x08".to_vec();
        // One entry in the first directory: where EXIF's own lies, behind it.
        tiff.extend([0, 1, 0x87, 0x69, 0, 4, 0, 0, 0, 1, 0, 0, 0, 26, 0, 0, 0, 0]);
        tiff.extend((fields.len() as u16).to_be_bytes());
        let values = 26 + 2 + 12 * fields.len() + 4;
        for (at, (tag, numerator, _)) in fields.iter().enumerate() {
            tiff.extend(tag.to_be_bytes());
            if *tag == 0x8827 {
                tiff.extend([0, 3, 0, 0, 0, 1]);
                tiff.extend((*numerator as u16).to_be_bytes());
                tiff.extend([0, 0]);
            } else {
                tiff.extend([0, 5, 0, 0, 0, 1]);
                tiff.extend(((values + 8 * at) as u32).to_be_bytes());
            }
        }
        tiff.extend([0; 4]);
        fields.iter().for_each(|(_, numerator, denominator)| tiff.extend([numerator.to_be_bytes(), denominator.to_be_bytes()].concat()));
        let mut segment = vec![0xff, 0xe1];
        segment.extend(((2 + 6 + tiff.len()) as u16).to_be_bytes());
        segment.extend(b"Exif\0\0");
        [&plain[..2], &segment, &tiff, &plain[2..]].concat()
    }

    const TIME: u16 = 0x829a;
    const APERTURE: u16 = 0x829d;
    const SENSITIVITY: u16 = 0x8827;

    fn written(folder: &tempfile::TempDir, files: &[Vec<u8>]) -> Vec<PathBuf> {
        let write = |(at, bytes): (usize, &Vec<u8>)| {
            let path = folder.path().join(format!("{at}.jpg"));
            std::fs::write(&path, bytes).unwrap();
            path
        };
        files.iter().enumerate().map(write).collect()
    }

    #[test]
    fn exposures_come_from_time_aperture_and_sensitivity() {
        let folder = tempfile::tempdir().unwrap();
        let files = [
            jpeg(&[(TIME, 1, 50), (APERTURE, 4, 1), (SENSITIVITY, 200, 1)]),
            jpeg(&[(TIME, 1, 100), (APERTURE, 28, 10), (SENSITIVITY, 100, 1)]),
        ];
        let stack = read_stack(&written(&folder, &files), &|path| std::fs::read(path), &Exposures::FromFiles).unwrap();
        let expected = [1.0 / 50.0 * 2.0 / 16.0, 1.0 / 100.0 / 7.84];
        assert!(stack.exposures().iter().zip(expected).all(|(a, b)| (a / b - 1.0).abs() < 1e-12), "{:?}", stack.exposures());
    }

    #[test]
    fn files_that_do_not_say_how_they_were_exposed_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let full = jpeg(&[(TIME, 1, 50), (APERTURE, 4, 1)]);
        let png = encode_png(&Rgb8::filled(8, 8, [90; 3])).unwrap();
        for (bad, lacks) in [
            (png, "ExposureTime"),
            (jpeg(&[(APERTURE, 4, 1)]), "ExposureTime"),
            (jpeg(&[(TIME, 0, 1), (APERTURE, 4, 1)]), "ExposureTime"),
            (jpeg(&[(TIME, 1, 0), (APERTURE, 4, 1)]), "ExposureTime"),
            (jpeg(&[(TIME, 1, 50)]), "FNumber"),
        ] {
            let paths = written(&folder, &[full.clone(), bad]);
            let refused = read_stack(&paths, &|path| std::fs::read(path), &Exposures::FromFiles);
            assert!(
                matches!(&refused, Err(ReadStackError::NoExposure { field, path, .. }) if *field == lacks && *path == paths[1]),
                "{refused:?}"
            );
        }
        let manual_lens = written(&folder, &[jpeg(&[(TIME, 1, 50)]), jpeg(&[(TIME, 1, 25)])]);
        assert_eq!(read_stack(&manual_lens, &|path| std::fs::read(path), &Exposures::FromFiles).unwrap().exposures(), [0.02, 0.04]);
    }

    #[test]
    fn lists_of_the_wrong_length_and_files_that_are_no_photographs_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let paths = written(&folder, &[jpeg(&[]), b"II\x2a\0 cut off".to_vec(), b"\x76\x2f\x31\x01".to_vec()]);
        let wrong_length = read_stack(&paths, &|path| std::fs::read(path), &Exposures::Listed(vec![1.0]));
        assert!(matches!(wrong_length, Err(ReadStackError::Stack(StackError::Lengths { photographs: 3, exposures: 1 }))));
        for path in &paths[1..] {
            let refused = read_stack(std::slice::from_ref(path), &|path| std::fs::read(path), &Exposures::Listed(vec![1.0]));
            assert!(matches!(&refused, Err(ReadStackError::Image(ImageError::InFile { path: named, .. })) if named == path), "{refused:?}");
        }
    }

    #[test]
    fn jpeg_png_and_tiff_are_told_by_their_bytes() {
        let folder = tempfile::tempdir().unwrap();
        let pixels = Rgb8::filled(8, 8, [90, 120, 200]);
        let mut tiff = Cursor::new(Vec::new());
        let codes = image::RgbImage::from_raw(8, 8, pixels.bytes.clone()).unwrap();
        codes.write_to(&mut tiff, image::ImageFormat::Tiff).unwrap();
        let paths = written(&folder, &[jpeg(&[]), encode_png(&pixels).unwrap(), tiff.into_inner()]);
        let stack = read_stack(&paths, &|path| std::fs::read(path), &Exposures::Listed(vec![1.0, 2.0, 4.0])).unwrap();
        assert_eq!(stack.photographs()[1], pixels);
        assert_eq!(stack.photographs()[2], pixels);
    }
}
