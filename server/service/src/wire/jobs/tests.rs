//! Specifications and their defaults, bounds and refusals; what is remembered of them.

use super::*;

const LIMITS: SpecLimits = SpecLimits { max_pixels: 1_000_000, max_cameras: 3 };

fn capture_message() -> proto::CaptureSpec {
    let builtin = proto::BuiltinScene { name: "gazebo".into(), ..Default::default() };
    proto::CaptureSpec {
        scene: Some(proto::SceneSource { source: Some(proto::scene_source::Source::Builtin(builtin)), environment: None }),
        object: "teapot".into(),
        dataset: "tea".into(),
        ..Default::default()
    }
}

fn refused(change: impl FnOnce(&mut proto::CaptureSpec)) -> String {
    let mut message = capture_message();
    change(&mut message);
    let spec = proto::JobSpec { spec: Some(proto::job_spec::Spec::Capture(message)) };
    job_spec(Some(spec), &LIMITS).unwrap_err().to_string()
}

#[test]
fn a_capture_has_the_documented_defaults() {
    let spec = capture(capture_message(), "c").unwrap();
    assert_eq!((spec.face_size_texels, spec.samples_per_texel, spec.max_bounces, spec.sample_map_size_texels), (128, 64, 8, 256));
    assert_eq!((spec.epsilon, spec.spacing, spec.placing), (None, Spacing::Count(1000), Placing::Uniform));
    assert_eq!((spec.pixel_format, spec.codec), (PixelFormat::F16, Codec::BitsChunk));
}

#[test]
fn a_capture_out_of_range_is_refused_by_field() {
    assert!(refused(|c| c.object.clear()).starts_with("spec.capture.object: missing"));
    assert!(refused(|c| c.dataset = "../x".into()).starts_with("spec.capture.dataset: \"../x\""));
    assert!(refused(|c| c.scene = None).starts_with("spec.capture.scene: missing"));
    assert!(refused(|c| c.offset = f32::NAN).starts_with("spec.capture.offset: NaN"));
    assert!(refused(|c| c.offset = -1.0).starts_with("spec.capture.offset: -1"));
    assert!(refused(|c| c.face_size_texels = 100).contains("a multiple of 16"));
    assert!(refused(|c| c.face_size_texels = 1 << 31).starts_with("spec.capture.face_size_texels"));
    assert!(refused(|c| c.density = Some(proto::capture_spec::Density::SamplePoints(3))).contains("4 to 65534"));
    assert!(refused(|c| c.density = Some(proto::capture_spec::Density::Spacing(0.0))).starts_with("spec.capture.spacing: 0"));
    assert!(refused(|c| c.placing = 4).starts_with("spec.capture.placing: 4, UNIFORM, CURVATURE or ERROR expected"));
    assert!(refused(|c| c.pixel_format = 5).starts_with("spec.capture.pixel_format: 5"));
    assert!(refused(|c| c.codec = 9).starts_with("spec.capture.codec: 9"));
}

#[test]
fn thinning_out_of_range_is_refused_by_field() {
    let good = || proto::ThinSpec {
        dataset: "tea".into(),
        into: "cup".into(),
        max_error: 2.0,
        settings: Some(proto::RenderSettings {
            representation: Some(proto::render_settings::Representation::OffsetSurfaceLightField(proto::OffsetSurfaceLightFieldSettings {
                component: proto::offset_surface_light_field_settings::Component::Mirror.into(),
                blend: proto::offset_surface_light_field_settings::Blend::Corrected.into(),
                ..Default::default()
            })),
            ..Default::default()
        }),
        ..Default::default()
    };
    let spec = thin(good(), "t").unwrap();
    assert_eq!((spec.windows, spec.truth_samples_per_pixel, spec.metric), (4096, 256, ThinMetric::DeltaE));
    let refused = |change: fn(&mut proto::ThinSpec)| {
        let mut message = good();
        change(&mut message);
        thin(message, "t").unwrap_err().to_string()
    };
    assert!(refused(|t| t.max_error = 0.0).starts_with("t.max_error: 0"));
    assert!(refused(|t| t.max_error = f64::NAN).starts_with("t.max_error: NaN"));
    assert!(refused(|t| t.into.clear()).starts_with("t.into"));
    assert!(refused(|t| t.settings = None).starts_with("t.settings"));
    assert!(refused(|t| t.metric = 7).starts_with("t.metric: 7"));
    assert!(refused(|t| t.windows = 5).starts_with("t.windows: 5"));
    assert!(refused(|t| t.codec = 9).starts_with("t.codec: 9"));
    let with_map = |t: &mut proto::ThinSpec| {
        let map = proto::offset_surface_light_field_settings::NormalMap { image: "ab".repeat(32), strength: None, repeat: None };
        let settings = t.settings.as_mut().and_then(|s| s.representation.as_mut());
        let Some(proto::render_settings::Representation::OffsetSurfaceLightField(field)) = settings else { unreachable!("made above") };
        field.normal_map = Some(map);
    };
    assert!(refused(with_map).starts_with("t.settings.normal_map: a normal map, none expected"));
}

