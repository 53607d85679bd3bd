//! How to render and what to return.

use glam::Vec3;
use lumisphere::evaluate::{MOST_PATHS_PER_PIXEL, MOST_TRUTH_PASSES};
use lumisphere::geometry::Mapping;
use lumisphere::images::{Exposure, JpegQuality, ToneMap};
use lumisphere::radiometry::dielectric::{Body, Dielectric, MOST_INDEX};
use lumisphere::representations::offset_surface_light_field as oslf;
use lumisphere::representations::{Settings, parameter_map};
use lumisphere::scenes::{MOST_POINT_LIGHTS, PointLight, Relighting};
use lumisphere::textures::ContentHash;
use serde::Deserialize;

use super::camera::vec3;
use super::{count, hash, proto, required, within};
use crate::config::BackendChoice;
use crate::depth_plane::{DepthFormat, DepthPlane, MAX_STEP};
use crate::errors::{ApiError, Reason};

/// Of `Gloss.brdf`: more than any model needs.
const MAX_BRDF_BYTES: usize = 2048;
/// Default of `Refraction.index`: glass.
const DEFAULT_INDEX: f32 = 1.5;
/// Default N of the blends that have one.
const DEFAULT_EXPONENT: f32 = 4.0;
const DEFAULT_JPEG_QUALITY: u8 = 90;
/// Defaults of `GroundTruth`: a first pass that comes soon, and enough that a still is worth a look.
const DEFAULT_PATHS_PER_PIXEL: u32 = 1;
const DEFAULT_TRUTH_PASSES: u32 = 64;
/// 2^stops, 2^−stops: what `Exposure` allows.
const MAX_EXPOSURE_STOPS: f32 = 30.0;
const MAX_EXPOSURE_GAMMA: f32 = 1000.0;
const MAX_TURN_DEG: f32 = 360.0;
/// Of a normal map: less of it is as good as flat.
const LEAST_REPEATS: f32 = 0.001;
/// Coordinates and intensities: their squares are far from overflow.
const MAX_OF_A_LIGHT: f32 = 1e9;

/// What to compute and where.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RenderSettings {
    /// By kind.
    pub settings: Settings,
    /// What they should show, instead of what is stored.
    pub ground_truth: Option<GroundTruth>,
    /// Where.
    pub backend: BackendChoice,
    /// Of a still, at least 1; 1 where a second would be no other than the first.
    pub passes: u32,
}

/// How truth is traced.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GroundTruth {
    /// Of a pass.
    pub paths_per_pixel: u32,
}

/// What is returned.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Output {
    /// Of the colour.
    pub encoding: Encoding,
    /// Of the last frame of a pose at which a viewer rests; None: the same.
    pub encoding_at_rest: Option<Encoding>,
    /// Return distances.
    pub depth: Option<DepthPlane>,
    /// Return where each pixel comes from.
    pub provenance: bool,
}

/// Encodings of colour.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Encoding {
    /// Interleaved f32, one zstd frame.
    RawZstd,
    /// 8-bit sRGB.
    Png {
        /// From radiance to the screen.
        tone_map: ToneMap,
    },
    /// 8-bit sRGB.
    Jpeg {
        /// 1 to 100.
        quality: JpegQuality,
        /// From radiance to the screen.
        tone_map: ToneMap,
    },
    /// f32 R G B.
    Exr,
    /// 8-bit sRGB, as it differs from the frame before.
    H264 {
        /// 1 to 100, as JPEG's.
        quality: JpegQuality,
        /// From radiance to the screen.
        tone_map: ToneMap,
    },
}

/// What frames are ordered for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Delivery {
    /// One at a time.
    Alone,
    /// One after the other to one viewer, who is given all of them.
    Stream,
}

impl Output {
    /// Whether any of its frames are H.264.
    pub fn has_video(&self) -> bool {
        let is_video = |encoding: Encoding| matches!(encoding, Encoding::H264 { .. });
        is_video(self.encoding) || self.encoding_at_rest.is_some_and(is_video)
    }
}

impl Encoding {
    /// 1 to 100, where there is one.
    pub fn quality(self) -> Option<u8> {
        match self {
            Self::Jpeg { quality, .. } | Self::H264 { quality, .. } => Some(quality.value()),
            Self::RawZstd | Self::Png { .. } | Self::Exr => None,
        }
    }

    /// With this quality at most.
    #[must_use]
    pub fn at_most(self, most: Option<u8>) -> Self {
        match (self, most.and_then(JpegQuality::new)) {
            (Self::Jpeg { quality, tone_map }, Some(most)) if most.value() < quality.value() => Self::Jpeg { quality: most, tone_map },
            (Self::H264 { quality, tone_map }, Some(most)) if most.value() < quality.value() => Self::H264 { quality: most, tone_map },
            (same, _) => same,
        }
    }
}

/// Checked settings; `field` is their path.
pub fn render_settings(message: Option<proto::RenderSettings>, field: &str) -> Result<RenderSettings, ApiError> {
    use proto::render_settings::Representation;
    let message = required(message, field)?;
    let (settings, passes) = match required(message.representation, &format!("{field}.representation"))? {
        Representation::OffsetSurfaceLightField(m) => {
            let field = format!("{field}.offset_surface_light_field");
            let passes = m.gloss.as_ref().map_or(0, |gloss| gloss.passes);
            let settings = oslf_settings(m, &field)?;
            (Settings::OffsetSurfaceLightField(settings), passes_of(&settings, passes, &field)?)
        }
        Representation::ParameterMap(m) => (Settings::ParameterMap(parameter_map_settings(m, &format!("{field}.parameter_map"))?), 1),
    };
    let backend = match proto::Backend::try_from(message.backend) {
        Ok(proto::Backend::Unspecified) => BackendChoice::Auto,
        Ok(proto::Backend::Gpu) => BackendChoice::Gpu,
        Ok(proto::Backend::Cpu) => BackendChoice::Cpu,
        Err(_) => return Err(ApiError::field(format!("{field}.backend"), format!("{}, GPU or CPU expected", message.backend))),
    };
    let truth = message.ground_truth.map(|m| ground_truth(m, &settings, &format!("{field}.ground_truth"))).transpose()?;
    let (ground_truth, passes) = truth.map_or((None, passes), |(truth, passes)| (Some(truth), passes));
    Ok(RenderSettings { settings, ground_truth, backend, passes })
}

