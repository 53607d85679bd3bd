//! Numbers of several texels side by side, one to a lane of a vector register: the arithmetic that the kernels are written in.
//!
//! `F32<S>` and `F64<S>` wrap the registers of `pulp`, which picks AVX-512, AVX2 + FMA, NEON or plain numbers when the program runs and
//! needs no unsafe code from us. Every operation works lane by lane, so a texel's result depends neither on its neighbours nor on the
//! register's width. All is `inline(always)`: the registers exist only inside of `pulp`'s dispatched function.

use std::ops::{Add, BitAnd, BitOr, Div, Mul, Neg, Not, Sub};

use pulp::Simd;

/// Texels to a group: the lanes of the widest register, 16 numbers of 32 bits.
pub const GROUP: usize = 16;

/// One number for each texel of a group.
pub type Row = [f32; GROUP];

/// As many texels of a group as a register holds.
pub trait Lanes: Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Div<Output = Self> + Neg<Output = Self> {
    /// The instruction set.
    type Token: Simd;
    /// A truth value for each lane.
    type Mask: Copy + BitAnd<Output = Self::Mask> + BitOr<Output = Self::Mask> + Not<Output = Self::Mask>;
    /// How many: `GROUP` is a multiple.
    const COUNT: usize;
    /// Relative precision of one number.
    const EPSILON: f64;

    /// The same number in every lane.
    fn splat(token: Self::Token, value: f64) -> Self;
    /// Lanes `part · COUNT ..` of a row.
    fn load(token: Self::Token, row: &Row, part: usize) -> Self;
    /// The reverse of `load`.
    fn store(self, row: &mut Row, part: usize);
    /// `self · factor + term`, rounded once where the machine can.
    fn mul_add(self, factor: Self, term: Self) -> Self;
    /// The larger.
    fn max(self, other: Self) -> Self;
    /// The smaller.
    fn min(self, other: Self) -> Self;
    /// Without its sign.
    fn abs(self) -> Self;
    /// Square root.
    fn sqrt(self) -> Self;
    /// Natural logarithm of a positive normal number.
    fn ln(self) -> Self;
    /// e to the power of `self`; below −40 as at −40, whose square is still a normal number.
    fn exp(self) -> Self;
    /// `self < other`, lane by lane; false for NaN.
    fn below(self, other: Self) -> Self::Mask;
    /// `self` where `mask`, else `other`.
    fn or(self, mask: Self::Mask, other: Self) -> Self;
    /// Whether any lane is true. `self` only tells the instruction set.
    fn any(self, mask: Self::Mask) -> bool;
}

macro_rules! lanes {
    ($name:ident, $mask_name:ident, $vector:ident, $mask:ident, $count:ident, $add:ident, $sub:ident, $mul:ident, $div:ident, $neg:ident,
     $and:ident, $or:ident, $not:ident) => {
        /// Numbers of one register.
        #[derive(Clone, Copy)]
        pub struct $name<S: Simd>(S, S::$vector);

        /// Truth values of one register.
        #[derive(Clone, Copy)]
        pub struct $mask_name<S: Simd>(S, S::$mask);

        impl<S: Simd> Add for $name<S> {
            type Output = Self;
            #[inline(always)]
            fn add(self, other: Self) -> Self {
                Self(self.0, self.0.$add(self.1, other.1))
            }
        }
        impl<S: Simd> Sub for $name<S> {
            type Output = Self;
            #[inline(always)]
            fn sub(self, other: Self) -> Self {
                Self(self.0, self.0.$sub(self.1, other.1))
            }
        }
        impl<S: Simd> Mul for $name<S> {
            type Output = Self;
            #[inline(always)]
            fn mul(self, other: Self) -> Self {
                Self(self.0, self.0.$mul(self.1, other.1))
            }
        }
        impl<S: Simd> Div for $name<S> {
            type Output = Self;
            #[inline(always)]
            fn div(self, other: Self) -> Self {
                Self(self.0, self.0.$div(self.1, other.1))
            }
        }
        impl<S: Simd> Neg for $name<S> {
            type Output = Self;
            #[inline(always)]
            fn neg(self) -> Self {
                Self(self.0, self.0.$neg(self.1))
            }
        }
        impl<S: Simd> BitAnd for $mask_name<S> {
            type Output = Self;
            #[inline(always)]
            fn bitand(self, other: Self) -> Self {
                Self(self.0, self.0.$and(self.1, other.1))
            }
        }
        impl<S: Simd> BitOr for $mask_name<S> {
            type Output = Self;
            #[inline(always)]
            fn bitor(self, other: Self) -> Self {
                Self(self.0, self.0.$or(self.1, other.1))
            }
        }
        impl<S: Simd> Not for $mask_name<S> {
            type Output = Self;
            #[inline(always)]
            fn not(self) -> Self {
                Self(self.0, self.0.$not(self.1))
            }
        }
    };
}

