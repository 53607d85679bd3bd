//! `lumisphere job …`.

mod text;

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};
use lumisphere::directions::Scheme;
use lumisphere::representations::parameter_map::AllowedModels;
use lumisphere::textures::Codec;
use lumisphere_proto::v1alpha1 as wire;
use serde_json::json;
use wire::job_spec::Spec;

use super::dataset::PAGE_SIZE;
use super::download::{Wanted, download};
use super::evaluate::EvaluateFlags;
use super::render::version_of;
use super::watch::{Events, watch};
use crate::byte_sizes::parse_bytes;
use crate::cameras::{CameraFlags, Views, parse_vec3};
use crate::choose_flags::ChooseFlags;
use crate::context::{Context, Server};
use crate::exit::Failure;
use crate::files::{Existing, prepare_folder, safe_name};
use crate::output::table;
use crate::photographs;
use crate::progress::Meter;
use crate::render_settings::{Backend, Blend, Component, Filter, Looks, OutputFlags, SettingsFlags, settings, with_uploads};
use crate::scene_source::{self, SceneFlags};
use crate::views;

/// Verbs.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Queue a job
    #[command(subcommand)]
    Submit(Submit),
    /// All jobs, newest first
    List,
    /// One job
    Get {
        /// Its name
        name: String,
    },
    /// Ask a job to stop
    Cancel {
        /// Its name
        name: String,
    },
    /// Follow a job until it ends; with --json an object a line
    Watch {
        /// Its name
        name: String,
    },
    /// Fetch what a job made
    Download {
        /// Its name
        name: String,
        /// Into this folder
        #[arg(long, value_name = "DIR")]
        out: PathBuf,
        /// Overwrite files
        #[arg(long)]
        force: bool,
    },
}

/// What can be queued.
#[derive(Debug, Subcommand)]
pub enum Submit {
    /// Trace cube maps around an object of a scene and publish them as a version of a dataset
    Capture(Box<CaptureArguments>),
    /// Compare frames with path-traced truth at held-out poses
    Evaluate(Box<EvaluateArguments>),
    /// Render a frame a camera; the frames are the job's results
    PathRender(Box<PathRenderArguments>),
    /// See an object of a scene from many directions; publish what was seen, texel by texel, as an observation map
    Observe(Box<ObserveArguments>),
    /// Resample photographs of a flat surface, or of a scene's object; publish what they show, texel by texel, as an observation map
    Import(ImportArguments),
    /// Fit a model to every texel of an observation map, the smallest that explains it; publish them as a parameter map
    Fit(FitArguments),
    /// Say from which directions a surface should be photographed next, from what a parameter map does not know of it; toward the lamp where that moved (.lp)
    Suggest(SuggestArguments),
    /// Leave out of a dataset what an error bound can do without, and publish the rest as a dataset of its own
    Thin(Box<ThinArguments>),
    /// Put another object where one was captured, into the light that a dataset holds, and publish its light field as a dataset of its own
    Replace(Box<ReplaceArguments>),
}

/// Flags of every submission.
#[derive(Debug, Clone, Args)]
pub struct SubmitFlags {
    /// Follow the job until it ends
    #[arg(long)]
    watch: bool,
    /// Repeating a submission with the same ID answers with the first job
    #[arg(long, value_name = "ID", default_value = "", hide_default_value = true)]
    request_id: String,
}

