//! Job specifications in; jobs out: `answers.rs`.

use std::time::Duration;

use lumisphere::capture::observation_map::{Coverage, MOST_TEXELS_PER_EDGE, ObserveSettings, Response};
use lumisphere::directions::{Scheme, SchemeError};
use lumisphere::evaluate::ThinMetric;
use lumisphere::fitting::{Outliers, Precision};
use lumisphere::geometry::Camera;
use lumisphere::render::Backend;
use lumisphere::representations::Original;
use lumisphere::representations::offset_surface_light_field::{Placement, Placing, Spacing};
use lumisphere::representations::parameter_map::{self, AllowedModels, MOST_CANDIDATES, MOST_SUGGESTIONS, SuggestSettings};
use lumisphere::textures::{Codec, ContentHash, PixelFormat};
use prost::Message;

use super::camera::vec3;
use super::scenes::{SceneSource, scene_source, uploaded_files};
use super::settings::{Delivery, Output, RenderSettings, output, render_settings, stored_settings};
use super::{camera, count, dataset_name, positive, proto, required, within};
use crate::errors::ApiError;
use crate::jobs::PARTIAL;

mod answers;
#[cfg(test)]
mod tests;

pub use answers::{job, job_event, listed_job};

const MAX_SETTINGS: usize = 64;
/// Default of `VirtualPhotographs.directions`.
const DEFAULT_DIRECTIONS: &str = "icosahedron:73";
/// Default of `SuggestSpec.candidates`.
const DEFAULT_CANDIDATES: &str = "icosahedron:305";
/// Default of `FitSpec.relative_noise`.
const DEFAULT_RELATIVE_NOISE: f32 = 0.01;
/// Jobs are remembered, so their specifications are held smaller than a request may be.
const MAX_SPEC_BYTES: usize = 2 << 20;
const MAX_REQUEST_ID_BYTES: usize = 64;

/// What a job is to do, checked.
#[derive(Debug, Clone, PartialEq)]
pub enum JobSpec {
    /// Scene to dataset version.
    Capture(Box<CaptureSpec>),
    /// Dataset version to table of errors.
    Evaluate(EvaluateSpec),
    /// Dataset version to frames.
    PathRender(Box<PathRenderSpec>),
    /// Dataset version to a smaller one.
    Thin(Box<ThinSpec>),
    /// Scene to observation map.
    Observe(Box<ObserveSpec>),
    /// Observation map to parameter map.
    Fit(FitSpec),
    /// Parameter map to directions.
    Suggest(SuggestSpec),
    /// Dataset version to that of another object in the same light.
    Replace(Box<ReplaceSpec>),
}

/// Scene to dataset version.
#[derive(Debug, Clone, PartialEq)]
pub struct CaptureSpec {
    /// What is read.
    pub scene: SceneSource,
    /// As it came, to be kept with the version.
    pub scene_message: proto::SceneSource,
    /// Which of its objects.
    pub object: String,
    /// Which dataset gets a version.
    pub dataset: String,
    /// Off the surface, scene units; None: a part of the object's size.
    pub epsilon: Option<f32>,
    /// How far apart sample points lie.
    pub spacing: Spacing,
    /// Where denser.
    pub placing: Placing,
    /// Along a face's edge.
    pub face_size_texels: u32,
    /// Paths.
    pub samples_per_texel: u32,
    /// 1 = direct light only.
    pub max_bounces: u32,
    /// Along a sample map's edge.
    pub sample_map_size_texels: u32,
    /// Of stored pages.
    pub pixel_format: PixelFormat,
    /// Of the cube maps' pages.
    pub codec: Codec,
    /// Of the random numbers.
    pub seed: u64,
    /// What the object looks like meanwhile.
    pub original: Original,
}

/// From where.
#[derive(Debug, Clone, PartialEq)]
pub enum Views {
    /// One by one.
    Cameras(Vec<Camera>),
    /// A circle.
    Orbit(Orbit),
}

/// Cameras on a circle around the object.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Orbit {
    /// How many.
    pub count: u32,
    /// Image size.
    pub width_px: u32,
    /// Image size.
    pub height_px: u32,
    /// Vertical.
    pub vfov_deg: f32,
    /// Above the horizon.
    pub elevation_deg: f32,
    /// In radii of the object's bounding sphere.
    pub distance_radii: f32,
    /// Of the first, from +Z toward +X.
    pub azimuth_deg: f32,
}

/// What is true.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Truth {
    /// One mirror reflection over the diffuse scene.
    OneReflection,
    /// A mirror that sees itself as one.
    PhysicalMirror,
}

