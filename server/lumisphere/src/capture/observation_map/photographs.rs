//! Photographs of a flat surface, or of a scene's object with texture coordinates, resampled into an observation map.
//!
//! A flat surface is a rectangle in z = 0 with its centre at the origin, x right, y up; u grows with x, v with y. A texel's entry is read from a
//! photograph bilinearly where the texel's centre is imaged; it is missing outside the picture, behind the camera, and where any of the four
//! pixels is; it is clipped in the channels in which any of them is. An object is seen by calibrated cameras alone, in its scene's space; what turns
//! away from a camera, or lies behind something in the scene, is missing.
//!
//! Texels are resampled in bands that fit into memory, each from all photographs in turn, so memory does not grow with the map.

use std::ops::RangeInclusive;

use glam::{Vec2, Vec3};
use rayon::prelude::*;
use thiserror::Error;

use super::virtual_photographs::{Visibility, names, sphere_around, texels_of};
use super::{
    MOST_OBSERVATIONS, MOST_TEXELS, MOST_TEXELS_PER_EDGE, Observation, ObservationMap, ObservationParameters, ObservedTexel, Observer,
    State, TEXELS_PER_PAGE, to_parts,
};
use crate::capture::{
    Background, ExposureStack, MergeError, Merged, PartsError, ResponseCurve, SurfaceMesh, Validity, merge, merge_linear,
};
use crate::formats::photograph_list::PhotographView;
use crate::geometry::TriangleMesh;
use crate::images::{Format, Image, ImageError, ReadLimits, decode_image, decode_image_codes};
use crate::progress::{Cancelled, Progress};
use crate::raytrace::TraceError;
use crate::scenes::{Environment, Scene};
use crate::textures::{Codec, EncodedPage, PageId, PixelFormat, Staging, StoreError, encode_as};

/// A photograph as radiance.
#[derive(Debug, Clone)]
pub struct RadiancePhotograph {
    /// Three planes, linear, up to one factor for all photographs.
    pub radiance: Image,
    /// Of each pixel, row by row.
    pub states: Vec<State>,
}

/// How an 8-bit code becomes radiance.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Response {
    /// As sRGB decodes.
    Srgb,
    /// Proportional to it.
    Linear,
}

impl RadiancePhotograph {
    /// Whether an image's file is scene-linear.
    pub fn is_linear(bytes: &[u8]) -> Result<bool, ImageError> {
        Ok(matches!(Format::of(bytes)?, Format::Exr | Format::Hdr))
    }

    /// From an image's file. Of PNG, JPEG and TIFF a channel of 255 is clipped; EXR and Radiance HDR are radiance, clipped from `saturation` on, and
    /// `response` means nothing to them.
    pub fn decode(bytes: &[u8], response: Response, saturation: Option<f32>) -> Result<Self, ImageError> {
        if Self::is_linear(bytes)? {
            let radiance = decode_image(bytes, ReadLimits::SCENE)?;
            let is_clipped = |value: f32| u8::from(saturation.is_some_and(|least| value >= least));
            let clipped = |[r, g, b]: [f32; 3]| is_clipped(r) | is_clipped(g) << 1 | is_clipped(b) << 2;
            let states = (0..radiance.width * radiance.height).map(|at| State::Seen { clipped: clipped(radiance.rgb(at)) }).collect();
            return Ok(Self { radiance, states });
        }
        let codes = decode_image_codes(bytes, ReadLimits::SCENE)?;
        let pixels = (0..codes.width * codes.height).map(|at| codes.pixel(at % codes.width, at / codes.width));
        let states = pixels
            .clone()
            .map(|[r, g, b]| State::Seen { clipped: u8::from(r == u8::MAX) | u8::from(g == u8::MAX) << 1 | u8::from(b == u8::MAX) << 2 });
        let states = states.collect();
        let radiance = match response {
            Response::Srgb => codes.to_linear(),
            Response::Linear => {
                let mut radiance = Image::zeros(codes.width, codes.height, 3);
                pixels.enumerate().for_each(|(at, rgb)| radiance.set_rgb(at, rgb.map(|code| f32::from(code) / 255.0)));
                radiance
            }
        };
        Ok(Self { radiance, states })
    }

