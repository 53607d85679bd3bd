//! What a start does: read the manifests, check the index against them, sweep what a crash left.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Weak};

use super::disk::{Disk, read_file};
use super::error::{At, StoreError};
use super::hash::ContentHash;
use super::index::{Index, digest};
use super::manifest::Manifest;
use super::segment::{Location, scan_headers};
use super::staging::StagingFile;
use super::store::{Catalog, Entry, Folders, IndexOutcome, OpenReport};
use super::version::VersionRecord;

/// The catalogue, and the index if one can be had.
pub(super) fn load(
    folders: &Folders,
    disk: &dyn Disk,
    index_cache_bytes: u64,
    report: &mut OpenReport,
) -> Result<(Catalog, Option<Index>), StoreError> {
    let mut catalog = Catalog::default();
    let mut index = OpeningIndex::open(&folders.index, index_cache_bytes);
    for (dataset, folder) in subfolders(&folders.datasets)? {
        let mut versions = BTreeMap::new();
        for (number, folder) in subfolders(&folder)? {
            let Ok(number) = number.parse::<u64>() else { continue };
            let path = folder.join("manifest.json");
            if !path.exists() {
                // Killed before the manifest had its name: the version never was.
                sweep_folder(disk, folder, report);
                continue;
            }
            versions.insert(number, load_version(&path, (&dataset, number), folders, disk, &mut index, report));
        }
        catalog.datasets.insert(dataset, versions);
    }
    sweep(&catalog, folders, disk, report)?;
    let (index, outcome) = index.finish(&catalog);
    report.index = outcome;
    Ok((catalog, index))
}

fn load_version(
    path: &Path,
    (dataset, number): (&str, u64),
    folders: &Folders,
    disk: &dyn Disk,
    index: &mut OpeningIndex,
    report: &mut OpenReport,
) -> Entry {
    let manifest = read_file(path).and_then(|bytes| Manifest::from_file(&bytes, path)).and_then(|manifest| {
        if manifest.dataset == dataset && manifest.version == number {
            return Ok(manifest);
        }
        Err(StoreError::DamagedFile { reason: format!("it is {} version {}'s", manifest.dataset, manifest.version), path: path.into() })
    });
    match manifest {
        Err(error) => {
            report.damaged.push(error.clone());
            Entry::Damaged(error)
        }
        Ok(manifest) => {
            check_lengths(&manifest, folders, report);
            let pages = index.pages(&manifest, folders, disk, report);
            Entry::Whole(Arc::new(VersionRecord::new(manifest, pages)), Weak::new())
        }
    }
}

/// A file that is missing or has another length is told now; other damage when it is read.
fn check_lengths(manifest: &Manifest, folders: &Folders, report: &mut OpenReport) {
    let segments = manifest.segments.iter().map(|s| (folders.segment(&s.blake3), s.bytes));
    let blobs = manifest.blobs.values().map(|b| (folders.blob(&b.blake3), b.bytes));
    for (path, expected) in segments.chain(blobs) {
        let reason = match fs::metadata(&path) {
            Ok(found) if found.len() == expected => continue,
            Ok(found) => format!("{} bytes long instead of {expected}", found.len()),
            Err(error) => error.to_string(),
        };
        report.damaged.push(StoreError::DamagedFile { reason, path });
    }
}

/// The index while the store is being opened. One entry that cannot be believed condemns it whole: it is made anew at the end.
struct OpeningIndex<'a> {
    path: &'a Path,
    cache_bytes: u64,
    index: Option<Index>,
    /// Why it has to be made anew, if it has.
    condemned: Option<String>,
    missing_reason: &'static str,
    rebuilt: Vec<(String, u64)>,
}

impl<'a> OpeningIndex<'a> {
    fn open(path: &'a Path, cache_bytes: u64) -> Self {
        let missing_reason = if path.exists() { "entries do not give the manifest's digest" } else { "there was none" };
        let (index, condemned) = match Index::open(path, cache_bytes) {
            Ok(index) => (Some(index), None),
            Err(reason) => (None, Some(reason)),
        };
        Self { path, cache_bytes, index, condemned, missing_reason, rebuilt: Vec::new() }
    }

    /// Places of a version's pages: from the index if it agrees with the manifest, else from the segments.
    fn pages(&mut self, manifest: &Manifest, folders: &Folders, disk: &dyn Disk, report: &mut OpenReport) -> Vec<Option<Location>> {
        let hashes = segment_hashes(manifest);
        let key = &manifest.pages.index;
        if let Some(pages) = self.index.as_ref().and_then(|index| index.load(key, manifest.pages.count, &hashes)) {
            return pages.into_iter().map(Some).collect();
        }
        let pages = scan(manifest, folders, disk, report);
        if whole_pages(manifest, &pages).is_some() {
            self.condemned.get_or_insert_with(|| self.missing_reason.into());
            self.rebuilt.push((manifest.dataset.clone(), manifest.version));
        } else {
            // The segments are at fault, not the index.
            report.damaged.push(StoreError::DamagedFile {
                reason: format!("{} of {} page headers are damaged", pages.iter().filter(|p| p.is_none()).count(), pages.len()),
                path: folders.dataset(&manifest.dataset).join(manifest.version.to_string()).join("manifest.json"),
            });
        }
        pages
    }