/// Dataset version to table of errors.
#[derive(Debug, Clone, PartialEq)]
pub struct EvaluateSpec {
    /// Which.
    pub dataset: String,
    /// 0: the latest.
    pub version: u64,
    /// From where.
    pub views: Views,
    /// Paths per pixel.
    pub truth_samples_per_pixel: u32,
    /// What to compare.
    pub settings: Vec<RenderSettings>,
    /// With what.
    pub truths: Vec<Truth>,
    /// Of the truth's random numbers.
    pub seed: u64,
    /// Of the truth's paths; None: as captured.
    pub max_bounces: Option<u32>,
    /// Frames of each setting at each view whose time counts.
    pub timed_frames_per_view: u32,
}

/// Dataset version to frames.
#[derive(Debug, Clone, PartialEq)]
pub struct PathRenderSpec {
    /// Which.
    pub dataset: String,
    /// 0: the latest.
    pub version: u64,
    /// From where.
    pub views: Views,
    /// What.
    pub settings: RenderSettings,
    /// How it is returned.
    pub output: Output,
}

/// Dataset version to a smaller one.
#[derive(Debug, Clone, PartialEq)]
pub struct ThinSpec {
    /// Which.
    pub dataset: String,
    /// 0: the latest.
    pub version: u64,
    /// Where the thinned one goes.
    pub into: String,
    /// Whose error is bounded.
    pub settings: RenderSettings,
    /// The bound.
    pub max_error: f64,
    /// Of what.
    pub metric: ThinMetric,
    /// Of validation.
    pub windows: u32,
    /// Paths per pixel.
    pub truth_samples_per_pixel: u32,
    /// Of the windows and their truth.
    pub seed: u64,
    /// Of the cube maps' pages.
    pub codec: Codec,
}

/// Dataset version to that of another object in the same light. What is None is the dataset's.
#[derive(Debug, Clone, PartialEq)]
pub struct ReplaceSpec {
    /// Which.
    pub dataset: String,
    /// 0: the latest.
    pub version: u64,
    /// Where the new object's goes.
    pub into: String,
    /// The new object's.
    pub scene: SceneSource,
    /// Which of its objects.
    pub object: String,
    /// Where it stands.
    pub placement: Placement,
    /// Off the surface, scene units; None: half the distance between neighbours.
    pub epsilon: Option<f32>,
    /// How far apart sample points lie.
    pub spacing: Option<Spacing>,
    /// Along a face's edge.
    pub face_size_texels: Option<u32>,
    /// Rays.
    pub rays_per_texel: u32,
    /// Along a sample map's edge.
    pub sample_map_size_texels: Option<u32>,
    /// Of stored pages.
    pub pixel_format: Option<PixelFormat>,
    /// Of the cube maps' pages.
    pub codec: Codec,
}

/// Scene or photographs to observation map.
#[derive(Debug, Clone, PartialEq)]
pub struct ObserveSpec {
    /// Which dataset gets a version.
    pub dataset: String,
    /// What is read.
    pub source: ObserveSource,
}

/// What is observed.
#[derive(Debug, Clone, PartialEq)]
pub enum ObserveSource {
    /// A scene, by the path tracer.
    Scene(Box<ObservedScene>),
    /// Photographs of a flat surface.
    Photographs(Box<PhotographSource>),
}

/// A scene's object.
#[derive(Debug, Clone, PartialEq)]
pub struct ObservedScene {
    /// What is read.
    pub scene: SceneSource,
    /// As it came, to be kept with the version.
    pub message: proto::SceneSource,
    /// What to photograph and how.
    pub settings: ObserveSettings,
}

/// Photographs of a flat surface.
#[derive(Debug, Clone, PartialEq)]
pub struct PhotographSource {
    /// One of the files.
    pub list_path: String,
    /// Relative path, content.
    pub files: Vec<(String, ContentHash)>,
    /// The object that they show; None: a rectangle.
    pub object: Option<PhotographedObject>,
    /// Of the rectangle; None: as the list says.
    pub width: Option<f32>,
    /// Of the rectangle; None: as the list says.
    pub height: Option<f32>,
    /// Of 8-bit codes.
    pub response: Response,
    /// Along an edge.
    pub size_texels: u32,
    /// Of stored pages.
    pub pixel_format: PixelFormat,
    /// Of stored pages.
    pub codec: Codec,
}

/// An object that is photographed.
#[derive(Debug, Clone, PartialEq)]
pub struct PhotographedObject {
    /// What it stands in.
    pub scene: SceneSource,
    /// Its name.
    pub name: String,
}

impl ObserveSource {
    /// Every uploaded file that must be there.
    pub fn blobs(&self) -> Vec<ContentHash> {
        match self {
            Self::Scene(observed) => observed.scene.blobs().collect(),
            Self::Photographs(source) => {
                let scene = source.object.iter().flat_map(|object| object.scene.blobs());
                source.files.iter().map(|(_, content)| *content).chain(scene).collect()
            }
        }
    }
}

