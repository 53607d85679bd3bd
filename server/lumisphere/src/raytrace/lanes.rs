//! Eight f32 side by side: AVX2 registers where the processor has them, else two `Vec4`s. Chosen at run time, once a kernel.
//!
//! Both kinds do the same IEEE operations in the same order, and nothing is fused: the same bytes on every processor.
//!
//! The only module of the library that is allowed `unsafe`: code compiled for AVX2 must not run without it. `Avx2` cannot be named
//! outside, and `dispatch` alone hands it to a kernel, after asking the processor.

use std::ops::{Add, BitAnd, Mul, Sub};

use glam::{BVec4A, Vec4};

/// How many numbers lie side by side.
pub(super) const WIDTH: usize = 8;

/// Eight numbers.
pub(super) trait Lanes: Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> {
    /// Eight answers.
    type Mask: Copy + BitAnd<Output = Self::Mask>;

    fn splat(x: f32) -> Self;
    fn load(from: &[f32; WIDTH]) -> Self;
    fn store(self, to: &mut [f32; WIDTH]);
    fn min(self, other: Self) -> Self;
    fn max(self, other: Self) -> Self;
    fn recip(self) -> Self;
    fn negate(self) -> Self;
    /// Each false where a lane is NaN.
    fn lt(self, other: Self) -> Self::Mask;
    fn le(self, other: Self) -> Self::Mask;
    /// Lane by lane: `yes` where the mask is set. Bits pass unchanged, so an index may travel as `f32::from_bits`.
    fn select(mask: Self::Mask, yes: Self, no: Self) -> Self;
    /// Bit k: lane k is set.
    fn bits(mask: Self::Mask) -> u32;
}

/// Work that is written once for every kind of `Lanes`. Its `run` must be `#[inline(always)]`, and so must all that takes `Lanes`:
/// only then is it compiled for the processor that `dispatch` found.
pub(super) trait Kernel {
    type Output;
    fn run<L: Lanes>(self) -> Self::Output;
}

/// Runs the kernel with the widest registers that the processor has.
#[inline]
pub(super) fn dispatch<K: Kernel>(kernel: K) -> K::Output {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2, as it just said.
        return unsafe { avx2::run(kernel) };
    }
    portable(kernel)
}

/// Runs the kernel with what every processor has.
pub(super) fn portable<K: Kernel>(kernel: K) -> K::Output {
    kernel.run::<Portable>()
}

#[derive(Clone, Copy)]
struct Portable(Vec4, Vec4);

#[derive(Clone, Copy)]
struct PortableMask(BVec4A, BVec4A);

impl Add for Portable {
    type Output = Self;
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        Self(self.0 + other.0, self.1 + other.1)
    }
}

impl Sub for Portable {
    type Output = Self;
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        Self(self.0 - other.0, self.1 - other.1)
    }
}

impl Mul for Portable {
    type Output = Self;
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        Self(self.0 * other.0, self.1 * other.1)
    }
}

impl BitAnd for PortableMask {
    type Output = Self;
    #[inline(always)]
    fn bitand(self, other: Self) -> Self {
        Self(self.0 & other.0, self.1 & other.1)
    }
}

impl Lanes for Portable {
    type Mask = PortableMask;

    #[inline(always)]
    fn splat(x: f32) -> Self {
        Self(Vec4::splat(x), Vec4::splat(x))
    }
    #[inline(always)]
    fn load(from: &[f32; WIDTH]) -> Self {
        Self(Vec4::from_slice(&from[..4]), Vec4::from_slice(&from[4..]))
    }
    #[inline(always)]
    fn store(self, to: &mut [f32; WIDTH]) {
        self.0.write_to_slice(&mut to[..4]);
        self.1.write_to_slice(&mut to[4..]);
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        Self(self.0.min(other.0), self.1.min(other.1))
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        Self(self.0.max(other.0), self.1.max(other.1))
    }
    #[inline(always)]
    fn recip(self) -> Self {
        Self(self.0.recip(), self.1.recip())
    }
    #[inline(always)]
    fn negate(self) -> Self {
        Self(-self.0, -self.1)
    }
    #[inline(always)]
    fn lt(self, other: Self) -> PortableMask {
        PortableMask(self.0.cmplt(other.0), self.1.cmplt(other.1))
    }
    #[inline(always)]
    fn le(self, other: Self) -> PortableMask {
        PortableMask(self.0.cmple(other.0), self.1.cmple(other.1))
    }
    #[inline(always)]
    fn select(mask: PortableMask, yes: Self, no: Self) -> Self {
        Self(Vec4::select(mask.0, yes.0, no.0), Vec4::select(mask.1, yes.1, no.1))
    }
    #[inline(always)]
    fn bits(mask: PortableMask) -> u32 {
        mask.0.bitmask() | mask.1.bitmask() << 4
    }
}

