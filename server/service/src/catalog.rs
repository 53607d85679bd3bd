//! Datasets and blobs: the texture store as the service uses it. Everything here blocks; call it off the tokio workers.

mod uploads;

use std::collections::VecDeque;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use lumisphere::capture::PartsError;
use lumisphere::capture::observation_map::{self, OBSERVATION_MAP, ObservationMap};
use lumisphere::representations::offset_surface_light_field as oslf;
use lumisphere::representations::{CachedPages, Kind, Representation, parameter_map};
use lumisphere::textures::{
    Cache, CacheOptions, CacheSnapshot, ContentHash, DatasetVersion, Manifest, OpenReport, Store, StoreError, StoreOptions, Trace,
};

use uploads::Uploads;
pub use uploads::{Progress, UploadLimits};

use crate::errors::{ApiError, Reason};
use crate::looks::Looks;
use crate::wire::cache::CacheChange;
use crate::wire::datasets::{ORIGIN, Origin, manifest_bytes};

/// Versions whose geometry stays in memory while nobody renders them.
const OPENED: usize = 4;

/// Datasets, blobs and the texture cache.
pub struct Catalog {
    store: Store,
    cache: Arc<Cache>,
    uploads: Uploads,
    looks: Arc<Looks>,
    opened: Mutex<VecDeque<Arc<OpenedVersion>>>,
    /// Counters at the last reset.
    baseline: Mutex<CacheSnapshot>,
    is_recording: Arc<AtomicBool>,
}

/// A version ready to render. While it is held it can be rendered, even if the dataset is deleted.
pub struct OpenedVersion {
    /// Its dataset.
    pub dataset: String,
    /// From 1.
    pub version: u64,
    /// Without pages.
    pub representation: Arc<dyn Representation>,
    /// Through the shared cache.
    pub pages: CachedPages,
    /// Where it came from, if it was captured here.
    pub origin: Option<Origin>,
    /// Uploads that it may be shown with.
    pub looks: Arc<Looks>,
}

/// A dataset and its versions; those whose manifest is damaged have none.
pub struct DatasetView {
    /// Unique.
    pub name: String,
    /// Number and manifest, ascending.
    pub versions: Vec<(u64, Option<Manifest>)>,
}

impl Catalog {
    /// Opens or makes the store below `data_dir` and tells the operator what was found.
    pub fn open(data_dir: &Path, cache: CacheOptions, limits: UploadLimits) -> Result<Self, StoreError> {
        let (store, report) = Store::open(data_dir, StoreOptions::local())?;
        log_report(&report);
        let cache = Cache::new(cache);
        Ok(Self {
            uploads: Uploads::new(store.clone(), limits),
            looks: Arc::new(Looks::new(&store)),
            store,
            baseline: Mutex::new(cache.snapshot()),
            cache: Arc::new(cache),
            opened: Mutex::default(),
            is_recording: Arc::default(),
        })
    }

    /// For jobs, which write.
    pub fn store(&self) -> &Store {
        &self.store
    }

    /// Measured BRDFs and normal maps among the blobs.
    pub fn looks(&self) -> &Looks {
        &self.looks
    }

    /// Chunks in.
    pub fn uploads(&self) -> &Uploads {
        &self.uploads
    }

    /// Reserves a name.
    pub fn create(&self, name: &str) -> Result<DatasetView, ApiError> {
        self.store.create_dataset(name)?;
        self.get(name)
    }

    /// One dataset.
    pub fn get(&self, name: &str) -> Result<DatasetView, ApiError> {
        let versions = self.store.versions(name)?;
        let versions = versions.into_iter().map(|v| (v, self.store.manifest(name, Some(v)).ok())).collect();
        Ok(DatasetView { name: name.into(), versions })
    }