    /// As if it had been exposed by 1 instead of `exposure`, which is above 0: radiance as of merged photographs.
    pub fn exposed_by_one(mut self, exposure: f64) -> Self {
        self.radiance.planes.iter_mut().flatten().for_each(|value| *value = (f64::from(*value) / exposure) as f32);
        self
    }

    /// From several exposures of one view, by the camera's response. What no exposure shows is missing.
    pub fn merged(stack: &ExposureStack, curve: &ResponseCurve) -> Result<Self, MergeError> {
        Ok(Self::of(merge(stack, curve)?))
    }

    /// From several scene-linear exposures of one view, clipped from `saturation` on. Radiance is that of exposure 1. What is clipped in
    /// all is missing; what is black is not.
    pub fn merged_linear(photographs: &[Image], exposures: &[f64], saturation: Option<f32>) -> Result<Self, MergeError> {
        Ok(Self::of(merge_linear(photographs, exposures, f32::NEG_INFINITY, saturation.unwrap_or(f32::INFINITY))?))
    }

    fn of(merged: Merged) -> Self {
        let state = |validity: &Validity| match validity {
            Validity::Measured => State::Seen { clipped: 0 },
            Validity::Clipped | Validity::Dark | Validity::Between => State::Missing,
        };
        Self { states: merged.validity.iter().map(state).collect(), radiance: merged.radiance }
    }
}

/// What photographs show.
#[derive(Debug, Clone, Copy)]
pub enum Photographed<'a> {
    /// A rectangle in z = 0, so long along x and y.
    Rectangle([f32; 2]),
    /// An object, by calibrated cameras.
    Object {
        /// What it stands in: all of it hides.
        scene: &'a Scene,
        /// Its name.
        object: &'a str,
    },
}

/// What to make of photographs.
#[derive(Debug, Clone, PartialEq)]
pub struct ImportSettings {
    /// Texels along an edge.
    pub size_texels: u32,
    /// Name of the list, for people.
    pub list: String,
    /// How pages hold numbers.
    pub pixel_format: PixelFormat,
    /// How pages are packed.
    pub codec: Codec,
}

