//! What clients must not send: each gets a clear error that names the field or the thing, and nothing is lost.

use std::fs;

use lumisphere_proto::v1alpha1 as wire;
use tonic::{Code, Status};
use wire::offset_surface_light_field_settings::{Blend, Component};

use crate::process::{Server, temporary_folder};
use crate::tiny::{self, DATASET, QUICK};
use crate::wire::{camera, code_and_reason, fields, frame_request, output, settings};

type Change = fn(&mut wire::RenderFrameRequest);

fn pose(request: &mut wire::RenderFrameRequest) -> &mut wire::Pose {
    request.camera.as_mut().unwrap().pose.as_mut().unwrap()
}

fn intrinsics(request: &mut wire::RenderFrameRequest) -> &mut wire::Intrinsics {
    request.camera.as_mut().unwrap().intrinsics.as_mut().unwrap()
}

/// What is wrong, how it is made so, and a part of the field that the error must name.
const BAD_FRAMES: [(&str, Change, &str); 18] = [
    ("no camera", |r| r.camera = None, "camera"),
    ("no pose", |r| r.camera.as_mut().unwrap().pose = None, "pose"),
    ("NaN position", |r| pose(r).position.as_mut().unwrap().x = f32::NAN, "pose"),
    ("infinite position", |r| pose(r).position.as_mut().unwrap().z = f32::INFINITY, "pose"),
    ("scaled axes", |r| pose(r).right.as_mut().unwrap().x = 2.0, "pose"),
    ("mirrored axes", |r| pose(r).right.as_mut().unwrap().x = -1.0, "pose"),
    ("missing axis", |r| pose(r).up = None, "up"),
    ("zero width", |r| intrinsics(r).width_px = 0, "intrinsics"),
    ("zero focal length", |r| intrinsics(r).focal_x_px = 0.0, "intrinsics"),
    ("NaN focal length", |r| intrinsics(r).focal_y_px = f32::NAN, "intrinsics"),
    ("beyond the pixel limit", |r| (intrinsics(r).width_px, intrinsics(r).height_px) = (100_000, 100_000), "intrinsics"),
    ("size that overflows", |r| (intrinsics(r).width_px, intrinsics(r).height_px) = (u32::MAX, u32::MAX), "intrinsics"),
    ("no settings", |r| r.settings = None, "settings"),
    ("unknown component", |r| r.settings = Some(with_component(77)), "component"),
    ("mirror without a blend", |r| r.settings = Some(settings(Component::Mirror, Blend::Unspecified)), "blend"),
    ("unknown encoding", |r| r.output.as_mut().unwrap().encoding = 99, "encoding"),
    ("no encoding", |r| r.output = Some(output(wire::Encoding::Unspecified)), "encoding"),
    ("NaN exposure", |r| r.output.as_mut().unwrap().exposure_stops = f32::NAN, "exposure"),
];

fn with_component(component: i32) -> wire::RenderSettings {
    let mut settings = settings(Component::Full, Blend::Average);
    if let Some(wire::render_settings::Representation::OffsetSurfaceLightField(s)) = &mut settings.representation {
        s.component = component;
    }
    settings
}

#[tokio::test]
async fn a_bad_frame_request_is_refused_with_the_field_and_the_next_one_is_served() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    tiny::capture(&server, folder.path());
    let mut rendering = server.rendering().await;
    for (what, change, field) in BAD_FRAMES {
        let mut request = frame_request(DATASET);
        change(&mut request);
        let status = rendering.render_frame(request).await.expect_err(what);
        assert_eq!(code_and_reason(&status), (Code::InvalidArgument, "FIELD_INVALID".into()), "{what}: {status:?}");
        let named = fields(&status);
        assert!(named.iter().any(|f| f.contains(field)), "{what}: names {named:?}, a field with {field:?} expected");
    }
    let frame = rendering.render_frame(frame_request(DATASET)).await.unwrap().into_inner();
    assert_eq!(frame.width_px, 32);
}

#[tokio::test]
async fn unknown_datasets_versions_and_jobs_are_not_found() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    tiny::capture(&server, folder.path());
    let mut rendering = server.rendering().await;
    let reason = |status: Status| code_and_reason(&status);
    let unknown = rendering.render_frame(frame_request("nothing")).await.unwrap_err();
    assert_eq!(reason(unknown), (Code::NotFound, "DATASET_NOT_FOUND".into()));
    let version = wire::RenderFrameRequest { version: 9, ..frame_request(DATASET) };
    assert_eq!(reason(rendering.render_frame(version).await.unwrap_err()), (Code::NotFound, "VERSION_NOT_FOUND".into()));
    let job = server.jobs().await.get_job(wire::GetJobRequest { name: "job-777777".into() }).await.unwrap_err();
    assert_eq!(reason(job), (Code::NotFound, "JOB_NOT_FOUND".into()));
    let mut datasets = server.datasets().await;
    let page = wire::ListDatasetsRequest { page_size: -1, page_token: String::new() };
    assert_eq!(reason(datasets.list_datasets(page).await.unwrap_err()).0, Code::InvalidArgument);
    for name in ["", "Upper", "../up", "a/b", ".hidden", &"x".repeat(64)] {
        let request = wire::CreateDatasetRequest { name: name.into() };
        assert_eq!(reason(datasets.create_dataset(request).await.unwrap_err()).0, Code::InvalidArgument, "{name:?}");
    }
}

