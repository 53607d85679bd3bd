//! The one map from what went wrong to a gRPC status: reason → code, library error → reason.
//!
//! A reason is part of the API (`ErrorReason` in `system.proto`); its status code follows from it, so that the two cannot disagree.

use std::collections::{BTreeMap, HashMap};
use std::fmt;
use std::time::Duration;

use lumisphere::capture::observation_map::{ImportError, ObserveError};
use lumisphere::evaluate::{EvaluateError, ThinError};
use lumisphere::progress::Cancelled;
use lumisphere::raytrace::TraceError;
use lumisphere::render::RenderError;
use lumisphere::representations::offset_surface_light_field::{ConstructError, ReplaceError, ThinningError};
use lumisphere::representations::parameter_map::{FitError, SuggestError};
use lumisphere::scenes::SceneError;
use lumisphere::textures::StoreError;
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt};

pub use crate::wire::proto::ErrorReason as Reason;
use crate::wire::{ERROR_DOMAIN, clipped_to, reason_name};

/// Of a text that goes to the caller. An error travels in headers, where clients take 16 KiB: a message goes in twice, once with three bytes
/// for each that is not ASCII, and may be a field's description, too.
const MAX_CHARS: usize = 400;

/// What the caller is told. Made once, at the place that knows the reason; turned into a `Status` at the edge.
#[derive(Debug, Clone, PartialEq)]
pub struct ApiError {
    reason: Reason,
    message: String,
    violations: Vec<Violation>,
    metadata: BTreeMap<String, String>,
}

/// A field and what was expected of it.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Violation {
    field: String,
    description: String,
}

impl ApiError {
    /// Anything but a field that does not hold what it must (`field`).
    pub fn new(reason: Reason, message: impl Into<String>) -> Self {
        Self { reason, message: message.into(), violations: Vec::new(), metadata: BTreeMap::new() }
    }

    /// `field` as a path from the request's type ("RenderFrameRequest.camera.pose"); `problem` says what it is and what was expected.
    pub fn field(field: impl Into<String>, problem: impl fmt::Display) -> Self {
        let (field, description) = (field.into(), problem.to_string());
        let message = format!("{field}: {description}");
        Self { violations: vec![Violation { field, description }], ..Self::new(Reason::FieldInvalid, message) }
    }

    /// Adds a machine-readable fact to the `ErrorInfo`.
    pub fn with(mut self, key: &str, value: impl fmt::Display) -> Self {
        self.metadata.insert(key.into(), value.to_string());
        self
    }

    /// A defect of ours: `message` goes to the log, the caller learns that it is in the log.
    pub fn internal(message: impl fmt::Display) -> Self {
        tracing::error!(%message, "internal error");
        Self::new(Reason::Internal, "internal error; the server's log has the details")
    }

    /// Why.
    pub fn reason(&self) -> Reason {
        self.reason
    }

    /// The status code that goes with the reason.
    pub fn code(&self) -> Code {
        code_of(self.reason)
    }

    /// For people.
    pub fn message(&self) -> &str {
        &self.message
    }
}

impl fmt::Display for ApiError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message)
    }
}

impl std::error::Error for ApiError {}

/// The status code of a reason, as `system.proto` documents it.
pub fn code_of(reason: Reason) -> Code {
    match reason {
        Reason::Unspecified | Reason::Internal | Reason::JobFailed => Code::Internal,
        Reason::FieldInvalid | Reason::SceneInvalid => Code::InvalidArgument,
        Reason::DatasetNotFound | Reason::VersionNotFound | Reason::BlobNotFound | Reason::JobNotFound | Reason::SessionNotFound => {
            Code::NotFound
        }
        Reason::DatasetExists | Reason::RequestIdReused => Code::AlreadyExists,
        Reason::DatasetEmpty
        | Reason::DatasetKindMismatch
        | Reason::ChunkOutOfOrder
        | Reason::UploadNotBegun
        | Reason::JobEnded
        | Reason::FormatTooNew
        | Reason::NoGpu
        | Reason::SceneUnknown
        | Reason::TooManyVideos
        | Reason::InteractionOrder => Code::FailedPrecondition,
        Reason::DatasetBusy | Reason::RecordingBusy | Reason::ReplayBusy | Reason::SessionTakenOver => Code::Aborted,
        Reason::BlobHashMismatch | Reason::DataCorrupt => Code::DataLoss,
        Reason::UploadTooLarge
        | Reason::JobQueueFull
        | Reason::RenderQueueFull
        | Reason::FrameTooLarge
        | Reason::TooManySessions
        | Reason::TraceTooLarge
        | Reason::SceneTooLarge
        | Reason::DiskFull => Code::ResourceExhausted,
        Reason::JobCancelled => Code::Cancelled,
        Reason::GpuUnavailable | Reason::ShuttingDown => Code::Unavailable,
        Reason::DeadlineExceeded | Reason::ViewerMute => Code::DeadlineExceeded,
    }
}

