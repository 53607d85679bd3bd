//! Distances as they go over the wire: whole, or of every so many columns and rows, as f32 or as 16 bits of inverse distance.

use bytes::Bytes;

use crate::errors::ApiError;
use crate::frames::compressed;

/// Most columns, and rows, of which one is told.
pub const MAX_STEP: u32 = 16;
/// Eight bits and more are left for the half of the distances that is nearer than the median.
const LEAST_OF_MEDIAN: f32 = 1.0 / 256.0;

/// What is told of them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DepthPlane {
    /// Of every distance.
    pub format: DepthFormat,
    /// Of so many columns, and rows, one: 1 to [`MAX_STEP`].
    pub step: u32,
}

/// How a distance is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DepthFormat {
    /// As it is.
    Float32,
    /// `round(65535 · nearest / distance)`, 0 for none.
    Inverse16,
}

/// Distances of a frame, encoded.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct EncodedDepth {
    /// One zstd frame.
    pub bytes: Bytes,
    /// Along a row.
    pub width_px: u32,
    /// Rows.
    pub height_px: u32,
    /// The least distance of those told; 0 for [`DepthFormat::Float32`], and where nothing was hit.
    pub nearest: f32,
}

impl DepthPlane {
    /// Of `distances`, rows of `width` from the top, +infinity for none.
    pub fn encode(self, distances: &[f32], width: u32) -> Result<EncodedDepth, ApiError> {
        let width = width as usize;
        let height = distances.len() / width;
        let told = |length: usize| (0..length.div_ceil(self.step as usize)).map(move |at| self.place(at, length));
        let picked: Vec<f32> = told(height).flat_map(|row| told(width).map(move |column| distances[row * width + column])).collect();
        let (bytes, nearest) = match self.format {
            DepthFormat::Float32 => (compressed(picked.iter().map(|v| v.to_le_bytes()))?, 0.0),
            DepthFormat::Inverse16 => {
                let nearest = nearest(&picked);
                (compressed(picked.iter().map(|d| inverse(*d, nearest).to_le_bytes()))?, nearest)
            }
        };
        Ok(EncodedDepth { bytes: bytes.into(), width_px: told(width).len() as u32, height_px: told(height).len() as u32, nearest })
    }

    /// The middle of the step, or the last there is.
    fn place(self, at: usize, length: usize) -> usize {
        let step = self.step as usize;
        (step * at + step / 2).min(length - 1)
    }
}

/// Of what was hit, but no less than a part of the median: a grain of dust before the camera does not take the codes from all else. 0 for none.
fn nearest(distances: &[f32]) -> f32 {
    let mut hit: Vec<f32> = distances.iter().copied().filter(|d| *d > 0.0 && d.is_finite()).collect();
    let middle = hit.len() / 2;
    if hit.is_empty() {
        return 0.0;
    }
    let (before, median, _) = hit.select_nth_unstable_by(middle, f32::total_cmp);
    before.iter().copied().fold(*median, f32::min).max(LEAST_OF_MEDIAN * *median)
}

/// 0 for what was not hit; what is nearer than the nearest, being closer than that to the camera or in it, is as near.
fn inverse(distance: f32, nearest: f32) -> u16 {
    if !(distance >= 0.0 && nearest > 0.0) {
        return 0;
    }
    (f32::from(u16::MAX) * (nearest / distance).min(1.0)).round() as u16
}

#[cfg(test)]
mod tests {
    use super::*;

    fn words<const N: usize>(encoded: &EncodedDepth) -> Vec<[u8; N]> {
        let bytes = zstd::bulk::decompress(&encoded.bytes, 1 << 16).unwrap();
        bytes.as_chunks::<N>().0.to_vec()
    }

    /// Ten columns, seven rows: 100 · row + column + 1.
    fn distances() -> Vec<f32> {
        (0..70).map(|at| (100 * (at / 10) + at % 10 + 1) as f32).collect()
    }

    #[test]
    fn a_step_picks_the_middle_of_each_part_and_the_last_of_a_rest() {
        for (step, columns, rows) in [
            (1, (0..10).collect::<Vec<_>>(), (0..7).collect::<Vec<_>>()),
            (3, vec![1, 4, 7, 9], vec![1, 4, 6]),
            (4, vec![2, 6, 9], vec![2, 6]),
            (16, vec![8], vec![6]),
        ] {
            let encoded = DepthPlane { format: DepthFormat::Float32, step }.encode(&distances(), 10).unwrap();
            assert_eq!((encoded.width_px as usize, encoded.height_px as usize), (columns.len(), rows.len()), "{step}");
            let expected: Vec<f32> = rows.iter().flat_map(|r| columns.iter().map(move |c| (100 * r + c + 1) as f32)).collect();
            assert_eq!(words(&encoded).into_iter().map(f32::from_le_bytes).collect::<Vec<_>>(), expected, "{step}");
        }
    }

    #[test]
    fn sixteen_bits_of_inverse_distance_are_as_exact_as_they_promise() {
        let mut distances: Vec<f32> = (1..=70).map(|distance| distance as f32).collect();
        distances[5] = f32::INFINITY;
        distances[6] = 1e9;
        let encoded = DepthPlane { format: DepthFormat::Inverse16, step: 1 }.encode(&distances, 10).unwrap();
        assert_eq!(encoded.nearest, 1.0);
        let codes: Vec<u16> = words(&encoded).into_iter().map(u16::from_le_bytes).collect();
        assert_eq!((codes[0], codes[5], codes[6]), (u16::MAX, 0, 0));
        for (distance, code) in distances.iter().zip(&codes).filter(|(_, code)| **code > 0) {
            let told = encoded.nearest * f32::from(u16::MAX) / f32::from(*code);
            let bound = 0.51 * told * distance / (encoded.nearest * f32::from(u16::MAX));
            assert!((told - distance).abs() <= bound + 1e-6 * distance, "{distance}: {told}");
        }
    }

    #[test]
    fn where_nothing_was_hit_nothing_is_told() {
        let encoded = DepthPlane { format: DepthFormat::Inverse16, step: 2 }.encode(&[f32::INFINITY; 6], 3).unwrap();
        assert_eq!((encoded.width_px, encoded.height_px, encoded.nearest), (2, 1, 0.0));
        assert_eq!(words::<2>(&encoded), [[0, 0]; 2]);
        // A camera inside a surface.
        let inverse = DepthPlane { format: DepthFormat::Inverse16, step: 1 };
        let encoded = inverse.encode(&[0.0, 2.0], 2).unwrap();
        assert_eq!((words(&encoded), encoded.nearest), (vec![u16::MAX.to_le_bytes(); 2], 2.0));
        // What is no distance is none, and dust takes nothing from what is behind it.
        let encoded = inverse.encode(&[f32::NAN, -1.0, 1e-6, 256.0, 256.0], 5).unwrap();
        let codes: Vec<u16> = words(&encoded).into_iter().map(u16::from_le_bytes).collect();
        assert_eq!((codes, encoded.nearest), (vec![0, 0, u16::MAX, 256, 256], 1.0));
        let encoded = inverse.encode(&[0.0, f32::INFINITY], 2).unwrap();
        assert_eq!((words::<2>(&encoded), encoded.nearest), (vec![[0, 0]; 2], 0.0));
    }
}