    /// Makes a condemned index anew from the catalogue.
    fn finish(self, catalog: &Catalog) -> (Option<Index>, IndexOutcome) {
        let Some(reason) = self.condemned else { return (self.index, IndexOutcome::Intact) };
        if let Some(index) = self.index {
            index.close();
        }
        let made = Index::recreate(self.path, self.cache_bytes).and_then(|index| {
            for record in catalog.records() {
                if let Some(pages) = whole_pages(&record.manifest, &record.pages) {
                    index.store(&record.manifest.pages.index, &pages)?;
                }
            }
            Ok(index)
        });
        match made {
            Ok(index) => (Some(index), IndexOutcome::Rebuilt { versions: self.rebuilt, reason }),
            Err(reason) => (None, IndexOutcome::Unavailable { reason }),
        }
    }
}

fn segment_hashes(manifest: &Manifest) -> Vec<ContentHash> {
    manifest.segments.iter().map(|s| s.blake3).collect()
}

/// The places, if none is missing and they are those of the manifest's digest.
fn whole_pages(manifest: &Manifest, pages: &[Option<Location>]) -> Option<Vec<Location>> {
    let whole: Vec<Location> = pages.iter().copied().collect::<Option<_>>()?;
    (digest(&whole, &segment_hashes(manifest)) == manifest.pages.index).then_some(whole)
}

/// Places of the pages as the segments' own headers give them; None for a page whose header is nowhere intact.
fn scan(manifest: &Manifest, folders: &Folders, disk: &dyn Disk, report: &mut OpenReport) -> Vec<Option<Location>> {
    let mut pages = vec![None; manifest.pages.count as usize];
    for (segment, entry) in manifest.segments.iter().enumerate() {
        let path = folders.segment(&entry.blake3);
        // A segment that is not there was reported with its length.
        let Ok(file) = File::open(&path) else { continue };
        match scan_headers(disk, &file, segment as u32, &path) {
            Ok(found) => {
                for found in found {
                    if let Some(place) = pages.get_mut(found.page.0 as usize) {
                        *place = Some(found.location);
                    }
                }
            }
            Err(error) => report.damaged.push(error),
        }
    }
    pages
}

/// Removes what no manifest names and no writer will come back for.
fn sweep(catalog: &Catalog, folders: &Folders, disk: &dyn Disk, report: &mut OpenReport) -> Result<(), StoreError> {
    for (_, folder) in subfolders(&folders.trash)? {
        sweep_folder(disk, folder, report);
    }
    let (stagings, unreadable) = stagings(folders);
    for (token, dataset) in stagings {
        let versions = catalog.datasets.get(&dataset);
        let published = versions.is_some_and(|v| v.values().filter_map(Entry::record).any(|r| r.manifest.token == token));
        if published || versions.is_none() {
            sweep_folder(disk, folders.staging.join(&token), report);
        } else {
            report.resumable.push((token, dataset));
        }
    }
    for (folder, error) in unreadable {
        match error {
            // Killed before the staging's first file had its name: nothing was written yet.
            None => sweep_folder(disk, folder, report),
            Some(error) => report.damaged.push(error),
        }
    }
    if catalog.has_damage() {
        report.sweep_withheld = true;
        return Ok(());
    }
    let named = catalog.named_files(folders);
    for folder in [&folders.segments, &folders.blobs] {
        for path in entries(folder)?.into_iter().filter(|path| !named.contains(path)) {
            if disk.remove_file(&path).is_ok() {
                report.swept.push(path);
            }
        }
    }
    Ok(())
}

/// Token and dataset of every staging; folders without or with a damaged `staging.json`.
#[allow(clippy::type_complexity)]
pub(super) fn stagings(folders: &Folders) -> (Vec<(String, String)>, Vec<(PathBuf, Option<StoreError>)>) {
    let (mut stagings, mut unreadable) = (Vec::new(), Vec::new());
    for (token, folder) in subfolders(&folders.staging).unwrap_or_default() {
        match StagingFile::read(&folder) {
            Ok(file) => stagings.push((token, file.dataset)),
            Err(_) if !folder.join("staging.json").exists() => unreadable.push((folder, None)),
            Err(error) => unreadable.push((folder, Some(error))),
        }
    }
    (stagings, unreadable)
}

fn sweep_folder(disk: &dyn Disk, folder: PathBuf, report: &mut OpenReport) {
    if disk.remove_dir_all(&folder).is_ok() {
        report.swept.push(folder);
    }
}

/// Paths in a folder, sorted.
fn entries(folder: &Path) -> Result<Vec<PathBuf>, StoreError> {
    let read = || -> std::io::Result<Vec<PathBuf>> { fs::read_dir(folder)?.map(|entry| Ok(entry?.path())).collect() };
    let mut paths = read().at("list", folder)?;
    paths.sort();
    Ok(paths)
}

/// Folders in a folder, sorted; names that are not UTF-8 are not ours.
fn subfolders(folder: &Path) -> Result<Vec<(String, PathBuf)>, StoreError> {
    let folders = entries(folder)?.into_iter().filter(|path| path.is_dir());
    Ok(folders.filter_map(|path| Some((path.file_name()?.to_str()?.to_string(), path))).collect())
}