    /// At most `count` datasets whose names follow `after`, sorted; true if there are more.
    pub fn list(&self, count: usize, after: &str) -> (Vec<DatasetView>, bool) {
        let mut names = self.store.datasets().into_iter().filter(|name| name.as_str() > after);
        // One deleted in the meantime is not listed.
        let page = names.by_ref().take(count).filter_map(|name| self.get(&name).ok()).collect();
        (page, names.next().is_some())
    }

    /// Deletes for good; frames in flight keep what they hold.
    pub fn delete(&self, name: &str) -> Result<(), ApiError> {
        self.store.delete_dataset(name)?;
        self.opened().retain(|o| o.dataset != name);
        Ok(())
    }

    /// The manifest of a version; 0 for the latest.
    pub fn manifest(&self, dataset: &str, version: u64) -> Result<Manifest, ApiError> {
        self.not_empty(dataset, version)?;
        Ok(self.store.manifest(dataset, numbered(version))?)
    }

    /// Where a version came from; None for one that was not captured here, or whose note of it is damaged.
    pub fn origin(&self, dataset: &str, version: u64) -> Option<Origin> {
        let stored = self.store.open_version(dataset, numbered(version)).ok()?;
        origin_of(&stored)
    }

    /// A version ready to render; 0 for the latest.
    pub fn open_version(&self, dataset: &str, version: u64) -> Result<Arc<OpenedVersion>, ApiError> {
        self.not_empty(dataset, version)?;
        let stored = self.store.open_version(dataset, numbered(version))?;
        let slot = stored.slot();
        if let Some(found) = self.take_opened(slot) {
            return Ok(found);
        }
        // Two who miss at once both read it; the second finds the first's when it puts its own away.
        let opened = Arc::new(self.read(dataset, stored)?);
        if let Some(found) = self.take_opened(slot) {
            return Ok(found);
        }
        let mut all = self.opened();
        all.push_back(opened.clone());
        if all.len() > OPENED {
            all.pop_front();
        }
        Ok(opened)
    }

    /// The opened version of this slot, now the most recently used.
    fn take_opened(&self, slot: u32) -> Option<Arc<OpenedVersion>> {
        let mut all = self.opened();
        let at = all.iter().position(|o| o.pages.version.slot() == slot)?;
        let found = all.remove(at)?;
        all.push_back(found.clone());
        Some(found)
    }

    fn opened(&self) -> MutexGuard<'_, VecDeque<Arc<OpenedVersion>>> {
        self.opened.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn read(&self, dataset: &str, stored: Arc<DatasetVersion>) -> Result<OpenedVersion, ApiError> {
        let manifest = stored.manifest();
        let unreadable = |reason: String| {
            let message = format!("dataset {dataset} version {} cannot be read: {reason}", manifest.version);
            ApiError::new(Reason::DataCorrupt, message)
        };
        if manifest.kind == OBSERVATION_MAP {
            let message = format!("dataset {dataset} holds {OBSERVATION_MAP:?}, which cannot be rendered: fit a parameter map to it");
            return Err(ApiError::new(Reason::DatasetKindMismatch, message));
        }
        let kind = Kind::from_name(&manifest.kind).ok_or_else(|| {
            let message = format!("dataset {dataset} is of the kind {:?}, which this server does not know", manifest.kind);
            ApiError::new(Reason::FormatTooNew, message)
        })?;
        let other_version = |e: serde_json::Error| unreadable(format!("another version of this program made it ({e}); make it anew"));
        let parameters = manifest.parameters.clone();
        let part = |name: &'static str| stored.blob(name).map_err(PartError::Store);
        let broken = |error: PartError| match error {
            PartError::Store(error) => ApiError::from(error),
            PartError::Malformed(error) => unreadable(error.to_string()),
        };
        let representation: Arc<dyn Representation> = match kind {
            Kind::OffsetSurfaceLightField => {
                let parameters = serde_json::from_value(parameters).map_err(other_version)?;
                Arc::new(oslf::from_parts(parameters, &part).map_err(broken)?)
            }
            Kind::ParameterMap => {
                let parameters = serde_json::from_value(parameters).map_err(other_version)?;
                Arc::new(parameter_map::from_parts(parameters, &part).map_err(broken)?)
            }
        };
        let (pages, needed) = (manifest.pages.count as usize, representation.page_count());
        if pages != needed {
            return Err(unreadable(format!("{pages} pages, {needed} expected")));
        }
        Ok(OpenedVersion {
            dataset: dataset.into(),
            version: manifest.version,
            representation,
            origin: origin_of(&stored),
            looks: self.looks.clone(),
            pages: CachedPages { cache: self.cache.clone(), version: stored },
        })
    }