/// When to try again what was refused because others were first; None where trying again is of no use, or nobody knows.
fn retry_after(reason: Reason) -> Option<Duration> {
    match reason {
        Reason::RenderQueueFull => Some(Duration::from_millis(100)),
        Reason::TooManySessions => Some(Duration::from_secs(2)),
        Reason::JobQueueFull => Some(Duration::from_secs(10)),
        _ => None,
    }
}

impl From<StoreError> for ApiError {
    fn from(error: StoreError) -> Self {
        let message = error.to_string();
        let reason = match &error {
            StoreError::NotFound { what } => not_found_reason(what),
            StoreError::AlreadyExists { .. } => Reason::DatasetExists,
            StoreError::AlreadyPublished { .. } | StoreError::Incomplete { .. } | StoreError::InvalidPage { .. } => {
                return Self::internal(message);
            }
            StoreError::Busy { .. } => Reason::DatasetBusy,
            StoreError::InvalidName { .. } => return Self::field("name", message),
            StoreError::DamagedPage { .. } | StoreError::DamagedFile { .. } => {
                tracing::error!(%error, "damaged data");
                Reason::DataCorrupt
            }
            StoreError::WrongOffset { expected, .. } => {
                return Self::new(Reason::ChunkOutOfOrder, message).with("expected_offset", expected);
            }
            StoreError::WrongLength { .. } => return Self::field("data", message),
            StoreError::WrongHash { .. } => Reason::BlobHashMismatch,
            StoreError::DiskFull { .. } => Reason::DiskFull,
            StoreError::Io { .. } => return Self::internal(message),
        };
        Self::new(reason, message)
    }
}

/// The store tells what is missing in words: "dataset x", "version 3 of dataset x", "blob …".
fn not_found_reason(what: &str) -> Reason {
    match what.split(' ').next() {
        Some("dataset") => Reason::DatasetNotFound,
        Some("version" | "a") => Reason::VersionNotFound,
        _ => Reason::BlobNotFound,
    }
}

impl From<RenderError> for ApiError {
    fn from(error: RenderError) -> Self {
        match error {
            RenderError::Store(error) => error.into(),
            RenderError::PageShape { .. } => Self::new(Reason::DataCorrupt, error.to_string()),
            RenderError::OtherKind { .. } | RenderError::NoSkyShares | RenderError::AsAuthored => {
                Self::new(Reason::DatasetKindMismatch, error.to_string())
            }
            RenderError::NoTable { .. } | RenderError::NoNormalMap { .. } => Self::internal(error),
            RenderError::NoGpu => Self::field("settings.backend", error),
            RenderError::TooManyDirections { .. } => Self::field("settings.offset_surface_light_field.gloss.directions", error),
            RenderError::DependsOnPages => Self::field("settings.offset_surface_light_field.blend", error),
            RenderError::Bumps(_) => Self::field("settings.offset_surface_light_field.normal_map", error),
            RenderError::ReadsMore => Self::field("settings.offset_surface_light_field", error),
            RenderError::Gpu(_) => Self::new(Reason::GpuUnavailable, error.to_string()),
        }
    }
}

impl From<Cancelled> for ApiError {
    fn from(_: Cancelled) -> Self {
        Self::new(Reason::JobCancelled, "cancelled")
    }
}

impl From<SceneError> for ApiError {
    fn from(error: SceneError) -> Self {
        Self::new(Reason::SceneInvalid, error.to_string())
    }
}

impl From<TraceError> for ApiError {
    fn from(error: TraceError) -> Self {
        Self::new(Reason::SceneInvalid, error.to_string())
    }
}

impl From<ConstructError> for ApiError {
    fn from(error: ConstructError) -> Self {
        of_construction(error, "spec.capture")
    }
}

fn of_construction(error: ConstructError, spec: &str) -> ApiError {
    match error {
        ConstructError::UnknownObject { .. } => ApiError::field(format!("{spec}.object"), error),
        ConstructError::Setting { setting, .. } => ApiError::field(format!("{spec}.{setting}"), error),
        ConstructError::Placement(error) => ApiError::field(format!("{spec}.density"), error),
        ConstructError::AllInside(_) => ApiError::field(format!("{spec}.offset"), error),
        ConstructError::Trace(error) => error.into(),
        ConstructError::Cancelled(error) => error.into(),
        ConstructError::Store(error) => error.into(),
        ConstructError::Parts(error) => ApiError::internal(error),
    }
}

