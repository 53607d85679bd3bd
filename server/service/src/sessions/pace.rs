//! How large, and how well encoded, the frames of a moving viewer are: as comes at the rate that the viewer asked for. `session` reports what
//! frames took and asks for the size and quality of the next; nothing here looks at a clock.
//!
//! Sizes are rungs of a ladder, full size · 2^(−rung/4) in each direction down to an eighth. A frame is taken to cost its wait for the
//! renderer, which its size does not change, and rendering and encoding, or the link's time if that is longer, in proportion to its pixels.
//! What does not shrink with the frame makes that promise too long for larger frames, never too short: so one climbs carefully and does not
//! fall back. Between the two bounds (0.8 and 1 of the interval) a size stays.
//!
//! Where the link is what takes too long, quality goes before size, and size comes back before quality: of 640 × 480 pixels of the gazebo's
//! teapot, 45 kB of JPEG err by 12 codes (RMS) at full size and quality 40, and by 16 at 0.5 of the pixels and quality 90.

//!
//! A link tells what it takes only when it is full: with room to spare it seems to take no time at all (`link`). So what it can do better is
//! tried, and each change of size or quality has it run empty once. A try that fills the link is taken back, and the next one comes after twice
//! as many frames.

use lumisphere::geometry::{Camera, Intrinsics};

/// The smallest: 2^(−12/4), an eighth.
pub const LAST_RUNG: u32 = 12;
const RUNGS_PER_OCTAVE: f32 = 4.0;
/// Weight of the newest measurement in the running mean: two thirds of it are the last four.
const NEWEST: f32 = 0.25;
/// The next larger size is taken when it promises to need no more than this part of the interval.
const CAREFUL: f32 = 0.8;
/// A frame whose rendering is a smaller part of its wait gains nothing from being smaller.
const WORTH: f32 = 1.0 / 16.0;
/// A try that lasts for so many frames has come off: several round trips.
const LASTED: u32 = 64;
/// Frames after a try that failed until the next one: at first, and at most (half a minute at 30 a second).
const PATIENCE: (u32, u32) = (32, 1024);
/// Qualities that a full link may be given instead of a better one that was asked for.
const LESSER_QUALITIES: [u8; 3] = [75, 60, 45];
/// Bytes of a frame by its quality, in those of quality 90: measured on that teapot; between them a straight line.
const BYTES_OF_QUALITY: [(f32, f32); 8] =
    [(1.0, 0.05), (30.0, 0.22), (45.0, 0.28), (60.0, 0.34), (75.0, 0.45), (85.0, 0.6), (90.0, 1.0), (100.0, 2.5)];

/// What a frame took in the server, seconds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Took {
    /// Until its turn came; None where that says nothing of other frames.
    pub waiting: Option<f32>,
    /// Pages, rendering and encoding.
    pub own: f32,
}

/// The controller.
#[derive(Debug, Clone)]
pub struct Pace {
    /// Between two frames, seconds.
    interval: f32,
    rung: u32,
    /// The one asked for, then lesser ones; a single one where quality changes nothing.
    qualities: Vec<u8>,
    /// Of those.
    step: usize,
    /// Of a frame of this rung and step, seconds.
    waiting: Mean,
    own: Mean,
    link: Mean,
    tries: Tries,
}

/// Of larger or better frames than those that the link had no trouble with.
#[derive(Debug, Clone, Copy)]
struct Tries {
    /// Frames that have arrived since the last one, or since it was taken back.
    since: u32,
    has_failed: bool,
    /// So many must have before the next; 0 unless the last ones failed.
    patience: u32,
}

/// Of the recent measurements; None before the first.
#[derive(Debug, Clone, Copy, Default)]
struct Mean(Option<f32>);

impl Pace {
    /// At full size, knowing nothing. `frames_per_second` is positive.
    pub fn new(frames_per_second: f32) -> Self {
        Self {
            interval: 1.0 / frames_per_second,
            rung: 0,
            qualities: vec![u8::MAX],
            step: 0,
            waiting: Mean::default(),
            own: Mean::default(),
            link: Mean::default(),
            tries: Tries::NONE,
        }
    }

