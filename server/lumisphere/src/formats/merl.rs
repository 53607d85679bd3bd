//! MERL's binary tables of measured reflectance (Matusik et al. 2003; the layout is that of the authors' reader).
//!
//! Three 32-bit counts (90 half angles, 90 difference angles, 180 turns), then the red, the green and the blue plane as f64, all
//! little-endian. Values are scaled by 1/1500, 1.15/1500 and 1.66/1500; negative ones mark what was not measured, and are black here.

use glam::Vec3;
use thiserror::Error;

use crate::radiometry::brdf::{BrdfError, MEASURED_SHAPE, Measured};

/// Why a file is no such table.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum MerlError {
    /// Its head counts other angles.
    #[error("table of {found:?} angles, {MEASURED_SHAPE:?} expected")]
    Shape {
        /// As the file says.
        found: [i32; 3],
    },
    /// Cut off, or something follows.
    #[error("table has {bytes} bytes, {expected} expected")]
    Length {
        /// Of the file.
        bytes: usize,
        /// Of every such file.
        expected: usize,
    },
    /// A value is NaN, infinite or beyond f32.
    #[error("value {index} of channel {channel} is not finite")]
    NotFinite {
        /// 0 red, 1 green, 2 blue.
        channel: usize,
        /// Within the plane.
        index: usize,
    },
    /// Values that are no reflectance.
    #[error("{0}")]
    Brdf(#[from] BrdfError),
}

const HEAD_BYTES: usize = 12;

/// Of every file.
pub const FILE_BYTES: u64 = (HEAD_BYTES + 3 * 8 * MEASURED_SHAPE[0] * MEASURED_SHAPE[1] * MEASURED_SHAPE[2]) as u64;

/// What the authors' reader multiplies each plane with.
const SCALE: [f64; 3] = [1.0 / 1500.0, 1.15 / 1500.0, 1.66 / 1500.0];

/// The table of a file.
pub fn read(bytes: &[u8]) -> Result<Measured, MerlError> {
    let count: usize = MEASURED_SHAPE.iter().product();
    let expected = HEAD_BYTES + 3 * 8 * count;
    let Some((head, planes)) = bytes.split_first_chunk::<HEAD_BYTES>() else {
        return Err(MerlError::Length { bytes: bytes.len(), expected });
    };
    let found = [0, 4, 8].map(|at| i32::from_le_bytes([head[at], head[at + 1], head[at + 2], head[at + 3]]));
    if found != MEASURED_SHAPE.map(|n| n as i32) {
        return Err(MerlError::Shape { found });
    }
    if bytes.len() != expected {
        return Err(MerlError::Length { bytes: bytes.len(), expected });
    }
    let mut values = vec![Vec3::ZERO; count];
    let (numbers, _) = planes.as_chunks::<8>();
    for (at, number) in numbers.iter().enumerate() {
        let (channel, index) = (at / count, at % count);
        let value = (f64::from_le_bytes(*number) * SCALE[channel]) as f32;
        if !value.is_finite() {
            return Err(MerlError::NotFinite { channel, index });
        }
        values[index][channel] = value.max(0.0);
    }
    Ok(Measured::new(values)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::radiometry::brdf::Brdf;

    const COUNT: usize = 90 * 90 * 180;

    fn file(value: impl Fn(usize, usize) -> f64) -> Vec<u8> {
        let mut bytes: Vec<u8> = [90i32, 90, 180].iter().flat_map(|n| n.to_le_bytes()).collect();
        (0..3).for_each(|channel| (0..COUNT).for_each(|i| bytes.extend(value(channel, i).to_le_bytes())));
        bytes
    }

    #[test]
    fn planes_become_colours_in_the_authors_scale() {
        let read = read(&file(|channel, i| if i == 0 { -1.0 } else { [300.0, 150.0, 75.0][channel] })).unwrap();
        let slanted = Vec3::new(0.6, 0.0, 0.8);
        let value = read.eval(slanted, Vec3::new(0.0, 0.6, 0.8));
        assert!((value - Vec3::new(0.2, 0.115, 0.083)).abs().max_element() < 1e-6, "{value}");
        // Cell 0 is light straight back along the normal; it was not measured.
        assert_eq!(read.eval(Vec3::Z, Vec3::Z), Vec3::ZERO);
    }

    #[test]
    fn a_file_that_is_no_table_is_refused_by_what_is_wrong_with_it() {
        let whole = file(|_, _| 1.0);
        let expected = whole.len();
        for length in [0, 4, 11] {
            assert_eq!(read(&whole[..length]).unwrap_err(), MerlError::Length { bytes: length, expected });
        }
        for length in [12, 1000, expected - 1] {
            assert_eq!(read(&whole[..length]).unwrap_err(), MerlError::Length { bytes: length, expected });
        }
        assert!(matches!(read(&[whole.clone(), vec![0]].concat()).unwrap_err(), MerlError::Length { .. }));
        let mut other = whole.clone();
        other[8..12].copy_from_slice(&360i32.to_le_bytes());
        assert_eq!(read(&other).unwrap_err(), MerlError::Shape { found: [90, 90, 360] });
        for bad in [f64::NAN, f64::INFINITY, 1e300] {
            let broken = file(|channel, i| if (channel, i) == (2, 5) { bad } else { 1.0 });
            assert_eq!(read(&broken).unwrap_err(), MerlError::NotFinite { channel: 2, index: 5 });
        }
    }
}