/// Observation map to parameter map.
#[derive(Debug, Clone, PartialEq)]
pub struct FitSpec {
    /// Which.
    pub observations: String,
    /// 0: the latest.
    pub version: u64,
    /// Which dataset gets a version.
    pub dataset: String,
    /// How to fit and store.
    pub settings: parameter_map::ConstructSettings,
    /// Between two partial maps, and the dataset that gets them; None: none.
    pub partial: Option<(Duration, String)>,
    /// What fits single lobes.
    pub backend: Backend,
}

/// Parameter map to directions.
#[derive(Debug, Clone, PartialEq)]
pub struct SuggestSpec {
    /// Which.
    pub dataset: String,
    /// 0: the latest.
    pub version: u64,
    /// What to choose from.
    pub settings: SuggestSettings,
}

/// Limits that specifications are held to.
#[derive(Debug, Clone, Copy)]
pub struct SpecLimits {
    /// Width · height.
    pub max_pixels: u64,
    /// In one job.
    pub max_cameras: usize,
}

impl JobSpec {
    /// "capture", "evaluate", "path_render", "thin", "observe", "fit", "suggest" or "replace".
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Capture(_) => "capture",
            Self::Evaluate(_) => "evaluate",
            Self::PathRender(_) => "path_render",
            Self::Thin(_) => "thin",
            Self::Observe(_) => "observe",
            Self::Fit(_) => "fit",
            Self::Suggest(_) => "suggest",
            Self::Replace(_) => "replace",
        }
    }

    /// The dataset and version that it reads; version 0 is the latest.
    pub fn reads(&self) -> Option<(&str, u64)> {
        match self {
            Self::Capture(_) | Self::Observe(_) => None,
            Self::Fit(f) => Some((&f.observations, f.version)),
            Self::Evaluate(e) => Some((&e.dataset, e.version)),
            Self::PathRender(p) => Some((&p.dataset, p.version)),
            Self::Thin(t) => Some((&t.dataset, t.version)),
            Self::Suggest(s) => Some((&s.dataset, s.version)),
            Self::Replace(r) => Some((&r.dataset, r.version)),
        }
    }

    /// The settings that it renders with.
    pub fn settings(&self) -> &[RenderSettings] {
        match self {
            Self::Capture(_) | Self::Observe(_) | Self::Fit(_) | Self::Suggest(_) | Self::Replace(_) => &[],
            Self::Evaluate(e) => &e.settings,
            Self::PathRender(p) => std::slice::from_ref(&p.settings),
            Self::Thin(t) => std::slice::from_ref(&t.settings),
        }
    }
}

/// A checked specification; field paths begin with "spec".
pub fn job_spec(message: Option<proto::JobSpec>, limits: &SpecLimits) -> Result<JobSpec, ApiError> {
    use proto::job_spec::Spec;
    let message = required(message, "spec")?;
    let bytes = message.encoded_len();
    if bytes > MAX_SPEC_BYTES {
        return Err(ApiError::field("spec", format!("{bytes} bytes, at most {MAX_SPEC_BYTES} expected")));
    }
    Ok(match required(message.spec, "spec.spec")? {
        Spec::Capture(m) => JobSpec::Capture(Box::new(capture(m, "spec.capture")?)),
        Spec::Evaluate(m) => JobSpec::Evaluate(evaluate(m, limits, "spec.evaluate")?),
        Spec::PathRender(m) => JobSpec::PathRender(Box::new(path_render(m, limits, "spec.path_render")?)),
        Spec::Thin(m) => JobSpec::Thin(Box::new(thin(m, "spec.thin")?)),
        Spec::Observe(m) => JobSpec::Observe(Box::new(observe(m, "spec.observe")?)),
        Spec::Fit(m) => JobSpec::Fit(fit(m, "spec.fit")?),
        Spec::Suggest(m) => JobSpec::Suggest(suggest(m, "spec.suggest")?),
        Spec::Replace(m) => JobSpec::Replace(Box::new(replace(m, "spec.replace")?)),
    })
}

/// BLAKE3 of a specification as it came.
pub fn digest(message: &proto::JobSpec) -> String {
    ContentHash::of(&message.encode_to_vec()).to_string()
}

/// The bytes under which a specification is remembered, `version = 0` replaced by what it stood for.
pub fn remembered(mut message: proto::JobSpec, version: Option<u64>) -> Vec<u8> {
    use proto::job_spec::Spec;
    match (&mut message.spec, version) {
        (Some(Spec::Evaluate(m)), Some(version)) => m.version = version,
        (Some(Spec::PathRender(m)), Some(version)) => m.version = version,
        (Some(Spec::Thin(m)), Some(version)) => m.version = version,
        (Some(Spec::Fit(m)), Some(version)) => m.version = version,
        (Some(Spec::Suggest(m)), Some(version)) => m.version = version,
        (Some(Spec::Replace(m)), Some(version)) => m.version = version,
        (Some(Spec::Capture(_) | Spec::Observe(_)) | None, _) | (_, None) => {}
    }
    message.encode_to_vec()
}

