//! Environments from files: latitude–longitude as it is, cube maps resampled to latitude–longitude.
//!
//! Two conventions of cube faces are about and look deceptively alike. *OpenGL's*: `directions::direction_from_face`, texel centres
//! at half integers. *OpenEXR's* (`+X (1,−t,s) −X (−1,−t,−s) +Y (s,1,−t) −Y (s,−1,t) +Z (−s,−t,1) −Z (s,−t,−1)`): every face is
//! OpenGL's mirrored, and its outermost texels lie on the cube's edge, so n texels span n − 1 steps. OpenEXR's latitude–longitude maps
//! likewise have whole rows at the poles and the seam's column twice, half a texel off what everybody else writes; both are read.
//! Measured on openexr-images' pairs of one environment in both forms (correlation .9993 with that, .991 without); the tests repeat it.

use glam::{Vec2, Vec3};
use rayon::prelude::*;

use crate::directions::{FACES, direction_from_lat_long, face_from_direction, lat_long_from_direction};
use crate::images::Image;

/// How a picture covers the sphere.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Layout {
    /// Twice as wide as high, texel centres at half integers.
    LatLong,
    /// The same, but the outermost texels' centres lie on the poles and on the seam.
    LatLongOpenExr,
    /// Faces in OpenGL's orientation.
    CubeOpenGl,
    /// Faces in OpenEXR's orientation.
    CubeOpenExr,
}

impl Layout {
    /// Names in the scene file.
    pub const NAMES: &str = "\"lat-long\", \"lat-long-openexr\", \"cube-opengl\" or \"cube-openexr\"";

    /// From its name in the scene file.
    pub fn from_name(name: &str) -> Option<Self> {
        match name {
            "lat-long" => Some(Self::LatLong),
            "lat-long-openexr" => Some(Self::LatLongOpenExr),
            "cube-opengl" => Some(Self::CubeOpenGl),
            "cube-openexr" => Some(Self::CubeOpenExr),
            _ => None,
        }
    }
}

/// A latitude–longitude map from one picture (a cube's six faces stand below one another, +X −X +Y −Y +Z −Z). Errors say what shape was expected.
pub fn from_picture(image: Image, layout: Layout) -> Result<Image, String> {
    let (w, h) = (image.width, image.height);
    match layout {
        Layout::LatLong if w == 2 * h => Ok(image),
        Layout::LatLongOpenExr if w == 2 * h => {
            let last = Vec2::new(w as f32, h as f32) - 1.0;
            Ok(resampled(w, |d| bilinear(&image, lat_long_from_direction(d) * last)))
        }
        Layout::LatLong | Layout::LatLongOpenExr => Err(format!(
            "environment is {w}x{h} pixels, twice as wide as high expected for latitude–longitude (\"layout\" says if it is a cube)"
        )),
        Layout::CubeOpenGl | Layout::CubeOpenExr if h == FACES * w => {
            let face = |f: usize| Image {
                width: w,
                height: w,
                planes: image.planes.iter().map(|p| p[f * w * w..(f + 1) * w * w].to_vec()).collect(),
            };
            let faces: Vec<Image> = (0..FACES).map(face).collect();
            from_faces(&faces, layout)
        }
        Layout::CubeOpenGl | Layout::CubeOpenExr => {
            Err(format!("environment is {w}x{h} pixels, six square faces below one another expected for a cube"))
        }
    }
}

/// A latitude–longitude map (4n × 2n) from six n × n faces, +X −X +Y −Y +Z −Z.
pub fn from_faces(faces: &[Image], layout: Layout) -> Result<Image, String> {
    let n = faces.first().map_or(0, |f| f.width);
    let least = if layout == Layout::CubeOpenExr { 2 } else { 1 };
    if faces.len() != FACES || n < least || faces.iter().any(|f| f.width != n || f.height != n || f.channels() < 3) {
        return Err("environment needs six square faces of one size".into());
    }
    Ok(resampled(4 * n, |d| sample(faces, layout, d)))
}

// A latitude–longitude map of what `radiance` says toward each texel's centre.
fn resampled(width: usize, radiance: impl Fn(Vec3) -> Vec3 + Sync) -> Image {
    let height = width / 2;
    let texel = |index: usize| {
        let centre = Vec2::new((index % width) as f32, (index / width) as f32) + 0.5;
        radiance(direction_from_lat_long(centre / Vec2::new(width as f32, height as f32)))
    };
    let texels: Vec<Vec3> = (0..width * height).into_par_iter().map(texel).collect();
    Image { width, height, planes: (0..3).map(|channel| texels.iter().map(|t| t[channel]).collect()).collect() }
}

// Bilinear on the face the direction pierces. At n texels an edge the seam error is half a texel of one face, which the resampling hides.
fn sample(faces: &[Image], layout: Layout, d: Vec3) -> Vec3 {
    let (face, st) = face_from_direction(d);
    let n = faces[face].width as f32;
    let at = match layout {
        // OpenEXR's faces are OpenGL's seen in a mirror: left and right for the sides, top and bottom for the lids.
        Layout::CubeOpenExr => {
            let mirrored = if face == 2 || face == 3 { Vec2::new(st.x, -st.y) } else { Vec2::new(-st.x, st.y) };
            (0.5 * (mirrored + 1.0)) * (n - 1.0)
        }
        Layout::CubeOpenGl | Layout::LatLong | Layout::LatLongOpenExr => 0.5 * (st + 1.0) * n - 0.5,
    };
    bilinear(&faces[face], at)
}

