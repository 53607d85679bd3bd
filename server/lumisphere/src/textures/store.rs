//! The store: one folder, one process, many datasets.
//!
//! ```text
//! lock                                   held while a process has the store open
//! datasets/<name>/<version>/manifest.json
//! segments/<blake3>.seg   blobs/<blake3>  what manifests name; swept when none does
//! uploads/<blake3>        partial/<blake3>  uploads: whole, and under way
//! staging/<token>/                       versions being written
//! trash/                                 datasets being deleted
//! index/                                 sled; can be deleted at any time
//! ```

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};

use super::disk::{Disk, LocalDisk, sync_dir};
use super::error::{At, StoreError};
use super::hash::ContentHash;
use super::index::Index;
use super::manifest::Manifest;
use super::opening;
use super::root_lock::RootLock;
use super::segment::Location;
use super::staging::{Claim, Staging};
use super::version::{DatasetVersion, VersionRecord};

/// What a store is opened with.
#[derive(Debug, Clone)]
pub struct StoreOptions {
    /// Memory that the index may keep; it is small, and only read at start.
    pub index_cache_bytes: u64,
    /// The file system, or something that behaves like a bad one.
    pub disk: Arc<dyn Disk>,
}

impl StoreOptions {
    /// The local file system and an 8 MiB index cache.
    pub fn local() -> Self {
        Self { index_cache_bytes: 8 << 20, disk: Arc::new(LocalDisk) }
    }
}

/// What opening found and did. The library prints nothing; whoever opens tells the operator.
#[derive(Debug, Clone, Default)]
pub struct OpenReport {
    /// Left by a crash and removed.
    pub swept: Vec<PathBuf>,
    /// True if a damaged manifest forbade removing unnamed segments and blobs, which may be its own.
    pub sweep_withheld: bool,
    /// How the index was found.
    pub index: IndexOutcome,
    /// Manifests, segments and stagings that are not what was written; everything else is served.
    pub damaged: Vec<StoreError>,
    /// Stagings that can be resumed: token and dataset.
    pub resumable: Vec<(String, String)>,
}

/// State of the index at opening.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub enum IndexOutcome {
    /// Every version's entries gave the manifest's digest.
    #[default]
    Intact,
    /// Made anew from the segments, for these versions.
    Rebuilt {
        /// Dataset and version.
        versions: Vec<(String, u64)>,
        /// What was wrong.
        reason: String,
    },
    /// Cannot be opened nor made: every start reads the segments' headers.
    Unavailable {
        /// Why.
        reason: String,
    },
}

/// A folder of datasets. Cheap to clone; all clones are the same store.
#[derive(Debug, Clone)]
pub struct Store {
    inner: Arc<Inner>,
}

#[derive(Debug)]
struct Inner {
    folders: Arc<Folders>,
    disk: Arc<dyn Disk>,
    index: Mutex<Option<Index>>,
    catalog: Mutex<Catalog>,
    /// Held while files get or lose the manifest that names them.
    files: Mutex<()>,
    // Last: what is dropped before it is still locked.
    _lock: RootLock,
}

/// Which versions there are and who writes.
#[derive(Debug, Default)]
pub(super) struct Catalog {
    pub datasets: BTreeMap<String, BTreeMap<u64, Entry>>,
    pub writing: BTreeSet<String>,
    pub uploading: BTreeSet<ContentHash>,
}

#[derive(Debug)]
pub(super) enum Entry {
    /// Its opened form is shared by all who hold it.
    Whole(Arc<VersionRecord>, Weak<DatasetVersion>),
    /// Its manifest cannot be believed.
    Damaged(StoreError),
}

/// Where everything is.
#[derive(Debug)]
pub(super) struct Folders {
    pub datasets: PathBuf,
    pub segments: PathBuf,
    pub blobs: PathBuf,
    pub uploads: PathBuf,
    pub partial: PathBuf,
    pub staging: PathBuf,
    pub trash: PathBuf,
    pub index: PathBuf,
}

impl Folders {
    fn below(root: &Path) -> Self {
        Self {
            datasets: root.join("datasets"),
            segments: root.join("segments"),
            blobs: root.join("blobs"),
            uploads: root.join("uploads"),
            partial: root.join("partial"),
            staging: root.join("staging"),
            trash: root.join("trash"),
            index: root.join("index"),
        }
    }

