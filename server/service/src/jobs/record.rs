//! A job as it is remembered: one small file each, replaced whole, so that a crash leaves the old state or the new.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{SystemTime, UNIX_EPOCH};

use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use super::Submission;
use crate::errors::{ApiError, Reason};

/// Version of the file's format.
const FORMAT: u32 = 1;

/// The durable part of a job.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Record {
    format: u32,
    /// Counts submissions; the name is made of it.
    pub number: u64,
    /// "capture", "evaluate", "path_render" or "thin".
    pub kind: String,
    /// The dataset that it adds a version to.
    pub writes: Option<String>,
    /// The client's, or empty.
    pub request_id: String,
    /// BLAKE3 of the specification as it came: tells a repeated request from another with the same id.
    pub asked: String,
    /// What to do.
    pub spec: Spec,
    /// How it is.
    pub state: State,
    /// Milliseconds since 1970, UTC.
    pub created_millis: u64,
    /// When it first ran.
    pub started_millis: Option<u64>,
    /// When it ended.
    pub ended_millis: Option<u64>,
    /// How often it was started.
    pub attempt: u32,
    /// Why it did not succeed.
    pub failure: Option<Failure>,
    /// What it made.
    pub outcome: Option<Outcome>,
}

/// What a job is to do, as protobuf; in the file, hexadecimal. Cheap to clone: every event holds one.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Spec(pub Arc<[u8]>);

impl Serialize for Spec {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let digit = |value: u8| char::from(b"0123456789abcdef"[usize::from(value)]);
        let digits: String = self.0.iter().flat_map(|byte| [digit(byte >> 4), digit(byte & 15)]).collect();
        serializer.serialize_str(&digits)
    }
}

impl<'de> Deserialize<'de> for Spec {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let bytes = decode_hex(&String::deserialize(deserializer)?);
        bytes.map(|bytes| Self(bytes.into())).ok_or_else(|| D::Error::custom("the specification is not hexadecimal"))
    }
}

/// AIP-216.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// Waits.
    Pending,
    /// Works; after a restart: goes on.
    Running,
    /// Was asked to stop.
    Cancelling,
    /// Ended well.
    Succeeded,
    /// Ended badly.
    Failed,
    /// Stopped as asked.
    Cancelled,
}

/// Why a job did not succeed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Failure {
    /// A `google.rpc.Code`.
    pub code: i32,
    /// Name of the reason.
    pub reason: String,
    /// For people.
    pub message: String,
}

/// What a job made.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Outcome {
    /// Dataset and version that were published.
    pub published: Option<(String, u64)>,
    /// Sorted by name.
    pub blobs: Vec<ResultBlob>,
    /// A JSON object.
    pub summary_json: String,
}

/// Named bytes that a job made.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ResultBlob {
    /// Unique within the job.
    pub name: String,
    /// Media type.
    pub media_type: String,
    /// Of its bytes, hexadecimal.
    pub blake3: String,
    /// Bytes.
    pub size_bytes: u64,
}

impl State {
    /// Nothing changes any more.
    pub fn is_ended(self) -> bool {
        matches!(self, Self::Succeeded | Self::Failed | Self::Cancelled)
    }
}

impl Record {
    /// A job that waits.
    pub fn new(number: u64, submission: Submission) -> Self {
        let Submission { kind, writes, request_id, asked, spec } = submission;
        Self {
            format: FORMAT,
            number,
            kind: kind.into(),
            writes,
            request_id,
            asked,
            spec: Spec(spec.into()),
            state: State::Pending,
            created_millis: now_millis(),
            started_millis: None,
            ended_millis: None,
            attempt: 0,
            failure: None,
            outcome: None,
        }
    }

    /// "job-000007".
    pub fn name(&self) -> String {
        job_name(self.number)
    }
}

/// "job-000007".
pub fn job_name(number: u64) -> String {
    format!("job-{number:06}")
}

/// The number in a job's name; None for what is no name of a job.
pub fn job_number(name: &str) -> Option<u64> {
    let number = name.strip_prefix("job-")?.parse().ok()?;
    (job_name(number) == name).then_some(number)
}

fn decode_hex(text: &str) -> Option<Vec<u8>> {
    let digits: Vec<u8> = text.chars().map(|c| c.to_digit(16).map(|d| d as u8)).collect::<Option<_>>()?;
    let (pairs, []) = digits.as_chunks::<2>() else { return None };
    Some(pairs.iter().map(|[high, low]| high << 4 | low).collect())
}

/// Milliseconds since 1970, UTC.
pub fn now_millis() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_millis() as u64)
}