/// Flags of `submit capture`; what is not given is the server's default.
#[derive(Debug, Args)]
pub struct CaptureArguments {
    #[command(flatten)]
    scene: SceneFlags,
    /// Which object of the scene
    #[arg(long, value_name = "NAME")]
    object: String,
    /// Dataset to add a version to; created when there is none
    #[arg(long, value_name = "NAME")]
    dataset: String,
    /// How far sample points are off the surface, scene units [default: half the distance between neighbours]
    #[arg(long, value_name = "LENGTH")]
    epsilon: Option<f32>,
    /// Distance between neighbouring sample points, scene units
    #[arg(long, value_name = "LENGTH", conflicts_with_all = ["points", "choose"])]
    spacing: Option<f32>,
    /// About how many sample points, 4 to 65534 [default: 1000]
    #[arg(long, value_name = "N", conflicts_with = "choose")]
    points: Option<u32>,
    /// Where sample points lie denser
    #[arg(long, value_enum, default_value = "uniform")]
    placing: Placing,
    /// Texels along a cube-map face's edge: 16 to 1024, a multiple of 16 [default: 128]
    #[arg(long, value_name = "N", conflicts_with = "choose")]
    face_size_texels: Option<u32>,
    #[command(flatten)]
    choose: ChooseFlags,
    /// Paths per texel [default: 64]
    #[arg(long, value_name = "N")]
    samples_per_texel: Option<u32>,
    /// Surface interactions of a path, 1 (direct light) to 64 [default: 8]
    #[arg(long, value_name = "N")]
    max_bounces: Option<u32>,
    /// Texels along the edge of a sample map, 16 to 1024 [default: 256]
    #[arg(long, value_name = "N")]
    sample_map_size_texels: Option<u32>,
    /// What the object looks like meanwhile: its diffuse part alone, or as its materials say
    #[arg(long, value_enum, default_value = "diffuse")]
    original: Original,
    /// Of stored pages
    #[arg(long, value_enum, default_value = "f16")]
    pixel_format: PixelFormat,
    /// Of stored pages; the sequential ones have any row only after all before it
    #[arg(long, value_name = "CODEC", default_value_t = Codec::DEFAULT)]
    codec: Codec,
    /// Of the random numbers
    #[arg(long, default_value_t = 0)]
    seed: u64,
    #[command(flatten)]
    submit: SubmitFlags,
}

/// Where sample points lie denser.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Placing {
    /// Nowhere
    Uniform,
    /// Where the surface bends
    Curvature,
    /// Where a small pilot capture cannot tell from its other points what one of them sees
    Error,
}

impl Placing {
    fn to_wire(self) -> wire::Placing {
        match self {
            Self::Uniform => wire::Placing::Uniform,
            Self::Curvature => wire::Placing::Curvature,
            Self::Error => wire::Placing::Error,
        }
    }
}

/// What an object looks like while it is captured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Original {
    /// Its diffuse part: can be shown in other light and with a mirror over it
    Diffuse,
    /// Highlights and all: blends that favour the view direction show them
    AsAuthored,
}

impl Original {
    fn to_wire(self) -> wire::Original {
        match self {
            Self::Diffuse => wire::Original::Diffuse,
            Self::AsAuthored => wire::Original::AsAuthored,
        }
    }
}

/// How stored pages hold numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum PixelFormat {
    /// Half precision
    F16,
    /// As traced, lossless
    F32,
}

impl PixelFormat {
    fn to_wire(self) -> wire::PixelFormat {
        match self {
            Self::F16 => wire::PixelFormat::F16,
            Self::F32 => wire::PixelFormat::F32,
        }
    }
}

/// Flags of `submit evaluate`.
#[derive(Debug, Args)]
pub struct EvaluateArguments {
    #[command(flatten)]
    evaluate: EvaluateFlags,
    #[command(flatten)]
    submit: SubmitFlags,
}

/// Flags of `submit path-render`.
#[derive(Debug, Args)]
pub struct PathRenderArguments {
    /// Dataset to render
    #[arg(long, value_name = "NAME")]
    dataset: String,
    /// Which version [default: the latest]
    #[arg(long, default_value_t = 0, hide_default_value = true)]
    version: u64,
    #[command(flatten)]
    cameras: CameraFlags,
    #[command(flatten)]
    settings: SettingsFlags,
    #[command(flatten)]
    output: OutputFlags,
    #[command(flatten)]
    submit: SubmitFlags,
}

/// Flags of `submit thin`.
#[derive(Debug, Args)]
pub struct ThinArguments {
    /// Dataset to thin
    #[arg(long, value_name = "NAME")]
    dataset: String,
    /// Which version [default: the latest]
    #[arg(long, default_value_t = 0, hide_default_value = true)]
    version: u64,
    /// Dataset to add the thinned version to; created when there is none
    #[arg(long, value_name = "NAME")]
    into: String,
    /// At most this error, of small windows of pictures from everywhere, against path-traced truth; no less than the dataset's own
    #[arg(long, value_name = "ERROR")]
    max_error: f64,
    /// Which error: mean CIEDE2000 difference, or RMSE of L* / 100
    #[arg(long, value_enum, default_value = "delta-e")]
    metric: ThinMetric,
    /// Of what is shown
    #[arg(long, value_enum, default_value = "mirror")]
    component: Component,
    /// How it is read
    #[arg(long, default_value = "corrected")]
    blend: Blend,
    /// How many windows, 16 to 16384 [default: 4096]
    #[arg(long, value_name = "N")]
    windows: Option<u32>,
    /// Paths per pixel of the windows' truth [default: 256]
    #[arg(long, value_name = "N")]
    truth_samples_per_pixel: Option<u32>,
    /// Of the windows and their truth
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Of stored pages
    #[arg(long, value_name = "CODEC", default_value_t = Codec::DEFAULT)]
    codec: Codec,
    #[command(flatten)]
    submit: SubmitFlags,
}

