//! What every command needs: where the server is, how long to wait, how to print. Flag > environment > file > default.

use std::cell::RefCell;
use std::path::{Path, PathBuf};
use std::time::Duration;
use std::{env, fs, io};

use anyhow::Context as _;
use lumisphere_proto::MAX_FRAME_MESSAGE_BYTES;
use lumisphere_proto::v1alpha1::cache_client::CacheClient;
use lumisphere_proto::v1alpha1::datasets_client::DatasetsClient;
use lumisphere_proto::v1alpha1::jobs_client::JobsClient;
use lumisphere_proto::v1alpha1::rendering_client::RenderingClient;
use lumisphere_proto::v1alpha1::system_client::SystemClient;
use serde::Deserialize;
use tonic::Request;
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Endpoint};

use crate::cli::Global;
use crate::exit::Failure;
use crate::output::Output;

/// The server's own default.
const DEFAULT_SERVER: &str = "http://127.0.0.1:7443";
/// Longer than the slowest frame on a software adapter, short enough to notice a server that hangs.
const DEFAULT_REQUEST_TIMEOUT: Duration = Duration::from_secs(120);
/// Beyond this a connection attempt on any network is hopeless.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(10);
/// Notices a dead peer under a quiet stream.
const KEEP_ALIVE: Duration = Duration::from_secs(20);

/// Where, how long, and how to print.
pub struct Context {
    server: String,
    ca_certificate: Option<PathBuf>,
    timeout: Option<Duration>,
    /// Standard output and standard error.
    pub output: Output,
    interrupt_note: RefCell<Option<String>>,
}

/// `client.toml`.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct ConfigFile {
    server: Option<String>,
    ca_certificate: Option<PathBuf>,
    timeout_seconds: Option<f64>,
}

/// One connection, all services.
#[derive(Clone)]
pub struct Server {
    channel: Channel,
}

impl Context {
    /// Reads the configuration file and settles every value.
    pub fn new(global: Global) -> anyhow::Result<Self> {
        let file = ConfigFile::load(global.config.as_deref())?;
        let seconds = global.timeout_seconds.or(file.timeout_seconds);
        let timeout = seconds.map(positive_seconds).transpose()?;
        let server = global.server.or(file.server).unwrap_or_else(|| DEFAULT_SERVER.into());
        let ca_certificate = global.ca_certificate.or(file.ca_certificate);
        Ok(Self { server, ca_certificate, timeout, output: Output::new(global.json, global.quiet), interrupt_note: RefCell::new(None) })
    }

    /// Connects, or says what could not be reached.
    pub async fn connect(&self) -> anyhow::Result<Server> {
        let bad_address =
            |e: &dyn std::fmt::Display| Failure::Usage(format!("--server {:?} is no address like {DEFAULT_SERVER}: {e}", self.server));
        let endpoint = Endpoint::from_shared(self.server.clone()).map_err(|e| bad_address(&e))?;
        if endpoint.uri().scheme().is_none() {
            return Err(bad_address(&"http:// or https:// is missing").into());
        }
        let is_secure = endpoint.uri().scheme_str() == Some("https");
        let endpoint = if is_secure { endpoint.tls_config(self.trust()?).map_err(|e| self.untrusted(&e))? } else { endpoint };
        let endpoint = endpoint
            .connect_timeout(self.timeout.unwrap_or(CONNECT_TIMEOUT).min(CONNECT_TIMEOUT))
            .tcp_nodelay(true)
            .http2_keep_alive_interval(KEEP_ALIVE)
            .keep_alive_while_idle(true);
        let unreachable = |e: tonic::transport::Error| Failure::Unavailable(format!("cannot reach {}: {}", self.server, innermost(&e)));
        Ok(Server { channel: endpoint.connect().await.map_err(unreachable)? })
    }