#[cfg(target_arch = "x86_64")]
mod avx2 {
    use std::arch::x86_64::*;
    use std::ops::{Add, BitAnd, Mul, Sub};

    use super::{Kernel, Lanes, WIDTH};

    /// The kernel, compiled for AVX2.
    #[target_feature(enable = "avx2")]
    pub(super) fn run<K: Kernel>(kernel: K) -> K::Output {
        kernel.run::<Avx2>()
    }

    #[derive(Clone, Copy)]
    struct Avx2(__m256);

    #[derive(Clone, Copy)]
    struct Avx2Mask(__m256);

    /// An intrinsic of AVX.
    macro_rules! avx {
        ($call:expr) => {
            // SAFETY: `Avx2` is private, and only `run` makes code of it, which is reached with AVX2 only. Loads and stores are
            // unaligned ones of eight f32 through references to eight f32.
            unsafe { $call }
        };
    }

    impl Add for Avx2 {
        type Output = Self;
        #[inline(always)]
        fn add(self, other: Self) -> Self {
            Self(avx!(_mm256_add_ps(self.0, other.0)))
        }
    }

    impl Sub for Avx2 {
        type Output = Self;
        #[inline(always)]
        fn sub(self, other: Self) -> Self {
            Self(avx!(_mm256_sub_ps(self.0, other.0)))
        }
    }

    impl Mul for Avx2 {
        type Output = Self;
        #[inline(always)]
        fn mul(self, other: Self) -> Self {
            Self(avx!(_mm256_mul_ps(self.0, other.0)))
        }
    }

    impl BitAnd for Avx2Mask {
        type Output = Self;
        #[inline(always)]
        fn bitand(self, other: Self) -> Self {
            Self(avx!(_mm256_and_ps(self.0, other.0)))
        }
    }

    impl Lanes for Avx2 {
        type Mask = Avx2Mask;

        #[inline(always)]
        fn splat(x: f32) -> Self {
            Self(avx!(_mm256_set1_ps(x)))
        }
        #[inline(always)]
        fn load(from: &[f32; WIDTH]) -> Self {
            Self(avx!(_mm256_loadu_ps(from.as_ptr())))
        }
        #[inline(always)]
        fn store(self, to: &mut [f32; WIDTH]) {
            avx!(_mm256_storeu_ps(to.as_mut_ptr(), self.0))
        }
        #[inline(always)]
        fn min(self, other: Self) -> Self {
            Self(avx!(_mm256_min_ps(self.0, other.0)))
        }
        #[inline(always)]
        fn max(self, other: Self) -> Self {
            Self(avx!(_mm256_max_ps(self.0, other.0)))
        }
        #[inline(always)]
        fn recip(self) -> Self {
            Self(avx!(_mm256_div_ps(_mm256_set1_ps(1.0), self.0)))
        }
        #[inline(always)]
        fn negate(self) -> Self {
            Self(avx!(_mm256_xor_ps(_mm256_set1_ps(-0.0), self.0)))
        }
        #[inline(always)]
        fn lt(self, other: Self) -> Avx2Mask {
            Avx2Mask(avx!(_mm256_cmp_ps::<_CMP_LT_OQ>(self.0, other.0)))
        }
        #[inline(always)]
        fn le(self, other: Self) -> Avx2Mask {
            Avx2Mask(avx!(_mm256_cmp_ps::<_CMP_LE_OQ>(self.0, other.0)))
        }
        #[inline(always)]
        fn select(mask: Avx2Mask, yes: Self, no: Self) -> Self {
            Self(avx!(_mm256_blendv_ps(no.0, yes.0, mask.0)))
        }
        #[inline(always)]
        fn bits(mask: Avx2Mask) -> u32 {
            avx!(_mm256_movemask_ps(mask.0)) as u32
        }
    }
}