    pub fn dataset(&self, name: &str) -> PathBuf {
        self.datasets.join(name)
    }

    pub fn segment(&self, hash: &ContentHash) -> PathBuf {
        self.segments.join(format!("{hash}.seg"))
    }

    pub fn blob(&self, hash: &ContentHash) -> PathBuf {
        self.blobs.join(hash.to_string())
    }

    pub fn upload(&self, hash: &ContentHash) -> PathBuf {
        self.uploads.join(hash.to_string())
    }

    /// The folders that the store itself makes; sled makes its own.
    fn made(&self) -> [&PathBuf; 7] {
        [&self.datasets, &self.segments, &self.blobs, &self.uploads, &self.partial, &self.staging, &self.trash]
    }
}

/// Names of datasets, tokens and blobs: safe as file names everywhere.
pub(super) fn check_name(name: &str) -> Result<(), StoreError> {
    let plain = |b: u8| b.is_ascii_lowercase() || b.is_ascii_digit();
    let valid = name.len() <= 63 && name.bytes().next().is_some_and(plain) && name.bytes().all(|b| plain(b) || b"._-".contains(&b));
    if valid { Ok(()) } else { Err(StoreError::InvalidName { name: name.into() }) }
}

impl Store {
    /// Opens or makes the store in `root`, sweeps what a crash left, checks the index. `Busy` if another process has it open.
    pub fn open(root: &Path, options: StoreOptions) -> Result<(Self, OpenReport), StoreError> {
        let disk = options.disk;
        let folders = Arc::new(Folders::below(root));
        for folder in folders.made() {
            disk.create_dir_all(folder).at("create", folder)?;
        }
        let lock = RootLock::take(root)?;
        let mut report = OpenReport::default();
        let (catalog, index) = opening::load(&folders, disk.as_ref(), options.index_cache_bytes, &mut report)?;
        let inner = Inner { folders, disk, index: Mutex::new(index), catalog: Mutex::new(catalog), files: Mutex::new(()), _lock: lock };
        Ok((Self { inner: Arc::new(inner) }, report))
    }

    pub(super) fn folders(&self) -> &Arc<Folders> {
        &self.inner.folders
    }

    pub(super) fn disk(&self) -> &dyn Disk {
        self.inner.disk.as_ref()
    }

    pub(super) fn shared_disk(&self) -> Arc<dyn Disk> {
        self.inner.disk.clone()
    }

    pub(super) fn catalog(&self) -> MutexGuard<'_, Catalog> {
        self.inner.catalog.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn lock_files(&self) -> MutexGuard<'_, ()> {
        self.inner.files.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Names of all datasets, sorted.
    pub fn datasets(&self) -> Vec<String> {
        self.catalog().datasets.keys().cloned().collect()
    }

    /// Version numbers of a dataset, rising; damaged ones included.
    pub fn versions(&self, dataset: &str) -> Result<Vec<u64>, StoreError> {
        Ok(self.catalog().versions(dataset)?.keys().copied().collect())
    }

    /// Manifest of a version, or of the newest, without opening its files.
    pub fn manifest(&self, dataset: &str, version: Option<u64>) -> Result<Manifest, StoreError> {
        match self.catalog().entry(dataset, version)? {
            Entry::Whole(record, _) => Ok(record.manifest.clone()),
            Entry::Damaged(error) => Err(error.clone()),
        }
    }

    /// A new dataset without versions.
    pub fn create_dataset(&self, dataset: &str) -> Result<(), StoreError> {
        check_name(dataset)?;
        let mut catalog = self.catalog();
        if catalog.datasets.contains_key(dataset) {
            return Err(StoreError::AlreadyExists { what: format!("dataset {dataset}") });
        }
        let folder = self.folders().dataset(dataset);
        self.disk().create_dir_all(&folder).at("create", &folder)?;
        sync_dir(self.disk(), &self.folders().datasets)?;
        catalog.datasets.insert(dataset.into(), BTreeMap::new());
        Ok(())
    }

