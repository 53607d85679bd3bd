//! What to compute and how to return it: flags and the wire's form of them.

use std::path::PathBuf;

use anyhow::Context as _;
use clap::{Args, ValueEnum};
use lumisphere::formats::merl;
use lumisphere_proto::v1alpha1 as wire;
use serde::{Deserialize, Serialize};
use wire::offset_surface_light_field_settings::{
    Blend as WireBlend, Component as WireComponent, Filter as WireFilter, Gloss, PointLight, Refraction, Relighting,
    gloss::{Integration as WireIntegration, Order as WireOrder},
    refraction::Body as WireBody,
};
use wire::parameter_map_settings::Show;
use wire::render_settings::Representation;

use crate::cameras::parse_vec3;
use crate::context::Context;
use crate::exit::Failure;
use crate::normal_map_flags::{self, NormalMapFlags};
use crate::progress::Meter;
use crate::upload::{Blob, upload};

/// What to compute.
#[derive(Debug, Clone, Args)]
pub struct SettingsFlags {
    /// What to show: of an offset surface light field a term of reconstruction + specular · mirror, glossy, or refraction; of a parameter map its radiance,
    /// or which models its texels have, or what their fits say [default: reconstruction, radiance]
    #[arg(long, value_enum)]
    pub component: Option<Component>,
    /// Weights of mirror and full: distance, angle, average, reflection:N, normal:N, environment-map or corrected
    #[arg(long, default_value = "normal:4")]
    pub blend: Blend,
    /// Specular reflectance, each in 0 to 1
    #[arg(long, value_name = "R,G,B", value_parser = parse_vec3, default_value = "1,1,1")]
    pub specular: [f32; 3],
    /// Mirror reflections of mirror and full one after the other, 1 to 4: from the second on the object sees itself as it is shown [default: 1]
    #[arg(long, value_name = "N", default_value_t = 0, hide_default_value = true)]
    pub reflections: u32,
    /// How cube maps are read
    #[arg(long, value_enum, default_value = "footprint")]
    pub filter: Filter,
    /// Where to compute
    #[arg(long, value_enum, default_value = "auto")]
    pub backend: Backend,
    #[command(flatten)]
    pub gloss: GlossFlags,
    #[command(flatten)]
    pub light: LightFlags,
    #[command(flatten)]
    pub clear: ClearFlags,
    #[command(flatten)]
    pub bumps: NormalMapFlags,
    #[command(flatten)]
    pub truth: TruthFlags,
}

/// What frames should look like.
#[derive(Debug, Clone, Default, Args)]
pub struct TruthFlags {
    /// Show ground truth instead: path traced from the scene that the dataset was made from
    #[arg(long)]
    pub truth: bool,
    /// Paths a pixel in each pass of --truth, 1 to 64 [default: 1]
    #[arg(long, value_name = "N", default_value_t = 0, hide_default_value = true, requires = "truth")]
    pub truth_paths: u32,
    /// Passes that a frame of --truth is the mean of, 1 to 4096 [default: 64]
    #[arg(long, value_name = "P", default_value_t = 0, hide_default_value = true, requires = "truth")]
    pub truth_passes: u32,
}

/// What component glossy shows.
#[derive(Debug, Clone, Default, Args)]
pub struct GlossFlags {
    /// BRDF of component glossy, for example {"model": "cook_torrance", "alpha_x": 0.1, "alpha_y": 0.1, "f0": [0.9, 0.7, 0.3]}, or
    /// {"model": "measured", "file": "gold.binary"}, a MERL table, which is uploaded ("table": HASH names one that was)
    #[arg(long, value_name = "JSON")]
    pub brdf: Option<String>,
    /// How the light that it reflects is gathered; auto: as measurements say for it, or by so many --directions [default: auto]
    #[arg(long, value_enum, requires = "brdf")]
    pub integration: Option<Integration>,
    /// Directions drawn from it for each pixel, 1 to 4096 [default: as many as it needs]
    #[arg(long, value_name = "N", default_value_t = 0, hide_default_value = true, requires = "brdf")]
    pub directions: u32,
    /// Passes of so many directions each that a frame is the mean of, 1 to 256 [default: 1]
    #[arg(long, value_name = "P", default_value_t = 0, hide_default_value = true, requires = "brdf")]
    pub passes: u32,
    /// Whether sample points are blended direction by direction, or first integrated one by one, each with directions of its own [default: blend-first]
    #[arg(long, value_enum, requires = "brdf")]
    pub integration_order: Option<Order>,
}

