//! Configuration: one table of keys; flag > environment > file > default; every value remembers where it came from.
//!
//! Values are parsed and checked here and nowhere else. An unknown key in the file, or a value that makes no sense, is refused with
//! the key, the value, its origin and what was expected.

use std::collections::BTreeMap;
use std::env;
use std::ffi::OsString;
use std::fmt;
use std::fs;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::{Arg, ArgAction, ArgMatches, Command};
use lumisphere::textures::{CacheOptions, PolicyKind};
use thiserror::Error;

/// Everything the operator can set.
#[derive(Debug, Clone, PartialEq)]
pub struct Config {
    /// gRPC and gRPC-Web. Port 0 takes a free one.
    pub listen_address: SocketAddr,
    /// `/metrics`, `/healthz`, `/readyz`. Port 0 takes a free one.
    pub http_address: SocketAddr,
    /// Datasets, blobs and job records.
    pub data_dir: PathBuf,
    /// Of gRPC's port; None for no transport security.
    pub tls: Option<TlsFiles>,
    /// What renders.
    pub backend: BackendChoice,
    /// Both memory tiers of the texture cache.
    pub cache: CacheOptions,
    /// Budget of textures on the graphics adapter.
    pub gpu_cache_bytes: u64,
    /// Which page leaves the adapter first.
    pub gpu_cache_policy: PolicyKind,
    /// Texels that a viewer's frame waits for; coarse ones stand in for the rest.
    pub gpu_upload_bytes_per_frame: u64,
    /// Whether pages are brought before a viewer's frame wants them.
    pub prefetch: Prefetch,
    /// Width · height.
    pub max_pixels_per_frame: u64,
    /// Renders that wait.
    pub render_queue_length: usize,
    /// Viewers at once: `Interact` streams and sessions.
    pub max_sessions: usize,
    /// Of those, who is sent H.264.
    pub max_video_sessions: usize,
    /// How long a session is kept while no stream of it is open.
    pub session_expiry: Duration,
    /// How long a viewer may leave a frame unread or unacknowledged.
    pub mute_viewer: Duration,
    /// Jobs that run at once.
    pub max_concurrent_jobs: usize,
    /// Threads that jobs share; 0 for one a core.
    pub job_threads: usize,
    /// Memory that the scene of one job may take while it is traced.
    pub job_scene_bytes: u64,
    /// Jobs that wait.
    pub max_queued_jobs: usize,
    /// Ended jobs that are remembered.
    pub jobs_kept: usize,
    /// Cameras in one job.
    pub max_cameras_per_job: usize,
    /// Of one uploaded blob.
    pub max_blob_bytes: u64,
    /// Of all unfinished uploads together.
    pub max_unfinished_upload_bytes: u64,
    /// Origins of web pages that may call; empty for none.
    pub allowed_origins: Vec<String>,
    /// How long open streams may go on once the server was asked to stop.
    pub shutdown_grace: Duration,
    /// What is logged (`tracing` filter directives).
    pub log: String,
}

/// PEM files.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TlsFiles {
    /// The server's, then those that vouch for it.
    pub certificate: PathBuf,
    /// The first one's.
    pub private_key: PathBuf,
}

/// Whether pages are brought ahead.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Prefetch {
    /// Never.
    Off,
    /// Those that a moving viewer's next frame would miss.
    Motion,
}

/// What renders.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BackendChoice {
    /// The GPU if there is an adapter, else the CPU.
    Auto,
    /// Refuse to start without an adapter.
    Gpu,
    /// Never look for one.
    Cpu,
}

/// Where a value came from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Origin {
    /// Built in.
    Default,
    /// The configuration file.
    File(PathBuf),
    /// This variable.
    Environment(String),
    /// This flag.
    Flag(String),
}

/// One key's effective value, for people.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Entry {
    /// As in the file.
    pub key: &'static str,
    /// As TOML.
    pub value: String,
    /// Where from.
    pub origin: Origin,
}

/// The configuration and its account.
#[derive(Debug, Clone)]
pub struct Effective {
    /// Checked values.
    pub config: Config,
    /// One a key, sorted by key.
    pub entries: Vec<Entry>,
}