impl From<ReplaceError> for ApiError {
    fn from(error: ReplaceError) -> Self {
        match error {
            ReplaceError::NotDiffuse { .. } => Self::field("spec.replace.object", error),
            ReplaceError::Outside { .. } | ReplaceError::Placement { .. } => Self::field("spec.replace.placement", error),
            ReplaceError::TooLarge { bytes, limit_bytes } => {
                Self::new(Reason::SceneTooLarge, error.to_string()).with("bytes", bytes).with("limit_bytes", limit_bytes)
            }
            ReplaceError::Construct(error) => of_construction(error, "spec.replace"),
            ReplaceError::Render(error) => error.into(),
        }
    }
}

impl From<ObserveError> for ApiError {
    fn from(error: ObserveError) -> Self {
        match error {
            ObserveError::UnknownObject { .. } | ObserveError::NoTexels { .. } => {
                Self::field("spec.observe.virtual_photographs.object", error)
            }
            ObserveError::Setting { setting, .. } => Self::field(format!("spec.observe.virtual_photographs.{setting}"), error),
            ObserveError::Trace(error) => error.into(),
            ObserveError::Cancelled(error) => error.into(),
            ObserveError::Store(error) => error.into(),
            ObserveError::Parts(error) => Self::internal(error),
        }
    }
}

impl From<ImportError> for ApiError {
    fn from(error: ImportError) -> Self {
        match error {
            ImportError::Setting { setting, .. } => Self::field(format!("spec.observe.photographs.{setting}"), error),
            ImportError::Size { .. } | ImportError::Photograph { .. } | ImportError::Behind { .. } | ImportError::NoCamera { .. } => {
                Self::field("spec.observe.photographs.files", error)
            }
            ImportError::UnknownObject { .. } | ImportError::NoTexels { .. } => Self::field("spec.observe.photographs.object", error),
            ImportError::Trace(error) => error.into(),
            ImportError::Cancelled(error) => error.into(),
            ImportError::Store(error) => error.into(),
            ImportError::Parts(error) => Self::internal(error),
        }
    }
}

impl From<FitError> for ApiError {
    fn from(error: FitError) -> Self {
        match error {
            FitError::PageShape { .. } | FitError::Lost { .. } => Self::new(Reason::DataCorrupt, error.to_string()),
            FitError::Settings(_) | FitError::Harmonics(_) => Self::field("spec.fit", error),
            FitError::MaxBytes { .. } => Self::field("spec.fit.max_bytes", error),
            FitError::TooLarge { .. } => Self::field("spec.fit.models", error),
            FitError::Device(_) => Self::new(Reason::GpuUnavailable, error.to_string()),
            FitError::Cancelled(error) => error.into(),
            FitError::Store(error) => error.into(),
            FitError::Parts(error) => Self::internal(error),
        }
    }
}

impl From<SuggestError> for ApiError {
    fn from(error: SuggestError) -> Self {
        match error {
            SuggestError::PageShape { .. } => Self::new(Reason::DataCorrupt, error.to_string()),
            SuggestError::OtherObservations(_) | SuggestError::NoModels => Self::field("spec.suggest.dataset", error),
            SuggestError::Setting { .. } => Self::field("spec.suggest", error),
            SuggestError::Cancelled(error) => error.into(),
            SuggestError::Store(error) => error.into(),
        }
    }
}

impl From<EvaluateError<Self>> for ApiError {
    fn from(error: EvaluateError<Self>) -> Self {
        match error {
            EvaluateError::Plan(problem) => Self::field("spec.evaluate", problem),
            EvaluateError::Trace(error) => error.into(),
            EvaluateError::Cancelled(error) => error.into(),
            EvaluateError::Compare(error) => Self::internal(error),
            EvaluateError::Other(error) => error,
        }
    }
}

impl From<ThinError> for ApiError {
    fn from(error: ThinError) -> Self {
        match error {
            ThinError::Unmet { .. } => Self::field("spec.thin.max_error", error),
            ThinError::Placement(error) => Self::field("spec.thin.windows", error),
            ThinError::NoObject(_) | ThinError::Unseen => Self::field("spec.thin.dataset", error),
            ThinError::Trace(error) => error.into(),
            ThinError::Thinning(error) => error.into(),
        }
    }
}

impl From<ThinningError> for ApiError {
    fn from(error: ThinningError) -> Self {
        match error {
            ThinningError::Render(error) => error.into(),
            ThinningError::Store(error) => error.into(),
            ThinningError::Cancelled(error) => error.into(),
        }
    }
}

