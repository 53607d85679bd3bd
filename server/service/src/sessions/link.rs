//! The way to the viewer, from acknowledgements alone: how long it takes a frame, and how many frames fill it. `session` reports what is sent
//! and acknowledged; nothing here looks at a clock.
//!
//! The link is a queue: a frame is on it from when it was sent, or the one before had arrived, until it arrives. Acknowledgements come a
//! round trip late, all alike, so that frame i took  ack_i − max(ack_{i−1}, sent_i + base), where base is the least time from sending to
//! acknowledgement that was seen lately (BBR's minimum filter; Cardwell et al. 2016). A base has a frame in it, so that for frames of one size
//! a link with room to spare takes no time at all, and one that is full takes a frame's as soon as another frame waits before it.
//!
//! More frames on their way than fill it make each wait for those before it, and its pose grow old. So of a viewer's credits as many are used
//! as let a frame wait for [`WAIT`] of the time between two (Vegas' rule, Brakmo and Peterson 1995, with a window of parts of frames): the
//! part of a frame is a time after an acknowledgement, in which nothing is begun. What is begun later shows a later pose.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// Frames after which the least time is looked for anew: routes change.
const WINDOW: u32 = 256;
/// What a frame should wait for others, in the time between two frames: enough that the link never runs dry.
const WAIT: f32 = 0.3125;
/// By how many frames the window changes for a frame that waited a whole frame's time too long: less than one over the frames on their way,
/// which is how late it is heard of.
const GAIN: f32 = 1.0 / 16.0;

/// What makes a frame large or small on its way.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Size {
    /// Of the full size's pixels.
    pub share: f32,
    /// Of its encoding, where it has one.
    pub quality: Option<u8>,
}

/// A window that is smaller than the credits by so much, and a frame that waited for so much of the time between two, say that the link is
/// full, not that a frame was late once or twice.
const FULL: f32 = 0.25;
/// A longer wait, in the time between two frames, says no more: one late frame must not empty the window.
const LONGEST_WAIT: f32 = 2.0;
/// Weight of the newest time between two frames in their mean.
const NEWEST: f32 = 0.25;

/// The way to one viewer.
#[derive(Debug)]
pub struct Link {
    /// Frames that the viewer lets be on their way.
    credits: u32,
    /// Of those, what fills the link: 1 to `credits`.
    window: f32,
    /// Between two frames of a full link, seconds.
    spacing: f32,
    /// Not acknowledged yet, oldest first; no more than there are credits.
    on_their_way: VecDeque<Sent>,
    last_acknowledged: Option<Instant>,
    /// Of this window and of the one before it.
    least: [Option<Duration>; 2],
    in_window: u32,
    /// Of frames as large as the last one.
    least_of_size: Option<(Option<Size>, Duration)>,
    /// Until a frame finds the link empty, and the least time is that of one that waits for none.
    is_draining: bool,
}

#[derive(Debug)]
struct Sent {
    frame_id: u64,
    size: Option<Size>,
    at: Instant,
    /// Whether another was on its way before it.
    is_behind: bool,
}

impl Link {
    /// Nothing known of it; at least one credit.
    pub fn new(credits: u32) -> Self {
        Self {
            credits,
            window: credits as f32,
            spacing: 0.0,
            on_their_way: VecDeque::new(),
            last_acknowledged: None,
            least: [None; 2],
            in_window: 0,
            least_of_size: None,
            is_draining: false,
        }
    }

    /// Another way with the same credits, nothing on it.
    pub fn forget(&mut self) {
        *self = Self::new(self.credits);
    }

    /// How many frames may be on their way, at least 1.
    pub fn places(&self) -> u64 {
        if self.is_draining { 1 } else { self.window.ceil() as u64 }
    }

    /// For how long after the last acknowledgement the last of those places stays free.
    pub fn until_begun(&self) -> Option<Instant> {
        let part = self.window.ceil() - self.window;
        self.last_acknowledged.map(|at| at + Duration::from_secs_f32(part * self.spacing))
    }

