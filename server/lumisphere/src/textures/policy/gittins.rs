//! Keeps the pages of which the most hits are expected for the time that they take a place: on rendered frames within 3.1 % of the best
//! of the others at every size measured, and mostly better. Who leaves has the least Gittins index, by its age and its class; see [`reuse_times`](super::reuse_times).
//!
//! Age is counted in visits that came after more than a while, half a visit for every page held: the run of visits with which a
//! bucket of pixels goes to and fro between its pages would else be most of all time. A page's class says how long it was between its
//! last two uses, and how often it was used of late. Pages that left are remembered for as long as twice as many come after them, so
//! that the law knows of uses that the cache missed.
//!
//! Among more than 64 pages, 64 are drawn and the worst of them leaves (LHD's way). The generator's seed is fixed: same
//! visits, same evictions.
//!
//! A visit that soon follows another of the page's counts as a use, and says nothing of when pages are used again: such visits are most, and
//! cost what they cost under LRU. An eviction costs 64 comparisons, and every few thousand visits a pass over the pages learns anew.
//! A page's weight does not count: reading it again costs as much as it weighs, so that what a byte is worth is the index itself.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::ghosts::Ghosts;
use super::reuse_times::{Counts, ReuseTimes};
use super::{PageKey, Policy};

/// Pages compared for an eviction.
const CANDIDATES: usize = 64;
/// Pages that left are remembered, for each that is held.
const GHOSTS: u64 = 2;
/// But for so many at least.
const FEWEST_GHOSTS: u64 = 256;
/// Visits between two lessons, which an eviction begins; more where more pages are known.
const LESSON_VISITS: u64 = 4096;
/// What was seen counts less by this at every lesson, so that the last 100 say most.
pub(super) const FADING: f32 = 0.99;
/// A page that is visited again within this part of the number of pages held was in use all along.
const IN_USE_PART: u64 = 10;
/// Visits for each page held after which one use counts half in how often a page is used.
const FREQUENCY_HALF_LIFE: f32 = 100.0;

/// What is known of a page, held or not.
#[derive(Debug, Clone, Copy)]
struct Record {
    /// The time, and the visit's number, of its last use.
    time: u64,
    visit: u64,
    /// Uses of late.
    frequency: f32,
    class: u8,
}

/// A page that is held.
#[derive(Debug, Clone, Copy)]
struct Resident {
    record: Record,
    key: PageKey,
    /// In the list of slots; [`FREE`] for a slot that holds nothing.
    place: u32,
}

const FREE: u32 = u32::MAX;

/// The time, and what it taught.
#[derive(Debug)]
struct History {
    times: ReuseTimes,
    time: u64,
    visits: u64,
}

/// Who is expected to hit least for its time leaves.
#[derive(Debug)]
pub struct Gittins {
    history: History,
    /// By slot.
    residents: Vec<Resident>,
    slots: Vec<u32>,
    ghosts: Ghosts<Record>,
    arriving: Option<(PageKey, Record)>,
    lesson_visits: u64,
    next_lesson: u64,
    rng: Pcg32,
}

impl History {
    /// A page that is not known arrives.
    fn first_seen(&mut self) -> Record {
        self.visits += 1;
        self.time += 1;
        Record { time: self.time, visit: self.visits, frequency: 1.0, class: class(None, 1.0) }
    }

    /// A known page is visited while so many are held.
    #[inline]
    fn seen_again(&mut self, record: &mut Record, held: u64) {
        self.visits += 1;
        let visits = self.visits - record.visit;
        record.visit = self.visits;
        if IN_USE_PART * visits < held {
            record.time = self.time;
            record.frequency += 1.0;
            record.class = record.class & !7 | often(record.frequency);
        } else {
            self.used_again(record, visits, held);
        }
    }

    /// After so many visits.
    fn used_again(&mut self, record: &mut Record, visits: u64, held: u64) {
        self.time += u64::from(2 * visits >= held);
        let age = self.time - record.time;
        self.times.reused.add(record.class, age);
        record.time = self.time;
        let half_lives = visits as f32 / (FREQUENCY_HALF_LIFE * held.max(1) as f32);
        record.frequency = record.frequency * (-half_lives).exp2() + 1.0;
        record.class = class(Some(age), record.frequency);
    }

    fn age(&self, record: &Record) -> u64 {
        self.time - record.time
    }

    fn forget(&mut self, record: &Record) {
        self.times.forgotten.add(record.class, self.age(record));
    }
}

impl Gittins {
    /// Knows no slot, and nothing of reuse.
    #[allow(clippy::new_without_default)]
    pub fn new() -> Self {
        Self::learning_every(LESSON_VISITS)
    }

