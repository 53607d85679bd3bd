//! How often the renderer looks ahead for a viewer. Who asks for the next frame before the look has ended waits for it and gains nothing: after
//! such a look some are left out, twice as many each time, until one ends in time.

/// Frames without a look, at most: the pauses of a viewer, and what a look takes, change.
const LEFT_OUT: u32 = 63;

/// Of one viewer.
#[derive(Debug, Default)]
pub struct Looks {
    is_in_work: bool,
    /// After the last look that came too late.
    pause: u32,
    still_left_out: u32,
}

impl Looks {
    /// Whether to take one now, which then has begun. One that has not ended by the next call came too late.
    pub fn begin(&mut self) -> bool {
        if std::mem::take(&mut self.is_in_work) {
            self.pause = (2 * self.pause + 1).min(LEFT_OUT);
            self.still_left_out = self.pause;
        }
        self.is_in_work = self.still_left_out == 0;
        self.still_left_out = self.still_left_out.saturating_sub(1);
        self.is_in_work
    }

    /// The one that was begun.
    pub fn end(&mut self) {
        (self.is_in_work, self.pause) = (false, 0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn looks_that_come_too_late_become_rare_and_one_in_time_brings_them_back() {
        let mut looks = Looks::default();
        let begun: Vec<u32> = (0..1000).filter(|_| looks.begin()).collect();
        assert_eq!(begun[..7], [0, 2, 6, 14, 30, 62, 126]);
        assert!(begun[7..].windows(2).all(|pair| pair[1] - pair[0] == LEFT_OUT + 1), "{begun:?}");
        while !looks.begin() {}
        looks.end();
        for _ in 0..10 {
            assert!(looks.begin());
            looks.end();
        }
        // As at the beginning.
        assert_eq!((0..4).map(|_| looks.begin()).collect::<Vec<_>>(), [true, false, true, false]);
    }
}
