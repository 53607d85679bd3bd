//! Ways of holding a light field, side by side: one folder each, none imports another.
//!
//! Adding one: a value in `Kind` and in the proto, a folder, an arm in `open` and in the service's `wire.rs`.

pub mod offset_surface_light_field;

use offset_surface_light_field as oslf;

/// Which representation a dataset holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Kind {
    /// Cube maps at sample points just above a surface.
    OffsetSurfaceLightField,
}

impl Kind {
    /// The name in manifests and on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::OffsetSurfaceLightField => "offset_surface_light_field",
        }
    }

    /// The kind of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        [Self::OffsetSurfaceLightField].into_iter().find(|k| k.name() == name)
    }
}

/// How to render, by kind.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Settings {
    /// Component, blend and specular reflectance.
    OffsetSurfaceLightField(oslf::Settings),
}
