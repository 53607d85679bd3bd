//! How long the way to the viewer takes a frame, from acknowledgements alone. `session` reports what is sent and acknowledged; nothing here
//! looks at a clock.
//!
//! The link is a queue: a frame is on it from when it was sent, or the one before had arrived, until it arrives. Acknowledgements come a
//! round trip late, all alike, so that frame i took  ack_i − max(ack_{i−1}, sent_i + base), where base is the least time from sending to
//! acknowledgement that was seen lately (BBR's minimum filter; Cardwell et al. 2016). A base has its own frame in it, so that a link with
//! room to spare takes no time at all, and one that is full takes a frame's as soon as another frame waits before it.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// Frames after which the least time is looked for anew: routes change.
const WINDOW: u32 = 256;

/// The way to one viewer.
#[derive(Debug, Default)]
pub struct Link {
    /// Not acknowledged yet, oldest first; no more than there are credits.
    on_their_way: VecDeque<Sent>,
    last_acknowledged: Option<Instant>,
    /// Of this window and of the one before it.
    least: [Option<Duration>; 2],
    in_window: u32,
}

#[derive(Debug)]
struct Sent {
    frame_id: u64,
    share: f32,
    at: Instant,
}

impl Link {
    /// A frame with this share of the full size's pixels goes.
    pub fn sent(&mut self, frame_id: u64, share: f32, at: Instant) {
        self.on_their_way.push_back(Sent { frame_id, share, at });
    }

    /// This frame and all before it have arrived: the sum of their shares, and the seconds that the link was theirs. None if nothing new.
    pub fn acknowledged(&mut self, frame_id: u64, at: Instant) -> Option<(f32, f32)> {
        let (mut share, mut first, mut latency) = (0.0, None, Duration::ZERO);
        while let Some(sent) = self.on_their_way.pop_front_if(|sent| sent.frame_id <= frame_id) {
            share += sent.share;
            first.get_or_insert(sent.at);
            latency = at.saturating_duration_since(sent.at);
        }
        let first = first?;
        let begun = (first + self.note(latency)).max(self.last_acknowledged.unwrap_or(first));
        self.last_acknowledged = Some(at);
        Some((share, at.saturating_duration_since(begun).as_secs_f32()))
    }

    /// The least time there and back of late, this one included.
    fn note(&mut self, latency: Duration) -> Duration {
        if self.in_window == WINDOW {
            self.least = [None, self.least[0]];
            self.in_window = 0;
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

    /// A link of `rtt` and so many seconds for a full frame, saturated with `credits` frames of one share; what it is taken for.
    fn measured(rtt: Duration, full: Duration, share: f32, credits: usize, frames: u64) -> Vec<f32> {
        let start = Instant::now();
        let (mut link, mut free, mut acks, mut seen) = (Link::default(), start, VecDeque::new(), Vec::new());
        for frame_id in 1..=frames {
            // Without a credit one waits for the oldest acknowledgement.
            let mut now = start;
            if acks.len() == credits {
                let (acknowledged, at) = acks.pop_front().unwrap();
                let (got, seconds) = link.acknowledged(acknowledged, at).unwrap();
                assert_eq!(got, share);
                seen.push(seconds);
                now = at;
            }
            link.sent(frame_id, share, now);
            free = free.max(now) + full.mul_f32(share);
            acks.push_back((frame_id, free + rtt));
        }
        seen
    }

    #[test]
    fn a_full_link_takes_a_frames_time_and_one_with_room_to_spare_none() {
        for (rtt, credits) in [(0, 1), (100, 2), (100, 4), (100, 16)] {
            let last = *measured(millis(rtt), millis(160), 0.25, credits, 100).last().unwrap();
            // Forty milliseconds a frame. From sending to acknowledgement: as many frames as there are credits, where they fill the round
            // trip; of that the base hides a round trip and a frame.
            let queue = 0.04 * (credits - 1) as f32 - 1e-3 * rtt as f32;
            assert!((last - queue.clamp(0.0, 0.04)).abs() < 1e-3, "{rtt} ms, {credits} credits: {last}");
        }
    }

    #[test]
    fn a_small_frame_behind_a_large_one_is_not_blamed_for_it() {
        let start = Instant::now();
        let mut link = Link::default();
        link.sent(1, 0.1, start);
        assert_eq!(link.acknowledged(1, start + millis(20)), Some((0.1, 0.0)));
        link.sent(2, 1.0, start + millis(100));
        link.sent(3, 0.1, start + millis(101));
        assert_eq!(link.acknowledged(2, start + millis(600)), Some((1.0, 0.48)));
        let (share, seconds) = link.acknowledged(3, start + millis(610)).unwrap();
        assert!(share == 0.1 && (seconds - 0.01).abs() < 1e-6, "{seconds}");
    }

    #[test]
    fn one_acknowledgement_for_several_frames_is_all_of_theirs_and_a_second_one_says_nothing() {
        let start = Instant::now();
        let mut link = Link::default();
        (1..=3).for_each(|id| link.sent(id, 0.5, start));
        let (share, _) = link.acknowledged(3, start + millis(30)).unwrap();
        assert_eq!(share, 1.5);
        assert_eq!((link.acknowledged(3, start + millis(40)), link.acknowledged(2, start + millis(40))), (None, None));
    }

    #[test]
    fn a_longer_route_is_learnt_within_two_windows() {
        let (start, mut link, mut last) = (Instant::now(), Link::default(), 0.0);
        for frame_id in 1..=u64::from(3 * WINDOW) {
            let at = start + millis(1000 * frame_id);
            let rtt = if frame_id <= u64::from(WINDOW) / 2 { millis(10) } else { millis(90) };
            link.sent(frame_id, 1.0, at);
            last = link.acknowledged(frame_id, at + rtt).unwrap().1;
        }
        assert_eq!(last, 0.0);
    }
}