/// Why nothing came of it.
#[derive(Debug, Error)]
pub enum ImportError {
    /// A setting out of range.
    #[error("{setting} is {value}, {expected} expected")]
    Setting {
        /// Which.
        setting: &'static str,
        /// As given.
        value: String,
        /// What would do.
        expected: String,
    },
    /// A photograph has another size than its list or the others say.
    #[error("photograph {file} has {}x{} pixels, {}x{} expected", found[0], found[1], expected[0], expected[1])]
    Size {
        /// Which.
        file: String,
        /// Its width and height.
        found: [usize; 2],
        /// As its camera or the first photograph has them.
        expected: [usize; 2],
    },
    /// A photograph cannot be read.
    #[error("photograph {file}: {reason}")]
    Photograph {
        /// Which.
        file: String,
        /// Why.
        reason: String,
    },
    /// A camera stands behind the surface.
    #[error("the camera of photograph {file} is at {position}, in front of the surface (z above 0) expected")]
    Behind {
        /// Which.
        file: String,
        /// Where.
        position: Vec3,
    },
    /// The scene has no object of that name.
    #[error("scene has no object {object:?}; it has {}", known.join(", "))]
    UnknownObject {
        /// As given.
        object: String,
        /// What there is.
        known: Vec<String>,
    },
    /// The object's texture coordinates cover no texel's centre.
    #[error("object {object:?} covers no texel of {size}x{size}: texture coordinates within [0, 1] expected, or more texels")]
    NoTexels {
        /// Which.
        object: String,
        /// Texels along an edge.
        size: u32,
    },
    /// A photograph of an object does not say which camera took it.
    #[error("photograph {file} of an object has no calibrated camera: transforms.json or COLMAP's images.txt expected")]
    NoCamera {
        /// Which.
        file: String,
    },
    /// What hides cannot be found in the scene.
    #[error(transparent)]
    Trace(#[from] TraceError),
    /// Asked to stop; can be resumed.
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
    /// The store refused.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A part cannot be encoded.
    #[error(transparent)]
    Parts(#[from] PartsError),
}

// Of the rectangle: the square of an area neither vanishes nor overflows.
const LENGTHS: RangeInclusive<f32> = 1e-9..=1e9;
// Entries of a band in memory: 2²⁴ of 16 bytes.
const BAND_ENTRIES: usize = 1 << 24;

/// Fills `staging` with pages and parts of an observation map; the caller publishes. `load(k)` gives photograph k of `views`, again for every
/// band. Can be called again on a staging area that an earlier, identical call left unfinished.
pub fn import(
    photographed: Photographed<'_>,
    views: &[(String, PhotographView)],
    load: &(dyn Fn(usize) -> Result<RadiancePhotograph, ImportError> + Sync),
    settings: &ImportSettings,
    staging: &Staging,
    progress: &dyn Progress,
) -> Result<ObservationParameters, ImportError> {
    check(photographed, views, settings)?;
    let map = map_of(photographed, views, settings)?;
    let scenery = Scenery::new(photographed)?;
    let shape = map.page_shape(settings.pixel_format);
    let present = staging.pages_present();
    let per_page = TEXELS_PER_PAGE * views.len();
    let missing: Vec<usize> = (0..map.page_count()).filter(|k| !present.contains(&PageId(*k as u32))).collect();
    let bands: Vec<&[usize]> = missing.chunks((BAND_ENTRIES / per_page).max(1)).collect();
    let total = (bands.len() * views.len()) as u64;
    let mut first_size: Option<[usize; 2]> = None;
    for (b, band) in bands.iter().enumerate() {
        let mut pages = vec![vec![Observation::MISSING.to_texel(); per_page]; band.len()];
        for (row, (file, view)) in views.iter().enumerate() {
            progress.report("resampling photographs", (b * views.len() + row) as u64, total);
            if progress.is_cancelled() {
                return Err(Cancelled.into());
            }
            let photograph = load(row)?;
            check_size(file, view, &photograph, &mut first_size)?;
            let pixels = Pixels { photograph: &photograph, view, scenery: &scenery };
            pages.par_iter_mut().zip(*band).for_each(|(entries, page)| {
                for (column, texel) in map.texels_of_page(*page).iter().enumerate() {
                    entries[row * TEXELS_PER_PAGE + column] = pixels.observe(texel).to_texel();
                }
            });
        }
        let encoded = pages.par_iter().map(|entries| encode_as(settings.codec, &shape, entries.as_flattened()));
        let encoded: Vec<EncodedPage> = encoded.collect::<Result<_, _>>()?;
        for (page, encoded) in band.iter().zip(&encoded) {
            staging.append_encoded(PageId(*page as u32), encoded)?;
        }
    }
    progress.report("resampling photographs", total, total);
    for (name, bytes) in to_parts(&map)? {
        staging.put_blob(name, &bytes)?;
    }
    Ok(map.parameters)
}

// The rectangle of that width and height, both of LENGTHS.
fn rectangle([width, height]: [f32; 2]) -> SurfaceMesh {
    let corners = [Vec2::ZERO, Vec2::X, Vec2::ONE, Vec2::Y];
    let positions = corners.map(|c| ((c - 0.5) * Vec2::new(width, height)).extend(0.0)).to_vec();
    let mesh = TriangleMesh::new(positions, vec![Vec3::Z; 4], corners.to_vec(), vec![[0, 1, 2], [0, 2, 3]])
        .expect("such lengths have an area in f32");
    SurfaceMesh { mesh, part_of_triangle: vec![0, 0], parts: 1 }
}

fn check(photographed: Photographed<'_>, views: &[(String, PhotographView)], settings: &ImportSettings) -> Result<(), ImportError> {
    let refuse = |setting, value: String, expected: String| Err(ImportError::Setting { setting, value, expected });
    if !(1..=MOST_TEXELS_PER_EDGE).contains(&settings.size_texels) {
        return refuse("texels along an edge", settings.size_texels.to_string(), format!("1 to {MOST_TEXELS_PER_EDGE}"));
    }
    if !(1..=MOST_OBSERVATIONS as usize).contains(&views.len()) {
        return refuse("number of photographs", views.len().to_string(), format!("1 to {MOST_OBSERVATIONS}"));
    }
    let size = match photographed {
        Photographed::Rectangle(size) => size,
        Photographed::Object { .. } => {
            let other = views.iter().find(|(_, view)| !matches!(view, PhotographView::Calibrated(_)));
            return other.map_or(Ok(()), |(file, _)| Err(ImportError::NoCamera { file: file.clone() }));
        }
    };
    for (setting, length) in ["width", "height"].into_iter().zip(size) {
        if !LENGTHS.contains(&length) {
            return refuse(setting, length.to_string(), format!("a length from {:e} to {:e}", LENGTHS.start(), LENGTHS.end()));
        }
    }
    for (file, view) in views {
        if let PhotographView::Calibrated(camera) = view
            && !(camera.camera.pose().position().z > 0.0)
        {
            return Err(ImportError::Behind { file: file.clone(), position: camera.camera.pose().position() });
        }
    }
    Ok(())
}

fn check_size(
    file: &str,
    view: &PhotographView,
    photograph: &RadiancePhotograph,
    first: &mut Option<[usize; 2]>,
) -> Result<(), ImportError> {
    let found = [photograph.radiance.width, photograph.radiance.height];
    let expected = match view {
        PhotographView::Calibrated(camera) => {
            let intrinsics = camera.camera.intrinsics();
            [intrinsics.width_px as usize, intrinsics.height_px as usize]
        }
        // Pictures of one fixed camera are of one size; rectified ones should be.
        PhotographView::Rectified { .. } | PhotographView::Lit { .. } => *first.get_or_insert(found),
    };
    if found == expected { Ok(()) } else { Err(ImportError::Size { file: file.into(), found, expected }) }
}

fn map_of(
    photographed: Photographed<'_>,
    views: &[(String, PhotographView)],
    settings: &ImportSettings,
) -> Result<ObservationMap, ImportError> {
    let (surface, name) = match photographed {
        Photographed::Rectangle(size) => (rectangle(size), "photographed surface"),
        Photographed::Object { scene, object } => (SurfaceMesh::of(&scene.objects[found(scene, object)?]), object),
    };
    let all = u64::from(surface.parts) * u64::from(settings.size_texels).pow(2);
    if all > MOST_TEXELS {
        let (value, expected) = (settings.size_texels.to_string(), format!("at most {MOST_TEXELS} in its {} parts", surface.parts));
        return Err(ImportError::Setting { setting: "texels along an edge", value, expected });
    }
    let texels: Vec<ObservedTexel> = texels_of(&surface, settings.size_texels as usize).into_iter().map(|(observed, _)| observed).collect();
    if texels.is_empty() {
        return Err(ImportError::NoTexels { object: name.into(), size: settings.size_texels });
    }
    let observer = |(_, view): &(String, PhotographView)| match view {
        PhotographView::Rectified { from } => Observer::At(*from),
        PhotographView::Lit { toward } => Observer::Toward(*toward),
        PhotographView::Calibrated(camera) => Observer::At(camera.camera.pose().position()),
    };
    Ok(ObservationMap {
        parameters: ObservationParameters {
            object: name.into(),
            size_texels: settings.size_texels,
            directions: settings.list.clone(),
            samples_per_observation: 0,
            max_bounces: 0,
            seed: 0,
        },
        background: Background { surfaces: vec![], textures: vec![], environment: Environment::Constant(Vec3::ZERO) },
        observers: views.iter().map(observer).collect(),
        texels,
        surface,
    })
}

fn found(scene: &Scene, object: &str) -> Result<usize, ImportError> {
    scene.object(object).ok_or_else(|| ImportError::UnknownObject { object: object.into(), known: names(scene) })
}

/// What stands between texels and cameras.
enum Scenery {
    /// Nothing; the rectangle has this size.
    Rectangle([f32; 2]),
    Scene(Visibility),
}

impl Scenery {
    fn new(photographed: Photographed<'_>) -> Result<Self, ImportError> {
        Ok(match photographed {
            Photographed::Rectangle(size) => Self::Rectangle(size),
            Photographed::Object { scene, object } => {
                let (_, radius) = sphere_around(&scene.objects[found(scene, object)?]);
                Self::Scene(Visibility::new(scene, radius)?)
            }
        })
    }
}

/// A photograph that is read.
struct Pixels<'a> {
    photograph: &'a RadiancePhotograph,
    view: &'a PhotographView,
    scenery: &'a Scenery,
}

impl Pixels<'_> {
    fn observe(&self, texel: &ObservedTexel) -> Observation {
        match self.image_of(texel) {
            Some(at) => self.bilinear(at),
            None => Observation::MISSING,
        }
    }

