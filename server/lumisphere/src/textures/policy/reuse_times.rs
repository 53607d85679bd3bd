//! After which time a page is used again, learned by classes of pages, and what that makes a page worth that was used some time ago:
//! the Gittins index, by which `gittins` chooses who leaves.
//!
//! Keeping a page pays with hits and costs the place for as long as it is kept. If uses of a page are apart by independent times of
//! one law, the best that can be made of a page whose last use was at age a is, over all ages T up to which one would wait,
//!
//! max over T of P(used again by T) / E(time until it is used again, T at most), both given that it was not used up to a:
//!
//! the index of J. C. Gittins (Bandit processes and dynamic allocation indices, JRSS B 1979). L. Belady's optimum knows the time, this
//! only its law. N. Beckmann, H. Chen, A. Cidon (LHD, NSDI 2018) rank by the same ratio with T where their cache evicts.
//!
//! The laws are estimated as survival is (E. Kaplan, P. Meier 1958): the chance to be used within an age, among those that reached it,
//! so that pages never used again count as well. A class with few pages leans on all pages together, and these on a law under which
//! the oldest use is worth least: before anything is learned this is LRU.

/// Ages are told apart by half octaves; all from the last one's start on are one.
pub(super) const AGES: usize = 52;
/// Classes of pages.
pub(super) const CLASSES: usize = 64;

/// The presumed law: a page is used again later than age a with probability (1 + a)^−θ. Its chance to be used now falls with 1 / (1 + a),
/// whatever θ.
const PRESUMED_EXPONENT: f64 = 0.1;
/// So many pages of the presumed law are added to all pages, and of the law of all to each class.
const PRESUMED_PAGES: f64 = 200.0;

/// The half octave of an age.
#[inline]
fn bucket(age: u64) -> usize {
    if age < 4 {
        return age as usize;
    }
    let shift = age.ilog2() - 1;
    (2 * shift as usize + (age >> shift) as usize).min(AGES - 1)
}

/// The first age of a half octave.
fn start(bucket: usize) -> f64 {
    if bucket < 4 { bucket as f64 } else { ((bucket % 2 + 2) as u64 * (1 << (bucket / 2 - 1))) as f64 }
}

/// Pages, by class and age.
#[derive(Debug, Clone)]
pub(super) struct Counts(Box<[[f32; AGES]; CLASSES]>);

impl Counts {
    /// None.
    pub fn new() -> Self {
        Self(Box::new([[0.0; AGES]; CLASSES]))
    }

    /// One more.
    #[inline]
    pub fn add(&mut self, class: u8, age: u64) {
        self.add_weighted(class, age, 1.0);
    }

    /// One that counts for more or less.
    #[inline]
    pub fn add_weighted(&mut self, class: u8, age: u64, weight: f32) {
        self.0[usize::from(class) % CLASSES][bucket(age)] += weight;
    }

    fn scale(&mut self, factor: f32) {
        self.0.iter_mut().flatten().for_each(|count| *count *= factor);
    }

    fn of_all(&self) -> [f32; AGES] {
        std::array::from_fn(|age| self.0.iter().map(|class| class[age]).sum())
    }
}

/// The laws, and the indices that follow.
#[derive(Debug)]
pub(super) struct ReuseTimes {
    /// At which age pages were used again.
    pub reused: Counts,
    /// At which age they were forgotten, not used again until then.
    pub forgotten: Counts,
    indices: Box<[[f64; AGES]; CLASSES]>,
}

impl ReuseTimes {
    /// Nothing is known.
    pub fn new() -> Self {
        let mut times = Self { reused: Counts::new(), forgotten: Counts::new(), indices: Box::new([[0.0; AGES]; CLASSES]) };
        times.learn(&Counts::new());
        times
    }

    /// Expected hits per unit of time of a page's place.
    #[inline]
    pub fn index(&self, class: u8, age: u64) -> f64 {
        self.indices[usize::from(class) % CLASSES][bucket(age)]
    }

    /// What was seen so far counts less from now on.
    pub fn fade(&mut self, factor: f32) {
        self.reused.scale(factor);
        self.forgotten.scale(factor);
    }

    /// Computes the indices anew; `waiting` are the pages that may be used yet, at their present ages.
    pub fn learn(&mut self, waiting: &Counts) {
        let (waiting_of_all, forgotten_of_all) = (waiting.of_all(), self.forgotten.of_all());
        let all = law(&self.reused.of_all(), &sum(&waiting_of_all, &forgotten_of_all), &presumed_law());
        for (class, indices) in self.indices.iter_mut().enumerate() {
            let unused = sum(&waiting.0[class], &self.forgotten.0[class]);
            *indices = gittins_indices(&law(&self.reused.0[class], &unused, &all));
        }
    }
}

fn sum(a: &[f32; AGES], b: &[f32; AGES]) -> [f32; AGES] {
    std::array::from_fn(|age| a[age] + b[age])
}

/// For every age the chance to be used within it, given that it was reached.
type Law = [f64; AGES];

fn presumed_law() -> Law {
    std::array::from_fn(|age| 1.0 - ((1.0 + start(age)) / (1.0 + start(age + 1))).powf(PRESUMED_EXPONENT))
}

