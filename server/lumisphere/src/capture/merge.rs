//! One image of radiance from photographs with different exposures.
//!
//! ln E is the mean of g(z) − ln t (Debevec and Malik 1997, equation 6) over the samples that are neither clipped nor dark, weighted by the inverse
//! of their variance. Samples that noise alone kept from clipping are left out where others remain: they are too dark on average. What no
//! exposure shows is masked, never averaged.

use super::photograph::{CODES, ExposureStack, StackError, check_exposures, check_sizes};
use super::response_curve::{ResponseCurve, is_inside};
use crate::images::Image;

/// Whether a pixel's radiance was measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Validity {
    /// Every channel is neither clipped nor dark in some exposure.
    Measured,
    /// A channel is clipped in every exposure that is not dark, the shortest included: it is at least that bright.
    Clipped,
    /// A channel is dark in every exposure.
    Dark,
    /// A channel is dark in short exposures and clipped in long ones: the steps are too wide.
    Between,
}

/// Relative radiance with its mask.
#[derive(Debug, Clone, PartialEq)]
pub struct Merged {
    /// Three planes; 0 where not measured. The unit is that of the response curve: exposure of code 128 per unit of the stack's exposures.
    pub radiance: Image,
    /// One per pixel, row by row.
    pub validity: Vec<Validity>,
}

/// Why a stack could not be merged.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum MergeError {
    /// Photographs of different sizes or exposures that are none.
    #[error(transparent)]
    Stack(#[from] StackError),
    /// A linear photograph has no three channels.
    #[error("photograph {index} has {channels} channels, expected at least 3")]
    Channels {
        /// Its place in the list, from 0.
        index: usize,
        /// How many it has.
        channels: usize,
    },
    /// Not one pixel was measured.
    #[error(
        "no pixel of {pixels} is neither clipped nor dark: {clipped} are clipped, {dark} dark, {between} dark in some exposures and clipped in the others"
    )]
    NothingMeasured {
        /// All pixels.
        pixels: usize,
        /// Clipped in all exposures.
        clipped: usize,
        /// Dark in all exposures.
        dark: usize,
        /// Dark in short, clipped in long exposures.
        between: usize,
    },
}

/// One sample that counts.
#[derive(Debug, Clone, Copy)]
struct Sample {
    ln_radiance: f64,
    weight: f64,
    /// By how many deviations of the sample the channel's end lies above it, if it were at another ln radiance x: (end − x) / deviation.
    end: f64,
    deviation: f64,
}

/// Nearer to the end than so many deviations a sample is left out where others remain.
const FROM_END: f64 = 2.5;

/// Merges photographs whose response is known.
pub fn merge(stack: &ExposureStack, curve: &ResponseCurve) -> Result<Merged, MergeError> {
    let (width, height) = stack.size();
    let ln_times: Vec<f64> = stack.exposures().iter().map(|exposure| exposure.ln()).collect();
    let channel = |pixel: usize, channel: usize| {
        let codes = || stack.photographs().iter().map(|photograph| photograph.bytes[3 * pixel + channel]);
        let samples: Vec<Sample> = codes()
            .zip(&ln_times)
            .filter(|(code, _)| is_inside(*code))
            .map(|(code, ln_time)| code_sample(curve, channel, code, *ln_time))
            .collect();
        mean(&samples).ok_or_else(|| invalid(codes().any(|code| code == 255), codes().any(|code| code == 0)))
    };
    collect(width, height, channel)
}

/// Merges photographs that are linear already (OpenEXR, developed raw files): samples in (`dark`, `saturation`) count, with weights as photons have them.
pub fn merge_linear(photographs: &[Image], exposures: &[f64], dark: f32, saturation: f32) -> Result<Merged, MergeError> {
    check_exposures(photographs.len(), exposures)?;
    check_sizes(photographs.iter().map(|photograph| (photograph.width, photograph.height)))?;
    if let Some((index, channels)) = photographs.iter().map(Image::channels).enumerate().find(|(_, channels)| *channels < 3) {
        return Err(MergeError::Channels { index, channels });
    }
    let (width, height) = photographs.first().map_or((0, 0), |first| (first.width, first.height));
    let channel = |pixel: usize, channel: usize| {
        let values = || photographs.iter().map(|photograph| photograph.planes[channel][pixel]);
        let (mut sum, mut weights) = (0.0, 0.0);
        // With variance in proportion to the signal the best estimate is the ratio of the sums. NaN is neither inside nor at an end.
        for (value, exposure) in values().zip(exposures).filter(|(value, _)| *value > dark && *value < saturation) {
            sum += f64::from(value);
            weights += exposure;
        }
        if weights > 0.0 {
            Ok(sum / weights)
        } else {
            Err(invalid(values().any(|value| value >= saturation), values().any(|value| value <= dark)))
        }
    };
    collect(width, height, channel)
}

fn invalid(clipped: bool, dark: bool) -> Validity {
    match (clipped, dark) {
        (true, true) => Validity::Between,
        (true, false) => Validity::Clipped,
        _ => Validity::Dark,
    }
}

fn code_sample(curve: &ResponseCurve, channel: usize, code: u8, ln_time: f64) -> Sample {
    let g = |code: usize| f64::from(curve.ln_exposure[channel][code]);
    let deviation = f64::from(curve.deviation[channel][usize::from(code)]);
    let end = 0.5 * (g(CODES - 2) + g(CODES - 1)) - ln_time;
    Sample { ln_radiance: g(usize::from(code)) - ln_time, weight: 1.0 / (deviation * deviation), end, deviation }
}

/// Radiance, None without samples.
fn mean(samples: &[Sample]) -> Option<f64> {
    let mean_of = |keep: &dyn Fn(&Sample) -> bool| {
        let kept = || samples.iter().filter(|sample| keep(sample));
        let weights: f64 = kept().map(|sample| sample.weight).sum();
        let sum: f64 = kept().map(|sample| sample.weight * sample.ln_radiance).sum();
        (weights > 0.0).then_some(sum / weights)
    };
    let all = mean_of(&|_| true)?;
    let inner = mean_of(&|sample| sample.end - all > FROM_END * sample.deviation);
    Some(inner.unwrap_or(all).exp())
}

fn collect(width: usize, height: usize, channel: impl Fn(usize, usize) -> Result<f64, Validity>) -> Result<Merged, MergeError> {
    let mut radiance = Image::zeros(width, height, 3);
    let mut validity = vec![Validity::Measured; width * height];
    for (pixel, validity) in validity.iter_mut().enumerate() {
        match (channel(pixel, 0), channel(pixel, 1), channel(pixel, 2)) {
            (Ok(r), Ok(g), Ok(b)) => radiance.set_rgb(pixel, [r, g, b].map(|value| value as f32)),
            (r, g, b) => *validity = worst([r, g, b].into_iter().filter_map(Result::err)),
        }
    }
    let count = |what| validity.iter().filter(|&&validity| validity == what).count();
    if count(Validity::Measured) == 0 {
        let (clipped, dark, between) = (count(Validity::Clipped), count(Validity::Dark), count(Validity::Between));
        return Err(MergeError::NothingMeasured { pixels: width * height, clipped, dark, between });
    }
    Ok(Merged { radiance, validity })
}

/// Clipped before between before dark: a pixel of which any channel is clipped is a bright one.
fn worst(reasons: impl Iterator<Item = Validity>) -> Validity {
    let rank = |validity: &Validity| match validity {
        Validity::Clipped => 3,
        Validity::Between => 2,
        Validity::Dark => 1,
        Validity::Measured => 0,
    };
    reasons.max_by_key(rank).unwrap_or(Validity::Measured)
}
