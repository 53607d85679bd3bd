//! Measured BRDFs, from a MERL file to frames, truths and tables; and both orders of integration, swept over and chosen from.

use std::f32::consts::FRAC_PI_2;
use std::fs;
use std::path::Path;

use glam::{Vec2, Vec3};
use lumisphere::radiometry::brdf::{Brdf, MEASURED_SHAPE, Ward};
use lumisphere_proto::v1alpha1 as wire;
use tonic::Code;
use wire::offset_surface_light_field_settings::{Blend, Component, Gloss};
use wire::render_settings::Representation;

use crate::clients::with_dataset;
use crate::pictures::Picture;
use crate::process::Server;
use crate::tiny::{self, DATASET};
use crate::viewers::{Transport, Viewer, opening};
use crate::wire::{code_and_reason, fields, frame_request, settings};

const WARD: &str = r#"{"model": "ward", "diffuse": [0.2, 0.1, 0.05], "specular": [0.4, 0.4, 0.4], "alpha_x": 0.3, "alpha_y": 0.3}"#;

/// MERL's layout of `WARD`, read in the middle of each cell.
fn write_table(path: &Path) {
    let ward = Ward::new(Vec3::new(0.2, 0.1, 0.05), Vec3::splat(0.4), Vec2::splat(0.3)).unwrap();
    let [halves, tilts, turns] = MEASURED_SHAPE;
    let value = |at: usize| {
        let (i, j, k) = (at / turns / tilts, at / turns % tilts, at % turns);
        let theta_h = FRAC_PI_2 * ((i as f32 + 0.5) / halves as f32).powi(2);
        let (theta_d, phi_d) = ((j as f32 + 0.5).to_radians(), (k as f32 + 0.5).to_radians());
        let (h, x) = (Vec3::new(theta_h.sin(), 0.0, theta_h.cos()), Vec3::new(theta_h.cos(), 0.0, -theta_h.sin()));
        let wi = theta_d.cos() * h + theta_d.sin() * (phi_d.cos() * x + phi_d.sin() * Vec3::Y);
        ward.eval(2.0 * wi.dot(h) * h - wi, wi)
    };
    let values: Vec<Vec3> = (0..halves * tilts * turns).map(value).collect();
    let mut bytes: Vec<u8> = MEASURED_SHAPE.iter().flat_map(|n| (*n as i32).to_le_bytes()).collect();
    for (channel, scale) in [1500.0, 1500.0 / 1.15, 1500.0 / 1.66].into_iter().enumerate() {
        values.iter().for_each(|v| bytes.extend((f64::from(v[channel]) * scale).to_le_bytes()));
    }
    fs::write(path, bytes).unwrap();
}

fn rendered(server: &Server, folder: &Path, name: &str, flags: &[&str]) -> Picture {
    let out = folder.join(name).display().to_string();
    let view = ["--frames", "1", "--size", "96x72", "--component", "glossy", "--blend", "average", "--out", &out, "--quiet"];
    server.succeed(&[&["render", "--dataset", DATASET][..], &view, flags].concat());
    Picture::of_png(&fs::read(Path::new(&out).join("frame-00000.png")).unwrap())
}

fn glossy(brdf: &str) -> wire::RenderSettings {
    let mut settings = settings(Component::Glossy, Blend::Average);
    if let Some(Representation::OffsetSurfaceLightField(field)) = &mut settings.representation {
        field.gloss = Some(Gloss { brdf: brdf.into(), directions: 8, passes: 1, order: 0, integration: 0 });
    }
    settings
}

