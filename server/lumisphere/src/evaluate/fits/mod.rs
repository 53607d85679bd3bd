//! The parameter-map thesis' tests of its models, repeated, with its methods beside ours: chapters 11 to 13 on its plane, whose radiance is
//! known in every direction (`plane_tests`), chapter 16 on photographs of a surface (`photographs`).
//!
//! Source: Mortensen and Andersen 2007; the methods page "Parameter maps" lists the tests and their figures.

mod methods;
mod photographs;
mod plane;
mod plane_tests;
#[cfg(test)]
mod tests;

pub use methods::{Method, MethodError};
pub use photographs::{
    PhotographError, PhotographRow, PhotographedSurface, SurfaceTest, View, photographed, surface_methods, surface_tests,
};
pub use plane_tests::{Drift, PlaneRow, PlaneTest, Slice, plane_test, plane_tests};