/// Ways of gathering the light that a highlight reflects.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Integration {
    /// As measurements say for the BRDF
    Auto,
    /// By directions drawn from it
    MonteCarlo,
    /// By one look over all of it
    Prefiltered,
}

/// Orders of the double sum over sample points and directions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Order {
    /// Blend, then sum
    BlendFirst,
    /// Sum, then blend
    IntegrateFirst,
}

/// What component refraction shows.
#[derive(Debug, Clone, Default, Args)]
pub struct ClearFlags {
    /// Index of refraction of component refraction, 1 to 4 [default: 1.5]
    #[arg(long, value_name = "INDEX")]
    pub refraction_index: Option<f32>,
    /// What is inside the surface of component refraction [default: solid]
    #[arg(long, value_enum)]
    pub body: Option<Body>,
}

/// Clear bodies.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Body {
    /// The medium
    Solid,
    /// Air: the surface is a thin sheet
    Thin,
}

/// What a frame shows beside the terms of the sum.
#[derive(Debug, Clone, Copy)]
pub struct Looks<'a> {
    /// Of component glossy.
    pub gloss: &'a GlossFlags,
    /// Of every component.
    pub light: &'a LightFlags,
    /// Of component refraction.
    pub clear: &'a ClearFlags,
    /// Of components mirror, full and glossy.
    pub bumps: &'a NormalMapFlags,
    /// Of components mirror and full; 0 is the server's default.
    pub reflections: u32,
}

impl Looks<'static> {
    /// As captured, and nothing glossy or clear.
    pub fn plain() -> Self {
        static GLOSS: GlossFlags = GlossFlags { brdf: None, integration: None, directions: 0, passes: 0, integration_order: None };
        static LIGHT: LightFlags = LightFlags { environment_turn_deg: 0.0, point_light: Vec::new() };
        static CLEAR: ClearFlags = ClearFlags { refraction_index: None, body: None };
        Self { gloss: &GLOSS, light: &LIGHT, clear: &CLEAR, bumps: &NormalMapFlags::NONE, reflections: 0 }
    }
}

/// Light other than was captured.
#[derive(Debug, Clone, Default, Args)]
pub struct LightFlags {
    /// Degrees about +Y by which the light from infinity is turned, -360 to 360 [default: 0]
    #[arg(long, value_name = "DEGREES", default_value_t = 0.0, hide_default_value = true, allow_negative_numbers = true)]
    pub environment_turn_deg: f32,
    /// A point light more: its place and its radiant intensity in W/sr; up to four times
    #[arg(long, value_name = "X,Y,Z:R,G,B", value_parser = parse_point_light, allow_hyphen_values = true)]
    pub point_light: Vec<[[f32; 3]; 2]>,
}

fn parse_point_light(text: &str) -> Result<[[f32; 3]; 2], String> {
    let (position, intensity) = text.split_once(':').ok_or("X,Y,Z:R,G,B expected")?;
    Ok([parse_vec3(position)?, parse_vec3(intensity)?])
}

impl LightFlags {
    fn to_wire(&self) -> Option<Relighting> {
        let vector = |[x, y, z]: [f32; 3]| Some(wire::Vector3 { x, y, z });
        let light = |[position, intensity]: &[[f32; 3]; 2]| PointLight { position: vector(*position), intensity: vector(*intensity) };
        let point_lights: Vec<PointLight> = self.point_light.iter().map(light).collect();
        let is_changed = self.environment_turn_deg != 0.0 || !point_lights.is_empty();
        is_changed.then_some(Relighting { environment_turn_deg: self.environment_turn_deg, point_lights })
    }
}

/// What of a cube map a pixel reads.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Filter {
    /// The mean over what the pixel covers
    Footprint,
    /// The four texels around its centre's direction
    Bilinear,
}