    /// Whom to believe that they are the server.
    fn trust(&self) -> anyhow::Result<ClientTlsConfig> {
        let Some(path) = &self.ca_certificate else { return Ok(ClientTlsConfig::new().with_native_roots()) };
        let pem = fs::read(path).with_context(|| format!("cannot read the certificate {}", path.display()))?;
        Ok(ClientTlsConfig::new().ca_certificate(Certificate::from_pem(pem)))
    }

    fn untrusted(&self, error: &tonic::transport::Error) -> Failure {
        let named = self.ca_certificate.as_ref().map(|path| format!("{}: ", path.display())).unwrap_or_default();
        Failure::Usage(format!("{named}no certificate that could be trusted: {}", innermost(error)))
    }

    /// A request that is answered at once.
    pub fn request<T>(&self, message: T) -> Request<T> {
        let mut request = Request::new(message);
        request.set_timeout(self.timeout.unwrap_or(DEFAULT_REQUEST_TIMEOUT));
        request
    }

    /// A request that takes as long as it takes, unless `--timeout-seconds` says otherwise.
    pub fn patient_request<T>(&self, message: T) -> Request<T> {
        let mut request = Request::new(message);
        if let Some(timeout) = self.timeout {
            request.set_timeout(timeout);
        }
        request
    }

    /// What `--timeout-seconds` says for a whole stream.
    pub fn timeout(&self) -> Option<Duration> {
        self.timeout
    }

    /// What Ctrl-C shall say from now on.
    pub fn on_interrupt(&self, note: Option<String>) {
        *self.interrupt_note.borrow_mut() = note;
    }

    /// See `on_interrupt`.
    pub fn interrupt_note(&self) -> Option<String> {
        self.interrupt_note.borrow().clone()
    }
}

impl Server {
    /// Datasets and blobs.
    pub fn datasets(&self) -> DatasetsClient<Channel> {
        DatasetsClient::new(self.channel.clone())
    }

    /// Long work.
    pub fn jobs(&self) -> JobsClient<Channel> {
        JobsClient::new(self.channel.clone()).max_decoding_message_size(MAX_FRAME_MESSAGE_BYTES)
    }

    /// Frames.
    pub fn rendering(&self) -> RenderingClient<Channel> {
        RenderingClient::new(self.channel.clone()).max_decoding_message_size(MAX_FRAME_MESSAGE_BYTES)
    }

    /// The texture cache.
    pub fn cache(&self) -> CacheClient<Channel> {
        CacheClient::new(self.channel.clone())
    }

    /// Version, adapter, limits.
    pub fn system(&self) -> SystemClient<Channel> {
        SystemClient::new(self.channel.clone())
    }
}

impl ConfigFile {
    /// The named file, which must exist, or the default one, which need not.
    fn load(named: Option<&Path>) -> anyhow::Result<Self> {
        let Some(path) = named.map(Path::to_path_buf).or_else(default_config_path) else { return Ok(Self::default()) };
        let text = match fs::read_to_string(&path) {
            Err(e) if named.is_none() && e.kind() == io::ErrorKind::NotFound => return Ok(Self::default()),
            other => other.with_context(|| format!("cannot read the configuration file {}", path.display()))?,
        };
        toml::from_str(&text).map_err(|e| Failure::Usage(format!("{}: {e}", path.display())).into())
    }
}

fn default_config_path() -> Option<PathBuf> {
    let base = env::var_os("XDG_CONFIG_HOME").map(PathBuf::from).or_else(|| Some(PathBuf::from(env::var_os("HOME")?).join(".config")))?;
    Some(base.join("lumisphere/client.toml"))
}

fn positive_seconds(seconds: f64) -> Result<Duration, Failure> {
    let refuse = || Failure::Usage(format!("timeout_seconds is {seconds}, a positive number expected"));
    if !(seconds > 0.0) {
        return Err(refuse());
    }
    Duration::try_from_secs_f64(seconds).map_err(|_| refuse())
}

/// "connection refused" rather than "transport error".
fn innermost(error: &dyn std::error::Error) -> String {
    let mut cause = error;
    while let Some(next) = cause.source() {
        cause = next;
    }
    cause.to_string()
}
