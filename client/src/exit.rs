//! What went wrong, for people, for programs (`--json`) and as an exit code.

use std::io;
use std::process::ExitCode;

use serde_json::{Value, json};
use thiserror::Error;
use tonic::{Code, Status};
use tonic_types::StatusExt;

/// Errors of the client itself; the server's come as `tonic::Status`.
#[derive(Debug, Error)]
pub enum Failure {
    /// A flag, a file or the configuration says something that cannot be meant.
    #[error("{0}")]
    Usage(String),
    /// A name that must exist does not.
    #[error("{0}")]
    NotFound(String),
    /// No server, or no answer in time.
    #[error("{0}")]
    Unavailable(String),
    /// The state of things forbids it: a file would be overwritten.
    #[error("{0}")]
    Precondition(String),
    /// The job that was waited for did not succeed.
    #[error("job {name} {state}: {message}")]
    Job {
        /// The job's name.
        name: String,
        /// "failed" or "was cancelled".
        state: &'static str,
        /// The job's own reason (`ErrorReason` without prefix).
        reason: String,
        /// The job's own words.
        message: String,
    },
    /// Ctrl-C.
    #[error("interrupted{}", note.as_deref().map(|n| format!(": {n}")).unwrap_or_default())]
    Interrupted {
        /// What goes on without us.
        note: Option<String>,
    },
}

/// The exit code that documentation promises for this error.
pub fn code(error: &anyhow::Error) -> u8 {
    error.chain().find_map(code_of_cause).unwrap_or(1)
}

fn code_of_cause(cause: &(dyn std::error::Error + 'static)) -> Option<u8> {
    if let Some(failure) = cause.downcast_ref::<Failure>() {
        return Some(match failure {
            Failure::Usage(_) => 2,
            Failure::NotFound(_) => 3,
            Failure::Unavailable(_) => 5,
            Failure::Job { .. } => 6,
            Failure::Precondition(_) => 7,
            Failure::Interrupted { .. } => 130,
        });
    }
    if let Some(status) = cause.downcast_ref::<Status>() {
        return Some(code_of_status(status));
    }
    match cause.downcast_ref::<io::Error>()?.kind() {
        io::ErrorKind::NotFound => Some(3),
        io::ErrorKind::PermissionDenied => Some(4),
        io::ErrorKind::AlreadyExists => Some(7),
        _ => None,
    }
}

fn code_of_status(status: &Status) -> u8 {
    match status.code() {
        Code::InvalidArgument | Code::OutOfRange => 2,
        Code::NotFound => 3,
        Code::PermissionDenied | Code::Unauthenticated => 4,
        Code::Unavailable | Code::DeadlineExceeded | Code::Cancelled => 5,
        // A full queue empties; a full disk or a frame that is too large does not.
        Code::ResourceExhausted if matches!(reason(status).as_str(), "JOB_QUEUE_FULL" | "RENDER_QUEUE_FULL" | "TOO_MANY_SESSIONS") => 5,
        Code::FailedPrecondition | Code::AlreadyExists | Code::Aborted => 7,
        _ => 1,
    }
}

/// `ErrorReason` without prefix, as the server gave it; empty when it gave none.
pub fn reason(status: &Status) -> String {
    status.get_details_error_info().map(|info| info.reason).unwrap_or_default()
}

/// Tells standard error and returns the exit code.
pub fn report(error: &anyhow::Error, json: bool) -> ExitCode {
    if json {
        eprintln!("{}", as_json(error));
    } else {
        eprintln!("error: {}", as_text(error));
    }
    ExitCode::from(code(error))
}

fn as_text(error: &anyhow::Error) -> String {
    let causes: Vec<String> =
        error.chain().map(|cause| cause.downcast_ref::<Status>().map_or_else(|| cause.to_string(), status_text)).collect();
    let mut text = causes.join(": ");
    for (field, expected) in violations(error) {
        text.push_str(&format!("\n  {field}: {expected}"));
    }
    text
}

fn status_text(status: &Status) -> String {
    match reason(status).as_str() {
        "" if status.code() == Code::Unimplemented => "the server does not know this request: an older version? (UNIMPLEMENTED)".into(),
        "" => format!("{} ({})", status.message(), code_name(status.code())),
        reason => format!("{} ({reason})", status.message()),
    }
}

fn as_json(error: &anyhow::Error) -> Value {
    let status = error.chain().find_map(|cause| cause.downcast_ref::<Status>());
    let job_reason = error.chain().find_map(|cause| match cause.downcast_ref::<Failure>() {
        Some(Failure::Job { reason, .. }) => Some(reason.clone()),
        _ => None,
    });
    let causes: Vec<String> =
        error.chain().map(|cause| cause.downcast_ref::<Status>().map_or_else(|| cause.to_string(), |s| s.message().into())).collect();
    json!({"error": {
        "exit_code": code(error),
        "code": status.map(|s| code_name(s.code())),
        "reason": status.map(reason).or(job_reason),
        "message": causes.join(": "),
        "violations": violations(error).into_iter().map(|(field, expected)| json!({"field": field, "expected": expected})).collect::<Vec<_>>(),
    }})
}

fn violations(error: &anyhow::Error) -> Vec<(String, String)> {
    let bad_request = error.chain().find_map(|cause| cause.downcast_ref::<Status>()?.get_details_bad_request());
    bad_request.map(|b| b.field_violations.into_iter().map(|v| (v.field, v.description)).collect()).unwrap_or_default()
}

/// Whether it may go away by itself: the server restarts, or the network comes back.
pub fn is_broken_connection(error: &anyhow::Error) -> bool {
    if let Some(status) = error.downcast_ref::<Status>() {
        // A reset in mid-stream comes as UNKNOWN or INTERNAL from the transport, without our details.
        let is_of_transport = matches!(status.code(), Code::Unknown | Code::Internal | Code::Cancelled) && reason(status).is_empty();
        return status.code() == Code::Unavailable || is_of_transport;
    }
    matches!(error.downcast_ref::<Failure>(), Some(Failure::Unavailable(_)))
}

/// The code as the gRPC specification writes it.
pub fn code_name(code: Code) -> &'static str {
    match code {
        Code::Ok => "OK",
        Code::Cancelled => "CANCELLED",
        Code::Unknown => "UNKNOWN",
        Code::InvalidArgument => "INVALID_ARGUMENT",
        Code::DeadlineExceeded => "DEADLINE_EXCEEDED",
        Code::NotFound => "NOT_FOUND",
        Code::AlreadyExists => "ALREADY_EXISTS",
        Code::PermissionDenied => "PERMISSION_DENIED",
        Code::ResourceExhausted => "RESOURCE_EXHAUSTED",
        Code::FailedPrecondition => "FAILED_PRECONDITION",
        Code::Aborted => "ABORTED",
        Code::OutOfRange => "OUT_OF_RANGE",
        Code::Unimplemented => "UNIMPLEMENTED",
        Code::Internal => "INTERNAL",
        Code::Unavailable => "UNAVAILABLE",
        Code::DataLoss => "DATA_LOSS",
        Code::Unauthenticated => "UNAUTHENTICATED",
    }
}

