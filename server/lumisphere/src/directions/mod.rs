//! Maps between directions and stored texels; which directions to sample; functions of direction.

mod cube_map;
mod differential;
#[cfg(feature = "gpu")]
mod harmonics_wgsl;
mod lat_long;
mod quadrature;
mod sampling;
mod spherical_harmonics;
mod voronoi;

pub use cube_map::{
    CubeMap, FACES, Footprint, Texel, bilinear_footprint, direction_from_face, face_from_direction, texel_direction, texel_solid_angle,
};
pub use differential::{DirectionDifferential, PyramidLevel, Taps};
#[cfg(feature = "gpu")]
pub(crate) use harmonics_wgsl::harmonics_wgsl;
pub use lat_long::{direction_from_lat_long, lat_long_from_direction};
pub use quadrature::hemisphere_quadrature;
pub use sampling::{MOST_DIRECTIONS, Scheme, SchemeError, icosphere, stratified_directions};
pub use spherical_harmonics::{HarmonicBasis, Harmonics, HarmonicsError, MOST_BANDS, MOST_FUNCTIONS};
pub use voronoi::planar_voronoi_areas;