/// The message that was remembered.
pub fn recalled(bytes: &[u8]) -> Result<proto::JobSpec, ApiError> {
    proto::JobSpec::decode(bytes).map_err(|e| ApiError::internal(format!("a job record holds no specification: {e}")))
}

/// The client's name for its request.
pub fn request_id(text: String) -> Result<String, ApiError> {
    match text.len() <= MAX_REQUEST_ID_BYTES {
        true => Ok(text),
        false => Err(ApiError::field("request_id", format!("{} bytes, at most {MAX_REQUEST_ID_BYTES} expected", text.len()))),
    }
}

fn capture(m: proto::CaptureSpec, field: &str) -> Result<CaptureSpec, ApiError> {
    use proto::capture_spec::Density;
    let at = |name: &str| format!("{field}.{name}");
    if m.object.is_empty() {
        return Err(ApiError::field(at("object"), "missing"));
    }
    let spacing = match m.density {
        None => Spacing::Count(1000),
        Some(Density::Spacing(distance)) => Spacing::Distance(positive(distance, &at("spacing"))?),
        Some(Density::SamplePoints(points)) => points_asked(points, &at("sample_points"))?,
    };
    let face_size_texels = face_size(m.face_size_texels, 128, &at("face_size_texels"))?;
    let pixel_format = pixel_format(m.pixel_format, PixelFormat::F16, &at("pixel_format"))?;
    let codec = codec(m.codec, Codec::DEFAULT, &at("codec"))?;
    Ok(CaptureSpec {
        scene: scene_source(m.scene.clone(), &at("scene"))?,
        scene_message: required(m.scene, &at("scene"))?,
        object: m.object,
        dataset: dataset_name(&m.dataset, &at("dataset"))?,
        epsilon: if m.offset == 0.0 { None } else { Some(positive(m.offset, &at("offset"))?) },
        spacing,
        placing: placing(m.placing, &at("placing"))?,
        face_size_texels,
        samples_per_texel: count(m.samples_per_texel, 64, 1, 65_536, &at("samples_per_texel"))?,
        max_bounces: count(m.max_bounces, 8, 1, 64, &at("max_bounces"))?,
        sample_map_size_texels: count(m.sample_map_size_texels, 256, 16, 1024, &at("sample_map_size_texels"))?,
        pixel_format,
        codec,
        seed: m.seed,
        original: original(m.original, &at("original"))?,
    })
}

fn original(value: i32, field: &str) -> Result<Original, ApiError> {
    match proto::Original::try_from(value) {
        Ok(proto::Original::Unspecified | proto::Original::Diffuse) => Ok(Original::Diffuse),
        Ok(proto::Original::AsAuthored) => Ok(Original::AsAuthored),
        Err(_) => Err(ApiError::field(field, format!("{value}, DIFFUSE or AS_AUTHORED expected"))),
    }
}

fn placing(value: i32, field: &str) -> Result<Placing, ApiError> {
    match proto::Placing::try_from(value) {
        Ok(proto::Placing::Unspecified | proto::Placing::Uniform) => Ok(Placing::Uniform),
        Ok(proto::Placing::Curvature) => Ok(Placing::Curvature),
        Ok(proto::Placing::Error) => Ok(Placing::Error),
        Err(_) => Err(ApiError::field(field, format!("{value}, UNIFORM, CURVATURE or ERROR expected"))),
    }
}

fn points_asked(points: u32, field: &str) -> Result<Spacing, ApiError> {
    match points {
        0 => Err(ApiError::field(field, "0, 4 to 65534 expected")),
        points => Ok(Spacing::Count(count(points, 0, 4, 65_534, field)?)),
    }
}

fn face_size(texels: u32, default: u32, field: &str) -> Result<u32, ApiError> {
    let texels = count(texels, default, 16, 1024, field)?;
    if texels % 16 == 0 { Ok(texels) } else { Err(ApiError::field(field, format!("{texels}, a multiple of 16 expected"))) }
}

