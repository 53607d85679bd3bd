//! The file of `evaluate sweep`: axes over captures and settings, checked whole before anything is done (`docs/command-line.md`).

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::ValueEnum;
use lumisphere_proto::v1alpha1 as wire;
use serde::{Deserialize, Serialize};
use toml::Value;
use wire::capture_spec::Density;

use crate::cameras::{OrbitFlags, Size, Views, read_cameras};
use crate::commands::evaluate::Truth;
use crate::commands::job::codec_message;
use crate::exit::Failure;
use crate::normal_map_flags::NormalMapFlags;
use crate::render_settings::{
    Backend, Blend, ClearFlags, Component, Filter, GlossFlags, Integration, LightFlags, Looks, Order, settings, table_file,
};
use crate::scene_source::SceneFlags;
use crate::sections::{Expected, Section, integer, number, text};

/// Most datasets of a sweep.
pub const MAX_DATASETS: usize = 64;
/// Most settings of a sweep: the server's limit for one evaluation.
pub const MAX_SETTINGS: usize = 64;
/// Most rows of a sweep.
pub const MAX_ROWS: usize = 1024;

/// What to sweep over.
#[derive(Debug, Clone)]
pub struct SweepFile {
    /// Datasets that are there.
    pub datasets: Vec<String>,
    /// Datasets that are captured unless they are there.
    pub captures: Vec<Capture>,
    /// What each is evaluated with.
    pub settings: Vec<Setting>,
    /// C_s of all settings.
    pub specular: [f32; 3],
    /// What mirror and full are compared with.
    pub truths: Vec<Truth>,
    /// Held-out views.
    pub views: Views,
    /// Paths per pixel of the truth; 0 is the server's default, here and below.
    pub truth_samples_per_pixel: u32,
    /// Of the truth's paths.
    pub truth_max_bounces: u32,
    /// Of the truth's random numbers.
    pub truth_seed: u64,
    /// Frames whose time counts.
    pub timed_frames_per_view: u32,
}

/// A setting, and how reports name what of it they cannot know from the rendering.
#[derive(Debug, Clone, PartialEq)]
pub struct Setting {
    /// As submitted, but for the file of a measured BRDF.
    pub wire: wire::RenderSettings,
    /// What of it a choice from the sweep needs beside what the report tells.
    pub asked: AskedLooks,
    /// `auto`, `gpu` or `cpu`.
    pub backend: String,
}

impl Setting {
    /// Its BRDF in other words.
    pub fn name_brdf(&mut self, json: &str) {
        self.asked.brdf = Some(json.into());
        if let Some(wire::render_settings::Representation::OffsetSurfaceLightField(field)) = &mut self.wire.representation
            && let Some(gloss) = &mut field.gloss
        {
            gloss.brdf = json.into();
        }
    }
}

/// What a setting shows beside the terms of the sum; in a sweep's rows.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AskedLooks {
    /// As `--brdf`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub brdf: Option<String>,
    /// As `--integration`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub integration: Option<Integration>,
    /// As `--directions`.
    #[serde(skip_serializing_if = "is_zero")]
    pub directions: u32,
    /// As `--integration-order`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub integration_order: Option<Order>,
    /// As `--refraction-index`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub refraction_index: Option<f32>,
    /// As `--reflections`; 0 is the server's default.
    #[serde(skip_serializing_if = "is_zero")]
    pub reflections: u32,
    /// As `--environment-turn-deg`; None: not turned.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub environment_turn_deg: Option<f32>,
}

fn is_zero(number: &u32) -> bool {
    *number == 0
}

impl AskedLooks {
    /// The settings that look so.
    pub fn settings(
        &self,
        component: Component,
        blend: Blend,
        specular: [f32; 3],
        filter: Filter,
        backend: Backend,
    ) -> wire::RenderSettings {
        let gloss = GlossFlags {
            brdf: self.brdf.clone(),
            integration: self.integration,
            directions: self.directions,
            passes: 0,
            integration_order: self.integration_order,
        };
        let light = LightFlags { environment_turn_deg: self.environment_turn_deg.unwrap_or(0.0), point_light: Vec::new() };
        let clear = ClearFlags { refraction_index: self.refraction_index, body: None };
        settings(
            component,
            blend,
            specular,
            filter,
            backend,
            Looks { gloss: &gloss, light: &light, clear: &clear, bumps: &NormalMapFlags::NONE, reflections: self.reflections },
        )
    }
}