/// Why there is no configuration.
#[derive(Debug, Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read the configuration file: {source}: {}", path.display())]
    Unreadable {
        /// The operating system's reason.
        source: std::io::Error,
        /// As given.
        path: PathBuf,
    },
    /// The file is not TOML.
    #[error("the configuration file is not TOML: {source}: {}", path.display())]
    NotToml {
        /// Line and column in its message.
        source: Box<toml::de::Error>,
        /// As given.
        path: PathBuf,
    },
    /// The file has a key that does not exist.
    #[error("unknown key `{key}` in the configuration file{}: {}", did_you_mean(key), path.display())]
    UnknownKey {
        /// As written.
        key: String,
        /// As given.
        path: PathBuf,
    },
    /// The value makes no sense.
    #[error("{key} = {value} ({origin}): {expected} expected")]
    BadValue {
        /// Which.
        key: &'static str,
        /// As given.
        value: String,
        /// Where from.
        origin: Origin,
        /// What would do.
        expected: String,
    },
}

/// One row of the table of keys.
struct Setting {
    key: &'static str,
    kind: Kind,
    /// As TOML.
    default: &'static str,
    about: &'static str,
}

/// What a value must be.
enum Kind {
    Address,
    Path,
    /// Or empty, for none.
    OptionalPath,
    Text,
    Choice(&'static [&'static str]),
    Count {
        min: u64,
        max: u64,
    },
    Origins,
}

/// A value that is what its kind asks.
#[derive(Debug, Clone, PartialEq)]
enum Value {
    Text(String),
    Count(u64),
    List(Vec<String>),
}

const POLICIES: &[&str] = &["lru", "clock", "arc", "s3_fifo", "frame_lru", "gittins"];

