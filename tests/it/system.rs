//! The server itself: health, reflection, probes, metrics, gRPC-Web, configuration.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::process::Command;

use lumisphere_proto::v1alpha1 as wire;
use prost::Message;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

use crate::process::{Server, binary, temporary_folder};
use crate::tiny::{self, DATASET};
use crate::wire::frame_request;

/// The page and what it loads, on the port of gRPC-Web: one origin.
#[test]
fn the_viewer_is_served_at_the_root_beside_grpc_web() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    let address = &server.address().host;
    let (status, page) = get(address, "/");
    assert!(status.contains(" 200 ") && page.contains("content-type: text/html; charset=utf-8"), "{status}{page}");
    assert!(page.contains("content-security-policy: default-src 'none'; script-src 'self'"), "{page}");
    let script = page.split("src=\"").nth(1).and_then(|rest| rest.split('"').next()).expect("the page has a script");
    let path = format!("/{}", script.trim_start_matches("./").trim_start_matches('/'));
    let (status, head) = get(address, &path);
    assert!(status.contains(" 200 ") && head.contains("content-type: text/javascript; charset=utf-8"), "{path}: {status}");
    assert!(head.contains("cache-control: public, max-age=31536000, immutable"), "{path}: a name with a hash");
    let (_, answer) = http(address, "HEAD / HTTP/1.1", &[]);
    assert!(answer.ends_with(b"\r\n\r\n"), "a head has no body");
    assert!(get(address, "/nothing.html").0.contains(" 404 "));
    // Nobody's paths become labels.
    assert!(!get(&server.http, "/metrics").1.contains("nothing.html"));
}

#[tokio::test]
async fn a_client_can_measure_its_link_and_no_call_carries_more_than_allowed() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    let mut system = server.system().await;
    for (up, down) in [(0, 0), (0, 1 << 20), (1 << 20, 0), (1000, 50_000)] {
        let request = wire::MeasureLinkRequest { answer_bytes: down, payload: vec![7; up].into() };
        let answer = system.measure_link(request).await.unwrap().into_inner();
        assert_eq!((answer.received_bytes, answer.payload.len()), (up as u64, down as usize));
        // Whoever compresses on the way gains nothing.
        let packed = zstd::encode_all(&answer.payload[..], 1).unwrap().len();
        assert!(packed >= down as usize, "{down} bytes compress to {packed}");
    }
    for answer_bytes in [(1 << 20) + 1, u32::MAX] {
        let status = system.measure_link(wire::MeasureLinkRequest { answer_bytes, ..Default::default() }).await.unwrap_err();
        assert_eq!(crate::wire::fields(&status), ["answer_bytes"]);
    }
    let longer = wire::MeasureLinkRequest { answer_bytes: 0, payload: vec![0; (1 << 20) + 1].into() };
    assert_eq!(crate::wire::fields(&system.measure_link(longer).await.unwrap_err()), ["payload"]);
    let too_large = wire::MeasureLinkRequest { answer_bytes: 0, payload: vec![0; 5 << 20].into() };
    assert_eq!(system.measure_link(too_large).await.unwrap_err().code(), tonic::Code::OutOfRange);
}

/// A whole HTTP/1.1 exchange: (status line, headers and body).
fn http(address: &str, request_head: &str, body: &[u8]) -> (String, Vec<u8>) {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.write_all(format!("{request_head}\r\nHost: {address}\r\nConnection: close\r\n\r\n").as_bytes()).unwrap();
    stream.write_all(body).unwrap();
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).unwrap();
    let end = answer.iter().position(|b| *b == b'\r').unwrap();
    (String::from_utf8_lossy(&answer[..end]).into_owned(), answer[end..].to_vec())
}

/// Status line, then headers and body.
pub fn get(address: &str, path: &str) -> (String, String) {
    let (status, rest) = http(address, &format!("GET {path} HTTP/1.1"), &[]);
    (status, String::from_utf8_lossy(&rest).into_owned())
}