/// A capture, but for the scene's upload.
#[derive(Debug, Clone)]
pub struct Capture {
    /// The scene.
    pub scene: SceneFlags,
    /// Without scene and dataset; 0 is the server's default.
    pub spec: wire::CaptureSpec,
    /// Every axis by its name in reports, as it was given.
    pub axes: BTreeMap<&'static str, String>,
}

impl SweepFile {
    /// Reads and checks all of it. Files that it names are relative to its folder.
    pub fn read(path: &Path) -> anyhow::Result<Self> {
        let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
        let folder = path.parent().unwrap_or(Path::new("")).to_path_buf();
        Self::parse(&text, &path.display().to_string(), &folder)
    }

    fn parse(text: &str, place: &str, folder: &Path) -> anyhow::Result<Self> {
        let mut top = Section::of_text(text, place)?;
        let datasets = top.axis("datasets", &Expected { text: "a dataset's name", read: &self::text })?.unwrap_or_default();
        let mut captures = Vec::new();
        for section in top.sections("capture")? {
            captures.extend(capture_axes(section, folder)?);
            if captures.len() > MAX_ROWS {
                break;
            }
        }
        if datasets.is_empty() && captures.is_empty() {
            return Err(top.error("datasets or a table [capture] expected: nothing to evaluate").into());
        }
        let (settings, specular) = setting_axes(top.section("settings")?, folder)?;
        let views = views(top.section("views")?, folder)?;
        let mut truth = top.section("truth")?;
        let truths = truth.axis("kinds", &one_of::<Truth>(&choices::<Truth>()))?.unwrap_or(vec![Truth::OneReflection]);
        let truth_samples_per_pixel = truth.value("samples_per_pixel", &count("1 to 65536", &|v| integer(v, 1, 65_536)))?.unwrap_or(0);
        let truth_max_bounces = truth.value("max_bounces", &count("1 to 64", &|v| integer(v, 1, 64)))?.unwrap_or(0);
        let truth_seed = truth.value("seed", &seed())?.unwrap_or(0);
        truth.finish()?;
        let timed_frames_per_view = top.value("timed_frames_per_view", &count("1 to 1000", &|v| integer(v, 1, 1000)))?.unwrap_or(0);
        let rows = (datasets.len() + captures.len()) * settings.len() * truths.len();
        for (what, n, most) in [
            ("datasets", datasets.len() + captures.len(), MAX_DATASETS),
            ("settings", settings.len(), MAX_SETTINGS),
            ("rows", rows, MAX_ROWS),
        ] {
            if n > most {
                return Err(top.error(&format!("{n} {what} in all combinations, at most {most} expected")).into());
            }
        }
        top.finish()?;
        Ok(Self {
            datasets,
            captures,
            settings,
            specular,
            truths,
            views,
            truth_samples_per_pixel,
            truth_max_bounces,
            truth_seed,
            timed_frames_per_view,
        })
    }

    /// What tells each dataset from the others: of captures, which come first, the axes that vary; of the others the name.
    pub fn variants(&self) -> Vec<BTreeMap<String, String>> {
        let varies = |axis: &str| self.captures.iter().any(|c| c.axes.get(axis) != self.captures[0].axes.get(axis));
        let of_capture = |c: &Capture| {
            let varying = c.axes.iter().filter(|(axis, _)| varies(axis));
            varying.map(|(axis, value)| (axis.to_string(), value.clone())).collect()
        };
        let is_alone = self.captures.is_empty() && self.datasets.len() == 1;
        let named = |name: &String| if is_alone { BTreeMap::new() } else { BTreeMap::from([("dataset".to_string(), name.clone())]) };
        self.captures.iter().map(of_capture).chain(self.datasets.iter().map(named)).collect()
    }
}

fn count<'a>(text: &'a str, read: &'a dyn Fn(&Value) -> Option<u32>) -> Expected<'a, u32> {
    Expected { text, read }
}

fn seed() -> Expected<'static, u64> {
    Expected { text: "a whole number from 0", read: &|v| u64::try_from(v.as_integer()?).ok() }
}

