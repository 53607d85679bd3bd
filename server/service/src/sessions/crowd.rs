//! Whether further frames of a pose will ever have all their pages: not where others at rest want so many that each frame drives out what the
//! one before brought. Such a frame is drawn once more and waits for all of them.

/// Frames in a row that drove out pages and miss no fewer than the one before: the others' frames come between, and pages are wanted in waves.
const PATIENCE: u32 = 32;

/// Of the frames of one wish.
#[derive(Debug, Default)]
pub struct Crowd {
    revision: u64,
    misses: Option<u64>,
    in_vain: u32,
}

impl Crowd {
    /// A frame of the wish with that revision missed so many pages, and so many left for those it brought. Whether there is hope that a further
    /// one misses none.
    pub fn has_hope(&mut self, revision: u64, misses: u64, evictions: u64) -> bool {
        if self.revision != revision {
            *self = Self { revision, ..Self::default() };
        }
        let is_fewer = self.misses.replace(misses).is_none_or(|before| misses < before);
        if evictions > 0 && !is_fewer {
            self.in_vain += 1;
        }
        self.in_vain < PATIENCE
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pages_that_become_fewer_give_hope_and_those_that_do_not_give_it_up() {
        let mut crowd = Crowd::default();
        // Slowly, in two waves, down to none.
        assert!((0..300).rev().chain((0..400).rev()).all(|left| crowd.has_hope(1, left, 8)));
        // With room there is no end to hope.
        assert!((0..300).all(|_| crowd.has_hope(2, 50, 0)));
        // Two who drive out each other's pages.
        let frames = (0..1000).take_while(|_| crowd.has_hope(3, 50, 8)).count();
        assert_eq!(frames, PATIENCE as usize);
        // Another pose is another matter.
        assert!(crowd.has_hope(4, 50, 8));
    }
}