/// The folder of job files.
#[derive(Debug, Clone)]
pub struct RecordFolder {
    path: PathBuf,
}

impl RecordFolder {
    /// Makes the folder if it is not there.
    pub fn open(path: PathBuf) -> io::Result<Self> {
        fs::create_dir_all(&path)?;
        Ok(Self { path })
    }

    /// Every job, by number. A file that cannot be read is put aside under another name, told of in the log, and hurts no other job.
    pub fn read_all(&self) -> io::Result<Vec<Record>> {
        let mut records = Vec::new();
        for entry in fs::read_dir(&self.path)? {
            let path = entry?.path();
            match path.extension().and_then(|e| e.to_str()) {
                // Half-written when the server was killed: never a job's state.
                Some("tmp") => fs::remove_file(&path)?,
                Some("json") => match read_record(&path) {
                    Ok(record) => records.push(record),
                    Err(problem) => {
                        tracing::error!(path = %path.display(), problem, "damaged job record put aside");
                        fs::rename(&path, path.with_extension("damaged"))?;
                    }
                },
                _ => {}
            }
        }
        records.sort_by_key(|r| r.number);
        Ok(records)
    }

    /// Replaces the job's file; durable when it returns.
    pub fn write(&self, record: &Record) -> Result<(), ApiError> {
        let json = serde_json::to_vec_pretty(record).expect("a record has string keys and no foreign numbers");
        self.replace(&self.file(record.number), &json).map_err(|error| match error.kind() {
            io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => {
                ApiError::new(Reason::DiskFull, "disk full: cannot record the job")
            }
            _ => ApiError::internal(format!("cannot write a job record: {error}: {}", self.path.display())),
        })
    }

    fn replace(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        let partial = path.with_extension("tmp");
        let mut file = File::create(&partial)?;
        file.write_all(bytes)?;
        file.sync_all()?;
        fs::rename(&partial, path)?;
        File::open(&self.path)?.sync_all()
    }

    /// Forgets a job.
    pub fn remove(&self, number: u64) {
        if let Err(error) = fs::remove_file(self.file(number)) {
            tracing::warn!(%error, job = job_name(number), "cannot remove an old job record");
        }
    }

    fn file(&self, number: u64) -> PathBuf {
        self.path.join(job_name(number)).with_extension("json")
    }
}

fn read_record(path: &Path) -> Result<Record, String> {
    let record: Record = serde_json::from_slice(&fs::read(path).map_err(|e| e.to_string())?).map_err(|e| e.to_string())?;
    if record.format != FORMAT {
        return Err(format!("format {}, this program reads {FORMAT}", record.format));
    }
    match path.file_stem().and_then(|s| s.to_str()) == Some(&record.name()) {
        true => Ok(record),
        false => Err("the file's name is not the job's".into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_record_is_read_as_written_and_a_damaged_one_hurts_no_other() {
        let folder = tempfile::tempdir().unwrap();
        let records = RecordFolder::open(folder.path().join("jobs")).unwrap();
        let submission = |kind, spec: &[u8]| Submission {
            kind,
            writes: Some("teapot".into()),
            request_id: "mine".into(),
            asked: String::new(),
            spec: spec.into(),
        };
        let mut first = Record::new(1, submission("capture", &[0, 0xab, 0xff]));
        first.state = State::Failed;
        first.failure = Some(Failure { code: 13, reason: "INTERNAL".into(), message: "\"quoted\"".into() });
        let second = Record::new(2, submission("evaluate", &[]));
        records.write(&first).unwrap();
        records.write(&second).unwrap();
        fs::write(folder.path().join("jobs/job-000003.json"), &fs::read(folder.path().join("jobs/job-000002.json")).unwrap()[..40])
            .unwrap();
        fs::write(folder.path().join("jobs/job-000004.tmp"), b"{").unwrap();
        assert_eq!(records.read_all().unwrap(), [first.clone(), second]);
        assert_eq!(records.read_all().unwrap()[0].spec.0[..], [0, 0xab, 0xff]);
        assert!(folder.path().join("jobs/job-000003.damaged").exists());
        assert!(!folder.path().join("jobs/job-000004.tmp").exists());
    }

    #[test]
    fn only_a_jobs_own_name_has_a_number() {
        assert_eq!(job_number("job-000007"), Some(7));
        assert_eq!(job_number("job-1234567"), Some(1_234_567));
        for name in ["", "job-", "job-7", "job-0000007", "job--00007", "job-00000x", "../job-000007"] {
            assert_eq!(job_number(name), None, "{name}");
        }
    }
}