#[test]
fn a_replacement_has_the_datasets_own_settings_and_out_of_range_is_refused_by_field() {
    let good = || proto::ReplaceSpec {
        dataset: "tea".into(),
        into: "coffee".into(),
        scene: capture_message().scene,
        object: "cup".into(),
        ..Default::default()
    };
    let spec = replace(good(), "r").unwrap();
    assert_eq!((spec.epsilon, spec.spacing, spec.face_size_texels, spec.sample_map_size_texels), (None, None, None, None));
    assert_eq!((spec.pixel_format, spec.codec, spec.rays_per_texel, spec.placement), (None, Codec::BitsChunk, 16, Placement::NONE));
    let stand_at = Some(proto::Vector3 { x: 1.0, y: 2.0, z: -3.0 });
    let asked = proto::ReplaceSpec {
        placement: Some(proto::ObjectPlacement { stand_at, turn_deg: -90.0, scale: 2.0 }),
        density: Some(proto::replace_spec::Density::Spacing(0.25)),
        face_size_texels: 32,
        sample_map_size_texels: 64,
        pixel_format: proto::PixelFormat::F32.into(),
        ..good()
    };
    let spec = replace(asked, "r").unwrap();
    let expected = Placement { stand_at: Some(glam::Vec3::new(1.0, 2.0, -3.0)), turn_deg: -90.0, scale: 2.0 };
    assert_eq!((spec.placement, spec.spacing), (expected, Some(Spacing::Distance(0.25))));
    assert_eq!((spec.face_size_texels, spec.sample_map_size_texels, spec.pixel_format), (Some(32), Some(64), Some(PixelFormat::F32)));
    let refused = |change: fn(&mut proto::ReplaceSpec)| {
        let mut message = good();
        change(&mut message);
        replace(message, "r").unwrap_err().to_string()
    };
    let placed = |stand_at: [f32; 3], turn_deg: f32, scale: f32| {
        let [x, y, z] = stand_at;
        placement(proto::ObjectPlacement { stand_at: Some(proto::Vector3 { x, y, z }), turn_deg, scale }, "p").unwrap_err().to_string()
    };
    assert!(refused(|r| r.dataset = "../x".into()).starts_with("r.dataset"));
    assert!(refused(|r| r.into.clear()).starts_with("r.into"));
    assert!(refused(|r| r.scene = None).starts_with("r.scene: missing"));
    assert!(refused(|r| r.object.clear()).starts_with("r.object: missing"));
    assert!(refused(|r| r.offset = f32::NAN).starts_with("r.offset: NaN"));
    assert!(refused(|r| r.density = Some(proto::replace_spec::Density::SamplePoints(3))).contains("4 to 65534"));
    assert!(refused(|r| r.density = Some(proto::replace_spec::Density::SamplePoints(0))).starts_with("r.sample_points: 0"));
    assert!(refused(|r| r.density = Some(proto::replace_spec::Density::Spacing(-1.0))).starts_with("r.spacing: -1"));
    assert!(refused(|r| r.face_size_texels = 24).contains("a multiple of 16"));
    assert!(refused(|r| r.face_size_texels = 2048).starts_with("r.face_size_texels: 2048"));
    assert!(refused(|r| r.sample_map_size_texels = 8).starts_with("r.sample_map_size_texels: 8"));
    assert!(refused(|r| r.rays_per_texel = 1025).starts_with("r.rays_per_texel: 1025"));
    assert!(refused(|r| r.pixel_format = 5).starts_with("r.pixel_format: 5"));
    assert!(refused(|r| r.codec = 9).starts_with("r.codec: 9"));
    assert!(placed([f32::NAN, 0.0, 0.0], 0.0, 1.0).starts_with("p.stand_at"));
    assert!(placed([0.0; 3], f32::INFINITY, 1.0).starts_with("p.turn_deg"));
    assert!(placed([0.0; 3], 0.0, -1.0).starts_with("p.scale: -1"));
}