/// Flags of `submit replace`; what is not given is the dataset's.
#[derive(Debug, Args)]
pub struct ReplaceArguments {
    /// Dataset whose light is used
    #[arg(long, value_name = "NAME")]
    dataset: String,
    /// Which version [default: the latest]
    #[arg(long, default_value_t = 0, hide_default_value = true)]
    version: u64,
    /// Dataset to add the new object's version to; created when there is none
    #[arg(long, value_name = "NAME")]
    into: String,
    /// Where the new object is: a scene that ships with the server, or a file; nothing but the object's mesh and albedo is used
    #[arg(long, value_name = "FILE|NAME")]
    scene: String,
    /// Which object of the scene; it must be diffuse and fit where the old one and its sample points are
    #[arg(long, value_name = "NAME")]
    object: String,
    /// Put the middle of its underside there [default: where its scene has it]
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_vec3, allow_hyphen_values = true)]
    stand_at: Option<[f32; 3]>,
    /// Turn it about +Y
    #[arg(long, value_name = "DEGREES", default_value_t = 0.0, allow_negative_numbers = true)]
    turn_deg: f32,
    /// Grow or shrink it
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0)]
    scale: f32,
    /// How far sample points are off the surface, scene units [default: half the distance between neighbours]
    #[arg(long, value_name = "LENGTH")]
    epsilon: Option<f32>,
    /// Distance between neighbouring sample points, scene units
    #[arg(long, value_name = "LENGTH", conflicts_with = "points")]
    spacing: Option<f32>,
    /// About how many sample points, 4 to 65534
    #[arg(long, value_name = "N")]
    points: Option<u32>,
    /// Texels along a cube-map face's edge: 16 to 1024, a multiple of 16
    #[arg(long, value_name = "N")]
    face_size_texels: Option<u32>,
    /// Rays per texel, made a square number, 1 to 1024 [default: 16]
    #[arg(long, value_name = "N")]
    rays_per_texel: Option<u32>,
    /// Texels along the edge of a sample map, 16 to 1024
    #[arg(long, value_name = "N")]
    sample_map_size_texels: Option<u32>,
    /// Of stored pages
    #[arg(long, value_enum)]
    pixel_format: Option<PixelFormat>,
    /// Of stored pages
    #[arg(long, value_name = "CODEC", default_value_t = Codec::DEFAULT)]
    codec: Codec,
    #[command(flatten)]
    submit: SubmitFlags,
}

/// Flags of `submit observe`; what is not given is the server's default.
#[derive(Debug, Args)]
pub struct ObserveArguments {
    #[command(flatten)]
    scene: SceneFlags,
    /// Which object of the scene
    #[arg(long, value_name = "NAME")]
    object: String,
    /// Dataset to add a version to; created when there is none
    #[arg(long, value_name = "NAME")]
    dataset: String,
    /// Texels along the edge of each of the surface's texture regions, 1 to 4096 [default: 256]
    #[arg(long, value_name = "N")]
    size_texels: Option<u32>,
    /// Where cameras stand: icosahedron:N (17, 73, 289, 305 or 1249), spiral:N:TURNS, latitude-longitude:A,B,... or stratified:N:SEED
    #[arg(long, value_name = "SCHEME", default_value = "icosahedron:73")]
    directions: Scheme,
    /// The scheme's zenith [default: the surface's mean normal, 0,1,0 where it faces all ways]
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_vec3, allow_hyphen_values = true)]
    axis: Option<[f32; 3]>,
    /// Also from the opposite directions
    #[arg(long)]
    both_hemispheres: bool,
    /// Of cameras from the object's centre, in radii of its bounding sphere; above 1 [default: 10]
    #[arg(long, value_name = "RADII", default_value_t = 0.0, hide_default_value = true)]
    distance_radii: f32,
    /// Paths per observation [default: 64]
    #[arg(long, value_name = "N")]
    samples_per_observation: Option<u32>,
    /// Surface interactions of a path, 1 (direct light) to 64 [default: 8]
    #[arg(long, value_name = "N")]
    max_bounces: Option<u32>,
    /// Of stored pages
    #[arg(long, value_enum, default_value = "f32")]
    pixel_format: PixelFormat,
    /// Of stored pages
    #[arg(long, value_name = "CODEC", default_value_t = Codec::DEFAULT)]
    codec: Codec,
    /// Of the random numbers
    #[arg(long, default_value_t = 0)]
    seed: u64,
    #[command(flatten)]
    submit: SubmitFlags,
}