    // Where a texel's centre is imaged: pixels, centres at half integers, y down.
    fn image_of(&self, texel: &ObservedTexel) -> Option<Vec2> {
        let point = texel.position;
        match (self.view, self.scenery) {
            (PhotographView::Calibrated(camera), Scenery::Rectangle(_)) => camera.project(point),
            (PhotographView::Calibrated(camera), Scenery::Scene(visibility)) => {
                visibility.is_seen(texel, camera.camera.pose().position()).then(|| camera.project(point))?
            }
            // Of an object there are none.
            (PhotographView::Rectified { .. } | PhotographView::Lit { .. }, Scenery::Scene(_)) => None,
            (PhotographView::Rectified { .. } | PhotographView::Lit { .. }, Scenery::Rectangle(size)) => {
                let uv = point.truncate() / Vec2::from(*size) + 0.5;
                let pixels = Vec2::new(self.photograph.radiance.width as f32, self.photograph.radiance.height as f32);
                Some(Vec2::new(uv.x, 1.0 - uv.y) * pixels)
            }
        }
    }

    // None of a pixel's half beyond the edge is read: there the nearest pixel alone is there.
    fn bilinear(&self, at: Vec2) -> Observation {
        let image = &self.photograph.radiance;
        let size = Vec2::new(image.width as f32, image.height as f32);
        if !(at.min_element() >= 0.0 && at.x <= size.x && at.y <= size.y) {
            return Observation::MISSING;
        }
        let corner = (at - 0.5).clamp(Vec2::ZERO, size - 1.0);
        let low = corner.floor();
        let fraction = corner - low;
        let (mut radiance, mut clipped) = (Vec3::ZERO, 0);
        for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
            let weight = if dx == 1 { fraction.x } else { 1.0 - fraction.x } * if dy == 1 { fraction.y } else { 1.0 - fraction.y };
            if weight == 0.0 {
                continue;
            }
            let index = (low.y as usize + dy) * image.width + low.x as usize + dx;
            match self.photograph.states[index] {
                State::Missing => return Observation::MISSING,
                State::Seen { clipped: channels } => clipped |= channels,
            }
            radiance += weight * Vec3::from(image.rgb(index));
        }
        Observation { radiance: radiance.to_array(), state: State::Seen { clipped } }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;
    use crate::capture::observation_map::tests::published;
    use crate::geometry::{Camera, Distortion, Intrinsics, PhotographCamera, Pose};
    use crate::progress::Unattended;
    use crate::textures::{Store, StoreOptions};