fn replace(m: proto::ReplaceSpec, field: &str) -> Result<ReplaceSpec, ApiError> {
    use proto::replace_spec::Density;
    let at = |name: &str| format!("{field}.{name}");
    if m.object.is_empty() {
        return Err(ApiError::field(at("object"), "missing"));
    }
    let spacing = match m.density {
        None => None,
        Some(Density::Spacing(distance)) => Some(Spacing::Distance(positive(distance, &at("spacing"))?)),
        Some(Density::SamplePoints(points)) => Some(points_asked(points, &at("sample_points"))?),
    };
    let given = |value: u32| (value != 0).then_some(value);
    let face_size_texels = given(m.face_size_texels).map(|texels| face_size(texels, 0, &at("face_size_texels"))).transpose()?;
    let map_field = at("sample_map_size_texels");
    Ok(ReplaceSpec {
        dataset: dataset_name(&m.dataset, &at("dataset"))?,
        version: m.version,
        into: dataset_name(&m.into, &at("into"))?,
        scene: scene_source(m.scene, &at("scene"))?,
        object: m.object,
        placement: placement(m.placement.unwrap_or_default(), &at("placement"))?,
        epsilon: if m.offset == 0.0 { None } else { Some(positive(m.offset, &at("offset"))?) },
        spacing,
        face_size_texels,
        rays_per_texel: count(m.rays_per_texel, 16, 1, 1024, &at("rays_per_texel"))?,
        sample_map_size_texels: given(m.sample_map_size_texels).map(|texels| count(texels, 0, 16, 1024, &map_field)).transpose()?,
        pixel_format: match proto::PixelFormat::try_from(m.pixel_format) {
            Ok(proto::PixelFormat::Unspecified) => None,
            _ => Some(pixel_format(m.pixel_format, PixelFormat::F16, &at("pixel_format"))?),
        },
        codec: codec(m.codec, Codec::DEFAULT, &at("codec"))?,
    })
}

fn placement(m: proto::ObjectPlacement, field: &str) -> Result<Placement, ApiError> {
    let stand_at = m.stand_at.map(vec3);
    if let Some(at) = stand_at.filter(|at| !at.is_finite()) {
        return Err(ApiError::field(format!("{field}.stand_at"), format!("{at}, finite coordinates expected")));
    }
    Ok(Placement {
        stand_at,
        turn_deg: within(m.turn_deg, -360_000.0, 360_000.0, &format!("{field}.turn_deg"))?,
        scale: if m.scale == 0.0 { 1.0 } else { positive(m.scale, &format!("{field}.scale"))? },
    })
}

fn evaluate(m: proto::EvaluateSpec, limits: &SpecLimits, field: &str) -> Result<EvaluateSpec, ApiError> {
    use proto::evaluate_spec::Views as Message;
    let at = |name: &str| format!("{field}.{name}");
    let views = match required(m.views, &at("views"))? {
        Message::Cameras(list) => cameras(list, limits, &at("cameras"))?,
        Message::Orbit(m) => Views::Orbit(orbit(m, limits, &at("orbit"))?),
    };
    if m.settings.is_empty() || m.settings.len() > MAX_SETTINGS {
        return Err(ApiError::field(at("settings"), format!("{} settings, 1 to {MAX_SETTINGS} expected", m.settings.len())));
    }
    let settings = m.settings.into_iter().enumerate().map(|(i, s)| stored_settings(Some(s), &format!("{field}.settings[{i}]")));
    let truth = |(i, number): (usize, &i32)| match proto::Truth::try_from(*number) {
        Ok(proto::Truth::OneReflection) => Ok(Truth::OneReflection),
        Ok(proto::Truth::PhysicalMirror) => Ok(Truth::PhysicalMirror),
        Ok(proto::Truth::Unspecified) | Err(_) => {
            Err(ApiError::field(format!("{field}.truths[{i}]"), format!("{number}, ONE_REFLECTION or PHYSICAL_MIRROR expected")))
        }
    };
    if m.truths.len() > 2 {
        return Err(ApiError::field(at("truths"), format!("{} truths, at most 2 expected", m.truths.len())));
    }
    let mut truths: Vec<Truth> = m.truths.iter().enumerate().map(truth).collect::<Result<_, _>>()?;
    truths.dedup();
    if truths.is_empty() {
        truths.push(Truth::OneReflection);
    }
    Ok(EvaluateSpec {
        dataset: dataset_name(&m.dataset, &at("dataset"))?,
        version: m.version,
        views,
        truth_samples_per_pixel: count(m.truth_samples_per_pixel, 256, 1, 65_536, &at("truth_samples_per_pixel"))?,
        settings: settings.collect::<Result<_, _>>()?,
        truths,
        seed: m.seed,
        max_bounces: if m.max_bounces == 0 { None } else { Some(count(m.max_bounces, 0, 1, 64, &at("max_bounces"))?) },
        timed_frames_per_view: count(m.timed_frames_per_view, 4, 1, 1000, &at("timed_frames_per_view"))?,
    })
}

fn pixel_format(number: i32, default: PixelFormat, field: &str) -> Result<PixelFormat, ApiError> {
    match proto::PixelFormat::try_from(number) {
        Ok(proto::PixelFormat::Unspecified) => Ok(default),
        Ok(proto::PixelFormat::F16) => Ok(PixelFormat::F16),
        Ok(proto::PixelFormat::F32) => Ok(PixelFormat::F32),
        Err(_) => Err(ApiError::field(field, format!("{number}, F16 or F32 expected"))),
    }
}

