//! `lumisphere system …`.

use clap::Subcommand;
use lumisphere_proto::v1alpha1 as wire;
use serde_json::{Value, json};

use crate::context::Context;
use crate::output::table;
use crate::views::backend_name;

/// Verbs.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Adapter, limits and configuration of the server
    Info,
    /// Versions of client and server, and the server's features
    Version,
}

/// Runs one.
pub async fn run(command: Command, context: &Context) -> anyhow::Result<()> {
    let mut client = context.connect().await?.system();
    match command {
        Command::Info => {
            let info = client.get_server_info(context.request(wire::GetServerInfoRequest {})).await?.into_inner();
            context.output.document(&info_json(&info), || info_text(&info))?;
        }
        Command::Version => {
            let server = client.get_version(context.request(wire::GetVersionRequest {})).await?.into_inner();
            let own = env!("CARGO_PKG_VERSION");
            let document = json!({"client": own, "server": server.version, "api": server.api, "features": server.features});
            context.output.document(&document, || {
                format!("client {own}\nserver {} ({})\nfeatures {}", server.version, server.api, server.features.join(", "))
            })?;
        }
    }
    Ok(())
}

fn limits(l: &wire::Limits) -> [(&'static str, u64); 10] {
    [
        ("max_pixels_per_frame", l.max_pixels_per_frame),
        ("max_request_bytes", l.max_request_bytes),
        ("max_frame_message_bytes", l.max_frame_message_bytes),
        ("max_chunk_bytes", l.max_chunk_bytes),
        ("max_blob_bytes", l.max_blob_bytes),
        ("max_cameras_per_job", l.max_cameras_per_job),
        ("render_queue_length", l.render_queue_length),
        ("max_concurrent_jobs", l.max_concurrent_jobs),
        ("max_queued_jobs", l.max_queued_jobs),
        ("max_sessions", l.max_sessions),
    ]
}

fn info_json(info: &wire::GetServerInfoResponse) -> Value {
    let limits: serde_json::Map<String, Value> =
        limits(&info.limits.unwrap_or_default()).into_iter().map(|(name, value)| (name.to_string(), value.into())).collect();
    let entry = |e: &wire::ConfigurationEntry| json!({"key": e.key, "value": e.value, "origin": e.origin});
    json!({
        "backend": backend_name(info.backend()),
        "adapter": info.adapter,
        "driver": info.driver,
        "limits": limits,
        "configuration": info.configuration.iter().map(entry).collect::<Vec<_>>(),
        "uptime_seconds": info.uptime_seconds,
        "shutting_down": info.shutting_down,
    })
}

fn info_text(info: &wire::GetServerInfoResponse) -> String {
    let adapter = if info.adapter.is_empty() { "none" } else { &info.adapter };
    let state = if info.shutting_down { "stopping" } else { "running" };
    let limits: Vec<Vec<String>> =
        limits(&info.limits.unwrap_or_default()).into_iter().map(|(name, value)| vec![name.to_string(), value.to_string()]).collect();
    let configuration: Vec<Vec<String>> =
        info.configuration.iter().map(|e| vec![e.key.clone(), e.value.clone(), format!("({})", e.origin)]).collect();
    format!(
        "{state} for {:.0} s\nbackend {}, adapter {adapter}, driver {}\n\nlimits\n{}\n\nconfiguration\n{}",
        info.uptime_seconds,
        backend_name(info.backend()),
        info.driver,
        table(&limits, &[1]),
        table(&configuration, &[]),
    )
}