    /// A picture whose red is x and whose green is y, both over the picture's size, and whose blue is `blue`.
    fn ramp(width: usize, height: usize, blue: f32) -> RadiancePhotograph {
        let mut radiance = Image::zeros(width, height, 3);
        for (i, j) in (0..width * height).map(|at| (at % width, at / width)) {
            radiance.set_rgb(j * width + i, [(i as f32 + 0.5) / width as f32, (j as f32 + 0.5) / height as f32, blue]);
        }
        RadiancePhotograph { radiance, states: vec![State::Seen { clipped: 0 }; width * height] }
    }

    fn settings() -> ImportSettings {
        let (pixel_format, codec) = (PixelFormat::F32, Codec::ZstdChunk);
        ImportSettings { size_texels: 10, list: "list.json".into(), pixel_format, codec }
    }

    // [photograph][row · 10 + column]
    fn imported(views: &[(String, PhotographView)], pictures: &[RadiancePhotograph]) -> Result<Vec<Vec<Observation>>, ImportError> {
        let folder = tempfile::tempdir().unwrap();
        let (store, _) = Store::open(folder.path(), StoreOptions::local()).unwrap();
        store.create_dataset("seen").unwrap();
        let staging = store.stage("seen", "token").unwrap();
        let parameters =
            import(Photographed::Rectangle([2.0, 1.0]), views, &|k| Ok(pictures[k].clone()), &settings(), &staging, &Unattended)?;
        let (map, version) = published(parameters, staging);
        let mut seen = vec![vec![Observation::MISSING; 100]; views.len()];
        for page in 0..map.page_count() {
            let pixels = version.read_page(PageId(page as u32)).unwrap();
            for (column, texel) in map.texels_of_page(page).iter().enumerate() {
                for (row, seen) in seen.iter_mut().enumerate() {
                    seen[texel.index as usize] = Observation::from_texel(pixels.texel(column as u32, row as u32));
                }
            }
        }
        Ok(seen)
    }

