//! Radiance and its colours.

pub mod color;
mod color_difference;

pub use color_difference::delta_e_2000;