const SETTINGS: &[Setting] = &[
    Setting { key: "listen_address", kind: Kind::Address, default: "\"127.0.0.1:7443\"", about: "Address and port of gRPC and gRPC-Web" },
    Setting {
        key: "http_address",
        kind: Kind::Address,
        default: "\"127.0.0.1:7444\"",
        about: "Address and port of /metrics, /healthz and /readyz",
    },
    Setting {
        key: "tls_certificate",
        kind: Kind::OptionalPath,
        default: "\"\"",
        about: "The server's certificate and those that vouch for it (PEM), for gRPC over TLS; \"\" for none",
    },
    Setting { key: "tls_private_key", kind: Kind::OptionalPath, default: "\"\"", about: "That certificate's private key (PEM)" },
    Setting { key: "data_dir", kind: Kind::Path, default: "\"lumisphere-data\"", about: "Folder of datasets, blobs and job records" },
    Setting {
        key: "backend",
        kind: Kind::Choice(&["auto", "gpu", "cpu"]),
        default: "\"auto\"",
        about: "What renders: auto (the GPU if there is one), gpu (refuse to start without) or cpu",
    },
    Setting {
        key: "memory_cache_bytes",
        kind: Kind::Count { min: 0, max: 1 << 44 },
        default: "536870912",
        about: "Budget of decoded texture pages in memory",
    },
    Setting {
        key: "gpu_cache_bytes",
        kind: Kind::Count { min: 0, max: 1 << 44 },
        default: "1073741824",
        about: "Budget of textures on the graphics adapter",
    },
    Setting {
        key: "compressed_cache_bytes",
        kind: Kind::Count { min: 0, max: 1 << 44 },
        default: "0",
        about: "Budget of compressed texture blocks in memory; 0 keeps none",
    },
    Setting {
        key: "memory_cache_policy",
        kind: Kind::Choice(POLICIES),
        default: "\"gittins\"",
        about: "Which decoded page leaves first: gittins, lru, clock, arc, s3_fifo or frame_lru",
    },
    Setting {
        key: "compressed_cache_policy",
        kind: Kind::Choice(POLICIES),
        default: "\"lru\"",
        about: "Which compressed block leaves first",
    },
    Setting { key: "gpu_cache_policy", kind: Kind::Choice(POLICIES), default: "\"lru\"", about: "Which page leaves the adapter first" },
    Setting {
        key: "gpu_upload_bytes_per_frame",
        kind: Kind::Count { min: 1, max: 1 << 44 },
        default: "16777216",
        about: "Texels that a viewer's frame waits for; coarse ones stand in for the rest, and a better frame follows",
    },
    Setting {
        key: "prefetch",
        kind: Kind::Choice(&["motion", "off"]),
        default: "\"motion\"",
        about: "motion: between the frames of a viewer who moves, bring pages that the next one would miss on the adapter; or off",
    },
    Setting {
        key: "read_strategy",
        kind: Kind::Choice(&["on_demand", "on_demand_restart", "half_threshold", "full_image", "block"]),
        default: "\"block\"",
        about: "What a miss of the CPU renderer decodes: on_demand, on_demand_restart, half_threshold, full_image or block",
    },
    Setting {
        key: "max_pixels_per_frame",
        kind: Kind::Count { min: 1, max: 1 << 28 },
        default: "8388608",
        about: "Most pixels (width times height) of one frame",
    },
    Setting {
        key: "render_queue_length",
        kind: Kind::Count { min: 1, max: 65_536 },
        default: "64",
        about: "Renders that may wait before new ones are refused",
    },
    Setting {
        key: "max_sessions",
        kind: Kind::Count { min: 1, max: 65_536 },
        default: "64",
        about: "Viewers at once: Interact streams and sessions",
    },
    Setting {
        key: "max_video_sessions",
        kind: Kind::Count { min: 1, max: 65_536 },
        default: "8",
        about: "Of those, how many may be sent H.264",
    },
    Setting {
        key: "session_expiry_seconds",
        kind: Kind::Count { min: 1, max: 86_400 },
        default: "30",
        about: "Seconds that a viewer's session is kept while no stream of it is open",
    },
    Setting {
        key: "mute_viewer_seconds",
        kind: Kind::Count { min: 1, max: 86_400 },
        default: "60",
        about: "Seconds that a viewer may leave a frame unread or unacknowledged before its stream is ended",
    },
    Setting { key: "max_concurrent_jobs", kind: Kind::Count { min: 1, max: 64 }, default: "1", about: "Jobs that run at once" },
    Setting {
        key: "job_threads",
        kind: Kind::Count { min: 0, max: 1024 },
        default: "0",
        about: "Threads that all jobs share; 0 for one per core",
    },
    Setting {
        key: "job_scene_bytes",
        kind: Kind::Count { min: 0, max: 1 << 44 },
        default: "2147483648",
        about: "Memory that the scene of one job may take while it is traced",
    },
    Setting {
        key: "max_queued_jobs",
        kind: Kind::Count { min: 1, max: 65_536 },
        default: "64",
        about: "Jobs that may wait before new ones are refused",
    },
    Setting {
        key: "jobs_kept",
        kind: Kind::Count { min: 1, max: 65_536 },
        default: "200",
        about: "Ended jobs that are remembered; the oldest go first",
    },
    Setting { key: "max_cameras_per_job", kind: Kind::Count { min: 1, max: 100_000 }, default: "10000", about: "Most cameras in one job" },
    Setting {
        key: "max_blob_bytes",
        kind: Kind::Count { min: 1, max: 1 << 40 },
        default: "4294967296",
        about: "Most bytes of one uploaded blob",
    },
    Setting {
        key: "max_unfinished_upload_bytes",
        kind: Kind::Count { min: 1, max: 1 << 44 },
        default: "17179869184",
        about: "Most announced bytes of all unfinished uploads together",
    },
    Setting {
        key: "allowed_origins",
        kind: Kind::Origins,
        default: "[]",
        about: "Origins of web pages that may call over gRPC-Web, separated by commas (\"https://viewer.example\")",
    },
    Setting {
        key: "shutdown_grace_seconds",
        kind: Kind::Count { min: 0, max: 3600 },
        default: "20",
        about: "Seconds that open streams may go on once the server was asked to stop",
    },
    Setting { key: "log", kind: Kind::Text, default: "\"info\"", about: "What is logged: tracing filter directives (\"info\", \"debug\")" },
];

impl Effective {
    /// From the process: its arguments, its environment and the file that `--config` names.
    /// Returns the matches too, for `--print-config`. Wrong usage, `--help` and `--version` end in the `clap::Error`.
    pub fn from_process() -> Result<Result<(Self, bool), ConfigError>, clap::Error> {
        let matches = command().try_get_matches()?;
        let file = matches.get_one::<PathBuf>("config").cloned();
        let print = matches.get_flag("print-config");
        Ok(Self::new(file.as_deref(), &|name| env::var_os(name), &matches).map(|effective| (effective, print)))
    }

