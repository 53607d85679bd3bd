//! What came of a map's fits: counted texel by texel, in memory that does not grow with them.

use std::collections::BTreeMap;

use super::ModelCode;
use super::models::{FittedRung, FittedTexel};
use super::registration::Registration;
use crate::fitting::Flags;

/// What came of the fits, over all texels that were observed.
#[derive(Debug, Clone, Default, PartialEq, serde::Serialize)]
pub struct FitSummary {
    /// Texels that have a model.
    pub texels: u64,
    /// Those that were fitted in this run; an earlier run's are not among them.
    pub texels_of_this_run: u64,
    /// Seconds of this run's fits.
    pub seconds: f64,
    /// The last divided by one another; 0 where nothing was fitted.
    pub texels_per_second: f64,
    /// How many texels have which model.
    pub histogram: BTreeMap<String, u64>,
    /// How many have which flag.
    pub flags: BTreeMap<&'static str, u64>,
    /// Root mean square of what the models leave of observations that are not clipped, outliers included.
    pub rms_residual: f64,
    /// The same texel by texel: half of the texels have less (to 1 %),
    pub median_residual: f64,
    /// and 95 of a hundred (to 1 %).
    pub p95_residual: f64,
    /// Photographs that lie beside the others; absent while texels are still being fitted.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub registration: Option<Registration>,
    /// What the bound on bytes did; absent where there was none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub budget: Option<BudgetReport>,
}

/// What a bound on bytes did.
#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Serialize)]
pub struct BudgetReport {
    /// The bound.
    pub max_bytes: u64,
    /// What the version takes, at most.
    pub bytes: u64,
    /// What it would take with every model as the fit chose it.
    pub bytes_before: u64,
    /// Texels that have a smaller model than the fit chose.
    pub texels_reduced: u64,
    /// `rms_residual` with every model as the fit chose it.
    pub rms_residual_before: f64,
}

/// Names of the flags.
const FLAGS: [(Flags, &str); 4] =
    [(Flags::UNRESOLVED, "unresolved"), (Flags::CLIPPED, "clipped"), (Flags::OUTLIERS, "outliers"), (Flags::MISFIT, "misfit")];

/// Models and what they leave, being counted.
#[derive(Debug, Clone)]
pub(super) struct Tally {
    texels: u64,
    codes: [u64; 256],
    flags: [u64; FLAGS.len()],
    squares: f64,
    samples: u64,
    residuals: Vec<u64>,
}

/// Bits of an f32 that tell one bin of residuals from the next: they are 2⁻⁷ wide, relatively.
const BIN_SHIFT: u32 = 16;

impl Tally {
    pub fn new() -> Self {
        Self { texels: 0, codes: [0; 256], flags: [0; 4], squares: 0.0, samples: 0, residuals: vec![0; 1 << (31 - BIN_SHIFT)] }
    }

    /// One more texel and the model that it has.
    pub fn add(&mut self, texel: &FittedTexel, rung: &FittedRung) {
        self.texels += 1;
        self.codes[usize::from(rung.code)] += 1;
        for (count, (flag, _)) in self.flags.iter_mut().zip(FLAGS) {
            *count += u64::from(Flags::from_bits(rung.flags).contains(flag));
        }
        (self.squares, self.samples) = (self.squares + rung.sum_of_squares, self.samples + texel.samples);
        let rms = (rung.sum_of_squares / texel.samples.max(1) as f64).sqrt() as f32;
        if let Some(bin) = self.residuals.get_mut((rms.to_bits() >> BIN_SHIFT) as usize) {
            *bin += 1;
        }
    }

    pub fn rms_residual(&self) -> f64 {
        (self.squares / self.samples.max(1) as f64).sqrt()
    }

    // The residual that this part of the texels does not exceed: the middle of its bin.
    fn quantile(&self, part: f64) -> f64 {
        let mut before = part * self.texels as f64;
        for (bin, count) in self.residuals.iter().enumerate() {
            before -= *count as f64;
            if *count > 0 && before <= 0.0 {
                let middle = if bin == 0 { 0 } else { ((bin as u32) << BIN_SHIFT) + (1 << (BIN_SHIFT - 1)) };
                return f64::from(f32::from_bits(middle));
            }
        }
        0.0
    }

    pub fn summary(&self, texels_of_this_run: u64, seconds: f64) -> FitSummary {
        let counted = (0..=u8::MAX).filter(|code| self.codes[usize::from(*code)] > 0);
        let named = counted.filter_map(|code| Some((ModelCode::from_number(code)?.name(), self.codes[usize::from(code)])));
        FitSummary {
            texels: self.texels,
            texels_of_this_run,
            seconds,
            texels_per_second: if seconds > 0.0 { texels_of_this_run as f64 / seconds } else { 0.0 },
            histogram: named.collect(),
            flags: FLAGS.iter().zip(self.flags).map(|((_, name), count)| (*name, count)).collect(),
            rms_residual: self.rms_residual(),
            median_residual: self.quantile(0.5),
            p95_residual: self.quantile(0.95),
            registration: None,
            budget: None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn residuals_are_summed_up_to_one_percent() {
        let mut tally = Tally::new();
        for i in 1..=1000 {
            let rms = 0.001 * f64::from(i);
            let rung = FittedRung {
                code: 3,
                flags: if i <= 10 { 3 } else { 8 },
                quads: vec![],
                sum_of_squares: 30.0 * rms * rms,
                of_clipped: 7.0,
            };
            tally.add(&FittedTexel { index: 0, samples: 30, rungs: vec![] }, &rung);
        }
        let summary = tally.summary(500, 0.25);
        assert!((summary.median_residual / 0.5 - 1.0).abs() < 0.01, "{}", summary.median_residual);
        assert!((summary.p95_residual / 0.95 - 1.0).abs() < 0.01, "{}", summary.p95_residual);
        // √(Σ i² / 1000) for i = 1 … 1000, thousandths.
        assert!((summary.rms_residual - 0.577_783_3).abs() < 1e-6, "{}", summary.rms_residual);
        assert_eq!(summary.histogram, [("phong:1".to_string(), 1000)].into());
        assert_eq!(summary.flags, [("unresolved", 10), ("clipped", 10), ("outliers", 0), ("misfit", 990)].into());
        assert_eq!((summary.texels, summary.texels_per_second), (1000, 2000.0));
        assert_eq!(Tally::new().summary(0, 0.0).median_residual, 0.0);
    }
}
