//! Radiance, its colours, and how surfaces reflect it.

pub mod brdf;
pub mod color;
mod color_difference;
pub mod dielectric;

pub use color_difference::delta_e_2000;
