//! A dataset version being written: found again after a crash, invisible until published.
//!
//! `staging/<token>/staging.json` names the dataset and the blobs, `0000.seg` … hold the pages, `blobs/` the blobs. Publishing
//! gives sealed files a second name in the store, then writes the manifest; only then does the staging folder go, and what the work kept in
//! `scratch/` for itself with it. So a crash at any
//! step leaves either the version or the staging to go on from, and what the next start sweeps.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use serde::{Deserialize, Serialize};

use super::codec::{EncodedPage, encode};
use super::disk::{read_file, sync_dir, write_atomically};
use super::error::{At, StoreError};
use super::hash::ContentHash;
use super::index;
use super::manifest::{BlobEntry, MANIFEST_FORMAT, Manifest, PageSummary, Publication, SegmentEntry, open_sealed_json, sealed_json};
use super::page::{PageId, PageShape};
use super::segment::{Location, MAX_SEGMENT_BYTES, SegmentWriter};
use super::store::{Store, check_name};
use super::version::{DatasetVersion, VersionRecord};

/// Of a BLAKE3 as text.
const HASH_DIGITS: usize = 64;

/// What `staging.json` holds.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct StagingFile {
    pub dataset: String,
    pub token: String,
    pub blobs: BTreeMap<String, BlobEntry>,
}

impl StagingFile {
    pub fn read(folder: &Path) -> Result<Self, StoreError> {
        let path = folder.join("staging.json");
        open_sealed_json("staging", &read_file(&path)?).map_err(|reason| StoreError::DamagedFile { reason, path })
    }

    fn write(&self, store: &Store, folder: &Path) -> Result<(), StoreError> {
        write_atomically(store.disk(), &folder.join("staging.json"), &sealed_json("staging", self))
    }
}

/// The only writer of a dataset. Dropping it keeps what was written; [`Store::stage`] with the same token goes on from there.
#[derive(Debug)]
pub struct Staging {
    store: Store,
    folder: PathBuf,
    state: Mutex<State>,
    // Released last: the folder is another writer's only once this one is gone.
    _claim: Claim,
}

#[derive(Debug)]
struct State {
    file: StagingFile,
    writers: Vec<SegmentWriter>,
    pages: BTreeMap<PageId, (Location, PageShape)>,
}

/// The dataset's write lock within this process.
#[derive(Debug)]
pub(super) struct Claim {
    pub store: Store,
    pub dataset: String,
}

impl Drop for Claim {
    fn drop(&mut self) {
        self.store.catalog().writing.remove(&self.dataset);
    }
}

/// What appending a page did.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Appended {
    /// On disk, header included.
    pub stored_bytes: u64,
    /// Finite numbers that f16 could not hold and that were clamped to ±65504.
    pub clamped: u64,
}

impl Staging {
    /// Opens or makes `staging/<token>`; the caller holds the claim.
    pub(super) fn open(store: Store, claim: Claim, token: &str) -> Result<Self, StoreError> {
        let folder = store.folders().staging.join(token);
        let disk = store.disk();
        let file = if folder.join("staging.json").exists() {
            StagingFile::read(&folder)?
        } else {
            disk.create_dir_all(&folder.join("blobs")).at("create", &folder)?;
            let file = StagingFile { dataset: claim.dataset.clone(), token: token.into(), blobs: BTreeMap::new() };
            file.write(&store, &folder)?;
            sync_dir(disk, &store.folders().staging)?;
            file
        };
        if file.dataset != claim.dataset {
            return Err(StoreError::AlreadyExists { what: format!("staging {token} of dataset {}", file.dataset) });
        }
        let mut state = State { file, writers: Vec::new(), pages: BTreeMap::new() };
        while segment_path(&folder, state.writers.len()).exists() {
            state.recover_segment(&store, &folder)?;
        }
        Ok(Self { store, folder, state: Mutex::new(state), _claim: claim })
    }

    fn state(&self) -> std::sync::MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Dataset that is being written.
    pub fn dataset(&self) -> String {
        self.state().file.dataset.clone()
    }

    /// The pages that are already there and need not be made again.
    pub fn pages_present(&self) -> BTreeSet<PageId> {
        self.state().pages.keys().copied().collect()
    }

    /// Encodes and appends one page of height · width · channels numbers, interleaved, row 0 first.
    /// After `DiskFull` nothing is lost and the call can be repeated.
    pub fn append_page(&self, page: PageId, shape: &PageShape, texels: &[f32]) -> Result<Appended, StoreError> {
        self.append_encoded(page, &encode(shape, texels)?)
    }