/// The same for work that reads what is stored.
pub fn stored_settings(message: Option<proto::RenderSettings>, field: &str) -> Result<RenderSettings, ApiError> {
    let settings = render_settings(message, field)?;
    match settings.ground_truth {
        None => Ok(settings),
        Some(_) => Err(ApiError::field(format!("{field}.ground_truth"), "given, none expected: this works on what is stored")),
    }
}

/// And its passes.
fn ground_truth(message: proto::GroundTruth, settings: &Settings, field: &str) -> Result<(GroundTruth, u32), ApiError> {
    if let Settings::ParameterMap(parameter_map::Settings { show }) = settings
        && *show != parameter_map::Show::Radiance
    {
        return Err(ApiError::field(field, format!("given for {}, RADIANCE expected: of nothing else is there a truth", show.name())));
    }
    let paths = &format!("{field}.paths_per_pixel");
    let paths_per_pixel = count(message.paths_per_pixel, DEFAULT_PATHS_PER_PIXEL, 1, MOST_PATHS_PER_PIXEL, paths)?;
    let passes = count(message.passes, DEFAULT_TRUTH_PASSES, 1, MOST_TRUTH_PASSES, &format!("{field}.passes"))?;
    Ok((GroundTruth { paths_per_pixel }, passes))
}

/// Refuses settings for another kind than the dataset's.
pub fn check_kind(settings: &Settings, dataset_kind: &str) -> Result<(), ApiError> {
    let kind = settings.kind().name();
    match kind == dataset_kind {
        true => Ok(()),
        false => {
            Err(ApiError::new(Reason::DatasetKindMismatch, format!("the dataset holds {dataset_kind:?}, the settings are for {kind:?}")))
        }
    }
}

fn parameter_map_settings(message: proto::ParameterMapSettings, field: &str) -> Result<parameter_map::Settings, ApiError> {
    use proto::parameter_map_settings::Show;
    let show = match Show::try_from(message.show) {
        Ok(Show::Unspecified | Show::Radiance) => parameter_map::Show::Radiance,
        Ok(Show::Models) => parameter_map::Show::Models,
        Ok(Show::Flags) => parameter_map::Show::Flags,
        Err(_) => return Err(ApiError::field(format!("{field}.show"), format!("{}, RADIANCE, MODELS or FLAGS expected", message.show))),
    };
    Ok(parameter_map::Settings { show })
}

fn oslf_settings(message: proto::OffsetSurfaceLightFieldSettings, field: &str) -> Result<oslf::Settings, ApiError> {
    use proto::offset_surface_light_field_settings::Blend;
    let filter = filter(message.filter, &format!("{field}.filter"))?;
    let component = component(message.component, (message.gloss, message.refraction), filter, field)?;
    let exponent = within(message.exponent.unwrap_or(DEFAULT_EXPONENT), 0.0, 10_000.0, &format!("{field}.exponent"))?;
    let blend = match component {
        // Corrected or not: of others anything will do, nonsense included.
        oslf::Component::Reconstruction if message.blend == Blend::Corrected as i32 => oslf::Blend::Corrected,
        oslf::Component::Reconstruction => oslf::Blend::Distance,
        oslf::Component::Mirror | oslf::Component::Full | oslf::Component::Glossy(_) | oslf::Component::Refraction(_) => {
            blend(message.blend, exponent, &format!("{field}.blend"))?
        }
    };
    let specular_reflectance = message.specular_reflectance.map_or(Vec3::ONE, vec3);
    for (channel, value) in ["x", "y", "z"].into_iter().zip(specular_reflectance.to_array()) {
        within(value, 0.0, 1.0, &format!("{field}.specular_reflectance.{channel}"))?;
    }
    let light = message.relighting.map_or(Ok(Relighting::NONE), |m| relighting(m, &format!("{field}.relighting")))?;
    let reflections = count(message.reflections, 1, 1, oslf::MOST_REFLECTIONS, &format!("{field}.reflections"))?;
    let bumps = message.normal_map.map(|m| bumps(m, &format!("{field}.normal_map"))).transpose()?;
    let settings = oslf::Settings { component, blend, specular_reflectance, filter, light, reflections, bumps };
    settings.check_bumps().map_err(|e| ApiError::field(format!("{field}.normal_map"), e))?;
    Ok(settings)
}

fn bumps(message: proto::offset_surface_light_field_settings::NormalMap, field: &str) -> Result<oslf::Bumps, ApiError> {
    let at = |name: &str| format!("{field}.{name}");
    let map = hash(&message.image, &at("image"))?;
    let strength = within(message.strength.unwrap_or(1.0), -oslf::MOST_STRENGTH, oslf::MOST_STRENGTH, &at("strength"))?;
    let repeat = within(message.repeat.unwrap_or(1.0), LEAST_REPEATS, oslf::MOST_REPEATS, &at("repeat"))?;
    Ok(oslf::Bumps { map, mapping: Mapping { strength, repeat } })
}