/// A capture of the generated scene; the change makes it bad.
fn capture_spec(change: impl FnOnce(&mut wire::CaptureSpec)) -> wire::SubmitJobRequest {
    let builtin = wire::BuiltinScene { name: "six_colours".into(), parameters: [].into() };
    let scene = wire::SceneSource { source: Some(wire::scene_source::Source::Builtin(builtin)), environment: None };
    let mut spec = wire::CaptureSpec {
        scene: Some(scene),
        object: "anything".into(),
        dataset: "target".into(),
        face_size_texels: 16,
        samples_per_texel: 1,
        max_bounces: 1,
        sample_map_size_texels: 16,
        density: Some(wire::capture_spec::Density::SamplePoints(8)),
        ..Default::default()
    };
    change(&mut spec);
    wire::SubmitJobRequest { spec: Some(wire::JobSpec { spec: Some(wire::job_spec::Spec::Capture(spec)) }), request_id: String::new() }
}

fn builtin(spec: &mut wire::CaptureSpec) -> &mut wire::BuiltinScene {
    match spec.scene.as_mut().and_then(|s| s.source.as_mut()) {
        Some(wire::scene_source::Source::Builtin(builtin)) => builtin,
        other => panic!("{other:?}"),
    }
}

#[tokio::test]
async fn a_bad_job_is_refused_before_it_is_queued() {
    type Bad = (&'static str, fn(&mut wire::CaptureSpec));
    const BAD: [Bad; 14] = [
        ("no scene", |s| s.scene = None),
        ("unknown built-in scene", |s| builtin(s).name = "gazbo".into()),
        ("unknown parameter", |s| builtin(s).parameters = [("colour".into(), "1".into())].into()),
        ("no object", |s| s.object.clear()),
        ("bad dataset name", |s| s.dataset = "No Good".into()),
        ("NaN offset", |s| s.offset = f32::NAN),
        ("negative offset", |s| s.offset = -1.0),
        ("NaN spacing", |s| s.density = Some(wire::capture_spec::Density::Spacing(f32::NAN))),
        ("too many points", |s| s.density = Some(wire::capture_spec::Density::SamplePoints(70_000))),
        ("odd face size", |s| s.face_size_texels = 17),
        ("huge face size", |s| s.face_size_texels = 1 << 20),
        ("unknown pixel format", |s| s.pixel_format = 42),
        ("too many bounces", |s| s.max_bounces = 65),
        ("unknown original", |s| s.original = 3),
    ];
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    let mut jobs = server.jobs().await;
    for (what, change) in BAD {
        let status = jobs.submit_job(capture_spec(change)).await.expect_err(what);
        assert_eq!(status.code(), Code::InvalidArgument, "{what}: {status:?}");
        assert!(!fields(&status).is_empty(), "{what}: no field is named: {status:?}");
    }
    let status = jobs.submit_job(wire::SubmitJobRequest::default()).await.unwrap_err();
    assert_eq!(status.code(), Code::InvalidArgument);
    let listed = jobs.list_jobs(wire::ListJobsRequest::default()).await.unwrap().into_inner();
    assert_eq!(listed.jobs, [], "a refused job is in the list");
}

#[tokio::test]
async fn two_jobs_cannot_write_one_dataset() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    let scene = tiny::write_scene(&folder.path().join("scene"));
    let submit = ["job", "submit", "capture", "--scene", scene.to_str().unwrap(), "--object", "box", "--dataset", DATASET];
    let long = ["--points", "400", "--face-size-texels", "64", "--samples-per-texel", "64"];
    let first = server.json(&[&submit[..], &long].concat());
    let second = server.lumisphere(&[&submit[..], &QUICK, &["--json"]].concat());
    assert_eq!(second.status.code(), Some(7));
    let error: serde_json::Value = serde_json::from_slice(second.stderr.split(|b| *b == b'\n').rfind(|l| !l.is_empty()).unwrap()).unwrap();
    assert_eq!(error["error"]["reason"], "DATASET_BUSY", "{error:#}");
    let mut datasets = server.datasets().await;
    let deleted = datasets.delete_dataset(wire::DeleteDatasetRequest { name: DATASET.into() }).await;
    assert!(deleted.is_err_and(|s| matches!(s.code(), Code::Aborted | Code::NotFound)), "a dataset is deleted under its writer");

    // The first is not hurt: it can be stopped, and then the dataset is free.
    let name = first["name"].as_str().unwrap();
    server.succeed(&["job", "cancel", name]);
    assert_eq!(server.lumisphere(&["job", "watch", name, "--quiet"]).status.code(), Some(6));
    let third = tiny::capture(&server, folder.path());
    assert_eq!(third["state"], "SUCCEEDED");
}