    /// With lessons so many visits apart, at least.
    pub(super) fn learning_every(lesson_visits: u64) -> Self {
        Self {
            history: History { times: ReuseTimes::new(), time: 0, visits: 0 },
            residents: Vec::new(),
            slots: Vec::new(),
            ghosts: Ghosts::new(),
            arriving: None,
            lesson_visits,
            next_lesson: lesson_visits,
            rng: Pcg32::seed_from_u64(0),
        }
    }

    fn arrive(&mut self, key: PageKey) {
        let record = match self.ghosts.take(key) {
            Some(mut record) => {
                self.history.seen_again(&mut record, self.slots.len() as u64);
                record
            }
            None => self.history.first_seen(),
        };
        self.arriving = Some((key, record));
    }

    #[cold]
    fn learn(&mut self) {
        let mut waiting = Counts::new();
        let residents = self.slots.iter().map(|&slot| &self.residents[slot as usize].record);
        for record in residents.chain(self.ghosts.memories()) {
            waiting.add(record.class, self.history.age(record));
        }
        self.history.times.fade(FADING);
        self.history.times.learn(&waiting);
        self.next_lesson = self.history.visits + self.lesson_visits.max((self.slots.len() + self.ghosts.len()) as u64);
    }

    fn take(&mut self, slot: u32) -> Resident {
        let resident = self.residents[slot as usize];
        self.residents[slot as usize].place = FREE;
        self.slots.swap_remove(resident.place as usize);
        if let Some(&moved) = self.slots.get(resident.place as usize) {
            self.residents[moved as usize].place = resident.place;
        }
        resident
    }

    /// Of two, the worse comes first; the one used longer ago where they are worth the same.
    fn worth(&self, slot: u32) -> (f64, u64) {
        let record = &self.residents[slot as usize].record;
        (self.history.times.index(record.class, self.history.age(record)), record.visit)
    }

    fn worst_of(&self, slots: impl Iterator<Item = u32>) -> Option<u32> {
        let worths = slots.map(|slot| (self.worth(slot), slot));
        worths.min_by(|((a, used_a), _), ((b, used_b), _)| a.total_cmp(b).then(used_a.cmp(used_b))).map(|(_, slot)| slot)
    }
}

/// Eight kinds of time between the last two uses, three octaves each, the last for pages seen once; times eight of how often.
pub(super) fn class(age: Option<u64>, frequency: f32) -> u8 {
    let interval = age.map_or(7, |age| ((u64::BITS - age.leading_zeros()) / 3).min(6) as u8);
    8 * interval + often(frequency)
}

/// The octave of how often, 0 to 7: a number's exponent. Never below 1, since the last use counts 1.
#[inline]
fn often(frequency: f32) -> u8 {
    (frequency.to_bits() >> 23).saturating_sub(127).min(7) as u8
}

impl Policy for Gittins {
    fn expect(&mut self, key: PageKey, _: u64) {
        self.arrive(key);
    }

    fn insert(&mut self, slot: u32, key: PageKey, _: u64) {
        // Handed over from another policy, or put back, it was not expected, and another may be.
        let other = self.arriving.take_if(|(expected, _)| *expected != key);
        if self.arriving.is_none() {
            self.arrive(key);
        }
        let arrived = self.arriving.take();
        self.arriving = other;
        let Some((_, record)) = arrived else { return };
        let resident = Resident { record, key, place: self.slots.len() as u32 };
        if self.residents.len() <= slot as usize {
            self.residents.resize(slot as usize + 1, Resident { place: FREE, ..resident });
        }
        self.residents[slot as usize] = resident;
        self.slots.push(slot);
    }

    #[inline]
    fn touch(&mut self, slot: u32) {
        self.history.seen_again(&mut self.residents[slot as usize].record, self.slots.len() as u64);
    }

    fn remove(&mut self, slot: u32) {
        let resident = self.take(slot);
        self.history.forget(&resident.record);
    }

    fn evict(&mut self) -> Option<u32> {
        // Not sooner: while nothing leaves there is nothing to decide.
        if self.history.visits >= self.next_lesson {
            self.learn();
        }
        let count = self.slots.len();
        let slot = if count <= CANDIDATES {
            self.worst_of(self.slots.iter().copied())?
        } else {
            let drawn: [u32; CANDIDATES] = std::array::from_fn(|_| self.slots[self.rng.random_range(0..count)]);
            self.worst_of(drawn.into_iter())?
        };
        let resident = self.take(slot);
        self.ghosts.push(resident.key, 1, resident.record);
        // As many as before this one left, lest emptying the cache forget all.
        while let Some(record) = self.ghosts.pop_beyond((GHOSTS * count as u64).max(FEWEST_GHOSTS)) {
            self.history.forget(&record);
        }
        Some(slot)
    }
}