fn codec(number: i32, default: Codec, field: &str) -> Result<Codec, ApiError> {
    Ok(match proto::Codec::try_from(number) {
        Ok(proto::Codec::Unspecified) => default,
        Ok(proto::Codec::ZstdChunk) => Codec::ZstdChunk,
        Ok(proto::Codec::ZstdSeq) => Codec::ZstdSeq,
        Ok(proto::Codec::LzwSeq) => Codec::LzwSeq,
        Ok(proto::Codec::BitsChunk) => Codec::BitsChunk,
        Err(_) => return Err(ApiError::field(field, format!("{number}, a codec's number expected"))),
    })
}

fn thin(m: proto::ThinSpec, field: &str) -> Result<ThinSpec, ApiError> {
    let at = |name: &str| format!("{field}.{name}");
    if !(m.max_error > 0.0 && m.max_error.is_finite()) {
        return Err(ApiError::field(at("max_error"), format!("{}, a number above 0 expected", m.max_error)));
    }
    let settings = stored_settings(m.settings, &at("settings"))?;
    if settings.settings.brdf().is_some() {
        return Err(ApiError::field(at("settings.component"), "GLOSSY, another component expected"));
    }
    if settings.settings.dielectric().is_some() {
        return Err(ApiError::field(at("settings.component"), "REFRACTION, another component expected"));
    }
    if let Some(mirrors) = settings.settings.mirrors().filter(|mirrors| mirrors.reflections > 1) {
        return Err(ApiError::field(at("settings.reflections"), format!("{}, 1 expected", mirrors.reflections)));
    }
    if settings.settings.bumps().is_some() {
        return Err(ApiError::field(at("settings.normal_map"), "a normal map, none expected"));
    }
    if settings.settings.light().changes_light() {
        return Err(ApiError::field(at("settings.relighting"), "other light than was captured, none expected"));
    }
    let metric = match proto::ThinMetric::try_from(m.metric) {
        Ok(proto::ThinMetric::Unspecified | proto::ThinMetric::DeltaE) => ThinMetric::DeltaE,
        Ok(proto::ThinMetric::RmseL) => ThinMetric::RmseLightness,
        Err(_) => return Err(ApiError::field(at("metric"), format!("{}, DELTA_E or RMSE_L expected", m.metric))),
    };
    Ok(ThinSpec {
        dataset: dataset_name(&m.dataset, &at("dataset"))?,
        version: m.version,
        into: dataset_name(&m.into, &at("into"))?,
        settings,
        max_error: m.max_error,
        metric,
        windows: count(m.windows, 4096, 16, 16_384, &at("windows"))?,
        truth_samples_per_pixel: count(m.truth_samples_per_pixel, 256, 1, 65_536, &at("truth_samples_per_pixel"))?,
        seed: m.seed,
        codec: codec(m.codec, Codec::DEFAULT, &at("codec"))?,
    })
}

fn observe(m: proto::ObserveSpec, field: &str) -> Result<ObserveSpec, ApiError> {
    use proto::observe_spec::Source;
    let size_texels = count(m.size_texels, 256, 1, MOST_TEXELS_PER_EDGE, &format!("{field}.size_texels"))?;
    let pixel_format = pixel_format(m.pixel_format, PixelFormat::F32, &format!("{field}.pixel_format"))?;
    let codec = codec(m.codec, Codec::DEFAULT, &format!("{field}.codec"))?;
    let source = match required(m.source, &format!("{field}.source"))? {
        Source::VirtualPhotographs(source) => {
            virtual_photographs(source, (size_texels, pixel_format, codec), &format!("{field}.virtual_photographs"))?
        }
        Source::Photographs(source) => photographs(source, (size_texels, pixel_format, codec), &format!("{field}.photographs"))?,
    };
    Ok(ObserveSpec { dataset: dataset_name(&m.dataset, &format!("{field}.dataset"))?, source })
}