    /// Appends a page that was encoded elsewhere. The order of appending is the order on disk.
    pub fn append_encoded(&self, page: PageId, encoded: &EncodedPage) -> Result<Appended, StoreError> {
        let mut state = self.state();
        if state.pages.contains_key(&page) {
            return Err(StoreError::AlreadyExists { what: format!("page {page}") });
        }
        let bytes = encoded.stored_bytes();
        if state.writers.last().is_none_or(|w| w.length() + bytes > MAX_SEGMENT_BYTES) {
            if let Some(full) = state.writers.last_mut() {
                full.sync()?;
            }
            state.recover_segment(&self.store, &self.folder)?;
        }
        let segment = state.writers.len() as u32 - 1;
        let writer = state.writers.last_mut().expect("one was opened above");
        let location = writer.append(page, encoded, segment)?;
        state.pages.insert(page, (location, encoded.shape));
        Ok(Appended { stored_bytes: bytes, clamped: encoded.clamped })
    }

    /// Makes what was appended so far survive a power cut; a killed process loses nothing even without.
    pub fn sync(&self) -> Result<(), StoreError> {
        let mut state = self.state();
        state.writers.last_mut().map_or(Ok(()), SegmentWriter::sync)?;
        sync_dir(self.store.disk(), &self.folder)
    }

    /// Puts or replaces a named blob.
    pub fn put_blob(&self, name: &str, bytes: &[u8]) -> Result<ContentHash, StoreError> {
        check_name(name)?;
        let mut state = self.state();
        let entry = BlobEntry { bytes: bytes.len() as u64, blake3: ContentHash::of(bytes) };
        write_atomically(self.store.disk(), &self.blob_path(&entry.blake3), bytes)?;
        let mut file = state.file.clone();
        let hash = entry.blake3;
        file.blobs.insert(name.into(), entry);
        file.write(&self.store, &self.folder)?;
        state.file = file;
        Ok(hash)
    }

    /// A blob that was put before, by this run or the one it resumes; None if there is none.
    pub fn blob(&self, name: &str) -> Result<Option<Vec<u8>>, StoreError> {
        let Some(entry) = self.state().file.blobs.get(name).cloned() else { return Ok(None) };
        let path = self.blob_path(&entry.blake3);
        let bytes = read_file(&path)?;
        if ContentHash::of(&bytes) != entry.blake3 {
            return Err(StoreError::DamagedFile { reason: "content does not have the hash in its name".into(), path });
        }
        Ok(Some(bytes))
    }

    /// Keeps bytes for the work itself, durably: whoever resumes it finds them, no version has them.
    pub fn put_scratch(&self, name: &str, bytes: &[u8]) -> Result<(), StoreError> {
        check_name(name)?;
        let folder = self.folder.join("scratch");
        let disk = self.store.disk();
        disk.create_dir_all(&folder).at("create", &folder)?;
        let sealed = [&ContentHash::of(bytes).to_string().into_bytes()[..], bytes].concat();
        write_atomically(disk, &folder.join(name), &sealed)
    }

    /// Bytes that were kept before, by this run or the one it resumes; None if there are none.
    pub fn scratch(&self, name: &str) -> Result<Option<Vec<u8>>, StoreError> {
        check_name(name)?;
        let path = self.folder.join("scratch").join(name);
        if !path.exists() {
            return Ok(None);
        }
        let mut sealed = read_file(&path)?;
        let bytes = sealed.split_off(sealed.len().min(HASH_DIGITS));
        match ContentHash::of(&bytes).to_string().into_bytes() == sealed {
            true => Ok(Some(bytes)),
            false => Err(StoreError::DamagedFile { reason: "content does not have the hash that it begins with".into(), path }),
        }
    }

    fn blob_path(&self, hash: &ContentHash) -> PathBuf {
        self.folder.join("blobs").join(hash.to_string())
    }