fn relighting(message: proto::offset_surface_light_field_settings::Relighting, field: &str) -> Result<Relighting, ApiError> {
    let turn = within(message.environment_turn_deg, -MAX_TURN_DEG, MAX_TURN_DEG, &format!("{field}.environment_turn_deg"))?;
    let count = message.point_lights.len();
    if count > MOST_POINT_LIGHTS {
        return Err(ApiError::field(format!("{field}.point_lights"), format!("{count}, at most {MOST_POINT_LIGHTS} expected")));
    }
    let light = |(i, m): (usize, proto::offset_surface_light_field_settings::PointLight)| {
        let at = |name: &str| format!("{field}.point_lights[{i}].{name}");
        let position = each_within(vec3(required(m.position, &at("position"))?), -MAX_OF_A_LIGHT, &at("position"))?;
        let intensity = each_within(vec3(required(m.intensity, &at("intensity"))?), 0.0, &at("intensity"))?;
        Ok(PointLight { position, intensity })
    };
    let lights = message.point_lights.into_iter().enumerate().map(light).collect::<Result<Vec<_>, ApiError>>()?;
    Ok(Relighting::new(turn.to_radians(), &lights).expect("checked above"))
}

/// No coordinate less than `least` or above [`MAX_OF_A_LIGHT`].
fn each_within(value: Vec3, least: f32, field: &str) -> Result<Vec3, ApiError> {
    for (axis, value) in ["x", "y", "z"].into_iter().zip(value.to_array()) {
        within(value, least, MAX_OF_A_LIGHT, &format!("{field}.{axis}"))?;
    }
    Ok(value)
}

fn filter(value: i32, field: &str) -> Result<oslf::Filter, ApiError> {
    use proto::offset_surface_light_field_settings::Filter;
    match Filter::try_from(value) {
        Ok(Filter::Unspecified | Filter::Footprint) => Ok(oslf::Filter::Footprint),
        Ok(Filter::Bilinear) => Ok(oslf::Filter::Bilinear),
        Err(_) => Err(ApiError::field(field, format!("{value}, FOOTPRINT or BILINEAR expected"))),
    }
}

fn component(
    value: i32,
    (gloss, refraction): (
        Option<proto::offset_surface_light_field_settings::Gloss>,
        Option<proto::offset_surface_light_field_settings::Refraction>,
    ),
    filter: oslf::Filter,
    field: &str,
) -> Result<oslf::Component, ApiError> {
    use proto::offset_surface_light_field_settings::Component;
    match Component::try_from(value) {
        Ok(Component::Reconstruction) => Ok(oslf::Component::Reconstruction),
        Ok(Component::Mirror) => Ok(oslf::Component::Mirror),
        Ok(Component::Full) => Ok(oslf::Component::Full),
        Ok(Component::Glossy) => Ok(oslf::Component::Glossy(self::gloss(gloss, filter, &format!("{field}.gloss"))?)),
        Ok(Component::Refraction) => Ok(oslf::Component::Refraction(self::refraction(refraction, &format!("{field}.refraction"))?)),
        Ok(Component::Unspecified) | Err(_) => {
            let field = format!("{field}.component");
            Err(ApiError::field(field, format!("{value}, RECONSTRUCTION, MIRROR, FULL, GLOSSY or REFRACTION expected")))
        }
    }
}

fn gloss(
    message: Option<proto::offset_surface_light_field_settings::Gloss>,
    filter: oslf::Filter,
    field: &str,
) -> Result<oslf::Gloss, ApiError> {
    use proto::offset_surface_light_field_settings::gloss::Order;
    let message = required(message, field)?;
    let wrong = |problem: String| ApiError::field(format!("{field}.brdf"), problem);
    if message.brdf.len() > MAX_BRDF_BYTES {
        return Err(wrong(format!("{} bytes, at most {MAX_BRDF_BYTES} expected", message.brdf.len())));
    }
    let brdf = gloss_brdf(&message.brdf).map_err(|e| wrong(format!("{e} in {:?}", message.brdf)))?;
    let order = match Order::try_from(message.order) {
        Ok(Order::Unspecified | Order::BlendFirst) => oslf::Order::BlendFirst,
        Ok(Order::IntegrateFirst) => oslf::Order::IntegrateFirst,
        Err(_) => {
            return Err(ApiError::field(format!("{field}.order"), format!("{}, BLEND_FIRST or INTEGRATE_FIRST expected", message.order)));
        }
    };
    let given = message.directions;
    if given > oslf::MOST_DIRECTIONS {
        return Err(ApiError::field(format!("{field}.directions"), format!("{given}, 1 to {} expected", oslf::MOST_DIRECTIONS)));
    }
    let suited = oslf::Gloss::suited(brdf, filter);
    let integration = integration(message.integration, &suited, (given, filter), &format!("{field}.integration"))?;
    let directions = if given == 0 { suited.directions } else { given };
    Ok(oslf::Gloss { brdf, integration, order, directions, pass: 0 })
}

/// As asked for; where nothing is, `suited`'s, unless directions are given.
fn integration(
    value: i32,
    suited: &oslf::Gloss,
    (directions, filter): (u32, oslf::Filter),
    field: &str,
) -> Result<oslf::Integration, ApiError> {
    use proto::offset_surface_light_field_settings::gloss::Integration;
    match Integration::try_from(value) {
        Ok(Integration::Unspecified) if directions == 0 => Ok(suited.integration),
        Ok(Integration::Unspecified | Integration::MonteCarlo) => Ok(oslf::Integration::MonteCarlo),
        Ok(Integration::Prefiltered) if filter == oslf::Filter::Bilinear => {
            Err(ApiError::field(field, "PREFILTERED with the filter BILINEAR, which reads no means; FOOTPRINT expected"))
        }
        Ok(Integration::Prefiltered) if !suited.brdf.is_one_highlight() => Err(ApiError::field(
            field,
            "PREFILTERED for such a BRDF; phong, ashikhmin_shirley or ward without a diffuse part, or cook_torrance expected",
        )),
        Ok(Integration::Prefiltered) => Ok(oslf::Integration::Prefiltered),
        Err(_) => Err(ApiError::field(field, format!("{value}, MONTE_CARLO or PREFILTERED expected"))),
    }
}

