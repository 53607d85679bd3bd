//! The real binaries: a server on free ports and a folder of its own, and the command line against it.

use std::fs::{self, File};
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::sync::mpsc;
use std::thread;
use std::time::Duration;

use lumisphere_proto::MAX_FRAME_MESSAGE_BYTES;
use lumisphere_proto::v1alpha1::datasets_client::DatasetsClient;
use lumisphere_proto::v1alpha1::jobs_client::JobsClient;
use lumisphere_proto::v1alpha1::rendering_client::RenderingClient;
use lumisphere_proto::v1alpha1::system_client::SystemClient;
use tonic::transport::{Certificate, Channel, ClientTlsConfig};

/// Far beyond what anything here takes, so that a hang is a failure and a slow machine is not.
pub const PATIENCE: Duration = Duration::from_secs(120);

/// A folder under `target/tmp` that is removed at the end.
pub fn temporary_folder() -> tempfile::TempDir {
    tempfile::Builder::new().prefix("it-").tempdir_in(env!("CARGO_TARGET_TMPDIR")).expect("target/tmp is writable")
}

/// `target/debug` beside the running test, or what the profile is.
pub fn binary(name: &str) -> PathBuf {
    let test = std::env::current_exe().expect("a test has a path");
    let path = test.parent().and_then(Path::parent).expect("tests lie in target/PROFILE/deps").join(name);
    assert!(path.exists(), "{} is missing: cargo build --workspace --bins --examples", path.display());
    path
}

/// A running `lumisphere-server`; killed when dropped.
pub struct Server {
    child: Child,
    log: PathBuf,
    /// "http://127.0.0.1:…", gRPC; with TLS "https://127.0.0.1:…".
    pub url: String,
    certificate: Option<PathBuf>,
    /// "127.0.0.1:…", metrics and probes.
    pub http: String,
}

impl Server {
    /// On a folder, which is made if it is not there.
    pub fn start(data: &Path) -> Self {
        Self::start_with(data, &[])
    }

    /// With more flags.
    pub fn start_with(data: &Path, flags: &[&str]) -> Self {
        let mut command = Command::new(binary("lumisphere-server"));
        Self::spawn(command.args(flags), data)
    }

    /// The command is the server, or ends by becoming it with the arguments that are added here.
    pub fn spawn(command: &mut Command, data: &Path) -> Self {
        let log = data.with_extension("log");
        let stderr = File::options().create(true).append(true).open(&log).expect("the log can be written");
        command.args(["--listen-address", "127.0.0.1:0", "--http-address", "127.0.0.1:0", "--data-dir"]).arg(data);
        without_settings(command);
        // A test that waits for the end cannot close its own connections meanwhile. A test's own flag stands above.
        command.env("LUMISPHERE_SHUTDOWN_GRACE_SECONDS", "2");
        let certificate = is_secure().then(|| secure(command, data));
        let mut child = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(stderr).spawn().expect("the server starts");
        let stdout = child.stdout.take().expect("stdout is piped");
        let mut server = Self { child, log, url: String::new(), certificate, http: String::new() };
        let (told, line) = mpsc::channel();
        thread::spawn(move || {
            let mut lines = BufReader::new(stdout);
            let mut line = String::new();
            let _ = lines.read_line(&mut line);
            let _ = told.send(line);
            // Keeps the pipe open and empty for as long as the server lives.
            let _ = lines.read_to_end(&mut Vec::new());
        });
        let line = line.recv_timeout(PATIENCE).unwrap_or_default();
        let address = |key: &str| line.split_whitespace().find_map(|word| word.strip_prefix(key)).map(str::to_string);
        let (Some(grpc), Some(http)) = (address("grpc="), address("http=")) else {
            panic!("the server said {line:?}; its log:\n{}", server.log_text());
        };
        let scheme = if server.certificate.is_some() { "https" } else { "http" };
        (server.url, server.http) = (format!("{scheme}://{grpc}"), http);
        server
    }