    /// Layers default, file, environment and flags.
    fn new(file: Option<&Path>, variable: &dyn Fn(&str) -> Option<OsString>, flags: &ArgMatches) -> Result<Self, ConfigError> {
        let mut values = BTreeMap::new();
        for setting in SETTINGS {
            let default = setting.default.parse::<toml::Value>().expect("the table's defaults are TOML");
            values.insert(setting.key, (setting.check_toml(&default, &Origin::Default)?, Origin::Default));
        }
        if let Some(path) = file {
            read_file(path, &mut values)?;
        }
        for setting in SETTINGS {
            let name = format!("LUMISPHERE_{}", setting.key.to_uppercase());
            if let Some(text) = variable(&name) {
                let origin = Origin::Environment(name);
                values.insert(setting.key, (setting.check_text(&text.to_string_lossy(), &origin)?, origin));
            }
            if let Some(text) = flags.get_one::<String>(setting.key) {
                let origin = Origin::Flag(format!("--{}", setting.flag()));
                values.insert(setting.key, (setting.check_text(text, &origin)?, origin));
            }
        }
        let entries = values.iter().map(|(key, (value, origin))| Entry { key, value: value.to_string(), origin: origin.clone() }).collect();
        Ok(Self { config: Config::from_values(&values)?, entries })
    }
}

impl fmt::Display for Effective {
    /// TOML with the origins as comments: what `--print-config` prints can be used as a file.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.entries.iter().try_for_each(|e| writeln!(f, "{} = {}  # {}", e.key, e.value, e.origin))
    }
}

impl fmt::Display for Origin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Default => f.write_str("default"),
            Self::File(path) => write!(f, "file {}", path.display()),
            Self::Environment(name) => write!(f, "environment {name}"),
            Self::Flag(flag) => write!(f, "flag {flag}"),
        }
    }
}

impl fmt::Display for Value {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Text(text) => toml::Value::from(text.as_str()).fmt(f),
            Self::Count(count) => count.fmt(f),
            Self::List(list) => toml::Value::from(list.clone()).fmt(f),
        }
    }
}

impl Config {
    fn from_values(values: &BTreeMap<&'static str, (Value, Origin)>) -> Result<Self, ConfigError> {
        let text = |key: &str| match &values[key].0 {
            Value::Text(text) => text.clone(),
            other => unreachable!("{key} is text by the table, not {other}"),
        };
        let count = |key: &str| match values[key].0 {
            Value::Count(count) => count,
            ref other => unreachable!("{key} is a count by the table, not {other}"),
        };
        let list = |key: &str| match &values[key].0 {
            Value::List(list) => list.clone(),
            other => unreachable!("{key} is a list by the table, not {other}"),
        };
        let address = |key: &str| text(key).parse().expect("addresses were checked by their kind");
        let policy = |key: &str| text(key).parse::<PolicyKind>().expect("the table's choices are the policies' names");
        let size = |key: &str| usize::try_from(count(key)).expect("counts that become sizes are bounded by the table");
        let tls = match (text("tls_certificate"), text("tls_private_key")) {
            (certificate, private_key) if certificate.is_empty() && private_key.is_empty() => None,
            (certificate, private_key) if !certificate.is_empty() && !private_key.is_empty() => {
                Some(TlsFiles { certificate: certificate.into(), private_key: private_key.into() })
            }
            (certificate, _) => {
                let key = if certificate.is_empty() { "tls_certificate" } else { "tls_private_key" };
                let (value, origin) = values[key].clone();
                let expected = "a path, since the other of certificate and private key is given".into();
                return Err(ConfigError::BadValue { key, value: value.to_string(), origin, expected });
            }
        };
        Ok(Self {
            listen_address: address("listen_address"),
            http_address: address("http_address"),
            data_dir: text("data_dir").into(),
            tls,
            backend: match text("backend").as_str() {
                "gpu" => BackendChoice::Gpu,
                "cpu" => BackendChoice::Cpu,
                _ => BackendChoice::Auto,
            },
            cache: CacheOptions {
                decoded_bytes: count("memory_cache_bytes"),
                compressed_bytes: count("compressed_cache_bytes"),
                decoded_policy: policy("memory_cache_policy"),
                compressed_policy: policy("compressed_cache_policy"),
                strategy: text("read_strategy").parse().expect("the table's choices are the strategies' names"),
            },
            gpu_cache_bytes: count("gpu_cache_bytes"),
            gpu_cache_policy: policy("gpu_cache_policy"),
            gpu_upload_bytes_per_frame: count("gpu_upload_bytes_per_frame"),
            prefetch: match text("prefetch").as_str() {
                "off" => Prefetch::Off,
                _ => Prefetch::Motion,
            },
            max_pixels_per_frame: count("max_pixels_per_frame"),
            render_queue_length: size("render_queue_length"),
            max_sessions: size("max_sessions"),
            max_video_sessions: size("max_video_sessions"),
            session_expiry: Duration::from_secs(count("session_expiry_seconds")),
            mute_viewer: Duration::from_secs(count("mute_viewer_seconds")),
            max_concurrent_jobs: size("max_concurrent_jobs"),
            job_threads: size("job_threads"),
            job_scene_bytes: count("job_scene_bytes"),
            max_queued_jobs: size("max_queued_jobs"),
            jobs_kept: size("jobs_kept"),
            max_cameras_per_job: size("max_cameras_per_job"),
            max_blob_bytes: count("max_blob_bytes"),
            max_unfinished_upload_bytes: count("max_unfinished_upload_bytes"),
            allowed_origins: list("allowed_origins"),
            shutdown_grace: Duration::from_secs(count("shutdown_grace_seconds")),
            log: text("log"),
        })
    }
}