#[test]
fn a_fit_out_of_range_is_refused_by_field() {
    let good = || proto::FitSpec { observations: "seen".into(), dataset: "map".into(), ..Default::default() };
    let spec = fit(good(), "f").unwrap();
    let settings = &spec.settings;
    assert_eq!((settings.outliers, settings.precision, settings.max_bytes), (Outliers::Keep, Precision::Single, None));
    assert_eq!((settings.models, settings.relative_noise, spec.partial), (AllowedModels::Auto, 0.01, None));
    assert_eq!(spec.backend, Backend::Cpu);
    for (asked, backend) in [(proto::Backend::Cpu, Backend::Cpu), (proto::Backend::Gpu, Backend::Gpu)] {
        assert_eq!(fit(proto::FitSpec { backend: asked.into(), ..good() }, "f").unwrap().backend, backend);
    }
    let asked = proto::FitSpec { reject_outliers: true, polish: true, max_bytes: 9, publish_every_seconds: 2.5, ..good() };
    let spec = fit(asked, "f").unwrap();
    let settings = &spec.settings;
    assert_eq!((settings.outliers, settings.precision, settings.max_bytes), (Outliers::Reject, Precision::Polished, Some(9)));
    assert_eq!(spec.partial, Some((Duration::from_millis(2500), "map-partial".into())));
    let refused = |change: fn(&mut proto::FitSpec)| {
        let mut message = good();
        change(&mut message);
        fit(message, "f").unwrap_err().to_string()
    };
    assert!(refused(|f| f.models = "phong:5".into()).starts_with("f.models: models are \"phong:5\""));
    assert!(refused(|f| f.noise_floor = -1.0).starts_with("f.noise_floor: -1"));
    let harmonics = refused(|f| (f.backend, f.models) = (proto::Backend::Gpu.into(), "sh:9".into()));
    assert!(harmonics.starts_with("f.backend: GPU with models sh:9, which have no lobe to fit"), "{harmonics}");
    assert!(refused(|f| (f.backend, f.models) = (proto::Backend::Gpu.into(), "constant".into())).starts_with("f.backend: GPU"));
    assert!(refused(|f| f.backend = 3).starts_with("f.backend: 3, GPU or CPU expected"));
    assert!(refused(|f| f.relative_noise = Some(2.0)).starts_with("f.relative_noise: 2"));
    assert!(refused(|f| f.publish_every_seconds = f32::NAN).starts_with("f.publish_every_seconds: NaN"));
    assert!(refused(|f| f.publish_every_seconds = -1.0).starts_with("f.publish_every_seconds: -1"));
    let long = refused(|f| (f.dataset, f.publish_every_seconds) = ("m".repeat(60), 1.0));
    assert!(long.starts_with("f.publish_every_seconds") && long.contains("-partial"), "{long}");
    let harmonics = refused(|f| (f.models, f.reject_outliers) = ("sh:16".into(), true));
    assert!(harmonics.starts_with("f.reject_outliers") && harmonics.contains("phong:N"), "{harmonics}");
}

#[test]
fn a_photographed_object_has_a_scene_and_a_name_and_no_size_of_its_own() {
    let builtin = proto::BuiltinScene { name: "gazebo".into(), ..Default::default() };
    let scene = proto::SceneSource { source: Some(proto::scene_source::Source::Builtin(builtin)), environment: None };
    let file = proto::SceneFile { path: "transforms.json".into(), blake3: "0".repeat(64) };
    let good = proto::PhotographSet {
        list_path: "transforms.json".into(),
        files: vec![file],
        scene: Some(scene),
        object: "teapot".into(),
        ..Default::default()
    };
    let parsed = |set: proto::PhotographSet| photographs(set, (8, PixelFormat::F32, Codec::DEFAULT), "p");
    let Ok(ObserveSource::Photographs(source)) = parsed(good.clone()) else { panic!() };
    assert_eq!(source.object.as_ref().map(|object| object.name.as_str()), Some("teapot"));
    let refused = |change: fn(&mut proto::PhotographSet)| {
        let mut message = good.clone();
        change(&mut message);
        parsed(message).unwrap_err().to_string()
    };
    assert!(refused(|p| p.scene = None).starts_with("p.scene: missing"));
    assert!(refused(|p| p.object.clear()).starts_with("p.object: missing"));
    assert!(refused(|p| p.height = 2.0).starts_with("p.height: of an object"));
    let Ok(ObserveSource::Photographs(flat)) = parsed(proto::PhotographSet { scene: None, object: String::new(), ..good.clone() }) else {
        panic!()
    };
    assert_eq!(flat.object, None);
}