    /// What it logged, over all its starts on this folder, without the account of its configuration.
    pub fn log_text(&self) -> String {
        let text = fs::read_to_string(&self.log).unwrap_or_default();
        text.lines().filter(|line| !line.contains("configuration key=")).map(|line| format!("{line}\n")).collect()
    }

    /// What it holds of the machine's memory now.
    pub fn resident_bytes(&self) -> u64 {
        self.status_bytes("VmRSS:")
    }

    /// The part of that which is no file's.
    pub fn anonymous_bytes(&self) -> u64 {
        self.status_bytes("RssAnon:")
    }

    /// The most that it held since its start or `forget_peak`.
    pub fn peak_bytes(&self) -> u64 {
        self.status_bytes("VmHWM:")
    }

    /// From now on, `peak_bytes` counts anew.
    pub fn forget_peak(&self) {
        fs::write(format!("/proc/{}/clear_refs", self.child.id()), "5").expect("Linux lets the parent do this");
    }

    /// Processor time that it has taken, to a hundredth of a second.
    pub fn cpu_seconds(&self) -> f64 {
        let stat = fs::read_to_string(format!("/proc/{}/stat", self.child.id())).expect("the server runs");
        // After the name, which may hold anything: field 3 is the first; 14 and 15 are user's and system's, in hundredths (man 5 proc).
        let (_, fields) = stat.rsplit_once(')').expect("a name");
        let ticks = fields.split_whitespace().skip(11).take(2).map(|field| field.parse::<f64>().expect("a number"));
        ticks.sum::<f64>() / 100.0
    }

    fn status_bytes(&self, field: &str) -> u64 {
        let status = fs::read_to_string(format!("/proc/{}/status", self.child.id())).expect("the server runs");
        let kib = status.lines().find_map(|l| l.strip_prefix(field)?.split_whitespace().next()?.parse::<u64>().ok());
        1024 * kib.unwrap_or_else(|| panic!("no {field} in {status}"))
    }

    /// `kill -9`.
    pub fn kill(mut self) {
        self.child.kill().expect("the server runs");
        self.child.wait().expect("a killed child ends");
    }

    /// SIGTERM, then its exit code; None when it ended by a signal. Fails after `PATIENCE`.
    pub fn stop(mut self) -> Option<i32> {
        self.terminate();
        self.ended().code()
    }

    /// SIGTERM.
    pub fn terminate(&self) {
        let sent = Command::new("sh").args(["-c", &format!("kill -TERM {}", self.child.id())]).status().expect("sh runs");
        assert!(sent.success(), "the server has ended already:\n{}", self.log_text());
    }

    /// Waits for the end.
    pub fn ended(&mut self) -> ExitStatus {
        ended(&mut self.child).unwrap_or_else(|| panic!("the server hung:\n{}", self.log_text()))
    }

    /// For those who connect by themselves.
    pub fn address(&self) -> ServerAddress {
        let (_, host) = self.url.split_once("://").expect("a URL");
        ServerAddress { host: host.into(), certificate: self.certificate.clone() }
    }

    /// The command line against this server.
    pub fn lumisphere(&self, arguments: &[&str]) -> Output {
        self.lumisphere_command(arguments).output().expect("the client starts")
    }

    /// The same, not started yet.
    pub fn lumisphere_command(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(binary("lumisphere"));
        without_settings(&mut command);
        self.introduce(&mut command);
        command.args(arguments).stdin(Stdio::null());
        command
    }

    /// Tells a client where it is and whom to trust.
    pub fn introduce(&self, command: &mut Command) {
        command.env("LUMISPHERE_SERVER", &self.url);
        if let Some(certificate) = &self.certificate {
            command.env("LUMISPHERE_CA_CERTIFICATE", certificate);
        }
    }

    /// Standard output of a command that must succeed.
    pub fn succeed(&self, arguments: &[&str]) -> String {
        let output = self.lumisphere(arguments);
        let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
        assert!(
            output.status.success(),
            "lumisphere {}: {}\n{}\n--- server\n{}",
            arguments.join(" "),
            output.status,
            text(&output.stderr),
            self.log_text()
        );
        text(&output.stdout)
    }