fn photographs(
    source: proto::PhotographSet,
    (size_texels, pixel_format, codec): (u32, PixelFormat, Codec),
    field: &str,
) -> Result<ObserveSource, ApiError> {
    use proto::photograph_set::Response as Message;
    let at = |name: &str| format!("{field}.{name}");
    let length = |value: f32, name: &str| (value != 0.0).then(|| positive(value, &at(name))).transpose();
    let object = match (source.scene, source.object) {
        (None, name) if name.is_empty() => None,
        (None, _) => return Err(ApiError::field(at("scene"), "missing, where an object is named")),
        (Some(_), name) if name.is_empty() => return Err(ApiError::field(at("object"), "missing, where a scene is given")),
        (scene, name) => Some(PhotographedObject { scene: scene_source(scene, &at("scene"))?, name }),
    };
    if let Some((field, _)) = [("width", source.width), ("height", source.height)].iter().find(|(_, v)| object.is_some() && *v != 0.0) {
        return Err(ApiError::field(at(field), "of an object, whose size its scene says: 0 expected"));
    }
    Ok(ObserveSource::Photographs(Box::new(PhotographSource {
        files: uploaded_files(source.files, &source.list_path, "list_path", field)?,
        list_path: source.list_path,
        object,
        width: length(source.width, "width")?,
        height: length(source.height, "height")?,
        response: match Message::try_from(source.response) {
            Ok(Message::Unspecified | Message::Srgb) => Response::Srgb,
            Ok(Message::Linear) => Response::Linear,
            Err(_) => return Err(ApiError::field(at("response"), format!("{}, SRGB or LINEAR expected", source.response))),
        },
        size_texels,
        pixel_format,
        codec,
    })))
}

fn virtual_photographs(
    source: proto::VirtualPhotographs,
    (size_texels, pixel_format, codec): (u32, PixelFormat, Codec),
    field: &str,
) -> Result<ObserveSource, ApiError> {
    let at = |name: &str| format!("{field}.{name}");
    if source.object.is_empty() {
        return Err(ApiError::field(at("object"), "missing"));
    }
    let directions = if source.directions.is_empty() { DEFAULT_DIRECTIONS } else { source.directions.as_str() };
    let directions: Scheme = directions.parse().map_err(|e: SchemeError| ApiError::field(at("directions"), e.to_string()))?;
    let distance_radii = or_default(source.distance_radii, 10.0, 1.0, 1e6, &at("distance_radii"))?;
    Ok(ObserveSource::Scene(Box::new(ObservedScene {
        scene: scene_source(source.scene.clone(), &at("scene"))?,
        message: required(source.scene, &at("scene"))?,
        settings: ObserveSettings {
            object: source.object,
            size_texels,
            directions,
            coverage: coverage(source.both_hemispheres),
            axis: zenith(source.axis, &at("axis"))?,
            distance_radii,
            samples_per_observation: count(source.samples_per_observation, 64, 1, 65_536, &at("samples_per_observation"))?,
            max_bounces: count(source.max_bounces, 8, 1, 64, &at("max_bounces"))?,
            seed: source.seed,
            pixel_format,
            codec,
        },
    })))
}

fn zenith(axis: Option<proto::Vector3>, field: &str) -> Result<Option<glam::Vec3>, ApiError> {
    axis.map(|axis| vec3(axis).try_normalize().ok_or_else(|| ApiError::field(field, "zero or not finite"))).transpose()
}

// As a request says it.
fn coverage(both_hemispheres: bool) -> Coverage {
    if both_hemispheres { Coverage::Sphere } else { Coverage::Hemisphere }
}

fn suggest(m: proto::SuggestSpec, field: &str) -> Result<SuggestSpec, ApiError> {
    let at = |name: &str| format!("{field}.{name}");
    let candidates = if m.candidates.is_empty() { DEFAULT_CANDIDATES } else { m.candidates.as_str() };
    let candidates: Scheme = candidates.parse().map_err(|e: SchemeError| ApiError::field(at("candidates"), e.to_string()))?;
    let coverage = coverage(m.both_hemispheres);
    let (number, most) = (candidates.count().saturating_mul(coverage.sides()), MOST_CANDIDATES);
    if number > most {
        return Err(ApiError::field(at("candidates"), format!("{number} directions, at most {most} expected")));
    }
    Ok(SuggestSpec {
        dataset: dataset_name(&m.dataset, &at("dataset"))?,
        version: m.version,
        settings: SuggestSettings {
            count: count(m.count, 8, 1, MOST_SUGGESTIONS as u32, &at("count"))? as usize,
            candidates,
            coverage,
            axis: zenith(m.axis, &at("axis"))?,
        },
    })
}