/// "distance, angle or …" of a flag's values.
fn choices<T: ValueEnum>() -> String {
    let names: Vec<String> = T::value_variants().iter().filter_map(|v| Some(v.to_possible_value()?.get_name().to_string())).collect();
    format!("one of {}", names.join(", "))
}

fn one_of<'a, T: ValueEnum>(text: &'a str) -> Expected<'a, T> {
    Expected { text, read: &|v| T::from_str(v.as_str()?, false).ok() }
}

/// Every combination of the table's axes.
fn capture_axes(mut s: Section, folder: &Path) -> anyhow::Result<Vec<Capture>> {
    let required = |values: Option<Vec<String>>, key: &str, s: &Section| values.ok_or_else(|| s.error(&format!("{key} is missing")));
    let scenes = s.axis("scene", &Expected { text: "a file or a built-in scene's name", read: &text })?;
    let scenes = required(scenes, "scene", &s)?;
    let parameters = scene_parameters(s.section("scene_parameters")?)?;
    let environment = s.value("environment", &Expected { text: "a file", read: &text })?.map(|file| folder.join(file));
    let objects = s.axis("object", &Expected { text: "an object's name", read: &text })?;
    let objects = required(objects, "object", &s)?;
    let size = |v: &Value| integer(v, 16, 1024).filter(|n| n % 16 == 0);
    let length = Expected { text: "a positive number", read: &|v: &Value| number(v).filter(|x| *x > 0.0) };
    let points = s.axis("points", &count("4 to 65534", &|v| integer(v, 4, 65_534)))?;
    let spacings = s.axis("spacing", &length)?;
    if points.is_some() && spacings.is_some() {
        return Err(s.error("points and spacing exclude each other").into());
    }
    let densities = points.into_iter().flatten().map(Density::SamplePoints).chain(spacings.into_iter().flatten().map(Density::Spacing));
    let densities: Vec<Option<Density>> = densities.map(Some).collect();
    let formats: &[(&str, wire::PixelFormat)] = &[("f16", wire::PixelFormat::F16), ("f32", wire::PixelFormat::F32)];
    let format = |v: &Value| formats.iter().find(|(name, _)| v.as_str() == Some(name)).map(|(_, format)| *format);
    let epsilons = s.axis("epsilon", &length)?.unwrap_or(vec![0.0]);
    let face_sizes = s.axis("face_size_texels", &count("a multiple of 16 from 16 to 1024", &size))?.unwrap_or(vec![0]);
    let samples = s.axis("samples_per_texel", &count("1 to 65536", &|v| integer(v, 1, 65_536)))?.unwrap_or(vec![0]);
    let bounces = s.axis("max_bounces", &count("1 to 64", &|v| integer(v, 1, 64)))?.unwrap_or(vec![0]);
    let map_sizes = s.axis("sample_map_size_texels", &count("16 to 1024", &|v| integer(v, 16, 1024)))?.unwrap_or(vec![0]);
    let formats =
        s.axis("pixel_format", &Expected { text: "\"f16\" or \"f32\"", read: &format })?.unwrap_or(vec![wire::PixelFormat::Unspecified]);
    let codec = |v: &Value| v.as_str()?.parse().ok().map(codec_message);
    let codec = Expected { text: "\"bits-chunk\", \"zstd-chunk\", \"zstd-seq\" or \"lzw-seq\"", read: &codec };
    let codecs = s.axis("codec", &codec)?.unwrap_or(vec![wire::Codec::Unspecified]);
    let seeds = s.axis("seed", &seed())?.unwrap_or(vec![0]);
    let originals: &[(&str, wire::Original)] = &[("diffuse", wire::Original::Unspecified), ("as-authored", wire::Original::AsAuthored)];
    let original = |v: &Value| originals.iter().find(|(name, _)| v.as_str() == Some(name)).map(|(_, original)| *original);
    let original = Expected { text: "\"diffuse\" or \"as-authored\"", read: &original };
    let originals = s.axis("original", &original)?.unwrap_or(vec![wire::Original::Unspecified]);
    let placings = s.axis("placing", &Expected { text: "\"uniform\", \"curvature\" or \"error\"", read: &placing })?;
    let placings = placings.unwrap_or(vec![wire::Placing::Unspecified]);
    s.finish()?;

    let mut all = vec![wire::CaptureSpec::default()];
    all = crossed(&all, &objects, |c, v| c.object.clone_from(v));
    all = crossed(&all, if densities.is_empty() { &[None] } else { &densities }, |c, v| c.density = *v);
    all = crossed(&all, &epsilons, |c, v| c.offset = *v);
    all = crossed(&all, &face_sizes, |c, v| c.face_size_texels = *v);
    all = crossed(&all, &samples, |c, v| c.samples_per_texel = *v);
    all = crossed(&all, &bounces, |c, v| c.max_bounces = *v);
    all = crossed(&all, &map_sizes, |c, v| c.sample_map_size_texels = *v);
    all = crossed(&all, &formats, |c, v| c.pixel_format = (*v).into());
    all = crossed(&all, &codecs, |c, v| c.codec = (*v).into());
    all = crossed(&all, &seeds, |c, v| c.seed = *v);
    all = crossed(&all, &originals, |c, v| c.original = (*v).into());
    all = crossed(&all, &placings, |c, v| c.placing = (*v).into());
    let scene = |name: &String| SceneFlags {
        scene: placed(name, folder),
        parameters: parameters.clone(),
        environment: environment.clone(),
        environment_scale: 1.0,
        environment_rotation_deg: 0.0,
    };
    let capture = |name: &String, spec: &wire::CaptureSpec| Capture { scene: scene(name), axes: axes(spec), spec: spec.clone() };
    let each = scenes.iter().flat_map(|name| all.iter().map(move |spec| (name, spec)));
    Ok(each.map(|(name, spec)| capture(name, spec)).take(MAX_ROWS + 1).collect())
}

