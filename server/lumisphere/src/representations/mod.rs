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

impl Settings {
    /// Names of component and blend, and the blend's exponent; no blend where nothing is reflected.
    pub fn names(&self) -> (&'static str, Option<&'static str>, Option<f32>) {
        match self {
            Self::OffsetSurfaceLightField(s) if s.component == oslf::Component::Reconstruction => (s.component.name(), None, None),
            Self::OffsetSurfaceLightField(s) => (s.component.name(), Some(s.blend.name()), s.blend.exponent()),
        }
    }

    /// Reflectance of the reflected part, and whether the diffuse part is shown too; None where nothing is reflected.
    pub fn reflection(&self) -> Option<(glam::Vec3, bool)> {
        match self {
            Self::OffsetSurfaceLightField(s) => match s.component {
                oslf::Component::Reconstruction => None,
                oslf::Component::Mirror => Some((s.specular_reflectance, false)),
                oslf::Component::Full => Some((s.specular_reflectance, true)),
            },
        }
    }
}