#[test]
fn bad_scenes_are_refused_with_the_file_that_is_wrong() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    let broken = |change: fn(&std::path::Path)| {
        let scene = tiny::write_scene(&folder.path().join("scene"));
        change(scene.parent().unwrap());
        let base =
            ["job", "submit", "capture", "--scene", scene.to_str().unwrap(), "--object", "box", "--dataset", "bad", "--watch", "--quiet"];
        let output = server.lumisphere(&[&base[..], &QUICK].concat());
        (output.status.code().unwrap(), String::from_utf8(output.stderr).unwrap())
    };
    let (code, text) = broken(|f| fs::write(f.join("meshes/box.obj"), "v 0 0 0\nv 1 0 0\nf 1 2 9\n").unwrap());
    assert!(code == 2 && text.contains("box.obj"), "{code} {text}");
    let (code, text) = broken(|f| fs::write(f.join("meshes/box.obj"), "").unwrap());
    assert!(code == 2 && text.contains("box.obj"), "{code} {text}");
    let (code, text) = broken(|f| fs::write(f.join("meshes/floor.obj"), "v 0 0 NaN\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").unwrap());
    assert!(code == 2 && text.contains("floor.obj"), "{code} {text}");
    let (code, text) = broken(|f| fs::remove_file(f.join("meshes/floor.obj")).unwrap());
    assert!(code == 2 && text.contains("floor.obj"), "{code} {text}");
    let (code, text) = broken(|f| {
        let text = fs::read_to_string(f.join("scene.json")).unwrap();
        fs::write(f.join("scene.json"), text.replace("meshes/floor.obj", "../../floor.obj")).unwrap();
    });
    assert!(code == 2 && text.contains("../../floor.obj"), "{code} {text}");
    let (code, text) = broken(|f| {
        let text = fs::read_to_string(f.join("scene.json")).unwrap();
        fs::write(f.join("scene.json"), &text[..text.len() / 2]).unwrap();
    });
    assert!(code == 2 && text.contains("scene.json"), "{code} {text}");
    assert_eq!(server.json(&["job", "list"])["jobs"].as_array().unwrap().len(), 0);
}

#[tokio::test]
async fn a_bundle_that_no_client_of_ours_would_send_is_refused_by_the_server_too() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    let mut jobs = server.jobs().await;
    let absent = "0".repeat(64);
    let bundle = |path: &str, scene_path: &str, hash: &str| {
        let file = wire::SceneFile { path: path.into(), blake3: hash.into() };
        let bundle = wire::SceneBundle { scene_path: scene_path.into(), files: vec![file] };
        wire::SceneSource { source: Some(wire::scene_source::Source::Bundle(bundle)), environment: None }
    };
    for (path, scene_path, hash, code) in [
        ("../scene.json", "../scene.json", absent.as_str(), Code::InvalidArgument),
        ("/scene.json", "/scene.json", absent.as_str(), Code::InvalidArgument),
        ("scene.json", "other.json", absent.as_str(), Code::InvalidArgument),
        ("scene.json", "scene.json", "xyz", Code::InvalidArgument),
        ("scene.json", "scene.json", absent.as_str(), Code::NotFound),
    ] {
        let request = capture_spec(|spec| spec.scene = Some(bundle(path, scene_path, hash)));
        let status = jobs.submit_job(request).await.unwrap_err();
        assert_eq!(status.code(), code, "{path} {scene_path} {hash}: {status:?}");
    }
    let spec = wire::EvaluateSpec {
        dataset: "nothing".into(),
        views: Some(wire::evaluate_spec::Views::Cameras(wire::CameraList { cameras: vec![camera(8, 8)] })),
        settings: vec![settings(Component::Reconstruction, Blend::Unspecified)],
        ..Default::default()
    };
    let request = wire::SubmitJobRequest {
        spec: Some(wire::JobSpec { spec: Some(wire::job_spec::Spec::Evaluate(spec)) }),
        request_id: String::new(),
    };
    assert_eq!(jobs.submit_job(request).await.unwrap_err().code(), Code::NotFound);
}