    /// Makes the pages 0…n−1 and the blobs the dataset's next version. After an error (a full disk, say) nothing is visible and
    /// staging with the same token goes on where this stopped.
    pub fn publish(self, publication: Publication) -> Result<Arc<DatasetVersion>, StoreError> {
        let mut state = self.state();
        state.seal()?;
        let hashes: Vec<ContentHash> = state.writers.iter().map(SegmentWriter::content_hash).collect();
        let locations = state.dense_locations()?;
        let shapes: BTreeSet<PageShape> = state.pages.values().map(|(_, shape)| *shape).collect();
        let pages =
            PageSummary { count: locations.len() as u32, shapes: shapes.into_iter().collect(), index: index::digest(&locations, &hashes) };

        // From the first link to the manifest nothing may sweep files that no manifest names yet.
        let publishing = self.store.lock_files();
        self.link_into_store(&state, &hashes)?;
        let version = self.store.next_version(&state.file.dataset);
        let segments = state.writers.iter().zip(&hashes).map(|(w, &blake3)| SegmentEntry { bytes: w.length(), blake3 }).collect();
        let manifest = Manifest {
            format: MANIFEST_FORMAT,
            dataset: state.file.dataset.clone(),
            version,
            token: state.file.token.clone(),
            kind: publication.kind,
            parameters: publication.parameters,
            inputs: publication.inputs,
            code_version: publication.code_version,
            created_unix_millis: publication.created_unix_millis,
            pages,
            segments,
            blobs: state.file.blobs.clone(),
        };
        self.write_manifest(&manifest)?;
        let record = VersionRecord::new(manifest, locations.iter().copied().map(Some).collect());
        let opened = self.store.add_version(record, &locations);
        drop(publishing);
        // Published: what is left of the staging is swept at the next start if it cannot be removed now.
        let _ = self.store.discard_staging(&state.file.token);
        drop(state);
        Ok(opened)
    }

    /// Gives every sealed file its name in the store, beside the one in the staging folder.
    fn link_into_store(&self, state: &State, hashes: &[ContentHash]) -> Result<(), StoreError> {
        let (folders, disk) = (self.store.folders(), self.store.disk());
        let segments = state.writers.iter().zip(hashes).map(|(w, hash)| (w.path().to_path_buf(), folders.segment(hash)));
        let blobs = state.file.blobs.values().map(|b| (self.blob_path(&b.blake3), folders.blob(&b.blake3)));
        let named = self.store.catalog().named_files(folders);
        for (from, to) in segments.chain(blobs).filter(|(_, to)| !named.contains(to)) {
            // A name that no manifest uses is left from an attempt that failed, and its file may have grown since.
            if to.exists() {
                disk.remove_file(&to).at("remove", &to)?;
            }
            disk.link(&from, &to).at("link", &to)?;
        }
        sync_dir(disk, &folders.segments)?;
        sync_dir(disk, &folders.blobs)
    }

    fn write_manifest(&self, manifest: &Manifest) -> Result<(), StoreError> {
        let disk = self.store.disk();
        let dataset = self.store.folders().dataset(&manifest.dataset);
        let folder = dataset.join(manifest.version.to_string());
        disk.create_dir_all(&folder).at("create", &folder)?;
        // The folder first: once the manifest has its name, the whole path to it must survive.
        sync_dir(disk, &dataset)?;
        write_atomically(disk, &folder.join("manifest.json"), &manifest.to_file())
    }

    /// Throws away what was staged.
    pub fn abandon(self) -> Result<(), StoreError> {
        let token = self.state().file.token.clone();
        self.store.discard_staging(&token)
    }
}

impl State {
    /// Opens the next segment file, with what a killed writer left in it.
    fn recover_segment(&mut self, store: &Store, folder: &Path) -> Result<(), StoreError> {
        let segment = self.writers.len();
        let (writer, found) = SegmentWriter::recover(store.shared_disk(), &segment_path(folder, segment), segment as u32)?;
        self.writers.push(writer);
        self.pages.extend(found.into_iter().map(|found| (found.page, (found.location, found.shape))));
        Ok(())
    }

    fn seal(&mut self) -> Result<(), StoreError> {
        // A segment left empty by a full disk is no segment.
        while self.writers.last().is_some_and(|w| w.length() == 0) {
            self.writers.pop();
        }
        self.writers.iter_mut().try_for_each(SegmentWriter::sync)
    }

    /// Places of pages 0…n−1, or which is missing.
    fn dense_locations(&self) -> Result<Vec<Location>, StoreError> {
        let expected = (0..).map(PageId);
        if let Some((missing, _)) = expected.zip(self.pages.keys()).find(|(expected, page)| expected != *page) {
            let last = *self.pages.keys().next_back().expect("a page was found");
            return Err(StoreError::Incomplete { missing, last });
        }
        Ok(self.pages.values().map(|(location, _)| *location).collect())
    }
}

fn segment_path(folder: &Path, segment: usize) -> PathBuf {
    folder.join(format!("{segment:04}.seg"))
}
