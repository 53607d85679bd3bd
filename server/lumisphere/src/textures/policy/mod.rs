//! Which resident page leaves when another needs its place. One file a policy, all behind [`Policy`].
//!
//! A policy orders dense slot numbers (places in memory, on the GPU) and remembers pages that left by their [`PageKey`]; it holds no
//! page and counts no bytes but the weights it is told. Weights have the unit of the capacity: bytes for memory, 1 for slots of equal
//! size. Calls for one arriving page: [`expect`](Policy::expect), [`evict`](Policy::evict) until there is room,
//! [`insert`](Policy::insert); a page found is [`touch`](Policy::touch)ed, once for each visit.

mod arc;
mod clock;
mod frame_lru;
mod ghosts;
mod gittins;
mod lru;
mod order;
mod reuse_times;
mod s3_fifo;
#[cfg(test)]
mod tests;

use std::fmt;
use std::str::FromStr;

pub use self::arc::Arc;
pub use self::clock::Clock;
pub use self::frame_lru::FrameLru;
pub use self::gittins::Gittins;
pub use self::lru::Lru;
pub use self::s3_fifo::S3Fifo;

/// Names a page, or a part of one, for as long as the policy lives; by it a policy knows a page that left and returns.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PageKey(pub u64);

/// Decides what to give up. Slots are dense numbers from 0; their owner sees to it that only occupied ones are touched or removed.
pub trait Policy: fmt::Debug + Send {
    /// Most weight that may be resident; the owner evicts what is above it.
    fn set_capacity(&mut self, _capacity: u64) {}
    /// A page is about to arrive: called once, before the evictions that make room for it.
    fn expect(&mut self, _key: PageKey, _weight: u64) {}
    /// `slot`, free until now, holds the page.
    fn insert(&mut self, slot: u32, key: PageKey, weight: u64);
    /// The page in `slot` was used.
    fn touch(&mut self, slot: u32);
    /// `slot` was emptied for a reason of its owner's, which says nothing about the page.
    fn remove(&mut self, slot: u32);
    /// Chooses a slot, takes it out and returns it; None only when no slot is occupied.
    fn evict(&mut self) -> Option<u32>;
    /// A rendered frame begins.
    fn begin_frame(&mut self) {}
}

/// The policies by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum PolicyKind {
    /// [`Lru`].
    Lru,
    /// [`Clock`].
    Clock,
    /// [`Arc`].
    Arc,
    /// [`S3Fifo`].
    S3Fifo,
    /// [`FrameLru`].
    FrameLru,
    /// [`Gittins`].
    Gittins,
}

impl PolicyKind {
    /// Every one.
    pub const ALL: [Self; 6] = [Self::Lru, Self::Clock, Self::Arc, Self::S3Fifo, Self::FrameLru, Self::Gittins];
    /// On rendered frames within 3.1 % of the best of the others at every size measured, and mostly better (docs/measurements.md).
    pub const DEFAULT: Self = Self::Gittins;

    /// As written in configuration.
    pub fn name(self) -> &'static str {
        match self {
            Self::Lru => "lru",
            Self::Clock => "clock",
            Self::Arc => "arc",
            Self::S3Fifo => "s3_fifo",
            Self::FrameLru => "frame_lru",
            Self::Gittins => "gittins",
        }
    }

    /// A fresh one for `capacity` units of weight.
    pub fn make(self, capacity: u64) -> Box<dyn Policy> {
        match self {
            Self::Lru => Box::new(Lru::new()),
            Self::Clock => Box::new(Clock::new()),
            Self::Arc => Box::new(Arc::new(capacity)),
            Self::S3Fifo => Box::new(S3Fifo::new(capacity)),
            Self::FrameLru => Box::new(FrameLru::new()),
            Self::Gittins => Box::new(Gittins::new()),
        }
    }
}

impl fmt::Display for PolicyKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// No policy has this name.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("no policy {0:?}: expected lru, clock, arc, s3_fifo, frame_lru or gittins")]
pub struct UnknownPolicy(pub String);

impl FromStr for PolicyKind {
    type Err = UnknownPolicy;

    fn from_str(name: &str) -> Result<Self, UnknownPolicy> {
        Self::ALL.into_iter().find(|kind| kind.name() == name).ok_or_else(|| UnknownPolicy(name.into()))
    }
}