/// Each of `all` with each of `values`; no more than tell that there are too many.
fn crossed<S: Clone, T>(all: &[S], values: &[T], set: impl Fn(&mut S, &T)) -> Vec<S> {
    let with = |one: &S, value: &T| {
        let mut one = one.clone();
        set(&mut one, value);
        one
    };
    all.iter()
        .flat_map(|one| values.iter().map(move |value| (one, value)))
        .map(|(one, value)| with(one, value))
        .take(MAX_ROWS + 1)
        .collect()
}

// "uniform" is what is captured where nothing is said: the same job by the same name.
const PLACINGS: [(&str, wire::Placing); 3] =
    [("uniform", wire::Placing::Unspecified), ("curvature", wire::Placing::Curvature), ("error", wire::Placing::Error)];

fn placing(value: &Value) -> Option<wire::Placing> {
    PLACINGS.iter().find(|(name, _)| value.as_str() == Some(name)).map(|(_, placing)| *placing)
}

fn axes(c: &wire::CaptureSpec) -> BTreeMap<&'static str, String> {
    let format = wire::PixelFormat::try_from(c.pixel_format).unwrap_or_default();
    let density = match c.density {
        Some(Density::SamplePoints(n)) => ("points", n.to_string()),
        Some(Density::Spacing(d)) => ("spacing", d.to_string()),
        None => ("points", "0".into()),
    };
    let all = [
        density,
        ("epsilon", c.offset.to_string()),
        ("face", c.face_size_texels.to_string()),
        ("paths", c.samples_per_texel.to_string()),
        ("bounces", c.max_bounces.to_string()),
        ("map", c.sample_map_size_texels.to_string()),
        ("format", if format == wire::PixelFormat::F32 { "f32".into() } else { "f16".into() }),
        ("codec", if c.codec == 0 { "0".into() } else { c.codec().as_str_name()["CODEC_".len()..].to_lowercase().replace('_', "-") }),
        ("seed", c.seed.to_string()),
        (
            "placing",
            PLACINGS
                .iter()
                .find(|(_, placing)| *placing != wire::Placing::Unspecified && *placing == c.placing())
                .map_or("0", |p| p.0)
                .into(),
        ),
        ("original", if c.original() == wire::Original::AsAuthored { "as-authored".into() } else { "0".into() }),
    ];
    // 0 is what was not given, but for the seed.
    all.into_iter().filter(|(axis, value)| value != "0" || *axis == "seed").collect()
}

/// A file is relative to the sweep's folder; a name is a name.
fn placed(scene: &str, folder: &Path) -> String {
    let is_file = Path::new(scene).extension().is_some() || scene.contains(['/', '\\']);
    if is_file { folder.join(scene).display().to_string() } else { scene.to_string() }
}