/// Terms.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Component {
    /// The object as captured (diffuse)
    Reconstruction,
    /// The mirror reflection alone
    Mirror,
    /// Both
    Full,
    /// With the BRDF of --brdf
    Glossy,
    /// As a clear body of --refraction-index
    Refraction,
    /// Of a parameter map: what its models say
    Radiance,
    /// Of a parameter map: which model each texel has, as a colour
    Models,
    /// Of a parameter map: unresolved red, clipped green, misfit blue, outliers brighter
    Flags,
}

impl Component {
    /// Which of `blends` make a difference: reconstruction has none, and is shown once; corrected, too, if that is among them.
    pub fn blends(self, blends: &[Blend]) -> Vec<Blend> {
        match self {
            Self::Reconstruction => {
                let corrected = blends.iter().copied().filter(|blend| *blend == Blend::Corrected);
                std::iter::once(Blend::Distance).chain(corrected).collect()
            }
            Self::Mirror | Self::Full | Self::Glossy | Self::Refraction => blends.to_vec(),
            Self::Radiance | Self::Models | Self::Flags => vec![Blend::Distance],
        }
    }
}

/// Where to compute.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Backend {
    /// The GPU if there is one
    Auto,
    /// The graphics adapter
    Gpu,
    /// The readable reference
    Cpu,
}

/// How the four sample points' reflections are weighted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Blend {
    /// The nearest.
    Distance,
    /// The one toward the mirror direction.
    Angle,
    /// Equal.
    Average,
    /// By max(r · ŝ, 0)^N.
    Reflection(f32),
    /// By max(n · ŝ, 0)^N.
    Normal(f32),
    /// The baseline.
    EnvironmentMap,
    /// By the stored distances.
    Corrected,
}

impl std::str::FromStr for Blend {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let exponent = |text: &str| text.parse::<f32>().ok().filter(|n| (0.0..=10_000.0).contains(n));
        let blend = match text.split_once(':') {
            None => match text {
                "distance" => Some(Self::Distance),
                "angle" => Some(Self::Angle),
                "average" => Some(Self::Average),
                "reflection" => Some(Self::Reflection(4.0)),
                "normal" => Some(Self::Normal(4.0)),
                "environment-map" => Some(Self::EnvironmentMap),
                "corrected" => Some(Self::Corrected),
                _ => None,
            },
            Some(("reflection", n)) => exponent(n).map(Self::Reflection),
            Some(("normal", n)) => exponent(n).map(Self::Normal),
            Some(_) => None,
        };
        blend.ok_or_else(|| {
            "distance, angle, average, reflection:N, normal:N (N 0 to 10000), environment-map or corrected expected".to_string()
        })
    }
}

impl SettingsFlags {
    /// The wire's form, for a dataset of this kind.
    pub fn to_wire(&self, kind: &str) -> wire::RenderSettings {
        let default = if kind == "parameter_map" { Component::Radiance } else { Component::Reconstruction };
        let component = self.component.unwrap_or(default);
        let (bumps, reflections) = (&self.bumps, self.reflections);
        let looks = Looks { gloss: &self.gloss, light: &self.light, clear: &self.clear, bumps, reflections };
        let stored = settings(component, self.blend, self.specular, self.filter, self.backend, looks);
        wire::RenderSettings { ground_truth: self.truth.to_wire(), ..stored }
    }
}

/// The same settings after the files of their measured BRDF and normal map were uploaded: they name them by their hashes from then on.
pub async fn with_uploads(mut settings: wire::RenderSettings, context: &Context) -> anyhow::Result<wire::RenderSettings> {
    let Some(Representation::OffsetSurfaceLightField(of_field)) = &mut settings.representation else { return Ok(settings) };
    if let Some(gloss) = &mut of_field.gloss {
        gloss.brdf = named_table(&gloss.brdf, context).await?;
    }
    if let Some(map) = &mut of_field.normal_map {
        map.image = normal_map_flags::uploaded(&map.image, context).await?;
    }
    Ok(settings)
}

/// The same of a BRDF's JSON.
pub async fn named_table(json: &str, context: &Context) -> anyhow::Result<String> {
    let Some(file) = table_file(json) else { return Ok(json.into()) };
    let bytes = std::fs::metadata(&file).with_context(|| format!("cannot read {}", file.display()))?.len();
    if bytes != merl::FILE_BYTES {
        return Err(Failure::Usage(format!("{} has {bytes} bytes, {} expected of a MERL table", file.display(), merl::FILE_BYTES)).into());
    }
    let blob = Blob::from_file(&file)?;
    let mut client = context.connect().await?.datasets();
    let mut meter = Meter::new(context.output);
    upload(context, &mut client, &blob, &mut meter, "uploading the table").await?;
    meter.finish();
    Ok(serde_json::json!({"model": "measured", "table": blob.blake3}).to_string())
}