/// Flags of `submit import`; what is not given is the server's default.
#[derive(Debug, Args)]
pub struct ImportArguments {
    /// Which photographs, and from where or under which light each was taken: a lumisphere-photographs/1 .json, RTI's .lp, nerfstudio's
    /// transforms.json, or COLMAP's images.txt beside its cameras.txt. Photographs are found beside it
    #[arg(long, value_name = "LIST")]
    photographs: PathBuf,
    /// Dataset to add a version to; created when there is none
    #[arg(long, value_name = "NAME")]
    dataset: String,
    /// What the photographed object stands in, in the space of the list's cameras: neutral-scene/1 .json, .glb, .gltf or .obj. Its geometry alone
    /// matters; the list is a transforms.json or COLMAP's [default: the photographs show a rectangle]
    #[arg(long, value_name = "FILE|NAME", requires = "object", conflicts_with_all = ["width", "height"])]
    scene: Option<String>,
    /// Which object of the scene was photographed
    #[arg(long, value_name = "NAME", requires = "scene")]
    object: Option<String>,
    /// Of the surface, in the list's unit [default: as the list says, 1 for an .lp list]
    #[arg(long, value_name = "LENGTH", default_value_t = 0.0, hide_default_value = true)]
    width: f32,
    /// Of the surface, in the list's unit [default: as the list says; for an .lp list as its photographs]
    #[arg(long, value_name = "LENGTH", default_value_t = 0.0, hide_default_value = true)]
    height: f32,
    /// How PNG and JPEG hold radiance
    #[arg(long, value_enum, default_value = "srgb")]
    response: Response,
    /// Texels along the surface's edge, 1 to 4096 [default: 256]
    #[arg(long, value_name = "N")]
    size_texels: Option<u32>,
    /// Of stored pages
    #[arg(long, value_enum, default_value = "f32")]
    pixel_format: PixelFormat,
    /// Of stored pages
    #[arg(long, value_name = "CODEC", default_value_t = Codec::DEFAULT)]
    codec: Codec,
    #[command(flatten)]
    submit: SubmitFlags,
}

/// From an 8-bit code to radiance.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Response {
    /// As sRGB decodes
    Srgb,
    /// Proportional to the code
    Linear,
}

/// What fits single lobes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum FitBackend {
    /// The processor
    Cpu,
    /// A graphics adapter: the same but for rounding; an error where there is none
    Gpu,
}

/// Flags of `submit fit`.
#[derive(Debug, Args)]
pub struct FitArguments {
    /// Dataset of kind observation_map
    #[arg(long, value_name = "NAME")]
    observations: String,
    /// Which version of it [default: the latest]
    #[arg(long, default_value_t = 0, hide_default_value = true)]
    version: u64,
    /// Dataset to add the parameter map to; created when there is none
    #[arg(long, value_name = "NAME")]
    dataset: String,
    /// What a texel may have: auto, constant, phong:1 to phong:4, or sh:4, sh:9 ... sh:100
    #[arg(long, value_name = "MODELS", default_value = "auto")]
    model: AllowedModels,
    /// Standard deviation of a dark observation, in units of radiance [default: a 1000th of the mean observation]
    #[arg(long, value_name = "RADIANCE", default_value_t = 0.0, hide_default_value = true)]
    noise_floor: f32,
    /// Standard deviation of an observation beyond that, as a part of it, 0 to 1
    #[arg(long, value_name = "PART", default_value_t = 0.01)]
    relative_noise: f32,
    /// Leave out observations that stand alone against their neighbours: glints, a hand in the picture; not with sh:N
    #[arg(long)]
    robust: bool,
    /// Take the last steps of lobes in double precision: matters for exact data alone
    #[arg(long)]
    polish: bool,
    /// What the version may take at most, such as 20MB: models are smaller where that costs least
    #[arg(long, value_name = "BYTES", value_parser = parse_bytes)]
    max_bytes: Option<u64>,
    /// What fits single lobes; everything else is the CPU's, which stands in for no GPU
    #[arg(long, value_enum, default_value = "cpu")]
    backend: FitBackend,
    /// Publish what is fitted so far as dataset NAME-partial after so many seconds each, later where publishing is slow; it goes when the job has ended
    #[arg(long, value_name = "SECONDS", default_value_t = 0.0, hide_default_value = true)]
    publish_every: f32,
    /// Of stored numbers
    #[arg(long, value_enum, default_value = "f16")]
    pixel_format: PixelFormat,
    /// Of stored pages
    #[arg(long, value_name = "CODEC", default_value_t = Codec::ZstdChunk)]
    codec: Codec,
    #[command(flatten)]
    submit: SubmitFlags,
}