impl Setting {
    fn flag(&self) -> String {
        self.key.replace('_', "-")
    }

    /// From the file.
    fn check_toml(&self, value: &toml::Value, origin: &Origin) -> Result<Value, ConfigError> {
        let list_of_text = |items: &Vec<toml::Value>| items.iter().map(|i| i.as_str().map(String::from)).collect::<Option<Vec<_>>>();
        let parsed = match value {
            toml::Value::String(text) => Some(Value::Text(text.clone())),
            toml::Value::Integer(count) => u64::try_from(*count).ok().map(Value::Count),
            toml::Value::Array(items) => list_of_text(items).map(Value::List),
            _ => None,
        };
        parsed.and_then(|v| self.accept(v)).ok_or_else(|| self.refuse(value.to_string(), origin))
    }

    /// From a variable or a flag, which have no types of their own.
    fn check_text(&self, text: &str, origin: &Origin) -> Result<Value, ConfigError> {
        let parsed = match self.kind {
            Kind::Count { .. } => text.trim().replace('_', "").parse().ok().map(Value::Count),
            Kind::Origins => Some(Value::List(text.split(',').map(str::trim).filter(|o| !o.is_empty()).map(String::from).collect())),
            Kind::Address | Kind::Path | Kind::OptionalPath | Kind::Text | Kind::Choice(_) => Some(Value::Text(text.into())),
        };
        parsed.and_then(|v| self.accept(v)).ok_or_else(|| self.refuse(format!("{text:?}"), origin))
    }

    /// The value, if it is what the kind asks.
    fn accept(&self, value: Value) -> Option<Value> {
        let fits = match (&self.kind, &value) {
            (Kind::Address, Value::Text(text)) => text.parse::<SocketAddr>().is_ok(),
            (Kind::Path, Value::Text(text)) => !text.is_empty() && !text.contains('\0'),
            (Kind::OptionalPath, Value::Text(text)) => !text.contains('\0'),
            (Kind::Text, Value::Text(text)) => text.parse::<tracing_subscriber::EnvFilter>().is_ok(),
            (Kind::Choice(choices), Value::Text(text)) => choices.contains(&text.as_str()),
            (Kind::Count { min, max }, Value::Count(count)) => (min..=max).contains(&count),
            (Kind::Origins, Value::List(origins)) => origins.iter().all(|o| is_origin(o)),
            _ => false,
        };
        fits.then_some(value)
    }