#[cfg(test)]
mod tests {
    use anyhow::Context as _;
    use tonic_types::ErrorDetails;

    use super::*;

    #[test]
    fn every_documented_exit_code_is_reached() {
        let cases: [(anyhow::Error, u8); 9] = [
            (anyhow::anyhow!("whatever"), 1),
            (Status::invalid_argument("x").into(), 2),
            (Status::not_found("x").into(), 3),
            (Status::permission_denied("x").into(), 4),
            (Status::unavailable("x").into(), 5),
            (Failure::Job { name: "j".into(), state: "failed", reason: String::new(), message: String::new() }.into(), 6),
            (Status::failed_precondition("x").into(), 7),
            (io::Error::from(io::ErrorKind::NotFound).into(), 3),
            (Failure::Interrupted { note: None }.into(), 130),
        ];
        for (error, expected) in cases {
            assert_eq!(code(&error), expected, "{error:?}");
        }
    }

    #[test]
    fn context_does_not_hide_the_code() {
        let error = Err::<(), _>(Status::not_found("x")).context("while rendering").unwrap_err();
        assert_eq!(code(&error), 3);
    }

    #[test]
    fn violations_are_told_to_people_and_programs() {
        let mut details = ErrorDetails::with_error_info("FIELD_INVALID", "lumisphere", [] as [(String, String); 0]);
        details.add_bad_request_violation("camera.pose", "rigid expected");
        let error = Status::with_error_details(Code::InvalidArgument, "bad camera", details).into();
        assert_eq!(as_text(&error), "bad camera (FIELD_INVALID)\n  camera.pose: rigid expected");
        let json = as_json(&error);
        assert_eq!(json["error"]["violations"][0]["field"], "camera.pose");
        assert_eq!((json["error"]["exit_code"].as_u64(), json["error"]["reason"].as_str()), (Some(2), Some("FIELD_INVALID")));
    }
}