    /// A frame of this size goes; None where it is in another encoding than those of a moving viewer.
    pub fn sent(&mut self, frame_id: u64, size: Option<Size>, at: Instant) {
        let is_behind = !self.on_their_way.is_empty();
        self.is_draining &= is_behind;
        // The next one, which has the link for itself, tells what frames of this size take.
        let is_as_before = self.on_their_way.back().is_none_or(|before| before.size == size);
        self.is_draining |= !is_as_before && self.window < self.credits as f32;
        self.on_their_way.push_back(Sent { frame_id, size, at, is_behind });
    }

    /// This frame and all before it have arrived: the sum of their shares with the last one's quality, and the seconds that the link was
    /// theirs. None if nothing new, or nothing that says what others will take.
    pub fn acknowledged(&mut self, frame_id: u64, at: Instant) -> Option<(Size, f32)> {
        let (mut share, mut first, mut last) = (0.0, None, None);
        let mut frames = 0.0;
        while let Some(sent) = self.on_their_way.pop_front_if(|sent| sent.frame_id <= frame_id) {
            share += sent.size.map_or(f32::NAN, |size| size.share);
            frames += 1.0;
            first.get_or_insert(sent.at);
            last = Some(sent);
        }
        let (first, last) = (first?, last?);
        let latency = at.saturating_duration_since(last.at);
        let base = self.note(latency);
        let least = self.note_of_size(last.size, latency);
        // A pause is not the link's.
        let before = self.last_acknowledged.replace(at).unwrap_or(first).max(first);
        let spacing = at.saturating_duration_since(before).as_secs_f32();
        let waited = self.fill(last.is_behind.then(|| latency.saturating_sub(least).as_secs_f32()), spacing / frames);
        // A link that is kept full on purpose hides half of a frame's time from the other rule.
        let is_full = self.window < self.credits as f32 - FULL && waited > FULL;
        let begun = (first + base).max(before);
        let size = last.size.filter(|_| !share.is_nan()).map(|size| Size { share, ..size })?;
        Some((size, if is_full { spacing } else { at.saturating_duration_since(begun).as_secs_f32() }))
    }

    /// `wait`: of a frame behind others, seconds. Its part of the time between two frames, of which this is one.
    fn fill(&mut self, wait: Option<f32>, spacing: f32) -> f32 {
        let Some(wait) = wait else {
            // Nothing was before it: there is room.
            self.spacing = 0.0;
            self.window = (self.window + GAIN * WAIT).min(self.credits as f32);
            return 0.0;
        };
        // Acknowledgements that come together say little one by one.
        self.spacing = if self.spacing > 0.0 { self.spacing + NEWEST * (spacing - self.spacing) } else { spacing };
        let waited = if self.spacing > 0.0 { (wait / self.spacing).min(LONGEST_WAIT) } else { 0.0 };
        self.window = (self.window + GAIN * (WAIT - waited)).clamp(1.0, self.credits as f32);
        waited
    }

    /// The least time there and back since frames have this size, this one included.
    fn note_of_size(&mut self, size: Option<Size>, latency: Duration) -> Duration {
        let least = match self.least_of_size {
            Some((known, least)) if known == size && self.in_window > 1 => least.min(latency),
            _ => latency,
        };
        self.least_of_size = Some((size, least));
        least
    }