    /// Standard output as one JSON document.
    pub fn json(&self, arguments: &[&str]) -> serde_json::Value {
        let text = self.succeed(&[arguments, &["--json"]].concat());
        serde_json::from_str(&text).unwrap_or_else(|e| panic!("{}: {e}\n{text}", arguments.join(" ")))
    }

    /// A connection of its own.
    pub async fn channel(&self) -> Channel {
        let endpoint = Channel::from_shared(self.url.clone()).expect("the address is a URL");
        let endpoint = match &self.certificate {
            Some(path) => {
                let pem = Certificate::from_pem(fs::read(path).expect("the certificate is kept"));
                endpoint.tls_config(ClientTlsConfig::new().ca_certificate(pem)).expect("a certificate")
            }
            None => endpoint,
        };
        endpoint.connect().await.expect("the server listens")
    }

    /// Datasets and blobs.
    pub async fn datasets(&self) -> DatasetsClient<Channel> {
        DatasetsClient::new(self.channel().await)
    }

    /// Long work.
    pub async fn jobs(&self) -> JobsClient<Channel> {
        JobsClient::new(self.channel().await)
    }

    /// Frames.
    pub async fn rendering(&self) -> RenderingClient<Channel> {
        RenderingClient::new(self.channel().await).max_decoding_message_size(MAX_FRAME_MESSAGE_BYTES)
    }

    /// The server itself.
    pub async fn system(&self) -> SystemClient<Channel> {
        SystemClient::new(self.channel().await)
    }
}

/// Where a server is, and how it shows that it is the one.
#[derive(Debug, Clone)]
pub struct ServerAddress {
    /// "127.0.0.1:…".
    pub host: String,
    /// The certificate that it shows; None without TLS.
    pub certificate: Option<PathBuf>,
}

/// Whether servers of this run have TLS: the same tests hold for both.
pub fn is_secure() -> bool {
    std::env::var_os("TEST_TLS").is_some_and(|value| value == "1")
}

/// Gives the server a certificate of its own beside its data, which is returned.
fn secure(command: &mut Command, data: &Path) -> PathBuf {
    let (certificate, key) = (data.with_extension("pem"), data.with_extension("key"));
    // A server that starts again on its data is the same server.
    if !certificate.exists() {
        let made = rcgen::generate_simple_self_signed(["127.0.0.1".into(), "localhost".into()]).expect("a certificate");
        fs::write(&certificate, made.cert.pem()).expect("the folder can be written");
        fs::write(&key, made.signing_key.serialize_pem()).expect("the folder can be written");
    }
    command.env("LUMISPHERE_TLS_CERTIFICATE", &certificate).env("LUMISPHERE_TLS_PRIVATE_KEY", &key);
    certificate
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
        if thread::panicking() {
            eprintln!("--- the server's log\n{}", self.log_text());
        }
    }
}

/// Waits for a child's end; None if it hung and was killed.
pub fn ended(child: &mut Child) -> Option<ExitStatus> {
    let id = child.id();
    // A watchdog rather than a poll: it only ever acts on a child that hangs.
    let (done, hung) = mpsc::channel::<()>();
    let watchdog = thread::spawn(move || {
        if hung.recv_timeout(PATIENCE) == Err(mpsc::RecvTimeoutError::Timeout) {
            let _ = Command::new("sh").args(["-c", &format!("kill -KILL {id}")]).status();
            return true;
        }
        false
    });
    let status = child.wait().expect("the child is ours");
    drop(done);
    (!watchdog.join().expect("the watchdog does not panic")).then_some(status)
}

/// Sends a signal: "INT", "TERM".
pub fn signal(child: &Child, name: &str) {
    let sent = Command::new("sh").args(["-c", &format!("kill -{name} {}", child.id())]).status().expect("sh runs");
    assert!(sent.success(), "the child has ended already");
}

/// Nothing of the caller's own configuration.
pub fn without_settings(command: &mut Command) {
    for (name, _) in std::env::vars_os().filter(|(name, _)| name.to_string_lossy().starts_with("LUMISPHERE_")) {
        command.env_remove(name);
    }
    command.env("XDG_CONFIG_HOME", "/nonexistent");
}