/// The law of pages used again and not used again, seen up to some age, together with [`PRESUMED_PAGES`] of another law. Who was
/// seen up to some age of a half octave is taken to have been half through it.
fn law(reused: &[f32; AGES], unused: &[f32; AGES], presumed: &Law) -> Law {
    let mut reached = [0.0; AGES];
    let mut older = 0.0;
    for age in (0..AGES).rev() {
        let (reused, unused) = (f64::from(reused[age]), f64::from(unused[age]));
        reached[age] = older + reused + 0.5 * unused;
        older += reused + unused;
    }
    let mut presumed_pages = PRESUMED_PAGES;
    std::array::from_fn(|age| {
        let presumed_uses = presumed_pages * presumed[age];
        let chance = (f64::from(reused[age]) + presumed_uses) / (reached[age] + presumed_pages);
        presumed_pages -= presumed_uses;
        chance
    })
}

/// The index at the start of every half octave. With P(T) and E(T) from age 0 on, the index at a is the steepest slope from the point
/// (E(a), P(a)) to a later one: an edge of the upper convex hull of the later points, found from the last to the first.
fn gittins_indices(law: &Law) -> [f64; AGES] {
    let mut points = [(0.0, 0.0); AGES + 1];
    let mut left = 1.0;
    for age in 0..AGES {
        let used = left * law[age];
        let (time, chance): (f64, f64) = points[age];
        // Uses lie in the middle of the half octave.
        points[age + 1] = (time + (left - 0.5 * used) * (start(age + 1) - start(age)), chance + used);
        left -= used;
    }
    let slope = |from: (f64, f64), to: (f64, f64)| {
        let time = to.0 - from.0;
        if time > 0.0 { (to.1 - from.1) / time } else { 0.0 }
    };
    let mut indices = [0.0; AGES];
    // Places of the hull's points, the nearest last.
    let mut hull = vec![AGES];
    for age in (0..AGES).rev() {
        while let [.., farther, nearer] = hull[..]
            && slope(points[age], points[nearer]) <= slope(points[age], points[farther])
        {
            hull.pop();
        }
        indices[age] = hull.last().map_or(0.0, |&nearest| slope(points[age], points[nearest]));
        hull.push(age);
    }
    indices
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn half_octaves_follow_each_other_without_a_gap() {
        for age in 0..1 << 20 {
            let bucket = bucket(age);
            assert!(start(bucket) <= age as f64 && (age as f64) < start(bucket + 1), "age {age} in half octave {bucket}");
        }
        assert_eq!(bucket(u64::MAX), AGES - 1);
    }

    #[test]
    fn before_anything_is_learned_the_oldest_use_is_worth_least() {
        let times = ReuseTimes::new();
        for age in 1..1 << 20 {
            assert!(times.index(7, age) <= times.index(7, age - 1), "age {age}");
        }
        assert!(times.index(7, 1 << 20) < 1e-3 * times.index(7, 0));
    }

    /// Used again after 1000 of its own time units, always: just before that a page is worth most.
    #[test]
    fn a_page_that_comes_round_is_worth_more_the_nearer_its_time_is() {
        let mut times = ReuseTimes::new();
        (0..100_000).for_each(|_| times.reused.add(3, 1000));
        times.learn(&Counts::new());
        assert!(times.index(3, 700) > times.index(3, 100));
        assert!(times.index(3, 100) > times.index(3, 10));
        // Past it, it is not expected any more.
        assert!(times.index(3, 700) > 10.0 * times.index(3, 3000));
    }

    /// The same uses, and a hundred times as many pages that never came back.
    #[test]
    fn pages_that_never_return_make_their_class_worth_less() {
        let mut times = ReuseTimes::new();
        (0..10_000).for_each(|_| times.reused.add(3, 20));
        (0..10_000).for_each(|_| times.reused.add(4, 20));
        let mut waiting = Counts::new();
        (0..1_000_000).for_each(|_| waiting.add(4, 5000));
        times.learn(&waiting);
        assert!(times.index(3, 10) > 10.0 * times.index(4, 10));
    }

    /// Of all pages each comes back after 1000; the only one of its class that was seen came back after 100.
    #[test]
    fn a_class_of_which_little_was_seen_is_worth_what_all_are() {
        let mut times = ReuseTimes::new();
        (0..100_000).for_each(|_| times.reused.add(3, 1000));
        times.reused.add(4, 100);
        times.learn(&Counts::new());
        assert!(times.index(4, 0) < 2.0 * times.index(3, 0), "{}, {}", times.index(4, 0), times.index(3, 0));
    }

    proptest! {
        /// The definition: every horizon tried.
        #[test]
        fn the_hull_finds_the_best_horizon(law in prop::array::uniform32(0.0f64..1.0)) {
            let law: Law = std::array::from_fn(|age| law[age % 32] * law[(7 * age + 3) % 32]);
            let indices = gittins_indices(&law);
            for from in 0..AGES {
                let (mut left, mut chance, mut time, mut best) = (1.0, 0.0, 0.0, 0.0f64);
                for (age, used) in law.iter().enumerate().skip(from) {
                    let used = left * used;
                    chance += used;
                    time += (left - 0.5 * used) * (start(age + 1) - start(age));
                    left -= used;
                    best = best.max(chance / time);
                }
                // Both are rounded: the hull takes differences of sums that begin at age 0, where little may be left.
                let survived: f64 = law[..from].iter().map(|used| 1.0 - used).product();
                prop_assert!((indices[from] - best).abs() <= 1e-9 * best + 1e-15 / survived, "{from}: {} and {best}", indices[from]);
            }
        }
    }
}