fn scene_parameters(s: Section) -> Result<Vec<(String, String)>, Failure> {
    let plain = |v: &Value| match v {
        Value::String(text) => Some(text.clone()),
        Value::Integer(n) => Some(n.to_string()),
        Value::Float(x) => Some(x.to_string()),
        Value::Boolean(b) => Some(b.to_string()),
        _ => None,
    };
    s.all(&Expected { text: "text or a number", read: &plain })
}

/// Looks of each component: axes of their own, those of the light for all.
struct LookAxes {
    glossy: Vec<AskedLooks>,
    refraction: Vec<AskedLooks>,
    mirrors: Vec<AskedLooks>,
    others: Vec<AskedLooks>,
}

impl LookAxes {
    fn read(s: &mut Section, components: &[Component], folder: &Path) -> anyhow::Result<Self> {
        let turn = |v: &Value| number(v).filter(|x| (-360.0..=360.0).contains(x)).map(|x| (x != 0.0).then_some(x));
        let turns = s.axis("environment_turns_deg", &Expected { text: "-360 to 360", read: &turn })?.unwrap_or(vec![None]);
        let index = |v: &Value| number(v).filter(|x| (1.0..=4.0).contains(x)).map(Some);
        let indices = s.axis("refraction_indices", &Expected { text: "1 to 4", read: &index })?;
        let reflections = s.axis("reflections", &count("1 to 4", &|v| integer(v, 1, 4)))?;
        let brdf = s.value("brdf", &Expected { text: "a BRDF's JSON, as --brdf,", read: &text })?;
        let brdf = brdf.map(|json| with_table_in(&json, folder)).transpose()?;
        let integrations = s.axis("integrations", &one_of::<Integration>(&choices::<Integration>()))?;
        let directions = s.axis("directions", &count("1 to 4096", &|v| integer(v, 1, 4096)))?;
        let orders = s.axis("integration_orders", &one_of::<Order>(&choices::<Order>()))?;
        let is_glossy = components.contains(&Component::Glossy);
        if is_glossy != brdf.is_some() {
            return Err(s.error("brdf and the component glossy go together").into());
        }
        for (given, takers, key) in [
            (integrations.is_some(), &[Component::Glossy][..], "integrations"),
            (directions.is_some(), &[Component::Glossy], "directions"),
            (orders.is_some(), &[Component::Glossy], "integration_orders"),
            (indices.is_some(), &[Component::Refraction], "refraction_indices"),
            (reflections.is_some(), &[Component::Mirror, Component::Full], "reflections"),
        ] {
            if given && !takers.iter().any(|component| components.contains(component)) {
                return Err(s.error(&format!("{key} is there, but no component of components takes one")).into());
            }
        }
        let others = crossed(&[AskedLooks::default()], &turns, |looks, turn| looks.environment_turn_deg = *turn);
        let refraction = crossed(&others, &indices.unwrap_or(vec![None]), |looks, index| looks.refraction_index = *index);
        let mirrors = crossed(&others, &reflections.unwrap_or(vec![0]), |looks, n| looks.reflections = *n);
        let integrations: Vec<Option<Integration>> = integrations.map_or(vec![None], |all| all.into_iter().map(Some).collect());
        // One look, or as many directions as it takes, is one setting.
        let takes_directions = |integration: &Option<Integration>| matches!(integration, None | Some(Integration::MonteCarlo));
        if directions.is_some() && !integrations.iter().any(takes_directions) {
            return Err(s.error("directions is there, but no integration of integrations takes some").into());
        }
        let mut glossy = Vec::new();
        for looks in crossed(&others, &integrations, |looks, integration| looks.integration = *integration) {
            let directions = directions.clone().filter(|_| takes_directions(&looks.integration)).unwrap_or(vec![0]);
            glossy.extend(crossed(&[looks], &directions, |looks, n| looks.directions = *n));
        }
        let orders: Vec<Option<Order>> = orders.map_or(vec![None], |orders| orders.into_iter().map(Some).collect());
        glossy = glossy
            .into_iter()
            .flat_map(|looks| {
                let takes_order = looks.integration != Some(Integration::Prefiltered);
                let orders = if takes_order { orders.as_slice() } else { &[None] };
                crossed(&[looks], orders, |looks, order| looks.integration_order = *order)
            })
            .collect();
        glossy.iter_mut().for_each(|looks| looks.brdf.clone_from(&brdf));
        Ok(Self { glossy, refraction, mirrors, others })
    }