    fn rectified(z: f32) -> (String, PhotographView) {
        (format!("{z}.png"), PhotographView::Rectified { from: Vec3::new(0.0, 0.0, z) })
    }

    #[test]
    fn a_rectified_picture_is_the_rectangle_with_its_first_row_at_the_top() {
        let seen = imported(&[rectified(3.0), rectified(4.0)], &[ramp(40, 20, 0.25), ramp(40, 20, 0.75)]).unwrap();
        for (blue, seen) in [0.25, 0.75].into_iter().zip(&seen) {
            for (at, entry) in seen.iter().enumerate() {
                let (u, v) = ((at % 10) as f32 / 10.0 + 0.05, (at / 10) as f32 / 10.0 + 0.05);
                let expected = Vec3::new(u, 1.0 - v, blue);
                assert!(Vec3::from(entry.radiance).distance(expected) < 1e-5 && entry.state == State::Seen { clipped: 0 }, "{at}");
            }
        }
    }

    #[test]
    fn a_calibrated_camera_reads_where_the_texel_is_imaged_and_nothing_beyond_its_picture() {
        // Straight above the right half: its picture is 1 wide at distance 2, x right, y up.
        let pose = Pose::look_at(Vec3::new(0.5, 0.0, 2.0), Vec3::new(0.5, 0.0, 0.0), Vec3::Y).unwrap();
        let intrinsics = Intrinsics { width_px: 100, height_px: 100, focal_px: Vec2::splat(200.0), center_px: Vec2::splat(50.0) };
        let camera = Camera::new(intrinsics, pose).unwrap();
        let camera = PhotographCamera { file: "a".into(), camera, distortion: Distortion::new([0.0; 4]).unwrap() };
        let seen = imported(&[("a".into(), PhotographView::Calibrated(camera))], &[ramp(100, 100, 0.5)]).unwrap();
        for (at, entry) in seen[0].iter().enumerate() {
            let (x, y) = (2.0 * ((at % 10) as f32 / 10.0 + 0.05) - 1.0, (at / 10) as f32 / 10.0 + 0.05 - 0.5);
            match x > 0.0 {
                true => {
                    let expected = Vec3::new(x, 0.5 - y, 0.5);
                    assert!(Vec3::from(entry.radiance).distance(expected) < 1e-4, "{at}: {entry:?} {expected}");
                }
                false => assert_eq!(*entry, Observation::MISSING),
            }
        }
    }