lanes!(F32, M32, f32s, m32s, F32_LANES, add_f32s, sub_f32s, mul_f32s, div_f32s, neg_f32s, and_m32s, or_m32s, not_m32s);
lanes!(F64, M64, f64s, m64s, F64_LANES, add_f64s, sub_f64s, mul_f64s, div_f64s, neg_f64s, and_m64s, or_m64s, not_m64s);

impl<S: Simd> F32<S> {
    #[inline(always)]
    fn bits(self) -> S::u32s {
        self.0.transmute_u32s_f32s(self.1)
    }

    #[inline(always)]
    fn from_bits(token: S, bits: S::u32s) -> Self {
        Self(token, token.transmute_f32s_u32s(bits))
    }

    /// `Σ coefficients[i] · self^i`, highest first.
    #[inline(always)]
    fn polynomial<const N: usize>(self, coefficients: [f32; N]) -> Self {
        let mut sum = Self::splat(self.0, 0.0);
        for coefficient in coefficients {
            sum = sum.mul_add(self, Self::splat(self.0, f64::from(coefficient)));
        }
        sum
    }
}

impl<S: Simd> Lanes for F32<S> {
    type Token = S;
    type Mask = M32<S>;
    const COUNT: usize = S::F32_LANES;
    const EPSILON: f64 = f32::EPSILON as f64;

    #[inline(always)]
    fn splat(token: S, value: f64) -> Self {
        Self(token, token.splat_f32s(value as f32))
    }
    #[inline(always)]
    fn load(token: S, row: &Row, part: usize) -> Self {
        Self(token, S::as_simd_f32s(row).0[part])
    }
    #[inline(always)]
    fn store(self, row: &mut Row, part: usize) {
        S::as_mut_simd_f32s(row).0[part] = self.1;
    }
    #[inline(always)]
    fn mul_add(self, factor: Self, term: Self) -> Self {
        Self(self.0, self.0.mul_add_e_f32s(self.1, factor.1, term.1))
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        Self(self.0, self.0.max_f32s(self.1, other.1))
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        Self(self.0, self.0.min_f32s(self.1, other.1))
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Self(self.0, self.0.abs_f32s(self.1))
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        Self(self.0, self.0.sqrt_f32s(self.1))
    }

    /// Cephes `logf` (Moshier 1989): mantissa in √½ … √2, ln(1 + x) = x − x²/2 + x³ P(x), 1 ulp.
    #[inline(always)]
    fn ln(self) -> Self {
        let s = self.0;
        let (one, root_half) = (0x3f80_0000_u32, 0x3f35_04f3_u32);
        let shifted = s.add_u32s(self.bits(), s.splat_u32s(one - root_half));
        // The exponent as a float without a conversion: as the low bits of 2²³.
        let exponent = s.or_u32s(s.wrapping_dyn_shr_u32s(shifted, s.splat_u32s(23)), s.splat_u32s(0x4b00_0000));
        let exponent = Self::from_bits(s, exponent) - Self::splat(s, 8_388_608.0 + 127.0);
        let mantissa = s.add_u32s(s.and_u32s(shifted, s.splat_u32s(0x007f_ffff)), s.splat_u32s(root_half));
        let x = Self::from_bits(s, mantissa) - Self::splat(s, 1.0);
        let p = x.polynomial([
            7.037_683_6e-2,
            -1.151_461e-1,
            1.167_699_9e-1,
            -1.242_014_1e-1,
            1.424_932_3e-1,
            -1.666_805_8e-1,
            2.000_071_5e-1,
            -2.499_999_4e-1,
            3.333_333e-1,
        ]);
        let square = x * x;
        let tail = (p * x).mul_add(square, exponent * Self::splat(s, -2.121_944_4e-4));
        let tail = square.mul_add(Self::splat(s, -0.5), tail);
        exponent.mul_add(Self::splat(s, 0.693_359_375), x + tail)
    }

