//! What goes wrong between a client and the server: who is not trusted, who asks for too much, who changes their mind all the time.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use lumisphere_proto::v1alpha1 as wire;
use wire::interact_request::Message as Up;
use wire::offset_surface_light_field_settings::{Blend, Component};

use crate::clients::with_dataset;
use crate::gate::{Gate, Looking};
use crate::process::{PATIENCE, Server, binary, ended, temporary_folder, without_settings};
use crate::system::metric;
use crate::viewers::{TRANSPORTS, Viewer, opening};
use crate::wire::{camera_around, frame_request, output, settings};

/// As serve.rs advertises them.
const MAX_CONCURRENT_STREAMS: usize = 256;

/// A certificate for this machine and its key.
fn certificate(folder: &Path, name: &str) -> (PathBuf, PathBuf) {
    let made = rcgen::generate_simple_self_signed(["127.0.0.1".into(), "localhost".into()]).unwrap();
    let (certificate, key) = (folder.join(format!("{name}.pem")), folder.join(format!("{name}.key")));
    fs::write(&certificate, made.cert.pem()).unwrap();
    fs::write(&key, made.signing_key.serialize_pem()).unwrap();
    (certificate, key)
}

fn list_datasets(url: &str, flags: &[&str]) -> Output {
    let mut command = Command::new(binary("lumisphere"));
    without_settings(&mut command);
    command.args(["--server", url]).args(flags).args(["dataset", "list"]).output().unwrap()
}

#[test]
fn a_client_believes_only_the_certificate_that_it_was_given() {
    let folder = temporary_folder();
    let at = |name: &str| folder.path().join(name);
    let ((own, key), (other, _)) = (certificate(folder.path(), "own"), certificate(folder.path(), "other"));
    let mut command = Command::new(binary("lumisphere-server"));
    command.arg("--tls-certificate").arg(&own).arg("--tls-private-key").arg(&key);
    let server = Server::spawn(&mut command, &at("data"));
    let url = format!("https://{}", server.address().host);
    let text = |path: &Path| path.to_str().unwrap().to_string();
    for (what, flags) in [("nobody's", vec![]), ("another's", vec!["--ca-certificate".to_string(), text(&other)])] {
        let output = list_datasets(&url, &flags.iter().map(String::as_str).collect::<Vec<_>>());
        let told = String::from_utf8_lossy(&output.stderr).to_lowercase();
        assert!(!output.status.success() && told.contains("certificate"), "{what}: {told}");
    }
    assert!(list_datasets(&url, &["--ca-certificate", &text(&own)]).status.success());
    fs::write(at("client.toml"), format!("ca_certificate = {:?}\n", text(&own))).unwrap();
    assert!(list_datasets(&url, &["--config", &text(&at("client.toml"))]).status.success());
    fs::write(at("client.toml"), format!("ca_certificate = {:?}\n", text(&other))).unwrap();
    assert!(!list_datasets(&url, &["--config", &text(&at("client.toml"))]).status.success());
}

