//! Colour spaces of radiance: linear Rec. 709 (D65), its sRGB encoding, CIE XYZ and CIE L*a*b*.
//!
//! Called by `images` (8-bit formats, tone mapping, metrics) and by nothing else: these two places are the only ones that
//! apply a transfer curve.
//!
//! Sources: IEC 61966-2-1:1999 (sRGB), ITU-R BT.709-6 (primaries, white), CIE 15:2004 (L*a*b*).

use std::sync::LazyLock;

/// XYZ from linear Rec. 709, the exact quotient of the primaries' and D65's chromaticities (CSS Color 4 gives the same digits).
const XYZ_FROM_LINEAR: [[f64; 3]; 3] = [
    [0.412_390_799_265_959_5, 0.357_584_339_383_878, 0.180_480_788_401_834_3],
    [0.212_639_005_871_510_36, 0.715_168_678_767_756, 0.072_192_315_360_733_71],
    [0.019_330_818_715_591_85, 0.119_194_779_794_625_99, 0.950_532_152_249_660_6],
];

/// XYZ of linear (1, 1, 1): the rows' sums, so that every grey has a* = b* = 0 to rounding.
const WHITE: [f64; 3] = [row_sum(0), row_sum(1), row_sum(2)];

const fn row_sum(row: usize) -> f64 {
    XYZ_FROM_LINEAR[row][0] + XYZ_FROM_LINEAR[row][1] + XYZ_FROM_LINEAR[row][2]
}

/// sRGB-encoded value of a linear one. Maps [0, 1] to [0, 1]; the line and the power continue beyond both ends.
pub fn srgb_from_linear(linear: f32) -> f32 {
    if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}

/// Linear value of an sRGB-encoded one, the inverse of [`srgb_from_linear`].
pub fn linear_from_srgb(encoded: f32) -> f32 {
    if encoded <= 0.040_45 { encoded / 12.92 } else { ((encoded + 0.055) / 1.055).powf(2.4) }
}

/// Linear value, in [0, 1], of an 8-bit sRGB code.
pub fn linear_from_srgb8(code: u8) -> f32 {
    static TABLE: LazyLock<[f32; 256]> = LazyLock::new(|| std::array::from_fn(|code| linear_from_srgb(code as f32 / 255.0)));
    TABLE[usize::from(code)]
}

/// Luminance of linear Rec. 709: the Y of XYZ, 1 for white.
pub fn luminance(linear: [f32; 3]) -> f32 {
    let [r, g, b] = XYZ_FROM_LINEAR[1];
    r as f32 * linear[0] + g as f32 * linear[1] + b as f32 * linear[2]
}

/// CIE 1931 XYZ of linear Rec. 709; Y = 1 for white.
pub fn xyz_from_linear(linear: [f32; 3]) -> [f64; 3] {
    let linear = linear.map(f64::from);
    XYZ_FROM_LINEAR.map(|row| row[0] * linear[0] + row[1] * linear[1] + row[2] * linear[2])
}

/// CIE 1976 L*a*b* under D65 in the standard's scale: L* is 0 for black and 100 for linear (1, 1, 1).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lab {
    /// Lightness, 0–100; above 100 for radiance above 1.
    pub l: f64,
    /// Green (−) to red (+), about ±100 inside Rec. 709.
    pub a: f64,
    /// Blue (−) to yellow (+), about ±100 inside Rec. 709.
    pub b: f64,
}

impl Lab {
    /// What L*, a* and b* are divided by to compare with the tables of the thesis that introduced offset surface light fields.
    ///
    /// Its L* errors (0.198 beside an RGB error of 0.05) are those of an L* on 0–1. It does not say how it scaled a* and b*, but
    /// its own figures do: table 6.1 has an RMSE of 0.0343 in b* beside 0.0048 in B, a ratio of 7. In the standard's scale
    /// ∂b*/∂B is at least 58 (at white) and at most 1360 (at black); a ratio of 711 fits a dark pot, a ratio of 7 nothing.
    /// So all three are the standard's divided by 100.
    pub const UNIT_SCALE: f64 = 100.0;

    /// L*a*b* of linear Rec. 709, (1, 1, 1) being the reference white. Values above 1 and below 0 are not clipped.
    pub fn from_linear(linear: [f32; 3]) -> Self {
        let xyz = xyz_from_linear(linear);
        let [x, y, z] = std::array::from_fn(|axis| lightness_response(xyz[axis] / WHITE[axis]));
        Self { l: 116.0 * y - 16.0, a: 500.0 * (x - y), b: 200.0 * (y - z) }
    }
}

/// CIE 15:2004's f: the cube root, and its tangent's line below (6/29)³.
fn lightness_response(t: f64) -> f64 {
    const EPSILON: f64 = 216.0 / 24_389.0;
    const SLOPE: f64 = 841.0 / 108.0;
    if t > EPSILON { t.cbrt() } else { SLOPE * t + 4.0 / 29.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_srgb_code_survives_the_round_trip() {
        for code in 0..=255u8 {
            let back = srgb_from_linear(linear_from_srgb8(code)) * 255.0;
            // A quarter of a code: the curve's published constants leave a step of 2e-7 at the joint, rounding less.
            assert!((back - f32::from(code)).abs() < 0.25, "{code} came back as {back}");
        }
    }

    #[test]
    fn srgb_matches_published_points() {
        // 18 % grey is code 117.6, half of the light is code 187.5 (IEC 61966-2-1).
        assert!((srgb_from_linear(0.18) - 0.461_356).abs() < 1e-5);
        assert!((srgb_from_linear(0.5) - 0.735_357).abs() < 1e-5);
        assert!((linear_from_srgb(0.5) - 0.214_041).abs() < 1e-5);
    }

    #[test]
    fn white_and_greys_are_neutral() {
        let white = Lab::from_linear([1.0; 3]);
        assert!((white.l - 100.0).abs() < 1e-9);
        for grey in [0.0, 0.001, 0.18, 1.0, 20.0] {
            let lab = Lab::from_linear([grey; 3]);
            assert!(lab.a.abs() < 1e-9 && lab.b.abs() < 1e-9, "{grey}: {lab:?}");
        }
        assert!((Lab::from_linear([0.184_187; 3]).l - 50.0).abs() < 1e-3);
    }

    #[test]
    fn primaries_have_their_published_lab() {
        // Lindbloom's calculator, sRGB primaries, D65, no adaptation; its white differs in the fifth digit.
        let expected = [
            ([1.0, 0.0, 0.0], [53.24, 80.09, 67.20]),
            ([0.0, 1.0, 0.0], [87.73, -86.18, 83.18]),
            ([0.0, 0.0, 1.0], [32.30, 79.19, -107.86]),
        ];
        for (linear, [l, a, b]) in expected {
            let lab = Lab::from_linear(linear);
            assert!((lab.l - l).abs() < 0.03 && (lab.a - a).abs() < 0.03 && (lab.b - b).abs() < 0.03, "{linear:?}: {lab:?}");
        }
    }

    #[test]
    fn luminance_is_the_y_of_xyz() {
        let linear = [0.3, 0.7, 0.2];
        assert!((f64::from(luminance(linear)) - xyz_from_linear(linear)[1]).abs() < 1e-7);
    }
}
