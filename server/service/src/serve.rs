//! The two ports: gRPC with gRPC-Web, health, reflection and the browser viewer on one, metrics and probes on the other.

use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use http::{HeaderName, HeaderValue, Method};
use tokio::net::{TcpListener, TcpStream};
use tokio_stream::StreamExt as _;
use tonic::service::Routes;
use tonic::transport::server::TcpIncoming;
use tonic::transport::{Identity, Server, ServerTlsConfig};
use tonic_health::ServingStatus;
use tonic_health::pb::health_server::{Health, HealthServer};
use tonic_health::server::HealthReporter;
use tonic_web::GrpcWebLayer;
use tower_http::cors::{AllowOrigin, CorsLayer};

use crate::api::{Api, App};
use crate::config::TlsFiles;
use crate::freed_memory::give_back;
use crate::shutdown::{Drained, StopSignals, until_drained};
use crate::telemetry::{Metrics, Observed, RpcMetrics, http_routes};
use crate::viewer_page::ViewerPage;
use crate::wire::cache::{dataset_counts, tier_counts, tier_name};
use crate::wire::proto::cache_server::{CacheServer, SERVICE_NAME as CACHE};
use crate::wire::proto::datasets_server::{DatasetsServer, SERVICE_NAME as DATASETS};
use crate::wire::proto::jobs_server::{JobsServer, SERVICE_NAME as JOBS};
use crate::wire::proto::rendering_server::{RenderingServer, SERVICE_NAME as RENDERING};
use crate::wire::proto::system_server::{SERVICE_NAME as SYSTEM, SystemServer};
use crate::wire::{FILE_DESCRIPTOR_SET, MAX_FRAME_MESSAGE_BYTES, MAX_REQUEST_BYTES};

/// A peer that is gone is noticed after these.
const KEEPALIVE_INTERVAL: Duration = Duration::from_secs(20);
const KEEPALIVE_TIMEOUT: Duration = Duration::from_secs(20);
/// Of TCP's own, within the timeout: browsers without TLS speak HTTP/1.1, which has no ping.
const KEEPALIVE_RETRIES: u32 = 4;
/// A peer that does not finish its TLS handshake is let go.
const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(10);
/// Streams on one connection.
const MAX_CONCURRENT_STREAMS: u32 = 256;
/// Window of a stream and of a connection for what clients send: several chunks of a blob.
const STREAM_WINDOW_BYTES: u32 = 4 << 20;
const CONNECTION_WINDOW_BYTES: u32 = 8 << 20;
/// Of a connection, what the kernel holds that is not on the wire yet. Of a download's bytes no more than these are ahead of a frame's there (on
/// Linux); the rest waits in its own stream, in turn with the frame's.
const UNSENT_BYTES: u32 = 64 << 10;
/// Metadata of a request.
const MAX_HEADER_BYTES: u32 = 16 << 10;
/// Streams that a client opens and resets at once before anyone has looked at them; more end its connection ("rapid reset").
const MAX_PENDING_RESETS: usize = 32;
/// Streams of one connection that we reset for what its client sent; more end it.
const MAX_ERROR_RESETS: usize = 256;
/// A browser may remember for so long what it may send.
const PREFLIGHT_AGE: Duration = Duration::from_secs(3600);

/// Serves until a signal, then drains for at most `grace`.
pub async fn serve(app: Arc<App>, grace: Duration) -> anyhow::Result<()> {
    let signals = StopSignals::install().context("cannot take signals")?;
    let mut builder = Server::builder();
    if let Some(files) = &app.config.tls {
        builder = builder.tls_config(tls(files)?).with_context(|| format!("tls_certificate {}", files.certificate.display()))?;
    }
    let grpc = bind(app.config.listen_address).await?;
    let http = bind(app.config.http_address).await?;
    warn_of_open_port(grpc.local_addr()?, app.config.tls.is_some());
    // One line on stdout once both ports take connections: for scripts that asked for port 0.
    println!("listening grpc={} http={}", grpc.local_addr()?, http.local_addr()?);
    tokio::spawn(signals.watch(app.stopping.clone()));
    tokio::spawn(give_back(app.clone()));
    let http_served = axum::serve(http, http_routes(observed(&app))).into_future();
    let (reporter, health) = tonic_health::server::health_reporter();
    report(&reporter, ServingStatus::Serving).await;
    let routes = routes(&app, health)?;
    let stopping = app.stopping.clone();
    let stop = async move {
        stopping.cancelled().await;
        // First: whoever balances load must look elsewhere before connections go.
        report(&reporter, ServingStatus::NotServing).await;
    };
    // tonic leaves these to whoever brings the listener.
    let incoming = TcpIncoming::from(grpc)
        .with_nodelay(Some(true))
        .with_keepalive(Some(KEEPALIVE_INTERVAL))
        .with_keepalive_interval(Some(KEEPALIVE_TIMEOUT / KEEPALIVE_RETRIES))
        .with_keepalive_retries(Some(KEEPALIVE_RETRIES))
        .map(|accepted| accepted.inspect(hold_little));
    let grpc_served = builder
        .accept_http1(true)
        .http2_keepalive_interval(Some(KEEPALIVE_INTERVAL))
        .http2_keepalive_timeout(Some(KEEPALIVE_TIMEOUT))
        .max_concurrent_streams(Some(MAX_CONCURRENT_STREAMS))
        .initial_stream_window_size(Some(STREAM_WINDOW_BYTES))
        .initial_connection_window_size(Some(CONNECTION_WINDOW_BYTES))
        .http2_max_header_list_size(Some(MAX_HEADER_BYTES))
        .http2_max_pending_accept_reset_streams(Some(MAX_PENDING_RESETS))
        .http2_max_local_error_reset_streams(Some(MAX_ERROR_RESETS))
        .layer(ViewerPage)
        .layer(cors(&app.config.allowed_origins)?)
        .layer(GrpcWebLayer::new())
        .layer(RpcMetrics { metrics: app.metrics.clone() })
        .add_routes(routes)
        .serve_with_incoming_shutdown(incoming, stop);
    tokio::select! {
        (served, drained) = until_drained(grpc_served, &app.stopping, grace) => {
            match drained {
                Drained::Whole => tracing::info!("every connection has ended"),
                Drained::Cut => tracing::warn!(grace_seconds = grace.as_secs(), "connections that did not end in time are cut"),
            }
            served.transpose().context("cannot serve gRPC")?;
        }
        ended = http_served => ended.context("cannot serve HTTP")?,
    }
    Ok(())
}