#[tokio::test]
async fn a_table_is_uploaded_drawn_traced_and_what_is_none_is_refused() {
    let (folder, server) = with_dataset().await;
    let file = folder.path().join("ward.binary");
    write_table(&file);
    let measured = serde_json::json!({"model": "measured", "file": file}).to_string();
    let shown = rendered(&server, folder.path(), "measured", &["--brdf", &measured]);
    let analytic = rendered(&server, folder.path(), "analytic", &["--brdf", WARD]);
    let duller = WARD.replace("0.3", "0.9");
    let other = rendered(&server, folder.path(), "other", &["--brdf", &duller]);
    // Cells of a degree, and other directions of the lobe.
    assert!(shown.mean(&analytic) < 1.5, "{} codes from the model that the table was made of", shown.mean(&analytic));
    assert!(shown.mean(&other) > 2.0 * shown.mean(&analytic), "{} codes from another", shown.mean(&other));
    // Both orders, on both backends; the other order is another estimate of the same.
    let first = ["--brdf", &measured, "--integration-order", "integrate-first"];
    let one_by_one = rendered(&server, folder.path(), "one-by-one", &first);
    let on_cpu = rendered(&server, folder.path(), "on-cpu", &[&first[..], &["--backend", "cpu"]].concat());
    assert!(one_by_one.mean(&shown) > 0.0 && one_by_one.mean(&shown) < 1.5, "{}", one_by_one.mean(&shown));
    assert!(one_by_one.mean(&on_cpu) < 0.3, "{}", one_by_one.mean(&on_cpu));
    // As ground truth.
    let traced = rendered(&server, folder.path(), "traced", &["--brdf", &measured, "--truth", "--truth-passes", "16"]);
    let of_model = rendered(&server, folder.path(), "traced-model", &["--brdf", WARD, "--truth", "--truth-passes", "16"]);
    assert!(traced.means(8).mean(&of_model.means(8)) < 4.0, "{}", traced.means(8).mean(&of_model.means(8)));

    // One that is not here, one that is none; alone, in a stream, and of a job.
    let named = |hash: &str| glossy(&serde_json::json!({"model": "measured", "table": hash}).to_string());
    let absent = named(&"0f".repeat(32));
    let mut client = server.rendering().await;
    let mut asked = async |settings: wire::RenderSettings| {
        client.render_frame(wire::RenderFrameRequest { settings: Some(settings), ..frame_request(DATASET) }).await.unwrap_err()
    };
    assert_eq!(code_and_reason(&asked(absent.clone()).await), (Code::NotFound, "BLOB_NOT_FOUND".into()));
    let small = folder.path().join("small.binary");
    fs::write(&small, b"no table").unwrap();
    let small = server.json(&["blob", "upload", small.to_str().unwrap()])["blake3"].as_str().unwrap().to_string();
    let status = asked(named(&small)).await;
    assert_eq!((status.code(), fields(&status)), (Code::InvalidArgument, vec!["settings.offset_surface_light_field.gloss.brdf".into()]));
    assert!(status.message().contains("has 8 bytes, 34992012"), "{}", status.message());
    let mut spoiled = fs::read(&file).unwrap();
    spoiled[20..28].copy_from_slice(&f64::NAN.to_le_bytes());
    let path = folder.path().join("spoiled.binary");
    fs::write(&path, spoiled).unwrap();
    let spoiled = server.json(&["blob", "upload", path.to_str().unwrap()])["blake3"].as_str().unwrap().to_string();
    let status = asked(named(&spoiled)).await;
    assert_eq!((status.code(), fields(&status)), (Code::InvalidArgument, vec!["settings.offset_surface_light_field.gloss.brdf".into()]));
    let open = wire::OpenInteraction { settings: Some(absent), ..opening(1) };
    let status = Viewer::open_as(&server, open, Transport::Interact).await.err().expect("no such table");
    assert_eq!(code_and_reason(&status), (Code::NotFound, "BLOB_NOT_FOUND".into()));
    let output = server.lumisphere(&[
        "evaluate",
        "--dataset",
        DATASET,
        "--components",
        "glossy",
        "--blends",
        "average",
        "--frames",
        "1",
        "--size",
        "32x24",
        "--brdf",
        &format!(r#"{{"model": "measured", "table": "{}"}}"#, "0f".repeat(32)),
    ]);
    assert_eq!(output.status.code(), Some(3), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn a_sweep_measures_both_orders_indices_and_turned_light_and_is_chosen_from() {
    let folder = crate::process::temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    tiny::write_scene(&folder.path().join("scene"));
    write_table(&folder.path().join("ward.binary"));
    let text = |settings: &str| {
        format!(
            "timed_frames_per_view = 1\n[capture]\nscene = \"scene/scene.json\"\nobject = \"box\"\npoints = 24\nepsilon = 0.3
            face_size_texels = 16\nsamples_per_texel = 1\nmax_bounces = 1\nsample_map_size_texels = 16\npixel_format = \"f32\"
            [settings]\nblends = [\"average\"]\n{settings}\n[views]\nframes = 1\nsize = \"40x30\"\n[truth]\nsamples_per_pixel = 4\n"
        )
    };
    let file = folder.path().join("sweep.toml");
    let axes =
        "components = [\"glossy\", \"refraction\"]\nbrdf = '{\"model\": \"measured\", \"file\": \"ward.binary\"}'\ndirections = [4, 16]
        integration_orders = [\"blend-first\", \"integrate-first\"]\nrefraction_indices = [1.2, 1.5]\nenvironment_turns_deg = [0, 90]";
    fs::write(&file, text(axes)).unwrap();
    let out = folder.path().join("out");
    let document = server.json(&["evaluate", "sweep", file.to_str().unwrap(), "--out", out.to_str().unwrap(), "--quiet"]);
    let rows = document["sweep"]["rows"].as_array().unwrap();
    let count = |key: &str, value: serde_json::Value| rows.iter().filter(|row| row[key] == value).count();
    assert_eq!((rows.len(), count("component", "glossy".into())), (12, 8), "{document:#}");
    assert_eq!((count("order", "integrate-first".into()), count("directions", 16.into())), (4, 4));
    assert_eq!((count("body", "solid-1.2".into()), count("light", "turned-90".into())), (2, 6));
    assert!(fs::read_to_string(out.join("chart.svg")).unwrap().contains("integrate-first"));
    // The chosen row is rendered as it was measured, the table among it.
    let sweep = out.join("sweep.json").display().to_string();
    // Of two lights, with a truth each.
    let ambiguous = server.lumisphere(&["evaluate", "choose", &sweep, "--max-millis", "1000000", "--group", "glossy"]);
    assert_eq!(ambiguous.status.code(), Some(2), "{}", String::from_utf8_lossy(&ambiguous.stdout));
    let bounds = ["--choose", &sweep, "--max-millis", "1000000", "--group", "glossy, turned-90, of"];
    let chosen = &server.json(&[&["evaluate", "choose", &sweep][..], &bounds[2..]].concat())["row"];
    let dataset = chosen["dataset"].as_str().unwrap();
    let view = ["--frames", "1", "--size", "40x30", "--quiet"];
    let (a, b) = (folder.path().join("a").display().to_string(), folder.path().join("b").display().to_string());
    server.succeed(&[&["render"][..], &bounds, &view, &["--out", &a]].concat());
    let table = serde_json::json!({"model": "measured", "file": folder.path().join("ward.binary")}).to_string();
    let directions = chosen["directions"].as_u64().unwrap().to_string();
    // The row tells what was measured, wherever that file is by now.
    fs::remove_file(folder.path().join("ward.binary")).unwrap();
    server.succeed(&[&["render"][..], &bounds, &view, &["--out", &a, "--force"]].concat());
    write_table(&folder.path().join("ward.binary"));
    let mut said = vec!["render", "--dataset", dataset, "--component", "glossy", "--blend", "average", "--brdf", &table];
    said.extend(["--directions", &directions, "--environment-turn-deg", "90", "--out", &b]);
    if chosen["order"] == "integrate-first" {
        said.extend(["--integration-order", "integrate-first"]);
    }
    server.succeed(&[&said[..], &view].concat());
    let frame = |folder: &str| fs::read(Path::new(folder).join("frame-00000.png")).unwrap();
    assert_eq!(frame(&a), frame(&b));

    for (settings, problem) in [
        ("components = \"glossy\"", "brdf and the component glossy go together"),
        ("directions = 3", "directions is there, but no component"),
        ("refraction_indices = 1.5", "refraction_indices is there, but no component"),
        ("components = \"reconstruction\"\nreflections = 2", "reflections is there, but no component"),
        ("components = \"full\"\nreflections = [1, 5]", "1 to 4"),
        ("components = \"refraction\"\nrefraction_indices = 9", "1 to 4"),
        ("environment_turns_deg = 400", "-360 to 360"),
    ] {
        fs::write(&file, text(settings)).unwrap();
        let output = server.lumisphere(&["evaluate", "sweep", file.to_str().unwrap(), "--out", out.to_str().unwrap()]);
        let told = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.code() == Some(2) && told.contains(problem), "{settings}: {told}");
    }
}
