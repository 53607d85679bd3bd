//! What frames are shown with beside their dataset: measured BRDFs and normal maps, uploaded and named by settings.

use std::sync::Arc;

use lumisphere::geometry::NormalMap;
use lumisphere::radiometry::brdf::Measured;
use lumisphere::representations::{Settings, Uploads};
use lumisphere::textures::Store;

use crate::errors::ApiError;
use crate::normal_maps::NormalMaps;
use crate::tables::Tables;

/// Over the store.
pub struct Looks {
    /// Measured BRDFs.
    pub tables: Tables,
    /// Normal maps.
    pub normal_maps: NormalMaps,
}

/// What some settings name, held while a frame is drawn.
pub struct HeldLooks {
    table: Option<Arc<Measured>>,
    normal_map: Option<Arc<NormalMap>>,
}

impl Looks {
    /// Nothing read yet.
    pub fn new(store: &Store) -> Self {
        Self { tables: Tables::new(store.clone()), normal_maps: NormalMaps::new(store.clone()) }
    }

    /// Refuses settings that name what is not here, or what it cannot be by its size. Reads nothing.
    pub fn check(&self, settings: &Settings) -> Result<(), ApiError> {
        self.tables.check(settings)?;
        self.normal_maps.check(settings)
    }

    /// What these settings name. Blocks.
    pub fn of(&self, settings: &Settings) -> Result<HeldLooks, ApiError> {
        Ok(HeldLooks { table: self.tables.of(settings)?, normal_map: self.normal_maps.of(settings)? })
    }
}

impl HeldLooks {
    /// Nothing.
    pub const NONE: Self = Self { table: None, normal_map: None };

    /// As a request takes it.
    pub fn uploads(&self) -> Uploads<'_> {
        Uploads { table: self.table.as_ref(), normal_map: self.normal_map.as_ref() }
    }
}
