//! Photographs of one view with different exposures.
//!
//! `response_curve` finds from them what their codes mean, `merge` makes one image of radiance of them.

use crate::images::Rgb8;

/// Codes of an 8-bit channel.
pub const CODES: usize = 256;

/// Photographs of one size, at most 255, each with its exposure.
#[derive(Debug, Clone, PartialEq)]
pub struct ExposureStack {
    photographs: Vec<Rgb8>,
    exposures: Vec<f64>,
}

/// Why photographs are no stack.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum StackError {
    /// None, or more than 255.
    #[error("{0} photographs in a stack: expected 1 to 255")]
    Number(usize),
    /// The list of exposures belongs to another stack.
    #[error("{exposures} exposures for {photographs} photographs")]
    Lengths {
        /// Photographs given.
        photographs: usize,
        /// Exposures given.
        exposures: usize,
    },
    /// An exposure is not a length of time.
    #[error("exposure {index} is {value}, expected a finite number above 0")]
    Exposure {
        /// Its place in the list, from 0.
        index: usize,
        /// What it is.
        value: f64,
    },
    /// A photograph has another size than the first.
    #[error("photograph {index} has {} × {} pixels, the first one {} × {}", got.0, got.1, expected.0, expected.1)]
    Size {
        /// Its place in the list, from 0.
        index: usize,
        /// Its columns and rows.
        got: (usize, usize),
        /// The first one's.
        expected: (usize, usize),
    },
}

impl ExposureStack {
    /// `exposures`: one per photograph, in any unit that is the same for all (seconds, if aperture and sensitivity are).
    pub fn new(photographs: Vec<Rgb8>, exposures: Vec<f64>) -> Result<Self, StackError> {
        check_exposures(photographs.len(), &exposures)?;
        check_sizes(photographs.iter().map(|photograph| (photograph.width, photograph.height)))?;
        Ok(Self { photographs, exposures })
    }

    /// At least one.
    pub fn photographs(&self) -> &[Rgb8] {
        &self.photographs
    }

    /// One per photograph.
    pub fn exposures(&self) -> &[f64] {
        &self.exposures
    }

    /// Columns and rows.
    pub fn size(&self) -> (usize, usize) {
        self.photographs.first().map_or((0, 0), |first| (first.width, first.height))
    }
}

/// Whether there are 1 to 255 photographs, and an exposure above 0 for each.
pub fn check_exposures(photographs: usize, exposures: &[f64]) -> Result<(), StackError> {
    if !(1..=255).contains(&photographs) {
        return Err(StackError::Number(photographs));
    }
    if exposures.len() != photographs {
        return Err(StackError::Lengths { photographs, exposures: exposures.len() });
    }
    let bad = exposures.iter().enumerate().find(|(_, value)| !(**value > 0.0 && value.is_finite()));
    bad.map_or(Ok(()), |(index, &value)| Err(StackError::Exposure { index, value }))
}

pub(super) fn check_sizes(mut sizes: impl Iterator<Item = (usize, usize)>) -> Result<(), StackError> {
    let Some(expected) = sizes.next() else { return Ok(()) };
    let other = sizes.enumerate().find(|(_, size)| *size != expected);
    other.map_or(Ok(()), |(at, got)| Err(StackError::Size { index: at + 1, got, expected }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn photographs_that_are_no_stack_are_refused() {
        let grey = |width: usize| Rgb8::filled(width, 2, [9; 3]);
        assert_eq!(ExposureStack::new(vec![], vec![]), Err(StackError::Number(0)));
        let other_size = StackError::Size { index: 1, got: (4, 2), expected: (3, 2) };
        assert_eq!(ExposureStack::new(vec![grey(3), grey(4)], vec![1.0, 2.0]), Err(other_size));
        assert_eq!(ExposureStack::new(vec![grey(3)], vec![1.0, 2.0]), Err(StackError::Lengths { photographs: 1, exposures: 2 }));
        for value in [0.0, -1.0, f64::INFINITY] {
            assert_eq!(ExposureStack::new(vec![grey(3); 2], vec![1.0, value]), Err(StackError::Exposure { index: 1, value }));
        }
        assert!(ExposureStack::new(vec![grey(3); 2], vec![1.0, f64::NAN]).is_err());
        assert_eq!(ExposureStack::new(vec![grey(3)], vec![1.0]).unwrap().size(), (3, 2));
    }
}