    /// Of the next frame while the viewer moves, 1 to 100: at most the one asked for. None, asked, says that the encoding has none.
    pub fn quality(&mut self, asked: Option<u8>) -> Option<u8> {
        if asked.unwrap_or(u8::MAX) != self.qualities[0] {
            let lesser = asked.map(|asked| LESSER_QUALITIES.into_iter().filter(move |lesser| *lesser < asked));
            self.qualities = std::iter::once(asked.unwrap_or(u8::MAX)).chain(lesser.into_iter().flatten()).collect();
            // What was measured was of frames of other qualities.
            (self.step, self.link, self.tries) = (0, Mean::default(), Tries::NONE);
        }
        asked.map(|_| self.qualities[self.step])
    }

    /// Of the next frame while the viewer moves.
    pub fn rung(&self) -> u32 {
        self.rung
    }

    /// A frame with this share of the full size's pixels was rendered and encoded.
    pub fn drawn(&mut self, share: f32, took: Took) {
        if let Some(waiting) = took.waiting {
            self.waiting.take(waiting);
        }
        self.own.take(took.own * self.relative(share));
        self.decide();
    }

    /// Frames with this share of the full size's pixels, of this quality, all together, took the link so many seconds.
    pub fn arrived(&mut self, share: f32, quality: Option<u8>, seconds: f32) {
        let bytes = quality.map_or(1.0, |quality| bytes_of(self.qualities[self.step]) / bytes_of(quality));
        self.link.take(seconds * self.relative(share) * bytes);
        self.tries.count();
        self.decide();
    }

    /// The link is another one.
    pub fn forget_link(&mut self) {
        (self.link, self.tries) = (Mean::default(), Tries::NONE);
    }

    /// From pixels of a share to pixels of this rung.
    fn relative(&self, share: f32) -> f32 {
        share_of(self.rung) / share.max(share_of(LAST_RUNG))
    }

    fn decide(&mut self) {
        let careful = CAREFUL * self.interval;
        if self.promised(self.rung, self.step) > self.interval {
            if self.on_link(self.rung, self.step) > self.interval {
                self.tries.fail();
            }
            self.shrink();
        } else if !self.tries.may_begin() {
            return;
        } else if let Some(rung) = self.rung.checked_sub(1)
            && let Some(step) = (self.step..=self.last_step()).find(|step| self.promised(rung, *step) <= careful)
        {
            self.set(rung, step);
            self.tries.begin();
            return;
        }
        if self.step > 0 && self.tries.may_begin() && self.on_link(self.rung, self.step - 1) <= careful {
            self.set(self.rung, self.step - 1);
            self.tries.begin();
        }
    }

    fn shrink(&mut self) {
        while self.on_link(self.rung, self.step) > self.interval && self.step < self.last_step() {
            self.set(self.rung, self.step + 1);
        }
        while self.rung < LAST_RUNG && self.promised(self.rung, self.step) > self.interval && self.is_worth_shrinking() {
            self.set(self.rung + 1, self.step);
        }
    }

    fn last_step(&self) -> usize {
        self.qualities.len() - 1
    }

    /// Seconds of a frame of that rung and step.
    fn promised(&self, rung: u32, step: usize) -> f32 {
        let pixels = share_of(rung) / share_of(self.rung);
        (self.waiting.value() + self.own.value() * pixels).max(self.on_link(rung, step))
    }

    fn on_link(&self, rung: u32, step: usize) -> f32 {
        self.link.value() * self.bytes(rung, step)
    }

    /// In those of a frame as it is now.
    fn bytes(&self, rung: u32, step: usize) -> f32 {
        share_of(rung) / share_of(self.rung) * bytes_of(self.qualities[step]) / bytes_of(self.qualities[self.step])
    }

    fn is_worth_shrinking(&self) -> bool {
        self.own.value() >= WORTH * self.waiting.value() || self.link.value() > self.interval
    }