/// Flags of `submit suggest`.
#[derive(Debug, Args)]
pub struct SuggestArguments {
    /// Dataset of kind parameter_map; the observations that it was fitted to must still be there
    #[arg(long, value_name = "NAME")]
    dataset: String,
    /// Which version of it [default: the latest]
    #[arg(long, default_value_t = 0, hide_default_value = true)]
    version: u64,
    /// How many directions, 1 to 64
    #[arg(long, value_name = "N", default_value_t = 8)]
    count: u32,
    /// Directions to choose from: icosahedron:N (17, 73, 289, 305 or 1249), spiral:N:TURNS, latitude-longitude:A,B,... or stratified:N:SEED
    #[arg(long, value_name = "SCHEME", default_value = "icosahedron:305")]
    candidates: Scheme,
    /// The scheme's zenith [default: the surface's mean normal, 0,1,0 where it faces all ways]
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_vec3, allow_hyphen_values = true)]
    axis: Option<[f32; 3]>,
    /// Also the opposite directions
    #[arg(long)]
    both_hemispheres: bool,
    #[command(flatten)]
    submit: SubmitFlags,
}

/// What is bounded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum ThinMetric {
    /// Mean CIEDE2000 difference; 1 is just noticeable
    DeltaE,
    /// RMSE of L*, divided by 100
    RmseL,
}

/// Runs one.
pub async fn run(command: Command, context: &Context) -> anyhow::Result<()> {
    match command {
        Command::Submit(Submit::Capture(arguments)) => submit_capture(context, &arguments).await,
        Command::Submit(Submit::Evaluate(arguments)) => {
            let server = context.connect().await?;
            let spec = Spec::Evaluate(arguments.evaluate.to_wire(context).await?);
            submit_and_tell(context, &server, spec, &arguments.submit).await
        }
        Command::Submit(Submit::PathRender(arguments)) => submit_path_render(context, &arguments).await,
        Command::Submit(Submit::Thin(arguments)) => submit_thin(context, &arguments).await,
        Command::Submit(Submit::Replace(arguments)) => submit_replace(context, &arguments).await,
        Command::Submit(Submit::Observe(arguments)) => submit_observe(context, &arguments).await,
        Command::Submit(Submit::Import(arguments)) => submit_import(context, &arguments).await,
        Command::Submit(Submit::Fit(arguments)) => submit_fit(context, &arguments).await,
        Command::Submit(Submit::Suggest(arguments)) => submit_suggest(context, &arguments).await,
        Command::List => list(context).await,
        Command::Get { name } => {
            let mut client = context.connect().await?.jobs();
            print_job(context, client.get_job(context.request(wire::GetJobRequest { name })).await?.into_inner())
        }
        Command::Cancel { name } => {
            let mut client = context.connect().await?.jobs();
            print_job(context, client.cancel_job(context.request(wire::CancelJobRequest { name })).await?.into_inner())
        }
        Command::Watch { name } => {
            let server = context.connect().await?;
            let job = watch(context, &server, &name, Events::Print).await?;
            if context.output.is_json() { Ok(()) } else { print_job(context, job) }
        }
        Command::Download { name, out, force } => {
            let server = context.connect().await?;
            let job = server.jobs().get_job(context.request(wire::GetJobRequest { name })).await?.into_inner();
            let files = download_results(context, &server, &job, &out, Existing::from_force(force)).await?;
            let document = json!({"job": job.name, "out": out, "files": files});
            context.output.document(&document, || format!("{} files in {}", files.len(), out.display()))?;
            Ok(())
        }
    }
}

