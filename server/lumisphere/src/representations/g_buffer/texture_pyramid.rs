//! Albedo textures with their coarser levels, as both twins read them: f16 texels in one array.

use std::ops::Range;

use glam::{Vec2, Vec3};
use half::f16;

use crate::scenes::Texture;

/// One level of one texture. On the device its four words are an element of a table.
#[derive(Debug, Clone, Copy, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(crate) struct Level {
    /// First texel in `TexturePyramids::texels`.
    pub first_texel: u32,
    pub width: u32,
    pub height: u32,
    pub padding: u32,
}

/// Every texture's levels, finest first, each half as large as the one before (rounded up), down to one texel.
#[derive(Debug, Default)]
pub(crate) struct TexturePyramids {
    pub levels: Vec<Level>,
    /// R, G, B, unused; rows from the top.
    pub texels: Vec<[f16; 4]>,
    of_texture: Vec<Range<usize>>,
}

// Twelve million texels of 8 bytes, 96 MiB: backgrounds are not worth more of the device.
const MAX_TEXELS: usize = 12 << 20;

impl TexturePyramids {
    pub fn new(textures: &[Texture]) -> Self {
        // All textures lose their finest levels together until everything fits: backgrounds are not worth more.
        let size_at = |drop: u32| {
            textures.iter().map(|t| 4 * t.image.width.div_ceil(1 << drop) * t.image.height.div_ceil(1 << drop) / 3 + 64).sum::<usize>()
        };
        let drop = (0..31).find(|d| size_at(*d) <= MAX_TEXELS).unwrap_or(31);
        let mut pyramids = Self::default();
        for texture in textures {
            let first = pyramids.levels.len();
            let (mut width, mut height) = (texture.image.width, texture.image.height);
            let mut level: Vec<Vec3> = (0..width * height).map(|i| Vec3::from(texture.image.rgb(i))).collect();
            for depth in 0.. {
                if depth >= drop || width * height == 1 {
                    pyramids.push(&level, width, height);
                }
                if width * height == 1 {
                    break;
                }
                level = halved(&level, width, height);
                (width, height) = (width.div_ceil(2), height.div_ceil(2));
            }
            pyramids.of_texture.push(first..pyramids.levels.len());
        }
        pyramids
    }

    fn push(&mut self, level: &[Vec3], width: usize, height: usize) {
        let first_texel = self.texels.len() as u32;
        self.levels.push(Level { first_texel, width: width as u32, height: height as u32, padding: 0 });
        self.texels.extend(level.iter().map(|c| [f16::from_f32(c.x), f16::from_f32(c.y), f16::from_f32(c.z), f16::ZERO]));
    }

    /// Which levels are texture `t`'s.
    pub fn of_texture(&self, t: usize) -> Range<usize> {
        self.of_texture[t].clone()
    }

    /// Texels along the edges of texture `t`'s finest level.
    pub fn size(&self, t: usize) -> Vec2 {
        let finest = self.levels[self.of_texture[t].start];
        Vec2::new(finest.width as f32, finest.height as f32)
    }

    /// Linear RGB at `uv` for a pixel that covers `footprint` texels of the finest level; trilinear, repeating, v up.
    pub fn texture_color(&self, first_level: u32, level_count: u32, uv: Vec2, footprint: f32) -> Vec3 {
        // Levels between powers of two are blended linearly in the footprint, by its exponent and mantissa: exact on every device.
        let bits = footprint.max(1.0).to_bits();
        let level = ((bits >> 23) - 127).min(level_count - 1);
        let coarser = (level + 1).min(level_count - 1);
        let fraction = f32::from_bits(bits & 0x007f_ffff | 0x3f80_0000) - 1.0;
        let fine = self.level_color(first_level + level, uv);
        fine + fraction * (self.level_color(first_level + coarser, uv) - fine)
    }

    fn level_color(&self, level: u32, uv: Vec2) -> Vec3 {
        let level = self.levels[level as usize];
        let repeated = uv - uv.floor();
        let x = repeated.x * level.width as f32 - 0.5;
        let y = (1.0 - repeated.y) * level.height as f32 - 0.5;
        let (x0, y0) = (x.floor(), y.floor());
        let (fx, fy) = (x - x0, y - y0);
        let texel = |dx: i32, dy: i32| {
            let column = (x0 as i32 + dx + level.width as i32) as u32 % level.width;
            let row = (y0 as i32 + dy + level.height as i32) as u32 % level.height;
            let [r, g, b, _] = self.texels[(level.first_texel + row * level.width + column) as usize];
            Vec3::new(r.to_f32(), g.to_f32(), b.to_f32())
        };
        let top = texel(0, 0) + fx * (texel(1, 0) - texel(0, 0));
        let bottom = texel(0, 1) + fx * (texel(1, 1) - texel(0, 1));
        top + fy * (bottom - top)
    }
}

// Means of 2×2 texels; an odd last row or column counts twice.
fn halved(level: &[Vec3], width: usize, height: usize) -> Vec<Vec3> {
    let at = |x: usize, y: usize| level[y.min(height - 1) * width + x.min(width - 1)];
    let (half_width, half_height) = (width.div_ceil(2), height.div_ceil(2));
    (0..half_width * half_height)
        .map(|i| {
            let (x, y) = (2 * (i % half_width), 2 * (i / half_width));
            0.25 * (at(x, y) + at(x + 1, y) + at(x, y + 1) + at(x + 1, y + 1))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::images::Image;

    fn checkered() -> Texture {
        let mut image = Image::zeros(8, 4, 3);
        for i in 0..32 {
            image.set_rgb(i, if (i % 8 + i / 8) % 2 == 0 { [1.0, 0.5, 0.0] } else { [0.0, 0.5, 1.0] });
        }
        Texture { image }
    }

    #[test]
    fn a_sharp_read_equals_the_scenes_own_texture() {
        let texture = checkered();
        let pyramids = TexturePyramids::new(std::slice::from_ref(&texture));
        for i in 0..100 {
            let (u, v) = (-1.3 + 0.031 * i as f32, 2.7 - 0.047 * i as f32);
            let read = pyramids.texture_color(0, pyramids.of_texture(0).len() as u32, Vec2::new(u, v), 0.7);
            // Values of the test texture are exact in f16; the rest is f32 rounding at |uv| < 3 times 8 texels.
            assert!((read - texture.sample(u, v)).length() < 1e-4, "{u} {v}");
        }
    }

    #[test]
    fn a_read_from_afar_is_the_mean() {
        let pyramids = TexturePyramids::new(&[checkered()]);
        let read = pyramids.texture_color(0, pyramids.of_texture(0).len() as u32, Vec2::new(0.3, 0.6), 1e6);
        assert!((read - Vec3::splat(0.5)).length() < 1e-6);
    }
}