    fn set(&mut self, rung: u32, step: usize) {
        let (pixels, bytes) = (share_of(rung) / share_of(self.rung), self.bytes(rung, step));
        (self.rung, self.step) = (rung, step);
        self.own.scale(pixels);
        self.link.scale(bytes);
    }
}

impl Tries {
    /// The last one was long ago, the next may be at once.
    const NONE: Self = Self { since: u32::MAX, has_failed: false, patience: 0 };

    fn count(&mut self) {
        self.since = self.since.saturating_add(1);
        if !self.has_failed && self.since >= LASTED {
            self.patience = 0;
        }
    }

    fn may_begin(self) -> bool {
        if self.has_failed { self.since >= self.patience } else { self.patience == 0 }
    }

    fn begin(&mut self) {
        (self.since, self.has_failed) = (0, false);
    }

    /// The link is full: the last one's fault, where it was not long ago.
    fn fail(&mut self) {
        if !self.has_failed && self.since < LASTED {
            let (first, most) = PATIENCE;
            *self = Self { since: 0, has_failed: true, patience: (2 * self.patience).clamp(first, most) };
        }
    }
}

impl Mean {
    fn take(&mut self, value: f32) {
        self.0 = Some(self.0.map_or(value, |mean| mean + NEWEST * (value - mean)));
    }

    fn scale(&mut self, factor: f32) {
        self.0 = self.0.map(|mean| mean * factor);
    }

    fn value(self) -> f32 {
        self.0.unwrap_or(0.0)
    }
}

/// Of the full size's pixels.
pub fn share_of(rung: u32) -> f32 {
    (-2.0 * rung as f32 / RUNGS_PER_OCTAVE).exp2()
}

/// Bytes of a frame of this quality, in those of quality 90.
fn bytes_of(quality: u8) -> f32 {
    let quality = f32::from(quality.min(100));
    let at = BYTES_OF_QUALITY.partition_point(|(q, _)| *q < quality).clamp(1, BYTES_OF_QUALITY.len() - 1);
    let ((q0, b0), (q1, b1)) = (BYTES_OF_QUALITY[at - 1], BYTES_OF_QUALITY[at]);
    b0 + (b1 - b0) * (quality - q0) / (q1 - q0)
}

/// The same view with fewer pixels, rounded to whole ones; at least one each way. The camera itself on rung 0.
pub fn smaller(camera: &Camera, rung: u32) -> Camera {
    let full = *camera.intrinsics();
    let factor = (-(rung as f32) / RUNGS_PER_OCTAVE).exp2();
    let scaled = |pixels: u32| ((pixels as f32 * factor).round() as u32).clamp(1, pixels);
    let (width_px, height_px) = (scaled(full.width_px), scaled(full.height_px));
    // What is left of each side, exactly: the edges of the picture stay where they are.
    let left = glam::Vec2::new(width_px as f32 / full.width_px as f32, height_px as f32 / full.height_px as f32);
    let intrinsics = Intrinsics { width_px, height_px, focal_px: full.focal_px * left, center_px: full.center_px * left };
    // Beyond the range of f32 there is no smaller camera.
    Camera::new(intrinsics, *camera.pose()).unwrap_or(*camera)
}

/// Of the full camera's pixels.
pub fn share(drawn: &Camera, full: &Camera) -> f32 {
    let pixels = |camera: &Camera| camera.intrinsics().width_px as f32 * camera.intrinsics().height_px as f32;
    pixels(drawn) / pixels(full)
}

#[cfg(test)]
mod tests {
    use glam::{Vec2, Vec3};
    use lumisphere::geometry::Pose;
    use proptest::prelude::*;

    use super::*;

    /// What frames of a machine cost: `fixed` + `per_size` · share, after `waiting`; `link` · share on the way.
    #[derive(Debug, Clone, Copy)]
    struct Machine {
        waiting: f32,
        fixed: f32,
        per_size: f32,
        link: f32,
    }

    impl Machine {
        fn own(&self, rung: u32) -> f32 {
            self.fixed + self.per_size * share_of(rung)
        }

        fn on_link(&self, rung: u32, quality: Option<u8>) -> f32 {
            self.link * share_of(rung) * quality.map_or(1.0, bytes_of)
        }

