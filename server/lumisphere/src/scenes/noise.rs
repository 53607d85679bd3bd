//! Noise for generated textures, skies and foliage: integer hashes, so that a seed gives the same bytes everywhere.

/// Uniform in [0, 1) from a lattice point.
pub(super) fn unit(seed: u32, x: i32, y: i32) -> f32 {
    // PCG output permutation over a mixed key (Jarzynski and Olano 2020, "Hash Functions for GPU Rendering").
    let mut state = seed.wrapping_mul(0x9E37_79B9) ^ (x as u32).wrapping_mul(0x85EB_CA6B) ^ (y as u32).wrapping_mul(0xC2B2_AE35);
    for _ in 0..2 {
        state = state.wrapping_mul(747_796_405).wrapping_add(2_891_336_453);
        let word = ((state >> ((state >> 28) + 4)) ^ state).wrapping_mul(277_803_737);
        state = (word >> 22) ^ word;
    }
    (state >> 8) as f32 / (1u32 << 24) as f32
}

/// Value noise in [0, 1), smooth, repeating every `period` lattice steps in x and y.
pub(super) fn value(seed: u32, x: f32, y: f32, period: i32) -> f32 {
    let (x0, y0) = (x.floor(), y.floor());
    let smooth = |t: f32| t * t * (3.0 - 2.0 * t);
    let (fx, fy) = (smooth(x - x0), smooth(y - y0));
    let at = |dx: i32, dy: i32| unit(seed, (x0 as i32 + dx).rem_euclid(period), (y0 as i32 + dy).rem_euclid(period));
    let row = |dy: i32| at(0, dy) + fx * (at(1, dy) - at(0, dy));
    row(0) + fy * (row(1) - row(0))
}

/// Sum of `octaves` value noises, each twice as fine and half as strong; in [0, 1).
pub(super) fn fractal(seed: u32, x: f32, y: f32, period: i32, octaves: u32) -> f32 {
    let (mut sum, mut weight) = (0.0, 0.0);
    for k in 0..octaves {
        let (scale, strength) = ((1 << k) as f32, 0.5f32.powi(k as i32));
        sum += strength * value(seed.wrapping_add(k), x * scale, y * scale, period << k);
        weight += strength;
    }
    sum / weight
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hashes_are_uniform_and_noise_repeats_and_is_continuous() {
        let mean = (0..10_000).map(|i| unit(1, i % 100, i / 100)).sum::<f32>() / 1e4;
        // Standard deviation of the mean: 1/√12/100 = 0.0029; five of them.
        assert!((mean - 0.5).abs() < 0.0145, "{mean}");
        assert!((fractal(3, 0.3, 1.7, 4, 3) - fractal(3, 4.3, 5.7, 4, 3)).abs() < 1e-5);
        assert!((value(3, 1.999_9, 0.5, 8) - value(3, 2.000_1, 0.5, 8)).abs() < 1e-3);
    }
}
