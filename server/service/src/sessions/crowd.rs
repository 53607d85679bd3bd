//! Whether further frames of a pose will ever have all their pages: not where others at rest want so many that each frame drives out what the
//! one before brought.

/// Frames in a row that miss no fewer pages than one before: the others' frames come between, and some pages wait on the disk.
const PATIENCE: u32 = 16;

/// Of the frames of one wish.
#[derive(Debug, Default)]
pub struct Crowd {
    revision: u64,
    least_misses: Option<u64>,
    in_vain: u32,
}

impl Crowd {
    /// A frame of the wish with that revision missed so many pages. Whether there is hope that a further one misses none.
    pub fn has_hope(&mut self, revision: u64, misses: u64) -> bool {
        if self.revision != revision {
            *self = Self { revision, ..Self::default() };
        }
        if self.least_misses.is_none_or(|least| misses < least) {
            (self.least_misses, self.in_vain) = (Some(misses), 0);
        } else {
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
        // Slowly, with others' frames between, down to none.
        for left in (0..300).rev() {
            assert!(crowd.has_hope(1, left) && crowd.has_hope(1, left + 40));
        }
        // Two who drive out each other's pages.
        let frames = (0..100).take_while(|frame| crowd.has_hope(2, 50 + frame % 3)).count();
        assert_eq!(frames, PATIENCE as usize);
        // Another pose is another matter.
        assert!(crowd.has_hope(3, 50));
    }
}