        fn seconds(&self, rung: u32, quality: Option<u8>) -> f32 {
            (self.waiting + self.own(rung)).max(self.on_link(rung, quality))
        }

        /// The rungs of so many frames.
        fn frames(&self, pace: &mut Pace, count: usize) -> Vec<u32> {
            self.encoded(pace, None, count).into_iter().map(|(rung, _)| rung).collect()
        }

        /// The rungs and qualities of so many frames.
        fn encoded(&self, pace: &mut Pace, asked: Option<u8>, count: usize) -> Vec<(u32, Option<u8>)> {
            let frame = |_| {
                let (rung, quality) = (pace.rung(), pace.quality(asked));
                pace.drawn(share_of(rung), Took { waiting: Some(self.waiting), own: self.own(rung) });
                pace.arrived(share_of(rung), quality, self.on_link(rung, quality));
                (rung, quality)
            };
            (0..count).map(frame).collect()
        }
    }

    fn machines() -> impl Strategy<Value = Machine> {
        let seconds = || prop_oneof![Just(0.0_f32), (-12.0_f32..2.0).prop_map(f32::exp2)];
        (seconds(), seconds(), seconds(), seconds()).prop_map(|(waiting, fixed, per_size, link)| Machine { waiting, fixed, per_size, link })
    }

    fn asked() -> impl Strategy<Value = Option<u8>> {
        proptest::option::of(1_u8..=100)
    }

    /// A size that is settled. Each rung down takes the promise of a cost that does not shrink down by 0.7, and the mean needs up to
    /// ln(2^-24 / 0.3) / ln 0.75 = 54 frames to notice the last bit of it; there are twelve rungs.
    const LONG: usize = 700;

    proptest! {
        #[test]
        fn a_steady_machine_gets_a_steady_size(machine in machines(), fps in 1.0_f32..240.0, asked in asked()) {
            let mut pace = Pace::new(fps);
            machine.encoded(&mut pace, asked, LONG);
            let frames = machine.encoded(&mut pace, asked, LONG);
            prop_assert!(frames.iter().all(|f| *f == frames[0]), "{frames:?}");
        }

        /// The bounds have a part in a thousand for means that are not quite there.
        #[test]
        fn the_size_keeps_the_rate_where_any_does_and_is_not_smaller_than_it_asks(
            machine in machines(),
            fps in 1.0_f32..240.0,
            asked in asked(),
        ) {
            let mut pace = Pace::new(fps);
            let (rung, quality) = *machine.encoded(&mut pace, asked, LONG).last().unwrap();
            let (interval, least) = (1.0 / fps, asked.map(|asked| asked.min(45)));
            let seconds = machine.seconds(rung, quality);
            if rung < LAST_RUNG {
                let pointless = machine.own(rung) <= 1.001 * WORTH * machine.waiting && machine.on_link(rung, quality) <= 1.001 * interval;
                prop_assert!(seconds <= 1.001 * interval || pointless, "{seconds} s on rung {rung}, {quality:?}");
            }
            if quality < asked {
                let better = LESSER_QUALITIES.into_iter().rev().find(|q| Some(*q) > quality && Some(*q) < asked).or(asked);
                let promise = machine.on_link(rung, better);
                prop_assert!(promise > 0.999 * CAREFUL * interval, "{promise} s promised with {better:?} instead of {quality:?}");
            }
            let quality = least;
            if rung > 0 {
                let larger = share_of(rung - 1) / share_of(rung);
                let promise = (machine.waiting + machine.own(rung) * larger).max(machine.on_link(rung - 1, quality));
                prop_assert!(promise > 0.999 * CAREFUL * interval, "{promise} s promised one rung above {rung}");
            }
        }

        #[test]
        fn what_is_proportional_to_pixels_has_its_closed_form(per_size in 0.0001_f32..10.0, fps in 1.0_f32..240.0) {
            let machine = Machine { waiting: 0.0, fixed: 0.0, per_size, link: 0.0 };
            let mut pace = Pace::new(fps);
            let rung = machine.frames(&mut pace, 3)[2];
            // The first frame tells all: the largest size in time.
            let rungs = 2.0 * (per_size * fps).log2();
            let exact = rungs.ceil().clamp(0.0, LAST_RUNG as f32);
            // On a rung's edge rounding decides.
            let is_edge = (rungs - rungs.round()).abs() < 1e-3;
            prop_assert!(rung as f32 == exact || is_edge && (rung as f32 - exact).abs() <= 1.0, "{rung}, not {exact}");
        }

        #[test]
        fn a_smaller_camera_sees_the_same(
            (width, height) in (1_u32..5000, 1_u32..5000),
            rung in 0..=LAST_RUNG,
            (x, y) in (0.0_f32..1.0, 0.0_f32..1.0),
        ) {
            let pose = Pose::look_at(Vec3::new(1.0, 2.0, 3.0), Vec3::ZERO, Vec3::Y).unwrap();
            let intrinsics = Intrinsics {
                width_px: width,
                height_px: height,
                focal_px: Vec2::new(0.9 * width as f32, 1.1 * height as f32),
                center_px: Vec2::new(0.4 * width as f32, 0.6 * height as f32),
            };
            let full = Camera::new(intrinsics, pose).unwrap();
            let drawn = smaller(&full, rung);
            let size = |c: &Camera| Vec2::new(c.intrinsics().width_px as f32, c.intrinsics().height_px as f32);
            // The same place of both pictures is the same ray, to the rounding of f32.
            let at = Vec2::new(x, y);
            let (a, b) = (full.ray(at * size(&full)), drawn.ray(at * size(&drawn)));
            prop_assert!(a.direction.distance(b.direction) < 1e-5, "{a:?} {b:?}");
            let exact = size(&full) * 2.0_f32.powf(-(rung as f32) / 4.0);
            prop_assert!((size(&drawn) - exact.max(Vec2::ONE)).abs().max_element() <= 0.51);
            prop_assert_eq!(drawn == full, rung == 0 || (width, height) == (1, 1) || size(&drawn) == size(&full));
        }
    }