    /// An observation map without its pages, and those.
    pub fn open_observations(&self, dataset: &str, version: u64) -> Result<(ObservationMap, Arc<DatasetVersion>), ApiError> {
        self.not_empty(dataset, version)?;
        let stored = self.store.open_version(dataset, numbered(version))?;
        let manifest = stored.manifest();
        if manifest.kind != OBSERVATION_MAP {
            let message = format!("dataset {dataset} holds {:?}, {OBSERVATION_MAP:?} expected", manifest.kind);
            return Err(ApiError::new(Reason::DatasetKindMismatch, message));
        }
        let unreadable = |reason: String| {
            let message = format!("dataset {dataset} version {} cannot be read: {reason}", manifest.version);
            ApiError::new(Reason::DataCorrupt, message)
        };
        let parameters = serde_json::from_value(manifest.parameters.clone());
        let parameters = parameters.map_err(|e| unreadable(format!("another version of this program made it ({e}); make it anew")))?;
        let part = |name: &'static str| stored.blob(name).map_err(PartError::Store);
        let map = observation_map::from_parts(parameters, &part).map_err(|error| match error {
            PartError::Store(error) => ApiError::from(error),
            PartError::Malformed(error) => unreadable(error.to_string()),
        })?;
        let (pages, needed) = (manifest.pages.count as usize, map.page_count());
        match pages == needed {
            true => Ok((map, stored)),
            false => Err(unreadable(format!("{pages} pages, {needed} expected"))),
        }
    }

    /// `version` 0 of a dataset without versions is another mistake than a version that does not exist.
    fn not_empty(&self, dataset: &str, version: u64) -> Result<(), ApiError> {
        match version == 0 && self.store.versions(dataset)?.is_empty() {
            true => Err(ApiError::new(Reason::DatasetEmpty, format!("dataset {dataset} has no version yet"))),
            false => Ok(()),
        }
    }

    /// Length of the bytes with this hash: a blob, a segment or, of `dataset`, a version's manifest.
    pub fn content(&self, hash: ContentHash, dataset: &str, version: u64) -> Result<Content, ApiError> {
        if !dataset.is_empty() {
            let bytes = manifest_bytes(&self.manifest(dataset, version)?);
            if ContentHash::of(&bytes) == hash {
                return Ok(Content::Memory(bytes));
            }
        }
        Ok(Content::Stored { store: self.store.clone(), hash, bytes: self.store.blob_bytes(&hash)? })
    }

    /// The cache's counters, and those of the last reset.
    pub fn cache_stats(&self) -> (CacheSnapshot, CacheSnapshot) {
        (self.cache.snapshot(), self.baseline().clone())
    }

    /// Changes both memory tiers now.
    pub fn configure_cache(&self, change: &CacheChange) {
        if let Some(strategy) = change.strategy {
            self.cache.set_strategy(change.dataset.as_deref(), strategy);
        }
        if let Some(policy) = change.memory_policy {
            self.cache.set_policy(policy);
        }
        if let Some(policy) = change.compressed_policy {
            self.cache.set_compressed_policy(policy);
        }
        if let Some(bytes) = change.memory_budget_bytes {
            self.cache.set_budget(bytes);
        }
        if let Some(bytes) = change.compressed_budget_bytes {
            self.cache.set_compressed_budget(bytes);
        }
    }

