//! Random numbers of one pixel: Owen-scrambled Sobol points, padded by two dimensions at a time.
//!
//! Source: Burley 2020, "Practical Hash-based Owen Scrambling" (JCGT 9/4); the permutation is the improved Laine–Karras hash of
//! Vegdahl 2021. Every pair of dimensions is its own (0, 2)-sequence, shuffled and scrambled by a hash of seed, pixel and
//! dimension, so the numbers depend on nothing else: not on threads, not on order.

use glam::Vec2;

/// Draws the numbers of one sample, in order. Cheap to copy.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SampleSequence {
    pixel: u32,
    sample: u32,
    dimension: u32,
}

impl SampleSequence {
    /// Numbers of sample `sample` of pixel `pixel`. Samples 0…2ᵏ−1 of a pixel are stratified together.
    pub fn new(seed: u64, pixel: u64, sample: u32) -> Self {
        Self { pixel: mix64(seed ^ mix64(pixel)) as u32, sample, dimension: 0 }
    }

    /// Two numbers in [0, 1), stratified together over the pixel's samples.
    #[inline]
    pub fn pair(&mut self) -> Vec2 {
        let key = mix32(self.pixel ^ self.dimension.wrapping_mul(0x9e37_79b9));
        self.dimension += 1;
        // A nested shuffle of the order keeps every prefix of 2ᵏ points stratified and decorrelates the pairs.
        let index = nested_permutation(self.sample.reverse_bits(), key).reverse_bits();
        let x = nested_permutation(index, mix32(key ^ 0xa511_e9b3));
        let y = nested_permutation(pascal(index), mix32(key ^ 0x6353_45ed));
        Vec2::new(unit(x.reverse_bits()), unit(y.reverse_bits()))
    }
}

/// A hash of all 64 bits (splitmix64's finaliser).
fn mix64(mut x: u64) -> u64 {
    x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ (x >> 31)
}

/// A hash of all 32 bits (Wellons 2018, "lowbias32").
#[inline]
fn mix32(mut x: u32) -> u32 {
    x = (x ^ (x >> 16)).wrapping_mul(0x7feb_352d);
    x = (x ^ (x >> 15)).wrapping_mul(0x846c_a68b);
    x ^ (x >> 16)
}

/// Permutes 32-bit numbers so that each bit is flipped by a hash of the bits *below* it: Owen scrambling of the reversed number.
#[inline]
fn nested_permutation(mut x: u32, key: u32) -> u32 {
    x ^= x.wrapping_mul(0x3d20_adea);
    x = x.wrapping_add(key);
    x = x.wrapping_mul((key >> 16) | 1);
    x ^= x.wrapping_mul(0x0552_6c56);
    x ^ x.wrapping_mul(0x53a2_2864)
}

/// The second Sobol dimension, bits reversed: the index times Pascal's triangle mod 2, which is [[1, 1], [0, 1]] ⊗ … five times.
#[inline]
fn pascal(mut x: u32) -> u32 {
    x ^= (x & 0xaaaa_aaaa) >> 1;
    x ^= (x & 0xcccc_cccc) >> 2;
    x ^= (x & 0xf0f0_f0f0) >> 4;
    x ^= (x & 0xff00_ff00) >> 8;
    x ^ ((x & 0xffff_0000) >> 16)
}

/// The upper 24 bits as a number in [0, 1).
#[inline]
fn unit(x: u32) -> f32 {
    (x >> 8) as f32 * (1.0 / 16_777_216.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_elementary_interval_of_the_first_sixteen_points_holds_one() {
        for pixel in 0..50 {
            for pair in 0..4 {
                let points: Vec<Vec2> = (0..16)
                    .map(|sample| {
                        let mut sequence = SampleSequence::new(7, pixel, sample);
                        (0..pair).for_each(|_| _ = sequence.pair());
                        sequence.pair()
                    })
                    .collect();
                // A (0, 4, 2)-net in base 2: 2^a × 2^(4−a) cells hold one point each, for every a.
                for a in 0..=4 {
                    let (columns, rows) = (1usize << a, 16usize >> a);
                    let mut cells = [0; 16];
                    points.iter().for_each(|p| cells[(p.y * rows as f32) as usize * columns + (p.x * columns as f32) as usize] += 1);
                    assert_eq!(cells, [1; 16], "pixel {pixel}, pair {pair}, {columns} x {rows}");
                }
            }
        }
    }

    #[test]
    fn pixels_pairs_and_seeds_are_uncorrelated() {
        let first = |seed, pixel, pair| {
            let mut sequence = SampleSequence::new(seed, pixel, 0);
            (0..pair).for_each(|_| _ = sequence.pair());
            sequence.pair() - 0.5
        };
        let n = 20_000u64;
        // The next pixel, the next pair, the next seed.
        for (seed, pixel_step, pair) in [(1, 1, 0), (1, 0, 1), (2, 0, 0)] {
            let products = (0..n).map(|p| first(1, p, 0) * first(seed, p + pixel_step, pair));
            let mean = products.fold(Vec2::ZERO, |sum, p| sum + p) / n as f32;
            // The product of two independent uniforms of variance 1/12 has standard deviation 1/12: 4.5 σ of the mean.
            let bound = 4.5 / 12.0 / (n as f32).sqrt();
            assert!(mean.abs().max_element() < bound, "{mean} beyond {bound}");
        }
    }
}