#[test]
fn a_suggestion_out_of_range_is_refused_by_field() {
    let good = || proto::SuggestSpec { dataset: "map".into(), ..Default::default() };
    let settings = suggest(good(), "s").unwrap().settings;
    assert_eq!((settings.count, settings.candidates.count(), settings.coverage, settings.axis), (8, 305, Coverage::Hemisphere, None));
    let axis = Some(proto::Vector3 { x: 0.0, y: 0.0, z: -2.0 });
    let asked = proto::SuggestSpec { count: 64, candidates: "icosahedron:1249".into(), axis, both_hemispheres: true, ..good() };
    let settings = suggest(asked, "s").unwrap().settings;
    assert_eq!((settings.count, settings.coverage, settings.axis), (64, Coverage::Sphere, Some(-glam::Vec3::Z)));
    let refused = |change: fn(&mut proto::SuggestSpec)| {
        let mut message = good();
        change(&mut message);
        suggest(message, "s").unwrap_err().to_string()
    };
    assert!(refused(|s| s.dataset = "../x".into()).starts_with("s.dataset: \"../x\""));
    assert!(refused(|s| s.count = 65).starts_with("s.count: 65"));
    let scheme = refused(|s| s.candidates = "icosahedron:18".into());
    assert!(scheme.starts_with("s.candidates: ") && scheme.contains("17, 73, 289"), "{scheme}");
    assert!(refused(|s| s.candidates = "stratified:4096:0".into()).starts_with("s.candidates: 4096 directions, at most 2600"));
    let twice = refused(|s| (s.candidates, s.both_hemispheres) = ("stratified:2500:0".into(), true));
    assert!(twice.starts_with("s.candidates: 5000"), "{twice}");
    assert!(refused(|s| s.axis = Some(proto::Vector3::default())).starts_with("s.axis: zero"));
}

#[test]
fn views_are_bounded_in_number_and_size() {
    let list = |n| proto::CameraList { cameras: vec![proto::Camera::default(); n] };
    assert!(cameras(list(0), &LIMITS, "v").unwrap_err().to_string().contains("1 to 3"));
    assert!(cameras(list(4), &LIMITS, "v").unwrap_err().to_string().contains("1 to 3"));
    assert!(cameras(list(1), &LIMITS, "v").unwrap_err().to_string().starts_with("v.cameras[0].intrinsics"));
    let with = |m: proto::OrbitPath| orbit(m, &SpecLimits { max_cameras: 10, ..LIMITS }, "o");
    assert_eq!(with(proto::OrbitPath::default()).unwrap().count, 8);
    assert!(with(proto::OrbitPath { width_px: 2000, height_px: 2000, ..Default::default() }).unwrap_err().to_string().contains("4000000"));
    assert!(with(proto::OrbitPath { distance_radii: 0.5, ..Default::default() }).is_err());
    assert!(with(proto::OrbitPath { elevation_deg: Some(f32::NAN), ..Default::default() }).is_err());
}

#[test]
fn what_is_remembered_pins_the_version() {
    let spec = proto::path_render_spec::Views::Orbit(proto::OrbitPath::default());
    let spec = proto::PathRenderSpec { dataset: "tea".into(), views: Some(spec), ..Default::default() };
    let message = proto::JobSpec { spec: Some(proto::job_spec::Spec::PathRender(spec)) };
    let Some(proto::job_spec::Spec::PathRender(back)) = recalled(&remembered(message, Some(7))).unwrap().spec else { panic!() };
    assert_eq!((back.version, back.dataset.as_str()), (7, "tea"));
    assert!(recalled(&[0xff, 0xff]).is_err());
}

#[test]
fn a_job_that_succeeded_is_whole_whatever_its_last_stage_told() {
    let submission =
        crate::jobs::Submission { kind: "capture", writes: None, request_id: String::new(), asked: String::new(), spec: vec![] };
    let record = crate::jobs::Record::new(1, submission);
    let stage = crate::jobs::Stage { name: "publishing".into(), done: 1, total: 4, ..Default::default() };
    let mut view = crate::jobs::JobView { sequence: 1, at_millis: 0, record, stage };
    use crate::jobs::State;
    let mut fraction = |state, total| {
        (view.record.state, view.stage.total) = (state, total);
        answers::progress(&view).fraction
    };
    assert_eq!([fraction(State::Running, 4), fraction(State::Running, 0), fraction(State::Failed, 4)], [0.25, 0.0, 0.25]);
    assert_eq!([fraction(State::Succeeded, 4), fraction(State::Succeeded, 0)], [1.0; 2]);
}
