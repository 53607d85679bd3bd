//! The coarse level on the device: every cube map's faces, small enough to be always resident. Stands in for pages that are not there.
//!
//! Read from its own pages when a frame first needs it. R, G, B share an exponent (RGB9E5, 4 bytes): off by at most 2⁻⁹ of the largest
//! channel, far below what 16² texels for a face leave out.

use glam::Vec3;
use rayon::prelude::*;

use super::OffsetSurfaceLightField;
use crate::directions::{CubeMap, FACES};
use crate::gpu::{Gpu, storage_buffer};
use crate::representations::RenderError;
use crate::representations::page_source::CountingSource;
use crate::textures::PageId;

/// The coarse level takes at most this part of the budget: it is shrunk until it does.
const BUDGET_SHARE: u64 = 16;

/// Faces of `size`² texels, and a single word until they are read.
pub(super) struct Coarse {
    pub size: u32,
    pub texels: wgpu::Buffer,
    is_filled: bool,
}

impl Coarse {
    /// Room in the plan, nothing on the device yet.
    pub fn planned(gpu: &Gpu, field: &OffsetSurfaceLightField, budget_bytes: u64) -> Self {
        let fits = |size: &u32| bytes(field, *size) <= budget_bytes / BUDGET_SHARE;
        let stored = field.parameters.coarse_face_size_texels;
        // One texel a face, at the least: where that is too much for its share, nothing else of the dataset fits either.
        let size = (0..).map(|halvings| stored >> halvings).find(|size| *size <= 1 || fits(size)).unwrap_or(0);
        Self { size, texels: storage_buffer(gpu, "coarse level", &[0u32], wgpu::BufferUsages::empty()), is_filled: false }
    }

    /// When filled.
    pub fn bytes(&self, field: &OffsetSurfaceLightField) -> u64 {
        bytes(field, self.size)
    }

    /// Of these, not on the device yet.
    pub fn unfilled_bytes(&self, field: &OffsetSurfaceLightField) -> u64 {
        if self.is_filled { 0 } else { bytes(field, self.size) }
    }

    /// Whether the dataset has one.
    pub fn exists(&self) -> bool {
        self.size > 0
    }

    /// Reads it, unless that was done. True where `texels` is another buffer than before.
    pub fn fill(&mut self, gpu: &Gpu, field: &OffsetSurfaceLightField, pages: &CountingSource<'_>) -> Result<bool, RenderError> {
        if self.is_filled {
            return Ok(false);
        }
        let read = |cube: usize| read_cube_map(field, cube, self.size as usize, pages);
        let cubes: Vec<Vec<u32>> = (0..field.cube_count()).into_par_iter().map(read).collect::<Result<_, _>>()?;
        gpu.check_binding("the coarse level", self.bytes(field))?;
        self.texels = storage_buffer(gpu, "coarse level", &cubes.concat(), wgpu::BufferUsages::empty());
        self.is_filled = true;
        gpu.check()?;
        Ok(true)
    }
}

fn bytes(field: &OffsetSurfaceLightField, size: u32) -> u64 {
    4 * field.face_count() as u64 * u64::from(size).pow(2)
}

/// Cube map `cube` with faces of `size`² texels, packed, from its coarse page.
pub(super) fn read_cube_map(
    field: &OffsetSurfaceLightField,
    cube: usize,
    size: usize,
    pages: &CountingSource<'_>,
) -> Result<Vec<u32>, RenderError> {
    let number = (field.face_count() + cube) as u32;
    let page = pages.page(PageId(number))?;
    let (stored, shape) = (field.parameters.coarse_face_size_texels, page.shape());
    if (shape.width, shape.height) != (stored, FACES as u32 * stored) || shape.channels < 3 {
        let (width, height, channels) = (shape.width, shape.height, shape.channels);
        return Err(RenderError::PageShape { page: number, width, height, channels, expected: stored });
    }
    let texels: Vec<[f32; 4]> =
        (0..shape.height).flat_map(|y| (0..shape.width).map(move |x| (x, y))).map(|(x, y)| page.texel(x, y)).collect();
    let shrunk = crate::capture::shrunk_faces(&CubeMap { size: stored as usize, texels }, size);
    Ok(shrunk.into_iter().map(|c| packed(c.into())).collect())
}

// 2⁻²⁴ is the smallest step: exponents run from −15, mantissas have 9 bits below the point.
const EXPONENT_BIAS: i32 = 15;
const MANTISSA_BITS: i32 = 9;
const LARGEST: f32 = 65408.0;

/// RGB9E5 as graphics interfaces define it; negative counts as 0, NaN too.
pub(super) fn packed(color: Vec3) -> u32 {
    let [r, g, b] = color.to_array().map(|c| if c > 0.0 { c.min(LARGEST) } else { 0.0 });
    let highest = r.max(g).max(b);
    let floor_log = (highest.to_bits() >> 23) as i32 - 127;
    let mut exponent = floor_log.max(-EXPONENT_BIAS - 1) + 1 + EXPONENT_BIAS;
    let step = |exponent: i32| 2f32.powi(exponent - EXPONENT_BIAS - MANTISSA_BITS);
    if (highest / step(exponent)).round() >= 512.0 {
        exponent += 1;
    }
    let [r, g, b] = [r, g, b].map(|c| (c / step(exponent)).round() as u32);
    r | g << 9 | b << 18 | (exponent as u32) << 27
}

/// Inverse of `packed`.
#[cfg(test)]
pub(super) fn unpacked(word: u32) -> Vec3 {
    let step = f32::from_bits(((word >> 27) + 103) << 23);
    step * Vec3::new((word & 0x1ff) as f32, (word >> 9 & 0x1ff) as f32, (word >> 18 & 0x1ff) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packing_keeps_every_channel_to_half_a_step_of_the_largest() {
        for k in 0..4000 {
            let highest = 2f32.powf(-13.9 + 0.0074 * k as f32);
            for color in [Vec3::new(highest, 0.3 * highest, 0.0), Vec3::new(0.11 * highest, 0.77 * highest, highest)] {
                // 9 bits for a mantissa in [½, 1): a step is at most 2⁻⁸ of the largest channel.
                let error = (unpacked(packed(color)) - color).abs().max_element();
                assert!(error <= highest / 512.0 * 1.001, "{color}: off by {error}");
            }
        }
    }

    #[test]
    fn what_is_no_radiance_packs_as_a_sensible_one() {
        assert_eq!(unpacked(packed(Vec3::new(-1.0, f32::NAN, 0.0))), Vec3::ZERO);
        assert_eq!(unpacked(packed(Vec3::splat(f32::INFINITY))), Vec3::splat(LARGEST));
    }
}