async fn submit_capture(context: &Context, arguments: &CaptureArguments) -> anyhow::Result<()> {
    let chosen = arguments.choose.chosen()?;
    if let Some(chosen) = &chosen {
        context.output.say(&format!("chosen: sample points and face size of {}, dataset {}", chosen.label, chosen.row.dataset));
    }
    let (chosen_density, chosen_face) = chosen.map(|c| c.density()).transpose()?.unzip();
    let server = context.connect().await?;
    let scene = scene_source::to_wire(context, &mut server.datasets(), &arguments.scene).await?;
    let spacing = arguments.spacing.map(wire::capture_spec::Density::Spacing);
    let points = arguments.points.map(wire::capture_spec::Density::SamplePoints);
    if arguments.epsilon.is_some_and(|e| !(e > 0.0)) {
        return Err(Failure::Usage("--epsilon must be positive".into()).into());
    }
    let spec = wire::CaptureSpec {
        scene: Some(scene),
        object: arguments.object.clone(),
        dataset: arguments.dataset.clone(),
        offset: arguments.epsilon.unwrap_or(0.0),
        density: spacing.or(points).or(chosen_density),
        face_size_texels: given(arguments.face_size_texels.or(chosen_face), "face-size-texels")?,
        samples_per_texel: given(arguments.samples_per_texel, "samples-per-texel")?,
        max_bounces: given(arguments.max_bounces, "max-bounces")?,
        sample_map_size_texels: given(arguments.sample_map_size_texels, "sample-map-size-texels")?,
        pixel_format: arguments.pixel_format.to_wire().into(),
        codec: codec_message(arguments.codec).into(),
        seed: arguments.seed,
        original: arguments.original.to_wire().into(),
        placing: arguments.placing.to_wire().into(),
    };
    submit_and_tell(context, &server, Spec::Capture(spec), &arguments.submit).await
}

/// On the wire.
pub fn codec_message(codec: Codec) -> wire::Codec {
    match codec {
        Codec::ZstdChunk => wire::Codec::ZstdChunk,
        Codec::ZstdSeq => wire::Codec::ZstdSeq,
        Codec::LzwSeq => wire::Codec::LzwSeq,
        Codec::BitsChunk => wire::Codec::BitsChunk,
    }
}

async fn submit_thin(context: &Context, arguments: &ThinArguments) -> anyhow::Result<()> {
    let server = context.connect().await?;
    let metric = match arguments.metric {
        ThinMetric::DeltaE => wire::ThinMetric::DeltaE,
        ThinMetric::RmseL => wire::ThinMetric::RmseL,
    };
    let shown = settings(arguments.component, arguments.blend, [1.0; 3], Filter::Footprint, Backend::Auto, Looks::plain());
    let spec = wire::ThinSpec {
        dataset: arguments.dataset.clone(),
        version: arguments.version,
        into: arguments.into.clone(),
        settings: Some(shown),
        max_error: arguments.max_error,
        metric: metric.into(),
        windows: given(arguments.windows, "windows")?,
        truth_samples_per_pixel: given(arguments.truth_samples_per_pixel, "truth-samples-per-pixel")?,
        seed: arguments.seed,
        codec: codec_message(arguments.codec).into(),
    };
    submit_and_tell(context, &server, Spec::Thin(spec), &arguments.submit).await
}

async fn submit_replace(context: &Context, arguments: &ReplaceArguments) -> anyhow::Result<()> {
    let above_zero = |value: f32, flag: &str| match value > 0.0 {
        true => Ok(value),
        false => Err(Failure::Usage(format!("--{flag} is {value}, above 0 expected"))),
    };
    let scale = above_zero(arguments.scale, "scale")?;
    let offset = arguments.epsilon.map(|epsilon| above_zero(epsilon, "epsilon")).transpose()?;
    let server = context.connect().await?;
    let scene = scene_source::to_wire(context, &mut server.datasets(), &SceneFlags::plain(&arguments.scene)).await?;
    let spacing = arguments.spacing.map(wire::replace_spec::Density::Spacing);
    let points = arguments.points.map(wire::replace_spec::Density::SamplePoints);
    let stand_at = arguments.stand_at.map(|[x, y, z]| wire::Vector3 { x, y, z });
    let spec = wire::ReplaceSpec {
        dataset: arguments.dataset.clone(),
        version: arguments.version,
        into: arguments.into.clone(),
        scene: Some(scene),
        object: arguments.object.clone(),
        placement: Some(wire::ObjectPlacement { stand_at, turn_deg: arguments.turn_deg, scale }),
        offset: offset.unwrap_or(0.0),
        density: spacing.or(points),
        face_size_texels: given(arguments.face_size_texels, "face-size-texels")?,
        rays_per_texel: given(arguments.rays_per_texel, "rays-per-texel")?,
        sample_map_size_texels: given(arguments.sample_map_size_texels, "sample-map-size-texels")?,
        pixel_format: arguments.pixel_format.map_or(wire::PixelFormat::Unspecified, PixelFormat::to_wire).into(),
        codec: codec_message(arguments.codec).into(),
    };
    submit_and_tell(context, &server, Spec::Replace(spec), &arguments.submit).await
}

