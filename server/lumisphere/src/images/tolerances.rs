//! The four tolerances that tests may compare numbers with, and why each is what it is. There is no fifth: fields are private, so a
//! test cannot make its own, and one that needs more has found an error to understand.

/// How far an element may be from its reference: `|actual − reference| ≤ absolute + relative · |reference|`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tolerance {
    name: &'static str,
    absolute: f32,
    relative: f32,
}

impl Tolerance {
    /// Copies and equal operations in equal order: storage that is lossless, any number of threads, resumed jobs, counts and indices in
    /// float planes.
    pub const EXACT: Self = Self { name: "EXACT", absolute: 0.0, relative: 0.0 };

    /// The same formula in f32 with other contraction and order, as a GPU compiler is free to choose. WGSL allows 2.5 ULP for a division
    /// and 2 for an inverse square root; some 60 such operations in a row, ½–2.5 ULP of 6·10⁻⁸ each, reach 10⁻⁵. Terms of order 1 that
    /// cancel leave 16 ULP of 1.
    pub const F32_ARITHMETIC: Self = Self { name: "F32_ARITHMETIC", absolute: 1e-6, relative: 1e-5 };

    /// Values read through a computed texel coordinate. A direction that is off by 2·10⁻⁶ (F32_ARITHMETIC of its few operations) moves a
    /// coordinate by 5·10⁻⁴ of a texel in a 256² face, and texture units keep only 8 bits of the weight (1/512 of a texel at worst): the
    /// result moves by 2·10⁻³ of the difference between neighbouring texels, which is of the order of the value itself.
    pub const F32_LOOKUP: Self = Self { name: "F32_LOOKUP", absolute: 1e-3, relative: 2e-3 };

    /// Values stored as f16 and read back: half a step is 2⁻¹¹ = 4.9·10⁻⁴ of the value, or 2⁻²⁵ in the subnormal range; blends with weights
    /// that sum to 1 do not enlarge it, and their arithmetic adds 10⁻⁵.
    pub const F16_STORAGE: Self = Self { name: "F16_STORAGE", absolute: 1e-6, relative: 5e-4 };

    /// All of them.
    pub const ALL: [Self; 4] = [Self::EXACT, Self::F32_ARITHMETIC, Self::F32_LOOKUP, Self::F16_STORAGE];

    /// Its name, for messages.
    pub fn name(&self) -> &'static str {
        self.name
    }

    /// Greatest admissible |actual − reference|; 0 where the reference is infinite, which only itself equals.
    pub fn allowed(&self, reference: f32) -> f32 {
        if reference.is_infinite() { 0.0 } else { self.absolute + self.relative * reference.abs() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn f16_storage_holds_every_rounding_to_half() {
        // Each float between 2⁻²⁶ and 65000 in steps of 1/128 octave, at both ends and the middle of a half's step.
        for bits in (0x3280_0000..0x477d_0000u32).step_by(1 << 10) {
            let reference = f32::from_bits(bits);
            let stored = half::f16::from_f32(reference).to_f32();
            assert!((stored - reference).abs() <= Tolerance::F16_STORAGE.allowed(reference), "{reference} became {stored}");
        }
    }

    #[test]
    fn only_an_infinite_value_equals_an_infinite_reference() {
        for tolerance in Tolerance::ALL {
            assert_eq!(tolerance.allowed(f32::INFINITY), 0.0);
        }
    }
}