/// Where it cannot be set, frames wait longer beside a download: nothing else.
fn hold_little(connection: &TcpStream) {
    #[cfg(any(target_os = "linux", target_os = "android"))]
    if let Err(error) = socket2::SockRef::from(connection).set_tcp_notsent_lowat(UNSENT_BYTES) {
        tracing::debug!(%error, "TCP_NOTSENT_LOWAT");
    }
}

async fn bind(address: SocketAddr) -> anyhow::Result<TcpListener> {
    TcpListener::bind(address).await.with_context(|| format!("cannot listen on {address}"))
}

/// There is no authorisation yet.
fn warn_of_open_port(address: SocketAddr, is_secure: bool) {
    if !address.ip().is_loopback() {
        let security = if is_secure { "encrypted" } else { "without transport security" };
        tracing::warn!(%address, security, "anyone who reaches this address can read, write and delete; put a proxy before it");
    }
}

fn tls(files: &TlsFiles) -> anyhow::Result<ServerTlsConfig> {
    let read = |key: &str, path: &Path| std::fs::read(path).with_context(|| format!("cannot read {key} {}", path.display()));
    let identity = Identity::from_pem(read("tls_certificate", &files.certificate)?, read("tls_private_key", &files.private_key)?);
    Ok(ServerTlsConfig::new().identity(identity).timeout(HANDSHAKE_TIMEOUT))
}

fn routes(app: &Arc<App>, health: HealthServer<impl Health>) -> anyhow::Result<Routes> {
    let api = || Api(app.clone());
    let mut routes = Routes::builder();
    routes.add_service(health);
    routes.add_service(reflection().build_v1()?);
    routes.add_service(reflection().build_v1alpha()?);
    routes.add_service(SystemServer::new(api()).max_decoding_message_size(MAX_REQUEST_BYTES));
    routes.add_service(DatasetsServer::new(api()).max_decoding_message_size(MAX_REQUEST_BYTES));
    routes.add_service(JobsServer::new(api()).max_decoding_message_size(MAX_REQUEST_BYTES));
    routes.add_service(CacheServer::new(api()).max_decoding_message_size(MAX_REQUEST_BYTES));
    let rendering = RenderingServer::new(api()).max_decoding_message_size(MAX_REQUEST_BYTES);
    routes.add_service(rendering.max_encoding_message_size(MAX_FRAME_MESSAGE_BYTES));
    Ok(routes.routes())
}

/// Describes our services and health; the builder adds reflection's own.
fn reflection() -> tonic_reflection::server::Builder<'static> {
    tonic_reflection::server::Builder::configure()
        .register_encoded_file_descriptor_set(FILE_DESCRIPTOR_SET)
        .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
}

/// Health of every service, and of the server as a whole under the empty name.
async fn report(reporter: &HealthReporter, status: ServingStatus) {
    for service in ["", SYSTEM, DATASETS, JOBS, RENDERING, CACHE] {
        reporter.set_service_status(service, status).await;
    }
}

/// Pages of these origins may call over gRPC-Web and read how a call ended.
fn cors(origins: &[String]) -> anyhow::Result<CorsLayer> {
    let origins = origins.iter().map(|o| o.parse::<HeaderValue>().context("allowed_origins")).collect::<Result<Vec<_>, _>>()?;
    let asked = ["content-type", "x-grpc-web", "x-user-agent", "grpc-timeout"].map(HeaderName::from_static);
    let told = ["grpc-status", "grpc-message", "grpc-status-details-bin"].map(HeaderName::from_static);
    let layer = CorsLayer::new().allow_origin(AllowOrigin::list(origins)).allow_methods([Method::POST]);
    Ok(layer.allow_headers(asked).expose_headers(told).max_age(PREFLIGHT_AGE))
}

/// What the second port shows; gauges of others are copied in at each scrape.
fn observed(app: &Arc<App>) -> Arc<Observed> {
    let seen = app.clone();
    let refresh = move |m: &Metrics| {
        let (pending, running) = seen.jobs.counts();
        m.jobs_pending.set(pending as i64);
        m.jobs_running.set(running as i64);
        m.sessions.set(seen.sessions.open() as i64);
        m.renders_waiting.set(seen.frames.waiting() as i64);
        let cache = seen.cache_stats();
        cache.tiers.iter().for_each(|t| m.cache_tier(tier_name(t), tier_counts(t)));
        for d in &cache.datasets {
            m.cache_dataset(&d.dataset, d.version, dataset_counts(d));
            d.tiers.iter().for_each(|t| m.cache_dataset_tier(tier_name(t), &d.dataset, d.version, tier_counts(t)));
        }
    };
    Arc::new(Observed { metrics: app.metrics.clone(), refresh: Box::new(refresh), stopping: app.stopping.clone() })
}