    /// Removes a dataset, its versions and stagings. Who holds a version goes on reading it. `Busy` while it is being written.
    pub fn delete_dataset(&self, dataset: &str) -> Result<(), StoreError> {
        let _files = self.lock_files();
        let removed = {
            let mut catalog = self.catalog();
            catalog.versions(dataset)?;
            if catalog.writing.contains(dataset) {
                return Err(StoreError::Busy { what: format!("dataset {dataset} is being written") });
            }
            // One rename decides: before it the dataset is whole, after it gone.
            let trash = self.folders().trash.join(dataset);
            let _ = self.disk().remove_dir_all(&trash);
            self.disk().rename(&self.folders().dataset(dataset), &trash).at("rename", &trash)?;
            catalog.datasets.remove(dataset).unwrap_or_default()
        };
        sync_dir(self.disk(), &self.folders().datasets)?;
        self.remove_unnamed(&removed);
        for (token, owner) in opening::stagings(self.folders()).0 {
            if owner == dataset {
                let _ = self.discard_staging(&token);
            }
        }
        let _ = self.disk().remove_dir_all(&self.folders().trash.join(dataset));
        Ok(())
    }

    /// Removes all versions of a dataset that are older than its newest. Who holds one goes on reading it.
    pub fn delete_older_versions(&self, dataset: &str) -> Result<(), StoreError> {
        let _files = self.lock_files();
        let mut removed = BTreeMap::new();
        let folder = self.folders().dataset(dataset);
        let mut older = self.versions(dataset)?;
        older.pop();
        for version in older {
            // One rename decides, as for a dataset. No dataset's name holds a plus.
            let trash = self.folders().trash.join(format!("{dataset}+{version}"));
            let _ = self.disk().remove_dir_all(&trash);
            self.disk().rename(&folder.join(version.to_string()), &trash).at("rename", &trash)?;
            removed.extend(self.catalog().datasets.get_mut(dataset).and_then(|versions| versions.remove_entry(&version)));
            let _ = self.disk().remove_dir_all(&trash);
        }
        sync_dir(self.disk(), &folder)?;
        self.remove_unnamed(&removed);
        Ok(())
    }

    /// Removes files and index entries that only `removed` named. What cannot be removed now is swept at the next start.
    fn remove_unnamed(&self, removed: &BTreeMap<u64, Entry>) {
        let catalog = self.catalog();
        if catalog.has_damage() {
            return;
        }
        let named = catalog.named_files(self.folders());
        for record in removed.values().filter_map(Entry::record) {
            let files = files_of(&record.manifest, self.folders());
            for path in files.filter(|path| !named.contains(path)) {
                let _ = self.disk().remove_file(&path);
            }
            self.with_index(|index| index.forget(&record.manifest.pages.index));
        }
    }

    /// A version's manifest and pages, its files kept open; the newest version if none is named. `DamagedFile` if its manifest is.
    pub fn open_version(&self, dataset: &str, version: Option<u64>) -> Result<Arc<DatasetVersion>, StoreError> {
        match self.catalog().entry(dataset, version)? {
            Entry::Damaged(error) => Err(error.clone()),
            Entry::Whole(record, opened) => Ok(opened.upgrade().unwrap_or_else(|| {
                let version = Arc::new(DatasetVersion::open(record.clone(), self.shared_disk(), self.folders().clone()));
                *opened = Arc::downgrade(&version);
                version
            })),
        }
    }

    /// Starts or resumes writing the next version. `token` names the piece of work (a job's id): after a crash the same token finds
    /// its pages again, and `AlreadyPublished` says that it had finished. `Busy` while someone else writes this dataset.
    pub fn stage(&self, dataset: &str, token: &str) -> Result<Staging, StoreError> {
        check_name(token)?;
        let claim = {
            let mut catalog = self.catalog();
            let versions = catalog.versions(dataset)?;
            let published = versions.values().filter_map(Entry::record).find(|r| r.manifest.token == token);
            if let Some(record) = published {
                return Err(StoreError::AlreadyPublished { dataset: dataset.into(), version: record.manifest.version });
            }
            if !catalog.writing.insert(dataset.into()) {
                return Err(StoreError::Busy { what: format!("dataset {dataset} is being written") });
            }
            Claim { store: self.clone(), dataset: dataset.into() }
        };
        Staging::open(self.clone(), claim, token)
    }

