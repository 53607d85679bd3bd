//! Radiance and its colours.