    /// The least time there and back of late, this one included.
    fn note(&mut self, latency: Duration) -> Duration {
        if self.in_window == WINDOW {
            self.least = [None, self.least[0]];
            self.in_window = 0;
            self.is_draining = self.window < self.credits as f32;
        }
        self.in_window += 1;
        let least = self.least[0].map_or(latency, |least| least.min(latency));
        self.least[0] = Some(least);
        self.least[1].map_or(least, |before| before.min(least))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn millis(n: u64) -> Duration {
        Duration::from_millis(n)
    }

    fn of(share: f32) -> Size {
        Size { share, quality: Some(90) }
    }

    /// A link of `rtt`, which sends a full frame in `full`.
    struct Way {
        rtt: Duration,
        full: Duration,
    }

    /// What came of frames sent whenever there was a place.
    struct Seen {
        /// What the link took for each, seconds.
        took: Vec<f32>,
        /// What each waited for others, in its own time on the link.
        waits: Vec<f32>,
        /// From the first frame's beginning to the last one's arrival, and of that the link's.
        used: f32,
    }

    impl Way {
        fn carry(&self, link: &mut Link, share: f32, frames: u64) -> Seen {
            let start = Instant::now();
            let (mut now, mut free, mut acks) = (start, start, VecDeque::new());
            let mut seen = Seen { took: Vec::new(), waits: Vec::new(), used: 0.0 };
            let own = self.full.mul_f32(share);
            let mut frame_id = 0;
            while frame_id < frames {
                let places = link.places();
                let held = link.until_begun().filter(|_| acks.len() as u64 + 1 == places).unwrap_or(start);
                let acknowledged = acks.front().map(|(_, at)| *at);
                if (acks.len() as u64) < places && held <= now {
                    frame_id += 1;
                    link.sent(frame_id, Some(of(share)), now);
                    seen.waits.push(free.saturating_duration_since(now).as_secs_f32() / own.as_secs_f32());
                    free = free.max(now) + own;
                    acks.push_back((frame_id, free + self.rtt));
                } else if acknowledged.is_none_or(|at| held > now && held < at) {
                    now = held;
                } else {
                    let (acknowledged, at) = acks.pop_front().unwrap();
                    now = at;
                    let (got, seconds) = link.acknowledged(acknowledged, at).unwrap();
                    assert_eq!(got, of(share));
                    seen.took.push(seconds);
                }
            }
            seen.used = own.as_secs_f32() * frames as f32 / (free - start).as_secs_f32();
            seen
        }
    }

    fn quantile(mut values: Vec<f32>, part: f32) -> f32 {
        values.sort_by(f32::total_cmp);
        values[(part * (values.len() - 1) as f32) as usize]
    }

    #[test]
    fn a_link_with_room_to_spare_takes_no_time_and_all_credits_are_used() {
        // Forty milliseconds a frame, so that two and a half fill the round trip.
        let way = Way { rtt: millis(100), full: millis(160) };
        for credits in [1, 2, 3] {
            let mut link = Link::new(credits);
            let seen = way.carry(&mut link, 0.25, 400);
            // The first few are sent at once, each behind the other.
            assert!(seen.took[16..].iter().all(|seconds| *seconds < 1e-6), "{credits} credits");
            assert_eq!(link.places(), u64::from(credits));
            assert!((seen.used - (0.04 * credits as f32 / 0.14)).abs() < 0.01, "{credits} credits: {}", seen.used);
        }
    }

    #[test]
    fn a_full_link_is_kept_busy_takes_a_frames_time_and_lets_none_wait_long() {
        for (rtt, share) in [(0, 0.25), (5, 0.25), (100, 0.25), (100, 1.0), (70, 0.4), (333, 0.1)] {
            for credits in [4, 8, 16_u32] {
                let way = Way { rtt: millis(rtt), full: millis(160) };
                let own = 0.16 * share;
                let fills = 1.0 + 1e-3 * rtt as f32 / own;
                if (credits as f32) <= fills + WAIT + FULL {
                    continue;
                }
                let mut link = Link::new(credits);
                let mut seen = way.carry(&mut link, share, 3000);
                // A queue that was made on the way to that goes by and by.
                let later = seen.waits.split_off(200);
                let (wait, used) = (quantile(later, 0.95), seen.used);
                assert!(wait < 0.8 && used > 0.97, "{rtt} ms, {credits} credits, share {share}: waits {wait}, {used} used");
                let took = quantile(seen.took, 0.5);
                assert!((took - own).abs() < 0.1 * own, "{rtt} ms, {credits} credits: {took} s for {own}");
                assert!(quantile(seen.waits, 1.0) <= credits as f32 - 0.99, "{rtt} ms");
            }
        }
    }

    #[test]
    fn a_small_frame_behind_a_large_one_is_not_blamed_for_it() {
        let start = Instant::now();
        let mut link = Link::new(16);
        link.sent(1, Some(of(0.1)), start);
        assert_eq!(link.acknowledged(1, start + millis(20)), Some((of(0.1), 0.0)));
        link.sent(2, Some(of(1.0)), start + millis(100));
        link.sent(3, Some(of(0.1)), start + millis(101));
        assert_eq!(link.acknowledged(2, start + millis(600)), Some((of(1.0), 0.48)));
        let (share, seconds) = link.acknowledged(3, start + millis(610)).unwrap();
        assert!(share == of(0.1) && (seconds - 0.01).abs() < 1e-6, "{seconds}");
    }

    #[test]
    fn one_acknowledgement_for_several_frames_is_all_of_theirs_and_a_second_one_says_nothing() {
        let start = Instant::now();
        let mut link = Link::new(16);
        (1..=3).for_each(|id| link.sent(id, Some(of(0.5)), start));
        let (share, _) = link.acknowledged(3, start + millis(30)).unwrap();
        assert_eq!(share, of(1.5));
        assert_eq!((link.acknowledged(3, start + millis(40)), link.acknowledged(2, start + millis(40))), (None, None));
    }

    #[test]
    fn a_still_in_another_encoding_says_nothing_of_frames_in_motion() {
        let start = Instant::now();
        let mut link = Link::new(16);
        link.sent(1, Some(of(0.1)), start);
        link.sent(2, None, start);
        assert_eq!(link.acknowledged(2, start + millis(900)), None);
        link.sent(3, Some(of(0.1)), start + millis(1000));
        assert_eq!(link.acknowledged(3, start + millis(1900)), Some((of(0.1), 0.0)));
    }

    #[test]
    fn a_pause_is_not_the_links_and_one_late_acknowledgement_does_not_empty_the_window() {
        let start = Instant::now();
        let mut link = Link::new(4);
        // Full for a while: a frame every 40 ms, each behind another.
        for frame_id in 1..=200 {
            link.sent(frame_id, Some(of(1.0)), start + millis(40 * frame_id));
            if frame_id > 3 {
                link.acknowledged(frame_id - 3, start + millis(40 * frame_id));
            }
        }
        link.acknowledged(200, start + millis(8_100));
        let before = link.window;
        // A minute later two frames are acknowledged at once.
        let later = start + millis(68_000);
        link.sent(201, Some(of(1.0)), later);
        link.sent(202, Some(of(1.0)), later + millis(1));
        let (_, seconds) = link.acknowledged(202, later + millis(160)).unwrap();
        assert!(seconds < 0.2, "{seconds} s");
        assert!(link.until_begun().unwrap() < later + millis(400));
        assert!(link.window > before - 0.2, "{before} {}", link.window);
        // And two within a microsecond.
        link.sent(203, Some(of(1.0)), later + millis(200));
        link.sent(204, Some(of(1.0)), later + millis(240));
        link.acknowledged(203, later + millis(360));
        link.acknowledged(204, later + millis(360) + Duration::from_micros(1));
        assert!(link.window > before - 0.4, "{before} {}", link.window);
    }

    #[test]
    fn a_longer_route_is_learnt_within_two_windows() {
        let (start, mut link, mut last) = (Instant::now(), Link::new(16), 0.0);
        for frame_id in 1..=u64::from(3 * WINDOW) {
            let at = start + millis(1000 * frame_id);
            let rtt = if frame_id <= u64::from(WINDOW) / 2 { millis(10) } else { millis(90) };
            link.sent(frame_id, Some(of(1.0)), at);
            last = link.acknowledged(frame_id, at + rtt).unwrap().1;
        }
        assert_eq!(last, 0.0);
    }

    #[test]
    fn another_way_has_all_credits_and_nothing_on_it() {
        let way = Way { rtt: millis(5), full: millis(160) };
        let mut link = Link::new(8);
        way.carry(&mut link, 0.25, 400);
        assert!(link.places() < 8);
        let now = Instant::now();
        link.sent(1000, Some(of(0.25)), now);
        link.forget();
        assert_eq!((link.places(), link.until_begun()), (8, None));
        assert_eq!(link.acknowledged(1000, now + millis(50)), None);
    }
}