    #[test]
    fn masked_pixels_are_never_averaged_and_clipped_ones_stay_clipped() {
        let mut picture = ramp(40, 20, 0.5);
        // Texel (0, 9), the top left: pixels 1 and 2 of rows 0 and 1 meet at (2, 1).
        picture.states[41] = State::Missing;
        // Texel (1, 9): at (6, 1).
        picture.states[45] = State::Seen { clipped: 2 };
        let seen = imported(&[rectified(3.0)], &[picture]).unwrap();
        assert_eq!(seen[0][90], Observation::MISSING);
        assert_eq!(seen[0][91].state, State::Seen { clipped: 2 });
        assert_eq!(seen[0][92].state, State::Seen { clipped: 0 });
    }

    #[test]
    fn pictures_of_other_sizes_and_cameras_behind_are_named() {
        let other = imported(&[rectified(3.0), rectified(4.0)], &[ramp(40, 20, 0.5), ramp(20, 20, 0.5)]).unwrap_err();
        assert_eq!(other.to_string(), "photograph 4.png has 20x20 pixels, 40x20 expected");
        let pose = Pose::look_at(Vec3::new(0.0, 0.0, -2.0), Vec3::ZERO, Vec3::Y).unwrap();
        let camera = Camera::new(Intrinsics::from_vfov(40.0, 40, 20).unwrap(), pose).unwrap();
        let camera = PhotographCamera { file: "b".into(), camera, distortion: Distortion::new([0.0; 4]).unwrap() };
        let behind = imported(&[("b".into(), PhotographView::Calibrated(camera))], &[ramp(40, 20, 0.5)]).unwrap_err();
        assert!(behind.to_string().starts_with("the camera of photograph b is at [0, 0, -2]"), "{behind}");
    }

    #[test]
    fn a_rectangle_too_small_or_large_to_have_an_area_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let (store, _) = Store::open(folder.path(), StoreOptions::local()).unwrap();
        store.create_dataset("seen").unwrap();
        let staging = store.stage("seen", "token").unwrap();
        let load = |_: usize| Ok(ramp(4, 4, 0.5));
        let of_size = |size| import(Photographed::Rectangle(size), &[rectified(1.0)], &load, &settings(), &staging, &Unattended);
        assert_eq!(
            of_size([1e-30, 1.0]).unwrap_err().to_string(),
            "width is 0.000000000000000000000000000001, a length from 1e-9 to 1e9 expected"
        );
        for size in [[1.0, 1e30], [f32::NAN, 1.0], [1.0, 0.0], [-1.0, 1.0], [f32::INFINITY, 1.0]] {
            assert!(of_size(size).unwrap_err().to_string().contains("a length from"), "{size:?}");
        }
        // Both ends have one.
        for size in [[1e-9; 2], [1e9; 2]] {
            assert!(rectangle(size).mesh.triangles.len() == 2);
        }
    }

    #[test]
    fn every_photograph_is_read_once_a_band() {
        let reads = AtomicUsize::new(0);
        let folder = tempfile::tempdir().unwrap();
        let (store, _) = Store::open(folder.path(), StoreOptions::local()).unwrap();
        store.create_dataset("seen").unwrap();
        let staging = store.stage("seen", "token").unwrap();
        let load = |_: usize| {
            reads.fetch_add(1, Ordering::Relaxed);
            Ok(ramp(4, 4, 0.5))
        };
        let views = [rectified(1.0), rectified(2.0), rectified(3.0)];
        import(Photographed::Rectangle([2.0, 1.0]), &views, &load, &settings(), &staging, &Unattended).unwrap();
        assert_eq!(reads.load(Ordering::Relaxed), 3);
    }
}