    #[test]
    fn load_shrinks_at_once_and_relief_grows_by_rungs() {
        let mut pace = Pace::new(30.0);
        let fast = Machine { waiting: 0.0, fixed: 0.001, per_size: 0.01, link: 0.0 };
        assert_eq!(fast.frames(&mut pace, 20), [0; 20]);
        // Eight times as long as the interval: three octaves of pixels, six rungs, as soon as the mean has noticed.
        let slow = Machine { per_size: 8.0 / 30.0, fixed: 0.0, ..fast };
        let rungs = slow.frames(&mut pace, 40);
        assert!(rungs[1] >= 2 && (6..=7).contains(rungs.last().unwrap()), "{rungs:?}");
        let rungs = fast.frames(&mut pace, 60);
        assert!(rungs.windows(2).all(|w| w[1] <= w[0] && w[0] - w[1] <= 1) && *rungs.last().unwrap() == 0, "{rungs:?}");
    }

    #[test]
    fn a_full_link_takes_quality_before_size_and_gives_it_back_last() {
        let mut pace = Pace::new(10.0);
        let on_a_link = |link| Machine { waiting: 0.0, fixed: 0.001, per_size: 0.01, link };
        let last = |pace: &mut Pace, link: f32| *on_a_link(link).encoded(pace, Some(90), 100).last().unwrap();
        for (link, expected) in [(0.09, (0, 90)), (0.15, (0, 75)), (0.25, (0, 60)), (0.34, (0, 45)), (0.7, (2, 45)), (0.28, (0, 45))] {
            assert_eq!(last(&mut pace, link), (expected.0, Some(expected.1)), "{link} s");
        }
        assert_eq!(last(&mut pace, 0.01), (0, Some(90)));
        // One who asks for less gets no more; where there is no quality, only the size is left.
        assert_eq!(*on_a_link(0.5).encoded(&mut pace, Some(50), 100).last().unwrap(), (1, Some(45)));
        assert_eq!(*on_a_link(0.15).encoded(&mut pace, None, 100).last().unwrap(), (2, None));
    }