    fn refuse(&self, value: String, origin: &Origin) -> ConfigError {
        let expected = match &self.kind {
            Kind::Address => "an IP address and a port (\"127.0.0.1:7443\")".to_string(),
            Kind::Path => "a path that is not empty".to_string(),
            Kind::OptionalPath => "a path, or \"\" for none".to_string(),
            Kind::Text => "tracing filter directives (\"info\", \"lumisphere_server=debug\")".to_string(),
            Kind::Choice(choices) => format!("one of {}", choices.join(", ")),
            Kind::Count { min, max } => format!("an integer from {min} to {max}"),
            Kind::Origins => "a list of origins (\"https://viewer.example\")".to_string(),
        };
        ConfigError::BadValue { key: self.key, value, origin: origin.clone(), expected }
    }
}

/// Scheme, host and perhaps a port; nothing after it.
fn is_origin(text: &str) -> bool {
    let host = text.strip_prefix("https://").or_else(|| text.strip_prefix("http://"));
    host.is_some_and(|h| !h.is_empty() && h.bytes().all(|b| b.is_ascii_alphanumeric() || b"-._:[]".contains(&b)))
}

fn read_file(path: &Path, values: &mut BTreeMap<&'static str, (Value, Origin)>) -> Result<(), ConfigError> {
    let text = fs::read_to_string(path).map_err(|source| ConfigError::Unreadable { source, path: path.into() })?;
    let table: toml::Table = text.parse().map_err(|source| ConfigError::NotToml { source: Box::new(source), path: path.into() })?;
    for (key, value) in &table {
        let setting = SETTINGS.iter().find(|s| s.key == key);
        let setting = setting.ok_or_else(|| ConfigError::UnknownKey { key: key.clone(), path: path.into() })?;
        let origin = Origin::File(path.into());
        values.insert(setting.key, (setting.check_toml(value, &origin)?, origin));
    }
    Ok(())
}

/// " (did you mean `…`?)" for a key that holds, or is held by, the unknown one, or shares its first word.
fn did_you_mean(unknown: &str) -> String {
    let first = |key: &str| key.split(['_', '-']).next().unwrap_or_default().to_string();
    let near = SETTINGS.iter().find(|s| s.key.contains(unknown) || unknown.contains(s.key));
    let near = near.or_else(|| SETTINGS.iter().find(|s| first(s.key) == first(unknown)));
    near.map(|s| format!(" (did you mean `{}`?)", s.key)).unwrap_or_default()
}