    /// Stagings that exist on disk, resumable or being written: token and dataset.
    pub fn stagings(&self) -> Vec<(String, String)> {
        opening::stagings(self.folders()).0
    }

    /// Removes a staging: one rename decides, so that a half-removed one is never resumed.
    pub(super) fn discard_staging(&self, token: &str) -> Result<(), StoreError> {
        let folder = self.folders().staging.join(token);
        // No dataset's name starts with a plus.
        let trash = self.folders().trash.join(format!("+{token}"));
        let _ = self.disk().remove_dir_all(&trash);
        self.disk().rename(&folder, &trash).at("rename", &folder)?;
        // Swept at the next start if not now.
        let _ = self.disk().remove_dir_all(&trash);
        Ok(())
    }

    /// Number of the version that would be published next.
    pub(super) fn next_version(&self, dataset: &str) -> u64 {
        self.catalog().datasets.get(dataset).and_then(|v| v.keys().next_back()).map_or(1, |newest| newest + 1)
    }

    /// Makes a version visible whose manifest is on disk.
    pub(super) fn add_version(&self, record: VersionRecord, pages: &[Location]) -> Arc<DatasetVersion> {
        // An index that cannot be written is rebuilt at the next start.
        self.with_index(|index| index.store(&record.manifest.pages.index, pages));
        let record = Arc::new(record);
        let version = Arc::new(DatasetVersion::open(record.clone(), self.shared_disk(), self.folders().clone()));
        let (dataset, number) = (record.manifest.dataset.clone(), record.manifest.version);
        let entry = Entry::Whole(record, Arc::downgrade(&version));
        self.catalog().datasets.entry(dataset).or_default().insert(number, entry);
        version
    }

    /// Does something with the index, if it works; drops it at the first failure, for the next start to rebuild.
    fn with_index(&self, work: impl FnOnce(&Index) -> Result<(), String>) {
        let mut index = self.inner.index.lock().unwrap_or_else(PoisonError::into_inner);
        if index.as_ref().is_some_and(|index| work(index).is_err()) {
            *index = None;
        }
    }
}

impl Catalog {
    pub fn versions(&self, dataset: &str) -> Result<&BTreeMap<u64, Entry>, StoreError> {
        self.datasets.get(dataset).ok_or_else(|| StoreError::NotFound { what: format!("dataset {dataset}") })
    }

    fn entry(&mut self, dataset: &str, version: Option<u64>) -> Result<&mut Entry, StoreError> {
        let versions = self.datasets.get_mut(dataset).ok_or_else(|| StoreError::NotFound { what: format!("dataset {dataset}") })?;
        let found = match version {
            Some(version) => versions.get_mut(&version),
            None => versions.values_mut().next_back(),
        };
        found.ok_or_else(|| StoreError::NotFound {
            what: version.map_or(format!("a version of dataset {dataset}"), |v| format!("version {v} of dataset {dataset}")),
        })
    }

    /// True if some manifest cannot be read, so that nobody knows which files it names.
    pub fn has_damage(&self) -> bool {
        self.datasets.values().flat_map(BTreeMap::values).any(|entry| entry.record().is_none())
    }

    /// Every segment and blob that some manifest names.
    pub fn named_files(&self, folders: &Folders) -> BTreeSet<PathBuf> {
        self.records().flat_map(|record| files_of(&record.manifest, folders)).collect()
    }

    /// Every version whose manifest is whole.
    pub fn records(&self) -> impl Iterator<Item = &Arc<VersionRecord>> {
        self.datasets.values().flat_map(BTreeMap::values).filter_map(Entry::record)
    }
}

impl Entry {
    pub fn record(&self) -> Option<&Arc<VersionRecord>> {
        match self {
            Self::Whole(record, _) => Some(record),
            Self::Damaged(_) => None,
        }
    }
}

/// The files that a manifest names.
pub(super) fn files_of<'a>(manifest: &'a Manifest, folders: &'a Folders) -> impl Iterator<Item = PathBuf> + 'a {
    let segments = manifest.segments.iter().map(|s| folders.segment(&s.blake3));
    segments.chain(manifest.blobs.values().map(|b| folders.blob(&b.blake3)))
}