    /// Cephes `exp2f` (Moshier 1989) of x·log₂e.
    #[inline(always)]
    fn exp(self) -> Self {
        let s = self.0;
        let x = self.max(Self::splat(s, -40.0)).min(Self::splat(s, 80.0)) * Self::splat(s, std::f64::consts::LOG2_E);
        // Adding 1.5·2²³ rounds to an integer, which then stands in the low bits.
        let magic = Self::splat(s, 12_582_912.0);
        let rounded = x + magic;
        let f = x - (rounded - magic);
        let p = f.polynomial([1.535_336_2e-4, 1.339_887_4e-3, 9.618_437e-3, 5.550_332_5e-2, 2.402_264_8e-1, 6.931_472e-1, 1.0]);
        let power = s.wrapping_dyn_shl_u32s(rounded.bits(), s.splat_u32s(23));
        Self::from_bits(s, s.add_u32s(p.bits(), power))
    }

    #[inline(always)]
    fn below(self, other: Self) -> M32<S> {
        M32(self.0, self.0.less_than_f32s(self.1, other.1))
    }
    #[inline(always)]
    fn or(self, mask: M32<S>, other: Self) -> Self {
        Self(self.0, self.0.select_f32s(mask.1, self.1, other.1))
    }
    #[inline(always)]
    fn any(self, mask: M32<S>) -> bool {
        self.0.first_true_m32s(mask.1) < S::F32_LANES
    }
}

impl<S: Simd> F64<S> {
    /// Lane by lane through the standard library: the polish runs one or two passes.
    #[inline(always)]
    fn map(self, f: impl Fn(f64) -> f64) -> Self {
        let mut numbers = [0.0; GROUP];
        let numbers = &mut numbers[..S::F64_LANES];
        self.0.partial_store_f64s(numbers, self.1);
        numbers.iter_mut().for_each(|x| *x = f(*x));
        Self(self.0, self.0.partial_load_f64s(numbers))
    }
}

impl<S: Simd> Lanes for F64<S> {
    type Token = S;
    type Mask = M64<S>;
    const COUNT: usize = S::F64_LANES;
    const EPSILON: f64 = f64::EPSILON;

    #[inline(always)]
    fn splat(token: S, value: f64) -> Self {
        Self(token, token.splat_f64s(value))
    }
    #[inline(always)]
    fn load(token: S, row: &Row, part: usize) -> Self {
        let mut numbers = [0.0; GROUP];
        for (number, &value) in numbers.iter_mut().zip(&row[part * S::F64_LANES..]) {
            *number = f64::from(value);
        }
        Self(token, token.partial_load_f64s(&numbers[..S::F64_LANES]))
    }
    #[inline(always)]
    fn store(self, row: &mut Row, part: usize) {
        let mut numbers = [0.0; GROUP];
        self.0.partial_store_f64s(&mut numbers[..S::F64_LANES], self.1);
        for (value, &number) in row[part * S::F64_LANES..].iter_mut().zip(&numbers[..S::F64_LANES]) {
            *value = number as f32;
        }
    }
    #[inline(always)]
    fn mul_add(self, factor: Self, term: Self) -> Self {
        Self(self.0, self.0.mul_add_e_f64s(self.1, factor.1, term.1))
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        Self(self.0, self.0.max_f64s(self.1, other.1))
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        Self(self.0, self.0.min_f64s(self.1, other.1))
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Self(self.0, self.0.abs_f64s(self.1))
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        Self(self.0, self.0.sqrt_f64s(self.1))
    }
    #[inline(always)]
    fn ln(self) -> Self {
        self.map(f64::ln)
    }
    #[inline(always)]
    fn exp(self) -> Self {
        self.map(|x| x.clamp(-40.0, 80.0).exp())
    }
    #[inline(always)]
    fn below(self, other: Self) -> M64<S> {
        M64(self.0, self.0.less_than_f64s(self.1, other.1))
    }
    #[inline(always)]
    fn or(self, mask: M64<S>, other: Self) -> Self {
        Self(self.0, self.0.select_f64s(mask.1, self.1, other.1))
    }
    #[inline(always)]
    fn any(self, mask: M64<S>) -> bool {
        self.0.first_true_m64s(mask.1) < S::F64_LANES
    }
}
