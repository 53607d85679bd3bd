//! Maps between directions and stored texels.

mod cube_map;
mod differential;
mod lat_long;

pub use cube_map::{
    CubeMap, FACES, Footprint, Texel, bilinear_footprint, direction_from_face, face_from_direction, texel_direction, texel_solid_angle,
};
pub use differential::{DirectionDifferential, PyramidLevel, Taps};
pub use lat_long::{direction_from_lat_long, lat_long_from_direction};