// At a position in texels, centres at integers; beyond the rim the rim.
fn bilinear(image: &Image, at: Vec2) -> Vec3 {
    let last = Vec2::new(image.width as f32, image.height as f32) - 1.0;
    let at = at.clamp(Vec2::ZERO, last);
    let base = at.floor();
    let (f, next) = (at - base, (base + 1.0).min(last));
    let texel = |x: f32, y: f32| Vec3::from(image.rgb(y as usize * image.width + x as usize));
    texel(base.x, base.y).lerp(texel(next.x, base.y), f.x).lerp(texel(base.x, next.y).lerp(texel(next.x, next.y), f.x), f.y)
}

/// What `make_radiance` had to change.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Mended {
    pub negative: usize,
    pub infinite: usize,
}

/// Three planes of radiance times `scale`: negative values (ringing of a resampled photograph) become 0, infinite ones (half floats
/// at the sun) the largest half float.
pub(super) fn make_radiance(mut image: Image, scale: f32) -> (Image, Mended) {
    const LARGEST_HALF: f32 = 65504.0;
    let mut mended = Mended { negative: 0, infinite: 0 };
    image.planes.truncate(3);
    for value in image.planes.iter_mut().flatten() {
        if *value < 0.0 {
            mended.negative += 1;
            *value = 0.0;
        } else if value.is_infinite() {
            mended.infinite += 1;
            *value = LARGEST_HALF;
        }
        *value *= scale;
    }
    (image, mended)
}

#[cfg(test)]
mod tests {
    use std::f32::consts::FRAC_PI_2;

    use super::*;
    use crate::images::{ReadLimits, decode_image};
    use crate::scenes::EnvironmentMap;

    const AXES: [Vec3; 6] = [Vec3::X, Vec3::NEG_X, Vec3::Y, Vec3::NEG_Y, Vec3::Z, Vec3::NEG_Z];

    // Colour of a direction: distinct for the six axes, smooth in between, so that mirrored and turned faces differ.
    fn colour(d: Vec3) -> Vec3 {
        0.5 + 0.5 * d + 0.25 * Vec3::new(d.y * d.z, d.z * d.x, d.x * d.y)
    }

    // The six faces painted by the formulas as they are published for each convention.
    fn painted(layout: Layout, n: usize) -> Vec<Image> {
        let paint = |face: usize| {
            let mut image = Image::zeros(n, n, 3);
            for row in 0..n {
                for column in 0..n {
                    let at = |i: usize| match layout {
                        Layout::CubeOpenExr => 2.0 * i as f32 / (n - 1) as f32 - 1.0,
                        _ => 2.0 * (i as f32 + 0.5) / n as f32 - 1.0,
                    };
                    let (s, t) = (at(column), at(row));
                    let open_gl = [[1.0, -t, -s], [-1.0, -t, s], [s, 1.0, t], [s, -1.0, -t], [s, -t, 1.0], [-s, -t, -1.0]];
                    let open_exr = [[1.0, -t, s], [-1.0, -t, -s], [s, 1.0, -t], [s, -1.0, t], [-s, -t, 1.0], [s, -t, -1.0]];
                    let d = if layout == Layout::CubeOpenExr { open_exr[face] } else { open_gl[face] };
                    image.set_rgb(row * n + column, colour(Vec3::from(d).normalize()).into());
                }
            }
            image
        };
        (0..FACES).map(paint).collect()
    }

    fn as_map(image: Image) -> EnvironmentMap {
        EnvironmentMap { image, rotation: 0.0 }
    }

    #[test]
    fn both_kinds_of_cube_show_every_direction_its_own_colour() {
        for layout in [Layout::CubeOpenGl, Layout::CubeOpenExr] {
            let faces = painted(layout, 32);
            let map = as_map(from_faces(&faces, layout).unwrap());
            for i in 0..300u32 {
                let u = |k: u32| ((i * 7919 + k * 104729) % 1000) as f32 / 500.0 - 1.0;
                let d = Vec3::new(u(1), u(2), u(3)).normalize_or(Vec3::X);
                // Steps of 1/32 in a function of slope about 1: bilinear twice, at face edges constant over half a texel.
                assert!((map.radiance(d) - colour(d)).length() < 0.06, "{layout:?} {d}");
            }
            for axis in AXES {
                assert!((map.radiance(axis) - colour(axis)).length() < 0.03, "{layout:?} {axis}");
            }
            // The same faces in one column.
            let column = Image {
                width: 32,
                height: 192,
                planes: (0..3).map(|c| faces.iter().flat_map(|f| f.planes[c].clone()).collect()).collect(),
            };
            assert_eq!(from_picture(column, layout).unwrap(), map.image);
        }
    }