    /// An error if there is no such dataset.
    pub fn check_exists(&self, dataset: &str) -> Result<(), ApiError> {
        self.store.versions(dataset)?;
        Ok(())
    }

    /// Records every request for texels, until the lease is finished or dropped.
    pub fn start_recording(&self, limit_bytes: usize) -> Result<RecordingLease, ApiError> {
        if self.is_recording.swap(true, Ordering::SeqCst) {
            return Err(ApiError::new(Reason::RecordingBusy, "another recording is under way; try again when it has ended"));
        }
        self.cache.start_recording(limit_bytes);
        Ok(RecordingLease { cache: self.cache.clone(), is_recording: self.is_recording.clone() })
    }

    /// Forgets every page.
    pub fn clear_cache(&self) {
        self.cache.clear();
    }

    /// Counters count from here.
    pub fn reset_cache_counters(&self) {
        self.cache.forget_peaks();
        *self.baseline() = self.cache.snapshot();
    }

    fn baseline(&self) -> MutexGuard<'_, CacheSnapshot> {
        self.baseline.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The one recording that is under way.
pub struct RecordingLease {
    cache: Arc<Cache>,
    is_recording: Arc<AtomicBool>,
}

impl RecordingLease {
    /// Ends it; what was recorded.
    pub fn finish(self) -> Trace {
        let empty = || Trace { versions: Vec::new(), events: Vec::new(), is_truncated: false };
        self.cache.stop_recording().unwrap_or_else(empty)
    }
}

impl Drop for RecordingLease {
    fn drop(&mut self) {
        self.cache.stop_recording();
        self.is_recording.store(false, Ordering::SeqCst);
    }
}

/// Bytes that can be downloaded.
pub enum Content {
    /// Made when asked for.
    Memory(Vec<u8>),
    /// On disk.
    Stored {
        /// Where.
        store: Store,
        /// Which.
        hash: ContentHash,
        /// How many.
        bytes: u64,
    },
}

impl Content {
    /// How many.
    pub fn len(&self) -> u64 {
        match self {
            Self::Memory(bytes) => bytes.len() as u64,
            Self::Stored { bytes, .. } => *bytes,
        }
    }

    /// Up to `length` bytes from `offset` on; none behind the end.
    pub fn read(&self, offset: u64, length: usize) -> Result<Vec<u8>, ApiError> {
        match self {
            Self::Memory(bytes) => {
                let start = usize::try_from(offset).unwrap_or(usize::MAX).min(bytes.len());
                Ok(bytes[start..bytes.len().min(start + length)].to_vec())
            }
            Self::Stored { store, hash, .. } => Ok(store.read_blob_range(hash, offset, length)?),
        }
    }
}

/// Why a part cannot be had: the store, or what is in it.
enum PartError {
    Store(StoreError),
    Malformed(PartsError),
}

impl From<PartsError> for PartError {
    fn from(error: PartsError) -> Self {
        Self::Malformed(error)
    }
}

fn origin_of(stored: &DatasetVersion) -> Option<Origin> {
    stored.blob(ORIGIN).ok().and_then(|bytes| Origin::from_bytes(&bytes))
}

fn numbered(version: u64) -> Option<u64> {
    (version != 0).then_some(version)
}

fn log_report(report: &OpenReport) {
    for path in &report.swept {
        tracing::info!(path = %path.display(), "swept what an interrupted run left");
    }
    for error in &report.damaged {
        tracing::error!(%error, "damaged data; everything else is served");
    }
    for (token, dataset) in &report.resumable {
        tracing::info!(token, dataset, "unfinished capture can be resumed");
    }
    if report.sweep_withheld {
        tracing::warn!("nothing is swept while a manifest is damaged");
    }
    match &report.index {
        lumisphere::textures::IndexOutcome::Intact => {}
        outcome => tracing::warn!(?outcome, "the index was not as expected"),
    }
}