    #[test]
    fn a_link_that_says_nothing_until_it_is_full_is_tried_less_and_less_often() {
        // 0.4 of the interval at the lowest quality, 1.4 of it at the highest.
        let link = Machine { waiting: 0.0, fixed: 0.001, per_size: 0.01, link: 1.4 / 30.0 };
        let mut pace = Pace::new(30.0);
        let mut too_large = |count: usize| {
            let frame = |_| {
                let (rung, quality) = (pace.rung(), pace.quality(Some(90)));
                pace.drawn(share_of(rung), Took { waiting: None, own: link.own(rung) });
                let seconds = link.on_link(rung, quality);
                let is_full = seconds > 1.0 / 30.0;
                pace.arrived(share_of(rung), quality, if is_full { seconds } else { 0.0 });
                is_full
            };
            (0..count).map(frame).filter(|is_full| *is_full).count()
        };
        too_large(1000);
        // Three tries of some frames each, until the mean has noticed.
        let tried = too_large(3000);
        assert!((1..=40).contains(&tried), "{tried} of 3000 frames filled the link");
        // Nor oftener where others are waited for all the time, so that no size would keep the rate.
        let mut waits = Pace::new(30.0);
        let mut full = 0;
        for frame in 0..4000 {
            let (rung, quality) = (waits.rung(), waits.quality(Some(90)));
            waits.drawn(share_of(rung), Took { waiting: Some(1.2 / 30.0), own: 0.002 * share_of(rung) });
            let seconds = link.on_link(rung, quality);
            let is_full = seconds > 1.0 / 30.0;
            waits.arrived(share_of(rung), quality, if is_full { seconds } else { 0.0 });
            full += usize::from(is_full && frame >= 1000);
        }
        assert!((1..=40).contains(&full), "{full} of 3000 frames filled the link while others were waited for");
        // A better one is noticed within the longest patience, and then used at once.
        let better = Machine { link: 0.1 / 30.0, ..link };
        let found = better.encoded(&mut pace, Some(90), PATIENCE.1 as usize + 100);
        assert_eq!(*found.last().unwrap(), (0, Some(90)));
    }

    #[test]
    fn another_link_is_not_blamed_for_the_one_before() {
        let full = |pace: &mut Pace| pace.arrived(share_of(pace.rung()), Some(90), 0.5);
        let mut pace = Pace::new(30.0);
        assert_eq!(pace.quality(Some(90)), Some(90));
        // Tried, and taken back: the next try is far.
        (0..20).for_each(|_| full(&mut pace));
        (0..20).for_each(|_| pace.arrived(share_of(pace.rung()), Some(45), 0.0));
        (0..20).for_each(|_| full(&mut pace));
        let rung = pace.rung();
        assert!(rung > 0 && !pace.tries.may_begin());
        pace.forget_link();
        pace.arrived(share_of(rung), Some(45), 0.0);
        assert_eq!(pace.rung(), rung - 1);
    }

    #[test]
    fn bytes_grow_with_quality() {
        assert!((1..100).all(|q| bytes_of(q) < bytes_of(q + 1)));
        assert_eq!([bytes_of(90), bytes_of(75), bytes_of(100)], [1.0, 0.45, 2.5]);
    }

    #[test]
    fn a_wait_for_others_does_not_shrink_what_is_small_beside_it() {
        let mut pace = Pace::new(30.0);
        let behind = Machine { waiting: 1.0, fixed: 0.0, per_size: 0.02, link: 0.0 };
        assert_eq!(behind.frames(&mut pace, 50), [0; 50]);
        // A wait that says nothing is not counted.
        let mut pace = Pace::new(30.0);
        pace.drawn(1.0, Took { waiting: None, own: 0.03 });
        pace.drawn(1.0, Took { waiting: Some(0.001), own: 0.03 });
        assert_eq!(pace.rung(), 0);
        let slow_link = Machine { link: 4.0 / 30.0, ..behind };
        assert!((4..=5).contains(slow_link.frames(&mut pace, 50).last().unwrap()));
    }
}