    #[test]
    fn one_convention_read_as_the_other_shows_wrong_colours() {
        let map = as_map(from_faces(&painted(Layout::CubeOpenExr, 32), Layout::CubeOpenGl).unwrap());
        let d = Vec3::new(1.0, 0.3, 0.7).normalize();
        assert!((map.radiance(d) - colour(d)).length() > 0.3);
    }

    #[test]
    fn pictures_of_the_wrong_shape_are_refused_with_what_was_expected() {
        let wrong = |w, h, layout| from_picture(Image::zeros(w, h, 3), layout).unwrap_err();
        assert!(wrong(30, 10, Layout::LatLong).contains("twice as wide as high"));
        assert!(wrong(10, 59, Layout::CubeOpenGl).contains("six square faces"));
        assert!(from_faces(&vec![Image::zeros(4, 4, 3); 5], Layout::CubeOpenGl).is_err());
        assert!(from_faces(&vec![Image::zeros(1, 1, 3); 6], Layout::CubeOpenExr).is_err());
    }

    // Correlation of two maps' brightness over directions spread evenly, in f64: a sun is a thousand times its sky.
    fn correlation(a: &EnvironmentMap, b: &EnvironmentMap) -> f64 {
        const COUNT: usize = 20_000;
        let golden = std::f32::consts::PI * (3.0 - 5f32.sqrt());
        let values: Vec<(f64, f64)> = (0..COUNT)
            .map(|i| {
                let y = 1.0 - 2.0 * (i as f32 + 0.5) / COUNT as f32;
                let (sin, cos) = (golden * i as f32).sin_cos();
                let d = Vec3::new((1.0 - y * y).sqrt() * cos, y, (1.0 - y * y).sqrt() * sin);
                // Mean over a texel and its neighbours: both maps were resampled once, and lines are one texel wide.
                let around = |k: usize| Vec2::new((k % 3) as f32 - 1.0, (k / 3) as f32 - 1.0) * Vec2::new(1.0 / 1024.0, 1.0 / 512.0);
                let at = lat_long_from_direction(d);
                let near = |k: usize| direction_from_lat_long(at + around(k));
                let brightness = |m: &EnvironmentMap| (0..9).map(|k| m.radiance(near(k)).dot(Vec3::ONE)).sum::<f32>();
                (brightness(a) as f64, brightness(b) as f64)
            })
            .collect();
        let mean = |f: fn(&(f64, f64)) -> f64| values.iter().map(f).sum::<f64>() / COUNT as f64;
        let (ma, mb) = (mean(|v| v.0), mean(|v| v.1));
        let sum = |f: &dyn Fn(f64, f64) -> f64| values.iter().map(|(x, y)| f(x - ma, y - mb)).sum::<f64>();
        sum(&|x, y| x * y) / (sum(&|x, _| x * x) * sum(&|_, y| y * y)).sqrt()
    }

    #[test]
    fn openexrs_own_cubes_match_their_latitude_longitude_twins() {
        for name in ["KernerEnv", "Orientation", "WavyLines"] {
            let read = |form: &str| {
                let path = crate::testdata::shared(&format!("env/pairs/{name}{form}.exr"))?;
                Some(decode_image(&std::fs::read(path).unwrap(), ReadLimits::SCENE).unwrap())
            };
            let (Some(cube), Some(lat_long)) = (read("Cube"), read("LatLong")) else { return };
            let twin = as_map(from_picture(lat_long, Layout::LatLongOpenExr).unwrap());
            let right = correlation(&as_map(from_picture(cube.clone(), Layout::CubeOpenExr).unwrap()), &twin);
            let wrong = correlation(&as_map(from_picture(cube, Layout::CubeOpenGl).unwrap()), &twin);
            assert!(right >= 0.98, "{name}: {right}");
            assert!(wrong < 0.93, "{name} read as OpenGL's: {wrong}");
        }
    }

    #[test]
    fn rotation_turns_the_lit_side_about_y_like_any_object() {
        // One bright texel toward −Z (the left edge's neighbours).
        let mut image = Image::zeros(64, 32, 3);
        for row in 14..18 {
            for column in [0, 63] {
                image.set_rgb(row * 64 + column, [1.0; 3]);
            }
        }
        assert!(as_map(image.clone()).radiance(Vec3::NEG_Z).x > 0.9);
        // A quarter turn about +Y carries −Z to −X.
        let turned = EnvironmentMap { image, rotation: FRAC_PI_2 };
        assert!(turned.radiance(Vec3::NEG_X).x > 0.9);
        assert!(turned.radiance(Vec3::X).x < 0.1 && turned.radiance(Vec3::NEG_Z).x < 0.1);
    }

    #[test]
    fn radiance_is_never_negative_nor_infinite() {
        let mut image = Image::zeros(2, 1, 4);
        image.planes[0] = vec![-1.0, f32::INFINITY];
        let (image, mended) = make_radiance(image, 2.0);
        assert_eq!((image.planes[0].clone(), image.channels()), (vec![0.0, 131_008.0], 3));
        assert_eq!(mended, Mended { negative: 1, infinite: 1 });
    }
}