/// A count or gauge without labels, as scraped.
pub fn metric(server: &Server, name: &str) -> u64 {
    let metrics = get(&server.http, "/metrics").1;
    let line = metrics.lines().find_map(|line| line.strip_prefix(&format!("lumisphere_{name} ")));
    line.expect("the metric is there").parse().expect("it is a number")
}

#[tokio::test]
async fn health_probes_and_metrics_answer() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    let mut health = HealthClient::new(server.channel().await);
    for service in ["", "lumisphere.v1alpha1.Rendering", "lumisphere.v1alpha1.Jobs"] {
        let answer = health.check(HealthCheckRequest { service: service.into() }).await.unwrap().into_inner();
        assert_eq!(answer.status(), ServingStatus::Serving, "{service}");
    }
    for path in ["/healthz", "/readyz"] {
        assert!(get(&server.http, path).0.contains(" 200 "), "{path}");
    }
    server.system().await.get_version(wire::GetVersionRequest {}).await.unwrap();
    let (status, metrics) = get(&server.http, "/metrics");
    assert!(status.contains(" 200 ") && metrics.contains("# TYPE") && metrics.contains("GetVersion"), "{metrics}");
    assert!(get(&server.http, "/nothing").0.contains(" 404 "));
}

#[tokio::test]
async fn reflection_describes_every_service_in_both_versions() {
    use tonic_reflection::pb::{v1, v1alpha};
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    let expected = ["Cache", "Datasets", "Jobs", "Rendering", "System"].map(|name| format!("lumisphere.v1alpha1.{name}"));

    let ask = v1::ServerReflectionRequest {
        host: String::new(),
        message_request: Some(v1::server_reflection_request::MessageRequest::ListServices(String::new())),
    };
    let mut client = v1::server_reflection_client::ServerReflectionClient::new(server.channel().await);
    let mut answers = client.server_reflection_info(tokio_stream::iter([ask])).await.unwrap().into_inner();
    let answer = answers.message().await.unwrap().unwrap().message_response.unwrap();
    let v1::server_reflection_response::MessageResponse::ListServicesResponse(list) = answer else { panic!("{answer:?}") };
    let names: Vec<String> = list.service.into_iter().map(|s| s.name).collect();
    assert!(expected.iter().all(|name| names.contains(name)), "{names:?}");

    let ask = v1alpha::ServerReflectionRequest {
        host: String::new(),
        message_request: Some(v1alpha::server_reflection_request::MessageRequest::FileContainingSymbol(expected[3].clone())),
    };
    let mut client = v1alpha::server_reflection_client::ServerReflectionClient::new(server.channel().await);
    let mut answers = client.server_reflection_info(tokio_stream::iter([ask])).await.unwrap().into_inner();
    let answer = answers.message().await.unwrap().unwrap().message_response.unwrap();
    let v1alpha::server_reflection_response::MessageResponse::FileDescriptorResponse(files) = answer else { panic!("{answer:?}") };
    assert!(!files.file_descriptor_proto.is_empty());
}

#[test]
fn a_browser_gets_a_frame_over_grpc_web() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    tiny::capture(&server, folder.path());
    let message = frame_request(DATASET).encode_to_vec();
    let mut body = vec![0];
    body.extend((message.len() as u32).to_be_bytes());
    body.extend(message);
    let head = format!(
        "POST /lumisphere.v1alpha1.Rendering/RenderFrame HTTP/1.1\r\nContent-Type: application/grpc-web+proto\r\nX-Grpc-Web: 1\r\nContent-Length: {}",
        body.len()
    );
    let (status, answer) = http(&server.address().host, &head, &body);
    assert!(status.contains(" 200 "), "{status}");
    let text = String::from_utf8_lossy(&answer);
    assert!(text.contains("grpc-status:0"), "no trailer says that it went well");
    let needle = DATASET.as_bytes();
    assert!(answer.len() > 1000 && answer.windows(needle.len()).any(|w| w == needle));
}