async fn submit_observe(context: &Context, arguments: &ObserveArguments) -> anyhow::Result<()> {
    let server = context.connect().await?;
    let scene = scene_source::to_wire(context, &mut server.datasets(), &arguments.scene).await?;
    let photographs = wire::VirtualPhotographs {
        scene: Some(scene),
        object: arguments.object.clone(),
        directions: arguments.directions.to_string(),
        axis: arguments.axis.map(|[x, y, z]| wire::Vector3 { x, y, z }),
        both_hemispheres: arguments.both_hemispheres,
        distance_radii: arguments.distance_radii,
        samples_per_observation: given(arguments.samples_per_observation, "samples-per-observation")?,
        max_bounces: given(arguments.max_bounces, "max-bounces")?,
        seed: arguments.seed,
    };
    let spec = wire::ObserveSpec {
        source: Some(wire::observe_spec::Source::VirtualPhotographs(photographs)),
        dataset: arguments.dataset.clone(),
        size_texels: given(arguments.size_texels, "size-texels")?,
        pixel_format: arguments.pixel_format.to_wire().into(),
        codec: codec_message(arguments.codec).into(),
    };
    submit_and_tell(context, &server, Spec::Observe(spec), &arguments.submit).await
}

async fn submit_import(context: &Context, arguments: &ImportArguments) -> anyhow::Result<()> {
    let packed = photographs::pack(&arguments.photographs)?;
    let server = context.connect().await?;
    let files = scene_source::upload_files(context, &mut server.datasets(), packed.files).await?;
    let scene = match &arguments.scene {
        Some(scene) => Some(scene_source::to_wire(context, &mut server.datasets(), &SceneFlags::plain(scene)).await?),
        None => None,
    };
    let object = arguments.object.clone().unwrap_or_default();
    let response = match arguments.response {
        Response::Srgb => wire::photograph_set::Response::Srgb,
        Response::Linear => wire::photograph_set::Response::Linear,
    };
    let (list_path, width, height) = (packed.list_path, arguments.width, arguments.height);
    let photographs = wire::PhotographSet { list_path, files, width, height, response: response.into(), scene, object };
    let spec = wire::ObserveSpec {
        source: Some(wire::observe_spec::Source::Photographs(photographs)),
        dataset: arguments.dataset.clone(),
        size_texels: given(arguments.size_texels, "size-texels")?,
        pixel_format: arguments.pixel_format.to_wire().into(),
        codec: codec_message(arguments.codec).into(),
    };
    submit_and_tell(context, &server, Spec::Observe(spec), &arguments.submit).await
}

async fn submit_fit(context: &Context, arguments: &FitArguments) -> anyhow::Result<()> {
    let server = context.connect().await?;
    let spec = wire::FitSpec {
        observations: arguments.observations.clone(),
        version: arguments.version,
        dataset: arguments.dataset.clone(),
        models: arguments.model.to_string(),
        noise_floor: arguments.noise_floor,
        relative_noise: Some(arguments.relative_noise),
        reject_outliers: arguments.robust,
        polish: arguments.polish,
        max_bytes: match arguments.max_bytes {
            Some(0) => return Err(Failure::Usage("--max-bytes is 0, at least 1 expected".into()).into()),
            other => other.unwrap_or(0),
        },
        publish_every_seconds: arguments.publish_every,
        backend: match arguments.backend {
            FitBackend::Cpu => wire::Backend::Cpu,
            FitBackend::Gpu => wire::Backend::Gpu,
        }
        .into(),
        pixel_format: arguments.pixel_format.to_wire().into(),
        codec: codec_message(arguments.codec).into(),
    };
    submit_and_tell(context, &server, Spec::Fit(spec), &arguments.submit).await
}

async fn submit_suggest(context: &Context, arguments: &SuggestArguments) -> anyhow::Result<()> {
    let server = context.connect().await?;
    let spec = wire::SuggestSpec {
        dataset: arguments.dataset.clone(),
        version: arguments.version,
        count: given(Some(arguments.count), "count")?,
        candidates: arguments.candidates.to_string(),
        axis: arguments.axis.map(|[x, y, z]| wire::Vector3 { x, y, z }),
        both_hemispheres: arguments.both_hemispheres,
    };
    submit_and_tell(context, &server, Spec::Suggest(spec), &arguments.submit).await
}

