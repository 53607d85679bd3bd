//! Coarser levels of cube-map faces, for reads over more than a texel: each is the one before it, halved.
//!
//! Level 0 is the faces as captured: R, G, B, distance. Level l ≥ 1 has faces of size / 2ˡ texels an edge, R, G, B and the share of the texel
//! through which light comes from infinity; a texel is the mean of four of the level before, as that is stored. Halving goes on while sizes are even and at least [`LEAST_FACE_SIZE`] texels result.

use crate::textures::{Page, PageShape, StoreError};

/// No level's faces are smaller: a quarter of a face is all that a pixel is ever read over.
pub const LEAST_FACE_SIZE: u32 = 4;

/// How many levels there are above the finest for faces of `size` texels an edge.
pub fn coarser_levels(size: u32) -> u32 {
    (1..).take_while(|level| size.is_multiple_of(1 << level) && size >> level >= LEAST_FACE_SIZE).count() as u32
}

/// Half as many rows and columns, of a page that has even numbers of both, with its first `channels` channels. What is not finite is left
/// out of a mean; where nothing is left it is 0.
pub fn halved(page: &Page, channels: u32) -> Result<Page, StoreError> {
    let PageShape { width, height, channels: stored, pixel } = page.shape();
    let values = page.to_f32();
    let shape = PageShape { width: width / 2, height: height / 2, channels, pixel };
    let (row, texel) = (page.shape().row_values(), stored as usize);
    let mut means = Vec::with_capacity(shape.values());
    for (y, x) in (0..shape.height as usize).flat_map(|y| (0..shape.width as usize).map(move |x| (y, x))) {
        let first = 2 * y * row + 2 * x * texel;
        for channel in first..first + channels as usize {
            means.push(mean([channel, channel + texel, channel + row, channel + row + texel].map(|i| values[i])));
        }
    }
    Page::from_f32(shape, &means)
}

fn mean(values: [f32; 4]) -> f32 {
    let sum = values[0] + values[1] + (values[2] + values[3]);
    if sum.is_finite() {
        return 0.25 * sum;
    }
    let (sum, count) = values.into_iter().filter(|v| v.is_finite()).fold((0f32, 0f32), |(sum, count), v| (sum + 0.25 * v, count + 0.25));
    if count > 0.0 { sum / count } else { 0.0 }
}

/// A face with shares in place of its distances: 1 where a texel sees infinitely far, 0 where not.
pub fn with_sky_shares(face: &Page) -> Result<Page, StoreError> {
    let shape = face.shape();
    if shape.channels != 4 {
        return Err(StoreError::InvalidPage { reason: format!("{} channels, R, G, B and distance expected", shape.channels) });
    }
    let mut values = face.to_f32();
    values.iter_mut().skip(3).step_by(4).for_each(|distance| *distance = sky_share(*distance, 0));
    Page::from_f32(shape, &values)
}

/// The share of a texel through which light comes from infinity, told by the fourth channel of its level.
pub fn sky_share(fourth: f32, level: u32) -> f32 {
    if level > 0 {
        return fourth;
    }
    if fourth == f32::INFINITY { 1.0 } else { 0.0 }
}

/// Of what is stored, scene units: its inverse is far from overflow.
const LEAST_DISTANCE: f32 = 1e-30;

/// 1 / distance; 0 where nothing is seen. What is not at least [`LEAST_DISTANCE`] was not stored and counts as infinitely far.
pub fn inverse_distance(distance: f32) -> f32 {
    if (LEAST_DISTANCE..=f32::MAX).contains(&distance) { 1.0 / distance } else { 0.0 }
}

/// The fourth channel of a face, halved `levels` times: distances, of which the inverse is averaged (0 for what is infinitely far), since that is
/// linear over a plane.
pub fn halved_distances(face: &Page, levels: u32) -> Vec<f32> {
    let (values, size, step) = (face.to_f32(), (face.shape().width >> levels) as usize, 1usize << levels);
    let (row, texel) = (face.shape().row_values(), face.shape().channels as usize);
    let inverse = |y: usize, x: usize| inverse_distance(values[y * row + x * texel + 3]);
    let mean = |y: usize, x: usize| {
        let all = (0..step * step).map(|k| inverse(y * step + k / step, x * step + k % step));
        all.sum::<f32>() / (step * step) as f32
    };
    (0..size * size).map(|at| 1.0 / mean(at / size, at % size)).collect()
}

/// A page above another, of one width and format: what is below the first.
pub fn stacked(faces: &[Page]) -> Result<Page, StoreError> {
    let shape = faces.first().map(Page::shape).ok_or_else(|| StoreError::InvalidPage { reason: "no faces".into() })?;
    let values: Vec<f32> = faces.iter().flat_map(Page::to_f32).collect();
    Page::from_f32(PageShape { height: shape.height * faces.len() as u32, ..shape }, &values)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::textures::PixelFormat;

    #[test]
    fn levels_end_at_four_texels_or_an_odd_size() {
        assert_eq!([4, 8, 21, 64, 96, 100, 128, 1024].map(coarser_levels), [0, 1, 0, 4, 4, 2, 5, 8]);
    }

    #[test]
    fn a_texel_is_the_mean_of_the_four_below_it_and_what_is_not_finite_is_left_out() {
        let shape = PageShape { width: 4, height: 2, channels: 2, pixel: PixelFormat::F32 };
        let (nan, inf) = (f32::NAN, f32::INFINITY);
        let rows = [[1.0, 9.0, 2.0, 9.0, nan, 9.0, 6.0, 9.0], [3.0, 9.0, 6.0, 9.0, 2.0, 9.0, inf, 9.0]];
        let page = Page::from_f32(shape, rows.as_flattened()).unwrap();
        assert_eq!(halved(&page, 1).unwrap().to_f32(), [3.0, 4.0]);
        assert_eq!(halved(&page, 2).unwrap().to_f32(), [3.0, 9.0, 4.0, 9.0]);
        let dark = Page::from_f32(PageShape { width: 2, height: 2, channels: 1, ..shape }, &[nan; 4]).unwrap();
        assert_eq!(halved(&dark, 1).unwrap().to_f32(), [0.0]);
    }

    #[test]
    fn distances_are_halved_as_their_inverses_and_what_is_infinitely_far_counts_nothing() {
        let shape = PageShape { width: 2, height: 2, channels: 4, pixel: PixelFormat::F32 };
        let halved = |distances: [f32; 4]| {
            let texels: Vec<f32> = distances.iter().flat_map(|d| [9.0, 9.0, 9.0, *d]).collect();
            halved_distances(&Page::from_f32(shape, &texels).unwrap(), 1)
        };
        assert_eq!(halved([1.0, 1.0, 0.5, f32::INFINITY]), [1.0]);
        assert_eq!(halved([f32::INFINITY; 4]), [f32::INFINITY]);
    }
}