    fn of(&self, component: Component) -> &[AskedLooks] {
        match component {
            Component::Glossy => &self.glossy,
            Component::Refraction => &self.refraction,
            Component::Mirror | Component::Full => &self.mirrors,
            _ => &self.others,
        }
    }
}

/// A table's file is relative to the sweep's folder.
fn with_table_in(json: &str, folder: &Path) -> anyhow::Result<String> {
    let Some(file) = table_file(json) else { return Ok(json.into()) };
    let path = folder.join(file);
    let text = path.to_str().with_context(|| format!("{}: a name in UTF-8 expected", path.display()))?;
    Ok(serde_json::json!({"model": "measured", "file": text}).to_string())
}

fn setting_axes(mut s: Section, folder: &Path) -> anyhow::Result<(Vec<Setting>, [f32; 3])> {
    let components = s.axis("components", &one_of::<Component>(&choices::<Component>()))?.unwrap_or(vec![Component::Mirror]);
    let looks = LookAxes::read(&mut s, &components, folder)?;
    // What the flag says, without its last word.
    let blend_text = "".parse::<Blend>().err().unwrap_or_default();
    let blend_text = blend_text.trim_end_matches(" expected");
    let named = |v: &Value| Some((v.as_str()?.to_string(), v.as_str()?.parse::<Blend>().ok()?));
    let blends = s.axis("blends", &Expected { text: blend_text, read: &named })?;
    let exponents = s.axis("exponents", &Expected { text: "0 to 10000", read: &|v| number(v).filter(|n| (0.0..=10_000.0).contains(n)) })?;
    let filters = s.axis("filters", &one_of::<Filter>(&choices::<Filter>()))?.unwrap_or(vec![Filter::Footprint]);
    let backends = s.axis("backends", &one_of::<Backend>(&choices::<Backend>()))?.unwrap_or(vec![Backend::Auto]);
    let unit = |v: &Value| {
        let values: Vec<f32> = v.as_array()?.iter().map(number).collect::<Option<_>>()?;
        <[f32; 3]>::try_from(values).ok().filter(|c| c.iter().all(|x| (0.0..=1.0).contains(x)))
    };
    let specular = s.value("specular", &Expected { text: "[R, G, B], each in 0 to 1,", read: &unit })?.unwrap_or([1.0; 3]);
    let shows_reflection = components.iter().any(|c| *c != Component::Reconstruction);
    let blends = match (blends, shows_reflection) {
        (None, true) => return Err(s.error("blends is missing: mirror and full need them").into()),
        (blends, _) => with_exponents(blends.unwrap_or_default(), exponents, &s)?,
    };
    s.finish()?;
    let mut all = Vec::new();
    for &filter in &filters {
        for &component in &components {
            let of_component = component.blends(&blends).into_iter().flat_map(|blend| looks.of(component).iter().map(move |l| (blend, l)));
            for (blend, asked) in of_component {
                for &backend in &backends {
                    if all.len() > MAX_SETTINGS {
                        return Ok((all, specular));
                    }
                    let name = backend.to_possible_value().map(|v| v.get_name().to_string()).unwrap_or_default();
                    let wire = asked.settings(component, blend, specular, filter, backend);
                    all.push(Setting { wire, asked: asked.clone(), backend: name });
                }
            }
        }
    }
    Ok((all, specular))
}

/// A blend that has an exponent and is written without takes each of `exponents`.
fn with_exponents(blends: Vec<(String, Blend)>, exponents: Option<Vec<f32>>, s: &Section) -> Result<Vec<Blend>, Failure> {
    let Some(exponents) = exponents else { return Ok(blends.into_iter().map(|(_, blend)| blend).collect()) };
    let takes = |text: &str| !text.contains(':') && format!("{text}:1").parse::<Blend>().is_ok();
    if !blends.iter().any(|(text, _)| takes(text)) {
        return Err(s.error("exponents is there, but no blend of blends takes one"));
    }
    let mut all = Vec::new();
    for (text, blend) in blends {
        match takes(&text) {
            true => all.extend(exponents.iter().filter_map(|n| format!("{text}:{n}").parse::<Blend>().ok())),
            false => all.push(blend),
        }
    }
    Ok(all)
}