#[test]
fn a_server_with_another_certificates_key_does_not_start() {
    let folder = temporary_folder();
    let ((own, _), (_, key)) = (certificate(folder.path(), "own"), certificate(folder.path(), "other"));
    let mut command = Command::new(binary("lumisphere-server"));
    command.args(["--listen-address", "127.0.0.1:0", "--http-address", "127.0.0.1:0", "--data-dir"]).arg(folder.path().join("data"));
    command.arg("--tls-certificate").arg(&own).arg("--tls-private-key").arg(&key);
    without_settings(&mut command);
    let log = folder.path().join("log");
    let mut child = command.stdout(Stdio::null()).stderr(fs::File::create(&log).unwrap()).spawn().unwrap();
    let status = ended(&mut child);
    let told = fs::read_to_string(log).unwrap();
    assert_eq!(status.and_then(|status| status.code()), Some(1), "{told}");
    assert!(told.contains("tls_certificate") && told.contains("own.pem"), "{told}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_connection_has_as_many_streams_as_the_server_says_and_floods_of_resets_end_it() {
    let (_folder, server) = with_dataset().await;
    if server.address().certificate.is_some() {
        return;
    }
    let tcp = tokio::net::TcpStream::connect(&server.address().host).await.unwrap();
    let (client, connection) = h2::client::handshake(tcp).await.unwrap();
    let connection = tokio::spawn(connection);
    let request = || {
        let uri = format!("http://{}/lumisphere.v1alpha1.System/GetVersion", server.address().host);
        http::Request::builder().method("POST").uri(uri).header("content-type", "application/grpc").body(()).unwrap()
    };
    let mut client = client.ready().await.unwrap();
    // Its settings have come with an answer.
    let (answer, mut body) = client.send_request(request(), false).unwrap();
    body.send_data(bytes::Bytes::from_static(&[0; 5]), true).unwrap();
    assert_eq!(answer.await.unwrap().status(), 200);
    assert_eq!(client.current_max_send_streams(), MAX_CONCURRENT_STREAMS);
    // Opened and given up at once, again and again.
    let flood = async {
        for _ in 0..100_000 {
            let Ok(ready) = client.clone().ready().await else { return true };
            client = ready;
            let Ok((_, mut body)) = client.send_request(request(), false) else { return true };
            body.send_reset(h2::Reason::CANCEL);
            tokio::task::yield_now().await;
        }
        false
    };
    assert!(flood.await, "all of them were taken");
    let ended = connection.await.unwrap().expect_err("the connection is ended");
    // Who still writes when it is closed does not always read why.
    assert!(ended.reason().is_none_or(|reason| reason == h2::Reason::ENHANCE_YOUR_CALM), "{ended}");
    // Others are served.
    server.system().await.get_version(wire::GetVersionRequest {}).await.unwrap();
}

/// Three times what a ping and its answer may take, as serve.rs has them.
const KEEPALIVE: Duration = Duration::from_secs(120);

/// Its sockets stay open, and nothing that is owed to it would be missed: only a ping finds out.
#[tokio::test(flavor = "multi_thread")]
async fn a_viewer_that_is_gone_without_a_word_is_let_go() {
    let (_folder, server) = with_dataset().await;
    let gate = Gate::before(&server);
    let mut looking = Looking::open(gate.channel().await).await;
    looking.look(1).await;
    while !looking.frame(PATIENCE).await.expect("a frame").is_final {}
    assert_eq!(metric(&server, "sessions_active"), 1);
    gate.set(Some(0));
    let gone = Instant::now();
    while metric(&server, "sessions_active") > 0 {
        assert!(gone.elapsed() < KEEPALIVE, "its session is still open");
        assert!(looking.frame(Duration::from_millis(500)).await.is_none());
    }
    // Another is welcome.
    Viewer::open(&server, 1).await.leave().await;
}

#[tokio::test]
async fn one_who_changes_the_settings_with_every_frame_is_shown_what_was_asked_for() {
    const CHANGES: u64 = 100;
    let (_folder, server) = with_dataset().await;
    let size = (48, 36);
    let both = [settings(Component::Full, Blend::Average), settings(Component::Mirror, Blend::Distance)];
    let mut expected = Vec::new();
    for settings in &both {
        let request = wire::RenderFrameRequest {
            camera: Some(camera_around(0.2, size.0, size.1)),
            settings: Some(settings.clone()),
            output: Some(output(wire::Encoding::RawZstd)),
            ..frame_request(crate::tiny::DATASET)
        };
        expected.push(server.rendering().await.render_frame(request).await.unwrap().into_inner().color);
    }
    assert!(expected[0] != expected[1]);
    for transport in TRANSPORTS {
        let mut viewer = Viewer::open_as(&server, opening(2), transport).await.unwrap();
        viewer.pose(1, camera_around(0.2, size.0, size.1)).await;
        for change in 1..=CHANGES {
            let update = wire::SettingsUpdate { settings: Some(both[(change % 2) as usize].clone()), output: None };
            viewer.send(Up::Settings(update)).await;
            let frame = viewer.frame().await;
            viewer.acknowledge(frame.frame_id).await;
            assert!(expected.contains(&frame.color), "{transport:?}, {change}: a frame of neither");
        }
        // What was asked for last is shown in the end, and nothing after it.
        let last = wire::SettingsUpdate { settings: Some(both[1].clone()), output: None };
        viewer.send(Up::Settings(last)).await;
        while {
            let frame = viewer.frame().await;
            viewer.acknowledge(frame.frame_id).await;
            frame.color != expected[1]
        } {}
        viewer.leave().await;
    }
}
