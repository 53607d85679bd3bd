//! Normal maps, from a PNG to frames, truths and tables.

use std::f32::consts::TAU;
use std::fs;
use std::path::Path;

use lumisphere::images::{Rgb8, encode_png};
use lumisphere_proto::v1alpha1 as wire;
use tonic::Code;
use wire::offset_surface_light_field_settings::{Blend, Component, NormalMap};
use wire::render_settings::Representation;

use crate::clients::with_dataset;
use crate::pictures::Picture;
use crate::process::Server;
use crate::tiny::DATASET;
use crate::viewers::{Transport, Viewer, opening};
use crate::wire::{code_and_reason, fields, frame_request, settings};

/// Waves along u whose slope reaches `steepest`.
fn write_map(path: &Path, steepest: f32) {
    let texel = |at: usize| {
        let slope = steepest * (TAU * (at % 32) as f32 / 32.0).sin();
        let length = (1.0 + slope * slope).sqrt();
        [(128.0 + 127.0 * slope / length).round() as u8, 128, (128.0 + 127.0 / length).round() as u8]
    };
    let bytes = (0..32 * 32).flat_map(texel).collect();
    fs::write(path, encode_png(&Rgb8 { width: 32, height: 32, bytes }).unwrap()).unwrap();
}

fn rendered(server: &Server, folder: &Path, name: &str, flags: &[&str]) -> Picture {
    let out = folder.join(name).display().to_string();
    let view = ["--frames", "1", "--size", "96x72", "--component", "mirror", "--blend", "average", "--out", &out, "--quiet"];
    server.succeed(&[&["render", "--dataset", DATASET][..], &view, flags].concat());
    Picture::of_png(&fs::read(Path::new(&out).join("frame-00000.png")).unwrap())
}

fn with_map(component: Component, map: NormalMap) -> wire::RenderSettings {
    let mut settings = settings(component, Blend::Average);
    if let Some(Representation::OffsetSurfaceLightField(field)) = &mut settings.representation {
        field.normal_map = Some(map);
    }
    settings
}

#[tokio::test]
async fn a_map_is_uploaded_drawn_traced_and_measured_and_what_is_none_is_refused() {
    let (folder, server) = with_dataset().await;
    let path = |name: &str| folder.path().join(name).display().to_string();
    let (waves, flat) = (path("waves.png"), path("flat.png"));
    write_map(Path::new(&waves), 0.6);
    write_map(Path::new(&flat), 0.0);
    let shown = |name: &str, flags: &[&str]| rendered(&server, folder.path(), name, flags);
    let plain = shown("plain", &[]);
    let waving = shown("waving", &["--normal-map", &waves]);
    assert!(waving.mean(&plain) > 1.0, "{} codes from none", waving.mean(&plain));
    assert!(shown("flat", &["--normal-map", &flat]).mean(&plain) < 0.01, "flat is none");
    assert!(shown("weak", &["--normal-map", &waves, "--normal-strength", "0"]).mean(&plain) < 0.01, "no strength is none");
    let often = shown("often", &["--normal-map", &waves, "--normal-repeat", "3"]);
    assert!(often.mean(&waving) > 0.5, "{} codes from once", often.mean(&waving));
    let on_cpu = shown("on-cpu", &["--normal-map", &waves, "--backend", "cpu"]);
    assert!(on_cpu.mean(&waving) < 0.3, "{}", on_cpu.mean(&waving));
    // By its hash.
    let hash = server.json(&["blob", "upload", &waves])["blake3"].as_str().unwrap().to_string();
    assert_eq!(shown("named", &["--normal-map", &hash]).mean(&waving), 0.0);
    // As ground truth: of the waves, and of the flat map.
    let truth = ["--truth", "--truth-passes", "16"];
    let traced = shown("traced", &[&["--normal-map", &waves][..], &truth].concat());
    let traced_plain = shown("traced-plain", &truth);
    assert!(traced.mean(&traced_plain) > 1.0, "{}", traced.mean(&traced_plain));
    // Measured against it: as waving as the truth, or the frame without would be nearer.
    let evaluated = server.json(&[
        "evaluate",
        "--dataset",
        DATASET,
        "--components",
        "mirror",
        "--blends",
        "average",
        "--frames",
        "1",
        "--size",
        "40x30",
        "--truth-samples-per-pixel",
        "4",
        "--normal-map",
        &waves,
        "--normal-strength",
        "0.5",
        "--normal-repeat",
        "2",
    ]);
    let row = &evaluated["summary"]["rows"][0];
    assert_eq!(row["normal_map"], format!("{}-strength-0.5-repeat-2", &hash[..8]), "{evaluated:#}");

    // One that is not here, one that is none; alone, in a stream, and of a job.
    let named = |image: &str| NormalMap { image: image.into(), strength: None, repeat: None };
    let mut client = server.rendering().await;
    let mut asked = async |settings: wire::RenderSettings| {
        client.render_frame(wire::RenderFrameRequest { settings: Some(settings), ..frame_request(DATASET) }).await.unwrap_err()
    };
    let absent = with_map(Component::Mirror, named(&"0f".repeat(32)));
    assert_eq!(code_and_reason(&asked(absent.clone()).await), (Code::NotFound, "BLOB_NOT_FOUND".into()));
    let none = path("none.png");
    fs::write(&none, b"no map").unwrap();
    let none_hash = server.json(&["blob", "upload", &none])["blake3"].as_str().unwrap().to_string();
    let at = |name: &str| vec![format!("settings.offset_surface_light_field.normal_map{name}")];
    for (settings, field, problem) in [
        (with_map(Component::Mirror, named(&none_hash)), at(".image"), "a PNG of 8 or 16 bits"),
        (with_map(Component::Mirror, named("12")), at(".image"), "64"),
        (with_map(Component::Mirror, NormalMap { strength: Some(f32::NAN), ..named(&hash) }), at(".strength"), "-16 to 16"),
        (with_map(Component::Mirror, NormalMap { repeat: Some(0.0), ..named(&hash) }), at(".repeat"), "0.001 to 4096"),
        (with_map(Component::Reconstruction, named(&hash)), at(""), "mirror, full or glossy expected"),
    ] {
        let status = asked(settings).await;
        assert_eq!((status.code(), fields(&status)), (Code::InvalidArgument, field));
        assert!(status.message().contains(problem), "{}", status.message());
    }
    let open = wire::OpenInteraction { settings: Some(absent), ..opening(1) };
    let status = Viewer::open_as(&server, open, Transport::Interact).await.err().expect("no such map");
    assert_eq!(code_and_reason(&status), (Code::NotFound, "BLOB_NOT_FOUND".into()));
    let refused = server.lumisphere(&["render", "--dataset", DATASET, "--component", "mirror", "--normal-map", &none, "--out", &path("r")]);
    let said = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(refused.status.code() == Some(2) && said.contains("a PNG of 8 or 16 bits"), "{said}");
}