/// On the wire.
pub fn integration_number(gloss: &oslf::Gloss) -> i32 {
    use proto::offset_surface_light_field_settings::gloss::Integration;
    (if gloss.is_prefiltered() { Integration::Prefiltered } else { Integration::MonteCarlo }) as i32
}

/// `{"model": "measured", "table": HASH}`, or a model's parameters.
fn gloss_brdf(json: &str) -> Result<oslf::GlossBrdf, serde_json::Error> {
    #[derive(Deserialize)]
    struct Model {
        model: Option<String>,
    }
    #[derive(Deserialize)]
    #[serde(deny_unknown_fields)]
    struct OfTable {
        #[serde(rename = "model")]
        _model: String,
        table: ContentHash,
    }
    match serde_json::from_str::<Model>(json)?.model.as_deref() {
        Some("measured") => Ok(oslf::GlossBrdf::Measured(serde_json::from_str::<OfTable>(json)?.table)),
        Some(_) | None => Ok(oslf::GlossBrdf::Analytic(serde_json::from_str(json)?)),
    }
}

fn refraction(message: Option<proto::offset_surface_light_field_settings::Refraction>, field: &str) -> Result<Dielectric, ApiError> {
    use proto::offset_surface_light_field_settings::refraction::Body as Message;
    let message = required(message, field)?;
    let index = within(message.index.unwrap_or(DEFAULT_INDEX), 1.0, MOST_INDEX, &format!("{field}.index"))?;
    let body = match Message::try_from(message.body) {
        Ok(Message::Unspecified | Message::Solid) => Body::Solid,
        Ok(Message::Thin) => Body::Thin,
        Err(_) => return Err(ApiError::field(format!("{field}.body"), format!("{}, SOLID or THIN expected", message.body))),
    };
    Ok(Dielectric::new(index, body).expect("checked above"))
}

/// `gloss` is ignored for what is not glossy, its passes included.
fn passes_of(settings: &oslf::Settings, passes: u32, field: &str) -> Result<u32, ApiError> {
    match settings.component {
        oslf::Component::Glossy(gloss) => {
            let passes = count(passes, 1, 1, oslf::MOST_PASSES, &format!("{field}.gloss.passes"))?;
            Ok(if gloss.is_prefiltered() { 1 } else { passes })
        }
        oslf::Component::Reconstruction | oslf::Component::Mirror | oslf::Component::Full | oslf::Component::Refraction(_) => Ok(1),
    }
}

fn blend(value: i32, exponent: f32, field: &str) -> Result<oslf::Blend, ApiError> {
    use proto::offset_surface_light_field_settings::Blend;
    match Blend::try_from(value) {
        Ok(Blend::Distance) => Ok(oslf::Blend::Distance),
        Ok(Blend::Angle) => Ok(oslf::Blend::Angle),
        Ok(Blend::Average) => Ok(oslf::Blend::Average),
        Ok(Blend::Reflection) => Ok(oslf::Blend::Reflection { exponent }),
        Ok(Blend::Normal) => Ok(oslf::Blend::Normal { exponent }),
        Ok(Blend::EnvironmentMap) => Ok(oslf::Blend::EnvironmentMap),
        Ok(Blend::Corrected) => Ok(oslf::Blend::Corrected),
        Ok(Blend::Unspecified) | Err(_) => {
            let expected = "DISTANCE, ANGLE, AVERAGE, REFLECTION, NORMAL, ENVIRONMENT_MAP or CORRECTED expected";
            Err(ApiError::field(field, format!("{value}, {expected}")))
        }
    }
}

/// Checked output; `field` is its path.
pub fn output(message: Option<proto::OutputSettings>, delivery: Delivery, field: &str) -> Result<Output, ApiError> {
    let message = required(message, field)?;
    let tone_map = tone_map(&message, field)?;
    let quality = match message.jpeg_quality {
        0 => Some(DEFAULT_JPEG_QUALITY),
        q => u8::try_from(q).ok(),
    };
    let quality = quality.and_then(JpegQuality::new);
    let quality =
        quality.ok_or_else(|| ApiError::field(format!("{field}.jpeg_quality"), format!("{}, 1 to 100 expected", message.jpeg_quality)))?;
    let named = |number: i32, name: &str| match proto::Encoding::try_from(number) {
        Ok(proto::Encoding::RawZstd) => Ok(Encoding::RawZstd),
        Ok(proto::Encoding::Png) => Ok(Encoding::Png { tone_map }),
        Ok(proto::Encoding::Jpeg) => Ok(Encoding::Jpeg { quality, tone_map }),
        Ok(proto::Encoding::Exr) => Ok(Encoding::Exr),
        Ok(proto::Encoding::H264) if !cfg!(feature = "h264") => {
            Err(ApiError::field(format!("{field}.{name}"), "H264, which this server is built without"))
        }
        Ok(proto::Encoding::H264) if delivery == Delivery::Alone => {
            Err(ApiError::field(format!("{field}.{name}"), "H264 is for the streams of Interact and sessions"))
        }
        Ok(proto::Encoding::H264) => Ok(Encoding::H264 { quality, tone_map }),
        Ok(proto::Encoding::Unspecified) | Err(_) => {
            Err(ApiError::field(format!("{field}.{name}"), format!("{number}, RAW_ZSTD, PNG, JPEG, EXR or H264 expected")))
        }
    };
    let encoding = named(message.encoding, "encoding")?;
    let encoding_at_rest = match message.encoding_at_rest {
        0 => None,
        number => Some(named(number, "encoding_at_rest")?),
    };
    let plane = depth_plane(&message, field)?;
    Ok(Output { encoding, encoding_at_rest, depth: message.want_depth.then_some(plane), provenance: message.want_provenance })
}