fn views(mut s: Section, folder: &Path) -> anyhow::Result<Views> {
    let cameras: Option<PathBuf> = s.value("cameras", &Expected { text: "a file", read: &text })?.map(|file| folder.join(file));
    let within = |least: f32, greatest: f32| move |v: &Value| number(v).filter(|x| (least..=greatest).contains(x));
    let orbit = OrbitFlags {
        frames: s.value("frames", &count("1 and more", &|v| integer(v, 1, u32::MAX)))?.unwrap_or(8),
        size: s
            .value("size", &Expected { text: "\"WIDTHxHEIGHT\"", read: &|v| v.as_str()?.parse::<Size>().ok() })?
            .unwrap_or(Size { width_px: 640, height_px: 480 }),
        vfov_deg: s.value("vfov_deg", &Expected { text: "1 to 179", read: &within(1.0, 179.0) })?.unwrap_or(40.0),
        elevation_deg: s.value("elevation_deg", &Expected { text: "-89 to 89", read: &within(-89.0, 89.0) })?.unwrap_or(25.0),
        distance_radii: s.value("distance_radii", &Expected { text: "1 and more", read: &within(1.0, f32::MAX) })?.unwrap_or(3.5),
        azimuth_deg: s.value("azimuth_deg", &Expected { text: "a number", read: &number })?.unwrap_or(0.0),
    };
    s.finish()?;
    match cameras {
        Some(file) => Ok(Views::Cameras(read_cameras(&file)?)),
        None => Ok(Views::Orbit(orbit.to_wire())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LEAST: &str = "[capture]\nscene = \"gazebo\"\nobject = \"teapot\"\n[settings]\nblends = \"distance\"\n";

    fn parse(text: &str) -> Result<SweepFile, String> {
        SweepFile::parse(text, "s.toml", Path::new("folder")).map_err(|e| e.to_string())
    }

    #[test]
    fn every_combination_of_the_axes_is_there_once() {
        let text = "datasets = \"tea\"\ntimed_frames_per_view = 2
            [capture]\nscene = \"gazebo\"\nobject = \"teapot\"\npoints = [40, 160]\nface_size_texels = [32, 64, 128]\nsamples_per_texel = 4
            [settings]\ncomponents = [\"reconstruction\", \"mirror\"]\nblends = [\"distance\", \"normal\", \"reflection:2\"]\nexponents = [1, 16]
            backends = [\"gpu\", \"cpu\"]\n[truth]\nkinds = [\"one-reflection\", \"physical-mirror\"]";
        let file = parse(text).unwrap();
        assert_eq!((file.captures.len(), file.timed_frames_per_view, file.truths.len()), (6, 2, 2));
        // Reconstruction once; distance, normal:1, normal:16, reflection:2; each on two backends.
        assert_eq!(file.settings.len(), 2 * (1 + 4));
        let variants = file.variants();
        assert_eq!(variants[1].iter().map(|(k, v)| format!("{k}={v}")).collect::<Vec<_>>(), ["face=64", "points=40"]);
        assert_eq!(variants[6], BTreeMap::from([("dataset".to_string(), "tea".to_string())]));
    }

    #[test]
    fn what_is_the_same_for_all_is_in_no_name() {
        let file = parse(&LEAST.replace("object", "points = [40, 80]\nobject")).unwrap();
        assert_eq!(file.variants(), ["40", "80"].map(|p| BTreeMap::from([("points".to_string(), p.to_string())])));
        assert_eq!(parse(LEAST).unwrap().variants(), [BTreeMap::new()]);
        // What is usual is the same job, said or not.
        let file = parse(&LEAST.replace("object", "placing = [\"uniform\", \"error\"]\nobject")).unwrap();
        assert_eq!(file.variants(), [BTreeMap::new(), BTreeMap::from([("placing".to_string(), "error".to_string())])]);
        assert_eq!(file.captures[0].spec, parse(LEAST).unwrap().captures[0].spec);
    }

    #[test]
    fn errors_name_key_value_and_expectation_before_anything_is_done() {
        let with = |more: &str| parse(&LEAST.replace("object", &format!("{more}\nobject"))).unwrap_err();
        assert_eq!(
            with("face_size_texels = [32, 100]"),
            "s.toml: capture.face_size_texels is 100, a multiple of 16 from 16 to 1024 expected"
        );
        assert_eq!(with("points = []"), "s.toml: capture.points is empty, at least one value expected (4 to 65534)");
        assert_eq!(with("points = 9\nspacing = 0.5"), "s.toml: capture.points and spacing exclude each other");
        assert_eq!(with("placing = \"dense\""), "s.toml: capture.placing is \"dense\", \"uniform\", \"curvature\" or \"error\" expected");
        assert_eq!(with("epsilon = nan"), "s.toml: capture.epsilon is nan, a positive number expected");
        assert!(with("face_size = 32").starts_with("s.toml: capture.face_size is no key here, one of "));
        assert_eq!(
            parse("[settings]\nblends = \"distance\"").unwrap_err(),
            "s.toml: datasets or a table [capture] expected: nothing to evaluate"
        );
        assert_eq!(parse("datasets = \"a\"").unwrap_err(), "s.toml: settings.blends is missing: mirror and full need them");
        let bad_blend = parse("datasets = \"a\"\n[settings]\nblends = [\"distance\", \"nearest\"]").unwrap_err();
        assert!(
            bad_blend.starts_with("s.toml: settings.blends is \"nearest\", distance, ") && bad_blend.ends_with(" expected"),
            "{bad_blend}"
        );
        let unused = parse("datasets = \"a\"\n[settings]\nblends = \"distance\"\nexponents = 4").unwrap_err();
        assert_eq!(unused, "s.toml: settings.exponents is there, but no blend of blends takes one");
        let missing = parse("[capture]\nscene = \"gazebo\"\n[settings]\nblends = \"distance\"").unwrap_err();
        assert_eq!(missing, "s.toml: capture.object is missing");
        let view = parse(&format!("{LEAST}[views]\nsize = \"big\"")).unwrap_err();
        assert_eq!(view, "s.toml: views.size is \"big\", \"WIDTHxHEIGHT\" expected");
    }

    #[test]
    fn directions_are_of_monte_carlo_alone() {
        let text = "datasets = \"a\"\n[settings]\ncomponents = \"glossy\"\nblends = \"distance\"\nbrdf = \"{}\"\n
            integrations = [\"auto\", \"prefiltered\", \"monte-carlo\"]\ndirections = [8, 16]";
        let asked = |file: SweepFile| file.settings.iter().map(|s| (s.asked.integration, s.asked.directions)).collect::<Vec<_>>();
        let [auto, one_look, drawn] = [Integration::Auto, Integration::Prefiltered, Integration::MonteCarlo].map(Some);
        assert_eq!(asked(parse(text).unwrap()), [(auto, 0), (one_look, 0), (drawn, 8), (drawn, 16)]);
        let none = parse(&text.replace(", \"monte-carlo\"", "")).unwrap_err();
        assert_eq!(none, "s.toml: settings.directions is there, but no integration of integrations takes some");
        let ordered = text.replace("directions = [8, 16]", "directions = 8\nintegration_orders = [\"blend-first\", \"integrate-first\"]");
        // One look knows no order.
        assert_eq!(parse(&ordered).unwrap().settings.len(), 2 + 1 + 2);
        let mirror = parse("datasets = \"a\"\n[settings]\nblends = \"distance\"\nintegrations = \"auto\"").unwrap_err();
        assert_eq!(mirror, "s.toml: settings.integrations is there, but no component of components takes one");
    }

    #[test]
    fn a_sweep_is_bounded() {
        let seeds = |n: u32| format!("seed = {:?}", (0..n).collect::<Vec<_>>());
        let with = |more: &str| parse(&LEAST.replace("object", &format!("{more}\nobject")));
        assert_eq!(with(&seeds(64)).unwrap().captures.len(), 64);
        assert_eq!(with(&seeds(65)).unwrap_err(), "s.toml: 65 datasets in all combinations, at most 64 expected");
    }

    #[test]
    fn the_example_is_a_sweep() {
        let file = parse(include_str!("../../docs/examples/sweep.toml")).unwrap();
        assert!(file.captures.len() * file.settings.len() >= 8);
    }

    #[test]
    fn files_lie_beside_the_sweep_and_names_are_names() {
        assert_eq!(placed("scene.json", Path::new("a")), Path::new("a/scene.json").display().to_string());
        assert_eq!(placed("gazebo", Path::new("a")), "gazebo");
    }
}
