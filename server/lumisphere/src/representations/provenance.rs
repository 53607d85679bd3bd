//! Where a pixel's colour comes from.

use bytemuck::{Pod, Zeroable};

/// What answered for a pixel. The numbers are those of the two highest bits of a [`Provenance`], here, in WGSL and on the wire.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[repr(u32)]
pub enum Answer {
    /// Proxy geometry or the environment: not the light field's matter.
    Background = 0,
    /// Read from stored samples by the rule.
    Hit = 1,
    /// Read from stored samples by a fallback, because no sample satisfies the rule.
    Filled = 2,
    /// No sample answers; the colour means nothing.
    Unknown = 3,
}

/// An [`Answer`] in bits 31–30 and, in bits 29–0, the sample that weighs most (all ones: none).
#[derive(Clone, Copy, PartialEq, Eq, Hash, Pod, Zeroable)]
#[repr(transparent)]
pub struct Provenance(u32);

const NO_SAMPLE: u32 = (1 << 30) - 1;

impl Provenance {
    /// Proxy geometry or the environment.
    pub const BACKGROUND: Self = Self(NO_SAMPLE);
    /// Nothing answers.
    pub const UNKNOWN: Self = Self((Answer::Unknown as u32) << 30 | NO_SAMPLE);

    /// `sample` below 2³⁰ − 1.
    pub fn new(answer: Answer, sample: u32) -> Self {
        Self((answer as u32) << 30 | sample.min(NO_SAMPLE))
    }

    /// What answered.
    pub fn answer(self) -> Answer {
        match self.0 >> 30 {
            0 => Answer::Background,
            1 => Answer::Hit,
            2 => Answer::Filled,
            _ => Answer::Unknown,
        }
    }

    /// The sample that weighs most, if any was read.
    pub fn sample(self) -> Option<u32> {
        Some(self.0 & NO_SAMPLE).filter(|s| *s != NO_SAMPLE)
    }

    /// As on the wire.
    pub fn bits(self) -> u32 {
        self.0
    }
}

impl std::fmt::Debug for Provenance {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:?}({:?})", self.answer(), self.sample())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn answer_and_sample_survive_the_packing() {
        for answer in [Answer::Background, Answer::Hit, Answer::Filled, Answer::Unknown] {
            for sample in [0, 1156, NO_SAMPLE - 1] {
                let p = Provenance::new(answer, sample);
                assert_eq!((p.answer(), p.sample()), (answer, Some(sample)));
            }
        }
        assert_eq!((Provenance::BACKGROUND.answer(), Provenance::BACKGROUND.sample()), (Answer::Background, None));
        assert_eq!((Provenance::UNKNOWN.answer(), Provenance::UNKNOWN.sample()), (Answer::Unknown, None));
    }
}