impl From<ApiError> for Status {
    fn from(error: ApiError) -> Self {
        let code = error.code();
        let clipped = |text: String| clipped_to(&text, MAX_CHARS);
        let metadata: HashMap<String, String> = error.metadata.into_iter().map(|(key, value)| (key, clipped(value))).collect();
        let mut details = ErrorDetails::with_error_info(reason_name(error.reason), ERROR_DOMAIN, metadata);
        if let Some(delay) = retry_after(error.reason) {
            details.set_retry_info(Some(delay));
        }
        for violation in error.violations {
            details.add_bad_request_violation(clipped(violation.field), clipped(violation.description));
        }
        Self::with_error_details(code, clipped(error.message), details)
    }
}

#[cfg(test)]
mod tests {
    use lumisphere::textures::{ContentHash, Store, StoreOptions};

    use super::*;

    #[test]
    fn a_bad_field_names_the_field_the_problem_and_the_reason() {
        let status = Status::from(ApiError::field("Camera.pose", "missing, a rigid pose expected").with("limit", 3));
        assert_eq!(status.code(), Code::InvalidArgument);
        assert_eq!(status.message(), "Camera.pose: missing, a rigid pose expected");
        let details = status.get_error_details();
        let info = details.error_info().unwrap();
        assert_eq!((info.reason.as_str(), info.domain.as_str()), ("FIELD_INVALID", "lumisphere"));
        assert_eq!(info.metadata["limit"], "3");
        let violation = &details.bad_request().unwrap().field_violations[0];
        assert_eq!((violation.field.as_str(), violation.description.as_str()), ("Camera.pose", "missing, a rigid pose expected"));
    }

    /// Twelve bytes of a header for each of these characters.
    #[test]
    fn an_error_fits_into_the_headers_that_clients_take_however_long_its_words_are() {
        let long = "\u{1f4a1}".repeat(10_000);
        let status = Status::from(ApiError::field("name", &long).with("name", &long));
        let headers = status.clone().into_http::<()>().headers().clone();
        let bytes: usize = headers.iter().map(|(name, value)| name.as_str().len() + value.len() + 32).sum();
        assert!(bytes < 16 << 10, "{bytes} bytes");
        assert!(status.message().starts_with("name: \u{1f4a1}") && status.message().ends_with('…'));
    }

    #[test]
    fn who_is_refused_for_others_learns_when_to_try_again() {
        let retry = |reason| Status::from(ApiError::new(reason, "no")).get_details_retry_info().and_then(|info| info.retry_delay);
        assert_eq!(retry(Reason::RenderQueueFull), Some(Duration::from_millis(100)));
        assert_eq!(retry(Reason::TooManySessions), Some(Duration::from_secs(2)));
        assert_eq!(retry(Reason::FrameTooLarge), None);
    }

    #[test]
    fn what_the_store_misses_is_told_apart() {
        let folder = tempfile::tempdir().unwrap();
        let (store, _) = Store::open(folder.path(), StoreOptions::local()).unwrap();
        let reason = |error: StoreError| ApiError::from(error).reason();
        assert_eq!(reason(store.versions("tea").unwrap_err()), Reason::DatasetNotFound);
        store.create_dataset("tea").unwrap();
        assert_eq!(reason(store.open_version("tea", Some(3)).unwrap_err()), Reason::VersionNotFound);
        assert_eq!(reason(store.open_version("tea", None).unwrap_err()), Reason::VersionNotFound);
        assert_eq!(reason(store.create_dataset("tea").unwrap_err()), Reason::DatasetExists);
        assert_eq!(reason(store.create_dataset("../tea").unwrap_err()), Reason::FieldInvalid);
        assert_eq!(reason(store.read_blob(&ContentHash::of(b"")).unwrap_err()), Reason::BlobNotFound);
        let _staging = store.stage("tea", "one").unwrap();
        assert_eq!(reason(store.stage("tea", "two").unwrap_err()), Reason::DatasetBusy);
    }

    #[test]
    fn every_reason_has_the_code_that_the_wire_documents() {
        let proto = include_str!("../../../proto/lumisphere/v1alpha1/system.proto");
        let mut seen = 0;
        for number in 1.. {
            let Ok(reason) = Reason::try_from(number) else { break };
            let place = proto.find(&format!("  {} = {number};", reason.as_str_name())).expect("the enum is in the file");
            let comment = proto[..place].trim_end().rsplit("\n\n").next().unwrap().lines().last().unwrap().trim();
            // The status code begins the comment, on its first line; comments here have one or two lines.
            let block: Vec<&str> = proto[..place].trim_end().lines().rev().take_while(|l| l.trim().starts_with("//")).collect();
            let first = block.last().unwrap_or(&comment).trim().trim_start_matches("// ");
            let documented = first.split(':').next().unwrap();
            let code = format!("{:?}", code_of(reason));
            assert_eq!(documented.replace('_', "").to_lowercase(), code.to_lowercase(), "{}", reason.as_str_name());
            seen += 1;
        }
        assert!(seen >= 30);
    }
}
