//! Which error counts where one number must decide.

use std::fmt;
use std::str::FromStr;

use crate::images::Comparison;

/// A measure of error: 0 where two images are equal, larger where they differ more. (PSNR, larger for the better image, is not among them:
/// it says what an RMSE says.)
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Metric {
    /// Mean CIEDE2000 difference; 1 is just noticeable.
    DeltaE,
    /// The CIEDE2000 difference that 95 % of the pixels do not exceed.
    DeltaEP95,
    /// Mean FLIP, 0 to 1.
    Flip,
    /// 1 − SSIM, 0 to 2.
    OneMinusSsim,
    /// RMSE of the linear channels together.
    RmseRgb,
    /// RMSE of L*, divided by 100.
    RmseLightness,
    /// RMSE of L*, a* and b* together, divided by 100.
    RmseLab,
    /// Largest absolute error of a linear channel.
    MaxAbs,
}

impl Metric {
    /// All.
    pub const ALL: [Self; 8] =
        [Self::DeltaE, Self::DeltaEP95, Self::Flip, Self::OneMinusSsim, Self::RmseRgb, Self::RmseLightness, Self::RmseLab, Self::MaxAbs];

    /// On the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::DeltaE => "delta-e",
            Self::DeltaEP95 => "delta-e-p95",
            Self::Flip => "flip",
            Self::OneMinusSsim => "one-minus-ssim",
            Self::RmseRgb => "rmse-rgb",
            Self::RmseLightness => "rmse-l",
            Self::RmseLab => "rmse-lab",
            Self::MaxAbs => "max-abs",
        }
    }

    /// For people.
    pub fn label(self) -> &'static str {
        match self {
            Self::DeltaE => "ΔE2000, mean",
            Self::DeltaEP95 => "ΔE2000, 95th percentile",
            Self::Flip => "FLIP, mean",
            Self::OneMinusSsim => "1 − SSIM",
            Self::RmseRgb => "RMSE of linear RGB",
            Self::RmseLightness => "RMSE of L* / 100",
            Self::RmseLab => "RMSE of L*a*b* / 100",
            Self::MaxAbs => "largest absolute error",
        }
    }

    /// The error; NaN where the comparison does not have it.
    pub fn error(self, c: &Comparison) -> f64 {
        let together = |channels: [f64; 3]| (channels.iter().map(|e| e * e).sum::<f64>() / 3.0).sqrt();
        match self {
            Self::DeltaE => c.delta_e_2000_mean,
            Self::DeltaEP95 => c.delta_e_2000_p95,
            Self::Flip => c.flip_mean,
            Self::OneMinusSsim => 1.0 - c.ssim.unwrap_or(f64::NAN),
            Self::RmseRgb => together(c.rmse_rgb),
            Self::RmseLightness => c.rmse_lab[0],
            Self::RmseLab => together(c.rmse_lab),
            Self::MaxAbs => c.max_abs_error,
        }
    }
}

impl fmt::Display for Metric {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Metric {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let expected = || format!("one of {} expected", Self::ALL.map(Self::name).join(", "));
        Self::ALL.into_iter().find(|m| m.name() == text).ok_or_else(expected)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_metric_is_read_by_its_name_and_is_the_figure_it_says() {
        let c = Comparison {
            pixels: 1,
            rmse_rgb: [1.0, 2.0, 2.0],
            rmse_lab: [2.0, 4.0, 4.0],
            max_abs_error: 3.0,
            psnr_db: None,
            ssim: Some(0.75),
            flip_mean: 4.0,
            delta_e_2000_mean: 5.0,
            delta_e_2000_p95: 6.0,
        };
        let read = Metric::ALL.map(|m| m.name().parse::<Metric>().unwrap().error(&c));
        assert_eq!(read, [5.0, 6.0, 4.0, 0.25, 3f64.sqrt(), 2.0, 12f64.sqrt(), 3.0]);
        assert!(Metric::OneMinusSsim.error(&Comparison { ssim: None, ..c }).is_nan());
        assert!("psnr".parse::<Metric>().unwrap_err().contains("delta-e-p95"));
    }
}