/// The command line: one flag a key.
fn command() -> Command {
    let command = Command::new("lumisphere-server")
        .version(env!("CARGO_PKG_VERSION"))
        .about("Serves captured appearance over gRPC: datasets, jobs and frames")
        .after_help("Each key can also be set by LUMISPHERE_<KEY> or in the file; flag > environment > file > default.")
        .arg(Arg::new("config").long("config").value_name("FILE").value_parser(clap::value_parser!(PathBuf)).help("Configuration (TOML)"))
        .arg(
            Arg::new("print-config")
                .long("print-config")
                .action(ArgAction::SetTrue)
                .help("Print the configuration in effect with the origin of every value, and end"),
        );
    SETTINGS.iter().fold(command, |command, setting| {
        let about = format!("{} [default: {}]", setting.about, setting.default.trim_matches('"'));
        command.arg(Arg::new(setting.key).long(setting.flag()).value_name("VALUE").allow_hyphen_values(true).help(about))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn effective(file: Option<&str>, variables: &[(&str, &str)], flags: &[&str]) -> Result<Effective, ConfigError> {
        let folder = tempfile::tempdir().unwrap();
        let path = file.map(|text| {
            let path = folder.path().join("server.toml");
            fs::write(&path, text).unwrap();
            path
        });
        let matches = command().get_matches_from([&["lumisphere-server"], flags].concat());
        let variable = |name: &str| variables.iter().find(|(n, _)| *n == name).map(|(_, v)| OsString::from(v));
        Effective::new(path.as_deref(), &variable, &matches)
    }

    fn origin_of<'a>(effective: &'a Effective, key: &str) -> &'a Origin {
        &effective.entries.iter().find(|e| e.key == key).unwrap().origin
    }

    #[test]
    fn flag_beats_environment_beats_file_beats_default() {
        let file = Some("max_sessions = 1\njobs_kept = 2\nlog = \"warn\"");
        let variables = [("LUMISPHERE_MAX_SESSIONS", "3"), ("LUMISPHERE_JOBS_KEPT", "4")];
        let effective = effective(file, &variables, &["--max-sessions", "5"]).unwrap();
        assert_eq!((effective.config.max_sessions, effective.config.jobs_kept, effective.config.log.as_str()), (5, 4, "warn"));
        assert_eq!(origin_of(&effective, "max_sessions"), &Origin::Flag("--max-sessions".into()));
        assert_eq!(origin_of(&effective, "jobs_kept"), &Origin::Environment("LUMISPHERE_JOBS_KEPT".into()));
        assert!(matches!(origin_of(&effective, "log"), Origin::File(_)));
        assert_eq!(origin_of(&effective, "backend"), &Origin::Default);
    }

    #[test]
    fn an_unknown_key_is_refused_by_name_with_the_nearest_one() {
        let error = effective(Some("memory_cache = 3"), &[], &[]).unwrap_err().to_string();
        assert!(error.starts_with("unknown key `memory_cache` in the configuration file (did you mean `memory_cache_bytes`?)"), "{error}");
    }

    #[test]
    fn nonsense_is_refused_with_key_value_origin_and_what_was_expected() {
        let refused = |file: &str| effective(Some(file), &[], &[]).unwrap_err().to_string();
        assert!(refused("max_sessions = -1").contains("max_sessions = -1 (file "));
        assert!(refused("max_sessions = 0").ends_with("an integer from 1 to 65536 expected"));
        assert!(refused("max_sessions = true").ends_with("an integer from 1 to 65536 expected"));
        assert!(refused("listen_address = \"localhost\"").contains("an IP address and a port"));
        assert!(refused("backend = \"tpu\"").ends_with("one of auto, gpu, cpu expected"));
        assert!(refused("tls_certificate = \"a.pem\"").contains("tls_private_key = \"\" (default): a path, since"));
        assert!(refused("tls_private_key = \"a.key\"").contains("tls_certificate = \"\" (default): a path, since"));
        assert!(refused("data_dir = \"\"").contains("a path that is not empty"));
        assert!(refused("allowed_origins = [\"viewer.example/path\"]").contains("a list of origins"));
        assert!(refused("max_sessions = ").contains("not TOML"));
        let from_flag = effective(None, &[], &["--jobs-kept", "many"]).unwrap_err().to_string();
        assert_eq!(from_flag, "jobs_kept = \"many\" (flag --jobs-kept): an integer from 1 to 65536 expected");
        let from_variable = effective(None, &[("LUMISPHERE_LOG", "a=b=c")], &[]).unwrap_err().to_string();
        assert!(from_variable.starts_with("log = \"a=b=c\" (environment LUMISPHERE_LOG)"), "{from_variable}");
    }

    #[test]
    fn what_is_printed_can_be_read_again() {
        let first =
            effective(None, &[("LUMISPHERE_ALLOWED_ORIGINS", "http://a.example:80, https://b.example")], &["--log", "warn"]).unwrap();
        assert_eq!(first.config.allowed_origins, ["http://a.example:80", "https://b.example"]);
        let second = effective(Some(&first.to_string()), &[], &[]).unwrap();
        assert_eq!(first.config, second.config);
    }

    #[test]
    fn the_shipped_file_has_every_key_at_its_default_under_a_comment() {
        let shipped = include_str!("../../../deploy/server.toml");
        let effective = effective(Some(shipped), &[], &[]).unwrap();
        for setting in SETTINGS {
            assert!(matches!(origin_of(&effective, setting.key), Origin::File(_)), "{} is missing", setting.key);
            let lines: Vec<&str> = shipped.lines().collect();
            let at = lines.iter().position(|l| l.starts_with(&format!("{} = ", setting.key))).unwrap();
            assert!(at > 0 && lines[at - 1].starts_with("# "), "{} has no comment", setting.key);
            let default: toml::Value = setting.default.parse().unwrap();
            let value = effective.entries.iter().find(|e| e.key == setting.key).unwrap().value.clone();
            assert_eq!(value, setting.check_toml(&default, &Origin::Default).unwrap().to_string(), "{}", setting.key);
        }
    }
}
