//! Which resident page leaves when another needs its place. One file a policy; all work on dense slot numbers, none on pages.

mod lru;

pub(super) use lru::Lru;