fn fit(m: proto::FitSpec, field: &str) -> Result<FitSpec, ApiError> {
    let at = |name: &str| format!("{field}.{name}");
    let models = if m.models.is_empty() { "auto" } else { m.models.as_str() };
    let models: AllowedModels = models.parse().map_err(|e: parameter_map::UnknownModels| ApiError::field(at("models"), e.to_string()))?;
    if m.reject_outliers && matches!(models, AllowedModels::Harmonics(_)) {
        return Err(ApiError::field(at("reject_outliers"), format!("with models {models}, auto, constant or phong:N expected")));
    }
    let dataset = dataset_name(&m.dataset, &at("dataset"))?;
    let partial = || {
        let field = at("publish_every_seconds");
        let every = Duration::from_secs_f32(within(m.publish_every_seconds, 0.001, 1e6, &field)?);
        Ok::<_, ApiError>((every, dataset_name(&format!("{dataset}{PARTIAL}"), &field)?))
    };
    let partial = (m.publish_every_seconds != 0.0).then(partial).transpose()?;
    let backend = match proto::Backend::try_from(m.backend) {
        Ok(proto::Backend::Unspecified | proto::Backend::Cpu) => Backend::Cpu,
        Ok(proto::Backend::Gpu) => Backend::Gpu,
        Err(_) => return Err(ApiError::field(at("backend"), format!("{}, GPU or CPU expected", m.backend))),
    };
    if backend == Backend::Gpu && matches!(models, AllowedModels::Constant | AllowedModels::Harmonics(_)) {
        return Err(ApiError::field(at("backend"), format!("GPU with models {models}, which have no lobe to fit; CPU expected")));
    }
    Ok(FitSpec {
        observations: dataset_name(&m.observations, &at("observations"))?,
        version: m.version,
        dataset,
        partial,
        backend,
        settings: parameter_map::ConstructSettings {
            models,
            outliers: if m.reject_outliers { Outliers::Reject } else { Outliers::Keep },
            precision: if m.polish { Precision::Polished } else { Precision::Single },
            max_bytes: (m.max_bytes != 0).then_some(m.max_bytes),
            noise_floor: if m.noise_floor == 0.0 { None } else { Some(positive(m.noise_floor, &at("noise_floor"))?) },
            relative_noise: within(m.relative_noise.unwrap_or(DEFAULT_RELATIVE_NOISE), 0.0, 1.0, &at("relative_noise"))?,
            pixel_format: pixel_format(m.pixel_format, PixelFormat::F16, &at("pixel_format"))?,
            codec: codec(m.codec, Codec::ZstdChunk, &at("codec"))?,
        },
    })
}

fn path_render(m: proto::PathRenderSpec, limits: &SpecLimits, field: &str) -> Result<PathRenderSpec, ApiError> {
    use proto::path_render_spec::Views as Message;
    let at = |name: &str| format!("{field}.{name}");
    let views = match required(m.views, &at("views"))? {
        Message::Cameras(list) => cameras(list, limits, &at("cameras"))?,
        Message::Orbit(m) => Views::Orbit(orbit(m, limits, &at("orbit"))?),
    };
    Ok(PathRenderSpec {
        dataset: dataset_name(&m.dataset, &at("dataset"))?,
        version: m.version,
        views,
        settings: render_settings(m.settings, &at("settings"))?,
        output: output(m.output, Delivery::Alone, &at("output"))?,
    })
}

fn cameras(list: proto::CameraList, limits: &SpecLimits, field: &str) -> Result<Views, ApiError> {
    let number = list.cameras.len();
    if number == 0 || number > limits.max_cameras {
        return Err(ApiError::field(format!("{field}.cameras"), format!("{number} cameras, 1 to {} expected", limits.max_cameras)));
    }
    let checked = |(i, c)| camera::camera(Some(c), limits.max_pixels, &format!("{field}.cameras[{i}]"));
    list.cameras.into_iter().enumerate().map(checked).collect::<Result<_, _>>().map(Views::Cameras)
}

fn orbit(m: proto::OrbitPath, limits: &SpecLimits, field: &str) -> Result<Orbit, ApiError> {
    let at = |name: &str| format!("{field}.{name}");
    let most = u32::try_from(limits.max_cameras).unwrap_or(u32::MAX);
    let orbit = Orbit {
        count: count(m.count, 8, 1, most, &at("count"))?,
        width_px: count(m.width_px, 640, 1, 1 << 20, &at("width_px"))?,
        height_px: count(m.height_px, 480, 1, 1 << 20, &at("height_px"))?,
        vfov_deg: or_default(m.vertical_field_of_view_deg, 40.0, 1.0, 179.0, &at("vertical_field_of_view_deg"))?,
        elevation_deg: within(m.elevation_deg.unwrap_or(25.0), -89.0, 89.0, &at("elevation_deg"))?,
        distance_radii: or_default(m.distance_radii, 3.5, 1.0, 1e6, &at("distance_radii"))?,
        azimuth_deg: within(m.azimuth_deg, -360_000.0, 360_000.0, &at("azimuth_deg"))?,
    };
    let pixels = u64::from(orbit.width_px) * u64::from(orbit.height_px);
    match pixels <= limits.max_pixels {
        true => Ok(orbit),
        false => Err(ApiError::field(at("width_px"), format!("{pixels} pixels, at most {} expected", limits.max_pixels))),
    }
}

fn or_default(value: f32, default: f32, least: f32, greatest: f32, field: &str) -> Result<f32, ApiError> {
    if value == 0.0 { Ok(default) } else { within(value, least, greatest, field) }
}
