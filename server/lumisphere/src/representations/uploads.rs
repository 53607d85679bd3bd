//! What was uploaded beside a dataset: settings name it by its hash, a request brings it.

use std::sync::Arc;

use crate::geometry::NormalMap;
use crate::radiometry::brdf::Measured;

/// What the settings of a frame name.
#[derive(Debug, Clone, Copy)]
pub struct Uploads<'a> {
    /// Of the settings' BRDF, where that is a measured one.
    pub table: Option<&'a Arc<Measured>>,
    /// Of the settings' bumps.
    pub normal_map: Option<&'a Arc<NormalMap>>,
}

impl Uploads<'static> {
    /// For settings that name nothing.
    pub const NONE: Self = Self { table: None, normal_map: None };
}