#[test]
fn pages_of_allowed_origins_and_no_others_may_call() {
    let folder = temporary_folder();
    let server = Server::start_with(&folder.path().join("data"), &["--allowed-origins", "https://viewer.example"]);
    let call = |origin: &str| {
        let head = format!(
            "POST /lumisphere.v1alpha1.System/GetVersion HTTP/1.1\r\nContent-Type: application/grpc-web+proto\r\nX-Grpc-Web: 1\r\nOrigin: {origin}\r\nContent-Length: 5"
        );
        // An empty message: not compressed, length 0.
        let (status, answer) = http(&server.address().host, &head, &[0; 5]);
        assert!(status.contains(" 200 "), "{status}");
        String::from_utf8_lossy(&answer).to_lowercase()
    };
    let allowed = call("https://viewer.example");
    assert!(allowed.contains("access-control-allow-origin: https://viewer.example"), "{allowed}");
    assert!(allowed.contains("grpc-status-details-bin"), "a page could not read why a call failed: {allowed}");
    assert!(!call("https://other.example").contains("access-control-allow-origin"));
}

#[test]
fn unknown_keys_and_senseless_values_are_refused_at_start() {
    let folder = temporary_folder();
    let config = folder.path().join("server.toml");
    let run = |text: &str, more: &[&str]| {
        std::fs::write(&config, text).unwrap();
        let output =
            Command::new(binary("lumisphere-server")).arg("--config").arg(&config).arg("--print-config").args(more).output().unwrap();
        (output.status.code(), String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned())
    };
    let (code, text) = run("max_sesions = 4\n", &[]);
    assert!(code == Some(2) && text.contains("max_sesions") && text.contains("server.toml"), "{code:?} {text}");
    let (code, text) = run("max_sessions = -1\n", &[]);
    assert!(code == Some(2) && text.contains("max_sessions"), "{code:?} {text}");
    let (code, text) = run("max_sessions = 4\n", &["--render-queue-length", "5"]);
    let origin = |key: &str| text.lines().find(|l| l.starts_with(&format!("{key} "))).unwrap_or_default().to_string();
    assert_eq!(code, Some(0), "{text}");
    assert!(origin("max_sessions").contains('4') && origin("max_sessions").contains("server.toml"), "{text}");
    assert!(origin("render_queue_length").contains("--render-queue-length"), "{text}");
    assert!(origin("backend").contains("default"), "{text}");
}

#[tokio::test]
async fn the_server_tells_its_limits_and_keeps_them() {
    let folder = temporary_folder();
    let server = Server::start_with(&folder.path().join("data"), &["--max-pixels-per-frame", "1000"]);
    tiny::capture(&server, folder.path());
    let info = server.system().await.get_server_info(wire::GetServerInfoRequest {}).await.unwrap().into_inner();
    assert_eq!(info.limits.unwrap().max_pixels_per_frame, 1000);
    let mut rendering = server.rendering().await;
    // 32 × 24 = 768 pixels fit, 50 × 21 = 1050 do not.
    rendering.render_frame(frame_request(DATASET)).await.unwrap();
    let large = wire::RenderFrameRequest { camera: Some(crate::wire::camera(50, 21)), ..frame_request(DATASET) };
    assert_eq!(rendering.render_frame(large).await.unwrap_err().code(), tonic::Code::InvalidArgument);
}

#[test]
fn one_data_folder_has_one_server() {
    let folder = temporary_folder();
    let data = folder.path().join("data");
    let _first = Server::start(&data);
    let second = Command::new(binary("lumisphere-server"))
        .args(["--listen-address", "127.0.0.1:0", "--http-address", "127.0.0.1:0", "--data-dir"])
        .arg(&data)
        .output()
        .unwrap();
    assert_eq!(second.status.code(), Some(1), "{}", String::from_utf8_lossy(&second.stderr));
}