/// Of `{"model": "measured", "file": FILE}`; everything else is the server's to judge.
pub fn table_file(json: &str) -> Option<PathBuf> {
    let brdf: serde_json::Value = serde_json::from_str(json).ok()?;
    let members = brdf.as_object().filter(|members| members.len() == 2)?;
    (members.get("model")? == "measured").then(|| members.get("file")?.as_str().map(PathBuf::from))?
}

impl TruthFlags {
    /// None where what is stored is shown.
    fn to_wire(&self) -> Option<wire::GroundTruth> {
        self.truth.then_some(wire::GroundTruth { paths_per_pixel: self.truth_paths, passes: self.truth_passes })
    }
}

/// The wire's form.
pub fn settings(
    component: Component,
    blend: Blend,
    specular: [f32; 3],
    filter: Filter,
    backend: Backend,
    Looks { gloss, light, clear, bumps, reflections }: Looks<'_>,
) -> wire::RenderSettings {
    let (blend, exponent) = match blend {
        Blend::Distance => (WireBlend::Distance, None),
        Blend::Angle => (WireBlend::Angle, None),
        Blend::Average => (WireBlend::Average, None),
        Blend::Reflection(n) => (WireBlend::Reflection, Some(n)),
        Blend::Normal(n) => (WireBlend::Normal, Some(n)),
        Blend::EnvironmentMap => (WireBlend::EnvironmentMap, None),
        Blend::Corrected => (WireBlend::Corrected, None),
    };
    let backend: i32 = match backend {
        Backend::Auto => wire::Backend::Unspecified,
        Backend::Gpu => wire::Backend::Gpu,
        Backend::Cpu => wire::Backend::Cpu,
    }
    .into();
    let of_map = |show: Show| {
        let settings = wire::ParameterMapSettings { show: show.into() };
        wire::RenderSettings { representation: Some(Representation::ParameterMap(settings)), ground_truth: None, backend }
    };
    let component = match component {
        Component::Reconstruction => WireComponent::Reconstruction,
        Component::Mirror => WireComponent::Mirror,
        Component::Full => WireComponent::Full,
        Component::Glossy => WireComponent::Glossy,
        Component::Refraction => WireComponent::Refraction,
        Component::Radiance => return of_map(Show::Radiance),
        Component::Models => return of_map(Show::Models),
        Component::Flags => return of_map(Show::Flags),
    };
    let filter = match filter {
        Filter::Footprint => WireFilter::Footprint,
        Filter::Bilinear => WireFilter::Bilinear,
    };
    let [x, y, z] = specular;
    let settings = wire::OffsetSurfaceLightFieldSettings {
        component: component.into(),
        blend: blend.into(),
        exponent,
        specular_reflectance: Some(wire::Vector3 { x, y, z }),
        filter: filter.into(),
        gloss: gloss.brdf.clone().map(|brdf| Gloss {
            brdf,
            directions: gloss.directions,
            passes: gloss.passes,
            integration: match gloss.integration {
                None | Some(Integration::Auto) => WireIntegration::Unspecified,
                Some(Integration::MonteCarlo) => WireIntegration::MonteCarlo,
                Some(Integration::Prefiltered) => WireIntegration::Prefiltered,
            }
            .into(),
            order: match gloss.integration_order {
                None => WireOrder::Unspecified,
                Some(Order::BlendFirst) => WireOrder::BlendFirst,
                Some(Order::IntegrateFirst) => WireOrder::IntegrateFirst,
            }
            .into(),
        }),
        relighting: light.to_wire(),
        reflections,
        normal_map: bumps.to_wire(),
        refraction: (component == WireComponent::Refraction).then(|| Refraction {
            index: clear.refraction_index,
            body: match clear.body {
                None => WireBody::Unspecified,
                Some(Body::Solid) => WireBody::Solid,
                Some(Body::Thin) => WireBody::Thin,
            }
            .into(),
        }),
    };
    wire::RenderSettings { representation: Some(Representation::OffsetSurfaceLightField(settings)), ground_truth: None, backend }
}