/// Zero is the wire's "as the server does by default"; somebody who says 0 means 0, which is never valid.
fn given(value: Option<u32>, flag: &str) -> Result<u32, Failure> {
    match value {
        Some(0) => Err(Failure::Usage(format!("--{flag} is 0, at least 1 expected"))),
        other => Ok(other.unwrap_or(0)),
    }
}

async fn submit_path_render(context: &Context, arguments: &PathRenderArguments) -> anyhow::Result<()> {
    let server = context.connect().await?;
    let views = match arguments.cameras.views()? {
        Views::Orbit(orbit) => wire::path_render_spec::Views::Orbit(orbit),
        Views::Cameras(cameras) => wire::path_render_spec::Views::Cameras(camera_list(cameras)),
    };
    let (_, kind) = version_of(context, &server, &arguments.dataset, arguments.version).await?;
    let spec = wire::PathRenderSpec {
        dataset: arguments.dataset.clone(),
        version: arguments.version,
        views: Some(views),
        settings: Some(with_uploads(arguments.settings.to_wire(&kind), context).await?),
        output: Some(arguments.output.to_wire()),
    };
    submit_and_tell(context, &server, Spec::PathRender(spec), &arguments.submit).await
}

/// Names stay here; the wire numbers its cameras.
pub fn camera_list(cameras: Vec<(String, wire::Camera)>) -> wire::CameraList {
    wire::CameraList { cameras: cameras.into_iter().map(|(_, camera)| camera).collect() }
}

async fn submit_and_tell(context: &Context, server: &Server, spec: Spec, flags: &SubmitFlags) -> anyhow::Result<()> {
    let job = submit(context, server, spec, flags.request_id.clone()).await?;
    if !flags.watch {
        return print_job(context, job);
    }
    context.output.say(&format!("submitted {}", job.name));
    print_job(context, watch(context, server, &job.name, Events::Show).await?)
}

/// Queues a job.
pub async fn submit(context: &Context, server: &Server, spec: Spec, request_id: String) -> anyhow::Result<wire::Job> {
    let request = wire::SubmitJobRequest { spec: Some(wire::JobSpec { spec: Some(spec) }), request_id };
    Ok(server.jobs().submit_job(context.request(request)).await?.into_inner())
}

async fn list(context: &Context) -> anyhow::Result<()> {
    let mut client = context.connect().await?.jobs();
    let mut jobs: Vec<views::Job> = Vec::new();
    let mut page_token = String::new();
    loop {
        let page = client.list_jobs(context.request(wire::ListJobsRequest { page_size: PAGE_SIZE, page_token })).await?.into_inner();
        jobs.extend(page.jobs.into_iter().map(views::Job::from));
        page_token = page.next_page_token;
        if page_token.is_empty() {
            break;
        }
    }
    context.output.document(&json!({"jobs": jobs}), || {
        let head = ["NAME", "KIND", "DATASET", "STATE", "DONE", "CREATED"].map(String::from).to_vec();
        let row = |j: &views::Job| {
            let done = j.progress.as_ref().map(|p| format!("{:.0} %", 100.0 * p.fraction)).unwrap_or_default();
            vec![j.name.clone(), j.kind.into(), j.dataset.clone(), j.state.clone(), done, j.create_time.clone().unwrap_or_default()]
        };
        table(&std::iter::once(head).chain(jobs.iter().map(row)).collect::<Vec<_>>(), &[4])
    })?;
    Ok(())
}

fn print_job(context: &Context, job: wire::Job) -> anyhow::Result<()> {
    let job = views::Job::from(job);
    context.output.document(&job, || text::job_text(&job))?;
    Ok(())
}

/// Fetches the job's blobs into the folder and returns their names.
pub async fn download_results(
    context: &Context,
    server: &Server,
    job: &wire::Job,
    out: &std::path::Path,
    existing: Existing,
) -> anyhow::Result<Vec<String>> {
    let result = job.result.as_ref().ok_or_else(|| {
        Failure::Precondition(format!("{} is {}; only a job that succeeded has results", job.name, views::state_name(job.state())))
    })?;
    let names = result.blobs.iter().map(|b| safe_name(&b.name).map(String::from)).collect::<anyhow::Result<Vec<_>>>()?;
    prepare_folder(out, names.iter().cloned(), existing)?;
    let mut client = server.datasets();
    let mut meter = Meter::new(context.output);
    for (blob, name) in result.blobs.iter().zip(&names) {
        let wanted = Wanted { blake3: &blob.blake3, dataset: None, label: name };
        download(context, &mut client, &wanted, &out.join(name), existing, &mut meter).await?;
    }
    meter.finish();
    Ok(names)
}