/// Wrong ones are refused even where no depth is wanted.
fn depth_plane(message: &proto::OutputSettings, field: &str) -> Result<DepthPlane, ApiError> {
    let format = match proto::DepthFormat::try_from(message.depth_format) {
        Ok(proto::DepthFormat::Unspecified | proto::DepthFormat::Float32) => DepthFormat::Float32,
        Ok(proto::DepthFormat::Inverse16) => DepthFormat::Inverse16,
        Err(_) => {
            let problem = format!("{}, FLOAT_32 or INVERSE_16 expected", message.depth_format);
            return Err(ApiError::field(format!("{field}.depth_format"), problem));
        }
    };
    let step = count(message.depth_step, 1, 1, MAX_STEP, &format!("{field}.depth_step"))?;
    Ok(DepthPlane { format, step })
}

/// Clipped at white, or with γ never.
fn tone_map(message: &proto::OutputSettings, field: &str) -> Result<ToneMap, ApiError> {
    let stops = within(message.exposure_stops, -MAX_EXPOSURE_STOPS, MAX_EXPOSURE_STOPS, &format!("{field}.exposure_stops"))?;
    let gamma = within(message.exposure_gamma, 0.0, MAX_EXPOSURE_GAMMA, &format!("{field}.exposure_gamma"))?;
    if gamma == 0.0 {
        return Ok(ToneMap::Clamp(Exposure::new(stops.exp2()).expect("stops were checked")));
    }
    let exposure = Exposure::new(gamma * stops.exp2()).ok_or_else(|| {
        let problem = format!("{gamma} · 2^{stops}, a product of 2^−{MAX_EXPOSURE_STOPS} to 2^{MAX_EXPOSURE_STOPS} expected");
        ApiError::field(format!("{field}.exposure_gamma"), problem)
    });
    exposure.map(ToneMap::Exponential)
}