/// How frames are returned.
#[derive(Debug, Clone, Args)]
pub struct OutputFlags {
    /// Format of the frames; raw is zstd over rows of R G B little-endian f32
    #[arg(long, value_enum, default_value = "png")]
    pub format: Format,
    /// JPEG quality, 1 to 100
    #[arg(long, value_name = "QUALITY", default_value_t = 90, value_parser = clap::value_parser!(u32).range(1..=100))]
    pub jpeg_quality: u32,
    /// PNG and JPEG show radiance · 2^STOPS
    #[arg(long, value_name = "STOPS", default_value_t = 0.0, allow_negative_numbers = true)]
    pub exposure_stops: f32,
    /// PNG and JPEG show 1 − exp(−GAMMA · radiance · 2^STOPS), which never clips, 0 to 1000; 0 for none
    #[arg(long, value_name = "GAMMA", default_value_t = 0.0)]
    pub gamma: f32,
    /// Also write each pixel's distance (.depth.zst)
    #[arg(long)]
    pub depth: bool,
    /// Also write each pixel's sample and state (.provenance.zst)
    #[arg(long)]
    pub provenance: bool,
}

/// Formats of frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Format {
    /// Linear, lossless
    Exr,
    /// 8-bit sRGB
    Png,
    /// 8-bit sRGB, lossy
    Jpeg,
    /// Linear, lossless, bare
    Raw,
}

impl Format {
    /// Of the files, without dot.
    pub fn extension(self) -> &'static str {
        match self {
            Self::Exr => "exr",
            Self::Png => "png",
            Self::Jpeg => "jpg",
            Self::Raw => "raw.zst",
        }
    }
}

impl OutputFlags {
    /// The wire's form.
    pub fn to_wire(&self) -> wire::OutputSettings {
        let encoding = match self.format {
            Format::Exr => wire::Encoding::Exr,
            Format::Png => wire::Encoding::Png,
            Format::Jpeg => wire::Encoding::Jpeg,
            Format::Raw => wire::Encoding::RawZstd,
        };
        wire::OutputSettings {
            encoding: encoding.into(),
            jpeg_quality: self.jpeg_quality,
            exposure_stops: self.exposure_stops,
            exposure_gamma: self.gamma,
            want_depth: self.depth,
            want_provenance: self.provenance,
            ..Default::default()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lights_are_parsed_and_without_any_nothing_is_sent() {
        assert_eq!(parse_point_light("1,-2,3:4,5,6"), Ok([[1.0, -2.0, 3.0], [4.0, 5.0, 6.0]]));
        for bad in ["1,2,3", "1,2:3,4,5", "1,2,3:4,5", "1,2,3:4,5,6:7", "a,b,c:1,2,3"] {
            assert!(parse_point_light(bad).is_err(), "{bad}");
        }
        assert_eq!(LightFlags::default().to_wire(), None);
        let turned = LightFlags { environment_turn_deg: -30.0, point_light: Vec::new() };
        assert_eq!(turned.to_wire().unwrap().environment_turn_deg, -30.0);
    }

    #[test]
    fn a_table_is_named_by_a_file_and_nothing_else_is() {
        assert_eq!(table_file(r#"{"model": "measured", "file": "a/b.binary"}"#), Some(PathBuf::from("a/b.binary")));
        for other in [
            r#"{"model": "measured", "table": "00"}"#,
            r#"{"model": "lambert", "file": "x"}"#,
            r#"{"model": "measured", "file": 3}"#,
            r#"{"model": "measured", "file": "x", "table": "00"}"#,
            "measured",
        ] {
            assert_eq!(table_file(other), None, "{other}");
        }
    }

    #[test]
    fn blends_are_parsed_with_their_exponents() {
        assert_eq!("reflection:16".parse(), Ok(Blend::Reflection(16.0)));
        assert_eq!("normal".parse(), Ok(Blend::Normal(4.0)));
        for bad in ["reflection:-1", "reflection:NaN", "reflection:", "distance:3", "nearest"] {
            assert!(bad.parse::<Blend>().is_err(), "{bad}");
        }
    }
}