/// On the wire.
pub fn encoding_number(encoding: Encoding) -> i32 {
    (match encoding {
        Encoding::RawZstd => proto::Encoding::RawZstd,
        Encoding::Png { .. } => proto::Encoding::Png,
        Encoding::Jpeg { .. } => proto::Encoding::Jpeg,
        Encoding::Exr => proto::Encoding::Exr,
        Encoding::H264 { .. } => proto::Encoding::H264,
    }) as i32
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(component: i32, blend: i32) -> proto::OffsetSurfaceLightFieldSettings {
        proto::OffsetSurfaceLightFieldSettings {
            component,
            blend,
            exponent: None,
            specular_reflectance: None,
            filter: 0,
            gloss: None,
            relighting: None,
            reflections: 0,
            refraction: None,
            normal_map: None,
        }
    }

    #[test]
    fn normal_maps_have_defaults_and_are_refused_by_field() {
        use proto::offset_surface_light_field_settings::NormalMap;
        let image = ContentHash([0xab; 32]).to_string();
        let of = |image: &str, strength, repeat, message: proto::OffsetSurfaceLightFieldSettings| {
            let normal_map = Some(NormalMap { image: image.into(), strength, repeat });
            oslf_settings(proto::OffsetSurfaceLightFieldSettings { normal_map, ..message }, "s")
        };
        let bumps = of(&image, None, None, message(2, 1)).unwrap().bumps.unwrap();
        assert_eq!(bumps, oslf::Bumps { map: ContentHash([0xab; 32]), mapping: Mapping { strength: 1.0, repeat: 1.0 } });
        assert_eq!(
            of(&image, Some(-0.5), Some(3.0), message(3, 1)).unwrap().bumps.unwrap().mapping,
            Mapping { strength: -0.5, repeat: 3.0 }
        );
        for (image, strength, repeat, problem) in [
            ("12", None, None, "s.normal_map.image: "),
            (&*image, Some(f32::NAN), None, "s.normal_map.strength: NaN, -16 to 16 expected"),
            (&*image, Some(17.0), None, "s.normal_map.strength: 17,"),
            (&*image, None, Some(0.0), "s.normal_map.repeat: 0, 0.001 to 4096 expected"),
            (&*image, None, Some(f32::INFINITY), "s.normal_map.repeat: inf,"),
        ] {
            let error = of(image, strength, repeat, message(2, 1)).unwrap_err().to_string();
            assert!(error.starts_with(problem), "{error}");
        }
        let refused = |message| of(&image, None, None, message).unwrap_err().to_string();
        assert!(refused(message(1, 0)).starts_with("s.normal_map: a normal map with reconstruction"));
        let refraction = Some(proto::offset_surface_light_field_settings::Refraction { index: None, body: 0 });
        assert!(refused(proto::OffsetSurfaceLightFieldSettings { refraction, ..message(5, 1) }).contains("with refraction"));
        let twice = proto::OffsetSurfaceLightFieldSettings { reflections: 2, ..message(2, 1) };
        assert!(refused(twice).starts_with("s.normal_map: a normal map with 2 reflections"));
    }

    #[test]
    fn unknown_components_and_blends_are_refused_by_field() {
        let refused = |c, b| oslf_settings(message(c, b), "s").unwrap_err().to_string();
        assert!(refused(0, 1).starts_with("s.component: 0"));
        assert!(refused(9, 1).starts_with("s.component: 9"));
        assert!(refused(2, 0).starts_with("s.blend: 0"));
        assert!(refused(3, 77).starts_with("s.blend: 77"));
        assert!(refused(4, 1).starts_with("s.gloss"));
        let glossy = |brdf: &str, directions| {
            let gloss =
                proto::offset_surface_light_field_settings::Gloss { brdf: brdf.into(), directions, passes: 0, order: 0, integration: 0 };
            oslf_settings(proto::OffsetSurfaceLightFieldSettings { gloss: Some(gloss), ..message(4, 1) }, "s")
        };
        let lambert = r#"{"model": "lambert", "albedo": [0.5, 0.5, 0.5]}"#;
        assert!(matches!(glossy(lambert, 0).unwrap().component, oslf::Component::Glossy(oslf::Gloss { directions: 64, .. })));
        assert!(glossy(lambert, 5000).unwrap_err().to_string().starts_with("s.gloss.directions: 5000, 1 to 4096"));
        for (bad, problem) in [
            ("", "EOF"),
            (&" ".repeat(3000), "3000 bytes"),
            (r#"{"model": "velvet"}"#, "unknown variant `velvet`"),
            (r#"{"model": "lambert", "albedo": [0.5, 1.5, 0.5]}"#, "albedo"),
            (r#"{"model": "measured"}"#, "missing field `table`"),
            (r#"{"model": "measured", "table": "12"}"#, "64"),
            (r#"{"model": "measured", "file": "a.binary", "table": ""}"#, "unknown field `file`"),
            (r#"{"model": "lambert", "albedo": [0.5, 0.5, 0.5], "gloss": 1}"#, "unknown field"),
        ] {
            let error = glossy(bad, 1).unwrap_err().to_string();
            assert!(error.starts_with("s.gloss.brdf: ") && error.contains(problem), "{error}");
        }
        let table = format!(r#"{{"model": "measured", "table": "{}"}}"#, ContentHash([0xab; 32]));
        let oslf::Component::Glossy(gloss) = glossy(&table, 1).unwrap().component else { panic!("glossy") };
        assert_eq!((gloss.brdf.table(), gloss.order), (Some(ContentHash([0xab; 32])), oslf::Order::BlendFirst));
        let ordered = |order| {
            let gloss =
                proto::offset_surface_light_field_settings::Gloss { brdf: lambert.into(), directions: 1, passes: 0, order, integration: 0 };
            oslf_settings(proto::OffsetSurfaceLightFieldSettings { gloss: Some(gloss), ..message(4, 1) }, "s")
        };
        assert_eq!(ordered(2).unwrap().order(), Some(oslf::Order::IntegrateFirst));
        assert!(ordered(3).unwrap_err().to_string().starts_with("s.gloss.order: 3, BLEND_FIRST"));
        let sharper = proto::OffsetSurfaceLightFieldSettings { filter: 9, ..message(1, 0) };
        assert!(oslf_settings(sharper, "s").unwrap_err().to_string().starts_with("s.filter: 9"));
        let nan = proto::OffsetSurfaceLightFieldSettings { exponent: Some(f32::NAN), ..message(2, 4) };
        assert!(oslf_settings(nan, "s").unwrap_err().to_string().starts_with("s.exponent: NaN"));
        let bright = proto::OffsetSurfaceLightFieldSettings {
            specular_reflectance: Some(proto::Vector3 { x: 1.0, y: 1.5, z: 0.0 }),
            ..message(2, 4)
        };
        assert!(oslf_settings(bright, "s").unwrap_err().to_string().starts_with("s.specular_reflectance.y: 1.5"));
        let with = |reflections| oslf_settings(proto::OffsetSurfaceLightFieldSettings { reflections, ..message(2, 5) }, "s");
        assert_eq!([0, 1, 4].map(|n| with(n).unwrap().reflections), [1, 1, 4]);
        assert!(with(5).unwrap_err().to_string().starts_with("s.reflections: 5, 1 to 4 expected"));
    }

    #[test]
    fn a_highlight_is_gathered_as_asked_or_as_suits_it() {
        use oslf::Integration::{MonteCarlo, Prefiltered};
        let of = |brdf: &str, directions, filter, integration| {
            let gloss =
                proto::offset_surface_light_field_settings::Gloss { brdf: brdf.into(), directions, passes: 7, order: 0, integration };
            let field = proto::OffsetSurfaceLightFieldSettings { gloss: Some(gloss), filter, ..message(4, 1) };
            let representation = Some(proto::render_settings::Representation::OffsetSurfaceLightField(field));
            let settings = render_settings(Some(proto::RenderSettings { representation, ..Default::default() }), "s")?;
            Ok::<_, ApiError>((settings.settings.gloss().unwrap().integration, settings.passes))
        };
        let ggx = |alpha: f32| format!(r#"{{"model": "cook_torrance", "alpha_x": {alpha}, "alpha_y": {alpha}, "f0": [0.9, 0.9, 0.9]}}"#);
        let (narrow, wide, matt) = (&ggx(0.005), &ggx(0.3), r#"{"model": "lambert", "albedo": [0.5, 0.5, 0.5]}"#);
        // (directions, filter, integration); one look is one pass.
        for (brdf, (directions, filter, integration), expected) in [
            (narrow.as_str(), (0, 0, 0), (Prefiltered, 1)),
            (narrow, (0, 1, 0), (Prefiltered, 1)),
            (narrow, (8, 0, 0), (MonteCarlo, 7)),
            (narrow, (0, 2, 0), (MonteCarlo, 7)),
            (narrow, (0, 0, 1), (MonteCarlo, 7)),
            (wide, (0, 0, 0), (MonteCarlo, 7)),
            (wide, (8, 0, 2), (Prefiltered, 1)),
            (matt, (0, 0, 0), (MonteCarlo, 7)),
        ] {
            assert_eq!(of(brdf, directions, filter, integration).unwrap(), expected, "{brdf} {directions} {filter} {integration}");
        }
        for (brdf, (filter, integration), problem) in [
            (narrow.as_str(), (2, 2), "PREFILTERED with the filter BILINEAR"),
            (matt, (0, 2), "PREFILTERED for such a BRDF"),
            (narrow, (0, 3), "3, MONTE_CARLO or PREFILTERED expected"),
        ] {
            let error = of(brdf, 0, filter, integration).unwrap_err().to_string();
            assert!(error.starts_with(&format!("s.offset_surface_light_field.gloss.integration: {problem}")), "{error}");
        }
    }

    #[test]
    fn a_clear_body_has_an_index_from_one_to_four() {
        use proto::offset_surface_light_field_settings::Refraction;
        let with =
            |refraction| oslf_settings(proto::OffsetSurfaceLightFieldSettings { refraction, ..message(5, 7) }, "s").map(|s| s.component);
        let glass = oslf::Component::Refraction(Dielectric::new(1.5, Body::Solid).unwrap());
        assert_eq!(with(Some(Refraction { index: None, body: 0 })).unwrap(), glass);
        let bubble = oslf::Component::Refraction(Dielectric::new(1.33, Body::Thin).unwrap());
        assert_eq!(with(Some(Refraction { index: Some(1.33), body: 2 })).unwrap(), bubble);
        for (refraction, problem) in [
            (None, "s.refraction"),
            (Some(Refraction { index: Some(0.5), body: 1 }), "s.refraction.index: 0.5"),
            (Some(Refraction { index: Some(f32::NAN), body: 1 }), "s.refraction.index: NaN"),
            (Some(Refraction { index: None, body: 3 }), "s.refraction.body: 3"),
        ] {
            let error = with(refraction).unwrap_err().to_string();
            assert!(error.starts_with(problem), "{error}");
        }
    }

    #[test]
    fn other_light_is_checked_number_by_number() {
        use proto::offset_surface_light_field_settings as oslf_proto;
        let at = |x, y, z| Some(proto::Vector3 { x, y, z });
        let light = |position, intensity| oslf_proto::PointLight { position, intensity };
        let with = |environment_turn_deg, point_lights| {
            let relighting = Some(oslf_proto::Relighting { environment_turn_deg, point_lights });
            oslf_settings(proto::OffsetSurfaceLightFieldSettings { relighting, ..message(1, 0) }, "s").map(|s| s.light)
        };
        let lamp = || light(at(1.0, -2.0, 3.0), at(0.0, 5.0, 6.0));
        let expected = PointLight { position: Vec3::new(1.0, -2.0, 3.0), intensity: Vec3::new(0.0, 5.0, 6.0) };
        assert_eq!(with(-90.0, vec![lamp()]).unwrap(), Relighting::new((-90f32).to_radians(), &[expected]).unwrap());
        assert_eq!(with(0.0, Vec::new()).unwrap(), Relighting::NONE);
        for (turn, lights, problem) in [
            (361.0, vec![], "s.relighting.environment_turn_deg: 361"),
            (f32::NAN, vec![], "s.relighting.environment_turn_deg: NaN"),
            (0.0, vec![lamp(); 5], "s.relighting.point_lights: 5, at most 4"),
            (0.0, vec![lamp(), light(None, at(1.0, 1.0, 1.0))], "s.relighting.point_lights[1].position"),
            (0.0, vec![light(at(0.0, 2e9, 0.0), at(1.0, 1.0, 1.0))], "s.relighting.point_lights[0].position.y: 2000000000"),
            (0.0, vec![light(at(0.0, 0.0, 0.0), None)], "s.relighting.point_lights[0].intensity"),
            (0.0, vec![light(at(0.0, 0.0, 0.0), at(1.0, 1.0, -1.0))], "s.relighting.point_lights[0].intensity.z: -1"),
            (0.0, vec![light(at(0.0, 0.0, 0.0), at(f32::INFINITY, 1.0, 1.0))], "s.relighting.point_lights[0].intensity.x: inf"),
        ] {
            let error = with(turn, lights).unwrap_err().to_string();
            assert!(error.starts_with(problem), "{error}");
        }
    }

    #[test]
    fn passes_are_of_glossy_stills_alone_and_bounded() {
        let with = |component, passes| {
            let brdf = r#"{"model": "lambert", "albedo": [0.5, 0.5, 0.5]}"#.into();
            let gloss = proto::offset_surface_light_field_settings::Gloss { brdf, directions: 0, passes, order: 0, integration: 0 };
            let field = proto::OffsetSurfaceLightFieldSettings { gloss: Some(gloss), ..message(component, 1) };
            let representation = Some(proto::render_settings::Representation::OffsetSurfaceLightField(field));
            render_settings(Some(proto::RenderSettings { representation, ..Default::default() }), "s").map(|s| s.passes)
        };
        assert_eq!([with(4, 0).unwrap(), with(4, 1).unwrap(), with(4, 256).unwrap(), with(2, 9999).unwrap()], [1, 1, 256, 1]);
        let error = with(4, 257).unwrap_err().to_string();
        assert_eq!(error, "s.offset_surface_light_field.gloss.passes: 257, 1 to 256 expected");
    }

    #[test]
    fn a_reconstruction_needs_no_blend_and_the_exponent_defaults_to_four() {
        assert_eq!(oslf_settings(message(1, 0), "s").unwrap().component, oslf::Component::Reconstruction);
        assert_eq!(oslf_settings(message(1, 7), "s").unwrap().blend, oslf::Blend::Corrected);
        assert_eq!(oslf_settings(message(2, 5), "s").unwrap().blend, oslf::Blend::Normal { exponent: 4.0 });
        assert_eq!(oslf_settings(message(2, 5), "s").unwrap().specular_reflectance, Vec3::ONE);
        assert_eq!(oslf_settings(message(2, 5), "s").unwrap().filter, oslf::Filter::Footprint);
    }

    #[test]
    fn a_truth_has_its_own_passes_and_only_radiance_has_one() {
        use proto::render_settings::Representation;
        let with = |representation: Representation, paths_per_pixel, passes| {
            let ground_truth = Some(proto::GroundTruth { paths_per_pixel, passes });
            render_settings(Some(proto::RenderSettings { representation: Some(representation), ground_truth, backend: 0 }), "s")
        };
        let field = || Representation::OffsetSurfaceLightField(message(2, 1));
        let map = |show| Representation::ParameterMap(proto::ParameterMapSettings { show });
        for (paths, passes, read) in [(0, 0, (1, 64)), (64, 4096, (64, 4096)), (2, 3, (2, 3))] {
            let settings = with(field(), paths, passes).unwrap();
            assert_eq!((settings.ground_truth.unwrap().paths_per_pixel, settings.passes), read);
        }
        let refusal = |result: Result<RenderSettings, ApiError>| result.unwrap_err().to_string();
        assert_eq!(refusal(with(field(), 65, 0)), "s.ground_truth.paths_per_pixel: 65, 1 to 64 expected");
        assert_eq!(refusal(with(field(), 1, 4097)), "s.ground_truth.passes: 4097, 1 to 4096 expected");
        assert!(with(map(0), 0, 0).is_ok() && with(map(1), 0, 0).is_ok());
        assert!(refusal(with(map(2), 0, 0)).starts_with("s.ground_truth: given for models, RADIANCE expected"));
        assert!(refusal(with(map(3), 0, 0)).starts_with("s.ground_truth: given for flags, RADIANCE expected"));
    }

    #[test]
    fn work_on_what_is_stored_takes_no_truth() {
        let representation = Some(proto::render_settings::Representation::OffsetSurfaceLightField(message(2, 1)));
        let with = |ground_truth| {
            stored_settings(Some(proto::RenderSettings { representation: representation.clone(), ground_truth, backend: 0 }), "s")
        };
        assert!(with(None).is_ok());
        assert!(with(Some(proto::GroundTruth::default())).unwrap_err().to_string().starts_with("s.ground_truth: given, none expected"));
    }

    #[test]
    fn outputs_have_an_encoding_and_a_sensible_quality() {
        let with = |encoding, jpeg_quality, exposure_stops| {
            output(Some(proto::OutputSettings { encoding, jpeg_quality, exposure_stops, ..Default::default() }), Delivery::Stream, "o")
        };
        let twice = ToneMap::Clamp(Exposure::new(2.0).unwrap());
        assert!(matches!(with(3, 0, 1.0).unwrap().encoding, Encoding::Jpeg { tone_map, .. } if tone_map == twice));
        assert!(with(0, 0, 0.0).unwrap_err().to_string().starts_with("o.encoding: 0"));
        assert!(with(6, 0, 0.0).unwrap_err().to_string().starts_with("o.encoding: 6"));
        assert!(with(3, 101, 0.0).unwrap_err().to_string().starts_with("o.jpeg_quality: 101"));
        assert!(with(3, 300, 0.0).unwrap_err().to_string().starts_with("o.jpeg_quality: 300"));
        assert!(with(2, 0, f32::NAN).unwrap_err().to_string().starts_with("o.exposure_stops: NaN"));
        let h264 = |delivery| output(Some(proto::OutputSettings { encoding: 5, ..Default::default() }), delivery, "o").map(|o| o.encoding);
        match h264(Delivery::Stream) {
            Ok(encoding) => {
                assert!(cfg!(feature = "h264") && matches!(encoding, Encoding::H264 { .. }));
                let error = h264(Delivery::Alone).unwrap_err().to_string();
                assert_eq!(error, "o.encoding: H264 is for the streams of Interact and sessions");
            }
            Err(error) => assert_eq!(error.to_string(), "o.encoding: H264, which this server is built without"),
        }
        let at_rest = |encoding_at_rest| {
            let message = proto::OutputSettings { encoding: 3, encoding_at_rest, ..Default::default() };
            output(Some(message), Delivery::Stream, "o").map(|o| o.encoding_at_rest)
        };
        assert_eq!((at_rest(0).unwrap(), at_rest(1).unwrap()), (None, Some(Encoding::RawZstd)));
        assert_eq!(at_rest(9).unwrap_err().to_string(), "o.encoding_at_rest: 9, RAW_ZSTD, PNG, JPEG, EXR or H264 expected");
        let depth = |want_depth, depth_format, depth_step| {
            let message = proto::OutputSettings { encoding: 2, want_depth, depth_format, depth_step, ..Default::default() };
            output(Some(message), Delivery::Stream, "o").map(|o| o.depth)
        };
        assert_eq!(depth(false, 2, 4).unwrap(), None);
        assert_eq!(depth(true, 0, 0).unwrap(), Some(DepthPlane { format: DepthFormat::Float32, step: 1 }));
        assert_eq!(depth(true, 2, 16).unwrap(), Some(DepthPlane { format: DepthFormat::Inverse16, step: 16 }));
        assert_eq!(depth(true, 9, 1).unwrap_err().to_string(), "o.depth_format: 9, FLOAT_32 or INVERSE_16 expected");
        assert_eq!(depth(false, 1, 17).unwrap_err().to_string(), "o.depth_step: 17, 1 to 16 expected");
    }

    #[test]
    fn a_gamma_compresses_instead_of_clipping_and_nonsense_is_refused() {
        let with = |exposure_gamma, exposure_stops| {
            output(Some(proto::OutputSettings { encoding: 2, exposure_gamma, exposure_stops, ..Default::default() }), Delivery::Stream, "o")
        };
        let exponential = |factor| Encoding::Png { tone_map: ToneMap::Exponential(Exposure::new(factor).unwrap()) };
        assert_eq!(with(1.5, 2.0).unwrap().encoding, exponential(6.0));
        assert_eq!(with(0.0, 2.0).unwrap().encoding, Encoding::Png { tone_map: ToneMap::Clamp(Exposure::new(4.0).unwrap()) });
        for bad in [f32::NAN, f32::INFINITY, -1.0, 1001.0] {
            assert!(with(bad, 0.0).unwrap_err().to_string().starts_with("o.exposure_gamma: "), "{bad}");
        }
        // Each fits, their product does not.
        let error = with(1000.0, 30.0).unwrap_err().to_string();
        assert_eq!(error, "o.exposure_gamma: 1000 · 2^30, a product of 2^−30 to 2^30 expected");
        assert!(with(1e-20, 0.0).unwrap_err().to_string().starts_with("o.exposure_gamma: "));
    }
}
